"""The origins of a URDF that carry the numbers of legs, and their changes for other numbers.

Each number of a leg is in the origin of a joint: A in its first joint, B in its last, the length in
its slider or a joint of its rod. For a rod on a carriage or an arm the origin of the motor joint
holds the axis, and the origin of the joint at A holds A at reading 0. An origin that moves only
this leg is a :class:`Handle`. If a tree has no such origin, because the last joint of a leg carries
the platform or a closure frame is on a shared link, a separate link is added
(:func:`with_separate_origins`).
"""

from __future__ import annotations

from collections.abc import Sequence, Set
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import RigidTransform, Rotation

from legcal.errors import OutOfClass
from legcal.geometry.motions import matrix_inverse, matrix_product, rotation_between
from legcal.geometry.types import Array
from legcal.machine.actuator import Actuator, Arm
from legcal.machine.chain import Bodies, Closure, Connection, rigid_bodies
from legcal.machine.leg import Leg, LegChain
from legcal.machine.model import Machine
from legcal.machine.parameters import legs_in_links, twist_after
from legcal.machine.urdf import Urdf, UrdfJoint, UrdfPatch, parse_urdf

_ROUNDING = 1e-14  # rotation that counts as none [rad]


def moved_origins(machine: Machine, legs: Sequence[Leg]) -> dict[str, tuple[RigidTransform, bool]]:
    """Return the new origin of each joint with a number of a leg, and whether it is rotated."""
    handles = Handles(machine.urdf, machine.chain.closures, machine.platform_joint)
    return _moved_origins(handles, machine, legs_in_links(machine, legs))


def _moved_origins(
    handles: Handles, machine: Machine, legs: Sequence[Leg]
) -> dict[str, tuple[RigidTransform, bool]]:
    """Return the same for legs in the links of base and platform."""
    origins: dict[str, tuple[RigidTransform, bool]] = {}
    moved = set[str]()  # motors of rods that are done

    def move(handle: Handle, motion: Motion, body: str) -> None:
        """Move a joint by a motion given in a link of its body."""
        joint, T_body_link = handle.joint, handles.bodies.T_body_link
        T_parent_origin, is_turned = origins.setdefault(joint.name, (joint.T_parent_origin, False))
        if motion.turn is None and not motion.shift.any():
            return
        there = RigidTransform.from_matrix(
            matrix_product(matrix_inverse(T_body_link[joint.parent]), T_body_link[body])
        )
        seen = motion.seen_from(there) if body != joint.parent else motion
        seen = seen.inv() if handle.is_inverse else seen
        origins[joint.name] = seen.of(T_parent_origin), is_turned or seen.turn is not None

    for leg, wanted in zip(machine.legs, legs, strict=True):
        chain = leg.urdf_chain
        at_base, at_platform = _ends(leg, wanted)
        grown = wanted.q0 - leg.q0, _twisted(leg, wanted, at_platform)
        if chain.is_joint:
            at_platform = _of_joint(leg, wanted, at_platform, grown[1])
        if chain.slider is not None:
            move(*_at_slider(handles, leg, chain, grown))
        elif not chain.is_joint:
            move(*_in_rod(handles, leg, chain, grown))
        first, last = chain.steps[chain.actuator is not None], chain.steps[-1]
        base, platform = machine.base, machine.platform
        if chain.actuator is not None:
            carried = _carried(leg.actuator, wanted.actuator)
            if leg.motor_label not in moved:
                move(handles.of(chain.actuator, 0, base, leg.name), carried, base)
                moved.add(leg.motor_label)
            base = handles.link(chain.actuator, 1)
            at_base = _onward(carried, leg, wanted, handles.at_zero(chain, machine.base, base))
        move(handles.of(first, 0, base, leg.name), at_base, base)
        move(handles.of(last, 1, platform, leg.name), at_platform, platform)
    return origins


