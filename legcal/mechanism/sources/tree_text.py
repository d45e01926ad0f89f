"""A URDF written from links and joints, for formats that are not URDF."""

from collections.abc import Set
from dataclasses import dataclass, field
from html import escape
from math import pi

import numpy as np
from scipy.spatial.transform import RigidTransform

from legcal.geometry.frames import roll_pitch_yaw
from legcal.geometry.types import Array

FULL_TURN = 2.0 * pi
EYE = RigidTransform.identity()


@dataclass(frozen=True, eq=False)
class TextCylinder:
    """A visual cylinder on a link: its pose there, radius and length [m]."""

    T_link_cylinder: RigidTransform
    radius: float
    length: float


@dataclass
class TreeText:
    """The lines of a URDF while it is put together.

    Attributes
    ----------
    links, joints : dict of str to str
        The line of every link and joint, by name.
    """

    links: dict[str, str] = field(default_factory=dict)
    joints: dict[str, str] = field(default_factory=dict)

    def unused(self, name: str, others: Set[str] = frozenset()) -> str:
        """Return a name that no link and no joint has yet: the given one, or it with a number."""
        taken = self.links.keys() | self.joints.keys() | others
        number, found = 1, name
        while found in taken:
            number += 1
            found = f"{name}_{number}"
        return found

    def link(self, name: str, cylinders: tuple[TextCylinder, ...] = ()) -> None:
        """Add a link with its visible cylinders."""
        self.show(
            name, "".join(visual(origin(c.T_link_cylinder), c.radius, c.length) for c in cylinders)
        )

    def show(self, name: str, visuals: str) -> None:
        """Add a link, or write it anew where it stands, with its visuals."""
        inside = f">{visuals}</link>" if visuals else "/>"
        self.links[name] = f"  <link name={_quoted(name)}{inside}"

    def joint(
        self,
        name: str,
        kind: str,
        parent: str,
        child: str,
        T_parent_origin: RigidTransform = EYE,
        axis: Array | None = None,
        limits: tuple[float, float] | None = (-FULL_TURN, FULL_TURN),
    ) -> None:
        """Add a joint; ``axis`` and ``limits`` [rad] or [m] are those of a moving one."""
        moving = ""
        if axis is not None:
            moving = along(axis) + limit(limits)
        self.connect(name, kind, (parent, child), origin(T_parent_origin) + moving)

    def connect(self, name: str, kind: str, links: tuple[str, str], inside: str) -> None:
        """Add a joint between parent and child with its elements, the origin first."""
        parent, child = (_quoted(link) for link in links)
        self.joints[name] = (
            f'  <joint name={_quoted(name)} type="{kind}"><parent link={parent}/>'
            f"<child link={child}/>{inside}</joint>"
        )

    def body(self) -> str:
        """Return the lines of all links and joints."""
        return "\n".join([*self.links.values(), *self.joints.values()])

    def robot(self, name: str) -> bytes:
        """Return the whole URDF."""
        head = f'<?xml version="1.0" encoding="utf-8"?>\n<robot name={_quoted(name)}>\n'
        return f"{head}{self.body()}\n</robot>\n".encode()


def origin(T_parent_origin: RigidTransform) -> str:
    """Return the ``<origin>`` of a rigid motion [m, rad]."""
    return place(np.asarray(T_parent_origin.translation), T_parent_origin.rotation.as_matrix())


def place(xyz: Array, rotation: Array) -> str:
    """Return the ``<origin>`` at a point [m] with a rotation matrix."""
    return f'<origin xyz="{_numbers(xyz)}" rpy="{_numbers(roll_pitch_yaw(rotation))}"/>'


def along(axis: Array) -> str:
    """Return the ``<axis>`` of a joint."""
    return f'<axis xyz="{_numbers(axis)}"/>'


def visual(at: str, radius: float, length: float) -> str:
    """Return the ``<visual>`` of a cylinder at an ``<origin>``."""
    shape = f'<cylinder radius="{radius!r}" length="{length!r}"/>'
    return f"<visual>{at}<geometry>{shape}</geometry></visual>"


def limit(limits: tuple[float, float] | None) -> str:
    """Return the ``<limit>`` of a joint; a URDF must name an effort and a velocity too."""
    ends = ""
    if limits is not None:
        lower, upper = (float(x) for x in limits)
        ends = f'lower="{lower!r}" upper="{upper!r}" '
    return f'<limit {ends}effort="1000" velocity="1"/>'


def _numbers(values: Array) -> str:
    """Return numbers so that they are read back exactly, rounding noise of zero as zero."""
    return " ".join(repr(float(x)) if abs(x) > 1e-15 else "0.0" for x in values)


def _quoted(text: str) -> str:
    """Return a text as the value of an attribute."""
    return f'"{escape(text)}"'
