"""Intrinsics whose camera file states a covariance are unknowns of the joint fit, known by it.

Camera files that the measurements contradict are named, with what they do to the parameters.
"""

import re
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from edits import keyed
from fit_sessions import LENS, PINHOLE, MachineSession, irregular_hexapod, machine_session
from scipy.spatial.transform import RigidTransform, Rotation
from simulated import simulated
from thinned import thinned

from legcal import calibrate, check, load_dataset
from legcal.calibration.documents import Result
from legcal.calibration.joint_fit.parameter_choices import Choices, Prior
from legcal.calibration.joint_fit.scale import ALL_READINGS
from legcal.calibration.joint_fit.sensitivity import (
    EXACT_CAMERAS,
    FITTED_CAMERA,
    INTRINSICS,
    SIGMA_EXACT,
    CameraResiduals,
)
from legcal.calibration.joint_fit.solution import Solution
from legcal.estimation.problem import linearize
from legcal.geometry.types import Array, BoolArray
from legcal.vision.camera import Camera, intrinsic_names, intrinsic_values, with_intrinsics
from legcal.vision.camera_file import read_camera

pytestmark = pytest.mark.usefixtures("without_steps")

NAMES = intrinsic_names(LENS)
SIGMA = np.array([3.0, 3.0, 1.5, 1.5, 0.004, 0.02, 3e-4, 3e-4, 0.0])  # k3 is held at zero
FREE = tuple(f"c1.{name}" for name in NAMES[:-1])


def _covariance(sigma: Array = SIGMA) -> Array:
    """Return a covariance correlated as that of calibrations is: fx to fy, cx to p2, k1 to k2."""
    C = np.eye(len(NAMES))
    for a, b, r in (("fx", "fy", 0.98), ("cx", "p2", -0.9), ("cy", "p1", -0.9), ("k1", "k2", -0.9)):
        i, j = NAMES.index(a), NAMES.index(b)
        C[i, j] = C[j, i] = r
    return np.asarray(sigma[:, None] * C * sigma)


COVARIANCE = _covariance()


@cache
def session(seed: int | None = 0, n_poses: int = 5) -> MachineSession:
    exact = machine_session("hexapod", n_poses=n_poses)
    return exact if seed is None else exact.noisy(seed)


def fitted(given: MachineSession, camera: Camera) -> Solution:
    """Return the fit of the pixels of a session with another camera."""
    return given.with_camera(camera).fit()


def moved(away: Array, covariance: Array | None = COVARIANCE) -> Camera:
    """Return the true camera with errors of its intrinsics, and what its file states."""
    values = (intrinsic_values(LENS) + away).tolist()
    return replace(
        with_intrinsics(LENS, dict(zip(NAMES, values, strict=True))), covariance=covariance
    )


def test_the_part_of_the_intrinsics_is_what_exact_ones_would_remove() -> None:
    rough, exact = (
        fitted(session(), moved(0.0 * SIGMA, C)) for C in (_covariance(9 * SIGMA), None)
    )
    part = rough.sensitivities[INTRINSICS]
    assert INTRINSICS not in exact.sensitivities
    C, remains = rough.kinematic.covariance, exact.kinematic.covariance
    free = np.diagonal(remains) > 0.0
    assert np.median(np.diagonal(C)[free] / np.diagonal(remains)[free]) > 1.2  # it matters
    sigma, expected = (np.sqrt(np.diagonal(x)[free]) for x in (C - part @ part.T, remains))
    np.testing.assert_allclose(sigma, expected, rtol=0.1)


def test_an_exact_focal_length_may_be_off_by_what_the_images_leave_of_it() -> None:
    by_focal = np.array([LENS.K[0, 0], LENS.K[1, 1], *[0.0] * (len(NAMES) - 2)])
    right, wrong = (
        fitted(session(None), moved(part * by_focal, None)) for part in (0.0, SIGMA_EXACT)
    )
    left = right.sensitivities[EXACT_CAMERAS][:, 0]
    change = session().errors(wrong.legs) - session().errors(right.legs)
    sizes = np.linalg.norm(left), np.linalg.norm(change)
    assert left @ change > 0.9 * np.prod(sizes)
    assert 1e-3 < sizes[0] / sizes[1] < 1.0  # images know a part of it
    assert EXACT_CAMERAS not in fitted(session(), moved(0.0 * SIGMA)).sensitivities


