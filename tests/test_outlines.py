"""Outlines measured in rendered scenes where they are known exactly, and what is rejected."""

from dataclasses import replace
from typing import Any

import cv2
import numpy as np
import pytest
from rendering import Bar, Light, render
from scipy.spatial.transform import RigidTransform, Rotation

from legcal.data.measurements import Measurements, View
from legcal.data.outlines import Outlines
from legcal.data.reasons import Reason, Rejection
from legcal.geometry.types import Array, Image
from legcal.machine.leg import Cylinder
from legcal.machine.shapes import Carrier, Occluder
from legcal.perception import outline
from legcal.perception.outline import LONE_SCORE, ImageSearch, _alone, measure, measure_outlines
from legcal.perception.placement import Placement, Search
from legcal.vision.camera import Camera
from legcal.vision.cylinder import EPSILON, outlines_of_axis
from legcal.vision.visibility import END_COVER, visible_segments

IDENTITY = RigidTransform.identity()
F = 700.0


def camera(distortion: Array | None = None) -> Camera:
    K = np.array([[F, 0.0, 181.3], [0.0, 1.01 * F, 133.1], [0.0, 0.0, 1.0]])
    return Camera(K, 360, 270, np.zeros(0) if distortion is None else distortion)


def bar(x: float, lean: float, albedo: float, radius: float = 0.011, depth: float = 0.8) -> Bar:
    A, B = np.array([x - lean, 0.16, depth]), np.array([x + lean, -0.16, depth + 0.04])
    return Bar(A, B, radius, albedo)


def detect(cam: Camera, bars: list[Bar], image: Image, **options: Any) -> Outlines:
    """Detect bars whose predicted joints are ``off`` metres wrong in every coordinate."""
    return detect_with_blur(cam, bars, image, **options)[0]


def detect_with_blur(
    cam: Camera,
    bars: list[Bar],
    image: Image,
    off: float = 2e-3,
    known: tuple[float, ...] = (),
    solids: tuple[Occluder, ...] = (),
) -> tuple[Outlines, float]:
    """Return the blur of the image as well; that of the view may be known [px]."""
    rng = np.random.default_rng(0)
    A = np.array([b.A for b in bars])[None] + off * rng.choice([-1.0, 1.0], (1, len(bars), 3))
    B = np.array([b.B for b in bars])[None] + off * rng.choice([-1.0, 1.0], (1, len(bars), 3))
    names = [f"leg{i + 1}" for i in range(len(bars))]
    wanted, one, q = np.ones((1, len(bars)), dtype=np.bool_), np.zeros(1, dtype=np.intp), A[..., 0]
    one_view = Measurements((View("c1", cam),), ("a.png",), one, one, q, np.full(len(bars), 1e-6))
    lengths = [float(np.linalg.norm(b.B - b.A)) for b in bars]
    cylinders = [
        (Cylinder("rod", b.radius, "base", 0.0, length),)
        for b, length in zip(bars, lengths, strict=True)
    ]
    size = float(np.linalg.norm(B - A, axis=2).mean())
    grey = image.astype(np.float32)
    search = Search(lambda row: grey, one_view, A, B, cylinders, wanted, names, size)
    search = replace(search, occluders=solids)
    found, blur = measure_outlines(search, Placement(A, B, (IDENTITY,), blur=known), [0])
    return found, float(blur[0])


def errors(cam: Camera, bars: list[Bar], found: Outlines) -> Array:
    """Return the errors at both ends of each used outline, positive to the inside (n, 2) [px]."""
    rows = np.flatnonzero(found.used)
    error = np.empty((len(rows), 2))
    for k, i in enumerate(rows):
        b = bars[found.leg[i]]
        u = (b.B - b.A) / np.linalg.norm(b.B - b.A)
        h = outlines_of_axis(u, b.A, b.radius)[found.edge[i] - 1]
        offset = cam.line_offset(h[None], cam.undistort(found.ends[i]))
        error[k] = EPSILON[found.edge[i] - 1] * offset
    return error


def backdrop(level: float) -> Array:
    """Return a background with a slope and soft texture."""
    texture = cv2.GaussianBlur(np.random.default_rng(7).standard_normal((270, 360)), (0, 0), 6.0)
    return np.asarray(level + 0.05 * np.arange(360.0) + 20.0 * texture)


