"""Where a camera may have stood that saw some of the base joints and axes, in closed form.

Three joints not on a line fix it. Joints on one line leave a turn about it, which revolute axes
across the line fix as lines: often one way, sometimes in several that look nearly alike. In a
planar machine, where all axes are normal to the line, the two sides of the plane end the legs
in mirrored places: laid on these, the nominal platform contradicts the readings on the wrong one.
"""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import RigidTransform, Rotation

from legcal.data.axes import LegAxes
from legcal.data.measurements import Measurements
from legcal.geometry.lines import cross
from legcal.geometry.motions import register_points
from legcal.geometry.types import Array, IntArray
from legcal.paper.gibbs import axis_frames
from legcal.paper.nominal import NominalMachine

_ON_A_LINE = 0.05  # spread of joints across their line, in that along it
_ALONG = 0.1  # sine of the angle between an axis and the line: less does not fix a camera
_MAX_DIFFERENCE = 0.07  # of the mean squared sine of angles between axes, of alike candidates
_TURNS = 720
_MAX_RATIO = 0.25  # squared errors of lengths, in those from the other side


def candidate_camera_poses(
    A_Rb: Array, v_Rb: Array, A_camera: Array, v_camera: Array, *, signed: bool = False
) -> tuple[list[RigidTransform], bool]:
    """Return the T_Rb_camera where a camera may have stood, most likely first, and if that is all.

    Joints (n, 3) and revolute axes (r, 3) of a view, as a model has them and as it sees them;
    axes are lines unless they are ``signed``. There is none for fewer than two separate joints.
    The flag is False where the pose is one of a continuum, turned about the line of the joints.
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
    for turn in _candidate_turns(along, v, v_camera[across], signed):
        rotation = Rotation.from_rotvec(turn * along)
        about = RigidTransform.from_components(middle - rotation.apply(middle), rotation)
        poses.append((about * T_camera_Rb).inv())
    return poses, True


def signs_seen(v_Rb: Array, v_camera: Array, T_Rb_camera: RigidTransform) -> Array:
    """Return +1 or -1 for each axis (r, 3): with it, v_camera points to the side of v_Rb."""
    predicted = T_Rb_camera.rotation.inv().apply(v_Rb)
    return np.where(np.sum(predicted * v_camera, axis=1) < 0.0, -1.0, 1.0)


def _laid_along(A_Rb: Array, line: Array, A_camera: Array) -> RigidTransform:
    """Return a T_camera_Rb that lays joints along a line on those seen, turned about it anyhow."""
    height = (A_Rb - A_Rb.mean(axis=0)) @ line
    seen = height @ (A_camera - A_camera.mean(axis=0))
    of_seen, of_line = axis_frames(np.array([seen / np.linalg.norm(seen), line]))
    rotation = Rotation.from_matrix(of_seen @ of_line.T)
    shift = A_camera.mean(axis=0) - rotation.apply(A_Rb.mean(axis=0))
    return RigidTransform.from_components(shift, rotation)


def _candidate_turns(along: Array, v: Array, seen: Array, signed: bool) -> Array:
    """Return the turns about a unit vector that lay axes v (r, 3) on those seen, best first."""
    turn = 2.0 * np.pi / _TURNS * np.arange(_TURNS)
    axial = (v @ along)[:, None] * along
    across = v - axial
    product = (
        np.sum(seen * axial, axis=1)
        + np.cos(turn)[:, None] * np.sum(seen * across, axis=1)
        + np.sin(turn)[:, None] * np.sum(seen * cross(along, across), axis=1)
    )
    error = 1.0 - np.mean(np.maximum(product, 0.0) ** 2 if signed else product**2, axis=1)
    least = np.flatnonzero((error <= np.roll(error, 1)) & (error < np.roll(error, -1)))
    least = least[np.argsort(error[least], kind="stable")]
    return np.asarray(turn[least[error[least] < error.min() + _MAX_DIFFERENCE]])


def side_of_plane(
    machine: NominalMachine,
    axes: LegAxes,
    measurements: Measurements,
    A_camera: Array,
    normal: Array,
    legs: IntArray,
) -> float:
    """Return the sign with which a normal points up in R_b, zero where nothing shows it.

    ``axes`` are those of one view of a planar machine; ``A_camera`` (n, 3) are the joints of
    ``legs`` (n,) that it locates, and ``normal`` (3,) is that of the plane, of any sign.
    """
    A_Rb, up = machine.parameters.base_joints[legs], np.tile([0.0, 0.0, 1.0], (len(legs), 1))
    errors = []
    for sign in (1.0, -1.0):
        seen = np.tile(sign * normal, (len(legs), 1))
        poses, _ = candidate_camera_poses(A_Rb, up, A_camera, seen, signed=True)
        if not poses:
            return 0.0
        errors.append(_length_errors(machine, axes, measurements, poses[0], A_camera, legs))
    if max(errors) == 0.0 or min(errors) > _MAX_RATIO * max(errors):
        return 0.0
    return 1.0 if errors[0] < errors[1] else -1.0


def _length_errors(
    machine: NominalMachine,
    axes: LegAxes,
    measurements: Measurements,
    T_Rb_camera: RigidTransform,
    A_camera: Array,
    legs: IntArray,
) -> float:
    """Return the sum of squared errors of leg lengths from one side [m^2]."""
    parameters, total = machine.parameters, 0.0
    place = np.full(machine.n_legs, -1)
    place[legs] = np.arange(len(legs))
    q = np.where(machine.constant, 0.0, machine.sign * measurements.q)
    # Points of the plane are complex numbers x + i y here.
    A, B = (P[:, 0] + 1j * P[:, 1] for P in (parameters.base_joints, parameters.platform_joints))
    for row in np.unique(axes.row):
        length = q[row] + machine.offsets
        here = np.flatnonzero((axes.row == row) & (place[axes.leg] >= 0))
        here = here[np.isfinite(length[axes.leg[here]])]
        if len(here) < 2:
            continue
        leg = axes.leg[here]
        ends = T_Rb_camera.apply(A_camera[place[leg]] + length[leg, None] * axes.u[here])
        seen = ends[:, 0] + 1j * ends[:, 1]
        middle = B[leg].mean()
        turn = np.sum(np.conj(B[leg] - middle) * (seen - seen.mean()))
        size = np.abs(turn)
        laid = seen.mean() + (turn / size if size > 0.0 else 1.0) * (B - middle)
        error = np.abs(laid - A) - length
        total += float(np.sum(error[np.isfinite(error)] ** 2))
    return total
