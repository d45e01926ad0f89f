"""A table template: a family as commented YAML, a hexapod also as CSV."""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from legcal.errors import OutOfResources, UsageError
from legcal.files.folder import write_atomically
from legcal.files.published import with_schema
from legcal.files.schema import plain_name
from legcal.machine.dimensions import Dimensions
from legcal.machine.family import family_table

_HEAD = """\
# A table of legs for: legcal new {name}.yaml -o .
# Replace the numbers by those of your machine. Keys are explained in docs/formats.md.
legcal_table: 1
name: {name}
unit: {unit:<24}# of every length here: mm, m, in, ...
"""
_HEXAPOD = """
# Joints of a leg from base to platform: R (hinge), U (cardan) or S (ball), with P for a slider.
type: {type}

# Centre of each joint, one row for each leg: on the base in axes that are fixed in the base, on the
# platform in axes that are fixed in the platform. If you measured the platform joints in the axes
# of the base, with the machine at home, write "platform_in: base" and leave out "home".
base_joints:
{base_joints}
platform_joints:
{platform_joints}

# Shortest and longest length of a leg, from joint centre to joint centre. Readings are zero at the
# shortest then. Otherwise give instead the length at reading zero and the lowest and highest
# reading:
#   offsets: 380
#   travel: [0, 120]
min_length: {min_length}
max_length: {max_length}

# Radius (half of the diameter) of the visible parts of a leg: the thick one at the base, the thin
# one at the platform.
radius: {radius}

# Height of the platform origin above the base origin at home, with a level platform.
home: {home}

# Rods of constant length that hang on carriages or arms (type 6-PSS, 6-RSS, 3-PRS) need motors:
# legcal new --template --family delta -o DIR writes a table with some.

# legs: [front, ...]          # names; leg1, leg2, ... without
# base_axes: [[0, 1, 0], ...] # directions of R joints and of the outer axes of U joints, if known
"""
_DELTA = """
# Each rod: the motor on which it hangs (R for an arm that turns, P for a carriage that slides),
# then its joints on the motor and on the platform.
type: {type}

# Motors: a point and the axis of an arm, about which it turns by the right hand, and its lowest and
# highest reading in degrees. "arm_radius: 8" draws the arm as a cylinder, which is measured then.
# A carriage has a direction and its travel: {{direction: [1, 0, 0], travel: [0, 200]}}.
actuators:
{actuators}
hangs_on: {hangs_on}

# Centre of each joint, one row for each rod: on the arms where their motors read 0, in axes of the
# base; on the platform in axes of the platform.
base_joints:
{base_joints}
platform_joints:
{platform_joints}

lengths: {lengths}
radius: {radius}

# Height of the platform origin above the base origin at home, with a level platform.
home: {home}
"""


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
    files = {folder / f"{name}.yaml": with_schema("table", _yaml(table))}
    if "actuators" not in table:
        files[folder / f"{name}.csv"] = _csv(table)
    there = [str(path) for path in files if os.path.lexists(path)]
    if there and not force:
        raise UsageError(
            f"{folder}: the template could not be written: found {' and '.join(there)} already "
            "there, needed new files; give another --name or --output, or --force to replace them."
        )
    try:
        folder.mkdir(parents=True, exist_ok=True)
        for path, content in files.items():
            write_atomically(path, content.encode())
    except OSError as error:
        raise OutOfResources(
            f"{folder}: the template could not be written: found '{error.strerror}', needed a "
            "folder that takes it; free space, correct permissions, or give another --output."
        ) from error
    return list(files)


def _yaml(table: dict[str, Any]) -> str:
    """Return a table of a family as commented YAML."""
    shown = {key: _flow(value) for key, value in table.items()}
    for key in ("base_joints", "platform_joints"):
        shown[key] = "\n".join(f"  - {_flow(joint)}" for joint in table[key])
    motors = table.get("actuators", {})
    shown["actuators"] = "\n".join(f"  {key}: {_flow(entry)}" for key, entry in motors.items())
    return (_HEAD + (_DELTA if motors else _HEXAPOD)).format(**shown)


def _csv(table: dict[str, Any]) -> str:
    """Return the table of a hexapod as CSV."""
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
