"""Axes that are known to belong to a joint: through its centre A, and normal to its axis v."""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import RigidTransform

from legcal.geometry.lines import normal_basis
from legcal.geometry.types import Array, IntArray
from legcal.observations.leg_axes import LegAxes
from legcal.stages.base_unknowns import BaseUnknowns, nominal_axes
from legcal.stages.joints_in_base import JointsInBase
from legcal.stages.joints_in_camera import JointsInCamera
from legcal.stages.meeting_points import miss_of_joint
from legcal.stages.nominal import NominalMechanism

_NO_AXIS = 1e6  # [rad^2] of the angle to an axis that a leg does not have
_EXACT = 1e-12  # [rad^2]: no axis is known better


def condition_on_joint(
    axes: LegAxes, A: Array, v: Array, covariance: Array
) -> tuple[Array, Array, Array]:
    """Return axes that are known to pass through points and to be normal to directions.

    Parameters
    ----------
    axes : LegAxes
        Axes.
    A : (n, 3) array
        A point of each in the same frame [m].
    v : (n, 3) array
        A unit normal of each; zero where there is none.
    covariance : (n, 3, 3) array
        Covariance of the normals [rad^2].

    Returns
    -------
    u : (n, 3) array
        Unit directions.
    basis : (n, 2, 3) array
        e1 and e2 normal to u.
    covariance : (n, 2, 2) array
        Covariance of u along e1 and e2 [rad^2].
    """
    here = np.arange(len(axes))
    residual, spread, cross = miss_of_joint(axes, here, A, v)
    doubt = np.einsum("ni,nij,nj->n", axes.u, covariance, axes.u) + _EXACT
    spread[:, 2, 2] += np.where(np.any(v != 0.0, axis=1), doubt, _NO_AXIS)
    gain = cross @ np.linalg.inv(spread)
    alpha = (gain @ residual[..., None])[..., 0]
    left = axes.covariance[:, :2, :2] - gain @ np.swapaxes(cross, 1, 2)
    u = axes.u + np.einsum("nia,ni->na", axes.basis, alpha)
    u /= np.linalg.norm(u, axis=-1, keepdims=True)
    e1 = axes.basis[:, 0] - u * np.sum(u * axes.basis[:, 0], axis=-1, keepdims=True)
    e1 /= np.linalg.norm(e1, axis=-1, keepdims=True)
    symmetric = 0.5 * (left + np.swapaxes(left, 1, 2))
    return u, np.stack([e1, np.cross(u, e1)], axis=1), symmetric


def known_normals(
    mechanism: NominalMechanism,
    joints: JointsInCamera,
    base: JointsInBase,
    view: IntArray,
    leg: IntArray,
) -> tuple[Array, Array]:
    """Return what legs are normal to, in R_b where the view is placed there, else in its frame.

    Parameters
    ----------
    mechanism : NominalMechanism
        Its joints.
    joints, base : JointsInCamera, JointsInBase
        The results of steps 1 and 2.
    view, leg : (n,) array of int
        The view and the leg of each.

    Returns
    -------
    (n, 3) array, (n, 3, 3) array
        Unit vectors, zero where there is none, and their covariances [rad^2].

    Notes
    -----
    In R_b the normal is the axis of step 2; in a planar mechanism it is z, which is as uncertain as
    the camera of the view is about it.
    """
    v, C = joints.v_camera[view, leg].copy(), np.zeros((len(leg), 3, 3))
    seen = joints.axis_located[view, leg]
    N = normal_basis(v[seen])
    C[seen] = np.swapaxes(N, 1, 2) @ joints.covariance[view, leg, 3:, 3:][seen] @ N
    in_base, of_base = nominal_axes(mechanism), np.zeros((mechanism.n_legs, 3, 3))
    if mechanism.revolute.any():
        unknowns = BaseUnknowns.of(mechanism)
        in_base, of_base = base.base_axes, unknowns.axis_covariance(base.solution)
    for i, T in enumerate(base.T_Rb_camera):
        here = np.flatnonzero(view == i)
        if T is None or not len(here):
            continue
        with_axis = np.isfinite(in_base[leg[here], 0])
        if mechanism.spatial:
            C[here] = np.where(with_axis[:, None, None], of_base[leg[here]], 0.0)
        else:
            with_axis &= joints.axis_located[i].any()
            C[here] = _turned(T, _common(joints, i))
        v[here] = np.where(with_axis[:, None], in_base[leg[here]], 0.0)
    return v, C


def _common(joints: JointsInCamera, view: int) -> Array:
    """Return the covariance (3, 3) of the common normal of a view, in the camera."""
    legs = np.flatnonzero(joints.axis_located[view])
    if not len(legs):
        return np.zeros((3, 3))
    N = normal_basis(joints.v_camera[view, legs[0]])
    return np.asarray(N.T @ joints.covariance[view, legs[0], 3:, 3:] @ N)


def _turned(T: RigidTransform, covariance: Array) -> Array:
    """Return a covariance of directions in another frame."""
    R = T.rotation.as_matrix()
    return np.asarray(R @ covariance @ R.T)
