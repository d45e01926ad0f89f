"""Axes of legs as Table 1 describes them: Euler angles (psi, theta) and M_LS = (x, 0, z)."""

import numpy as np

from legcal.geometry.lines import normal_basis
from legcal.geometry.types import Array, IntArray
from legcal.observations.leg_axes import LegAxes
from legcal.vision.cylinder import point_with_zero_y
from legcal.vision.euler import angles_of_direction, direction_derivative, direction_of_angles


def axes_of_table(row: IntArray, leg: IntArray, values: Array, sigmas: Array) -> LegAxes:
    """Return axes from their angles and their points M_LS.

    Parameters
    ----------
    row, leg : (n,) array of int
        Indices of the image and of the leg.
    values : (n, 4) array
        psi, theta [rad] and x, z [m] in the camera frame. Away from |theta| = pi/2 and
        |psi| = pi/2, where M_LS does not exist.
    sigmas : (n, 4) array
        Their standard deviations; their errors are independent.

    Returns
    -------
    LegAxes
    """
    psi, theta, x, z = values.T
    u = direction_of_angles(psi, theta)
    M = np.stack([x, np.zeros_like(x), z], axis=-1)
    basis = normal_basis(u)
    scaled = _table_derivative(basis, psi, theta) * sigmas[:, None, :]
    return LegAxes(row, leg, u, M, basis, scaled @ np.swapaxes(scaled, -1, -2))


def table_of_axes(axes: LegAxes) -> tuple[Array, Array]:
    """Return angles and points M_LS of axes with their standard deviations.

    Correlations between the four, which the table has no place for, are left out; axes that
    came from :func:`axes_of_table` have none.

    Parameters
    ----------
    axes : LegAxes

    Returns
    -------
    values, sigmas : (n, 4) array
        psi, theta [rad] and x, z [m].

    Raises
    ------
    NotVisible
        If an axis is parallel to the plane y = 0, where M_LS does not exist.
    """
    M = point_with_zero_y(axes.u, axes.M)
    # The same line and its covariance, written at M_LS.
    shift = np.sum((M - axes.M) * axes.u, axis=-1)
    move = np.tile(np.eye(4), (len(axes), 1, 1))
    move[:, 2, 0] = move[:, 3, 1] = shift
    psi, theta = angles_of_direction(axes.u)
    to_table = np.linalg.inv(_table_derivative(axes.basis, psi, theta)) @ move
    covariance = to_table @ axes.covariance @ np.swapaxes(to_table, -1, -2)
    sigmas = np.sqrt(np.einsum("nii->ni", covariance))
    return np.stack([psi, theta, M[:, 0], M[:, 2]], axis=-1), sigmas


def _table_derivative(basis: Array, psi: Array, theta: Array) -> Array:
    """Return d (alpha, beta) / d (psi, theta, x, z), (n, 4, 4)."""
    derivative = np.zeros((len(basis), 4, 4))
    derivative[:, :2, :2] = basis @ direction_derivative(psi, theta)
    derivative[:, 2:, 2:] = basis[:, :, [0, 2]]
    return derivative
