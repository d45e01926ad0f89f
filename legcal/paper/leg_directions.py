"""The legs as steps 3 and 4 see them: directions u of (13) that start at located base joints A.

Legs of one platform pose that were seen in one frame form a *group*. All cameras that were
located in step 2 share the frame R_b, so that several cameras or several images of one pose
make one group; the other cameras keep their own frames, since distances do not depend on it.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from legcal.data.axes import LegAxes, join_axes
from legcal.data.measurements import Measurements
from legcal.geometry.lines import cross, normal_basis
from legcal.geometry.types import Array, BoolArray, IntArray
from legcal.paper.joints_in_base import JointsInBase
from legcal.paper.joints_in_camera import JointsInCamera, joint_residuals, residual_jacobian
from legcal.paper.nominal import NominalMachine

_OUTLIER = 8.0  # standard deviations or medians
_VARIANCE_NO_AXIS = 1e6  # [rad^2] of the angle to an axis that a leg does not have
_ROUNDING = 1e-14  # of a variance, in the difference that is left of it
_MIN_VARIANCE = 1e-12  # [rad^2] of an axis


@dataclass(frozen=True, eq=False)
class LegDirections:
    """Directions of legs from their base joints, by group and then by leg."""

    group: IntArray  # (n,): legs of one group belong to one platform pose, in one frame
    view: IntArray  # (n,) of the first image of each
    leg: IntArray  # (n,)
    A: Array  # (n, 3): base joint centres in the frame of the group [m], at the readings
    u: Array  # (n, 3): unit directions from base to platform
    basis: Array  # (n, 2, 3): e1, e2 normal to u
    covariance: Array  # (n, 2, 2) of u along e1 and e2 [rad^2]
    reading: Array  # (n,) sign * q [m], length less offset; zero if constant, NaN if passive
    q: Array  # (n,) readings as they are [m, or rad of an arm]
    turn: Array  # (n, 3, 3): how what is fixed in the carriage or arm has turned in R_b

    def __len__(self) -> int:
        return len(self.leg)

    def groups(self) -> list[IntArray]:
        """Return the indices of the legs of each group."""
        order = np.argsort(self.group, kind="stable")
        return np.split(order, np.flatnonzero(np.diff(self.group[order])) + 1)


def observed_directions(
    axes: LegAxes, measurements: Measurements, machine: NominalMachine, joints: JointsInCamera
) -> LegDirections:
    """Return u as the images give it, from A of step 1 in each camera frame: the u of (13).

    Images of one pose in one view are averaged.
    """
    located = joints.located[measurements.view[axes.row], axes.leg]
    axes = axes.choose(np.flatnonzero(located))
    view, pose = measurements.view[axes.row], measurements.pose[axes.row]
    key = np.stack([view, pose, axes.leg], axis=1)
    distinct, first, which = np.unique(key, axis=0, return_index=True, return_inverse=True)
    total = np.zeros((len(distinct), 3))
    np.add.at(total, which.ravel(), axes.u)
    u = total / np.linalg.norm(total, axis=1, keepdims=True)
    v, k, j = distinct.T
    q = measurements.q[axes.row[first], j]
    return LegDirections(
        group=v * measurements.n_poses + k,
        view=v,
        leg=j,
        A=joints.A_at(v, j, q),
        u=u,
        basis=normal_basis(u),
        covariance=axes.covariance[first, :2, :2],
        reading=_readings(machine, q, j),
        q=q,
        turn=machine.turns_at(j, q),
    )


def directions_through_joints(
    axes: LegAxes, measurements: Measurements, base: JointsInBase
) -> LegDirections:
    """Return u of the legs given that each axis belongs to its base joint.

    One image determines the tilt of a leg towards the camera poorly, and (13) multiplies that
    error by the leg's length. But A is known from many images, and the middle of the leg from
    this one: an axis through both has a much better direction. This is what conditioning the
    covariance of the axis on "it passes through A" does, and on "it is normal to v" for a leg
    with a revolute joint.
    """
    machine, joints = base.machine, base.in_cameras
    view = measurements.view[axes.row]
    in_base = np.array([T is not None for T in base.T_Rb_camera])
    usable = in_base[view] | joints.located[view, axes.leg]
    axes, view = axes.choose(np.flatnonzero(usable)), view[usable]
    u, M, basis = axes.u.copy(), axes.M.copy(), axes.basis.copy()
    for v, T in enumerate(base.T_Rb_camera):
        if T is not None:
            here = view == v
            u[here], M[here] = T.rotation.apply(axes.u[here]), T.apply(axes.M[here])
            basis[here] = T.rotation.apply(axes.basis[here].reshape(-1, 3)).reshape(-1, 2, 3)
    frame = np.where(in_base[view], 0, 1 + view)
    group = frame * measurements.n_poses + measurements.pose[axes.row]
    axes = join_axes(replace(axes, u=u, M=M, basis=basis), group)
    view, pose = measurements.view[axes.row], measurements.pose[axes.row]
    frame = np.where(in_base[view], 0, 1 + view)
    q = measurements.q[axes.row, axes.leg]
    A = np.where(in_base[view][:, None], machine.A_at(axes.leg, q), joints.A_at(view, axes.leg, q))
    normals = _known_normals(base, view, axes.leg, q)
    u, basis, covariance = _conditioned(axes, A, *normals)
    return LegDirections(
        group=frame * measurements.n_poses + pose,
        view=view,
        leg=axes.leg,
        A=A,
        u=u,
        basis=basis,
        covariance=covariance,
        reading=_readings(machine, q, axes.leg),
        q=q,
        turn=machine.turns_at(axes.leg, q),
    )


def find_outliers(axes: LegAxes, measurements: Measurements, base: JointsInBase) -> BoolArray:
    """Return which axes (n,) miss A, or the plane normal to v, by far: wrong outlines, as a rule.

    The threshold is a multiple of the predicted standard deviations, or of the median where these
    are too small.
    """
    joints = base.in_cameras
    view = measurements.view[axes.row]
    q = measurements.q[axes.row, axes.leg]
    A, A_Rb = joints.A_at(view, axes.leg, q), base.machine.A_at(axes.leg, q)
    known = joints.located[view, axes.leg]
    for i, T in enumerate(base.T_Rb_camera):
        if T is not None:
            A[view == i] = T.inv().apply(A_Rb[view == i])
            known |= view == i
    here, v = np.arange(len(axes)), joints.v_at(view, axes.leg, q)
    residual, spread, _ = joint_residuals(axes, here, A, v)
    with_axis = joints.axis_located[view, axes.leg]
    slope = np.zeros((len(axes), 3, 5))
    slope[:, :2, :3] = axes.basis
    at_observed = np.zeros((int(with_axis.sum()), 2))
    slope[with_axis] = residual_jacobian(axes, here[with_axis], v[with_axis], at_observed)
    C = joints.covariance[view, axes.leg].copy()
    for of_carrier, carrier in joints.carried(view, axes.leg):
        by_unknowns = carrier.at(q[of_carrier])[1]
        C[of_carrier, :3, :3] = by_unknowns @ carrier.covariance @ np.swapaxes(by_unknowns, 1, 2)
        C[of_carrier, :3, 3:] = C[of_carrier, 3:, :3] = 0.0
    spread = spread + slope @ C @ np.swapaxes(slope, 1, 2)
    spread[~with_axis, 2, 2] = 1.0  # of nothing: the residual is zero
    chi = np.sqrt(np.einsum("ni,nij,nj->n", residual, np.linalg.inv(spread), residual))
    return np.asarray(known & (chi > _OUTLIER * max(1.0, float(np.median(chi[known])))))


def _conditioned(
    axes: LegAxes, A: Array, v: Array, covariance: Array
) -> tuple[Array, Array, Array]:
    """Return u (n, 3), basis (n, 2, 3) and covariance (n, 2, 2) of axes through A, normal to v.

    v (n, 3) is zero where there is none; its covariance is (n, 3, 3) [rad^2].
    """
    residual, spread, mixed = joint_residuals(axes, np.arange(len(axes)), A, v)
    of_v = np.einsum("ni,nij,nj->n", axes.u, covariance, axes.u) + _MIN_VARIANCE
    spread[:, 2, 2] += np.where(np.any(v != 0.0, axis=1), of_v, _VARIANCE_NO_AXIS)
    gain = mixed @ np.linalg.inv(spread)
    alpha = (gain @ residual[..., None])[..., 0]
    left = axes.covariance[:, :2, :2] - gain @ np.swapaxes(mixed, 1, 2)
    u = axes.u + np.einsum("nia,ni->na", axes.basis, alpha)
    u /= np.linalg.norm(u, axis=-1, keepdims=True)
    e1 = axes.basis[:, 0] - u * np.sum(u * axes.basis[:, 0], axis=-1, keepdims=True)
    e1 /= np.linalg.norm(e1, axis=-1, keepdims=True)
    before = np.trace(axes.covariance[:, :2, :2], axis1=1, axis2=2)
    covariance = _positive(0.5 * (left + np.swapaxes(left, 1, 2)), _ROUNDING * before)
    return u, np.stack([e1, cross(u, e1)], axis=1), covariance


def _positive(covariance: Array, least: Array) -> Array:
    """Return covariances (n, 2, 2) with no variance below *least* (n,), which is rounding."""
    variances, directions = np.linalg.eigh(covariance)
    lost = variances[:, 0] < least
    variances = np.maximum(variances[lost], least[lost, None])
    covariance[lost] = directions[lost] * variances[:, None] @ np.swapaxes(directions[lost], 1, 2)
    return covariance


def _known_normals(
    base: JointsInBase, view: IntArray, leg: IntArray, q: Array
) -> tuple[Array, Array]:
    """Return what legs are normal to (n, 3), zero if nothing, and its covariance (n, 3, 3) [rad^2].

    In R_b, where the view is placed there, this is the axis of step 2; in a planar machine z,
    which is as uncertain as the camera of the view is about it. Otherwise it is that of step 1.
    """
    machine, joints = base.machine, base.in_cameras
    v, C = joints.v_at(view, leg, q), np.zeros((len(leg), 3, 3))
    seen = joints.axis_located[view, leg]
    N = normal_basis(v[seen])
    C[seen] = np.swapaxes(N, 1, 2) @ joints.covariance[view, leg, 3:, 3:][seen] @ N
    in_base, of_base = machine.base_normals, base.axis_covariance
    for i, T in enumerate(base.T_Rb_camera):
        here = np.flatnonzero(view == i)
        if T is None or not len(here):
            continue
        with_axis = np.isfinite(in_base[leg[here], 0])
        if machine.spatial:
            C[here] = np.where(with_axis[:, None, None], of_base[leg[here]], 0.0)
        else:
            of_normal = np.zeros((3, 3))
            legs = np.flatnonzero(joints.axis_located[i])
            if len(legs):
                N = normal_basis(joints.v_camera[i, legs[0]]) @ T.rotation.as_matrix().T
                of_normal = N.T @ joints.covariance[i, legs[0], 3:, 3:] @ N
            with_axis &= len(legs) > 0
            C[here] = of_normal
        turned = np.einsum("kij,kj->ki", machine.turns_at(leg[here], q[here]), in_base[leg[here]])
        v[here] = np.where(with_axis[:, None], turned, 0.0)
    return v, C


def _readings(machine: NominalMachine, q: Array, leg: IntArray) -> Array:
    """Return sign * q of legs in images [m]; a leg of constant length reads zero, as in (14)."""
    return np.asarray(machine.sign[leg] * np.where(machine.constant[leg], 0.0, q))
