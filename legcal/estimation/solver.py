"""Levenberg-Marquardt on a problem: normal equations by blocks, and the search for a minimum.

N x = -g with N = [[U, W], [W^T, V]]: kept unknowns first, then one block for each eliminated
element. V is block diagonal, so that the Schur complement U - W V^-1 W^T is all that is solved.
Where exact constraints bind the elements, V, W and their gradient belong to coordinates y inside
what the constraints leave (:class:`Tangent`), and every step ends with a projection onto them.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Generic

import numpy as np
from scipy.linalg import cho_factor, cho_solve, null_space
from scipy.linalg.lapack import dpotrf, dtrtri

from legcal.errors import DidNotConverge
from legcal.estimation.loss import LEAST_SQUARES, Loss, PseudoHuber
from legcal.estimation.problem import (
    Linearization,
    Places,
    Problem,
    Residuals,
    S,
    Tangent,
    linearize,
)
from legcal.geometry.types import Array, BoolArray

_FIRST_DAMPING = 1e-6
_MIN_DAMPING = 1e-10
_MAX_DAMPING = 1e8
COST_TOLERANCE = 1e-12  # predicted fall of the cost at a minimum, in squared sigmas
_ROUNDING = 1e-13  # of the cost
_WIDTH_IN_MEDIANS = 5.0  # width of the loss while most measurements are beyond its final one
_SLOW_FALL = 0.5  # of the cost: below, the loss is narrowed as far as the median allows
_MIN_NARROWING = 0.8  # of the width: smaller changes of the median do not change the loss
_CONVERGED_FALL = 0.01  # of the cost: below, the loss is narrowed in any case
_NARROWED = 0.5  # of the width, then
_MAX_ELEMENT_STEPS = 3
_NEARLY_LINEAR = 0.99  # part of what a step predicted: above, damping is needed no longer
_NEARLY_LINEAR_DECAY = 1e-3
_DAMPING_MARGIN = 3.0  # times a damping that failed is tried after one that did not
_DAMPING_DECAY = 0.3  # of a damping that failed, every step
_MIN_ITERATIONS = 30  # before the relative tolerance counts
_RANK_TOLERANCE = 1e-13  # eigenvalues below this part of the largest are rounding
_MIN_PIVOT = 1e-9  # a scaled block with a pivot below may be singular
_MANY = 16  # unknowns: larger matrices are inverted by their factor


@dataclass(frozen=True, eq=False)
class Minimum(Generic[S]):
    """A minimum of the robust cost."""

    state: S
    linear: Linearization
    cost: float
    iterations: int  # steps that were tried
    rate: float = 1.0  # what the last step predicted to fall, over what the one before did


def minimise(
    problem: Problem[S],
    state: S,
    loss: Loss = LEAST_SQUARES,
    *,
    max_iterations: int = 200,
    is_near: bool = False,
    tolerance: float = COST_TOLERANCE,
    relative_tolerance: float = 0.0,
    must_converge: bool = True,
    known: Mapping[str, Residuals] | None = None,
    rate: float = 1.0,
) -> Minimum[S]:
    """Minimise the robust cost from a state.

    A pseudo-Huber loss begins as wide as most measurements need and is narrowed on the way.

    Parameters
    ----------
    problem, state, loss
        What to minimise, and where to start.
    max_iterations : int
        Steps to try.
    is_near : bool
        Whether the start is a minimum with other weights: the first step is not damped.
    tolerance : float
        Fall of the cost at which to stop, in squared sigmas.
    relative_tolerance : float
        Relative fall of the cost at which to stop after some steps: where outliers bend the cost,
        the last steps are many and follow these.
    must_converge : bool
        Whether to refuse where the steps do not come to an end; else the best state is returned.
    known : mapping, optional
        Rows of factors at the start.
    rate : float
        That of a minimum nearby, if the start is one with other weights: where the first step does
        not have to be followed by another is known then.

    Raises
    ------
    DidNotConverge
        If no step lowers the cost before it has converged, or after *max_iterations* steps.
    """
    begin, state = state, problem.projected(state)
    linear = linearize(problem, state, known if state is begin else None)
    wide = _widened(problem, linear, loss, np.inf)
    damping, failed, fall_before = _MIN_DAMPING if is_near else _FIRST_DAMPING, 0.0, np.inf
    cost, normal = robust_cost(problem, linear, wide), None
    for iteration in range(1, max_iterations + 1):
        normal = normal or normal_equations(problem, state, linear, wide)
        step, predicted = normal.step(damping)
        converged = predicted < COST_TOLERANCE + _ROUNDING * cost
        trial = _tried(problem, state, step)
        there = np.inf if trial is None else robust_cost(problem, trial[1], wide)
        if trial is not None and not converged and not there < cost:
            trial = _followed(problem, *trial, wide, cost)
            there = np.inf if trial is None else robust_cost(problem, trial[1], wide)
        fall = cost - there
        if trial is None or not np.isfinite(fall) or not (fall > 0.0 or converged):
            failed, damping = damping, 10.0 * damping
            fall_before, rate = np.inf, 1.0
            if damping > _MAX_DAMPING:
                break
            continue
        (state, linear), cost, normal = trial, there, None
        damping = max(_next(damping, fall / max(predicted, 1e-300)), _DAMPING_MARGIN * failed)
        failed *= _DAMPING_DECAY
        if np.isfinite(fall_before):
            rate = min(predicted / fall_before, 1.0)
        expected = predicted * rate
        narrower = wide
        if expected < _SLOW_FALL * cost:
            narrower = _widened(problem, linear, loss, wide.width)
        if narrower.width == wide.width and expected < _CONVERGED_FALL * cost:
            narrower = _of_width(loss, max(loss.width, _NARROWED * wide.width))
        if narrower.width != wide.width:
            wide, fall_before, rate = narrower, np.inf, 1.0
            cost = robust_cost(problem, linear, wide)
            continue
        smallest = relative_tolerance * cost if iteration > _MIN_ITERATIONS else 0.0
        if converged or expected < max(smallest, tolerance):
            return Minimum(state, linear, cost, iteration, rate)
        fall_before = predicted
    if not must_converge:
        return Minimum(state, linear, cost, iteration)
    raise DidNotConverge(
        f"The {problem.name} did not converge: found a cost that still falls by {predicted:.2g} a "
        f"step after {iteration} steps, needed a minimum; {problem.remedy}."
    )


def robust_cost(problem: Problem[S], linear: Linearization, loss: Loss) -> float:
    """Return half the squares of priors and plain factors, and the loss of all others."""
    plain, robust = float(linear.prior_r @ linear.prior_r), 0.0
    for factor in problem.factors:
        rows = linear[factor.name]
        if factor.robust:
            robust += loss.cost(rows.squared_norms)
        else:
            plain += float(rows.squared_norms.sum())
    return 0.5 * plain + robust


def _of_width(loss: Loss, width: float) -> Loss:
    """Return a loss of another width where losses are narrowed."""
    return PseudoHuber(width) if isinstance(loss, PseudoHuber) else loss


def _widened(problem: Problem[S], linear: Linearization, loss: Loss, before: float) -> Loss:
    """Return the loss at a width of some medians while most measurements are far off."""
    if np.isinf(loss.width):
        return loss
    medians = [0.0]
    for factor in problem.factors:
        if factor.robust:
            norms = linear[factor.name].squared_norms
            norms = norms[norms > 0.0]
            medians += [float(np.sqrt(np.median(norms)))] if len(norms) else []
    median = max(medians)  # some kinds agree with each other before anything else does
    wanted = loss.width if median <= loss.width else _WIDTH_IN_MEDIANS * median
    narrows = wanted == loss.width or wanted < _MIN_NARROWING * before
    return _of_width(loss, wanted if narrows else before)


def _next(damping: float, gain: float) -> float:
    """Return the damping after a step that gave that part of what it predicted."""
    if gain > 0.75:
        decay = _NEARLY_LINEAR_DECAY if gain > _NEARLY_LINEAR else 0.1
        return max(decay * damping, _MIN_DAMPING)
    return damping if gain > 0.25 else 4.0 * damping


def _tried(problem: Problem[S], state: S, step: Array) -> tuple[S, Linearization] | None:
    """Return where a step leads, shortened where a block moves too far; None if nowhere."""
    if not np.all(np.isfinite(step)):
        return None
    try:
        moved = problem.moved(state, step / max(problem.overshoot(step), 1.0))
        moved = problem.projected(moved)
    except DidNotConverge:
        return None
    return moved, linearize(problem, moved)


def _followed(
    problem: Problem[S], state: S, linear: Linearization, loss: Loss, cost: float
) -> tuple[S, Linearization] | None:
    """Return the state after more steps of eliminated elements alone, where a step failed.

    Some factors are nearly exact, and curved: a long straight step leaves them, and the elements
    bring them back where the rest of the step was right.
    """
    there: tuple[S, Linearization] | None = (state, linear)
    for _ in range(_MAX_ELEMENT_STEPS if problem.eliminated is not None else 0):
        if there is None or not np.isfinite(robust_cost(problem, there[1], loss)):
            return None
        step = normal_equations(problem, *there, loss).element_step()
        there = _tried(problem, there[0], step)
        if there is not None and robust_cost(problem, there[1], loss) < cost:
            return there
    return there


@dataclass(frozen=True, eq=False)
class NormalEquations:
    """The normal equations of a problem at a state."""

    U: Array  # (n_kept, n_kept)
    W: Array  # (n_kept, n_elements, f)
    V: Array  # (n_elements, f, f)
    g_kept: Array  # (n_kept,) gradient of the cost
    g_elements: Array  # (n_elements, f)
    tangent: Tangent | None  # None where eliminated elements are free
    held_directions: Array  # (w, n_kept) directions that stay

    @cached_property
    def V_inverse(self) -> Array:
        """The inverses of the eliminated blocks on their range, (n_elements, f, f)."""
        return inverse_on_range(self.V)

    @property
    def elements_by_kept(self) -> Array:
        """Derivative of elements at their minimum by kept unknowns, (n_elements, f, n_kept)."""
        return np.asarray(-self.V_inverse @ np.moveaxis(self.W, 0, 2))

    def reduced(self) -> Array:
        """Return the normal matrix (n_kept, n_kept) of the kept unknowns, the others free."""
        return self._reduced.copy()

    @cached_property
    def _reduced(self) -> Array:
        try:
            root = np.asarray(np.linalg.cholesky(self.V_inverse), dtype=np.float64)
            half = _by_element(self.W, root)
            R = self.U - _coupled(half, half)
        except np.linalg.LinAlgError:  # some elements are not determined
            R = self.U - _coupled(_by_element(self.W, self.V_inverse), self.W)
        return np.asarray(0.5 * (R + R.T))

    def contributions(self) -> Array:
        """Return what each element takes off U, (n_elements, n_kept, n_kept): W V^-1 W^T of each.

        With the factors of an element alone, U less its contribution is what it adds to the
        information of the kept unknowns, of rank no more than its residuals.
        """
        W = np.moveaxis(self.W, 1, 0)
        return np.asarray(W @ self.V_inverse @ np.swapaxes(W, 1, 2))

    def kept_covariance(self) -> Array:
        """Return the inverse of the reduced matrix, held directions left out."""
        return self._kept_covariance

    @cached_property
    def _kept_covariance(self) -> Array:
        if len(self.held_directions) == 0:
            return inverse_on_range(self._reduced)
        N = null_space(self.held_directions)
        return np.asarray(N @ inverse_on_range(N.T @ self._reduced @ N) @ N.T)

    def moved_by(self, columns: Array) -> Array:
        """Return the covariance of the kept unknowns times columns (n_kept, c)."""
        if len(self.held_directions) == 0 and "_kept_covariance" not in vars(self):
            scale = _scale(self._reduced)
            U, failed = dpotrf(scale[:, None] * self._reduced * scale)
            if not failed and np.diagonal(U).min(initial=1.0) ** 2 > _MIN_PIVOT:
                right = scale[:, None] * columns
                return np.asarray(scale[:, None] * cho_solve((U, False), right))
        return np.asarray(self._kept_covariance @ columns)

    def step(self, damping: float) -> tuple[Array, float]:
        """Return a Levenberg-Marquardt step (size,) and the predicted fall of the cost.

        *damping* is the part of the diagonal that is added to it.
        """
        V = _damped(self.V, damping)
        V_inverse = np.asarray(np.linalg.inv(V), dtype=np.float64)
        U = _damped(self.U, damping)
        try:
            root = np.asarray(np.linalg.cholesky(V_inverse), dtype=np.float64)
            half = _by_element(self.W, root)
            R = U - _coupled(half, half)
        except np.linalg.LinAlgError:  # by rounding
            R = U - _coupled(_by_element(self.W, V_inverse), self.W)
        following = (V_inverse @ self.g_elements[..., None]).ravel()
        right = -self.g_kept + _flat(self.W) @ following
        if len(self.held_directions):
            N = null_space(self.held_directions)
            kept = N @ _solve(N.T @ R @ N, N.T @ right)
        else:
            kept = _solve(R, right)
        pull = self.g_elements + (kept @ _flat(self.W)).reshape(self.g_elements.shape)
        y = -(V_inverse @ pull[..., None])[..., 0]
        linear = float(self.g_kept @ kept + np.sum(self.g_elements * y))
        extra = float(
            (np.diagonal(U) - np.diagonal(self.U)) @ kept**2
            + np.sum((np.einsum("kpp->kp", V) - np.einsum("kpp->kp", self.V)) * y**2)
        )
        return self._whole(kept, y), 0.5 * (extra - linear)

    def element_step(self, damping: Array | None = None) -> Array:
        """Return the step (size,) of the eliminated elements alone, each damped by its own part."""
        if damping is None:
            inverse = self.V_inverse
        else:
            damped = _damped(self.V, damping[:, None])
            inverse = np.asarray(np.linalg.inv(damped), dtype=np.float64)
        y = -(inverse @ self.g_elements[..., None])[..., 0]
        return self._whole(np.zeros(len(self.U)), y)

    def _whole(self, kept: Array, y: Array) -> Array:
        """Return a step of all unknowns, from one inside the constraints."""
        elements = y
        if self.tangent is not None:
            elements = np.einsum("kpf,kf->kp", self.tangent.Z, y)
            elements = elements + np.einsum("akp,a->kp", self.tangent.Q, kept)
        return np.concatenate([kept, elements.ravel()])


def normal_equations(
    problem: Problem[S], state: S, linear: Linearization, loss: Loss = LEAST_SQUARES
) -> NormalEquations:
    """Return the normal equations of the robust cost, with the loss's true curvature."""
    weighted = {}
    for factor in problem.factors:
        rows = linear[factor.name]
        if factor.robust and np.isfinite(loss.width):
            rows = Residuals(*loss.softened(rows.r, rows.slope), rows.chain)
        weighted[factor.name] = rows, 1.0
    return _of_rows(problem, state, linear, weighted)


