"""Configurations of firmwares, in their own numbers: read as machines, and written again."""

from pathlib import Path

import numpy as np
import pytest

from legcal.exports.formats import export
from legcal.machine.dimensions import Dimensions
from legcal.machine.family import description_of
from legcal.machine.firmware_files import read_delta
from legcal.machine.model import Machine
from legcal.machine.model_builder import create_model

KLIPPER = """
[stepper_a]
step_pin: PF0
position_endstop: 301.35
arm_length: 330.25
angle: 209.6
[stepper_b]
position_endstop: 300.9  # above the bed
arm_length = 330.75
[stepper_c]
position_endstop: 299.0
[printer]
kinematics: delta
delta_radius: 168.2
print_radius: 120
#*# <---------------------- SAVE_CONFIG ---------------------->
#*# [stepper_c]
#*# position_endstop = 300.6
#*# angle = 90.45
"""
KLIPPER_ARMS = """
[stepper_a]
gear_ratio: 107:16, 60:16
position_endstop: 250
upper_arm_length: 168.5
lower_arm_length: 322
[stepper_b]
lower_arm_length: 321.25
angle: 150.8
[stepper_c]
upper_arm_length: 169
position_endstop: 251.5
[printer]
kinematics: rotary_delta
shoulder_radius: 35.4
shoulder_height: 411.2
"""
DUET = """
G21
M665 L289.1:288.7:289.4 R131.15 B110 H305.2 X-0.4 Y0.25 Z0.1 ; all of it
M666 X0.35 Y-0.2 Z-0.15
"""
DUET_ARMS = """
M669 K10 U101.5:101.2:100.9 L221:220.4:220.7 H242:242.5:241.6 R48.2 A-40:62 X0.3 Y-0.2 Z0.15
M666 X0.2 Y-0.3 Z0.1
"""
MARLIN = """
; Marlin, from M503
  M665 L250.4 R124.3 H252.7 S200 X0.12 Y-0.31 Z0.05 A0.2 B-0.3 C0.1
  M666 X-0.4 Y0 Z-0.75
"""
MARLIN_HEADER = """
#define DELTA
#if ENABLED(DELTA)
  #define DELTA_PRINTABLE_RADIUS 110.0 // mm
  #define DELTA_DIAGONAL_ROD 250.4        // mm
  #define DELTA_HEIGHT 252.7
  #define DELTA_ENDSTOP_ADJ { -0.4, 0.0, -0.75 }
  #define DELTA_RADIUS 124.3
  #define DELTA_TOWER_ANGLE_TRIM { 0.12, -0.31, 0.05 }
  //#define DELTA_RADIUS_TRIM_TOWER { 1.0, 0.0, 0.0 }
  #define DELTA_DIAGONAL_ROD_TRIM_TOWER { 0.2, -0.3, 0.1 }
#endif
"""
CONFIGURATIONS = {
    "klipper": KLIPPER,
    "klipper-arms": KLIPPER_ARMS,
    "reprapfirmware": DUET,
    "reprapfirmware-arms": DUET_ARMS,
    "marlin": MARLIN,
    "marlin-header": MARLIN_HEADER,
}


def machine_of(text: str, folder: Path, name: str = "printer.txt", **options: object) -> Machine:
    """Return the machine of a configuration; the name of its file says nothing."""
    path = folder / name
    path.write_text(text)
    return create_model(
        description_of(path, Dimensions(**options)),  # type: ignore[arg-type]
        folder,
        force=True,
    ).machine


def numbers_in(text: str) -> list[float]:
    """Return the numbers of a Delta, in the order of its fields."""
    ideal = read_delta(Path("text"), text)
    fields = (ideal.radius, ideal.angle, ideal.rod, ideal.arm, ideal.height, ideal.stop)
    return np.concatenate(fields).tolist()


@pytest.mark.parametrize("name", CONFIGURATIONS)
def test_a_configuration_is_written_as_it_was_read(name: str, tmp_path: Path) -> None:
    text = CONFIGURATIONS[name]
    machine = machine_of(text, tmp_path)
    path = tmp_path / "again.txt"
    exported = export(machine.yaml_path, name.split("-", maxsplit=1)[0], path)
    np.testing.assert_allclose(numbers_in(path.read_text()), numbers_in(text), atol=1e-6)
    assert exported.figures["remaining_mm"]["max"] < 1e-6
