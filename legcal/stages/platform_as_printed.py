"""Step 4 as printed: (16), then (18), then axes and passive ends one by one, unweighted."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from legcal.geometry.frames import frame_on_points
from legcal.geometry.types import Array, BoolArray
from legcal.mechanism.leg import LegKind
from legcal.mechanism.leg_geometry import LegGeometry
from legcal.mechanism.parametrization import tied_twist, twist_after
from legcal.stages.joints_in_base import JointsInBase
from legcal.stages.least_squares import LeastSquares, Term
from legcal.stages.leg_directions import LegDirections
from legcal.stages.nominal import NominalMechanism
from legcal.stages.offsets import leg_ends, pairs_of_legs
from legcal.stages.passive_legs import locate_passive_end
from legcal.stages.platform_axes import (
    directions_on_platform,
    fixed_direction,
    of_leg,
    revolute_axis,
)
from legcal.stages.platform_pose import (
    PlatformPoses,
    Transformation,
    check_located,
    locate_platform,
    register_by_rays,
)
from legcal.stages.platform_unknowns import B_COLUMNS, PlatformUnknowns
from legcal.stages.residuals import distance_of_known_joints
from legcal.stages.rigid_platform import APART
from legcal.stages.solution import Solution
from legcal.stages.solve import solve_least_squares
from legcal.stages.universal_axes import close_legs


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