def test_noise_does_not_lengthen_a_focal_length(tmp_path: Path) -> None:
    # Distances in pixels must not shrink with a longer focal length: 700 of them would gain by it.
    simulated(tmp_path / "s", "3-rps", views=3, poses=8, sigma_px=1.5, seed=1)
    vague = {f"c1.{name}": (1290.3, 60.0) for name in ("fx", "fy")}
    found = calibrate(tmp_path / "s", priors=vague, use_cache=False).solution
    true, sigma = 1290.3, found.estimates.sigma[found.estimates.names.index("c1.fx")]
    assert sigma < 12.0
    assert abs(found.cameras[0].K[0, 0] - true) < 3.0 * sigma


def said_of_cameras(found: Solution) -> list[str]:
    return [note for note in found.notes if "agree" in note]


def test_errors_of_a_drawn_camera_are_those_that_the_fit_states() -> None:
    rng = np.random.default_rng(3)
    root = np.linalg.cholesky(COVARIANCE[:-1, :-1])
    honest, exact = [], []
    for seed in range(3):
        given = session(seed)
        away = np.append(root @ rng.standard_normal(len(NAMES) - 1), 0.0)
        found = fitted(given, moved(away))
        honest.append(given.squares(found))
        assert said_of_cameras(found) == []
        if seed < 1:
            exact.append(given.squares(fitted(given, moved(away, None))))
    n = 3 * len(session().legs.parametrization)
    assert abs(np.mean(honest) - 1.0) < 4.0 * np.sqrt(2.0 / n)
    assert np.mean(exact) > 2.0


def test_intrinsics_of_exact_pictures_are_found() -> None:
    given = session(None)
    away = np.array([2.0, -1.0, 1.0, -1.0, 0.003, -0.01, 2e-4, -2e-4, 0.0])
    found = fitted(given, moved(away, _covariance(1e4 * SIGMA)))
    names = {f"c1.{name}" for name in NAMES}
    assert [name for name in found.estimates.names if name in names] == [*FREE]
    others = "c2", "c3"  # views of the same camera
    assert not any(name.startswith(others) for name in found.estimates.values)
    assert found.cameras[2].K is not LENS.K
    np.testing.assert_allclose(found.cameras[2].K, LENS.K, atol=1e-4)
    assert given.off(found.legs) < 1e-7


def test_what_the_owner_chooses_leaves_the_covariance_of_the_file() -> None:
    camera = replace(LENS, covariance=COVARIANCE)
    choices = Choices(
        fixed=frozenset({"c1.fx"}),
        free=frozenset({"c1.cx"}),
        priors={"c1.cy": Prior(380.5, 1e-6)},
    )
    given = session().with_camera(camera)
    stated, chosen = given.fit(), given.fit(choices=choices)
    assert "c1.fx" not in chosen.estimates.values
    assert "c1.cx" not in chosen.estimates.prior_sigma
    fy = [found.estimates.prior_sigma["c1.fy"] for found in (chosen, stated)]
    assert fy == pytest.approx([SIGMA[1]] * 2)
    assert chosen.estimates.values["c1.cy"] == pytest.approx(380.5, abs=1e-5)
    sigma = [
        found.estimates.sigma[found.estimates.names.index("c1.cx")] for found in (stated, chosen)
    ]
    assert sigma[1] > sigma[0]


@pytest.mark.parametrize(
    ("name", "error", "said"),
    thinned(
        [
            ("f", 0.01, ("focal length of c1", "given 1302.9 px", "same focus and zoom")),
            ("cx", 25.0, ("principal point of c1", "given (543.0, 380.0) px", "same focus and")),
        ],
        lambda name, *_: name == "cx",
    ),
)
def test_a_camera_that_contradicts_its_covariance_is_named(
    name: str, error: float, said: tuple[str, ...]
) -> None:
    away = np.zeros(len(NAMES))
    if name == "f":
        away[:2] = error * intrinsic_values(LENS)[:2]
    else:
        away[NAMES.index(name)] = error
    found = fitted(session(n_poses=8), moved(away, _covariance(0.3 * SIGMA)))
    (note,) = said_of_cameras(found)
    assert [word for word in said if word not in note] == []
    assert [wrong.view for wrong in found.camera_doubts] == ["c1"]


