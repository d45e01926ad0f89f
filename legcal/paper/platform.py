"""Section 3.5: joints and axes on the platform, universal axes at the base, passive legs.

As printed (``literal``) they follow one by one, (16) to (19). Distances decide neither z of
coplanar joints nor the handedness, so the default lays the leg ends B of all poses on one rigid
body, with one platform pose for every group of three or more legs (two in a plane); two legs give
their distance. The platform joint predicts the whole leg: its direction is compared with the
observed one, and its length with reading plus offset:

    direction of R B + t - A = u,    |R B + t - A| = q + q0

The offsets stay free: (13) multiplies a noisy direction by the unknown length, which biases (14),
while here directions are predicted and not multiplied. A passive leg has no reading, and takes part
with its direction alone, which is (19). What joints demand of a leg (normal to its revolute axis,
no twist) are further residuals, with the axes among the unknowns: one image gives a poor pose
of the platform, and an axis computed from such poses inherits that; all demands together make the
poses much better, and the joints with them.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cache
from itertools import combinations

import casadi as ca
import numpy as np

from legcal.errors import DidNotConverge, NotIdentifiable
from legcal.geometry import Array, BoolArray, IntArray
from legcal.machine import Demand, Leg, LegKind, linearize
from legcal.paper.joints_in_base import JointsInBase
from legcal.paper.joints_in_camera import JointsInCamera
from legcal.paper.least_squares import LeastSquares, Solution, Term, solve_least_squares
from legcal.paper.leg_demands import (
    direction_of_leg,
    fixed_on_platform,
    length_of_leg,
    revolute_on_platform,
    twist_of_leg,
    twisting_legs,
)
from legcal.paper.leg_directions import LegDirections
from legcal.paper.motions import axis_frames, whitener
from legcal.paper.nominal import Criteria, NominalMachine, Transformation
from legcal.paper.offsets import (
    Offsets,
    distance_of_ends,
    distance_sigma,
    leg_end_covariance,
    leg_ends,
    observed_legs,
)
from legcal.paper.platform_pose import PlatformPoses, locate_platform
from legcal.paper.platform_printed import platform_as_printed
from legcal.paper.platform_unknowns import (
    BASE_TURNS,
    LENGTH,
    OF_B,
    PLATFORM_TURNS,
    TWIST,
    PlatformUnknowns,
    held_at_nominal,
    near_nominal,
)

_APART = 1e-3  # mean leg lengths: nearer joints count as one, whose distance has no direction
_RELATIVE = 1e-5  # of the mean length: floor of the sigma of a length, keeps it well conditioned
_EXACT = 1e-5  # [rad] floor of the sigma of a demand: keeps exact base joints well conditioned
_IN_PLANE = np.array([0, 1, -1, -1, -1, 2])  # of displacement and turn of a planar platform
KEPT_NEAR = (
    "Step 4 kept the axes of legs without an S joint near the nominal ones: the poses show them "
    "too poorly to find them alone."
)


@dataclass(frozen=True, eq=False)
class PlatformJoints:
    """The legs with all that step 4 finds."""

    # A and revolute axes at the base as step 2 found them; offsets of step 3, improved by the
    # default criterion; B, axes on the platform, universal axes at the base, twists
    legs: tuple[Leg, ...]
    solution: Solution  # free coordinates of B in R_e first
    diagnostics: tuple[str, ...] = ()  # what was left at nominal, and why

    @property
    def B_Re(self) -> Array:
        """Platform joint centres in R_e, (n_legs, 3) [m]."""
        return np.array([leg.B for leg in self.legs])

    @property
    def q0(self) -> Array:
        """Offsets and lengths, (n_legs,) [m]; NaN for passive legs."""
        return np.array([np.nan if leg.kind is LegKind.PASSIVE else leg.q0 for leg in self.legs])


def locate_platform_joints(
    machine: NominalMachine,
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

    (18) is solved by point equality, or as printed in the literal steps, unless ``transformation``
    says otherwise; the default criterion only starts there. Raises NotIdentifiable if the images do
    not tie all joints together, or leave something open that moves the platform; DidNotConverge.
    """
    known = replace(
        machine,
        legs=tuple(
            replace(
                leg,
                A=base.A_Rb[j],
                base_axis=base.base_axes[j] if machine.revolute[j] else leg.base_axis,
                q0=float(offsets.q0[j]) if np.isfinite(offsets.q0[j]) else leg.q0,
            )
            for j, leg in enumerate(machine.legs)
        ),
    )
    unknowns = PlatformUnknowns.of(known, free_twists=free_twists)
    how = chosen_transformation(transformation, criteria)
    if criteria == "literal":
        return PlatformJoints(*platform_as_printed(known, unknowns, base, directions, how))
    rigid = RigidProblem.of(known, unknowns, joints, base, directions, sigma_q, how)
    # What is open is judged near the nominal model: there the platform moves as it should. Axes
    # that the poses show too poorly to converge without it stay near the nominal ones.
    problem = build_rigid(rigid)
    n, terms = len(unknowns), problem.terms
    near = near_nominal(unknowns.of_closure)
    solution = solve_least_squares(replace(problem, terms=(*terms, *near)))
    found = unknowns.legs(solution.x[:n], known.legs)
    information = solution.without_last(sum(len(term.index) for term in near)).information()
    poses, nominal = rigid.poses_in_base(solution.x[n:]), unknowns.vector(known.legs)
    held, said = held_at_nominal(known, unknowns, information, found, poses, nominal)
    if near or held:
        terms = (*terms, *held)
        problem = replace(problem, terms=terms, start=solution.x)
        try:
            solution = solve_least_squares(problem)
        except DidNotConverge:
            solution = solve_least_squares(replace(problem, terms=(*terms, *near)))
            said = (*said, KEPT_NEAR)
        found = unknowns.legs(solution.x[:n], known.legs)
    return PlatformJoints(found, solution, said)


