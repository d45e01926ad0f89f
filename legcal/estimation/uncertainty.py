"""Covariances, weak directions, responses and score tests of a problem.

All of it follows from the normal equations at one state, eliminated elements following.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from scipy.linalg import null_space

from legcal.estimation.problem import Linearization, Places, Problem, Residuals, S, linearize
from legcal.estimation.solver import (
    Minimum,
    NormalEquations,
    inverse_on_range,
    normal_equations,
)
from legcal.geometry.types import Array, IntArray

_STIFF = 1e6  # information on what is tied, over that of measurements
_ROUNDING = 1e-12  # of information, in differences
_N_WORST = 3  # directions that are named
_MIN_COMPONENT = 0.3  # components of a direction that are named, relative to the largest


@dataclass(frozen=True, eq=False)
class WorstDirection:
    """A combination of parameters that is known worst."""

    sigma: float  # standard deviation along it, in the unit of the scaled parameters
    parts: tuple[tuple[str, float], ...]  # its largest components, as a unit vector

    def __str__(self) -> str:
        return " ".join(f"{value:+.2f} {name}" for name, value in self.parts)


def worst_directions(
    covariance: Array, names: tuple[str, ...], unit: Array
) -> tuple[WorstDirection, ...]:
    """Return the few directions known worst, worst first; parameters count in *unit* (n,) each."""
    variance, vector = np.linalg.eigh(covariance / unit[:, None] / unit)
    found = []
    for i in range(min(_N_WORST, len(names))):
        v = vector[:, -1 - i] * np.sign(vector[np.argmax(np.abs(vector[:, -1 - i])), -1 - i])
        order = np.argsort(-np.abs(v), kind="stable")
        named = [j for j in order if abs(v[j]) >= _MIN_COMPONENT * abs(v[order[0]])][:4]
        sigma = float(np.sqrt(max(variance[-1 - i], 0.0)))
        found.append(WorstDirection(sigma, tuple((names[j], float(v[j])) for j in named)))
    return tuple(found)


def named_covariance(problem: Problem[S], state: S, covariance: Array) -> Array:
    """Return the covariance (n_named, n_named) of coordinates from that of all kept unknowns."""
    n = problem.n_named
    if problem.is_read_directly:
        return covariance[:n, :n].copy()
    by_x = problem.jacobian(state)
    return np.asarray(by_x @ covariance[:n, :n] @ by_x.T)


def named_information(problem: Problem[S], state: S, normal: NormalEquations) -> Array:
    """Return the normal matrix (n_named, n_named) of coordinates, all else unknown.

    What exact constraints tie counts as known a thousand times better than by measurements.
    """
    R, n = normal.reduced(), problem.n_named
    if normal.tangent is not None and len(normal.tangent.ties):
        size = np.sqrt(np.maximum(np.diagonal(R), np.finfo(np.float64).tiny))
        along = np.linalg.qr((normal.tangent.ties / size).T)[0].T * size
        R += _STIFF * along.T @ along
    if n < len(R):
        R = R[:n, :n] - R[:n, n:] @ inverse_on_range(R[n:, n:]) @ R[n:, :n]
    if problem.is_read_directly:
        return R
    back = np.linalg.inv(problem.jacobian(state))
    return np.asarray(back.T @ R @ back)


def marginal(information: Array, which: IntArray) -> Array:
    """Return the normal matrix of some unknowns with all others unknown."""
    others = np.setdiff1d(np.arange(len(information)), which)
    mixed = information[np.ix_(others, which)]
    inverse = inverse_on_range(information[np.ix_(others, others)])
    return np.asarray(information[np.ix_(which, which)] - mixed.T @ inverse @ mixed)


def _following(normal: NormalEquations) -> Array:
    """Return how eliminated elements follow kept unknowns, (n_elements, d, n_kept)."""
    inside = normal.elements_by_kept
    if normal.tangent is None:
        return inside
    return np.asarray(np.moveaxis(normal.tangent.Q, 0, 2) + normal.tangent.Z @ inside)


def explained_share(
    problem: Problem[S],
    linear: Linearization,
    normal: NormalEquations,
    name: str,
    covariance: Array | None = None,
) -> Array:
    """Return the covariance (n, q, q) of a factor's predicted whitened residuals.

    Residuals of fitted measurements have covariance one minus this, those of others one plus this.
    *covariance* is that of the kept unknowns, if not that of these equations.
    """
    where, rows = problem.places[name], linear[name]
    if covariance is None:
        covariance = normal.kept_covariance()
    share = np.zeros((*rows.r.shape, rows.r.shape[1]))
    padded = np.pad(covariance, (0, 1))  # no unknown has no variance
    if where.element is not None:
        following = _following(normal)
        with_kept = (following.reshape(-1, len(covariance)) @ covariance).reshape(following.shape)
        with_kept = np.pad(with_kept, ((0, 0), (0, 0), (0, 1)))
        of_elements = with_kept[..., :-1] @ np.swapaxes(following, 1, 2)
        Z = None if normal.tangent is None else normal.tangent.Z
        left = normal.V_inverse
        of_elements += left if Z is None else Z @ left @ np.swapaxes(Z, 1, 2)
    for member, columns in where.members:
        J = np.ascontiguousarray(rows.J[member])
        k, q, m = J.shape
        along = (J.reshape(k * q, m) @ padded[np.ix_(columns, columns)]).reshape(k, q, m)
        if where.element is None:
            share[member] = along @ np.swapaxes(J, 1, 2)
            continue
        element, own = where.element[member], np.ascontiguousarray(rows.J_element[member])
        mixed = own @ with_kept[:, :, columns][element]
        crossed = mixed @ np.swapaxes(J, 1, 2)
        share[member] = (along + mixed) @ np.swapaxes(J, 1, 2) + np.swapaxes(crossed, 1, 2)
        share[member] += own @ of_elements[element] @ np.swapaxes(own, 1, 2)
    return share


def residual_changes(
    problem: Problem[S], linear: Linearization, block: str, error: Array
) -> dict[str, Array]:
    """Return how whitened residuals (n, q) of each factor change with an error of a block's values.

    *error* (n, d) is of all numbers of the block, whether they are unknowns or fixed.
    """
    changes = {}
    width = {variables.name: variables.unknown.shape[1] for variables in problem.variables}
    for factor in problem.factors:
        J, first = linear[factor.name].J, 0
        change = np.zeros(J.shape[:2])
        for name, element, numbers in factor.touches:
            end = first + len(range(width[name])[numbers]) * int(np.prod(element.shape[1:]))
            if name == block:
                by = error[element][..., numbers].reshape(factor.n, end - first)
                change += np.einsum("nqk,nk->nq", J[..., first:end], by)
            first = end
        changes[factor.name] = change
    return changes


def response(
    problem: Problem[S],
    linear: Linearization,
    normal: NormalEquations,
    changes: Mapping[str, Array],
) -> Array:
    """Return how kept unknowns (n_kept, c) move when factors' whitened residuals do.

    *changes* has (n, q, c) for factors by name, c different changes.
    """
    n_changes = next(iter(changes.values())).shape[-1]
    gradient = np.zeros((problem.n_kept + 1, n_changes))
    elements = np.zeros((problem.n_elements, problem.d_element, n_changes))
    for name, change in changes.items():
        where, rows = problem.places[name], linear[name]
        _add_products(where, rows, change, gradient, elements)
    kept = gradient[:-1]
    if normal.tangent is not None:
        kept = kept + np.einsum("akp,kpc->ac", normal.tangent.Q, elements, optimize=True)
        elements = np.swapaxes(normal.tangent.Z, 1, 2) @ elements
    kept = kept - np.einsum("akf,kfc->ac", normal.W, normal.V_inverse @ elements, optimize=True)
    return -normal.moved_by(kept)


def _add_products(
    where: Places, rows: Residuals, columns: Array, kept: Array, elements: Array
) -> None:
    """Add J^T times columns (n, q, c) of a factor to sums of (n_kept + 1, c) and of elements."""
    c = columns.shape[-1]
    for member, places in where.members:
        J = rows.J[member]
        flat = J.reshape(J.shape[0] * J.shape[1], J.shape[2])  # of no columns, too
        np.add.at(kept, places, flat.T @ columns[member].reshape(-1, c))
    if where.element is not None:
        np.add.at(elements, where.element, np.swapaxes(rows.J_element, 1, 2) @ columns)


def restricted_log_likelihood(problem: Problem[S], minimum: Minimum[S]) -> float:
    """Return the logarithm of the likelihood of whitened residuals, all unknowns integrated out.

    Of a minimum of plain squares, up to a constant of the numbers of unknowns and residuals and
    the determinants of the whitening. Priors of random effects count with their variances.
    """
    linear = minimum.linear
    normal = normal_equations(problem, minimum.state, linear)
    squares = sum(float(np.sum(rows.r**2)) for rows in linear.rows.values())
    squares += float(np.sum(linear.prior_r**2))
    R = normal.reduced()
    if len(normal.held_directions):
        N = null_space(normal.held_directions)
        R = N.T @ R @ N
    widths = np.linalg.slogdet(R)[1] + np.sum(np.linalg.slogdet(normal.V)[1])
    return -0.5 * (squares + float(widths)) - float(np.log(problem.priors.sigma).sum())


def score_test(
    problem: Problem[S],
    linear: Linearization,
    normal: NormalEquations,
    columns: Mapping[str, Array],
) -> tuple[Array, Array]:
    """Return v^T M r (c,) and v^T M v (c, c), M projecting onto residuals: Rao's test of columns v.

    *columns* has whitened columns (n, q, c) of factors by name; *normal* is of plain squares.
    """
    c = next(iter(columns.values())).shape[-1]
    of_kept, score, left = np.zeros((problem.n_kept + 1, c)), np.zeros(c), np.zeros((c, c))
    of_elements = np.zeros((problem.n_elements, problem.d_element, c))
    for name, v in columns.items():
        _add_products(problem.places[name], linear[name], v, of_kept, of_elements)
        score += np.einsum("nqc,nq->c", v, linear[name].r)
        left += np.einsum("nqc,nqd->cd", v, v)
    kept = of_kept[:-1] + np.einsum("kda,kdc->ac", _following(normal), of_elements, optimize=True)
    by_element = of_elements
    if normal.tangent is not None:
        by_element = np.swapaxes(normal.tangent.Z, 1, 2) @ of_elements
    following = normal.V_inverse @ by_element
    elements = (normal.V_inverse @ normal.g_elements[..., None])[..., 0]
    g_kept = normal.g_kept - np.einsum("akp,kp->a", normal.W, elements)
    moved = normal.moved_by(kept)
    score = score - moved.T @ g_kept - np.einsum("kpc,kp->c", following, normal.g_elements)
    left = left - moved.T @ kept - np.einsum("kpc,kpd->cd", following, by_element)
    return score, left


def scores_of_block(problem: Problem[S], state: S, name: str) -> tuple[Array, Array]:
    """Return the scores of a block of random effects where all of them are zero.

    Parameters
    ----------
    problem : Problem
        With the block, whose every unknown has a prior of mean zero and its own, and comes last
        of the named.
    state : S
        Near a minimum of the problem with some of them or none; Gauss-Newton's step from there is
        taken into account.
    name : str
        The block.

    Returns
    -------
    z : (b,) array
        B^T M r with B the whitened effects, r the residuals without any effect and M the projector
        onto the residuals of the fit.
    K : (b, b) array
        B^T M B: the covariance of z if all effects are zero.
    """
    normal = normal_equations(problem, state, linearize(problem, state))
    R = normal.reduced()
    elements = (normal.V_inverse @ normal.g_elements[..., None])[..., 0]
    g = normal.g_kept - np.einsum("akp,kp->a", normal.W, elements)
    effects, block = problem.where(name), problem.block(name)
    value = block.read(getattr(state, name))
    others = np.setdiff1d(np.arange(len(R)), effects)
    of_prior = 1.0 / block.prior.sigma**2
    R_others, R_mixed = R[np.ix_(others, others)], R[np.ix_(others, effects)]
    if len(normal.held_directions):
        N = null_space(normal.held_directions[:, others])
        inverse = N @ inverse_on_range(N.T @ R_others @ N) @ N.T
    else:
        inverse = inverse_on_range(R_others)
    every = R[np.ix_(effects, effects)] - np.diag(of_prior)
    K = every - R_mixed.T @ inverse @ R_mixed
    K = 0.5 * (K + K.T)
    try:
        np.linalg.cholesky(K + _ROUNDING * np.diag(np.diagonal(every)))
    except np.linalg.LinAlgError:
        # A difference of what nearly cancels where measurements determine little.
        eigenvalue, vector = np.linalg.eigh(K)
        K = (vector * np.maximum(eigenvalue, 0.0)) @ vector.T
    left = g[effects] - of_prior * value - R_mixed.T @ inverse @ g[others]
    return K @ value - left, K
