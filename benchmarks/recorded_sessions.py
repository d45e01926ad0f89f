"""Record the answers of the commands on small sessions, and compare them with the earlier record.

    OMP_NUM_THREADS=1 python benchmarks/recorded_sessions.py [SESSION ...]

runs the sessions, writes tests/recorded_sessions.json and prints the change of each session; with
names it runs these alone and writes nothing. tests/test_recorded_sessions.py compares the answers
with the file. Write it anew only where the new answers are better, and say why in the commit.

The record of a command has its exit code; ``facts``, which must be equal (status, counts, ranks,
kind of an error); ``sizes``, which agree within SIZE_TOLERANCE (predicted errors of the platform,
sums of squares, places of cameras); and ``estimates``, the value and standard deviation of each
parameter, which agree within VALUE_TOLERANCE standard deviations and SIZE_TOLERANCE (for a weak
parameter the standard deviation is that of the platform). The keys of ``--json`` are recorded for
each command: those of all its documents, and for each other key the sessions that have it. Keys
that the data choose (names of legs, views) are written as ``*``. Sentences are not recorded.

The datasets are files in tests/data/recorded, so that they do not change with the simulation.
"""

import argparse
import contextlib
import io
import json
import math
import re
import shutil
import sys
import time
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any
from unittest.mock import patch

import cv2
import numpy as np
from scipy.spatial.transform import Rotation

from legcal import cli
from legcal.planning import places, planner

ROOT = Path(__file__).parents[1]
RECORDED = ROOT / "tests/recorded_sessions.json"
DATASETS = ROOT / "tests/data/recorded"
EXAMPLE = ROOT / "examples/hexapod"

VALUE_TOLERANCE = 0.05  # standard deviations
SIZE_TOLERANCE = 0.02  # relative; of standard deviations too
WORST = 12  # rows of a table of differences