def test_an_error_of_pitch_may_be_of_all_motors_or_of_each() -> None:
    """A wrong scale of one motor moves the parameters as the sensitivities of a fit say."""
    noisy = irregular_hexapod(5).noisy(0)
    right = noisy.fit()
    stated = right.sensitivities[ALL_READINGS]
    assert stated.shape[1] == len(noisy.legs.names)
    for motors in (slice(None), [2]):
        q = noisy.measurements.q.copy()
        q[:, motors] *= 1.0 + 1e-4
        wrong = noisy.with_readings(q).fit()
        change = noisy.legs.vector(wrong.legs) - noisy.legs.vector(right.legs)
        weights, *_ = np.linalg.lstsq(stated, change, rcond=None)
        missed = change - stated @ weights
        assert np.linalg.norm(missed) < 0.2 * np.linalg.norm(change)


def test_a_view_of_photographs_that_were_turned_upside_down_is_named() -> None:
    """Its camera rolled by half a turn, and its principal point is on the other side."""
    noisy = irregular_hexapod(6).noisy(0)
    o, camera = noisy.outlines, with_intrinsics(PINHOLE, {"cx": 521.5, "cy": 373.5})
    rolled = RigidTransform.from_rotation(Rotation.from_rotvec([0.0, 0.0, np.pi]))
    of_view, size = noisy.measurements.view[o.row] == 1, np.array([camera.width, camera.height])
    moved = o.ends + camera.K[:2, 2] - PINHOLE.K[:2, 2]
    ends = np.where(of_view[:, None, None], size - 1.0 - moved, moved)
    h = np.where(of_view[:, None], o.h * [-1.0, -1.0, 1.0], o.h)
    given = replace(noisy, outlines=replace(o, ends=ends, h=h)).with_camera(camera)
    cameras = list(given.start.T_camera_Rb)
    cameras[1] = rolled * cameras[1]
    turned = replace(given, start=replace(given.start, T_camera_Rb=tuple(cameras)))
    (wrong,) = turned.fit().camera_doubts
    assert (wrong.kind, wrong.view) == ("centre", "c2")
    assert "turned upside down" in str(wrong)


def test_a_view_at_another_zoom_than_the_others_of_its_camera_is_named() -> None:
    """Digital zoom: all distances from the principal point of its camera are longer."""
    noisy = irregular_hexapod(6).noisy(0)
    o, centre = noisy.outlines, PINHOLE.K[:2, 2]
    zoomed = (noisy.measurements.view[o.row] == 1)[:, None, None]
    ends = np.where(zoomed, centre + 1.03 * (o.ends - centre), o.ends)
    solution = fitted(replace(noisy, outlines=replace(o, ends=ends)), PINHOLE)
    (note,) = [note for note in solution.notes if "focal length" in note]
    assert note.startswith("The focal length of view c2 does not agree with the other views")
    found = float(note.partition("it differs by ")[2].partition(" +-")[0])
    assert found == pytest.approx(3.0, abs=1.2)
    assert [wrong.view for wrong in solution.camera_doubts] == ["c2"]


def test_one_edge_on_a_reflection_says_nothing_of_a_camera() -> None:
    posterior = irregular_hexapod(6).noisy(0).fit().posterior
    problem, linear = posterior.problem, linearize(posterior.problem, posterior.state)
    o, outlines = problem.outlines, linear["outlines"]
    by_zoom = CameraResiduals(linear).zoomed(1)["outlines"]
    one = np.argmax(np.bincount(o.leg[o.view == 1]))
    is_one = (o.view == 1) & (o.leg == one) & (o.epsilon > 0)

    def named(shown: BoolArray, size: float) -> list[str]:
        rows = dict(linear.rows)
        rows["outlines"] = replace(outlines, r=outlines.r - size * shown[:, None] * by_zoom)
        found = CameraResiduals(replace(linear, rows=rows)).contradicted()
        return [wrong.view for wrong in found]

    assert named(o.view == 1, 0.03) == ["c2"]
    assert named(is_one, 0.3) == []


@pytest.fixture(scope="module")
def right() -> Solution:
    """The fit with the camera that the pictures are of."""
    return irregular_hexapod(12).noisy(0).fit()


