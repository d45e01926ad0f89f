"""Camera files of three kinds, and what is refused in them."""

import json
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import yaml

from legcal.errors import DatasetError
from legcal.vision.camera import Camera
from legcal.vision.camera_file import read_camera

K = [[1290.3, 0.0, 518.3], [0.0, 1291.7, 379.6], [0.0, 0.0, 1.0]]
PLUMB_BOB = [-0.2, 0.05, 1e-3, -5e-4, 0.01]
RATIONAL = [0.3, 0.1, 1e-3, -5e-4, 0.02, 0.4, 0.05, 0.01]
EXAMPLE = Path(__file__).parents[1] / "examples" / "hexapod" / "camera_info.yaml"


def ros(**changes: Any) -> dict[str, Any]:
    """The content of a ROS camera_info file."""
    model = changes.pop("distortion_model", "plumb_bob")
    D = changes.pop("D", PLUMB_BOB)
    matrix = changes.pop("K", K)
    content = {
        "image_width": 1024,
        "image_height": 768,
        "camera_name": "any",
        "camera_matrix": {"rows": 3, "cols": 3, "data": [x for row in matrix for x in row]},
        "distortion_model": model,
        "distortion_coefficients": {"rows": 1, "cols": len(D), "data": D},
    }
    return {k: v for k, v in {**content, **changes}.items() if v is not ...}


def kalibr(**changes: Any) -> dict[str, Any]:
    """The content of a Kalibr camchain of one camera."""
    camera = {
        "cam_overlaps": [],
        "camera_model": "pinhole",
        "distortion_coeffs": PLUMB_BOB[:4],
        "distortion_model": "radtan",
        "intrinsics": [1290.3, 1291.7, 518.3, 379.6],
        "resolution": [1024, 768],
        "rostopic": "/camera/image_raw",
    }
    return {"cam0": {k: v for k, v in {**camera, **changes}.items() if v is not ...}}


def write(tmp_path: Path, content: object, name: str = "camera.yaml") -> Path:
    path = tmp_path / name
    path.write_text(content if isinstance(content, str) else yaml.safe_dump(content))
    return path


def write_opencv(path: Path, D: list[float], matrix: object = K, **more: int) -> Path:
    storage = cv2.FileStorage(str(path), cv2.FILE_STORAGE_WRITE)
    storage.write("image_width", 1024)
    storage.write("image_height", 768)
    storage.write("camera_matrix", np.array(matrix, dtype=np.float64))
    storage.write("distortion_coefficients", np.array([D], dtype=np.float64).T)
    for name, value in more.items():
        storage.write(name, value)
    storage.release()
    return path


def assert_camera(camera: Camera, model: str, D: list[float]) -> None:
    np.testing.assert_array_equal(camera.K, K)
    np.testing.assert_array_equal(camera.distortion, D)
    assert (camera.model, camera.width, camera.height) == (model, 1024, 768)


def problems_of(path: Path) -> tuple[str, ...]:
    with pytest.raises(DatasetError) as refusal:
        read_camera(path)
    assert all(str(path) in problem for problem in refusal.value.problems)
    return refusal.value.problems


@pytest.mark.parametrize(
    ("model", "D"),
    [
        ("plumb_bob", PLUMB_BOB),
        ("plumb_bob", PLUMB_BOB[:4]),
        ("rational_polynomial", RATIONAL),
        ("equidistant", [0.01, 0.02, 0.003, 0.004]),
    ],
)
def test_ros_files_are_read(tmp_path: Path, model: str, D: list[float]) -> None:
    path = write(tmp_path, ros(distortion_model=model, D=D))
    assert_camera(read_camera(path), model, D)


def test_ros_file_of_the_example_is_read() -> None:
    camera = read_camera(EXAMPLE)
    assert (camera.width, camera.height, camera.K[0, 0]) == (1024, 768, 1290.3)
    assert not camera.has_distortion


@pytest.mark.parametrize("suffix", ["yaml", "xml", "json"])
@pytest.mark.parametrize(
    ("model", "D"), [("plumb_bob", PLUMB_BOB), ("rational_polynomial", RATIONAL)]
)
def test_opencv_files_are_read(tmp_path: Path, suffix: str, model: str, D: list[float]) -> None:
    path = write_opencv(tmp_path / f"camera.{suffix}", D)
    assert_camera(read_camera(path), model, D)


