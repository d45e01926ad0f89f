"""Common mistakes of owners are named: in readings, models and images that disagree."""

import re
from collections.abc import Callable, Collection
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest
import yaml
from edits import cell, keyed
from scipy.spatial.transform import RigidTransform, Rotation
from simulated import settings, simulated
from thinned import thinned

from legcal import Dataset, calibrate, load_dataset, load_mechanism, simulate
from legcal.calibration import mistake_search
from legcal.calibration.board import usable_board
from legcal.calibration.diagnosis import NONE_EXPLAINS, Diagnosis, _permuted
from legcal.calibration.mistake_search import diagnose, symmetries
from legcal.calibration.mistakes import Assumed, Mistake, mistakes
from legcal.calibration.ordered_dataset import OrderedDataset, order_dataset
from legcal.data.image_choice import dataset_at
from legcal.data.measurements import row_names
from legcal.errors import DatasetError, DidNotConverge, NotIdentifiable, NotVisible
from legcal.geometry.types import Array
from legcal.machine.leg import Leg
from legcal.progress import no_progress
from legcal.simulation.settings import Level, SimulationSettings
from legcal.workers import in_turn


def test_every_mistake_can_be_tried_on_a_machine_with_a_passive_leg(tmp_path: Path) -> None:
    dataset = load_dataset(simulated(tmp_path / "set", "hexapod-strut").folder)
    data = order_dataset(dataset, in_turn, no_progress)
    tried = mistakes(data)
    kinds = {"columns exchanged", "columns rotated", "readings shifted", "handedness"}
    assert kinds <= {one.kind for one in tried}
    for one in tried:
        A, B = one.true.joints(range(6))
        assert A.shape == B.shape == (6, data.machine.n_legs, 3)


# One mistake in given outlines


def _with_readings(d: Dataset, q: Array) -> Dataset:
    return replace(d, measurements=replace(d.measurements, q=q))


def _with_legs(d: Dataset, legs: list[Leg]) -> Dataset:
    return replace(d, machine=replace(d.machine, legs=tuple(legs)))


def _exchanged(d: Dataset) -> Dataset:
    return _with_readings(d, d.measurements.q[:, [0, 1, 3, 2, 4, 5]])


def _late(d: Dataset, first: int = 0) -> Dataset:
    """Return a session in whose second view readings are one row late from a row on."""
    q, rows = d.measurements.q.copy(), np.flatnonzero(d.measurements.view == 1)[first:]
    q[rows] = q[np.roll(rows, 1)]
    return _with_readings(d, q)


def _late_from_fourth(d: Dataset) -> Dataset:
    return _late(d, 3)


def _doubled_row(d: Dataset) -> Dataset:
    """Return a session whose eighth row stands twice in the table, through both views."""
    q = d.measurements.q
    return _with_readings(d, np.vstack([q[:8], q[7:-1]]))


def _in_order_of_text(d: Dataset) -> Dataset:
    """Return a session whose readings are those of images 1, 10, 2, ... in each view."""
    q = d.measurements.q.copy()
    for v in (0, 1):
        rows = np.flatnonzero(d.measurements.view == v)
        q[rows[sorted(range(len(rows)), key=lambda k: str(k + 1))]] = q[rows]
    return _with_readings(d, q)


def _reversed(d: Dataset) -> Dataset:
    ends = np.array([sum(leg.travel) for leg in d.machine.legs])
    return _with_readings(d, ends - d.measurements.q)


def _with_first_rows_of(d: Dataset, changed: Array) -> Dataset:
    """Return changed readings from the eighth image of the first view on."""
    return _with_readings(d, np.vstack([d.measurements.q[:7], changed[7:]]))


def _exchanged_from_eighth(d: Dataset) -> Dataset:
    return _with_first_rows_of(d, d.measurements.q[:, [1, 0, 2]])


def _reversed_from_eighth(d: Dataset) -> Dataset:
    q = d.measurements.q.copy()
    q[:, 0] = _reversed(d).measurements.q[:, 0]
    return _with_first_rows_of(d, q)


def _left_handed(d: Dataset) -> Dataset:
    y = np.array([1.0, -1.0, 1.0])
    return _with_legs(d, [replace(leg, A=y * leg.A, B=y * leg.B) for leg in d.machine.legs])


