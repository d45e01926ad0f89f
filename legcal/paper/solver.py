"""Rigid motions inside the steps: registration of points, and unknown motions in CasADi."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Any

import casadi as ca
import numpy as np
from scipy.sparse import csc_array, diags_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial.transform import RigidTransform, Rotation

from legcal.errors import DidNotConverge
from legcal.geometry import Array, BoolArray, IntArray


@dataclass(frozen=True, eq=False)
class Term:
    """One kind of residual, and the observations that have it.

    Attributes
    ----------
    function : casadi.Function
        (local, *observed) -> residuals of one observation, in units of their standard
        deviations or of eqs (9), (14), (16). *local* (n_local,) are the unknowns that it depends
        on.
    index : (n, n_local) array of int
        Positions of the local unknowns of each observation among all unknowns; -1 for
        coordinates that are zero by the choice of the frame. No unknown twice in a row.
    observed : tuple of (n,), (n, a) or (n, a, b) array
        What each observation saw: the other arguments of the function.
    robust : bool
        An observation that is an outlier loses weight, all its residuals together.
    """

    function: ca.Function
    index: IntArray
    observed: tuple[Array, ...]
    robust: bool = False

    @property
    def n_rows(self) -> int:
        """Number of residuals of one observation."""
        return int(self.function.size1_out(0))


@dataclass(frozen=True)
class Structure:
    """What problems of one kind share: which unknowns each observation has, and how.

    Attributes
    ----------
    n_unknowns : int
        Number of unknowns.
    terms : tuple
        Of each term the function, the shape and the bytes of its index, and the shapes of what
        one observation saw.
    exact_hessian : bool
        As of the problem.
    reweighted : bool
        Some terms are robust: the problem is solved several times, with other weights.
    """

    n_unknowns: int
    terms: tuple[tuple[ca.Function, tuple[int, ...], bytes, tuple[tuple[int, int], ...]], ...]
    exact_hessian: bool
    reweighted: bool

    @property
    def n_residuals(self) -> int:
        """Number of residuals."""
        return sum(function.size1_out(0) * shape[0] for function, shape, _, _ in self.terms)

    @property
    def n_observed(self) -> int:
        """Number of parameters."""
        return sum(n * a * b for _, (n, _), _, seen in self.terms for a, b in seen)


@dataclass(frozen=True, eq=False)
class LeastSquares:
    """Half the sum of squared residuals, to be minimised from a start.

    Attributes
    ----------
    name : str
        What is looked for, for messages: "the base joints (eq 9)".
    terms : tuple of Term
        The residuals.
    start : (n,) array
        Values of the unknowns to start from.
    n_shared : int, optional
        How many unknowns, the first ones, belong to many observations. The others come in
        groups, such as the pose of one image, that no residual ties to each other. Without it
        all are shared.
    exact_hessian : bool
        Use second derivatives of the residuals instead of J'J. Criteria that do not decide some
        unknown, as (9) and (16) with z, need it: J'J vanishes in that direction.
    """

    name: str
    terms: tuple[Term, ...]
    start: Array
    n_shared: int | None = None
    exact_hessian: bool = False

    @property
    def n_residuals(self) -> int:
        """Number of residuals of all terms."""
        return sum(term.n_rows * len(term.index) for term in self.terms)

    @property
    def structure(self) -> Structure:
        """What it shares with problems that saw other numbers."""
        terms = [
            (
                term.function,
                term.index.shape,
                np.ascontiguousarray(term.index, dtype=np.int64).tobytes(),
                tuple(_shape(values) for values in term.observed),
            )
            for term in self.terms
            if len(term.index)
        ]
        reweighted = any(term.robust for term in self.terms if len(term.index))
        return Structure(len(self.start), tuple(terms), self.exact_hessian, reweighted)

    @property
    def observed(self) -> Array:
        """What all observations saw, as one vector: the parameters of the structure."""
        parts = [
            _side_by_side(values).ravel(order="F")
            for term in self.terms
            if len(term.index)
            for values in term.observed
        ]
        return np.concatenate([np.zeros(0), *parts])

    @property
    def block(self) -> IntArray:
        """Number of the observation that each residual belongs to, (m,); -1 where not robust."""
        blocks, n_blocks = [], 0
        for term in self.terms:
            number = np.arange(n_blocks, n_blocks + len(term.index))
            blocks.append(np.repeat(number if term.robust else -1 + 0 * number, term.n_rows))
            n_blocks += len(term.index)
        return np.concatenate(blocks)


def structure_residuals(structure: Structure) -> ca.Function:
    """Return the function (x, observed) -> residuals of all terms, (m,)."""
    x, seen = _symbols(structure)
    found = [
        ca.vec(_mapped(function, index, x, observed))
        for (function, _, _, _), index, observed in _terms(structure, seen)
    ]
    return ca.Function("residuals", [x, seen], [ca.vertcat(ca.MX(0, 1), *found)])


def structure_jacobian(structure: Structure) -> ca.Function:
    """Return the function (x, observed) -> sparse Jacobian of the residuals, (m, n)."""
    n_unknowns = structure.n_unknowns
    x, seen = _symbols(structure)
    values, n_before = [ca.MX(0, 1)], 0
    rows, columns = [np.zeros(0, dtype=np.intp)], [np.zeros(0, dtype=np.intp)]
    for (function, _, _, _), index, observed in _terms(structure, seen):
        n, n_local = index.shape
        n_rows = int(function.size1_out(0))
        values.append(ca.vec(_mapped(_derivative(function), index, x, observed)))
        # CasADi stores columns: of one observation all residuals by its first unknown come first.
        of_observation = np.arange(n * n_rows).reshape(n, 1, n_rows)
        rows.append(n_before + np.repeat(of_observation, n_local, axis=1).ravel())
        columns.append(np.repeat(index.ravel(), n_rows))
        n_before += n * n_rows
    row, column = np.concatenate(rows), np.concatenate(columns)
    order = np.lexsort((row, column))
    order = order[column[order] >= 0]
    first = np.searchsorted(column[order], np.arange(n_unknowns + 1))
    pattern = ca.Sparsity(n_before, n_unknowns, first.tolist(), row[order].tolist())
    jacobian = ca.MX(pattern, ca.vertcat(*values)[order.tolist()])
    return ca.Function("jacobian", [x, seen], [jacobian])


def _symbols(structure: Structure) -> tuple[ca.MX, ca.MX]:
    """Return the unknowns and the parameters of a structure."""
    return ca.MX.sym("x", structure.n_unknowns), ca.MX.sym("observed", structure.n_observed)


def _terms(
    structure: Structure, seen: ca.MX
) -> Iterator[tuple[tuple[ca.Function, tuple[int, ...], bytes, Any], IntArray, list[ca.MX]]]:
    """Return each term with its index and its part of the parameters, observations side by side."""
    place = 0
    for term in structure.terms:
        _, shape, index, shapes = term
        observed = []
        for a, b in shapes:
            size = shape[0] * a * b
            observed.append(ca.reshape(seen[place : place + size], a, shape[0] * b))
            place += size
        yield term, np.frombuffer(index, dtype=np.int64).reshape(shape), observed


def _mapped(function: ca.Function, index: IntArray, x: ca.MX, observed: list[ca.MX]) -> ca.MX:
    """Return a function of (local, *observed) for all observations of a term, side by side."""
    n, n_local = index.shape
    place = np.where(index >= 0, index, x.numel())
    local = ca.reshape(ca.vertcat(x, 0.0)[place.ravel().tolist()], n_local, n)
    mapped: ca.MX = function.map(n)(local, *observed)
    return mapped


def _shape(values: Array) -> tuple[int, int]:
    """Return the shape of what one observation saw, as a matrix."""
    rows, columns = (*values.shape[1:], 1, 1)[:2]
    return rows, columns


def _side_by_side(values: Array) -> Array:
    """Return numbers, vectors or matrices of n observations as the columns of one matrix."""
    if values.ndim < 3:
        return np.atleast_2d(values.T)
    return np.swapaxes(values, 0, 1).reshape(values.shape[1], -1)


def _derivative(function: ca.Function) -> ca.Function:
    """Return the derivative of a function of (local, *observed) by its local unknowns, full."""
    inputs = [ca.SX.sym(f"i{k}", *function.size_in(k)) for k in range(function.n_in())]
    jacobian = ca.densify(ca.jacobian(function(*inputs), inputs[0]))
    return ca.Function("derivative", inputs, [jacobian])


_RANK = 1e-7  # singular values of the scaled Jacobian below this are directions that nothing shows


@dataclass(frozen=True, eq=False)
class Solution:
    """A converged least-squares problem.

    Attributes
    ----------
    x : (n,) array
        The unknowns.
    residuals : (m,) array
        The residuals there, times the square root of their weights.
    jacobian : (m, n) sparse array
        Their derivative there.
    n_shared : int
        Number of unknowns, the first ones, that many observations share.
    n_iterations : int
        Iterations that IPOPT took, over all weights.
    status : str
        What IPOPT says about the end.
    """

    x: Array
    residuals: Array
    jacobian: csc_array[np.float64]
    n_shared: int
    n_iterations: int
    status: str

    @property
    def cost(self) -> float:
        """Half the sum of squared residuals."""
        return 0.5 * float(self.residuals @ self.residuals)

    def without_last(self, n_rows: int) -> Solution:
        """Return what is left without the last residuals, at the same place."""
        n_kept = len(self.residuals) - n_rows
        return replace(self, residuals=self.residuals[:n_kept], jacobian=self.jacobian[:n_kept])

    def covariance(self) -> Array:
        """Return the covariance of the shared unknowns when residuals have unit variance.

        Directions that no residual shows are given none: see :meth:`unseen`.
        """
        scale = column_scale(self.jacobian)
        triangle = _shared_triangle(self.jacobian, scale, self.n_shared)
        scaled = np.linalg.pinv(triangle, rcond=_RANK) * scale[: self.n_shared, None]
        return np.asarray(scaled @ scaled.T)

    def information(self) -> Array:
        """Return whitened rows (n_shared, n_shared) that say the same of the shared unknowns.

        They are derivatives of residuals in standard deviations, the other unknowns being free.
        """
        scale = column_scale(self.jacobian)
        triangle = _shared_triangle(self.jacobian, scale, self.n_shared)
        return np.asarray(triangle / scale[: self.n_shared])

    def unseen(self, n_first: int) -> BoolArray:
        """Return which of the first unknowns can move without changing any residual, (n_first,).

        They are to be among the shared ones.
        """
        scale = column_scale(self.jacobian)
        triangle = _shared_triangle(self.jacobian, scale, self.n_shared)
        rows = _eliminated(triangle[None, :, n_first:], triangle[None, :, :n_first])
        _, singular, directions = np.linalg.svd(rows)
        null = directions[np.count_nonzero(singular >= _RANK) :]
        return np.asarray(np.abs(null).max(axis=0, initial=0.0) > 1e-3)


def column_scale(jacobian: csc_array[np.float64]) -> Array:
    """Return the change of each unknown that moves the residuals by one unit, (n,)."""
    norms = np.sqrt(np.asarray(jacobian.multiply(jacobian).sum(axis=0)).ravel())
    floor = 1e-6 * float(norms.max(initial=0.0)) or 1.0
    return np.asarray(1.0 / np.maximum(norms, floor))


def _shared_triangle(jacobian: csc_array[np.float64], scale: Array, n_shared: int) -> Array:
    """Return R of the scaled Jacobian after the other unknowns are eliminated, square."""
    entries = jacobian.tocoo()
    row, column = np.asarray(entries.row, np.intp), np.asarray(entries.col, np.intp)
    values = entries.data * scale[column]
    own = column >= n_shared
    group_of_row, place_of_column = _groups(jacobian, n_shared)
    alone = group_of_row < 0
    shared_rows = np.zeros((int(alone.sum()), n_shared))
    here = alone[row]
    shared_rows[(np.cumsum(alone) - 1)[row[here]], column[here]] = values[here]
    n_groups = int(group_of_row.max(initial=-1)) + 1
    if n_groups:
        slot = _rank_in_group(group_of_row)
        n_slots, n_own = int(slot.max()) + 1, int(place_of_column.max()) + 1
        filled = np.zeros((n_groups, n_slots, n_own + n_shared))
        place = n_own + column
        place[own] = place_of_column[column[own] - n_shared]
        filled[group_of_row[row[~here]], slot[row[~here]], place[~here]] = values[~here]
        rest = _eliminated(filled[:, :, :n_own], filled[:, :, n_own:])
        shared_rows = np.concatenate([shared_rows, rest])
    reduced = np.asarray(np.linalg.qr(shared_rows, mode="r"))
    return np.vstack([reduced, np.zeros((n_shared - len(reduced), n_shared))])


def _groups(jacobian: csc_array[np.float64], n_shared: int) -> tuple[IntArray, IntArray]:
    """Return the group of each row, -1 for none, and each other unknown's place in its group."""
    n_rows, n = jacobian.shape
    if n == n_shared:
        return np.full(n_rows, -1), np.zeros(0, dtype=np.intp)
    own = jacobian[:, n_shared:]
    _, group = connected_components(own.T @ own, directed=False)
    group_of_row = np.full(n_rows, -1)
    entries = own.tocoo()
    group_of_row[entries.row] = group[entries.col]
    return group_of_row, _rank_in_group(np.asarray(group, np.intp))


