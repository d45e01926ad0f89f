"""The estimation problem by itself: no robot, no camera, against the same written out densely."""

from dataclasses import dataclass, replace

import numpy as np
import pytest
from dense_fit import jacobian, residuals

from legcal.errors import DidNotConverge
from legcal.estimation.loss import Huber, PseudoHuber
from legcal.estimation.problem import (
    EstimationProblem,
    Factor,
    GaussianPrior,
    Residuals,
    Variables,
    all_free,
    linearize,
)
from legcal.estimation.solver import information, minimise, normal_equations, robust_cost
from legcal.estimation.uncertainty import left_out_blocks, named_covariance
from legcal.estimation.variances import Effects, estimate_variances, expected_variances
from legcal.geometry.types import Array, IntArray

N_SHARED, N_ELEMENTS, N_EACH = 3, 5, 6
LOSS = PseudoHuber(0.1**-0.5)


@dataclass(frozen=True, eq=False)
class Waves:
    """Sums of waves of shared phases, and of offsets of each group of measurements."""

    phase: Array  # (N_SHARED, 1)
    offset: Array  # (N_ELEMENTS, 2)


def waves(
    rng: np.random.Generator, unknown: IntArray, noise: float = 0.0, n_open: int = 0
) -> EstimationProblem[Waves]:
    """Return the problem of measurements at random places, the first phase with a prior.

    Nothing shows the second offset of the first ``n_open`` groups.
    """
    n = N_ELEMENTS * N_EACH
    place, element = rng.uniform(0.0, 6.0, (n, N_SHARED)), np.repeat(np.arange(N_ELEMENTS), N_EACH)
    slope, shared = rng.normal(size=(n, 2)), np.tile(np.arange(N_SHARED), (n, 1))
    error = noise * rng.standard_normal(n)
    slope[element < n_open, 1] = 0.0

    def predicted(state: Waves) -> Array:
        by_offset = np.sum(slope * state.offset[element], axis=1)
        return np.asarray(np.sin(place + state.phase[:, 0]).sum(axis=1) + by_offset)

    measured = predicted(TRUTH) + error

    def rows(state: Waves) -> Residuals:
        J = np.cos(place + state.phase[:, 0])
        return Residuals.of((predicted(state) - measured)[:, None], J[:, None], slope[:, None])

    prior = GaussianPrior(np.zeros(1, dtype=np.intp), TRUTH.phase[0], np.array([0.5]))
    labels = tuple(f"phase {i}" for i in range(int(unknown.max()) + 1))
    return EstimationProblem(
        variables=(Variables("phase", unknown, labels=labels, units=("",) * 3, prior=prior),),
        eliminated=Variables("offset", all_free(N_ELEMENTS, 2)),
        factors=(
            Factor(
                "values", rows, (("phase", shared, slice(None)),), n, 1, element, 10.0, robust=True
            ),
        ),
    )


TRUTH = Waves(
    np.array([[0.3], [-0.2], [0.5]]),
    np.random.default_rng(7).normal(size=(N_ELEMENTS, 2)),
)
AWAY = Waves(TRUTH.phase + 0.1, np.zeros((N_ELEMENTS, 2)))


@pytest.mark.parametrize("n_open", [0, 2])
def test_elimination_gives_the_covariance_of_the_whole_system(n_open: int) -> None:
    problem = waves(np.random.default_rng(1), all_free(N_SHARED, 1), 0.1, n_open)
    linear = linearize(problem, AWAY)
    J, index = jacobian(problem, linear), problem.sparsity["values"].index
    assert np.array_equal(index, np.tile(np.arange(N_SHARED), (N_ELEMENTS * N_EACH, 1)))
    covariance = np.linalg.pinv(J.T @ J, hermitian=True)[:N_SHARED, :N_SHARED]
    mine = named_covariance(linear, information(linear).kept_covariance())
    np.testing.assert_allclose(mine, covariance, rtol=1e-9)


