"""Section 3 from leg axes to parameters: the four steps in a row."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import RigidTransform

from legcal.data import LegAxes, Measurements
from legcal.geometry import BoolArray
from legcal.machine import KinematicParameters, LegGeometry
from legcal.paper.joints_in_base import JointsInBase, locate_joints_in_base
from legcal.paper.joints_in_camera import JointsInCamera, locate_joints_in_cameras
from legcal.paper.leg_directions import (
    directions_through_joints,
    find_misses,
    observed_directions,
    select_axes,
)
from legcal.paper.nominal import Criteria, NominalMechanism
from legcal.paper.offsets import Offsets, identify_offsets
from legcal.paper.platform_joints import PlatformJoints, locate_platform_joints
from legcal.paper.platform_pose import Transformation


@dataclass(frozen=True, eq=False)
class BaseSteps:
    """What steps 1 and 2 give: the base as the cameras see it, and where they stood.

    Attributes
    ----------
    joints_in_camera, joints_in_base
        The results of steps 1 and 2.
    """

    joints_in_camera: JointsInCamera
    joints_in_base: JointsInBase

    @property
    def T_Rb_camera(self) -> tuple[RigidTransform | None, ...]:
        """Where each camera stood; None for a view that locates fewer than three base joints."""
        return self.joints_in_base.T_Rb_camera


@dataclass(frozen=True, eq=False)
class StagedResult:
    """What the four steps give.

    Attributes
    ----------
    legs : tuple of LegGeometry
        The identified legs in R_b and R_e: joint centres, offsets, axes and twists.
    T_Rb_camera : tuple of RigidTransform or None, length n_views
        Where each camera stood; None for a view that locates fewer than three base joints.
    joints_in_camera, joints_in_base, offsets, platform_joints
        The results of steps 1 to 4.
    diagnostics : tuple of str
        What was left out or left at nominal, and why.
    """

    legs: tuple[LegGeometry, ...]
    T_Rb_camera: tuple[RigidTransform | None, ...]
    joints_in_camera: JointsInCamera
    joints_in_base: JointsInBase
    offsets: Offsets
    platform_joints: PlatformJoints
    diagnostics: tuple[str, ...]

    @property
    def parameters(self) -> KinematicParameters:
        """Joint centres [m] and offsets [m], NaN for passive legs."""
        return KinematicParameters(
            self.joints_in_base.A_Rb, self.platform_joints.B_Re, self.platform_joints.q0
        )


def run_steps(
    mechanism: NominalMechanism,
    axes: LegAxes,
    measurements: Measurements,
    *,
    criteria: Criteria = "default",
    transformation: Transformation | None = None,
    free_twists: bool = False,
) -> StagedResult:
    """Identify all parameters from leg axes and readings by the four steps (3.2 to 3.5).

    Parameters
    ----------
    mechanism : NominalMechanism
        The nominal mechanism: its parameters are the start.
    axes : LegAxes
        Leg axes in the camera frames.
    measurements : Measurements
        Views, poses and readings of the images.
    criteria : {"default", "literal"}
        ``literal`` takes (6), (7), (9), (14) and (16) to (19) as printed, unweighted.
    transformation : {"points", "cross_product"}, optional
        How (18) is solved: by point equality, as by default, or as printed, as in the
        ``literal`` steps.
    free_twists : bool
        Look for the twists of legs without an S joint too; they are nominal otherwise.

    Returns
    -------
    StagedResult

    Raises
    ------
    NotIdentifiable
        If the observations do not determine the parameters.
    DidNotConverge
        If a step does not converge.
    """
    return run_platform_steps(
        mechanism,
        axes,
        measurements,
        run_base_steps(mechanism, axes, measurements, criteria=criteria),
        criteria=criteria,
        transformation=transformation,
        free_twists=free_twists,
    )


def run_base_steps(
    mechanism: NominalMechanism,
    axes: LegAxes,
    measurements: Measurements,
    *,
    criteria: Criteria = "default",
) -> BaseSteps:
    """Locate base joints and cameras by steps 1 and 2 (3.2 and 3.3).

    Parameters and errors are those of :func:`run_steps`.
    """
    joints = locate_joints_in_cameras(mechanism, axes, measurements, criteria=criteria)
    return BaseSteps(joints, locate_joints_in_base(mechanism, joints, criteria=criteria))


def run_platform_steps(
    mechanism: NominalMechanism,
    axes: LegAxes,
    measurements: Measurements,
    base_steps: BaseSteps,
    *,
    criteria: Criteria = "default",
    transformation: Transformation | None = None,
    free_twists: bool = False,
) -> StagedResult:
    """Identify the rest by steps 3 and 4 (3.4 and 3.5).

    Parameters and errors are those of :func:`run_steps`; ``base_steps`` is what
    :func:`run_base_steps` found by the same axes and criteria.
    """
    joints, base = base_steps.joints_in_camera, base_steps.joints_in_base
    diagnostics = joints.diagnostics
    if criteria == "default":
        wrong = find_misses(axes, measurements, joints, base)
        diagnostics += _describe_misses(mechanism, axes, measurements, wrong)
        axes = select_axes(axes, ~wrong)
    directions = (
        observed_directions(mechanism, axes, measurements, joints)
        if criteria == "literal"
        else directions_through_joints(mechanism, axes, measurements, joints, base)
    )
    offsets = identify_offsets(mechanism, directions, measurements.sigma_q, criteria=criteria)
    platform = locate_platform_joints(
        mechanism,
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


def _describe_misses(
    mechanism: NominalMechanism, axes: LegAxes, measurements: Measurements, wrong: BoolArray
) -> tuple[str, ...]:
    """Return a sentence for each axis that was left out of steps 3 and 4."""
    return tuple(
        f"Leg {mechanism.leg_names[int(axes.leg[i])]} in image "
        f"{measurements.image[int(axes.row[i])] or int(axes.row[i]) + 1} was left out of steps "
        "3 and 4: its axis misses its base joint by far; check its outlines."
        for i in np.flatnonzero(wrong)
    )