def moved_arms(machine: Machine, legs: Sequence[Leg]) -> list[tuple[Arm, RigidTransform]]:
    """Return the arms that differ from the URDF, with motions of their visuals in their links."""
    handles = Handles(machine.urdf, machine.chain.closures, machine.platform_joint)
    arms = []
    for leg, wanted in zip(machine.legs, legs_in_links(machine, legs), strict=True):
        arm, other, chain = leg.arm, wanted.arm, leg.urdf_chain
        if arm is None or other is None or chain.actuator is None:
            continue
        T_base_link = handles.at_zero(chain, machine.base, arm.link)
        carried = _carried(leg.actuator, wanted.actuator)
        before = arm.line.in_frame(T_base_link.inv().as_matrix())
        line = other.line.in_frame(carried.of(T_base_link).inv().as_matrix())
        along = (before.point - line.point) @ line.axis  # the position along the line is arbitrary
        shift = line.point + along * line.axis - before.point
        motion = Motion(shift, before.point, _turn(before.axis, line.axis, directed=True))
        if motion.turn is not None or np.abs(shift).max() > _ROUNDING:
            arms.append((arm, motion.of(RigidTransform.identity())))
    return arms


def with_separate_origins(
    urdf: Urdf, closures: Sequence[Closure], machine: Machine
) -> tuple[Urdf, tuple[Closure, ...]]:
    """Return the tree of a machine and its closures with an origin for every number of a leg.

    Links are added as needed: between a joint and its child link, and for closure frames on links
    that carry other things. Our own layout needs none.

    Raises OutOfClass if a leg is welded several times between two of its joints.
    """
    changed = list(closures)
    while True:
        handles = Handles(urdf, changed, machine.platform_joint)
        try:
            _moved_origins(handles, machine, machine.legs)
        except NoOriginError as missing:
            patch, names = UrdfPatch(urdf.content), {*urdf.links, *urdf.joints}
            if missing.joint is not None:
                below = urdf.joints[missing.joint].child
                link, joint = _unused(f"{missing.joint}_mount", names)
                patch.add_link_below(missing.joint, link, joint)
                changed = [_with_frame(closure, missing.joint, below) for closure in changed]
            else:
                frame = str(missing.frame)
                link, joint = _unused(f"{frame}_mount", names)
                patch.add_frame(urdf.link_of(frame), link, link, joint, RigidTransform.identity())
                # In this closure only: closures that share a frame get a link each.
                changed[missing.closure] = _with_frame(changed[missing.closure], frame, link)
            urdf = replace(parse_urdf(urdf.path, patch.content()), wording=urdf.wording)
        else:
            return urdf, tuple(changed)


def _unused(name: str, taken: Set[str]) -> tuple[str, str]:
    """Return free names of a link and of the fixed joint above it."""
    while name in taken or f"{name}_joint" in taken:
        name += "_"
    return name, f"{name}_joint"


def _with_frame(closure: Closure, old: str, new: str) -> Closure:
    """Return a closure with one of its frames renamed."""
    first, second = (new if frame == old else frame for frame in closure.frames)
    return Closure(closure.kind, (first, second))


class Handle(NamedTuple):
    """The joint of the URDF whose origin is moved."""

    joint: UrdfJoint
    is_inverse: bool  # its origin moves the body relative to the joint of the leg


class NoOriginError(LookupError):
    """There is no origin that moves a joint or a closure frame alone."""

    def __init__(
        self, *, joint: str | None = None, frame: str | None = None, closure: int = -1
    ) -> None:
        super().__init__(joint, frame, closure)
        self.joint, self.frame, self.closure = joint, frame, closure


