"""A leg in the links of base and platform, from its chain: centres, length law, axes and twist."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import cast

import numpy as np
from scipy.spatial.transform import RigidTransform

from legcal.errors import OutOfClass
from legcal.geometry import Array, distance_to_line, normal_basis, product
from legcal.machine.bodies import Connection
from legcal.machine.leg import JointLetter, Leg, LegKind, PlatformLetter

CONCURRENT = 10e-6  # [m]
PERPENDICULAR = 1e-3  # [rad]


@dataclass(frozen=True, eq=False)
class Step:
    """A connection as a leg passes it from base to platform.

    Attributes
    ----------
    connection : Connection
        The joint.
    near, far : int
        Which of its two bodies lies towards the base, and which towards the platform.
    axis : (3,) array
        Unit axis in the joint frame.
    """

    connection: Connection
    near: int
    far: int
    axis: Array

    @property
    def name(self) -> str:
        """The joint as a message names it."""
        return self.connection.joint or "the 3d closure"

    def line(self, side: int) -> tuple[Array, Array]:
        """Return a point [m] and the direction of the axis in the body of one side."""
        matrix = self.connection.T_body_joint[side].as_matrix()
        return matrix[:3, 3], matrix[:3, :3] @ self.axis

    def point(self, side: int, along: float) -> Array:
        """Return the point of the axis at a distance from the joint frame's origin [m]."""
        origin, direction = self.line(side)
        return origin + along * direction


@dataclass(frozen=True, eq=False)
class Axis:
    """The axis of a revolute, or the centre of a sphere.

    Attributes
    ----------
    name : str
        The joint.
    point : (3,) array
        A point of the axis: the joint's origin [m].
    direction : (3,) array or None
        Unit direction; None for a sphere.
    """

    name: str
    point: Array
    direction: Array | None

    @property
    def along(self) -> Array:
        """The direction of a revolute."""
        if self.direction is None:
            raise ValueError("a sphere has no axis")
        return self.direction

    def distance(self, point: Array) -> float:
        """Return how far a point is from the axis, or from the centre of a sphere [m]."""
        if self.direction is None:
            return float(np.linalg.norm(point - self.point))
        return float(distance_to_line(point, self.direction, self.point))

    def foot(self, point: Array) -> Array:
        """Return the point of the axis that is nearest to a point [m]."""
        return self.point + ((point - self.point) @ self.along) * self.along


@dataclass(frozen=True, eq=False)
class Pivot:
    """What the revolutes and spheres at one end of a leg make together.

    Attributes
    ----------
    letter : {"R", "U", "S", ""}
        The joint; empty where nothing turns but the leg about itself.
    centre : (3,) array or None
        Its centre [m]; None for R, which has an axis of possible ones.
    axes : tuple of Axis
        The axis of R; the outer one, fixed in base or platform, and the inner one of U.
    spins : tuple of Axis
        Revolutes along the leg that are not part of it.
    spare : int
        Freedoms that it has beyond those of its letter.
    """

    letter: PlatformLetter
    centre: Array | None
    axes: tuple[Axis, ...]
    spins: tuple[Axis, ...] = ()
    spare: int = 0


def pivot(axes: Sequence[Axis], along: Array | None, leg: str) -> Pivot:
    """Return the joint that consecutive spheres and revolutes make, from their geometry.

    Three or more revolutes whose axes meet in one point are an S, two that meet at right angles a
    U. A revolute along the leg turns nothing but the leg itself.

    Parameters
    ----------
    axes : sequence of Axis
        From the one fixed in base or platform to the one fixed in the leg.
    along : (3,) array or None
        The direction of the leg; None while it is not known.
    leg : str
        A joint that names the leg.

    Raises
    ------
    OutOfClass
        If the axes do not meet within 10 um, or a U is not at right angles.
    """
    spheres = [axis for axis in axes if axis.direction is None]
    if spheres:
        return _about(spheres[0], [axis for axis in axes if axis is not spheres[0]], leg)
    lines = _distinct(axes)
    spare = len(axes) - len(lines)
    spins: tuple[Axis, ...] = ()
    if along is not None and 1 <= len(lines) <= 2 and parallel(lines[-1].along, along):
        *lines, spin = lines
        spins = (spin,)
    if len(lines) < 2:
        return Pivot("R" if lines else "", None, tuple(lines), spins, spare)
    centre = _meeting(lines, leg)
    if len(lines) > 2:
        return Pivot("S", centre, (), (), spare + len(lines) - 3)
    tilt = off_square(lines[0].along, lines[1].along)
    if tilt > PERPENDICULAR:
        raise OutOfClass(
            f"leg '{leg}' could not be understood: the axes of {_names(lines)} are "
            f"{np.degrees(tilt):.4g} deg from perpendicular, needed a universal joint within "
            f"{np.degrees(PERPENDICULAR):.2g} deg; correct their axes."
        )
    return Pivot("U", centre, tuple(lines), (), spare)


