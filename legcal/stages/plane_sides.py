"""From which side a camera sees the plane of a planar mechanism, where joints do not say it.

Two joints, or joints on one line, look the same from both sides. But the legs then end in mirrored
places: laid on these, the nominal platform puts the ends of all legs where their lengths contradict
the readings, if it is the wrong side.
"""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import RigidTransform

from legcal.geometry.types import Array, IntArray
from legcal.observations.leg_axes import LegAxes
from legcal.observations.measurements import Measurements
from legcal.stages.camera_starts import camera_starts
from legcal.stages.nominal import NominalMechanism

_DECIDED = 0.25  # squared errors of lengths, in those from the other side


def side_of_plane(
    mechanism: NominalMechanism,
    axes: LegAxes,
    measurements: Measurements,
    A_camera: Array,
    normal: Array,
    legs: IntArray,
) -> float:
    """Return the sign with which a normal points up in R_b, zero where nothing says it.

    Parameters
    ----------
    mechanism : NominalMechanism
        Its legs, of a planar mechanism.
    axes : LegAxes
        The axes of one view.
    measurements : Measurements
        Readings of the images.
    A_camera : (n, 3) array
        The located joints of the view in the camera frame [m].
    normal : (3,) array
        The normal of the plane there, of any sign.
    legs : (n,) array of int
        The legs of the joints.
    """
    A_Rb, up = mechanism.parameters.base_joints[legs], np.array([0.0, 0.0, 1.0])
    errors = []
    for sign in (1.0, -1.0):
        seen = np.tile(sign * normal, (len(legs), 1))
        starts = camera_starts(A_Rb, np.tile(up, (len(legs), 1)), A_camera, seen, signed=True)
        if not starts:
            return 0.0
        errors.append(_error(mechanism, axes, measurements, starts[0].T_Rb_camera, A_camera, legs))
    if max(errors) == 0.0 or min(errors) > _DECIDED * max(errors):
        return 0.0
    return 1.0 if errors[0] < errors[1] else -1.0


def _error(
    mechanism: NominalMechanism,
    axes: LegAxes,
    measurements: Measurements,
    T_Rb_camera: RigidTransform,
    A_camera: Array,
    legs: IntArray,
) -> float:
    """Return the sum of squared errors of leg lengths from one side [m^2]."""
    parameters, total = mechanism.parameters, 0.0
    place = np.full(mechanism.n_legs, -1)
    place[legs] = np.arange(len(legs))
    q = np.where(mechanism.constant, 0.0, mechanism.sign * measurements.q)
    A, B = (_in_plane(P) for P in (parameters.base_joints, parameters.platform_joints))
    for row in np.unique(axes.row):
        length = q[row] + parameters.offsets
        here = np.flatnonzero((axes.row == row) & (place[axes.leg] >= 0))
        here = here[np.isfinite(length[axes.leg[here]])]
        if len(here) < 2:
            continue
        leg = axes.leg[here]
        ends = T_Rb_camera.apply(A_camera[place[leg]] + length[leg, None] * axes.u[here])
        placed = _laid(B, leg, _in_plane(ends))
        miss = np.abs(placed - A) - length
        total += float(np.sum(miss[np.isfinite(miss)] ** 2))
    return total


def _laid(B: Array, leg: IntArray, ends: Array) -> Array:
    """Return points of a plane moved so that those of some legs lie on their ends, all complex."""
    middle, centre = B[leg].mean(), ends.mean()
    turn = np.sum(np.conj(B[leg] - middle) * (ends - centre))
    size = np.abs(turn)
    return np.asarray(centre + (turn / size if size > 0.0 else 1.0) * (B - middle))


def _in_plane(points: Array) -> Array:
    """Return points (n, 3) as complex numbers x + i y."""
    return np.asarray(points[:, 0] + 1j * points[:, 1])
