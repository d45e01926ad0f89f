"""A described machine put together: a pose in which it closes, lengths and axes of all legs."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import combinations

import numpy as np
from scipy.spatial.transform import RigidTransform, Rotation

from legcal.errors import ModelError
from legcal.files.motions import motion_to_xyz_quat
from legcal.files.quantity import SHOWN_IN
from legcal.geometry.lines import cross
from legcal.geometry.motions import frame_on_points, motion_of
from legcal.geometry.rotations import cross_matrices
from legcal.geometry.types import Array
from legcal.machine.description import (
    Description,
    Home,
    LegEntry,
    legs_in_words,
    wrong_axes,
    wrong_lengths,
    wrong_sizes,
)
from legcal.machine.equations import posture_constraints
from legcal.machine.leg import EquationKind, Leg, LegKind
from legcal.machine.rods import actuators_of, joints_at, reading_of_rod
from legcal.machine.solver import postures_after, solve

TRIALS = 40
CLOSED = 1e-10  # largest residual of a closed pose, relative to the size of the machine
ROUNDING = 1e-13
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

    @property
    def shortest_shown(self) -> float:
        """The length at reading zero, or at the reading nearest to it within the travel [m]."""
        return self.q0 + min(max(0.0, self.travel[0]), self.travel[1])


@dataclass(frozen=True, eq=False, kw_only=True)
class Assembled(Description):
    """A machine with all its numbers; home is a pose in which it closes, as in the file."""

    legs: tuple[AssembledLeg, ...]
    home: Home
    base_frame: tuple[str, ...]  # the legs whose joints define R_b and R_e
    planar: bool  # motion in the xy plane of base and platform

    @property
    def T_base_platform(self) -> RigidTransform:
        """The home pose."""
        return self.home.motion()


def assemble(described: Description) -> Assembled:
    """Return a described machine with its home, lengths and axes."""
    _refuse(wrong_sizes(described))
    home = home_of_description(described)
    T = home.motion()
    readings = _readings_at_home(described, T)
    A = np.array([_at(leg, readings) for leg in described.legs])
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
        base_axis, platform_axis = axes = _axes(entry, tangents[j], T, q)
        problems += wrong_axes(described, entry, u[j], axes)
        q0, travel = _law(entry, float(lengths[j]))
        numbers = {"travel": travel, "base_axis": base_axis, "platform_axis": platform_axis}
        legs.append(AssembledLeg(**(vars(entry) | numbers), u=u[j], q0=q0, q_home=q))
    _refuse(problems)
    planar = all_revolute(described) and is_planar(legs, T)
    frame = _base_frame(described, 2 if _in_a_plane(legs) else 3)
    at_home = {name: readings[name] for name in described.home_readings}
    numbers = {"legs": tuple(legs), "home": home, "base_frame": frame, "home_readings": at_home}
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


def home_of_description(described: Description) -> Home:
    """Return a pose in which a machine closes, projected onto what its legs keep constant.

    If no home is given, all motors are at the middle of their travel; among such poses the one with
    the smallest rotation of the platform is taken, and of mirror images in the plane of the base
    joints the one on the positive side of z.
    """
    if described.home is not None:
        return _project(described, described.home)
    closure = _ClosingEquations(described, mid_travel=True)
    home = _search(closure, turning=False) or _search(closure, turning=True)
    if home is None:
        raise ModelError(
            f"{described.source}: no home was found: no pose has all motors at the middle of "
            "their travel with their axes in place, needed a pose in which the machine closes; "
            "write home, or correct the joints, offsets or travel."
        )
    return home


class _ClosingEquations:
    """The equations of home: lengths, axes of R joints, and in a plane parallel axes.

    Unknown are the pose and the readings of motors that carry joints; the readings are fixed if
    home is at mid-travel. Residuals are relative to the size of the machine.
    """

    def __init__(self, described: Description, *, mid_travel: bool) -> None:
        self.planar = all_revolute(described)
        self.stated = described.home_readings
        legs = [_fixed_leg(entry, self.planar, mid_travel) for entry in described.legs]
        self.legs = tuple(leg for leg in legs if leg.n_constraints)
        self.actuators = actuators_of(self.legs)
        self.still: Array | None = None
        if mid_travel:
            middles = [self.stated.get(a.joint, 0.5 * sum(a.travel)) for a in self.actuators]
            self.still = np.array(middles)
        self.A = np.array([leg.A for leg in legs])
        self.B = np.array([leg.B for leg in legs])
        lengths = [leg.q0 for leg in self.legs if leg.kind is LegKind.CONSTANT]
        spread = max(float(np.ptp(points, axis=0).max()) for points in (self.A, self.B))
        self.size = max(spread, 1e-3, *lengths)
        turns = [1.0 if actuator.turns else self.size for actuator in self.actuators]
        self.unit = np.array([1.0] * 3 + [self.size] * 3 + turns)

    def __call__(self, points: Array) -> tuple[Array, Array]:
        """Return residuals (k, m) and derivatives (k, m, 6 + n) at poses and n readings."""
        poses, q = points[:, :12].reshape(-1, 3, 4), points[:, 12:]
        if not self.legs:
            return np.zeros((len(q), 0)), np.zeros((len(q), 0, 6))
        R, t = poses[:, :, :3], poses[:, :, 3]
        with np.errstate(invalid="ignore"):  # a leg without length has no direction
            equations = posture_constraints(self.legs, R, t, q)
        values = [equations.values / self.size]
        slopes = [np.concatenate([equations.by_pose, equations.by_q], axis=2) / self.size]
        if self.still is not None:
            slopes[0][:, :, 6:] = 0.0
        for leg in self.legs if self.planar else ():
            if leg.base_axis is not None and leg.platform_axis is not None:
                turned = R @ leg.platform_axis
                values.append(cross(leg.base_axis, turned))
                slope = -cross_matrices(leg.base_axis) @ cross_matrices(turned)
                slopes.append(np.concatenate([slope, np.zeros_like(slope)], axis=2))
        return np.concatenate(values, axis=1), np.concatenate(slopes, axis=1)

    def readings_at(self, T: RigidTransform) -> Array:
        """Return the readings (n,) at a pose: fixed ones, or those of the first rods."""
        if self.still is not None:
            return self.still
        first = {a.joint: leg for leg in reversed(self.legs) if (a := leg.actuator) is not None}
        candidates = [
            _candidates(first[a.joint], T, self.stated.get(a.joint)) for a in self.actuators
        ]
        return np.array([pair[0] for pair in candidates])

    def _point(self, T: RigidTransform) -> Array:
        """Return a pose with its readings, (1, 12 + n)."""
        return np.concatenate([T.as_matrix()[:3].ravel(), self.readings_at(T)])[None]

    def residual(self, T: RigidTransform) -> float:
        """Return the largest residual at a pose."""
        return float(np.abs(self(self._point(T))[0]).max(initial=0.0))

    def nearest(self, T: RigidTransform) -> RigidTransform:
        """Return the nearest pose that closes, as far as steps get nearer to one."""
        solution = solve(
            self, postures_after, self._point(T), tolerance=1e-16, unit=self.unit, steps=30
        )
        pose = solution.points[0, :12].reshape(3, 4)
        return motion_of(pose[:, :3], pose[:, 3])

    def describe(self, T: RigidTransform) -> list[str]:
        """Return the residuals at a pose in words."""
        matrix, q = T.as_matrix()[None], self.readings_at(T)[None]
        equations = posture_constraints(self.legs, matrix[:, :3, :3], matrix[:, :3, 3], q)
        (A,) = joints_at(self.legs, q)
        words, lengths = list[str](), dict[str, list[str]]()  # lengths: legs with the same residual
        for j, kind, value in zip(equations.leg, equations.kinds, equations.values[0], strict=True):
            leg = self.legs[j]
            length = float(np.linalg.norm(T.apply(leg.B) - A[j]))
            if kind is EquationKind.LENGTH:
                if abs(value) > CLOSED * self.size:
                    off = f"{1e3 * length:.6g} mm long instead of {1e3 * leg.q0:.6g} mm"
                    lengths.setdefault(off, []).append(leg.name)
                continue
            angle = np.degrees(np.arccos(min(1.0, abs(float(value)) / length)))
            if 90.0 - angle > 1e-6:
                side = "base" if kind is EquationKind.BASE_AXIS else "platform"
                words.append(
                    f"the {side} axis of leg '{leg.name}' at {angle:.4g} deg to the leg "
                    "instead of 90 deg, which an R joint needs,"
                )
        words[:0] = [f"{legs_in_words(names)} {off}" for off, names in lengths.items()]
        return words or ["axes of a planar mechanism that are not parallel"]


def _fixed_leg(entry: LegEntry, planar: bool, mid_travel: bool) -> Leg:
    """Return a leg with its length at home, passive if any length will do."""
    length = entry.offset if entry.kind is LegKind.CONSTANT else None
    if mid_travel and entry.kind is LegKind.ACTUATED and entry.travel is not None:
        length = (entry.offset or 0.0) + 0.5 * sum(entry.travel)
    z = np.array([0.0, 0.0, 1.0]) if planar else None
    return Leg(
        entry.type.base,
        entry.type.platform,
        LegKind.PASSIVE if length is None else LegKind.CONSTANT,
        entry.A_base,
        entry.B_platform,
        0.0 if length is None else length,
        z if entry.base_axis is None else entry.base_axis,
        z if entry.platform_axis is None else entry.platform_axis,
        travel=(0.0, 0.0) if entry.actuator is None else entry.actuator.travel,
        name=entry.name,
        actuator=entry.actuator,
    )


def _candidates(leg: Leg, T: RigidTransform, stated: float | None = None) -> list[float]:
    """Return the two readings at which a rod reaches a pose.

    The first is the one inside the travel, or the one nearer to the stated reading.
    """
    B = np.asarray(T.apply(leg.B))[None]
    low, high = leg.travel
    readings = [float(reading_of_rod(replace(leg, mode=mode), B)[0]) for mode in (1, -1)]
    if stated is not None:
        return sorted(readings, key=lambda q: abs(q - stated))
    return sorted(readings, key=lambda q: max(low - q, q - high, 0.0))


def _at(entry: LegEntry, readings: Mapping[str, float]) -> Array:
    """Return the joint at A (3,) at readings of motors that carry joints."""
    if entry.actuator is None:
        return entry.A_base
    q = np.array([readings[entry.actuator.joint]])
    return np.asarray(entry.actuator.at(entry.A_base, q)[0])


def _readings_at_home(described: Description, T: RigidTransform) -> dict[str, float]:
    """Return the readings at home of motors that carry joints.

    Raises
    ------
    ModelError
        If home is outside a travel, or both readings of a rod are inside it.
    """
    closure = _ClosingEquations(described, mid_travel=False)
    readings, problems = dict[str, float](), list[str]()
    for actuator in closure.actuators:
        rods = [leg for leg in closure.legs if leg.actuator is actuator]
        stated = described.home_readings.get(actuator.joint)
        chosen, other = _candidates(rods[0], T, stated)
        readings[actuator.joint] = chosen
        scale, unit = SHOWN_IN[actuator.unit]
        low, high = (scale * end for end in actuator.travel)
        where = f"{described.source}: motor '{actuator.joint}' cannot close at home"
        needed = f"needed one in its travel of {low:.6g} to {high:.6g} {unit}"
        outside = [max(low - scale * q, scale * q - high) > 1e-6 for q in (chosen, other)]
        if outside[0]:
            problems.append(
                f"{where}: found the readings {scale * chosen:.6g} and {scale * other:.6g} {unit} "
                f"there, {needed}; correct home, lengths or travel."
            )
        elif stated is not None:
            if abs(chosen - stated) > MAX_HOME_RESIDUAL * (actuator.travel[1] - actuator.travel[0]):
                problems.append(
                    f"{where} at the reading {scale * stated:.6g} {unit} of home_readings: found "
                    f"{scale * chosen:.6g} and {scale * other:.6g} {unit} there, needed one within "
                    f"{MAX_HOME_RESIDUAL:.0%} of its travel; correct home or home_readings."
                )
        elif not outside[1] and abs(other - chosen) > 1e-9:
            problems.append(
                f"{where}: found two readings there, {scale * chosen:.6g} and {scale * other:.6g} "
                f"{unit}, {needed} and not two; write the right one in home_readings, or limit the "
                f"travel to one side of the turning point of {_rods_in_words(rods)}."
            )
    _refuse(problems)
    return readings


def _rods_in_words(rods: Sequence[Leg]) -> str:
    """Return rods in words."""
    return legs_in_words([leg.name for leg in rods])


def _project(described: Description, home: Home) -> Home:
    """Return the closed pose nearest to home."""
    closure, T = _ClosingEquations(described, mid_travel=False), home.motion()
    if closure.residual(T) < ROUNDING:
        return home
    if closure.residual(T) < MAX_HOME_RESIDUAL:
        T = closure.nearest(T)
    if closure.residual(T) < CLOSED:
        return _written(T)
    raise ModelError(
        [
            f"{described.source}: home could not be used: found {residual} there, needed a pose in "
            "which the machine closes; correct home, lengths or axes."
            for residual in closure.describe(home.motion())
        ]
    )


def _search(closure: _ClosingEquations, *, turning: bool) -> Home | None:
    """Return the best pose that seeded starts lead to, None if none closes."""
    rng = np.random.default_rng(1965)
    centre = closure.A.mean(axis=0) - closure.B.mean(axis=0)
    n_trials = TRIALS if turning else 8
    still = np.zeros(0) if closure.still is None else closure.still
    starts = np.zeros((n_trials, 3, 4))
    for trial in range(n_trials):
        shift = rng.normal(0.0, 1.0, 3) if trial else np.array([0.0, 0.0, 1.0])
        starts[trial, :, 3] = centre + closure.size * shift
        turn = rng.normal(0.0, 0.3, 3) if turning else np.zeros(3)
        starts[trial, :, :3] = Rotation.from_rotvec(turn).as_matrix()

    def equations(points: Array) -> tuple[Array, Array]:
        values, slopes = closure(points)
        slopes[:, :, :3] *= turning
        return values, slopes

    points = np.concatenate([starts.reshape(-1, 12), np.tile(still, (n_trials, 1))], axis=1)
    solution = solve(
        equations, postures_after, points, tolerance=1e-15, unit=closure.unit, damped=True
    )
    best: tuple[float, RigidTransform] | None = None
    for pose in solution.points[solution.worst <= CLOSED, :12].reshape(-1, 3, 4):
        T = motion_of(pose[:, :3], pose[:, 3])
        below = float((T.apply(closure.B) - closure.A).mean(axis=0)[2]) < -1e-9
        rank = 10.0 * below + float(T.rotation.magnitude())
        if best is None or rank < best[0] - 1e-6:
            best = rank, T
    return None if best is None else _written(closure.nearest(best[1]))


def _written(T: RigidTransform) -> Home:
    """Return a computed pose for a file, without the rounding noise of its zeros."""
    entry = motion_to_xyz_quat(T)
    clean = {key: [x if abs(x) > 1e-13 else 0.0 for x in value] for key, value in entry.items()}
    return Home(tuple(clean["xyz"]), tuple(clean["quat_xyzw"]))
