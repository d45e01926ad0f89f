"""The calibrated URDF: the nominal file with new numbers at the joints, and nothing else changed.

Where R_b stands in the base link and R_e in the platform link cannot be observed, so that both are
laid on their nominal places. A joint centre moves with the origin of the joint, or of the fixed
joint under a closure's frame, that ties the leg to base or platform; the offset moves with
the slider's origin along its axis.
"""

import json
import re
from pathlib import Path

import numpy as np
import yaml

from legcal.errors import DidNotConverge, OutOfClass
from legcal.geometry.types import Array
from legcal.mechanism.axes import Step
from legcal.mechanism.bodies import Bodies, frame_link, rigid_bodies
from legcal.mechanism.kinematics import forward_kinematics, inverse_kinematics
from legcal.mechanism.leg import LegKind
from legcal.mechanism.load import load_mechanism
from legcal.mechanism.model import Mechanism
from legcal.mechanism.parameters import KinematicParameters
from legcal.mechanism.sources.read import XML_SUFFIXES
from legcal.mechanism.urdf import UrdfJoint
from legcal.report.model_files import mechanism_text
from legcal.report.urdf_patch import patch_origins, same_point

_PLAIN = re.compile(r"[A-Za-z_][A-Za-z0-9_./-]*")  # needs no quotes in YAML
CLOSES = 1e-9  # [m] and [rad], home against the pose at its own readings


def write_calibrated_urdf(
    mechanism: Mechanism, parameters: KinematicParameters, destination: Path
) -> None:
    """Write the mechanism's URDF with calibrated joint centres and offsets.

    Loading it again gives these parameters to 1e-12 m, with R_b and R_e where they were. Radii
    are not written: they absorb the bias of edges.

    Parameters
    ----------
    mechanism : Mechanism
        The nominal mechanism, as loaded.
    parameters : KinematicParameters
        Joint centres in R_b and R_e and offsets [m], in the order of ``mechanism.legs``.
    destination : Path
        The file to write.

    Raises
    ------
    OutOfClass
        If the tree ties a leg to base or platform where no origin moves that leg alone.
    """
    origins = calibrated_origins(mechanism, parameters)
    changed = {
        joint: xyz
        for joint, xyz in origins.items()
        if not same_point(xyz, np.asarray(mechanism.urdf.joints[joint].T_parent_origin.translation))
    }
    destination.write_bytes(patch_origins(mechanism.urdf.content, changed))


def calibrated_origins(mechanism: Mechanism, parameters: KinematicParameters) -> dict[str, Array]:
    """Return the new origin of every joint that carries a parameter, in its parent link [m]."""
    fixed = rigid_bodies(mechanism.urdf, (), mechanism.platform_joint)
    A_base = mechanism.T_base_Rb.apply(parameters.base_joints)
    B_platform = mechanism.T_platform_Re.apply(parameters.platform_joints)
    origins: dict[str, Array] = {}
    for j, (leg, chain) in enumerate(zip(mechanism.legs, mechanism.leg_chains, strict=True)):
        shifts = (
            (chain.steps[0], chain.steps[0].near, mechanism.base, A_base[j] - leg.A_base),
            (
                chain.steps[-1],
                chain.steps[-1].far,
                mechanism.platform,
                B_platform[j] - leg.B_platform,
            ),
        )
        for step, side, link, shift in shifts:
            joint = _tie(mechanism, fixed, step, side, link, leg.name)
            parent = fixed.T_body_link[joint.parent].rotation
            turned = parent.inv().apply(fixed.T_body_link[link].rotation.apply(shift))
            origins[joint.name] = np.asarray(joint.T_parent_origin.translation) + turned
        growth = float(parameters.offsets[j]) - leg.q0
        if leg.kind is LegKind.ACTUATED:
            slider = mechanism.urdf.joints[str(leg.prismatic)]
            axis = slider.T_parent_origin.rotation.apply(slider.axis)
            origin = np.asarray(slider.T_parent_origin.translation)
            origins[slider.name] = origin + leg.sign * growth * axis
        elif leg.kind is LegKind.CONSTANT and abs(growth) > 0.0:
            raise OutOfClass(
                f"{mechanism.urdf_path}: the length of leg '{leg.name}' could not be written: "
                "found a leg of constant length, needed one with a slider; keep its length."
            )
    return origins


def _tie(
    mechanism: Mechanism, fixed: Bodies, step: Step, side: int, link: str, leg: str
) -> UrdfJoint:
    """Return the joint whose origin moves the end of a leg on base or platform, and only that."""
    urdf, connection = mechanism.urdf, step.connection
    ours = fixed.body_of[link]
    if connection.closure is not None:
        closure = mechanism.chain.closures[connection.closure]
        return _carrier(mechanism, (closure.frame_1, closure.frame_2)[side], leg)
    joint = urdf.joints[str(connection.joint)]
    at = joint.parent if side == 0 else joint.child
    if fixed.body_of[at] == ours and side == 0:
        return joint
    if fixed.body_of[at] != ours:
        for closure in mechanism.chain.closures:
            frames = (closure.frame_1, closure.frame_2)
            bodies = [fixed.body_of[frame_link(urdf, frame)] for frame in frames]
            if closure.kind == "6d" and set(bodies) == {ours, fixed.body_of[at]}:
                return _carrier(mechanism, frames[bodies.index(ours)], leg)
    raise OutOfClass(
        f"{mechanism.urdf_path}: leg '{leg}' could not be written: found that joint "
        f"'{joint.name}' carries the link '{link}' itself, needed legs that hang from base or "
        "platform, or are closed on them; let a virtual floating joint carry the platform."
    )


def _carrier(mechanism: Mechanism, frame: str, leg: str) -> UrdfJoint:
    """Return the fixed joint under a closure's frame, which must carry nothing else."""
    urdf = mechanism.urdf
    link = frame_link(urdf, frame)
    above = [joint for joint in urdf.joints.values() if joint.child == link]
    below = [joint for joint in urdf.joints.values() if joint.parent == link]
    uses = sum(
        link in (frame_link(urdf, c.frame_1), frame_link(urdf, c.frame_2))
        for c in mechanism.chain.closures
    )
    if len(above) == 1 and not above[0].moves and not below and uses == 1:
        return above[0]
    raise OutOfClass(
        f"{mechanism.urdf_path}: leg '{leg}' could not be written: found the closure frame "
        f"'{frame}' on a link that carries other things too, needed a link of its own on a fixed "
        "joint; add one at the joint centre."
    )


def write_calibrated_yaml(mechanism: Mechanism, destination: Path, urdf_name: str) -> None:
    """Write the mechanism's YAML with ``legcal.urdf`` naming the calibrated file.

    Every other character stays as it was; the key is added where the file does not have it. A
    mechanism of another format, or without a block ``legcal``, gets a YAML with all it needs.

    Parameters
    ----------
    mechanism : Mechanism
        The nominal mechanism, as loaded.
    destination : Path
        The file to write, beside the calibrated URDF.
    urdf_name : str
        The calibrated URDF, relative to ``destination``.
    """
    if not _is_written_down(mechanism):
        destination.write_bytes(mechanism_text(mechanism, urdf_name).encode("utf-8"))
        return
    text = mechanism.yaml_path.read_bytes().decode("utf-8")
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
    """Load a mechanism that was just written and check that it closes at home."""
    mechanism = load_mechanism(path)
    check_closes(mechanism)
    return mechanism
