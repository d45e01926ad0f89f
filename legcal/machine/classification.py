"""A leg classified from its joints: types of its end joints, A, B, length law, axes and twist.

A leg is analysed with all its joints at zero, in the frame of the base body. The revolutes and
spheres before and after its slider, or on both sides of the best split of a rod, form one R, U or
S joint each; revolutes along the leg only spin it.
"""

import math
from collections.abc import Iterable, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from scipy.spatial.transform import RigidTransform

from legcal.errors import OutOfClass
from legcal.geometry.lines import cross, normal_basis
from legcal.geometry.motions import matrix_applied, matrix_inverse, matrix_product
from legcal.geometry.types import Array
from legcal.machine.actuator import Actuator, ActuatorKind
from legcal.machine.chain import Connection
from legcal.machine.leg import PERPENDICULAR, Axis, JointType, Leg, LegChain, LegKind, Pivot

CONCURRENT = 1.5e-5  # largest gap of axes that meet, relative to the span of the joints
NOT_CALIBRATED = "this machine cannot be calibrated with legcal"
_CENTRES = (
    "a joint whose centre is fixed in the base, at most one slider and "
    "one motor for each leg, and a joint whose centre is "
    "fixed in the platform, or a motor that moves the joint at A and then a rod"
)


def joint_tolerance(joints: Iterable[Sequence[Array] | Array]) -> float:
    """Return the largest gap [m] of axes that meet, from the joints on base and on platform.

    For a single joint on each (refused later) the tolerance is that of a machine of one metre.
    """
    spans = [float(np.linalg.norm(np.ptp(points, axis=0))) for points in joints if len(points)]
    return CONCURRENT * (max(spans, default=0.0) or 1.0)


def classify_leg(
    steps: Sequence[Connection],
    platform_origin: Array,
    path: Path,
    within: float,
    motors: Sequence[str] = (),
) -> LegChain:
    """Return a leg from its joints and an origin of the platform body (that of the platform link).

    Axes that meet may be *within* [m] (:func:`joint_tolerance`) of each other. If the first joint
    is one of the *motors* and the others form a rod with a joint at each end, this motor carries
    the rod.

    Raises OutOfClass if the leg is not a joint, at most one slider, and a joint, with axes that the
    method supports.
    """
    poses, axes = [np.eye(4)], list[Axis]()
    for step in steps:
        T_near, T_far = step.T_body_joint
        T = matrix_product(poses[-1], T_near)
        direction = None if step.axis is None else T[:3, :3] @ step.axis
        axes.append(Axis(step.name, T[:3, 3], direction))
        poses.append(matrix_product(T, matrix_inverse(T_far)))
    sliders = [i for i, s in enumerate(steps) if s.type == "prismatic"]
    leg = next((s.joint for s in steps if s.joint), "") or ""
    hangs = is_actuator(steps[0], motors) and len(steps) > 2
    try:
        carrier = None if sliders else _carrier(axes, poses[-1], platform_origin, leg, within)
        if carrier is not None:
            return LegChain(tuple(steps), tuple(poses), len(steps), None, *carrier)
        _check_sliders(steps, motors, leg, hangs=hangs)
        if hangs:
            n_lower, ends = _rod(axes[1:], leg, within, axes[0].name)
            chain = LegChain(tuple(steps), tuple(poses), n_lower + 1, None, *ends, steps[0])
            if steps[0].type == "revolute" and axes[0].distance(chain.A) < within:
                raise OutOfClass(
                    f"the leg of motor '{axes[0].name}' is not supported",
                    "the joint at A on the axis of the motor, which turns the rod and does not "
                    "move its joint",
                    "an arm between them",
                    "remove it from name_mot if it has no motor, otherwise this machine cannot be"
                    " calibrated with legcal",
                )
            return chain
        if sliders:
            origin = matrix_applied(poses[-1], platform_origin)
            n_lower, slider = sliders[0], steps[sliders[0]]
            towards = 1.0 if slider.is_forward else -1.0
            ends = _telescope(axes, n_lower, towards, origin, leg, within)
        else:
            slider, (n_lower, ends) = None, _rod(axes, leg, within)
    except OutOfClass as error:
        raise error.map_problems(lambda problem: problem.in_file(path)) from error
    return LegChain(tuple(steps), tuple(poses), n_lower, slider, *ends)


