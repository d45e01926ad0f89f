"""A motor between the base and the joint at A: a carriage or an arm on which rods hang.

A rod of constant length hangs at A, which moves with the reading q of the motor:

    prismatic  A(q) = a + g q d             d the direction of the carriage
    revolute   A(q) = c + Rot(w, g q)(a - c)    c a point of the axis, w its direction

a is A at reading 0, and the gain g is 1 unless it is estimated. Several rods may hang on one motor
(the arm of a Delta carries two): each has the same :class:`Actuator`, known by its joint.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from enum import StrEnum
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from scipy.spatial.transform import RigidTransform, Rotation

from legcal.geometry import (
    Array,
    axis_angles,
    axis_angles_slope,
    cross,
    matrix_applied,
    normal_basis,
    turned_axis,
)

if TYPE_CHECKING:
    from legcal.machine.leg import Leg


class ActuatorKind(StrEnum):
    """How a motor moves what hangs on it."""

    PRISMATIC = "prismatic"
    REVOLUTE = "revolute"


class ActuatorColumns:
    """Where the numbers of an actuator stand in those of its legs, after their own twelve."""

    AXIS, POINT, GAIN = slice(12, 14), slice(14, 16), 16


class JointMotion(NamedTuple):
    """A joint centre at k readings, and its derivatives."""

    A: Array  # (k, 3) [m]
    by_A: Array  # (k, 3, 3) by A at reading 0; this is also how directions in the arm turn
    by_axis: Array  # (k, 3, 2) by turns of the axis about its normal_basis
    by_point: Array  # (k, 3, 2) by displacements of a revolute's axis along its normal_basis
    by_gain: Array  # (k, 3)
    by_q: Array  # (k, 3) by the reading [1, or m/rad]
    angle: Array  # (k,) by which a revolute has turned [rad]; zero of a prismatic


@dataclass(frozen=True, eq=False)
class Actuator:
    """A motor that carries joints at A, in the frame of its legs: the base link, or R_b."""

    joint: str  # the URDF joint, whose value is the reading [m or rad]
    kind: ActuatorKind
    axis: Array  # (3,) unit: d of a prismatic, w of a revolute
    point: Array  # (3,) a point of a revolute's axis [m]; of a prismatic where its joint stands
    travel: tuple[float, float]  # limits of the joint [m or rad]
    link: str = ""  # the carriage or arm
    gain: float = 1.0  # true motion over reading

    @property
    def turns(self) -> bool:
        """Whether it is a revolute."""
        return self.kind is ActuatorKind.REVOLUTE

    @property
    def unit(self) -> str:
        """The unit of its readings."""
        return "rad" if self.turns else "m"

    def rotations(self, q: Array) -> Array:
        """Return how directions fixed in the carriage or arm turn at readings, (k, 3, 3)."""
        q = np.asarray(q, dtype=np.float64)
        if not self.turns:
            return np.broadcast_to(np.eye(3), (len(q), 3, 3))
        w, angle = self.axis, self.gain * q[:, None, None]
        K = np.array([[0.0, -w[2], w[1]], [w[2], 0.0, -w[0]], [-w[1], w[0], 0.0]])
        return np.asarray(np.eye(3) + np.sin(angle) * K + (1.0 - np.cos(angle)) * (K @ K))

    def at(self, A: Array, q: Array) -> Array:
        """Return the joint centre (k, 3) that is at A (3,) at reading 0, at readings (k,)."""
        q = np.asarray(q, dtype=np.float64)
        if not self.turns:
            return np.asarray(A + self.gain * q[:, None] * self.axis)
        return np.asarray(self.point + self.rotations(q) @ (A - self.point))

    def motion(self, A: Array, q: Array) -> JointMotion:
        """Return the same with its derivatives."""
        q = np.asarray(q, dtype=np.float64)
        k, basis = len(q), normal_basis(self.axis)
        if not self.turns:
            across = cross(basis, self.axis)  # (2, 3)
            return JointMotion(
                self.at(A, q),
                np.broadcast_to(np.eye(3), (k, 3, 3)),
                self.gain * q[:, None, None] * across.T,
                np.zeros((k, 3, 2)),
                q[:, None] * self.axis,
                np.broadcast_to(self.gain * self.axis, (k, 3)),
                np.zeros(k),
            )
        R, arm = self.rotations(q), A - self.point
        turned = R @ arm
        by_axis = np.stack([cross(e, turned) - R @ cross(e, arm) for e in basis], axis=2)
        by_angle = cross(self.axis, turned)
        return JointMotion(
            self.point + turned,
            R,
            by_axis,
            (np.eye(3) - R) @ basis.T,
            q[:, None] * by_angle,
            self.gain * by_angle,
            self.gain * q,
        )

    def moved(self, step: Array) -> Actuator:
        """Return the actuator after a step (5,): turns of its axis, its point, and its gain."""
        basis = normal_basis(self.axis)
        return replace(
            self,
            axis=turned_axis(self.axis, step[:2]),
            point=self.point + step[2:4] @ basis,
            gain=self.gain + float(step[4]),
        )

    def in_frame(self, T_to_from: Array) -> Actuator:
        """Return the same in another frame, T_to_from (4, 4)."""
        return replace(
            self, axis=T_to_from[:3, :3] @ self.axis, point=matrix_applied(T_to_from, self.point)
        )

    def numbers(self, nominal: Actuator) -> Array:
        """Return its five numbers: turns of the axis from the nominal one, its place, its gain.

        The place is where the axis meets the plane across the nominal axis at the nominal point,
        from that point.
        """
        crossing = self._crossing(nominal)[0] - nominal.point
        place = normal_basis(nominal.axis) @ crossing if self.turns else np.zeros(2)
        return np.array([*axis_angles(self.axis, nominal.axis), *place, self.gain])

    def numbers_slope(self, nominal: Actuator) -> Array:
        """Return the derivative (5, 5) of :meth:`numbers` by a step of :meth:`moved`."""
        slope = np.eye(5)
        slope[:2, :2] = axis_angles_slope(self.axis, nominal.axis)
        if not self.turns:
            return slope
        basis, w0 = normal_basis(self.axis), nominal.axis
        _, s, along = self._crossing(nominal)
        onto = normal_basis(w0) @ (np.eye(3) - np.outer(self.axis, w0) / along)
        slope[2:4, :2] = s * onto @ cross(basis, self.axis).T
        slope[2:4, 2:4] = onto @ basis.T
        return slope

    def with_numbers(self, nominal: Actuator, numbers: Array) -> Actuator:
        """Return the actuator that has these five numbers; the inverse of :meth:`numbers`."""
        axis = turned_axis(nominal.axis, numbers[:2])
        point = self.point
        if self.turns:
            point = nominal.point + numbers[2:4] @ normal_basis(nominal.axis)
        return replace(self, axis=axis, point=point, gain=float(numbers[4]))

    def _crossing(self, nominal: Actuator) -> tuple[Array, float, float]:
        """Return where the axis crosses the nominal plane, how far along it, and w . w0."""
        along = float(self.axis @ nominal.axis)
        s = float((nominal.point - self.point) @ nominal.axis) / along
        return self.point + s * self.axis, s, along

    def document(self) -> dict[str, object]:
        """Return it as result files have it, in its frame."""
        if self.turns:
            return {
                "kind": self.kind.value,
                "point": self.point.tolist(),
                "axis": self.axis.tolist(),
            }
        return {"kind": self.kind.value, "direction": self.axis.tolist()}


def actuators_of(legs: Sequence[Leg]) -> tuple[Actuator, ...]:
    """Return the actuators of legs, each once, in the order of their first legs."""
    found: dict[str, Actuator] = {}
    for leg in legs:
        if leg.actuator is not None:
            found.setdefault(leg.actuator.joint, leg.actuator)
    return tuple(found.values())


def actuator_index(legs: Sequence[Leg]) -> list[int]:
    """Return which of :func:`actuators_of` each leg hangs on, -1 for none."""
    number = {actuator.joint: i for i, actuator in enumerate(actuators_of(legs))}
    return [-1 if leg.actuator is None else number[leg.actuator.joint] for leg in legs]


def joints_at(legs: Sequence[Leg], q: Array) -> Array:
    """Return the joints A of legs (k, n_legs, 3) [m] at readings of actuators (k, n_actuators)."""
    A = np.empty((len(q), len(legs), 3))
    for j, (leg, a) in enumerate(zip(legs, actuator_index(legs), strict=True)):
        A[:, j] = leg.A if leg.actuator is None else leg.actuator.at(leg.A, q[:, a])
    return A


def reading_of_rod(leg: Leg, B: Array, near: Array | None = None) -> Array:
    """Return the readings (k,) at which a rod reaches points B (k, 3) in the frame of the base.

    |A(q) - B| = l has two solutions; the one is taken in whose mode the rod is (``Leg.mode``), or
    without *near* [the same unit], where the axis turns, that nearest to it in whole turns. Where
    the rod does not reach B it is the reading at which it comes nearest.
    """
    actuator = leg.actuator
    if actuator is None:
        raise ValueError("a leg that hangs on no actuator has no reading of one")
    if not actuator.turns:
        along = (B - leg.A) @ actuator.axis
        across = np.sum((B - leg.A) ** 2, axis=1) - along**2
        half = np.sqrt(np.maximum(leg.q0**2 - across, 0.0))
        # d|AB|/dq = -u.d has the sign of the mode
        return np.asarray((along + leg.mode * half) / actuator.gain)
    w, arm, to_B = actuator.axis, leg.A - actuator.point, B - actuator.point
    height, radial = arm @ w, arm - (arm @ w) * w
    e1 = radial / np.linalg.norm(radial)
    e2 = cross(w, e1)
    radius = float(np.linalg.norm(radial))
    x, y, z = to_B @ e1, to_B @ e2, to_B @ w - height
    size = np.hypot(x, y)
    cosine = (size**2 + radius**2 + z**2 - leg.q0**2) / np.maximum(2.0 * radius * size, 1e-300)
    # |AB|^2 = r^2 + size^2 + z^2 - 2 r size cos(angle - towards): grows beyond the direction of B
    angle = np.arctan2(y, x) + leg.mode * np.arccos(np.clip(cosine, -1.0, 1.0))
    middle = 0.5 * sum(actuator.travel) if near is None else near
    q = angle / actuator.gain
    turn = 2.0 * np.pi / actuator.gain
    return np.asarray(q - turn * np.round((q - middle) / turn))


def rod_mode(leg: Leg, q: float, B: Array) -> int:
    """Return the working mode of a rod at a reading, with B (3,) in the frame of the base.

    It is the sign of d|AB|/dq: of the two readings at which a rod reaches B, the larger or smaller.
    """
    if leg.actuator is None:
        return leg.mode
    motion = leg.actuator.motion(leg.A, np.array([q]))
    return 1 if float((motion.A[0] - B) @ motion.by_q[0]) > 0.0 else -1


def actuators_in(legs: Sequence[Leg], T: RigidTransform) -> tuple[Actuator | None, ...]:
    """Return the actuator of each leg in another frame of the base."""
    matrix = T.as_matrix()
    moved = {a.joint: a.in_frame(matrix) for a in actuators_of(legs)}
    return tuple(None if leg.actuator is None else moved[leg.actuator.joint] for leg in legs)


def arm_rotation(actuator: Actuator, q: float) -> Rotation:
    """Return how what is fixed in the carriage or arm has turned at a reading."""
    return Rotation.from_matrix(actuator.rotations(np.array([q]))[0])
