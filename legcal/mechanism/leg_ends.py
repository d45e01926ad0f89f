"""Both ends of a leg with its joints at zero, and the revolutes along the leg made part of them."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import RigidTransform

from legcal.errors import OutOfClass
from legcal.geometry.frames import product
from legcal.geometry.types import Array
from legcal.mechanism.axes import PERPENDICULAR, Axis, Pivot, Step, off_square


@dataclass(frozen=True, eq=False)
class Ends:
    """Both ends of a leg with all joints at zero: their joints, A, B, and the leg's direction."""

    base: Pivot
    platform: Pivot
    A: Array
    B: Array
    u: Array
    idle_spins: int


class LegAtZero:
    """The joints of a leg at zero, in the frame of the base body."""

    def __init__(self, steps: Sequence[Step], platform_origin: Array) -> None:
        self.steps = tuple(steps)
        self.poses = [RigidTransform.identity()]
        self.axes: list[Axis] = []
        for step in steps:
            T_near, T_far = (step.connection.T_body_joint[side] for side in (step.near, step.far))
            T = product(self.poses[-1], T_near)
            turns = step.connection.type != "sphere"
            direction = T.as_matrix()[:3, :3] @ step.axis if turns else None
            self.axes.append(Axis(step.name, T.as_matrix()[:3, 3], direction))
            self.poses.append(product(T, T_far.inv()))
        self.platform_origin = np.asarray(self.poses[-1].apply(platform_origin))
        self.leg = next((s.connection.joint for s in steps if s.connection.joint), "") or ""


def with_spins(base: Pivot, platform: Pivot, u: Array, leg: str) -> tuple[Pivot, Pivot, int]:
    """Return both joints with the revolutes along the leg made part of them, and the idle ones.

    A universal joint and a revolute along the leg are an S, on whichever end it stands: the leg
    twists freely. What is left turns the leg idly, if there is an S.

    Raises
    ------
    OutOfClass
        If there is none, or nothing but a revolute along the leg at the base.
    """
    spare = [len(base.spins), len(platform.spins)]
    ends = [base, platform]
    for i in (0, 1):
        if ends[i].letter == "U" and spare[1 - i] and ends[1 - i].letter != "S":
            spare[1 - i] -= 1
            ends[i] = Pivot("S", ends[i].centre, (), ends[i].spins, ends[i].spare)
    left = sum(spare)
    letters = [end.letter for end in ends]
    if letters[0] == "":
        raise OutOfClass(
            f"the leg of joint '{leg}' is outside the method: found the axis of "
            f"'{base.spins[0].name}' along the leg, needed one perpendicular to it within "
            f"{np.degrees(PERPENDICULAR):.2g} deg; this machine cannot be calibrated this way."
        )
    if left and "S" not in letters:
        name = (*base.spins, *platform.spins)[0].name
        raise OutOfClass(
            f"the leg of joint '{leg}' is outside the method: found the axis of '{name}' along the "
            "leg, and no S joint; needed the inner axis of a universal joint perpendicular to the "
            f"leg within {np.degrees(PERPENDICULAR):.2g} deg; correct its axis."
        )
    idle = left + base.spare + platform.spare + (letters == ["S", "S"])
    return ends[0], ends[1], idle


def check_axes(ends: Ends, leg: str) -> None:
    """Refuse revolute axes, and inner axes of legs without S, that are not square to the leg."""
    without_s = "S" not in (ends.base.letter, ends.platform.letter)
    for end in (ends.base, ends.platform):
        if end.letter == "R" or (end.letter == "U" and without_s):
            tilt = off_square(end.axes[-1].along, ends.u)
            if tilt > PERPENDICULAR:
                what = "a revolute axis" if end.letter == "R" else "an inner axis of a U joint"
                raise OutOfClass(
                    f"the leg of joint '{leg}' is outside the method: found the axis of "
                    f"'{end.axes[-1].name}' {np.degrees(tilt):.4g} deg from perpendicular to the "
                    f"leg, needed {what} within {np.degrees(PERPENDICULAR):.2g} deg; correct it."
                )
