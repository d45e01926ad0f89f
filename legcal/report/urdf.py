"""The calibrated URDF: the nominal file with new numbers at the joints, and nothing else changed.

Where R_b stands in the base link and R_e in the platform link cannot be observed, so that both are
laid on their nominal places.
"""

import json
import re
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import yaml
from scipy.spatial.transform import RigidTransform

from legcal.errors import DidNotConverge
from legcal.geometry.frames import motion_to_xyz_quat, roll_pitch_yaw
from legcal.mechanism.kinematics import forward_kinematics, inverse_kinematics
from legcal.mechanism.leg_geometry import LegGeometry
from legcal.mechanism.load import load_mechanism
from legcal.mechanism.model import Mechanism
from legcal.mechanism.sources.read import XML_SUFFIXES
from legcal.report.leg_origins import moved_origins
from legcal.report.model_files import mechanism_text
from legcal.report.urdf_patch import Origin, patch_origins, same_point

_PLAIN = re.compile(r"[A-Za-z_][A-Za-z0-9_./-]*")  # needs no quotes in YAML
CLOSES = 1e-9  # [m] and [rad], home against the pose at its own readings


def write_urdf(mechanism: Mechanism, legs: Sequence[LegGeometry], destination: Path) -> None:
    """Write the mechanism's URDF with other numbers of its legs, of whatever class.

    Loading it again gives these numbers to 1e-12 m and rad, with R_b and R_e where they were.
    Radii are not written: they absorb the bias of edges. Nor is home looked at: with other rods
    or axes the mechanism may close elsewhere.

    Parameters
    ----------
    mechanism : Mechanism
        The nominal mechanism, as loaded.
    legs : sequence of LegGeometry
        The legs in R_b and R_e, in the order of ``mechanism.legs``. B of a leg that is fixed
        to the platform is where the platform link's origin has its foot on the leg.
    destination : Path
        The file to write.

    Raises
    ------
    OutOfClass
        If the tree ties a leg to base or platform where no origin moves that leg alone.
    """
    changed: dict[str, Origin] = {}
    for name, moved in moved_origins(mechanism, legs).items():
        before, after = mechanism.urdf.joints[name].T_parent_origin, moved.T_parent_origin
        xyz, rpy = np.asarray(after.translation), None
        if moved.is_turned:
            rpy = roll_pitch_yaw(after.rotation.as_matrix())
        stays = same_point(xyz, np.asarray(before.translation))
        if rpy is not None or not stays:
            changed[name] = Origin(None if stays else xyz, rpy)
    destination.write_bytes(patch_origins(mechanism.urdf.content, changed))


def write_calibrated_yaml(
    mechanism: Mechanism, destination: Path, urdf_name: str, home: RigidTransform | None = None
) -> None:
    """Write the mechanism's YAML with ``legcal.urdf`` naming the calibrated file.

    Every other character stays as it was, but for the numbers of ``legcal.home`` where home moves;
    the key is added where the file does not have it. A mechanism of another format, or without a
    block ``legcal``, gets a YAML with all it needs.

    Parameters
    ----------
    mechanism : Mechanism
        The nominal mechanism, as loaded.
    destination : Path
        The file to write, beside the calibrated URDF.
    urdf_name : str
        The calibrated URDF, relative to ``destination``.
    home : RigidTransform, optional
        T_base_platform where the calibrated legs close, if not where the nominal ones do.
    """
    if not _is_written_down(mechanism):
        there = mechanism if home is None else replace(mechanism, home=home)
        destination.write_bytes(mechanism_text(there, urdf_name).encode("utf-8"))
        return
    text = mechanism.yaml_path.read_bytes().decode("utf-8")
    if home is not None:
        text = _with_home(text, home)
    value = urdf_name if _PLAIN.fullmatch(urdf_name) else json.dumps(urdf_name)
    block = _entry(yaml.compose(text, Loader=yaml.SafeLoader), "legcal")
    written = None if block is None else _entry(block, "urdf")
    if written is not None:
        text = text[: written.start_mark.index] + value + text[written.end_mark.index :]
    elif isinstance(block, yaml.MappingNode) and block.value:
        first = block.value[0][0].start_mark
        separator = ", " if block.flow_style else "\n" + " " * first.column
        text = f"{text[: first.index]}urdf: {value}{separator}{text[first.index :]}"
    destination.write_bytes(text.encode("utf-8"))


def _with_home(text: str, home: RigidTransform) -> str:
    """Return the text of a YAML with other numbers in ``legcal.home``, if it has one."""
    written = _entry(_entry(yaml.compose(text, Loader=yaml.SafeLoader), "legcal"), "home")
    numbers = []
    for key, values in motion_to_xyz_quat(home).items():
        entry = _entry(written, key)
        if isinstance(entry, yaml.SequenceNode):
            numbers += list(zip(entry.value, values, strict=True))
    for node, value in sorted(numbers, key=lambda number: -number[0].start_mark.index):
        text = text[: node.start_mark.index] + repr(value) + text[node.end_mark.index :]
    return text


def _is_written_down(mechanism: Mechanism) -> bool:
    """Say whether the YAML of a mechanism is one of ours, and holds of the URDF as it is."""
    if mechanism.yaml_path.suffix.lower() in XML_SUFFIXES:
        return False
    content = mechanism.yaml_path.read_bytes().decode("utf-8")
    document = yaml.compose(content, Loader=yaml.SafeLoader)
    stand_ins = _entry(document, "joint_name")
    has_stand_ins = isinstance(stand_ins, yaml.SequenceNode) and bool(stand_ins.value)
    return isinstance(_entry(document, "legcal"), yaml.MappingNode) and not has_stand_ins


def _entry(node: yaml.Node | None, key: str) -> yaml.Node | None:
    """Return the value of a key of a mapping, or None."""
    if not isinstance(node, yaml.MappingNode):
        return None
    return next((value for name, value in node.value if name.value == key), None)


def check_closes(mechanism: Mechanism) -> None:
    """Check that a mechanism closes at home: its own readings lead back to it.

    Parameters
    ----------
    mechanism : Mechanism
        The mechanism, loaded from the files in question.

    Raises
    ------
    DidNotConverge
        If no closed pose is found there, or another one.
    """
    found = forward_kinematics(mechanism, inverse_kinematics(mechanism, mechanism.home))
    away = mechanism.home.inv() * found
    shift, turn = float(np.linalg.norm(away.translation)), float(away.rotation.magnitude())
    if not max(shift, turn) <= CLOSES:
        raise DidNotConverge(
            f"{mechanism.yaml_path}: the mechanism does not close at home: found a pose "
            f"{1e3 * shift:.2g} mm and {np.degrees(turn):.2g} deg away from it at its own "
            f"readings, needed at most {1e3 * CLOSES:.0e} mm and {np.degrees(CLOSES):.0e} deg; "
            "check legcal.home."
        )


def reload_and_check(path: Path) -> Mechanism:
    """Load a mechanism that was just written and check that it closes at home.

    Loading closes the chain there; where the motors determine the pose they must lead back to it.
    """
    mechanism = load_mechanism(path)
    if mechanism.is_determined:
        check_closes(mechanism)
    return mechanism
