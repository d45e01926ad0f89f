"""Ties: equations between the parameters of legs that hold exactly, independent of measurements.

A leg that is fixed to the platform and defines R_e has B at its
:func:`~legcal.machine.leg.frame_point`: shifting B along the leg together with its offset has no
effect.

An overconstrained machine has more joint constraints than removed freedoms (an Exechon, whose axes
are parallel in pairs). Errors of its parameters keep the mobility if the constraints stay
dependent: at every pose where they hold the machine has self-stresses, forces w of its joints in
equilibrium, w . F_pose = 0, and a step of the parameters must do no work on any of them, w . F_xi
step = 0. Over several postures (poses with motor readings) these are the ties; parameters move on
the manifold where all of them hold.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import NamedTuple

import numpy as np

from legcal.geometry.lines import cross, normal_basis
from legcal.geometry.types import Array, BoolArray, IntArray
from legcal.machine.equations import (
    PoseEquations,
    n_pose_constraints,
    posture_constraints,
)
from legcal.machine.leg import Leg, LegColumns, frame_point, mean_length
from legcal.machine.model import Machine
from legcal.machine.parameters import (
    SHOWN,
    Parametrization,
    geometries,
    is_spatial,
    moved_legs,
    parameters_in_words,
    parametrization_of,
    sparse_basis,
)
from legcal.machine.rods import actuators_of, readings_of_rods
from legcal.machine.solver import poses_after

_POSES, _TEST_POSES = (8, 16, 32, 64), 4  # postures that define the ties, and that test them
_REACH = 0.15  # distance of postures from home [rad], and in mean leg lengths
_RANK, _NEARLY = 1e-7, 1e-3  # singular value of (nearly) dependent rows, relative to the largest
_AT_REST, _STEPS = 2.5e-13, 30  # last Gauss-Newton step [mean leg lengths, rad], and number
_TRIAL = 1e-3  # errors that a machine must be able to have [mean leg lengths, rad]
_WHOLLY = 1e-9
_CLOSED = 1e-10  # residual of a closed posture, in mean leg lengths


class TieRows(NamedTuple):
    """The residuals and derivatives of ties at some legs."""

    values: Array  # (m,) residuals [m]
    by_local: Array  # (m, n_legs, 21) derivative by the numbers of legs (LegColumns)


class _Postures(NamedTuple):
    """Poses of R_e in R_b with readings of actuators."""

    R: Array  # (k, 3, 3)
    t: Array  # (k, 3) [m]
    q: Array  # (k, n) [m or rad]


_NOWHERE = _Postures(np.zeros((0, 3, 3)), np.zeros((0, 3)), np.zeros((0, 0)))


@dataclass(frozen=True, eq=False)
class Ties:
    """The ties between the parameters of the legs of a machine, in R_b and R_e."""

    frame_legs: tuple[int, ...]
    points: tuple[int, ...] = ()  # frame legs fixed to the platform
    n_dependent: int = 0  # number of dependent constraints at a pose
    postures: _Postures = _NOWHERE  # postures at which constraints define ties

    def __bool__(self) -> bool:
        return bool(self.points) or self.n_dependent > 0

    def at(self, legs: Sequence[Leg]) -> TieRows:
        """Return the ties at legs; those of constraints are not independent of each other."""
        shape = len(legs), LegColumns.COUNT
        parts = [(np.zeros(0), np.zeros((0, *shape)))]
        for j in self.points:
            value, row = self._point(legs, j)
            parts.append((np.array([value]), row[None]))
        if self.n_dependent:
            _, equations, stress = _closed(legs, self.n_dependent, self.postures)
            wide = np.zeros((*equations.values.shape, *shape))
            wide[:, np.arange(len(equations.leg)), equations.leg] = equations.by_local
            rows = np.einsum("kms,kmjc->ksjc", stress, wide)
            values = np.einsum("kms,km->ks", stress, equations.values)
            parts.append((values.ravel(), rows.reshape(-1, *shape)))
        values, rows = zip(*parts, strict=True)
        return TieRows(np.concatenate(values), np.concatenate(rows))

    def _point(self, legs: Sequence[Leg], leg: int) -> tuple[float, Array]:
        """Return the distance of B of a leg past its frame point, with derivative (n_legs, 12)."""
        B, u = legs[leg].B, np.asarray(legs[leg].platform_axis)
        others = [j for j in self.frame_legs if j not in self.points]
        row = np.zeros((len(legs), LegColumns.COUNT))
        row[leg, LegColumns.B] = u
        away = B - np.mean([legs[j].B for j in others], axis=0)
        row[leg, LegColumns.PLATFORM_AXIS] = cross(normal_basis(u), u) @ away
        for j in others:
            row[j, LegColumns.B] -= u / len(others)
        if len(others) == 2:
            between = legs[others[0]].B - legs[others[1]].B
            between /= np.linalg.norm(between)
            row[others[0], LegColumns.B] -= 0.5 * between
            row[others[1], LegColumns.B] += 0.5 * between
        return float((B - frame_point(legs, self.frame_legs, leg)) @ u), row


def ties_of(
    legs: Sequence[Leg],
    frame_legs: Sequence[int],
    # (3, 4) R_e in R_b at a closed home; without it constraints define no ties
    home: Array | None = None,
) -> Ties:
    """Return the ties of a machine from its nominal legs in R_b and R_e."""
    fixed = [j for j in frame_legs if legs[j].is_fixed_to_platform]
    defined = any(not legs[j].is_fixed_to_platform for j in frame_legs)
    ties = Ties(tuple(frame_legs), tuple(fixed) if defined else ())
    n_dependent = 0 if home is None or not is_spatial(frame_legs) else _n_dependent(legs, home)
    if home is None or n_dependent == 0:
        return ties
    for n in _POSES:
        at = _postures_near(legs, n_dependent, home, n, 0)
        ties = replace(ties, n_dependent=n_dependent, postures=at)
        alone = replace(ties, points=())
        rows = alone.at(legs).by_local.reshape(-1, len(legs) * LegColumns.COUNT)
        if np.linalg.matrix_rank(rows, _RANK) < len(rows):  # more poses add no ties
            break
    return ties


@lru_cache(maxsize=8)  # a job needs those of one or two machines several times
def machine_ties(machine: Machine) -> Ties:
    """Return the ties of a mechanism; see :func:`ties_of`."""
    return ties_of(geometries(machine), machine.frame_legs, _home(machine))


def _home(machine: Machine) -> Array:
    """Return the home of R_e in R_b, (3, 4)."""
    return np.asarray(machine.home_of_frames.as_matrix()[:3])


def independent(rows: TieRows, by_unknowns: Array, n: int | None = None) -> tuple[Array, Array]:
    """Return independent ties (w,) with orthonormal derivatives (w, p), equivalent to rows (m, p).

    Without *n* all ties must hold at the machine: elsewhere more seem independent.
    """
    left, singular, right = np.linalg.svd(by_unknowns, full_matrices=False)
    if n is None:
        n = int(np.sum(singular > _RANK * singular.max(initial=0.0)))
    return (left.T @ rows.values)[:n] / singular[:n], right[:n]


def by_step(rows: TieRows, place: IntArray) -> Array:
    """Return derivatives (m, p) by steps of parameters with indices *place* (n_legs, 21).

    Legs may share parameters, those of actuators.
    """
    by_parameter = np.zeros((int(place.max(initial=-1)) + 1, len(rows.values)))
    np.add.at(by_parameter, place[place >= 0], rows.by_local[:, place >= 0].T)
    return by_parameter.T


def on_ties(
    legs: Sequence[Leg], nominal: Sequence[Leg], ties: Ties, place: IntArray, scale: Array
) -> tuple[Leg, ...]:
    """Return legs moved onto the ties, which hold at the nominal legs.

    Parameters move as little as possible relative to *scale* (p,), not at all if it is zero; their
    indices are *place* (n_legs, 21).
    """
    if not ties:
        return tuple(legs)
    at_nominal = ties.at(nominal)
    n = len(independent(at_nominal, by_step(at_nominal, place) * scale)[1])
    for _ in range(_STEPS):
        rows = ties.at(legs)
        left, along = independent(rows, by_step(rows, place) * scale, n)
        step = -(along.T @ left)
        legs = moved_legs(legs, place, scale * step)
        if np.abs(step).max(initial=0.0) < _AT_REST:
            break
    return tuple(legs)


def wholly_tied(rows: Array) -> BoolArray:
    """Return which parameters (p,) cannot move at all, given orthonormal ties (w, p)."""
    return np.asarray(np.sum(rows**2, axis=0) > 1.0 - _WHOLLY)


def n_dependent_at_home(machine: Machine) -> int:
    """Return the number of dependent joint constraints at home, even if only there."""
    return _n_dependent_at(geometries(machine), _home(machine), _RANK)


def n_nearly_dependent(machine: Machine) -> int:
    """Return the number of joint constraints that are dependent up to 1 mrad."""
    if not machine.spatial:
        return 0
    return _n_dependent(geometries(machine), _home(machine), _NEARLY)


def is_tied(legs: Sequence[Leg], ties: Ties, parametrization: Parametrization) -> bool:
    """Return whether a machine with small errors can be moved back to its mobility along the ties.

    Then its constraints hold at further postures, with the same number of dependent ones.
    """
    if ties.n_dependent == 0:
        return True
    home = np.concatenate([ties.postures.R[0], ties.postures.t[0][:, None]], axis=1)
    length = mean_length(legs, home)
    unit = np.where([name == "m" for name in parametrization.units], length, 1.0)
    step = _TRIAL * unit * np.random.default_rng(1).uniform(-1.0, 1.0, len(unit))
    place = parametrization.place
    moved = on_ties(moved_legs(legs, place, step), legs, ties, place, unit)
    there = _postures_near(moved, ties.n_dependent, home, _TEST_POSES, 1)
    missed = np.abs(posture_constraints(moved, *there).values).max()
    return bool(missed < _CLOSED * length)


def ties_in_words(machine: Machine) -> str | None:
    """Return the ties between joints of an overconstrained machine in words, None without any."""
    ties, parametrization = machine_ties(machine), parametrization_of(machine, twists=True)
    if ties.n_dependent == 0:
        return None
    rows = ties.at(geometries(machine))
    scale = np.where([name == "m" for name in parametrization.units], machine.size, 1.0)
    tied = sparse_basis(independent(rows, by_step(rows, parametrization.place) * scale)[1])
    is_alone = np.sum(np.abs(tied) > SHOWN, axis=1) == 1
    alone = [parametrization.names[i] for i in np.argmax(np.abs(tied[is_alone]), axis=1)]
    words = [f"{parameters_in_words(alone, machine.leg_names)} do not change"] if alone else []
    together = np.flatnonzero(np.any(np.abs(tied[~is_alone]) > SHOWN, axis=0))
    names = [parametrization.names[i] for i in together]
    if names:
        words.append(f"{parameters_in_words(names, machine.leg_names)} change only together")
    n = n_pose_constraints(machine.legs)
    return (
        f"The machine is overconstrained: {ties.n_dependent} of the {n} constraints of its joints "
        f"follow{'s' * (ties.n_dependent == 1)} from the others. To keep this so, "
        f"{len(tied)} combinations of its parameters are tied: {'; '.join(words)}."
    )


def _slopes(legs: Sequence[Leg], equations: PoseEquations, home: Array) -> tuple[Array, Array]:
    """Return derivatives (k, m, 6 + n) by postures, and their units, (6 + n,)."""
    joints = actuators_of(legs)
    length = mean_length(legs, home)
    unit = np.array([length] * 3 + [1.0] * 3 + [length if j.turns else 1.0 for j in joints])
    return np.concatenate([equations.by_pose, equations.by_q], axis=2) / unit, unit


def _n_dependent(legs: Sequence[Leg], home: Array, least: float = _RANK) -> int:
    """Return the number of dependent constraints at home and at postures around it."""
    dependent = _n_dependent_at(legs, home, least)
    if dependent == 0:
        return 0
    # If only home is special, the constraints are independent nearby.
    around = posture_constraints(legs, *_postures_near(legs, dependent, home, _TEST_POSES, 2))
    singular = np.linalg.svd(_slopes(legs, around, home)[0], compute_uv=False)
    rank = np.sum(singular > least * singular[:, :1], axis=1)
    return len(around.leg) - int(rank.max())


def _n_dependent_at(legs: Sequence[Leg], home: Array, least: float) -> int:
    """Return the number of dependent constraints at one pose (3, 4)."""
    R, t = home[None, :, :3], home[None, :, 3]
    here = posture_constraints(legs, R, t, readings_of_rods(legs, R, t))
    if len(here.leg) < 2:
        return 0
    singular_values = np.linalg.svd(_slopes(legs, here, home)[0][0], compute_uv=False)
    return len(here.leg) - int(np.sum(singular_values > least * singular_values[0]))


def _postures_near(
    legs: Sequence[Leg], n_dependent: int, home: Array, n: int, seed: int
) -> _Postures:
    """Return n postures around home, home first, at which the independent constraints hold."""
    R, t = home[None, :, :3], home[None, :, 3]
    at = _Postures(R, t, readings_of_rods(legs, R, t))
    slopes, unit = _slopes(legs, posture_constraints(legs, *at), home)
    step = _REACH * np.random.default_rng(seed).uniform(-1.0, 1.0, (n, len(unit)))
    if at.q.shape[1]:  # motors follow the platform, along its freedoms
        left = np.linalg.svd(slopes[0])[2][slopes.shape[1] - n_dependent :]
        step = step @ left.T @ left
    step[0] = 0.0
    at = _Postures(*(np.repeat(part, n, axis=0) for part in at))
    return _closed(legs, n_dependent, _moved(at, mean_length(legs, home) * step / unit))[0]


def _closed(
    legs: Sequence[Leg], n_dependent: int, at: _Postures
) -> tuple[_Postures, PoseEquations, Array]:
    """Return postures nearby, their constraints and self-stresses (k, m, n_dependent) there.

    The component along self-stresses remains at any posture: with errors off the ties the
    constraints contradict each other there. The stresses do no work on motors.
    """
    home = np.concatenate([at.R[0], at.t[0][:, None]], axis=1)
    for _ in range(_STEPS):
        equations = posture_constraints(legs, *at, by_local=True)
        slopes, unit = _slopes(legs, equations, home)
        left, singular, right = np.linalg.svd(slopes)
        rank = left.shape[1] - n_dependent
        along = np.einsum("kmr,km->kr", left[:, :, :rank], equations.values) / singular[:, :rank]
        step = -np.einsum("kr,krc->kc", along, right[:, :rank])
        if np.abs(step).max(initial=0.0) < _AT_REST * mean_length(legs, home):
            break
        at = _moved(at, step / unit)
    return at, equations, left[:, :, rank:]


def _moved(at: _Postures, step: Array) -> _Postures:
    """Return postures after steps (k, 6 + n)."""
    poses = poses_after(np.concatenate([at.R, at.t[..., None]], axis=2), step[:, :6])
    return _Postures(poses[:, :, :3], poses[:, :, 3], at.q + step[:, 6:])
