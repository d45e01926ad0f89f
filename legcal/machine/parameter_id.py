"""Names of parameters, and their parts: owner, kind, component."""

from __future__ import annotations

from dataclasses import dataclass

JOINTS = ("base", "platform")  # kinds of joint coordinates at both ends of a leg
AXES = ("base_axis", "platform_axis")  # kinds of rotations of the axes there
ARMS = ("arm_axis", "arm_point")  # kinds of the line of an arm
_XYZ, _TWO = ("x", "y", "z"), ("1", "2")
_COMPONENTS = {
    **dict.fromkeys(JOINTS, _XYZ),
    **dict.fromkeys(AXES, (*_TWO, *_XYZ)),  # turns in R_b or R_e, and about the axes of a link
    **dict.fromkeys((*ARMS, "direction", "axis", "axis_point"), _TWO),
}
_RADIUS = ".radius."


@dataclass(frozen=True, slots=True)
class ParameterId:
    """A parameter, named ``<owner>.<kind>`` or ``<owner>.<kind>.<component>``.

    Attributes
    ----------
    owner : str
        The leg, motor or view; it may contain dots.
    kind : str
        ``base``, ``platform``, ``offset``, ``length``, ``base_axis``, ``platform_axis``,
        ``twist``, ``radius`` of legs; ``direction``, ``axis``, ``axis_point``, ``arm_axis``,
        ``arm_point``, ``gain`` of motors; ``fx``, ``k1``, ``gamma`` and others of cameras.
    component : str
        A coordinate (``x``), an angle (``1``), the link of a radius, or nothing.
    """

    owner: str
    kind: str
    component: str = ""

    @classmethod
    def parse(cls, name: str) -> ParameterId:
        """Return the parameter of a name; the owner is empty if the name has no dot."""
        head, _, component = name.rpartition(".")
        owner, _, kind = head.rpartition(".")
        if owner and component in _COMPONENTS.get(kind, ()):
            return cls(owner, kind, component)
        if _RADIUS in name:
            owner, _, link = name.partition(_RADIUS)
            return cls(owner, "radius", link)
        return cls(head, component)

    def __str__(self) -> str:
        return ".".join(part for part in (self.owner, self.kind, self.component) if part)

    @property
    def is_joint_coordinate(self) -> bool:
        """Whether it is a coordinate of a joint at an end of a leg."""
        return self.kind in JOINTS
