"""A solution found in the order of work, in the order of the dataset's files."""

from __future__ import annotations

import dataclasses
from dataclasses import replace

import numpy as np

from legcal.calibration.joint_fit.biases import GAMMA_SUFFIX
from legcal.calibration.joint_fit.contradictions import (
    focal_lengths,
    refuse_contradicted_priors,
    rejected_notes,
    scale_notes,
    sensitivities,
)
from legcal.calibration.joint_fit.determinacy import Held, held_spread, named_units
from legcal.calibration.joint_fit.gammas import estimated_gammas
from legcal.calibration.joint_fit.held_out import Posterior
from legcal.calibration.joint_fit.normal import information, named_covariance, worst_directions
from legcal.calibration.joint_fit.parameters import known_parameters
from legcal.calibration.joint_fit.problem import (
    FitProblem,
    Linearization,
    linearize,
    named_values,
    offsets_of,
)
from legcal.calibration.joint_fit.rounds import Fit, corner_notes, rejection_reasons
from legcal.calibration.joint_fit.solution import Solution, Status
from legcal.calibration.joint_fit.solver import robust_cost
from legcal.calibration.joint_fit.state import RefinementSettings, State
from legcal.data import Dataset, Order, Outlines, inverse, reorder_measurements
from legcal.estimation import NoiseModel, width_to_k
from legcal.geometry import Array, BoolArray, IntArray
from legcal.machine import footed, parametrize, radius_name

_SIGNIFICANT = 5.0  # standard deviations of chi2


def assemble_solution(
    problem: FitProblem,
    fit: Fit,
    held: Held,
    outlines: Outlines,
    label: str,
    settings: RefinementSettings,
) -> Solution:
    """Put together what was found.

    Raises
    ------
    NotIdentifiable
        If the outlines that are left do not determine the parameters.
    DidNotConverge
        If a stated prior contradicts the measurements.
    """
    state, k = fit.state, width_to_k(settings.loss_width)
    linear = fit.minimum.linear
    whitening = fit.noise.whitening(problem.outlines.covariance, fit.accepted)
    normal = information(problem, state, linear, k)
    kept = normal.kept_covariance()
    covariance = named_covariance(problem, state, kept)
    refuse_contradicted_priors(problem, state, normal)
    values, status = _values(problem, state), _status(problem, held)
    names = tuple(name for name in values if status[name] == "estimated")
    where = [problem.named.index(name) for name in names]
    estimated = covariance[np.ix_(where, where)]
    offsets = offsets_of(problem, state)
    used = offsets[fit.accepted]
    n_residuals = used.size + len(problem.readings) + len(problem.priors)
    n_residuals += linear.axes.r.size + linear.corners.r.size
    chi2, dof = _chi2(linear), n_residuals - problem.n_unknowns + len(held.basis)
    units = dict(zip(problem.named, problem.named_units, strict=True))
    units |= dict(
        zip(problem.legs.parametrization.names, problem.legs.parametrization.units, strict=True)
    )
    focal = focal_lengths(problem, state, linear, whitening)
    doubtful = [f for f in focal if f.is_doubtful]
    gammas = estimated_gammas(problem, state, kept, outlines)
    return Solution(
        legs=state.legs,
        T_camera_Rb=state.T_camera_Rb,
        cameras=state.cameras,
        T_Rb_Re=state.T_Rb_Re,
        radii=dict(zip(problem.layout.parts, state.radii.tolist(), strict=True)),
        parametrization=problem.legs.parametrization,
        values=values,
        units={name: units.get(name, "m") for name in values},
        status=status,
        names=names,
        covariance=estimated,
        sigma=np.sqrt(np.diagonal(estimated)),
        kinematic_covariance=_of_kinematic(problem, kept),
        held_covariance=_of_kinematic(problem, held_spread(problem, state, held)),
        value_covariance=_of_kinematic(problem, covariance),
        held_basis=_held_values(problem, held),
        weak=worst_directions(estimated, names, named_units(problem, state)[where]),
        held=held.directions,
        cost=comparable_cost(problem, state, settings),
        chi2=chi2,
        dof=dof,
        rms_px=_rms(used),
        rms_axes=_rms(linear.axes.r),
        rejected_corners=tuple(
            (problem.outlines.views[view], corner) for view, corner in problem.rejected_corners
        ),
        T_Rb_board=state.T_Rb_board if len(problem.board) else None,
        rms_corners_px=_rms(linear.corners.r * problem.board.sigma[:, None]),
        noise=fit.noise,
        gammas=gammas,
        biases=_biases(problem, state),
        shared_px=fit.shifts.sizes,
        sensitivities=sensitivities(problem, state, linear, normal, whitening, k),
        outlines=_with_rejections(outlines, problem, state, fit.accepted, offsets),
        start=label,
        iterations=fit.iterations,
        posterior=Posterior(problem, state, fit.shifts, fit.noise, kept),
        focal_doubt=max((abs(f.change) for f in doubtful), default=0.0),
        doubtful_cameras=tuple(f.view for f in doubtful),
        notes=(
            *fit.notes,
            *rejected_notes(problem, fit.accepted),
            *corner_notes(problem),
            *map(str, gammas),
            *scale_notes(problem, state, settings),
            *(_misfit_of_axes(chi2, dof) if len(problem.axes) else ()),
            *(str(f) for f in doubtful),
        ),
    )


