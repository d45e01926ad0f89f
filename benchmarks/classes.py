"""How much better a machine of each class becomes by photographs, against its true model.

    OMP_NUM_THREADS=1 python benchmarks/classes.py [MODEL ...] [--seeds 2] [--keep FOLDER]

Every shipped model is simulated as ``legcal simulate MODEL`` does without options: 45 photographs,
3 views of 15 extreme poses each. Platform errors of eq (20) at these poses, displacement [mm] and
rotation [deg]: of the nominal model, of the model that ``legcal calibrate`` makes of the
photographs, and what it predicts (1 sigma). "better" is the first over the second. Beside it
the same machine, poses and cameras with outlines of 0.1 px of noise in each edge point
(``--level outlines``): what photographs lose to it is lost in finding the edges. At last what
the measured noise of outlines is over what detection claims, the share of them that is rejected,
and the seconds of the calibration on one core.
"""

import argparse
import math
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from legcal import LegcalError, calibrate, evaluate, load_dataset
from legcal.simulation.dataset import simulate
from legcal.simulation.settings import Level, SimulationSettings

MODELS = Path(__file__).parents[1] / "models"
HEADER = (
    f"{'':18}{'nominal':>15}   {'photographs':>15}{'better':>8}{'predicted':>16}   {'outlines':>15}"
    f"{'better':>8}{'predicted':>16}{'noise':>8}{'left out':>9}{'time':>6}"
)


@dataclass(frozen=True)
class Gain:
    """Errors of the platform before and after a calibration, displacement and rotation."""

    before: tuple[float, float]  # [m, rad]
    after: tuple[float, float]
    predicted: tuple[float, float]
    noise: float
    rejected: float
    seconds: float

    @property
    def better(self) -> float:
        """The error before over the error after, in displacement."""
        return self.before[0] / self.after[0]


def gain(model: str, level: Level, seed: int, scratch: Path) -> Gain:
    """Simulate a dataset unless it is there, and calibrate it."""
    folder = scratch / f"{model}-{level}-{seed}"
    if not folder.exists():
        simulate(model, folder, SimulationSettings(level=level, seed=seed))
    result = scratch / f"{folder.name}-result"
    begin = time.perf_counter()
    calibration = calibrate(folder, output=result, use_cache=False)
    seconds = time.perf_counter() - begin
    truth = next((folder / "truth/models").glob("*.yaml"))
    nominal = load_dataset(folder).machine.yaml_path
    before, after = (
        evaluate(path, truth, dataset=folder) for path in (nominal, result / "calibrated.yaml")
    )
    platform, outlines = calibration.platform, calibration.solution.outlines
    if platform is None or before.displacement is None or after.displacement is None:
        raise LegcalError(f"{model}: found motors that do not determine the pose.")
    return Gain(
        (float(before.displacement.mean()), float(before.rotation.mean())),
        (float(after.displacement.mean()), float(after.rotation.mean())),
        (platform.sigma.mean_displacement, platform.sigma.mean_rotation),
        calibration.solution.quality.noise.scale,
        1.0 - float(np.mean(outlines.used)),
        seconds,
    )


def text(pair: tuple[float, float]) -> str:
    """Return a displacement [mm] and a rotation [deg]."""
    return f"{1e3 * pair[0]:7.3f} {math.degrees(pair[1]):7.4f}"


def line(name: str, photographs: Gain, outlines: Gain) -> str:
    """Return a line of the table."""
    both = "".join(
        f"   {text(g.after)}{g.better:8.1f} {text(g.predicted)}" for g in (photographs, outlines)
    )
    return (
        f"{name:18}{text(photographs.before)}{both}{photographs.noise:8.2f}"
        f"{100 * photographs.rejected:7.1f} %{photographs.seconds:6.0f}"
    )


def runs(model: str, seeds: range, scratch: Path) -> Iterator[float]:
    """Print a line a run and yield how much better photographs made the machine."""
    for seed in seeds:
        try:
            photographs, outlines = (
                gain(model, level, seed, scratch) for level in (Level.PHOTOGRAPHS, Level.OUTLINES)
            )
        except LegcalError as error:
            print(f"{model + f' {seed}':18}{error}", flush=True)
            yield 0.0
            continue
        print(line(f"{model} {seed}", photographs, outlines), flush=True)
        yield photographs.better


def main() -> None:
    """Print a line a run, and at the end how much better each class became."""
    shipped = sorted(path.stem for path in MODELS.glob("*.yaml"))
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("models", nargs="*", metavar="MODEL", help="shipped models; all of them")
    parser.add_argument("--seeds", type=int, default=2, help="machines of each class; 2")
    parser.add_argument("--first", type=int, default=0, help="the first seed; 0")
    parser.add_argument("--keep", type=Path, help="folder that keeps datasets for the next run")
    options = parser.parse_args()
    if unknown := set(options.models) - set(shipped):
        parser.error(f"found {', '.join(sorted(unknown))}, needed some of {', '.join(shipped)}")
    seeds = range(options.first, options.first + options.seeds)
    print(HEADER)
    with TemporaryDirectory() as temporary:
        scratch = options.keep or Path(temporary)
        scratch.mkdir(exist_ok=True)
        summary = {}
        for model in options.models or shipped:
            summary[model] = list(runs(model, seeds, scratch))
    for model, found in summary.items():
        mean = math.exp(np.mean(np.log(found))) if min(found) > 0.0 else 0.0
        print(f"{model:16} better by {min(found):5.1f} to {max(found):5.1f}, mean {mean:5.1f}")


if __name__ == "__main__":
    main()
