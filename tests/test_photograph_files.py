"""What files of photographs say of how they were made, and what is said where it contradicts."""

from collections.abc import Callable
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
from legcal.calibration.diagnosis.diagnosis import Diagnosis
from legcal.data.photograph_notes import compression_note
from legcal.errors import DatasetError, NotVisible
from legcal.vision.camera_file import read_camera
from legcal.vision.image_facts import ImageFacts, read_facts

__all__ = ["folder"]

PICTURE = np.random.default_rng(0).integers(0, 255, (SIZE[1], SIZE[0]), dtype=np.uint8)
COMMENT = b"ASCII\0\0\0"
PHONE: dict[str, Any] = {
    "make": "Acme", "model": "Acme One", "orientation": 1, "software": "17.1", "exposure": 0.01,
    "focus": 0.5, "focal": 4.25, "width": SIZE[0], "height": SIZE[1], "zoom": 1.0, "focal35": 26,
    "serial": "A1", "lens": "Acme back camera",
}  # fmt: skip
NAMES = [f"images/{view}_{k}.jpg" for view in ("c1", "c2") for k in (1, 2)]
PORTRAIT = (
    b"<rdf:li>com.google.android.apps.camera.gallery.specialtype.SpecialType-PORTRAIT</rdf:li>"
)
XIAOMI = (
    b"<rdf:Description MiCamera:XMPMeta=\"&lt;?xml version='1.0'?&gt;&lt;%s=&quot;1&quot; /&gt;\"/>"
)
SAMSUNG = b"\0\0\xb1\x0a\x13\0\0\0%s" + bytes(99) + b"SEFHj\0\0\0SEFT"
XMP = b'<rdf:Description crs:LensProfileEnable="%d" crs:HasCrop="%s"/>'


# What is read


def test_the_quality_of_every_jpeg_is_found() -> None:
    for quality in range(1, 101):
        assert read_facts(jpeg(PICTURE, quality)).jpeg_quality == quality
    colours = np.dstack([PICTURE] * 3)
    assert read_facts(jpeg(colours, 60)).jpeg_quality == 60
    inside = read_facts(tiff(colours, 7))
    assert inside.is_lossy
    assert 1 <= (inside.jpeg_quality or 0) < 100


@pytest.mark.parametrize("content", [png(PICTURE), tiff(PICTURE), tiff(PICTURE, 5), b"", b"II*\0"])
def test_files_that_say_nothing_have_no_facts(content: bytes) -> None:
    facts = read_facts(content)
    assert facts == ImageFacts(form=facts.form)


@pytest.mark.parametrize("order", ["<", ">"])
def test_facts_are_those_that_were_written(order: str) -> None:
    block = exif(order, **PHONE)
    expected = {
        "device": "Acme One", "serial": "A1", "lens": "Acme back camera", "software": "17.1",
        "focal_length": 4.25, "focal_length_35mm": 26.0, "focus_distance": 0.5,
        "digital_zoom": 1.0, "orientation": 1, "taken_size": SIZE,
    }  # fmt: skip
    for content in (jpeg(PICTURE, 90, block), png(PICTURE, block), block):
        found = read_facts(content)
        assert {name: getattr(found, name) for name in expected} == expected
    assert read_facts(exif(order, focal=np.float64(4.25))).focal_length == 4.25
    assert read_facts(exif(order, focal=np.float64("inf"))).focal_length is None
    other = exif(order, make="Acme", model="Two", zoom=0.0, focal=0.0, orientation=9)
    found = read_facts(jpeg(PICTURE, 90, other, XMP % (1, b"False")))
    assert (found.device, found.digital_zoom) == ("Acme Two", 1.0)
    assert found.focal_length is found.orientation is None
    assert (found.lens_corrected, found.cropped) == (True, False)
    escape = read_facts(jpeg(PICTURE, 90, exif(order, model="\x1b[31m\u202ered" + "x" * 999)))
    assert escape.device.startswith("[31mred")
    assert len(escape.device) < 100


