"""The result of the joint fit, put together from a minimum, and put into the files' order."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from scipy.spatial.transform import RigidTransform

from legcal.brief import brief
from legcal.calibration.joint_fit.determinacy import HeldDirections, held_spread, named_units
from legcal.calibration.joint_fit.diagnostics import (
    DoubtedCamera,
    contradicted_radii,
    doubted_cameras,
    legs_left_out,
    rejected_notes,
    reversed_motors,
)
from legcal.calibration.joint_fit.free_poses import of_determined_poses
from legcal.calibration.joint_fit.held_out import Posterior
from legcal.calibration.joint_fit.outlier_readings import (
    JudgedReadings,
    judged_readings,
    reading_notes,
)
from legcal.calibration.joint_fit.outline_errors import (
    GAMMA_SUFFIX,
    EstimatedGamma,
    NoiseModel,
    notes_on_blur,
)
from legcal.calibration.joint_fit.parameter_choices import known_parameters
from legcal.calibration.joint_fit.problem import FitProblem
from legcal.calibration.joint_fit.rounds import Fit, corner_notes, rejection_reasons
from legcal.calibration.joint_fit.scale import scale_notes, sensitivity_to_scale
from legcal.calibration.joint_fit.sensitivity import (
    CameraResiduals,
    Sensitivity,
    WrongIntrinsic,
    sensitivities,
)
from legcal.calibration.joint_fit.variables import State
from legcal.data.dataset import Dataset
from legcal.data.image_tables import Order, inverse, reorder_measurements
from legcal.data.outlines import Outlines
from legcal.data.reasons import Reason, Rejection
from legcal.estimation.problem import linearize
from legcal.estimation.solver import NormalEquations, robust_cost
from legcal.estimation.uncertainty import WorstDirection, named_covariance, worst_directions
from legcal.geometry.types import Array, IntArray
from legcal.machine.leg import (
    KinematicParameters,
    Leg,
    parameters_of_legs,
    radius_name,
    with_platform_points,
)
from legcal.machine.parameters import Parametrization, parametrize
from legcal.vision.board import Link
from legcal.vision.camera import Camera

_SIGNIFICANT = 5.0  # standard deviations of chi2
ParameterStatus = Literal["estimated", "fixed", "weak"]


@brief
@dataclass(frozen=True, eq=False)
class KinematicUncertainty:
    """How well all p kinematic parameters are known; covariances are zero of what is fixed."""

    parametrization: Parametrization
    # (p, p) of steps, as moved_legs and pose_sensitivity have them (axes turn about the vectors of
    # where they are); zero along what is held
    covariance: Array
    # (p, p) how far steps may be off along what is held, if the nominal model is as wrong there as
    # the fit found it to be elsewhere
    held_covariance: Array
    value_covariance: Array  # (p, p) covariance of the values
    held_basis: Array  # (w, p) how values change along each held direction, by a metre
    held: tuple[str, ...]  # the directions that are held at nominal, in words

    @property
    def total_covariance(self) -> Array:
        """Of steps, (p, p): as far as the fit knows them, and along what is held."""
        return self.covariance + self.held_covariance

    def of_values(self, names: Sequence[str]) -> tuple[Array, Array]:
        """Return covariance (n, n) and held basis (w, n) of the values of some parameters."""
        at = _places(names, self.parametrization.names)
        return self.value_covariance[np.ix_(at, at)], self.held_basis[:, at]

    def in_order(self, parametrization: Parametrization) -> KinematicUncertainty:
        """Return the same in the order of another parametrization of these parameters."""
        at = _places(parametrization.names, self.parametrization.names)
        value_covariance, held_basis = self.of_values(parametrization.names)
        return KinematicUncertainty(
            parametrization,
            self.covariance[np.ix_(at, at)],
            self.held_covariance[np.ix_(at, at)],
            value_covariance,
            held_basis,
            self.held,
        )


@brief
@dataclass(frozen=True, eq=False)
class Estimates:
    """All parameters by name: kinematic ones, radii, unknown intrinsics, sizes of boards."""

    values: Mapping[str, float]  # [m, rad, px]
    units: Mapping[str, str]
    status: Mapping[str, ParameterStatus]  # weak: part of a direction that is held at nominal
    names: tuple[str, ...]  # the estimated ones, in the order of ``values``
    covariance: Array  # (n, n) of these, with cameras and poses unknown
    prior_sigma: Mapping[str, float]  # of the intrinsics that camera files state one of
    # the estimated directions known worst, worst first, of what no camera file states
    weak: tuple[WorstDirection, ...]

    @property
    def sigma(self) -> Array:
        """Standard deviations (n,) of the estimated ones."""
        return np.sqrt(np.diagonal(self.covariance))

    def vector(self, names: Sequence[str]) -> Array:
        """Return the values of some parameters, (len(names),)."""
        return np.array([self.values[name] for name in names])

    def in_order(self, names: Sequence[str]) -> Estimates:
        """Return the same in the order in which these names, and others, stand."""
        every = [name for name in names if name in self.values]
        estimated = tuple(name for name in every if name in self.names)
        at = _places(estimated, self.names)
        return replace(
            self,
            values={name: self.values[name] for name in every},
            units={name: self.units[name] for name in every},
            status={name: self.status[name] for name in every},
            names=estimated,
            covariance=self.covariance[np.ix_(at, at)],
        )


@brief
@dataclass(frozen=True, eq=False)
class GoodnessOfFit:
    """How large the residuals of a fit are, and the noise that they show."""

    cost: float  # over all observations, rejected ones too, with claimed covariances: comparable
    chi2: float  # of used outlines, axes, readings and priors
    dof: int
    rms_px: float | None  # of the offsets of used outlines [px]
    rms_axes: float | None  # of measured axes, over their claimed standard deviations
    rms_corners_px: Mapping[Link, float]  # of corners of the calibration board on each link [px]
    noise: NoiseModel  # errors of single outlines
    shared_px: Mapping[str, float]  # sigmas of common-mode biases by kind [px]; empty without any
    redundant_readings: JudgedReadings | None  # None where readings cannot disagree


@dataclass(frozen=True, eq=False)
class CameraDoubts:
    """The cameras that the measurements contradict."""

    tested: Sequence[WrongIntrinsic]  # whose residuals show one error, the clearest
    others: Sequence[DoubtedCamera]  # that are moved too far for what their files state

    @classmethod
    def of(cls, cameras: CameraResiduals, covariance: Array) -> CameraDoubts:
        """Return the doubts where a fit ended, with the covariance of its kept unknowns."""
        tested = cameras.contradicted()
        views = {test.view for test in tested}
        doubted = doubted_cameras(cameras.problem, cameras.state, covariance)
        return cls(tested, [camera for camera in doubted if camera.view not in views])

    @property
    def views(self) -> tuple[str, ...]:
        """The views that stand for these cameras."""
        views = [one.view for one in self.tested] + [one.view for one in self.others]
        return tuple(dict.fromkeys(views))

    @property
    def notes(self) -> tuple[str, ...]:
        """A sentence on each."""
        return tuple(str(one) for one in (*self.tested, *self.others))


@brief
@dataclass(frozen=True, eq=False)
class Solution:
    """A converged joint fit; axes count as angles from the nominal axis."""

    legs: tuple[Leg, ...]  # in R_b and R_e
    T_camera_Rb: tuple[RigidTransform, ...]  # one a view; of the start where it shows nothing
    cameras: tuple[Camera, ...]  # of the views, with the intrinsics that were estimated
    T_Rb_Re: tuple[RigidTransform, ...]  # platform poses
    radii: dict[tuple[int, str], float]  # [m] for each (leg index, part) that was observed
    estimates: Estimates
    kinematic: KinematicUncertainty
    quality: GoodnessOfFit
    # View, pose (-1 on the base: in all images of the view) and number; poses as the fit counts
    # them
    rejected_corners: tuple[tuple[str, int, int], ...]
    # T_Rb_board and T_Re_board, by the link that the board is fixed to, where images show one
    T_frame_board: dict[Link, RigidTransform]
    gammas: tuple[EstimatedGamma, ...]  # of cameras without a given gamma
    sensitivities: tuple[Sensitivity, ...]  # to mistakes in what was taken as known
    outlines: Outlines  # the table that came in, with what the fit rejected and why
    start: str  # label of the start that led here
    iterations: int  # of the solver, all rounds
    camera_doubts: CameraDoubts
    posterior: Posterior  # what it predicts of other images; in the order that was fitted
    notes: tuple[str, ...] = ()  # one sentence each
    details: tuple[str, ...] = ()  # how it was found, the same
    left_out: tuple[str, ...] = ()  # legs of views most of whose outlines disagree, unconfirmed

    @property
    def parameters(self) -> KinematicParameters:
        """Joint centres, and offsets or constant lengths [m]."""
        return parameters_of_legs(self.legs)

    def cameras_in_base(self, T_base_Rb: RigidTransform) -> tuple[RigidTransform, ...]:
        """Return T_base_camera of every view, R_b laid where the nominal model has it."""
        return tuple(T_base_Rb * T.inv() for T in self.T_camera_Rb)


def assemble_solution(
    fit: Fit,
    normal: NormalEquations,
    held: HeldDirections,
    outlines: Outlines,
    label: str,
) -> Solution:
    """Put together what was found; *normal* is the information where the fit ended.

    Raises
    ------
    NotIdentifiable
        If the outlines that are left do not determine the parameters.
    """
    problem, state, linear = fit.problem, fit.state, fit.minimum.linear
    kept = normal.kept_covariance()
    if fit.at_places is not None:
        kept = kept + fit.at_places.covariance
    covariance = named_covariance(problem, state, kept)
    quality = _quality(fit, normal, len(held.basis))
    cameras = CameraResiduals(problem, state, linear)
    doubts = CameraDoubts.of(cameras, kept)
    gammas = _gammas(problem, state, kept, outlines)
    scale = scale_notes(problem, state)
    return Solution(
        legs=state.legs,
        T_camera_Rb=state.camera_pose.motions,
        cameras=state.cameras,
        T_Rb_Re=state.platform_pose.motions,
        radii=dict(zip(problem.outlines.parts, state.radii.tolist(), strict=True)),
        estimates=_estimates(problem, state, held, covariance),
        kinematic=_kinematic(problem, state, held, kept, covariance),
        quality=quality,
        rejected_corners=tuple(
            (problem.outlines.views[view], pose, corner)
            for view, pose, corner in problem.rejected_corners
        ),
        T_frame_board={
            corners.link: T
            for corners, T in zip(problem.boards, state.board_pose.motions, strict=True)
            if len(corners)
        },
        gammas=gammas,
        sensitivities=(
            *sensitivities(cameras, normal, doubts.tested),
            *sensitivity_to_scale(problem, state, kept),
        ),
        outlines=_with_rejections(outlines, fit),
        start=label,
        iterations=fit.minimum.iterations,
        posterior=Posterior(problem, state, fit.edge_biases, fit.noise, kept),
        camera_doubts=doubts,
        left_out=legs_left_out(problem, fit.accepted),
        notes=(
            *fit.notes,
            *rejected_notes(problem, fit.accepted),
            *corner_notes(problem),
            *reading_notes(quality.redundant_readings),
            *reversed_motors(problem, state),
            *map(str, gammas),
            *notes_on_blur(fit.edge_biases, problem.outlines.covariance[fit.accepted]),
            *(scale or contradicted_radii(problem, state, normal)),
            *(_misfit_of_axes(quality) if len(problem.axes) else ()),
            *doubts.notes,
        ),
    )


def _quality(fit: Fit, normal: NormalEquations, n_held: int) -> GoodnessOfFit:
    """Return how well a fit agrees with its data; *n_held* directions are not estimated."""
    problem, state, linear = fit.problem, fit.state, fit.minimum.linear
    offsets = problem.offsets(state)
    used = offsets[fit.accepted]
    readings = judged_readings(problem, state, linear, normal)
    n_rejected = offsets.size - used.size + (0 if readings is None else len(readings.wrong))
    n_residuals = problem.n_equations + len(problem.priors.mean) - n_rejected
    of_rows = sum(float(np.sum(rows.r**2)) for rows in linear.rows.values())
    return GoodnessOfFit(
        cost=_comparable_cost(problem, state),
        chi2=float(np.sum(linear.prior_r**2)) + of_rows,
        dof=n_residuals - problem.n_unknowns + n_held,
        rms_px=_rms(used),
        rms_axes=_rms(linear["axes"].r),
        rms_corners_px={
            corners.link: rms
            for corners in problem.boards
            if (rms := _rms(linear[corners.name].r * corners.sigma[:, None])) is not None
        },
        noise=fit.noise,
        shared_px=fit.shared_px,
        redundant_readings=readings,
    )


def _comparable_cost(problem: FitProblem, state: State) -> float:
    """Return the robust cost of all observations with their claimed covariances."""
    claimed = problem.weighted(NoiseModel())
    return robust_cost(claimed, linearize(claimed, state), claimed.loss)


def _gammas(
    problem: FitProblem, state: State, covariance: Array, outlines: Outlines
) -> tuple[EstimatedGamma, ...]:
    """Return the estimated gammas; *covariance* is that of the kept unknowns."""
    o = problem.outlines
    found = []
    for k, position in enumerate(problem.where("biases").tolist()):
        camera = problem.named[position].removesuffix(GAMMA_SUFFIX)
        if camera == problem.named[position]:
            continue
        of_camera = np.array([name == camera for name in o.cameras], dtype=np.bool_)
        moved = of_camera[o.view] & (o.by_gamma != 0.0)
        measured_with = float(outlines.gamma[o.index[moved]][0])
        views = tuple(name for name, is_one in zip(o.views, of_camera, strict=True) if is_one)
        gamma = measured_with * float(np.exp(state.biases[k]))
        sigma = float(np.sqrt(covariance[position, position]))
        found.append(EstimatedGamma(views, gamma, sigma, measured_with))
    return tuple(found)


def _estimates(
    problem: FitProblem, state: State, held: HeldDirections, covariance: Array
) -> Estimates:
    """Return all parameters; *covariance* is that of the named unknowns."""
    legs, biases, found = problem.legs, problem.block("biases").labels, problem.legs.parametrization
    radii = [radius_name(legs.names[leg], part) for leg, part in problem.outlines.parts]
    unknown = [name for name in problem.named if name not in biases]
    of_unknowns = dict(zip(problem.named, problem.coordinates(state).tolist(), strict=True))
    values = dict(zip(found.names, legs.vector(state.legs).tolist(), strict=True))
    values |= dict(zip(radii, state.radii.tolist(), strict=True))
    values |= {name: of_unknowns[name] for name in unknown}
    units = dict.fromkeys(radii, "m") | dict(zip(problem.named, problem.units, strict=True))
    units |= dict(zip(found.names, found.units, strict=True))
    status: dict[str, ParameterStatus] = dict.fromkeys((*found.names, *radii), "fixed")
    status |= dict.fromkeys(unknown, "estimated")
    status |= dict.fromkeys(held.names, "weak")
    names = tuple(name for name in values if status[name] == "estimated")
    at = [problem.named.index(name) for name in names]
    estimated, prior_sigma = covariance[np.ix_(at, at)], _prior_sigma(problem)
    shown = [i for i, name in enumerate(names) if name not in prior_sigma]
    weak = worst_directions(
        estimated[np.ix_(shown, shown)],
        tuple(names[i] for i in shown),
        named_units(problem, state)[at][shown],
    )
    return Estimates(
        values,
        {name: units[name] for name in values},
        status,
        names,
        estimated,
        prior_sigma,
        weak,
    )


def _prior_sigma(problem: FitProblem) -> dict[str, float]:
    """Return the standard deviations that camera files state, by the name of the intrinsic."""
    priors, of_files = problem.priors, set(problem.calibrated.tolist())
    stated = zip(priors.unknown.tolist(), priors.sigma.tolist(), strict=True)
    return {problem.named[i]: sigma for i, sigma in stated if i in of_files}


def _kinematic(
    problem: FitProblem, state: State, held: HeldDirections, kept: Array, named: Array
) -> KinematicUncertainty:
    """Return the uncertainty of kinematic parameters from that of *kept* and *named* unknowns."""
    free, n = problem.free, problem.n_kinematic

    def of_every(covariance: Array) -> Array:
        """Return of the covariance of unknowns that of all these, fixed ones too."""
        wide = np.zeros((len(free), len(free)))
        wide[np.ix_(free, free)] = covariance[:n, :n]
        return wide

    held_basis = np.zeros((len(held.basis), len(free)))
    held_basis[:, free] = (held.basis * held.unit)[:, :n]
    return KinematicUncertainty(
        problem.legs.parametrization,
        of_every(kept),
        of_every(held_spread(problem, state, held)),
        of_every(named),
        held_basis,
        held.directions,
    )


def _rms(values: Array) -> float | None:
    """Return the root mean square of values, None of none."""
    return float(np.sqrt(np.mean(values**2))) if values.size else None


def _misfit_of_axes(quality: GoodnessOfFit) -> tuple[str, ...]:
    """Return a note where axes, whose errors are not estimated, are worse than they claim."""
    chi2, dof = quality.chi2, quality.dof
    if chi2 <= dof + _SIGNIFICANT * np.sqrt(2.0 * dof):
        return ()
    return (
        f"The axes are worse than their standard deviations claim: chi2 is {chi2:.0f} for {dof} "
        "degrees of freedom, so that the uncertainty of the result is about "
        f"{np.sqrt(chi2 / max(dof, 1)):.1f} times what is stated; correct them.",
    )


def _with_rejections(outlines: Outlines, fit: Fit) -> Outlines:
    """Return the table with what the fit rejected, and why."""
    used, reason, problem = outlines.used.copy(), list(outlines.reason), fit.problem
    rejected = np.flatnonzero(~fit.accepted)
    words = rejection_reasons(problem, fit.state, rejected, problem.offsets(fit.state))
    every = np.ones_like(fit.accepted)
    placed = of_determined_poses(problem.weighted(fit.noise), fit.state, every)[rejected]
    for row, why, has_pose in zip(problem.outlines.index[rejected], words, placed, strict=True):
        used[row] = False
        reason[row] = why if has_pose else Rejection(Reason.FEW_LEGS)
    return replace(outlines, used=used, reason=tuple(reason))


def in_file_order(solution: Solution, order: Order, dataset: Dataset) -> Solution:
    """Return a solution found in the order of work, in the order of the dataset's files.

    Parameters
    ----------
    solution : Solution
        In the order of work.
    order : Order
        What that order is.
    dataset : Dataset
        In the order of the files.

    Returns
    -------
    Solution
        B of legs that are fixed to the platform is where models put it.
    """
    machine, measurements = dataset.machine, dataset.measurements
    legs, views = inverse(order.legs).tolist(), inverse(order.views).tolist()
    origin = np.asarray(machine.T_platform_Re.inv().translation)
    geometry = with_platform_points([solution.legs[j] for j in legs], machine.frame_legs, origin)
    by_leg = {leg: j for j, leg in enumerate(legs)}
    radii = {(by_leg[leg], part): value for (leg, part), value in solution.radii.items()}
    known = known_parameters(machine, measurements.views, boards=dataset.boards).by_name
    names_of_legs, frame_legs = machine.leg_names, machine.frame_legs
    parametrization = parametrize(names_of_legs, geometry, frame_legs, twists=True)
    steps = _places(parametrization.names, solution.kinematic.parametrization.names)
    poses = _poses(order, dataset).tolist()
    file_pose = {worked: pose for pose, worked in enumerate(poses)}
    readings = solution.quality.redundant_readings
    return replace(
        solution,
        legs=geometry,
        T_camera_Rb=tuple(solution.T_camera_Rb[v] for v in views),
        cameras=tuple(solution.cameras[v] for v in views),
        T_Rb_Re=tuple(solution.T_Rb_Re[p] for p in poses),
        radii=dict(sorted(radii.items())),
        estimates=solution.estimates.in_order(tuple(known)),
        kinematic=solution.kinematic.in_order(parametrization),
        sensitivities=tuple(replace(s, steps=s.steps[steps]) for s in solution.sensitivities),
        outlines=order.restore(solution.outlines),
        quality=replace(
            solution.quality,
            redundant_readings=readings and readings.renumbered(order.legs.tolist(), file_pose),
        ),
    )


def _places(names: Sequence[str], among: tuple[str, ...]) -> IntArray:
    """Return where names stand among the same ones in another order."""
    return np.array([among.index(name) for name in names], dtype=np.intp)


def _poses(order: Order, dataset: Dataset) -> IntArray:
    """Return for every pose of the dataset its number in the order of work."""
    pose = dataset.measurements.pose
    worked = reorder_measurements(dataset.measurements, order).pose[inverse(order.rows)]
    found = np.empty(dataset.measurements.n_poses, dtype=np.intp)
    found[pose] = worked
    return found
