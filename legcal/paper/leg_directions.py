"""The legs as steps 3 and 4 see them: directions u that start at located base joints A.

Legs of one platform pose that were seen in one frame form a *group*. All cameras that were
located in step 2 share the frame R_b, so that several cameras or several images of one pose
make one group; the other cameras keep their own frames, since distances do not depend on it.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from legcal.data import LegAxes, Measurements, join_axes
from legcal.geometry import Array, BoolArray, IntArray, normal_basis
from legcal.paper.joints_in_base import JointsInBase, condition_on_joint, known_normals
from legcal.paper.joints_in_camera import JointsInCamera, derivative_of_miss, miss_of_joint
from legcal.paper.nominal import NominalMechanism

_FAR = 8.0  # an axis that misses its joint by so many deviations or medians is a wrong one


@dataclass(frozen=True, eq=False)
class LegDirections:
    """Directions of legs from their base joints, by group and then by leg.

    Attributes
    ----------
    group : (n,) array of int
        Legs of one group belong to one platform pose, in one frame.
    view : (n,) array of int
        View of the first image of each.
    leg : (n,) array of int
        Index of the leg.
    A : (n, 3) array
        Base joint centres in the frame of the group [m].
    u : (n, 3) array
        Unit directions from base to platform.
    basis : (n, 2, 3) array
        e1, e2 normal to u.
    covariance : (n, 2, 2) array
        Covariance of u along e1 and e2 [rad^2].
    reading : (n,) array
        sign * q [m]: the leg length less its offset; zero for legs of constant length, NaN for
        passive ones.
    """

    group: IntArray
    view: IntArray
    leg: IntArray
    A: Array
    u: Array
    basis: Array
    covariance: Array
    reading: Array

    def __len__(self) -> int:
        return len(self.leg)

    def groups(self) -> list[IntArray]:
        """Return the indices of the legs of each group."""
        order = np.argsort(self.group, kind="stable")
        return np.split(order, np.flatnonzero(np.diff(self.group[order])) + 1)


def find_misses(
    axes: LegAxes, measurements: Measurements, joints: JointsInCamera, base: JointsInBase
) -> BoolArray:
    """Return which axes miss their base joint by far, (n,): wrong outlines, as a rule.

    An axis misses A, or the plane normal to v of a revolute joint.

    The limit is a multiple of what the covariances promise, or of the median where they promise
    too much.
    """
    view = measurements.view[axes.row]
    A = joints.A_camera[view, axes.leg]
    known = joints.located[view, axes.leg]
    for i, T in enumerate(base.T_Rb_camera):
        if T is not None:
            A[view == i] = T.inv().apply(base.A_Rb[axes.leg[view == i]])
            known |= view == i
    here, v = np.arange(len(axes)), joints.v_camera[view, axes.leg]
    residual, spread, _ = miss_of_joint(axes, here, A, v)
    with_axis = joints.axis_located[view, axes.leg]
    slope = np.zeros((len(axes), 3, 5))
    slope[:, :2, :3] = axes.basis
    slope[with_axis] = derivative_of_miss(
        axes, here[with_axis], v[with_axis], np.zeros((int(with_axis.sum()), 2))
    )
    spread = spread + slope @ joints.covariance[view, axes.leg] @ np.swapaxes(slope, 1, 2)
    spread[~with_axis, 2, 2] = 1.0  # of nothing: the residual is zero
    chi = np.sqrt(np.einsum("ni,nij,nj->n", residual, np.linalg.inv(spread), residual))
    return np.asarray(known & (chi > _FAR * max(1.0, float(np.median(chi[known])))))


def observed_directions(
    mechanism: NominalMechanism,
    axes: LegAxes,
    measurements: Measurements,
    joints: JointsInCamera,
) -> LegDirections:
    """Return u as the images give it, from A of step 1 in each camera frame: the u of (13).

    Images of one pose in one view are averaged.
    """
    here = joints.located[measurements.view[axes.row], axes.leg]
    axes = select_axes(axes, here)
    view, pose = measurements.view[axes.row], measurements.pose[axes.row]
    key = np.stack([view, pose, axes.leg], axis=1)
    distinct, which = np.unique(key, axis=0, return_inverse=True)
    which = which.ravel()
    total = np.zeros((len(distinct), 3))
    np.add.at(total, which, axes.u)
    u = total / np.linalg.norm(total, axis=1, keepdims=True)
    first = np.array([np.flatnonzero(which == k)[0] for k in range(len(distinct))], dtype=np.intp)
    v, k, j = distinct.T
    return LegDirections(
        group=v * measurements.n_poses + k,
        view=v,
        leg=j,
        A=joints.A_camera[v, j],
        u=u,
        basis=normal_basis(u),
        covariance=axes.covariance[first, :2, :2],
        reading=_readings(mechanism, measurements, axes.row[first], j),
    )


def directions_through_joints(
    mechanism: NominalMechanism,
    axes: LegAxes,
    measurements: Measurements,
    joints: JointsInCamera,
    base: JointsInBase,
) -> LegDirections:
    """Return u of the legs given that each axis belongs to its base joint.

    Parameters
    ----------
    mechanism : NominalMechanism
        Its signs.
    axes : LegAxes
        Leg axes in the camera frames.
    measurements : Measurements
        Views, poses and readings of the images.
    joints : JointsInCamera
        The result of step 1, for views that step 2 did not locate.
    base : JointsInBase
        The result of step 2.

    Returns
    -------
    LegDirections

    Notes
    -----
    One image says little about the tilt of a leg towards the camera, and (13) multiplies
    that error by the leg's length. But A is known from many images, and the middle of the
    leg from this one: an axis through both has a much better direction. This is what
    conditioning the covariance of the axis on "it passes through A" does, and on "it is normal
    to v" for a leg with a revolute joint.
    """
    view = measurements.view[axes.row]
    known = np.array([T is not None for T in base.T_Rb_camera])
    usable = known[view] | joints.located[view, axes.leg]
    axes, view = select_axes(axes, usable), view[usable]
    u, M, basis = axes.u.copy(), axes.M.copy(), axes.basis.copy()
    for v, T in enumerate(base.T_Rb_camera):
        if T is not None:
            here = view == v
            u[here], M[here] = T.rotation.apply(axes.u[here]), T.apply(axes.M[here])
            basis[here] = T.rotation.apply(axes.basis[here].reshape(-1, 3)).reshape(-1, 2, 3)
    pose = measurements.pose[axes.row]
    frame = np.where(known[view], 0, 1 + view)
    in_groups = replace(axes, u=u, M=M, basis=basis)
    axes = join_axes(in_groups, frame * measurements.n_poses + pose)
    view, pose = measurements.view[axes.row], measurements.pose[axes.row]
    frame = np.where(known[view], 0, 1 + view)
    A = np.where(known[view][:, None], base.A_Rb[axes.leg], joints.A_camera[view, axes.leg])
    normals = known_normals(mechanism, joints, base, view, axes.leg)
    u, basis, covariance = condition_on_joint(axes, A, *normals)
    return LegDirections(
        group=frame * measurements.n_poses + pose,
        view=view,
        leg=axes.leg,
        A=A,
        u=u,
        basis=basis,
        covariance=covariance,
        reading=_readings(mechanism, measurements, axes.row, axes.leg),
    )


def _readings(
    mechanism: NominalMechanism, measurements: Measurements, row: IntArray, leg: IntArray
) -> Array:
    """Return sign * q of legs in images [m]; a leg of constant length reads zero, as in (14)."""
    q = np.where(mechanism.constant[leg], 0.0, measurements.q[row, leg])
    return np.asarray(mechanism.sign[leg] * q)


def select_axes(axes: LegAxes, keep: BoolArray) -> LegAxes:
    """Return some of the axes."""
    return LegAxes(
        axes.row[keep],
        axes.leg[keep],
        axes.u[keep],
        axes.M[keep],
        axes.basis[keep],
        axes.covariance[keep],
    )
