"""What changed in the course of a session is named with its moment and amount, and nothing else."""

import re
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from changed_rays import turned, with_moved_joint, with_rays, zoomed
from csv_rows import read_rows, write_rows
from scipy.spatial.transform import Rotation
from simulated import settings, simulated, standing

from legcal import Calibration, Dataset, calibrate, evaluate, load_dataset, load_mechanism
from legcal.calibration import session_changes
from legcal.calibration.joint_fit.fit import refine
from legcal.calibration.joint_fit.variables import Start, fitted_legs
from legcal.calibration.session_changes import ALL_MOTORS, UnmodelledEffect, session_tests
from legcal.calibration.verdict import commanded
from legcal.data.image_choice import chosen_images, dataset_at, image_sequences, own_zeros
from legcal.data.reading_units import sigmas_of_legs
from legcal.errors import UsageError
from legcal.files.table import format_table
from legcal.geometry.types import Array, BoolArray
from legcal.simulation.session import simulate_session, streams

pytestmark = pytest.mark.usefixtures("without_steps")

CHANGED_AT = 7  # of the 12 images of the second view
SLIP, LAG, GAIN, BACKLASH, DRIFT, SCATTER = 3e-4, 4e-3, 2e-3, 2e-4, 4e-4, 1e-4
TURN, ZOOM = 4e-4, 1e-3
CHANGED_IN = "c1,c2:p13..p19"


@pytest.fixture(scope="module")
def healthy(tmp_path_factory: pytest.TempPathFactory) -> Dataset:
    """Outlines of a hexapod in two views, each with an order of its own: without times."""
    folder = simulated(tmp_path_factory.mktemp("course") / "set", "hexapod", poses=12).folder
    dataset = load_dataset(folder)
    return replace(dataset, measurements=replace(dataset.measurements, time=None))


@pytest.fixture(scope="module")
def shared(tmp_path_factory: pytest.TempPathFactory) -> tuple[Dataset, Start]:
    """Outlines of poses that two cameras photograph one after the other, and their fit."""
    folder = tmp_path_factory.mktemp("shared") / "set"
    dataset = load_dataset(simulated(folder, "hexapod", poses=12, shared_poses=True).folder)
    m = dataset.measurements
    time = np.asarray(10.0 * m.pose + m.view, dtype=np.float64)
    dataset = replace(dataset, measurements=replace(m, time=time))
    solution = calibrate(dataset).solution
    return dataset, Start(solution.legs, solution.T_camera_Rb, solution.T_Rb_Re, "nominal")


@pytest.fixture(scope="module")
def unordered(healthy: Dataset) -> Calibration:
    """The calibration of that session from images whose labels say nothing of their order."""
    labels = tuple("p" + "x" * n for n in range(1, 25))
    m = replace(healthy.measurements, pose_labels=labels)
    return calibrate(replace(healthy, measurements=m))


@pytest.fixture(scope="module")
def start(unordered: Calibration) -> Start:
    """That fit, near which those of all changed sessions lie."""
    solution = unordered.solution
    return Start(solution.legs, solution.T_camera_Rb, solution.T_Rb_Re, "nominal")


def _findings(dataset: Dataset, start: Start) -> tuple[UnmodelledEffect, ...]:
    m, outlines = dataset.measurements, dataset.observations
    assert outlines is not None
    solution = refine(fitted_legs(dataset.machine), m, outlines, start)
    return session_tests(solution.posterior, m, image_sequences(m, {})).findings


def _with_readings(change: Callable[[Array], Array]) -> Callable[[Dataset], Dataset]:
    def changed(dataset: Dataset) -> Dataset:
        m = dataset.measurements
        return replace(dataset, measurements=replace(m, q=change(m.q)))

    return changed


def _later(n: int) -> BoolArray:
    """Rows of the second view from a change on; the first view was photographed before."""
    return np.arange(n) >= 12 + CHANGED_AT


def _slipped(q: Array) -> Array:
    return q + SLIP * np.outer(_later(len(q)), np.arange(6) == 1)


def _moves(q: Array) -> Array:
    moves = np.diff(q, axis=0, prepend=q[:1])
    moves[12] = 0.0
    return moves


