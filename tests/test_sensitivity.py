"""Cameras that the measurements contradict are named, with what they do to the parameters."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from fit_sessions import PINHOLE, MachineSession, irregular_hexapod, with_camera
from scipy.spatial.transform import RigidTransform, Rotation

from legcal.calibration.joint_fit.fit import refine
from legcal.calibration.joint_fit.parameter_choices import Choices
from legcal.calibration.joint_fit.scale import ALL_READINGS
from legcal.calibration.joint_fit.sensitivity import FITTED_CAMERA
from legcal.calibration.joint_fit.solution import Solution
from legcal.vision.camera import Camera, with_intrinsics


def fitted(
    session: MachineSession,
    seed: int,
    factor: float,
    free: frozenset[str] = frozenset(),
    **others: float,
) -> Solution:
    """Return the fit of noisy data with a wrong focal length, or with other wrong intrinsics."""
    measurements, outlines = session.noisy(seed)
    camera = session.measurements.views[0].camera
    scaled = {key: factor * camera.K[i, i] for i, key in enumerate(("fx", "fy"))}
    camera = with_intrinsics(camera, scaled | others)
    measurements, outlines = with_camera(measurements, outlines, camera)
    choices = Choices(frozenset(), free, {})
    return refine(session.legs, measurements, outlines, session.start, choices=choices)


@cache
def fitted_rightly(camera: Camera) -> Solution:
    return fitted(irregular_hexapod(12, camera=camera), 0, 1.0)


def test_an_error_of_pitch_may_be_of_all_motors_or_of_each() -> None:
    """A wrong scale of one motor moves the parameters as the sensitivities of a fit say."""
    session = irregular_hexapod(5)
    measurements, outlines = session.noisy(0)
    right = refine(session.legs, measurements, outlines, session.start)
    stated = right.sensitivities[ALL_READINGS]
    assert stated.shape[1] == len(session.legs.names)
    for motors in (slice(None), [2]):
        q = measurements.q.copy()
        q[:, motors] *= 1.0 + 1e-4
        wrong = refine(session.legs, replace(measurements, q=q), outlines, session.start)
        change = session.legs.vector(wrong.legs) - session.legs.vector(right.legs)
        weights, *_ = np.linalg.lstsq(stated, change, rcond=None)
        missed = change - stated @ weights
        assert np.linalg.norm(missed) < 0.2 * np.linalg.norm(change)


def notes_on_focal_lengths(solution: Solution) -> list[str]:
    return [note for note in solution.notes if "focal length" in note]


def test_a_view_at_another_zoom_than_the_others_of_its_camera_is_named() -> None:
    """Digital zoom: all distances from the principal point of its camera are longer."""
    session = irregular_hexapod(6)
    measurements, outlines = session.noisy(0)
    camera = measurements.views[0].camera
    zoomed = measurements.view[outlines.row] == 1
    centre = camera.K[:2, 2]
    ends = np.where(zoomed[:, None, None], centre + 1.03 * (outlines.ends - centre), outlines.ends)
    data = with_camera(measurements, replace(outlines, ends=ends), camera)
    solution = refine(session.legs, *data, session.start)
    (note,) = notes_on_focal_lengths(solution)
    assert note.startswith("The focal length of view c2 does not agree with the other views")
    found = float(note.partition("it differs by ")[2].partition(" +-")[0])
    assert found == pytest.approx(3.0, abs=1.2)
    assert [wrong.view for wrong in solution.camera_doubts] == ["c2"]


def test_a_view_of_photographs_that_were_turned_upside_down_is_named() -> None:
    """Its camera rolled by half a turn, and its principal point is on the other side."""
    session = irregular_hexapod(6)
    measurements, outlines = session.noisy(0)
    camera = with_intrinsics(measurements.views[0].camera, {"cx": 521.5, "cy": 373.5})
    rolled = RigidTransform.from_rotation(Rotation.from_rotvec([0.0, 0.0, np.pi]))
    of_view, size = measurements.view[outlines.row] == 1, np.array([camera.width, camera.height])
    moved = outlines.ends + camera.K[:2, 2] - measurements.views[0].camera.K[:2, 2]
    ends = np.where(of_view[:, None, None], size - 1.0 - moved, moved)
    h = np.where(of_view[:, None], outlines.h * [-1.0, -1.0, 1.0], outlines.h)
    data = with_camera(measurements, replace(outlines, ends=ends, h=h), camera)
    cameras = list(session.start.T_camera_Rb)
    cameras[1] = rolled * cameras[1]
    start = replace(session.start, T_camera_Rb=tuple(cameras))
    (wrong,) = refine(session.legs, *data, start).camera_doubts
    assert (wrong.kind, wrong.view) == ("centre", "c2")
    assert "turned upside down" in str(wrong)


@pytest.mark.parametrize(
    ("camera", "wrong", "start", "words"),
    [
        (PINHOLE, {"k1": -0.1}, "The distortion of c1", "appears to have been removed"),
        (PINHOLE, {"cx": 539.0}, "The principal point of c1", "given (539.0, 380.0) px"),
    ],
)
def test_a_wrong_camera_file_is_noticed_and_what_it_does_is_told(
    camera: Camera, wrong: dict[str, float], start: str, words: str
) -> None:
    """As where board and machine are corrected for the lens, or cropped, differently."""
    solution = fitted(irregular_hexapod(12, camera=camera), 0, 1.0, frozenset(), **wrong)
    (note,) = (note for note in solution.notes if "does not agree" in note)
    assert note.startswith(start)
    assert words in note
    assert [wrong.view for wrong in solution.camera_doubts] == ["c1"]
    steps = solution.sensitivities[FITTED_CAMERA]
    right = fitted_rightly(camera)
    assert not [note for note in right.notes if "does not agree" in note]
    assert right.camera_doubts == ()
    names = right.kinematic.parametrization.names
    off = solution.estimates.vector(names) - right.estimates.vector(names)
    moved = steps[:, 0]
    assert np.linalg.norm(off + moved) < 0.5 * np.linalg.norm(off)  # it says where the truth is
