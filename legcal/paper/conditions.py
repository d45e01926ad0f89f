"""The paper's conditions of identifiability as printed: eqs (10)-(12), (15), (17) and the text.

They count equations and unknowns. Counts are neither sufficient (n points have at most 3n - 6
independent distances, however often they are observed) nor necessary (a joint fit uses more
information than the steps): ranks decide.

The paper has no moving joints at A. Where actuators carry them, the counts are made by analogy and
marked as ours: (12) counts the axis of every actuator among the revolute axes, with four unknowns
of an arm and two of a carriage, and the centre of the circle of every rod on an arm as a further
point.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass, replace
from math import comb

import numpy as np

from legcal.geometry.types import Array, IntArray
from legcal.machine.leg import EquationKind, Leg, LegKind
from legcal.machine.parameters import n_frame_legs

_SAME_DIRECTION = 1e-9  # minimum eigenvalue of the normalised information of eq (6)
_AT_ONCE = 3  # legs that determine the pose of the platform in the camera frame, eq (18)


@dataclass(frozen=True)
class Condition:
    """One condition of the paper, a count or a requirement on legs."""

    name: str  # eq12, eq15, eq17, every_leg_seen, two_directions or three_legs_at_once
    ok: bool
    equations: int | None = None  # both sides of a count
    unknowns: int | None = None
    legs: tuple[int, ...] = ()  # legs that do not fulfil it
    needed: bool = True  # (12) is not, where a calibration board ties the cameras to each other
    by_analogy: bool = False  # ours and not the paper's: joints at A move


def count_conditions(
    views: Sequence[Collection[int]],
    n_legs: int,
    *,
    spatial: bool = True,
    revolute: Collection[int] = (),
    passive: Collection[int] = (),
    board: bool = False,
    actuators: Sequence[tuple[Collection[int], bool]] = (),
) -> tuple[Condition, ...]:
    """Return (12), (15), (17) and "every leg seen" from the legs that each camera position shows.

    As printed. The first term of E = l + 2(n - N_d) is read as 1; passive legs count in E although
    (19) determines them. ``revolute`` are the legs with a revolute joint at the base,
    ``actuators`` the legs on each actuator that moves joints at A, and whether it turns.
    """
    n_d = n_frame_legs(spatial=spatial)  # N_d: joint centres that define a frame
    joints_base = 3 + 3 * (n_legs - n_d) + 2 * len(revolute) if spatial else 2 + 2 * (n_legs - n_d)
    joints_base += sum(4 if turns else 2 for _, turns in actuators)
    joints_platform = 3 + 3 * (n_legs - n_d) if spatial else 1 + 2 * (n_legs - n_d)
    products = distances = 0
    for legs in views:
        n, r = len(set(legs)), len(set(legs) & set(revolute))
        middles = sum(len(set(legs) & set(on)) for on, turns in actuators if turns)
        r += sum(not set(legs).isdisjoint(on) for on, _ in actuators)
        n += middles
        # The product of the arm of a rod and the axis of its actuator is zero: no information
        products += comb(r, 2) + comb(n, 2) + r * max(n - 1, 0) - middles
        distances += comb(len(set(legs) - set(passive)), 2)
    n_offsets, ours = n_legs - len(set(passive)), bool(actuators)
    counts = (
        Condition("eq12", products >= joints_base, products, joints_base, needed=not board),
        Condition("eq15", distances >= n_offsets, distances, n_offsets),
        Condition("eq17", distances >= joints_platform, distances, joints_platform),
    )
    return (
        *(replace(count, by_analogy=ours) for count in counts),
        _without("every_leg_seen", set(range(n_legs)).difference(*views)),
    )


def two_directions(view: IntArray, leg: IntArray, u: Array, n_legs: int) -> Condition:
    """Return the condition that each leg is seen in two directions from one camera position.

    ``u`` (k, 3) are observed directions, in one frame for all of a view.
    """
    normal = np.eye(3) - u[:, :, None] * u[:, None, :]
    n_views = int(view.max(initial=-1)) + 1
    information = np.zeros((n_views, n_legs, 3, 3))
    number = np.zeros((n_views, n_legs))
    np.add.at(information, (view, leg), normal)
    np.add.at(number, (view, leg), 1.0)
    smallest = np.linalg.eigvalsh(information)[..., 0]
    has_two = ((number > 0) & (smallest > _SAME_DIRECTION * number)).any(axis=0)
    return _without("two_directions", set(np.flatnonzero(~has_two).tolist()))


def three_legs_at_once(
    views: Sequence[Collection[int]], legs: Sequence[Leg], *, spatial: bool = True
) -> Condition:
    """Return the condition that the legs in (18) and (19) are seen with enough others at once.

    A revolute joint on the platform (18) and the axes of a universal joint in a leg without an S
    joint need a view that shows the leg and three legs in all; the end of a passive leg (19) a
    view that shows it and three legs whose length is measured or constant. The revolute axes
    of a planar machine are known from the base.
    """
    with_length = {j for j, leg in enumerate(legs) if leg.kind is not LegKind.PASSIVE}
    missing = set()
    for j, leg in enumerate(legs):
        together = [set(view) for view in views if j in view]
        axes = leg.platform_axis is not None or (
            leg.base_axis is not None and EquationKind.BASE_AXIS not in leg.equations
        )
        if spatial and axes and not any(len(view) >= _AT_ONCE for view in together):
            missing.add(j)
        passive = leg.kind is LegKind.PASSIVE
        if passive and not any(len(view & with_length) >= _AT_ONCE for view in together):
            missing.add(j)
    return _without("three_legs_at_once", missing)


def _without(name: str, missing: set[int]) -> Condition:
    """Return a condition that some legs do not meet."""
    return Condition(name, not missing, legs=tuple(sorted(missing)))
