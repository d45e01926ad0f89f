"""A machine as a table describes it, checked and put together.

:class:`Description` has what is stated, in metres. :func:`assemble` finds a pose in which the
machine closes, and completes lengths and axes of all legs there.
"""

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import combinations

import numpy as np
from scipy.spatial.transform import RigidTransform, Rotation

from legcal.errors import ModelError, Problems
from legcal.files.quantity import SHOWN_IN
from legcal.geometry.lines import cross, distance_to_line
from legcal.geometry.motions import frame_on_points, motion_of, pose_distance
from legcal.geometry.types import Array
from legcal.machine.actuator import Actuator, ActuatorKind
from legcal.machine.closing import solve_poses, solve_postures
from legcal.machine.equations import PoseEquations, posture_constraints
from legcal.machine.leg import (
    LINKS,
    MAX_LENGTH,
    MAX_RADIUS,
    MIN_LENGTH,
    MIN_RADIUS,
    EquationKind,
    JointType,
    Leg,
    LegKind,
)
from legcal.machine.rods import actuators_of, both_readings, first_rods, joints_at

MAX_NUMBER = 1e9  # largest number of a description, in any unit
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
    home: RigidTransform | None  # T_base_platform of a pose in which it closes
    base_frame: tuple[str, ...] | None  # the legs whose joints define R_b and R_e
    notes: tuple[str, ...] = ()  # assumptions
    home_readings: Mapping[str, float] = field(default_factory=dict)  # of motors [m or rad]
    reach: float | None = None  # of the platform from the z axis of the base [m]
    floor: float | None = None  # its lowest z [m]


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
    return replace(described, home=motion_of(turn.as_matrix(), np.array([x, y, height])))


def joints_from_base(described: Description) -> Description:
    """Return a machine whose platform joints were given in the base link at home.

    The platform link has the axes of the base link and its origin in the middle of the joints.
    """
    origin = np.round(_joints(described)[1].mean(axis=0), 6) + 0.0
    legs = tuple(
        replace(leg, B_platform=np.round(leg.B_platform - origin, 12) + 0.0)
        for leg in described.legs
    )
    note = (
        "Platform joints are in coordinates of the base at home: the platform link stands in their "
        f"middle, ({', '.join(f'{1e3 * x:.6g}' for x in origin)}) mm in the base link."
    )
    home, notes = motion_of(np.eye(3), origin), (*described.notes, note)
    return replace(described, legs=legs, home=home, notes=notes)


def check_links(described: Description, problems: Problems) -> None:
    """Note platform joints that seem to be given in the base link.

    They do if all motors are within their travel with both links coincident, the platform joints
    are away from those of the base, and the stated home is not this pose.
    """
    measured = [leg for leg in described.legs if leg.offset is not None and leg.travel is not None]
    if len(measured) < _MANY or (described.home is not None and _closes(described, described.home)):
        return
    A, B = _joints(described)
    apart = float(np.linalg.norm(B.mean(axis=0) - A.mean(axis=0)))
    if 2.0 * apart < np.linalg.norm(B - A, axis=1).mean() or not _closes(
        described, RigidTransform.identity()
    ):
        return
    middle = ", ".join(f"{x:g}" for x in np.round(1e3 * B.mean(axis=0), 2) + 0.0)
    problems.add(
        "platform_joints could not be used",
        f"joints around ({middle}) mm, as far from the base joints as legs are long, which look "
        "like coordinates of the base at home",
        "coordinates of the platform",
        "write platform_in: base in the table (in a CSV a column platform_in), or platform_in: "
        "platform if they are right",
    )


def _joints(described: Description) -> tuple[Array, Array]:
    """Return the joints of base and platform, each in its link, (n, 3) [m]."""
    A = np.array([leg.A_base for leg in described.legs])
    return A, np.array([leg.B_platform for leg in described.legs])


