"""Errors of measurements: outliers rejected, noise, common-mode biases and gammas estimated."""

from dataclasses import replace

import numpy as np
import pytest
from dense_fit import jacobian, residuals
from fit_sessions import (
    PINHOLE,
    MachineSession,
    corners_of,
    disturbed_start,
    irregular_hexapod,
    machine_session,
    with_board,
)

from legcal.calibration.estimate import (
    GAMMA_RANGE,
    GAMMA_STEP,
    MAX_GAMMA_TRIALS,
    GammaTrials,
    most_likely,
    next_trial,
)
from legcal.calibration.joint_fit.factors import observed_outlines
from legcal.calibration.joint_fit.outline_errors import (
    PLACES,
    RECOVERED_SHARE,
    EdgeBiases,
    possible_biases,
)
from legcal.calibration.joint_fit.problem import build_fit
from legcal.calibration.joint_fit.rounds import with_edge_biases
from legcal.calibration.joint_fit.solution import Solution
from legcal.calibration.joint_fit.variables import RefinementSettings
from legcal.calibration.tuning import LIMB_GAMMA_SIGMA
from legcal.data.outlines import Outlines
from legcal.data.reasons import Reason
from legcal.errors import DidNotConverge
from legcal.estimation.problem import linearize
from legcal.estimation.solver import information
from legcal.estimation.uncertainty import score_test, scores_of_block
from legcal.geometry.types import Array
from legcal.vision.cylinder import EPSILON

SHARE = 0.2  # of outlines that are wrong
LOG_GAMMA = 0.6


@pytest.fixture(scope="module")
def session() -> MachineSession:
    return irregular_hexapod(8, legs_seen=5, sigma_px=0.05)


