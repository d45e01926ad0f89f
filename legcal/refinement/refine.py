"""One fit of everything: all outlines in pixels and all readings, at once.

A wide robust loss first, so that wrong outlines cannot bend the way; then rounds in which the
noise of outlines is estimated, outlines that disagree are rejected, and the rest is fitted again.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass

import casadi as ca
import numpy as np

from legcal.errors import DidNotConverge, LegcalError, NotIdentifiable
from legcal.geometry.types import Array, BoolArray
from legcal.measurements import Measurements
from legcal.observations import Outlines
from legcal.refinement.covariance import check_counts, explained_share, uncertainty
from legcal.refinement.legs import FittedLegs
from legcal.refinement.loss import efficiency, width_to_k
from legcal.refinement.noise import NoiseModel, estimate_noise, noise_of_the_median
from legcal.refinement.normal import Linearization, information, linearize
from legcal.refinement.observed import has_offset, observed_outlines, readings
from legcal.refinement.problem import FitProblem, Prior, build_problem, data_of
from legcal.refinement.solution import Solution
from legcal.refinement.solve import polish, solve
from legcal.refinement.start import Start
from legcal.refinement.state import State, lay_out


@dataclass(frozen=True)
class RefinementSettings:
    """Choices of the fit.

    Attributes
    ----------
    radius_sigma : float
        Standard deviation of the prior on radii, as a part of the radius.
    loss_width : float
        Whitened distance at which the loss of an outline turns from quadratic to linear.
    rejection : float
        Whitened distance beyond which an outline is rejected; a right one in 25,000 is, at 4.5.
    rejection_rounds : int
        Rounds, at most, until the rejected outlines stay the same.
    noise_rounds : int
        Rounds of noise estimation after that.
    comparison_px : float
        Bias of outlines [px] that is assumed when two fits are compared.
    max_iterations : int
        Limit for IPOPT in each solve.
    """

    radius_sigma: float = 0.02
    loss_width: float = 3.0
    rejection: float = 4.5
    rejection_rounds: int = 6
    noise_rounds: int = 2
    comparison_px: float = 0.1
    max_iterations: int = 100


DEFAULT_SETTINGS = RefinementSettings()


@dataclass(frozen=True, eq=False)
class _Fit:
    """A state with the noise and the outlines that it was fitted with."""

    state: State
    noise: NoiseModel
    accepted: BoolArray
    iterations: int


def build_fit(
    legs: FittedLegs,
    measurements: Measurements,
    outlines: Outlines,
    settings: RefinementSettings = DEFAULT_SETTINGS,
) -> FitProblem:
    """Build the fit of everything without solving it.

    Raises
    ------
    NotIdentifiable
        If there are fewer equations than unknowns.
    DatasetError
        If an outline cannot be used.
    """
    observed = observed_outlines(outlines, measurements, legs)
    encoders = readings(measurements, legs)
    seen = np.zeros(len(measurements.views), dtype=np.bool_)
    seen[observed.view] = True
    layout = lay_out(
        legs.frame_legs, has_offset(measurements), observed.parts, seen, measurements.n_poses
    )
    mean = np.array([legs.radii[part] for part in observed.parts])
    prior = Prior(layout.radius, mean, settings.radius_sigma * mean)
    problem = build_problem(layout, observed, encoders, prior, settings.max_iterations)
    check_counts(problem, measurements.n_rows)
    return problem


def refine(
    legs: FittedLegs,
    measurements: Measurements,
    outlines: Outlines,
    start: Start,
    settings: RefinementSettings = DEFAULT_SETTINGS,
) -> Solution:
    """Fit kinematic parameters, cameras, platform poses and radii to all data at once.

    Parameters
    ----------
    legs : FittedLegs
        The mechanism (:func:`legcal.refinement.legs.fitted_legs`).
    measurements : Measurements
        Views, poses and readings [m].
    outlines : Outlines
        Outlines in pixels; only the used ones enter.
    start : Start
        Starting values.
    settings : RefinementSettings
        Choices of the fit.

    Returns
    -------
    Solution

    Raises
    ------
    NotIdentifiable
        If the data do not determine the parameters.
    DidNotConverge
        If the solver stops early, or most outlines disagree with what it found.
    DatasetError
        If an outline cannot be used.
    """
    return _refined(
        build_fit(legs, measurements, outlines, settings), legs, outlines, start, settings
    )


def refine_from_best(
    legs: FittedLegs,
    measurements: Measurements,
    outlines: Outlines,
    starts: Sequence[Start],
    settings: RefinementSettings = DEFAULT_SETTINGS,
) -> Solution:
    """Fit everything from several starts and keep the lowest cost (hazard 10 of the method).

    A start that fails is skipped with a note; between equal costs the earlier start wins.

    Raises
    ------
    NotIdentifiable, DidNotConverge
        If no start leads to a fit.
    """
    problem = build_fit(legs, measurements, outlines, settings)
    best: Solution | None = None
    notes: list[str] = []
    failures: list[LegcalError] = []
    for start in starts:
        try:
            found = _refined(problem, legs, outlines, start, settings)
        except (DidNotConverge, NotIdentifiable) as failure:
            failures.append(failure)
            notes.append(f"The start {start.label} was skipped. {failure}")
            continue
        notes.append(f"The start {start.label} led to a cost of {found.cost:.6g}.")
        if best is None or found.cost < (1.0 - 1e-6) * best.cost:
            best = found
    if best is not None:
        return dataclasses.replace(best, notes=(*best.notes, *notes))
    if failures and all(isinstance(failure, NotIdentifiable) for failure in failures):
        raise failures[0]
    raise DidNotConverge(notes or ["The fit was given no starting values; it needs at least one."])


def _refined(
    problem: FitProblem,
    legs: FittedLegs,
    outlines: Outlines,
    start: Start,
    settings: RefinementSettings,
) -> Solution:
    """Fit from one start with a problem that is already built."""
    names = _estimated_names(problem, legs)
    begin = start.state(problem.radius_prior.mean)
    try:
        fit = _fit_in_rounds(problem, begin, settings)
    except DidNotConverge:
        # A fit that nothing determines has no minimum to converge to: say so if that is why.
        linear = linearize(problem, begin, NoiseModel().whitening(problem.outlines.covariance))
        uncertainty(problem, information(problem, linear, 1.0), names)
        raise
    return _solution(problem, fit, outlines, names, start.label, settings)


def _fit_in_rounds(problem: FitProblem, begin: State, settings: RefinementSettings) -> _Fit:
    """Solve wide, reject what disagrees until that settles, then estimate the noise and solve."""
    claimed = problem.outlines.covariance
    noise, k = NoiseModel(), width_to_k(settings.loss_width)
    first = noise.squared_norms(_offsets(problem, begin), claimed)
    wide = max(settings.loss_width, float(np.sqrt(np.median(first)))) if len(first) else 1.0
    state, iterations = solve(problem, begin, noise.whitening(claimed), width_to_k(wide))
    accepted = np.ones(len(first), dtype=np.bool_)
    for _ in range(settings.rejection_rounds if len(first) else 0):
        before = accepted
        noise = noise_of_the_median(_offsets(problem, state)[before], claimed[before])
        accepted = _accepted(problem, state, noise, settings)
        state, more = solve(problem, state, noise.whitening(claimed, accepted), k)
        iterations += more
        if np.array_equal(before, accepted):
            break
    for _ in range(settings.noise_rounds):
        noise = _noise(problem, state, noise, accepted, settings)
        accepted = _accepted(problem, state, noise, settings)
        whitening = noise.whitening(claimed, accepted)
        state, more = solve(problem, state, whitening, k)
        state = polish(problem, state, whitening, k)
        iterations += more
    return _Fit(state, noise, accepted, iterations)


def _noise(
    problem: FitProblem,
    state: State,
    noise: NoiseModel,
    accepted: BoolArray,
    settings: RefinementSettings,
) -> NoiseModel:
    """Return the noise of the accepted outlines at a fit."""
    if not accepted.any():
        return noise
    claimed = problem.outlines.covariance
    linear = linearize(problem, state, noise.whitening(claimed, accepted))
    normal = information(problem, linear, efficiency(width_to_k(settings.loss_width)))
    L = np.linalg.cholesky(noise.covariance(claimed))
    explained = L @ explained_share(problem, linear, normal) @ np.swapaxes(L, -1, -2)
    offsets = np.einsum("nij,nj->ni", L, linear.outline_r)
    return estimate_noise(offsets[accepted], explained[accepted], claimed[accepted])


def _offsets(problem: FitProblem, state: State) -> Array:
    """Return the offsets (n, 2) [px] of all outlines at a state."""
    unit = np.broadcast_to(np.eye(2), (len(problem.outlines), 2, 2))
    return linearize(problem, state, unit).outline_r


def _accepted(
    problem: FitProblem, state: State, noise: NoiseModel, settings: RefinementSettings
) -> BoolArray:
    """Return which outlines agree with a fit.

    Raises
    ------
    DidNotConverge
        If fewer than half of them do.
    """
    offsets = _offsets(problem, state)
    s = noise.squared_norms(offsets, problem.outlines.covariance)
    accepted = s <= settings.rejection**2
    if 2 * int(accepted.sum()) < len(accepted):
        raise DidNotConverge(
            f"The fit of everything ended where {len(accepted) - int(accepted.sum())} of "
            f"{len(accepted)} outlines disagree with it, by {np.median(np.abs(offsets)):.1f} px in "
            "the median; most must agree; check the camera poses, the readings and the outlines."
        )
    return np.asarray(accepted)


def _solution(
    problem: FitProblem,
    fit: _Fit,
    outlines: Outlines,
    names: tuple[str, ...],
    label: str,
    settings: RefinementSettings,
) -> Solution:
    """Put together what was found."""
    claimed, k = problem.outlines.covariance, width_to_k(settings.loss_width)
    linear = linearize(problem, fit.state, fit.noise.whitening(claimed, fit.accepted))
    known = uncertainty(problem, information(problem, linear, efficiency(k)), names)
    offsets = _offsets(problem, fit.state)
    used = offsets[fit.accepted]
    n_residuals = used.size + len(problem.readings) + len(problem.radius_prior.mean)
    parts = problem.layout.parts
    return Solution(
        parameters=fit.state.parameters,
        T_camera_Rb=fit.state.T_camera_Rb,
        T_Rb_Re=fit.state.T_Rb_Re,
        radii=dict(zip(parts, fit.state.radii.tolist(), strict=True)),
        sigma_radii=dict(zip(parts, known.sigma_radii.tolist(), strict=True)),
        names=names,
        covariance=known.covariance,
        sigma=np.sqrt(np.diagonal(known.covariance)),
        weak=known.weak,
        cost=_comparable_cost(problem, fit.state, settings),
        chi2=_chi2(linear),
        dof=n_residuals - problem.layout.size,
        rms_px=float(np.sqrt(np.mean(used**2))) if used.size else 0.0,
        noise=fit.noise,
        outlines=_with_rejections(outlines, problem, fit.accepted, offsets),
        start=label,
        iterations=fit.iterations,
    )


def _chi2(linear: Linearization) -> float:
    parts = (linear.outline_r, linear.encoder_r, linear.prior_r)
    return float(sum(np.sum(part**2) for part in parts))


def _comparable_cost(problem: FitProblem, state: State, settings: RefinementSettings) -> float:
    """Return the robust cost of all outlines under the noise that all fits share."""
    noise = NoiseModel(1.0, settings.comparison_px)
    whitening = noise.whitening(problem.outlines.covariance)
    data = data_of(problem, state, whitening, width_to_k(settings.loss_width))
    zero = ca.DM.zeros(problem.layout.size)
    return float(problem.cost(zero, *[np.asfortranarray(part.T) for part in data]))


def _with_rejections(
    outlines: Outlines, problem: FitProblem, accepted: BoolArray, offsets: Array
) -> Outlines:
    """Return the table with what the fit rejected, and by how much it disagrees."""
    used, reason = outlines.used.copy(), list(outlines.reason)
    worst = np.abs(offsets).max(axis=1, initial=0.0)
    for i in np.flatnonzero(~accepted):
        row = int(problem.outlines.index[i])
        used[row] = False
        reason[row] = f"disagrees with the fit by {worst[i]:.1f} px"
    return dataclasses.replace(outlines, used=used, reason=tuple(reason))


def _estimated_names(problem: FitProblem, legs: FittedLegs) -> tuple[str, ...]:
    """Return the names of the kinematic parameters that are unknowns of the fit."""
    is_free = problem.layout.offset < problem.layout.size
    joints = legs.parameter_names[: -legs.n_legs]
    offsets = legs.parameter_names[-legs.n_legs :]
    return (*joints, *(name for name, free in zip(offsets, is_free, strict=True) if free))
