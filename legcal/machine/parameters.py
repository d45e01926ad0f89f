"""Steps of the parameters of legs: joint centres, lengths, turns of axes, twists."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.linalg import qr
from scipy.spatial.transform import RigidTransform, Rotation

from legcal.geometry import Array, BoolArray, IntArray, normal_basis
from legcal.machine.leg import N_LOCAL, LegGeometry, LegKind, free_coordinates, geometry_of
from legcal.machine.model import Mechanism

_LENGTH, _TWIST = 6, 11


@dataclass(frozen=True, eq=False)
class Parametrization:
    """Where the numbers of each leg stand in a parameter vector.

    Attributes
    ----------
    names : tuple of str
        ``leg2.base.x``, ``leg1.offset``, ``leg1.length``, ``leg1.base_axis.1``, ``leg1.twist``.
    units : tuple of str
        ``m`` or ``rad``.
    place : (n_legs, 12) array of int
        Position of A, B, length, turns of both axes, twist of each leg; -1 for what is
        no parameter. The order is that of :class:`legcal.machine.equations.Linearization`.
    """

    names: tuple[str, ...]
    units: tuple[str, ...]
    place: IntArray

    def __len__(self) -> int:
        return len(self.names)

    def scatter(self, by_local: Array, leg: int) -> Array:
        """Return derivatives (..., 12) by a leg's numbers as derivatives by all parameters."""
        place = self.place[leg]
        wide = np.zeros((*by_local.shape[:-1], len(self)))
        wide[..., place[place >= 0]] = by_local[..., place >= 0]
        return wide


def geometries(mechanism: Mechanism) -> tuple[LegGeometry, ...]:
    """Return the legs of a mechanism in its joint frames: A and axes in R_b, B and axes in R_e."""
    T_Rb, T_Re = mechanism.T_base_Rb.inv(), mechanism.T_platform_Re.inv()
    parameters = mechanism.parameters
    return tuple(
        replace(
            geometry_of(leg),
            A=parameters.base_joints[j],
            B=parameters.platform_joints[j],
            base_axis=_turned(T_Rb, leg.base_axis),
            platform_axis=_turned(T_Re, leg.platform_axis),
            twist=twist_after(geometry_of(leg), T_Re.rotation),
        )
        for j, leg in enumerate(mechanism.legs)
    )


def in_links(mechanism: Mechanism, legs: Sequence[LegGeometry]) -> tuple[LegGeometry, ...]:
    """Return legs in R_b and R_e as they stand in the links, the frames on their nominal places.

    The inverse of :func:`geometries` where the legs are those of the mechanism.

    Parameters
    ----------
    mechanism : Mechanism
        The machine whose R_b and R_e are taken.
    legs : sequence of LegGeometry
        Its legs, or others like them, in R_b and R_e.
    """
    T_base, T_platform = mechanism.T_base_Rb, mechanism.T_platform_Re
    return tuple(
        replace(
            leg,
            A=np.asarray(T_base.apply(leg.A)),
            B=np.asarray(T_platform.apply(leg.B)),
            base_axis=_turned(T_base, leg.base_axis),
            platform_axis=_turned(T_platform, leg.platform_axis),
            twist=twist_after(leg, T_platform.rotation),
        )
        for leg in legs
    )


def twist_after(leg: LegGeometry, turn: Rotation) -> float | None:
    """Return the twist of a leg after its platform axis has been turned, and what is tied to it.

    The twist of a leg that is fixed to the platform counts to the first :func:`normal_basis` vector
    of its direction, which is not turned with it.
    """
    if leg.twist is None or leg.platform_axis is None or leg.platform_joint != "":
        return leg.twist
    outer = np.asarray(turn.apply(normal_basis(leg.platform_axis)[0]))
    e1, e2 = normal_basis(np.asarray(turn.apply(leg.platform_axis)))
    twist = leg.twist - float(np.arctan2(outer @ e2, outer @ e1))
    return float(twist - np.pi * np.ceil(twist / np.pi - 0.5))