def chosen_transformation(
    transformation: Transformation | None, criteria: Criteria
) -> Transformation:
    """Return how (18) is solved: point equality by default, as printed in the literal steps."""
    if transformation is not None:
        return transformation
    return "cross_product" if criteria == "literal" else "points"


@dataclass(frozen=True, eq=False)
class RigidProblem:
    """What the rigid criterion is built of."""

    machine: NominalMachine  # with what steps 2 and 3 found
    unknowns: PlatformUnknowns
    directions: LegDirections
    poses: PlatformPoses  # to start from
    in_base: BoolArray  # (n,), which of the directions are in R_b: twists count for these
    A_covariance: Array  # (n, 3, 3) [m^2]
    sigma_q: float  # [m]

    @classmethod
    def of(
        cls,
        known: NominalMachine,
        unknowns: PlatformUnknowns,
        joints: JointsInCamera,
        base: JointsInBase,
        directions: LegDirections,
        sigma_q: float,
        transformation: Transformation = "points",
    ) -> RigidProblem:
        """Gather it, platform poses to start from among it."""
        placed = np.array([T is not None for T in base.T_Rb_camera])
        centre = np.zeros((len(directions), 3))
        for v, T in enumerate(base.T_Rb_camera):
            if T is not None:
                centre[directions.view == v] = T.translation
        q0, of_A = known.parameters.offsets, _covariance_of_A(directions, joints, base)
        covariance = leg_end_covariance(directions, q0, sigma_q) + of_A
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
        in_base = placed[directions.view]
        return cls(known, unknowns, directions, poses, in_base, of_A, sigma_q)

    def index(self, rows: IntArray) -> IntArray:
        """Return the places of B and of the step of the pose of some of the legs, (k, 9)."""
        own = np.arange(6) if self.machine.spatial else _IN_PLANE
        first = len(self.unknowns) + (own.max() + 1) * self.poses.pose[rows, None]
        steps = np.where(own >= 0, first + own, -1)
        return np.hstack([self.unknowns.place[self.directions.leg[rows], OF_B], steps])

    def known(self, rows: IntArray) -> tuple[Array, Array, Array, Array]:
        """Return what is known of some of the legs: B in part, the pose at step zero, and A."""
        pose, held = self.poses.pose[rows], self.unknowns.held[self.directions.leg[rows]]
        return held, self.poses.R[pose], self.poses.t[pose], self.directions.A[rows]

    def sigma(self, rows: IntArray, demand: Demand, least: float) -> Array:
        """Return standard deviations of a demand (k,): at least one, and what A is wrong by.

        Lengths and demands hold exactly, but between joints A that have errors: an error of A
        changes the length and the direction of the leg by far more than a reading is wrong.
        """
        directions, variance = self.directions, np.zeros(len(rows))
        key = np.column_stack([directions.leg[rows], directions.A[rows]])
        _, first, which = np.unique(key, axis=0, return_index=True, return_inverse=True)
        for k, i in enumerate(first):
            here = np.flatnonzero(which.ravel() == k)
            of_leg = self.machine.legs[directions.leg[rows[i]]]
            pose = self.poses.pose[rows[here]]
            linear = linearize(
                replace(of_leg, A=directions.A[rows[i]]), self.poses.R[pose], self.poses.t[pose]
            )
            by_A = linear.by_local[:, linear.demands.index(demand), :3]
            of_A = self.A_covariance[rows[here]]
            variance[here] = np.einsum("ni,nij,nj->n", by_A, of_A, by_A)
        return np.asarray(np.sqrt(least**2 + variance))

    def poses_in_base(self, x: Array) -> tuple[Array, Array]:
        """Return R and t of the poses of groups in R_b, from the unknowns of all poses."""
        steps = np.zeros((len(self.poses.R), 6))
        own = np.arange(6) if self.machine.spatial else _IN_PLANE
        steps[:, own >= 0] = x.reshape(len(steps), own.max() + 1)
        numbers = np.unique(self.poses.pose[self.in_base])
        return self.poses.stepped(steps, numbers[numbers >= 0])


