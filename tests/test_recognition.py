"""Cameras and legs from bars of known geometry: right, or refused, never guessed."""

from typing import ClassVar

import cv2
import numpy as np
import pytest
from numpy.random import Generator
from scipy.spatial.transform import RigidTransform, Rotation

from legcal import load_mechanism
from legcal.data.measurements import Measurements, View
from legcal.geometry.types import Array, Image
from legcal.machine import Machine, forward_kinematics
from legcal.perception import recognition as recognising
from legcal.perception.camera_search import Candidates, place_camera, place_near
from legcal.perception.lines import EdgePairs, EdgeSegments, find_edge_pairs, find_segments
from legcal.perception.pair_matching import (
    LegSegments,
    Picture,
    Poses,
    gauss_newton_step,
    leg_segments,
    match_pairs,
)
from legcal.perception.placement import Placement, Search
from legcal.perception.pose_hypotheses import pose_hypotheses
from legcal.perception.recognition import recognise
from legcal.vision.camera import Camera
from legcal.vision.cylinder import outlines_of_axis

PIXEL = 2.0 / 1000.0
CORNERS = np.array([[-0.52, -0.4], [0.52, 0.4]])
CAMERA = Camera(np.array([[500.0, 0.0, 260.0], [0.0, 500.0, 200.0], [0.0, 0.0, 1.0]]), 520, 400)


@pytest.fixture(scope="module")
def hexapod() -> Machine:
    return load_mechanism("hexapod")


def looking_at(place: Array, target: Array, roll: float) -> RigidTransform:
    """Return T_base_camera of a camera that looks at a point."""
    z = (target - place) / np.linalg.norm(target - place)
    x = np.cross(z, [0.0, 0.0, 1.0])
    x /= np.linalg.norm(x)
    R = Rotation.from_matrix(np.stack([x, np.cross(z, x), z], axis=1))
    return RigidTransform.from_components(place, R * Rotation.from_rotvec([0.0, 0.0, roll]))


def bars_of(
    targets: LegSegments, T_base_camera: RigidTransform, rng: Generator, clutter: int
) -> EdgePairs:
    """Return the bars that an ideal picture shows, with half a pixel of noise, and others."""
    X = T_base_camera.inv().apply(targets.ends.reshape(-1, 3)).reshape(-1, 2, 3)
    xy = X[..., :2] / X[..., 2:]
    along = xy[:, 1] - xy[:, 0]
    length = np.linalg.norm(along, axis=1)
    along /= length[:, None]
    normal = np.stack([-along[:, 1], along[:, 0]], axis=1)
    u = X[:, 1] - X[:, 0]
    u /= np.linalg.norm(u, axis=1, keepdims=True)
    h = outlines_of_axis(u, X[:, 0], targets.radius)  # (n, 2, 3)
    rays = np.concatenate([xy, np.ones((*xy.shape[:2], 1))], axis=-1)
    offset = (
        -np.einsum("nei,nki->nke", h, rays) / np.einsum("nex,nx->ne", h[..., :2], normal)[:, None]
    )
    width = np.abs(offset[..., 1] - offset[..., 0])
    noise = 0.25 * PIXEL
    n = clutter
    angle = rng.uniform(0.0, np.pi, n)
    bars = EdgePairs(
        np.concatenate([xy.mean(axis=1), rng.uniform(CORNERS[0], CORNERS[1], (n, 2))]),
        np.concatenate([along, np.stack([np.cos(angle), np.sin(angle)], axis=1)]),
        np.concatenate([0.45 * length, rng.uniform(0.03, 0.2, n)]),
        np.concatenate([width, np.tile(rng.uniform(0.01, 0.06, (n, 1)), 2)]),
        np.concatenate([length, rng.uniform(0.03, 0.4, n)]),
        PIXEL,
    )
    moved = bars.middle + noise * rng.standard_normal(bars.middle.shape)
    bars = EdgePairs(moved, bars.along, bars.half_length, bars.width, bars.merit, PIXEL)
    return bars.take(np.argsort(-bars.merit, kind="stable"))


