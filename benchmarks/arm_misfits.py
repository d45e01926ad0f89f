"""How far outlines of arms lie off a fit beside those of rods, where arms are cylinders or not.

    OMP_NUM_THREADS=1 python benchmarks/arm_misfits.py [MACHINE ...] [--runs 20] [--seed 0]
                         [--level outlines|photographs] [--shapes NAME ...]

MACHINE: those of ``outline_sessions.ROUND_ARMS``, all of them without. In every session the arms
are of one of ``SHAPES``, and the model draws them as cylinders. Of outlines, pairs whose width
detection would refuse are left out. Photographs (``--poses`` 8 from each of three places) are
rendered of the first and the last shapes, bars, and calibrated with one rod measured. Printed are,
of each shape:

- arms without a misfit, whose outlines were all refused, or most for their width, of how many;
- of the others the misfit (``arm_misfits``) where fits are first judged with them, quantiles over
  arms: over rods, and [px];
- how many arms a misfit leaves out, and how many stay in the end;
- the normalised squared error of the parameters (outlines), or the error of the platform at the
  poses over what is predicted (photographs), root mean square over sessions.
"""

import argparse
import math
import re
import sys
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any
from unittest.mock import patch

import numpy as np
from bound import ERRORS
from classes_study import errors_of_fit
from outline_sessions import (
    ROUND_ARMS,
    Design,
    Noise,
    design_of,
    draw_session,
    made,
    one_fit,
    true_machine,
)

from legcal import LegcalError, calibrate, evaluate, load_mechanism
from legcal.calibration.joint_fit import fit
from legcal.calibration.joint_fit.diagnostics import arm_misfits, wrong_arms
from legcal.data.outlines import Outlines, are_of_arms
from legcal.data.reasons import Reason
from legcal.errors import NotIdentifiable
from legcal.geometry.lines import cross
from legcal.geometry.types import Array
from legcal.machine.model import Machine
from legcal.machine.rods import arms_at
from legcal.perception.outline import WIDTH_PART
from legcal.perception.tuning import WIDTH_PX
from legcal.simulation.dataset import simulate
from legcal.simulation.observe import moved_outlines, noisy_outlines
from legcal.simulation.settings import Level, SimulationSettings

LENGTH_SIGMA = 5e-5  # [m] of a length measured by hand

N_VIEWS, N_POSES = 3, 15
_CIRCLE = np.array([[np.cos(t), np.sin(t)] for t in np.linspace(0.0, 2.0 * np.pi, 720)])
_CORNERS = np.array([[1.0, 1.0], [1.0, -1.0], [-1.0, 1.0], [-1.0, -1.0]])
# Points (n, 2) of the section at the near and at the far end: in the plane in which the arm turns,
# and along the axis of its motor, in radii of the cylinder that the model draws
SHAPES = {
    "cylinder": (_CIRCLE, _CIRCLE),
    "cylinder, 3 % thicker": (1.03 * _CIRCLE, 1.03 * _CIRCLE),
    "cone, 2 %": (1.01 * _CIRCLE, 0.99 * _CIRCLE),
    "cone, 5 %": (1.025 * _CIRCLE, 0.975 * _CIRCLE),
    "cone, 10 %": (1.05 * _CIRCLE, 0.95 * _CIRCLE),
    "cone, 20 %": (1.1 * _CIRCLE, 0.9 * _CIRCLE),
    "oval, 5 % flat": (_CIRCLE * [1.025, 0.975], _CIRCLE * [1.025, 0.975]),
    "oval, 10 % flat": (_CIRCLE * [1.05, 0.95], _CIRCLE * [1.05, 0.95]),
    "square bar": (0.886 * _CORNERS, 0.886 * _CORNERS),
    "flat bar, 6 : 5": (_CORNERS * [0.97, 0.81], _CORNERS * [0.97, 0.81]),
    "flat bar, 3 : 2": (_CORNERS * [1.09, 0.72], _CORNERS * [1.09, 0.72]),
}
PHOTOGRAPHED = ("cylinder", "square bar", "flat bar, 6 : 5", "flat bar, 3 : 2")
QUANTILES = (0.0, 0.1, 0.5, 0.9, 1.0)


