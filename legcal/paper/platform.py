"""Section 3.5: joints and axes on the platform, universal axes at the base, passive legs.

As printed (``literal``) they follow one by one, (16) to (19). Distances decide neither z of
coplanar joints nor the handedness, so the default lays the leg ends B of all poses on one rigid
body, with one platform pose for every group of three or more legs (two in a plane); two legs give
their distance. The platform joint predicts the whole leg: its direction is compared with the
observed one, and its length with reading plus offset:

    direction of R B + t - A = u,    |R B + t - A| = q + q0

The offsets stay free: (13) multiplies a noisy direction by the unknown length, which biases (14),
while here directions are predicted and not multiplied. A passive leg has no reading, and takes part
with its direction alone, which is (19). The constraints of a leg (normal to its revolute
axis, no twist) are further residuals, with the axes among the unknowns: one image gives a poor pose
of the platform, and an axis computed from such poses inherits that; all constraints together make
the poses much better, and the joints with them.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cache
from itertools import combinations

import casadi as ca
import numpy as np

from legcal.errors import DidNotConverge, NotIdentifiable
from legcal.geometry.covariances import whitener
from legcal.geometry.types import Array, BoolArray, IntArray
from legcal.machine.equations import leg_equations
from legcal.machine.leg import EquationKind, JointType, Leg, LegColumns
from legcal.paper.criteria import Criteria, Transformation
from legcal.paper.joints_in_base import JointsInBase
from legcal.paper.joints_in_camera import JointsInCamera
from legcal.paper.least_squares import LeastSquares, Term, solve_least_squares
from legcal.paper.leg_directions import LegDirections
from legcal.paper.leg_equations import constraint_of_leg, direction_of_leg, length_of_leg
from legcal.paper.nominal import NominalMachine
from legcal.paper.offsets import (
    distance_of_ends,
    distance_sigma,
    leg_end_covariance,
    leg_ends,
    observed_legs,
)
from legcal.paper.platform_pose import PlatformPoses, locate_platform
from legcal.paper.platform_printed import platform_as_printed
from legcal.paper.unknowns import Unknowns
from legcal.paper.weak_directions import fix_weak_directions, nominal_prior

_APART = 1e-3  # mean leg lengths: nearer joints count as one, whose distance has no direction
_MIN_SIGMA_LENGTH = 1e-5  # of the mean length: keeps exact sessions well conditioned
_MIN_SIGMA_CONSTRAINT = 1e-5  # [rad]: the same
_IN_PLANE = np.array([0, 1, -1, -1, -1, 2])  # of displacement and turn of a planar platform
NEAR_NOMINAL = (
    "Step 4 kept the axes of legs without an S joint near the nominal ones: the poses show them "
    "too poorly to find them alone."
)


def locate_platform_joints(
    machine: NominalMachine,
    base: JointsInBase,
    directions: LegDirections,
    sigma_q: float,
    *,
    criteria: Criteria = "default",
    transformation: Transformation | None = None,
    free_twists: bool = False,
) -> tuple[NominalMachine, tuple[str, ...]]:
    """Return the machine of steps 2 and 3 with all that step 4 estimates, and diagnostics.

    These are B, axes on the platform, universal axes at the base, twists if they are freed, and
    offsets again by the default criterion; diagnostics say what was left at nominal, and why. (18)
    is solved by point equality, or as printed in the literal steps, unless ``transformation`` says
    otherwise; the default criterion only starts there. Raises NotIdentifiable if the images do not
    tie all joints together, or do not determine something that moves the platform; DidNotConverge.
    """
    if transformation is None:
        transformation = "cross_product" if criteria == "literal" else "points"
    unknowns = Unknowns.of_platform(machine, free_twists=free_twists)
    if criteria == "literal":
        legs, diagnostics = platform_as_printed(machine, unknowns, base, directions, transformation)
        return replace(machine, legs=legs), diagnostics
    rigid = RigidProblem.of(machine, unknowns, base, directions, sigma_q, transformation)
    # What is not determined is judged near the nominal model: there the platform moves as it
    # should. Axes that the poses show too poorly to converge without it stay near the nominal ones.
    problem = build_rigid_platform(rigid)
    n, terms = len(unknowns), problem.terms
    twisting = [leg.twist is not None for leg in machine.legs]
    turns = unknowns.place[twisting, LegColumns.BASE_AXIS.start : LegColumns.OWN]
    prior = nominal_prior(np.unique(turns[turns >= 0]))
    solution = solve_least_squares(replace(problem, terms=(*terms, *prior)))
    legs = unknowns.legs(solution.x, machine.legs)
    information = solution.without_last(sum(len(term.index) for term in prior)).information()
    poses, nominal = rigid.poses_in_base(solution.x[n:]), unknowns.vector(machine.legs)
    fixed, diagnostics = fix_weak_directions(machine, unknowns, information, legs, poses, nominal)
    if prior or fixed:
        terms = (*terms, *fixed)
        problem = replace(problem, terms=terms, start=solution.x)
        try:
            solution = solve_least_squares(problem)
        except DidNotConverge:
            solution = solve_least_squares(replace(problem, terms=(*terms, *prior)))
            diagnostics = (*diagnostics, NEAR_NOMINAL)
        legs = unknowns.legs(solution.x, machine.legs)
    return replace(machine, legs=legs), diagnostics


_OF_STEP_4 = {EquationKind.PLATFORM_AXIS, EquationKind.DIRECTION_1, EquationKind.TWIST}


@dataclass(frozen=True, eq=False)
class RigidProblem:
    """What the rigid criterion is built of."""

    machine: NominalMachine  # as steps 2 and 3 have it: the start
    unknowns: Unknowns
    directions: LegDirections
    poses: PlatformPoses  # to start from
    in_base: BoolArray  # (n,), which of the directions are in R_b: twists count for these
    A_covariance: Array  # (n, 3, 3) [m^2]
    sigma_q: float  # [m]

    @classmethod
    def of(
        cls,
        machine: NominalMachine,
        unknowns: Unknowns,
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
        q0, of_A = machine.offsets, _covariance_of_A(directions, base)
        covariance = leg_end_covariance(directions, q0, sigma_q) + of_A
        poses = locate_platform(
            directions,
            leg_ends(directions, q0),
            machine.parameters.platform_joints,
            centre=centre,
            transformation=transformation,
            spatial=machine.spatial,
            on_a_line=True,
            weight=1.0 / np.einsum("nii->n", covariance),
        )
        in_base = placed[directions.view]
        return cls(machine, unknowns, directions, poses, in_base, of_A, sigma_q)

    def index(self, rows: IntArray) -> IntArray:
        """Return the places of the local unknowns of :mod:`legcal.paper.leg_equations`, (k, 15)."""
        free = np.arange(6) if self.machine.spatial else _IN_PLANE
        first = len(self.unknowns) + (free.max() + 1) * self.poses.pose[rows, None]
        steps = np.where(free >= 0, first + free, -1)
        of_leg = self.unknowns.place[self.directions.leg[rows], LegColumns.B.start : LegColumns.OWN]
        return np.hstack([of_leg, steps])

    def known(self, rows: IntArray) -> tuple[Array, Array, Array, Array]:
        """Return what is known of some of the legs: B in part, the pose at step zero, and A."""
        pose, B = self.poses.pose[rows], self.unknowns.known_B[self.directions.leg[rows]]
        return B, self.poses.R[pose], self.poses.t[pose], self.directions.A[rows]

    def sigma(self, rows: IntArray, about: EquationKind, least: float) -> Array:
        """Return standard deviations of an equation (k,), *least* with an exact A.

        Lengths and constraints hold exactly, but between joints A that have errors: an error of A
        changes the length and the direction of the leg by far more than a reading is wrong.
        """
        directions, variance = self.directions, np.zeros(len(rows))
        legs = self.machine.legs
        key = np.column_stack([directions.leg[rows], directions.A[rows]])
        _, first, which = np.unique(key, axis=0, return_index=True, return_inverse=True)
        for k, i in enumerate(first):
            here = np.flatnonzero(which.ravel() == k)
            leg = _standing(legs[directions.leg[rows[i]]], directions, rows[i])
            pose = self.poses.pose[rows[here]]
            linear = leg_equations(leg, self.poses.R[pose], self.poses.t[pose])
            by_A = linear.by_local[:, linear.kinds.index(about), :3]
            of_A = self.A_covariance[rows[here]]
            variance[here] = np.einsum("ni,nij,nj->n", by_A, of_A, by_A)
        return np.asarray(np.sqrt(least**2 + variance))

    def poses_in_base(self, x: Array) -> tuple[Array, Array]:
        """Return R and t of the poses of groups in R_b, from the unknowns of all poses."""
        steps = np.zeros((len(self.poses.R), 6))
        free = np.arange(6) if self.machine.spatial else _IN_PLANE
        steps[:, free >= 0] = x.reshape(len(steps), free.max() + 1)
        numbers = np.unique(self.poses.pose[self.in_base])
        return self.poses.stepped(steps, numbers[numbers >= 0])


def _standing(leg: Leg, directions: LegDirections, i: int) -> Leg:
    """Return a leg with its joint at A where one of the directions begins."""
    axis = leg.base_axis
    if axis is not None and leg.actuator is not None:
        axis = directions.turn[i] @ axis
    return replace(leg, A=directions.A[i], base_axis=axis, actuator=None)


def _covariance_of_A(directions: LegDirections, base: JointsInBase) -> Array:
    """Return the covariance of A of each leg in the frame of its group, (n, 3, 3) [m^2].

    Cameras that step 2 placed know A together; errors of their places are not counted.
    """
    joints, leg = base.in_cameras, directions.leg
    together = np.zeros((len(leg), 3, 3))
    alone = _seen_covariance(joints, directions, directions.view)
    for v, T in enumerate(base.T_Rb_camera):
        if T is not None:
            R, located = T.rotation.as_matrix(), joints.located[v, leg]
            C = _seen_covariance(joints, directions, np.full(len(leg), v))[located]
            together[located] += R @ np.linalg.inv(C) @ R.T
    placed = np.array([T is not None for T in base.T_Rb_camera])
    known = np.einsum("nii->n", together) > 0.0
    together[known] = np.linalg.inv(together[known])
    return np.where(placed[directions.view, None, None], together, alone)


def _seen_covariance(joints: JointsInCamera, directions: LegDirections, view: IntArray) -> Array:
    """Return the covariance of A of each leg as views (n,) show it, (n, 3, 3) [m^2]."""
    C = joints.covariance[view, directions.leg, :3, :3]
    for here, carrier in joints.carried(view, directions.leg):
        by_unknowns = carrier.at(directions.q[here])[1]
        C[here] = by_unknowns @ carrier.covariance @ np.swapaxes(by_unknowns, 1, 2)
    return C


def build_rigid_platform(rigid: RigidProblem) -> LeastSquares:
    """Build the rigid criterion in standard deviations; the legs of ``rigid`` are the start.

    Axes in closed form from poses of noisy ends are further off than the nominal model. Raises
    NotIdentifiable if no pose shows two legs at once.
    """
    directions, poses, machine = rigid.directions, rigid.poses, rigid.machine
    q0, B = machine.offsets, machine.parameters.platform_joints
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
    of_pairs = rigid.unknowns.place[directions.leg][pairs]
    index = np.hstack(
        [of_pairs[:, :, LegColumns.LENGTH], of_pairs[:, :, LegColumns.B].reshape(-1, 6)]
    )
    sigma = distance_sigma(leg_ends(directions, q0), covariance, pairs)
    with_length = posed[np.isfinite(q0[directions.leg[posed]])]
    sigma_length = float(np.hypot(rigid.sigma_q, _MIN_SIGMA_LENGTH * mean_offset))
    observed = directions.u[posed], directions.basis[posed], whitener(directions.covariance[posed])
    readings = (
        directions.reading[with_length],
        rigid.sigma(with_length, EquationKind.LENGTH, sigma_length),
    )
    terms = (
        Term(_ends_and_joints(), index, (observed_legs(directions, pairs), sigma), robust=True),
        Term(direction_of_leg(), rigid.index(posed), (*rigid.known(posed), *observed), robust=True),
        Term(length_of_leg(), rigid.index(with_length), (*rigid.known(with_length), *readings)),
        *_constraints(rigid, posed),
    )
    x = rigid.unknowns.vector(machine.legs)
    steps = np.zeros((6 if machine.spatial else 3) * len(poses.R))
    start = np.concatenate([x, steps])
    return LeastSquares("The platform joints (step 4)", terms, start, n_shared=len(x))


@cache
def _ends_and_joints() -> ca.Function:
    """Return (q0 and B of two legs; legs, sigma) -> distance observed less that of B, in sigmas."""
    local, legs, sigma = ca.SX.sym("local", 8), ca.SX.sym("legs", 7, 2), ca.SX.sym("sigma")
    residual = (distance_of_ends(local[:2], legs) - ca.norm_2(local[2:5] - local[5:])) / sigma
    return ca.Function("ends", [local, legs, sigma], [residual])


def _constraints(rigid: RigidProblem, rows: IntArray) -> list[Term]:
    """Return the residuals of constraints of legs at unknown poses, in standard deviations."""
    legs, unknowns, directions, terms = rigid.machine.legs, rigid.unknowns, rigid.directions, []
    constrained: dict[tuple[EquationKind, JointType, JointType], list[int]] = {}
    for j, leg in enumerate(legs):
        for about in _OF_STEP_4.intersection(leg.equations):
            constrained.setdefault((about, leg.base_joint, leg.platform_joint), []).append(j)
    for kind, those in sorted(constrained.items()):
        usable = rows[rigid.in_base[rows]] if kind[0] is EquationKind.TWIST else rows
        here = usable[np.isin(rigid.directions.leg[usable], those)]
        if not len(here):
            continue
        of_row = rigid.directions.leg[here]
        observed = (
            directions.turn[here] @ unknowns.base_frames[of_row],
            unknowns.platform_frames[of_row],
            np.array([leg.twist or 0.0 for leg in legs])[of_row],
            rigid.sigma(here, kind[0], _MIN_SIGMA_CONSTRAINT),
        )
        index, known = rigid.index(here), rigid.known(here)
        terms.append(Term(constraint_of_leg(*kind), index, (*known, *observed)))
    return terms
