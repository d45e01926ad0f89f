"""Section 3.5: universal axes on base and platform, by the closure of legs without an S joint.

Such a leg cannot twist: the angle about u from its inner axis at the base, a x u, to its inner axis
at the platform, b x u, is the same in all poses of the platform. That is the inverse kinematic
model which the paper asks for; the length of the leg does not depend on a and b.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from legcal.geometry.types import Array, BoolArray, IntArray
from legcal.mechanism.leg_geometry import LegGeometry
from legcal.stages.least_squares import LeastSquares, Term
from legcal.stages.leg_directions import LegDirections
from legcal.stages.nominal import NominalMechanism
from legcal.stages.open_directions import metres, near_nominal, open_directions
from legcal.stages.platform_demands import axes_with_bases
from legcal.stages.platform_pose import PlatformPoses
from legcal.stages.platform_residuals import closure_of_leg
from legcal.stages.platform_unknowns import (
    BASE_TURNS,
    PLATFORM_TURNS,
    TWIST,
    PlatformUnknowns,
    turned_axis,
)
from legcal.stages.solve import solve_least_squares

SHOWN = 1e-4  # unit of the closures together, rms: what changes them by less is not shown


def closure_unknowns(unknowns: PlatformUnknowns) -> IntArray:
    """Return which unknowns of step 4 the closure identifies: universal axes and twists."""
    columns = []
    for leg, place in zip(unknowns.nominal, unknowns.place, strict=True):
        if leg.twist is None:
            continue
        columns += place[BASE_TURNS].tolist()
        columns += place[PLATFORM_TURNS].tolist() * (leg.platform_joint == "U")
        columns.append(int(place[TWIST]))
    found = np.unique(np.array(columns, dtype=np.intp))
    return np.asarray(found[found >= 0])


def close_legs(
    known: NominalMechanism,
    unknowns: PlatformUnknowns,
    legs: tuple[LegGeometry, ...],
    directions: LegDirections,
    poses: PlatformPoses,
    in_base: BoolArray,
) -> tuple[tuple[LegGeometry, ...], tuple[str, ...]]:
    """Identify universal axes and twists by the closure, what the poses leave open at nominal.

    Parameters
    ----------
    known : NominalMechanism
        The mechanism with what steps 2 and 3 found of it.
    unknowns : PlatformUnknowns
        Those of step 4.
    legs : tuple of LegGeometry
        Legs with joints, revolute axes and directions in the platform as they were found; their
        universal axes and twists are nominal.
    directions : LegDirections
        Legs of each pose.
    poses : PlatformPoses
        Poses of the platform.
    in_base : (n,) array of bool
        Which legs stand in R_b.

    Returns
    -------
    tuple of LegGeometry
        The legs with universal axes and twists.
    tuple of str
        What was left at nominal.

    Raises
    ------
    NotIdentifiable
        If the poses leave something open that moves the platform.
    DidNotConverge
        If IPOPT does not.
    """
    wanted = closure_unknowns(unknowns)
    if not len(wanted):
        return legs, ()
    numbers = np.unique(poses.pose[in_base & (poses.pose >= 0)])
    seen = poses.R[numbers], poses.t[numbers]
    problem = build_closure(unknowns, legs, directions, poses, in_base)
    x, information = problem.start, np.zeros((0, len(wanted)))
    near = near_nominal(np.arange(len(wanted)))
    if problem.terms:
        solution = solve_least_squares(replace(problem, terms=(*problem.terms, *near)))
        x, information = solution.x, solution.without_last(len(wanted)).information()
    found = _closed(unknowns, legs, wanted, x)
    still = open_directions(known, unknowns, information, found, seen, wanted)
    if problem.terms:
        unit = metres(unknowns, still.length)[wanted]
        held = (still.holding(unit, np.zeros(len(wanted))),) if len(still.basis) else ()
        problem = replace(problem, terms=(*problem.terms, *held), start=x)
        found = _closed(unknowns, legs, wanted, solve_least_squares(problem).x)
    return found, still.sentences


def build_closure(
    unknowns: PlatformUnknowns,
    legs: tuple[LegGeometry, ...],
    directions: LegDirections,
    poses: PlatformPoses,
    in_base: BoolArray,
) -> LeastSquares:
    """Build the closure of all legs without an S joint, unweighted: sin(angle - twist) = 0.

    All are divided by one number. The parameters are those of :func:`close_legs`.

    Returns
    -------
    LeastSquares
        The unknowns are those of :func:`closure_unknowns`, in that order.
    """
    wanted = closure_unknowns(unknowns)
    renumbered = np.full(len(unknowns) + 1, -1, dtype=np.intp)
    renumbered[wanted] = np.arange(len(wanted))
    place = renumbered[unknowns.place]
    shown = in_base & (poses.pose >= 0)
    closed = np.array([leg.twist is not None for leg in legs])
    n_rows, terms = max(int(np.sum(shown & closed[directions.leg])), 1), []
    for joints in dict.fromkeys(
        (leg.base_joint, leg.platform_joint) for leg in legs if leg.twist is not None
    ):
        of_kind = np.array(
            [g.twist is not None and (g.base_joint, g.platform_joint) == joints for g in legs]
        )
        rows = np.flatnonzero(shown & of_kind[directions.leg])
        if len(rows):
            terms.append(_closure_term(joints, legs, place, directions, poses, rows, n_rows))
    return LeastSquares("The universal axes (step 4)", tuple(terms), np.zeros(len(wanted)))


def _closure_term(
    joints: tuple[str, str],
    legs: tuple[LegGeometry, ...],
    place: IntArray,
    directions: LegDirections,
    poses: PlatformPoses,
    rows: IntArray,
    n_rows: int,
) -> Term:
    """Return the closure of legs of one kind at all poses."""
    leg = directions.leg[rows]
    known: tuple[Array, ...] = (
        directions.u[rows],
        poses.R[poses.pose[rows]],
        *axes_with_bases(legs, leg, "base_axis"),
        *axes_with_bases(legs, leg, "platform_axis"),
        np.array([float(legs[j].twist or 0.0) for j in leg]),
        np.full(len(rows), SHOWN / np.sqrt(n_rows)),
    )
    of_leg = place[leg]
    index = np.hstack([of_leg[:, PLATFORM_TURNS], of_leg[:, BASE_TURNS], of_leg[:, TWIST, None]])
    return Term(closure_of_leg(*joints), index, known)


def _closed(
    unknowns: PlatformUnknowns, legs: tuple[LegGeometry, ...], wanted: IntArray, x: Array
) -> tuple[LegGeometry, ...]:
    """Return legs with universal axes turned from the nominal ones, and twists changed."""
    values = np.zeros(len(unknowns) + 1)
    values[wanted] = x
    found = []
    for leg, place in zip(legs, unknowns.place, strict=True):
        if leg.twist is not None:
            leg = replace(
                leg,
                base_axis=turned_axis(leg.base_axis, values[place[BASE_TURNS]]),
                platform_axis=turned_axis(leg.platform_axis, values[place[PLATFORM_TURNS]]),
                twist=leg.twist + float(values[place[TWIST]]),
            )
        found.append(leg)
    return tuple(found)