def _closes(described: Description, home: RigidTransform) -> bool:
    """Return whether all motors are inside their travel at a pose."""
    A, B = _joints(described)
    lengths = np.linalg.norm(np.asarray(home.apply(B)) - A, axis=1)
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
    """Return the problems of offsets and travels in themselves."""
    if all_revolute(described) and any(leg.actuator for leg in described.legs):
        return [
            f"{described.source}: this mechanism is not supported: found a planar machine whose "
            "joints at A move on carriages or arms, needed a machine in space, or sliders along "
            "the legs; this machine cannot be calibrated with legcal."
        ]
    for leg in described.legs:
        for end in leg.travel or (0.0,):
            length = MIN_LENGTH if leg.offset is None else leg.offset + end
            if problems := _wrong_length(described, f"leg '{leg.name}'", "a length of", length):
                return problems
    problems = list[str]()
    for side, joints in zip(LINKS, _joints(described), strict=True):
        reach = float(np.linalg.norm(np.ptp(joints, axis=0)))
        problems += _wrong_length(described, f"the {side} joints", "them apart by", reach, 0.0)
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
        if wrong := _wrong_length(described, f"leg '{leg.name}'", "a length of", float(length)):
            return wrong
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


def _wrong_length(
    described: Description, what: str, found: str, length: float, least: float = MIN_LENGTH
) -> list[str]:
    """Return the problem of a length [m] that is most likely in another unit, or none."""
    if least <= length <= MAX_LENGTH:
        return []
    unit, remedy = described.unit, "check the numbers and the unit"
    if length <= 0.0:
        remedy = "correct its joints, offset or travel (length = offset + reading)"
    elif unit == ("m" if length > MAX_LENGTH else "mm"):
        other = "mm" if unit == "m" else "m"
        remedy = f"these look like {other} values where {unit} are stated: check the unit"
    return [
        f"{described.source}: {what} could not be used: found {found} {length:.4g} m with lengths "
        f"in {unit}, needed {least:g} to {MAX_LENGTH:g} m; {remedy}."
    ]


def wrong_axes(
    described: Description, entry: LegEntry, u: Array, axes: tuple[Array, Array]
) -> list[str]:
    """Return the problems of outer axes of U joints along their leg at home."""
    problems = []
    for side, axis in zip(LINKS, axes, strict=True):
        angle = float(np.degrees(np.arccos(np.clip(abs(axis @ u), 0.0, 1.0))))
        if getattr(entry.type, side) is JointType.UNIVERSAL and angle < ALONG:
            problems.append(
                f"{described.source}: the {side} axis of leg '{entry.name}' could not be used: "
                f"found it along the leg at home ({angle:.3g} deg), where a U joint is singular; "
                f"needed it across the leg; correct {side}_axes or home."
            )
    return problems


TRIALS = 40
APART = 0.1  # least distance of two poses that are not the same [sizes of the machine, rad]
LIKELY = 1.2  # turn of a pose that is as likely as home, relative to that of home
CLOSED = 1e-10  # largest residual of a closed pose, relative to the size of the machine
ROUNDING = 1e-13
IN_SPACE = (0, 1, 2)  # legs that define frames, of a platform with all six freedoms
MAX_HOME_RESIDUAL = 0.01  # of a stated home, relative to the size; rounded digits give less
PARALLEL = 1e-9
FREE_TRAVEL = (0.5, 1.5)  # range of passive sliders without limits, relative to length at home


@dataclass(frozen=True, eq=False, kw_only=True)
class AssembledLeg(LegEntry):
    """A leg with all its numbers; its axes are in the base link at home."""

    travel: tuple[float, float]  # lowest and highest reading [m]; (0, 0) for a constant leg
    base_axis: Array  # (3,) of an R, or the outer one of a U
    platform_axis: Array  # (3,) of an R, or the outer one of a U
    u: Array  # (3,) direction from A to B at home, in the base link
    q0: float  # length at reading zero, or of a constant leg [m]
    q_home: float  # the reading of the motor that carries A at home [m or rad]


