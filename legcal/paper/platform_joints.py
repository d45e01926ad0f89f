"""Section 3.5: joints and axes on the platform, universal axes at the base, passive legs.

With the offsets known, the leg ends B of every pose are points of one rigid body, the
platform: laying the poses on each other gives the joint centres in R_e. Where the platform is
tells what its axes are.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from legcal.errors import DidNotConverge, NotIdentifiable
from legcal.geometry import Array, BoolArray, IntArray, frame_on_points
from legcal.machine import LegGeometry, LegKind, tied_twist, twist_after
from legcal.paper.joints_in_base import JointsInBase, distance_of_known_joints
from legcal.paper.joints_in_camera import JointsInCamera
from legcal.paper.leg_directions import LegDirections
from legcal.paper.nominal import Criteria, NominalMechanism
from legcal.paper.offsets import Offsets, leg_ends, pairs_of_legs
from legcal.paper.platform_pose import (
    PlatformPoses,
    Transformation,
    check_located,
    chosen_transformation,
    closure_of_leg,
    locate_platform,
    register_by_rays,
)
from legcal.paper.platform_problem import (
    APART,
    B_COLUMNS,
    BASE_TURNS,
    PLATFORM_TURNS,
    TWIST,
    PlatformUnknowns,
    RigidProblem,
    axes_with_bases,
    build_rigid,
    closure_turns,
    metres,
    near_nominal,
    open_directions,
    platform_unknowns,
    rigid_problem,
    turned_axis,
)
from legcal.paper.solver import LeastSquares, Solution, Term, solve_least_squares

_SAME_DIRECTION = 1e-9  # of the normalised information: directions that differ by less are one


def directions_on_platform(directions: LegDirections, poses: PlatformPoses) -> Array:
    """Return u in R_e, (n, 3); NaN where the pose of the platform is not known."""
    u = np.full((len(directions), 3), np.nan)
    here = np.flatnonzero(poses.pose >= 0)
    u[here] = np.einsum("nij,ni->nj", poses.R[poses.pose[here]], directions.u[here])
    return u


def revolute_axis(name: str, u: Array, nominal: Array) -> Array:
    """Identify a revolute axis on the platform from v . u = 0, eq (7), unweighted.

    Parameters
    ----------
    name : str
        Name of the leg, for messages.
    u : (n, 3) array
        Directions of the leg in R_e.
    nominal : (3,) array
        The nominal axis in R_e, on whose side the result is.

    Returns
    -------
    (3,) array
        The unit axis in R_e.

    Raises
    ------
    NotIdentifiable
        If the leg has fewer than two directions in the platform.
    """
    value, vector = np.linalg.eigh(u.T @ u)
    axis = vector[:, 0]
    if value[1] <= _SAME_DIRECTION * len(u):
        raise NotIdentifiable(
            f"The revolute axis of leg {name} on the platform could not be identified: found "
            f"{_count(len(u))} in the frame of the platform, needed two different ones; add poses "
            "between which the leg turns about it."
        )
    return axis if axis @ nominal > 0.0 else -axis


def fixed_direction(name: str, u: Array) -> Array:
    """Return the direction in R_e of a leg that is fixed to the platform: the mean of u, (n, 3).

    Raises
    ------
    NotIdentifiable
        If no pose shows it.
    """
    if not len(u):
        raise NotIdentifiable(
            f"The direction of leg {name} in the platform could not be identified: found no pose "
            "that shows it together with three legs of known length, needed one; add images that "
            "show several legs at once."
        )
    total = u.sum(axis=0)
    return np.asarray(total / np.linalg.norm(total))


def _count(n_poses: int) -> str:
    """Return how many poses showed a single direction, in words."""
    if n_poses == 0:
        return "no pose that shows its direction"
    return f"one direction in {n_poses} pose{'s' * (n_poses != 1)}"


def of_leg(directions: LegDirections, poses: PlatformPoses, leg: int) -> Sequence[int]:
    """Return the places of a leg's directions whose platform pose is known."""
    here: Sequence[int] = np.flatnonzero((directions.leg == leg) & (poses.pose >= 0)).tolist()
    return here


