"""Poses that the legs allow to rounding, near poses that they allow nearly.

Models are written with rounded axes, and their chains close with joints that are as far off. The
equations of the legs (:mod:`legcal.mechanism.equations`) know ideal joints; a simulated machine is
to stand where these hold.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.spatial.transform import Rotation

from legcal.errors import DidNotConverge
from legcal.geometry.types import Array
from legcal.mechanism.equations import demanded
from legcal.mechanism.leg import LegKind
from legcal.mechanism.leg_geometry import Demand, LegGeometry
from legcal.mechanism.sensitivity import freedoms

_STEPS = 20
_CLOSED = 1e-13  # [m]


def closed_poses(
    legs: Sequence[LegGeometry], frame_legs: Sequence[int], R: Array, t: Array
) -> tuple[Array, Array]:
    """Return the nearest poses at which everything holds that legs demand without a reading.

    Parameters
    ----------
    legs : sequence of LegGeometry
        The legs in R_b and R_e.
    frame_legs : sequence of int
        The legs that define R_b and R_e: three in space, two in a plane.
    R, t : (k, 3, 3) and (k, 3) array
        Poses nearby of R_e in R_b [m].

    Returns
    -------
    R, t : (k, 3, 3) and (k, 3) array

    Raises
    ------
    DidNotConverge
        If the legs meet nowhere nearby.
    """
    columns = list(freedoms(frame_legs))
    if len(columns) < 6:
        R, t = _in_plane(legs, R, t)
    for _ in range(_STEPS):
        values, by_pose = unmeasured(legs, R, t)
        if np.abs(values).max(initial=0.0) < _CLOSED:
            return R, t
        step = np.zeros((len(t), 6))
        step[:, columns] = -(np.linalg.pinv(by_pose[:, :, columns]) @ values[..., None])[..., 0]
        R, t = moved_poses(R, t, step)
    raise DidNotConverge(
        f"Simulated poses could not be closed: found legs {1e3 * np.abs(values).max():.2g} mm off "
        "what they demand, needed poses that they allow; check the model's home."
    )


def unmeasured(legs: Sequence[LegGeometry], R: Array, t: Array) -> tuple[Array, Array]:
    """Return the equations that hold without a reading, (k, m) [m], and how poses change them."""
    values, by_pose = [np.zeros((len(t), 0))], [np.zeros((len(t), 0, 6))]
    for leg in legs:
        found = demanded(leg, R, t)
        measured = [d is Demand.LENGTH and leg.kind is LegKind.ACTUATED for d in found.demands]
        rows = np.flatnonzero(~np.array(measured, dtype=np.bool_))
        values.append(found.values[:, rows])
        by_pose.append(found.by_pose[:, rows])
    return np.concatenate(values, axis=1), np.concatenate(by_pose, axis=1)


def moved_poses(R: Array, t: Array, step: Array) -> tuple[Array, Array]:
    """Return poses after a rotation [rad] and a displacement [m] in R_b, (k, 6)."""
    turn = Rotation.from_rotvec(step[..., :3]).as_matrix()
    return np.asarray(turn @ R), np.asarray(t + step[..., 3:])


def _in_plane(legs: Sequence[LegGeometry], R: Array, t: Array) -> tuple[Array, Array]:
    """Return poses turned and lifted into the plane of motion."""
    angle = np.arctan2(R[:, 1, 0], R[:, 0, 0])
    t = t.copy()
    t[:, 2] = np.mean([leg.A[2] - leg.B[2] for leg in legs])
    return Rotation.from_euler("z", angle[:, None]).as_matrix(), t
