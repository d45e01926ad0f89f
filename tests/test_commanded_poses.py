"""Simulated poses are such that a controller with the nominal model could have commanded them."""

from pathlib import Path

import numpy as np
import pytest
from simulated import settings

import legcal
from legcal.errors import DidNotConverge
from legcal.machine import Machine
from legcal.simulation import poses as module
from legcal.simulation.poses import commanded_poses, draw_poses
from legcal.simulation.request import Sampling
from legcal.simulation.truth import write_true_model


@pytest.fixture(scope="module")
def pair(tmp_path_factory: pytest.TempPathFactory) -> tuple[Machine, Machine]:
    nominal = legcal.load_mechanism("nategh-agheli")
    folder: Path = tmp_path_factory.mktemp("truth")
    return nominal, write_true_model(nominal, settings().errors, np.random.default_rng(3), folder)


def test_the_nominal_model_reaches_every_pose_at_its_readings(
    pair: tuple[Machine, Machine],
) -> None:
    nominal, truth = pair
    home = legcal.singularity(nominal, nominal.home)
    poses = commanded_poses(truth, nominal, 12, np.random.default_rng(0), Sampling.EXTREME)
    assert len(poses.configurations) == len(poses.poses) == len(poses.readings) == 12
    for T, q in zip(poses.poses, poses.readings, strict=True):
        near = legcal.forward_kinematics(nominal, q)
        assert legcal.singularity(nominal, near) >= 0.05 * home
        assert np.linalg.norm(near.translation - T.translation) < 0.1


def test_poses_that_the_nominal_model_does_not_reach_are_drawn_again(
    pair: tuple[Machine, Machine], monkeypatch: pytest.MonkeyPatch
) -> None:
    nominal, truth = pair
    readings = draw_poses(truth, 3, np.random.default_rng(0)).readings
    monkeypatch.setattr(module, "_reaches", lambda _, q: not np.array_equal(q, readings[1]))
    poses = commanded_poses(truth, nominal, 3, np.random.default_rng(0), Sampling.EXTREME)
    assert np.array_equal(poses.readings[:2], readings[[0, 2]])
    assert len(poses.poses) == 3


def test_a_machine_far_from_its_model_is_refused(
    pair: tuple[Machine, Machine], monkeypatch: pytest.MonkeyPatch
) -> None:
    nominal, truth = pair
    monkeypatch.setattr(module, "_reaches", lambda *_: False)
    with pytest.raises(DidNotConverge, match="found 0 that the true machine and the nominal"):
        commanded_poses(truth, nominal, 1, np.random.default_rng(0), Sampling.EXTREME)