@pytest.mark.system
@pytest.mark.parametrize(("name", "whole_legs"), [("3-upu-tilted", False), ("tricept", True)])
def test_a_fifth_of_the_outlines_wrong_costs_less_than_half_the_accuracy(
    name: str, whole_legs: bool
) -> None:
    """Both edges of legs, or all outlines of whole legs in images, moved by 2 to 30 px."""
    session, rng = machine_session(name, n_poses=12), np.random.default_rng(100)
    o = session.outlines
    of_leg = o.row * session.legs.n_legs + o.leg
    group = of_leg if whole_legs else np.repeat(np.arange(len(o) // 2), 2)
    wrong = (rng.random(group.max() + 1) < SHARE)[group]
    assert 0.1 < wrong.mean() < 0.3
    size = rng.uniform(2.0, 30.0, of_leg.max() + 1) * rng.choice([-1.0, 1.0], of_leg.max() + 1)
    shift = np.where(wrong, size[of_leg] * np.where(o.edge == 1, 1.0, -1.0), 0.0)
    found = session.noisy(0).moved(np.repeat(shift[:, None], 2, axis=1)).fit()
    clean = session.noisy(0).fit()
    sigma = np.sqrt(np.diag(clean.kinematic.covariance))
    free = sigma > 0.0  # all but twists
    assert not found.outlines.used[wrong].any()
    assert (~found.outlines.used[~wrong]).sum() <= 2
    assert all("px" in str(found.outlines.reason[i].detail) for i in np.flatnonzero(wrong))
    of_clean, of_dirty = (
        np.sqrt(np.mean((session.errors(one.legs)[free] / sigma[free]) ** 2))
        for one in (clean, found)
    )
    assert of_clean < 1.5
    assert of_dirty < 1.5 * of_clean


def find(outlines: Outlines, row: int, leg: int, edge: int) -> int:
    found = (outlines.row == row) & (outlines.leg == leg) & (outlines.edge == edge)
    return int(np.flatnonzero(found)[0])


def test_a_rejected_outline_carries_how_far_it_is_and_the_edge_that_it_lies_on() -> None:
    session = irregular_hexapod(8)
    o, names = session.outlines, session.legs.names
    one, two = np.unique(o.leg[o.row == 2])[:2].tolist()
    other = int(o.leg[o.row == 5][0])
    swaps = {  # outlines that show another line, and the leg that their reasons name
        find(o, 2, one, 1): (find(o, 2, two, 2), names[two]),
        find(o, 5, other, 1): (find(o, 5, other, 2), names[other]),
    }
    shift = np.zeros((len(o), 2))
    shift[99] = 5.4
    outlines = session.moved(shift).outlines
    h, ends = outlines.h.copy(), outlines.ends.copy()
    for wrong, (right, _) in swaps.items():
        h[wrong], ends[wrong] = o.h[right], o.ends[right]
    found = replace(session, outlines=replace(outlines, h=h, ends=ends)).fit()
    assert set(np.flatnonzero(~found.outlines.used)) == {*swaps, 99}
    assert str(found.outlines.reason[99]) == "disagrees with the fit by 5.4 px"
    for wrong, (_, leg) in swaps.items():
        assert found.outlines.reason[wrong].reason is Reason.DISAGREES
        said = str(found.outlines.reason[wrong].detail)
        assert said.endswith(f" px, lies on edge 2 of {leg}.{leg}_tube")
    assert session.off(found.legs) < 1e-9


def test_errors_of_corners_are_found_in_their_residuals() -> None:
    session = machine_session("hexapod")
    corners, claimed = corners_of(session, seed=4), []
    for factor in (0.2, 5.0):
        said = replace(corners, sigma_px=factor * corners.sigma_px)
        seen, start = with_board(session, said)
        claimed.append(session.noisy(3).fit(start, board=seen).estimates.sigma)
    np.testing.assert_allclose(claimed[0], claimed[1], rtol=0.05)


def biases_of(session: MachineSession) -> EdgeBiases:
    """Return all biases that the outlines of a session may share."""
    observed = observed_outlines(session.outlines, session.measurements, session.legs)
    return possible_biases(observed, session.legs.names)


def shared_errors(
    session: MachineSession, rng: np.random.Generator, level: float, slope: float
) -> MachineSession:
    """Return a session whose edges err alike in all images of a view, and change with place."""
    possible = biases_of(session)
    sigma = np.array([0.0, 0.0, level, level, slope, slope])
    values = sigma[possible.kind] * rng.standard_normal(len(possible))
    observed = observed_outlines(session.outlines, session.measurements, session.legs)
    shift = np.zeros((len(observed), 2))
    shift[observed.index] = np.einsum("nc,nce->ne", values[possible.index], possible.shift)
    return session.noisy(rng).moved(shift)


def test_scores_are_those_of_the_residuals_of_a_fit(session: MachineSession) -> None:
    noisy = session.noisy(4)
    problem = build_fit(session.legs, noisy.measurements, noisy.outlines)
    state = problem.begin(disturbed_start(session, joints=1e-5, camera=1e-5, angle=1e-5))
    whitening = np.asarray(problem.factor("outlines").whitening)
    possible = biases_of(session)
    z, K = scores_of_block(linearize(*with_edge_biases(problem, state, possible)), "biases")
    linear = linearize(problem, state)
    # All at once: outlines, readings and priors, without elimination.
    J_all, r_all = jacobian(problem, linear), residuals(problem, state)
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
    tested = score_test(information(linear), {"outlines": B})
    for found, expected in zip(tested, (z, K), strict=True):
        np.testing.assert_allclose(found, expected, atol=1e-6 * np.abs(expected).max())


def test_shared_errors_are_found_and_weighed(session: MachineSession) -> None:
    normalised, sizes = [], []
    for seed in range(3):
        found = shared_errors(session, np.random.default_rng(seed), 0.06, 0.03).fit()
        normalised.append(session.squares(found))
        sizes.append(found.quality.noise.scale)
        kinds = {name.rsplit(".", 1)[1] for name in found.posterior.biases}
        assert {"bias", "tilt", "bias_x"} <= kinds
    assert np.mean(sizes) == pytest.approx(1.0, abs=0.1)
    assert 0.7 < np.mean(normalised) < 1.5


@pytest.mark.system
def test_errors_that_come_back_with_a_place_widen_the_covariance() -> None:
    session, n, sigma = irregular_hexapod(20, legs_seen=5, sigma_px=0.03, repeats=4), 4, 0.08
    normalised, found_px = [], []
    observed = observed_outlines(session.outlines, session.measurements, session.legs)
    edge = 2 * observed.radius + (observed.epsilon < 0.0)
    place = (observed.pose // n) * (int(edge.max()) + 1) + edge
    for seed in range(3):
        rng = np.random.default_rng(seed)
        shift = np.zeros((len(observed), 2))
        shift[observed.index] = sigma * rng.standard_normal(int(place.max()) + 1)[place, None]
        found = session.noisy(rng).moved(shift).fit()
        normalised.append(session.squares(found))
        found_px.append(found.quality.shared_px[PLACES[0]])
    assert 0.7 < np.mean(normalised) < 1.2
    assert np.mean(found_px) == pytest.approx(sigma, rel=0.3)


@pytest.mark.system
def test_polished_rods_are_known_less_well_though_no_residual_shows_it() -> None:
    session = irregular_hexapod(20, legs_seen=5, sigma_px=0.03, repeats=4)
    noisy = session.noisy(0)
    looks = (np.full(len(noisy.outlines), polish) for polish in (-3.0, 3.0))
    matte, polished = (
        replace(noisy, outlines=replace(noisy.outlines, polish=polish)).fit() for polish in looks
    )
    np.testing.assert_allclose(session.errors(polished.legs), session.errors(matte.legs))
    assert polished.quality.shared_px[PLACES[0]] == pytest.approx(0.2, rel=0.05)
    sigma, less = (np.sqrt(np.diag(one.kinematic.covariance)) for one in (polished, matte))
    assert np.median(sigma / less) > 2.0


def _fit_in_rounds(session: MachineSession, n_rounds: int) -> Solution:
    """Return a fit to outlines whose errors are shared by parts in views, in some rounds."""
    shared = shared_errors(session, np.random.default_rng(3), 0.2, 0.1)
    return shared.fit(settings=RefinementSettings(noise_rounds=n_rounds))


def test_a_fit_that_still_changes_a_lot_is_refused(session: MachineSession) -> None:
    with pytest.raises(DidNotConverge, match=r"did not converge on the inliers and the noise"):
        _fit_in_rounds(session, 1)


def test_a_fit_that_still_changes_a_little_says_so(session: MachineSession) -> None:
    (note,) = _fit_in_rounds(session, 4).notes or ("",)
    assert "has not converged" in note
    assert " px to 0." in note


def without_gamma(session: MachineSession) -> MachineSession:
    """Return a session of one camera whose gamma is not given."""
    return session.with_camera(replace(PINHOLE, gamma_is_given=False))


def encoded(session: MachineSession, log_gamma: float = LOG_GAMMA) -> MachineSession:
    """Return noisy outlines that were measured with a gamma of one, of a camera with another."""
    rng = np.random.default_rng(3)
    outlines = session.noisy(rng).outlines
    by_gamma = rng.normal(0.0, 0.2, len(outlines))
    inward = -by_gamma * log_gamma * EPSILON[outlines.edge - 1]
    # Normals of moved_outlines point to one side of the leg: to the inside of one of both edges.
    noisy = replace(session, outlines=outlines)
    small = noisy.moved(np.full((len(outlines), 2), 1e-3)).outlines
    xy = PINHOLE.undistort(small.ends[:, 0])
    side = np.sign(np.sum(outlines.h * np.column_stack([xy, np.ones(len(xy))]), axis=1))
    moved = noisy.moved(np.repeat((side * inward)[:, None], 2, axis=1)).outlines
    moved = replace(moved, gamma=np.ones(len(moved)), by_gamma=by_gamma)
    return replace(session, outlines=moved)


def test_gamma_of_a_camera_is_found_by_its_outlines(session: MachineSession) -> None:
    found = without_gamma(encoded(session)).fit()
    (gamma,) = found.gammas
    assert gamma.views == ("c1", "c2", "c3")
    assert gamma.measured_with == 1.0
    assert gamma.fitted_sigma < 0.02
    of_fit, unseen = gamma.fitted_sigma / RECOVERED_SHARE, np.log(gamma.gamma)  # as much again
    assert gamma.sigma == pytest.approx(np.sqrt(of_fit**2 + unseen**2 + LIMB_GAMMA_SIGMA**2))
    assert np.log(gamma.gamma) == pytest.approx(LOG_GAMMA, abs=0.06)  # the fit's own three sigmas
    assert any("The gamma of the camera of views c1, c2, c3 is not given" in n for n in found.notes)
    as_linear = encoded(session).fit()
    right, wrong = (np.sqrt(np.mean(session.errors(s.legs) ** 2)) for s in (found, as_linear))
    assert right < wrong
    assert found.quality.rms_px is not None
    assert as_linear.quality.rms_px is not None
    assert found.quality.rms_px < 0.7 * as_linear.quality.rms_px


@pytest.mark.parametrize(("log_gamma", "is_tried"), [(0.0, False), (0.5 * GAMMA_STEP, True)])
def test_a_higher_gamma_is_tried_unless_the_first_fit_excludes_it(
    session: MachineSession, log_gamma: float, *, is_tried: bool
) -> None:
    first = without_gamma(encoded(session, log_gamma)).fit()
    gammas = GammaTrials.begun(first, {}).next()
    tried = dict.fromkeys(("c1", "c2", "c3"), np.exp(GAMMA_STEP)) if is_tried else {}
    assert gammas == pytest.approx(tried)


@pytest.mark.parametrize("truth", [-0.3, 0.0, 0.15, 0.4, 0.65, 0.79, 1.05, 1.4])
def test_trials_end_at_the_gamma_that_is_likely(truth: float) -> None:
    def merit(log_gamma: Array) -> Array:
        return -0.5 * ((log_gamma - truth) / 0.05) ** 2

    tried = np.zeros(1)
    while (there := next_trial(tried, merit(tried))) is not None:
        tried = np.append(tried, there)
    assert len(tried) <= 1 + MAX_GAMMA_TRIALS
    found, (least, most) = most_likely(tried, merit(tried)), np.log(GAMMA_RANGE)
    # Between the first two the first one stays, if it is the better one.
    assert found == pytest.approx(np.clip(truth, least, most), abs=0.5 * GAMMA_STEP)
    if 0.5 * GAMMA_STEP < truth < 2.5 * GAMMA_STEP:
        assert found == pytest.approx(np.clip(truth, least, most), abs=1e-9)
