"""Covariances, weak directions, responses and score tests of a problem.

All of them follow from the normal equations at one state, eliminated elements marginalised out.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np
from scipy.sparse import csc_array, csr_array, hstack

from legcal.estimation.problem import Linearization, Residuals
from legcal.estimation.solver import (
    FreeSteps,
    Minimum,
    NormalEquations,
    inverse_on_range,
    is_regular,
    normal_equations,
)
from legcal.geometry.types import Array, IntArray

_STIFF = 1e6  # information on tied directions, over the information of measurements
_ROUNDING = 1e-12  # relative error of differences of information
LEAST_SEEN = 1e-7  # part of the square of a column below which the fit absorbs it
_N_WORST = 3  # directions reported
_MIN_COMPONENT = 0.3  # smallest reported component of a direction, over the largest


@dataclass(frozen=True, eq=False)
class WorstDirection:
    """A combination of parameters with a large standard deviation."""

    sigma: float  # standard deviation along the direction, in units of the scaled parameters
    parts: tuple[tuple[str, float], ...]  # largest components of the unit vector

    def __str__(self) -> str:
        return " ".join(f"{value:+.2f} {name}" for name, value in self.parts)


def worst_directions(
    covariance: Array, names: tuple[str, ...], unit: Array
) -> tuple[WorstDirection, ...]:
    """Return the directions of largest variance of parameters in units *unit* (n,), worst first."""
    variance, vector = np.linalg.eigh(covariance / unit[:, None] / unit)
    directions = []
    for i in range(min(_N_WORST, len(names))):
        v = vector[:, -1 - i] * np.sign(vector[np.argmax(np.abs(vector[:, -1 - i])), -1 - i])
        order = np.argsort(-np.abs(v), kind="stable")
        named = [j for j in order if abs(v[j]) >= _MIN_COMPONENT * abs(v[order[0]])][:4]
        sigma = float(np.sqrt(max(variance[-1 - i], 0.0)))
        directions.append(WorstDirection(sigma, tuple((names[j], float(v[j])) for j in named)))
    return tuple(directions)


def named_covariance(linear: Linearization[Any, Any], covariance: Array) -> Array:
    """Return the covariance (n_named, n_named) of coordinates from that of the kept unknowns."""
    problem, n = linear.problem, linear.problem.n_named
    if problem.is_read_directly:
        return covariance[:n, :n].copy()
    by_x = problem.jacobian(linear.state)
    return np.asarray(by_x @ covariance[:n, :n] @ by_x.T)


def named_information(normal: NormalEquations[Any, Any]) -> Array:
    """Return the information (n_named, n_named) of coordinates, other unknowns marginalised out.

    Directions tied by exact constraints count as known a thousand times better than by
    measurements.
    """
    problem, R = normal.problem, normal.reduced()
    n = problem.n_named
    if normal.tangent is not None and len(normal.tangent.ties):
        size = np.sqrt(np.maximum(np.diagonal(R), np.finfo(np.float64).tiny))
        along = np.linalg.qr((normal.tangent.ties / size).T)[0].T * size
        R += _STIFF * along.T @ along
    if n < len(R):
        R = R[:n, :n] - R[:n, n:] @ inverse_on_range(R[n:, n:]) @ R[n:, :n]
    if problem.is_read_directly:
        return R
    back = np.linalg.inv(problem.jacobian(normal.state))
    return np.asarray(back.T @ R @ back)


def marginal(information: Array, which: IntArray) -> Array:
    """Return the information of unknowns *which*, the others marginalised out."""
    others = np.setdiff1d(np.arange(len(information)), which)
    mixed = information[np.ix_(others, which)]
    inverse = inverse_on_range(information[np.ix_(others, others)])
    return np.asarray(information[np.ix_(which, which)] - mixed.T @ inverse @ mixed)


def _element_derivatives(normal: NormalEquations[Any, Any]) -> Array:
    """Jacobian (n_elements, d, n_kept) of elements at their minimum by the kept unknowns."""
    inside = normal.elements_by_kept
    if normal.tangent is None:
        return inside
    return np.asarray(np.moveaxis(normal.tangent.Q, 0, 2) + normal.tangent.Z @ inside)


def leverage(
    normal: NormalEquations[Any, Any],
    name: str,
    covariance: Array | None = None,
    linear: Linearization[Any, Any] | None = None,
) -> Array:
    """Return the covariance (n, q, q) of a factor's predicted measurements, whitened.

    Residuals of fitted measurements have the covariance 1 - C, residuals of held-out measurements
    1 + C. *covariance* (n_kept, n_kept) of the kept unknowns is taken from *normal* by default, and
    so is *linear*, which has the measurements with their derivatives.
    """
    linear = normal.linear if linear is None else linear
    sparsity, rows = linear.problem.sparsity[name], linear[name]
    if covariance is None:
        covariance = normal.kept_covariance()
    share = np.zeros((*rows.r.shape, rows.r.shape[1]))
    padded = np.pad(covariance, (0, 1))  # a zero for fixed coordinates
    if sparsity.element is not None:
        following = _element_derivatives(normal)
        cross_covariance = (following.reshape(-1, len(covariance)) @ covariance).reshape(
            following.shape
        )
        cross_covariance = np.pad(cross_covariance, ((0, 0), (0, 0), (0, 1)))
        element_total = cross_covariance[..., :-1] @ np.swapaxes(following, 1, 2)
        Z = None if normal.tangent is None else normal.tangent.Z
        element_covariance = normal.V_inverse
        element_total += (
            element_covariance if Z is None else Z @ element_covariance @ np.swapaxes(Z, 1, 2)
        )
    for member, columns in sparsity.members:
        J = np.ascontiguousarray(rows.J[member])
        k, q, m = J.shape
        J_covariance = (J.reshape(k * q, m) @ padded[np.ix_(columns, columns)]).reshape(k, q, m)
        if sparsity.element is None:
            share[member] = J_covariance @ np.swapaxes(J, 1, 2)
            continue
        element, J_element = sparsity.element[member], np.ascontiguousarray(rows.J_element[member])
        element_cross = J_element @ cross_covariance[:, :, columns][element]
        crossed = element_cross @ np.swapaxes(J, 1, 2)
        share[member] = (J_covariance + element_cross) @ np.swapaxes(J, 1, 2) + np.swapaxes(
            crossed, 1, 2
        )
        share[member] += J_element @ element_total[element] @ np.swapaxes(J_element, 1, 2)
    return share


def residual_changes(linear: Linearization[Any, Any], block: str, error: Array) -> dict[str, Array]:
    """Return the change of whitened residuals (n, q) of each factor by an error of a block.

    *error* (n, d) has all coordinates of the block, estimated or fixed.
    """
    changes, problem = {}, linear.problem
    width = {variables.name: variables.unknown.shape[1] for variables in problem.variables}
    for factor in problem.factors:
        J, first = linear[factor.name].J, 0
        change = np.zeros(J.shape[:2])
        for name, element, numbers in factor.touches:
            stop = first + len(range(width[name])[numbers]) * int(np.prod(element.shape[1:]))
            if name == block:
                error_of_rows = error[element][..., numbers].reshape(factor.n, stop - first)
                change += np.einsum("nqk,nk->nq", J[..., first:stop], error_of_rows)
            first = stop
        changes[factor.name] = change
    return changes


def response(normal: NormalEquations[Any, Any], changes: Mapping[str, Array]) -> Array:
    """Return the shift (n_kept, c) of the kept unknowns for c changes of whitened residuals.

    *changes* has (n, q, c) for factors by name, which count as much as these do in *normal*.
    """
    kept, _, _ = _gradients(normal, {name: normal.weight[name] * x for name, x in changes.items()})
    return -normal.moved_by(kept.T)


def _gradients(
    normal: NormalEquations[Any, Any], columns: Mapping[str, Any]
) -> tuple[Array, csr_array, csr_array]:
    """Return J^T times whitened columns (n, q, c) of factors by name, and the columns (c, n q).

    For kept unknowns with elements at their minimum (c, n_kept), and for elements in the tangent
    space of their constraints (c, n_elements d). Columns are sparse, and may be given so (n q, c):
    there may be thousands, each of which acts on few measurements.
    """
    problem, c, d = normal.problem, next(iter(columns.values())).shape[-1], normal.problem.d_element
    kept = csr_array((c, problem.n_kept + 1))
    elements = csr_array((c, problem.n_elements * d))
    stacked = []
    for name, of_factor in columns.items():
        sparsity, rows = problem.sparsity[name], normal.linear[name]
        n, q = rows.r.shape
        flat = csr_array(csc_array(of_factor.reshape(n * q, c)).T)
        stacked.append(flat)
        kept += flat @ _scattered(rows.J, sparsity.index, kept.shape[1])
        if sparsity.element is not None:
            unknown = sparsity.element[:, None] * d + np.arange(d)
            elements += flat @ _scattered(rows.J_element, unknown, elements.shape[1])
    following = _element_derivatives(normal).reshape(-1, problem.n_kept)
    of_kept = elements @ following
    of_kept += kept[:, :-1].toarray()
    if normal.tangent is not None:
        elements = elements @ _block_diagonal(normal.tangent.Z)
    return of_kept, elements, hstack(stacked, "csr")


def _block_diagonal(blocks: Array) -> csr_array:
    """Return blocks (n, d, f) as a sparse matrix (n d, n f)."""
    n, _, f = blocks.shape
    return _scattered(blocks, np.arange(n * f).reshape(n, f), n * f)


def _scattered(J: Array, unknown: IntArray, size: int) -> csr_array:
    """Return derivatives (n, q, m) by unknowns (n, m) of *size*, as a sparse matrix (n q, size)."""
    n, q, m = J.shape
    starts, place = m * np.arange(n * q + 1), np.repeat(unknown, q, axis=0)
    return csr_array((J.ravel(), place.ravel(), starts), shape=(n * q, size))


def restricted_log_likelihood(minimum: Minimum[Any]) -> float:
    """Return the log-likelihood of whitened residuals, all unknowns integrated out.

    At a minimum of plain squares, up to the determinants of the whitening and a constant that
    depends on the numbers of unknowns and residuals. Priors of random effects count with their
    variances.
    """
    linear, problem = minimum.linear, minimum.linear.problem
    normal = normal_equations(linear)
    squares = sum(float(np.sum(rows.r**2)) for rows in linear.rows.values())
    squares += float(np.sum(linear.prior_r**2))
    R = normal.free_steps.of(normal.reduced())
    log_determinants = np.linalg.slogdet(R)[1] + np.sum(np.linalg.slogdet(normal.V)[1])
    return -0.5 * (squares + float(log_determinants)) - float(np.log(problem.priors.sigma).sum())


def score_test(
    normal: NormalEquations[Any, Any], columns: Mapping[str, Array]
) -> tuple[Array, Array]:
    """Return Rao's score v^T M r (c,) and its information v^T M v (c, c) of columns v.

    M is the projector onto the residuals of the fit. *columns* has whitened columns (n, q, c) of
    factors by name; *normal* is of plain squares.
    """
    of = Projected.of(normal, columns)
    return of.score, of.information(slice(None), slice(None))


@dataclass(frozen=True, eq=False)
class Projected:
    """Whitened columns less what the fit absorbs of them, with their scores (:func:`score_test`).

    The information of two of them is the product of the columns less that of the responses of all
    unknowns to one and their gradients by the other: there may be thousands.
    """

    score: Array  # (c,)
    size: Array  # (c,) squares of the columns before the fit absorbs its part
    # sparse, (c, m): the measurements of all factors, and the gradients by the elements, which
    # take their responses off
    columns: csr_array
    projected: csr_array
    response: Array  # (c, k) of the kept unknowns
    gradient: Array  # (c, k)

    @classmethod
    def of(cls, normal: NormalEquations[Any, Any], columns: Mapping[str, Any]) -> Projected:
        """Project *columns* (n, q, c) of factors by name; *normal* is of plain squares."""
        gradient, elements, stacked = _gradients(normal, columns)
        response = normal.moved_by(gradient.T).T
        projected = hstack([stacked, -(elements @ _block_diagonal(normal.V_inverse))], "csr")
        residual = [normal.linear[name].r.ravel() for name in columns]
        score = projected @ np.concatenate([*residual, normal.g_elements.ravel()])
        return cls(
            score - response @ _reduced_gradient(normal),
            np.asarray(stacked.multiply(stacked).sum(axis=1)),
            hstack([stacked, elements], "csr"),
            projected,
            response,
            gradient,
        )

    def information(self, of: IntArray | slice, by: IntArray | slice) -> Array:
        """Return v^T M v of some columns by others."""
        products = (self.projected[of] @ self.columns[by].T).toarray()
        return np.asarray(products - self.response[of] @ self.gradient[by].T)

    def at(self, columns: IntArray | slice) -> Scores:
        """Return the scores of some columns."""
        information = self.information(columns, columns)
        return Scores(self.score[columns], information, self.size[columns])

    def given(self, numbers: Estimated) -> Projected:
        """Return the columns less what a fit that has these numbers as well absorbs."""
        toward = self.information(slice(None), numbers.columns) @ numbers.chosen
        return self.less(toward @ numbers.covariance, toward, toward @ numbers.amount)

    def less(self, response: Array, gradient: Array, score: Array) -> Projected:
        """Return the columns less responses (c, k) to further unknowns, with these gradients."""
        return replace(
            self,
            score=self.score - score,
            response=np.concatenate([self.response, response], axis=1),
            gradient=np.concatenate([self.gradient, gradient], axis=1),
        )


class Estimated(NamedTuple):
    """Numbers that a fit lacks, estimated by their scores."""

    columns: IntArray  # (c,)
    chosen: Array  # (c, d) what one unit of each number adds to each of these columns
    amount: Array  # (d,)
    covariance: Array  # (d, d)
    rank: int  # directions of the numbers that the fit does not absorb
    square: float  # of the score over its variance: chi-squared of that rank if all are zero


@dataclass(frozen=True, eq=False)
class Scores:
    """Rao's scores of numbers that a fit lacks, and their information (:func:`score_test`)."""

    score: Array  # (c,)
    information: Array  # (c, c)
    size: Array  # (c,) squares of the columns before the fit absorbs its part

    def estimate(self, columns: IntArray, chosen: Array | None = None) -> Estimated:
        """Estimate numbers together: one for each column, or *chosen* (c, d) sums of columns."""
        chosen = np.eye(len(columns)) if chosen is None else chosen
        return self.estimates(columns, chosen[None])[0]

    def estimates(self, columns: IntArray, chosen: Array) -> list[Estimated]:
        """Estimate the numbers of t tests, each by itself: *chosen* (t, c, d) sums of columns."""
        sums = np.swapaxes(chosen, 1, 2)
        score = sums @ self.score[columns]
        information = sums @ (self.information[np.ix_(columns, columns)] @ chosen)
        scale = np.sqrt(np.maximum(sums @ self.size[columns], np.finfo(np.float64).tiny))
        value, vector = np.linalg.eigh(information / scale[:, None] / scale[..., None])
        seen = value > LEAST_SEEN
        root = vector * np.sqrt(seen / np.where(seen, value, 1.0))[:, None] / scale[..., None]
        covariance = root @ np.swapaxes(root, 1, 2)
        amount = (covariance @ score[..., None])[..., 0]
        square = np.sum(score * amount, axis=1).tolist()
        found = zip(chosen, amount, covariance, seen.sum(axis=1).tolist(), square, strict=True)
        return [Estimated(columns, *one) for one in found]

    def left(self, numbers: Sequence[Estimated]) -> tuple[Array, Array]:
        """Return scores (t, c) and variances of columns in fits that have the numbers of a test."""
        chosen = np.stack([one.chosen for one in numbers])
        amount = np.stack([one.amount for one in numbers])
        covariance = np.stack([one.covariance for one in numbers])
        toward = self.information[:, numbers[0].columns] @ chosen
        score = self.score - (toward @ amount[..., None])[..., 0]
        absorbed = np.sum((toward @ covariance) * toward, axis=2)
        return score, np.diagonal(self.information) - absorbed

    def given(self, numbers: Estimated) -> Scores:
        """Return the scores of a fit that has these numbers as well."""
        toward = self.information[:, numbers.columns] @ numbers.chosen
        return replace(
            self,
            score=self.score - toward @ numbers.amount,
            information=self.information - toward @ numbers.covariance @ toward.T,
        )