def is_actuator(step: Connection, motors: Sequence[str]) -> bool:
    """Return whether a joint on the base is a motor that may carry joints at A."""
    return step.joint in motors and step.type in ("prismatic", "revolute")


def _check_sliders(
    steps: Sequence[Connection], motors: Sequence[str], leg: str, *, hangs: bool
) -> None:
    """Check that a leg has no more than one slider or motor, and no slider on the base."""
    onward = [step.name for step in steps[1:] if step.type == "prismatic"]
    driven = [step.name for step in steps[1:] if step.joint in motors]
    n_sliders = len(onward) + (steps[0].type == "prismatic")
    found, remedy = None, "name the motor that moves the joint at A in name_mot"
    if hangs and (driven or onward):
        kind, name = ("a second motor", driven[0]) if driven else ("the slider", onward[0])
        found = f"{kind} '{name}' beyond the motor '{leg}' on the base"
        remedy = f"name only one of '{leg}' and '{name}' in name_mot, the one with a motor"
    elif not hangs and n_sliders > 1:
        found = f"{n_sliders} sliders"
    elif not hangs and n_sliders > len(onward):
        found = f"the slider '{leg}' on the base itself, so that the joint at A moves"
    if found is None:
        return
    raise OutOfClass(
        f"the leg of joint '{leg}' is not supported",
        found,
        _CENTRES,
        f"{remedy}, otherwise {NOT_CALIBRATED}",
    )


def actuator_of(
    chain: LegChain, T_body_base: Array, travel: tuple[float, float], link: str
) -> Actuator:
    """Return the motor that carries the rod of a chain, in the base link (at T_body_base)."""
    step = chain.actuator
    if step is None:
        raise ValueError("a leg without a motor on the base has no actuator")
    inverse = matrix_inverse(T_body_base)
    point, axis = step.line(0)
    sign = 1.0 if step.is_forward else -1.0  # a joint moves its child
    A, at = matrix_applied(inverse, chain.A), matrix_applied(inverse, point)
    direction = sign * (inverse[:3, :3] @ axis)
    turns = step.type == "revolute"
    return Actuator(
        joint=str(step.joint),
        kind=ActuatorKind.REVOLUTE if turns else ActuatorKind.PRISMATIC,
        axis=direction,
        point=at + ((A - at) @ direction) * direction if turns else at,
        travel=travel,
        link=link,
    )


def leg_of(
    name: str,
    chain: LegChain,
    T_body_link: tuple[Array, Array],
    *,
    travel: tuple[float, float],
    actuated: bool,
    spatial: bool,
    home: RigidTransform | None,
    actuator: Actuator | None = None,
) -> Leg:
    """Return a leg in the links of base and platform, given T_body_link of both.

    Planar machines have neither axes nor twists. *home* (T_base_platform) determines the sign of
    the length law.
    """
    T_base, T_platform = T_body_link
    A = matrix_applied(matrix_inverse(T_base), chain.A)
    u_last = chain.line_in(-1, chain.B)[1]
    B = matrix_applied(matrix_inverse(T_platform), chain.B_platform)
    sign, kind = 1, LegKind.CONSTANT
    if chain.slider is not None:
        length = None if home is None else float(np.linalg.norm(home.apply(B) - A))
        sign = _sign(chain.reach, travel, length)
        kind = LegKind.ACTUATED if actuated else LegKind.PASSIVE
    T_zero_platform = matrix_product(chain.poses[-1], T_platform)
    base_axis = _axis(chain, chain.base, T_base)
    platform_axis = _axis(chain, chain.platform, T_zero_platform)
    if chain.platform.type is JointType.FIXED:
        platform_axis = sign * (T_platform[:3, :3].T @ u_last)
    return Leg(
        base_joint=chain.base.type,
        platform_joint=chain.platform.type,
        kind=kind,
        A=A,
        B=B,
        q0=sign * chain.reach,
        base_axis=base_axis if spatial else None,
        platform_axis=platform_axis if spatial else None,
        twist=_twist(chain, sign, platform_axis, T_zero_platform) if spatial else None,
        name=name,
        prismatic=chain.motor,
        sign=sign,
        travel=travel,
        chain=chain,
        actuator=actuator,
    )