def _rank_in_group(group: IntArray) -> IntArray:
    """Return the how-manieth of its group each entry is."""
    order = np.argsort(group, kind="stable")
    in_order = group[order]
    rank = np.zeros(len(group), dtype=np.intp)
    rank[order] = np.arange(len(group)) - np.searchsorted(in_order, in_order)
    return rank


def _eliminated(own: Array, shared: Array) -> Array:
    """Return what the rows [own, shared] of (k, r, n) groups say about the shared unknowns alone.

    Rows are turned until as few as possible contain the own unknowns, which are then dropped.
    """
    n_own, n_shared = own.shape[2], shared.shape[2]
    if n_own == 0:
        return shared.reshape(-1, n_shared)
    rows = np.asarray(np.linalg.qr(np.concatenate([own, shared], axis=2), mode="r"))
    left, singular, _ = np.linalg.svd(rows[:, :, :n_own])
    turned = np.swapaxes(left, 1, 2) @ rows[:, :, n_own:]
    turned[:, : singular.shape[1]][singular >= _RANK] = 0.0
    return np.asarray(turned.reshape(-1, n_shared))


_REWEIGHTINGS = 4
_OUTLIER = 4.0  # an observation this many times the median has half its weight
_SETTLED = 0.01  # change of a weight that no longer matters
_NO_NOISE = 1e-3  # standard deviations: smaller residuals are rounding, and nobody's fault
_KEPT = 8  # structures: those of one run of the steps, with either criteria
_OPTIONS: dict[str, bool | int | float | str] = {
    "print_time": False,
    "calc_lam_p": False,
    "no_nlp_grad": True,
    "ipopt.print_level": 0,
    "ipopt.sb": "yes",
    "ipopt.tol": 1e-8,
    "ipopt.acceptable_tol": 1e-6,  # of a standard deviation: where rounding ends the progress
    "ipopt.acceptable_iter": 8,
    "ipopt.max_iter": 300,
    "ipopt.mu_init": 1e-9,
    "ipopt.nlp_scaling_method": "none",
}


