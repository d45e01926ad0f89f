"""Machines whose rods hang on carriages and arms: written and loaded.

How they move is compared with closed forms in test_firmware.py.
"""

from pathlib import Path

import numpy as np
import pytest
import yaml
from machines import ROOT, delta_with_round_arms, read_table

from legcal import Machine, export, inverse_kinematics, load_mechanism
from legcal.descriptions.new_model import create_model
from legcal.descriptions.table import described_machine
from legcal.errors import ModelError
from legcal.exports.subject import Subject
from legcal.machine.home import home_of_legs
from legcal.machine.leg import ARMS as ARM_KINDS
from legcal.machine.leg import ParameterId
from legcal.machine.model import readings_at
from legcal.machine.model_writer import write_model
from legcal.machine.parameters import geometries, moved_legs, parametrization_of, vector_of
from legcal.simulation.truth import write_model_with

TABLES = ROOT / "models" / "tables"
# --- what is shipped ----------------------------------------------------------------------------


def test_an_arm_that_is_a_cylinder_is_a_line_of_the_first_rod_on_it(tmp_path: Path) -> None:
    machine = create_model(delta_with_round_arms(4.0), tmp_path).machine
    bare = load_mechanism("delta")
    assert parametrization_of(machine).names == parametrization_of(bare).names
    arms = [leg.arm for leg in machine.legs if leg.arm is not None]
    assert tuple(arm.leg for arm in arms) == ("leg1", "leg3", "leg5")
    for actuator, arm in zip(machine.actuators, arms, strict=True):
        assert actuator.arm is arm
        assert arm.radius == 0.004
        joints = [leg.A for leg in machine.legs if leg.prismatic == actuator.joint]
        near, far = arm.ends
        np.testing.assert_allclose(far, np.mean(joints, axis=0), atol=1e-6)
        np.testing.assert_allclose(np.cross(near - actuator.point, actuator.axis), 0.0, atol=1e-6)

    legs, found = geometries(machine), parametrization_of(machine, twists=True)
    step = np.random.default_rng(1).uniform(-1e-3, 1e-3, len(found))
    step[[n.endswith(".gain") for n in found.names]] = 0.0
    moved = moved_legs(legs, found.place, step)
    home = home_of_legs(machine, moved, 0.2)
    assert home is not None
    again = load_mechanism(write_model_with(machine, moved, home, tmp_path / "moved", {}))
    apart = vector_of(found, geometries(again), legs) - vector_of(found, moved, legs)
    np.testing.assert_allclose(apart, 0.0, atol=1e-12)
    of_arms = [i for i, n in enumerate(found.names) if ParameterId.parse(n).kind in ARM_KINDS]
    assert len(of_arms) == 4 * len(arms)
    assert np.abs(vector_of(found, moved, legs)[of_arms]).min() > 1e-7


# --- tables -------------------------------------------------------------------------------------


def test_a_table_says_at_which_of_two_readings_a_motor_stands_at_home(tmp_path: Path) -> None:
    table = yaml.safe_load((TABLES / "linear-delta.yaml").read_text())
    for entry in table["actuators"].values():
        entry["travel"] = [-800, 200]  # the carriages may stand below the platform too
    path, shipped = tmp_path / "table.yaml", load_mechanism("linear-delta")

    def at(reading: float) -> Machine:
        stated = {"home_readings": dict.fromkeys(table["actuators"], float(1e3 * reading))}
        path.write_text(yaml.safe_dump(table | stated))
        return create_model(read_table(path), tmp_path / f"{reading:g}").machine

    above = float(inverse_kinematics(shipped, shipped.home)[0])
    below = above - 2.0 * float(np.sqrt(0.4**2 - (0.25 - 0.06) ** 2))
    for reading, sign in ((above, 1), (below, -1)):
        machine = at(reading)
        np.testing.assert_allclose(inverse_kinematics(machine, machine.home), reading, atol=1e-9)
        again = load_mechanism(write_model(machine, tmp_path / f"again{sign}")[0])
        modes = {leg.mode for leg in (*machine.legs, *again.legs)}
        assert modes == {sign * shipped.legs[0].mode}
    with pytest.raises(ModelError, match=r"'rail1'.* correct home or home_readings"):
        at(above - 0.05)


def test_rods_of_other_joints_are_loaded_as_they_were_stated(tmp_path: Path) -> None:
    """Build each kind of rod once, on an arm and on a carriage, and write it as a model again."""
    table = yaml.safe_load((TABLES / "servo-hexapod.yaml").read_text())
    del table["type"]
    table["types"] = ["RSU", "RUS", "RSS", "PUS", "PSU", "PSS"]
    for name in ("servo4", "servo5", "servo6"):
        table["actuators"][name] = {"direction": [0, 0.1, 1], "travel": [-20, 30]}
    path = tmp_path / "mixed.yaml"
    path.write_text(yaml.safe_dump(table | {"name": "mixed", "home": None}, sort_keys=False))
    machine = create_model(read_table(path), tmp_path).machine
    assert [leg.type for leg in machine.legs] == table["types"]
    assert machine.mobility == len(machine.motors) == 6
    again = load_mechanism(write_model(machine, tmp_path / "again")[0])
    assert [leg.actuator.joint for leg in again.legs if leg.actuator] == list(machine.motor_names)
    np.testing.assert_array_equal(again.A_base, machine.A_base)


def test_of_two_readings_at_home_the_one_that_a_file_draws_is_taken(tmp_path: Path) -> None:
    arms = yaml.safe_load((TABLES / "delta.yaml").read_text())
    motors = arms["actuators"]
    wide = {name: arm | {"travel_deg": [-175, 175]} for name, arm in motors.items()}
    table = arms | {"actuators": wide, "home_readings_deg": dict.fromkeys(motors, 20)}
    machine = create_model(described_machine(table, Path("wide")), tmp_path).machine
    export(Subject(machine, "wide"), "mjcf", tmp_path / "wide.xml")
    back = load_mechanism(tmp_path / "wide.xml")
    assert [leg.mode for leg in back.legs] == [leg.mode for leg in machine.legs]
    np.testing.assert_allclose(readings_at(back, back.home), np.radians(20.0), atol=1e-9)
