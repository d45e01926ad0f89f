"""Verification: a few new images of a machine against the result of an earlier calibration."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from legcal.brief import brief
from legcal.calibration.change_detection import (
    LikelihoodRatio,
    Movement,
    difference,
    judge_movement,
    noise_dof,
    possible_changes,
)
from legcal.calibration.diagnosis.diagnosis import notes_beside
from legcal.calibration.documents import (
    CheckDocument,
    ExplanationBlock,
    FitQuality,
    MovedPlatform,
)
from legcal.calibration.joint_fit.held_out import PlatformPair
from legcal.calibration.joint_fit.outline_errors import NoiseModel
from legcal.calibration.joint_fit.parameter_choices import Choices, Prior
from legcal.calibration.joint_fit.problem import FitProblem
from legcal.calibration.joint_fit.solution import Solution
from legcal.calibration.joint_fit.variables import State
from legcal.calibration.ordered_dataset import Options, order_dataset
from legcal.calibration.pipeline import estimate_parameters, outline_key
from legcal.calibration.result_folder import EarlierResult, load_result
from legcal.data.dataset import Dataset, load_dataset
from legcal.errors import DatasetError, NotVisible, UsageError
from legcal.estimation.problem import Frames, GaussianPrior, linearize
from legcal.estimation.solver import Minimum, information, minimise
from legcal.estimation.uncertainty import named_covariance
from legcal.geometry.types import Array, IntArray
from legcal.machine.equations import pose_sensitivity
from legcal.machine.model import Machine, vectors_A_to_B
from legcal.machine.parameter_id import ARMS, ParameterId
from legcal.machine.parameters import (
    Parametrization,
    geometries,
    parametrization_of,
    vector_of,
)
from legcal.progress import Progress, shown_progress
from legcal.vision.camera import shared_cameras
from legcal.workers import Workers, worker_pool

SIGNIFICANCE = 0.01
MAX_SIGNIFICANCE = 0.5
BETTER = 2.5  # of costs, by which another minimum of the new images is the one
PRIOR_SIGMA = 0.009  # [rad], or of the mean leg length: less than what a fit holds at nominal


@brief
@dataclass(frozen=True, eq=False)
class Check:
    """The result of :func:`legcal.check`.

    Attributes
    ----------
    dataset : Dataset
        The new images; its ``machine`` is the calibrated model of the earlier result.
    earlier : EarlierResult
        What was tested.
    solution : Solution
        The fit of the new images by themselves.
    movement : Movement
        The test; ``movement.moved`` is its answer.
    at_platform : PlatformPair
        How far the platform by the new images is from that by the earlier result, root mean square
        over the poses, and one standard deviation of this if nothing moved.
    notes : tuple of str
        What else a reader should know.
    """

    dataset: Dataset
    earlier: EarlierResult
    solution: Solution
    movement: Movement
    at_platform: PlatformPair
    notes: tuple[str, ...] = ()

    @property
    def sentence(self) -> str:
        """The answer in words."""
        movement, pair = self.movement, self.at_platform
        p = "below 1e-6" if movement.p_value < 1e-6 else f"{movement.p_value:.2g}"
        test = f"p-value {p}, significance {100 * movement.significance:g} %"
        known = (
            f"{1e3 * pair.expected_displacement:.3f} mm / "
            f"{np.degrees(pair.expected_rotation):.4f} deg (1 sigma)"
        )
        if not movement.moved:
            return (
                f"No change was detected ({test}); the platform relative to the earlier result is "
                f"known to {known}."
            )
        found = f"{1e3 * pair.displacement:.3f} mm / {np.degrees(pair.rotation):.4f} deg"
        return (
            f"Something has moved ({test}): the platform is {found} from where the earlier result "
            f"has it, known to {known}; calibrate again."
        )

    def document(self) -> dict[str, Any]:
        """Return the document that ``--json`` prints."""
        movement, pair = self.movement, self.at_platform
        return CheckDocument(
            legcal_check=1,
            result=str(self.earlier.folder),
            moved=movement.moved,
            significance=movement.significance,
            p_value=movement.p_value,
            statistic=movement.statistic,
            dof=movement.dof,
            of=len(self.earlier.names),
            noise_dof=movement.noise_dof,
            verdict=self.sentence,
            explanations=[
                ExplanationBlock(
                    what=found.change.what,
                    components=list(found.change.components),
                    units=list(found.change.units),
                    links=list(found.change.links),
                    values=found.values.tolist(),
                    sigma=found.sigma.tolist(),
                    remaining=found.remaining,
                    p_value=found.p_value,
                )
                for found in movement.explanations
            ],
            platform=MovedPlatform(
                dX_m=pair.displacement,
                dE_rad=pair.rotation,
                sigma_dX_m=pair.expected_displacement,
                sigma_dE_rad=pair.expected_rotation,
            ),
            images=self.dataset.measurements.n_rows,
            residuals=FitQuality.model_validate(self.solution.quality),
            notes=list(self.notes),
        ).document()


def check(
    source: str | Path | Dataset,
    result: str | Path,
    *,
    significance: float = SIGNIFICANCE,
    progress: Progress = False,
    workers: Workers = 1,
) -> Check:
    """Test with a few new images whether an earlier calibration still holds.

    Parameters
    ----------
    source : path or Dataset
        The new images, of cameras anywhere. Nothing is written beside them.
    result : path
        The folder that the earlier calibration wrote.
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
        If the new images cannot be fitted, or say nothing.
    """
    if not 0.0 < significance <= MAX_SIGNIFICANCE:
        raise UsageError(
            f"The earlier result could not be tested: found the significance {significance:g}, "
            f"needed a probability above 0 and up to {MAX_SIGNIFICANCE:g} (0.01 gives one "
            "false alarm in a hundred checks); correct it."
        )
    earlier = load_result(result)
    dataset = source if isinstance(source, Dataset) else load_dataset(source)
    dataset = _as_calibrated(dataset, earlier)
    prior = _EarlierEstimate.of(dataset.machine, earlier)
    choices = _choices(dataset, earlier, prior)
    with shown_progress(progress) as report, worker_pool(workers) as pool:
        data = order_dataset(dataset, pool, report, fingerprint=outline_key(dataset, choices))
        every_row = np.arange(dataset.measurements.n_rows)
        found = estimate_parameters(data, every_row, Options(choices, every_leg=False))
    if dataset.axes is None and not found.outlines.used.any():
        refusal = (
            f"{dataset.folder}: the earlier result could not be tested: found no used outline in "
            "any image, needed some; take images that show the legs."
        )
        raise NotVisible([refusal, *found.image_notes])
    solution = found.in_file_order().solution
    tested = _compare(dataset, earlier, solution, prior, significance)
    wrong = (one.sentence for one in found.diagnosis)
    on_images = (*found.image_notes, *found.fit_notes)
    of_images = notes_beside(found.diagnosis, on_images, "legcal calibrate --check")
    notes = (*wrong, *dataset.notes, *of_images, *solution.notes)
    return replace(tested, notes=tuple(dict.fromkeys(notes)))


def _as_calibrated(dataset: Dataset, earlier: EarlierResult) -> Dataset:
    """Return new images with the calibrated model in place of the one that they name."""
    given, calibrated = dataset.machine, earlier.machine
    if sorted(given.leg_names) != sorted(calibrated.leg_names):
        different = f"the legs {', '.join(calibrated.leg_names)}, not {', '.join(given.leg_names)}"
    else:
        calibrated = calibrated.with_leg_order(given.leg_names)
        different = _model_difference(calibrated, given)
    if different:
        raise DatasetError(
            f"{earlier.folder}: the earlier result could not be tested with {dataset.folder}: "
            f"found the result of another machine, with {different}, needed one of the same; give "
            "the result that belongs to these images."
        )
    return replace(dataset, machine=calibrated, overrides=())


def _model_difference(calibrated: Machine, given: Machine) -> str:
    """Return what differs between two models of the same legs, nothing if they are one machine."""
    for one, other in zip(calibrated.legs, given.legs, strict=True):
        here, there = (f"{leg.name} ({leg.kind}, {leg.type})" for leg in (one, other))
        if here != there:
            return f"the leg {here}, not {there}"
        if one.prismatic != other.prismatic:
            return f"the joint {one.prismatic}, not {other.prismatic}"
    frames = [[m.leg_names[j] for j in m.frame_legs] for m in (calibrated, given)]
    if frames[0] != frames[1]:
        return f"base_frame {', '.join(frames[0])}, not {', '.join(frames[1])}"
    return ""


@dataclass(frozen=True, eq=False)
class _EarlierEstimate:
    """The parameters that may have moved: where they were, and how far they may be now."""

    names: tuple[str, ...]
    old: Array  # (n,) earlier values
    covariance: Array  # (n, n) of these, with room along what was held
    sigma: Array  # (n,) standard deviations that leave room for whatever moved [m, rad]
    held_sigma: float  # the same along directions that are held [m]

    @classmethod
    def of(cls, machine: Machine, earlier: EarlierResult) -> _EarlierEstimate:
        """Return what an earlier result says of the parameters of its mechanism."""
        legs, found = geometries(machine), parametrization_of(machine, twists=True)
        values = vector_of(found, legs, legs)
        chosen = [found.names.index(name) for name in earlier.names]
        at_home = vectors_A_to_B(machine, machine.home)
        held_sigma = PRIOR_SIGMA * float(np.mean(np.linalg.norm(at_home, axis=1)))
        sigma = np.array([held_sigma if found.units[i] == "m" else PRIOR_SIGMA for i in chosen])
        covariance = earlier.covariance + held_sigma**2 * earlier.held.T @ earlier.held
        return cls(earlier.names, values[chosen], covariance, sigma, held_sigma)


def _choices(dataset: Dataset, earlier: EarlierResult, prior: _EarlierEstimate) -> Choices:
    """Return priors that leave room for whatever may have moved."""
    means, sigmas = prior.old.tolist(), prior.sigma.tolist()
    priors = {
        name: Prior(mean, sigma)
        for name, mean, sigma in zip(prior.names, means, sigmas, strict=True)
    }
    views = dataset.measurements.views
    owners = shared_cameras([view.name for view in views], [view.camera for view in views])
    found = {owner: earlier.intrinsics(v.camera) for owner, v in zip(owners, views, strict=True)}
    # Lines of arms that the earlier images did not show were left at nominal, and not known.
    fixed = [name for name in earlier.fixed if ParameterId.parse(name).kind not in ARMS]
    return Choices(
        fixed=frozenset(fixed),
        priors=priors,
        cameras={owner: known for owner, known in found.items() if known is not None},
        least_shared_px=earlier.document.residuals.shared_px,
    )


@dataclass(frozen=True, eq=False)
class _Free:
    """The new images fitted with wide priors, at one of their minima."""

    problem: FitProblem
    minimum: Minimum[State]
    which: IntArray  # the tested parameters among the named unknowns
    more: Array  # (n, n) covariance of these besides that by information
    prior: Array  # (n,) their wide priors

    @property
    def poses(self) -> Frames:
        """The platform poses."""
        return self.minimum.state.platform_pose.frames

    def estimate(self) -> tuple[Array, Array]:
        """Return the tested parameters (n,) and their covariance (n, n), below the prior's."""
        problem, state, which = self.problem, self.minimum.state, self.which
        normal = information(problem, state, self.minimum.linear, problem.loss)
        named = named_covariance(problem, state, normal.kept_covariance())
        covariance, unit = named[np.ix_(which, which)] + self.more, np.outer(self.prior, self.prior)
        variance, vectors = np.linalg.eigh(covariance / unit)
        covariance = (vectors * np.minimum(variance, 1.0)) @ vectors.T * unit
        return problem.coordinates(state)[which], covariance


