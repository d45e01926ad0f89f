"""Whether common mistakes are named: sessions of photographs, each with one mistake.

    OMP_NUM_THREADS=1 python benchmarks/mistakes.py [--models hexapod,3-rps,...] [--seeds 50]
        [--keep DIR] [--only KIND] [--workers 2] [--wrong-joints 10]

Each session is rendered once (45 photographs of a machine whose joints are 2 mm off, kept in DIR),
then one mistake is drawn and made in its readings, model or images. Printed is what is named, what
is named for it, how many images agree, and in the end how often the right kind was the first of the
diagnosis, with its 95 % interval (Wilson), and how often anything was named of sessions without a
mistake. Mistakes that leave the machine as it is (legs of a symmetric one relabelled) count as
right where the diagnosis names one that does the same.
"""

import argparse
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from legcal import ParameterErrors, SimulationSettings, Spread, load_dataset, simulate
from legcal.calibration.diagnosis.diagnosis import diagnose
from legcal.calibration.ordered_dataset import order_dataset
from legcal.data import Dataset
from legcal.geometry import Array
from legcal.machine import Leg, LegKind, Machine
from legcal.progress import no_progress
from legcal.simulation import Level
from legcal.workers import worker_pool

MODELS = ("hexapod", "3-rps", "3-upu", "tricept")
MIRROR = np.diag([1.0, -1.0, 1.0])
# kinds of diagnosis that name a mistake
RIGHT = {
    "exchanged": ("columns exchanged",),
    "reversed": ("columns reversed", "handedness", "images mirrored", "columns exchanged"),
    "rotated": ("columns rotated",),
    "direction": ("direction of an encoder",),
    "directions": ("direction of encoders",),
    "shifted": ("readings shifted",),
    "views": ("views exchanged",),
    "diameter": ("diameter for radius",),
    "handedness": ("handedness", "images mirrored", "columns reversed", "columns exchanged"),
    "platform joints": ("platform joints from another leg", "columns rotated"),
    "focal length": ("focal length",),
    "mirrored": ("images mirrored", "handedness", "columns reversed", "columns exchanged"),
}
Make = Callable[[Dataset, np.random.Generator], Dataset]


def _motors(machine: Machine) -> list[int]:
    return [j for j, leg in enumerate(machine.legs) if leg.kind is LegKind.ACTUATED]


def _with_columns(dataset: Dataset, order: list[int]) -> Dataset:
    """Return a session whose motors have the readings of others."""
    motors, q = _motors(dataset.machine), dataset.measurements.q.copy()
    q[:, motors] = dataset.measurements.q[:, [motors[k] for k in order]]
    return replace(dataset, measurements=replace(dataset.measurements, q=q))


def _with_legs(dataset: Dataset, legs: list[Leg]) -> Dataset:
    return replace(dataset, machine=replace(dataset.machine, legs=tuple(legs)))


def exchanged(dataset: Dataset, rng: np.random.Generator) -> Dataset:
    """Exchange two columns."""
    order = list(range(len(_motors(dataset.machine))))
    i, k = rng.choice(len(order), 2, replace=False).tolist()
    order[i], order[k] = order[k], order[i]
    return _with_columns(dataset, order)


def reversed_columns(dataset: Dataset, rng: np.random.Generator) -> Dataset:
    """Reverse the columns."""
    return _with_columns(dataset, list(range(len(_motors(dataset.machine))))[::-1])


def rotated(dataset: Dataset, rng: np.random.Generator) -> Dataset:
    """Begin with another column."""
    n = len(_motors(dataset.machine))
    k = int(rng.integers(1, n))
    return _with_columns(dataset, [(j + k) % n for j in range(n)])


def _turned(dataset: Dataset, which: list[int]) -> Dataset:
    q = dataset.measurements.q.copy()
    for j in which:
        low, high = dataset.machine.legs[j].travel
        q[:, j] = low + high - q[:, j]
    return replace(dataset, measurements=replace(dataset.measurements, q=q))


def direction(dataset: Dataset, rng: np.random.Generator) -> Dataset:
    """Count one encoder from the other end of its travel."""
    return _turned(dataset, [int(rng.choice(_motors(dataset.machine)))])


def directions(dataset: Dataset, rng: np.random.Generator) -> Dataset:
    """Count all encoders from the other end."""
    return _turned(dataset, _motors(dataset.machine))


def shifted(dataset: Dataset, rng: np.random.Generator) -> Dataset:
    """Shift the readings by a row within each view."""
    m = dataset.measurements
    q, step = m.q.copy(), int(rng.choice([-1, 1]))
    for v in range(len(m.views)):
        rows = np.flatnonzero(m.view == v)
        q[rows] = m.q[np.roll(rows, step)]
    return replace(dataset, measurements=replace(m, q=q))


def views(dataset: Dataset, rng: np.random.Generator) -> Dataset:
    """Exchange the readings of two views."""
    m = dataset.measurements
    a, b = rng.choice(len(m.views), 2, replace=False).tolist()
    one, other = np.flatnonzero(m.view == a), np.flatnonzero(m.view == b)
    q = m.q.copy()
    q[one], q[other] = m.q[other], m.q[one]
    return replace(dataset, measurements=replace(m, q=q))


