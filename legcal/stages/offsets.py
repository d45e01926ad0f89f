"""Section 3.4: the encoder offsets q0 and the constant leg lengths, eqs (13) and (14).

A leg ends at B = A + (q + q0) u. The distance between two leg ends is a distance on the
rigid platform: it is the same in all poses for the right offsets only.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations

import casadi as ca
import numpy as np

from legcal.errors import NotIdentifiable
from legcal.geometry.types import Array, IntArray
from legcal.stages.leg_directions import LegDirections
from legcal.stages.nominal import Criteria, NominalMechanism
from legcal.stages.solve import LeastSquares, Solution, solve_least_squares

_REWEIGHTINGS = 2


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
    if criteria == "literal":
        problem = build_consecutive(mechanism, directions)
        solution = solve_least_squares(problem)
        _check_identifiable(mechanism, solution)
        return Offsets(_all_offsets(mechanism, solution.x), solution)
    q0 = mechanism.parameters.offsets
    for _ in range(_REWEIGHTINGS):
        problem = build_constant_distances(mechanism, directions, q0, sigma_q)
        solution = solve_least_squares(problem)
        _check_identifiable(mechanism, solution)
        q0 = _all_offsets(mechanism, solution.x)
    return Offsets(q0, solution)


def build_consecutive(mechanism: NominalMechanism, directions: LegDirections) -> LeastSquares:
    """Build the criterion C_2 of (14): distances equal those of the next position of the view."""
    x, B = _leg_ends(mechanism, directions)
    residuals = []
    last: dict[tuple[int, int, int], ca.SX] = {}
    for group in directions.groups():
        for a, b in _pairs(mechanism, directions, group):
            distance = ca.norm_2(B[:, a] - B[:, b])
            key = (int(directions.view[a]), int(directions.leg[a]), int(directions.leg[b]))
            if key in last:
                residuals.append(distance - last[key])
            last[key] = distance
    return LeastSquares("The offsets (eq 14)", x, _stacked(residuals), _start(mechanism))


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
    x, B = _leg_ends(mechanism, directions)
    ends = leg_ends(directions, q0)
    covariance = leg_end_covariance(directions, q0, sigma_q)
    found: dict[tuple[int, int], list[tuple[int, int]]] = {}
    for group in directions.groups():
        for a, b in _pairs(mechanism, directions, group):
            found.setdefault((int(directions.leg[a]), int(directions.leg[b])), []).append((a, b))
    unknowns, residuals, start = [x], [], [_start(mechanism)]
    for (j, g), members in sorted(found.items()):
        d = ca.SX.sym(f"d_{j}_{g}")
        values = []
        for a, b in members:
            sigma = distance_sigma(ends, covariance, (a, b))
            residuals.append((ca.norm_2(B[:, a] - B[:, b]) - d) / sigma)
            values.append(float(np.linalg.norm(ends[a] - ends[b])))
        unknowns.append(d)
        start.append(np.array([np.mean(values)]))
    return LeastSquares(
        "The offsets (step 3)",
        ca.vertcat(*unknowns),
        _stacked(residuals),
        np.concatenate(start),
        block=np.arange(len(residuals)),
    )


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


def distance_sigma(ends: Array, covariance: Array, pair: Sequence[int] | IntArray) -> float:
    """Return the standard deviation of the distance between two leg ends [m]."""
    a, b = pair
    apart = ends[a] - ends[b]
    n = apart / np.linalg.norm(apart)
    return float(np.sqrt(n @ (covariance[a] + covariance[b]) @ n))


def _leg_ends(mechanism: NominalMechanism, directions: LegDirections) -> tuple[ca.SX, ca.SX]:
    """Return the unknown offsets, and B (3, n) of (13) built of them; zero for passive legs."""
    with_offset = np.flatnonzero(np.isfinite(mechanism.parameters.offsets))
    x = ca.SX.sym("q0", len(with_offset))
    B = ca.SX.zeros(3, len(directions))
    for k, leg in enumerate(with_offset):
        for i in np.flatnonzero(directions.leg == leg):
            length = float(directions.reading[i]) + x[k]
            B[:, int(i)] = ca.DM(directions.A[i]) + length * ca.DM(directions.u[i])
    return x, B


def _pairs(
    mechanism: NominalMechanism, directions: LegDirections, group: IntArray
) -> list[tuple[int, int]]:
    """Return the pairs of legs of a group, g > j, that have offsets: the set AC of (14)."""
    finite = np.isfinite(mechanism.parameters.offsets[directions.leg[group]])
    return list(combinations(group[finite].tolist(), 2))


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


def _stacked(residuals: list[ca.SX]) -> ca.SX:
    """Return residuals as one column, refusing an empty criterion."""
    if not residuals:
        raise NotIdentifiable(
            "The offsets could not be identified: no image shows two legs whose base joints are "
            "located; needed images that show several legs at once; add such images."
        )
    return ca.vertcat(*residuals)


def _check_identifiable(mechanism: NominalMechanism, solution: Solution) -> None:
    """Refuse when an offset can change without any distance noticing."""
    with_offset = np.flatnonzero(np.isfinite(mechanism.parameters.offsets))
    loose = with_offset[solution.unseen(len(with_offset))]
    if len(loose):
        names = ", ".join(mechanism.leg_names[int(j)] for j in loose)
        raise NotIdentifiable(
            f"The offsets could not be identified: no distance between leg ends fixes that of "
            f"{names}; needed each leg in images of at least three different poses together "
            "with other legs; add images that show several legs at once."
        )
