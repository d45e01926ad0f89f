"""A hexapod from calibration boards on base and platform, without a leg: error over prediction.

    python benchmarks/platform_board.py corners [--runs 200] [--alone]
    python benchmarks/platform_board.py photographs [--seeds 1 2 3]

``corners`` fits corners with noise that a simulated session shows, from joints that are 2 mm wrong:
how many runs converge, and the normalised squared error of the parameters. ``--alone`` leaves out
the board on the base. ``photographs`` renders 45 photographs for each seed, of which no leg is
used, calibrates without any rough pose, and compares the error of eq (20) with the predicted one.
"""

from __future__ import annotations

import argparse
import json
import tempfile
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import yaml
from scipy.spatial.transform import RigidTransform, Rotation

from legcal import calibrate, evaluate, load_mechanism, simulate
from legcal.calibration.joint_fit.factors import BoardCorners
from legcal.calibration.joint_fit.fit import refine
from legcal.calibration.joint_fit.variables import Start, fitted_legs, start_from
from legcal.data.corners import found_corners
from legcal.data.outlines import no_outlines
from legcal.errors import LegcalError
from legcal.geometry.types import Array
from legcal.machine.parameters import geometries, moved_legs
from legcal.simulation.observe import corners_in_images
from legcal.simulation.session import SimulatedSession, simulate_session, streams
from legcal.simulation.settings import Level, SimulationSettings

SIGMA_PX = 0.05
WRONG_M = 0.002
SHAKE = (0.005, 0.02)  # of where boards and cameras start [m, rad]


def session_of_boards(*, alone: bool, seed: int = 0) -> SimulatedSession:
    """Return 45 exact images of 45 poses, with a board on the platform and one on the base."""
    machine = load_mechanism("hexapod")
    settings = SimulationSettings(
        level=Level.OUTLINES,
        views=3,
        poses=15,
        board=None if alone else "charuco",
        platform_board="charuco",
        seed=seed,
    )
    return simulate_session(machine, machine, settings, streams(seed))


def fit_corners(session: SimulatedSession, seed: int) -> tuple[float, int]:
    """Return the squared error over the variances, and of how many numbers, of one noisy run."""
    rng, machine = np.random.default_rng(seed), session.truth
    legs, true = fitted_legs(machine), geometries(machine)
    p = legs.parametrization
    free = np.array([not name.endswith(".twist") for name in p.names])
    nominal = moved_legs(true, p.place, np.where(free, WRONG_M * rng.choice([-1, 1], len(free)), 0))
    legs = replace(legs, nominal=nominal)
    m = session.measurements
    exact = corners_in_images(session.scene, session.posed_machines, 0.0)
    q = session.poses.readings[np.unique(session.scene.images.pose)][m.pose]
    error = m.sigma_q * rng.standard_normal((m.n_poses, q.shape[1]))
    m = replace(m, q=q + error[m.pose])
    px = exact.px + SIGMA_PX * rng.standard_normal(exact.px.shape)
    corners = found_corners(exact.row, exact.corner, px, np.full(len(px), SIGMA_PX))
    T_Rb, T_Re = machine.T_base_Rb, machine.T_platform_Re
    poses = [
        T_Rb.inv() * session.poses.poses[k] * T_Re for k in np.unique(session.scene.images.pose)
    ]
    cameras = [_shaken(v.T_base_camera.inv() * T_Rb, rng) for v in session.scene.views]
    start = start_from(nominal, m, legs, cameras, poses, "nominal")
    for fixed in session.boards:
        assert fixed.T_link_board is not None
        frame = T_Rb if fixed.link == "base" else T_Re
        place = _shaken(frame.inv() * fixed.T_link_board, rng)
        name = "T_Rb_board" if fixed.link == "base" else "T_Re_board"
        start = _with_place(start, name, place)
    board = BoardCorners(session.boards, corners)
    found = refine(legs, m, no_outlines(), start, board=board)
    estimates = found.estimates
    names = [name for name in estimates.names if name in p.names]
    which = [estimates.names.index(name) for name in names]
    off = estimates.vector(names)
    off -= legs.vector(true)[[p.names.index(name) for name in names]]
    covariance = found.estimates.covariance[np.ix_(which, which)]
    return float(off @ np.linalg.solve(covariance, off)), len(off)


def _with_place(start: Start, name: str, place: RigidTransform) -> Start:
    if name == "T_Rb_board":
        return replace(start, T_Rb_board=place)
    return replace(start, T_Re_board=place)


def _shaken(T: RigidTransform, rng: np.random.Generator) -> RigidTransform:
    shift, turn = (size * rng.uniform(-1.0, 1.0, 3) for size in SHAKE)
    return T * RigidTransform.from_components(shift, Rotation.from_rotvec(turn))


def corner_runs(runs: int, *, alone: bool) -> None:
    """Print how many runs converge and their normalised squared error."""
    session = session_of_boards(alone=alone)
    found: list[float] = []
    failed = 0
    for seed in range(runs):
        try:
            squared, n = fit_corners(session, seed)
        except LegcalError as error:
            failed += 1
            print(f"run {seed}: {error}")
            continue
        found.append(squared / n)
    nse: Array = np.array(found)
    spread = nse.std() / np.sqrt(len(nse))
    print(
        f"{len(nse)} of {runs} runs converged; normalised squared error "
        f"{nse.mean():.3f} +- {spread:.3f}"
    )


def photographs(seeds: Sequence[int], folder: Path) -> None:
    """Print error over predicted sigma of calibrations from photographs of two boards."""
    ratios = []
    for seed in seeds:
        place = folder / f"{seed}"
        settings = SimulationSettings(
            level=Level.PHOTOGRAPHS,
            views=3,
            poses=15,
            board="charuco",
            platform_board="charuco",
            hints=False,
            seed=seed,
        )
        made = simulate("hexapod", place, settings)
        entry = yaml.safe_load((place / "dataset.yaml").read_text())
        for view in entry["views"].values():
            view["legs"] = []
        (place / "dataset.yaml").write_text(yaml.safe_dump(entry))
        calibrate(place, output=folder / f"{seed}-result")
        found = json.loads((folder / f"{seed}-result/result.json").read_text())
        error = evaluate(folder / f"{seed}-result/calibrated.yaml", made.truth_path, dataset=place)
        platform = found["platform"]["per_pose"]
        dX = float(np.sqrt(np.mean(error.displacement**2)))
        predicted = float(np.sqrt(np.mean([pose["sigma_dX_m"] ** 2 for pose in platform])))
        ratios.append(dX / predicted)
        print(f"seed {seed}: {1e3 * dX:.4f} mm, predicted {1e3 * predicted:.4f}: {ratios[-1]:.2f}")
    print(f"mean of {len(ratios)}: {np.mean(ratios):.2f}")


def main() -> None:
    """Run one of both."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("what", choices=("corners", "photographs"))
    parser.add_argument("--runs", type=int, default=200)
    parser.add_argument("--alone", action="store_true")
    parser.add_argument("--seeds", type=int, nargs="+", default=[1, 2, 3])
    parser.add_argument("--folder", type=Path)
    options = parser.parse_args()
    if options.what == "corners":
        corner_runs(options.runs, alone=options.alone)
        return
    with tempfile.TemporaryDirectory() as name:
        photographs(options.seeds, options.folder or Path(name))


if __name__ == "__main__":
    main()