def test_opencv_fisheye_flag_makes_the_coefficients_equidistant(tmp_path: Path) -> None:
    D = [0.01, 0.02, 0.003, 0.004]
    path = write_opencv(tmp_path / "camera.yaml", D, fisheye_model=1)
    assert_camera(read_camera(path), "equidistant", D)


def test_opencv_coefficients_that_were_not_fitted_are_left_out(tmp_path: Path) -> None:
    path = write_opencv(tmp_path / "camera.yaml", [*RATIONAL, 0, 0, 0, 0, 0, 0])
    assert_camera(read_camera(path), "rational_polynomial", RATIONAL)


@pytest.mark.parametrize(
    ("name", "model", "D"),
    [("radtan", "plumb_bob", PLUMB_BOB[:4]), ("equidistant", "equidistant", PLUMB_BOB[:4])],
)
def test_kalibr_files_are_read(tmp_path: Path, name: str, model: str, D: list[float]) -> None:
    assert_camera(read_camera(write(tmp_path, kalibr(distortion_model=name))), model, D)


@pytest.mark.parametrize("D", [[], ..., [0.0, 0.0, 0.0, 0.0]])
def test_kalibr_camera_without_distortion_is_read(tmp_path: Path, D: object) -> None:
    path = write(tmp_path, kalibr(distortion_model="none", distortion_coeffs=D))
    assert_camera(read_camera(path), "plumb_bob", [])


def test_skewed_camera_matrix_is_accepted(tmp_path: Path) -> None:
    skewed = [[1290.3, 1.5, 518.3], *K[1:]]
    assert read_camera(write(tmp_path, ros(K=skewed))).K[0, 1] == 1.5


def test_numbers_without_a_point_are_numbers(tmp_path: Path) -> None:
    text = yaml.safe_dump(ros()).replace("0.05", "5e-2")
    np.testing.assert_allclose(read_camera(write(tmp_path, text)).distortion, PLUMB_BOB)


