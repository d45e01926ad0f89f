"""The first hour of three owners: commands from a table to an export, and how many refuse.

    python benchmarks/first_hour.py [hexapod|linear-delta|3-rpr ...] [--seed 0] [--poses 10]

Each has a table of joints as people write it, photographs of a chessboard, photographs of the
machine in a folder for each place, and a table of readings by their own names and numbers. The
photographs are simulated from the machine of the table with errors, and are all that is kept of the
simulation. The commands are those of the README: new, camera, init, calibrate, export.
"""

from __future__ import annotations

import argparse
import csv
import json
import shlex
import shutil
import subprocess
import sys
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory

from board_photographs import PrintedBoard, photograph_boards

import legcal
from legcal.machine.loader import load_mechanism
from legcal.machine.model import Machine
from legcal.simulation.dataset import simulate
from legcal.simulation.rendering.appearance import Appearance
from legcal.simulation.settings import SimulationSettings
from legcal.vision.camera_file import read_camera

PLACES = ("links", "Mitte", "rechts")
HEXAPOD = """\
Hexapod Werkstatt, gemessen mit Messschieber;;;;;;;;;;
;Boden;;;Plattform;;;Länge min;Länge max;Ø Rohr;Ø Stange
Zylinder;X;Y;Z;X;Y;Z;;;;
;mm;mm;mm;mm;mm;mm;mm;mm;mm;mm
1;-233,8;-135,0;0;-168,9;-97,5;0;341;489;20;20
2;158,7;-218,4;0;-114,6;-157,8;0;341;489;20;20
3;233,8;-135,0;0;168,9;-97,5;0;341;489;20;20
4;109,8;246,7;0;193,9;-20,4;0;341;489;20;20
5;0;270,0;0;0;195,0;0;341;489;20;20
6;-268,5;-28,2;0;-79,3;178,1;0;341;489;20;20
"""
DELTA = """\
Linear Delta, heights above the bed
Rod,Tower,Carriage X (mm),Carriage Y (mm),Carriage Z (mm),Effector X (mm),Effector Y (mm),\
Effector Z (mm),Rod length (mm),Rod diameter (mm),Travel (mm)
1,A,250,-30,402,60,-30,0,400,10,200
2,A,250,30,402,60,30,0,400,10,200
3,B,-99,231.5,402,-4,67,0,400,10,200
4,B,-151,201.5,402,-56,37,0,400,10,200
5,C,-151,-201.5,402,-56,-37,0,400,10,200
6,C,-99,-231.5,402,-4,-67,0,400,10,200
"""
PLANAR = """\
Planar robot, drawing of March
Joint;X (mm);Y (mm)
A1;0;-400
A2;346,4;200
A3;-346,4;200
B1 (home);100,3;-124,7
B2 (home);79,2;116,9
B3 (home);-139,5;-12,2
"""


def whole_lengths(machine: Machine, q: list[float]) -> list[str]:
    """Return lengths of legs [mm] with decimal commas."""
    pairs = zip(machine.legs, q, strict=True)
    return [f"{1e3 * leg.length_at(x):.3f}".replace(".", ",") for leg, x in pairs]


def millimetres(machine: Machine, q: list[float]) -> list[str]:
    """Return readings [mm]."""
    return [f"{1e3 * x:.3f}" for x in q]


@dataclass(frozen=True)
class Owner:
    """A table of joints, options for what it leaves out, and a table of readings."""

    table: str
    options: str  # of legcal new
    between: str  # cells of the table of readings
    photograph: str  # heading of the photographs: their names, or where (2) and the how manyth
    motors: tuple[str, ...]  # headings
    cells: Callable[[Machine, list[float]], list[str]]
    export: str


OWNERS = {
    "hexapod": Owner(
        HEXAPOD,
        "--type SPU --unit mm --height 383",
        ";",
        "Foto",
        tuple(f"Zylinder {j} [mm]" for j in range(1, 7)),
        whole_lengths,
        "linuxcnc -o machine.hal",
    ),
    "linear-delta": Owner(
        DELTA,
        "--type PSS --height 150 --unit mm",
        ",",
        "Photo",
        ("Tower A (mm)", "Tower B (mm)", "Tower C (mm)"),
        millimetres,
        "linuxcnc -o machine.hal",
    ),
    "3-rpr": Owner(
        PLANAR,
        "--type RPR --unit mm --min-length 230 --max-length 370 --leg-radius 12",
        ";",
        "Ort;Bild Nr.",
        ("Antrieb 1", "Antrieb 2", "Antrieb 3"),
        millimetres,
        "urdf -o machine.urdf",
    ),
}


