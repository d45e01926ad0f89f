"""The parameter vector of legs: names, units, where each number stands, and steps on it.

Parameters are joint centres in R_b and R_e, without those that are zero by the definition of these
frames (their gauge), lengths, two turns of each axis that is a parameter, and twists where asked.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import RigidTransform, Rotation

from legcal.geometry import Array, BoolArray, IntArray, cross, normal_basis
from legcal.machine.leg import N_LOCAL, KinematicParameters, Leg, LegKind
from legcal.machine.model import Machine

_LENGTH, _TWIST = 6, 11
_COLUMNS = (range(3), range(3, 6), (_LENGTH,), (7, 8), (9, 10), (_TWIST,))  # in this order
_LOCAL_NAMES = (
    *(f"{side}.{axis}" for side in ("base", "platform") for axis in "xyz"),
    "offset",
    *(f"{side}_axis.{angle}" for side in ("base", "platform") for angle in (1, 2)),
    "twist",
)


@dataclass(frozen=True, eq=False)
class Parametrization:
    """Where the numbers of each leg stand in a parameter vector."""

    names: tuple[str, ...]  # leg2.base.x, leg1.offset, leg1.length, leg1.base_axis.1, leg1.twist
    units: tuple[str, ...]  # m or rad
    place: IntArray  # (n_legs, 12) of A, B, length, turns of both axes, twist; -1 for no parameter

    def __len__(self) -> int:
        return len(self.names)

    def scatter(self, by_local: Array, leg: int) -> Array:
        """Return derivatives (..., 12) by a leg's numbers as derivatives by all parameters."""
        place = self.place[leg]
        wide = np.zeros((*by_local.shape[:-1], len(self)))
        wide[..., place[place >= 0]] = by_local[..., place >= 0]
        return wide


def parametrize(
    names: Sequence[str], legs: Sequence[Leg], frame_legs: Sequence[int], *, twists: bool = False
) -> Parametrization:
    """Return the parameters of legs in R_b and R_e; without *twists* these are fixed."""
    free = np.zeros((len(legs), N_LOCAL), dtype=np.bool_)
    free[:, :3] = free[:, 3:6] = free_coordinates(len(legs), frame_legs)
    for j, leg in enumerate(legs):
        free[j, _LENGTH] = leg.kind is not LegKind.PASSIVE
        free[j, 7:9] = leg.base_axis is not None
        free[j, 9:11] = leg.platform_axis is not None
        free[j, _TWIST] = twists and leg.twist is not None
        if leg.is_fixed_to_platform and leg.platform_axis is not None:  # B anywhere on the line
            free[j, 3 + int(np.argmax(np.abs(leg.platform_axis)))] = False
    found: list[tuple[str, str]] = []
    place = np.full(free.shape, -1, dtype=np.intp)
    for columns in _COLUMNS:
        for j, leg in enumerate(legs):
            for column in columns:
                if free[j, column]:
                    place[j, column] = len(found)
                    name = _LOCAL_NAMES[column]
                    if column == _LENGTH and leg.kind is LegKind.CONSTANT:
                        name = "length"
                    found.append((f"{names[j]}.{name}", "m" if column <= _LENGTH else "rad"))
    return Parametrization(tuple(n for n, _ in found), tuple(u for _, u in found), place)


def parametrization_of(machine: Machine, *, twists: bool = False) -> Parametrization:
    """Return the parameters of a mechanism; see :func:`parametrize`."""
    return parametrize(machine.leg_names, geometries(machine), machine.frame_legs, twists=twists)


def n_frame_legs(*, spatial: bool) -> int:
    """Return N_d, the number of legs whose joints define a frame."""
    return 3 if spatial else 2


def free_coordinates(n_legs: int, frame_legs: Sequence[int]) -> BoolArray:
    """Return which joint coordinates, (n_legs, 3), are not zero by the frame's definition.

    The frame legs' joints are origin, x axis and xy plane; a planar machine has two, and heights z
    are no parameters.
    """
    free = np.ones((n_legs, 3), dtype=np.bool_)
    free[:, 2] = len(frame_legs) == 3
    for rank, leg in enumerate(frame_legs):
        free[leg, rank:] = False
    return free


def geometries(machine: Machine) -> tuple[Leg, ...]:
    """Return the legs of a mechanism in its joint frames: A and axes in R_b, B and axes in R_e."""
    parameters = machine.parameters
    moved = _in_frames(machine.legs, machine.T_base_Rb.inv(), machine.T_platform_Re.inv())
    return tuple(
        replace(leg, A=A, B=B)  # zero by definition, not by rounding
        for leg, A, B in zip(moved, parameters.base_joints, parameters.platform_joints, strict=True)
    )


