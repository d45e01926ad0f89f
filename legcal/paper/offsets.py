"""How exactly base joints are known, and what that does to the equations of step 4.

Step 4 takes A as step 2 found it. An error of A changes the length between A and B and the
direction of the leg, and with them what the joints demand of it, by far more than a reading is
wrong. The equations are weighted by that.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import combinations

import numpy as np

from legcal.errors import NotIdentifiable
from legcal.geometry import Array, IntArray
from legcal.machine import Demand, LegGeometry, linearize
from legcal.paper.joints_in_base import JointsInBase, change_of_distance, constant_distance
from legcal.paper.joints_in_camera import JointsInCamera
from legcal.paper.leg_directions import LegDirections
from legcal.paper.nominal import Criteria, NominalMechanism
from legcal.paper.platform_pose import PlatformPoses
from legcal.paper.solver import LeastSquares, Solution, Term, solve_least_squares


def check_any(found: Sequence[object], missing: str) -> None:
    """Refuse an empty criterion; *missing* says what there is none of."""
    if not found:
        raise NotIdentifiable(
            f"The offsets could not be identified: no {missing}; needed images at different poses "
            "that show several legs at once; add such images."
        )


def check_identifiable(
    mechanism: NominalMechanism,
    directions: LegDirections,
    pairs: IntArray,
    solution: Solution,
    largest_sigma: float = np.inf,
) -> None:
    """Refuse when an offset can change without any distance noticing."""
    with_offset = np.flatnonzero(np.isfinite(mechanism.parameters.offsets))
    loose = solution.unseen(len(with_offset))
    if np.isfinite(largest_sigma):
        sigma = np.sqrt(np.diag(solution.covariance())[: len(with_offset)])
        loose |= sigma > largest_sigma
    loose &= ~mechanism.on_platform[with_offset]
    if not loose.any():
        return
    reasons = [
        f"{mechanism.leg_names[int(j)]} {_why_loose(directions, pairs, int(j))}"
        for j in with_offset[loose]
    ]
    names = ", ".join(mechanism.leg_names[int(j)] for j in with_offset[loose])
    raise NotIdentifiable(
        f"The offsets could not be identified: no distance between leg ends fixes that of "
        f"{names} ({'; '.join(reasons)}); needed each leg in images of at least three different "
        "poses together with other legs that end elsewhere on the platform and turn against it; "
        "add images that show several legs at once."
    )


def _why_loose(directions: LegDirections, pairs: IntArray, leg: int) -> str:
    """Return what is seen of a leg whose offset nothing fixes."""
    mine = pairs[np.any(directions.leg[pairs] == leg, axis=1)]
    n_poses = len(np.unique(directions.group[mine[:, 0]]))
    if n_poses == 0:
        return "is in no image together with a leg that ends elsewhere on the platform"
    if n_poses < 3:
        return f"is together with others in {n_poses} pose{'s' if n_poses > 1 else ''}"
    return f"hardly turns against the legs that are seen with it in {n_poses} poses"


_REWEIGHTINGS = 2
_APART = 1e-3  # mean leg lengths: nearer platform joints count as one


@dataclass(frozen=True, eq=False)
class Offsets:
    """Offsets of the legs.

    Attributes
    ----------
    q0 : (n_legs,) array
        Offset of actuated legs, length of constant ones, NaN for passive ones [m].
    solution : Solution
        The converged problem: the offsets of the legs that have one come first.
    """

    q0: Array
    solution: Solution


def identify_offsets(
    mechanism: NominalMechanism,
    directions: LegDirections,
    sigma_q: float,
    *,
    criteria: Criteria = "default",
) -> Offsets:
    """Identify the offsets from the distances between leg ends, eq (14).

    Parameters
    ----------
    mechanism : NominalMechanism
        Its nominal offsets are the start.
    directions : LegDirections
        Legs of each pose.
    sigma_q : float
        Standard deviation of a reading [m].
    criteria : {"default", "literal"}
        ``literal`` compares consecutive positions of each view, as (14) is printed.

    Returns
    -------
    Offsets

    Raises
    ------
    NotIdentifiable
        If the distances do not fix every offset.
    DidNotConverge
        If IPOPT does not.

    Notes
    -----
    Differences of consecutive positions use each distance twice and tie views to nothing. The
    default compares every distance with one unknown d_jg a pair of legs, the same in all poses
    and views, and weights it by its covariance.
    """
    pairs = pairs_apart(mechanism, directions)
    if criteria == "literal":
        problem = build_consecutive(mechanism, directions)
        solution = solve_least_squares(problem)
        check_identifiable(mechanism, directions, pairs, solution)
        return Offsets(_all_offsets(mechanism, solution.x), solution)
    q0 = mechanism.parameters.offsets
    for _ in range(_REWEIGHTINGS):
        problem = build_constant_distances(mechanism, directions, q0, sigma_q)
        solution = solve_least_squares(problem)
        check_identifiable(mechanism, directions, pairs, solution, mean_length(directions, q0))
        q0 = _all_offsets(mechanism, solution.x)
    return Offsets(q0, solution)


def build_consecutive(mechanism: NominalMechanism, directions: LegDirections) -> LeastSquares:
    """Build the criterion C_2 of (14): distances equal those of the next position of the view."""
    nominal = mechanism.parameters.offsets
    pairs = pairs_apart(mechanism, directions)
    last: dict[tuple[int, ...], int] = {}
    found = []
    for k, (a, b) in enumerate(pairs):
        key = (int(directions.view[a]), int(directions.leg[a]), int(directions.leg[b]))
        if key in last:
            found.append((last[key], k))
        last[key] = k
    check_any(found, "view shows the same two legs in two images")
    before, after = np.array(found, dtype=np.intp).T
    term = Term(
        change_of_distance(),
        offset_positions(nominal)[directions.leg[pairs[after]]],
        (observed_legs(directions, pairs[before]), observed_legs(directions, pairs[after])),
    )
    return LeastSquares("The offsets (eq 14)", (term,), _start(mechanism))


def build_constant_distances(
    mechanism: NominalMechanism, directions: LegDirections, q0: Array, sigma_q: float
) -> LeastSquares:
    """Build the default criterion: distances equal d_jg in all poses and views.

    Parameters
    ----------
    mechanism : NominalMechanism
        Its nominal offsets are the start.
    directions : LegDirections
        Legs of each pose.
    q0 : (n_legs,) array
        Offsets for the weights and for the start of the distances [m].
    sigma_q : float
        Standard deviation of a reading [m].

    Returns
    -------
    LeastSquares
        Residuals in standard deviations of the distances.
    """
    pairs = pairs_apart(mechanism, directions)
    ends = leg_ends(directions, q0)
    covariance = leg_end_covariance(directions, q0, sigma_q)
    legs = directions.leg[pairs]
    _, which = np.unique(legs, axis=0, return_inverse=True)
    which = which.ravel()
    n_offsets = len(_start(mechanism))
    term = Term(
        constant_distance(),
        np.column_stack([offset_positions(q0)[legs], n_offsets + which]),
        (observed_legs(directions, pairs), distance_sigma(ends, covariance, pairs)),
        robust=True,
    )
    distance = np.linalg.norm(ends[pairs[:, 0]] - ends[pairs[:, 1]], axis=1)
    mean = np.bincount(which, weights=distance) / np.bincount(which)
    start = np.concatenate([_start(mechanism), mean])
    return LeastSquares("The offsets (step 3)", (term,), start)


def leg_ends(directions: LegDirections, q0: Array) -> Array:
    """Return B = A + (q + q0) u of (13) in the frame of each group, (n, 3) [m]."""
    length = directions.reading + q0[directions.leg]
    return directions.A + length[:, None] * directions.u


def leg_end_covariance(directions: LegDirections, q0: Array, sigma_q: float) -> Array:
    """Return the covariance of the leg ends of (13) given A and q0, (n, 3, 3) [m^2]."""
    length = directions.reading + q0[directions.leg]
    across = np.swapaxes(directions.basis, 1, 2) @ directions.covariance @ directions.basis
    along = directions.u[:, :, None] * directions.u[:, None, :]
    return np.asarray(length[:, None, None] ** 2 * across + sigma_q**2 * along)


def distance_sigma(ends: Array, covariance: Array, pairs: IntArray) -> Array:
    """Return the standard deviation of the distance between two leg ends, (n_pairs,) [m]."""
    a, b = pairs.T
    apart = ends[a] - ends[b]
    n = apart / np.linalg.norm(apart, axis=1, keepdims=True)
    return np.asarray(np.sqrt(np.einsum("pi,pij,pj->p", n, covariance[a] + covariance[b], n)))


def pairs_of_legs(directions: LegDirections, q0: Array) -> IntArray:
    """Return the pairs of legs of each group, g > j, that have offsets: the set AC of (14).

    Raises
    ------
    NotIdentifiable
        If there is no such pair.
    """
    finite = np.isfinite(q0[directions.leg])
    pairs = [
        pair
        for group in directions.groups()
        for pair in combinations(group[finite[group]].tolist(), 2)
    ]
    check_any(pairs, "image shows two legs of known length whose base joints are located")
    return np.array(pairs, dtype=np.intp)


def pairs_apart(mechanism: NominalMechanism, directions: LegDirections) -> IntArray:
    """Return the pairs of :func:`pairs_of_legs` whose distance says something of their offsets.

    Two legs that meet in one platform joint are at distance zero whatever their offsets are; a leg
    that is fixed to the platform ends on it whatever its offset is.

    Raises
    ------
    NotIdentifiable
        If there is no such pair.
    """
    q0, B = mechanism.parameters.offsets, mechanism.parameters.platform_joints
    pairs = pairs_of_legs(directions, q0)
    legs = directions.leg[pairs]
    gap = np.linalg.norm(B[legs[:, 0]] - B[legs[:, 1]], axis=1)
    apart = gap > _APART * mean_length(directions, q0)
    chosen: IntArray = pairs[apart & ~mechanism.on_platform[legs].any(axis=1)]
    check_any(
        chosen.tolist(),
        "image shows two legs that turn against the platform and end in different places of it",
    )
    return chosen


def mean_length(directions: LegDirections, q0: Array) -> float:
    """Return the mean length of the legs that have one [m]."""
    length = directions.reading + q0[directions.leg]
    return float(np.mean(length[np.isfinite(length)]))


def observed_legs(directions: LegDirections, pairs: IntArray) -> Array:
    """Return A, u and reading of both legs of each pair, one leg a column, (n_pairs, 7, 2)."""
    seen = np.column_stack([directions.A, directions.u, directions.reading])
    return np.swapaxes(seen[pairs], 1, 2)


def offset_positions(q0: Array) -> IntArray:
    """Return the place of each leg among the legs with an offset, (n_legs,); -1 for passive."""
    with_offset = np.isfinite(q0)
    return np.where(with_offset, np.cumsum(with_offset) - 1, -1)


def _start(mechanism: NominalMechanism) -> Array:
    """Return the nominal offsets of the legs that have one."""
    offsets = mechanism.parameters.offsets
    return offsets[np.isfinite(offsets)]


def _all_offsets(mechanism: NominalMechanism, x: Array) -> Array:
    """Return the offsets of all legs from the head of x."""
    q0 = mechanism.parameters.offsets.copy()
    with_offset = np.isfinite(q0)
    q0[with_offset] = x[: int(with_offset.sum())]
    return q0


def base_spread(directions: LegDirections, joints: JointsInCamera, base: JointsInBase) -> Array:
    """Return the covariance of A of each leg in the frame of its group, (n, 3, 3) [m^2].

    Cameras that step 2 placed know A together; what their places are wrong by is not counted.
    """
    n_legs = joints.located.shape[1]
    together = np.zeros((n_legs, 3, 3))
    alone = joints.covariance[directions.view, directions.leg, :3, :3]
    for v, T in enumerate(base.T_Rb_camera):
        if T is not None:
            R, seen = T.rotation.as_matrix(), joints.located[v]
            together[seen] += R @ np.linalg.inv(joints.covariance[v, seen, :3, :3]) @ R.T
    placed = np.array([T is not None for T in base.T_Rb_camera])
    known = np.einsum("nii->n", together) > 0.0
    together[known] = np.linalg.inv(together[known])
    return np.where(placed[directions.view, None, None], together[directions.leg], alone)


def spread_of_demands(
    legs: tuple[LegGeometry, ...],
    directions: LegDirections,
    poses: PlatformPoses,
    spread: Array,
    rows: IntArray,
    demand: Demand,
) -> Array:
    """Return the variance of a demand of legs by that of A, (k,).

    Parameters
    ----------
    legs : tuple of LegGeometry
        The legs.
    directions : LegDirections
        Where A is.
    poses : PlatformPoses
        Where the platform is, about.
    spread : (n, 3, 3) array
        Covariance of A [m^2].
    rows : (k,) array of int
        Which of the directions, all of legs that have this demand.
    demand : Demand
        Which equation: a length counts in m^2, the others have no unit.
    """
    found = np.zeros(len(rows))
    key = np.column_stack([directions.leg[rows], directions.A[rows]])
    _, first, which = np.unique(key, axis=0, return_index=True, return_inverse=True)
    for k, i in enumerate(first):
        here = np.flatnonzero(which.ravel() == k)
        leg = replace(legs[directions.leg[rows[i]]], A=directions.A[rows[i]])
        pose = poses.pose[rows[here]]
        linear = linearize(leg, poses.R[pose], poses.t[pose])
        by_A = linear.by_local[:, linear.demands.index(demand), :3]
        found[here] = np.einsum("ni,nij,nj->n", by_A, spread[rows[here]], by_A)
    return found
