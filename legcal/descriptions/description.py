"""A machine as a table describes it, checked and put together.

:class:`Description` has what is stated, in metres. :func:`assemble` finds a pose in which the
machine closes, and completes lengths and axes of all legs there.
"""

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
from scipy.spatial.transform import RigidTransform, Rotation

from legcal.errors import DidNotConverge, ModelError, Problems
from legcal.files.motions import MotionEntry, motion_to_xyz_quat
from legcal.files.quantity import SHOWN_IN
from legcal.geometry.lines import cross
from legcal.geometry.types import Array
from legcal.machine.actuator import Actuator, ActuatorKind
from legcal.machine.closing import project_pose
from legcal.machine.home import (
    check_home_travel,
    homes_at_mid_travel,
    in_modes,
    readings_at_home,
    stated_or_middle,
)
from legcal.machine.leg import JointType, Leg, LegKind
from legcal.machine.loader import machine_of_legs
from legcal.machine.model import Machine, readings_at
from legcal.machine.parameters import n_frame_legs
from legcal.machine.topology import widest
from legcal.machine.urdf import Wording

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
    home: MotionEntry | None  # T_base_platform of a pose in which it closes
    base_frame: tuple[str, ...] | None  # the legs whose joints define R_b and R_e
    notes: tuple[str, ...] = ()  # assumptions
    home_readings: Mapping[str, float] = field(default_factory=dict)  # of motors [m or rad]


def home_of(xyz: Sequence[float], turn: Rotation) -> MotionEntry:
    """Return a home with the quaternion of a rotation, rounded as in files."""
    quat = turn.as_quat(canonical=True).tolist()
    return MotionEntry.model_validate({"xyz": xyz, "quat_xyzw": quat})


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
    return replace(described, home=home_of((x, y, height), turn))


def joints_from_base(described: Description) -> Description:
    """Return a machine whose platform joints were given in the base link at home.

    The platform link has the axes of the base link and its origin in the middle of the joints.
    """
    origin = np.round(_joints(described)[1].mean(axis=0), 6) + 0.0
    legs = tuple(
        replace(leg, B_platform=np.round(leg.B_platform - origin, 12) + 0.0)
        for leg in described.legs
    )
    home = home_of(tuple(origin.tolist()), Rotation.identity())
    note = (
        "Platform joints are in coordinates of the base at home: the platform link stands in their "
        f"middle, ({', '.join(f'{1e3 * x:.6g}' for x in origin)}) mm in the base link."
    )
    return replace(described, legs=legs, home=home, notes=(*described.notes, note))


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
        described, home_of((0.0, 0.0, 0.0), Rotation.identity())
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


def _closes(described: Description, home: MotionEntry) -> bool:
    """Return whether all motors are inside their travel at a pose."""
    try:
        check_home_travel(replace(_legs_alone(described), home=home.motion()), 0.0)
    except ModelError:
        return False
    return True


_MANY = 3  # legs that hardly all fit by chance
ALONG = 1.0  # [deg] least angle of outer axis and leg; a U joint is singular if they coincide
MAX_OFF = 0.01  # of a stated reading at home, relative to the travel
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

    @property
    def shortest_shown(self) -> float:
        """The length at reading zero, or at the reading nearest to it within the travel [m]."""
        return self.q0 + min(max(0.0, self.travel[0]), self.travel[1])


@dataclass(frozen=True, eq=False, kw_only=True)
class Assembled(Description):
    """A machine with all its numbers; home is a pose in which it closes, as in the file."""

    legs: tuple[AssembledLeg, ...]
    home: MotionEntry
    base_frame: tuple[str, ...]  # the legs whose joints define R_b and R_e
    planar: bool  # motion in the xy plane of base and platform

    @property
    def T_base_platform(self) -> RigidTransform:
        """The home pose."""
        return self.home.motion()