@pytest.mark.parametrize("n_open", [0, 2])
def test_blocks_that_are_left_out_are_predicted_as_by_the_rest_alone(n_open: int) -> None:
    problem = waves(np.random.default_rng(4), all_free(N_SHARED, 1), 0.1, n_open)
    state = minimise(problem, AWAY).state
    linear, block = linearize(problem, state), np.array([0, 1, 0, 2, 1])
    left_out = left_out_blocks(linear, block)
    J, r = jacobian(problem, linear), residuals(problem, state)
    for b in range(3):
        is_inside = np.append(np.repeat(block == b, N_EACH), False)  # without the prior
        rest, own = J[~is_inside], np.repeat(block == b, 2)
        x = -np.linalg.pinv(rest) @ r[~is_inside]
        known, offsets = ~np.append(np.zeros(N_SHARED, dtype=bool), own), J[is_inside]
        covariance = np.linalg.pinv((rest.T @ rest)[np.ix_(known, known)], hermitian=True)
        covariance = offsets[:, known] @ covariance @ offsets[:, known].T + np.eye(len(offsets))
        innovation, by_own = r[is_inside] + offsets[:, known] @ x[known], offsets[:, ~known]
        weight = np.linalg.inv(covariance)
        cross = by_own.T @ weight
        weight -= cross.T @ np.linalg.pinv(cross @ by_own, hermitian=True) @ cross
        assert left_out.squares[b] == pytest.approx(innovation @ weight @ innovation, rel=1e-6)
        assert left_out.dof[b] == np.linalg.matrix_rank(weight, tol=1e-9)
        H = rest.T @ rest
        shared, others = H[:N_SHARED, :N_SHARED], H[N_SHARED:, :N_SHARED]
        by_rest = shared - others.T @ np.linalg.pinv(H[N_SHARED:, N_SHARED:]) @ others
        np.testing.assert_allclose(left_out.rest[b].reduced(), by_rest, rtol=1e-6, atol=1e-6)


def _with_prior(
    problem: EstimationProblem[Waves], prior: GaussianPrior
) -> EstimationProblem[Waves]:
    (block,) = problem.variables
    return replace(problem, variables=(replace(block, prior=prior),))


@pytest.mark.parametrize("turned", [False, True])
def test_a_correlated_prior_adds_the_inverse_of_its_covariance(turned: bool) -> None:
    C, mean = np.array([[0.04, -0.03], [-0.03, 0.09]]), np.array([0.6, 0.1])
    which = np.array([2, 0], dtype=np.intp)
    single = GaussianPrior(np.array([1], dtype=np.intp), np.zeros(1), np.array([0.5]))
    problem = waves(np.random.default_rng(1), all_free(N_SHARED, 1), 0.1)
    by_x = np.random.default_rng(3).normal(size=(3, 3)) if turned else np.eye(3)
    (block,) = problem.variables
    if turned:
        read = replace(block, jacobian=lambda _: by_x, coordinates=lambda v: by_x @ v[:, 0])
        problem = replace(problem, variables=(read,))
    known = _with_prior(problem, single + GaussianPrior.from_covariance(which, mean, C))
    without = _with_prior(problem, GaussianPrior(which[:0], mean[:0], mean[:0]))
    K = np.zeros((3, 3))
    K[np.ix_(which, which)], K[1, 1] = np.linalg.inv(C), 4.0
    away = by_x @ TRUTH.phase[:, 0] - np.array([0.1, 0.0, 0.6])
    here, there = (linearize(p, TRUTH) for p in (known, without))
    a, b = normal_equations(here), normal_equations(there)
    np.testing.assert_allclose(a.U - b.U, by_x.T @ K @ by_x, atol=1e-9)
    np.testing.assert_allclose(a.g_kept - b.g_kept, by_x.T @ K @ away, atol=1e-9)
    np.testing.assert_allclose(here.prior_J.T @ here.prior_J, by_x.T @ K @ by_x, atol=1e-9)
    cost = robust_cost(here, LOSS) - robust_cost(there, LOSS)
    assert cost == pytest.approx(0.5 * away @ K @ away)


def test_fixed_numbers_stay_and_tied_ones_move_together() -> None:
    unknown = np.array([[0], [-1], [0]])
    problem = waves(np.random.default_rng(3), unknown)
    assert problem.n_kept == 1
    moved = problem.moved(AWAY, np.ones(problem.size))
    np.testing.assert_allclose(moved.phase - AWAY.phase, [[1.0], [0.0], [1.0]])
    found = minimise(problem, Waves(TRUTH.phase + 0.1 * (unknown >= 0), AWAY.offset))
    np.testing.assert_allclose(found.state.phase, TRUTH.phase, atol=1e-8)


def test_too_few_steps_are_refused_unless_what_they_found_is_asked_for() -> None:
    problem = replace(
        waves(np.random.default_rng(5), all_free(N_SHARED, 1)), name="fit of waves", remedy="wait"
    )
    with pytest.raises(DidNotConverge, match=r"The fit of waves did not converge: .*; wait\."):
        minimise(problem, AWAY, max_iterations=1)
    first = minimise(problem, AWAY, max_iterations=1, must_converge=False)
    assert first.iterations == 1


def test_loss_is_quadratic_near_and_linear_far() -> None:
    def value(r: float) -> float:
        return LOSS.cost(np.array([r * r]))

    assert value(1e-3) == pytest.approx(0.5e-6, rel=1e-6)
    assert value(2e6) - value(1e6) == pytest.approx(1e6 * LOSS.width, rel=1e-5)
    assert value(7.0) == pytest.approx(7.0**2 / (1.0 + np.sqrt(1.0 + LOSS.k * 7.0**2)))
    assert PseudoHuber().cost(np.array([9.0])) == 4.5
    assert Huber(3.0).cost(np.array([4.0, 100.0])) == 2.0 + 3.0 * (10.0 - 1.5)