def _covariance_of_A(
    directions: LegDirections, joints: JointsInCamera, base: JointsInBase
) -> Array:
    """Return the covariance of A of each leg in the frame of its group, (n, 3, 3) [m^2].

    Cameras that step 2 placed know A together; errors of their places are not counted.
    """
    together = np.zeros((joints.located.shape[1], 3, 3))
    alone = joints.covariance[directions.view, directions.leg, :3, :3]
    for v, T in enumerate(base.T_Rb_camera):
        if T is not None:
            R, seen = T.rotation.as_matrix(), joints.located[v]
            together[seen] += R @ np.linalg.inv(joints.covariance[v, seen, :3, :3]) @ R.T
    placed = np.array([T is not None for T in base.T_Rb_camera])
    known = np.einsum("nii->n", together) > 0.0
    together[known] = np.linalg.inv(together[known])
    return np.where(placed[directions.view, None, None], together[directions.leg], alone)


def build_rigid(rigid: RigidProblem) -> LeastSquares:
    """Build the rigid criterion in standard deviations; the legs of ``rigid`` are the start.

    Axes in closed form from poses of noisy ends are further off than the nominal model. Raises
    NotIdentifiable if no pose shows two legs at once.
    """
    directions, poses, machine = rigid.directions, rigid.poses, rigid.machine
    q0, B = machine.parameters.offsets, machine.parameters.platform_joints
    mean_offset = np.mean(q0[np.isfinite(q0)])
    posed = np.flatnonzero(poses.pose >= 0)
    # Groups without a pose: distances between ends are all they give.
    alone = np.isfinite(q0[directions.leg]) & (poses.pose < 0)
    pairs = np.array(
        [
            (a, b)
            for rows in directions.groups()
            for a, b in combinations(rows[alone[rows]].tolist(), 2)
            if np.linalg.norm(B[directions.leg[a]] - B[directions.leg[b]]) > _APART * mean_offset
        ],
        dtype=np.intp,
    ).reshape(-1, 2)
    if not len(posed) and not len(pairs):
        raise NotIdentifiable(
            "The platform joints could not be located: no pose shows two legs at once; needed "
            "images of three or more; add images that show several legs at once."
        )
    covariance = leg_end_covariance(directions, q0, rigid.sigma_q)
    place = rigid.unknowns.place[directions.leg]
    of_pairs = place[pairs]
    index = np.hstack([of_pairs[:, :, LENGTH], of_pairs[:, :, OF_B].reshape(-1, 6)])
    sigma = distance_sigma(leg_ends(directions, q0), covariance, pairs)
    ended = posed[np.isfinite(q0[directions.leg[posed]])]
    sigma_length = float(np.hypot(rigid.sigma_q, _RELATIVE * mean_offset))
    seen = directions.u[posed], directions.basis[posed], whitener(directions.covariance[posed])
    read = directions.reading[ended], rigid.sigma(ended, Demand.LENGTH, sigma_length)
    lengths = np.hstack([rigid.index(ended), place[ended, LENGTH, None]])
    terms = [
        Term(_ends_and_joints(), index, (observed_legs(directions, pairs), sigma), robust=True),
        Term(direction_of_leg(), rigid.index(posed), (*rigid.known(posed), *seen), robust=True),
        Term(length_of_leg(), lengths, (*rigid.known(ended), *read)),
        *_demands(rigid, posed),
    ]
    x = rigid.unknowns.vector(machine.legs)
    steps = np.zeros((6 if machine.spatial else 3) * len(poses.R))
    start = np.concatenate([x, steps])
    return LeastSquares("The platform joints (step 4)", tuple(terms), start, n_shared=len(x))


