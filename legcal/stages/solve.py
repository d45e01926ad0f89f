"""Least squares with IPOPT: the one place of steps 2, 3 and 4.

A step builds its problem; this module keeps what problems of one structure share, as those of many
simulated sessions do, scales the unknowns, hands IPOPT the sparse Gauss-Newton
Hessian J'J (or leaves it the exact one) and refuses an answer that did not converge.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import casadi as ca
import numpy as np
from scipy.sparse import csc_array, diags_array

from legcal.errors import DidNotConverge
from legcal.geometry.types import Array, IntArray
from legcal.stages.least_squares import (
    LeastSquares,
    Structure,
    structure_jacobian,
    structure_residuals,
)
from legcal.stages.solution import Solution, column_scale

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