def test_damaged_files_never_raise_and_say_little() -> None:
    block = exif(**PHONE)
    contents = [jpeg(PICTURE, 90, block, XMP % (1, b"True")), png(PICTURE, block, Title="a"), block]
    for content in contents:
        for end in range(0, min(len(content), 900), 3):
            facts = read_facts(content[:end])
            assert facts.device in ("", "Acme One")
    for old, new in (  # entries, bytes of a text, numbers, and a directory that points to itself
        (block[8:10], b"\xff\xff"),
        (b"\x0f\x01\x02\0\x05\0\0\0", b"\x0f\x01\x02\0\xff\xff\xff\xff"),
        (b"\x0a\x92\x05\0\x01\0\0\0", b"\x0a\x92\x05\0\xff\xff\xff\xff"),
        (b"\x69\x87\x04\0\x01\0\0\0", b"\x69\x87\x04\0\x01\0\0\0\x08\0\0\0"),
    ):
        assert old in block
        assert read_facts(block.replace(old, new, 1)[: len(block)]).focal_length is None
    chance = np.random.default_rng(3)
    for k in range(1500):
        facts = read_facts(mutate(contents[k % 3], "jpg", chance))
        assert all(c.isprintable() for c in facts.device + facts.lens + facts.software)
        for number in (facts.focal_length, facts.focus_distance, facts.digital_zoom):
            assert number is None or 0.0 < number <= 1e5


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
    (phone(zoom=2.0), ["digital zoom of 2", "without zoom", "one digital zoom"]),
    (phone(focus=2.0), ["2 m", "0.5 m", "one focus"]),
    (phone(width=80, height=48), ["80 x 48 px and cropped"]),
    (phone(width=48, height=64), ["48 x 64 px and turned"]),
    (phone(width=128, height=96), ["128 x 96 px and rescaled by 0.5", "of the size"]),
    (phone(software="Adobe Lightroom 6.0"), ["'Adobe Lightroom 6.0'", "'17.1'", "processing"]),
    (phone(orientation=6), ["turned by 90 deg", "stands still"]),
    (jpeg(PICTURE, 95), ["no camera", "'Acme One'", "3 others"]),
    (png(PICTURE, exif(comment=COMMENT + b"Screenshot")), ["screenshots", "copy them"]),
    (png(PICTURE, Software="gnome-screenshot"), ["screenshots"]),
    (phone(rendered=8), ["portrait mode", "take them again"]),
    (phone(rendered=6), ["panoramas"]),
    (jpeg(PICTURE, 95, exif(**PHONE), PORTRAIT), ["portrait mode"]),
    (jpeg(PICTURE, 95, exif(**PHONE), XIAOMI % b"depthmap version"), ["portrait mode"]),
    (phone() + SAMSUNG % b"DualShot_DepthMap_5", ["portrait mode"]),
    (phone() + SAMSUNG % b"SingeShot_DepthMap_1", ["portrait mode"]),
    (phone() + b"V\xe9\0\0edof\0" + bytes(99), ["portrait mode"]),  # Huawei
)


@pytest.mark.parametrize(("content", "words"), DIFFERENT)
def test_an_image_unlike_the_others_is_named_with_the_difference(
    folder: Folder, content: bytes, words: list[str]
) -> None:
    if "'Acme One'" in words and "no camera" in words:  # most of one view must name the camera
        for row in folder.rows:
            row["view"] = "c1"
        del folder.entry["views"]["c2"]
    (note,) = notes(folder, {1: content})
    assert [word for word in [*ONE, *words] if word not in note] == []


def test_what_is_written_only_where_it_is_so_differs_from_silence(folder: Folder) -> None:
    silent = {key: value for key, value in PHONE.items() if key not in ("zoom", "software")}
    files = dict.fromkeys(range(4), jpeg(PICTURE, 95, exif(**silent)))
    assert notes(folder, files) == []
    for said, word in (({"zoom": 1.1}, "digital zoom of 1.1"), ({"software": "GIMP"}, "'GIMP'")):
        (note,) = notes(folder, files | {1: jpeg(PICTURE, 95, exif(**silent | said))})
        assert f"{word} ({NAMES[1]}) and images that say nothing of it ({NAMES[0]}," in note


def test_portrait_mode_is_said_once_for_all_views(folder: Folder) -> None:
    (note,) = notes(folder, dict.fromkeys((1, 2), phone(rendered=8)))
    assert f"Outlines in {NAMES[1]}, {NAMES[2]} of views c1, c2" in note