def parametrize(
    names: Sequence[str],
    legs: Sequence[LegGeometry],
    frame_legs: Sequence[int],
    *,
    twists: bool = False,
) -> Parametrization:
    """Return the parameters of legs.

    Parameters
    ----------
    names : sequence of str
        Leg names.
    legs : sequence of LegGeometry
        The legs in R_b and R_e.
    frame_legs : sequence of int
        The legs that define R_b and R_e: three in space, two in a plane.
    twists : bool
        Count the twists of legs without an S joint; they are held at nominal otherwise.

    Returns
    -------
    Parametrization
    """
    free = _free(legs, frame_legs, twists=twists)
    found: list[tuple[str, str]] = []
    place = np.full(free.shape, -1, dtype=np.intp)
    for columns in (range(3), range(3, 6), (_LENGTH,), (7, 8), (9, 10), (_TWIST,)):
        for j, leg in enumerate(legs):
            for column in columns:
                if free[j, column]:
                    place[j, column] = len(found)
                    unit = "m" if column <= _LENGTH else "rad"
                    found.append((f"{names[j]}.{_local_name(column, leg.kind)}", unit))
    return Parametrization(tuple(n for n, _ in found), tuple(u for _, u in found), place)


def parametrization_of(mechanism: Mechanism, *, twists: bool = False) -> Parametrization:
    """Return the parameters of a mechanism; see :func:`parametrize`."""
    return parametrize(
        mechanism.leg_names, geometries(mechanism), mechanism.frame_legs, twists=twists
    )


def vector_of(
    parametrization: Parametrization, legs: Sequence[LegGeometry], nominal: Sequence[LegGeometry]
) -> Array:
    """Return the parameters of legs as a vector [m, rad].

    Axes are rotations of the nominal ones: v = exp([w]_x) v_nominal with w = w_1 e_1 + w_2 e_2 and
    e_1, e_2 the :func:`legcal.geometry.lines.normal_basis` of v_nominal.

    Parameters
    ----------
    parametrization : Parametrization
        Which parameters.
    legs, nominal : sequence of LegGeometry
        The legs, and those whose axes count as zero.
    """
    vector = np.zeros(len(parametrization))
    for leg, start, place in zip(legs, nominal, parametrization.place, strict=True):
        local = np.concatenate(
            [
                leg.A,
                leg.B,
                [leg.q0],
                _turn(leg.base_axis, start.base_axis),
                _turn(leg.platform_axis, start.platform_axis),
                [_twist(leg, start)],
            ]
        )
        vector[place[place >= 0]] = local[place >= 0]
    return vector


def _free(legs: Sequence[LegGeometry], frame_legs: Sequence[int], *, twists: bool) -> BoolArray:
    """Return which numbers of each leg are parameters, (n_legs, 12)."""
    free = np.zeros((len(legs), N_LOCAL), dtype=np.bool_)
    joints = free_coordinates(len(legs), frame_legs)
    free[:, :3], free[:, 3:6] = joints, joints
    for j, leg in enumerate(legs):
        free[j, _LENGTH] = leg.kind is not LegKind.PASSIVE
        free[j, 7:9] = leg.base_axis is not None
        free[j, 9:11] = leg.platform_axis is not None
        free[j, _TWIST] = twists and leg.twist is not None
        if leg.platform_joint == "" and leg.platform_axis is not None:
            free[j, 3 + int(np.argmax(np.abs(leg.platform_axis)))] = False
    return free


def _local_name(column: int, kind: LegKind) -> str:
    """Return the name of one number of a leg."""
    if column < 6:
        return f"{'base' if column < 3 else 'platform'}.{'xyz'[column % 3]}"
    if column == _LENGTH:
        return "length" if kind is LegKind.CONSTANT else "offset"
    if column == _TWIST:
        return "twist"
    return f"{'base' if column < 9 else 'platform'}_axis.{2 - column % 2}"


def _turned(T: RigidTransform, axis: Array | None) -> Array | None:
    """Return an axis in another frame."""
    return None if axis is None else np.asarray(T.rotation.apply(axis))


