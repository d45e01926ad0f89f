"""How well a fit foretells images that it has not seen: in pixels, and at the platform.

In pixels: where the calibrated model, its readings and its cameras put the outlines, against where
they are. At the platform: its pose by the readings, against its pose by what the image shows alone.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import RigidTransform

from legcal.calibration.joint_fit.biases import SharedShifts, possible_shifts
from legcal.calibration.joint_fit.constraints import on_constraints
from legcal.calibration.joint_fit.influence import explained_share
from legcal.calibration.joint_fit.normal import NormalEquations, of_one_kind
from legcal.calibration.joint_fit.observations import observed_outlines, of_parts, seen_by
from legcal.calibration.joint_fit.problem import (
    FitProblem,
    Linearization,
    linearize,
    offsets_of,
    with_measurements,
)
from legcal.calibration.joint_fit.state import State
from legcal.data import Measurements, Outlines
from legcal.errors import NotIdentifiable, NotVisible
from legcal.estimation import NoiseModel
from legcal.geometry import Array, BoolArray, IntArray, components, turned
from legcal.machine import pose_differences


@dataclass(frozen=True, eq=False)
class Foretold:
    """Images that a fit has not seen, with all that it knows of them.

    Attributes
    ----------
    problem : FitProblem
        Their outlines and readings; its unknowns are those of the fit, with the shifts that these
        outlines share.
    state : State
        Where the fit ended, at the poses of these images.
    covariance : (n_kept, n_kept) array
        What the fit says of all unknowns but poses; shifts that it has not met have their prior.
    """

    problem: FitProblem
    state: State
    covariance: Array


@dataclass(frozen=True, eq=False)
class Posterior:
    """Where a fit ended, with the covariance of everything that is no pose.

    Attributes
    ----------
    problem : FitProblem
        With the shifts that outlines share.
    state : State
    shifts : SharedShifts
    noise : NoiseModel
    covariance : (n_kept, n_kept) array
        Of parameters, radii, shifts, intrinsics and cameras, all together.
    """

    problem: FitProblem
    state: State
    shifts: SharedShifts
    noise: NoiseModel
    covariance: Array

    def of_images(
        self,
        measurements: Measurements,
        outlines: Outlines,
        T_Rb_Re: Sequence[RigidTransform],
    ) -> Foretold:
        """Return what the fit knows of other images of the same views.

        Parameters
        ----------
        measurements : Measurements
            The images.
        outlines : Outlines
            Their outlines; the used ones enter.
        T_Rb_Re : sequence of RigidTransform
            Their poses.

        Raises
        ------
        DatasetError
            If an outline cannot be used.
        """
        legs, state = self.problem.legs, self.state
        found = of_parts(observed_outlines(outlines, measurements, legs), self.problem.layout.parts)
        found = seen_by(found, state.cameras)
        possible = possible_shifts(found, legs.names, self.problem.outlines)
        shifts = possible.of_sizes(self.shifts.sigma)
        problem = with_measurements(self.problem, measurements, found, shifts)
        known = {self.problem.named[i]: i for i in self.problem.layout.bias.tolist()}
        values = dict(zip(known, state.biases.tolist(), strict=True))
        others = [legs.radii[part] for part in found.parts[len(state.radii) :]]
        R, t = components(T_Rb_Re)
        return Foretold(
            problem,
            replace(
                state,
                radii=np.append(state.radii, others),
                biases=np.array([values.get(name, 0.0) for name in shifts.names]),
                R_pose=R,
                t_pose=t,
            ),
            self._covariance_of(problem, shifts),
        )

    def _covariance_of(self, problem: FitProblem, shifts: SharedShifts) -> Array:
        """Return the covariance of the unknowns of a problem with other shifts."""
        old, new = self.problem, problem.layout
        place = {name: i for i, name in enumerate(old.named)}
        cameras = range(old.layout.n_named, old.layout.n_kept)
        where = np.array([*(place.get(name, -1) for name in problem.named), *cameras], np.intp)
        is_known = where >= 0
        covariance = np.zeros((new.n_kept, new.n_kept))
        covariance[new.bias, new.bias] = shifts.sigmas**2
        kept = where[is_known]
        covariance[np.ix_(is_known, is_known)] = self.covariance[np.ix_(kept, kept)]
        return covariance


_ROBUST_STEPS, _MOST_STEPS = 10, 30
_WIDTH = 3.0  # whitened distance at which an outline starts to count less
_KNOWN = 0.03  # [rad], or of a leg's length: a pose known worse is none
_FURTHEST = 0.1  # [rad], or of a leg's length, in one step
_LOST = 0.3  # the same from where the search began
_SETTLED = 1e-4  # squared length of the last step, in standard deviations
_RANK = 1.0  # [1/rad^2, 1/m^2]: better than a metre or radian


@dataclass(frozen=True, eq=False)
class ShownPoses:
    """Poses by outlines alone.

    Attributes
    ----------
    T_Rb_Re : tuple of RigidTransform
        All poses; those that are not known mean nothing.
    known : (n_known,) array of int
        Which poses the outlines determine.
    covariance : (n_known, 6, 6) array
        Of the motion between each of these by the readings and by the outlines: rotation vector in
        R_b and displacement of R_e [rad^2, rad m, m^2].
    """

    T_Rb_Re: tuple[RigidTransform, ...]
    known: IntArray
    covariance: Array


def poses_by_outlines(foretold: Foretold, whitening: Array, rejection: float) -> ShownPoses:
    """Return the poses that fit the outlines best.

    Outlines count less the farther off they are, then those near enough count alike. Poses that
    still move after that are not known.

    Parameters
    ----------
    foretold : Foretold
        The images at poses nearby, those by the readings.
    whitening : (n, 2, 2) array
        Whitens the noise of the outlines [1/px].
    rejection : float
        Whitened distance beyond which an outline does not count.
    """
    problem, begin = foretold.problem, foretold.state
    linear = linearize(problem, begin, whitening)
    length = _mean_length(begin)
    state, known = begin, _is_known(of_one_kind(problem, begin, linear, "outlines"), length)
    settled = np.zeros(len(known), dtype=np.bool_)
    weight = np.ones(len(problem.outlines))
    for step in range(_ROBUST_STEPS + _MOST_STEPS):
        s = linear.outlines.squared_norms
        if step < _ROBUST_STEPS:
            weight = 1.0 / (1.0 + s / _WIDTH**2)
        elif step == _ROBUST_STEPS:
            weight = np.where(s < rejection**2, 1.0, 0.0)
        normal = of_one_kind(problem, state, _weighted(linear, weight), "outlines")
        change, squared = _step(normal)
        settled = (squared < _SETTLED) & (step >= _ROBUST_STEPS)
        moving = known & ~settled
        if not moving.any():
            break
        state, is_near = _moved(foretold, state, np.where(moving[:, None], change, 0.0), length)
        known &= is_near
        linear = linearize(problem, state, whitening)
    outlines = of_one_kind(problem, state, _weighted(linear, weight), "outlines")
    readings = of_one_kind(problem, state, linear, "readings")
    which = np.flatnonzero(known & settled & _is_known(outlines, length))
    covariance = _covariance(outlines, readings, foretold.covariance)[which]
    return ShownPoses(state.T_Rb_Re, which, covariance)


def _weighted(linear: Linearization, weight: Array) -> Linearization:
    """Return the same with weights of the squares of outlines."""
    factor = np.sqrt(weight)[:, None, None] * np.eye(2)
    return replace(linear, outlines=linear.outlines.whitened(factor))


def _step(normal: NormalEquations) -> tuple[Array, Array]:
    """Return Gauss-Newton's steps (n_poses, 6) and their squared lengths in sigmas (n_poses,)."""
    y = -(normal.V_inverse @ normal.g_pose[..., None])[..., 0]
    squared = np.einsum("kf,kfh,kh->k", y, normal.V, y)
    return (_motions(normal) @ y[..., None])[..., 0], np.asarray(squared)


