"""Models written with other numbers: the URDF by moved origins, the YAML beside it.

A leg's number is carried by the origin of a joint. Where an origin moves that leg alone it is a
:class:`Handle`, and :func:`moved_origins` says where all of them go; what is written is loaded
again and checked. Axes count as turns of the nominal ones, see :func:`turns_between`.
"""

from __future__ import annotations

import json
import os
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import NamedTuple

import numpy as np
import yaml
from scipy.spatial.transform import RigidTransform, Rotation

from legcal.errors import DidNotConverge, OutOfClass, OutOfResources, UsageError
from legcal.files import motion_to_xyz_quat, write_atomically
from legcal.geometry import Array, roll_pitch_yaw, rotation_between
from legcal.machine.bodies import Bodies, frame_link, rigid_bodies
from legcal.machine.files import FOLDER_YAML
from legcal.machine.formats import XML_SUFFIXES
from legcal.machine.kinematics import forward_kinematics, inverse_kinematics
from legcal.machine.leg import Leg, LegChain, LegKind, Step
from legcal.machine.loader import load_mechanism
from legcal.machine.model import Machine
from legcal.machine.parameters import (
    Parametrization,
    in_links,
    moved_legs,
    turn_of,
    twist_after,
    vector_of,
)
from legcal.machine.schema import mechanism_yaml
from legcal.machine.urdf import UrdfJoint, UrdfPatch


class Handle(NamedTuple):
    """The joint of the URDF whose origin is moved."""

    joint: UrdfJoint
    is_inverse: bool  # whether its origin moves the body against the leg's joint


class Handles:
    """What moves the joints of legs in the bodies of a mechanism."""

    def __init__(self, machine: Machine) -> None:
        self._mechanism = machine
        self._urdf = machine.urdf
        self._closures = machine.chain.closures
        self._fixed = rigid_bodies(self._urdf, (), machine.platform_joint)
        self.bodies: Bodies = rigid_bodies(self._urdf, self._closures, machine.platform_joint)
        self._above = {joint.child: joint for joint in self._urdf.joints.values()}

    def of(self, step: Step, side: int, body: str, leg: str) -> Handle:
        """Return what moves a joint in a body."""
        connection = step.connection
        if connection.closure is not None:
            closure = self._closures[connection.closure]
            return Handle(self._carrier((closure.frame_1, closure.frame_2)[side], leg), False)
        joint = self._urdf.joints[str(connection.joint)]
        if side == 0:
            return Handle(joint, False)
        if self._fixed.body_of[joint.child] == self._fixed.body_of[body]:
            return Handle(self._onward(joint, body, leg), True)
        return self._weld(joint, body, leg)

    def link(self, step: Step, side: int) -> str:
        """Return the link that carries one side of a joint."""
        connection = step.connection
        if connection.closure is not None:
            closure = self._closures[connection.closure]
            return frame_link(self._urdf, (closure.frame_1, closure.frame_2)[side])
        joint = self._urdf.joints[str(connection.joint)]
        return (joint.parent, joint.child)[side]

    def _onward(self, joint: UrdfJoint, body: str, leg: str) -> UrdfJoint:
        """Return the fixed joint that leads from the child of a joint to the rest of its body."""
        link, onward = body, None
        while link != joint.child and link in self._above:
            onward = self._above[link]
            link = onward.parent
        if link == joint.child and onward is not None and self._carries_only(link, onward):
            return onward
        raise OutOfClass(
            f"{self._mechanism.urdf_path}: leg '{leg}' could not be written: found that joint "
            f"'{joint.name}' carries the link '{body}' itself, needed legs that hang from base or "
            "platform, or are closed on them; let a virtual floating joint carry the platform, or "
            "put a link on a fixed joint between them."
        )

    def _weld(self, joint: UrdfJoint, body: str, leg: str) -> Handle:
        """Return the fixed joint under a frame of the closure that welds a leg to a body."""
        ours, theirs = self._fixed.body_of[body], self._fixed.body_of[joint.child]
        problem: OutOfClass | None = None
        for closure in self._closures:
            frames = closure.frame_1, closure.frame_2
            on = [self._fixed.body_of[frame_link(self._urdf, frame)] for frame in frames]
            if closure.kind == "6d" and set(on) == {ours, theirs}:
                for wanted in (ours, theirs):
                    try:
                        carrier = self._carrier(frames[on.index(wanted)], leg)
                    except OutOfClass as error:
                        problem = problem or error
                        continue
                    return Handle(carrier, wanted == theirs)
        if problem is not None:
            raise problem
        raise OutOfClass(
            f"{self._mechanism.urdf_path}: leg '{leg}' could not be written: found several welds "
            f"between joint '{joint.name}' and the link '{body}', needed one; close the leg once."
        )

    def _carrier(self, frame: str, leg: str) -> UrdfJoint:
        """Return the fixed joint under a closure's frame, which must carry nothing else."""
        link = frame_link(self._urdf, frame)
        above = self._above.get(link)
        if above is not None and not above.moves and self._carries_only(link, None, closures=1):
            return above
        raise OutOfClass(
            f"{self._mechanism.urdf_path}: leg '{leg}' could not be written: found the closure "
            f"frame '{frame}' on a link that carries other things too, needed a link of its own on "
            "a fixed joint; add one at the joint centre."
        )

    def _carries_only(self, link: str, below: UrdfJoint | None, closures: int = 0) -> bool:
        """Say whether a link carries one joint or none, and so many frames of closures."""
        found = [joint for joint in self._urdf.joints.values() if joint.parent == link]
        frames = [f for c in self._closures for f in (c.frame_1, c.frame_2)]
        uses = sum(frame_link(self._urdf, frame) == link for frame in frames)
        return found == ([] if below is None else [below]) and uses == closures


