"""How exactly base joints are known, and what that does to the equations of step 4.

Step 4 takes A as step 2 found it. An error of A changes the length between A and B and the
direction of the leg, and with them what the joints demand of it, by far more than a reading is
wrong. The equations are weighted by that.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from legcal.geometry.types import Array, IntArray
from legcal.mechanism.equations import linearize
from legcal.mechanism.leg_geometry import Demand, LegGeometry
from legcal.stages.joints_in_base import JointsInBase
from legcal.stages.joints_in_camera import JointsInCamera
from legcal.stages.leg_directions import LegDirections
from legcal.stages.platform_pose import PlatformPoses


def base_spread(directions: LegDirections, joints: JointsInCamera, base: JointsInBase) -> Array:
    """Return the covariance of A of each leg in the frame of its group, (n, 3, 3) [m^2].

    Cameras that step 2 placed know A together; what their places are wrong by is not counted.
    """
    n_legs = joints.located.shape[1]
    together = np.zeros((n_legs, 3, 3))
    alone = joints.covariance[directions.view, directions.leg, :3, :3]
    for v, T in enumerate(base.T_Rb_camera):
        if T is not None:
            R, seen = T.rotation.as_matrix(), joints.located[v]
            together[seen] += R @ np.linalg.inv(joints.covariance[v, seen, :3, :3]) @ R.T
    placed = np.array([T is not None for T in base.T_Rb_camera])
    known = np.einsum("nii->n", together) > 0.0
    together[known] = np.linalg.inv(together[known])
    return np.where(placed[directions.view, None, None], together[directions.leg], alone)


def spread_of_demands(
    legs: tuple[LegGeometry, ...],
    directions: LegDirections,
    poses: PlatformPoses,
    spread: Array,
    rows: IntArray,
    demand: Demand,
) -> Array:
    """Return the variance of a demand of legs by that of A, (k,).

    Parameters
    ----------
    legs : tuple of LegGeometry
        The legs.
    directions : LegDirections
        Where A is.
    poses : PlatformPoses
        Where the platform is, about.
    spread : (n, 3, 3) array
        Covariance of A [m^2].
    rows : (k,) array of int
        Which of the directions, all of legs that have this demand.
    demand : Demand
        Which equation: a length counts in m^2, the others have no unit.
    """
    found = np.zeros(len(rows))
    key = np.column_stack([directions.leg[rows], directions.A[rows]])
    _, first, which = np.unique(key, axis=0, return_index=True, return_inverse=True)
    for k, i in enumerate(first):
        here = np.flatnonzero(which.ravel() == k)
        leg = replace(legs[directions.leg[rows[i]]], A=directions.A[rows[i]])
        pose = poses.pose[rows[here]]
        linear = linearize(leg, poses.R[pose], poses.t[pose])
        by_A = linear.by_local[:, linear.demands.index(demand), :3]
        found[here] = np.einsum("ni,nij,nj->n", by_A, spread[rows[here]], by_A)
    return found
