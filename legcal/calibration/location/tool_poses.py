"""Measured tool poses: the table, and what is known of the errors of its rows.

The table is a CSV file that is read strictly. Its header has the actuated joints, ``x,y,z`` and,
where orientations are measured, ``qx,qy,qz,qw``, in any order; optional are ``name``,
``position_sigma`` and ``angle_sigma``.

The errors of a row are those of the measurement, the same in all directions: one standard
deviation for positions and one for orientations, times a factor that may be unknown; those of the
readings, which move position and orientation together; and those of a calibrated model, which all
rows share.
"""

from __future__ import annotations

import math
import os
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from scipy.spatial.transform import RigidTransform, Rotation

from legcal.brief import brief
from legcal.calibration.location.frames import PosePairs, tool_motions
from legcal.calibration.result_folder import RESULT_NAME, load_result
from legcal.data.measurements import reading_columns, readings_in
from legcal.errors import Code, DatasetError, DidNotConverge, NotIdentifiable, Problem, UsageError
from legcal.files.motions import QUATERNION_TOLERANCE
from legcal.files.table import Column, Table, header_problem, read_table
from legcal.geometry.covariances import whitener
from legcal.geometry.rotations import cross_matrices
from legcal.geometry.types import Array, BoolArray, IntArray
from legcal.machine.equations import freedoms, pose_equations, pose_sensitivity
from legcal.machine.files import RESULT_YAML
from legcal.machine.kinematics import forward_kinematics_many, platforms_in_base
from legcal.machine.model import Machine
from legcal.machine.parameters import geometries, parametrization_of
from legcal.machine.rods import first_rods, readings_of_rods

MIN_SIGMA = 1e-9  # [m, rad]; nobody measures better, and files round
MAX_ANGLE_SIGMA = 0.2  # [rad]; a larger one is none of a measured orientation
FEWEST = 3  # poses, where orientations are measured
FEWEST_POSITIONS = 4
_MAX_POSITION = 1e6  # [m]; squares of far larger positions overflow
_NORM_TOLERANCE = 1e-5  # of a quaternion: less is not worth a note
_NEGLIGIBLE = 1e-12  # of the largest eigenvalue of the covariance
_RADIAN = 0.25  # leg lengths that a radian is compared with
_FIRST_FACTOR = 1e-2  # of the length, and [rad]: where the estimate of unknown scatter starts
_POSITION = ("x", "y", "z")
_QUATERNION = ("qx", "qy", "qz", "qw")
_COLUMNS = (
    Column("name", "text", required=False),
    *(
        Column(
            name,
            least=-_MAX_POSITION,
            most=_MAX_POSITION,
            what="position",
            unit="metres",
            needed=f"less than {_MAX_POSITION:g} m",
            remedy="write metres, or remove the row",
        )
        for name in _POSITION
    ),
    *(
        Column(name, what="quaternion", required=False, blank=True, group="quaternion")
        for name in _QUATERNION
    ),
    Column(
        "position_sigma",
        least=MIN_SIGMA,
        what="standard deviation",
        unit="metres",
        needed=f"one from {MIN_SIGMA:g} metres",
        required=False,
    ),
    Column(
        "angle_sigma",
        least=MIN_SIGMA,
        most=MAX_ANGLE_SIGMA,
        what="standard deviation",
        unit="radians",
        needed=f"one from {MIN_SIGMA:g} to {MAX_ANGLE_SIGMA:g} radians, not degrees",
        required=False,
        blank=True,
    ),
)
_ANGLES = re.compile(r"[rw][xyz]|[abc]|roll|pitch|yaw|phi|theta|psi", re.IGNORECASE)


@brief
@dataclass(frozen=True, eq=False)
class ToolPoses:
    """What a laser tracker, a CMM or a camera measured, one row a pose."""

    q: Array  # (n, n_legs): readings in the order of the legs [m or rad]; NaN without a motor
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


