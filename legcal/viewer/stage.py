"""The visible geometry of a machine at a posture: legs, rims, ellipsoids, as arrays."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from legcal.geometry.types import Array
from legcal.machine.kinematics import platform_in_base
from legcal.machine.leg import Leg
from legcal.machine.model import Machine
from legcal.machine.parameters import geometries
from legcal.machine.picture import corners_of_base, motor_lines
from legcal.scene.motions import FACTORS, MachineScene, PlacedModel, enlargement
from legcal.viewer.motion import Posture
from legcal.viewer.source import Source

_THIN = 0.006  # radius of a leg without cylinders, relative to the machine
_STANDING, _MOVING = 0.8, 1.4  # radii of fixed and moving parts of motors, in thickest rods
_USUAL = 0.02  # least displayed size of the median ellipsoid, relative to the machine
_WIDER = 4.0  # the same, in radii of the ball at a joint
_JOINT = 1.25  # radius of the ball at joints, relative to the thickest cylinder of the leg


@dataclass(frozen=True, eq=False)
class Rods:
    """Cylinders with poses and sizes."""

    position: Array  # (m, 3) middles [m]
    wxyz: Array  # (m, 4) unit quaternions
    scale: Array  # (m, 3) radius, radius, length [m]


@dataclass(frozen=True, eq=False)
class Seen:
    """The visible geometry of a machine, in the base link [m]."""

    A: Array  # (n, 3)
    B: Array  # (n, 3)
    rods: Rods  # cylinders of Stage.rod_legs
    base: Array  # (n, 3) corners of the base: A, or the positions of motors that move A
    motors: Rods  # rails and axes of these motors, then carriages and arms
    beside: tuple[Array, Array] | None  # A and B of the compared model
    skeleton: Array | None  # (m, 2, 3) lines of the compared model
    apart: float  # largest distance of joints from the compared ones, not exaggerated [m]


class Stage:
    """The constant geometry: sizes, rims, ellipsoids, and models for comparison.

    Attributes
    ----------
    scene : MachineScene
        The machine, its nominal model and its directions of motion.
    size : float
        Size of the machine at home [m].
    rod_legs : (m,) array of int
        The leg of each rod.
    rod_is_thick : (m,) array of bool
        Whether it belongs to the half at the base.
    n_standing : int
        Number of fixed parts, which are first in ``Seen.motors``.
    magnification : float
        Factor by which ellipsoids are enlarged.
    """

    def __init__(self, source: Source) -> None:
        self.source = source
        self.machine: Machine = source.machine
        self.scene = MachineScene(
            self.machine,
            geometries(self.machine),
            None if source.nominal is None else geometries(source.nominal),
            None if source.result is None else source.result.result,
        )
        self.size = self.scene.size
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
        home = motor_lines(self.machine.legs, self.machine.A_base[None])
        thickest = float(self._radii.max())
        self._motor_radii = thickest * np.array(
            [_STANDING] * self.n_standing + [_MOVING] * home.moving.shape[1]
        )
        self.ball_radii = _JOINT * np.array(
            [self._radii[self.rod_legs == j].max() for j in range(self.machine.n_legs)]
        )
        radius = max(_USUAL * self.size, _WIDER * float(self.ball_radii.max()))
        self.magnification = enlargement(self.scene.ellipsoids, radius)

    def compared(
        self, posture: Posture, motion: int | None = None
    ) -> tuple[PlacedModel, PlacedModel] | None:
        """Return the two compared models, at the readings of a posture.

        They differ by the calibration, or by one sigma along the direction with index *motion*.
        """
        here = self._here(posture)
        if motion is not None:
            return here, self._placed(self.scene.moved(motion), posture)
        if self.scene.nominal is None:
            return None
        return self._placed(self.scene.nominal, posture), here

    def first_step(self, posture: Posture, motion: int) -> int:
        """Return the index of the default magnification for a direction."""
        compared = self.compared(posture, motion)
        if compared is None:
            return FACTORS.index(1)
        return self.scene.first_step(*compared)

    def seen(
        self,
        posture: Posture,
        motion: int | None = None,
        factor: float = 1.0,
        phase: float = 1.0,
    ) -> Seen:
        """Return the visible geometry at a posture.

        Parameters
        ----------
        posture : Posture
            Posture of the machine.
        motion : int, optional
            Index of the weak direction of motion; by default nominal and calibrated are compared.
        factor : float
            Magnification of the difference; 1 shows the actual machine.
        phase : float
            Phase of a motion, -1 to 1.
        """
        compared = self.compared(posture, motion)
        if compared is None:
            here, before, apart = self._here(posture), None, 0.0
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

    def _here(self, posture: Posture) -> PlacedModel:
        """Return the machine at a posture, k = 1."""
        near = platform_in_base(self.machine, posture.T)
        return self.scene.placed(self.scene.legs, posture.q[None], [near], by_readings=False)

    def _placed(self, legs: Sequence[Leg], posture: Posture) -> PlacedModel:
        """Return a model at the readings of a posture, k = 1, if readings determine its pose."""
        near = platform_in_base(self.machine, posture.T)
        by_readings = self.machine.is_determined
        return self.scene.placed(legs, posture.q[None], [near], by_readings=by_readings)

    def _skeleton(self, placed: PlacedModel) -> Array:
        """Return legs, motors and rims as lines (m, 2, 3)."""
        A, B = placed.A[0], placed.B[0]
        lines = [np.stack([A, B], axis=1), _motors(placed)]
        rims = self.scene.rims.values()
        for joints, rim in zip((corners_of_base(A, placed.anchors), B), rims, strict=True):
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
    """Return motors as lines (m, 2, 3), fixed parts first."""
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
