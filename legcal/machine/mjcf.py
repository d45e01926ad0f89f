"""A mechanism as MuJoCo's MJCF writes it: bodies with joints, closed by equality constraints.

``<connect>`` makes a ``3d`` closure and ``<weld>`` a ``6d`` one; actuators and ``<jointpos>``
sensors on slides tell the motors. What only a simulation needs is left alone: cameras, lights,
inertias, plugins, adhesion, and geoms other than cylinders and capsules. An element of a body, a
constraint or a geom type that MJCF does not have is refused, since it may be a misspelt one.
"""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from lxml import etree
from scipy.spatial.transform import RigidTransform, Rotation

from legcal.errors import ModelError, OutOfClass
from legcal.files import closest
from legcal.geometry import Array, rotation_between
from legcal.machine.schema import MechanismFile
from legcal.machine.spanning_tree import (
    DRAWING,
    EYE,
    FULL_TURN,
    Loop,
    LoopKind,
    Source,
    TextCylinder,
    UrdfBuilder,
    close_loop,
    moving_groups,
)
from legcal.machine.urdf import Problems, Urdf, number_list, parse_urdf, parse_xml

ORIENTATIONS = {"quat": 4, "axisangle": 4, "xyaxes": 6, "zaxis": 3, "euler": 3}
Attributes = Mapping[str, str]


@dataclass(frozen=True)
class Compiler:
    """The options of ``<compiler>`` that matter for kinematics."""

    degrees: bool = True  # whether angles are in degrees, as they are by default
    eulerseq: str = "xyz"  # three letters
    autolimits: bool = True  # whether a range alone limits a joint

    def radians(self, angle: float) -> float:
        """Return an angle of the file in radians."""
        return float(np.deg2rad(angle)) if self.degrees else angle


def own_attributes(element: etree._Element) -> dict[str, str]:
    """Return the attributes that an element has itself."""
    return {str(key): str(value) for key, value in element.attrib.items()}