def _sign(reach: float, travel: tuple[float, float], length: float | None) -> int:
    """Return whether a leg grows (+1) or shrinks (-1) with its joint value.

    B is at reach + q along the slider. The side of A is the one whose length at home is within the
    travel, or, if both or neither are, the one at the middle of the travel.
    """
    if length is not None:
        inside = [travel[0] <= s * length - reach <= travel[1] for s in (1, -1)]
        if inside[0] != inside[1]:
            return 1 if inside[0] else -1
    return 1 if reach + 0.5 * (travel[0] + travel[1]) > 0.0 else -1


def _axis(chain: LegChain, pivot: Pivot, T_zero_link: Array) -> Array | None:
    """Return the axis of a joint in its link, None if it is no parameter."""
    if pivot.outer is None or (pivot.type is JointType.UNIVERSAL and chain.twists):
        return None
    return undirected(T_zero_link[:3, :3].T @ pivot.outer)


def _twist(
    chain: LegChain, sign: int, platform_axis: Array | None, T_zero_platform: Array
) -> float | None:
    """Return the angle about u between the inner axes of a leg without an S joint [rad]."""
    if chain.twists:
        return None
    p, w = chain.base.inner, chain.platform.inner
    if w is None and platform_axis is not None:
        w = T_zero_platform[:3, :3] @ normal_basis(platform_axis)[0]
    if p is None or w is None:
        raise ValueError("a leg without an S joint has an axis at both ends")
    angle = math.atan2(float(sign * chain.u @ cross(p, w)), float(p @ w))
    # modulo pi; just above -pi/2 is rounding, and means pi/2
    return angle - math.pi * math.ceil(angle / math.pi - 0.5 - 1e-10)


LegEnds = tuple[Pivot, Pivot, Array, Array, Array, int]  # base, platform, A, B, u, idle spins


def _pivot(axes: Sequence[Axis], along: Array | None, leg: str, within: float) -> Pivot:
    """Return the joint formed by consecutive spheres and revolutes.

    Three or more revolutes whose axes meet in one point are an S, two that meet at right angles a
    U. A revolute along the leg (whose direction may not be determined yet) only spins it. *axes*
    are ordered from base or platform to the leg, and meet *within* this distance [m].
    """
    if any(axis.direction is None for axis in axes):
        return Pivot(JointType.SPHERICAL, _centre(axes, leg, within), (), (), len(axes) - 1)
    lines = _distinct(axes, within)
    spare = len(axes) - len(lines)
    spins: tuple[Axis, ...] = ()
    if along is not None and 1 <= len(lines) <= 2 and parallel(lines[-1].along, along):
        *lines, spin = lines
        spins = (spin,)
    if len(lines) < 2:
        turns = JointType.REVOLUTE if lines else JointType.FIXED
        return Pivot(turns, None, tuple(lines), spins, spare)
    centre = _centre(lines, leg, within)
    if len(lines) > 2:
        return Pivot(JointType.SPHERICAL, centre, (), (), spare + len(lines) - 3)
    tilt = off_square(lines[0].along, lines[1].along)
    if tilt > PERPENDICULAR:
        raise OutOfClass(
            f"leg '{leg}' could not be classified",
            f"the axes of {_names(lines)} {np.degrees(tilt):.4g} deg from perpendicular",
            f"a universal joint within {np.degrees(PERPENDICULAR):.2g} deg",
            "correct their axes",
        )
    return Pivot(JointType.UNIVERSAL, centre, tuple(lines), (), spare)


def _distinct(axes: Sequence[Axis], within: float) -> list[Axis]:
    """Return the axes without repetitions of neighbours on one line."""
    lines: list[Axis] = []
    for axis in axes:
        same = (
            lines
            and parallel(lines[-1].along, axis.along)
            and lines[-1].distance(axis.point) <= within
        )
        if not same:
            lines.append(axis)
    return lines


