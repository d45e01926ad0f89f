"""Revolute base joints in R_b: eqs (8) and (9), planes, and cameras that axes help to place."""

from dataclasses import replace

import numpy as np
import pytest
from machine_session import PINHOLE
from scipy.spatial.transform import RigidTransform, Rotation
from staged_machines import Observed, made_up_base, seen_from, shipped, three_steps

from legcal.data.axes import LegAxes
from legcal.data.measurements import Measurements, View
from legcal.errors import NotIdentifiable
from legcal.geometry.lines import normal_basis
from legcal.geometry.types import Array, BoolArray
from legcal.machine import Leg, LegKind
from legcal.paper.camera_poses import camera_poses
from legcal.paper.joints_in_base import (
    BaseUnknowns,
    build_rigid,
    build_scalar_products,
    locate_joints_in_base,
)
from legcal.paper.joints_in_camera import locate_joints_in_cameras, oriented
from legcal.paper.motions import turned_axis
from legcal.paper.nominal import NominalMachine

SQUARE = np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [1.0, 1.0, 0.0], [0.0, 1.0, 0.0]])
ACROSS = np.array([[0.3, 1.0, 0.0], [-0.2, 1.0, 0.1], [1.0, 0.2, 0.0], [0.1, 0.4, 1.0]])
ACROSS /= np.linalg.norm(ACROSS, axis=1, keepdims=True)


def legs_seen(*views: tuple[int, ...], n_legs: int = 4) -> BoolArray:
    seen = np.zeros((len(views), n_legs), dtype=np.bool_)
    for row, legs in zip(seen, views, strict=True):
        row[list(legs)] = True
    return seen


def away(A_Rb: Array, v_Rb: Array, seed: int = 0) -> tuple[Array, Array]:
    """Return joints 3 mm and axes 1 degree off; R_b is still on the first three joints."""
    rng = np.random.default_rng(seed)
    step = 0.003 * rng.choice([-1.0, 1.0], A_Rb.shape)
    step[[0, 0, 0, 1, 1, 2], [0, 1, 2, 1, 2, 2]] = 0.0
    turn = np.deg2rad(1.0) * normal_basis(v_Rb)[:, 0]
    return A_Rb + step, Rotation.from_rotvec(turn).apply(v_Rb)


# Signs of axes


def test_axes_take_the_side_of_the_nominal_ones_whatever_their_signs_were() -> None:
    seen = legs_seen((0, 1, 2, 3), (0, 1), (2, 3))
    joints, cameras = seen_from(SQUARE, ACROSS, seen)
    nominal = made_up_base(*away(SQUARE, ACROSS))
    found = oriented(nominal, joints)
    for v, T in enumerate(cameras):
        expected = T.rotation.inv().apply(ACROSS)[seen[v]]
        assert np.allclose(found.v_camera[v, seen[v]], expected, atol=1e-12)
    assert np.any(found.v_camera != joints.v_camera)


def test_the_covariance_turns_with_the_sign_of_an_axis() -> None:
    observed = shipped("3-rps", noise=0.3)
    joints = locate_joints_in_cameras(observed.nominal, observed.axes, observed.measurements)
    legs = tuple(
        replace(leg, base_axis=-axis)
        for leg, axis in zip(observed.nominal.legs, observed.nominal.base_axes, strict=True)
    )
    nominal = replace(observed.nominal, legs=legs)
    other = oriented(nominal, joints)
    assert np.allclose(other.v_camera, -joints.v_camera)
    first, second = (
        locate_joints_in_base(n, j) for n, j in ((observed.nominal, joints), (nominal, other))
    )
    assert np.allclose(first.A_Rb, second.A_Rb, atol=1e-9)
    assert np.allclose(first.base_axes, -second.base_axes, atol=1e-8)


# Places of cameras


@pytest.mark.parametrize("seed", [0, 1])
def test_two_joints_and_an_axis_across_their_line_place_a_camera(seed: int) -> None:
    seen = legs_seen((0, 1), (1, 2), (2, 3), (3, 0))
    joints, cameras = seen_from(SQUARE, ACROSS, seen)
    base = locate_joints_in_base(made_up_base(*away(SQUARE, ACROSS, seed)), joints)
    assert np.abs(base.A_Rb - SQUARE).max() < 1e-8
    assert np.abs(base.base_axes - ACROSS).max() < 1e-7
    for T, true in zip(base.T_Rb_camera, cameras, strict=True):
        assert T is not None
        assert (T.inv() * true).rotation.magnitude() < 1e-7


