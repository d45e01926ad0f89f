"""Unobservable directions: held at nominal if the platform hardly moves with them, else refused.

A direction is held if it moves the platform by at most a hundredth of its own change. The error of
the nominal model along held directions is taken to be as large as elsewhere: the root mean square
of the changes in the fit, separately for lengths and angles.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.linalg import null_space
from scipy.spatial.transform import RigidTransform

from legcal.calibration.joint_fit.problem import FitNormal, FitProblem
from legcal.calibration.joint_fit.variables import FittedLegs, State, with_values
from legcal.calibration.tuning import HARMLESS, HELD_SIGMA, MAX_SIGMA
from legcal.errors import NotIdentifiable
from legcal.estimation.problem import Frames
from legcal.estimation.solver import inverse_on_range
from legcal.estimation.uncertainty import marginal, named_information
from legcal.geometry.types import Array, BoolArray
from legcal.machine.equations import pose_sensitivity
from legcal.machine.leg import Leg
from legcal.machine.parameters import (
    SHOWN,
    describe_direction,
    sparse_basis,
    split_by_motion,
)

_MAX_OTHERS = 0.05  # non-kinematic part of a direction, above which it cannot be held
_MIN_SPREAD = 2.5e-12  # mean leg lengths: floor of the error of the nominal model


@dataclass(frozen=True, eq=False)
class HeldDirections:
    """Open directions that do not move the platform and are held at nominal."""

    basis: Array  # (w, n_named) orthonormal, in named unknowns over their unit
    unit: Array  # (n_named,) equivalent of a metre in the unit of each
    directions: tuple[str, ...] = ()  # in words
    names: tuple[
        str, ...
    ] = ()  # parameters that depend on the nominal model along these directions


def undetermined_directions(normal: FitNormal) -> HeldDirections:
    """Return the open directions that hardly move the platform.

    *normal* is the information of a problem without held directions yet. Intrinsics with the
    covariance of a camera file are not tested.

    Raises NotIdentifiable if an open direction moves the platform, or includes a camera or a
    radius.
    """
    problem, state = normal.problem, normal.state
    every_unit, length = named_units(problem, state), state.mean_length
    judged = np.setdiff1d(np.arange(problem.n_named), problem.calibrated)
    names, unit = [problem.named[i] for i in judged], every_unit[judged]
    information = marginal(named_information(normal), judged)
    unseen = [name for name, row in zip(names, information, strict=True) if not np.any(row)]
    scaled = unit[:, None] * information * unit
    eigenvalue, eigenvector = np.linalg.eigh(0.5 * (scaled + scaled.T))
    basis = eigenvector[:, _are_open(eigenvalue, eigenvector, length)].T
    weak_basis = eigenvector[:, eigenvalue * (HELD_SIGMA * length) ** 2 < 1.0].T
    if len(weak_basis) == 0:
        return HeldDirections(np.zeros((0, problem.n_named)), every_unit)
    not_kinematic = np.flatnonzero(
        (basis[:, problem.n_kinematic :] ** 2).sum(axis=1) > _MAX_OTHERS**2
    )
    if len(not_kinematic):
        basis = basis[not_kinematic]
    else:
        motion = _motion(problem, state, unit)
        basis, _ = split_by_motion(motion, basis, length, HARMLESS)
        _, harmless = split_by_motion(motion, weak_basis, length, HARMLESS)
    if len(basis) and unseen:
        raise NotIdentifiable(
            f"The fit is not determined: no measurement depends on {', '.join(unseen)}. Every leg "
            "needs readings or outlines: add images that show it."
        )
    if len(basis):
        description = _in_words(names, sparse_basis(basis)[0], problem.legs.names)
        raise NotIdentifiable(
            f"The fit is not determined: {len(basis)} of {len(names)} combinations of parameters "
            f"are uncertain by more than a tenth of a leg length: {description}; "
            f"{_remedy(problem)}."
        )
    weak: tuple[str, ...] = ()
    if len(
        harmless
    ):  # moved by more than sigma if the nominal model is off by a hundredth of a leg
        N = null_space(harmless)
        sigma = np.sqrt(np.diagonal(N @ inverse_on_range(N.T @ scaled @ N) @ N.T))
        is_weak = HELD_SIGMA * length * np.linalg.norm(harmless, axis=0) > sigma
        weak = tuple(names[i] for i in np.flatnonzero(is_weak))
    directions = (_in_words(names, row, problem.legs.names) for row in sparse_basis(harmless))
    basis = np.zeros((len(harmless), problem.n_named))
    basis[:, judged] = harmless
    return HeldDirections(basis, every_unit, tuple(directions), weak)


def refuse_undetermined_inliers(
    normal: FitNormal, held: HeldDirections, accepted: BoolArray
) -> None:
    """Refuse a fit with open directions besides the held ones, after outlier rejection.

    *accepted* (n_outlines,) are the inliers.

    Raises NotIdentifiable naming one of the directions.
    """
    problem, length = normal.problem, normal.state.mean_length
    excluded = np.concatenate([problem.where("biases"), problem.calibrated])
    kept = np.setdiff1d(np.arange(problem.n_named), excluded)
    unit, basis = held.unit[kept], held.basis[:, kept]
    scaled = unit[:, None] * marginal(named_information(normal), kept) * unit
    N = null_space(basis) if len(basis) else np.eye(len(kept))
    eigenvalue, eigenvector = np.linalg.eigh(N.T @ scaled @ N)
    eigenvector = N @ eigenvector
    if len(is_open := np.flatnonzero(_are_open(eigenvalue, eigenvector, length))):
        names = [problem.named[i] for i in kept]
        description = _in_words(names, eigenvector[:, is_open[0]], problem.legs.names)
        if accepted.all():
            raise NotIdentifiable(
                f"The fit is not determined: at its minimum, {description} is uncertain by more "
                f"than a tenth of a leg length; {_remedy(problem)}."
            )
        raise NotIdentifiable(
            f"The fit is not determined: without the rejected outlines, {description} is not "
            "determined; correct the rejected outlines, or add images."
        )


def _remedy(problem: FitProblem) -> str:
    """Return what determines a fit; tolerances only where they are not its priors already."""
    tolerances = ", or tolerances (machine_kind) with --only all"
    return (
        "add images from other directions, of other legs or at poses that differ more, or state "
        f"what is known: values with a prior{tolerances * (problem.choices.built is None)}"
    )


def _are_open(information: Array, direction: Array, length: float) -> BoolArray:
    """Which unit directions (n, k) leave a parameter uncertain by more than a tenth of a leg.

    *information* (k,) is along each. The test is by single parameters: a scale known to a per cent
    or two moves many of them, each by little.
    """
    most = MAX_SIGMA * length / np.abs(direction).max(axis=0)
    return np.asarray(information * most**2 < 1.0)


def held_at_nominal(
    problem: FitProblem, state: State, held: HeldDirections
) -> tuple[FitProblem, State]:
    """Hold directions in the problem, and set the state to nominal along them."""
    legs, free, n = problem.legs, problem.free, problem.n_kinematic
    rows = (held.basis / held.unit) @ problem.jacobian(state)
    orthonormal = np.linalg.qr(rows.T)[0].T
    values = legs.vector(state.legs)[free]
    deviation = values - legs.vector(legs.nominal)[free]
    component = held.basis[:, :n] @ (deviation / held.unit[:n])
    target = values - held.unit[:n] * (component @ held.basis[:, :n])
    numbers = np.flatnonzero(free).tolist()
    moved = with_values(state.legs, legs, dict(zip(numbers, target.tolist(), strict=True)))
    return replace(problem, held_directions=orthonormal), replace(
        state, legs=problem.parameters.tied(moved)
    )


def covariance_of_held(problem: FitProblem, state: State, held: HeldDirections) -> Array:
    """Return the covariance (n_kinematic, n_kinematic) of steps along the held directions H.

    Errors of the nominal model with covariance D^2, conditioned on the estimated complement of H,
    have the covariance H^T (H D^-2 H^T)^-1 H.
    """
    legs, free, n = problem.legs, problem.free, problem.n_kinematic
    if len(held.basis) == 0:
        return np.zeros((n, n))
    unit, H = held.unit[:n], held.basis[:, :n]
    change = (legs.vector(state.legs) - legs.vector(legs.nominal))[free] / unit
    is_length = np.array([name == "m" for name in problem.units[:n]], dtype=np.bool_)
    sigma = np.zeros(n)
    for kind in (is_length, ~is_length):
        n_found = float(
            np.sum(kind) - np.sum(H[:, kind] ** 2)
        )  # degrees of freedom that are not held
        sigma[kind] = np.sqrt(np.sum(change[kind] ** 2) / max(n_found, 1.0))
    weighted = H / np.maximum(sigma, _MIN_SPREAD * state.mean_length)
    spread = H.T @ np.linalg.solve(weighted @ weighted.T, H)
    to_steps = np.linalg.inv(problem.jacobian(state))[:n, :n] * unit
    return np.asarray(to_steps @ spread @ to_steps.T)


def covariance_as_stated(
    S: Array,  # (p, p) of steps of the parameters, by the information of a fit
    moved: Array,  # (p, c) their changes by errors that it does not know, one sigma of each
    legs: FittedLegs,
    T_Rb_Re: Sequence[RigidTransform],  # the poses of its images
    length: float,  # mean leg length [m]
) -> Array:
    """Return the covariance (p, p) that a calibration states before it sees measurements.

    Weak directions that hardly move the platform are known then, since they are held.
    """
    unit = np.where(np.equal(legs.parametrization.units, "m"), 1.0, 1.0 / length)
    variance, direction = np.linalg.eigh(S / unit[:, None] / unit)
    weak = direction[:, variance > (HELD_SIGMA * length) ** 2].T
    C = np.asarray(S + moved @ moved.T)
    if not len(weak):
        return C
    motion = _motion_by(legs.nominal, legs, Frames.of(T_Rb_Re))
    H = split_by_motion(None if motion is None else motion * unit, weak, length, HARMLESS)[1] / unit
    rest = np.eye(len(S)) - S @ H.T @ np.linalg.solve(H @ S @ H.T, H)
    return np.asarray(rest @ C @ rest.T)


def named_units(problem: FitProblem, state: State) -> Array:
    """Equivalent of a metre in the unit of each named unknown; angles at the mean leg length."""
    length = state.mean_length
    focal = float(np.mean([camera.K[0, 0] for camera in state.cameras]))
    size_of_unit = {"m": 1.0, "rad": 1.0 / length, "px": focal / length, "": 1.0 / length}
    return np.array([size_of_unit[unit] for unit in problem.units])


def _motion(problem: FitProblem, state: State, unit: Array) -> Array | None:
    """Motion of the platform (k, 6, n_named) by each named unknown, scaled by *unit*."""
    legs, n = problem.legs, problem.n_kinematic
    by_steps = _motion_by(state.legs, legs, state.platform_pose.frames)
    if by_steps is None:
        return None
    motion = np.zeros((len(by_steps), 6, len(unit)))
    motion[..., :n] = by_steps[..., problem.free] @ np.linalg.inv(problem.jacobian(state))[:n, :n]
    return motion * unit


def _motion_by(legs: Sequence[Leg], fitted: FittedLegs, poses: Frames) -> Array | None:
    """Motion of the platform (k, 6, p) by steps of parameters; None if readings do not tell it."""
    try:
        return pose_sensitivity(legs, fitted.parametrization, fitted.frame_legs, *poses)
    except NotIdentifiable:
        return None


def _in_words(names: Sequence[str], row: Array, leg_names: Sequence[str]) -> str:
    """Describe a direction of named unknowns, largest components first."""
    size = np.abs(row)
    order = np.argsort(-size, kind="stable")
    shown = [names[i] for i in order if size[i] > SHOWN * size[order[0]]]
    return describe_direction(shown, leg_names)
