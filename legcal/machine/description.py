"""A machine described by a table, and the checks of its numbers."""

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from scipy.spatial.transform import RigidTransform, Rotation

from legcal.files.motions import motion_from_xyz_quat
from legcal.geometry.lines import distance_to_line
from legcal.geometry.types import Array
from legcal.machine.actuator import Actuator, ActuatorKind
from legcal.machine.classification import PERPENDICULAR
from legcal.machine.leg import (
    MAX_LENGTH,
    MAX_RADIUS,
    MIN_LENGTH,
    MIN_RADIUS,
    JointType,
    LegKind,
)

_TYPE = re.compile(r"([PR])([RUS])([RUS])|([RUS])(P?)([RUS]?)")

NEEDED_TYPE = (
    "R, U or S at the base, P for a slider, then R, U or S at the platform or nothing for a leg "
    "that is fixed there (UPS, SPU, RPR, UP, SS); for a rod that hangs on a motor P or R first "
    "(PSS, RSS, PRS)"
)


@dataclass(frozen=True)
class LegType:
    """The joints of a leg from base to platform, written as ``UPS``, ``SS``, ``PSS``."""

    base: JointType  # the joint at the base, or on the carriage or arm of a motor
    has_slider: bool  # whether there is a P along the leg
    platform: JointType  # the joint at the platform
    actuator: ActuatorKind | None = None  # the motor that carries the joint at A

    @property
    def has_sphere(self) -> bool:
        """Whether one of the joints is an S."""
        return self.base.twists_freely or self.platform.twists_freely

    @property
    def is_planar(self) -> bool:
        """Whether both joints are R, as in planar machines."""
        return self.base is self.platform is JointType.REVOLUTE

    def __str__(self) -> str:
        """Return the letters of the leg type."""
        motor = {None: "", ActuatorKind.PRISMATIC: "P", ActuatorKind.REVOLUTE: "R"}[self.actuator]
        return f"{motor}{self.base}{'P' * self.has_slider}{self.platform}"


def leg_type(text: str) -> LegType | None:
    """Return the leg type of a text such as ``UPS``, None for any other text."""
    match = _TYPE.fullmatch(text)
    if match is None:
        return None
    if match[1]:
        kind = ActuatorKind.PRISMATIC if match[1] == "P" else ActuatorKind.REVOLUTE
        return LegType(JointType(match[2]), False, JointType(match[3]), kind)
    if not (match[5] or match[6]):
        return None
    return LegType(JointType(match[4]), bool(match[5]), JointType(match[6]))


@dataclass(frozen=True, eq=False)
class LegEntry:
    """One leg as described."""

    name: str  # its name
    type: LegType  # joints
    kind: LegKind  # actuated, passive or without slider
    A_base: Array  # (3,) joint centre in the base link [m], with its motor at reading 0
    B_platform: Array  # (3,) joint centre in the platform link [m]
    offset: float | None  # length at reading zero [m] of an actuated leg, length of a constant one
    travel: tuple[float, float] | None  # lowest and highest reading [m]
    tube: float | None  # radius of the half at the base [m]
    rod: float | None  # radius of the half at the platform [m]
    base_axis: Array | None  # (3,) in the base link, at motor reading 0; None for the default
    platform_axis: Array | None  # (3,) in the platform link; None for the default
    actuator: Actuator | None = None  # the motor that carries A, in the base link


@dataclass(frozen=True, eq=False)
class Description:
    """A machine as described by a table."""

    name: str  # the name of the model and of its files
    source: str  # origin of the description, for messages: a path, or --family
    unit: str  # unit of the description, for messages
    legs: tuple[LegEntry, ...]  # the legs in order
    home: "Home | None"  # T_base_platform of a pose in which it closes
    base_frame: tuple[str, ...] | None  # the legs whose joints define R_b and R_e
    notes: tuple[str, ...] = ()  # assumptions
    home_readings: Mapping[str, float] = field(default_factory=dict)  # of motors [m or rad]


@dataclass(frozen=True, eq=False)
class Home:
    """A pose with its numbers as written."""

    xyz: tuple[float, ...]  # position [m]
    quat_xyzw: tuple[float, ...]  # unit quaternion, to its digits

    @classmethod
    def of(cls, xyz: tuple[float, ...], turn: Rotation) -> "Home":
        """Return a home with the quaternion of a rotation, rounded as in files."""
        return cls(xyz, tuple(float(x) for x in turn.as_quat(canonical=True)))

    def motion(self) -> RigidTransform:
        """Return T_base_platform."""
        return motion_from_xyz_quat(self.xyz, self.quat_xyzw)


