"""What carries the ends of rods: which hang on which, where A and B are, and at which readings.

See :mod:`legcal.machine.actuator` for how A and B move. The coordinates of a machine at a pose are
the readings of its actuators, and after them those of the joints inside its platform.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from scipy.spatial.transform import RigidTransform

from legcal.geometry.lines import cross
from legcal.geometry.types import Array, IntArray
from legcal.machine.actuator import Actuator
from legcal.machine.leg import Leg
from legcal.machine.solver import solve

_CLOSED = 1e-15  # [m], of the lengths of rods
_MAX_STEP = 0.3  # [rad or m] of an internal joint towards where rods hold it
_STALLED = 3  # steps that hardly improve: the squares are least there
AT_ZERO = ", where their motors read 0"  # what is said of joints A that move, after their name


def actuators_of(legs: Sequence[Leg]) -> tuple[Actuator, ...]:
    """Return the actuators of legs, each once, in the order of their first legs."""
    return _each_once([leg.actuator for leg in legs])


def actuator_index(legs: Sequence[Leg]) -> list[int]:
    """Return which of :func:`actuators_of` each leg hangs on, -1 for none."""
    return _places([leg.actuator for leg in legs])


def internal_joints_of(legs: Sequence[Leg]) -> tuple[Actuator, ...]:
    """Return the joints inside a platform of several bodies, each once, by their first legs."""
    return _each_once([leg.internal for leg in legs])


def internal_index(legs: Sequence[Leg]) -> list[int]:
    """Return which of :func:`internal_joints_of` carries B of each leg, -1 for none."""
    return _places([leg.internal for leg in legs])


def _each_once(joints: Sequence[Actuator | None]) -> tuple[Actuator, ...]:
    """Return the joints that carry ends of legs, each once, in the order of their first legs."""
    found: dict[str, Actuator] = {}
    for joint in joints:
        if joint is not None:
            found.setdefault(joint.joint, joint)
    return tuple(found.values())


def _places(joints: Sequence[Actuator | None]) -> list[int]:
    """Return which of :func:`_each_once` each leg has, -1 for none."""
    number = {joint.joint: i for i, joint in enumerate(_each_once(joints))}
    return [-1 if joint is None else number[joint.joint] for joint in joints]


@dataclass(frozen=True, eq=False)
class Carried:
    """Many points that ride on joints, each on its path (:meth:`Actuator.path`)."""

    on: IntArray  # (n,) which joint carries each, of those that are counted once; -1 for none
    gain: Array  # (n,) of joints that turn
    middle: Array  # (n, 3), as the others [m]
    cos: Array
    sin: Array
    slide: Array

    @classmethod
    def of(cls, points: Array, joints: Sequence[Actuator | None]) -> Carried:
        """Return points (n, 3), where their joints are at 0, on a joint each."""
        middle, cos, sin, slide = points.copy(), *(np.zeros_like(points) for _ in range(3))
        gain = np.zeros(len(points))
        for j, joint in enumerate(joints):
            if joint is not None:
                middle[j], cos[j], sin[j], slide[j] = joint.path(points[j])
                gain[j] = joint.gain if joint.turns else 0.0
        return cls(np.array(_places(joints), dtype=np.intp), gain, middle, cos, sin, slide)

    def at(self, q: Array) -> Array:
        """Return the points (k, n, 3) at coordinates of joints (k, n_joints)."""
        own, angle = self._own(q)
        found = self.middle + self.cos * np.cos(angle) + self.sin * np.sin(angle)
        return np.asarray(found + self.slide * own)

    def by_coordinate(self, q: Array) -> Array:
        """Return how each point moves with its joint there, (k, n, 3)."""
        _, angle = self._own(q)
        turning = self.sin * np.cos(angle) - self.cos * np.sin(angle)
        return np.asarray(self.gain[:, None] * turning + self.slide)

    def _own(self, q: Array) -> tuple[Array, Array]:
        """Return the coordinate of the joint of each point, and its angle, (k, n, 1)."""
        own = np.zeros((len(q), len(self.on)))
        carried = self.on >= 0
        own[:, carried] = q[:, self.on[carried]]
        return own[..., None], (self.gain * own)[..., None]


@lru_cache(maxsize=16)
def carried_at_A(legs: tuple[Leg, ...]) -> Carried:
    """Return the joints A of legs, which ride on actuators."""
    A = np.array([leg.A for leg in legs]).reshape(-1, 3)
    return Carried.of(A, [leg.actuator for leg in legs])


@lru_cache(maxsize=16)
def carried_at_B(legs: tuple[Leg, ...]) -> Carried:
    """Return the joints B of legs, which ride on joints inside the platform."""
    B = np.array([leg.B for leg in legs]).reshape(-1, 3)
    return Carried.of(B, [leg.internal for leg in legs])


def platform_joints_at(legs: Sequence[Leg], s: Array) -> Array:
    """Return B of legs (k, n_legs, 3) [m] in a platform whose internal joints are at s (k, n)."""
    return carried_at_B(tuple(legs)).at(s)


def joints_at(legs: Sequence[Leg], q: Array) -> Array:
    """Return the joints A of legs (k, n_legs, 3) [m] at readings of actuators (k, n_actuators)."""
    return carried_at_A(tuple(legs)).at(q)


def arms_at(legs: Sequence[Leg], q: Array) -> dict[int, Array]:
    """Return the ends (k, 2, 3) [m] of arms at readings of actuators (k, n_actuators).

    They are by the legs that have them as parts (:attr:`Leg.arm`), in the frame of A.
    """
    on, found = actuator_index(legs), dict[int, Array]()
    for j, leg in enumerate(legs):
        if leg.actuator is not None and leg.arm is not None:
            ends = [leg.actuator.at(end, q[:, on[j]]) for end in leg.arm.ends]
            found[j] = np.stack(ends, axis=1)
    return found


def ends_at_poses(
    legs: Sequence[Leg], R: Array, t: Array, q: Array | None = None
) -> tuple[Array, Array]:
    """Return A and B of legs (k, n_legs, 3) [m] in the frame of the base at poses R, t.

    Joints at A that move are where readings q (k, n_actuators) have them, or without these where
    the first rod on their actuator reaches the platform.
    """
    c = coordinates_at(legs, R, t, q)
    n = len(actuators_of(legs))
    return joints_at(legs, c[:, :n]), _in_base(R, t, platform_joints_at(legs, c[:, n:]))


def _in_base(R: Array, t: Array, B: Array) -> Array:
    """Return points B (k, n, 3) of the platform in the frame of the base, at poses R, t."""
    return np.asarray(B @ np.swapaxes(R, 1, 2) + t[:, None])


def ends_in_base(
    legs: Sequence[Leg], T_base_Rb: RigidTransform, R: Array, t: Array, q: Array | None = None
) -> tuple[Array, Array]:
    """Return what :func:`ends_at_poses` does, of legs in R_b, in the base link."""
    A, B = (
        T_base_Rb.apply(ends.reshape(-1, 3)).reshape(ends.shape)
        for ends in ends_at_poses(legs, R, t, q)
    )
    return A, B


def reading_legs(legs: Sequence[Leg]) -> tuple[int, ...]:
    """Return the index of the leg whose encoder reads each leg: rods on one motor share one."""
    first: dict[str | None, int] = {}
    return tuple(
        j if leg.actuator is None else first.setdefault(leg.actuator.joint, j)
        for j, leg in enumerate(legs)
    )


def first_rods(legs: Sequence[Leg]) -> list[int]:
    """Return the first leg on each of :func:`actuators_of`."""
    return sorted({j for j in reading_legs(legs) if legs[j].actuator is not None})


def readings_of_rods(legs: Sequence[Leg], R: Array, t: Array) -> Array:
    """Return the readings of actuators (k, n) at poses R, t: those of the first rod on each."""
    return coordinates_at(legs, R, t)[:, : len(actuators_of(legs))]


def coordinates_at(
    legs: Sequence[Leg], R: Array, t: Array, q: Array | None = None, s: Array | None = None
) -> Array:
    """Return readings of actuators and then coordinates of internal joints, (k, n), at poses R, t.

    Readings are *q* (k, n_actuators), or one row for all, if they are given, else those at which
    the first rod on each actuator reaches the platform. Internal joints stand where rods miss their
    lengths least, near *s* (k, n), or near zero: there if the pose leaves them free, as on an I4.
    """
    s = np.zeros((len(t), len(internal_joints_of(legs)))) if s is None else s
    q = None if q is None else np.broadcast_to(q, (len(t), q.shape[1]))
    if s.shape[1]:
        found = solve(
            lambda points: _missed_lengths(legs, R, t, points, q),
            lambda points, step: points + np.clip(step, -_MAX_STEP, _MAX_STEP),
            s,
            tolerance=_CLOSED,
            damped=True,
            max_stalled=_STALLED,
        )
        s = found.points
    if q is None:
        q = _readings_at(legs, _in_base(R, t, platform_joints_at(legs, s)))
    return np.concatenate([q, s], axis=1)


def _readings_at(legs: Sequence[Leg], B: Array) -> Array:
    """Return the readings (k, n) at which the first rods on actuators reach B (k, n_legs, 3)."""
    first = first_rods(legs)
    q = np.zeros((len(B), len(first)))
    for a, j in enumerate(first):
        q[:, a] = reading_of_rod(legs[j], B[:, j])
    return q


def _missed_lengths(
    legs: Sequence[Leg], R: Array, t: Array, s: Array, q: Array | None
) -> tuple[Array, Array]:
    """Return what rods on actuators miss at internal coordinates s (k, n) [m], and the slopes by s.

    Without readings q what these can make good is left out of both.
    """
    at_A, at_B = carried_at_A(tuple(legs)), carried_at_B(tuple(legs))
    rods = np.flatnonzero(at_A.on >= 0)
    B = _in_base(R, t, at_B.at(s))
    read = _readings_at(legs, B) if q is None else q
    vectors = (B - at_A.at(read))[:, rods]
    length = np.linalg.norm(vectors, axis=2)
    u = vectors / length[..., None]
    values = length - np.array([leg.q0 for leg in legs])[rods]
    slopes = np.zeros((*length.shape, s.shape[1]))
    on_inside = np.flatnonzero(at_B.on[rods] >= 0)
    by_s = at_B.by_coordinate(s)[:, rods[on_inside]] @ np.swapaxes(R, 1, 2)
    slopes[:, on_inside, at_B.on[rods[on_inside]]] = np.sum(u[:, on_inside] * by_s, axis=2)
    by_q = np.zeros((*length.shape, read.shape[1]))
    if q is None:
        by_reading = at_A.by_coordinate(read)[:, rods]
        by_q[:, np.arange(len(rods)), at_A.on[rods]] = np.sum(u * by_reading, axis=2)
    if q is None:
        by_q /= np.maximum(np.linalg.norm(by_q, axis=1, keepdims=True), 1e-300)
        left = np.eye(len(rods)) - by_q @ np.swapaxes(by_q, 1, 2)
        values, slopes = (left @ values[..., None])[..., 0], left @ slopes
    return values, slopes


def measured_readings(legs: Sequence[Leg], R: Array, t: Array, q: Array) -> Array:
    """Return the readings of actuators (k, n) at poses R, t: the measured ones of q (k, n_legs).

    Elsewhere, where it is NaN, the first rod on the actuator reaches the pose. Beyond a turning
    point, where that rod stands square to its motion, the pose alone gives another reading.
    """
    read = np.asarray(q, dtype=np.float64)[:, first_rods(legs)]
    return np.where(np.isfinite(read), read, readings_of_rods(legs, R, t))


def reading_of_rod(leg: Leg, B: Array) -> Array:
    """Return the readings (k,) at which a rod reaches points B (k, 3) in the frame of the base.

    |A(q) - B| = l has two solutions; the one is taken in whose mode the rod is (``Leg.mode``), of a
    motor that turns the one nearest to the middle of its travel in whole turns. Where the rod does
    not reach B it is the reading at which it comes nearest.
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
    middle = 0.5 * sum(actuator.travel)
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
