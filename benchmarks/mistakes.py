"""Whether common mistakes are named: sessions of photographs, each with one mistake.

    OMP_NUM_THREADS=1 python benchmarks/mistakes.py --keep DIR --record FILE
        [--models hexapod,3-rps,...] [--seeds 50] [--first-seed 0] [--each 1] [--minutes 7]
        [--only KIND] [--workers 1]

A session is 45 photographs of a machine whose joints are 2 mm off, rendered once; their edge pairs
are kept in DIR as well. Every other one has no rough camera poses. In each session so many mistakes
(--each) are made one after the other, in its readings, its model or its images, dealt so that all
kinds come about equally often; and nothing is done to it once, and once its model gets joints that
are 10 mm off. What is named is written to FILE (JSON lines), and what FILE has is not done again,
so that a run can be continued (--minutes ends it early). Printed is what FILE has in the end: how
often the right kind was the first of the diagnosis, with its 95 % interval (Wilson), and how often
anything was named of sessions without a mistake; and how long it took, also in processor time (of
this process: all of it with one worker). The example that comes with legcal is one more model
(--models example), with its rough camera poses (seed 0) and without (seed 1).

Right is the kind of mistake that was made, or one whose undoing gives the same machine: legs at the
same places in all images, whatever their names and wherever the camera stands. That is computed
for each diagnosis from the nominal model and the readings (a mirror-symmetric hexapod with reversed
columns is one whose images are mirrored). Where what was done leaves the machine the same, as with
columns of a threefold symmetric one that are moved on, nothing should be named.
"""

import argparse
import json
import pickle
import time
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, replace
from itertools import permutations
from pathlib import Path

import numpy as np

from legcal import ParameterErrors, SimulationSettings, Spread, load_dataset, simulate
from legcal.calibration.mistake_search import diagnose
from legcal.calibration.mistakes import Assumed, as_given, mistakes
from legcal.calibration.ordered_dataset import OrderedDataset, order_dataset
from legcal.data.dataset import Dataset
from legcal.geometry.types import Array
from legcal.machine.leg import Leg, LegKind
from legcal.machine.model import Machine
from legcal.perception.agreement import as_if
from legcal.perception.camera_search import LEFT_RIGHT, UPSIDE_DOWN
from legcal.perception.candidate_pairs import CandidatePairs
from legcal.perception.placement import Placement, sensor_extent
from legcal.progress import no_progress
from legcal.simulation.settings import Level
from legcal.workers import Run, worker_pool

MODELS = ("hexapod", "3-rps", "3-upu", "tricept")
EXAMPLE, EXAMPLE_FOLDER = "example", Path(__file__).parents[1] / "examples/hexapod"
JOINTS, WRONG_JOINTS = 2e-3, 10e-3  # standard deviation of joint centres of the model [m]
SAME = 0.01  # of the size of the machine: legs at the same places
WRONG_RADIUS = 0.05  # relative
ZERO = 0.1, 0.25  # least and greatest error of an encoder's zero, in its travel
MIRROR = np.diag([1.0, -1.0, 1.0])
CLEAN, OFF = "no mistake", "joints 10 mm off"


@dataclass(frozen=True)
class Session:
    """A session with the edge pairs of its images, by image."""

    dataset: Dataset
    pairs: dict[str, CandidatePairs]
    flip: tuple[int, ...] = ()  # views whose images are mirrored
    turned: tuple[str, ...] = ()  # images that are upside down
    focal: float = 1.0  # the right focal length as a part of the stated one

    def true(self, data: OrderedDataset) -> Assumed:
        """Return what is true of the session, by the data of one without the mistake."""
        given = as_given(data)
        given.flip[np.isin(data.measurements.view, self.flip)] = LEFT_RIGHT
        given.flip[np.isin(data.measurements.image, self.turned)] = UPSIDE_DOWN
        return replace(given, focal=self.focal)


