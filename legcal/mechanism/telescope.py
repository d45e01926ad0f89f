"""The ends of a leg with a slider: where a line along it meets both joints (section 2)."""

import numpy as np

from legcal.errors import OutOfClass
from legcal.geometry.types import Array
from legcal.mechanism.axes import CONCURRENT, Axis, Pivot, nearest, parallel, pivot
from legcal.mechanism.leg_ends import Ends, LegAtZero, check_axes, with_spins

_END = {"R": "platform axis", "U": "platform joint", "S": "platform joint", "": "slider"}


def telescope_ends(zero: LegAtZero, slider: int) -> Ends:
    """Return the ends of a leg whose slider is one of its joints, given by its index.

    Between joints with a centre the leg's axis is the line through one of them along the slider.
    Between two R it is the line along the slider that meets both axes; where these are parallel,
    as in a plane, its height along them is that of the slider's joint origin.

    Raises
    ------
    OutOfClass
        If that line misses a joint by more than 10 um, or an axis is not square to it.
    """
    step = zero.steps[slider]
    u = zero.axes[slider].along * (1.0 if step.near == 0 else -1.0)  # a joint moves its child
    base = pivot(zero.axes[:slider], u, zero.leg)
    platform = pivot(zero.axes[:slider:-1], u, zero.leg)
    base, platform, idle_spins = with_spins(base, platform, u, zero.leg)
    origin = zero.axes[slider].point
    A, B, miss = _on_slider(base, platform, u, origin)
    what = f"its axis through the {_END[platform.letter]} misses the base joint"
    for spin in (*base.spins, *platform.spins):
        if spin.distance(A) > miss:
            miss, what = spin.distance(A), f"the axis of '{spin.name}' misses that of the leg"
    if miss > CONCURRENT:
        raise OutOfClass(
            f"the leg of slider '{step.name}' is outside the method: {what} "
            f"{'axis' if base.letter == 'R' else 'centre'} by {1e3 * miss:.4g} mm, needed at most "
            "0.01 mm; correct the origins along the leg."
        )
    if platform.letter == "":
        B = A + ((zero.platform_origin - A) @ u) * u
    ends = Ends(base, platform, A, B, u, idle_spins)
    check_axes(ends, zero.leg)
    return ends


def _on_slider(base: Pivot, platform: Pivot, u: Array, origin: Array) -> tuple[Array, Array, float]:
    """Return A and B where a line along the slider meets both joints, and by how much it misses."""
    A, B = base.centre, platform.centre
    v = base.axes[0] if base.letter == "R" else None
    w = platform.axes[0] if platform.letter == "R" else None
    if v is not None and w is not None:
        if parallel(v.along, w.along):
            across = np.cross(v.along, u)
            return v.foot(origin), w.foot(origin), abs(float((w.point - v.point) @ across))
        s, _, t = np.linalg.solve(np.stack([v.along, u, -w.along], axis=1), w.point - v.point)
        return v.point + s * v.along, w.point + t * w.along, 0.0
    if A is None and v is not None:
        A = _crossing(v, u, origin if B is None else B)
    if B is None:
        B = origin if w is None or A is None else _crossing(w, u, A)
        if w is None and base.letter != "R":
            B = A
    if A is None or B is None:
        raise ValueError("a leg without any joint has no centre")
    between = B - A
    return A, B, float(np.linalg.norm(between - (between @ u) * u))


def _crossing(axis: Axis, u: Array, point: Array) -> Array:
    """Return the point of an axis that is nearest to a line."""
    on_axis, _ = nearest(axis, Axis("", point, u))
    return axis.foot(point) if on_axis is None else on_axis