def _turn(axis: Array | None, nominal: Array | None) -> Array:
    """Return the two angles by which an axis, a line, is turned from the nominal one [rad]."""
    if axis is None or nominal is None:
        return np.zeros(2)
    if axis @ nominal < 0.0:
        axis = -axis
    turn = _cross(nominal, axis)
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
    by_turn = _cross(normal_basis(axis), seen)
    turn, d_turn = _cross(nominal, seen), _cross(nominal, by_turn)
    sine, cosine = float(np.sqrt(turn @ turn)), float(nominal @ seen)
    if sine == 0.0:
        return np.asarray(normal_basis(nominal) @ d_turn.T)
    scale = float(np.arctan2(sine, cosine)) / sine
    d_sine = d_turn @ turn / sine
    d_scale = (cosine * d_sine - sine * (by_turn @ nominal) - scale * d_sine) / sine
    return np.asarray(normal_basis(nominal) @ (scale * d_turn + np.outer(d_scale, turn)).T)


def tied_twist(leg: LegGeometry, nominal: LegGeometry, twist: float) -> float | None:
    """Return the twist of a leg that had another one where its platform axis was nominal [rad].

    The axis went from there by the smallest rotation: what is tied to it has turned about it on any
    other way.
    """
    turn = turn_between(nominal.platform_axis, leg.platform_axis)
    return twist_after(replace(nominal, twist=twist), turn)


def tied_twist_slope(leg: LegGeometry, nominal: LegGeometry) -> Array:
    """Return the derivative (2,) of :func:`tied_twist` by turns of the platform axis.

    Beyond the turn that :func:`twist_after` knows: the angle by which the nominal axis, the leg's
    and the turned one, as corners of a spherical triangle, exceed pi.
    """
    u, n = leg.platform_axis, nominal.platform_axis
    if u is None or n is None or leg.platform_joint != "":
        return np.zeros(2)
    n = n if n @ u > 0.0 else -n
    e1, e2 = normal_basis(u)
    return np.array([-e2, e1]) @ np.cross(n, u) / (1.0 + float(n @ u))


def _twist(leg: LegGeometry, nominal: LegGeometry) -> float:
    """Return the twist that a leg has with its axes turned back, nearest to the nominal one [rad].

    Twists are angles between lines.
    """
    twist = twist_after(leg, turn_between(nominal.platform_axis, leg.platform_axis).inv())
    if twist is None or nominal.twist is None:
        return 0.0
    return float(twist - np.pi * np.round((twist - nominal.twist) / np.pi))


def _cross(a: Array, b: Array) -> Array:
    """Return vector products along the last axis; np.cross is slow."""
    here, there = [1, 2, 0], [2, 0, 1]
    return np.asarray(a[..., here] * b[..., there] - a[..., there] * b[..., here])


def turn_between(nominal: Array | None, axis: Array | None) -> Rotation:
    """Return the smallest rotation that takes a nominal axis to an axis, both as lines."""
    angles = _turn(axis, nominal)
    return Rotation.from_rotvec(np.zeros(3) if nominal is None else angles @ normal_basis(nominal))


_MOST_GROUPS = 4  # of joints in one direction
_NOUN = {
    "base": ("base joint", "base joints"),
    "platform": ("platform joint", "platform joints"),
    "offset": ("offset of leg", "offsets of legs"),
    "length": ("length of leg", "lengths of legs"),
    "base_axis": ("base axis of leg", "base axes of legs"),
    "platform_axis": ("platform axis of leg", "platform axes of legs"),
    "twist": ("twist of leg", "twists of legs"),
    "radius": ("radius of leg", "radii of legs"),
    "": ("camera", "cameras"),
}


def joined(words: Sequence[str]) -> str:
    """Return words as a list in a sentence."""
    if len(words) < 2:
        return "".join(words)
    return f"{', '.join(words[:-1])} and {words[-1]}"


def leg_labels(leg_names: Sequence[str]) -> dict[str, str]:
    """Return what to call each leg after the word leg: its number where its name is one."""
    numbers = [re.fullmatch(r"[Ll]eg[_-]?(\d+)", name) for name in leg_names]
    labels = {
        name: match.group(1) if match else name
        for name, match in zip(leg_names, numbers, strict=True)
    }
    return labels if len(set(labels.values())) == len(labels) else {name: name for name in labels}


