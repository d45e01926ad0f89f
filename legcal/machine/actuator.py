"""A motor between the base and the joint at A: a carriage or an arm on which rods hang.

A rod of constant length hangs at A, which moves with the reading q of the motor:

    prismatic  A(q) = a + g q d             d the direction of the carriage
    revolute   A(q) = c + Rot(w, g q)(a - c)    c a point of the axis, w its direction

a is A at reading 0, and the gain g is 1 unless it is estimated. Several rods may hang on one motor
(the arm of a Delta carries two): all have the same :class:`Actuator`, identified by its joint. A
cylindrical arm (:class:`Arm`) is visible to cameras: its line turns with A and need not meet it.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from enum import StrEnum
from functools import cached_property
from typing import Any, Literal

import numpy as np

from legcal.errors import BadValue
from legcal.geometry.lines import axis_angles, axis_angles_slope, cross, normal_basis, turned_axis
from legcal.geometry.motions import matrix_applied
from legcal.geometry.types import Array


class ActuatorKind(StrEnum):
    """The motion of a motor: translation or rotation."""

    PRISMATIC = "prismatic"
    REVOLUTE = "revolute"


class ActuatorColumns:
    """Columns of the actuator among the numbers of a leg (:class:`LegColumns`), after 12."""

    AXIS, POINT, GAIN = slice(12, 14), slice(14, 16), 16
    ARM_AXIS, ARM_POINT = slice(17, 19), slice(19, 21)
    LINE, ARM = slice(12, 16), slice(17, 21)  # the line of the axis, the line of the arm
    COUNT = 9


US_PER_DEG = (0.1, 1000.0)  # plausible range of |pulse width per degree| of hobby servos


@dataclass(frozen=True)
class Pulses:
    """The pulse widths that command a hobby servo; joint value 0 is at the centre pulse."""

    centre: float  # pulse width at joint value 0 [us]
    per_degree: float  # [us/deg], negative where longer pulses turn it backwards

    @staticmethod
    def stated(
        centre: float | None, per_degree: float | None, *, turns: bool = True
    ) -> Pulses | None:
        """Return the stated pulses, None if neither number is given.

        Raises BadValue if a number is missing or implausible for a servo, or the motor does not
        turn.
        """
        if centre is None and per_degree is None:
            return None
        if not turns:
            remedy = "leave out centre_us and us_per_deg"
            raise BadValue("pulses of a motor that slides", "one that turns", remedy)
        if centre is None or per_degree is None:
            missing = "centre_us" if centre is None else "us_per_deg"
            raise BadValue(
                f"no {missing}",
                "the pulse at joint value 0 (centre_us: 1500) and the us for one degree "
                "(us_per_deg: 11.1, negative for the other sense)",
                f"add {missing}",
            )
        least, most = US_PER_DEG
        if not (centre > 0.0 and least <= abs(per_degree) <= most):
            raise BadValue(
                f"centre_us {centre:g} and us_per_deg {per_degree:g}",
                f"a positive pulse, usually 1500, and {least:g} to {most:g} us for one degree "
                "either way, usually 5.6 to 11.1",
                "correct them",
            )
        return Pulses(centre, per_degree)

    def angles(self, pulses: Array) -> Array:
        """Return the joint values [rad] of pulses [us]."""
        return np.asarray(np.radians((pulses - self.centre) / self.per_degree))


@dataclass(frozen=True, eq=False)
class Line:
    """A line in space; its four numbers are two rotations of its axis and two offsets across it."""

    point: Array  # (3,) any point of it [m]
    axis: Array  # (3,) unit

    @cached_property
    def across(self) -> Array:
        """Two directions perpendicular to the axis (2, 3), along which it rotates and moves."""
        return normal_basis(self.axis)

    def moved(self, step: Array) -> Line:
        """Return the line after a step (4,): rotations of its axis, displacements across it."""
        point = self.point + step[2:] @ self.across
        return Line(point, turned_axis(self.axis, step[:2]))

    def in_frame(self, T_to_from: Array) -> Line:
        """Return the line in another frame, T_to_from (4, 4)."""
        return Line(matrix_applied(T_to_from, self.point), T_to_from[:3, :3] @ self.axis)

    def numbers(self, nominal: Line) -> Array:
        """Return the four numbers (4,): rotations of the axis from the nominal one, and offsets.

        The offsets are those of its intersection with the nominal plane (perpendicular to the
        nominal axis, through the nominal point) from the nominal point.
        """
        crossing = self._crossing(nominal)[0] - nominal.point
        place = nominal.across @ crossing
        return np.array([*axis_angles(self.axis, nominal.axis), *place])

    def numbers_slope(self, nominal: Line) -> Array:
        """Return the derivative (4, 4) of :meth:`numbers` by a step of :meth:`moved`."""
        slope, basis, w0 = np.zeros((4, 4)), self.across, nominal.axis
        _, s, along = self._crossing(nominal)
        onto = nominal.across @ (np.eye(3) - np.outer(self.axis, w0) / along)
        slope[:2, :2] = axis_angles_slope(self.axis, w0)
        slope[2:, :2] = s * onto @ cross(basis, self.axis).T
        slope[2:, 2:] = onto @ basis.T
        return slope

    def _crossing(self, nominal: Line) -> tuple[Array, float, float]:
        """Return the point on the nominal plane, its distance along the line, and w . w0."""
        along = float(self.axis @ nominal.axis)
        s = float((nominal.point - self.point) @ nominal.axis) / along
        return self.point + s * self.axis, s, along

    @staticmethod
    def with_numbers(nominal: Line, numbers: Array) -> Line:
        """Return the line with these four numbers; the inverse of :meth:`numbers`."""
        point = nominal.point + numbers[2:] @ nominal.across
        return Line(point, turned_axis(nominal.axis, numbers[:2]))


@dataclass(frozen=True, eq=False)
class Arm:
    """The visible cylinder of an arm, with its motor at reading 0."""

    line: Line  # axis of the cylinder through its middle, in the frame of the actuator
    length: float  # [m]
    radius: float  # [m]
    link: str  # the URDF link that carries the visual; it names the part in observations
    leg: str  # the rod under which observations list the arm: the first on its motor

    @property
    def ends(self) -> Array:
        """Both ends of its axis (2, 3) [m]."""
        half = np.array([[-0.5], [0.5]]) * self.length
        return np.asarray(self.line.point + half * self.line.axis)

    def ends_slope(self) -> Array:
        """Return the derivatives of both ends (2, 3, 4) by a step of :meth:`Line.moved`."""
        basis = self.line.across
        half = np.array([-0.5, 0.5])[:, None, None] * self.length
        turned = half * cross(basis, self.line.axis).T
        return np.concatenate([turned, np.broadcast_to(basis.T, turned.shape)], axis=2)


@dataclass(frozen=True, eq=False)
class Actuator:
    """A motor that carries joints at A, in the frame of its legs: the base link, or R_b."""

    joint: str  # the URDF joint, whose value is the reading [m or rad]
    kind: ActuatorKind
    axis: Array  # (3,) unit: d of a prismatic, w of a revolute
    point: Array  # (3,) a point of a revolute's axis [m]; of a prismatic the origin of its joint
    travel: tuple[float, float]  # limits of the joint [m or rad]
    link: str = ""  # the carriage or arm
    gain: float = 1.0  # true motion over reading
    pulses: Pulses | None = None  # of a hobby servo
    arm: Arm | None = None  # the visible cylinder, if the arm is one

    @cached_property
    def line(self) -> Line:
        """The axis of a revolute, as a line."""
        return Line(self.point, self.axis)

    @property
    def turns(self) -> bool:
        """Whether it is a revolute."""
        return self.kind is ActuatorKind.REVOLUTE

    @property
    def unit(self) -> Literal["m", "rad"]:
        """The unit of its readings."""
        return "rad" if self.turns else "m"

    def with_arm(self, A: Array, radius: float, leg: str) -> Actuator:
        """Return the actuator with a round arm, from its axis to the middle of A (n, 3)."""
        middle = A.mean(axis=0)
        along = middle - self.point
        along = along - (along @ self.axis) * self.axis
        length = float(np.linalg.norm(along))
        line = Line(middle - 0.5 * along, along / length)
        return replace(self, arm=Arm(line, length, radius, self.link, leg))

    def rotations(self, q: Array) -> Array:
        """Return the rotations (k, 3, 3) of the carriage or arm at readings (k,)."""
        return self.motion(self.point, q).by_A

    def at(self, A: Array, q: Array) -> Array:
        """Return the joint centre (k, 3) at readings (k,); it is at A (3,) at reading 0."""
        return self.motion(A, q).A

    def motion(self, A: Array, q: Array) -> JointMotion:
        """Return the motion of the joint centre that is at A (3,) at reading 0."""
        return JointMotion(self, A, np.asarray(q, dtype=np.float64))

    def moved(self, step: Array) -> Actuator:
        """Return the actuator after a step (9,): its axis (rotations, point), gain and arm."""
        arm = self.arm
        return replace(
            self.with_line(self.line.moved(step[:4])),
            gain=self.gain + float(step[4]),
            arm=None if arm is None else replace(arm, line=arm.line.moved(step[5:])),
        )

    def with_line(self, line: Line) -> Actuator:
        """Return the actuator with another axis."""
        return replace(self, axis=line.axis, point=line.point)

    def in_frame(self, T_to_from: Array) -> Actuator:
        """Return the actuator in another frame, T_to_from (4, 4)."""
        line, arm = self.line.in_frame(T_to_from), self.arm
        moved = None if arm is None else replace(arm, line=arm.line.in_frame(T_to_from))
        return replace(self.with_line(line), arm=moved)

    def numbers(self, nominal: Actuator) -> Array:
        """Return the nine numbers (9,): four of the axis, the gain, four of the line of the arm.

        Lines are :meth:`Line.numbers`; offsets of a prismatic and numbers of a missing arm are
        zero.
        """
        axis, arm = self.line.numbers(nominal.line), np.zeros(4)
        if not self.turns:
            axis[2:] = 0.0
        if self.arm is not None and nominal.arm is not None:
            arm = self.arm.line.numbers(nominal.arm.line)
        return np.array([*axis, self.gain, *arm])

    def numbers_slope(self, nominal: Actuator) -> Array:
        """Return the derivative (9, 9) of :meth:`numbers` by a step of :meth:`moved`."""
        slope = np.eye(ActuatorColumns.COUNT)
        slope[:4, :4] = self.line.numbers_slope(nominal.line)
        if not self.turns:
            slope[2:4, :4] = np.eye(4)[2:]
        if self.arm is not None and nominal.arm is not None:
            slope[5:, 5:] = self.arm.line.numbers_slope(nominal.arm.line)
        return slope

    def with_numbers(self, nominal: Actuator, numbers: Array) -> Actuator:
        """Return the actuator with these nine numbers; the inverse of :meth:`numbers`."""
        line, arm = Line.with_numbers(nominal.line, numbers[:4]), self.arm
        if arm is not None and nominal.arm is not None:
            arm = replace(arm, line=Line.with_numbers(nominal.arm.line, numbers[5:]))
        point = line.point if self.turns else self.point
        return replace(self, axis=line.axis, point=point, gain=float(numbers[4]), arm=arm)

    def placed(self, document: Mapping[str, Any]) -> Actuator:
        """Return the actuator as a result document places it; the inverse of :meth:`document`."""
        if not self.turns:
            return replace(self, axis=np.array(document["direction"]))
        axis, point, arm = np.array(document["axis"]), np.array(document["point"]), self.arm
        if arm is not None and (there := document.get("arm")) is not None:
            line = Line(np.array(there["point"]), np.array(there["axis"]))
            arm = replace(arm, line=line)
        return replace(self, axis=axis, point=point, arm=arm)

    def document(self) -> dict[str, Any]:
        """Return the actuator as an entry of result files, in its frame."""
        if not self.turns:
            return {"kind": self.kind.value, "direction": self.axis.tolist()}
        document: dict[str, Any] = {
            "kind": self.kind.value,
            "point": self.point.tolist(),
            "axis": self.axis.tolist(),
        }
        if self.arm is None:
            return document
        line = self.arm.line
        arm = {"link": self.arm.link, "point": line.point.tolist(), "axis": line.axis.tolist()}
        return document | {"arm": arm}


@dataclass(frozen=True, eq=False)
class JointMotion:
    """A joint centre on an actuator at k readings, and its derivatives."""

    actuator: Actuator
    at_zero: Array  # (3,) the joint centre at reading 0 [m]
    q: Array  # (k,) readings [m or rad]

    @cached_property
    def angle(self) -> Array:
        """The rotation of a revolute, (k,) [rad]; zero for a prismatic."""
        return np.asarray(self.actuator.gain * self.q * self.actuator.turns)

    @cached_property
    def _arm(self) -> Array:
        """From the point of the axis to the joint, (k, 3) [m]: Rodrigues' formula."""
        w, arm, angle = self.actuator.axis, self.at_zero - self.actuator.point, self.angle[:, None]
        along = (arm @ w) * w
        return np.asarray(along + np.cos(angle) * (arm - along) + np.sin(angle) * cross(w, arm))

    @cached_property
    def A(self) -> Array:
        """The joint centre, (k, 3) [m]."""
        if self.actuator.turns:
            return np.asarray(self.actuator.point + self._arm)
        return np.asarray(self.at_zero + self.actuator.gain * self.q[:, None] * self.actuator.axis)

    @cached_property
    def by_A(self) -> Array:
        """The derivative (k, 3, 3) by A at reading 0, which is also the rotation of the arm."""
        w, angle = self.actuator.axis, self.angle[:, None, None]
        K = np.array([[0.0, -w[2], w[1]], [w[2], 0.0, -w[0]], [-w[1], w[0], 0.0]])
        return np.asarray(np.eye(3) + np.sin(angle) * K + (1.0 - np.cos(angle)) * (K @ K))

    @cached_property
    def by_axis(self) -> Array:
        """The derivative (k, 3, 2) by rotations of the axis about its normal_basis."""
        basis, arm = self.actuator.line.across, self.at_zero - self.actuator.point
        if not self.actuator.turns:
            across = cross(basis, self.actuator.axis).T
            return np.asarray(self.actuator.gain * self.q[:, None, None] * across)
        return np.stack([cross(e, self._arm) - self.by_A @ cross(e, arm) for e in basis], axis=2)

    @cached_property
    def by_point(self) -> Array:
        """The derivative (k, 3, 2) by displacements of the axis along its normal_basis."""
        return np.asarray((np.eye(3) - self.by_A) @ self.actuator.line.across.T)

    @cached_property
    def _by_true_motion(self) -> Array:
        """The derivative (k, 3) by the angle of a revolute, or the displacement of a prismatic."""
        w = self.actuator.axis
        return cross(w, self._arm) if self.actuator.turns else np.tile(w, (len(self.q), 1))

    @property
    def by_gain(self) -> Array:
        """The derivative (k, 3) by the gain."""
        return np.asarray(self.q[:, None] * self._by_true_motion)

    @property
    def by_q(self) -> Array:
        """The derivative (k, 3) by the reading [1, or m/rad]."""
        return np.asarray(self.actuator.gain * self._by_true_motion)
