"""A leg understood: its joints, its centres and its length law, from where its axes lie.

Nothing here reads names for meaning. All of it is worked out with the joints at zero, in the frame
of the base body: neither where the leg was cut nor where it hangs matters there.
"""

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from legcal.errors import OutOfClass
from legcal.geometry.types import Array
from legcal.mechanism.axes import Step
from legcal.mechanism.leg_chain import JointGroup, LegChain
from legcal.mechanism.leg_ends import Ends, LegAtZero
from legcal.mechanism.rod import rod_ends
from legcal.mechanism.telescope import telescope_ends


def understand(steps: Sequence[Step], platform_origin: Array, path: Path) -> LegChain:
    """Return the geometry of a leg from its joints.

    Parameters
    ----------
    steps : sequence of Step
        Its joints from base to platform.
    platform_origin : (3,) array
        Origin of the platform link in the body of the platform [m].
    path : Path
        The file, for messages.

    Raises
    ------
    OutOfClass
        If it is not a joint, at most one slider, and a joint, with axes as the method needs them.
    """
    zero = LegAtZero(steps, platform_origin)
    sliders = [i for i, s in enumerate(steps) if s.connection.type == "prismatic"]
    try:
        if not sliders:
            n_lower, ends = rod_ends(zero)
            return _chain(zero, n_lower, None, ends)
        if len(sliders) > 1 or sliders[0] == 0:
            raise OutOfClass(_misplaced(zero, sliders))
        return _chain(zero, sliders[0], steps[sliders[0]], telescope_ends(zero, sliders[0]))
    except OutOfClass as error:
        raise OutOfClass([f"{path}: {problem}" for problem in error.problems]) from error


def _misplaced(zero: LegAtZero, sliders: Sequence[int]) -> str:
    """Return why the sliders of a leg are not where a leg has one."""
    found = (
        f"{len(sliders)} sliders"
        if len(sliders) > 1
        else f"the slider '{zero.axes[0].name}' on the base itself, so that the joint at A moves"
    )
    return (
        f"the leg of joint '{zero.leg}' is outside the method: found {found}, needed a joint whose "
        "centre is fixed in the base, at most one slider, and a joint whose centre is fixed in the "
        "platform; this machine cannot be calibrated this way."
    )


def _chain(zero: LegAtZero, n_lower: int, slider: Step | None, ends: Ends) -> LegChain:
    """Return a leg, every number in the body that it is fixed in."""
    lower, upper = zero.poses[n_lower], zero.poses[n_lower + (slider is not None)]
    last = zero.poses[-1]
    groups = []
    for end, centre, near, far, own in (
        (ends.base, ends.A, zero.poses[0], lower, zero.poses[0]),
        (ends.platform, ends.B, upper, last, last),
    ):
        outer, inner = (end.axes[0].along, end.axes[-1].along) if end.axes else (None, None)
        groups.append(
            JointGroup(
                end.letter,
                np.asarray(near.inv().apply(centre)),
                np.asarray(far.inv().apply(centre)),
                None if outer is None else outer @ own.as_matrix()[:3, :3],
                inner,
            )
        )
    return LegChain(
        steps=zero.steps,
        bodies=tuple(s.connection.bodies[s.far] for s in zero.steps[:-1]),
        n_lower=n_lower,
        base=groups[0],
        platform=groups[1],
        slider=slider,
        u_lower=ends.u @ lower.as_matrix()[:3, :3],
        u_upper=ends.u @ upper.as_matrix()[:3, :3],
        reach=float((ends.B - ends.A) @ ends.u),
        u_zero=ends.u,
        T_zero=last,
        idle_spins=ends.idle_spins,
    )
