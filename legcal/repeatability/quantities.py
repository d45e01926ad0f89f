"""What Table 1 lists of a leg's axis, and the same errors in the image and towards the camera.

The last four are written in the frame of the ray to the middle of the visible leg: ``n`` is normal
to the plane of the ray and the axis, ``w`` lies in that plane, normal to the axis and away from the
camera. Turning about w and moving along n are seen in the image; turning about n and moving
along w, towards or away from the camera, hardly.
"""

from dataclasses import dataclass

import numpy as np

from legcal.geometry.types import Array, BoolArray
from legcal.observations.leg_axes import LegAxes
from legcal.vision.euler import angles_of_direction

ANGLES = ("psi", "theta", "angle", "tilt")
QUANTITIES = ("psi", "theta", "x", "z", "angle", "across", "tilt", "depth")
OF_M_LS = ("x", "z")
SURELY = 3.0  # standard deviations by which an axis must be inclined to the plane of M_LS
_STEP = 1e-6  # of derivatives [rad, m]
_M_LS_ROWS = [QUANTITIES.index(name) for name in OF_M_LS]


@dataclass(frozen=True, eq=False)
class AxisValues:
    """Repeated axes of one leg as numbers.

    Attributes
    ----------
    values : (n, 8) array
        The ``QUANTITIES`` of each, as differences to the first one [rad, m].
    claimed : (n, 8, 8) array
        Their claimed covariances.
    inclination : (n,) array
        Angle between the image of each axis and the image x axis [rad].
    has_M_LS : bool
        False if any of the axes is seen so nearly parallel to the image x axis that the place in
        the image where M_LS is seen has an expected standard deviation above the leg's width, or
        is parallel to the plane y = 0 within ``SURELY`` of its standard deviations.
    """

    values: Array
    claimed: Array
    inclination: Array
    has_M_LS: bool


def axis_values(axes: LegAxes, chosen: BoolArray, radius: float) -> AxisValues:
    """Return what repeated axes of one leg are in numbers.

    Parameters
    ----------
    axes : LegAxes
        Axes in camera frames.
    chosen : (n_axes,) array of bool
        The repeats of one leg in one view and pose.
    radius : float
        Radius of the leg [m].
    """
    u, M = axes.u[chosen], axes.M[chosen]
    basis, covariance = axes.basis[chosen], axes.covariance[chosen]
    values = _values(u, M, u[0], M[0])
    derivative = np.empty((len(u), len(QUANTITIES), 4))
    for k in range(4):
        step = _STEP * basis[:, k % 2]
        du, dM = (step, np.zeros_like(M)) if k < 2 else (np.zeros_like(u), step)
        up, down = (_values(u + s * du, M + s * dM, u[0], M[0]) for s in (1.0, -1.0))
        derivative[..., k] = (up - down) / (2.0 * _STEP)
    claimed = derivative @ covariance @ derivative.swapaxes(1, 2)
    normal = np.cross(u, M)
    inclination = np.arctan2(np.abs(normal[:, 0]), np.abs(normal[:, 1]))
    e_y = basis[:, :, 1]
    sigma_u_y = np.sqrt(np.einsum("ni,nij,nj->n", e_y, covariance[:, :2, :2], e_y))
    has_M_LS = _has_M_LS(u, M, sigma_u_y, claimed, radius)
    return AxisValues(values, claimed, inclination, has_M_LS)


def _has_M_LS(u: Array, M: Array, sigma_u_y: Array, claimed: Array, radius: float) -> bool:
    """Say whether M_LS is expected to be seen at the same place up to the width of the leg."""
    if np.any(np.abs(u[:, 1]) <= np.maximum(SURELY * sigma_u_y, 10.0 * _STEP)):
        return False
    x, z = _M_LS(u, M)
    gradient = np.column_stack([1.0 / z, -x / z**2])  # of x / z, where M_LS is seen
    variance = np.einsum(
        "ni,nij,nj->n", gradient, claimed[:, _M_LS_ROWS][:, :, _M_LS_ROWS], gradient
    )
    return bool(np.all(np.sqrt(variance) < 2.0 * radius / np.linalg.norm(M, axis=1)))


def _values(u: Array, M: Array, u_0: Array, M_0: Array) -> Array:
    """Return the quantities of axes (n, 8) as differences to those of a reference axis."""
    n = np.cross(u_0, M_0)
    n /= np.linalg.norm(n)
    w = np.cross(n, u_0)  # the part of M_0 normal to u_0: away from the camera
    psi, theta = angles_of_direction(u)
    psi_0, theta_0 = angles_of_direction(u_0)
    x, z = _M_LS(u, M)
    x_0, z_0 = _M_LS(u_0[None], M_0[None])
    at_M = M - M_0 - u * (((M - M_0) @ u_0) / (u @ u_0))[:, None]  # where M_0 was along the leg
    columns = [
        psi - psi_0,
        np.remainder(theta - theta_0 + np.pi, 2.0 * np.pi) - np.pi,
        x - x_0,
        z - z_0,
        u @ n,
        at_M @ n,
        u @ w,
        at_M @ w,
    ]
    return np.column_stack(columns)


def _M_LS(u: Array, M: Array) -> tuple[Array, Array]:
    """Return x and z of the axis at y = 0; of any size where it is nearly parallel to it."""
    flat = np.abs(u[:, 1]) < 1e-12
    along = np.where(flat, 0.0, M[:, 1] / np.where(flat, 1.0, u[:, 1]))
    return M[:, 0] - along * u[:, 0], M[:, 2] - along * u[:, 2]
