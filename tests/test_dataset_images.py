"""Image files: every kind that is accepted, and every fault that is found before any work."""

import struct
import zlib
from pathlib import Path

import cv2
import numpy as np
import pytest
from dataset_folder import SIZE, Folder, folder

from legcal.data.dataset import load_dataset
from legcal.errors import DatasetError
from legcal.geometry.types import Image
from legcal.vision.camera import Camera
from legcal.vision.image_file import image_problem, image_size, read_image

__all__ = ["folder"]

W, H = SIZE
CAMERA = Camera(np.array([[80.0, 0, 32], [0, 80, 24], [0, 0, 1]]), W, H)


def picture(dtype: type = np.uint8, channels: int = 1) -> Image:
    """A smooth picture, brightest at the top right."""
    x, y = np.meshgrid(np.linspace(0.1, 0.9, W), np.linspace(1.0, 0.5, H))
    grey = x * y * np.iinfo(dtype).max
    shades = [grey, 0.5 * grey, 0.25 * grey, np.full_like(grey, np.iinfo(dtype).max)]
    return np.stack(shades[:channels], axis=-1).squeeze().astype(dtype)


def write(path: Path, image: Image, *options: int) -> Path:
    assert cv2.imwrite(str(path), image, list(options))
    return path


@pytest.mark.parametrize("name", ["a.png", "a.jpg", "a.tif"])
def test_8_bit_grey_levels_are_read_as_they_are(tmp_path: Path, name: str) -> None:
    levels = read_image(write(tmp_path / name, picture()), CAMERA)
    assert levels.shape == (H, W)
    assert levels.dtype == np.float32
    np.testing.assert_allclose(levels, picture(), atol=4.0 if name == "a.jpg" else 0.0)


@pytest.mark.parametrize("name", ["a.png", "a.tif"])
def test_16_bit_grey_levels_keep_their_fractions_on_the_same_scale(
    tmp_path: Path, name: str
) -> None:
    levels = read_image(write(tmp_path / name, picture(np.uint16)), CAMERA)
    np.testing.assert_allclose(levels, picture(np.uint16) / 257.0, rtol=1e-6)
    assert levels.max() < 256.0


@pytest.mark.parametrize("name", ["a.png", "a.tif"])
def test_data_of_12_bits_in_files_of_16_fill_the_scale(tmp_path: Path, name: str) -> None:
    full = 2**12 - 1
    image = np.clip(picture(np.uint16) >> 4, 1, full)
    image[0, :3] = full  # saturated
    levels = read_image(write(tmp_path / name, image), CAMERA)
    np.testing.assert_allclose(levels, image * (255.0 / full), rtol=1e-6)


@pytest.mark.parametrize("bits", [10, 12])
def test_data_in_the_upper_of_16_bits_are_not_brightened(tmp_path: Path, bits: int) -> None:
    """Dark data of 12 bits, moved up by 4, are as dark as they were."""
    image = (picture(np.uint16) >> 20 - bits) << (16 - bits)
    levels = read_image(write(tmp_path / "a.png", image), CAMERA)
    np.testing.assert_allclose(levels, image / 257.0, rtol=1e-6)


@pytest.mark.parametrize("name", ["a.png", "a.jpg", "a.tif"])
@pytest.mark.parametrize("channels", [3, 4])
def test_colours_are_read_as_their_grey(tmp_path: Path, name: str, channels: int) -> None:
    colours = picture(channels=3 if name == "a.jpg" else channels)
    levels = read_image(write(tmp_path / name, colours), CAMERA)
    grey = colours[..., :3] @ [0.114, 0.587, 0.299]
    np.testing.assert_allclose(levels, grey, atol=4.0 if name == "a.jpg" else 0.6)


def test_16_bit_colours_are_read_as_their_grey(tmp_path: Path) -> None:
    colours = picture(np.uint16, channels=3)
    levels = read_image(write(tmp_path / "a.png", colours), CAMERA)
    np.testing.assert_allclose(levels, colours @ [0.114, 0.587, 0.299] / 257.0, rtol=1e-4)


@pytest.mark.parametrize(
    "options",
    [
        (cv2.IMWRITE_JPEG_PROGRESSIVE, 1),
        (cv2.IMWRITE_JPEG_RST_INTERVAL, 2),
        (cv2.IMWRITE_JPEG_OPTIMIZE, 1, cv2.IMWRITE_JPEG_QUALITY, 100),
    ],
)
def test_every_kind_of_jpeg_is_complete_when_it_is(
    tmp_path: Path, options: tuple[int, ...]
) -> None:
    noise = np.random.default_rng(1).integers(0, 255, (H, W), dtype=np.uint8)
    path = write(tmp_path / "a.jpg", noise, *options)
    assert image_problem(path, CAMERA) is None
    content = path.read_bytes()
    assert image_size(content + b"thumbnails and padding").width == W
    for end in range(1, len(content), 7):
        with pytest.raises(ValueError, match=r"cut off|none of these"):
            image_size(content[:end])


@pytest.mark.parametrize("name", ["a.png", "a.tif"])
def test_every_cut_of_a_file_is_found(tmp_path: Path, name: str) -> None:
    noise = np.random.default_rng(1).integers(0, 255, (H, W), dtype=np.uint8)
    content = write(tmp_path / name, noise).read_bytes()
    for end in range(0, len(content) - 1, 7):
        with pytest.raises(ValueError, match=r"cut off|none of these|an empty file"):
            image_size(content[:end])


