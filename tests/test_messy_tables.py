"""Tables that a person reads at once: languages, titles, remarks, units, diameters, workbooks."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from command_line import Outcome, run
from csv_rows import read_rows, write_rows
from simulated import simulated

from legcal import load_dataset, load_mechanism
from legcal.calibration.location.tool_poses import read_tool_poses
from legcal.data.readings_sheet import ReadingsSheet
from legcal.descriptions.description import Description, assemble
from legcal.descriptions.new_model import Dimensions, create_model, description_of
from legcal.errors import DatasetError
from legcal.files.table import Column, read_table
from legcal.machine.kinematics import forward_kinematics_many
from legcal.machine.model import Machine, readings_at

BASE = [(289.8, 77.6), (-77.6, 289.8), (-212.1, 212.1), (-212.1, -212.1), (-77.6, -289.8),
        (289.8, -77.6)]  # fmt: skip
PLATFORM = [(106.1, 106.1), (38.8, 144.9), (-144.9, 38.8), (-144.9, -38.8), (38.8, -144.9),
            (106.1, -106.1)]  # fmt: skip


def wide(
    header: str, *more: str, leg: str = "", size: float = 1.0, mark: str = "", at: float = 0.0
) -> str:
    """Return a row for each leg; semicolons in the header make commas of points."""
    rows = []
    for j, (A, B) in enumerate(zip(BASE, PLATFORM, strict=True), 1):
        numbers = [f"{size * x:g}{mark}" for x in (*A, 0.0, *B, at)]
        rows.append([*([leg.format(j)] if leg else []), *numbers, *more])
    return joined(header, rows)


def points(header: str, base: str, platform: str, *more: str) -> str:
    """Return a row for each joint."""
    named = [(name, joints) for name, joints in ((base, BASE), (platform, PLATFORM))]
    rows = [
        [*name.format(j).split("|"), f"{x:g}", f"{y:g}", "0", *more]
        for name, joints in named
        for j, (x, y) in enumerate(joints, 1)
    ]
    return joined(header, rows)


def joined(header: str, rows: Sequence[Sequence[str]]) -> str:
    between = next((mark for mark in ";\t," if mark in header), " ")
    lines = [between.join(row) for row in rows]
    lines = [line.replace(".", ",") for line in lines] if between == ";" else lines
    return "\n".join([*([header] if header else []), *lines]) + "\n"


POINTS = "Point,X [mm],Y [mm],Z [mm]"
B_AND_P = points(POINTS, "B{}", "P{}")
SIX = "{0} X [mm];{0} Y [mm];{0} Z [mm];{1} X [mm];{1} Y [mm];{1} Z [mm]"


def one_row() -> str:
    points = {f"B{j + 1}": A for j, A in enumerate(BASE)}
    points |= {f"P{j + 1}": B for j, B in enumerate(PLATFORM)}
    header = ",".join(f"{name}{axis}" for name in points for axis in "xyz")
    return header + "\n" + ",".join(f"{x:g},{y:g},0" for x, y in points.values()) + "\n"


TABLES = {  # content, and the radii of tube and rod in it [mm]
    "German": (wide("Zylinder;" + SIX.format("Boden", "Plattform"), leg="Zylinder {}"), ()),
    "title, blank line, units, remarks": (
        points("Hexapod Labor 2, Stand Mai\n\nPunkt;X;Y;Z\n;mm;mm;mm", "A{} (Boden)",
               "B{} (Plattform)"), ()),
    "French, tube and rod": (
        wide("Vérin;" + SIX.format("Base", "Nacelle") + ";Longueur min (mm);Longueur max (mm);"
             "Diamètre corps (mm);Diamètre tige (mm)", "380", "500", "28", "16", leg="V{}"),
        (14, 8)),
    "units below": (
        wide("Nr.;unten x;unten y;unten z;oben x;oben y;oben z;Länge min;Länge max;Ø Rohr;Ø Stange"
             "\n" + ";mm" * 10, "380.0", "500.0", "28", "16", leg="{}"), (14, 8)),
    "cylinder and side": (
        points("Joint,X (mm),Y (mm),Z (mm)", "Cylinder {} bottom", "Cylinder {} top"), ()),
    "units in cells": (
        wide("leg,bx,by,bz,px,py,pz,min length,max length,rod diameter,tube diameter",
             "380 mm", "500 mm", "16 mm", "28 mm", leg="{}", mark=" mm"), (14, 8)),
    "groups": (
        wide(";Boden;;;Plattform;;\nBein;X;Y;Z;X;Y;Z\n;mm;mm;mm;mm;mm;mm", leg="{}"), ()),
    "groups beside columns of their own": (
        "Stand Mai;;;;;;;;;;\n;Boden;;;Plattform;;;Länge min;Länge max;Ø Rohr;Ø Stange\n"
        + wide("Bein;X;Y;Z;X;Y;Z;;;;", "380", "500", "28", "16", leg="{}")
        .replace("\n", "\n;mm;mm;mm;mm;mm;mm;mm;mm;mm;mm\n", 1), (14, 8)),
    "line below": (wide(SIX.format("b", "p")) + "gemessen mit Messschieber;;;;;\n", ()),
    "metres and millimetres": (
        wide("leg,base x [m],base y [m],base z [m],platform x [m],platform y [m],platform z [m],"
             "min length [m],max length [mm],diameter [mm]", "0.38", "500", "20", leg="{}",
             size=1e-3), (10, 10)),
    "side and number": (points("Seite;Nr;X [mm];Y [mm];Z [mm]", "Boden|{}", "Plattform|{}"), ()),
    "shortest and longest": (
        wide("Bein;" + SIX.format("Basis", "Plattform") + ";kürzeste Länge;längste Länge;Radius",
             "380", "500", "10", leg="{}"), (10, 10)),
    "stroke": (
        wide("Strebe;" + SIX.format("Boden", "Oben") + ";min. Länge;Hub;Durchmesser", "380", "120",
             "20", leg="S{}"), (10, 10)),
    "workshop English": (
        wide("Actuator #,Base joint X (mm),Base joint Y (mm),Base joint Z (mm),"
             "Platform joint X (mm),Platform joint Y (mm),Platform joint Z (mm),Min. length (mm),"
             "Max. length (mm),Tube OD (mm),Rod dia. (mm)", "380", "500", "28", "16", leg="{}"),
        (14, 8)),
    "no headings": (points("", "Boden{}", "Plattform{}"), ()),
    "typeset minus, inch of a diameter sign": (
        wide("Bein;" + SIX.format("Boden", "Plattform") + ";Durchmesser", "Ø 20 mm", leg="{}")
        .replace("-", "−"), (10, 10)),
    "thousands": (
        wide("Bein;" + SIX.format("Boden", "Plattform").replace("mm", "um")
             + ";min. Länge (mm);max. Länge (um);Durchmesser (um)", "380", "500\u202f000.0",
             "?", leg="{}", size=1e3)
        .replace("289800", "289'800").replace("-77600", "−77,6e3").replace("77600", "77.600")
        .replace("?", "20.000,0"), (10, 10)),
    "bars": (
        "\n".join(
            f"| {' | '.join(row.split(';'))} |".replace(",", ".")
            for row in wide("Leg;" + SIX.format("Base", "Top") + "\n" + ";".join(["---"] * 7),
                            leg="{}").splitlines()), ()),
    "a column for each leg": (
        "\n".join(map(";".join, zip(*(
            row.split(";") for row in wide("Bein;" + SIX.format("Boden", "Plattform"),
                                           leg="Bein {}").splitlines()), strict=True))), ()),
    "one block below the other": (
        "".join(f"{side}\nNr.;X [mm];Y [mm];Z [mm]\n" + "".join(
            f"{j};{x:g};{y:g};0\n" for j, (x, y) in enumerate(joints, 1)) + "\n"
                for side, joints in (("Boden", BASE), ("Plattform", PLATFORM))), ()),
    "retracted and extended": (
        wide("No.,Lower ball X mm,Lower ball Y mm,Lower ball Z mm,Upper ball X mm,Upper ball Y mm,"
             "Upper ball Z mm,Retracted length mm,Extended length mm", "380", "500", leg="{}"), ()),
    "capitals, empty columns": (
        wide("LEG;BASE_X_MM;BASE_Y_MM;BASE_Z_MM;TOP_X_MM;TOP_Y_MM;TOP_Z_MM;;", "", "", leg="L{}"),
        ()),
    "unit in a remark": (
        "# define the joints, all in mm\n"
        + wide("i;Ax;Ay;Az;Bx;By;Bz;Länge eingefahren;Länge ausgefahren", "380", "500", leg="{}"),
        ()),
    "axis first": (
        wide("Jambe,X base,Y base,Z base,X plate-forme,Y plate-forme,Z plate-forme", leg="J{}"),
        ()),
    "letters": (wide("bx,by,bz,px,py,pz"), ()),
    "one row": (one_row(), ()),
    "platform first": ("\n".join([POINTS, *B_AND_P.splitlines()[:0:-1]]), ()),
    "points by side": (points(POINTS, "Base joint {}", "Platform joint {}"), ()),
}  # fmt: skip


def described(path: Path, text: str, radii: Sequence[float]) -> Description:
    has_unit = any(mark in text for mark in ("mm", "[m]"))
    has_lengths = any(word in text for word in ("380", "0.38"))
    size = 1e-3 if "[m]" in text else 1.0
    given = Dimensions(
        type="UPS",
        unit=None if has_unit else "mm",
        height=400.0 * size,
        min_length=None if has_lengths else 380.0,
        max_length=None if has_lengths else 500.0,
        leg_radius=None if radii else 10.0,
    )
    return description_of(path, given)


def check(made: Description, radii: Sequence[float]) -> None:
    np.testing.assert_allclose([leg.A_base[:2] for leg in made.legs], 1e-3 * np.array(BASE))
    np.testing.assert_allclose([leg.B_platform[:2] for leg in made.legs], 1e-3 * np.array(PLATFORM))
    assert {leg.travel for leg in made.legs} == {(0.0, 0.12)}
    assert {leg.offset for leg in made.legs} == {0.38}
    tube, rod = radii or (10.0, 10.0)
    assert {(leg.tube, leg.rod) for leg in made.legs} == {(1e-3 * tube, 1e-3 * rod)}


@pytest.mark.parametrize("kind", TABLES)
def test_what_a_person_reads_at_once_is_read(kind: str, tmp_path: Path) -> None:
    text, radii = TABLES[kind]
    (tmp_path / "own.csv").write_text(text)
    check(described(tmp_path / "own.csv", text, radii), radii)


@pytest.mark.parametrize("encoding", ["utf-16", "utf-16-le", "utf-16-be", "cp1252"])
def test_tables_are_read_as_spreadsheets_save_them(encoding: str, tmp_path: Path) -> None:
    text, radii = TABLES["German"]
    (tmp_path / "own.csv").write_bytes(text.replace("\n", "\r\n").encode(encoding))
    check(described(tmp_path / "own.csv", text, radii), radii)


def test_points_beside_decimal_commas_are_what_makes_sizes_alike(tmp_path: Path) -> None:
    path = tmp_path / "own.csv"
    path.write_text("a;b;c\n1.234;123.456;1.234.567\n987,5;100,5;-987.654,25\n")
    columns = [Column(name) for name in "abc"]
    table = read_table(path, "table", "row", columns, reshape=lambda lines: lines)
    expected = [[1234.0, 123.456, 1234567.0], [987.5, 100.5, -987654.25]]
    np.testing.assert_array_equal(table.numbers("abc"), expected)


def test_numbers_are_joined_at_thousands_and_names_are_not(tmp_path: Path) -> None:
    path = tmp_path / "own.csv"
    columns = [Column("image", "text"), Column("a [mm]"), Column("b"), Column("c")]
    rows = ["001.002.003.jpg;1\u202f234,5 mm;1'000;1", "192.168.100.200;1\u202f234 mm;-1.000.000;2"]
    for name in ("1'234.jpg", "1 234", "+5.png", "7"):
        rows.append(f"{name};10 mm;5;3")
    remarks = ["Exported from readings.xlsx", "Measured by J.Smith", "see www.acme.com", "18 ok.x1"]
    path.write_text("\n".join(["image;a;b;c", *rows, *remarks]))
    table = read_table(path, "table", "row", columns, reshape=lambda lines: lines)
    assert table.text("image") == tuple(row.partition(";")[0] for row in rows)
    expected = [[1234.5, 1000, 1], [1234, -1e6, 2], *[[10, 5, 3]] * 4]
    np.testing.assert_array_equal(table.numbers(["a [mm]", "b", "c"]), expected)
    path.write_text("note;a;b\n001.002.003.jpg;1;2\n1'234.jpg;1;2\n")
    columns = [Column("note", "text"), Column("a"), Column("b")]
    table = read_table(path, "table", "row", columns, reshape=lambda lines: lines)
    assert table.text("note") == ("001.002.003.jpg", "1'234.jpg")


def test_a_planar_table_states_home_by_joints_as_they_are_at_home(tmp_path: Path) -> None:
    path = tmp_path / "own.csv"
    joints: dict[str, list[tuple[float, float]]]
    joints = {"A": [(0, -400), (346.4, 200), (-346.4, 200)],
              "B": [(100.3, -124.7), (79.2, 116.9), (-139.5, -12.2)]}  # fmt: skip
    rows = [f"{side}{j}{' (home)' * (side == 'B')};{x};{y}" for side, xy in joints.items()
            for j, (x, y) in enumerate(xy, 1)]  # fmt: skip
    path.write_text("\n".join(["Gelenk;X (mm);Y (mm)", *rows]))
    given = Dimensions(type="RPR", min_length=230.0, max_length=370.0, leg_radius=12.0)
    made = assemble(description_of(path, given))
    assert made.planar
    at_home = [made.home.apply(leg.B_platform)[:2] for leg in made.legs]
    np.testing.assert_allclose(at_home, 1e-3 * np.array(joints["B"]), atol=1e-9)
    legs = [f"{j};{ax};{ay};{bx};{by}" for j, ((ax, ay), (bx, by))
            in enumerate(zip(*joints.values(), strict=True), 1)]  # fmt: skip
    path.write_text("\n".join(["Bein;A x;A y;B x (home);B y (home)", *legs]))
    by_leg = assemble(description_of(path, replace(given, unit="mm")))
    np.testing.assert_allclose(by_leg.home.as_matrix(), made.home.as_matrix(), atol=1e-12)
    rows[3:] = ["B1;0;-140", "B2;121.2;70", "B3;-121.2;70"]  # in the platform link
    path.write_text("\n".join(["Gelenk;X (mm);Y (mm)", *rows]))
    (note,) = [note for note in assemble(description_of(path, given)).notes if "Two poses" in note]
    assert "B1 (home)" in note


def test_rods_on_upright_rails_are_named_by_their_towers(tmp_path: Path) -> None:
    path = tmp_path / "own.csv"
    lines = [
        "Rod,Tower,Carriage X (mm),Carriage Y (mm),Carriage Z (mm),Effector X (mm),"
        "Effector Y (mm),Effector Z (mm),Rod length (mm),Rod diameter (mm),Travel (mm)"
    ]
    for j in range(6):
        turn = np.exp(2j * np.pi * (j // 2) / 3)
        A, B = (250 + 30j * (-1) ** j) * turn, (60 + 30j * (-1) ** j) * turn
        cells = [j + 1, "ABC"[j // 2], A.real, A.imag, 402, B.real, B.imag, 0, 400, 10, 200]
        lines.append(",".join(map(str, cells)))
    path.write_text("\n".join(lines))
    made = assemble(description_of(path, Dimensions(type="PSS", height=150.0)))
    motors = [leg.actuator for leg in made.legs]
    assert [motor and motor.joint for motor in motors] == list("AABBCC")
    assert {motor and motor.travel for motor in motors} == {(0.0, 0.2)}
    assert {(leg.name, leg.rod) for leg in made.legs} == {(f"leg{j}", 0.005) for j in range(1, 7)}
    assert any("slide along z" in note for note in made.notes)
    created = create_model(description_of(path, Dimensions(type="PSS", height=150.0)), tmp_path)
    path.write_text("Photo,Tower B (mm),Turm A (mm),C (mm)\np1.jpg,20,10,30\np2.jpg,25,15,35\n")
    q = ReadingsSheet(path, created.machine, "photograph").readings().q
    np.testing.assert_allclose(q, [[0.01, 0.02, 0.03], [0.015, 0.025, 0.035]])


def test_the_sheet_of_a_workbook_that_has_a_table_is_read(tmp_path: Path) -> None:
    openpyxl = pytest.importorskip("openpyxl")
    book = openpyxl.Workbook()
    book.active.append(["Deckblatt"])
    sheet = book.create_sheet("Gelenke")
    for cells in (["Hexapod"], [], ["Bein", "Boden", *[None] * 2, "Plattform", *[None] * 2, "Ø"],
                  [None, *"XYZXYZ"], [None, *["mm"] * 7]):  # fmt: skip
        sheet.append(cells)
    for j, (A, B) in enumerate(zip(BASE, PLATFORM, strict=True), 1):
        sheet.append([f"Zylinder {j}", *A, 0, *B, 0.0, 28])
    book.save(tmp_path / "own.xlsx")
    check(described(tmp_path / "own.xlsx", "mm", (14, 14)), (14, 14))


@pytest.mark.parametrize("mark", [";", " "])
@pytest.mark.parametrize("heading", ["ID", "Label", "Name", "Foto-Nr."])
def test_the_column_of_photographs_is_the_one_that_says_so(
    heading: str, mark: str, tmp_path: Path
) -> None:
    path = tmp_path / "own.csv"
    lines = [[heading, "Datei", *(f"Zylinder{j}" for j in range(1, 7))]]
    lines += [[f"{9 - k}", f"p{k}.jpg", *(f"0,0{k}{j}" for j in range(6))] for k in range(1, 9)]
    path.write_text("\n".join(map(mark.join, lines)))
    sheet = ReadingsSheet(path, load_mechanism("hexapod"), "photograph")
    assert sheet.table.text("image") == tuple(f"p{k}.jpg" for k in range(1, 9))


def test_a_running_number_is_no_photograph(tmp_path: Path) -> None:
    path = tmp_path / "own.csv"
    path.write_text("ID,1,2,3,4,5,6\n1,0.01,0.02,0.03,0.04,0.05,0.06\n")
    assert "image" not in ReadingsSheet(path, load_mechanism("hexapod"), "photograph").table


def test_poses_of_a_tracker_beside_whole_lengths_in_mm_are_read(tmp_path: Path) -> None:
    machine = load_mechanism("hexapod")
    low, high = np.array([leg.travel for leg in machine.legs]).T
    q = low + (high - low) * np.random.default_rng(0).uniform(0.3, 0.7, (8, 6))
    poses = [pose.translation for pose in forward_kinematics_many(machine, q)]
    numbers = np.hstack([machine.q0 + q, poses]) * 1e3
    header = "Messung 3.2.\nPose;" + ";".join(f"Zylinder {j}" for j in range(1, 7)) + ";X;Y;Z\n"
    rows = [[str(k), *(f"{x:.4f}" for x in row)] for k, row in enumerate(numbers, 1)]
    path = tmp_path / "own.csv"
    path.write_text(joined(header + ";mm" * 9, rows))
    found = read_tool_poses(path, machine)
    np.testing.assert_allclose(found.q, q, atol=6e-8)
    np.testing.assert_allclose(found.position, poses, atol=6e-8)
    assert found.unit.startswith("mm, as the heading says, whole lengths")
    assert {found.columns["Zylinder 1 [mm]"], found.columns["X [mm]"]} == {
        machine.legs[0].prismatic,
        "x",
    }


# --- by the command

ENDS = ("--min-length", "380", "--max-length", "500")
OPTIONS = ("--type", "UPS", *ENDS, "--leg-radius", "10", "--height", "400")


def new(folder: Path, text: str, *words: str) -> Outcome:
    (folder / "own.csv").write_text(text)
    return run("new", folder / "own.csv", "-o", folder / "made", *words)


def made(folder: Path) -> Machine:
    return load_mechanism(folder / "made/models/own.yaml")


def test_platform_joints_in_the_base_are_asked_about_and_taken_as_said(tmp_path: Path) -> None:
    text = wide("bx,by,bz,px,py,pz", at=395.5)
    words = ("--unit", "mm", "--type", "UPS", *ENDS)
    for more in ((), ("--height", "400")):
        outcome = new(tmp_path, text, *words, *more)
        assert outcome.code == 2
        assert outcome.err.count("legcal: ") == outcome.err.count("\n") == 1
        assert "look like coordinates of the base" in outcome.err
        assert "platform_in: base" in outcome.err

    def stating(side: str) -> str:
        head, *rows = text.splitlines()
        return "\n".join([f"{head},platform_in", *(f"{row},{side}" for row in rows)])

    outcome = new(tmp_path, stating("base"), *words)
    assert outcome.code == 0
    machine = made(tmp_path)
    np.testing.assert_allclose(machine.home.translation, [0, 0, 0.3955], atol=1e-12)
    np.testing.assert_allclose(machine.B_platform[0], [0.1061, 0.1061, 0], atol=1e-12)
    assert "coordinates of the base at home" in outcome.said
    assert new(tmp_path, stating("platform"), *words, "--force").code == 0
    np.testing.assert_allclose(made(tmp_path).B_platform[0], [0.1061, 0.1061, 0.3955], atol=1e-12)


def test_a_platform_that_is_turned_in_its_link_is_level_and_turned_back_at_its_height(
    tmp_path: Path,
) -> None:
    lines = wide("bx,by,bz,px,py,pz").splitlines()
    turned = [lines[0]]
    for line in lines[1:]:
        *base, x, y, z = line.split(",")
        turned.append(",".join([*base, y, str(-float(x)), z]))  # by -90 deg
    assert new(tmp_path, "\n".join(turned), "--unit", "mm", *OPTIONS).code == 0
    machine = made(tmp_path)
    assert machine.home.rotation.as_euler("xyz", degrees=True)[2] == pytest.approx(90.0)
    q = readings_at(machine, machine.home)
    assert np.ptp(q) < 1e-3


REFUSED: list[tuple[str, Sequence[str], Sequence[str]]] = [
    (wide("bx,by,bz,px,py,pz"), ("--unit", "mm", "--type", "UPS"),
     ("'leg1', 'leg2', 'leg3', 'leg4', 'leg5', 'leg6'", "min_length")),
    (wide("bx,by,bz,px,py,pz"), OPTIONS, ("--unit mm",)),
    (wide("bx,by,bz,px,py,pz"), ("--unit", "mm", *OPTIONS[2:]), ("type", "--type UPS")),
    (wide("bx,by,bz,px,py,pz"), ("--unit", "mm", *OPTIONS, "--base-radius", "9"),
     ("--base-radius", "--family only")),
    (wide("bx,by,bz,px,py,pz"), ("--unit", "mm", *OPTIONS[:-2], "--height", "700"),
     ("'leg1', 'leg2'", "close at home", "380 to 500 mm")),
    (wide("bx,by,bz,px,py,pz [dm]"), OPTIONS, ("dm", "mm, um, nm, cm, m, in, ft")),
    (wide("bx,by,bz,qx,qy,qz"), ("--unit", "mm", *OPTIONS), ("'qx'", "'platform_x'")),
    (B_AND_P.replace("P3,-144.9,38.8,0\n", ""), OPTIONS, ("platform_x",)),
    (points(POINTS, "{}", "{}"), OPTIONS, ("'1'", "B1 and P1")),
    (wide("bx,by,bz,px,py,pz").partition("\n")[2], OPTIONS, ("numbers in the first line",)),
    (wide("u,v,w,r,s,t"), OPTIONS, ("columns 'u', 'v', 'w', 'r', 's', 't'", "columns 'base_x'")),
    (one_row() * 2, ("--unit", "mm", *OPTIONS), ("3 rows", "one complete row")),
    (wide("bx,by,bz,px,py,pz"), ("--unit", "mm", "--max-length", "500", "--type", "UPS"),
     ("max_length alone",)),
]  # fmt: skip


@pytest.mark.parametrize(("text", "words", "named"), REFUSED)
def test_what_tables_lack_is_said_once(
    text: str, words: Sequence[str], named: Sequence[str], tmp_path: Path
) -> None:
    outcome = new(tmp_path, text, *words)
    assert outcome.code == 2
    said = outcome.err
    assert all(word in said for word in named), said
    assert "leg2'" not in said or "'leg1'" in said.split("leg2'")[0]
    assert not (tmp_path / "made").exists()


def test_rows_of_one_table_without_the_other_are_told_in_a_sentence_with_what_helps(
    tmp_path: Path,
) -> None:
    folder = simulated(tmp_path / "set", "hexapod").folder
    readings, outlines = folder / "measurements.csv", folder / "observations.csv"
    rows, seen = read_rows(readings), read_rows(outlines)
    first, second = (row["pose"] for row in rows[:2])

    write_rows(readings, [rows[0], *rows])
    with pytest.raises(DatasetError, match=f"two rows of view c1 with pose {first}") as repeated:
        load_dataset(folder)
    assert len(repeated.value.problems) == 1

    write_rows(readings, rows[2:])
    with pytest.raises(DatasetError, match="add their rows") as missing:
        load_dataset(folder)
    assert len(missing.value.problems) == 1
    write_rows(outlines, [row for row in seen if row["image"] not in (first, second)])
    assert load_dataset(folder).measurements.n_rows == len(rows) - 2
