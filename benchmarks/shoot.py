"""Guided sessions of few photographs beside unguided ones of more.

A session is planned, and shot as ``legcal shoot`` guides it: a simulated camera stands at the
planned tripods, a little off, and a machine off its model takes each pose that is asked. Beside it
the same machine is photographed at random poses, as an owner chooses them, from cameras around it.
Both are calibrated; the error of the platform is the mean over the workspace.

    python benchmarks/shoot.py --runs 20
    python benchmarks/shoot.py --runs 2 --rendered [--camera SMALL.yaml]

With ``--planned`` fewer photographs than ``--images``, the others are those that ``shoot`` finds
best by what is known then. With ``--rendered`` photographs are checked as they come.
"""

from __future__ import annotations

import argparse
import json
import shutil
import time
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

import legcal
from legcal.errors import LegcalError
from legcal.machine.loader import load_mechanism
from legcal.planning.session import write_session
from legcal.planning.shooting import GuidedSession
from legcal.simulation.dataset import simulate
from legcal.simulation.settings import Level, Sampling, SimulationSettings


def main() -> None:
    """Run."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--machine", default="hexapod")
    parser.add_argument("--images", type=int, default=15, help="photographs of a guided session")
    parser.add_argument("--planned", type=int, help="of these, those of the plan")
    parser.add_argument("--plan", type=Path, help="the folder of a plan, in place of a new one")
    parser.add_argument("--camera", type=Path, help="the camera file, of small images for example")
    parser.add_argument("--unguided", type=int, default=30, help="photographs beside them")
    parser.add_argument("--cameras", type=int, default=3)
    parser.add_argument(
        "--sampling", type=Sampling, default=Sampling.WORKSPACE, help="of the owner"
    )
    parser.add_argument("--first", type=int, default=0, help="seed of the first run")
    parser.add_argument("--runs", type=int, default=20)
    parser.add_argument("--rendered", action="store_true", help="photographs, not outlines")
    args = parser.parse_args()
    level = Level.PHOTOGRAPHS if args.rendered else Level.OUTLINES
    guided, unguided, seconds = list[float](), list[float](), list[float]()
    with TemporaryDirectory() as name:
        folder = Path(name)
        plan = args.plan or folder / "plan"
        if args.plan is None:
            n = args.planned or args.images
            planned = legcal.plan(args.machine, images=n, cameras=args.cameras, camera=args.camera)
            write_session(planned, plan)
        for seed in range(args.first, args.first + args.runs):
            here = folder / str(seed)
            try:
                dataset, truth = shot(args, plan, here, level, seed, seconds)
                mine = error_of(dataset, truth)
                owner = simulate(
                    args.machine,
                    here / "unguided",
                    SimulationSettings(
                        seed=seed,
                        level=level,
                        views=args.cameras,
                        sampling=args.sampling,
                        poses=args.unguided // args.cameras,
                        camera=plan / "camera_info.yaml",
                    ),
                )
                theirs = error_of(owner.folder, owner.truth_path)
            except LegcalError as error:
                print(json.dumps({"seed": seed, "failed": str(error)}), flush=True)
                continue
            guided.append(mine)
            unguided.append(theirs)
            print(json.dumps({"seed": seed, "guided_mm": mine, "unguided_mm": theirs}), flush=True)
            shutil.rmtree(here)
    found = {
        "machine": args.machine,
        "runs": len(guided),
        "guided_median_mm": float(np.median(guided)),
        "unguided_median_mm": float(np.median(unguided)),
        "better": int(np.sum(np.array(guided) < np.array(unguided))),
    }
    if seconds:
        found |= {"check_median_s": float(np.median(seconds)), "check_most_s": max(seconds)}
    print(json.dumps(found, indent=1))


def shot(
    args: argparse.Namespace,
    plan: Path,
    here: Path,
    level: Level,
    seed: int,
    seconds: list[float],
) -> tuple[Path, Path]:
    """Shoot a session as it is guided; return its dataset and the true model.

    The simulated machine takes each pose when it is asked for. Times of checks are added to
    *seconds*.
    """
    shutil.copytree(plan, session_folder := here / "session")
    target = None if args.planned is None else 0.0  # on beyond the plan
    session, taken = GuidedSession(session_folder, target=target), 0
    if level == Level.PHOTOGRAPHS:
        settings = SimulationSettings(seed=seed, level=level, plan=plan)
        source = simulate(args.machine, here / "rendered", settings)
        for file in (source.folder.glob("camera*.yaml"), [source.folder / "dataset.yaml"]):
            for path in file:
                shutil.copy(path, session_folder)
        session = GuidedSession(session_folder, target=target)
    while taken < args.images and (asked := session.next()) is not None:
        taken += 1
        if level != Level.PHOTOGRAPHS:
            session.accept(asked, None)
            continue
        photograph = source.folder / f"{asked.image}.png"
        begin = time.perf_counter()
        checked = session.check(asked, photograph)
        seconds.append(time.perf_counter() - begin)
        if checked.problems:
            print(json.dumps({"seed": seed, "pose": asked.pose, "refused": checked.problems}))
            continue
        session.accept(asked, photograph, checked=checked)
    if level == Level.PHOTOGRAPHS:
        return session_folder, source.truth_path
    settings = SimulationSettings(seed=seed, level=level, plan=session_folder)
    machine = load_mechanism(args.machine)
    source = simulate(machine, here / "guided", settings)
    return source.folder, source.truth_path


def error_of(dataset: Path, truth: Path) -> float:
    """Return the mean error of the platform over the workspace after a calibration [mm]."""
    out = dataset.parent / f"{dataset.name}-result"
    legcal.calibrate(dataset, output=out)
    return 1e3 * float(legcal.evaluate(out / "calibrated.yaml", truth).displacement.mean())


if __name__ == "__main__":
    main()
