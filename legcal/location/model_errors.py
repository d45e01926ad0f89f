"""What errors of the model and of the readings do to the tool poses, linearised.

A calibrated model comes with the covariance of its parameters. An error of these moves all poses
together, so that it does not average out over rows: it is looked for beside the frames, with what
the calibration says of it as prior. Errors of readings are independent from row to row.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import RigidTransform

from legcal.geometry.types import Array, BoolArray, IntArray
from legcal.location.pose_pairs import Frames, PosePairs, cross_matrices
from legcal.mechanism.model import Mechanism
from legcal.mechanism.parametrization import geometries, parametrization_of
from legcal.mechanism.platform import platform_in_base
from legcal.mechanism.sensitivity import freedoms, pose_equations, pose_sensitivity

_NEGLIGIBLE = 1e-12  # of the largest eigenvalue of the covariance


@dataclass(frozen=True, eq=False)
class PlatformMotions:
    """How independent errors, each one standard deviation large, move the platform link.

    Attributes
    ----------
    turn, shift : (n, 3, k) array
        Rotation vector [rad] and displacement of the link's origin [m], in the base link.
    """

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
    mechanism: Mechanism,
    poses: Sequence[RigidTransform],
    names: Sequence[str],
    covariance: Array,
) -> PlatformMotions:
    """Return what the errors of a calibrated model do to the platform at some poses.

    Parameters
    ----------
    mechanism : Mechanism
        The calibrated model.
    poses : sequence of RigidTransform
        T_base_platform of every row.
    names : sequence of str, length p
        Parameters of :func:`legcal.mechanism.parametrization.parametrization_of` with twists.
    covariance : (p, p) array
        Their covariance [m, rad].
    """
    known = parametrization_of(mechanism, twists=True)
    R, t = _joint_frames(mechanism, poses)
    by_parameters = pose_sensitivity(geometries(mechanism), known, mechanism.frame_legs, R, t)
    values, vectors = np.linalg.eigh(covariance)
    kept = values > _NEGLIGIBLE * max(float(values[-1]), 0.0)
    root = vectors[:, kept] * np.sqrt(values[kept])
    columns = [known.names.index(name) for name in names]
    return _of_link(mechanism, poses, by_parameters[:, :, columns] @ root)


def motions_by_readings(
    mechanism: Mechanism, poses: Sequence[RigidTransform], sigma_q: float
) -> PlatformMotions:
    """Return what an error of each reading does to the platform at some poses.

    Parameters
    ----------
    mechanism : Mechanism
        The machine.
    poses : sequence of RigidTransform
        T_base_platform of every row.
    sigma_q : float
        Standard deviation of a reading [m].
    """
    R, t = _joint_frames(mechanism, poses)
    known = parametrization_of(mechanism)
    equations = pose_equations(geometries(mechanism), known, R, t)
    columns = list(freedoms(mechanism.frame_legs))
    inverse = np.linalg.pinv(equations.by_pose[:, :, columns])[:, :, equations.measured]
    moved = np.zeros((len(poses), 6, inverse.shape[2]))
    moved[:, columns] = sigma_q * inverse  # the sign of a reading does not matter
    return _of_link(mechanism, poses, moved)


def _joint_frames(mechanism: Mechanism, poses: Sequence[RigidTransform]) -> tuple[Array, Array]:
    """Return rotations and positions of R_e in R_b."""
    matrices = np.array([platform_in_base(mechanism, T).as_matrix() for T in poses])
    return matrices[:, :3, :3], matrices[:, :3, 3]


def _of_link(
    mechanism: Mechanism, poses: Sequence[RigidTransform], moved: Array
) -> PlatformMotions:
    """Return motions of R_e in R_b (n, 6, k) as those of the platform link in the base link."""
    to_base = mechanism.T_base_Rb.rotation.as_matrix()
    turn = to_base @ moved[:, :3]
    origin = mechanism.T_platform_Re.translation
    arms = cross_matrices(np.array([T.rotation.apply(-origin) for T in poses]))
    return PlatformMotions(turn, to_base @ moved[:, 3:] - arms @ turn)
