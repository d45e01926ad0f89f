"""Section 3.4: offsets q0 of the legs from the distances between their ends, eqs (13) and (14).

A leg ends in B = A + (q + q0) u (13). The distance between the ends of two legs is constant over
poses. As printed (``literal``), consecutive positions of each view are compared (14):

    C_2 = sum over pairs of legs (j, g) and positions k of (|B_j B_g|_k+1 - |B_j B_g|_k)^2

That uses each distance twice and ties views to nothing. The default compares every distance with
one unknown d_jg a pair of legs, the same in all poses and views, weighted by its covariance.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import cache
from itertools import combinations

import casadi as ca
import numpy as np

from legcal.errors import NotIdentifiable
from legcal.geometry.types import Array, IntArray
from legcal.machine.leg import LegColumns
from legcal.paper.criteria import Criteria
from legcal.paper.least_squares import IpoptSolution, LeastSquares, Term, solve_least_squares
from legcal.paper.leg_directions import LegDirections
from legcal.paper.nominal import NominalMachine
from legcal.paper.unknowns import Unknowns

_REWEIGHTINGS = 2
_APART = 1e-3  # mean leg lengths: nearer platform joints count as one


def identify_offsets(
    machine: NominalMachine,
    directions: LegDirections,
    sigma_q: float,
    *,
    criteria: Criteria = "default",
) -> NominalMachine:
    """Return the machine with offsets and constant lengths from distances of leg ends, eq (14).

    Raises NotIdentifiable if the distances do not fix every offset, and DidNotConverge.
    """
    pairs, unknowns = pairs_apart(machine, directions), Unknowns.of_lengths(machine)
    nominal = machine
    if criteria == "literal":
        solution = solve_least_squares(build_consecutive(machine, directions))
        _check_identifiable(machine, directions, pairs, solution)
        return replace(machine, legs=unknowns.legs(solution.x, machine.legs))
    for _ in range(_REWEIGHTINGS):
        q0 = machine.offsets
        solution = solve_least_squares(build_constant_distances(nominal, directions, q0, sigma_q))
        _check_identifiable(nominal, directions, pairs, solution, mean_length(directions, q0))
        machine = replace(machine, legs=unknowns.legs(solution.x, machine.legs))
    return machine


def build_consecutive(machine: NominalMachine, directions: LegDirections) -> LeastSquares:
    """Build the criterion C_2 of (14): distances equal those of the next position of the view."""
    pairs, unknowns = pairs_apart(machine, directions), Unknowns.of_lengths(machine)
    last: dict[tuple[int, ...], int] = {}
    found = []
    for k, (a, b) in enumerate(pairs):
        key = (int(directions.view[a]), int(directions.leg[a]), int(directions.leg[b]))
        if key in last:
            found.append((last[key], k))
        last[key] = k
    _check_any(found, "view shows the same two legs in two images")
    before, after = np.array(found, dtype=np.intp).T
    term = Term(
        _change_of_distance(),
        unknowns.place[directions.leg[pairs[after]], LegColumns.LENGTH],
        (observed_legs(directions, pairs[before]), observed_legs(directions, pairs[after])),
    )
    return LeastSquares("The offsets (eq 14)", (term,), unknowns.vector(machine.legs))


def build_constant_distances(
    machine: NominalMachine, directions: LegDirections, q0: Array, sigma_q: float
) -> LeastSquares:
    """Build the default criterion, in standard deviations: distances equal d_jg in all poses.

    Offsets ``q0`` (n_legs,) are those of the weights and of the start of the distances.
    """
    pairs, unknowns = pairs_apart(machine, directions), Unknowns.of_lengths(machine)
    ends = leg_ends(directions, q0)
    covariance = leg_end_covariance(directions, q0, sigma_q)
    legs = directions.leg[pairs]
    _, which = np.unique(legs, axis=0, return_inverse=True)
    which = which.ravel()
    start = unknowns.vector(machine.legs)
    term = Term(
        _constant_distance(),
        np.column_stack([unknowns.place[legs, LegColumns.LENGTH], len(start) + which]),
        (observed_legs(directions, pairs), distance_sigma(ends, covariance, pairs)),
        robust=True,
    )
    distance = np.linalg.norm(ends[pairs[:, 0]] - ends[pairs[:, 1]], axis=1)
    mean = np.bincount(which, weights=distance) / np.bincount(which)
    return LeastSquares("The offsets (step 3)", (term,), np.concatenate([start, mean]))


# Ends of legs and their distances


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


def mean_length(directions: LegDirections, q0: Array) -> float:
    """Return the mean length of the legs that have one [m]."""
    length = directions.reading + q0[directions.leg]
    return float(np.mean(length[np.isfinite(length)]))


def pairs_of_legs(directions: LegDirections, q0: Array) -> IntArray:
    """Return the pairs of legs of each group, g > j, that have offsets: the set AC of (14)."""
    finite = np.isfinite(q0[directions.leg])
    pairs = [
        pair
        for group in directions.groups()
        for pair in combinations(group[finite[group]].tolist(), 2)
    ]
    _check_any(pairs, "image shows two legs of known length whose base joints are located")
    return np.array(pairs, dtype=np.intp)


def pairs_apart(machine: NominalMachine, directions: LegDirections) -> IntArray:
    """Return the pairs of :func:`pairs_of_legs` whose distance depends on their offsets.

    Two legs that meet in one platform joint are at distance zero whatever their offsets are; a leg
    that is fixed to the platform ends on it whatever its offset is.
    """
    q0, B = machine.offsets, machine.parameters.platform_joints
    pairs = pairs_of_legs(directions, q0)
    legs = directions.leg[pairs]
    gap = np.linalg.norm(B[legs[:, 0]] - B[legs[:, 1]], axis=1)
    apart = gap > _APART * mean_length(directions, q0)
    chosen: IntArray = pairs[apart & ~machine.on_platform[legs].any(axis=1)]
    _check_any(
        chosen.tolist(),
        "image shows two legs that turn against the platform and end in different places of it",
    )
    return chosen


def observed_legs(directions: LegDirections, pairs: IntArray) -> Array:
    """Return A, u and reading of both legs of each pair, one leg a column, (n_pairs, 7, 2)."""
    seen = np.column_stack([directions.A, directions.u, directions.reading])
    return np.swapaxes(seen[pairs], 1, 2)


def distance_of_ends(q0: ca.SX, legs: ca.SX) -> ca.SX:
    """Return the distance between the ends A + (q + q0) u of two legs (7, 2), eq (13)."""
    ends = [legs[:3, k] + (legs[6, k] + q0[k]) * legs[3:6, k] for k in range(2)]
    return ca.norm_2(ends[0] - ends[1])


@cache
def _change_of_distance() -> ca.Function:
    """Return (q0 of two legs; legs before, legs after) -> the change of (14)."""
    q0 = ca.SX.sym("q0", 2)
    before, after = ca.SX.sym("before", 7, 2), ca.SX.sym("after", 7, 2)
    change = distance_of_ends(q0, after) - distance_of_ends(q0, before)
    return ca.Function("change", [q0, before, after], [change])


@cache
def _constant_distance() -> ca.Function:
    """Return (q0 of two legs and d_jg; legs, sigma) -> distance observed less d_jg, in sigmas."""
    local, legs, sigma = ca.SX.sym("local", 3), ca.SX.sym("legs", 7, 2), ca.SX.sym("sigma")
    residual = (distance_of_ends(local[:2], legs) - local[2]) / sigma
    return ca.Function("constant", [local, legs, sigma], [residual])


# Refusals


def _check_any(found: Sequence[object], missing: str) -> None:
    """Refuse a criterion without observations; *missing* says which are missing."""
    if not found:
        raise NotIdentifiable(
            f"The offsets could not be identified: no {missing}; needed images at different poses "
            "that show several legs at once; add such images."
        )


def _check_identifiable(
    machine: NominalMachine,
    directions: LegDirections,
    pairs: IntArray,
    solution: IpoptSolution,
    largest_sigma: float = np.inf,
) -> None:
    """Refuse when an offset can change without any distance noticing."""
    with_offset = np.flatnonzero(np.isfinite(machine.offsets))
    loose = solution.undetermined(len(with_offset))
    if np.isfinite(largest_sigma):
        sigma = np.sqrt(np.diag(solution.covariance())[: len(with_offset)])
        loose |= sigma > largest_sigma
    loose &= ~machine.on_platform[with_offset]
    if not loose.any():
        return
    names, reasons = [machine.leg_names[j] for j in with_offset[loose]], []
    for leg in with_offset[loose]:
        mine = pairs[np.any(directions.leg[pairs] == leg, axis=1)]
        n_poses = len(np.unique(directions.group[mine[:, 0]]))
        if n_poses == 0:
            reasons.append("is in no image together with a leg that ends elsewhere on the platform")
        elif n_poses < 3:
            reasons.append(f"is together with others in {n_poses} pose{'s' * (n_poses > 1)}")
        else:
            reasons.append(f"hardly turns against the legs seen with it in {n_poses} poses")
    why = "; ".join(f"{name} {reason}" for name, reason in zip(names, reasons, strict=True))
    raise NotIdentifiable(
        f"The offsets could not be identified: no distance between leg ends fixes that of "
        f"{', '.join(names)} ({why}); needed each leg in images of at least three different "
        "poses together with other legs that end elsewhere on the platform and turn against it; "
        "add images that show several legs at once."
    )
