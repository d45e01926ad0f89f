"""Where cameras stand by default: outside, on the side of the legs that they show."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from legcal.geometry.types import Array

FOCAL_PX = 1290.0  # 1024 x 768 pixels, 43 degrees wide
_DISTANCE = 2.5  # machine sizes
_TILT = 0.5  # [rad] from the normal of a planar machine


def default_cameras(
    A: Array, B: Array, views: Sequence[Sequence[int]], spatial: bool, rng: np.random.Generator
) -> Array:
    """Return where a camera for each view stands.

    No two of them stand in the same place, even if they show the same legs.

    Parameters
    ----------
    A, B : (n_legs, 3) array
        Joint centres at home, in R_b [m].
    views : sequence of sequences of int
        The legs that each view shows.
    spatial : bool
        Planar machines are seen from along their normal, tilted toward the side of the legs.
    rng : numpy.random.Generator
        Source of the variation.

    Returns
    -------
    (n_views, 3) array
        In R_b [m].
    """
    points = np.concatenate([A, B])
    size = float(np.linalg.norm(np.ptp(points, axis=0)))
    middle = 0.5 * (A + B)
    centre = middle.mean(axis=0)
    axis = _axis(A, B) if spatial else np.array([0.0, 0.0, 1.0])
    places = []
    for seen in views:
        outward = (middle[list(seen)] - centre).mean(axis=0)
        outward -= axis * (outward @ axis)
        if np.linalg.norm(outward) < 0.02 * size:  # legs all around: any side will do
            outward = np.cross(axis, rng.normal(size=3))
        outward /= np.linalg.norm(outward)
        side = np.cross(axis, outward)
        turn, lift = rng.uniform(-0.15, 0.15), rng.uniform(0.05, 0.3)
        if not spatial:
            lift = 0.5 * np.pi - _TILT + rng.uniform(-0.1, 0.1)
        toward = np.cos(turn) * outward + np.sin(turn) * side
        toward = np.cos(lift) * toward + np.sin(lift) * axis
        places.append(centre + _DISTANCE * size * rng.uniform(0.95, 1.05) * toward)
    return np.array(places).reshape(-1, 3)


def _axis(A: Array, B: Array) -> Array:
    """Return the direction from base to platform."""
    across = B.mean(axis=0) - A.mean(axis=0)
    size = float(np.linalg.norm(across))
    if size < 1e-6:
        return np.array([0.0, 0.0, 1.0])
    return np.asarray(across / size)
