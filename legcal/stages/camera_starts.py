"""Where a camera may have stood, from what it shows of the base and a model of that.

Joints that are not on one line fix a camera by themselves. Joints on one line leave a turn
about it, which revolute axes across the line fix; but axes are lines, and what they fix may have
two solutions: two legs with axes normal to the line between them look the same after half a turn
about that line.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import RigidTransform, Rotation

from legcal.geometry.lines import normal_basis
from legcal.geometry.types import Array
from legcal.stages.motion import register_points

_ON_A_LINE = 0.05  # spread of joints across their line, in that along it
_ALONG = 0.1  # sine of the angle between an axis and the line: less does not fix a camera
_ALIKE = 0.07  # mean squared sine of angles between axes: turns that differ by less are alike
_TURNS = 720


@dataclass(frozen=True, eq=False)
class CameraStart:
    """A place where a camera may have stood.

    Attributes
    ----------
    T_Rb_camera : RigidTransform
        The place.
    fixed : bool
        Whether the joints and axes of the view fix it; otherwise it is one of a continuum.
    """

    T_Rb_camera: RigidTransform
    fixed: bool


def camera_starts(
    A_Rb: Array, v_Rb: Array, A_camera: Array, v_camera: Array, *, signed: bool = False
) -> list[CameraStart]:
    """Return where a camera may have stood, the most likely place first.

    Parameters
    ----------
    A_Rb, A_camera : (n, 3) array
        The located joints of a view in R_b, as a model has them, and in its camera frame [m].
    v_Rb, v_camera : (r, 3) array
        The located revolute axes in both frames.
    signed : bool
        Their signs are known; otherwise they are lines.

    Returns
    -------
    list of CameraStart
        Empty for fewer than two joints apart from each other. Several only where joints on one
        line and the axes of their legs leave several turns about it that are nearly alike.
    """
    if len(A_Rb) < 2:
        return []
    centred = A_Rb - A_Rb.mean(axis=0)
    _, spread, directions = np.linalg.svd(centred)
    size = float(np.linalg.norm(A_Rb, axis=1).max())
    if spread[0] <= 1e-6 * size:
        return []
    if len(A_Rb) > 2 and spread[1] > _ON_A_LINE * spread[0]:
        return [CameraStart(register_points(A_camera, A_Rb), True)]
    line = directions[0]
    across = np.linalg.norm(np.cross(v_Rb, line), axis=1) > _ALONG
    first = _laid_along(A_Rb, line, A_camera)
    if not across.any():
        return [CameraStart(first.inv(), False)]
    along = first.rotation.apply(line)
    turns = _alike_turns(along, first.rotation.apply(v_Rb[across]), v_camera[across], signed)
    middle = A_camera.mean(axis=0)
    return [
        CameraStart((_about(middle, Rotation.from_rotvec(turn * along)) * first).inv(), True)
        for turn in turns
    ]


def signs_seen(v_Rb: Array, v_camera: Array, T_Rb_camera: RigidTransform) -> Array:
    """Return +1 or -1 for each axis (r, 3): with it, v_camera points to the side of v_Rb."""
    predicted = T_Rb_camera.rotation.inv().apply(v_Rb)
    return np.where(np.sum(predicted * v_camera, axis=1) < 0.0, -1.0, 1.0)


def _laid_along(A_Rb: Array, line: Array, A_camera: Array) -> RigidTransform:
    """Return a T_camera_Rb that lays joints along a line on those seen, turned about it anyhow."""
    height = (A_Rb - A_Rb.mean(axis=0)) @ line
    seen = height @ (A_camera - A_camera.mean(axis=0))
    seen /= np.linalg.norm(seen)
    frames = [np.column_stack([direction, *normal_basis(direction)]) for direction in (seen, line)]
    rotation = Rotation.from_matrix(frames[0] @ frames[1].T)
    shift = A_camera.mean(axis=0) - rotation.apply(A_Rb.mean(axis=0))
    return RigidTransform.from_components(shift, rotation)


def _alike_turns(along: Array, v: Array, seen: Array, signed: bool) -> Array:
    """Return the turns about a unit vector that lay axes v (r, 3) on those seen, best first."""
    turn = 2.0 * np.pi / _TURNS * np.arange(_TURNS)
    axial = (v @ along)[:, None] * along
    across = v - axial
    product = (
        np.sum(seen * axial, axis=1)
        + np.cos(turn)[:, None] * np.sum(seen * across, axis=1)
        + np.sin(turn)[:, None] * np.sum(seen * np.cross(along, across), axis=1)
    )
    miss = 1.0 - np.mean(np.maximum(product, 0.0) ** 2 if signed else product**2, axis=1)
    least = np.flatnonzero((miss <= np.roll(miss, 1)) & (miss < np.roll(miss, -1)))
    least = least[np.argsort(miss[least], kind="stable")]
    return np.asarray(turn[least[miss[least] < miss.min() + _ALIKE]])


def _about(point: Array, rotation: Rotation) -> RigidTransform:
    """Return a rotation about a point."""
    return RigidTransform.from_components(point - rotation.apply(point), rotation)
