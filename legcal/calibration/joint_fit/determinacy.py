"""What is held at nominal is not known: how far it may be off, for all that depends on it.

Directions are held where they hardly move the platform, by up to a hundredth of their own change.
The nominal model is wrong along them as it is wrong elsewhere, which the fit has found out: the
root mean square of its changes says how much, of lengths and of angles apart.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.linalg import null_space

from legcal.calibration.joint_fit.constraints import with_values
from legcal.calibration.joint_fit.normal import NormalEquations, inverse_on_range
from legcal.calibration.joint_fit.problem import FitProblem, named_jacobian
from legcal.calibration.joint_fit.state import State
from legcal.errors import NotIdentifiable
from legcal.geometry import Array, BoolArray
from legcal.machine import (
    SHOWN,
    describe_direction,
    pose_sensitivity,
    sparse_basis,
    split_by_motion,
)

_LARGEST_SIGMA = 0.1  # of the mean leg length
_HELD_SIGMA = 0.01  # of it, where the platform does not move
_HARMLESS = 0.01  # of the change of the parameters: the platform hardly moves
_OTHERS = 0.05  # of a direction that is not kinematic: more, and it is not a matter of the legs
_REMEDY = "add images from other directions, of other legs or at poses that differ more"


@dataclass(frozen=True, eq=False)
class Held:
    """Directions of the parameters that are open and do not move the platform.

    Attributes
    ----------
    basis : (w, n_named) array
        In the values of named unknowns, each over its unit, orthonormal.
    unit : (n_named,) array
        A metre of each named unknown in its own unit.
    directions : tuple of str
        The directions in words.
    names : tuple of str
        The parameters that a nominal model which is a hundredth of a leg wrong along them
        would move by more than their standard deviations.
    """

    basis: Array
    unit: Array
    directions: tuple[str, ...] = ()
    names: tuple[str, ...] = ()


def open_directions(problem: FitProblem, state: State, normal: NormalEquations) -> Held:
    """Return the open directions that do no harm.

    Parameters
    ----------
    problem : FitProblem
        Without anything held.
    state : State
    normal : NormalEquations
        From :func:`legcal.calibration.joint_fit.normal.information` at the state.

    Raises
    ------
    NotIdentifiable
        If an open direction moves the platform, or belongs to a camera or a radius.
    """
    names, unit, length = problem.named, named_units(problem, state), mean_length(state)
    S = of_values(problem, state, normal)
    unseen = [name for name, row in zip(names, S, strict=True) if not np.any(row)]
    scaled = unit[:, None] * S * unit
    value, vector = np.linalg.eigh(0.5 * (scaled + scaled.T))
    n_open, n_poor = (
        int(np.sum(value * (sigma * length) ** 2 < 1.0)) for sigma in (_LARGEST_SIGMA, _HELD_SIGMA)
    )
    basis, poor = vector[:, :n_open].T, vector[:, :n_poor].T
    n = problem.layout.n_kinematic
    others = np.flatnonzero((basis[:, n:] ** 2).sum(axis=1) > _OTHERS**2)
    if len(others):
        basis = basis[others]
    else:
        motion = _motion(problem, state, unit)
        basis, _ = split_by_motion(motion, basis, length, _HARMLESS)
        _, harmless = split_by_motion(motion, poor, length, _HARMLESS)
    if len(basis):
        raise NotIdentifiable(_refusal(problem, sparse_basis(basis)[0], len(basis), unseen))
    rows = sparse_basis(harmless)
    return Held(
        harmless,
        unit,
        tuple(_in_words(names, row, problem.legs.names) for row in rows),
        tuple(names[i] for i in np.flatnonzero(_is_weak(scaled, harmless, length))),
    )


def refuse_lost(problem: FitProblem, state: State, normal: NormalEquations, held: Held) -> None:
    """Refuse a fit whose outlines, those that agree with it, leave more open than is held.

    Parameters
    ----------
    problem : FitProblem
        With or without biases.
    state : State
        Where the fit ended.
    normal : NormalEquations
        From :func:`legcal.calibration.joint_fit.normal.information` there.
    held : Held
        What :func:`open_directions` found before any outline was rejected.

    Raises
    ------
    NotIdentifiable
        With one of the directions.
    """
    S, biases = of_values(problem, state, normal), problem.layout.bias
    kept = np.setdiff1d(np.arange(len(S)), biases)
    mixed = S[np.ix_(biases, kept)]
    S = S[np.ix_(kept, kept)] - mixed.T @ np.linalg.inv(S[np.ix_(biases, biases)]) @ mixed
    scaled = held.unit[:, None] * S * held.unit
    N = null_space(held.basis) if len(held.basis) else np.eye(len(kept))
    value, vector = np.linalg.eigh(N.T @ scaled @ N)
    if value[0] * (_LARGEST_SIGMA * mean_length(state)) ** 2 < 1.0:
        names = [problem.named[i] for i in kept]
        raise NotIdentifiable(
            "The fit is not determined: found that the outlines which agree with it leave "
            f"{_in_words(names, N @ vector[:, 0], problem.legs.names)} open, needed what the "
            "rejected ones showed; correct these, or add images."
        )


def held_at_nominal(problem: FitProblem, state: State, held: Held) -> tuple[FitProblem, State]:
    """Return the problem with these directions held, and the state with them at nominal."""
    layout, legs = problem.layout, problem.legs
    n = layout.n_kinematic
    by_x = named_jacobian(state, layout, legs)
    rows = np.zeros((len(held.basis), layout.n_kept))
    rows[:, : len(by_x)] = (held.basis / held.unit) @ by_x
    orthonormal = np.linalg.qr(rows.T)[0].T
    away = (legs.vector(state.legs) - legs.vector(legs.nominal))[layout.kinematic < layout.size]
    along = held.basis[:, :n] @ (away / held.unit[:n])
    wanted = legs.vector(state.legs)[layout.kinematic < layout.size]
    wanted = wanted - held.unit[:n] * (along @ held.basis[:, :n])
    where = np.flatnonzero(layout.kinematic < layout.size).tolist()
    moved = with_values(state.legs, legs, dict(zip(where, wanted.tolist(), strict=True)))
    return replace(problem, held=orthonormal), replace(state, legs=problem.tied(moved))


def named_units(problem: FitProblem, state: State) -> Array:
    """Return a metre of each named unknown in its own unit: angles at the mean leg length."""
    length = mean_length(state)
    focal = float(np.mean([camera.K[0, 0] for camera in state.cameras]))
    of = {"m": 1.0, "rad": 1.0 / length, "px": focal / length, "": 1.0 / length}
    return np.array([of[unit] for unit in problem.named_units])


def _is_weak(scaled: Array, held: Array, length: float) -> BoolArray:
    """Say which parameters move by more than their sigma where the nominal ones are a bit wrong.

    Parameters
    ----------
    scaled : (n, n) array
        Normal matrix of the named unknowns, each over its unit [1/m^2].
    held : (w, n) array
        What is held, orthonormal.
    length : float
        Mean leg length [m].
    """
    if len(held) == 0:
        return np.zeros(len(scaled), dtype=np.bool_)
    N = null_space(held)
    sigma = np.sqrt(np.diagonal(N @ inverse_on_range(N.T @ scaled @ N) @ N.T))
    return np.asarray(_HELD_SIGMA * length * np.linalg.norm(held, axis=0) > sigma)


def mean_length(state: State) -> float:
    """Return the mean distance of the joints of a leg over the poses [m]."""
    ends = np.einsum("kij,lj->kli", state.R_pose, state.B) + state.t_pose[:, None]
    return float(np.linalg.norm(ends - state.A, axis=-1).mean())


def of_values(problem: FitProblem, state: State, normal: NormalEquations) -> Array:
    """Return the normal matrix of the values of named unknowns, all else unknown; biases too."""
    S, layout = normal.reduced(), problem.layout
    n = layout.n_named
    if n < len(S):
        S = S[:n, :n] - S[:n, n:] @ inverse_on_range(S[n:, n:]) @ S[n:, :n]
    back = np.linalg.inv(named_jacobian(state, layout, problem.legs))
    return np.asarray(back.T @ S @ back)


def _motion(problem: FitProblem, state: State, unit: Array) -> Array | None:
    """Return how the platform moves (k, 6, n_named) by a metre of each named unknown."""
    legs, layout = problem.legs, problem.layout
    try:
        by = pose_sensitivity(
            state.legs, legs.parametrization, legs.frame_legs, state.R_pose, state.t_pose
        )
    except NotIdentifiable:
        return None
    motion = np.zeros((len(by), 6, len(unit)))
    free = layout.kinematic < layout.size
    n = layout.n_kinematic
    motion[..., :n] = by[..., free] @ np.linalg.inv(named_jacobian(state, layout, legs))[:n, :n]
    return motion * unit


def _in_words(names: Sequence[str], row: Array, leg_names: Sequence[str]) -> str:
    """Return a direction of named unknowns in words, its largest parts first."""
    size = np.abs(row)
    order = np.argsort(-size, kind="stable")
    shown = [names[i] for i in order if size[i] > SHOWN * size[order[0]]]
    return describe_direction(shown, leg_names)


def _refusal(problem: FitProblem, row: Array, n_open: int, unseen: list[str]) -> str:
    """Return why the fit cannot be trusted."""
    if unseen:
        return (
            f"The fit is not determined: no measurement depends on {', '.join(unseen)}; every leg "
            "needs readings or outlines; add images that show it."
        )
    words = _in_words(problem.named, row, problem.legs.names)
    return (
        f"The fit is not determined: found {n_open} of {len(problem.named)} directions of the "
        f"parameters that the measurements leave open and that matter, {words}, "
        f"needed all to a tenth of a leg; {_REMEDY}, or state what is known with a prior."
    )


_LEAST = 1e-12  # [m] a spread that counts as none


def held_spread(problem: FitProblem, state: State, held: Held) -> Array:
    """Return the covariance of steps of named kinematic unknowns along what is held.

    Nominal errors e of variance D^2, of which all but what is held (the rows of H) is found, leave
    H^T (H D^-2 H^T)^-1 H.

    Parameters
    ----------
    problem : FitProblem
    state : State
        The fit.
    held : Held
        What is held.

    Returns
    -------
    (n_kinematic, n_kinematic) array
        In the steps of :attr:`legcal.calibration.joint_fit.solution.Solution.kinematic_covariance`.
    """
    layout, legs = problem.layout, problem.legs
    n = layout.n_kinematic
    if len(held.basis) == 0:
        return np.zeros((n, n))
    free = layout.kinematic < layout.size
    unit, H = held.unit[:n], held.basis[:, :n]
    change = (legs.vector(state.legs) - legs.vector(legs.nominal))[free] / unit
    is_length = np.array([name == "m" for name in problem.named_units[:n]], dtype=np.bool_)
    sigma = np.zeros(n)
    for kind in (is_length, ~is_length):
        found = float(np.sum(kind) - np.sum(H[:, kind] ** 2))  # the rest is held: no change
        sigma[kind] = np.sqrt(np.sum(change[kind] ** 2) / max(found, 1.0))
    weighted = H / np.maximum(sigma, _LEAST)
    spread = H.T @ np.linalg.solve(weighted @ weighted.T, H)
    back = np.linalg.inv(named_jacobian(state, layout, legs))[:n, :n] * unit
    return np.asarray(back @ spread @ back.T)
