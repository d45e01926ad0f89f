"""Machines that are not shipped, of every kind of the class: outlines, and calibrations.

    OMP_NUM_THREADS=1 python benchmarks/machine_kinds.py [KIND ...] [--runs 200] [--seed 0]
                         [--datasets 0] [--level axes|outlines|photographs] [--keep FOLDER]
                         [--record FILE] [--error KIND=SIZE] [--radii PERCENT]
                         [--wrong-reading MM] [--wrong-scale PERCENT]

KIND: a table of ``machine_kinds.yaml`` (all of them without), which is a table of joints without
version, name and unit (mm). Two things are asked:

- sessions of outlines (``--runs``): the joint fit from a model that is wrong by up to 2 mm and
  1 deg in everything, and from rough cameras; its errors beside the Cramer-Rao bound and the
  normalised squared error on all that is determined, as ``classes_study.py`` counts them; of
  redundant machines also how many of their readings, which are right, are called wrong;
- datasets (``--datasets``) of ``legcal simulate`` without hints at ``--level``, whose true machine
  is off by up to 2 mm and 0.1 deg or by ``--error``, calibrated by ``legcal calibrate``: how many
  converge, and how many of these the verdict trusts; of all that converge the platform error of eq
  (20) at their readings before and after, how the latter compares with the predicted sigma, and the
  normalised squared error of the parameters (means over seeds); of photographs also how far used
  outlines lie inside of the true ones. Where motors do not determine the pose, cameras have hints,
  and errors are those of the parameters in metres (root mean square). Where motors turn, somebody
  measures the distance of two joints on the base to 0.05 mm, or with ``--radii`` nothing but the
  radius of each leg, to so many per cent.

A mistake is made in the readings of each dataset by ``--wrong-reading`` (so much is added to one of
them) and ``--wrong-scale`` (those of one motor are so much larger); row and motor are drawn by the
seed. What the fit names is printed; errors are those at the right readings.
"""

import argparse
import csv
import json
import math
import shutil
import sys
import time
from collections.abc import Sequence
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
from bound import ERRORS
from classes_study import errors_of_fit
from outline_sessions import (
    CARRIED,
    ROUND_ARMS,
    Noise,
    design_of,
    draw_session,
    kinds,
    made,
    one_fit,
)
from outline_study import failures_of

from legcal import LegcalError, calibrate, evaluate, load_mechanism
from legcal.calibration.evaluation import Evaluation
from legcal.calibration.joint_fit.solution import Solution
from legcal.calibration.result import Calibration
from legcal.data.outlines import read_observations
from legcal.geometry.types import Array
from legcal.machine.leg import radius_name
from legcal.machine.model import Machine
from legcal.machine.parameters import geometries, vector_of
from legcal.simulation.dataset import simulate
from legcal.simulation.paper import failure_of
from legcal.simulation.settings import Level, SimulationSettings, parameter_errors
from legcal.vision.cylinder import EPSILON

N_VIEWS, N_POSES = 3, 15
LENGTH_SIGMA = 0.05  # [mm] of the distance of two joints that motors which turn need


