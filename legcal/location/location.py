"""Where the base stands in the world and the tool in the platform, and how well that is known."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from scipy.spatial.transform import RigidTransform

from legcal.geometry.types import Array
from legcal.location.open_part import OpenPart

Status = Literal["located", "located in part", "doubtful"]

NAMES = tuple(
    f"{frame}.{component}"
    for frame in ("T_world_base", "T_platform_tool")
    for component in ("x", "y", "z", "rx", "ry", "rz")
)


@dataclass(frozen=True)
class RowResidual:
    """A row of the measured poses, and how far it is from the located frames.

    Attributes
    ----------
    row : int
        Its number in the file, from 1.
    position : tuple of float
        Measured minus predicted position of the tool, in the world [m].
    rotation : tuple of float or None
        The same of its orientation as a rotation vector about world axes [rad]; None where it was
        not measured.
    reason : str
        Why it was left out; "" if it was used.
    """

    row: int
    position: tuple[float, float, float]
    rotation: tuple[float, float, float] | None
    reason: str = ""

    @property
    def used(self) -> bool:
        """Whether the frames rest on it."""
        return not self.reason


@dataclass(frozen=True)
class MeasurementNoise:
    """How precise the measured poses are.

    Attributes
    ----------
    position, angle : float or None
        Standard deviation of a component [m], [rad], rms over the rows; None of orientations that
        were not measured.
    position_stated, angle_stated : bool
        Whether it was stated or comes from the residuals.
    reading : float
        Standard deviation of a reading that was stated [m]; zero if none was.
    model : bool
        Whether the covariance of a calibrated model was counted in.
    """

    position: float
    angle: float | None
    position_stated: bool
    angle_stated: bool
    reading: float
    model: bool


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


def _rms(vectors: list[tuple[float, float, float]]) -> float:
    """Return the root mean square of components."""
    return float(np.sqrt(np.mean(np.square(vectors))))
