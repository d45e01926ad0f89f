"""Building the fit: a CasADi problem over all measurements, ready for IPOPT.

Building fixes only the structure: which unknowns each measurement depends on. References,
measured values, weights and the width of the loss are parameters, so that one problem
serves all rounds of a fit. Each kind of residual is mapped over its measurements; small dense
Hessian blocks go to their places in the sparse Hessian by one constant selection matrix.
"""

from dataclasses import dataclass
from typing import Any

import casadi as ca
import numpy as np

from legcal.geometry.types import Array, IntArray
from legcal.refinement.loss import LossFunctions, robust_loss
from legcal.refinement.observed import ObservedOutlines, Readings
from legcal.refinement.observed_axes import ObservedAxes
from legcal.refinement.residuals import (
    Residual,
    axis_residual,
    encoder_residual,
    outline_residual,
    prior_residual,
)
from legcal.refinement.state import Layout

IPOPT_OPTIONS = {
    "print_time": False,
    "show_eval_warnings": False,
    "calc_lam_p": False,
    "no_nlp_grad": True,
    "ipopt.print_level": 0,
    "ipopt.sb": "yes",
    "ipopt.tol": 1e-3,
    "ipopt.acceptable_iter": 0,
    "ipopt.nlp_scaling_method": "none",
}


@dataclass(frozen=True, eq=False)
class Prior:
    """A Gaussian prior on single unknowns.

    Attributes
    ----------
    position : (n,) array of int
        Positions of the unknowns in x.
    mean, sigma : (n,) array
        Means and standard deviations [m or rad].
    """

    position: IntArray
    mean: Array
    sigma: Array


@dataclass(frozen=True, eq=False)
class FitProblem:
    """A fit, built and not yet solved.

    Attributes
    ----------
    layout : Layout
    outlines : ObservedOutlines
    readings : Readings
    radius_prior : Prior
    axes : ObservedAxes
    solver : casadi.Function
        IPOPT on the whole problem; its parameter is that of
        :func:`legcal.refinement.inputs.parameter_of`.
    outline_index, encoder_index, axis_index : (n, 19), (n, 13) and (n, 18) array of int
        Positions in x of the unknowns of each measurement; ``layout.size`` where fixed.
    cost, gradient, hessian : casadi.Function
        Of (x, parameter): the robust cost, its gradient and the upper triangle of its
        Gauss-Newton Hessian.
    """

    layout: Layout
    outlines: ObservedOutlines
    readings: Readings
    radius_prior: Prior
    axes: ObservedAxes
    outline_index: IntArray
    encoder_index: IntArray
    axis_index: IntArray
    cost: ca.Function
    gradient: ca.Function
    hessian: ca.Function
    solver: ca.Function

    @property
    def n_equations(self) -> int:
        """Number of residuals, priors left out."""
        return 2 * len(self.outlines) + len(self.readings) + 4 * len(self.axes)


@dataclass(frozen=True, eq=False)
class _Term:
    """One kind of residual, mapped over its measurements."""

    loss: LossFunctions
    residual: Residual
    index: IntArray
    data: ca.MX


def build_problem(
    layout: Layout,
    outlines: ObservedOutlines,
    readings: Readings,
    radius_prior: Prior,
    axes: ObservedAxes,
    max_iterations: int = 100,
) -> FitProblem:
    """Build the fit of everything.

    Parameters
    ----------
    layout : Layout
        The unknowns.
    outlines : ObservedOutlines
    readings : Readings
    radius_prior : Prior
        Prior on the radii.
    axes : ObservedAxes
    max_iterations : int
        Limit for IPOPT.

    Returns
    -------
    FitProblem
    """
    outline_index = np.column_stack(
        [
            layout.base[outlines.leg],
            layout.platform[outlines.leg],
            layout.radius[outlines.radius],
            layout.camera[outlines.view],
            layout.pose[outlines.pose],
        ]
    )
    encoder_index = np.column_stack(
        [
            layout.base[readings.leg],
            layout.platform[readings.leg],
            layout.offset[readings.leg],
            layout.pose[readings.pose],
        ]
    )
    axis_index = np.column_stack(
        [
            layout.base[axes.leg],
            layout.platform[axes.leg],
            layout.camera[axes.view],
            layout.pose[axes.pose],
        ]
    )
    kinds = [
        (outline_residual(), outline_index),
        (encoder_residual(), encoder_index),
        (prior_residual(), radius_prior.position[:, None]),
        (axis_residual(), axis_index),
    ]
    x = ca.MX.sym("x", layout.size)
    terms = []
    for residual, index in kinds:
        data = ca.MX.sym(f"{residual.name}_data", residual.n_data, len(index))
        terms.append(_Term(robust_loss(residual), residual, index, data))
    parameter = ca.veccat(*[term.data for term in terms])
    cost, gradient, hessian = _sums(terms, x)
    # The terms' data are slices of one parameter vector for IPOPT, and inputs for us.
    inputs = [x, *[term.data for term in terms]]
    names = ["x", *[term.residual.name for term in terms]]
    cost_function = ca.Function("cost", inputs, [cost], names, ["f"])
    gradient_function = ca.Function("gradient", inputs, [gradient], names, ["g"])
    hessian_function = ca.Function("hessian", inputs, [hessian], names, ["H"])
    p = ca.MX.sym("p", parameter.size1())
    solver = _ipopt(x, p, terms, cost_function, gradient_function, hessian_function, max_iterations)
    return FitProblem(
        layout,
        outlines,
        readings,
        radius_prior,
        axes,
        outline_index,
        encoder_index,
        axis_index,
        cost_function,
        gradient_function,
        hessian_function,
        solver,
    )


