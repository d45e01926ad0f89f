"""``legcal noise``: measurement accuracy from repeated images (4.2), and what it refuses."""

import json
import sys
from collections.abc import Callable
from dataclasses import replace
from io import StringIO
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from repeated_images import RepeatedImages, repeated_images
from rich.console import Console

from legcal import cli, measure_noise
from legcal.calibration import Noise
from legcal.calibration.measurement_noise.comparison import find_repeats, noise_notes
from legcal.calibration.measurement_noise.repeatability import QUANTITIES
from legcal.data.dataset import load_dataset
from legcal.errors import DatasetError, LegcalError, NotIdentifiable, NotVisible
from legcal.machine import load_mechanism
from legcal.report import noise_table

FLAT = "images/p1_2.png"  # shows nothing


@pytest.fixture(scope="module")
def rendered(tmp_path_factory: pytest.TempPathFactory) -> RepeatedImages:
    """A hexapod in two poses, three images each; the last one shows nothing."""
    made = repeated_images(tmp_path_factory.mktemp("noise") / "hexapod")
    made.pictures[FLAT] = np.full_like(made.pictures[FLAT], 90.0)
    made.write()
    return made


@pytest.fixture(scope="module")
def found(rendered: RepeatedImages) -> Noise:
    return measure_noise(rendered.path)


@pytest.fixture
def spoiled(rendered: RepeatedImages, tmp_path: Path) -> RepeatedImages:
    """The same, to be changed and written."""
    entry = json.loads(json.dumps(rendered.entry))
    rows = [dict(row) for row in rendered.rows]
    return RepeatedImages(tmp_path / "set", rendered.machine, entry, rows, dict(rendered.pictures))


def run(monkeypatch: pytest.MonkeyPatch, *words: str | Path) -> int:
    """Run the command in this process, without others, and return its exit code."""
    monkeypatch.setattr("legcal.cli.options.MAX_IMAGE_WORKERS", 1)
    monkeypatch.setattr(sys, "argv", ["legcal", "noise", *map(str, words)])
    with pytest.raises(SystemExit) as stop:
        cli.main()
    assert isinstance(stop.value.code, int)
    return stop.value.code


