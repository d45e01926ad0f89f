"""A new model of a described machine: its YAML and its URDF, written and loaded."""

import os
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from legcal.errors import LegcalError, OutOfResources, Problem, UsageError
from legcal.files.folder import temporary_folder
from legcal.files.published import write_schemas
from legcal.geometry.lines import cross, normal_basis
from legcal.geometry.types import Array
from legcal.machine.actuator import Actuator
from legcal.machine.assembly import Assembled, AssembledLeg, assemble
from legcal.machine.description import Description
from legcal.machine.files import mechanism_yaml, motor_entries
from legcal.machine.leg import JointType, LegKind
from legcal.machine.loader import load_mechanism
from legcal.machine.model import Machine
from legcal.machine.spanning_tree import (
    UrdfBuilder,
    axis_xml,
    box_xml,
    limit_xml,
    origin_xml_at,
    visual_xml,
)

TURN = (-3.15, 3.15)  # limits of revolutes [rad]
VISIBLE = 0.9  # length of tube and rod together, relative to the shortest leg
_AXES = {letter: axis_xml(axis) for letter, axis in zip("xyz", np.eye(3), strict=True)}


def urdf_text(machine: Assembled) -> str:
    """Return the URDF of a machine, with all its geometry."""
    tree = UrdfBuilder()
    tree.link("base")
    tree.link("platform")
    if machine.planar:
        height = np.array([0.0, 0.0, machine.T_base_platform.translation[2]])
        tree.connect("platform_free", "planar", ("base", "platform"), height, moving=_AXES["z"])
    else:
        tree.connect("platform_free", "floating", ("base", "platform"))
    _add_actuators(tree, machine)
    for leg in machine.legs:
        _Branch(tree, machine, leg).write()
    return tree.robot(machine.name).decode()


def yaml_text(machine: Assembled) -> str:
    """Return the mechanism YAML of a machine, with closures, motors, legs and home."""
    stated = motor_entries([leg.actuator for leg in machine.legs if leg.actuator is not None])
    return mechanism_yaml(
        [
            (f"{leg.name}_end", f"{leg.name}_seat", "3d" if leg.type.has_sphere else "6d")
            for leg in machine.legs
        ],
        list(dict.fromkeys(_motor(leg) for leg in machine.legs if _motor(leg))),
        {
            "urdf": f"../urdf/{machine.name}.urdf",
            "base": "base",
            "platform": "platform",
            "platform_joint": "platform_free",
            "base_frame": list(machine.base_frame),
            "home": {"xyz": list(machine.home.xyz), "quat_xyzw": list(machine.home.quat_xyzw)},
            **({"home_readings": dict(machine.home_readings)} if machine.home_readings else {}),
            **({"motors": stated} if stated else {}),
            "legs": {leg.name: _joint_of(leg) for leg in machine.legs},
        },
    )


def _motor(leg: AssembledLeg) -> str:
    """Return the joint of the motor of a leg, empty if it has none."""
    if leg.actuator is not None:
        return leg.actuator.joint
    return f"{leg.name}_prismatic" if leg.kind is LegKind.ACTUATED else ""


def _add_actuators(tree: UrdfBuilder, machine: Assembled) -> None:
    """Add the motors that carry joints, a carriage or an arm each, in the axes of the base."""
    on_base = list[str]()
    for actuator in dict.fromkeys(leg.actuator for leg in machine.legs):
        if actuator is None:
            continue
        rods = [leg for leg in machine.legs if leg.actuator is actuator]
        motor, carried = motor_visuals(actuator, rods)
        on_base += motor
        tree.link(actuator.link)
        tree.link(actuator.link, "".join(carried))
        kind = actuator.kind.value
        moving = axis_xml(actuator.axis) + limit_xml(actuator.travel)
        links = "base", actuator.link
        tree.connect(actuator.joint, kind, links, actuator.point, moving=moving)
    if on_base:
        tree.link("base", "".join(on_base))


def _hangs_from_base(leg: AssembledLeg) -> bool:
    """Return whether the tree of a leg starts at the base (or an actuator), not at the platform.

    A leg with its S at the base starts at the platform.
    """
    return not leg.type.base.twists_freely or leg.type.platform.twists_freely


