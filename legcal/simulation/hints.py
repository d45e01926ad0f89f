"""What a person would note about the cameras of a simulated dataset: roughly where they stand."""

import numpy as np
from scipy.spatial.transform import RigidTransform, Rotation

from legcal.geometry.types import Array

_SHIFT = 0.015  # [m] at most; a dataset may be off by 2 cm and 2 degrees
_TURN = float(np.deg2rad(1.5))


def rough_pose(T_base_camera: RigidTransform, rng: np.random.Generator) -> RigidTransform:
    """Return a camera pose that is up to 15 mm and 1.5 degrees off."""
    shift = _SHIFT * rng.random() * _any_direction(rng)
    turn = Rotation.from_rotvec(_TURN * rng.random() * _any_direction(rng))
    return RigidTransform.from_components(
        T_base_camera.translation + shift, turn * T_base_camera.rotation
    )


def _any_direction(rng: np.random.Generator) -> Array:
    """Return a unit vector (3,) that points anywhere."""
    v = rng.normal(size=3)
    return np.asarray(v / np.linalg.norm(v))
