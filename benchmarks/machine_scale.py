"""One machine in five sizes: the same photographs, all lengths of the dataset times a factor.

    OMP_NUM_THREADS=1 python benchmarks/machine_scale.py [--full] [--no-hints] [--dataset FOLDER]
                                                         [--legs 0.012 0.4] [--seed 1] [--keep DIR]

The hexapod is photographed once (24 images of 512 x 384 pixels, or 1024 x 768 with --full). For
each mean leg length all lengths of model, readings, their sigma and rough camera poses are scaled,
which leaves the photographs as they are, so that a calibration must find the same. Asked are,
against legs as they are: outlines used within 5 %, platform sigma over leg length within 10 %,
processor time within 50 %. The last column says which of these does not hold. ``--dataset`` takes
another dataset in place of the rendered one.
"""

import argparse
import json
import os
import resource
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory

import yaml

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))

from scaled import scaled_dataset

from legcal.data.dataset import load_dataset
from legcal.machine.closing import leg_scale

LEGS = (0.012, 0.04, 0.4, 4.0, 19.0)  # mean leg lengths [m]
OUTLINES, SIGMA, TIME = 0.05, 0.1, 0.5  # how far they may be from those at scale 1, as a part
CAMERA = {
    "image_width": 512, "image_height": 384, "camera_name": "small",
    "camera_matrix": {
        "rows": 3, "cols": 3, "data": [645.15, 0.0, 258.9, 0.0, 645.15, 189.6, 0.0, 0.0, 1.0]
    },
    "distortion_model": "plumb_bob",
    "distortion_coefficients": {"rows": 1, "cols": 5, "data": [0.0] * 5},
}  # fmt: skip


@dataclass(frozen=True)
class Outcome:
    """What a calibration found; without any outline where it failed."""

    used: int
    total: int
    rms_px: float
    sigma: float  # of the platform's position, over the mean leg length
    seconds: float  # of the processor
    said: str = ""  # why it failed

    def misses(self, usual: "Outcome") -> str:
        """Say what is not as asked against another size."""
        if self.said:
            return self.said
        off = {
            "outlines": (self.used / usual.used - 1.0, OUTLINES),
            "sigma": (self.sigma / usual.sigma - 1.0, SIGMA),
            "time": (self.seconds / usual.seconds - 1.0, TIME),
        }
        return ", ".join(
            f"{name} {100 * part:+.0f} %" for name, (part, most) in off.items() if abs(part) > most
        )


def legcal(*arguments: object) -> tuple[subprocess.CompletedProcess[str], float]:
    """Run legcal; return its output and the processor time that it and its workers took."""
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    command = [sys.executable, "-m", "legcal", *map(str, arguments)]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    return done, after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime


def photographed(folder: Path, seed: int, *, full: bool) -> Path:
    """Photograph the hexapod."""
    options = []
    if not full:
        camera = folder / "camera.yaml"
        camera.write_text(yaml.safe_dump(CAMERA), encoding="utf-8")
        options = ["--camera", camera]
    model = Path(__file__).parents[1] / "models/hexapod.yaml"
    dataset = folder / "dataset"
    done, _ = legcal("simulate", model, "-o", dataset, "--poses", 8, "--seed", seed, "-q", *options)
    if done.returncode:
        sys.exit(done.stderr)
    return dataset


def without_hints(folder: Path) -> None:
    """Remove rough camera poses and legs of views."""
    path = folder / "dataset.yaml"
    text = yaml.safe_load(path.read_text(encoding="utf-8"))
    for view in text["views"].values():
        view.pop("T_base_camera", None)
        view.pop("legs", None)
    path.write_text(yaml.safe_dump(text, sort_keys=False), encoding="utf-8")


def calibrated(dataset: Path, out: Path, leg: float) -> Outcome:
    """Calibrate a dataset anew."""
    done, seconds = legcal(
        "calibrate", dataset, "-o", out, "--fresh", "--no-report", "--json", "--workers", 1
    )
    if not (out / "result.json").exists():
        said = json.loads(done.stdout)["error"]["message"]
        return Outcome(0, 0, float("nan"), float("nan"), seconds, str(said))
    result = json.loads((out / "result.json").read_text(encoding="utf-8"))
    observations, sigma = result["observations"], result["platform"]["sigma_dX_m"]
    rms = result["residuals"]["rms_px"]
    return Outcome(observations["used"], observations["total"], rms, sigma / leg, seconds)


def main() -> None:
    """Print a line for each size."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--full", action="store_true", help="photographs of 1024 x 768 pixels")
    parser.add_argument("--no-hints", action="store_true", help="no rough camera poses")
    parser.add_argument(
        "--dataset", type=Path, help="a dataset to scale in place of a rendered one"
    )
    parser.add_argument("--legs", type=float, nargs="+", default=LEGS, help="mean lengths [m]")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--keep", type=Path, help="folder for datasets and results")
    chosen = parser.parse_args()
    os.environ.setdefault("OMP_NUM_THREADS", "1")
    with TemporaryDirectory() as scratch:
        folder = chosen.keep or Path(scratch)
        folder.mkdir(parents=True, exist_ok=True)
        source = chosen.dataset
        if source is None:
            source = folder / "dataset"
            if not source.exists():
                photographed(folder, chosen.seed, full=chosen.full)
        machine = load_dataset(source).machine
        length = leg_scale(machine, machine.home)
        sizes = [length, *(leg for leg in chosen.legs if abs(leg / length - 1.0) > 0.2)]
        usual: Outcome | None = None
        print("   legs/m  used  of   rms/px  sigma/leg  time/s  not as asked")
        for leg in sizes:
            dataset = scaled_dataset(source, folder / f"legs-{leg:g}", leg / length)
            if chosen.no_hints:
                without_hints(dataset)
            outcome = calibrated(dataset, folder / f"legs-{leg:g}-result", leg)
            usual = usual or outcome
            print(
                f"{leg:9.3f} {outcome.used:5d} {outcome.total:4d} {outcome.rms_px:7.3f} "
                f"{outcome.sigma:10.2e} {outcome.seconds:7.1f}  {outcome.misses(usual)}",
                flush=True,
            )


if __name__ == "__main__":
    main()