def legs_in_words(names: Sequence[str]) -> str:
    """Return legs as the subject of a sentence."""
    quoted = [f"'{name}'" for name in names]
    return f"leg {quoted[0]}" if len(quoted) == 1 else f"legs {', '.join(quoted)}"


def home_at_height(described: Description, height: float, turn: Rotation | None) -> Description:
    """Return a machine whose platform is level at home, over the middle of the base.

    *height* is the height of the platform link over the base link [m]. Without *turn* the platform
    is turned about z, in whole degrees, so that its joints are nearest to those of the base; the
    middles of both are over each other to a whole millimetre.
    """
    A, B = _joints(described)
    if turn is None:
        base, platform = ((p - p.mean(axis=0))[:, :2] @ [1.0, 1.0j] for p in (A, B))
        angle = round(float(np.degrees(np.angle(np.sum(base * platform.conj())))))
        turn = Rotation.from_euler("z", angle, degrees=True)
    middle = A.mean(axis=0) - turn.apply(B.mean(axis=0))
    x, y = (round(float(value), 3) + 0.0 for value in middle[:2])
    return replace(described, home=Home.of((x, y, height), turn))


def joints_from_base(described: Description) -> Description:
    """Return a machine whose platform joints were given in the base link at home.

    The platform link has the axes of the base link and its origin in the middle of the joints.
    """
    origin = np.round(_joints(described)[1].mean(axis=0), 6) + 0.0
    legs = tuple(
        replace(leg, B_platform=np.round(leg.B_platform - origin, 12) + 0.0)
        for leg in described.legs
    )
    home = Home.of(tuple(origin.tolist()), Rotation.identity())
    note = (
        "Platform joints are in coordinates of the base at home: the platform link stands in their "
        f"middle, ({', '.join(f'{1e3 * x:.6g}' for x in origin)}) mm in the base link."
    )
    return replace(described, legs=legs, home=home, notes=(*described.notes, note))


def look_like_base(described: Description) -> list[str]:
    """Return the problem of platform joints that seem to be given in the base link, if any.

    They do if all motors are within their travel with both links coincident, the platform joints
    are away from those of the base, and the stated home is not this pose.
    """
    measured = [leg for leg in described.legs if leg.offset is not None and leg.travel is not None]
    if len(measured) < _MANY or (described.home is not None and _closes(described, described.home)):
        return []
    origin = Home.of((0.0, 0.0, 0.0), Rotation.identity())
    A, B = _joints(described)
    apart = float(np.linalg.norm(B.mean(axis=0) - A.mean(axis=0)))
    lengths = np.linalg.norm(B - A, axis=1)
    if 2.0 * apart < lengths.mean() or not _closes(described, origin):
        return []
    middle = np.round(1e3 * B.mean(axis=0), 2) + 0.0
    return [
        f"{described.source}: platform_joints could not be used: found joints around "
        f"({', '.join(f'{x:g}' for x in middle)}) mm, as far from the base joints as legs are "
        "long, which look like coordinates of the base at home, needed coordinates of the "
        "platform; write platform_in: base in the table (in a CSV a column platform_in), or "
        "platform_in: platform if they are right."
    ]


def _joints(described: Description) -> tuple[Array, Array]:
    """Return the joints of base and platform, each in its link, (n, 3) [m]."""
    A = np.array([leg.A_base for leg in described.legs])
    return A, np.array([leg.B_platform for leg in described.legs])


def _closes(described: Description, home: Home) -> bool:
    """Return whether all motors are inside their travel at a pose."""
    A, B = _joints(described)
    lengths = np.linalg.norm(np.asarray(home.motion().apply(B)) - A, axis=1)
    return all(
        leg.offset + leg.travel[0] - _SLACK * length
        <= length
        <= leg.offset + leg.travel[1] + _SLACK * length
        for leg, length in zip(described.legs, lengths.tolist(), strict=True)
        if leg.offset is not None and leg.travel is not None
    )


_SLACK = 2.5e-9  # tolerance of lengths, relative to the leg
_MANY = 3  # legs that hardly all fit by chance
ALONG = 1.0  # [deg] least angle of outer axis and leg; a U joint is singular if they coincide


