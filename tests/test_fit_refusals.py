"""What the joint fit refuses, and its starting values."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from fit_sessions import (
    PINHOLE,
    TRUTH,
    HexapodSession,
    disturbed_start,
    irregular_hexapod,
    noisy_outlines,
)

from legcal.calibration.joint_fit import fit
from legcal.calibration.joint_fit.fit import refine
from legcal.calibration.joint_fit.problem import FitProblem
from legcal.calibration.joint_fit.variables import (
    Start,
    cameras_from_hints,
    start_from,
)
from legcal.data.measurements import View
from legcal.data.outlines import Outlines
from legcal.errors import DatasetError, DidNotConverge, LegcalError, NotIdentifiable
from legcal.files.motions import motion_from_xyz_quat
from legcal.machine.leg import point_like_legs
from legcal.simulation.observe import moved_outlines


@pytest.fixture(scope="module")
def session() -> HexapodSession:
    return irregular_hexapod(6, legs_seen=5)


def at_truth(session: HexapodSession) -> Start:
    """Return a start at the truth, poses by the readings."""
    legs, poses = point_like_legs(TRUTH), session.T_Rb_Re
    m, cameras = session.measurements, session.T_camera_Rb
    return start_from(legs, m, session.legs, cameras, poses, "nominal")


def one_pose_many_times(n_times: int) -> HexapodSession:
    """Return a session in which three views see the same pose again and again."""
    once = irregular_hexapod(1, shared_poses=True)
    m, n = once.measurements, 3 * n_times
    measurements = replace(
        m,
        image=tuple(f"{i:03d}.png" for i in range(n)),
        view=np.tile(m.view, n_times),
        pose=np.arange(n),
        q=np.tile(m.q, (n_times, 1)),
    )
    o = once.outlines
    row = np.repeat(3 * np.arange(n_times), len(o)) + np.tile(o.row, n_times)
    outlines = replace(
        o,
        row=row,
        leg=np.tile(o.leg, n_times),
        edge=np.tile(o.edge, n_times),
        h=np.tile(o.h, (n_times, 1)),
        ends=np.tile(o.ends, (n_times, 1, 1)),
        covariance=np.tile(o.covariance, (n_times, 1, 1)),
        used=np.tile(o.used, n_times),
        gamma=np.tile(o.gamma, n_times),
        by_gamma=np.tile(o.by_gamma, n_times),
        polish=np.tile(o.polish, n_times),
        part=o.part * n_times,
        reason=o.reason * n_times,
        source=o.source * n_times,
    )
    return replace(once, measurements=measurements, outlines=outlines, T_Rb_Re=once.T_Rb_Re * n)


Change = Callable[[Outlines], Outlines]


def with_covariance(o: Outlines) -> Outlines:
    covariance = o.covariance.copy()
    covariance[3] = [[0.01, 0.02], [0.02, 0.01]]
    return replace(o, covariance=covariance)


def scattered(o: Outlines) -> Outlines:
    by = np.random.default_rng(0).uniform(-15.0, 15.0, (len(o), 2))
    return moved_outlines(o, PINHOLE, by)


def measured_with_two_gammas(o: Outlines) -> Outlines:
    return replace(o, gamma=np.where(np.arange(len(o)) == 5, 2.2, 1.0), by_gamma=np.ones(len(o)))


@pytest.mark.parametrize(
    ("change", "error", "found"),
    [
        (lambda o: replace(o, used=o.row < 0), NotIdentifiable, "0 outlines and 108 readings"),
        (
            lambda o: replace(o, edge=3 - o.edge),
            DidNotConverge,
            "right legs and edges|outlines rejected",
        ),
        (scattered, DidNotConverge, r"outlines rejected and an error of \d+.\d px"),
        (with_covariance, DatasetError, r"leg\d in c1_000.png .* not positive definite"),
        (lambda o: replace(o, part=("tube", *o.part[1:])), DatasetError, r"leg\d\.tube"),
        (measured_with_two_gammas, DatasetError, r"view c1 could not be used.*1 and 2\.2"),
    ],
    ids=["none", "swapped edges", "scattered", "covariance", "part", "gammas"],
)
def test_outlines_that_cannot_be_fitted_are_refused(
    session: HexapodSession, change: Change, error: type[LegcalError], found: str
) -> None:
    m = session.measurements
    camera = replace(PINHOLE, gamma_is_given=False)
    m = replace(m, views=tuple(replace(view, camera=camera) for view in m.views))
    with pytest.raises(error, match=found):
        refine(session.legs, m, change(session.outlines), disturbed_start(session))


@pytest.mark.parametrize(
    ("few", "found"),
    [
        (
            irregular_hexapod(1, n_views=2),
            r"2 images with 16 outlines and 12 readings give \d+ equations",
        ),
        (one_pose_many_times(6), r"\d+ of \d+ combinations .*leg length: .*leg"),
        (irregular_hexapod(10), r"\d+ of \d+ combinations .* with a prior"),
    ],
    ids=["two images", "one pose", "one leg"],
)
def test_images_that_do_not_determine_the_parameters_are_refused(
    few: HexapodSession, found: str
) -> None:
    shown = few.outlines
    if "prior" in found:
        shown = noisy_outlines(few, np.random.default_rng(0))
        shown = replace(shown, used=shown.leg == 0)
    with pytest.raises(NotIdentifiable, match=found):
        refine(few.legs, few.measurements, shown, at_truth(few))


def test_a_start_far_away_is_refused(session: HexapodSession) -> None:
    far = disturbed_start(session, joints=0.1, camera=0.5, angle=2.0)
    with pytest.raises(DidNotConverge, match=r"still falls by|outlines rejected"):
        refine(session.legs, session.measurements, session.outlines, far)
    with pytest.raises(DidNotConverge, match=r"still falls|outlines rejected") as refused:
        refine(session.legs, session.measurements, session.outlines, [far, far])
    assert len(refused.value.problems) == 1
    with pytest.raises(DidNotConverge, match="needs at least one"):
        refine(session.legs, session.measurements, session.outlines, [])


def test_the_start_of_the_lowest_cost_is_refined_wherever_it_stands(
    session: HexapodSession, monkeypatch: pytest.MonkeyPatch
) -> None:
    starts = [replace(at_truth(session), label=label) for label in ("second", "first", "third")]
    costs = {"first": 1.0, "second": 2.0, "third": 3.0}
    unwatched = fit._first_minimum

    def with_cost(problem: FitProblem, start: Start) -> object:
        return replace(unwatched(problem, start), cost=costs[start.label])

    monkeypatch.setattr(fit, "_first_minimum", with_cost)
    found = refine(session.legs, session.measurements, session.outlines, starts)
    assert found.start == "first"


def test_views_without_a_rough_pose_are_named(session: HexapodSession) -> None:
    T = motion_from_xyz_quat([0.1, 0.2, 0.3], [0.0, 0.0, 0.6, 0.8])
    with pytest.raises(DatasetError, match="c1, c2, c3 have no T_base_camera"):
        cameras_from_hints(session.measurements, T)
    views = tuple(View(v.name, v.camera, T) for v in session.measurements.views)
    hinted = replace(session.measurements, views=views)
    for T_camera_Rb in cameras_from_hints(hinted, T):
        np.testing.assert_allclose(T_camera_Rb.as_matrix(), np.eye(4), atol=1e-15)


def test_platform_poses_have_the_lengths_of_the_readings(session: HexapodSession) -> None:
    m = session.measurements
    start = start_from(
        point_like_legs(TRUTH),
        m,
        session.legs,
        session.T_camera_Rb,
        disturbed_start(session, camera=0.02, angle=0.1).T_Rb_Re,
        "nominal",
    )
    for found, true in zip(start.T_Rb_Re, session.T_Rb_Re, strict=True):
        assert np.linalg.norm((found.inv() * true).translation) < 1e-11
