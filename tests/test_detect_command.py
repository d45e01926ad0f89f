"""``legcal detect``: the folder that people look at, and that nothing of theirs is lost."""

import csv
import json
import re
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from outline_tables import assert_same
from repeated_images import SIZE, RepeatedImages, repeated_images

from legcal import cli, detect, load_dataset
from legcal.data.outlines import QUALITY, read_observations
from legcal.data.rows import canonical_order
from legcal.errors import UsageError
from legcal.perception.overview import Detection, _caption, picture_names
from legcal.perception.photographs import Observations, Photographs, observe

BLANK, ASIDE = "images/p1_1.png", "images/aside.png"


@pytest.fixture(scope="module")
def rendered(tmp_path_factory: pytest.TempPathFactory) -> RepeatedImages:
    """A hexapod in two poses; one picture shows nothing, and another view only shows grey."""
    made = repeated_images(tmp_path_factory.mktemp("detect") / "hexapod", n_images=2)
    made.pictures[BLANK] = np.full_like(made.pictures[BLANK], 90.0)
    made.pictures[ASIDE] = made.pictures[BLANK]
    made.entry["views"]["c2"] = dict(made.entry["views"]["c1"])
    made.rows.append({**made.rows[0], "view": "c2", "image": ASIDE})
    made.write()
    return made


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("out") / "found"


@pytest.fixture(scope="module")
def found(rendered: RepeatedImages, folder: Path) -> Detection:
    return detect(rendered.path, output=folder)


@pytest.fixture
def one_image(rendered: RepeatedImages, tmp_path: Path) -> RepeatedImages:
    """The same view with two images, to be changed."""
    entry = json.loads(json.dumps(rendered.entry))
    del entry["views"]["c2"]
    rows = [dict(row) for row in rendered.rows[:2]]
    pictures = {row["image"]: rendered.pictures[row["image"]] for row in rows}
    made = RepeatedImages(tmp_path / "set", rendered.machine, entry, rows, pictures)
    made.write()
    return made


def run(monkeypatch: pytest.MonkeyPatch, *words: str | Path) -> int:
    """Run the command in this process and return its exit code."""
    command = ["legcal", "detect", *map(str, words), "--workers", "1"]
    monkeypatch.setattr(sys, "argv", command)
    with pytest.raises(SystemExit) as stop:
        cli.main()
    assert isinstance(stop.value.code, int)
    return stop.value.code


def table(path: Path) -> list[dict[str, str]]:
    with path.open(newline="") as file:
        return list(csv.DictReader(file))


def write_table(path: Path, rows: list[dict[str, str]]) -> None:
    with path.open("w", newline="") as file:
        writer = csv.DictWriter(file, list(rows[0]), lineterminator="\n")
        writer.writeheader()
        writer.writerows(rows)