def read_tool_poses(path: Path, machine: Machine) -> ToolPoses:
    """Return the measured tool poses of a file.

    Raises DatasetError with one sentence for each thing that is wrong, naming row and column.
    """
    table = read_table(
        path,
        "table of tool poses",
        "row",
        [*reading_columns(machine.legs), *_COLUMNS],
        needed="a row for each pose; measure some",
        unknown=lambda name: _about_angles(path, name),
    )
    readings, notes = readings_in(table, machine.legs)
    position = table.numbers(_POSITION)
    rotation, oriented, worst = _orientations(table)
    if "angle_sigma" in table:
        if "qx" not in table:
            found, needed = "angle_sigma and no quaternions", "qx, qy, qz, qw beside it"
            table.refuse_file(
                header_problem(path, found, needed, "add the columns", Code.MISSING_COLUMN)
            )
        table.need(["angle_sigma"], oriented)
    joints = [column.name for column in reading_columns(machine.legs)]
    same = table.numbers([*joints, *(name for name in (*_POSITION, *_QUATERNION) if name in table)])
    table.once(
        [
            tuple(row) if np.all(np.isfinite(row[: len(joints) + 3])) else None
            for row in np.where(np.isnan(same), math.inf, same).tolist()
        ],
        "the same readings and the same pose",
    )  # one measurement would count as two
    table.check()
    q = np.full((len(table), machine.n_legs), math.nan)
    q[:, list(machine.motors)] = readings
    if worst > _NORM_TOLERANCE:
        notes = (
            *notes,
            f"{path}: quaternions were made unit; their norms are up to {worst:.2g} off, as if "
            "they had been rounded.",
        )
    angle_sigma = np.where(oriented, table.number("angle_sigma"), 1.0)
    return ToolPoses(
        q=q,
        position=position,
        rotation=rotation,
        oriented=oriented,
        position_sigma=table.number("position_sigma") if "position_sigma" in table else None,
        angle_sigma=angle_sigma if "angle_sigma" in table else None,
        numbers=np.arange(1, len(table) + 1),
        notes=notes,
    )


def _about_angles(path: Path, name: str) -> Problem | None:
    """Return what is wrong with a column that looks like an angle."""
    if not _ANGLES.fullmatch(name):
        return None
    found, needed = f"'{name}', which looks like an angle", "orientations as quaternions "
    needed += ", ".join(_QUATERNION)
    return header_problem(path, found, needed, "convert the angles", Code.UNKNOWN_COLUMN)


def _orientations(table: Table) -> tuple[Array, BoolArray, float]:
    """Return orientations (n, 3, 3), where there are any, and how far norms are off at most."""
    rotation = np.tile(np.eye(3), (len(table), 1, 1))
    quaternions = table.numbers(_QUATERNION)
    norms = np.linalg.norm(quaternions, axis=1)
    error = np.abs(norms - 1.0)
    for i in np.flatnonzero(error > QUATERNION_TOLERANCE).tolist():
        hint = "; these look like angles in degrees" if norms[i] > 2.0 else ""
        found = f"a quaternion of norm {norms[i]:.6g}"
        needed, remedy = f"1 within {QUATERNION_TOLERANCE:g}{hint}", "check its four numbers"
        table.refuse(i, found, needed, *_QUATERNION, remedy=remedy, what="orientation")
    oriented = error <= QUATERNION_TOLERANCE
    if np.any(oriented):
        rotation[oriented] = Rotation.from_quat(quaternions[oriented]).as_matrix()
    return rotation, oriented, float(error[oriented].max(initial=0.0))


@dataclass(frozen=True, eq=False)
class PoseNoise:
    """Standard deviations of the rows."""

    sigma: Array  # (n, 2): of position [m] and orientation [rad] of each row, up to ``factor``
    factor: Array  # (2,): what all of a kind are multiplied with
    # whether the standard deviations of positions and of orientations were stated; the factor of
    # those that were not is estimated
    stated: tuple[bool, bool]
    # (n, 6, 6): covariance of the tool pose by errors of the readings [m, rad]; None without any
    readings: Array | None = None

    def of(self, rows: BoolArray | IntArray) -> PoseNoise:
        """Return that of some rows."""
        readings = None if self.readings is None else self.readings[rows]
        return replace(self, sigma=self.sigma[rows], readings=readings)

    def scaled(self, factor: Array) -> PoseNoise:
        """Return the same with other factors."""
        return replace(self, factor=factor)

    @property
    def min_factor(self) -> Array:
        """The smallest factor of each kind that can be meant, (2,)."""
        return np.asarray(MIN_SIGMA / self.sigma.min(axis=0))

    @property
    def rms(self) -> Array:
        """Standard deviations of a component, rms over the rows, (2,) [m], [rad]."""
        return np.asarray(self.factor * np.sqrt((self.sigma**2).mean(axis=0)))

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
            W = whitener(S)
        W[~oriented, 3:] = 0.0
        return np.asarray(W)


