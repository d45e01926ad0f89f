"""The paper's evaluation: eq (20), its sessions, means and table; the runner of studies."""

import io
import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from rich.console import Console
from scipy.spatial.transform import RigidTransform
from toy_studies import Deadly, Draws, Mistaken

from legcal.errors import DidNotConverge, OutOfResources, UsageError
from legcal.machine.configurations import JITTER
from legcal.machine.kinematics import platforms_in_base
from legcal.machine.parameters import geometries
from legcal.paper.criteria import Criteria
from legcal.paper.unknowns import NominalMachine
from legcal.report.session import study_table
from legcal.simulation.observe import TableNoise, axes_in_images
from legcal.simulation.paper import (
    DOCUMENT_NAME,
    PAPER_VIEWS,
    SCALARS,
    EstimatorRow,
    PaperStudy,
    paper_cameras,
    paper_machine,
    platform_errors,
    run_study,
)
from legcal.simulation.session import draw_poses, streams

# Eq (20)


def test_eq20_of_the_truth_is_zero_and_of_equal_offsets_the_travel_of_a_lift() -> None:
    machine = paper_machine("noncoplanar")
    drawn = draw_poses(machine, 10, np.random.default_rng(0), "workspace").poses
    poses = RigidTransform.concatenate(list(platforms_in_base(machine, drawn)))
    errors = platform_errors(machine, geometries(machine), poses)
    assert max(errors.dX, errors.dE, errors.angle) < 1e-12
    home = RigidTransform.concatenate([machine.home_of_frames])
    lifted = tuple(replace(leg, q0=leg.q0 + 1e-4) for leg in geometries(machine))
    assert 1e-4 < platform_errors(machine, lifted, home).dX < 3e-4


# Sessions


def test_a_session_is_that_of_the_paper() -> None:
    machine, seed = paper_machine("coplanar"), np.random.SeedSequence(1)
    views = paper_cameras(machine, np.random.default_rng(1))
    rngs = streams(seed)
    session = PaperStudy().session(machine, views, rngs)
    m = session.measurements
    assert (m.n_rows, m.n_poses, len(m.views)) == (135, 45, 3)
    assert np.all(np.bincount(m.pose) == 3)  # images of each pose, with one reading
    axes = axes_in_images(session.scene, TableNoise(), rngs["observations"])
    for row, legs in enumerate(np.split(axes.leg, 135)):
        assert tuple(legs.tolist()) == PAPER_VIEWS[m.view[row]]
    true = session.poses.readings
    part = true / 0.140
    assert np.all(np.minimum(part, 1.0 - part) <= JITTER)
    error = m.q_of_poses - true
    assert 2.5e-6 < np.abs(error).max() <= 3e-6
    assert m.sigma_q == pytest.approx(3e-6 / np.sqrt(3.0))
    height = max(abs(joint[2]) for leg in geometries(machine) for joint in (leg.A, leg.B))
    assert height < 1e-12


# Runs


def test_means_have_their_standard_deviations() -> None:
    drawn = np.random.default_rng(0).uniform(1.0, 2.0, (7, len(SCALARS)))
    means = EstimatorRow.of("coplanar", "literal", [
        {**dict(zip(SCALARS, row.tolist(), strict=True)), "parameters": [float(row[0])]}
        for row in drawn
    ])  # fmt: skip
    row, sigma = means.document(), drawn.std(axis=0, ddof=1) / np.sqrt(len(drawn))
    assert row["dX_mm"] == pytest.approx(1e3 * drawn[:, 0].mean())
    assert row["dE_deg"] == pytest.approx(np.rad2deg(drawn[:, 1].mean()))
    assert row["parameters_mm"] == pytest.approx([1e3 * drawn[:, 0].mean()])
    assert row["dX_mean_sigma_mm"] == pytest.approx(1e3 * sigma[0])
    assert row["dE_mean_sigma_deg"] == pytest.approx(np.rad2deg(sigma[1]))


def test_an_estimator_that_fails_is_counted_and_leaves_the_others(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    calls = []

    def steps(machine: NominalMachine, *_: object, criteria: Criteria) -> NominalMachine:
        if criteria == "default":
            raise DidNotConverge("It never does.")
        calls.append(machine)
        if len(calls) % 2:
            raise DidNotConverge("It did not.")
        return machine

    monkeypatch.setattr("legcal.simulation.paper.run_steps", steps)
    found = run_study(PaperStudy(n_poses=4), 2)
    rows = {(row["estimator"], row["coplanar"]): row for row in found["rows"]}
    assert rows["literal", True]["failures"] == {"DidNotConverge": 2}
    assert rows["literal", False]["failures"] == {}
    assert rows["default", True]["dX_mm"] is None
    assert rows["default", True]["parameters_mm"] == []
    assert found["failures"] == {}
    printed = io.StringIO()
    Console(file=printed, width=80).print(study_table(found))
    said = "steps as printed, coplanar joints: 2 of 2 runs failed (DidNotConverge)"
    assert said in printed.getvalue()


# The runner: the same results however it is run, written complete or not at all


def test_runs_do_not_depend_on_their_number_and_are_counted(tmp_path: Path) -> None:
    progress = list[tuple[str, int, int]]()
    few = run_study(Draws(), 10, output=tmp_path, progress=lambda *now: progress.append(now))
    assert progress == [("Study draws", done, 10) for done in range(11)]
    assert json.loads((tmp_path / DOCUMENT_NAME).read_bytes()) == few
    assert (tmp_path / "total.txt").read_text() == str(few["total"])
    more = run_study(Draws(), 25, output=tmp_path)
    assert json.loads((tmp_path / DOCUMENT_NAME).read_bytes()) == more
    some = run_study(Draws(fails_above=0.0), 25)
    assert some["n"] + some["failures"]["DidNotConverge"] == 25 == some["runs"]
    assert some["total"] < 0.0
    assert some["settings"] == {"scale": 1.0, "fails": {"above": 0.0}}


def test_a_study_of_failures_only_says_why() -> None:
    with pytest.raises(DidNotConverge, match=r"all of its 5 runs failed.*The draw is"):
        run_study(Draws(fails_above=-np.inf), 5)


@pytest.mark.parametrize("workers", [1, pytest.param(2, marks=pytest.mark.system)])
def test_a_mistake_in_a_study_is_no_failed_run(workers: int) -> None:
    with pytest.raises(ZeroDivisionError):
        run_study(Mistaken(), 4, workers=workers)


@pytest.mark.system
def test_processes_give_the_same_and_one_that_is_ended_from_outside_is_told(
    tmp_path: Path,
) -> None:
    study = Draws(fails_above=1.0)
    assert run_study(study, 30, workers=2) == run_study(study, 30)
    with pytest.raises(OutOfResources, match="one of the processes was ended from outside"):
        run_study(Deadly(), 20, workers=2, output=tmp_path)
    assert list(tmp_path.iterdir()) == []


def test_numbers_that_make_no_sense_are_refused() -> None:
    for n_runs, seed, workers, message in (
        (0, 0, 1, "runs = 0, needed 1 or more"),
        (10**9, 0, 1, "runs = 1000000000, needed 1000000 at most"),
        (1, -1, 1, "seed = -1, needed 0 or more"),
        (1, 0, 0, "workers = 0, needed 1 or more"),
    ):
        with pytest.raises(UsageError, match=message):
            run_study(Draws(), n_runs, seed=seed, workers=workers)
    run_study(Draws(), 1, workers=10**11)  # more than are of use are not started
