"""From which side a camera sees the plane of a planar mechanism, where joints do not say it.

Two joints, or joints on one line, look the same from both sides. But the legs then end in mirrored
places: laid on these, the nominal platform puts the ends of all legs where their lengths contradict
the readings, if it is the wrong side.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache

import casadi as ca
import numpy as np
from scipy.spatial.transform import RigidTransform, Rotation

from legcal.data import LegAxes, Measurements
from legcal.geometry import Array, BoolArray, IntArray, normal_basis, register_points
from legcal.machine import free_coordinates
from legcal.paper.nominal import NominalMechanism
from legcal.paper.solver import Solution


@dataclass(frozen=True, eq=False)
class BaseUnknowns:
    """Where coordinates of A and turns of v stand among the unknowns, and where they start.

    Attributes
    ----------
    joints : (n_legs, 3) array of int
        Places of the coordinates of A, leg by leg; -1 where they are known.
    axes : (n_legs, 2) array of int
        Places of the turns of v about the normal basis of its nominal direction, after those of
        all joints; -1 for legs without a revolute axis.
    A_nominal : (n_legs, 3) array
        Nominal centres in R_b [m], with the values of known coordinates.
    v_nominal : (n_legs, 3) array
        Nominal axes in R_b, see :func:`nominal_axes`.
    """

    joints: IntArray
    axes: IntArray
    A_nominal: Array
    v_nominal: Array

    @classmethod
    def of(cls, mechanism: NominalMechanism) -> BaseUnknowns:
        """Return the unknowns of a mechanism."""
        free = free_coordinates(mechanism.n_legs, mechanism.frame_legs)
        turned = np.repeat(mechanism.revolute[:, None], 2, axis=1)
        return cls(
            _numbered(free, 0),
            _numbered(turned, int(free.sum())),
            mechanism.parameters.base_joints,
            nominal_axes(mechanism),
        )

    def __len__(self) -> int:
        return int(np.sum(self.joints >= 0) + np.sum(self.axes >= 0))

    @property
    def known(self) -> Array:
        """Known coordinates of A, zero for unknown ones, (n_legs, 3) [m]."""
        return np.where(self.joints < 0, self.A_nominal, 0.0)

    @property
    def frames(self) -> Array:
        """Nominal axis and its normal basis as columns, (n_legs, 3, 3); zero without an axis."""
        frames = np.zeros((len(self.axes), 3, 3))
        for j in np.flatnonzero(np.isfinite(self.v_nominal[:, 0])):
            v = self.v_nominal[j]
            frames[j] = np.column_stack([v, *normal_basis(v)])
        return frames

    @property
    def start(self) -> Array:
        """The nominal values of the unknowns, (n,) [m, rad]."""
        return np.concatenate(
            [self.A_nominal[self.joints >= 0], np.zeros(int(np.sum(self.axes >= 0)))]
        )

    def joints_at(self, x: Array) -> Array:
        """Return A in R_b, (n_legs, 3) [m], from unknowns of which these are the first."""
        return np.where(self.joints >= 0, x[self.joints], self.A_nominal)

    def axes_at(self, x: Array) -> Array:
        """Return v in R_b, (n_legs, 3), from unknowns of which these are the first."""
        turns = np.where(self.axes >= 0, x[self.axes], 0.0)
        axes = self.v_nominal.copy()
        for j in np.flatnonzero(self.axes[:, 0] >= 0):
            axes[j] = np.array(_axis_of_turns()(turns[j], self.frames[j])).ravel()
        return axes

    def axis_covariance(self, solution: Solution) -> Array:
        """Return the covariance of v in R_b, (n_legs, 3, 3) [rad^2]; zero for legs without one."""
        turns = np.where(self.axes >= 0, solution.x[self.axes], 0.0)
        of_turns, found = solution.covariance(), np.zeros((len(self.axes), 3, 3))
        for j in np.flatnonzero(self.axes[:, 0] >= 0):
            slope = np.array(_slope_of_turns()(turns[j], self.frames[j]))
            found[j] = slope @ of_turns[np.ix_(self.axes[j], self.axes[j])] @ slope.T
        return found


def nominal_axes(mechanism: NominalMechanism) -> Array:
    """Return revolute axes at the base in R_b, (n_legs, 3), those of a plane included.

    They are z in a planar mechanism, where they are no parameters; NaN for other joints.
    """
    if mechanism.spatial:
        return mechanism.base_axes
    return np.tile([0.0, 0.0, 1.0], (mechanism.n_legs, 1))


def turned_axis(turns: ca.SX, frame: ca.SX) -> ca.SX:
    """Return a unit axis turned from its nominal direction.

    Parameters
    ----------
    turns : (2, 1) SX
        Turns w_1, w_2 about the normal basis [rad], as 2 tan(angle / 2) along w_1 e_1 + w_2 e_2:
        to second order those of :mod:`legcal.machine.parameters`, and without a square root.
    frame : (3, 3) SX
        The nominal axis and its normal basis as columns.

    Returns
    -------
    (3, 1) SX
    """
    v, w = frame[:, 0], 0.5 * frame[:, 1:] @ turns
    across = ca.cross(w, v)
    return v + 2.0 / (1.0 + ca.dot(w, w)) * (across + ca.cross(w, across))


@cache
def _axis_of_turns() -> ca.Function:
    """Return (turns, frame) -> v, for numbers."""
    turns, frame = ca.SX.sym("turns", 2), ca.SX.sym("frame", 3, 3)
    return ca.Function("axis", [turns, frame], [turned_axis(turns, frame)])


@cache
def _slope_of_turns() -> ca.Function:
    """Return (turns, frame) -> derivative of v by the turns, (3, 2), for numbers."""
    turns, frame = ca.SX.sym("turns", 2), ca.SX.sym("frame", 3, 3)
    return ca.Function("slope", [turns, frame], [ca.jacobian(turned_axis(turns, frame), turns)])


def _numbered(free: BoolArray, first: int) -> IntArray:
    """Return consecutive numbers where something is free, -1 elsewhere."""
    numbers = np.full(free.shape, -1, dtype=np.intp)
    numbers[free] = first + np.arange(free.sum())
    return numbers


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


_DECIDED = 0.25  # squared errors of lengths, in those from the other side


def side_of_plane(
    mechanism: NominalMechanism,
    axes: LegAxes,
    measurements: Measurements,
    A_camera: Array,
    normal: Array,
    legs: IntArray,
) -> float:
    """Return the sign with which a normal points up in R_b, zero where nothing says it.

    Parameters
    ----------
    mechanism : NominalMechanism
        Its legs, of a planar mechanism.
    axes : LegAxes
        The axes of one view.
    measurements : Measurements
        Readings of the images.
    A_camera : (n, 3) array
        The located joints of the view in the camera frame [m].
    normal : (3,) array
        The normal of the plane there, of any sign.
    legs : (n,) array of int
        The legs of the joints.
    """
    A_Rb, up = mechanism.parameters.base_joints[legs], np.array([0.0, 0.0, 1.0])
    errors = []
    for sign in (1.0, -1.0):
        seen = np.tile(sign * normal, (len(legs), 1))
        starts = camera_starts(A_Rb, np.tile(up, (len(legs), 1)), A_camera, seen, signed=True)
        if not starts:
            return 0.0
        errors.append(_error(mechanism, axes, measurements, starts[0].T_Rb_camera, A_camera, legs))
    if max(errors) == 0.0 or min(errors) > _DECIDED * max(errors):
        return 0.0
    return 1.0 if errors[0] < errors[1] else -1.0


def _error(
    mechanism: NominalMechanism,
    axes: LegAxes,
    measurements: Measurements,
    T_Rb_camera: RigidTransform,
    A_camera: Array,
    legs: IntArray,
) -> float:
    """Return the sum of squared errors of leg lengths from one side [m^2]."""
    parameters, total = mechanism.parameters, 0.0
    place = np.full(mechanism.n_legs, -1)
    place[legs] = np.arange(len(legs))
    q = np.where(mechanism.constant, 0.0, mechanism.sign * measurements.q)
    A, B = (_in_plane(P) for P in (parameters.base_joints, parameters.platform_joints))
    for row in np.unique(axes.row):
        length = q[row] + parameters.offsets
        here = np.flatnonzero((axes.row == row) & (place[axes.leg] >= 0))
        here = here[np.isfinite(length[axes.leg[here]])]
        if len(here) < 2:
            continue
        leg = axes.leg[here]
        ends = T_Rb_camera.apply(A_camera[place[leg]] + length[leg, None] * axes.u[here])
        placed = _laid(B, leg, _in_plane(ends))
        miss = np.abs(placed - A) - length
        total += float(np.sum(miss[np.isfinite(miss)] ** 2))
    return total


def _laid(B: Array, leg: IntArray, ends: Array) -> Array:
    """Return points of a plane moved so that those of some legs lie on their ends, all complex."""
    middle, centre = B[leg].mean(), ends.mean()
    turn = np.sum(np.conj(B[leg] - middle) * (ends - centre))
    size = np.abs(turn)
    return np.asarray(centre + (turn / size if size > 0.0 else 1.0) * (B - middle))


def _in_plane(points: Array) -> Array:
    """Return points (n, 3) as complex numbers x + i y."""
    return np.asarray(points[:, 0] + 1j * points[:, 1])