def _joint_of(leg: AssembledLeg) -> str:
    """Return the joint that identifies a leg in the YAML."""
    if leg.kind is LegKind.CONSTANT:
        return f"{leg.name}_a1" if _hangs_from_base(leg) else f"{leg.name}_b1"
    return f"{leg.name}_prismatic"


class _Branch:
    """One leg, from the link at its start to the frames that close its loop."""

    def __init__(self, tree: UrdfBuilder, machine: Assembled, leg: AssembledLeg) -> None:
        self._tree, self._leg = tree, leg
        self._from_base = _hangs_from_base(leg)
        self._R_base_platform = machine.T_base_platform.rotation.as_matrix()
        self._T = machine.T_base_platform
        self._carrier, self._A = "base", leg.A_base  # the link at the start, and A in it
        self._R_base_carrier = np.eye(3)  # at home
        if leg.actuator is not None:
            self._carrier, self._A = leg.actuator.link, leg.A_base - leg.actuator.point
            self._R_base_carrier = leg.actuator.rotations(np.array([leg.q_home]))[0]
        self._link = self._carrier if self._from_base else "platform"
        self._along = np.zeros(3)  # position of the next joint in the previous link

    def write(self) -> None:
        """Add the leg to the tree."""
        leg = self._leg
        if self._from_base:
            R_carrier = self._R_base_carrier.T
            axis = R_carrier @ leg.base_axis
            R = self._near("a", leg.type.base, R_carrier @ leg.u, axis, self._A)
            R = self._R_base_carrier @ R
        else:
            inverse = self._R_base_platform.T
            axis = inverse @ leg.platform_axis
            R = self._near("b", leg.type.platform, -inverse @ leg.u, axis, leg.B_platform)
        self._half(near=True)
        if leg.kind is LegKind.CONSTANT:
            self._along = np.array([0.0, 0.0, leg.q0])
        else:
            far = f"{leg.name}_{'rod' if self._from_base else 'tube'}"
            offset = np.array([0.0, 0.0, leg.q0])
            self._to(f"{leg.name}_prismatic", "prismatic", far, offset, None, "z", leg.travel)
            self._half(near=False)
        if self._from_base and not leg.type.has_sphere:
            R = self._far(R)
        self._close(R)

    def _near(self, side: str, joint: JointType, u: Array, axis: Array, at: Array) -> Array:
        """Add the joint at the start of the leg, and return the frame of the leg there."""
        y = _unit(cross(u, axis))
        along = np.column_stack([cross(y, u), y, u])
        if joint is JointType.FIXED:
            root = f"{self._leg.name}_rod"
            self._tree.link(root)
            self._tree.connect(f"{root}_frame", "fixed", (self._link, root), at, along)
            self._link = root
            return along
        first = np.column_stack([axis, y, cross(axis, y)]) if joint.inner_is_across else along
        for number, name in enumerate("xyz"[: joint.n_freedoms], start=1):
            place, frame = (at, first) if number == 1 else (None, None)
            if number == 2 and joint.inner_is_across:
                frame = first.T @ along
            self._turn(f"{side}{number}", place, frame, name)
        return along

    def _far(self, R: Array) -> Array:
        """Add the platform joint of a leg without S, and return the frame after it."""
        leg = self._leg
        if leg.type.platform is JointType.FIXED:
            return R
        y = _unit(cross(leg.u, leg.platform_axis))
        along = np.column_stack([cross(y, leg.u), y, leg.u])
        if leg.type.platform is JointType.REVOLUTE:
            self._turn("b1", self._along, R.T @ along, "x")
            return along
        last = np.column_stack([leg.platform_axis, y, cross(leg.platform_axis, y)])
        self._turn("b2", self._along, R.T @ along, "y")
        self._turn("b1", None, along.T @ last, "x")
        return last

    def _close(self, R: Array) -> None:
        """Add the coincident frames that close the loop."""
        leg, tree = self._leg, self._tree
        end, seat = f"{leg.name}_end", f"{leg.name}_seat"
        tree.link(end)
        tree.link(seat)
        tree.connect(f"{end}_frame", "fixed", (self._link, end), self._along)
        at_base = self._carrier, self._A
        carrier, at = ("platform", leg.B_platform) if self._from_base else at_base
        turned = None if leg.type.has_sphere else self._R_base_platform.T @ R
        tree.connect(f"{seat}_frame", "fixed", (carrier, seat), at, turned)

    def _turn(self, joint: str, at: Array | None, rotation: Array | None, axis: str) -> None:
        name = f"{self._leg.name}_{joint}"
        self._to(name, "revolute", f"{name}_link", at, rotation, axis, TURN)

    def _to(
        self,
        joint: str,
        kind: str,
        child: str,
        at: Array | None,
        rotation: Array | None,
        axis: str,
        limits: tuple[float, float],
    ) -> None:
        """Add a joint and continue from its child."""
        self._tree.link(child)
        moving = _AXES[axis] + limit_xml(limits)
        self._tree.connect(joint, kind, (self._link, child), at, rotation, moving)
        self._link, self._along = child, np.zeros(3)

    def _half(self, *, near: bool) -> None:
        """Add the visual of the half of the leg on the current link."""
        leg = self._leg
        radius = leg.tube if near == self._from_base else leg.rod
        if radius is None:
            return
        if leg.kind is LegKind.CONSTANT:
            length = end = leg.q0
        else:
            length = VISIBLE * leg.shortest_shown
            end = length if near else -length
        at = f'<origin xyz="0 0 {0.5 * end!r}" rpy="0 0 0"/>'
        self._tree.link(self._link, visual_xml(at, radius, length))