def locate_passive_end(
    name: str,
    u: Array,
    A: Array,
    pose: tuple[Array, Array],
    B_nominal: Array,
    free: IntArray,
) -> Array:
    """Locate the platform joint centre of a passive leg: u x A B = 0 in all poses, eq (19).

    Parameters
    ----------
    name : str
        Name of the leg, for messages.
    u, A : (n, 3) array
        Directions of the leg and base joint centres [m], in the frames of groups.
    pose : (n, 3, 3) and (n, 3) array
        Rotation and position [m] of R_e in these frames.
    B_nominal : (3,) array
        Its other coordinates are kept [m].
    free : (k,) array of int
        The coordinates of B that are looked for: three; two in a plane, and on a leg that is
        fixed to the platform, along which B may lie anywhere.

    Returns
    -------
    (3,) array
        B in R_e [m], with the least sum of squares of (19), unweighted.

    Raises
    ------
    NotIdentifiable
        If the leg has fewer directions in the platform than that takes.
    """
    R, t = pose
    across = np.eye(3) - u[:, :, None] * u[:, None, :]  # its square is itself
    inside = np.swapaxes(R, 1, 2) @ across
    normal = (inside @ R).sum(axis=0)
    right = np.einsum("nij,nj->i", inside, A - t) - normal @ B_nominal
    B = B_nominal.copy()
    normal = normal[np.ix_(free, free)]
    if len(u) == 0 or np.linalg.eigvalsh(normal)[0] <= _SAME_DIRECTION * len(u):
        raise NotIdentifiable(
            f"The end of leg {name} on the platform could not be located: found "
            f"{len(u)} pose{'s' * (len(u) != 1)} of the platform that show{'s' * (len(u) == 1)} "
            "it, with axes that do not meet in one point there; needed two different directions in "
            "the platform, each seen together with three legs of known length (eq 19); add images "
            "at poses that differ more."
        )
    B[free] += np.linalg.solve(normal, right[free])
    return B


SHOWN = 1e-4  # unit of the closures together, rms: what changes them by less is not shown


def closure_unknowns(unknowns: PlatformUnknowns) -> IntArray:
    """Return which unknowns of step 4 the closure identifies: universal axes and twists."""
    columns = []
    for leg, place in zip(unknowns.nominal, unknowns.place, strict=True):
        if leg.twist is None:
            continue
        columns += place[BASE_TURNS].tolist()
        columns += place[PLATFORM_TURNS].tolist() * (leg.platform_joint == "U")
        columns.append(int(place[TWIST]))
    found = np.unique(np.array(columns, dtype=np.intp))
    return np.asarray(found[found >= 0])


def close_legs(
    known: NominalMechanism,
    unknowns: PlatformUnknowns,
    legs: tuple[LegGeometry, ...],
    directions: LegDirections,
    poses: PlatformPoses,
    in_base: BoolArray,
) -> tuple[tuple[LegGeometry, ...], tuple[str, ...]]:
    """Identify universal axes and twists by the closure, what the poses leave open at nominal.

    Parameters
    ----------
    known : NominalMechanism
        The mechanism with what steps 2 and 3 found of it.
    unknowns : PlatformUnknowns
        Those of step 4.
    legs : tuple of LegGeometry
        Legs with joints, revolute axes and directions in the platform as they were found; their
        universal axes and twists are nominal.
    directions : LegDirections
        Legs of each pose.
    poses : PlatformPoses
        Poses of the platform.
    in_base : (n,) array of bool
        Which legs stand in R_b.

    Returns
    -------
    tuple of LegGeometry
        The legs with universal axes and twists.
    tuple of str
        What was left at nominal.

    Raises
    ------
    NotIdentifiable
        If the poses leave something open that moves the platform.
    DidNotConverge
        If IPOPT does not.
    """
    wanted = closure_unknowns(unknowns)
    if not len(wanted):
        return legs, ()
    numbers = np.unique(poses.pose[in_base & (poses.pose >= 0)])
    seen = poses.R[numbers], poses.t[numbers]
    problem = build_closure(unknowns, legs, directions, poses, in_base)
    x, information = problem.start, np.zeros((0, len(wanted)))
    near = near_nominal(np.arange(len(wanted)))
    if problem.terms:
        solution = solve_least_squares(replace(problem, terms=(*problem.terms, *near)))
        x, information = solution.x, solution.without_last(len(wanted)).information()
    found = _closed(unknowns, legs, wanted, x)
    still = open_directions(known, unknowns, information, found, seen, wanted)
    if problem.terms:
        unit = metres(unknowns, still.length)[wanted]
        held = (still.holding(unit, np.zeros(len(wanted))),) if len(still.basis) else ()
        problem = replace(problem, terms=(*problem.terms, *held), start=x)
        found = _closed(unknowns, legs, wanted, solve_least_squares(problem).x)
    return found, still.sentences