def solve_least_squares(problem: LeastSquares) -> Solution:
    """Minimise half the sum of squared residuals with IPOPT and a Gauss-Newton Hessian.

    With robust terms the problem is solved again with Cauchy weights until these have settled:
    an observation far beyond the median loses its say. The unknowns are counted from the start
    in units of what one residual unit shows, so that tolerances do not depend on the units of
    length or on the noise.

    Parameters
    ----------
    problem : LeastSquares
        What to minimise.

    Returns
    -------
    Solution

    Raises
    ------
    DidNotConverge
        If IPOPT does not report success, to its tolerance or to the acceptable one.
    """
    built, observed = _built(problem.structure), ca.DM(problem.observed)
    scale = _scale(problem, built, observed)
    given = ca.vertcat(ca.DM(problem.start), ca.DM(scale), observed)
    block = problem.block
    root_weight = np.ones(len(block))
    z, n_iterations, status = _minimum(problem, built, given, 0.0 * scale, root_weight)
    x = problem.start + scale * z
    for _ in range(_REWEIGHTINGS if np.any(block >= 0) else 0):
        new = _cauchy_root_weights(_dense(built.residuals(x, observed)), block)
        if np.max(np.abs(new - root_weight)) < _SETTLED:
            break
        root_weight = new
        z, more, status = _minimum(problem, built, given, z, root_weight)
        x = problem.start + scale * z
        n_iterations += more
    return Solution(
        x=x,
        residuals=root_weight * _dense(built.residuals(x, observed)),
        jacobian=csc_array(diags_array(root_weight) @ _sparse(built.jacobian(x, observed))),
        n_shared=len(x) if problem.n_shared is None else problem.n_shared,
        n_iterations=n_iterations,
        status=status,
    )


