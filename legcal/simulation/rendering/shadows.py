"""Shadows of round lamps: how much of a lamp is seen from a point."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from legcal.geometry.types import Array, IntArray
from legcal.simulation.rendering.meshes import is_hidden
from legcal.simulation.rendering.rays import Single
from legcal.simulation.rendering.solid_in_view import SolidInView
from legcal.simulation.shapes import Box, Cylinder, Sphere

_TINY = 1e-12
_SMALLEST = 1e-5  # [m] half-shadow of a point-like lamp
_CHUNK = 8192  # points at a time
_SPARE = 1e-4  # [m] for rounding


@dataclass(frozen=True, eq=False)
class Lamp:
    """A light in the camera frame.

    Attributes
    ----------
    position : (3,) array
        Where it stands [m].
    power : float
        Radiance of a white surface that faces it, times its squared distance [m^2].
    radius : float
        Its size [m].
    shadows : bool
        Whether solids cast shadows of it.
    """

    position: Array
    power: float
    radius: float
    shadows: bool


class Occluders:
    """Solids that stand between points and lamps: long ones around a line, others in a ball.

    Parameters
    ----------
    solids : sequence of SolidInView
        The solids.
    """

    def __init__(self, solids: Sequence[SolidInView]) -> None:
        long = [isinstance(s.shape, Cylinder) and s.shape.length > s.shape.radius for s in solids]
        self._lines = [i for i, is_long in enumerate(long) if is_long]
        self._balls = [i for i, is_long in enumerate(long) if not is_long]
        self.solids = tuple(solids)
        self._u = np.array([solids[i].R[:, 2] for i in self._lines]).reshape(-1, 3)
        self._w = np.array([solids[i].w for i in self._lines]).reshape(-1, 3)
        self._radius = np.array([s.shape.radius if isinstance(s.shape, Cylinder) else 0.0
                                 for s in (solids[i] for i in self._lines)])  # fmt: skip
        self._centre = np.array([solids[i].centre for i in self._balls]).reshape(-1, 3)
        self._reach = np.array([solids[i].reach for i in self._balls])

    def near(self, lamp: Lamp, to_lamp: Single) -> Iterator[tuple[int, IntArray]]:
        """Yield solids with the points whose way to a lamp passes near them.

        The way l from a point to the lamp at O passes the line (u, w) at the distance
        l . (u x (O - w)) / |l x u|, and the ball about c at |l x (O - c)| / |l|.

        Parameters
        ----------
        lamp : Lamp
            The lamp.
        to_lamp : (3, n) array
            From the points to the lamp [m].
        """
        l2 = np.einsum("in,in->n", to_lamp, to_lamp)
        spare = lamp.radius + _SPARE
        moment = np.cross(self._u, lamp.position - self._w).astype(np.float32) @ to_lamp
        along = self._u.astype(np.float32) @ to_lamp
        limit = ((self._radius + spare) ** 2).astype(np.float32)[:, None]
        close = moment * moment < limit * (l2 - along * along + np.float32(1e-6) * l2)
        for row in np.flatnonzero(close.any(axis=1)):
            yield self._lines[row], np.flatnonzero(close[row])
        away = lamp.position - self._centre
        along = away.astype(np.float32) @ to_lamp
        rest = np.sum(away**2, axis=1) - (self._reach + spare) ** 2
        close = rest.astype(np.float32)[:, None] * l2 < along * along
        for row in np.flatnonzero(close.any(axis=1)):
            yield self._balls[row], np.flatnonzero(close[row])


def seen_of_lamp(lamp: Lamp, P: Single, occluders: Occluders, own: IntArray | int = -1) -> Single:
    """Return the share of a lamp that is seen from points past solids, (n,).

    The half-shadow is that of a straight edge: it goes smoothly from none to all over the
    apparent size of the lamp. That of a box or a mesh is hard.

    Parameters
    ----------
    lamp : Lamp
        The lamp.
    P : (3, n) array
        Points in the camera frame [m].
    occluders : Occluders
        What may stand between.
    own : int or (n,) array of int, optional
        The solid that the points are on, which does not shade itself.
    """
    seen = np.ones(P.shape[1], dtype=np.float32)
    own = np.broadcast_to(own, seen.shape)
    position = lamp.position.astype(np.float32)[:, None]
    for start in range(0, P.shape[1], _CHUNK):
        points = P[:, start : start + _CHUNK]
        to_lamp = position - points
        owners = own[start : start + _CHUNK]
        for i, some in occluders.near(lamp, to_lamp):
            some = some[owners[some] != i]
            if len(some):
                share = _past(
                    occluders.solids[i], lamp, points.take(some, axis=1), to_lamp.take(some, axis=1)
                )
                seen[start + some] *= share
    return seen


def _past(solid: SolidInView, lamp: Lamp, P: Single, to_lamp: Single) -> Single:
    """Return the share of the lamp seen past a solid."""
    shape = solid.shape
    if isinstance(shape, Cylinder):
        return _past_cylinder(solid, shape, lamp, P, to_lamp)
    if isinstance(shape, Sphere):
        return _past_sphere(solid, shape, lamp, P, to_lamp)
    if isinstance(shape, Box):
        return _past_box(solid, shape, P, to_lamp)
    return np.float32(1.0) - is_hidden(solid, shape, P, lamp.position)


def _past_cylinder(
    solid: SolidInView, shape: Cylinder, lamp: Lamp, P: Single, to_lamp: Single
) -> Single:
    """Return the share of the lamp seen past a cylinder."""
    R = solid.R.T.astype(np.float32)
    qx, qy, qz = R @ (P - solid.w.astype(np.float32)[:, None])
    lx, ly, lz = R @ to_lamp
    # The part of the way that lies between the planes of the caps.
    safe = np.where(np.abs(lz) < _TINY, np.float32(_TINY), lz)
    t1, t2 = (-0.5 * shape.length - qz) / safe, (0.5 * shape.length - qz) / safe
    first = np.minimum(np.maximum(np.minimum(t1, t2), 0.0), 1.0)
    last = np.minimum(np.maximum(np.maximum(t1, t2), 0.0), 1.0)
    # Closest approach to the axis there.
    t = -(qx * lx + qy * ly) / np.maximum(lx * lx + ly * ly, _TINY)
    t = np.minimum(np.maximum(t, first), last)
    px, py = qx + t * lx, qy + t * ly
    gap = np.sqrt(px * px + py * py) - shape.radius
    return np.where(last > first, _half_shadow(gap, t, lamp), np.float32(1.0))


def _past_sphere(
    solid: SolidInView, shape: Sphere, lamp: Lamp, P: Single, to_lamp: Single
) -> Single:
    """Return the share of the lamp seen past a sphere."""
    q = P - solid.w.astype(np.float32)[:, None]
    l2 = np.maximum(np.einsum("in,in->n", to_lamp, to_lamp), _TINY)
    t = np.clip(-np.einsum("in,in->n", q, to_lamp) / l2, 0.0, 1.0)
    q += t * to_lamp
    gap = np.sqrt(np.einsum("in,in->n", q, q)) - shape.radius
    return _half_shadow(gap, t, lamp)


def _past_box(solid: SolidInView, shape: Box, P: Single, to_lamp: Single) -> Single:
    """Return the share of the lamp seen past a box: all or nothing."""
    R = solid.R.T.astype(np.float32)
    q, l = R @ (P - solid.w.astype(np.float32)[:, None]), R @ to_lamp  # noqa: E741
    first = np.zeros(P.shape[1], dtype=np.float32)
    last = np.ones(P.shape[1], dtype=np.float32)
    for axis in range(3):
        d = np.where(l[axis] == 0.0, np.float32(_TINY), l[axis])
        a, b = (-0.5 * shape.size[axis] - q[axis]) / d, (0.5 * shape.size[axis] - q[axis]) / d
        np.maximum(first, np.minimum(a, b), out=first)
        np.minimum(last, np.maximum(a, b), out=last)
    return (first >= last).astype(np.float32)


def _half_shadow(gap: Single, t: Single, lamp: Lamp) -> Single:
    """Return the share of the lamp past an edge: the ray misses it by a gap, t of the way."""
    width = t * np.float32(lamp.radius) + np.float32(_SMALLEST)
    # A surface that coincides with the points' own one does not shade it.
    share = np.clip((gap + np.float32(_SMALLEST)) / width * 0.5 + 0.5, 0.0, 1.0)
    return np.asarray(share * share * (3.0 - 2.0 * share))
