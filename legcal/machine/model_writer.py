"""Models written with other numbers: a URDF with moved origins, and its YAML.

Written files are loaded again and checked.
"""

from __future__ import annotations

import json
import os
import re
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from scipy.spatial.transform import RigidTransform

from legcal.errors import DidNotConverge, ModelError, OutOfResources, UsageError
from legcal.files.folder import write_atomically
from legcal.files.motions import motion_to_xyz_quat
from legcal.files.schema import content_of
from legcal.geometry.rotations import roll_pitch_yaw
from legcal.machine.files import FILE_KIND, FOLDER_YAML, is_xml, mechanism_yaml, motor_entries
from legcal.machine.kinematics import forward_kinematics, inverse_kinematics
from legcal.machine.leg import Leg
from legcal.machine.loader import load_mechanism
from legcal.machine.meshes import mesh_file
from legcal.machine.model import Machine, readings_at
from legcal.machine.origins import moved_arms, moved_origins
from legcal.machine.rods import actuators_of
from legcal.machine.urdf import UrdfPatch, written

_PLAIN = re.compile(r"[A-Za-z_][A-Za-z0-9_./-]*")  # strings without quotes in YAML
CLOSES = 2.5e-9  # tolerance of home and the pose at its readings [mean leg lengths, rad]
ROUNDING = 1e-15  # displacement that counts as none [mean leg lengths]


def mechanism_text(machine: Machine, urdf: str) -> str:
    """Return the complete YAML of a mechanism."""
    return mechanism_yaml(
        [(c.frame_1, c.frame_2, c.kind) for c in machine.chain.closures],
        [str(machine.legs[j].prismatic) for j in machine.motors],
        {
            "urdf": urdf,
            "base": machine.base,
            "platform": machine.platform,
            "platform_joint": machine.platform_joint,
            "base_frame": [machine.leg_names[j] for j in machine.frame_legs],
            "home": motion_to_xyz_quat(machine.home),
            **_actuators_in_words(machine),
            "legs": {leg.name: _joint_of(machine, leg) for leg in machine.legs},
        },
    )


def _actuators_in_words(machine: Machine) -> dict[str, Any]:
    """Return the YAML entries of actuators: readings at home, numbers with no place in a URDF."""
    q = readings_at(machine, machine.home)
    home = {str(machine.legs[j].prismatic): float(q[j]) for j in machine.motors
            if machine.legs[j].actuator is not None}  # fmt: skip
    stated = motor_entries(machine.actuators)
    return ({"home_readings": home} if home else {}) | ({"motors": stated} if stated else {})


def model_name(machine: Machine) -> str:
    """Return the name for the files of a mechanism: that of its file, or of its folder."""
    path = machine.yaml_path
    return path.resolve().parent.name if path.name == FOLDER_YAML else path.stem


def write_model(machine: Machine, folder: Path) -> tuple[Path, Path]:
    """Write ``models/NAME.yaml`` and ``urdf/NAME.urdf`` of a mechanism.

    An unconverted URDF is copied byte for byte, but for lost paths of meshes.
    """
    name = model_name(machine)
    places = folder / "models" / f"{name}.yaml", folder / "urdf" / f"{name}.urdf"
    there = [str(path) for path in places if os.path.lexists(path)]
    if there:
        raise UsageError(
            f"the model '{name}' could not be written",
            f"{' and '.join(there)} already there",
            "new files",
            "give another folder",
            machine.yaml_path,
        )
    try:
        for path in places:
            path.parent.mkdir(parents=True, exist_ok=True)
        write_atomically(places[1], _with_paths(machine, places[1]))
        text = mechanism_text(machine, f"../urdf/{name}.urdf")
        write_atomically(places[0], text.encode())  # last: a URDF alone is no model
    except OSError as error:
        raise OutOfResources(
            f"{folder}: the model could not be written: found '{error.strerror}', needed a folder "
            "that takes it; free space, correct permissions, or give another folder."
        ) from error
    return places