Make = Callable[[Session, np.random.Generator], Session]


def _motors(machine: Machine) -> list[int]:
    return [j for j, leg in enumerate(machine.legs) if leg.kind is LegKind.ACTUATED]


def _with_readings(session: Session, q: Array) -> Session:
    dataset = session.dataset
    measurements = replace(dataset.measurements, q=q)
    return replace(session, dataset=replace(dataset, measurements=measurements))


def _with_machine(session: Session, machine: Machine) -> Session:
    return replace(session, dataset=replace(session.dataset, machine=machine))


def _with_legs(session: Session, legs: list[Leg]) -> Session:
    return _with_machine(session, replace(session.dataset.machine, legs=tuple(legs)))


def _with_columns(session: Session, order: list[int]) -> Session:
    """Return a session whose motors have the readings of others."""
    motors, own = _motors(session.dataset.machine), session.dataset.measurements.q
    q = own.copy()
    q[:, motors] = own[:, [motors[k] for k in order]]
    return _with_readings(session, q)


def exchanged(session: Session, rng: np.random.Generator) -> Session:
    """Exchange two columns."""
    order = list(range(len(_motors(session.dataset.machine))))
    i, k = rng.choice(len(order), 2, replace=False).tolist()
    order[i], order[k] = order[k], order[i]
    return _with_columns(session, order)


def reversed_columns(session: Session, _: np.random.Generator) -> Session:
    """Reverse the columns."""
    return _with_columns(session, list(range(len(_motors(session.dataset.machine))))[::-1])


def rotated(session: Session, rng: np.random.Generator) -> Session:
    """Begin with another column."""
    n = len(_motors(session.dataset.machine))
    k = int(rng.integers(1, n))
    return _with_columns(session, [(j + k) % n for j in range(n)])


def _renumbered(session: Session, k: int, ends: tuple[str, str]) -> Session:
    """Give legs a joint of others of the model."""
    machine = session.dataset.machine
    legs, motors = list(machine.legs), _motors(machine)
    for i, j in enumerate(motors):
        other = machine.legs[motors[(i + k) % len(motors)]]
        legs[j] = replace(legs[j], **{name: getattr(other, name) for name in ends})
    return _with_legs(session, legs)


def renumbered(session: Session, rng: np.random.Generator) -> Session:
    """Number the platform joints of the model from another one on."""
    k = int(rng.integers(1, len(_motors(session.dataset.machine))))
    return _renumbered(session, k, ("B", "platform_axis"))


def base_renumbered(session: Session, rng: np.random.Generator) -> Session:
    """Number the base joints of the model from another one on."""
    k = int(rng.integers(1, len(_motors(session.dataset.machine))))
    return _renumbered(session, k, ("A", "base_axis"))


def _turned(session: Session, which: list[int]) -> Session:
    q = session.dataset.measurements.q.copy()
    for j in which:
        low, high = session.dataset.machine.legs[j].travel
        q[:, j] = low + high - q[:, j]
    return _with_readings(session, q)


def direction(session: Session, rng: np.random.Generator) -> Session:
    """Count one encoder from the other end of its travel."""
    return _turned(session, [int(rng.choice(_motors(session.dataset.machine)))])


def directions(session: Session, _: np.random.Generator) -> Session:
    """Count all encoders from the other end."""
    return _turned(session, _motors(session.dataset.machine))


def zero(session: Session, rng: np.random.Generator) -> Session:
    """Move the zero of one encoder by a tenth to a quarter of its travel, which is stated wider."""
    machine, q = session.dataset.machine, session.dataset.measurements.q.copy()
    j = int(rng.choice(_motors(machine)))
    low, high = machine.legs[j].travel
    size = float(rng.uniform(*ZERO)) * (high - low)
    q[:, j] += float(rng.choice([-1.0, 1.0])) * size
    legs = [replace(leg, travel=(low - size, high + size)) if k == j else leg
            for k, leg in enumerate(machine.legs)]  # fmt: skip
    return _with_readings(_with_legs(session, legs), q)