FIT = "--no-report --workers 1"
SESSIONS: dict[str, dict[str, str]] = {  # by session and step: the words after legcal
    "example": {
        "identify": "identify {in}",  # before its outlines are there
        "calibrate": f"calibrate {{in}} -o {{out}}/result {FIT}",
        "evaluate": "evaluate hexapod {tests}/data/hexapod-truth/models/hexapod.yaml"
        " --dataset {in}",
        "locate": "locate hexapod {sets}/tool/hexapod.csv -o {out}/cell.yaml",
    },
    "planar": {  # 3-RPR
        "calibrate": "calibrate {in} -o {out}/result --truth {in}/truth/models/3-rpr.yaml"
        " --workers 1",
        "holdout": f"calibrate {{in}} -o {{out}}/four-fifths --holdout 0.2 {FIT}",
        "check": "calibrate {in} --check {out}/result",
        "check another": "calibrate {sets}/planar-later --check {out}/result",
        "identify": "identify {in}",
        "plan": "plan 3-rpr --images 3 --cameras 1 --given {in} --noise {out}/result"
        " -o {out}/plan --workers 1",
        "locate": "locate 3-rpr {sets}/tool/3-rpr.csv -o {out}/cell.yaml --tool-position 0,0,5mm",
    },
    "revolute": {  # 3-RPS
        "calibrate": f"calibrate {{in}} -o {{out}}/result {FIT}",
        "check": "calibrate {in} --check {out}/result",
        "identify": "identify 3-rps --view leg1,leg2 --view leg2,leg3 --images 4",
    },
    "universal": {  # 3-UPU
        "calibrate": f"calibrate {{in}} -o {{out}}/result {FIT}",
        "identify": "identify {in}",
    },
    "passive": {  # a Tricept, whose UP leg has no motor
        "calibrate": f"calibrate {{in}} -o {{out}}/result {FIT}",
        "identify": "identify {in}",
    },
    "constant": {  # a hexapod with a rod of constant length in place of a leg
        "calibrate": f"calibrate {{in}} -o {{out}}/result {FIT}",
        "literal": f"calibrate {{in}} -o {{out}}/literal --criteria literal {FIT}",
        "check": "calibrate {in} --check {out}/result",
        "identify": "identify {in}",
    },
    "redundant": {  # 4-RPR
        "calibrate": f"calibrate {{in}} -o {{out}}/result {FIT}",
        "identify": "identify {in}",
    },
    "arms": {  # a Delta, one rod of which was measured
        "calibrate": f"calibrate {{in}} -o {{out}}/result {FIT}",
        "check": "calibrate {in} --check {out}/result",
        "identify": "identify {in}",
    },
    "board": {  # a hexapod, photographed with a board beside it from a hand
        "calibrate": f"calibrate {{in}} -o {{out}}/result {FIT}",
        "identify": "identify {in}",
    },
    "few": {  # three images of a hexapod: a result that is not to be trusted
        "calibrate": f"calibrate {{in}} -o {{out}}/result {FIT}",
        "identify": "identify {in}",
    },
    "refused": {  # one image of a 3-RPS: not identifiable
        "calibrate": f"calibrate {{in}} -o {{out}}/result {FIT}",
        "identify": "identify {in}",
    },
    "others": {  # mostly for the keys of --json
        "inspect": "inspect delta",
        "detect": "detect {here}/photographs -o {out}/detected --workers 1",
        "doctor": "doctor {here}/photographs --workers 1",
        "evaluate": "evaluate {tests}/data/recorded/planar/truth/models/3-rpr.yaml 3-rpr",
        "camera": "camera {here}/boards --board chessboard:7x6:30mm -o {out}/camera.yaml"
        " --model plumb_bob --workers 1",
        "init": "init {here}/photographs/images --readings {here}/photographs/measurements.csv"
        " --model hexapod --camera {here}/photographs/camera_info.yaml -o {out}/dataset",
        "import": "import {here}/frames --readings {here}/frames.csv --offset 0 --model hexapod"
        " --camera {here}/small.yaml -o {out}/imported",
        "new": "new --family delta -o {out}/model",
        "simulate": "simulate 3-rpr -o {out}/simulated --level outlines --poses 2",
        "export": "export hexapod --to csv -o {out}/hexapod.csv",
        "example": "example -o {out}/example",
        "wrong use": "inspect nothing-of-this-name",
    },
}

# Under these the data choose the keys: names of legs, views, joints, and reasons.
CHOSEN = (
    "base_axes", "platform_axes", "twists", "nominal_axes.base", "nominal_axes.platform",
    "views", "cameras", "actuators", "shared_px", "rejected", "columns", "readings", ".legs",
)  # fmt: skip
HELD = 1e-12  # standard deviations of held coordinates are rounding

# Paths in documents, by command.
FACTS = {
    "calibrate": (
        "status", "trustworthy", "observations.used", "observations.images", "residuals.dof",
        "platform.poses", "holdout.images", "holdout.outlines", "holdout.wrong",
    ),
    "check": ("moved", "dof", "of", "images", "residuals.dof"),
    "identify": (
        "spatial", "n", "n_d", "r", "n_ac", "paper.ok", "full.rank", "full.of", "identifiable",
    ),
    "plan": ("images", "seed"),
    "locate": ("status", "determined.everything", "determined.tool_orientation", "residuals.dof"),
    "evaluate": ("poses",),
}  # fmt: skip
SIZES = {
    "calibrate": (
        "platform.sigma_dX_m", "platform.sigma_dE_rad", "platform.sigma_dX_max_m",
        "platform.sigma_dE_max_rad", "platform.workspace.sigma_dX_m",
        "platform.workspace.sigma_dE_rad", "residuals.chi2", "holdout.rms_px",
        "holdout.expected_px", "stages.staged.from_fit.dX_m", "stages.staged.from_fit.dE_rad",
    ),
    "check": ("platform.sigma_dX_m", "platform.sigma_dE_rad", "residuals.chi2"),
    "identify": ("platform_sigma.dX_m", "platform_sigma.dE_rad"),
    "plan": ("expected.dX_m", "expected.dE_rad", "expected.dX_max_m", "expected.dE_max_rad"),
    "locate": ("noise.position", "noise.angle", "tool_in_world_sigma.position"),
    "evaluate": ("dX_m", "dE_rad", "dX_max_m"),
}  # fmt: skip


