"""Poses in which a simulated machine is photographed (section 4.3)."""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum
from pathlib import Path

import numpy as np
from scipy.spatial.transform import RigidTransform

from legcal.geometry.types import Array
from legcal.mechanism.configurations import random_configurations
from legcal.mechanism.model import Mechanism


class Sampling(StrEnum):
    """How poses are drawn: every motor near an end of its travel, or anywhere in it."""

    EXTREME = "extreme"
    WORKSPACE = "workspace"


@dataclass(frozen=True, eq=False)
class SimulatedPoses:
    """Poses of a machine.

    Attributes
    ----------
    configurations : (n_poses, nq) array
        Of the closed chain.
    readings : (n_poses, n_legs) array
        Joint value of every leg [m], passive ones too; zero for legs of constant length.
    T_base_platform : tuple of RigidTransform
        Poses of the platform link in the base link.
    """

    configurations: Array
    readings: Array
    T_base_platform: tuple[RigidTransform, ...]

    def __len__(self) -> int:
        return len(self.configurations)


def draw_poses(
    mechanism: Mechanism,
    n_poses: int,
    rng: np.random.Generator,
    sampling: Sampling | str = Sampling.EXTREME,
) -> SimulatedPoses:
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
        How they are drawn.

    Returns
    -------
    SimulatedPoses

    Raises
    ------
    DidNotConverge
        If too few poses are reached.
    """
    found = random_configurations(mechanism, n_poses, rng)
    return SimulatedPoses(found.configurations, found.readings, tuple(found.poses))


def given_poses(mechanism: Mechanism, path: Path) -> SimulatedPoses:
    """Return the poses at readings that a CSV gives: actuated joints in its header, [m] below.

    Parameters
    ----------
    mechanism : Mechanism
        The true machine.
    path : Path
        The CSV.

    Returns
    -------
    SimulatedPoses

    Raises
    ------
    DatasetError
        If the file is malformed, or a row is outside the travel or not reached.
    """
    raise NotImplementedError