def build_closure(
    unknowns: PlatformUnknowns,
    legs: tuple[LegGeometry, ...],
    directions: LegDirections,
    poses: PlatformPoses,
    in_base: BoolArray,
) -> LeastSquares:
    """Build the closure of all legs without an S joint, unweighted: sin(angle - twist) = 0.

    All are divided by one number. The parameters are those of :func:`close_legs`.

    Returns
    -------
    LeastSquares
        The unknowns are those of :func:`closure_unknowns`, in that order.
    """
    wanted = closure_unknowns(unknowns)
    renumbered = np.full(len(unknowns) + 1, -1, dtype=np.intp)
    renumbered[wanted] = np.arange(len(wanted))
    place = renumbered[unknowns.place]
    shown = in_base & (poses.pose >= 0)
    closed = np.array([leg.twist is not None for leg in legs])
    n_rows, terms = max(int(np.sum(shown & closed[directions.leg])), 1), []
    for joints in dict.fromkeys(
        (leg.base_joint, leg.platform_joint) for leg in legs if leg.twist is not None
    ):
        of_kind = np.array(
            [g.twist is not None and (g.base_joint, g.platform_joint) == joints for g in legs]
        )
        rows = np.flatnonzero(shown & of_kind[directions.leg])
        if len(rows):
            terms.append(_closure_term(joints, legs, place, directions, poses, rows, n_rows))
    return LeastSquares("The universal axes (step 4)", tuple(terms), np.zeros(len(wanted)))


def _closure_term(
    joints: tuple[str, str],
    legs: tuple[LegGeometry, ...],
    place: IntArray,
    directions: LegDirections,
    poses: PlatformPoses,
    rows: IntArray,
    n_rows: int,
) -> Term:
    """Return the closure of legs of one kind at all poses."""
    leg = directions.leg[rows]
    known: tuple[Array, ...] = (
        directions.u[rows],
        poses.R[poses.pose[rows]],
        *axes_with_bases(legs, leg, "base_axis"),
        *axes_with_bases(legs, leg, "platform_axis"),
        np.array([float(legs[j].twist or 0.0) for j in leg]),
        np.full(len(rows), SHOWN / np.sqrt(n_rows)),
    )
    of_leg = place[leg]
    index = np.hstack([of_leg[:, PLATFORM_TURNS], of_leg[:, BASE_TURNS], of_leg[:, TWIST, None]])
    return Term(closure_of_leg(*joints), index, known)


def _closed(
    unknowns: PlatformUnknowns, legs: tuple[LegGeometry, ...], wanted: IntArray, x: Array
) -> tuple[LegGeometry, ...]:
    """Return legs with universal axes turned from the nominal ones, and twists changed."""
    values = np.zeros(len(unknowns) + 1)
    values[wanted] = x
    found = []
    for leg, place in zip(legs, unknowns.place, strict=True):
        if leg.twist is not None:
            leg = replace(
                leg,
                base_axis=turned_axis(leg.base_axis, values[place[BASE_TURNS]]),
                platform_axis=turned_axis(leg.platform_axis, values[place[PLATFORM_TURNS]]),
                twist=leg.twist + float(values[place[TWIST]]),
            )
        found.append(leg)
    return tuple(found)


