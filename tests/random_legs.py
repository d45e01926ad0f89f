"""Random legs of every kind that close at a pose, in closed form."""

import math
from dataclasses import replace

import numpy as np
from scipy.spatial.transform import Rotation

from legcal.geometry.lines import normal_basis
from legcal.geometry.types import Array
from legcal.machine.equations import leg_equations
from legcal.machine.leg import JointType, Leg, LegKind


def leg_and_pose(joints: str, seed: int) -> tuple[Leg, Array, Array]:
    """Return a random leg that closes at a random pose, R and t."""
    rng = np.random.default_rng(seed)
    R, t = Rotation.random(rng=rng).as_matrix(), rng.normal(size=3)
    return closed_leg(joints, R, t, rng), R, t


def closed_leg(
    joints: str,
    R: Array,
    t: Array,
    rng: np.random.Generator,
    kind: LegKind = LegKind.ACTUATED,
) -> Leg:
    """Return a random leg that closes at a pose; ``joints`` are RR, US, U (fixed) and so on."""
    base, platform = joints[0], joints[1:]
    A, B = rng.normal(size=3), rng.normal(size=3)
    u = R @ B + t - A
    u /= np.linalg.norm(u)
    a, b = Rotation.random(2, rng=rng).apply([0.0, 0.0, 1.0])
    if base == "R":
        a = np.cross(a, u) / np.linalg.norm(np.cross(a, u))
    if platform == "R":
        b = R.T @ (np.cross(b, u) / np.linalg.norm(np.cross(b, u)))
    if platform == "":
        b = R.T @ u
    leg = Leg(
        base_joint=JointType(base),
        platform_joint=JointType(platform),
        kind=kind,
        A=A,
        B=B,
        q0=float(np.linalg.norm(R @ B + t - A)) if kind is LegKind.CONSTANT else 0.4,
        base_axis=a if base == "R" or (base == "U" and platform != "S") else None,
        platform_axis=b if platform in ("R", "") or (platform == "U" and base != "S") else None,
        twist=None if "S" in joints else 0.0,
    )
    if leg.twist is None:
        return leg
    sine, cosine = (  # of the twist in (-pi/2, pi/2] with which it closes at the pose
        float(leg_equations(replace(leg, twist=twist), R[None], t[None]).values[0, -1])
        for twist in (0.0, -0.5 * np.pi)
    )
    angle = math.atan2(sine, cosine)
    return replace(leg, twist=angle - math.pi * math.ceil(angle / math.pi - 0.5))


def turned(vector: Array | None, axis: Array | None, angles: Array) -> Array | None:
    """Return an axis, or what is tied to it, turned about the basis normal to the axis."""
    if vector is None or axis is None:
        return None
    return Rotation.from_rotvec(angles @ normal_basis(axis)).apply(vector)


def changed(leg: Leg, local: Array) -> Leg:
    """Return a leg with A, B, length, axes and twist changed, as derivatives count them."""
    return replace(
        leg,
        A=leg.A + local[:3],
        B=leg.B + local[3:6],
        q0=leg.q0 + local[6],
        base_axis=turned(leg.base_axis, leg.base_axis, local[7:9]),
        platform_axis=turned(leg.platform_axis, leg.platform_axis, local[9:11]),
        twist=None if leg.twist is None else leg.twist + local[11],
    )
