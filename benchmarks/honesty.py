"""Whether predicted uncertainties are right on photographs, judged by the true models.

    python benchmarks/honesty.py [--simulate hexapod 6-sps ...] [--seeds 3] [--datasets FOLDER ...]

Datasets are simulated with ``legcal simulate`` (fifteen seconds each on one core) or given: folders
that hold ``truth/models``. The example hexapod is always among them. A line each: root mean square
of the true errors of all joints and lengths and of what the fit predicts; mean squares of errors
over predicted standard deviations, one by one ("pull^2") and with the whole covariance ("joint");
the part of errors inside their 95 % intervals; displacement of the platform at the poses, true and
predicted; noise of single outlines over what detection claims, and standard deviations of the
shifts that outlines share [px]: bias and tilt of many edges, of one, and of its change with place.
One dataset shows little, since its errors hang together: look at the last line.
"""

import argparse
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from legcal import calibrate, load_mechanism
from legcal.calibration.joint_fit.outline_errors import KINDS
from legcal.calibration.result import Calibration
from legcal.geometry.motions import components
from legcal.geometry.types import Array
from legcal.machine.equations import pose_sensitivity
from legcal.machine.model import Machine
from legcal.machine.parameters import geometries, vector_of
from legcal.simulation.dataset import simulate
from legcal.simulation.settings import SimulationSettings

ROOT = Path(__file__).parents[1]
EXAMPLE = ROOT / "examples/hexapod", ROOT / "tests/data/hexapod-truth/models/hexapod.yaml"


@dataclass(frozen=True)
class Honesty:
    """Errors of a calibration beside what it predicts of them."""

    name: str
    n: int
    rms: float  # [m]
    rms_predicted: float
    pull: float
    joint: float
    covered: float
    displacement: float  # [m]
    displacement_predicted: float
    scale: float
    shifts: Array  # [px]

    def __str__(self) -> str:
        shifts = " ".join(f"{x:.3f}" for x in self.shifts)
        return (
            f"{self.name:24s} {self.n:3d} {1e6 * self.rms:6.0f} {1e6 * self.rms_predicted:6.0f} "
            f"{self.pull:7.2f} {self.joint:6.2f} {100 * self.covered:6.1f} "
            f"{1e6 * self.displacement:6.0f} {1e6 * self.displacement_predicted:6.0f} "
            f"{self.scale:6.2f}  {shifts}"
        )


def honesty(name: str, calibration: Calibration, truth: Machine) -> Honesty:
    """Compare a calibration with the true model."""
    solution, machine = calibration.solution, calibration.dataset.machine
    truth = truth.with_leg_order(machine.leg_names)
    legs, parametrization = solution.legs, solution.kinematic.parametrization
    step = vector_of(parametrization, geometries(truth), legs)
    step = step - vector_of(parametrization, legs, legs)
    C = solution.kinematic.covariance
    known = np.diagonal(C) > 0.0
    by_pose = pose_sensitivity(
        legs, parametrization, machine.frame_legs, *components(solution.T_Rb_Re)
    )[:, 3:]
    away = np.einsum("kia,a->ki", by_pose, step)
    spread = np.einsum("kia,ab,kib->k", by_pose, C, by_pose)
    lengths = known & (np.array(parametrization.units) == "m")
    error, sigma = step[known], np.sqrt(np.diagonal(C)[known])
    scaled = C[np.ix_(known, known)] / sigma / sigma[:, None]
    pull = error / sigma
    kinds = dict.fromkeys(KINDS, 0.0)
    kinds |= solution.quality.shared_px
    return Honesty(
        name,
        len(error),
        rms(step[lengths]),
        rms(np.sqrt(np.diagonal(C)[lengths])),
        float(np.mean(pull**2)),
        float(pull @ np.linalg.pinv(scaled, rcond=1e-9, hermitian=True) @ pull / len(pull)),
        float(np.mean(np.abs(pull) < 1.96)),
        float(np.sqrt(np.mean(np.sum(away**2, axis=1)))),
        float(np.sqrt(np.mean(spread))),
        solution.quality.noise.scale,
        np.array(list(kinds.values())),
    )


def rms(values: Array) -> float:
    """Return the root mean square."""
    return float(np.sqrt(np.mean(values**2)))


def datasets(options: argparse.Namespace, scratch: Path) -> Iterator[tuple[str, Path, Path]]:
    """Yield names, datasets and true models, simulated when their turn comes."""
    yield "example", *EXAMPLE
    for folder in options.datasets:
        yield folder.name, folder, next((folder / "truth/models").glob("*.yaml"))
    for model in options.simulate:
        for seed in range(options.seeds):
            folder = scratch / f"{model}-{seed}"
            simulate(model, folder, SimulationSettings(seed=seed))
            yield folder.name, folder, next((folder / "truth/models").glob("*.yaml"))


def main() -> None:
    """Print a line a dataset, and the means."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--simulate", nargs="*", default=["hexapod", "6-sps", "nategh-agheli"])
    parser.add_argument("--seeds", type=int, default=3)
    parser.add_argument("--datasets", nargs="*", type=Path, default=[])
    options = parser.parse_args()
    print(f"{'':24} {'n':>3} {'um':>6} {'sigma':>6} {'pull^2':>7} {'joint':>6} {'95 %':>6} "
          f"{'dX um':>6} {'sigma':>6} {'noise':>6}  shared [px]")  # fmt: skip
    found = []
    with TemporaryDirectory() as scratch:
        for name, folder, truth in datasets(options, Path(scratch)):
            calibration = calibrate(folder, use_cache=False)
            found.append(honesty(name, calibration, load_mechanism(truth)))
            print(found[-1], flush=True)
    pulls, joints = np.array([[h.pull, h.joint] for h in found]).T
    covered = 100 * np.average([h.covered for h in found], weights=[h.n for h in found])
    ratio = np.exp(np.mean([np.log(h.displacement / h.displacement_predicted) for h in found]))
    print(
        f"mean pull^2 {pulls.mean():.2f} (median {np.median(pulls):.2f}), "
        f"joint {joints.mean():.2f}, inside 95 % {covered:.1f} %, "
        f"platform error over predicted {ratio:.2f}, "
        f"rms {1e6 * np.exp(np.mean([np.log(h.rms) for h in found])):.0f} um (geometric mean)"
    )


if __name__ == "__main__":
    main()
