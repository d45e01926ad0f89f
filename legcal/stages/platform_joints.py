"""Section 3.5: joints and axes on the platform, universal axes at the base, passive legs.

With the offsets known, the leg ends B of every pose are points of one rigid body, the
platform: laying the poses on each other gives the joint centres in R_e. Where the platform is
tells what its axes are.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from legcal.errors import DidNotConverge
from legcal.geometry.types import Array
from legcal.mechanism.leg import LegKind
from legcal.mechanism.leg_geometry import LegGeometry
from legcal.stages.joints_in_base import JointsInBase
from legcal.stages.joints_in_camera import JointsInCamera
from legcal.stages.leg_directions import LegDirections
from legcal.stages.nominal import Criteria, NominalMechanism
from legcal.stages.offsets import Offsets
from legcal.stages.open_directions import closure_turns, metres, near_nominal, open_directions
from legcal.stages.platform_as_printed import platform_as_printed
from legcal.stages.platform_pose import (
    Transformation,
    chosen_transformation,
)
from legcal.stages.platform_unknowns import platform_unknowns
from legcal.stages.rigid_platform import build_rigid
from legcal.stages.rigid_problem import RigidProblem, rigid_problem
from legcal.stages.solution import Solution
from legcal.stages.solve import solve_least_squares

KEPT_NEAR = (
    "Step 4 kept the axes of legs without an S joint near the nominal ones: the poses show them "
    "too poorly to find them alone."
)


@dataclass(frozen=True, eq=False)
class PlatformJoints:
    """The legs with all that step 4 finds.

    Attributes
    ----------
    legs : tuple of LegGeometry
        A and revolute axes at the base as step 2 found them; offsets of step 3, improved
        by the default criterion; B, axes on the platform, universal axes at the base, twists.
    solution : Solution
        The converged problem: free coordinates of B in R_e first.
    diagnostics : tuple of str
        What was left at nominal, and why.
    """

    legs: tuple[LegGeometry, ...]
    solution: Solution
    diagnostics: tuple[str, ...] = ()

    @property
    def B_Re(self) -> Array:
        """Platform joint centres in R_e, (n_legs, 3) [m]."""
        return np.array([leg.B for leg in self.legs])

    @property
    def q0(self) -> Array:
        """Offsets and lengths, (n_legs,) [m]; NaN for passive legs."""
        return np.array([np.nan if leg.kind is LegKind.PASSIVE else leg.q0 for leg in self.legs])


def locate_platform_joints(
    mechanism: NominalMechanism,
    joints: JointsInCamera,
    base: JointsInBase,
    directions: LegDirections,
    offsets: Offsets,
    sigma_q: float,
    *,
    criteria: Criteria = "default",
    transformation: Transformation | None = None,
    free_twists: bool = False,
) -> PlatformJoints:
    """Locate the joints on the platform from the leg ends, and identify the axes.

    Parameters
    ----------
    mechanism : NominalMechanism
        Its nominal platform joints and axes are the start.
    joints : JointsInCamera
        The result of step 1: how exactly A is known.
    base : JointsInBase
        The result of step 2: A and revolute axes in R_b, and where the cameras stand.
    directions : LegDirections
        Legs of each pose.
    offsets : Offsets
        The result of step 3.
    sigma_q : float
        Standard deviation of a reading [m].
    criteria : {"default", "literal"}
        ``literal`` minimises (16) as printed, mean distances of each view, and then identifies
        axes and passive ends one by one, every equation with the same weight.
    transformation : {"points", "cross_product"}, optional
        How (18) is solved: by point equality, as by default, or as printed, as in the
        ``literal`` steps. The default criterion only starts there.
    free_twists : bool
        Look for the twists of legs without an S joint too; they are nominal otherwise.

    Returns
    -------
    PlatformJoints

    Raises
    ------
    NotIdentifiable
        If the images do not tie all joints together, or leave something open that moves the
        platform.
    DidNotConverge
        If IPOPT does not.

    Notes
    -----
    Distances decide neither z of coplanar joints nor the handedness (see step 2), so the
    default lays the leg ends on each other rigidly, with one platform pose for every group of
    three or more legs (two in a plane); two legs give their distance. The platform joint
    predicts the whole leg: its direction is compared with the observed one, and its length with
    reading plus offset. The offsets stay free in this: (13) multiplies a noisy direction by the
    unknown length, which biases (14), while here directions are predicted and not multiplied. A
    passive leg has no reading, and takes part with its direction alone, which is (19). Lengths and
    demands hold exactly, but between joints A that have errors: they are weighted by these.

    What the joints demand of a leg, that it is normal to its revolute axis, keeps its direction in
    the platform, does not twist, are further residuals of the same problem, with the axes among the
    unknowns. One image tells a pose of the platform badly, and an axis that is computed from
    such poses inherits that; the demands of all legs make the poses much better, and the joints
    with them. They tell joints too that distances alone leave open.
    The problem starts at the nominal model: axes in closed form from poses of noisy ends are
    further off than these, and what it finds is the same from 30 mm and 20 degrees away.
    """
    known = with_base_and_offsets(mechanism, base, offsets)
    how = chosen_transformation(transformation, criteria)
    if criteria == "literal":
        unknowns = platform_unknowns(known, free_twists=free_twists)
        legs, solution, said = platform_as_printed(known, unknowns, base, directions, how)
        return PlatformJoints(legs, solution, said)
    rigid = rigid_problem(
        known, joints, base, directions, sigma_q, transformation=how, free_twists=free_twists
    )
    return _minimum(rigid)


def with_base_and_offsets(
    mechanism: NominalMechanism, base: JointsInBase, offsets: Offsets
) -> NominalMechanism:
    """Return the mechanism with what steps 2 and 3 found."""
    legs = tuple(
        replace(
            leg,
            A=base.A_Rb[j],
            base_axis=base.base_axes[j] if mechanism.revolute[j] else leg.base_axis,
            q0=float(offsets.q0[j]) if np.isfinite(offsets.q0[j]) else leg.q0,
        )
        for j, leg in enumerate(mechanism.legs)
    )
    return replace(mechanism, legs=legs)


def _minimum(rigid: RigidProblem) -> PlatformJoints:
    """Return the minimum of the rigid criterion, with what it leaves open held at nominal.

    What is open is judged near the nominal model: there the platform moves as it should. Axes that
    the poses show too poorly to converge without it stay near the nominal ones.
    """
    known, unknowns = rigid.mechanism, rigid.unknowns
    problem = build_rigid(rigid)
    n, terms = len(unknowns), problem.terms
    nominal = unknowns.vector(known.legs)
    near = near_nominal(closure_turns(unknowns))
    solution = solve_least_squares(replace(problem, terms=(*terms, *near)))
    found = unknowns.legs(solution.x[:n], known.legs)
    shown = solution.without_last(sum(len(term.index) for term in near))
    still = open_directions(
        known, unknowns, shown.information(), found, rigid.poses_in_base(solution.x[n:])
    )
    if len(still.basis):
        terms = (*terms, still.holding(metres(unknowns, still.length), nominal))
    said = still.sentences
    if near or len(still.basis):
        problem = replace(problem, terms=terms, start=solution.x)
        try:
            solution = solve_least_squares(problem)
        except DidNotConverge:
            solution = solve_least_squares(replace(problem, terms=(*terms, *near)))
            said = (*said, KEPT_NEAR)
        found = unknowns.legs(solution.x[:n], known.legs)
    return PlatformJoints(found, solution, said)
