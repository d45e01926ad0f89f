"""Order of poses, and intermediate poses on the path between them.

Between two poses, motors move in a straight line in joint space. A path is free if every pose on it
is feasible: inside limits, without collisions of legs, away from singularities.
"""

from __future__ import annotations

import numpy as np

from legcal.geometry.types import Array
from legcal.machine.configurations import Configurations, Feasibility, motor_travel
from legcal.machine.model import Machine, platform_pose, slider_columns

HOME = "home"
_STOPS = (0.2, 0.4, 0.6, 0.8, 1.0)  # checked points of a path
_SAME = 2.5e-6  # mean leg lengths, and entries of rotations
_ROUNDS = 20  # of 2-opt exchanges


def shortest_order(machine: Machine, poses: Configurations, begin: Array) -> list[int]:
    """Return an order of poses with short motor travel, from the configuration *begin*."""
    columns = slider_columns(machine, machine.motors)[0]
    lower, upper = motor_travel(machine)
    q = np.concatenate([begin[None], poses.configurations])[:, columns]
    q = q / (upper - lower)
    distance = np.abs(q[:, None] - q).max(axis=2)
    order, remaining = [0], set(range(1, len(q)))
    while remaining:
        order.append(min(remaining, key=lambda k: (distance[order[-1], k], k)))
        remaining.remove(order[-1])
    for _ in range(_ROUNDS):
        shorter = False
        for i in range(1, len(order) - 1):
            for j in range(i + 1, len(order)):
                next_leg = distance[order[j], order[j + 1]] if j + 1 < len(order) else 0.0
                joined = distance[order[i], order[j + 1]] if j + 1 < len(order) else 0.0
                gain = (
                    distance[order[i - 1], order[i]]
                    + next_leg
                    - distance[order[i - 1], order[j]]
                    - joined
                )
                if gain > 1e-12:
                    order[i : j + 1] = order[i : j + 1][::-1]
                    shorter = True
        if not shorter:
            break
    return [k - 1 for k in order[1:]]


def ways(machine: Machine, configurations: Array) -> tuple[tuple[str, ...], int]:
    """Return the intermediate pose before each pose, and the number of poses without a free path.

    The machine starts at home and takes the poses in order. The intermediate pose is "" for a free
    straight path, ``home``, or the 1-based number of an earlier pose.
    """
    if not machine.is_determined:
        return ("",) * len(configurations), 0
    feasibility, home = Feasibility(machine), machine.home_configuration
    free_paths: dict[tuple[int, int], bool] = {}
    stations = [home, *configurations]

    def is_free(a: int, b: int) -> bool:
        key = min(a, b), max(a, b)
        if key not in free_paths:
            free_paths[key] = _is_free(machine, feasibility, stations[key[0]], stations[key[1]])
        return free_paths[key]

    passed, n_blocked = [], 0
    for b in range(1, len(stations)):
        a = b - 1
        if is_free(a, b):
            passed.append("")
            continue
        candidates = [0, *range(b - 1, 0, -1)]
        via = next((k for k in candidates if k != a and is_free(a, k) and is_free(k, b)), None)
        n_blocked += via is None
        passed.append(HOME if not via else str(via))
    return tuple(passed), n_blocked


def _is_free(machine: Machine, feasibility: Feasibility, first: Array, last: Array) -> bool:
    """Whether the straight path between two configurations is free."""
    readings = last[slider_columns(machine, machine.motors)[0]]
    reached = feasibility.led(first, readings, _STOPS)
    if isinstance(reached, tuple):
        return False
    T, target = platform_pose(machine, reached), platform_pose(machine, last)
    difference = T.as_matrix() - target.as_matrix()
    difference[:3, 3] /= machine.size
    return bool(np.abs(difference).max() < _SAME)  # not another assembly mode