@dataclass
class Answers:
    """Answers of the commands of a session by step, and the keys of their documents by command."""

    steps: dict[str, Any] = field(default_factory=dict)
    keys: dict[str, set[str]] = field(default_factory=dict)


# Running the commands


def run(words: Sequence[str]) -> tuple[int, dict[str, Any]]:
    """Run ``legcal WORDS --json`` in this process; return its exit code and document."""
    out, code = io.StringIO(), None
    with (
        patch.object(sys, "argv", ["legcal", *words, "--json"]),
        contextlib.redirect_stdout(out),
        contextlib.redirect_stderr(io.StringIO()),
    ):
        try:
            cli.main()
        except SystemExit as stop:
            code = stop.code
    if not isinstance(code, int):
        raise RuntimeError(f"legcal {' '.join(words)} did not exit")
    return code, json.loads(out.getvalue())


def run_session(session: str, folder: Path) -> Answers:
    """Run the commands of a session in an empty folder."""
    at = {"in": folder / "in", "out": folder / "out", "here": folder}
    at |= {"sets": DATASETS, "tests": ROOT / "tests"}
    at["out"].mkdir()
    source = EXAMPLE if session == "example" else DATASETS / session
    if source.is_dir():
        copy_dataset(source, at["in"])
    if session == "others":
        write_inputs(folder)
    answers = Answers()
    for step, command in SESSIONS[session].items():
        with small_search():
            code, document = run([word.format(**at) for word in command.split()])
        name = "check" if "--check" in command else command.split()[0]
        answers.steps[step] = {"exit": code, **answer_of(name, document)}
        name = "error" if "error" in document else name
        answers.keys.setdefault(name, set()).update(key_paths(document))
    return answers


@contextlib.contextmanager
def small_search() -> Iterator[None]:
    """Let a plan choose from fewer poses and places, and judge it by fewer draws."""
    with (
        patch.multiple(planner, MIN_POSES=8, POSES_EACH=2, ROUNDS=1),
        patch.multiple(places, _N_AZIMUTHS=6, USUAL_DRAWS=3),
    ):
        yield


def copy_dataset(source: Path, target: Path) -> None:
    """Copy a dataset without the outlines and the cache of an earlier run."""
    left = [".legcal-cache.json"] + (["observations.csv"] if source == EXAMPLE else [])
    shutil.copytree(source, target, ignore=shutil.ignore_patterns(*left))


def write_inputs(folder: Path) -> None:
    """Write three photographs of the example, a recording, and pictures of a chessboard."""
    target = folder / "photographs"
    copy_dataset(EXAMPLE, target)
    table = target / "measurements.csv"
    header, *rows = table.read_text().splitlines()
    kept = rows[::15]  # of each view the first
    table.write_text("\n".join([header, *kept]) + "\n")
    names = {Path(row.split(",")[1]).name for row in kept}
    for image in (target / "images").iterdir():
        if image.name not in names:
            image.unlink()
    write_frames(folder, header.split(",")[2:], [row.split(",")[2:] for row in kept])
    write_boards(folder / "boards")


