"""Edges of legs in pictures, from known geometry: what recognition has to make sense of."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import RigidTransform, Rotation

from legcal.geometry.types import Array
from legcal.machine.leg import Cylinder
from legcal.perception.candidate_pairs import EdgeSegments, find_candidate_pairs
from legcal.perception.pair_matching import LegSegments, Picture, leg_segments
from legcal.vision.cylinder import outlines_of_axis

PIXEL = 1.0 / 600.0  # of the pictures, on the sensor plane
CORNERS = np.array([[-0.45, -0.36], [0.45, 0.36]])
SIZE = 0.4  # of the machine, about its mean leg length [m]
TUBE, ROD = 0.013, 0.009
CYLINDERS = (
    Cylinder("tube", TUBE, "base", 0.0, 0.24),
    Cylinder("rod", ROD, "platform", -0.24, 0.0),
)


@dataclass(frozen=True, eq=False)
class MachineSpec:
    """Joint centres of a machine on two plates, (n_legs, 3) [m]."""

    A: Array
    B: Array

    @property
    def n_legs(self) -> int:
        return len(self.A)

    def posed(self, T: RigidTransform) -> Array:
        """Return B in the base frame, where the platform stands at T."""
        return np.asarray(T.apply(self.B))


def machine(n_legs: int, rng: np.random.Generator | None = None) -> MachineSpec:
    """Return a machine whose legs stand around; a symmetric one without chance."""
    turn = 2.0 * np.pi * np.arange(n_legs) / n_legs
    aside = 0.25 * np.where(np.arange(n_legs) % 2, -1.0, 1.0) * (n_legs > 3)
    A = 0.22 * np.stack([np.cos(turn + aside), np.sin(turn + aside), 0.0 * turn], axis=1)
    B = 0.12 * np.stack([np.cos(turn - aside), np.sin(turn - aside), 0.0 * turn], axis=1)
    if rng is not None:
        A, B = A + rng.uniform(-0.03, 0.03, A.shape), B + rng.uniform(-0.03, 0.03, B.shape)
    return MachineSpec(A, B)


def platform(rng: np.random.Generator | None = None) -> RigidTransform:
    """Return where a platform stands: anywhere, or right above the base."""
    if rng is None:
        return RigidTransform.from_translation([0.0, 0.0, 0.38])
    turn = rng.uniform(-0.25, 0.25, 3)
    return motion([*rng.uniform(-0.06, 0.06, 2), rng.uniform(0.36, 0.42)], turn)


def motion(xyz: Sequence[float] | Array, turn: Sequence[float] | Array) -> RigidTransform:
    """Return the motion of a translation [m] and a rotation vector [rad]."""
    return RigidTransform.from_components(xyz, Rotation.from_rotvec(turn))


def camera(rng: np.random.Generator) -> RigidTransform:
    """Return T_base_camera of a camera somewhere around that looks at a machine, rolled."""
    turn, lift = rng.uniform(0.0, 2.0 * np.pi), rng.uniform(0.1, 0.8)
    away = np.array([np.cos(lift) * np.cos(turn), np.cos(lift) * np.sin(turn), np.sin(lift)])
    x = np.cross(-away, [0.0, 0.0, 1.0])
    x /= np.linalg.norm(x)
    upright = Rotation.from_matrix(np.column_stack([x, np.cross(-away, x), -away]))
    roll = Rotation.from_euler("z", rng.uniform(0.0, 2.0 * np.pi))
    where = np.array([0.0, 0.0, 0.2]) + rng.uniform(0.85, 1.2) * away
    return RigidTransform.from_components(where, upright * roll)


def pieces(A: Array, B: Array, cylinders: Sequence[Cylinder] = CYLINDERS) -> LegSegments:
    """Return what can be seen of legs that are all alike."""
    return leg_segments(A, B, [tuple(cylinders)] * len(A), np.arange(len(A)))


def edges(targets: LegSegments, T_base_camera: RigidTransform) -> Array:
    """Return the two outlines of each piece, brighter inside, (n, 2, 2, 2) on the sensor plane."""
    T = T_base_camera.inv()
    found = []
    for ends, radius in zip(targets.ends, targets.radius, strict=True):
        X = T.apply(ends)
        u = (X[1] - X[0]) / np.linalg.norm(X[1] - X[0])
        axis = X[:, :2] / X[:, 2:]
        normal = np.array([axis[0, 1] - axis[1, 1], axis[1, 0] - axis[0, 0]])
        both = []
        for h in outlines_of_axis(u, X[0], float(radius)):
            # Where the normals of the axis seen at its ends meet the outline.
            v = -(axis @ h[:2] + h[2]) / (normal @ h[:2])
            line = axis + v[:, None] * normal
            both.append(line if v[0] > 0.0 else line[::-1])
        found.append(both)
    return np.array(found).reshape(-1, 2, 2, 2)


def segments(lines: Array) -> EdgeSegments:
    """Return edges (..., 2, 2) as they are found."""
    lines = lines.reshape(-1, 2, 2)
    return EdgeSegments(lines, np.ones(len(lines)), PIXEL)


def clutter(n: int, rng: np.random.Generator) -> Array:
    """Return edges (n, 2, 2, 2) of bars that are no legs."""
    middle, turn = rng.uniform(0.9 * CORNERS[0], 0.9 * CORNERS[1], (n, 2)), rng.uniform(0, 6.3, n)
    along = np.stack([np.cos(turn), np.sin(turn)], axis=1)
    across = np.stack([-along[:, 1], along[:, 0]], axis=1)
    half, width = rng.uniform(0.03, 0.2, (n, 1)), rng.uniform(0.01, 0.04, (n, 1))
    one, two = middle + 0.5 * width * across, middle - 0.5 * width * across
    lines = [[one + half * along, one - half * along], [two - half * along, two + half * along]]
    return np.asarray(np.array(lines).transpose(2, 0, 1, 3))


def picture(
    nominal: tuple[Array, Array],
    true: tuple[Array, Array],
    T_base_camera: RigidTransform,
    rng: np.random.Generator,
    *,
    missing: float = 0.0,
    n_clutter: int = 0,
    noise: float = 0.0,
) -> Picture:
    """Return what a picture shows of the true legs, and what the nominal ones should show.

    A part of the pieces is missing; ends of edges have noise [px] across, and less is seen of them.
    """
    lines = edges(pieces(*true), T_base_camera)
    lines = lines[rng.random(len(lines)) >= missing]
    lines = np.concatenate([lines, clutter(n_clutter, rng)])
    if noise > 0.0:
        step = lines[..., 1, :] - lines[..., 0, :]
        part = rng.uniform(0.0, 0.15, (*step.shape[:2], 2, 1)) * [[1.0], [-1.0]]
        lines = lines + part * step[..., None, :] + noise * PIXEL * rng.normal(size=lines.shape)
    return Picture(find_candidate_pairs(segments(lines)), pieces(*nominal), CORNERS, SIZE)


def pictures(
    made: MachineSpec,
    T_base_camera: RigidTransform,
    platforms: Sequence[RigidTransform],
    rng: np.random.Generator,
    *,
    joint_error: float = 0.0,
    n_clutter: int = 0,
    **difficulty: float,
) -> list[Picture]:
    """Return pictures of a machine that differs from its model by a joint error [m]."""
    A = made.A + rng.uniform(-joint_error, joint_error, made.A.shape)
    off = rng.uniform(-joint_error, joint_error, made.B.shape)
    true = MachineSpec(A, made.B + off)
    return [
        picture(
            (made.A, made.posed(T)),
            (true.A, true.posed(T)),
            T_base_camera,
            rng,
            n_clutter=n_clutter,
            **difficulty,
        )
        for T in platforms
    ]


def apart(one: RigidTransform, two: RigidTransform) -> tuple[float, float]:
    """Return how far two camera poses are from each other: [m], [rad]."""
    off = one.inv() * two
    return float(np.linalg.norm(off.translation)), float(off.rotation.magnitude())
