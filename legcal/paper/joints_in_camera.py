"""Section 3.2: base joint centres and revolute axes in the camera frames, eqs (6) and (7).

All axes of one leg in the images of one view meet in its base joint centre A, and are normal
to the revolute axis v of that joint. In a planar mechanism the axes of a view are one normal.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from legcal.data import LegAxes, Measurements
from legcal.errors import NotIdentifiable
from legcal.geometry import Array, BoolArray, IntArray, normal_basis
from legcal.paper.base_unknowns import camera_starts, nominal_axes, side_of_plane, signs_seen
from legcal.paper.nominal import Criteria, NominalMechanism


@dataclass(frozen=True, eq=False)
class Bundles:
    """Axes in bundles, each of one leg in one view, whose axes meet in one point.

    Attributes
    ----------
    rows : (k,) array of int
        The axes, bundle by bundle.
    counts : (n,) array of int
        How many axes each bundle has.
    """

    rows: IntArray
    counts: IntArray

    @classmethod
    def of(cls, key: IntArray) -> Bundles:
        """Return the bundles of axes with equal keys, by key."""
        return cls(np.argsort(key, kind="stable"), np.unique(key, return_counts=True)[1])

    @property
    def bundle(self) -> IntArray:
        """The bundle of each of ``rows``, (k,)."""
        return np.repeat(np.arange(len(self.counts)), self.counts)

    def some(self, wanted: BoolArray) -> Bundles:
        """Return some of the bundles."""
        return Bundles(self.rows[wanted[self.bundle]], self.counts[wanted])

    def total(self, values: Array) -> Array:
        """Return the sum over each bundle of values of ``rows``."""
        if len(self.counts) == 0:
            return np.zeros((0, *values.shape[1:]))
        return np.asarray(np.add.reduceat(values, np.cumsum(self.counts) - self.counts))

    def median(self, values: Array) -> Array:
        """Return the median over each bundle of values (k,) of ``rows``."""
        ordered = values[np.lexsort((values, self.bundle))]
        first = np.cumsum(self.counts) - self.counts
        low, high = first + (self.counts - 1) // 2, first + self.counts // 2
        return np.asarray(0.5 * (ordered[low] + ordered[high]))


_SAME_DIRECTION = 1e-9  # of the normalised information: directions that differ by less are one
_LARGEST_SIGMA = 0.1  # of the distance to the camera
_LARGEST_TURN = 1.0  # [rad] of an axis; beyond, nothing is known of it


def too_few_directions(information: Array, n_images: int) -> str:
    """Return why (6) has no single solution, or an empty string."""
    smallest = float(np.linalg.eigvalsh(information)[0])
    if smallest > _SAME_DIRECTION * n_images:
        return ""
    if n_images == 1:
        return "it was found in one image, and at least two different directions are needed"
    return f"its direction is the same in all {n_images} images, and two are needed"


def too_uncertain(A: Array, covariance: Array) -> str:
    """Return why a centre says nothing, or an empty string."""
    sigma = float(np.sqrt(np.linalg.eigvalsh(covariance)[-1]))
    distance = float(np.linalg.norm(A))
    if sigma <= _LARGEST_SIGMA * distance:
        return ""
    return (
        f"its directions differ too little to say where they meet (sigma {1e3 * sigma:.0f} mm "
        f"at {1e3 * distance:.0f} mm from the camera)"
    )


def too_tilted(covariance: Array) -> str:
    """Return why an axis says nothing, or an empty string."""
    sigma = float(np.sqrt(np.linalg.eigvalsh(covariance)[-1]))
    if sigma <= _LARGEST_TURN:
        return ""
    return (
        "its leg's directions differ too little to say what they are normal to "
        f"(sigma {np.degrees(sigma):.0f} deg)"
    )


MOST_REWEIGHTINGS = 100
_FEWEST_REWEIGHTINGS = 10
_SETTLED = 1e-6  # standard deviations: smaller steps no longer matter
_OUTLIER = 3.0  # an axis that misses A by this many times the median has half its weight
_NO_NOISE = 1e-3  # standard deviations: smaller misses are rounding


def plain_information(axes: LegAxes, bundles: Bundles) -> tuple[Array, Array]:
    """Return the normal equations of (6), (n, 3, 3) and (n, 3): sums of I - u u' and of its M."""
    u, M = axes.u[bundles.rows], axes.M[bundles.rows]
    normal = np.eye(3) - u[:, :, None] * u[:, None, :]
    return bundles.total(normal), bundles.total(np.einsum("kij,kj->ki", normal, M))


