"""Machines of a family: legs of one type on circles or in pairs, with a few dimensions."""

import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import RigidTransform, Rotation

from legcal.errors import UsageError
from legcal.files.schema import plain_name
from legcal.geometry.lines import cross
from legcal.geometry.types import Array
from legcal.machine.actuated_family import (
    ALIASES,
    FAMILIES,
    OPTIONAL,
    ActuatedFamily,
    describe_actuated_family,
)
from legcal.machine.assembly import across_leg
from legcal.machine.description import NEEDED_TYPE, Description, Home, LegEntry, LegType, leg_type
from legcal.machine.description_table import in_metres, read_description
from legcal.machine.dimensions import Dimensions
from legcal.machine.leg import MAX_LEGS, JointType, LegKind
from legcal.option_fields import flag

_FAMILY = re.compile(r"([0-9]{1,2})-([A-Z]+)")
SPREAD = 30.0  # [deg] between the two joints of a pair
TURN_IN_PLANE = 30.0  # [deg]; without, the legs of a planar platform meet in one point
SHORTEST, STROKE, RADIUS = 0.8, 0.4, 0.02  # parts of the length at home


def describe_family(given: Dimensions) -> Description:
    """Return the machine of a family: joints on circles, its legs at home with default lengths."""
    family = str(given.family)
    name = ALIASES.get(family.lower(), family.lower())
    if name in FAMILIES:
        return _describe_named(name, FAMILIES[name], given)
    match = _FAMILY.fullmatch(family)
    of_legs = None if match is None else leg_type(match[2])
    if (
        match is None
        or of_legs is None
        or of_legs.actuator is not None
        or not 2 <= int(match[1]) <= MAX_LEGS
    ):
        raise UsageError(
            f"The family could not be read: found '{family}', needed a number of legs "
            f"from 2 to {MAX_LEGS} and their type, such as 6-UPS: {NEEDED_TYPE.split('; for')[0]}; "
            f"or, with rods that hang on motors, {', '.join(FAMILIES)}; correct --family."
        )
    count = int(match[1])
    problems = [*_wrong_dimensions(given, of_legs), *_unused_dimensions(given, count, of_legs)]
    if problems:
        raise UsageError(problems)
    unit = str(given.unit)

    def metres(value: float | None) -> float:
        return 0.0 if value is None else in_metres(value, unit)

    base_angles, platform_angles = _angles(count, given)
    A = metres(given.base_radius) * _unit_circle(base_angles)
    B = metres(given.platform_radius) * _unit_circle(platform_angles)
    turn = given.turn if given.turn is not None else TURN_IN_PLANE * of_legs.is_planar
    tilt = float(np.radians(given.tilt or 0.0))
    z_turn = Rotation.from_euler("z", turn, degrees=True)
    T = RigidTransform.from_components([0.0, 0.0, metres(given.height)], z_turn)
    legs = []
    for j in range(count):
        vector = T.apply(B[j]) - A[j]
        length = float(np.linalg.norm(vector))  # at home
        radius = _default(RADIUS * length)
        if given.leg_radius is not None:
            radius = metres(given.leg_radius)
        kind = LegKind.CONSTANT
        offset: float | None = None
        travel: tuple[float, float] | None = None
        if of_legs.has_slider:
            kind, offset = LegKind.ACTUATED, _default(SHORTEST * length)
            travel = (0.0, _default(STROKE * length))
            if given.offset is not None:
                offset = in_metres(given.offset, unit)
            if given.travel is not None:
                travel = metres(given.travel[0]), metres(given.travel[1])
        base_axis, platform_axis = _tilted_axes(of_legs, vector, A[j], tilt)
        if platform_axis is not None:
            platform_axis = np.asarray(T.rotation.inv().apply(platform_axis))
        legs.append(
            LegEntry(
                f"leg{j + 1}", of_legs, kind, A[j], B[j], offset, travel, radius, radius,
                base_axis, platform_axis,
            )
        )  # fmt: skip
    home = Home.of((0.0, 0.0, metres(given.height)), z_turn)
    name = given.name or family.lower()
    return Description(name, f"--family {family}", unit, tuple(legs), home, None)


