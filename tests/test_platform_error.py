"""What errors of parameters do to the platform is what written models do there, of every class."""

from pathlib import Path

import numpy as np
import pytest
from layouts import Layout, write_machine
from machines import of_types, written_with

from legcal import Machine, evaluate, load_mechanism, random_configurations
from legcal.calibration.joint_fit.platform import (
    expected_error,
    platform_accuracy,
    platform_by_parameters,
)
from legcal.geometry.types import Array
from legcal.machine.kinematics import forward_kinematics_many, platform_in_base, pose_differences
from legcal.machine.parameters import (
    Parametrization,
    geometries,
    moved_legs,
    parametrization_of,
    reframed,
)


def random_covariance(
    parametrization: Parametrization, rng: np.random.Generator, rank: int, sigma: float
) -> Array:
    """Return the root (p, rank) of a covariance, parameters known to about sigma [m, rad]."""
    return np.asarray(sigma * rng.normal(size=(len(parametrization), rank)) / np.sqrt(rank))


def changed(nominal: Machine, parametrization: Parametrization, step: Array, to: Path) -> Machine:
    """Return a mechanism with changed parameters, as loaded from the files written of it."""
    origin = np.asarray(nominal.T_platform_Re.inv().translation)
    moved = moved_legs(geometries(nominal), parametrization.place, step)
    return written_with(nominal, reframed(moved, nominal.frame_legs, origin), to)


def _motions(nominal: Machine, other: Machine, q: Array) -> Array:
    """Return rotation vectors and displacements of R_e in R_b from one model to another, (k, 6)."""
    pairs = zip(forward_kinematics_many(nominal, q), forward_kinematics_many(other, q), strict=True)
    found = []
    for T, T_other in pairs:
        before, after = platform_in_base(nominal, T), platform_in_base(other, T_other)
        turn = (after.rotation * before.rotation.inv()).as_rotvec()
        found.append([*turn, *(after.translation - before.translation)])
    return np.array(found)


REDUNDANT = of_types(["RS", "RS", "SS", "SS", "SS"], ["actuated"] * 4 + ["constant"])


@pytest.mark.parametrize("name", ["3-rpr", "hexapod-rod", "3-rps", "tricept", "3-upu-tilted", ""])
def test_predicted_errors_are_those_of_written_models_in_pinocchio(
    name: str, tmp_path: Path
) -> None:
    """Also of a machine with a motor too many, whose poses are those of least squares."""
    nominal = load_mechanism(name or write_machine(tmp_path, REDUNDANT, Layout()))
    parametrization = parametrization_of(nominal, twists=True)
    rng = np.random.default_rng(4)
    drawn = random_configurations(nominal, 3, rng)
    root = random_covariance(parametrization, rng, 3, 2e-5)
    poses = [platform_in_base(nominal, T) for T in drawn.poses]
    J = platform_by_parameters(geometries(nominal), parametrization, nominal.frame_legs, poses)
    predicted = expected_error(J, root @ root.T)
    squares = np.zeros((3, 6))
    for k, column in enumerate(root.T):
        other = changed(nominal, parametrization, column, tmp_path / str(k))
        moved = _motions(nominal, other, drawn.readings)
        np.testing.assert_allclose(J @ column, moved, atol=3e-3 * np.abs(moved).max())
        squares += moved**2
    np.testing.assert_allclose(predicted.displacement, np.sqrt(squares[:, 3:].sum(1)), rtol=3e-3)
    np.testing.assert_allclose(predicted.rotation, np.sqrt(squares[:, :3].sum(1)), rtol=3e-3)
    assert predicted.displacement.min() > 1e-6


# Of a calibration: what it changed, how well that is known, and what wrong assumptions do


def test_the_change_and_the_workspace_are_those_of_written_models(tmp_path: Path) -> None:
    nominal = load_mechanism("tricept")
    parameters = parametrization_of(nominal, twists=True)
    rng = np.random.default_rng(3)
    step = 5e-4 * rng.normal(size=len(parameters))
    calibrated = changed(nominal, parameters, step, tmp_path / "a")
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
    apart = evaluate(calibrated, changed(calibrated, parameters, root[:, 0], tmp_path / "b"))
    assert accuracy.workspace is not None
    assert len(accuracy.workspace.displacement) == len(apart.displacement) == 100
    for found, expected, rel in (
        (accuracy.workspace.mean_displacement, apart.displacement.mean(), 0.03),
        (accuracy.workspace.max_displacement, apart.displacement.max(), 0.1),
        (accuracy.workspace.mean_rotation, apart.rotation.mean(), 0.03),
        (accuracy.workspace.max_rotation, apart.rotation.max(), 0.1),
    ):
        assert found == pytest.approx(expected, rel=rel)