def _about(sphere: Axis, others: Sequence[Axis], leg: str) -> Pivot:
    """Return an S joint made of a sphere and revolutes through its centre."""
    for axis in others:
        miss = axis.distance(sphere.point)
        if miss > CONCURRENT:
            raise OutOfClass(
                f"leg '{leg}' could not be understood: the axis of '{axis.name}' misses the centre "
                f"of {sphere.name} by {1e3 * miss:.4g} mm, needed one joint at each end of the leg "
                "within 0.01 mm; correct their origins."
            )
    return Pivot("S", sphere.point, (), (), len(others))


def _distinct(axes: Sequence[Axis]) -> list[Axis]:
    """Return axes, each only once where neighbours are one line."""
    lines: list[Axis] = []
    for axis in axes:
        same = (
            lines
            and parallel(lines[-1].along, axis.along)
            and lines[-1].distance(axis.point) <= CONCURRENT
        )
        if not same:
            lines.append(axis)
    return lines


def _meeting(lines: Sequence[Axis], leg: str) -> Array:
    """Return the one point where axes meet [m]."""
    points = []
    for one, two in pairwise(lines):
        near, far = nearest(one, two)
        gap = None if near is None or far is None else float(np.linalg.norm(far - near))
        if near is None or gap is None or gap > CONCURRENT:
            found = "are parallel" if gap is None else f"miss each other by {1e3 * gap:.4g} mm"
            raise OutOfClass(
                f"leg '{leg}' could not be understood: the axes of '{one.name}' and '{two.name}' "
                f"{found}, needed axes that meet within 0.01 mm; correct their origins."
            )
        points.append(near)
    apart = max(float(np.linalg.norm(point - points[0])) for point in points)
    if apart > CONCURRENT:
        raise OutOfClass(
            f"leg '{leg}' could not be understood: the axes of {_names(lines)} meet in two points "
            f"{1e3 * apart:.4g} mm apart, needed one point within 0.01 mm; correct their origins."
        )
    return points[0]


def nearest(one: Axis, two: Axis) -> tuple[Array, Array] | tuple[None, None]:
    """Return the points of two axes that are nearest to each other [m], None if parallel."""
    normal = np.cross(one.along, two.along)
    square = float(normal @ normal)
    if square < PERPENDICULAR**2:
        return None, None
    between = two.point - one.point
    on_one = float(np.cross(between, two.along) @ normal) / square
    on_two = float(np.cross(between, one.along) @ normal) / square
    return one.point + on_one * one.along, two.point + on_two * two.along


def parallel(one: Array, two: Array) -> bool:
    """Say whether two unit directions are parallel, or opposite, within 1 mrad."""
    return bool(np.linalg.norm(np.cross(one, two)) < PERPENDICULAR)


def off_square(one: Array, two: Array) -> float:
    """Return how far two unit directions are from perpendicular [rad]."""
    return abs(float(np.arcsin(np.clip(one @ two, -1.0, 1.0))))


def undirected(axis: Array) -> Array:
    """Return the direction of a line whose last component that is not zero is positive."""
    sized = axis[np.abs(axis) > 1e-9]
    return axis if len(sized) == 0 or sized[-1] > 0.0 else -axis


