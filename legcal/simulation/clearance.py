"""Legs that run through each other: their visible cylinders, as capsules, come too near.

Cylinders that overlap at home, where legs share a joint or a drawing is generous, are not judged.
"""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import RigidTransform

from legcal.geometry.types import Array, BoolArray
from legcal.mechanism.closing import leg_vectors
from legcal.mechanism.model import Mechanism


class Clearance:
    """The cylinders of a machine, two by two.

    Parameters
    ----------
    mechanism : Mechanism
        The machine, with its home.
    """

    def __init__(self, mechanism: Mechanism) -> None:
        self._mechanism = mechanism
        found = [(j, c) for j, leg in enumerate(mechanism.legs) for c in leg.cylinders]
        self._leg = np.array([j for j, _ in found], dtype=np.intp)
        self._ends = np.array([(c.start, c.end) for _, c in found]).reshape(-1, 2)
        self._from_platform = np.array([c.side == "platform" for _, c in found], dtype=np.bool_)
        radius = np.array([c.radius for _, c in found])
        first, second = np.triu_indices(len(found), 1)
        other = self._leg[first] != self._leg[second]
        self._pairs = np.stack([first[other], second[other]])
        self._needed = radius[self._pairs].sum(axis=0)
        judged = ~self._touching(mechanism.home)
        self._pairs, self._needed = self._pairs[:, judged], self._needed[judged]

    def touching(self, T_base_platform: RigidTransform) -> tuple[str, str] | None:
        """Return the first two legs that run through each other at a pose, None if none do."""
        touching = np.flatnonzero(self._touching(T_base_platform))
        if not len(touching):
            return None
        one, two = self._leg[self._pairs[:, touching[0]]]
        names = self._mechanism.leg_names
        return names[one], names[two]

    def _touching(self, T_base_platform: RigidTransform) -> BoolArray:
        """Return which pairs of cylinders are nearer than the sum of their radii."""
        vectors = leg_vectors(self._mechanism, T_base_platform)
        lengths = np.linalg.norm(vectors, axis=1)
        u = (vectors / lengths[:, None])[self._leg]
        along = self._ends + np.where(self._from_platform, lengths[self._leg], 0.0)[:, None]
        start = self._mechanism.A_base[self._leg] + along[:, :1] * u
        one, two = self._pairs
        span = np.diff(along, axis=1) * u
        distance = segment_distance(start[one], span[one], start[two], span[two])
        return np.asarray(distance < self._needed)


def segment_distance(start_1: Array, span_1: Array, start_2: Array, span_2: Array) -> Array:
    """Return the distance of pairs of straight pieces start + s span, 0 <= s <= 1.

    Parameters
    ----------
    start_1, start_2 : (n, 3) array
        Where the pieces start [m].
    span_1, span_2 : (n, 3) array
        From their start to their end [m], not zero.

    Returns
    -------
    (n,) array
        Distances [m].
    """
    between = start_1 - start_2
    a, e, b = _dot(span_1, span_1), _dot(span_2, span_2), _dot(span_1, span_2)
    c, f = _dot(span_1, between), _dot(span_2, between)
    square = a * e - b * b
    lines_cross = square > 1e-12 * a * e
    s = np.where(lines_cross, (b * f - c * e) / np.where(lines_cross, square, 1.0), 0.0)
    s = np.clip(s, 0.0, 1.0)
    t = np.clip((b * s + f) / e, 0.0, 1.0)
    s = np.clip((b * t - c) / a, 0.0, 1.0)
    return np.asarray(np.linalg.norm(between + s[:, None] * span_1 - t[:, None] * span_2, axis=1))


def _dot(one: Array, two: Array) -> Array:
    """Return the scalar products of rows."""
    return np.asarray(np.einsum("ni,ni->n", one, two))
