"""The residuals of step 4: what one leg says of the platform at one pose, as CasADi functions.

As in :mod:`legcal.stages.residuals`, each takes the unknowns that it depends on as one column, and
then what is known. The first are always B [m], less its coordinates that are known, and the step
of the pose (:func:`legcal.stages.motion.moved_points`); the pose at step zero (R, t) and A are
those of the leg's group.
"""

from __future__ import annotations

from functools import cache

import casadi as ca

from legcal.stages.motion import moved_points, turned_points


@cache
def direction_of_leg() -> ca.Function:
    """Return (B, step; held, R, t, A, u, basis, W) -> A B against u, in deviations (2,)."""
    local, known = ca.SX.sym("local", 9), _known()
    u, basis, W = ca.SX.sym("u", 3), ca.SX.sym("basis", 2, 3), ca.SX.sym("W", 2, 2)
    leg = _leg(local, known)
    miss = W @ (basis @ leg / ca.dot(u, leg))
    return ca.Function("direction", [local, *known, u, basis, W], [miss])


@cache
def length_of_leg() -> ca.Function:
    """Return (B, step, q0; held, R, t, A, reading, sigma) -> |A B| less reading + q0, in sigmas."""
    local, known = ca.SX.sym("local", 10), _known()
    reading, sigma = ca.SX.sym("reading"), ca.SX.sym("sigma")
    miss = (ca.norm_2(_leg(local, known)) - (reading + local[9])) / sigma
    return ca.Function("length", [local, *known, reading, sigma], [miss])


@cache
def revolute_on_platform() -> ca.Function:
    """Return (B, step, turns; held, R, t, A, v, basis, sigma) -> v . u of (7), in sigmas."""
    local, known, v, basis = ca.SX.sym("local", 11), _known(), *_axis("v")
    sigma = ca.SX.sym("sigma")
    axis = _carried(local, known, turned(local[9:], v, basis, v))
    miss = ca.dot(axis, _direction(local, known)) / sigma
    return ca.Function("revolute", [local, *known, v, basis, sigma], [miss])


@cache
def fixed_on_platform() -> ca.Function:
    """Return (B, step, turns; held, R, t, A, v, basis, sigma) -> u across v, in sigmas (2,)."""
    local, known, v, basis = ca.SX.sym("local", 11), _known(), *_axis("v")
    sigma = ca.SX.sym("sigma")
    across = turned(local[9:], v, basis, basis.T)
    across = turned_points(local[6:9], known[1] @ across)
    miss = across.T @ _direction(local, known) / sigma
    return ca.Function("fixed", [local, *known, v, basis, sigma], [miss])


@cache
def twist_of_leg(base_joint: str, platform_joint: str) -> ca.Function:
    """Return (B, step, turns of b, of a, twist; held, R, t, A, a, basis, b, basis, twist, sigma).

    The residual is sin(angle - twist) of the inner axes about u, in sigmas; see
    :mod:`legcal.mechanism.equations`.
    """
    local, known, a, b = ca.SX.sym("local", 14), _known(), _axis("a"), _axis("b")
    twist, sigma = ca.SX.sym("twist"), ca.SX.sym("sigma")
    first = b[1][0, :].T if platform_joint == "" else b[0]
    outer = _carried(local, known, turned(local[9:11], *b, first))
    base = turned(local[11:13], *a, a[0])
    u, tau = _direction(local, known), twist + local[13]
    miss = twist_sine((base_joint, platform_joint), base, outer, u, tau) / sigma
    return ca.Function("twist", [local, *known, *a, *b, twist, sigma], [miss])


@cache
def closure_of_leg(base_joint: str, platform_joint: str) -> ca.Function:
    """Return (turns of b, of a, twist; u, R, a, basis, b, basis, twist, unit) -> sine over unit.

    The residual of :func:`twist_of_leg` where leg direction u and rotation R of the platform are
    known.
    """
    local, a, b = ca.SX.sym("local", 5), _axis("a"), _axis("b")
    u, R, twist = ca.SX.sym("u", 3), ca.SX.sym("R", 3, 3), ca.SX.sym("twist")
    unit = ca.SX.sym("unit")
    first = b[1][0, :].T if platform_joint == "" else b[0]
    outer, base = R @ turned(local[:2], *b, first), turned(local[2:4], *a, a[0])
    miss = twist_sine((base_joint, platform_joint), base, outer, u, twist + local[4])
    return ca.Function("closure", [local, u, R, *a, *b, twist, unit], [miss / unit])


@cache
def miss_of_ray() -> ca.Function:
    """Return (step; R, t, point, end, centre) -> (R point + t) x end of (18) [m^2], (3,).

    Both vectors begin at the camera *centre*, from which the point's *end* was seen.
    """
    step, R, t = ca.SX.sym("step", 6), ca.SX.sym("R", 3, 3), ca.SX.sym("t", 3)
    point, end, centre = (ca.SX.sym(name, 3) for name in ("point", "end", "centre"))
    miss = ca.cross(moved_points(step, R, t, point) - centre, end - centre)
    return ca.Function("ray", [step, R, t, point, end, centre], [miss])


def twist_sine(joints: tuple[str, str], a: ca.SX, b: ca.SX, u: ca.SX, twist: ca.SX) -> ca.SX:
    """Return sin(angle - twist) of the inner axes of a leg about its direction u.

    The inner axis is the outer one across u for a universal joint, and the axis itself otherwise;
    a and b are those of base and platform in one frame.
    """
    p, w = (
        _unit(ca.cross(axis, u)) if joint == "U" else axis
        for joint, axis in zip(joints, (a, b), strict=True)
    )
    return ca.cos(twist) * ca.dot(u, ca.cross(p, w)) - ca.sin(twist) * ca.dot(p, w)


def turned(turns: ca.SX, axis: ca.SX, basis: ca.SX, vectors: ca.SX) -> ca.SX:
    """Return vectors (3, n) after the turns that move an axis with its basis (2, 3)."""
    return turned_points(0.5 * (basis.T @ turns), vectors)


def _known() -> tuple[ca.SX, ca.SX, ca.SX, ca.SX]:
    """Return symbols of the known part of B, of R and t at step zero, and of A."""
    return ca.SX.sym("held", 3), ca.SX.sym("R", 3, 3), ca.SX.sym("t", 3), ca.SX.sym("A", 3)


def _axis(name: str) -> tuple[ca.SX, ca.SX]:
    """Return symbols of a nominal axis and of its basis."""
    return ca.SX.sym(name, 3), ca.SX.sym(f"{name}_basis", 2, 3)


def _leg(local: ca.SX, known: tuple[ca.SX, ca.SX, ca.SX, ca.SX]) -> ca.SX:
    """Return the vector from A to B."""
    held, R, t, A = known
    return moved_points(local[3:9], R, t, local[:3] + held) - A


def _direction(local: ca.SX, known: tuple[ca.SX, ca.SX, ca.SX, ca.SX]) -> ca.SX:
    """Return the unit vector from A to B."""
    return _unit(_leg(local, known))


def _carried(local: ca.SX, known: tuple[ca.SX, ca.SX, ca.SX, ca.SX], vector: ca.SX) -> ca.SX:
    """Return a direction of the platform in the frame of the group."""
    return turned_points(local[6:9], known[1] @ vector)


def _unit(vector: ca.SX) -> ca.SX:
    return vector / ca.norm_2(vector)