class Values:
    """What the elements of one MJCF file say, after defaults, with problems noted."""

    def __init__(self, root: etree._Element, problems: Problems) -> None:
        self.problems = problems
        self._defaults: dict[str, dict[str, dict[str, str]]] = {"main": {}}
        for top in root.iterfind("default"):
            self._read_defaults(top, "main", {})
        self.compiler = self._compiler(root)

    def attributes(self, element: etree._Element, childclass: str) -> dict[str, str]:
        """Return the attributes of an element over those of its default class."""
        own = own_attributes(element)
        name = own.get("class", childclass)
        if name not in self._defaults:
            self.problems.add(
                element, f"names the default class '{name}', which is not in the file",
                "correct the name",
            )  # fmt: skip
            name = "main"
        default = dict(self._defaults[name].get(str(element.tag), {}))
        if not ORIENTATIONS.keys().isdisjoint(own):
            default = {k: v for k, v in default.items() if k not in ORIENTATIONS}
        return {**default, **own}

    def has_class(self, name: str) -> bool:
        """Say whether there is a default class of that name."""
        return name in self._defaults

    def numbers(
        self, element: etree._Element, attributes: Attributes, key: str, counts: tuple[int, ...]
    ) -> Array | None:
        """Return the numbers of an attribute; None where it is missing or wrong."""
        text = attributes.get(key)
        if text is None:
            return None
        found = number_list(text, len(text.split()))
        if found is None or len(found) not in counts:
            wanted = " or ".join(map(str, counts))
            self.problems.add(
                element,
                f"has {key}={text[:60]!r}, needed {wanted} finite number{'s' * (wanted != '1')}",
                "correct the value",
            )
            return None
        return np.array(found)

    def pose(self, element: etree._Element, attributes: Attributes) -> RigidTransform:
        """Return the motion of ``pos`` and an orientation."""
        pos = self.numbers(element, attributes, "pos", (3,))
        return RigidTransform.from_components(
            np.zeros(3) if pos is None else pos, self.orientation(element, attributes)
        )

    def orientation(self, element: etree._Element, attributes: Attributes) -> Rotation:
        """Return the rotation of ``quat``, ``axisangle``, ``xyaxes``, ``zaxis`` or ``euler``."""
        written = [key for key in ORIENTATIONS if key in attributes]
        if len(written) > 1:
            self.problems.add(
                element, f"has {' and '.join(written)}, needed one orientation", "keep one"
            )
        if len(written) != 1:
            return Rotation.identity()
        key = written[0]
        numbers = self.numbers(element, attributes, key, (ORIENTATIONS[key],))
        if numbers is None:
            return Rotation.identity()
        rotation = self._rotation(key, numbers)
        if rotation is None:
            self.problems.add(
                element, f"has {key}={attributes[key]!r}, which gives no orientation",
                "correct the value",
            )  # fmt: skip
            return Rotation.identity()
        return rotation

    def _rotation(self, key: str, numbers: Array) -> Rotation | None:
        """Return the rotation of one way to write it, or None where it means none."""
        if key == "euler":
            angles = np.array([self.compiler.radians(float(angle)) for angle in numbers])
            return euler(self.compiler.eulerseq, angles)
        if key == "quat":
            return None if not numbers.any() else Rotation.from_quat(np.roll(numbers, -1))
        if key == "axisangle":
            if not numbers[:3].any():
                return None
            axis = numbers[:3] / np.linalg.norm(numbers[:3])
            return Rotation.from_rotvec(self.compiler.radians(float(numbers[3])) * axis)
        if key == "zaxis":
            return None if not numbers.any() else _z_onto(numbers)
        x, y = numbers[:3], numbers[3:]
        z = np.cross(x, y)
        if not np.linalg.norm(z) > 1e-9 * np.linalg.norm(x) * np.linalg.norm(y):
            return None
        x, z = x / np.linalg.norm(x), z / np.linalg.norm(z)
        return Rotation.from_matrix(np.column_stack([x, np.cross(z, x), z]))

    def _read_defaults(
        self, element: etree._Element, name: str, inherited: dict[str, dict[str, str]]
    ) -> None:
        """Read a default class and those within it."""
        here = {tag: dict(values) for tag, values in inherited.items()}
        for part in element:
            if part.tag != "default":
                values = here.setdefault(str(part.tag), {})
                if not ORIENTATIONS.keys().isdisjoint(own_attributes(part)):
                    for key in ORIENTATIONS:
                        values.pop(key, None)
                values.update(own_attributes(part))
        if name == "main":
            here = {**self._defaults["main"], **here}
            name = element.get("class", "main")
            self._defaults["main"] = here
        self._defaults[name] = here
        for part in element.iterfind("default"):
            inner = part.get("class", "")
            if not inner:
                self.problems.add(part, "is a default class without a name", "name it")
            elif inner in self._defaults:
                self.problems.add(
                    part, f"is the default class '{inner}' again", "give each its own name"
                )
            else:
                self._read_defaults(part, inner, here)

    def _compiler(self, root: etree._Element) -> Compiler:
        """Return the options of all ``<compiler>`` elements; later ones win."""
        found = Compiler()
        for element in root.iterfind("compiler"):
            for key, allowed in (
                ("angle", ("degree", "radian")),
                ("coordinate", ("local",)),
                ("autolimits", ("true", "false")),
            ):
                value = element.get(key)
                if value is not None and value not in allowed:
                    self.problems.add(
                        element, f"has {key}='{value}', needed {' or '.join(allowed)}",
                        "convert the model with MuJoCo first",
                    )  # fmt: skip
            sequence = element.get("eulerseq", found.eulerseq)
            if len(sequence) != 3 or not set(sequence.lower()) <= set("xyz"):
                self.problems.add(
                    element, f"has eulerseq='{sequence}', needed three letters of x, y, z",
                    "correct the value",
                )  # fmt: skip
                sequence = found.eulerseq
            found = Compiler(
                element.get("angle", "degree" if found.degrees else "radian") != "radian",
                sequence,
                element.get("autolimits", str(found.autolimits).lower()) != "false",
            )
        return found


