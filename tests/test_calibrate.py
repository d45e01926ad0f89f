"""The whole path from a dataset to the result folder: recovery, invariance, verdict, refusals.

What commands write for small sessions of all classes is compared in test_recorded_sessions.py.
"""

import re
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from csv_rows import read_rows, write_rows
from edits import Edit, document, kept
from hexapod_example import HEXAPOD, ROOT, TRUTH, Run
from simulated import files_of, simulated

from legcal import Calibration, calibrate, evaluate, load_mechanism, load_result
from legcal.calibration.four_steps import Steps
from legcal.calibration.joint_fit.platform import poses_at_readings
from legcal.calibration.result_folder import write_result
from legcal.calibration.summary import sentences
from legcal.calibration.verdict import judge
from legcal.errors import DatasetError, LegcalError, NotVisible
from legcal.machine.kinematics import pose_differences
from legcal.machine.parameters import geometries, vector_of
from legcal.simulation.dataset import SimulatedDataset

Row = dict[str, str]
Rows = list[Row]
PLANAR = "3-rpr"


def _change(path: Path, change: Callable[[Rows], Rows]) -> Rows:
    """Change the rows of a table; return them."""
    rows = change(read_rows(path))
    write_rows(path, rows)
    return rows


def _simulated(
    folder: Path, model: str = PLANAR, *, poses: int = 6, **changes: Any
) -> SimulatedDataset:
    return simulated(folder / "set", model, poses=poses, **changes)


@pytest.fixture(scope="module")
def planar(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Calibration]:
    """Outlines of a planar machine in three views, and their calibration, with ``result``."""
    folder = _simulated(tmp_path_factory.mktemp("planar"), views=3).folder
    return folder, calibrate(folder, output=folder.parent / "result")


# Invariance.


def _rotated(folder: Path) -> None:
    """Rotate the order of rows, columns, legs and views by one: no such order is its inverse."""

    def rotated(entry: dict[str, Any]) -> dict[str, Any]:
        (first, value), *others = entry.items()
        return {**dict(others), first: value}

    for table in ("measurements.csv", "observations.csv"):
        _change(folder / table, lambda rows: [rotated(row) for row in [*rows[1:], rows[0]]])
    document("dataset.yaml", lambda e: e.update(views=rotated(e["views"])))(folder)
    legs = f"models/{PLANAR}.yaml"
    document(legs, lambda e: e["legcal"].update(legs=rotated(e["legcal"]["legs"])))(folder)


def _by_name(calibration: Calibration) -> dict[str, Any]:
    """Return what a result says of every name, whatever their order."""
    found = calibration.result
    names = [row.name for row in found.parameters if row.status == "estimated"]
    order, legs = np.argsort(names), np.argsort(found.legs)
    kinematic = np.argsort(found.kinematic.names)
    assert found.stages is not None
    staged: Any = found.stages.staged
    outlines, m = calibration.solution.outlines, calibration.dataset.measurements
    of_rows = zip(outlines.row.tolist(), outlines.leg.tolist(), outlines.edge, strict=True)
    keys = [
        (m.views[m.view[r]].name, m.pose_labels[m.pose[r]], found.legs[j], e) for r, j, e in of_rows
    ]
    return {
        "values": [row.value for row in sorted(found.parameters, key=lambda row: row.name)],
        "covariance": np.array(found.covariance)[np.ix_(order, order)],
        "kinematic": np.array(found.kinematic.covariance)[np.ix_(kinematic, kinematic)],
        "base": np.array(found.base_joints)[legs],
        "platform": np.array(found.platform_joints)[legs],
        "offsets": np.array(found.offsets)[legs],
        "staged": np.array(staged.base_joints)[legs],
        "cameras": [found.views[v].T_base_camera.xyz for v in sorted(found.views)],
        "outlines": outlines.h[sorted(range(len(keys)), key=keys.__getitem__)],
    }