def _drifting(q: Array) -> Array:
    return q + DRIFT * np.outer(np.tile(np.linspace(0.0, 1.0, 12), 2), np.arange(6) == 5)


def _with_later_rays(change: Callable[[Array], Array]) -> Callable[[Dataset], Dataset]:
    return lambda dataset: with_rays(dataset, _later(dataset.measurements.n_rows), change)


def _with_each_rays(
    change: Callable[[np.random.Generator], Callable[[Array], Array]],
) -> Callable[[Dataset], Dataset]:
    """Change the rays of each image of the second view by a draw of its own."""

    def changed(dataset: Dataset) -> Dataset:
        n, rng = dataset.measurements.n_rows, np.random.default_rng(1)
        for row in range(12, n):
            dataset = with_rays(dataset, np.arange(n) == row, change(rng))
        return dataset

    return changed


CASES: dict[str, tuple[Callable[[Dataset], Dataset], str, float]] = {
    "encoder": (_with_readings(_slipped), "leg2", SLIP),
    "lag": (_with_readings(lambda q: q + LAG * _moves(q)), "", LAG),
    "gain": (
        _with_readings(lambda q: q * np.where(np.arange(6) == 3, 1 + GAIN, 1.0)),
        "leg4",
        GAIN,
    ),
    "backlash": (
        _with_readings(lambda q: q + 0.5 * BACKLASH * np.sign(_moves(q)) * (np.arange(6) == 2)),
        "leg3",
        BACKLASH,
    ),
    "drift": (_with_readings(_drifting), "leg6", DRIFT),
    "eccentricity": (
        _with_readings(
            lambda q: q + SCATTER * np.sin(1.0 + np.pi * q / 2.5e-3) * (np.arange(6) == 1)
        ),
        "leg2",
        SCATTER,
    ),
    "autofocus": (_with_each_rays(lambda rng: zoomed(ZOOM * rng.normal())), "c2", ZOOM),
    "vibration": (
        _with_each_rays(lambda rng: Rotation.from_rotvec(TURN * rng.normal(size=3)).apply),
        "c2",
        TURN,
    ),
    "focal_length": (_with_later_rays(zoomed(ZOOM)), "c2", ZOOM),
}


def test_nothing_is_found_in_a_healthy_session(healthy: Dataset, start: Start) -> None:
    assert _findings(healthy, start) == ()


@pytest.mark.parametrize("kind", CASES)
def test_the_first_finding_is_what_was_done_with_its_amount(
    healthy: Dataset, start: Start, kind: str
) -> None:
    change, subject, amount = CASES[kind]
    finding = _findings(change(healthy), start)[0]
    assert (finding.kind, finding.subject) == (kind, subject)
    assert abs(finding.amount - amount) < 4.0 * finding.sigma < 0.6 * amount
    if kind in ("encoder", "focal_length"):
        assert finding.between is not None
        labels = healthy.measurements.pose_labels
        assert finding.between == (labels[11 + CHANGED_AT], labels[12 + CHANGED_AT])


def test_a_slip_is_found_where_readings_are_stated_as_exact(healthy: Dataset, start: Start) -> None:
    slipped = _with_readings(_slipped)(healthy)
    sigma = sigmas_of_legs(slipped.machine.legs, 1e-9)
    m = replace(slipped.measurements, sigma_q=sigma)
    finding = _findings(replace(slipped, measurements=m), start)[0]
    assert (finding.kind, finding.subject) == ("encoder", "leg2")


def test_encoders_that_were_homed_anew_accuse_no_joint_and_get_zeros_of_their_own(
    healthy: Dataset, start: Start
) -> None:
    by = SLIP * np.array([2.0, -1.5, -4.0, 3.0, 1.0, 2.5])
    homed = _with_readings(lambda q: q + np.outer(_later(len(q)), by))(healthy)
    (finding,) = _findings(homed, start)
    assert (finding.kind, finding.subject, finding.images) == ("encoder", ALL_MOTORS, CHANGED_IN)
    assert "all motors were homed anew" in finding.what
    assert min(abs(finding.amount - by)) < 4.0 * finding.sigma
    result = calibrate(homed, split=[f"all@{finding.images}"])
    assert result.verdict.trustworthy
    state, sigma = result.solution.posterior.state, result.solution.posterior.covariance
    at = result.solution.posterior.problem.where("own_zeros")
    np.testing.assert_array_less(
        np.abs(state.own_zeros + by), 4.0 * np.sqrt(np.diagonal(sigma)[at])
    )