def _fits(
    solution: Solution, prior: _EarlierEstimate, variance_factor: float
) -> tuple[_Free, _Free, float]:
    """Return the free fit, that one next to the earlier result, and the squares that it saves.

    They are saved over a fit with the earlier result as a prior beside the wide ones. A free fit
    that starts where this one ends is what the images say near the earlier result; another minimum
    counts where it fits better.
    """
    posterior, loss = solution.posterior, solution.posterior.problem.loss
    problem, state = posterior.problem, posterior.state
    block, outlines = problem.block("legs"), problem.factor("outlines")
    number = np.array([block.labels.index(name) for name in prior.names], dtype=np.intp)
    which = problem.where("legs")[number]
    # Errors of edges that return to places are in no residual.
    normal = information(problem, state, linearize(problem, state), loss)
    at_places = named_covariance(problem, state, posterior.covariance - normal.kept_covariance())
    at_places = at_places[np.ix_(which, which)]
    held = solution.kinematic.of_values(prior.names)[1]
    more = at_places + prior.held_sigma**2 * held.T @ held
    earlier = GaussianPrior.from_covariance(number, prior.old, prior.covariance + at_places)

    whitening = outlines.whitening / np.sqrt(variance_factor)
    problem = problem.with_factors(replace(outlines, whitening=whitening))
    with_earlier = problem.with_parts((replace(block, prior=block.prior + earlier),), ())

    def minimum(of: FitProblem, begin: State) -> Minimum[State]:
        most = of.settings.max_iterations
        return minimise(of, begin, loss, max_iterations=most, must_converge=False)

    starts = (replace(state, legs=problem.legs.nominal), state)
    there = min((minimum(with_earlier, begin) for begin in starts), key=lambda one: one.cost)
    near, elsewhere = minimum(problem, there.state), minimum(problem, state)
    best = elsewhere if near.cost - elsewhere.cost > BETTER else near
    beside, free = (_Free(problem, one, which, more, prior.sigma) for one in (near, best))
    saved = 2.0 * (there.cost - min(near.cost, elsewhere.cost))
    return free, beside, max(saved, 0.0)  # images of the earlier result save nothing