def euler(sequence: str, angles: Array) -> Rotation:
    """Return rotations in turn: about the moved axis for small letters, the fixed for capitals."""
    rotation = Rotation.identity()
    for letter, angle in zip(sequence, angles, strict=True):
        turn = Rotation.from_euler(letter.lower(), float(angle))
        rotation = rotation * turn if letter.islower() else turn * rotation
    return rotation


WORLD = "world"


@dataclass
class MjcfTree:
    """What is found while the bodies are walked."""

    values: Values
    text: UrdfBuilder = field(default_factory=UrdfBuilder)  # the URDF
    poses: dict[str, RigidTransform] = field(default_factory=dict)
    sites: dict[str, tuple[str, RigidTransform]] = field(default_factory=dict)
    joints: dict[str, str] = field(default_factory=dict)  # the type of every hinge, slide
    references: dict[str, float] = field(default_factory=dict)  # the values [rad
    taken: set[str] = field(default_factory=set)  # names that no new link or joint may have
    driven: frozenset[str] = frozenset()  # the joints that actuators drive or sensors measure


@dataclass(frozen=True, eq=False)
class Place:
    """Where in the tree an element stands: its body, the frame it is written in, its class."""

    body: str
    T_body_frame: RigidTransform
    childclass: str


def unused(tree: MjcfTree, name: str) -> str:
    """Return a name that nothing in the file has, and take it."""
    found = tree.text.unused(name, tree.taken)
    tree.taken.add(found)
    return found


_Z = (0.0, 0.0, 1.0)


def is_free(tree: MjcfTree, joints: list[tuple[etree._Element, Place]]) -> bool:
    """Say whether the joints of a body, none of them driven, leave it all six freedoms."""
    axes: dict[str, list[Array]] = {"slide": [], "hinge": [], "ball": []}
    for element, place in joints:
        attributes = tree.values.attributes(element, place.childclass)
        kind = attributes.get("type", "hinge")
        axis = number_list(attributes.get("axis", "0 0 1"), 3)
        driven = attributes.get("name") in tree.driven
        if element.tag != "joint" or kind not in axes or axis is None or driven:
            return False
        axes[kind].append(np.array(axis))
    turns_freely = len(axes["ball"]) == 1 if axes["ball"] else _span_space(axes["hinge"])
    return _span_space(axes["slide"]) and turns_freely and len(axes["hinge"]) in (0, 3)


def _span_space(axes: list[Array]) -> bool:
    """Say whether there are three axes, independent of each other."""
    return len(axes) == 3 and int(np.linalg.matrix_rank(np.array(axes), tol=1e-3)) == 3


def write_joint(
    tree: MjcfTree,
    element: etree._Element,
    place: Place,
    at: str,
    T_at_body: RigidTransform,
    *,
    last: bool,
    only: bool,
) -> tuple[str, RigidTransform]:
    """Write one joint of a body; return the link after it and the body's frame in that link."""
    values = tree.values
    attributes = values.attributes(element, place.childclass)
    kind = "free" if element.tag == "freejoint" else attributes.get("type", "hinge")
    name = attributes.get("name", "")
    if name and name in tree.joints:
        values.problems.add(
            element, f"has the name '{name}', which another joint has", "give each its own name"
        )
    if not name or name in tree.joints:
        name = unused(tree, f"{place.body}_{kind}")
    tree.joints[name] = kind
    if kind == "free":
        if not only or at != WORLD:
            values.problems.add(
                element, "frees a body that has other joints or is not on the world itself",
                "a free joint stands alone in a body of <worldbody>",
            )  # fmt: skip
        tree.text.joint(name, "floating", at, place.body, T_at_body)
        return place.body, EYE
    if kind not in ("hinge", "slide", "ball"):
        values.problems.add(
            element, f"has the type '{kind}', needed free, ball, slide or hinge", "correct it"
        )
        return at, T_at_body
    pos = values.numbers(element, attributes, "pos", (3,))
    pos = np.zeros(3) if pos is None or kind == "slide" else pos
    T_body_joint = RigidTransform.from_translation(place.T_body_frame.apply(pos))
    T_at_joint = T_at_body * T_body_joint
    centred = not np.asarray(T_body_joint.translation).any()
    child = place.body if last and centred else unused(tree, f"{name}_link")
    if kind == "ball":
        _ball(tree, name, at, child, T_at_joint)
    else:
        _one_axis(tree, element, attributes, place, name, kind, at, child, T_at_joint)
    if child != place.body:
        tree.text.link(child)
    return child, EYE if child == place.body else T_body_joint.inv()


