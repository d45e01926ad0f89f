"""Small studies for the tests of the runner."""

import os
import signal
import time
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from legcal.errors import DidNotConverge
from legcal.simulation.paper import Record, Summary


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

    def summary(self, records: Sequence[Record], heading: dict[str, Any]) -> Summary:
        total = sum(record["x"] for record in records)
        document = {"total": total, "n": len(records), **heading}
        return document, {"total.txt": str(total).encode()}


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
