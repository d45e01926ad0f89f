"""What is to be located, put together: measured poses, platform poses, errors of the model.

The errors of a row are those of the measurement, the same in all directions: one standard
deviation for positions and one for orientations, times a factor that may be unknown; those of the
readings, which move position and orientation together; and those of a calibrated model, which all
rows share.
"""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from scipy.spatial.transform import RigidTransform

from legcal.calibration.location.frames import Frames, Noise, PosePairs
from legcal.calibration.location.result import ToolPoses
from legcal.calibration.result_folder import (
    MODEL_NAME,
    RESULT_NAME,
    EarlierResult,
    read_result,
)
from legcal.errors import DatasetError, DidNotConverge, NotIdentifiable, UsageError
from legcal.geometry import Array, BoolArray, IntArray, cross_matrices
from legcal.machine import (
    Machine,
    forward_kinematics_many,
    freedoms,
    geometries,
    leg_scale,
    parametrization_of,
    platform_in_base,
    pose_equations,
    pose_sensitivity,
)

_NEGLIGIBLE = 1e-12  # of the largest eigenvalue of the covariance
FEWEST = 3  # poses, where orientations are measured
FEWEST_POSITIONS = 4
SIZE = 0.25  # of a leg length: what a radian is compared with
_START_FACTOR = 1e-2  # of the length, and [rad]: where unknown scatter starts


@dataclass(frozen=True, eq=False)
class Problem:
    """Measured poses with all that is known of their errors."""

    machine: Machine  # the machine
    poses: ToolPoses  # as measured
    T_base_platform: tuple[RigidTransform, ...]  # at the readings
    pairs: PosePairs  # both as arrays
    noise: Noise  # of the measurement
    encoder_sigma: float  # of a reading [m]; zero if none was stated
    # by_readings, by_model: what errors of readings and of the calibrated model do; None if nothing
    # is known of them
    by_readings: PlatformMotions | None
    by_model: PlatformMotions | None
    result: EarlierResult | None  # the calibration that the covariance of the model comes from
    fewest: int  # poses that can determine the frames

    def of(self, rows: BoolArray) -> Problem:
        """Return the problem of some rows, with the measurements as they were."""
        return replace(
            self,
            pairs=self.pairs.of(rows),
            noise=self.noise.of(rows),
            by_readings=None if self.by_readings is None else self.by_readings.of(rows),
            by_model=None if self.by_model is None else self.by_model.of(rows),
        )

    def noise_at(self, frames: Frames) -> Noise:
        """Return the noise with what errors of the readings do to the tool at some frames."""
        if self.by_readings is None:
            return self.noise
        moved = self.by_readings.of_tool(frames, self.pairs)
        return replace(self.noise, readings=moved @ np.swapaxes(moved, 1, 2))

    @property
    def is_oriented(self) -> bool:
        """Whether any orientation was measured."""
        return bool(self.pairs.oriented.any())


def build_problem(
    machine: Machine,
    poses: ToolPoses,
    name: str,  # what they are called in messages
    *,
    # position_sigma, angle_sigma: standard deviations of all rows [m], [rad]; None where the table
    # or the residuals tell
    position_sigma: float | None,
    angle_sigma: float | None,
    encoder_sigma: float,
) -> Problem:
    """Return what is to be located.

    Raises NotIdentifiable if there are too few poses, or the motors do not determine the pose;
    DidNotConverge if the machine cannot have some readings; UsageError if a standard deviation is
    stated twice.
    """
    oriented = bool(poses.oriented.any())
    fewest = FEWEST if oriented else FEWEST_POSITIONS
    check_count(poses, name, fewest)
    try:
        T = forward_kinematics_many(machine, poses.q)
    except (DidNotConverge, UsageError) as error:
        raise type(error)([f"{name}: {problem}" for problem in error.problems]) from error
    matrices = np.array([pose.as_matrix() for pose in T])
    pairs = PosePairs(
        R=matrices[:, :3, :3],
        t=matrices[:, :3, 3],
        M=poses.rotation,
        p=poses.position,
        oriented=poses.oriented,
        length=SIZE * leg_scale(machine, machine.home),
    )
    result = _calibration_of(machine)
    return Problem(
        machine=machine,
        poses=poses,
        T_base_platform=tuple(T),
        pairs=pairs,
        noise=_noise(poses, position_sigma, angle_sigma, pairs.length, name),
        encoder_sigma=encoder_sigma,
        by_readings=motions_by_readings(machine, T, encoder_sigma) if encoder_sigma else None,
        by_model=None
        if result is None
        else motions_by_parameters(machine, T, result.names, result.covariance),
        result=result,
        fewest=fewest,
    )


