"""Poses that a controller could command: both the true machine and its nominal model reach them."""

from __future__ import annotations

from functools import partial

import numpy as np

from legcal.errors import DidNotConverge
from legcal.geometry.types import Array
from legcal.mechanism.configurations import Configurations
from legcal.mechanism.kinematics import forward_kinematics
from legcal.mechanism.model import Mechanism
from legcal.mechanism.singularity import singularity
from legcal.progress import Report, no_progress
from legcal.simulation.motion import Sampling, draw_poses

_REGULAR = 0.05  # of the nominal model's singularity measure at home
_ROUNDS = 20  # of draws for those that were left out


def commanded_poses(
    truth: Mechanism,
    nominal: Mechanism,
    n_poses: int,
    rng: np.random.Generator,
    sampling: Sampling,
    progress: Report = no_progress,
) -> Configurations:
    """Return random poses of a machine that its nominal model reaches at the same readings.

    A controller plans with the nominal model. Beside a singularity small errors decide whether
    legs of some lengths meet at all, and poses there are drawn again. Where motors do not
    determine the pose, nothing is asked of the nominal model.

    Parameters
    ----------
    truth, nominal : Mechanism
        The machine, and the model of it.
    n_poses : int
        Number of poses.
    rng : numpy.random.Generator
        Source of the poses.
    sampling : Sampling
        How they are drawn.
    progress : callable
        Called as ``progress(stage, done, total)``.

    Raises
    ------
    DidNotConverge
        If too few are found.
    """
    kept: list[Configurations] = []
    missing = n_poses
    for _ in range(_ROUNDS):
        report = partial(_report, progress, n_poses - missing)
        drawn = draw_poses(truth, missing, rng, sampling, report)
        reached = [i for i, q in enumerate(drawn.readings) if _reaches(nominal, q)]
        kept.append(_chosen(drawn, reached))
        missing -= len(reached)
        if missing == 0:
            return _joined(kept)
    raise DidNotConverge(
        f"{nominal.yaml_path}: {n_poses} poses could not be drawn: found {n_poses - missing} that "
        f"the true machine and the nominal model reach at the same readings in {_ROUNDS} rounds, "
        "needed all; make the errors of the true machine smaller, or give poses."
    )


def _report(progress: Report, kept: int, stage: str, done: int, total: int) -> None:
    """Report poses beside those that are kept already."""
    progress(stage, kept + done, kept + total)


def _reaches(nominal: Mechanism, q: Array) -> bool:
    """Say whether the nominal model reaches readings, away from its singularities."""
    if not nominal.is_determined:
        return True
    try:
        T = forward_kinematics(nominal, q)
    except DidNotConverge:
        return False
    return singularity(nominal, T) >= _REGULAR * singularity(nominal, nominal.home)


def _chosen(poses: Configurations, index: list[int]) -> Configurations:
    """Return some of the poses."""
    return Configurations(
        poses.configurations[index],
        poses.readings[index],
        [poses.poses[i] for i in index],
    )


def _joined(poses: list[Configurations]) -> Configurations:
    """Return the poses of several sets."""
    return Configurations(
        np.concatenate([p.configurations for p in poses]),
        np.concatenate([p.readings for p in poses]),
        [T for p in poses for T in p.poses],
    )
