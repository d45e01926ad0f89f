"""How much the result depends on each number of a room's ``tuning.py``.

    OMP_NUM_THREADS=1 python benchmarks/constants.py --room perception|calibration
        [--only NAME ...] [--sessions NAME ...] [--independent FOLDER] [--factors 0.5 0.7 1.4 2]
    python benchmarks/constants.py --table | --check

Small sessions are calibrated with one number times a factor, the others as they are:

example, 3-rps
    Nine photographs of the example at half their size, and of a simulated 3-RPS. With
    ``--independent``, also nine photographs of a session with a truth by another renderer. All are
    without rough camera poses, so that recognition counts.
hexapod outlines, tricept outlines, linear-delta outlines
    For the calibration room also tables of outlines a tenth of which are wrong.

A line of JSON for each number, factor and session has the outlines used, the error of the platform
against the truth [leg lengths], and the stated error; lines that the file has are not measured
again. ``--table`` prints all lines, with the plateau of each number: the factors about 1 at which
no session loses 5 % of its outlines, gets half again as wrong as before (and wronger than it
states), or fails. ``--check`` says which numbers no code uses.
"""

import argparse
import ast
import json
import shutil
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from tempfile import TemporaryDirectory

import cv2
import yaml

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))

from csv_rows import read_rows, write_rows
from hexapod_example import write_halved_camera
from start_dependence import Session as Simulated
from start_dependence import session_folder

from legcal.machine.loader import load_mechanism
from legcal.simulation.settings import Level

ROOT = Path(__file__).parents[1]
ROOMS = ("perception", "calibration")
OUTLINES = {
    "hexapod outlines": Simulated("hexapod", Level.OUTLINES, 8, 3, 10),
    "tricept outlines": Simulated("tricept", Level.OUTLINES, 9, 3, 10),
    "linear-delta outlines": Simulated("linear-delta", Level.OUTLINES, 10, 3, 6),
}
RECORDED = Path(__file__).with_suffix(".jsonl")
FACTORS = (0.5, 0.7, 1.4, 2.0)
IMAGES = 3  # of each view
FEWER, WORSE = 0.95, 1.5  # outlines used, and error, against those at factor 1
TRIAL = """
import json, sys
import legcal.{room}.tuning as tuning
name, factor = sys.argv[1], float(sys.argv[2])
if name:
    source = open(tuning.__file__, encoding="utf-8").read()
    before = "\\n" + name + " = "
    number = source.split(before)[1].split("\\n")[0]
    exec(compile(source.replace(before + number, before + repr(factor * float(number))),
                 tuning.__file__, "exec"), tuning.__dict__)
from legcal import calibrate, evaluate
from legcal.errors import LegcalError
try:
    found = calibrate(sys.argv[3], use_cache=False, output=sys.argv[5])
except LegcalError as error:
    print(json.dumps({{"said": str(error)[:200]}}))
else:
    result = found.result
    off = evaluate(sys.argv[5] + "/calibrated.yaml", sys.argv[4], dataset=sys.argv[3])
    print(json.dumps({{
        "used": int(result.observations.used), "off": float(off.displacement.mean()),
        "stated": result.platform.sigma_dX_m,
    }}))
"""


@dataclass(frozen=True)
class Line:
    """What a session came to with one number times a factor."""

    room: str
    number: str  # "" where nothing is changed
    factor: float
    session: str
    used: int = 0
    off: float = float("nan")  # error of the platform [leg lengths]
    stated: float = float("nan")  # one standard deviation of it
    said: str = ""  # why it failed


@dataclass(frozen=True)
class Session:
    """A small dataset, and the true model of its machine."""

    name: str
    dataset: Path
    truth: Path


def numbers(room: str) -> list[str]:
    """Return the names of the numbers of a room that are not made from others."""
    text = (ROOT / f"legcal/{room}/tuning.py").read_text(encoding="utf-8")
    pairs = [line.split(" = ") for line in text.splitlines() if " = " in line]
    return [name for name, value in pairs if name.isupper() and _is_number(value)]


def unused(room: str) -> list[str]:
    """Return the numbers of a room that neither its modules nor other numbers of it use."""
    used = set[str]()
    for path in (ROOT / f"legcal/{room}").rglob("*.py"):
        tree = ast.parse(path.read_text(encoding="utf-8"))
        names = [node for node in ast.walk(tree) if isinstance(node, ast.Name)]
        used |= {name.id for name in names if isinstance(name.ctx, ast.Load)}
    return [name for name in numbers(room) if name not in used]