def test_the_order_of_rows_columns_legs_and_views_does_not_matter(
    planar: tuple[Path, Calibration], tmp_path: Path
) -> None:
    folder = Path(shutil.copytree(planar[0], tmp_path / "rotated"))
    _rotated(folder)
    other = calibrate(folder)
    names = planar[1].dataset.machine.leg_names
    assert other.dataset.machine.leg_names == (*names[1:], names[0])
    assert other.dataset.measurements.views[0].name == "c2"
    one, another = _by_name(planar[1]), _by_name(other)
    for key, value in one.items():
        scale = np.abs(value).max()
        np.testing.assert_allclose(another[key], value, atol=1e-7 * scale, err_msg=key)


# The verdict.


def _judged(calibration: Calibration, **changes: Any) -> Calibration:
    solution = replace(calibration.solution, **changes)
    return judge(calibration.dataset, solution, calibration.steps, ())


@pytest.mark.parametrize("part", ["covariance", "held_covariance"])
def test_a_model_is_trusted_if_its_change_exceeds_two_sigma(
    planar: tuple[Path, Calibration], part: str
) -> None:
    calibration = planar[1]
    kinematic = calibration.solution.kinematic
    nothing = np.zeros_like(kinematic.covariance)
    of_one = {"covariance": nothing, "held_covariance": nothing, part: kinematic.covariance}

    def judged(of: dict[str, Any]) -> Calibration:
        return _judged(calibration, kinematic=replace(kinematic, **of))

    platform = judged(of_one).platform
    assert platform is not None
    sigmas = platform.change.mean_displacement / platform.sigma.mean_displacement
    for factor, trusted in ((0.99, True), (1.01, False)):
        scaled = of_one | {part: (0.5 * factor * sigmas) ** 2 * of_one[part]}
        assert judged(scaled).verdict.trustworthy is trusted


# Recovery from outlines.


def test_fit_and_steps_come_nearer_to_the_truth(planar: tuple[Path, Calibration]) -> None:
    folder, found = planar
    out, nominal = folder.parent / "result", found.dataset.machine
    (truth,) = (folder / "truth/models").glob("*.yaml")
    assert found.verdict.trustworthy
    assert found.steps.failure == ""
    assert found.steps.legs is not None
    T, q = found.solution.T_Rb_Re, found.dataset.measurements.q
    true, uncalibrated, staged, fitted = (
        poses_at_readings(nominal, legs, q, T)
        for legs in (
            geometries(load_mechanism(truth)),
            geometries(nominal),
            found.steps.legs,
            found.solution.legs,
        )
    )
    before, by_steps, by_fit = (
        pose_differences(poses, true)[0].mean() for poses in (uncalibrated, staged, fitted)
    )
    assert before > 1e-3
    assert found.platform is not None
    assert by_fit < 3.0 * found.platform.sigma.mean_displacement < 0.2 * before
    assert by_steps < 0.2 * before
    assert not [note for note in found.notes if "no model of the four steps" in note]
    apart = evaluate(out / "staged.yaml", out / "calibrated.yaml", dataset=folder)
    from_fit: Any = found.result.stages.staged
    assert apart.displacement.mean() == pytest.approx(from_fit.from_fit.dX_m, abs=1e-7)
    assert apart.rotation.mean() == pytest.approx(from_fit.from_fit.dE_rad, abs=1e-6)


def test_a_model_of_the_four_steps_that_does_not_load_is_left_out_with_a_note(
    planar: tuple[Path, Calibration], tmp_path: Path
) -> None:
    earlier, found = planar[0].parent / "result", planar[1]
    assert found.steps.legs is not None
    far_away = tuple(replace(leg, A=100.0 * leg.A) for leg in found.steps.legs)
    for k, (steps, said) in enumerate(
        [
            (replace(found.steps, legs=far_away), "model of the four steps (staged.yaml)"),
            (Steps(None, None, "Too few legs."), "no staged.yaml: Too few legs."),
        ]
    ):
        out = shutil.copytree(earlier, tmp_path / f"{k}")
        written = write_result(replace(found, steps=steps), out)
        assert said in written.summary()
        assert k or "that loads and closes" in " ".join(written.summary().split())
        models = ["calibrated.urdf", "calibrated.yaml"]
        assert sorted(files_of(out)) == [*models, "observations.csv", "result.json"]
        assert load_result(out).result.notes == written.result.notes


# Files, refusals and notes.


# A calibration board.


def _moved_aside(entry: dict[str, Any]) -> None:
    entry["views"]["c1"]["T_base_camera"]["xyz"][0] += 0.3