def test_folder_json_and_summary_tell_the_same(
    rendered: RepeatedImages,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    before = sorted(rendered.path.rglob("*"))
    out = tmp_path / "out"
    assert run(monkeypatch, rendered.path, "-o", out, "--json") == 1  # c2 shows no leg
    document = json.loads(capsys.readouterr().out)
    assert sorted(rendered.path.rglob("*")) == before
    rows = table(out / "observations.csv")
    assert document["outlines"] == len(rows)
    assert document["used"] == sum(row["verdict"] == "used" for row in rows) > 20
    assert list(document["views"]) == ["c1", "c2"]
    view = document["views"]["c1"]
    assert (view["images"], view["legs_found"]) == (4, view["legs_visible"] - 6)
    contrast = [float(row["contrast"]) for row in rows if row["verdict"] == "used"]
    assert view["contrast"] == pytest.approx(np.median(contrast))
    assert sum(view["rejected"].values()) == view["outlines"] - view["used"]
    assert "c2" in document["views"]["c2"]["problem"]
    files = [entry["file"] for entry in document["overlays"]]
    assert len(files) == len(set(files)) == document["images"] == 5
    page = (out / "index.html").read_text()
    for file in files:
        picture = cv2.imread(str(out / file))
        assert picture is not None
        assert picture.shape[0] > 3 * SIZE[1]  # enlarged, with a legend
        assert f'href="{file}"' in page
    assert "http" not in page
    kept = json.loads((out / "detection.json").read_text())
    assert {key: kept[key] for key in document} == document


def test_views_without_a_camera_pose_are_told_and_drawn_where_they_were_expected(
    found: Detection,
) -> None:
    assert list(found.unplaced) == ["c2"]
    assert {found.view_of(row) for row in found.outlines.row.tolist()} == {"c1"}
    assert len(found.predicted(4)) == 6


def test_captions_say_only_of_a_camera_with_a_hint_where_it_was_expected(
    found: Detection,
) -> None:
    assert _caption(found, 0).startswith("c1  images/p0_0.png  1")
    assert _caption(found, 4).endswith(
        "the camera could not be placed: legs are drawn where it was expected"
    )
    unknown = replace(found, T_base_camera=(found.T_base_camera[0], None))
    assert unknown.predicted(4) == []
    assert _caption(unknown, 4).endswith("the camera could not be placed")


def test_legs_are_drawn_by_the_radii_that_were_searched_by(
    one_image: RepeatedImages, monkeypatch: pytest.MonkeyPatch
) -> None:
    def thicker(photographs: Photographs, *others: Any) -> Observations:
        cylinders = [
            [replace(c, radius=c.radius * (2.0 + j)) for c in of_leg]
            for j, of_leg in enumerate(photographs.cylinders)
        ]
        wrong = replace(photographs, machine=photographs.machine.with_cylinders(cylinders))
        return replace(observe(photographs, *others), photographs=wrong)

    monkeypatch.setattr("legcal.calibration.outline_detection.observe", thicker)
    found = detect(one_image.path)
    legs = {leg.leg: leg for leg in found.predicted(0)}
    assert len(legs) == 6
    order = canonical_order(found.dataset.measurements, found.dataset.machine.leg_names).legs
    for at, j in enumerate(order.tolist()):
        nominal = {c.link: c.radius for c in found.dataset.machine.legs[j].cylinders}
        for piece in legs[j].segments:
            assert piece.radius == pytest.approx((2.0 + at) * nominal[piece.link])


def test_the_written_table_is_read_as_what_was_found(
    rendered: RepeatedImages, found: Detection, folder: Path
) -> None:
    dataset = load_dataset(rendered.path)
    path, legs = folder / "observations.csv", dataset.machine.legs
    assert_same(read_observations(path, legs, dataset.measurements), found.outlines)
    for name in QUALITY:
        assert np.all(np.isfinite(getattr(found.outlines, name)[found.outlines.used]))


def test_people_read_a_table_of_views(
    one_image: RepeatedImages,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.setenv("COLUMNS", "100")
    assert run(monkeypatch, one_image.path, "-o", tmp_path / "out") == 0
    printed = capsys.readouterr()
    assert "outlines used in 2 images" in printed.out
    assert re.search(r"1[12]/12", printed.out)  # of one leg little is seen
    assert f"Look at {tmp_path}/out/index.html" in printed.out.replace("\n", "")
    assert "Drawing overlays: 2/2" in printed.err


def test_an_edited_table_is_never_written_over_and_wins_in_the_dataset(
    one_image: RepeatedImages, tmp_path: Path
) -> None:
    out = tmp_path / "out"
    detect(one_image.path, output=out)
    detect(one_image.path, output=out)  # replaces its own files
    rows = table(out / "observations.csv")
    rows[3] |= {"verdict": "rejected", "reason": "a cable", "source": "edited"}
    write_table(out / "observations.csv", rows)
    edited = (out / "observations.csv").read_bytes()
    with pytest.raises(UsageError, match=r"found a table that was changed since .* copy it into"):
        detect(one_image.path, output=out)
    assert (out / "observations.csv").read_bytes() == edited
    (one_image.path / "observations.csv").write_bytes(edited)
    found = detect(one_image.path, output=out)
    assert found.outlines.reason[3] == "a cable"
    assert found.outlines.source.count("edited") == 1
    kept = table(out / "observations.csv")[3]
    assert (kept["verdict"], kept["source"], kept["contrast"]) == ("rejected", "edited", "")


def test_an_earlier_detection_is_replaced_and_other_files_are_kept(
    one_image: RepeatedImages, tmp_path: Path
) -> None:
    out = tmp_path / "out"
    detect(one_image.path, output=out)
    (out / "overlays" / "mine.txt").write_text("mine")
    del one_image.rows[1]
    one_image.write()
    detect(one_image.path, output=out)
    assert [path.name for path in (out / "overlays" / "c1").iterdir()] == ["p0_0.jpg"]
    assert (out / "overlays" / "mine.txt").read_text() == "mine"
    one_image.rows[0]["image"] = "images/p0_1.png"
    one_image.write()
    (out / "overlays" / "c1" / "p0_1.jpg").write_text("of somebody else")
    with pytest.raises(UsageError, match=r"overlays/c1/p0_1.jpg, which legcal did not write"):
        detect(one_image.path, output=out)
    assert (out / "overlays" / "c1" / "p0_0.jpg").exists()


def test_images_of_the_same_name_have_pictures_of_their_own(found: Detection) -> None:
    measurements = found.dataset.measurements
    views = (replace(measurements.views[0], name="../left cam"), *measurements.views[1:])
    images = ("images/a.png", "more/A.png", "b/c.png", "b/d.png", "images/a.png")
    renamed = replace(measurements, views=views, image=images)
    pictures = picture_names(replace(found, dataset=replace(found.dataset, measurements=renamed)))
    assert list(pictures.values()) == [
        "overlays/_left_cam/images_a.png.jpg",
        "overlays/_left_cam/more_A.png.jpg",
        "overlays/_left_cam/b_c.png.jpg",
        "overlays/_left_cam/b_d.png.jpg",
        "overlays/c2/a.jpg",
    ]


def test_a_folder_with_other_files_is_refused_before_any_work(
    rendered: RepeatedImages, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run(monkeypatch, rendered.path, "-o", rendered.path, "--json") == 2
    error: dict[str, Any] = json.loads(capsys.readouterr().out)["error"]
    assert "found a folder with other files and no detection.json of legcal" in error["message"]


def test_images_that_cannot_be_read_are_refused_and_nothing_is_written(
    one_image: RepeatedImages,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    path = one_image.path / one_image.rows[1]["image"]
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])
    assert run(monkeypatch, one_image.path, "-o", tmp_path / "out") == 2
    said = capsys.readouterr().err
    assert "p0_1.png" in said
    assert len(said.strip().splitlines()) <= 2
    assert not (tmp_path / "out").exists()
