"""The dataset folder: dataset.yaml, measurements.csv and image files, read and refused.

Refusals of single cells and keys are in tests/refusal_table.py; here are those that
Python alone shows, and every kind and every fault of an image file.
"""

from pathlib import Path

import cv2
import numpy as np
import pytest
from dataset_folder import JOINTS, SIZE, Folder, folder, readings
from photograph_files import exif, jpeg
from scipy.spatial.transform import RigidTransform

from legcal.data.dataset import load_dataset
from legcal.data.measurements import Measurements
from legcal.errors import DatasetError
from legcal.geometry.types import Image
from legcal.vision.camera import Camera
from legcal.vision.image_file import BadImage, image_size, inspect_image, read_image

__all__ = ["folder"]

W, H = SIZE
CAMERA = Camera(np.array([[80.0, 0, 32], [0, 80, 24], [0, 0, 1]]), W, H)


def read(folder: Folder) -> Measurements:
    folder.write()
    return load_dataset(folder.path).measurements


# --- dataset.yaml


def test_a_dataset_is_named_by_its_folder_or_its_file(
    folder: Folder, monkeypatch: pytest.MonkeyPatch
) -> None:
    expected = load_dataset(folder.path)
    assert load_dataset(folder.path / "dataset.yaml").folder == expected.folder == folder.path
    monkeypatch.chdir(folder.path)
    for name in (".", "dataset.yaml"):
        np.testing.assert_array_equal(load_dataset(name).measurements.q, expected.measurements.q)


def test_empty_columns_at_the_end_of_a_table_are_none(folder: Folder) -> None:
    expected, table = read(folder).q, folder.path / "measurements.csv"
    table.write_text("".join(f"{line},,\n" for line in table.read_text().splitlines()))
    np.testing.assert_array_equal(load_dataset(folder.path).measurements.q, expected)


def test_cameras_in_millimetres_are_taken_so_and_said(folder: Folder) -> None:
    near = read(folder).views[0].T_base_camera
    assert near is not None
    hint = folder.entry["views"]["c1"]["T_base_camera"]
    hint["xyz"] = [1e3 * x for x in hint["xyz"]]
    folder.write()
    dataset = load_dataset(folder.path)
    T = dataset.measurements.views[0].T_base_camera
    assert T is not None
    np.testing.assert_allclose(T.as_matrix(), near.as_matrix(), atol=1e-12)
    assert [note for note in dataset.notes if "view c1" in note and "millimetres" in note]


def test_views_keep_their_camera_pose_and_legs(folder: Folder) -> None:
    folder.entry["views"]["c1"]["T_base_camera"]["quat_xyzw"] = [0.0, 0.0, 0.7071, 0.7071]
    folder.entry["views"]["c9"] = {"camera": "camera_info.yaml"}
    folder.write()
    dataset = load_dataset(folder.path)
    c1, c2, _ = dataset.measurements.views
    assert (c1.name, c1.legs, c2.name, c2.legs) == ("c1", None, "c2", ("leg1", "leg4"))
    assert (c1.camera.width, c1.camera.height) == SIZE
    assert isinstance(c1.T_base_camera, RigidTransform)
    half = np.sqrt(0.5)  # a rounded quaternion is made unit
    np.testing.assert_allclose(c1.T_base_camera.rotation.as_quat(), [0, 0, half, half])
    assert c2.T_base_camera is None
    (note,) = dataset.notes
    assert "view c9 has no row" in note


# --- measurements.csv


@pytest.mark.parametrize("mark", [b"", b"\xef\xbb\xbf"])
@pytest.mark.parametrize("end", [b"\n", b"\r\n"])
def test_columns_are_found_by_name_in_any_text_format(
    folder: Folder, mark: bytes, end: bytes
) -> None:
    folder.columns = [JOINTS[3], "image", *JOINTS[:3], "view", *JOINTS[4:]]
    folder.write()
    path = folder.path / "measurements.csv"
    path.write_bytes(mark + path.read_bytes().replace(b"\n", end) + b" , ,,,,,," + end)
    measurements = load_dataset(folder.path).measurements
    np.testing.assert_array_equal(measurements.q, [readings(seed) for seed in range(4)])
    assert measurements.image[2] == "images/c2_1.png"
    np.testing.assert_array_equal(measurements.view, [0, 0, 1, 1])
    np.testing.assert_array_equal(measurements.pose, [0, 1, 2, 3])  # no labels: own poses
    assert measurements.pose_labels == ()