def write_frames(folder: Path, joints: list[str], readings: list[list[str]]) -> None:
    """Write a recording at 10 Hz: a bar that rests for a second at each pose, and the readings."""
    (folder / "frames").mkdir()
    noise = np.random.default_rng(0)
    q, lines = np.array(readings, dtype=float), [",".join(["time", *joints])]
    for k in range(10 * len(q) + 5 * (len(q) - 1)):
        pose, part = divmod(k, 15)
        s = pose + max(part - 9, 0) / 6.0
        between = [np.interp(s, np.arange(len(q)), column) for column in q.T]
        time = 1_700_000_000.0 + 0.1 * k
        lines.append(",".join(f"{value:.7f}" for value in (time, *between)))
        bar = np.exp(-(((np.arange(96) - 10.0 - 12.0 * s) / 3.0) ** 2))
        grey = 60.0 + 120.0 * bar + noise.normal(scale=1.5, size=(64, 96))
        cv2.imwrite(str(folder / f"frames/{round(1e3 * time)}.png"), grey.astype(np.uint8))
    (folder / "frames.csv").write_text("\n".join(lines) + "\n")
    K = [100.0, 0.0, 47.5, 0.0, 100.0, 31.5, 0.0, 0.0, 1.0]
    camera = {"image_width": 96, "image_height": 64, "distortion_model": "plumb_bob"}
    camera["camera_matrix"] = {"rows": 3, "cols": 3, "data": K}
    camera["distortion_coefficients"] = {"rows": 1, "cols": 5, "data": [0.0] * 5}
    (folder / "small.yaml").write_text(json.dumps(camera))


def write_boards(folder: Path, size: tuple[int, int] = (480, 360), square: int = 40) -> None:
    """Write pictures of a chessboard with 7 x 6 squares of 30 mm, by a pinhole camera."""
    folder.mkdir()
    fields = np.indices((6, 7)).sum(axis=0) % 2
    print_ = np.kron(255 * fields, np.ones((square, square)))
    print_ = np.pad(print_, square, constant_values=255).astype(np.uint8)
    K = np.array([[520.0, 0.0, 239.5], [0.0, 520.0, 179.5], [0.0, 0.0, 1.0]])
    scale = 0.03 / square
    turns = [(0.5, 0, 0), (-0.5, 0, 0.3), (0, 0.5, 0), (0, -0.5, 0.2), (0.35, 0.35, 0.1), (0, 0, 0)]
    for i, turn in enumerate(turns):
        R = cv2.Rodrigues(np.array(turn, dtype=float))[0]
        t = np.array([0.0, 0.0, 0.42]) - R @ [4.5 * 0.03, 4.0 * 0.03, 0.0]
        H = K @ np.column_stack([scale * R[:, 0], scale * R[:, 1], t])
        picture = cv2.warpPerspective(print_, H, size, flags=cv2.INTER_AREA, borderValue=255)
        cv2.imwrite(str(folder / f"board{i}.png"), cv2.GaussianBlur(picture, (0, 0), 0.7))


# The record of a document


def key_paths(document: Any, at: str = "") -> Iterator[str]:
    """Yield the paths of all keys of a document, with ``[]`` for the entries of a list."""
    if isinstance(document, list):
        for entry in document:
            yield from key_paths(entry, f"{at}[]")
    elif isinstance(document, dict):
        for key, value in document.items():
            path = f"{at}.{'*' if at.endswith(CHOSEN) else key}".lstrip(".")
            yield path
            yield from key_paths(value, path)


def selected(document: dict[str, Any], paths: Sequence[str]) -> dict[str, Any]:
    """Return the values at those paths of a document that it has."""
    values = dict[str, Any]()
    for path in paths:
        value: Any = document
        for key in path.split("."):
            value = value.get(key) if isinstance(value, dict) else None
        if value is not None:
            values[path] = value
    return values


def rounded(value: float, unit: float | None = None) -> float:
    """Return a number to five or six digits, or to a thousandth of a unit."""
    unit = 1e-2 * abs(value) if unit is None else unit
    return round(value, 3 - math.floor(math.log10(unit))) if unit else 0.0