def _names(axes: Sequence[Axis]) -> str:
    """Return joints as a message names them."""
    return " and ".join(f"'{axis.name}'" for axis in axes)


@dataclass(frozen=True, eq=False)
class Ends:
    """Both ends of a leg with all joints at zero: their joints, A, B, and the leg's direction."""

    base: Pivot
    platform: Pivot
    A: Array
    B: Array
    u: Array
    idle_spins: int


class LegAtZero:
    """The joints of a leg at zero, in the frame of the base body."""

    def __init__(self, steps: Sequence[Step], platform_origin: Array) -> None:
        self.steps = tuple(steps)
        self.poses = [RigidTransform.identity()]
        self.axes: list[Axis] = []
        for step in steps:
            T_near, T_far = (step.connection.T_body_joint[side] for side in (step.near, step.far))
            T = product(self.poses[-1], T_near)
            turns = step.connection.type != "sphere"
            direction = T.as_matrix()[:3, :3] @ step.axis if turns else None
            self.axes.append(Axis(step.name, T.as_matrix()[:3, 3], direction))
            self.poses.append(product(T, T_far.inv()))
        self.platform_origin = np.asarray(self.poses[-1].apply(platform_origin))
        self.leg = next((s.connection.joint for s in steps if s.connection.joint), "") or ""


def with_spins(base: Pivot, platform: Pivot, u: Array, leg: str) -> tuple[Pivot, Pivot, int]:
    """Return both joints with the revolutes along the leg made part of them, and the idle ones.

    A universal joint and a revolute along the leg are an S, on whichever end it stands: the leg
    twists freely. What is left turns the leg idly, if there is an S.

    Raises
    ------
    OutOfClass
        If there is none, or nothing but a revolute along the leg at the base.
    """
    spare = [len(base.spins), len(platform.spins)]
    ends = [base, platform]
    for i in (0, 1):
        if ends[i].letter == "U" and spare[1 - i] and ends[1 - i].letter != "S":
            spare[1 - i] -= 1
            ends[i] = Pivot("S", ends[i].centre, (), ends[i].spins, ends[i].spare)
    left = sum(spare)
    letters = [end.letter for end in ends]
    if letters[0] == "":
        raise OutOfClass(
            f"the leg of joint '{leg}' is outside the method: found the axis of "
            f"'{base.spins[0].name}' along the leg, needed one perpendicular to it within "
            f"{np.degrees(PERPENDICULAR):.2g} deg; this machine cannot be calibrated this way."
        )
    if left and "S" not in letters:
        name = (*base.spins, *platform.spins)[0].name
        raise OutOfClass(
            f"the leg of joint '{leg}' is outside the method: found the axis of '{name}' along the "
            "leg, and no S joint; needed the inner axis of a universal joint perpendicular to the "
            f"leg within {np.degrees(PERPENDICULAR):.2g} deg; correct its axis."
        )
    idle = left + base.spare + platform.spare + (letters == ["S", "S"])
    return ends[0], ends[1], idle


def check_axes(ends: Ends, leg: str) -> None:
    """Refuse revolute axes, and inner axes of legs without S, that are not square to the leg."""
    without_s = "S" not in (ends.base.letter, ends.platform.letter)
    for end in (ends.base, ends.platform):
        if end.letter == "R" or (end.letter == "U" and without_s):
            tilt = off_square(end.axes[-1].along, ends.u)
            if tilt > PERPENDICULAR:
                what = "a revolute axis" if end.letter == "R" else "an inner axis of a U joint"
                raise OutOfClass(
                    f"the leg of joint '{leg}' is outside the method: found the axis of "
                    f"'{end.axes[-1].name}' {np.degrees(tilt):.4g} deg from perpendicular to the "
                    f"leg, needed {what} within {np.degrees(PERPENDICULAR):.2g} deg; correct it."
                )


