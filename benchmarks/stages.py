"""What the four steps give on simulated machines, default and literal, printed as measured.

    python benchmarks/stages.py [--draws 5] [--only times|errors]
    python benchmarks/stages.py --photographs 3-rps tricept [--seed 0]

Every row is the mean over draws of noise of the platform error of eq (20) over ten extreme poses:
the nominal model is 3 mm wrong in every parameter; three cameras see all legs in 15 poses each. A
criterion that fails on a draw is counted, not hidden. ``legcal study paper`` has the sessions of
section 4.3. Times are medians of a few runs of the default steps on 45 and on 450 images.

With ``--photographs`` the machines are calibrated from 45 rendered photographs each, 15 poses
before three cameras, as ``legcal simulate`` draws them by default; all models that come of that are
compared with the truth at these poses, as ``legcal evaluate OUT/staged.yaml TRUTH --dataset`` does;
poses that a model does not reach are left out and counted.
"""

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path
from resource import RUSAGE_SELF, getrusage
from tempfile import TemporaryDirectory
from time import perf_counter

import numpy as np

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))

from fit_sessions import machine_session
from outline_sessions import COPLANAR, NONCOPLANAR, true_machine
from scipy.spatial.transform import RigidTransform

from legcal import calibrate, evaluate
from legcal.errors import DidNotConverge, LegcalError
from legcal.machine.kinematics import platforms_in_base
from legcal.machine.leg import Leg
from legcal.paper.criteria import Criteria
from legcal.paper.four_steps import run_steps
from legcal.simulation.dataset import SimulatedDataset, simulate
from legcal.simulation.paper import platform_errors
from legcal.simulation.session import draw_poses
from legcal.simulation.settings import SimulationSettings

NOISES = (0.003, 0.3, 1.0, 6.0)  # of points of outlines, in 0.2 px with 150 points an outline
MACHINES = {"coplanar": COPLANAR, "non-coplanar": NONCOPLANAR}
CRITERIA: tuple[Criteria, ...] = ("default", "literal")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--draws", type=int, default=5)
    parser.add_argument("--only", choices=["times", "errors"])
    parser.add_argument("--photographs", nargs="+", metavar="MACHINE")
    parser.add_argument("--seed", type=int, default=0)
    arguments = parser.parse_args()
    if arguments.photographs:
        _print_photographs(arguments.photographs, arguments.seed)
        return
    if arguments.only != "errors":
        _print_times()
    if arguments.only != "times":
        _print_errors(arguments.draws)


def _print_photographs(names: Sequence[str], seed: int) -> None:
    """Print the platform errors of models that photographs give, against the simulated truth."""
    columns = ("nominal", *CRITERIA, "joint fit")
    print("platform error from photographs, mean over poses [mm / deg]")
    print(f"{'machine':14}" + " ".join(f"{column:>24}" for column in columns))
    for name in names:
        with TemporaryDirectory() as temporary:
            folder = Path(temporary)
            made = simulate(name, folder / "set", SimulationSettings(seed=seed))
            models = {"nominal": Path(name)}
            for criteria in CRITERIA:
                calibrate(made.folder, output=folder / criteria, criteria=criteria)
                models[criteria] = folder / criteria / "staged.yaml"
            models["joint fit"] = folder / "default/calibrated.yaml"
            cells = [_against_truth(model, made) for model in models.values()]
        print(f"{name:14}" + " ".join(f"{cell:>24}" for cell in cells), flush=True)


def _against_truth(model: Path, made: SimulatedDataset) -> str:
    """Return a cell: the mean error at the poses of a dataset, and at how many there is none."""
    if model.suffix and not model.exists():
        return "no model"
    try:
        found = evaluate(str(model), made.truth_path, dataset=made.folder)
    except DidNotConverge:
        return "reaches no pose"
    if not len(found.displacement):
        return "no pose by readings"
    dX, dE = 1e3 * found.displacement.mean(), np.rad2deg(found.rotation.mean())
    n = found.n_left_out
    return f"{dX:.3f} / {dE:.3f}" + f" (not at {n})" * (n > 0)


def _print_times() -> None:
    """Print how long the default steps take, and the largest memory of the process until then."""
    print(f"{'images':>8} {'median':>10} {'an image':>10} {'memory':>10}")
    for n_images, n_runs in ((45, 7), (450, 3)):
        session = machine_session(COPLANAR, n_poses=n_images // 3).noisy(0)
        seconds = []
        for _ in range(n_runs):
            begin = perf_counter()
            run_steps(session.nominal, session.axes, session.measurements)
            seconds.append(perf_counter() - begin)
        median = float(np.median(seconds))
        memory = getrusage(RUSAGE_SELF).ru_maxrss / 1024.0  # Linux counts kB
        each = 1e3 * median / n_images
        print(f"{n_images:8} {median:8.2f} s {each:7.2f} ms {memory:7.0f} MB", flush=True)


def _print_errors(n_draws: int) -> None:
    """Print the platform errors of both criteria for every kind of noise."""
    print(f"platform error, mean over {n_draws} draws [mm / deg]")
    print(f"{'noise':>8} {'joints':12} {'nominal':>15} {'default':>15} {'literal':>15}")
    for noise in NOISES:
        for joints, name in MACHINES.items():
            errors: dict[str, list[tuple[float, float]]] = {}
            for seed in range(n_draws):
                for key, error in _errors(name, noise, seed).items():
                    errors.setdefault(key, []).append(error)
            cells = [_cell(errors.get(key, []), n_draws) for key in ("nominal", *CRITERIA)]
            print(
                f"{noise:8g} {joints:12} " + " ".join(f"{cell:>15}" for cell in cells), flush=True
            )


def _errors(name: str, noise: float, seed: int) -> dict[str, tuple[float, float]]:
    """Return the platform errors of the nominal model and of each criterion that ends."""
    session = machine_session(name, n_poses=15).noisy(seed, noise)
    found = {"nominal": _platform_error(name, session.nominal.legs)}
    for criteria in CRITERIA:
        try:
            result = run_steps(
                session.nominal, session.axes, session.measurements, criteria=criteria
            )
            found[criteria] = _platform_error(name, result.legs)
        except LegcalError:
            continue
    return found


def _platform_error(name: str, legs: Sequence[Leg]) -> tuple[float, float]:
    """Return the error of eq (20) over ten extreme poses [mm, deg]."""
    machine = true_machine(name)
    drawn = draw_poses(machine, 10, np.random.default_rng(20020721)).poses
    poses = RigidTransform.concatenate(list(platforms_in_base(machine, drawn)))
    errors = platform_errors(machine, legs, poses)
    return 1e3 * errors.dX, float(np.rad2deg(errors.angle))


def _cell(errors: Sequence[tuple[float, float]], n_draws: int) -> str:
    """Return a cell of the table: the mean, and how many draws have none."""
    failed = n_draws - len(errors)
    if not errors:
        return "all failed"
    displacement, angle = np.mean(errors, axis=0)
    return f"{displacement:.3f} / {angle:.3f}" + (f" ({failed} failed)" if failed else "")


if __name__ == "__main__":
    main()
