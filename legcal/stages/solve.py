"""Least-squares problems in CasADi, solved with IPOPT: the one place of steps 2, 3 and 4.

A step builds its residuals and a start; this module scales the unknowns, hands IPOPT the
Gauss-Newton Hessian J'J (or leaves it the exact one) and refuses an answer that did not converge.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import casadi as ca
import numpy as np

from legcal.errors import DidNotConverge
from legcal.geometry.types import Array, BoolArray, IntArray

_RANK = 1e-7  # singular values of the scaled Jacobian below this are directions that nothing shows
_REWEIGHTINGS = 4
_OUTLIER = 4.0  # an observation this many times the median has half its weight
_SETTLED = 0.01  # change of a weight that no longer matters
_NO_NOISE = 1e-3  # standard deviations: smaller residuals are rounding, and nobody's fault
_OPTIONS: dict[str, bool | int | float | str] = {
    "print_time": False,
    "ipopt.print_level": 0,
    "ipopt.sb": "yes",
    "ipopt.tol": 1e-8,
    "ipopt.acceptable_tol": 1e-6,  # of a standard deviation: where rounding ends the progress
    "ipopt.acceptable_iter": 8,
    "ipopt.max_iter": 300,
    "ipopt.mu_init": 1e-9,
    "ipopt.nlp_scaling_method": "none",
}


@dataclass(frozen=True, eq=False)
class LeastSquares:
    """Half the sum of squared residuals, to be minimised from a start.

    Attributes
    ----------
    name : str
        What is looked for, for messages: "the base joints (eq 9)".
    x : casadi.SX
        Unknowns, one column.
    residuals : casadi.SX
        Residuals, one column, in units of their standard deviations or of eqs (9), (14), (16).
    start : (n,) array
        Values of the unknowns to start from.
    exact_hessian : bool
        Use second derivatives of the residuals instead of J'J. Criteria that do not decide some
        unknown, as (9) and (16) with z, need it: J'J vanishes in that direction.
    block : (m,) array of int, optional
        Residuals of one observation share a number and lose weight together where they are
        outliers; -1 for residuals that keep theirs. Without it all do.
    """

    name: str
    x: ca.SX
    residuals: ca.SX
    start: Array
    exact_hessian: bool = False
    block: IntArray | None = None


@dataclass(frozen=True, eq=False)
class Solution:
    """A converged least-squares problem.

    Attributes
    ----------
    x : (n,) array
        The unknowns.
    residuals : (m,) array
        The residuals there, times the square root of their weights.
    jacobian : (m, n) array
        Their derivative there.
    n_iterations : int
        Iterations that IPOPT took, over all weights.
    status : str
        What IPOPT says about the end.
    """

    x: Array
    residuals: Array
    jacobian: Array
    n_iterations: int
    status: str

    @property
    def cost(self) -> float:
        """Half the sum of squared residuals."""
        return 0.5 * float(self.residuals @ self.residuals)

    def covariance(self) -> Array:
        """Return the covariance of the unknowns when residuals have unit variance, (n, n).

        Directions that no residual shows are given none: see :meth:`unseen`.
        """
        scale = _column_scale(self.jacobian)
        inverse = np.linalg.pinv(self.jacobian * scale, rcond=_RANK)
        scaled = inverse * scale[:, None]
        return np.asarray(scaled @ scaled.T)

    def unseen(self, n_first: int) -> BoolArray:
        """Return which of the first unknowns can move without changing any residual, (n_first,)."""
        scaled = self.jacobian * _column_scale(self.jacobian)
        n = scaled.shape[1]
        n_rest = n - n_first
        # QR eliminates the unknowns that come later: what is left is about the first ones.
        triangle = np.zeros((n, n))
        reduced = np.asarray(np.linalg.qr(np.roll(scaled, -n_first, axis=1), mode="r"))
        triangle[: len(reduced)] = reduced
        if np.linalg.svd(triangle[n_rest:, n_rest:], compute_uv=False)[-1] >= _RANK:
            return np.zeros(n_first, dtype=np.bool_)
        _, singular, rows = np.linalg.svd(triangle)
        null = rows[singular < _RANK, n_rest:]
        return np.asarray(np.abs(null).max(axis=0, initial=0.0) > 1e-3)


def solve_least_squares(problem: LeastSquares) -> Solution:
    """Minimise half the sum of squared residuals with IPOPT and a Gauss-Newton Hessian.

    With blocks the problem is solved again with Cauchy weights until these have settled: an
    observation far beyond the median loses its say. The unknowns are counted from the start in
    units of what one residual unit shows, so that tolerances do not depend on the units of
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
        If IPOPT does not report success.
    """
    built = _build(problem)
    root_weight = np.ones(problem.residuals.shape[0])
    solution = _solve(problem, built, np.zeros(len(problem.start)), root_weight)
    if problem.block is None:
        return solution
    n_iterations = solution.n_iterations
    for _ in range(_REWEIGHTINGS):
        new = _cauchy_root_weights(solution.residuals / root_weight, problem.block)
        if np.max(np.abs(new - root_weight)) < _SETTLED:
            break
        root_weight = new
        solution = _solve(problem, built, (solution.x - problem.start) / built.scale, root_weight)
        n_iterations += solution.n_iterations
    return replace(solution, n_iterations=n_iterations)


@dataclass(frozen=True, eq=False)
class _Built:
    """A problem in scaled unknowns, ready to be solved with different weights."""

    solver: ca.Function
    value: ca.Function
    slope: ca.Function
    scale: Array


def _build(problem: LeastSquares) -> _Built:
    """Return the problem as IPOPT takes it; the weights are its parameters."""
    w = ca.SX.sym("w", problem.residuals.shape[0])
    weighted = w * problem.residuals
    value = ca.Function("value", [problem.x, w], [weighted])
    slope = ca.Function("slope", [problem.x, w], [ca.jacobian(weighted, problem.x)])
    scale = _column_scale(np.asarray(slope(problem.start, 1.0).full()))
    if problem.exact_hessian:  # coordinates of one kind; some columns of J may vanish
        scale = np.full_like(scale, scale.min())
    z, p = ca.MX.sym("z", len(problem.start)), ca.MX.sym("p", w.shape[0])
    x = problem.start + scale * z
    options: dict[str, Any] = dict(_OPTIONS)
    if not problem.exact_hessian:
        options["hess_lag"] = _gauss_newton(z, p, slope(x, p) @ ca.MX(ca.diag(ca.DM(scale))))
    nlp: dict[str, Any] = {"x": z, "p": p, "f": 0.5 * ca.sumsqr(value(x, p))}
    return _Built(ca.nlpsol("solver", "ipopt", nlp, options), value, slope, scale)


def _solve(problem: LeastSquares, built: _Built, z: Array, root_weight: Array) -> Solution:
    """Return the solution for given weights, or refuse."""
    found = np.asarray(built.solver(x0=z, p=root_weight)["x"].full()).ravel()
    stats = built.solver.stats()
    if not stats["success"]:
        raise DidNotConverge(
            f"{problem.name} could not be computed: IPOPT stopped after {stats['iter_count']} "
            f"iterations with {stats['return_status']}, needed Solve_Succeeded; check the "
            "nominal model and the observations, or reject the ones with large residuals."
        )
    x = problem.start + built.scale * found
    return Solution(
        x=x,
        residuals=np.asarray(built.value(x, root_weight).full()).ravel(),
        jacobian=np.asarray(built.slope(x, root_weight).full()),
        n_iterations=int(stats["iter_count"]),
        status=str(stats["return_status"]),
    )


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


def _column_scale(jacobian: Array) -> Array:
    """Return the change of each unknown that moves the residuals by one unit."""
    norms = np.linalg.norm(jacobian, axis=0)
    floor = 1e-6 * float(norms.max(initial=0.0)) or 1.0
    return np.asarray(1.0 / np.maximum(norms, floor))
