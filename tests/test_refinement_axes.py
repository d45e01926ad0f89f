"""The fit of measured axes: exact without noise, at the Cramer-Rao bound with it."""

from dataclasses import replace

import numpy as np
import pytest
from axes_session import AxesSession, axes_session
from hexapod_session import disturbed_start, joint_errors, simulate
from thinned import thinned

from legcal.calibration.joint_fit.factors import average_images, observed_axes
from legcal.calibration.joint_fit.fit import bound, refine
from legcal.calibration.joint_fit.problem import FitProblem, build_fit
from legcal.calibration.joint_fit.solution import Solution
from legcal.data.axes import LegAxes, axes_from_outlines
from legcal.data.measurements import Measurements
from legcal.data.outlines import no_outlines
from legcal.errors import DatasetError, DidNotConverge, NotIdentifiable
from legcal.estimation import linearize
from legcal.machine import parameters_of_legs


@pytest.fixture(scope="module")
def session() -> AxesSession:
    return axes_session()


def _fit(session: AxesSession, measurements: Measurements, axes: LegAxes) -> FitProblem:
    return build_fit(session.legs, measurements, no_outlines(), axes=axes)


def _found(session: AxesSession, measurements: Measurements, axes: LegAxes) -> Solution:
    return refine(session.legs, measurements, no_outlines(), session.start(), axes=axes)


def test_the_residual_is_where_the_predicted_line_passes_the_measured_one(
    session: AxesSession,
) -> None:
    start, axes, m = session.start(), session.axes, session.measurements
    problem = _fit(session, m, axes)
    r = linearize(problem, problem.begin(start))["axes"].r
    whitening = observed_axes(axes, m, session.legs).whitening
    for i in range(0, len(axes), 7):
        j, T = axes.leg[i], start.T_camera_Rb[m.view[axes.row[i]]]
        A = T.apply(start.legs[j].A)
        B = start.T_Rb_Re[m.pose[axes.row[i]]].apply(start.legs[j].B)
        B = T.apply(B)
        # The line A + s (B - A) in the axes (e1, e2, u) with the origin M.
        frame = np.vstack([axes.basis[i], axes.u[i]])
        p, d = frame @ (A - axes.M[i]), frame @ (B - A)
        expected = np.concatenate([d[:2] / d[2], p[:2] - p[2] * d[:2] / d[2]])
        assert np.allclose(r[i], whitening[i] @ expected, rtol=1e-9)


def test_the_whitening_makes_the_claimed_covariance_one(session: AxesSession) -> None:
    T = observed_axes(session.axes, session.measurements, session.legs).whitening
    assert np.allclose(T @ session.axes.covariance @ np.swapaxes(T, -1, -2), np.eye(4), atol=1e-9)
    assert not np.triu(T, 1).any()


@pytest.mark.parametrize("coplanar", [False, True])
@pytest.mark.parametrize("joints", [0.002, 0.005])
def test_exact_axes_give_the_truth(joints: float, coplanar: bool) -> None:
    session = axes_session(coplanar=coplanar)
    start = session.start(joints=joints)
    assert np.abs(session.errors(parameters_of_legs(start.legs))).min() > 0.9 * joints
    found = refine(session.legs, session.measurements, no_outlines(), start, axes=session.axes)
    assert np.abs(session.errors(found.parameters)).max() < 1e-9
    assert found.rms_px is None
    assert found.rms_axes == pytest.approx(0.0, abs=1e-5)
    assert found.radii == {}


def test_legs_that_no_image_shows_are_found_from_their_encoders() -> None:
    session = axes_session(15)
    shown = session.axes.choose(np.flatnonzero(session.axes.leg != 2))
    found = refine(session.legs, session.measurements, no_outlines(), session.start(), axes=shown)
    assert np.abs(session.errors(found.parameters)).max() < 1e-9


def test_axes_beside_outlines_add_to_what_is_known() -> None:
    session = simulate(6, legs_seen=5)
    radii = {part: r for (_, part), r in session.legs.radii.items()}
    axes = axes_from_outlines(session.outlines, session.measurements, radii)
    arguments = (session.legs, session.measurements, session.outlines, disturbed_start(session))
    alone, both = refine(*arguments), refine(*arguments, axes=axes)
    assert np.abs(joint_errors(both.parameters)).max() < 1e-9
    assert np.all(both.sigma[:30] < alone.sigma[:30])
    assert both.dof == alone.dof + 4 * len(axes)


