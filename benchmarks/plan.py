"""Planned sessions beside random ones: predicted and found errors of the platform.

For each machine a session of ``--images`` photographs from ``--cameras`` places is planned, and
``--random`` sessions are drawn: extreme poses, cameras in sectors around the machine at a height by
chance, at the least distance from which all legs are in the picture with the same tolerance. All
are judged by the same draws of tripods and machines. ``--runs`` simulated calibrations of the
planned session from outlines compare the error that is predicted with the one that is found, and
``--rendered`` from photographs. A table says how the criteria of the literature rank the random
sessions: the rank correlation (Spearman) of each with the predicted error of the platform, and the
error that is predicted for the session that it takes for the best, over that of the best.

    python benchmarks/plan.py --machines hexapod 3-rpr --random 50 --runs 20

Machines are shipped ones, or ``delta-round-arms`` and its like (``outline_sessions``); where motors
turn, the rod that the plan counts on is measured.
"""

from __future__ import annotations

import argparse
import json
import time
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
from outline_sessions import ROUND_ARMS, made
from scipy.stats import spearmanr

import legcal
from legcal.calibration.joint_fit.parameter_choices import NO_CHOICES, Choices, Prior
from legcal.calibration.joint_fit.predicted import DEFAULT_NOISE, WHITE, Predictor
from legcal.data.reading_units import sigmas_of, sigmas_of_legs
from legcal.errors import LegcalError, NotIdentifiable
from legcal.geometry.lines import direction_above
from legcal.geometry.types import Array
from legcal.machine.configurations import feasible_poses, poses_at
from legcal.machine.loader import load_mechanism
from legcal.machine.model import Machine
from legcal.planning.exchange import workspace_of
from legcal.planning.places import Place, all_points, default_setting, places_along
from legcal.planning.planner import Candidates, Task, drawn_covariance
from legcal.planning.poses import surely_reached
from legcal.planning.session import Plan, write_session
from legcal.simulation.dataset import simulate
from legcal.simulation.settings import Distribution, Level, SimulationSettings, Spread
from legcal.vision.camera import sample_camera

LENGTH_SIGMA = 5e-5  # [m] of a length measured by hand

MACHINES = ("hexapod", "3-upu-tilted", "3-rpr", "3-rps", "tricept")
_LIFTS = {True: (0.1, 0.7), False: (0.8, 1.3)}  # [rad] of random places; planar machines: False


def random_session(
    task: Task, n_images: int, n_views: int, rng: np.random.Generator
) -> list[Candidates]:
    """Return a session of random extreme poses and random sensible places."""
    machine, camera = task.machine, task.predictor.camera
    configurations: list[Array] = []
    while len(configurations) < n_images:
        drawn = feasible_poses(machine, n_images, rng, extreme=True)
        kept = surely_reached(machine, task.predictor.legs, task.setting, drawn)
        configurations += [drawn.configurations[k] for k in np.flatnonzero(kept)]
    poses = poses_at(machine, configurations[:n_images])
    points, up = all_points(machine, poses.poses), machine.upward
    first, places = rng.uniform(0.0, 2.0 * np.pi), list[Place]()
    while len(places) < n_views:
        turn = first + 2.0 * np.pi * (len(places) + rng.uniform(-0.3, 0.3)) / n_views
        toward = direction_above(up, turn, rng.uniform(*_LIFTS[machine.spatial]))
        places += places_along(toward, points, camera, task.setting)[:1]
    parts = np.array_split(np.arange(n_images), n_views)
    return [
        Candidates(place, poses_at(machine, [poses.configurations[k] for k in part]))
        for place, part in zip(places, parts, strict=True)
    ]