def rod_ends(zero: LegAtZero) -> tuple[int, Ends]:
    """Return how many joints of a leg without slider are at the base, and its ends.

    A revolute along the rod passes through both centres, and may belong to either joint: the one
    that its origin is nearer to.

    Raises
    ------
    OutOfClass
        If no split makes two joints, each with one centre, and axes as the method needs them.
    """
    found: list[tuple[float, int, Ends]] = []
    problems: dict[int, OutOfClass] = {}
    for n_lower in range(1, len(zero.steps)):
        try:
            ends = _split_rod(zero, n_lower)
        except OutOfClass as error:
            problems[n_lower] = error
            continue
        lower, upper = zero.axes[:n_lower], zero.axes[n_lower:]
        away = [np.linalg.norm(axis.point - ends.A) for axis in lower]
        away += [np.linalg.norm(axis.point - ends.B) for axis in upper]
        found.append((float(sum(away)), n_lower, ends))
    if found:
        _, n_lower, ends = min(found, key=lambda split: split[:2])
        return n_lower, ends
    places = _places(zero.axes)
    if len(places) == 2:
        raise problems[len(places[0])]
    what = (
        f"no slider and {len(places)} joints in different places, so that the rod hangs on a "
        "moving arm and the joint at A moves"
        if len(places) > 2
        else "no slider and all joints in one place"
    )
    raise OutOfClass(
        f"the leg of joint '{zero.leg}' is outside the method: found {what}, needed a joint whose "
        "centre is fixed in the base, then a slider or a rod of constant length, and a joint whose "
        "centre is fixed in the platform; this machine cannot be calibrated this way."
    )


def _split_rod(zero: LegAtZero, n_lower: int) -> Ends:
    """Return the ends of a rod whose first joints are at the base."""
    lower, upper = zero.axes[:n_lower], zero.axes[: n_lower - 1 : -1]
    A, B = _on_rod(pivot(lower, None, zero.leg), pivot(upper, None, zero.leg))
    length = float(np.linalg.norm(B - A))
    if length < CONCURRENT:
        raise OutOfClass(
            f"the leg of joint '{zero.leg}' is outside the method: found both its joints in one "
            "point, needed a distance between them; correct their origins."
        )
    u = (B - A) / length
    base, platform = pivot(lower, u, zero.leg), pivot(upper, u, zero.leg)
    base, platform, idle_spins = with_spins(base, platform, u, zero.leg)
    ends = Ends(base, platform, A, B, u, idle_spins)
    if platform.letter == "":
        raise OutOfClass(
            f"the leg of joint '{zero.leg}' is outside the method: found a rod that only turns "
            "about itself at the platform, needed a joint there; correct its axes."
        )
    check_axes(ends, zero.leg)
    return ends


def _on_rod(base: Pivot, platform: Pivot) -> tuple[Array, Array]:
    """Return A and B of a rod: feet of the other centre, or of the common perpendicular."""
    A, B = base.centre, platform.centre
    if A is None and B is None:
        v, w = base.axes[0], platform.axes[0]
        A, B = nearest(v, w)
        if A is None or B is None:  # parallel: where the joint at the base was put
            A, B = v.point, w.foot(v.point)
    elif A is None and B is not None:
        A = base.axes[0].foot(B)
    elif B is None and A is not None:
        B = platform.axes[0].foot(A)
    if A is None or B is None:
        raise ValueError("a rod without any joint has no centre")
    return A, B


def _places(axes: Sequence[Axis]) -> list[list[Axis]]:
    """Split the joints of a leg without slider where their axes stop meeting."""
    places = [[axes[0]]]
    for axis in axes[1:]:
        last = places[-1]
        if axis.direction is None or last[-1].direction is None:
            line, sphere = (axis, last[-1]) if last[-1].direction is None else (last[-1], axis)
            meets = line.distance(sphere.point) <= CONCURRENT
        else:
            near, far = nearest(last[-1], axis)
            meets = (
                near is not None
                and far is not None
                and float(np.linalg.norm(near - far)) <= CONCURRENT
            )
        if meets:
            last.append(axis)
        else:
            places.append([axis])
    return places


_END = {"R": "platform axis", "U": "platform joint", "S": "platform joint", "": "slider"}