def test_opposite_legs_of_a_symmetric_machine_do_not_mislead() -> None:
    """Half a turn about their line lays both joints and axes, as lines, on themselves."""
    A, v = SQUARE, np.array([[1.0, -1.0, 0.0], [1.0, 1.0, 0.0], [1.0, -1.0, 0.0], [1.0, 1.0, 0.0]])
    v = v / np.sqrt(2.0)
    true_A, true_v = away(A, v, seed=3)
    seen = legs_seen((0, 1, 2, 3), (0, 2), (1, 3))
    poses, fixed = camera_poses(A[[0, 2]], v[[0, 2]], A[[0, 2]], v[[0, 2]])
    assert (len(poses), fixed) == (2, True)
    joints, cameras = seen_from(true_A, true_v, seen, sigma=1e-5)
    base = locate_joints_in_base(made_up_base(A, v), joints)
    assert np.abs(base.A_Rb - true_A).max() < 1e-8
    assert np.abs(base.base_axes - true_v).max() < 1e-7
    for T, true in zip(base.T_Rb_camera, cameras, strict=True):
        assert T is None or (T.inv() * true).rotation.magnitude() < 1e-7
    assert base.T_Rb_camera[1] is not None  # the first view says which half turn is right


def test_where_two_places_of_a_camera_fit_alike_the_view_says_distances_only() -> None:
    A, v = SQUARE, np.array([[1.0, -1.0, 0.0], [1.0, 1.0, 0.0], [1.0, -1.0, 0.0], [1.0, 1.0, 0.0]])
    v = v / np.sqrt(2.0)
    seen = legs_seen((0, 1, 2, 3), (0, 2))
    joints, _ = seen_from(A, v, seen)
    base = locate_joints_in_base(made_up_base(*away(A, v)), joints)
    assert np.abs(base.A_Rb - A).max() < 1e-8
    assert [T is None for T in base.T_Rb_camera] == [False, True]


def test_views_that_leave_two_places_of_a_camera_do_not_crowd_out_the_others() -> None:
    A, v = SQUARE, np.array([[1.0, -1.0, 0.0], [1.0, 1.0, 0.0], [1.0, -1.0, 0.0], [1.0, 1.0, 0.0]])
    v = v / np.sqrt(2.0)
    seen = legs_seen(*[(0, 2)] * 6, (0, 1, 2, 3))
    joints, _ = seen_from(A, v, seen)
    base = locate_joints_in_base(made_up_base(*away(A, v)), joints)
    assert np.abs(base.A_Rb - A).max() < 1e-8
    assert base.T_Rb_camera[-1] is not None


def test_axes_along_the_line_between_two_joints_do_not_place_a_camera() -> None:
    v = np.tile([1.0, 0.0, 0.0], (4, 1))
    seen = legs_seen((0, 1, 2, 3), (0, 1))
    joints, _ = seen_from(SQUARE, v, seen)
    base = locate_joints_in_base(made_up_base(*away(SQUARE, v)), joints)
    assert np.abs(base.A_Rb - SQUARE).max() < 1e-8
    assert [T is None for T in base.T_Rb_camera] == [False, True]


def test_joints_in_one_place_are_no_direction() -> None:
    A = SQUARE.copy()
    A[3] = A[2]
    none = np.full((4, 3), np.nan)
    joints, _ = seen_from(A, none, legs_seen((0, 1, 2, 3), (2, 3)))
    base = locate_joints_in_base(made_up_base(A, none), joints)
    assert np.abs(base.A_Rb - A).max() < 1e-8
    assert [T is None for T in base.T_Rb_camera] == [False, True]


def test_an_axis_that_no_view_locates_is_refused_by_name() -> None:
    joints, _ = seen_from(SQUARE, ACROSS, legs_seen((0, 1, 2, 3), (0, 1, 2)))
    axis_located = joints.axis_located.copy()
    axis_located[:, 2] = False
    with pytest.raises(NotIdentifiable, match=r"those of leg3 can turn.*axes: 3, 2"):
        locate_joints_in_base(
            made_up_base(SQUARE, ACROSS), replace(joints, axis_located=axis_located)
        )


