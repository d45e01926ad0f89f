"""Poses that a controller could command: both the true machine and its nominal model reach them.

They are drawn (:func:`legcal.machine.configurations.feasible_poses`) or given by their readings.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from legcal.data.measurements import reading_columns, readings_in
from legcal.errors import DatasetError, DidNotConverge, UsageError
from legcal.files.table import read_table
from legcal.geometry.types import Array, BoolArray
from legcal.machine.closing import singularities, singularity
from legcal.machine.configurations import (
    JITTER,
    TRAVEL_TOLERANCE,
    Cause,
    Configurations,
    Feasibility,
    feasible_poses,
    motor_travel,
    poses_at,
)
from legcal.machine.kinematics import followed, followed_poses, platform_in_base
from legcal.machine.model import Machine, platform_pose
from legcal.machine.redundancy import contradictions
from legcal.progress import Report, no_progress
from legcal.simulation.settings import Sampling

_REGULAR_NOMINAL = 0.05  # minimum singularity measure of the nominal model, in units of home
_MAX_ROUNDS = 20  # maximum rounds of draws that replace poses unreachable for the nominal model


def are_extreme(machine: Machine, readings: Array) -> BoolArray:
    """Return a mask (n_poses,) of the poses with every motor near an end of its travel."""
    lower, upper = motor_travel(machine)
    part = (readings[:, list(machine.motors)] - lower) / (upper - lower)
    return np.asarray(np.all(np.minimum(part, 1.0 - part) <= JITTER, axis=1))


def draw_poses(
    machine: Machine,
    n_poses: int,
    rng: np.random.Generator,
    sampling: Sampling | str = Sampling.EXTREME,
    progress: Report = no_progress,
) -> Configurations:
    """Return random poses of a machine."""
    if n_poses < 1 or sampling not in list(Sampling):
        raise UsageError(
            f"Poses could not be drawn: found {n_poses} poses and the sampling '{sampling}', "
            f"needed at least one pose and {' or '.join(Sampling)}; choose them."
        )
    extreme = Sampling(sampling) is Sampling.EXTREME
    return feasible_poses(machine, n_poses, rng, extreme=extreme, progress=progress)


def given_poses(machine: Machine, path: Path) -> Configurations:
    """Return the poses at the readings of a CSV: actuated joints in its header, [m] below.

    Each is reached from the nearest pose that has been reached already, or from home.
    """
    if not machine.is_determined:
        raise UsageError(
            f"{path}: poses could not be given: found a machine of {machine.mobility} freedoms "
            f"and {len(machine.motors)} motors, needed one whose readings tell its pose; let "
            "poses be drawn."
        )
    table = read_table(
        path,
        "file of poses",
        "row",
        reading_columns(machine.legs),
        needed="one row for each pose; write the readings of the motors",
    )
    readings, _ = readings_in(table, machine.legs)  # (n_poses, n_motors) [m]
    table.check()
    feasibility, reached = Feasibility(machine), list[Array]()
    obstacles = [_outside_travel(machine, row) for row in readings]
    inside = [k for k, obstacle in enumerate(obstacles) if obstacle is None]
    chains = followed(machine, readings[inside], must_agree=False)
    for k, (configuration, failure) in zip(inside, chains, strict=True):
        reached.append(configuration)
        T = platform_in_base(machine, platform_pose(machine, configuration))
        if failure is not None:
            obstacles[k] = Cause.LENGTHS
        elif off := contradictions(machine, [T], readings[[k]]):
            obstacles[k] = str(off[0].cause(machine))
        else:
            obstacles[k] = feasibility.problem(configuration, of_motors=False)
    if problems := [
        f"{place}: the pose could not be used: found {obstacle} there, needed a pose that the "
        "machine reaches from home; correct or remove the row."
        for place, obstacle in zip(table.where, obstacles, strict=True)
        if obstacle is not None
    ]:
        raise DatasetError(problems)
    return poses_at(machine, reached)


def commanded_poses(
    truth: Machine,
    nominal: Machine,
    n_poses: int,
    rng: np.random.Generator,
    sampling: Sampling | str,
    progress: Report = no_progress,
) -> Configurations:
    """Return random poses of a machine that its nominal model reaches at the same readings.

    A controller plans with the nominal model. Beside a singularity small errors decide whether
    legs of some lengths meet at all, and poses there are drawn again. Where motors do not
    determine the pose, the nominal model need not reach them.
    """
    kept: list[Array] = []

    def report(stage: str, done: int, total: int) -> None:
        progress(stage, len(kept) + done, len(kept) + total)

    for _ in range(_MAX_ROUNDS):
        drawn = draw_poses(truth, n_poses - len(kept), rng, sampling, report)
        kept += list(drawn.configurations[_reached(nominal, drawn.readings)])
        if len(kept) == n_poses:
            return poses_at(truth, kept)
    raise DidNotConverge(
        f"{nominal.yaml_path}: {n_poses} poses could not be drawn: found {len(kept)} that "
        f"the true machine and the nominal model reach at the same readings in {_MAX_ROUNDS} "
        "rounds, needed all; make the errors of the true machine smaller, or give poses."
    )


def _outside_travel(machine: Machine, row: Array) -> str | None:
    """Return in words the reading of a motor outside its travel, among (n_motors,) [m]."""
    for j, q in zip(machine.motors, row, strict=True):
        leg = machine.legs[j]
        lower, upper = leg.travel
        slack = TRAVEL_TOLERANCE * max(abs(lower), abs(upper))
        if not lower - slack <= q <= upper + slack:
            travel = f"{lower:.9g} to {upper:.9g} m"
            return f"{leg.prismatic} at {q:.9g} m, outside its travel of {travel},"
    return None


def _reached(nominal: Machine, readings: Array) -> BoolArray:
    """Return a mask of readings (k, n_legs) in reach of the nominal model, off singularities."""
    if not nominal.is_determined:
        return np.ones(len(readings), dtype=np.bool_)
    poses, failures = zip(*followed_poses(nominal, readings, on_the_chain=False), strict=True)
    is_reached = np.array([failure is None for failure in failures])
    regular = singularities(nominal, np.array([T.as_matrix() for T in poses]))
    least = _REGULAR_NOMINAL * singularity(nominal, nominal.home)
    return np.asarray(is_reached & (regular >= least))
