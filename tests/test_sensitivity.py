"""Effects of errors in what counts as known are those of fits with them; focal lengths too."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from fit_sessions import (
    LENS,
    PINHOLE,
    RADIUS,
    HexapodSession,
    disturbed_start,
    irregular_hexapod,
    machine_session,
    noisy_outlines,
    noisy_readings,
    with_camera,
)
from thinned import thinned

from legcal.calibration.joint_fit.fit import refine
from legcal.calibration.joint_fit.parameter_choices import NO_CHOICES, Choices, Prior
from legcal.calibration.joint_fit.sensitivity import FITTED_CAMERA
from legcal.calibration.joint_fit.solution import Solution
from legcal.geometry.types import Array
from legcal.machine.parameters import moved_legs
from legcal.vision.camera import Camera, with_intrinsics

PART = 1e-3  # of the errors whose effects are reported
RADII = [f"leg{j}.radius.rod" for j in range(1, 7)]
FOCAL = "a focal length 1 % longer"


@pytest.fixture(scope="module")
def session() -> HexapodSession:
    return irregular_hexapod(8, camera=LENS)


def _fit(
    session: HexapodSession, choices: Choices = NO_CHOICES, camera: Camera | None = None
) -> Solution:
    data = session.measurements, session.outlines
    if camera is not None:
        data = with_camera(*data, camera)
    return refine(session.legs, *data, disturbed_start(session), choices=choices)


@pytest.fixture(scope="module")
def fit(session: HexapodSession) -> Solution:
    return _fit(session)


def _steps(found: Solution) -> dict[str, Array]:
    return {s.what: s.steps[:, 0] for s in found.sensitivities}


def _assert_moved(found: Solution, mistaken: Solution, what: str) -> None:
    """Check that a fit with a part of an error is moved by that part of its effect."""
    step, names = _steps(found)[what], found.kinematic.parametrization.names
    moved = (mistaken.estimates.vector(names) - found.estimates.vector(names)) / PART
    assert np.linalg.norm(step) > 1e-8
    np.testing.assert_allclose(moved, step, atol=0.02 * float(np.abs(step).max()))


@pytest.mark.parametrize(
    ("what", "changes"),
    [
        (FOCAL, {"fx": 12.9, "fy": 12.8}),
        ("a principal point 0.1 px further down", {"cy": 0.1}),
    ],
)
def test_a_wrong_camera_moves_the_fit_as_predicted(
    session: HexapodSession, fit: Solution, what: str, changes: dict[str, float]
) -> None:
    camera = {"fx": 1290.0, "fy": 1280.0, "cx": 518.0, "cy": 380.0}
    wrong = {name: camera[name] + PART * step for name, step in changes.items()}
    _assert_moved(fit, _fit(session, camera=with_intrinsics(LENS, wrong)), what)


@pytest.mark.parametrize("stated", thinned([False, True], [True]))
def test_wrong_radii_move_the_fit_as_predicted(session: HexapodSession, stated: bool) -> None:
    def choices(radius: float) -> Choices:
        if stated:
            return Choices(priors=dict.fromkeys(RADII, Prior(radius, 1e-6)))
        return Choices(fixed=frozenset(RADII), values=dict.fromkeys(RADII, radius))

    found, mistaken = (_fit(session, choices(RADIUS * (1.0 + p))) for p in (0.0, 0.01 * PART))
    _assert_moved(found, mistaken, "radii 1 % larger")


def test_a_wrong_file_with_a_covariance_moves_the_fit_as_predicted(
    session: HexapodSession,
) -> None:
    C = np.zeros((9, 9))
    C[:4, :4] = np.diag([4.0, 4.0, 1.0, 1.0])
    C[0, 1] = C[1, 0] = 3.9
    C[0, 2] = C[2, 0] = -1.0
    wrong = with_intrinsics(LENS, {"fx": 1290.0 + 12.9 * PART, "fy": 1280.0 + 12.8 * PART})
    found, mistaken = (_fit(session, camera=replace(c, covariance=C)) for c in (LENS, wrong))
    _assert_moved(found, mistaken, FOCAL)


def _assert_moved_to(was: Array, moved: Array, expected: Array) -> None:
    largest = float(np.abs(expected - was).max())
    np.testing.assert_allclose(moved, expected, atol=0.03 * largest)


@pytest.mark.parametrize("name", thinned(["3-rpr", "tricept"], ["tricept"]))
def test_legs_on_constraints_move_as_predicted(name: str) -> None:
    session = machine_session(name)
    camera = session.measurements.views[0].camera
    wrong = with_intrinsics(camera, {"fx": 1290.0 + 0.0129, "fy": 1280.0 + 0.0128})
    data = session.measurements, session.outlines
    found = refine(session.legs, *data, session.start)
    mistaken = refine(session.legs, *with_camera(*data, wrong), session.start)
    step = _steps(found)[FOCAL]
    assert np.linalg.norm(step) > 1e-6
    predicted = moved_legs(found.legs, found.kinematic.parametrization.place, PART * step)
    _assert_moved_to(*map(session.legs.vector, (found.legs, mistaken.legs, predicted)))


@pytest.mark.parametrize("model", thinned(["3-upu-tilted", "tricept"], ["3-upu-tilted"]))
def test_a_wrong_twist_moves_the_fit_as_predicted(model: str) -> None:
    session = machine_session(model)
    data = (session.legs, *session.noisy(0), session.start)
    found, part = refine(*data), 0.1
    effect = next(s for s in found.sensitivities if "twist" in s.what)
    name = next(n for n in found.kinematic.parametrization.names if n.endswith(".twist"))
    twist = found.estimates.values[name] + part * np.radians(0.1)
    mistaken = refine(*data, choices=Choices(fixed=frozenset({name}), values={name: twist}))
    predicted = moved_legs(
        found.legs, found.kinematic.parametrization.place, part * effect.steps[:, 0]
    )
    _assert_moved_to(*map(session.legs.vector, (found.legs, mistaken.legs, predicted)))


def fitted(
    session: HexapodSession,
    seed: int,
    factor: float,
    free: frozenset[str] = frozenset(),
    **others: float,
) -> Solution:
    """Return the fit of noisy data with a wrong focal length, or with other wrong intrinsics."""
    rng = np.random.default_rng(seed)
    measurements, outlines = noisy_readings(session, rng), noisy_outlines(session, rng)
    camera = session.measurements.views[0].camera
    scaled = {key: factor * camera.K[i, i] for i, key in enumerate(("fx", "fy"))}
    camera = with_intrinsics(camera, scaled | others)
    measurements, outlines = with_camera(measurements, outlines, camera)
    choices = Choices(frozenset(), free, {})
    return refine(session.legs, measurements, outlines, disturbed_start(session), choices=choices)


@cache
def fitted_rightly(camera: Camera) -> Solution:
    return fitted(irregular_hexapod(12, camera=camera), 0, 1.0)


def notes_on_focal_lengths(solution: Solution) -> list[str]:
    return [note for note in solution.notes if "focal length" in note]


@pytest.mark.parametrize(
    ("camera", "factor"), thinned([(PINHOLE, 0.99), (LENS, 1.01)], lambda camera, _: camera is LENS)
)
def test_a_focal_length_wrong_by_one_percent_is_noticed(camera: Camera, factor: float) -> None:
    solution = fitted(irregular_hexapod(12, camera=camera), 0, factor)
    (note,) = notes_on_focal_lengths(solution)
    found = float(note.partition("found fx = ")[2].partition(" +-")[0])
    assert found == pytest.approx(1290.0, abs=5.0)
    assert note.startswith("The focal length of c1 does not agree with the measurements")
    assert f"given {1290.0 * factor:.1f} px" in note


def test_a_view_at_another_zoom_than_the_others_of_its_camera_is_named() -> None:
    """Digital zoom: all distances from the principal point of its camera are longer."""
    session = irregular_hexapod(6)
    rng = np.random.default_rng(0)
    measurements, outlines = noisy_readings(session, rng), noisy_outlines(session, rng)
    camera = measurements.views[0].camera
    zoomed = measurements.view[outlines.row] == 1
    centre = camera.K[:2, 2]
    ends = np.where(zoomed[:, None, None], centre + 1.03 * (outlines.ends - centre), outlines.ends)
    data = with_camera(measurements, replace(outlines, ends=ends), camera)
    solution = refine(session.legs, *data, disturbed_start(session))
    (note,) = notes_on_focal_lengths(solution)
    assert note.startswith("The focal length of view c2 does not agree with the other views")
    found = float(note.partition("it differs by ")[2].partition(" +-")[0])
    assert found == pytest.approx(3.0, abs=1.2)
    assert [wrong.view for wrong in solution.camera_doubts] == ["c2"]


@pytest.mark.parametrize(
    ("camera", "wrong", "start", "words"),
    thinned(
        [
            (LENS, {"k1": 0.0}, "The distortion of c1", "appears not to have been removed"),
            (PINHOLE, {"k1": -0.1}, "The distortion of c1", "appears to have been removed"),
            (PINHOLE, {"cx": 539.0}, "The principal point of c1", "given (539.0, 380.0) px"),
            (
                LENS,
                {"cx": 524.0, "cy": 394.0},
                "The principal point of c1",
                "given (524.0, 394.0) px",
            ),
        ],
        lambda _, wrong, *__: wrong in ({"k1": -0.1}, {"cx": 539.0}),
    ),
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
    (effect,) = (s for s in solution.sensitivities if s.what == FITTED_CAMERA)
    right = fitted_rightly(camera)
    assert not [note for note in right.notes if "does not agree" in note]
    assert right.camera_doubts == ()
    names = right.kinematic.parametrization.names
    off = solution.estimates.vector(names) - right.estimates.vector(names)
    moved = effect.steps[:, 0]
    assert np.linalg.norm(off + moved) < 0.5 * np.linalg.norm(off)  # it says where the truth is