def in_links(machine: Machine, legs: Sequence[Leg]) -> tuple[Leg, ...]:
    """Return legs in R_b and R_e as they stand in the links, the inverse of :func:`geometries`."""
    return _in_frames(legs, machine.T_base_Rb, machine.T_platform_Re)


def _in_frames(
    legs: Sequence[Leg], T_base: RigidTransform, T_platform: RigidTransform
) -> tuple[Leg, ...]:
    """Return legs in other frames of base and platform."""

    def turned(T: RigidTransform, axis: Array | None) -> Array | None:
        return None if axis is None else np.asarray(T.rotation.apply(axis))

    return tuple(
        replace(
            leg,
            A=np.asarray(T_base.apply(leg.A)),
            B=np.asarray(T_platform.apply(leg.B)),
            base_axis=turned(T_base, leg.base_axis),
            platform_axis=turned(T_platform, leg.platform_axis),
            twist=twist_after(leg, T_platform.rotation),
        )
        for leg in legs
    )


def to_vector(parameters: KinematicParameters, frame_legs: Sequence[int]) -> Array:
    """Return parameters as one vector [m], passive or not, as :func:`parametrize` orders them."""
    free = free_coordinates(len(parameters.offsets), frame_legs)
    return np.concatenate(
        [parameters.base_joints[free], parameters.platform_joints[free], parameters.offsets]
    )


def from_vector(vector: Array, n_legs: int, frame_legs: Sequence[int]) -> KinematicParameters:
    """Return the parameters of a vector laid out as in :func:`to_vector`."""
    free = free_coordinates(n_legs, frame_legs)
    base, platform = np.zeros((n_legs, 3)), np.zeros((n_legs, 3))
    base[free], platform[free], offsets = np.split(vector, [free.sum(), 2 * free.sum()])
    return KinematicParameters(base, platform, offsets.copy())


def vector_of(
    parametrization: Parametrization, legs: Sequence[Leg], nominal: Sequence[Leg]
) -> Array:
    """Return the parameters of legs as a vector [m, rad].

    Axes are rotations of the nominal ones: v = exp([w]_x) v_nominal with w = w_1 e_1 + w_2 e_2 and
    e_1, e_2 the :func:`legcal.geometry.normal_basis` of v_nominal.
    """
    vector = np.zeros(len(parametrization))
    for leg, start, place in zip(legs, nominal, parametrization.place, strict=True):
        turns = _turn(leg.base_axis, start.base_axis), _turn(leg.platform_axis, start.platform_axis)
        local = np.concatenate([leg.A, leg.B, [leg.q0], *turns, [_twist(leg, start)]])
        vector[place[place >= 0]] = local[place >= 0]
    return vector


def moved_legs(legs: Sequence[Leg], place: IntArray, step: Array) -> tuple[Leg, ...]:
    """Return legs after a small step of the parameters, which stand at *place* of it."""
    padded = np.append(step, 0.0)
    moved = []
    for leg, local in zip(legs, padded[place], strict=True):
        twist = leg.twist
        if twist is not None:
            twist = twist_after(leg, turn_of(leg.platform_axis, local[9:11]))
        moved.append(
            replace(
                leg,
                A=leg.A + local[:3],
                B=leg.B + local[3:6],
                q0=leg.q0 + float(local[6]),
                base_axis=turned(leg.base_axis, local[7:9]),
                platform_axis=turned(leg.platform_axis, local[9:11]),
                twist=None if twist is None else twist + float(local[11]),
            )
        )
    return tuple(moved)


def with_platform_foot(legs: Sequence[Leg], origin: Array) -> tuple[Leg, ...]:
    """Return legs with B where models put it on those that are fixed to the platform.

    Nothing depends on where B lies on the line of such a leg; models take the foot of the platform
    link's origin, *origin* (3,) in R_e [m].
    """
    found = []
    for leg in legs:
        if leg.is_fixed_to_platform and leg.platform_axis is not None:
            along = float((origin - leg.B) @ leg.platform_axis)
            leg = replace(leg, B=leg.B + along * leg.platform_axis, q0=leg.q0 + along)
        found.append(leg)
    return tuple(found)


def turned(axis: Array | None, turn: Array) -> Array | None:
    """Return an axis turned by two angles about its :func:`normal_basis`."""
    return None if axis is None else np.asarray(turn_of(axis, turn).apply(axis))


