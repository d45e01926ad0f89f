"""Candidate camera poses from observed base joints and axes, in closed form.

Three joints not on a line determine the pose. Joints on one line leave a rotation about it, which
revolute axes across the line determine as lines: often uniquely, sometimes with several nearly
equal solutions, such as both sides of the plane of a planar machine.
"""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import RigidTransform, Rotation

from legcal.geometry.lines import cross
from legcal.geometry.motions import register_points
from legcal.geometry.types import Array
from legcal.paper.gibbs import axis_frames

_ON_A_LINE = 0.05  # maximum ratio of the spreads of collinear joints across and along their line
_ALONG = 0.1  # minimum sine of the angle between the line and an axis that determines a camera
_MAX_DIFFERENCE = 0.07  # between mean squared sines of angles to axes of equivalent candidates
_TURNS = 720


def candidate_camera_poses(
    A_Rb: Array, v_Rb: Array, A_camera: Array, v_camera: Array
) -> tuple[list[RigidTransform], bool]:
    """Return the candidates of T_Rb_camera, most likely first, and whether they are all.

    Joints (n, 3) and revolute axes (r, 3) of a view are given in the model and in the camera; axes
    are lines without a sign. There are no candidates for fewer than two separate joints.
    The flag is False if the pose is one of a continuum, rotated about the line of the joints.
    """
    if len(A_Rb) < 2:
        return [], False
    _, spread, directions = np.linalg.svd(A_Rb - A_Rb.mean(axis=0))
    if spread[0] <= 1e-6 * float(np.linalg.norm(A_Rb, axis=1).max()):
        return [], False
    if len(A_Rb) > 2 and spread[1] > _ON_A_LINE * spread[0]:
        return [register_points(A_camera, A_Rb)], True
    line = directions[0]
    across = np.linalg.norm(cross(v_Rb, line), axis=1) > _ALONG
    T_camera_Rb = _laid_along(A_Rb, line, A_camera)
    if not across.any():
        return [T_camera_Rb.inv()], False
    along, middle = T_camera_Rb.rotation.apply(line), A_camera.mean(axis=0)
    v = T_camera_Rb.rotation.apply(v_Rb[across])
    poses = []
    for turn in _candidate_turns(along, v, v_camera[across]):
        rotation = Rotation.from_rotvec(turn * along)
        about = RigidTransform.from_components(middle - rotation.apply(middle), rotation)
        poses.append((about * T_camera_Rb).inv())
    return poses, True


def signs_seen(v_Rb: Array, v_camera: Array, T_Rb_camera: RigidTransform) -> Array:
    """Return +1 or -1 for each axis (r, 3): with it, v_camera points to the side of v_Rb."""
    predicted = T_Rb_camera.rotation.inv().apply(v_Rb)
    return np.where(np.sum(predicted * v_camera, axis=1) < 0.0, -1.0, 1.0)


def _laid_along(A_Rb: Array, line: Array, A_camera: Array) -> RigidTransform:
    """Return a T_camera_Rb that aligns collinear joints, with any rotation about their line."""
    height = (A_Rb - A_Rb.mean(axis=0)) @ line
    seen_line = height @ (A_camera - A_camera.mean(axis=0))
    of_seen, of_line = axis_frames(np.array([seen_line / np.linalg.norm(seen_line), line]))
    rotation = Rotation.from_matrix(of_seen @ of_line.T)
    shift = A_camera.mean(axis=0) - rotation.apply(A_Rb.mean(axis=0))
    return RigidTransform.from_components(shift, rotation)


def _candidate_turns(along: Array, v: Array, v_seen: Array) -> Array:
    """Return the rotations about a unit vector that align axes v (r, 3) with v_seen, best first."""
    turn = 2.0 * np.pi / _TURNS * np.arange(_TURNS)
    axial = (v @ along)[:, None] * along
    across = v - axial
    product = (
        np.sum(v_seen * axial, axis=1)
        + np.cos(turn)[:, None] * np.sum(v_seen * across, axis=1)
        + np.sin(turn)[:, None] * np.sum(v_seen * cross(along, across), axis=1)
    )
    error = 1.0 - np.mean(product**2, axis=1)
    least = np.flatnonzero((error <= np.roll(error, 1)) & (error < np.roll(error, -1)))
    least = least[np.argsort(error[least], kind="stable")]
    return np.asarray(turn[least[error[least] < error.min() + _MAX_DIFFERENCE]])
