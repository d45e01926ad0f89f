"""What files of photographs say of how they were made, and what is said where it contradicts."""

from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import yaml
from camera_sessions import PINHOLE, drawings
from dataset_folder import SIZE, Folder, folder
from fuzzing.mutations import mutate
from photograph_files import exif, jpeg, png, tiff

from legcal import calibrate, calibrate_camera, load_dataset
from legcal.data.photograph_notes import compression_notes
from legcal.errors import DatasetError, NotVisible, Place
from legcal.vision.camera import Camera
from legcal.vision.camera_file import read_camera
from legcal.vision.image_file import (
    ImageFacts,
    decode_image,
    inspect_image,
    read_facts,
)

__all__ = ["folder"]

PICTURE = np.random.default_rng(0).integers(0, 255, (SIZE[1], SIZE[0]), dtype=np.uint8)
PHONE: dict[str, Any] = {
    "make": "Acme", "model": "Acme One", "orientation": 1, "software": "17.1", "exposure": 0.01,
    "focus": 0.5, "focal": 4.25, "width": SIZE[0], "height": SIZE[1], "zoom": 1.0, "focal35": 26,
    "serial": "A1", "lens": "Acme back camera", "taken": "2026:11:23 10:15:00",
}  # fmt: skip
NAMES = [f"images/{view}_{k}.jpg" for view in ("c1", "c2") for k in (1, 2)]
CAMERA = Camera(np.array([[80.0, 0.0, 32.0], [0.0, 80.0, 24.0], [0.0, 0.0, 1.0]]), *SIZE)


# What is read


def test_the_quality_of_a_jpeg_is_found() -> None:
    for quality in range(20, 100):
        assert read_facts(jpeg(PICTURE, quality)).jpeg_quality == quality
    assert read_facts(jpeg(np.dstack([PICTURE] * 3), 60)).jpeg_quality == 60


@pytest.mark.parametrize(
    "content", [png(PICTURE), tiff(PICTURE), tiff(PICTURE, 7), b"", b"II*\0", b"\xff\xd8\xff"]
)
def test_files_that_say_nothing_have_no_facts(content: bytes) -> None:
    assert read_facts(content) == ImageFacts()


@pytest.mark.parametrize("order", ["<", ">"])
def test_facts_are_those_that_were_written(order: str) -> None:
    block = exif(order, **PHONE)
    expected = {
        "device": "Acme One", "serial": "A1", "lens": "Acme back camera", "software": "17.1",
        "focal_length": 4.25, "focal_length_35mm": 26.0, "focus_distance": 0.5,
        "digital_zoom": 1.0, "orientation": 1, "taken_size": SIZE,
        "taken_at": "2026:11:23 10:15:00",
    }  # fmt: skip
    for content in (jpeg(PICTURE, 90, block), png(PICTURE, block), block):
        found = read_facts(content)
        assert {name: getattr(found, name) for name in expected} == expected
    assert read_facts(exif(order, focal=np.float64(4.25))).focal_length == 4.25
    assert read_facts(exif(order, focal=np.float64("inf"))).focal_length is None
    other = exif(order, make="Acme", model="Two", zoom=0.0, focal=0.0, orientation=9)
    found = read_facts(jpeg(PICTURE, 90, other))
    assert (found.device, found.digital_zoom) == ("Acme Two", 1.0)
    assert found.focal_length is found.orientation is None
    escape = read_facts(jpeg(PICTURE, 90, exif(order, model="\x1b[31m\u202ered" + "x" * 999)))
    assert len(escape.device) < 100
    assert escape.device.isprintable()


def test_damaged_files_never_raise_and_say_little() -> None:
    block = exif(**PHONE)
    contents = [jpeg(PICTURE, 90, block), png(PICTURE, block, Title="a"), block]
    chance = np.random.default_rng(3)
    for k in range(500):
        facts = read_facts(mutate(contents[k % 3], "jpg", chance))
        assert (facts.device + facts.lens + facts.software + "x").isprintable()
        for number in (facts.focal_length, facts.focus_distance, facts.digital_zoom):
            assert number is None or 0.0 < number <= 1e5


# What is refused


def _damaged_png() -> bytes:
    content = bytearray(png(PICTURE))
    content[60] ^= 0xFF
    return bytes(content)


