"""Poses in which a simulated machine is photographed (section 4.3).

They are reached from home without crossing a singularity, with every joint inside its limits and no
leg through another. Extreme ones have every motor near an end of its travel; where the legs cannot
have such lengths at the same time, they go as far that way as they can: after some draws in vain
over all of the travel, the next are drawn nearer to home.
"""

from __future__ import annotations

from enum import StrEnum
from pathlib import Path

import numpy as np

from legcal.errors import DatasetError, DidNotConverge, UsageError
from legcal.geometry.types import Array
from legcal.mechanism.closing import platform_pose, slider_columns
from legcal.mechanism.configurations import INSIDE, Configurations, joint_values
from legcal.mechanism.following import follow
from legcal.mechanism.model import Mechanism
from legcal.progress import Report, no_progress
from legcal.simulation.admission import Admission
from legcal.simulation.draws import Draws
from legcal.simulation.readings_file import read_readings

STAGE = "Poses"
HOPELESS = 5  # poses in vain, one after the other


class Sampling(StrEnum):
    """How poses are drawn: every motor near an end of its travel, or anywhere in it."""

    EXTREME = "extreme"
    WORKSPACE = "workspace"


def draw_poses(
    mechanism: Mechanism,
    n_poses: int,
    rng: np.random.Generator,
    sampling: Sampling | str = Sampling.EXTREME,
    progress: Report = no_progress,
) -> Configurations:
    """Return random poses of a machine.

    Parameters
    ----------
    mechanism : Mechanism
        The true machine.
    n_poses : int
        Number of poses.
    rng : numpy.random.Generator
        Source of the poses.
    sampling : Sampling
        How they are drawn. Where the motors do not determine the pose the machine takes a random
        walk in either case.
    progress : callable
        Called as ``progress(stage, done, total)``.

    Returns
    -------
    Configurations

    Raises
    ------
    DidNotConverge
        If too few poses are reached.
    ModelError
        If a joint is outside its limits at home already.
    UsageError
        If there is no pose to draw, or no such sampling.
    """
    if n_poses < 1 or sampling not in list(Sampling):
        raise UsageError(
            f"Poses could not be drawn: found {n_poses} poses and the sampling '{sampling}', "
            f"needed at least one pose and {' or '.join(Sampling)}; choose them."
        )
    draws = Draws(mechanism, rng, extreme=Sampling(sampling) is Sampling.EXTREME)
    found: list[Array] = []
    in_vain = 0
    progress(STAGE, 0, n_poses)
    while len(found) < n_poses and in_vain < HOPELESS:
        configuration = draws.next()
        in_vain = in_vain + 1 if configuration is None else 0
        if configuration is not None:
            found.append(configuration)
            progress(STAGE, len(found), n_poses)
    if len(found) < n_poses:
        raise DidNotConverge(
            f"{mechanism.yaml_path}: {n_poses} poses could not be drawn: found {len(found)} that "
            f"the machine reaches in {draws.problems.total() + len(found)} draws "
            f"({draws.said()}), needed all; check legcal.home and the limits of the joints, or "
            "give poses."
        )
    return _poses(mechanism, found)


def given_poses(mechanism: Mechanism, path: Path) -> Configurations:
    """Return the poses at the readings of a CSV: actuated joints in its header, [m] below.

    Each is followed from the nearest one that is reached already, or from home.

    Parameters
    ----------
    mechanism : Mechanism
        The true machine.
    path : Path
        The CSV.

    Returns
    -------
    Configurations
        In the order of the rows.

    Raises
    ------
    DatasetError
        If the file is malformed or has readings outside the travel, or if the machine cannot
        stand at those of a row; one sentence for each.
    UsageError
        If readings do not tell the pose of this machine.
    ModelError
        If a joint is outside its limits at home already.
    """
    if not mechanism.is_determined:
        raise UsageError(
            f"{path}: poses could not be given: found a machine of {mechanism.mobility} freedoms "
            f"and {len(mechanism.motors)} motors, needed one whose readings tell its pose; let "
            "poses be drawn."
        )
    given = read_readings(path, mechanism)
    admission, problems = Admission(mechanism), []
    known = [mechanism.home_configuration[slider_columns(mechanism, mechanism.motors)[0]]]
    reached = [mechanism.home_configuration]
    for where, row in zip(given.where, given.readings, strict=True):
        nearest = int(np.argmin(np.abs(np.array(known) - row).max(axis=1)))
        problem = _outside_travel(mechanism, row)
        if problem is None:
            try:
                configuration = follow(mechanism, reached[nearest], row)
            except DidNotConverge:
                problem = "legs that cannot have these lengths at the same time"
            else:
                problem = admission.problem(configuration, of_motors=False)
                known.append(row)
                reached.append(configuration)
        if problem is not None:
            problems.append(
                f"{where}: the pose could not be used: found {problem} there, needed a pose that "
                "the machine reaches from home; correct or remove the row."
            )
    if problems:
        raise DatasetError(problems)
    return _poses(mechanism, reached[1:])


def _outside_travel(mechanism: Mechanism, row: Array) -> str | None:
    """Return which reading of the motors, (n_motors,) [m], is outside its travel."""
    for j, q in zip(mechanism.motors, row, strict=True):
        leg = mechanism.legs[j]
        lower, upper = leg.travel
        if not lower - INSIDE <= q <= upper + INSIDE:
            travel = f"{lower:.9g} to {upper:.9g} m"
            return f"{leg.prismatic} at {q:.9g} m, outside its travel of {travel},"
    return None


def _poses(mechanism: Mechanism, configurations: list[Array]) -> Configurations:
    """Return closed configurations as poses."""
    return Configurations(
        np.array(configurations),
        np.array([joint_values(mechanism, c) for c in configurations]),
        [platform_pose(mechanism, c) for c in configurations],
    )
