"""Levenberg-Marquardt on a problem, with the Schur complement over eliminated elements.

N x = -g with N = [[U, W], [W^T, V]]: kept unknowns first, then one block for each eliminated
element. V is block diagonal, so that only the Schur complement U - W V^-1 W^T has to be solved.
If exact constraints apply to the elements, V, W and their gradient are in coordinates y of the
tangent space of the constraints (:class:`Tangent`), and every step ends with a projection.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Any, Generic

import numpy as np
from scipy.linalg import cho_factor, cho_solve, null_space
from scipy.linalg.lapack import dpotrf, dtrtri

from legcal.errors import DidNotConverge
from legcal.estimation.loss import LEAST_SQUARES, Loss, PseudoHuber
from legcal.estimation.problem import (
    EstimationProblem,
    Linearization,
    P,
    Residuals,
    S,
    Sparsity,
    Tangent,
    linearize,
)
from legcal.geometry.types import Array, BoolArray, IntArray

_FIRST_DAMPING = 1e-6
_MIN_DAMPING = 1e-10
_MAX_DAMPING = 1e8
COST_TOLERANCE = 1e-12  # predicted decrease of the cost at convergence, in squared sigmas
_LAST_TOLERANCE = 1e-6  # the same after the last step: steps of a thousandth of a sigma
_ROUNDING = 1e-13  # relative rounding error of the cost
_WIDTH_IN_MEDIANS = 5.0  # width of the loss in median residuals, while these exceed the final width
_SLOW_FALL = 0.5  # relative decrease of the cost, below which the loss follows the median
_MIN_NARROWING = 0.8  # ratio of widths, above which the loss is not changed
_CONVERGED_FALL = 0.01  # relative decrease of the cost, below which the loss is always narrowed
_NARROWED = 0.5  # by this factor
_MAX_ELEMENT_STEPS = 3
_NEARLY_LINEAR = 0.99  # gain ratio, above which damping is dropped
_NEARLY_LINEAR_DECAY = 1e-3
_DAMPING_MARGIN = 3.0  # least damping after a failure, over the damping that failed
_DAMPING_DECAY = 0.3  # decay of the failed damping per step
_MIN_ITERATIONS = 30  # iterations before the relative tolerance applies
_RANK_TOLERANCE = 1e-13  # eigenvalue that is rounding, relative to the largest
_MIN_PIVOT = 1e-9  # a scaled block with a pivot below may be singular
_MIN_SIZE_FOR_FACTOR = 16  # larger matrices are inverted by their Cholesky factor


@dataclass(frozen=True, eq=False)
class Minimum(Generic[S]):
    """A minimum of the robust cost."""

    state: S
    linear: Linearization[Any, S]
    cost: float
    iterations: int  # attempted steps
    rate: float = 1.0  # predicted decrease of the last step over that of the step before


def minimise(
    problem: EstimationProblem[S],
    state: S,
    loss: Loss = LEAST_SQUARES,
    *,
    max_iterations: int = 200,  # attempted steps
    is_near: bool = False,  # the start is the minimum for other weights: no damping of a first step
    tolerance: float = COST_TOLERANCE,  # predicted decrease at convergence, in squared sigmas
    # relative decrease at convergence, after the first 30 steps: outliers make the cost nearly
    # linear, and its last decreases slow
    relative_tolerance: float = 0.0,
    must_converge: bool = True,  # raise if the steps do not; otherwise return the best state
    # that of a minimum nearby: it predicts the decrease after the first step, which may then be the
    # only one
    rate: float = 1.0,
) -> Minimum[S]:
    """Minimise the robust cost from a state.

    A pseudo-Huber loss starts wide enough for most residuals and is narrowed while converging. At
    its final width the first of three criteria stops the iteration: the predicted decrease of the
    cost is at rounding, it is below *tolerance*, or, after the first 30 steps, it is below
    *relative_tolerance* times the cost.

    Raises DidNotConverge if no step decreases the cost before convergence, or if the cost still
    falls by more than 1e-6 a step after *max_iterations* steps.
    """
    linear = linearize(problem, problem.projected(state))
    current_loss = _loss_for(linear, loss, np.inf)
    damping, failed, fall_before = _MIN_DAMPING if is_near else _FIRST_DAMPING, 0.0, np.inf
    cost, normal = robust_cost(linear, current_loss), None
    for iteration in range(1, max_iterations + 1):
        normal = normal or normal_equations(linear, current_loss)
        step, predicted = normal.step(damping)
        converged = predicted < COST_TOLERANCE + _ROUNDING * cost
        trial = _take_step(linear, step)
        trial_cost = np.inf if trial is None else robust_cost(trial, current_loss)
        if trial is not None and not converged and not trial_cost < cost:
            trial = _correct_elements(trial, current_loss, cost)
            trial_cost = np.inf if trial is None else robust_cost(trial, current_loss)
        fall = cost - trial_cost
        if trial is None or not np.isfinite(fall) or not (fall > 0.0 or converged):
            failed, damping = damping, 10.0 * damping
            fall_before, rate = np.inf, 1.0
            if damping > _MAX_DAMPING:
                break
            continue
        linear, cost, normal = trial, trial_cost, None
        damping = max(
            _next_damping(damping, fall / max(predicted, 1e-300)), _DAMPING_MARGIN * failed
        )
        failed *= _DAMPING_DECAY
        if np.isfinite(fall_before):
            rate = min(predicted / fall_before, 1.0)
        expected = predicted * rate
        narrowed = current_loss
        if expected < _SLOW_FALL * cost:
            narrowed = _loss_for(linear, loss, current_loss.width)
        if narrowed.width == current_loss.width and expected < _CONVERGED_FALL * cost:
            narrowed = _with_width(loss, max(loss.width, _NARROWED * current_loss.width))
        if narrowed.width != current_loss.width:
            current_loss, fall_before, rate = narrowed, np.inf, 1.0
            cost = robust_cost(linear, current_loss)
            continue
        smallest = relative_tolerance * cost if iteration > _MIN_ITERATIONS else 0.0
        if converged or expected < max(smallest, tolerance):
            return Minimum(linear.state, linear, cost, iteration, rate)
        fall_before = predicted
    if not must_converge or (iteration == max_iterations and predicted < _LAST_TOLERANCE):
        return Minimum(linear.state, linear, cost, iteration)
    raise DidNotConverge(
        f"The {problem.name} did not converge: after {iteration} steps, the cost still falls by "
        f"{predicted:.2g} a step; {problem.remedy}."
    )


def robust_cost(linear: Linearization[Any, Any], loss: Loss) -> float:
    """Return half the squares of priors and plain factors, plus the loss of robust factors."""
    plain, robust = float(linear.prior_r @ linear.prior_r), 0.0
    for factor in linear.problem.factors:
        rows = linear[factor.name]
        if factor.robust:
            robust += loss.cost(rows.squared_norms)
        else:
            plain += float(rows.squared_norms.sum())
    return 0.5 * plain + robust


def _with_width(loss: Loss, width: float) -> Loss:
    """Change the width of a pseudo-Huber loss; others stay."""
    return PseudoHuber(width) if isinstance(loss, PseudoHuber) else loss


def _loss_for(linear: Linearization[Any, Any], loss: Loss, previous_width: float) -> Loss:
    """Widen the loss to a few median residuals while these exceed its final width."""
    if np.isinf(loss.width):
        return loss
    medians = [0.0]
    for factor in linear.problem.factors:
        if factor.robust:
            norms = linear[factor.name].squared_norms
            norms = norms[norms > 0.0]
            medians += [float(np.sqrt(np.median(norms)))] if len(norms) else []
    median = max(medians)  # the largest: some kinds of measurements converge first
    width = loss.width if median <= loss.width else _WIDTH_IN_MEDIANS * median
    narrows = width == loss.width or width < _MIN_NARROWING * previous_width
    return _with_width(loss, width if narrows else previous_width)


def _next_damping(damping: float, gain_ratio: float) -> float:
    """Damping after a step with a ratio of actual to predicted decrease of the cost."""
    if gain_ratio > 0.75:
        decay = _NEARLY_LINEAR_DECAY if gain_ratio > _NEARLY_LINEAR else 0.1
        return max(decay * damping, _MIN_DAMPING)
    return damping if gain_ratio > 0.25 else 4.0 * damping


def _take_step(linear: Linearization[P, S], step: Array) -> Linearization[P, S] | None:
    """Take a step, shortened to the step limits; None if the new state is not defined."""
    problem = linear.problem
    if not np.all(np.isfinite(step)):
        return None
    try:
        moved = problem.moved(linear.state, step / max(problem.overshoot(step), 1.0))
        moved = problem.projected(moved)
    except DidNotConverge:
        return None
    return linearize(problem, moved)


def _correct_elements(
    linear: Linearization[P, S], loss: Loss, cost: float
) -> Linearization[P, S] | None:
    """Move eliminated elements alone after a step that did not decrease the cost.

    Some factors are nearly exact and curved: a long straight step violates them, and a correction
    of the elements makes an otherwise good step succeed.
    """
    candidate: Linearization[P, S] | None = linear
    for _ in range(_MAX_ELEMENT_STEPS if linear.problem.eliminated is not None else 0):
        if candidate is None or not np.isfinite(robust_cost(candidate, loss)):
            return None
        candidate = _take_step(candidate, normal_equations(candidate, loss).element_step())
        if candidate is not None and robust_cost(candidate, loss) < cost:
            return candidate
    return candidate


@dataclass(frozen=True, eq=False)
class FreeSteps:
    """An orthonormal basis of the steps of n unknowns along no held direction.

    Its last vectors are the unknowns that no held direction touches: products with it need few
    multiplications.
    """

    touched: IntArray  # unknowns in held directions
    others: IntArray
    basis: Array  # (n_touched, k) of the first vectors

    @classmethod
    def without(cls, held_directions: Array) -> FreeSteps:
        """Find the steps without held directions (w, n)."""
        is_touched = held_directions.any(axis=0)
        touched, others = np.flatnonzero(is_touched), np.flatnonzero(~is_touched)
        basis = null_space(held_directions[:, touched]) if len(touched) else np.zeros((0, 0))
        return cls(touched, others, basis)

    def restricted(self, columns: Array) -> Array:
        """Multiply (n,) or (n, c) by the transposed basis."""
        if not len(self.touched):
            return columns
        return np.concatenate([self.basis.T @ columns[self.touched], columns[self.others]])

    def extended(self, steps: Array) -> Array:
        """Multiply (f,) or (f, c) by the basis."""
        if not len(self.touched):
            return steps
        k = self.basis.shape[1]
        columns = np.empty((len(self.touched) + len(self.others), *steps.shape[1:]))
        columns[self.touched], columns[self.others] = self.basis @ steps[:k], steps[k:]
        return columns

    def of(self, R: Array) -> Array:
        """Return the information (f, f) of these steps of a symmetric one (n, n)."""
        return self.restricted(self.restricted(R).T).T


@dataclass(frozen=True, eq=False)
class NormalEquations(Generic[P, S]):
    """The normal equations of a problem at a state."""

    linear: Linearization[P, S]
    U: Array  # (n_kept, n_kept)
    W: Array  # (n_kept, n_elements, f)
    V: Array  # (n_elements, f, f)
    g_kept: Array  # (n_kept,) gradient of the cost
    g_elements: Array  # (n_elements, f)
    tangent: Tangent | None  # None where eliminated elements are free
    held_directions: Array  # (w, n_kept) directions without a step
    weight: Mapping[str, float]  # of the squares of each factor

    @property
    def problem(self) -> P:
        """The problem."""
        return self.linear.problem

    @property
    def state(self) -> S:
        """The state."""
        return self.linear.state

    @cached_property
    def V_inverse(self) -> Array:
        """Pseudoinverses of the eliminated blocks, (n_elements, f, f)."""
        return inverse_on_range(self.V)

    @property
    def elements_by_kept(self) -> Array:
        """Derivative of elements at their minimum by kept unknowns, (n_elements, f, n_kept)."""
        return np.asarray(-self.V_inverse @ np.moveaxis(self.W, 0, 2))

    def reduced(self) -> Array:
        """Return the Schur complement (n_kept, n_kept): elements marginalised out."""
        return self._reduced.copy()

    @cached_property
    def _reduced(self) -> Array:
        R = _schur_complement(self.U, self.W, self.V_inverse)
        return np.asarray(0.5 * (R + R.T))

    def contributions(self) -> Array:
        """Return W V^-1 W^T of each element, (n_elements, n_kept, n_kept).

        For the factors of one element, U minus this is the information that the element adds to
        the kept unknowns; its rank is at most the number of residuals.
        """
        W = np.moveaxis(self.W, 1, 0)
        return np.asarray(W @ self.V_inverse @ np.swapaxes(W, 1, 2))

    def kept_covariance(self) -> Array:
        """Return the inverse of the reduced matrix, zero along held directions."""
        return self._kept_covariance

    @cached_property
    def _kept_covariance(self) -> Array:
        free = self.free_steps
        covariance = free.extended(free.extended(inverse_on_range(free.of(self._reduced))).T).T
        return np.asarray(0.5 * (covariance + covariance.T))  # rounding grows with the condition

    @cached_property
    def free_steps(self) -> FreeSteps:
        """The steps of the kept unknowns along no held direction."""
        return FreeSteps.without(self.held_directions)

    def moved_by(self, columns: Array) -> Array:
        """Multiply columns (n_kept, c) by the covariance of the kept unknowns."""
        if "_kept_covariance" not in vars(self):
            free = self.free_steps
            reduced = free.of(self._reduced)
            scale = _scale(reduced)
            U, failed = dpotrf(scale[:, None] * reduced * scale)
            if not failed and np.diagonal(U).min(initial=1.0) ** 2 > _MIN_PIVOT:
                solved = cho_solve((U, False), scale[:, None] * free.restricted(columns))
                return free.extended(scale[:, None] * solved)
        return np.asarray(self._kept_covariance @ columns)

    def step(self, damping: float) -> tuple[Array, float]:
        """Return a Levenberg-Marquardt step (size,) and the predicted decrease of the cost.

        *damping* times the diagonal is added to the diagonal.
        """
        V = _damped(self.V, damping)
        V_inverse = np.asarray(np.linalg.inv(V), dtype=np.float64)
        U = _damped(self.U, damping)
        R = _schur_complement(U, self.W, V_inverse)
        element_part = (V_inverse @ self.g_elements[..., None]).ravel()
        right = -self.g_kept + _as_matrix(self.W) @ element_part
        free = self.free_steps
        kept = free.extended(_solve(free.of(R), free.restricted(right)))
        g_total = self.g_elements + (kept @ _as_matrix(self.W)).reshape(self.g_elements.shape)
        y = -(V_inverse @ g_total[..., None])[..., 0]
        gradient_term = float(self.g_kept @ kept + np.sum(self.g_elements * y))
        damping_term = float(
            (np.diagonal(U) - np.diagonal(self.U)) @ kept**2
            + np.sum((np.einsum("kpp->kp", V) - np.einsum("kpp->kp", self.V)) * y**2)
        )
        return self._full_step(kept, y), 0.5 * (damping_term - gradient_term)

    def element_step(self, damping: Array | None = None) -> Array:
        """Return the step (size,) of the eliminated elements alone, with a damping of each."""
        if damping is None:
            inverse = self.V_inverse
        else:
            damped = _damped(self.V, damping[:, None])
            inverse = np.asarray(np.linalg.inv(damped), dtype=np.float64)
        y = -(inverse @ self.g_elements[..., None])[..., 0]
        return self._full_step(np.zeros(len(self.U)), y)

    def _full_step(self, kept: Array, y: Array) -> Array:
        """Map a step in the tangent space of the constraints to all unknowns."""
        elements = y
        if self.tangent is not None:
            elements = np.einsum("kpf,kf->kp", self.tangent.Z, y)
            elements = elements + np.einsum("akp,a->kp", self.tangent.Q, kept)
        return np.concatenate([kept, elements.ravel()])


def normal_equations(
    linear: Linearization[P, S], loss: Loss = LEAST_SQUARES
) -> NormalEquations[P, S]:
    """Return the normal equations of the robust cost, with the curvature of the loss."""
    weighted = {}
    for factor in linear.problem.factors:
        rows = linear[factor.name]
        if factor.robust and np.isfinite(loss.width):
            rows = Residuals(*loss.softened(rows.r, rows.slope), rows.chain)
        weighted[factor.name] = rows, 1.0
    return _normal_equations_of(linear, weighted)


def information(
    linear: Linearization[P, S],
    loss: PseudoHuber = LEAST_SQUARES,
    only: Collection[str] | None = None,
) -> NormalEquations[P, S]:
    """Return the information of the unknowns; its inverse is their covariance.

    Robust factors count with the efficiency of the loss. With *only*, other factors are left out;
    priors stay.
    """
    weighted = {}
    for factor in linear.problem.factors:
        if only is None or factor.name in only:
            rows = linear[factor.name]
            kept = 1.0
            if factor.robust and np.isfinite(loss.width):
                kept = loss.efficiency(factor.n_rows)
            weighted[factor.name] = rows, kept
    return _normal_equations_of(linear, weighted)


def _normal_equations_of(
    linear: Linearization[P, S],
    weighted: dict[str, tuple[Residuals, float]],  # weight of the squares
) -> NormalEquations[P, S]:
    """Build normal equations, elements in the tangent space of their constraints."""
    problem = linear.problem
    sparsity = problem.sparsity
    U, W, V, g_kept, g_elements = _summed_products(
        [(sparsity[name], rows, weight) for name, (rows, weight) in weighted.items()], problem
    )
    linear.add_priors(U, g_kept)
    tangent = None
    if problem.constraint is not None:
        tangent = problem.constraint.tangent(problem, linear.state)
    if tangent is not None:
        Z, Q = tangent.Z, tangent.Q
        coupled, QV = _sum_of_products(W, Q), _times_blocks(Q, V)
        U = U + coupled + coupled.T + _sum_of_products(Q, QV)
        g_kept = g_kept + _as_matrix(Q) @ g_elements.ravel()
        W = _times_blocks(W + QV, Z)
        V = np.swapaxes(Z, 1, 2) @ V @ Z
        g_elements = np.einsum("kpf,kp->kf", Z, g_elements)
    held_directions = np.zeros((len(problem.held_directions), problem.n_kept))
    held_directions[:, : problem.held_directions.shape[1]] = problem.held_directions
    if tangent is not None and len(tangent.ties):
        held_directions = np.concatenate([held_directions, tangent.ties])
    weight = {name: of_factor for name, (_, of_factor) in weighted.items()}
    return NormalEquations(linear, U, W, V, g_kept, g_elements, tangent, held_directions, weight)


def _summed_products(
    kinds: list[tuple[Sparsity, Residuals, float]], problem: EstimationProblem[S]
) -> tuple[Array, Array, Array, Array, Array]:
    """Return the blocks U, W, V of J^T J and g_kept, g_elements of J^T r."""
    n_kept, n_elements, d = problem.n_kept, problem.n_elements, problem.d_element
    squares = np.zeros((n_kept + 2, n_kept + 2))  # a row of fixed coordinates, then r
    element_sums: Array | None = None  # the same rows by element, then elements
    for sparsity, rows, weight in kinds:
        if len(rows.r) == 0:
            continue
        groups, m = sparsity.groups, sparsity.columns.shape[1]
        stacked = rows.stacked(groups.order)
        n, q, width = stacked.shape
        flat, products_of_groups = stacked.reshape(n * q, width)[:, : m + 1], []
        for start, end in groups.bounds:
            rows_of_group = flat[q * start : q * end]
            products_of_groups.append(weight * (rows_of_group.T @ rows_of_group))
        last = np.full((len(sparsity.columns), 1), n_kept + 1)
        columns = np.concatenate([sparsity.columns, last], axis=1)
        np.add.at(squares, (columns[:, :, None], columns[:, None, :]), np.array(products_of_groups))
        if sparsity.to_elements is not None:
            cells = stacked.reshape(n // groups.cell, groups.cell * q, width)
            products = np.swapaxes(cells, 1, 2) @ cells[:, :, m + 1 :]
            products_of_cells = sparsity.to_elements @ products.reshape(-1, d)
            products_of_cells *= weight
            element_sums = (
                products_of_cells
                if element_sums is None
                else np.add(element_sums, products_of_cells, out=element_sums)
            )
    if element_sums is None:
        element_sums = np.zeros(((n_kept + 2 + d) * n_elements, d))
    by_row = element_sums.reshape(n_kept + 2 + d, n_elements, d)
    V = np.swapaxes(by_row[n_kept + 2 :], 0, 1).copy()
    U, g_kept = squares[:n_kept, :n_kept].copy(), squares[:n_kept, -1].copy()
    return U, by_row[:n_kept], V, g_kept, by_row[n_kept + 1]


def inverse_on_range(S: Array) -> Array:
    """Return the pseudoinverse of symmetric positive semidefinite matrices (..., n, n).

    The matrices are scaled to unit diagonal first, so that the rank does not depend on units.
    """
    if S.size == 0:
        return S.copy()
    scale = _scale(S)
    scaled = scale[..., :, None] * S * scale[..., None, :]
    if S.ndim == 2 and len(S) > _MIN_SIZE_FOR_FACTOR:
        inverse = _inverse_by_factor(scaled)
    else:
        inverse = _inverses(scaled.reshape(-1, *S.shape[-2:])).reshape(S.shape)
    inverse *= scale[..., :, None]
    inverse *= scale[..., None, :]
    return inverse


def _inverses(scaled: Array) -> Array:
    """Pseudoinverses of matrices (k, n, n) of unit diagonal."""
    safe = is_regular(scaled)
    if safe.all():
        return np.asarray(np.linalg.inv(scaled))
    inverse = np.empty_like(scaled)
    inverse[safe] = np.linalg.inv(scaled[safe])
    inverse[~safe] = _pseudoinverses(scaled[~safe])
    return inverse


def _inverse_by_factor(scaled: Array) -> Array:
    """Pseudoinverse of one large matrix; its Cholesky factor shows whether it is regular."""
    U, failed = dpotrf(scaled.T)
    if failed or np.diagonal(U).min() ** 2 <= _MIN_PIVOT:
        return np.asarray(_pseudoinverses(scaled[None])[0])
    root, _ = dtrtri(U, overwrite_c=True)
    return np.asarray(root @ root.T)


def _pseudoinverses(scaled: Array) -> Array:
    """Pseudoinverses of positive semidefinite matrices (k, n, n) by eigenvalues."""
    value, vector = np.linalg.eigh(scaled)
    kept = value > _RANK_TOLERANCE * value[..., -1:]
    reciprocal = np.where(kept, 1.0, 0.0) / np.where(kept, value, 1.0)
    return np.asarray((vector * reciprocal[..., None, :]) @ np.swapaxes(vector, -1, -2))


def is_regular(scaled: Array) -> BoolArray:
    """Which matrices (k, n, n) of unit diagonal are far from singular, (k,)."""
    try:
        L = np.linalg.cholesky(scaled)
    except np.linalg.LinAlgError:
        return np.zeros(len(scaled), dtype=np.bool_)
    return np.asarray(np.einsum("kii->ki", L).min(axis=1, initial=1.0) ** 2 > _MIN_PIVOT)


def _scale(S: Array) -> Array:
    """Scale factors (..., n) to unit diagonal; one for a zero diagonal."""
    diagonal = np.einsum("...ii->...i", S)
    return np.asarray(1.0 / np.sqrt(np.where(diagonal > 0.0, diagonal, 1.0)))


def _as_matrix(W: Array) -> Array:
    """Reshape W (n_kept, n_elements, f) to a matrix (n_kept, n_elements f)."""
    return W.reshape(len(W), W.shape[1] * W.shape[2])


def _sum_of_products(left: Array, right: Array) -> Array:
    """Sum of left right^T over elements, both (n_kept, n_elements, f)."""
    return np.asarray(_as_matrix(left) @ _as_matrix(right).T)


def _schur_complement(U: Array, W: Array, V_inverse: Array) -> Array:
    """Return U - W V^-1 W^T; V^-1 is singular if elements are not determined, or by rounding."""
    try:
        half = _times_blocks(W, np.asarray(np.linalg.cholesky(V_inverse), dtype=np.float64))
    except np.linalg.LinAlgError:
        return U - _sum_of_products(_times_blocks(W, V_inverse), W)
    return U - _sum_of_products(half, half)


def _times_blocks(W: Array, blocks: Array) -> Array:
    """Multiply W (n_kept, n_elements, f) by the block (n_elements, f, h) of each element."""
    product = np.empty((*W.shape[:2], blocks.shape[2]))
    np.matmul(W.swapaxes(0, 1), blocks, out=product.swapaxes(0, 1))
    return product


def _damped(M: Array, damping: float | Array) -> Array:
    """Add *damping* times the diagonal to matrices; one where the diagonal is zero."""
    damped = M.copy()
    diagonal = np.einsum("...ii->...i", damped)
    diagonal += np.where(diagonal > 0.0, damping * diagonal, 1.0)
    return damped


def _solve(S: Array, right: Array) -> Array:
    """Solve S x = right for a scaled positive definite S; by the pseudoinverse if singular."""
    scale = _scale(S)
    scaled = scale[:, None] * S * scale
    try:
        solution = cho_solve(cho_factor(scaled, check_finite=False), scale * right)
    except np.linalg.LinAlgError:
        solution = inverse_on_range(scaled) @ (scale * right)
    return np.asarray(scale * solution)
