"""Why the axes of a leg in one view say nothing of its base joint, in words."""

from __future__ import annotations

import numpy as np

from legcal.geometry.types import Array

_SAME_DIRECTION = 1e-9  # of the normalised information: directions that differ by less are one
_LARGEST_SIGMA = 0.1  # of the distance to the camera
_LARGEST_TURN = 1.0  # [rad] of an axis; beyond, nothing is known of it


def too_few_directions(information: Array, n_images: int) -> str:
    """Return why (6) has no single solution, or an empty string."""
    smallest = float(np.linalg.eigvalsh(information)[0])
    if smallest > _SAME_DIRECTION * n_images:
        return ""
    if n_images == 1:
        return "it was found in one image, and at least two different directions are needed"
    return f"its direction is the same in all {n_images} images, and two are needed"


def too_uncertain(A: Array, covariance: Array) -> str:
    """Return why a centre says nothing, or an empty string."""
    sigma = float(np.sqrt(np.linalg.eigvalsh(covariance)[-1]))
    distance = float(np.linalg.norm(A))
    if sigma <= _LARGEST_SIGMA * distance:
        return ""
    return (
        f"its directions differ too little to say where they meet (sigma {1e3 * sigma:.0f} mm "
        f"at {1e3 * distance:.0f} mm from the camera)"
    )


def too_tilted(covariance: Array) -> str:
    """Return why an axis says nothing, or an empty string."""
    sigma = float(np.sqrt(np.linalg.eigvalsh(covariance)[-1]))
    if sigma <= _LARGEST_TURN:
        return ""
    return (
        "its leg's directions differ too little to say what they are normal to "
        f"(sigma {np.degrees(sigma):.0f} deg)"
    )
