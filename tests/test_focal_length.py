"""A focal length that is wrong is noticed where the measurements can tell, and only there."""

from dataclasses import replace

import numpy as np
import pytest
from hexapod_session import (
    LENS,
    PINHOLE,
    Session,
    disturbed_start,
    noisy_outlines,
    noisy_readings,
    simulate,
)

from legcal.calibration.joint_fit.choices import Choices
from legcal.calibration.joint_fit.fit import refine
from legcal.calibration.joint_fit.solution import Solution
from legcal.data.measurements import Measurements
from legcal.data.outlines import Outlines
from legcal.vision.camera import Camera, with_intrinsics


def scaled(camera: Camera, factor: float) -> Camera:
    """Return a camera whose focal length is wrong by a factor."""
    fx, fy = camera.K[0, 0], camera.K[1, 1]
    return with_intrinsics(camera, {"fx": factor * fx, "fy": factor * fy})


def with_camera(
    measurements: Measurements, outlines: Outlines, camera: Camera
) -> tuple[Measurements, Outlines]:
    """Return the same pixels, taken for those of another camera."""
    views = tuple(replace(view, camera=camera) for view in measurements.views)
    xy = camera.undistort(outlines.ends)
    rays = np.concatenate([xy, np.ones((*xy.shape[:-1], 1))], axis=-1)
    h = np.cross(rays[:, 0], rays[:, 1])
    h /= np.linalg.norm(h, axis=1, keepdims=True)
    h *= np.sign(np.sum(h * outlines.h, axis=1, keepdims=True))
    return replace(measurements, views=views), replace(outlines, h=h)


def fitted(
    session: Session, seed: int, factor: float, free: frozenset[str] = frozenset()
) -> Solution:
    """Return the fit of noisy data with a wrong focal length."""
    rng = np.random.default_rng(seed)
    measurements, outlines = noisy_readings(session, rng), noisy_outlines(session, rng)
    camera = scaled(session.measurements.views[0].camera, factor)
    measurements, outlines = with_camera(measurements, outlines, camera)
    choices = Choices(frozenset(), free, {})
    return refine(session.legs, measurements, outlines, disturbed_start(session), choices=choices)


def doubts(solution: Solution) -> list[str]:
    return [note for note in solution.notes if "focal length" in note]


@pytest.mark.parametrize("camera", [PINHOLE, LENS])
@pytest.mark.parametrize("factor", [0.99, 1.01])
def test_a_focal_length_wrong_by_one_percent_is_noticed(camera: Camera, factor: float) -> None:
    solution = fitted(simulate(12, camera=camera), 0, factor)
    (note,) = doubts(solution)
    assert solution.focal_doubt == pytest.approx(0.01, abs=0.004)
    found = float(note.partition("found fx = ")[2].partition(" +-")[0])
    assert found == pytest.approx(1290.0, abs=5.0)
    assert note.startswith("The focal length of c1 does not agree with the measurements")
    assert f"given {1290.0 * factor:.1f} px" in note


def test_a_right_focal_length_is_left_alone() -> None:
    session = simulate(8)
    for seed in range(6):
        solution = fitted(session, seed, 1.0)
        assert doubts(solution) == []
        assert solution.focal_doubt == 0.0


def test_nothing_is_said_where_the_measurements_cannot_tell() -> None:
    assert doubts(fitted(simulate(12, sigma_px=1.0), 0, 1.01)) == []


def test_a_focal_length_that_the_fit_looks_for_is_not_doubted() -> None:
    solution = fitted(simulate(12), 0, 1.01, frozenset({"c1.fx", "c1.fy"}))
    assert doubts(solution) == []
    sigma = solution.sigma[solution.names.index("c1.fx")]
    assert abs(solution.values["c1.fx"] - 1290.0) < 4.0 * sigma
    assert sigma < 4.0