def wrong_sizes(described: Description) -> list[str]:
    """Return the problems of radii, offsets and travels in themselves."""
    problems = []
    for leg in described.legs:
        if leg.offset is None:
            continue
        ends = leg.travel or (0.0, 0.0)
        for length in (leg.offset + ends[0], leg.offset + ends[1]):
            problems += _out_of_proportion(described, leg.name, length)[:1]
            if problems:
                return problems
    for side, joints in (
        ("base", [leg.A_base for leg in described.legs]),
        ("platform", [leg.B_platform for leg in described.legs]),
    ):
        reach = float(np.linalg.norm(np.ptp(joints, axis=0)))
        if reach > MAX_LENGTH:
            problems.append(
                f"{described.source}: the {side} joints could not be used: found them "
                f"{reach:.4g} m apart with lengths in {described.unit}, needed at most "
                f"{MAX_LENGTH:g} m; {_about_the_unit(described.unit, too_long=True)}."
            )
    for leg in described.legs:
        motor = leg.actuator
        if motor is None or not motor.turns:
            continue
        if distance_to_line(leg.A_base, motor.axis, motor.point) < MIN_LENGTH:
            problems.append(
                f"{described.source}: leg '{leg.name}' could not be used: found its base joint on "
                f"the axis of '{motor.joint}', which turns without moving it, needed an arm of "
                f"{1e3 * MIN_LENGTH:g} mm at least between them; correct the joint, or point and "
                "axis of the motor."
            )
    return problems


def wrong_lengths(described: Description, lengths: Array) -> list[str]:
    """Return the problems of leg lengths at home."""
    problems = list[str]()
    outside = list[tuple[str, float, float, float]]()
    for leg, length in zip(described.legs, lengths, strict=True):
        disproportions = _out_of_proportion(described, leg.name, float(length))
        if disproportions:
            return disproportions
        for radius in (leg.tube, leg.rod):
            if radius is not None and not MIN_RADIUS < radius / length < MAX_RADIUS:
                return [
                    f"{described.source}: leg '{leg.name}' could not be used: found a radius of "
                    f"{1e3 * radius:.4g} mm on a length of {1e3 * length:.4g} mm, needed "
                    f"{MIN_RADIUS:g} to {MAX_RADIUS:g} of the length; correct radius and its unit."
                ]
        if leg.kind is LegKind.CONSTANT or leg.travel is None:
            continue
        q0 = leg.offset or 0.0
        low, high = q0 + leg.travel[0], q0 + leg.travel[1]
        if not low - _SLACK * length <= length <= high + _SLACK * length:
            outside.append((leg.name, 1e3 * float(length), 1e3 * low, 1e3 * high))
    if outside:
        shortest, longest = (f(x[1] for x in outside) for f in (min, max))
        there = f"{shortest:.6g} mm" + f" to {longest:.6g} mm" * (longest - shortest > 1e-6)
        least, most = min(x[2] for x in outside), max(x[3] for x in outside)
        problems.append(
            f"{described.source}: {legs_in_words([name for name, *_ in outside])} cannot close at "
            f"home: found the length {there} there, needed {least:.6g} to {most:.6g} mm (offset "
            "plus travel); correct home, offsets or travel."
        )
    return problems


def _out_of_proportion(described: Description, leg: str, length: float) -> list[str]:
    """Return the problem of an implausible leg length, if any."""
    if MIN_LENGTH <= length <= MAX_LENGTH:
        return []
    where = f"{described.source}: leg '{leg}' could not be used: found a length of {length:.4g} m"
    return [
        f"{where} with lengths in {described.unit}, needed {MIN_LENGTH:g} to {MAX_LENGTH:g} m; "
        f"{_about_the_unit(described.unit, too_long=length > MAX_LENGTH, positive=length > 0.0)}."
    ]


def _about_the_unit(unit: str, *, too_long: bool, positive: bool = True) -> str:
    """Return the remedy for implausible sizes."""
    if not positive:
        return "correct its joints, offset or travel (length = offset + reading)"
    if unit == "m" and too_long:
        return "these look like mm values where m are stated: check the unit"
    if unit == "mm" and not too_long:
        return "these look like m values where mm are stated: check the unit"
    return "check the numbers and the unit"


def wrong_axes(
    described: Description, entry: LegEntry, u: Array, axes: tuple[Array, Array]
) -> list[str]:
    """Return the problems of axes that do not fit their leg at home."""
    problems = []
    for side, joint, axis in (
        ("base", entry.type.base, axes[0]),
        ("platform", entry.type.platform, axes[1]),
    ):
        angle = float(np.degrees(np.arccos(np.clip(abs(axis @ u), 0.0, 1.0))))
        if joint is JointType.REVOLUTE and 90.0 - angle > np.degrees(PERPENDICULAR):
            problems.append(
                f"{described.source}: the {side} axis of leg '{entry.name}' could not be used: "
                f"found it at {angle:.4g} deg to the leg at home, needed 90 deg for an R joint; "
                f"correct {side}_axes or home."
            )
        if joint is JointType.UNIVERSAL and angle < ALONG:
            problems.append(
                f"{described.source}: the {side} axis of leg '{entry.name}' could not be used: "
                f"found it along the leg at home ({angle:.3g} deg), where a U joint is singular; "
                f"needed it across the leg; correct {side}_axes or home."
            )
    return problems
