"""Frames on joint centres, and rigid motions as the files write them."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import RigidTransform, Rotation

from legcal.files import motion_from_xyz_quat, motion_to_xyz_quat
from legcal.geometry import Array, frame_on_points, motion_of, product

FAST = settings(deadline=None, max_examples=50)
SEEDS = st.integers(0, 2**32 - 1)


def motion(seed: int) -> RigidTransform:
    rng = np.random.default_rng(seed)
    return RigidTransform.from_components(rng.normal(size=3), Rotation.random(rng=rng))


def points(seed: int) -> Array:
    rng = np.random.default_rng(seed)
    return np.array([[0.0, 0.0, 0.0], [0.4, 0.0, 0.0], [0.1, 0.3, 0.0]]) + rng.normal(
        scale=0.03, size=(3, 3)
    )


@FAST
@given(SEEDS)
def test_quick_products_are_those_of_scipy(seed: int) -> None:
    one, two, three = motion(seed), motion(seed + 1), motion(seed + 2)
    expected = (one * two * three).as_matrix()
    np.testing.assert_allclose(product(one, two, three).as_matrix(), expected, atol=1e-14)


@FAST
@given(SEEDS)
def test_rounding_of_a_rotation_matrix_is_corrected(seed: int) -> None:
    T = motion(seed)
    R = T.rotation.as_matrix() + 1e-9 * np.random.default_rng(seed).normal(size=(3, 3))
    found = motion_of(R, T.translation).as_matrix()
    np.testing.assert_allclose(found[:3, :3].T @ found[:3, :3], np.eye(3), atol=1e-15)
    expected = RigidTransform.from_components(T.translation, Rotation.from_matrix(R)).as_matrix()
    np.testing.assert_allclose(found, expected, atol=1e-15)


@FAST
@given(SEEDS)
def test_points_are_origin_x_axis_and_xy_plane_of_their_frame(seed: int) -> None:
    P = points(seed)
    local = frame_on_points(P).inv().apply(P)
    np.testing.assert_allclose(local[0], 0.0, atol=1e-12)
    np.testing.assert_allclose(local[1, 1:], 0.0, atol=1e-12)
    assert local[1, 0] > 0.0
    assert local[2, 1] > 0.0
    assert local[2, 2] == pytest.approx(0.0, abs=1e-12)


@FAST
@given(SEEDS)
def test_frame_moves_with_its_points(seed: int) -> None:
    T, P = motion(seed), points(seed)
    np.testing.assert_allclose(
        frame_on_points(T.apply(P)).as_matrix(), (T * frame_on_points(P)).as_matrix(), atol=1e-12
    )


@FAST
@given(SEEDS, st.floats(1e-3, 1e3))
def test_frame_keeps_its_axes_when_lengths_are_scaled(seed: int, scale: float) -> None:
    P = points(seed)
    np.testing.assert_allclose(
        frame_on_points(scale * P).rotation.as_matrix(),
        frame_on_points(P).rotation.as_matrix(),
        atol=1e-9,
    )


@FAST
@given(SEEDS)
def test_two_points_and_a_normal_move_together_whatever_their_heights(seed: int) -> None:
    T, P = motion(seed), points(seed)[:2]
    here = frame_on_points(P)
    np.testing.assert_allclose(here.rotation.as_matrix()[:, 2], [0.0, 0.0, 1.0], atol=1e-12)
    local = here.inv().apply(P)
    assert local[1, 0] > 0.0
    assert local[1, 1] == pytest.approx(0.0, abs=1e-12)
    assert local[1, 2] == pytest.approx(P[1, 2] - P[0, 2], abs=1e-12)
    moved = frame_on_points(T.apply(P), T.rotation.apply([0.0, 0.0, 1.0]))
    np.testing.assert_allclose(moved.as_matrix(), (T * here).as_matrix(), atol=1e-12)


def test_two_points_keep_the_z_axis() -> None:
    T = frame_on_points(np.array([[1.0, 1.0, 0.0], [1.0, 3.0, 0.0]]))
    np.testing.assert_allclose(T.rotation.apply([0.0, 0.0, 1.0]), [0.0, 0.0, 1.0], atol=1e-15)
    np.testing.assert_allclose(T.inv().apply([1.0, 3.0, 0.0]), [2.0, 0.0, 0.0], atol=1e-15)


@pytest.mark.parametrize(
    "P",
    [
        pytest.param(np.zeros((3, 3)), id="all points coincide"),
        pytest.param(np.array([[0.0, 0, 0], [1, 0, 0], [1, 0, 0]]), id="two points coincide"),
        pytest.param(np.array([[0.0, 0, 0], [1, 1, 1], [3, 3, 3]]), id="collinear"),
        pytest.param(np.array([[0.0, 0, 0], [0, 0, 1]]), id="two points along z"),
    ],
)
def test_points_without_a_plane_are_refused(P: Array) -> None:
    with pytest.raises(ValueError, match="coincide or are collinear"):
        frame_on_points(P)


@FAST
@given(SEEDS)
def test_motion_is_read_as_it_was_written(seed: int) -> None:
    T = motion(seed)
    written = motion_to_xyz_quat(T)
    assert written["quat_xyzw"][3] >= 0.0
    again = motion_from_xyz_quat(written["xyz"], written["quat_xyzw"])
    np.testing.assert_allclose(again.as_matrix(), T.as_matrix(), atol=1e-14)


def test_quaternion_has_its_scalar_last() -> None:
    quarter_turn = motion_from_xyz_quat([0, 0, 0], [0.0, 0.0, np.sqrt(0.5), np.sqrt(0.5)])
    np.testing.assert_allclose(quarter_turn.apply([1.0, 0.0, 0.0]), [0.0, 1.0, 0.0], atol=1e-15)
