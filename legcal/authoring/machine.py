"""A machine as described: what a table or a family says of every leg, in SI units."""

import re
from dataclasses import dataclass
from typing import cast

from scipy.spatial.transform import RigidTransform

from legcal.geometry.frames import motion_from_xyz_quat
from legcal.geometry.types import Array
from legcal.mechanism.leg import JointLetter, LegKind, PlatformLetter

_TYPE = re.compile(r"([RUS])(P?)([RUS]?)")

NEEDED_TYPE = (
    "R, U or S at the base, P for a slider, then R, U or S at the platform or nothing for a leg "
    "that is fixed there (UPS, SPU, RPR, UP, SS)"
)


@dataclass(frozen=True)
class LegType:
    """The joints of a leg from base to platform, as they are written: ``UPS``, ``SS``, ``UP``.

    Attributes
    ----------
    base : {"R", "U", "S"}
        The joint at the base.
    has_slider : bool
        Whether there is a P.
    platform : {"R", "U", "S", ""}
        The joint at the platform; empty for a leg that is fixed there.
    """

    base: JointLetter
    has_slider: bool
    platform: PlatformLetter

    @property
    def has_sphere(self) -> bool:
        """Whether one of the joints is an S."""
        return "S" in (self.base, self.platform)


def leg_type(text: str) -> LegType | None:
    """Return the leg type of a text such as ``UPS``; None if it is none."""
    match = _TYPE.fullmatch(text)
    if match is None or not (match[2] or match[3]):
        return None
    return LegType(cast(JointLetter, match[1]), bool(match[2]), cast(PlatformLetter, match[3]))


@dataclass(frozen=True, eq=False)
class LegEntry:
    """One leg as described.

    Attributes
    ----------
    name : str
        Its name.
    type : LegType
        Its joints.
    kind : LegKind
        Whether its slider has a motor, moves freely, or is not there.
    A_base, B_platform : (3,) array
        Joint centres in the base and the platform link [m]; B of a leg that is fixed to the
        platform is any point of its axis.
    offset : float or None
        Length at reading zero [m] of an actuated leg, length of a constant one. A passive slider
        without one reads the length itself. None also for a constant leg that has the length
        which home gives it.
    travel : tuple of float or None
        Lowest and highest reading [m]; None for constant legs and for passive sliders that move
        freely.
    tube, rod : float or None
        Radii of the base and of the platform half [m]; None where they cannot be seen.
    base_axis, platform_axis : (3,) array or None
        Axes of R and outer axes of U as unit vectors in the base and the platform link; None for
        the default.
    """

    name: str
    type: LegType
    kind: LegKind
    A_base: Array
    B_platform: Array
    offset: float | None
    travel: tuple[float, float] | None
    tube: float | None
    rod: float | None
    base_axis: Array | None
    platform_axis: Array | None


@dataclass(frozen=True, eq=False)
class Description:
    """A machine as described by a table or a family.

    Attributes
    ----------
    name : str
        The name of the model and of its files.
    source : str
        Where it was described, for messages: a path, or the family.
    unit : str
        The unit in which it was described, for messages.
    legs : tuple of LegEntry
        The legs in order.
    home : Home or None
        T_base_platform of a pose in which it closes.
    base_frame : tuple of str or None
        The legs whose joints define R_b and R_e.
    """

    name: str
    source: str
    unit: str
    legs: tuple[LegEntry, ...]
    home: "Home | None"
    base_frame: tuple[str, ...] | None


@dataclass(frozen=True, eq=False)
class Home:
    """A pose with the numbers as they were written.

    Attributes
    ----------
    xyz : tuple of float
        Position [m].
    quat_xyzw : tuple of float
        Unit quaternion, as far as its digits go.
    """

    xyz: tuple[float, ...]
    quat_xyzw: tuple[float, ...]

    def motion(self) -> RigidTransform:
        """Return T_base_platform."""
        return motion_from_xyz_quat(self.xyz, self.quat_xyzw)