@dataclass(frozen=True, eq=False, kw_only=True)
class Assembled(Description):
    """A machine with all its numbers; home is a pose in which it closes, as in the file."""

    legs: tuple[AssembledLeg, ...]
    home: RigidTransform
    base_frame: tuple[str, ...]  # the legs whose joints define R_b and R_e
    planar: bool  # motion in the xy plane of base and platform


def assemble(described: Description) -> Assembled:
    """Return a described machine with its home, lengths and axes."""
    _refuse(wrong_sizes(described))
    T, notes = home_of_description(described)
    readings = _readings_at_home(described, T)
    A = np.array(
        [
            leg.A_base
            if (motor := leg.actuator) is None
            else motor.at(leg.A_base, np.array([readings[motor.joint]]))[0]
            for leg in described.legs
        ]
    )
    B = T.apply(np.array([leg.B_platform for leg in described.legs]))
    lengths = np.linalg.norm(B - A, axis=1)
    _refuse(wrong_lengths(described, lengths))
    u = (B - A) / lengths[:, None]
    tangents = np.array([across_leg(u[j], A[j] - A.mean(axis=0)) for j in range(len(A))])
    if all_revolute(described):
        tangents[:] = [0.0, 0.0, 1.0]
    legs, problems = [], []
    for j, entry in enumerate(described.legs):
        q = 0.0 if entry.actuator is None else readings[entry.actuator.joint]
        base_axis = platform_axis = tangents[j]
        if entry.base_axis is not None:
            turn = (
                np.eye(3) if entry.actuator is None else entry.actuator.rotations(np.array([q]))[0]
            )
            base_axis = np.asarray(turn @ entry.base_axis)
        if entry.platform_axis is not None:
            platform_axis = np.asarray(T.rotation.apply(entry.platform_axis))
        problems += wrong_axes(described, entry, u[j], (base_axis, platform_axis))
        length, travel = float(lengths[j]), entry.travel
        q0 = length if entry.kind is LegKind.CONSTANT else 0.0
        q0 = q0 if entry.offset is None else entry.offset
        if entry.kind is LegKind.CONSTANT:
            travel = (0.0, 0.0)
        elif travel is None:
            travel = (FREE_TRAVEL[0] * length - q0, FREE_TRAVEL[1] * length - q0)
        numbers = {"travel": travel, "base_axis": base_axis, "platform_axis": platform_axis}
        legs.append(AssembledLeg(**(vars(entry) | numbers), u=u[j], q0=q0, q_home=q))
    _refuse(problems)
    planar = all_revolute(described) and is_planar(legs, T)
    frame = _base_frame(described, 2 if _in_a_plane(legs) else 3)
    at_home = {name: readings[name] for name in described.home_readings}
    numbers = {"legs": tuple(legs), "home": T, "base_frame": frame, "home_readings": at_home}
    numbers["notes"] = (*described.notes, *notes)
    return Assembled(**(vars(described) | numbers), planar=planar)


def all_revolute(described: Description) -> bool:
    """Return whether all joints are R, as in planar mechanisms."""
    return all(leg.type.is_planar for leg in described.legs)


def _in_a_plane(legs: Sequence[AssembledLeg]) -> bool:
    """Return whether all axes are parallel revolutes across all legs."""
    n = legs[0].base_axis
    return all(
        leg.type.is_planar
        and np.linalg.norm(cross(axis, n)) < PARALLEL
        and abs(leg.u @ n) < PARALLEL
        for leg in legs
        for axis in (leg.base_axis, leg.platform_axis)
    )


def is_planar(legs: Sequence[AssembledLeg], T: RigidTransform) -> bool:
    """Return whether the plane of motion is the xy plane of base and platform link."""
    z = np.array([0.0, 0.0, 1.0])
    upright = np.linalg.norm(cross(legs[0].base_axis, z)) < PARALLEL
    return _in_a_plane(legs) and bool(upright) and bool(T.rotation.apply(z)[2] > 1.0 - 1e-15)


