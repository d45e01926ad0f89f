"""What joints demand of the legs in the rigid criterion of step 4: axes, fixed directions, twists.

Each demand holds exactly but for what the base joints are wrong by.
"""

from __future__ import annotations

import casadi as ca
import numpy as np

from legcal.geometry.lines import normal_basis
from legcal.geometry.types import Array, IntArray
from legcal.mechanism.leg_geometry import Demand, LegGeometry
from legcal.stages.least_squares import Term
from legcal.stages.platform_residuals import fixed_on_platform, revolute_on_platform, twist_of_leg
from legcal.stages.platform_unknowns import BASE_TURNS, PLATFORM_TURNS, TWIST
from legcal.stages.rigid_problem import RigidProblem

_EXACT = 1e-5  # [rad] floor of the sigma of a demand: keeps exact base joints well conditioned


def demand_terms(rigid: RigidProblem, rows: IntArray) -> list[Term]:
    """Return what joints demand of legs whose poses are unknown, in standard deviations."""
    legs, leg = rigid.mechanism.legs, rigid.directions.leg[rows]
    revolute = np.array([g.platform_joint == "R" and g.platform_axis is not None for g in legs])
    fixed = np.array([g.platform_joint == "" and g.platform_axis is not None for g in legs])
    kinds = {
        (g.base_joint, g.platform_joint): np.array(
            [
                h.twist is not None
                and (h.base_joint, h.platform_joint) == (g.base_joint, g.platform_joint)
                for h in legs
            ]
        )
        for g in legs
        if g.twist is not None
    }
    terms = [
        _platform_axis_term(rigid, rows[revolute[leg]], revolute_on_platform()),
        _platform_axis_term(rigid, rows[fixed[leg]], fixed_on_platform()),
    ]
    for joints, of_kind in kinds.items():
        here = rows[of_kind[leg] & rigid.in_base[rows]]
        terms.append(_twist_term(rigid, here, twist_of_leg(*joints)))
    return [term for term in terms if len(term.index)]


def _platform_axis_term(rigid: RigidProblem, rows: IntArray, function: ca.Function) -> Term:
    """Return the residuals of axes, or of fixed directions, on the platform."""
    leg = rigid.directions.leg[rows]
    place = rigid.unknowns.place[leg, PLATFORM_TURNS]
    axis, basis = axes_with_bases(rigid.unknowns.nominal, leg, "platform_axis")
    kind = Demand.PLATFORM_AXIS if function is revolute_on_platform() else Demand.ALONG_1
    sigma = rigid.sigma(rows, kind, _EXACT)
    index = np.hstack([rigid.index(rows), place])
    return Term(function, index, (*rigid.known(rows), axis, basis, sigma))


def _twist_term(rigid: RigidProblem, rows: IntArray, function: ca.Function) -> Term:
    """Return the residuals of twists."""
    leg, legs = rigid.directions.leg[rows], rigid.unknowns.nominal
    place = rigid.unknowns.place[leg]
    turns = (place[:, PLATFORM_TURNS], place[:, BASE_TURNS], place[:, TWIST, None])
    return Term(
        function,
        np.hstack([rigid.index(rows), *turns]),
        (
            *rigid.known(rows),
            *axes_with_bases(legs, leg, "base_axis"),
            *axes_with_bases(legs, leg, "platform_axis"),
            np.array([float(legs[j].twist or 0.0) for j in leg]),
            rigid.sigma(rows, Demand.TWIST, _EXACT),
        ),
    )


def axes_with_bases(
    legs: tuple[LegGeometry, ...], leg: IntArray, which: str
) -> tuple[Array, Array]:
    """Return ``base_axis`` or ``platform_axis`` of legs and what turns of it are about.

    Parameters
    ----------
    legs : tuple of LegGeometry
        The legs.
    leg : (n,) array of int
        Which of them.
    which : str
        Name of the attribute.

    Returns
    -------
    (n, 3) array, (n, 2, 3) array
    """
    axes = np.array([getattr(legs[j], which) for j in leg]).reshape(-1, 3)
    return axes, normal_basis(axes)
