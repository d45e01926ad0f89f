"""Joint axes that meet in a point: R, U and S from revolutes, and their centres."""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from legcal.errors import OutOfClass
from legcal.geometry.types import Array
from legcal.mechanism.bodies import Connection
from legcal.mechanism.leg import JointLetter

CONCURRENT = 10e-6  # [m]
PERPENDICULAR = 1e-3  # [rad]


@dataclass(frozen=True, eq=False)
class Step:
    """A connection as a leg passes it from base to platform.

    Attributes
    ----------
    connection : Connection
        The joint.
    near, far : int
        Which of its two bodies lies towards the base, and which towards the platform.
    axis : (3,) array
        Unit axis in the joint frame.
    """

    connection: Connection
    near: int
    far: int
    axis: Array

    def line(self, side: int) -> tuple[Array, Array]:
        """Return a point [m] and the direction of the axis in the body of one side."""
        T = self.connection.T_body_joint[side]
        return np.asarray(T.translation), np.asarray(T.rotation.apply(self.axis))

    def point(self, side: int, along: float) -> Array:
        """Return the point of the axis at a distance from the joint frame's origin [m]."""
        origin, direction = self.line(side)
        return origin + along * direction


@dataclass(frozen=True, eq=False)
class JointGroup:
    """A joint of the leg at base or platform, with its centre in the bodies that it joins.

    Attributes
    ----------
    letter : {"R", "U", "S"}
        Its type.
    centre_near, centre_far : (3,) array
        The centre in the body towards the base, and in the one towards the platform [m].
    """

    letter: JointLetter
    centre_near: Array
    centre_far: Array


def joint_group(steps: Sequence[Step], leg: str) -> JointGroup:
    """Return the joint that consecutive spheres and revolutes make, from their geometry.

    Three revolutes whose axes meet in one point are an S, two that meet at right angles a U.

    Raises
    ------
    OutOfClass
        If the axes do not meet within 10 um, a U is not at right angles, or they are too many.
    """
    names = " and ".join(f"'{s.connection.joint or 'the 3d closure'}'" for s in steps)
    kinds = [s.connection.type for s in steps]
    if kinds == ["sphere"]:
        T_near, T_far = (steps[0].connection.T_body_joint[i] for i in (steps[0].near, steps[0].far))
        return JointGroup("S", np.asarray(T_near.translation), np.asarray(T_far.translation))
    if "sphere" in kinds or "prismatic" in kinds or not 1 <= len(steps) <= 3:
        raise OutOfClass(
            f"leg '{leg}' could not be understood: found {len(steps)} joints ({names}) at one end, "
            "needed one R, U or S; write the leg as joint, slider, joint."
        )
    first, last = steps[0], steps[-1]
    if len(steps) == 1:
        return JointGroup("R", first.point(first.near, 0.0), first.point(first.far, 0.0))
    on_axes = [_meeting(a, b, leg) for a, b in pairwise(steps)]
    if len(steps) == 3:
        gap = abs(on_axes[0][1] - on_axes[1][0])
        if gap > CONCURRENT:
            raise OutOfClass(
                f"leg '{leg}' could not be understood: the axes of {names} meet in two points "
                f"{1e3 * gap:.4g} mm apart, needed one point within 0.01 mm; correct their origins."
            )
    else:
        tilt = _off_square(*steps)
        if tilt > PERPENDICULAR:
            raise OutOfClass(
                f"leg '{leg}' could not be understood: the axes of {names} are "
                f"{np.degrees(tilt):.4g} deg from perpendicular, needed a universal joint within "
                f"{np.degrees(PERPENDICULAR):.2g} deg; correct their axes."
            )
    letter: JointLetter = "U" if len(steps) == 2 else "S"
    near, far = on_axes[0][0], on_axes[-1][1]
    return JointGroup(letter, first.point(first.near, near), last.point(last.far, far))


def meet(one: Step, two: Step) -> bool:
    """Say whether the axes of two revolutes that share a body meet in a point."""
    gap = _gap(one, two)[0]
    return gap is not None and gap <= CONCURRENT


def _meeting(one: Step, two: Step, leg: str) -> tuple[float, float]:
    """Return where two axes meet, as distances along both from their origins [m]."""
    gap, along_one, along_two = _gap(one, two)
    if gap is None or gap > CONCURRENT:
        found = "are parallel" if gap is None else f"miss each other by {1e3 * gap:.4g} mm"
        raise OutOfClass(
            f"leg '{leg}' could not be understood: the axes of '{one.connection.joint}' and "
            f"'{two.connection.joint}' {found}, needed axes that meet within 0.01 mm; correct "
            "their origins."
        )
    return along_one, along_two


def _gap(one: Step, two: Step) -> tuple[float | None, float, float]:
    """Return the distance of two axes (None if parallel) and where they come nearest [m]."""
    P1, d1 = one.line(one.far)
    P2, d2 = two.line(two.near)
    normal = np.cross(d1, d2)
    square = float(normal @ normal)
    if square < 1e-6:
        return None, 0.0, 0.0
    between = P2 - P1
    along_one = float(np.cross(between, d2) @ normal) / square
    along_two = float(np.cross(between, d1) @ normal) / square
    return abs(float(between @ normal)) / np.sqrt(square), along_one, along_two


def _off_square(one: Step, two: Step) -> float:
    """Return how far two axes are from perpendicular [rad]."""
    cosine = float(one.line(one.far)[1] @ two.line(two.near)[1])
    return abs(float(np.arcsin(np.clip(cosine, -1.0, 1.0))))
