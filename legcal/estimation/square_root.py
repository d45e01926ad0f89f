"""Square-root information: whitened rows R with R^T R the information matrix.

Normal equations square the condition number. Rank decisions, with exact constraints of a mechanism
beside weak observations, therefore use the rows: orthogonal transformations eliminate nuisance
unknowns without loss of information, including unknowns that the rows do not determine.
"""

from __future__ import annotations

import numpy as np

from legcal.geometry.types import Array, IntArray

_UNKNOWN = 1e-3  # [1 / unit]: singular values up to here count as undetermined unknowns


def marginal_rows(rows: Array, which: IntArray) -> Array:
    """Marginalise out all unknowns of rows (m, n) but *which*; return rows (c, c)."""
    others = np.setdiff1d(np.arange(rows.shape[1]), which)
    return compress(eliminate(rows[None][:, :, np.append(others, which)], len(others)))


def eliminate(
    # (k, r, n_nuisance + n_shared): rows of each group, one over the unit of the unknowns
    rows: Array,
    n_nuisance: int,  # number of leading columns: nuisance unknowns of each group
) -> Array:
    """Marginalise out the nuisance unknowns of each group of rows; return rows (m, n_shared).

    A QR decomposition and an SVD rotate the rows until as few as possible contain nuisance
    unknowns, and these rows are dropped: exact also where the nuisance unknowns are not determined.
    """
    n_shared = rows.shape[2] - n_nuisance
    if rows.shape[0] == 0 or rows.shape[1] == 0:
        return np.zeros((0, n_shared))
    if n_nuisance == 0:
        return rows.reshape(-1, n_shared)
    if rows.shape[1] < n_nuisance:
        missing = n_nuisance - rows.shape[1]
        rows = np.concatenate([rows, np.zeros((len(rows), missing, rows.shape[2]))], axis=1)
    upper = np.asarray(np.linalg.qr(rows, mode="r"))
    left, singular, _ = np.linalg.svd(upper[:, :n_nuisance, :n_nuisance])
    rotated = np.swapaxes(left, 1, 2) @ upper[:, :n_nuisance, n_nuisance:]
    lower = upper[:, n_nuisance:, n_nuisance:]
    return np.concatenate([rotated[singular <= _UNKNOWN], lower.reshape(-1, n_shared)])


def compress(rows: Array) -> Array:
    """Return the square rows (p, p) of the same information as rows (m, p)."""
    n = rows.shape[1]
    upper = np.asarray(np.linalg.qr(rows, mode="r")) if len(rows) else np.zeros((0, n))
    return np.concatenate([upper, np.zeros((n - len(upper), n))])