def nearest_points(information: tuple[Array, Array]) -> tuple[Array, Array]:
    """Return the least-squares points A (n, 3) and the inverses of their normal matrices."""
    inverse = np.asarray(np.linalg.inv(information[0]))
    return np.asarray((inverse @ information[1][..., None])[..., 0]), inverse


def weighted_points(axes: LegAxes, bundles: Bundles, A: Array) -> tuple[Array, Array]:
    """Return the points nearest to axes in units of their covariances, and their covariances.

    The covariance at A depends on A, so the weights are computed again until A stays, and axes that
    miss the others by far are given less.

    Parameters
    ----------
    axes : LegAxes
        Axes in the camera frames.
    bundles : Bundles
        Which of them meet.
    A : (n, 3) array
        Points to start from, one a bundle [m].

    Returns
    -------
    (n, 3) array [m], (n, 3, 3) array [m^2]
    """
    A, C, going = A.copy(), np.zeros((len(A), 3, 3)), np.arange(len(A))
    for k in range(MOST_REWEIGHTINGS):
        some, before = bundles.some(np.isin(np.arange(len(A)), going)), A[going]
        E, M = axes.basis[some.rows], axes.M[some.rows]
        residual, spread = miss(axes, some.rows, before[some.bundle])
        normal = np.swapaxes(E, -1, -2) @ robust_weights(some, residual, spread) @ E
        right = (normal @ M[..., None])[..., 0]
        A[going], C[going] = nearest_points((some.total(normal), some.total(right)))
        going = going[np.logical_and(*progress(k, A[going] - before, A[going], C[going]))]
        if not len(going):
            break
    return A, C


def progress(k: int, step: Array, A: Array, covariance: Array) -> tuple[BoolArray, BoolArray]:
    """Return which bundles (n,) still move after step *k*, and which are sound.

    One that says nothing of its joint would wander off, and is not to be followed.
    """
    if k + 1 < _FEWEST_REWEIGHTINGS:
        return np.ones(len(A), dtype=np.bool_), np.ones(len(A), dtype=np.bool_)
    moves = np.any(step**2 > _SETTLED**2 * np.einsum("nii->ni", covariance), axis=1)
    sound = [not too_uncertain(*told) for told in zip(A, covariance[:, :3, :3], strict=True)]
    return np.asarray(moves), np.array(sound, dtype=np.bool_)


def robust_weights(bundles: Bundles, residual: Array, spread: Array) -> Array:
    """Return the inverses of covariances (k, r, r), less for residuals (k, r) far from the rest."""
    weight = np.linalg.inv(spread)
    chi = np.sqrt(np.einsum("ki,kij,kj->k", residual, weight, residual))
    limit = np.maximum(_OUTLIER * bundles.median(chi), _NO_NOISE)[bundles.bundle]
    return np.asarray(weight / (1.0 + (chi / limit) ** 2)[:, None, None])


def miss(axes: LegAxes, here: IntArray, A: Array) -> tuple[Array, Array]:
    """Return by how much axes miss points, in e1 and e2, and the covariance of that.

    Parameters
    ----------
    axes : LegAxes
        Axes.
    here : (k,) array of int
        Which of them.
    A : (3,) or (k, 3) array
        Points in the same frame [m].

    Returns
    -------
    (k, 2) array [m], (k, 2, 2) array [m^2]
        The axis at the height s of the point is M + s u + e (beta + s alpha).
    """
    arm = A - axes.M[here]
    residual = np.einsum("kia,ka->ki", axes.basis[here], arm)
    s = np.sum(arm * axes.u[here], axis=-1)
    C, s = axes.covariance[here], s[:, None, None]
    mixed = C[:, :2, 2:]
    spread = s**2 * C[:, :2, :2] + s * (mixed + np.swapaxes(mixed, 1, 2)) + C[:, 2:, 2:]
    return residual, spread


