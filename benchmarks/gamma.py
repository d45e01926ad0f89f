"""What a gamma that nobody tells does to a calibration, and how well outlines tell it.

    OMP_NUM_THREADS=1 python benchmarks/gamma.py [MODEL ...] [--seeds 3]

Photographs of simulated machines by cameras of gamma 2.2 and 1, three views of some poses each, are
calibrated with the true gamma told, with none told, and, those of gamma 2.2, with a wrong gamma of
1 told, which is what reading them without looking means. Root mean square error of the platform at
its poses and what is predicted (1 sigma), normalised squared errors of single parameters and of
all together, residuals, and the gamma that was found.
"""

import argparse
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory

from honesty import honesty

from legcal import Appearance, LegcalError, calibrate, load_dataset, load_mechanism
from legcal.data.dataset import Dataset
from legcal.simulation.dataset import simulate
from legcal.simulation.settings import SimulationSettings

ENCODED = 2.2
HEADER = (
    f"{'':16}{'gamma':>6} {'told':>5} {'dX um':>7} {'sigma':>7} {'pull^2':>7} {'joint':>6} "
    f"{'rms px':>7} {'found':>13} {'time':>5}"
)


def told(dataset: Dataset, gamma: float | None) -> Dataset:
    """Return a dataset that tells this gamma of all its cameras, or none."""
    views = tuple(
        replace(
            view,
            camera=replace(view.camera, gamma=gamma or 1.0, gamma_is_given=gamma is not None),
        )
        for view in dataset.measurements.views
    )
    return replace(dataset, measurements=replace(dataset.measurements, views=views))


def line(name: str, folder: Path, gamma: float, said: float | None) -> str:
    """Calibrate a dataset, and return a line of the table."""
    truth = load_mechanism(next((folder / "truth/models").glob("*.yaml")))
    begin = time.perf_counter()
    calibration = calibrate(told(load_dataset(folder), said), use_cache=False)
    seconds = time.perf_counter() - begin
    solution, judged = calibration.solution, honesty(name, calibration, truth)
    found = [f"{one.gamma:.2f} +- {one.gamma * one.sigma:.2f}" for one in solution.gammas]
    return (
        f"{name:16}{gamma:6.1f} {'-' if said is None else f'{said:.1f}':>5} "
        f"{1e6 * judged.displacement:7.0f} {1e6 * judged.displacement_predicted:7.0f} "
        f"{judged.pull:7.2f} {judged.joint:6.2f} {solution.quality.rms_px:7.3f} "
        f"{', '.join(found):>13} {seconds:5.0f}"
    )


def cases(model: str, seeds: range, poses: int, scratch: Path) -> Iterator[str]:
    """Yield the lines of a model."""
    for seed in seeds:
        for gamma in (ENCODED, 1.0):
            folder = scratch / f"{model}-{seed}-{gamma:g}"
            look = Appearance(gamma=gamma)
            simulate(model, folder, SimulationSettings(seed=seed, poses=poses, appearance=look))
            for said in dict.fromkeys((gamma, None, 1.0)):
                try:
                    yield line(f"{model} {seed}", folder, gamma, said)
                except LegcalError as error:
                    yield f"{model} {seed}: {error}"


def main() -> None:
    """Print a line a calibration."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("models", nargs="*", metavar="MODEL", default=["hexapod"])
    parser.add_argument("--seeds", type=int, default=3, help="machines of each class; 3")
    parser.add_argument("--first", type=int, default=1, help="the first seed; 1")
    parser.add_argument("--poses", type=int, default=8, help="images of each view; 8")
    options = parser.parse_args()
    seeds = range(options.first, options.first + options.seeds)
    print(HEADER)
    with TemporaryDirectory() as scratch:
        for model in options.models:
            for found in cases(model, seeds, options.poses, Path(scratch)):
                print(found, flush=True)


if __name__ == "__main__":
    main()