def platform_as_printed(
    known: NominalMechanism,
    unknowns: PlatformUnknowns,
    base: JointsInBase,
    directions: LegDirections,
    transformation: Transformation,
) -> tuple[tuple[LegGeometry, ...], Solution, tuple[str, ...]]:
    """Identify joints and axes on the platform by (16) to (19) as printed.

    Parameters
    ----------
    known : NominalMechanism
        The mechanism with what steps 2 and 3 found of it.
    unknowns : PlatformUnknowns
        What is looked for.
    base : JointsInBase
        The result of step 2.
    directions : LegDirections
        Legs of each pose in the frames of the cameras.
    transformation : {"points", "cross_product"}
        How (18) is solved, for platform and base.

    Returns
    -------
    tuple of LegGeometry
        The legs.
    Solution
        Of (16): free coordinates of B.
    tuple of str
        What was left at nominal.
    """
    solution = solve_least_squares(build_mean_distances(known, unknowns, directions))
    legs = unknowns.legs(_with_joints(unknowns, known, solution.x), known.legs)
    asked = [
        name
        for name, leg in zip(known.leg_names, legs, strict=True)
        if leg.kind is LegKind.PASSIVE or leg.platform_axis is not None or leg.twist is not None
    ]
    if not asked:
        return legs, solution, ()
    directions, centre, in_base = _in_base_frame(known, base, directions, transformation)
    ends = leg_ends(directions, known.parameters.offsets)
    B_Re = np.array([leg.B for leg in legs])
    poses = locate_platform(
        directions,
        ends,
        B_Re,
        centre=centre,
        transformation=transformation,
        spatial=known.spatial,
    )
    check_located(poses, "Axes and passive ends", f"leg {', '.join(asked)}", spatial=known.spatial)
    legs = _with_axes(known, legs, directions, poses)
    legs = _with_passive_ends(known, unknowns, legs, directions, poses)
    legs, said = close_legs(known, unknowns, legs, directions, poses, in_base)
    return _in_own_frame(known, legs), solution, said


def build_mean_distances(
    known: NominalMechanism, unknowns: PlatformUnknowns, directions: LegDirections
) -> LeastSquares:
    """Build the criterion C_3 of (16): mean distances of a view equal those in R_e.

    Two legs that end in one place have none. In a plane the heights of R_e are nominal.
    """
    q0 = known.parameters.offsets
    ends = leg_ends(directions, q0)
    pairs = pairs_of_legs(directions, q0)
    B = known.parameters.platform_joints[directions.leg[pairs]]
    apart = APART * float(np.mean(q0[np.isfinite(q0)]))
    pairs = pairs[np.linalg.norm(B[:, 1] - B[:, 0], axis=1) > apart]
    distance = np.linalg.norm(ends[pairs[:, 0]] - ends[pairs[:, 1]], axis=1)
    key = np.column_stack([directions.view[pairs[:, 0]], directions.leg[pairs]])
    distinct, which = np.unique(key, axis=0, return_inverse=True)
    which = which.ravel()
    mean = np.bincount(which, weights=distance) / np.bincount(which)
    legs = distinct[:, 1:]
    place = unknowns.place[:, B_COLUMNS]
    observed = (np.swapaxes(unknowns.held[legs], 1, 2), mean, np.ones(len(mean)))
    return LeastSquares(
        "The platform joints (eq 16)",
        (Term(distance_of_known_joints(), place[legs].reshape(-1, 6), observed),),
        unknowns.vector(known.legs)[: int(place.max()) + 1],
        exact_hessian=True,
    )


def _with_joints(unknowns: PlatformUnknowns, known: NominalMechanism, B: Array) -> Array:
    """Return the nominal unknowns with other free coordinates of B."""
    x = unknowns.vector(known.legs)
    x[: len(B)] = B
    return x


