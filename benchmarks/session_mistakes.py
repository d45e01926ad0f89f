"""Verdicts on sessions with one mistake in their course, and on healthy ones beside them.

    OMP_NUM_THREADS=1 python benchmarks/session_mistakes.py [--sessions 40] [--first 0]
                         [--machines hexapod,...] [--kinds slip,...] [--record FILE]
                         [--photographs]

Outlines of 45 images of a machine whose joints are off are simulated. Two sessions in three have a
mistake, drawn at a size from harmless to gross: the zero of an encoder slips or drifts, photographs
come before the platform stands still, a motor has backlash, another scale or an error once a turn,
commands stand for readings, a camera is bumped or refocused, its autofocus or its tripod moves in
each image, light from another side shifts edges, a joint moves, all motors have another scale
(``pitch``, which nothing in outlines shows). Each is calibrated; the platform error by eq (20)
against the true machine is compared with what is stated, for mistakes of the scale or of a gain
with the error that pitches may have. Printed are sessions that harm by more than three stated
sigmas, how many of these are trusted, and how often the first doubt names their mistake; ``pitch``
is a kind apart. FILE keeps sessions as JSON lines; those in it are not done again. About 5 s a
session. With --photographs 18 small photographs are rendered in place of outlines, and mistakes are
those of readings, of a stated length, and of a focal length, to which images are enlarged; about a
minute.
"""

import argparse
import json
import sys
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory

import cv2
import numpy as np
from machine_kinds import measured_length
from scipy.spatial.transform import Rotation

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))

from changed_rays import turned, with_moved_joint, with_rays, zoomed
from simulated import small_camera

from legcal import (
    LegcalError,
    SimulationSettings,
    calibrate,
    evaluate,
    load_dataset,
    load_mechanism,
    simulate,
)
from legcal.calibration.joint_fit.scale import ALL_READINGS
from legcal.data.dataset import Dataset
from legcal.geometry.types import Array, BoolArray
from legcal.machine.model import Machine
from legcal.simulation.observe import Scene, shifted_outlines
from legcal.simulation.session import simulate_session, streams
from legcal.simulation.settings import Level

MACHINES = "hexapod", "6-sps", "3-rpr", "3-rps", "linear-delta", "hexaglide", "servo-hexapod"
POINT_TO_POINT = "hexapod", "6-sps", "hexaglide"
HEALTHY, PITCH = "healthy", "pitch"
N_SIGMAS = 3.0
SCREW_PITCH = 0.005  # [m]
# Sizes from harmless to gross, and the codes of doubts that name the mistake
SIZES: dict[str, tuple[float, float, tuple[str, ...]]] = {
    "slip": (2e-5, 2e-3, ("encoder",)),  # [m] at the joint
    "drift": (2e-5, 1e-3, ("drift", "encoder")),
    "backlash": (2e-5, 5e-4, ("backlash",)),
    "lag": (3e-4, 1e-2, ("lag",)),  # part of the last move
    "gain": (2e-4, 1e-2, ("gain",)),
    "commands": (2e-5, 3e-4, ("reading_noise",)),  # [m]
    "eccentricity": (2e-5, 5e-4, ("eccentricity", "gain")),  # [m]
    "focal length": (3e-4, 7e-3, ("focal_length", "camera")),
    "camera": (1e-4, 3e-3, ("camera",)),  # [rad]
    "autofocus": (1e-4, 3e-3, ("autofocus", "focal_length")),  # relative, of each image
    "vibration": (1e-5, 1e-3, ("vibration", "camera")),  # [rad] of each image
    "lamp": (0.02, 0.6, ("lamp",)),  # [px] at the limb that faces the other lamp
    "joint": (2e-5, 2e-3, ("joint",)),  # [m] of a joint on the base
    PITCH: (2e-4, 4e-3, ()),
}
# Two witnesses of the scale, one of which is wrong, and one alone; asked for by --kinds
OF_SCALE: dict[str, tuple[float, float, tuple[str, ...]]] = {
    "length": (3e-4, 3e-2, ("scale",)),  # a stated length, relative
    "pitch and length": (3e-4, 1e-2, ("scale",)),  # all motors, beside a right length
    "pitch and board": (3e-4, 1e-2, ("scale",)),  # the same beside a right board
    "board": (3e-4, 3e-2, ("scale",)),  # squares of a board
    "nominal length": (0.0, 0.0, ("nominal_length",)),  # stated, and not measured
}
KINDS = SIZES | OF_SCALE
PHOTOGRAPHED = (
    "slip", "drift", "backlash", "lag", "gain", "commands", "eccentricity", "focal length", "length"
)  # fmt: skip
PHOTOGRAPHS = {"poses": 6, "views": 3, "level": Level.PHOTOGRAPHS}


