"""Visuals of the motors of a new model: rails and carriages, motors and arms.

Sizes follow from the radius of the rods, except for cylindrical arms with a stated radius. No shape
is along a rod: cameras see them, but only cylindrical arms are measured.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from legcal.geometry.lines import cross, normal_basis
from legcal.geometry.types import Array
from legcal.machine.actuator import Actuator
from legcal.machine.assembly import AssembledLeg
from legcal.machine.spanning_tree import box_xml, origin_xml_at, visual_xml

THICK, WIDE = 2.0, 3.0  # size of arms and rails, in radii of a rod
MOTOR_RADIUS, MOTOR_LENGTH = 4.0, 8.0
BEHIND = 2.5  # distance of rails and carriages from the joints, away from the rods
_ROUND = 6  # decimals of sizes and positions [m], for display only


def motor_visuals(actuator: Actuator, rods: Sequence[AssembledLeg]) -> tuple[list[str], list[str]]:
    """Return the ``<visual>`` elements of a motor on the base, and on the link that it moves.

    The first are in the base link, the others relative to the point of the actuator in base axes,
    at reading 0. Without a visible rod there are none.
    """
    radii = [r for rod in rods for r in (rod.tube, rod.rod) if r is not None]
    if not radii:
        return [], []
    make = _turning if actuator.turns else _sliding
    return make(actuator, np.array([rod.A_base for rod in rods]), rods, max(radii))


def _turning(
    actuator: Actuator, A: Array, _rods: Sequence[AssembledLeg], r: float
) -> tuple[list[str], list[str]]:
    """Return a motor along the axis, an arm across it and a bar between the joints."""
    w, middle = actuator.axis, A.mean(axis=0)
    foot = actuator.point + ((middle - actuator.point) @ w) * w
    x = (middle - foot) / np.linalg.norm(middle - foot)
    frame = np.column_stack([x, cross(w, x), w])
    motor = visual_xml(_at(foot, frame), _rounded(MOTOR_RADIUS * r), _rounded(MOTOR_LENGTH * r))
    length = float(np.linalg.norm(middle - foot))
    place = 0.5 * (foot + middle) - actuator.point
    if actuator.arm is None:
        arm = _box(place, np.array([length, WIDE * r, THICK * r]), frame)
    else:
        along = np.column_stack([frame[:, 1], frame[:, 2], x])
        arm = visual_xml(_at(place, along), actuator.arm.radius, _rounded(length))
    return [motor], [arm, *_bar(A - actuator.point, frame, r)]


def _sliding(
    actuator: Actuator, A: Array, rods: Sequence[AssembledLeg], r: float
) -> tuple[list[str], list[str]]:
    """Return a rail along the direction, a carriage on it and a bar between the joints."""
    d, middle = actuator.axis, A.mean(axis=0)
    towards = np.mean([rod.u for rod in rods], axis=0)
    away = -(towards - (towards @ d) * d)
    if np.linalg.norm(away) < 1e-3:  # rods in line with it are side by side
        away = cross(d, A[-1] - A[0])
    if np.linalg.norm(away) < 1e-6:
        away = normal_basis(d)[0]
    y = away / np.linalg.norm(away)
    frame = np.column_stack([d, y, cross(d, y)])
    low, high = actuator.travel
    side = WIDE * r
    rail = np.array([high - low + 2.0 * side, side, side])
    on_rail = middle + (BEHIND * r + side) * y + 0.5 * (low + high) * d
    carriage = middle - actuator.point + BEHIND * r * y
    return [_box(on_rail, rail, frame)], [
        _box(carriage, np.array([2.0 * side, side, 2.0 * side]), frame),
        *_bar(A - actuator.point, frame, r),
    ]


def _bar(A: Array, frame: Array, r: float) -> list[str]:
    """Return the bar between the joints of one link, if there are several."""
    ends = A[[int(np.argmin(A @ frame[:, 2])), int(np.argmax(A @ frame[:, 2]))]]
    along = ends[1] - ends[0]
    length = float(np.linalg.norm(along))
    if length < r:
        return []
    z = along / length
    x = frame[:, 0] - (frame[:, 0] @ z) * z
    x /= np.linalg.norm(x)
    turned = np.column_stack([x, cross(z, x), z])
    return [_box(ends.mean(axis=0), np.array([THICK * r, THICK * r, length + WIDE * r]), turned)]


def _box(at: Array, sizes: Array, frame: Array) -> str:
    """Return a box of sizes (3,) along the axes of a frame."""
    return box_xml(_at(at, frame), np.round(sizes, _ROUND))


def _at(place: Array, frame: Array) -> str:
    return origin_xml_at(np.round(place, _ROUND), frame)


def _rounded(size: float) -> float:
    """Return a size, rounded for the file [m]."""
    return round(size, _ROUND)
