"""What calibrations state, and how true it is, on photographs by each kind of camera.

    OMP_NUM_THREADS=1 python benchmarks/real_cameras.py [--sessions 60] [--kinds phone webcam ...]
        [--models hexapod 3-rps 3-upu] [--views 3] [--poses 15] [--keep FOLDER [--kept]]
        [--workers 1]

Cameras of five kinds (``legcal simulate --camera KIND``), from industrial ones to those of people,
photograph simulated machines from tilted poses and a chessboard; the models take turns, each
session has a seed of its own. As people do it, the intrinsics come from ``legcal camera`` on the
photographs of the board, and nobody tells the gamma; then the machine is calibrated. A line a
session, and a line a kind, a machine and for all of them:

    n          sessions, and of these: how many were refused, how many are trusted ("Calibrated")
    e'C^-1e    mean of e' C^-1 e / rank, and one standard deviation of this mean: e the errors of
               the platform at the session's poses, against the truth, C their predicted
               covariance; 1 where it is honest
    error      median over sessions of the error of the platform, rms over its poses [mm]
    sigma      median of what is predicted of it [mm]
    gamma      median of the gammas found; they are 2.2
    largest    largest error of a trusted result over what is predicted of it
    dropped    outlines that were measured and left out: too rough, of a wrong width, by the fit

With ``--keep`` photographs stay in that folder, a folder a session, and are used again, so that
only the calibrations are repeated, of copies; with ``--kept`` of all sessions that lie there.
"""

import argparse
import re
import shutil
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
from board_photographs import PrintedBoard, photograph_boards

from legcal import LegcalError, calibrate, calibrate_camera, load_mechanism
from legcal.calibration.result import Calibration
from legcal.geometry.motions import components
from legcal.geometry.types import Array
from legcal.machine.equations import pose_sensitivity
from legcal.machine.parameters import geometries, vector_of
from legcal.simulation.cameras import mild_lens
from legcal.simulation.dataset import simulate
from legcal.simulation.rendering.appearance import CAMERAS, Appearance
from legcal.simulation.settings import SimulationSettings
from legcal.workers import worker_pool

MODELS = "hexapod", "3-rps", "3-upu"
_NAME = re.compile(rf"({'|'.join(CAMERAS)})-({'|'.join(MODELS)})-(\d+)x(\d+)-(\d+)")
N_BOARDS = 15
_LEAST_SIGMA = 1e-3  # of the largest standard deviation of the platform: directions that count
HEADER = (
    f"{'':26}{'n':>4} {'refused':>7} {'trusted':>7} {'e`C^-1e':>13} {'error':>7} {'sigma':>7} "
    f"{'gamma':>6} {'largest':>8} {'dropped':>8}"
)


@dataclass(frozen=True)
class Session:
    """A machine that a kind of camera photographs."""

    kind: str
    model: str
    seed: int
    views: int
    poses: int

    @property
    def name(self) -> str:
        """The name of its folder."""
        return f"{self.kind}-{self.model}-{self.views}x{self.poses}-{self.seed}"

    @classmethod
    def named(cls, name: str) -> "Session | None":
        """Return the session whose folder has a name, None if none has."""
        found = _NAME.fullmatch(name)
        if found is None:
            return None
        return cls(found[1], found[2], int(found[5]), int(found[3]), int(found[4]))


@dataclass(frozen=True)
class Outcome:
    """What calibrating a session gave."""

    session: Session
    refusal: str = ""
    trusted: bool = False
    square: float = 0.0  # e' C^-1 e / rank
    error: float = 0.0  # [m]
    sigma: float = 0.0  # [m]
    gammas: tuple[float, ...] = ()
    dropped: float = 0.0


def photographed(session: Session, folder: Path) -> None:
    """Write the photographs of a session, and those of the board by the same camera."""
    look = Appearance(camera=session.kind, colour=CAMERAS[session.kind].colour)
    settings = SimulationSettings(
        seed=session.seed,
        views=session.views,
        poses=session.poses,
        tell_gamma=False,
        appearance=look,
    )
    with TemporaryDirectory(dir=folder.parent, prefix=".") as unfinished:
        made = Path(unfinished) / "made"
        simulate(session.model, made, settings)
        seed = np.random.SeedSequence([session.seed, MODELS.index(session.model)])
        camera = mild_lens()
        draws = int(seed.generate_state(1)[0])
        photograph_boards(made / "board", PrintedBoard(), camera, look, N_BOARDS, draws)
        made.rename(folder)


def outcome(session: Session, kept: Path) -> Outcome:
    """Calibrate camera and machine of a session, photographed before or now."""
    folder = kept / session.name
    if not folder.exists():
        photographed(session, folder)
    with TemporaryDirectory() as scratch:
        copy = Path(scratch) / "session"
        shutil.copytree(folder, copy)
        for file in copy.glob("camera_info*.yaml"):
            file.unlink()
        try:
            spec = "chessboard:10x7:25mm"
            calibrate_camera(copy / "board", spec, output=copy / "camera_info.yaml")
            return judged(session, calibrate(copy, use_cache=False), copy)
        except LegcalError as error:
            return Outcome(session, refusal=str(error))


