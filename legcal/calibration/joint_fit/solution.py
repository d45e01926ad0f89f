"""The result of the fit of everything."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Literal

import numpy as np
from scipy.spatial.transform import RigidTransform

from legcal.calibration.joint_fit.gammas import EstimatedGamma
from legcal.calibration.joint_fit.held_out import Posterior
from legcal.calibration.joint_fit.normal import WeakDirection
from legcal.data import Outlines
from legcal.estimation import NoiseModel
from legcal.geometry import Array
from legcal.machine import KinematicParameters, LegGeometry, LegKind, Parametrization
from legcal.vision import Camera

Status = Literal["estimated", "fixed", "weak"]


@dataclass(frozen=True)
class Sensitivity:
    """What a mistake in what was taken as known would do to the kinematic parameters.

    Attributes
    ----------
    what : str
        The mistake, in words.
    steps : (p, c) array
        Steps of all kinematic parameters from the fitted legs [m, rad], one for each of c
        independent parts of the mistake.
    """

    what: str
    steps: Array


@dataclass(frozen=True, eq=False)
class Solution:
    """A converged fit of everything.

    Attributes
    ----------
    legs : tuple of LegGeometry
        The legs in R_b and R_e.
    T_camera_Rb : tuple of RigidTransform
        Camera poses, one a view. A view that shows nothing keeps that of the start.
    cameras : tuple of Camera
        The cameras of the views, with the intrinsics that the fit was asked for.
    T_Rb_Re : tuple of RigidTransform
        Platform poses.
    radii : dict
        Radius [m] for each (leg index, part) that was observed.
    parametrization : Parametrization
        All kinematic parameters.
    values : mapping
        Value of every parameter by its name [m, rad, px]: kinematic ones, observed radii, then the
        intrinsics that the fit was asked for and the size of the calibration board. Axes are angles
        from the nominal axis.
    units : mapping
        Their units.
    status : mapping
        ``estimated``; ``fixed`` at its value; or ``weak``: part of a direction that the
        measurements leave open and that does not move the platform, held at nominal along it.
    names : tuple of str
        The estimated parameters, in the order of ``values``.
    covariance : (n, n) array
        Their covariance, with cameras and poses unknown.
    sigma : (n,) array
        Their standard deviations.
    kinematic_covariance : (p, p) array
        Covariance of steps of all kinematic parameters from the fitted legs, as
        :func:`legcal.machine.parameters.moved_legs` and
        :func:`legcal.machine.pose_sensitivity` have them (axes turn about the
        vectors of where they are); zero where they are fixed, and along what is held.
    held_covariance : (p, p) array
        How far these may be off along what is held, if the nominal model is as wrong there as the
        fit found it to be elsewhere; zero where nothing is held.
    value_covariance : (p, p) array
        The first covariance of the values of all kinematic parameters, axes as angles from the
        nominal axis.
    held_basis : (w, p) array
        How these values change along each direction that is held, by a metre: angles count at the
        mean length of the legs. As a set of metres, orthonormal but for what is not kinematic.
    weak : tuple of WeakDirection
        The directions of the estimated parameters known worst, worst first.
    held : tuple of str
        The directions that are held at nominal.
    cost : float
        Robust cost over all observations that came in, rejected ones too, with their claimed
        covariances: comparable between fits of the same data.
    chi2 : float
        Sum of the squared whitened residuals of used outlines, axes, readings and priors.
    dof : int
        Their number, less the unknowns.
    rms_px : float or None
        Root mean square of the offsets of used outlines [px]; None if there are none.
    rms_axes : float or None
        Root mean square of the residuals of measured axes, over their claimed standard
        deviations; None if there are none.
    rms_corners_px : float or None
        Root mean square of the residuals of corners of the calibration board [px]; None without.
    rejected_corners : tuple of (str, int)
        View and number of the corners that were left out, in all images of the view.
    T_Rb_board : RigidTransform or None
        The calibration board in R_b; None if no image shows one.
    noise : NoiseModel
        The estimated errors of outlines; ``noise.bias_px`` is tau.
    gammas : tuple of EstimatedGamma
        Of the cameras whose gamma is not told and whose outlines move with it.
    biases : mapping
        Shifts of outlines that several share, by name [px]: those that the residuals show.
    shared_px : mapping
        Standard deviations of these shifts by what they are, one of
        :data:`legcal.calibration.joint_fit.biases.KINDS` [px]; empty where residuals show none.
    sensitivities : tuple of Sensitivity
        What mistakes in cameras and radii would do.
    outlines : Outlines
        The table that came in, with what the fit rejected and why.
    start : str
        Label of the start that led here.
    iterations : int
        Steps of the solver, all rounds.
    posterior : Posterior
        What it says of images that it has not seen; always in the order of the measurements that
        were fitted.
    notes : tuple of str
        What else a reader should know, one sentence each.
    focal_doubt : float
        By what part of itself a focal length is wrong, if measurements contradict one; 0 otherwise.
    doubtful_cameras : tuple of str
        Views that stand for the cameras whose focal lengths the measurements contradict.
    """

    legs: tuple[LegGeometry, ...]
    T_camera_Rb: tuple[RigidTransform, ...]
    cameras: tuple[Camera, ...]
    T_Rb_Re: tuple[RigidTransform, ...]
    radii: dict[tuple[int, str], float]
    parametrization: Parametrization
    values: Mapping[str, float]
    units: Mapping[str, str]
    status: Mapping[str, Status]
    names: tuple[str, ...]
    covariance: Array
    sigma: Array
    kinematic_covariance: Array
    held_covariance: Array
    value_covariance: Array
    held_basis: Array
    weak: tuple[WeakDirection, ...]
    held: tuple[str, ...]
    cost: float
    chi2: float
    dof: int
    rms_px: float | None
    rms_axes: float | None
    rms_corners_px: float | None
    rejected_corners: tuple[tuple[str, int], ...]
    T_Rb_board: RigidTransform | None
    noise: NoiseModel
    gammas: tuple[EstimatedGamma, ...]
    biases: Mapping[str, float]
    shared_px: Mapping[str, float]
    sensitivities: tuple[Sensitivity, ...]
    outlines: Outlines
    start: str
    iterations: int
    posterior: Posterior
    notes: tuple[str, ...] = ()
    focal_doubt: float = 0.0
    doubtful_cameras: tuple[str, ...] = ()

    @property
    def parameters(self) -> KinematicParameters:
        """Joint centres, and offsets or constant lengths; NaN for passive legs [m]."""
        return joints_of(self.legs)


def joints_of(legs: tuple[LegGeometry, ...]) -> KinematicParameters:
    """Return joint centres, and offsets or constant lengths; NaN for passive legs [m]."""
    lengths = [np.nan if leg.kind is LegKind.PASSIVE else leg.q0 for leg in legs]
    return KinematicParameters(
        np.array([leg.A for leg in legs]),
        np.array([leg.B for leg in legs]),
        np.array(lengths),
    )
