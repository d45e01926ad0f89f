"""Verification of an earlier calibration by a few new images of the machine.

These are fitted twice: with wide priors, so that no plausible change is rejected as an outlier, and
with the earlier result as prior. The reduction of the squares by the free fit has an F distribution
if nothing moved. Unlike a difference of parameters, this likelihood ratio is not affected by
several minima of equal cost.

The change itself is identified from the difference of the free fit and the earlier result, with the
covariance of both. Directions that the new images determine worse than the priors do not count.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from scipy.special import fdtrc

from legcal.brief import brief
from legcal.calibration.board import board_notes
from legcal.calibration.diagnosis import notes_beside
from legcal.calibration.documents import (
    CheckDocument,
    ExplanationBlock,
    FitQuality,
    MovedPlatform,
)
from legcal.calibration.evaluation import machine_difference
from legcal.calibration.joint_fit.outline_errors import NoiseModel
from legcal.calibration.joint_fit.parameter_choices import Choices, Prior
from legcal.calibration.joint_fit.part_errors import part_derivatives
from legcal.calibration.joint_fit.platform import expected_error, moved_by
from legcal.calibration.joint_fit.problem import FitProblem
from legcal.calibration.joint_fit.solution import Solution
from legcal.calibration.joint_fit.variables import State, fitted_legs
from legcal.calibration.ordered_dataset import Options, order_dataset
from legcal.calibration.pipeline import estimate_parameters, outline_key
from legcal.calibration.result_folder import EarlierResult, load_result
from legcal.calibration.summary import mm_deg
from legcal.data.dataset import Dataset, load_dataset
from legcal.errors import DatasetError, NotIdentifiable, NotVisible, UsageError
from legcal.estimation.problem import Frames, GaussianPrior, linearize
from legcal.estimation.solver import Minimum, information, minimise
from legcal.estimation.uncertainty import named_covariance
from legcal.geometry.covariances import whitener
from legcal.geometry.types import Array, IntArray
from legcal.machine.equations import pose_sensitivity
from legcal.machine.leg import ARMS, LegKind, ParameterId
from legcal.machine.model import Machine, vectors_A_to_B
from legcal.machine.parameters import (
    geometries,
    parametrization_of,
    vector_of,
)
from legcal.machine.rods import first_rods
from legcal.progress import Progress, shown_progress
from legcal.workers import Workers, worker_pool

_SEEN = 1e-6  # change of a parameter over that of a part, below which it has no effect


@dataclass(frozen=True, eq=False)
class Change:
    """A possible change of the geometry."""

    part: str  # offset, base joint; "" for all of the owner
    owner: str  # a leg, or a motor that moves joints at A
    components: tuple[str, ...]  # names of the changed values: leg1.offset or x, y, z
    units: tuple[str, ...]  # m or rad
    links: tuple[str, ...]  # links of the axes of coordinates; empty for other components
    columns: Array  # (p, m): derivative of all parameters by the components

    @property
    def what(self) -> str:
        """Description: offset of leg1, base joint of leg2, leg3."""
        return f"{self.part} of {self.owner}" if self.part else self.owner


@dataclass(frozen=True, eq=False)
class Movement:
    """Test of an earlier result by new images."""

    statistic: float  # reduction of the squares by the free fit
    dof: int  # number of compared directions
    noise_dof: int  # degrees of freedom of the noise of the new images
    p_value: float  # probability of a larger statistic if nothing moved
    significance: float  # largest p-value of a movement
    explanations: tuple[ExplanationBlock, ...]  # the best first; empty if nothing moved

    @property
    def moved(self) -> bool:
        """Whether something has moved."""
        return self.p_value < self.significance


def difference(
    values: Array,  # (p,): parameters by the new images and the priors
    covariance: Array,  # (p, p): covariance of the values, priors included
    prior: Array,  # (p,): standard deviations of the priors, with the earlier result as mean
    old: Array,  # (p,): parameters of the earlier result
    old_covariance: Array,  # (p, p)
) -> tuple[Array, Array, Array]:
    """Return the determined directions (k, p), the differences (k,) and their covariance (k, k).

    Directions are derivatives by the parameters, each in sigmas of its prior.

    Raises NotIdentifiable if the new images determine nothing.
    """
    # In units of the priors, S is the information of the new images.
    scaled = covariance / np.outer(prior, prior)
    S = np.linalg.inv(scaled) - np.eye(len(prior))
    score = np.linalg.solve(scaled, (values - old) / prior)
    weight, vectors = np.linalg.eigh(0.5 * (S + S.T))
    is_determined = weight > 1.0
    if not is_determined.any():
        raise NotIdentifiable(
            "The earlier result could not be tested: the new images determine no direction of the "
            "parameters better than it is known without them; take more images, of more legs at "
            "once and at other poses."
        )
    directions = vectors[:, is_determined].T / prior
    return (
        directions,
        vectors[:, is_determined].T @ score / weight[is_determined],
        np.diag(1.0 / weight[is_determined]) + directions @ old_covariance @ directions.T,
    )


def determined_parts(covariance: Array, prior: Array) -> Array:
    """Return 1 - v by direction, (p,): v is the posterior variance over that of the wide prior."""
    return np.clip(1.0 - np.linalg.eigvalsh(covariance / np.outer(prior, prior)), 0.0, 1.0)


def noise_dof(dof: int, covariance: Array, prior: Array) -> int:
    """Return the degrees of freedom of the noise in a fit with wide priors.

    ``dof`` are residuals, including those of priors, less unknowns; ``covariance`` (p, p) is the
    covariance of the parameters with priors.
    """
    # A prior that is much wider than the posterior leaves no residual.
    dominated = len(prior) - float(np.trace(covariance / prior**2))
    return max(round(dof - dominated), 1)


def judge_movement(
    measured_difference: tuple[Array, Array, Array],
    saved: float,
    parts: Array,
    noise_dof: int,
    changes: Sequence[Sequence[Change]],
    significance: float,
) -> Movement:
    """Return the test of the earlier result, with the simplest sufficient explanations.

    ``measured_difference`` is the result of :func:`difference`, ``saved`` the reduction of the
    squares by a fit with wide priors against one with the earlier result. Along each direction it
    is its ``part`` (:func:`determined_parts`) times a chi2 variable with one degree of freedom; the
    probability of a larger sum comes by moment matching.
    ``significance`` is the probability of a false alarm.
    """
    directions, values, covariance = measured_difference
    whitening = whitener(covariance)
    residual = whitening @ values
    # Linear theory counts far outliers in full, the costs do not.
    share = saved / max(float(residual @ residual), np.finfo(np.float64).tiny)
    mean, variance = float(np.sum(parts)), 2.0 * float(np.sum(parts**2))
    p_value = float(fdtrc(2.0 * mean**2 / variance, max(noise_dof, 1), saved / mean))
    explanations: list[ExplanationBlock] = []
    if p_value < significance:
        for of_kind in changes:
            candidates = [
                _explain(whitening @ directions, residual, c, noise_dof, share) for c in of_kind
            ]
            explanations = sorted(candidates, key=lambda explanation: explanation.remaining)
            sufficient = [e for e in explanations if e.p_value >= significance]
            if sufficient:
                explanations = sufficient
                break
    return Movement(saved, len(residual), noise_dof, p_value, significance, tuple(explanations))


def _explain(
    directions: Array, residual: Array, change: Change, noise_dof: int, share: float
) -> ExplanationBlock:
    """Return the fit of a change to a whitened difference (k,); *share* scales the statistic."""
    by_change = directions @ change.columns
    inverse = np.linalg.pinv(by_change, rcond=1e-9)
    values = inverse @ residual
    remainder = residual - by_change @ values
    remaining = share * float(remainder @ remainder)
    dof = len(residual) - int(np.linalg.matrix_rank(by_change))
    return ExplanationBlock(
        what=change.what,
        components=list(change.components),
        units=list(change.units),
        links=list(change.links),
        values=values.tolist(),
        sigma=np.sqrt(np.sum(inverse**2, axis=1)).tolist(),
        remaining=remaining,
        p_value=float(fdtrc(dof, max(noise_dof, 1), remaining / dof)) if dof > 0 else 0.0,
    )


def possible_changes(machine: Machine, names: Sequence[str]) -> tuple[tuple[Change, ...], ...]:
    """Return the possible changes: single lengths first, then joints, then whole legs.

    *names* are the parameters that may differ. Joints move along the axes of the links of base and
    platform. Changes of a motor that moves joints at A affect all its rods.
    """
    fitted, changes = fitted_legs(machine), dict[str, list[Change]]()
    legs, moved = fitted.nominal, part_derivatives(fitted)[0]
    every, unit_of = fitted.parametrization.names, fitted.parametrization.units
    rows = np.array([every.index(name) for name in names], dtype=np.intp)
    sizes = {"m": machine.size, "rad": 1.0}
    least = _SEEN * np.array([[sizes[unit_of[i]]] for i in rows])
    turns = ("1", "2", "place 1", "place 2"), ("rad", "rad", "m", "m")

    def add(
        owner: str, part: str, names: Sequence[str], units: Sequence[str], J: Array, link: str = ""
    ) -> None:
        """Add the change of a part, without components that have no effect."""
        size = [sizes[unit] for unit in units[: J.shape[1]]]
        shown = np.flatnonzero(np.any(np.abs(J[rows]) * size > least, axis=0))
        if len(shown):
            components, of_shown = (tuple(x[k] for k in shown.tolist()) for x in (names, units))
            links, columns = (link,) * len(shown), J[np.ix_(rows, shown)]
            change = Change(part, owner, components, of_shown, links, columns)
            changes.setdefault(owner, []).append(change)

    for j, leg in enumerate(legs):
        if (j, "length") in moved:
            length = "length" if leg.kind is LegKind.CONSTANT else "offset"
            add(leg.name, length, [f"{leg.name}.{length}"], "m", moved[j, "length"])
        for part, end, link, T in (  # rows of T are the axes of the links in R_b and R_e
            ("base joint", "A", machine.base, machine.T_base_Rb),
            ("platform joint", "B", machine.platform, machine.T_platform_Re),
        ):
            along = moved[j, end] @ T.rotation.as_matrix().T
            add(leg.name, part, "xyz", "mmm", along, link)
        for axis in ("base_axis", "platform_axis"):
            if (j, axis) in moved:
                add(leg.name, axis.replace("_", " "), *turns, moved[j, axis])
    for j, motor in ((j, legs[j].motor_label) for j in first_rods(legs)):
        add(motor, "zero", [f"{motor}.zero"], [legs[j].reading_unit], moved[j, "zero"])
        if not legs[j].reads_angle:
            add(motor, "direction", *turns, moved[j, "axis"])
            continue
        add(motor, "axis", *turns, np.hstack([moved[j, "axis"], moved[j, "point"]]))
        if (j, "arm_axis") in moved:
            line = np.hstack([moved[j, "arm_axis"], moved[j, "arm_point"]])
            add(motor, "arm line", *turns, line)
    found = [change for of_owner in changes.values() for change in of_owner]
    return (
        tuple(change for change in found if len(change.components) == 1),
        tuple(change for change in found if len(change.components) > 1),
        tuple(_together(owner, own) for owner, own in changes.items() if len(own) > 1),
    )


def _together(name: str, changes: Sequence[Change]) -> Change:
    """Return all changes of one leg as one change."""
    return Change(
        "",
        name,
        tuple(
            component if component == f"{name}.{change.part}" else f"{change.part} {component}"
            for change in changes
            for component in change.components
        ),
        tuple(unit for change in changes for unit in change.units),
        tuple(link for change in changes for link in change.links),
        np.concatenate([change.columns for change in changes], axis=1),
    )


SIGNIFICANCE = 0.01
MAX_SIGNIFICANCE = 0.5
BETTER = 2.5  # smallest difference of costs that decides for another minimum
_BY_CHANCE = 1e-6  # probability of new images that agree as well as those of the calibration
PRIOR_SIGMA = 0.009  # [rad, mean leg lengths]; below the limit for directions held at nominal


@brief
@dataclass(frozen=True, eq=False)
class Check:
    """The result of :func:`legcal.check`."""

    # the new images; its ``machine`` is the calibrated model of the earlier result
    dataset: Dataset
    earlier: EarlierResult  # the tested result
    solution: Solution  # the fit of the new images alone
    movement: Movement  # the test; ``movement.moved`` is its answer
    # difference of the platform between new images and earlier result, root mean square over the
    # poses, and its standard deviation if nothing moved
    at_platform: MovedPlatform
    notes: tuple[str, ...] = ()  # further remarks

    @property
    def sentence(self) -> str:
        """The answer in words."""
        movement, pair = self.movement, self.at_platform
        p = "below 1e-6" if movement.p_value < 1e-6 else f"{movement.p_value:.2g}"
        test = f"p-value {p}, significance {100 * movement.significance:g} %"
        uncertainty = f"{mm_deg(pair.sigma_dX_m, pair.sigma_dE_rad)} (1 sigma)"
        if not movement.moved:
            return (
                f"No change was detected ({test}); the platform pose is confirmed to {uncertainty}."
            )
        change = mm_deg(pair.dX_m, pair.dE_rad)
        return (
            f"Something has moved ({test}): the platform pose has changed by {change}, uncertainty "
            f"{uncertainty}; calibrate again."
        )

    def document(self) -> dict[str, Any]:
        """Return the output of ``--json``."""
        return CheckDocument.describing(
            self.movement,
            legcal_check=1,
            result=str(self.earlier.folder),
            of=len(self.earlier.names),
            verdict=self.sentence,
            platform=self.at_platform,
            images=self.dataset.measurements.n_rows,
            residuals=FitQuality.model_validate(self.solution.quality),
            notes=list(self.notes),
        ).document()


def check(
    source: str | Path | Dataset,
    result: str | Path | EarlierResult,
    *,
    significance: float = SIGNIFICANCE,
    progress: Progress = False,
    workers: Workers = 1,
) -> Check:
    """Test with a few new images whether an earlier calibration still holds.

    Parameters
    ----------
    source : path or Dataset
        The new images, from arbitrary cameras. Nothing is written into their folder.
    result : path or EarlierResult
        The result folder of the earlier calibration.
    significance : float
        Probability of a false alarm.
    progress : bool or callable
        True shows bars on stderr; a function is called as ``progress(stage, done, total)``.
    workers : int, str or executor
        Search the images there, as :func:`legcal.calibrate` does.

    Returns
    -------
    Check

    Raises
    ------
    UsageError
        If the significance is out of range.
    DatasetError, ModelError, OutOfClass
        If images or result are malformed, or of different machines.
    NotVisible, NotIdentifiable, DidNotConverge
        If the new images cannot be fitted, or determine nothing.
    """
    if not 0.0 < significance <= MAX_SIGNIFICANCE:
        raise UsageError(
            f"The earlier result could not be tested: found the significance {significance:g}, "
            f"needed a probability above 0 and up to {MAX_SIGNIFICANCE:g} (0.01 gives one "
            "false alarm in a hundred checks); correct it."
        )
    earlier = result if isinstance(result, EarlierResult) else load_result(result)
    dataset = source if isinstance(source, Dataset) else load_dataset(source)
    dataset = _as_calibrated(dataset, earlier)
    prior = _EarlierEstimate.of(dataset.machine, earlier)
    choices = _choices(dataset, earlier, prior)
    with shown_progress(progress) as report, worker_pool(workers) as pool:
        data = order_dataset(dataset, pool, report, fingerprint=outline_key(dataset, choices))
        all_rows = np.arange(dataset.measurements.n_rows)
        estimate = estimate_parameters(data, all_rows, Options(choices, every_leg=False))
    if not estimate.outlines.used.any():
        refusal = (
            f"{dataset.folder}: the earlier result could not be tested: found no used outline in "
            "any image, needed some; take images that show the legs."
        )
        raise NotVisible([refusal, *estimate.image_notes])
    found = estimate.in_file_order()
    solution = found.solution
    answer = _compare(dataset, earlier, solution, prior, significance)
    sentences = (diagnosis.sentence for diagnosis in estimate.diagnosis)
    on_images = (*estimate.image_notes, *estimate.fit_notes)
    of_images = notes_beside(estimate.diagnosis, on_images, "legcal calibrate --check")
    known = "These images appear to be those of the earlier calibration itself: take new ones."
    of_boards = board_notes(dataset, solution, found.corners)
    notes = (*sentences, *dataset.notes, *of_images, *of_boards, *solution.notes)
    notes = (*[known] * (answer.movement.p_value > 1.0 - _BY_CHANCE), *notes)
    return replace(answer, notes=tuple(dict.fromkeys(notes)))


def _as_calibrated(dataset: Dataset, earlier: EarlierResult) -> Dataset:
    """Return the new images with the calibrated model in place of their own."""
    named, calibrated = dataset.machine, earlier.machine
    different = machine_difference(calibrated, named)
    if not different:
        calibrated = calibrated.with_leg_order(named.leg_names)
        for leg, other in zip(calibrated.legs, named.legs, strict=True):
            if leg.prismatic != other.prismatic:
                different = f"the joint {leg.prismatic}, not {other.prismatic}"
    if different:
        raise DatasetError(
            f"{earlier.folder}: the earlier result could not be tested with {dataset.folder}: "
            f"found the result of another machine, with {different}, needed one of the same; give "
            "the result that belongs to these images."
        )
    return replace(dataset, machine=calibrated, overrides=())


@dataclass(frozen=True, eq=False)
class _EarlierEstimate:
    """The tested parameters with the earlier estimate and their wide priors."""

    names: tuple[str, ...]
    old: Array  # (n,): earlier values
    covariance: Array  # (n, n): earlier covariance, with the wide prior along held directions
    sigma: Array  # (n,): standard deviations of the wide priors [m, rad]
    held_sigma: float  # standard deviation of the wide prior along held directions [m]

    @classmethod
    def of(cls, machine: Machine, earlier: EarlierResult) -> _EarlierEstimate:
        """Return the tested parameters of an earlier result."""
        legs, parametrization = geometries(machine), parametrization_of(machine, twists=True)
        values = vector_of(parametrization, legs, legs)
        chosen = [parametrization.names.index(name) for name in earlier.names]
        at_home = vectors_A_to_B(machine, machine.home)
        held_sigma = PRIOR_SIGMA * float(np.mean(np.linalg.norm(at_home, axis=1)))
        sigma = np.array(
            [held_sigma if parametrization.units[i] == "m" else PRIOR_SIGMA for i in chosen]
        )
        covariance = earlier.covariance + held_sigma**2 * earlier.held.T @ earlier.held
        return cls(earlier.names, values[chosen], covariance, sigma, held_sigma)


def _choices(dataset: Dataset, earlier: EarlierResult, prior: _EarlierEstimate) -> Choices:
    """Return choices with wide priors, so that any plausible change fits."""
    means, sigmas = prior.old.tolist(), prior.sigma.tolist()
    priors = {
        name: Prior(mean, sigma)
        for name, mean, sigma in zip(prior.names, means, sigmas, strict=True)
    }
    m = dataset.measurements
    cameras = dict(zip(m.owners, map(earlier.intrinsics, m.cameras), strict=True))
    # Lines of arms that the earlier images did not show were kept nominal and are uncertain.
    fixed = [name for name in earlier.fixed if ParameterId.parse(name).kind not in ARMS]
    return Choices(
        fixed=frozenset(fixed),
        priors=priors,
        cameras={owner: known for owner, known in cameras.items() if known is not None},
        least_shared_px=earlier.document.residuals.shared_px,
    )


@dataclass(frozen=True, eq=False)
class _Free:
    """The new images fitted with wide priors, at one of their minima."""

    minimum: Minimum[State]
    tested: IntArray  # indices of the tested parameters among the named unknowns
    more: Array  # (n, n): covariance of the tested parameters not included in the information
    prior: Array  # (n,): standard deviations of the wide priors

    @property
    def poses(self) -> Frames:
        """The platform poses."""
        return self.minimum.state.platform_pose.frames

    def estimate(self) -> tuple[Array, Array]:
        """Return the tested parameters (n,) and their covariance (n, n), at most the prior's."""
        linear, tested = self.minimum.linear, self.tested
        problem, unit = linear.problem, np.outer(self.prior, self.prior)
        named = named_covariance(linear, information(linear, problem.loss).kept_covariance())
        covariance = named[np.ix_(tested, tested)] + self.more
        variance, vectors = np.linalg.eigh(covariance / unit)
        covariance = (vectors * np.minimum(variance, 1.0)) @ vectors.T * unit
        return problem.coordinates(linear.state)[tested], covariance


