"""A location, its undetermined parts in words, and the location file: written and read back."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
import yaml
from pydantic import BeforeValidator, Field
from scipy.spatial.transform import RigidTransform

from legcal.brief import brief
from legcal.errors import DatasetError
from legcal.files.folder import OutputFile
from legcal.files.motions import MotionEntry, motion_to_xyz_quat
from legcal.files.published import with_schema
from legcal.files.schema import FileSchema, Number, Version, read_yaml, validate
from legcal.geometry.types import Array

LocatedFrame = Literal["base", "tool"]
PoseComponent = Literal["position", "orientation"]
Direction = tuple[float, float, float]
LocationStatus = Literal["located", "located in part", "doubtful"]
NAMES = tuple(
    f"{frame}.{component}"
    for frame in ("T_world_base", "T_platform_tool")
    for component in ("x", "y", "z", "rx", "ry", "rz")
)
_WHAT = "location file"
_KEY = "legcal_location"
LOCATION_FILE = OutputFile("the location", _WHAT, _KEY, "a new file or an earlier location")
_SYMMETRY_TOLERANCE = 1e-9  # relative
_NEGATIVE_TOLERANCE = 1e-12  # of eigenvalues below zero, relative
_Vector = Annotated[
    tuple[Number, Number, Number], BeforeValidator(lambda v: tuple(v) if type(v) is list else v)
]
_Size = Annotated[Number, Field(ge=0.0)]


@brief
@dataclass(frozen=True, eq=False)
class Location:
    """The result of :func:`legcal.locate`.

    Attributes
    ----------
    model, poses : str
        The files it comes from.
    T_world_base : RigidTransform
        The base link in the world [m].
    T_platform_tool : RigidTransform
        The tool in the platform link [m]; its rotation is the identity where the orientation of
        the tool was not measured.
    has_tool_orientation : bool
        Whether the orientation of the tool in the platform is known.
    covariance : (12, 12) array
        Covariance of ``NAMES``: displacements [m] and rotation vectors [rad] of the base about
        world axes and of the tool about platform axes, T_true = (exp r, t + x) applied from the
        left. What is held, and an orientation that is not known, counts as zero.
    held : tuple of OpenPart
        The directions that no pose of this machine determines.
    held_at : tuple of float
        Position of the tool in the platform, used where it is not determined [m].
    held_words : str
        The same for people; "" where everything is determined.
    noise : MeasurementNoise
        Standard deviations of the measurement.
    rows : tuple of RowResidual
        In the order of the file.
    chi2, dof, p_value : float, int, float or None
        Sum of squared residuals in standard deviations, degrees of freedom, and the probability of
        a larger sum; None where all standard deviations come from the residuals.
    tool_position_sigma, tool_angle_sigma : float, float or None
        How well both frames together put the tool in the world at the measured poses: one standard
        deviation of the vector, rms over the poses [m], [rad].
    status : {"located", "located in part", "doubtful"}
        The verdict in a word.
    sentence : str
        The verdict.
    notes : tuple of str
        What else a reader should know.
    """

    model: str
    poses: str
    T_world_base: RigidTransform
    T_platform_tool: RigidTransform
    has_tool_orientation: bool
    covariance: Array
    held: tuple[OpenPart, ...]
    held_at: tuple[float, float, float]
    held_words: str
    noise: MeasurementNoise
    rows: tuple[RowResidual, ...]
    chi2: float
    dof: int
    p_value: float | None
    tool_position_sigma: float
    tool_angle_sigma: float | None
    status: LocationStatus
    sentence: str
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
        """The same of orientations [rad]; None where none was measured."""
        turns = [row.rotation for row in self.rows if row.used and row.rotation is not None]
        return _rms(turns) if turns else None


@dataclass(frozen=True)
class RowResidual:
    """A row of the measured poses, and how far it is from the located frames."""

    row: int  # its number in the file, from 1
    # measured minus predicted position of the tool, in the world [m]
    position: tuple[float, float, float]
    # the same of its orientation as a rotation vector about world axes [rad]; None where it was not
    # measured
    rotation: tuple[float, float, float] | None
    reason: str = ""  # why it was left out; "" if it was used

    @property
    def used(self) -> bool:
        """Whether the frames rest on it."""
        return not self.reason


@dataclass(frozen=True)
class MeasurementNoise:
    """How precise the measured poses are."""

    # position, angle: standard deviation of a component [m], [rad], rms over the rows; None of
    # orientations that were not measured
    position: float
    angle: float | None
    # position_stated, angle_stated: whether it was stated or comes from the residuals
    position_stated: bool
    angle_stated: bool
    reading: float  # standard deviation of a reading that was stated [m or rad]; zero if none was
    model: bool  # whether the covariance of a calibrated model was counted in


@dataclass(frozen=True)
class OpenPart:
    """A part of the frames that poses do not determine, or hardly."""

    frame: LocatedFrame  # {"base", "tool"}: whose
    kind: PoseComponent  # {"position", "orientation"}: of what
    # unit vectors: of the base in the base link, of the tool in the platform link
    directions: tuple[Direction, ...]

    @property
    def words(self) -> str:
        """What is open, for people."""
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


def open_parts_in_words(parts: list[OpenPart]) -> str:
    """Return parts in one phrase, the tool's first."""
    words = [part.words for part in sorted(parts, key=lambda part: part.frame != "tool")]
    return words[0] if len(words) == 1 else f"{', '.join(words[:-1])} and {words[-1]}"


