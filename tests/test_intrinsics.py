"""The numbers of a camera by their names."""

import numpy as np
import pytest

from legcal.vision.camera import (
    Camera,
    intrinsic_names,
    intrinsic_unit,
    intrinsic_values,
    shared_cameras,
    undistort_derivatives,
    with_intrinsics,
)

K = np.array([[1290.0, 0.0, 511.0], [0.0, 1285.0, 380.0], [0.0, 0.0, 1.0]])
SKEWED = np.array([[1290.0, 2.0, 511.0], [0.0, 1285.0, 380.0], [0.0, 0.0, 1.0]])
CAMERAS = {
    "plain": Camera(K, 1024, 768),
    "skewed": Camera(SKEWED, 1024, 768),
    "four": Camera(K, 1024, 768, np.array([-0.11, 0.05, 1e-3, -5e-4])),
    "five": Camera(K, 1024, 768, np.array([-0.11, 0.05, 1e-3, -5e-4, 0.01])),
    "rational": Camera(
        K,
        1024,
        768,
        np.array([0.2, -0.1, 1e-3, -5e-4, 0.01, 0.3, -0.05, 0.02]),
        "rational_polynomial",
    ),
    "fisheye": Camera(K, 1024, 768, np.array([0.02, -0.01, 3e-3, -1e-3]), "equidistant"),
}
PIXELS = np.array([[[12.0, 30.0], [700.5, 101.25]], [[511.5, 380.5], [1000.0, 760.0]]])


@pytest.mark.parametrize("camera", CAMERAS.values(), ids=CAMERAS)
def test_points_move_with_each_number_as_the_differences_say(camera: Camera) -> None:
    names = intrinsic_names(camera)
    found = undistort_derivatives(camera, PIXELS, names)
    assert found.shape == (2, 2, 2, len(names))
    for k, (name, value) in enumerate(zip(names, intrinsic_values(camera), strict=True)):
        step = 1e-2 if intrinsic_unit(name) == "px" else 1e-5
        ends = [
            with_intrinsics(camera, {name: value + sign * step}).undistort(PIXELS)
            for sign in (1, -1)
        ]
        slope = (ends[0] - ends[1]) / (2.0 * step)
        np.testing.assert_allclose(found[..., k], slope, rtol=2e-5, atol=2e-8, err_msg=name)


@pytest.mark.parametrize("camera", CAMERAS.values(), ids=CAMERAS)
def test_a_camera_with_its_own_numbers_sees_the_same(camera: Camera) -> None:
    same = with_intrinsics(
        camera, dict(zip(intrinsic_names(camera), intrinsic_values(camera), strict=True))
    )
    np.testing.assert_array_equal(same.undistort(PIXELS), camera.undistort(PIXELS))


def test_the_order_of_names_does_not_matter_and_some_may_be_left_out() -> None:
    camera = CAMERAS["five"]
    both = undistort_derivatives(camera, PIXELS, ("k1", "fx"))
    alone = undistort_derivatives(camera, PIXELS, ("fx",))
    np.testing.assert_allclose(both[..., 1:], alone, rtol=1e-12)
    assert undistort_derivatives(camera, PIXELS, ()).shape == (2, 2, 2, 0)


def test_replacing_a_number_leaves_the_given_camera_alone() -> None:
    camera = CAMERAS["plain"]
    changed = with_intrinsics(camera, {"fx": 1300.0, "k1": 0.1})
    assert changed.K[0, 0] == 1300.0
    assert changed.has_distortion
    assert camera.K[0, 0] == 1290.0
    assert not camera.has_distortion


def test_names_are_those_of_the_model() -> None:
    plumb_bob = ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2", "k3")
    assert intrinsic_names(CAMERAS["plain"]) == intrinsic_names(CAMERAS["four"]) == plumb_bob
    assert intrinsic_names(CAMERAS["rational"]) == (*plumb_bob, "k4", "k5", "k6")
    assert intrinsic_names(CAMERAS["fisheye"]) == ("fx", "fy", "cx", "cy", "k1", "k2", "k3", "k4")
    assert intrinsic_names(CAMERAS["skewed"]) == ("fx", "fy", "cx", "cy")
    assert [intrinsic_unit(name) for name in ("fx", "cy", "k1", "p2")] == ["px", "px", "", ""]


def test_views_of_one_camera_share_its_numbers_in_any_order() -> None:
    plain, five = CAMERAS["plain"], CAMERAS["five"]
    again = Camera(K.copy(), 1024, 768, np.zeros(5))  # the same camera, written at length
    assert shared_cameras(["c3", "c2", "c1"], [plain, five, again]) == ("c1", "c2", "c1")
    assert shared_cameras(["c1", "c2", "c3"], [again, five, plain]) == ("c1", "c2", "c1")