def describe_direction(parameters: Sequence[str], leg_names: Sequence[str]) -> str:
    """Return a combination of parameters in words.

    Parameters
    ----------
    parameters : sequence of str
        Names of the parameters that change.
    leg_names : sequence of str
        All legs.

    Returns
    -------
    str
        ``z of platform joints 2 and 4 together``, ``offset of leg 3``, ``fx of camera c1``.
    """
    coordinates: dict[tuple[str, str], list[str]] = {}
    for name in parameters:
        owner, kind, which = _split(name, leg_names)
        coordinates.setdefault((kind, owner), []).append(which)
    groups: dict[tuple[str, str], list[str]] = {}
    for (kind, owner), found in coordinates.items():
        axes = joined(sorted(found))
        if kind == "radius":  # a tube and a rod of one leg
            axes = ""
        elif kind.endswith("_axis"):
            axes = f"angle{'s' * (len(found) > 1)} {axes}"
        groups.setdefault((kind, axes), []).append(owner)
    phrases = []
    for (kind, axes), owners in groups.items():
        noun = _NOUN[kind][len(owners) > 1]
        ordered = _labelled(owners, leg_names)
        phrases.append(f"{axes + ' of ' if axes else ''}{noun} {joined(ordered)}")
    if len(phrases) > _MOST_GROUPS:
        more = len(phrases) - _MOST_GROUPS + 1
        phrases = [*phrases[: _MOST_GROUPS - 1], f"{more} more such changes"]
    together = " together" if len(coordinates) > 1 else ""
    return f"{joined(phrases)}{together}"


def _labelled(owners: Sequence[str], leg_names: Sequence[str]) -> list[str]:
    """Return what to call legs, in their order, or cameras."""
    labels = leg_labels(leg_names)
    legs = [labels[name] for name in leg_names if name in owners]
    return [*legs, *(owner for owner in owners if owner not in leg_names)]


def _split(name: str, leg_names: Sequence[str]) -> tuple[str, str, str]:
    """Return leg, kind and coordinate of a parameter, or view, nothing and coordinate.

    Names of legs may contain dots.
    """
    leg = max((n for n in leg_names if name.startswith(f"{n}.")), key=len, default="")
    kind, _, which = name[len(leg) + 1 :].partition(".")
    if leg and kind in _NOUN:
        return leg, kind, which
    view, _, which = name.rpartition(".")
    return view, "", which


SHOWN = 0.02  # of the largest component


def split_by_motion(
    motion: Array | None, basis: Array, length: float, harmless: float
) -> tuple[Array, Array]:
    """Return a space of directions as that which moves the platform and that which does not.

    Parameters
    ----------
    motion : (k, 6, p) array or None
        Rotation [rad] and displacement [m] of the platform at k poses by each parameter, all
        in metres; None where the motors do not determine the pose, and everything counts.
    basis : (w, p) array
        Orthonormal basis of the space.
    length : float
        Mean leg length, by which rotations become displacements [m].
    harmless : float
        Motion of the platform, as a part of the change of the parameters, that counts as none.

    Returns
    -------
    moving, still : (a, p) and (b, p) array
        Orthonormal bases, a + b = w.
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
    """Return a basis of the same space in which each direction has a parameter for itself."""
    if len(basis) == 0:
        return basis
    _, upper, order = qr(basis, mode="economic", pivoting=True)
    w = len(basis)
    sparse = np.zeros_like(basis)
    sparse[:, order] = np.linalg.solve(upper[:, :w], upper)
    sparse[np.abs(sparse) < 1e-9] = 0.0
    first = np.argmax(np.abs(sparse) > SHOWN * np.abs(sparse).max(axis=1, keepdims=True), axis=1)
    return np.asarray(sparse[np.argsort(first, kind="stable")])


def moved_legs(
    legs: Sequence[LegGeometry], place: IntArray, step: Array
) -> tuple[LegGeometry, ...]:
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


def footed(legs: Sequence[LegGeometry], origin: Array) -> tuple[LegGeometry, ...]:
    """Return legs with B where models put it on those that are fixed to the platform.

    Nothing depends on where B lies on the line of such a leg; models take the foot of the platform
    link's origin.

    Parameters
    ----------
    legs : sequence of LegGeometry
        Legs in R_b and R_e.
    origin : (3,) array
        Origin of the platform link in R_e [m].
    """
    found = []
    for leg in legs:
        if leg.platform_joint == "" and leg.platform_axis is not None:
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
