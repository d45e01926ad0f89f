"""The result of the joint fit, assembled at a minimum, and reordered to the files' order."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from scipy.spatial.transform import RigidTransform

from legcal.brief import brief
from legcal.calibration.joint_fit.determinacy import HeldDirections, covariance_of_held, named_units
from legcal.calibration.joint_fit.diagnostics import (
    contradicted_radii,
    legs_left_out,
    rejected_notes,
    reversed_motors,
)
from legcal.calibration.joint_fit.free_poses import of_determined_poses
from legcal.calibration.joint_fit.held_out import Posterior, rms
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
from legcal.calibration.joint_fit.parameter_choices import dataset_parameters
from legcal.calibration.joint_fit.problem import FitNormal, FitProblem
from legcal.calibration.joint_fit.rounds import Fit, corner_notes, rejection_reasons
from legcal.calibration.joint_fit.scale import sensitivity_to_scale
from legcal.calibration.joint_fit.sensitivity import (
    CameraResiduals,
    WrongIntrinsic,
    sensitivity_to_cameras,
    sensitivity_to_exact_cameras,
    sensitivity_to_intrinsics,
)
from legcal.calibration.joint_fit.variables import State
from legcal.data.dataset import Dataset
from legcal.data.image_tables import Order, inverse, reorder_measurements
from legcal.data.measurements import Measurements
from legcal.data.outlines import Outlines, polished_parts
from legcal.data.reasons import Reason, Rejection
from legcal.estimation.problem import linearize
from legcal.estimation.solver import robust_cost
from legcal.estimation.uncertainty import WorstDirection, named_covariance, worst_directions
from legcal.geometry.motions import components
from legcal.geometry.types import Array, IntArray
from legcal.machine.leg import (
    Leg,
    Link,
    radius_name,
    with_platform_points,
)
from legcal.machine.model import Machine
from legcal.machine.parameters import Parametrization, geometries, parametrize, vector_of
from legcal.machine.rods import ends_in_base, measured_readings
from legcal.perception.placement import Placement, placed_arms
from legcal.vision.camera import Camera

_SIGNIFICANT = 5.0  # standard deviations of chi2
ParameterStatus = Literal["estimated", "fixed", "weak"]


@brief
@dataclass(frozen=True, eq=False)
class KinematicUncertainty:
    """Covariances of all p kinematic parameters; zero for fixed ones."""

    parametrization: Parametrization
    # (p, p) of steps, as in moved_legs and pose_sensitivity (rotation vectors for axes); zero along
    # held directions
    covariance: Array
    # (p, p) of steps along held directions, if the nominal model is as wrong there as elsewhere
    held_covariance: Array
    value_covariance: Array  # (p, p) of values
    held_basis: Array  # (w, p) change of values along each held direction, by a metre
    held: tuple[str, ...]  # descriptions of the held directions

    @property
    def total_covariance(self) -> Array:
        """Covariance (p, p) of steps, with held directions."""
        return self.covariance + self.held_covariance

    def of_values(self, names: Sequence[str]) -> tuple[Array, Array]:
        """Return covariance (n, n) and held basis (w, n) of the values of named parameters."""
        indices = _indices_of(names, self.parametrization.names)
        return self.value_covariance[np.ix_(indices, indices)], self.held_basis[:, indices]

    def in_order(self, parametrization: Parametrization) -> KinematicUncertainty:
        """Reorder to another parametrization of the same parameters."""
        indices = _indices_of(parametrization.names, self.parametrization.names)
        value_covariance, held_basis = self.of_values(parametrization.names)
        return KinematicUncertainty(
            parametrization,
            self.covariance[np.ix_(indices, indices)],
            self.held_covariance[np.ix_(indices, indices)],
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
    status: Mapping[str, ParameterStatus]  # weak: part of a held direction
    names: tuple[str, ...]  # the estimated ones, in the order of ``values``
    covariance: Array  # (n, n) of these, cameras and poses marginalised out
    prior_sigma: Mapping[str, float]  # of intrinsics, from camera files
    # estimated directions of largest variance, worst first, without intrinsics of camera files
    weak: tuple[WorstDirection, ...]

    @property
    def sigma(self) -> Array:
        """Standard deviations (n,) of the estimated ones."""
        return np.sqrt(np.diagonal(self.covariance))

    def vector(self, names: Sequence[str]) -> Array:
        """Return the values of named parameters, (len(names),)."""
        return np.array([self.values[name] for name in names])

    def transformed(
        self, values: Mapping[str, float], free: Collection[str], C: Array, by_fit: Array
    ) -> Estimates:
        """Return other kinematic parameters, of which *free* ones are estimated.

        *values* are all of them by name, C (p, p) their covariance, *by_fit* (p, p) their
        derivative by those of the fit.
        """
        kinematic = list(values)
        names = tuple(n for n in self.values if n in free or (n in self.names and n not in values))
        M = np.zeros((len(names), len(self.names)))
        for i, name in enumerate(names):
            for k, of_fit in enumerate(self.names):
                if name in values and of_fit in values:
                    M[i, k] = by_fit[kinematic.index(name), kinematic.index(of_fit)]
                elif name == of_fit:
                    M[i, k] = 1.0
        covariance = M @ self.covariance @ M.T
        own = [i for i, name in enumerate(names) if name in values]
        indices = [kinematic.index(names[i]) for i in own]
        covariance[np.ix_(own, own)] = C[np.ix_(indices, indices)]
        status: dict[str, ParameterStatus] = dict.fromkeys(values, "fixed")
        status |= dict.fromkeys(free, "estimated")
        return replace(
            self,
            values={**self.values, **values},
            status={**self.status, **status},
            names=names,
            covariance=covariance,
        )

    def in_order(self, names: Sequence[str]) -> Estimates:
        """Reorder by *names*, which may have further names."""
        ordered = [name for name in names if name in self.values]
        estimated = tuple(name for name in ordered if name in self.names)
        indices = _indices_of(estimated, self.names)
        return replace(
            self,
            values={name: self.values[name] for name in ordered},
            units={name: self.units[name] for name in ordered},
            status={name: self.status[name] for name in ordered},
            names=estimated,
            covariance=self.covariance[np.ix_(indices, indices)],
        )


@brief
@dataclass(frozen=True, eq=False)
class GoodnessOfFit:
    """Residuals of a fit, and the noise estimated from them."""

    cost: float  # of all observations, rejected too, with claimed covariances: comparable
    chi2: float  # of used outlines, axes, readings and priors
    dof: int
    rms_px: float | None  # of the offsets of used outlines [px]
    rms_corners_px: Mapping[Link, float]  # of corners of the calibration board on each link [px]
    noise: NoiseModel  # errors of single outlines
    shared_px: Mapping[str, float]  # sigmas of common-mode biases by kind [px]; empty without any
    # of one end of an edge of a body, seen from the other [px]; None where no edge is used
    edges_px: float | None
    redundant_readings: JudgedReadings | None  # None where readings cannot disagree


@brief
@dataclass(frozen=True, eq=False)
class Solution:
    """A converged joint fit; axes count as angles from the nominal axis."""

    legs: tuple[Leg, ...]  # in R_b and R_e
    T_camera_Rb: tuple[RigidTransform, ...]  # one a view; of the start for a view without data
    cameras: tuple[Camera, ...]  # of the views, with the intrinsics that were estimated
    T_Rb_Re: tuple[RigidTransform, ...]  # platform poses
    radii: dict[tuple[int, str], float]  # [m] for each (leg index, part) that was observed
    estimates: Estimates
    kinematic: KinematicUncertainty
    quality: GoodnessOfFit
    # view, pose in the fit (-1 on the base: in all images of the view), and number
    rejected_corners: tuple[tuple[str, int, int], ...]
    # T_Rb_board and T_Re_board, by the link that the board is fixed to, where images show one
    T_frame_board: dict[Link, RigidTransform]
    gammas: tuple[EstimatedGamma, ...]  # of cameras without a given gamma
    # (p, c) changes of the parameters [m, rad] by c independent errors of a fixed quantity, by what
    # it is
    sensitivities: Mapping[str, Array]
    outlines: Outlines  # the input table, with the rejections of the fit
    start: str  # label of the start
    iterations: int  # of the solver, all rounds
    camera_doubts: tuple[WrongIntrinsic, ...]  # cameras that the measurements contradict
    posterior: Posterior  # to predict other images; in the order of the fit
    notes: tuple[str, ...] = ()  # one sentence each
    details: tuple[str, ...] = ()  # on the starts, one sentence each
    left_out: tuple[str, ...] = ()  # legs in views with most outlines rejected, unconfirmed
    edges: Outlines | None = None  # straight edges of bodies, with the rejections of the fit

    def cameras_in_base(self, T_base_Rb: RigidTransform) -> tuple[RigidTransform, ...]:
        """Return T_base_camera of every view, with R_b at its nominal pose in the base."""
        return tuple(T_base_Rb * T.inv() for T in self.T_camera_Rb)

    def shown_cameras(
        self, measurements: Measurements, T_base_Rb: RigidTransform
    ) -> tuple[RigidTransform | None, ...]:
        """Return T_base_camera of the views with an outline in the fit, None of others."""
        shown = np.unique(measurements.view[self.outlines.row[self.outlines.used]])
        cameras = self.cameras_in_base(T_base_Rb)
        return tuple(T if v in shown else None for v, T in enumerate(cameras))

    def placement(
        self,
        machine: Machine,
        measurements: Measurements,
        T_Rb_Re: Sequence[RigidTransform] | None = None,
        blur: Sequence[float] = (),
    ) -> Placement:
        """Return the legs and cameras of the fit, with R_b on the nominal one.

        At its own poses, or at those of other images of the same views.
        """
        T_base_Rb, poses = machine.T_base_Rb, components(T_Rb_Re or self.T_Rb_Re)
        q = measured_readings(self.legs, *poses, measurements.q_of_poses)
        A, B = (ends[measurements.pose] for ends in ends_in_base(self.legs, T_base_Rb, *poses, q))
        arms = placed_arms(self.legs, q, measurements.pose, T_base=T_base_Rb, radii=self.radii)
        cameras, polished = self.cameras_in_base(T_base_Rb), polished_parts(self.outlines)
        return Placement.of_fit(A, B, cameras, blur, arms, polished)


def assemble_solution(
    fit: Fit,
    normal: FitNormal,
    held: HeldDirections,
    outlines: Outlines,
    label: str,
) -> Solution:
    """Assemble the solution; *normal* is the information at the minimum.

    Raises NotIdentifiable if the inliers do not determine the parameters.
    """
    problem, state, linear = fit.problem, fit.state, fit.minimum.linear
    kept = normal.kept_covariance()
    if fit.absorbed is not None:
        kept = kept + fit.absorbed[1]
    covariance = named_covariance(linear, kept)
    quality = _goodness_of_fit(fit, normal, len(held.basis))
    cameras = CameraResiduals(linear)
    contradicted = tuple(cameras.contradicted())
    gammas = _gammas(problem, state, kept, outlines)
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
        sensitivities=sensitivity_to_cameras(cameras, normal, contradicted)
        | sensitivity_to_exact_cameras(cameras)
        | sensitivity_to_scale(linear, kept)
        | sensitivity_to_intrinsics(problem, kept),
        outlines=_with_rejections(outlines, fit),
        start=label,
        iterations=fit.minimum.iterations,
        posterior=Posterior(problem, state, fit.edge_biases, fit.noise, kept),
        camera_doubts=contradicted,
        left_out=legs_left_out(problem, fit.accepted),
        notes=(
            *fit.notes,
            *rejected_notes(problem, fit.accepted),
            *corner_notes(problem),
            *reading_notes(quality.redundant_readings),
            *reversed_motors(problem, state),
            *map(str, gammas),
            *notes_on_blur(fit.edge_biases, problem.outlines.covariance[fit.accepted]),
            *contradicted_radii(normal),
            *map(str, contradicted),
        ),
    )


def _goodness_of_fit(fit: Fit, normal: FitNormal, n_held: int) -> GoodnessOfFit:
    """Residual statistics of a fit with *n_held* held directions."""
    problem, state, linear = fit.problem, fit.state, fit.minimum.linear
    offsets = problem.offsets(state)
    used = offsets[fit.accepted]
    readings = judged_readings(normal)
    n_rejected = offsets.size - used.size + (0 if readings is None else len(readings.wrong))
    n_residuals = problem.n_equations + len(problem.priors.mean) - n_rejected
    of_rows = sum(float(np.sum(rows.r**2)) for rows in linear.rows.values())
    claimed = problem.weighted(NoiseModel())
    of_edges = np.ravel(problem.factor("edges").whitening)
    of_edges = of_edges[of_edges > 0.0]
    return GoodnessOfFit(
        cost=robust_cost(linearize(claimed, state), claimed.loss),
        chi2=float(np.sum(linear.prior_r**2)) + of_rows,
        dof=n_residuals - problem.n_unknowns + n_held,
        rms_px=rms(used),
        rms_corners_px={
            corners.link: rms_px
            for corners in problem.boards
            if (rms_px := rms(linear[corners.name].r * corners.sigma[:, None])) is not None
        },
        noise=fit.noise,
        shared_px=fit.shared_px,
        edges_px=float(np.median(1.0 / of_edges)) if len(of_edges) else None,
        redundant_readings=readings,
    )


def _gammas(
    problem: FitProblem, state: State, covariance: Array, outlines: Outlines
) -> tuple[EstimatedGamma, ...]:
    """Estimated gammas; *covariance* is of the kept unknowns."""
    o = problem.outlines
    gammas = []
    for k, position in enumerate(problem.where("biases").tolist()):
        camera = problem.named[position].removesuffix(GAMMA_SUFFIX)
        if camera == problem.named[position]:
            continue
        of_camera = np.array([name == camera for name in o.cameras], dtype=np.bool_)
        moving = of_camera[o.view] & (o.by_gamma != 0.0)
        measured_with = float(outlines.gamma[o.index[moving]][0])
        views = tuple(name for name, is_one in zip(o.views, of_camera, strict=True) if is_one)
        gamma = measured_with * float(np.exp(state.biases[k]))
        sigma = float(np.sqrt(covariance[position, position]))
        gammas.append(EstimatedGamma(views, gamma, sigma, measured_with))
    return tuple(gammas)


def _estimates(
    problem: FitProblem, state: State, held: HeldDirections, covariance: Array
) -> Estimates:
    """Estimates of all parameters; *covariance* is of the named unknowns."""
    legs, parametrization = problem.legs, problem.legs.parametrization
    nuisance = {*problem.block("biases").labels, *problem.block("leans").labels}
    radii = [radius_name(legs.names[leg], part) for leg, part in problem.outlines.parts]
    unknown = [name for name in problem.named if name not in nuisance]
    unknown_values = dict(zip(problem.named, problem.coordinates(state).tolist(), strict=True))
    values = dict(zip(parametrization.names, legs.vector(state.legs).tolist(), strict=True))
    values |= dict(zip(radii, state.radii.tolist(), strict=True))
    values |= {name: unknown_values[name] for name in unknown}
    units = dict.fromkeys(radii, "m") | dict(zip(problem.named, problem.units, strict=True))
    units |= dict(zip(parametrization.names, parametrization.units, strict=True))
    status: dict[str, ParameterStatus] = dict.fromkeys((*parametrization.names, *radii), "fixed")
    status |= dict.fromkeys(unknown, "estimated")
    status |= dict.fromkeys(held.names, "weak")
    names = tuple(name for name in values if status[name] == "estimated")
    indices = [problem.named.index(name) for name in names]
    estimated, of_files = covariance[np.ix_(indices, indices)], set(problem.calibrated.tolist())
    stated = zip(problem.priors.unknown.tolist(), problem.priors.sigma.tolist(), strict=True)
    prior_sigma = {problem.named[i]: sigma for i, sigma in stated if i in of_files}
    ranked = [i for i, name in enumerate(names) if name not in prior_sigma]
    weak = worst_directions(
        estimated[np.ix_(ranked, ranked)],
        tuple(names[i] for i in ranked),
        named_units(problem, state)[indices][ranked],
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


def _kinematic(
    problem: FitProblem, state: State, held: HeldDirections, kept: Array, named: Array
) -> KinematicUncertainty:
    """Uncertainty of kinematic parameters from covariances of *kept* and *named* unknowns."""
    free, n = problem.free, problem.n_kinematic

    def of_every(covariance: Array) -> Array:
        """Expand to all kinematic parameters, zero for fixed ones."""
        wide = np.zeros((len(free), len(free)))
        wide[np.ix_(free, free)] = covariance[:n, :n]
        return wide

    held_basis = np.zeros((len(held.basis), len(free)))
    held_basis[:, free] = (held.basis * held.unit)[:, :n]
    return KinematicUncertainty(
        problem.legs.parametrization,
        of_every(kept),
        of_every(covariance_of_held(problem, state, held)),
        of_every(named),
        held_basis,
        held.directions,
    )


def _with_rejections(outlines: Outlines, fit: Fit) -> Outlines:
    """Mark the outlines rejected by the fit in the table, with reasons."""
    used, reason, problem = outlines.used.copy(), list(outlines.reason), fit.problem
    rejected = np.flatnonzero(~fit.accepted)
    reasons = rejection_reasons(problem, fit.state, rejected, problem.offsets(fit.state))
    all_outlines = np.ones_like(fit.accepted)
    placed = of_determined_poses(problem.weighted(fit.noise), fit.state, all_outlines)[rejected]
    for row, rejection, has_pose in zip(
        problem.outlines.index[rejected], reasons, placed, strict=True
    ):
        used[row] = False
        reason[row] = rejection if has_pose else Rejection(Reason.FEW_LEGS)
    return replace(outlines, used=used, reason=tuple(reason))


def in_file_order(solution: Solution, order: Order, dataset: Dataset) -> Solution:
    """Reorder a solution from an order of work to that of the files, in which the dataset is.

    B of legs fixed to the platform is then at the point that model files use.
    """
    machine = dataset.machine
    legs, views = inverse(order.legs).tolist(), inverse(order.views).tolist()
    origin = np.asarray(machine.T_platform_Re.inv().translation)
    geometry = with_platform_points([solution.legs[j] for j in legs], machine.frame_legs, origin)
    by_leg = {leg: j for j, leg in enumerate(legs)}
    radii = {(by_leg[leg], part): value for (leg, part), value in solution.radii.items()}
    names_of_legs, frame_legs = machine.leg_names, machine.frame_legs
    parametrization = parametrize(names_of_legs, geometry, frame_legs, twists=True)
    steps = _indices_of(parametrization.names, solution.kinematic.parametrization.names)
    vector = vector_of(parametrization, geometry, geometries(machine)).tolist()
    estimates, values = solution.estimates, dict(zip(parametrization.names, vector, strict=True))
    estimates = replace(estimates, values={**estimates.values, **values})
    of_rows = reorder_measurements(dataset.measurements, order).pose[inverse(order.rows)]
    worked_pose = dict(zip(dataset.measurements.pose.tolist(), of_rows.tolist(), strict=True))
    poses = [worked_pose[pose] for pose in range(dataset.measurements.n_poses)]
    file_pose = {worked: pose for pose, worked in enumerate(poses)}
    readings = solution.quality.redundant_readings
    return replace(
        solution,
        legs=geometry,
        T_camera_Rb=tuple(solution.T_camera_Rb[v] for v in views),
        cameras=tuple(solution.cameras[v] for v in views),
        T_Rb_Re=tuple(solution.T_Rb_Re[p] for p in poses),
        radii=dict(sorted(radii.items())),
        estimates=estimates.in_order(tuple(dataset_parameters(dataset).by_name)),
        kinematic=solution.kinematic.in_order(parametrization),
        sensitivities={what: moved[steps] for what, moved in solution.sensitivities.items()},
        outlines=order.restore(solution.outlines),
        edges=None if solution.edges is None else order.restore(solution.edges),
        quality=replace(
            solution.quality,
            redundant_readings=readings and readings.renumbered(order.legs.tolist(), file_pose),
        ),
    )


def _indices_of(names: Sequence[str], among: tuple[str, ...]) -> IntArray:
    """Return the indices of names in a permutation of them."""
    return np.array([among.index(name) for name in names], dtype=np.intp)
