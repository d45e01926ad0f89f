"""The order in which poses are taken, and what to pass on the way between them.

Between two poses motors move together in a straight line. A way counts if the machine can be
everywhere on it: inside its limits, no leg through another, no singularity near.
"""

from __future__ import annotations

import numpy as np

from legcal.geometry.types import Array
from legcal.machine.configurations import Configurations
from legcal.machine.feasibility import Feasibility, motor_travel
from legcal.machine.model import Machine, platform_pose, slider_columns

HOME = "home"
_STOPS = (0.2, 0.4, 0.6, 0.8, 1.0)  # parts of a way that are looked at
_SAME = 2.5e-6  # mean leg lengths, and entries of rotations
_ROUNDS = 20  # of exchanges for a shorter way


def in_short_order(machine: Machine, poses: Configurations, begin: Array) -> list[int]:
    """Return an order of poses in which the motors travel little, from where a machine begins."""
    columns = slider_columns(machine, machine.motors)[0]
    lower, upper = motor_travel(machine)
    q = np.concatenate([begin[None], poses.configurations])[:, columns]
    q = q / (upper - lower)
    far = np.abs(q[:, None] - q).max(axis=2)
    order, left = [0], set(range(1, len(q)))
    while left:
        order.append(min(left, key=lambda k: (far[order[-1], k], k)))
        left.remove(order[-1])
    for _ in range(_ROUNDS):
        shorter = False
        for i in range(1, len(order) - 1):
            for j in range(i + 1, len(order)):
                after = far[order[j], order[j + 1]] if j + 1 < len(order) else 0.0
                new = far[order[i], order[j + 1]] if j + 1 < len(order) else 0.0
                gain = far[order[i - 1], order[i]] + after - far[order[i - 1], order[j]] - new
                if gain > 1e-12:
                    order[i : j + 1] = order[i : j + 1][::-1]
                    shorter = True
        if not shorter:
            break
    return [k - 1 for k in order[1:]]


def ways(machine: Machine, configurations: Array) -> tuple[tuple[str, ...], int]:
    """Return what to pass before each pose, and for how many poses no way was found.

    The machine begins at home and takes all poses of all views in turn. What it passes is "" where
    the straight way is free, ``home``, or an earlier pose, as its place from 1.
    """
    if not machine.is_determined:
        return ("",) * len(configurations), 0
    feasibility, home = Feasibility(machine), machine.home_configuration
    known: dict[tuple[int, int], bool] = {}
    stations = [home, *configurations]

    def is_free(a: int, b: int) -> bool:
        key = min(a, b), max(a, b)
        if key not in known:
            known[key] = _is_free(machine, feasibility, stations[key[0]], stations[key[1]])
        return known[key]

    found, missing = [], 0
    for b in range(1, len(stations)):
        a = b - 1
        if is_free(a, b):
            found.append("")
            continue
        others = [0, *range(b - 1, 0, -1)]
        via = next((k for k in others if k != a and is_free(a, k) and is_free(k, b)), None)
        missing += via is None
        found.append(HOME if not via else str(via))
    return tuple(found), missing


def _is_free(machine: Machine, feasibility: Feasibility, first: Array, last: Array) -> bool:
    """Say whether the machine can go straight from one configuration to another."""
    readings = last[slider_columns(machine, machine.motors)[0]]
    there = feasibility.led(first, readings, _STOPS)
    if isinstance(there, tuple):
        return False
    T, wanted = platform_pose(machine, there), platform_pose(machine, last)
    off = T.as_matrix() - wanted.as_matrix()
    off[:3, 3] /= machine.size
    return bool(np.abs(off).max() < _SAME)  # not a mirrored one