def test_json_is_one_document_and_the_folder_stays_as_it_was(
    rendered: RepeatedImages,
    found: Noise,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    before = sorted(rendered.path.rglob("*"))
    assert run(monkeypatch, rendered.path, "--json") == 0
    printed = capsys.readouterr()
    assert json.loads(printed.out) == found.document()
    assert sorted(rendered.path.rglob("*")) == before
    for stage in ("Recognising legs", "Measuring outlines", "Canny and least squares"):
        assert stage in printed.err


def test_every_leg_has_standard_deviations_by_both_methods(found: Noise) -> None:
    document = found.document()
    assert (document["images"], document["orientations"]) == (6, 2)
    assert document["repeats"] == {"least": 3, "most": 3}
    assert set(document["methods"]) == {"detector", "canny"}
    for method in document["methods"].values():
        assert [leg["leg"] for leg in method["legs"]] == [f"leg{j}" for j in range(1, 7)]
        for leg in method["legs"]:
            for name in ("outline", "psi", "theta", "angle", "across", "tilt", "depth"):
                spread = leg[name]
                assert 0.0 < spread["sd"] <= spread["largest"] * (1.0 + 1e-12)
                assert spread["ratio_low"] < spread["ratio"] < spread["ratio_high"]
                assert spread["ratio"] == pytest.approx(spread["sd"] / spread["claimed"])
            assert leg["outline"]["sd"] < 0.3
        # Far worse towards the camera than in the image.
        assert method["all"]["tilt"]["sd"] > 10.0 * method["all"]["angle"]["sd"]


def test_a_detection_that_is_missed_is_counted_and_leaves_fewer_repeats(found: Noise) -> None:
    for method in found.document()["methods"].values():
        for leg in method["legs"]:
            assert leg["images"] == 6
            assert leg["axes"] <= 5
            assert leg["outlines_found"] <= leg["outlines"] - 2
            axes = {o["pose"]: o["axes"] for o in leg["orientations"]}
            assert axes["p1"] <= 2
            dof = sum(max(n - 1, 0) for n in axes.values())
            assert leg["psi"]["dof"] <= dof + 1e-9


def test_the_upper_bound_is_the_largest_of_all_legs_and_orientations(found: Noise) -> None:
    for method in found.document()["methods"].values():
        for name in QUANTITIES:
            values = [o[name] for leg in method["legs"] for o in leg["orientations"]]
            assert method["upper_bound"][name] == max(v for v in values if v is not None)


def test_the_orientations_that_set_upper_bounds_are_named(found: Noise) -> None:
    for method in found.document()["methods"].values():
        for name in (*QUANTITIES, "outline"):
            at = method["upper_bound_at"][name]
            (leg,) = [leg for leg in method["legs"] if leg["leg"] == at["leg"]]
            (o,) = [
                o for o in leg["orientations"] if (o["view"], o["pose"]) == (at["view"], at["pose"])
            ]
            assert leg[name]["largest"] == method["upper_bound"][name]
            assert method["all"][name]["median"] < method["upper_bound"][name]
            assert name == "outline" or o[name] == method["upper_bound"][name]


def test_an_edge_that_jumps_between_images_is_named(rendered: RepeatedImages, found: Noise) -> None:
    measurements = load_dataset(rendered.path).measurements
    assert not any("jumps" in note for note in noise_notes(measurements, found.methods))
    detector, canny = found.methods
    first, *others = canny.legs[2].orientations
    jumping = replace(first.lines[0], covariance=400.0 * first.lines[0].claimed)
    leg = replace(
        canny.legs[2],
        orientations=(replace(first, lines=(jumping, *first.lines[1:])), *others),
    )
    canny = replace(canny, legs=(*canny.legs[:2], leg, *canny.legs[3:]))
    (note,) = [n for n in noise_notes(measurements, [detector, canny]) if "jumps" in n]
    place = f"leg3 in c1/{measurements.pose_labels[first.pose]} ({jumping.sd:.3f} px)"
    assert note.startswith("Canny: single outlines spread over 3 times")
    assert place in note


def test_the_table_fits_80_columns_and_says_what_repeats_do_not_show(found: Noise) -> None:
    console = Console(width=80, record=True, file=StringIO())
    console.print(noise_table(found))
    text = console.export_text()
    assert max(len(line) for line in text.splitlines()) <= 80
    flowing = " ".join(text.split())
    for words in (
        "psi [deg]", "x [mm]", "upper bound", "Canny", "claims", "claimed", "2/12", "not the bias",
        "median", "Upper bounds by detector: leg", "95 % ranges hold for normal",
    ):  # fmt: skip
        assert words in flowing
    assert text.count("leg1  ") == 3  # on one line in every table


def test_the_result_does_not_depend_on_the_order_of_rows(
    spoiled: RepeatedImages, found: Noise
) -> None:
    spoiled.rows.reverse()
    assert measure_noise(spoiled.write()).document() == found.document()


def test_rows_that_nothing_repeats_are_left_out(spoiled: RepeatedImages) -> None:
    for row, label in zip(spoiled.rows[3:], ("", "alone", "p1"), strict=True):
        row["pose"] = label
    spoiled.entry["views"]["c1"]["legs"] = ["leg1", "leg3", "leg4", "leg6"]
    document = measure_noise(spoiled.write()).document()
    assert (document["images"], document["orientations"]) == (3, 1)
    legs = document["methods"]["canny"]["legs"]
    assert {o["pose"] for leg in legs for o in leg["orientations"]} == {"p0"}
    assert "leg2 is in none of the repeated images." in document["notes"]
    assert legs[1]["psi"] is None


def test_what_is_wrong_with_the_cameras_is_said(spoiled: RepeatedImages) -> None:
    pose = spoiled.entry["views"]["c1"]["T_base_camera"]
    pose["xyz"] = [value + 0.3 for value in pose["xyz"]]
    notes = measure_noise(spoiled.write()).notes
    assert any(note.startswith("view c1: its T_base_camera is wrong: found") for note in notes)


def test_a_leg_along_the_image_x_axis_is_said_to_have_no_M_LS(tmp_path: Path) -> None:
    made = repeated_images(tmp_path / "level", "3-rps", n_poses=1, level_leg=1)
    noise = measure_noise(made.write())
    for method in noise.document()["methods"].values():
        leg = method["legs"][1]
        assert leg["axes"] == 3
        assert (leg["without_M_LS"], leg["x"], leg["z"]) == (1, None, None)
        assert leg["psi"]["sd"] > 0.0
        assert method["legs"][0]["without_M_LS"] == 0
    note = "leg2: M_LS does not exist for detector in 1 of 1 orientations (c1/p0), where the leg is"
    assert any(text.startswith(note) for text in noise.notes)
    console = Console(width=100, record=True, file=StringIO())
    console.print(noise_table(noise))
    assert console.export_text().count("no M_LS") == 4


@pytest.mark.parametrize("model", ["tricept"])
def test_other_classes_of_mechanisms_are_measured_too(tmp_path: Path, model: str) -> None:
    made = repeated_images(tmp_path / model, model, n_poses=1, n_images=3)
    noise = measure_noise(made.write())
    detector = noise.methods[0]
    assert [leg.name for leg in detector.legs] == list(load_mechanism(model).leg_names)
    assert sum(bool(leg.spread("psi")) for leg in detector.legs) >= 2


def _no_pose_column(made: RepeatedImages) -> None:
    for row in made.rows:
        del row["pose"]


def _no_repeats(made: RepeatedImages) -> None:
    made.rows = [made.rows[0], made.rows[3]]


def _no_images(made: RepeatedImages) -> None:
    for row in made.rows:
        row["image"] = ""


def _damaged(made: RepeatedImages) -> None:
    path = made.write() / "images/p0_1.png"
    path.write_bytes(path.read_bytes()[:-2000])
    made.pictures.clear()


def _no_camera_pose(made: RepeatedImages) -> None:
    del made.entry["views"]["c1"]["T_base_camera"]


def _camera_elsewhere(made: RepeatedImages) -> None:
    made.entry["views"]["c1"]["T_base_camera"] = {"xyz": [9, 9, 9], "quat_xyzw": [0, 0, 0, 1]}


def _nothing_shown(made: RepeatedImages) -> None:
    for name, picture in made.pictures.items():
        made.pictures[name] = np.full_like(picture, 90.0)


def _nothing_shown_twice(made: RepeatedImages) -> None:
    for name, picture in made.pictures.items():
        if not name.endswith("_0.png"):
            made.pictures[name] = np.full_like(picture, 90.0)


def _a_motor_less(made: RepeatedImages) -> None:
    motor = str(made.machine.legs[0].prismatic)

    def change(urdf: str, entry: dict[str, Any]) -> str:
        entry["name_mot"].remove(motor)
        return urdf

    _new_model(made, change)
    for row in made.rows:
        del row[motor]


def _new_model(made: RepeatedImages, change: Callable[[str, dict[str, Any]], str]) -> None:
    """Give the dataset a changed model of its own."""
    made.path.mkdir(parents=True)
    entry = yaml.safe_load(made.machine.yaml_path.read_text())
    urdf = change(made.machine.urdf_path.read_text(), entry)
    entry["legcal"]["urdf"] = "model.urdf"
    (made.path / "model.urdf").write_text(urdf)
    (made.path / "model.yaml").write_text(yaml.safe_dump(entry, sort_keys=False))
    made.entry["mechanism"] = "model.yaml"


REFUSALS = [
    (_no_pose_column, NotIdentifiable, "found no column pose, needed several images"),
    (_no_repeats, NotIdentifiable, "found no two images of one pose in any view"),
    (_no_images, DatasetError, "neither an image nor outlines"),
    (_damaged, DatasetError, "a PNG cut off"),
    (_nothing_shown, NotVisible, "view c1: its camera could not be placed"),
    (_nothing_shown_twice, NotVisible, "found no outline in two images of the same pose"),
    (_a_motor_less, NotIdentifiable, "found mobility 6 and 5 motors"),
]


@pytest.mark.parametrize(
    ("spoil", "kind", "words"), REFUSALS, ids=[spoil.__name__[1:] for spoil, _, _ in REFUSALS]
)
def test_what_gives_no_noise_is_refused_in_one_sentence(
    spoiled: RepeatedImages,
    spoil: Callable[[RepeatedImages], None],
    kind: type[LegcalError],
    words: str,
) -> None:
    spoil(spoiled)
    with pytest.raises(kind) as refused:
        measure_noise(spoiled.write())
    assert words in str(refused.value)
    assert len(refused.value.problems) == 1 or spoil in (_no_images,)


def test_repeated_rows_without_images_are_refused(rendered: RepeatedImages) -> None:
    measurements = load_dataset(rendered.path).measurements
    with pytest.raises(DatasetError, match="found no image in 6 rows, needed repeated images"):
        find_repeats(measurements, np.zeros(6, dtype=np.bool_), Path("measurements.csv"))


def test_one_pose_seen_from_several_places_is_not_repeated(rendered: RepeatedImages) -> None:
    measurements = load_dataset(rendered.path).measurements
    apart = replace(measurements, view=np.arange(6, dtype=np.intp))
    with pytest.raises(NotIdentifiable, match="no two images of one pose in any view"):
        find_repeats(apart, np.ones(6, dtype=np.bool_), Path("measurements.csv"))


def test_a_refusal_is_one_json_document_with_its_exit_code(
    spoiled: RepeatedImages, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    _no_repeats(spoiled)
    assert run(monkeypatch, spoiled.write(), "--json") == 1
    assert json.loads(capsys.readouterr().out)["error"]["kind"] == "NotIdentifiable"
    assert run(monkeypatch, spoiled.path / "nowhere") == 2