@cache
def _ends_and_joints() -> ca.Function:
    """Return (q0 and B of two legs; legs, sigma) -> distance seen less that of B, in sigmas."""
    local, legs, sigma = ca.SX.sym("local", 8), ca.SX.sym("legs", 7, 2), ca.SX.sym("sigma")
    miss = (distance_of_ends(local[:2], legs) - ca.norm_2(local[2:5] - local[5:])) / sigma
    return ca.Function("ends", [local, legs, sigma], [miss])


def _demands(rigid: RigidProblem, rows: IntArray) -> list[Term]:
    """Return what joints demand of legs whose poses are unknown, in standard deviations."""
    legs, nominal = rigid.machine.legs, rigid.unknowns.nominal
    leg, terms = rigid.directions.leg[rows], []
    for joint, function, demand in (
        ("R", revolute_on_platform(), Demand.PLATFORM_AXIS),
        ("", fixed_on_platform(), Demand.ALONG_1),
    ):
        of_joint = np.array(
            [g.platform_joint == joint and g.platform_axis is not None for g in legs]
        )
        here, of_leg = rows[of_joint[leg]], leg[of_joint[leg]]
        if len(here):
            index = np.hstack([rigid.index(here), rigid.unknowns.place[of_leg, PLATFORM_TURNS]])
            frames = _frames([nominal[j].platform_axis for j in of_leg])
            sigma = rigid.sigma(here, demand, _EXACT)
            terms.append(Term(function, index, (*rigid.known(here), frames, sigma)))
    for joints, of_kind in twisting_legs(legs).items():
        here = rows[of_kind[leg] & rigid.in_base[rows]]
        if len(here):
            of_leg = rigid.directions.leg[here]
            place = rigid.unknowns.place[of_leg]
            turns = place[:, PLATFORM_TURNS], place[:, BASE_TURNS], place[:, TWIST, None]
            observed = (
                _frames([nominal[j].base_axis for j in of_leg]),
                _frames([nominal[j].platform_axis for j in of_leg]),
                np.array([float(nominal[j].twist or 0.0) for j in of_leg]),
                rigid.sigma(here, Demand.TWIST, _EXACT),
            )
            index = np.hstack([rigid.index(here), *turns])
            terms.append(Term(twist_of_leg(*joints), index, (*rigid.known(here), *observed)))
    return terms


def _frames(axes: list[Array | None]) -> Array:
    """Return the frames of axes that legs have, (n, 3, 3)."""
    return axis_frames(np.array(axes, dtype=np.float64))