def miss_of_joint(axes: LegAxes, here: IntArray, A: Array, v: Array) -> tuple[Array, Array, Array]:
    """Return by how much axes miss points and are not normal to directions, (6) and (7).

    Parameters
    ----------
    axes : LegAxes
        Axes.
    here : (k,) array of int
        Which of them.
    A, v : (k, 3) array
        Points [m] and unit directions in the same frame.

    Returns
    -------
    residual : (k, 3) array
        The miss in e1 and e2, as in :func:`miss` [m], and -v . u. The direction of the axis is
        u + e alpha, so that the last is (e v) . alpha for the right v.
    spread : (k, 3, 3) array
        Its covariance.
    tilt : (k, 2, 3) array
        Covariance of alpha with it.
    """
    arm, u, E = A - axes.M[here], axes.u[here], axes.basis[here]
    across = np.einsum("kia,ka->ki", E, arm)
    residual = np.column_stack([across, -np.sum(v * u, axis=1)])
    T = np.zeros((len(here), 3, 4))
    T[:, :2, :2] = np.sum(arm * u, axis=1)[:, None, None] * np.eye(2)
    T[:, :2, 2:] = np.eye(2)
    T[:, 2, :2] = np.einsum("kia,ka->ki", E, v)
    tilt = axes.covariance[here, :2] @ np.swapaxes(T, 1, 2)
    return residual, np.asarray(T @ axes.covariance[here] @ np.swapaxes(T, 1, 2)), tilt


def derivative_of_miss(axes: LegAxes, here: IntArray, v: Array, alpha: Array) -> Array:
    """Return the derivative of the miss by A and turns of v, (k, 3, 5).

    Parameters
    ----------
    axes : LegAxes
        Axes.
    here : (k,) array of int
        Which of them.
    v : (k, 3) array
        Unit directions.
    alpha : (k, 2) array
        Where the axes really are, as far as is known: their directions are u + e alpha.
    """
    N, E, u = normal_basis(v), axes.basis[here], axes.u[here]
    better = u + np.einsum("kia,ki->ka", E, alpha)
    J = np.zeros((len(here), 3, 5))
    J[:, :2, :3] = E - alpha[:, :, None] * u[:, None, :]
    J[:, 2, 3] = np.sum(N[:, 1] * better, axis=1)
    J[:, 2, 4] = -np.sum(N[:, 0] * better, axis=1)
    return J


_LONGEST = 0.2  # step: [rad] of an axis, and in its distance of a centre


def plain_axes(axes: LegAxes, bundles: Bundles, pool: IntArray) -> tuple[Array, Array]:
    """Return v of (7), every equation with the same weight, and the inverse of its normal matrix.

    Parameters
    ----------
    axes : LegAxes
        Axes in the camera frames.
    bundles : Bundles
        Which of them are legs of one joint.
    pool : (n,) array of int
        Bundles with the same number, 0 and so on, share v.

    Returns
    -------
    (n, 3) array, (n, 2, 2) array
        Unit vectors of any sign, and the inverse matrices by turns of v about its
        :func:`legcal.geometry.lines.normal_basis`.
    """
    u = axes.u[bundles.rows]
    scatter = _by_pool(bundles.total(u[:, :, None] * u[:, None, :]), pool)
    v = np.linalg.eigh(scatter)[1][:, :, 0]
    N = normal_basis(v)
    information = N[:, ::-1] @ scatter @ np.swapaxes(N[:, ::-1], 1, 2)
    information *= np.array([[1.0, -1.0], [-1.0, 1.0]])  # v turned about e1 by t is v - t e2
    return v[pool], np.asarray(np.linalg.inv(information))[pool]


def weighted_joints(
    axes: LegAxes, bundles: Bundles, pool: IntArray, A: Array, v: Array
) -> tuple[Array, Array, Array]:
    """Return A and v of revolute joints weighted by the covariances of the axes, (6) and (7).

    What an image knows badly is the tilt of a leg towards the camera. It enters the miss
    of A, in proportion to the distance, and the angle to v: both are weighted together, by their
    joint covariance. The derivatives are those at the adjusted directions, which meet in A and are
    normal to v; at the observed ones, tilts would pass for turns, and v would come out biased.

    Parameters
    ----------
    axes, bundles, pool
        As in :func:`plain_axes`.
    A, v : (n, 3) array
        Points [m] and unit vectors to start from, v the same in a pool.

    Returns
    -------
    A : (n, 3) array
        Centres [m].
    v : (n, 3) array
        Unit vectors, the same in a pool but for bundles that say nothing of their joints.
    covariance : (n, 5, 5) array
        Of A [m^2] and of two turns of v about its normal basis [rad^2].
    """
    A, v, C, going = A.copy(), v.copy(), np.zeros((len(A), 5, 5)), np.arange(len(A))
    for k in range(MOST_REWEIGHTINGS):
        some = bundles.some(np.isin(np.arange(len(A)), going))
        step, C[going] = _step(axes, some, pool[going], A[going], v[going])
        A[going] -= step[:, :3]
        v[going] = turned(v[going], -step[:, 3:])
        moves, sound = progress(k, step, A[going], C[going])
        going = going[sound & np.isin(pool[going], pool[going[moves & sound]])]
        if not len(going):
            break
    return A, v, C


