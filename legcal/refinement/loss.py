"""The robust loss, and the pieces that a solver needs of each kind of residual.

With s the squared norm of a whitened residual the cost is s / (1 + sqrt(1 + k s)), the
pseudo-Huber loss of width k^-1/2: s / 2 for small s, linear in the distance far out, convex, and
plain least squares for k = 0. No residual, however wrong, pulls with more than that width.
"""

from dataclasses import dataclass
from functools import cache
from math import gamma

import casadi as ca
import numpy as np

from legcal.geometry.types import Array
from legcal.refinement.residuals import Residual


@dataclass(frozen=True, eq=False)
class LossFunctions:
    """CasADi functions of (local, data) for one measurement of a kind.

    Attributes
    ----------
    cost, gradient, hessian : casadi.Function
        The robust cost, its gradient and the upper triangle, row by row, of the Gauss-Newton
        Hessian with the weight of iterated least squares: positive semidefinite everywhere.
    jacobian : casadi.Function
        The whitened residual and its Jacobian.
    """

    cost: ca.Function
    gradient: ca.Function
    hessian: ca.Function
    jacobian: ca.Function


def width_to_k(width: float) -> float:
    """Return k of a loss that turns linear at a whitened distance; 0 for an infinite one."""
    return 1.0 / (width * width)


def weights(s: Array, k: float) -> Array:
    """Return the weights of iterated least squares at squared whitened norms."""
    return np.asarray(1.0 / np.sqrt(1.0 + k * s))


def curvature(r: Array, k: float) -> Array:
    """Return the Hessian (..., m, m) of the loss at whitened residuals r (..., m)."""
    s = np.sum(r**2, axis=-1)[..., None, None]
    eye = np.eye(r.shape[-1])
    return np.asarray(
        eye / np.sqrt(1.0 + k * s) - k * r[..., :, None] * r[..., None, :] / (1.0 + k * s) ** 1.5
    )


def efficiency(k: float, m: int = 2) -> float:
    """Return the information that the loss keeps of m Gaussian residuals, 1 for k = 0.

    E[psi']^2 / E[psi^2], the factor of the asymptotic covariance of an M-estimator.
    """
    node, weight = np.polynomial.laguerre.laggauss(60)
    weight = weight * node ** (0.5 * m - 1.0) / gamma(0.5 * m)
    s = 2.0 * node  # the squared norm of m unit Gaussians has the density s^(m/2-1) exp(-s/2)
    w = weights(s, k)
    slope = w - k * s * w**3 / m
    return float((weight @ slope) ** 2 / (weight @ (w**2 * s / m)))


@cache
def _robust_loss(name: str, function: ca.Function) -> LossFunctions:
    n_local, n_data = function.size1_in(0), function.size1_in(1)
    local, data = ca.SX.sym("local", n_local), ca.SX.sym("data", n_data)
    r = function(local, data)
    J = ca.jacobian(r, local)
    s, k = ca.sumsqr(r), data[n_data - 1]
    root = ca.sqrt(1.0 + k * s)
    H = ca.mtimes(J.T, J) / root
    rows, columns = np.triu_indices(n_local)
    upper = ca.vertcat(*[H[int(i), int(j)] for i, j in zip(rows, columns, strict=True)])
    options = {"cse": True}
    inputs = [local, data]
    return LossFunctions(
        ca.Function(f"{name}_cost", inputs, [s / (1.0 + root)], options),
        ca.Function(f"{name}_gradient", inputs, [ca.mtimes(J.T, r) / root], options),
        ca.Function(f"{name}_hessian", inputs, [ca.densify(upper)], options),
        ca.Function(f"{name}_jacobian", inputs, [r, ca.densify(J)], options),
    )


def robust_loss(residual: Residual) -> LossFunctions:
    """Return cost, gradient, Gauss-Newton Hessian and Jacobian of one kind of residual."""
    return _robust_loss(residual.name, residual.function)