ROUNDING = 1e-14  # [rad]: what turns less does not turn
ROUNDING_M = 4e-16  # [m]: what moves less does not move


@dataclass(frozen=True, eq=False)
class Motion:
    """A rigid motion in a frame: p -> about + R (p - about) + shift."""

    shift: Array  # (3,) displacement, and the point that it is the displacement of [m]
    about: Array  # (3,) displacement, and the point that it is the displacement of [m]
    turn: Rotation | None = None  # R; None where nothing turns, so that nothing is rounded

    def inv(self) -> Motion:
        """Return the motion back."""
        turn = None if self.turn is None else self.turn.inv()
        return Motion(-self.shift, self.about + self.shift, turn)

    def seen_from(self, T_to_from: RigidTransform) -> Motion:
        """Return the same motion in another frame."""
        R = T_to_from.rotation
        turn = None if self.turn is None else R * self.turn * R.inv()
        return Motion(
            np.asarray(R.apply(self.shift)), np.asarray(T_to_from.apply(self.about)), turn
        )

    def of(self, T: RigidTransform) -> RigidTransform:
        """Return a pose after the motion."""
        if self.turn is None:
            return RigidTransform.from_components(T.translation + self.shift, T.rotation)
        arm = self.turn.apply(T.translation - self.about)
        return RigidTransform.from_components(self.about + arm + self.shift, self.turn * T.rotation)


def moved_origins(machine: Machine, legs: Sequence[Leg]) -> dict[str, tuple[RigidTransform, bool]]:
    """Return the new origin of every joint that carries a number of a leg, and if it is turned."""
    handles = Handles(machine)
    found: dict[str, tuple[RigidTransform, bool]] = {}

    def move(handle: Handle, motion: Motion, body: str) -> None:
        """Move a joint by a motion that is given in a link of its body."""
        joint, T_body_link = handle.joint, handles.bodies.T_body_link
        T_parent_origin, is_turned = found.get(joint.name, (joint.T_parent_origin, False))
        there = T_body_link[joint.parent].inv() * T_body_link[body]
        seen = motion.seen_from(there) if body != joint.parent else motion
        seen = seen.inv() if handle.is_inverse else seen
        found[joint.name] = seen.of(T_parent_origin), is_turned or seen.turn is not None

    for leg, wanted in zip(machine.legs, in_links(machine, legs), strict=True):
        chain = _chain(leg)
        at_base, at_platform = _ends(leg, wanted)
        grown = wanted.q0 - leg.q0, _twisted(leg, wanted, at_platform)
        if chain.slider is not None:
            move(*_at_slider(handles, leg, chain, grown))
        elif any(grown):
            move(*_in_rod(handles, leg, chain, grown))
        first, last = chain.steps[0], chain.steps[-1]
        base, platform = machine.base, machine.platform
        move(handles.of(first, first.near, base, leg.name), at_base, base)
        move(handles.of(last, last.far, platform, leg.name), at_platform, platform)
    return found


