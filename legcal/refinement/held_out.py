"""How well a fit foretells images that it has not seen: in pixels, and at the platform.

In pixels: where the calibrated model, its readings and its cameras put the outlines, against where
they are. At the platform: its pose by the readings, against its pose by what the image shows alone.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import RigidTransform

from legcal.geometry.types import Array, IntArray
from legcal.mechanism.parametrization import Parametrization
from legcal.mechanism.platform import pose_differences
from legcal.mechanism.sensitivity import pose_sensitivity
from legcal.observations.measurements import Measurements
from legcal.observations.outlines import Outlines
from legcal.observations.sets import choose_outlines
from legcal.refinement.foretold import FittedModel, ForetoldOutlines, arrays
from legcal.refinement.pose_by_outlines import poses_by_outlines

_MEDIAN = float(np.sqrt(2.0 * np.log(2.0)))  # of the norm of two unit Gaussians


@dataclass(frozen=True, eq=False)
class HeldOut:
    """What images that were kept aside say of a fit.

    Attributes
    ----------
    n_images, n_poses : int
        How many were kept aside.
    outlines, wrong : int
        Outlines in them, and how many are far from where they should be, compared with the others
        and with their noise; they are left out of what follows.
    rms_px, expected_px : float or None
        Root mean square of the offsets of the outlines [px], and what the noise of the fitted
        ones lets expect. None without outlines.
    rms_px_of_view : dict
        The same for each view that has some, by its name.
    displacement, rotation : (n_known,) array
        Distance [m] and angle [rad] between the platform by the readings and by the outlines alone,
        for each pose that its outlines determine.
    expected_displacement, expected_rotation : (n_known,) array
        One standard deviation of these, by the noise of the outlines and the covariance of the
        parameters [m, rad].
    """

    n_images: int
    n_poses: int
    outlines: int
    wrong: int
    rms_px: float | None
    expected_px: float | None
    rms_px_of_view: dict[str, float]
    displacement: Array
    rotation: Array
    expected_displacement: Array
    expected_rotation: Array

    @property
    def at_platform(self) -> PlatformPair | None:
        """What was found at the platform and what was expected there; None without any pose.

        Poses count by how well their outlines determine them.
        """
        if len(self.displacement) == 0:
            return None
        return PlatformPair(
            *_weighted_rms(self.displacement, self.expected_displacement),
            *_weighted_rms(self.rotation, self.expected_rotation),
        )


@dataclass(frozen=True)
class PlatformPair:
    """Root mean squares over poses: found, and expected as one standard deviation.

    Attributes
    ----------
    displacement, expected_displacement : float
        [m]
    rotation, expected_rotation : float
        [rad]
    """

    displacement: float
    expected_displacement: float
    rotation: float
    expected_rotation: float


@dataclass(frozen=True, eq=False)
class Expected:
    """What a fit says of its own errors.

    Attributes
    ----------
    parametrization : Parametrization
        The kinematic parameters.
    parameters : (p, p) array
        Their covariance.
    outlines : (n, 2, 2) array
        Covariance of the offsets of the outlines at both ends [px^2].
    rejection : float
        Whitened distance beyond which the fit rejects an outline.
    """

    parametrization: Parametrization
    parameters: Array
    outlines: Array
    rejection: float


def compare_held_out(
    model: FittedModel,
    measurements: Measurements,
    outlines: Outlines,
    T_Rb_Re: Sequence[RigidTransform],
    expected: Expected,
) -> HeldOut:
    """Compare images that were kept aside with what a fit of others foretells.

    Parameters
    ----------
    model : FittedModel
        The fit.
    measurements : Measurements
        The images that were kept aside.
    outlines : Outlines
        Their outlines; the used ones are compared.
    T_Rb_Re : sequence of RigidTransform
        Their poses by the model and the readings.
    expected : Expected
        What the fit says of its errors; its ``outlines`` are those of the table that came in.

    Returns
    -------
    HeldOut

    Raises
    ------
    NotVisible
        If a camera stands inside a leg.
    """
    used = choose_outlines(outlines, outlines.used)
    covariance = expected.outlines[outlines.used]
    whitening = np.linalg.inv(np.linalg.cholesky(covariance))
    foretold = ForetoldOutlines(model, measurements, used)
    R, t = arrays(T_Rb_Re)
    offsets = foretold.offsets(R, t)
    norm = np.linalg.norm((whitening @ offsets[..., None])[..., 0], axis=1)
    limit = expected.rejection * _usual(norm)
    right = norm < limit
    view = measurements.view[used.row]
    shown = poses_by_outlines(model, foretold, whitening, T_Rb_Re, limit)
    known = np.flatnonzero(shown.known).tolist()
    displacement, rotation = pose_differences(
        [shown.T_Rb_Re[k] for k in known], [T_Rb_Re[k] for k in known]
    )
    J = pose_sensitivity(model.legs, expected.parametrization, model.frame_legs, R[known], t[known])
    both = shown.covariance[known] + J @ expected.parameters @ J.swapaxes(1, 2)
    variance = np.einsum("kii->ki", both)
    return HeldOut(
        n_images=measurements.n_rows,
        n_poses=measurements.n_poses,
        outlines=len(used),
        wrong=int(np.sum(~right)),
        rms_px=_rms(offsets[right]),
        expected_px=_rms(np.sqrt(np.einsum("nii->ni", covariance[right]))),
        rms_px_of_view=_of_views(measurements, view[right], offsets[right]),
        displacement=displacement,
        rotation=rotation,
        expected_displacement=np.sqrt(variance[:, 3:].sum(axis=1)),
        expected_rotation=np.sqrt(variance[:, :3].sum(axis=1)),
    )


def _usual(norm: Array) -> float:
    """Return how far off outlines usually are, in sigmas of their noise, at least one."""
    return max(float(np.median(norm)) / _MEDIAN, 1.0) if len(norm) else 1.0


def _of_views(measurements: Measurements, view: IntArray, offsets: Array) -> dict[str, float]:
    """Return the root mean square of offsets for each view that has some [px]."""
    return {
        measurements.views[v].name: float(np.sqrt(np.mean(offsets[view == v] ** 2)))
        for v in np.unique(view).tolist()
    }


def _rms(offsets: Array) -> float | None:
    """Return the root mean square of offsets, None without any."""
    return float(np.sqrt(np.mean(offsets**2))) if len(offsets) else None


def _weighted_rms(found: Array, expected: Array) -> tuple[float, float]:
    """Return the root mean squares of both, weighted by what was expected."""
    weight = expected**-2
    total = float(np.sum(weight))
    return float(np.sqrt(np.sum(weight * found**2) / total)), float(np.sqrt(len(found) / total))
