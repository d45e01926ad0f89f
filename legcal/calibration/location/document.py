"""A location, its undetermined parts in words, and the location file."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
import yaml
from pydantic import BeforeValidator, Field
from scipy.spatial.transform import RigidTransform

from legcal.brief import brief
from legcal.files.folder import OutputFile, with_schema
from legcal.files.motions import MotionEntry, motion_to_xyz_quat
from legcal.files.schema import FileSchema, Number, Version
from legcal.geometry.types import Array

LocatedFrame = Literal["base", "tool"]
PoseComponent = Literal["position", "orientation"]
LocationStatus = Literal["located", "located in part", "doubtful"]
NAMES = tuple(
    f"{frame}.{component}"
    for frame in ("T_world_base", "T_platform_tool")
    for component in ("x", "y", "z", "rx", "ry", "rz")
)
_WHAT = "location file"
_KEY = "legcal_location"
LOCATION_FILE = OutputFile("the location", _WHAT, _KEY, "a new file or an earlier location")
_Vector = Annotated[
    tuple[Number, Number, Number], BeforeValidator(lambda v: tuple(v) if type(v) is list else v)
]
_Size = Annotated[Number, Field(ge=0.0)]


class RowResidual(FileSchema):
    """Residuals of a row of the measured poses."""

    row: Annotated[int, Field(ge=1)]  # number of the row in the file, from 1
    position: _Vector  # measured minus predicted position of the tool, in the world [m]
    # residual of the orientation as a rotation vector about world axes [rad]; None if the
    # orientation was not measured
    rotation: _Vector | None
    left_out: str  # reason for leaving the row out; "" if it was used

    @property
    def used(self) -> bool:
        """Whether the row was used in the fit."""
        return not self.left_out


class MeasurementNoise(FileSchema):
    """Standard deviations of the measured poses."""

    position: _Size  # standard deviation of a component, rms over the rows [m]
    angle: _Size | None  # the same [rad]; None if no orientations were measured
    # position_stated, angle_stated: whether the standard deviation was stated, rather than
    # estimated from the residuals
    position_stated: bool
    angle_stated: bool
    model: bool  # whether the covariance of a calibrated model is included


class OpenPart(FileSchema):
    """An undetermined part of the frames."""

    frame: LocatedFrame
    kind: PoseComponent
    # unit vectors in the base link or in the platform link
    directions: Annotated[list[_Vector], Field(min_length=1, max_length=3)]

    @property
    def words(self) -> str:
        """Description of the part in words."""
        whose = "the base in the world" if self.frame == "base" else "the tool in the platform"
        link = "the base" if self.frame == "base" else "the platform"
        start = f"the {self.kind} of {whose}"
        if len(self.directions) == 3:
            return start
        if len(self.directions) == 2:
            normal = np.cross(*np.array(self.directions))
            return f"{start} across {direction_words(normal)} of {link}"
        link = "its own axes" if self.frame == "base" else link
        how = "along" if self.kind == "position" else "about"
        return f"{start} {how} {direction_words(self.directions[0])} of {link}"


@brief
@dataclass(frozen=True, eq=False)
class Location:
    """The result of :func:`legcal.locate`."""

    model: str  # model, poses: the files it comes from
    poses: str
    T_world_base: RigidTransform  # the base link in the world [m]
    # the tool in the platform link [m]; its rotation is the identity where the orientation of the
    # tool was not measured
    T_platform_tool: RigidTransform
    has_tool_orientation: bool  # whether the orientation of the tool in the platform is known
    # (12, 12): covariance of ``NAMES``: displacements [m] and rotation vectors [rad] of the base
    # about world axes and of the tool about platform axes, T_true = (exp r, t + x) applied from the
    # left. Zero along held directions and for an orientation that was not measured
    covariance: Array
    held: tuple[OpenPart, ...]  # the directions that no pose of this machine determines
    # position of the tool in the platform, used where it is not determined [m]
    held_at: tuple[float, float, float]
    held_words: str  # description of the held directions; "" if everything is determined
    noise: MeasurementNoise  # standard deviations of the measurement
    rows: tuple[RowResidual, ...]  # in the order of the file
    # chi2, dof, p_value: sum of squared residuals in standard deviations, degrees of freedom, and
    # the probability of a larger sum; None if all standard deviations come from the residuals
    chi2: float
    dof: int
    p_value: float | None
    # tool_position_sigma, tool_angle_sigma: standard deviation of the tool pose in the world from
    # both frames at the measured poses, of the vector, rms over the poses [m], [rad]
    tool_position_sigma: float
    tool_angle_sigma: float | None
    status: LocationStatus  # the verdict in a word
    sentence: str  # the verdict
    notes: tuple[str, ...]

    @property
    def sigma(self) -> Array:
        """Standard deviation of each of ``NAMES``, (12,) [m, rad]."""
        return np.asarray(np.sqrt(np.maximum(np.diagonal(self.covariance), 0.0)))

    @property
    def trustworthy(self) -> bool:
        """Whether the poses are explained as well as they claim to be measured."""
        return self.status != "doubtful"

    @property
    def rms_position(self) -> float:
        """Root mean square of the position residuals of the rows used, a component [m]."""
        return _rms([row.position for row in self.rows if row.used])

    @property
    def rms_angle(self) -> float | None:
        """Root mean square of the rotation residuals of the rows used [rad]; None without any."""
        turns = [row.rotation for row in self.rows if row.used and row.rotation is not None]
        return _rms(turns) if turns else None


def open_parts_in_words(parts: list[OpenPart]) -> str:
    """Return one phrase for all parts, the tool's first."""
    words = [part.words for part in sorted(parts, key=lambda part: part.frame != "tool")]
    return words[0] if len(words) == 1 else f"{', '.join(words[:-1])} and {words[-1]}"