def size_left(scores: Scores, covariance: Array) -> Array:
    """Return how large numbers may be that a fit takes as zero, by their scores and a prior.

    The root (c, c) of their mean products, with the *covariance* (c, c) as prior.
    """
    root = np.linalg.cholesky(covariance)
    value, vector = np.linalg.eigh(root.T @ scores.information @ root)
    left = (root @ vector) / np.sqrt(1.0 + np.maximum(value, 0.0))
    mean = left @ left.T @ scores.score
    value, vector = np.linalg.eigh(left @ left.T + np.outer(mean, mean))
    return np.asarray(vector * np.sqrt(np.maximum(value, 0.0)))


@dataclass(frozen=True, eq=False)
class LeftOut:
    """How well blocks of eliminated elements are predicted by all else."""

    squares: Array  # (n_blocks,) squared Mahalanobis distances of measurements from predictions
    n_residuals: IntArray  # (n_blocks,)
    block: IntArray  # (n_elements,) of each element, from 0
    everything: NormalEquations[Any, Any]
    rest: tuple[NormalEquations[Any, Any], ...]  # without each block

    @property
    def dof(self) -> IntArray:
        """Independent innovations (n_blocks,), without what only the block determines."""
        of_all, *of_rest = (
            int(_ranks(normal.reduced()[None])[0]) for normal in (self.everything, *self.rest)
        )
        own = np.bincount(self.block, _ranks(self.everything.V), len(self.rest)).astype(np.intp)
        return np.asarray(self.n_residuals - (of_all - np.array(of_rest)) - own, dtype=np.intp)


