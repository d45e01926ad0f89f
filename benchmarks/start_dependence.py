"""Whether a calibration depends on where its search began.

    python benchmarks/start_dependence.py [NAME ...] [--seed 0] [--keep FOLDER]

Each of ten sessions is calibrated from several starts: the joint fit from the nominal model, the
four steps left out; from the model of the four steps, where these give one; and from a nominal
model all of whose joints and lengths are up to 3 mm elsewhere, which looks for legs elsewhere in
the images as well. Axes and radii keep their nominal values, which priors are about.

Sessions are the example, photographs of simulated machines of several kinds, and tables of
outlines a tenth of which are wrong, by little or by much. A line each: the largest difference of
an estimated parameter from the first start, in its standard deviation; outlines used; chi2 of
the fit.
"""

import argparse
import math
import shutil
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from unittest.mock import patch

import numpy as np

from legcal import LegcalError, calibrate, load_dataset
from legcal.calibration import estimate
from legcal.calibration.four_steps import starts
from legcal.calibration.joint_fit.variables import Start
from legcal.calibration.result import Calibration
from legcal.data.outlines import Outlines, read_observations, write_observations
from legcal.geometry.types import Array
from legcal.simulation.dataset import simulate
from legcal.simulation.observe import moved_outlines
from legcal.simulation.settings import Level, ParameterErrors, SimulationSettings, Spread
from legcal.simulation.truth import write_true_model

EXAMPLE = Path(__file__).parents[1] / "examples/hexapod"
OFF = 3e-3  # [m] of joints and lengths of the third start
WRONG_SHARE = 0.1  # of outlines
WRONG_PX = (0.3, 30.0)  # of a wrong outline, evenly by the logarithm
TOLERANCE = 0.02  # standard deviations that starts may differ by


@dataclass(frozen=True)
class Session:
    """A simulated session."""

    model: str
    level: Level
    seed: int
    views: int = 3
    poses: int = 6


SESSIONS = {
    "hexapod photographs": Session("hexapod", Level.PHOTOGRAPHS, 1),
    "6-sps photographs": Session("6-sps", Level.PHOTOGRAPHS, 2),
    "3-rps photographs": Session("3-rps", Level.PHOTOGRAPHS, 3),
    "nategh-agheli photographs": Session("nategh-agheli", Level.PHOTOGRAPHS, 4),
    "hexapod-strut photographs": Session("hexapod-strut", Level.PHOTOGRAPHS, 5),
    "linear-delta photographs": Session("linear-delta", Level.PHOTOGRAPHS, 6),
    "3-rpr photographs": Session("3-rpr", Level.PHOTOGRAPHS, 7),
    "hexapod outlines": Session("hexapod", Level.OUTLINES, 8, 3, 10),
    "tricept outlines": Session("tricept", Level.OUTLINES, 9, 3, 10),
}


def with_wrong_outlines(outlines: Outlines, folder: Path, rng: np.random.Generator) -> Outlines:
    """Return outlines of a dataset some of which are off, at both ends alike or not."""
    read = load_dataset(folder)
    n = len(outlines)
    sizes = np.exp(rng.uniform(math.log(WRONG_PX[0]), math.log(WRONG_PX[1]), (n, 1))) * rng.choice(
        [-1.0, 1.0], (n, 1)
    )
    offsets = sizes * np.stack([np.ones(n), rng.uniform(-1.0, 1.0, n)], axis=1)
    offsets[rng.random(n) >= WRONG_SHARE] = 0.0
    return moved_outlines(outlines, read.measurements.views[0].camera, offsets)


def session_folder(name: str, session: Session, scratch: Path, seed: int = 0) -> Path:
    """Return the dataset of a session, simulated unless it is there."""
    folder = scratch / f"{name.replace(' ', '-')}-{session.seed + seed}"
    if folder.exists():
        return folder
    settings = SimulationSettings(
        level=session.level,
        seed=session.seed + seed,
        views=session.views,
        poses=session.poses,
        hints=True,
    )
    made = simulate(session.model, folder, settings)
    if session.level is Level.OUTLINES:
        path = folder / "observations.csv"
        outlines = read_observations(path, made.nominal.legs, made.measurements)
        wrong = with_wrong_outlines(outlines, folder, np.random.default_rng(session.seed + seed))
        write_observations(path, wrong, made.measurements, made.nominal.leg_names)
    return folder


