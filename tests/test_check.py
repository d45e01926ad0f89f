"""Has it moved: new images of the same machine, of one that was touched, and of others."""

import csv
import json
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from simulated import settings
from typer.testing import CliRunner

from legcal import calibrate, check
from legcal.calibration import Result
from legcal.calibration.pipeline import Estimate, estimate_session
from legcal.cli.app import app
from legcal.errors import DatasetError, LegcalError, NotVisible, UsageError
from legcal.machine import geometries, load_mechanism, moved_legs, parametrization_of, vector_of
from legcal.machine.written import turns_between
from legcal.simulation.dataset import simulate

MODEL = "3-rpr"


@pytest.fixture(scope="module")
def result(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The result of a calibration."""
    folder = tmp_path_factory.mktemp("earlier")
    made = simulate(MODEL, folder / "set", settings(poses=8, views=2))
    calibrate(made.folder, output=folder / "result", holdout=0.2)
    return folder / "result"


@pytest.fixture(scope="module")
def images(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A few new images of the same machine."""
    folder = tmp_path_factory.mktemp("new") / "set"
    return simulate(MODEL, folder, settings(poses=4, views=1)).folder


def _with_offset(images: Path, folder: Path, leg: str, change: float) -> Path:
    """Copy images of a machine whose encoder has slipped by a change [m]."""
    shutil.copytree(images, folder)
    with (folder / "measurements.csv").open(newline="") as file:
        header, *rows = csv.reader(file)
    column = header.index(f"{leg}_prismatic")
    for row in rows:
        row[column] = repr(float(row[column]) - change)
    with (folder / "measurements.csv").open("w", newline="") as file:
        csv.writer(file).writerows([header, *rows])
    return folder


def test_a_machine_that_was_left_alone_has_not_moved(result: Path, images: Path) -> None:
    before = {path: path.read_bytes() for path in images.rglob("*") if path.is_file()}
    found = check(images, result)
    assert not found.movement.moved
    assert found.movement.explanations == ()
    assert found.at_platform.displacement < 4.0 * found.at_platform.expected_displacement
    assert "Nothing has moved" in found.sentence
    assert {path: path.read_bytes() for path in images.rglob("*") if path.is_file()} == before


def test_an_encoder_that_slipped_is_noticed_and_named(
    result: Path, images: Path, tmp_path: Path
) -> None:
    slipped = _with_offset(images, tmp_path / "slipped", "leg2", 3e-4)
    found = check(slipped, result)
    assert found.movement.moved
    best = found.movement.explanations[0]
    assert best.change.what == "offset of leg2"
    assert best.values[0] == pytest.approx(3e-4, abs=4.0 * best.sigma[0])
    assert 0.0 < best.sigma[0] < 1e-4
    assert found.at_platform.displacement > found.at_platform.expected_displacement


def test_a_machine_with_all_legs_elsewhere_is_told_so(result: Path, tmp_path: Path) -> None:
    other = simulate(MODEL, tmp_path / "set", settings(poses=4, views=1, seed=6)).folder
    found = check(other, result)
    assert found.movement.moved
    best, *others = found.movement.explanations
    assert best.p_value < found.movement.significance
    assert all(best.remaining <= explanation.remaining for explanation in others)
    assert found.at_platform.displacement > 1e-3
    assert "Something has moved" in found.sentence


def test_the_command_says_it_in_json_and_by_its_exit_code(
    result: Path, images: Path, tmp_path: Path
) -> None:
    slipped = _with_offset(images, tmp_path / "slipped", "leg1", -5e-4)
    for folder, code in ((images, 0), (slipped, 1)):
        arguments = ["calibrate", str(folder), "--check", str(result / "result.json")]
        run = CliRunner().invoke(app, [*arguments, "--json"])
        assert run.exit_code == code
        document = json.loads(run.stdout)
        assert document["moved"] == (code == 1)
        assert document["significance"] == 0.01
        assert bool(document["explanations"]) == (code == 1)
        told = CliRunner().invoke(app, [*arguments, "--significance", "0.001"])
        assert told.exit_code == code
        assert "significance 0.1 %" in " ".join(told.stdout.split())
    assert sorted(path.name for path in tmp_path.iterdir()) == ["slipped"]


def test_held_out_images_are_in_the_result(result: Path) -> None:
    found = json.loads((result / "result.json").read_text())["holdout"]
    assert (found["images"], found["wrong"]) == (3, 0)
    assert found["rms_px"] == pytest.approx(found["expected_px"], rel=0.5)
    assert found["platform"]["poses"] == 3
    assert 0.0 < found["platform"]["dX_m"] < 4.0 * found["platform"]["expected_dX_m"]
    assert set(found["views"]) <= {"c1", "c2"}


def test_a_result_is_read_back_as_it_was_written(result: Path) -> None:
    path = result / "result.json"
    written = json.loads(path.read_text())
    read = Result.read(path).document()
    assert read == written
    assert list(read) == list(written)


Spoil = Callable[[Path, dict[str, Any]], None]


def _no_document(folder: Path, document: dict[str, Any]) -> None:
    (folder / "result.json").unlink()


def _not_json(folder: Path, document: dict[str, Any]) -> None:
    (folder / "result.json").write_text("{")


def _another_document(folder: Path, document: dict[str, Any]) -> None:
    del document["legcal_result"]


def _later_version(folder: Path, document: dict[str, Any]) -> None:
    document["legcal_result"] = 2


def _short_covariance(folder: Path, document: dict[str, Any]) -> None:
    document["covariance"].pop()


def _other_covariance(folder: Path, document: dict[str, Any]) -> None:
    document["covariance"][0][1] *= -1.0


def _other_kinematic_covariance(folder: Path, document: dict[str, Any]) -> None:
    document["kinematic"]["covariance"][0][1] += 1.0


def _other_kinematic_names(folder: Path, document: dict[str, Any]) -> None:
    document["kinematic"]["names"][0] = "leg9.base.x"


def _short_held_direction(folder: Path, document: dict[str, Any]) -> None:
    document["kinematic"]["held"].append([1.0])


def _unknown_shared_error(folder: Path, document: dict[str, Any]) -> None:
    document["residuals"]["shared_px"]["bias of nothing"] = 0.1


def _negative_sigma(folder: Path, document: dict[str, Any]) -> None:
    document["parameters"][0]["sigma"] = -1e-5


def _missing_parameter(folder: Path, document: dict[str, Any]) -> None:
    row = document["parameters"].pop(0)
    where = 0 if row["status"] == "estimated" else None
    if where is not None:
        kept = [line[1:] for line in document["covariance"][1:]]
        document["covariance"] = kept


def _other_value(folder: Path, document: dict[str, Any]) -> None:
    document["parameters"][0]["value"] += 1e-6


def _no_model(folder: Path, document: dict[str, Any]) -> None:
    (folder / "calibrated.yaml").unlink()


@pytest.mark.parametrize(
    ("spoil", "message"),
    [
        (_no_document, "found no such file"),
        (_not_json, "found no JSON"),
        (_another_document, "found another document, needed one with 'legcal_result: 1'"),
        (_later_version, "legcal_result could not be read: found 2"),
        (_short_covariance, r"found \d+ rows of \d+ numbers"),
        (_other_covariance, "needed a covariance of the"),
        (_other_kinematic_covariance, "found another matrix in 'kinematic'"),
        (_other_kinematic_names, r"found those of \d+ others"),
        (_short_held_direction, "found rows of other lengths"),
        (_unknown_shared_error, "found the shared errors 'bias of nothing', needed bias of many"),
        (_negative_sigma, "sigma could not be read"),
        (_missing_parameter, "found other values of leg"),
        (_other_value, "found other values of leg"),
        (_no_model, "found no such file"),
    ],
)
def test_a_damaged_result_is_refused(
    result: Path, images: Path, tmp_path: Path, spoil: Spoil, message: str
) -> None:
    folder = Path(shutil.copytree(result, tmp_path / "result"))
    document = json.loads((folder / "result.json").read_text())
    spoil(folder, document)
    if (folder / "result.json").exists() and spoil is not _not_json:
        (folder / "result.json").write_text(json.dumps(document))
    with pytest.raises(LegcalError, match=message) as refused:
        check(images, folder)
    assert refused.value.exit_code == 2


def test_the_result_of_another_machine_is_refused(result: Path, tmp_path: Path) -> None:
    other = simulate("tricept", tmp_path / "set", settings(poses=2, views=1)).folder
    with pytest.raises(DatasetError, match="found the result of another machine, with the legs"):
        check(other, result)


@pytest.mark.parametrize("significance", [0.0, 1.0, -1.0, float("nan"), 5.0])
def test_a_significance_that_is_none_is_refused(
    result: Path, images: Path, significance: float
) -> None:
    with pytest.raises(UsageError, match="found the significance"):
        check(images, result, significance=significance)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--check", "r", "-o", "out"], "found --output beside --check"),
        (["--check", "r", "--criteria", "literal"], "found --criteria beside --check"),
        (["--check", "r", "--transformation", "points"], "found --transformation beside --check"),
        (["--check", "r", "--holdout", "0.2", "--fix", "*.offset"], "--fix, --holdout beside"),
        (["-o", "out", "--significance", "0.05"], "found --significance without --check"),
        ([], r"found no --output \(-o\)"),
        (["-o", "out", "--holdout", "1.5"], "found the fraction 1.5"),
    ],
)
def test_options_that_do_not_go_together_are_refused(
    images: Path, tmp_path: Path, options: list[str], message: str
) -> None:
    run = CliRunner().invoke(app, ["calibrate", str(images), *options])
    assert isinstance(run.exception, UsageError)
    with pytest.raises(UsageError, match=message):
        raise run.exception


