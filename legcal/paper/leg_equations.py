"""The equations of a leg in CasADi: the residuals of section 3.5.

They are those of :mod:`legcal.machine.equations`, with all numbers of a leg and the platform pose
unknown; a test compares both. The local unknowns of every function are the numbers of a leg from
its third on (B, length, turns of the axes at base and platform, change of the twist), then the step
of the platform pose (see :func:`~legcal.paper.gibbs.moved_points`).
"""

from __future__ import annotations

from functools import cache
from typing import NamedTuple

import casadi as ca

from legcal.machine.equations import VectorOps, axis_in_leg, twist_residual
from legcal.machine.leg import EquationKind, JointType
from legcal.paper.gibbs import moved_points, turned_frame, turned_points

N_UNKNOWNS = 15


@cache
def direction_of_leg() -> ca.Function:
    """Return (local; B, R, t, A, u, basis, W) -> the direction of A B against u, whitened (2,).

    B is the known part of it, R and t are the pose at step zero.
    """
    leg = _SymbolicLeg.symbols()
    u, basis, W = ca.SX.sym("u", 3), ca.SX.sym("basis", 2, 3), ca.SX.sym("W", 2, 2)
    residual = W @ (basis @ leg.vector / ca.dot(u, leg.vector))
    return ca.Function("direction", [leg.local, *leg.known, u, basis, W], [residual])


@cache
def length_of_leg() -> ca.Function:
    """Return (local; B, R, t, A, reading, sigma) -> |A B| less reading + q0, in sigmas."""
    leg = _SymbolicLeg.symbols()
    reading, sigma = ca.SX.sym("reading"), ca.SX.sym("sigma")
    residual = (ca.norm_2(leg.vector) - (reading + leg.local[3])) / sigma
    return ca.Function("length", [leg.local, *leg.known, reading, sigma], [residual])


@cache
def constraint_of_leg(
    about: EquationKind, base_joint: JointType, platform_joint: JointType
) -> ca.Function:
    """Return (local; B, R, t, A, a, b, twist, sigma) -> residuals of a constraint, in sigmas.

    a and b are the frames (3, 3) of the axes at base and platform where turns are zero: an axis and
    its normal basis as columns. About the axis at the platform it is v . u of (7), about the
    direction in the platform both components of u across v, about the twist the sine of how far the
    inner axes are from it.
    """
    leg = _SymbolicLeg.symbols()
    a, b = ca.SX.sym("a", 3, 3), ca.SX.sym("b", 3, 3)
    twist, sigma = ca.SX.sym("twist"), ca.SX.sym("sigma")
    u, frame = leg.vector / ca.norm_2(leg.vector), leg.in_base(turned_frame(leg.local[6:8], b))
    if about is EquationKind.PLATFORM_AXIS:
        residual = ca.dot(frame[:, 0], u)
    elif about is EquationKind.DIRECTION_1:
        residual = frame[:, 1:].T @ u
    elif about is not EquationKind.TWIST:
        raise NotImplementedError(f"the steps have no equation for {about}")
    else:
        base = turned_frame(leg.local[4:6], a)[:, 0]
        outer = frame[:, 1 if platform_joint is JointType.FIXED else 0]
        total = twist + leg.local[8]
        residual = _sine_of_twist((base_joint, platform_joint), base, outer, u, total)
    observed = [*leg.known, a, b, twist, sigma]
    return ca.Function("constraint", [leg.local, *observed], [residual / sigma])


@cache
def closure_of_leg(base_joint: JointType, platform_joint: JointType) -> ca.Function:
    """Return (turns of a, of b, twist; u, R, a, b, twist, unit) -> sine of the twist over unit.

    As :func:`constraint_of_leg` has it, where direction u and rotation R of the platform are known.
    """
    local, u, R = ca.SX.sym("local", 5), ca.SX.sym("u", 3), ca.SX.sym("R", 3, 3)
    a, b = ca.SX.sym("a", 3, 3), ca.SX.sym("b", 3, 3)
    twist, unit = ca.SX.sym("twist"), ca.SX.sym("unit")
    base = turned_frame(local[:2], a)[:, 0]
    outer = R @ turned_frame(local[2:4], b)[:, 1 if platform_joint is JointType.FIXED else 0]
    sine = _sine_of_twist((base_joint, platform_joint), base, outer, u, twist + local[4])
    return ca.Function("closure", [local, u, R, a, b, twist, unit], [sine / unit])


def _sine_of_twist(
    joints: tuple[JointType, JointType], a: ca.SX, b: ca.SX, u: ca.SX, twist: ca.SX
) -> ca.SX:
    """Return the residual of the twist of a leg about its direction u.

    a and b are the outer axes at base and platform in one frame, of a leg fixed to the platform the
    first direction across it.
    """
    p, w = (
        axis_in_leg(joint, axis, u, _SYMBOLS) for joint, axis in zip(joints, (a, b), strict=True)
    )
    sine: ca.SX = twist_residual(p, w, u, twist, _SYMBOLS)
    return sine


_SYMBOLS = VectorOps(ca.dot, ca.cross, lambda v: v / ca.norm_2(v), ca.cos, ca.sin)


class _SymbolicLeg(NamedTuple):
    """A leg at an unknown pose."""

    local: ca.SX  # unknowns
    known: list[ca.SX]  # B in part, R, t, A
    vector: ca.SX  # from A to B

    @classmethod
    def symbols(cls) -> _SymbolicLeg:
        local, B, A = ca.SX.sym("local", N_UNKNOWNS), ca.SX.sym("B", 3), ca.SX.sym("A", 3)
        R, t = ca.SX.sym("R", 3, 3), ca.SX.sym("t", 3)
        vector = moved_points(local[9:], R, t, local[:3] + B) - A
        return cls(local, [B, R, t, A], vector)

    def in_base(self, directions: ca.SX) -> ca.SX:
        """Return directions (3, n) of the platform in the frame of the base."""
        return turned_points(self.local[12:], self.known[1] @ directions)
