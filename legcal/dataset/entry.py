"""The schema of ``dataset.yaml``."""

import math
from typing import Annotated, Literal

from pydantic import Field, field_validator
from scipy.spatial.transform import RigidTransform

from legcal.files.schema import FileSchema, Metres, Name, Number
from legcal.geometry.frames import motion_from_xyz_quat

QUATERNION_TOLERANCE = 1e-3  # files round to a few digits; more is a mistake
ENCODER_SIGMAS = (1e-12, 1.0)  # [m]; no encoder is better, none worse

Vector = tuple[Metres, Metres, Metres]
Quaternion = tuple[Number, Number, Number, Number]


class MotionEntry(FileSchema):
    """A rigid motion: ``{xyz: [m], quat_xyzw: [-]}``."""

    xyz: Vector
    quat_xyzw: Quaternion

    @field_validator("quat_xyzw")
    @classmethod
    def _has_unit_norm(cls, quat: Quaternion) -> Quaternion:
        norm = math.hypot(*quat)
        if abs(norm - 1.0) > QUATERNION_TOLERANCE:
            raise ValueError(
                f"found a quaternion of norm {norm:.6g}, needed 1 within {QUATERNION_TOLERANCE:g}; "
                "check its four numbers, x y z w."
            )
        x, y, z, w = (c / norm for c in quat)
        return x, y, z, w

    def motion(self) -> RigidTransform:
        """Return the motion, its quaternion made exactly unit."""
        return motion_from_xyz_quat(self.xyz, self.quat_xyzw)


class ViewEntry(FileSchema):
    """One camera position."""

    camera: str
    T_base_camera: MotionEntry | None = None
    legs: Annotated[list[str], Field(min_length=1)] | None = None

    @field_validator("legs")
    @classmethod
    def _names_each_leg_once(cls, legs: list[str] | None) -> list[str] | None:
        twice = sorted({name for name in legs or () if (legs or []).count(name) > 1})
        if twice:
            raise ValueError(f"found {', '.join(twice)} twice, needed each leg once; remove one.")
        return legs


class DatasetEntry(FileSchema):
    """The whole of ``dataset.yaml``."""

    legcal_dataset: Literal[1]
    mechanism: str
    measurements: str
    encoder_sigma: Annotated[Number, Field(gt=0.0)]
    views: Annotated[dict[Name, ViewEntry], Field(min_length=1)]

    @field_validator("encoder_sigma")
    @classmethod
    def _is_that_of_an_encoder(cls, sigma: float) -> float:
        least, most = ENCODER_SIGMAS
        if not least <= sigma <= most:
            raise ValueError(
                f"found {sigma:g} m, needed {least:g} to {most:g} m; give one standard deviation "
                "of a reading in metres."
            )
        return sigma
