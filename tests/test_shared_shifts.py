"""Errors that outlines share: found where they are, and only there, and rightly weighed."""

from dataclasses import replace

import numpy as np
import pytest
from dense_fit import jacobian, residuals
from hexapod_session import (
    PINHOLE,
    Session,
    disturbed_start,
    joint_errors,
    moved_outlines,
    noisy_outlines,
    noisy_readings,
    simulate,
)

from legcal.calibration.joint_fit.factors import ObservedOutlines, observed_outlines
from legcal.calibration.joint_fit.fit import refine
from legcal.calibration.joint_fit.outline_errors import (
    KINDS,
    N_KINDS,
    EdgeBiases,
    NoiseModel,
    estimated_biases,
    possible_biases,
)
from legcal.calibration.joint_fit.problem import FitProblem, build_fit
from legcal.calibration.joint_fit.rounds import with_edge_biases
from legcal.calibration.joint_fit.variables import State
from legcal.data.outlines import Outlines
from legcal.estimation import linearize, scores_of_block
from legcal.estimation.variances import Effects, estimate_variances
from legcal.geometry.types import Array

LEAST_GAIN = 25.0


@pytest.fixture(scope="module")
def session() -> Session:
    return simulate(10, legs_seen=5, sigma_px=0.05)


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
        found = [estimate_variances(random_effects(rng, sigma), 0.0)[0] for _ in range(150)]
        assert np.mean(found, axis=0) == pytest.approx(np.square(sigma), rel=0.1, abs=0.03)


def test_white_residuals_have_no_effects_at_all() -> None:
    rng = np.random.default_rng(1)
    for _ in range(200):
        variances, gain = estimate_variances(random_effects(rng, (0.0, 0.0)), LEAST_GAIN)
        assert not variances.any()
        assert gain < LEAST_GAIN


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


def test_the_likelihood_is_that_of_the_scores() -> None:
    effects = random_effects(np.random.default_rng(3), (1.0, 0.7))
    variances = np.array([1.2, 0.3])
    D = np.diag(variances[effects.kind])

    def gaussian(covariance: Array) -> float:
        value = effects.z @ np.linalg.solve(covariance, effects.z)
        return float(-0.5 * (value + np.linalg.slogdet(covariance)[1]))

    expected = gaussian(effects.K + effects.K @ D @ effects.K) - gaussian(effects.K)
    assert effects.log_likelihood(variances) == pytest.approx(expected, rel=1e-9)


def observed_in(session: Session) -> ObservedOutlines:
    return observed_outlines(session.outlines, session.measurements, session.legs)


def scores_of(problem: FitProblem, state: State, possible: EdgeBiases) -> tuple[Array, Array]:
    """Return the scores of all biases that outlines may share, and their covariance."""
    asked, there = with_edge_biases(problem, state, possible)
    return scores_of_block(asked, there, "biases")


def test_scores_are_those_of_the_residuals_that_a_fit_leaves(session: Session) -> None:
    rng = np.random.default_rng(4)
    measurements, outlines = noisy_readings(session, rng), noisy_outlines(session, rng)
    problem = build_fit(session.legs, measurements, outlines)
    state = problem.begin(disturbed_start(session, joints=1e-5, camera=1e-5, angle=1e-5))
    whitening = NoiseModel().whitening(problem.outlines.covariance)
    possible = possible_biases(problem.outlines, session.legs.names)
    z, K = scores_of(problem, state, possible)
    linear = linearize(problem, state)
    # All at once: outlines, readings and priors, without elimination.
    J_all, r_all = jacobian(problem, linear), residuals(problem, state, whitening)
    B = np.zeros((len(problem.outlines), 2, len(possible)))
    shift = np.einsum("nij,ncj->nci", whitening, possible.shift)
    for c in range(shift.shape[1]):
        B[np.arange(len(B)), :, possible.index[:, c]] += shift[:, c]
    B_all = np.zeros((len(r_all), len(possible)))
    B_all[: 2 * len(B)] = B.reshape(-1, len(possible))
    scale = np.linalg.norm(J_all, axis=0)
    basis = np.linalg.svd(J_all / scale, full_matrices=False)[0]
    left = B_all - basis @ (basis.T @ B_all)
    np.testing.assert_allclose(K, left.T @ B_all, atol=1e-6 * np.abs(K).max())
    np.testing.assert_allclose(z, left.T @ r_all, atol=1e-6 * np.abs(z).max())


