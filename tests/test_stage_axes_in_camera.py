"""Revolute base joints in a camera frame: eqs (6) and (7), and the directions of their legs."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from staged_machines import shipped

from legcal.geometry.lines import normal_basis
from legcal.geometry.types import Array
from legcal.paper import joints_in_camera
from legcal.paper.joints_in_base import locate_joints_in_base
from legcal.paper.joints_in_camera import (
    derivative_of_miss,
    locate_joints_in_cameras,
    miss_of_joint,
    turned,
)
from legcal.paper.leg_directions import directions_through_joints, find_misses


@pytest.mark.parametrize("name", ["3-rps", "3-rpr"])
def test_eq07_axes_are_normal_to_all_directions_of_their_leg(name: str) -> None:
    observed = shipped(name)
    for criteria in ("default", "literal"):
        joints = locate_joints_in_cameras(
            observed.nominal, observed.axes, observed.measurements, criteria=criteria
        )
        assert joints.axis_located.all()
        view = observed.measurements.view[observed.axes.row]
        v = joints.v_camera[view, observed.axes.leg]
        assert np.abs(np.sum(v * observed.axes.u, axis=1)).max() < 1e-9
        for k, T in enumerate(observed.T_camera_Rb):
            assert np.abs(joints.v_camera[k] - T.rotation.apply(observed.v_Rb)).max() < 1e-7


def test_all_legs_of_a_planar_mechanism_have_one_normal_in_a_view() -> None:
    observed = shipped("3-rpr", noise=0.3)
    joints = locate_joints_in_cameras(observed.nominal, observed.axes, observed.measurements)
    assert np.array_equal(joints.v_camera, joints.v_camera[:, :1] + np.zeros((1, 3, 1)))
    spread = joints.covariance[:, :, 3:, 3:]
    assert np.allclose(spread, spread[:, :1])


@pytest.mark.parametrize("name", ["3-rps", "3-rpr"])
def test_weights_make_joints_far_better_axes_no_worse_and_their_covariance_true(name: str) -> None:
    squares: dict[str, list[Array]] = {"default": [], "literal": []}
    normalised = []
    for seed in range(3):
        observed = shipped(name, n_poses=10, noise=0.2, seed=seed)
        nominal, axes, m = observed.nominal, observed.axes, observed.measurements
        weighted = locate_joints_in_cameras(nominal, axes, m)
        plain = locate_joints_in_cameras(nominal, axes, m, criteria="literal")
        for k, T in enumerate(observed.T_camera_Rb):
            A, v = T.apply(observed.A_Rb), T.rotation.apply(observed.v_Rb)
            for key, joints in (("default", weighted), ("literal", plain)):
                miss, turn = joints.A_camera[k] - A, np.cross(v, joints.v_camera[k])
                squares[key].append(np.array([np.sum(miss**2), np.sum(turn**2)]))
            for j in range(3):
                turns = normal_basis(weighted.v_camera[k, j]) @ np.cross(
                    v[j], weighted.v_camera[k, j]
                )
                error = np.concatenate([weighted.A_camera[k, j] - A[j], turns])
                normalised.append(error @ np.linalg.solve(weighted.covariance[k, j], error))
    gain = np.sum(squares["default"], axis=0) / np.sum(squares["literal"], axis=0)
    assert gain[0] < 0.05
    assert gain[1] < 1.0
    assert 3.0 < np.mean(normalised) < 6.5  # 5 by rights; outlier weights cost a little


def test_a_revolute_leg_of_one_direction_has_no_axis_in_that_view() -> None:
    observed = shipped("3-rps")
    axes, m = observed.axes, observed.measurements
    here = np.flatnonzero((m.view[axes.row] == 1) & (axes.leg == 0))
    u, M, basis = axes.u.copy(), axes.M.copy(), axes.basis.copy()
    u[here], M[here], basis[here] = u[here[0]], M[here[0]], basis[here[0]]
    stopped = replace(axes, u=u, M=M, basis=basis)
    joints = locate_joints_in_cameras(observed.nominal, stopped, m)
    assert joints.axis_located[:, 0].tolist() == [True, False, True]
    assert "leg1 in view c2 was left out: its direction is the same in all" in joints.diagnostics[0]
    base = locate_joints_in_base(observed.nominal, joints)
    assert np.abs(np.cross(base.base_axes, observed.v_Rb)).max() < 1e-7


def test_an_axis_that_nearly_equal_directions_leave_open_is_left_out_with_its_uncertainty() -> None:
    observed = shipped("3-rps")
    axes, m = observed.axes, observed.measurements
    coarse = replace(axes, covariance=30.0**2 * axes.covariance)
    joints = locate_joints_in_cameras(observed.nominal, coarse, m)
    assert not joints.axis_located.all()
    assert any("revolute axis of leg leg" in d and "deg)" in d for d in joints.diagnostics)


def test_weights_are_computed_again_until_joints_and_axes_stay(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    observed = shipped("3-rps", n_poses=10, noise=3.0, seed=1)
    inputs = observed.nominal, observed.axes, observed.measurements
    found = locate_joints_in_cameras(*inputs)
    monkeypatch.setattr(joints_in_camera, "MOST_REWEIGHTINGS", 1000)
    monkeypatch.setattr(joints_in_camera, "_CONVERGED", 1e-9)
    longer = locate_joints_in_cameras(*inputs)
    assert np.array_equal(found.axis_located, longer.axis_located)
    sigma = np.sqrt(np.einsum("vlii->vli", found.covariance))[found.axis_located]
    turn = np.cross(found.v_camera, longer.v_camera)[found.axis_located]
    move = (found.A_camera - longer.A_camera)[found.axis_located]
    assert np.linalg.norm(turn, axis=1).max() < 1e-4 * sigma[:, 3:].min()
    assert np.all(np.abs(move) < 1e-4 * sigma[:, :3])


@pytest.mark.parametrize(("name", "noise"), [("3-rpr", 10.0), ("3-rpr", 30.0), ("3-rps", 30.0)])
def test_legs_that_say_nothing_of_their_joint_do_not_stop_the_others(
    name: str, noise: float
) -> None:
    observed = shipped(name, n_poses=10, noise=noise, seed=3)
    joints = locate_joints_in_cameras(observed.nominal, observed.axes, observed.measurements)
    assert not joints.located.all()
    assert joints.located.any(axis=0).all()
    assert np.all(np.isfinite(joints.A_camera))
    assert np.all(np.isfinite(joints.covariance))


def test_the_derivative_of_the_miss_is_that_of_differences() -> None:
    observed = shipped("3-rps")
    axes = observed.axes
    here, h = np.arange(len(axes)), 1e-6
    rng = np.random.default_rng(0)
    A = axes.M + 0.1 * rng.normal(size=axes.M.shape)
    v = np.cross(axes.u, rng.normal(size=axes.u.shape))
    v /= np.linalg.norm(v, axis=1, keepdims=True)
    found = derivative_of_miss(axes, here, v, np.zeros((len(axes), 2)))
    for k in range(5):
        step = np.zeros((len(axes), 5))
        step[:, k] = h
        ahead, behind = (
            miss_of_joint(axes, here, A + s * step[:, :3], turned(v, s * step[:, 3:]))[0]
            for s in (1.0, -1.0)
        )
        assert np.allclose((ahead - behind) / (2.0 * h), found[:, :, k], atol=1e-8)


# Directions


@pytest.mark.parametrize("name", ["3-rps", "3-rpr"])
def test_being_normal_to_an_axis_improves_the_direction_of_a_leg(name: str) -> None:
    observed = shipped(name, n_poses=10, noise=0.3)
    nominal, axes, m = observed.nominal, observed.axes, observed.measurements
    joints = locate_joints_in_cameras(nominal, axes, m)
    base = locate_joints_in_base(nominal, joints)
    known = directions_through_joints(nominal, axes, m, joints, base)
    assert np.all(np.linalg.eigvalsh(known.covariance)[:, 0] > 0.0)
    without = replace(joints, axis_located=np.zeros_like(joints.axis_located))
    legs = tuple(replace(leg, base_joint="S", base_axis=None) for leg in nominal.legs)
    point_like = replace(nominal, legs=legs)
    free = directions_through_joints(point_like, axes, m, without, base)
    off = [np.sum(d.u * observed.v_Rb[d.leg], axis=1) for d in (known, free)]
    assert np.std(off[0]) < 0.7 * np.std(off[1])


def test_an_axis_off_the_plane_of_its_leg_is_found() -> None:
    observed = shipped("3-rps", n_poses=10, noise=0.1)
    nominal, axes, m = observed.nominal, observed.axes, observed.measurements
    joints = locate_joints_in_cameras(nominal, axes, m)
    base = locate_joints_in_base(nominal, joints)
    assert not find_misses(axes, m, joints, base).any()
    A, v = (part[m.view[axes.row[7]], axes.leg[7]] for part in (joints.A_camera, joints.v_camera))
    turn = Rotation.from_rotvec(0.1 * np.cross(axes.u[7], v))
    u, M, basis = axes.u.copy(), axes.M.copy(), axes.basis.copy()
    u[7], M[7], basis[7] = turn.apply(u[7]), A + turn.apply(M[7] - A), turn.apply(basis[7])
    wrong = find_misses(replace(axes, u=u, M=M, basis=basis), m, joints, base)
    assert np.flatnonzero(wrong).tolist() == [7]
