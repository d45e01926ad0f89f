"""The rigid criterion of step 4: the legs of every pose end on one rigid platform.

What the images show of each leg, how long it is and what its joints demand (revolute axes,
directions that are fixed in the platform, twists) are residuals of one problem. Unknown are the
numbers of :mod:`legcal.stages.platform_unknowns` and one platform pose for every group.
"""

from __future__ import annotations

from itertools import combinations

import numpy as np

from legcal.errors import NotIdentifiable
from legcal.geometry.types import IntArray
from legcal.mechanism.leg_geometry import Demand
from legcal.stages.least_squares import LeastSquares, Term
from legcal.stages.motion import whitener
from legcal.stages.offsets import distance_sigma, leg_end_covariance, leg_ends, observed_legs
from legcal.stages.platform_demands import demand_terms
from legcal.stages.platform_residuals import direction_of_leg, length_of_leg
from legcal.stages.platform_unknowns import B_COLUMNS, LENGTH
from legcal.stages.residuals import distance_of_ends_and_joints
from legcal.stages.rigid_problem import RigidProblem

_RELATIVE = 1e-5  # of the mean length: floor of the sigma of a length, keeps it well conditioned
APART = 1e-3  # mean leg lengths: nearer joints count as one, whose distance has no direction


def build_rigid(rigid: RigidProblem) -> LeastSquares:
    """Build the rigid criterion.

    Parameters
    ----------
    rigid : RigidProblem
        What it is built of; its legs are the start.

    Returns
    -------
    LeastSquares
        Residuals in standard deviations.

    Raises
    ------
    NotIdentifiable
        If no pose shows two legs at once.
    """
    posed = np.flatnonzero(rigid.poses.pose >= 0)
    pairs = _pairs_without_pose(rigid)
    if not len(posed) and not len(pairs):
        raise NotIdentifiable(
            "The platform joints could not be located: no pose shows two legs at once; needed "
            "images of three or more; add images that show several legs at once."
        )
    terms = [_pairs_term(rigid, pairs), *_leg_terms(rigid, posed)]
    terms += demand_terms(rigid, posed)
    x = rigid.unknowns.vector(rigid.mechanism.legs)
    n_own = 6 if rigid.mechanism.spatial else 3
    return LeastSquares(
        "The platform joints (step 4)",
        tuple(terms),
        np.concatenate([x, np.zeros(n_own * len(rigid.poses.R))]),
        n_shared=len(x),
    )


def _pairs_without_pose(rigid: RigidProblem) -> IntArray:
    """Return the pairs of legs (n, 2) of groups without a pose: distances are all they tell."""
    directions, q0 = rigid.directions, rigid.mechanism.parameters.offsets
    without = np.isfinite(q0[directions.leg]) & (rigid.poses.pose < 0)
    B = rigid.mechanism.parameters.platform_joints[directions.leg]
    apart = APART * float(np.mean(q0[np.isfinite(q0)]))
    pairs = [
        (a, b)
        for rows in directions.groups()
        for a, b in combinations(rows[without[rows]].tolist(), 2)
        if np.linalg.norm(B[a] - B[b]) > apart
    ]
    return np.array(pairs, dtype=np.intp).reshape(-1, 2)


def _pairs_term(rigid: RigidProblem, pairs: IntArray) -> Term:
    """Return the residuals of pairs of legs (n_pairs, 2), whose distance is all they tell."""
    directions, q0 = rigid.directions, rigid.mechanism.parameters.offsets
    ends = leg_ends(directions, q0)
    covariance = leg_end_covariance(directions, q0, rigid.sigma_q)
    place = rigid.unknowns.place[directions.leg[pairs]]
    index = np.hstack([place[:, :, LENGTH], place[:, :, B_COLUMNS].reshape(-1, 6)])
    observed = (observed_legs(directions, pairs), distance_sigma(ends, covariance, pairs))
    return Term(distance_of_ends_and_joints(), index, observed, robust=True)


def _leg_terms(rigid: RigidProblem, rows: IntArray) -> list[Term]:
    """Return the residuals of directions and of lengths of the legs whose poses are unknown."""
    directions, q0 = rigid.directions, rigid.mechanism.parameters.offsets
    index, known = rigid.index(rows), rigid.known(rows)
    seen = (directions.u[rows], directions.basis[rows], whitener(directions.covariance[rows]))
    end = np.isfinite(q0[directions.leg[rows]])
    sigma = float(np.hypot(rigid.sigma_q, _RELATIVE * np.mean(q0[np.isfinite(q0)])))
    place = rigid.unknowns.place[directions.leg[rows], LENGTH]
    return [
        Term(direction_of_leg(), index, (*known, *seen), robust=True),
        Term(
            length_of_leg(),
            np.hstack([index, place[:, None]])[end],
            (
                *(values[end] for values in known),
                directions.reading[rows[end]],
                rigid.sigma(rows[end], Demand.LENGTH, sigma),
            ),
        ),
    ]
