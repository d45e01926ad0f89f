"""The camera of a view and its legs, fitted to outlines that were measured once.

Edge pairs place a camera to some millimetres and leave out legs that have none. Outlines are far
better known: a fit of the camera, of where the view sees the joints, and of what each image adds to
the platform joints says where all legs are, how well that is known, and which legs do not fit.
"""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import RigidTransform, Rotation

from legcal.data import Outlines
from legcal.errors import NotVisible
from legcal.geometry import Array, BoolArray, IntArray
from legcal.machine import main_cylinders
from legcal.perception.agreement import NEAREST, Poses, exchanged
from legcal.perception.placement import Group, Search
from legcal.vision import Camera, outlines_of_axis

JOINT_SIGMA = 6e-3  # of the joint centres of the nominal model in all images, at first [m]
JOINT_SIGMAS = 1.5e-3, 12e-3  # the least and the largest that legs may show
IMAGE_SIGMA = 2e-3  # of the platform joints in an image besides, at first [m]
IMAGE_SIGMAS = 0.7e-3, 12e-3  # the least and the largest that images may show
TURN_SIGMA, PLACE_SIGMA = 0.3, 0.15  # of the pose that was recognised: angle, part of the distance
MOST_TURN, MOST_PLACE = 0.2, 0.1  # of a step: angle, part of the distance
STEPS, FIXED_STEPS = 8, 2  # of Gauss-Newton, and those before standard deviations are estimated
ROBUST = 2.0  # standard deviations from which on a leg of an image counts less
WORTH, MOST_OUTLINES = 2.0, 4  # of an outline as evidence: half a square, of a leg in an image
MISFIT = 3.5  # standard deviations from the fit, of a leg in an image
LARGEST_SHIFT = 4.0  # of a leg, in standard deviations
LONE_SHIFT = 2.5  # the same of a leg of which only single outlines were found
MOST_TURN_SIGMA = np.deg2rad(10.0)  # of a pose; before any outline it is TURN_SIGMA
SUITS = 0.85  # of the most evidence that outlines can give
SHIFT_COST = 0.25  # of shifts, less than half a square: some are the pose's
LEAST_EVIDENCE = 8.0, 1.2  # and for each image
EDGE_SIGMA = 0.3  # of an outline: what its covariance does not know, as a wrong gamma [px]
NUDGE = 1e-6  # of finite differences [m]


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
    own: Array  # (n, 3) what their images add to B [m]
    distance: Array  # (n,) how far their outlines are from the fit, in standard deviations
    middle: Array  # (3,) of the machine in the base link [m]
    evidence: float  # what it is worth that each outline was found near where the fit has it, less
    # half of the squares of how far they are off and of the shifts

    @property
    def suits(self) -> bool:
        """Whether nearly all outlines suit the fit as well as they can."""
        most = WORTH * np.minimum(self.n_outlines, MOST_OUTLINES).sum()
        return self.evidence >= SUITS * float(most)

    @property
    def misfits(self) -> BoolArray:
        """Legs in images that are too far from where the other legs have them, (n,)."""
        shift = np.abs(self.shift).max(axis=(1, 2)) / self.joint_sigma
        alone = np.ones(len(self.shift), dtype=np.bool_)
        alone[self.leg[self.n_outlines > 1]] = False
        far = shift > np.where(alone, LONE_SHIFT, LARGEST_SHIFT)
        return np.asarray((self.distance > MISFIT) | far[self.leg])

    def joints(self, A_base: Array, B_base: Array) -> tuple[Array, Array]:
        """Return joint centres (n_rows, n_legs, 3) where the images of the group see them [m]."""
        B = B_base + self.shift[:, 1]
        B[self.row, self.leg] += self.own
        return A_base + self.shift[:, 0], B

    @property
    def is_determined(self) -> bool:
        """Whether the outlines tell the pose from those around it: else legs may be others."""
        return bool(self.turn_sigma <= MOST_TURN_SIGMA)

    @property
    def turn_sigma(self) -> float:
        """Standard deviation of the rotation about the axis that is known worst [rad]."""
        return float(np.sqrt(np.linalg.eigvalsh(self.covariance[:3, :3])[-1]))


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
    lines = lines_of(search, group, outlines)
    if lines is None:
        return None
    middle = np.concatenate([lines.A, lines.B]).mean(axis=0)
    T = T_base_group.inv()
    begin = _State(T.rotation.as_matrix(), T.translation, shift, np.zeros((lines.n_items, 3)))
    state, weight = begin, np.ones(lines.n_items)
    joint_sigma, image_sigma = JOINT_SIGMA, IMAGE_SIGMA
    try:
        equations = equations_of(group, lines, state, middle)
        for step in range(STEPS):
            sigmas = joint_sigma, image_sigma
            normal = _normal_equations(lines, equations, state, begin, weight, sigmas, middle)
            state = _moved(state, normal, lines, middle)
            equations = equations_of(group, lines, state, middle)
            square, own_square = _squared_distances(lines, equations, state, image_sigma)
            weight = 1.0 / (1.0 + square / (lines.size * ROBUST**2))
            if step >= FIXED_STEPS:  # most legs and images are alike
                variance = np.diag(np.linalg.inv(normal.H))[6:].reshape(state.shift.shape)
                of_leg = np.mean(state.shift**2 + variance, axis=(1, 2))[np.unique(lines.item_leg)]
                of_image = np.sum(weight * own_square) / (3.0 * weight.sum())
                joint_sigma = float(np.clip(np.sqrt(np.median(of_leg)), *JOINT_SIGMAS))
                image_sigma = float(np.clip(np.sqrt(of_image), *IMAGE_SIGMAS))
    except NotVisible:
        return None
    sigmas = joint_sigma, image_sigma
    normal = _normal_equations(lines, equations, state, begin, weight, sigmas, middle)
    pose = Poses(state.R[None], state.t[None], state.shift[None])
    return ViewFit(
        pose.T_base_camera(),
        state.shift,
        np.asarray(np.linalg.inv(normal.H), dtype=np.float64),
        joint_sigma,
        image_sigma,
        lines.item_row,
        lines.item_leg,
        lines.size // 2,
        state.own,
        np.sqrt(square / lines.size),
        middle,
        _evidence(lines, equations, state, joint_sigma),
    )


