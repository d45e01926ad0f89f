"""The whole path, on the photographs of the example hexapod."""

import csv
import json
import re
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from hexapod_example import HEXAPOD, ROOT, TRUTH, Run, copy_of_the_example
from thinned import thinned

from legcal import LegcalError, calibrate, evaluate, load_dataset, load_mechanism
from legcal.calibration.identify.judge import check_identifiable
from legcal.errors import NotIdentifiable, UsageError
from legcal.machine import geometries, parametrization_of, vector_of


def _table(folder: Path) -> list[list[str]]:
    with (folder / "measurements.csv").open(newline="") as file:
        return list(csv.reader(file))


def _write_table(folder: Path, rows: list[list[str]]) -> None:
    with (folder / "measurements.csv").open("w", newline="") as file:
        csv.writer(file).writerows(rows)


def _entry(folder: Path) -> dict[str, Any]:
    entry: dict[str, Any] = yaml.safe_load((folder / "dataset.yaml").read_text())
    return entry


def _write_entry(folder: Path, entry: dict[str, Any]) -> None:
    (folder / "dataset.yaml").write_text(yaml.safe_dump(entry, sort_keys=False))


def test_photographs_bring_the_platform_within_0_15_mm_and_0_03_deg(example_run: Run) -> None:
    nominal = evaluate(HEXAPOD / "models/hexapod.yaml", TRUTH, dataset=HEXAPOD)
    found = evaluate(example_run.output / "calibrated.yaml", TRUTH, dataset=HEXAPOD)
    assert nominal.displacement.mean() > 1.2e-3
    assert nominal.rotation.mean() > np.radians(0.4)
    assert found.displacement.mean() < 0.15e-3
    assert found.rotation.mean() < np.radians(0.03)


def test_parameters_from_photographs_are_about_as_wrong_as_their_sigmas(example_run: Run) -> None:
    solution, truth = example_run.calibration.solution, load_mechanism(TRUTH)
    names = parametrization_of(truth).names
    values = vector_of(parametrization_of(truth), geometries(truth), geometries(truth))
    sigma = dict(zip(solution.names, solution.sigma, strict=True))
    pulls = [(solution.values[n] - v) / sigma[n] for n, v in zip(names, values, strict=True)]
    assert len(pulls) == 30
    assert 0.2 < np.mean(np.square(pulls)) < 2.0


def test_radii_are_known_no_better_than_light_at_the_limb_allows(example_run: Run) -> None:
    document = json.loads((example_run.output / "result.json").read_text())
    radii = [p for p in document["parameters"] if ".radius." in p["name"]]
    assert len(radii) == 6
    for radius in radii:
        assert abs(radius["value"] - 0.01) < 3.0 * radius["sigma"], radius["name"]
        assert radius["sigma"] < 0.05e-3


def test_the_verdict_is_positive_and_the_change_is_known_well(example_run: Run) -> None:
    verdict, platform = example_run.calibration.verdict, example_run.calibration.platform
    assert verdict.trustworthy
    assert platform is not None
    assert platform.change.mean_displacement > 2.0 * platform.sigma.mean_displacement


def test_the_result_document_has_what_the_format_says(example_run: Run) -> None:
    document = json.loads((example_run.output / "result.json").read_text())
    n_estimated = sum(row["status"] == "estimated" for row in document["parameters"])
    covariance = np.array(document["covariance"])
    assert document["legcal_result"] == 1
    assert document["status"] == "converged"
    assert covariance.shape == (n_estimated, n_estimated)
    assert np.allclose(covariance, covariance.T, rtol=1e-9)
    sigma = [row["sigma"] for row in document["parameters"] if row["status"] == "estimated"]
    assert np.allclose(np.sqrt(np.diagonal(covariance)), sigma, rtol=1e-9)
    assert np.array(document["base_joints"]).shape == (6, 3)
    assert document["base_joints"][0] == [0.0, 0.0, 0.0]
    assert set(document["views"]) == {"c1", "c2", "c3"}
    assert len(document["stages"]["staged"]["offsets"]) == 6
    assert [row["name"] for row in document["parameters"]][:3] == [
        "leg2.base.x",
        "leg2.base.y",
        "leg2.base.z",
    ]


def test_the_written_model_is_the_one_that_was_computed(example_run: Run) -> None:
    written = load_mechanism(example_run.output / "calibrated.yaml")
    expected = example_run.calibration.solution.parameters
    assert np.abs(written.parameters.base_joints - expected.base_joints).max() < 1e-12
    assert np.abs(written.parameters.platform_joints - expected.platform_joints).max() < 1e-12
    assert np.abs(written.parameters.offsets - expected.offsets).max() < 1e-12