def _moved(
    foretold: Foretold, state: State, change: Array, length: float
) -> tuple[State, BoolArray]:
    """Return poses after a change [rad, m] that is not too large, and which are near the first.

    Those that are not are back at the first ones, and so are those that put a camera into a leg.
    """
    begin, unit = foretold.state, np.repeat([1.0, length], 3)
    reach = np.linalg.norm(change / unit, axis=1, keepdims=True)
    change = change * np.minimum(1.0, _FURTHEST / np.maximum(reach, 1e-300))
    R, t = turned(state.R_pose, change[:, :3]), state.t_pose + change[:, 3:]
    cosine = 0.5 * (np.einsum("kij,kij->k", R, begin.R_pose) - 1.0)
    shift = np.linalg.norm(t - begin.t_pose, axis=1)
    is_near = (cosine > np.cos(_LOST)) & (shift < _LOST * length)
    trial = _with_poses(state, begin, is_near, R, t)
    trial = on_constraints(trial, foretold.problem.legs.frame_legs)
    seen = np.isfinite(offsets_of(foretold.problem, trial)).all(axis=1)
    is_near[foretold.problem.outlines.pose[~seen]] = False
    return _with_poses(trial, begin, is_near, trial.R_pose, trial.t_pose), is_near


def _with_poses(state: State, begin: State, chosen: BoolArray, R: Array, t: Array) -> State:
    """Return a state with some new poses, the others those of the beginning."""
    return replace(
        state,
        R_pose=np.where(chosen[:, None, None], R, begin.R_pose),
        t_pose=np.where(chosen[:, None], t, begin.t_pose),
    )


def _mean_length(state: State) -> float:
    """Return the mean length of the legs [m]."""
    B = state.B @ np.swapaxes(state.R_pose, 1, 2) + state.t_pose[:, None]
    return float(np.mean(np.linalg.norm(B - state.A, axis=2)))


def _is_known(normal: NormalEquations, length: float) -> BoolArray:
    """Return which poses are determined well enough to mean anything."""
    Z = _motions(normal)
    covariance = Z @ normal.V_inverse @ np.swapaxes(Z, 1, 2)
    has_rank = np.linalg.eigvalsh(normal.V)[:, 0] > _RANK
    turn, shift = (
        np.sqrt(np.trace(covariance[:, part, part], axis1=1, axis2=2))
        for part in (slice(0, 3), slice(3, 6))
    )
    return np.asarray(has_rank & (shift < _KNOWN * length) & (turn < _KNOWN))


def _covariance(outlines: NormalEquations, readings: NormalEquations, of_fit: Array) -> Array:
    """Return the covariance of the motions between poses by readings and by outlines.

    Each has its own noise, and both follow the errors of the fit.
    """
    apart = _following(outlines) - _following(readings)
    inside = outlines.V_inverse + readings.V_inverse + apart @ of_fit @ np.swapaxes(apart, 1, 2)
    Z = _motions(outlines)
    return np.asarray(Z @ inside @ np.swapaxes(Z, 1, 2))


def _following(normal: NormalEquations) -> Array:
    """Return how poses follow the kept unknowns inside the constraints, (n_poses, f, n_kept)."""
    return np.asarray(-normal.V_inverse @ np.moveaxis(normal.W, 0, 2))


def _motions(normal: NormalEquations) -> Array:
    """Return the basis of the motions of poses, (n_poses, 6, f)."""
    if normal.tangent is None:
        return np.broadcast_to(np.eye(6), (len(normal.V), 6, 6))
    return normal.tangent.Z


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
