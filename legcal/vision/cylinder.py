"""The image of a cylinder, eqs (1) to (5): its outlines, its axis, and the angles of the axis.

The paper names the Euler angles of Table 1 and does not define them. Here psi is the tilt out of
the plane of the image and theta the angle in the image, from its y axis: the axis is the camera's y
axis turned by psi about x and then by theta about z, ``u = Rz(theta) Rx(psi) e_y``. An image fixes
theta far better than psi.
"""

import numpy as np

from legcal.errors import NotVisible
from legcal.geometry.lines import cross, moment, nearest_point_to_origin
from legcal.geometry.types import Array

EPSILON = np.array([1.0, -1.0])


def outlines_of_axis(
    u: Array,  # (..., 3) unit directions in the camera frame, from base to platform
    M: Array,  # (..., 3) a point of each axis in the camera frame [m]
    radius: Array | float,  # (...) radii [m]
) -> Array:
    """Return the outlines of cylinders seen from the origin, eqs (1) and (3), (..., 2, 3).

    The tangent planes contain u, and stand at the angle asin(R / d) to the plane through the
    axis and the camera centre, d being the distance of the axis.
    """
    foot = nearest_point_to_origin(u, M)
    distance = np.linalg.norm(foot, axis=-1)
    if np.any(distance <= radius):
        raise NotVisible(
            "The outline of a cylinder could not be drawn: the camera centre is "
            f"{1e3 * float(distance.min()):.1f} mm from an axis, inside the cylinder; it must "
            "stand outside every leg; check the camera pose of the view."
        )
    sine = np.asarray(radius) / distance
    m = moment(u, M) / distance[..., None]
    toward = foot / distance[..., None]
    cosine = np.sqrt(1.0 - sine**2)
    return np.stack(
        [cosine[..., None] * m + e * sine[..., None] * toward for e in EPSILON], axis=-2
    )


def steps_to_outlines(
    h: Array,  # (..., 2, 3) both outlines
    radius: Array | float,  # (...) radii [m]
) -> Array:
    """Return the steps (..., 2, 3) from an axis to the lines where outlines touch the cylinder.

    By (5), h . M = epsilon R on the axis, and zero where the cylinder touches the plane of h.
    """
    return np.asarray(-EPSILON[:, None] * np.asarray(radius)[..., None, None] * h)


def axis_of_outlines(
    h1: Array,  # (..., 3)
    h2: Array,  # (..., 3)
    radius: Array | float,  # (...) radii [m]
) -> tuple[Array, Array]:
    """Return the axes of cylinders from their outlines, eqs (4) and (5).

    Returns u (..., 3); M (..., 3) [m].
    """
    n = cross(h1, h2)
    norm = np.linalg.norm(n, axis=-1, keepdims=True)
    if not np.all(norm > 1e-12):
        raise NotVisible(
            "A leg axis could not be computed: its two outlines coincide; two different edges "
            "are needed; reject this leg in the observations."
        )
    u = n / norm
    # In the plane of h1 and h2 the point is R (h1 - h2) / (1 - h1 . h2): symmetric in both.
    cosine = np.sum(h1 * h2, axis=-1, keepdims=True)
    M = np.asarray(radius)[..., None] * (h1 - h2) / (1.0 - cosine)
    return u, M


def direction_of_angles(
    psi: Array,  # (...)
    theta: Array,  # (...)
) -> Array:
    """Return u = (-sin theta cos psi, cos theta cos psi, sin psi), (..., 3)."""
    return np.stack(
        [-np.sin(theta) * np.cos(psi), np.cos(theta) * np.cos(psi), np.sin(psi)], axis=-1
    )


def direction_derivative(psi: Array, theta: Array) -> Array:
    """Return d u / d (psi, theta), (..., 3, 2); arguments as in :func:`direction_of_angles`.

    Both columns are normal to u; the second vanishes along the optical axis.
    """
    by_psi = [np.sin(theta) * np.sin(psi), -np.cos(theta) * np.sin(psi), np.cos(psi)]
    by_theta = [-np.cos(theta) * np.cos(psi), -np.sin(theta) * np.cos(psi), np.zeros_like(psi)]
    return np.stack([np.stack(by_psi, axis=-1), np.stack(by_theta, axis=-1)], axis=-1)