def test_a_second_run_reads_the_outlines_and_gives_the_same_result(example_run: Run) -> None:
    stages: list[str] = []
    again = calibrate(example_run.folder, progress=lambda stage, done, total: stages.append(stage))
    assert "Recognising legs" in example_run.stages
    assert not any("outlines" in stage or "Recognising" in stage for stage in stages)
    difference = (
        again.solution.parameters.base_joints
        - example_run.calibration.solution.parameters.base_joints
    )
    assert np.abs(difference).max() < 1e-12


def test_the_criteria_as_printed_end_far_away_and_do_not_harm_the_fit(example_run: Run) -> None:
    literal = calibrate(example_run.folder, criteria="literal")
    default = example_run.calibration
    assert literal.steps.legs is not None
    assert default.steps.legs is not None
    fitted = default.solution.parameters
    off = [
        np.abs(np.array([leg.A for leg in legs]) - fitted.base_joints).max()
        for legs in (default.steps.legs, literal.steps.legs)
    ]
    assert off[1] > 3.0 * off[0]
    assert np.abs(literal.solution.parameters.base_joints - fitted.base_joints).max() < 1e-9


def test_the_readme_tells_the_accuracy_that_is_measured(example_run: Run) -> None:
    readme = (ROOT / "README.md").read_text()
    number = r"\*{0,2}([\d.]+) (?:mm|deg)\*{0,2}"
    # Processors round differently, and a block of an edge more or less moves the fit a little.
    for label, model, within in (
        ("nominal model", HEXAPOD / "models/hexapod.yaml", 0.01),
        ("joint fit of all outlines", example_run.output / "calibrated.yaml", 0.3),
    ):
        told = re.search(rf"\| {label}[^|]*\| {number} \| {number} \|", readme)
        assert told is not None, label
        found = evaluate(model, TRUTH, dataset=HEXAPOD)
        assert 1e3 * found.displacement.mean() == pytest.approx(float(told[1]), rel=within)
        assert np.degrees(found.rotation.mean()) == pytest.approx(float(told[2]), rel=within)


def test_an_edited_row_wins_and_is_kept(example_run: Run, tmp_path: Path) -> None:
    folder = Path(shutil.copytree(example_run.folder, tmp_path / "edited"))
    path = folder / "observations.csv"
    lines = path.read_text().splitlines()
    k = next(i for i, line in enumerate(lines) if ",used,,detected," in line)
    lines[k] = lines[k].replace(",used,,detected", ",rejected,a reflection,edited")
    assert not lines[k].endswith(",,,")  # how well it was seen
    path.write_text("\n".join(lines) + "\n")
    result = calibrate(folder, output=tmp_path / "out")
    key = ",".join(lines[k].split(",")[:5])
    for table in (path, tmp_path / "out/observations.csv"):
        kept = [line for line in table.read_text().splitlines() if line.startswith(key + ",")]
        assert len(kept) == 1
        assert ",rejected,a reflection,edited," in kept[0]
    assert (
        result.solution.outlines.used.sum() < example_run.calibration.solution.outlines.used.sum()
    )


def _reordered(folder: Path) -> None:
    """Turn the order of rows, columns, legs and views around."""
    header, *rows = _table(folder)
    columns = [*range(len(header) - 1, -1, -1)]
    _write_table(folder, [[line[c] for c in columns] for line in [header, *rows[::-1]]])
    entry = _entry(folder)
    entry["views"] = dict(reversed(entry["views"].items()))
    _write_entry(folder, entry)
    model = folder / "models/hexapod.yaml"
    machine = yaml.safe_load(model.read_text())
    machine["legcal"]["legs"] = dict(reversed(machine["legcal"]["legs"].items()))
    for key in ("closed_loop", "type", "name_mot"):
        machine[key] = machine[key][::-1]
    model.write_text(yaml.safe_dump(machine, sort_keys=False))


@pytest.mark.parametrize("shown", thinned(["outlines", "photographs"], ["outlines"]))
def test_the_order_of_rows_columns_legs_and_views_does_not_matter(
    example_run: Run, tmp_path: Path, shown: str
) -> None:
    results = []
    for name in ("given", "reordered"):
        folder = copy_of_the_example(tmp_path / name)
        if shown == "outlines":
            shutil.rmtree(folder / "images")
            shutil.copy(example_run.folder / "observations.csv", folder)
        else:
            header, *rows = _table(folder)
            _write_table(folder, [header, *rows[0:3], *rows[15:18], *rows[30:33]])
        if name == "reordered":
            _reordered(folder)
        results.append(calibrate(folder))
    given, reordered = results
    names = given.dataset.machine.leg_names
    legs = [reordered.dataset.machine.leg_names.index(leg) for leg in names]
    one, other = given.solution.parameters, reordered.solution.parameters
    assert legs == [5, 4, 3, 2, 1, 0]
    assert np.abs(one.base_joints - other.base_joints[legs]).max() < 1e-12
    assert np.abs(one.platform_joints - other.platform_joints[legs]).max() < 1e-12
    assert np.abs(one.offsets - other.offsets[legs]).max() < 1e-12
    assert set(given.solution.names) == set(reordered.solution.names)
    sigma = dict(zip(reordered.solution.names, reordered.solution.sigma, strict=True))
    for parameter, value in zip(given.solution.names, given.solution.sigma, strict=True):
        assert sigma[parameter] == pytest.approx(value, rel=1e-6)


