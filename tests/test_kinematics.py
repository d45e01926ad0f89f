"""Kinematics of the closed chain against closed forms, finite differences and a second reader."""

import csv
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pinocchio as pin
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from mechanisms import ROOT, SHIPPED_URDF, SHIPPED_YAML, Layout, geometry, write_hexapod
from scipy.spatial.transform import RigidTransform, Rotation

from legcal.errors import DidNotConverge, NotIdentifiable, UsageError
from legcal.geometry.types import Array
from legcal.machine import (
    LegKind,
    Machine,
    forward_kinematics,
    forward_kinematics_many,
    inverse_kinematics,
    leg_vectors,
    load_mechanism,
    platform_pose,
)
from legcal.machine.chain import ClosedChain, Closure
from legcal.machine.kinematics import close_at
from legcal.machine.mobility import mobility


@pytest.fixture(scope="module")
def hexapod() -> Machine:
    return load_mechanism("hexapod")


def _sample_readings(machine: Machine) -> Array:
    with (ROOT / "examples" / "hexapod" / "measurements.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    return np.array([[float(row[str(leg.prismatic)]) for leg in machine.legs] for row in rows])


def _length_misfit(machine: Machine, T: RigidTransform, q: Array) -> float:
    lengths = np.linalg.norm(leg_vectors(machine, T), axis=1)
    return float(np.abs(lengths - (machine.sign * q + machine.q0)).max())


@settings(
    max_examples=40, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture]
)
@given(xyz=st.tuples(*[st.floats(-0.05, 0.05)] * 3), turn=st.tuples(*[st.floats(-0.25, 0.25)] * 3))
def test_forward_kinematics_inverts_inverse_kinematics(
    hexapod: Machine, xyz: tuple[float, float, float], turn: tuple[float, float, float]
) -> None:
    T = RigidTransform.from_components(
        np.asarray(hexapod.home.translation) + xyz, Rotation.from_rotvec(turn)
    ) * RigidTransform.from_rotation(hexapod.home.rotation)
    found = forward_kinematics(hexapod, inverse_kinematics(hexapod, T))
    np.testing.assert_allclose(found.as_matrix(), T.as_matrix(), atol=1e-11)


def test_every_random_reading_of_the_travel_closes_in_one_assembly_mode(
    hexapod: Machine,
) -> None:
    rng = np.random.default_rng(11)
    lower, upper = np.array([leg.travel for leg in hexapod.legs]).T
    q = rng.uniform(lower, upper, (150, 6))
    poses = forward_kinematics_many(hexapod, q)
    for row, T in zip(q, poses, strict=True):
        assert _length_misfit(hexapod, T, row) < 1e-12
        assert T.translation[2] > 0.1
    for row, T in list(zip(q, poses, strict=True))[::10]:
        alone = forward_kinematics(hexapod, row)
        np.testing.assert_allclose(alone.as_matrix(), T.as_matrix(), atol=1e-11)


def test_a_path_of_readings_gives_a_continuous_path_of_poses(hexapod: Machine) -> None:
    start, end = np.full(6, 0.0), np.array([0.14, 0.0, 0.14, 0.02, 0.1, 0.03])
    q = start + np.linspace(0.0, 1.0, 60)[:, None] * (end - start)
    poses = forward_kinematics_many(hexapod, q)
    for one, two in pairwise(poses):
        step = one.inv() * two
        assert np.linalg.norm(step.translation) < 0.02
        assert step.rotation.magnitude() < 0.05


def test_the_sample_readings_close_and_row_order_does_not_matter(hexapod: Machine) -> None:
    q = _sample_readings(hexapod)
    poses = forward_kinematics_many(hexapod, q)
    backwards = forward_kinematics_many(hexapod, q[::-1])[::-1]
    for row, T, other in zip(q, poses, backwards, strict=True):
        assert _length_misfit(hexapod, T, row) < 1e-12
        np.testing.assert_allclose(T.as_matrix(), other.as_matrix(), atol=1e-12)


def test_a_warm_start_leads_to_the_same_pose(hexapod: Machine) -> None:
    q = inverse_kinematics(hexapod, hexapod.home)
    q = q + np.array([0.01, -0.02, 0.03, 0.0, 0.02, -0.01])
    cold = forward_kinematics(hexapod, q)
    warm = forward_kinematics(hexapod, q, start=cold)
    np.testing.assert_allclose(warm.as_matrix(), cold.as_matrix(), atol=1e-12)


def test_a_start_in_another_assembly_mode_stays_there(hexapod: Machine) -> None:
    # Base and platform joints are coplanar: the mirror image in their planes has equal legs.
    below = RigidTransform.from_components(
        hexapod.home.translation * [1.0, 1.0, -1.0], hexapod.home.rotation
    )
    q = inverse_kinematics(hexapod, hexapod.home) + 0.01
    above_T, below_T = forward_kinematics(hexapod, q), forward_kinematics(hexapod, q, start=below)
    np.testing.assert_allclose(
        below_T.translation, above_T.translation * [1.0, 1.0, -1.0], atol=1e-9
    )