def assemble(described: Description) -> Assembled:
    """Return a described machine with its home, lengths and axes."""
    machine, home, notes = _at_home(described)
    T = home.motion()
    check_home_travel(machine, 0.0)
    q_home = zip(described.legs, readings_at(machine, T).tolist(), strict=True)
    readings = {leg.actuator.joint: q for leg, q in reversed([*q_home]) if leg.actuator is not None}
    for actuator in machine.actuators:
        q, stated = readings[actuator.joint], described.home_readings.get(actuator.joint)
        if stated is not None and abs(q - stated) > MAX_OFF * np.ptp(actuator.travel):
            scale, unit = SHOWN_IN[actuator.unit]
            raise ModelError(
                f"home_readings.{actuator.joint} could not be used",
                f"{scale * stated:.6g} {unit}",
                f"the reading {scale * q:.6g} {unit} at home",
                "correct home or home_readings",
                described.source,
            )
    A = np.array([_at(leg, readings) for leg in described.legs])
    B = T.apply(np.array([leg.B_platform for leg in described.legs]))
    lengths = np.linalg.norm(B - A, axis=1)
    u = (B - A) / lengths[:, None]
    tangents = np.array([across_leg(u[j], A[j] - A.mean(axis=0)) for j in range(len(A))])
    if all_revolute(described):
        tangents[:] = [0.0, 0.0, 1.0]
    legs, problems = [], Problems(described.source)
    for j, entry in enumerate(described.legs):
        q = 0.0 if entry.actuator is None else readings[entry.actuator.joint]
        axes = dict(zip(("base", "platform"), _axes(entry, tangents[j], T, q), strict=True))
        for side, axis in axes.items():
            angle = float(np.degrees(np.arccos(np.clip(abs(axis @ u[j]), 0.0, 1.0))))
            if getattr(entry.type, side) is JointType.UNIVERSAL and angle < ALONG:
                problems.add(
                    f"the {side} axis of leg '{entry.name}' could not be used",
                    f"it along the leg at home ({angle:.3g} deg), where a U joint is singular",
                    "it across the leg",
                    f"correct {side}_axes or home",
                )
        q0, travel = _law(entry, float(lengths[j]))
        numbers = {"travel": travel, **{f"{side}_axis": axis for side, axis in axes.items()}}
        legs.append(AssembledLeg(**(vars(entry) | numbers), u=u[j], q0=q0, q_home=q))
    problems.raise_if_any()
    planar = all_revolute(described) and is_planar(legs, T)
    frame = described.base_frame or tuple(machine.leg_names[j] for j in machine.frame_legs)
    at_home = {name: readings[name] for name in described.home_readings}
    numbers = {"legs": tuple(legs), "home": home, "base_frame": frame, "home_readings": at_home}
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
    z = np.array([0.0, 0.0, 1.0])
    for other in (u, outward, np.array([1.0, 0.0, 0.0])):
        across = cross(z, other)
        if np.linalg.norm(across) > 1e-6 * max(1.0, float(np.linalg.norm(other))):
            across = across - (across @ u) * u
            return np.asarray(across / np.linalg.norm(across))
    return np.array([0.0, 1.0, 0.0])


def _axes(entry: LegEntry, tangent: Array, T: RigidTransform, q: float) -> tuple[Array, Array]:
    """Return the axes of a leg at base and platform at home, both in the base link."""
    base = tangent
    if entry.base_axis is not None:
        turn = np.eye(3) if entry.actuator is None else entry.actuator.rotations(np.array([q]))[0]
        base = np.asarray(turn @ entry.base_axis)
    platform = tangent
    if entry.platform_axis is not None:
        platform = np.asarray(T.rotation.apply(entry.platform_axis))
    return base, platform


def _law(entry: LegEntry, length: float) -> tuple[float, tuple[float, float]]:
    """Return length at reading zero and travel of a leg [m]."""
    if entry.kind is LegKind.CONSTANT:
        return length if entry.offset is None else entry.offset, (0.0, 0.0)
    q0 = 0.0 if entry.offset is None else entry.offset
    free = (FREE_TRAVEL[0] * length - q0, FREE_TRAVEL[1] * length - q0)
    return q0, free if entry.travel is None else entry.travel


def words_of(described: Description) -> Wording:
    """Return the words for messages about a table."""
    return Wording(
        home="home of the table",
        no_home="the table has no home",
        state_home="write home, or correct the joints, offsets or travel",
        correct_home="correct home, its joints, offsets or travel, and their unit,",
        readings="home_readings",
        state_readings="write home_readings (of arms home_readings_deg) in the table",
        correct_unit=f"lengths are in {described.unit}: check the numbers and the unit",
    )


