"""Do identify and plan predict the uncertainty that calibrate states?

    OMP_NUM_THREADS=1 python benchmarks/uncertainty.py [DATASET ...]

Each dataset is calibrated. At its poses, cameras, used outlines and edges of bodies, with the noise
of the result, the mean predicted error of the platform over the workspace is computed as
``identify`` and as ``plan`` do, and compared with that of the covariance of the fit, before doubts
add to it. Where readings do not determine the pose, the mean standard deviation of the parameters
takes its place. By default the example and recorded sessions of nine other machines. Ratios are to
lie within 25 %: the last line says by how much the worst is off, and the exit code whether.
"""

import sys
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

import legcal
from legcal.calibration.identify.identifiability import Analysis
from legcal.calibration.identify.session import recorded_session
from legcal.calibration.joint_fit.parameter_choices import Choices
from legcal.calibration.joint_fit.platform import expected_error, platform_by_parameters
from legcal.calibration.joint_fit.predicted import (
    PredictedNoise,
    Predictor,
    fitted_covariance,
    read_noise,
)
from legcal.calibration.pipeline import chosen_parameters
from legcal.calibration.result import Calibration
from legcal.data.dataset import Dataset
from legcal.data.outlines import no_outlines
from legcal.estimation.problem import Frames
from legcal.geometry.types import Array
from legcal.machine.configurations import workspace
from legcal.machine.kinematics import platforms_in_base
from legcal.machine.leg import Leg

ROOT = Path(__file__).parents[1]
RECORDED = ROOT / "tests/data/recorded"
NAMES = ("planar", "revolute", "passive", "constant", "redundant", "arms", "universal", "few",
         "board")  # fmt: skip
MOST_APART = 0.25


def main(*names: str) -> None:
    """Print a row for each dataset."""
    folders = [Path(n) for n in names]
    folders = folders or [ROOT / "examples/hexapod", *(RECORDED / name for name in NAMES)]
    print(
        f"{'dataset':16}{'outlines':>9}{'calibrate':>11}{'identify':>10}{'plan':>9}  [mm], ratios"
    )
    apart = 0.0
    for folder in folders:
        calibration, sizes = compared(folder)
        apart = max(apart, *(abs(x / sizes[0] - 1.0) for x in sizes[1:]))
        columns = "".join(f"{1e3 * x:10.4f}" for x in sizes)
        ratios = " ".join(f"{x / sizes[0]:5.2f}" for x in sizes[1:])
        n = int(calibration.solution.outlines.used.sum())
        print(f"{folder.name:16}{n:9}{columns}  {ratios}", flush=True)
    print(f"The worst prediction is {100.0 * apart:.0f} % off.")
    sys.exit(apart > MOST_APART)


def compared(folder: Path) -> tuple[Calibration, tuple[float, float, float]]:
    """Calibrate a dataset; return the figures of calibrate, identify and plan too."""
    with TemporaryDirectory() as temporary:
        output = Path(temporary) / "result"
        calibration = legcal.calibrate(
            folder, output=output, progress=False, use_cache=False, workers=1
        )
        noise = read_noise(output)
    solution = calibration.solution
    stated = size(calibration, solution.legs, solution.kinematic.covariance)
    return calibration, (stated, by_identify(calibration, noise), by_plan(calibration, noise))


def size(calibration: Calibration, legs: Sequence[Leg], covariance: Array) -> float:
    """Return the figure that is compared, of a covariance of the parameters of legs [m]."""
    machine = calibration.dataset.machine
    parametrization = calibration.solution.kinematic.parametrization
    if not machine.is_determined:
        unit = [1.0 if u == "m" else machine.size for u in parametrization.units]
        return float(np.sqrt(np.mean(np.diagonal(covariance) * np.square(unit))))
    poses = platforms_in_base(machine, workspace(machine)[1])
    by_parameters = platform_by_parameters(legs, parametrization, machine.frame_legs, poses)
    return expected_error(by_parameters, covariance).mean_displacement


def by_identify(calibration: Calibration, noise: PredictedNoise) -> float:
    """Return the figure of identify."""
    dataset, solution = calibration.dataset, calibration.solution
    R, t = Frames.of(solution.T_Rb_Re)
    session = recorded_session(dataset, twists=True)
    places = solution.cameras_in_base(dataset.machine.T_base_Rb)
    to_Rb = dataset.machine.T_base_Rb.inv()
    cameras = tuple(
        replace(view, T_base_camera=to_Rb * T)
        for view, T in zip(session.cameras, places, strict=True)
    )
    session = replace(
        session, R=R, t=t, cameras=cameras, found=solution.outlines, found_edges=solution.edges
    )
    found = Analysis(session, choices_of(dataset), noise)
    return size(calibration, session.fitted.nominal, found.covariance)


def by_plan(calibration: Calibration, noise: PredictedNoise) -> float:
    """Return the figure of plan."""
    dataset, solution = calibration.dataset, calibration.solution
    m, o = dataset.measurements, solution.outlines.choose(solution.outlines.used)
    parts, none, fixed, board = [], no_outlines(), dataset.board_on("base"), None
    if fixed is not None:
        board = fixed.board, dataset.machine.T_base_Rb * solution.T_frame_board["base"]
    predictor = predictor_of(calibration, noise)
    for v, T in enumerate(solution.cameras_in_base(dataset.machine.T_base_Rb)):
        rows = np.flatnonzero(m.view == v)
        of_view = np.isin(o.row, rows)
        if not of_view.any():
            continue
        outlines = replace(o.choose(of_view), row=np.searchsorted(rows, o.row[of_view]))
        edges = none if solution.edges is None else solution.edges
        edges = edges.choose(edges.used & np.isin(edges.row, rows))
        edges = replace(edges, row=np.searchsorted(rows, edges.row))
        poses = [solution.T_Rb_Re[k] for k in m.pose[rows]]
        view = np.zeros(len(rows), dtype=np.intp)
        here = {"here": T}, view, poses, outlines, solution.legs, edges
        parts.append(predictor.contributions(*here, board=board))
    legs, length = predictor.legs, dataset.machine.size
    covariance = fitted_covariance(parts, legs, solution.T_Rb_Re, length)
    return size(calibration, legs.nominal, covariance)


def predictor_of(calibration: Calibration, noise: PredictedNoise) -> Predictor:
    """Return the predictor of a plan."""
    dataset = calibration.dataset
    m = dataset.measurements
    return Predictor(dataset.machine, m.views[0].camera, noise, m.sigma_q, choices_of(dataset))


def choices_of(dataset: Dataset) -> Choices:
    """Return what calibrate knows of parameters."""
    return chosen_parameters(dataset, ())


if __name__ == "__main__":
    main(*sys.argv[1:])
