"""What joints demand of a leg, in CasADi: the residuals of section 3.5.

They are those of the machine room's equations, here as functions of unknowns of step 4. ``local``
begins with B in R_e and the step of the platform pose (see :func:`moved_points`); the known part
of B (``held``), R and t at step zero and A follow. Axes are frames (3, 3): the nominal axis and its
normal basis as columns.
"""

from __future__ import annotations

from functools import cache

import casadi as ca
import numpy as np

from legcal.geometry import BoolArray
from legcal.machine import Leg
from legcal.paper.motions import moved_points, turned_frame, turned_points


def twisting_legs(legs: tuple[Leg, ...]) -> dict[tuple[str, str], BoolArray]:
    """Return which legs have a twist, (n_legs,), by their joints on base and platform."""
    kinds = {(g.base_joint, g.platform_joint): g for g in legs if g.twist is not None}
    return {
        joints: np.array(
            [g.twist is not None and (g.base_joint, g.platform_joint) == joints for g in legs]
        )
        for joints in kinds
    }


@cache
def direction_of_leg() -> ca.Function:
    """Return (B, step; held, R, t, A, u, basis, W) -> A B against u, in deviations (2,)."""
    local, known, leg = _leg(9)
    u, basis, W = ca.SX.sym("u", 3), ca.SX.sym("basis", 2, 3), ca.SX.sym("W", 2, 2)
    miss = W @ (basis @ leg / ca.dot(u, leg))
    return ca.Function("direction", [local, *known, u, basis, W], [miss])


@cache
def length_of_leg() -> ca.Function:
    """Return (B, step, q0; held, R, t, A, reading, sigma) -> |A B| less reading + q0, in sigmas."""
    local, known, leg = _leg(10)
    reading, sigma = ca.SX.sym("reading"), ca.SX.sym("sigma")
    miss = (ca.norm_2(leg) - (reading + local[9])) / sigma
    return ca.Function("length", [local, *known, reading, sigma], [miss])


@cache
def revolute_on_platform() -> ca.Function:
    """Return (B, step, turns; held, R, t, A, frame, sigma) -> v . u of (7), in sigmas."""
    local, known, leg = _leg(11)
    frame, sigma = ca.SX.sym("frame", 3, 3), ca.SX.sym("sigma")
    axis = _in_group(local, known, turned_frame(local[9:], frame)[:, 0])
    miss = ca.dot(axis, _unit(leg)) / sigma
    return ca.Function("revolute", [local, *known, frame, sigma], [miss])


@cache
def fixed_on_platform() -> ca.Function:
    """Return (B, step, turns; held, R, t, A, frame, sigma) -> u across v, in sigmas (2,)."""
    local, known, leg = _leg(11)
    frame, sigma = ca.SX.sym("frame", 3, 3), ca.SX.sym("sigma")
    across = _in_group(local, known, turned_frame(local[9:], frame)[:, 1:])
    miss = across.T @ _unit(leg) / sigma
    return ca.Function("fixed", [local, *known, frame, sigma], [miss])


@cache
def twist_of_leg(base_joint: str, platform_joint: str) -> ca.Function:
    """Return (B, step, turns of b, of a, twist; held, R, t, A, a, b, twist, sigma) -> sine.

    The residual is sin(angle - twist) of the inner axes about u, in sigmas; a and b are the frames
    of the axes at base and platform.
    """
    local, known, leg = _leg(14)
    a, b, twist, sigma = *_frames(), ca.SX.sym("twist"), ca.SX.sym("sigma")
    outer = _in_group(local, known, _outer(platform_joint, local[9:11], b))
    base = turned_frame(local[11:13], a)[:, 0]
    joints = base_joint, platform_joint
    miss = _twist_sine(joints, base, outer, _unit(leg), twist + local[13]) / sigma
    return ca.Function("twist", [local, *known, a, b, twist, sigma], [miss])


@cache
def closure_of_leg(base_joint: str, platform_joint: str) -> ca.Function:
    """Return (turns of b, of a, twist; u, R, a, b, twist, unit) -> sine over unit.

    That of :func:`twist_of_leg` where leg direction u and rotation R of the platform are known.
    """
    local, u, R = ca.SX.sym("local", 5), ca.SX.sym("u", 3), ca.SX.sym("R", 3, 3)
    a, b, twist, unit = *_frames(), ca.SX.sym("twist"), ca.SX.sym("unit")
    outer, base = R @ _outer(platform_joint, local[:2], b), turned_frame(local[2:4], a)[:, 0]
    miss = _twist_sine((base_joint, platform_joint), base, outer, u, twist + local[4])
    return ca.Function("closure", [local, u, R, a, b, twist, unit], [miss / unit])


def _twist_sine(joints: tuple[str, str], a: ca.SX, b: ca.SX, u: ca.SX, twist: ca.SX) -> ca.SX:
    """Return sin(angle - twist) of the inner axes of a leg about its direction u.

    The inner axis is the outer one across u for a universal joint, and the axis itself otherwise;
    a and b are those of base and platform in one frame.
    """
    p, w = (
        _unit(ca.cross(axis, u)) if joint == "U" else axis
        for joint, axis in zip(joints, (a, b), strict=True)
    )
    return ca.cos(twist) * ca.dot(u, ca.cross(p, w)) - ca.sin(twist) * ca.dot(p, w)


def _outer(platform_joint: str, turns: ca.SX, b: ca.SX) -> ca.SX:
    """Return the outer axis in R_e: of a leg fixed to the platform, the first across it."""
    return turned_frame(turns, b)[:, 1 if platform_joint == "" else 0]


def _leg(n_local: int) -> tuple[ca.SX, list[ca.SX], ca.SX]:
    """Return local unknowns, what is known (held, R, t, A), and the vector from A to B."""
    local, held, A = ca.SX.sym("local", n_local), ca.SX.sym("held", 3), ca.SX.sym("A", 3)
    R, t = ca.SX.sym("R", 3, 3), ca.SX.sym("t", 3)
    return local, [held, R, t, A], moved_points(local[3:9], R, t, local[:3] + held) - A


def _in_group(local: ca.SX, known: list[ca.SX], directions: ca.SX) -> ca.SX:
    """Return directions (3, n) of the platform in the frame of the group."""
    return turned_points(local[6:9], known[1] @ directions)


def _frames() -> tuple[ca.SX, ca.SX]:
    return ca.SX.sym("a", 3, 3), ca.SX.sym("b", 3, 3)


def _unit(vector: ca.SX) -> ca.SX:
    return vector / ca.norm_2(vector)