def comparable_cost(problem: FitProblem, state: State, settings: RefinementSettings) -> float:
    """Return the robust cost of all observations with their claimed covariances."""
    whitening = NoiseModel().whitening(problem.outlines.covariance)
    return robust_cost(linearize(problem, state, whitening), width_to_k(settings.loss_width))


def _values(problem: FitProblem, state: State) -> dict[str, float]:
    """Return the values of all parameters: kinematic, radii, and intrinsics that are unknown."""
    legs, layout = problem.legs, problem.layout
    names = (radius_name(legs.names[leg], part) for leg, part in layout.parts)
    values = dict(
        zip(legs.parametrization.names, legs.vector(state.legs).tolist(), strict=True)
    ) | dict(zip(names, state.radii.tolist(), strict=True))
    named = zip(problem.named, named_values(state, layout, legs).tolist(), strict=True)
    biases = {problem.named[i] for i in layout.bias}
    return values | {name: value for name, value in named if name not in biases}


def _status(problem: FitProblem, held: Held) -> dict[str, Status]:
    """Return the status of every parameter."""
    legs = problem.legs
    names = [radius_name(legs.names[leg], part) for leg, part in problem.layout.parts]
    biases = {problem.named[i] for i in problem.layout.bias}
    status: dict[str, Status] = dict.fromkeys((*legs.parametrization.names, *names), "fixed")
    status |= {name: "estimated" for name in problem.named if name not in biases}
    return status | dict.fromkeys(held.names, "weak")


def _of_kinematic(problem: FitProblem, covariance: Array) -> Array:
    """Return of the covariance of unknowns that of all kinematic parameters, fixed ones too."""
    position = problem.layout.kinematic
    free = position < problem.layout.size
    wide = np.zeros((len(position), len(position)))
    n = problem.layout.n_kinematic
    wide[np.ix_(free, free)] = covariance[:n, :n]
    return wide


def _held_values(problem: FitProblem, held: Held) -> Array:
    """Return how the values of all kinematic parameters change along what is held (w, p)."""
    position, n = problem.layout.kinematic, problem.layout.n_kinematic
    wide = np.zeros((len(held.basis), len(position)))
    wide[:, position < problem.layout.size] = (held.basis * held.unit)[:, :n]
    return wide


def _biases(problem: FitProblem, state: State) -> dict[str, float]:
    names = [problem.named[i] for i in problem.layout.bias]
    biases = zip(names, state.biases.tolist(), strict=True)
    return {name: value for name, value in biases if not name.endswith(GAMMA_SUFFIX)}


def _rms(values: Array) -> float | None:
    """Return the root mean square of values, None of none."""
    return float(np.sqrt(np.mean(values**2))) if values.size else None


