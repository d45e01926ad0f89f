"""What is known of parameters before any image is looked at: those that are fixed, and priors."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from itertools import combinations, combinations_with_replacement

import numpy as np

from legcal.calibration.identify.session import Across, Session, at_base_joints, at_platform_joints
from legcal.calibration.joint_fit import Choices
from legcal.errors import NotIdentifiable
from legcal.geometry import Array, BoolArray, IntArray, normal_basis
from legcal.machine import (
    SHOWN,
    Demand,
    describe_direction,
    freedoms,
    pose_equations,
    pose_sensitivity,
    sparse_basis,
    split_by_motion,
)

_UNSEEN = 1e-3  # 1/m: an unknown known to no better than a kilometre is not known


def eliminate(rows: Array, n_own: int) -> Array:
    """Return what groups of rows say about shared unknowns when their own ones are free.

    Rows are turned until as few as possible contain the own unknowns, which are then dropped:
    nothing is lost where the rows do not determine the own unknowns.

    Parameters
    ----------
    rows : (k, r, n_own + n_shared) array
        Whitened rows of each group: derivatives in standard deviations per metre.
    n_own : int
        Number of unknowns, the first ones, that each group has for itself.

    Returns
    -------
    (m, n_shared) array
    """
    n_shared = rows.shape[2] - n_own
    if rows.shape[0] == 0 or rows.shape[1] == 0:
        return np.zeros((0, n_shared))
    if n_own == 0:
        return rows.reshape(-1, n_shared)
    if rows.shape[1] < n_own:
        short = n_own - rows.shape[1]
        rows = np.concatenate([rows, np.zeros((len(rows), short, rows.shape[2]))], axis=1)
    upper = np.asarray(np.linalg.qr(rows, mode="r"))
    left, singular, _ = np.linalg.svd(upper[:, :n_own, :n_own])
    top = np.swapaxes(left, 1, 2) @ upper[:, :n_own, n_own:]
    top[singular > _UNSEEN] = 0.0
    rest = upper[:, n_own:, n_own:]
    kept = top[singular <= _UNSEEN]
    return np.concatenate([kept, rest.reshape(-1, n_shared)])


def compress(rows: Array) -> Array:
    """Return rows (p, p) that say the same as rows (m, p)."""
    n = rows.shape[1]
    upper = np.asarray(np.linalg.qr(rows, mode="r")) if len(rows) else np.zeros((0, n))
    return np.concatenate([upper, np.zeros((n - len(upper), n))])


SIGMA_EXACT = 1e-7  # [m]: what the mechanism itself demands


@dataclass(frozen=True, eq=False)
class WhitenedDemands:
    """The whitened equations of all legs at the poses of a session.

    Attributes
    ----------
    by_pose : (k, m, f) array
        By the possible motions of the platform: turns [m at the leg's length], displacements.
    by_parameters : (k, m, p) array
        By the parameters in metres.
    leg : (m,) array of int
        The leg of each row.
    demand : (m,) array of Demand
        What it is about.
    """

    by_pose: Array
    by_parameters: Array
    leg: IntArray
    demand: tuple[Demand, ...]

    def at(self, poses: IntArray) -> WhitenedDemands:
        """Return the equations at some of the poses, in that order."""
        return replace(self, by_pose=self.by_pose[poses], by_parameters=self.by_parameters[poses])


def demands_of(session: Session) -> WhitenedDemands:
    """Return what readings and legs demand of the poses of a session."""
    equations = pose_equations(session.legs, session.R, session.t)
    sigma = np.where(equations.measured, session.sigma_q, SIGMA_EXACT)[:, None]
    columns = list(freedoms(session.frame_legs))
    return WhitenedDemands(
        (equations.by_pose / sigma * pose_unit(session))[:, :, columns],
        equations.by_parameters(session.parametrization) / sigma * session.unit,
        equations.leg,
        equations.demands,
    )


def pose_unit(session: Session) -> Array:
    """Return what a metre of the six components of a motion is: turns count at the leg's length."""
    return np.repeat([1.0 / session.mean_length, 1.0], 3)


def image_rows(session: Session) -> Array:
    """Return what each image says, (n_images, n_legs, 4, f + 6 + p), whitened.

    The unknowns are the platform's motion, the motion of the camera of that image, and the
    parameters, all in metres.
    """
    base, platform = at_base_joints(session), at_platform_joints(session)
    turns = pose_unit(session)
    by_camera = np.concatenate([base.by_camera(), platform.by_camera()], axis=2) * turns
    turn = np.cross(session.arm[session.pose][:, :, None], platform.gradient)
    by_pose = np.zeros_like(by_camera)
    by_pose[:, :, 2:] = np.concatenate([turn, platform.gradient], axis=3) * turns
    scatter = session.local_to_parameters
    inside = platform.gradient @ session.R[session.pose][:, None]
    by_parameters = np.concatenate(
        [base.gradient @ scatter[:, :3], inside @ scatter[:, 3:6]], axis=2
    )
    columns = list(freedoms(session.frame_legs))
    return np.concatenate([by_pose[..., columns], by_camera, by_parameters], axis=3)


def information(session: Session, images: Array, demands: WhitenedDemands) -> Array:
    """Return what everything at once says of the parameters, (p, p) whitened rows [1/m].

    The arguments are those of :func:`by_cameras`.
    """
    return of_parameters(session, by_cameras(session, images, demands))


def of_parameters(session: Session, rows: Array) -> Array:
    """Return what rows of cameras and parameters say of the parameters, (p, p)."""
    return compress(eliminate(rows[None], rows.shape[1] - len(session.parametrization)))


def by_cameras(session: Session, images: Array, demands: WhitenedDemands) -> Array:
    """Return what everything says of cameras and parameters, (m, 6 n_frames + p) [1/m].

    The motions of the platform are free. Views that show a board share one camera: that of the
    board.

    Parameters
    ----------
    session : Session
        The observations.
    images : (n_images, n_legs, 4, f + 6 + p) array
        What :func:`image_rows` says of them; other unknowns may follow the parameters.
    demands : WhitenedDemands
        What :func:`demands_of` says of them, and of these others.
    """
    n_f, n_p = len(freedoms(session.frame_legs)), demands.by_parameters.shape[2]
    seen = images.reshape(len(session.view), -1, n_f + 6 + n_p)
    n_cameras = 6 * session.n_frames
    wide = np.zeros((*seen.shape[:2], n_f + n_cameras + n_p))
    wide[..., :n_f], wide[..., n_f + n_cameras :] = seen[..., :n_f], seen[..., n_f + 6 :]
    for v, frame in enumerate(session.frame.tolist()):
        here = session.view == v
        place = n_f + 6 * frame
        wide[here, :, place : place + 6] = seen[here, :, n_f : n_f + 6]
    equations = np.zeros((len(session.t), demands.by_pose.shape[1], wide.shape[2]))
    equations[..., :n_f] = demands.by_pose
    equations[..., n_f + n_cameras :] = demands.by_parameters
    rows = np.concatenate([equations, by_group(wide, session.pose, len(session.t))], axis=1)
    return compress_groups(eliminate(rows, n_f))


def compress_groups(rows: Array) -> Array:
    """Return fewer rows that say the same."""
    return rows if len(rows) < rows.shape[1] else np.asarray(np.linalg.qr(rows, mode="r"))


def by_group(rows: Array, group: IntArray, n_groups: int) -> Array:
    """Return rows (n, r, c) of members laid out by group, (n_groups, most * r, c), with zeros."""
    number = np.bincount(group, minlength=n_groups)
    place = np.zeros(len(group), dtype=np.intp)
    order = np.argsort(group, kind="stable")
    place[order] = np.arange(len(group)) - np.repeat(np.cumsum(number) - number, number)
    most = int(number.max(initial=0))
    laid = np.zeros((n_groups, most, *rows.shape[1:]))
    laid[group, place] = rows
    return laid.reshape(n_groups, most * rows.shape[1], rows.shape[2])


_BASE, _PLATFORM, _LENGTH = (0, 1, 2), (3, 4, 5), (6,)
_BASE_AXIS, _PLATFORM_AXIS, _TWIST = (7, 8), (9, 10), (11,)
LARGEST_SIGMA = 1.0  # mean leg lengths: what is known to no better is not determined
_APART = 1e-3  # mean leg lengths: nearer joints count as one, whose distance has no direction


@dataclass(frozen=True, eq=False)
class Located:
    """Step 1: base joints and revolute axes in the frames of cameras, or of the board.

    Attributes
    ----------
    information : (n_frames, n_legs, r, 5) array
        Whitened rows by A along the axes of R_b [m] and the two turns of the axis [m at the leg's
        length]; zero where the leg is not seen.
    joint, axis : (n_frames, n_legs) array of bool
        Which joints are located, and which revolute axes.
    rank, of : int
        Unknowns that are determined, and all of them.
    """

    information: Array
    joint: BoolArray
    axis: BoolArray
    rank: int
    of: int


@dataclass(frozen=True, eq=False)
class Step:
    """One step's information on the parameters that it identifies.

    Attributes
    ----------
    name : str
        What it identifies.
    columns : (c,) array of int
        The parameters.
    information : (m, c) array
        Whitened rows by these parameters in metres.
    """

    name: str
    columns: IntArray
    information: Array


def revolute_axes(session: Session) -> BoolArray:
    """Return which legs have a revolute axis at the base that is a parameter, (n_legs,)."""
    return np.array(
        [leg.base_joint == "R" and leg.base_axis is not None for leg in session.legs],
        dtype=np.bool_,
    )


def locate_joints(session: Session) -> Located:
    """Return what step 1 says: all axes of a leg in a frame meet in A (6), and v . u = 0 (7)."""
    A, B = at_base_joints(session), at_platform_joints(session)
    revolute = revolute_axes(session)
    found = np.zeros((session.n_frames, session.n_legs, 5, 5))
    frame, wanted = session.frame[session.view], 0
    for f, legs in enumerate(session.frames):
        for j in legs:
            here = np.flatnonzero((frame == f) & session.seen[session.view, j])
            wanted += 3 + 2 * int(revolute[j])
            if revolute[j]:
                found[f, j] = compress(_joint_and_axis(session, A, B, here, j))
            else:
                found[f, j, :3, :3] = compress(A.gradient[here, j].reshape(-1, 3))
    limit = 1.0 / (LARGEST_SIGMA * session.mean_length)
    singular = np.linalg.svd(found, compute_uv=False)
    joint = np.linalg.svd(found[..., :3], compute_uv=False)[..., -1] > limit
    axis = revolute & joint & (singular[..., -1] > limit)
    return Located(found, joint, axis, int(np.sum(singular > limit)), wanted)


def identify_base(session: Session, located: Located) -> Step:
    """Return what step 2 says of base joints and revolute axes, the frames being free."""
    columns, by_frame = base_by_frames(session, located)
    return Step("base_joints", columns, eliminate(by_frame, 6)[:, columns])


def base_by_frames(session: Session, located: Located) -> tuple[IntArray, Array]:
    """Return the parameters of step 2, and rows by each frame and all parameters, (k, r, 6 + p)."""
    columns = np.union1d(
        session.columns(_BASE),
        _of_legs(session, _BASE_AXIS, revolute_axes(session)),
    )
    pairs = np.argwhere(located.joint)
    rows = np.zeros((len(pairs), 5, 6 + len(session.unit)))
    for row, (f, j) in zip(rows, pairs, strict=True):
        F = located.information[f, j]
        if not located.axis[f, j]:  # what is known of A alone
            F = np.zeros_like(F)
            F[:3, :3] = compress(
                eliminate(located.information[f, j][None][:, :, [3, 4, 0, 1, 2]], 2)
            )[:3]
        row[:, :6] = _by_camera(session, j, F)
        scatter = session.local_to_parameters[j]
        row[:, 6:] = F[:, :3] @ scatter[:3] + F[:, 3:] @ scatter[7:9] * session.mean_length
    return columns, by_group(rows, pairs[:, 0], session.n_frames)


def distance_rows(session: Session, located: Located) -> tuple[Array, Array, IntArray]:
    """Return what distances between leg ends say of the offsets.

    Two legs on one platform joint have none: their distance is zero whatever the offsets are.

    Returns
    -------
    (m, n_lengths) array
        Derivative of each distance by the offsets and lengths, whitened.
    (m,) array
        One over the standard deviation of each distance [1/m].
    (m, 4) array of int
        Frame, pose, and both legs of each distance.
    """
    columns = session.columns(_LENGTH)
    place = np.full(session.n_legs, -1)
    place[session.with_length] = np.arange(len(columns))
    B = at_platform_joints(session)
    ends = located.joint & session.with_length
    centres = np.array([leg.B for leg in session.legs])
    gaps = np.linalg.norm(centres[:, None] - centres, axis=2)
    frame = session.frame[session.view]
    shown = ends[frame] & session.seen[session.view]
    keys = [
        (f, i, j, g)
        for f in range(session.n_frames)
        for i in np.flatnonzero(frame == f)
        for j, g in combinations(np.flatnonzero(shown[i]).tolist(), 2)
        if gaps[j, g] > _APART * session.mean_length
    ]
    if not keys:
        return np.zeros((0, len(columns))), np.zeros(0), np.zeros((0, 4), dtype=np.intp)
    f, i, j, g = np.array(keys, dtype=np.intp).T
    apart = B.point[i, j] - B.point[i, g]
    n = apart / np.linalg.norm(apart, axis=1, keepdims=True)
    pose = session.pose[i]
    variance = sum(_end_variance(session, B, i, leg, n) for leg in (j, g))
    weight = 1.0 / np.sqrt(variance)
    rows = np.zeros((len(keys), len(columns)))
    each = np.arange(len(keys))
    rows[each, place[j]] = weight * np.einsum("ki,ki->k", n, session.u[pose, j])
    rows[each, place[g]] = -weight * np.einsum("ki,ki->k", n, session.u[pose, g])
    return rows, np.asarray(weight), np.stack([f, pose, j, g], axis=1)


def identify_platform(
    session: Session, located: Located, images: Array, demands: WhitenedDemands
) -> Step:
    """Return what step 4 says of platform joints and axes, and of universal axes at the base.

    *images* and *demands* are those of :func:`legcal.calibration.identify.ranks.information`.
    """
    universal = np.array([leg.base_joint == "U" for leg in session.legs], dtype=np.bool_)
    columns = np.unique(
        np.concatenate(
            [
                session.columns((*_PLATFORM, *_PLATFORM_AXIS, *_TWIST)),
                _of_legs(session, _BASE_AXIS, universal),
            ]
        )
    )
    n_f, n_p = len(freedoms(session.frame_legs)), len(session.unit)
    keep = np.concatenate([np.arange(n_f), n_f + columns])
    groups = _groups(session, located)
    seen = np.delete(images[:, :, 2:], np.s_[n_f : n_f + 6], axis=3)  # at B
    seen = seen * groups.used[groups.of_image][:, :, None, None]
    seen = seen * located.joint[session.frame[session.view]][:, :, None, None]
    seen = seen.reshape(len(session.view), 2 * session.n_legs, n_f + n_p)
    rows = np.concatenate([demands.by_pose, demands.by_parameters], axis=2)[groups.pose]
    wanted = _step_4_demands(demands, groups)
    rows = np.concatenate(
        [rows * wanted[..., None], by_group(seen, groups.of_image, len(groups.pose))], axis=1
    )
    return Step("platform_joints", columns, eliminate(rows[:, :, keep], n_f))


def _joint_and_axis(session: Session, A: Across, B: Across, here: IntArray, j: int) -> Array:
    """Return rows by A and the turns of the revolute axis, the leg's direction being free."""
    axis = np.asarray(session.legs[j].base_axis)
    pose = session.pose[here]
    u, length = session.u[pose, j], session.length[pose, j]
    E = normal_basis(u)
    rows = np.zeros((len(here), 5, 7))  # the end moves by e1, e2 of the direction; A; the axis
    rows[:, :2, 2:5] = A.gradient[here, j]
    rows[:, 2:4, :2] = B.gradient[here, j] @ np.swapaxes(E, 1, 2)
    rows[:, 2:4, 2:5] = B.gradient[here, j]
    rows[:, 4, :2] = (E @ axis) * (session.mean_length / length)[:, None]
    rows[:, 4, 5:] = u @ np.cross(normal_basis(axis), axis).T
    rows[:, 4] /= SIGMA_EXACT
    return eliminate(rows, 2)


def _by_camera(session: Session, j: int, F: Array) -> Array:
    """Return rows F by A and axis of a leg as rows by the turn and displacement of the camera."""
    rows = np.zeros((len(F), 6))
    rows[:, :3] = -np.cross(session.A[j], F[:, :3])
    rows[:, 3:] = -F[:, :3]
    axis = session.legs[j].base_axis
    if axis is not None:
        rows[:, :3] -= session.mean_length * F[:, 3:] @ normal_basis(axis)
    return rows * pose_unit(session)


def _of_legs(session: Session, kinds: tuple[int, ...], legs: BoolArray) -> IntArray:
    """Return the parameters of some legs that stand for given ones of their twelve numbers."""
    place = session.parametrization.place[legs][:, list(kinds)]
    return np.unique(place[place >= 0])


def _end_variance(session: Session, B: Across, image: IntArray, leg: IntArray, n: Array) -> Array:
    """Return the variance of leg ends along directions n, (k,) [m^2], base joints being known."""
    gradient = B.gradient[image, leg]
    size = np.maximum(np.sum(gradient**2, axis=2), 1e-30)
    across = np.sum((np.einsum("ki,kri->kr", n, gradient) / size) ** 2, axis=1)
    along = np.einsum("ki,ki->k", n, session.u[session.pose[image], leg]) * session.sigma_q
    return np.asarray(across + along**2)


def offsets_from_distances(session: Session, rows: Array, weight: Array, key: IntArray) -> Step:
    """Return what step 3 says: the distance of each pair is constant and free, (14)."""
    columns = session.columns(_LENGTH)
    _, pair = np.unique(key[:, 2:], axis=0, return_inverse=True)
    pair = pair.ravel()
    own = np.concatenate([weight[:, None], rows], axis=1)
    laid = by_group(own[:, None], pair, int(pair.max(initial=-1)) + 1)
    return Step("offsets", columns, eliminate(laid, 1))


@dataclass(frozen=True, eq=False)
class _Groups:
    """Legs of one pose that were seen in one frame: of all located cameras, or of one other."""

    of_image: IntArray
    pose: IntArray
    in_base: BoolArray
    used: BoolArray
    enough: BoolArray


def _groups(session: Session, located: Located) -> _Groups:
    """Return the groups of a session, with the legs that take part in step 4."""
    n_d = len(session.frame_legs)
    frame = session.frame[session.view]
    in_base = (located.joint.sum(axis=1) >= n_d)[frame]
    key = np.stack([session.pose, np.where(in_base, -1, frame)], axis=1)
    distinct, of_image = np.unique(key, axis=0, return_inverse=True)
    of_image = of_image.ravel()
    legs = np.zeros((len(distinct), session.n_legs), dtype=np.bool_)
    np.logical_or.at(legs, of_image, located.joint[frame] & session.seen[session.view])
    ends = legs & session.with_length
    number = ends.sum(axis=1)
    enough = number >= n_d
    used = np.where(enough[:, None], legs, ends & (number >= 2)[:, None])
    return _Groups(of_image, distinct[:, 0], distinct[:, 1] < 0, used, enough)


def _step_4_demands(demands: WhitenedDemands, groups: _Groups) -> BoolArray:
    """Return which equations of the legs step 4 uses in each group, (n_groups, m)."""
    kinds = np.array([d.name for d in demands.demand])
    length, base_axis, twist = (kinds == d for d in ("LENGTH", "BASE_AXIS", "TWIST"))
    others = ~length & ~base_axis & (~twist | groups.in_base[:, None])
    wanted = length | (others & groups.enough[:, None])
    return np.asarray(wanted & groups.used[:, demands.leg])


_FLOOR = 1e-12  # of a variance [m^2]


def scalar_products(session: Session, located: Located) -> Step:
    """Return what (9) says: all products of vectors A_j A_g and revolute axes of each frame."""
    columns = identify_base(session, located).columns
    scatter = session.local_to_parameters
    rows = [np.zeros((0, len(session.unit)))]
    for f in range(session.n_frames):
        vectors, slopes = _vectors_of(session, located, f)
        pairs = [
            (p, q)
            for p, q in combinations_with_replacement(range(len(vectors)), 2)
            if p != q or slopes[p][:, :3].any()  # v . v = 1 says nothing
        ]
        if not pairs:
            continue
        G = np.array([vectors[p] @ slopes[q] + vectors[q] @ slopes[p] for p, q in pairs])
        variance = np.einsum("pi,ij,pj->p", G, _covariance(session, located, f), G)
        by_local = np.concatenate([scatter[:, :3], session.mean_length * scatter[:, 7:9]], axis=1)
        rows.append(G @ by_local.reshape(G.shape[1], -1) / np.sqrt(variance + _FLOOR)[:, None])
    return Step("base_joints", columns, np.concatenate(rows)[:, columns])


def consecutive_distances(rows: Array, weight: Array, key: IntArray, columns: IntArray) -> Step:
    """Return what (14) says: distances equal those of the next position of the frame.

    The rows, weights and keys are those of :func:`legcal.calibration.identify.ranks.distance_rows`.
    """
    last: dict[tuple[int, int, int], int] = {}
    found = [np.zeros((0, len(columns)))]
    for k, (f, _, j, g) in enumerate(key.tolist()):
        before = last.get((f, j, g))
        if before is not None:
            change = rows[k] / weight[k] - rows[before] / weight[before]
            found.append((change / np.hypot(1.0 / weight[k], 1.0 / weight[before]))[None])
        last[f, j, g] = k
    return Step("offsets", columns, np.concatenate(found))


def mean_distances(session: Session, weight: Array, key: IntArray) -> Step:
    """Return what (16) says: mean distances of leg ends in each frame are those of the joints."""
    columns = session.columns((3, 4, 5))
    B = np.array([leg.B for leg in session.legs])
    distinct, which = np.unique(key[:, [0, 2, 3]], axis=0, return_inverse=True)
    number = np.bincount(which.ravel(), weights=weight**2)
    rows = np.zeros((len(distinct), len(session.unit)))
    scatter = session.local_to_parameters[:, 3:6]
    for row, (_, j, g), n in zip(rows, distinct, number, strict=True):
        apart = B[g] - B[j]
        row += np.sqrt(n) * (apart / np.linalg.norm(apart)) @ (scatter[g] - scatter[j])
    return Step("platform_joints", columns, rows[:, columns])


def _vectors_of(session: Session, located: Located, f: int) -> tuple[list[Array], list[Array]]:
    """Return the set V of (8) and the derivative of each by A and axes of all legs, (3, 5 n)."""
    vectors, slopes = [], []
    eye = np.eye(3 * session.n_legs).reshape(session.n_legs, 3, -1)
    n_axes = 2 * session.n_legs
    for j, g in combinations(np.flatnonzero(located.joint[f]).tolist(), 2):
        vectors.append(session.A[g] - session.A[j])
        slopes.append(_by_leg(eye[g] - eye[j], np.zeros((3, n_axes))))
    for j in np.flatnonzero(located.axis[f]).tolist():
        axis = np.asarray(session.legs[j].base_axis)
        turn = np.zeros((3, n_axes))
        turn[:, 2 * j : 2 * j + 2] = np.cross(normal_basis(axis), axis).T / session.mean_length
        vectors.append(axis)
        slopes.append(_by_leg(np.zeros_like(eye[0]), turn))
    return vectors, slopes


def _by_leg(by_joints: Array, by_axes: Array) -> Array:
    """Return derivatives by A and the axis of each leg in turn, (3, 5 n)."""
    both = np.concatenate([by_joints.reshape(3, -1, 3), by_axes.reshape(3, -1, 2)], axis=2)
    return both.reshape(3, -1)


def _covariance(session: Session, located: Located, f: int) -> Array:
    """Return the covariance of A and axes of a frame as step 1 found them, (5 n, 5 n) [m^2]."""
    n = session.n_legs
    covariance = np.zeros((5 * n, 5 * n))
    for j in np.flatnonzero(located.joint[f]).tolist():
        F = located.information[f, j]
        inverse = np.linalg.pinv(F.T @ F, hermitian=True)
        covariance[5 * j : 5 * j + 5, 5 * j : 5 * j + 5] = inverse
    return covariance


_ERROR = 1e-3  # [m], the largest component of a direction whose effect is told
_HARMLESS = 1e-3  # of that: the platform does not move


@dataclass(frozen=True)
class PlatformError:
    """How far the platform moves, root mean square over poses.

    Attributes
    ----------
    dX_m : float
        Displacement of the origin of R_e [m].
    dE_rad : float
        Rotation [rad].
    """

    dX_m: float
    dE_rad: float


@dataclass(frozen=True)
class WeakDirection:
    """A combination of parameters that the observations do not determine.

    Attributes
    ----------
    direction : str
        In words.
    parameters : tuple of str
        The parameters that change, the largest first.
    components : tuple of float
        By how much, when the largest changes by 1 mm (an angle by 1 mm at the leg's length)
        [m or rad].
    dX_m, dE_rad : float or None
        The displacement [m] and rotation [rad] of the platform that this could hide, root mean
        square over the poses; None where the motors do not determine the pose.
    harmless : bool
        Whether the platform does not move.
    """

    direction: str
    parameters: tuple[str, ...]
    components: tuple[float, ...]
    dX_m: float | None
    dE_rad: float | None
    harmless: bool


@dataclass(frozen=True)
class Ranks:
    """How many parameters are determined.

    Attributes
    ----------
    rank, of : int
        Directions of the parameter space that are determined, and all of them.
    weak : tuple of WeakDirection
        The others.
    """

    rank: int
    of: int
    weak: tuple[WeakDirection, ...]

    @property
    def complete(self) -> bool:
        """Whether all directions that move the platform are determined."""
        return all(direction.harmless for direction in self.weak)


class PlatformMotion:
    """How the platform moves with the parameters, over the poses that a session reaches."""

    def __init__(self, session: Session) -> None:
        self.session = session
        self.by_metres: Array | None = None
        self.why_not = ""
        try:
            moved = pose_sensitivity(
                session.legs,
                session.parametrization,
                session.frame_legs,
                session.R_reached,
                session.t_reached,
            )
        except NotIdentifiable as error:
            self.why_not = str(error)
            return
        self.by_metres = moved * session.unit

    def effect(self, direction: Array) -> PlatformError | None:
        """Return what a direction (p,) in metres does."""
        if self.by_metres is None:
            return None
        moved = self.by_metres @ direction
        turn, shift = (float(np.sqrt(np.mean(np.sum(x**2, axis=1)))) for x in np.split(moved, 2, 1))
        return PlatformError(shift, turn)

    def sigma(self, information: Array) -> PlatformError | None:
        """Return the standard deviation of the platform that information leaves."""
        if self.by_metres is None:
            return None
        _, singular, basis = np.linalg.svd(information)
        seen = singular > _limit(self.session)
        spread = self.by_metres @ (basis[seen].T / singular[seen])
        turn, shift = (
            float(np.sqrt(np.mean(np.sum(x**2, (1, 2))))) for x in np.split(spread, 2, 1)
        )
        return PlatformError(shift, turn)

    def split(self, basis: Array) -> tuple[Array, Array]:
        """Return a space (w, p) as that which moves the platform and that which does not."""
        return split_by_motion(self.by_metres, basis, self.session.mean_length, _HARMLESS)


def determined(session: Session, information: Array) -> int:
    """Return the rank of whitened rows: directions known to better than a leg's length."""
    singular = np.linalg.svd(compress(information), compute_uv=False)
    return int(np.sum(singular > _limit(session)))


def undetermined(session: Session, information: Array) -> Array:
    """Return an orthonormal basis (w, c) of the directions that rows (m, c) do not determine."""
    _, singular, basis = np.linalg.svd(compress(information))
    return np.asarray(basis[singular <= _limit(session)])


def weak_directions(
    session: Session, motion: PlatformMotion, basis: Array, columns: IntArray | None = None
) -> tuple[WeakDirection, ...]:
    """Return the directions of a space in words, those that move the platform first.

    Parameters
    ----------
    session : Session
        Where names and units come from.
    motion : PlatformMotion
        What the platform does.
    basis : (w, c) array
        The space, in metres.
    columns : (c,) array of int, optional
        Which parameters; all without it.
    """
    wide = basis
    if columns is not None:
        wide = np.zeros((len(basis), len(session.unit)))
        wide[:, columns] = basis
    parts = motion.split(wide)
    return tuple(
        _direction(session, motion, row, harmless)
        for part, harmless in zip(parts, (False, True), strict=True)
        for row in sparse_basis(part)
    )


def _direction(
    session: Session, motion: PlatformMotion, row: Array, harmless: bool
) -> WeakDirection:
    """Return a direction with its largest component at 1 mm."""
    row = row * (_ERROR / row[np.argmax(np.abs(row))])
    shown = np.flatnonzero(np.abs(row) > SHOWN * _ERROR)
    shown = shown[np.argsort(-np.abs(row[shown] / _ERROR).round(3), kind="stable")]
    names = tuple(session.parametrization.names[i] for i in shown)
    effect = motion.effect(row)
    return WeakDirection(
        describe_direction(names, session.leg_names),
        names,
        tuple(float((row * session.unit)[i]) for i in shown),
        None if effect is None else effect.dX_m,
        None if effect is None else effect.dE_rad,
        harmless,
    )


def _limit(session: Session) -> float:
    """Return the least singular value that counts [1/m]."""
    return 1.0 / (LARGEST_SIGMA * session.mean_length)


@dataclass(frozen=True)
class StepRank:
    """The rank of one step's equations.

    Attributes
    ----------
    name : str
        ``joints_in_cameras``, ``base_joints``, ``offsets`` or ``platform_joints``.
    criteria : {"default", "literal"}
        legcal's criteria, or the paper's as printed: (6) and (7), (9), (14), (16).
    rank, of : int
        Unknowns that are determined, and all of them. Those of the first step are joints and
        axes in the camera frames; the others are parameters.
    """

    name: str
    criteria: str
    rank: int
    of: int


@dataclass(frozen=True, eq=False)
class Analysis:
    """What a session says of the parameters.

    Attributes
    ----------
    session : Session
        The session.
    known : (m, p) array or None
        What is known of the parameters without looking, as whitened rows [1/m].
    """

    session: Session
    known: Array | None = None

    def elsewhere(self, session: Session, poses: IntArray) -> Analysis:
        """Return the analysis of other images of the same machine, at some of the same poses."""
        other = Analysis(session, self.known)
        other.__dict__.update(motion=self.motion, demands=self.demands.at(poses))
        return other

    def with_board(self, *, board: bool = True) -> Analysis:
        """Return the analysis of the same images with a calibration board in all or in none."""
        session = self.session.with_board(board=board)
        other = self.elsewhere(session, np.arange(len(session.t)))
        other.__dict__.update(images=self.images)
        return other

    @cached_property
    def images(self) -> Array:
        """What the images say."""
        return image_rows(self.session)

    @cached_property
    def demands(self) -> WhitenedDemands:
        """What readings and legs demand."""
        return demands_of(self.session)

    @cached_property
    def located(self) -> Located:
        """Step 1."""
        return locate_joints(self.session)

    @cached_property
    def distances(self) -> tuple[Array, Array, IntArray]:
        """The distances of steps 3 and 4."""
        return distance_rows(self.session, self.located)

    @cached_property
    def default_steps(self) -> tuple[Step, ...]:
        """Steps 2, 3 and 4, default criteria."""
        return (
            identify_base(self.session, self.located),
            offsets_from_distances(self.session, *self.distances),
            identify_platform(self.session, self.located, self.images, self.demands),
        )

    @cached_property
    def literal_steps(self) -> tuple[Step, ...]:
        """Steps 2, 3 and 4 as printed."""
        rows, weight, key = self.distances
        return (
            scalar_products(self.session, self.located),
            consecutive_distances(rows, weight, key, self.default_steps[1].columns),
            mean_distances(self.session, weight, key),
        )

    @cached_property
    def of_cameras(self) -> Array:
        """Everything at once, of cameras and parameters, (m, 6 n_frames + p)."""
        return by_cameras(self.session, self.images, self.demands)

    @cached_property
    def information(self) -> Array:
        """Everything at once, (p, p)."""
        found = of_parameters(self.session, self.of_cameras)
        return found if self.known is None else compress(np.concatenate([found, self.known]))

    @cached_property
    def motion(self) -> PlatformMotion:
        """What the platform does."""
        return PlatformMotion(self.session)

    @cached_property
    def staged(self) -> Ranks:
        """The four default steps together."""
        weak = tuple(
            direction
            for step in self.default_steps
            for direction in weak_directions(
                self.session,
                self.motion,
                undetermined(self.session, step.information),
                step.columns,
            )
        )
        n_p = len(self.session.unit)
        return Ranks(n_p - len(weak), n_p, weak)

    @cached_property
    def full(self) -> Ranks:
        """Everything at once."""
        basis = undetermined(self.session, self.information)
        weak = weak_directions(self.session, self.motion, basis)
        n_p = len(self.session.unit)
        return Ranks(n_p - len(weak), n_p, weak)

    @cached_property
    def step_ranks(self) -> tuple[StepRank, ...]:
        """The rank of each step, default and as printed."""
        first = ("joints_in_cameras", self.located.rank, self.located.of)
        found = [
            StepRank(first[0], "default", *first[1:]),
            StepRank(first[0], "literal", *first[1:]),
        ]
        for default, printed in zip(self.default_steps, self.literal_steps, strict=True):
            for criteria, step in (("default", default), ("literal", printed)):
                rank = determined(self.session, step.information)
                found.append(StepRank(step.name, criteria, rank, len(step.columns)))
        return tuple(found)


def missing(session: Session, rows: Array, motion: PlatformMotion) -> int:
    """Return how many directions that move the platform rows of all parameters leave open."""
    return len(motion.split(undetermined(session, rows))[0])


def scattered(step: Step, n_parameters: int) -> Array:
    """Return a step's rows by all parameters; the others count as known."""
    rows = np.zeros((len(step.information) + n_parameters, n_parameters))
    rows[: len(step.information), step.columns] = step.information
    known = np.setdiff1d(np.arange(n_parameters), step.columns)
    rows[len(step.information) + known, known] = 1e12
    return rows


def known_rows(session: Session, choices: Choices) -> Array:
    """Return what is known of the parameters as whitened rows, (p, p) [1/m].

    Parameters
    ----------
    session : Session
        The observations; its parameters are counted in metres.
    choices : Choices
        Parameters that are fixed, and those of which something is known.
    """
    known = np.zeros(len(session.unit))
    for i, name in enumerate(session.parametrization.names):
        if name in choices.priors:
            known[i] = session.unit[i] / choices.priors[name].sigma
        elif choices.holds(name, by_default=name.endswith(".twist")):
            known[i] = 1.0 / SIGMA_EXACT
    return np.diag(known)