def judged(session: Session, calibration: Calibration, folder: Path) -> Outcome:
    """Compare a calibration with the truth and with what it says of itself."""
    solution, machine = calibration.solution, calibration.dataset.machine
    truth = load_mechanism(next((folder / "truth/models").glob("*.yaml")))
    truth = truth.with_leg_order(machine.leg_names)
    legs, parametrization = solution.legs, solution.kinematic.parametrization
    step = vector_of(parametrization, geometries(truth), legs)
    step = step - vector_of(parametrization, legs, legs)
    by_pose = pose_sensitivity(
        legs, parametrization, machine.frame_legs, *components(solution.T_Rb_Re)
    )
    C = solution.kinematic.total_covariance
    away = by_pose[:, 3:] @ step
    spread = np.einsum("kia,ab,kib->k", by_pose[:, 3:], C, by_pose[:, 3:])
    error, sigma = (float(np.sqrt(np.mean(square))) for square in (np.sum(away**2, axis=1), spread))
    o = solution.outlines
    measured = np.array([bool(np.isfinite(S).all() and S.any()) for S in o.covariance])
    return Outcome(
        session,
        trusted=calibration.verdict.trustworthy,
        square=normalised_square(by_pose, C, step, machine.B_platform),
        error=error,
        sigma=sigma,
        gammas=tuple(found.gamma for found in solution.gammas),
        dropped=float(np.mean(~o.used[measured])),
    )


def normalised_square(by_pose: Array, covariance: Array, step: Array, joints: Array) -> float:
    """Return e' C^-1 e / rank of the platform at all poses, angles as they move its joints."""
    arm = float(np.linalg.norm(np.ptp(joints, axis=0))) / 2.0
    J = (by_pose * np.repeat([arm, 1.0], 3)[:, None]).reshape(-1, by_pose.shape[2])
    values, vectors = np.linalg.eigh(covariance)
    root = vectors * np.sqrt(np.maximum(values, 0.0))
    U, s, _ = np.linalg.svd(J @ root, full_matrices=False)
    known = s > _LEAST_SIGMA * s[0]
    return float(np.sum((U[:, known].T @ (J @ step) / s[known]) ** 2) / known.sum())


def summary(name: str, found: Sequence[Outcome]) -> str:
    """Return a line of the table."""
    fitted = [one for one in found if not one.refusal]
    trusted = [one for one in fitted if one.trusted]
    start = f"{name:26}{len(found):4d} {len(found) - len(fitted):7d} {len(trusted):7d} "
    if not fitted:
        return start
    gammas = [gamma for one in fitted for gamma in one.gammas]
    gamma = f"{np.median(gammas):.2f}" if gammas else "-"
    largest = max((one.error / one.sigma for one in trusted), default=0.0)
    squares = [one.square for one in fitted]
    of_mean = f" ± {np.std(squares, ddof=1) / len(squares) ** 0.5:.2f}" if len(squares) > 1 else ""
    return start + (
        f"{f'{np.mean(squares):.2f}{of_mean}':>13} "
        f"{1e3 * np.median([one.error for one in fitted]):7.3f} "
        f"{1e3 * np.median([one.sigma for one in fitted]):7.3f} {gamma:>6} {largest:8.2f} "
        f"{100.0 * np.mean([one.dropped for one in fitted]):6.1f} %"
    )


@dataclass(frozen=True)
class _Task:
    """The work on a session, for any process."""

    kept: Path

    def __call__(self, session: Session) -> Outcome:
        return outcome(session, self.kept)


def outcomes(sessions: Sequence[Session], kept: Path, workers: int) -> Iterable[Outcome]:
    """Yield the outcome of each session, and print it."""
    kept.mkdir(parents=True, exist_ok=True)
    with worker_pool(workers) as run:
        for one in run(_Task(kept.resolve()), sessions):
            print(summary(one.session.name, [one]), flush=True)
            if one.refusal:
                print(f"    {one.refusal}", flush=True)
            yield one


def main() -> None:
    """Print a line a session, a kind, a machine, and for all."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--sessions", type=int, default=60, help="of each kind of camera; 60")
    parser.add_argument("--kinds", nargs="+", choices=CAMERAS, default=list(CAMERAS))
    parser.add_argument("--models", nargs="+", choices=MODELS, default=list(MODELS))
    parser.add_argument("--views", type=int, default=3, help="3")
    parser.add_argument("--poses", type=int, default=15, help="of each view; 15")
    parser.add_argument("--first", type=int, default=1, help="the first seed; 1")
    parser.add_argument("--keep", type=Path, help="where photographs stay and are used again")
    parser.add_argument("--kept", action="store_true", help="all that lie there, and no others")
    parser.add_argument("--workers", type=int, default=1, help="processes; 1")
    options = parser.parse_args()
    if options.kept and options.keep is None:
        parser.error("--kept needs --keep FOLDER")
    n = len(options.models)
    sessions = [
        Session(kind, options.models[k % n], options.first + k // n, options.views, options.poses)
        for k in range(options.sessions)
        for kind in options.kinds
    ]
    if options.kept:
        lying = [Session.named(folder.name) for folder in sorted(options.keep.iterdir())]
        sessions = [
            one
            for one in lying
            if one is not None and one.kind in options.kinds and one.model in options.models
        ]
    print(HEADER)
    with TemporaryDirectory() as scratch:
        kept = options.keep or Path(scratch)
        found = list(outcomes(sessions, kept, options.workers))
    print()
    for kind in options.kinds:
        print(summary(kind, [one for one in found if one.session.kind == kind]))
    for model in options.models:
        print(summary(model, [one for one in found if one.session.model == model]))
    print(summary("all", found))


if __name__ == "__main__":
    main()