def _chain(leg: Leg) -> LegChain:
    """Return the joints of a leg that a file describes."""
    if leg.chain is None:
        raise ValueError("a leg that no file describes has no joints to write")
    return leg.chain


def _ends(leg: Leg, wanted: Leg) -> tuple[Motion, Motion]:
    """Return how the ends of a leg move in the links of base and platform."""
    is_fixed = leg.is_fixed_to_platform
    return (
        Motion(wanted.A - leg.A, leg.A, _turn(leg.base_axis, wanted.base_axis)),
        Motion(
            wanted.B - leg.B,
            leg.B,
            _turn(leg.platform_axis, wanted.platform_axis, directed=is_fixed),
        ),
    )


def _turn(axis: Array | None, wanted: Array | None, *, directed: bool = False) -> Rotation | None:
    """Return the smallest rotation of an axis, a line unless it is directed, onto another."""
    if axis is None or wanted is None:
        return None
    if not directed and axis @ wanted < 0.0:
        wanted = -wanted
    turn = rotation_between(axis, wanted)
    return None if turn.magnitude() < ROUNDING else turn


def _twisted(leg: Leg, wanted: Leg, at_platform: Motion) -> float:
    """Return how far the upper half of a leg turns about it, beside what its end does [rad]."""
    if leg.twist is None or wanted.twist is None:
        return 0.0
    carried = leg.twist
    if at_platform.turn is not None:
        carried = float(twist_after(leg, at_platform.turn) or 0.0)
    twist = wanted.twist - carried
    twist -= np.pi * np.round(twist / np.pi)
    return float(twist) if abs(twist) > ROUNDING else 0.0


def _screw(along: Array, point: Array, grown: tuple[float, float]) -> Motion:
    """Return the motion of the upper half of a leg: growth along its line, and turn about it."""
    growth, twist = grown
    turn = None if twist == 0.0 else Rotation.from_rotvec(twist * along)
    return Motion(growth * along, point, turn)


def _at_slider(
    handles: Handles, leg: Leg, chain: LegChain, grown: tuple[float, float]
) -> tuple[Handle, Motion, str]:
    """Return what moves the upper half of a leg at its slider, how, and the body that says so."""
    slider = chain.slider
    if slider is None:
        raise ValueError("a rod has no slider")
    body = slider.connection.bodies[0]  # that of the joint's parent
    if slider.near == 0:
        point, along = chain.line_in(chain.n_lower, chain.A)
    else:
        point, along = chain.line_in(chain.n_upper, chain.B)
    handle = handles.of(slider, 0, body, leg.name)._replace(is_inverse=slider.near != 0)
    return handle, _screw(leg.sign * along, point, grown), body


def _in_rod(
    handles: Handles, leg: Leg, chain: LegChain, grown: tuple[float, float]
) -> tuple[Handle, Motion, str]:
    """Return what moves the upper end of a rod against its lower one, how, and the body."""
    below, above = chain.steps[chain.n_lower - 1], chain.steps[chain.n_lower]
    body = chain.bodies[chain.n_lower - 1]
    try:
        handle = handles.of(above, above.near, handles.link(below, below.far), leg.name)
    except OutOfClass:
        handle = handles.of(below, below.far, handles.link(above, above.near), leg.name)
        handle = handle._replace(is_inverse=not handle.is_inverse)
    point, along = chain.line_in(chain.n_lower, chain.A)
    return handle, _screw(along, point, grown), body