def pictures_of(
    machine: Machine,
    T_base_camera: RigidTransform,
    readings: Array,
    rng: Generator,
    clutter: int = 10,
    hidden: int = 0,
) -> list[Picture]:
    """Return what pictures at some readings show, some of the legs being hidden in each."""
    cylinders = [leg.cylinders for leg in machine.legs]
    n_legs = len(machine.legs)
    found = []
    for q in readings:
        B = forward_kinematics(machine, q).apply(machine.B_platform)
        seen = np.sort(rng.permutation(n_legs)[: n_legs - hidden])
        shown = leg_segments(machine.A_base, B, cylinders, seen)
        every = leg_segments(machine.A_base, B, cylinders, np.arange(n_legs))
        found.append(Picture(bars_of(shown, T_base_camera, rng, clutter), every, CORNERS))
    return found


def readings_of(machine: Machine, n: int, rng: Generator) -> Array:
    """Return readings all over the travel."""
    travel = np.array([leg.travel for leg in machine.legs if leg.prismatic])
    return np.asarray(
        rng.uniform(0.2, 0.8, (n, len(travel))) * np.ptp(travel, axis=1) + travel[:, 0]
    )


def apart(placed: Candidates, T_base_camera: RigidTransform) -> tuple[float, float]:
    """Return how far the first pose is from the true one: part of the distance, angle [deg]."""
    off = T_base_camera.inv() * placed.pose()
    distance = float(np.linalg.norm(T_base_camera.translation))
    angle = float(np.degrees(off.rotation.magnitude()))
    return float(np.linalg.norm(off.translation)) / distance, angle


CENTRE = np.array([0.0, 0.0, 0.18])


@pytest.mark.parametrize(("seed", "hidden"), [(0, 0), (1, 3), (2, 2), (3, 1)])
def test_a_camera_is_placed_at_any_roll_in_clutter_with_legs_hidden(
    hexapod: Machine, seed: int, hidden: int
) -> None:
    rng = np.random.default_rng(seed)
    turn = rng.uniform(0.0, 2.0 * np.pi)
    place = np.array([1.0 * np.cos(turn), 1.0 * np.sin(turn), rng.uniform(0.1, 0.6)])
    T = looking_at(place, CENTRE, rng.uniform(-np.pi, np.pi))
    pictures = pictures_of(hexapod, T, readings_of(hexapod, 5, rng), rng, 12, hidden)
    placed = place_camera(pictures, 6)
    assert placed.is_convincing
    distance, angle = apart(placed, T)
    assert distance < 0.03
    assert angle < 2.0


def test_a_model_a_centimetre_off_is_recognised_all_the_same(hexapod: Machine) -> None:
    rng = np.random.default_rng(5)
    T = looking_at(np.array([0.7, -0.8, 0.3]), CENTRE, 0.3)
    pictures = pictures_of(hexapod, T, readings_of(hexapod, 6, rng), rng)
    leg = pictures[0].targets.leg
    error = rng.uniform(-0.01, 0.01, (6, 2, 3))
    moved = [
        Picture(
            p.pairs, LegSegments(leg, p.targets.ends + error[leg], *_rest(p.targets)), p.corners
        )
        for p in pictures
    ]
    placed = place_camera(moved, 6)
    assert placed.is_convincing
    distance, angle = apart(placed, T)
    assert distance < 0.06
    assert angle < 4.0


def _rest(targets: LegSegments) -> tuple[Array, Array, Array]:
    return targets.place, targets.radius, targets.share


