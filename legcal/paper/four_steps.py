"""Section 3 from leg axes to parameters: the four steps in a row."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import RigidTransform

from legcal.data import LegAxes, Measurements
from legcal.machine import KinematicParameters, Leg
from legcal.paper.joints_in_base import JointsInBase, locate_joints_in_base
from legcal.paper.joints_in_camera import JointsInCamera, locate_joints_in_cameras
from legcal.paper.leg_directions import (
    directions_through_joints,
    find_misses,
    observed_directions,
)
from legcal.paper.nominal import Criteria, NominalMachine, Transformation
from legcal.paper.offsets import Offsets, identify_offsets
from legcal.paper.platform import PlatformJoints, locate_platform_joints


@dataclass(frozen=True, eq=False)
class BaseSteps:
    """What steps 1 and 2 give: the base as the cameras see it, and where they stood."""

    joints_in_camera: JointsInCamera
    joints_in_base: JointsInBase

    @property
    def T_Rb_camera(self) -> tuple[RigidTransform | None, ...]:
        """Where each camera stood; None for a view that locates fewer than three base joints."""
        return self.joints_in_base.T_Rb_camera


@dataclass(frozen=True, eq=False)
class StagedResult:
    """What the four steps give."""

    legs: tuple[Leg, ...]  # identified, in R_b and R_e
    T_Rb_camera: tuple[RigidTransform | None, ...]  # as of :class:`BaseSteps`
    joints_in_camera: JointsInCamera
    joints_in_base: JointsInBase
    offsets: Offsets
    platform_joints: PlatformJoints
    diagnostics: tuple[str, ...]  # what was left out or left at nominal, and why

    @property
    def parameters(self) -> KinematicParameters:
        """Joint centres [m] and offsets [m], NaN for passive legs."""
        return KinematicParameters(
            self.joints_in_base.A_Rb, self.platform_joints.B_Re, self.platform_joints.q0
        )


def run_steps(
    machine: NominalMachine,
    axes: LegAxes,
    measurements: Measurements,
    *,
    criteria: Criteria = "default",
    transformation: Transformation | None = None,
    free_twists: bool = False,
) -> StagedResult:
    """Identify all parameters from leg axes and readings by the four steps (3.2 to 3.5).

    ``literal`` criteria are (6), (7), (9), (14) and (16) to (19) as printed, unweighted; (18) is
    then solved as printed too, by point equality otherwise, unless ``transformation`` says how.
    Twists of legs without an S joint are nominal unless they are freed. Raises NotIdentifiable if
    the observations do not determine the parameters, DidNotConverge if a step does not converge.
    """
    base = run_base_steps(machine, axes, measurements, criteria=criteria)
    return run_platform_steps(
        machine,
        axes,
        measurements,
        base,
        criteria=criteria,
        transformation=transformation,
        free_twists=free_twists,
    )


def run_base_steps(
    machine: NominalMachine,
    axes: LegAxes,
    measurements: Measurements,
    *,
    criteria: Criteria = "default",
) -> BaseSteps:
    """Locate base joints and cameras by steps 1 and 2 (3.2 and 3.3), as :func:`run_steps`."""
    joints = locate_joints_in_cameras(machine, axes, measurements, criteria=criteria)
    return BaseSteps(joints, locate_joints_in_base(machine, joints, criteria=criteria))


def run_platform_steps(
    machine: NominalMachine,
    axes: LegAxes,
    measurements: Measurements,
    base_steps: BaseSteps,
    *,
    criteria: Criteria = "default",
    transformation: Transformation | None = None,
    free_twists: bool = False,
) -> StagedResult:
    """Identify the rest by steps 3 and 4 (3.4 and 3.5), as :func:`run_steps`."""
    joints, base = base_steps.joints_in_camera, base_steps.joints_in_base
    diagnostics = joints.diagnostics
    if criteria == "literal":
        directions = observed_directions(machine, axes, measurements, joints)
    else:
        wrong = find_misses(axes, measurements, joints, base)
        diagnostics += tuple(
            f"Leg {machine.leg_names[leg]} in image {measurements.image[row] or row + 1} was "
            "left out of steps 3 and 4: its axis misses its base joint by far; check its outlines."
            for leg, row in zip(axes.leg[wrong].tolist(), axes.row[wrong].tolist(), strict=True)
        )
        axes = axes.choose(np.flatnonzero(~wrong))
        directions = directions_through_joints(machine, axes, measurements, joints, base)
    offsets = identify_offsets(machine, directions, measurements.sigma_q, criteria=criteria)
    platform = locate_platform_joints(
        machine,
        joints,
        base,
        directions,
        offsets,
        measurements.sigma_q,
        criteria=criteria,
        transformation=transformation,
        free_twists=free_twists,
    )
    return StagedResult(
        legs=platform.legs,
        T_Rb_camera=base.T_Rb_camera,
        joints_in_camera=joints,
        joints_in_base=base,
        offsets=offsets,
        platform_joints=platform,
        diagnostics=diagnostics + platform.diagnostics,
    )