def seen_as(design: Design, sections: tuple[Array, Array]) -> Outlines:
    """Return the exact outlines of a design whose arms have other sections, as detection has them.

    Outlines of arms move to where the outermost points of the sections are seen at their ends.
    """
    shown, legs, camera = design.outlines, design.legs.nominal, design.camera
    arms = arms_at(legs, design.q_of_actuators)
    offsets = np.zeros((len(shown), 2))
    for i in np.flatnonzero(are_of_arms(shown, legs)).tolist():
        j, row = int(shown.leg[i]), int(shown.row[i])
        leg = legs[j]
        if leg.actuator is None or leg.arm is None:
            raise ValueError("an outline of an arm is of a leg that has none")
        T = design.T_Rb_camera[design.view[row]].inv()
        near, far = T.apply(arms[j][design.pose[row]])
        along = far - near
        u = along / np.linalg.norm(along)
        w = T.rotation.apply(leg.actuator.axis)
        across = np.stack([cross(w, u), w - (w @ u) * u])
        across /= np.linalg.norm(across, axis=1, keepdims=True)
        xy = camera.undistort(shown.ends[i])
        rays = np.concatenate([xy, np.ones((2, 1))], axis=1)
        rays /= np.linalg.norm(rays, axis=1, keepdims=True)
        outward = -np.sign(shown.h[i] @ near)
        normal = np.linalg.solve(
            np.swapaxes(camera.pixels_per_unit(xy), 1, 2),
            np.tile(shown.h[i][:2], (2, 1))[..., None],
        )[..., 0]
        normal /= np.linalg.norm(normal, axis=1, keepdims=True)
        for end in range(2):
            apart = np.cross(u, rays[end])  # the point of the axis that is nearest to the ray
            s = float(np.cross(-near, rays[end]) @ apart / (apart @ apart))
            share = s / float(np.linalg.norm(along))
            section = (1.0 - share) * sections[0] + share * sections[1]
            points = near + s * u + leg.arm.radius * section @ across
            beyond = (camera.project(points) - shown.ends[i, end]) @ normal[end]
            offsets[i, end] = outward * np.max(outward * beyond)
    return _refused(moved_outlines(shown, camera, offsets), design)


def _refused(outlines: Outlines, design: Design) -> Outlines:
    """Return outlines without the pairs of arms whose width is not that of the cylinder."""
    exact, least = design.outlines, (WIDTH_PX, WIDTH_PART)
    own = np.flatnonzero(are_of_arms(outlines, design.legs.nominal)).reshape(-1, 2)
    wide, expected = (
        np.linalg.norm(ends[own[:, 1]] - ends[own[:, 0]], axis=-1).mean(axis=1)
        for ends in (outlines.ends, exact.ends)
    )
    wrong = np.zeros(len(outlines), dtype=np.bool_)
    wrong[own[np.abs(wide - expected) > least[0] + least[1] * expected]] = True
    return outlines.reject(wrong, Reason.WIDTH)


class Judged:
    """The misfits of arms where fits are first judged with them, and which arms stay."""

    def __init__(self) -> None:
        self.misfits: dict[int, tuple[float, float]] = {}
        self.left_out: set[int] = set()

    def __call__(self, problem: Any, state: Any, noise: Any, outlines: Outlines) -> dict[int, str]:
        """Return what ``wrong_arms`` does."""
        wrong = wrong_arms(problem, state, noise, outlines)
        for leg, misfit in arm_misfits(problem, state, noise).items():
            self.misfits.setdefault(leg, misfit)
        self.left_out |= set(wrong)
        return wrong


def of_outlines(machine: str, shape: str, seed: np.random.SeedSequence) -> float:
    """Return the normalised squared error of the fit of a session of outlines."""
    noise, rng = Noise(), np.random.default_rng(seed)
    design = design_of(machine, N_VIEWS, N_POSES, noise.sigma_px)
    exact = seen_as(design, SHAPES[shape])
    session = draw_session(design, noise, ERRORS, rng)
    session = replace(session, outlines=noisy_outlines(exact, design.camera, rng))
    found = one_fit(session, noise.radius_sigma)
    return float(errors_of_fit(design, session, found, noise)["nse"])