def _legs_alone(described: Description) -> Machine:
    """Return a machine of the legs alone, without a URDF, for the search of its home.

    Joints without a stated axis constrain nothing yet, but in a plane.
    """
    source, normal = Path(described.source), np.array([0.0, 0.0, 1.0])
    first = described.legs[0]
    of_plane = [normal if v is None else v for v in (first.base_axis, first.platform_axis)]
    axes = [v for leg in described.legs for v in (leg.base_axis, leg.platform_axis)]
    in_plane = all_revolute(described) and all(
        v is None or np.linalg.norm(cross(v, n)) < PARALLEL
        for v, n in zip(axes, of_plane * len(described.legs), strict=True)
    )
    planes = of_plane if in_plane else (None, None)
    A, B = _joints(described)
    wide = 4.0 * max(float(np.ptp(points, axis=0).max()) for points in (A, B))
    legs = []
    for entry in described.legs:
        is_rod = entry.kind is LegKind.CONSTANT and entry.offset is not None
        free = (0.0, wide) if entry.travel is None else entry.travel
        base_axis, platform_axis = (
            stated if stated is not None else plane
            for stated, plane in zip((entry.base_axis, entry.platform_axis), planes, strict=True)
        )
        legs.append(
            Leg(
                entry.type.base,
                entry.type.platform,
                LegKind.PASSIVE if entry.kind is LegKind.CONSTANT and not is_rod else entry.kind,
                entry.A_base,
                entry.B_platform,
                entry.offset or 0.0,
                base_axis,
                platform_axis,
                name=entry.name,
                prismatic=entry.name,
                travel=free if entry.actuator is None else entry.actuator.travel,
                actuator=entry.actuator,
            )
        )
    motors = [leg.motor_label for leg in legs]
    n_d = min(n_frame_legs(spatial=not in_plane), len(legs))
    frame_legs = widest(A, B, motors, n_d)
    normals = (of_plane[0], of_plane[1]) if in_plane else None
    return machine_of_legs(source, legs, frame_legs, normals, words_of(described))


def _at_home(described: Description) -> tuple[Machine, MotionEntry, list[str]]:
    """Return the legs in a closed pose, the pose as files have it, and notes.

    A stated home is moved onto what the legs keep constant. Without one all motors are at the
    middle of their travel; a note names another such pose that is as likely.
    """
    machine, stated, notes = _legs_alone(described), described.home_readings, list[str]()
    if described.home is None:
        try:
            q = stated_or_middle(machine, stated)
            (T, *others), mirrored = homes_at_mid_travel(machine, q)
        except DidNotConverge as error:
            raise ModelError(error.facts) from error
        if others := [*others, *([] if mirrored is None else [mirrored])]:
            where = [
                f"({', '.join(f'{round(1e3 * x) + 0:d}' for x in T.translation)}) mm, turned by "
                f"{round(T.rotation.as_euler('ZYX', degrees=True)[0]) + 0:d} deg about z"
                for T in (T, others[0])
            ]
            notes = [
                f"Two poses have all motors at mid-travel: home is {' and not '.join(where)}. If "
                "yours is the other, give --height, or in the table home (YAML) or the joints of "
                "the platform as they are at home in the base link ('B1 (home)')."
            ]
        home = _written(T)
        return replace(in_modes(machine, T, q), home=home.motion()), home, notes
    T = described.home.motion()
    machine = replace(machine, home=T)
    machine = in_modes(machine, T, readings_at_home(machine, stated, {}))
    closed, problem = project_pose(machine, T)
    if problem is not None:
        raise ModelError(
            "home could not be used",
            f"{problem} there",
            "a pose in which the machine closes",
            "correct home, lengths or axes",
            described.source,
        )
    home = described.home if closed is T else _written(closed)
    return replace(machine, home=home.motion()), home, notes


def _at(entry: LegEntry, readings: Mapping[str, float]) -> Array:
    """Return the joint at A (3,) at readings of motors that carry joints."""
    if entry.actuator is None:
        return entry.A_base
    q = np.array([readings[entry.actuator.joint]])
    return np.asarray(entry.actuator.at(entry.A_base, q)[0])


def _written(T: RigidTransform) -> MotionEntry:
    """Return a computed pose for a file, without the rounding noise of its zeros."""
    entry = motion_to_xyz_quat(T)
    clean = {key: [x if abs(x) > 1e-13 else 0.0 for x in value] for key, value in entry.items()}
    return MotionEntry.model_validate(clean)