def test_a_refusal_names_what_may_be_its_cause(
    folder: Folder, monkeypatch: pytest.MonkeyPatch
) -> None:
    del folder.entry["views"]["c2"]["legs"]
    (note,) = notes(folder, {1: phone(zoom=2.0)})
    with pytest.raises(NotVisible) as refused:
        calibrate(folder.path)
    assert len(refused.value.problems) > 1
    assert refused.value.problems[-1] == note
    # Where a mistake explains them, what follows from it is counted and accuses nobody.
    n = len(refused.value.problems) - 1
    mistake = Diagnosis(
        "columns exchanged", "columns a and b look exchanged", (), "with them exchanged", 6, 1, 6,
        0.9, "exchange their headers",
    )  # fmt: skip
    monkeypatch.setattr("legcal.calibration.pipeline.diagnose", lambda data: (mistake,))
    with pytest.raises(NotVisible) as refused:
        calibrate(folder.path)
    first, follow, last = refused.value.problems
    assert (first, last) == (mistake.sentence, note)
    assert follow.startswith(f"{n} more thing")


@pytest.mark.parametrize(
    "content",
    [
        phone(exposure=0.5),
        phone(software="17.4"),
        phone(focal35=27),
        phone(focus=0.51),
        jpeg(PICTURE, 60, exif(**PHONE)),
        phone(make="ACME", model="Acme One"),
        phone() + SAMSUNG % b"MotionPhoto_Data",
        jpeg(PICTURE, 95, exif(**PHONE), XIAOMI % b"lenswatermark offset"),
    ],
)
def test_differences_that_move_no_edge_are_not_spoken_of(folder: Folder, content: bytes) -> None:
    assert notes(folder, {1: content}) == []


RECORDED = {"device": ["Acme One"], "focal_length_mm": [4.25], "focal_length_35mm": [26.0],
            "digital_zoom": [1.0], "software": ["16.0"], "taken_size": [list(SIZE)],
            "lens_corrected": [False], "cropped": [False]}  # fmt: skip