def mechanism_text(machine: Machine, urdf: str) -> str:
    """Return the YAML of a mechanism, complete."""
    return mechanism_yaml(
        [(c.frame_1, c.frame_2, c.kind) for c in machine.chain.closures],
        [str(leg.prismatic) for leg in machine.legs if leg.kind is LegKind.ACTUATED],
        {
            "urdf": urdf,
            "base": machine.base,
            "platform": machine.platform,
            "platform_joint": machine.platform_joint,
            "base_frame": [machine.leg_names[j] for j in machine.frame_legs],
            "home": motion_to_xyz_quat(machine.home),
            "legs": {leg.name: _joint_of(machine, leg) for leg in machine.legs},
        },
    )


def model_name(machine: Machine) -> str:
    """Return the name that the files of a mechanism get: that of its file, or of its folder."""
    path = machine.yaml_path
    return path.resolve().parent.name if path.name == FOLDER_YAML else path.stem


def write_model(machine: Machine, folder: Path) -> tuple[Path, Path]:
    """Write ``models/NAME.yaml`` and ``urdf/NAME.urdf`` of a mechanism.

    A URDF that was read as it stands is copied byte for byte.
    """
    name = model_name(machine)
    places = folder / "models" / f"{name}.yaml", folder / "urdf" / f"{name}.urdf"
    there = [str(path) for path in places if os.path.lexists(path)]
    if there:
        raise UsageError(
            f"{machine.yaml_path}: the model '{name}' could not be written: found "
            f"{' and '.join(there)} already there, needed new files; give another folder."
        )
    try:
        for path in places:
            path.parent.mkdir(parents=True, exist_ok=True)
        write_atomically(places[1], machine.urdf.content)
        text = mechanism_text(machine, f"../urdf/{name}.urdf")
        write_atomically(places[0], text.encode())  # last: a URDF alone is no model
    except OSError as error:
        raise OutOfResources(
            f"{folder}: the model could not be written: found '{error.strerror}', needed a folder "
            "that takes it; free space, correct permissions, or give another folder."
        ) from error
    return places


def _joint_of(machine: Machine, leg: Leg) -> str:
    """Return a joint that stands for a leg: its slider, or any other on it."""
    if leg.prismatic is not None:
        return leg.prismatic
    chain = _chain(leg)
    moving = [step.connection.joint for step in chain.steps if step.connection.joint]
    fixed = [joint.name for joint in machine.urdf.joints.values() if joint.child in chain.bodies]
    return str([*moving, *fixed][0])


_PLAIN = re.compile(r"[A-Za-z_][A-Za-z0-9_./-]*")  # needs no quotes in YAML
CLOSES = 1e-9  # [m] and [rad], home against the pose at its own readings


def write_urdf(machine: Machine, legs: Sequence[Leg], destination: Path) -> None:
    """Write the mechanism's URDF with other numbers of its legs, of whatever class.

    Loading it again gives these numbers to 1e-12 m and rad, with R_b and R_e where they were.
    Radii are not written: they absorb the bias of edges. Nor is home looked at: with other rods
    or axes the mechanism may close elsewhere.
    """
    patch = UrdfPatch(machine.urdf.content)
    for name, (after, is_turned) in moved_origins(machine, legs).items():
        before = machine.urdf.joints[name].T_parent_origin
        xyz = np.asarray(after.translation)
        stays = np.abs(xyz - before.translation).max() < ROUNDING_M
        rpy = roll_pitch_yaw(after.rotation.as_matrix()) if is_turned else None
        if rpy is not None or not stays:
            patch.set_origin(name, None if stays else xyz, rpy)
    destination.write_bytes(patch.content())


def write_calibrated_yaml(
    machine: Machine, destination: Path, urdf_name: str, home: RigidTransform | None = None
) -> None:
    """Write the mechanism's YAML with ``legcal.urdf`` naming the calibrated file.

    Every other character stays as it was, but for the numbers of ``legcal.home`` where home moves;
    the key is added where the file does not have it. A mechanism of another format, or without a
    block ``legcal``, gets a YAML with all it needs.
    """
    if not _is_written_down(machine):
        there = machine if home is None else replace(machine, home=home)
        destination.write_bytes(mechanism_text(there, urdf_name).encode("utf-8"))
        return
    text = machine.yaml_path.read_bytes().decode("utf-8")
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