def left_out_blocks(linear: Linearization[Any, Any], block: IntArray) -> LeftOut:
    """Return how well blocks of eliminated elements are predicted by all else.

    The block of each element is given, (n_elements,) from 0. The measurements of a block are
    compared with the fit without them, one Gauss-Newton step from here: the squares are those of
    their innovations, whitened by the covariance of these. For right models they are as large as
    their number.
    """
    n_blocks = int(block.max(initial=-1)) + 1
    everything, without = normal_equations(linear), list[NormalEquations[Any, Any]]()
    gradient, squares = _reduced_gradient(everything), np.zeros(n_blocks)
    n_residuals = np.zeros(n_blocks, dtype=np.intp)
    for b in range(n_blocks):
        rows = dict(linear.rows)
        for factor in linear.problem.factors:
            if factor.element is None:
                continue
            is_inside, of_factor = block[factor.element] == b, linear[factor.name]
            kept = np.where(is_inside, 0.0, 1.0)[:, None]
            rows[factor.name] = Residuals.of(
                kept * of_factor.r,
                kept[..., None] * of_factor.J,
                kept[..., None] * of_factor.J_element,
            )
            inside = of_factor.squared_norms[is_inside]
            squares[b] += float(inside.sum())
            n_residuals[b] += factor.n_rows * int(np.sum(inside > 0.0))
        rest = normal_equations(replace(linear, rows=rows))
        pull = _reduced_gradient(rest) - gradient
        squares[b] += float(pull @ rest.moved_by(pull[:, None])[:, 0])
        without.append(rest)
    return LeftOut(squares, n_residuals, block, everything, tuple(without))


