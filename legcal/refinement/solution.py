"""The result of the fit of everything."""

from __future__ import annotations

from dataclasses import dataclass

from scipy.spatial.transform import RigidTransform

from legcal.geometry.types import Array
from legcal.mechanism.parameters import KinematicParameters
from legcal.observations.outlines import Outlines
from legcal.refinement.covariance import WeakDirection
from legcal.refinement.noise import NoiseModel


@dataclass(frozen=True, eq=False)
class Solution:
    """A converged fit of everything.

    Attributes
    ----------
    parameters : KinematicParameters
        Joints in R_b and R_e, and offsets [m].
    T_camera_Rb : tuple of RigidTransform
        Camera poses, one a view. A view that shows nothing keeps that of the start.
    T_Rb_Re : tuple of RigidTransform
        Platform poses.
    radii : dict
        Radius [m] for each (leg index, part) that was observed.
    names : tuple of str
        Names of the estimated parameters: the kinematic ones in the order of
        ``parameters.to_vector``, then the radii in the order of ``radii``.
    covariance : (n, n) array
        Their covariance [m^2], with cameras and poses unknown.
    sigma : (n,) array
        Their standard deviations [m].
    weak : tuple of WeakDirection
        The directions known worst, worst first.
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
    noise : NoiseModel
        The estimated errors of outlines; ``noise.bias_px`` is tau.
    shared_bias_px, shared_tilt_px : float
        Standard deviations [px] of errors that all images of one edge of a leg in a view share;
        0 where the residuals do not show them. They are part of ``covariance``.
    outlines : Outlines
        The table that came in, with what the fit rejected and why.
    start : str
        Label of the start that led here.
    iterations : int
        Of IPOPT, all rounds.
    notes : tuple of str
        What else a reader should know, one sentence each.
    """

    parameters: KinematicParameters
    T_camera_Rb: tuple[RigidTransform, ...]
    T_Rb_Re: tuple[RigidTransform, ...]
    radii: dict[tuple[int, str], float]
    names: tuple[str, ...]
    covariance: Array
    sigma: Array
    weak: tuple[WeakDirection, ...]
    cost: float
    chi2: float
    dof: int
    rms_px: float | None
    rms_axes: float | None
    noise: NoiseModel
    shared_bias_px: float
    shared_tilt_px: float
    outlines: Outlines
    start: str
    iterations: int
    notes: tuple[str, ...] = ()

    @property
    def kinematic_covariance(self) -> Array:
        """Covariance of the kinematic parameters alone [m^2]."""
        n = len(self.names) - len(self.radii)
        return self.covariance[:n, :n]
