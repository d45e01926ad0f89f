"""One leg of an n-leg parallel mechanism (section 2)."""

from collections.abc import Sequence
from dataclasses import dataclass
from enum import StrEnum
from typing import Literal

from legcal.geometry.types import Array

JointLetter = Literal["R", "U", "S"]
PlatformLetter = Literal["R", "U", "S", ""]

SHORTEST, LONGEST = 1e-3, 20.0  # [m]; legs beyond are most likely written in another unit
THINNEST, THICKEST = 2e-4, 0.5  # radius of a leg in its length; beyond, its unit is the mistake
MOST_LEGS = 32  # the work of all that is done with them grows with the cube of their number


class LegKind(StrEnum):
    """What moves along a leg: a motor with an encoder, a free slider, or nothing."""

    ACTUATED = "actuated"
    PASSIVE = "passive"
    CONSTANT = "constant"


@dataclass(frozen=True)
class Cylinder:
    """A visible cylinder coaxial with its leg: a tube or a rod.

    Attributes
    ----------
    link : str
        The URDF link that carries the visual; it names the part in observations.
    radius : float
        Radius [m].
    side : {"base", "platform"}
        The half of the leg that the cylinder moves with. Positions along the leg are
        measured from A for ``base`` and from B for ``platform``, positive from A to B.
    start, end : float
        The ends along the leg axis [m], ``start < end``.
    """

    link: str
    radius: float
    side: Literal["base", "platform"]
    start: float
    end: float

    def span(self, length: float) -> tuple[float, float]:
        """Return both ends as distances from A along a leg of that length [m]."""
        shift = 0.0 if self.side == "base" else length
        return self.start + shift, self.end + shift


def main_cylinders(cylinders: Sequence[Cylinder]) -> dict[str, Cylinder]:
    """Return the cylinder that each link names as a part: its longest; the others hide pieces."""
    found: dict[str, Cylinder] = {}
    for cylinder in sorted(cylinders, key=lambda c: (c.end - c.start, c.radius)):
        found[cylinder.link] = cylinder
    return found


@dataclass(frozen=True, eq=False)
class Leg:
    """A leg from its base joint centre A to its platform joint centre B.

    Attributes
    ----------
    name : str
        The name in the mechanism file.
    base_joint : {"R", "U", "S"}
        Type of the joint at the base, found from the model.
    platform_joint : {"R", "U", "S", ""}
        Type of the joint at the platform; empty for a leg that is fixed to the platform (the
        centre leg of a Tricept). B of such a leg is the foot of the platform link's origin on
        the leg's axis.
    kind : LegKind
        Actuated, passive or constant length.
    prismatic : str or None
        The URDF prismatic joint; None for a constant-length leg.
    A_base : (3,) array
        Base joint centre in the base link [m].
    B_platform : (3,) array
        Platform joint centre in the platform link [m].
    q0 : float
        Leg length at reading zero [m]: L = sign * q + q0. The length of a constant leg.
    sign : int
        +1 where the leg grows with the joint value, -1 where it shrinks.
    travel : tuple of float
        Lower and upper joint limit [m]; (0, 0) for a constant-length leg.
    cylinders : tuple of Cylinder
        What a camera can see of the leg.
    base_axis, platform_axis : (3,) array or None
        Unit axis in the base or platform link, only for joints whose axis is a parameter: R,
        and the outer axis of U in a leg without an S joint; none in planar mechanisms. The last
        component that is not zero is positive: an axis is a line. The platform axis of a leg
        that is fixed to the platform is its direction from A to B.
    twist : float or None
        Angle about u from the inner axis at the base to the inner one at the platform [rad],
        in (-pi/2, pi/2], which the leg keeps constant; only for legs without an S joint in
        space. See :mod:`legcal.mechanism.equations`.
    """

    name: str
    base_joint: JointLetter
    platform_joint: PlatformLetter
    kind: LegKind
    prismatic: str | None
    A_base: Array
    B_platform: Array
    q0: float
    sign: int
    travel: tuple[float, float]
    cylinders: tuple[Cylinder, ...]
    base_axis: Array | None = None
    platform_axis: Array | None = None
    twist: float | None = None

    @property
    def radius_of_part(self) -> dict[str, float]:
        """Radius [m] of each part that outlines are found of, by its URDF link."""
        return {link: c.radius for link, c in main_cylinders(self.cylinders).items()}

    @property
    def type(self) -> str:
        """The leg's joints from base to platform, such as ``SPU``; ``UP`` if fixed there."""
        slider = "" if self.kind is LegKind.CONSTANT else "P"
        return f"{self.base_joint}{slider}{self.platform_joint}"