def direction_words(v: Array | tuple[float, ...]) -> str:
    """Return a direction with two digits."""
    v = _signed(np.asarray(v) / np.linalg.norm(v))
    return "(" + ", ".join(f"{x:.3g}" for x in np.round(v, 2) + 0.0) + ")"


def direction_of(v: Array) -> Direction:
    """Return a unit vector (3,) with its largest component positive, as numbers."""
    x, y, z = _signed(v).tolist()
    return x, y, z


def _signed(v: Array) -> Array:
    """Return a direction with its largest component positive."""
    return np.asarray(v if v[np.argmax(np.abs(v))] > 0.0 else -v)


def _rms(vectors: list[tuple[float, float, float]]) -> float:
    """Return the root mean square of components."""
    return float(np.sqrt(np.mean(np.square(vectors))))


class _FrameEntry(MotionEntry):
    """A frame with its standard deviations, which the covariance repeats in full."""

    sigma_xyz: _Vector
    sigma_rotation: _Vector | None


class _OpenPartEntry(FileSchema):
    """A part that the machine leaves open."""

    frame: Literal["base", "tool"]
    kind: Literal["position", "orientation"]
    directions: Annotated[list[_Vector], Field(min_length=1, max_length=3)]


class _Determined(FileSchema):
    """The determined frames, and the directions held at their given values."""

    everything: bool
    tool_orientation: bool
    held: list[_OpenPartEntry]
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


class _RowEntry(FileSchema):
    """Residuals of a row."""

    row: Annotated[int, Field(ge=1)]
    position: _Vector
    rotation: _Vector | None
    left_out: str


class _ResidualsEntry(FileSchema):
    """Residuals of the measured poses."""

    chi2: _Size
    dof: Annotated[int, Field(ge=0)]
    p_value: _Size | None
    rms_position: _Size
    rms_angle: _Size | None
    rows: Annotated[list[_RowEntry], Field(min_length=1)]


class _Tool(FileSchema):
    """How well the frames put the tool in the world."""

    position: _Size
    angle: _Size | None


class _Covariance(FileSchema):
    """The covariance of both frames."""

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
    noise: _Noise
    tool_in_world_sigma: _Tool
    residuals: _ResidualsEntry
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
    LOCATION_FILE.write(Path(file), with_schema("location", text))


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
    found = read_yaml(path, _WHAT)
    if _KEY not in found:
        raise DatasetError(
            f"{path}: the {_WHAT} could not be read: found no key '{_KEY}', needed a file that "
            "legcal locate wrote; give that file."
        )
    document = validate(LocationFile, found, path)
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


def _matrix(path: Path, found: _Covariance) -> Array:
    """Return the covariance; refuse a matrix that is not one."""
    n = len(NAMES)
    is_square = len(found.matrix) == n and all(len(row) == n for row in found.matrix)
    if tuple(found.names) == NAMES and is_square:
        matrix = np.array(found.matrix)
        largest = float(np.abs(matrix).max())
        symmetric = np.abs(matrix - matrix.T).max() <= _SYMMETRY_TOLERANCE * largest
        if symmetric and float(np.linalg.eigvalsh(matrix)[0]) >= -_NEGATIVE_TOLERANCE * largest:
            return matrix
    raise DatasetError(
        f"{path}: covariance could not be read: found another matrix, needed a covariance of the "
        f"{n} components {NAMES[0]} to {NAMES[-1]}; give the file that legcal locate wrote."
    )