def test_both_readers_of_the_urdf_place_every_link_alike(hexapod: Machine) -> None:
    from yourdfpy import URDF

    robot = URDF.load(str(SHIPPED_URDF), load_meshes=False)
    q = inverse_kinematics(hexapod, hexapod.home)
    configuration = hexapod.home_configuration
    values = {
        joint.name: float(configuration[hexapod.chain.q_index(joint.name)])
        for joint in hexapod.urdf.joints.values()
        if joint.type in ("revolute", "prismatic")
    }
    assert [values[str(leg.prismatic)] for leg in hexapod.legs] == pytest.approx(q, abs=1e-12)
    robot.update_cfg(values)
    for j in range(1, 7):
        for link in ("b1_link", "b2_link", "tube", "end"):
            ours = hexapod.chain.pose(configuration, "platform", f"leg{j}_{link}")
            theirs = robot.get_transform(f"leg{j}_{link}", "platform")
            np.testing.assert_allclose(ours.as_matrix(), theirs, atol=1e-12)
        # the second reader knows no loops: closed by us, its leg ends at the base joint too
        end = hexapod.home.apply(robot.get_transform(f"leg{j}_end", "platform")[:3, 3])
        np.testing.assert_allclose(end, hexapod.A_base[j - 1], atol=1e-12)


@pytest.mark.parametrize("kind", ["3d", "6d"])
def test_the_jacobian_of_a_closure_is_the_derivative_of_its_residual(kind: str) -> None:
    closure = Closure("3d" if kind == "3d" else "6d", "leg1_end", "leg2_seat")
    chain = ClosedChain(SHIPPED_URDF.read_text(), [closure])
    configuration = chain.integrate(
        chain.neutral(), np.random.default_rng(2).uniform(-0.5, 0.5, chain.nv)
    )
    residual, jacobian = chain.linearize(configuration)
    np.testing.assert_allclose(residual, chain.residual(configuration), atol=1e-15)
    h = 1e-6
    numeric = np.stack(
        [
            chain.residual(chain.integrate(configuration, h * e))
            - chain.residual(chain.integrate(configuration, -h * e))
            for e in np.eye(chain.nv)
        ],
        axis=1,
    ) / (2 * h)
    np.testing.assert_allclose(jacobian, numeric, atol=1e-8)
    assert np.abs(jacobian).max() > 0.1


def test_rotation_columns_are_those_that_turn(hexapod: Machine) -> None:
    columns = set(hexapod.chain.rotation_columns().tolist())
    angles = {
        hexapod.chain.v_index(joint.name)
        for joint in hexapod.urdf.joints.values()
        if joint.type == "revolute"
    }
    floating = hexapod.chain.v_index("platform_free")
    assert columns == angles | {floating + 3, floating + 4, floating + 5}


def test_closing_at_a_pose_never_flips_a_leg(hexapod: Machine) -> None:
    T = RigidTransform.from_components([0.05, -0.03, 0.42], Rotation.from_rotvec([0.2, 0.1, 0.8]))
    configuration = close_at(hexapod, T)
    np.testing.assert_allclose(
        platform_pose(hexapod, configuration).as_matrix(), T.as_matrix(), atol=1e-12
    )
    for leg in hexapod.legs:
        q = configuration[hexapod.chain.q_index(str(leg.prismatic))]
        assert leg.sign * q + leg.q0 > 0.1


def test_motors_that_do_not_determine_the_pose_are_refused(hexapod: Machine) -> None:
    passive = replace(hexapod.legs[1], kind=LegKind.PASSIVE)
    legs = (hexapod.legs[0], passive, *hexapod.legs[2:])
    with pytest.raises(NotIdentifiable, match="mobility 6 and 5 motors"):
        forward_kinematics(replace(hexapod, legs=legs), np.zeros(6))


def test_readings_that_make_no_sense_are_refused(hexapod: Machine) -> None:
    with pytest.raises(UsageError, match=r"needed \(6,\)"):
        forward_kinematics(hexapod, np.zeros(5))
    q = np.full(6, 0.07)
    q[3] = np.nan
    with pytest.raises(UsageError, match="reading nan of leg 'leg4'"):
        forward_kinematics(hexapod, q)
    q[3] = -0.4
    with pytest.raises(UsageError, match=r"reading -0\.4 of leg 'leg4'"):
        forward_kinematics_many(hexapod, np.array([np.full(6, 0.07), q]))


def test_readings_that_no_pose_has_do_not_converge(hexapod: Machine) -> None:
    q = np.array([3.0, 0.0, 0.0, 0.0, 0.0, 0.0])
    with pytest.raises(DidNotConverge, match=r"of row 2 could not be reached: at .* %"):
        forward_kinematics_many(hexapod, np.array([np.full(6, 0.07), q]))


def test_mobility_is_six_although_the_neutral_tree_is_singular(hexapod: Machine) -> None:
    assert mobility(hexapod) == 6
    assert pin.__version__.startswith("4.")


def test_spheres_as_revolutes_move_as_far_as_cut_ones(
    tmp_path_factory: pytest.TempPathFactory,
) -> None:
    description = geometry()
    layouts = (Layout(), Layout(welded=True), Layout(hung="base", first="S", welded=True))
    found = [
        load_mechanism(write_hexapod(tmp_path_factory.mktemp("layout"), layout, description))
        for layout in layouts
    ]
    T = RigidTransform.from_components([0.06, 0.05, 0.40], Rotation.from_rotvec([0.3, -0.3, 0.9]))
    q = inverse_kinematics(found[0], T)
    for machine in found:
        np.testing.assert_allclose(
            forward_kinematics(machine, q).as_matrix(), T.as_matrix(), atol=1e-10
        )


def test_the_yaml_of_the_example_is_the_shipped_one() -> None:
    example = ROOT / "examples" / "hexapod" / "models" / "hexapod.yaml"
    assert example.read_bytes() == SHIPPED_YAML.read_bytes()