def test_every_problem_is_listed_at_once(tmp_path: Path) -> None:
    singular = [[0.0, 0.0, 518.3], [0.0, -3.0, 900.0], [0.0, 0.0, 1.0]]
    found = problems_of(write(tmp_path, ros(K=singular, D=PLUMB_BOB[:3])))
    assert len(found) == 4
    text = "\n".join(found)
    assert "found 3 coefficients, needed 0 or 4 or 5 for plumb_bob" in text
    assert "fx = 0, so that it is singular" in text
    assert "fy = -3, needed a focal length above 0 px" in text
    assert "cy = 900, needed a principal point inside the image of 1024 x 768 px" in text
    found = problems_of(write(tmp_path, ros(image_width=0, distortion_model="cubic")))
    assert len(found) == 2


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (ros(distortion_model="thin_prism"), "distortion_model .* found 'thin_prism', needed"),
        (ros(distortion_model="equidistant"), "found 5 coefficients, needed 4 for equidistant"),
        (ros(distortion_model="rational_polynomial"), "found 5 coefficients, needed 8"),
        (ros(image_height=-768), "image_height .* found -768, needed a number greater than 0"),
        (ros(image_width=...), "image_width .* found no such key"),
        (ros(K=K[:2]), "camera_matrix .* found 6 numbers in a matrix of 3 x 3, needed 9"),
        (ros(D=["a", 0, 0, 0, 0]), r"distortion_coefficients.data.0 .* found 'a', needed a number"),
        (ros(D=[float("nan"), 0, 0, 0, 0]), "found nan, needed a finite number"),
        (ros(K=[[float("inf"), 0, 5], *K[1:]]), "found inf, needed a finite number"),
        (ros(K=[*K[:2], [0.0, 0.0, 2.0]]), r"needed \[\[fx, s, cx\], \[0, fy, cy\], \[0, 0, 1\]\]"),
        (ros(camera_matrix=7), "camera_matrix .* found 7, needed a mapping"),
        (
            ros(camera_matrix={"rows": 1, "cols": 2, "data": [1, 2]}),
            "found a matrix of 1 x 2, needed 3 x 3",
        ),
        (kalibr(camera_model="omni"), "cam0.camera_model .* found 'omni', needed 'pinhole'"),
        (kalibr(distortion_model="fov"), "cam0.distortion_model .* found 'fov'"),
        (kalibr(distortion_coeffs=[0.1]), "found 1 coefficients, needed 4 for radtan"),
        (kalibr(distortion_model="none"), "found 4 coefficients, needed 0 for none"),
        (kalibr(intrinsics=[1, 2, 3]), r"cam0.intrinsics could .* found 3 numbers"),
        (kalibr(intrinsics=[1290, 1290, 2000, 300]), "cx = 2000, needed a principal point inside"),
        ({**kalibr(), "cam1": kalibr()["cam0"]}, r"found 2 cameras \(cam0, cam1\), needed one"),
        ({"fx": 1, "fy": 2}, "found the keys fx, fy, needed those of a ROS camera_info"),
        ([1, 2], r"found \[1, 2\], needed 'key: value' lines"),
        ("", "found nothing, needed 'key: value' lines"),
        ("a: [1, 2", "line 1, column 9: the camera file could not be read"),
        ("a: 1\nb: 2\na: 3", "line 3, column 1: .* found the key 'a' twice"),
        ("a: !!python/object/apply:os.system [ls]", "could not determine a constructor"),
        ("%YAML:1.0\n---\nimage_width: [[[", "found a storage that OpenCV cannot parse"),
        ("<?xml version='1.0'?><opencv_storage><a>", "found a storage that OpenCV cannot parse"),
        ("%YAML:1.0\n---\nimage_width: 5\n", "camera_matrix .* found no such key"),
        (
            "a: &a [1,1,1,1,1,1,1,1,1]\nb: &b [*a,*a,*a,*a,*a,*a,*a]\nc: &c [*b,*b,*b,*b,*b,*b]\n"
            "d: &d [*c,*c,*c,*c,*c,*c]\ne: &e [*d,*d,*d,*d,*d,*d]\nf: [*e,*e,*e,*e,*e,*e,*e,*e]",
            "found more than 100000 values, some repeated through aliases",
        ),
        ("a: &a [*a]", "found more than 100000 values"),
        ("[" * 5000, "nested too deeply|recursion"),
    ],
)
def test_files_that_are_not_cameras_are_refused(
    tmp_path: Path, content: object, message: str
) -> None:
    with pytest.raises(DatasetError, match=message):
        read_camera(write(tmp_path, content))


def test_opencv_file_with_a_singular_matrix_is_refused(tmp_path: Path) -> None:
    path = write_opencv(tmp_path / "camera.yaml", PLUMB_BOB, np.zeros((3, 3)))
    with pytest.raises(DatasetError, match="fx = 0, so that it is singular"):
        read_camera(path)


def test_missing_file_and_folder_are_refused(tmp_path: Path) -> None:
    with pytest.raises(DatasetError, match="found no such file"):
        read_camera(tmp_path / "none.yaml")
    with pytest.raises(DatasetError, match="found a folder"):
        read_camera(tmp_path)


def test_huge_file_is_refused_unread(tmp_path: Path) -> None:
    path = tmp_path / "camera.yaml"
    path.touch()
    with path.open("r+b") as file:
        file.truncate(10_000_000)
    with pytest.raises(DatasetError, match="found 10000000 bytes, needed at most"):
        read_camera(path)


def test_bytes_that_are_not_text_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "camera.yaml"
    path.write_bytes(b"a: \xff\xfe\xfd")
    with pytest.raises(DatasetError, match="needed YAML text in UTF-8"):
        read_camera(path)
    path.write_bytes(b"%YAML:1.0\n# \xff")
    with pytest.raises(DatasetError, match="not UTF-8"):
        read_camera(path)


def test_json_of_opencv_is_told_by_its_matrices(tmp_path: Path) -> None:
    path = write_opencv(tmp_path / "camera.json", PLUMB_BOB)
    assert json.loads(path.read_text())["camera_matrix"]["type_id"] == "opencv-matrix"
    assert_camera(read_camera(path), "plumb_bob", PLUMB_BOB)
