"""What errors of parameters do to the platform is what written models do there, of every class."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hexapod_example import Run
from layouts import Layout, write_machine
from machines import of_types, written_with

import legcal
from legcal import Machine, evaluate, load_mechanism, random_configurations
from legcal.calibration.documents import Kinematic, ParameterRow
from legcal.calibration.joint_fit.platform import (
    expected_error,
    platform_accuracy,
    platform_by_parameters,
)
from legcal.calibration.result import joints_in_links
from legcal.calibration.verification import possible_changes
from legcal.errors import NotIdentifiable
from legcal.geometry.types import Array
from legcal.machine.kinematics import forward_kinematics_many, platform_in_base, pose_differences
from legcal.machine.leg import LINKS, LegKind
from legcal.machine.parameters import (
    Parametrization,
    geometries,
    moved_legs,
    nominal_axes,
    parametrization_of,
    reframed,
    vector_of,
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


def test_poses_that_readings_do_not_determine_have_no_predicted_error() -> None:
    nominal = load_mechanism("hexapod")
    first, *others = geometries(nominal)
    legs = [replace(first, kind=LegKind.PASSIVE), *others]
    poses = [platform_in_base(nominal, nominal.home)]
    with pytest.raises(NotIdentifiable, match="the 5 readings do not determine platform pose 1"):
        platform_by_parameters(legs, parametrization_of(nominal), nominal.frame_legs, poses)


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


# Joints in the links that an owner knows: as the written URDF has them, covariance and all


OBLIQUE = "nategh-agheli"  # its R_b is turned against its base link by 170 deg


def test_joints_are_where_the_written_model_has_them(example_run: Run) -> None:
    result = legcal.load_result(example_run.output)
    links = result.result.links
    assert links is not None
    machine = result.machine
    for side, points in zip(LINKS, (machine.A_base, machine.B_platform), strict=True):
        joints = links[side].joints
        np.testing.assert_allclose([joint.xyz for joint in joints], points, atol=1e-12)
        assert [joint.defines for joint in joints][::2] == ["origin", "x axis", "xy plane"]
        assert joints[0].sigma == [None] * 3
        assert joints[0].xyz == pytest.approx(joints[0].nominal, abs=1e-15)
    rows = [row for row in result.joints() if row["joint"] == "base"]
    assert [row["status"] for row in rows[6:9]] == ["x axis of R_b", "defines R_b", "defines R_b"]
    sigma = {row.name: row.sigma for row in result.result.parameters}
    assert rows[5]["sigma"] == pytest.approx(1e3 * float(sigma["leg2.base.z"] or 0.0))  # z is z


@pytest.mark.parametrize("model", [OBLIQUE, "3-rpr", "3-upu-tilted"])
def test_covariance_is_that_of_joints_of_written_models(model: str) -> None:
    """Each parameter is moved in the URDF: the joints that are loaded give the derivatives."""
    machine = load_mechanism(model)
    found, legs = parametrization_of(machine, twists=True), geometries(machine)
    rng, n = np.random.default_rng(3), len(found)
    factor = 1e-5 * rng.normal(size=(n, n))
    covariance = factor @ factor.T
    fixed = found.names.index(f"{machine.leg_names[-1]}.base.x")
    covariance[fixed], covariance[:, fixed] = 0.0, 0.0
    values = vector_of(found, legs, legs).tolist()
    rows = [
        ParameterRow(
            name=name, value=value, nominal=value, unit=unit, sigma=None if k == fixed else 1.0,
            status="fixed" if k == fixed else "estimated",
        )
        for k, (name, unit, value) in enumerate(zip(found.names, found.units, values, strict=True))
    ]  # fmt: skip
    kinematic = Kinematic(names=list(found.names), covariance=covariance.tolist(), held=[])
    axes = nominal_axes(machine.leg_names, legs)
    blocks = joints_in_links(machine, rows, kinematic)

    def joints_with(step: Array) -> Array:
        """Return all base joints and all platform joints in their links (2, n_legs, 3)."""
        moved = moved_legs(legs, found.place, step)
        return np.array(
            [
                machine.T_base_Rb.apply([leg.A for leg in moved]),
                machine.T_platform_Re.apply([leg.B for leg in moved]),
            ]
        )

    J = np.stack(
        [(joints_with(1e-3 * e) - joints_with(-1e-3 * e)) / 2e-3 for e in np.eye(n)], axis=-1
    )
    for k, side in enumerate(LINKS):
        for joint, by in zip(blocks[side].joints, J[k], strict=True):
            expected = by @ covariance @ by.T
            np.testing.assert_allclose(joint.covariance, expected, atol=1e-16)
            for sigma, status, variance in zip(
                joint.sigma, joint.status, np.diagonal(expected), strict=True
            ):
                assert (sigma is not None) == (status == "estimated") == (variance > 1e-18)
                assert sigma is None or sigma**2 == pytest.approx(variance)

    def axes_with(side: str, step: Array) -> dict[str, Array]:
        """Return the axes of a side in its link by leg."""
        frame = machine.T_base_Rb if side == "base" else machine.T_platform_Re
        moved = zip(machine.leg_names, moved_legs(legs, found.place, step), strict=True)
        own = ((name, getattr(leg, f"{side}_axis")) for name, leg in moved)
        return {name: frame.rotation.apply(axis) for name, axis in own if axis is not None}

    for side in LINKS:
        assert [one.leg for one in blocks[side].axes] == list(axes[side])
        for one in blocks[side].axes:
            ends = [[axes_with(side, h * e)[one.leg] for e in np.eye(n)] for h in (1e-4, -1e-4)]
            turn = np.cross(one.direction, (np.array(ends[0]) - ends[1]) / 2e-4)  # (n, 3)
            expected = np.einsum("ki,kl,li->i", turn, covariance, turn)
            np.testing.assert_allclose(np.square(one.sigma or []), expected, rtol=1e-5, atol=1e-18)


@pytest.mark.parametrize("model", [OBLIQUE, "3-upu-tilted"])
def test_what_may_have_moved_counts_along_the_links(model: str) -> None:
    """A joint is moved in the link; R_b and R_e, built anew, give the parameters."""
    machine = load_mechanism(model)
    found, legs = parametrization_of(machine), geometries(machine)
    before, step = vector_of(found, legs, legs), 1e-5
    changes = {change.what: change for change in possible_changes(machine, found.names)[1]}
    for side in ("base", "platform"):
        for j, name in enumerate(machine.leg_names):
            change = changes[f"{side} joint of {name}"]
            for k, axis in enumerate(change.components):
                by, end = step * np.eye(3)["xyz".index(axis)], "A" if side == "base" else "B"
                leg = replace(machine.legs[j], **{end: getattr(machine.legs[j], end) + by})
                moved = replace(machine, legs=(*machine.legs[:j], leg, *machine.legs[j + 1 :]))
                after = vector_of(found, geometries(moved), legs)
                np.testing.assert_allclose(change.columns[:, k], (after - before) / step, atol=2e-3)
            assert set(change.links) == {getattr(machine, side)}
