"""Measured tool poses: the table, and the noise of its rows.

The table is a CSV file. Its header has the actuated joints, ``x,y,z`` and, if orientations are
measured, ``qx,qy,qz,qw``, in any order; ``name`` is optional. Without names of joints it is read as
a table of readings is: legs by name or number, units in headings, readings or whole lengths.

A row has two sources of error: the measurement, which is isotropic, with one standard deviation for
positions and one for orientations that may be unknown; and a calibrated model, whose errors all
rows share.
"""

from __future__ import annotations

import math
import os
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import combinations
from pathlib import Path

import numpy as np
from scipy.spatial.transform import RigidTransform, Rotation

from legcal.brief import brief
from legcal.calibration.joint_fit.platform import platform_by_parameters
from legcal.calibration.location.frames import PosePairs
from legcal.calibration.result_folder import RESULT_NAME, load_result
from legcal.data.readings_sheet import ReadingsSheet
from legcal.errors import Code, DatasetError, DidNotConverge, NotIdentifiable, Problem, UsageError
from legcal.files.motions import QUATERNION_TOLERANCE
from legcal.files.table import Column, Table, header_problem
from legcal.geometry.motions import cross_matrices
from legcal.geometry.types import Array, BoolArray, IntArray
from legcal.machine.files import RESULT_YAML
from legcal.machine.kinematics import forward_kinematics_many, platforms_in_base
from legcal.machine.model import Machine
from legcal.machine.parameters import geometries, parametrization_of

MIN_SIGMA = 1e-8  # [m, rad]; no measurement is better, and files round
MAX_ANGLE_SIGMA = 0.2  # [rad]; with a larger one the orientation was not measured
FEWEST = 3  # poses with orientation that determine the frames
FEWEST_POSITIONS = 4  # poses without orientation
_MAX_POSITION = 1e6  # [m]; squares of far larger positions overflow
_NORM_TOLERANCE = 1e-5  # deviation of the norm of a quaternion from one that is worth a note
_NEGLIGIBLE = 1e-12  # negligible eigenvalue of the covariance, relative to the largest
_RADIAN = 0.25  # mean leg lengths equivalent to a radian
_FIRST_SIGMA = 1e-2  # start of the estimate of an unknown scatter [machine lengths, rad]
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
)
_ANGLES = re.compile(r"[rw][xyz]|[abc]|roll|pitch|yaw|phi|theta|psi", re.IGNORECASE)


@brief
@dataclass(frozen=True, eq=False)
class ToolPoses:
    """Tool poses measured by a laser tracker, a CMM or a camera, one row a pose."""

    q: Array  # (n, n_legs): readings in the order of the legs [m or rad]; NaN without a motor
    position: Array  # (n, 3): position of the tool in the world [m]
    rotation: Array  # (n, 3, 3): T_world_tool; the identity if only the position was measured
    oriented: BoolArray  # (n,): whether the orientation was measured too
    numbers: IntArray  # (n,): numbers of the rows in the file, from 1
    notes: tuple[str, ...] = ()  # warnings about the table
    source: str = "The tool poses"  # the file, for messages
    columns: Mapping[str, str] = field(default_factory=dict)  # meaning of its headings
    unit: str = "m and rad"  # of the readings in it, and where that is from, in words

    def __len__(self) -> int:
        return len(self.position)


def read_tool_poses(path: Path, machine: Machine) -> ToolPoses:
    """Return the measured tool poses of a file, in SI by joints or as people write it.

    Raises DatasetError with one sentence for each problem, naming row and column.
    """
    joints = machine.motor_names
    sheet = ReadingsSheet(
        path, machine, "pose", others=_COLUMNS, unknown=lambda name: _about_angles(path, name)
    )
    table, readings = sheet.table, sheet.readings(in_si=set(joints) <= sheet.taken.keys())
    notes = readings.notes
    position = table.numbers(_POSITION)
    rotation, oriented, worst = _orientations(table)
    numbers = table.numbers(
        [*joints, *(name for name in (*_POSITION, *_QUATERNION) if name in table)]
    )
    table.once(
        [
            tuple(row) if np.all(np.isfinite(row[: len(joints) + 3])) else None
            for row in np.where(np.isnan(numbers), math.inf, numbers).tolist()
        ],
        "the same readings and the same pose",
    )  # one measurement would count as two
    table.check()
    q = np.full((len(table), machine.n_legs), math.nan)
    q[:, list(machine.motors)] = readings.q
    if worst > _NORM_TOLERANCE:
        notes = (
            *notes,
            f"{path}: quaternions were made unit; their norms are up to {worst:.2g} off, as if "
            "they had been rounded.",
        )
    return ToolPoses(
        q=q,
        position=position,
        rotation=rotation,
        oriented=oriented,
        numbers=np.arange(1, len(table) + 1),
        notes=notes,
        source=str(path),
        columns=sheet.taken,
        unit=f"{readings.unit}, {readings.unit_from}",
    )