class Handles:
    """The origins of a URDF that move the joints of legs in the bodies of a machine."""

    def __init__(self, urdf: Urdf, closures: Sequence[Closure], platform_joint: str | None) -> None:
        self._urdf = urdf
        self._closures = closures
        self._fixed = rigid_bodies(urdf, (), platform_joint)
        self.bodies: Bodies = rigid_bodies(urdf, closures, platform_joint)

    def of(self, step: Connection, side: int, body: str, leg: str) -> Handle:
        """Return the handle of a joint in the near (0) or far body (1)."""
        of_parent = side == 0 if step.is_forward else side == 1
        if step.closure is not None:
            return Handle(self._carrier(step.closure, 0 if of_parent else 1), False)
        joint = self._urdf.joints[str(step.joint)]
        if of_parent:
            return Handle(joint, False)
        if self._fixed.body_of[joint.child] == self._fixed.body_of[body]:
            return Handle(self._onward(joint, body), True)
        return self._weld(joint, body, leg)

    def link(self, step: Connection, side: int) -> str:
        """Return the link on the near (0) or far side (1) of a joint."""
        if step.closure is not None:
            links = [self._urdf.link_of(frame) for frame in self._closures[step.closure].frames]
        else:
            joint = self._urdf.joints[str(step.joint)]
            links = [joint.parent, joint.child]
        return links[side if step.is_forward else 1 - side]

    def at_zero(self, chain: LegChain, base: str, link: str) -> RigidTransform:
        """Return the pose in the base link of the link behind a motor, at reading zero."""
        T_base_body = matrix_inverse(self.bodies.T_body_link[base])
        T_body_arm = matrix_product(matrix_inverse(chain.poses[0]), chain.poses[1])
        T_arm_link = self.bodies.T_body_link[link]
        return RigidTransform.from_matrix(T_base_body @ T_body_arm @ T_arm_link)

    def _onward(self, joint: UrdfJoint, body: str) -> UrdfJoint:
        """Return the fixed joint from the child of a joint to the rest of its body."""
        for onward in self._urdf.joints_above(body):
            if onward.parent == joint.child and self._carries_only(joint.child, onward):
                return onward
        raise NoOriginError(joint=joint.name)

    def _weld(self, joint: UrdfJoint, body: str, leg: str) -> Handle:
        """Return the fixed joint under a frame of the closure that welds a leg to a body."""
        ours, theirs = self._fixed.body_of[body], self._fixed.body_of[joint.child]
        problem: NoOriginError | None = None
        for i, closure in enumerate(self._closures):
            on = [self._fixed.body_of[self._urdf.link_of(frame)] for frame in closure.frames]
            if closure.kind == "6d" and set(on) == {ours, theirs}:
                for wanted in (ours, theirs):
                    try:
                        carrier = self._carrier(i, on.index(wanted))
                    except NoOriginError as error:
                        problem = problem or error
                        continue
                    return Handle(carrier, wanted == theirs)
        if problem is not None:
            raise problem
        raise OutOfClass(
            f"leg '{leg}' is not supported",
            f"several welds between joint '{joint.name}' and the link '{body}'",
            "one, which moves with the parameters of the leg",
            "close the leg once",
            self._urdf.path,
        )

    def _carrier(self, closure: int, side: int) -> UrdfJoint:
        """Return the fixed joint under a closure frame, which must carry nothing else."""
        frame = self._closures[closure].frames[side]
        link = self._urdf.link_of(frame)
        above = self._urdf.above.get(link)
        if above is not None and not above.moves and self._carries_only(link, None, closures=1):
            return above
        raise NoOriginError(frame=frame, closure=closure)

    def _carries_only(self, link: str, below: UrdfJoint | None, closures: int = 0) -> bool:
        """Return whether a link carries at most one joint, and this number of closure frames."""
        joints = self._urdf.below[link]
        frames = [frame for closure in self._closures for frame in closure.frames]
        uses = sum(self._urdf.link_of(frame) == link for frame in frames)
        return joints == ([] if below is None else [below]) and uses == closures


@dataclass(frozen=True, eq=False)
class Motion:
    """A rigid motion in a frame: p -> about + R (p - about) + shift."""

    shift: Array  # (3,) displacement of the point *about* [m]
    about: Array  # (3,) [m]
    turn: Rotation | None = None  # R; None without rotation, which avoids rounding

    def inv(self) -> Motion:
        """Return the inverse motion."""
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


def _carried(actuator: Actuator | None, wanted: Actuator | None) -> Motion:
    """Return the motion of a motor in the base link: its axis, and its point if it turns."""
    if actuator is None or wanted is None:
        raise ValueError("a rod that hangs on a motor has its numbers")
    turn = _turn(actuator.axis, wanted.axis, directed=True)
    shift = wanted.point - actuator.point if actuator.turns else np.zeros(3)
    along = shift @ wanted.axis  # the position along the axis is arbitrary
    return Motion(shift - along * wanted.axis, actuator.point, turn)


