"""Euler angles of a leg's axis in the camera frame, the (psi, theta) of Table 1.

The paper names the angles and does not define them. Here psi is the tilt out of the plane of
the image and theta the angle in the image, from its y axis: the axis is the camera's y axis turned
by psi about x and then by theta about z, ``u = Rz(theta) Rx(psi) e_y``. An image tells theta far
better than psi.
"""

import numpy as np

from legcal.geometry.types import Array


def direction_of_angles(psi: Array, theta: Array) -> Array:
    """Return u = (-sin theta cos psi, cos theta cos psi, sin psi).

    Parameters
    ----------
    psi, theta : (...) array
        Tilt away from the image plane, and angle in the image [rad].

    Returns
    -------
    (..., 3) array
        Unit directions in the camera frame, from base to platform.
    """
    return np.stack(
        [-np.sin(theta) * np.cos(psi), np.cos(theta) * np.cos(psi), np.sin(psi)], axis=-1
    )


def angles_of_direction(u: Array) -> tuple[Array, Array]:
    """Return psi = asin(u_z) and theta = atan2(-u_x, u_y).

    Parameters
    ----------
    u : (..., 3) array
        Unit directions in the camera frame, from base to platform. Along the optical axis theta
        has no meaning; 0 is returned.

    Returns
    -------
    psi, theta : (...) array
        In [-pi/2, pi/2] and [-pi, pi] [rad].
    """
    x, y, z = np.moveaxis(u, -1, 0)
    # The same as asin(u_z), without its loss of digits near the optical axis.
    return np.arctan2(z, np.hypot(x, y)), np.arctan2(-x, y)


def direction_derivative(psi: Array, theta: Array) -> Array:
    """Return d u / d (psi, theta), (..., 3, 2); arguments as in :func:`direction_of_angles`.

    Both columns are normal to u; the second vanishes along the optical axis.
    """
    by_psi = [np.sin(theta) * np.sin(psi), -np.cos(theta) * np.sin(psi), np.cos(psi)]
    by_theta = [-np.cos(theta) * np.cos(psi), -np.sin(theta) * np.cos(psi), np.zeros_like(psi)]
    return np.stack([np.stack(by_psi, axis=-1), np.stack(by_theta, axis=-1)], axis=-1)
