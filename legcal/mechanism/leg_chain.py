"""One leg understood: its joints, its centres and its length law, from where its axes lie.

Nothing here reads names for meaning. All of it is worked out with the joints at zero, in the frame
of the base body: neither where the leg was cut nor where it hangs matters there.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.spatial.transform import RigidTransform

from legcal.errors import OutOfClass
from legcal.geometry.types import Array
from legcal.mechanism.axes import (
    CONCURRENT,
    PERPENDICULAR,
    Axis,
    Pivot,
    Step,
    nearest,
    off_square,
    parallel,
    pivot,
)
from legcal.mechanism.leg import PlatformLetter


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
    def twists(self) -> bool:
        """Whether an S joint lets the leg twist about itself."""
        return "S" in (self.base.letter, self.platform.letter)


@dataclass(frozen=True, eq=False)
class _Ends:
    """Both ends of a leg with all joints at zero: their joints, A, B, and the leg's direction."""

    base: Pivot
    platform: Pivot
    A: Array
    B: Array
    u: Array
    idle_spins: int


class _Zero:
    """The joints of a leg at zero, in the frame of the base body."""

    def __init__(self, steps: Sequence[Step], platform_origin: Array) -> None:
        self.steps = tuple(steps)
        self.poses = [RigidTransform.identity()]
        self.axes: list[Axis] = []
        for step in steps:
            T_near, T_far = (step.connection.T_body_joint[side] for side in (step.near, step.far))
            T = self.poses[-1] * T_near
            turns = step.connection.type != "sphere"
            direction = np.asarray(T.rotation.apply(step.axis)) if turns else None
            self.axes.append(Axis(step.name, np.asarray(T.translation), direction))
            self.poses.append(T * T_far.inv())
        self.platform_origin = np.asarray(self.poses[-1].apply(platform_origin))
        self.leg = next((s.connection.joint for s in steps if s.connection.joint), "") or ""


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
    zero = _Zero(steps, platform_origin)
    sliders = [i for i, s in enumerate(steps) if s.connection.type == "prismatic"]
    try:
        if not sliders:
            n_lower, ends = _rod(zero)
            return _chain(zero, n_lower, None, ends)
        if len(sliders) > 1 or sliders[0] == 0:
            raise OutOfClass(_misplaced(zero, sliders))
        return _chain(zero, sliders[0], steps[sliders[0]], _telescope(zero, sliders[0]))
    except OutOfClass as error:
        raise OutOfClass([f"{path}: {problem}" for problem in error.problems]) from error


def _misplaced(zero: _Zero, sliders: Sequence[int]) -> str:
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


def _telescope(zero: _Zero, slider: int) -> _Ends:
    """Return the ends of a leg with a slider."""
    step = zero.steps[slider]
    u = zero.axes[slider].along * (1.0 if step.near == 0 else -1.0)  # a joint moves its child
    base = pivot(zero.axes[:slider], u, zero.leg)
    platform = pivot(zero.axes[:slider:-1], u, zero.leg)
    base, platform, idle_spins = _with_spins(base, platform, u, zero.leg)
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
    ends = _Ends(base, platform, A, B, u, idle_spins)
    _check_axes(ends, zero.leg)
    return ends


_END = {"R": "platform axis", "U": "platform joint", "S": "platform joint", "": "slider"}


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


def _rod(zero: _Zero) -> tuple[int, _Ends]:
    """Return how many joints of a leg without slider are at the base, and its ends.

    A revolute along the rod passes through both centres, and may belong to either joint: the one
    that its origin is nearer to.
    """
    found: list[tuple[float, int, _Ends]] = []
    problems: dict[int, OutOfClass] = {}
    for n_lower in range(1, len(zero.steps)):
        try:
            ends = _rod_ends(zero, n_lower)
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


def _rod_ends(zero: _Zero, n_lower: int) -> _Ends:
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
    base, platform, idle_spins = _with_spins(base, platform, u, zero.leg)
    ends = _Ends(base, platform, A, B, u, idle_spins)
    if platform.letter == "":
        raise OutOfClass(
            f"the leg of joint '{zero.leg}' is outside the method: found a rod that only turns "
            "about itself at the platform, needed a joint there; correct its axes."
        )
    _check_axes(ends, zero.leg)
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


def _with_spins(base: Pivot, platform: Pivot, u: Array, leg: str) -> tuple[Pivot, Pivot, int]:
    """Return both joints with the revolutes along the leg made part of them, and the idle ones.

    A universal joint and a revolute along the leg are an S, on whichever end it stands: the leg
    twists freely. What is left turns the leg idly, if there is an S.
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


def _check_axes(ends: _Ends, leg: str) -> None:
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


def _chain(zero: _Zero, n_lower: int, slider: Step | None, ends: _Ends) -> LegChain:
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
                None if outer is None else np.asarray(own.rotation.inv().apply(outer)),
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
        u_lower=np.asarray(lower.rotation.inv().apply(ends.u)),
        u_upper=np.asarray(upper.rotation.inv().apply(ends.u)),
        reach=float((ends.B - ends.A) @ ends.u),
        u_zero=ends.u,
        T_zero=last,
        idle_spins=ends.idle_spins,
    )
