"""What is seen of a machine at a posture: legs, rims, ellipsoids; numbers in, numbers out."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from legcal.geometry.types import Array
from legcal.machine.drawing import corners_of_base, motor_lines
from legcal.machine.kinematics import platform_in_base
from legcal.machine.leg import Leg
from legcal.machine.model import Machine
from legcal.machine.parameters import geometries, moved_legs, parametrization_of
from legcal.scene.motions import FACTORS, PlacedModel, directions, placed_model
from legcal.scene.shapes import around, ellipsoids, enlargement
from legcal.viewer.motion import Posture
from legcal.viewer.source import Source

_THIN = 0.006  # of the size of the machine: the radius of a leg without cylinders
_STANDING, _MOVING = 0.8, 1.4  # of the thickest rod: rails and axes, arms and carriages
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
    base: Array  # (n, 3) what its base is drawn about: A, or where motors stand that move these
    motors: Rods  # rails and axes of those motors, then carriages and arms
    beside: tuple[Array, Array] | None  # A and B of what it is compared with
    skeleton: Array | None  # (m, 2, 3) lines of that
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
    n_standing : int
        The first of ``Seen.motors``, which stand.
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
        self.n_standing = len(self.machine.actuators)
        home = motor_lines(self.machine.legs, A[None])
        thickest = float(self._radii.max())
        self._motor_radii = thickest * np.array(
            [_STANDING] * self.n_standing + [_MOVING] * home.moving.shape[1]
        )
        self.rims = around(corners_of_base(A, home.anchors)), around(B)
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
    ) -> tuple[PlacedModel, PlacedModel] | None:
        """Return the joints before and after what is compared, at the readings of a posture.

        That is what the calibration changed, or one sigma along a direction, number *motion*.
        """
        here = self._placed(self._legs, posture, by_readings=False)
        if motion is not None:
            parameters = parametrization_of(self.machine, twists=True)
            step = self._directions[motion][1]
            moved = moved_legs(self._legs, parameters.place, step)
            return here, self._placed(moved, posture)
        if self._nominal is None:
            return None
        return self._placed(self._nominal, posture), here

    def first_step(self, posture: Posture, motion: int) -> int:
        """Return which of the factors of exaggeration shows a direction at first."""
        compared = self.compared(posture, motion)
        if compared is None:
            return FACTORS.index(1)
        before, after = compared
        return before.first_step(after, self.size)

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
            here, before, apart = self._placed(self._legs, posture, by_readings=False), None, 0.0
        else:
            before, after = compared
            apart = float(np.linalg.norm(np.subtract(after[:2], before[:2]), axis=-1).max())
            here = before.moved_towards(after, factor * phase)
        return Seen(
            here.A[0],
            here.B[0],
            self._rods(here.A[0], here.B[0]),
            corners_of_base(here.A[0], here.anchors),
            _between(_motors(here), self._motor_radii),
            None if before is None else (before.A[0], before.B[0]),
            None if before is None else self._skeleton(before),
            apart,
        )

    def _placed(
        self, legs: Sequence[Leg], posture: Posture, *, by_readings: bool = True
    ) -> PlacedModel:
        """Return what is seen of legs at the readings of a posture, k = 1."""
        near = platform_in_base(self.machine, posture.T)
        by_readings = by_readings and self.machine.is_determined
        return placed_model(self.machine, legs, posture.q[None], [near], by_readings=by_readings)

    def _skeleton(self, placed: PlacedModel) -> Array:
        """Return legs, motors and rims as lines (m, 2, 3)."""
        A, B = placed.A[0], placed.B[0]
        lines = [np.stack([A, B], axis=1), _motors(placed)]
        for joints, rim in zip((corners_of_base(A, placed.anchors), B), self.rims, strict=True):
            lines.append(np.stack([joints[rim[:-1]], joints[rim[1:]]], axis=1))
        return np.concatenate(lines)

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


def _motors(placed: PlacedModel) -> Array:
    """Return motors as lines (m, 2, 3): what stands, then what moves."""
    return np.concatenate([placed.standing, placed.moving[0]])


def _between(ends: Array, radii: Array) -> Rods:
    """Return cylinders between ends (m, 2, 3)."""
    along = ends[:, 1] - ends[:, 0]
    length = np.linalg.norm(along, axis=1)
    scale = np.stack([radii, radii, length], axis=1)
    return Rods(ends.mean(axis=1), from_z(along / np.maximum(length, 1e-12)[:, None]), scale)


def from_z(u: Array) -> Array:
    """Return quaternions wxyz (m, 4) of the shortest turns from z to unit vectors (m, 3)."""
    zero = np.zeros(len(u))
    quaternions = np.stack([1.0 + u[:, 2], -u[:, 1], u[:, 0], zero], axis=1)
    length = np.linalg.norm(quaternions, axis=1)
    quaternions[length < 1e-6] = [0.0, 1.0, 0.0, 0.0]
    return np.asarray(quaternions / np.linalg.norm(quaternions, axis=1)[:, None])
