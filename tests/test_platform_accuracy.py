"""What a fit means at the platform, held against written models and ``legcal evaluate``."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from parameter_steps import random_covariance, written_with
from thinned import thinned

from legcal import evaluate
from legcal.calibration.joint_fit.platform import PlatformAccuracy, platform_accuracy
from legcal.calibration.joint_fit.sensitivity import Sensitivity
from legcal.geometry.types import Array
from legcal.machine import (
    Machine,
    forward_kinematics_many,
    geometries,
    load_mechanism,
    parametrization_of,
    platform_in_base,
    pose_differences,
    random_configurations,
)


def _accuracy(
    nominal: Machine, calibrated: Machine, q: Array, root: Array, *mistakes: Sensitivity
) -> PlatformAccuracy:
    """Return what is told of a calibration that ended at a given model."""
    poses = forward_kinematics_many(calibrated, q)
    found = platform_accuracy(
        nominal,
        geometries(calibrated),
        parametrization_of(nominal, twists=True),
        root @ root.T,
        q,
        [platform_in_base(calibrated, T) for T in poses],
        mistakes,
    )
    assert found is not None
    return found


@pytest.mark.parametrize("name", thinned(["3-rpr", "3-rps", "tricept"], ["3-rps", "tricept"]))
def test_the_change_and_the_workspace_are_those_of_written_models(
    name: str, tmp_path: Path
) -> None:
    nominal = load_mechanism(name)
    found = parametrization_of(nominal, twists=True)
    rng = np.random.default_rng(3)
    calibrated = written_with(nominal, found, 5e-4 * rng.normal(size=len(found)), tmp_path / "a")
    q = random_configurations(nominal, 3, rng).readings
    root = random_covariance(found, rng, 1, 1e-6)
    accuracy = _accuracy(nominal, calibrated, q, root)
    before, after = (
        [platform_in_base(m, T) for T in forward_kinematics_many(m, q)]
        for m in (nominal, calibrated)
    )
    displacement, rotation = pose_differences(after, before)
    np.testing.assert_allclose(accuracy.change.displacement, displacement, rtol=1e-6)
    np.testing.assert_allclose(accuracy.change.rotation, rotation, rtol=1e-6)
    other = written_with(calibrated, found, root[:, 0], tmp_path / "b")
    apart = evaluate(calibrated, other)
    assert accuracy.workspace is not None
    assert len(accuracy.workspace.displacement) == len(apart.displacement) == 100
    assert accuracy.workspace.mean_displacement == pytest.approx(
        apart.displacement.mean(), rel=0.03
    )
    assert accuracy.workspace.max_displacement == pytest.approx(apart.displacement.max(), rel=0.1)
    assert accuracy.workspace.mean_rotation == pytest.approx(apart.rotation.mean(), rel=0.03)


def test_errors_in_what_counts_as_known_are_told_over_the_workspace() -> None:
    nominal = load_mechanism("hexapod")
    longer = np.zeros(30)
    longer[-6:] = 1e-3  # all offsets: the platform is lifted
    q = random_configurations(nominal, 2, 0).readings
    accuracy = _accuracy(
        nominal, nominal, q, np.zeros((30, 1)), Sensitivity("legs 1 mm longer", longer[:, None])
    )
    (effect,) = accuracy.effects
    assert effect.what == "legs 1 mm longer"
    assert len(effect.error.displacement) == 100
    assert 0.9e-3 < effect.error.mean_displacement < 2e-3
    assert accuracy.sigma.max_displacement == 0.0
    assert accuracy.change.max_displacement < 1e-9


def test_without_a_workspace_errors_are_told_at_the_readings(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    nominal = load_mechanism("hexapod")
    q = random_configurations(nominal, 2, 0).readings
    monkeypatch.setattr("legcal.machine.configurations.NEARER", np.zeros(0))
    accuracy = _accuracy(nominal, nominal, q, np.eye(30), Sensitivity("anything", np.ones((30, 1))))
    assert accuracy.workspace is None
    assert len(accuracy.effects[0].error.displacement) == 2


def test_a_machine_whose_motors_do_not_determine_the_pose_has_no_platform_error() -> None:
    nominal = load_mechanism("hexapod")
    fewer = replace(nominal, mobility=7)
    q = random_configurations(nominal, 2, 0).readings
    poses = [nominal.home] * 2
    arguments = geometries(nominal), parametrization_of(nominal), np.eye(30), q, poses
    assert platform_accuracy(fewer, *arguments) is None