def sessions(kind: str, runs: int, seed: int, record: Path | None) -> str:
    """Return a line on the joint fit in many sessions of outlines."""
    noise, records = Noise(), list[dict[str, Any]]()
    design = design_of(kind, N_VIEWS, N_POSES, noise.sigma_px)
    known = {}
    if record is not None and record.exists():
        read = [json.loads(line) for line in record.read_text().splitlines()]
        known = {
            row["run"]: row["found"] for row in read if (row["kind"], row["seed"]) == (kind, seed)
        }
    for run, child in enumerate(np.random.SeedSequence(seed).spawn(runs)):
        if run in known:
            records.append(known[run])
            continue
        session = draw_session(design, noise, ERRORS, np.random.default_rng(child))
        try:
            solution = one_fit(session, noise.radius_sigma)
            records.append(errors_of_fit(design, session, solution, noise))
            if (readings := solution.quality.redundant_readings) is not None:
                records[-1]["readings"] = len(readings.wrong), len(readings.doubts)
        except LegcalError as error:
            records.append({"failure": failure_of(error)})
            print(f"{kind}: {error}", file=sys.stderr)
        if record is not None:
            with record.open("a") as file:
                row = {"kind": kind, "seed": seed, "run": run, "found": records[-1]}
                file.write(json.dumps(row) + "\n")
    fits = [record for record in records if "failure" not in record]
    line = f"{kind:20}{len(fits):6} of {runs}"
    if fits:
        rank = np.array([fit["rank"] for fit in fits])
        ratio, nse = (
            float(rank @ np.array([fit[key] for fit in fits])) / rank.sum()
            for key in ("of_bound", "nse")
        )
        determined = f"{rank.min()} of {len(design.parametrization)}"
        line += f"{determined:>12}{math.sqrt(ratio):14.3f}{nse:8.3f}"
    judged = [fit["readings"] for fit in fits if "readings" in fit]
    if judged:
        n_wrong, n_doubts = np.sum(judged, axis=0).tolist()
        line += f"  {n_wrong} right readings left out, {n_doubts} doubts"
    return f"{line}  {failures_of(records) or ''}"