@dataclass(frozen=True, eq=False)
class _Built:
    """All problems of one structure in scaled unknowns, ready to be solved.

    The parameters of the solver are square roots of weights, start, scale and what was observed.
    """

    solver: ca.Function
    residuals: ca.Function
    jacobian: ca.Function


@lru_cache(maxsize=_KEPT)
def _built(structure: Structure) -> _Built:
    """Return the problems of a structure as IPOPT takes them."""
    residuals, jacobian = structure_residuals(structure), structure_jacobian(structure)
    n, m = structure.n_unknowns, structure.n_residuals
    z, p = ca.MX.sym("z", n), ca.MX.sym("p", m + 2 * n + structure.n_observed)
    root_weight, start, scale = p[:m], p[m : m + n], p[m + n : m + 2 * n]
    observed = p[m + 2 * n :]
    x = start + scale * z
    weighted = root_weight * residuals(x, observed)
    slope = ca.diag(root_weight) @ jacobian(x, observed) @ ca.diag(scale)
    cost = 0.5 * ca.sumsqr(weighted)
    gradient = ca.densify(ca.mtimes(slope.T, weighted))  # IPOPT reads it as full
    options: dict[str, Any] = dict(_OPTIONS)
    options["grad_f"] = ca.Function(
        "nlp_grad_f", [z, p], [cost, gradient], ["x", "p"], ["f", "grad_f_x"]
    )
    if not structure.exact_hessian:
        options["hess_lag"] = _gauss_newton(z, p, slope)
    if structure.reweighted:  # more iterations only look for a descent below rounding
        options["ipopt.acceptable_iter"] = 2
    nlp: dict[str, Any] = {"x": z, "p": p, "f": cost}
    return _Built(ca.nlpsol("solver", "ipopt", nlp, options), residuals, jacobian)