def least_evidence(group: Group) -> float:
    """Return how much evidence outlines must give: more images show more that suits by chance."""
    return LEAST_EVIDENCE[0] + LEAST_EVIDENCE[1] * len(group.rows)


def sideways_sigmas(search: Search, group: Group, fit: ViewFit) -> Array:
    """Return how well a fit knows where legs are seen, (n_rows, n_legs) [px].

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
        front = X[..., 2].min(axis=1) > NEAREST
        X = np.where(front[:, None, None], X, [[0.0, 0.0, 1.0], [0.0, 1.0, 1.0]])
        ends = X[..., :2] / X[..., 2:]
        thin, edge = np.zeros(len(X)), np.zeros(len(X), dtype=np.intp)
        D = offsets_of(X, thin, edge, ends, metric_of(camera, ends))[1] @ T.rotation.as_matrix()
        J = derivatives_by(D, X_group.reshape(-1, 2, 3) - centre, T_group_base.rotation.as_matrix())
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


def reversed_pose(search: Search, group: Group, T_base_group: RigidTransform) -> RigidTransform:
    """Return the pose at which a flat machine looks alike from far: near and far exchanged."""
    X = np.concatenate([search.A_base[group.rows], search.B_base[group.rows]]).reshape(-1, 3)
    pose = Poses.one(T_base_group, np.zeros((search.n_legs, 2, 3)))
    return exchanged(pose, X).T_base_camera()


@dataclass(frozen=True, eq=False)
class Lines:
    """Outlines to fit, by item: a leg in an image."""

    view: IntArray  # (n,)
    item: IntArray  # (n,)
    leg: IntArray  # (n,)
    A: Array  # (n, 3) by the model, in the base link [m]
    B: Array
    radius: Array  # (n,)
    edge: IntArray  # (n,) 0 where epsilon is +1, 1 where it is -1
    ends: Array  # (n, 2, 2) on the sensor plane
    metric: Array  # (n, 2, 2, 2), see metric_of
    whitening: Array  # (n, 2, 2)
    item_row: IntArray  # (n_items,)
    item_leg: IntArray
    first: IntArray  # (n_items,) its first outline: those of an item follow each other
    size: IntArray  # (n_items,) offsets that were measured

    @property
    def n_items(self) -> int:
        """Number of legs in images."""
        return len(self.item_row)

    def summed(self, values: Array) -> Array:
        """Return sums of values (n, ...) over the outlines of each item, (n_items, ...)."""
        return np.asarray(np.add.reduceat(values, self.first, axis=0))


def lines_of(search: Search, group: Group, outlines: Outlines) -> Lines | None:
    """Return the used outlines of a group."""
    used = np.flatnonzero(outlines.used & np.isin(outlines.row, group.rows))
    if len(used) == 0:
        return None
    used = used[np.lexsort([outlines.leg[used], outlines.row[used]])]
    row, leg = outlines.row[used], outlines.leg[used]
    of_leg = [main_cylinders(cylinders) for cylinders in search.cylinders]
    parts = zip(leg.tolist(), used.tolist(), strict=True)
    radius = np.array([of_leg[j][outlines.part[i]].radius for j, i in parts])
    view = search.measurements.view[row]
    ends, metric = np.empty((len(used), 2, 2)), np.empty((len(used), 2, 2, 2))
    for v in np.unique(view).tolist():
        own, camera = view == v, search.measurements.views[v].camera
        ends[own] = camera.undistort(outlines.ends[used[own]])
        metric[own] = metric_of(camera, ends[own])
    covariance = outlines.covariance[used] + EDGE_SIGMA**2 * np.eye(2)
    begins = (np.diff(row, prepend=-1) != 0) | (np.diff(leg, prepend=-1) != 0)
    first = np.flatnonzero(begins)
    return Lines(
        view,
        np.cumsum(begins) - 1,
        leg,
        search.A_base[row, leg],
        search.B_base[row, leg],
        radius,
        outlines.edge[used] - 1,
        ends,
        metric,
        np.linalg.inv(np.linalg.cholesky(covariance)),
        row[first],
        leg[first],
        first,
        2 * np.diff(np.append(first, len(used))),
    )


def offsets_of(
    X: Array, radius: Array, edge: IntArray, ends: Array, metric: Array
) -> tuple[Array, Array]:
    """Return how far points are from outlines (n, 2) [px], and derivatives (n, 2, 2, 3) by A and B.

    Of the outlines (0 where epsilon is +1, 1 where it is -1) of cylinders with A and B (n, 2, 3) in
    the frame of the camera [m] and radii (n,), at two points (n, 2, 2) of the sensor plane with
    their :func:`metric_of`.
    """
    nudges = NUDGE * np.concatenate([np.zeros((1, 6)), np.eye(6)]).reshape(7, 1, 2, 3)
    moved = X + nudges
    u = moved[:, :, 1] - moved[:, :, 0]
    u /= np.linalg.norm(u, axis=-1, keepdims=True)
    both = outlines_of_axis(u, moved[:, :, 0], radius)
    h = both[:, np.arange(len(X)), edge]  # (7, n, 3)
    value = np.einsum("knx,nex->kne", h[..., :2], ends) + h[..., 2:]
    normal = np.einsum("nexy,kny->knex", metric, h[..., :2])
    offset = value / np.linalg.norm(normal, axis=-1)
    derivative = np.moveaxis((offset[1:] - offset[0]) / NUDGE, 0, -1)
    return offset[0], derivative.reshape(-1, 2, 2, 3)


def metric_of(camera: Camera, ends: Array) -> Array:
    """Return what makes normals of lines (..., 2) those in the picture at points (..., 2)."""
    return np.asarray(np.swapaxes(np.linalg.inv(camera.pixels_per_unit(ends)), -1, -2))


def derivatives_by(D: Array, from_centre: Array, R: Array) -> Array:
    """Return derivatives (n, 2, 15) from those by A and B in the frame of the group."""
    turning = np.cross(from_centre[:, None], D).sum(axis=2)
    in_base = D @ R
    of_A, of_B = in_base[:, :, 0], in_base[:, :, 1]
    return np.concatenate([turning, D.sum(axis=2), of_A, of_B, of_B], axis=-1)


class _State(NamedTuple):
    """Where everything is."""

    R: Array  # (3, 3) of T_group_base
    t: Array  # (3,)
    shift: Array  # (n_legs, 2, 3) of A and B of the legs against the model, in the base link [m]
    own: Array  # (n_items, 3) what its image adds to B of each leg [m]


class _Normal(NamedTuple):
    """Normal equations of the pose and the shifts, and what gives the images' own parts."""

    H: Array
    b: Array
    back: Array  # (n_items, 3, 12) own part by the other unknowns
    start: Array  # (n_items, 3) own part without them


