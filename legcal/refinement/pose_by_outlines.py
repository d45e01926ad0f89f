"""Poses of the platform by what images show alone, without the readings.

Where legs have R or U joints or constant lengths, the poses keep what these demand.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import RigidTransform, Rotation

from legcal.geometry.types import Array, BoolArray
from legcal.mechanism.equations import demanded
from legcal.mechanism.leg import LegKind
from legcal.mechanism.leg_geometry import Demand, LegGeometry
from legcal.mechanism.sensitivity import freedoms
from legcal.refinement.foretold import FittedModel, ForetoldOutlines, arrays

_STEP = 1e-6  # [rad, m] of the differences
_EXACT = 1e-7  # [m]: what the mechanism itself demands
_ROBUST_STEPS, _STEPS = 10, 5
_WIDTH = 3.0  # whitened distance at which an outline starts to count less
_KNOWN = 0.1  # of a leg's length: a pose known worse is none


@dataclass(frozen=True, eq=False)
class ShownPoses:
    """Poses by outlines alone.

    Attributes
    ----------
    T_Rb_Re : tuple of RigidTransform
        The poses.
    covariance : (n_poses, 6, 6) array
        Of the rotation vector in R_b and the displacement of R_e, by the noise of the outlines
        [rad^2, rad m, m^2].
    known : (n_poses,) array of bool
        Where the outlines determine the pose; what the others have means nothing.
    """

    T_Rb_Re: tuple[RigidTransform, ...]
    covariance: Array
    known: BoolArray


def poses_by_outlines(
    model: FittedModel,
    foretold: ForetoldOutlines,
    whitening: Array,
    T_Rb_Re: Sequence[RigidTransform],
    rejection: float,
) -> ShownPoses:
    """Return the poses at which the model fits the outlines best.

    Parameters
    ----------
    model : FittedModel
        The model.
    foretold : ForetoldOutlines
        The outlines.
    whitening : (n, 2, 2) array
        Whitens the offsets of the outlines [1/px].
    T_Rb_Re : sequence of RigidTransform
        Poses nearby.
    rejection : float
        Whitened distance beyond which an outline does not count.
    """
    R, t = arrays(T_Rb_Re)
    normal = np.zeros((len(t), 6, 6))
    for step in range(_ROBUST_STEPS + _STEPS):
        r, J = _linearized(foretold, whitening, R, t)
        norm = np.linalg.norm(r, axis=1)
        weight = 1.0 / (1.0 + (norm / _WIDTH) ** 2)
        if step >= _ROBUST_STEPS:
            weight = np.where(norm < rejection, 1.0, 0.0)
        normal, gradient = _demands(model.legs, R, t)
        np.add.at(normal, foretold.pose, weight[:, None, None] * (J.swapaxes(1, 2) @ J))
        np.add.at(gradient, foretold.pose, weight[:, None] * np.einsum("nri,nr->ni", J, r))
        change = -np.einsum("kij,kj->ki", _inverse(normal, model.frame_legs), gradient)
        R = Rotation.from_rotvec(change[:, :3]).as_matrix() @ R
        t = t + change[:, 3:]
    covariance = _inverse(normal, model.frame_legs)
    length = np.mean(
        [np.linalg.norm(T.apply(leg.B) - leg.A) for T in T_Rb_Re for leg in model.legs]
    )
    spread = np.sqrt(np.trace(covariance[:, 3:, 3:], axis1=1, axis2=2))
    turn = np.sqrt(np.trace(covariance[:, :3, :3], axis1=1, axis2=2))
    known = (spread < _KNOWN * length) & (turn < _KNOWN) & _has_rank(normal, model.frame_legs)
    together = RigidTransform.from_components(t, Rotation.from_matrix(R))
    return ShownPoses(tuple(together[k] for k in range(len(t))), covariance, known)


def _linearized(
    foretold: ForetoldOutlines, whitening: Array, R: Array, t: Array
) -> tuple[Array, Array]:
    """Return whitened offsets (n, 2) and their derivatives (n, 2, 6) by the poses."""
    columns = []
    for k in range(6):
        ends = []
        for step in (-_STEP, _STEP):
            turn, shift = np.zeros(3), np.zeros(3)
            (turn if k < 3 else shift)[k % 3] = step
            turned = Rotation.from_rotvec(turn).as_matrix() @ R
            ends.append(foretold.offsets(turned, t + shift))
        columns.append((ends[1] - ends[0]) / (2.0 * _STEP))
    J = whitening @ np.stack(columns, axis=-1)
    return (whitening @ foretold.offsets(R, t)[..., None])[..., 0], J


def _demands(legs: Sequence[LegGeometry], R: Array, t: Array) -> tuple[Array, Array]:
    """Return what the legs demand without a reading, as normal equations of each pose."""
    normal, gradient = np.zeros((len(t), 6, 6)), np.zeros((len(t), 6))
    for leg in legs:
        found = demanded(leg, R, t)
        measured = np.array(
            [d is Demand.LENGTH and leg.kind is LegKind.ACTUATED for d in found.demands],
            dtype=np.bool_,
        )
        J, value = found.by_pose[:, ~measured] / _EXACT, found.values[:, ~measured] / _EXACT
        normal += J.swapaxes(1, 2) @ J
        gradient += np.einsum("kri,kr->ki", J, value)
    return normal, gradient


def _inverse(normal: Array, frame_legs: Sequence[int]) -> Array:
    """Return the inverse of normal matrices (k, 6, 6) over the freedoms of the platform."""
    columns = np.ix_(range(len(normal)), freedoms(frame_legs), freedoms(frame_legs))
    inverse = np.zeros_like(normal)
    inverse[columns] = np.linalg.pinv(normal[columns], rcond=1e-15, hermitian=True)
    return inverse


def _has_rank(normal: Array, frame_legs: Sequence[int]) -> BoolArray:
    """Return which normal matrices determine all freedoms of the platform."""
    columns = np.ix_(range(len(normal)), freedoms(frame_legs), freedoms(frame_legs))
    return np.asarray(np.linalg.eigvalsh(normal[columns])[:, 0] > 1.0)  # [m, rad]: no worse
