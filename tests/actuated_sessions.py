"""Machines whose joints at A move, made by hand, at random poses and before cameras."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
from scipy.spatial.transform import RigidTransform, Rotation

from legcal.calibration.identify.session import Session, default_cameras
from legcal.geometry.motions import frame_on_points
from legcal.geometry.types import Array, BoolArray
from legcal.machine.actuator import Actuator, ActuatorKind
from legcal.machine.leg import JointType, Leg, LegKind
from legcal.machine.parameters import parametrize
from legcal.machine.rods import actuator_index, actuators_of, rod_mode

S = JointType.SPHERICAL
UP = np.array([0.0, 0.0, 1.0])
MACHINES = ("hexaglide", "6-rss", "linear-delta", "delta", "3-prs")


def _ring(radius: float, angles: Array, height: float = 0.0) -> Array:
    return np.stack(
        [radius * np.cos(angles), radius * np.sin(angles), np.full(len(angles), height)], axis=1
    )


@cache
def machine(name: str, seed: int = 0) -> tuple[tuple[Leg, ...], Array, Array]:
    """Return the legs of a machine in R_b and R_e, without symmetry, and R and t at readings 0.

    A Hexaglide is ``square`` whose second rod stands square to its rail at home.
    """
    rng = np.random.default_rng(seed)
    pairs = name in ("linear-delta", "delta")
    n = 3 if pairs or name == "3-prs" else 6
    angles = 2.0 * np.pi / n * np.arange(n) + (0.15 * (-1.0) ** np.arange(n) if n == 6 else 0.0)
    out = _ring(1.0, angles)
    turning = name in ("6-rss", "delta")
    arm = {"6-rss": 0.025, "delta": 0.2}.get(name, 0.0)
    size = 0.15 if name == "6-rss" else 0.4
    base, platform = (0.5 * size, 0.35 * size) if name == "6-rss" else (0.6 * size, 0.3 * size)
    centre = base * out
    side = np.cross(UP, out)
    w = side if name == "delta" else out
    joint = centre + arm * (out if name == "delta" else side)
    d = 0.9 * UP + 0.35 * out + 0.15 * side
    axis = w if turning else d / np.linalg.norm(d, axis=1)[:, None]
    legs = list[Leg]()
    for i in range(n):
        v = axis[i] + 0.02 * rng.normal(size=3)
        v /= np.linalg.norm(v)
        kind = ActuatorKind.REVOLUTE if turning else ActuatorKind.PRISMATIC
        travel = (-0.6, 0.6) if turning else (-0.25 * size, 0.25 * size)
        actuator = Actuator(f"motor{i + 1}", kind, v, centre[i], travel)
        for k in (-1.0, 1.0) if pairs else (0.0,):
            A = joint[i] + 0.06 * k * side[i] + 0.003 * size * rng.normal(size=3)
            B = platform * out[i] + 0.06 * k * side[i] + 0.003 * size * rng.normal(size=3)
            twist = 0.0 if pairs or n == 3 else 0.3 * (-1.0) ** i
            B = Rotation.from_rotvec(twist * UP).apply(B)
            base_axis = None
            length = np.linalg.norm(B + size * UP - A)
            if name == "3-prs":
                u = (B + size * UP - A) / length
                base_axis = np.cross(u, np.cross(side[i], u))
                base_axis /= np.linalg.norm(base_axis)
            if name == "square" and i == 1:
                u = (B + size * UP - A) / length
                v = v - (v @ u) * u
                actuator = replace(actuator, axis=v / np.linalg.norm(v))
            legs.append(
                Leg(
                    S if base_axis is None else JointType.REVOLUTE,
                    S,
                    LegKind.CONSTANT,
                    A,
                    B,
                    float(length),
                    base_axis=base_axis,
                    name=f"leg{len(legs) + 1}",
                    prismatic=actuator.joint,
                    actuator=actuator,
                )
            )
    return _in_own_frames(tuple(legs), size)


def _in_own_frames(legs: tuple[Leg, ...], height: float) -> tuple[tuple[Leg, ...], Array, Array]:
    """Return legs in the frames on the joints of :func:`frame_legs`, and R and t of home there."""
    frame = list(frame_legs(len(legs)))
    T_b = frame_on_points(np.array([legs[j].A for j in frame])).inv()
    T_e = frame_on_points(np.array([legs[j].B for j in frame])).inv()
    home = (T_b * RigidTransform.from_translation(height * UP) * T_e.inv()).as_matrix()
    R, t, found = home[:3, :3], home[:3, 3], []
    for j, leg in enumerate(legs):
        A, B = T_b.apply(leg.A), T_e.apply(leg.B)
        if j in frame:
            A[frame.index(j) :] = B[frame.index(j) :] = 0.0
        axis = None if leg.base_axis is None else T_b.rotation.apply(leg.base_axis)
        assert leg.actuator is not None
        actuator = leg.actuator.in_frame(T_b.as_matrix())
        leg = replace(leg, A=A, B=B, base_axis=axis, actuator=actuator)
        found.append(replace(leg, mode=rod_mode(leg, 0.0, R @ leg.B + t)))
    return tuple(found), R, t


def frame_legs(n_legs: int) -> tuple[int, ...]:
    """Return the legs that define the frames: on different actuators where there are pairs."""
    return (0, 2, 4) if n_legs == 6 else (0, 1, 2)


def poses_at(name: str, q: Array, seed: int = 0) -> tuple[Array, Array, BoolArray]:
    """Return R (k, 3, 3) and t (k, 3) at readings (k, n_actuators), and where they were found."""
    legs, R0, t0 = machine(name, seed)
    R, t = np.tile(R0, (len(q), 1, 1)), np.tile(t0, (len(q), 1))
    for part in np.repeat(np.linspace(0.25, 1.0, 4), (3, 3, 3, 8)):
        rows, values = [], []
        for leg, a in zip(legs, actuator_index(legs), strict=True):
            assert leg.actuator is not None
            arm = R @ leg.B
            d = arm + t - leg.actuator.at(leg.A, part * q[:, a])
            length = np.linalg.norm(d, axis=1)
            gradients = [(length - leg.q0, d / length[:, None])]
            if leg.base_axis is not None:
                v = leg.actuator.rotations(part * q[:, a]) @ leg.base_axis
                gradients.append((np.sum(v * d, axis=1), v))
            for value, by_d in gradients:
                values.append(value)
                rows.append(np.hstack([np.cross(arm, by_d), by_d]))
        step = -np.linalg.solve(np.stack(rows, axis=1), np.stack(values, axis=1)[..., None])[..., 0]
        size = np.linalg.norm(step[:, :3], axis=1, keepdims=True)
        step /= np.maximum(size / 0.2, 1.0)
        R, t = Rotation.from_rotvec(step[:, :3]).as_matrix() @ R, t + step[:, 3:]
    closed = np.abs(np.stack(values)).max(axis=0) < 1e-12
    tilt = np.einsum("ij,kij->k", R0, R) > 2.4  # a turn of 45 degrees
    return R, t, closed & tilt & (np.linalg.norm(t - t0, axis=1) < legs[0].q0)


@cache
def session(
    name: str, *, views: tuple[tuple[int, ...], ...] | None = None, images: int = 8, seed: int = 0
) -> Session:
    """Return what views of all legs show of a machine at random readings in its travel."""
    (legs, R0, t0), rng = machine(name), np.random.default_rng(seed)
    views = views or (tuple(range(len(legs))),) * 3
    n_poses = images * len(views)
    low, high = np.array([a.travel for a in actuators_of(legs)]).T
    readings = rng.uniform(low, high, (20 * n_poses, len(low)))
    R, t, good = poses_at(name, readings)
    assert good.sum() >= n_poses
    R, t, readings = (x[good][:n_poses] for x in (R, t, readings))
    seen = np.zeros((len(views), len(legs)), dtype=np.bool_)
    for row, view in zip(seen, views, strict=True):
        row[list(view)] = True
    A, B = np.array([leg.A for leg in legs]), np.array([R0 @ leg.B + t0 for leg in legs])
    names = tuple(leg.name for leg in legs)
    return Session(
        leg_names=names,
        legs=legs,
        frame_legs=frame_legs(len(legs)),
        parametrization=parametrize(names, legs, frame_legs(len(legs))),
        R=R,
        t=t,
        R_reached=R,
        t_reached=t,
        view=np.repeat(np.arange(len(views)), images),
        pose=np.arange(n_poses),
        seen=seen,
        cameras=default_cameras(A, B, views, True, rng),
        sigma_q=2e-6,
        unread=np.zeros((len(t), len(legs)), dtype=np.bool_),
        board=np.zeros(len(views), dtype=np.bool_),
    )