def direction_words(v: Array | tuple[float, ...]) -> str:
    """Return a direction as text with two digits."""
    v = signed(np.asarray(v) / np.linalg.norm(v))
    return "(" + ", ".join(f"{x:.3g}" for x in np.round(v, 2) + 0.0) + ")"


def signed(v: Array) -> Array:
    """Return a vector (3,) or its opposite, with its largest component positive."""
    return np.asarray(v if v[np.argmax(np.abs(v))] > 0.0 else -v)


def _rms(vectors: list[tuple[float, float, float]]) -> float:
    return float(np.sqrt(np.mean(np.square(vectors))))


class _FrameEntry(MotionEntry):
    """A frame with its standard deviations, which the covariance repeats in full."""

    sigma_xyz: _Vector
    sigma_rotation: _Vector | None


class _Determined(FileSchema):
    """The determined frames, and the directions held at their given values."""

    everything: bool
    tool_orientation: bool
    held: list[OpenPart]
    tool_position: _Vector
    words: str


class _ResidualsEntry(FileSchema):
    chi2: _Size
    dof: Annotated[int, Field(ge=0)]
    p_value: _Size | None
    rms_position: _Size
    rms_angle: _Size | None
    rows: Annotated[list[RowResidual], Field(min_length=1)]


class _Tool(FileSchema):
    """Standard deviations of the tool pose in the world from both frames."""

    position: _Size
    angle: _Size | None


class _Covariance(FileSchema):
    names: list[str]
    matrix: list[list[Number]]


class LocationFile(FileSchema):
    """The file."""

    legcal_location: Version
    status: Literal["located", "located in part", "doubtful"]
    verdict: str
    model: str
    poses: str
    T_world_base: _FrameEntry
    T_platform_tool: _FrameEntry
    determined: _Determined
    noise: MeasurementNoise
    tool_in_world_sigma: _Tool
    residuals: _ResidualsEntry
    covariance: _Covariance
    notes: list[str]


def location_document(location: Location) -> dict[str, Any]:
    """Return the content of a location file."""
    sigma = [[float(s) for s in part] for part in location.sigma.reshape(4, 3)]
    base, tool = (
        dict[str, Any](motion_to_xyz_quat(T))
        | {"sigma_xyz": sigma[i], "sigma_rotation": sigma[i + 1]}
        for i, T in ((0, location.T_world_base), (2, location.T_platform_tool))
    )
    if not location.has_tool_orientation:
        tool["sigma_rotation"] = None
    return {
        _KEY: 1,
        "status": location.status,
        "verdict": location.sentence,
        "model": location.model,
        "poses": location.poses,
        "T_world_base": base,
        "T_platform_tool": tool,
        "determined": {
            "everything": not location.held,
            "tool_orientation": location.has_tool_orientation,
            "held": [part.model_dump(mode="json") for part in location.held],
            "tool_position": list(location.held_at),
            "words": location.held_words,
        },
        "noise": location.noise.model_dump(mode="json"),
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
            "rows": [row.model_dump(mode="json") for row in location.rows],
        },
        "covariance": {"names": list(NAMES), "matrix": location.covariance.tolist()},
        "notes": list(location.notes),
    }


def write_location(location: Location, file: str | Path) -> None:
    """Write a location; an earlier one is replaced, any other file is not.

    Parameters
    ----------
    location : Location
        The location.
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
    LOCATION_FILE.write(Path(file), with_schema("location", text))
