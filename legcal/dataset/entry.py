"""The schema of ``dataset.yaml``."""

from typing import Annotated

from pydantic import Field, field_validator

from legcal.files.motion import MotionEntry
from legcal.files.schema import FileSchema, Name, Number, Version

ENCODER_SIGMAS = (1e-12, 1.0)  # [m]; no encoder is better, none worse


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

    legcal_dataset: Version
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