def diameter(dataset: Dataset, rng: np.random.Generator) -> Dataset:
    """Double all radii."""
    legs = dataset.machine.legs
    cylinders = [[replace(c, radius=2.0 * c.radius) for c in leg.cylinders] for leg in legs]
    return replace(dataset, machine=dataset.machine.with_cylinders(cylinders))


def handedness(dataset: Dataset, rng: np.random.Generator) -> Dataset:
    """Reverse y of all joints and axes."""

    def turned(axis: Array | None) -> Array | None:
        return None if axis is None else MIRROR @ axis

    return _with_legs(
        dataset,
        [
            replace(
                leg,
                A=MIRROR @ leg.A,
                B=MIRROR @ leg.B,
                base_axis=turned(leg.base_axis),
                platform_axis=turned(leg.platform_axis),
            )
            for leg in dataset.machine.legs
        ],
    )


def platform_joints(dataset: Dataset, rng: np.random.Generator) -> Dataset:
    """List the platform joints from another leg on."""
    legs = dataset.machine.legs
    k = int(rng.integers(1, len(legs)))
    return _with_legs(
        dataset,
        [replace(leg, B=legs[(j + k) % len(legs)].B) for j, leg in enumerate(legs)],
    )


def focal_length(dataset: Dataset, rng: np.random.Generator) -> Dataset:
    """State another focal length: images of half or twice the size."""
    factor = float(rng.choice([0.5, 2.0]))
    K = np.array([[factor, 1.0, 1.0], [1.0, factor, 1.0], [1.0, 1.0, 1.0]])
    m = dataset.measurements
    changed = {id(v.camera): replace(v.camera, K=v.camera.K * K) for v in m.views}
    of_views = tuple(replace(v, camera=changed[id(v.camera)]) for v in m.views)
    return replace(dataset, measurements=replace(m, views=of_views))


MISTAKES: dict[str, Make] = {
    "exchanged": exchanged,
    "reversed": reversed_columns,
    "rotated": rotated,
    "direction": direction,
    "directions": directions,
    "shifted": shifted,
    "views": views,
    "diameter": diameter,
    "handedness": handedness,
    "platform joints": platform_joints,
    "focal length": focal_length,
}


def wilson(k: int, n: int) -> tuple[float, float]:
    """Return the 95 % interval of a share of k in n."""
    z, p = 1.96, k / n
    middle, half = p + z * z / (2 * n), z * np.sqrt(p * (1 - p) / n + z * z / (4 * n * n))
    return tuple(float(x / (1 + z * z / n)) for x in (middle - half, middle + half))  # type: ignore[return-value]


def session(model: str, seed: int, joints: float, keep: Path) -> Dataset:
    """Return a rendered session, made once."""
    folder = keep / f"{model}-{seed}-{1e3 * joints:g}"
    if not (folder / "dataset.yaml").exists():
        spread = Spread(joints)
        settings = SimulationSettings(
            level=Level.PHOTOGRAPHS,
            seed=seed,
            errors=ParameterErrors(base_joints=spread, platform_joints=spread, offsets=spread),
        )
        simulate(model, folder, settings)
    return load_dataset(folder)


def named(dataset: Dataset, workers: int) -> tuple[tuple[str, ...], str, float]:
    """Return the kinds of the diagnosis, its sentence, and how long it took [s]."""
    start = time.monotonic()
    with worker_pool(workers) as pool:
        found = diagnose(order_dataset(dataset, pool, no_progress))
    spent = time.monotonic() - start
    return tuple(d.kind for d in found), found[0].sentence if found else "nothing", spent


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--models", default=",".join(MODELS))
    parser.add_argument("--seeds", type=int, default=50)
    parser.add_argument("--keep", type=Path, help="keep the photographs in this folder")
    parser.add_argument("--only", choices=MISTAKES)
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--wrong-joints", type=float, default=2.0, help="of the true machine [mm]")
    args = parser.parse_args()
    rng = np.random.default_rng(2002)
    right = total = accused = clean = 0
    with TemporaryDirectory() as temporary:
        keep = args.keep or Path(temporary)
        for number in range(args.seeds):
            for model in args.models.split(","):
                dataset = session(model, number, 1e-3 * args.wrong_joints, keep)
                alike = len({leg.type for leg in dataset.machine.legs}) == 1
                every = [name for name in MISTAKES if alike or name != "platform joints"]
                kinds = [args.only] if args.only else every
                kind = kinds[int(rng.integers(len(kinds)))]
                found, sentence, spent = named(dataset, args.workers)
                clean, accused = clean + 1, accused + bool(found)
                if found:
                    print(f"{model:8} {number:3} without a mistake: {sentence}", flush=True)
                found, sentence, spent = named(MISTAKES[kind](dataset, rng), args.workers)
                is_right = bool(found) and found[0] in RIGHT[kind]
                right, total = right + is_right, total + 1
                print(
                    f"{model:8} {number:3} {kind:16} {'right' if is_right else 'WRONG'} "
                    f"{spent:5.1f} s  {sentence}",
                    flush=True,
                )
    low, high = wilson(right, total)
    print(f"right: {right} of {total} ({low:.2f} to {high:.2f}); "
          f"without a mistake: something named of {accused} of {clean}")  # fmt: skip


if __name__ == "__main__":
    main()
