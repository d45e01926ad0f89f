"""What is to be located, put together: measured poses, platform poses, errors of the model."""

from __future__ import annotations

import os
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from scipy.spatial.transform import RigidTransform

from legcal.errors import DatasetError, DidNotConverge, NotIdentifiable, UsageError
from legcal.geometry.types import BoolArray
from legcal.location.model_errors import (
    PlatformMotions,
    motions_by_parameters,
    motions_by_readings,
)
from legcal.location.noise import Noise
from legcal.location.pose_pairs import Frames, PosePairs
from legcal.location.tool_poses import ToolPoses
from legcal.mechanism.demands import leg_scale
from legcal.mechanism.kinematics import forward_kinematics_many
from legcal.mechanism.model import Mechanism
from legcal.report.earlier_result import MODEL_NAME, RESULT_NAME, EarlierResult, read_result

FEWEST = 3  # poses, where orientations are measured
FEWEST_POSITIONS = 4
SIZE = 0.25  # of a leg length: what a radian is compared with
_START_FACTOR = 1e-2  # of the length, and [rad]: where unknown scatter starts


@dataclass(frozen=True, eq=False)
class Problem:
    """Measured poses with all that is known of their errors.

    Attributes
    ----------
    mechanism : Mechanism
        The machine.
    poses : ToolPoses
        As measured.
    T_base_platform : tuple of RigidTransform
        At the readings.
    pairs : PosePairs
        Both as arrays.
    noise : Noise
        Of the measurement.
    encoder_sigma : float
        Of a reading [m]; zero if none was stated.
    by_readings, by_model : PlatformMotions or None
        What errors of readings and of the calibrated model do; None if nothing is known of them.
    result : EarlierResult or None
        The calibration that the covariance of the model comes from.
    fewest : int
        Poses that can determine the frames.
    """

    mechanism: Mechanism
    poses: ToolPoses
    T_base_platform: tuple[RigidTransform, ...]
    pairs: PosePairs
    noise: Noise
    encoder_sigma: float
    by_readings: PlatformMotions | None
    by_model: PlatformMotions | None
    result: EarlierResult | None
    fewest: int

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
    mechanism: Mechanism,
    poses: ToolPoses,
    name: str,
    *,
    position_sigma: float | None,
    angle_sigma: float | None,
    encoder_sigma: float,
) -> Problem:
    """Return what is to be located.

    Parameters
    ----------
    mechanism : Mechanism
        The machine.
    poses : ToolPoses
        The measured poses.
    name : str
        What they are called in messages.
    position_sigma, angle_sigma : float or None
        Standard deviations of all rows [m], [rad]; None where the table or the residuals tell.
    encoder_sigma : float
        Of a reading [m].

    Raises
    ------
    NotIdentifiable
        If there are too few poses, or the motors do not determine the pose.
    DidNotConverge
        If the machine cannot have some readings.
    UsageError
        If a standard deviation is stated twice.
    """
    oriented = bool(poses.oriented.any())
    fewest = FEWEST if oriented else FEWEST_POSITIONS
    check_count(poses, name, fewest)
    try:
        T = forward_kinematics_many(mechanism, poses.q)
    except (DidNotConverge, UsageError) as error:
        raise type(error)([f"{name}: {problem}" for problem in error.problems]) from error
    matrices = np.array([pose.as_matrix() for pose in T])
    pairs = PosePairs(
        R=matrices[:, :3, :3],
        t=matrices[:, :3, 3],
        M=poses.rotation,
        p=poses.position,
        oriented=poses.oriented,
        length=SIZE * leg_scale(mechanism, mechanism.home),
    )
    result = _calibration_of(mechanism)
    return Problem(
        mechanism=mechanism,
        poses=poses,
        T_base_platform=tuple(T),
        pairs=pairs,
        noise=_noise(poses, position_sigma, angle_sigma, pairs.length, name),
        encoder_sigma=encoder_sigma,
        by_readings=motions_by_readings(mechanism, T, encoder_sigma) if encoder_sigma else None,
        by_model=None
        if result is None
        else motions_by_parameters(mechanism, T, result.names, result.covariance),
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


def _calibration_of(mechanism: Mechanism) -> EarlierResult | None:
    """Return the calibration that a model lies in the result folder of, or None."""
    path = Path(mechanism.yaml_path)
    if path.name != MODEL_NAME or not os.path.isfile(path.parent / RESULT_NAME):
        return None
    try:
        return read_result(path.parent)
    except DatasetError as error:
        raise DatasetError(
            [f"The covariance of the model could not be used: {p}" for p in error.problems]
        ) from error