def _fits(
    solution: Solution, prior: _EarlierEstimate, variance_factor: float
) -> tuple[_Free, _Free, float]:
    """Return the free fit, the free fit near the earlier result, and the reduction of the squares.

    The reduction is relative to a fit with the earlier result as additional prior. A free fit that
    starts at its solution gives the minimum near the earlier result; another minimum counts only if
    it fits better.
    """
    posterior, loss = solution.posterior, solution.posterior.problem.loss
    problem, state = posterior.problem, posterior.state
    block, outlines = problem.block("legs"), problem.factor("outlines")
    number = np.array([block.labels.index(name) for name in prior.names], dtype=np.intp)
    tested = problem.where("legs")[number]
    # Local edge biases do not show in residuals.
    linear = linearize(problem, state)
    without = information(linear, loss).kept_covariance()
    at_places = named_covariance(linear, posterior.covariance - without)
    at_places = at_places[np.ix_(tested, tested)]
    held = solution.kinematic.of_values(prior.names)[1]
    additional = at_places + prior.held_sigma**2 * held.T @ held
    earlier = GaussianPrior.from_covariance(number, prior.old, prior.covariance + at_places)

    whitening = outlines.whitening / np.sqrt(variance_factor)
    problem = problem.with_factors(replace(outlines, whitening=whitening))
    with_earlier = problem.with_parts((replace(block, prior=block.prior + earlier),), ())

    def minimum(fit_problem: FitProblem, begin: State) -> Minimum[State]:
        max_iterations = fit_problem.settings.max_iterations
        return minimise(
            fit_problem, begin, loss, max_iterations=max_iterations, must_converge=False
        )

    starts = (replace(state, legs=problem.legs.nominal), state)
    constrained = min(
        (minimum(with_earlier, begin) for begin in starts), key=lambda result: result.cost
    )
    near, elsewhere = minimum(problem, constrained.state), minimum(problem, state)
    best = elsewhere if near.cost - elsewhere.cost > BETTER else near
    near_earlier, free = (_Free(result, tested, additional, prior.sigma) for result in (near, best))
    saved = 2.0 * (constrained.cost - min(near.cost, elsewhere.cost))
    return free, near_earlier, max(saved, 0.0)  # zero for the images of the earlier result


