"""Covariances, batched."""

import numpy as np

from legcal.geometry.types import Array


def whitener(covariance: Array) -> Array:
    """Return lower triangular W with W C W^T = 1, of positive definite covariances (..., n, n)."""
    return np.asarray(np.linalg.inv(np.linalg.cholesky(covariance)))