def _step(
    axes: LegAxes, bundles: Bundles, pool: IntArray, A: Array, v: Array
) -> tuple[Array, Array]:
    """Return a Gauss-Newton step (n, 5) of A and v and their covariances (n, 5, 5)."""
    rows, bundle = bundles.rows, bundles.bundle
    residual, spread, tilt = miss_of_joint(axes, rows, A[bundle], v[bundle])
    weight = robust_weights(bundles, residual, spread)
    alpha = (tilt @ np.linalg.solve(spread, residual[..., None]))[..., 0]
    J = derivative_of_miss(axes, rows, v[bundle], alpha)
    back = np.swapaxes(J, 1, 2) @ weight
    right = (back @ residual[..., None])[..., 0]
    of_pool = np.unique(pool, return_inverse=True)[1].ravel()
    step, C = _pooled(bundles.total(back @ J), bundles.total(right), of_pool)
    return _limited(step, np.linalg.norm(A, axis=1)), C


def turned(v: Array, turn: Array) -> Array:
    """Return unit vectors (n, 3) turned about their normal bases by small angles (n, 2)."""
    w = np.einsum("ni,nia->na", turn, normal_basis(v))
    moved = v + np.cross(w, v)
    return np.asarray(moved / np.linalg.norm(moved, axis=1, keepdims=True))


def _limited(step: Array, distance: Array) -> Array:
    """Return steps (n, 5) within which their equations are nearly linear, shorter if need be."""
    size = np.maximum(
        np.linalg.norm(step[:, :3], axis=1) / distance, np.linalg.norm(step[:, 3:], axis=1)
    )
    return np.asarray(step / np.maximum(size / _LONGEST, 1.0)[:, None])


def flipped(covariance: Array) -> Array:
    """Return covariances (..., 5, 5) of A and v as those of A and -v.

    The second vector of the normal basis changes its sign with v.
    """
    sign = np.array([1.0, 1.0, 1.0, 1.0, -1.0])
    return np.asarray(covariance * np.outer(sign, sign))


def _pooled(F: Array, b: Array, pool: IntArray) -> tuple[Array, Array]:
    """Return steps (n, 5) and covariances of A and v from normal equations, v being pooled."""
    C_A = np.linalg.inv(F[:, :3, :3])
    G = -C_A @ F[:, :3, 3:]  # how A follows v
    rest = F[:, 3:, 3:] + np.swapaxes(F[:, :3, 3:], 1, 2) @ G
    right = b[:, 3:] + (np.swapaxes(G, 1, 2) @ b[:, :3, None])[..., 0]
    C_v = np.linalg.inv(_by_pool(rest, pool))
    turn = (C_v @ _by_pool(right, pool)[..., None])[..., 0][pool]
    C_v = C_v[pool]
    A = (C_A @ b[:, :3, None] + G @ turn[..., None])[..., 0]
    C = np.zeros((len(F), 5, 5))
    C[:, :3, :3] = C_A + G @ C_v @ np.swapaxes(G, 1, 2)
    C[:, :3, 3:] = G @ C_v
    C[:, 3:, :3] = np.swapaxes(C[:, :3, 3:], 1, 2)
    C[:, 3:, 3:] = C_v
    return np.column_stack([A, turn]), C


def _by_pool(values: Array, pool: IntArray) -> Array:
    """Return the sums of values (n, ...) over each pool."""
    total = np.zeros((int(pool.max(initial=-1)) + 1, *values.shape[1:]))
    np.add.at(total, pool, values)
    return total


@dataclass(frozen=True, eq=False)
class JointsInCamera:
    """Base joint centres and revolute axes in the frame of each view.

    Attributes
    ----------
    A_camera : (n_views, n_legs, 3) array
        Centres in the camera frame [m]; zero where not located.
    located : (n_views, n_legs) array of bool
        Which centres were located.
    v_camera : (n_views, n_legs, 3) array
        Unit revolute axes in the camera frame, the common normal in a planar mechanism; zero
        where not located. They point as :func:`oriented` says.
    axis_located : (n_views, n_legs) array of bool
        Which axes were located.
    covariance : (n_views, n_legs, 5, 5) array
        Covariance of the centres [m^2] and of two turns of the axes about their
        :func:`legcal.geometry.lines.normal_basis` [rad^2]; zero where not located. Of a planar
        mechanism, that of each leg and the common normal.
    diagnostics : tuple of str
        Which legs were left out of which views, and why.
    sided : (n_views,) array of bool
        Planar mechanisms: where lengths of legs say from which side the camera sees the plane, so
        that the sign of the normal is known.
    """

    A_camera: Array
    located: BoolArray
    v_camera: Array
    axis_located: BoolArray
    covariance: Array
    diagnostics: tuple[str, ...]
    sided: BoolArray


