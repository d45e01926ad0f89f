"""A URDF file, read as a tree of links and joints and checked where other readers are silent.

Pinocchio says nothing of a link with two parents, an unknown name, a zero axis, NaN, ``mimic``
or ``<loop_joint>``: all of these are refused here, all problems of a file at once.
"""

from dataclasses import dataclass
from pathlib import Path
from typing import Literal, cast

import numpy as np
from lxml import etree
from scipy.spatial.transform import RigidTransform, Rotation

from legcal.geometry.frames import motion_of
from legcal.geometry.types import Array
from legcal.mechanism.files import read_file
from legcal.mechanism.robot_xml import parse_robot
from legcal.mechanism.urdf_checks import Problems, check_numbers, check_tree, number_list

JointType = Literal["fixed", "revolute", "continuous", "prismatic", "floating", "planar"]
JOINT_TYPES = ("fixed", "revolute", "continuous", "prismatic", "floating", "planar")
LOOP_TAGS = ("loop_joint", "constraint")


@dataclass(frozen=True, eq=False)
class UrdfJoint:
    """One joint of a URDF.

    Attributes
    ----------
    name, type, parent, child : str
        As in the file; ``parent`` and ``child`` are links.
    T_parent_origin : RigidTransform
        The joint frame in the parent link, at joint value zero [m].
    axis : (3,) array
        Unit axis in the joint frame.
    limits : tuple of float or None
        Lower and upper limit [rad] or [m].
    line : int
        The line of the file.
    """

    name: str
    type: JointType
    parent: str
    child: str
    T_parent_origin: RigidTransform
    axis: Array
    limits: tuple[float, float] | None
    line: int

    @property
    def moves(self) -> bool:
        """Whether the joint is not fixed."""
        return self.type != "fixed"


@dataclass(frozen=True, eq=False)
class Urdf:
    """A URDF whose tree, names and numbers have been checked.

    Attributes
    ----------
    path : Path
        The file.
    content : bytes
        The file as it stands on disk, or the URDF that was made of another format.
    name : str
        The robot's name.
    links : tuple of str
        Link names in the order of the file.
    joints : dict of str to UrdfJoint
        Joints by name in the order of the file.
    root : str
        The link without a parent.
    has_cylinders : bool
        Whether any visual is a cylinder.
    """

    path: Path
    content: bytes
    name: str
    links: tuple[str, ...]
    joints: dict[str, UrdfJoint]
    root: str
    has_cylinders: bool

    @property
    def text(self) -> str:
        """The XML as text."""
        return self.content.decode("utf-8-sig")


def read_urdf(path: Path, *, travel_needed: bool = True) -> Urdf:
    """Return the tree of a URDF file.

    Parameters
    ----------
    path : Path
        The file.
    travel_needed : bool
        Whether a prismatic joint without limits is refused; else its limits are None.

    Raises
    ------
    ModelError
        If the file is missing or not XML, has a document type or entities, or if its links,
        joints or numbers do not describe one tree; one sentence a problem, with line numbers.
    """
    return parse_urdf(path, read_file(path, "URDF"), travel_needed=travel_needed)


def parse_urdf(path: Path, content: bytes, *, travel_needed: bool = True) -> Urdf:
    """Return the tree of a URDF that was read before.

    Parameters
    ----------
    path : Path
        The file, for messages.
    content : bytes
        What it holds.
    travel_needed : bool
        Whether a prismatic joint without limits is refused; else its limits are None.

    Raises
    ------
    ModelError
        As :func:`read_urdf`, of whose tests this has all but those of the file itself.
    """
    robot = parse_robot(path, content)
    problems = Problems(path)
    for element in robot:
        if element.tag in LOOP_TAGS:
            problems.add(
                element,
                f"closes a loop with <{element.tag}>, which is not read beside a mechanism YAML",
                "write the pair of frames in closed_loop of the mechanism YAML",
            )
    return checked_tree(robot, path, content, problems, travel_needed=travel_needed)


