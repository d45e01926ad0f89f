"""The whole path on a table of axes: no image is searched, the fit takes the axes as they are."""

import csv
import io
import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import yaml
from axes_dataset import MODEL, write_axes_dataset
from rich.console import Console

from legcal import calibrate, load_dataset, load_mechanism
from legcal.calibration.identify.judge import identifiability_of_dataset
from legcal.calibration.identify.planning import recorded_session
from legcal.calibration.verdict import Calibration
from legcal.errors import DatasetError, DidNotConverge, NotIdentifiable, UsageError
from legcal.machine import to_vector
from legcal.report import summary
from legcal.simulation.hexapod import PAPER_VIEWS, PaperHexapod

Rows = list[dict[str, str]]


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, PaperHexapod, Calibration]:
    folder = tmp_path_factory.mktemp("axes")
    machine = write_axes_dataset(folder / "set")
    return folder, machine, calibrate(folder / "set", output=folder / "result")


@pytest.fixture
def dataset(tmp_path: Path) -> Path:
    write_axes_dataset(tmp_path / "set", n_poses=5)
    return tmp_path / "set"


def _change(path: Path, change: Callable[[Rows], Rows]) -> None:
    """Change the rows of a table."""
    with path.open(newline="") as file:
        rows = list(csv.DictReader(file))
    with path.open("w", newline="") as file:
        writer = csv.DictWriter(file, rows[0].keys())
        writer.writeheader()
        writer.writerows(change(rows))


def test_the_result_is_right_by_its_own_sigmas(run: tuple[Path, PaperHexapod, Calibration]) -> None:
    _, machine, calibration = run
    solution = calibration.solution
    error = to_vector(solution.parameters, machine.frame_legs) - to_vector(
        machine.parameters, machine.frame_legs
    )
    squared = error @ np.linalg.solve(solution.kinematic_covariance, error) / len(error)
    assert 0.4 < squared < 1.9  # chi-square of 30 degrees, over 30: these are beyond 1 in 1000
    assert solution.chi2 / solution.dof == pytest.approx(1.0, abs=0.25)
    assert calibration.verdict.trustworthy
    nominal = to_vector(load_mechanism(MODEL).parameters, machine.frame_legs)
    before = np.abs(to_vector(machine.parameters, machine.frame_legs) - nominal)
    assert np.sqrt(np.mean(error**2)) < 0.1 * np.sqrt(np.mean(before**2))


def test_the_four_steps_run_on_the_axes_too(run: tuple[Path, PaperHexapod, Calibration]) -> None:
    assert run[2].steps.legs is not None


def test_the_result_has_residuals_of_axes_and_no_outlines(
    run: tuple[Path, PaperHexapod, Calibration],
) -> None:
    folder, _, calibration = run
    document = json.loads((folder / "result" / "result.json").read_text())
    assert document["residuals"]["rms_px"] is None
    assert document["residuals"]["rms_axes"] == pytest.approx(1.0, abs=0.2)
    assert set(document["views"]) == {"c1", "c2", "c3"}
    assert not [row for row in document["parameters"] if "radius" in row["name"]]
    written = sorted(path.name for path in (folder / "result").iterdir())
    assert written == ["calibrated.urdf", "calibrated.yaml", "result.json"]
    assert not (folder / "set" / "observations.csv").exists()
    console = Console(file=io.StringIO(), width=200, record=True)
    console.print(summary(calibration, folder / "result"))
    text = console.export_text()
    assert "Axes: 120 in 30 images" in text
    assert "of their standard deviations, rms" in text
    assert "px" not in text


def test_outlines_of_an_earlier_result_do_not_stay_beside_one_of_axes(dataset: Path) -> None:
    result = dataset.parent / "result"
    result.mkdir()
    (result / "result.json").write_text('{"legcal_result": 1}')
    (result / "observations.csv").write_text("of an earlier result")
    calibrate(dataset, output=result)
    assert not (result / "observations.csv").exists()


def test_images_are_not_looked_at(tmp_path: Path) -> None:
    write_axes_dataset(tmp_path / "set", n_poses=5, images=True)
    stages: list[str] = []
    calibrate(tmp_path / "set", progress=lambda stage, done, total: stages.append(stage))
    assert set(stages) == {"Four steps", "Joint fit"}


