"""Machines as CAD exports draw them: whole robots of meshes, with loops between named frames."""

from pathlib import Path

import numpy as np
import pytest
from cad_exports import LENGTH, RADIUS, SHAFT, write_mjcf, write_urdf

from legcal import load_mechanism
from legcal.machine.model import Machine, readings_at
from legcal.machine.model_writer import write_model
from legcal.machine.topology import level_rotation


def _check(machine: Machine, radius: float = RADIUS, length: float = LENGTH) -> None:
    """Check the kind of the machine, its rods, and the drawn pose as home."""
    assert [leg.type for leg in machine.legs] == ["RSS"] * 6
    assert machine.mobility == len(machine.motors) == machine.motor_rank == 6
    np.testing.assert_allclose([leg.q0 for leg in machine.legs], length, rtol=0, atol=1e-5)
    assert all(len(leg.cylinders) == 1 for leg in machine.legs)
    seen = [leg.cylinders[0] for leg in machine.legs]
    np.testing.assert_allclose([c.radius for c in seen], radius, rtol=2e-3)
    np.testing.assert_allclose(readings_at(machine, machine.home), 0.0, atol=1e-4)
    level = level_rotation(machine.A_at(np.zeros(6)), machine.B_platform)
    assert (level.inv() * machine.home.rotation).magnitude() < np.radians(0.1)


@pytest.mark.parametrize("write", [write_urdf, write_mjcf])
def test_a_robot_of_a_cad_export_loads_as_it_is(write: object, tmp_path: Path) -> None:
    machine = load_mechanism(write(tmp_path / "from"))  # type: ignore[operator]
    _check(machine)
    # The longest shaft between eye and collar, seen inside both.
    part = machine.legs[0].cylinders[0]
    assert SHAFT[0] < part.start < part.end < SHAFT[1] + 1e-3
    assert part.end - part.start == pytest.approx(0.063, abs=0.002)
    assert machine.base == "body"
    assert machine.platform == "head"
    said = " ".join(machine.diagnostics)
    assert "'yaw'" in said
    assert "'antenna' close no loop and are held as drawn" in said
    assert "rod.stl" in said
    # Written down it needs neither the meshes nor what was inferred.
    written = load_mechanism(write_model(machine, tmp_path / "to")[0])
    _check(written)
    assert written.leg_names == machine.leg_names
