"""Actuators that carry the joints A of rods: their rods, positions of A, and readings.

See :mod:`legcal.machine.actuator` for how A moves with the reading of its actuator.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from scipy.spatial.transform import RigidTransform

from legcal.geometry.lines import cross
from legcal.geometry.types import Array
from legcal.machine.actuator import Actuator
from legcal.machine.leg import Leg

AT_ZERO = ", where their motors read 0"  # added after the name of moving joints A


def actuators_of(legs: Sequence[Leg]) -> tuple[Actuator, ...]:
    """Return the actuators of legs, each once, in the order of their first legs."""
    actuators: dict[str, Actuator] = {}
    for leg in legs:
        if leg.actuator is not None:
            actuators.setdefault(leg.actuator.joint, leg.actuator)
    return tuple(actuators.values())


def actuator_index(legs: Sequence[Leg]) -> list[int]:
    """Return the index of the actuator (:func:`actuators_of`) of each leg, -1 for none."""
    number = {actuator.joint: i for i, actuator in enumerate(actuators_of(legs))}
    return [-1 if leg.actuator is None else number[leg.actuator.joint] for leg in legs]


def joints_at(legs: Sequence[Leg], q: Array) -> Array:
    """Return the joints A of legs (k, n_legs, 3) [m] at readings of actuators (k, n_actuators)."""
    A = np.tile(np.array([leg.A for leg in legs]).reshape(-1, 3), (len(q), 1, 1))
    for j, (leg, a) in enumerate(zip(legs, actuator_index(legs), strict=True)):
        if leg.actuator is not None:
            A[:, j] = leg.actuator.at(leg.A, q[:, a])
    return A


def arms_at(legs: Sequence[Leg], q: Array) -> dict[int, Array]:
    """Return the ends (k, 2, 3) [m] of arms at readings of actuators (k, n_actuators).

    The keys are the legs that have arms as parts (:attr:`Leg.arm`); the ends are in the frame of A.
    """
    on, arms = actuator_index(legs), dict[int, Array]()
    for j, leg in enumerate(legs):
        if leg.actuator is not None and leg.arm is not None:
            ends = [leg.actuator.at(end, q[:, on[j]]) for end in leg.arm.ends]
            arms[j] = np.stack(ends, axis=1)
    return arms


def ends_at_poses(
    legs: Sequence[Leg], R: Array, t: Array, q: Array | None = None
) -> tuple[Array, Array]:
    """Return A and B of legs (k, n_legs, 3) [m] in the base frame at poses R, t.

    Moving joints at A follow readings q (k, n_actuators), or without these the position where the
    first rod of their actuator reaches the platform.
    """
    q = readings_of_rods(legs, R, t) if q is None else np.broadcast_to(q, (len(t), q.shape[1]))
    return joints_at(legs, q), _platform_joints(legs, R, t)


def length_errors(legs: Sequence[Leg], R: Array, t: Array, q: Array) -> Array:
    """Return |AB| minus the lengths at readings q (k, n_legs) of legs at poses, (k, n_legs) [m]."""
    A, B = ends_at_poses(legs, R, t, q[:, first_rods(legs)])
    sign = [0 if leg.actuator is not None else leg.sign for leg in legs]
    return np.asarray(np.linalg.norm(B - A, axis=2) - [leg.q0 for leg in legs] - q * sign)


def _platform_joints(legs: Sequence[Leg], R: Array, t: Array) -> Array:
    """Return B of legs (k, n_legs, 3) [m] in the base frame at poses R, t."""
    B = np.array([leg.B for leg in legs]).reshape(-1, 3)
    return np.asarray(B @ np.swapaxes(R, 1, 2) + t[:, None])


def ends_in_base(
    legs: Sequence[Leg], T_base_Rb: RigidTransform, R: Array, t: Array, q: Array | None = None
) -> tuple[Array, Array]:
    """Return :func:`ends_at_poses` of legs in R_b, transformed to the base link."""
    A, B = (
        T_base_Rb.apply(ends.reshape(-1, 3)).reshape(ends.shape)
        for ends in ends_at_poses(legs, R, t, q)
    )
    return A, B


def reading_legs(legs: Sequence[Leg]) -> tuple[int, ...]:
    """Return the index of the leg whose encoder reads each leg; rods on one motor share it."""
    first: dict[str | None, int] = {}
    return tuple(
        j if leg.actuator is None else first.setdefault(leg.actuator.joint, j)
        for j, leg in enumerate(legs)
    )


def first_rods(legs: Sequence[Leg]) -> list[int]:
    """Return the first leg on each of :func:`actuators_of`."""
    return sorted({j for j in reading_legs(legs) if legs[j].actuator is not None})


def readings_of_rods(legs: Sequence[Leg], R: Array, t: Array) -> Array:
    """Return the readings of actuators (k, n) at poses R, t, from the first rod on each."""
    first = first_rods(legs)
    q = np.zeros((len(t), len(first)))
    if first:
        B = _platform_joints(legs, R, t)
        for a, j in enumerate(first):
            q[:, a] = reading_of_rod(legs[j], B[:, j])
    return q


def measured_readings(legs: Sequence[Leg], R: Array, t: Array, q: Array) -> Array:
    """Return the readings of actuators (k, n) at poses R, t, the measured ones from q (k, n_legs).

    Where q is NaN the first rod on the actuator determines it from the pose; beyond a turning
    point, with the rod perpendicular to its motion, that gives a different reading.
    """
    read = np.asarray(q, dtype=np.float64)[:, first_rods(legs)]
    return np.where(np.isfinite(read), read, readings_of_rods(legs, R, t))


def reading_of_rod(leg: Leg, B: Array) -> Array:
    """Return the readings (k,) at which a rod reaches points B (k, 3) in the base frame.

    |A(q) - B| = l has two solutions; the one in the mode of the rod (``Leg.mode``) is taken, for a
    motor that turns modulo full turns nearest to the middle of its travel. If the rod does not
    reach B it is the reading at which it comes nearest.
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


def both_readings(leg: Leg, B: Array) -> list[float]:
    """Return the two readings at which a rod reaches a point B (3,) in the base frame."""
    return [float(reading_of_rod(replace(leg, mode=mode), B[None])[0]) for mode in (1, -1)]


def rod_mode(leg: Leg, q: float, B: Array) -> int:
    """Return the working mode of a rod at a reading, with B (3,) in the base frame.

    It is the sign of d|AB|/dq, which selects one of the two readings at which the rod reaches B.
    """
    if leg.actuator is None:
        return leg.mode
    motion = leg.actuator.motion(leg.A, np.array([q]))
    return 1 if float((motion.A[0] - B) @ motion.by_q[0]) > 0.0 else -1
