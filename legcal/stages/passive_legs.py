"""Section 3.5: the ends of passive legs on the platform, eq (19).

Nothing tells the length of a passive leg, but its end B lies on its axis through A in every pose.
With the platform's pose of (18) these are linear equations in B.
"""

from __future__ import annotations

import numpy as np

from legcal.errors import NotIdentifiable
from legcal.geometry.types import Array, IntArray

_SAME_DIRECTION = 1e-9  # of the normalised information: directions that differ by less are one


def locate_passive_end(
    name: str,
    u: Array,
    A: Array,
    pose: tuple[Array, Array],
    B_nominal: Array,
    free: IntArray,
) -> Array:
    """Locate the platform joint centre of a passive leg: u x A B = 0 in all poses, eq (19).

    Parameters
    ----------
    name : str
        Name of the leg, for messages.
    u, A : (n, 3) array
        Directions of the leg and base joint centres [m], in the frames of groups.
    pose : (n, 3, 3) and (n, 3) array
        Rotation and position [m] of R_e in these frames.
    B_nominal : (3,) array
        Its other coordinates are kept [m].
    free : (k,) array of int
        The coordinates of B that are looked for: three; two in a plane, and on a leg that is
        fixed to the platform, along which B may lie anywhere.

    Returns
    -------
    (3,) array
        B in R_e [m], with the least sum of squares of (19), unweighted.

    Raises
    ------
    NotIdentifiable
        If the leg has fewer directions in the platform than that takes.
    """
    R, t = pose
    across = np.eye(3) - u[:, :, None] * u[:, None, :]  # its square is itself
    inside = np.swapaxes(R, 1, 2) @ across
    normal = (inside @ R).sum(axis=0)
    right = np.einsum("nij,nj->i", inside, A - t) - normal @ B_nominal
    B = B_nominal.copy()
    normal = normal[np.ix_(free, free)]
    if len(u) == 0 or np.linalg.eigvalsh(normal)[0] <= _SAME_DIRECTION * len(u):
        raise NotIdentifiable(
            f"The end of leg {name} on the platform could not be located: found "
            f"{len(u)} pose{'s' * (len(u) != 1)} of the platform that show{'s' * (len(u) == 1)} "
            "it, with axes that do not meet in one point there; needed two different directions in "
            "the platform, each seen together with three legs of known length (eq 19); add images "
            "at poses that differ more."
        )
    B[free] += np.linalg.solve(normal, right[free])
    return B
