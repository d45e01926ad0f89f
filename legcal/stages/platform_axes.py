"""Section 3.5: revolute axes on the platform, and directions of legs that are fixed to it.

The transformation of (18) turns the direction u of a leg into R_e. A revolute axis is normal to
it at every pose, (7); a leg that is fixed to the platform keeps the same u.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from legcal.errors import NotIdentifiable
from legcal.geometry.types import Array
from legcal.stages.leg_directions import LegDirections
from legcal.stages.platform_pose import PlatformPoses

_SAME_DIRECTION = 1e-9  # of the normalised information: directions that differ by less are one


def directions_on_platform(directions: LegDirections, poses: PlatformPoses) -> Array:
    """Return u in R_e, (n, 3); NaN where the pose of the platform is not known."""
    u = np.full((len(directions), 3), np.nan)
    here = np.flatnonzero(poses.pose >= 0)
    u[here] = np.einsum("nij,ni->nj", poses.R[poses.pose[here]], directions.u[here])
    return u


def revolute_axis(name: str, u: Array, nominal: Array) -> Array:
    """Identify a revolute axis on the platform from v . u = 0, eq (7), unweighted.

    Parameters
    ----------
    name : str
        Name of the leg, for messages.
    u : (n, 3) array
        Directions of the leg in R_e.
    nominal : (3,) array
        The nominal axis in R_e, on whose side the result is.

    Returns
    -------
    (3,) array
        The unit axis in R_e.

    Raises
    ------
    NotIdentifiable
        If the leg has fewer than two directions in the platform.
    """
    value, vector = np.linalg.eigh(u.T @ u)
    axis = vector[:, 0]
    if value[1] <= _SAME_DIRECTION * len(u):
        raise NotIdentifiable(
            f"The revolute axis of leg {name} on the platform could not be identified: found "
            f"{_count(len(u))} in the frame of the platform, needed two different ones; add poses "
            "between which the leg turns about it."
        )
    return axis if axis @ nominal > 0.0 else -axis


def fixed_direction(name: str, u: Array) -> Array:
    """Return the direction in R_e of a leg that is fixed to the platform: the mean of u, (n, 3).

    Raises
    ------
    NotIdentifiable
        If no pose shows it.
    """
    if not len(u):
        raise NotIdentifiable(
            f"The direction of leg {name} in the platform could not be identified: found no pose "
            "that shows it together with three legs of known length, needed one; add images that "
            "show several legs at once."
        )
    total = u.sum(axis=0)
    return np.asarray(total / np.linalg.norm(total))


def _count(n_poses: int) -> str:
    """Return how many poses showed a single direction, in words."""
    if n_poses == 0:
        return "no pose that shows its direction"
    return f"one direction in {n_poses} pose{'s' * (n_poses != 1)}"


def of_leg(directions: LegDirections, poses: PlatformPoses, leg: int) -> Sequence[int]:
    """Return the places of a leg's directions whose platform pose is known."""
    here: Sequence[int] = np.flatnonzero((directions.leg == leg) & (poses.pose >= 0)).tolist()
    return here