SMALL = np.resize(PICTURE, (24, 32))
REFUSED: tuple[tuple[bytes, list[str]], ...] = (
    (b"\xff\xd8\xff\xd9", ["a JPEG file of 4 bytes", "cut off", "copy it again"]),
    (tiff(PICTURE)[:2000], ["TIFF", "cut off"]),
    (_damaged_png(), ["PNG", "damaged"]),
    (tiff(PICTURE.astype(np.float32)), ["a TIFF of 32 bit pixels", "8 or 16 bit"]),
    (b"\0\0\0\x18ftypheic" + bytes(200), ["HEIC", "magick", "JPEG"]),
    (jpeg(PICTURE.reshape(SIZE)), ["48 x 64 px", "turned by a quarter turn", "64 x 48 px"]),
    (jpeg(PICTURE.reshape(SIZE), block=exif(orientation=6)), ["EXIF orientation 6"]),
    (jpeg(SMALL), ["32 x 24 px", "rescaled by 0.5"]),
    (jpeg(np.resize(PICTURE, (128, 96))), ["96 x 128 px", "turned and rescaled by 2"]),
    (jpeg(PICTURE[:40]), ["64 x 40 px", "cropped"]),
    (jpeg(SMALL, block=exif(width=64, height=48)), ["taken with 64 x 48 px"]),
    (png(np.zeros((1, 30_001), np.uint8)), ["30001 x 1 px", "at most 30000 px a side"]),
)  # fmt: skip