def test_eq09_does_not_leave_axes_at_nominal_that_are_in_none_of_its_products() -> None:
    joints, _ = seen_from(SQUARE, ACROSS, legs_seen((0, 1, 2, 3), (2,)))
    axis_located = joints.axis_located.copy()
    axis_located[0, 2] = False
    with pytest.raises(NotIdentifiable, match="locates the revolute axes of leg3 together"):
        locate_joints_in_base(
            made_up_base(SQUARE, ACROSS),
            replace(joints, axis_located=axis_located),
            criteria="literal",
        )


def test_views_that_share_one_leg_leave_joints_and_axes_loose() -> None:
    joints, _ = seen_from(SQUARE, ACROSS, legs_seen((0, 1, 2), (2,), (3,)))
    with pytest.raises(
        NotIdentifiable, match=r"those of leg4 can move and the revolute axes of leg4 can turn"
    ) as refusal:
        locate_joints_in_base(made_up_base(SQUARE, ACROSS), joints)
    assert "a revolute axis across the line between them" in str(refusal.value)
    assert "calibration board" in str(refusal.value)


def test_the_covariance_of_step_2_agrees_with_monte_carlo() -> None:
    seen = legs_seen((0, 1, 2), (1, 2, 3), (0, 3))
    nominal = made_up_base(SQUARE, ACROSS)
    unknowns = BaseUnknowns.of(nominal)
    normalised = []
    for seed in range(10):
        joints, _ = seen_from(SQUARE, ACROSS, seen, sigma=1e-3, seed=seed)
        solution = locate_joints_in_base(nominal, joints).solution
        error = solution.x[: len(unknowns)] - unknowns.start
        normalised.append(error @ np.linalg.solve(solution.covariance(), error))
    assert np.mean(normalised) == pytest.approx(len(unknowns), rel=0.3)


def test_derivatives_of_both_criteria_are_those_of_differences() -> None:
    nominal = made_up_base(*away(SQUARE, ACROSS))
    seen = legs_seen((0, 1, 2), (1, 2, 3), (0, 3))
    joints, cameras = seen_from(SQUARE, ACROSS, seen, sigma=1e-2)
    joints = oriented(nominal, joints)
    plane = shipped("3-rpr", noise=0.3)
    in_plane = locate_joints_in_cameras(plane.nominal, plane.axes, plane.measurements)
    problems = [
        build_rigid(nominal, joints, [*cameras[:2], None]),
        build_scalar_products(nominal, joints),
        build_rigid(plane.nominal, in_plane, [T.inv() for T in plane.T_camera_Rb]),
    ]
    for problem in problems:
        x = problem.start + 0.01 * np.random.default_rng(0).normal(size=len(problem.start))
        h = 1e-6
        columns = [
            problem.residuals(x + h * e) - problem.residuals(x - h * e) for e in np.eye(len(x))
        ]
        numeric = np.column_stack(columns) / (2.0 * h)
        found = problem.jacobian(x).toarray()
        assert np.allclose(found, numeric, atol=1e-6 * np.abs(found).max())


def test_turns_of_an_axis_are_rotations_about_its_normal_basis_to_second_order() -> None:
    v = ACROSS[0]
    basis = normal_basis(v)
    for size in (1e-3, 1e-2):
        w = size * np.array([0.6, -0.8])
        found = turned_axis(v, w)
        assert np.linalg.norm(found) == pytest.approx(1.0, abs=1e-15)
        assert np.abs(found - Rotation.from_rotvec(w @ basis).apply(v)).max() < size**3


# A plane


def test_two_joints_of_a_plane_take_their_side_from_the_lengths_of_legs() -> None:
    observed = shipped("3-rpr")
    axes, m = observed.axes, observed.measurements
    some = axes.choose(np.flatnonzero((m.view[axes.row] > 0) | (axes.leg < 2)))
    seen = locate_joints_in_cameras(observed.nominal, some, m)
    assert seen.sided.tolist() == [True, False, False]  # the others see three joints
    base = locate_joints_in_base(observed.nominal, seen)
    for T, true in zip(base.T_Rb_camera, observed.T_camera_Rb, strict=True):
        assert T is not None
        assert (T * true).rotation.magnitude() < 1e-7


