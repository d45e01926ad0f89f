"""Small studies for the tests of the runner, and a program that runs one of them."""

import os
import signal
import sys
import time
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from legcal.errors import DidNotConverge
from legcal.signals import stopped_by_signals
from legcal.simulation.study import Record, run_study


@dataclass(frozen=True)
class Total:
    """The sum of what the runs drew."""

    total: float
    n: int

    def document(self) -> dict[str, Any]:
        return {"total": self.total, "n": self.n}

    def files(self) -> dict[str, bytes]:
        return {"total.txt": str(self.total).encode()}


@dataclass(frozen=True)
class Draws:
    """Every run draws a number; some runs fail, and runs may take their time."""

    name: str = "draws"
    scale: float = 1.0
    fails_above: float = np.inf
    seconds: float = 0.0

    @property
    def settings(self) -> dict[str, Any]:
        above = self.fails_above
        return {"scale": self.scale, "fails": {"above": above if np.isfinite(above) else None}}

    def one_run(self, seed: np.random.SeedSequence) -> Record:
        rng = np.random.default_rng(seed)
        time.sleep(self.seconds * rng.random())
        x = self.scale * float(rng.normal())
        if x > self.fails_above:
            raise DidNotConverge(f"The draw is {x}.")
        return {"x": x}

    def summary(self, records: Iterable[Record]) -> Total:
        total, n = 0.0, 0
        for record in records:
            total, n = total + record["x"], n + 1
        return Total(total, n)


@dataclass(frozen=True)
class Mistaken(Draws):
    """A study with a programming mistake."""

    def one_run(self, seed: np.random.SeedSequence) -> Record:
        return {"x": 1 // 0}


@dataclass(frozen=True)
class Deadly(Draws):
    """A study that ends the process it runs in, as a system short of memory does."""

    def one_run(self, seed: np.random.SeedSequence) -> Record:
        os.kill(os.getpid(), signal.SIGKILL)
        return {}


if __name__ == "__main__":
    signal.signal(signal.SIGINT, signal.default_int_handler)  # tests may run with it ignored
    with stopped_by_signals():
        run_study(Draws(seconds=0.05), 400, workers=2, output=Path(sys.argv[1]))
