"""What is predicted at the platform is what written models do there, of every class."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from parameter_steps import random_covariance, written_with

from legcal.calibration.joint_fit.platform import (
    PlatformError,
    expected_error,
    moved_by,
    platform_by_parameters,
    predict_platform_error,
)
from legcal.errors import NotIdentifiable
from legcal.geometry.types import Array
from legcal.machine import (
    LegKind,
    Machine,
    forward_kinematics_many,
    geometries,
    load_mechanism,
    parametrization_of,
    parametrize,
    platform_in_base,
    random_configurations,
)

MACHINES = ("hexapod-rod", "hexapod-strut", "3-rpr", "3-rps", "3-spr", "3-upu-tilted", "tricept")


def _motions(nominal: Machine, other: Machine, q: Array) -> Array:
    """Return rotation vectors and displacements of R_e in R_b from one model to another, (k, 6)."""
    pairs = zip(forward_kinematics_many(nominal, q), forward_kinematics_many(other, q), strict=True)
    found = []
    for T, T_other in pairs:
        before, after = platform_in_base(nominal, T), platform_in_base(other, T_other)
        turn = (after.rotation * before.rotation.inv()).as_rotvec()
        found.append([*turn, *(after.translation - before.translation)])
    return np.array(found)


@pytest.mark.parametrize("name", MACHINES)
def test_predicted_errors_are_those_of_written_models_in_pinocchio(
    name: str, tmp_path: Path
) -> None:
    nominal = load_mechanism(name)
    parametrization = parametrization_of(nominal, twists=True)
    rng = np.random.default_rng(4)
    drawn = random_configurations(nominal, 3, rng)
    root = random_covariance(parametrization, rng, 3, 2e-5)
    poses = [platform_in_base(nominal, T) for T in drawn.poses]
    predicted = predict_platform_error(
        geometries(nominal), parametrization, root @ root.T, nominal.frame_legs, poses
    )
    squares = np.zeros((3, 6))
    for k, column in enumerate(root.T):
        other = written_with(nominal, parametrization, column, tmp_path / str(k))
        squares += _motions(nominal, other, drawn.readings) ** 2
    np.testing.assert_allclose(predicted.displacement, np.sqrt(squares[:, 3:].sum(1)), rtol=3e-3)
    np.testing.assert_allclose(predicted.rotation, np.sqrt(squares[:, :3].sum(1)), rtol=3e-3)
    assert predicted.displacement.min() > 1e-6


def test_a_change_of_the_parameters_moves_the_platform_as_its_covariance_says() -> None:
    nominal = load_mechanism("3-rps")
    drawn = random_configurations(nominal, 4, 1)
    parametrization = parametrization_of(nominal)
    J = platform_by_parameters(
        geometries(nominal),
        parametrization,
        nominal.frame_legs,
        [platform_in_base(nominal, T) for T in drawn.poses],
    )
    change = np.random.default_rng(2).normal(size=len(parametrization))
    moved, expected = moved_by(J, change[:, None]), expected_error(J, np.outer(change, change))
    np.testing.assert_allclose(moved.displacement, expected.displacement, rtol=1e-9)
    np.testing.assert_allclose(moved.rotation, expected.rotation, rtol=1e-9)


def test_means_and_maxima_are_those_over_the_poses() -> None:
    error = PlatformError(np.array([1.0, 3.0]), np.array([0.2, 0.1]))
    assert (error.mean_displacement, error.max_displacement) == (2.0, 3.0)
    assert error.mean_rotation == pytest.approx(0.15)
    assert error.max_rotation == 0.2


def test_a_pose_that_readings_do_not_determine_is_refused() -> None:
    nominal = load_mechanism("hexapod")
    legs = geometries(nominal)
    passive = [*legs[:5], replace(legs[5], kind=LegKind.PASSIVE, q0=np.nan)]
    parametrization = parametrize(nominal.leg_names, passive, nominal.frame_legs)
    with pytest.raises(NotIdentifiable, match="the 5 readings do not determine platform pose 1"):
        predict_platform_error(
            passive,
            parametrization,
            np.eye(29),
            nominal.frame_legs,
            [platform_in_base(nominal, nominal.home)],
        )
