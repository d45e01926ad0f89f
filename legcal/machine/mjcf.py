"""A mechanism in the MJCF of MuJoCo: bodies with joints, closed by equality constraints.

``<connect>`` gives a ``3d`` closure and ``<weld>`` a ``6d`` one; motors are the joints of actuators
and the slides of ``<jointpos>`` sensors. Elements for simulation only are ignored: cameras, lights,
inertias, plugins, adhesion, and geoms other than cylinders, capsules and meshes. An unknown element
of a body, constraint or geom type is refused, since it may be misspelt.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import numpy as np
from lxml import etree
from scipy.spatial.transform import RigidTransform, Rotation

from legcal.errors import ModelError, OutOfClass
from legcal.files.schema import closest
from legcal.geometry.lines import cross
from legcal.geometry.motions import rotation_between
from legcal.geometry.types import Array
from legcal.machine.chain import Closure
from legcal.machine.spanning_tree import (
    EYE,
    FULL_TURN,
    LinkFrame,
    Loop,
    Source,
    UrdfBuilder,
    close_loops,
    mesh_xml,
    moving_groups,
    origin_xml,
    parts_of,
    visual_xml,
)
from legcal.machine.urdf import (
    MJCF,
    Urdf,
    UrdfJointType,
    XmlProblems,
    number_list,
    parse_urdf,
    parse_xml,
)

WORLD = "world"
MAX_PARTS = 5000
ORIENTATIONS = {"quat": 4, "axisangle": 4, "xyaxes": 6, "zaxis": 3, "euler": 3}
_Z = (0.0, 0.0, 1.0)
_LEFT_ALONE = ("inertial", "camera", "light", "plugin", "site")
_GEOMS = ("plane", "hfield", "sphere", "capsule", "ellipsoid", "cylinder", "box", "mesh", "sdf")
_NOT_READ = ("include", "composite", "flexcomp", "attach", "replicate")
_COUPLINGS = ("joint", "tendon", "flex", "flexvert", "flexstrain")
_SHOWN_GROUPS = 2  # the last group of geoms that MuJoCo shows by default; others are collisions
_OTHER_DRIVES = ("tendon", "site", "refsite", "cranksite", "slidersite")

Attributes = Mapping[str, str]
Defaults = dict[str, dict[str, str]]  # attributes of each element


class BodyElement(NamedTuple):
    """An element of a body, with its body, the frame around it, and its default class."""

    element: etree._Element
    body: str
    T_body_frame: RigidTransform
    childclass: str


def read_mjcf_source(path: Path, content: bytes) -> Source:
    """Return the mechanism of an MJCF file."""
    root = parse_xml(path, content, "MJCF file")
    n_parts = sum(1 for _ in root.iter("body", "joint", "default", "frame"))
    if n_parts > MAX_PARTS:
        raise ModelError(
            "the MJCF file could not be used",
            f"{n_parts} bodies, joints, frames and default classes",
            f"at most {MAX_PARTS}",
            "give the mechanism alone",
            path,
        )
    reader = MjcfReader(root, XmlProblems(path))
    reader.read_bodies()
    loops = list(reader.loops())
    motors = reader.motors()
    reader.problems.raise_if_any()
    if not loops:
        raise OutOfClass(
            "this is not a parallel mechanism",
            "an MJCF file without <connect> or <weld> in <equality>, which is a tree "
            "without closed loops",
            "the closures of its loops",
            "add them",
            path,
        )
    closures = close_loops(loops, reader.tree, path)
    name = root.get("model", "").strip() or path.stem
    urdf = parse_urdf(path, reader.tree.robot(name), travel_needed=False)
    urdf, dropped = _without_loose_bodies(urdf, closures, reader.tree, name)
    notes = (f"Free bodies that touch no loop were left out: {', '.join(dropped)}.",)
    return Source(
        path,
        replace(urdf, wording=MJCF),
        closures,
        motors,
        notes=notes * bool(dropped),
        values={joint: x for joint, x in reader.references.items() if joint in urdf.joints},
    )


class MjcfReader:
    """One MJCF file: its elements with defaults applied, and the tree of its bodies.

    Problems are collected and raised together. The loops are closed in the configuration of the
    file, with all joints at their ``ref``.
    """

    def __init__(self, root: etree._Element, problems: XmlProblems) -> None:
        self.root, self.problems = root, problems
        self._names: set[str] = set()  # taken names of links and joints
        self.tree = UrdfBuilder(taken=self._names)
        self.poses: dict[str, RigidTransform] = {WORLD: EYE}  # pose of every body in the world
        self.references: dict[str, float] = {}  # values of joints in the file [rad] or [m]
        self._joints: dict[str, str] = {}  # type of every joint
        self.sites: dict[str, LinkFrame] = {}
        named = (*root.iterfind("actuator/*"), *root.iterfind("sensor/jointpos"))
        self._driven = frozenset(str(element.get("joint")) for element in named)
        self._defaults: dict[str, Defaults] = {"main": {}}
        for top in root.iterfind("default"):
            self._read_defaults(top, "main", {})
        self._degrees, self._eulerseq, self._autolimits = True, "xyz", True
        self._mesh_folder = ""
        self._meshes = {
            element.get("name") or Path(element.get("file", "")).stem: element
            for element in root.iterfind("asset/mesh")
        }
        for compiler in root.iterfind("compiler"):
            self._read_compiler(compiler)

    # Bodies

    def read_bodies(self) -> None:
        """Write all bodies as links and joints."""
        for element in self.root.iter(*_NOT_READ):
            self.problems.at(
                element, "is not expanded", "save the compiled model with MuJoCo and give that file"
            )
        for tags in (("body",), ("joint", "freejoint"), ("site",)):
            named = [e for top in self.root.findall("worldbody") for e in top.iter(*tags)]
            self.problems.check_unique(named)
            if tags != ("site",):
                self._names |= {str(e.get("name")) for e in named if e.get("name")}
        self.problems.check_unique(self.root.iterfind("equality/*"))
        self.problems.check_unique(self.root.iterfind(".//default/default"), "class")
        visuals = ""
        pending: list[BodyElement] = []
        for world in self.root.findall("worldbody"):
            part = BodyElement(world, WORLD, EYE, world.get("childclass", "main"))
            _, bodies, shown = self._contents(part)
            visuals += shown
            pending += bodies
        self.tree.link(WORLD, visuals)
        while pending:
            pending = self._body(pending.pop(0)) + pending

    def _contents(self, body: BodyElement) -> tuple[list[BodyElement], list[BodyElement], str]:
        """Return joints, bodies and visuals of a body and its frames; register its sites."""
        joints, bodies, visuals = list[BodyElement](), list[BodyElement](), ""
        pending = [body._replace(element=part) for part in body.element]
        while pending:
            part = pending.pop(0)
            element, tag = part.element, part.element.tag
            if tag == "frame":
                T = part.T_body_frame * self._pose(element, _attributes_of(element))
                inner = BodyElement(element, part.body, T, self._childclass(part))
                pending = [inner._replace(element=inside) for inside in element] + pending
            elif tag == "body":
                bodies.append(part)
            elif tag in ("joint", "freejoint"):
                joints.append(part)
            elif tag == "geom":
                visuals += self._visual(part)
            elif tag == "site" and element.get("name"):
                site, site_name = part.element, str(part.element.get("name"))
                attributes = self._attributes(part)
                T_site, length = self._between(site, attributes)
                if T_site is None or length == 0.0:
                    T_site = self._pose(site, attributes)
                self.sites[site_name] = part.body, part.T_body_frame * T_site
            elif isinstance(tag, str) and tag not in (*_LEFT_ALONE, *_NOT_READ):
                self.problems.at(element, "is no element of a body", "correct or remove it")
        return joints, bodies, visuals

    def _body(self, part: BodyElement) -> list[BodyElement]:
        """Write a body with its joints, and return its child bodies."""
        element = part.element
        name = element.get("name", "")
        if name == WORLD:
            self.problems.at(element, f"has the name '{WORLD}', which <worldbody> has", "rename it")
        if not name or name in self.poses:
            name = self._unused(f"body{len(self.poses)}")
        T_parent_body = part.T_body_frame * self._pose(element, _attributes_of(element))
        self.poses[name] = self.poses[part.body] * T_parent_body
        inside = BodyElement(element, name, EYE, self._childclass(part))
        joints, bodies, visuals = self._contents(inside)
        at, T_at_body = part.body, T_parent_body
        if at == WORLD and self._is_free(joints):
            self.tree.joint(
                self._unused(f"{name}_free"), "floating", (at, name), *parts_of(T_at_body)
            )
            at, joints = name, []
        for i, joint in enumerate(joints):
            only, last = len(joints) == 1, i + 1 == len(joints)
            at, T_at_body = self._joint(joint, at, T_at_body, last=last, only=only)
        if at != name:
            self.tree.joint(
                self._unused(f"{name}_fixed"), "fixed", (at, name), *parts_of(T_at_body)
            )
        self.tree.link(name, visuals)
        return bodies

    def _is_free(self, joints: list[BodyElement]) -> bool:
        """Return whether the joints of a body are passive and leave it all six freedoms."""
        axes: dict[str, list[Array]] = {"slide": [], "hinge": [], "ball": []}
        for part in joints:
            attributes = self._attributes(part)
            kind = attributes.get("type", "hinge")
            axis = number_list(attributes.get("axis", "0 0 1"), 3)
            driven = attributes.get("name") in self._driven
            if part.element.tag != "joint" or kind not in axes or axis is None or driven:
                return False
            axes[kind].append(np.array(axis))
        turns_freely = len(axes["ball"]) == 1 if axes["ball"] else _span_space(axes["hinge"])
        return _span_space(axes["slide"]) and turns_freely and len(axes["hinge"]) in (0, 3)

    def _joint(
        self, part: BodyElement, at: str, T_at_body: RigidTransform, *, last: bool, only: bool
    ) -> LinkFrame:
        """Write one joint of a body; return the link after it and the body frame in that link."""
        element, attributes = part.element, self._attributes(part)
        kind = "free" if element.tag == "freejoint" else attributes.get("type", "hinge")
        name = attributes.get("name", "")
        if not name or name in self._joints:
            name = self._unused(f"{part.body}_{kind}")
        self._joints[name] = kind
        if kind == "free":
            if not only or at != WORLD:
                self.problems.at(
                    element,
                    "frees a body that has other joints or is not on the world itself",
                    "a free joint stands alone in a body of <worldbody>",
                )
            self.tree.joint(name, "floating", (at, part.body), *parts_of(T_at_body))
            return part.body, EYE
        if kind not in ("hinge", "slide", "ball"):
            self.problems.at(
                element, f"has the type '{kind}', needed free, ball, slide or hinge", "correct it"
            )
            return at, T_at_body
        pos = self._numbers(element, attributes, "pos", (3,))
        pos = np.zeros(3) if pos is None or kind == "slide" else pos
        T_body_joint = RigidTransform.from_translation(part.T_body_frame.apply(pos))
        centred = not np.asarray(T_body_joint.translation).any()
        child = part.body if last and centred else self._unused(f"{name}_link")
        if kind == "ball":
            axes = dict(zip("xyz", np.eye(3), strict=True))
            self.tree.turns(name, at, child, T_at_body * T_body_joint, axes)
        else:
            self._one_axis(part, attributes, name, kind, (at, child), T_at_body * T_body_joint)
        if child != part.body:
            self.tree.link(child)
        return child, EYE if child == part.body else T_body_joint.inv()

    def _one_axis(
        self,
        part: BodyElement,
        attributes: Attributes,
        name: str,
        kind: str,
        links: tuple[str, str],
        T_at_joint: RigidTransform,
    ) -> None:
        """Write a hinge or a slide, with its zero at the value in the file."""
        element = part.element
        given = self._numbers(element, attributes, "axis", (3,))
        axis = np.array(_Z) if given is None else given
        if not np.linalg.norm(axis) > 1e-9:
            self.problems.at(element, "has a zero axis, needed a direction", "correct its axis")
            axis = np.array(_Z)
        axis = part.T_body_frame.rotation.apply(axis / np.linalg.norm(axis))
        ref = self._numbers(element, attributes, "ref", (1,))
        zero = 0.0 if ref is None else float(ref[0])
        limits = self._range(element, attributes)
        if kind == "slide":
            to_zero = RigidTransform.from_translation(-zero * axis)
        else:
            zero = self._radians(zero)
            to_zero = RigidTransform.from_rotation(Rotation.from_rotvec(-zero * axis))
            ends = (-FULL_TURN, FULL_TURN)
            if limits is not None:
                ends = self._radians(limits[0]), self._radians(limits[1])
            limits = ends
        self.references[name] = zero
        origin = parts_of(T_at_joint * to_zero)
        urdf_type: UrdfJointType = "prismatic" if kind == "slide" else "revolute"
        self.tree.joint(name, urdf_type, links, *origin, axis, limits)

    def _range(self, element: etree._Element, attributes: Attributes) -> tuple[float, float] | None:
        """Return the limits of a joint, or None."""
        numbers = self._numbers(element, attributes, "range", (2,))
        limited = attributes.get("limited", "auto")
        if numbers is None or limited == "false" or not numbers.any():
            return None
        if limited == "auto" and not self._autolimits:
            return None
        lower, upper = float(numbers[0]), float(numbers[1])
        if not lower < upper:
            self.problems.at(
                element, f"has the range {lower:g} to {upper:g}", "give the lower end first"
            )
            return None
        return lower, upper

    def _visual(self, part: BodyElement) -> str:
        """Return the ``<visual>`` of a geom of type cylinder, capsule or mesh, else nothing."""
        element, attributes = part.element, self._attributes(part)
        kind = attributes.get("type", "sphere")
        if kind not in _GEOMS:
            self.problems.at(
                element, f"has the type '{kind}', needed one of {', '.join(_GEOMS)}", "correct it"
            )
        if kind == "mesh":
            return self._mesh(part, attributes)
        if kind not in ("cylinder", "capsule") or "mesh" in attributes:
            return ""
        size = self._numbers(element, attributes, "size", (1, 2, 3))
        T, length = self._between(element, attributes)
        if T is None:
            T = self._pose(element, attributes)
            length = 2.0 * float(size[1]) if size is not None and len(size) > 1 else 0.0
        if size is None or not (size[0] > 0.0 and length > 0.0):
            self.problems.at(
                element,
                "is a cylinder without a radius and a length above zero",
                "write size, or fromto and size",
            )
            return ""
        return visual_xml(origin_xml(*parts_of(part.T_body_frame * T)), float(size[0]), length)

    def _mesh(self, part: BodyElement, attributes: Attributes) -> str:
        """Return the ``<visual>`` of a mesh that MuJoCo shows (groups 0 to 2), else nothing."""
        asset = self._meshes.get(attributes.get("mesh", ""))
        group = number_list(attributes.get("group", "0"), 1)
        if asset is None or group is None or group[0] > _SHOWN_GROUPS:
            return ""
        element, stated = asset, self._attributes(BodyElement(asset, WORLD, EYE, "main"))
        scale = self._numbers(element, stated, "scale", (3,))
        position = self._numbers(element, stated, "refpos", (3,))
        turn = self._numbers(element, stated, "refquat", (4,))
        T_file_mesh = RigidTransform.from_components(
            np.zeros(3) if position is None else position,
            Rotation.identity() if turn is None else Rotation.from_quat(np.roll(turn, -1)),
        )
        T = part.T_body_frame * self._pose(part.element, attributes) * T_file_mesh.inv()
        file = str(Path(self._mesh_folder) / stated.get("file", ""))
        return mesh_xml(origin_xml(*parts_of(T)), file, np.ones(3) if scale is None else scale)

    def _between(
        self, element: etree._Element, attributes: Attributes
    ) -> tuple[RigidTransform | None, float]:
        """Return the frame between the two points of ``fromto``, z along them, and their gap."""
        ends = self._numbers(element, attributes, "fromto", (6,))
        if ends is None:
            return None, 0.0
        along: Array = ends[3:] - ends[:3]
        turn = _z_onto(along) if along.any() else Rotation.identity()
        middle = 0.5 * (ends[3:] + ends[:3])
        return RigidTransform.from_components(middle, turn), float(np.linalg.norm(along))

    def _unused(self, name: str) -> str:
        """Return an unused name, and take it."""
        unused = self.tree.unused(name)
        self._names.add(unused)
        return unused

    # Closures and motors

    def loops(self) -> Iterator[Loop]:
        """Yield the loops of all ``<equality>`` elements."""
        for i, element in enumerate(self.root.iterfind("equality/*"), start=1):
            name_of_class = element.get("class", "main")
            default = self._default(element, name_of_class).get("equality", {})
            attributes = {**default, **_attributes_of(element)}
            if attributes.get("active", "true") == "false":
                continue
            if element.tag not in ("connect", "weld"):
                reason = "is no constraint that legcal knows"
                if element.tag in _COUPLINGS:
                    reason = f"couples <{element.tag}> coordinates, which is not followed"
                remedy = "close loops with <connect> and <weld> alone"
                self.problems.at(element, reason, remedy)
                continue
            name = str(attributes.get("name") or f"{element.tag}{i}")
            n_before = len(self.problems)
            by_site = "site1" in attributes or "site2" in attributes
            ends = self._joined_sites(element) if by_site else self._joined_bodies(element)
            if ends is None or len(self.problems) > n_before:
                continue
            if ends[0][0] == ends[1][0]:
                found = f"joins the body '{ends[0][0]}' to itself"
                self.problems.at(element, found, "name two bodies")
                continue
            scale = self._numbers(element, attributes, "torquescale", (1,))
            is_point = element.tag == "connect" or (scale is not None and scale[0] == 0.0)
            yield Loop(name, "3d" if is_point else "6d", ends)

    def _joined_sites(self, element: etree._Element) -> tuple[LinkFrame, LinkFrame] | None:
        sites = []
        for key in ("site1", "site2"):
            name = element.get(key, "")
            if name in self.sites:
                sites.append(self.sites[name])
            else:
                self._unknown(element, f"the site '{name}' as {key}", name, self.sites)
        return (sites[0], sites[1]) if len(sites) == 2 else None

    def _joined_bodies(self, element: etree._Element) -> tuple[LinkFrame, LinkFrame] | None:
        """Return the frames on the two bodies of a constraint."""
        names = [element.get("body1", ""), element.get("body2", WORLD)]
        for key, name in zip(("body1", "body2"), names, strict=True):
            if not name:
                self.problems.at(element, f"has no {key}", "name the body that it holds")
            elif name not in self.poses:
                self._unknown(element, f"the body '{name}' as {key}", name, self.poses)
        attributes = _attributes_of(element)
        anchor = self._numbers(element, attributes, "anchor", (3,))
        if element.tag == "connect" and "anchor" not in attributes:
            self.problems.at(element, "has no anchor", "write the point in the frame of body1")
        if any(name not in self.poses for name in names):
            return None
        T_body1_body2 = self.poses[names[0]].inv() * self.poses[names[1]]
        at = np.zeros(3) if anchor is None else anchor
        if element.tag == "connect":  # the anchor is in body1
            T_body1 = RigidTransform.from_translation(at)
            T_body2 = RigidTransform.from_translation(T_body1_body2.inv().apply(at))
            return (names[0], T_body1), (names[1], T_body2)
        relpose = self._numbers(element, attributes, "relpose", (7,))
        T_body2 = RigidTransform.from_translation(at)  # the anchor of a weld is in body2
        if relpose is not None and relpose[3:].any():  # MuJoCo moves the anchor to this point
            rotation = Rotation.from_quat(np.roll(relpose[3:], -1))
            T_body1 = RigidTransform.from_components(relpose[:3], rotation)
        else:  # as in the configuration of the file
            T_body1 = T_body1_body2 * T_body2
        return (names[0], T_body1), (names[1], T_body2)

    def motors(self) -> tuple[str, ...]:
        """Return the joints with an encoder: driven joints, and measured slides."""
        motors: dict[str, None] = {}
        named = (*self.root.iterfind("actuator/*"), *self.root.iterfind("sensor/jointpos"))
        for element in named:
            other = [key for key in _OTHER_DRIVES if element.get(key) is not None]
            name = element.get("joint", element.get("jointinparent"))
            if other and element.tag != "jointpos":
                self.problems.at(
                    element,
                    f"drives by {other[0]}, which is no joint with a reading",
                    "drive the slide of each leg itself",
                )
            drives_no_joint = element.tag == "plugin" or element.get("body") is not None  # suction
            if name is None and not other and not drives_no_joint:
                self.problems.at(
                    element, "names no joint", "name the slide that it drives or measures as joint"
                )
            if name is None:
                continue
            kind = self._joints.get(name)
            if kind is None:
                self._unknown(element, f"the joint '{name}'", name, self._joints)
            elif kind in ("ball", "free"):
                self.problems.at(
                    element,
                    f"drives or measures the {kind} joint '{name}', which has no one reading",
                    "remove it",
                )
            elif kind == "slide" or element.tag != "jointpos":
                motors[name] = None
        return tuple(motors)

    def _unknown(
        self, element: etree._Element, reference: str, name: str, candidates: Mapping[str, object]
    ) -> None:
        remedy = closest(name, candidates).rstrip(".")
        self.problems.at(element, f"names {reference}, which is not in the file", remedy)

    # Attributes, with defaults and compiler options

    def _attributes(self, part: BodyElement) -> dict[str, str]:
        """Return the attributes of an element, on top of its default class."""
        stated = _attributes_of(part.element)
        classes = self._default(part.element, stated.get("class", part.childclass))
        default = classes.get(str(part.element.tag), {})
        if not ORIENTATIONS.keys().isdisjoint(stated):
            default = {k: v for k, v in default.items() if k not in ORIENTATIONS}
        return {**default, **stated}

    def _default(self, element: etree._Element, name: str) -> Defaults:
        """Return a default class; the main class, and a problem, if it does not exist."""
        if name not in self._defaults:
            self.problems.at(
                element,
                f"names the default class '{name}', which is not in the file",
                "correct the name",
            )
            name = "main"
        return self._defaults[name]

    def _childclass(self, part: BodyElement) -> str:
        """Return the default class inside a body or frame."""
        name = part.element.get("childclass", part.childclass)
        is_defined = self._default(part.element, name) is self._defaults.get(name)
        return name if is_defined else part.childclass

    def _numbers(
        self, element: etree._Element, attributes: Attributes, key: str, counts: tuple[int, ...]
    ) -> Array | None:
        """Return the numbers of an attribute; None if missing or wrong."""
        text = attributes.get(key)
        if text is None:
            return None
        numbers = number_list(text, len(text.split()))
        if numbers is None or len(numbers) not in counts:
            wanted = " or ".join(map(str, counts))
            self.problems.at(
                element,
                f"has {key}={text[:60]!r}, needed {wanted} finite number{'s' * (wanted != '1')}",
                "correct the value",
            )
            return None
        return np.array(numbers)

    def _pose(self, element: etree._Element, attributes: Attributes) -> RigidTransform:
        """Return the motion of ``pos`` and an orientation."""
        pos = self._numbers(element, attributes, "pos", (3,))
        turn = self._orientation(element, attributes)
        return RigidTransform.from_components(np.zeros(3) if pos is None else pos, turn)

    def _orientation(self, element: etree._Element, attributes: Attributes) -> Rotation:
        """Return the rotation of ``quat``, ``axisangle``, ``xyaxes``, ``zaxis`` or ``euler``."""
        written = [key for key in ORIENTATIONS if key in attributes]
        if len(written) > 1:
            self.problems.at(
                element, f"has {' and '.join(written)}, needed one orientation", "keep one"
            )
        if len(written) != 1:
            return Rotation.identity()
        key = written[0]
        numbers = self._numbers(element, attributes, key, (ORIENTATIONS[key],))
        rotation = None if numbers is None else self._rotation(key, numbers)
        if numbers is not None and rotation is None:
            self.problems.at(
                element,
                f"has {key}={attributes[key]!r}, which gives no orientation",
                "correct the value",
            )
        return Rotation.identity() if rotation is None else rotation

    def _rotation(self, key: str, numbers: Array) -> Rotation | None:
        """Return the rotation of an orientation attribute, None if it is degenerate."""
        if key == "euler":  # about moved axes for small letters, fixed axes for capitals
            rotation = Rotation.identity()
            for letter, angle in zip(self._eulerseq, numbers, strict=True):
                turn = Rotation.from_euler(letter.lower(), self._radians(float(angle)))
                rotation = rotation * turn if letter.islower() else turn * rotation
            return rotation
        if key == "xyaxes":
            x, y = numbers[:3], numbers[3:]
            z = cross(x, y)
            if not np.linalg.norm(z) > 1e-9 * np.linalg.norm(x) * np.linalg.norm(y):
                return None
            x, z = x / np.linalg.norm(x), z / np.linalg.norm(z)
            return Rotation.from_matrix(np.column_stack([x, cross(z, x), z]))
        if not numbers[: 3 if key == "axisangle" else None].any():
            return None
        if key == "axisangle":
            axis = numbers[:3] / np.linalg.norm(numbers[:3])
            return Rotation.from_rotvec(self._radians(float(numbers[3])) * axis)
        return Rotation.from_quat(np.roll(numbers, -1)) if key == "quat" else _z_onto(numbers)

    def _radians(self, angle: float) -> float:
        """Return an angle of the file in radians."""
        return float(np.deg2rad(angle)) if self._degrees else angle

    def _read_defaults(self, element: etree._Element, name: str, inherited: Defaults) -> None:
        """Read a default class and those within it."""
        here = {tag: dict(values) for tag, values in inherited.items()}
        for part in element:
            if part.tag != "default":
                values, attributes = here.setdefault(str(part.tag), {}), _attributes_of(part)
                if not ORIENTATIONS.keys().isdisjoint(attributes):
                    for key in ORIENTATIONS:
                        values.pop(key, None)
                values.update(attributes)
        if name == "main":
            here = {**self._defaults["main"], **here}
            name = element.get("class", "main")
            self._defaults["main"] = here
        self._defaults[name] = here
        for part in element.iterfind("default"):
            inner = part.get("class", "")
            if not inner:
                self.problems.at(part, "is a default class without a name", "name it")
            elif inner not in self._defaults:
                self._read_defaults(part, inner, here)

    def _read_compiler(self, element: etree._Element) -> None:
        """Read the ``<compiler>`` options that affect kinematics; later ones win."""
        for key, allowed in (
            ("angle", ("degree", "radian")),
            ("coordinate", ("local",)),
            ("autolimits", ("true", "false")),
        ):
            value = element.get(key)
            if value is not None and value not in allowed:
                self.problems.at(
                    element,
                    f"has {key}='{value}', needed {' or '.join(allowed)}",
                    "convert the model with MuJoCo first",
                )
        sequence = element.get("eulerseq", self._eulerseq)
        if len(sequence) != 3 or not set(sequence.lower()) <= set("xyz"):
            self.problems.at(
                element,
                f"has eulerseq='{sequence}', needed three letters of x, y, z",
                "correct the value",
            )
            sequence = self._eulerseq
        self._eulerseq = sequence
        if element.get("angle") is not None:
            self._degrees = element.get("angle") != "radian"
        self._mesh_folder = element.get("meshdir", element.get("assetdir", self._mesh_folder))
        if element.get("autolimits") is not None:
            self._autolimits = element.get("autolimits") != "false"


def _attributes_of(element: etree._Element) -> dict[str, str]:
    return {str(key): str(value) for key, value in element.attrib.items()}


def _span_space(axes: list[Array]) -> bool:
    """Return whether there are three linearly independent axes."""
    return len(axes) == 3 and int(np.linalg.matrix_rank(np.array(axes), tol=1e-3)) == 3


def _without_loose_bodies(
    urdf: Urdf, closures: Sequence[Closure], tree: UrdfBuilder, name: str
) -> tuple[Urdf, list[str]]:
    """Return the tree without free bodies outside all closures, and the names of these."""
    moved = {j.child for j in urdf.joints.values() if j.moves and j.type != "floating"}
    loose = {
        link
        for links, closed in moving_groups(urdf, closures)
        if not closed and moved.isdisjoint(links)
        for link in links
    }
    if not loose:
        return urdf, []
    joints = [j for j in urdf.joints.values() if j.child in loose]
    for joint in joints:
        del tree.joints[joint.name]
    for link in loose:
        del tree.links[link]
    freed = [f"'{j.child}'" for j in joints if j.type == "floating"]
    return parse_urdf(urdf.path, tree.robot(name), travel_needed=False), freed


def _z_onto(direction: Array) -> Rotation:
    """Return the shortest rotation of z onto a direction of any length."""
    return rotation_between(np.array([0.0, 0.0, 1.0]), direction / np.linalg.norm(direction))
