"""How well a fit foretells images that it has not seen: in pixels, and at the platform.

In pixels: where the calibrated model, its readings and its cameras put the outlines, against where
they are. At the platform: its pose by the readings, against its pose by what the image shows alone.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import RigidTransform

from legcal.errors import NotIdentifiable, NotVisible
from legcal.geometry.types import Array, IntArray
from legcal.mechanism.platform import pose_differences
from legcal.observations.measurements import Measurements
from legcal.observations.outlines import Outlines
from legcal.refinement.foretold import Posterior
from legcal.refinement.influence import explained_share
from legcal.refinement.linearize import Linearization, linearize
from legcal.refinement.normal import NormalEquations, of_one_kind
from legcal.refinement.pose_by_outlines import poses_by_outlines

_MEDIAN = float(np.sqrt(2.0 * np.log(2.0)))  # of the norm of two unit Gaussians
_SINGULAR = 1e-18  # of the largest eigenvalue of what readings say of a pose


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
        Root mean square of the offsets of the outlines, without the shifts that they share with
        fitted ones [px], and what is expected. None without outlines.
    rms_px_of_view : dict
        The same for each view that has some, by its name.
    displacement, rotation : (n_known,) array
        Distance [m] and angle [rad] between the platform by the readings and by the outlines alone,
        for each pose that its outlines determine.
    expected_displacement, expected_rotation : (n_known,) array
        One standard deviation of these, by the noise of outlines and readings and the covariance
        of all that the fit knows [m, rad].
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


def compare_held_out(
    posterior: Posterior,
    measurements: Measurements,
    outlines: Outlines,
    T_Rb_Re: Sequence[RigidTransform],
    rejection: float,
) -> HeldOut:
    """Compare images that were kept aside with what a fit of others foretells.

    Shifts that the outlines share with those of the fit are taken off. What is expected has the
    noise of the outlines, that of the readings, and the covariance of all that the fit knows.

    Parameters
    ----------
    posterior : Posterior
        The fit.
    measurements : Measurements
        The images that were kept aside.
    outlines : Outlines
        Their outlines; the used ones are compared.
    T_Rb_Re : sequence of RigidTransform
        Their poses by the fit and the readings.
    rejection : float
        Whitened distance beyond which the fit rejects an outline.

    Returns
    -------
    HeldOut

    Raises
    ------
    NotIdentifiable
        If the readings do not determine the poses.
    NotVisible
        If a camera stands inside a leg.
    """
    foretold = posterior.of_images(measurements, outlines, T_Rb_Re)
    problem, state = foretold.problem, foretold.state
    noise = posterior.noise.covariance(problem.outlines.covariance)
    L = np.linalg.cholesky(noise)
    whitening = np.linalg.inv(L)
    linear = linearize(problem, state, whitening)
    _refuse_unseen(linear)
    readings = of_one_kind(problem, state, linear, "readings")
    _refuse_undetermined(readings)
    places, of_fit = problem.couplings.outlines, foretold.covariance
    expected = np.eye(2) + explained_share(places, linear.outlines, readings, of_fit)
    offsets = (L @ linear.outlines.r[..., None])[..., 0]
    norm = _norms(linear.outlines.r, expected)
    limit = rejection * _usual(norm)
    right = norm < limit
    pixels = np.einsum("nij,njk,nik->ni", L, expected, L)
    shown = poses_by_outlines(foretold, whitening, limit)
    known = shown.known.tolist()
    displacement, rotation = pose_differences(
        [shown.T_Rb_Re[k] for k in known], [T_Rb_Re[k] for k in known]
    )
    variance = np.einsum("kii->ki", shown.covariance)
    return HeldOut(
        n_images=measurements.n_rows,
        n_poses=measurements.n_poses,
        outlines=len(problem.outlines),
        wrong=int(np.sum(~right)),
        rms_px=_rms(offsets[right]),
        expected_px=_rms(np.sqrt(pixels[right])),
        rms_px_of_view=_of_views(measurements, problem.outlines.view[right], offsets[right]),
        displacement=displacement,
        rotation=rotation,
        expected_displacement=np.sqrt(variance[:, 3:].sum(axis=1)),
        expected_rotation=np.sqrt(variance[:, :3].sum(axis=1)),
    )


def _refuse_undetermined(readings: NormalEquations) -> None:
    """Raise NotIdentifiable where readings do not determine a pose."""
    value = np.linalg.eigvalsh(readings.V)
    bad = np.flatnonzero(value[:, 0] <= _SINGULAR * value[:, -1])
    if len(bad):
        raise NotIdentifiable(
            "The images that were kept aside could not be compared with what the fit foretells: "
            f"found readings that leave platform pose {bad[0] + 1} of them open, needed readings "
            "that determine every pose; leave out --holdout."
        )


def _refuse_unseen(linear: Linearization) -> None:
    """Raise NotVisible where a camera stands inside a leg."""
    bad = int(np.sum(~np.isfinite(linear.outlines.r).all(axis=1)))
    if bad:
        raise NotVisible(
            "The images that were kept aside could not be compared with what the fit foretells: "
            f"found {bad} outlines of legs that a camera stands inside by their readings, needed "
            "cameras outside the legs; check the readings."
        )


def _norms(r: Array, covariance: Array) -> Array:
    """Return how many standard deviations residuals (n, 2) are off, (n,)."""
    inverse = np.linalg.inv(covariance)
    return np.asarray(np.sqrt(np.einsum("ni,nij,nj->n", r, inverse, r)))


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
