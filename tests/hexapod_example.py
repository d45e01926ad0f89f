"""The example hexapod: its files, a copy to spoil, one run of the whole path."""

import shutil
from dataclasses import dataclass
from pathlib import Path

from legcal.calibration.verdict import Calibration

ROOT = Path(__file__).parents[1]
HEXAPOD = ROOT / "examples" / "hexapod"
TRUTH = ROOT / "tests" / "data" / "hexapod-truth" / "models" / "hexapod.yaml"


def copy_of_the_example(destination: Path) -> Path:
    """Copy the example without what an earlier run left beside it."""
    left = shutil.ignore_patterns("observations.csv", ".legcal-cache.json")
    return Path(shutil.copytree(HEXAPOD, destination, ignore=left))


@dataclass(frozen=True)
class Run:
    """One calibration of the example hexapod from its photographs."""

    folder: Path
    output: Path
    calibration: Calibration
    stages: tuple[str, ...]
