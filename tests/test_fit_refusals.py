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

from legcal.calibration.joint_fit.fit import refine
from legcal.calibration.joint_fit.variables import (
    Start,
    start_from,
)
from legcal.data.outlines import Outlines
from legcal.errors import DatasetError, DidNotConverge, LegcalError, NotIdentifiable
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
        (irregular_hexapod(10), r"\d+ of \d+ combinations .* with a prior"),
    ],
    ids=["two images", "one leg"],
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
