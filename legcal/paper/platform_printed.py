"""Section 3.5 as printed: joints and axes on the platform by eqs (16) to (19), one by one.

With the offsets known, the leg ends B of every pose are points of one rigid body. Mean distances
of a view equal those in the platform frame R_e (16):

    C_3 = sum over views and pairs of legs (mean |B_j B_g| in R_c - |B_j B_g| in R_e)^2

Where the platform is (18) gives revolute axes on the platform by v . u = 0 (7), the ends of passive
legs by u x A B = 0 (19), universal axes and twists by the closure of legs without an S joint.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from legcal.errors import NotIdentifiable
from legcal.geometry.axes import turned_axis
from legcal.geometry.motions import frame_on_points
from legcal.geometry.types import Array, BoolArray, IntArray
from legcal.machine.leg import EquationKind, JointType, Leg, LegColumns, LegKind
from legcal.machine.parameters import tied_twist, twist_after
from legcal.paper.criteria import Transformation
from legcal.paper.gibbs import angles_of, axis_frames
from legcal.paper.joints_in_base import JointsInBase, distance_of_joints
from legcal.paper.least_squares import LeastSquares, Term, solve_least_squares
from legcal.paper.leg_directions import LegDirections
from legcal.paper.leg_equations import closure_of_leg
from legcal.paper.nominal import NominalMachine
from legcal.paper.offsets import leg_ends, pairs_of_legs
from legcal.paper.platform_pose import PlatformPoses, locate_platform, register_by_rays
from legcal.paper.unknowns import Unknowns
from legcal.paper.weak_directions import fix_weak_directions, nominal_prior

_APART = 1e-3  # mean leg lengths: nearer joints count as one, whose distance has no direction
_SAME_DIRECTION = 1e-9  # of the normalised information: directions that differ by less are one
_SIGMA_CLOSURE = 1e-4  # of all closures together, rms: what changes them by less is not observed


def platform_as_printed(
    machine: NominalMachine,
    unknowns: Unknowns,
    base: JointsInBase,
    directions: LegDirections,
    transformation: Transformation,
) -> tuple[tuple[Leg, ...], tuple[str, ...]]:
    """Identify joints and axes on the platform by (16) to (19).

    ``machine`` has what steps 2 and 3 estimated; directions are in the frames of the cameras.
    Returns the legs, and what was left at nominal, in words.
    """
    distances = solve_least_squares(build_mean_distances(machine, unknowns, directions)).x
    x = unknowns.vector(machine.legs)
    x[: len(distances)] = distances
    legs = unknowns.legs(x, machine.legs)
    unposed = [
        name
        for name, leg in zip(machine.leg_names, legs, strict=True)
        if leg.kind is LegKind.PASSIVE or leg.platform_axis is not None or leg.twist is not None
    ]
    if not unposed:
        return legs, ()
    directions, centre, in_base = _in_base_frame(machine, base, directions, transformation)
    poses = locate_platform(
        directions,
        leg_ends(directions, machine.offsets),
        np.array([leg.B for leg in legs]),
        centre=centre,
        transformation=transformation,
        spatial=machine.spatial,
    )
    if not len(poses.R):
        number = "three" if machine.spatial else "two"
        shape = " that do not lie on one line" if machine.spatial else ""
        raise NotIdentifiable(
            f"Axes and passive ends of leg {', '.join(unposed)} could not be identified: no pose "
            f"shows {number} legs of known length at once with ends{shape}, needed to know where "
            "the platform is (eq 18); add images that show several legs at once."
        )
    legs = tuple(
        _with_axis_and_end(machine, unknowns, j, leg, directions, poses)
        for j, leg in enumerate(legs)
    )
    legs, diagnostics = _close_legs(machine, unknowns, legs, directions, poses, in_base)
    return _in_own_frame(machine, legs), diagnostics


def build_mean_distances(
    machine: NominalMachine, unknowns: Unknowns, directions: LegDirections
) -> LeastSquares:
    """Build the criterion C_3 of (16): mean distances of a view equal those in R_e.

    Two legs that end in one place have none. In a plane the heights of R_e are nominal.
    """
    q0 = machine.offsets
    ends = leg_ends(directions, q0)
    pairs = pairs_of_legs(directions, q0)
    B = machine.parameters.platform_joints[directions.leg[pairs]]
    apart = _APART * float(np.mean(q0[np.isfinite(q0)]))
    pairs = pairs[np.linalg.norm(B[:, 1] - B[:, 0], axis=1) > apart]
    distance = np.linalg.norm(ends[pairs[:, 0]] - ends[pairs[:, 1]], axis=1)
    key = np.column_stack([directions.view[pairs[:, 0]], directions.leg[pairs]])
    distinct, which = np.unique(key, axis=0, return_inverse=True)
    which = which.ravel()
    mean = np.bincount(which, weights=distance) / np.bincount(which)
    legs = distinct[:, 1:]
    place = unknowns.place[:, LegColumns.B]
    observed = (np.swapaxes(unknowns.known_B[legs], 1, 2), mean, np.ones(len(mean)))
    return LeastSquares(
        "The platform joints (eq 16)",
        (Term(distance_of_joints(), place[legs].reshape(-1, 6), observed),),
        unknowns.vector(machine.legs)[: int(place.max()) + 1],
        exact_hessian=True,
    )


def _in_base_frame(
    machine: NominalMachine,
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
        if transformation == "cross_product" and machine.spatial:
            legs = np.unique(directions.leg[here])
            T = register_by_rays(base.A_Rb[legs], base.in_cameras.A_camera[v, legs], T.inv()).inv()
        A[here], u[here] = T.apply(A[here]), T.rotation.apply(u[here])
        basis[here] = T.rotation.apply(basis[here].reshape(-1, 3)).reshape(-1, 2, 3)
        centre[here], in_base[here] = T.translation, True
    return replace(directions, A=A, u=u, basis=basis), centre, in_base


# Axes on the platform and passive ends


def _with_axis_and_end(
    machine: NominalMachine,
    unknowns: Unknowns,
    j: int,
    leg: Leg,
    directions: LegDirections,
    poses: PlatformPoses,
) -> Leg:
    """Return leg *j* with its axis on the platform, (7), and its end if it is passive, (19)."""
    name, nominal = machine.leg_names[j], leg.platform_axis
    here = np.flatnonzero((directions.leg == j) & (poses.pose >= 0))
    u, R, t = directions.u[here], poses.R[poses.pose[here]], poses.t[poses.pose[here]]
    u_Re = np.einsum("nij,ni->nj", R, u)
    if nominal is not None and EquationKind.PLATFORM_AXIS in leg.equations:
        leg = replace(leg, platform_axis=revolute_axis(name, u_Re, nominal))
    elif nominal is not None and leg.is_fixed_to_platform:
        fixed = replace(leg, platform_axis=fixed_direction(name, u_Re))
        twist = None if leg.twist is None else tied_twist(fixed, leg, leg.twist)
        leg = replace(fixed, twist=twist)
    if leg.kind is LegKind.PASSIVE:
        free = np.flatnonzero(unknowns.place[j, LegColumns.B] >= 0)
        if j in machine.frame_legs and not leg.is_fixed_to_platform:
            free = np.arange(3 if machine.spatial else 2)
        B = locate_passive_end(name, u, directions.A[here], (R, t), leg.B, free)
        leg = replace(leg, B=B)
    return leg


def revolute_axis(name: str, u: Array, nominal: Array) -> Array:
    """Return a revolute axis in R_e (3,) from v . u = 0 (7), u (n, 3) in R_e, on the nominal side.

    Raises NotIdentifiable if the leg has fewer than two directions in the platform.
    """
    value, vector = np.linalg.eigh(u.T @ u)
    axis = vector[:, 0]
    if value[1] <= _SAME_DIRECTION * len(u):
        found = f"one direction in {len(u)} pose{'s' * (len(u) != 1)}"
        raise NotIdentifiable(
            f"The revolute axis of leg {name} on the platform could not be identified: found "
            f"{found if len(u) else 'no pose that shows its direction'} in the frame of the "
            "platform, needed two different ones; add poses between which the leg turns about it."
        )
    return axis if axis @ nominal > 0.0 else -axis


def fixed_direction(name: str, u: Array) -> Array:
    """Return the direction in R_e of a leg that is fixed to the platform: the mean of u (n, 3).

    Raises NotIdentifiable if no pose shows it.
    """
    if not len(u):
        raise NotIdentifiable(
            f"The direction of leg {name} in the platform could not be identified: found no pose "
            "that shows it together with three legs of known length, needed one; add images that "
            "show several legs at once."
        )
    total = u.sum(axis=0)
    return np.asarray(total / np.linalg.norm(total))


def locate_passive_end(
    name: str,
    u: Array,
    A: Array,
    pose: tuple[Array, Array],
    B_nominal: Array,
    free: IntArray,
) -> Array:
    """Return the platform joint centre (3,) of a passive leg: u x A B = 0 in all poses, eq (19).

    u and A (n, 3) are in the frames of groups, as is the pose, R (n, 3, 3) and t (n, 3). Only the
    ``free`` coordinates of B are looked for: three; two in a plane, and on a leg that is fixed to
    the platform, along which B may lie anywhere. Raises NotIdentifiable if the leg has too few
    directions in the platform.
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


