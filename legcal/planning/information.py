"""What predicted images say: the rows that each adds to the information of the joint fit.

The joint fit itself is built at predicted outlines, with its common-mode edge biases, radii,
intrinsics of which the camera file states a covariance, lines of arms with their prior, and gamma
where it is not given. The platform pose of an image is eliminated; machine, cameras and what images
share are kept, so that an image is a low-rank update: rows U with U^T U added to the information.
Unknowns have names, those of a view begin with its name; unknown kinematic parameters are
coordinates inside what the mechanism ties.

**Places.** Edges that come back to the same place of a view err alike again. Photographs of one
*site*, with all legs where others of them have theirs, share these errors: the second tells less
than the first. In rows that make shared errors of variances s^2 independent, n photographs tell
n / (1 + n s^2) of what one would without such errors.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np
from scipy.linalg import block_diag, null_space
from scipy.spatial.transform import RigidTransform

from legcal.calibration.joint_fit.factors import ObservedOutlines
from legcal.calibration.joint_fit.outline_errors import (
    NoiseModel,
    possible_biases,
    shifts_at_places,
    shifts_of_edges,
    with_gamma,
)
from legcal.calibration.joint_fit.parameter_choices import NO_CHOICES, Choices, Prior
from legcal.calibration.joint_fit.problem import FitProblem, arm_sigmas, build_fit
from legcal.calibration.joint_fit.variables import FittedLegs, Start, State, fitted_legs
from legcal.data.measurements import Measurements, View
from legcal.data.outlines import Outlines
from legcal.estimation.problem import Frames, linearize
from legcal.geometry.types import Array, BoolArray, IntArray
from legcal.machine.leg import Leg
from legcal.machine.model import Machine
from legcal.machine.rods import reading_of_rod
from legcal.vision.camera import Camera

KINEMATIC = "machine"  # names of coordinates of the machine begin so
# What is known of all that has no other prior: [rad] and [px], mean leg lengths
_WEAK, _WEAK_LENGTH = 1.0, 2.5
_RANK = 1e-7  # of the largest singular value


@dataclass(frozen=True)
class PredictedNoise:
    """Errors of outlines, whatever the contrast.

    By default shared errors are about the largest of a simulated machine
    (``benchmarks/shared_errors.py``): plans that count on less rely on it.

    Attributes
    ----------
    sigma_px : float
        Standard deviation of an edge in one pixel of length; that of an outline at both of its
        ends falls with the root of its length [px].
    correlation : float
        Of the errors at both ends: -0.5 where errors of pixels are independent.
    common_px : tuple of float
        Standard deviations of the common-mode edge biases, in the order of their kinds [px].
    places_px : tuple of float
        Standard deviations of bias and tilt of an edge at a place [px].
    gamma_px : float
        How far an outline moves with the logarithm of the gamma, which counts as not known [px].
    source : str
        Where it is from, in words.
    """

    sigma_px: float = 0.35
    correlation: float = 0.0
    common_px: tuple[float, ...] = (0.045, 0.003, 0.033, 0.009, 0.014, 0.005)
    places_px: tuple[float, ...] = (0.024, 0.023)
    gamma_px: float = 0.1
    source: str = "what photographs of simulated machines show"

    def of(self, outlines: Outlines) -> Outlines:
        """Return outlines with the covariance and the dependence on gamma that are predicted."""
        n = len(outlines.row)
        length = np.linalg.norm(outlines.ends[:, 1] - outlines.ends[:, 0], axis=-1)
        of_ends = 4.0 * np.array([[1.0, self.correlation], [self.correlation, 1.0]])
        with_noise = replace(
            outlines, covariance=(self.sigma_px**2 / length)[:, None, None] * of_ends
        )
        if self.gamma_px == 0.0:
            return with_noise
        return replace(with_noise, gamma=np.full(n, 2.2), by_gamma=np.full(n, self.gamma_px))


DEFAULT_NOISE = PredictedNoise()
# White noise of edge points, as simulated outlines have it
WHITE = PredictedNoise(0.1, -0.5, (0.0,) * 6, (0.0, 0.0), 0.0, "independent errors of edge points")


@dataclass(frozen=True, eq=False)
class Contributions:
    """What images add to the information, by named unknowns."""

    names: tuple[str, ...]  # of m unknowns, the p coordinates of the machine first
    rows: Array  # (n_images, r, m): of each image, its platform pose eliminated
    prior: Array  # (m, m): prior information
    basis: Array  # (n_parameters, p): directions of the kinematic parameters
    at_site: Array  # (n_images, r) variances of what photographs of a site share, in those rows
    site: IntArray  # (n_images,)
    # (n_images, r, c) how errors at places, one standard deviation of each, move the rows; none of
    # them unless a fit is predicted that does not know them
    shifts: Array

    def gains(self, images: IntArray, number: IntArray) -> Array:
        """Return the rows (n, r, m) that images add as that many-th ones of their sites."""
        shared, number = self.at_site[images], np.reshape(number, (-1, 1))
        before = number - 1
        gain = number / (1.0 + number * shared) - before / (1.0 + before * shared)
        return np.asarray(np.sqrt(gain)[..., None] * self.rows[images])

    def all_gains(self) -> Array:
        """Return the rows (n_images r, m) that all images add together."""
        order = np.argsort(self.site, kind="stable")
        _, first, count = np.unique(self.site[order], return_index=True, return_counts=True)
        number = np.empty(len(order), dtype=np.intp)
        number[order] = 1 + np.arange(len(order)) - np.repeat(first, count)
        rows = self.gains(np.arange(len(order)), number)
        return rows.reshape(len(order) * rows.shape[1], rows.shape[2])

    def repeated(self, times: float) -> Contributions:
        """Return the information of *times* photographs in place of each one."""
        return replace(self, rows=self.rows * np.sqrt(times), at_site=self.at_site * times)


@dataclass(frozen=True, eq=False)
class Predictor:
    """The joint fit of a machine at images that nobody has taken."""

    machine: Machine
    camera: Camera
    noise: PredictedNoise
    sigma_q: float  # of a reading [m]
    choices: Choices = NO_CHOICES
    sigma_by_joint: Mapping[str, float] = field(default_factory=dict)  # where stated [m or rad]

    @cached_property
    def legs(self) -> FittedLegs:
        """The legs as the joint fit sees them."""
        return fitted_legs(self.machine)

    @cached_property
    def _known(self) -> Choices:
        """The choices, with lines of arms unknown in all images, also in those that show none."""
        seen = [j for j, leg in enumerate(self.legs.nominal) if leg.arm is not None]
        sigmas = arm_sigmas(self.legs.parametrization, self.legs.nominal, seen)
        arms = {name: Prior(0.0, sigma) for name, sigma in sigmas.items()}
        return replace(self.choices, priors=arms | dict(self.choices.priors))

    def contributions(
        self,
        views: Mapping[str, RigidTransform],  # T_base_camera of views by their names
        view: IntArray,  # (n_images,)
        poses: Sequence[RigidTransform],  # T_Rb_Re of each image
        outlines: Outlines,
        legs: Sequence[Leg] | None = None,  # in R_b and R_e, if not the nominal ones
        *,
        is_fit: bool = False,
    ) -> Contributions:
        """Return the contribution of images to the information.

        With *is_fit* that of a fit that weighs outlines as if they had no errors at places, and how
        these move it.
        """
        n, shown = len(poses), tuple(legs or self.legs.nominal)
        R, t = Frames.of(poses)
        q = np.zeros((n, self.legs.n_legs))
        for j, leg in enumerate(shown):
            if leg.actuator is not None:  # it has joints at A where readings say
                q[:, j] = reading_of_rod(leg, R @ leg.B + t)
        camera = replace(self.camera, gamma_is_given=False)
        measurements = Measurements(
            views=tuple(View(name, camera, T) for name, T in views.items()),
            image=("",) * n,
            view=view,
            pose=np.arange(n, dtype=np.intp),
            q=q,
            sigma_q=self.sigma_q,
            sigma_by_joint=self.sigma_by_joint,
        )
        problem = build_fit(self.legs, measurements, self.noise.of(outlines), choices=self._known)
        biases = possible_biases(problem.outlines, self.legs.names)
        problem = problem.with_biases(
            biases.of_sizes(with_gamma(np.append(self.noise.common_px, 0.0)))
        )
        T_base_Rb = self.machine.T_base_Rb
        start = Start(
            shown,
            tuple(T.inv() * T_base_Rb for T in views.values()),
            tuple(poses),
            "plan",
        )
        state = problem.begin(start)
        return self._rows(problem.weighted(NoiseModel()), state, list(views), is_fit=is_fit)

    def _rows(
        self, problem: FitProblem, state: State, views: Sequence[str], *, is_fit: bool
    ) -> Contributions:
        """Return the whitened rows of every image, and the priors of all unknowns."""
        linear, n = linearize(problem, state), problem.n_elements
        tangent = problem.constraint.tangent(problem, state) if problem.constraint else None
        shifts = self._shifts(problem, are_shared=is_fit)
        blocks, is_outline = [], []
        for factor in problem.factors:
            if not factor.n or factor.element is None:
                continue
            found, where = linear[factor.name], problem.sparsity[factor.name]
            q = found.r.shape[1]
            J = np.zeros((factor.n, q, problem.n_kept + 1))
            at = np.arange(factor.n)[:, None, None], np.arange(q)[None, :, None]
            np.add.at(J, (*at, where.index[:, None, :]), found.J)
            moved = np.zeros((factor.n, q, shifts.shape[2]))
            if factor.name == "outlines":
                moved = factor.whitening @ shifts
            every = np.concatenate([found.J_element, J[..., :-1], moved], axis=2)
            every *= np.sqrt(problem.loss.efficiency(q)) if factor.robust else 1.0
            blocks.append(_by_element(every, factor.element, n))
            is_outline += [factor.name == "outlines"] * blocks[-1].shape[1]
        stacked = np.concatenate(blocks, axis=1)
        n_own = stacked.shape[2] - problem.n_kept - shifts.shape[2]
        own, kept, moved = np.split(stacked, [n_own, n_own + problem.n_kept], axis=2)
        if tangent is not None:
            kept = kept + np.einsum("krd,mkd->krm", own, tangent.Q)
            own = own @ tangent.Z
        U, s, _ = np.linalg.svd(own, full_matrices=False)
        U = U * (s > _RANK * s[:, :1])[:, None]
        kept = _without(U, kept)
        at_site = np.zeros(kept.shape[:2])
        if not is_fit and np.any(self.noise.places_px):
            at_site, kept = _apart(kept, U, moved, np.array(is_outline))
        names = _names(problem, views)
        prior = linear.prior_J.T @ linear.prior_J
        weak = np.array([prior[i, i] == 0.0 for i in range(len(prior))])
        known = np.where(_are_lengths(problem), _WEAK_LENGTH * self.machine.size, _WEAK)
        prior[weak, weak] = 1.0 / known[weak] ** 2
        k, untied = problem.n_kinematic, np.eye(problem.n_kinematic)
        if problem.parameters.n_tied:
            untied = null_space(problem.parameters.tie_rows(state.legs)[1])
        basis = np.zeros((len(problem.free), untied.shape[1]))
        # Steps of an axis count in its tangent plane, parameters as angles from the nominal one.
        basis[problem.free] = problem.parameters.jacobian(state.legs) @ untied
        rows = np.concatenate([kept[..., :k] @ untied, kept[..., k:]], axis=2)
        whole = block_diag(untied.T @ prior[:k, :k] @ untied, prior[k:, k:])
        named = *(f"{KINEMATIC} {i}" for i in range(untied.shape[1])), *names[k:]
        if is_fit:
            moved = _without(U, moved)
            return Contributions(named, rows, whole, basis, at_site, np.arange(n), moved)
        site = _sites(problem.outlines, n)
        return Contributions(named, rows, whole, basis, at_site, site, moved[..., :0])

    def _shifts(self, problem: FitProblem, *, are_shared: bool) -> Array:
        """Return the shifts of both ends of outlines by repeated errors (n, 2, c) [px].

        By one standard deviation of each: of each place, or of bias and tilt of each outline alone.
        """
        o, sigma = problem.outlines, np.array(self.noise.places_px)
        if not sigma.any():
            return np.zeros((len(o), 2, 0))
        if not are_shared:
            return np.asarray(shifts_of_edges(len(o)) * sigma, dtype=np.float64)
        shifts = shifts_at_places(o, np.ones(len(o), dtype=np.bool_))
        return np.asarray(shifts * np.repeat(sigma, shifts.shape[2] // len(sigma)))


def _without(U: Array, X: Array) -> Array:
    """Return columns X (n, r, c) without their parts along orthonormal ones (n, r, d), or zero."""
    return X - U @ (np.swapaxes(U, 1, 2) @ X)


def _apart(
    kept: Array,  # (n, r, m)
    U: Array,  # (n, r, d): derivatives by the pose of an image
    moved: Array,  # (n, r, 2): by bias and tilt of the outline of each row
    is_outline: BoolArray,  # (r,)
) -> tuple[Array, Array]:
    """Return variances (n, r) of shared errors, and rows turned so that these are independent."""
    first = int(np.argmax(is_outline))
    outline = (np.arange(len(is_outline)) - first) // 2  # of two rows each
    same = (outline[:, None] == outline) & is_outline & is_outline[:, None]
    shared = (moved @ np.swapaxes(moved, 1, 2)) * same
    shared = _without(U, np.swapaxes(_without(U, shared), 1, 2))
    variances, turn = np.linalg.eigh(shared)
    return np.maximum(variances, 0.0), np.swapaxes(turn, 1, 2) @ kept


def _sites(outlines: ObservedOutlines, n: int) -> IntArray:
    """Return the site (n,) of each image: the same where all edges are within a width of a part."""
    o = outlines
    middle = np.full((n, len(o.parts), 2, 2), np.nan)  # of images that show the edge
    middle[o.pose, o.radius, (o.epsilon < 0.0).astype(np.intp)] = o.pixels.mean(axis=1)
    site, firsts, width = np.zeros(n, dtype=np.intp), list[int](), o.width_px
    shown = np.isfinite(middle)
    for k in range(n):
        alike = np.all(shown[firsts] == shown[k], axis=(1, 2, 3))
        apart = np.linalg.norm(middle[firsts] - middle[k], axis=-1)
        near = alike & np.all(~(apart > width), axis=(1, 2))
        site[k] = int(np.argmax(near)) if near.any() else len(firsts)
        if not near.any():
            firsts.append(k)
    return site


def _by_element(rows: Array, element: IntArray, n: int) -> Array:
    """Return rows (m, q, c) by their element, (n, r, c), with zeros where an element has fewer."""
    m, q, c = rows.shape
    order = np.argsort(element, kind="stable")
    count = np.bincount(element, minlength=n)
    first = np.concatenate([[0], np.cumsum(count)[:-1]])
    padded = np.zeros((n, int(count.max(initial=0)), q, c))
    padded[element[order], np.arange(m) - first[element[order]]] = rows[order]
    return padded.reshape(n, -1, c)


def _are_lengths(problem: FitProblem) -> BoolArray:
    """Return the mask of kept unknowns in metres, (n_kept,)."""
    are_lengths = np.zeros(problem.n_kept, dtype=np.bool_)
    for block in problem.variables:
        where = problem.where(block.name)
        if block.units:
            are_lengths[where] = [unit == "m" for unit in block.units]
        elif block.unknown.shape[1] == 6:  # motions: turns before displacements
            displaced = block.unknown[:, 3:]
            are_lengths[where[displaced[displaced >= 0]]] = True
    return are_lengths


def _names(problem: FitProblem, views: Sequence[str]) -> list[str]:
    """Return a name for each kept unknown; those of one view begin with ``VIEW:``."""
    names = [""] * problem.n_kept
    for block in problem.variables:
        where = problem.where(block.name)
        labels = block.labels or tuple(str(i) for i in range(block.n_unknowns))
        for i, label in zip(where.tolist(), labels, strict=True):
            owners = [view for view in views if label.startswith(f"{view}.")]
            head = max(owners, key=len, default="")
            rest = label.removeprefix(f"{head}.")
            if block.name == "cameras" or (block.name == "biases" and rest == "gamma"):
                names[i] = f"camera {rest}"  # all views share one
            elif block.name == "biases" and head:
                names[i] = f"{head}: {rest}"
            else:
                names[i] = f"{block.name} {label}"
    of_views = problem.block("camera_pose").unknown
    where = problem.where("camera_pose")
    for v, numbers in enumerate(of_views):
        for k, number in enumerate(numbers.tolist()):
            if number >= 0:
                names[where[number]] = f"{views[v]}: pose {k}"
    return names