def equations_of(group: Group, lines: Lines, state: _State, middle: Array) -> tuple[Array, Array]:
    """Return whitened offsets (n, 2) and their derivatives (n, 2, 15).

    By the motion of the machine about its middle, the shifts of A and B of the leg, and the own
    part of B.
    """
    A = (lines.A + state.shift[lines.leg, 0]) @ state.R.T + state.t
    B = (lines.B + state.shift[lines.leg, 1] + state.own[lines.item]) @ state.R.T + state.t
    offset, D = np.empty((len(A), 2)), np.empty((len(A), 2, 2, 3))
    for v in np.unique(lines.view).tolist():
        own, T = lines.view == v, group.T_group_camera[v].inv()
        R = T.rotation.as_matrix()
        X = np.stack([A[own], B[own]], axis=1) @ R.T + T.translation
        args = lines.radius[own], lines.edge[own], lines.ends[own], lines.metric[own]
        offset[own], at_camera = offsets_of(X, *args)
        D[own] = at_camera @ R
    centre = state.R @ middle + state.t
    J = derivatives_by(D, np.stack([A, B], axis=1) - centre, state.R)
    return (lines.whitening @ offset[..., None])[..., 0], lines.whitening @ J


def _normal_equations(
    lines: Lines,
    equations: tuple[Array, Array],
    state: _State,
    begin: _State,
    weight: Array,
    sigmas: tuple[float, float],
    middle: Array,
) -> _Normal:
    """Return the normal equations without the images' own parts, by sigmas of joints and images."""
    joint_sigma, image_sigma = sigmas
    residual, J = equations
    Jt = J.swapaxes(1, 2)
    M, b = lines.summed(Jt @ J), -lines.summed((Jt @ residual[..., None])[..., 0])
    M[:, 12:, 12:] += np.eye(3) / image_sigma**2
    b[:, 12:] -= state.own / image_sigma**2
    solved = np.linalg.solve(M[:, 12:, 12:], np.concatenate([M[:, 12:, :12], b[:, 12:, None]], -1))
    back, start = solved[..., :12], solved[..., 12]
    S = (M[:, :12, :12] - M[:, :12, 12:] @ back) * weight[:, None, None]
    c = (b[:, :12] - (M[:, :12, 12:] @ start[..., None])[..., 0]) * weight[:, None]
    n = 6 + state.shift.size
    H, g = np.zeros((n, n)), np.zeros(n)
    for leg in np.unique(lines.item_leg).tolist():
        own = lines.item_leg == leg
        place = np.r_[0:6, 6 + 6 * leg : 12 + 6 * leg]
        H[np.ix_(place, place)] += S[own].sum(axis=0)
        g[place] += c[own].sum(axis=0)
    turned = Rotation.from_matrix(state.R @ begin.R.T).as_rotvec()
    centre, before = (one.R @ middle + one.t for one in (state, begin))
    distance = float(np.linalg.norm(before))
    known = np.concatenate([np.full(3, TURN_SIGMA), np.full(3, PLACE_SIGMA * distance)]) ** -2
    H[np.arange(6), np.arange(6)] += known
    g[:6] -= known * np.concatenate([turned, centre - before])
    joints = np.arange(6, n)
    H[joints, joints] += joint_sigma**-2
    g[6:] -= state.shift.ravel() / joint_sigma**2
    return _Normal(H, g, back, start)


