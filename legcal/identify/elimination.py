"""Unknowns that nobody asks for: what rows say about the others once these are free."""

import numpy as np

from legcal.geometry.types import Array

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
