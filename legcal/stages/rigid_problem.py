"""What the rigid criterion of step 4 is built of: legs, unknowns, poses to start from, weights."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from legcal.geometry.types import Array, BoolArray, IntArray
from legcal.mechanism.leg_geometry import Demand
from legcal.stages.base_spread import base_spread, spread_of_demands
from legcal.stages.joints_in_base import JointsInBase
from legcal.stages.joints_in_camera import JointsInCamera
from legcal.stages.leg_directions import LegDirections
from legcal.stages.nominal import NominalMechanism
from legcal.stages.offsets import leg_end_covariance, leg_ends
from legcal.stages.platform_pose import PlatformPoses, Transformation, locate_platform
from legcal.stages.platform_unknowns import B_COLUMNS, PlatformUnknowns, platform_unknowns

IN_PLANE = np.array([0, 1, -1, -1, -1, 2])  # of displacement and turn of a planar platform


@dataclass(frozen=True, eq=False)
class RigidProblem:
    """What the rigid criterion is built of.

    Attributes
    ----------
    mechanism : NominalMechanism
        The legs with what steps 2 and 3 found of them: A and revolute axes of the base in R_b,
        offsets and lengths.
    unknowns : PlatformUnknowns
        Where the unknowns stand.
    directions : LegDirections
        Legs of each pose.
    poses : PlatformPoses
        Platform poses to start from.
    in_base : (n,) array of bool
        Which of the legs stand in R_b: twists count for these.
    spread : (n, 3, 3) array
        Covariance of A of each [m^2].
    sigma_q : float
        Standard deviation of a reading [m].
    """

    mechanism: NominalMechanism
    unknowns: PlatformUnknowns
    directions: LegDirections
    poses: PlatformPoses
    in_base: BoolArray
    spread: Array
    sigma_q: float

    def index(self, rows: IntArray) -> IntArray:
        """Return the places of B and of the step of the pose of some of the legs, (k, 9)."""
        own = np.arange(6) if self.mechanism.spatial else IN_PLANE
        first = len(self.unknowns) + (own.max() + 1) * self.poses.pose[rows, None]
        steps = np.where(own >= 0, first + own, -1)
        return np.hstack([self.unknowns.place[self.directions.leg[rows], B_COLUMNS], steps])

    def known(self, rows: IntArray) -> tuple[Array, Array, Array, Array]:
        """Return what is known of some of the legs: B in part, the pose at step zero, and A."""
        pose, held = self.poses.pose[rows], self.unknowns.held[self.directions.leg[rows]]
        return held, self.poses.R[pose], self.poses.t[pose], self.directions.A[rows]

    def sigma(self, rows: IntArray, demand: Demand, least: float) -> Array:
        """Return standard deviations of a demand: at least one, and what A is wrong by."""
        of_A = spread_of_demands(
            self.mechanism.legs, self.directions, self.poses, self.spread, rows, demand
        )
        return np.asarray(np.sqrt(least**2 + of_A))

    def poses_in_base(self, x: Array) -> tuple[Array, Array]:
        """Return R and t of the poses of groups in R_b, from the unknowns of all poses."""
        steps = np.zeros((len(self.poses.R), 6))
        own = np.arange(6) if self.mechanism.spatial else IN_PLANE
        steps[:, own >= 0] = x.reshape(len(steps), own.max() + 1)
        numbers = np.unique(self.poses.pose[self.in_base])
        return self.poses.stepped(steps, numbers[numbers >= 0])


def rigid_problem(
    known: NominalMechanism,
    joints: JointsInCamera,
    base: JointsInBase,
    directions: LegDirections,
    sigma_q: float,
    *,
    transformation: Transformation = "points",
    free_twists: bool = False,
) -> RigidProblem:
    """Gather what the rigid criterion is built of, platform poses to start from among it.

    Parameters
    ----------
    known : NominalMechanism
        The mechanism with what steps 2 and 3 found of it.
    joints : JointsInCamera
        The result of step 1: how exactly A is known.
    base : JointsInBase
        The result of step 2: where the cameras stand.
    directions : LegDirections
        Legs of each pose.
    sigma_q : float
        Standard deviation of a reading [m].
    transformation : {"points", "cross_product"}
        How the poses to start from are computed, see
        :func:`legcal.stages.platform_pose.locate_platform`.
    free_twists : bool
        Count twists among the unknowns.

    Raises
    ------
    DidNotConverge
        If IPOPT does not.
    """
    placed = np.array([T is not None for T in base.T_Rb_camera])
    centre = np.zeros((len(directions), 3))
    for v, T in enumerate(base.T_Rb_camera):
        if T is not None:
            centre[directions.view == v] = T.translation
    q0, spread = known.parameters.offsets, base_spread(directions, joints, base)
    covariance = leg_end_covariance(directions, q0, sigma_q) + spread
    poses = locate_platform(
        directions,
        leg_ends(directions, q0),
        known.parameters.platform_joints,
        centre=centre,
        transformation=transformation,
        spatial=known.spatial,
        on_a_line=True,
        weight=1.0 / np.einsum("nii->n", covariance),
    )
    unknowns = platform_unknowns(known, free_twists=free_twists)
    in_base = placed[directions.view]
    return RigidProblem(known, unknowns, directions, poses, in_base, spread, sigma_q)