def test_symmetric_readings_are_ambiguous_and_other_readings_or_a_rough_pose_decide(
    hexapod: Machine,
) -> None:
    rng = np.random.default_rng(7)
    T = looking_at(np.array([0.9, 0.2, 0.4]), CENTRE, 0.1)
    travel = np.array([leg.travel for leg in hexapod.legs])
    level = np.outer([0.2, 0.5, 0.8], np.ptp(travel, axis=1)) + travel[:, 0]
    pictures = pictures_of(hexapod, T, level, rng, clutter=4)
    placed = place_camera(pictures, 6)
    assert placed.is_enough
    assert not placed.is_convincing
    near = place_near(pictures, T, 6)
    assert near.is_convincing
    assert apart(near, T)[1] < 2.0
    more = pictures_of(hexapod, T, readings_of(hexapod, 3, rng), rng, clutter=4)
    decided = place_camera([*pictures, *more], 6)
    assert decided.is_convincing
    assert apart(decided, T)[1] < 2.0


def test_bars_of_nothing_place_no_camera(hexapod: Machine) -> None:
    rng = np.random.default_rng(3)
    T = looking_at(np.array([0.9, 0.2, 0.4]), CENTRE, 0.0)
    pictures = pictures_of(hexapod, T, readings_of(hexapod, 4, rng), rng, clutter=25, hidden=6)
    assert not place_camera(pictures, 6).is_convincing


def test_starts_lay_legs_on_bars(hexapod: Machine) -> None:
    rng = np.random.default_rng(4)
    T = looking_at(np.array([0.8, 0.6, 0.3]), CENTRE, 1.0)
    picture = pictures_of(hexapod, T, readings_of(hexapod, 1, rng), rng, clutter=0)[0]
    starts = pose_hypotheses(picture, 6)
    assert np.allclose(starts.R @ starts.R.swapaxes(1, 2), np.eye(3), atol=1e-9)
    assert np.all(np.linalg.det(starts.R) > 0.0)
    cosine = 0.5 * (np.einsum("nij,ij->n", starts.R, T.inv().rotation.as_matrix()) - 1.0)
    assert np.degrees(np.arccos(np.clip(cosine.max(), -1.0, 1.0))) < 15.0


def test_steps_end_at_the_true_pose_and_shifts_are_found(hexapod: Machine) -> None:
    rng = np.random.default_rng(8)
    T = looking_at(np.array([0.8, -0.5, 0.3]), CENTRE, 0.0)
    pictures = pictures_of(hexapod, T, readings_of(hexapod, 3, rng), rng, clutter=0)
    start = T * RigidTransform.from_rotation(Rotation.from_rotvec([0.01, -0.01, 0.02]))
    inverse = start.inv()
    poses = Poses.rigid(inverse.rotation.as_matrix()[None], inverse.translation[None], 6)
    values = []
    for _ in range(8):
        found = [match_pairs(picture, poses, 0.05) for picture in pictures]
        values.append(sum(float(one.score.sum()) for one in found))
        poses = gauss_newton_step(pictures, poses, found, 0.05)
    off = (
        T.inv() * RigidTransform.from_components(poses.t[0], Rotation.from_matrix(poses.R[0])).inv()
    )
    assert values[-1] > values[0]
    assert np.degrees(off.rotation.magnitude()) < 0.3


def test_a_bright_bar_gives_two_edges_and_one_bar() -> None:
    camera = Camera(np.array([[500.0, 0.0, 160.0], [0.0, 500.0, 120.0], [0.0, 0.0, 1.0]]), 320, 240)
    y, x = np.mgrid[0:240, 0:320]
    across = (x - 160.0) * np.cos(0.3) + (y - 120.0) * np.sin(0.3)
    along = -(x - 160.0) * np.sin(0.3) + (y - 120.0) * np.cos(0.3)
    grey = np.where((np.abs(across) < 10.0) & (np.abs(along) < 90.0), 180.0, 40.0)
    lens = cv2.GaussianBlur(grey.astype(np.float32), (0, 0), 0.6)
    segments = find_segments(np.asarray(lens, dtype=np.float32), camera)
    middle = segments.ends.mean(axis=1)
    direction = segments.ends[:, 1] - segments.ends[:, 0]
    bright = np.stack([direction[:, 1], -direction[:, 0]], axis=1)
    long = np.linalg.norm(direction, axis=1) > 150.0 / 500.0
    assert np.count_nonzero(long) == 2
    assert np.all(np.sum(bright * middle, axis=1)[long] < 0.0)  # towards the middle of the bar
    bars = find_edge_pairs(segments)
    assert bars.width[0] * 500.0 == pytest.approx(20.0, abs=1.0)
    assert np.abs(bars.along[0] @ [-np.sin(0.3), np.cos(0.3)]) > 0.9999


