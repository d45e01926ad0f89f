"""Where axes meet, eq (6), and by how much they miss a joint: the point nearest to a bundle.

An outline pair says very exactly in which plane through the camera centre a joint lies, and little
about its depth, so that the miss of an axis is weighted by its covariance.
"""

from __future__ import annotations

import numpy as np

from legcal.geometry.lines import normal_basis
from legcal.geometry.types import Array, BoolArray, IntArray
from legcal.observations.leg_axes import LegAxes
from legcal.stages.bundles import Bundles
from legcal.stages.doubts import too_uncertain

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
