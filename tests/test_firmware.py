"""Configurations of firmwares, in their own numbers: read as machines, and written again."""

import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from command_line import run
from edits import keyed
from layouts import Layout, LegLayout, write_machine
from lxml import etree
from machines import MACHINES
from scipy.spatial.transform import RigidTransform, Rotation

from legcal import (
    LegcalError,
    Machine,
    ParameterErrors,
    SimulationSettings,
    calibrate,
    export,
    inverse_kinematics,
    load_mechanism,
    simulate,
)
from legcal.descriptions.controllers import firmware_table, ini_entries, read_delta
from legcal.descriptions.new_model import Dimensions, create_model, description_of
from legcal.descriptions.table import described_machine
from legcal.geometry.types import Array
from legcal.machine.configurations import feasible_poses, random_poses
from legcal.machine.model_writer import write_model
from legcal.simulation.settings import Level

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
DUET_AS_MARLIN = """
M555 P2 ; set output to look like Marlin
M569 P0 S1
M584 X0 Y1 Z2
M665 R124.3 L250.4 B85 H252.7
M666 X-0.4 Y0 Z-0.75
"""
CONFIGURATIONS = {
    "klipper": KLIPPER,
    "klipper-arms": KLIPPER_ARMS,
    "reprapfirmware": DUET,
    "reprapfirmware-arms": DUET_ARMS,
    "marlin": MARLIN,
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
    return [float(number) for number in np.concatenate(fields)]


@pytest.mark.parametrize("name", CONFIGURATIONS)
def test_a_configuration_is_written_as_it_was_read(name: str, tmp_path: Path) -> None:
    text = CONFIGURATIONS[name]
    machine = machine_of(text, tmp_path)
    path = tmp_path / "again.txt"
    exported = export(machine.yaml_path, name.split("-", maxsplit=1)[0], path)
    assert etree.parse(exported.paths[1]).getroot().tag.endswith("svg")
    np.testing.assert_allclose(numbers_in(path.read_text()), numbers_in(text), atol=1e-6)
    assert exported.figures["remaining_mm"]["max"] < 1e-6


@pytest.mark.parametrize(
    ("text", "like"),
    [
        (KLIPPER.replace("arm_length", "Arm_Length").replace("delta_r", "Delta_R"), KLIPPER),
        (MARLIN.replace("from M503", "of a former Duet"), MARLIN),
        (MARLIN_HEADER, MARLIN),
    ],
)
def test_a_configuration_means_the_same_however_it_is_spelt(text: str, like: str) -> None:
    np.testing.assert_allclose(numbers_in(text), numbers_in(like))


def test_the_firmware_is_told_by_its_header_and_its_codes() -> None:
    duet, marlin = Path("config"), DUET_AS_MARLIN.partition("M665")
    np.testing.assert_allclose(numbers_in(DUET_AS_MARLIN)[-3:], [252.3, 252.7, 251.95])
    np.testing.assert_allclose(
        numbers_in(f"echo:Marlin 2.1\nM665{marlin[2]}")[-3:], [253.1, 252.7, 253.45]
    )
    _, notes = firmware_table(duet, f"; Marlin\nM665{marlin[2]}") or ({}, ())
    assert "radius of the bed" in notes[0]


def test_files_that_a_configuration_names_are_read_in_their_place(tmp_path: Path) -> None:
    (tmp_path / "axes").mkdir()
    printer = KLIPPER.index("[printer]")
    (tmp_path / "axes" / "towers.cfg").write_text(KLIPPER[:printer])
    (tmp_path / "axes" / "inner.cfg").write_text("[include towers.cfg]\n")
    (tmp_path / "z-bed.cfg").write_text("[bed_mesh]\nspeed: 100\n")
    named = "[include ./axes/in*.cfg] # towers\n[include z-*.cfg]\n[include no/*.cfg]\n"
    file = tmp_path / "printer.cfg"
    assert firmware_table(file, named + KLIPPER[printer:]) == firmware_table(file, KLIPPER)


DOCUMENTED = {
    # angles of towers, radius, rods and the centred nozzle at each endstop, from the documentation
    "klipper": ([209.6, 330, 90.45], 168.2, [330.25, 330.75, 330.25], [301.35, 300.9, 300.6]),
    "reprapfirmware": ([209.6, 330.25, 90.1], 131.15, [289.1, 288.7, 289.4], [305.55, 305, 305.05]),
    "marlin": ([210.12, 329.69, 90.05], 124.3, [250.6, 250.1, 250.5], [253.1, 252.7, 253.45]),
}
ARMS = {
    # and the arms, the heights of their shafts, the endstops as height or angle
    "klipper-arms": (
        [30, 150.8, 270], 35.4, [322, 321.25, 322], [168.5, 168.5, 169], [411.2] * 3,
        [250, 250, 251.5],
    ),
    "reprapfirmware-arms": (
        [210.3, 329.8, 90.15], 48.2, [221, 220.4, 220.7], [101.5, 101.2, 100.9],
        [242, 242.5, 241.6], [62.2, 61.7, 62.1],
    ),
}  # fmt: skip


@pytest.mark.parametrize("name", [*DOCUMENTED, *ARMS])
def test_readings_are_the_positions_of_motors_that_the_firmware_documents(
    name: str, tmp_path: Path
) -> None:
    machine = machine_of(CONFIGURATIONS[name], tmp_path)
    nozzle = np.array([12.0, -34.0, 56.0])
    pose = RigidTransform.from_translation(1e-3 * nozzle)
    q = inverse_kinematics(machine, pose)[::2]
    tops = np.array([actuator.travel[1] for actuator in machine.actuators])
    numbers_of_all: dict[str, Any] = DOCUMENTED | ARMS
    angles, radius, rods, *others = numbers_of_all[name]
    towers = [np.array([np.cos(a), np.sin(a), 0.0]) for a in np.radians(angles)]
    for i, (out, rod) in enumerate(zip(towers, rods, strict=True)):
        if name in DOCUMENTED:
            stop = others[0][i]
            away = float(np.linalg.norm((nozzle - radius * out)[:2]))
            assert 1e3 * q[i] == pytest.approx(nozzle[2] + np.sqrt(rod**2 - away**2), abs=1e-6)
            assert 1e3 * tops[i] == pytest.approx(stop + np.sqrt(rod**2 - radius**2), abs=1e-6)
            continue
        arm, height, stop = (numbers[i] for numbers in others)

        def elbow(angle: float, out: Array = out, arm: float = arm, z: float = height) -> Array:
            up = np.array([0.0, 0.0, z + arm * np.sin(angle)])
            return np.asarray((radius + arm * np.cos(angle)) * out + up)

        assert np.linalg.norm(elbow(q[i]) - nozzle) == pytest.approx(rod, abs=1e-6)
        if name != "klipper-arms":
            assert np.degrees(tops[i]) == pytest.approx(stop, abs=1e-6)
        else:
            assert np.linalg.norm(elbow(tops[i]) - [0, 0, stop]) == pytest.approx(rod, abs=1e-6)


def printer_with_errors(folder: Path) -> Machine:
    """Return a printer whose towers, rods and endstops are not those of its configuration."""
    rng = np.random.default_rng(3)
    table, _ = firmware_table(Path("printer"), KLIPPER) or ({}, ())
    A = np.array(table["base_joints"]).reshape(3, 2, 3)
    for tower in range(3):
        turn = Rotation.from_euler("z", rng.normal(0.0, 0.3), degrees=True)
        A[tower] = turn.apply(A[tower] + rng.normal(0.0, 1.0, 3))  # [mm], z of the endstop
    rods = np.repeat(np.array(table["lengths"][::2]) + rng.normal(0.0, 0.3, 3), 2)
    true = table | {"base_joints": A.reshape(6, 3).tolist(), "lengths": rods.tolist()}
    return create_model(described_machine(true, Path("true")), folder).machine


def off_by(text: str, true: Machine) -> float:
    """Return the error of a firmware's kinematics over the bed of a printer [mm rms].

    Where the bed stands, which probing tells, counts as known.
    """
    q, poses = random_poses(true, 400, 5)
    nozzle = 1e3 * np.array([pose.translation for pose in poses])
    tops = np.array([actuator.travel[1] for actuator in true.actuators])
    ideal = read_delta(Path("text"), text)
    motors = ideal.at_stops - 1e3 * (tops - q[:, ::2])
    usual = ideal.is_usual(motors)
    both = ideal.positions(motors)[usual], nozzle[usual]
    there, nozzle = (points - points.mean(axis=0) for points in both)
    _, distance = Rotation.align_vectors(nozzle, there)
    return float(distance / np.sqrt(len(nozzle)))


def test_poses_of_a_printer_stay_over_its_bed(tmp_path: Path) -> None:
    """Plans, the workspace and copies of the model end where the firmware does."""
    machine = machine_of(KLIPPER, tmp_path)
    copied = load_mechanism(write_model(machine, tmp_path / "copy")[0])
    assert (copied.reach, copied.floor) == (machine.reach, machine.floor) == (0.12, 0.0)
    said = " ".join(run("inspect", copied.yaml_path).out.split())
    assert "within 120.00 mm of the z axis of the base and at or above z = 0.00 mm" in said
    extreme = feasible_poses(copied, 12, np.random.default_rng(1), extreme=True)
    for poses in (extreme.poses, random_poses(copied, 50, 2)[1]):
        at = np.array([pose.translation for pose in poses])
        assert np.hypot(at[:, 0], at[:, 1]).max() <= 0.12
        assert at[:, 2].min() >= 0.0


def test_the_frame_of_an_export_is_said_in_degrees(tmp_path: Path) -> None:
    table, _ = firmware_table(Path("printer"), KLIPPER) or ({}, ())
    turn = Rotation.from_euler("x", 0.4, degrees=True)
    rails = {
        name: motor | {"direction": turn.apply(motor["direction"]).tolist()}
        for name, motor in table["actuators"].items()
    }
    home = {"xyz": turn.apply(table["home"]["xyz"]).tolist(), "rpy_deg": [0.4, 0.0, 0.0]}
    A = turn.apply(table["base_joints"]).tolist()
    tilted = table | {"base_joints": A, "actuators": rails, "home": home}
    machine = create_model(described_machine(tilted, Path("tilted")), tmp_path).machine
    exported = export(machine, "klipper", tmp_path / "printer.cfg")
    assert "0.4 deg away" in exported.paths[0].read_text()
    assert exported.figures["remaining_mm"]["max"] < 1e-3


@pytest.mark.system
def test_a_calibrated_printer_prints_with_what_was_exported(tmp_path: Path) -> None:
    nominal, true = machine_of(KLIPPER, tmp_path), printer_with_errors(tmp_path / "true")
    perfect = ParameterErrors()
    made = SimulationSettings(Level.OUTLINES, perfect, poses=8, sampling="workspace", seed=4)
    folder = tmp_path / "session"
    simulate(true, folder, made)
    keyed("dataset.yaml", mechanism=str(nominal.yaml_path))(folder)
    calibrate(folder, output=tmp_path / "out")
    exported = export(tmp_path / "out", "klipper", tmp_path / "printer.cfg")
    before, after = off_by(KLIPPER, true), off_by(exported.paths[0].read_text(), true)
    assert before > 0.3
    assert after < before / 5.0
    assert exported.figures["nominal_mm"]["rms"] == pytest.approx(before, rel=0.3)
    assert abs(exported.figures["remaining_mm"]["rms"] - after) < 0.01


def test_lines_of_a_calibration_in_doubt_say_its_verdict_first(tmp_path: Path) -> None:
    """Outlines of one view tell little of a printer; sure results have no such line."""
    folder = tmp_path / "session"
    made = SimulationSettings(Level.OUTLINES, ParameterErrors(), poses=5, views=1, seed=4)
    simulate(machine_of(KLIPPER, tmp_path), folder, made)
    keyed("dataset.yaml", machine_kind="printed")(folder)
    found = calibrate(folder, output=tmp_path / "out", only="all")
    assert not found.verdict.trustworthy
    exported = export(tmp_path / "out", "klipper", tmp_path / "printer.cfg")
    assert exported.notes[0] == found.verdict.sentence
    assert exported.paths[0].read_text().splitlines()[1] == f"# {found.verdict.sentence}"
    keyed("result.json", trustworthy=True, doubts=[])(tmp_path / "out")
    again = export(tmp_path / "out", "klipper", tmp_path / "printer.cfg", force=True)
    assert again.notes == exported.notes[1:]


# --- hexapods -----------------------------------------------------------------------------------

INI = """
[KINS]
KINEMATICS = genhexkins
[HAL]
HALFILE = LIB:basic_sim.tcl
HALFILE = struts.hal
[TRAJ]
LINEAR_UNITS = inch
HOME = 0.25 -0.5 21 1 -2 3
"""
FLYPT = """
<FLYPT_MOVER Version="3.5.3"><RIG><Type>Mover.Rigs.LinearHexapod</Type><CONTROLS>
<NUDCORX>15</NUDCORX><NUDCORY>-20</NUDCORY><NUDCORZ>240</NUDCORZ>
<NUDRigL1>812.5</NUDRigL1><NUDRigL2>95</NUDRigL2><NUDRigL3>130.5</NUDRigL3>
<NUDRigL4>1100</NUDRigL4><NUDRange>150</NUDRange><NUDMiddle>860</NUDMiddle>
</CONTROLS></RIG></FLYPT_MOVER>
"""
SIX = np.arange(6)
BASE = 18.0 * np.stack([np.cos(SIX + 0.1), np.sin(SIX + 0.1), 0.01 * SIX], axis=1)
PLATFORM = 9.0 * np.stack([np.cos(SIX + 0.4), np.sin(SIX + 0.4), -0.02 * SIX], axis=1)


def pins(base: Array = BASE, platform: Array = PLATFORM) -> str:
    """Return the setp lines of a hexapod, and the INI sections of its joints."""
    lines = [
        f"setp genhexkins.{side}.{j}.{axis} {x!r}"
        for side, points in (("base", base), ("platform", platform))
        for j, point in enumerate(points.tolist())
        for axis, x in zip("xyz", point, strict=True)
    ]
    return "\n".join(lines)


def joints(offset: float = 15.0, limits: tuple[float, float] = (16.0, 30.0)) -> str:
    sections = (
        f"[JOINT_{j}]\nHOME_OFFSET = {offset + 0.1 * j}\nMIN_LIMIT = {limits[0]}\n"
        f"MAX_LIMIT = {limits[1]}\n"
        for j in range(6)
    )
    return "".join(sections)


def test_a_linuxcnc_hexapod_in_inches_comes_back_from_its_hal_file(tmp_path: Path) -> None:
    (tmp_path / "struts.hal").write_text(pins())
    machine = machine_of(INI + joints(), tmp_path, "machine.txt")
    np.testing.assert_allclose(machine.A_base, 0.0254 * BASE, atol=1e-12)
    np.testing.assert_allclose(machine.B_platform, 0.0254 * PLATFORM, atol=1e-12)
    np.testing.assert_allclose(machine.home.translation, 0.0254 * np.array([0.25, -0.5, 21.0]))
    np.testing.assert_allclose(
        machine.home.rotation.as_euler("xyz", degrees=True), [1.0, -2.0, 3.0], atol=1e-9
    )
    np.testing.assert_allclose([leg.length_at(leg.travel[1]) for leg in machine.legs], 0.0254 * 30)
    backwards = write_machine(tmp_path, MACHINES["6-UPS"](), Layout((LegLayout(flip_slider=True),)))
    for hexapod in (machine, load_mechanism(backwards)):
        path = tmp_path / "again.txt"
        export(hexapod.yaml_path, "linuxcnc", path, force=True)
        text = path.read_text()
        assert not re.search(r"setp .*\.\d{10}", text)  # people read them
        again, ini = machine_of(text, tmp_path, "again.txt"), ini_entries(text)
        np.testing.assert_allclose(again.home.as_matrix(), hexapod.home.as_matrix(), atol=1e-9)
        for j, (one, two) in enumerate(zip(hexapod.legs, again.legs, strict=True)):
            np.testing.assert_allclose(
                [*one.A, *one.B, one.q0], [*two.A, *two.B, two.q0], atol=1e-9
            )
            ends = sorted(map(one.length_at, one.travel))
            np.testing.assert_allclose(ends, [two.length_at(q) for q in two.travel])
            at_home = np.linalg.norm(one.A - hexapod.home.apply(one.B))
            assert float(ini[f"JOINT_{j}.HOME"]) == pytest.approx(1e3 * at_home)


def test_a_rig_of_flypt_is_written_as_it_was_read(tmp_path: Path) -> None:
    machine = machine_of(FLYPT, tmp_path, "rig.txt", leg_radius=20.0)
    path = tmp_path / "again.txt"
    exported = export(machine.yaml_path, "flypt", path)
    values = dict(re.findall(r"^([\w ]+): ([-\d.]+)$", path.read_text(), re.MULTILINE))
    stated = {
        key.removeprefix("Rig").replace("COR", "COR "): float(value)
        for key, value in re.findall(r"<NUD(\w+)>([-\d.]+)<", FLYPT)
    }
    assert {key: float(value) for key, value in values.items()} == pytest.approx(stated, abs=1e-6)
    assert exported.figures["remaining_mm"]["max"] < 1e-6
    assert etree.parse(exported.paths[1]).getroot().tag.endswith("svg")
    lengths = [np.linalg.norm(leg.A - machine.home.apply(leg.B)) for leg in machine.legs]
    np.testing.assert_allclose(lengths, 0.86)


RIG = "L1: 103\nL2: 9.5\nL3: 13\nL4: 110\nRange: 15\nMiddle: 86\n"


@pytest.mark.parametrize(
    ("text", "unit", "metres"),
    [
        (RIG, None, 1e-3),
        (RIG, "cm", 1e-2),
        (RIG.replace("\n", " in\n"), None, 0.0254),
        (RIG.replace(": ", " (inch): "), None, 0.0254),
    ],
)
def test_lengths_of_a_rig_have_the_unit_that_is_stated(
    text: str, unit: str | None, metres: float, tmp_path: Path
) -> None:
    machine = machine_of(text, tmp_path, unit=unit)
    side = np.linalg.norm(machine.B_platform[1] - machine.B_platform[2])
    assert side == pytest.approx(103 * metres)


# --- mistakes -----------------------------------------------------------------------------------


def without(text: str, *parts: str) -> str:
    """Return a configuration without its lines that have some text."""
    return "\n".join(line for line in text.splitlines() if not any(p in line for p in parts))


REFUSED = [
    # configuration, options, words that must be said
    (without(KLIPPER, "arm_length: 330"), {}, ("no arm_length in [stepper_a]", "rods")),
    (f"[include delta.cfg]\n{KLIPPER}", {}, ("included file", "delta.cfg", "no such file")),
    (f"[include printer.txt]\n{KLIPPER}", {}, ("[include printer.txt]", "includes itself")),
    (without(KLIPPER, "kinematics"), {}, ("kinematics nowhere", "section [printer]")),
    (KLIPPER.replace("delta\n", "corexy\n"), {}, ("corexy", "delta or rotary_delta")),
    (KLIPPER.replace("330.25", "long"), {}, ("arm_length in [stepper_a]", "'long'")),
    (KLIPPER.replace("209.6", "89"), {}, ("towers c and a 1.45 deg apart", "correct their angles")),
    (KLIPPER.replace("330.25", "13.0").replace("330.75", "13.02"), {},
     ("rods of 13 mm", "--unit in")),
    (KLIPPER.replace("168.2", "368.2"), {}, ("longer than the radius", "one unit")),
    (KLIPPER.replace("330.25", "13.0"), {}, ("13", "330.75", "one unit")),
    (KLIPPER.replace("300.6", "11.8"), {}, ("endstops 11.8 mm", "the unit of the rods")),
    (KLIPPER, {"platform_radius": 150.0}, ("--platform-radius", "150 mm", "below 134.6 mm")),
    (KLIPPER, {"unit": "in"}, ("330.25 in", "30 to 5000 mm")),
    (DUET.replace("L289.1:288.7:289.4", "L289:289:289:289"), {}, ("more than three towers",)),
    (DUET, {"unit": "in"}, ("--unit in and mm", "leave out --unit")),
    (DUET_ARMS.replace("A-40:62", ""), {}, ("no A of M669", "highest angle")),
    (DUET_ARMS.replace("K10", "K4"), {}, ("K4", "K10")),
    (DUET_AS_MARLIN.replace("M569 P0 S1", "; Marlin\nM569 P0 S1"), {}, ("both Marlin", "M584")),
    (MARLIN.replace("B-0.3", "B80"), {}, ("B of M665", "80 mm", "12.52 mm")),
    ("M665 L250 R124 H250\nM666 X-0.5", {}, ("M666", "'; Marlin'")),
    (without(MARLIN_HEADER, "DELTA_RADIUS 1"), {}, ("no R of M665",)),
    (MARLIN_HEADER.replace("#endif", "#else\n#define DELTA_HEIGHT 300\n#endif"), {},
     ("'DELTA_HEIGHT 252.7' in line 6", "'DELTA_HEIGHT 300' in line 13", "one value")),
    (MARLIN_HEADER.replace("#define DELTA\n", "//#define DELTA\n"), {}, ("commented out",)),
    (without(INI, "HALFILE") + joints(), {}, ("genhexkins.base.0.x' and 35 more", "HAL file")),
    (pins(), {"height": 20.0}, ("no unit", "--unit mm or in")),
    (pins(), {"unit": "in"}, ("no HOME in [TRAJ]", "--height")),
    (INI.replace("genhexkins", "trivkins"), {}, ("trivkins", "genhexkins")),
    (INI + pins() + "\n" + joints().replace("HOME_OFFSET = 15.3\n", ""), {},
     ("HOME_OFFSET of 5 joints", "[JOINT_5]")),
    (INI.replace("inch", "cubits") + pins(), {}, ("LINEAR_UNITS = cubits",)),
    (INI.replace("inch", "mm") + pins() + "\n" + joints(380.0, (400.0, 700.0)), {},
     ("limits of 400 to 700", "one unit")),
    (without(FLYPT, "RigL1"), {}, ("no positive L1 and L2 and L3", "'L1: 1030'")),
    (FLYPT.replace("LinearHexapod", "RotaryHexapod"), {}, ("RotaryHexapod", "LinearHexapod")),
    (FLYPT.replace("<NUDMiddle>860", "<NUDMiddle>33"), {}, ("Middle 33", "all in mm")),
    (RIG.replace("L1: 103", "L1: 1,030"), {}, ("L1 could not be read", "'1,030'", "1030 mm")),
    (RIG.replace("L1: 103", "L1: 103 cm"), {}, ("L1 in cm", "L2 in no unit", "one unit")),
    (RIG.replace("L1:", "L1 [ells]:"), {}, ("L1 could not be read", "'[ells] 103'")),
    (RIG.replace(": ", " [mm]: "), {"unit": "in"}, ("--unit in and mm",)),
    ("<robot name='x'/>", {}, ("found XML", "legcal inspect")),
]  # fmt: skip


@pytest.mark.parametrize(("text", "options", "words"), REFUSED)
def test_a_configuration_that_cannot_be_one_is_refused_in_a_sentence(
    text: str, options: dict[str, Any], words: tuple[str, ...], tmp_path: Path
) -> None:
    with pytest.raises(LegcalError) as caught:
        machine_of(text, tmp_path, **options)
    said = caught.value.problems
    assert all(word in said[0] for word in words), said