def test_an_image_that_says_nothing_is_refused(result: Path, images: Path, tmp_path: Path) -> None:
    blank = Path(shutil.copytree(images, tmp_path / "blank"))
    with (blank / "observations.csv").open(newline="") as file:
        header, *rows = csv.reader(file)
    column = header.index("verdict")
    for row in rows:
        row[column] = "rejected"
    with (blank / "observations.csv").open("w", newline="") as file:
        csv.writer(file).writerows([header, *rows])
    with pytest.raises(NotVisible, match="found no used outline in any image"):
        check(blank, result)


def test_what_is_said_of_the_images_is_passed_on(
    result: Path, images: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    left_out = "view c1, image k01: was left out: the image is black; take it again."
    doubt = "view c1, image k02: its reading does not agree with its outlines."

    def noted(*arguments: Any) -> Estimate:
        return replace(
            estimate_session(*arguments), image_notes=(left_out, doubt), fit_notes=(doubt,)
        )

    monkeypatch.setattr("legcal.calibration.verification.estimate_session", noted)
    found = check(images, result)
    assert [note for note in found.notes if "view c1, image" in note] == [left_out, doubt]
    assert set(found.document()["notes"]) >= {left_out, doubt, *found.solution.notes}


@pytest.mark.parametrize("model", ["3-upu-tilted", "tricept"])
def test_covariances_of_turned_axes_are_taken_along(model: str) -> None:
    machine = load_mechanism(model)
    nominal, found = geometries(machine), parametrization_of(machine, twists=True)
    rng = np.random.default_rng(4)
    is_angle = np.array(found.units) == "rad"
    far = np.where(is_angle, rng.uniform(-0.1, 0.1, len(found)), 0.0)
    calibrated = moved_legs(nominal, found.place, far)
    start, here = (vector_of(found, calibrated, legs) for legs in (nominal, calibrated))
    turns = turns_between(found, calibrated, nominal)
    for i in np.flatnonzero(is_angle):
        step = np.zeros(len(found))
        step[i] = 1e-6
        moved = moved_legs(nominal, found.place, far + step)
        by_calibrated = (vector_of(found, moved, calibrated) - here) / 1e-6
        by_nominal = (vector_of(found, moved, nominal) - start) / 1e-6
        np.testing.assert_allclose(turns @ by_nominal, by_calibrated, atol=1e-4)