def _renumbered(d: Dataset) -> Dataset:
    legs = d.machine.legs
    return _with_legs(d, [replace(leg, B=legs[(j + 2) % 6].B) for j, leg in enumerate(legs)])


def _numbered_back(d: Dataset) -> Dataset:
    """Return a machine whose platform joints are numbered the other way round."""
    legs = d.machine.legs
    return _with_legs(d, [replace(leg, B=legs[-1 - j].B) for j, leg in enumerate(legs)])


def _late_in_third_column(d: Dataset) -> Dataset:
    """Return readings of one leg that are a row late, through both views."""
    q = d.measurements.q.copy()
    q[:, 2] = np.roll(q[:, 2], 1)
    return _with_readings(d, q)


def _thick(d: Dataset) -> Dataset:
    return replace(d, machine=d.machine.with_radii(lambda _, c: 2.0 * c.radius))


def _turned_arms(d: Dataset) -> Dataset:
    """Return a Delta whose arms are turned against its platform: two rods an arm."""
    legs = []
    for leg, other in zip(d.machine.legs, np.roll(np.array(d.machine.legs), -2), strict=True):
        actuator = replace(other.actuator, joint=leg.prismatic)
        legs.append(replace(leg, A=other.A, actuator=actuator))
    return _with_legs(d, legs)


def _in_radians(d: Dataset) -> Dataset:
    """Return readings in another unit; rods on one motor have one reading."""
    q = np.deg2rad(d.measurements.q[:, list(d.machine.motors)])
    return _with_readings(d, d.machine.at_readings(q))


@pytest.fixture(scope="module")
def outlines(tmp_path_factory: pytest.TempPathFactory) -> Callable[[str], Dataset]:
    """Outlines of a machine, each made once."""

    @cache
    def made(model: str) -> Dataset:
        folder = tmp_path_factory.mktemp("outlines") / "set"
        if model == "delta":
            simulate(model, folder, settings(poses=6))
        else:
            simulated(folder, model, poses=10 if model == "3-upu" else 6)
        return load_dataset(folder)

    return made


def test_a_machine_is_as_symmetric_where_its_home_is_tilted() -> None:
    machine = load_mechanism("3-upu")
    tilt = RigidTransform.from_components([0.02, 0.03, 0.0], Rotation.from_rotvec([0.03, 0.0, 0.0]))
    tilted = replace(machine, home=machine.home * tilt)
    assert len(symmetries(tilted)) == len(symmetries(machine)) == 6


def _try_only(kinds: Collection[str], monkeypatch: pytest.MonkeyPatch) -> None:
    """Try mistakes of some kinds, also beside others that are undone: all take seconds."""

    def few(data: OrderedDataset, given: Assumed | None = None) -> list[Mistake]:
        return [one for one in mistakes(data, given) if one.kind in kinds]

    monkeypatch.setattr(mistake_search, "mistakes", few)


def _likely(d: Dataset) -> tuple[Diagnosis, ...] | None:
    data = order_dataset(d, in_turn, no_progress)
    return diagnose(data, usable_board(data))


def _diagnosed(d: Dataset) -> Diagnosis:
    (found,) = _likely(d) or ()
    return found


BESIDE = {"images mirrored", "images upside down", "readings shifted", "direction of encoders"}
USUAL = (
    *(_exchanged, _thick, _doubled_row, _in_order_of_text, _late_in_third_column),
    *(_exchanged_from_eighth, _reversed_from_eighth),
)


