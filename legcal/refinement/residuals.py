"""The residuals of the fit, one small pure CasADi function for each kind of measurement.

Each takes ``(local, data)``: *local* are the quantities that one measurement depends on, *data*
what was measured. How these quantities depend on the unknowns (joints, cameras, platform poses)
is in :mod:`legcal.refinement.linearize`.
"""

from dataclasses import dataclass
from functools import cache, lru_cache
from typing import Any

import casadi as ca
import numpy as np

from legcal.geometry.types import Array


@dataclass(frozen=True, eq=False)
class Residual:
    """A kind of measurement.

    Attributes
    ----------
    name : str
    n_local, n_data, n_rows : int
        Sizes of what it depends on, of the data and of the residual.
    jacobian : casadi.Function
        (local, data) -> residual and its dense Jacobian by *local*.
    """

    name: str
    n_local: int
    n_data: int
    n_rows: int
    jacobian: ca.Function

    def evaluate(self, local: Array, data: Array) -> tuple[Array, Array]:
        """Return residuals (n, n_rows) and Jacobians (n, n_rows, n_local) of n measurements.

        Parameters
        ----------
        local : (n, n_local) array
        data : (n, n_data) array
        """
        n = len(local)
        r = np.zeros((n, self.n_rows))
        by_local = np.zeros((n, self.n_local, self.n_rows))  # CasADi stores column by column
        if n:
            _fill(_mapped(self, n), [local, data], [r, by_local])
        return r, np.swapaxes(by_local, 1, 2)


def outline_of_leg(A: ca.SX, B: ca.SX, radius: ca.SX, epsilon: ca.SX) -> ca.SX:
    """Return the outline h of the cylinder about AB seen from the origin, eqs (1) and (3).

    Its length is that of A x B squared, of no matter for a line. With n = A x B and D = B - A
    eq (3) is h = epsilon r (D x n) - n sqrt(|n|^2 - |D|^2 r^2) up to that, without a division.
    """
    n, D = ca.cross(A, B), B - A
    depth = ca.sqrt(ca.dot(n, n) - radius**2 * ca.dot(D, D))
    return epsilon * radius * ca.cross(D, n) - depth * n


def offset_in_image(h: ca.SX, xy: ca.SX, J_inverse_transposed: ca.SX) -> ca.SX:
    """Return the signed distance [px] of a point of the sensor plane from the line h.

    The same as :meth:`legcal.vision.camera.Camera.line_offset`, with the derivative of the
    lens at the point given as a constant.
    """
    normal = J_inverse_transposed @ h[:2]
    return (h[0] * xy[0] + h[1] * xy[1] + h[2]) / ca.norm_2(normal)


@cache
def outline_residual() -> Residual:
    """Return the distances [px] of the predicted outline from both ends of the measured one.

    local (11): A and B in the camera frame, radius [m], both ends on the sensor plane. data (9):
    J^-T at the ends (2 x 4, column by column), epsilon.
    """
    local, data = ca.SX.sym("local", 11), ca.SX.sym("data", 9)
    h = outline_of_leg(local[0:3], local[3:6], local[6], data[8])
    offsets = [
        offset_in_image(
            h,
            local[7 + 2 * end : 9 + 2 * end],
            ca.reshape(data[4 * end : 4 + 4 * end], 2, 2),
        )
        for end in range(2)
    ]
    return _residual("outline", local, data, ca.vertcat(*offsets))


@cache
def axis_residual() -> Residual:
    """Return how far a leg's predicted axis is from a measured one: alpha1, alpha2, beta1, beta2.

    The measured axis passes through M along e1 x e2. alpha is the predicted direction in e1 and
    e2, over its part along the axis; beta is where the predicted axis meets the plane through
    M with these directions, from M [m].

    local (6): A and B in the camera frame [m]. data (9): M, e1, e2.
    """
    local, data = ca.SX.sym("local", 6), ca.SX.sym("data", 9)
    A, leg = local[0:3], local[3:6] - local[0:3]
    M, e1, e2 = data[0:3], data[3:6], data[6:9]
    basis, along = ca.horzcat(e1, e2).T, ca.cross(e1, e2)
    slope = leg / ca.dot(along, leg)
    to_A = A - M
    beta = basis @ (to_A - slope * ca.dot(along, to_A))
    return _residual("axis", local, data, ca.vertcat(basis @ slope, beta))


@cache
def corner_residual() -> Residual:
    """Return how far a predicted corner of the calibration board is from the measured one [px].

    local (5): the corner in the camera frame [m], the measured one on the sensor plane. data (4):
    the derivative of pixels by the sensor plane there (2 x 2, column by column).
    """
    local, data = ca.SX.sym("local", 5), ca.SX.sym("data", 4)
    away = local[:2] / local[2] - local[3:]
    return _residual("corner", local, data, ca.reshape(data, 2, 2) @ away)


@cache
def encoder_residual() -> Residual:
    """Return the closure of a leg, |AB| - sign q - q0 [m].

    local (7): A and B in R_b, q0 [m]. data (1): sign * q [m].
    """
    local, data = ca.SX.sym("local", 7), ca.SX.sym("data", 1)
    closure = ca.norm_2(local[3:6] - local[0:3]) - data - local[6]
    return _residual("encoder", local, data, closure)


@cache
def prior_residual() -> Residual:
    """Return the distance of an unknown from its prior in standard deviations.

    local (1): the unknown. data (2): mean, 1 / sigma.
    """
    local, data = ca.SX.sym("local", 1), ca.SX.sym("data", 2)
    return _residual("prior", local, data, (local - data[0]) * data[1])


def _residual(name: str, local: ca.SX, data: ca.SX, r: ca.SX) -> Residual:
    """Return a kind of measurement with its Jacobian."""
    options = {"cse": True}
    by_local = ca.densify(ca.jacobian(r, local))
    return Residual(
        name,
        local.size1(),
        data.size1(),
        r.size1(),
        ca.Function(f"{name}_jacobian", [local, data], [r, by_local], options),
    )


@lru_cache(maxsize=64)
def _mapped(residual: Residual, n: int) -> ca.Function:
    """Return the Jacobian over n measurements."""
    return residual.jacobian.map(n)


def _fill(function: ca.Function, inputs: list[Array], outputs: list[Array]) -> None:
    """Evaluate on NumPy's memory, row by row of measurements, without copies."""
    buffer: Any
    buffer, evaluate = function.buffer()
    kept = [np.ascontiguousarray(array, dtype=np.float64) for array in inputs]
    for i, array in enumerate(kept):
        buffer.set_arg(i, array.data)
    for i, array in enumerate(outputs):
        buffer.set_res(i, array.data)
    evaluate()
