"""Common mistakes of owners are named: in readings, models and images that disagree."""

import pickle
from collections.abc import Callable
from pathlib import Path

import pytest
from hexapod_example import Spoiled, spoiled
from simulated import simulated

from legcal import calibrate, load_dataset
from legcal.calibration.diagnosis.diagnosis import diagnose
from legcal.calibration.diagnosis.mistakes import mistakes
from legcal.calibration.ordered_dataset import order_dataset
from legcal.errors import DatasetError, NotVisible
from legcal.progress import no_progress
from legcal.workers import in_turn

COLUMNS = [f"leg{k}_prismatic" for k in range(1, 7)]


def _exchange(one: str, other: str) -> Callable[[Spoiled], None]:
    def change(session: Spoiled) -> None:
        for row in session.rows:
            row[one], row[other] = row[other], row[one]

    return change


def _numbers(change: Callable[[float], float]) -> Callable[[Spoiled], None]:
    def of_all(session: Spoiled) -> None:
        for row in session.rows:
            row.update({name: f"{change(float(row[name])):.9f}" for name in COLUMNS})

    return of_all


@pytest.mark.system  # fifty mistakes are tried
def test_a_fit_with_exchanged_columns_is_not_trusted_and_they_are_named(tmp_path: Path) -> None:
    session = spoiled(tmp_path / "set", 5, ("c1", "c2"))
    _exchange("leg2_prismatic", "leg3_prismatic")(session)
    calibration = calibrate(session.write())
    (found,) = calibration.diagnosis
    assert found.what == "columns leg2_prismatic and leg3_prismatic look exchanged"
    assert found.after == found.images == 10
    assert not calibration.verdict.trustworthy
    assert found.sentence in calibration.verdict.sentence
    assert "known to" in calibration.verdict.sentence
    assert calibration.notes[0] == found.sentence
    block = calibration.result.document()["diagnosis"]
    assert [one["kind"] for one in block] == ["columns exchanged"]


def test_refusals_carry_the_diagnosis_to_other_processes() -> None:
    error = NotVisible(["Columns look exchanged.", "No view could be placed."])
    error.diagnosis = ({"kind": "columns exchanged"},)
    again = pickle.loads(pickle.dumps(error))
    assert (again.problems, again.diagnosis) == (error.problems, error.diagnosis)


def test_nothing_is_wrong_with_a_session_that_is_right(tmp_path: Path) -> None:
    session = spoiled(tmp_path / "set", 4, ("c1", "c2"))
    data = order_dataset(load_dataset(session.write()), in_turn, no_progress)
    assert diagnose(data) == ()


@pytest.mark.parametrize("model", ["3-rpr", "3-upu-tilted", "tricept", "hexapod-strut"])
def test_every_mistake_can_be_tried_on_every_kind_of_machine(model: str, tmp_path: Path) -> None:
    """Legs of other types, constant and passive ones, a plane: joints are known or left out."""
    dataset = load_dataset(simulated(tmp_path / "set", model).folder)
    data = order_dataset(dataset, in_turn, no_progress)
    tried = mistakes(data)
    assert {"columns exchanged", "readings shifted", "handedness"} <= {one.kind for one in tried}
    for one in tried:
        A, B = one.true.joints(range(6))
        assert A.shape == B.shape == (6, data.machine.n_legs, 3)


@pytest.mark.parametrize(
    ("change", "cause"),
    [
        (lambda q: 1e3 * q, "millimetres: divide the column by 1000"),
        (lambda q: q + 0.345, "whole leg lengths: subtract"),
        (lambda q: 1e3 * (q + 0.345), "whole leg lengths in millimetres"),
        (lambda q: 1e2 * q, "centimetres"),
        (lambda q: q / 0.0254, "inches"),
        (lambda q: -q - 0.01, "readings with the opposite sign"),
    ],
)
def test_readings_outside_the_travel_are_called_what_they_look_like(
    change: Callable[[float], float], cause: str, tmp_path: Path
) -> None:
    session = spoiled(tmp_path / "set", 4, ("c1",))
    _numbers(change)(session)
    with pytest.raises(DatasetError) as refusal:
        load_dataset(session.write())
    assert len(refusal.value.problems) == 6
    assert all(f"these look like {cause}" in problem for problem in refusal.value.problems)
