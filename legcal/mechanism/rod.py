"""The ends of a leg of constant length: where its axes stop meeting (section 2)."""

from collections.abc import Sequence

import numpy as np

from legcal.errors import OutOfClass
from legcal.geometry.types import Array
from legcal.mechanism.axes import CONCURRENT, Axis, Pivot, nearest, pivot
from legcal.mechanism.leg_ends import Ends, LegAtZero, check_axes, with_spins


def rod_ends(zero: LegAtZero) -> tuple[int, Ends]:
    """Return how many joints of a leg without slider are at the base, and its ends.

    A revolute along the rod passes through both centres, and may belong to either joint: the one
    that its origin is nearer to.

    Raises
    ------
    OutOfClass
        If no split makes two joints, each with one centre, and axes as the method needs them.
    """
    found: list[tuple[float, int, Ends]] = []
    problems: dict[int, OutOfClass] = {}
    for n_lower in range(1, len(zero.steps)):
        try:
            ends = _split_rod(zero, n_lower)
        except OutOfClass as error:
            problems[n_lower] = error
            continue
        lower, upper = zero.axes[:n_lower], zero.axes[n_lower:]
        away = [np.linalg.norm(axis.point - ends.A) for axis in lower]
        away += [np.linalg.norm(axis.point - ends.B) for axis in upper]
        found.append((float(sum(away)), n_lower, ends))
    if found:
        _, n_lower, ends = min(found, key=lambda split: split[:2])
        return n_lower, ends
    places = _places(zero.axes)
    if len(places) == 2:
        raise problems[len(places[0])]
    what = (
        f"no slider and {len(places)} joints in different places, so that the rod hangs on a "
        "moving arm and the joint at A moves"
        if len(places) > 2
        else "no slider and all joints in one place"
    )
    raise OutOfClass(
        f"the leg of joint '{zero.leg}' is outside the method: found {what}, needed a joint whose "
        "centre is fixed in the base, then a slider or a rod of constant length, and a joint whose "
        "centre is fixed in the platform; this machine cannot be calibrated this way."
    )


def _split_rod(zero: LegAtZero, n_lower: int) -> Ends:
    """Return the ends of a rod whose first joints are at the base."""
    lower, upper = zero.axes[:n_lower], zero.axes[: n_lower - 1 : -1]
    A, B = _on_rod(pivot(lower, None, zero.leg), pivot(upper, None, zero.leg))
    length = float(np.linalg.norm(B - A))
    if length < CONCURRENT:
        raise OutOfClass(
            f"the leg of joint '{zero.leg}' is outside the method: found both its joints in one "
            "point, needed a distance between them; correct their origins."
        )
    u = (B - A) / length
    base, platform = pivot(lower, u, zero.leg), pivot(upper, u, zero.leg)
    base, platform, idle_spins = with_spins(base, platform, u, zero.leg)
    ends = Ends(base, platform, A, B, u, idle_spins)
    if platform.letter == "":
        raise OutOfClass(
            f"the leg of joint '{zero.leg}' is outside the method: found a rod that only turns "
            "about itself at the platform, needed a joint there; correct its axes."
        )
    check_axes(ends, zero.leg)
    return ends


def _on_rod(base: Pivot, platform: Pivot) -> tuple[Array, Array]:
    """Return A and B of a rod: feet of the other centre, or of the common perpendicular."""
    A, B = base.centre, platform.centre
    if A is None and B is None:
        v, w = base.axes[0], platform.axes[0]
        A, B = nearest(v, w)
        if A is None or B is None:  # parallel: where the joint at the base was put
            A, B = v.point, w.foot(v.point)
    elif A is None and B is not None:
        A = base.axes[0].foot(B)
    elif B is None and A is not None:
        B = platform.axes[0].foot(A)
    if A is None or B is None:
        raise ValueError("a rod without any joint has no centre")
    return A, B


def _places(axes: Sequence[Axis]) -> list[list[Axis]]:
    """Split the joints of a leg without slider where their axes stop meeting."""
    places = [[axes[0]]]
    for axis in axes[1:]:
        last = places[-1]
        if axis.direction is None or last[-1].direction is None:
            line, sphere = (axis, last[-1]) if last[-1].direction is None else (last[-1], axis)
            meets = line.distance(sphere.point) <= CONCURRENT
        else:
            near, far = nearest(last[-1], axis)
            meets = (
                near is not None
                and far is not None
                and float(np.linalg.norm(near - far)) <= CONCURRENT
            )
        if meets:
            last.append(axis)
        else:
            places.append([axis])
    return places
