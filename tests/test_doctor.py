"""``legcal doctor``: what can stand in the way is provoked, and named once with a remedy."""

import shutil
from pathlib import Path

import cv2
import numpy as np
import pytest
from command_line import run
from edits import each_row
from hexapod_example import Spoiled, spoiled
from photograph_files import exif, jpeg, undecodable_png
from simulated import settings, simulated, small_camera

from legcal import doctor, simulate
from legcal.calibration.detection import CHECKS, Examination, Finding
from legcal.calibration.diagnosis import NONE_EXPLAINS, Diagnosis
from legcal.simulation.settings import Level

pytestmark = pytest.mark.usefixtures("without_remedies")

COLUMNS = [f"leg{k}_prismatic" for k in range(1, 7)]


def made(folder: Path, n: int = 2) -> Spoiled:
    """Return a session; views of two images are too few for mistakes to be tried."""
    return spoiled(folder / "set", n, ("c1", "c2", "c3"))


def found_of(found: Examination, check: str, severity: str) -> list[Finding]:
    return [one for one in found.findings if (one.check, one.severity) == (check, severity)]


def test_nothing_stands_against_the_example(tmp_path: Path) -> None:
    found = doctor(made(tmp_path).write())
    assert found.is_ready
    assert found.is_usable
    assert {one.severity for one in found.findings} == {"note"}
    (untried,) = found_of(found, "mistakes", "note")
    assert "found at most 2 images of a view, needed 3 or more" in untried.what
    assert [one.name for one in found.checks] == list(CHECKS)
    assert {one.state for one in found.checks} <= {"ok", "note"}
    assert [one.images for one in found.views] == [2, 2, 2]
    assert all((one.legs_found or 0) >= 10 for one in found.views)
    assert len(found.encoders) == 6


def test_photographs_that_cannot_be_used_are_named_and_the_others_judged(tmp_path: Path) -> None:
    session = made(tmp_path, 5)
    session.rows = [row for k, row in enumerate(session.rows) if k < 5 or k % 5 < 2]
    gone, cut, spoilt = (str(session.row("c1", k)["image"]) for k in range(3))
    (session.path / gone).unlink()
    (session.path / cut).write_bytes((session.path / cut).read_bytes()[:-300])
    picture = cv2.imread(str(session.path / spoilt), cv2.IMREAD_UNCHANGED)
    assert picture is not None
    (session.path / spoilt).write_bytes(undecodable_png(picture))
    black = session.change("c2", 0, lambda picture: 0 * picture)
    first, same = (str(session.row("c3", k)["image"]) for k in range(2))
    shutil.copy(session.path / first, session.path / same)
    found = doctor(session.write())
    assert not found.is_usable
    missing, damaged, undecoded, twice = found_of(found, "files", "error")
    assert missing.images == (gone,)
    assert damaged.images == (cut,)
    assert "cut off" in damaged.what
    assert undecoded.images == (spoilt,)
    assert twice.images == (first, same)
    assert "are the same photograph, with different readings" in twice.what
    (dark,) = found_of(found, "photographs", "warning")
    assert "the image is black" in dark.what
    assert black in dark.what
    assert sum(black in one.what for one in found.findings) == 1


def test_readings_are_compared_with_their_travel(tmp_path: Path) -> None:
    folder = simulated(tmp_path / "set", "hexapod", poses=2, views=3).folder

    def rounded(row: dict[str, str]) -> None:
        row |= {name: f"{float(row[name]):.4f}" for name in COLUMNS}
        row["leg5_prismatic"] = "0.0500"
        row["leg3_prismatic"] = f"{float(row['leg3_prismatic']) / 50.0 + 0.02:.4f}"

    each_row("measurements.csv", rounded)(folder)
    found = doctor(folder)
    constant, still = found_of(found, "readings", "warning")
    assert "found the same reading in all rows of leg5_prismatic" in constant.what
    assert "found leg3_prismatic in" in still.what


def test_what_photographs_say_of_camera_and_compression_is_told(tmp_path: Path) -> None:
    session = made(tmp_path)
    usual, other = (exif(make="Acme", model="One", focal=focal) for focal in (4.25, 6.5))
    for k, row in enumerate(session.rows):
        picture = cv2.imread(str(session.path / row["image"]), cv2.IMREAD_GRAYSCALE)
        row["image"] = str(Path(row["image"]).with_suffix(".jpg"))
        content = jpeg(np.asarray(picture, dtype=np.uint8), 60, other if k == 3 else usual)
        (session.path / row["image"]).write_bytes(content)
    found = doctor(session.write())
    (zoomed,) = found_of(found, "camera", "error")
    assert "one focal length" in zoomed.what
    assert session.rows[3]["image"] in zoomed.what
    assert "JPEGs of quality 60" in found_of(found, "photographs", "note")[0].what
    assert [one.jpeg_quality for one in found.views] == [60, 60, 60]


