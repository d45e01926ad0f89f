"""The observation table: every outline of every leg in every image, with its covariance."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from legcal.geometry.types import Array, BoolArray, IntArray

QUALITY = ("contrast", "length", "residual")  # what tells how well an outline was seen
ENCODING = ("gamma", "by_gamma")  # what tells how an outline depends on the gamma of the camera


def _unknown() -> Array:
    return np.zeros(0)


@dataclass(frozen=True, eq=False)
class Outlines:
    """Outlines of cylinders in images, one row an outline (eqs 2, 3, 5).

    Attributes
    ----------
    row : (n,) array of int
        Index into the rows of :class:`legcal.observations.measurements.Measurements`.
    leg : (n,) array of int
        Index into the legs of the mechanism.
    part : tuple of str, length n
        The URDF link of the cylinder.
    edge : (n,) array of int
        1 where epsilon of eq (5) is +1, 2 where it is -1.
    h : (n, 3) array
        Unit normal (a, b, c) of the plane through the camera centre and the outline, in the
        camera frame, signed as in eq (3): h . M = epsilon R for a leg oriented from base
        to platform. NaN for a leg that was not found.
    ends : (n, 2, 2) array
        Both ends of the used piece, in pixels of the image; the first is nearer to the base
        joint. NaN for a leg that was not found.
    covariance : (n, 2, 2) array
        Covariance of the offsets of the line, normal to itself, at these ends [px^2].
    used : (n,) array of bool
        False for rejected outlines.
    reason : tuple of str, length n
        Why an outline was rejected; "" for used ones.
    source : tuple of str, length n
        ``detected`` or ``edited``.
    contrast : (n,) array
        Median step from the background to the leg [grey levels]. This and the next two are NaN
        where nothing was found and for outlines that were given or edited; they may be left out.
    length : (n,) array
        How much of the used piece was seen on its line, without gaps [px].
    residual : (n,) array
        Robust standard deviation of its edge about the line [px].
    gamma : (n,) array
        The gamma of the camera with which it was measured. This and the next one are NaN where
        nothing was found and for outlines that were given or edited; they may be left out.
    by_gamma : (n,) array
        How far it moves towards the inside of the leg with the logarithm of that gamma [px].
    """

    row: IntArray
    leg: IntArray
    part: tuple[str, ...]
    edge: IntArray
    h: Array
    ends: Array
    covariance: Array
    used: BoolArray
    reason: tuple[str, ...]
    source: tuple[str, ...]
    contrast: Array = field(default_factory=_unknown)
    length: Array = field(default_factory=_unknown)
    residual: Array = field(default_factory=_unknown)
    gamma: Array = field(default_factory=_unknown)
    by_gamma: Array = field(default_factory=_unknown)

    def __post_init__(self) -> None:
        for name in (*QUALITY, *ENCODING):
            if len(getattr(self, name)) == 0:
                object.__setattr__(self, name, np.full(len(self.row), np.nan))

    def __len__(self) -> int:
        return len(self.row)
