"""Section 3 from leg axes to parameters: the four steps in a row."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from legcal.data.axes import LegAxes
from legcal.data.measurements import Measurements
from legcal.machine.leg import KinematicParameters, Leg
from legcal.paper.criteria import Criteria, Transformation
from legcal.paper.joints_in_base import JointsInBase, locate_joints_in_base
from legcal.paper.joints_in_camera import locate_joints_in_cameras
from legcal.paper.leg_directions import (
    directions_through_joints,
    find_outliers,
    observed_directions,
)
from legcal.paper.nominal import NominalMachine
from legcal.paper.offsets import identify_offsets
from legcal.paper.platform import locate_platform_joints


@dataclass(frozen=True, eq=False)
class StagedResult:
    """What the four steps give."""

    machine: NominalMachine  # identified
    base: JointsInBase  # what steps 1 and 2 gave
    diagnostics: tuple[str, ...]  # what was left out or left at nominal, and why

    @property
    def legs(self) -> tuple[Leg, ...]:
        """Identified legs, in R_b and R_e."""
        return self.machine.legs

    @property
    def parameters(self) -> KinematicParameters:
        """Joint centres [m] and offsets [m]."""
        return self.machine.parameters


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
        base,
        axes,
        measurements,
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
) -> JointsInBase:
    """Locate base joints and cameras by steps 1 and 2 (3.2 and 3.3), as :func:`run_steps`."""
    joints = locate_joints_in_cameras(machine, axes, measurements, criteria=criteria)
    return locate_joints_in_base(machine, joints, criteria=criteria)


def run_platform_steps(
    base: JointsInBase,
    axes: LegAxes,
    measurements: Measurements,
    *,
    criteria: Criteria = "default",
    transformation: Transformation | None = None,
    free_twists: bool = False,
) -> StagedResult:
    """Identify the rest by steps 3 and 4 (3.4 and 3.5), as :func:`run_steps`."""
    diagnostics = base.in_cameras.diagnostics
    if criteria == "literal":
        directions = observed_directions(axes, measurements, base.machine, base.in_cameras)
    else:
        wrong = find_outliers(axes, measurements, base)
        diagnostics += tuple(
            f"Leg {base.machine.leg_names[leg]} in image {measurements.image[row] or row + 1} was "
            "left out of steps 3 and 4: its axis misses its base joint by far; check its outlines."
            for leg, row in zip(axes.leg[wrong].tolist(), axes.row[wrong].tolist(), strict=True)
        )
        axes = axes.choose(np.flatnonzero(~wrong))
        directions = directions_through_joints(axes, measurements, base)
    with_offsets = identify_offsets(
        base.machine, directions, measurements.sigma_q, criteria=criteria
    )
    machine, left_at_nominal = locate_platform_joints(
        with_offsets,
        base,
        directions,
        measurements.sigma_q,
        criteria=criteria,
        transformation=transformation,
        free_twists=free_twists,
    )
    return StagedResult(machine, base, diagnostics + left_at_nominal)