def _sums(terms: list[_Term], x: ca.MX) -> tuple[ca.MX, ca.MX, ca.MX]:
    """Return cost, gradient and upper triangle of the Hessian of all terms."""
    size = x.size1()
    x_and_zero = ca.vertcat(x, 0.0)
    cost, gradient = ca.MX(0.0), ca.MX.zeros(size + 1)
    blocks, rows, columns = [], [], []
    for term in terms:
        n, m = term.index.shape
        if n == 0:
            continue
        local = ca.reshape(x_and_zero[term.index.ravel().tolist()], m, n)
        cost += ca.sum2(term.loss.cost.map(n)(local, term.data))
        local_gradient = ca.vec(term.loss.gradient.map(n)(local, term.data))
        places = np.arange(n * m)
        gradient += _selection(term.index.ravel(), places, size + 1, n * m) @ local_gradient
        blocks.append(ca.vec(term.loss.hessian.map(n)(local, term.data)))
        i, j = np.triu_indices(m)
        a, b = term.index[:, i].ravel(), term.index[:, j].ravel()
        rows.append(np.minimum(a, b))
        columns.append(np.maximum(a, b))
    row, column = np.concatenate(rows), np.concatenate(columns)
    place = np.flatnonzero(column < size)
    entry, target = np.unique(column[place] * (size + 1) + row[place], return_inverse=True)
    pattern = ca.Sparsity.triplet(
        size, size, (entry % (size + 1)).tolist(), (entry // (size + 1)).tolist()
    )
    values = _selection(target, place, len(entry), len(row)) @ ca.vertcat(*blocks)
    return cost, gradient[:size], ca.MX(pattern, values)


def _selection(row: IntArray, column: IntArray, n_rows: int, n_columns: int) -> ca.DM:
    """Return a 0/1 matrix with at most one entry in each column."""
    occupied = np.zeros(n_columns, dtype=np.intp)
    occupied[column] = 1
    start = np.concatenate([[0], np.cumsum(occupied)])
    return ca.DM.ones(ca.Sparsity(n_rows, n_columns, start.tolist(), row.tolist()))


def _ipopt(
    x: ca.MX,
    p: ca.MX,
    terms: list[_Term],
    cost: ca.Function,
    gradient: ca.Function,
    hessian: ca.Function,
    max_iterations: int,
) -> ca.Function:
    """Return IPOPT on the cost, with its gradient and the Gauss-Newton Hessian given."""
    lam_f, lam_g = ca.MX.sym("lam_f"), ca.MX.sym("lam_g", 0)
    sizes = np.cumsum([0, *[term.data.numel() for term in terms]]).tolist()
    data = [
        ca.reshape(part, term.data.size1(), term.data.size2())
        for part, term in zip(ca.vertsplit(p, sizes), terms, strict=True)
    ]
    f = cost(x, *data)
    grad_f = ca.Function("grad_f", [x, p], [f, gradient(x, *data)], ["x", "p"], ["f", "grad_f_x"])
    hess_lag = ca.Function(
        "hess_lag",
        [x, p, lam_f, lam_g],
        [lam_f * hessian(x, *data)],
        ["x", "p", "lam_f", "lam_g"],
        ["hess_gamma_x_x"],
    )
    problem: dict[str, Any] = {"x": x, "p": p, "f": f}
    options: dict[str, Any] = {
        **IPOPT_OPTIONS,
        "ipopt.max_iter": max_iterations,
        "grad_f": grad_f,
        "hess_lag": hess_lag,
    }
    return ca.nlpsol("refine", "ipopt", problem, options)
