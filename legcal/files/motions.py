"""Rigid motions in files: ``{xyz: [m], quat_xyzw: [-]}``."""

import math
from collections.abc import Sequence
from typing import Annotated

import numpy as np
from pydantic import AfterValidator, Field
from scipy.spatial.transform import RigidTransform, Rotation

from legcal.files.schema import Document, FileSchema, Metres, Number, Triple
from legcal.geometry.motions import motion_of

QUATERNION_TOLERANCE = 1e-3  # rounding of quaternions in files; a larger error is a mistake

Vector = tuple[Metres, Metres, Metres]


def _of_unit_norm(quat: tuple[float, ...]) -> tuple[float, ...]:
    """Return a quaternion made exactly unit; refuse it if more than its last digits are wrong."""
    norm = math.hypot(*quat)
    if abs(norm - 1.0) > QUATERNION_TOLERANCE:
        raise ValueError(
            f"found a quaternion of norm {norm:.6g}, needed 1 within {QUATERNION_TOLERANCE:g}; "
            "check its four numbers, x y z w."
        )
    return tuple(c / norm for c in quat)


Quaternion = Annotated[tuple[Number, Number, Number, Number], AfterValidator(_of_unit_norm)]


class MotionEntry(FileSchema):
    """A rigid motion: ``{xyz: [m], quat_xyzw: [-]}``."""

    xyz: Vector
    quat_xyzw: Quaternion

    def motion(self) -> RigidTransform:
        """Return the motion."""
        return motion_from_xyz_quat(self.xyz, self.quat_xyzw)


class Pose(Document):
    """A rigid motion."""

    xyz: Triple
    quat_xyzw: Annotated[list[Number], Field(min_length=4, max_length=4)]

    @classmethod
    def of(cls, T: RigidTransform) -> "Pose":
        """Return a motion in the form of documents."""
        return cls(**motion_to_xyz_quat(T))

    def motion(self) -> RigidTransform:
        """Return the motion; ValueError if its quaternion is not of unit norm."""
        return MotionEntry(**self.model_dump()).motion()


def motion_from_xyz_quat(xyz: Sequence[float], quat_xyzw: Sequence[float]) -> RigidTransform:
    """Return the rigid motion written as ``{xyz: [m], quat_xyzw: [-]}`` in the files."""
    return motion_of(Rotation.from_quat(quat_xyzw).as_matrix(), np.asarray(xyz))


def motion_to_xyz_quat(T: RigidTransform) -> dict[str, list[float]]:
    """Return a rigid motion as the files write it, with the scalar part not negative."""
    return {
        "xyz": [float(x) for x in T.translation],
        "quat_xyzw": [float(x) for x in T.rotation.as_quat(canonical=True)],
    }
