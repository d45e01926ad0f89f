"""What locating takes and gives: measured tool poses, a :class:`Location`, open parts in words."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from scipy.spatial.transform import RigidTransform

from legcal.geometry import Array, BoolArray, IntArray

Frame = Literal["base", "tool"]
Kind = Literal["position", "orientation"]
Direction = tuple[float, float, float]
Status = Literal["located", "located in part", "doubtful"]
NAMES = tuple(
    f"{frame}.{component}"
    for frame in ("T_world_base", "T_platform_tool")
    for component in ("x", "y", "z", "rx", "ry", "rz")
)


@dataclass(frozen=True, eq=False)
class ToolPoses:
    """What a laser tracker, a CMM or a camera measured, one row a pose."""

    q: Array  # (n, n_legs): readings in the order of the legs [m]; NaN for legs without a motor
    position: Array  # (n, 3): of the tool in the world [m]
    rotation: Array  # (n, 3, 3): T_world_tool; the identity where only the position was measured
    oriented: BoolArray  # (n,): where the orientation was measured too
    # position_sigma, angle_sigma: (n,): standard deviation of each component [m], [rad]; None if
    # not stated
    position_sigma: Array | None
    angle_sigma: Array | None
    numbers: IntArray  # (n,): of the rows in the file, from 1
    notes: tuple[str, ...] = ()  # what is odd but allowed

    def __len__(self) -> int:
        return len(self.position)


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
        Of ``NAMES``: displacements [m] and rotation vectors [rad] of the base about world axes and
        of the tool about platform axes, T_true = (exp r, t + x) applied from the left. What is
        held, and an orientation that is not known, counts as zero.
    held : tuple of OpenPart
        What the machine leaves open.
    held_at : tuple of float
        The tool position in the platform whose components are taken where it is open [m].
    held_words : str
        The same for people; "" where everything is determined.
    noise : MeasurementNoise
        Of the measurement.
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
    status: Status
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
    reading: float  # standard deviation of a reading that was stated [m]; zero if none was
    model: bool  # whether the covariance of a calibrated model was counted in


@dataclass(frozen=True)
class OpenPart:
    """A part of the frames that poses do not tell, or hardly."""

    frame: Frame  # {"base", "tool"}: whose
    kind: Kind  # {"position", "orientation"}: of what
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


def joined(parts: list[OpenPart]) -> str:
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