@dataclass(frozen=True, eq=False)
class ToolMeasurements:
    """Measured tool poses with all that is known of their errors."""

    machine: Machine
    poses: ToolPoses  # as measured
    pairs: PosePairs  # beside the platform poses at the readings
    noise: PoseNoise  # of the measurement
    encoder_sigma: float  # the largest of a reading [m or rad]; zero if none was stated
    # by_readings, by_model: (n, 6, k): platform motions (see tool_motions) by independent errors of
    # one standard deviation; None if nothing is known of them
    by_readings: Array | None
    by_model: Array | None
    fewest: int  # poses that can determine the frames

    def of(self, rows: BoolArray) -> ToolMeasurements:
        """Return some rows, with the measured poses as they were."""
        return replace(
            self,
            pairs=self.pairs.of(rows),
            noise=self.noise.of(rows),
            by_readings=None if self.by_readings is None else self.by_readings[rows],
            by_model=None if self.by_model is None else self.by_model[rows],
        )

    def noise_at(self, frames: Array) -> PoseNoise:
        """Return the noise with what errors of the readings do to the tool at some frames."""
        if self.by_readings is None:
            return self.noise
        moved = tool_motions(self.by_readings, frames, self.pairs)
        return replace(self.noise, readings=moved @ np.swapaxes(moved, 1, 2))

    @property
    def is_oriented(self) -> bool:
        """Whether any orientation was measured."""
        return bool(self.pairs.oriented.any())


def tool_measurements(
    machine: Machine,
    poses: ToolPoses,
    name: str,  # what they are called in messages
    *,
    # position_sigma, angle_sigma: standard deviations of all rows [m], [rad]; None where the table
    # has them or residuals are to give them
    position_sigma: float | None,
    angle_sigma: float | None,
    encoder_sigma: Mapping[str, float],  # by motor [m or rad], of those that are not exact
) -> ToolMeasurements:
    """Return measured poses beside those of the platform, with what is known of their errors.

    Raises NotIdentifiable if there are too few poses, or the motors do not determine the pose;
    DidNotConverge if the machine cannot have some readings; UsageError if a standard deviation is
    stated twice.
    """
    fewest = FEWEST if poses.oriented.any() else FEWEST_POSITIONS
    _check_count(poses, name, fewest)
    try:
        T = forward_kinematics_many(machine, poses.q)
    except (DidNotConverge, UsageError) as error:
        raise error.told(lambda problem: _of_table(problem, name)) from error
    matrices = np.array([pose.as_matrix() for pose in T])
    pairs = PosePairs(
        R=matrices[:, :3, :3],
        t=matrices[:, :3, 3],
        M=poses.rotation,
        p=poses.position,
        oriented=poses.oriented,
        length=_RADIAN * machine.size,
    )
    by_model = _motions_by_model(machine, T)
    return ToolMeasurements(
        machine=machine,
        poses=poses,
        pairs=pairs,
        noise=_noise(poses, position_sigma, angle_sigma, pairs.length, name),
        encoder_sigma=max(encoder_sigma.values(), default=0.0),
        by_readings=motions_by_readings(machine, T, encoder_sigma) if encoder_sigma else None,
        by_model=by_model,
        fewest=fewest,
    )


def _check_count(poses: ToolPoses, name: str, fewest: int) -> None:
    """Refuse too few poses, and poses that are all one."""
    n = len(poses)
    columns = ~np.isnan(poses.q).any(axis=0)
    n_different = len(np.unique(poses.q[:, columns], axis=0))
    if n_different >= fewest:
        return
    what = "measured with orientation" if poses.oriented.any() else "of which only positions"
    found = f"{n} pose{'s' * (n != 1)}" if n == n_different else (
        f"{n} rows at {n_different} different reading{'s' * (n_different != 1)}"
    )  # fmt: skip
    raise NotIdentifiable(
        f"{name}: base and tool could not be located: found {found}, needed at least {fewest} "
        f"poses {what}{' were measured' * (not poses.oriented.any())}, with rotations about two "
        "axes where the machine has them; measure more poses."
    )


