"""Planned sessions: what they hold, what they promise, and what is refused."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import legcal
from legcal import planning
from legcal.data import load_dataset
from legcal.machine import inverse_kinematics, load_mechanism
from legcal.planning import Setting
from legcal.simulation import Level, SimulationSettings, simulate

FEW = Setting(draws=4)


@pytest.fixture(scope="module")
def planned() -> planning.Plan:
    """A plan for outlines with white noise."""
    return legcal.plan("3-rpr", images=6, cameras=2, seed=3, noise=planning.WHITE, setting=FEW)


@pytest.fixture(scope="module")
def shot(planned: planning.Plan, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A simulated session of it, beside the plan."""
    folder = tmp_path_factory.mktemp("planned")
    planning.write_session(planned, folder / "session")
    settings = replace(SimulationSettings(seed=5), plan=folder / "session", level=Level.OUTLINES)
    simulate(load_mechanism("3-rpr"), folder / "shot", settings)
    return folder


def test_a_planned_session_is_a_dataset_and_simulation_shoots_it(
    planned: planning.Plan, shot: Path
) -> None:
    dataset = load_dataset(shot / "session", check_images=False)
    machine, m = dataset.machine, dataset.measurements
    assert m.n_rows == planned.n_images == 6
    poses = [T for view in planned.views for T in view.poses.poses]
    readings = np.array([inverse_kinematics(machine, T) for T in poses])
    motors = list(machine.motors)
    assert np.abs(readings - m.q)[:, motors].max() < 1e-9
    taken = load_dataset(shot / "shot").measurements
    assert np.abs(taken.q - m.q)[:, motors].max() < 2e-5  # encoders err
    assert taken.view.tolist() == m.view.tolist()


def test_the_expected_error_is_that_of_a_calibration(planned: planning.Plan, shot: Path) -> None:
    found = legcal.calibrate(shot / "shot", output=shot / "out")
    assert found.platform is not None
    assert found.platform.workspace is not None
    assert planned.error is not None
    stated = found.platform.workspace.mean_displacement
    assert planned.error.mean_displacement == pytest.approx(stated, rel=0.25)