def _unit(vector: Array) -> Array:
    return np.asarray(vector / np.linalg.norm(vector))


@dataclass(frozen=True, eq=False)
class Created:
    """A model after writing."""

    machine: Machine  # the model as loaded again
    yaml_path: Path
    urdf_path: Path
    notes: tuple[str, ...] = ()  # on what was assumed


def create_model(described: Description, output: Path, *, force: bool = False) -> Created:
    """Write ``models/NAME.yaml`` and ``urdf/NAME.urdf`` of a machine, and load them."""
    machine = assemble(described)
    paths = model_paths(machine.name, output)
    folders = [str(path) for path in paths if path.is_dir()]
    if folders:
        raise UsageError(
            f"{described.source}: the model '{machine.name}' could not be written: found the "
            f"folder {folders[0]}, needed a place for a file; give another --name or --output."
        )
    there = [str(path) for path in paths if os.path.lexists(path)]
    if there and not force:
        raise UsageError(
            f"{described.source}: the model '{machine.name}' could not be written: found "
            f"{' and '.join(there)} already there, needed new files; give another --name or "
            "--output, or --force to replace them."
        )
    try:
        return _write(machine, output)
    except OSError as error:
        raise OutOfResources(
            f"{output}: the model could not be written: found '{error.strerror}', needed a folder "
            "that takes it; free space, correct permissions, or choose another --output."
        ) from error


def model_paths(name: str, output: Path) -> tuple[Path, Path]:
    """Return the paths of the YAML and the URDF of a model."""
    return output / "models" / f"{name}.yaml", output / "urdf" / f"{name}.urdf"


def _write(machine: Assembled, output: Path) -> Created:
    """Write and load the files in a temporary folder, then move them to their places."""
    made = [path for path in (output, *output.parents) if not path.exists()]
    output.mkdir(parents=True, exist_ok=True)
    try:
        with temporary_folder(output, machine.name) as temporary:
            written = model_paths(machine.name, temporary)
            for path, text in zip(written, (yaml_text(machine), urdf_text(machine)), strict=True):
                path.parent.mkdir()
                path.write_bytes(text.encode())
            _load(written[0], temporary, machine.source)
            places = model_paths(machine.name, output)
            for path in places:
                if not path.parent.is_dir():
                    path.parent.mkdir()
                    made.insert(0, path.parent)
            for path, place in zip(reversed(written), reversed(places), strict=True):
                os.replace(path, place)  # the YAML last: a URDF alone is no model
            write_schemas(places[0])
    except BaseException:
        for folder in made:
            if folder.is_dir() and not os.listdir(folder):
                folder.rmdir()
        raise
    return Created(load_mechanism(places[0]), *places, machine.notes)


def _load(path: Path, temporary: Path, source: str) -> None:
    """Load the files in the temporary folder; errors name the source instead."""
    try:
        load_mechanism(path)
    except LegcalError as error:
        raise error.told(
            lambda problem: _attributed_to_source(problem, temporary, source)
        ) from error


def _attributed_to_source(problem: Problem, temporary: Path, source: str) -> Problem:
    """Return a problem of a file in the temporary folder as a problem of the source."""
    file = Path(problem.file)
    if not file.is_relative_to(temporary):
        return problem
    return replace(problem, file=f"{source}: {file.relative_to(temporary)}")