def telescope_ends(zero: LegAtZero, slider: int) -> Ends:
    """Return the ends of a leg whose slider is one of its joints, given by its index.

    Between joints with a centre the leg's axis is the line through one of them along the slider.
    Between two R it is the line along the slider that meets both axes; where these are parallel,
    as in a plane, its height along them is that of the slider's joint origin.

    Raises
    ------
    OutOfClass
        If that line misses a joint by more than 10 um, or an axis is not square to it.
    """
    step = zero.steps[slider]
    u = zero.axes[slider].along * (1.0 if step.near == 0 else -1.0)  # a joint moves its child
    base = pivot(zero.axes[:slider], u, zero.leg)
    platform = pivot(zero.axes[:slider:-1], u, zero.leg)
    base, platform, idle_spins = with_spins(base, platform, u, zero.leg)
    origin = zero.axes[slider].point
    A, B, miss = _on_slider(base, platform, u, origin)
    what = f"its axis through the {_END[platform.letter]} misses the base joint"
    for spin in (*base.spins, *platform.spins):
        if spin.distance(A) > miss:
            miss, what = spin.distance(A), f"the axis of '{spin.name}' misses that of the leg"
    if miss > CONCURRENT:
        raise OutOfClass(
            f"the leg of slider '{step.name}' is outside the method: {what} "
            f"{'axis' if base.letter == 'R' else 'centre'} by {1e3 * miss:.4g} mm, needed at most "
            "0.01 mm; correct the origins along the leg."
        )
    if platform.letter == "":
        B = A + ((zero.platform_origin - A) @ u) * u
    ends = Ends(base, platform, A, B, u, idle_spins)
    check_axes(ends, zero.leg)
    return ends


def _on_slider(base: Pivot, platform: Pivot, u: Array, origin: Array) -> tuple[Array, Array, float]:
    """Return A and B where a line along the slider meets both joints, and by how much it misses."""
    A, B = base.centre, platform.centre
    v = base.axes[0] if base.letter == "R" else None
    w = platform.axes[0] if platform.letter == "R" else None
    if v is not None and w is not None:
        if parallel(v.along, w.along):
            across = np.cross(v.along, u)
            return v.foot(origin), w.foot(origin), abs(float((w.point - v.point) @ across))
        s, _, t = np.linalg.solve(np.stack([v.along, u, -w.along], axis=1), w.point - v.point)
        return v.point + s * v.along, w.point + t * w.along, 0.0
    if A is None and v is not None:
        A = _crossing(v, u, origin if B is None else B)
    if B is None:
        B = origin if w is None or A is None else _crossing(w, u, A)
        if w is None and base.letter != "R":
            B = A
    if A is None or B is None:
        raise ValueError("a leg without any joint has no centre")
    between = B - A
    return A, B, float(np.linalg.norm(between - (between @ u) * u))


def _crossing(axis: Axis, u: Array, point: Array) -> Array:
    """Return the point of an axis that is nearest to a line."""
    on_axis, _ = nearest(axis, Axis("", point, u))
    return axis.foot(point) if on_axis is None else on_axis


@dataclass(frozen=True, eq=False)
class JointGroup:
    """A joint of the leg at base or platform, with its centre in the bodies that it joins.

    Attributes
    ----------
    letter : {"R", "U", "S", ""}
        Its type; empty where the leg is fixed to the platform.
    centre_near, centre_far : (3,) array
        The centre in the body towards the base, and in the one towards the platform [m].
    outer : (3,) array or None
        The axis of R, or the one of U that is fixed in base or platform, in that body.
    inner : (3,) array or None
        The axis of R, or the one of U that is fixed in the leg, with all joints of the leg at
        zero in the body of the base.
    """

    letter: PlatformLetter
    centre_near: Array
    centre_far: Array
    outer: Array | None
    inner: Array | None


