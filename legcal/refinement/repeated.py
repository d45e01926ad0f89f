"""A fit of measured axes that is built once and solved for many data of the same structure.

Building takes longer than solving, and depends only on which image shows which legs and on
which images share a pose. A Monte Carlo study builds once (in each process) and goes on::

    fit = build_axes_fit(legs, measurements, axes)           # any session of this structure
    solution = solve_again(fit, measurements, axes, start)   # for each session
    known = bound(fit, measurements, axes, truth)            # Cramer-Rao, at the true state

``average_images(axes, measurements)`` first makes one axis of all images of a leg at one
pose in one view; nothing is lost by it, and the fit is smaller by the number of images. All of
build, solve and bound must then be given the averaged axes. ``start`` is
``start_from(nominal, measurements, legs, T_camera_Rb, T_Rb_Re, "nominal")``, ``truth`` a
``Start`` of the true parameters, cameras and poses. ``known.covariance`` and
``solution.kinematic_covariance`` are in the order of ``solution.names`` [m^2].
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from legcal.errors import UsageError
from legcal.geometry.types import Array
from legcal.observations.leg_axes import LegAxes, join_axes
from legcal.observations.measurements import Measurements
from legcal.observations.sets import no_outlines
from legcal.refinement.assembly import estimated_names, machine_size
from legcal.refinement.covariance import Uncertainty, uncertainty
from legcal.refinement.legs import FittedLegs
from legcal.refinement.normal import information, linearize
from legcal.refinement.observed import Readings, readings
from legcal.refinement.observed_axes import ObservedAxes, observed_axes
from legcal.refinement.problem import FitProblem
from legcal.refinement.refine import build_fit, solve_fit
from legcal.refinement.settings import DEFAULT_SETTINGS, RefinementSettings
from legcal.refinement.solution import Solution
from legcal.refinement.start import Start


@dataclass(frozen=True, eq=False)
class AxesFit:
    """A fit of axes and readings, built and ready for data.

    Attributes
    ----------
    legs : FittedLegs
    problem : FitProblem
        With the data that it was built of.
    settings : RefinementSettings
    """

    legs: FittedLegs
    problem: FitProblem
    settings: RefinementSettings


def average_images(axes: LegAxes, measurements: Measurements) -> LegAxes:
    """Return one axis for each leg at each pose in each view, weighted by the covariances.

    Parameters
    ----------
    axes : LegAxes
        Axes in single images.
    measurements : Measurements
        Their rows.

    Returns
    -------
    LegAxes
        By view, pose and leg; ``row`` is the first image of each.
    """
    view, pose = measurements.view[axes.row], measurements.pose[axes.row]
    return join_axes(axes, view * measurements.n_poses + pose)


def build_axes_fit(
    legs: FittedLegs,
    measurements: Measurements,
    axes: LegAxes,
    settings: RefinementSettings = DEFAULT_SETTINGS,
) -> AxesFit:
    """Build a fit of axes and readings.

    Parameters
    ----------
    legs : FittedLegs
        The mechanism.
    measurements : Measurements
        Views, poses and readings [m].
    axes : LegAxes
        Measured axes with their covariances.
    settings : RefinementSettings
        Choices of the fit.

    Returns
    -------
    AxesFit

    Raises
    ------
    NotIdentifiable
        If there are fewer equations than unknowns.
    DatasetError
        If an axis cannot be used.
    """
    problem = build_fit(legs, measurements, no_outlines(), settings, axes=axes)
    return AxesFit(legs, problem, settings)


def solve_again(fit: AxesFit, measurements: Measurements, axes: LegAxes, start: Start) -> Solution:
    """Solve a built fit for other data: the same images, legs and poses, other numbers.

    Parameters
    ----------
    fit : AxesFit
        From :func:`build_axes_fit`.
    measurements : Measurements
        Readings [m].
    axes : LegAxes
        Measured axes.
    start : Start
        Starting values.

    Returns
    -------
    Solution
        The same, to rounding, as that of :func:`legcal.refinement.refine.refine`.

    Raises
    ------
    UsageError
        If the data have another structure than those that the fit was built of.
    NotIdentifiable, DidNotConverge, DatasetError
        As :func:`legcal.refinement.refine.refine`.
    """
    problem = _with_data(fit, measurements, axes)
    return solve_fit(problem, fit.legs, no_outlines(), start, fit.settings)


def bound(fit: AxesFit, measurements: Measurements, axes: LegAxes, state: Start) -> Uncertainty:
    """Return the Cramer-Rao bound: the inverse of the information that the data hold at a state.

    Parameters
    ----------
    fit : AxesFit
        From :func:`build_axes_fit`.
    measurements : Measurements
        Their ``sigma_q`` counts; the readings do not.
    axes : LegAxes
        Their covariances count, and lines only as the place where these are written: exact
        ones for the bound to the letter.
    state : Start
        The true parameters, cameras and poses.

    Returns
    -------
    Uncertainty
        Covariance of the kinematic parameters [m^2] with everything else unknown.

    Raises
    ------
    UsageError
        If the data have another structure than those that the fit was built of.
    NotIdentifiable
        If the data do not determine the parameters.
    """
    problem = _with_data(fit, measurements, axes)
    at = state.state(problem.radius_prior.mean)
    linear = linearize(problem, at, np.zeros((0, 2, 2)))
    names = estimated_names(problem, fit.legs)
    return uncertainty(problem, information(problem, linear, 0.0), names, machine_size(at))


def _with_data(fit: AxesFit, measurements: Measurements, axes: LegAxes) -> FitProblem:
    """Return the problem with other data."""
    old_axes, old_readings = fit.problem.axes, fit.problem.readings
    new_axes = observed_axes(axes, measurements, fit.legs)
    new_readings = readings(measurements, fit.legs)
    same = all(
        np.array_equal(old, new)
        for old, new in zip(
            _structure(old_axes, old_readings), _structure(new_axes, new_readings), strict=True
        )
    )
    if not same:
        raise UsageError(
            "A fit could not be solved again: found axes or readings of other images, legs or "
            "poses than those that it was built of, needed the same; build another one for them."
        )
    return replace(fit.problem, axes=new_axes, readings=new_readings)


def _structure(axes: ObservedAxes, encoders: Readings) -> tuple[Array, ...]:
    """Return what a problem's structure depends on."""
    return (
        np.column_stack([axes.leg, axes.view, axes.pose]),
        np.column_stack([encoders.leg, encoders.pose]),
    )
