"""Where viewing rays touch a cylinder, by the tangents to a circle.

The method has its own route from an axis to its outlines, by angles between planes
(:mod:`legcal.vision.cylinder`). The simulator does not use it, so that a mistake in one of them
shows. Here the cylinder is cut by the plane through the camera centre that is normal to its axis:
from there a circle is seen, and the two tangents to it touch the generating lines of the outlines.
"""

import numpy as np

from legcal.errors import NotVisible
from legcal.geometry.types import Array


def contact_offsets(u: Array, A: Array, radius: Array) -> Array:
    """Return the steps from an axis to the generating lines that its outlines show.

    A circle of radius R whose centre is at a distance d is touched at R^2 / d before its centre
    and R sqrt(1 - R^2 / d^2) beside it, whatever point of the axis they are counted from.

    Parameters
    ----------
    u, A : (..., 3) array
        Unit directions from base to platform, and a point of each axis, in the camera frame [m].
    radius : (...) array
        Radii [m].

    Returns
    -------
    (..., 2, 3) array
        For edges 1 (epsilon +1) and 2 (epsilon -1), in the camera frame [m].

    Raises
    ------
    NotVisible
        If the camera centre is inside a cylinder or on its surface.
    """
    centre = A - u * np.sum(u * A, axis=-1, keepdims=True)
    d = np.linalg.norm(centre, axis=-1, keepdims=True)
    R = np.broadcast_to(np.asarray(radius, dtype=np.float64), d.shape[:-1])[..., None]
    if not np.all(d > R):
        raise NotVisible(
            "A simulated leg could not be seen: found the camera centre "
            f"{1e3 * float(d.min()):.1f} mm from its axis, inside the leg, needed one outside; "
            "move the camera."
        )
    away = centre / d
    aside = np.cross(u, away)
    before = -(R * R / d) * away
    beside = R * np.sqrt(1.0 - (R / d) ** 2) * aside
    return np.stack([before - beside, before + beside], axis=-2)


def silhouette(u: Array, A: Array, radius: Array) -> tuple[Array, Array]:
    """Return the outlines of cylinders and the steps to their generating lines.

    Parameters
    ----------
    u, A, radius : array
        As in :func:`contact_offsets`.

    Returns
    -------
    h : (..., 2, 3) array
        Unit normals of the planes through the camera centre and the generating lines, signed as
        the moment u x P of a point P of each, eq (3).
    offsets : (..., 2, 3) array
        As from :func:`contact_offsets`: the point A + s u of the axis is beside the point
        A + s u + offset of the generating line.
    """
    offsets = contact_offsets(u, A, radius)
    moments = np.cross(u[..., None, :], A[..., None, :] + offsets)
    return moments / np.linalg.norm(moments, axis=-1, keepdims=True), offsets
