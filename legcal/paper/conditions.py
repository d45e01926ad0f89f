"""The paper's conditions of identifiability as printed: eqs (10)-(12), (15), (17) and their words.

They count equations and unknowns. Counts are neither sufficient (n points carry at most
3n - 6 distances, however often they are seen) nor necessary (everything at once knows more
than the steps): ranks decide.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass, replace
from math import comb

import numpy as np

from legcal.geometry import Array, IntArray
from legcal.machine import LegGeometry, LegKind, n_frame_legs

_SAME_DIRECTION = 1e-9  # of the normalised information of eq (6)
_AT_ONCE = 3  # legs that give the pose of the platform in the camera frame, eq (18)


@dataclass(frozen=True)
class Condition:
    """One condition of the paper.

    Attributes
    ----------
    name : str
        ``eq12``, ``eq15``, ``eq17``, ``every_leg_seen``, ``two_directions`` or
        ``three_legs_at_once``.
    ok : bool
        Whether it holds.
    equations, unknowns : int or None
        Both sides of a count; None for a condition that is not one.
    legs : tuple of int
        The legs for which it does not hold, where it speaks of legs.
    needed : bool
        False for (12) where a calibration board ties the cameras to each other: then there is
        nothing to join by scalar products.
    """

    name: str
    ok: bool
    equations: int | None = None
    unknowns: int | None = None
    legs: tuple[int, ...] = ()
    needed: bool = True

    @property
    def fails(self) -> bool:
        """Whether it is needed and does not hold."""
        return self.needed and not self.ok


def count_conditions(
    views: Sequence[Collection[int]],
    n_legs: int,
    *,
    spatial: bool = True,
    revolute: Collection[int] = (),
    passive: Collection[int] = (),
    board: bool = False,
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
    board : bool
        Whether a calibration board ties the cameras to each other, so that (12) is not needed.

    Returns
    -------
    tuple of Condition
        (12), (15), (17), and every leg seen.

    Notes
    -----
    As printed. Of E = l + 2(n - N_d) the first term is read as 1; passive legs count in E
    although (19) finds them.
    """
    n_d = n_frame_legs(spatial=spatial)
    joints_base = 3 + 3 * (n_legs - n_d) + 2 * len(revolute) if spatial else 2 + 2 * (n_legs - n_d)
    joints_platform = 3 + 3 * (n_legs - n_d) if spatial else 1 + 2 * (n_legs - n_d)
    products = distances = 0
    for legs in views:
        n, r = len(set(legs)), len(set(legs) & set(revolute))
        products += comb(r, 2) + comb(n, 2) + r * (n - 1)
        distances += comb(len(set(legs) - set(passive)), 2)
    unseen = set(range(n_legs)).difference(*views)
    return (
        replace(_count("eq12", products, joints_base), needed=not board),
        _count("eq15", distances, n_legs - len(set(passive))),
        _count("eq17", distances, joints_platform),
        _for_legs("every_leg_seen", unseen),
    )


def two_directions(view: IntArray, leg: IntArray, u: Array, n_legs: int) -> Condition:
    """Return whether every leg is seen in two different directions from one camera position.

    Parameters
    ----------
    view, leg : (k,) array of int
        The view and the leg of each observation.
    u : (k, 3) array
        Its direction, in one frame for all observations of a view.
    n_legs : int
        Number of legs.
    """
    normal = np.eye(3) - u[:, :, None] * u[:, None, :]
    n_views = int(view.max(initial=-1)) + 1
    information = np.zeros((n_views, n_legs, 3, 3))
    number = np.zeros((n_views, n_legs))
    np.add.at(information, (view, leg), normal)
    np.add.at(number, (view, leg), 1.0)
    smallest = np.linalg.eigvalsh(information)[..., 0]
    found = ((number > 0) & (smallest > _SAME_DIRECTION * number)).any(axis=0)
    return _for_legs("two_directions", set(np.flatnonzero(~found).tolist()))


def three_legs_at_once(
    views: Sequence[Collection[int]], legs: Sequence[LegGeometry], *, spatial: bool = True
) -> Condition:
    """Return whether the legs that (18) or (19) speak of are seen with enough others at once.

    A revolute joint on the platform (18) and the axes of a universal joint in a leg without an S
    joint need a view that shows the leg and three legs in all; the end of a passive leg (19) a
    view that shows it and three legs whose length is measured or constant. The revolute axes
    of a planar mechanism are known from the base.

    Parameters
    ----------
    views : sequence of collections of int
        The legs that each camera position shows.
    legs : sequence of LegGeometry
        All legs.
    spatial : bool
        False for planar mechanisms.
    """
    with_length = {j for j, leg in enumerate(legs) if leg.kind is not LegKind.PASSIVE}
    missing = set()
    for j, leg in enumerate(legs):
        together = [set(view) for view in views if j in view]
        axes = spatial and leg.platform_axis is not None
        universal = spatial and leg.base_axis is not None and leg.base_joint == "U"
        if (axes or universal) and not any(len(view) >= _AT_ONCE for view in together):
            missing.add(j)
        passive = leg.kind is LegKind.PASSIVE
        if passive and not any(len(view & with_length) >= _AT_ONCE for view in together):
            missing.add(j)
    return _for_legs("three_legs_at_once", missing)


def _count(name: str, equations: int, unknowns: int) -> Condition:
    """Return a count as a condition."""
    return Condition(name, equations >= unknowns, equations, unknowns)


def _for_legs(name: str, missing: set[int]) -> Condition:
    """Return a condition that some legs do not meet."""
    return Condition(name, not missing, legs=tuple(sorted(missing)))
