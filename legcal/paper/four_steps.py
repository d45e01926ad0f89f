"""Section 3 from leg axes to parameters: the four steps in a row."""

from __future__ import annotations

from dataclasses import dataclass

from legcal.data.measurements import Measurements
from legcal.data.outlines import LegAxes
from legcal.machine.leg import Leg
from legcal.paper.criteria import Criteria
from legcal.paper.joints_in_base import JointsInBase, locate_joints_in_base
from legcal.paper.joints_in_camera import locate_joints_in_cameras
from legcal.paper.offsets import identify_offsets, leg_directions
from legcal.paper.platform import locate_platform_joints
from legcal.paper.unknowns import NominalMachine


@dataclass(frozen=True, eq=False)
class StagedResult:
    """The result of the four steps."""

    machine: NominalMachine  # identified
    base: JointsInBase  # result of steps 1 and 2
    diagnostics: tuple[str, ...]  # omissions and nominal values, with their reasons

    @property
    def legs(self) -> tuple[Leg, ...]:
        """Identified legs, in R_b and R_e."""
        return self.machine.legs


def run_steps(
    machine: NominalMachine,
    axes: LegAxes,
    measurements: Measurements,
    *,
    criteria: Criteria = "default",
    free_twists: bool = False,
) -> StagedResult:
    """Identify all parameters from leg axes and readings by the four steps (3.2 to 3.5).

    Equations are (6), (7), (9), (14) and (16) to (19) as printed; all weights are one with
    ``literal`` criteria, else from the covariances of the axes. Twists of legs without an S joint
    are nominal unless they are freed. Raises NotIdentifiable if the observations do not determine
    the parameters, DidNotConverge if a step does not converge.
    """
    base = run_base_steps(machine, axes, measurements, criteria=criteria)
    return run_platform_steps(base, measurements, criteria=criteria, free_twists=free_twists)


def run_base_steps(
    machine: NominalMachine,
    axes: LegAxes,
    measurements: Measurements,
    *,
    criteria: Criteria = "default",
) -> JointsInBase:
    """Locate base joints and cameras by steps 1 and 2 (3.2 and 3.3), as :func:`run_steps`."""
    weighted = criteria == "default"
    joints = locate_joints_in_cameras(machine, axes, measurements, weighted=weighted)
    return locate_joints_in_base(machine, joints, measurements, weighted=weighted)


def run_platform_steps(
    base: JointsInBase,
    measurements: Measurements,
    *,
    criteria: Criteria = "default",
    free_twists: bool = False,
) -> StagedResult:
    """Identify the rest by steps 3 and 4 (3.4 and 3.5), as :func:`run_steps`."""
    weighted = criteria == "default"
    directions = leg_directions(base.machine, base.in_cameras, measurements)
    machine, of_offsets = identify_offsets(base.machine, directions, weighted=weighted)
    machine, of_platform = locate_platform_joints(
        machine, base, directions, weighted=weighted, free_twists=free_twists
    )
    return StagedResult(machine, base, (*base.diagnostics, *of_offsets, *of_platform))