def _scale(problem: LeastSquares, built: _Built, observed: ca.DM) -> Array:
    """Return the unit of each unknown: what one residual unit shows at the start."""
    scale = column_scale(_sparse(built.jacobian(problem.start, observed)))
    if problem.exact_hessian:  # coordinates of one kind; some columns of J may vanish
        scale = np.full_like(scale, scale.min())
    return scale


def _minimum(
    problem: LeastSquares, built: _Built, given: ca.DM, z: Array, root_weight: Array
) -> tuple[Array, int, str]:
    """Return the scaled minimum for given weights, the iterations and the status, or refuse."""
    found = built.solver(x0=z, p=ca.vertcat(ca.DM(root_weight), given))
    stats = built.solver.stats()
    if not stats["success"]:
        raise DidNotConverge(
            f"{problem.name} could not be computed: IPOPT stopped after {stats['iter_count']} "
            f"iterations with {stats['return_status']}, needed Solve_Succeeded or "
            "Solved_To_Acceptable_Level; check the nominal model and the observations, or reject "
            "the ones with large residuals."
        )
    return _dense(found["x"]), int(stats["iter_count"]), str(stats["return_status"])


def _cauchy_root_weights(residuals: Array, block: IntArray) -> Array:
    """Return square roots of 1 / (1 + (chi / limit)^2), chi being the size of each block."""
    inside = block >= 0
    size = np.zeros(int(block.max(initial=0)) + 1)
    np.add.at(size, block[inside], residuals[inside] ** 2)
    chi = np.sqrt(size)
    limit = max(_OUTLIER * float(np.median(chi[np.unique(block[inside])])), _NO_NOISE)
    root_weight = np.ones(len(block))
    root_weight[inside] = 1.0 / np.sqrt(1.0 + (chi[block[inside]] / limit) ** 2)
    return root_weight