def information(
    problem: Problem[S],
    state: S,
    linear: Linearization,
    loss: PseudoHuber = LEAST_SQUARES,
    only: Collection[str] | None = None,
) -> NormalEquations:
    """Return the normal equations whose inverse is the covariance of the unknowns.

    A robust loss does not keep all information of what it is on (its efficiency). With *only*
    these factors enter, beside the priors.
    """
    weighted = {}
    for factor in problem.factors:
        if only is None or factor.name in only:
            rows = linear[factor.name]
            kept = 1.0
            if factor.robust and np.isfinite(loss.width):
                kept = loss.efficiency(factor.n_rows)
            weighted[factor.name] = rows, kept
    return _of_rows(problem, state, linear, weighted)


def _of_rows(
    problem: Problem[S],
    state: S,
    linear: Linearization,
    weighted: dict[str, tuple[Residuals, float]],  # and how much their squares count
) -> NormalEquations:
    """Return normal equations, with motions inside the constraints in place of elements."""
    places = problem.places
    U, W, V, g_kept, g_elements = _sums(
        [(places[name], rows, weight) for name, (rows, weight) in weighted.items()], problem
    )
    linear.add_priors(U, g_kept)
    motion = None
    if problem.constraint is not None:
        motion = problem.constraint.tangent(problem, state)
    if motion is not None:
        Z, Q = motion.Z, motion.Q
        coupled, QV = _coupled(W, Q), _by_element(Q, V)
        U = U + coupled + coupled.T + _coupled(Q, QV)
        g_kept = g_kept + _flat(Q) @ g_elements.ravel()
        W = _by_element(W + QV, Z)
        V = np.swapaxes(Z, 1, 2) @ V @ Z
        g_elements = np.einsum("kpf,kp->kf", Z, g_elements)
    held = np.zeros((len(problem.held_directions), problem.n_kept))
    held[:, : problem.held_directions.shape[1]] = problem.held_directions
    if motion is not None and len(motion.ties):
        held = np.concatenate([held, motion.ties])
    return NormalEquations(U, W, V, g_kept, g_elements, motion, held)