def across_leg(u: Array, outward: Array) -> Array:
    """Return the horizontal direction across a leg; across the way outward for upright legs."""
    x, _, z = np.eye(3)
    across = next(
        across
        for other in (u, outward, x)
        if np.linalg.norm(across := cross(z, other)) > 1e-6 * max(1.0, float(np.linalg.norm(other)))
    )
    across = across - (across @ u) * u
    return np.asarray(across / np.linalg.norm(across))


def _base_frame(described: Description, count: int) -> tuple[str, ...]:
    """Return the legs that define frames: as given, or 1, 3, 5 of six, or the first possible."""
    legs = described.legs
    if described.base_frame is not None:
        names = [leg.name for leg in legs]
        named = [names.index(name) for name in described.base_frame]
        if len(named) != count or _degenerate(described, named):
            raise ModelError(
                f"{described.source}: base_frame could not be used: found "
                f"{', '.join(described.base_frame)}, needed {count} legs whose joints on base and "
                "platform are not in one point or on one line; choose others, or leave it out."
            )
        return described.base_frame
    combos = list(combinations(range(len(legs)), count))
    if len(legs) == 6 and count == 3:
        combos.insert(0, (0, 2, 4))
    motors = [j if leg.actuator is None else leg.actuator.joint for j, leg in enumerate(legs)]
    combos.sort(key=lambda chosen: -len({motors[j] for j in chosen}))  # of different motors first
    for chosen in combos:
        if not _degenerate(described, chosen):
            return tuple(legs[j].name for j in chosen)
    raise ModelError(
        f"{described.source}: the frames of base and platform could not be built: found the joints "
        f"of the base or of the platform all in one point or on one line, needed {count} legs "
        "whose joints span them; correct base_joints or platform_joints."
    )


def _degenerate(described: Description, chosen: Sequence[int]) -> bool:
    """Return whether the joints of some legs define no frame."""
    try:
        for side in ("A_base", "B_platform"):
            frame_on_points(np.array([getattr(described.legs[j], side) for j in chosen]))
    except ValueError:
        return True
    return False


def _refuse(problems: list[str]) -> None:
    if problems:
        raise ModelError(problems)


def home_of_description(described: Description) -> tuple[RigidTransform, list[str]]:
    """Return a pose in which a machine closes, projected onto what its legs keep constant.

    If no home is given, all motors are at the middle of their travel; among such poses the one with
    the smallest rotation of the platform is taken, and of mirror images in the plane of the base
    joints the one on the positive side of z. A note names another pose that is as likely.
    """
    if described.home is not None:
        return _project(described, described.home), []
    homes = _search(described, turning=False) or _search(described, turning=True)
    if not homes:
        raise ModelError(
            f"{described.source}: no home was found: no pose has all motors at the middle of "
            "their travel with their axes in place, needed a pose in which the machine closes; "
            "write home, or correct the joints, offsets or travel."
        )
    where = [
        f"({', '.join(f'{round(1e3 * x) + 0:d}' for x in T.translation)}) mm, turned by "
        f"{round(T.rotation.as_euler('ZYX', degrees=True)[0]) + 0:d} deg about z"
        for T in homes[:2]
    ]
    note = (
        f"Two poses have all motors at mid-travel: home is {' and not '.join(where)}. If yours is "
        "the other, give --height, or in the table home (YAML) or the joints of the platform as "
        "they are at home in the base link ('B1 (home)')."
    )
    return homes[0], [note] if len(homes) > 1 else []


def _legs_to_close(described: Description) -> tuple[Leg, ...]:
    """Return the legs as described; a constant length that is not stated may be any.

    In a plane axes are z unless they are stated, and those of a leg are parallel: its twist is 0.
    """
    planar = all_revolute(described)
    z = np.array([0.0, 0.0, 1.0]) if planar else None
    legs = []
    for entry in described.legs:
        is_open = entry.kind is LegKind.CONSTANT and entry.offset is None
        travel = entry.travel if entry.actuator is None else entry.actuator.travel
        leg = Leg(
            entry.type.base,
            entry.type.platform,
            LegKind.PASSIVE if is_open else entry.kind,
            entry.A_base,
            entry.B_platform,
            entry.offset or 0.0,
            z if entry.base_axis is None else entry.base_axis,
            z if entry.platform_axis is None else entry.platform_axis,
            twist=0.0 if planar else None,
            name=entry.name,
            travel=travel or (0.0, 0.0),
            actuator=entry.actuator,
        )
        legs.append(leg)
    return tuple(legs)


