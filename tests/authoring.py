"""Tables of machines, and the models that are made of them, for tests."""

from pathlib import Path
from typing import Any

import yaml

from legcal.machine import Machine, create_model, described

TRIPOD: dict[str, Any] = {
    "legcal_table": 1,
    "name": "tripod",
    "unit": "mm",
    "type": "3-RPS",
    "base_joints": [[300, 0, 0], [-150, 260, 0], [-150, -260, 0]],
    "platform_joints": [[180, 0, 0], [-90, 156, 0], [-90, -156, 0]],
    "offsets": 380,
    "travel": [0, 150],
    "radius": {"tube": 14, "rod": 9},
    "home": {"xyz": [0, 0, 440], "rpy_deg": [0, 0, 0]},
}


def write_table(folder: Path, **changes: Any) -> Path:
    """Write the tripod with some keys changed, or left out where they are None."""
    table = {key: value for key, value in (TRIPOD | changes).items() if value is not None}
    path = folder / "table.yaml"
    path.write_text(yaml.safe_dump(table, sort_keys=False))
    return path


def read_table(path: Path, unit: str | None = None, name: str | None = None) -> Any:
    """Return what a table describes."""
    return described(path, family=None, unit=unit, name=name, dimensions={})


def read_family(family: str, unit: str | None = "mm", **dimensions: Any) -> Any:
    """Return what a family with some dimensions describes."""
    name = dimensions.pop("name", None)
    return described(None, family=family, unit=unit, name=name, dimensions=dimensions)


def made(folder: Path, **changes: Any) -> Machine:
    """Return the machine of a table with some keys changed, written as a model and loaded."""
    return create_model(read_table(write_table(folder, **changes)), folder).machine
