"""Common mistakes of owners are named: in readings, models and images that disagree."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hexapod_example import Spoiled, spoiled
from simulated import settings, simulated

from legcal import calibrate, load_dataset
from legcal.calibration.diagnosis import diagnosis
from legcal.calibration.diagnosis.diagnosis import diagnose
from legcal.calibration.diagnosis.mistakes import mistakes
from legcal.calibration.ordered_dataset import order_dataset
from legcal.data.dataset import Dataset
from legcal.data.image_choice import dataset_at
from legcal.data.measurements import row_names
from legcal.geometry.types import Array
from legcal.progress import no_progress
from legcal.simulation.dataset import simulate
from legcal.workers import in_turn


def _exchange(one: str, other: str) -> Callable[[Spoiled], None]:
    def change(session: Spoiled) -> None:
        for row in session.rows:
            row[one], row[other] = row[other], row[one]

    return change


@pytest.mark.system  # fifty mistakes are tried
def test_a_fit_with_exchanged_columns_is_not_trusted_and_they_are_named(tmp_path: Path) -> None:
    session = spoiled(tmp_path / "set", 5, ("c1", "c2"))
    _exchange("leg2_prismatic", "leg3_prismatic")(session)
    calibration = calibrate(session.write())
    (found,) = calibration.diagnosis
    assert found.what == "columns leg2_prismatic and leg3_prismatic appear to be swapped"
    assert found.after == found.images == 10
    assert not calibration.verdict.trustworthy
    assert found.sentence in calibration.verdict.sentence
    assert "known to" in calibration.verdict.sentence
    assert calibration.notes[0] == found.sentence
    block = calibration.result.document()["diagnosis"]
    assert [one["kind"] for one in block] == ["columns exchanged"]


def test_every_mistake_can_be_tried_on_a_machine_with_a_passive_leg(tmp_path: Path) -> None:
    dataset = load_dataset(simulated(tmp_path / "set", "hexapod-strut").folder)
    data = order_dataset(dataset, in_turn, no_progress)
    tried = mistakes(data)
    kinds = {"columns exchanged", "columns rotated", "readings shifted", "handedness"}
    assert kinds <= {one.kind for one in tried}
    for one in tried:
        A, B = one.true.joints(range(6))
        assert A.shape == B.shape == (6, data.machine.n_legs, 3)


def _exchanged(d: Dataset) -> Dataset:
    q = d.measurements.q[:, [0, 1, 3, 2, 4, 5]]
    return replace(d, measurements=replace(d.measurements, q=q))


def _late_in_one_view(d: Dataset) -> Dataset:
    q, rows = d.measurements.q.copy(), np.flatnonzero(d.measurements.view == 1)
    q[rows] = q[np.roll(rows, 1)]
    return replace(d, measurements=replace(d.measurements, q=q))


def _left_handed(d: Dataset) -> Dataset:
    y = np.array([1.0, -1.0, 1.0])
    legs = tuple(replace(leg, A=y * leg.A, B=y * leg.B) for leg in d.machine.legs)
    return replace(d, machine=replace(d.machine, legs=legs))


def _renumbered(d: Dataset) -> Dataset:
    legs = d.machine.legs
    legs = tuple(replace(leg, B=legs[(j + 2) % 6].B) for j, leg in enumerate(legs))
    return replace(d, machine=replace(d.machine, legs=legs))


def _thick(d: Dataset) -> Dataset:
    return replace(d, machine=d.machine.with_radii(lambda _, c: 2.0 * c.radius))


@pytest.fixture(scope="module")
def outlines(tmp_path_factory: pytest.TempPathFactory) -> Dataset:
    folder = tmp_path_factory.mktemp("outlines") / "set"
    simulated(folder, "hexapod", poses=6)
    return load_dataset(folder)


@pytest.mark.parametrize(
    ("change", "what", "other"),
    [
        (_exchanged, "columns leg3_prismatic and leg4_prismatic appear to be swapped", "legs leg3"),
        pytest.param(
            *(_late_in_one_view, "the readings of view c2 appear to be one row late"),
            "",
            marks=pytest.mark.system,
        ),
        pytest.param(
            *(_left_handed, "the model appears mirrored", "the outlines appear to be mirrored"),
            marks=pytest.mark.system,
        ),
        pytest.param(
            *(_renumbered, "the platform joints of the model appear to be numbered", ""),
            marks=pytest.mark.system,
        ),
        (_thick, "the radii of the legs in the model appear to be diameters", ""),
    ],
)
def test_given_outlines_name_a_mistake_as_photographs_do(
    outlines: Dataset,
    change: Callable[[Dataset], Dataset],
    what: str,
    other: str,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    data = order_dataset(change(outlines), in_turn, no_progress)
    alike = (what[:12], "the outlines", "images look")  # the others would take seconds
    few = [one for one in mistakes(data) if one.what.startswith(alike)]
    assert len(few) > 1
    monkeypatch.setattr(diagnosis, "mistakes", lambda _: few)
    (found,) = diagnose(data)
    assert found.what.startswith(what)
    assert found.images == 12
    assert found.after >= 11 > found.before
    assert any(one.startswith(other) for one in found.same_as) or not other
    assert ("To distinguish them" in found.sentence) == bool(found.same_as)


@pytest.mark.system
def test_arms_of_a_delta_that_are_turned_against_its_platform_are_named(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = simulate("delta", tmp_path / "set", settings(poses=6)).folder
    d = load_dataset(folder)
    of = [d.machine.legs[(j + 2) % 6] for j in range(6)]  # two rods an arm
    legs = []
    for leg, other in zip(d.machine.legs, of, strict=True):
        assert leg.actuator is not None
        assert other.actuator is not None
        actuator = replace(other.actuator, joint=leg.actuator.joint)
        legs.append(replace(leg, A=other.A, actuator=actuator))
    turned = replace(d, machine=replace(d.machine, legs=tuple(legs)))
    data = order_dataset(turned, in_turn, no_progress)
    alike = ("the arms", "the platform", "the columns")
    few = [one for one in mistakes(data) if one.what.startswith(alike)]
    monkeypatch.setattr(diagnosis, "mistakes", lambda _: few)
    (found,) = diagnose(data)
    assert found.what.startswith("the arms of the model appear to be turned against the platform")
    assert found.images == 12
    assert found.after >= 11 > found.before


@pytest.fixture(scope="module")
def delta(tmp_path_factory: pytest.TempPathFactory) -> Dataset:
    folder = tmp_path_factory.mktemp("delta") / "set"
    simulate("delta", folder, settings(poses=6))
    return load_dataset(folder)


def _with_readings(d: Dataset, change: Callable[[Array], Array]) -> Dataset:
    """Change the readings (n, n_motors) of a machine; rods on one motor have one reading."""
    q = d.machine.at_readings(change(d.measurements.q[:, list(d.machine.motors)]))
    return replace(d, measurements=replace(d.measurements, q=q))


@pytest.mark.system
def test_wrong_readings_of_arms_are_named(delta: Dataset, monkeypatch: pytest.MonkeyPatch) -> None:
    kinds = {"unit", "direction of encoders"}
    found = _diagnosed(_with_readings(delta, np.deg2rad), kinds, monkeypatch)
    assert found.what.startswith("the readings appear to be radians")
    assert found.after >= 11 > found.before


def _mirrored(d: Dataset, v: int, only: slice | list[int] = slice(None)) -> Dataset:
    """Mirror the outlines of some images of a view, of all views for -1."""
    outlines, camera = d.observations, d.measurements.views[0].camera
    assert outlines is not None
    rows = np.flatnonzero((d.measurements.view == v) | (v < 0))[only]
    chosen = np.isin(outlines.row, rows)
    middle = 0.5 * (camera.width - 1.0)
    h, ends = outlines.h.copy(), outlines.ends.copy()
    h[chosen, 2] += 2.0 * h[chosen, 0] * (middle - camera.K[0, 2]) / camera.K[0, 0]
    h[chosen, 0] *= -1.0
    ends[chosen, :, 0] = 2.0 * middle - ends[chosen, :, 0]
    return replace(d, observations=replace(outlines, h=h, ends=ends))


def _late_from(d: Dataset, v: int, first: int) -> Dataset:
    q, rows = d.measurements.q.copy(), np.flatnonzero(d.measurements.view == v)[first:]
    q[rows] = q[np.roll(rows, 1)]
    return replace(d, measurements=replace(d.measurements, q=q))


def _diagnosed(d: Dataset, kinds: set[str], monkeypatch: pytest.MonkeyPatch) -> diagnosis.Diagnosis:
    data = order_dataset(d, in_turn, no_progress)
    few = [one for one in mistakes(data) if one.kind in kinds]
    monkeypatch.setattr(diagnosis, "mistakes", lambda _: few)
    (found,) = diagnose(data)
    return found


@pytest.fixture(scope="module")
def of_symmetric_machine(tmp_path_factory: pytest.TempPathFactory) -> Dataset:
    folder = tmp_path_factory.mktemp("outlines") / "set"
    simulated(folder, "3-upu", poses=10)
    return load_dataset(folder)


def _of_few_poses(d: Dataset) -> Dataset:
    return dataset_at(d, np.flatnonzero(d.measurements.pose % 10 < 7))


@pytest.mark.system
def test_a_view_whose_camera_was_moved_is_named(
    outlines: Dataset, monkeypatch: pytest.MonkeyPatch
) -> None:
    view = outlines.measurements.view.copy()
    moved = np.flatnonzero(view == 1)[:5]
    view[moved] = 0
    d = replace(outlines, measurements=replace(outlines.measurements, view=view))
    found = _diagnosed(d, {"readings shifted", "images upside down"}, monkeypatch)
    first = [row_names(d.measurements)[k] for k in (0, int(moved[0]))]
    assert found.what == (
        "the outlines of view c1 appear to be taken from 2 camera positions "
        f"({first[0]} and 5 others from position 1, {first[1]} and 4 others from position 2)"
    )
    assert (found.images, found.before, found.after, found.same_as) == (11, 6, 11, ())


@pytest.mark.system
def test_a_diagnosis_names_each_kind_of_mistake_that_images_do_not_tell_from_it(
    of_symmetric_machine: Dataset, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Any two columns of a threefold symmetric machine exchanged are its mirror image."""
    kinds = {"columns exchanged", "images mirrored", "handedness"}
    d = _mirrored(_of_few_poses(of_symmetric_machine), -1)
    views = tuple(replace(view, T_base_camera=None) for view in d.measurements.views)
    d = replace(d, measurements=replace(d.measurements, views=views))
    found = _diagnosed(d, kinds, monkeypatch)
    assert found.kind == "columns exchanged"
    assert len([one for one in found.same_as if one.startswith("columns")]) == 2
    told = found.sentence.partition(": with the columns swapped,")[0]
    assert "or the outlines appear to be mirrored, or the model appears mirrored" in told
    assert "or 2 similar mistakes" in told


@pytest.mark.system
def test_a_row_from_which_on_readings_are_late_is_named(
    of_symmetric_machine: Dataset, monkeypatch: pytest.MonkeyPatch
) -> None:
    d = _late_from(of_symmetric_machine, 1, 3)
    found = _diagnosed(d, {"readings shifted", "images mirrored"}, monkeypatch)
    row = row_names(d.measurements)[int(np.flatnonzero(d.measurements.view == 1)[3])]
    assert found.what.startswith(
        f"from {row} on, the readings of view c2 appear to be one row late"
    )
    assert found.after > found.before