def _centre(axes: Sequence[Axis], leg: str, within: float) -> Array:
    """Return the point (3,) [m] in which axes meet, the centre of a sphere if there is one."""
    sphere = next((axis for axis in axes if axis.direction is None), None)
    meeting = None if sphere is not None else axes[0].nearest(axes[1])
    centre = (sphere or axes[0]).point if meeting is None else meeting[0]
    is_parallel = sphere is None and meeting is None
    for axis in axes if sphere is not None else axes[1:]:
        miss = math.inf if is_parallel else axis.distance(centre)
        if miss > within:
            other = f"that of '{axes[0].name}'"
            if sphere is not None:
                other = f"the centre of {sphere.name}"
            far = "parallel to" if is_parallel else f"{1e3 * miss:.4g} mm from"
            raise OutOfClass(
                f"leg '{leg}' could not be classified",
                f"the axis of '{axis.name}' {far} {other}",
                f"axes that meet within {1e3 * within:.2g} mm in one joint at each end of the leg",
                "correct their origins",
            )
    return centre


def parallel(first: Array, second: Array) -> bool:
    """Return whether two unit directions are parallel, or opposite, within 1 mrad."""
    return bool(np.linalg.norm(cross(first, second)) < PERPENDICULAR)


def off_square(first: Array, second: Array) -> float:
    """Return the deviation of two unit directions from perpendicular [rad]."""
    return abs(float(np.arcsin(np.clip(first @ second, -1.0, 1.0))))


def undirected(axis: Array) -> Array:
    """Return the direction of a line, signed so that its last nonzero component is positive."""
    sized = axis[np.abs(axis) > 1e-9]
    return axis if len(sized) == 0 or sized[-1] > 0.0 else -axis


def _names(axes: Sequence[Axis]) -> str:
    """Return joints in words."""
    return " and ".join(f"'{axis.name}'" for axis in axes)


def _with_spins(base: Pivot, platform: Pivot, leg: str) -> tuple[Pivot, Pivot, int]:
    """Return both joints including the revolutes along the leg, and the number of idle ones.

    A universal joint and a revolute along the leg are an S, at whichever end the revolute is: the
    leg twists freely. If there is an S already, further revolutes spin the leg idly.
    """
    spare = [len(base.spins), len(platform.spins)]
    ends = [base, platform]
    for i in (0, 1):
        other = ends[1 - i].type
        if ends[i].type is JointType.UNIVERSAL and spare[1 - i] and not other.twists_freely:
            spare[1 - i] -= 1
            ends[i] = replace(ends[i], type=JointType.SPHERICAL, axes=())
    left, twisting = sum(spare), [end.type.twists_freely for end in ends]
    if ends[0].type is JointType.FIXED or (left and not any(twisting)):
        raise OutOfClass(
            f"the leg of joint '{leg}' is not supported",
            f"the axis of '{(*base.spins, *platform.spins)[0].name}' along the leg, and no S joint",
            "a joint at each end with an axis perpendicular to the leg within "
            f"{np.degrees(PERPENDICULAR):.2g} deg, or an S joint at one",
            f"correct its axis, otherwise {NOT_CALIBRATED}",
        )
    idle = left + base.spare + platform.spare + all(twisting)
    return ends[0], ends[1], idle


def _check_axes(base: Pivot, platform: Pivot, u: Array, leg: str) -> None:
    """Refuse revolute axes, and inner axes of legs without S, not perpendicular to the leg."""
    twists = base.type.twists_freely or platform.type.twists_freely
    for end in (base, platform):
        if end.type is JointType.REVOLUTE or (end.type is JointType.UNIVERSAL and not twists):
            tilt = off_square(end.axes[-1].along, u)
            if tilt > PERPENDICULAR:
                is_revolute = end.type is JointType.REVOLUTE
                axis_kind = "a revolute axis" if is_revolute else "an inner axis of a U joint"
                raise OutOfClass(
                    f"the leg of joint '{leg}' is not supported",
                    f"the axis of '{end.axes[-1].name}' {np.degrees(tilt):.4g} deg from "
                    "perpendicular to the leg",
                    f"{axis_kind} within {np.degrees(PERPENDICULAR):.2g} deg",
                    "correct it",
                )


