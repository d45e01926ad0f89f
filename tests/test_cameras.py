"""Cameras: distortion both ways, their files, and cylinders seen by them (eqs 1 to 5)."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import yaml
from hypothesis import given, settings
from hypothesis import strategies as st

from legcal.calibration.camera_calibration.projection import compare_cameras
from legcal.errors import DatasetError, NotVisible, UsageError
from legcal.geometry.lines import distance_to_line, moment
from legcal.geometry.types import Array
from legcal.vision.camera import (
    Camera,
    intrinsic_names,
    intrinsic_unit,
    intrinsic_values,
    pixel_derivatives,
    project_with_derivatives,
    shared_cameras,
    undistort_near,
    with_intrinsics,
)
from legcal.vision.camera_file import camera_info, convert_camera, read_camera
from legcal.vision.cylinder import EPSILON, axis_of_outlines, outlines_of_axis, steps_to_outlines
from legcal.vision.distortion import CameraProgram, DistortionModel

FAST = settings(deadline=None, max_examples=40)
SIZE = 1024, 768
K = np.array([[1290.0, 2.5, 518.3], [0.0, 1310.0, 379.6], [0.0, 0.0, 1.0]])
PLUMB_BOB = [-0.25, 0.08, 1e-3, -8e-4, 0.01]
RATIONAL = [0.3, 0.1, 1e-3, -5e-4, 0.02, 0.4, 0.05, 0.01]
PRISM = [*RATIONAL, 0.002, -0.0004, -0.0015, 0.0003]
FISHEYE = [0.03, -0.01, 0.004, -0.002]
SPLINE = [0.02, 0.06, 0.09, 0.07, 0.01, -0.05]
LENSES: list[tuple[DistortionModel, list[float]]] = [
    ("plumb_bob", []),
    ("plumb_bob", PLUMB_BOB),
    ("plumb_bob", PLUMB_BOB[:4]),
    ("rational_polynomial", RATIONAL),
    ("thin_prism", PRISM),
    ("equidistant", FISHEYE),
    ("equidistant", [0.0] * 4),
    ("splined_radial", SPLINE),
]
CAMERAS = [Camera(K, *SIZE, np.array(D), model) for model, D in LENSES]
EACH = pytest.mark.parametrize("camera", CAMERAS, ids=lambda c: f"{c.model}-{len(c.distortion)}")
PINHOLE = CAMERAS[0]


def field(n: int = 7) -> Array:
    """Points of the sensor plane all over the image."""
    x, y = np.meshgrid(np.linspace(-0.4, 0.38, n), np.linspace(-0.28, 0.29, n))
    return np.stack([x, y], axis=-1)


@EACH
def test_undistort_undoes_distort_all_over_the_image(camera: Camera) -> None:
    pixels = camera.distort(field())
    assert pixels.shape == (7, 7, 2)
    np.testing.assert_allclose(camera.undistort(pixels), field(), atol=1e-11)
    nothing = np.zeros((0, 2, 2))
    assert camera.distort(nothing).shape == camera.undistort(nothing).shape == (0, 2, 2)
    assert camera.line_offset(np.zeros((0, 2, 3)), nothing).shape == (0, 2)
    rays = np.concatenate([field(), np.ones((7, 7, 1))], axis=-1)
    np.testing.assert_allclose(camera.project(0.9 * rays), pixels, atol=1e-9)
    step = np.array([3e-4, -2e-4])
    moved = camera.distort(field() + step) - camera.distort(field() - step)
    np.testing.assert_allclose(camera.pixels_per_unit(field()) @ (2.0 * step), moved, atol=1e-5)
    P, dP = np.array([[0.1, -0.05, 0.8], [-0.2, 0.1, 0.9]]), np.array([1e-5, -2e-5, 3e-5])
    pixels, by_point = camera.project_with_derivative(P)
    np.testing.assert_allclose(pixels, camera.project(P), atol=1e-9)
    np.testing.assert_allclose(
        2.0 * by_point @ dP, camera.project(P + dP) - camera.project(P - dP), atol=1e-5
    )


@EACH
@pytest.mark.parametrize("offset", [-0.5, 1.0])
def test_line_offset_is_the_distance_to_the_line_as_the_lens_bends_it(
    camera: Camera, offset: float
) -> None:
    direction = np.array([0.6, 0.8])
    h = np.array([-0.8, 0.6, 0.05])
    on_line = -h[2] * h[:2] + 0.2 * direction
    xy = on_line + h[:2] * offset / 1300.0
    s = np.linspace(0.18, 0.22, 8_001)[:, None]
    curve = camera.distort(-h[2] * h[:2] + s * direction)
    nearest = np.linalg.norm(curve - camera.distort(xy), axis=-1).min()
    assert camera.line_offset(h, xy) == pytest.approx(np.sign(offset) * nearest, abs=2e-3)
    assert camera.line_offset(5.0 * h, xy) == pytest.approx(camera.line_offset(h, xy), rel=1e-12)


# Intrinsics by their names.

PIXELS = np.array([[[12.0, 30.0], [700.5, 101.25]], [[511.5, 380.5], [1000.0, 760.0]]])
STRAIGHT = np.array([[1290.0, 0.0, 511.0], [0.0, 1285.0, 380.0], [0.0, 0.0, 1.0]])
PLAIN, FIVE = Camera(STRAIGHT, *SIZE), Camera(STRAIGHT, *SIZE, np.array(PLUMB_BOB))


@pytest.mark.parametrize(
    "camera",
    [PLAIN, PINHOLE, *(Camera(STRAIGHT, *SIZE, np.array(D), model) for model, D in LENSES[1:6])],
    ids=lambda c: f"{c.model}-{len(c.distortion)}",
)
def test_points_move_with_each_intrinsic_as_the_differences_say(camera: Camera) -> None:
    names, values = intrinsic_names(camera), intrinsic_values(camera)
    true = camera.undistort(PIXELS)
    near = true + np.array([3e-3, -2e-3])
    for begin in (near, np.full(PIXELS.shape, np.nan)):
        np.testing.assert_allclose(undistort_near(camera, PIXELS, begin), true, atol=1e-13)
    by_xy, found = pixel_derivatives(camera, true, names)
    np.testing.assert_allclose(by_xy, camera.pixels_per_unit(true), rtol=1e-6, atol=1e-6)
    assert found.shape == (2, 2, 2, len(names))
    for k, (name, value) in enumerate(zip(names, values, strict=True)):
        step = 1e-2 if intrinsic_unit(name) == "px" else 1e-5
        plus, minus = (
            with_intrinsics(camera, {name: value + sign * step}).distort(true) for sign in (1, -1)
        )
        slope = (plus - minus) / (2.0 * step)
        np.testing.assert_allclose(found[..., k], slope, rtol=2e-5, atol=2e-5, err_msg=name)
    same = with_intrinsics(camera, dict(zip(names, values, strict=True)))
    np.testing.assert_array_equal(same.undistort(PIXELS), true)
    both, alone = (pixel_derivatives(camera, true, x)[1] for x in (("cy", "fx"), ("fx",)))
    np.testing.assert_allclose(both[..., 1:], alone, rtol=1e-12)
    assert pixel_derivatives(camera, true, ())[1].shape == (2, 2, 2, 0)


def test_views_of_one_camera_share_its_intrinsics_in_any_order() -> None:
    again = Camera(STRAIGHT.copy(), *SIZE, np.zeros(5))  # the same camera, written at length
    for names, cameras in (
        (["c3", "c2", "c1"], [PLAIN, FIVE, again]),
        (["c1", "c2", "c3"], [again, FIVE, PLAIN]),
    ):
        assert shared_cameras(names, cameras) == ("c1", "c2", "c1")


# Files.


def ros(**changes: Any) -> dict[str, Any]:
    """The content of a ROS camera_info file; D and K are its coefficients and matrix."""
    D, matrix = changes.pop("D", PLUMB_BOB), changes.pop("K", K.tolist())
    content = {
        "image_width": SIZE[0],
        "image_height": SIZE[1],
        "camera_matrix": {"rows": 3, "cols": 3, "data": [x for row in matrix for x in row]},
        "distortion_model": "plumb_bob",
        "distortion_coefficients": {"rows": 1, "cols": len(D), "data": D},
    }
    return {key: value for key, value in {**content, **changes}.items() if value is not ...}


def kalibr(**changes: Any) -> dict[str, Any]:
    """The content of a Kalibr camchain of one camera."""
    camera = {
        "cam_overlaps": [],
        "camera_model": "pinhole",
        "distortion_coeffs": PLUMB_BOB[:4],
        "distortion_model": "radtan",
        "intrinsics": [1290.0, 1310.0, 518.3, 379.6],
        "resolution": list(SIZE),
    }
    return {"cam0": {k: v for k, v in {**camera, **changes}.items() if v is not ...}}


def write(folder: Path, content: object) -> Path:
    path = folder / "camera.yaml"
    if callable(content):
        return Path(content(folder))
    if isinstance(content, bytes):
        path.write_bytes(content)
    else:
        path.write_text(content if isinstance(content, str) else yaml.safe_dump(content))
    return path


def opencv(name: str, D: list[float], **more: Any) -> Callable[[Path], Path]:
    """Return what writes a storage of OpenCV."""

    def written(folder: Path) -> Path:
        storage = cv2.FileStorage(str(folder / name), cv2.FILE_STORAGE_WRITE)
        storage.write("image_width", SIZE[0])
        storage.write("image_height", SIZE[1])
        storage.write("camera_matrix", K)
        storage.write("distortion_coefficients", np.array([D], dtype=np.float64).T)
        for key, value in more.items():
            storage.write(key, value)
        storage.release()
        return folder / name

    return written


MESSAGE = {"width": SIZE[0], "height": SIZE[1], "distortion_model": "plumb_bob"}
MRCAL = "# made by hand\n{{ 'lensmodel': '{}', 'intrinsics': {}, 'imagersize': [1024, 768], }}\n"
FOUR = [1290.0, 1310.0, 518.3, 379.6]
AT_CORNER = "1290 1310 518.8 380.1"
MATLAB = {"RadialDistortion": [-0.25, 0.08, 0.01], "TangentialDistortion": [1e-3, -8e-4]} | {
    "ImageSize": SIZE[::-1]
}
FULL = MESSAGE | {"k": K.ravel().tolist(), "d": PLUMB_BOB}
ROI = {"x_offset": 0, "y_offset": 0, "width": SIZE[0], "height": SIZE[1], "do_rectify": False}
BY_ONE = [[1290.0, 2.5, 519.3], [0.0, 1310.0, 380.6], [0.0, 0.0, 1.0]]


def basalt(lens: str, numbers: dict[str, float]) -> dict[str, Any]:
    """The content of a calibration of Basalt of one camera."""
    pinhole = dict(zip(("fx", "fy", "cx", "cy"), FOUR, strict=True))
    camera = {"camera_type": lens, "intrinsics": pinhole | numbers}
    return {"value0": {"intrinsics": [camera], "resolution": [list(SIZE)]}}


def echoed(*messages: dict[str, Any]) -> str:
    """The text of messages as ``ros2 topic echo`` prints them."""
    return "".join(yaml.safe_dump(message) + "---\n" for message in messages)


READ: list[tuple[object, str, list[float], float]] = [  # content, model, coefficients, skew
    *((ros(distortion_model=model, D=D), model, D, 2.5) for model, D in LENSES[1:]),
    (yaml.safe_dump(ros()).replace("0.08", "8e-2"), "plumb_bob", PLUMB_BOB, 2.5),  # a text in YAML
    (ros(distortion_model="rational_polynomial"), "plumb_bob", PLUMB_BOB, 2.5),
    (ros(D=[*PLUMB_BOB, 0.0, 0.0, 0.0]), "plumb_bob", PLUMB_BOB, 2.5),
    *((opencv(f"camera.{suffix}", PLUMB_BOB), "plumb_bob", PLUMB_BOB, 2.5)
      for suffix in ("yaml", "xml", "json")),
    (opencv("a.yaml", RATIONAL), "rational_polynomial", RATIONAL, 2.5),
    (opencv("a.yaml", [*RATIONAL, *[0.0] * 6]), "rational_polynomial", RATIONAL, 2.5),
    (opencv("a.yaml", [*PRISM, 0.0, 0.0]), "thin_prism", PRISM, 2.5),
    (opencv("a.yaml", PRISM), "thin_prism", PRISM, 2.5),
    (opencv("a.yaml", FISHEYE, fisheye_model=1), "equidistant", FISHEYE, 2.5),
    (opencv("a.yaml", FISHEYE, distortion_model="equidistant"), "equidistant", FISHEYE, 2.5),
    (opencv("a.yaml", FISHEYE, camera_model="fisheye"), "equidistant", FISHEYE, 2.5),
    (opencv("a.yaml", PLUMB_BOB[:4], fisheye_model=0), "plumb_bob", PLUMB_BOB[:4], 2.5),
    (kalibr(), "plumb_bob", PLUMB_BOB[:4], 0.0),
    *((kalibr(distortion_model=name, distortion_coeffs=FISHEYE), "equidistant", FISHEYE, 0.0)
      for name in ("equidistant", "equi")),
    *((kalibr(distortion_model="none", distortion_coeffs=none), "plumb_bob", [], 0.0)
      for none in ([], ..., [0.0] * 4)),
    ("%YAML:1.0 # OpenCV's\n" + yaml.safe_dump(kalibr()), "plumb_bob", PLUMB_BOB[:4], 0.0),
    (echoed(*2 * [FULL]), "plumb_bob", PLUMB_BOB, 2.5),
    (FULL | {"binning_x": 1, "binning_y": 0, "roi": ROI}, "plumb_bob", PLUMB_BOB, 2.5),
    (echoed(MESSAGE | {"K": K.ravel().tolist(), "D": PLUMB_BOB}), "plumb_bob", PLUMB_BOB, 2.5),
    (MRCAL.format("LENSMODEL_OPENCV8", FOUR + RATIONAL), "rational_polynomial", RATIONAL, 0.0),
    (MRCAL.format("LENSMODEL_OPENCV12", FOUR + PRISM), "thin_prism", PRISM, 0.0),
    (MRCAL.replace("lensmodel", "lens_model").format("LENSMODEL_PINHOLE", FOUR), "plumb_bob",
     [0.0] * 5, 0.0),
    (f"# Camera list\n1 OPENCV_FISHEYE 1024 768 {AT_CORNER} 0.03 -0.01 0.004 -0.002\n",
     "equidistant", FISHEYE, 0.0),
    (f"# Camera list\r\n\r\n1 PINHOLE 1024 768 {AT_CORNER}\r\n".encode(), "plumb_bob",
     [0.0] * 5, 0.0),
    (yaml.safe_dump(ros()) + "note: |\n  1 AB 3 4\n", "plumb_bob", PLUMB_BOB, 2.5),
    (f"3 OPENCV 1024 768 {AT_CORNER} -0.25 0.08 0.001 -0.0008\n", "plumb_bob",
     [*PLUMB_BOB[:4], 0.0], 0.0),
    (basalt("kb4", dict(zip(("k1", "k2", "k3", "k4"), FISHEYE, strict=True))), "equidistant",
     FISHEYE, 0.0),
    (MATLAB | {"K": BY_ONE}, "plumb_bob", PLUMB_BOB, 2.5),
    (MATLAB | {"IntrinsicMatrix": np.transpose(BY_ONE).tolist()}, "plumb_bob", PLUMB_BOB, 2.5),
]  # fmt: skip


@pytest.mark.parametrize(("content", "model", "D", "skew"), READ)
def test_files_of_all_programs_are_read_and_written_for_ros(
    tmp_path: Path, content: object, model: str, D: list[float], skew: float
) -> None:
    camera = read_camera(write(tmp_path, content))
    np.testing.assert_allclose(camera.K, [[1290.0, skew, 518.3], *K[1:]], atol=1e-9)
    np.testing.assert_array_equal(camera.distortion, D)
    again = read_camera(write(tmp_path, camera_info(camera, "any")))
    np.testing.assert_array_equal(again.distort(field()), camera.distort(field()))
    for found in (camera, again):
        assert (found.model, found.width, found.height) == (model, *SIZE)


@pytest.mark.parametrize(
    ("content", "named"),
    [
        (MRCAL.format("LENSMODEL_SPLINED_STEREOGRAPHIC_order=3", FOUR),
         ("SPLINED", "LENSMODEL_OPENCV8", "legcal camera")),
        (MRCAL.format("LENSMODEL_OPENCV8", FOUR), ("4 parameters", "12")),
        (basalt("ds", {}), ("'ds'", "kb4")),
        (f"1 FOV 1024 768 {AT_CORNER} 0.9\n", ("'FOV'", "OPENCV_FISHEYE")),
        (f"1 PINHOLE 1024 768 {AT_CORNER}\n2 PINHOLE 1024 768 {AT_CORNER}\n", ("2 cameras",)),
        ("1 PINHOLE 1024\n", ("camera 1 could not be read", "'1024'", "width and height")),
        ("1 PINHOLE 1024 768 1.2.3 1 5 5\n", ("'1.2.3'", "parameters of PINHOLE")),
        (MATLAB | {"K": 3 * [[1.0, 2.0]]}, ("K could not be used", "three rows of three numbers")),
        (opencv("a.yaml", PLUMB_BOB, camera_model="fisheye"),
         ("found 5 coefficients, needed 4 for equidistant",)),
        (opencv("a.yaml", PLUMB_BOB, camera_model="omnidir"), ("camera_model", "'omnidir'")),
        (opencv("a.yaml", FISHEYE, camera_model="fisheye", fisheye_model=0),
         ("beside the distortion 'plumb",)),
        *((four, ("four coefficients without a lens model",))
          for four in (opencv("a.yaml", FISHEYE), ros(distortion_model=..., D=FISHEYE))),
        (kalibr(camera_model="omni", intrinsics=[0.8, *FOUR]), ("'omni'", "pinhole-radtan")),
        (kalibr(distortion_model="fov", distortion_coeffs=[0.9]), ("'fov'", "equidistant")),
        (ros(distortion_model="plumb_bob", D=RATIONAL), ("8 coefficients", "name the lens")),
        (ros(distortion_model="rational_polynomial", D=[*PRISM, 0.1, 0.0]), ("tilt",)),
        (FULL | {"binning_x": 2}, ("binning_x", "found 2", "0 or 1")),
        (FULL | {"roi": ROI | {"y_offset": 8, "height": 760}}, ("roi", "1024 x 760 px at (0, 8)")),
        (echoed(MESSAGE | {"k": K.ravel().tolist(), "d": FISHEYE},
                MESSAGE | {"k": K.ravel().tolist(), "d": PLUMB_BOB}), ("different cameras",)),
    ],
)  # fmt: skip
def test_lenses_that_legcal_does_not_have_are_refused_in_one_sentence(
    tmp_path: Path, content: object, named: tuple[str, ...]
) -> None:
    with pytest.raises(DatasetError) as refused:
        read_camera(write(tmp_path, content))
    assert [word for word in named if word not in str(refused.value)] == []
    assert len(refused.value.problems) == 1


@pytest.mark.parametrize(
    ("program", "lacks"),
    [
        ("ros", ()),
        ("opencv", ()),
        ("kalibr", ("rational_polynomial", "thin_prism")),
        ("mrcal", ("equidistant",)),
    ],
)
def test_cameras_are_written_for_other_programs(
    tmp_path: Path, program: CameraProgram, lacks: tuple[str, ...]
) -> None:
    source, output = tmp_path / "camera.yaml", tmp_path / f"{program}.txt"
    for model, D in LENSES[2:-1]:
        D = D[:4] if program == "kalibr" and model == "plumb_bob" else D
        source.write_text(camera_info(Camera(STRAIGHT, *SIZE, np.array(D), model), "any"))
        if model in lacks:
            with pytest.raises(UsageError, match=f"found the lens {model}, needed"):
                convert_camera(source, program, output)
            continue
        convert_camera(source, program, output)  # over the one before
        camera = read_camera(output)
        assert camera.model == model
        np.testing.assert_array_equal(camera.K, STRAIGHT)
        np.testing.assert_array_equal(camera.distortion[: len(D)], D)


@pytest.mark.parametrize(
    ("of", "program", "model"),
    [
        (LENSES[-1], "ros", "rational_polynomial"),
        (LENSES[-1], "opencv", "rational_polynomial"),
        (LENSES[-1], "kalibr", "equidistant"),
        (LENSES[-1], "mrcal", "rational_polynomial"),
        (LENSES[1], "kalibr", "plumb_bob"),  # with k3
    ],
)
def test_a_lens_that_the_program_lacks_is_written_as_its_nearest(
    tmp_path: Path,
    of: tuple[DistortionModel, list[float]],
    program: CameraProgram,
    model: str,
) -> None:
    lens = Camera(STRAIGHT, *SIZE, np.array(of[1]), of[0])
    block = {"version": 1, "sigma": {"fx": 2.0}, "names": ["fx"], "covariance": [[4.0]]}
    source = write(tmp_path, camera_info(lens, "any", {"legcal_camera": block}))
    _, said, left_out = convert_camera(source, program, tmp_path / "other.txt")
    written = read_camera(tmp_path / "other.txt")
    assert written.model == model
    off = float(said.partition("at most ")[2].partition(" px")[0])
    assert np.abs(written.distort(field()) - lens.distort(field())).max() <= 1.05 * off < 0.5
    assert written.covariance is None
    assert "covariance is left out" in left_out


def test_a_spline_agrees_with_the_fisheye_lens_of_opencv_all_over_the_image() -> None:
    K = np.array([[564.0, 0.0, 651.0], [0.0, 563.4, 497.0], [0.0, 0.0, 1.0]])
    k = np.array([0.0705, -0.0234, 0.0164, -0.0014])
    u, v = np.meshgrid(np.linspace(0.0, 1279.0, 41), np.linspace(0.0, 959.0, 31))
    pixels = np.column_stack([u.ravel(), v.ravel()])
    xy: Array = np.asarray(cv2.fisheye.undistortPoints(pixels[:, None], K, k), np.float64)[:, 0]
    assert np.degrees(np.arctan(np.linalg.norm(xy, axis=1))).max() > 70.0
    pixels = np.asarray(cv2.fisheye.distortPoints(xy[:, None], K, k), np.float64)[:, 0]
    spline = Camera(K, 1280, 960, np.zeros(6), "splined_radial")
    names, rays = intrinsic_names(spline), np.column_stack([xy, np.ones(len(xy))])
    for _ in range(3):  # linear in all but products of focal lengths and coefficients
        at, _, J = project_with_derivatives(spline, rays, names)
        step = np.linalg.lstsq(J.reshape(-1, len(names)), (pixels - at).ravel(), rcond=None)[0]
        values = intrinsic_values(spline) + step
        spline = with_intrinsics(spline, dict(zip(names, values.tolist(), strict=True)))
    assert np.linalg.norm(spline.project(rays) - pixels, axis=1).max() < 0.01
    np.testing.assert_allclose(spline.undistort(spline.distort(xy)), xy, atol=1e-9)


def test_a_spline_that_turns_back_inside_the_image_is_refused(tmp_path: Path) -> None:
    K = np.array([[564.0, 0.0, 651.0], [0.0, 563.4, 497.0], [0.0, 0.0, 1.0]])
    # The corners of the image are 1.45 focal lengths away: 83 deg off the axis without a spline.
    knots = np.array([0.0, 0.0, 0.0, -0.15, -0.4, -0.5])
    lens = Camera(K, 1280, 960, knots, "splined_radial")
    theta = np.linspace(0.01, 1.5, 500)
    u = lens.distort(np.column_stack([np.tan(theta), 0.0 * theta]))[:, 0]
    turn = np.degrees(theta[np.argmax(u)])
    with pytest.raises(DatasetError, match="stops growing") as refused:
        read_camera(write(tmp_path, camera_info(lens, "any")))
    said = float(str(refused.value).partition("growing ")[2].partition(" deg")[0])
    assert said == pytest.approx(turn, abs=1.0)
    # The same lens before a smaller image does so outside.
    inner = replace(lens, K=K - [[0, 0, 331.0], [0, 0, 257.0], [0, 0, 0]], width=640, height=480)
    assert read_camera(write(tmp_path, camera_info(inner, "any"))).model == "splined_radial"


def test_the_covariance_of_a_converted_camera_is_kept_where_it_can_be(tmp_path: Path) -> None:
    block = {"version": 1, "sigma": {"fx": 2.0}, "names": ["fx"], "covariance": [[4.0]]}
    source = write(tmp_path, camera_info(PLAIN, "any", {"legcal_camera": block}))
    assert len(convert_camera(source, "ros", tmp_path / "ros.yaml")) == 1
    assert yaml.safe_load((tmp_path / "ros.yaml").read_text())["legcal_camera"] == block
    covariance = read_camera(tmp_path / "ros.yaml").covariance
    assert covariance is not None
    assert covariance[0, 0] == 4.0
    _, note = convert_camera(source, "mrcal", tmp_path / "mrcal.txt")
    assert "files of mrcal do not hold it" in note


@pytest.mark.parametrize(("k1", "part"), [(0.0, 1.0), (-0.9, 0.855), (-3.0, 0.0)])
def test_the_compared_part_of_the_image_is_said_and_one_below_half_refused(
    k1: float, part: float
) -> None:
    folded = Camera(STRAIGHT, *SIZE, np.array([k1, 0.0, 0.0, 0.0]))
    if part == 0.0:
        with pytest.raises(UsageError, match="% of the image that the lens model"):
            compare_cameras(folded, PLAIN)
        return
    comparison = compare_cameras(folded, PLAIN)
    assert comparison.reached == comparison.document()["reached"] == pytest.approx(part, abs=0.01)
    assert (comparison.reached < 1.0) == (k1 < 0.0)


# A cylinder in the camera frame.

SEEDS = st.integers(0, 2**32 - 1)


def cylinder(seed: int) -> tuple[Array, Array, float]:
    """A direction, a point and a radius of a cylinder that leaves the camera centre outside."""
    rng = np.random.default_rng(seed)
    u = rng.normal(size=3)
    M = rng.normal(size=3) * [0.3, 0.3, 0.1] + [0.0, 0.0, 0.9]
    u /= np.linalg.norm(u)
    radius = float(rng.uniform(0.001, 0.9) * distance_to_line(np.zeros(3), u, M))
    return u, M, radius


@FAST
@given(SEEDS, st.floats(-2.0, 2.0))
def test_eq03_outlines_are_the_planes_that_touch_the_cylinder(seed: int, s: float) -> None:
    u, M, radius = cylinder(seed)
    h = outlines_of_axis(u, M, radius)
    np.testing.assert_allclose(np.linalg.norm(h, axis=-1), 1.0, atol=1e-12)
    np.testing.assert_allclose(h @ (M + s * u), EPSILON * radius, atol=1e-12)
    for one, P in zip(h, M + steps_to_outlines(h, radius), strict=True):
        # on the generating line, of which it is the moment
        assert distance_to_line(P, u, M) == pytest.approx(radius)
        m = moment(u, P)
        np.testing.assert_allclose(one, m / np.linalg.norm(m), atol=1e-9)
    np.testing.assert_allclose(outlines_of_axis(-u, M, radius), -h[::-1], atol=1e-12)


@FAST
@given(SEEDS, st.floats(1e-3, 1e3))
def test_eq05_outlines_give_back_the_axis_at_any_scale(seed: int, scale: float) -> None:
    u, M, radius = cylinder(seed)
    h1, h2 = outlines_of_axis(u, M, radius)
    np.testing.assert_allclose(outlines_of_axis(u, scale * M, scale * radius), [h1, h2], atol=1e-9)
    u_hat, M_hat = axis_of_outlines(h1, h2, radius)
    np.testing.assert_allclose(u_hat, u, atol=1e-9)
    assert distance_to_line(M_hat, u, M) < 1e-9
    assert M_hat @ u_hat == pytest.approx(0.0, abs=1e-9)  # nearest to the camera
    np.testing.assert_allclose(
        axis_of_outlines(h1, h2, scale * radius)[1], scale * M_hat, rtol=1e-12
    )
    u_hat, M_hat = axis_of_outlines(-h2, -h1, radius)
    np.testing.assert_allclose(u_hat, -u, atol=1e-9)
    assert distance_to_line(M_hat, u, M) < 1e-9


@pytest.mark.parametrize("distance", [0.0, 0.01])
def test_what_no_camera_sees_is_refused(distance: float) -> None:
    u, M = np.array([0.0, 0.0, 1.0]), np.array([distance, 0.0, 0.5])
    with pytest.raises(NotVisible, match=r"camera centre is \d+\.\d mm from an axis"):
        outlines_of_axis(u, M, 0.01)
    h = np.array([0.6, 0.0, 0.8])
    for sign in (1.0, -1.0):
        with pytest.raises(NotVisible, match="its two outlines coincide"):
            axis_of_outlines(h, sign * h, 0.01)
