"""The chain of one leg as it was understood: its joints, centres and length law."""

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import RigidTransform

from legcal.geometry.types import Array
from legcal.mechanism.axes import Step
from legcal.mechanism.leg import PlatformLetter


@dataclass(frozen=True, eq=False)
class JointGroup:
    """A joint of the leg at base or platform, with its centre in the bodies that it joins.

    Attributes
    ----------
    letter : {"R", "U", "S", ""}
        Its type; empty where the leg is fixed to the platform.
    centre_near, centre_far : (3,) array
        The centre in the body towards the base, and in the one towards the platform [m].
    outer : (3,) array or None
        The axis of R, or the one of U that is fixed in base or platform, in that body.
    inner : (3,) array or None
        The axis of R, or the one of U that is fixed in the leg, with all joints of the leg at
        zero in the body of the base.
    """

    letter: PlatformLetter
    centre_near: Array
    centre_far: Array
    outer: Array | None
    inner: Array | None


@dataclass(frozen=True, eq=False)
class LegChain:
    """The chain of one leg, and its geometry.

    Attributes
    ----------
    steps : tuple of Step
        Its joints from base to platform.
    bodies : tuple of str
        The body after every joint but the last: all of the leg, without base and platform.
    n_lower : int
        Number of joints on the base side of the slider, or of the rod.
    base, platform : JointGroup
        The joints at both ends.
    slider : Step or None
        The prismatic joint; None for a leg of constant length.
    u_lower, u_upper : (3,) array
        For a slider, the direction in which its value moves the platform end, in the bodies on
        its base and platform side; else the direction from A to B.
    reach : float
        Position of B past A along that direction at joint value zero [m].
    u_zero : (3,) array
        That direction with all joints at zero, in the body of the base.
    T_zero : RigidTransform
        The body of the platform in that of the base, with all joints of the leg at zero.
    idle_spins : int
        Freedoms of the joints that turn nothing but the leg about itself.
    """

    steps: tuple[Step, ...]
    bodies: tuple[str, ...]
    n_lower: int
    base: JointGroup
    platform: JointGroup
    slider: Step | None
    u_lower: Array
    u_upper: Array
    reach: float
    u_zero: Array
    T_zero: RigidTransform
    idle_spins: int

    @property
    def motor(self) -> str | None:
        """The slider's joint, None for a rod."""
        return None if self.slider is None else self.slider.connection.joint

    @property
    def u_platform(self) -> Array:
        """The direction ``u_zero`` in the body of the platform, for a leg that is fixed to it."""
        return np.asarray(self.T_zero.rotation.inv().apply(self.u_zero))

    @property
    def twists(self) -> bool:
        """Whether an S joint lets the leg twist about itself."""
        return "S" in (self.base.letter, self.platform.letter)