def plane_with_joints_on_a_line(A: Array, B: Array, nominal_A: Array) -> Observed:
    """Return a 3-RPR whose base joints are nearly collinear, seen from both sides."""
    rng = np.random.default_rng(0)
    rows = np.arange(12)
    R = Rotation.from_rotvec(np.outer(rng.uniform(-0.4, 0.4, 12), [0.0, 0.0, 1.0])).as_matrix()
    t = np.column_stack([rng.uniform(0.2, 0.5, (12, 2)), np.zeros(12)])
    legs = np.einsum("nij,kj->nki", R, B) + t[:, None] - A
    length = np.linalg.norm(legs, axis=2)
    view, leg = rows // 6, np.tile(np.arange(3), 12)
    T = [
        RigidTransform.from_components([-0.4, 0.2, 1.5], Rotation.from_rotvec([2.8, 0.3, 0.1])),
        RigidTransform.from_components([-0.4, -0.3, 1.4], Rotation.from_rotvec([-0.3, 0.1, 0.4])),
    ]
    u, M = legs / length[..., None], np.broadcast_to(A, legs.shape)
    u = np.array([T[v].rotation.apply(d) for v, d in zip(view, u, strict=True)]).reshape(-1, 3)
    M = np.array([T[v].apply(p) for v, p in zip(view, M, strict=True)]).reshape(-1, 3)
    covariance = np.tile(np.diag([1e-6, 1e-6, 1e-8, 1e-8]), (36, 1, 1))
    nominal, true = (
        tuple(Leg("R", "R", LegKind.ACTUATED, a, b, 0.1) for a, b in zip(P, B, strict=True))
        for P in (nominal_A, A)
    )
    return Observed(
        NominalMachine(("leg1", "leg2", "leg3"), nominal, np.ones(3), (0, 1)),
        LegAxes(np.repeat(rows, 3), leg, u, M, normal_basis(u), covariance),
        Measurements(
            (View("c1", PINHOLE), View("c2", PINHOLE)), ("",) * 12, view, rows, length - 0.1, 2e-6
        ),
        true,
        tuple(T),
    )


def test_collinear_joints_of_a_plane_take_their_side_from_the_platform() -> None:
    A = np.array([[0.0, 0.0, 0.0], [0.8, 0.0, 0.0], [0.4, 0.002, 0.0]])
    B = np.array([[0.0, 0.0, 0.0], [0.2, 0.0, 0.0], [0.1, 0.15, 0.0]])
    step = np.array([[0.0, 0.0, 0.0], [3e-3, 0.0, 0.0], [0.0, -3e-3, 0.0]])
    observed = plane_with_joints_on_a_line(A, B, A + step)
    steps = three_steps(observed)
    assert steps.joints.sided.all()
    assert np.abs(steps.base.A_Rb - A).max() < 1e-8
    assert all(T is not None for T in steps.base.T_Rb_camera)


def test_a_plane_without_any_side_is_refused() -> None:
    """Nothing but the heights of both triangles tells left from right."""
    A = np.array([[0.0, 0.0, 0.0], [0.8, 0.0, 0.0], [0.4, 0.0, 0.0]])
    B = np.array([[0.0, 0.0, 0.0], [0.2, 0.0, 0.0], [0.1, 0.0, 0.0]])
    with pytest.raises(NotIdentifiable, match="those of leg3 can move"):
        three_steps(plane_with_joints_on_a_line(A, B, A))


def test_heights_of_a_plane_stay_nominal() -> None:
    observed = shipped("3-rpr")
    heights = np.array([0.0, 0.05, -0.03])
    u, M, m = observed.axes.u, observed.axes.M.copy(), observed.measurements
    for k, T in enumerate(observed.T_camera_Rb):
        here = m.view[observed.axes.row] == k
        up = T.rotation.apply([0.0, 0.0, 1.0])
        M[here] += heights[observed.axes.leg[here], None] * up
    legs = tuple(
        replace(leg, A=leg.A + np.array([0.0, 0.0, z]))
        for leg, z in zip(observed.nominal.legs, heights, strict=True)
    )
    raised = replace(
        observed,
        nominal=replace(observed.nominal, legs=legs),
        axes=replace(observed.axes, M=M, u=u),
    )
    for criteria in ("default", "literal"):
        steps = three_steps(raised, criteria)
        assert np.allclose(steps.base.A_Rb[:, 2], heights, atol=0.0)
        assert np.abs(steps.base.A_Rb[:, :2] - observed.A_Rb[:, :2]).max() < 1e-8