def test_softened_rows_have_gradient_and_curvature_of_the_loss() -> None:
    rng = np.random.default_rng(0)
    r, J = 3.0 * rng.normal(size=(1, 2)), rng.normal(size=(1, 2, 3))
    soft_r, soft_J = LOSS.softened(r, J)

    def cost(x: Array) -> float:
        moved = r[0] + J[0] @ x
        return LOSS.cost(np.array([moved @ moved]))

    eye = 1e-4 * np.eye(3)
    gradient = [(cost(d) - cost(-d)) / 2e-4 for d in eye]
    np.testing.assert_allclose(soft_J[0].T @ soft_r[0], gradient, rtol=1e-6)
    hessian = [
        [(cost(d + e) - cost(d - e) - cost(e - d) + cost(-d - e)) / 4e-8 for d in eye] for e in eye
    ]
    np.testing.assert_allclose(soft_J[0].T @ soft_J[0], hessian, rtol=1e-5, atol=1e-6)
    assert PseudoHuber().softened(r, J)[1] is J


@pytest.mark.parametrize("m", [1, 2, 4])
def test_efficiency_of_the_loss_agrees_with_monte_carlo(m: int) -> None:
    assert PseudoHuber().efficiency(m) == pytest.approx(1.0, abs=1e-12)
    r = np.random.default_rng(0).standard_normal((400_000, m))
    s = np.sum(r**2, axis=1)
    w = 1.0 / np.sqrt(1.0 + LOSS.k * s)  # of iteratively reweighted least squares
    slope = np.mean(w - LOSS.k * w**3 * r[:, 0] ** 2)
    assert LOSS.efficiency(m) == pytest.approx(slope**2 / np.mean((w * r[:, 0]) ** 2), rel=5e-3)


def random_effects(rng: np.random.Generator, sigma: tuple[float, float]) -> Effects:
    """Return what residuals of a regression say of two kinds of effects."""
    n, n_fitted, kind = 300, 25, np.repeat([0, 1], [30, 20])
    B = rng.standard_normal((n, len(kind))) * (rng.random((n, len(kind))) < 0.1)
    fitted = np.linalg.qr(rng.standard_normal((n, n_fitted)))[0]
    r = B @ (np.array(sigma)[kind] * rng.standard_normal(len(kind))) + rng.standard_normal(n)
    left = B - fitted @ (fitted.T @ B)
    return Effects(left.T @ r, left.T @ B, kind)


def test_variances_of_random_effects_come_out_of_residuals() -> None:
    rng = np.random.default_rng(0)
    for sigma in ((1.0, 0.5), (1.5, 0.0), (0.0, 2.0)):
        found = [estimate_variances(random_effects(rng, sigma), 0.0)[0] for _ in range(60)]
        assert np.mean(found, axis=0) == pytest.approx(np.square(sigma), rel=0.15, abs=0.05)


def test_expected_variances_of_few_groups_make_covariances_hold() -> None:
    # Six means of groups of ten, and what they have in common: its error is mostly theirs.
    rng, n_groups, n_each, sigma = np.random.default_rng(5), 6, 10, 0.4
    B = np.kron(np.eye(n_groups), np.ones((n_each, 1)))
    left = B - B.mean(axis=0)
    kind = np.zeros(n_groups, dtype=np.intp)
    squares = []
    for _ in range(200):
        y = B @ (sigma * rng.standard_normal(n_groups)) + rng.standard_normal(n_groups * n_each)
        effects = Effects(left.T @ y, left.T @ B, kind)
        likeliest = estimate_variances(effects, 0.0)[0]
        expected = expected_variances(effects, likeliest, [0])
        of_mean = (np.array([likeliest[0], expected[0]]) + 1.0 / n_each) / n_groups
        squares.append(y.mean() ** 2 / of_mean)
    plain, honest = np.mean(squares, axis=0)
    assert plain > 1.4
    assert 0.9 < honest < 1.3


def test_the_slope_is_that_of_the_likelihood() -> None:
    effects = random_effects(np.random.default_rng(2), (1.0, 0.7))
    at, step = np.array([0.4, 0.9]), 1e-5
    numeric = [
        (effects.log_likelihood(at + step * e) - effects.log_likelihood(at - step * e))
        / (2.0 * step)
        for e in np.eye(2)
    ]
    np.testing.assert_allclose(effects.slope(at)[0], numeric, rtol=1e-6)
    assert effects.log_likelihood(np.zeros(2)) == 0.0