def test_rows_of_one_label_share_a_pose_and_the_mean_reading(folder: Folder) -> None:
    folder.columns.append("pose")
    for row, label in zip(folder.rows, ["b", "", "b", ""], strict=True):
        row["pose"] = label
    folder.rows[2].update(dict(zip(JOINTS, readings(0), strict=True)))
    folder.rows[2][JOINTS[1]] += 4e-6
    measurements = read(folder)
    np.testing.assert_array_equal(measurements.pose, [0, 1, 0, 2])
    assert measurements.pose_labels == ("b", "", "")
    np.testing.assert_array_equal(measurements.q[0], measurements.q[2])
    assert measurements.q[0, 1] == pytest.approx(readings(0)[1] + 2e-6, abs=1e-12)
    np.testing.assert_allclose(measurements.q[0, 2:], readings(0)[2:], rtol=1e-15)
    folder.rows[2][JOINTS[2]] += 1e-4
    with pytest.raises(DatasetError, match=r"row 1 .*leg3_prismatic: the pose b .* 0.0001 m"):
        read(folder)


def test_readings_from_another_zero_and_still_encoders_are_called_so(folder: Folder) -> None:
    for row in folder.rows:
        row[JOINTS[2]] = 0.07
    folder.write()
    (note,) = load_dataset(folder.path).notes
    assert "the same reading in all rows of leg3_prismatic" in note
    for row in folder.rows:
        row.update({name: row[name] + 0.21 for name in JOINTS})
    folder.write()
    with pytest.raises(DatasetError, match="from another zero") as refusal:
        load_dataset(folder.path)
    assert "inches" not in str(refusal.value)


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_a_reading_outside_the_travel_is_noted_or_refused(folder: Folder, sign: float) -> None:
    end, travel = (0.144 if sign > 0.0 else -0.004), 0.148
    folder.rows[1][JOINTS[0]] = end + sign * 0.0005 * travel  # noise, as at an end of the travel
    folder.write()
    assert not load_dataset(folder.path).notes
    folder.rows[1][JOINTS[0]] = end + sign * 0.04 * travel
    folder.write()
    (note,) = load_dataset(folder.path).notes
    assert "leg1_prismatic" in note
    assert f"{end + sign * 0.04 * travel:g} m in row 2 (line 3)" in note
    for part in (0.06, 3.0):  # one reading far outside does not make its column millimetres
        folder.rows[1][JOINTS[0]] = end + sign * part * travel
        folder.write()
        with pytest.raises(DatasetError, match="leg1_prismatic: readings are outside") as refusal:
            load_dataset(folder.path)
        for word in ("row 2 (line 3), needed -0.004 to 0.144 m", "correct the readings or"):
            assert word in str(refusal.value)


def test_links_are_followed_inside_the_folder_and_not_out_of_it(folder: Folder) -> None:
    (folder.path / "linked").symlink_to(folder.path / "images")
    folder.rows[0]["image"] = "linked/c1_1.png"
    assert read(folder).n_rows == 4
    (folder.path.parent / "other").mkdir()
    (folder.path / "away").symlink_to(folder.path.parent / "other")
    folder.rows[0]["image"] = "away/a.png"
    with pytest.raises(DatasetError, match=r"row 1 .*leads out of the dataset folder"):
        read(folder)


def test_an_image_that_was_not_checked_is_refused_where_it_is_read(folder: Folder) -> None:
    path = folder.path / "images/c1_2.png"
    path.write_bytes(path.read_bytes()[:-30])
    folder.rows[3]["image"] = ""
    dataset = load_dataset(folder.write(), check_images=False)
    assert dataset.image_path(3) is None
    for row, words in ((1, r"image .*c1_2\.png could not be read"), (3, "found an empty cell")):
        with pytest.raises(DatasetError, match=f"row {row + 1}: .*{words}"):
            dataset.image_reader([row])(0)


# --- image files