def _onward(carried: Motion, leg: Leg, wanted: Leg, T_base_arm: RigidTransform) -> Motion:
    """Return the motion of the joint at A in the arm at reading zero, after that of its motor."""
    A = np.asarray(carried.of(RigidTransform.from_translation(leg.A)).translation)
    axis = leg.base_axis
    if axis is not None and carried.turn is not None:
        axis = np.asarray(carried.turn.apply(axis))
    onward = Motion(wanted.A - A, A, _turn(axis, wanted.base_axis))
    return onward.seen_from(carried.of(T_base_arm).inv())


def _ends(leg: Leg, wanted: Leg) -> tuple[Motion, Motion]:
    """Return the motions of the ends of a leg in the links of base and platform."""
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
    """Return the smallest rotation of an axis onto another, as lines unless directed."""
    if axis is None or wanted is None:
        return None
    if not directed and axis @ wanted < 0.0:
        wanted = -wanted
    turn = rotation_between(axis, wanted)
    return None if turn.magnitude() < _ROUNDING else turn


def _twisted(leg: Leg, wanted: Leg, at_platform: Motion) -> float:
    """Return the rotation of the upper half of a leg about it, relative to its end [rad]."""
    if leg.twist is None or wanted.twist is None:
        return 0.0
    carried = leg.twist
    if at_platform.turn is not None:
        carried = float(twist_after(leg, at_platform.turn) or 0.0)
    twist = wanted.twist - carried
    twist -= np.pi * np.round(twist / np.pi)
    return float(twist) if abs(twist) > _ROUNDING else 0.0


def _of_joint(leg: Leg, wanted: Leg, at_platform: Motion, twist: float) -> Motion:
    """Return the motion in the platform of the joint that holds it: platform and leg are one."""
    u, v = leg.platform_axis, wanted.platform_axis
    if u is None or v is None:
        raise ValueError("a leg that is fixed to the platform has a direction there")
    centre, turn = leg.B - leg.q0 * u, at_platform.turn
    if twist != 0.0:
        back = Rotation.from_rotvec(-twist * v)
        turn = back if turn is None else back * turn
    return Motion(wanted.B - wanted.q0 * v - centre, centre, turn)


def _screw(along: Array, point: Array, grown: tuple[float, float]) -> Motion:
    """Return the motion of the upper half of a leg: growth along its line, rotation about it."""
    growth, twist = grown
    turn = None if twist == 0.0 else Rotation.from_rotvec(twist * along)
    return Motion(growth * along, point, turn)


def _at_slider(
    handles: Handles, leg: Leg, chain: LegChain, grown: tuple[float, float]
) -> tuple[Handle, Motion, str]:
    """Return handle and motion of the upper half of a leg at its slider, and the body of these."""
    slider = chain.slider
    if slider is None:
        raise ValueError("a rod has no slider")
    side = 0 if slider.is_forward else 1  # of the parent of the joint
    body = slider.bodies[side]
    if slider.is_forward:
        point, along = chain.line_in(chain.n_lower, chain.A)
    else:
        point, along = chain.line_in(chain.n_upper, chain.B)
    handle = handles.of(slider, side, body, leg.name)._replace(is_inverse=not slider.is_forward)
    return handle, _screw(leg.sign * along, point, grown), body


def _in_rod(
    handles: Handles, leg: Leg, chain: LegChain, grown: tuple[float, float]
) -> tuple[Handle, Motion, str]:
    """Return handle and motion of the upper end of a rod against its lower one, and the body."""
    below, above = chain.steps[chain.n_lower - 1], chain.steps[chain.n_lower]
    body = chain.bodies[chain.n_lower - 1]
    try:
        handle = handles.of(above, 0, handles.link(below, 1), leg.name)
    except NoOriginError:
        handle = handles.of(below, 1, handles.link(above, 0), leg.name)
        handle = handle._replace(is_inverse=not handle.is_inverse)
    point, along = chain.line_in(chain.n_lower, chain.A)
    return handle, _screw(along, point, grown), body
