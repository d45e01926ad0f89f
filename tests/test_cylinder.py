"""A cylinder and its outline, both ways (section 3.1, eqs 1-5)."""

import json
from pathlib import Path

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from legcal.errors import NotVisible
from legcal.geometry.lines import distance_to_line, moment
from legcal.geometry.types import Array
from legcal.vision.cylinder import EPSILON, axis_of_outlines, outlines_of_axis, point_with_zero_y

FAST = settings(deadline=None, max_examples=50)
SEEDS = st.integers(0, 2**32 - 1)
TRUTH = Path(__file__).parent / "data" / "hexapod-truth" / "truth.json"


def cylinder(seed: int) -> tuple[Array, Array, float]:
    """A direction, a point and a radius of a cylinder that leaves the camera centre outside."""
    rng = np.random.default_rng(seed)
    u = rng.normal(size=3)
    M = rng.normal(size=3) * [0.3, 0.3, 0.1] + [0.0, 0.0, 0.9]
    u /= np.linalg.norm(u)
    radius = float(rng.uniform(0.001, 0.9) * distance_to_line(np.zeros(3), u, M))
    return u, M, radius


@FAST
@given(SEEDS)
def test_axis_of_outlines_undoes_outlines_of_axis(seed: int) -> None:
    u, M, radius = cylinder(seed)
    h1, h2 = outlines_of_axis(u, M, radius)
    u_hat, M_hat = axis_of_outlines(h1, h2, radius)
    np.testing.assert_allclose(u_hat, u, atol=1e-9)
    assert distance_to_line(M_hat, u, M) < 1e-9


@FAST
@given(SEEDS, st.floats(-2.0, 2.0))
def test_eq05_axis_point_is_one_radius_from_both_tangent_planes(seed: int, s: float) -> None:
    u, M, radius = cylinder(seed)
    h = outlines_of_axis(u, M, radius)
    np.testing.assert_allclose(np.linalg.norm(h, axis=-1), 1.0, atol=1e-12)
    np.testing.assert_allclose(h @ (M + s * u), EPSILON * radius, atol=1e-12)


@FAST
@given(SEEDS)
def test_eq03_outline_is_the_moment_of_its_generating_line(seed: int) -> None:
    u, M, radius = cylinder(seed)
    for h, epsilon in zip(outlines_of_axis(u, M, radius), EPSILON, strict=True):
        P = M - epsilon * radius * h
        assert distance_to_line(P, u, M) == pytest.approx(radius)
        m = moment(u, P)
        np.testing.assert_allclose(h, m / np.linalg.norm(m), atol=1e-9)


@FAST
@given(SEEDS)
def test_eq05_solution_is_the_axis_point_nearest_to_the_camera(seed: int) -> None:
    u, M, radius = cylinder(seed)
    h1, h2 = outlines_of_axis(u, M, radius)
    u_hat, M_hat = axis_of_outlines(h1, h2, radius)
    assert M_hat @ u_hat == pytest.approx(0.0, abs=1e-9)


@FAST
@given(SEEDS)
def test_turning_the_leg_swaps_and_turns_its_outlines(seed: int) -> None:
    u, M, radius = cylinder(seed)
    np.testing.assert_allclose(
        outlines_of_axis(-u, M, radius), -outlines_of_axis(u, M, radius)[::-1], atol=1e-12
    )


@FAST
@given(SEEDS)
def test_eq04_direction_follows_the_signs_of_the_outlines(seed: int) -> None:
    u, M, radius = cylinder(seed)
    h1, h2 = outlines_of_axis(u, M, radius)
    u_hat, M_hat = axis_of_outlines(-h2, -h1, radius)
    np.testing.assert_allclose(u_hat, -u, atol=1e-9)
    assert distance_to_line(M_hat, u, M) < 1e-9