def with_other_model(folder: Path, scratch: Path, seed: int, off: float = OFF) -> Path:
    """Return a copy of a dataset whose nominal model has its joints and lengths elsewhere."""
    copy = scratch / f"{folder.name}-off-{seed}"
    shutil.rmtree(copy, ignore_errors=True)
    left = ["truth", "models", "urdf"]
    if (folder / "images").exists():
        left.append("observations.csv")  # of an earlier calibration
    shutil.copytree(folder, copy, ignore=shutil.ignore_patterns(*left))
    nominal = load_dataset(folder).machine
    spread = Spread(off)
    errors = ParameterErrors(spread, spread, spread, spread)
    write_true_model(nominal, errors, np.random.default_rng(seed), copy)
    return copy


@contextmanager
def started_from(label: str) -> Iterator[None]:
    """Let joint fits start there alone, where there is such a start."""

    def chosen(*arguments: object) -> list[Start]:
        every = starts(*arguments)  # type: ignore[arg-type]
        return [start for start in every if start.label == label] or every

    with patch.object(estimate, "starts", chosen):
        yield


def calibrated(folder: Path, start: str, *, steps: bool = True) -> Calibration:
    """Return the calibration of a dataset from a start, the four steps left out or not."""
    with started_from(start):
        criteria = "default" if steps else None
        return calibrate(folder, use_cache=False, criteria=criteria)  # type: ignore[arg-type]


def difference(one: Calibration, two: Calibration) -> tuple[float, str]:
    """Return the largest difference of an estimated parameter in sigmas of the first, and which."""
    names = one.solution.estimates.names
    if set(names) != set(two.solution.estimates.names):
        return math.inf, "other parameters are estimated"
    off: Array = two.solution.estimates.vector(names) - one.solution.estimates.vector(names)
    off = np.abs(off) / one.solution.estimates.sigma
    worst = int(np.argmax(off))
    return float(off[worst]), names[worst]


def facts(calibration: Calibration) -> str:
    """Return outlines used, chi2 and noise of a fit."""
    solution = calibration.solution
    quality = solution.quality
    return (
        f"{int(solution.outlines.used.sum()):5} outlines, chi2 {quality.chi2:9.3f}, "
        f"noise {quality.noise.scale:.4f}"
    )


def compared(name: str, folder: Path, scratch: Path, seed: int) -> list[float]:
    """Print a line a start of a session; return the differences from the first one [sigma]."""
    begin = time.perf_counter()
    first = calibrated(folder, "nominal", steps=False)
    seconds = time.perf_counter() - begin
    print(f"{name:27} nominal {'':34}{facts(first)} {seconds:5.1f} s", flush=True)
    found = list[float]()
    for label in ("staged", "3 mm off", "usual"):
        begin = time.perf_counter()
        try:
            if label == "staged":
                other = calibrated(folder, "staged")
                label = other.solution.start
            elif label == "usual":
                other = calibrate(folder, use_cache=False)
            else:
                moved = with_other_model(folder, scratch, seed)
                other = calibrated(moved, "nominal", steps=False)
        except LegcalError as error:
            print(f"{'':27} {label:8} {type(error).__name__}: {error}", flush=True)
            found.append(math.inf)
            continue
        off, worst = difference(first, other)
        seconds = time.perf_counter() - begin
        found.append(off)
        print(
            f"{'':27} {label:8} {off:8.4f} sigma {worst:18} {facts(other)} {seconds:5.1f} s",
            flush=True,
        )
    return found


def main(arguments: Sequence[str] | None = None) -> None:
    """Print the sessions, and the largest difference of all."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("names", nargs="*", help="parts of names of sessions; all without")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--keep", type=Path, help="a folder for the sessions")
    options = parser.parse_args(arguments)
    chosen = [
        name
        for name in ("example", *SESSIONS)
        if not options.names or any(part in name for part in options.names)
    ]
    off = list[float]()
    with TemporaryDirectory() as temporary:
        scratch = options.keep or Path(temporary)
        scratch.mkdir(parents=True, exist_ok=True)
        for name in chosen:
            folder = EXAMPLE
            if name != "example":
                folder = session_folder(name, SESSIONS[name], scratch, options.seed)
            off += compared(name, folder, Path(temporary), options.seed)
    n_same = sum(one <= TOLERANCE for one in off)
    print(f"{n_same} of {len(off)} within {TOLERANCE} sigma, at most {max(off):.4f} sigma")


if __name__ == "__main__":
    main()