def _is_number(text: str) -> bool:
    try:
        float(text)
    except ValueError:
        return False
    return True


def small(source: Path, folder: Path) -> None:
    """Copy the first images of each view at half their size, without rough camera poses."""
    shutil.copytree(source, folder, ignore=shutil.ignore_patterns(".legcal*", "images", "truth"))
    rows, n_of_view = [], dict[str, int]()
    (folder / "images").mkdir(exist_ok=True)
    for row in read_rows(source / "measurements.csv"):
        n_of_view[row["view"]] = n_of_view.get(row["view"], 0) + 1
        if n_of_view[row["view"]] > IMAGES:
            continue
        picture = cv2.imread(str(source / row["image"]), cv2.IMREAD_UNCHANGED)
        if picture is None:
            raise OSError(f"{source / row['image']} is no image")
        row["image"] = f"images/{row['view']}_{n_of_view[row['view']]}.png"
        picture = cv2.resize(picture, None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA)
        cv2.imwrite(str(folder / row["image"]), picture)
        rows.append(row)
    write_rows(folder / "measurements.csv", rows)
    entry = yaml.safe_load((folder / "dataset.yaml").read_text(encoding="utf-8"))
    cameras = set[str]()
    for view in entry["views"].values():
        view.pop("T_base_camera", None)
        view.pop("legs", None)
        cameras.add(view["camera"])
    (folder / "dataset.yaml").write_text(yaml.safe_dump(entry, sort_keys=False), encoding="utf-8")
    for name in cameras:
        write_halved_camera(folder / name, folder / name)


def sessions(room: str, folder: Path, independent: Path | None) -> list[Session]:
    """Make the sessions of a room in a folder that may have them already."""
    made = list[Session]()
    if room == "calibration":
        for name, simulated in OUTLINES.items():
            dataset = session_folder(name, simulated, folder)
            truth = dataset / f"truth/models/{simulated.model}.yaml"
            made.append(Session(name, dataset, truth))
    sources = {
        "example": (
            ROOT / "examples/hexapod",
            ROOT / "tests/data/hexapod-truth/models/hexapod.yaml",
        )
    }
    if independent is not None:
        truth = next(independent.with_name(f"{independent.name}-truth").glob("models/*.yaml"))
        sources[independent.name] = independent, truth
    shot = folder / "3-rps-shot"
    if not shot.exists():
        words = ["simulate", ROOT / "models/3-rps.yaml", "-o", shot, "--poses", IMAGES]
        words += ["--seed", 4, "-q"]
        subprocess.run([sys.executable, "-m", "legcal", *map(str, words)], check=True,
                       capture_output=True)  # fmt: skip
    sources["3-rps"] = shot, shot / "truth/models/3-rps.yaml"
    for name, (source, truth) in sources.items():
        dataset = folder / name
        if not dataset.exists():
            small(source, dataset)
        made.append(Session(name, dataset, truth))
    return made


def trial(room: str, number: str, factor: float, session: Session, size: float) -> Line:
    """Calibrate a session with a number times a factor, in a process of its own."""
    with TemporaryDirectory() as scratch:
        words = [number, str(factor), str(session.dataset), str(session.truth), f"{scratch}/out"]
        code = TRIAL.format(room=room)
        done = subprocess.run(
            [sys.executable, "-c", code, *words], capture_output=True, text=True, check=False
        )
    if done.returncode:
        why = done.stderr.strip().splitlines()[-1][:200]
        return Line(room, number, factor, session.name, said=why)
    line = Line(room, number, factor, session.name, **json.loads(done.stdout.splitlines()[-1]))
    return replace(line, off=line.off / size, stated=line.stated / size)


def recorded(path: Path) -> list[Line]:
    """Return the lines of a file; none if there is no file."""
    if not path.exists():
        return []
    return [Line(**json.loads(text)) for text in path.read_text(encoding="utf-8").splitlines()]


def is_worse(line: Line, usual: Line) -> bool:
    """Say whether a trial is clearly worse than with the number as it is."""
    if line.said:
        return not usual.said
    few = line.used < FEWER * usual.used
    return few or line.off > max(WORSE * usual.off, 2.0 * line.stated)