@pytest.mark.parametrize(
    ("wrong", "start", "words"),
    [
        ({"k1": -0.1}, "The distortion of c1", "appears to have been removed"),
        ({"cx": 539.0}, "The principal point of c1", "given (539.0, 380.0) px"),
    ],
)
def test_a_wrong_camera_file_is_noticed_and_what_it_does_is_told(
    right: Solution, wrong: dict[str, float], start: str, words: str
) -> None:
    """As where board and machine are corrected for the lens, or cropped, differently."""
    solution = fitted(irregular_hexapod(12).noisy(0), with_intrinsics(PINHOLE, wrong))
    (note,) = (note for note in solution.notes if "does not agree" in note)
    assert note.startswith(start)
    assert words in note
    assert [wrong.view for wrong in solution.camera_doubts] == ["c1"]
    assert not [note for note in right.notes if "does not agree" in note]
    assert right.camera_doubts == ()
    names = right.kinematic.parametrization.names
    off = solution.estimates.vector(names) - right.estimates.vector(names)
    moved = solution.sensitivities[FITTED_CAMERA][:, 0]
    assert np.linalg.norm(off + moved) < 0.5 * np.linalg.norm(off)  # it says where the truth is


def state_covariance(folder: Path, seen: float = 1.0) -> Path:
    """Write a covariance of fx, fy and k3 into the camera file of a dataset; return the folder.

    Boards were seen in the left part of the image, *seen* of its width.
    """
    (path,) = set(load_dataset(folder).camera_paths)
    camera = read_camera(path)
    rows = [[9.0, 8.5, 0.0], [8.5, 9.0, 0.0], [0.0, 0.0, 0.0]]
    right, bottom = seen * camera.width, camera.height
    covered = [[-1.0, -1.0], [right, -1.0], [right, bottom], [-1.0, bottom]]
    block = {
        "version": 1,
        "sigma": {"fx": 3.0},
        "names": ["fy", "fx", "k3"],
        "covariance": rows,
        "covered": covered,
    }
    keyed(path.name, legcal_camera=block)(path.parent)
    return folder


def test_a_camera_file_with_a_covariance_is_used_from_calibration_to_check(tmp_path: Path) -> None:
    folder = simulated(tmp_path / "set", "3-rpr", poses=5).folder
    found = calibrate(state_covariance(folder), output=tmp_path / "out")
    assert not any("exact" in note or "no board" in note for note in found.notes)
    document = Result.read(tmp_path / "out/result.json")
    assert {p.name: p.prior_sigma for p in document.parameters if p.prior_sigma} == {
        "c1.fx": 3.0,
        "c1.fy": 3.0,
    }
    names = [p.name for p in document.parameters if p.status == "estimated"]
    at = [names.index("c1.fx"), names.index("c1.fy")]
    earlier = np.array(document.covariance)[np.ix_(at, at)]
    new = simulated(tmp_path / "new", "3-rpr", poses=4).folder
    tested = check(new, tmp_path / "out")  # the camera is known by the earlier result
    assert not tested.movement.moved
    prior = tested.solution.posterior.problem.block("cameras").prior
    assert prior.mean.tolist() == [p.value for p in document.parameters if p.prior_sigma]
    whitened = prior.whitened(np.eye(2))
    np.testing.assert_allclose(np.linalg.inv(whitened.T @ whitened), earlier, rtol=1e-6)


def test_outlines_where_no_board_was_seen_are_noted(tmp_path: Path) -> None:
    folder = simulated(tmp_path / "set", "3-rpr", poses=5).folder
    found = calibrate(state_covariance(folder, seen=0.5))
    (note,) = [note for note in found.notes if "no board" in note]
    (share,) = re.findall(r"^Up to (\d\d) % of the outlines of views? c1", note)
    o, m = found.solution.outlines, found.dataset.measurements
    is_beyond = np.linspace(o.ends[:, 0, 0], o.ends[:, 1, 0], 100) > 0.5 * m.views[0].camera.width
    of_views = [is_beyond[:, o.used & (m.view[o.row] == v)].mean() for v in (0, 1)]
    assert float(share) == pytest.approx(100.0 * max(of_views), abs=1.5)
    assert np.ptp(of_views) > 0.1