def stated_lengths(kind: str, size: float, truth: Machine, nominal: Machine,
                   rng: np.random.Generator) -> list[str]:  # fmt: skip
    """Return the length that somebody states, where a kind or a machine needs one."""
    if not (kind in ("length", "pitch and length", "nominal length")
            or not (nominal.readings_carry_length or "board" in kind)):  # fmt: skip
        return []
    (stated,) = measured_length(truth, rng)
    name, _, value = stated.partition("=")
    number, _, sigma = value.partition("+-")
    if kind == "length":
        number = f"{(1.0 + size) * float(number):.4f}"
    if kind == "nominal length":
        ends = [nominal.A_base[list(nominal.leg_names).index(end.partition(".")[0])]
                for end in name.split(":")]  # fmt: skip
        number = f"{1e3 * float(np.linalg.norm(ends[0] - ends[1])):.3f}"
    return [f"{name}={number}+-{sigma}"]


def relit(dataset: Dataset, rows: BoolArray, size: float, angle: float) -> Dataset:
    """Return edges of some images of one view moved by light from another side."""
    o, m = dataset.observations, dataset.measurements
    assert o is not None
    changed = rows[o.row]
    camera = m.views[int(m.view[rows][0])].camera
    h, ends = o.h[changed], o.ends[changed]
    towards = h[:, :2] / np.linalg.norm(h[:, :2], axis=1, keepdims=True)
    lit = np.maximum(towards @ [np.cos(angle), np.sin(angle)], 0.0)
    moved = shifted_outlines(camera, h, ends, size * np.repeat(lit[:, None], 2, axis=1))
    new_h, new_ends = o.h.copy(), o.ends.copy()
    new_h[changed], new_ends[changed] = moved
    return replace(dataset, observations=replace(o, h=new_h, ends=new_ends))


def enlarge(dataset: Dataset, rows: BoolArray, size: float) -> None:
    """Enlarge some photographs of one view about its principal point."""
    m = dataset.measurements
    for row in np.flatnonzero(rows).tolist():
        file = str(dataset.folder / m.image[row])
        image, centre = cv2.imread(file, cv2.IMREAD_UNCHANGED), m.views[m.view[row]].camera.K[:2, 2]
        assert image is not None
        by = np.column_stack([(1.0 + size) * np.eye(2), -size * centre])
        larger = cv2.warpAffine(image, by, image.shape[1::-1], borderMode=cv2.BORDER_REPLICATE)
        cv2.imwrite(file, larger)


