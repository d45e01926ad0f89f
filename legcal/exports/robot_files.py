"""A single URDF file with loops, the folder for ROS, and the MJCF file for MuJoCo.

The tree of the URDF has exactly the numbers of the machine. Meshes, which a single file cannot
hold, are left out; loops are ``<loop_joint>`` elements and motors ``<transmission>`` elements, so
that legcal reads the file without a YAML; other programs skip unknown elements.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import yaml
from lxml import etree
from scipy.spatial.transform import RigidTransform

from legcal.exports.subject import (
    Rendered,
    Subject,
    comment,
    identifier,
    other_gains,
)
from legcal.files.motions import motion_to_xyz_quat
from legcal.geometry.types import Array
from legcal.machine.model import Machine
from legcal.machine.urdf import UrdfJoint, origins_of, parse_robot
from legcal.version import __version__

STUB_MASS, STUB_INERTIA = 1.0, 1e-3  # [kg], [kg m^2] about each axis of the link
_SHAPES = ("visual", "collision")


def urdf_files(subject: Subject, path: Path) -> Rendered:
    """Return the URDF file."""
    content, notes = urdf_text(subject.machine)
    return Rendered({"": content}, notes)


def ros_files(subject: Subject, path: Path) -> Rendered:
    """Return the URDF and the numbers of the calibration."""
    content, notes = urdf_text(subject.machine)
    name = identifier(subject.name)
    document = {
        "legcal_calibration": 1,
        "legcal": __version__,
        "robot": subject.machine.urdf.name,
        "urdf": f"{name}.urdf",
        **_calibration(subject),
    }
    text = yaml.safe_dump(document, sort_keys=False, allow_unicode=True)
    return Rendered({f"{name}.urdf": content, "calibration.yaml": text.encode()}, notes)


def urdf_text(machine: Machine) -> tuple[bytes, tuple[str, ...]]:
    """Return a self-contained URDF, and the elements left out."""
    parser = etree.XMLParser(resolve_entities=False, no_network=True, load_dtd=False)
    robot = etree.fromstring(machine.urdf.content, parser)
    meshes = _without_meshes(robot)
    joints = machine.urdf.joints
    for i, closure in enumerate(machine.chain.closures, start=1):
        kind = "spherical" if closure.kind == "3d" else "fixed"
        loop = etree.SubElement(robot, "loop_joint", name=f"loop_{i}", type=kind)
        for tag, frame in zip(("link1", "link2"), closure.frames, strict=True):
            link = frame if frame in machine.urdf.links else joints[frame].child
            etree.SubElement(loop, tag, link=link)
    named = {e.get("name") for e in robot.iterfind("transmission/joint")}
    for leg in (machine.legs[j] for j in machine.motors):
        if leg.prismatic not in named:
            motor = etree.SubElement(robot, "transmission", name=f"{leg.prismatic}_transmission")
            etree.SubElement(motor, "type").text = "transmission_interface/SimpleTransmission"
            etree.SubElement(motor, "joint", name=str(leg.prismatic))
            etree.SubElement(motor, "actuator", name=f"{leg.prismatic}_motor")
    etree.indent(robot)
    content = etree.tostring(robot, xml_declaration=True, encoding="utf-8") + b"\n"
    notes = []
    if gains := other_gains(machine):
        notes.append(
            f"Joints move by their readings times the gain, which a URDF has no place for: {gains}."
        )
    if meshes:
        named_meshes = ", ".join(meshes[:3]) + " and more" * (len(meshes) > 3)
        notes.append(f"Meshes are in separate files and were left out: {named_meshes}.")
    return content, tuple(notes)


def _without_meshes(robot: etree._Element) -> list[str]:
    """Remove shapes and textures in other files; return their names."""
    removed = []
    for link in robot.iterfind("link"):
        for shape in [part for part in link if part.tag in _SHAPES]:
            mesh = shape.find("geometry/mesh")
            if mesh is not None:
                removed.append(mesh.get("filename", "a mesh without a name"))
                link.remove(shape)
    for texture in list(robot.iter("texture")):
        parent = texture.getparent()
        if parent is not None:
            removed.append(texture.get("filename", "a texture without a name"))
            parent.remove(texture)
    return removed


def _calibration(subject: Subject) -> dict[str, object]:
    """Return the numbers of calibration.yaml [m, rad]."""
    machine = subject.machine
    calibration: dict[str, object] = {
        "base_link": machine.base,
        "platform_link": machine.platform,
        "closed_loop": [[*c.frames] for c in machine.chain.closures],
        "closed_loop_type": [c.kind for c in machine.chain.closures],
        "home": motion_to_xyz_quat(machine.home),
        "legs": {
            leg.name: {
                "joint": leg.prismatic,
                "is_motor": leg.is_motor,
                "base_joint": leg.A.tolist(),
                "platform_joint": leg.B.tolist(),
                "offset": float(leg.q0),
                "sign": leg.sign,
            }
            for leg in machine.legs
        },
    }
    if machine.actuators:  # joints carried by actuators are at reading 0
        calibration["actuators"] = {a.joint: a.document() for a in machine.actuators}
    if subject.result is not None:
        result = subject.result.document
        row_of = {row.name: row for row in result.parameters}
        names = result.kinematic.names
        rows = [row_of.get(name) for name in names]
        calibration["parameters"] = {
            "frames": "R_b and R_e",
            "names": names,
            "units": ["m" if row is None else row.unit for row in rows],
            "values": [None if row is None else row.value for row in rows],
            "nominal": [None if row is None else row.nominal for row in rows],
            "sigma": [None if row is None else row.sigma for row in rows],
            "covariance": np.array(result.kinematic.covariance).tolist(),
        }
    return calibration


# MJCF: bodies are at the home of the machine, where every loop is closed, and "ref" is the joint
# value at home, so that joint positions equal those of the URDF, readings included. A 3d closure is
# a <connect> and a 6d closure a <weld> of two sites. Links without inertia, or with an impossible
# one, get a stub, which MuJoCo requires.


WORLD = "world"
_X, _Y, _Z = np.eye(3)
STIFF = "0.001 1"  # solref of closures: one millisecond, critically damped
GAIN = 1e4  # gain of the position servos [N/m]
LEAST = 1e-15  # least mass, moment of inertia or size that MuJoCo accepts


def mjcf_refusal(subject: Subject) -> str | None:
    """Return the reason for refusing a tree that MuJoCo cannot represent, or None."""
    if gains := other_gains(subject.machine):
        return (
            f"found gains other than 1 ({gains}), needed joints that move by their "
            "readings, as those of MuJoCo do"
        )
    urdf = subject.machine.urdf
    for joint in urdf.joints.values():
        for above in urdf.joints_above(joint.parent):
            if joint.type == "floating" and above.moves:
                return (
                    f"found the floating joint '{joint.name}' below '{above.name}', which "
                    "moves, needed it to hang from the world alone (MuJoCo)"
                )
    return None


def mjcf_files(subject: Subject, path: Path) -> Rendered:
    """Return the MJCF file."""
    machine = subject.machine
    root = _Writer(machine).model(subject.name)
    etree.indent(root)
    title = f" {comment(subject.name)}, written by legcal {__version__} "
    content = f"<!--{title.replace('--', '__')}-->\n".encode()
    return Rendered({"": content + etree.tostring(root, encoding="utf-8") + b"\n"})


class _Writer:
    def __init__(self, machine: Machine) -> None:
        self._machine = machine
        urdf = machine.urdf
        robot = parse_robot(urdf.path, urdf.content)
        self._links = {str(e.get("name")): e for e in robot.iterfind("link")}
        self._world = etree.Element("worldbody")
        self._name = {link: link for link in urdf.links}  # names of bodies; the root is the world
        if WORLD in self._name and urdf.root != WORLD:
            self._name[WORLD] = _unused(WORLD, set(urdf.links))
        self._joints = set(urdf.joints)
        self._motors = {machine.legs[j].prismatic for j in machine.motors}
        self._body: dict[str, etree._Element] = {urdf.root: self._world}

    def model(self, name: str) -> etree._Element:
        """Return the ``<mujoco>`` element."""
        machine = self._machine
        mujoco = etree.Element("mujoco", model=name)
        etree.SubElement(
            mujoco, "compiler", angle="radian", autolimits="true", balanceinertia="true"
        )
        etree.SubElement(mujoco, "option", gravity="0 0 0")
        mujoco.append(self._world)
        self._shapes(machine.urdf.root, self._world)
        pending = [machine.urdf.root]
        while pending:
            link = pending.pop(0)
            for joint in machine.urdf.below[link]:
                self._add(joint)
                pending.append(joint.child)
        equality = etree.SubElement(mujoco, "equality")
        for i, closure in enumerate(machine.chain.closures, start=1):
            sites = {}
            for number, frame in enumerate(closure.frames, start=1):
                link = frame if frame in self._body else machine.urdf.joints[frame].child
                sites[f"site{number}"] = f"loop_{i}_{number}"
                etree.SubElement(self._body[link], "site", name=f"loop_{i}_{number}")
            tag = "connect" if closure.kind == "3d" else "weld"
            etree.SubElement(equality, tag, {"name": f"loop_{i}", "solref": STIFF, **sites})
        motors = etree.SubElement(mujoco, "actuator")
        for j in machine.motors:
            motor = str(machine.legs[j].prismatic)
            etree.SubElement(motors, "position", name=motor, joint=motor, kp=_text(GAIN))
        return mujoco

    def _add(self, joint: UrdfJoint) -> None:
        machine, link = self._machine, joint.child
        chain, home = machine.chain, machine.home_configuration
        is_free = joint.type == "floating"
        parent = machine.urdf.root if is_free else joint.parent
        T = chain.pose(home, parent, link)
        body = etree.SubElement(self._body[parent], "body", {"name": self._name[link], **_pose(T)})
        self._body[link] = body
        if is_free:
            etree.SubElement(body, "freejoint", name=joint.name)
        elif joint.type == "planar":
            # As in Pinocchio: x and y of the joint frame, then rotation about z.
            x, y, cosine, sine = home[chain.q_index(joint.name) :][:4]
            turned = np.array([[cosine, sine, 0.0], [-sine, cosine, 0.0], [0.0, 0.0, 1.0]])
            for name, kind, axis, value in (
                (f"{joint.name}_x", "slide", turned @ _X, x),
                (f"{joint.name}_y", "slide", turned @ _Y, y),
                (f"{joint.name}_turn", "hinge", _Z, np.arctan2(sine, cosine)),
            ):
                _joint(body, _unused(name, self._joints), kind, axis, value)
        elif joint.moves:
            value = home[chain.q_index(joint.name)]
            if joint.type == "continuous":
                value = np.arctan2(home[chain.q_index(joint.name) + 1], value)
            is_slide = joint.type == "prismatic"
            element = _joint(body, joint.name, "slide" if is_slide else "hinge", joint.axis, value)
            if joint.limits is not None and (is_slide or joint.name in self._motors):
                element.set("range", _text(*joint.limits))
        if joint.moves:
            self._inertia(link, body)
        self._shapes(link, body)

    def _inertia(self, link: str, body: etree._Element) -> None:
        """Add the inertia of a link, or a stub."""
        inertial = self._links[link].find("inertial")
        mass = None if inertial is None else inertial.find("mass")
        moments = None if inertial is None else inertial.find("inertia")
        full = np.zeros((3, 3))
        if mass is not None and moments is not None:
            numbers = (
                float(moments.get(key, 0.0)) for key in ("ixx", "iyy", "izz", "ixy", "ixz", "iyz")
            )
            ixx, iyy, izz, ixy, ixz, iyz = numbers
            full = np.array([[ixx, ixy, ixz], [ixy, iyy, iyz], [ixz, iyz, izz]])
        heavy = 0.0 if mass is None else float(mass.get("value", 0.0))
        if inertial is None or min(heavy, np.linalg.eigvalsh(full)[0]) <= LEAST:
            stub = _text(*[STUB_INERTIA] * 3)
            etree.SubElement(body, "inertial", pos="0 0 0", mass=_text(STUB_MASS), diaginertia=stub)
            return
        T = RigidTransform.from_matrix(origins_of([inertial])[0])
        R = T.rotation.as_matrix()
        full = R @ full @ R.T
        etree.SubElement(
            body,
            "inertial",
            pos=_text(*T.translation),
            mass=_text(heavy),
            fullinertia=_text(*np.diagonal(full), full[0, 1], full[0, 2], full[1, 2]),
        )

    def _shapes(self, link: str, body: etree._Element) -> None:
        for visual in self._links[link].iterfind("visual"):
            cylinder = visual.find("geometry/cylinder")
            if cylinder is not None:
                T = RigidTransform.from_matrix(origins_of([visual])[0])
                size = float(cylinder.get("radius", 0)), 0.5 * float(cylinder.get("length", 0))
                if min(size) <= LEAST:
                    continue
                shape = {"type": "cylinder", "size": _text(*size), "mass": "0"}
                apart = {"contype": "0", "conaffinity": "0"}
                etree.SubElement(body, "geom", {**shape, **apart, **_pose(T)})


def _joint(body: etree._Element, name: str, kind: str, axis: Array, value: float) -> etree._Element:
    """Add a joint at the origin of a body, with its value at home."""
    return etree.SubElement(
        body, "joint", name=name, type=kind, axis=_text(*axis), ref=_text(value), damping="1"
    )


def _pose(T: RigidTransform) -> dict[str, str]:
    x, y, z, w = T.rotation.as_quat()
    return {"pos": _text(*T.translation), "quat": _text(w, x, y, z)}


def _text(*numbers: float) -> str:
    """Return numbers that are read back exactly."""
    return " ".join(repr(float(x)) for x in numbers)


def _unused(name: str, taken: set[str]) -> str:
    unused = name
    while unused in taken:
        unused += "_"
    return unused
