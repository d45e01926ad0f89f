"""Candidate poses of a session: feasible for every machine within tolerance."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from legcal.calibration.joint_fit.platform import poses_at_readings
from legcal.calibration.joint_fit.variables import FittedLegs
from legcal.errors import DidNotConverge
from legcal.estimation.problem import Frames
from legcal.geometry.types import Array, BoolArray
from legcal.machine.configurations import (
    Configurations,
    Feasibility,
    feasible_poses,
    motor_travel,
    poses_at,
)
from legcal.machine.kinematics import follow, platforms_in_base
from legcal.machine.leg import ARMS, Leg, LegKind, ParameterId
from legcal.machine.model import Machine, platform_pose, slider_columns
from legcal.machine.parameters import is_held_by_default, moved_legs
from legcal.machine.rods import length_errors
from legcal.planning.places import USUAL_LENGTH, Setting
from legcal.progress import Report, no_progress

N_REACHING = 10  # random machines that must reach a pose
_WIDER = 1.5  # their tolerance, over the stated one
N_NEAR = 3  # candidates near each pose
_MIN_SHARE = 0.2  # of the drawn poses, that must be usable
_MOST_MOVED = 0.1  # leg lengths: largest motion of a pose by errors of the machine
_CLOSED = 2.5e-7  # mean leg lengths: residual of a reached pose
_HALF_WAY = 0.5  # least step towards a pose nearby


def candidate_poses(
    machine: Machine,
    legs: FittedLegs,
    setting: Setting,
    n: int,
    rng: np.random.Generator,
    progress: Report = no_progress,
) -> Configurations:
    """Draw feasible poses, half of them extreme.

    Raises DidNotConverge if there are too few.
    """
    configurations: list[Array] = []
    for extreme in (True, False):
        drawn = feasible_poses(machine, n // 2, rng, extreme=extreme, progress=progress)
        kept = surely_reached(machine, legs, setting, drawn)
        configurations += [drawn.configurations[k] for k in np.flatnonzero(kept)]
    if len(configurations) < max(_MIN_SHARE * n, 1):
        remedies = [
            "check legcal.home and the limits of the joints",
            "plan with a smaller length in Setting (in Python), if it is known better",
        ]
        if setting.length > USUAL_LENGTH * machine.size:
            remedies.reverse()
        raise DidNotConverge(
            f"{machine.yaml_path}: no session could be planned: the machine reaches only "
            f"{len(configurations)} of {n} poses at the same readings if its joints are "
            f"{1e3 * setting.length:.2g} mm off, needed {_MIN_SHARE * n:.0f}; "
            f"{', or '.join(remedies)}."
        )
    return poses_at(machine, configurations)


def surely_reached(
    machine: Machine, legs: FittedLegs, setting: Setting, poses: Configurations
) -> BoolArray:
    """Return a mask of poses that random machines within tolerance reach at the same readings.

    Near a singularity, or at the boundary of the workspace, small errors make poses unreachable.
    Readings of redundant motors contradict each other in all machines but one: there the pose of
    least squares counts, where all rods have their lengths.
    """
    reached = np.ones(len(poses.poses), dtype=np.bool_)
    if not machine.is_determined or not len(reached):
        return reached
    rng, nearby = np.random.default_rng(0), platforms_in_base(machine, poses.poses)
    measured = [
        j
        for j, leg in enumerate(machine.legs)
        if leg.kind is not LegKind.PASSIVE and not (machine.is_redundant and leg.is_motor)
    ]
    t_nearby = Frames.of(nearby).t
    wider = replace(setting, length=_WIDER * setting.length, angle=_WIDER * setting.angle)
    for _ in range(N_REACHING):
        drawn = drawn_legs(legs, wider, rng)
        R, t = Frames.of(poses_at_readings(machine, drawn, poses.readings, nearby))
        errors = length_errors(drawn, R, t, poses.readings)
        residual = np.abs(errors[:, measured]).max(axis=1, initial=0.0)
        moved = np.linalg.norm(t - t_nearby, axis=1)
        reached &= (residual < _CLOSED * machine.size) & (moved < _MOST_MOVED * machine.size)
    return reached


def drawn_legs(legs: FittedLegs, setting: Setting, rng: np.random.Generator) -> tuple[Leg, ...]:
    """Draw legs, and visible arms, within the tolerance of the machine."""
    parametrization = legs.parametrization
    spread = np.where(
        [unit == "m" for unit in parametrization.units], setting.length, setting.angle
    )
    arms = np.array([ParameterId.parse(name).kind in ARMS for name in parametrization.names])
    spread = spread * (arms | [not is_held_by_default(name) for name in parametrization.names])
    return moved_legs(
        legs.nominal, parametrization.place, spread * rng.uniform(-1.0, 1.0, len(spread))
    )


def poses_near(
    machine: Machine,
    legs: FittedLegs,
    setting: Setting,
    poses: Configurations,
    step: float,  # of the travel
    rng: np.random.Generator,
) -> Configurations:
    """Add feasible poses near each pose."""
    feasibility = Feasibility(machine)
    columns = slider_columns(machine, machine.motors)[0]
    lower, upper = motor_travel(machine)
    nearby: list[Array] = []
    for configuration in poses.configurations:
        for _ in range(N_NEAR if machine.is_determined else 0):
            q = configuration[columns] + step * (upper - lower) * rng.normal(size=len(columns))
            q = np.clip(q, lower, upper)
            try:
                reached = follow(machine, configuration, q, min_step=_HALF_WAY)
            except DidNotConverge:
                continue
            if feasibility.problem(reached, of_motors=False) is None:
                nearby.append(reached)
    if not nearby:
        return poses
    kept = surely_reached(machine, legs, setting, poses_at(machine, nearby))
    more = [nearby[k] for k in np.flatnonzero(kept)]
    return poses_at(machine, [*poses.configurations, *more])


# Order of poses, and intermediate poses on the path between them


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
    distance = np.abs(q[:, None] - q).max(axis=2, initial=0.0)
    distance = np.pad(distance, (0, 1))  # the end is near all
    order, remaining = [0], set(range(1, len(q)))
    while remaining:
        order.append(min(remaining, key=lambda k: (distance[order[-1], k], k)))
        remaining.remove(order[-1])
    order.append(len(q))
    for _ in range(_ROUNDS):
        shorter = False
        for i in range(1, len(order) - 2):
            for j in range(i + 1, len(order) - 1):
                before, first, last, after = (order[k] for k in (i - 1, i, j, j + 1))
                now = distance[before, first] + distance[last, after]
                if now - distance[before, last] - distance[first, after] > 1e-12:
                    order[i : j + 1] = order[i : j + 1][::-1]
                    shorter = True
        if not shorter:
            break
    return [k - 1 for k in order[1:-1]]


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