def locate_joints_in_cameras(
    mechanism: NominalMechanism,
    axes: LegAxes,
    measurements: Measurements,
    *,
    criteria: Criteria = "default",
) -> JointsInCamera:
    """Locate base joint centres and revolute axes in each camera frame, eqs (6) and (7).

    Parameters
    ----------
    mechanism : NominalMechanism
        Names and joints of the legs; its base says to which side axes point.
    axes : LegAxes
        Leg axes in the camera frames.
    measurements : Measurements
        The view of each image.
    criteria : {"default", "literal"}
        ``literal`` solves (6) and then (7) as printed, every equation with the same weight.

    Returns
    -------
    JointsInCamera

    Raises
    ------
    NotIdentifiable
        If some leg is not located in any view: each needs two different directions in one.

    Notes
    -----
    The default weights the distance of A from each axis, and the angle of the axis to v, by the
    covariance of the axis: see :mod:`legcal.paper.joints_in_camera` and
    :mod:`legcal.paper.joints_in_camera`. Axes that miss the others by far are given less.
    """
    key = measurements.view[axes.row] * mechanism.n_legs + axes.leg
    views, legs = np.divmod(np.unique(key), mechanism.n_legs)
    bundles = Bundles.of(key)
    spread = plain_information(axes, bundles)[0]
    reasons = [
        too_few_directions(*told) for told in zip(spread, bundles.counts.tolist(), strict=True)
    ]
    clear = np.flatnonzero([not reason for reason in reasons])
    bundles = bundles.some(np.isin(np.arange(len(reasons)), clear))
    A, v, C = _estimate(mechanism, axes, bundles, views[clear], legs[clear], criteria)
    has_axis = np.any(v != 0.0, axis=1)
    doubts = [""] * len(clear)
    if criteria == "default":
        for k, i in enumerate(clear):
            reasons[i] = too_uncertain(A[k], C[k, :3, :3])
            if has_axis[k] and not reasons[i]:
                doubts[k] = too_tilted(C[k, 3:, 3:])
    good = np.array([not reasons[i] for i in clear], dtype=np.bool_)
    good_axis = good & has_axis & np.array([not doubt for doubt in doubts], dtype=np.bool_)
    at = (views[clear], legs[clear])
    shape = (len(measurements.views), mechanism.n_legs)
    diagnostics = (
        *_left_out("base joint", mechanism, measurements, (views, legs), reasons),
        *_left_out("revolute axis", mechanism, measurements, at, doubts),
    )
    found = JointsInCamera(
        _laid_out(shape, at, np.where(good[:, None], A, 0.0)),
        _laid_out(shape, at, good),
        _laid_out(shape, at, np.where(good_axis[:, None], v, 0.0)),
        _laid_out(shape, at, good_axis),
        _laid_out(shape, at, np.where(good[:, None, None], C, 0.0)),
        diagnostics,
        np.zeros(shape[0], dtype=np.bool_),
    )
    _check_every_leg(mechanism, found.located, diagnostics)
    found = oriented(mechanism, found)
    return found if mechanism.spatial else _sided(mechanism, axes, measurements, found)


def oriented(mechanism: NominalMechanism, joints: JointsInCamera) -> JointsInCamera:
    """Return joints with their axes pointing to the side of the nominal axes.

    An axis in a camera is a line: (7) gives it up to its sign, while products of vectors need one.
    The nominal base is laid on the joints of each view, and each axis takes the sign with which it
    points to the side of its nominal axis. Where the joints lie on one line, the base is
    turned about it until the axes agree best, as lines. Where two turns agree alike, as for
    axes normal to the line between two joints, the sign remains a matter of choice: step 2 by
    default tries both. That of an axis whose joint is alone in its view does not matter. In a
    planar mechanism all axes are normal to that line, and lengths of legs decide
    (:mod:`legcal.paper.base_unknowns`).
    """
    nominal, A_Rb = nominal_axes(mechanism), mechanism.parameters.base_joints
    signs = np.ones(joints.located.shape)
    for v, (located, with_axis) in enumerate(zip(joints.located, joints.axis_located, strict=True)):
        seen = joints.v_camera[v, with_axis]
        starts = camera_starts(A_Rb[located], nominal[with_axis], joints.A_camera[v, located], seen)
        if starts:
            signs[v, with_axis] = signs_seen(nominal[with_axis], seen, starts[0].T_Rb_camera)
    return with_signs(joints, signs)