def test_file_whose_end_was_never_written_is_found(tmp_path: Path) -> None:
    content = write(tmp_path / "a.jpg", picture()).read_bytes()
    half = len(content) // 2
    with pytest.raises(ValueError, match="without its end marker"):
        image_size(content[:half] + bytes(len(content) - half))


def test_end_marker_of_a_thumbnail_is_not_that_of_the_picture(tmp_path: Path) -> None:
    content = write(tmp_path / "a.jpg", picture()).read_bytes()
    thumbnail = b"\xff\xe1" + struct.pack(">H", len(content) + 2) + content
    whole = content[:2] + thumbnail + content[2:]
    assert image_size(whole).height == H
    with pytest.raises(ValueError, match="without its end marker"):
        image_size(whole[:-2])


def test_damaged_png_is_found(tmp_path: Path) -> None:
    content = bytearray(write(tmp_path / "a.png", picture()).read_bytes())
    content[60] ^= 0xFF
    with pytest.raises(ValueError, match="chunk has a wrong checksum"):
        image_size(bytes(content))


def test_orientation_in_the_exif_data_does_not_turn_the_pixels(tmp_path: Path) -> None:
    path = write(tmp_path / "a.jpg", picture(), cv2.IMWRITE_JPEG_QUALITY, 100)
    content = path.read_bytes()
    tiff = b"II*\0\x08\0\0\0\x01\0\x12\x01\x03\0\x01\0\0\0\x06\0\0\0\0\0\0\0"
    exif = b"Exif\0\0" + tiff
    segment = b"\xff\xe1" + struct.pack(">H", len(exif) + 2) + exif
    path.write_bytes(content[:2] + segment + content[2:])
    turned = cv2.imread(str(path), cv2.IMREAD_GRAYSCALE)
    assert turned is not None
    assert turned.shape == (W, H)
    np.testing.assert_allclose(read_image(path, CAMERA), picture(), atol=4.0)


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (b"", "found an empty file"),
        (b"GIF89a", "found a file that is none of these, needed a complete PNG, JPEG or TIFF"),
        (b"\xff\xd8\xff\xd9", "found a JPEG without a picture"),
        (b"\xff\xd8\xff\xe0", "found a JPEG cut off|found a file cut off"),
        (b"II*\0\x08" + bytes(9), "found a TIFF without a picture"),
        (b"II*\0\xff\xff\xff\xff", "found a file cut off after 8 bytes"),
    ],
)
def test_files_that_are_no_pictures_are_refused(
    tmp_path: Path, content: bytes, message: str
) -> None:
    path = tmp_path / "a.jpg"
    path.write_bytes(content)
    with pytest.raises(DatasetError, match=message):
        read_image(path, CAMERA)


def test_picture_that_cannot_be_decoded_is_refused_quietly(
    tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    level = cv2.utils.logging.getLogLevel()

    def chunk(kind: bytes, body: bytes) -> bytes:
        checksum = struct.pack(">I", zlib.crc32(kind + body))
        return struct.pack(">I", len(body)) + kind + body + checksum

    header = chunk(b"IHDR", struct.pack(">IIBBBBB", W, H, 8, 0, 0, 0, 0))
    path = tmp_path / "a.png"
    path.write_bytes(b"\x89PNG\r\n\x1a\n" + header + chunk(b"IDAT", b"junk") + chunk(b"IEND", b""))
    with pytest.raises(DatasetError, match=r"row 3: image .* found data that cannot be decoded"):
        read_image(path, CAMERA, "table, row 3")
    assert cv2.utils.logging.getLogLevel() == level
    assert "OpenCV" not in capfd.readouterr().err


def test_floating_point_picture_is_refused(tmp_path: Path) -> None:
    path = write(tmp_path / "a.tif", picture().astype(np.float32))
    with pytest.raises(DatasetError, match="found float32 pixels, needed 8 or 16 bit"):
        read_image(path, CAMERA)


@pytest.mark.parametrize("name", ["a.png", "a.jpg", "a.tif"])
def test_picture_of_another_size_is_refused(tmp_path: Path, name: str) -> None:
    path = write(tmp_path / name, picture().T.copy())
    with pytest.raises(DatasetError, match="found 48 x 64 px, needed 64 x 48 px as in its camera"):
        read_image(path, CAMERA)


def test_all_bad_images_of_a_dataset_are_listed_at_once(folder: Folder) -> None:
    images = folder.path / "images"
    (images / "c1_1.png").unlink()
    (images / "c1_2.png").write_bytes((images / "c1_2.png").read_bytes()[:-30])
    write(images / "c2_1.png", picture()[:, :-1])
    (images / "c2_2.png").write_text("a text")
    with pytest.raises(DatasetError) as refusal:
        load_dataset(folder.path)
    expected = ("no such file", "cut off", "63 x 48 px", "none of these")
    for row, problem in enumerate(refusal.value.problems):
        assert f"measurements.csv, row {row + 1}: image " in problem
        assert expected[row] in problem
    assert len(refusal.value.problems) == 4
    dataset = load_dataset(folder.path, check_images=False)
    with pytest.raises(DatasetError, match=r"row 2: image .*c1_2\.png could not be read"):
        dataset.read_image(1)


def test_row_without_an_image_cannot_be_read(folder: Folder) -> None:
    folder.rows[1]["image"] = ""
    folder.write()
    dataset = load_dataset(folder.path, check_images=False)
    assert dataset.image_path(1) is None
    with pytest.raises(DatasetError, match="row 2: its image could not be read: found an empty"):
        dataset.read_image(1)
