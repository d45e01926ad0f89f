"""How precise the measured tool poses are, and what else moves them.

The errors of a row are those of the measurement, the same in all directions: one standard
deviation for positions and one for orientations, times a factor that may be unknown; and those of
the readings, which move position and orientation together.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from scipy.spatial.transform import RigidTransform, Rotation

from legcal.geometry import Array, BoolArray, IntArray, cross_matrices, rotation_matrices

Frame = Literal["base", "tool"]
Kind = Literal["position", "orientation"]
Direction = tuple[float, float, float]


@dataclass(frozen=True)
class OpenPart:
    """A part of the frames that poses do not tell, or hardly.

    Attributes
    ----------
    frame : {"base", "tool"}
        Whose.
    kind : {"position", "orientation"}
        Of what.
    directions : tuple of tuple of float
        Unit vectors: of the base in the base link, of the tool in the platform link.
    """

    frame: Frame
    kind: Kind
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


@dataclass(frozen=True, eq=False)
class ToolPoses:
    """What a laser tracker, a CMM or a camera measured, one row a pose.

    Attributes
    ----------
    q : (n, n_legs) array
        Readings in the order of the legs [m]; NaN for legs without a motor.
    position : (n, 3) array
        Of the tool in the world [m].
    rotation : (n, 3, 3) array
        T_world_tool; the identity where only the position was measured.
    oriented : (n,) array of bool
        Where the orientation was measured too.
    position_sigma, angle_sigma : (n,) array or None
        Standard deviation of each component [m], [rad]; None if not stated.
    numbers : (n,) array of int
        Of the rows in the file, from 1.
    notes : tuple of str
        What is odd but allowed.
    """

    q: Array
    position: Array
    rotation: Array
    oriented: BoolArray
    position_sigma: Array | None
    angle_sigma: Array | None
    numbers: IntArray
    notes: tuple[str, ...] = ()

    def __len__(self) -> int:
        return len(self.position)


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


N_FRAME = 12  # displacement and rotation of both frames


@dataclass(frozen=True, eq=False)
class PosePairs:
    """Measured tool poses and the platform poses that the readings give.

    Attributes
    ----------
    R, t : (n, 3, 3) and (n, 3) array
        T_base_platform [m].
    M, p : (n, 3, 3) and (n, 3) array
        T_world_tool as measured [m]; M is the identity where it is not.
    oriented : (n,) array of bool
        Whether the orientation of the tool was measured.
    length : float
        A length of the machine, which rotations are weighed against [m].
    """

    R: Array
    t: Array
    M: Array
    p: Array
    oriented: BoolArray
    length: float

    def __len__(self) -> int:
        return len(self.t)

    def of(self, rows: BoolArray | IntArray) -> PosePairs:
        """Return some of the pairs."""
        return PosePairs(
            self.R[rows],
            self.t[rows],
            self.M[rows],
            self.p[rows],
            self.oriented[rows],
            self.length,
        )

    @property
    def scale(self) -> Array:
        """What one unit of each component of a step means, (12,): the length, or one radian."""
        return np.tile(np.repeat([self.length, 1.0], 3), 2)


@dataclass(frozen=True, eq=False)
class Frames:
    """The base in the world and the tool in the platform; leading dimensions make a batch.

    Attributes
    ----------
    R_base, t_base : (..., 3, 3) and (..., 3) array
        T_world_base [m].
    R_tool, t_tool : (..., 3, 3) and (..., 3) array
        T_platform_tool [m].
    """

    R_base: Array
    t_base: Array
    R_tool: Array
    t_tool: Array

    def at(self, i: int | IntArray) -> Frames:
        """Return one of a batch, or several."""
        return Frames(self.R_base[i], self.t_base[i], self.R_tool[i], self.t_tool[i])

    def moved(self, step: Array) -> Frames:
        """Return the frames after a step (..., 12).

        A step holds the displacement of the base in the world [m], its rotation vector about
        world axes [rad], and the same of the tool in the platform.
        """
        return Frames(
            rotation_matrices(step[..., 3:6]) @ self.R_base,
            self.t_base + step[..., :3],
            rotation_matrices(step[..., 9:]) @ self.R_tool,
            self.t_tool + step[..., 6:9],
        )

    def transforms(self) -> tuple[RigidTransform, RigidTransform]:
        """Return T_world_base and T_platform_tool."""
        return (
            RigidTransform.from_components(self.t_base, Rotation.from_matrix(self.R_base)),
            RigidTransform.from_components(self.t_tool, Rotation.from_matrix(self.R_tool)),
        )


def stacked(several: list[Frames]) -> Frames:
    """Return several frames as one batch."""
    return Frames(
        np.array([f.R_base for f in several]),
        np.array([f.t_base for f in several]),
        np.array([f.R_tool for f in several]),
        np.array([f.t_tool for f in several]),
    )


def predicted(frames: Frames, pairs: PosePairs) -> tuple[Array, Array]:
    """Return orientations (..., n, 3, 3) and positions (..., n, 3) [m] of the tool in the world."""
    tip = np.einsum("nij,...j->...ni", pairs.R, frames.t_tool) + pairs.t
    p = np.einsum("...ij,...nj->...ni", frames.R_base, tip) + frames.t_base[..., None, :]
    M = frames.R_base[..., None, :, :] @ pairs.R @ frames.R_tool[..., None, :, :]
    return M, p


def residuals(frames: Frames, pairs: PosePairs) -> Array:
    """Return measured minus predicted poses, (..., n, 6): position [m], rotation vector [rad].

    Both are along world axes; a rotation that was not measured counts as zero.
    """
    M, p = predicted(frames, pairs)
    away = pairs.M @ np.swapaxes(M, -1, -2)
    turn = Rotation.from_matrix(away.reshape(-1, 3, 3)).as_rotvec().reshape(p.shape)
    turn[..., ~pairs.oriented, :] = 0.0
    return np.concatenate([pairs.p - p, turn], axis=-1)


def jacobian(frames: Frames, pairs: PosePairs) -> Array:
    """Return the derivative of predicted poses by a step, (..., n, 6, 12)."""
    n = len(pairs)
    tip = np.einsum("nij,...j->...ni", pairs.R, frames.t_tool) + pairs.t
    arm = np.einsum("...ij,...nj->...ni", frames.R_base, tip)
    carried = frames.R_base[..., None, :, :] @ pairs.R
    J = np.zeros((*frames.t_base.shape[:-1], n, 6, N_FRAME))
    J[..., :3, :3] = np.eye(3)
    J[..., :3, 3:6] = -cross_matrices(arm)
    J[..., :3, 6:9] = carried
    J[..., 3:, 3:6] = np.eye(3) * pairs.oriented[:, None, None]
    J[..., 3:, 9:] = carried * pairs.oriented[:, None, None]
    return J


SMALLEST = 1e-9  # [m, rad]; nobody measures better, and files round


@dataclass(frozen=True, eq=False)
class Noise:
    """Standard deviations of the rows.

    Attributes
    ----------
    sigma : (n, 2) array
        Of position [m] and orientation [rad] of each row, up to ``factor``.
    factor : (2,) array
        What all of a kind are multiplied with.
    stated : tuple of bool
        Whether the standard deviations of positions and of orientations were stated; the factor
        of those that were not is estimated.
    readings : (n, 6, 6) array or None
        Covariance of the tool pose by errors of the readings [m, rad]; None without any.
    """

    sigma: Array
    factor: Array
    stated: tuple[bool, bool]
    readings: Array | None = None

    def of(self, rows: BoolArray | IntArray) -> Noise:
        """Return that of some rows."""
        readings = None if self.readings is None else self.readings[rows]
        return replace(self, sigma=self.sigma[rows], readings=readings)

    def scaled(self, factor: Array) -> Noise:
        """Return the same with other factors."""
        return replace(self, factor=factor)

    @property
    def floor(self) -> Array:
        """The smallest factor of each kind that can be meant."""
        return np.asarray(SMALLEST / self.sigma.min(axis=0))

    def standard_deviations(self) -> Array:
        """Return those of each row and component without the readings', (n, 6) [m, rad]."""
        return np.repeat(self.sigma * self.factor, 3, axis=1)

    def whitening(self, oriented: BoolArray) -> Array:
        """Return matrices W (n, 6, 6) with W^T W the inverse covariance; zero where unmeasured."""
        sigma = self.standard_deviations()
        if self.readings is None:
            W = np.zeros((*sigma.shape, 6))
            W[:, range(6), range(6)] = 1.0 / sigma
        else:
            S = self.readings.copy()
            S[~oriented, 3:, :3] = S[~oriented, :3, 3:] = 0.0
            S[:, range(6), range(6)] += sigma**2
            W = np.linalg.inv(np.linalg.cholesky(S))
        W[~oriented, 3:] = 0.0
        return np.asarray(W)