def _size(legs: Sequence[Leg]) -> float:
    """Return the extent of the joints of a machine, or its longest constant leg [m]."""
    spread = max(float(np.ptp([getattr(x, end) for x in legs], axis=0).max()) for end in "AB")
    return max(spread, 1e-3, *(leg.q0 for leg in legs if leg.kind is LegKind.CONSTANT))


def _candidates(leg: Leg, T: RigidTransform, stated: float | None = None) -> list[float]:
    """Return the two readings at which a rod reaches a pose.

    The first is the one inside the travel, or the one nearer to the stated reading.
    """
    readings, (low, high) = both_readings(leg, np.asarray(T.apply(leg.B))), leg.travel
    if stated is not None:
        return sorted(readings, key=lambda q: abs(q - stated))
    return sorted(readings, key=lambda q: max(low - q, q - high, 0.0))


def _readings_at_home(described: Description, T: RigidTransform) -> dict[str, float]:
    """Return the readings at home of motors that carry joints.

    Raises ModelError if home is outside a travel, or both readings of a rod are inside it.
    """
    legs = _legs_to_close(described)
    readings, problems = dict[str, float](), list[str]()
    for actuator in actuators_of(legs):
        rods = [leg for leg in legs if leg.actuator is actuator]
        stated = described.home_readings.get(actuator.joint)
        chosen, other = _candidates(rods[0], T, stated)
        readings[actuator.joint] = chosen
        scale, unit = SHOWN_IN[actuator.unit]
        low, high = (scale * end for end in actuator.travel)
        outside = [max(low - scale * q, scale * q - high) > 1e-6 for q in (chosen, other)]
        both = f"{scale * chosen:.6g} and {scale * other:.6g} {unit}"
        needed, fault = f"needed one in its travel of {low:.6g} to {high:.6g} {unit}", None
        if outside[0]:
            fault = f"found the readings {both} there, {needed}; correct home, lengths or travel"
        elif stated is not None:
            if abs(chosen - stated) > MAX_HOME_RESIDUAL * (actuator.travel[1] - actuator.travel[0]):
                fault = (
                    f"found {both} there, needed one within {MAX_HOME_RESIDUAL:.0%} of its travel "
                    f"from {scale * stated:.6g} {unit} of home_readings; correct home or "
                    "home_readings"
                )
        elif not outside[1] and abs(other - chosen) > 1e-9:
            fault = (
                f"found two readings there, {both}, {needed} and not two; write the right one in "
                "home_readings, or limit the travel to one side of the turning point of "
                f"{legs_in_words([leg.name for leg in rods])}"
            )
        if fault is not None:
            start = f"{described.source}: motor '{actuator.joint}' cannot close at home"
            problems.append(f"{start}: {fault}.")
    _refuse(problems)
    return readings


def _project(described: Description, home: RigidTransform) -> RigidTransform:
    """Return the closed pose nearest to home."""
    size = _size(every := _legs_to_close(described))
    legs = [leg for leg in every if leg.n_constraints]
    if not legs:
        return home
    rods = [legs[j] for j in first_rods(legs)]
    stated = described.home_readings
    q = np.array([_candidates(leg, home, stated.get(leg.motor_label))[0] for leg in rods])
    turns = [1.0 if actuator.turns else size for actuator in actuators_of(legs)]
    matrix, scale = home.as_matrix()[None], np.array([1.0] * 3 + [size] * 3 + turns)
    R, t = matrix[:, :3, :3], matrix[:, :3, 3]
    with np.errstate(invalid="ignore"):  # a leg without length has no direction
        at_home = posture_constraints(legs, R, t, q[None])
        worst = float(np.abs(at_home.values).max())
        if worst < ROUNDING * size:
            return home
        if worst < MAX_HOME_RESIDUAL * size:
            solved, _ = solve_postures(legs, IN_SPACE, R, t, q[None], scale)
            if solved.missed[0] < CLOSED * size:
                return motion_of(solved.R[0], solved.t[0])
    raise ModelError(
        [
            f"{described.source}: home could not be used: found {residual} there, needed a pose in "
            "which the machine closes; correct home, lengths or axes."
            for residual in _in_words(legs, at_home, home, joints_at(legs, q[None])[0], size)
        ]
    )


