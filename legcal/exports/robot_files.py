"""A single URDF file with loops, and the folder for ROS.

The tree has exactly the numbers of the machine. Meshes, which a single file cannot hold, are left
out; loops are ``<loop_joint>`` elements and motors ``<transmission>`` elements, so that legcal
reads the file without a YAML; other programs skip unknown elements.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import yaml
from lxml import etree

from legcal.exports.identifiers import identifier
from legcal.exports.subject import ExportedFile, ExportOptions, Rendered, Subject, other_gains
from legcal.files.motions import motion_to_xyz_quat
from legcal.machine.model import Machine
from legcal.version import __version__

STUB_MASS, STUB_INERTIA = 1.0, 1e-3  # [kg], [kg m^2] about each axis of the link
_SHAPES = ("visual", "collision")


def urdf_files(subject: Subject, options: ExportOptions, path: Path) -> Rendered:
    """Return the URDF file."""
    content, notes = urdf_text(subject.machine, inertia=options.inertia)
    return Rendered((ExportedFile("", content),), notes)


def ros_files(subject: Subject, options: ExportOptions, path: Path) -> Rendered:
    """Return the URDF and the numbers of the calibration."""
    content, notes = urdf_text(subject.machine, inertia=options.inertia)
    name = identifier(subject.name)
    document = {
        "legcal_calibration": 1,
        "legcal": __version__,
        "robot": subject.machine.urdf.name,
        "urdf": f"{name}.urdf",
        **_calibration(subject),
    }
    text = yaml.safe_dump(document, sort_keys=False, allow_unicode=True)
    files = ExportedFile(f"{name}.urdf", content), ExportedFile("calibration.yaml", text.encode())
    return Rendered(files, notes)


def urdf_text(machine: Machine, *, inertia: bool) -> tuple[bytes, tuple[str, ...]]:
    """Return a self-contained URDF, and the elements left out."""
    parser = etree.XMLParser(resolve_entities=False, no_network=True, load_dtd=False)
    robot = etree.fromstring(machine.urdf.content, parser)
    meshes = _without_meshes(robot)
    if inertia:
        for link in robot.iterfind("link"):
            if link.find("inertial") is None:
                link.append(_stub())
    joints = machine.urdf.joints
    for i, closure in enumerate(machine.chain.closures, start=1):
        kind = "spherical" if closure.kind == "3d" else "fixed"
        loop = etree.SubElement(robot, "loop_joint", name=f"loop_{i}", type=kind)
        for tag, frame in (("link1", closure.frame_1), ("link2", closure.frame_2)):
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


def _stub() -> etree._Element:
    """Return an inertia accepted by simulators."""
    inertial = etree.Element("inertial")
    etree.SubElement(inertial, "origin", xyz="0 0 0", rpy="0 0 0")
    etree.SubElement(inertial, "mass", value=repr(STUB_MASS))
    moments = {f"i{pair}": "0.0" for pair in ("xy", "xz", "yz")}
    moments |= {f"i{pair}": repr(STUB_INERTIA) for pair in ("xx", "yy", "zz")}
    etree.SubElement(inertial, "inertia", moments)
    return inertial


def _calibration(subject: Subject) -> dict[str, object]:
    """Return the numbers of calibration.yaml [m, rad]."""
    machine = subject.machine
    calibration: dict[str, object] = {
        "base_link": machine.base,
        "platform_link": machine.platform,
        "closed_loop": [[c.frame_1, c.frame_2] for c in machine.chain.closures],
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