@dataclass(frozen=True, eq=False)
class LegChain:
    """The chain of one leg, and its geometry.

    Attributes
    ----------
    steps : tuple of Step
        Its joints from base to platform.
    bodies : tuple of str
        The body after every joint but the last: all of the leg, without base and platform.
    n_lower : int
        Number of joints on the base side of the slider, or of the rod.
    base, platform : JointGroup
        The joints at both ends.
    slider : Step or None
        The prismatic joint; None for a leg of constant length.
    u_lower, u_upper : (3,) array
        For a slider, the direction in which its value moves the platform end, in the bodies on
        its base and platform side; else the direction from A to B.
    reach : float
        Position of B past A along that direction at joint value zero [m].
    u_zero : (3,) array
        That direction with all joints at zero, in the body of the base.
    T_zero : RigidTransform
        The body of the platform in that of the base, with all joints of the leg at zero.
    idle_spins : int
        Freedoms of the joints that turn nothing but the leg about itself.
    """

    steps: tuple[Step, ...]
    bodies: tuple[str, ...]
    n_lower: int
    base: JointGroup
    platform: JointGroup
    slider: Step | None
    u_lower: Array
    u_upper: Array
    reach: float
    u_zero: Array
    T_zero: RigidTransform
    idle_spins: int

    @property
    def motor(self) -> str | None:
        """The slider's joint, None for a rod."""
        return None if self.slider is None else self.slider.connection.joint

    @property
    def u_platform(self) -> Array:
        """The direction ``u_zero`` in the body of the platform, for a leg that is fixed to it."""
        return np.asarray(self.T_zero.rotation.inv().apply(self.u_zero))

    @property
    def twists(self) -> bool:
        """Whether an S joint lets the leg twist about itself."""
        return "S" in (self.base.letter, self.platform.letter)


def understand(steps: Sequence[Step], platform_origin: Array, path: Path) -> LegChain:
    """Return the geometry of a leg from its joints.

    Parameters
    ----------
    steps : sequence of Step
        Its joints from base to platform.
    platform_origin : (3,) array
        Origin of the platform link in the body of the platform [m].
    path : Path
        The file, for messages.

    Raises
    ------
    OutOfClass
        If it is not a joint, at most one slider, and a joint, with axes as the method needs them.
    """
    zero = LegAtZero(steps, platform_origin)
    sliders = [i for i, s in enumerate(steps) if s.connection.type == "prismatic"]
    try:
        if not sliders:
            n_lower, ends = rod_ends(zero)
            return _chain(zero, n_lower, None, ends)
        if len(sliders) > 1 or sliders[0] == 0:
            raise OutOfClass(_misplaced(zero, sliders))
        return _chain(zero, sliders[0], steps[sliders[0]], telescope_ends(zero, sliders[0]))
    except OutOfClass as error:
        raise OutOfClass([f"{path}: {problem}" for problem in error.problems]) from error


def _misplaced(zero: LegAtZero, sliders: Sequence[int]) -> str:
    """Return why the sliders of a leg are not where a leg has one."""
    found = (
        f"{len(sliders)} sliders"
        if len(sliders) > 1
        else f"the slider '{zero.axes[0].name}' on the base itself, so that the joint at A moves"
    )
    return (
        f"the leg of joint '{zero.leg}' is outside the method: found {found}, needed a joint whose "
        "centre is fixed in the base, at most one slider, and a joint whose centre is fixed in the "
        "platform; this machine cannot be calibrated this way."
    )


def _chain(zero: LegAtZero, n_lower: int, slider: Step | None, ends: Ends) -> LegChain:
    """Return a leg, every number in the body that it is fixed in."""
    lower, upper = zero.poses[n_lower], zero.poses[n_lower + (slider is not None)]
    last = zero.poses[-1]
    groups = []
    for end, centre, near, far, own in (
        (ends.base, ends.A, zero.poses[0], lower, zero.poses[0]),
        (ends.platform, ends.B, upper, last, last),
    ):
        outer, inner = (end.axes[0].along, end.axes[-1].along) if end.axes else (None, None)
        groups.append(
            JointGroup(
                end.letter,
                np.asarray(near.inv().apply(centre)),
                np.asarray(far.inv().apply(centre)),
                None if outer is None else outer @ own.as_matrix()[:3, :3],
                inner,
            )
        )
    return LegChain(
        steps=zero.steps,
        bodies=tuple(s.connection.bodies[s.far] for s in zero.steps[:-1]),
        n_lower=n_lower,
        base=groups[0],
        platform=groups[1],
        slider=slider,
        u_lower=ends.u @ lower.as_matrix()[:3, :3],
        u_upper=ends.u @ upper.as_matrix()[:3, :3],
        reach=float((ends.B - ends.A) @ ends.u),
        u_zero=ends.u,
        T_zero=last,
        idle_spins=ends.idle_spins,
    )