@pytest.mark.parametrize(
    ("spoil", "kind", "named"),
    [
        (kept("corners.csv", 2), NotVisible, "found no image with 4 of its corners or more"),
        (
            document("dataset.yaml", _moved_aside),
            DatasetError,
            "T_base_board and the T_base_camera .* found the board",
        ),
    ],
)
def test_a_board_that_does_not_place_the_cameras_is_refused(
    spoil: Edit, kind: type[LegcalError], named: str, tmp_path: Path
) -> None:
    folder = _simulated(tmp_path, poses=2, views=1, board="charuco", board_pose=True).folder
    spoil(folder)
    with pytest.raises(kind, match=named):
        calibrate(folder)


# The photographs of the example.


def test_photographs_bring_the_platform_within_0_15_mm_and_0_03_deg(example_run: Run) -> None:
    """As much as the README and its evidence say, which processors change a little."""
    readme = (ROOT / "README.md").read_text()
    evidence = (ROOT / "docs/evidence.md").read_text()
    number = r"\*{0,2}([\d.]+) (?:mm|deg)\*{0,2}"
    for label, model, limits, within in (
        ("nominal model", HEXAPOD / "models/hexapod.yaml", (5.0, 1.0), 0.01),
        ("joint fit of all outlines", example_run.output / "calibrated.yaml", (0.15, 0.03), 0.3),
    ):
        found = evaluate(model, TRUTH, dataset=HEXAPOD)
        mean = 1e3 * found.displacement.mean(), np.degrees(found.rotation.mean())
        assert mean < limits
        quoted = re.search(rf"\| {label}[^|]*\| {number} \| {number} \|", evidence)
        assert quoted is not None, label
        assert f"{quoted[1]} mm" in readme
        assert f"{quoted[2]} deg" in readme
        assert mean == pytest.approx((float(quoted[1]), float(quoted[2])), rel=within)


def test_counts_of_rejected_outlines_in_words_add_up(example_run: Run) -> None:
    result = example_run.calibration.result
    rejected = {"hidden": 7, "width": 5, "disagrees": 3, "partner": 2, "faint": 2, "rough": 1}
    seen = result.observations.model_copy(update={"used": 480, "total": 500, "rejected": rejected})
    said = sentences(result.model_copy(update={"observations": seen}))
    (line,) = (one for one in said if one.startswith("Outlines:"))
    used, total, *counts = map(int, re.findall(r"\d+", line))
    assert total - used == sum(counts)


def test_errors_from_photographs_are_as_large_as_their_sigmas(example_run: Run) -> None:
    solution, legs = example_run.calibration.solution, geometries(load_mechanism(TRUTH))
    true, found = (
        vector_of(solution.kinematic.parametrization, g, legs) for g in (legs, solution.legs)
    )
    sigma = np.sqrt(np.diagonal(solution.kinematic.value_covariance))
    pulls = (found - true)[sigma > 0.0] / sigma[sigma > 0.0]
    assert len(pulls) == 30
    assert 0.2 < np.mean(np.square(pulls)) < 2.0
    radii = [row for row in example_run.calibration.result.parameters if ".radius." in row.name]
    assert len(radii) == 6
    for radius in radii:  # light at the limb allows no smaller sigma
        assert radius.sigma is not None
        assert abs(radius.value - 0.01) < 3.0 * radius.sigma < 0.15e-3


def test_a_second_run_searches_no_image(example_run: Run, monkeypatch: pytest.MonkeyPatch) -> None:
    stages: list[str] = []

    def stopped(*_: object, **__: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr("legcal.calibration.pipeline.fit_outlines", stopped)
    assert "Recognising legs" in example_run.stages
    with pytest.raises(KeyboardInterrupt):
        calibrate(example_run.folder, progress=lambda stage, done, total: stages.append(stage))
    assert stages == []


def test_good_photographs_give_no_notes(example_run: Run) -> None:
    exact = "The intrinsics of the camera of views c1, c2, c3 are taken as exact, because its file "
    usual = ("From the ", "The gamma of ", exact)
    assert sum(note.startswith(exact) for note in example_run.calibration.notes) == 1
    assert [note for note in example_run.calibration.notes if not note.startswith(usual)] == []
