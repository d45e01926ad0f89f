"""Photographs: exact outlines, light as it falls, every mechanism, the same bits every time."""

import math
from typing import Any

import cv2
import numpy as np
import pytest
from rendering import photograph
from scipy.spatial.transform import RigidTransform, Rotation
from scipy.special import ndtr

from legcal.errors import UsageError
from legcal.geometry.types import Array
from legcal.simulation.rendering.appearance import CAMERAS, Appearance, Light
from legcal.simulation.rendering.scene import develop, prepare_view
from legcal.simulation.solids import (
    Box,
    Material,
    Mesh,
    PlacedSolid,
    Shape,
    Solid,
    SolidCylinder,
    Sphere,
)
from legcal.vision.camera import Camera
from legcal.vision.cylinder import outlines_of_axis

IDENTITY = RigidTransform.identity()
WIDTH, HEIGHT, F = 320, 240, 400.0
LENSES = {
    "pinhole": Camera(np.array([[F, 0, 157.3], [0, 1.01 * F, 121.8], [0, 0, 1.0]]), WIDTH, HEIGHT),
    "barrel": Camera(
        np.array([[F, 0, 157.3], [0, 1.01 * F, 121.8], [0, 0, 1.0]]),
        WIDTH,
        HEIGHT,
        np.array([-0.25, 0.08, 0.002, -0.001, 0.0]),
    ),
    "fisheye": Camera(
        np.array([[0.6 * F, 0, 157.3], [0, 0.6 * F, 121.8], [0, 0, 1.0]]),
        WIDTH,
        HEIGHT,
        np.array([-0.02, 0.004, 0.0, 0.0]),
        "equidistant",
    ),
}


def solid(shape: Shape, T: RigidTransform, **looks: Any) -> PlacedSolid:
    return PlacedSolid(Solid(None, shape, T, Material(**looks)), T)


def bar(angle: float, radius: float, tilt: float = 0.1) -> tuple[PlacedSolid, Array, Array]:
    """Return a long cylinder at an angle in the image, and its direction and middle."""
    u = np.array(
        [math.cos(tilt) * math.cos(angle), math.cos(tilt) * math.sin(angle), math.sin(tilt)]
    )
    M = np.array([0.013, -0.007, 1.0])
    turn = Rotation.align_vectors([u], [[0.0, 0.0, 1.0]])[0]
    T = RigidTransform.from_components(M, turn)
    return solid(SolidCylinder(radius, 8.0), T, albedo=0.6), u, M


def edge_errors(image: Array, camera: Camera, h: Array, inward: Array) -> Array:
    """Return how far an edge is inside of a line, along it [px], from areas: no edge detector.

    Across the edge the pixels' levels, as parts of the step, add up to the covered length.
    """
    near = -h[:2] * h[2] / (h[:2] @ h[:2])
    along = np.array([-h[1], h[0]]) / np.hypot(h[0], h[1])
    curve = camera.distort(near + np.linspace(-1.2, 1.2, 4001)[:, None] * along)
    middle = np.argmin(np.linalg.norm(curve - [WIDTH / 2, HEIGHT / 2], axis=1))
    direction = curve[middle + 1] - curve[middle - 1]
    steep = abs(direction[1]) > abs(direction[0])  # then measured along rows, else along columns
    picture = image if steep else image.T
    curve = curve if steep else curve[:, ::-1]
    across = float(inward[0] if steep else inward[1])
    order = np.argsort(curve[:, 1])
    rows = np.arange(20, picture.shape[0] - 20)
    expected = np.interp(rows, curve[order, 1], curve[order, 0])
    errors = []
    for row, x in zip(rows, expected, strict=True):
        low, high = round(x) - 5, round(x) + 6
        if low < 1 or high > picture.shape[1] - 1:
            continue
        levels = picture[row, low:high]
        covered = float(np.sum((levels - levels.min()) / (levels.max() - levels.min())))
        errors.append(covered - (high - 0.5 - x if across > 0.0 else x - low + 0.5))
    slope = np.gradient(expected).mean()
    return -np.array(errors) / math.hypot(1.0, slope)


def clean(placed: list[PlacedSolid], **changes: Any) -> Array:
    """Return radiance of solids before a pinhole at the origin, 0 to 1."""
    looks = Appearance.clean(**changes)
    image = photograph(placed, LENSES["pinhole"], IDENTITY, looks, np.random.default_rng(0))
    return np.asarray(image / (2.0**looks.bits - 1.0))