def _chi2(linear: Linearization) -> float:
    parts = (
        linear.outlines.r,
        linear.readings.r,
        linear.prior_r,
        linear.axes.r,
        linear.corners.r,
    )
    return float(sum(np.sum(part**2) for part in parts))


def _misfit_of_axes(chi2: float, dof: int) -> tuple[str, ...]:
    """Return a note where axes, whose errors are not estimated, are worse than they claim."""
    if chi2 <= dof + _SIGNIFICANT * np.sqrt(2.0 * dof):
        return ()
    return (
        f"The axes are worse than their standard deviations claim: chi2 is {chi2:.0f} for {dof} "
        "degrees of freedom, so that the uncertainty of the result is about "
        f"{np.sqrt(chi2 / max(dof, 1)):.1f} times what is stated; correct them.",
    )


def _with_rejections(
    outlines: Outlines, problem: FitProblem, state: State, accepted: BoolArray, offsets: Array
) -> Outlines:
    """Return the table with what the fit rejected, and why."""
    used, reason = outlines.used.copy(), list(outlines.reason)
    rejected = np.flatnonzero(~accepted)
    words = rejection_reasons(problem, state, rejected, offsets)
    for row, why in zip(problem.outlines.index[rejected].tolist(), words, strict=True):
        used[row] = False
        reason[row] = why
    return dataclasses.replace(outlines, used=used, reason=tuple(reason))


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
    mechanism, measurements = dataset.mechanism, dataset.measurements
    legs, views = inverse(order.legs).tolist(), inverse(order.views).tolist()
    origin = np.asarray(mechanism.T_platform_Re.inv().translation)
    geometry = footed([solution.legs[j] for j in legs], origin)
    by_leg = {leg: j for j, leg in enumerate(legs)}
    radii = {(by_leg[leg], part): value for (leg, part), value in solution.radii.items()}
    with_board = dataset.board is not None
    known = known_parameters(mechanism, measurements.views, with_board=with_board).by_name
    ordered = [name for name in known if name in solution.values]
    names = tuple(name for name in ordered if name in solution.names)
    names_of_legs, frame_legs = mechanism.leg_names, mechanism.frame_legs
    parametrization = parametrize(names_of_legs, geometry, frame_legs, twists=True)
    where = _places(names, solution.names)
    steps = _places(parametrization.names, solution.parametrization.names)
    return replace(
        solution,
        legs=geometry,
        T_camera_Rb=tuple(solution.T_camera_Rb[v] for v in views),
        cameras=tuple(solution.cameras[v] for v in views),
        T_Rb_Re=tuple(solution.T_Rb_Re[p] for p in _poses(order, dataset).tolist()),
        radii=dict(sorted(radii.items())),
        parametrization=parametrization,
        values={name: solution.values[name] for name in ordered},
        units={name: solution.units[name] for name in ordered},
        status={name: solution.status[name] for name in ordered},
        names=names,
        covariance=solution.covariance[np.ix_(where, where)],
        sigma=solution.sigma[where],
        kinematic_covariance=solution.kinematic_covariance[np.ix_(steps, steps)],
        held_covariance=solution.held_covariance[np.ix_(steps, steps)],
        value_covariance=solution.value_covariance[np.ix_(steps, steps)],
        held_basis=solution.held_basis[:, steps],
        sensitivities=tuple(replace(s, steps=s.steps[steps]) for s in solution.sensitivities),
        outlines=order.restore(solution.outlines),
    )


def _places(names: tuple[str, ...], among: tuple[str, ...]) -> IntArray:
    """Return where names stand among the same ones in another order."""
    return np.array([among.index(name) for name in names], dtype=np.intp)


def _poses(order: Order, dataset: Dataset) -> IntArray:
    """Return for every pose of the dataset its number in the order of work."""
    pose = dataset.measurements.pose
    worked = reorder_measurements(dataset.measurements, order).pose[inverse(order.rows)]
    found = np.empty(dataset.measurements.n_poses, dtype=np.intp)
    found[pose] = worked
    return found