def _rolled(session: Session, views: list[int], step: int) -> Session:
    m = session.dataset.measurements
    q = m.q.copy()
    for v in views:
        rows = np.flatnonzero(m.view == v)
        q[rows] = m.q[np.roll(rows, step)]
    return _with_readings(session, q)


def shifted(session: Session, rng: np.random.Generator) -> Session:
    """Shift the readings by a row within each view."""
    n = len(session.dataset.measurements.views)
    return _rolled(session, list(range(n)), int(rng.choice([-1, 1])))


def shifted_view(session: Session, rng: np.random.Generator) -> Session:
    """Shift the readings of one view by a row."""
    n = len(session.dataset.measurements.views)
    return _rolled(session, [int(rng.integers(n))], int(rng.choice([-1, 1])))


def dropped(session: Session, rng: np.random.Generator) -> Session:
    """Shift the readings of one view by a row from one of its rows on."""
    m = session.dataset.measurements
    rows = np.flatnonzero(m.view == int(rng.integers(len(m.views))))
    first = int(rng.integers(len(rows) // 4, len(rows) // 2))
    q = m.q.copy()
    q[rows[first:]] = m.q[np.roll(rows[first:], int(rng.choice([-1, 1])))]
    return _with_readings(session, q)


def _with_radii(session: Session, radius: Callable[[float], float]) -> Session:
    machine = session.dataset.machine.with_radii(lambda _, c: radius(c.radius))
    return _with_machine(session, machine)


def diameter(session: Session, _: np.random.Generator) -> Session:
    """Double all radii."""
    return _with_radii(session, lambda radius: 2.0 * radius)


def handedness(session: Session, _: np.random.Generator) -> Session:
    """Reverse y of all joints and axes."""

    def turned(axis: Array | None) -> Array | None:
        return None if axis is None else MIRROR @ axis

    return _with_legs(
        session,
        [
            replace(
                leg,
                A=MIRROR @ leg.A,
                B=MIRROR @ leg.B,
                base_axis=turned(leg.base_axis),
                platform_axis=turned(leg.platform_axis),
            )
            for leg in session.dataset.machine.legs
        ],
    )


def focal_length(session: Session, rng: np.random.Generator) -> Session:
    """State another focal length: images of half or twice the size, or cropped."""
    factor = float(rng.choice([0.5, 0.8, 1.25, 2.0]))
    K = np.array([[factor, 1.0, 1.0], [1.0, factor, 1.0], [1.0, 1.0, 1.0]])
    m = session.dataset.measurements
    changed = {id(v.camera): replace(v.camera, K=v.camera.K * K) for v in m.views}
    of_views = tuple(replace(v, camera=changed[id(v.camera)]) for v in m.views)
    dataset = replace(session.dataset, measurements=replace(m, views=of_views))
    pairs = {image: as_if(one, np.zeros((2, 2)), np.ones(2), factor)
             for image, one in session.pairs.items()}  # fmt: skip
    return Session(dataset, pairs, focal=1.0 / factor)


def _mirrored(session: Session, which: list[int]) -> Session:
    m, pairs = session.dataset.measurements, dict(session.pairs)
    for image, v in zip(m.image, m.view.tolist(), strict=True):
        if v in which:
            corners = sensor_extent(m.views[v].camera)
            pairs[image] = as_if(pairs[image], corners, LEFT_RIGHT, 1.0)
    return replace(session, pairs=pairs, flip=tuple(which))


def mirrored(session: Session, _: np.random.Generator) -> Session:
    """Mirror all images."""
    return _mirrored(session, list(range(len(session.dataset.measurements.views))))


def mirrored_view(session: Session, rng: np.random.Generator) -> Session:
    """Mirror the images of one view."""
    return _mirrored(session, [int(rng.integers(len(session.dataset.measurements.views)))])


def turned(session: Session, rng: np.random.Generator) -> Session:
    """Turn a third of the images of one view upside down."""
    m, pairs = session.dataset.measurements, dict(session.pairs)
    rows = np.flatnonzero(m.view == int(rng.integers(len(m.views))))
    images = [m.image[row] for row in rng.choice(rows, len(rows) // 3, replace=False).tolist()]
    corners = sensor_extent(m.views[m.view[rows[0]]].camera)
    pairs |= {image: as_if(pairs[image], corners, UPSIDE_DOWN, 1.0) for image in images}
    return replace(session, pairs=pairs, turned=tuple(images))


MISTAKES: dict[str, tuple[Make, str]] = {  # with the kinds of diagnosis that are right
    "exchanged": (exchanged, "columns exchanged"),
    "reversed": (reversed_columns, "columns reversed"),
    "rotated": (rotated, "columns rotated"),
    "renumbered": (renumbered, "platform joints renumbered"),
    "base renumbered": (base_renumbered, "base joints renumbered"),
    "direction": (direction, "direction of an encoder"),
    "directions": (directions, "direction of encoders"),
    "zero": (zero, "zero of an encoder"),
    "shifted": (shifted, "readings shifted"),
    "shifted view": (shifted_view, "readings shifted"),
    "dropped": (dropped, "readings shifted"),
    "diameter": (diameter, "diameter for radius"),
    "handedness": (handedness, "handedness"),
    "focal length": (focal_length, "focal length"),
    "mirrored": (mirrored, "images mirrored"),
    "mirrored view": (mirrored_view, "images mirrored"),
    "turned": (turned, "images upside down"),
}


def joints_off(session: Session, rng: np.random.Generator) -> Session:
    """Move all joints of the model."""
    size = np.sqrt(WRONG_JOINTS**2 - JOINTS**2)
    legs = session.dataset.machine.legs
    moves = rng.normal(scale=size, size=(len(legs), 2, 3))
    both = zip(legs, moves, strict=True)
    return _with_legs(session, [replace(leg, A=leg.A + a, B=leg.B + b) for leg, (a, b) in both])


def is_same(mended: Assumed, true: Assumed) -> bool:
    """Say whether two assumptions show the same legs in all images, by whatever names."""
    rows = list(range(len(true.q)))
    (A, B), (A_true, B_true) = mended.joints(rows), true.joints(rows)
    turned = np.any(mended.flip != true.flip, axis=1)
    if not (turned.all() or not turned.any()) or mended.focal != true.focal:
        return False
    n = true.machine.n_legs
    radii, radii_true = (
        [[c.radius for c in leg.cylinders] for leg in one.machine.legs] for one in (mended, true)
    )
    if not (np.isfinite(B).all() and np.isfinite(B_true).all()):
        return False
    own = np.concatenate([A, B]).reshape(2, len(rows), n, 3)
    own = own @ MIRROR if turned.all() else own
    wanted = np.concatenate([A_true, B_true]).reshape(2, len(rows), n, 3)
    size = float(np.std(wanted.reshape(-1, 3), axis=0).max())
    for order in permutations(range(n)):
        if not all(
            len(radii[i]) == len(radii_true[j])
            and np.allclose(radii[i], radii_true[j], rtol=WRONG_RADIUS)
            for j, i in enumerate(order)
        ):
            continue
        x, y = own[:, :, list(order)].reshape(-1, 3), wanted.reshape(-1, 3)
        x, y = x - x.mean(axis=0), y - y.mean(axis=0)
        U, s, Vt = np.linalg.svd(x.T @ y)
        s[2] *= np.sign(np.linalg.det(U @ Vt))
        if np.sum(x**2) + np.sum(y**2) - 2.0 * s.sum() <= len(x) * (SAME * size) ** 2:
            return True
    return False


def wilson(k: int, n: int) -> tuple[float, float]:
    """Return the 95 % interval of a share of k in n."""
    z, p = 1.96, k / n
    middle, half = p + z * z / (2 * n), z * np.sqrt(p * (1 - p) / n + z * z / (4 * n * n))
    return float((middle - half) / (1 + z * z / n)), float((middle + half) / (1 + z * z / n))


def session(model: str, seed: int, keep: Path, pool: Run) -> Session:
    """Return a session with its edge pairs, rendered and searched once."""
    folder = keep / f"{model}-{seed}-{1e3 * JOINTS:g}"
    kept = folder / "pairs.pickle"
    if model == EXAMPLE:
        folder, kept = EXAMPLE_FOLDER, keep / f"{EXAMPLE}.pickle"
    if not (folder / "dataset.yaml").exists():
        spread = Spread(JOINTS)
        settings = SimulationSettings(
            level=Level.PHOTOGRAPHS,
            seed=seed,
            errors=ParameterErrors(base_joints=spread, platform_joints=spread, offsets=spread),
        )
        simulate(model, folder, settings)
    dataset = load_dataset(folder)
    if not kept.exists():
        data = order_dataset(dataset, pool, no_progress)
        n, m = data.measurements.n_rows, data.measurements
        nowhere = np.full((n, data.machine.n_legs, 3), np.nan)
        search = data.photographs.search(Placement(nowhere, nowhere, (None,) * len(m.views)))
        found = dict(zip(range(n), pool(search.pairs, range(n)), strict=True))
        kept.write_bytes(pickle.dumps({m.image[row]: one for row, one in found.items()}))
    if seed % 2:
        m = dataset.measurements
        views = tuple(replace(view, T_base_camera=None) for view in m.views)
        dataset = replace(dataset, measurements=replace(m, views=views))
    return Session(dataset, pickle.loads(kept.read_bytes()))


def ordered(session: Session, pool: Run) -> OrderedDataset:
    """Return a session as it is diagnosed, with edge pairs."""
    data = order_dataset(session.dataset, pool, no_progress)
    pairs = {row: session.pairs[image] for row, image in enumerate(data.measurements.image)}
    return replace(data, edge_pairs=pairs)


def judged(kind: str, spoiled: Session, true: Session, pool: Run) -> dict[str, object]:
    """Return what is named of a session, and whether that is right."""
    data = ordered(spoiled, pool)
    start, processor = time.monotonic(), time.process_time()
    found = diagnose(data)
    entry: dict[str, object] = {
        "seconds": round(time.monotonic() - start, 1),
        "processor": round(time.process_time() - processor, 1),
    }
    reference = ordered(true, pool)
    place = {image: row for row, image in enumerate(data.measurements.image)}
    rows = [place[image] for image in reference.measurements.image]  # canonical orders may differ
    truth = spoiled.true(reference)

    def is_true(one: Assumed) -> bool:
        return is_same(replace(one, q=one.q[rows]), truth)

    is_mistake = kind not in (CLEAN, OFF) and not is_true(as_given(data))
    if not found:
        return entry | {"right": not is_mistake, "named": None}
    first = found[0]
    entry |= {"named": first.kind, "sentence": first.sentence}
    if not is_mistake:
        return entry | {"right": False}
    is_kind = first.kind == MISTAKES[kind][1]
    mended = [one.true for one in mistakes(data) if one.what == first.what]
    return entry | {"right": is_kind or any(is_true(one) for one in mended), "kind": is_kind}


def deal(each: int, counts: Counter[str], rng: np.random.Generator) -> list[str]:
    """Return the kinds of mistakes that are made in a session: the rarest so far."""
    kinds = list(MISTAKES)
    rng.shuffle(kinds)
    chosen = sorted(kinds, key=lambda kind: counts[kind])[:each]
    counts.update(chosen)
    return chosen


def report(entries: list[dict[str, object]]) -> None:
    """Print what was named, by kinds of mistakes."""

    def share(right: int, n: int) -> str:
        low, high = wilson(right, n)
        return f"{right:3} of {n:3} ({low:.2f} to {high:.2f})"

    for kind in (*MISTAKES, CLEAN, OFF):
        own = [one for one in entries if one["mistake"] == kind]
        if own:
            right = sum(bool(one["right"]) for one in own)
            wrong = Counter(str(one["named"]) for one in own if not one["right"])
            others = ", ".join(f"{name} {n}" for name, n in wrong.most_common())
            print(f"{kind:17} {share(right, len(own))}  {others}")
    made = [one for one in entries if one["mistake"] in MISTAKES]
    clean = [one for one in entries if one["mistake"] not in MISTAKES]
    of_all = ("right", made), ("nothing without a mistake", clean)
    for what, own in of_all:
        if own:
            print(f"{what}: {share(sum(bool(one['right']) for one in own), len(own))}")
    for what in ("seconds", "processor"):
        own_seconds = [float(str(one[what])) for one in entries if what in one]
        if own_seconds:
            print(f"{what} [s]: median {np.median(own_seconds):.1f}, most {max(own_seconds):.1f}")


def main() -> None:
    """Make mistakes, diagnose them and print the table."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--models", default=",".join(MODELS))
    parser.add_argument("--seeds", type=int, default=50)
    parser.add_argument("--first-seed", type=int, default=0)
    parser.add_argument("--each", type=int, default=1, help="mistakes in each session")
    parser.add_argument("--keep", type=Path, required=True, help="folder of the photographs")
    parser.add_argument("--record", type=Path, required=True, help="JSON lines of what was named")
    parser.add_argument("--minutes", type=float, default=np.inf, help="stop after so long")
    parser.add_argument("--only", choices=MISTAKES)
    parser.add_argument("--workers", type=int, default=1)
    args = parser.parse_args()
    entries = [json.loads(line) for line in args.record.read_text().splitlines()
               ] if args.record.exists() else []  # fmt: skip
    done = {(one["model"], one["seed"], one["mistake"]) for one in entries}
    stop, counts = time.monotonic() + 60.0 * args.minutes, Counter[str]()
    with worker_pool(args.workers) as pool, args.record.open("a") as record:
        for seed in range(args.first_seed, args.first_seed + args.seeds):
            for model in args.models.split(","):
                true = None
                for kind in (None, CLEAN, OFF):
                    of_session = [2002, seed, [*MODELS, EXAMPLE].index(model)]
                    if kind is None:
                        if true is None:
                            true = session(model, seed, args.keep, pool)
                        rng = np.random.default_rng(of_session)
                        kinds = deal(args.each, counts, rng)
                        kinds = [args.only] if args.only else kinds
                    else:
                        kinds = [] if args.only else [kind]
                    for one in kinds:
                        if (model, seed, one) in done or true is None:
                            continue
                        if time.monotonic() > stop:
                            report(entries)
                            return
                        spoiled = true
                        # Its own, so that a run that is continued makes the same mistakes.
                        place = [*MISTAKES, CLEAN, OFF].index(one)
                        rng = np.random.default_rng([*of_session, place])
                        if one in MISTAKES:
                            spoiled = MISTAKES[one][0](true, rng)
                        elif one == OFF:
                            spoiled = joints_off(true, rng)
                        entry = {"model": model, "seed": seed, "mistake": one}
                        entry |= judged(one, spoiled, true, pool)
                        entries.append(entry)
                        record.write(json.dumps(entry) + "\n")
                        record.flush()
                        print(
                            f"{model:8} {seed:4} {one:17} "
                            f"{'right' if entry['right'] else 'WRONG'} {entry['seconds']:5.1f} s  "
                            f"{entry.get('sentence', 'nothing')}",
                            flush=True,
                        )
    report(entries)


if __name__ == "__main__":
    main()