def _rod(
    axes: Sequence[Axis], leg: str, within: float, on: str | None = None
) -> tuple[int, LegEnds]:
    """Return the number of base joints of a leg without slider, and its ends.

    A revolute along the rod passes through both centres and could belong to either joint; it is
    assigned to the one nearer to its origin. *on* is the motor that carries the rod, for messages.
    """
    splits: list[tuple[float, int, LegEnds]] = []
    problems: dict[int, OutOfClass] = {}
    for n_lower in range(1, len(axes)):
        try:
            ends = _split_rod(axes, n_lower, leg, within)
        except OutOfClass as error:
            problems[n_lower] = error
            continue
        lower, upper = axes[:n_lower], axes[n_lower:]
        away = [np.linalg.norm(axis.point - ends[2]) for axis in lower]
        away += [np.linalg.norm(axis.point - ends[3]) for axis in upper]
        splits.append((float(sum(away)), n_lower, ends))
    if splits:
        _, n_lower, ends = min(splits, key=lambda split: split[:2])
        return n_lower, ends
    places = _places(axes, within)
    if len(places) == 2:
        raise problems[len(places[0])]
    several = len(places) > 2
    where = f"{len(places)} joints in different places" if several else "all joints in one place"
    if on is not None:
        raise OutOfClass(
            f"the leg of motor '{on}' is not supported",
            f"no slider and {where} beyond it",
            "a rod of constant length with a joint at each end",
            NOT_CALIBRATED,
        )
    hangs = ", so that the rod hangs on a moving arm and the joint at A moves" * several
    raise OutOfClass(
        f"the leg of joint '{leg}' is not supported",
        f"no slider and {where}{hangs}",
        _CENTRES,
        f"name the motor that moves the joint at A in name_mot, otherwise {NOT_CALIBRATED}",
    )


def _carrier(
    axes: Sequence[Axis], pose: Array, platform_origin: Array, leg: str, within: float
) -> LegEnds | None:
    """Return the ends of a joint that holds the platform on the base itself, else None.

    It is a leg of constant length that is fixed to the platform, as the shin of an ankle on its
    universal joint. Where B is on the platform is arbitrary: it is as far from the joint as the
    machine is large, in a direction of the platform across the inner axis, towards the origin of
    the platform link if that is not in the joint.
    """
    if len(axes) > 3 or len(_places(axes, within)) > 1:
        return None
    base = _pivot(axes, None, leg, within)
    if base.spare or base.type is JointType.FIXED:
        return None
    A = axes[0].point if base.centre is None else base.centre
    towards = matrix_applied(pose, platform_origin) - A
    turns = np.array([axis.direction for axis in axes if axis.direction is not None]).reshape(-1, 3)
    if base.type is not JointType.SPHERICAL:
        inner = base.axes[-1].along
        towards = towards - (towards @ inner) * inner
    reach = within / CONCURRENT
    if np.linalg.norm(towards) < 1e-3 * reach:
        towards = cross(turns[0], turns[-1]) if len(turns) > 1 else normal_basis(
            turns[0] if len(turns) else np.array([1.0, 0.0, 0.0])
        )[0]  # fmt: skip
    u = towards / np.linalg.norm(towards)
    fixed = Pivot(JointType.FIXED, None, (), ())
    return base, fixed, A, A + reach * u, u, 0


def _split_rod(axes: Sequence[Axis], n_lower: int, leg: str, within: float) -> LegEnds:
    """Return the ends of a rod, given the number of joints at the base."""
    lower, upper = axes[:n_lower], axes[: n_lower - 1 : -1]
    # The joint centres, or the feet of the (common) perpendicular
    base, platform = _pivot(lower, None, leg, within), _pivot(upper, None, leg, within)
    if base.centre is None and platform.centre is None:
        v, w = base.axes[0], platform.axes[0]
        A, B = v.nearest(w) or (v.point, w.foot(v.point))  # if parallel, at the joint at the base
    else:
        A, B = base.near(platform.centre), platform.near(base.centre)
    length = float(np.linalg.norm(B - A))
    if length < within:
        raise OutOfClass(
            f"the leg of joint '{leg}' is not supported",
            "both its joints in one point",
            "a distance between them",
            "correct their origins",
        )
    u = (B - A) / length
    base, platform = _pivot(lower, u, leg, within), _pivot(upper, u, leg, within)
    base, platform, idle_spins = _with_spins(base, platform, leg)
    if platform.type is JointType.FIXED:
        raise OutOfClass(
            f"the leg of joint '{leg}' is not supported",
            "a rod that only turns about itself at the platform",
            "a joint there",
            "correct its axes",
        )
    _check_axes(base, platform, u, leg)
    return base, platform, A, B, u, idle_spins


