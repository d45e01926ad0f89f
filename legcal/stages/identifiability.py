"""The paper's conditions of identifiability as printed: eqs (10)-(12), (15) and (17).

They count equations and unknowns. Counts are neither sufficient (n points carry at most
3n - 6 distances, however often they are seen) nor necessary (everything at once knows more
than the steps): the steps themselves decide by the rank of their Jacobians.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass
from math import comb

import numpy as np

from legcal.observations.leg_axes import LegAxes
from legcal.observations.measurements import Measurements

_SAME_DIRECTION = 1e-9  # of the normalised information of eq (6)


@dataclass(frozen=True)
class Condition:
    """One condition of the paper.

    Attributes
    ----------
    name : str
        ``eq12``, ``eq15``, ``eq17``, ``every_leg_seen`` or ``two_directions``.
    ok : bool
        Whether it holds.
    equations, unknowns : int or None
        Both sides of a count; None for a condition that is not one.
    """

    name: str
    ok: bool
    equations: int | None = None
    unknowns: int | None = None


def count_conditions(
    views: Sequence[Collection[int]],
    n_legs: int,
    *,
    spatial: bool = True,
    revolute: Collection[int] = (),
    passive: Collection[int] = (),
) -> tuple[Condition, ...]:
    """Return the conditions that depend only on which legs each view shows.

    Parameters
    ----------
    views : sequence of collections of int
        The legs that each camera position shows.
    n_legs : int
        Number of legs n.
    spatial : bool
        False for planar mechanisms: two joint centres define the frame instead of three.
    revolute : collection of int
        Legs with a revolute joint on the base.
    passive : collection of int
        Legs whose length is neither measured nor constant.

    Returns
    -------
    tuple of Condition
        (12), (15), (17), and every leg seen.

    Notes
    -----
    As printed. Of E = l + 2(n - N_d) the first term is read as 1; passive legs count in E
    although (19) finds them.
    """
    n_d = 3 if spatial else 2
    joints_base = 3 + 3 * (n_legs - n_d) + 2 * len(revolute) if spatial else 2 + 2 * (n_legs - n_d)
    joints_platform = 3 + 3 * (n_legs - n_d) if spatial else 1 + 2 * (n_legs - n_d)
    products = distances = 0
    for legs in views:
        n, r = len(set(legs)), len(set(legs) & set(revolute))
        products += comb(r, 2) + comb(n, 2) + r * (n - 1)
        distances += comb(len(set(legs) - set(passive)), 2)
    seen = set().union(*(set(legs) for legs in views))
    return (
        _count("eq12", products, joints_base),
        _count("eq15", distances, n_legs - len(set(passive))),
        _count("eq17", distances, joints_platform),
        Condition("every_leg_seen", seen == set(range(n_legs))),
    )


def two_directions(axes: LegAxes, measurements: Measurements, n_legs: int) -> Condition:
    """Return whether every leg was seen in two different directions from one camera position."""
    view = measurements.view[axes.row]
    found = set()
    for v, j in {(int(v), int(j)) for v, j in zip(view, axes.leg, strict=True)}:
        u = axes.u[(view == v) & (axes.leg == j)]
        information = np.eye(3) - u[:, :, None] * u[:, None, :]
        if np.linalg.eigvalsh(information.sum(axis=0))[0] > _SAME_DIRECTION * len(u):
            found.add(j)
    return Condition("two_directions", found == set(range(n_legs)))


def legs_by_view(axes: LegAxes, measurements: Measurements) -> tuple[tuple[int, ...], ...]:
    """Return the legs that were seen from each camera position."""
    view = measurements.view[axes.row]
    return tuple(
        tuple(int(j) for j in np.unique(axes.leg[view == v]))
        for v in range(len(measurements.views))
    )


def _count(name: str, equations: int, unknowns: int) -> Condition:
    """Return a count as a condition."""
    return Condition(name, equations >= unknowns, equations, unknowns)