def _with_paths(machine: Machine, destination: Path) -> bytes:
    """Return the URDF of a mechanism; meshes not found from a destination get absolute paths."""
    robot, changed = machine.urdf.robot(), False
    for mesh in robot.iterfind("link/*/geometry/mesh"):
        file = mesh_file(machine.urdf.path, mesh.get("filename", ""))
        if file is not None and mesh_file(destination, mesh.get("filename", "")) is None:
            mesh.set("filename", file.resolve().as_posix())
            changed = True
    return written(robot) if changed else machine.urdf.content


def _joint_of(machine: Machine, leg: Leg) -> str:
    """Return a joint that identifies a leg: its slider, or any other of its own."""
    if leg.prismatic is not None and leg.actuator is None:
        return leg.prismatic
    chain = leg.urdf_chain
    steps = chain.steps[chain.actuator is not None :]
    moving = [step.connection.joint for step in steps if step.connection.joint]
    fixed = [joint.name for joint in machine.urdf.joints.values() if joint.child in chain.bodies]
    return str([*moving, *fixed][0])


def write_urdf(machine: Machine, legs: Sequence[Leg], destination: Path) -> None:
    """Write the URDF of a mechanism with other numbers of its legs, of any type.

    Loading it again gives these numbers to 1e-12 m and rad, with R_b and R_e unchanged. The visuals
    of arms move with their lines. Radii are not written, since they absorb the bias of edges. Home
    is not checked: with other rods or axes the mechanism may close elsewhere. Gains of motors that
    carry rods are in the YAML only.
    """
    patch = UrdfPatch(machine.urdf.content)
    for name, (after, is_turned) in moved_origins(machine, legs).items():
        before = machine.urdf.joints[name].T_parent_origin
        xyz = np.asarray(after.translation)
        stays = np.abs(xyz - before.translation).max() < ROUNDING * machine.size
        rpy = roll_pitch_yaw(after.rotation.as_matrix()) if is_turned else None
        if rpy is not None or not stays:
            patch.set_origin(name, None if stays else xyz, rpy)
    for arm, T in moved_arms(machine, legs):
        patch.move_cylinder(arm.link, (arm.radius, arm.length), T)
    destination.write_bytes(patch.content())


def write_calibrated_yaml(
    machine: Machine,
    destination: Path,
    urdf_name: str,
    home: RigidTransform | None = None,
    legs: Sequence[Leg] = (),
) -> None:
    """Write the mechanism's YAML with ``legcal.urdf`` naming the calibrated file.

    All else is kept character by character, except the numbers of ``legcal.home`` if home moves;
    the key is added if it is missing, and the gains of the motors of *legs* if they differ from the
    model. A mechanism of another format, or without a block ``legcal``, gets a complete YAML.
    """
    gains = {a.joint: a.gain for a in actuators_of(legs)}
    if not _is_written_down(machine):
        there = machine if home is None else replace(machine, home=home)
        there = replace(there, legs=tuple(_with_gain(leg, gains) for leg in there.legs))
        destination.write_bytes(mechanism_text(there, urdf_name).encode("utf-8"))
        return
    text = content_of(machine.yaml_path, FILE_KIND, ModelError).decode("utf-8")
    if home is not None:
        text = _with_home(text, home)
    if any(a.gain != gains.get(a.joint, a.gain) for a in machine.actuators):
        moved = [leg.actuator for leg in (_with_gain(leg, gains) for leg in machine.legs)]
        text = _with_motors(text, motor_entries([a for a in moved if a is not None]))
    value = urdf_name if _PLAIN.fullmatch(urdf_name) else json.dumps(urdf_name)
    block = _entry(yaml.compose(text, Loader=yaml.SafeLoader), "legcal")
    written = None if block is None else _entry(block, "urdf")
    if written is not None:
        text = text[: written.start_mark.index] + value + text[written.end_mark.index :]
    else:
        text = _with_first(text, block, f"urdf: {value}")
    destination.write_bytes(text.encode("utf-8"))


def _with_gain(leg: Leg, gains: Mapping[str, float]) -> Leg:
    """Return a leg whose motor has its gain from a mapping by joint."""
    if leg.actuator is None:
        return leg
    gain = gains.get(leg.actuator.joint, leg.actuator.gain)
    return replace(leg, actuator=replace(leg.actuator, gain=gain))