def test_an_empty_picture_has_neither_edges_nor_bars() -> None:
    camera = Camera(np.array([[500.0, 0.0, 160.0], [0.0, 500.0, 120.0], [0.0, 0.0, 1.0]]), 320, 240)
    segments = find_segments(np.zeros((240, 320), dtype=np.float32), camera)
    assert len(segments) == 0
    assert len(find_edge_pairs(EdgeSegments(segments.ends, segments.covered, segments.pixel))) == 0


class _Known(Search):
    """A search whose pictures are made already."""

    made: ClassVar[list[Picture]] = []

    def picture(self, row: int) -> Picture:
        return self.made[row]


def _recognised(
    machine: Machine, pictures: list[Picture], hint: RigidTransform | None
) -> Placement:
    """Return what is recognised in the pictures of one view by bars alone: there are no images."""
    n, n_legs = len(pictures), machine.n_legs
    rows, names = np.arange(n), tuple(f"{k}.png" for k in range(n))
    measurements = Measurements(
        (View("c1", CAMERA),), names, np.zeros(n, dtype=np.intp), rows, np.zeros((n, n_legs)), 1e-6
    )
    nowhere, cylinders = np.zeros((n, n_legs, 3)), [leg.cylinders for leg in machine.legs]
    wanted = np.ones((1, n_legs), dtype=np.bool_)
    search = _Known(_no_image, measurements, nowhere, nowhere, cylinders, wanted, machine.leg_names)
    _Known.made[:] = pictures
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(
            recognising, "_decided_by_outlines", lambda s, groups, placed, p, g: placed[g]
        )
        return recognise(search, rows, [hint])


def _no_image(row: int) -> Image:
    raise AssertionError(row)


@pytest.mark.parametrize("hidden", [2, 3])
def test_many_images_with_a_rough_pose_and_hidden_legs_are_placed(
    hexapod: Machine, hidden: int
) -> None:
    rng = np.random.default_rng(hidden)
    T = looking_at(np.array([0.8, -0.5, 0.35]), CENTRE, 0.4)
    pictures = pictures_of(hexapod, T, readings_of(hexapod, 15, rng), rng, 10, hidden)
    found = _recognised(hexapod, pictures, T).T_base_camera[0]
    assert found is not None
    assert np.degrees((T.inv() * found).rotation.magnitude()) < 2.0


@pytest.mark.parametrize("spread", [0.05, 0.1])
def test_a_rough_pose_turned_by_a_symmetry_of_the_machine_is_not_believed(
    hexapod: Machine, spread: float
) -> None:
    rng = np.random.default_rng(1)
    T = looking_at(np.array([0.9, 0.3, 0.35]), CENTRE, 0.2)
    travel = np.array([leg.travel for leg in hexapod.legs])
    share = 0.5 + spread * rng.uniform(-1.0, 1.0, (3, 6))
    pictures = pictures_of(hexapod, T, travel[:, 0] + share * np.ptp(travel, axis=1), rng, 10, 0)
    turned = RigidTransform.from_rotation(Rotation.from_euler("z", 120.0, degrees=True)) * T
    found = _recognised(hexapod, pictures, turned).T_base_camera[0]
    assert found is not None
    assert np.degrees((T.inv() * found).rotation.magnitude()) < 2.0