def _ball(tree: MjcfTree, name: str, at: str, child: str, T_at_joint: RigidTransform) -> None:
    """Write a ball joint as three revolutes, perpendicular in the configuration of the file."""
    for i, letter in enumerate("xyz"):
        after = child if letter == "z" else unused(tree, f"{name}_{letter}_link")
        if after != child:
            tree.text.link(after)
        tree.text.joint(
            unused(tree, f"{name}_{letter}"),
            "revolute",
            at,
            after,
            T_at_joint if i == 0 else EYE,
            np.eye(3)[i],
        )
        at = after


def _one_axis(
    tree: MjcfTree,
    element: etree._Element,
    attributes: Attributes,
    place: Place,
    name: str,
    kind: str,
    at: str,
    child: str,
    T_at_joint: RigidTransform,
) -> None:
    """Write a hinge or a slide, its zero where the value of the file is."""
    values = tree.values
    given = values.numbers(element, attributes, "axis", (3,))
    axis = np.array(_Z) if given is None else given
    if not np.linalg.norm(axis) > 1e-9:
        values.problems.add(element, "has a zero axis, needed a direction", "correct its axis")
        axis = np.array(_Z)
    axis = place.T_body_frame.rotation.apply(axis / np.linalg.norm(axis))
    ref = values.numbers(element, attributes, "ref", (1,))
    zero = 0.0 if ref is None else float(ref[0])
    limits = _range(tree, element, attributes)
    if kind == "slide":
        T_at_joint = T_at_joint * RigidTransform.from_translation(-zero * axis)
        tree.references[name] = zero
        tree.text.joint(name, "prismatic", at, child, T_at_joint, axis, limits)
        return
    zero = values.compiler.radians(zero)
    tree.references[name] = zero
    turn = Rotation.from_rotvec(-zero * axis)
    T_at_joint = T_at_joint * RigidTransform.from_rotation(turn)
    turns = (-FULL_TURN, FULL_TURN)
    if limits is not None:
        turns = values.compiler.radians(limits[0]), values.compiler.radians(limits[1])
    tree.text.joint(name, "revolute", at, child, T_at_joint, axis, turns)


def _range(
    tree: MjcfTree, element: etree._Element, attributes: Attributes
) -> tuple[float, float] | None:
    """Return the limits of a joint as the file writes them, or None."""
    numbers = tree.values.numbers(element, attributes, "range", (2,))
    limited = attributes.get("limited", "auto")
    if numbers is None or limited == "false" or not numbers.any():
        return None
    if limited == "auto" and not tree.values.compiler.autolimits:
        return None
    lower, upper = float(numbers[0]), float(numbers[1])
    if not lower < upper:
        tree.values.problems.add(
            element, f"has the range {lower:g} to {upper:g}", "give the lower end first"
        )
        return None
    return lower, upper


_LEFT_ALONE = ("inertial", "camera", "light", "plugin", "site")
_GEOMS = ("plane", "hfield", "sphere", "capsule", "ellipsoid", "cylinder", "box", "mesh", "sdf")
_NOT_READ = ("include", "composite", "flexcomp", "attach", "replicate")