def indices(covariance: Array, unit: Array) -> dict[str, float]:
    """Return the criteria of the literature, each so that less is better.

    Of the singular values s_1 >= ... >= s_m of the whitened Jacobian of the machine (angles at the
    mean leg length) and n images' rows: O1 (Borm and Menq) their geometric mean, O2 (Driels and
    Pathre) s_m / s_1, O3 (Nahvi) s_m, O4 the noise amplification s_m^2 / s_1 (Nahvi and
    Hollerbach), O5 (Sun and Hollerbach) 1 / sum of 1 / s.
    """
    variance = np.linalg.eigvalsh(covariance / unit[:, None] / unit)
    variance = variance[variance > 1e-14 * variance[-1]]
    s = 1.0 / np.sqrt(variance[::-1])
    return {
        "O1 geometric mean": float(-np.log(s).mean()),
        "O2 inverse condition": -float(s[-1] / s[0]),
        "O3 minimum singular value": -float(s[-1]),
        "O4 noise amplification": -float(s[-1] ** 2 / s[0]),
        "O5 harmonic": -float(1.0 / np.sum(1.0 / s)),
    }


def judged(task: Task, session: list[Candidates], draws: int) -> Array:
    """Return the mean covariance of the parameters over the same draws."""
    rng = np.random.default_rng(1)
    return np.asarray(np.mean([drawn_covariance(task, session, rng) for _ in range(draws)], axis=0))


