"""What errors of parameters do to the platform is what written models do there, of every class."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from parameter_steps import random_covariance, written_with

from legcal import evaluate
from legcal.calibration.joint_fit.platform import (
    expected_error,
    platform_accuracy,
    platform_by_parameters,
)
from legcal.errors import NotIdentifiable
from legcal.geometry.types import Array
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


def test_the_change_and_the_workspace_are_those_of_written_models(tmp_path: Path) -> None:
    nominal = load_mechanism("tricept")
    parameters = parametrization_of(nominal, twists=True)
    rng = np.random.default_rng(3)
    step = 5e-4 * rng.normal(size=len(parameters))
    calibrated = written_with(nominal, parameters, step, tmp_path / "a")
    q = random_configurations(nominal, 3, rng).readings
    root = random_covariance(parameters, rng, 1, 1e-6)
    before, after = (
        [platform_in_base(m, T) for T in forward_kinematics_many(m, q)]
        for m in (nominal, calibrated)
    )
    accuracy = platform_accuracy(
        nominal, geometries(calibrated), parameters, root @ root.T, q, after, {}
    )
    assert accuracy is not None
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