def _moved(state: _State, normal: _Normal, lines: Lines, middle: Array) -> _State:
    """Return the state after a step, not too far."""
    step = np.linalg.solve(normal.H, normal.b)
    centre = state.R @ middle + state.t
    distance = float(np.linalg.norm(centre))
    reach = max(
        float(np.linalg.norm(step[:3])) / MOST_TURN,
        float(np.linalg.norm(step[3:6])) / (MOST_PLACE * distance),
        1.0,
    )
    step = step / reach
    shifts = step[6:].reshape(-1, 6)
    of_item = np.concatenate([np.broadcast_to(step[:6], (lines.n_items, 6)),
                              shifts[lines.item_leg]], axis=1)  # fmt: skip
    own = state.own + normal.start - (normal.back @ of_item[..., None])[..., 0]
    turn = Rotation.from_rotvec(step[:3]).as_matrix()
    t = turn @ (state.t - centre) + centre + step[3:6]
    return _State(turn @ state.R, t, state.shift + shifts.reshape(state.shift.shape), own)


def _squared_distances(
    lines: Lines, equations: tuple[Array, Array], state: _State, sigma: float
) -> tuple[Array, Array]:
    """Return squared distances of items from the fit, and squares of their own parts [m^2]."""
    residual, J = equations
    Jo = J[..., 12:]
    r = residual - (Jo @ state.own[lines.item][..., None])[..., 0]
    Jt = Jo.swapaxes(1, 2)
    H, g = lines.summed(Jt @ Jo), lines.summed((Jt @ r[..., None])[..., 0])
    square = lines.summed(np.sum(r**2, axis=1))
    V = np.linalg.inv(H + np.eye(3) / sigma**2)
    own = -(V @ g[..., None])[..., 0]
    return square + np.sum(g * own, axis=1), np.sum(own**2, axis=1) + np.trace(V, axis1=1, axis2=2)


def _evidence(
    lines: Lines, equations: tuple[Array, Array], state: _State, joint_sigma: float
) -> float:
    """Return how much outlines speak for a state, each leg of an image by itself."""
    square, _ = _squared_distances(lines, equations, state, IMAGE_SIGMA)
    found = np.minimum(0.5 * lines.size, MOST_OUTLINES)
    of_legs = np.maximum(WORTH * found - 0.5 * square, 0.0).sum()
    joint = max(JOINT_SIGMA, joint_sigma)
    return float(of_legs - SHIFT_COST * np.sum(state.shift**2) / joint**2)
