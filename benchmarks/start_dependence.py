"""Whether a calibration depends on where its search began.

    python benchmarks/start_dependence.py [NAME ...] [--seed 0] [--keep FOLDER]

Each session is calibrated from several starts:

nominal
    The joint fit starts from the nominal model, without the four steps where camera poses are
    given.
staged
    From the model of the four steps, where they give one.
3 mm off
    From the nominal model with all joints, offsets and lengths moved by up to 3 mm. What the fit
    refers to (priors, held directions, the search of photographs before the first fit) stays
    nominal.
model off
    The nominal model itself is up to 3 mm off, so that photographs are searched elsewhere as well.
    Parameters that the data leave at nominal and points of axes, which count from the nominal ones,
    differ then; they are not compared.
usual
    As ``legcal calibrate`` starts.

Sessions are the example, photographs of simulated machines of several kinds, tables of outlines a
tenth of which are wrong, by little or by much, and the recorded sessions (tests/data/recorded). A
line for each start: the largest difference of an estimated parameter from the first start, in its
standard deviation; outlines used; chi2 of the fit.
"""

import argparse
import math
import shutil
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from tempfile import TemporaryDirectory
from unittest.mock import patch

import numpy as np

from legcal import LegcalError, calibrate, load_dataset
from legcal.calibration import estimate
from legcal.calibration.four_steps import starts
from legcal.calibration.joint_fit.variables import Start, start_from
from legcal.calibration.ordered_dataset import OrderedDataset
from legcal.calibration.result import Calibration
from legcal.data.outlines import Outlines, read_observations, write_observations
from legcal.geometry.types import Array
from legcal.machine.leg import ParameterId
from legcal.simulation.dataset import simulate
from legcal.simulation.observe import moved_outlines
from legcal.simulation.settings import Level, ParameterErrors, SimulationSettings, Spread
from legcal.simulation.truth import draw_errors, write_true_model

ROOT = Path(__file__).parents[1]
EXAMPLE = ROOT / "examples/hexapod"
RECORDED = ROOT / "tests/data/recorded"
OFF = 3e-3  # [m] of joints, offsets and lengths
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


RECORDED_SESSIONS = (
    "planar", "revolute", "universal", "passive", "constant", "redundant", "arms", "board", "few",
)  # fmt: skip
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
    write_true_model(nominal, errors_of(off), np.random.default_rng(seed), copy)
    return copy


def errors_of(off: float) -> ParameterErrors:
    """Return errors of joints, offsets and lengths up to a size [m]; axes and radii have none."""
    spread = Spread(off)
    return ParameterErrors(spread, spread, spread, spread)


@contextmanager
def started_from(label: str, off: float = 0.0, seed: int = 0) -> Iterator[None]:
    """Let joint fits begin at the start of that label alone, where there is one.

    With *off*, its legs are those of the nominal model with errors up to that size [m].
    """

    def chosen(data: OrderedDataset, *arguments: object) -> list[Start]:
        every = starts(data, *arguments)  # type: ignore[arg-type]
        labelled = [start for start in every if start.label == label] or every
        if not off:
            return labelled
        legs = draw_errors(data.machine, errors_of(off), np.random.default_rng(seed))
        start = labelled[0]
        moved = start_from(
            legs, data.measurements, data.fitted_legs, start.T_camera_Rb, start.T_Rb_Re, label
        )
        return [replace(start, legs=moved.legs, T_Rb_Re=moved.T_Rb_Re)]

    with patch.object(estimate, "starts", chosen):
        yield


def calibrated(
    folder: Path, start: str, *, steps: bool = True, off: float = 0.0, seed: int = 0
) -> Calibration:
    """Return the calibration of a dataset from a start, with or without the four steps."""
    with started_from(start, off, seed):
        criteria = "default" if steps else None
        return calibrate(folder, use_cache=False, criteria=criteria)  # type: ignore[arg-type]


def needs_steps(folder: Path) -> bool:
    """Return whether only the four steps place a camera of a table of outlines."""
    read = load_dataset(folder)
    views = read.measurements.views
    return read.observations is not None and any(view.T_base_camera is None for view in views)


def difference(
    first: Calibration, other: Calibration, *, same_nominal: bool = True
) -> tuple[float, str]:
    """Return the largest difference of an estimated parameter in sigmas of the first, and which.

    Without *same_nominal*, parameters that depend on the nominal model are left out.
    """
    estimates, others = first.solution.estimates, other.solution.estimates
    if set(estimates.names) != set(others.names):
        return math.inf, "other parameters are estimated"
    names = [
        name
        for name in estimates.names
        if same_nominal
        or (
            "weak" not in (estimates.status[name], others.status[name])
            and ParameterId.parse(name).kind != "axis_point"
        )
    ]
    sigma = dict(zip(estimates.names, estimates.sigma.tolist(), strict=True))
    off: Array = others.vector(names) - estimates.vector(names)
    off = np.abs(off) / [sigma[name] for name in names]
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


def compared(name: str, folder: Path, scratch: Path, seed: int) -> dict[str, float]:
    """Print a line for each start of a session; return the differences from the first [sigma]."""
    steps = needs_steps(folder)

    def from_model_off() -> Calibration:
        moved = with_other_model(folder, scratch, seed)
        return calibrated(moved, "nominal", steps=steps)

    by_start: dict[str, Callable[[], Calibration]] = {
        "nominal": lambda: calibrated(folder, "nominal", steps=steps),
        "staged": lambda: calibrated(folder, "staged"),
        "3 mm off": lambda: calibrated(folder, "nominal", steps=steps, off=OFF, seed=seed),
        "model off": from_model_off,
        "usual": lambda: calibrate(folder, use_cache=False),
    }
    first: Calibration | None = None
    differences = dict[str, float]()
    for start, run in by_start.items():
        begin = time.perf_counter()
        try:
            calibration = run()
        except LegcalError as error:
            print(f"{name:27} {start:9} {type(error).__name__}: {error}", flush=True)
            differences[start] = math.inf
            continue
        first = first or calibration
        off, worst = difference(first, calibration, same_nominal=start != "model off")
        differences[start] = off
        seconds = time.perf_counter() - begin
        print(
            f"{name:27} {start:9} {off:8.4f} sigma {worst:18} {facts(calibration)} "
            f"{seconds:5.1f} s",
            flush=True,
        )
    return differences


def main(arguments: Sequence[str] | None = None) -> None:
    """Print the sessions, and the largest difference of each start."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("names", nargs="*", help="parts of names of sessions; all without")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--keep", type=Path, help="a folder for the sessions")
    options = parser.parse_args(arguments)
    recorded = {f"recorded {name}": RECORDED / name for name in RECORDED_SESSIONS}
    chosen = [
        name
        for name in ("example", *recorded, *SESSIONS)
        if not options.names or any(part in name for part in options.names)
    ]
    by_start = dict[str, list[float]]()
    with TemporaryDirectory() as temporary:
        scratch = options.keep or Path(temporary)
        scratch.mkdir(parents=True, exist_ok=True)
        for name in chosen:
            folder = recorded.get(name, EXAMPLE)
            if name in SESSIONS:
                folder = session_folder(name, SESSIONS[name], scratch, options.seed)
            for start, off in compared(name, folder, Path(temporary), options.seed).items():
                by_start.setdefault(start, []).append(off)
    for start, differences in by_start.items():
        n_same = sum(off <= TOLERANCE for off in differences)
        print(
            f"{start:9} {n_same} of {len(differences)} within {TOLERANCE} sigma, at most "
            f"{max(differences):.4f} sigma"
        )


if __name__ == "__main__":
    main()