SCENES = {
    "bright on dark": (backdrop(20.0), 170.0, Light(), 0.5),
    "dark on bright": (backdrop(200.0), 40.0, Light(), 0.8),
    "bright on one side, dark on the other": (
        backdrop(90.0),
        170.0,
        Light(direction=(0.95, 0.0, -0.3), ambient=0.1, diffuse=0.9),
        0.5,
    ),
    "a highlight along the leg": (backdrop(30.0), 110.0, Light(gloss=0.6), 0.4),
    "blurred": (backdrop(30.0), 140.0, Light(), 1.2),
}


@pytest.mark.parametrize("name", SCENES)
def test_outlines_are_found_where_they_are(name: str) -> None:
    background, albedo, light, blur = SCENES[name]
    cam = camera()
    bars = [bar(-0.09, 0.03, albedo), bar(0.08, -0.05, albedo)]
    image = render(cam, bars, background, light, blur=blur, noise=2.0, supersample=3)
    found = detect(cam, bars, np.rint(image).astype(np.uint8))
    assert np.all(found.used), found.reason
    error = errors(cam, bars, found)
    assert np.abs(error).max() < (0.2 if blur < 1.0 else 0.4)
    assert np.median(np.abs(error)) < (0.08 if blur < 1.0 else 0.15)
    assert abs(float(error.mean())) < (
        0.05 if blur < 1.0 else 0.15
    )  # signed: half a pixel somewhere would show
    sigma = np.sqrt([np.diag(c) for c in found.covariance])
    assert np.sqrt(np.mean((error / sigma) ** 2)) < 2.0
    if name == "bright on dark":  # near a fit, with the blur of other images
        found, seen = detect_with_blur(
            cam, bars, np.rint(image).astype(np.uint8), off=2e-4, known=(0.45,)
        )
        assert np.all(found.used), found.reason
        error = errors(cam, bars, found)
        assert np.abs(error).max() < 0.2
        assert np.median(np.abs(error)) < 0.08
        assert seen == pytest.approx(np.hypot(blur, 0.29), rel=0.25)  # with that of the pixels


@pytest.mark.parametrize("name", ["before half of it", "behind it", "along it", "at an angle"])
def test_a_solid_hides_and_its_edges_are_not_taken_for_outlines(name: str) -> None:
    cam, rod = camera(), bar(-0.09, 0.03, 170.0)
    behind, bars = SCENES["bright on dark"][0], [rod]
    image = np.rint(render(cam, bars, behind, Light(), blur=0.5, noise=2.0, supersample=3))
    turn = Rotation.align_vectors([rod.B - rod.A], [[0.0, 0.0, 1.0]])[0].as_matrix()
    middle, half = 0.5 * (rod.A + rod.B), np.array([0.02, 0.02, 0.25])
    aside = np.array([0.037, 0.0, 0.02])  # one edge is less than 5 px from an outline
    if name == "before half of it":
        half, middle = np.array([0.05, 0.02, 0.08]), middle - [0.0, 0.0, 0.2]
        middle = middle - 0.08 * turn[:, 2]
    elif name == "behind it":
        middle = middle + np.array([0.0, 0.0, 0.2])
        half[0] = 0.2
    else:
        middle = middle + aside
        if name == "at an angle":
            turn = turn @ Rotation.from_rotvec([0.0, 0.3, 0.0]).as_matrix()
    corners = np.stack(np.meshgrid(*[(-1.0, 1.0)] * 3), axis=-1).reshape(-1, 3) * half
    solid = Occluder("box", Carrier(), corners @ turn.T + middle)
    found = detect(cam, bars, image.astype(np.uint8), solids=(solid,))
    if name == "along it":
        assert set(found.reason) == {Rejection(Reason.HIDDEN, "box")}
        return
    assert np.all(found.used), found.reason
    assert np.abs(errors(cam, bars, found)).max() < 0.2
    length = np.linalg.norm(found.ends[:, 1] - found.ends[:, 0], axis=1)
    whole = detect(cam, bars, image.astype(np.uint8))
    share = length / np.linalg.norm(whole.ends[:, 1] - whole.ends[:, 0], axis=1)
    assert np.all(share < 0.6) if name == "before half of it" else np.all(share == 1.0)


