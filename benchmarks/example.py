"""How good the calibration of the example hexapod is, against its true model.

    python benchmarks/example.py

Platform errors of eq (20) at the 45 poses: of the nominal model, of what the four steps give
alone (default criteria, and the criteria as printed), and of the joint fit; beside the
error that the fit predicts, and the normalised squared error of its parameters.
"""

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from legcal import calibrate, load_dataset, load_mechanism
from legcal.calibration.joint_fit.variables import platform_poses
from legcal.calibration.result import Calibration
from legcal.data.outlines import axes_from_outlines
from legcal.machine.kinematics import pose_differences
from legcal.machine.leg import Leg
from legcal.machine.parameters import geometries, to_vector
from legcal.paper.four_steps import run_steps
from legcal.paper.unknowns import nominal_machine

ROOT = Path(__file__).parents[1]
TRUTH = ROOT / "tests/data/hexapod-truth/models/hexapod.yaml"


def platform_error(
    calibration: Calibration, legs: Sequence[Leg], truth: Sequence[Leg]
) -> tuple[float, float]:
    """Return the mean displacement [m] and rotation [rad] between two sets of legs."""
    measurements, machine = calibration.dataset.measurements, calibration.dataset.machine
    first_row = np.unique(measurements.pose, return_index=True)[1]
    driven = machine.sign * measurements.q[first_row]
    near = calibration.solution.T_Rb_Re
    frame_legs = machine.frame_legs
    poses, true_poses = (platform_poses(some, driven, near, frame_legs) for some in (legs, truth))
    displacement, rotation = pose_differences(poses, true_poses)
    return float(displacement.mean()), float(rotation.mean())


def main() -> None:
    """Print a line an estimate."""
    dataset = load_dataset(ROOT / "examples/hexapod")
    machine, truth = dataset.machine, geometries(load_mechanism(TRUTH))
    calibration = calibrate(dataset, use_cache=False)
    solution = calibration.solution
    radii = {cylinder.link: cylinder.radius for leg in machine.legs for cylinder in leg.cylinders}
    axes = axes_from_outlines(solution.outlines, dataset.measurements, radii)
    nominal = nominal_machine(machine)
    steps = {
        criteria: run_steps(nominal, axes, dataset.measurements, criteria=criteria).legs
        for criteria in ("literal", "default")
    }
    rows = {
        "nominal model": geometries(machine),
        "four steps, criteria as printed": steps["literal"],
        "four steps, default criteria": steps["default"],
        "joint fit": solution.legs,
    }
    for name, legs in rows.items():
        dX, dE = platform_error(calibration, legs, truth)
        print(f"{name:32s} {1e3 * dX:8.3f} mm {np.degrees(dE):8.4f} deg")
    if calibration.platform is not None:  # the motors determine the pose
        sigma = calibration.platform.sigma
        dX, dE = 1e3 * sigma.mean_displacement, np.degrees(sigma.mean_rotation)
        print(f"{'predicted for the fit, 1 sigma':32s} {dX:8.3f} mm {dE:8.4f} deg")
    error = to_vector(solution.legs, machine.frame_legs) - to_vector(truth, machine.frame_legs)
    n = len(error)
    pull = error / solution.estimates.sigma[:n]
    together = error @ np.linalg.solve(solution.estimates.covariance[:n, :n], error) / n
    print(
        f"normalised squared error: {np.mean(pull**2):.2f} of single parameters, {together:.2f} of "
        "all together"
    )


if __name__ == "__main__":
    main()
