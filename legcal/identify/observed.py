"""What the images of a session say: where each leg's axis lies, seen from its camera.

An outline pair shows the axis across the leg in the image very exactly (n_lat, by a part of a
pixel) and towards the camera poorly (n_dep, by distance / radius more).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from legcal.geometry.types import Array
from legcal.identify.session import SIGMA_PX, Session

_ALONG = 1e-6  # a leg that points at the camera shows no lateral direction: least |u x ray|


@dataclass(frozen=True, eq=False)
class Across:
    """Two directions across each leg at a point of its axis, over their standard deviations.

    Attributes
    ----------
    gradient : (n_images, n_legs, 2, 3) array
        n_lat and n_dep in R_b by their sigma [1/m]; zero where the leg is not seen.
    point : (n_images, n_legs, 3) array
        The points in R_b [m].
    """

    gradient: Array
    point: Array

    def by_camera(self) -> Array:
        """Return the derivative (n_images, n_legs, 2, 6) by the camera's turn and displacement."""
        turn = -np.cross(self.point[:, :, None], self.gradient)
        return np.concatenate([turn, -self.gradient], axis=3)


def at_base_joints(session: Session) -> Across:
    """Return what is seen at the base joint centres."""
    images = len(session.view)
    return _across(session, np.broadcast_to(session.A, (images, *session.A.shape)))


def at_platform_joints(session: Session) -> Across:
    """Return what is seen at the platform joint centres."""
    return _across(session, (session.arm + session.t[:, None])[session.pose])


def _across(session: Session, point: Array) -> Across:
    """Return the directions across legs at points (n_images, n_legs, 3)."""
    u = session.u[session.pose]
    ray = point - session.camera[session.view][:, None]
    distance = np.linalg.norm(ray, axis=2)
    lateral = np.cross(u, ray / distance[..., None])
    lateral /= np.maximum(np.linalg.norm(lateral, axis=2), _ALONG)[..., None]
    depth = np.cross(u, lateral)
    sigma_lateral = SIGMA_PX * distance / session.focal[session.view][:, None]
    sigma_depth = sigma_lateral * distance / session.radius
    gradient = np.stack(
        [lateral / sigma_lateral[..., None], depth / sigma_depth[..., None]], axis=2
    )
    gradient[~session.seen[session.view]] = 0.0
    return Across(gradient, point)