@FAST
@given(SEEDS, st.floats(1e-3, 1e3))
def test_outlines_do_not_change_when_lengths_are_scaled(seed: int, scale: float) -> None:
    u, M, radius = cylinder(seed)
    h = outlines_of_axis(u, M, radius)
    np.testing.assert_allclose(outlines_of_axis(u, scale * M, scale * radius), h, atol=1e-9)
    M_hat = axis_of_outlines(h[0], h[1], scale * radius)[1]
    np.testing.assert_allclose(M_hat, scale * axis_of_outlines(h[0], h[1], radius)[1], rtol=1e-12)


@FAST
@given(SEEDS)
def test_outlines_turn_with_the_camera(seed: int) -> None:
    u, M, radius = cylinder(seed)
    R = Rotation.random(rng=np.random.default_rng(seed))
    np.testing.assert_allclose(
        outlines_of_axis(R.apply(u), R.apply(M), radius),
        R.apply(outlines_of_axis(u, M, radius)),
        atol=1e-12,
    )


def test_many_cylinders_have_the_outlines_of_each() -> None:
    cylinders = [cylinder(seed) for seed in range(6)]
    u, M = (np.array([c[i] for c in cylinders]).reshape(2, 3, 3) for i in (0, 1))
    radius = np.array([c[2] for c in cylinders]).reshape(2, 3)
    h = outlines_of_axis(u, M, radius)
    np.testing.assert_allclose(h[1, 2], outlines_of_axis(*cylinders[5]), atol=1e-15)
    u_hat, M_hat = axis_of_outlines(h[..., 0, :], h[..., 1, :], radius)
    np.testing.assert_allclose(u_hat, u, atol=1e-9)
    np.testing.assert_allclose(np.cross(M_hat - M, u), 0.0, atol=1e-9)


def test_eqs_hold_on_the_rendered_hexapod() -> None:
    truth = json.loads(TRUTH.read_text())
    legs = [leg for image in truth["images"] for leg in image["legs"]]
    assert len(legs) > 200
    u, M, h1, h2 = (np.array([leg[name] for leg in legs]) for name in ("u", "M", "h1", "h2"))
    radius = np.array([leg["R"] for leg in legs], dtype=np.float64)
    h = outlines_of_axis(u, M, radius)
    np.testing.assert_allclose(h[:, 0], h1, atol=1e-9)
    np.testing.assert_allclose(h[:, 1], h2, atol=1e-9)
    u_hat, M_hat = axis_of_outlines(h1, h2, radius)
    np.testing.assert_allclose(u_hat, u, atol=1e-9)
    M_zero = np.array([leg["M_LS"] for leg in legs])
    np.testing.assert_allclose(point_with_zero_y(u_hat, M_hat), M_zero, rtol=1e-6, atol=1e-3)
    A, B = (np.array([leg[name] for leg in legs]) for name in ("A_cam", "B_cam"))
    np.testing.assert_allclose(np.sum((B - A) * u_hat, axis=-1), [leg["L"] for leg in legs])


@pytest.mark.parametrize("distance", [0.0, 0.005, 0.01])
def test_axis_through_the_camera_centre_is_refused(distance: float) -> None:
    u, M = np.array([0.0, 0.0, 1.0]), np.array([distance, 0.0, 0.5])
    with pytest.raises(NotVisible, match=r"camera centre is \d+\.\d mm from an axis"):
        outlines_of_axis(u, M, 0.01)


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_parallel_outlines_are_refused(sign: float) -> None:
    h = np.array([0.6, 0.0, 0.8])
    with pytest.raises(NotVisible, match="its two outlines coincide"):
        axis_of_outlines(h, sign * h, 0.01)


@FAST
@given(SEEDS)
def test_point_with_zero_y_is_on_the_axis(seed: int) -> None:
    u, M, _ = cylinder(seed)
    assume(abs(u[1]) > 1e-3)
    P = point_with_zero_y(u, M)
    assert P[1] == pytest.approx(0.0, abs=1e-9)
    assert distance_to_line(P, u, M) < 1e-9


def test_point_with_zero_y_is_refused_for_a_leg_parallel_to_the_image_x_axis() -> None:
    with pytest.raises(NotVisible, match="parallel to the image x axis"):
        point_with_zero_y(np.array([1.0, 0.0, 0.0]), np.array([0.0, 0.1, 1.0]))