def read_bodies(root: etree._Element, values: Values) -> MjcfTree:
    """Return the bodies of a ``<mujoco>`` as links and joints, problems noted in ``values``.

    The configuration of the file, where all joints are at their ``ref``, closes its loops.
    """
    named = (*root.iterfind("actuator/*"), *root.iterfind("sensor/jointpos"))
    tree = MjcfTree(values, driven=frozenset(str(element.get("joint")) for element in named))
    for element in root.iter(*_NOT_READ):
        values.problems.add(
            element, "is not expanded", "save the compiled model with MuJoCo and give that file"
        )
    for element in root.iterfind("worldbody//*[@name]"):
        if element.tag in ("body", "joint", "freejoint"):
            tree.taken.add(str(element.get("name")))
    tree.poses[WORLD] = EYE
    worlds = root.findall("worldbody")
    visuals: list[TextCylinder] = []
    bodies: list[tuple[etree._Element, Place]] = []
    for world in worlds:
        inside = _contents(tree, world, Place(WORLD, EYE, world.get("childclass", "main")))
        visuals += inside.cylinders
        bodies += inside.bodies
    tree.text.link(WORLD, tuple(visuals))
    while bodies:
        element, place = bodies.pop(0)
        bodies = _body(tree, element, place) + bodies
    return tree


@dataclass
class _Contents:
    """What stands directly in a body, also within its ``<frame>`` elements."""

    joints: list[tuple[etree._Element, Place]] = field(default_factory=list)
    bodies: list[tuple[etree._Element, Place]] = field(default_factory=list)
    cylinders: list[TextCylinder] = field(default_factory=list)


def _contents(tree: MjcfTree, element: etree._Element, place: Place) -> _Contents:
    """Return the joints, bodies and cylinders of a body and note its sites."""
    found = _Contents()
    pending = [(part, place) for part in element]
    while pending:
        part, where = pending.pop(0)
        if part.tag == "frame":
            T = where.T_body_frame * tree.values.pose(part, own_attributes(part))
            inner = Place(where.body, T, _class_within(tree, part, where.childclass))
            pending = [(inside, inner) for inside in part] + pending
        elif part.tag == "body":
            found.bodies.append((part, where))
        elif part.tag in ("joint", "freejoint"):
            found.joints.append((part, where))
        elif part.tag == "geom":
            cylinder = _cylinder(tree, part, where)
            if cylinder is not None:
                found.cylinders.append(cylinder)
        elif part.tag == "site" and part.get("name"):
            _site(tree, part, where)
        elif isinstance(part.tag, str) and part.tag not in (*_LEFT_ALONE, *_NOT_READ):
            tree.values.problems.add(part, "is no element of a body", "correct or remove it")
    return found


def _class_within(tree: MjcfTree, element: etree._Element, outer: str) -> str:
    """Return the default class that holds within a body or frame."""
    name = element.get("childclass", outer)
    if not tree.values.has_class(name):
        tree.values.problems.add(
            element, f"names the default class '{name}', which is not in the file",
            "correct the name",
        )  # fmt: skip
        return outer
    return name


def _body(
    tree: MjcfTree, element: etree._Element, place: Place
) -> list[tuple[etree._Element, Place]]:
    """Write a body with its joints, and return the bodies on it."""
    name = element.get("name", "")
    if name in tree.poses:
        tree.values.problems.add(
            element, f"has the name '{name}', which another body has", "give each its own name"
        )
    if not name or name in tree.poses:
        name = unused(tree, f"body{len(tree.poses)}")
    T_parent_body = place.T_body_frame * tree.values.pose(element, own_attributes(element))
    tree.poses[name] = tree.poses[place.body] * T_parent_body
    inside = _contents(
        tree, element, Place(name, EYE, _class_within(tree, element, place.childclass))
    )
    at, T_at_body = place.body, T_parent_body
    if at == WORLD and is_free(tree, inside.joints):
        tree.text.joint(unused(tree, f"{name}_free"), "floating", at, name, T_at_body)
        at, inside.joints = name, []
    for i, (joint, where) in enumerate(inside.joints):
        only = len(inside.joints) == 1
        at, T_at_body = write_joint(
            tree, joint, where, at, T_at_body, last=i + 1 == len(inside.joints), only=only
        )
    if at != name:
        tree.text.joint(unused(tree, f"{name}_fixed"), "fixed", at, name, T_at_body)
    tree.text.link(name, tuple(inside.cylinders))
    return inside.bodies