def _sided(
    mechanism: NominalMechanism, axes: LegAxes, measurements: Measurements, joints: JointsInCamera
) -> JointsInCamera:
    """Return joints whose normals point up where the lengths of legs say which way that is."""
    signs, sided = np.ones(joints.located.shape), joints.sided.copy()
    view = measurements.view[axes.row]
    for v, with_axis in enumerate(joints.axis_located):
        legs = np.flatnonzero(with_axis)
        if len(legs) < 2:
            continue
        of_view = axes.choose(np.flatnonzero(view == v))
        seen = joints.A_camera[v, legs], joints.v_camera[v, legs[0]], legs
        side = side_of_plane(mechanism, of_view, measurements, *seen)
        sided[v], signs[v] = side != 0.0, -1.0 if side < 0.0 else 1.0
    return replace(with_signs(joints, signs), sided=sided)


def with_signs(joints: JointsInCamera, signs: Array) -> JointsInCamera:
    """Return joints with the axes turned round whose sign (n_views, n_legs) is -1."""
    turned = (signs < 0.0)[..., None]
    return replace(
        joints,
        v_camera=np.where(turned, -joints.v_camera, joints.v_camera),
        covariance=np.where(turned[..., None], flipped(joints.covariance), joints.covariance),
    )


def _estimate(
    mechanism: NominalMechanism,
    axes: LegAxes,
    bundles: Bundles,
    views: IntArray,
    legs: IntArray,
    criteria: Criteria,
) -> tuple[Array, Array, Array]:
    """Return A (n, 3), v (n, 3), zero where there is none, and covariances (n, 5, 5) of bundles."""
    A, C_A = nearest_points(plain_information(axes, bundles))
    v, C = np.zeros((len(A), 3)), np.zeros((len(A), 5, 5))
    C[:, :3, :3] = C_A
    revolute = mechanism.revolute[legs] | (not mechanism.spatial)
    if criteria == "default" and not revolute.all():
        some = bundles.some(~revolute)
        A[~revolute], C[~revolute, :3, :3] = weighted_points(axes, some, A[~revolute])
    if revolute.any():
        some, pool = bundles.some(revolute), np.arange(int(revolute.sum()))
        if not mechanism.spatial:
            pool = np.unique(views[revolute], return_inverse=True)[1].ravel()
        v[revolute], C[revolute, 3:, 3:] = plain_axes(axes, some, pool)
        if criteria == "default":
            A[revolute], v[revolute], C[revolute] = weighted_joints(
                axes, some, pool, A[revolute], v[revolute]
            )
    return A, v, C


def _laid_out(shape: tuple[int, int], at: tuple[IntArray, IntArray], values: Any) -> Any:
    """Return values of bundles by view and leg, zero where there is no bundle."""
    found = np.zeros((*shape, *values.shape[1:]), dtype=values.dtype)
    found[at] = values
    return found


def _left_out(
    what: str,
    mechanism: NominalMechanism,
    measurements: Measurements,
    at: tuple[IntArray, IntArray],
    reasons: Sequence[str],
) -> tuple[str, ...]:
    """Return a sentence for each bundle that gives nothing, by view and leg."""
    return tuple(
        f"The {what} of leg {mechanism.leg_names[int(j)]} in view "
        f"{measurements.views[int(v)].name} was left out: {reason}."
        for v, j, reason in zip(*at, reasons, strict=True)
        if reason
    )


def _check_every_leg(
    mechanism: NominalMechanism, located: BoolArray, diagnostics: Sequence[str]
) -> None:
    """Refuse when a leg was located in no view."""
    missing = [mechanism.leg_names[int(j)] for j in np.flatnonzero(~located.any(axis=0))]
    if missing:
        raise NotIdentifiable(
            [
                f"The base joint of leg {name} could not be located: found no view that shows the "
                "leg in two different directions, needed one; add images in which it is visible."
                for name in missing
            ]
            + list(diagnostics)
        )
