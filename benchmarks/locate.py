"""How near ``legcal locate`` is to the Cramer-Rao bound, machine by machine.

    python benchmarks/locate.py [RUNS] [MACHINE ...]

Each run places base and tool anywhere, takes 20 random poses of the workspace and measures them
with 0.02 mm and 0.01 deg of noise a component. The bound is worked out at the truth from central
differences of simulated measurements, without the equations of the fit. Where a machine leaves a
part open (it only translates, it moves in a plane), base and tool are compared with the
tool held at its true position, which is what then is determined.

"error / bound" is the rms error of a component in units of its bound, over all runs: least and
largest of the components, and all together (all components of a run measured by the covariance of
the bound). "NSE" is the normalised squared error by the covariance that the command states, one
where that is right: with sigmas stated, and estimated from the residuals, for which
dof / (dof - 2) is expected. "rows" counts correct rows that were left out.
"""

import sys
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import RigidTransform, Rotation

from legcal import Location, ToolPoses, load_mechanism, locate
from legcal.geometry.types import Array
from legcal.machine.configurations import random_configurations
from legcal.machine.model import Machine

POSES = 20
SIGMA_POSITION = 0.02e-3  # [m]
SIGMA_ANGLE = float(np.radians(0.01))
MACHINES = ("hexapod", "3-rps", "tricept", "3-upu", "3-rpr")
STEP = 1e-6  # [m, rad]
LOST = 1e-6  # of the largest singular value: an open direction

Motion = RigidTransform


def random_motion(chance: np.random.Generator, size: float) -> Motion:
    """Return any orientation at a place within some distance [m]."""
    turn = Rotation.from_quat(chance.normal(size=4))
    return Motion.from_components(size * chance.uniform(-1.0, 1.0, 3), turn)


def shifted(T: Motion, step: Array) -> Motion:
    """Return a motion after a displacement [m] and a rotation [rad], both from the left."""
    turn = Rotation.from_rotvec(step[3:])
    return Motion.from_components(T.translation + step[:3], turn * T.rotation)


def difference(one: Motion, other: Motion) -> Array:
    """Return the step from the other motion to the one, (6,)."""
    turn = (one.rotation * other.rotation.inv()).as_rotvec()
    return np.concatenate([one.translation - other.translation, turn])


def measured(base: Motion, tool: Motion, platform: Sequence[Motion]) -> list[Motion]:
    """Return the poses of the tool in the world."""
    return [base * T * tool for T in platform]


def bound(base: Motion, tool: Motion, platform: Sequence[Motion]) -> tuple[Array, Array]:
    """Return the covariance of the best estimator (12, 12) and its open directions (12, k)."""
    columns = []
    for i in range(12):
        step = np.zeros(12)
        step[i] = STEP
        ends = [
            measured(shifted(base, s[:6]), shifted(tool, s[6:]), platform) for s in (step, -step)
        ]
        columns.append(
            np.concatenate([difference(a, b) for a, b in zip(*ends, strict=True)]) / (2 * STEP)
        )
    sigma = np.tile(np.repeat([SIGMA_POSITION, SIGMA_ANGLE], 3), len(platform))
    design = np.column_stack(columns) / sigma[:, None]
    _, s, Vt = np.linalg.svd(design)
    lost = Vt[s < LOST * s[0]].T
    held = np.zeros_like(lost)
    held[6:] = lost[6:]  # the tool is held where it is open
    kept = np.linalg.svd(held, full_matrices=True)[0][:, lost.shape[1] :]
    kept = np.eye(12) if not lost.shape[1] else kept
    information = kept.T @ design.T @ design @ kept
    return kept @ np.linalg.solve(information, kept.T), lost


@dataclass
class Run:
    """One simulated location."""

    error: Array
    bound: Array
    stated: Location
    estimated: Location
    estimated_error: Array


def one_run(machine: Machine, seed: int) -> Run:
    """Return what a run finds with stated and with estimated sigmas."""
    chance = np.random.default_rng([seed, 20])
    base, tool = random_motion(chance, 3.0), random_motion(chance, 0.2)
    drawn = random_configurations(machine, POSES, chance)
    covariance, lost = bound(base, tool, drawn.poses)
    poses = [
        shifted(T, chance.normal(size=6) * np.repeat([SIGMA_POSITION, SIGMA_ANGLE], 3))
        for T in measured(base, tool, drawn.poses)
    ]
    table = ToolPoses(
        q=drawn.readings,
        position=np.array([T.translation for T in poses]),
        rotation=np.array([T.rotation.as_matrix() for T in poses]),
        oriented=np.ones(POSES, dtype=np.bool_),
        numbers=np.arange(1, POSES + 1),
    )
    at = tool.translation.tolist() if lost.shape[1] else None
    stated = locate(
        machine,
        table,
        position_sigma=SIGMA_POSITION,
        angle_sigma=SIGMA_ANGLE,
        tool_position=at,
    )
    estimated = locate(machine, table, tool_position=at)
    errors = [
        np.concatenate([difference(f.T_world_base, base), difference(f.T_platform_tool, tool)])
        for f in (stated, estimated)
    ]
    return Run(errors[0], covariance, stated, estimated, errors[1])


def normalised(error: Array, covariance: Array) -> tuple[float, int]:
    """Return the squared error by a covariance, and how many components that has."""
    scale = np.sqrt(np.maximum(np.diagonal(covariance), 0.0))
    scale[scale < 1e-12] = np.inf
    values, vectors = np.linalg.eigh(covariance / np.outer(scale, scale))
    kept = values > 1e-9
    y = vectors[:, kept].T @ (error / scale)
    return float((y**2 / values[kept]).sum()), int(kept.sum())


def line(name: str, runs: int) -> str:
    """Return the line of a machine."""
    machine = load_mechanism(name)
    done = [one_run(machine, seed) for seed in range(runs)]
    squares = np.mean([r.error**2 for r in done], axis=0)
    best = np.mean([np.diagonal(r.bound) for r in done], axis=0)
    ratio = np.sqrt(squares[best > 1e-24] / best[best > 1e-24])
    together = [normalised(r.error, r.bound) for r in done]
    stated = [normalised(r.error, r.stated.covariance) for r in done]
    estimated = [normalised(r.estimated_error, r.estimated.covariance) for r in done]
    n = together[0][1]
    nse = [np.mean([s for s, _ in found]) / n for found in (together, stated, estimated)]
    out = sum(not row.used for r in done for row in (*r.stated.rows, *r.estimated.rows))
    size = np.sqrt(best.reshape(4, 3).sum(axis=1))
    return (
        f"{name:14}{n:4}   {1e3 * size[0]:.3f} mm {np.degrees(size[1]):.4f} deg   "
        f"{1e3 * size[2]:.3f} mm {np.degrees(size[3]):.4f} deg   "
        f"{ratio.min():.3f} to {ratio.max():.3f}   {np.sqrt(nse[0]):.3f}   "
        f"{nse[1]:.3f}   {nse[2]:.3f}   {out:4}"
    )


def main(runs: int = 200, *machines: str) -> None:
    """Print a line a machine."""
    print(
        f"{runs} runs of {POSES} poses\n"
        f"{'':14}  of   bound: base             bound: tool             error / bound    all     "
        "NSE: stated, estimated   rows"
    )
    for name in machines or MACHINES:
        print(line(name, runs), flush=True)


if __name__ == "__main__":
    main(int(sys.argv[1]) if len(sys.argv) > 1 else 200, *sys.argv[2:])
