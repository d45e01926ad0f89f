"""What a mistake in cameras or radii would do is what a fit with that mistake does."""

from dataclasses import replace

import numpy as np
import pytest
from hexapod_session import LENS, RADIUS, Session, disturbed_start, moved_outlines, simulate
from machine_session import LENS as LENS_OF_MACHINES
from machine_session import machine_session

from legcal.calibration.joint_fit.choices import NO_CHOICES, Choices, Prior
from legcal.calibration.joint_fit.fit import refine
from legcal.calibration.joint_fit.solution import Solution
from legcal.geometry.types import Array
from legcal.machine import moved_legs
from legcal.vision.camera import Camera, with_intrinsics

PART = 1e-3  # of the mistakes that are told
RADII = [f"leg{j}.radius.rod" for j in range(1, 7)]


@pytest.fixture(scope="module")
def session() -> Session:
    return simulate(10, camera=LENS)


def _with_camera(session: Session, camera: Camera) -> Session:
    """Return the same pixels, taken to be from another camera."""
    views = tuple(replace(view, camera=camera) for view in session.measurements.views)
    outlines = moved_outlines(session.outlines, camera, np.zeros((len(session.outlines), 2)))
    measurements = replace(session.measurements, views=views)
    return replace(session, measurements=measurements, outlines=outlines)


def _fit(session: Session, choices: Choices = NO_CHOICES) -> Solution:
    start = disturbed_start(session)
    return refine(session.legs, session.measurements, session.outlines, start, choices=choices)


def _steps(found: Solution) -> dict[str, Array]:
    return {s.what: s.steps[:, 0] for s in found.sensitivities}


def _difference(found: Solution, mistaken: Solution) -> Array:
    """Return how all kinematic parameters differ, for the whole mistake."""
    names = found.parametrization.names
    return np.array([mistaken.values[n] - found.values[n] for n in names]) / PART


@pytest.mark.parametrize(
    ("what", "changes"),
    [
        ("a focal length 1 % longer", {"fx": 12.9, "fy": 12.9}),
        ("a principal point 0.1 px further right", {"cx": 0.1}),
        ("a principal point 0.1 px further down", {"cy": 0.1}),
    ],
)
def test_a_mistaken_camera_moves_the_fit_as_foretold(
    session: Session, what: str, changes: dict[str, float]
) -> None:
    camera = {"fx": 1290.0, "fy": 1290.0, "cx": 518.0, "cy": 380.0}
    wrong = {name: camera[name] + PART * step for name, step in changes.items()}
    found = _fit(session)
    mistaken = _fit(_with_camera(session, with_intrinsics(LENS, wrong)))
    moved = _difference(found, mistaken)
    step = _steps(found)[what]
    assert np.linalg.norm(step) > 1e-6
    np.testing.assert_allclose(moved, step, atol=0.02 * float(np.abs(step).max()))


@pytest.mark.parametrize("stated", [False, True])
def test_mistaken_radii_move_the_fit_as_foretold(session: Session, stated: bool) -> None:
    def choices(radius: float) -> Choices:
        if stated:
            return Choices(priors=dict.fromkeys(RADII, Prior(radius, 1e-6)))
        return Choices(fixed=frozenset(RADII), values=dict.fromkeys(RADII, radius))

    found = _fit(session, choices(RADIUS))
    mistaken = _fit(session, choices(RADIUS * (1.0 + 0.01 * PART)))
    step = _steps(found)["radii 1 % larger"]
    assert np.linalg.norm(step) > 1e-8
    np.testing.assert_allclose(
        _difference(found, mistaken), step, atol=0.02 * float(np.abs(step).max())
    )


def test_what_is_looked_for_is_not_taken_as_known(session: Session) -> None:
    choices = Choices(free=frozenset(["c1.fx", "c1.fy", *RADII]))
    assert set(_steps(_fit(session, choices))) == {
        "a principal point 0.1 px further right",
        "a principal point 0.1 px further down",
    }


def test_a_prior_of_a_camera_pulls_as_foretold(session: Session) -> None:
    def choices(focal: float) -> Choices:
        return Choices(priors={"c1.fx": Prior(focal, 1.0), "c1.fy": Prior(focal, 1.0)})

    found = _fit(session, choices(1290.0))
    mistaken = _fit(session, choices(1290.0 + 12.9 * PART))
    step = _steps(found)["a focal length 1 % longer"]
    assert np.linalg.norm(step) > 1e-8
    np.testing.assert_allclose(
        _difference(found, mistaken), step, atol=0.02 * float(np.abs(step).max())
    )


@pytest.mark.parametrize("name", ["3-rpr", "hexapod-rod", "tricept"])
def test_legs_on_constraints_move_as_foretold(name: str) -> None:
    session = machine_session(name)
    wrong = with_intrinsics(LENS_OF_MACHINES, {"fx": 1290.0 + 0.0129, "fy": 1280.0 + 0.0128})
    views = tuple(replace(view, camera=wrong) for view in session.measurements.views)
    measurements = replace(session.measurements, views=views)
    outlines = moved_outlines(session.outlines, wrong, np.zeros((len(session.outlines), 2)))
    found = refine(session.legs, session.measurements, session.outlines, session.start)
    mistaken = refine(session.legs, measurements, outlines, session.start)
    step = _steps(found)["a focal length 1 % longer"]
    assert np.linalg.norm(step) > 1e-6
    foretold = moved_legs(found.legs, found.parametrization.place, PART * step)
    was, moved, expected = (
        session.legs.vector(legs) for legs in (found.legs, mistaken.legs, foretold)
    )
    np.testing.assert_allclose(moved, expected, atol=0.03 * float(np.abs(expected - was).max()))


@pytest.mark.parametrize("model", ["3-upu-tilted", "tricept"])
def test_a_mistaken_twist_moves_the_fit_as_foretold(model: str) -> None:
    session = machine_session(model)
    data = (session.legs, *session.noisy(0), session.start)
    found = refine(*data)
    told = next(s for s in found.sensitivities if "twist" in s.what)
    name = next(n for n in found.parametrization.names if n.endswith(".twist"))
    part = 0.1
    twist = found.values[name] + part * np.radians(0.1)
    mistaken = refine(*data, choices=Choices(fixed=frozenset({name}), values={name: twist}))
    foretold = moved_legs(found.legs, found.parametrization.place, part * told.steps[:, 0])
    was, moved, expected = (
        session.legs.vector(legs) for legs in (found.legs, mistaken.legs, foretold)
    )
    np.testing.assert_allclose(moved, expected, atol=0.03 * float(np.abs(expected - was).max()))
