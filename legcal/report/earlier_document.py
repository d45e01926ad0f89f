"""What is needed of the ``result.json`` that an earlier calibration wrote, as it stands there."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Annotated, Literal

from pydantic import BaseModel, ConfigDict, Field

from legcal.errors import DatasetError
from legcal.files.schema import Number, Version, describe, read_text, validate

Axis = Annotated[list[Number], Field(min_length=3, max_length=3)]


class Row(BaseModel):
    """A row of the parameters."""

    model_config = ConfigDict(frozen=True, allow_inf_nan=False)
    name: str
    value: Number
    nominal: Number
    sigma: Annotated[Number, Field(gt=0.0)] | None
    unit: str
    status: Literal["estimated", "fixed", "weak"]


class Noise(BaseModel):
    """The noise of the outlines."""

    model_config = ConfigDict(frozen=True, allow_inf_nan=False)
    scale: Annotated[Number, Field(gt=0.0)]
    bias_px: Annotated[Number, Field(ge=0.0)]
    tilt_px: Annotated[Number, Field(ge=0.0)]


class KinematicPart(BaseModel):
    """What is known of all kinematic parameters."""

    model_config = ConfigDict(frozen=True, allow_inf_nan=False)
    names: list[str]
    covariance: list[list[Number]]
    held: list[list[Number]]


class Residuals(BaseModel):
    """What was left of the observations."""

    model_config = ConfigDict(frozen=True, allow_inf_nan=False)
    dof: int
    noise: Noise
    shared_px: dict[str, Annotated[Number, Field(ge=0.0)]]


class ResultDocument(BaseModel):
    """What is needed of ``result.json``; there is more in it."""

    model_config = ConfigDict(frozen=True, allow_inf_nan=False)
    legcal_result: Version
    status: Literal["converged"]
    legs: list[str]
    parameters: Annotated[list[Row], Field(min_length=1)]
    nominal_axes: dict[str, dict[str, Axis]]
    covariance: list[list[Number]]
    kinematic: KinematicPart
    cameras: dict[str, dict[str, Number | str]]
    residuals: Residuals


def read_document(path: Path) -> ResultDocument:
    """Return what the document says.

    Raises
    ------
    DatasetError
        If it is missing, or no such document.
    """
    content = read_text(path, "result of an earlier calibration")
    try:
        found = json.loads(content)
    except (ValueError, RecursionError) as error:
        raise DatasetError(refused(path, "no JSON", "the document of a calibration")) from error
    if not isinstance(found, dict) or "legcal_result" not in found:
        what = "another document" if isinstance(found, dict) else describe(found)
        raise DatasetError(refused(path, what, "one with 'legcal_result: 1'"))
    return validate(ResultDocument, found, path)


def refused(path: Path, found: str, needed: str) -> str:
    """Return why a result could not be read."""
    return (
        f"{path}: the result of the earlier calibration could not be read: found {found}, needed "
        f"{needed}; give the folder that legcal calibrate wrote."
    )