def of_photographs(machine: str, shape: str, seed: int, n_poses: int, folder: Path) -> float:
    """Return the squared error of the platform over what a calibration of photographs predicts."""
    nominal, true = made(machine, folder / "nominal"), made(machine, folder / "true")
    drawn = (nominal.yaml_path.parent.parent / "urdf").glob("*.urdf")
    (urdf,) = drawn
    if shape != "cylinder":
        other = folder / "true" / urdf.relative_to(folder / "nominal")
        other.write_text(_with_bars(other.read_text(), nominal, SHAPES[shape][0]))
        true = load_mechanism(true.yaml_path)
    rod = nominal.rod_for_scale(has_length=False)
    lengths = {} if rod is None else {rod[1]: LENGTH_SIGMA}
    settings = SimulationSettings(
        level=Level.PHOTOGRAPHS, seed=seed, poses=n_poses, lengths=lengths, hints=False
    )
    shot = simulate(true, folder / "shot", settings)
    (folder / "shot/urdf" / urdf.name).write_text(urdf.read_text())
    found = calibrate(folder / "shot", output=folder / "out", use_cache=False)
    errors = evaluate(folder / "out/calibrated.yaml", shot.truth_path, dataset=folder / "shot")
    if found.platform is None:
        raise NotIdentifiable("readings do not give the pose")
    predicted = found.platform.sigma.displacement
    return float(np.mean(errors.displacement**2) / np.mean(predicted**2))


def _with_bars(urdf: str, machine: Machine, section: Array) -> str:
    """Return a URDF with bars in place of the cylinders of arms."""
    for arm in (leg.arm for leg in machine.legs if leg.arm is not None):
        x, y = 2.0 * arm.radius * section.max(axis=0)
        pattern = rf'<cylinder radius="{arm.radius:g}" length="[0-9.]+"/>'
        urdf = re.sub(pattern, f'<box size="{x:g} {y:g} {arm.length:g}"/>', urdf)
    return urdf


def study(machine: str, asked: argparse.Namespace) -> None:
    """Print a line of each shape."""
    n_arms = sum(leg.arm is not None for leg in true_machine(machine).legs)
    for shape in asked.shapes or (SHAPES if asked.level == "outlines" else PHOTOGRAPHED):
        misfits, squared = list[tuple[float, float]](), list[float]()
        n_left, n_kept, failed = 0, 0, 0
        for run, child in enumerate(np.random.SeedSequence(asked.seed).spawn(asked.runs)):
            judged = Judged()
            with TemporaryDirectory() as folder, patch.object(fit, "wrong_arms", judged):
                try:
                    if asked.level == "outlines":
                        squared.append(of_outlines(machine, shape, child))
                    else:
                        seed = asked.seed + run
                        squared.append(
                            of_photographs(machine, shape, seed, asked.poses, Path(folder))
                        )
                except LegcalError as error:
                    failed += 1
                    print(f"{machine}, {shape}, run {run}: {error}", file=sys.stderr)
                    continue
            misfits += judged.misfits.values()
            n_left += len(judged.left_out)
            n_kept += len(judged.misfits.keys() - judged.left_out)
        n = n_arms * len(squared)
        line = f"{machine:18}{shape:22}{n - len(misfits):4} of {n:3} "
        for values in np.array(misfits).reshape(-1, 2).T:
            quantiles = np.quantile(values, QUANTILES) if misfits else []
            line += f"  {' '.join(f'{q:5.2f}' for q in quantiles):30}"
        mean = float(np.mean(squared)) if squared else math.nan
        shown = f"{mean if asked.level == 'outlines' else math.sqrt(mean):6.2f}"
        print(f"{line}{n_left:4}{n_kept:4}{shown}{f'  {failed} failed' * bool(failed)}", flush=True)


def main() -> None:
    """Run."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("machines", nargs="*", default=list(ROUND_ARMS), metavar="MACHINE")
    parser.add_argument("--runs", type=int, default=20)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--level", choices=("outlines", "photographs"), default="outlines")
    parser.add_argument("--shapes", nargs="+", choices=SHAPES)
    parser.add_argument("--poses", type=int, default=8)
    asked = parser.parse_args()
    print(f"{'':40}none         misfit: {'0 10 50 90 100 %':22}  [px]{'':24} out  in  error")
    for machine in asked.machines:
        study(machine, asked)


if __name__ == "__main__":
    main()