def _noise(
    poses: ToolPoses,
    position_sigma: float | None,
    angle_sigma: float | None,
    length: float,
    name: str,
) -> PoseNoise:
    """Return the standard deviations that were stated, and a start for the others."""
    sigma = np.ones((len(poses), 2))
    factor, stated = np.array([_FIRST_FACTOR * length, _FIRST_FACTOR]), [False, False]
    given = (
        ("position", poses.position_sigma, position_sigma),
        ("angle", poses.angle_sigma, angle_sigma),
    )
    for kind, (what, column, number) in enumerate(given):
        if column is not None and number is not None:
            raise UsageError(
                f"{name}: the {what} sigma could not be used: found it in the column "
                f"{what}_sigma and as an option, needed it once; leave one of them out."
            )
        if column is None and number is None:
            continue
        sigma[:, kind] = number if column is None else column
        factor[kind], stated[kind] = 1.0, True
    if not poses.oriented.any():
        sigma[:, 1] = factor[1] = 1.0
        stated[1] = True
    return PoseNoise(sigma, factor, (stated[0], stated[1]))


def motions_by_readings(
    machine: Machine,
    poses: Sequence[RigidTransform],
    sigma: Mapping[str, float],  # standard deviations of readings by motor [m or rad]
) -> Array:
    """Return the platform motions (n, 6, k) by an error of each reading at some poses."""
    R, t = _joint_frames(machine, poses)
    legs = geometries(machine)
    equations = pose_equations(legs, R, t, by_local=False, q=readings_of_rods(legs, R, t))
    columns = list(freedoms(machine.frame_legs))
    inverse = np.linalg.pinv(equations.by_pose[:, :, columns])
    of_leg = np.array([sigma.get(str(leg.prismatic), 0.0) for leg in machine.legs])
    hangs = np.array([leg.actuator is not None for leg in legs], dtype=np.bool_)
    own = equations.measured & ~hangs[equations.leg]
    moved = np.zeros((len(poses), 6, own.sum() + equations.by_q.shape[2]))
    moved[:, columns] = np.concatenate(  # the sign of a reading does not matter
        [
            inverse[:, :, own] * of_leg[equations.leg[own]],
            inverse @ equations.by_q * of_leg[first_rods(legs)],
        ],
        axis=2,
    )
    return _of_link(machine, poses, moved)


def _of_table(problem: Problem, name: str) -> Problem:
    """Return what is wrong with the poses of a table at a machine, which may name its file."""
    what = f"{problem.file}: {problem.what}" if problem.file else problem.what
    return replace(problem, what=what, file=name)


def _motions_by_model(machine: Machine, poses: Sequence[RigidTransform]) -> Array | None:
    """Return the platform motions (n, 6, k) by the errors of a calibrated model.

    None where the model does not lie in the result folder of a calibration.
    """
    path = Path(machine.yaml_path)
    if path.name != RESULT_YAML or not os.path.isfile(path.parent / RESULT_NAME):
        return None
    try:
        result = load_result(path.parent)
    except DatasetError as error:
        raise DatasetError(
            [f"The covariance of the model could not be used: {p}" for p in error.problems]
        ) from error
    known = parametrization_of(machine, twists=True)
    R, t = _joint_frames(machine, poses)
    by_parameters = pose_sensitivity(geometries(machine), known, machine.frame_legs, R, t)
    values, vectors = np.linalg.eigh(result.covariance)
    kept = values > _NEGLIGIBLE * max(float(values[-1]), 0.0)
    root = vectors[:, kept] * np.sqrt(values[kept])
    columns = [known.names.index(name) for name in result.names]
    return _of_link(machine, poses, by_parameters[:, :, columns] @ root)


def _joint_frames(machine: Machine, poses: Sequence[RigidTransform]) -> tuple[Array, Array]:
    """Return rotations and positions of R_e in R_b."""
    matrices = np.array([T.as_matrix() for T in platforms_in_base(machine, poses)])
    return matrices[:, :3, :3], matrices[:, :3, 3]


def _of_link(machine: Machine, poses: Sequence[RigidTransform], moved: Array) -> Array:
    """Return motions of R_e in R_b (n, 6, k) as those of the platform link in the base link."""
    to_base = machine.T_base_Rb.rotation.as_matrix()
    turn = to_base @ moved[:, :3]
    origin = machine.T_platform_Re.translation
    arms = cross_matrices(np.array([T.rotation.apply(-origin) for T in poses]))
    return np.concatenate([turn, to_base @ moved[:, 3:] - arms @ turn], axis=1)
