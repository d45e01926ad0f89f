"""The estimation problem by itself: no robot, no camera, against the same written out densely."""

from dataclasses import dataclass, replace

import numpy as np
import pytest

from legcal.errors import DidNotConverge
from legcal.estimation import (
    Factor,
    GaussianPrior,
    Huber,
    Problem,
    PseudoHuber,
    Rows,
    Variables,
    all_free,
    information,
    linearize,
    minimise,
    named_covariance,
)
from legcal.geometry import Array, IntArray

N_SHARED, N_OWN, N_EACH = 3, 5, 6


@dataclass(frozen=True, eq=False)
class Waves:
    """Sums of waves of shared phases, and of offsets of each group of measurements."""

    phase: Array  # (N_SHARED, 1)
    offset: Array  # (N_OWN, 2)


def waves(rng: np.random.Generator, unknown: IntArray, noise: float = 0.0) -> Problem[Waves]:
    """Return the problem of measurements at random places, the first phase with a prior."""
    n = N_OWN * N_EACH
    place, own = rng.uniform(0.0, 6.0, (n, N_SHARED)), np.repeat(np.arange(N_OWN), N_EACH)
    slope, shared = rng.normal(size=(n, 2)), np.tile(np.arange(N_SHARED), (n, 1))
    error = noise * rng.standard_normal(n)

    def predicted(state: Waves) -> Array:
        by_offset = np.sum(slope * state.offset[own], axis=1)
        return np.asarray(np.sin(place + state.phase[:, 0]).sum(axis=1) + by_offset)

    measured = predicted(TRUTH) + error

    def rows(state: Waves) -> Rows:
        J = np.cos(place + state.phase[:, 0])
        return Rows.of((predicted(state) - measured)[:, None], J[:, None], slope[:, None])

    prior = GaussianPrior(np.zeros(1, dtype=np.intp), TRUTH.phase[0], np.array([0.5]))
    labels = tuple(f"phase {i}" for i in range(int(unknown.max()) + 1))
    return Problem(
        variables=(Variables("phase", unknown, labels=labels, units=("",) * 3, prior=prior),),
        eliminated=Variables("offset", all_free(N_OWN, 2)),
        factors=(
            Factor("values", rows, (("phase", shared, slice(None)),), n, 1, own, 10.0, robust=True),
        ),
    )


TRUTH = Waves(
    np.array([[0.3], [-0.2], [0.5]]),
    np.random.default_rng(7).normal(size=(N_OWN, 2)),
)
AWAY = Waves(TRUTH.phase + 0.1, np.zeros((N_OWN, 2)))


@pytest.mark.parametrize("loss", [PseudoHuber(), PseudoHuber(3.0), Huber(3.0)])
def test_exact_measurements_are_explained_exactly(loss: PseudoHuber | Huber) -> None:
    problem = waves(np.random.default_rng(0), all_free(N_SHARED, 1))
    found = minimise(problem, AWAY, loss)
    np.testing.assert_allclose(found.state.phase, TRUTH.phase, atol=1e-8)
    np.testing.assert_allclose(found.state.offset, TRUTH.offset, atol=1e-8)


def test_elimination_gives_the_covariance_of_the_whole_system() -> None:
    problem = waves(np.random.default_rng(1), all_free(N_SHARED, 1), 0.1)
    found = minimise(problem, AWAY)
    rows, where = found.linear["values"], problem.places["values"]
    J = np.zeros((len(rows.r), problem.size))
    J[:, :N_SHARED] = rows.J[:, 0]
    for i, k in enumerate(np.repeat(np.arange(N_OWN), N_EACH).tolist()):
        J[i, N_SHARED + 2 * k : N_SHARED + 2 * k + 2] = rows.J_element[i, 0]
    H = J.T @ J
    H[0, 0] += 0.5**-2
    assert np.array_equal(where.index, np.tile(np.arange(N_SHARED), (len(J), 1)))
    covariance = np.linalg.inv(H)[:N_SHARED, :N_SHARED]
    normal = information(problem, found.state, found.linear)
    mine = named_covariance(problem, found.state, normal.kept_covariance())
    np.testing.assert_allclose(mine, covariance, rtol=1e-9)


def test_elements_add_to_the_information_one_by_one() -> None:
    problem = waves(np.random.default_rng(2), all_free(N_SHARED, 1), 0.1)
    normal = information(problem, TRUTH, linearize(problem, TRUTH))
    parts = normal.contributions()
    assert parts.shape == (N_OWN, N_SHARED, N_SHARED)
    assert all(np.linalg.matrix_rank(part) <= 2 for part in parts)
    np.testing.assert_allclose(normal.reduced(), normal.U - parts.sum(axis=0), rtol=1e-9)


def test_fixed_numbers_stay_and_tied_ones_move_together() -> None:
    unknown = np.array([[0], [-1], [0]])
    problem = waves(np.random.default_rng(3), unknown)
    assert problem.n_kept == 1
    moved = problem.moved(AWAY, np.ones(problem.size))
    np.testing.assert_allclose(moved.phase - AWAY.phase, [[1.0], [0.0], [1.0]])
    found = minimise(problem, Waves(TRUTH.phase + 0.1 * (unknown >= 0), AWAY.offset))
    np.testing.assert_allclose(found.state.phase, TRUTH.phase, atol=1e-8)


def test_held_directions_do_not_move() -> None:
    problem = waves(np.random.default_rng(4), all_free(N_SHARED, 1))
    direction = np.array([[1.0, 1.0, 0.0]]) / np.sqrt(2.0)
    found = minimise(replace(problem, held=direction), AWAY)
    change = (found.state.phase - AWAY.phase)[:, 0]
    assert np.abs(change).max() > 1e-3
    assert direction[0] @ change == pytest.approx(0.0, abs=1e-12)


def test_too_few_steps_are_refused_unless_what_they_found_is_asked_for() -> None:
    problem = replace(
        waves(np.random.default_rng(5), all_free(N_SHARED, 1)), name="fit of waves", remedy="wait"
    )
    with pytest.raises(DidNotConverge, match=r"The fit of waves did not converge: .*; wait\."):
        minimise(problem, AWAY, max_iterations=1)
    first = minimise(problem, AWAY, max_iterations=1, must_converge=False)
    assert first.iterations == 1
