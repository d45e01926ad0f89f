"""Information in square-root form: whitened rows R with R^T R the information matrix.

Normal equations square the range between what is known best and worst. Where ranks are decided,
and constraints of a mechanism stand beside weak observations, the rows are kept: orthogonal
transformations eliminate unknowns without loss, also where the rows do not determine them.
"""

from __future__ import annotations

import numpy as np

from legcal.estimation.problem import Problem, S, linearize
from legcal.geometry.types import Array, IntArray

_UNKNOWN = 1e-3  # [1 / unit]: singular values of unknowns that count as not determined


def information_rows(problem: Problem[S], state: S) -> Array:
    """Return rows (m, n_kept) of the kept unknowns, eliminated elements being free.

    Their R^T R is the reduced matrix of ``information``, without a loss.
    """
    linear = linearize(problem, state)
    free, by_element = [linear.prior_J], []
    for factor in problem.factors:
        where, rows = problem.places[factor.name], linear[factor.name]
        n, q, _ = rows.J.shape
        J = np.zeros((n, q, problem.n_kept + 1))
        measurement, row = np.arange(n)[:, None, None], np.arange(q)[None, :, None]
        np.add.at(J, (measurement, row, where.index[:, None, :]), rows.J)
        J = J[..., :-1]
        if where.element is None:
            free.append(J.reshape(n * q, problem.n_kept))
        else:
            both = np.concatenate([rows.J_element, J], axis=2)
            by_element.append(grouped(both, where.element, problem.n_elements))
    if by_element:
        free.append(shortened(eliminate(np.concatenate(by_element, axis=1), problem.d_element)))
    return np.concatenate(free)


def marginal_rows(rows: Array, which: IntArray) -> Array:
    """Return rows (c, c) of some unknowns, all others of rows (m, n) being free."""
    others = np.setdiff1d(np.arange(rows.shape[1]), which)
    return compress(eliminate(rows[None][:, :, np.append(others, which)], len(others)))


def eliminate(
    # (k, r, n_own + n_shared): rows of each group, one over the unit of the unknowns
    rows: Array,
    n_own: int,  # number of unknowns, the first ones, that each group has for itself
) -> Array:
    """Return what groups of rows say about shared unknowns when their own ones are free.

    Rows are turned until as few as possible contain the own unknowns, which are then dropped:
    nothing is lost where the rows do not determine the own unknowns.

    Returns (m, n_shared).
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
    rest = upper[:, n_own:, n_own:]
    return np.concatenate([top[singular <= _UNKNOWN], rest.reshape(-1, n_shared)])


def compress(rows: Array) -> Array:
    """Return rows (p, p) that say the same as rows (m, p)."""
    n = rows.shape[1]
    upper = np.asarray(np.linalg.qr(rows, mode="r")) if len(rows) else np.zeros((0, n))
    return np.concatenate([upper, np.zeros((n - len(upper), n))])


def shortened(rows: Array) -> Array:
    """Return no more rows than unknowns that say the same."""
    return rows if len(rows) < rows.shape[1] else compress(rows)


def grouped(rows: Array, group: IntArray, n_groups: int) -> Array:
    """Return rows (n, r, c) of members laid out by group, (n_groups, most * r, c), with zeros."""
    number = np.bincount(group, minlength=n_groups)
    place = np.zeros(len(group), dtype=np.intp)
    order = np.argsort(group, kind="stable")
    place[order] = np.arange(len(group)) - np.repeat(np.cumsum(number) - number, number)
    most = int(number.max(initial=0))
    laid = np.zeros((n_groups, most, *rows.shape[1:]))
    laid[group, place] = rows
    return laid.reshape(n_groups, most * rows.shape[1], rows.shape[2])