@pytest.mark.parametrize(
    ("lens", "radius"),
    [("barrel", 0.02), ("fisheye", 0.12)],
)
def test_outlines_are_where_the_tangent_planes_are(lens: str, radius: float) -> None:
    camera = LENSES[lens]
    worst = []
    for degrees in range(0, 180, 15):
        placed, u, M = bar(math.radians(degrees) + 1e-3, radius)
        looks = Appearance.clean()
        image = photograph([placed], camera, IDENTITY, looks, np.random.default_rng(0)).astype(
            float
        )
        for h, epsilon in zip(outlines_of_axis(u, M, radius), (1.0, -1.0), strict=True):
            errors = edge_errors(image, camera, h, epsilon * h[:2])
            assert len(errors) > 100
            worst.append(float(errors.mean()))
            assert np.abs(errors - errors.mean()).max() < 0.15
    assert np.abs(worst).max() < 0.01
    assert abs(np.mean(worst)) < 0.002


@pytest.mark.parametrize("turn", [0.0, math.pi])
def test_a_cylinder_seen_along_its_axis_shows_its_near_cap(turn: float) -> None:
    T = RigidTransform.from_components([0.0, 0.0, 1.0], Rotation.from_rotvec([turn, 0.0, 0.0]))
    covered = (clean([solid(SolidCylinder(0.1, 0.2), T, albedo=0.6)]) - 0.02) / 0.58
    near = 0.1 / 0.9  # of the cap, 0.9 m away
    assert covered.sum() == pytest.approx(math.pi * near**2 * F * 1.01 * F, rel=0.01)


def test_a_cylinder_seen_from_the_side_ends_at_both_ends() -> None:
    T = RigidTransform.from_components([0.0, 0.0, 1.0], Rotation.from_euler("y", 0.5 * math.pi))
    shown = clean([solid(SolidCylinder(0.01, 0.2), T, albedo=0.6)]).max(axis=0) > 0.3
    np.testing.assert_allclose(
        np.flatnonzero(shown)[[0, -1]], [157.3 - 40.0, 157.3 + 40.0], atol=1.5
    )


def test_a_mesh_looks_like_the_shape_that_it_is_of() -> None:
    size = (0.3, 0.2, 0.15)
    corners = np.array([[x, y, z] for x in (-0.5, 0.5) for y in (-0.5, 0.5) for z in (-0.5, 0.5)])
    quads = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]
    faces = np.array([f for a, b, c, d in quads for f in ((a, b, c), (a, c, d))])
    T = RigidTransform.from_components([0.02, 0.01, 1.0], Rotation.from_rotvec([0.5, 0.4, 0.3]))
    solids = [
        solid(shape, T, albedo=0.6) for shape in (Box(size), Mesh(np.array(size) * corners, faces))
    ]
    flat = [clean([one]) for one in solids]
    assert np.abs(flat[0] - flat[1]).max() < 0.02  # one or two of the rays that graze an edge
    looks = {"lights": (Light(direction=(0.4, -0.9, -0.5)),), "ambient": 0.1, "specular": 1.0}
    lit = [clean([one], **looks) for one in solids]
    assert np.ptp(lit[0]) > 0.3
    assert np.mean(np.abs(lit[0] - lit[1]) > 2e-3) < 0.01  # at creases alone


def test_light_on_a_wall_falls_with_the_square_of_the_distance_of_its_lamp() -> None:
    wall = solid(Box((3.0, 3.0, 0.02)), RigidTransform.from_translation([0.0, 0.0, 1.51]))
    looks = Appearance.clean(lights=(Light((-0.5, 0.0, -1.0), distance=1.0),), ambient=0.0)
    prepared = prepare_view([wall], LENSES["pinhole"], IDENTITY, looks, np.random.default_rng(0))
    lamp = prepared.painter.light.lamps[0].position
    row = prepared.render([wall], np.random.default_rng(0))[122, 10:310:50].astype(float)
    u = np.arange(10, 310, 50)
    P = 1.5 * np.stack([(u - 157.3) / F, np.zeros(len(u)), np.ones(len(u))], axis=-1)
    expected = (1.5 - lamp[2]) / np.linalg.norm(lamp - P, axis=1) ** 3  # cosine over square
    assert np.ptp(expected) > 0.3 * expected.max()
    assert row / row.max() == pytest.approx(expected / expected.max(), rel=0.01)


def test_the_same_seed_gives_the_same_bits_and_another_one_does_not() -> None:
    ball = solid(Sphere(0.2), RigidTransform.from_translation([0.0, 0.0, 1.0]))
    camera = LENSES["barrel"]

    def picture(scene_seed: int, noise_seed: int) -> Array:
        rng = np.random.default_rng(scene_seed)
        scene = prepare_view([ball], camera, IDENTITY, Appearance(clutter=2, cables=2), rng)
        return np.asarray(scene.render([ball], np.random.default_rng(noise_seed)))

    first = picture(1, 2)
    assert np.array_equal(first, picture(1, 2))
    assert np.mean(first != picture(1, 3)) > 0.2
    assert np.abs(first - picture(3, 2).astype(float)).mean() > 2.0