def _cylinder(tree: MjcfTree, element: etree._Element, place: Place) -> TextCylinder | None:
    """Return the cylinder of a geom that is a cylinder or a capsule, else None."""
    values = tree.values
    attributes = values.attributes(element, place.childclass)
    kind = attributes.get("type", "sphere")
    if kind not in _GEOMS:
        values.problems.add(
            element, f"has the type '{kind}', needed one of {', '.join(_GEOMS)}", "correct it"
        )
    if kind not in ("cylinder", "capsule") or "mesh" in attributes:
        return None
    size = values.numbers(element, attributes, "size", (1, 2, 3))
    ends = values.numbers(element, attributes, "fromto", (6,))
    length = None
    T: RigidTransform
    if ends is not None:
        along: Array = ends[3:] - ends[:3]
        length = float(np.linalg.norm(along))
        if length > 0.0:
            T = RigidTransform.from_components(0.5 * (ends[3:] + ends[:3]), _z_onto(along))
    else:
        T = values.pose(element, attributes)
        length = 2.0 * float(size[1]) if size is not None and len(size) > 1 else None
    if size is None or length is None or not (size[0] > 0.0 and length > 0.0):
        values.problems.add(
            element, "is a cylinder without a radius and a length above zero",
            "write size, or fromto and size",
        )  # fmt: skip
        return None
    return TextCylinder(place.T_body_frame * T, float(size[0]), length)


def _site(tree: MjcfTree, element: etree._Element, place: Place) -> None:
    """Note a site by its name."""
    values = tree.values
    name = str(element.get("name"))
    if name in tree.sites:
        values.problems.add(
            element, f"has the name '{name}', which another site has", "give each its own name"
        )
    attributes = values.attributes(element, place.childclass)
    ends = values.numbers(element, attributes, "fromto", (6,))
    if ends is not None and np.linalg.norm(ends[3:] - ends[:3]) > 0.0:
        T = RigidTransform.from_components(
            0.5 * (ends[3:] + ends[:3]), _z_onto(ends[3:] - ends[:3])
        )
    else:
        T = values.pose(element, attributes)
    tree.sites[name] = place.body, place.T_body_frame * T


MAX_PARTS = 5000
_COUPLINGS = ("joint", "tendon", "flex", "flexvert", "flexstrain")
_WORDS = (("closed_loop", "<equality>"), ("the root of the URDF", "<worldbody>"), *DRAWING)
_OTHER_DRIVES = ("tendon", "site", "refsite", "cranksite", "slidersite")


def read_mjcf_source(path: Path, content: bytes) -> Source:
    """Return the mechanism of an MJCF file."""
    root = parse_xml(path, content, "MJCF file")
    n_parts = sum(1 for _ in root.iter("body", "joint", "default", "frame"))
    if n_parts > MAX_PARTS:
        raise ModelError(
            f"{path}: the MJCF file could not be used: found {n_parts} bodies, joints, frames and "
            f"default classes, needed at most {MAX_PARTS}; give the mechanism alone."
        )
    problems = Problems(path)
    values = Values(root, problems)
    tree = read_bodies(root, values)
    loops = list(closing_joints(root, tree))
    motors = _motors(root, tree)
    problems.raise_if_any()
    if not loops:
        raise OutOfClass(
            f"{path}: this is not a parallel mechanism: found an MJCF file without <connect> or "
            "<weld> in <equality>, which is a tree without closed loops, needed the closures of "
            "its loops; add them."
        )
    pairs = [close_loop(loop, tree.text, tree.poses) for loop in loops]
    name = root.get("model", "").strip() or path.stem
    urdf = parse_urdf(path, tree.text.robot(name), travel_needed=False)
    frames = [ends for ends, _ in pairs]
    urdf, dropped = _without_loose_bodies(urdf, frames, tree, name)
    left_out = f"Free bodies that touch no loop were left out: {', '.join(dropped)}."
    values_there = {name: x for name, x in tree.references.items() if name in urdf.joints}
    file = MechanismFile(closed_loop=frames, type=[kind for _, kind in pairs], name_mot=motors)
    notes = (left_out,) * bool(dropped)
    return Source(path, file, urdf, True, notes, values_there, words=_WORDS)