def test_outlines_without_photographs_are_enough(example_run: Run, tmp_path: Path) -> None:
    folder = Path(shutil.copytree(example_run.folder, tmp_path / "outlines"))
    shutil.rmtree(folder / "images")
    (folder / ".legcal-cache.json").unlink()
    result = calibrate(folder)
    expected = example_run.calibration.solution.parameters
    assert np.abs(result.solution.parameters.base_joints - expected.base_joints).max() < 1e-12


def test_too_few_images_are_refused_with_both_numbers(tmp_path: Path) -> None:
    folder = copy_of_the_example(tmp_path / "two")
    header, *rows = _table(folder)
    _write_table(folder, [header, rows[0], rows[15]])
    with pytest.raises(NotIdentifiable, match=r"determine \d+ of 30 at best and leave open \d"):
        calibrate(folder, output=tmp_path / "out")
    assert not (tmp_path / "out").exists()


def test_what_the_steps_alone_leave_open_is_noted(example_run: Run, tmp_path: Path) -> None:
    folder = Path(shutil.copytree(example_run.folder, tmp_path / "narrow"))
    entry = _entry(folder)
    entry["views"]["c1"]["legs"] = entry["views"]["c3"]["legs"] = ["leg1", "leg2", "leg3"]
    entry["views"]["c2"]["legs"] = ["leg4", "leg5", "leg6"]
    _write_entry(folder, entry)
    notes = check_identifiable(load_dataset(folder))
    assert len(notes) == 1
    assert re.match(
        r"The four steps alone leave open 12 independent .*z of base joint 2;", notes[0]
    )


@pytest.mark.slow  # test_recognise.py has the same in seconds
def test_no_and_wrong_camera_poses_end_where_right_ones_do(
    example_run: Run, tmp_path: Path
) -> None:
    folder = copy_of_the_example(tmp_path / "unknown")
    entry = _entry(folder)
    entry["views"]["c1"]["T_base_camera"]["quat_xyzw"] = [0.0, 0.0, 0.0, 1.0]
    for name in ("c2", "c3"):
        del entry["views"][name]["T_base_camera"]
    _write_entry(folder, entry)
    found = calibrate(folder)
    assert [note for note in found.notes if note.startswith("view c1: its T_base_camera is")]
    right = example_run.calibration.solution
    apart = [found.solution.values[name] - right.values[name] for name in right.names]
    assert np.all(np.abs(apart) < right.sigma)


def test_an_output_folder_with_other_files_is_left_alone(tmp_path: Path) -> None:
    (tmp_path / "out").mkdir()
    (tmp_path / "out/thesis.tex").write_text("years of work")
    with pytest.raises(UsageError, match="other files"):
        calibrate(HEXAPOD, output=tmp_path / "out")
    assert [path.name for path in (tmp_path / "out").iterdir()] == ["thesis.tex"]


def test_an_interrupted_run_leaves_nothing_behind(
    example_run: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def interrupted(*args: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr("legcal.calibration.result_folder.write_observations", interrupted)
    with pytest.raises(KeyboardInterrupt):
        calibrate(example_run.folder, output=tmp_path / "out")
    assert list(tmp_path.iterdir()) == []


def test_a_view_without_images_is_noted_and_gets_no_pose(example_run: Run, tmp_path: Path) -> None:
    folder = Path(shutil.copytree(example_run.folder, tmp_path / "spare"))
    entry = _entry(folder)
    entry["views"]["spare"] = {"camera": "camera_info.yaml"}
    _write_entry(folder, entry)
    header, *rows = _table(folder)
    _write_table(folder, [header, *rows[0:3], *rows[15:18], *rows[30:33]])  # searched again
    calibration = calibrate(folder, output=tmp_path / "out")
    assert any("view spare has no row" in note for note in calibration.notes)
    document = json.loads((tmp_path / "out/result.json").read_text())
    assert set(document["views"]) == {"c1", "c2", "c3"}


def test_a_dataset_can_be_loaded_first(example_run: Run) -> None:
    dataset = load_dataset(example_run.folder)
    assert calibrate(dataset).solution.start == example_run.calibration.solution.start
    with pytest.raises(LegcalError):
        load_dataset(example_run.folder / "nothing")