@pytest.mark.parametrize("level", [0.1, 0.5])
def test_noise_is_that_of_electrons_and_readout(level: float) -> None:
    noise = {"electrons": 2000.0, "read_noise": 20.0, "background": level}
    image = clean([], **noise)
    assert image.mean() == pytest.approx(level, abs=2e-4)
    assert image.std() == pytest.approx(math.sqrt(level / 2000.0 + 0.01**2), rel=0.02)


def test_grey_levels_are_radiance_to_the_power_of_one_over_gamma() -> None:
    placed_bar, _, _ = bar(0.4, 0.05)
    linear, curved = clean([placed_bar]), clean([placed_bar], gamma=2.2)
    assert np.allclose(curved**2.2, linear, atol=1e-4)
    assert np.allclose(clean([placed_bar], bits=8), linear, atol=0.6 / 255.0)
    assert clean([placed_bar], exposure=3.0).max() == 1.0  # saturated


@pytest.mark.parametrize("blur", [0.5, 1.5])
def test_a_lens_blurs_edges_by_a_gaussian_before_pixels_count(blur: float) -> None:
    radius, camera = 0.06, LENSES["pinhole"]
    placed, u, M = bar(1.2, radius)
    share = (clean([placed], blur=blur) - 0.02) / 0.58
    y, x = np.mgrid[8 : HEIGHT - 8, 8 : WIDTH - 8]  # of the blur at borders nothing is known
    xy = camera.undistort(np.stack([x, y], axis=-1).astype(float))
    inside, share = camera.line_offset(outlines_of_axis(u, M, radius)[0], xy), share[y, x]
    near = np.abs(inside) < 4.0
    spread = math.hypot(blur, math.sqrt(1.0 / 12.0))
    assert np.abs(share[near] - ndtr(inside[near] / spread)).max() < 0.02


# What cameras make of the light.

SIDE, DARK, LIGHT = 160, 0.2, 0.8


def slanted_edge(kind: str, **changes: Any) -> tuple[Array, bytes]:
    """Return the photograph of a slanted edge by a kind of camera in grey, and its file."""
    x, y = np.meshgrid(np.arange(SIDE), np.arange(SIDE))
    share = np.clip(edge_place(y) - x + 0.5, 0.0, 1.0)[..., None]
    radiance = np.repeat(DARK + (LIGHT - DARK) * share, 3, axis=2).astype(np.float32)
    look: dict[str, Any] = {"blur": 0.7, "electrons": 30_000.0, "bits": 8, "colour": True}
    appearance = Appearance.clean(camera=kind, **(look | changes))
    if not appearance.colour:
        radiance = np.ascontiguousarray(radiance[..., 0])
    image = develop(radiance, appearance, np.random.default_rng(3))
    file = appearance.pipeline.file(image)
    written = cv2.imdecode(np.frombuffer(file, np.uint8), cv2.IMREAD_COLOR)
    assert written is not None
    return written.astype(np.float64) @ [0.114, 0.587, 0.299], file


def edge_place(y: Any) -> Array:
    """Return where the edge is in rows of the image [px]."""
    return np.asarray(0.5 * (SIDE - 1) + 0.1 * (y - 0.5 * (SIDE - 1)))


@pytest.mark.parametrize("kind", CAMERAS)
@pytest.mark.parametrize("colour", [True, False])
def test_cameras_leave_edges_where_they_are(kind: str, colour: bool) -> None:
    grey, _ = slanted_edge(kind, colour=colour)
    rows = np.arange(30, SIDE - 30)
    places = []
    for y in rows.tolist():
        near = slice(int(edge_place(y)) - 8, int(edge_place(y)) + 9)
        level = grey[y, near]
        middle = 0.5 * (level[:3].mean() + level[-3:].mean())
        k = int(np.flatnonzero(level >= middle)[-1])
        places.append(near.start + k + (level[k] - middle) / (level[k] - level[k + 1]))
    assert np.mean(places - edge_place(rows)) == pytest.approx(0.0, abs=0.05)


@pytest.mark.parametrize(
    "wrong",
    [
        {"camera": "webcm"},
        {"camera": "phone", "bits": 16},
        {"jpeg": 101},
        {"read_noise": -1.0},
        {"gamma": 0.0},
        {"blur": math.nan},
        {"exposure": math.inf},
        {"limb": 1.5},
        {"samples": 20},
        {"lights": (Light((0.0, 0.0, 0.0)),)},
        {"lights": (Light((0.0, 0.0, 1.0), distance=0.0),)},
        {"lights": (Light((0.0, 0.0, 1.0), strength=-1.0),)},
    ],
)
def test_looks_that_make_no_sense_are_refused(wrong: dict[str, Any]) -> None:
    with pytest.raises(UsageError, match=r"found .*, needed .*;"):
        Appearance(**wrong)