@pytest.mark.parametrize(
    ("model", "change", "kind", "what", "other"),
    thinned(
        [
            ("hexapod", _exchanged, "columns exchanged",
             "columns leg3_prismatic and leg4_prismatic appear", "legs leg3"),
            ("hexapod", _late, "readings shifted",
             "the readings of view c2 appear to be one row late", ""),
            ("hexapod", _left_handed, "handedness", "the model appears mirrored",
             "the outlines appear to be mirrored"),
            ("hexapod", _renumbered, "platform joints renumbered",
             "the platform joints of the model appear to be numbered", ""),
            ("hexapod", _numbered_back, "joints reversed",
             "the platform joints of the model appear to be numbered the other way round", ""),
            ("hexapod", _late_in_third_column, "column shifted",
             "the readings in column leg3_prismatic appear to be one row late", ""),
            ("hexapod", _thick, "diameter for radius",
             "the radii of the legs in the model appear to be diameters", ""),
            ("delta", _turned_arms, "base joints renumbered",
             "the arms of the model appear to be turned against the platform", ""),
            ("delta", _in_radians, "unit", "the readings appear to be radians", ""),
            ("3-upu", _late_from_fourth, "readings shifted",
             "from p14 on, the readings of view c2 appear to be one row late", ""),
            ("3-upu", _doubled_row, "readings shifted",
             "from p09 on, the readings appear to be one row late", ""),
            ("3-upu", _in_order_of_text, "order of text",
             "the readings appear to be sorted in another order", ""),
            ("3-upu", _exchanged_from_eighth, "columns exchanged",
             "from p08 of view c1 on, columns leg1_prismatic and leg2_prismatic appear", ""),
            ("3-upu", _reversed_from_eighth, "direction of an encoder",
             "from p08 of view c1 on, column leg1_prismatic appears", ""),
        ],
        lambda _, change, *rest: change in USUAL,
    ),
)  # fmt: skip
def test_given_outlines_name_a_mistake_as_photographs_do(
    outlines: Callable[[str], Dataset],
    model: str,
    change: Callable[[Dataset], Dataset],
    kind: str,
    what: str,
    other: str,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    changed = change(outlines(model))
    _try_only({*BESIDE, kind}, monkeypatch)
    found = _diagnosed(changed)
    assert found.kind == kind
    assert found.what.startswith(what)
    assert found.images == changed.measurements.n_rows
    assert found.images_after >= found.images - 1 > found.images_before
    assert found.images_after == found.images or change is not _in_order_of_text
    assert any(one.startswith(other) for one in found.same_as) or not other
    assert ("To distinguish them" in found.sentence) == bool(found.same_as)


@pytest.mark.system
def test_two_mistakes_at_once_are_named_together_with_both_remedies(
    outlines: Callable[[str], Dataset], monkeypatch: pytest.MonkeyPatch
) -> None:
    kinds = ("diameter for radius", "direction of encoders", "columns exchanged")
    _try_only(kinds, monkeypatch)
    found = _diagnosed(_thick(_reversed(outlines("hexapod"))))
    assert set(found.kind.split(" and ")) == set(kinds[:2])
    assert found.images_after >= 11 > found.images_before
    for told in ("appear to be diameters", "reverse them in the table", "<visual> cylinders"):
        assert told in found.sentence


@pytest.mark.system
def test_what_was_tried_in_vain_stands_beside_a_refusal(
    outlines: Callable[[str], Dataset], monkeypatch: pytest.MonkeyPatch
) -> None:
    _try_only(("diameter for radius",), monkeypatch)
    d = outlines("hexapod")
    rng = np.random.default_rng(0)
    with pytest.raises((NotVisible, DidNotConverge)) as refused:
        calibrate(_with_readings(d, rng.permuted(d.measurements.q, axis=0)))
    assert NONE_EXPLAINS in refused.value.notes


@pytest.mark.system
def test_where_most_images_agree_nothing_is_to_be_explained(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """36 of 45: joints of the model are some millimetres off."""
    _try_only(("diameter for radius",), monkeypatch)
    folder = tmp_path / "set"
    chosen = SimulationSettings(Level.OUTLINES, board="chessboard", hand_held=True)
    simulate("hexapod", folder, chosen)
    assert _likely(load_dataset(folder)) is None


@pytest.mark.system
def test_a_board_of_another_size_is_named_without_further_guesses(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    _try_only(("diameter for radius",), monkeypatch)
    folder = simulated(tmp_path / "set", "servo-hexapod", poses=5, board="chessboard").folder
    square = yaml.safe_load((folder / "dataset.yaml").read_text())["board"]["square"]
    keyed("dataset.yaml", board__square=1.05 * square)(folder)
    with pytest.raises(DidNotConverge, match="dimensions of the calibration board") as refused:
        calibrate(folder)
    assert NONE_EXPLAINS not in refused.value.notes


@pytest.mark.parametrize(
    ("model", "names", "what"),
    [
        ("hexapod", {1: 2, 2: 1}, "leg2 and leg3 appear to be exchanged"),
        ("hexapod", {1: 4, 4: 1}, "leg2 and leg5 appear to be exchanged"),  # no fit
        (
            "hexapod",
            {0: 4, 4: 2, 2: 0},
            "leg1, leg3, leg5 name other legs (leg1 those of leg3, leg3 those of leg5, leg5 those "
            "of leg1)",
        ),
    ],
)
def test_outlines_under_the_names_of_other_legs_in_a_view_are_named(
    outlines: Callable[[str], Dataset], model: str, names: dict[int, int], what: str
) -> None:
    d = outlines(model)
    assert not _likely(d)
    renamed = _misnamed(d, names)
    mistake = _diagnosed(renamed)
    assert mistake.what == f"the outlines of {what} in view c2"
    assert (mistake.images, mistake.images_before, mistake.images_after) == (6, 0, 6)
    with pytest.raises(DidNotConverge, match=re.escape(mistake.sentence)):
        calibrate(renamed)


@pytest.mark.parametrize("order", [(0, 1, 2), (1, 2, 0), (2, 0, 1)])
def test_exchanged_legs_are_found_beside_another_that_names_one_of_them(
    order: tuple[int, ...],
) -> None:
    first, second, third = order
    nearest = np.ones((4, 4))
    for one, other in ((first, second), (second, third), (third, second), (3, 3)):
        nearest[one, other] = 0.0
    leg = np.repeat(np.arange(4), 6)
    (cycle,) = _permuted(nearest[leg], leg)
    assert sorted(cycle) == sorted([(second, third), (third, second)])


def test_legs_are_not_taken_for_exchanged_where_the_others_lie_elsewhere_too() -> None:
    """As where readings are wrong: two legs are near each other's place by chance."""
    away, leg = np.full((6, 6), 0.4), np.repeat(np.arange(6), 6)
    away[1, 2] = away[2, 1] = 0.01
    assert list(_permuted(away[leg], leg)) == []
    np.fill_diagonal(away, [0.002, 0.4, 0.4, 0.001, 0.002, 0.4])
    (cycle,) = _permuted(away[leg], leg)
    assert sorted(cycle) == [(1, 2), (2, 1)]
    away, leg = np.full((3, 3), 0.4), np.repeat(np.arange(3), 6)
    away[[0, 1, 2], [1, 2, 0]] = 0.01  # as from a symmetric place, where images do not agree
    assert list(_permuted(away[leg], leg, of_all=False)) == []
    assert len(list(_permuted(away[leg], leg))) == 1


def _misnamed(d: Dataset, names: dict[int, int]) -> Dataset:
    """Give outlines of the second view the names of other legs."""
    given, m, legs = d.observations, d.measurements, d.machine.legs
    assert given is not None
    leg, part = given.leg.copy(), list(given.part)
    for i in np.flatnonzero(m.view[given.row] == 1).tolist():
        j = int(leg[i])
        leg[i] = names.get(j, j)
        part[i] = part[i].replace(legs[j].name, legs[leg[i]].name)
    return replace(d, observations=replace(given, leg=leg, part=tuple(part)))


@pytest.mark.system
def test_a_fit_that_leaves_out_exchanged_legs_names_them_and_accuses_no_reading(
    tmp_path: Path,
) -> None:
    d = load_dataset(simulated(tmp_path / "set", "hexapod", views=3, poses=8).folder)
    fitted = calibrate(_misnamed(d, {0: 1, 1: 0}))
    assert [doubt.code for doubt in fitted.doubts] == ["mistake"]
    assert "leg1 and leg2 appear to be exchanged in view c2" in fitted.doubts[0].what
    (found,) = fitted.diagnosis
    assert not fitted.verdict.trustworthy
    assert found.sentence in fitted.verdict.sentence
    assert "known to" in fitted.verdict.sentence
    assert fitted.notes[0] == found.sentence
    assert [one["kind"] for one in fitted.result.document()["diagnosis"]] == [found.kind]
    assert calibrate(d).diagnosis == ()


@pytest.mark.system
def test_a_view_whose_camera_was_moved_is_named(
    outlines: Callable[[str], Dataset], monkeypatch: pytest.MonkeyPatch
) -> None:
    session = outlines("hexapod")
    view = session.measurements.view.copy()
    moved = np.flatnonzero(view == 1)[:5]
    view[moved] = 0
    d = replace(session, measurements=replace(session.measurements, view=view))
    _try_only({"readings shifted", "images upside down"}, monkeypatch)
    found = _diagnosed(d)
    first = [row_names(d.measurements)[k] for k in (0, int(moved[0]))]
    assert found.what == (
        "the outlines of view c1 appear to be taken from 2 camera positions "
        f"({first[0]} and 5 others from position 1, {first[1]} and 4 others from position 2)"
    )
    assert (found.images, found.images_before, found.images_after, found.same_as) == (11, 6, 11, ())


def _mirrored(d: Dataset) -> Dataset:
    """Mirror all outlines."""
    outlines, camera = d.observations, d.measurements.views[0].camera
    assert outlines is not None
    middle = 0.5 * (camera.width - 1.0)
    h, ends = outlines.h.copy(), outlines.ends.copy()
    h[:, 2] += 2.0 * h[:, 0] * (middle - camera.K[0, 2]) / camera.K[0, 0]
    h[:, 0] *= -1.0
    ends[:, :, 0] = 2.0 * middle - ends[:, :, 0]
    return replace(d, observations=replace(outlines, h=h, ends=ends))


@pytest.mark.system
def test_a_diagnosis_names_each_kind_of_mistake_that_images_do_not_tell_from_it(
    outlines: Callable[[str], Dataset], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Any two columns of a threefold symmetric machine exchanged are its mirror image."""
    _try_only({"columns exchanged", "images mirrored", "handedness"}, monkeypatch)
    session = outlines("3-upu")
    d = _mirrored(dataset_at(session, np.flatnonzero(session.measurements.pose % 10 < 7)))
    views = tuple(replace(view, T_base_camera=None) for view in d.measurements.views)
    d = replace(d, measurements=replace(d.measurements, views=views))
    found = _diagnosed(d)
    assert found.kind == "columns exchanged"
    assert len([one for one in found.same_as if one.startswith("columns")]) == 2
    told = found.sentence.partition(": with the columns swapped,")[0]
    assert "or the outlines appear to be mirrored, or the model appears mirrored" in told
    assert "or 2 similar mistakes" in told


def _base_joints_exchanged(d: Dataset) -> Dataset:
    """Return the session with the base joints of two legs exchanged in its model."""
    legs = list(d.machine.legs)
    for j, other in ((4, 5), (5, 4)):
        end = d.machine.legs[other]
        legs[j] = replace(legs[j], A=end.A, base_axis=end.base_axis)
    return _with_legs(d, legs)


@pytest.mark.system
def test_joints_exchanged_in_the_model_are_named_before_readings_that_it_cannot_reach(
    outlines: Callable[[str], Dataset], monkeypatch: pytest.MonkeyPatch
) -> None:
    d = _base_joints_exchanged(outlines("hexapod"))
    _try_only({"joints exchanged", "columns exchanged"}, monkeypatch)
    with pytest.raises(DatasetError) as refused:
        calibrate(d)
    first = refused.value.problems[0]
    assert first.startswith("The base joints of leg5 and leg6 appear to be swapped in the model")
    (reach,) = map(str, refused.value.consequences)
    assert "cannot reach" in reach
    _try_only((), monkeypatch)
    said = reach.partition("--leave-out ")[2].partition(")")[0]
    calibration = calibrate(d, leave_out=said)  # the other images are fitted
    assert f"Left out, as asked: {said}." in calibration.notes
    assert calibration.solution.outlines.used.any()


def test_an_encoder_that_never_moves_is_named_before_what_it_leaves_open(tmp_path: Path) -> None:
    folder = tmp_path / "set"
    simulate("delta", folder, settings(poses=2))
    column = load_mechanism("delta").motor_names[1]
    cell("measurements.csv", None, **{column: "0.1"})(folder)
    with pytest.raises(NotIdentifiable) as refused:
        calibrate(folder)
    assert column in refused.value.problems[0]
    assert "the same reading in all rows" in refused.value.problems[0]
    assert "cannot be identified" in refused.value.problems[-1]