THICK, WIDE = 2.0, 3.0  # size of arms and rails, in radii of a rod
MOTOR_RADIUS, MOTOR_LENGTH = 4.0, 8.0
BEHIND = 2.5  # distance of rails and carriages from the joints, away from the rods
_ROUND = 6  # decimals of sizes and positions [m], for display only


def motor_visuals(actuator: Actuator, rods: Sequence[AssembledLeg]) -> tuple[list[str], list[str]]:
    """Return the ``<visual>`` elements of a motor on the base, and on the link that it moves.

    The first are in the base link, the others relative to the point of the actuator in base axes,
    at reading 0. Without a visible rod there are none.
    """
    radii = [r for rod in rods for r in (rod.tube, rod.rod) if r is not None]
    if not radii:
        return [], []
    make = _turning if actuator.turns else _sliding
    return make(actuator, np.array([rod.A_base for rod in rods]), rods, max(radii))


def _turning(
    actuator: Actuator, A: Array, _rods: Sequence[AssembledLeg], r: float
) -> tuple[list[str], list[str]]:
    """Return a motor along the axis, an arm across it and a bar between the joints."""
    w, middle = actuator.axis, A.mean(axis=0)
    foot = actuator.point + ((middle - actuator.point) @ w) * w
    x = (middle - foot) / np.linalg.norm(middle - foot)
    frame = np.column_stack([x, cross(w, x), w])
    motor = visual_xml(_at(foot, frame), _rounded(MOTOR_RADIUS * r), _rounded(MOTOR_LENGTH * r))
    length = float(np.linalg.norm(middle - foot))
    place = 0.5 * (foot + middle) - actuator.point
    if actuator.arm is None:
        arm = _box(place, np.array([length, WIDE * r, THICK * r]), frame)
    else:
        along = np.column_stack([frame[:, 1], frame[:, 2], x])
        arm = visual_xml(_at(place, along), actuator.arm.radius, _rounded(length))
    return [motor], [arm, *_bar(A - actuator.point, frame, r)]


def _sliding(
    actuator: Actuator, A: Array, rods: Sequence[AssembledLeg], r: float
) -> tuple[list[str], list[str]]:
    """Return a rail along the direction, a carriage on it and a bar between the joints."""
    d, middle = actuator.axis, A.mean(axis=0)
    towards = np.mean([rod.u for rod in rods], axis=0)
    away = -(towards - (towards @ d) * d)
    if np.linalg.norm(away) < 1e-3:  # rods in line with it are side by side
        away = cross(d, A[-1] - A[0])
    if np.linalg.norm(away) < 1e-6:
        away = normal_basis(d)[0]
    y = away / np.linalg.norm(away)
    frame = np.column_stack([d, y, cross(d, y)])
    low, high = actuator.travel
    side = WIDE * r
    rail = np.array([high - low + 2.0 * side, side, side])
    on_rail = middle + (BEHIND * r + side) * y + 0.5 * (low + high) * d
    carriage = middle - actuator.point + BEHIND * r * y
    return [_box(on_rail, rail, frame)], [
        _box(carriage, np.array([2.0 * side, side, 2.0 * side]), frame),
        *_bar(A - actuator.point, frame, r),
    ]


def _bar(A: Array, frame: Array, r: float) -> list[str]:
    """Return the bar between the joints of one link, if there are several."""
    ends = A[[int(np.argmin(A @ frame[:, 2])), int(np.argmax(A @ frame[:, 2]))]]
    along = ends[1] - ends[0]
    length = float(np.linalg.norm(along))
    if length < r:
        return []
    z = along / length
    x = frame[:, 0] - (frame[:, 0] @ z) * z
    x /= np.linalg.norm(x)
    turned = np.column_stack([x, cross(z, x), z])
    return [_box(ends.mean(axis=0), np.array([THICK * r, THICK * r, length + WIDE * r]), turned)]


def _box(at: Array, sizes: Array, frame: Array) -> str:
    return box_xml(_at(at, frame), np.round(sizes, _ROUND))


def _at(place: Array, frame: Array) -> str:
    return origin_xml_at(np.round(place, _ROUND), frame)


def _rounded(size: float) -> float:
    return round(size, _ROUND)