def test_a_saturated_background_moves_no_outline() -> None:
    cam = camera()
    bars = [bar(-0.05, 0.02, 60.0), bar(0.06, 0.02, 60.0)]
    behind = np.full((270, 360), 120.0)
    behind[:, 181:] = 300.0  # behind the second leg
    image = render(cam, bars, behind, blur=1.0, noise=1.0, supersample=3)
    clipped = np.clip(np.rint(image), 0.0, 255.0).astype(np.uint8)
    found, seen = detect_with_blur(cam, bars, clipped, off=1e-3)
    assert np.all(found.used), found.reason
    error = errors(cam, bars, found)
    sigma = np.sqrt([np.diag(c) for c in found.covariance])
    assert np.abs(error).max() < 0.15
    assert np.sqrt(np.mean((error / sigma) ** 2)) < 1.5
    assert seen == pytest.approx(np.hypot(1.0, 0.29), rel=0.15)  # with that of the pixels


def test_outlines_are_rejected_where_saturation_leaves_nothing_of_the_step() -> None:
    cam = camera()
    bars = [bar(-0.05, 0.02, 60.0), bar(0.06, 0.02, 60.0)]
    image = render(cam, bars, 800.0, blur=0.5, noise=1.0, supersample=3)
    clipped = np.clip(np.rint(image), 0.0, 255.0).astype(np.uint8)
    found = detect(cam, bars, clipped, off=1e-3)
    assert not np.any(found.used), errors(cam, bars, found)
    assert found.rejected_for(Reason.OVEREXPOSED).any(), found.reason


def test_an_edge_stands_alone_where_the_other_side_is_as_dark_as_the_background() -> None:
    cam = camera()
    light = Light(direction=(1.0, 0.0, -0.3), ambient=0.1, diffuse=0.9)
    bars = [bar(-0.09, 0.03, 170.0, 0.015), bar(0.08, -0.05, 170.0, 0.015)]
    image = render(cam, bars, 17.0, light, blur=0.6, noise=2.0, supersample=3)
    found = detect(cam, bars, np.rint(image).astype(np.uint8))
    np.testing.assert_array_equal(found.used, [True, False, True, False])
    assert np.abs(errors(cam, bars, found)).max() < 0.2
    assert all(found.reason[i] for i in (1, 3))


def test_outlines_are_straight_in_space_and_not_in_the_picture() -> None:
    cam = camera(np.array([-0.3, 0.1, 0.001, -0.002, 0.0]))
    bars = [bar(-0.15, 0.02, 150.0), bar(0.15, -0.02, 150.0, 0.025)]
    image = render(cam, bars, 30.0, blur=0.6, noise=0.3, supersample=3)
    found = detect(cam, bars, image)
    assert np.all(found.used), found.reason
    assert np.abs(errors(cam, bars, found)).max() < 0.15
    sigma = np.sqrt([np.diag(C) for C in found.covariance])
    assert sigma.min() > 0.03  # what the model leaves out, however little noise there is


def test_legs_behind_others_end_where_they_are_hidden() -> None:
    cam = camera()
    front, behind = bar(0.0, 0.08, 60.0, depth=0.7), bar(0.0, -0.08, 170.0, depth=0.9)
    image = render(cam, [front, behind], 30.0, blur=0.5, supersample=3)
    found = detect(cam, [front, behind], image.astype(np.uint8))
    assert np.all(found.used), found.reason
    assert np.abs(errors(cam, [front, behind], found)).max() < 0.2
    gap = np.linalg.norm(np.diff(found.ends, axis=1)[:, 0], axis=1) - found.length
    assert np.all(gap > -1.0)
    assert np.all(gap[2:] > 20.0)  # the leg in front hides the middle