@pytest.mark.parametrize(("content", "words"), REFUSED)
def test_a_file_that_cannot_be_used_is_refused_in_one_sentence(
    content: bytes, words: list[str], tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    level = cv2.utils.logging.getLogLevel()
    path = tmp_path / "a.jpg"
    path.write_bytes(content)
    with pytest.raises(DatasetError) as refused:
        decode_image(path, CAMERA, Place("table", 3))
    (sentence,) = refused.value.problems
    assert [w for w in ("table, row 3: image", "a.jpg", *words) if w not in sentence] == []
    assert str(inspect_image(path, CAMERA, Place("table", 3))[1]) == sentence
    assert cv2.utils.logging.getLogLevel() == level
    assert capfd.readouterr().err == ""


# What is said of a dataset


def notes(
    folder: Folder, files: dict[int, bytes], board: dict[str, Any] | None = None
) -> list[str]:
    """Return the notes on photographs of which some are others than those of the phone."""
    for k, (row, name) in enumerate(zip(folder.rows, NAMES, strict=True)):
        row["image"] = name
        (folder.path / name).write_bytes(files.get(k, jpeg(PICTURE, 95, exif(**PHONE))))
    if board is not None:
        folder.camera["legcal_camera"] = {"version": 1, "sigma": {}, "photographs": board}
    folder.write()
    return list(load_dataset(folder.path).notes)


def phone(**others: Any) -> bytes:
    return jpeg(PICTURE, 95, exif(**PHONE | others))


ONE = [NAMES[1]]  # the image that differs
DIFFERENT: tuple[tuple[bytes, list[str]], ...] = (
    (phone(model="Acme Two"), ["'Acme Two'", "'Acme One'", "one camera"]),
    (phone(serial="B2"), ["'B2'", "'A1'", "one camera"]),
    (phone(lens="Acme front camera"), ["front camera", "back camera", "one lens"]),
    (phone(focal=6.0), ["6 mm", "4.25 mm", "one focal length"]),
    (phone(focal35=52), ["52 mm", "26 mm", "one field of view"]),
    (phone(zoom=2.0), ["digital zoom of 2", "digital zoom of 1", "one digital zoom"]),
    (phone(focus=2.0), ["2 m", "0.5 m", "one focus"]),
    (phone(width=80, height=48), ["80 x 48 px and cropped"]),
    (phone(width=48, height=64), ["48 x 64 px and turned"]),
    (phone(width=128, height=96), ["128 x 96 px and rescaled by 0.5", "of the size"]),
    (phone(software="Adobe Lightroom 6.0"), ["'Adobe Lightroom 6.0'", "'17.1'", "processing"]),
    (phone(orientation=6), ["turned by 90 deg", "stands still"]),
    (phone(software="Screenshot"), ["'Screenshot'", "'17.1'"]),
    # what moves no edge is not spoken of
    (phone(exposure=0.5), []),
    (phone(software="17.4"), []),
    (phone(focal35=27), []),
    (phone(focus=0.51), []),
    (jpeg(PICTURE, 60, exif(**PHONE)), []),
    (phone() + b"a video behind the picture", []),
)


@pytest.mark.parametrize(("content", "words"), DIFFERENT)
def test_an_image_unlike_the_others_is_named_with_the_difference(
    folder: Folder, content: bytes, words: list[str]
) -> None:
    found = notes(folder, {1: content})
    assert len(found) == bool(words)
    assert all(word in note for note in found for word in (*ONE, *words))


def test_a_refusal_names_what_may_be_its_cause(folder: Folder) -> None:
    del folder.entry["views"]["c2"]["legs"]
    (note,) = notes(folder, {1: phone(zoom=2.0)})
    with pytest.raises(NotVisible) as refused:
        calibrate(folder.path)
    assert len(refused.value.problems) > 1
    assert refused.value.notes == (note,)


RECORDED = {"device": ["Acme One"], "focal_length_mm": [4.25], "focal_length_35mm": [26.0],
            "digital_zoom": [1.0], "software": ["16.0"], "taken_size": [list(SIZE)]}  # fmt: skip


@pytest.mark.parametrize(
    ("board", "words"),
    [
        ({"device": ["Acme Two"]}, ["'Acme One'", "'Acme Two'"]),
        ({"focal_length_mm": [6.0]}, ["4.25 mm", "6 mm"]),
        ({"digital_zoom": [2.0]}, ["digital zoom of 1", "digital zoom of 2"]),
        ({"taken_size": [[128, 96]]}, ["of the size", "128 x 96 px and rescaled by 0.5"]),
        ({"software": ["GIMP 2.10"]}, ["'17.1'", "'GIMP 2.10'"]),
        ({}, []),
        ({"orientation": [6], "jpeg_quality": [40], "format": ["PNG"]}, []),
    ],
)
def test_photographs_unlike_those_of_the_board_are_named(
    folder: Folder, board: dict[str, Any], words: list[str]
) -> None:
    found = notes(folder, {}, RECORDED | board)
    assert len(found) == bool(words)
    for word in [*words, *NAMES[:3], "camera_info.yaml", "views c1, c2"] if words else []:
        assert word in found[0]


def test_lossy_compression_is_noted_once_with_views_and_quality(folder: Folder) -> None:
    def note(*qualities: int) -> list[str]:
        assert notes(folder, dict(enumerate(jpeg(PICTURE, q) for q in qualities))) == []
        dataset = load_dataset(folder.path)
        return compression_notes(dataset.measurements, dataset.facts)

    assert note(95, 95, 100, 97) == []
    (both,) = note(75, 80, 75, 75)
    assert [w for w in ("views c1, c2", "quality 75 or so", "95 or more") if w not in both] == []
    (one,) = note(95, 95, 60, 80)
    assert "quality 60 or so in photographs of view c2" in one


# The camera


def test_the_camera_file_records_its_photographs(tmp_path: Path) -> None:
    (tmp_path / "photographs").mkdir()
    for k, path in enumerate(drawings(tmp_path, PINHOLE, 3)):
        image = np.asarray(cv2.imread(str(path), cv2.IMREAD_UNCHANGED))
        said = PHONE | {"width": image.shape[1], "height": image.shape[0]}
        (tmp_path / f"photographs/b{k}.jpg").write_bytes(jpeg(image, 92, exif(**said)))
    found = calibrate_camera(
        tmp_path / "photographs", "chessboard:9x6:30mm", output=tmp_path / "camera.yaml"
    )
    assert not [w for w in found.warnings if "No one camera" in w]
    block = yaml.safe_load((tmp_path / "camera.yaml").read_text())["legcal_camera"]
    assert block["photographs"] == {
        "device": ["Acme One"], "serial": ["A1"], "lens": ["Acme back camera"],
        "focal_length_mm": [4.25], "focal_length_35mm": [26.0], "digital_zoom": [1.0],
        "focus_distance_m": [0.5],
        "taken_size": [[448, 336]], "software": ["17.1"],
    }  # fmt: skip
    camera = read_camera(tmp_path / "camera.yaml")
    assert camera.photographs["focal_length_mm"] == [4.25]
    assert camera.photographs["taken_size"] == [(448, 336)]