@pytest.mark.parametrize(
    ("board", "words"),
    [
        ({"device": ["Acme Two"]}, ["'Acme One'", "'Acme Two'"]),
        ({"focal_length_mm": [6.0]}, ["4.25 mm", "6 mm"]),
        ({"digital_zoom": [2.0]}, ["without zoom", "digital zoom of 2"]),
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


@pytest.mark.parametrize(
    ("content", "words"),
    [
        (phone(zoom=2.0), ["digital zoom of 2"]),
        (phone(width=80, height=48), ["80 x 48 px and cropped"]),
        (phone(width=48, height=64), ["48 x 64 px and turned"]),
        (phone(width=128, height=96), ["128 x 96 px"]),
        (jpeg(PICTURE, 95, exif(**PHONE), XMP % (1, b"False")), ["corrected for their lens"]),
        (jpeg(PICTURE, 95, exif(**PHONE), XMP % (0, b"True")), ["cropped by a program"]),
    ],
)
def test_what_few_calibrations_hold_for_is_asked_about(
    folder: Folder, content: bytes, words: list[str]
) -> None:
    (note,) = notes(folder, dict.fromkeys(range(4), content))
    assert [word for word in [*words, "no record", "legcal camera"] if word not in note] == []
    folder.camera.pop("legcal_camera", None)
    corrected = {"lens_corrected": [True], "cropped": [True], "digital_zoom": [2.0],
                 "taken_size": [[128, 96]]}  # fmt: skip
    said = notes(folder, dict.fromkeys(range(4), content), corrected)
    assert all("no record" not in sentence for sentence in said)


@pytest.mark.parametrize(
    ("shape", "block", "words"),
    [
        ((64, 48), b"", ["48 x 64 px", "turned by a quarter turn"]),
        ((64, 48), exif(orientation=6), ["quarter turn", "EXIF orientation 6"]),
        ((24, 32), b"", ["32 x 24 px", "rescaled by 0.5"]),
        ((96, 128), b"", ["128 x 96 px", "rescaled by 2"]),
        ((128, 96), b"", ["96 x 128 px", "turned and rescaled by 2"]),
        ((40, 64), b"", ["64 x 40 px", "cropped"]),
        ((24, 32), exif(width=64, height=48), ["taken with 64 x 48 px"]),
        ((60, 30), exif(comment=COMMENT + b"Screenshot"), ["a screenshot"]),
    ],
)
def test_another_size_is_refused_with_its_likeliest_cause(
    folder: Folder, shape: tuple[int, int], block: bytes, words: list[str]
) -> None:
    other = jpeg(np.resize(PICTURE, shape), 90, block)
    with pytest.raises(DatasetError) as refused:
        notes(folder, {1: other})
    assert [word for word in [*ONE, *words] if word not in str(refused.value)] == []


def test_a_photograph_of_another_format_is_named_with_how_to_convert_it(folder: Folder) -> None:
    with pytest.raises(DatasetError) as refused:
        notes(folder, {1: b"\0\0\0\x18ftypheic" + bytes(200)})
    assert [w for w in (*ONE, "HEIC", "magick", "JPEG") if w not in str(refused.value)] == []


def test_lossy_compression_is_noted_once_with_views_and_qualities(folder: Folder) -> None:
    def note(*qualities: int) -> list[str]:
        files = dict(enumerate(jpeg(PICTURE, q) for q in qualities))
        assert notes(folder, files) == []
        dataset = load_dataset(folder.path)
        return compression_note(dataset.measurements, dataset.facts, 0.456, 1.234, "9.8 times")

    assert note(95, 95, 100, 97) == []
    (both,) = note(75, 75, 75, 75)
    assert [
        w
        for w in ("views c1, c2", "quality 75 or", "0.46 px", "1.23", "9.8 times", "95")
        if w not in both
    ] == []
    (one,) = note(95, 95, 60, 80)
    assert "view c2" in one
    assert "60 to 80" in one
    assert "c1" not in one


# The camera


@pytest.fixture(scope="module")
def boards(tmp_path_factory: pytest.TempPathFactory) -> Callable[..., Path]:
    """Photographs of a board by a phone, of which the last may be another."""
    path = tmp_path_factory.mktemp("boards")
    images = [cv2.imread(str(p), cv2.IMREAD_UNCHANGED) for p in drawings(path, PINHOLE, 3)]

    def written(**others: Any) -> Path:
        for p in path.glob("b*"):
            p.unlink()
        for k, image in enumerate(images):
            assert image is not None
            height, width = image.shape
            said = PHONE | {"width": width, "height": height} | (others if k == 2 else {})
            (path / f"b{k}.jpg").write_bytes(jpeg(image, 92, exif(**said)))
        return path

    return written


def test_the_camera_file_records_its_photographs(
    boards: Callable[..., Path], tmp_path: Path
) -> None:
    found = calibrate_camera(boards(), "chessboard:9x6:30mm", output=tmp_path / "camera.yaml")
    assert not [w for w in found.warnings if "No one camera" in w]
    block = yaml.safe_load((tmp_path / "camera.yaml").read_text())["legcal_camera"]
    assert block["photographs"] == {
        "format": ["JPEG"], "jpeg_quality": [92], "orientation": [1], "device": ["Acme One"],
        "serial": ["A1"], "lens": ["Acme back camera"], "focal_length_mm": [4.25],
        "focal_length_35mm": [26.0], "digital_zoom": [1.0], "focus_distance_m": [0.5],
        "taken_size": [[448, 336]], "software": ["17.1"],
    }  # fmt: skip
    camera = read_camera(tmp_path / "camera.yaml")
    assert camera.photographs["focal_length_mm"] == [4.25]
    assert camera.photographs["taken_size"] == [(448, 336)]


def test_photographs_of_a_board_by_two_cameras_are_warned_of(boards: Callable[..., Path]) -> None:
    found = calibrate_camera(boards(focal=6.0), "chessboard:9x6:30mm")
    (warning,) = (w for w in found.warnings if "No one camera" in w)
    assert [w for w in ("b2.jpg", "6 mm", "4.25 mm", "b0.jpg") if w not in warning] == []


def test_a_photograph_of_a_board_in_portrait_mode_is_warned_of(boards: Callable[..., Path]) -> None:
    found = calibrate_camera(boards(rendered=7), "chessboard:9x6:30mm")
    assert [w for w in found.warnings if "b2.jpg" in w and "portrait mode" in w and "b0" not in w]