def first_hour(name: str, folder: Path, seed: int, poses: int) -> dict[str, object]:
    """Go from the table of an owner to an export; return commands, refusals and errors."""
    owner, refusals, commands = OWNERS[name], list[str](), 0

    def run(command: str) -> None:
        nonlocal commands
        commands += 1
        words = [sys.executable, "-m", "legcal", *shlex.split(command)]
        done = subprocess.run(words, cwd=folder, capture_output=True, text=True, check=False)
        print(f"$ legcal {command}\n{done.stdout}{done.stderr}", file=sys.stderr, flush=True)
        if done.returncode:
            refusals.append(f"{command.split()[0]}: {done.stderr.strip()}")

    (folder / "joints.csv").write_text(owner.table)
    run(f"new joints.csv {owner.options} -o .")
    if refusals:
        return {"machine": name, "commands": commands, "refusals": refusals}
    machine = load_mechanism(folder / "models/joints.yaml")
    sim = simulate(machine, folder / "sim", SimulationSettings(seed=seed, poses=poses))
    _put_down(owner, machine, sim.folder, folder)
    camera = read_camera(next(sim.folder.glob("camera*.yaml")))
    boards = folder / "boards"
    photograph_boards(boards, PrintedBoard(), camera, Appearance(), 12, seed)
    run("camera boards --board chessboard:10x7:25mm -o camera_info.yaml")
    run(
        "init photos --readings readings.csv --camera camera_info.yaml --model models/joints.yaml "
        "-o session"
    )
    run("calibrate session -o calibrated")
    run(f"export calibrated --to {owner.export}")
    found: dict[str, object] = {"machine": name, "commands": commands, "refusals": refusals}
    if (folder / "calibrated").is_dir():
        result = legcal.load_result(folder / "calibrated")
        before, after = (
            1e3 * float(legcal.evaluate(model, sim.truth_path).displacement.mean())
            for model in (folder / "models/joints.yaml", folder / "calibrated")
        )
        trusted = result.verdict.trustworthy
        found |= {"trusted": trusted, "before_mm": before, "after_mm": after}
    return found


def _put_down(owner: Owner, machine: Machine, dataset: Path, folder: Path) -> None:
    """Copy photographs under plain names, and write the readings as the owner keeps them."""
    rows = list(csv.DictReader((dataset / "measurements.csv").open()))
    joints = [machine.legs[j].prismatic for j in machine.motors]
    views = list(dict.fromkeys(row["view"] for row in rows))
    lines, counts = [[*owner.photograph.split(";"), *owner.motors]], dict.fromkeys(views, 0)
    for k, row in enumerate(rows, start=207):
        place = PLACES[views.index(row["view"])]
        counts[row["view"]] += 1
        photograph = f"IMG_{k:04d}.png"
        (folder / "photos" / place).mkdir(parents=True, exist_ok=True)
        shutil.copy(dataset / row["image"], folder / "photos" / place / photograph)
        named = [photograph]
        if ";" in owner.photograph:
            named = [place, str(counts[row["view"]])]
        lines.append([*named, *owner.cells(machine, [float(row[joint]) for joint in joints])])
    text = "\n".join(owner.between.join(line) for line in lines)
    (folder / "readings.csv").write_text(f"{text}\n")


def main() -> None:
    """Print a line of JSON an owner; what the commands print goes to stderr."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("machines", nargs="*", choices=[*OWNERS, []], default=[])
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--poses", type=int, default=10)
    parser.add_argument("--keep", type=Path, help="an empty folder to work in")
    args = parser.parse_args()
    for name in args.machines or OWNERS:
        with TemporaryDirectory() as temporary:
            folder = Path(temporary) if args.keep is None else args.keep / name
            folder.mkdir(parents=True, exist_ok=True)
            print(json.dumps(first_hour(name, folder, args.seed, args.poses)), flush=True)


if __name__ == "__main__":
    main()