def turn_of(axis: Array | None, turn: Array) -> Rotation:
    """Return the rotation by two angles about the :func:`normal_basis` of an axis."""
    return Rotation.from_rotvec(np.zeros(3) if axis is None else turn @ normal_basis(axis))


def twist_after(leg: Leg, turn: Rotation) -> float | None:
    """Return the twist of a leg after its platform axis has been turned, and what is tied to it.

    The twist of a leg that is fixed to the platform counts to the first :func:`normal_basis` vector
    of its direction, which is not turned with it.
    """
    if leg.twist is None or leg.platform_axis is None or not leg.is_fixed_to_platform:
        return leg.twist
    outer = np.asarray(turn.apply(normal_basis(leg.platform_axis)[0]))
    e1, e2 = normal_basis(np.asarray(turn.apply(leg.platform_axis)))
    twist = leg.twist - float(np.arctan2(outer @ e2, outer @ e1))
    return float(twist - np.pi * np.ceil(twist / np.pi - 0.5))


def _turn(axis: Array | None, nominal: Array | None) -> Array:
    """Return the two angles by which an axis, a line, is turned from the nominal one [rad]."""
    if axis is None or nominal is None:
        return np.zeros(2)
    if axis @ nominal < 0.0:
        axis = -axis
    turn = cross(nominal, axis)
    sine = float(np.sqrt(turn @ turn))
    scale = 1.0 if sine == 0.0 else float(np.arctan2(sine, axis @ nominal)) / sine
    return np.asarray(normal_basis(nominal) @ (scale * turn))


def turn_slope(axis: Array | None, nominal: Array | None) -> Array:
    """Return the derivative (2, 2) of the angles of an axis from the nominal one by its turns.

    Turns are about the :func:`normal_basis` of the axis where it is now.
    """
    if axis is None or nominal is None:
        return np.eye(2)
    seen = -axis if axis @ nominal < 0.0 else axis
    by_turn = cross(normal_basis(axis), seen)
    turn, d_turn = cross(nominal, seen), cross(nominal, by_turn)
    sine, cosine = float(np.sqrt(turn @ turn)), float(nominal @ seen)
    if sine == 0.0:
        return np.asarray(normal_basis(nominal) @ d_turn.T)
    scale = float(np.arctan2(sine, cosine)) / sine
    d_sine = d_turn @ turn / sine
    d_scale = (cosine * d_sine - sine * (by_turn @ nominal) - scale * d_sine) / sine
    return np.asarray(normal_basis(nominal) @ (scale * d_turn + np.outer(d_scale, turn)).T)


def tied_twist(leg: Leg, nominal: Leg, twist: float) -> float | None:
    """Return the twist of a leg that had another one where its platform axis was nominal [rad].

    The axis went from there by the smallest rotation: what is tied to it has turned about it on any
    other way.
    """
    turn = turn_between(nominal.platform_axis, leg.platform_axis)
    return twist_after(replace(nominal, twist=twist), turn)


def tied_twist_slope(leg: Leg, nominal: Leg) -> Array:
    """Return the derivative (2,) of :func:`tied_twist` by turns of the platform axis.

    Beyond the turn that :func:`twist_after` knows: the angle by which the nominal axis, the leg's
    and the turned one, as corners of a spherical triangle, exceed pi.
    """
    u, n = leg.platform_axis, nominal.platform_axis
    if u is None or n is None or not leg.is_fixed_to_platform:
        return np.zeros(2)
    n = n if n @ u > 0.0 else -n
    e1, e2 = normal_basis(u)
    return np.array([-e2, e1]) @ np.cross(n, u) / (1.0 + float(n @ u))


def _twist(leg: Leg, nominal: Leg) -> float:
    """Return the twist that a leg has with its axes turned back, nearest to the nominal one [rad].

    Twists are angles between lines.
    """
    twist = twist_after(leg, turn_between(nominal.platform_axis, leg.platform_axis).inv())
    if twist is None or nominal.twist is None:
        return 0.0
    return float(twist - np.pi * np.round((twist - nominal.twist) / np.pi))


def turn_between(nominal: Array | None, axis: Array | None) -> Rotation:
    """Return the smallest rotation that takes a nominal axis to an axis, both as lines."""
    angles = _turn(axis, nominal)
    return Rotation.from_rotvec(np.zeros(3) if nominal is None else angles @ normal_basis(nominal))
