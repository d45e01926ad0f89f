"""Tables of machines for the tests, and what a loaded model must have in common with them."""

from pathlib import Path
from typing import Any

import numpy as np
import yaml

from legcal.machine import LegKind, Machine, main_cylinders
from legcal.machine.description import Description
from legcal.machine.description_table import read_description
from legcal.machine.new_model import create_model

ROOT = Path(__file__).parents[1]
TABLES = sorted((ROOT / "models" / "tables").glob("*.yaml"))

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


def described(folder: Path, **changes: Any) -> Description:
    return read_description(write_table(folder, **changes))


def made(folder: Path, **changes: Any) -> Machine:
    return create_model(described(folder, **changes), folder).machine


def check_same(machine: Machine, description: Description) -> None:
    """Compare a loaded model with its description."""
    assert machine.name == description.name
    assert machine.leg_names == tuple(leg.name for leg in description.legs)
    for leg, entry in zip(machine.legs, description.legs, strict=True):
        slider = "P" if entry.type.has_slider else ""
        assert leg.type == f"{entry.type.base}{slider}{entry.type.platform}"
        assert leg.kind is entry.kind
        assert leg.sign == 1
        np.testing.assert_allclose(leg.A, entry.A_base, rtol=0, atol=1e-12)
        if entry.type.platform:
            np.testing.assert_allclose(leg.B, entry.B_platform, rtol=0, atol=1e-12)
            if entry.offset is not None:
                assert abs(leg.q0 - entry.offset) < 1e-12
        if entry.travel is not None:
            np.testing.assert_allclose(leg.travel, entry.travel, rtol=0, atol=1e-15)
        for axis, told in (
            (leg.base_axis, entry.base_axis),
            (leg.platform_axis, entry.platform_axis),
        ):
            if axis is not None and told is not None:
                assert np.linalg.norm(np.cross(axis, told)) < 1e-12
        parts = {c.side: c.radius for c in main_cylinders(leg.cylinders).values()}
        wanted = {"base": entry.tube, "platform": entry.rod}
        if entry.kind is LegKind.CONSTANT:
            assert set(parts.values()) <= set(wanted.values())
        elif entry.type.platform:
            assert parts == {side: radius for side, radius in wanted.items() if radius is not None}
