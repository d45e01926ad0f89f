"""The Cramer-Rao bound: what the measurements hold, whatever is made of them."""

from __future__ import annotations

from dataclasses import replace

from legcal.calibration.joint_fit.constraints import Start
from legcal.calibration.joint_fit.determinacy import open_directions
from legcal.calibration.joint_fit.normal import information, named_covariance
from legcal.calibration.joint_fit.problem import FitProblem, linearize
from legcal.data import LegAxes, Measurements, join_axes
from legcal.estimation import NoiseModel
from legcal.geometry import Array


def bound(problem: FitProblem, truth: Start, radii: Array | None = None) -> Array:
    """Return the inverse of the information of a fit's data at a state.

    Parameters
    ----------
    problem : FitProblem
        Built of data whose covariances count; of outlines and axes also the lines, as the place
        where these are written: exact ones for the bound to the letter.
    truth : Start
        The true legs, cameras and poses.
    radii : (n_radii,) array, optional
        The true radii [m]; nominal without it.

    Returns
    -------
    (n, n) array
        Covariance of ``problem.named`` with everything else unknown, priors used.

    Raises
    ------
    NotIdentifiable
        If the data do not determine what moves the platform.
    """
    state = problem.begin(truth)
    state = state if radii is None else replace(state, radii=radii)
    whitening = NoiseModel().whitening(problem.outlines.covariance)
    normal = information(problem, state, linearize(problem, state, whitening), 0.0)
    open_directions(problem, state, normal)
    return named_covariance(problem, state, normal.kept_covariance())


def average_images(axes: LegAxes, measurements: Measurements) -> LegAxes:
    """Return one axis for each leg at each pose in each view, weighted by the covariances.

    Nothing is lost by it, and a fit is smaller by the number of images.

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