def _describe_named(name: str, family: ActuatedFamily, given: Dimensions) -> Description:
    """Return a machine whose rods hang on motors, its dimensions by default those of its family."""
    where = f"The family {given.family} could not be built"
    known = (*family.dimensions, *OPTIONAL.get(name, ()))
    stated = {
        key: float(value)
        for key, value in given.stated().items()
        if isinstance(value, float | int) and (value or key != "tilt")
    }
    problems = [
        f"{where}: found {flag(key)}, needed some of {', '.join(map(flag, known))} and "
        "--travel; leave it out."
        for key in stated
        if key not in known
    ]
    lengths = [key for key in stated if not key.endswith("spread")]
    in_lengths = not family.turns and given.travel is not None
    if given.unit is None and (lengths or in_lengths):
        problems.append(
            f"{where}: found {flag([*lengths, 'travel'][0])} and no unit of lengths, needed m "
            "or mm; give --unit mm."
        )
    for key, value in stated.items():
        low = -1e9 if key == "height" else 0.0
        high = 120.0 if key.endswith("spread") else 1e9
        if not low < value < high:
            needed = "an angle between 0 and 120 deg" if high == 120.0 else "a positive length"
            problems.append(f"{where}: found {flag(key)} {value:g}, needed {needed}; mend it.")
    if name == "delta" and stated.get("height", -1.0) >= 0.0:
        problems.append(
            f"{where}: found --height {stated['height']:g}, needed a negative one: the platform "
            "of a Delta is below its base, towards which arms sink; give it the other sign."
        )
    if given.travel is not None and not -1e9 < given.travel[0] < given.travel[1] < 1e9:
        problems.append(_wrong_travel(where, given.travel))
    elif given.travel is not None and family.turns and np.ptp(given.travel) <= np.pi:
        low, high = given.travel
        problems.append(
            f"{where}: found --travel {low:g} {high:g}, which hardly turns a motor in degrees and "
            "looks like radians, needed degrees; write --travel "
            f"{np.degrees(low):.4g} {np.degrees(high):.4g}."
        )
    if given.name is not None:
        problems += _wrong_name(where, given.name)
    if problems:
        raise UsageError(problems)
    unit = given.unit or "mm"

    def metres(value: float) -> float:
        return in_metres(value, unit)

    travel = given.travel
    if travel is not None and not family.turns:
        travel = metres(travel[0]), metres(travel[1])
    size = {k: v if k.endswith("spread") else metres(v) for k, v in stated.items()}
    source = f"--family {given.family}"
    try:
        return describe_actuated_family(given.name or name, source, family, size, travel, unit)
    except ValueError as error:
        raise UsageError(f"{where}: found {error}") from error


def _wrong_travel(where: str, travel: tuple[float, float]) -> str:
    """Return that the ends of a travel are in the wrong order."""
    return (
        f"{where}: found --travel {travel[0]:g} {travel[1]:g}, needed the lower reading first; "
        "swap them."
    )


def _wrong_name(where: str, name: str) -> list[str]:
    """Return what is wrong with the name of a model."""
    try:
        plain_name(name)
    except ValueError as error:
        return [f"{where}: the name could not be used: {error}"]
    return []


def _wrong_dimensions(given: Dimensions, of_legs: LegType) -> list[str]:
    """Return what is missing or impossible among the dimensions."""
    in_plane = of_legs.is_planar
    where = f"The family {given.family} could not be built"
    needed = {
        "--base-radius": given.base_radius,
        "--platform-radius": given.platform_radius,
        **({} if in_plane else {"--height": given.height}),
        "--unit": given.unit,
    }
    missing = [option for option, value in needed.items() if value is None]
    problems = []
    if missing:
        problems.append(
            f"{where}: found no {' and no '.join(missing)}, needed "
            f"{', '.join(needed)}; for example --base-radius 300 --platform-radius 150"
            f"{'' if in_plane else ' --height 400'} --unit mm."
        )
    if given.unit not in (None, "m", "mm"):
        problems.append(f"{where}: found the unit '{given.unit}', needed m or mm; correct --unit.")
    for option, value in (*needed.items(), ("--leg-radius", given.leg_radius)):
        if isinstance(value, float | int) and not 0.0 < value < 1e9:
            problems.append(f"{where}: found {option} {value:g}, needed a positive length; fix it.")
    for option, angle in (
        ("--base-spread", given.base_spread),
        ("--platform-spread", given.platform_spread),
    ):
        if angle is not None and not 0.0 < angle < 120.0:
            problems.append(
                f"{where}: found {option} {angle:g} deg, needed an angle between 0 and 120 deg; "
                "mend it."
            )
    if not abs(given.tilt or 0.0) <= 80.0:
        problems.append(
            f"{where}: found --tilt {given.tilt:g} deg, needed at most 80 deg either way; mend it."
        )
    if given.turn is not None and not abs(given.turn) <= 180.0:
        problems.append(
            f"{where}: found --turn {given.turn:g} deg, needed at most 180 deg either way; mend it."
        )
    if given.travel is not None and not -1e9 < given.travel[0] < given.travel[1] < 1e9:
        problems.append(_wrong_travel(where, given.travel))
    if given.offset is not None and not abs(given.offset) < 1e9:
        problems.append(f"{where}: found --offset {given.offset:g}, needed a length; mend it.")
    if given.name is not None:
        problems += _wrong_name(where, given.name)
    return problems