# Universal axes and twists


def _close_legs(
    machine: NominalMachine,
    unknowns: Unknowns,
    legs: tuple[Leg, ...],
    directions: LegDirections,
    poses: PlatformPoses,
    in_base: BoolArray,
) -> tuple[tuple[Leg, ...], tuple[str, ...]]:
    """Identify universal axes and twists by the closure, what the poses leave open at nominal.

    ``legs`` have all else as it was found. Returns them, and what was left at nominal, in words.
    """
    twisting = np.array([leg.twist is not None for leg in unknowns.start])
    known_axis = np.array([leg.platform_joint is not JointType.UNIVERSAL for leg in unknowns.start])
    turns = unknowns.place[twisting, LegColumns.BASE_AXIS.start : LegColumns.OWN]
    wanted = np.setdiff1d(turns[turns >= 0], unknowns.place[known_axis, LegColumns.PLATFORM_AXIS])
    if not len(wanted):
        return legs, ()
    numbers = np.unique(poses.pose[in_base & (poses.pose >= 0)])
    observed = poses.R[numbers], poses.t[numbers]
    problem = _build_closure(unknowns, wanted, legs, directions, poses, in_base)
    x, information = problem.start, np.zeros((0, len(wanted)))
    prior = nominal_prior(np.arange(len(wanted)))
    if problem.terms:
        solution = solve_least_squares(replace(problem, terms=(*problem.terms, *prior)))
        x, information = solution.x, solution.without_last(len(wanted)).information()
    closed = _closed(unknowns, legs, wanted, x)
    fixed, diagnostics = fix_weak_directions(
        machine, unknowns, information, closed, observed, np.zeros(len(wanted)), wanted
    )
    if problem.terms:
        problem = replace(problem, terms=(*problem.terms, *fixed), start=x)
        closed = _closed(unknowns, legs, wanted, solve_least_squares(problem).x)
    return closed, diagnostics


