"""The information of the joint fit at images that nobody has taken, or has taken already.

The joint fit itself is built at outlines, with its common-mode edge biases, radii, intrinsics of
which the camera file states a covariance, lines of arms with their prior, and gamma where it is not
given. ``identify`` asks for its rank and covariance, ``plan`` selects images by it, and
``calibrate`` has it at the solution. Platform poses are eliminated; machine, cameras and what
images share are kept, so that an image is a low-rank update: rows U with U^T U added to the
information. Unknowns have names, those of a view begin with its name; unknown kinematic parameters
are coordinates inside what the mechanism ties.

**Errors that no fit knows**, of edges at places and of bodies in a view, move its result; their
effect adds to the covariance (:func:`fitted_covariance`). To choose images that would need
all others: photographs of one *site*, with all legs where others of them have theirs, count as
sharing errors at places, so that the second tells less than the first. In rows that make shared
errors of variances s^2 independent, n photographs tell n / (1 + n s^2) of what one would without
such errors.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path

import numpy as np
from scipy.linalg import block_diag, null_space
from scipy.spatial.transform import RigidTransform

from legcal.calibration.documents import ResidualsBlock, Result
from legcal.calibration.joint_fit.determinacy import covariance_as_stated
from legcal.calibration.joint_fit.factors import BoardCorners, ObservedOutlines
from legcal.calibration.joint_fit.outline_errors import (
    KINDS,
    PLACES,
    NoiseModel,
    possible_biases,
    shifts_at_places,
    shifts_of_edges,
    with_gamma,
)
from legcal.calibration.joint_fit.parameter_choices import NO_CHOICES, Choices, Prior
from legcal.calibration.joint_fit.problem import FitProblem, arm_sigmas, build_fit
from legcal.calibration.joint_fit.variables import FittedLegs, Start, fitted_legs
from legcal.calibration.tuning import TWIST_SIGMA_DEG
from legcal.data.corners import Corners, found_corners
from legcal.data.dataset import OBSERVATIONS_NAME
from legcal.data.measurements import Measurements, View
from legcal.data.outlines import FIRST_EDGE, OUTLINE_COLUMNS, Outlines, outlines_in_sight
from legcal.errors import DatasetError, UsageError
from legcal.estimation.problem import Frames, linearize
from legcal.estimation.uncertainty import marginal_rows
from legcal.files.table import read_table
from legcal.geometry.types import Array, BoolArray, IntArray
from legcal.machine.leg import Leg, LegKind, ParameterId
from legcal.machine.model import Machine
from legcal.machine.rods import ends_in_base, reading_of_rod
from legcal.perception.body_edges import predicted_edges
from legcal.vision.board import Board, FixedBoard
from legcal.vision.camera import Camera
from legcal.vision.visibility import Seen

# What is known of all that has no other prior: [rad] and [px], mean leg lengths
_WEAK, _WEAK_LENGTH = 1.0, 2.5
_RANK = 1e-7  # of the largest singular value
CORNER_PX = 0.1  # standard deviation of a corner of a board [px]


def predicted_outlines(seen: Seen, row: IntArray) -> Outlines:
    """Return the outlines of visible segments, each end known to a pixel; *row* of each image."""
    return outlines_in_sight(seen, row[seen.image], np.tile(np.eye(2), (len(seen), 1, 1)))


def predicted_corners(fixed: FixedBoard, row: IntArray, px: Array) -> Corners:
    """Return the corners of a board in images *row* (n,), where they show them (n, k, 2) [px]."""
    number = np.tile(fixed.first + np.arange(px.shape[1]), len(row))
    sigma = np.full(len(number), CORNER_PX)
    return found_corners(np.repeat(row, px.shape[1]), number, px.reshape(-1, 2), sigma)


@dataclass(frozen=True, eq=False)
class Contributions:
    """What images add to the information, by named unknowns."""

    names: tuple[str, ...]  # of m unknowns, the p coordinates of the machine first
    rows: Array  # (n_images, r, m): of each image, its platform pose eliminated
    known: Array  # (r, m): rows of priors and of measured lengths, of no image
    basis: Array  # (n_parameters, p): directions of the kinematic parameters
    # (n_images, r, c) how errors that a fit does not know, one standard deviation of each, move the
    # rows; to choose images none of them, but in their place
    shifts: Array
    at_site: Array  # (n_images, r) variances of what photographs of a site share, in the rows
    site: IntArray  # (n_images,)

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

    def tied_by_board(self, T_base_camera: Mapping[str, RigidTransform]) -> Contributions:
        """Replace camera poses of views by the pose of a board on the base.

        Camera poses relative to the board count as exact, so that all cameras share the six
        unknowns of the board. A camera that sees nothing else has no pose to replace.
        """
        names, turn = list(self.names), np.eye(len(self.names))
        tied = {view: T for view, T in T_base_camera.items() if f"{view}: pose 0" in names}
        if not tied:
            return self
        for view, T in tied.items():
            R = T.rotation.as_matrix().T
            columns = [names.index(f"{view}: pose {k}") for k in range(6)]
            turn[np.ix_(columns, columns)] = block_diag(R, R)
            for k, i in enumerate(columns):
                names[i] = f"board {k}"
        kept = list(dict.fromkeys(names))
        merge = np.zeros((len(names), len(kept)))
        merge[np.arange(len(names)), [kept.index(name) for name in names]] = 1.0
        turn = turn @ merge
        return replace(self, names=tuple(kept), rows=self.rows @ turn, known=self.known @ turn)

    def of_shared(self) -> Contributions:
        """Eliminate the unknowns of single views, without errors that a fit does not know."""
        is_own = np.array([": " in name for name in self.names])
        shared, with_own = np.flatnonzero(~is_own), self.known[:, is_own].any(axis=1)
        rows = marginal_rows(np.concatenate([self.all_gains(), self.known[with_own]]), shared)
        names, known = tuple(self.names[i] for i in shared), self.known[~with_own][:, shared]
        nothing, site = np.zeros((1, len(rows), 0)), np.zeros(1, dtype=np.intp)
        no_errors = np.zeros((1, len(rows)))  # all rows count as those of one image
        return Contributions(names, rows[None], known, self.basis, nothing, no_errors, site)

    def repeated(self, times: float) -> Contributions:
        """Return the information of *times* photographs in place of each one."""
        return replace(self, rows=self.rows * np.sqrt(times), at_site=self.at_site * times)


def joined(parts: Sequence[Contributions]) -> tuple[list[IntArray], Array]:
    """Return the numbers of each part's unknowns among all, and the prior information of all.

    Unknowns of single views belong to their part; what is known of others is the same in each.
    """
    number, columns = dict[str, int](), list[IntArray]()
    for s, part in enumerate(parts):
        local = [f"{s}/{name}" if ": " in name else name for name in part.names]
        columns.append(np.array([number.setdefault(name, len(number)) for name in local]))
    prior = np.zeros((len(number), len(number)))
    of_views = [part.known[:, [": " in name for name in part.names]].any(axis=1) for part in parts]
    for where, part, is_own in zip(columns, parts, of_views, strict=True):
        prior[np.ix_(where, where)] = part.known[~is_own].T @ part.known[~is_own]
    for where, part, is_own in zip(columns, parts, of_views, strict=True):
        prior[np.ix_(where, where)] += part.known[is_own].T @ part.known[is_own]
    return columns, prior


def fitted_covariance(
    parts: Sequence[Contributions],
    fitted: FittedLegs,
    poses: Sequence[RigidTransform],  # T_Rb_Re
    length: float,  # mean leg length [m]
) -> Array:
    """Return the covariance (p, p) of all parameters that a fit to all images of views states.

    With errors that the fit does not know, as a calibration has them. Weak directions that hardly
    move the platform at *poses* are held.
    """
    (columns, information), basis = joined(parts), parts[0].basis
    pulls = list[Array]()
    for where, part in zip(columns, parts, strict=True):
        rows = part.all_gains()
        information[np.ix_(where, where)] += rows.T @ rows
        pulls.append(rows.T @ part.shifts.reshape(len(rows), part.shifts.shape[2]))
    by_all = basis @ np.linalg.inv(information)[: basis.shape[1]]
    moved = [by_all[:, at] @ pull for at, pull in zip(columns, pulls, strict=True)]
    S = by_all[:, : basis.shape[1]] @ basis.T
    return covariance_as_stated(S, np.hstack(moved), fitted, poses, length)


@dataclass(frozen=True, eq=False)
class Predictor:
    """The joint fit of a machine at images that nobody has taken."""

    machine: Machine
    camera: Camera
    noise: PredictedNoise
    sigma_q: Array  # (n_legs,) of readings [m or rad]
    choices: Choices = NO_CHOICES

    @cached_property
    def legs(self) -> FittedLegs:
        """The legs as the joint fit sees them."""
        return fitted_legs(self.machine)

    def contributions(
        self,
        views: Mapping[str, RigidTransform],  # T_base_camera of views by their names
        view: IntArray,  # (n_images,)
        poses: Sequence[RigidTransform],  # T_Rb_Re of each image
        outlines: Outlines,
        legs: Sequence[Leg] | None = None,  # in R_b and R_e, if not the nominal ones
        edges: Outlines | None = None,  # of bodies; without them those that are predicted
        *,
        # a board on the base with T_base_board, which all images show
        board: tuple[Board, RigidTransform] | None = None,
        hand_held: bool = False,  # views are images of one camera in a hand
        to_choose: bool = False,
    ) -> Contributions:
        """Return the contribution of images to the information of a fit, or *to_choose* some.

        Unknowns without a prior have a weak one.
        """
        n, shown = len(poses), tuple(legs or self.legs.nominal)
        camera = replace(self.camera, gamma_is_given=False)
        measurements = Measurements(
            views=tuple(View(name, camera, T, hand_held=hand_held) for name, T in views.items()),
            image=("",) * n,
            view=view,
            pose=np.arange(n, dtype=np.intp),
            q=readings_at(shown, *Frames.of(poses)),
            sigma_q=self.sigma_q,
        )
        T_base_Rb = self.machine.T_base_Rb
        if edges is None:
            edges = predicted_edges(
                self.machine.occluders,
                [(camera, T) for T in views.values()],
                view,
                ends_in_base(shown, T_base_Rb, *Frames.of(poses), measurements.q),
                np.ones((len(views), len(shown)), dtype=np.bool_),
            )
        start = Start(
            shown,
            tuple(T.inv() * T_base_Rb for T in views.values()),
            tuple(poses),
            "plan",
            RigidTransform.identity() if board is None else T_base_Rb.inv() * board[1],
        )
        return information_of_images(
            self.legs,
            measurements,
            outlines,
            start,
            self.noise,
            self.choices,
            board=None if board is None else self._corners(*board, views, view),
            edges=edges,
            to_choose=to_choose,
            known_length=self.machine.size,
        )

    def _corners(
        self,
        board: Board,
        T_base_board: RigidTransform,
        views: Mapping[str, RigidTransform],
        view: IntArray,
    ) -> BoardCorners:
        """Return the corners of a board on the base in all images."""
        X, fixed = T_base_board.apply(board.points), FixedBoard(board, "base")
        px = np.array([self.camera.project(T.inv().apply(X)) for T in views.values()])
        return BoardCorners((fixed,), predicted_corners(fixed, np.arange(len(view)), px[view]))


def readings_at(legs: Sequence[Leg], R: Array, t: Array) -> Array:
    """Return the readings (n, n_legs) of motors at poses [m or rad], and zero for other legs."""
    q = np.zeros((len(t), len(legs)))
    for j, leg in enumerate(legs):
        end = R @ leg.B + t
        if leg.actuator is not None:
            q[:, j] = reading_of_rod(leg, end)
        elif leg.kind is LegKind.ACTUATED:
            q[:, j] = leg.sign * (np.linalg.norm(end - leg.A, axis=1) - leg.q0)
    return q


def information_of_images(
    legs: FittedLegs,
    measurements: Measurements,
    outlines: Outlines,  # which there are: their errors are those of *noise*
    start: Start,
    noise: PredictedNoise,
    choices: Choices = NO_CHOICES,
    *,
    board: BoardCorners | None = None,
    edges: Outlines | None = None,  # of bodies, likewise
    to_choose: bool = False,  # as in :meth:`Predictor.contributions`
    known_length: float | None = None,  # mean leg length of weak priors; without it there are none
) -> Contributions:
    """Return the information of the joint fit, linearised at a start."""
    usual = replace(_as_calibrated(legs, choices), of_photographs=noise.of_photographs)
    problem = build_fit(
        legs,
        measurements,
        noise.of(outlines),
        board=board,
        choices=usual,
        edges=None if edges is None else noise.of_bodies(edges),
    )
    biases = possible_biases(problem.outlines, legs.names)
    problem = problem.with_biases(biases.of_sizes(with_gamma(np.append(noise.common_px, 0.0))))
    problem, state = problem.weighted(NoiseModel()), problem.begin(start)
    linear, n = linearize(problem, state), problem.n_elements
    tangent = problem.constraint.tangent(problem, state) if problem.constraint else None
    shifts = _unknown_errors(problem, noise, to_choose=to_choose)
    n_shifts = shifts["outlines"].shape[2]
    blocks, is_outline, known = [], [], [linear.prior_J]
    for factor in problem.factors:
        if not factor.n:
            continue
        found, where = linear[factor.name], problem.sparsity[factor.name]
        q = found.r.shape[1]
        J = np.zeros((factor.n, q, problem.n_kept + 1))
        at = np.arange(factor.n)[:, None, None], np.arange(q)[None, :, None]
        np.add.at(J, (*at, where.index[:, None, :]), found.J)
        if factor.element is None:
            known.append(J[..., :-1].reshape(-1, problem.n_kept))
            continue
        moved = shifts.get(factor.name, np.zeros((factor.n, q, n_shifts)))
        every = np.concatenate([found.J_element, J[..., :-1], moved], axis=2)
        every *= np.sqrt(problem.loss.efficiency(q)) if factor.robust else 1.0
        blocks.append(_by_element(every, factor.element, n))
        is_outline += [factor.name == "outlines"] * blocks[-1].shape[1]
    stacked = np.concatenate(blocks, axis=1)
    n_own = stacked.shape[2] - problem.n_kept - n_shifts
    own, kept, moved = np.split(stacked, [n_own, n_own + problem.n_kept], axis=2)
    if tangent is not None:
        kept = kept + np.einsum("krd,mkd->krm", own, tangent.Q)
        own = own @ tangent.Z
    U, s, _ = np.linalg.svd(own, full_matrices=False)
    U = U * (s > _RANK * s[:, :1])[:, None]
    kept = _without(U, kept)
    at_site, site = np.zeros(kept.shape[:2]), np.arange(n)
    if not to_choose:
        moved = _without(U, moved)
    else:
        if any(noise.places_px):
            at_site, kept = _apart(kept, U, moved, np.array(is_outline))
            site = _sites(problem.outlines, n)
        moved = moved[..., :0]
    names = _names(problem, measurements.view_names)
    if known_length is not None:
        known.append(_weak_rows(problem, np.concatenate(known), known_length))
    k, untied = problem.n_kinematic, np.eye(problem.n_kinematic)
    if problem.parameters.n_tied:
        untied = null_space(problem.parameters.tie_rows(state.legs)[1])
    basis = np.zeros((len(problem.free), untied.shape[1]))
    # Steps of an axis count in its tangent plane, parameters as angles from the nominal one.
    basis[problem.free] = problem.jacobian(state)[:k, :k] @ untied
    turn = block_diag(untied, np.eye(problem.n_kept - k))
    named = *(f"machine {i}" for i in range(untied.shape[1])), *names[k:]
    return Contributions(
        named, kept @ turn, np.concatenate(known) @ turn, basis, moved, at_site, site
    )


def _as_calibrated(legs: FittedLegs, choices: Choices) -> Choices:
    """Add the priors of a calibration: of twists, and of lines of arms, also of those not seen."""
    seen = [j for j, leg in enumerate(legs.nominal) if leg.arm is not None]
    sigmas = arm_sigmas(legs.parametrization, legs.nominal, seen) if choices.built is None else {}
    twist = float(np.radians(TWIST_SIGMA_DEG))
    names = legs.parametrization.names
    sigmas |= {name: twist for name in names if ParameterId.parse(name).kind == "twist"}
    chosen = {*choices.fixed, *choices.free}
    usual = {name: Prior(0.0, sigma) for name, sigma in sigmas.items() if name not in chosen}
    return replace(choices, priors=usual | dict(choices.priors))


def _unknown_errors(
    problem: FitProblem, noise: PredictedNoise, *, to_choose: bool
) -> dict[str, Array]:
    """Return how errors that a fit does not know move whitened rows (n, q, c), by their factor.

    By one standard deviation of each; to choose, of bias and tilt of each outline alone.
    """
    o, sigma = problem.outlines, np.array(noise.places_px)
    if to_choose:
        whitening = np.asarray(problem.factor("outlines").whitening)
        return {"outlines": whitening @ (shifts_of_edges(len(o)) * sigma)}
    at_places = shifts_at_places(o, np.full(len(o), sigma.any()))
    return problem.unknown_errors(at_places * np.repeat(sigma, at_places.shape[2] // len(sigma)))


def _weak_rows(problem: FitProblem, known: Array, length: float) -> Array:
    """Return rows of weak priors of unknowns of which nothing is known."""
    weak = np.flatnonzero(~known.any(axis=0))
    sigma = np.where(_are_lengths(problem), _WEAK_LENGTH * length, _WEAK)[weak]
    rows = np.zeros((len(weak), problem.n_kept))
    rows[np.arange(len(weak)), weak] = 1.0 / sigma
    return rows


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
    o, view = outlines, np.zeros(n, dtype=np.intp)
    if len(np.unique(np.stack([o.pose, o.view], axis=1), axis=0)) > len(np.unique(o.pose)):
        return np.arange(n)  # several cameras see a pose
    view[o.pose] = o.view
    middle = np.full((n, len(o.parts), 2, 2), np.nan)  # of images that show the edge
    middle[o.pose, o.radius, (o.epsilon < 0.0).astype(np.intp)] = o.pixels.mean(axis=1)
    site, firsts, width = np.zeros(n, dtype=np.intp), list[int](), o.width_px
    shown = np.isfinite(middle)
    for k in range(n):
        alike = np.all(shown[firsts] == shown[k], axis=(1, 2, 3)) & (view[firsts] == view[k])
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
    are_alike = len(set(problem.outlines.cameras)) == 1  # all views share one camera
    for block in problem.variables:
        where = problem.where(block.name)
        labels = block.labels or tuple(str(i) for i in range(block.n_unknowns))
        for i, label in zip(where.tolist(), labels, strict=True):
            owners = [view for view in views if label.startswith(f"{view}.")]
            head = max(owners, key=len, default="")
            rest = label.removeprefix(f"{head}.")
            if block.name == "cameras" or (block.name == "biases" and rest == "gamma"):
                names[i] = f"camera {rest if are_alike else label}"
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


@dataclass(frozen=True)
class PredictedNoise:
    """Errors of outlines, whatever the contrast.

    By default shared errors are about the largest of a simulated machine
    (``benchmarks/shared_errors.py``): plans that count on less rely on it.
    """

    # Standard deviation of an edge in one pixel of length [px]; that of an outline at both of its
    # ends falls with the root of its length
    sigma_px: float = 0.35
    correlation: float = 0.0  # of errors at both ends: -0.5 where those of pixels are independent
    # standard deviations of the common-mode edge biases, in the order of their kinds [px]
    common_px: tuple[float, ...] = (0.045, 0.003, 0.033, 0.009, 0.014, 0.005)
    places_px: tuple[float, ...] = (0.024, 0.023)  # of bias and tilt of an edge at a place [px]
    gamma_px: float = 0.1  # motion of an outline with ln gamma, which counts as not known [px]
    source: str = "what photographs of simulated machines show"  # where it is from, in words
    # standard deviations of bias and tilt of single outlines [px]
    bias_px: float = 0.0
    tilt_px: float = 0.0
    edge_px: float = 0.28  # of one end of an edge of a body, seen from the other [px]

    @property
    def of_photographs(self) -> bool:
        """Whether edges share errors, as those in photographs do."""
        return any(self.common_px)

    def of_bodies(self, edges: Outlines) -> Outlines:
        """Return edges of bodies with the covariance that is predicted."""
        covariance = np.tile(0.5 * self.edge_px**2 * np.eye(2), (len(edges), 1, 1))
        return replace(edges, covariance=covariance)

    def of(self, outlines: Outlines) -> Outlines:
        """Return outlines with the covariance and the dependence on gamma that are predicted."""
        n = len(outlines.row)
        length = np.linalg.norm(outlines.ends[:, 1] - outlines.ends[:, 0], axis=-1)
        of_ends = 4.0 * np.array([[1.0, self.correlation], [self.correlation, 1.0]])
        of_length = (self.sigma_px**2 / length)[:, None, None] * of_ends
        single = NoiseModel(1.0, self.bias_px, self.tilt_px)
        with_noise = replace(outlines, covariance=single.covariance(of_length))
        if self.gamma_px == 0.0:
            return with_noise
        return replace(with_noise, gamma=np.full(n, 2.2), by_gamma=np.full(n, self.gamma_px))


DEFAULT_NOISE = PredictedNoise()
# White noise of edge points, as simulated outlines have it
WHITE = PredictedNoise(0.1, -0.5, (0.0,) * 6, (0.0, 0.0), 0.0, "independent errors of edge points")


def read_noise(path: Path) -> PredictedNoise:
    """Return the estimated noise of an earlier result, by its folder or ``result.json``.

    Its outlines have their claimed standard deviations times the estimated scale.
    """
    file = path / "result.json" if path.is_dir() else path
    try:
        return _noise_of_result(Result.read(file).residuals, file)
    except (OSError, DatasetError) as error:
        raise UsageError(
            f"The noise in {path} could not be used: {error} Correct --noise, or leave it out."
        ) from error


def _noise_of_result(residuals: ResidualsBlock, file: Path) -> PredictedNoise:
    noise, common = residuals.noise, residuals.shared_px
    sigma, correlation = DEFAULT_NOISE.sigma_px, DEFAULT_NOISE.correlation
    table = file.parent / OBSERVATIONS_NAME
    if table.is_file():
        rows = read_table(table, "table", "outline", OUTLINE_COLUMNS)
        used = np.array([verdict == "used" for verdict in rows.text("verdict")])
        used &= rows.number("edge") < FIRST_EDGE  # not of bodies
        s00, s01, s11 = (rows.number(name)[used] for name in ("s00", "s01", "s11"))
        ends = np.stack([rows.number(n)[used] for n in ("u0", "v0", "u1", "v1")], axis=-1)
        length = np.linalg.norm(ends[:, 2:] - ends[:, :2], axis=1)
        if len(length):
            variance = 0.5 * (s00 + s11)
            sigma = noise.scale * float(np.median(np.sqrt(variance * length / 4.0)))
            correlation = float(np.median(s01 / variance))
    shared, places = (tuple(common.get(kind, 0.0) for kind in kinds) for kinds in (KINDS, PLACES))
    return PredictedNoise(
        sigma,
        max(min(correlation, 0.9), -0.9),
        shared,
        places,
        DEFAULT_NOISE.gamma_px if any(shared) else 0.0,
        str(file),
        noise.bias_px,
        noise.tilt_px,
        DEFAULT_NOISE.edge_px if residuals.edges_px is None else residuals.edges_px,
    )
