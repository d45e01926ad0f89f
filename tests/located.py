"""Machines that stand somewhere in the world, and tool poses measured there."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path

import numpy as np
from csv_rows import write_rows
from scipy.spatial.transform import RigidTransform, Rotation

from legcal import Machine, ToolPoses, inverse_kinematics, load_mechanism, random_configurations
from legcal.calibration.location.frames import PosePairs, predicted, transforms
from legcal.geometry.motions import rotation_matrices
from legcal.geometry.types import Array

SIGMA_POSITION = 0.02e-3
SIGMA_ANGLE = float(np.radians(0.01))
BASE = RigidTransform.from_components([1.2, -0.7, 0.4], Rotation.from_rotvec([0.3, -2.1, 0.9]))
TOOL = RigidTransform.from_components([0.03, -0.02, 0.11], Rotation.from_rotvec([-1.0, 0.4, 2.0]))


@cache
def shipped(name: str) -> Machine:
    return load_mechanism(name)


@dataclass(frozen=True, eq=False)
class Located:
    """A machine in the world, and what was measured."""

    machine: Machine
    base: RigidTransform
    platform: Sequence[RigidTransform]
    poses: ToolPoses

    def rows(self, kept: Sequence[int]) -> ToolPoses:
        p, k = self.poses, list(kept)
        return replace(
            p,
            q=p.q[k],
            position=p.position[k],
            rotation=p.rotation[k],
            oriented=p.oriented[k],
            numbers=np.arange(1, len(k) + 1),
        )


def located(
    model: str | Machine,
    n: int = 20,
    *,
    noise: float = 1.0,
    platform: Sequence[RigidTransform] | None = None,
) -> Located:
    """Return a machine at BASE with a tool at TOOL, measured at poses of the workspace or these."""
    machine = shipped(model) if isinstance(model, str) else model
    chance = np.random.default_rng(1)
    if platform is None:
        drawn = random_configurations(machine, n, 1)
        q, platform = drawn.readings, drawn.poses
    else:
        q = np.array([inverse_kinematics(machine, T) for T in platform])
    tools = [BASE * T * TOOL for T in platform]
    turn = rotation_matrices(noise * SIGMA_ANGLE * chance.normal(size=(len(tools), 3)))
    poses = ToolPoses(
        q=q,
        position=np.array([T.translation for T in tools])
        + noise * SIGMA_POSITION * chance.normal(size=(len(tools), 3)),
        rotation=turn @ np.array([T.rotation.as_matrix() for T in tools]),
        oriented=np.ones(len(tools), dtype=np.bool_),
        numbers=np.arange(1, len(tools) + 1),
    )
    return Located(machine, BASE, platform, poses)


def frames_of(T_world_base: RigidTransform, T_platform_tool: RigidTransform) -> Array:
    """Return two rigid motions as frames (2, 3, 4)."""
    return np.array([T.as_matrix()[:3] for T in (T_world_base, T_platform_tool)])


def pairs_at(base: RigidTransform, tool: RigidTransform, n: int = 8) -> PosePairs:
    """Return exact tool poses of a platform that goes anywhere within 0.1 m and 30 degrees."""
    chance = np.random.default_rng(0)
    R = rotation_matrices(chance.uniform(-0.5, 0.5, (n, 3)))
    t = chance.uniform(-0.1, 0.1, (n, 3)) + np.array([0.0, 0.0, 0.4])
    blank = PosePairs(R, t, np.tile(np.eye(3), (n, 1, 1)), t, np.ones(n, dtype=np.bool_), 0.1)
    M, p = predicted(frames_of(base, tool), blank)
    return replace(blank, M=M, p=p)


def noisy(pairs: PosePairs, chance: np.random.Generator) -> PosePairs:
    n = len(pairs)
    return replace(
        pairs,
        p=pairs.p + SIGMA_POSITION * chance.normal(size=(n, 3)),
        M=rotation_matrices(SIGMA_ANGLE * chance.normal(size=(n, 3))) @ pairs.M,
    )


def frame_errors(frames: Array, base: RigidTransform, tool: RigidTransform) -> Array:
    """Return the step from the truth to frames, (12,)."""
    found = transforms(frames)
    return np.concatenate(
        [motion_error(T, true) for T, true in zip(found, (base, tool), strict=True)]
    )


def motion_error(T: RigidTransform, true: RigidTransform) -> Array:
    turn = (T.rotation * true.rotation.inv()).as_rotvec()
    return np.concatenate([T.translation - true.translation, turn])


def write_poses(
    path: Path, machine: Located, poses: ToolPoses | None = None
) -> list[dict[str, str]]:
    """Write the table of measured poses and return its rows."""
    poses = machine.poses if poses is None else poses
    joints = [str(machine.machine.legs[j].prismatic) for j in machine.machine.motors]
    rows = []
    for q, p, M in zip(poses.q, poses.position, poses.rotation, strict=True):
        numbers = dict(zip(joints, q[list(machine.machine.motors)], strict=True))
        numbers |= dict(zip("xyz", p, strict=True))
        quaternion = Rotation.from_matrix(M).as_quat()
        numbers |= dict(zip(("qx", "qy", "qz", "qw"), quaternion, strict=True))
        rows.append({name: repr(float(x)) for name, x in numbers.items()})
    write_rows(path, rows)
    return rows
