"""Poses at which a flat machine looks alike from far: near and far exchanged."""

import numpy as np

from legcal.geometry.types import Array


def exchanged(R: Array, t: Array, X: Array) -> tuple[Array, Array]:
    """Return the poses that show points of a flat machine alike from far.

    The machine is reflected in its own plane, which leaves a flat one as it is, and in the plane
    through its middle that faces the camera.

    Parameters
    ----------
    R, t : (n, 3, 3) and (n, 3) array
        T_camera_base of some poses: rotations and translations [m].
    X : (m, 3) array
        Points of the machine, one at least, in the base link [m].

    Returns
    -------
    R, t : (n, 3, 3) and (n, 3) array
    """
    middle = X.mean(axis=0)
    normal = np.linalg.svd(X - middle, full_matrices=False)[2][2]
    at = R @ middle + t
    facing = at / np.linalg.norm(at, axis=1, keepdims=True)
    in_plane = np.eye(3) - 2.0 * np.outer(normal, normal)
    in_depth = np.eye(3) - 2.0 * facing[:, :, None] * facing[:, None, :]
    turned = in_depth @ R @ in_plane
    return turned, at - turned @ middle
