"""Section 3.5: the platform joint centres in the platform frame R_e, eq (16).

With the offsets known, the leg ends B of every pose are points of one rigid body, the
platform: laying the poses on each other gives the joint centres in R_e.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import combinations

import casadi as ca
import numpy as np

from legcal.errors import NotIdentifiable
from legcal.geometry.types import Array, IntArray
from legcal.mechanism.parameters import free_coordinates
from legcal.stages.leg_directions import LegDirections
from legcal.stages.motion import moved_points, register_points, whitener
from legcal.stages.nominal import Criteria, NominalMechanism
from legcal.stages.offsets import Offsets, distance_sigma, leg_end_covariance, leg_ends
from legcal.stages.solve import LeastSquares, Solution, solve_least_squares

_RELATIVE_LENGTH = 1e-5  # floor of the sigma of a length: keeps exact readings well conditioned


@dataclass(frozen=True, eq=False)
class PlatformJoints:
    """Platform joint centres in R_e.

    Attributes
    ----------
    B_Re : (n_legs, 3) array
        Platform joint centres [m].
    q0 : (n_legs,) array
        Offsets [m]: those of step 3, improved by the default criterion.
    solution : Solution
        The converged problem: free coordinates of B_Re first.
    """

    B_Re: Array
    q0: Array
    solution: Solution


def locate_platform_joints(
    mechanism: NominalMechanism,
    directions: LegDirections,
    offsets: Offsets,
    sigma_q: float,
    *,
    criteria: Criteria = "default",
) -> PlatformJoints:
    """Locate the platform joint centres in R_e from the leg ends.

    Parameters
    ----------
    mechanism : NominalMechanism
        Its nominal platform joints are the start.
    directions : LegDirections
        Legs of each pose.
    offsets : Offsets
        The result of step 3.
    sigma_q : float
        Standard deviation of a reading [m].
    criteria : {"default", "literal"}
        ``literal`` minimises (16) as printed: mean distances of each view.

    Returns
    -------
    PlatformJoints

    Raises
    ------
    NotIdentifiable
        If the images do not tie all joints together.
    DidNotConverge
        If IPOPT does not.

    Notes
    -----
    Distances decide neither z of coplanar joints nor the handedness (see step 2), so the
    default lays the leg ends on each other rigidly, with one platform pose for every group of
    three or more legs; two legs give their distance. The platform joint predicts the whole
    leg: its direction is compared with the observed one, and its length with reading plus
    offset. The offsets stay free in this: (13) multiplies a noisy direction by the unknown
    length, which biases (14), while here directions are predicted and not multiplied. A
    passive leg has no reading, and takes part with its direction alone, which is (19).
    """
    if criteria == "literal":
        solution = solve_least_squares(build_mean_distances(mechanism, directions, offsets.q0))
        return PlatformJoints(_joints(mechanism, solution.x), offsets.q0, solution)
    solution = solve_least_squares(build_rigid(mechanism, directions, offsets.q0, sigma_q))
    _check_identifiable(mechanism, solution)
    q0 = offsets.q0.copy()
    with_offset = np.isfinite(q0)
    n_free = _n_free(mechanism)
    q0[with_offset] = solution.x[n_free : n_free + int(with_offset.sum())]
    return PlatformJoints(_joints(mechanism, solution.x), q0, solution)


def build_mean_distances(
    mechanism: NominalMechanism, directions: LegDirections, q0: Array
) -> LeastSquares:
    """Build the criterion C_3 of (16): mean distances of a view equal those in R_e."""
    x, B = _unknown_joints(mechanism)
    ends = leg_ends(directions, q0)
    found: dict[tuple[int, int, int], list[float]] = {}
    for group in directions.groups():
        with_end = group[np.isfinite(q0[directions.leg[group]])]
        for a, b in combinations(with_end.tolist(), 2):
            key = (int(directions.view[a]), int(directions.leg[a]), int(directions.leg[b]))
            found.setdefault(key, []).append(float(np.linalg.norm(ends[a] - ends[b])))
    residuals = [
        float(np.mean(distances)) - ca.norm_2(B[:, j] - B[:, g])
        for (_, j, g), distances in sorted(found.items())
    ]
    return LeastSquares(
        "The platform joints (eq 16)",
        x,
        ca.vertcat(*residuals),
        _start(mechanism),
        exact_hessian=True,
    )


def build_rigid(
    mechanism: NominalMechanism, directions: LegDirections, q0: Array, sigma_q: float
) -> LeastSquares:
    """Build the rigid criterion: unknown are B in R_e, the offsets and the platform poses.

    Parameters
    ----------
    mechanism : NominalMechanism
        Its nominal platform joints are the start.
    directions : LegDirections
        Legs of each pose.
    q0 : (n_legs,) array
        Offsets to start from [m].
    sigma_q : float
        Standard deviation of a reading [m].

    Returns
    -------
    LeastSquares
        Residuals in standard deviations.
    """
    x, B = _unknown_joints(mechanism)
    with_offset = np.flatnonzero(np.isfinite(q0))
    offsets = ca.SX.sym("q0", len(with_offset))
    offset_of = {int(j): offsets[k] for k, j in enumerate(with_offset)}
    ends = leg_ends(directions, q0)
    covariance = leg_end_covariance(directions, q0, sigma_q)
    sigma_length = float(np.hypot(sigma_q, _RELATIVE_LENGTH * np.mean(q0[with_offset])))
    poses: list[ca.SX] = []
    residuals: list[ca.SX] = []
    block: list[int] = []
    for group in directions.groups():
        legs = directions.leg[group]
        with_end = group[np.isin(legs, with_offset)]
        if len(with_end) == 2:
            seen = _distance(directions, with_end, offset_of)
            a, b = (int(j) for j in directions.leg[with_end])
            sigma = distance_sigma(ends, covariance, with_end)
            residuals.append((seen - ca.norm_2(B[:, a] - B[:, b])) / sigma)
            block.append(len(residuals))
        if len(with_end) < 3:
            continue
        nominal = mechanism.parameters.platform_joints[directions.leg[with_end]]
        step = ca.SX.sym(f"pose{len(poses)}", 6)
        poses.append(step)
        start = register_points(nominal, ends[with_end])
        predicted = moved_points(step, start, B[:, legs.tolist()])
        for column, i in enumerate(group.tolist()):
            leg = predicted[:, column] - ca.DM(directions.A[i])
            residuals.append(_direction_residual(leg, directions, i))
            block += 2 * [len(residuals)]
            if i in with_end:
                length = float(directions.reading[i]) + offset_of[int(directions.leg[i])]
                residuals.append((ca.norm_2(leg) - length) / sigma_length)
                block.append(-1)
    _check_enough(residuals)
    return LeastSquares(
        "The platform joints (step 4)",
        ca.vertcat(x, offsets, *poses),
        ca.vertcat(*residuals),
        np.concatenate([_start(mechanism), q0[with_offset], np.zeros(6 * len(poses))]),
        block=np.array(block, dtype=np.intp),
    )


def _direction_residual(leg: ca.SX, directions: LegDirections, i: int) -> ca.SX:
    """Return the direction of a leg vector A B against the observed one, in deviations, (2,)."""
    along = ca.dot(ca.DM(directions.u[i]), leg)
    across = ca.mtimes(ca.DM(directions.basis[i]), leg) / along
    return ca.mtimes(ca.DM(whitener(directions.covariance[i])), across)


def _distance(directions: LegDirections, pair: IntArray, offset_of: dict[int, ca.SX]) -> ca.SX:
    """Return the distance between the ends (13) of two legs, for unknown offsets."""
    ends = []
    for i in pair.tolist():
        length = float(directions.reading[i]) + offset_of[int(directions.leg[i])]
        ends.append(ca.DM(directions.A[i]) + length * ca.DM(directions.u[i]))
    return ca.norm_2(ends[0] - ends[1])


def _check_enough(residuals: list[ca.SX]) -> None:
    """Refuse an empty criterion."""
    if not residuals:
        raise NotIdentifiable(
            "The platform joints could not be located: no pose shows two legs at once; needed "
            "images of three or more; add images that show several legs at once."
        )


def _unknown_joints(mechanism: NominalMechanism) -> tuple[ca.SX, ca.SX]:
    """Return the free coordinates of B as unknowns, and B (3, n_legs) built of them."""
    free = free_coordinates(mechanism.n_legs, mechanism.frame_legs)
    x = ca.SX.sym("B", int(free.sum()))
    B = ca.SX.zeros(3, mechanism.n_legs)
    for k, (leg, axis) in enumerate(np.argwhere(free)):
        B[int(axis), int(leg)] = x[k]
    return x, B


def _joints(mechanism: NominalMechanism, x: Array) -> Array:
    """Return B_Re from the free coordinates at the head of x."""
    free = free_coordinates(mechanism.n_legs, mechanism.frame_legs)
    B_Re = np.zeros((mechanism.n_legs, 3))
    B_Re[free] = x[: _n_free(mechanism)]
    return B_Re


def _start(mechanism: NominalMechanism) -> Array:
    """Return the free coordinates of the nominal platform joints."""
    free = free_coordinates(mechanism.n_legs, mechanism.frame_legs)
    return mechanism.parameters.platform_joints[free]


def _n_free(mechanism: NominalMechanism) -> int:
    """Return the number of free coordinates."""
    return int(free_coordinates(mechanism.n_legs, mechanism.frame_legs).sum())


def _check_identifiable(mechanism: NominalMechanism, solution: Solution) -> None:
    """Refuse when platform joints can move without any image noticing."""
    free = free_coordinates(mechanism.n_legs, mechanism.frame_legs)
    unseen = np.zeros_like(free)
    unseen[free] = solution.unseen(_n_free(mechanism))
    loose = [mechanism.leg_names[int(j)] for j in np.flatnonzero(unseen.any(axis=1))]
    if loose:
        raise NotIdentifiable(
            f"The platform joints could not be tied together: those of {', '.join(loose)} can "
            "move without any image noticing; needed images of three or more legs at once that "
            "share legs with each other; add images that show several legs at once."
        )