def _compare(
    dataset: Dataset,
    earlier: EarlierResult,
    solution: Solution,
    prior: _EarlierEstimate,
    significance: float,
) -> Check:
    machine, parametrization = dataset.machine, solution.kinematic.parametrization
    columns = [parametrization.names.index(name) for name in prior.names]
    variance_factor = _earlier_noise(solution, earlier)
    free, near, saved = _fits(solution, prior, variance_factor)
    values, covariance = free.estimate()
    measured_difference = difference(values, covariance, prior.sigma, prior.old, prior.covariance)
    dof = earlier.document.residuals.dof
    if variance_factor == 1.0:
        dof = noise_dof(solution.quality.dof, covariance, prior.sigma)
    parts = determined_parts(covariance, prior.sigma)
    changes = possible_changes(machine, prior.names)
    movement = judge_movement(measured_difference, saved, parts, dof, changes, significance)
    fit = free if movement.moved else near
    J = pose_sensitivity(geometries(machine), parametrization, machine.frame_legs, *fit.poses)
    J, (values, covariance) = J[:, :, columns], fit.estimate()
    # Priors shrink the estimate towards the earlier result by 1 - G.
    G = np.eye(len(values)) - covariance / prior.sigma**2
    spread = G @ covariance + G @ prior.covariance @ G.T
    (dX, dE), sigma = moved_by(J, (values - prior.old)[:, None]).rms, expected_error(J, spread).rms
    moved = MovedPlatform(dX_m=dX, dE_rad=dE, sigma_dX_m=sigma[0], sigma_dE_rad=sigma[1])
    return Check(dataset, earlier, solution, movement, moved)


def _earlier_noise(solution: Solution, earlier: EarlierResult) -> float:
    """Return the ratio of the earlier to the new variance of outlines, at least one."""
    claimed = solution.outlines.covariance[solution.outlines.used]
    if len(claimed) == 0:
        return 1.0
    before = NoiseModel(**earlier.document.residuals.noise.document())
    new_variance, earlier_variance = (
        float(np.mean(np.trace(noise.covariance(claimed), axis1=1, axis2=2)))
        for noise in (solution.quality.noise, before)
    )
    return max(earlier_variance / new_variance, 1.0)
