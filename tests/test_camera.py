"""The camera model: distortion both ways, and offsets of lines in pixels."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from legcal.geometry.types import Array
from legcal.vision.camera import Camera

FAST = settings(deadline=None, max_examples=50)
K = np.array([[1290.0, 2.5, 518.3], [0.0, 1310.0, 379.6], [0.0, 0.0, 1.0]])
PINHOLE = Camera(K, 1024, 768)
CAMERAS = {
    "pinhole": PINHOLE,
    "plumb_bob": Camera(K, 1024, 768, np.array([-0.25, 0.08, 1e-3, -8e-4, 0.01])),
    "plumb_bob of 4": Camera(K, 1024, 768, np.array([0.12, -0.05, 5e-4, 1e-3])),
    "rational": Camera(
        K,
        1024,
        768,
        np.array([0.3, 0.1, 1e-3, -5e-4, 0.02, 0.4, 0.05, 0.01]),
        "rational_polynomial",
    ),
    "equidistant": Camera(K, 1024, 768, np.array([0.03, -0.01, 0.004, -0.002]), "equidistant"),
    "equidistant of 0": Camera(K, 1024, 768, np.zeros(4), "equidistant"),
}
EACH = pytest.mark.parametrize("camera", CAMERAS.values(), ids=CAMERAS.keys())


def field(n: int = 7) -> Array:
    """Points of the sensor plane all over the image."""
    x, y = np.meshgrid(np.linspace(-0.4, 0.38, n), np.linspace(-0.28, 0.29, n))
    return np.stack([x, y], axis=-1)


@EACH
def test_undistort_undoes_distort_all_over_the_image(camera: Camera) -> None:
    pixels = camera.distort(field())
    assert pixels.shape == (7, 7, 2)
    np.testing.assert_allclose(camera.undistort(pixels), field(), atol=1e-11)
    np.testing.assert_allclose(camera.distort(camera.undistort(pixels)), pixels, atol=1e-8)


@FAST
@given(
    st.tuples(st.floats(-0.3, 0.3), st.floats(-0.1, 0.1)),
    st.tuples(st.floats(-2e-3, 2e-3), st.floats(-2e-3, 2e-3)),
    st.tuples(st.floats(-0.35, 0.35), st.floats(-0.3, 0.3)),
)
def test_undistort_undoes_distort_for_any_ordinary_lens(
    radial: tuple[float, float], tangential: tuple[float, float], point: tuple[float, float]
) -> None:
    camera = Camera(K, 1024, 768, np.array([*radial, *tangential, 0.0]))
    xy = np.array(point)
    np.testing.assert_allclose(camera.undistort(camera.distort(xy)), xy, atol=1e-10)


@EACH
def test_project_is_distort_of_the_ray(camera: Camera) -> None:
    rays = np.concatenate([field(), np.ones((7, 7, 1))], axis=-1)
    np.testing.assert_allclose(camera.project(0.9 * rays), camera.distort(field()), atol=1e-9)


def test_coefficients_of_zero_are_a_pinhole() -> None:
    camera = Camera(K, 1024, 768, np.zeros(5))
    assert not camera.has_distortion
    np.testing.assert_array_equal(camera.distort(field()), PINHOLE.distort(field()))


def test_pinhole_projects_by_its_camera_matrix() -> None:
    P = np.array([0.1, -0.2, 0.8])
    np.testing.assert_allclose(PINHOLE.project(P), (K @ P / P[2])[:2], atol=1e-12)


def test_equidistant_image_grows_with_the_angle_to_the_optical_axis() -> None:
    camera = CAMERAS["equidistant of 0"]
    angle = 0.35
    pixel = camera.distort(np.array([np.tan(angle), 0.0]))
    np.testing.assert_allclose(pixel, [K[0, 0] * angle + K[0, 2], K[1, 2]], atol=1e-9)


def test_pixels_per_unit_of_a_pinhole_is_its_camera_matrix() -> None:
    J = PINHOLE.pixels_per_unit(field())
    np.testing.assert_array_equal(J, np.broadcast_to(K[:2, :2], (7, 7, 2, 2)))


@EACH
def test_pixels_per_unit_predicts_small_steps(camera: Camera) -> None:
    xy, step = field(), np.array([3e-4, -2e-4])
    moved = camera.distort(xy + step) - camera.distort(xy - step)
    np.testing.assert_allclose(camera.pixels_per_unit(xy) @ (2.0 * step), moved, atol=1e-5)


@FAST
@given(
    st.floats(0.0, 6.28),
    st.floats(-0.3, 0.3),
    st.tuples(st.floats(-0.4, 0.4), st.floats(-0.3, 0.3)),
)
def test_line_offset_of_a_pinhole_is_the_distance_to_the_line_in_the_image(
    angle: float, shift: float, point: tuple[float, float]
) -> None:
    h = np.array([np.cos(angle), np.sin(angle), shift])
    line = np.linalg.solve(K.T, h / np.linalg.norm(h))
    distance = line @ [*PINHOLE.distort(np.array(point)), 1.0] / np.linalg.norm(line[:2])
    assert PINHOLE.line_offset(h, np.array(point)) == pytest.approx(distance, abs=1e-9)


@EACH
@pytest.mark.parametrize("offset", [-0.5, 0.02, 1.0])
def test_line_offset_is_the_distance_to_the_line_as_the_lens_bends_it(
    camera: Camera, offset: float
) -> None:
    direction = np.array([0.6, 0.8])
    h = np.array([-0.8, 0.6, 0.05])
    on_line = -h[2] * h[:2] + 0.2 * direction
    # A point beside the line, found on the sensor plane and measured in the image.
    xy = on_line + h[:2] * offset / 1300.0
    s = np.linspace(0.15, 0.25, 40_001)[:, None]
    curve = camera.distort(-h[2] * h[:2] + s * direction)
    nearest = np.linalg.norm(curve - camera.distort(xy), axis=-1).min()
    assert camera.line_offset(h, xy) == pytest.approx(np.sign(offset) * nearest, abs=2e-3)


def test_line_offset_does_not_depend_on_the_length_of_h() -> None:
    camera, h = CAMERAS["plumb_bob"], np.array([0.3, -0.9, 0.1])
    np.testing.assert_allclose(
        camera.line_offset(5.0 * h, field()), camera.line_offset(h, field()), rtol=1e-12
    )
