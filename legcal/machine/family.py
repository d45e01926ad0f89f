"""Machines from tables and from families; a family is a table built from a few dimensions.

The hexapod has its joints in pairs on two circles. The Delta has three arms, level at reading 0,
that sink with the reading, and two parallel rods on each. For further numbers, edit the table that
``legcal new --template`` writes: a family as commented YAML, a hexapod also as CSV.
"""

import math
import os
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, fields, replace
from importlib.resources import files
from pathlib import Path
from string import Template
from typing import Any

import numpy as np

from legcal.errors import OutOfResources, UsageError
from legcal.files.folder import write_atomically
from legcal.files.published import with_schema
from legcal.files.quantity import LENGTH
from legcal.files.schema import plain_name
from legcal.geometry.types import Array
from legcal.machine.description import Description, leg_type
from legcal.machine.description_table import BESIDE, described_machine, read_description
from legcal.machine.model_builder import Created, create_model

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

    Raises
    ------
    UsageError
        With one sentence for each dimension that is missing, impossible or belongs to another
        family.
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
    tables = {folder / f"{name}.yaml": with_schema("table", _yaml(table))}
    if "actuators" not in table:
        tables[folder / f"{name}.csv"] = _csv(table)
    there = [str(path) for path in tables if os.path.lexists(path)]
    if there and not force:
        raise UsageError(
            f"{folder}: the template could not be written: found {' and '.join(there)} already "
            "there, needed new files; give another --name or --output, or --force to replace them."
        )
    try:
        folder.mkdir(parents=True, exist_ok=True)
        for path, content in tables.items():
            write_atomically(path, content.encode())
    except OSError as error:
        raise OutOfResources(
            f"{folder}: the template could not be written: found '{error.strerror}', needed a "
            "folder that takes it; free space, correct permissions, or give another --output."
        ) from error
    return list(tables)


def _yaml(table: dict[str, Any]) -> str:
    """Return a table of a family as commented YAML, from the text in ``templates``."""
    shown = {key: _flow(value) for key, value in table.items()}
    for key in ("base_joints", "platform_joints"):
        shown[key] = "\n".join(f"  - {_flow(joint)}" for joint in table[key])
    motors = table.get("actuators", {})
    shown["actuators"] = "\n".join(f"  {key}: {_flow(entry)}" for key, entry in motors.items())
    template = files("legcal.machine") / "templates" / f"{'delta' if motors else 'hexapod'}.yaml"
    return Template(template.read_text(encoding="utf-8")).substitute(shown)


def _csv(table: dict[str, Any]) -> str:
    leg_type = table["type"].split("-")[-1]
    lengths = [table.get("min_length", ""), table.get("max_length", "")]
    radii = [table["radius"]["tube"], table["radius"]["rod"]]
    lines = ["leg,type,bx,by,bz,px,py,pz,min_length,max_length,tube,rod,unit"]
    joints = zip(table["base_joints"], table["platform_joints"], strict=True)
    for j, (A, B) in enumerate(joints, start=1):
        cells: Sequence[Any] = [f"leg{j}", leg_type, *A, *B, *lengths, *radii, table["unit"]]
        lines.append(",".join(_flow(cell) for cell in cells))
    return "\n".join(lines) + "\n"


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