def with_mistake(folder: Path, machine: Machine, seed: int, added: float, scale: float) -> Path:
    """Return a copy of a dataset in whose readings a mistake was made, and print which.

    *added* [m] is what one reading is larger by, and *scale* what those of a motor are multiplied
    by.
    """
    wrong = shutil.copytree(folder, folder.with_name(f"{folder.name}-wrong"), dirs_exist_ok=True)
    with (folder / "measurements.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    rng = np.random.default_rng(seed)
    row, leg = int(rng.integers(len(rows))), machine.legs[int(rng.choice(machine.motors))]
    motor, image = str(leg.prismatic), rows[row]["image"] or f"row {row + 1}"
    for k, entry in enumerate(rows):
        entry[motor] = repr(scale * float(entry[motor]) + (added if k == row else 0.0))
    with (wrong / "measurements.csv").open("w", newline="") as file:
        writer = csv.DictWriter(file, list(rows[0]), lineterminator="\n")
        writer.writeheader()
        writer.writerows(rows)
    if added:
        print(f"{folder.name}: {1e3 * added:+g} mm in {leg.motor_label} of {image}")
    if scale != 1.0:
        print(f"{folder.name}: {100.0 * (scale - 1.0):+g} % in {leg.motor_label}")
    return wrong


def named_readings(solution: Solution) -> list[str]:
    """Return what a fit says is wrong with readings, in words."""
    judged = solution.quality.redundant_readings
    if judged is None:
        return []
    return [
        *(
            f"{' or '.join((one.motor, *one.alike))} of {one.image or f'pose {one.pose + 1}'} is "
            f"{1e3 * one.off:+.3f} mm off"
            for one in judged.wrong
        ),
        *(what for what, _ in judged.doubts),
    ]


def datasets(
    kind: str,
    level: Level,
    seeds: Sequence[int],
    scratch: Path,
    added: float = 0.0,
    scale: float = 1.0,
    radii: float = 0.0,
    errors: list[str] | None = None,
) -> str:
    """Print a line a dataset, and return one on all that were calibrated.

    *added* [m] and *scale* are of :func:`with_mistake`, and *radii* is what radii are stated to,
    as a part of them, in place of a length; none if it is 0. *errors* are those of
    ``legcal simulate --error``.
    """
    machine = load_mechanism(kind) if kind in CARRIED else made(kind, scratch / "nominal")
    model, found, hints = machine.yaml_path, [], not machine.is_determined
    squared, inwards, n_trusted = list[float](), list[Array](), 0
    for seed in seeds:
        folder = scratch / f"{kind}-{level}-{seed}"
        result = scratch / f"{folder.name}-result"
        begin = time.perf_counter()
        try:
            if not folder.exists():
                wrong = parameter_errors(errors or (), machine)
                settings = SimulationSettings(level=level, seed=seed, hints=hints, errors=wrong)
                simulate(model, folder, settings)
            begin = time.perf_counter()
            truth = next((folder / "truth/models").glob("*.yaml"))
            priors = list[str]()
            if any(actuator.turns for actuator in machine.actuators):
                measured, rng = load_mechanism(truth), np.random.default_rng(seed)
                priors = (
                    stated_radii(measured, radii, rng) if radii else measured_length(measured, rng)
                )
            read = folder
            if added or scale != 1.0:
                read = with_mistake(folder, machine, seed, added, scale)
            calibration = calibrate(read, output=result, use_cache=False, priors=priors)
            both = [
                evaluate(path, truth, dataset=folder)
                for path in (model, result / "calibrated.yaml")
            ]
        except LegcalError as error:
            print(f"{kind:20}{seed:4}  {type(error).__name__}: {error}", flush=True)
            continue
        platform, solution = calibration.platform, calibration.solution
        if platform is None:
            before, after = (_in_metres(one) for one in both)
            estimates = solution.estimates
            lengths = [
                sigma**2
                for name, sigma in zip(estimates.names, estimates.sigma, strict=True)
                if name.split(".")[1] in ("base", "platform", "offset", "length")
            ]
            predicted = math.sqrt(float(np.mean(lengths)))
        else:
            before, after = (one.displacement.mean() for one in both)
            predicted = platform.sigma.mean_displacement
        squared.append(normalised_error(machine, result / "calibrated.yaml", truth, solution))
        found.append((before, after, predicted))
        trusted = calibration.verdict.trustworthy
        n_trusted += trusted
        seconds = time.perf_counter() - begin
        nse = f", nse {squared[-1]:5.2f}"
        print(f"{kind:20}{seed:4}{numbers(found[-1])}{nse}{seconds:6.0f} s", end="")
        if level is Level.PHOTOGRAPHS:
            inwards.append(inward_errors(folder, calibration))
            print(f", edges {np.mean(inwards[-1]):+.3f} px inwards", end="")
        print("" if trusted else f", not trusted: {calibration.verdict.sentence}", flush=True)
        for words in named_readings(solution):
            print(f"  named: {words}", flush=True)
    line = f"{kind:20}{len(found):4} of {len(seeds)} converge from {level}, {n_trusted} trusted"
    line += numbers(np.mean(found, axis=0)) if found else ""
    if inwards:
        every = np.concatenate(inwards)
        line += f", {len(every)} edges {np.mean(every):+.3f} px inwards"
    return line + (f", nse {np.mean(squared):5.2f}" if squared else "")


def inward_errors(folder: Path, calibration: Calibration) -> Array:
    """Return how far used outlines of legs are inside of the true ones, in the middle (n,) [px]."""
    read, outlines = calibration.dataset, calibration.solution.outlines
    measurements = read.measurements
    truth = read_observations(folder / "truth/outlines.csv", read.machine.legs, measurements)
    lines = dict(zip(truth.row_keys(), truth.h, strict=True))
    off = list[float]()
    for i, key in enumerate(outlines.row_keys()):
        if outlines.used[i] and key in lines:
            camera = measurements.views[measurements.view[outlines.row[i]]].camera
            offset = camera.line_offset(lines[key][None], camera.undistort(outlines.ends[i]))
            off.append(EPSILON[outlines.edge[i] - 1] * float(offset.mean()))
    return np.array(off)


def normalised_error(nominal: Machine, calibrated: Path, truth: Path, solution: Solution) -> float:
    """Return the normalised squared error of all parameters that the fit estimates.

    Axes count from the nominal ones, as in the covariance: turns about another axis are about other
    directions.
    """
    there, true = (
        vector_of(
            solution.kinematic.parametrization,
            geometries(load_mechanism(path).with_leg_order(nominal.leg_names)),
            geometries(nominal),
        )
        for path in (calibrated, truth)
    )
    sigma = np.sqrt(np.diagonal(solution.kinematic.value_covariance))
    free = np.flatnonzero(sigma > 0.0)  # gains are fixed
    unit = sigma[free]
    covariance = solution.kinematic.value_covariance[np.ix_(free, free)]
    value, vector = np.linalg.eigh(covariance / np.outer(unit, unit))
    kept = value > 1e-9
    along = vector[:, kept].T @ ((there - true)[free] / unit)
    return float(np.mean(along**2 / value[kept]))


def measured_length(truth: Machine, rng: np.random.Generator) -> list[str]:
    """Return the distance of two joints on the base as somebody measured it."""
    legs = truth.frame_legs[:2]
    one, other = truth.A_base[list(legs)]
    names = [f"{truth.leg_names[j]}.base" for j in legs]
    length = 1e3 * float(np.linalg.norm(one - other)) + LENGTH_SIGMA * float(rng.normal())
    return [f"{':'.join(names)}={length:.4f}+-{LENGTH_SIGMA}mm"]


def stated_radii(truth: Machine, sigma: float, rng: np.random.Generator) -> list[str]:
    """Return the radii of all legs as somebody measured them; *sigma* is a part of each."""
    return [
        f"{radius_name(leg.name, part)}={1e3 * radius * (1.0 + sigma * float(rng.normal())):.4f}"
        f"+-{1e3 * sigma * radius:.4f}mm"
        for leg in truth.legs
        for part, radius in leg.radius_of_part.items()
    ]


def _in_metres(found: Evaluation) -> float:
    """Return the root mean square error of all parameters that are lengths [m]."""
    is_length = np.array([unit == "m" for unit in found.units])
    return math.sqrt(float(np.mean((found.values - found.references)[is_length] ** 2)))


def numbers(errors: Sequence[float]) -> str:
    """Return errors of the platform [mm]: before, after, predicted; and the ratio of these."""
    before, after, predicted = errors
    return (
        f"  nominal {1e3 * before:7.3f} mm, calibrated {1e3 * after:7.4f}, predicted "
        f"{1e3 * predicted:7.4f}, ratio {after / predicted:5.2f}"
    )


def main() -> None:
    """Print what was asked of every kind."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("kinds", nargs="*", metavar="KIND", help="tables; all of them")
    parser.add_argument("--runs", type=int, default=200, help="sessions of outlines; 200")
    parser.add_argument("--seed", type=int, default=0, help="of sessions, and of the first dataset")
    parser.add_argument("--datasets", type=int, default=0, help="simulated and calibrated; none")
    parser.add_argument("--level", type=Level, default=Level.OUTLINES, choices=list(Level))
    parser.add_argument("--keep", type=Path, help="folder that keeps datasets for the next run")
    parser.add_argument("--record", type=Path, help="JSON lines of sessions, to go on from later")
    parser.add_argument("--error", action="append", help="of the machine, as of legcal simulate")
    parser.add_argument("--radii", type=float, default=0.0, help="[%%] stated; none, but a length")
    parser.add_argument("--wrong-reading", type=float, default=0.0, help="[mm] in one; none")
    parser.add_argument("--wrong-scale", type=float, default=0.0, help="[%%] of a motor; none")
    options = parser.parse_args()
    known = (*kinds(), *ROUND_ARMS, *CARRIED)
    if unknown := set(options.kinds) - set(known):
        parser.error(f"found {', '.join(sorted(unknown))}, needed some of {', '.join(known)}")
    chosen = options.kinds or list(known)
    if options.runs:
        print(f"{'':20}{'converged':>12}{'determined':>12}{'error/bound':>14}{'nse':>8}")
        for kind in chosen:
            print(sessions(kind, options.runs, options.seed, options.record), flush=True)
    if options.datasets:
        seeds = range(options.seed, options.seed + options.datasets)
        with TemporaryDirectory() as temporary:
            scratch = options.keep or Path(temporary)
            scratch.mkdir(parents=True, exist_ok=True)
            mistake = 1e-3 * options.wrong_reading, 1.0 + 0.01 * options.wrong_scale
            radii = 0.01 * options.radii
            summary = [
                datasets(kind, options.level, seeds, scratch, *mistake, radii, options.error)
                for kind in chosen
            ]
        print(*summary, sep="\n")


if __name__ == "__main__":
    main()
