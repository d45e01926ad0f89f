"""Covariances, batched."""

import numpy as np

from legcal.geometry.types import Array


def whitener(covariance: Array) -> Array:
    """Return lower triangular W with W C W^T = 1, of positive definite covariances (..., n, n)."""
    if covariance.shape[-1] != 2:
        return np.asarray(np.linalg.inv(np.linalg.cholesky(covariance)))
    # Many small matrices: written out, with equal entries contiguous.
    (first, _), (mixed, second) = np.moveaxis(covariance, (-2, -1), (0, 1))
    W = np.zeros((2, 2, *first.shape))
    with np.errstate(invalid="ignore", divide="ignore"):
        np.divide(1.0, np.sqrt(first), out=W[0, 0])
        slope = mixed / first
        np.divide(1.0, np.sqrt(second - slope * mixed), out=W[1, 1])
    np.multiply(-slope, W[1, 1], out=W[1, 0])
    if not np.isfinite(W).all():
        raise np.linalg.LinAlgError("Matrix is not positive definite")
    return np.moveaxis(W, (0, 1), (-2, -1))