def _reduced_gradient(normal: NormalEquations[Any, Any]) -> Array:
    """Return the gradient (n_kept,) of kept unknowns, elements at their minimum."""
    elements = (normal.V_inverse @ normal.g_elements[..., None])[..., 0]
    return np.asarray(normal.g_kept - np.einsum("akp,kp->a", normal.W, elements))


def _ranks(matrices: Array) -> IntArray:
    """Return the ranks of information matrices (k, n, n), whatever their units."""
    diagonal = np.einsum("kii->ki", matrices)
    scale = np.sqrt(np.maximum(diagonal, np.finfo(np.float64).tiny))
    scaled = matrices / scale[:, :, None] / scale[:, None, :]
    ranks = np.full(len(matrices), matrices.shape[1])
    singular = ~is_regular(scaled)  # at a fraction of the cost of eigenvalues
    ranks[singular] = np.linalg.matrix_rank(scaled[singular], tol=_ROUNDING, hermitian=True)
    return ranks


def scores_of_block(linear: Linearization[Any, Any], name: str) -> tuple[Array, Array]:
    """Return the scores z of a block of random effects at zero effects, and their covariance K.

    z (b,) is B^T M r with B the whitened effects, r the residuals without any effect and M the
    projector onto the residuals of the fit; K (b, b) is B^T M B, the covariance for zero effects.

    The problem has the block as the last named one, each of its unknowns with a prior of mean zero;
    near a minimum with some of the effects or none: the Gauss-Newton step from there is taken into
    account.
    """
    problem, normal = linear.problem, normal_equations(linear)
    R = normal.reduced()
    g = _reduced_gradient(normal)
    effects, block = problem.where(name), problem.block(name)
    value = block.read(getattr(linear.state, name))
    others = np.setdiff1d(np.arange(len(R)), effects)
    prior_information = 1.0 / block.prior.sigma**2
    R_others, R_mixed = R[np.ix_(others, others)], R[np.ix_(others, effects)]
    free = FreeSteps.without(normal.held_directions[:, others])
    inverse = free.extended(free.extended(inverse_on_range(free.of(R_others))).T).T
    block_information = R[np.ix_(effects, effects)] - np.diag(prior_information)
    K = block_information - R_mixed.T @ inverse @ R_mixed
    K = 0.5 * (K + K.T)
    try:
        np.linalg.cholesky(K + _ROUNDING * np.diag(np.diagonal(block_information)))
    except np.linalg.LinAlgError:
        # Cancellation where measurements determine little: project onto semidefinite matrices.
        eigenvalue, vector = np.linalg.eigh(K)
        K = (vector * np.maximum(eigenvalue, 0.0)) @ vector.T
    block_score = g[effects] - prior_information * value - R_mixed.T @ inverse @ g[others]
    return K @ value - block_score, K


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