def checked_tree(
    robot: etree._Element,
    path: Path,
    content: bytes,
    problems: Problems,
    *,
    travel_needed: bool = True,
) -> Urdf:
    """Return the tree of a ``<robot>``, whatever else it holds; see :func:`parse_urdf`."""
    links = [e for e in robot if e.tag == "link"]
    joints = [e for e in robot if e.tag == "joint"]
    for element in (*links, *joints):
        check_numbers(element, problems)
    root = check_tree(links, joints, problems)
    found = {j.name: j for e in joints if (j := _joint(e, problems, travel_needed)) is not None}
    problems.raise_if_any()
    return Urdf(
        path=path,
        content=content,
        name=robot.get("name", path.stem),
        links=tuple(str(e.get("name")) for e in links),
        joints=found,
        root=root,
        has_cylinders=any(e.find("visual/geometry/cylinder") is not None for e in links),
    )


def _joint(element: etree._Element, problems: Problems, travel_needed: bool) -> UrdfJoint | None:
    """Return a joint, or None with its problems noted."""
    n_before = len(problems)
    for tag in ("parent", "child", "origin", "axis", "limit"):
        if len(element.findall(tag)) > 1:
            problems.add(element, f"has more than one <{tag}>", "keep one")
    kind = element.get("type", "")
    if kind not in JOINT_TYPES:
        problems.add(
            element,
            f"has the type '{kind}', needed one of {', '.join(JOINT_TYPES)}",
            "write a spherical or universal joint as revolutes, or cut the loop there ('3d')",
        )
    if element.find("mimic") is not None:
        problems.add(
            element, "has <mimic>, which is not followed", "close the loop in the mechanism YAML"
        )
    axis = _axis(element, kind, problems)
    limits = _limits(element, kind, problems, travel_needed)
    if len(problems) > n_before:
        return None
    origin = element.find("origin")
    xyz = _vector(origin, "xyz", (0.0, 0.0, 0.0))
    rpy = _vector(origin, "rpy", (0.0, 0.0, 0.0))
    ends = [element.find(tag) for tag in ("parent", "child")]
    parent, child = ("" if end is None else end.get("link", "") for end in ends)
    return UrdfJoint(
        name=element.get("name", ""),
        type=cast("JointType", kind),
        parent=parent,
        child=child,
        T_parent_origin=motion_of(Rotation.from_euler("xyz", rpy).as_matrix(), xyz),
        axis=axis,
        limits=limits,
        line=cast("int", element.sourceline),
    )


def _vector(
    element: etree._Element | None, attribute: str, default: tuple[float, float, float]
) -> Array:
    """Return three numbers of an attribute, or the default where they are missing or wrong."""
    text = None if element is None else element.get(attribute)
    found = None if text is None else number_list(text, 3)
    return np.array(default if found is None else found)


def _axis(element: etree._Element, kind: str, problems: Problems) -> Array:
    """Return the unit axis; the URDF default is x."""
    axis = _vector(element.find("axis"), "xyz", (1.0, 0.0, 0.0))
    norm = float(np.linalg.norm(axis))
    if kind in ("revolute", "continuous", "prismatic", "planar") and norm < 1e-9:
        problems.add(element, "has a zero axis, needed a direction", "correct <axis xyz>")
        return axis
    if kind == "prismatic" and abs(norm - 1.0) > 1e-3:
        problems.add(
            element,
            f"has an axis of length {norm:.6g}, which leaves open how far one unit of the reading "
            "moves it, needed length 1",
            "normalise <axis xyz>",
        )
    return axis / max(norm, 1e-9)


def _limits(
    element: etree._Element, kind: str, problems: Problems, travel_needed: bool
) -> tuple[float, float] | None:
    """Return the limits of a revolute or prismatic joint."""
    if kind not in ("revolute", "prismatic"):
        return None
    limit = element.find("limit")
    bounds_written = limit is not None and not {"lower", "upper"}.isdisjoint(limit.keys())
    if kind == "prismatic" and not travel_needed and not bounds_written:
        return None
    needed = ("lower", "upper", "effort", "velocity") if kind == "prismatic" else (
        "effort", "velocity")  # fmt: skip
    missing = [key for key in needed if limit is None or limit.get(key) is None]
    if missing or limit is None:
        problems.add(
            element,
            f"lacks {', '.join(missing)} in its <limit>",
            "give the travel of the joint" if kind == "prismatic" else "give its limits",
        )
        return None
    bounds = [number_list(limit.get(key, "0"), 1) for key in ("lower", "upper")]
    if bounds[0] is None or bounds[1] is None:
        return None
    lower, upper = bounds[0][0], bounds[1][0]
    if lower > upper or (kind == "prismatic" and lower == upper):
        problems.add(element, f"has the limits {lower:g} to {upper:g}", "give the lower one first")
    return lower, upper