def closing_joints(root: etree._Element, tree: MjcfTree) -> Iterator[Loop]:
    """Give the loops of all ``<equality>`` elements; problems are noted."""
    problems = tree.values.problems
    names: set[str] = set()
    for i, element in enumerate(root.iterfind("equality/*"), start=1):
        attributes = {**_equality_default(tree, element), **own_attributes(element)}
        if attributes.get("active", "true") == "false":
            continue
        if element.tag in _COUPLINGS:
            problems.add(
                element, f"couples <{element.tag}> coordinates, which is not followed",
                "close loops with <connect> and <weld> alone",
            )  # fmt: skip
        elif element.tag not in ("connect", "weld"):
            problems.add(
                element, "is no constraint that legcal knows",
                "close loops with <connect> and <weld> alone",
            )  # fmt: skip
        if element.tag not in ("connect", "weld"):
            continue
        name = str(attributes.get("name") or f"{element.tag}{i}")
        if name in names:
            problems.add(element, "has a name that another one has", "give each its own name")
        names.add(name)
        n_before = len(problems)
        by_site = "site1" in attributes or "site2" in attributes
        ends = _sites(element, tree) if by_site else _bodies(element, tree)
        if ends is None or len(problems) > n_before:
            continue
        (link_1, T_1), (link_2, T_2) = ends
        if link_1 == link_2:
            problems.add(element, f"joins the body '{link_1}' to itself", "name two bodies")
            continue
        scale = tree.values.numbers(element, attributes, "torquescale", (1,))
        is_point = element.tag == "connect" or (scale is not None and scale[0] == 0.0)
        kind: LoopKind = "point" if is_point else "weld"
        yield Loop(name, kind, (link_1, link_2), (T_1, T_2))


def _equality_default(tree: MjcfTree, element: etree._Element) -> dict[str, str]:
    """Return the default attributes of an equality constraint."""
    stand_in = etree.Element("equality")
    if element.get("class") is not None:
        stand_in.set("class", str(element.get("class")))
    return tree.values.attributes(stand_in, "main")


_Ends = tuple[tuple[str, RigidTransform], tuple[str, RigidTransform]]


def _sites(element: etree._Element, tree: MjcfTree) -> _Ends | None:
    """Return the two sites that a constraint holds together."""
    found = []
    for key in ("site1", "site2"):
        name = element.get(key, "")
        if name in tree.sites:
            found.append(tree.sites[name])
        else:
            tree.values.problems.add(
                element, f"names the site '{name}' as {key}, which is not in the file",
                closest(name, tree.sites).rstrip("."),
            )  # fmt: skip
    return (found[0], found[1]) if len(found) == 2 else None