def test_two_encoders_that_slipped_are_named_and_not_all(healthy: Dataset, start: Start) -> None:
    by = np.array([1e-3, -1e-3, 0.0, 0.0, 0.0, 0.0])
    slipped = _with_readings(lambda q: q + np.outer(_later(len(q)), by))(healthy)
    (finding,) = _findings(slipped, start)
    assert (finding.kind, finding.subject, finding.images) == ("encoder", "leg1, leg2", CHANGED_IN)
    assert "the zeros of the encoders of leg1, leg2 changed" in finding.what
    splits = [f"{leg}@{finding.images}" for leg in ("leg1", "leg2")]
    assert " ".join(f"--split {split}" for split in splits) in finding.remedy
    assert calibrate(slipped, split=splits).verdict.trustworthy


@pytest.mark.parametrize("times", [1.0, 30.0])
def test_an_encoder_sigma_far_above_what_readings_scatter_is_noted(
    healthy: Dataset, unordered: Calibration, times: float
) -> None:
    m = healthy.measurements
    notes = unordered.notes
    if times > 1.0:
        notes = calibrate(
            replace(healthy, measurements=replace(m, sigma_q=times * m.sigma_q))
        ).notes
    said = [note for note in notes if note.startswith("Readings scatter by about")]
    assert len(said) == (times > 1.0)
    for note in said:
        found, stated = map(float, re.findall(r"([\d.]+) mm", note))
        assert 1e3 * times * m.sigma_q == pytest.approx(stated)
        assert np.all(np.abs(np.log2(1e-3 * found / m.sigma_q)) < 1.0)


def test_scatter_is_that_of_the_images_that_have_a_part_in_the_fit(
    healthy: Dataset, start: Start
) -> None:
    little, n = 0.1 * TURN, healthy.measurements.n_rows
    scattered = _with_each_rays(
        lambda rng: Rotation.from_rotvec(little * rng.normal(size=3)).apply
    )(healthy)
    for row in (15, 20):  # as by a tripod that was pushed
        scattered = with_rays(scattered, np.arange(n) == row, turned(25.0 * TURN))
    finding = _findings(scattered, start)[0]
    assert (finding.kind, finding.subject) == ("vibration", "c2")
    assert abs(finding.amount - little) < 4.0 * finding.sigma < 2.0 * little


def _exchanged(dataset: Dataset) -> Dataset:
    """Exchange two photographs of the first view."""
    outlines = dataset.observations
    assert outlines is not None
    rows = np.arange(24)
    rows[[3, 7]] = 7, 3
    return replace(dataset, observations=replace(outlines, row=rows[outlines.row]))


@pytest.mark.parametrize(
    ("change", "codes"),
    [
        (_exchanged, []),
        (lambda d: with_rays(d, np.arange(24) >= 12, zoomed(3.0 * ZOOM)), ["camera"]),
    ],
    ids=["photographs exchanged", "camera file of a view"],
)
def test_readings_and_autofocus_are_not_accused_of_wrong_rows_or_a_camera_file(
    healthy: Dataset, change: Callable[[Dataset], Dataset], codes: list[str]
) -> None:
    assert [doubt.code for doubt in calibrate(change(healthy)).doubts] == codes


def test_a_joint_that_moved_is_named_and_not_the_encoder_of_its_leg(
    healthy: Dataset, start: Start
) -> None:
    truth = load_mechanism(next((healthy.folder / "truth/models").glob("*.yaml")))
    nominal, given = load_mechanism("hexapod"), settings(views=standing("hexapod"), poses=12)
    scene = simulate_session(truth, nominal, given, streams(given.seed)).scene
    by = np.array([0.0, 3e-4, -4e-4])
    later = np.arange(24) >= 12 + CHANGED_AT  # of readings and outlines in the second view alone
    finding = _findings(with_moved_joint(healthy, scene, later, 3, by), start)[0]
    assert (finding.kind, finding.subject) == ("joint", "leg4.base")
    assert abs(finding.amount - 5e-4) < 4.0 * finding.sigma < 3e-4


