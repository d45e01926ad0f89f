"""Open directions: refused where they matter, held at nominal where the platform stays.

Directions are held where they hardly move the platform, by up to a hundredth of their own change.
The nominal model is assumed as wrong along them as elsewhere, by the root mean square of the
changes that the fit found, of lengths and of angles apart.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.linalg import null_space

from legcal.calibration.joint_fit.problem import FitProblem
from legcal.calibration.joint_fit.variables import State, with_values
from legcal.errors import NotIdentifiable
from legcal.estimation.solver import NormalEquations, inverse_on_range
from legcal.estimation.uncertainty import marginal, named_information
from legcal.geometry.types import Array, BoolArray
from legcal.machine.directions import SHOWN, describe_direction, sparse_basis, split_by_motion
from legcal.machine.equations import pose_sensitivity

_MAX_SIGMA = 0.1  # of the mean leg length
_HELD_SIGMA = 0.01  # of it, where the platform does not move
_HARMLESS = 0.01  # of the change of the parameters: the platform hardly moves
_MAX_OTHERS = 0.05  # of a direction that is not kinematic: more, and it is not a matter of the legs
_REMEDY = "add images from other directions, of other legs or at poses that differ more"
_MIN_SPREAD = 2.5e-12  # mean leg lengths: a spread that counts as none


@dataclass(frozen=True, eq=False)
class HeldDirections:
    """Directions of the parameters that are open and do not move the platform."""

    basis: Array  # (w, n_named) in the values of named unknowns, each over its unit, orthonormal
    unit: Array  # (n_named,) a metre of each in its own unit
    directions: tuple[str, ...] = ()  # in words
    names: tuple[str, ...] = ()  # parameters that a slightly wrong nominal model would move


def open_directions(problem: FitProblem, state: State, normal: NormalEquations) -> HeldDirections:
    """Return the open directions that hardly move the platform.

    *problem* holds nothing yet; *normal* is its information at the state. Intrinsics that are known
    with the covariance of a camera file are none of the parameters that may be open.

    Raises
    ------
    NotIdentifiable
        If an open direction moves the platform, or belongs to a camera or a radius.
    """
    every_unit, length = named_units(problem, state), state.mean_length
    judged = np.setdiff1d(np.arange(problem.n_named), problem.calibrated)
    names, unit = [problem.named[i] for i in judged], every_unit[judged]
    information = marginal(named_information(problem, state, normal), judged)
    unseen = [name for name, row in zip(names, information, strict=True) if not np.any(row)]
    scaled = unit[:, None] * information * unit
    value, vector = np.linalg.eigh(0.5 * (scaled + scaled.T))
    basis = vector[:, _are_open(value, vector, length)].T
    poor = vector[:, value * (_HELD_SIGMA * length) ** 2 < 1.0].T
    if len(poor) == 0:
        return HeldDirections(np.zeros((0, problem.n_named)), every_unit)
    others = np.flatnonzero((basis[:, problem.n_kinematic :] ** 2).sum(axis=1) > _MAX_OTHERS**2)
    if len(others):
        basis = basis[others]
    else:
        motion = _motion(problem, state, unit)
        basis, _ = split_by_motion(motion, basis, length, _HARMLESS)
        _, harmless = split_by_motion(motion, poor, length, _HARMLESS)
    if len(basis) and unseen:
        raise NotIdentifiable(
            f"The fit is not determined: no measurement depends on {', '.join(unseen)}; every leg "
            "needs readings or outlines; add images that show it."
        )
    if len(basis):
        words = _in_words(names, sparse_basis(basis)[0], problem.legs.names)
        raise NotIdentifiable(
            f"The fit is not determined: found {len(basis)} of {len(names)} directions of the "
            f"parameters that the measurements leave open and that matter, {words}, "
            f"needed all to a tenth of a leg; {_REMEDY}, or state what is known with a prior."
        )
    weak: tuple[str, ...] = ()
    if len(harmless):  # what nominal models that are a hundredth of a leg wrong move beyond sigma
        N = null_space(harmless)
        sigma = np.sqrt(np.diagonal(N @ inverse_on_range(N.T @ scaled @ N) @ N.T))
        is_weak = _HELD_SIGMA * length * np.linalg.norm(harmless, axis=0) > sigma
        weak = tuple(names[i] for i in np.flatnonzero(is_weak))
    directions = (_in_words(names, row, problem.legs.names) for row in sparse_basis(harmless))
    basis = np.zeros((len(harmless), problem.n_named))
    basis[:, judged] = harmless
    return HeldDirections(basis, every_unit, tuple(directions), weak)


def refuse_undetermined_inliers(
    problem: FitProblem,
    state: State,
    normal: NormalEquations,
    held: HeldDirections,
    accepted: BoolArray,  # which outlines agree with the fit
) -> None:
    """Refuse a fit that leaves more open than was held before outlines were rejected.

    Raises
    ------
    NotIdentifiable
        With one of the directions.
    """
    known = np.concatenate([problem.where("biases"), problem.calibrated])
    kept = np.setdiff1d(np.arange(problem.n_named), known)
    unit, basis = held.unit[kept], held.basis[:, kept]
    scaled = unit[:, None] * marginal(named_information(problem, state, normal), kept) * unit
    N = null_space(basis) if len(basis) else np.eye(len(kept))
    value, vector = np.linalg.eigh(N.T @ scaled @ N)
    vector = N @ vector
    if len(opened := np.flatnonzero(_are_open(value, vector, state.mean_length))):
        names = [problem.named[i] for i in kept]
        words = _in_words(names, vector[:, opened[0]], problem.legs.names)
        if accepted.all():
            raise NotIdentifiable(
                f"The fit is not determined: found that its measurements leave {words} open where "
                f"it ends, needed all to a tenth of a leg; {_REMEDY}, or state what is known with "
                "a prior."
            )
        raise NotIdentifiable(
            f"The fit is not determined: found that the outlines which agree with it leave {words} "
            "open, needed what the rejected ones showed; correct these, or add images."
        )


def _are_open(information: Array, direction: Array, length: float) -> BoolArray:
    """Say which directions (n, k) leave one of the parameters open by a tenth of a leg.

    *information* (k,) is that of each, which has unit length. A scale that is known to a per cent
    or two moves many parameters, each of them little.
    """
    most = _MAX_SIGMA * length / np.abs(direction).max(axis=0)
    return np.asarray(information * most**2 < 1.0)


def held_at_nominal(
    problem: FitProblem, state: State, held: HeldDirections
) -> tuple[FitProblem, State]:
    """Return the problem with these directions held, and the state with them at nominal."""
    legs, free, n = problem.legs, problem.free, problem.n_kinematic
    rows = (held.basis / held.unit) @ problem.jacobian(state)
    orthonormal = np.linalg.qr(rows.T)[0].T
    values = legs.vector(state.legs)[free]
    away = values - legs.vector(legs.nominal)[free]
    along = held.basis[:, :n] @ (away / held.unit[:n])
    wanted = values - held.unit[:n] * (along @ held.basis[:, :n])
    where = np.flatnonzero(free).tolist()
    moved = with_values(state.legs, legs, dict(zip(where, wanted.tolist(), strict=True)))
    return replace(problem, held_directions=orthonormal), replace(
        state, legs=problem.parameters.tied(moved)
    )


def held_spread(problem: FitProblem, state: State, held: HeldDirections) -> Array:
    """Return the covariance (n_kinematic, n_kinematic) of steps along what is held.

    Nominal errors e of variance D^2, of which all but what is held (the rows of H) is found, leave
    H^T (H D^-2 H^T)^-1 H.
    """
    legs, free, n = problem.legs, problem.free, problem.n_kinematic
    if len(held.basis) == 0:
        return np.zeros((n, n))
    unit, H = held.unit[:n], held.basis[:, :n]
    change = (legs.vector(state.legs) - legs.vector(legs.nominal))[free] / unit
    is_length = np.array([name == "m" for name in problem.units[:n]], dtype=np.bool_)
    sigma = np.zeros(n)
    for kind in (is_length, ~is_length):
        found = float(np.sum(kind) - np.sum(H[:, kind] ** 2))  # the rest is held: no change
        sigma[kind] = np.sqrt(np.sum(change[kind] ** 2) / max(found, 1.0))
    weighted = H / np.maximum(sigma, _MIN_SPREAD * state.mean_length)
    spread = H.T @ np.linalg.solve(weighted @ weighted.T, H)
    back = np.linalg.inv(problem.jacobian(state))[:n, :n] * unit
    return np.asarray(back @ spread @ back.T)


def named_units(problem: FitProblem, state: State) -> Array:
    """Return a metre of each named unknown in its own unit: angles at the mean leg length."""
    length = state.mean_length
    focal = float(np.mean([camera.K[0, 0] for camera in state.cameras]))
    of = {"m": 1.0, "rad": 1.0 / length, "px": focal / length, "": 1.0 / length}
    return np.array([of[unit] for unit in problem.units])


def _motion(problem: FitProblem, state: State, unit: Array) -> Array | None:
    """Return how the platform moves (k, 6, n_named) by a metre of each named unknown."""
    legs, n = problem.legs, problem.n_kinematic
    try:
        by = pose_sensitivity(
            state.legs, legs.parametrization, legs.frame_legs, *state.platform_pose.frames
        )
    except NotIdentifiable:
        return None
    motion = np.zeros((len(by), 6, len(unit)))
    motion[..., :n] = by[..., problem.free] @ np.linalg.inv(problem.jacobian(state))[:n, :n]
    return motion * unit


def _in_words(names: Sequence[str], row: Array, leg_names: Sequence[str]) -> str:
    """Return a direction of named unknowns in words, its largest parts first."""
    size = np.abs(row)
    order = np.argsort(-size, kind="stable")
    shown = [names[i] for i in order if size[i] > SHOWN * size[order[0]]]
    return describe_direction(shown, leg_names)