def test_a_leg_right_before_the_camera_is_not_searched_all_over_the_image(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """A camera that stands nowhere puts joints there; the votes of such a window fill a memory."""
    windows = list[Array]()

    def asked(search: ImageSearch, *, in_brief: bool) -> tuple[Outlines, float]:
        windows.append(search.window)
        return measure(search, in_brief=in_brief)

    monkeypatch.setattr(outline, "measure", asked)
    cam, seen = camera(), bar(0.0, 0.03, 150.0)
    near = Bar(np.array([0.03, 0.06, 1e-4]), np.array([0.12, -0.1, 0.9]), 0.006, 150.0)
    image = render(cam, [seen], 40.0, blur=0.5, supersample=3).astype(np.uint8)
    found = detect(cam, [seen, near], image)
    assert found.used.tolist() == [True, True, False, False]
    assert windows[0].max() <= 0.05 * cam.width


def test_what_is_not_there_is_rejected_with_the_reason() -> None:
    cam = camera()
    bars = [bar(0.0, 0.03, 150.0), bar(0.9, 0.0, 150.0)]
    image = render(cam, bars[:1], 40.0, blur=0.5, supersample=3).astype(np.uint8)
    found = detect(cam, bars, image)
    assert found.reason[2:] == (Rejection(Reason.OUTSIDE),) * 2
    empty = detect(cam, bars[:1], np.full_like(image, 90))
    assert set(empty.reason) == {Rejection(Reason.NO_PAIR)}
    noise = np.random.default_rng(0).integers(80, 100, image.shape).astype(np.uint8)
    assert not np.any(detect(cam, bars[:1], noise).used)


def test_a_mirrored_image_shows_mirrored_outlines_at_its_border_too() -> None:
    """What lies beyond a border is not seen, on the right as on the left."""
    cam = camera()
    K = cam.K.copy()
    K[0, 2] = cam.width - 1.0 - K[0, 2]
    other, across = replace(cam, K=K), np.array([-1.0, 1.0, 1.0])
    b = bar(0.2, 0.0, 150.0)
    mirrored = Bar(across * b.A, across * b.B, b.radius, b.albedo)
    image = np.rint(render(cam, [b], 30.0, blur=0.5, supersample=2)).astype(np.uint8)
    found = detect(cam, [b], image, off=0.0)
    again = detect(other, [mirrored], image[:, ::-1].copy(), off=0.0)
    assert found.reason == again.reason[::-1]
    np.testing.assert_array_equal(found.used, [False, True])


def test_an_edge_stands_alone_only_without_a_rival() -> None:
    near, far = np.array([[0.0, 0.5], [1.0, 1.5]]), np.array([[0.0, 0.5], [9.0, 8.0]])
    cases = (
        (far, [0.8, 0.3], True),
        (far, [0.8, 0.7], False),
        (near, [0.8, 0.7], True),  # two lines on one edge
        (far, [0.4, 0.1], False),
        (0.0 * far, [0.0, 0.0], False),  # no line at all
    )
    shift, score, expected = (np.array(x) for x in zip(*cases, strict=True))
    # As the edges of parts, each beside another one of them.
    other = np.roll(np.arange(len(cases)), 1)
    both = np.stack([np.arange(len(cases)), other], axis=1)
    least = np.full(len(cases), LONE_SCORE)
    np.testing.assert_array_equal(_alone(shift[both], score[both], least), expected[both])


TUBE, ROD = (
    Cylinder("tube", 0.012, "base", 0.0, 0.25),
    Cylinder("rod", 0.008, "platform", -0.3, 0.0),
)
LONG_ROD = Cylinder("rod", 0.008, "base", 0.0, 0.4)


@pytest.mark.parametrize(
    ("cylinders", "length", "expected"),
    [  # of the links: start and end in the radius that covers each, and metres
        ([TUBE, ROD], 0.4, [("tube", 0.012, 0.0, 0.25), ("rod", 0.012, 0.25, 0.4)]),
        ([TUBE, replace(ROD, start=-0.1)], 0.26, [("tube", 0.012, 0.0, 0.25)]),
        (
            [LONG_ROD, Cylinder("collar", 0.02, "base", 0.1, 0.12)],
            0.4,
            [("rod", 0.02, 0.12, 0.4), None],
        ),
        ([LONG_ROD, Cylinder("rod", 0.02, "base", 0.1, 0.16)], 0.4, [("rod", 0.02, 0.16, 0.4)]),
    ],
    ids=["tube and rod", "rod inside", "collar", "collar of the link"],
)
def test_of_overlapping_cylinders_the_thicker_one_is_seen(
    cylinders: list[Cylinder],
    length: float,
    expected: list[tuple[str, float, float, float] | None],
) -> None:
    segments = visible_segments(cylinders, length)
    assert segments == visible_segments(cylinders[::-1], length)
    named = {segment.link: segment for segment in segments}
    for one in expected:
        if one is None:
            continue
        link, radius, start, end = one
        segment = named[link]
        assert segment.start == pytest.approx(start + END_COVER * radius)
        assert segment.end == pytest.approx(min(end, length - END_COVER * segment.radius))
    if None not in expected:
        assert [segment.link for segment in segments] == [one[0] for one in expected if one]