def _bodies(element: etree._Element, tree: MjcfTree) -> _Ends | None:
    """Return the frames on two bodies that a constraint holds together."""
    values = tree.values
    names = []
    for key in ("body1", "body2"):
        name = element.get(key, WORLD if key == "body2" else "")
        names.append(name)
        if not name:
            values.problems.add(element, f"has no {key}", "name the body that it holds")
        elif name not in tree.poses:
            values.problems.add(
                element, f"names the body '{name}' as {key}, which is not in the file",
                closest(name, tree.poses).rstrip("."),
            )  # fmt: skip
    attributes = own_attributes(element)
    anchor = values.numbers(element, attributes, "anchor", (3,))
    if element.tag == "connect" and "anchor" not in attributes:
        values.problems.add(element, "has no anchor", "write the point in the frame of body1")
    if any(name not in tree.poses for name in names):
        return None
    T_one_two = tree.poses[names[0]].inv() * tree.poses[names[1]]
    at = np.zeros(3) if anchor is None else anchor
    if element.tag == "connect":  # the anchor stands in body1
        T_one = RigidTransform.from_translation(at)
        T_two = RigidTransform.from_translation(T_one_two.inv().apply(at))
        return (names[0], T_one), (names[1], T_two)
    relpose = values.numbers(element, attributes, "relpose", (7,))
    T_two = RigidTransform.from_translation(at)  # the anchor of a weld stands in body2
    if relpose is not None and relpose[3:].any():  # MuJoCo brings the anchor to this very place
        rotation = Rotation.from_quat(np.roll(relpose[3:], -1))
        T_one = RigidTransform.from_components(relpose[:3], rotation)
    else:  # the configuration of the file holds
        T_one = T_one_two * T_two
    return (names[0], T_one), (names[1], T_two)


def _motors(root: etree._Element, tree: MjcfTree) -> list[str]:
    """Return the joints that have an encoder: what is driven, and slides that are measured."""
    problems = tree.values.problems
    motors: dict[str, None] = {}
    for element in (*root.iterfind("actuator/*"), *root.iterfind("sensor/jointpos")):
        other = [key for key in _OTHER_DRIVES if element.get(key) is not None]
        name = element.get("joint", element.get("jointinparent"))
        if other and element.tag != "jointpos":
            problems.add(
                element, f"drives by {other[0]}, which is no joint with a reading",
                "drive the slide of each leg itself",
            )  # fmt: skip
        if name is None and not other and not _drives_no_leg(element):
            problems.add(
                element, "names no joint", "name the slide that it drives or measures as joint"
            )
        if name is None:
            continue
        kind = tree.joints.get(name)
        if kind is None:
            problems.add(
                element, f"names the joint '{name}', which is not in the file",
                closest(name, tree.joints).rstrip("."),
            )  # fmt: skip
        elif kind in ("ball", "free"):
            problems.add(
                element, f"drives or measures the {kind} joint '{name}', which has no one reading",
                "remove it",
            )  # fmt: skip
        elif kind == "slide" or element.tag != "jointpos":
            motors[name] = None
    return list(motors)


def _drives_no_leg(element: etree._Element) -> bool:
    """Say whether an actuator acts on something else than joints: suction of a body, a plugin."""
    return element.tag == "plugin" or element.get("body") is not None


def _without_loose_bodies(
    urdf: Urdf, frames: list[list[str]], tree: MjcfTree, name: str
) -> tuple[Urdf, list[str]]:
    """Return the tree without free bodies that no closure touches, and their names."""
    loose = {link for links, closed in moving_groups(urdf, frames) if not closed for link in links}
    if not loose:
        return urdf, []
    held = [j for j in urdf.joints.values() if j.child in loose]
    other = [j.name for j in held if j.moves and j.type != "floating"]
    if other:
        raise OutOfClass(
            f"{urdf.path}: the mechanism could not be read: found joints of something else beside "
            f"it ('{other[0]}'), needed one mechanism in the file; remove the other bodies."
        )
    for joint in held:
        del tree.text.joints[joint.name]
    for link in loose:
        del tree.text.links[link]
    freed = [f"'{j.child}'" for j in held if j.type == "floating"]
    return parse_urdf(urdf.path, tree.text.robot(name), travel_needed=False), freed


def _z_onto(direction: Array) -> Rotation:
    """Return the shortest rotation that takes z onto a direction of any length."""
    return rotation_between(np.array([0.0, 0.0, 1.0]), direction / np.linalg.norm(direction))