def _places(axes: Sequence[Axis], within: float) -> list[list[Axis]]:
    """Return the joints of a leg without slider, split where their axes stop meeting."""
    places = [[axes[0]]]
    for axis in axes[1:]:
        if places[-1][-1].gap(axis) <= within:
            places[-1].append(axis)
        else:
            places.append([axis])
    return places


_END = {
    JointType.REVOLUTE: "platform axis",
    JointType.UNIVERSAL: "platform joint",
    JointType.SPHERICAL: "platform joint",
    JointType.FIXED: "slider",
}


def _telescope(
    axes: Sequence[Axis],
    slider: int,
    towards: float,
    platform_origin: Array,
    leg: str,
    within: float,
) -> LegEnds:
    """Return the ends of a leg with a slider (a joint index), which moves *towards* along its axis.

    If a joint has a centre, the axis of the leg is the line through it along the slider. Between
    two R joints it is the line along the slider that meets both axes; if these are parallel (planar
    machines), it is at the height of the origin of the slider joint.
    """
    u = towards * axes[slider].along  # a joint moves its child
    base = _pivot(axes[:slider], u, leg, within)
    platform = _pivot(axes[:slider:-1], u, leg, within)
    base, platform, idle_spins = _with_spins(base, platform, leg)
    origin = axes[slider].point
    A, B, miss = _on_slider(base, platform, u, origin)
    at_base = "axis" if base.centre is None else "centre"
    misfit = f"its axis through the {_END[platform.type]} misses the base joint {at_base}"
    for spin in (*base.spins, *platform.spins):
        if spin.distance(A) > miss:
            miss, misfit = spin.distance(A), f"the axis of '{spin.name}' misses that of the leg"
    if miss > within:
        raise OutOfClass(
            f"the leg of slider '{axes[slider].name}' is not supported",
            f"that {misfit} by {1e3 * miss:.4g} mm",
            f"at most {1e3 * within:.2g} mm",
            "correct the origins along the leg",
        )
    if platform.type is JointType.FIXED:
        B = A + ((platform_origin - A) @ u) * u
    _check_axes(base, platform, u, leg)
    return base, platform, A, B, u, idle_spins


_COPLANAR = 1e-12  # volume spanned by three unit directions, below which they are coplanar


def _on_slider(base: Pivot, platform: Pivot, u: Array, origin: Array) -> tuple[Array, Array, float]:
    """Return A and B on a line along the slider that meets both joints, and the miss distance."""
    A, B = base.centre, platform.centre
    v = base.axes[0] if base.type is JointType.REVOLUTE else None
    w = platform.axes[0] if platform.type is JointType.REVOLUTE else None
    if v is not None and w is not None:
        if parallel(v.along, w.along):
            across = cross(v.along, u)
            return v.foot(origin), w.foot(origin), abs(float((w.point - v.point) @ across))
        directions = np.stack([v.along, u, -w.along], axis=1)
        if abs(np.linalg.det(directions)) < _COPLANAR:  # an axis is not normal to the slider
            s, _, t = np.linalg.lstsq(directions, w.point - v.point)[0]
        else:
            s, _, t = np.linalg.solve(directions, w.point - v.point)
        return v.point + s * v.along, w.point + t * w.along, 0.0
    if A is None and v is not None:
        A = _crossing(v, u, origin if B is None else B)
    if B is None:
        B = origin if w is None or A is None else _crossing(w, u, A)
        if w is None and v is None:
            B = A
    if A is None or B is None:
        raise ValueError("a leg without any joint has no centre")
    between = B - A
    return A, B, float(np.linalg.norm(between - (between @ u) * u))


def _crossing(axis: Axis, u: Array, point: Array) -> Array:
    """Return the point of an axis nearest to a line."""
    ends = axis.nearest(Axis("", point, u))
    return axis.foot(point) if ends is None else ends[0]