def spoiled(dataset: Dataset, kind: str, size: float, rng: np.random.Generator,
            scene: Scene | None) -> Dataset:  # fmt: skip
    """Return a session with a mistake; photographs without a scene."""
    m, machine = dataset.measurements, dataset.machine
    n, j = m.n_rows, int(rng.choice(machine.motors))
    is_motor = np.equal(machine.reads, j).astype(float)
    of_leg = np.array([leg.reading_of(1.0) if leg.is_motor else 0.0 for leg in machine.legs])
    time_of_row = np.linspace(0.0, 1.0, n)
    later = time_of_row > rng.uniform(0.2, 0.8)
    moves = np.diff(m.q, axis=0, prepend=m.q[:1])
    moves[np.diff(m.view, prepend=-1) != 0] = 0.0
    if kind == "board":
        boards = [
            replace(b, board=replace(b.board, side=(1.0 + size) * b.board.side,
                                     marker=(1.0 + size) * b.board.marker))
            for b in dataset.boards
        ]  # fmt: skip
        return replace(dataset, boards=tuple(boards))
    if kind in ("length", "nominal length"):
        return dataset
    kind = PITCH if kind.startswith(PITCH) else kind
    if kind == "joint" and scene is not None:
        direction = rng.normal(size=3)
        by = size * direction / np.linalg.norm(direction)
        return with_moved_joint(dataset, scene, later, int(rng.integers(len(machine.legs))), by)
    rows = np.flatnonzero(m.view == int(rng.integers(len(m.views))))
    if kind in ("autofocus", "vibration"):
        for row in rows:
            part, turn = size * rng.normal(), Rotation.from_rotvec(size * rng.normal(size=3))
            change = zoomed(part) if kind == "autofocus" else turn.apply
            dataset = with_rays(dataset, np.arange(n) == row, change)
        return dataset
    if kind in ("camera", "focal length", "lamp"):
        changed = np.zeros(n, dtype=np.bool_)
        changed[rows[int(len(rows) * 0.4) :]] = True
        if scene is None:
            enlarge(dataset, changed, size)
            return dataset
        if kind == "lamp":
            return relit(dataset, changed, size, rng.uniform(0.0, 2.0 * np.pi))
        return with_rays(dataset, changed, turned(size) if kind == "camera" else zoomed(size))
    per = [2.0 * np.pi if leg.reads_angle else SCREW_PITCH for leg in machine.legs]
    phase = rng.uniform(0.0, 2.0 * np.pi)
    scatter = rng.normal(size=(n, len(machine.motors)))
    of_motor = {motor: scatter[:, i] for i, motor in enumerate(machine.motors)}
    changes: dict[str, Callable[[], Array]] = {
        "slip": lambda: size * np.outer(later, is_motor * of_leg),
        "drift": lambda: size * np.outer(time_of_row, is_motor * of_leg),
        "backlash": lambda: 0.5 * size * np.sign(moves) * is_motor * of_leg,
        "lag": lambda: size * moves,
        "gain": lambda: size * m.q * is_motor,
        "commands": lambda: (
            size * of_leg * np.column_stack([of_motor.get(i, np.zeros(n)) for i in machine.reads])
        ),
        "eccentricity": lambda: size * is_motor * of_leg * np.sin(2.0 * np.pi * m.q / per + phase),
        PITCH: lambda: size * m.q,
    }
    return replace(dataset, measurements=replace(m, q=m.q + changes[kind]()))