def _unused_dimensions(given: Dimensions, count: int, of_legs: LegType) -> list[str]:
    """Return which given dimensions a machine of this family does not have."""
    in_plane = of_legs.is_planar
    no_axes = not (of_legs.base.has_axis or of_legs.platform.has_axis)
    found = {
        "--height": in_plane and bool(given.height) and "a planar machine",
        "--tilt": (in_plane or no_axes) and bool(given.tilt) and "axes that cannot tilt",
        "--base-spread": count != 6 and given.base_spread is not None and f"{count} legs",
        "--platform-spread": count != 6 and given.platform_spread is not None and f"{count} legs",
        "--offset": not of_legs.has_slider and given.offset is not None and "legs without P",
        "--travel": not of_legs.has_slider and given.travel is not None and "legs without P",
        "--arm-length": given.arm_length is not None and "legs without arms",
        "--arm-radius": given.arm_radius is not None and "legs without arms",
        "--rod-length": given.rod_length is not None and "legs on no motor",
        "--rod-spacing": given.rod_spacing is not None and "legs on no motor",
    }
    return [
        f"The family {given.family} could not be built: found {option} for {what}, needed none; "
        "leave it out."
        for option, what in found.items()
        if what
    ]


def _angles(count: int, given: Dimensions) -> tuple[Array, Array]:
    """Return the angles of the joints on base and platform [rad]."""
    if count != 6:
        even = 2.0 * np.pi * np.arange(count) / count
        return even, even
    half = np.array([0.5, -0.5])
    spreads = (SPREAD if s is None else s for s in (given.base_spread, given.platform_spread))
    on_base, on_platform = (spread * np.tile(half, 3) for spread in spreads)
    base = np.array([0.0, 120.0, 120.0, 240.0, 240.0, 360.0]) + on_base
    platform = np.repeat([60.0, 180.0, 300.0], 2) - on_platform
    return np.radians(base), np.radians(platform)


def _unit_circle(angles: Array) -> Array:
    """Return points of the unit circle in the plane z = 0."""
    ring = np.stack([np.cos(angles), np.sin(angles), np.zeros_like(angles)], axis=-1)
    return np.where(np.abs(ring) < 1e-15, 0.0, ring)


def _tilted_axes(
    of_legs: LegType, vector: Array, A: Array, tilt: float
) -> tuple[Array | None, Array | None]:
    """Return the tilted axes at base and platform, in the base; None for the default ones."""
    if tilt == 0.0:
        return None, None
    u = vector / np.linalg.norm(vector)
    across = across_leg(u, A)

    def tilted(joint: JointType, angle: float) -> Array | None:
        up = cross(u, across) if joint is JointType.REVOLUTE else np.array([0.0, 0.0, 1.0])
        axis = np.cos(angle) * across + np.sin(angle) * up
        return np.asarray(axis) if joint.has_axis else None

    return tilted(of_legs.base, tilt), tilted(of_legs.platform, -tilt)


def _default(length: float) -> float:
    """Return a length that nobody chose, in tenths of a millimetre [m]."""
    return max(round(length, 4), 1e-4)


def _with_travel(given: Dimensions) -> Dimensions:
    """Return dimensions with offset and travel in place of a shortest and a longest length."""
    low, high = given.min_length, given.max_length
    if low is None and high is None:
        return given
    stated = given.offset is not None or given.travel is not None
    if low is None or high is None or not low < high or stated:
        raise UsageError(
            f"The family {given.family} could not be built: found --min-length {low} and "
            f"--max-length {high}, needed both, the shorter first, in place of --offset and "
            "--travel; correct them."
        )
    travel = (0.0, round(high - low, 9))
    return replace(given, offset=low, travel=travel, min_length=None, max_length=None)


_BESIDE = {  # entries of a table for options that may stand beside it
    "type": "type",
    "offset": "offsets",
    "travel": "travel",
    "min_length": "min_length",
    "max_length": "max_length",
    "leg_radius": "radius",
    "height": "home",
    "platform_in": "platform_in",
}


def description_of(table: Path | None, given: Dimensions) -> Description:
    """Return the machine that a table, with what may stand beside it, or a family describes."""
    family, unit = given.family, given.unit
    stated = replace(given, family=None, unit=None, name=None).stated()
    if (table is None) == (family is None):
        found = "neither" if table is None else "both"
        raise UsageError(
            f"The model could not be written: found {found} of a table and --family, needed one; "
            "give a YAML or CSV table, or --family 6-UPS with its dimensions."
        )
    if unit not in (None, "m", "mm"):
        raise UsageError(
            f"The unit could not be used: found '{unit}', needed mm or m; correct --unit."
        )
    if table is None:
        beside = [flag(key) for key in ("type", "platform_in") if key in stated]
        if beside:
            raise UsageError(
                f"The family {family} could not be built: found {' and '.join(beside)}, needed it "
                "beside a table only; leave it out."
            )
        return describe_family(_with_travel(given))
    if of_family := [flag(key) for key in stated if key not in _BESIDE]:
        raise UsageError(
            f"The model could not be written: found {', '.join(of_family)} beside a table, needed "
            "them with --family only; write them in the table."
        )
    entries: dict[str, Any] = {_BESIDE[key]: value for key, value in stated.items()}
    if "home" in entries:
        entries["home"] = {"height": entries["home"]}
    if "travel" in entries:
        entries["travel"] = list(entries["travel"])
    return read_description(table, unit, given.name, entries)