def test_a_mistake_comes_first_and_its_diagnosis_is_in_the_document(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    mistake = Diagnosis(
        kind="columns exchanged", what="columns a and b look exchanged", same_as=(), score=0.9,
        remedy="exchange their headers", mended="with them exchanged",
        images=6, images_before=1, images_after=6,
    )  # fmt: skip
    monkeypatch.setattr("legcal.calibration.doctor.diagnose", lambda *_: (mistake,))
    session = spoiled(tmp_path / "set", 2, ("c1", "c3"))
    rough = session.entry["views"]["c3"]["T_base_camera"]
    right, rough["xyz"] = rough["xyz"], [2.0, 2.0, 2.0]
    name = session.change("c1", 0, lambda picture: 0 * picture)
    folder = session.write()
    outcome = run("doctor", folder, "--json")
    document = outcome.document
    assert outcome.code == 1
    said = [one["what"] for one in document["findings"]]
    assert said[0] == mistake.sentence
    assert any(what.startswith("1 further problem may have the same cause") for what in said)
    assert not any("T_base_camera is wrong" in what for what in said)
    assert document["diagnosis"] == [mistake.model_dump(mode="json")]
    assert not document["ready"]
    assert document["usable"]
    rough["xyz"] = right
    (session.write() / name).unlink()
    outcome = run("doctor", folder)
    assert outcome.code == 2
    assert outcome.out.index("error:") < outcome.out.index("Columns a and b look exchanged")
    assert "errors to fix before calibrating" in outcome.out


def test_what_was_tried_in_vain_is_said_only_where_legs_are_missing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("legcal.calibration.doctor.diagnose", lambda *_: ())
    session = spoiled(tmp_path / "set", 3, ("c1", "c3"))
    assert NONE_EXPLAINS not in [one.what for one in doctor(session.write()).findings]
    session.change("c1", 0, lambda picture: 0 * picture)
    assert NONE_EXPLAINS not in [one.what for one in doctor(session.write()).findings]
    session.change("c3", 1, lambda picture: 0 * picture)
    assert NONE_EXPLAINS in [one.what for one in doctor(session.write()).findings]


def test_a_black_photograph_is_no_reason_to_look_for_mistakes(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.delattr("legcal.calibration.mistake_search.mistakes")
    session = spoiled(tmp_path / "set", 3, ("c1", "c3"))
    session.change("c1", 0, lambda picture: 0 * picture)
    assert {one.check for one in doctor(session.write()).findings if one.severity != "note"} == {
        "photographs"
    }


@pytest.mark.system
def test_a_photograph_in_the_hand_that_is_not_placed_is_no_error(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("legcal.calibration.doctor.diagnose", lambda *_: ())
    camera = small_camera(tmp_path, 480, 360)
    shot = settings(
        level=Level.PHOTOGRAPHS, views=1, poses=5, camera=camera, board="charuco", hand_held=True
    )
    folder = simulate("hexapod", tmp_path / "set", shot).folder
    names = sorted((folder / "images").rglob("*.png"))
    severities = []
    for name in names[:2]:
        cv2.imwrite(str(name), np.zeros((360, 480), dtype=np.uint8))
        found = [one for one in doctor(folder).findings if "could not be placed" in one.what]
        severities += [{one.severity for one in found}]
    assert severities == [{"warning"}, {"error"}]


def test_datasets_without_photographs_are_judged_by_what_they_have(tmp_path: Path) -> None:
    simulated(tmp_path / "outlines", "3-rpr", views=3, poses=6)
    outcome = run("doctor", tmp_path / "outlines")
    assert outcome.code == 0
    assert "Ready to calibrate" in outcome.out
    assert "legcal calibrate" in outcome.out
    simulated(tmp_path / "few", "3-rpr", views=1)
    assert [one.name for one in doctor(tmp_path / "few").checks][-1] == "mistakes"
    (tmp_path / "outlines" / "measurements.csv").unlink()
    outcome = run("doctor", tmp_path / "outlines", "--json")
    assert outcome.code == 2
    assert outcome.document["error"]["kind"] == "DatasetError"