def test_the_order_of_rows_changes_nothing(dataset: Path) -> None:
    before = calibrate(dataset).solution
    rng = np.random.default_rng(0)
    for name in ("axes.csv", "measurements.csv"):
        _change(dataset / name, lambda rows: [rows[i] for i in rng.permutation(len(rows))])
    after = calibrate(dataset).solution
    assert np.array_equal(before.parameters.base_joints, after.parameters.base_joints)
    assert np.array_equal(before.covariance, after.covariance)


def test_a_view_shows_the_legs_that_have_axes_in_it(dataset: Path) -> None:
    loaded = load_dataset(dataset)
    assert identifiability_of_dataset(loaded).identifiable
    seen = recorded_session(loaded).seen
    assert [np.flatnonzero(row).tolist() for row in seen] == [list(legs) for legs in PAPER_VIEWS]


def test_axes_of_too_few_legs_are_refused_before_any_fit(dataset: Path) -> None:
    _change(dataset / "axes.csv", lambda rows: [row for row in rows if row["leg"] == "leg3"])
    _change(dataset / "measurements.csv", lambda rows: [r for r in rows if r["view"] != "c3"])
    with pytest.raises(NotIdentifiable, match="the parameters cannot be identified"):
        calibrate(dataset)


def test_axes_of_legs_that_a_view_leaves_out_are_not_used(dataset: Path) -> None:
    entry = yaml.safe_load((dataset / "dataset.yaml").read_text())
    entry["views"]["c1"]["legs"] = ["leg1", "leg2", "leg3"]
    (dataset / "dataset.yaml").write_text(yaml.safe_dump(entry))
    loaded = load_dataset(dataset)
    assert loaded.axes is not None
    assert len(loaded.axes) == 15 * 4 - 5
    assert any("5 axes of legs that their views leave out" in note for note in loaded.notes)
    for view in entry["views"].values():
        view["legs"] = ["leg1"]
    entry["views"]["c1"]["legs"] = ["leg6"]
    entry["views"]["c2"]["legs"] = ["leg1"]
    entry["views"]["c3"]["legs"] = ["leg3"]
    (dataset / "dataset.yaml").write_text(yaml.safe_dump(entry))
    with pytest.raises(DatasetError, match="found only legs that their views leave out"):
        load_dataset(dataset)


def test_axes_and_outlines_at_once_are_refused(dataset: Path) -> None:
    (dataset / "observations.csv").write_text("view\n")
    with pytest.raises(DatasetError, match=r"found axes\.csv and observations\.csv, needed"):
        load_dataset(dataset)


def test_a_row_without_axes_is_refused(dataset: Path) -> None:
    _change(dataset / "axes.csv", lambda rows: [row for row in rows if row["image"] != "p3"])
    with pytest.raises(DatasetError, match="row 4: the row could not be used: found no axis of it"):
        load_dataset(dataset)


def test_axes_with_sigmas_that_are_too_small_are_noted(dataset: Path) -> None:
    def shrunk(rows: Rows) -> Rows:
        names = [name for name in rows[0] if name.startswith("sigma")]
        return [row | {name: repr(float(row[name]) / 4.0) for name in names} for row in rows]

    _change(dataset / "axes.csv", shrunk)
    calibration = calibrate(dataset)
    note = next(note for note in calibration.notes if "worse than their standard" in note)
    assert "is about 3." in note or "is about 4." in note


def test_axes_of_another_machine_are_refused(dataset: Path) -> None:
    names = {f"leg{j}": f"leg{j % 6 + 1}" for j in range(1, 7)}
    _change(dataset / "axes.csv", lambda rows: [row | {"leg": names[row["leg"]]} for row in rows])
    with pytest.raises(
        DidNotConverge, match=r"axes are those of the right legs|axes disagree with it"
    ):
        calibrate(dataset, output=dataset.parent / "result")
    assert not (dataset.parent / "result").exists()


def test_axes_are_not_kept_aside(dataset: Path) -> None:
    with pytest.raises(UsageError, match="no images could be kept aside: found a table of axes"):
        calibrate(dataset, holdout=0.2)
