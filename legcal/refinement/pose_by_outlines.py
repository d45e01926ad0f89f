"""Poses of the platform by what images show alone, without the readings.

Where legs have R or U joints or constant lengths, the poses keep what these demand.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial

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
_KNOWN = 0.03  # [rad], or of a leg's length: a pose known worse is none
_FURTHEST = 0.1  # [rad], or of a leg's length, in one step


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
    length = _mean_length(model.legs, T_Rb_Re)
    everything, _ = _normal(model, foretold, whitening, R, t, np.ones_like)
    known = _is_known(everything, model.frame_legs, length)
    for step in range(_ROBUST_STEPS + _STEPS):
        weight_of = _soft if step < _ROBUST_STEPS else partial(_hard, rejection)
        normal, gradient = _normal(model, foretold, whitening, R, t, weight_of)
        change = -np.einsum("kij,kj->ki", _inverse(normal, model.frame_legs), gradient)
        change[~known] = 0.0
        reach = np.linalg.norm(change * np.repeat([1.0, 1.0 / length], 3), axis=1, keepdims=True)
        change *= np.minimum(1.0, _FURTHEST / np.maximum(reach, 1e-300))
        R = Rotation.from_rotvec(change[:, :3]).as_matrix() @ R
        t = t + change[:, 3:]
    known &= _is_known(normal, model.frame_legs, length)
    covariance = _inverse(normal, model.frame_legs)
    together = RigidTransform.from_components(t, Rotation.from_matrix(R))
    return ShownPoses(tuple(together[k] for k in range(len(t))), covariance, known)


def _soft(norm: Array) -> Array:
    """Return weights that fall with the whitened distance."""
    return np.asarray(1.0 / (1.0 + (norm / _WIDTH) ** 2))


def _hard(rejection: float, norm: Array) -> Array:
    """Return weights that are one up to a whitened distance."""
    return np.where(norm < rejection, 1.0, 0.0)


def _mean_length(legs: Sequence[LegGeometry], T_Rb_Re: Sequence[RigidTransform]) -> float:
    """Return the mean length of the legs at poses [m]."""
    A, B = np.array([leg.A for leg in legs]), np.array([leg.B for leg in legs])
    return float(np.mean([np.linalg.norm(T.apply(B) - A, axis=1) for T in T_Rb_Re]))


def _normal(
    model: FittedModel,
    foretold: ForetoldOutlines,
    whitening: Array,
    R: Array,
    t: Array,
    weight_of: Callable[[Array], Array],
) -> tuple[Array, Array]:
    """Return normal matrix and gradient of each pose, outlines weighted by their distance."""
    r, J = _linearized(foretold, whitening, R, t)
    weight = weight_of(np.linalg.norm(r, axis=1))
    normal, gradient = _demands(model.legs, R, t)
    np.add.at(normal, foretold.pose, weight[:, None, None] * (J.swapaxes(1, 2) @ J))
    np.add.at(gradient, foretold.pose, weight[:, None] * np.einsum("nri,nr->ni", J, r))
    return normal, gradient


def _is_known(normal: Array, frame_legs: Sequence[int], length: float) -> BoolArray:
    """Return which poses are determined well enough to mean anything."""
    covariance = _inverse(normal, frame_legs)
    columns = np.ix_(range(len(normal)), freedoms(frame_legs), freedoms(frame_legs))
    has_rank = np.linalg.eigvalsh(normal[columns])[:, 0] > 1.0  # better than a metre or radian
    turn, shift = (
        np.sqrt(np.trace(covariance[:, part, part], axis1=1, axis2=2))
        for part in (slice(0, 3), slice(3, 6))
    )
    return np.asarray(has_rank & (shift < _KNOWN * length) & (turn < _KNOWN))


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