def picture(dtype: type = np.uint8, channels: int = 1) -> Image:
    """Return a smooth picture, brightest at the top right."""
    x, y = np.meshgrid(np.linspace(0.1, 0.9, W), np.linspace(1.0, 0.5, H))
    grey = x * y * np.iinfo(dtype).max
    shades = [grey, 0.5 * grey, 0.25 * grey, np.full_like(grey, np.iinfo(dtype).max)]
    return np.stack(shades[:channels], axis=-1).squeeze().astype(dtype)


def write(path: Path, image: Image, *options: int) -> Path:
    assert cv2.imwrite(str(path), image, list(options))
    return path


@pytest.mark.parametrize("name", ["a.png", "a.jpg", "a.tif"])
@pytest.mark.parametrize("channels", [1, 3, 4])
def test_8_bit_images_are_read_as_their_grey(tmp_path: Path, name: str, channels: int) -> None:
    colours = picture(channels=min(channels, 3) if name == "a.jpg" else channels)
    levels = read_image(write(tmp_path / name, colours), CAMERA)
    assert levels.shape == (H, W)
    assert levels.dtype == np.float32
    grey = colours if channels == 1 else colours[..., :3] @ [0.114, 0.587, 0.299]
    rounding = 0.0 if channels == 1 else 0.6
    np.testing.assert_allclose(levels, grey, atol=4.0 if name == "a.jpg" else rounding)


@pytest.mark.parametrize("name", ["a.png", "a.tif"])
def test_16_bit_images_keep_their_fractions_on_the_same_scale(tmp_path: Path, name: str) -> None:
    levels = read_image(write(tmp_path / name, picture(np.uint16)), CAMERA)
    np.testing.assert_allclose(levels, picture(np.uint16) / 257.0, rtol=1e-6)
    colours = picture(np.uint16, channels=3)
    levels = read_image(write(tmp_path / name, colours), CAMERA)
    np.testing.assert_allclose(levels, colours @ [0.114, 0.587, 0.299] / 257.0, rtol=1e-4)
    full = 2**12 - 1  # data of 12 bits fill the scale,
    image = np.clip(picture(np.uint16) >> 4, 1, full)
    image[0, :3] = full  # saturated
    levels = read_image(write(tmp_path / name, image), CAMERA)
    np.testing.assert_allclose(levels, image * (255.0 / full), rtol=1e-6)
    for bits in (10, 12):  # and in the upper of 16 bits they are as dark as they were
        image = (picture(np.uint16) >> 20 - bits) << (16 - bits)
        levels = read_image(write(tmp_path / name, image), CAMERA)
        np.testing.assert_allclose(levels, image / 257.0, rtol=1e-6)


@pytest.mark.parametrize(
    ("name", "options"),
    [
        ("a.png", ()),
        ("a.tif", ()),
        ("a.jpg", (cv2.IMWRITE_JPEG_PROGRESSIVE, 1)),
        ("a.jpg", (cv2.IMWRITE_JPEG_RST_INTERVAL, 2)),
        ("a.jpg", (cv2.IMWRITE_JPEG_OPTIMIZE, 1, cv2.IMWRITE_JPEG_QUALITY, 100)),
    ],
)
def test_every_cut_of_a_file_is_found(tmp_path: Path, name: str, options: tuple[int, ...]) -> None:
    noise = np.random.default_rng(1).integers(0, 255, (H, W), dtype=np.uint8)
    path = write(tmp_path / name, noise, *options)
    assert inspect_image(path, CAMERA)[1] is None
    content = path.read_bytes()
    if name == "a.jpg":
        assert image_size(content + b"thumbnails and padding").width == W
    for end in range(0, len(content) - 1, 13):
        with pytest.raises(BadImage):
            image_size(content[:end])


def test_orientation_in_the_exif_data_does_not_turn_the_pixels(tmp_path: Path) -> None:
    path = tmp_path / "a.jpg"
    path.write_bytes(jpeg(picture(), 100, exif(orientation=6)))
    turned = cv2.imread(str(path), cv2.IMREAD_GRAYSCALE)
    assert turned is not None
    assert turned.shape == (W, H)
    np.testing.assert_allclose(read_image(path, CAMERA), picture(), atol=4.0)