@pytest.mark.parametrize("coplanar", thinned([False, True], [True]))
def test_errors_reach_the_bound_and_agree_with_their_sigmas(coplanar: bool) -> None:
    session, n = axes_session(coplanar=coplanar), 40
    least = bound(_fit(session, session.measurements, session.axes), session.truth)
    solutions = [_found(session, *session.noisy(seed)) for seed in range(n)]
    errors = np.array([session.errors(found.parameters) for found in solutions])
    sigmas = np.array([found.sigma for found in solutions])
    claimed = [
        error @ np.linalg.solve(found.covariance, error) / 30
        for error, found in zip(errors, solutions, strict=True)
    ]
    to_bound = np.einsum("na,ab,nb->n", errors, np.linalg.inv(least), errors) / 30
    # The mean of 40 chi-squares of 30 degrees, over 30: 1 with a standard deviation of 0.041.
    assert np.mean(to_bound) == pytest.approx(1.0, abs=0.12)
    assert np.mean(claimed) == pytest.approx(1.0, abs=0.12)
    # Parameters share few large errors, so that their own mean squares spread more.
    assert np.mean((errors / sigmas) ** 2) == pytest.approx(1.0, abs=0.3)
    assert np.mean([found.chi2 / found.dof for found in solutions]) == pytest.approx(1.0, abs=0.02)
    assert np.mean([found.rms_axes or 0.0 for found in solutions]) < 1.0
    # What the robust loss does not keep, and no more.
    assert np.all(sigmas.mean(axis=0) > np.sqrt(np.diag(least)))
    assert sigmas.mean() < 1.02 * np.sqrt(np.diag(least)).mean()


def test_the_mean_of_images_of_one_pose_holds_what_they_hold() -> None:
    session = axes_session(5, 3)
    m, axes = session.measurements, session.axes
    mean = average_images(axes, m)
    assert len(mean) == len(axes) / 3
    assert np.array_equal(np.unique(m.pose[mean.row]), np.arange(m.n_poses))
    all_images, together = (bound(_fit(session, m, some), session.truth) for some in (axes, mean))
    assert np.allclose(together, all_images, rtol=1e-6)


def test_a_wrong_axis_hardly_bends_the_answer(session: AxesSession) -> None:
    measurements, axes = session.noisy(0)
    M = axes.M.copy()
    M[4] += [0.0, 0.0, 0.05]  # 500 sigma
    wrong = replace(axes, M=M)
    start = session.start()
    clean, bent = (
        refine(session.legs, measurements, no_outlines(), start, axes=a) for a in (axes, wrong)
    )
    moved = session.errors(bent.parameters) - session.errors(clean.parameters)
    assert np.abs(moved / clean.sigma).max() < 2.0
    assert bent.chi2 > clean.chi2 + 1e4


def test_a_covariance_that_is_not_one_is_refused(session: AxesSession) -> None:
    covariance = session.axes.covariance.copy()
    covariance[3] = 0.0
    leg = session.legs.names[session.axes.leg[3]]
    with pytest.raises(DatasetError, match=f"{leg} in row 1 could not be used: its covariance"):
        _fit(session, session.measurements, replace(session.axes, covariance=covariance))


def test_axes_in_degrees_are_refused(session: AxesSession) -> None:
    measurements, axes = session.noisy(0)
    tilt = 0.3 * np.random.default_rng(0).normal(size=(len(axes), 2))
    u = axes.u + np.einsum("ni,nia->na", tilt, axes.basis)
    u /= np.linalg.norm(u, axis=1, keepdims=True)
    e1 = axes.basis[:, 0] - u * np.sum(u * axes.basis[:, 0], axis=1, keepdims=True)
    e1 /= np.linalg.norm(e1, axis=1, keepdims=True)
    wrong = replace(axes, u=u, basis=np.stack([e1, np.cross(u, e1)], axis=1))
    with pytest.raises((DidNotConverge, NotIdentifiable)) as refusal:
        refine(session.legs, measurements, no_outlines(), session.start(), axes=wrong)
    assert "axes disagree with it" in str(refusal.value)
    assert "units (rad, m)" in str(refusal.value)


def test_fewer_equations_than_unknowns_are_refused_with_their_numbers(
    session: AxesSession,
) -> None:
    few = session.axes.choose(np.arange(8))
    with pytest.raises(NotIdentifiable, match=r"24 images with 8 axes and 144 readings give 176"):
        _fit(session, session.measurements, few)
