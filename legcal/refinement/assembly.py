"""Putting the result of a fit together: figures, covariance and the table of outlines."""

import dataclasses

import casadi as ca
import numpy as np

from legcal.geometry.types import Array, BoolArray
from legcal.mechanism.parameters import radius_name
from legcal.observations.outlines import Outlines
from legcal.refinement.covariance import uncertainty
from legcal.refinement.inputs import inputs_of
from legcal.refinement.legs import FittedLegs
from legcal.refinement.loss import width_to_k
from legcal.refinement.noise import NoiseModel
from legcal.refinement.normal import Linearization, information, linearize
from legcal.refinement.problem import FitProblem
from legcal.refinement.rounds import Fit, offsets_of
from legcal.refinement.settings import RefinementSettings
from legcal.refinement.shared_errors import shared_errors
from legcal.refinement.solution import Solution
from legcal.refinement.state import State

_SIGNIFICANT = 5.0  # standard deviations of chi2


def assemble_solution(
    problem: FitProblem,
    fit: Fit,
    legs: FittedLegs,
    outlines: Outlines,
    label: str,
    settings: RefinementSettings,
) -> Solution:
    """Put together what was found."""
    names = estimated_names(problem, legs)
    claimed, k = problem.outlines.covariance, width_to_k(settings.loss_width)
    whitening = fit.noise.whitening(claimed, fit.accepted)
    linear = linearize(problem, fit.state, whitening)
    normal = information(problem, linear, k)
    shared = shared_errors(problem, linear, normal, whitening)
    known = uncertainty(problem, normal, names, machine_size(fit.state), shared.covariance)
    offsets = offsets_of(problem, fit.state)
    used = offsets[fit.accepted]
    n_residuals = used.size + len(problem.readings) + len(problem.radius_prior.mean)
    n_residuals += linear.axis_r.size
    parts = problem.layout.parts
    chi2, dof = _chi2(linear), n_residuals - problem.layout.size
    return Solution(
        parameters=fit.state.parameters,
        T_camera_Rb=fit.state.T_camera_Rb,
        T_Rb_Re=fit.state.T_Rb_Re,
        radii=dict(zip(parts, fit.state.radii.tolist(), strict=True)),
        names=(*names, *(radius_name(legs.names[leg], part) for leg, part in parts)),
        covariance=known.covariance,
        sigma=np.sqrt(np.diagonal(known.covariance)),
        weak=known.weak,
        cost=comparable_cost(problem, fit.state, settings),
        chi2=chi2,
        dof=dof,
        rms_px=float(np.sqrt(np.mean(used**2))) if used.size else None,
        rms_axes=float(np.sqrt(np.mean(linear.axis_r**2))) if linear.axis_r.size else None,
        noise=fit.noise,
        shared_bias_px=shared.bias_px,
        shared_tilt_px=shared.tilt_px,
        outlines=_with_rejections(outlines, problem, fit.accepted, offsets),
        start=label,
        iterations=fit.iterations,
        notes=_misfit_of_axes(chi2, dof) if len(problem.axes) else (),
    )


def machine_size(state: State) -> float:
    """Return the largest joint coordinate [m]."""
    return float(max(np.abs(state.base_joints).max(), np.abs(state.platform_joints).max()))


def _chi2(linear: Linearization) -> float:
    parts = (linear.outline_r, linear.encoder_r, linear.prior_r, linear.axis_r)
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


def comparable_cost(problem: FitProblem, state: State, settings: RefinementSettings) -> float:
    """Return the robust cost of all observations with their claimed covariances."""
    whitening = NoiseModel().whitening(problem.outlines.covariance)
    inputs = inputs_of(problem, state, whitening, width_to_k(settings.loss_width))
    zero = ca.DM.zeros(problem.layout.size)
    return float(problem.cost(zero, *[np.asfortranarray(part.T) for part in inputs]))


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


def estimated_names(problem: FitProblem, legs: FittedLegs) -> tuple[str, ...]:
    """Return the names of the kinematic parameters that are unknowns of the fit."""
    is_free = problem.layout.offset < problem.layout.size
    joints = legs.parameter_names[: -legs.n_legs]
    offsets = legs.parameter_names[-legs.n_legs :]
    return (*joints, *(name for name, free in zip(offsets, is_free, strict=True) if free))