def test_wrong_edges_in_one_image_are_no_change(healthy: Dataset, start: Start) -> None:
    outlines, wrong, row, leg = healthy.observations, 13, np.arange(24), 1
    elsewhere = with_rays(healthy, row == wrong, turned(400.0 * TURN)).observations
    assert outlines is not None
    assert elsewhere is not None
    of_leg = outlines.leg == leg
    is_wrong = of_leg & (outlines.row == wrong)
    changed = replace(
        outlines,
        h=np.where(is_wrong[:, None], elsewhere.h, outlines.h),
        ends=np.where(is_wrong[:, None, None], elsewhere.ends, outlines.ends),
    )
    seldom_seen = of_leg & (outlines.row >= 12) & ~np.isin(outlines.row, [wrong, 18, 20])
    spoiled = replace(healthy, observations=changed.choose(~seldom_seen))
    assert [one.kind for one in _findings(spoiled, start)] == []


@pytest.mark.parametrize(
    ("poses", "last", "slip", "blocks"),
    [
        pytest.param(12, 3, 2e-3, 8, id="the last block of a long session"),
        pytest.param(5, 3, 1e-4, 60, id="few images"),
    ],
)
def test_a_slip_that_few_images_show_is_named(
    tmp_path: Path, poses: int, last: int, slip: float, blocks: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(session_changes, "MAX_BLOCKS", blocks)
    session = load_dataset(simulated(tmp_path / "set", "hexapod", poses=poses).folder)
    m = session.measurements
    n = m.n_rows
    solution = calibrate(session).solution
    nominal = Start(solution.legs, solution.T_camera_Rb, solution.T_Rb_Re, "nominal")
    q = m.q + slip * np.outer(np.arange(n) >= n - last, np.arange(6) == 2)
    m = replace(m, q=q, time=np.arange(n, dtype=np.float64))
    (finding,) = _findings(replace(session, measurements=m), nominal)
    assert (finding.kind, finding.subject) == ("encoder", "leg3")
    assert finding.between == (m.pose_labels[n - last - 1], m.pose_labels[n - last])
    assert abs(finding.amount - slip) < 4.0 * finding.sigma < slip


def test_a_stated_length_tells_a_pitch_that_all_motors_share(healthy: Dataset) -> None:
    truth, part = load_mechanism(next((healthy.folder / "truth/models").glob("*.yaml"))), 3e-3
    length = 1e3 * float(np.linalg.norm(truth.A_base[0] - truth.A_base[2]))
    stretched = _with_readings(lambda q: q * (1.0 + part))(healthy)
    result = calibrate(stretched, priors=[f"leg1.base:leg3.base={length:.3f}±0.05mm"])
    m = stretched.measurements
    (pitch,) = session_tests(result.solution.posterior, m, image_sequences(m, {})).findings
    assert pitch.kind == "pitch"
    assert abs(pitch.amount - part) < 4.0 * pitch.sigma < 0.6 * part
    assert [doubt.code for doubt in result.doubts] == ["scale"]


def test_the_remedy_of_a_slip_gives_a_result_within_its_sigmas_in_any_order_of_rows(
    healthy: Dataset, tmp_path: Path
) -> None:
    slip = 5.0 * SLIP  # and the machine has the zero of later images
    slipped = Path(shutil.copytree(healthy.folder, tmp_path / "set"))
    rows = read_rows(slipped / "measurements.csv")
    name = next(name for name in rows[0] if name.startswith("leg4"))
    for row, is_later in zip(rows, _later(len(rows)), strict=True):
        row[name] = repr(float(row[name]) + slip * bool(not is_later))
    write_rows(slipped / "measurements.csv", rows[::-1])
    doubted = calibrate(slipped)
    assert not doubted.verdict.trustworthy
    assert [doubt.code for doubt in doubted.doubts] == ["encoder"]
    assert "leg4" in doubted.doubts[0].sentence
    (option,) = re.findall(r"--split (\S+)\)", doubted.doubts[0].remedy)
    assert option == "leg4@c1:p01..c2:p19"
    result = calibrate(slipped, split=[option], output=tmp_path / "out")
    assert result.verdict.trustworthy
    assert result.platform is not None
    truth = next((healthy.folder / "truth/models").glob("*.yaml"))
    off = evaluate(tmp_path / "out/calibrated.yaml", truth, dataset=healthy.folder)
    assert off.displacement.mean() < 3.0 * result.platform.sigma.mean_displacement
    (note,) = [note for note in result.notes if "zero of the encoder of leg4" in note]
    (value, sigma) = map(float, re.findall(r"is (\S+) ± (\S+) mm", note)[0])
    assert abs(value - 1e3 * slip) < 4.0 * sigma < 0.05


def test_a_camera_that_turned_is_found_and_images_without_outlines_are_beside_those_around_them(
    healthy: Dataset, start: Start
) -> None:
    bumped = _with_later_rays(turned(TURN))(healthy)
    outlines = bumped.observations
    assert outlines is not None
    without = outlines.choose(~np.isin(outlines.row, [15, 23]))
    finding = _findings(replace(bumped, observations=without), start)[0]
    assert (finding.kind, finding.subject, finding.images) == ("camera", "c2", "c2:p20..p24")
    assert abs(finding.amount - TURN) < 4.0 * finding.sigma < 0.6 * TURN


def test_a_split_has_all_images_of_the_poses_before_a_slip(
    shared: tuple[Dataset, Start],
) -> None:
    dataset, start = shared
    m = dataset.measurements
    q = m.q + SLIP * np.outer(m.pose >= 5, np.arange(6) == 0)
    m = replace(m, q=q, time=None)
    slipped = replace(dataset, measurements=m)
    finding = _findings(slipped, start)[0]
    assert (finding.kind, finding.subject) == ("encoder", "leg1")
    assert finding.images == "c1:p01..p05,c2:p01..p05"
    chosen = chosen_images(slipped, finding.images)
    assert chosen.tolist() == (m.pose < 5).tolist()


def test_a_split_stands_for_all_images_of_its_poses(shared: tuple[Dataset, Start]) -> None:
    dataset, _ = shared
    (zero,) = own_zeros(dataset, ["leg1@c2:p01..p05"])
    (by_joint,) = own_zeros(dataset, ["leg1_prismatic@c2:p01..p05"])
    assert (by_joint.motor, by_joint.rows.tolist()) == (zero.motor, zero.rows.tolist())
    assert zero.rows.tolist() == (dataset.measurements.pose < 5).tolist()
    with pytest.raises(UsageError, match="share a pose with them"):
        own_zeros(dataset, ["leg1@c2"])


def test_a_slip_that_cannot_be_seen_has_no_least_size(shared: tuple[Dataset, Start]) -> None:
    dataset, start = shared
    few = dataset_at(dataset, np.flatnonzero(dataset.measurements.pose < 6))  # one moment
    m = replace(few.measurements, own_zeros=own_zeros(few, ["leg1@c1:p01..p03"]))
    assert few.observations is not None
    solution = refine(
        fitted_legs(few.machine), m, few.observations, replace(start, T_Rb_Re=start.T_Rb_Re[:6])
    )
    session = session_tests(solution.posterior, m, image_sequences(m, {}))
    assert sorted(session.least_slips) == [f"leg{j}" for j in range(2, 7)]
    assert min(session.least_slips.values()) > 0.0


def test_images_that_are_left_out_have_no_effect(healthy: Dataset) -> None:
    bumped = _with_later_rays(turned(5.0 * TURN))(healthy)
    (option,) = re.findall(r"--leave-out (\S+)\)", calibrate(bumped).doubts[0].remedy)
    assert option == "c2:p20..p24"
    without = calibrate(bumped, leave_out=option)
    assert without.verdict.trustworthy
    rows = np.flatnonzero(~_later(24))
    expected = calibrate(dataset_at(healthy, rows)).solution.estimates
    assert without.solution.estimates.values == pytest.approx(dict(expected.values), abs=1e-9)


def test_images_are_chosen_by_their_file_or_their_pose(healthy: Dataset) -> None:
    m = healthy.measurements
    labels = [m.pose_labels[p] for p in m.pose.tolist()]
    views = [m.view_names[v] for v in m.view.tolist()]
    image = [f"images/{view}_{label}.png" for view, label in zip(views, labels, strict=True)]
    dataset = replace(healthy, measurements=replace(m, image=tuple(image)))
    for name in (image[14], image[14].removeprefix("images/"), f"c2_{labels[14]}", labels[14]):
        assert np.flatnonzero(chosen_images(dataset, name)).tolist() == [14]
    chosen = chosen_images(dataset, f"{labels[14]}..c2:{labels[17]}")
    assert np.flatnonzero(chosen).tolist() == [14, 15, 16, 17]


@pytest.mark.parametrize(
    ("arguments", "sentence"),
    [
        ({"leave_out": "p77"}, "found no image 'p77'"),
        ({"leave_out": "p03..p20"}, "found the range p03..p20"),
        ({"leave_out": "c1,c2"}, "found all images"),
        ({"split": ["leg7@p03"]}, "found no motor of that name"),
        ({"split": ["leg1"]}, "needed MOTOR@IMAGES"),
        ({"split": ["leg1@"]}, "found no images, needed MOTOR@IMAGES"),
        ({"split": ["leg1@c1", "leg1@c2"]}, "found all images in splits of that motor, needed"),
        ({"split": ["leg1@c1", "leg1@c1:p03"]}, "found images of another split of that motor"),
        ({"split": ["leg1@c1:p03"], "leave_out": "c1"}, "found only images that are left out"),
        ({"split": ["leg1@c1"], "leave_out": "c2"}, "found all images in splits of that motor,"),
    ],
)
def test_images_that_cannot_be_chosen_are_refused_with_the_cause(
    healthy: Dataset, arguments: dict[str, Any], sentence: str
) -> None:
    with pytest.raises(UsageError, match=re.escape(sentence)):
        calibrate(healthy, **arguments)


def test_a_session_whose_images_have_no_order_says_that_changes_were_not_tested(
    unordered: Calibration,
) -> None:
    assert any("add a column time to measurements.csv" in note for note in unordered.notes)


def test_images_are_ordered_by_times_then_by_the_numbers_of_a_view(healthy: Dataset) -> None:
    m = healthy.measurements
    by_numbers = image_sequences(m, {})
    assert [rows.tolist() for rows in by_numbers] == [list(range(12)), list(range(12, 24))]
    times = np.arange(24.0)[::-1]
    (by_times,) = image_sequences(replace(m, time=times), {})
    assert by_times.tolist() == list(range(24))[::-1]
    names = tuple(f"images/{row}.jpg" for row in range(24))
    taken = {name: f"2026:11:23 10:{59 - row:02d}:00" for row, name in enumerate(names)}
    (by_exif,) = image_sequences(replace(m, image=names), taken)
    assert by_exif.tolist() == list(range(24))[::-1]
    unnamed = replace(m, image=tuple("a" * (row + 1) for row in range(24)))
    assert image_sequences(unnamed, {}) == ()


def test_readings_that_are_the_commands_of_a_plan_are_noted(
    healthy: Dataset, tmp_path: Path
) -> None:
    m = replace(healthy.measurements, image=tuple(f"{row}.jpg" for row in range(24)))
    q = np.round(m.q, 7)  # [m]
    motors = [f"{leg.prismatic} [mm]" for leg in healthy.machine.legs]
    rows = [
        [name, *(f"{1e3 * x:.4f}" for x in of_row)] for name, of_row in zip(m.image, q, strict=True)
    ]
    (tmp_path / "poses.csv").write_text(format_table(["image", *motors], rows))
    planned = replace(healthy, folder=tmp_path, measurements=replace(m, q=q))
    assert "encoders read" in commanded(planned)[0]
    q = q + 1e-6 * (np.arange(24) == 5)[:, None]
    assert commanded(replace(planned, measurements=replace(m, q=q))) == ()