def _compare(
    dataset: Dataset,
    earlier: EarlierResult,
    solution: Solution,
    prior: _EarlierEstimate,
    significance: float,
) -> Check:
    """Return what the fit of the new images says against the earlier result."""
    machine, parametrization = dataset.machine, solution.kinematic.parametrization
    columns = [parametrization.names.index(name) for name in prior.names]
    variance_factor = _earlier_noise(solution, earlier)
    free, near, saved = _fits(solution, prior, variance_factor)
    values, covariance = free.estimate()
    found = difference(values, covariance, prior.sigma, prior.old, prior.covariance)
    dof = earlier.document.residuals.dof
    if variance_factor == 1.0:
        dof = noise_dof(solution.quality.dof, covariance, prior.sigma)
    ratio = LikelihoodRatio.of(saved, covariance, prior.sigma)
    changes = possible_changes(machine, _only(parametrization, columns))
    movement = judge_movement(found, ratio, dof, changes, significance)
    fit = free if movement.moved else near
    J = pose_sensitivity(geometries(machine), parametrization, machine.frame_legs, *fit.poses)
    at_platform = _moved_platform(J[:, :, columns], fit, prior)
    return Check(dataset, earlier, solution, movement, at_platform)


def _moved_platform(J: Array, fit: _Free, prior: _EarlierEstimate) -> PlatformPair:
    """Return how far a fit moves the platform; J (k, 6, n) has its derivative by the parameters."""
    values, covariance = fit.estimate()
    # Priors pull what was found to the earlier result by 1 - G.
    G = np.eye(len(values)) - covariance / prior.sigma**2
    spread = G @ covariance + G @ prior.covariance @ G.T
    shift = J @ (values - prior.old)
    variance = np.einsum("kia,ab,kib->ki", J, spread, J, optimize=True)
    return PlatformPair(
        _rms(shift[:, 3:] ** 2),
        _rms(variance[:, 3:]),
        _rms(shift[:, :3] ** 2),
        _rms(variance[:, :3]),
    )


def _earlier_noise(solution: Solution, earlier: EarlierResult) -> float:
    """Return how many times the variance by the new images is that by the earlier ones, or one."""
    claimed = solution.outlines.covariance[solution.outlines.used]
    if len(claimed) == 0:
        return 1.0
    before = NoiseModel(**earlier.document.residuals.noise.document())
    now, then = (
        float(np.mean(np.trace(noise.covariance(claimed), axis1=1, axis2=2)))
        for noise in (solution.quality.noise, before)
    )
    return max(then / now, 1.0)


def _only(parametrization: Parametrization, columns: Sequence[int]) -> Parametrization:
    """Return some of the parameters."""
    place = np.full(parametrization.place.shape, -1, dtype=np.intp)
    for new, old in enumerate(columns):
        place[parametrization.place == old] = new
    return Parametrization(
        tuple(parametrization.names[i] for i in columns),
        tuple(parametrization.units[i] for i in columns),
        place,
    )


def _rms(squares: Array) -> float:
    """Return the root of the mean over poses of sums of squares (k, 3)."""
    return float(np.sqrt(np.mean(squares.sum(axis=1))))
