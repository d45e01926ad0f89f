"""The singularity measure: zero at poses that are known to be singular, not far from them."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from layouts import Layout, LegSpec, MachineSpec, write_machine
from machines import planar, ring
from mechanisms import ROOT, displaced
from scipy.spatial.transform import RigidTransform, Rotation

from legcal.errors import DidNotConverge
from legcal.machine import (
    Follower,
    LegKind,
    Machine,
    forward_kinematics,
    inverse_kinematics,
    leg_vectors,
    load_mechanism,
    singularity,
)
from legcal.machine.equations import equations_at
from legcal.machine.mobility import determinant_sign, dimensionless

SHIPPED = sorted(path.stem for path in (ROOT / "models").glob("*.yaml"))


def _turned(machine: Machine, degrees: float, height: float = 0.4) -> RigidTransform:
    """Return home turned about z, from the attitude in which base and platform are symmetric."""
    turn = Rotation.from_euler("z", degrees, degrees=True) * machine.home.rotation
    return RigidTransform.from_components([0.0, 0.0, height], turn)


def test_leg_lines_alone_say_the_same_as_all_equations_of_a_hexapod() -> None:
    machine = load_mechanism("hexapod-strut")
    T = displaced(machine.home, [0.1, 0.2, -0.1, 0.02, 0.03, 0.01])
    jacobian = equations_at(machine, T).by_pose[0]
    lengths = np.linalg.norm(leg_vectors(machine, T), axis=1)
    centre = T.rotation.apply(machine.B_platform.mean(axis=0))
    moments = (jacobian[:, :3] - np.cross(centre, jacobian[:, 3:])) / lengths.mean()
    expected = np.hstack([moments, jacobian[:, 3:]])
    np.testing.assert_allclose(dimensionless(machine, T), expected, atol=1e-12)


@pytest.mark.parametrize("name", SHIPPED)
def test_home_of_a_shipped_model_is_regular(name: str) -> None:
    machine = load_mechanism(name)
    assert singularity(machine, machine.home) > 0.03


@pytest.mark.parametrize("quarter", [90.0, -90.0])
def test_a_symmetric_hexapod_is_singular_after_a_quarter_turn(quarter: float) -> None:
    # Fichter: at 90 degrees about the normal all leg lines belong to one linear complex
    machine = load_mechanism("hexapod")
    for height in (0.3, 0.5):
        assert singularity(machine, _turned(machine, quarter, height)) < 1e-6  # digits
        for degrees in (quarter - 20.0, quarter + 20.0):
            assert singularity(machine, _turned(machine, degrees, height)) > 0.05


def test_similar_hexagons_in_the_same_order_are_singular_everywhere(tmp_path: Path) -> None:
    angles = [10.0, 110.0, 130.0, 230.0, 250.0, 350.0]
    A, B = ring(angles, 0.3), ring(angles, 0.15)
    home = RigidTransform.from_components([0.0, 0.0, 0.4], Rotation.from_euler("z", 0.5))
    legs = tuple(
        LegSpec("US", a, np.asarray(home.apply(b)), base_axis=np.array([1.0, 0.0, 0.0]))
        for a, b in zip(A, B, strict=True)
    )
    machine = load_mechanism(write_machine(tmp_path, MachineSpec(legs, home), Layout()))
    for step in ([0.0] * 6, [0.2, 0.1, -0.1, 0.03, 0.02, 0.05]):
        assert singularity(machine, displaced(home, step)) < 1e-12


def test_a_hexapod_whose_legs_lie_in_its_base_is_singular() -> None:
    machine = load_mechanism("hexapod")
    assert singularity(machine, _turned(machine, 0.0, height=0.0)) < 1e-12


def test_a_planar_platform_is_singular_where_its_legs_meet_in_a_point(tmp_path: Path) -> None:
    machine = load_mechanism("3-rpr")
    A, B = machine.A_base, machine.B_platform
    centre = B.mean(axis=0)
    about = A.mean(axis=0)

    def at(angle: float) -> RigidTransform:
        turn = Rotation.from_rotvec([0.0, 0.0, angle])
        return RigidTransform.from_components(about - turn.apply(centre), turn)

    angles = np.linspace(-np.pi, np.pi, 721)
    measures = [singularity(machine, at(a)) for a in angles]
    # both triangles are regular: legs meet in the centre where the platform's corners face them
    best = float(angles[int(np.argmin(measures))])
    lines = leg_vectors(machine, at(best))[:, :2]
    moments = A[:, 0] * lines[:, 1] - A[:, 1] * lines[:, 0]
    concurrent = np.linalg.det(np.column_stack([lines, moments]))
    assert min(measures) < 2e-3
    assert abs(concurrent) < 1e-4
    assert singularity(machine, at(best + 0.5 * np.pi)) > 0.1


def test_the_measure_is_the_concurrency_determinant_of_a_planar_platform(tmp_path: Path) -> None:
    machine = load_mechanism(write_machine(tmp_path, planar(), Layout()))
    for angle in np.linspace(-1.0, 1.0, 9):
        T = displaced(machine.home, [0.0, 0.0, angle, 0.01, 0.02, 0.0])
        vectors = leg_vectors(machine, T)
        u = vectors / np.linalg.norm(vectors, axis=1)[:, None]
        A = machine.A_base
        moments = A[:, 0] * u[:, 1] - A[:, 1] * u[:, 0]
        lines = np.column_stack([moments, u[:, :2]])
        assert abs(determinant_sign(machine, T)) == 1.0
        found = dimensionless(machine, T)
        scale = np.linalg.norm(vectors, axis=1).mean()
        assert abs(np.linalg.det(found)) == pytest.approx(
            abs(np.linalg.det(lines)) / scale, abs=1e-9
        )


def test_a_3_upu_is_singular_in_its_constraints_where_all_legs_are_parallel() -> None:
    machine = load_mechanism("3-upu")
    measures = []
    for height in (0.45, 5.0, 50.0):
        T = RigidTransform.from_components([0.0, 0.0, height], machine.home.rotation)
        rows = dimensionless(machine, T)[~equations_at(machine, T).measured]
        measures.append(float(np.linalg.svd(rows, compute_uv=False)[2]))
    assert measures[0] > 5.0 * measures[1] > 20.0 * measures[2]


def test_a_3_upu_in_its_base_plane_has_no_hold_on_its_attitude() -> None:
    # all legs lie in the plane: nothing but the plane's own couple is left
    machine = load_mechanism("3-upu")
    T = RigidTransform.from_components([0.0, 0.0, 0.0], machine.home.rotation)
    assert singularity(machine, T) < 1e-9


def test_the_measure_does_not_depend_on_size_or_frames(tmp_path: Path) -> None:
    def description(scale: float, shift: np.ndarray) -> MachineSpec:
        angles, turned = (
            [10.0, 110.0, 130.0, 230.0, 250.0, 350.0],
            [50.0, 70.0, 170.0, 190.0, 290.0, 310.0],
        )
        A, B = scale * ring(angles, 0.3), scale * ring(turned, 0.2)
        place = scale * np.array([0.0, 0.0, 0.4])
        home = RigidTransform.from_components(place + shift, Rotation.from_euler("z", 0.4))
        legs = tuple(
            LegSpec("US", a + shift, np.asarray(home.apply(b)), base_axis=np.array([1.0, 0.0, 0.0]))
            for a, b in zip(A, B, strict=True)
        )
        return MachineSpec(legs, home)

    found = []
    for k, (scale, shift) in enumerate([(1.0, 0.0), (4.0, 0.0), (1.0, 2.0)]):
        path = write_machine(tmp_path / str(k), description(scale, np.full(3, shift)), Layout())
        machine = load_mechanism(path)
        found.append(singularity(machine, machine.home))
    np.testing.assert_allclose(found[1:], found[0], rtol=1e-9)


def test_forward_kinematics_does_not_pass_a_singular_attitude() -> None:
    machine = load_mechanism("hexapod")
    here = determinant_sign(machine, machine.home)
    beyond = _turned(machine, 100.0)
    assert determinant_sign(machine, beyond) == -here
    follower = Follower(machine)
    for degrees in (20.0, 40.0, 60.0, 75.0):
        wanted = _turned(machine, degrees)
        reached = follower.move_to(inverse_kinematics(machine, wanted))
        np.testing.assert_allclose(reached.as_matrix(), wanted.as_matrix(), atol=1e-9)
    # the same lengths have a pose on this side: it is found, and not the one beyond
    back = forward_kinematics(machine, inverse_kinematics(machine, beyond))
    assert determinant_sign(machine, back) == here
    assert (back.rotation * beyond.rotation.inv()).magnitude() > 0.1
    there = forward_kinematics(machine, inverse_kinematics(machine, beyond), start=beyond)
    np.testing.assert_allclose(there.as_matrix(), beyond.as_matrix(), atol=1e-9)
    with pytest.raises(DidNotConverge, match="or the mechanism is singular"):
        follower.move_to(np.array([0.5, 0.07, 0.07, 0.07, 0.07, 0.07]))
    np.testing.assert_allclose(
        follower.pose.as_matrix(), _turned(machine, 75.0).as_matrix(), atol=1e-9
    )


def test_a_mechanism_with_too_few_motors_measures_zero() -> None:
    machine = load_mechanism("hexapod")
    passive = replace(machine.legs[0], kind=LegKind.PASSIVE)
    loose = replace(machine, legs=(passive, *machine.legs[1:]))
    assert singularity(loose, loose.home) == 0.0