def _sums(
    kinds: list[tuple[Places, Residuals, float]], problem: Problem[S]
) -> tuple[Array, Array, Array, Array, Array]:
    """Return the blocks U, W, V of J^T J and both parts of J^T r, all measurements added up."""
    n_kept, n_elements, d = problem.n_kept, problem.n_elements, problem.d_element
    squares = np.zeros((n_kept + 2, n_kept + 2))  # with one row of no unknown, and r as the last
    mixed: Array | None = None  # the same rows for each element, then those of the elements
    for where, rows, weight in kinds:
        if len(rows.r) == 0:
            continue
        groups, m = where.groups, where.columns.shape[1]
        stacked = rows.stacked(groups.order)
        n, q, width = stacked.shape
        flat, of_group = stacked.reshape(n * q, width)[:, : m + 1], []
        for start, end in groups.bounds:
            own = flat[q * start : q * end]
            of_group.append(weight * (own.T @ own))
        last = np.full((len(where.columns), 1), n_kept + 1)
        columns = np.concatenate([where.columns, last], axis=1)
        np.add.at(squares, (columns[:, :, None], columns[:, None, :]), np.array(of_group))
        if where.to_elements is not None:
            cells = stacked.reshape(n // groups.cell, groups.cell * q, width)
            products = np.swapaxes(cells, 1, 2) @ cells[:, :, m + 1 :]
            added = where.to_elements @ products.reshape(-1, d)
            added *= weight
            mixed = added if mixed is None else np.add(mixed, added, out=mixed)
    if mixed is None:
        mixed = np.zeros(((n_kept + 2 + d) * n_elements, d))
    by_row = mixed.reshape(n_kept + 2 + d, n_elements, d)
    V = np.swapaxes(by_row[n_kept + 2 :], 0, 1).copy()
    U, g_kept = squares[:n_kept, :n_kept].copy(), squares[:n_kept, -1].copy()
    return U, by_row[:n_kept], V, g_kept, by_row[n_kept + 1]


def inverse_on_range(S: Array) -> Array:
    """Return the inverse of symmetric positive semidefinite matrices (..., n, n) on their range.

    The matrices are scaled to unit diagonal first, so that units do not matter.
    """
    if S.size == 0:
        return S.copy()
    scale = _scale(S)
    scaled = scale[..., :, None] * S * scale[..., None, :]
    if S.ndim == 2 and len(S) > _MANY:
        inverse = _inverse_of_one(scaled)
    else:
        inverse = _inverses(scaled.reshape(-1, *S.shape[-2:])).reshape(S.shape)
    inverse *= scale[..., :, None]
    inverse *= scale[..., None, :]
    return inverse


def _inverses(scaled: Array) -> Array:
    """Return the inverses on their range of matrices (k, n, n) of unit diagonal."""
    safe = _is_regular(scaled)
    if safe.all():
        return np.asarray(np.linalg.inv(scaled))
    inverse = np.empty_like(scaled)
    inverse[safe] = np.linalg.inv(scaled[safe])
    inverse[~safe] = _pseudoinverses(scaled[~safe])
    return inverse


def _inverse_of_one(scaled: Array) -> Array:
    """Return the same of one large matrix, from the factor that says whether it is regular."""
    U, failed = dpotrf(scaled.T)
    if failed or np.diagonal(U).min() ** 2 <= _MIN_PIVOT:
        return np.asarray(_pseudoinverses(scaled[None])[0])
    root, _ = dtrtri(U, overwrite_c=True)
    return np.asarray(root @ root.T)


def _pseudoinverses(scaled: Array) -> Array:
    """Return inverses on the range of any positive semidefinite matrices (k, n, n)."""
    value, vector = np.linalg.eigh(scaled)
    kept = value > _RANK_TOLERANCE * value[..., -1:]
    reciprocal = np.where(kept, 1.0, 0.0) / np.where(kept, value, 1.0)
    return np.asarray((vector * reciprocal[..., None, :]) @ np.swapaxes(vector, -1, -2))


def _is_regular(scaled: Array) -> BoolArray:
    """Say which matrices of unit diagonal are far from singular."""
    try:
        L = np.linalg.cholesky(scaled)
    except np.linalg.LinAlgError:
        return np.zeros(len(scaled), dtype=np.bool_)
    return np.asarray(np.einsum("kii->ki", L).min(axis=1, initial=1.0) ** 2 > _MIN_PIVOT)


def _scale(S: Array) -> Array:
    """Return what scales diagonals (..., n) to one; one where they are zero."""
    diagonal = np.einsum("...ii->...i", S)
    return np.asarray(1.0 / np.sqrt(np.where(diagonal > 0.0, diagonal, 1.0)))


def _flat(W: Array) -> Array:
    """Return what couples kept to eliminated unknowns as one matrix (n_kept, n_elements f)."""
    return W.reshape(len(W), W.shape[1] * W.shape[2])


def _coupled(left: Array, right: Array) -> Array:
    """Return the sum over elements of left right^T, both (n_kept, n_elements, f)."""
    return np.asarray(_flat(left) @ _flat(right).T)


def _by_element(W: Array, blocks: Array) -> Array:
    """Return W (n_kept, n_elements, f) times the block (n_elements, f, h) of each element."""
    found = np.empty((*W.shape[:2], blocks.shape[2]))
    np.matmul(W.swapaxes(0, 1), blocks, out=found.swapaxes(0, 1))
    return found


def _damped(M: Array, damping: float | Array) -> Array:
    """Return matrices with a part of their diagonal added to it; one where it is zero."""
    damped = M.copy()
    diagonal = np.einsum("...ii->...i", damped)
    diagonal += np.where(diagonal > 0.0, damping * diagonal, 1.0)
    return damped


def _solve(S: Array, right: Array) -> Array:
    """Return S^-1 right for a positive definite S, scaled; least squares where it is not."""
    scale = _scale(S)
    scaled = scale[:, None] * S * scale
    try:
        found = cho_solve(cho_factor(scaled, check_finite=False), scale * right)
    except np.linalg.LinAlgError:
        found = inverse_on_range(scaled) @ (scale * right)
    return np.asarray(scale * found)
