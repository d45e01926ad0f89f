"""Section 3.4: the encoder offsets q0 and the constant leg lengths, eqs (13) and (14).

A leg ends at B = A + (q + q0) u. The distance between two leg ends is a distance on the
rigid platform: it is the same in all poses for the right offsets only.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import combinations

import numpy as np

from legcal.geometry.types import Array, IntArray
from legcal.stages.least_squares import LeastSquares, Term
from legcal.stages.leg_directions import LegDirections
from legcal.stages.loose_offsets import check_any, check_identifiable
from legcal.stages.nominal import Criteria, NominalMechanism
from legcal.stages.residuals import change_of_distance, constant_distance
from legcal.stages.solution import Solution
from legcal.stages.solve import solve_least_squares

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
