"""Views fitted to their outlines, and guided matching of the legs that are missing.

Edge pairs place a camera to some millimetres and leave out legs that have none; outlines are far
better known. A group of views is one :class:`legcal.estimation.problem.EstimationProblem`:

    pose        of the machine in the frame of the group, about the middle of its joints
    shift       of A and B of each leg against the model
    offset      of B of each leg in each image besides, eliminated

Outlines, priors of shifts and of offsets are its factors; the standard deviations of the priors are
estimated on the way, and a Cauchy weight of each leg in each image makes it robust.
:func:`refine_views` rejects legs that do not fit, looks for missing ones within what the fit knows,
and fits again. Outlines of wrong edges agree on no fit, which also separates camera poses
that edge pairs do not.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import RigidTransform, Rotation

from legcal.data.outlines import Outlines, is_edited, join_outlines
from legcal.data.reasons import Reason
from legcal.errors import Cause, NotVisible
from legcal.estimation.loss import cauchy_weights
from legcal.estimation.problem import (
    EstimationProblem,
    Factor,
    Frames,
    GaussianPrior,
    Linearization,
    Residuals,
    Variables,
    all_free,
    linearize,
)
from legcal.estimation.solver import NormalEquations, information
from legcal.geometry.covariances import whitener
from legcal.geometry.lines import cross
from legcal.geometry.motions import cross_matrices
from legcal.geometry.types import Array, BoolArray, IntArray
from legcal.machine.leg import main_cylinders
from legcal.perception.outline import measure_outlines
from legcal.perception.pair_matching import MIN_DEPTH, CameraPoses, depth_reversed
from legcal.perception.placement import Group, Placement, Search
from legcal.perception.tuning import EVIDENCE, OUTLIER_SIGMAS, OUTLINE_SIGMA_PX
from legcal.vision.camera import Camera
from legcal.vision.cylinder import outlines_of_axis
from legcal.workers import Run, in_turn

# Lengths are parts of the mean leg length.
JOINT_SIGMA_BOUNDS = 0.0038, 0.03  # of joint centres in all images, as legs may show them
IMAGE_SIGMA = 0.005  # of the platform joints in an image besides, at first
IMAGE_SIGMA_BOUNDS = 0.0018, 0.03  # between which images may show it
TURN_SIGMA, DISTANCE_SIGMA = 0.3, 0.15  # prior of the pose: angle, displacement by its distance
MAX_TURN, MAX_DISPLACEMENT = 0.2, 0.1  # of a step: angle, part of the distance
ITERATIONS, FIXED_ITERATIONS = 8, 2  # of Gauss-Newton, and those before sigmas are estimated
OUTLINE_EVIDENCE, MAX_OUTLINES = 2.0, 4  # of an outline, half a square; of a leg in an image
EVIDENCE_OF_IMAGE = 0.15  # of EVIDENCE, for each image: more of them agree more by chance
WEAK = 0.7  # part of the least evidence without which a view that edge pairs placed is none
MAX_GAP = 2.33  # of the joints of a group to those of others [standard deviations of a normal]
SHOWN = 1e-9  # of the best known combination of shifts, from which on a group shows another one
SHIFT_COST = 0.25  # of a squared shift [standard deviations^-2]: half, as some are the pose's
GOOD_FIT = 0.85  # part of the evidence that outlines can give at most
CAUCHY_WIDTH = 2.0  # from which on a leg of an image counts less [standard deviations]
# Of the joints of a leg, and of one of which only single outlines were found: it may be another
MAX_SHIFT, MAX_LONE_SHIFT = 4.0, 2.5  # [standard deviations]
MAX_TURN_SIGMA = np.deg2rad(10.0)  # of a pose; before any outline it is TURN_SIGMA
NEAR_PX, NEAR_SIGMAS, MAX_NEAR_PX = 2.0, 3.0, 40.0  # where missing outlines are looked for


@dataclass(frozen=True, eq=False)
class ViewFit:
    """Where a group of views sees the legs, by outlines."""

    T_base_group: RigidTransform  # the camera pose
    shift: Array  # (n_legs, 2, 3) of A and B against the model, in the base link [m]
    covariance: Array  # (6 + 6 n_legs,) squared: of the motion of the machine about its middle in
    # the frame of the group, rotation vector and displacement, and of the shifts [rad, m]
    joint_sigma: float  # of the joint centres of the model, as the legs show it [m]
    image_sigma: float  # of the platform joints in an image besides [m]
    row: IntArray  # (n,) legs in images that have outlines
    leg: IntArray  # (n,)
    n_outlines: IntArray  # (n,) how many of each
    offset: Array  # (n, 3) shift of B in their images [m]
    distance: Array  # (n,) how far their outlines are from the fit, in standard deviations
    middle: Array  # (3,) of the machine in the base link [m]
    evidence: float  # what it is worth that each outline was found near where the fit has it, less
    # half of the squares of how far they are off and of the shifts

    @property
    def is_good(self) -> bool:
        """Whether nearly all outlines agree with the fit as well as they can."""
        most = OUTLINE_EVIDENCE * np.minimum(self.n_outlines, MAX_OUTLINES).sum()
        return self.evidence >= GOOD_FIT * float(most)

    @property
    def outliers(self) -> BoolArray:
        """Legs in images that are too far from where the other legs have them, (n,)."""
        shift = np.abs(self.shift).max(axis=(1, 2)) / self.joint_sigma
        alone = np.ones(len(self.shift), dtype=np.bool_)
        alone[self.leg[self.n_outlines > 1]] = False
        far = shift > np.where(alone, MAX_LONE_SHIFT, MAX_SHIFT)
        return np.asarray((self.distance > OUTLIER_SIGMAS) | far[self.leg])

    def joints(self, A_base: Array, B_base: Array) -> tuple[Array, Array]:
        """Return joint centres (n_rows, n_legs, 3) where the images of the group see them [m]."""
        B = B_base + self.shift[:, 1]
        B[self.row, self.leg] += self.offset
        return A_base + self.shift[:, 0], B

    @property
    def is_determined(self) -> bool:
        """Whether the outlines determine the pose about every axis: else legs may be others."""
        return bool(np.linalg.eigvalsh(self.covariance[:3, :3])[-1] <= MAX_TURN_SIGMA**2)


@dataclass(frozen=True, eq=False)
class _State:
    """The unknowns of the fit of a group."""

    pose: Frames  # (1,) of the machine in the frame of the group, its origin at the middle
    shift: Array  # (n_legs, 2, 3) of A and B of the legs against the model, in the base link [m]
    offset: Array  # (n_items, 3) shift of B of each leg in its image [m]


def fit_view(
    search: Search,
    group: Group,
    T_base_group: RigidTransform,
    shift: Array,
    outlines: Outlines,
) -> ViewFit | None:
    """Fit the camera and the joints of a group of views to its used outlines.

    From where they were recognised, with shifts (n_legs, 2, 3) of A and B against the model [m].
    None without any outline.
    """
    lines = _lines_of(search, group, outlines)
    if lines is None:
        return None
    middle = np.concatenate([lines.A, lines.B]).mean(axis=0)
    T = T_base_group.inv()
    pose = Frames(T.rotation.as_matrix()[None], T.apply(middle)[None])
    state = _State(pose, shift, np.zeros((lines.n_items, 3)))
    problem = _problem(group, lines, state, middle)
    weight = np.ones(lines.n_items)
    size, usual = search.size, search.joint_error * search.size
    joint_sigma, image_sigma = usual, IMAGE_SIGMA * size
    known = search.shift_whitening
    try:
        linear = linearize(problem, state)
        for iteration in range(ITERATIONS):
            normal = _normal_equations(linear, weight, _whitening(known, joint_sigma), image_sigma)
            step, _ = normal.step(0.0)
            distance = float(np.linalg.norm(state.pose.t))
            overshoot = max(
                float(np.linalg.norm(step[:3])) / MAX_TURN,
                float(np.linalg.norm(step[3:6])) / (MAX_DISPLACEMENT * distance),
                1.0,
            )
            state = problem.moved(state, step / overshoot)
            linear = linearize(problem, state)
            rows = linear["outlines"]
            square, offset_square = _squared_distances(lines, rows, state.offset, image_sigma)
            weight = cauchy_weights(square / (lines.size * CAUCHY_WIDTH**2))
            if iteration >= FIXED_ITERATIONS:  # most legs and images are alike
                variance = np.diag(normal.kept_covariance())[6:].reshape(state.shift.shape)
                of_leg = np.mean(state.shift**2 + variance, axis=(1, 2))[np.unique(lines.item_leg)]
                of_image = np.sum(weight * offset_square) / (3.0 * weight.sum())
                joint_sigma, image_sigma = (
                    float(np.clip(np.sqrt(variance), size * bounds[0], size * bounds[1]))
                    for variance, bounds in (
                        (np.median(of_leg), JOINT_SIGMA_BOUNDS),
                        (of_image, IMAGE_SIGMA_BOUNDS),
                    )
                )
    except NotVisible:
        return None
    normal = _normal_equations(linear, weight, _whitening(known, joint_sigma), image_sigma)
    R = state.pose.R[0]
    T_group_base = RigidTransform.from_components(
        state.pose.t[0] - R @ middle, Rotation.from_matrix(R)
    )
    return ViewFit(
        T_group_base.inv(),
        state.shift,
        normal.kept_covariance(),
        joint_sigma,
        image_sigma,
        lines.item_row,
        lines.item_leg,
        lines.size // 2,
        state.offset,
        np.sqrt(square / lines.size),
        middle,
        _evidence(lines, linear, state, _whitening(known, max(joint_sigma, usual)), size),
    )


def _problem(
    group: Group, lines: "_Lines", start: _State, middle: Array
) -> EstimationProblem[_State]:
    """Return the problem of a group; weights and sigmas of its priors are put on its rows later."""
    n_legs, every_item = len(start.shift), np.arange(lines.n_items)
    R, centre = start.pose.R[0], start.pose.t[0]
    distance = float(np.linalg.norm(centre))

    def pose_from_start(pose: Frames) -> Array:
        turn = Rotation.from_matrix(pose.R[0] @ R.T).as_rotvec()
        return np.concatenate([turn, pose.t[0] - centre])

    prior_sigma = np.concatenate([np.full(3, TURN_SIGMA), np.full(3, DISTANCE_SIGMA * distance)])
    prior = GaussianPrior(np.arange(6, dtype=np.intp), np.zeros(6), prior_sigma)
    pose = Variables("pose", all_free(1, 6), Frames.moved, coordinates=pose_from_start, prior=prior)

    def offset_rows(state: _State) -> Residuals:
        J_element = np.broadcast_to(np.eye(3), (lines.n_items, 3, 3))
        return Residuals.of(state.offset, np.zeros((lines.n_items, 3, 0)), J_element)

    def shift_rows(state: _State) -> Residuals:
        J = np.broadcast_to(np.eye(6), (n_legs, 6, 6))
        return Residuals.of(state.shift.reshape(n_legs, 6), J)

    every = slice(None)
    n = len(lines.leg)
    touches = ("pose", np.zeros(n, dtype=np.intp), every), ("shift", lines.leg, every)
    return EstimationProblem(
        (pose, Variables("shift", all_free(n_legs, 6))),
        Variables("offset", all_free(lines.n_items, 3)),
        (
            Factor(
                "outlines",
                lambda state: _outline_rows(group, lines, state, middle),
                touches,
                n,
                2,
                lines.item,
                lines.whitening,
            ),
            Factor("offsets", offset_rows, (), lines.n_items, 3, every_item),
            Factor("shifts", shift_rows, (("shift", np.arange(n_legs), every),), n_legs, 6),
        ),
    )


def _outline_rows(group: Group, lines: "_Lines", state: _State, middle: Array) -> Residuals:
    """Return offsets (n, 2) of outlines [px], with derivatives by pose and shift, and by offset."""
    R, centre = state.pose.R[0], state.pose.t[0]
    A = (lines.A + state.shift[lines.leg, 0] - middle) @ R.T + centre
    B = (lines.B + state.shift[lines.leg, 1] + state.offset[lines.item] - middle) @ R.T + centre
    px, D = np.empty((len(A), 2)), np.empty((len(A), 2, 2, 3))
    for v in np.unique(lines.view).tolist():
        here, T = lines.view == v, group.T_group_camera[v].inv()
        R_view = T.rotation.as_matrix()
        X = np.stack([A[here], B[here]], axis=1) @ R_view.T + T.translation
        args = lines.radius[here], lines.edge[here], lines.ends[here], lines.metric[here]
        px[here], at_camera = _offsets_of(X, *args)
        D[here] = at_camera @ R_view
    J = _derivatives_by(D, np.stack([A, B], axis=1) - centre, R)
    return Residuals.of(px, J[..., :12], J[..., 12:])


def _normal_equations(
    linear: Linearization[EstimationProblem[_State], _State],
    weight: Array,
    of_shifts: Array,
    image_sigma: float,
) -> NormalEquations[EstimationProblem[_State], _State]:
    """Return the normal equations with weights (n_items,) of legs in images, by their priors.

    ``of_shifts`` whitens shifts; offsets in images have one standard deviation [m]. A weight is
    that of all that an image says of a leg, the prior of its offset included.
    """
    root = np.sqrt(weight)
    item = linear.problem.factor("outlines").element
    rows = {
        "outlines": linear["outlines"].whitened(root[item][:, None, None]),
        "offsets": linear["offsets"].whitened((root / image_sigma)[:, None, None]),
        "shifts": linear["shifts"].whitened(of_shifts),
    }
    return information(replace(linear, rows=rows))


def _whitening(known: Array | None, joint_sigma: float) -> Array:
    """Return what whitens shifts of joints: what is known of them, or one standard deviation."""
    return np.asarray(1.0 / joint_sigma) if known is None else known


def _squared_distances(
    lines: "_Lines", rows: Residuals, offset: Array, sigma: float
) -> tuple[Array, Array]:
    """Return squared distances of items from the fit, and squares of their offsets [m^2].

    Both with the offsets that suit best by a prior of a standard deviation [m].
    """
    J = rows.J_element
    r = rows.r - (J @ offset[lines.item][..., None])[..., 0]
    Jt = J.swapaxes(1, 2)
    H, g = lines.summed(Jt @ J), lines.summed((Jt @ r[..., None])[..., 0])
    square = lines.summed(np.sum(r**2, axis=1))
    V = np.linalg.inv(H + np.eye(3) / sigma**2)
    best = -(V @ g[..., None])[..., 0]
    return square + np.sum(g * best, axis=1), np.sum(best**2, axis=1) + np.trace(
        V, axis1=1, axis2=2
    )


def _evidence(
    lines: "_Lines",
    linear: Linearization[EstimationProblem[_State], _State],
    state: _State,
    of_shifts: Array,
    size: float,
) -> float:
    """Return the evidence of outlines for a state, by leg and image."""
    square, _ = _squared_distances(lines, linear["outlines"], state.offset, IMAGE_SIGMA * size)
    n_outlines = np.minimum(0.5 * lines.size, MAX_OUTLINES)
    of_legs = np.maximum(OUTLINE_EVIDENCE * n_outlines - 0.5 * square, 0.0).sum()
    shifts = linear["shifts"].whitened(of_shifts).r
    return float(of_legs - SHIFT_COST * np.sum(shifts**2))


def with_common_shift(search: Search, fits: Sequence[ViewFit]) -> tuple[Search, Array, BoolArray]:
    """Return the search with the joints where fits of several groups have them.

    Besides their shifts (n_legs, 2, 3) of A and B [m], and which fits these come from. All groups
    show one machine: what the outlines of each say besides its prior adds up, but for those that
    contradict the others. Motions of all joints as one body are the cameras'.
    """
    usual, n = search.joint_error * search.size, 6 * search.n_legs
    prior = np.eye(n) / usual**2
    inverse = np.linalg.inv([fit.covariance[6:, 6:] for fit in fits])
    own_sigma = np.array([fit.joint_sigma for fit in fits])
    weights = inverse - np.eye(n) / own_sigma[:, None, None] ** 2
    told = np.stack([of @ fit.shift.ravel() for of, fit in zip(inverse, fits, strict=True)])
    agree = _agreeing(prior, weights, told)
    N, b = prior + weights[agree].sum(axis=0), told[agree].sum(axis=0)
    A, B = search.A_base.mean(axis=0), search.B_base.mean(axis=0)
    X = np.stack([A, B], axis=1).reshape(-1, 3)
    turns = -cross_matrices(X - X.mean(axis=0)).reshape(n, 3)
    rigid = np.linalg.qr(np.hstack([np.tile(np.eye(3), (len(X), 1)), turns]))[0]
    own = np.eye(n) - rigid @ rigid.T
    covariance = np.linalg.inv(N)
    shift = (covariance @ b).reshape(search.n_legs, 2, 3)
    legs = np.arange(search.n_legs)
    of_legs = (own @ covariance @ own).reshape(search.n_legs, 6, search.n_legs, 6)[legs, :, legs]
    of_legs += (IMAGE_SIGMA * search.size) ** 2 * np.eye(6)
    u = (B - A) / np.linalg.norm(B - A, axis=1)[:, None]
    ends = np.stack([of_legs[:, :3, :3], of_legs[:, 3:, 3:]], axis=1)
    across = np.trace(ends, axis1=2, axis2=3) - np.einsum("li,leij,lj->le", u, ends, u)
    moved = replace(
        search,
        A_base=search.A_base + shift[:, 0],
        B_base=search.B_base + shift[:, 1],
        joint_error=min(float(np.sqrt(across.mean() / 2.0)) / search.size, search.joint_error),
        shift_whitening=whitener(of_legs),
    )
    return moved, shift, agree


def _agreeing(prior: Array, weights: Array, told: Array) -> BoolArray:
    """Return which of some sources agree with the others: the farthest goes while one does not.

    From the inverse covariance (n, n) of a common prior, and the normal equations (m, n, n), (m, n)
    of each source. Of two that disagree nobody knows which is wrong.
    """
    agree = np.ones(len(told), dtype=np.bool_)
    while agree.sum() > 2:
        gaps = np.full(len(told), -np.inf)
        for k in np.flatnonzero(agree).tolist():
            others = np.linalg.inv(prior + weights[agree].sum(axis=0) - weights[k])
            gap = told[k] - weights[k] @ others @ (told[agree].sum(axis=0) - told[k])
            variance, axes = np.linalg.eigh(weights[k] + weights[k] @ others @ weights[k])
            shown = variance > SHOWN * variance[-1]
            square = np.sum((gap @ axes[:, shown]) ** 2 / variance[shown])
            # As probabilities of large squares are zero, by Wilson and Hilferty's (1931) roots.
            spread = 2.0 / (9.0 * shown.sum())
            gaps[k] = (np.cbrt(square / shown.sum()) - (1.0 - spread)) / np.sqrt(spread)
        if gaps.max() <= MAX_GAP:
            break
        agree[np.argmax(gaps)] = False
    return agree


def min_evidence(group: Group) -> float:
    """Return the required evidence of outlines: more images agree more by chance."""
    return EVIDENCE * (1.0 + EVIDENCE_OF_IMAGE * len(group.rows))


def sideways_sigmas(search: Search, group: Group, fit: ViewFit) -> Array:
    """Return the standard deviations of predicted legs in images, (n_rows, n_legs) [px].

    One standard deviation across each leg, at the joint where it is known worse; infinite for
    legs that reach behind the camera, and in images of other views.
    """
    m, n_legs = search.measurements, search.n_legs
    A, B = fit.joints(search.A_base, search.B_base)
    T_group_base = fit.T_base_group.inv()
    centre = T_group_base.apply(fit.middle)
    sigma = np.full((m.n_rows, n_legs), np.inf)
    for v in group.views:
        rows = [row for row in group.rows if m.view[row] == v]
        T, camera = group.T_group_camera[v].inv(), m.views[v].camera
        X_group = T_group_base.apply(np.stack([A[rows], B[rows]], axis=2).reshape(-1, 3))
        X = T.apply(X_group).reshape(-1, 2, 3)
        front = X[..., 2].min(axis=1) > MIN_DEPTH * search.size
        X = np.where(front[:, None, None], X, [[0.0, 0.0, 1.0], [0.0, 1.0, 1.0]])
        ends = X[..., :2] / X[..., 2:]
        thin, edge = np.zeros(len(X)), np.zeros(len(X), dtype=np.intp)
        D = _offsets_of(X, thin, edge, ends, _metric_of(camera, ends))[1] @ T.rotation.as_matrix()
        J = _derivatives_by(
            D, X_group.reshape(-1, 2, 3) - centre, T_group_base.rotation.as_matrix()
        )
        leg = np.tile(np.arange(n_legs), len(rows))
        place = np.concatenate(
            [np.broadcast_to(np.arange(6), (len(leg), 6)), 6 + 6 * leg[:, None] + np.arange(6)], 1
        )
        of_leg = fit.covariance[place[:, :, None], place[:, None, :]]
        variance = np.einsum("nei,nij,nej->ne", J[..., :12], of_leg, J[..., :12])
        variance += fit.image_sigma**2 * np.sum(J[..., 12:] ** 2, axis=-1)
        worst = np.sqrt(variance.max(axis=1))
        sigma[rows] = np.where(front, worst, np.inf).reshape(len(rows), n_legs)
    return sigma


@dataclass(frozen=True, eq=False)
class _Lines:
    """Outlines to fit, by item: a leg in an image."""

    view: IntArray  # (n,)
    item: IntArray  # (n,)
    leg: IntArray  # (n,)
    A: Array  # (n, 3) by the model, in the base link [m]
    B: Array
    radius: Array  # (n,)
    edge: IntArray  # (n,) 0 where epsilon is +1, 1 where it is -1
    ends: Array  # (n, 2, 2) on the sensor plane
    metric: Array  # (n, 2, 2, 2), see _metric_of
    whitening: Array  # (n, 2, 2)
    item_row: IntArray  # (n_items,)
    item_leg: IntArray
    first: IntArray  # (n_items,) its first outline; the outlines of an item are consecutive
    size: IntArray  # (n_items,) offsets that were measured

    @property
    def n_items(self) -> int:
        """Number of legs in images."""
        return len(self.item_row)

    def summed(self, values: Array) -> Array:
        """Return sums of values (n, ...) over the outlines of each item, (n_items, ...)."""
        return np.asarray(np.add.reduceat(values, self.first, axis=0))


def _lines_of(search: Search, group: Group, outlines: Outlines) -> _Lines | None:
    """Return the used outlines of a group."""
    of_leg = [main_cylinders(cylinders) for cylinders in search.cylinders]
    parts = zip(outlines.leg.tolist(), outlines.part, strict=True)
    along = np.array([part in of_leg[j] for j, part in parts], dtype=np.bool_)  # no arm
    used = np.flatnonzero(outlines.used & along & np.isin(outlines.row, group.rows))
    if len(used) == 0:
        return None
    used = used[np.lexsort([outlines.leg[used], outlines.row[used]])]
    row, leg = outlines.row[used], outlines.leg[used]
    places = zip(leg.tolist(), used.tolist(), strict=True)
    radius = np.array([of_leg[j][outlines.part[i]].radius for j, i in places])
    view = search.measurements.view[row]
    ends, metric = np.empty((len(used), 2, 2)), np.empty((len(used), 2, 2, 2))
    for v in np.unique(view).tolist():
        own, camera = view == v, search.measurements.views[v].camera
        ends[own] = camera.undistort(outlines.ends[used[own]])
        metric[own] = _metric_of(camera, ends[own])
    covariance = outlines.covariance[used] + OUTLINE_SIGMA_PX**2 * np.eye(2)
    begins = (np.diff(row, prepend=-1) != 0) | (np.diff(leg, prepend=-1) != 0)
    first = np.flatnonzero(begins)
    return _Lines(
        view,
        np.cumsum(begins) - 1,
        leg,
        search.A_base[row, leg],
        search.B_base[row, leg],
        radius,
        outlines.edge[used] - 1,
        ends,
        metric,
        whitener(covariance),
        row[first],
        leg[first],
        first,
        2 * np.diff(np.append(first, len(used))),
    )


def _offsets_of(
    X: Array, radius: Array, edge: IntArray, ends: Array, metric: Array
) -> tuple[Array, Array]:
    """Return the distances of points from outlines (n, 2) [px], with derivatives by A and B.

    Of the outlines (0 where epsilon is +1, 1 where it is -1) of cylinders with A and B (n, 2, 3) in
    the frame of the camera [m] and radii (n,), at two points (n, 2, 2) of the sensor plane with
    their :func:`_metric_of`.
    """
    A, B = X[:, 0], X[:, 1]
    u = B - A
    u /= np.linalg.norm(u, axis=-1, keepdims=True)
    h = outlines_of_axis(u, A, radius)[np.arange(len(X)), edge]  # (n, 3)
    value = np.einsum("nx,nex->ne", h[:, :2], ends) + h[:, 2:]
    normal = np.einsum("nexy,ny->nex", metric, h[:, :2])
    length = np.linalg.norm(normal, axis=-1)
    offset = value / length
    by_h = np.ones((len(X), 2, 3))
    by_h[..., :2] = ends - (offset / length)[..., None] * np.einsum("nexy,nex->ney", metric, normal)
    # A unit h with h.A = h.B = epsilon R stays one: dh = -(h.dA) a - (h.dB) b.
    dual = np.stack([cross(B, h), cross(h, A)], axis=2)
    dual /= np.sum(A * dual[..., 0], axis=1)[:, None, None]
    along = (by_h @ dual) / length[..., None]  # (n, 2 points, A and B)
    return offset, -along[..., None] * h[:, None, None]


def _metric_of(camera: Camera, ends: Array) -> Array:
    """Return the matrices that map normals of lines (..., 2) into the image at points (..., 2)."""
    return np.asarray(np.swapaxes(np.linalg.inv(camera.pixels_per_unit(ends)), -1, -2))


def _derivatives_by(D: Array, from_centre: Array, R: Array) -> Array:
    """Return derivatives (n, 2, 15) from those by A and B in the frame of the group."""
    turning = cross(from_centre[:, None], D).sum(axis=2)
    in_base = D @ R
    of_A, of_B = in_base[:, :, 0], in_base[:, :, 1]
    return np.concatenate([turning, D.sum(axis=2), of_A, of_B, of_B], axis=-1)


Fits = list[ViewFit | None]  # of groups; None where one was not placed or has no outlines


def refine_views(
    search: Search,
    groups: Sequence[Group],
    placement: Placement,
    outlines: Outlines,
    *,
    in_brief: bool = False,
    run: Run = in_turn,
    progress: Callable[[int], None] | None = None,
) -> tuple[Placement, Outlines, Fits]:
    """Fit all views to their outlines, and look for the legs that are missing near that.

    Return cameras and joint centres by the outlines, the outlines that agree with them (what was
    looked for and not found keeps its reason), and the fits.
    """
    fits = _fits_or_reversed(search, groups, placement, outlines)
    placement = _placed_by_fits(search, groups, placement, fits)
    outlines, fits = _without_outliers(search, groups, placement, outlines, fits)
    placement = _placed_by_fits(search, groups, placement, fits)
    near = replace(placement, window=_windows(search, groups, fits, outlines))
    rows = sorted(row for group in groups for row in group.rows)
    again, _ = measure_outlines(search, near, rows, in_brief=in_brief, run=run, progress=progress)
    measured = set(zip(again.row[again.used].tolist(), again.leg[again.used].tolist(), strict=True))
    kept = outlines.choose(~_among(outlines, measured))
    outlines = join_outlines([kept, again.choose(_among(again, measured))])
    fits = _fits(search, groups, placement, outlines, fits, {row for row, _ in measured})
    outlines, fits = _without_outliers(search, groups, placement, outlines, fits)
    placement = _without_weak_views(
        search, groups, _placed_by_fits(search, groups, placement, fits), fits
    )
    placed = np.array([T is not None for T in placement.T_base_camera])
    unplaced_rows = ~placed[search.measurements.view[outlines.row]]
    return placement, outlines.reject(unplaced_rows & ~is_edited(outlines), Reason.NOT_PLACED), fits


def _fits(
    search: Search,
    groups: Sequence[Group],
    placement: Placement,
    outlines: Outlines,
    before: Fits,
    changed: set[int],
) -> Fits:
    """Return the fit of each group; those before stand where no row of a group has changed."""
    fits = before.copy()
    for g, group in enumerate(groups):
        v = group.views[0]
        T = placement.T_base_camera[v]
        if T is not None and not changed.isdisjoint(group.rows):
            T_base_group = T * group.T_group_camera[v].inv()
            fits[g] = fit_view(search, group, T_base_group, placement.shift[v], outlines)
    return fits


def _fits_or_reversed(
    search: Search, groups: Sequence[Group], placement: Placement, outlines: Outlines
) -> Fits:
    """Return fits, with near and far exchanged where outlines suit that better."""
    every = {row for group in groups for row in group.rows}
    fits = _fits(search, groups, placement, outlines, [None] * len(groups), every)
    for g, (group, fit) in enumerate(zip(groups, fits, strict=True)):
        if fit is None or len(group.views) > 1 or fit.is_good:
            continue
        X = np.concatenate([search.A_base[group.rows], search.B_base[group.rows]]).reshape(-1, 3)
        pose = CameraPoses.one(fit.T_base_group, np.zeros((search.n_legs, 2, 3)))
        other = depth_reversed(pose, X).T_base_camera()
        over = fit_view(search, group, other, np.zeros_like(fit.shift), outlines)
        if over is not None and over.evidence > fit.evidence:
            fits[g] = over
    return fits


def _without_outliers(
    search: Search,
    groups: Sequence[Group],
    placement: Placement,
    outlines: Outlines,
    fits: Fits,
) -> tuple[Outlines, Fits]:
    """Return outlines without legs that do not fit, and the fits to the others."""
    wrong = {
        one
        for fit in fits
        if fit is not None
        for one in zip(fit.row[fit.outliers].tolist(), fit.leg[fit.outliers].tolist(), strict=True)
    }
    if not wrong:
        return outlines, fits
    out = _among(outlines, wrong) & ~is_edited(outlines)  # edited outlines stay
    outlines = outlines.reject(out, Reason.VIEW_DISAGREES)
    return outlines, _fits(search, groups, placement, outlines, fits, {row for row, _ in wrong})


def _placed_by_fits(
    search: Search, groups: Sequence[Group], placement: Placement, fits: Fits
) -> Placement:
    """Return cameras and joint centres by the fits; other groups stay as recognised."""
    T, shift = dict(enumerate(placement.T_base_camera)), placement.shift.copy()
    for group, fit in zip(groups, fits, strict=True):
        if fit is not None:
            T |= group.cameras(fit.T_base_group)
            shift[group.views] = fit.shift
    recognised = placement.shifted(search, shift)
    A, B = placement.A_base.copy(), placement.B_base.copy()
    for group, fit in zip(groups, fits, strict=True):
        joints = recognised.A_base, recognised.B_base
        if fit is not None:
            joints = fit.joints(search.A_base, search.B_base)
        A[group.rows], B[group.rows] = (X[group.rows] for X in joints)
    return replace(recognised, T_base_camera=tuple(T.values()), A_base=A, B_base=B)


def _without_weak_views(
    search: Search, groups: Sequence[Group], placement: Placement, fits: Fits
) -> Placement:
    """Return cameras without those for which hardly an outline speaks, near no rough pose."""
    T, unplaced = dict(enumerate(placement.T_base_camera)), dict(placement.unplaced)
    for group, fit in zip(groups, fits, strict=True):
        least = WEAK * min_evidence(group)
        is_sure = fit is not None and fit.is_determined and fit.evidence >= least
        if group.hint is not None or T[group.views[0]] is None or is_sure:
            continue
        n, n_images = 0 if fit is None else int(fit.n_outlines.sum()), len(group.rows)
        remedy = "add images at other readings, in better light, or a rough T_base_camera"
        if len(group.views) > 1:
            remedy = (
                "check the dimensions of the board in dataset.yaml, by which these views stand to "
                "each other; else add images in better light"
            )
        why = Cause(
            "its camera could not be placed: found only {} outlines that agree in its {} image"
            f"{'s' * (n_images != 1)}, needed more than other edges give by chance; {remedy}.",
            (n, n_images),
        )
        unplaced |= group.not_placed(search.measurements, why)
        T |= dict.fromkeys(group.views)
    return replace(placement, T_base_camera=tuple(T.values()), unplaced=unplaced)


def _windows(search: Search, groups: Sequence[Group], fits: Fits, outlines: Outlines) -> Array:
    """Return the tolerance of missing legs about a fit (n_rows, n_legs) [px]; NaN for others."""
    missing = np.zeros((search.measurements.n_rows, search.n_legs), dtype=np.bool_)
    visible = ~outlines.rejected_for(Reason.OUTSIDE, Reason.NOT_PLACED)
    missing[outlines.row[visible], outlines.leg[visible]] = True
    missing[outlines.row[outlines.used], outlines.leg[outlines.used]] = False
    window = np.full(missing.shape, np.nan)
    for group, fit in zip(groups, fits, strict=True):
        if fit is not None and missing[group.rows].any():
            sigma = sideways_sigmas(search, group, fit)[group.rows]
            near = np.minimum(NEAR_PX + NEAR_SIGMAS * sigma, MAX_NEAR_PX)
            window[group.rows] = np.where(missing[group.rows], near, np.nan)
    return window


def _among(outlines: Outlines, legs: set[tuple[int, int]]) -> BoolArray:
    """Return the mask of outlines of some legs in images, (row, leg)."""
    own = zip(outlines.row.tolist(), outlines.leg.tolist(), strict=True)
    return np.array([one in legs for one in own], dtype=np.bool_)