def leg_of(
    name: str,
    chain: LegChain,
    T_body_link: tuple[RigidTransform, RigidTransform],
    *,
    travel: tuple[float, float],
    actuated: bool,
    spatial: bool,
    home: RigidTransform | None,
) -> Leg:
    """Return a leg in the links of base and platform.

    Parameters
    ----------
    name : str
        Its name.
    chain : LegChain
        Its joints.
    T_body_link : tuple of RigidTransform
        The links of base and platform in their bodies.
    travel : tuple of float
        Limits of the slider [m].
    actuated : bool
        Whether its slider has a motor.
    spatial : bool
        Whether the mechanism moves in space; in a plane axes and twist say nothing.
    home : RigidTransform or None
        T_base_platform of a pose that tells the sign of the length law.
    """
    T_base, T_platform = T_body_link
    A_base = np.asarray(T_base.inv().apply(chain.base.centre_near))
    B_platform = np.asarray(T_platform.inv().apply(chain.platform.centre_far))
    sign, kind = 1, LegKind.CONSTANT
    if chain.slider is not None:
        length = None if home is None else float(np.linalg.norm(home.apply(B_platform) - A_base))
        sign = _sign(chain.reach, travel, length)
        kind = LegKind.ACTUATED if actuated else LegKind.PASSIVE
    base_axis = _axis(chain, chain.base, T_base)
    platform_axis = _axis(chain, chain.platform, T_platform)
    if chain.platform.letter == "":
        platform_axis = sign * np.asarray(T_platform.rotation.inv().apply(chain.u_platform))
    return Leg(
        name=name,
        base_joint=cast("JointLetter", chain.base.letter),
        platform_joint=chain.platform.letter,
        kind=kind,
        prismatic=chain.motor,
        A=A_base,
        B=B_platform,
        q0=sign * chain.reach,
        sign=sign,
        travel=travel,
        cylinders=(),
        base_axis=base_axis if spatial else None,
        platform_axis=platform_axis if spatial else None,
        twist=_twist(chain, sign, platform_axis, T_platform) if spatial else None,
    )


def _sign(reach: float, travel: tuple[float, float], length: float | None) -> int:
    """Return whether a leg grows (+1) or shrinks (-1) with its joint value.

    B stands at reach + q along the slider. Its length at home tells on which side of A, where
    only one of the two is within the travel; else the middle of the travel does.
    """
    if length is not None:
        inside = [travel[0] <= s * length - reach <= travel[1] for s in (1, -1)]
        if inside[0] != inside[1]:
            return 1 if inside[0] else -1
    return 1 if reach + 0.5 * (travel[0] + travel[1]) > 0.0 else -1


def _axis(chain: LegChain, group: JointGroup, T_body_link: RigidTransform) -> Array | None:
    """Return the axis of a joint in its link, where it is a parameter."""
    if group.outer is None or (group.letter == "U" and chain.twists):
        return None
    return undirected(np.asarray(T_body_link.rotation.inv().apply(group.outer)))


def _twist(
    chain: LegChain, sign: int, platform_axis: Array | None, T_platform: RigidTransform
) -> float | None:
    """Return the angle about u between the inner axes of a leg without an S joint [rad]."""
    if chain.twists:
        return None
    p, w = chain.base.inner, chain.platform.inner
    if w is None and platform_axis is not None:
        T_zero_link = chain.T_zero.rotation * T_platform.rotation
        w = np.asarray(T_zero_link.apply(normal_basis(platform_axis)[0]))
    if p is None or w is None:
        raise ValueError("a leg without an S joint has an axis at both ends")
    angle = math.atan2(float(sign * chain.u_zero @ np.cross(p, w)), float(p @ w))
    # modulo pi; just above -pi/2 is rounding, and means pi/2
    return angle - math.pi * math.ceil(angle / math.pi - 0.5 - 1e-10)
