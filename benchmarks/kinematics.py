"""How long kinematics take for every shipped model: medians, in one process.

    python benchmarks/kinematics.py [ROWS]

A path goes through random readings inside the travel, in steps of a hundredth of the travel.
"follow" is a step of a Follower along it, "warm" forward kinematics from the pose of the step
before, "cold" forward kinematics at a random reading from home, "inverse" inverse kinematics,
"measure" the singularity measure, and "draw" one random closed configuration.
"""

import statistics
import sys
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path

import numpy as np

from legcal.geometry.types import Array
from legcal.machine.closing import singularity
from legcal.machine.configurations import random_configurations
from legcal.machine.kinematics import Follower, forward_kinematics, inverse_kinematics
from legcal.machine.loader import load_mechanism
from legcal.machine.model import Machine

MODELS = Path(__file__).parents[1] / "models"
STEP = 0.01  # of the travel


def path_of(machine: Machine, corners: Array, rows: int) -> Array:
    """Return readings from home towards random ones and back, in even steps, (rows, n_legs)."""
    home = inverse_kinematics(machine, machine.home)
    travel = np.array([upper - lower for lower, upper in (leg.travel for leg in machine.legs)])
    path: list[Array] = []
    for corner in corners:
        motors = list(machine.motors)
        share = np.abs((corner - home)[motors] / travel[motors]).max()
        way = np.linspace(0.0, 1.0, max(int(share / STEP), 2))
        out = home + way[:, None] * (corner - home)
        path += [*out, *out[::-1]]
    return np.array(path)[:rows]


def medians(actions: dict[str, list[Callable[[], object]]]) -> str:
    """Return the median time of each kind of action [ms]."""
    columns = []
    for calls in actions.values():
        seconds = []
        for call in calls:
            begin = time.perf_counter()
            call()
            seconds.append(time.perf_counter() - begin)
        columns.append(f"{1e3 * statistics.median(seconds):9.3f}")
    return "".join(columns)


def measure(machine: Machine, rows: int) -> str:
    """Return the times of a mechanism as a line of the table."""
    drawn = random_configurations(machine, max(rows // 10, 5), 1)
    path = path_of(machine, drawn.readings, rows)
    follower, walker = Follower(machine), Follower(machine)
    before = [machine.home, *(walker.move_to(q) for q in path[:-1])]

    return medians(
        {
            "follow": [partial(follower.move_to, q) for q in path],
            "warm": [
                partial(forward_kinematics, machine, q, start=T)
                for q, T in zip(path, before, strict=True)
            ],
            "cold": [partial(forward_kinematics, machine, q) for q in drawn.readings],
            "inverse": [partial(inverse_kinematics, machine, T) for T in drawn.poses],
            "measure": [partial(singularity, machine, T) for T in drawn.poses],
            "draw": [partial(random_configurations, machine, 1, i) for i in range(20)],
        }
    )


def main(rows: int = 300) -> None:
    """Print a line a model."""
    print("[ms]            " + "".join(f"{w:>9}" for w in ("follow", "warm", "cold")), end="")
    print("".join(f"{w:>9}" for w in ("inverse", "measure", "draw")))
    for path in sorted(MODELS.glob("*.yaml")):
        machine = load_mechanism(path)
        print(f"{path.stem:16}{measure(machine, rows)}")


if __name__ == "__main__":
    main(*map(int, sys.argv[1:]))
