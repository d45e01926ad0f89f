"""Section 3.5: the platform joint centres in the platform frame R_e, eq (16).

With the offsets known, the leg ends B of every pose are points of one rigid body, the
platform: laying the poses on each other gives the joint centres in R_e.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from legcal.errors import NotIdentifiable
from legcal.geometry.types import Array, IntArray
from legcal.stages.free_joints import (
    free_values,
    joint_positions,
    joints_from,
    loose_joints,
    n_free_coordinates,
)
from legcal.stages.least_squares import LeastSquares, Term
from legcal.stages.leg_directions import LegDirections
from legcal.stages.motion import register_groups, whitener
from legcal.stages.nominal import Criteria, NominalMechanism
from legcal.stages.offsets import (
    Offsets,
    distance_sigma,
    leg_end_covariance,
    leg_ends,
    observed_legs,
    offset_positions,
    pairs_of_legs,
)
from legcal.stages.residuals import (
    direction_of_leg,
    distance_of_ends_and_joints,
    distance_of_joints,
    length_of_leg,
)
from legcal.stages.solution import Solution
from legcal.stages.solve import solve_least_squares

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
        return PlatformJoints(joints_from(mechanism, solution.x), offsets.q0, solution)
    solution = solve_least_squares(build_rigid(mechanism, directions, offsets.q0, sigma_q))
    _check_identifiable(mechanism, solution)
    q0 = offsets.q0.copy()
    q0[np.isfinite(q0)] = solution.x[n_free_coordinates(mechanism) : solution.n_shared]
    return PlatformJoints(joints_from(mechanism, solution.x), q0, solution)


def build_mean_distances(
    mechanism: NominalMechanism, directions: LegDirections, q0: Array
) -> LeastSquares:
    """Build the criterion C_3 of (16): mean distances of a view equal those in R_e."""
    ends = leg_ends(directions, q0)
    pairs = pairs_of_legs(directions, q0)
    distance = np.linalg.norm(ends[pairs[:, 0]] - ends[pairs[:, 1]], axis=1)
    key = np.column_stack([directions.view[pairs[:, 0]], directions.leg[pairs]])
    distinct, which = np.unique(key, axis=0, return_inverse=True)
    which = which.ravel()
    mean = np.bincount(which, weights=distance) / np.bincount(which)
    index = joint_positions(mechanism)[distinct[:, 1:]].reshape(-1, 6)
    return LeastSquares(
        "The platform joints (eq 16)",
        (Term(distance_of_joints(), index, (mean, np.ones(len(mean)))),),
        free_values(mechanism, mechanism.parameters.platform_joints),
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

    Raises
    ------
    NotIdentifiable
        If no pose shows two legs at once.
    """
    has_end = np.isfinite(q0[directions.leg])
    _, group = np.unique(directions.group, return_inverse=True)
    n_ends = np.bincount(group, weights=has_end).astype(np.intp)[group]
    if not np.any(n_ends >= 2):
        raise NotIdentifiable(
            "The platform joints could not be located: no pose shows two legs at once; needed "
            "images of three or more; add images that show several legs at once."
        )
    by_group = np.argsort(group, kind="stable")
    pairs = by_group[(has_end & (n_ends == 2))[by_group]].reshape(-1, 2)
    rows = np.flatnonzero(n_ends >= 3)
    _, pose = np.unique(group[rows], return_inverse=True)
    start = [free_values(mechanism, mechanism.parameters.platform_joints), q0[np.isfinite(q0)]]
    n_shared = sum(len(values) for values in start)
    start.append(np.zeros(6 * (int(pose.max(initial=-1)) + 1)))
    return LeastSquares(
        "The platform joints (step 4)",
        (
            _pairs_term(mechanism, directions, pairs, q0, sigma_q),
            *_pose_terms(mechanism, directions, rows, pose, q0, sigma_q),
        ),
        np.concatenate(start),
        n_shared=n_shared,
    )


def _pairs_term(
    mechanism: NominalMechanism,
    directions: LegDirections,
    pairs: IntArray,
    q0: Array,
    sigma_q: float,
) -> Term:
    """Return the residuals of pairs of legs (n_pairs, 2), whose distance is all they tell."""
    ends, covariance = leg_ends(directions, q0), leg_end_covariance(directions, q0, sigma_q)
    legs = directions.leg[pairs]
    offsets = n_free_coordinates(mechanism) + offset_positions(q0)[legs]
    joints = joint_positions(mechanism)[legs].reshape(-1, 6)
    observed = (observed_legs(directions, pairs), distance_sigma(ends, covariance, pairs))
    return Term(distance_of_ends_and_joints(), np.hstack([offsets, joints]), observed, robust=True)


def _pose_terms(
    mechanism: NominalMechanism,
    directions: LegDirections,
    rows: IntArray,
    pose: IntArray,
    q0: Array,
    sigma_q: float,
) -> tuple[Term, Term]:
    """Return the residuals of directions and of lengths of legs whose platform poses are free.

    The legs are rows of the directions; *pose* numbers the pose of each.
    """
    leg = directions.leg[rows]
    place, n_free = offset_positions(q0), n_free_coordinates(mechanism)
    end = place[leg] >= 0
    nominal = mechanism.parameters.platform_joints
    ends = leg_ends(directions, q0)
    R, t = register_groups(nominal[leg[end]], ends[rows[end]], pose[end])
    steps = n_free + int(place.max()) + 1 + 6 * pose[:, None] + np.arange(6)
    index = np.hstack([joint_positions(mechanism)[leg], steps])
    start = (R[pose], t[pose], directions.A[rows])
    direction = (directions.u[rows], directions.basis[rows], whitener(directions.covariance[rows]))
    sigma = float(np.hypot(sigma_q, _RELATIVE_LENGTH * np.mean(q0[np.isfinite(q0)])))
    length = (directions.reading[rows[end]], np.full(len(rows[end]), sigma))
    return (
        Term(direction_of_leg(), index, start + direction, robust=True),
        Term(
            length_of_leg(),
            np.hstack([index, n_free + place[leg, None]])[end],
            tuple(values[end] for values in start) + length,
        ),
    )


def _check_identifiable(mechanism: NominalMechanism, solution: Solution) -> None:
    """Refuse when platform joints can move without any image noticing."""
    loose = loose_joints(mechanism, solution)
    if loose:
        raise NotIdentifiable(
            f"The platform joints could not be tied together: those of {', '.join(loose)} can "
            "move without any image noticing; needed images of three or more legs at once that "
            "share legs with each other; add images that show several legs at once."
        )