def _is_written_down(machine: Machine) -> bool:
    """Say whether the YAML of a mechanism is one of ours, and holds of the URDF as it is."""
    if machine.yaml_path.suffix.lower() in XML_SUFFIXES:
        return False
    content = machine.yaml_path.read_bytes().decode("utf-8")
    document = yaml.compose(content, Loader=yaml.SafeLoader)
    stand_ins = _entry(document, "joint_name")
    has_stand_ins = isinstance(stand_ins, yaml.SequenceNode) and bool(stand_ins.value)
    return isinstance(_entry(document, "legcal"), yaml.MappingNode) and not has_stand_ins


def _entry(node: yaml.Node | None, key: str) -> yaml.Node | None:
    """Return the value of a key of a mapping, or None."""
    if not isinstance(node, yaml.MappingNode):
        return None
    return next((value for name, value in node.value if name.value == key), None)


def check_closes(machine: Machine) -> None:
    """Check that a mechanism closes at home: its own readings lead back to it."""
    found = forward_kinematics(machine, inverse_kinematics(machine, machine.home))
    away = machine.home.inv() * found
    shift, turn = float(np.linalg.norm(away.translation)), float(away.rotation.magnitude())
    if not max(shift, turn) <= CLOSES:
        raise DidNotConverge(
            f"{machine.yaml_path}: the mechanism does not close at home: found a pose "
            f"{1e3 * shift:.2g} mm and {np.degrees(turn):.2g} deg away from it at its own "
            f"readings, needed at most {1e3 * CLOSES:.0e} mm and {np.degrees(CLOSES):.0e} deg; "
            "check legcal.home."
        )


def reload_and_check(path: Path) -> Machine:
    """Load a mechanism that was just written and check that it closes at home.

    Loading closes the chain there; where the motors determine the pose they must lead back to it.
    """
    machine = load_mechanism(path)
    if machine.is_determined:
        check_closes(machine)
    return machine


_STEP = 1e-6  # [m or rad]

Axes = Mapping[str, Sequence[float]]  # by leg name, in R_b or R_e


def nominal_axes(
    leg_names: Sequence[str], nominal: Sequence[Leg]
) -> dict[str, dict[str, list[float]]]:
    """Return the axes that turns count from, at the base in R_b and at the platform in R_e."""
    named = list(zip(leg_names, nominal, strict=True))
    return {
        "base": {name: leg.base_axis.tolist() for name, leg in named if leg.base_axis is not None},
        "platform": {
            name: leg.platform_axis.tolist() for name, leg in named if leg.platform_axis is not None
        },
    }


def turns_between(
    parametrization: Parametrization,
    calibrated: Sequence[Leg],
    nominal: Sequence[Leg],
) -> Array:
    """Return the derivative (p, p) of parameters with calibrated axes by those with nominal ones.

    Twists, which are tied to axes, depend on these and on the turns of the axes.
    """
    by_step = []
    for start in (calibrated, nominal):
        columns = []
        for step in _STEP * np.eye(len(parametrization)):
            ahead, behind = (
                vector_of(parametrization, moved_legs(calibrated, parametrization.place, by), start)
                for by in (step, -step)
            )
            columns.append((ahead - behind) / (2.0 * _STEP))
        by_step.append(np.column_stack(columns))
    return np.asarray(np.linalg.solve(by_step[1].T, by_step[0].T).T)


def calibrated_axis(
    nominal: Sequence[float], leg: str, side: str, values: Mapping[str, float]
) -> Array:
    """Return the axis (3,) that a result has, from the nominal one and its turns."""
    w = np.array([values.get(f"{leg}.{side}_axis.{k}", 0.0) for k in (1, 2)])
    return np.asarray(turn_of(np.array(nominal), w).apply(nominal))