def _about_angles(path: Path, name: str) -> Problem | None:
    """Return the problem of a column that looks like an angle."""
    if not _ANGLES.fullmatch(name):
        return None
    actual, needed = f"'{name}', which looks like an angle", "orientations as quaternions "
    needed += ", ".join(_QUATERNION)
    return header_problem(path, actual, needed, "convert the angles", Code.UNKNOWN_COLUMN)


def _orientations(table: Table) -> tuple[Array, BoolArray, float]:
    """Return orientations (n, 3, 3), a mask (n,) of measured ones, the largest error of a norm."""
    rotation = np.tile(np.eye(3), (len(table), 1, 1))
    quaternions = table.numbers(_QUATERNION)
    norms = np.linalg.norm(quaternions, axis=1)
    error = np.abs(norms - 1.0)
    for i in np.flatnonzero(error > QUATERNION_TOLERANCE).tolist():
        hint = "; these look like angles in degrees" if norms[i] > 2.0 else ""
        actual = f"a quaternion of norm {norms[i]:.6g}"
        needed, remedy = f"1 within {QUATERNION_TOLERANCE:g}{hint}", "check its four numbers"
        table.refuse(i, actual, needed, *_QUATERNION, remedy=remedy, what="orientation")
    oriented = error <= QUATERNION_TOLERANCE
    if np.any(oriented):
        rotation[oriented] = Rotation.from_quat(quaternions[oriented]).as_matrix()
    return rotation, oriented, float(error[oriented].max(initial=0.0))


@dataclass(frozen=True, eq=False)
class PoseNoise:
    """Standard deviations of a component of all positions and of all orientations."""

    sigma: Array  # (2,) [m], [rad]
    # whether each was stated; otherwise it is estimated
    stated: tuple[bool, bool]

    def weights(self, oriented: BoolArray) -> Array:
        """Return the inverse standard deviations (n, 6); zero for what was not measured."""
        weights = np.tile(np.repeat(1.0 / self.sigma, 3), (len(oriented), 1))
        weights[~oriented, 3:] = 0.0
        return weights


@dataclass(frozen=True, eq=False)
class ToolMeasurements:
    """Measured tool poses with the platform poses at their readings and all sources of noise."""

    machine: Machine
    poses: ToolPoses  # as measured
    pairs: PosePairs
    noise: PoseNoise  # standard deviations of the measurement
    # (n, 6, k): platform motions (see tool_motions) by independent errors of the model of one
    # standard deviation; None without such errors
    by_model: Array | None
    fewest: int  # smallest number of poses that determines the frames

    def of(self, rows: BoolArray) -> ToolMeasurements:
        """Return the measurements of selected rows; ``poses`` keeps all of them."""
        return replace(
            self,
            pairs=self.pairs.of(rows),
            by_model=None if self.by_model is None else self.by_model[rows],
        )

    @property
    def is_oriented(self) -> bool:
        """Whether any orientation was measured."""
        return bool(self.pairs.oriented.any())

    def with_columns_exchanged(self, rows: IntArray) -> Iterator[tuple[PosePairs, str, str]]:
        """Yield some rows with two columns of readings exchanged, what that is, and its remedy."""
        machine, chosen = self.machine, self.pairs.of(rows)
        for one, other in combinations(machine.motors, 2):
            q = self.poses.q[rows]
            q[:, [one, other]] = q[:, [other, one]]
            is_inside = [bool(machine.legs[j].in_travel(q[:, j]).all()) for j in (one, other)]
            if not all(is_inside):
                continue
            try:
                T = np.array([x.as_matrix() for x in forward_kinematics_many(machine, q)])
            except (DidNotConverge, UsageError):
                continue
            names = " and ".join(str(machine.legs[j].prismatic) for j in (one, other))
            yield (
                replace(chosen, R=T[:, :3, :3], t=T[:, :3, 3]),
                f"those of readings with columns {names} exchanged",
                "swap the headers of these columns",
            )