def plateaus(lines: list[Line], room: str) -> Iterator[tuple[str, float, float, list[Line]]]:
    """Return each number with the least and greatest factor about 1 at which nothing is worse."""
    of_room = [line for line in lines if line.room == room]
    usual = {line.session: line for line in of_room if not line.number}
    for number in dict.fromkeys(line.number for line in of_room if line.number):
        trials = [line for line in of_room if line.number == number and line.session in usual]
        bad = {line.factor for line in trials if is_worse(line, usual[line.session])}
        tried = sorted({line.factor for line in trials} | {1.0})
        low = max((f for f in bad if f < 1.0), default=0.0)
        high = min((f for f in bad if f > 1.0), default=float("inf"))
        within = [factor for factor in tried if low < factor < high]
        yield number, within[0], within[-1], trials


def table(lines: list[Line], room: str) -> None:
    """Print the plateau of each number, and the outlines and errors of each session."""
    usual = {line.session: line for line in lines if line.room == room and not line.number}
    print(f"{room}: {', '.join(numbers(room))}")
    for line in usual.values():
        print(f"{line.session:>22}: {line.used} outlines used, off {1e4 * line.off:.2f} e-4 of a "
              f"leg ({1e4 * line.stated:.2f} stated)")  # fmt: skip
    print(f"{'':20}plateau      outlines used and error against factor 1")
    for number, low, high, trials in plateaus(lines, room):
        if all((t.used, t.off) == (usual[t.session].used, usual[t.session].off) for t in trials):
            names = dict.fromkeys(line.session for line in trials)
            print(f"{number:20}no part in {', '.join(names)}")
            continue
        words = []
        for factor in sorted({line.factor for line in trials}):
            each = [
                "failed"
                if line.said
                else f"{100 * (line.used / usual[line.session].used - 1):+.0f}% "
                f"x{line.off / usual[line.session].off:.2f}"
                for line in trials
                if line.factor == factor
            ]
            words.append(f"{factor:g}: {', '.join(each)}")
        print(f"{number:20}{low:g} to {high:g}   {'; '.join(words)}")


def main() -> None:
    """Measure what is missing, then print the table."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--room", choices=ROOMS, help="both with --table or --check")
    parser.add_argument("--only", nargs="+", help="these numbers alone")
    parser.add_argument("--sessions", nargs="+", help="these sessions alone")
    parser.add_argument("--independent", type=Path, help="a dataset, its truth in NAME-truth")
    parser.add_argument("--factors", type=float, nargs="+", default=FACTORS)
    parser.add_argument("--keep", type=Path, help="folder for the sessions")
    parser.add_argument("--table", action="store_true", help="measure nothing")
    parser.add_argument("--check", action="store_true", help="only say which numbers are not used")
    parser.add_argument("-o", "--output", type=Path, default=RECORDED)
    options = parser.parse_args()
    rooms = [options.room] if options.room else list(ROOMS)
    if options.check:
        lost = [f"{room}: {name}" for room in rooms for name in unused(room)]
        print("\n".join(lost) or f"all {sum(len(numbers(room)) for room in rooms)} are used")
        sys.exit(1 if lost else 0)
    if not options.table:
        if options.room is None:
            parser.error("--room says whose numbers to sweep")
        measure(options)
    for room in rooms:
        table(recorded(options.output), room)


def measure(options: argparse.Namespace) -> None:
    """Add the lines that the file does not have."""
    room, lines = options.room, recorded(options.output)
    done = {(line.room, line.number, line.factor, line.session) for line in lines}
    tried = [("", 1.0)]
    tried += [(name, f) for name in options.only or numbers(room) for f in options.factors]
    with TemporaryDirectory() as scratch, options.output.open("a", encoding="utf-8") as file:
        every = sessions(room, options.keep or Path(scratch), options.independent)
        for number, factor in tried:
            for session in every:
                if options.sessions and session.name not in options.sessions:
                    continue
                if (room, number, factor, session.name) in done:
                    continue
                size = load_mechanism(session.truth).size
                line = trial(room, number, factor, session, size)
                file.write(json.dumps(asdict(line)) + "\n")
                file.flush()


if __name__ == "__main__":
    main()
