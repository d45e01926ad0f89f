"""Where cameras stood, found together with the base: step 2 from every place that looks alike.

Where a view leaves several places of its camera, the rigid criterion is tried from all of them,
up to a number of trials; of more such views it takes distances between joints only.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import product

import numpy as np
from scipy.spatial.transform import RigidTransform

from legcal.errors import DidNotConverge
from legcal.geometry.types import Array
from legcal.stages.base_unknowns import nominal_axes
from legcal.stages.camera_starts import CameraStart, camera_starts, signs_seen
from legcal.stages.joints_in_camera import JointsInCamera, with_signs
from legcal.stages.nominal import NominalMechanism
from legcal.stages.rigid_parts import build_rigid
from legcal.stages.solution import Solution
from legcal.stages.solve import solve_least_squares

_MOST_TRIALS = 32  # of places of cameras that look alike
_DECIDED = 4.5  # half of a squared error: a difference in cost that decides between two places


def register_views(
    A_Rb: Array, v_Rb: Array, joints: JointsInCamera
) -> tuple[RigidTransform | None, ...]:
    """Return T_Rb_camera of each view whose joints and axes fix it, in closed form, unweighted.

    Parameters
    ----------
    A_Rb, v_Rb : (n_legs, 3) array
        Base joint centres [m] and revolute axes in R_b.
    joints : JointsInCamera
        The result of step 1.
    """
    starts = _starts(A_Rb, v_Rb, joints)
    return tuple(
        places[0].T_Rb_camera if len(places) == 1 and places[0].fixed else None for places in starts
    )


def _starts(A_Rb: Array, v_Rb: Array, joints: JointsInCamera) -> list[list[CameraStart]]:
    """Return where the camera of each view may have stood."""
    return [
        camera_starts(
            A_Rb[located], v_Rb[axis], A_camera[located], v_camera[axis], signed=bool(sided)
        )
        for A_camera, located, v_camera, axis, sided in zip(
            joints.A_camera,
            joints.located,
            joints.v_camera,
            joints.axis_located,
            joints.sided,
            strict=True,
        )
    ]


def lay_together(
    mechanism: NominalMechanism, joints: JointsInCamera
) -> tuple[Solution, JointsInCamera, tuple[CameraStart | None, ...]]:
    """Return the rigid solution, joints with the signs of their axes, and where cameras started."""
    A_Rb, v_Rb = mechanism.parameters.base_joints, nominal_axes(mechanism)
    starts: list[Sequence[CameraStart | None]] = []
    n_trials = 1
    for places, located in zip(_starts(A_Rb, v_Rb, joints), joints.located, strict=True):
        usable = places and (places[0].fixed or located.sum() > 2)
        if usable and n_trials * len(places) <= _MOST_TRIALS:
            n_trials *= len(places)
            starts.append(places)
        else:
            starts.append([None])
    trials = [_Trial.of(mechanism, joints, v_Rb, choice) for choice in product(*starts)]
    best = min(trials, key=lambda trial: trial.cost)
    doubtful = np.zeros(len(starts), dtype=np.bool_)
    for trial in trials:
        if trial.cost < best.cost + _DECIDED:
            doubtful |= [a is not b for a, b in zip(trial.starts, best.starts, strict=True)]
    if doubtful.any():
        choice = [None if d else a for a, d in zip(best.starts, doubtful, strict=True)]
        best = _Trial.of(mechanism, joints, v_Rb, choice)
    if isinstance(best.solution, DidNotConverge):
        raise best.solution
    return best.solution, best.joints, best.starts


@dataclass(frozen=True, eq=False)
class _Trial:
    """The rigid criterion, begun from one place of each camera."""

    starts: tuple[CameraStart | None, ...]
    joints: JointsInCamera
    solution: Solution | DidNotConverge

    @classmethod
    def of(
        cls,
        mechanism: NominalMechanism,
        joints: JointsInCamera,
        v_Rb: Array,
        starts: Sequence[CameraStart | None],
    ) -> _Trial:
        """Return what the criterion gives."""
        signs = np.ones(joints.located.shape)
        for v, start in enumerate(starts):
            if start is not None:
                axes = np.flatnonzero(joints.axis_located[v])
                signs[v, axes] = signs_seen(v_Rb[axes], joints.v_camera[v, axes], start.T_Rb_camera)
        joints = with_signs(joints, signs)
        places = [None if start is None else start.T_Rb_camera for start in starts]
        solution: Solution | DidNotConverge
        try:
            solution = solve_least_squares(build_rigid(mechanism, joints, places))
        except DidNotConverge as failure:  # the wrong one of two places may end anywhere
            solution = failure
        return cls(tuple(starts), joints, solution)

    @property
    def cost(self) -> float:
        """Half the sum of squares, infinite where there is no solution."""
        return self.solution.cost if isinstance(self.solution, Solution) else np.inf