def _gauss_newton(z: ca.MX, p: ca.MX, jacobian: ca.MX) -> ca.Function:
    """Return J'J as the Hessian of the Lagrangian that IPOPT asks for."""
    lam_f, lam_g = ca.MX.sym("lam_f"), ca.MX.sym("lam_g", 0)
    return ca.Function(
        "nlp_hess_l",
        [z, p, lam_f, lam_g],
        [lam_f * ca.triu(ca.mtimes(jacobian.T, jacobian))],
        ["x", "p", "lam_f", "lam_g"],
        ["triu_hess_gamma_x_x"],
    )


def _dense(column: ca.DM) -> Array:
    """Return a CasADi column as an array."""
    return np.asarray(column.full()).ravel()


def _sparse(matrix: ca.DM) -> csc_array[np.float64]:
    """Return a CasADi matrix as a sparse array."""
    first, row = matrix.sparsity().get_ccs()
    return csc_array((np.array(matrix.nonzeros()), row, first), shape=matrix.shape)


def moved_points(step: ca.SX, R: ca.SX, t: ca.SX, points: ca.SX) -> ca.SX:
    """Return points moved by an unknown rigid motion, counted from a start.

    Parameters
    ----------
    step : (6, 1) SX
        Translation [m], and Gibbs vector w of the turn that follows the start's rotation:
        tan(angle / 2) along the axis. It has no branches and no square root.
    R, t : (3, 3) SX, (3, 1) SX
        Rotation matrix and translation [m] of the motion at step = 0.
    points : (3, n) SX
        Points, one a column.

    Returns
    -------
    (3, n) SX
    """
    return turned_points(step[3:], R @ points) + ca.repmat(t + step[:3], 1, points.shape[1])


def turned_points(w: ca.SX, points: ca.SX) -> ca.SX:
    """Return points (3, n) turned by the rotation that has the Gibbs vector w (3, 1)."""
    cross = ca.skew(w)
    turn = ca.SX.eye(3) + 2.0 / (1.0 + ca.dot(w, w)) * (cross + ca.mtimes(cross, cross))
    return turn @ points


def moved(step: Array, start: RigidTransform) -> RigidTransform:
    """Return the motion that :func:`moved_points` applies, for numbers."""
    w = step[3:]
    size = float(np.linalg.norm(w))
    turn = Rotation.from_rotvec(w * (2.0 * np.arctan(size) / size if size > 0.0 else 2.0))
    return RigidTransform.from_components(start.translation + step[:3], turn * start.rotation)


def whitener(covariance: Array) -> Array:
    """Return W with W covariance W' = 1, for symmetric positive covariances (..., n, n)."""
    return np.asarray(np.linalg.inv(np.linalg.cholesky(covariance)))