def session(
    seed: int, name: str, kinds: list[str], scratch: Path, *, photographs: bool
) -> dict[str, object]:
    """Simulate, spoil and calibrate a session."""
    rng = np.random.default_rng(seed)
    folder, out = scratch / f"{seed}", scratch / f"{seed}-out"
    kind, size = HEALTHY, 0.0
    if seed % 3:
        possible = [kind for kind in kinds if kind != "joint" or name in POINT_TO_POINT]
        kind = possible[int(rng.integers(len(possible)))]
        least, most, _ = KINDS[kind]
        size = float(np.exp(rng.uniform(np.log(least), np.log(most)))) if least else 0.0
    board = "charuco" if "board" in kind else None
    settings = SimulationSettings(level=Level.OUTLINES, seed=seed, board=board)
    if photographs:
        settings = replace(settings, **PHOTOGRAPHS, camera=small_camera(scratch, 640, 480))  # type: ignore[arg-type]
    simulate(name, folder, settings)
    truth = next((folder / "truth/models").glob("*.yaml"))
    nominal: Machine = load_mechanism(name)
    dataset = load_dataset(folder)
    if kind != HEALTHY:
        scene = None
        if not photographs:
            true = load_mechanism(truth)
            scene = simulate_session(true, nominal, settings, streams(seed)).scene
        dataset = spoiled(dataset, kind, size, rng, scene)
    priors = stated_lengths(kind, size, load_mechanism(truth), nominal, rng)
    line: dict[str, object] = {"seed": seed, "machine": name, "kind": kind, "size": size}
    begin = time.perf_counter()
    try:
        calibration = calibrate(dataset, output=out, use_cache=False, priors=priors)
    except LegcalError as error:
        return line | {"refused": type(error).__name__, "why": str(error)[:200]}
    after = evaluate(out / "calibrated.yaml", truth, dataset=folder)
    assert calibration.platform is not None
    return line | {
        "off_mm": 1e3 * float(after.displacement.mean()),
        "stated_mm": 1e3 * calibration.platform.sigma.mean_displacement,
        "scale_mm": [
            1e3 * effect.mean_displacement
            for what, effect in calibration.platform.effects.items()
            if what == ALL_READINGS
        ],
        "trusted": calibration.verdict.trustworthy,
        "doubts": [doubt.code for doubt in calibration.doubts],
        "seconds": time.perf_counter() - begin,
    }


def report(lines: list[dict[str, object]]) -> None:
    """Print what verdicts are worth."""
    print(
        f"{'kind':14}{'sessions':>9}{'refused':>9}{'harmful':>9}{'trusted':>9}{'wrongly':>9}"
        f"{'named first':>13}"
    )
    for kind in (HEALTHY, *KINDS):
        of_kind = [line for line in lines if line["kind"] == kind]
        judged = [line for line in of_kind if "refused" not in line]
        # For others the sigma of the fit has to do.
        of_scale = kind in (PITCH, "gain") or kind in OF_SCALE
        harmful = [
            x for x in judged
            if x["off_mm"] > N_SIGMAS * np.hypot.reduce([x["stated_mm"], *x["scale_mm"][:of_scale]])  # type: ignore[index]
        ]  # fmt: skip
        named = 0
        for x in harmful:
            codes = KINDS[kind][2] if kind in KINDS else ()
            doubts = list(x["doubts"])  # type: ignore[call-overload]
            named += bool(doubts) and doubts[0] in codes
        trusted = sum(bool(line["trusted"]) for line in judged)
        wrongly = sum(bool(line["trusted"]) for line in harmful)
        print(
            f"{kind:14}{len(of_kind):9}{len(of_kind) - len(judged):9}{len(harmful):9}{trusted:9}"
            f"{wrongly:9}{named:13}"
        )


def main() -> None:
    """Run the sessions that are asked for."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--sessions", type=int, default=40)
    parser.add_argument("--first", type=int, default=0)
    parser.add_argument("--machines", default=",".join(MACHINES))
    parser.add_argument("--kinds")
    parser.add_argument("--photographs", action="store_true")
    parser.add_argument("--record", type=Path)
    given = parser.parse_args()
    lines: list[dict[str, object]] = []
    if given.record is not None and given.record.exists():
        lines = [json.loads(text) for text in given.record.read_text().splitlines()]
    done, machines = {line["seed"] for line in lines}, given.machines.split(",")
    usual = PHOTOGRAPHED if given.photographs else tuple(SIZES)
    kinds = given.kinds.split(",") if given.kinds else list(usual)
    for seed in range(given.first, given.first + given.sessions):
        if seed in done:
            continue
        with TemporaryDirectory() as scratch:
            name = machines[(seed // 3) % len(machines)]
            line = session(seed, name, kinds, Path(scratch), photographs=given.photographs)
        print(json.dumps(line), flush=True)
        lines.append(line)
        if given.record is not None:
            with given.record.open("a") as file:
                file.write(json.dumps(line) + "\n")
    report(lines)


if __name__ == "__main__":
    main()
