"""Outlines by Canny's edge points and least squares, as the paper found them."""

import cv2
import numpy as np
import pytest
from rendering import Bar, Light, render
from scipy.spatial.transform import RigidTransform

from legcal.calibration.measurement_noise.canny import canny_parts, edge_points
from legcal.data.measurements import Measurements, View
from legcal.data.outlines import Outlines
from legcal.geometry.types import Array
from legcal.machine import Cylinder
from legcal.perception.detection import measure_outlines
from legcal.perception.placement import Placement, Search
from legcal.vision.camera import Camera
from legcal.vision.cylinder import EPSILON, outlines_of_axis

FLAT = Light(ambient=1.0, diffuse=0.0)
LENS = np.array([-0.3, 0.1, 0.001, -0.002, 0.0])


def camera(distortion: Array | None = None) -> Camera:
    K = np.array([[700.0, 0.0, 181.3], [0.0, 707.0, 133.1], [0.0, 0.0, 1.0]])
    return Camera(K, 360, 270, np.zeros(0) if distortion is None else distortion)


def bar(x: float, lean: float, albedo: float = 170.0) -> Bar:
    A, B = np.array([x - lean, 0.16, 0.8]), np.array([x + lean, -0.16, 0.84])
    return Bar(A, B, 0.011, albedo)


def detect(cam: Camera, bars: list[Bar], image: Array, *, canny: bool = True) -> Outlines:
    """Detect bars that are predicted 2 mm off."""
    rng = np.random.default_rng(0)
    A, B = (np.array([getattr(b, end) for b in bars])[None] for end in "AB")
    one = np.zeros(1, dtype=np.intp)
    lengths = [float(np.linalg.norm(b.B - b.A)) for b in bars]
    pixels = np.rint(image).astype(np.uint8)
    A = A + 2e-3 * rng.choice([-1.0, 1.0], A.shape)
    B = B + 2e-3 * rng.choice([-1.0, 1.0], B.shape)
    one_view = Measurements(
        (View("c1", cam),), ("a.png",), one, one, np.zeros((1, len(bars))), 1e-6
    )
    cylinders = [(Cylinder("rod", 0.011, "base", 0.0, length),) for length in lengths]
    wanted, names = (
        np.ones((1, len(bars)), dtype=np.bool_),
        [f"leg{i + 1}" for i in range(len(bars))],
    )
    search = Search(lambda row: pixels, one_view, A, B, cylinders, wanted, names)
    placement = Placement(A, B, (RigidTransform.identity(),))
    return measure_outlines(search, placement, [0], method=canny_parts if canny else None)[0]


def errors(cam: Camera, bars: list[Bar], found: Outlines) -> Array:
    """Return the errors at both ends of each used outline, positive to the inside [px]."""
    error = []
    for i in np.flatnonzero(found.used).tolist():
        b = bars[found.leg[i]]
        u = (b.B - b.A) / np.linalg.norm(b.B - b.A)
        h = outlines_of_axis(u, b.A, b.radius)[found.edge[i] - 1]
        offset = cam.line_offset(np.stack([h, h]), cam.undistort(found.ends[i]))
        error.append(EPSILON[found.edge[i] - 1] * offset)
    return np.array(error)


def test_edge_points_lie_beside_a_step_on_whole_pixels() -> None:
    image = np.full((60, 80), 50.0, dtype=np.float32)
    image[:, 41:] = 120.0  # the step is between columns 40 and 41
    points = edge_points(image)
    assert set(points[:, 0]) <= {40.0, 41.0}
    assert set(points[:, 1]) == set(np.arange(60.0))


@pytest.mark.parametrize("distortion", [None, LENS], ids=["pinhole", "lens"])
def test_flat_edges_are_found_without_bias(distortion: Array | None) -> None:
    cam = camera(distortion)
    bars = [bar(-0.13, 0.03), bar(-0.02, 0.01), bar(0.12, -0.05)]
    image = render(cam, bars, 40.0, FLAT, blur=0.5, noise=2.0, supersample=4)
    found = detect(cam, bars, image)
    assert np.all(found.used), found.reason
    error = errors(cam, bars, found)
    assert abs(float(error.mean())) < 0.05  # signed: half a pixel somewhere would show
    assert float(np.sqrt(np.mean(error**2))) < 0.3


def test_noise_that_shows_in_repeats_is_less_than_the_error_they_share() -> None:
    cam, bars = camera(), [bar(-0.09, 0.03), bar(0.08, -0.05)]
    clean = render(cam, bars, 40.0, Light(), blur=0.5, noise=0.0, supersample=4)
    rng = np.random.default_rng(2)
    repeats = [
        errors(
            cam,
            bars,
            detect(cam, bars, np.clip(clean + 2.0 * rng.standard_normal(clean.shape), 0, 255)),
        )
        for _ in range(5)
    ]
    spread = float(np.std(np.array(repeats), axis=0).mean())
    shared = float(np.abs(np.mean(repeats, axis=0)).mean())
    assert spread < 0.1
    assert shared > 2.0 * spread


def test_an_outline_that_fades_away_is_rejected_with_a_reason() -> None:
    cam, bars = camera(), [bar(-0.09, 0.03), bar(0.08, -0.05)]
    image = render(cam, bars, 40.0, FLAT, blur=0.5, noise=1.0, supersample=3)
    noise = np.random.default_rng(0).standard_normal(image.shape)
    image[:, :180] = 40.0 + noise[:, :180]  # nothing is left of the first
    found = detect(cam, bars, image)
    np.testing.assert_array_equal(found.used, [False, False, True, True])
    assert all(found.reason[:2])


def test_both_methods_look_at_the_same_parts() -> None:
    cam, bars = camera(), [bar(-0.09, 0.03), bar(0.08, -0.05)]
    image = render(cam, bars, 40.0, Light(), blur=0.8, noise=2.0, supersample=3)
    image = np.asarray(cv2.GaussianBlur(image, (0, 0), 0.5))
    canny, ours = detect(cam, bars, image), detect(cam, bars, image, canny=False)
    for name in ("row", "leg", "edge"):
        np.testing.assert_array_equal(getattr(canny, name), getattr(ours, name))
    assert canny.part == ours.part