def _build_closure(
    unknowns: Unknowns,
    wanted: IntArray,
    legs: tuple[Leg, ...],
    directions: LegDirections,
    poses: PlatformPoses,
    in_base: BoolArray,
) -> LeastSquares:
    """Build the closure of all legs without an S joint: sin(angle - twist) = 0, unweighted."""
    renumbered = np.full(len(unknowns) + 1, -1, dtype=np.intp)
    renumbered[wanted] = np.arange(len(wanted))
    place = renumbered[unknowns.place]
    shown = in_base & (poses.pose >= 0)
    twisting = [(j, leg) for j, leg in enumerate(legs) if leg.twist is not None]
    n_rows = int(np.sum(shown & np.isin(directions.leg, [j for j, _ in twisting])))
    terms = []
    for joints in dict.fromkeys((leg.base_joint, leg.platform_joint) for _, leg in twisting):
        of_kind = [j for j, leg in twisting if (leg.base_joint, leg.platform_joint) == joints]
        rows = np.flatnonzero(shown & np.isin(directions.leg, of_kind))
        if not len(rows):
            continue
        leg = directions.leg[rows]
        observed = (
            directions.u[rows],
            poses.R[poses.pose[rows]],
            axis_frames(np.array([legs[j].base_axis for j in leg], dtype=np.float64)),
            axis_frames(np.array([legs[j].platform_axis for j in leg], dtype=np.float64)),
            np.array([float(legs[j].twist or 0.0) for j in leg]),
            np.full(len(rows), _SIGMA_CLOSURE / np.sqrt(n_rows)),
        )
        terms.append(
            Term(
                closure_of_leg(*joints),
                place[leg, LegColumns.BASE_AXIS.start : LegColumns.OWN],
                observed,
            )
        )
    return LeastSquares("The universal axes (step 4)", tuple(terms), np.zeros(len(wanted)))


def _closed(
    unknowns: Unknowns, legs: tuple[Leg, ...], wanted: IntArray, x: Array
) -> tuple[Leg, ...]:
    """Return legs with universal axes turned from the nominal ones, and twists changed."""
    values = np.zeros(len(unknowns) + 1)
    values[wanted] = x
    found = []
    for leg, own in zip(legs, values[unknowns.place], strict=True):
        if leg.twist is not None and leg.base_axis is not None and leg.platform_axis is not None:
            base, platform = (
                turned_axis(axis, angles_of(own[columns]))
                for axis, columns in (
                    (leg.base_axis, LegColumns.BASE_AXIS),
                    (leg.platform_axis, LegColumns.PLATFORM_AXIS),
                )
            )
            twist = leg.twist + float(own[LegColumns.TWIST])
            leg = replace(leg, base_axis=base, platform_axis=platform, twist=twist)
        found.append(leg)
    return tuple(found)


def _in_own_frame(machine: NominalMachine, legs: tuple[Leg, ...]) -> tuple[Leg, ...]:
    """Return legs with the platform in R_e, where passive legs among the frame legs were moved."""
    frame = list(machine.frame_legs)
    if all(legs[j].kind is not LegKind.PASSIVE for j in frame):
        return legs
    T = frame_on_points(np.array([legs[j].B for j in frame])).inv()
    found = []
    for j, leg in enumerate(legs):
        B, axis = T.apply(leg.B), leg.platform_axis
        if j in frame:  # coordinates that are zero by the choice of the frame
            B[frame.index(j) : len(frame)] = 0.0
        axis = None if axis is None else np.asarray(T.rotation.apply(axis))
        found.append(replace(leg, B=B, platform_axis=axis, twist=twist_after(leg, T.rotation)))
    return tuple(found)
