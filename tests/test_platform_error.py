"""What errors of parameters do to the platform is what written models do there, of every class."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from parameter_steps import random_covariance, written_with

from legcal import evaluate
from legcal.calibration.joint_fit import platform
from legcal.calibration.joint_fit.platform import (
    PlatformAccuracy,
    expected_error,
    platform_accuracy,
    platform_by_parameters,
)
from legcal.errors import NotIdentifiable
from legcal.geometry.types import Array
from legcal.machine import configurations
from legcal.machine.configurations import random_configurations
from legcal.machine.kinematics import forward_kinematics_many, platform_in_base, pose_differences
from legcal.machine.leg import LegKind
from legcal.machine.loader import load_mechanism
from legcal.machine.model import Machine
from legcal.machine.parameters import geometries, parametrization_of, parametrize


def _motions(nominal: Machine, other: Machine, q: Array) -> Array:
    """Return rotation vectors and displacements of R_e in R_b from one model to another, (k, 6)."""
    pairs = zip(forward_kinematics_many(nominal, q), forward_kinematics_many(other, q), strict=True)
    found = []
    for T, T_other in pairs:
        before, after = platform_in_base(nominal, T), platform_in_base(other, T_other)
        turn = (after.rotation * before.rotation.inv()).as_rotvec()
        found.append([*turn, *(after.translation - before.translation)])
    return np.array(found)


@pytest.mark.parametrize("name", ["3-rpr", "hexapod-rod"])
def test_predicted_errors_are_those_of_written_models_in_pinocchio(
    name: str, tmp_path: Path
) -> None:
    nominal = load_mechanism(name)
    parametrization = parametrization_of(nominal, twists=True)
    rng = np.random.default_rng(4)
    drawn = random_configurations(nominal, 3, rng)
    root = random_covariance(parametrization, rng, 3, 2e-5)
    poses = [platform_in_base(nominal, T) for T in drawn.poses]
    J = platform_by_parameters(geometries(nominal), parametrization, nominal.frame_legs, poses)
    predicted = expected_error(J, root @ root.T)
    squares = np.zeros((3, 6))
    for k, column in enumerate(root.T):
        other = written_with(nominal, parametrization, column, tmp_path / str(k))
        squares += _motions(nominal, other, drawn.readings) ** 2
    np.testing.assert_allclose(predicted.displacement, np.sqrt(squares[:, 3:].sum(1)), rtol=3e-3)
    np.testing.assert_allclose(predicted.rotation, np.sqrt(squares[:, :3].sum(1)), rtol=3e-3)
    assert predicted.displacement.min() > 1e-6


def test_a_pose_that_readings_do_not_determine_is_refused() -> None:
    nominal = load_mechanism("hexapod")
    legs = geometries(nominal)
    passive = [*legs[:5], replace(legs[5], kind=LegKind.PASSIVE, q0=np.nan)]
    parametrization = parametrize(nominal.leg_names, passive, nominal.frame_legs)
    with pytest.raises(NotIdentifiable, match="the 5 readings do not determine platform pose 1"):
        platform_by_parameters(
            passive, parametrization, nominal.frame_legs, [platform_in_base(nominal, nominal.home)]
        )


# Of a calibration: what it changed, how well that is known, and what wrong assumptions do


def _accuracy(
    nominal: Machine, calibrated: Machine, q: Array, root: Array, **effects: Array
) -> PlatformAccuracy:
    """Return the accuracy of a calibration that ended at a given model."""
    accuracy = platform_accuracy(
        nominal,
        geometries(calibrated),
        parametrization_of(nominal, twists=True),
        root @ root.T,
        q,
        [platform_in_base(calibrated, T) for T in forward_kinematics_many(calibrated, q)],
        effects,
    )
    assert accuracy is not None
    return accuracy


@pytest.mark.parametrize("name", ["tricept"])
def test_the_change_and_the_workspace_are_those_of_written_models(
    name: str, tmp_path: Path
) -> None:
    nominal = load_mechanism(name)
    parameters = parametrization_of(nominal, twists=True)
    rng = np.random.default_rng(3)
    step = 5e-4 * rng.normal(size=len(parameters))
    calibrated = written_with(nominal, parameters, step, tmp_path / "a")
    q = random_configurations(nominal, 3, rng).readings
    root = random_covariance(parameters, rng, 1, 1e-6)
    accuracy = _accuracy(nominal, calibrated, q, root)
    before, after = (
        [platform_in_base(m, T) for T in forward_kinematics_many(m, q)]
        for m in (nominal, calibrated)
    )
    displacement, rotation = pose_differences(after, before)
    np.testing.assert_allclose(accuracy.change.displacement, displacement, rtol=1e-6)
    np.testing.assert_allclose(accuracy.change.rotation, rotation, rtol=1e-6)
    apart = evaluate(calibrated, written_with(calibrated, parameters, root[:, 0], tmp_path / "b"))
    assert accuracy.workspace is not None
    assert len(accuracy.workspace.displacement) == len(apart.displacement) == 100
    for found, expected, rel in (
        (accuracy.workspace.mean_displacement, apart.displacement.mean(), 0.03),
        (accuracy.workspace.max_displacement, apart.displacement.max(), 0.1),
        (accuracy.workspace.mean_rotation, apart.rotation.mean(), 0.03),
        (accuracy.workspace.max_rotation, apart.rotation.max(), 0.1),
    ):
        assert found == pytest.approx(expected, rel=rel)


@pytest.mark.parametrize("workspace", [True, False])
def test_wrong_assumptions_count_over_the_workspace_or_at_the_readings(
    workspace: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    nominal = load_mechanism("hexapod")
    longer = np.zeros(30)
    longer[-6:] = 1e-3  # all offsets: the platform is lifted
    q = random_configurations(nominal, 2, 0).readings
    if not workspace:
        monkeypatch.setattr(platform, "workspace", configurations.workspace.__wrapped__)
        monkeypatch.setattr(configurations, "WORKSPACE_SEED", 1)  # drawn anew, with no share
        monkeypatch.setattr(configurations, "SHARES", np.zeros(0))
    accuracy = _accuracy(nominal, nominal, q, np.zeros((30, 1)), longer=longer[:, None])
    effect = accuracy.effects["longer"]
    assert len(effect.displacement) == (100 if workspace else 2)
    assert (accuracy.workspace is None) == (not workspace)
    assert 0.9e-3 < effect.mean_displacement < 2e-3
    assert accuracy.sigma.max_displacement == 0.0
    assert accuracy.change.max_displacement < 1e-9