def check_count(poses: ToolPoses, name: str, fewest: int) -> None:
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
) -> Noise:
    """Return the standard deviations that were stated, and a start for the others."""
    sigma = np.ones((len(poses), 2))
    factor, stated = np.array([_START_FACTOR * length, _START_FACTOR]), [False, False]
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
    return Noise(sigma, factor, (stated[0], stated[1]))


def _calibration_of(machine: Machine) -> EarlierResult | None:
    """Return the calibration that a model lies in the result folder of, or None."""
    path = Path(machine.yaml_path)
    if path.name != MODEL_NAME or not os.path.isfile(path.parent / RESULT_NAME):
        return None
    try:
        return read_result(path.parent)
    except DatasetError as error:
        raise DatasetError(
            [f"The covariance of the model could not be used: {p}" for p in error.problems]
        ) from error


@dataclass(frozen=True, eq=False)
class PlatformMotions:
    """How independent errors, each one standard deviation large, move the platform link."""

    # turn, shift: (n, 3, k): rotation vector [rad] and displacement of the link's origin [m], in
    # the base link
    turn: Array
    shift: Array

    def of(self, rows: BoolArray | IntArray) -> PlatformMotions:
        """Return those of some rows."""
        return PlatformMotions(self.turn[rows], self.shift[rows])

    def of_tool(self, frames: Frames, pairs: PosePairs) -> Array:
        """Return how they move the tool in the world, (n, 6, k): displacement, rotation."""
        arm = cross_matrices(pairs.R @ frames.t_tool)
        shift = frames.R_base @ (self.shift - arm @ self.turn)
        turn = frames.R_base @ self.turn * pairs.oriented[:, None, None]
        return np.concatenate([shift, turn], axis=1)


def motions_by_parameters(
    machine: Machine,
    poses: Sequence[RigidTransform],
    # (p): parameters of :func:`legcal.machine.parameters.parametrization_of` with twists
    names: Sequence[str],
    covariance: Array,  # (p, p): their covariance [m, rad]
) -> PlatformMotions:
    """Return what the errors of a calibrated model do to the platform at some poses."""
    known = parametrization_of(machine, twists=True)
    R, t = _joint_frames(machine, poses)
    by_parameters = pose_sensitivity(geometries(machine), known, machine.frame_legs, R, t)
    values, vectors = np.linalg.eigh(covariance)
    kept = values > _NEGLIGIBLE * max(float(values[-1]), 0.0)
    root = vectors[:, kept] * np.sqrt(values[kept])
    columns = [known.names.index(name) for name in names]
    return _of_link(machine, poses, by_parameters[:, :, columns] @ root)


def motions_by_readings(
    machine: Machine,
    poses: Sequence[RigidTransform],
    sigma_q: float,  # standard deviation of a reading [m]
) -> PlatformMotions:
    """Return what an error of each reading does to the platform at some poses."""
    R, t = _joint_frames(machine, poses)
    equations = pose_equations(geometries(machine), R, t)
    columns = list(freedoms(machine.frame_legs))
    inverse = np.linalg.pinv(equations.by_pose[:, :, columns])[:, :, equations.measured]
    moved = np.zeros((len(poses), 6, inverse.shape[2]))
    moved[:, columns] = sigma_q * inverse  # the sign of a reading does not matter
    return _of_link(machine, poses, moved)


def _joint_frames(machine: Machine, poses: Sequence[RigidTransform]) -> tuple[Array, Array]:
    """Return rotations and positions of R_e in R_b."""
    matrices = np.array([platform_in_base(machine, T).as_matrix() for T in poses])
    return matrices[:, :3, :3], matrices[:, :3, 3]


def _of_link(machine: Machine, poses: Sequence[RigidTransform], moved: Array) -> PlatformMotions:
    """Return motions of R_e in R_b (n, 6, k) as those of the platform link in the base link."""
    to_base = machine.T_base_Rb.rotation.as_matrix()
    turn = to_base @ moved[:, :3]
    origin = machine.T_platform_Re.translation
    arms = cross_matrices(np.array([T.rotation.apply(-origin) for T in poses]))
    return PlatformMotions(turn, to_base @ moved[:, 3:] - arms @ turn)
