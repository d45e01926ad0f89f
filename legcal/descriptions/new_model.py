"""Machines from tables and from families; a family is a table built from a few dimensions.

The hexapod has its joints in pairs on two circles. The Delta has three arms, level at reading 0,
that sink with the reading, and two parallel rods on each. For further numbers, edit the table that
``legcal new --template`` writes: a family as commented YAML, a hexapod also as CSV.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, fields, replace
from importlib.resources import files
from pathlib import Path
from string import Template
from typing import Any, get_type_hints

import numpy as np

from legcal.arguments import check_arguments
from legcal.descriptions.description import (
    ROUNDING,
    Assembled,
    AssembledLeg,
    Description,
    assemble,
    leg_type,
)
from legcal.descriptions.table import BESIDE, described_machine, read_description
from legcal.errors import LegcalError, Problem, UsageError
from legcal.files.folder import new_files, with_schema
from legcal.files.motions import motion_to_xyz_quat
from legcal.files.quantity import LENGTH
from legcal.files.schema import plain_name
from legcal.geometry.lines import cross, normal_basis
from legcal.geometry.types import Array
from legcal.machine.actuator import Actuator
from legcal.machine.files import mechanism_yaml, motor_entries
from legcal.machine.leg import JointType, LegKind
from legcal.machine.loader import load_mechanism
from legcal.machine.model import Machine
from legcal.machine.spanning_tree import (
    UNTURNED,
    ZERO,
    UrdfBuilder,
    box_xml,
    origin_xml,
    visual_xml,
)
from legcal.machine.urdf import UrdfJointType

SPREAD = 30.0  # angle between the two joints of a pair of a hexapod [deg]
SHORTEST, LONGEST = 0.8, 1.2  # range of leg lengths, relative to the length at home
TUBE, ROD = 0.03, 0.02  # radii, relative to the length at home
RADIUS_OF_ROD = 0.0125  # radius of rods of a Delta, relative to their length
SPACING = 1.2  # distance of the two rods of an arm, in platform radii
TRAVEL = (-30.0, 70.0)  # travel of arms [deg]
DIGITS = 12  # decimals of a length in metres


@dataclass(frozen=True, kw_only=True)
class Dimensions:
    """Numbers given beside a table, or a family and its dimensions; None if not given.

    Lengths are in ``unit``.
    """

    family: str | None = None  # hexapod or delta, in place of a table
    unit: str | None = None
    name: str | None = None  # of the model and its files
    type: str | None = None  # of the legs: UPS
    min_length: float | None = None  # of a leg, where readings are zero
    max_length: float | None = None
    leg_radius: float | None = None  # of tube and rod
    height: float | None = None  # of the platform above the base at home
    base_radius: float | None = None  # of the circle of base joints, or motors
    platform_radius: float | None = None  # of the circle of platform joints
    arm_length: float | None = None  # of a delta
    rod_length: float | None = None  # of a delta

    def stated(self) -> dict[str, Any]:
        """Return the given dimensions by name."""
        dimensions = {field.name: getattr(self, field.name) for field in fields(self)}
        return {name: value for name, value in dimensions.items() if value is not None}


def new(
    table: str | Path | None = None,
    output: str | Path = ".",
    *,
    force: bool = False,
    **dimensions: str | float,
) -> Created:
    """Write a model, YAML and URDF, from a table of joints or a few dimensions.

    Parameters
    ----------
    table : path, optional
        A table of legs, as for ``legcal new``; None with a family.
    output : path
        The folder of ``models/`` and ``urdf/``.
    force : bool
        Replace existing files.
    **dimensions
        The options of ``legcal new``: ``family``, ``unit``, ``name``, ``type``, ``height``, ...
        Lengths are in ``unit``, "mm" or "m".

    Returns
    -------
    Created
        The machine as loaded again, the paths, and notes on what was assumed.

    Raises
    ------
    UsageError, ModelError
        With one sentence for each problem of the table or the dimensions.
    OutOfResources
        If the folder cannot be written.
    """
    known = [field.name for field in fields(Dimensions)]
    if unknown := [name for name in dimensions if name not in known]:
        raise UsageError(
            f"The model could not be written: found the dimension '{unknown[0]}', needed some of "
            f"{', '.join(known)}; correct its name."
        )
    check_arguments("legcal.new", get_type_hints(Dimensions), dimensions)
    given = Dimensions(**dimensions)  # type: ignore[arg-type]
    path = None if table is None else Path(table)
    return create_model(description_of(path, given), Path(output), force=force)


def description_of(table: Path | None, given: Dimensions) -> Description:
    """Return the machine of a table, with options beside it, or of a family."""
    stated = given.stated()
    if (table is None) == (given.family is None):
        sources = "neither" if table is None else "both"
        raise UsageError(
            f"The model could not be written: found {sources} of a table and --family, needed one; "
            "give a YAML or CSV table, or --family hexapod or delta; legcal new --template writes "
            "a table to start from."
        )
    _check_unit(given)
    if table is None:
        return described_machine(family_table(given), Path(f"--family {given.family}"))
    entries = {
        BESIDE[key]: {"height": value} if key == "height" else value
        for key, value in stated.items()
        if key in BESIDE
    }
    beside = (*BESIDE, "unit", "name", "platform_radius")
    if of_family := [flag(key) for key in stated if key not in beside]:
        raise UsageError(
            f"The model could not be written: found {', '.join(of_family)} beside a table, needed "
            "them with --family only; write them in the table."
        )
    return read_description(table, given.unit, given.name, entries, given.platform_radius)


def _check_unit(given: Dimensions) -> None:
    if given.unit not in (None, *LENGTH):
        raise UsageError(
            f"The unit could not be used: found '{given.unit}', needed one of "
            f"{', '.join(LENGTH)}; correct --unit."
        )


def family_table(given: Dimensions) -> dict[str, Any]:
    """Return the table of a family, as in YAML, in the unit of the dimensions.

    Raises UsageError with one sentence for each dimension that is missing, impossible or belongs to
    another family.
    """
    _check_unit(given)
    name = str(given.family).lower()
    if name not in FAMILIES:
        raise UsageError(_no_family(str(given.family)))
    family, stated, unit = FAMILIES[name], given.stated(), given.unit or "mm"
    where = f"The family {name} could not be built"
    keys = (*family.dimensions, *family.others)
    lengths = {key: value for key, value in stated.items() if isinstance(value, float | int)}
    problems = [
        f"{where}: found {flag(key)}, needed some of {', '.join(map(flag, keys))}; leave it out."
        for key in stated
        if key not in (*keys, "family", "unit", "name")
    ]
    if lengths and given.unit is None:
        problems.append(
            f"{where}: found {flag(next(iter(lengths)))} and no unit of lengths, needed one "
            f"of {', '.join(LENGTH)}; give --unit mm."
        )
    for key, value in lengths.items():
        below = name == "delta" and key == "height"
        if not 0.0 < (-value if below else value) < 1e9:
            needed = "a positive length"
            if below:
                needed = "a negative one, because the platform of a Delta is below its base"
            problems.append(f"{where}: found {flag(key)} {value:g}, needed {needed}; correct it.")
    of_legs = leg_type(given.type or "UPS")
    if of_legs is None or not of_legs.has_slider:
        problems.append(
            f"{where}: found --type {given.type}, needed the joints of a leg with a slider, such "
            "as UPS, SPU or SPS; correct it."
        )
    if problems:
        raise UsageError(problems)
    size = {key: value * 1e-3 / LENGTH[unit] for key, value in family.dimensions.items()}
    try:
        table = family.make(size | lengths, unit)
    except ValueError as error:
        raise UsageError(f"{where}: found {error}") from error
    if "type" in stated:
        table["type"] = f"6-{given.type}"
    return {"legcal_table": 1, "name": given.name or name, "unit": unit, **table}


def _no_family(family: str) -> str:
    remedy = (
        "write the joints of any other machine in a table, for which legcal new --template -o DIR "
        "makes one to start from"
    )
    if family.startswith("6-") and (of_legs := leg_type(family[2:])) and of_legs.actuator is None:
        remedy = f"give --family hexapod --type {family[2:]}, or {remedy}"
    return (
        f"The family could not be built: found --family {family}, needed hexapod or delta; "
        f"{remedy}."
    )


def _decimals(unit: str) -> int:
    return DIGITS + round(math.log10(LENGTH[unit]))


def _hexapod(size: Mapping[str, float], unit: str) -> dict[str, Any]:
    """Return the table of a hexapod, with platform pairs between base pairs."""
    digits, half = _decimals(unit), SPREAD * np.tile([0.5, -0.5], 3)
    A = size["base_radius"] * _ring(np.array([0.0, 120.0, 120.0, 240.0, 240.0, 360.0]) + half)
    B = size["platform_radius"] * _ring(np.repeat([60.0, 180.0, 300.0], 2) - half)
    at_home = float(np.linalg.norm(B[0] + np.array([0.0, 0.0, size["height"]]) - A[0]))

    def part(of_length: float) -> float:
        return round(of_length * at_home, max(digits - 8, 1))

    radius = size.get("leg_radius")
    return {
        "type": "6-UPS",
        "base_joints": A.round(digits).tolist(),
        "platform_joints": B.round(digits).tolist(),
        "min_length": size.get("min_length", part(SHORTEST)),
        "max_length": size.get("max_length", part(LONGEST)),
        "radius": {"tube": radius or part(TUBE), "rod": radius or part(ROD)},
        "home": {"height": size["height"]},
    }


def _delta(size: Mapping[str, float], unit: str) -> dict[str, Any]:
    """Return the table of a Delta, at home at mid-travel if no height is given."""
    R, r, arm, rod = (
        size[key] for key in ("base_radius", "platform_radius", "arm_length", "rod_length")
    )
    digits, spacing = _decimals(unit), SPACING * r
    radius = size.get("leg_radius", RADIUS_OF_ROD * rod)
    if not 2.0 * radius < spacing:
        raise ValueError(
            f"two rods {spacing:.6g} {unit} apart that are {2.0 * radius:.6g} {unit} thick, needed "
            "them beside each other; give half of their diameter as --leg-radius, or enlarge "
            "--platform-radius."
        )
    q = np.radians(0.5 * sum(TRAVEL))
    reach = R + arm * np.cos(q) - r
    if not abs(reach) < rod:
        raise ValueError(
            f"rods of {rod:.6g} {unit} that reach {abs(reach):.6g} {unit} inwards at mid-travel, "
            "needed longer rods; enlarge --rod-length, or correct the other dimensions."
        )
    out = _ring(np.array([0.0, 120.0, 240.0]))
    along = _ring(np.array([90.0, 210.0, 330.0]))
    pair = 0.5 * spacing * np.stack([-along, along], axis=1)
    down = float(arm * np.sin(q) + np.sqrt(rod**2 - reach**2))
    return {
        "type": "6-RSS",
        "actuators": {
            f"arm{k + 1}": {
                "point": (R * out[k]).round(digits).tolist(),
                "axis": along[k].round(15).tolist(),
                "travel_deg": list(TRAVEL),
            }
            for k in range(3)
        },
        "hangs_on": ["arm1", "arm1", "arm2", "arm2", "arm3", "arm3"],
        "base_joints": ((R + arm) * out[:, None] + pair).reshape(6, 3).round(digits).tolist(),
        "platform_joints": (r * out[:, None] + pair).reshape(6, 3).round(digits).tolist(),
        "lengths": rod,
        "radius": radius,
        "home": {"height": size.get("height", round(-down, digits))},
    }


def _ring(degrees: Array) -> Array:
    """Return points of the unit circle in the plane z = 0, (n, 3)."""
    a = np.radians(degrees)
    return np.stack([np.cos(a), np.sin(a), np.zeros_like(a)], axis=-1).round(15) + 0.0


@dataclass(frozen=True)
class _Family:
    """Default dimensions [mm], optional dimensions, and the table built from them."""

    dimensions: Mapping[str, float]
    others: tuple[str, ...]
    make: Callable[[Mapping[str, float], str], dict[str, Any]]


FAMILIES = {
    "hexapod": _Family(
        {"base_radius": 300.0, "platform_radius": 150.0, "height": 400.0},
        ("type", "min_length", "max_length", "leg_radius"),
        _hexapod,
    ),
    "delta": _Family(
        {"base_radius": 120.0, "platform_radius": 50.0, "arm_length": 200.0, "rod_length": 400.0},
        ("height", "leg_radius"),
        _delta,
    ),
}


def write_template(folder: Path, given: Dimensions, *, force: bool = False) -> list[Path]:
    """Write ``NAME.yaml``, and ``NAME.csv`` of a hexapod; existing files only with *force*.

    The numbers are of a family with the given dimensions.
    """
    family = str(given.family or "hexapod").lower()
    name = str(given.name or f"my-{family}")
    try:
        plain_name(name)
    except ValueError as error:
        raise UsageError(f"The name of the template could not be used: {error}") from error
    table = family_table(replace(given, family=family, name=name))
    tables = {f"{name}.yaml": with_schema("table", _yaml(table))}
    if "actuators" not in table:
        leg_type = table["type"].split("-")[-1]
        lengths = [table.get("min_length", ""), table.get("max_length", "")]
        radii = [table["radius"]["tube"], table["radius"]["rod"]]
        lines = ["leg,type,bx,by,bz,px,py,pz,min_length,max_length,tube,rod,unit"]
        joints = zip(table["base_joints"], table["platform_joints"], strict=True)
        for j, (A, B) in enumerate(joints, start=1):
            cells: Sequence[Any] = [f"leg{j}", leg_type, *A, *B, *lengths, *radii, table["unit"]]
            lines.append(",".join(_flow(cell) for cell in cells))
        tables[f"{name}.csv"] = "\n".join(lines) + "\n"
    with new_files(folder, "template", tables, force=force) as temporary:
        for file, content in tables.items():
            (temporary / file).write_bytes(content.encode())
    return [folder / file for file in tables]


def _yaml(table: dict[str, Any]) -> str:
    """Return a table of a family as commented YAML, from the text in ``templates``."""
    shown = {key: _flow(value) for key, value in table.items()}
    for key in ("base_joints", "platform_joints"):
        shown[key] = "\n".join(f"  - {_flow(joint)}" for joint in table[key])
    motors = table.get("actuators", {})
    shown["actuators"] = "\n".join(f"  {key}: {_flow(entry)}" for key, entry in motors.items())
    name = "delta.yaml" if motors else "hexapod.yaml"
    template = files("legcal.descriptions") / "templates" / name
    return Template(template.read_text(encoding="utf-8")).substitute(shown)


def _flow(value: Any) -> str:
    """Return a value as YAML on one line."""
    if isinstance(value, dict):
        return "{" + ", ".join(f"{key}: {_flow(x)}" for key, x in value.items()) + "}"
    if isinstance(value, list):
        return "[" + ", ".join(map(_flow, value)) + "]"
    return f"{value:.7g}" if isinstance(value, float) else str(value)


def flag(name: str) -> str:
    """Return the option of a dimension."""
    return f"--{name.replace('_', '-')}"


TURN = (-3.15, 3.15)  # limits of revolutes [rad]
VISIBLE = 0.9  # length of tube and rod together, relative to the shortest leg
_AXES = dict(zip("xyz", np.eye(3), strict=True))


def urdf_text(machine: Assembled) -> str:
    """Return the URDF of a machine, with all its geometry."""
    tree = UrdfBuilder()
    tree.link("base")
    tree.link("platform")
    if machine.planar:
        height = np.array([0.0, 0.0, machine.home.translation[2]])
        tree.joint("platform_free", "planar", ("base", "platform"), height, axis=_AXES["z"])
    else:
        tree.joint("platform_free", "floating", ("base", "platform"))
    _add_actuators(tree, machine)
    for leg in machine.legs:
        _write_leg(tree, machine, leg)
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
            "home": {
                key: [x if abs(x) > ROUNDING else 0.0 for x in numbers]
                for key, numbers in motion_to_xyz_quat(machine.home).items()
            },
            **({"home_readings": dict(machine.home_readings)} if machine.home_readings else {}),
            **({"motors": stated} if stated else {}),
            **({} if machine.reach is None else {"reach": machine.reach}),
            **({} if machine.floor is None else {"floor": machine.floor}),
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
        tree.link(actuator.link, "".join(carried))
        kind: UrdfJointType = "revolute" if actuator.turns else "prismatic"
        links, moves = ("base", actuator.link), (actuator.axis, actuator.travel)
        tree.joint(actuator.joint, kind, links, actuator.point, UNTURNED, *moves)
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


def _write_leg(tree: UrdfBuilder, machine: Assembled, leg: AssembledLeg) -> None:
    """Add a leg: its joints from the link at its start on, and the frames that close its loop.

    Frames are rotation matrices in the base link at home, with z from the start of the leg on.
    """
    R_platform, carrier, A = machine.home.rotation.as_matrix(), "base", leg.A_base
    R_carrier = np.eye(3)
    if leg.actuator is not None:
        carrier, A = leg.actuator.link, leg.A_base - leg.actuator.point
        R_carrier = leg.actuator.rotations(np.array([leg.q_home]))[0]
    on_base, on_platform = (carrier, A, R_carrier), ("platform", leg.B_platform, R_platform)
    of_base = "a", leg.type.base, leg.base_axis
    of_platform = "b", leg.type.platform, leg.platform_axis
    starts_at_base = _hangs_from_base(leg)
    (link, at, R), end = (on_base, on_platform) if starts_at_base else (on_platform, on_base)
    side, joint, axis = of_base if starts_at_base else of_platform
    u = leg.u if starts_at_base else -leg.u

    def add(
        name: str,
        kind: UrdfJointType,
        child: str,
        at: Array,
        frame: Array,
        letter: str = "",
        limits: tuple[float, float] = TURN,
    ) -> None:
        """Add a joint at a point of the last link, and continue from its child."""
        nonlocal link, R
        tree.link(child)
        turned = UNTURNED if frame is R else frame if link == "base" else R.T @ frame
        tree.joint(name, kind, (link, child), at, turned, _AXES.get(letter), limits)
        link, R = child, frame

    for number, (letter, frame) in enumerate(_frames(joint, u, axis), start=1):
        name = f"{leg.name}_{side}{number}"
        add(name, "revolute", f"{name}_link", at, frame, letter)
        at = ZERO
    if joint is JointType.FIXED:
        along = _frames(JointType.REVOLUTE, u, axis)[0][1]
        add(f"{leg.name}_rod_frame", "fixed", f"{leg.name}_rod", at, along)
    tree.link(link, _half(leg, near=True, from_base=starts_at_base))
    at = np.array([0.0, 0.0, leg.q0])
    if leg.kind is not LegKind.CONSTANT:
        far = f"{leg.name}_{'rod' if starts_at_base else 'tube'}"
        add(f"{leg.name}_prismatic", "prismatic", far, at, R, "z", leg.travel)
        tree.link(link, _half(leg, near=False, from_base=starts_at_base))
        at = ZERO
    if starts_at_base and not leg.type.has_sphere:
        side, joint, axis = of_platform
        for number, (letter, frame) in reversed([*enumerate(_frames(joint, u, axis), start=1)]):
            name = f"{leg.name}_{side}{number}"
            add(name, "revolute", f"{name}_link", at, frame, letter)
            at = ZERO
    ends = f"{leg.name}_end", f"{leg.name}_seat"
    for frame_link in ends:
        tree.link(frame_link)
    tree.joint(f"{ends[0]}_frame", "fixed", (link, ends[0]), at)
    carrier, at, R_end = end
    turned = UNTURNED if leg.type.has_sphere else R_end.T @ R
    tree.joint(f"{ends[1]}_frame", "fixed", (carrier, ends[1]), at, turned)


def _frames(joint: JointType, u: Array, axis: Array) -> list[tuple[str, Array]]:
    """Return the revolutes of a joint from its link to the leg: their axes, and frames at home."""
    y = _unit(cross(u, axis))
    along = np.column_stack([cross(y, u), y, u])
    if joint is JointType.UNIVERSAL:
        return [("x", np.column_stack([axis, y, cross(axis, y)])), ("y", along)]
    return [(letter, along) for letter in "xyz"[: joint.n_freedoms]]


def _half(leg: AssembledLeg, *, near: bool, from_base: bool) -> str:
    """Return the visual of the half of a leg on its link, empty if it has no radius."""
    radius = leg.tube if near == from_base else leg.rod
    if radius is None:
        return ""
    length, (low, high) = leg.q0, leg.travel
    if leg.kind is not LegKind.CONSTANT:  # at reading zero, or the one nearest to it in the travel
        length = VISIBLE * (leg.q0 + min(max(0.0, low), high))
    end = length if near else -length
    return visual_xml(f'<origin xyz="0 0 {0.5 * end!r}" rpy="0 0 0"/>', radius, length)


def _unit(vector: Array) -> Array:
    return np.asarray(vector / np.linalg.norm(vector))


@dataclass(frozen=True, eq=False)
class Created:
    """A model after writing."""

    machine: Machine  # the model as loaded again
    yaml_path: Path
    urdf_path: Path
    notes: tuple[str, ...] = ()  # on what was assumed


def create_model(
    described: Description,
    output: Path,
    *,
    force: bool = False,
    before: Callable[[Machine, tuple[str, ...]], object] = lambda machine, notes: None,
) -> Created:
    """Write ``models/NAME.yaml`` and ``urdf/NAME.urdf`` of a machine, and load them.

    ``before`` takes the machine and the notes on it once all is in order, before the files appear.
    """
    machine = assemble(described)
    names = f"models/{machine.name}.yaml", f"urdf/{machine.name}.urdf"
    with new_files(output, "model", names, force=force) as temporary:
        for name, text in zip(names, (yaml_text(machine), urdf_text(machine)), strict=True):
            (temporary / name).parent.mkdir()
            (temporary / name).write_bytes(text.encode())
        try:
            loaded = load_mechanism(temporary / names[0])
        except LegcalError as error:
            raise error.map_problems(
                lambda problem: _of_source(problem, temporary, machine)
            ) from error
        before(loaded, machine.notes)
    yaml_path, urdf_path = (output / name for name in names)
    return Created(load_mechanism(yaml_path), yaml_path, urdf_path, machine.notes)


def _of_source(problem: Problem, temporary: Path, machine: Assembled) -> Problem:
    """Return a problem of a file in the temporary folder as one of what it is made of."""
    moved = problem.moved(temporary, Path())
    return problem if moved is problem else replace(moved, file=f"{machine.source}: {moved.file}")


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
    A, r = np.array([rod.A_base for rod in rods]), max(radii)
    return _turning(actuator, A, r) if actuator.turns else _sliding(actuator, A, rods, r)


def _turning(actuator: Actuator, A: Array, r: float) -> tuple[list[str], list[str]]:
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
    return origin_xml(np.round(place, _ROUND), frame)


def _rounded(size: float) -> float:
    return round(size, _ROUND)
