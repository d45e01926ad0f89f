"""The location file: written, checked and read back."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
import yaml
from pydantic import BeforeValidator, Field

from legcal.calibration.location.result import (
    NAMES,
    Location,
    MeasurementNoise,
    OpenPart,
    RowResidual,
)
from legcal.errors import DatasetError
from legcal.files import (
    FileSchema,
    MotionEntry,
    Number,
    OwnYaml,
    Version,
    motion_to_xyz_quat,
    parse_yaml,
    read_text,
    validate,
)

WHAT = "location file"
KEY = "legcal_location"
LOCATION_FILE = OwnYaml("the location", WHAT, KEY, "a new file or an earlier location")
_SYMMETRIC = 1e-9  # relative
_NONE = 1e-12  # below zero: rounding
_Vector = Annotated[
    tuple[Number, Number, Number], BeforeValidator(lambda v: tuple(v) if type(v) is list else v)
]
_Size = Annotated[Number, Field(ge=0.0)]


class _Frame(MotionEntry):
    """A frame with its standard deviations, which the covariance repeats in full."""

    sigma_xyz: _Vector
    sigma_rotation: _Vector | None


class _Held(FileSchema):
    """A part that the machine leaves open."""

    frame: Literal["base", "tool"]
    kind: Literal["position", "orientation"]
    directions: Annotated[list[_Vector], Field(min_length=1, max_length=3)]


class _Determined(FileSchema):
    """What is determined and what was held."""

    everything: bool
    tool_orientation: bool
    held: list[_Held]
    tool_position: _Vector
    words: str


class _Noise(FileSchema):
    """How precise the measured poses are."""

    position: _Size
    angle: _Size | None
    position_stated: bool
    angle_stated: bool
    reading: _Size
    model: bool


class _Row(FileSchema):
    """Residuals of a row."""

    row: Annotated[int, Field(ge=1)]
    position: _Vector
    rotation: _Vector | None
    left_out: str


class _Residuals(FileSchema):
    """What is left of the measured poses."""

    chi2: _Size
    dof: Annotated[int, Field(ge=0)]
    p_value: _Size | None
    rms_position: _Size
    rms_angle: _Size | None
    rows: Annotated[list[_Row], Field(min_length=1)]


class _Tool(FileSchema):
    """How well the frames put the tool in the world."""

    position: _Size
    angle: _Size | None


class _Covariance(FileSchema):
    """The covariance of both frames."""

    names: list[str]
    matrix: list[list[Number]]


class _Document(FileSchema):
    """The file."""

    legcal_location: Version
    status: Literal["located", "located in part", "doubtful"]
    verdict: str
    model: str
    poses: str
    T_world_base: _Frame
    T_platform_tool: _Frame
    determined: _Determined
    noise: _Noise
    tool_in_world_sigma: _Tool
    residuals: _Residuals
    covariance: _Covariance
    notes: list[str]


def location_document(location: Location) -> dict[str, Any]:
    """Return a location as its file has it."""
    sigma = [[float(s) for s in part] for part in location.sigma.reshape(4, 3)]
    base, tool = (
        dict[str, Any](motion_to_xyz_quat(T))
        | {"sigma_xyz": sigma[i], "sigma_rotation": sigma[i + 1]}
        for i, T in ((0, location.T_world_base), (2, location.T_platform_tool))
    )
    if not location.has_tool_orientation:
        tool["sigma_rotation"] = None
    return {
        KEY: 1,
        "status": location.status,
        "verdict": location.sentence,
        "model": location.model,
        "poses": location.poses,
        "T_world_base": base,
        "T_platform_tool": tool,
        "determined": {
            "everything": not location.held,
            "tool_orientation": location.has_tool_orientation,
            "held": [
                {"frame": h.frame, "kind": h.kind, "directions": [list(v) for v in h.directions]}
                for h in location.held
            ],
            "tool_position": list(location.held_at),
            "words": location.held_words,
        },
        "noise": vars(location.noise).copy(),
        "tool_in_world_sigma": {
            "position": location.tool_position_sigma,
            "angle": location.tool_angle_sigma,
        },
        "residuals": {
            "chi2": location.chi2,
            "dof": location.dof,
            "p_value": location.p_value,
            "rms_position": location.rms_position,
            "rms_angle": location.rms_angle,
            "rows": [
                {
                    "row": row.row,
                    "position": list(row.position),
                    "rotation": None if row.rotation is None else list(row.rotation),
                    "left_out": row.reason,
                }
                for row in location.rows
            ],
        },
        "covariance": {"names": list(NAMES), "matrix": location.covariance.tolist()},
        "notes": list(location.notes),
    }


def write_location(location: Location, file: str | Path) -> None:
    """Write a location; an earlier one is replaced, any other file is not.

    Parameters
    ----------
    location : Location
        What was located.
    file : str or Path
        The YAML.

    Raises
    ------
    UsageError
        If another file stands there, or none can be written.
    OutOfResources
        If the file cannot be written.
    """
    text = yaml.safe_dump(
        location_document(location),
        sort_keys=False,
        default_flow_style=None,
        allow_unicode=True,
        width=120,
    )
    LOCATION_FILE.write(Path(file), text)


def load_location(file: str | Path) -> Location:
    """Return the location in a file that ``legcal locate`` wrote.

    Parameters
    ----------
    file : str or Path
        The YAML.

    Raises
    ------
    DatasetError
        If it is missing or damaged.
    """
    path = Path(file)
    found = parse_yaml(read_text(path, WHAT), path, WHAT)
    if KEY not in found:
        raise DatasetError(
            f"{path}: the {WHAT} could not be read: found no key '{KEY}', needed a file that "
            "legcal locate wrote; give that file."
        )
    document = validate(_Document, found, path)
    determined, residuals = document.determined, document.residuals
    return Location(
        model=document.model,
        poses=document.poses,
        T_world_base=document.T_world_base.motion(),
        T_platform_tool=document.T_platform_tool.motion(),
        has_tool_orientation=determined.tool_orientation,
        covariance=_matrix(path, document.covariance),
        held=tuple(OpenPart(h.frame, h.kind, tuple(h.directions)) for h in determined.held),
        held_at=determined.tool_position,
        held_words=determined.words,
        noise=MeasurementNoise(**document.noise.model_dump()),
        rows=tuple(RowResidual(r.row, r.position, r.rotation, r.left_out) for r in residuals.rows),
        chi2=residuals.chi2,
        dof=residuals.dof,
        p_value=residuals.p_value,
        tool_position_sigma=document.tool_in_world_sigma.position,
        tool_angle_sigma=document.tool_in_world_sigma.angle,
        status=document.status,
        sentence=document.verdict,
        notes=tuple(document.notes),
    )


def _matrix(path: Path, found: _Covariance) -> np.ndarray[Any, np.dtype[np.float64]]:
    """Return the covariance, refused where it is none."""
    n = len(NAMES)
    is_square = len(found.matrix) == n and all(len(row) == n for row in found.matrix)
    if tuple(found.names) == NAMES and is_square:
        matrix = np.array(found.matrix)
        largest = float(np.abs(matrix).max())
        symmetric = np.abs(matrix - matrix.T).max() <= _SYMMETRIC * largest
        if symmetric and float(np.linalg.eigvalsh(matrix)[0]) >= -_NONE * largest:
            return matrix
    raise DatasetError(
        f"{path}: covariance could not be read: found another matrix, needed a covariance of the "
        f"{n} components {NAMES[0]} to {NAMES[-1]}; give the file that legcal locate wrote."
    )