def _in_base_frame(
    known: NominalMechanism,
    base: JointsInBase,
    directions: LegDirections,
    transformation: Transformation,
) -> tuple[LegDirections, Array, BoolArray]:
    """Return directions in R_b where their camera is located, camera centres, and which these are.

    As printed the camera is where each A lies on the ray that shows it, as the platform is.
    """
    A, u, basis = directions.A.copy(), directions.u.copy(), directions.basis.copy()
    centre, in_base = np.zeros_like(A), np.zeros(len(A), dtype=np.bool_)
    for v, T in enumerate(base.T_Rb_camera):
        here = np.flatnonzero(directions.view == v)
        if T is None or not len(here):
            continue
        if transformation == "cross_product" and known.spatial:
            legs, first = np.unique(directions.leg[here], return_index=True)
            T = register_by_rays(base.A_Rb[legs], directions.A[here[first]], T.inv()).inv()
        A[here], u[here] = T.apply(A[here]), T.rotation.apply(u[here])
        basis[here] = T.rotation.apply(basis[here].reshape(-1, 3)).reshape(-1, 2, 3)
        centre[here], in_base[here] = T.translation, True
    return replace(directions, A=A, u=u, basis=basis), centre, in_base


def _with_axes(
    known: NominalMechanism,
    legs: tuple[LegGeometry, ...],
    directions: LegDirections,
    poses: PlatformPoses,
) -> tuple[LegGeometry, ...]:
    """Return legs with revolute axes on the platform, (7), and directions that are fixed to it."""
    u_Re = directions_on_platform(directions, poses)
    found = []
    for j, leg in enumerate(legs):
        name, u = known.leg_names[j], u_Re[of_leg(directions, poses, j)]
        nominal = leg.platform_axis
        if nominal is not None and leg.platform_joint == "R":
            leg = replace(leg, platform_axis=revolute_axis(name, u, nominal))
        elif nominal is not None and leg.platform_joint == "":
            leg = replace(leg, platform_axis=fixed_direction(name, u))
            if leg.twist is not None:
                leg = replace(leg, twist=tied_twist(leg, legs[j], leg.twist))
        found.append(leg)
    return tuple(found)


def _with_passive_ends(
    known: NominalMechanism,
    unknowns: PlatformUnknowns,
    legs: tuple[LegGeometry, ...],
    directions: LegDirections,
    poses: PlatformPoses,
) -> tuple[LegGeometry, ...]:
    """Return legs with the ends of passive ones, (19)."""
    found = []
    for j, leg in enumerate(legs):
        if leg.kind is LegKind.PASSIVE:
            here = np.asarray(of_leg(directions, poses, j), dtype=np.intp)
            pose = poses.pose[here]
            free = np.flatnonzero(unknowns.place[j, B_COLUMNS] >= 0)
            if j in known.frame_legs and leg.platform_joint != "":
                free = np.arange(3 if known.spatial else 2)
            B = locate_passive_end(
                known.leg_names[j],
                directions.u[here],
                directions.A[here],
                (poses.R[pose], poses.t[pose]),
                leg.B,
                free,
            )
            leg = replace(leg, B=B)
        found.append(leg)
    return tuple(found)


def _in_own_frame(
    known: NominalMechanism, legs: tuple[LegGeometry, ...]
) -> tuple[LegGeometry, ...]:
    """Return legs with the platform in R_e, where passive legs among the frame legs were moved."""
    frame = list(known.frame_legs)
    if all(legs[j].kind is not LegKind.PASSIVE for j in frame):
        return legs
    T = frame_on_points(np.array([legs[j].B for j in frame])).inv()
    return tuple(
        replace(
            leg,
            B=np.where(_zero(known, j), 0.0, T.apply(leg.B)),
            platform_axis=None
            if leg.platform_axis is None
            else np.asarray(T.rotation.apply(leg.platform_axis)),
            twist=twist_after(leg, T.rotation),
        )
        for j, leg in enumerate(legs)
    )


def _zero(known: NominalMechanism, leg: int) -> BoolArray:
    """Return which coordinates of a leg's joints are zero by the choice of the frame, (3,)."""
    if leg not in known.frame_legs:
        return np.zeros(3, dtype=np.bool_)
    of_frame = np.arange(3) >= known.frame_legs.index(leg)
    return of_frame & (np.arange(3) < len(known.frame_legs))


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
