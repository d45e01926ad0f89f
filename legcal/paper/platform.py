"""Section 3.5: joints and axes on the platform, universal axes at the base, passive legs.

With the offsets known, the leg ends B of every pose are points of one rigid body. Mean distances
of a view equal those in the platform frame R_e (16):

    C_3 = sum over views and pairs of legs (mean |B_j B_g| in R_c - |B_j B_g| in R_e)^2

With weights, joints, offsets and poses of the platform are then solved for together by (18), which
determines z of coplanar joints too. The poses of the platform give revolute axes on it by
v . u = 0 (7), the ends of passive legs by u x A B = 0 (19), universal axes and twists by the
closure of legs without an S joint.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from legcal.errors import NotIdentifiable
from legcal.geometry.lines import turned_axis
from legcal.geometry.motions import frame_on_points
from legcal.geometry.types import Array, BoolArray, IntArray
from legcal.machine.leg import EquationKind, JointType, Leg, LegColumns, LegKind
from legcal.machine.parameters import tied_twist, twist_after
from legcal.paper.equations import (
    angles_of,
    axis_frames,
    closure_of_leg,
    distance_of_ends,
    end_of_leg,
    end_on_axis,
    end_on_ray,
    mean_distance,
    stepped_poses,
)
from legcal.paper.joints_in_base import JointsInBase
from legcal.paper.joints_in_camera import AcrossAxes
from legcal.paper.least_squares import (
    LeastSquares,
    Term,
    derivatives,
    evaluated,
    solve_least_squares,
)
from legcal.paper.offsets import LegDirections, pairs_of_legs
from legcal.paper.platform_pose import PlatformPoses, across_rays, locate_platform
from legcal.paper.unknowns import (
    NominalMachine,
    Unknowns,
    hold_at_nominal,
    left_near_nominal,
    with_prior,
)

_APART = 1e-3  # [mean leg lengths] minimum distance of separate joints
_SAME_DIRECTION = 1e-9  # minimum eigenvalue of the normalised information of different directions
_SIGMA_CLOSURE = 1e-4  # standard deviation of all closures together, rms


def locate_platform_joints(
    machine: NominalMachine,
    base: JointsInBase,
    directions: LegDirections,
    *,
    weighted: bool,
    free_twists: bool = False,
) -> tuple[NominalMachine, tuple[str, ...]]:
    """Return the machine of steps 2 and 3 with all estimates of step 4, and diagnostics.

    These are B, axes on the platform, universal axes at the base, and twists if they are freed;
    diagnostics name nominal values with their reasons. Raises NotIdentifiable if the images do not
    determine a parameter that moves the platform, and DidNotConverge.
    """
    unknowns = Unknowns.of_platform(machine, free_twists=free_twists)
    problem = build_mean_distances(machine, unknowns, directions)
    held = np.zeros(0, dtype=np.intp)
    if weighted:
        problem, held = hold_at_nominal(problem, machine, unknowns, weighted=True)
    x = unknowns.vector(machine.legs)
    x[: len(problem.start)] = solve_least_squares(problem, weighted=weighted).x
    legs = unknowns.legs(x, machine.legs)
    unposed = [
        name
        for name, leg in zip(machine.leg_names, legs, strict=True)
        if leg.kind is LegKind.PASSIVE or leg.platform_axis is not None or leg.twist is not None
    ]
    on_rays = weighted and machine.spatial
    if not unposed and not on_rays:
        left = left_near_nominal("Step 4 (16)", machine, unknowns, held)
        return replace(machine, legs=legs), left
    seen_legs = _SeenLegs.of(
        machine, legs, base, directions, weighted=weighted, by_rays=not on_rays
    )
    if on_rays and len(seen_legs.poses.R):
        seen_legs, legs, shown = _ends_on_rays(seen_legs, unknowns, legs)
        held = np.setdiff1d(held, shown)
    left = left_near_nominal("Step 4 (16)", machine, unknowns, held)
    if not unposed:
        return replace(machine, legs=legs), left
    if not len(seen_legs.poses.R):
        number = "three" if machine.spatial else "two"
        shape = " that do not lie on one line" if machine.spatial else ""
        raise NotIdentifiable(
            f"Axes and passive ends of leg {', '.join(unposed)} could not be identified: no pose "
            f"shows {number} legs of known length at once with ends{shape}, needed to know where "
            "the platform is (eq 18); add images that show several legs at once."
        )
    legs = tuple(_with_axis_and_end(seen_legs, unknowns, j, leg) for j, leg in enumerate(legs))
    legs, of_closure = _close_legs(seen_legs, unknowns, legs)
    return replace(machine, legs=_in_own_frame(machine, legs)), (*left, *of_closure)


def build_mean_distances(
    machine: NominalMachine, unknowns: Unknowns, directions: LegDirections
) -> LeastSquares:
    """Build the criterion C_3 of (16): mean distances of a view equal those in R_e.

    Two legs that end in one point are left out. In a plane the heights of R_e are nominal.
    """
    q0 = machine.offsets
    pairs = pairs_of_legs(directions, q0)
    B = machine.B[directions.leg[pairs]]
    apart = _APART * float(np.mean(q0[np.isfinite(q0)]))
    pairs = pairs[np.linalg.norm(B[:, 1] - B[:, 0], axis=1) > apart]
    key = np.column_stack([directions.view[pairs[:, 0]], directions.leg[pairs]])
    distinct, group = np.unique(key, axis=0, return_inverse=True)
    group, legs = group.ravel(), distinct[:, 1:]
    ends = q0[directions.leg[pairs]], np.swapaxes(directions.columns[pairs], 1, 2)
    distance = evaluated(distance_of_ends(), *ends)[:, 0]
    slope = derivatives(distance_of_ends(), 1, *ends)[:, 0].reshape(-1, 2, 3)
    variance = np.einsum("pki,pkij,pkj->p", slope, directions.covariance[pairs], slope)
    n = np.bincount(group)
    mean, of_mean = (np.bincount(group, weights=w) for w in (distance, variance))
    place = unknowns.place[:, LegColumns.B]
    observed = np.swapaxes(unknowns.known_B[legs], 1, 2), mean / n
    index, covariance = place[legs].reshape(-1, 6), (of_mean / n**2)[:, None, None]
    return LeastSquares(
        "The platform joints (eq 16)",
        (Term(mean_distance(), index, observed, covariance),),
        unknowns.vector(machine.legs)[: int(place.max()) + 1],
        exact_hessian=True,
    )


@dataclass(frozen=True, eq=False)
class _SeenLegs:
    """Legs in R_b where their camera is located, else in its frame, and the platform there."""

    machine: NominalMachine  # result of steps 2 and 3
    directions: LegDirections
    in_base: BoolArray  # (n,) whether each is in R_b
    centre: Array  # (n, 3) of the camera [m]
    poses: PlatformPoses
    weighted: bool

    @classmethod
    def of(
        cls,
        machine: NominalMachine,
        legs: tuple[Leg, ...],
        base: JointsInBase,
        directions: LegDirections,
        *,
        weighted: bool,
        by_rays: bool,
    ) -> _SeenLegs:
        """Locate cameras and platform by (18): each A, and each B, is on its camera ray."""
        A, u, basis = directions.A.copy(), directions.u.copy(), directions.basis.copy()
        of_A = directions.of_A.copy()
        centre, in_base = np.zeros_like(A), np.zeros(len(A), dtype=np.bool_)
        for v, T in enumerate(base.T_Rb_camera):
            of_view = np.flatnonzero(directions.view == v)
            if T is None or not len(of_view):
                continue
            R = T.rotation.as_matrix()
            of_A[of_view] = R @ of_A[of_view] @ R.T
            A[of_view], u[of_view] = T.apply(A[of_view]), T.rotation.apply(u[of_view])
            basis[of_view] = T.rotation.apply(basis[of_view].reshape(-1, 3)).reshape(-1, 2, 3)
            centre[of_view], in_base[of_view] = T.translation, True
        directions = replace(directions, A=A, of_A=of_A, u=u, basis=basis)
        q0 = machine.offsets
        slope = derivatives(end_of_leg(), 1, q0[directions.leg, None], directions.columns)
        poses = locate_platform(
            directions.groups(),
            np.array([leg.B for leg in legs])[directions.leg],
            directions.ends(q0),
            slope @ directions.covariance @ np.swapaxes(slope, 1, 2) + of_A,
            centre,
            spatial=machine.spatial,
            weighted=weighted,
            by_rays=by_rays,
        )
        return cls(machine, directions, in_base, centre, poses, weighted)

    def across(self, rows: IntArray) -> AcrossAxes:
        """Return some directions in the form of (7) for one axis on the platform."""
        u, basis = self.directions.u[rows], self.directions.basis[rows]
        R, axis = self.poses.R[self.poses.pose[rows]], np.zeros(len(rows), dtype=np.intp)
        return AcrossAxes(u, basis, R, self.covariance(rows), axis)

    def covariance(self, rows: IntArray) -> Array:
        """Return the covariances (k, 8, 8) of some directions and of steps of their poses."""
        covariances = np.zeros((len(rows), 8, 8))
        covariances[:, :2, :2] = self.directions.covariance[rows, :2, :2]
        covariances[:, 2:, 2:] = self.poses.covariance[self.poses.pose[rows]]
        return covariances


# Ends, offsets and poses together


def _ends_on_rays(
    seen_legs: _SeenLegs, unknowns: Unknowns, legs: tuple[Leg, ...]
) -> tuple[_SeenLegs, tuple[Leg, ...], IntArray]:
    """Return platform poses and legs with B and offsets by (18), and the unknowns it determines.

    Directions with less information in (18) than in the nominal model keep the results of (14) and
    (16).
    """
    machine, directions, poses = seen_legs.machine, seen_legs.directions, seen_legs.poses
    q0 = machine.offsets
    rows = np.flatnonzero(
        (poses.pose >= 0) & np.isfinite(q0[directions.leg]) & ~machine.on_platform[directions.leg]
    )
    pose, leg = poses.pose[rows], directions.leg[rows]
    place = np.column_stack(
        [unknowns.place[leg, LegColumns.LENGTH], unknowns.place[leg, LegColumns.B]]
    )
    wanted = np.unique(place[place >= 0])
    renumbered = np.full(len(unknowns) + 1, -1)
    renumbered[wanted] = np.arange(len(wanted))
    steps = len(wanted) + np.arange(6 * len(poses.R)).reshape(-1, 6)
    covariance = np.zeros((len(rows), 6, 6))
    covariance[:, :3, :3], covariance[:, 3:, 3:] = (
        directions.covariance[rows],
        directions.of_A[rows],
    )
    observed = (
        unknowns.known_B[leg],
        poses.R[pose],
        poses.t[pose],
        seen_legs.centre[rows],
        across_rays(directions.ends(q0)[rows], seen_legs.centre[rows]),
        directions.columns[rows],
    )
    index = np.hstack([renumbered[place], steps[pose]])
    term = Term(end_on_ray(), index, observed, covariance, n_printed=2)
    x = unknowns.vector(legs)
    start = np.concatenate([x[wanted], np.zeros(steps.size)])
    name = "The platform joints and poses (eq 18)"
    problem = LeastSquares(name, (term,), start, exact_hessian=True)
    problem, held = hold_at_nominal(problem, machine, unknowns, weighted=True, wanted=wanted)
    solution = solve_least_squares(problem, weighted=True)
    x[wanted] = solution.x[: len(wanted)]
    legs = unknowns.legs(x, legs)
    R, t = stepped_poses(poses.R, poses.t, solution.x[steps])
    poses = PlatformPoses(poses.pose, R, t, solution.covariances(steps))
    seen_legs = replace(seen_legs, machine=replace(machine, legs=legs), poses=poses)
    return seen_legs, legs, np.setdiff1d(wanted, held)


# Axes on the platform and passive ends


def _with_axis_and_end(seen_legs: _SeenLegs, unknowns: Unknowns, j: int, leg: Leg) -> Leg:
    """Return leg *j* with its axis on the platform, (7), and its end if it is passive, (19)."""
    machine, directions, nominal = seen_legs.machine, seen_legs.directions, leg.platform_axis
    name = machine.leg_names[j]
    rows = np.flatnonzero((directions.leg == j) & (seen_legs.poses.pose >= 0))
    if nominal is not None and EquationKind.PLATFORM_AXIS in leg.equations:
        across, n = seen_legs.across(rows), len(rows)
        if not n or np.linalg.eigvalsh(across.scatter[0])[1] <= _SAME_DIRECTION * n:
            actual = f"one direction in {n} pose{'s' * (n != 1)}"
            raise NotIdentifiable(
                f"The revolute axis of leg {name} on the platform could not be identified: found "
                f"{actual if n else 'no pose that shows its direction'} in the frame of the "
                "platform, needed two different ones; add poses between which the leg turns about "
                "it."
            )
        v, turns, _ = across.solve(weighted=seen_legs.weighted)
        axis = turned_axis(v[0], angles_of(turns[0]))
        leg = replace(leg, platform_axis=(axis if axis @ nominal > 0.0 else -axis))
    elif nominal is not None and leg.is_fixed_to_platform:
        u = np.einsum(
            "nij,ni->nj", seen_legs.poses.R[seen_legs.poses.pose[rows]], directions.u[rows]
        )
        if not len(u):
            raise NotIdentifiable(
                f"The direction of leg {name} in the platform could not be identified: found no "
                "pose that shows it together with three legs of known length, needed one; add "
                "images that show several legs at once."
            )
        total = u.sum(axis=0)
        fixed = replace(leg, platform_axis=np.asarray(total / np.linalg.norm(total)))
        twist = None if leg.twist is None else tied_twist(fixed, leg, leg.twist)
        leg = replace(fixed, twist=twist)
    if leg.kind is LegKind.PASSIVE:
        free = np.flatnonzero(unknowns.place[j, LegColumns.B] >= 0)
        if j in machine.frame_legs and not leg.is_fixed_to_platform:
            free = np.arange(3 if machine.spatial else 2)
        leg = replace(leg, B=_passive_end(seen_legs, name, rows, leg.B, free))
    return leg


def _passive_end(
    seen_legs: _SeenLegs, name: str, rows: IntArray, B_nominal: Array, free: IntArray
) -> Array:
    """Return the platform joint centre (3,) of a passive leg: u x A B = 0 in all poses, eq (19).

    Only the ``free`` coordinates of B are unknown: three; two in a plane, and on a leg that is
    fixed to the platform, where B may be anywhere along the leg. Raises NotIdentifiable if the leg
    has too few directions in the platform.
    """
    n, place, B = len(rows), np.full(3, -1), B_nominal.copy()
    place[free] = np.arange(len(free))
    pose, directions = seen_legs.poses.pose[rows], seen_legs.directions
    observed = (
        np.tile(np.where(place < 0, B, 0.0), (n, 1)),
        seen_legs.poses.R[pose],
        seen_legs.poses.t[pose],
        directions.A[rows],
        directions.u[rows],
        directions.basis[rows],
    )
    term = Term(end_on_axis(), np.tile(place, (n, 1)), observed, seen_legs.covariance(rows))
    problem = LeastSquares(f"The end of leg {name} (eq 19)", (term,), B[free])
    J = problem.jacobian(problem.start).toarray() if n else np.zeros((1, len(free)))
    if np.linalg.eigvalsh(J.T @ J)[0] <= _SAME_DIRECTION * n:
        raise NotIdentifiable(
            f"The end of leg {name} on the platform could not be located: found "
            f"{n} pose{'s' * (n != 1)} of the platform that show{'s' * (n == 1)} "
            "it, with axes that do not meet in one point there; needed two different directions in "
            "the platform, each seen together with three legs of known length (eq 19); add images "
            "at poses that differ more."
        )
    B[free] = solve_least_squares(problem, weighted=seen_legs.weighted).x
    return B


# Universal axes and twists


def _close_legs(
    seen_legs: _SeenLegs, unknowns: Unknowns, legs: tuple[Leg, ...]
) -> tuple[tuple[Leg, ...], tuple[str, ...]]:
    """Identify universal axes and twists by the closure; undetermined ones stay nominal.

    ``legs`` have the other estimates. Returns them, and the nominal values in words.
    """
    twisting = np.array([leg.twist is not None for leg in unknowns.start])
    known_axis = np.array([leg.platform_joint is not JointType.UNIVERSAL for leg in unknowns.start])
    turns = unknowns.place[twisting, LegColumns.BASE_AXIS.start : LegColumns.OWN]
    wanted = np.setdiff1d(turns[turns >= 0], unknowns.place[known_axis, LegColumns.PLATFORM_AXIS])
    if not len(wanted):
        return legs, ()
    problem = _build_closure(seen_legs, unknowns, wanted, legs)
    if not problem.terms:
        names = ", ".join(np.array(seen_legs.machine.leg_names)[twisting])
        return legs, (
            f"Step 4 left the axes of leg {names} at nominal: no camera in R_b shows it.",
        )
    if not seen_legs.weighted:  # undetermined axes would end anywhere
        near = with_prior(problem, np.arange(len(wanted)))
        problem = replace(problem, start=solve_least_squares(near).x)
    problem, held = hold_at_nominal(
        problem,
        seen_legs.machine,
        unknowns,
        weighted=seen_legs.weighted,
        wanted=wanted,
        nominal=np.zeros(len(wanted)),
    )
    x = solve_least_squares(problem, weighted=seen_legs.weighted).x
    left = left_near_nominal("Step 4", seen_legs.machine, unknowns, held)
    return _closed(unknowns, legs, wanted, x), left


def _build_closure(
    seen_legs: _SeenLegs, unknowns: Unknowns, wanted: IntArray, legs: tuple[Leg, ...]
) -> LeastSquares:
    """Build the closure of all legs without an S joint: sin(angle - twist) = 0."""
    renumbered = np.full(len(unknowns) + 1, -1, dtype=np.intp)
    renumbered[wanted] = np.arange(len(wanted))
    place, directions = renumbered[unknowns.place], seen_legs.directions
    shown = seen_legs.in_base & (seen_legs.poses.pose >= 0)
    twisting = [(j, leg) for j, leg in enumerate(legs) if leg.twist is not None]
    n_rows = int(np.sum(shown & np.isin(directions.leg, [j for j, _ in twisting])))
    terms = []
    for joints in dict.fromkeys((leg.base_joint, leg.platform_joint) for _, leg in twisting):
        of_kind = [j for j, leg in twisting if (leg.base_joint, leg.platform_joint) == joints]
        rows = np.flatnonzero(shown & np.isin(directions.leg, of_kind))
        if not len(rows):
            continue
        leg = directions.leg[rows]
        base, platform = (
            axis_frames(np.array([getattr(legs[j], name) for j in leg], dtype=np.float64))
            for name in ("base_axis", "platform_axis")
        )
        observed = (
            directions.u[rows],
            directions.basis[rows],
            seen_legs.poses.R[seen_legs.poses.pose[rows]],
            base,
            platform,
            np.array([float(legs[j].twist or 0.0) for j in leg]),
            np.full(len(rows), _SIGMA_CLOSURE / np.sqrt(n_rows)),
        )
        index = place[leg, LegColumns.BASE_AXIS.start : LegColumns.OWN]
        terms.append(Term(closure_of_leg(*joints), index, observed, seen_legs.covariance(rows)))
    return LeastSquares("The universal axes (step 4)", tuple(terms), np.zeros(len(wanted)))


def _closed(
    unknowns: Unknowns, legs: tuple[Leg, ...], wanted: IntArray, x: Array
) -> tuple[Leg, ...]:
    """Return legs with universal axes rotated from the nominal axes, and changed twists."""
    values = np.zeros(len(unknowns) + 1)
    values[wanted] = x
    closed_legs = []
    for leg, leg_values in zip(legs, values[unknowns.place], strict=True):
        if leg.twist is not None and leg.base_axis is not None and leg.platform_axis is not None:
            base, platform = (
                turned_axis(axis, angles_of(leg_values[columns]))
                for axis, columns in (
                    (leg.base_axis, LegColumns.BASE_AXIS),
                    (leg.platform_axis, LegColumns.PLATFORM_AXIS),
                )
            )
            twist = leg.twist + float(leg_values[LegColumns.TWIST])
            leg = replace(leg, base_axis=base, platform_axis=platform, twist=twist)
        closed_legs.append(leg)
    return tuple(closed_legs)


def _in_own_frame(machine: NominalMachine, legs: tuple[Leg, ...]) -> tuple[Leg, ...]:
    """Return legs with the platform in R_e again after passive legs among the frame legs moved."""
    frame = list(machine.frame_legs)
    if all(legs[j].kind is not LegKind.PASSIVE for j in frame):
        return legs
    T = frame_on_points(np.array([legs[j].B for j in frame])).inv()
    moved_legs = []
    for j, leg in enumerate(legs):
        B, axis = T.apply(leg.B), leg.platform_axis
        if j in frame:  # coordinates that are zero by the choice of the frame
            B[frame.index(j) : len(frame)] = 0.0
        axis = None if axis is None else np.asarray(T.rotation.apply(axis))
        moved_legs.append(replace(leg, B=B, platform_axis=axis, twist=twist_after(leg, T.rotation)))
    return tuple(moved_legs)
