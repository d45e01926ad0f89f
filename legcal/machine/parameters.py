"""The parameter vector of legs: names, units, positions of numbers, and steps.

Parameters are joint centres in R_b and R_e, without the coordinates that are zero by definition of
these frames (the gauge), lengths, two rotations of each axis that is a parameter, and twists on
request. Directions in their space have words: :func:`describe_direction`.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np
from scipy.linalg import qr
from scipy.spatial.transform import RigidTransform, Rotation

from legcal.geometry.lines import axis_angles, cross, normal_basis, turned_axis
from legcal.geometry.motions import frame_on_points, matrix_applied, rotation_between
from legcal.geometry.types import Array, BoolArray, IntArray
from legcal.machine.actuator import ActuatorColumns
from legcal.machine.leg import (
    ARMS,
    Leg,
    LegColumns,
    LegKind,
    ParameterId,
    with_platform_points,
)
from legcal.machine.model import Machine
from legcal.machine.rods import actuators_of

_STEP = 1e-6  # step of numerical derivatives [rad], and relative to the extent of the joints
# Blocks of LegColumns, in parameter order.
_BLOCKS = (
    *(range(3), range(3, 6), (6,), (7, 8), (9, 10), (11,)),
    *((12, 13), (14, 15), (16,), (17, 18), (19, 20)),  # those of its actuator
)
# By column: names after the leg or its motor, and units.
_NAMES = (
    *(f"{side}.{axis}" for side in ("base", "platform") for axis in "xyz"),
    "offset",
    *(f"{side}_axis.{angle}" for side in ("base", "platform") for angle in (1, 2)),
    "twist",
    *("axis.1", "axis.2", "axis_point.1", "axis_point.2", "gain"),
    *("arm_axis.1", "arm_axis.2", "arm_point.1", "arm_point.2"),
)
_UNITS = (*["m"] * 7, *["rad"] * 5, "rad", "rad", "m", "m", "", "rad", "rad", "m", "m")


@dataclass(frozen=True, eq=False)
class Parametrization:
    """The positions of the numbers of each leg in a parameter vector."""

    names: tuple[str, ...]  # leg2.base.x, leg1.offset, leg1.length, leg1.base_axis.1, leg1.twist
    units: tuple[str, ...]  # m or rad
    # (n_legs, 21) index of each number (LegColumns), -1 if it is no parameter; legs on one actuator
    # share its numbers
    place: IntArray

    def __len__(self) -> int:
        return len(self.names)


def parametrize(
    names: Sequence[str], legs: Sequence[Leg], frame_legs: Sequence[int], *, twists: bool = False
) -> Parametrization:
    """Return the parameters of legs in R_b and R_e.

    Without *twists* the twists, the gains of actuators and the lines of arms are fixed.
    """
    columns = LegColumns
    free = np.zeros((len(legs), columns.COUNT), dtype=np.bool_)
    free[:, columns.A] = free[:, columns.B] = free_coordinates(len(legs), frame_legs)
    for j, leg in enumerate(legs):
        free[j, columns.LENGTH] = leg.kind is not LegKind.PASSIVE
        free[j, columns.BASE_AXIS] = leg.base_axis is not None
        free[j, columns.PLATFORM_AXIS] = leg.platform_axis is not None
        free[j, columns.TWIST] = twists and leg.twist is not None
        if leg.actuator is not None:
            free[j, ActuatorColumns.AXIS] = True
            free[j, ActuatorColumns.POINT] = leg.actuator.turns
            free[j, ActuatorColumns.GAIN] = twists
            has_arm = twists and leg.actuator.arm is not None
            free[j, ActuatorColumns.ARM_AXIS] = free[j, ActuatorColumns.ARM_POINT] = has_arm
        if leg.is_platform_joint and leg.platform_axis is not None:
            # Its direction is a convention, but for what turns the axis of the joint.
            held, inner = [0, 1], leg.inner_axis
            if inner is not None:
                held = [int(np.argmax(np.abs(normal_basis(leg.platform_axis) @ inner)))]
            free[j, [columns.PLATFORM_AXIS.start + k for k in held]] = False
        if j not in frame_legs and leg.is_fixed_to_platform and leg.platform_axis is not None:
            # B is arbitrary on the line
            free[j, columns.B.start + int(np.argmax(np.abs(leg.platform_axis)))] = False
    number, units = dict[str, int](), dict[str, str]()
    place = np.full(free.shape, -1, dtype=np.intp)
    for block in _BLOCKS:
        for j, leg in enumerate(legs):
            for column in block:
                if not free[j, column]:
                    continue
                name = _name(names[j], leg, column)
                place[j, column] = number.setdefault(name, len(number))  # motors are shared
                units[name] = _UNITS[column]
    return Parametrization(tuple(number), tuple(units.values()), place)


def _name(leg_name: str, leg: Leg, column: int) -> str:
    """Return the name of a number of a leg, or of its actuator."""
    name = _NAMES[column]
    if column >= LegColumns.OWN:
        moves = name if leg.reads_angle else name.replace("axis", "direction")
        return f"{leg.motor_label}.{moves}"
    is_length = name == "offset" and leg.kind is LegKind.CONSTANT
    return f"{leg_name}.{'length' if is_length else name}"


def is_held_by_default(name: str) -> bool:
    """Return whether a parameter is fixed by default: a twist, a gain, a line of an arm.

    The line of a visible arm is estimated, near its line in the model.
    """
    return ParameterId.parse(name).kind in ("twist", "gain", *ARMS)


def parametrization_of(machine: Machine, *, twists: bool = False) -> Parametrization:
    """Return the parameters of a mechanism; see :func:`parametrize`."""
    return parametrize(machine.leg_names, geometries(machine), machine.frame_legs, twists=twists)


def n_frame_legs(*, spatial: bool) -> int:
    """Return N_d, the number of legs whose joints define a frame."""
    return 3 if spatial else 2


def is_spatial(frame_legs: Sequence[int]) -> bool:
    """Return whether frames defined by these legs are of a spatial platform, not a planar one."""
    return len(frame_legs) == n_frame_legs(spatial=True)


def free_coordinates(n_legs: int, frame_legs: Sequence[int]) -> BoolArray:
    """Return which joint coordinates, (n_legs, 3), are not zero by definition of the frame.

    The joints of the frame legs are origin, x axis and xy plane; a planar machine has two, and
    heights z are no parameters.
    """
    free = np.ones((n_legs, 3), dtype=np.bool_)
    free[:, 2] = is_spatial(frame_legs)
    for rank, leg in enumerate(frame_legs):
        free[leg, rank:] = False
    return free


@lru_cache(maxsize=8)  # a job needs those of one or two machines dozens of times
def geometries(machine: Machine) -> tuple[Leg, ...]:
    """Return the legs of a mechanism in its joint frames: A and axes in R_b, B and axes in R_e."""
    A = machine.T_base_Rb.inv().apply(machine.A_base)
    B = machine.T_platform_Re.inv().apply([leg.B for leg in machine.legs_of_frames])
    n_d = len(machine.frame_legs)
    for rank, j in enumerate(machine.frame_legs):  # zero by definition, not by rounding
        A[j, rank:n_d] = B[j, rank:n_d] = 0.0
    moved = _in_frames(machine.legs_of_frames, machine.T_base_Rb.inv(), machine.T_platform_Re.inv())
    ends = zip(moved, A, B, strict=True)
    return tuple(replace(leg, A=A_j, B=B_j) for leg, A_j, B_j in ends)


def legs_in_links(machine: Machine, legs: Sequence[Leg]) -> tuple[Leg, ...]:
    """Return legs in R_b and R_e transformed to the links, the inverse of :func:`geometries`."""
    return _in_frames(legs, machine.T_base_Rb, machine.T_platform_Re)


def _in_frames(
    legs: Sequence[Leg], T_base: RigidTransform, T_platform: RigidTransform
) -> tuple[Leg, ...]:
    """Return legs in other frames of base and platform."""
    base, platform = T_base.as_matrix(), T_platform.as_matrix()
    turn = T_platform.rotation

    def turned(matrix: Array, axis: Array | None) -> Array | None:
        return None if axis is None else matrix[:3, :3] @ axis

    moved = {actuator.joint: actuator.in_frame(base) for actuator in actuators_of(legs)}
    return tuple(
        replace(
            leg,
            A=matrix_applied(base, leg.A),
            B=matrix_applied(platform, leg.B),
            base_axis=turned(base, leg.base_axis),
            platform_axis=turned(platform, leg.platform_axis),
            twist=twist_after(leg, turn),
            actuator=None if leg.actuator is None else moved[leg.actuator.joint],
        )
        for leg in legs
    )


def in_joint_frames(legs: Sequence[Leg], frame_legs: Sequence[int]) -> tuple[Leg, ...]:
    """Return legs in any frames of base and platform in R_b and R_e, those of a plane of motion z.

    B of frame legs fixed to the platform is moved to the points that define R_e.
    """
    legs = with_platform_points(legs, frame_legs)
    base, platform = (
        frame_on_points(np.array([end[j] for j in frame_legs])).inv()
        for end in ([leg.A for leg in legs], [leg.B for leg in legs])
    )
    return _in_frames(legs, base, platform)


def to_vector(legs: Sequence[Leg], frame_legs: Sequence[int]) -> Array:
    """Return joint centres in R_b and R_e and lengths of legs, passive or not, as a vector [m].

    These are all parameters of point-like joints, in the order of :func:`parametrize`.
    """
    free = free_coordinates(len(legs), frame_legs)
    A, B = (np.array(points)[free] for points in ([x.A for x in legs], [x.B for x in legs]))
    return np.concatenate([A, B, [leg.q0 for leg in legs]])


def vector_of(
    parametrization: Parametrization, legs: Sequence[Leg], nominal: Sequence[Leg]
) -> Array:
    """Return the parameters of legs as a vector [m, rad]; axes are angles from the nominal ones."""
    numbers, is_parameter = numbers_of(legs, nominal), parametrization.place >= 0
    vector = np.zeros(len(parametrization))
    vector[parametrization.place[is_parameter]] = numbers[is_parameter]
    return vector


def numbers_of(legs: Sequence[Leg], nominal: Sequence[Leg]) -> Array:
    """Return the numbers of legs, (n_legs, 21), in the order of :class:`LegColumns` [m, rad].

    Axes are ``axis_angles`` from the nominal axes, zero for legs without.
    """
    numbers = np.zeros((len(legs), LegColumns.COUNT))
    for row, leg, start in zip(numbers, legs, nominal, strict=True):
        row[LegColumns.A], row[LegColumns.B], row[LegColumns.LENGTH] = leg.A, leg.B, leg.q0
        if leg.base_axis is not None and start.base_axis is not None:
            row[LegColumns.BASE_AXIS] = axis_angles(leg.base_axis, start.base_axis)
        if leg.platform_axis is not None and start.platform_axis is not None:
            row[LegColumns.PLATFORM_AXIS] = axis_angles(leg.platform_axis, start.platform_axis)
        row[LegColumns.TWIST] = _twist(leg, start)
        if leg.actuator is not None and start.actuator is not None:
            row[LegColumns.ACTUATOR] = leg.actuator.numbers(start.actuator)
    return numbers


def with_numbers(
    legs: Sequence[Leg], nominal: Sequence[Leg], numbers: Array, given: BoolArray
) -> tuple[Leg, ...]:
    """Return legs with some numbers, *given* (n_legs, 21), replaced by those of :func:`numbers_of`.

    If a platform axis or a twist is given, the twist is taken from the numbers.
    """
    moved_legs = []
    for leg, start, row, is_given in zip(legs, nominal, numbers, given, strict=True):
        if not is_given.any():
            moved_legs.append(leg)
            continue
        axes = []
        for columns, axis, origin in (
            (LegColumns.BASE_AXIS, leg.base_axis, start.base_axis),
            (LegColumns.PLATFORM_AXIS, leg.platform_axis, start.platform_axis),
        ):
            if axis is not None and origin is not None and is_given[columns].any():
                turned = turned_axis(origin, row[columns])
                axis = turned if turned @ axis > 0.0 else -turned
            axes.append(axis)
        moved = replace(
            leg,
            A=np.where(is_given[LegColumns.A], row[LegColumns.A], leg.A),
            B=np.where(is_given[LegColumns.B], row[LegColumns.B], leg.B),
            q0=float(row[LegColumns.LENGTH]) if is_given[LegColumns.LENGTH] else leg.q0,
            base_axis=axes[0],
            platform_axis=axes[1],
        )
        if (
            leg.twist is not None
            and is_given[LegColumns.PLATFORM_AXIS.start : LegColumns.OWN].any()
        ):
            moved = replace(moved, twist=tied_twist(moved, start, float(row[LegColumns.TWIST])))
        of_actuator = is_given[LegColumns.ACTUATOR]
        if leg.actuator is not None and start.actuator is not None and of_actuator.any():
            numbers_there = leg.actuator.numbers(start.actuator)
            wanted = np.where(of_actuator, row[LegColumns.ACTUATOR], numbers_there)
            moved = replace(moved, actuator=leg.actuator.with_numbers(start.actuator, wanted))
        moved_legs.append(moved)
    return tuple(moved_legs)


def moved_legs(legs: Sequence[Leg], place: IntArray, step: Array) -> tuple[Leg, ...]:
    """Return legs after a small step of the parameters, with their indices *place*."""
    columns, padded = LegColumns, np.append(step, 0.0)
    moved = []
    for leg, local in zip(legs, padded[place], strict=True):
        base_axis, platform_axis, twist = leg.base_axis, leg.platform_axis, leg.twist
        if base_axis is not None:
            base_axis = turned_axis(base_axis, local[columns.BASE_AXIS])
        if platform_axis is not None:
            angles = local[columns.PLATFORM_AXIS]
            twist = twist_after(leg, Rotation.from_rotvec(angles @ normal_basis(platform_axis)))
            platform_axis = turned_axis(platform_axis, angles)
        moved.append(
            replace(
                leg,
                A=leg.A + local[columns.A],
                B=leg.B + local[columns.B],
                q0=leg.q0 + float(local[columns.LENGTH]),
                base_axis=base_axis,
                platform_axis=platform_axis,
                twist=None if twist is None else twist + float(local[columns.TWIST]),
                actuator=(
                    None if leg.actuator is None else leg.actuator.moved(local[columns.ACTUATOR])
                ),
            )
        )
    return tuple(moved)


def reframed(
    legs: Sequence[Leg], frame_legs: Sequence[int], origin: Array | None = None
) -> tuple[Leg, ...]:
    """Return the machine with B at conventional points, in the frames defined by these points.

    *origin* as in :func:`with_platform_points`. Without a frame leg fixed to the platform the
    frames are unchanged.
    """
    legs = with_platform_points(legs, frame_legs, origin)
    if not any(legs[j].is_fixed_to_platform for j in frame_legs):
        return legs
    T = frame_on_points(np.array([legs[j].B for j in frame_legs])).inv()
    zero = ~free_coordinates(len(legs), frame_legs)
    moved = _in_frames(legs, RigidTransform.identity(), T)
    return tuple(
        replace(leg, B=np.where(is_zero, 0.0, leg.B))
        for leg, is_zero in zip(moved, zero, strict=True)
    )


def twist_after(leg: Leg, turn: Rotation) -> float | None:
    """Return the twist of a leg after a rotation of its platform axis, with directions tied to it.

    The twist of a leg fixed to the platform refers to the first :func:`normal_basis` vector of its
    direction, which does not rotate with it.
    """
    if leg.twist is None or leg.platform_axis is None or not leg.is_fixed_to_platform:
        return leg.twist
    outer = np.asarray(turn.apply(normal_basis(leg.platform_axis)[0]))
    e1, e2 = normal_basis(np.asarray(turn.apply(leg.platform_axis)))
    twist = leg.twist - float(np.arctan2(outer @ e2, outer @ e1))
    return float(twist - np.pi * np.ceil(twist / np.pi - 0.5))


def tied_twist(leg: Leg, nominal: Leg, twist: float) -> float | None:
    """Return the twist of a leg with a given twist at its nominal platform axis [rad].

    The axis is reached by the smallest rotation from there; on any other path the directions tied
    to it rotate about it as well.
    """
    turn = _turn_between(nominal.platform_axis, leg.platform_axis)
    return twist_after(replace(nominal, twist=twist), turn)


def tied_twist_slope(leg: Leg, nominal: Leg) -> Array:
    """Return the derivative (2,) of :func:`tied_twist` by rotations of the platform axis.

    In addition to the rotation of :func:`twist_after` it contains the spherical excess of the
    triangle of the nominal axis, the axis of the leg and the rotated axis.
    """
    u, n = leg.platform_axis, nominal.platform_axis
    if u is None or n is None or not leg.is_fixed_to_platform:
        return np.zeros(2)
    n = n if n @ u > 0.0 else -n
    e1, e2 = normal_basis(u)
    return np.array([-e2, e1]) @ cross(n, u) / (1.0 + float(n @ u))


def _twist(leg: Leg, nominal: Leg) -> float:
    """Return the twist of a leg with its axes rotated back, nearest to the nominal twist [rad].

    Twists are angles between lines.
    """
    if leg.twist is None or nominal.twist is None:
        return 0.0
    twist = twist_after(leg, _turn_between(nominal.platform_axis, leg.platform_axis).inv())
    if twist is None:
        return 0.0
    return float(twist - np.pi * np.round((twist - nominal.twist) / np.pi))


def _turn_between(nominal: Array | None, axis: Array | None) -> Rotation:
    """Return the smallest rotation of a nominal axis onto an axis, as lines."""
    if nominal is None or axis is None:
        return Rotation.identity()
    return rotation_between(nominal, axis if axis @ nominal >= 0.0 else -axis)


def nominal_axes(
    leg_names: Sequence[str], nominal: Sequence[Leg]
) -> dict[str, dict[str, list[float]]]:
    """Return the reference axes of rotations, at the base in R_b and at the platform in R_e."""
    named = list(zip(leg_names, nominal, strict=True))
    return {
        "base": {name: leg.base_axis.tolist() for name, leg in named if leg.base_axis is not None},
        "platform": {
            name: leg.platform_axis.tolist() for name, leg in named if leg.platform_axis is not None
        },
    }


def turns_between(
    parametrization: Parametrization,
    calibrated: Sequence[Leg],
    nominal: Sequence[Leg],
) -> Array:
    """Return the derivative (p, p) of parameters with calibrated axes by those with nominal axes.

    Twists are tied to axes and depend on their rotations.
    """
    extent = float(np.ptp([leg.B for leg in calibrated], axis=0).max())
    steps = _STEP * np.where([unit == "m" for unit in parametrization.units], extent, 1.0)
    by_step = []
    for start in (calibrated, nominal):
        columns = []
        for size in np.diag(steps):
            ahead, behind = (
                vector_of(parametrization, moved_legs(calibrated, parametrization.place, by), start)
                for by in (size, -size)
            )
            columns.append((ahead - behind) / (2.0 * size.max()))
        by_step.append(np.column_stack(columns))
    return np.asarray(np.linalg.solve(by_step[1].T, by_step[0].T).T)


def calibrated_axis(
    nominal: Sequence[float], leg: str, side: str, values: Mapping[str, float]
) -> Array:
    """Return the axis (3,) of a result, from the nominal axis and its rotations."""
    w = np.array([values.get(f"{leg}.{side}_axis.{k}", 0.0) for k in (1, 2)])
    return np.asarray(turned_axis(np.array(nominal), w))


SHOWN = 0.02  # least component named in words, relative to the largest


def split_by_motion(
    motion: Array | None, basis: Array, length: float, harmless: float
) -> tuple[Array, Array]:
    """Return bases (a, p), (b, p) of the directions that move the platform, and the others.

    *motion* (k, 6, p) is rotation [rad] and displacement [m] of the platform at k poses by each
    parameter, all in metres; None if the motors do not determine the pose: then all directions
    count. *basis* (w, p) is orthonormal; rotations are converted to displacements by the mean leg
    *length* [m]; motion below *harmless*, relative to the change of the parameters, counts as none.
    """
    if motion is None or len(basis) == 0:
        return basis, basis[:0]
    moved = motion @ basis.T
    moved[:, :3] *= length
    flat = moved.reshape(-1, len(basis)) / np.sqrt(len(moved))
    singular, turn = np.linalg.eigh(flat.T @ flat)
    still = singular < harmless**2
    return turn.T[~still] @ basis, turn.T[still] @ basis


def sparse_basis(basis: Array) -> Array:
    """Return a basis of the same space in which each direction has a parameter of its own."""
    if len(basis) == 0:
        return basis
    _, upper, order = qr(basis, mode="economic", pivoting=True)
    w = len(basis)
    sparse = np.zeros_like(basis)
    sparse[:, order] = np.linalg.solve(upper[:, :w], upper)
    sparse[np.abs(sparse) < 1e-9] = 0.0
    first = np.argmax(np.abs(sparse) > SHOWN * np.abs(sparse).max(axis=1, keepdims=True), axis=1)
    return np.asarray(sparse[np.argsort(first, kind="stable")])


_MAX_GROUPS = 4  # groups of joints named in one direction
_OF_ACTUATOR = {
    "direction": ("direction", "directions"),
    "axis": ("axis", "axes"),
    "axis_point": ("place of the axis", "places of the axes"),
    "arm_axis": ("direction of the arm", "directions of the arms"),
    "arm_point": ("place of the arm", "places of the arms"),
    "gain": ("gain", "gains"),
}
_NOUN = {
    "base": ("base joint", "base joints"),
    "platform": ("platform joint", "platform joints"),
    "offset": ("offset of leg", "offsets of legs"),
    "length": ("length of leg", "lengths of legs"),
    "base_axis": ("base axis of leg", "base axes of legs"),
    "platform_axis": ("platform axis of leg", "platform axes of legs"),
    "twist": ("twist of leg", "twists of legs"),
    "radius": ("radius of leg", "radii of legs"),
    "board": ("size of the board on", "sizes of the boards on"),
    "": ("camera", "cameras"),
    **{kind: (f"{what} of", f"{several} of") for kind, (what, several) in _OF_ACTUATOR.items()},
}
_BOARDS = {"board.scale": "the base", "platform_board.scale": "the platform"}


def list_in_words(words: Sequence[str]) -> str:
    """Return words joined as a list in a sentence."""
    if len(words) < 2:
        return "".join(words)
    return f"{', '.join(words[:-1])} and {words[-1]}"


def leg_labels(leg_names: Sequence[str]) -> dict[str, str]:
    """Return the label of each leg after the word "leg": its number if its name is one."""
    numbers = [re.fullmatch(r"[Ll]eg[_-]?(\d+)", name) for name in leg_names]
    labels = {
        name: match.group(1) if match else name
        for name, match in zip(leg_names, numbers, strict=True)
    }
    return labels if len(set(labels.values())) == len(labels) else {name: name for name in labels}


def legs_in_words(legs: Sequence[int], leg_names: Sequence[str]) -> str:
    """Return legs as a sentence names them: ``legs 1, 2 and 5``."""
    labels = leg_labels(leg_names)
    return f"leg{'s' * (len(legs) > 1)} {list_in_words([labels[leg_names[j]] for j in legs])}"


def describe_direction(parameters: Sequence[str], leg_names: Sequence[str]) -> str:
    """Return the parameters of a direction in words: ``z of platform joints 2 and 4 together``.

    Others are ``offset of leg 3``, ``direction of rail1`` and ``fx of camera c1``.
    """
    several = {_split(name, leg_names)[:2] for name in parameters}
    return parameters_in_words(parameters, leg_names) + " together" * (len(several) > 1)


def parameters_in_words(parameters: Sequence[str], leg_names: Sequence[str]) -> str:
    """Return parameters in words, grouped by kind: ``z of platform joints 2 and 4``."""
    coordinates: dict[tuple[str, str], list[str]] = {}
    for name in parameters:
        owner, kind, which = _split(name, leg_names)
        coordinates.setdefault((kind, owner), []).append(which)
    groups: dict[tuple[str, str], list[str]] = {}
    for (kind, owner), letters in coordinates.items():
        axes = list_in_words(sorted(letters))
        if kind == "radius" or kind in _OF_ACTUATOR:  # tube and rod, two angles
            axes = ""
        elif kind.endswith("_axis"):
            axes = f"angle{'s' * (len(letters) > 1)} {axes}"
        groups.setdefault((kind, axes), []).append(owner)
    phrases = []
    for (kind, axes), owners in groups.items():
        noun = _NOUN[kind][len(owners) > 1]
        labels = leg_labels(leg_names)
        legs = [labels[name] for name in leg_names if name in owners]
        ordered = [*legs, *(owner for owner in owners if owner not in leg_names)]
        phrases.append(f"{axes + ' of ' if axes else ''}{noun} {list_in_words(ordered)}")
    if len(phrases) > _MAX_GROUPS:
        more = len(phrases) - _MAX_GROUPS + 1
        phrases = [*phrases[: _MAX_GROUPS - 1], f"{more} more such changes"]
    return list_in_words(phrases)


def _split(name: str, leg_names: Sequence[str]) -> tuple[str, str, str]:
    """Return owner, kind and component of a parameter, for words.

    The owner of the size of a board is its link; an intrinsic parameter is a component of a camera,
    without kind.
    """
    if name in _BOARDS:
        return _BOARDS[name], "board", ""
    parameter = ParameterId.parse(name)
    if parameter.owner in leg_names and parameter.kind in _NOUN:
        return parameter.owner, parameter.kind, parameter.component
    if parameter.kind in _OF_ACTUATOR:
        return parameter.owner, parameter.kind, ""
    return parameter.owner, "", parameter.kind