def estimates_of(name: str, document: dict[str, Any]) -> dict[str, list[float]]:
    """Return value and standard deviation of the estimates of a command, by name."""
    pairs: list[tuple[str, float, float | None]] = []
    if name == "calibrate":
        at_platform = document["platform"]
        of_weak = {"m": at_platform["sigma_dX_m"], "rad": at_platform["sigma_dE_rad"]}
        for p in document["parameters"]:
            sigma = of_weak.get(p["unit"]) if p["status"] == "weak" else p["sigma"]
            pairs.append((p["name"], p["value"], sigma))
    if name in ("calibrate", "check"):
        platform, change = document["platform"], "change_" if name == "calibrate" else ""
        for size in ("dX_m", "dE_rad"):
            pairs.append((f"platform.{size}", platform[change + size], platform[f"sigma_{size}"]))
    if name == "camera":
        pairs = [(p["name"], p["value"], p["sigma"]) for p in document["intrinsics"]]
    if name == "locate":
        for frame in ("T_world_base", "T_platform_tool"):
            place = document[frame]
            rotation = Rotation.from_quat(place["quat_xyzw"]).as_rotvec()
            for i, axis in enumerate("xyz"):
                pairs.append((f"{frame}.{axis}", place["xyz"][i], place["sigma_xyz"][i]))
                pairs.append((f"{frame}.r{axis}", rotation[i], place["sigma_rotation"][i]))
    return {
        name: [rounded(value, sigma), rounded(sigma)]
        for name, value, sigma in pairs
        if sigma is not None and sigma > HELD
    }


def answer_of(name: str, document: dict[str, Any]) -> dict[str, Any]:
    """Return the facts, sizes and estimates of a document, as far as it has them."""
    if "error" in document:
        return {"facts": {"error.kind": document["error"]["kind"]}}
    facts = selected(document, FACTS.get(name, ()))
    if name == "calibrate":
        statuses = Counter(p["status"] for p in document["parameters"])
        facts |= {f"parameters {status}": count for status, count in sorted(statuses.items())}
        legs = zip(document["legs"], document["offsets"], strict=True)
        facts["without offset"] = [leg for leg, offset in legs if offset is None]
    if name == "identify":
        for condition in document["conditions"]:
            facts[f"{condition['name']}.ok"] = condition["ok"]
    sizes = selected(document, SIZES.get(name, ()))
    if name == "calibrate":
        for view, place in document["views"].items():
            for axis, x in zip("xyz", place["T_base_camera"]["xyz"], strict=True):
                sizes[f"{view}.{axis}"] = x
    if name == "evaluate":
        sizes |= {p["name"]: p["difference"] for p in document["parameters"]}
    sizes = {path: rounded(size) for path, size in sizes.items()}
    parts = {"facts": facts, "sizes": sizes, "estimates": estimates_of(name, document)}
    return {kind: values for kind, values in parts.items() if values}


# Comparing


@dataclass(frozen=True)
class Difference:
    """A difference between an answer and the record."""

    where: str
    name: str
    how: str
    excess: float  # over the tolerance; infinite where answers must be equal

    def __str__(self) -> str:
        return f"{self.where:24}{self.name:40}{self.how}"


def differences(session: str, answers: Answers, recorded: dict[str, Any]) -> list[Difference]:
    """Return the differences of a session from the record, the worst first."""
    rows = list[Difference]()
    steps = recorded["sessions"].get(session, {})
    for step in {**steps, **answers.steps}:
        where = f"{session}, {step}"
        if step not in steps or step not in answers.steps:
            rows.append(Difference(where, "", "is not in both", math.inf))
            continue
        rows += _step_differences(where, answers.steps[step], steps[step])
    for command, keys in answers.keys.items():
        expected = recorded_keys(recorded, command, session)
        lost, new = expected - keys, keys - expected
        where = f"{session}, {command}"
        rows += [Difference(where, key, "this key is gone", math.inf) for key in sorted(lost)]
        rows += [Difference(where, key, "this key is new", math.inf) for key in sorted(new)]
    return sorted(rows, key=lambda row: -row.excess)


