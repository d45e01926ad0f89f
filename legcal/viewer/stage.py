"""What is seen of a machine at a posture: legs, rims, ellipsoids; numbers in, numbers out."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from legcal.geometry import Array
from legcal.machine import (
    Leg,
    Machine,
    geometries,
    moved_legs,
    parametrization_of,
    platform_in_base,
)
from legcal.scene import (
    FACTORS,
    around,
    directions,
    ellipsoids,
    enlargement,
    joints_at,
    step_shown,
)
from legcal.viewer.motion import Posture
from legcal.viewer.source import Source

_THIN = 0.006  # of the size of the machine: the radius of a leg without cylinders
_USUAL = 0.02  # of it: the median ellipsoid, and
_WIDER = 4.0  # of the ball that it must be seen about
_JOINT = 1.25  # of the thickest cylinder of a leg: the ball at its joints


@dataclass(frozen=True, eq=False)
class Rods:
    """Cylinders of a length along z, moved into place."""

    position: Array  # (m, 3) of their middles [m]
    wxyz: Array  # (m, 4) unit quaternions
    scale: Array  # (m, 3) radius, radius, length [m]


@dataclass(frozen=True, eq=False)
class Seen:
    """What is seen of a machine, in the base link [m]."""

    A: Array  # (n, 3)
    B: Array  # (n, 3)
    rods: Rods  # of Stage.rod_legs
    beside: tuple[Array, Array] | None  # A and B of what it is compared with
    apart: float  # how far joints are from those beside, without exaggeration [m]


class Stage:
    """All that does not move: sizes, rims, ellipsoids, what can be compared.

    Attributes
    ----------
    size : float
        Of the machine at home [m].
    rims : tuple of two lists of int
        Joints of base and platform in the order around it, the first twice.
    rod_legs : (m,) array of int
        The leg of each rod.
    rod_is_thick : (m,) array of bool
        Whether it is a part of the base's half.
    motions : tuple of str
        What else can be shown as a motion: weak and held directions.
    """

    def __init__(self, source: Source) -> None:
        self.source = source
        self.machine: Machine = source.machine
        self._legs = geometries(self.machine)
        self._nominal = None if source.nominal is None else geometries(source.nominal)
        A, B = self.machine.A_base, self.machine.home.apply(self.machine.B_platform)
        self.size = float(np.ptp(np.concatenate([A, B]), axis=0).max())
        self.rims = around(A), around(B)
        parts = [
            (j, c.radius, c.side == "base", c)
            for j, leg in enumerate(self.machine.legs)
            for c in leg.cylinders
        ]
        bare = [j for j, leg in enumerate(self.machine.legs) if not leg.cylinders]
        self._spans = [(j, c) for j, _, _, c in parts] + [(j, None) for j in bare]
        self.rod_legs = np.array([j for j, _ in self._spans])
        self.rod_is_thick = np.array([p[2] for p in parts] + [False] * len(bare))
        thin = _THIN * self.size
        self._radii = np.array([p[1] for p in parts] + [thin] * len(bare))
        self.ball_radii = _JOINT * np.array(
            [self._radii[self.rod_legs == j].max() for j in range(self.machine.n_legs)]
        )

    @cached_property
    def _directions(self) -> list[tuple[str, Array]]:
        if self.source.result is None:
            return []
        parameters = parametrization_of(self.machine, twists=True)
        A, B = self.machine.A_base, self.machine.home.apply(self.machine.B_platform)
        length = float(np.mean(np.linalg.norm(B - A, axis=1)))
        return directions(self.source.result.result, parameters, length)

    @property
    def motions(self) -> tuple[str, ...]:
        """What weak and held directions are called."""
        return tuple(words for words, _ in self._directions)

    @cached_property
    def ellipsoids(self) -> tuple[dict[str, Array], float]:
        """Half axes of one sigma by side, (n, 3, 3) [m], and by how much they are enlarged."""
        if self.source.result is None:
            return {}, 1.0
        axes = ellipsoids(self.source.result.result)
        radius = max(_USUAL * self.size, _WIDER * float(self.ball_radii.max()))
        return axes, enlargement(axes, radius)

    def compared(
        self, posture: Posture, motion: int | None = None
    ) -> tuple[tuple[Array, Array], tuple[Array, Array]] | None:
        """Return A and B (n, 3) before and after what is compared, at the readings of a posture.

        That is what the calibration changed, or one sigma along a direction, number *motion*.
        """
        here = self._joints(self._legs, posture, by_readings=False)
        if motion is not None:
            parameters = parametrization_of(self.machine, twists=True)
            step = self._directions[motion][1]
            moved = moved_legs(self._legs, parameters.place, step)
            return here, self._joints(moved, posture)
        if self._nominal is None:
            return None
        return self._joints(self._nominal, posture), here

    def first_step(self, posture: Posture, motion: int) -> int:
        """Return which of the factors of exaggeration shows a direction at first."""
        compared = self.compared(posture, motion)
        if compared is None:
            return FACTORS.index(1)
        before, after = compared
        moved = max(float(np.abs(b - a).max()) for a, b in zip(before, after, strict=True))
        return step_shown(moved, self.size)

    def seen(
        self,
        posture: Posture,
        motion: int | None = None,
        factor: float = 1.0,
        phase: float = 1.0,
    ) -> Seen:
        """Return what is seen at a posture.

        Parameters
        ----------
        posture : Posture
            Where the machine stands.
        motion : int, optional
            The weak direction along which it is moved; without it, nominal and calibrated.
        factor : float
            By how much the difference is exaggerated; 1 shows the machine as it is.
        phase : float
            Of a motion, -1 to 1.
        """
        compared = self.compared(posture, motion)
        if compared is None:
            A, B = self._joints(self._legs, posture, by_readings=False)
            return Seen(A, B, self._rods(A, B), None, 0.0)
        before, after = compared
        apart = float(np.linalg.norm(np.subtract(after, before), axis=2).max())
        share = factor * phase
        A, B = (a + share * (b - a) for a, b in zip(before, after, strict=True))
        return Seen(A, B, self._rods(A, B), before, apart)

    def _joints(
        self, legs: Sequence[Leg], posture: Posture, *, by_readings: bool = True
    ) -> tuple[Array, Array]:
        """Return A and B (n, 3) of legs at the readings of a posture."""
        near = platform_in_base(self.machine, posture.T)
        by_readings = by_readings and self.machine.is_determined
        A, B = joints_at(self.machine, legs, posture.q[None], [near], by_readings=by_readings)
        return A[0], B[0]

    def _rods(self, A: Array, B: Array) -> Rods:
        """Return the cylinders of legs from A to B (n, 3)."""
        lengths = np.linalg.norm(B - A, axis=1)
        u = (B - A) / np.maximum(lengths, 1e-12)[:, None]
        ends = np.array(
            [(0.0, lengths[j]) if c is None else c.span(float(lengths[j])) for j, c in self._spans]
        )
        along = u[self.rod_legs]
        position = A[self.rod_legs] + ends.mean(axis=1)[:, None] * along
        scale = np.stack([self._radii, self._radii, np.ptp(ends, axis=1)], axis=1)
        return Rods(position, from_z(along), scale)


def from_z(u: Array) -> Array:
    """Return quaternions wxyz (m, 4) of the shortest turns from z to unit vectors (m, 3)."""
    zero = np.zeros(len(u))
    found = np.stack([1.0 + u[:, 2], -u[:, 1], u[:, 0], zero], axis=1)
    length = np.linalg.norm(found, axis=1)
    found[length < 1e-6] = [0.0, 1.0, 0.0, 0.0]
    return np.asarray(found / np.linalg.norm(found, axis=1)[:, None])