def main() -> None:
    """Run."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--machines", nargs="+", default=list(MACHINES))
    parser.add_argument("--images", type=int, default=45)
    parser.add_argument("--cameras", type=int, default=3)
    parser.add_argument("--random", type=int, default=50, help="random sessions; 0 for none")
    parser.add_argument("--first", type=int, default=0, help="seed of the first calibration")
    parser.add_argument("--draws", type=int, default=3, help="of each random session")
    parser.add_argument("--runs", type=int, default=0, help="calibrations from outlines")
    parser.add_argument("--rendered", type=int, default=0, help="calibrations from photographs")
    parser.add_argument("--encoder-sigma", help="of motors that turn: 0.5deg")
    parser.add_argument("--keep", type=Path, help="folder that keeps photographs and results")
    parser.add_argument("--record", type=Path)
    args = parser.parse_args()
    for name in args.machines:
        found = compare(name, args)
        print(json.dumps(found, indent=1), flush=True)
        if args.record is not None:
            with args.record.open("a") as file:
                file.write(json.dumps(found) + "\n")


def compare(name: str, args: argparse.Namespace) -> dict[str, object]:
    """Return the figures of one machine."""
    with TemporaryDirectory() as folder:
        machine = made(name, Path(folder)) if name in ROUND_ARMS else load_mechanism(name)
        return compared(name, machine, args)


def compared(name: str, machine: Machine, args: argparse.Namespace) -> dict[str, object]:
    """Return the figures of one machine, whose files are there."""
    choices, rod = NO_CHOICES, machine.rod_for_scale(has_length=False)
    if rod is not None:
        known = Prior(rod[0].q0, LENGTH_SIGMA)
        choices = Choices(priors={f"{rod[0].name}.length": known})
    stated = {} if args.encoder_sigma is None else sigmas_of(args.encoder_sigma, machine.legs)
    sigma_q = sigmas_of_legs(machine.legs, 2e-6, stated)
    predictor = Predictor(machine, sample_camera(), DEFAULT_NOISE, sigma_q, choices)
    task = Task(predictor, args.images, args.cameras, default_setting(machine))
    work = workspace_of(machine, predictor.legs)
    if work is None:
        raise NotIdentifiable(f"{name}: readings do not give the pose, needed another machine.")
    start = time.perf_counter()
    plan = legcal.plan(
        machine, images=args.images, cameras=args.cameras, encoder_sigma=args.encoder_sigma
    )
    seconds = time.perf_counter() - start
    session = [Candidates(Place(v.T_base_camera), v.poses) for v in plan.views]
    planned = work.error(judged(task, session, args.draws)).mean_displacement
    unit = np.array([1.0 if u == "m" else 1.0 / machine.q0.mean() for u in plan.units])
    rng, errors, ranked = np.random.default_rng(7), [], []
    for _ in range(args.random):
        covariance = judged(task, random_session(task, args.images, args.cameras, rng), args.draws)
        errors.append(work.error(covariance).mean_displacement)
        free = np.diagonal(covariance) > 0.0
        ranked.append(indices(covariance[np.ix_(free, free)], unit[free]))
    table = {}
    for key in ranked[0] if ranked else ():
        scores = [one[key] for one in ranked]
        table[key] = {
            "spearman": float(spearmanr(scores, errors)[0]),
            "best": errors[int(np.argmin(scores))] / min(errors),
        }
    found: dict[str, object] = {
        "machine": name,
        "seconds": seconds,
        "planned_mm": 1e3 * planned,
    }
    if errors:
        found |= {
            "random_median_mm": 1e3 * float(np.median(errors)),
            "random_best_mm": 1e3 * min(errors),
            "ratio": planned / float(np.median(errors)),
            "indices": table,
        }
    with TemporaryDirectory() as folder:
        if args.runs:
            white = legcal.plan(
                machine,
                images=args.images,
                cameras=args.cameras,
                noise=WHITE,
                encoder_sigma=args.encoder_sigma,
            )
            write_session(white, Path(folder) / "white")
            found["outlines"] = shot(
                machine, white, Path(folder) / "white", Level.OUTLINES, args.first, args.runs
            )
        if args.rendered:
            planned_in = (args.keep or Path(folder)) / name / "plan"
            write_session(plan, planned_in)
            found["photographs"] = shot(
                machine, plan, planned_in, Level.PHOTOGRAPHS, args.first, args.rendered
            )
    return found


def shot(
    machine: Machine, plan: Plan, session: Path, level: Level, first: int, runs: int
) -> dict[str, object]:
    """Return errors of simulated calibrations of a planned session, beside what was predicted.

    The standard error of their ratio is that of the mean square of the runs.
    """
    dX, dE, stated, turned, failed = [], [], [], [], []
    rod = machine.rod_for_scale(has_length=False)
    lengths = {} if rod is None else {rod[1]: LENGTH_SIGMA}
    turning = [s for leg, s in zip(machine.legs, plan.sigma_q, strict=True) if leg.reads_angle]
    angles = Spread(float(min(turning)), Distribution.NORMAL) if turning else None
    for seed in range(first, first + runs):
        folder = session.parent / f"shot{seed}"
        out = session.parent / f"{folder.name}-result"
        try:
            settings = SimulationSettings(
                plan=session, level=level, seed=seed, lengths=lengths, angles=angles
            )
            taken = simulate(machine, folder, settings)
            result = legcal.calibrate(folder, output=out)
        except LegcalError as error:
            failed.append(str(error))
            continue
        of = legcal.evaluate(out / "calibrated.yaml", taken.truth_path)
        dX.append(of.displacement)
        dE.append(of.rotation)
        if result.platform is not None and result.platform.workspace is not None:
            stated.append(result.platform.workspace.displacement)
            turned.append(result.platform.workspace.rotation)
    expected = plan.error
    if expected is None:
        raise NotIdentifiable("Readings do not give the pose, needed another machine.")
    rms = {
        key: float(np.sqrt(np.mean(np.square(np.concatenate(x)))))
        for key, x in (
            ("found", dX),
            ("stated", stated),
            ("expected", [expected.displacement]),
            ("turned", turned),
            ("expected_turn", [expected.rotation]),
        )
    }
    square = np.array([float(np.mean(np.square(x))) for x in dX])
    spread = float(square.std(ddof=1)) if len(square) > 1 else 0.0
    return {
        "runs": runs,
        "first": first,
        "failed": failed,
        "predicted_mm": 1e3 * expected.mean_displacement,
        "mean_mm": 1e3 * float(np.mean(np.concatenate(dX))),
        "mean_deg": float(np.degrees(np.mean(np.concatenate(dE)))),
        "worst_mm": 1e3 * max(float(x.mean()) for x in dX),
        "found_over_predicted": rms["found"] / rms["expected"],
        "found_error": 0.5 * spread / len(square) ** 0.5 / rms["found"] / rms["expected"],
        "stated_over_predicted": rms["stated"] / rms["expected"],
        "stated_turn_over_predicted": rms["turned"] / rms["expected_turn"],
        "found_mm": (1e3 * np.sqrt(square)).tolist(),
    }


if __name__ == "__main__":
    main()