def _step_differences(
    where: str, now: dict[str, Any], before: dict[str, Any]
) -> Iterator[Difference]:
    flat_now, flat_before = ({"exit": a["exit"], **a.get("facts", {})} for a in (now, before))
    for name in {**flat_before, **flat_now}:
        one, other = flat_before.get(name), flat_now.get(name)
        if one != other:
            yield Difference(where, name, f"{one} is now {other}", math.inf)
    for kind in ("sizes", "estimates"):
        values, earlier = now.get(kind, {}), before.get(kind, {})
        for name in {**earlier, **values}:
            if name not in values or name not in earlier:
                how = "is new" if name in values else "is gone"
                yield Difference(where, name, how, math.inf)
            elif kind == "sizes":
                yield _size_difference(where, name, values[name], earlier[name])
            else:
                (value, sigma), (value_before, sigma_before) = values[name], earlier[name]
                change = (value - value_before) / sigma_before
                how = f"{change:+.3f} sigma"
                yield Difference(where, name, how, abs(change) / VALUE_TOLERANCE)
                yield _size_difference(where, f"sigma of {name}", sigma, sigma_before)


def _size_difference(where: str, name: str, value: float, before: float) -> Difference:
    change = value / before - 1.0 if before else math.inf if value else 0.0
    return Difference(where, name, f"{100.0 * change:+.2f} %", abs(change) / SIZE_TOLERANCE)


def too_much(rows: Sequence[Difference]) -> str:
    """Return a table of the worst differences beyond the tolerances, an empty text without any."""
    over = [row for row in rows if row.excess > 1.0]
    table = [str(row) for row in over[:WORST]]
    if len(over) > WORST:
        table.append(f"and {len(over) - WORST} more")
    return "\n".join(table)


# The file


def recorded_keys(record: dict[str, Any], command: str, session: str) -> set[str]:
    """Return the keys that the documents of a command have in a session."""
    keys = record["keys"].get(command, {"always": [], "sometimes": {}})
    some = {key for key, sessions in keys["sometimes"].items() if session in sessions}
    return {*keys["always"], *some}


def read_record() -> dict[str, Any]:
    """Return the record."""
    record: dict[str, Any] = json.loads(RECORDED.read_text(encoding="utf-8"))
    return record


def record_of(sessions: dict[str, Answers]) -> dict[str, Any]:
    """Return the record of all sessions."""
    keys = dict[str, Any]()
    for command in sorted({name for a in sessions.values() for name in a.keys}):
        by_session = {s: a.keys[command] for s, a in sessions.items() if command in a.keys}
        always = set.intersection(*by_session.values())
        others = sorted(set.union(*by_session.values()) - always)
        sometimes = {key: [s for s, k in by_session.items() if key in k] for key in others}
        keys[command] = {"always": sorted(always), "sometimes": sometimes}
    return {"sessions": {name: answers.steps for name, answers in sessions.items()}, "keys": keys}


def text_of(record: dict[str, Any]) -> str:
    """Return the record as JSON, with value and standard deviation in one line."""
    pair = r"\[\n +([-+.\de]+),\n +([-+.\de]+)\n +\]"
    return re.sub(pair, r"[\1, \2]", json.dumps(record, indent=2)) + "\n"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("session", nargs="*", help="run only these, and write nothing")
    names = parser.parse_args().session
    before = read_record() if RECORDED.is_file() else {"sessions": {}, "keys": {}}
    sessions = dict[str, Answers]()
    for session in names or SESSIONS:
        begin = time.process_time()
        with TemporaryDirectory(prefix="legcal-recorded-") as folder:
            sessions[session] = run_session(session, Path(folder))
        rows = differences(session, sessions[session], before)
        sigmas = [row.excess * VALUE_TOLERANCE for row in rows if row.how.endswith(" sigma")]
        seconds = time.process_time() - begin
        print(f"{session:12}{seconds:5.1f} s   at most {max(sigmas, default=0.0):.4f} sigma")
        if text := too_much(rows):
            print(text)
    if not names:
        RECORDED.write_text(text_of(record_of(sessions)), encoding="utf-8")
        print(f"written: {RECORDED}")


if __name__ == "__main__":
    main()