def _with_motors(text: str, entries: dict[str, Any]) -> str:
    """Return the text of a YAML with these entries in ``legcal.motors``."""
    value = json.dumps(entries)  # YAML on one line
    block = _entry(yaml.compose(text, Loader=yaml.SafeLoader), "legcal")
    written = _entry(block, "motors")
    if written is not None:
        end = written.end_mark.index
        if isinstance(written, yaml.MappingNode) and not written.flow_style:
            value += "\n" + " " * _indent(block)
        return text[: written.start_mark.index] + value + text[end:]
    return _with_first(text, block, f"motors: {value}")


def _indent(block: yaml.Node | None) -> int:
    """Return the column of the keys of a mapping."""
    return block.value[0][0].start_mark.column if isinstance(block, yaml.MappingNode) else 0


def _with_first(text: str, block: yaml.Node | None, entry: str) -> str:
    """Return a text with an entry inserted as the first of a mapping."""
    if not isinstance(block, yaml.MappingNode) or not block.value:
        return text
    first = block.value[0][0].start_mark
    separator = ", " if block.flow_style else "\n" + " " * first.column
    return f"{text[: first.index]}{entry}{separator}{text[first.index :]}"


def _with_home(text: str, home: RigidTransform) -> str:
    """Return the text of a YAML with other numbers in ``legcal.home``, if present."""
    written = _entry(_entry(yaml.compose(text, Loader=yaml.SafeLoader), "legcal"), "home")
    numbers = []
    for key, values in motion_to_xyz_quat(home).items():
        entry = _entry(written, key)
        if isinstance(entry, yaml.SequenceNode):
            numbers += list(zip(entry.value, values, strict=True))
    for node, value in sorted(numbers, key=lambda number: -number[0].start_mark.index):
        text = text[: node.start_mark.index] + repr(value) + text[node.end_mark.index :]
    return text


def _is_written_down(machine: Machine) -> bool:
    """Return whether a mechanism has a YAML of our format, for its URDF as it is."""
    if is_xml(machine.yaml_path):
        return False
    content = content_of(machine.yaml_path, FILE_KIND, ModelError).decode("utf-8")
    document = yaml.compose(content, Loader=yaml.SafeLoader)
    stand_ins = _entry(document, "joint_name")
    has_stand_ins = isinstance(stand_ins, yaml.SequenceNode) and bool(stand_ins.value)
    if not isinstance(_entry(document, "legcal"), yaml.MappingNode) or has_stand_ins:
        return False
    loops = _entry(document, "closed_loop")
    pairs = loops.value if isinstance(loops, yaml.SequenceNode) else []
    named = {tuple(frame.value for frame in pair.value) for pair in pairs}
    return named == {(c.frame_1, c.frame_2) for c in machine.chain.closures}


def _entry(node: yaml.Node | None, key: str) -> yaml.Node | None:
    """Return the value of a key of a mapping, or None."""
    if not isinstance(node, yaml.MappingNode):
        return None
    return next((value for name, value in node.value if name.value == key), None)


def check_closes(machine: Machine) -> None:
    """Check that a mechanism closes at home, and that its readings lead back to it."""
    pose = forward_kinematics(machine, inverse_kinematics(machine, machine.home))
    away = machine.home.inv() * pose
    shift, turn = float(np.linalg.norm(away.translation)), float(away.rotation.magnitude())
    if not max(shift / machine.size, turn) <= CLOSES:
        raise DidNotConverge(
            "the mechanism does not close at home",
            f"a pose {1e3 * shift:.2g} mm and {np.degrees(turn):.2g} deg away from it "
            "at its own readings",
            f"at most {1e3 * CLOSES * machine.size:.0e} mm and {np.degrees(CLOSES):.0e} deg",
            f"check {machine.urdf.wording.home}",
            machine.yaml_path,
        )


def reload_and_check(path: Path) -> Machine:
    """Load a mechanism after writing, and check that it closes at home.

    Loading closes the chain there; if the motors determine the pose, its readings must lead back.
    """
    machine = load_mechanism(path)
    if machine.is_determined:
        check_closes(machine)
    return machine