def _in_words(
    legs: Sequence[Leg], at_home: PoseEquations, home: RigidTransform, A: Array, size: float
) -> list[str]:
    """Return the constraints that home violates, with joints A (n, 3) there, in words."""
    words, lengths = list[str](), dict[str, list[str]]()  # lengths: legs that are alike
    for j, kind, value in zip(at_home.leg, at_home.kinds, at_home.values[0], strict=True):
        leg = legs[j]
        length = float(np.linalg.norm(home.apply(leg.B) - A[j]))
        if kind is EquationKind.LENGTH:
            if abs(value) > CLOSED * size:
                off = f"{1e3 * length:.6g} mm long instead of {1e3 * leg.q0:.6g} mm"
                lengths.setdefault(off, []).append(leg.name)
            continue
        angle = np.degrees(np.arccos(min(1.0, abs(float(value)) / length)))
        if 90.0 - angle > 1e-6 and kind is not EquationKind.TWIST:
            side = "base" if kind is EquationKind.BASE_AXIS else "platform"
            words.append(
                f"the {side} axis of leg '{leg.name}' at {angle:.4g} deg to the leg "
                "instead of 90 deg, which an R joint needs,"
            )
    words[:0] = [f"{legs_in_words(names)} {off}" for off, names in lengths.items()]
    return words or ["axes of a planar mechanism that are not parallel"]


def _search(described: Description, *, turning: bool) -> list[RigidTransform]:
    """Return the best pose at mid-travel from seeded starts, and others that are as likely."""
    legs = _legs_to_close(described)
    middle = [described.home_readings.get(leg.motor_label, 0.5 * sum(leg.travel)) for leg in legs]
    A, B = (np.array([getattr(leg, end) for leg in legs]) for end in "AB")
    rng, size = np.random.default_rng(1965), _size(legs)
    n_trials = TRIALS if turning else 8
    shifts, turns = np.array([[0.0, 0.0, 1.0]] * n_trials), np.zeros((n_trials, 3))
    for trial in range(n_trials):
        if trial:
            shifts[trial] = rng.normal(0.0, 1.0, 3)
        if turning:
            turns[trial] = rng.normal(0.0, 0.3, 3)
    solved = solve_poses(
        legs,
        IN_SPACE,
        Rotation.from_rotvec(turns).as_matrix(),
        A.mean(axis=0) - B.mean(axis=0) + size * shifts,
        np.tile(middle, (n_trials, 1)),
        scale=np.repeat([float(turning), size], 3),
    )
    closed, best = list[tuple[float, RigidTransform]](), list[tuple[float, RigidTransform]]()
    for k in np.flatnonzero(solved.missed <= CLOSED * size):
        T = motion_of(solved.R[k], solved.t[k])
        below = float((T.apply(B) - A).mean(axis=0)[2]) < -1e-9
        closed.append((10.0 * below + float(T.rotation.magnitude()), T))
    for rank, T in sorted(closed, key=lambda entry: round(entry[0], 6)):
        upright = rank % 10.0 if T.translation[2] > -1e-9 else rank
        apart = [max(np.divide(pose_distance(T, other), (size, 1.0))) for _, other in best]
        if not best or (min(apart) > APART and upright < LIKELY * best[0][0] + APART):
            best.append((rank, T))
    return [T for _, T in best]
