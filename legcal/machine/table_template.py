"""A table to start from: the same machine as commented YAML and as CSV, in millimetres."""

from __future__ import annotations

import os
from pathlib import Path

from legcal.errors import OutOfResources, UsageError
from legcal.files.folder import write_atomically
from legcal.files.published import with_schema
from legcal.files.schema import plain_name

TEMPLATE_NAME = "my-hexapod"

_JOINTS = (  # of base and platform [mm]
    (289.8, 77.6, 0.0, 106.1, 106.1, 0.0),
    (-77.6, 289.8, 0.0, 38.8, 144.9, 0.0),
    (-212.1, 212.1, 0.0, -144.9, 38.8, 0.0),
    (-212.1, -212.1, 0.0, -144.9, -38.8, 0.0),
    (-77.6, -289.8, 0.0, 38.8, -144.9, 0.0),
    (289.8, -77.6, 0.0, 106.1, -106.1, 0.0),
)

_YAML = """\
# A table of legs for: legcal new {name}.yaml -o .
# Replace the numbers by those of your machine. What the words mean: docs/models.md.
legcal_table: 1
name: {name}
unit: mm                      # of every length here; mm or m

# Joints of a leg from base to platform: R (hinge), U (cardan) or S (ball), with P for a slider.
type: 6-UPS

# Centre of each joint, one row for each leg: on the base in axes that are fixed in the base, on the
# platform in axes that are fixed in the platform. If you measured the platform joints in the axes
# of the base, with the machine at home, write "platform_in: base" and leave out "home".
base_joints:
{base}
platform_joints:
{platform}

# Shortest and longest length of a leg, from joint centre to joint centre. Readings are zero at the
# shortest then. If yours are not, give in place of these the length at reading zero and the lowest
# and highest reading:
#   offsets: 380
#   travel: [0, 120]
min_length: 380
max_length: 500

# Radius (half of the diameter) of what is seen of a leg: the thick part at the base, the thin one
# at the platform.
radius: {{tube: 14, rod: 9}}

# Height of the platform's origin over that of the base when the machine stands level.
home: {{height: 400}}

# Rods of constant length that hang on carriages or arms (type 6-PSS, 6-RSS, 3-PRS): base joints at
# reading 0, "lengths" of the rods in place of shortest and longest ones, and the motors:
# actuators:
#   rail1: {{direction: [1, 0, 0], travel: [0, 200]}}
#   arm1: {{point: [120, 0, 0], axis: [0, 1, 0], travel_deg: [-30, 70]}}
# hangs_on: [rail1, arm1, ...]  # of each leg; motors in the order of the legs without
# A whole one to start from: legcal new --family delta -o DIR; models/tables has their tables.

# legs: [front, ...]          # names; leg1, leg2, ... without
# base_axes: [[0, 1, 0], ...] # directions of R joints and of the outer axes of U joints, if known
"""


def write_template(folder: Path, name: str | None, *, force: bool = False) -> tuple[Path, Path]:
    """Write ``NAME.yaml`` and ``NAME.csv``; files that are there only with *force*."""
    name = str(name or TEMPLATE_NAME)
    try:
        plain_name(name)
    except ValueError as error:
        raise UsageError(f"The name of the template could not be used: {error}") from error
    paths = folder / f"{name}.yaml", folder / f"{name}.csv"
    there = [str(path) for path in paths if os.path.lexists(path)]
    if there and not force:
        raise UsageError(
            f"{folder}: the template could not be written: found {' and '.join(there)} already "
            "there, needed new files; give another --name or --output, or --force to replace them."
        )
    rows = [[f"{x:g}" for x in joint] for joint in _JOINTS]
    joints = ["\n".join(f"  - [{', '.join(row[i : i + 3])}]" for row in rows) for i in (0, 3)]
    text = with_schema("table", _YAML.format(name=name, base=joints[0], platform=joints[1]))
    header = "leg,type,bx,by,bz,px,py,pz,min_length,max_length,tube,rod,unit"
    lines = [f"leg{j + 1},UPS,{','.join(row)},380,500,14,9,mm" for j, row in enumerate(rows)]
    try:
        folder.mkdir(parents=True, exist_ok=True)
        for path, content in zip(paths, (text, "\n".join([header, *lines]) + "\n"), strict=True):
            write_atomically(path, content.encode())
    except OSError as error:
        raise OutOfResources(
            f"{folder}: the template could not be written: found '{error.strerror}', needed a "
            "folder that takes it; free space, correct permissions, or give another --output."
        ) from error
    return paths