def tool_measurements(
    machine: Machine,
    poses: ToolPoses,
    name: str,  # name of the poses in messages
    *,
    # standard deviations of all rows [m], [rad]; None if to be estimated from the residuals
    position_sigma: float | None,
    angle_sigma: float | None,
) -> ToolMeasurements:
    """Return measured poses with the platform poses at their readings and their noise.

    Raises NotIdentifiable if there are too few poses, or the motors do not determine the pose;
    DidNotConverge if the machine cannot reach some readings.
    """
    fewest = FEWEST if poses.oriented.any() else FEWEST_POSITIONS
    _check_count(poses, name, fewest)
    try:
        T = forward_kinematics_many(machine, poses.q)
    except (DidNotConverge, UsageError) as error:
        raise error.map_problems(lambda problem: _of_table(problem, name)) from error
    matrices = np.array([pose.as_matrix() for pose in T])
    pairs = PosePairs(
        R=matrices[:, :3, :3],
        t=matrices[:, :3, 3],
        M=poses.rotation,
        p=poses.position,
        oriented=poses.oriented,
        length=_RADIAN * machine.size,
    )
    stated = position_sigma is not None, angle_sigma is not None or not poses.oriented.any()
    sigma = np.array([position_sigma or _FIRST_SIGMA * pairs.length, angle_sigma or _FIRST_SIGMA])
    if not poses.oriented.any():
        sigma[1] = 1.0
    return ToolMeasurements(
        machine=machine,
        poses=poses,
        pairs=pairs,
        noise=PoseNoise(sigma, stated),
        by_model=_motions_by_model(machine, T),
        fewest=fewest,
    )


def _check_count(poses: ToolPoses, name: str, fewest: int) -> None:
    n = len(poses)
    columns = ~np.isnan(poses.q).any(axis=0)
    n_different = len(np.unique(poses.q[:, columns], axis=0))
    if n_different >= fewest:
        return
    kind = "measured with orientation" if poses.oriented.any() else "of which only positions"
    actual = f"{n} pose{'s' * (n != 1)}" if n == n_different else (
        f"{n} rows at {n_different} different reading{'s' * (n_different != 1)}"
    )  # fmt: skip
    raise NotIdentifiable(
        f"{name}: base and tool could not be located: found {actual}, needed at least {fewest} "
        f"poses {kind}{' were measured' * (not poses.oriented.any())}, with rotations about two "
        "axes where the machine has them; measure more poses."
    )


def _of_table(problem: Problem, name: str) -> Problem:
    """Return a problem of the kinematics as one of the table of poses."""
    sentence = f"{problem.file}: {problem.what}" if problem.file else problem.what
    return replace(problem, what=sentence, file=name)


def _motions_by_model(machine: Machine, poses: Sequence[RigidTransform]) -> Array | None:
    """Return the platform motions (n, 6, k) by the errors of a calibrated model.

    None if the model is not in the result folder of a calibration.
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
    parametrization = parametrization_of(machine, twists=True)
    by_parameters = platform_by_parameters(
        geometries(machine),
        parametrization,
        machine.frame_legs,
        platforms_in_base(machine, poses),
    )
    values, vectors = np.linalg.eigh(result.covariance)
    significant = values > _NEGLIGIBLE * max(float(values[-1]), 0.0)
    root = vectors[:, significant] * np.sqrt(values[significant])
    columns = [parametrization.names.index(name) for name in result.names]
    return _of_link(machine, poses, by_parameters[:, :, columns] @ root)


def _of_link(machine: Machine, poses: Sequence[RigidTransform], moved: Array) -> Array:
    """Return motions of R_e in R_b (n, 6, k) as motions of the platform link in the base link."""
    to_base = machine.T_base_Rb.rotation.as_matrix()
    turn = to_base @ moved[:, :3]
    origin = machine.T_platform_Re.translation
    arms = cross_matrices(np.array([T.rotation.apply(-origin) for T in poses]))
    return np.concatenate([turn, to_base @ moved[:, 3:] - arms @ turn], axis=1)