def test_scores_do_not_depend_on_the_shifts_that_are_fitted(session: Session) -> None:
    rng = np.random.default_rng(5)
    measurements, outlines = noisy_readings(session, rng), noisy_outlines(session, rng)
    problem = build_fit(session.legs, measurements, outlines)
    state = problem.begin(disturbed_start(session, joints=0.0, camera=0.0, angle=0.0))
    possible = possible_biases(problem.outlines, session.legs.names)
    bare = scores_of(problem, state, possible)
    some = possible.of_sizes(np.array([0.0, 0.1, 0.2, 0.0, 0.1, 0.0]))
    with_some, there = with_edge_biases(problem, state, some)
    there = replace(there, biases=0.1 * rng.standard_normal(len(some)))
    for one, other in zip(
        bare,
        scores_of(with_some, there, possible),
        strict=True,
    ):
        np.testing.assert_allclose(other, one, atol=1e-7 * np.abs(one).max())


def test_shifts_have_names_of_their_own(session: Session) -> None:
    observed = observed_in(session)
    possible = possible_biases(observed, session.legs.names)
    assert len(set(possible.names)) == len(possible.names) == len(possible.kind)
    assert {"all.bias", "c1.tilt", "leg1.rod.bias"} <= set(possible.names)
    assert {"c1.leg5.rod.inward.bias", "c1.leg5.rod.sideways.tilt_x"} <= set(possible.names)
    assert len(possible.of_sizes(np.zeros(N_KINDS))) == 0


def shared_errors(
    session: Session, rng: np.random.Generator, level: float, slope: float
) -> Outlines:
    """Return outlines whose edges err alike in all images of a view, and change with place."""
    observed = observed_in(session)
    possible = possible_biases(observed, session.legs.names)
    sigma = np.array([0.0, 0.0, level, level, slope, slope])
    values = sigma[possible.kind] * rng.standard_normal(len(possible))
    shift = np.einsum("nc,nce->ne", values[possible.index], possible.shift)
    return moved_outlines(noisy_outlines(session, rng), PINHOLE, shift)


def test_shared_errors_are_found_and_weighed(session: Session) -> None:
    start = disturbed_start(session)
    normalised, sizes = [], []
    for seed in range(3):
        rng = np.random.default_rng(seed)
        measurements = noisy_readings(session, rng)
        outlines = shared_errors(session, rng, 0.06, 0.03)
        found = refine(session.legs, measurements, outlines, start)
        error = joint_errors(found.parameters)
        normalised.append(error @ np.linalg.solve(found.kinematic_covariance, error) / len(error))
        sizes.append(found.noise.scale)
        assert {"bias", "tilt", "bias_x"} <= {name.rsplit(".", 1)[1] for name in found.biases}
    assert np.mean(sizes) == pytest.approx(1.0, abs=0.1)
    assert 0.7 < np.mean(normalised) < 1.5


def test_independent_errors_are_not_taken_for_shared_ones(session: Session) -> None:
    start = disturbed_start(session)
    for seed in range(5):
        rng = np.random.default_rng(100 + seed)
        measurements, outlines = noisy_readings(session, rng), noisy_outlines(session, rng)
        found = refine(session.legs, measurements, outlines, start)
        assert found.biases == {}
        assert found.noise.bias_px == found.noise.tilt_px == 0.0


def test_residuals_of_known_shifts_give_their_sizes(session: Session) -> None:
    observed = observed_in(session)
    possible = possible_biases(observed, session.legs.names)
    sigma, found = np.array([0.0, 0.0, 0.06, 0.04, 0.03, 0.0]), []
    problem = build_fit(session.legs, session.measurements, session.outlines)
    state = problem.begin(disturbed_start(session, joints=0.0, camera=0.0, angle=0.0))
    NoiseModel().whitening(observed.covariance)
    K = scores_of(problem, state, possible)[1]
    rng, value, vector = np.random.default_rng(0), *np.linalg.eigh(K)
    root = vector * np.sqrt(np.maximum(value, 0.0))
    for _ in range(40):
        b = sigma[possible.kind] * rng.standard_normal(len(possible))
        z = K @ b + root @ rng.standard_normal(len(possible))
        found.append(estimated_biases(possible, z, K).sigma ** 2)
    found_sigma = np.sqrt(np.mean(found, axis=0))[: len(KINDS)]
    assert found_sigma == pytest.approx(sigma, rel=0.15, abs=0.03)
