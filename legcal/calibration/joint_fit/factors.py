"""The factors of the joint fit: outlines, readings, axes, and corners of a calibration board.

A measurement in an image depends on both ends of a leg in the camera frame; these depend on
joints, camera and platform pose. Rotations change by Cayley's map from the left: a camera turns in
its own frame, a platform about the origin of R_e in the directions of R_b. The residuals are
CasADi functions; the chain rule around them is written out.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache, lru_cache, partial
from typing import Any

import casadi as ca
import numpy as np

from legcal.calibration.joint_fit.observations import (
    ObservedAxes,
    ObservedBoard,
    ObservedOutlines,
    Readings,
)
from legcal.calibration.joint_fit.state import State
from legcal.estimation import Factor, Rows
from legcal.geometry import Array, IntArray, cross
from legcal.vision import Camera, intrinsic_names, undistort_derivatives

_SIX, _ALL, _ONE = slice(0, 6), slice(None), slice(0, 1)


@dataclass(frozen=True, eq=False)
class Residual:
    """A CasADi residual of one measurement, evaluated for many at once."""

    n_local: int  # numbers that it depends on
    n_rows: int
    jacobian: ca.Function  # (local, data) -> residual and its dense Jacobian by local

    def evaluate(self, local: Array, data: Array) -> tuple[Array, Array]:
        """Return residuals (n, n_rows) and Jacobians (n, n_rows, n_local) of n measurements."""
        n = len(local)
        r = np.zeros((n, self.n_rows))
        by_local = np.zeros((n, self.n_local, self.n_rows))  # CasADi stores column by column
        if n:
            buffer: Any
            buffer, evaluate = _mapped(self, n).buffer()  # on NumPy's memory, without copies
            kept = [np.ascontiguousarray(array, dtype=np.float64) for array in (local, data)]
            for i, array in enumerate(kept):
                buffer.set_arg(i, array.data)
            for i, array in enumerate((r, by_local)):
                buffer.set_res(i, array.data)
            evaluate()
        return r, np.swapaxes(by_local, 1, 2)


@lru_cache(maxsize=64)
def _mapped(residual: Residual, n: int) -> ca.Function:
    """Return the Jacobian over n measurements."""
    return residual.jacobian.map(n)


def _residual(name: str, local: ca.SX, data: ca.SX, r: ca.SX) -> Residual:
    by_local = ca.densify(ca.jacobian(r, local))
    function = ca.Function(f"{name}_jacobian", [local, data], [r, by_local], {"cse": True})
    return Residual(local.size1(), r.size1(), function)


def outline_of_leg(A: ca.SX, B: ca.SX, radius: ca.SX, epsilon: ca.SX) -> ca.SX:
    """Return the outline h of the cylinder about AB seen from the origin, eqs (1) and (3).

    Its length is that of A x B squared, of no matter for a line. With n = A x B and D = B - A
    eq (3) is h = epsilon r (D x n) - n sqrt(|n|^2 - |D|^2 r^2) up to that, without a division.
    """
    n, D = ca.cross(A, B), B - A
    depth = ca.sqrt(ca.dot(n, n) - radius**2 * ca.dot(D, D))
    return epsilon * radius * ca.cross(D, n) - depth * n


def offset_in_image(h: ca.SX, xy: ca.SX, J_inverse_transposed: ca.SX) -> ca.SX:
    """Return the signed distance [px] of a point of the sensor plane from the line h.

    The same as :meth:`legcal.vision.camera.Camera.line_offset`, with the derivative of the
    lens at the point given as a constant.
    """
    normal = J_inverse_transposed @ h[:2]
    return (h[0] * xy[0] + h[1] * xy[1] + h[2]) / ca.norm_2(normal)


@cache
def outline_residual() -> Residual:
    """Return the distances [px] of the predicted outline from both ends of the measured one.

    local (11): A and B in the camera frame, radius [m], both ends on the sensor plane. data (9):
    J^-T at the ends (2 x 4, column by column), epsilon.
    """
    local, data = ca.SX.sym("local", 11), ca.SX.sym("data", 9)
    h = outline_of_leg(local[0:3], local[3:6], local[6], data[8])
    offsets = [
        offset_in_image(
            h, local[7 + 2 * end : 9 + 2 * end], ca.reshape(data[4 * end : 4 + 4 * end], 2, 2)
        )
        for end in range(2)
    ]
    return _residual("outline", local, data, ca.vertcat(*offsets))


@cache
def axis_residual() -> Residual:
    """Return how far a leg's predicted axis is from a measured one: alpha1, alpha2, beta1, beta2.

    The measured axis passes through M along e1 x e2. alpha is the predicted direction in e1 and
    e2, over its part along the axis; beta is where the predicted axis meets the plane through
    M with these directions, from M [m].

    local (6): A and B in the camera frame [m]. data (9): M, e1, e2.
    """
    local, data = ca.SX.sym("local", 6), ca.SX.sym("data", 9)
    A, leg = local[0:3], local[3:6] - local[0:3]
    M, e1, e2 = data[0:3], data[3:6], data[6:9]
    basis, along = ca.horzcat(e1, e2).T, ca.cross(e1, e2)
    slope = leg / ca.dot(along, leg)
    to_A = A - M
    beta = basis @ (to_A - slope * ca.dot(along, to_A))
    return _residual("axis", local, data, ca.vertcat(basis @ slope, beta))


@cache
def corner_residual() -> Residual:
    """Return how far a predicted corner of the calibration board is from the measured one [px].

    local (5): the corner in the camera frame [m], the measured one on the sensor plane. data (4):
    the derivative of pixels by the sensor plane there (2 x 2, column by column).
    """
    local, data = ca.SX.sym("local", 5), ca.SX.sym("data", 4)
    away = local[:2] / local[2] - local[3:]
    return _residual("corner", local, data, ca.reshape(data, 2, 2) @ away)


@cache
def encoder_residual() -> Residual:
    """Return the closure of a leg, |AB| - sign q - q0 [m].

    local (7): A and B in R_b, q0 [m]. data (1): sign * q [m].
    """
    local, data = ca.SX.sym("local", 7), ca.SX.sym("data", 1)
    closure = ca.norm_2(local[3:6] - local[0:3]) - data - local[6]
    return _residual("encoder", local, data, closure)


def outline_factor(
    o: ObservedOutlines, whitening: Array | float, keys: tuple[str, ...]
) -> Factor[State]:
    """Return the factor of outlines; *keys* are the intrinsics that may be unknown."""
    touches = (
        ("legs", o.leg, _SIX),
        ("camera_pose", o.view, _ALL),
        ("radii", o.radius, _ONE),
        ("biases", o.bias_index, _ONE),
        ("cameras", o.view, _ALL),
    )
    rows = partial(outline_rows, o, keys)
    return Factor("outlines", rows, touches, len(o), 2, o.pose, whitening, robust=True)


def outline_rows(o: ObservedOutlines, keys: tuple[str, ...], state: State) -> Rows:
    """Return the offsets (n, 2) [px] of all outlines with their derivatives."""
    ends = _ends_in_camera(state, o.leg, o.view, o.pose)
    xy, by_intrinsics = on_sensor(state.cameras, keys, o.view, o.feet, o.pixels)
    n = len(o)
    radius = state.radii[o.radius, None]
    local = np.concatenate([ends.A, ends.B, radius, xy.reshape(n, 4)], axis=1)
    r, slope = outline_residual().evaluate(local, o.constants)
    if not o.bias_index.shape[1] and not keys:
        return Rows(r, slope[..., :7], ends.with_others)
    r = r - np.einsum("nc,ncq->nq", state.biases[o.bias_index], o.bias_shift)
    along = slope[..., 7:].reshape(n, 2, 2, 2)  # by (end, coordinate)
    others = [
        -np.swapaxes(o.bias_shift, 1, 2),
        np.einsum("nqec,neck->nqk", along, by_intrinsics),
    ]
    return Rows(r, np.concatenate([slope[..., :7], *others], axis=-1), ends.with_others)


def reading_factor(e: Readings) -> Factor[State]:
    """Return the factor of encoder readings."""

    def rows(state: State) -> Rows:
        arm, R_pose = state.arms[e.pose, e.leg], state.platform_pose.R[e.pose]
        B = state.platform_pose.t[e.pose] + arm
        local = np.column_stack([state.A[e.leg], B, state.lengths[e.leg]])
        r, slope = encoder_residual().evaluate(local, e.length[:, None])

        def chain(slope: Array) -> tuple[Array, Array]:
            b = slope[..., 3:6]
            J = np.concatenate([slope[..., :3], b @ R_pose, slope[..., 6:]], axis=-1)
            return J, np.concatenate([cross(arm[:, None], b), b], axis=-1)

        return Rows(r, slope, chain)

    touches = (("legs", e.leg, slice(0, 7)),)
    return Factor("readings", rows, touches, len(e), 1, e.pose, 1.0 / e.sigma)


def axis_factor(a: ObservedAxes) -> Factor[State]:
    """Return the factor of measured axes."""
    data = np.concatenate([a.M, a.basis.reshape(-1, 6)], axis=1)

    def rows(state: State) -> Rows:
        ends = _ends_in_camera(state, a.leg, a.view, a.pose)
        r, slope = axis_residual().evaluate(np.concatenate([ends.A, ends.B], axis=1), data)
        return Rows(r, slope, ends.by_unknowns)

    touches = (("legs", a.leg, _SIX), ("camera_pose", a.view, _ALL))
    return Factor("axes", rows, touches, len(a), 4, a.pose, a.whitening, robust=True)


def corner_factor(c: ObservedBoard, keys: tuple[str, ...]) -> Factor[State]:
    """Return the factor of the corners of a calibration board; no platform pose moves them."""
    one = np.zeros(len(c), dtype=np.intp)
    touches = (
        ("camera_pose", c.view, _ALL),
        ("board_pose", one, _ALL),
        ("board_scale", one, _ALL),
        ("cameras", c.view, _ALL),
    )
    rows = partial(_corner_rows, c, keys)
    whitening = 1.0 / c.sigma[:, None, None]
    return Factor("corners", rows, touches, len(c), 2, None, whitening, robust=True)


def _corner_rows(c: ObservedBoard, keys: tuple[str, ...], state: State) -> Rows:
    R_camera = state.camera_pose.R[c.view]
    arm = c.point @ state.board_pose.R[0].T
    grown = state.board_scale[0] * arm
    turned = _times(R_camera, grown + state.board_pose.t)
    xy, by_intrinsics = on_sensor(state.cameras, keys, c.view, c.feet, c.pixels)
    local = np.concatenate([turned + state.camera_pose.t[c.view], xy], axis=1)
    r, slope = corner_residual().evaluate(local, c.constants)

    def chain(slope: Array) -> tuple[Array, Array]:
        in_camera = slope[..., :3]
        in_base = in_camera @ R_camera
        J = [
            cross(turned[:, None], in_camera),
            in_camera,
            cross(grown[:, None], in_base),
            in_base,
            in_base @ arm[..., None],
            slope[..., 3:] @ by_intrinsics,
        ]
        return np.concatenate(J, axis=-1), np.zeros((*slope.shape[:2], 6))

    return Rows(r, slope, chain)


def on_sensor(
    cameras: Sequence[Camera], keys: tuple[str, ...], view: IntArray, feet: Array, pixels: Array
) -> tuple[Array, Array]:
    """Return points (n, ..., 2) of images on the sensor plane, and (n, ..., 2, n_keys).

    The latter is how they move with intrinsics; without any these are where they were put.
    """
    xy, slopes = feet.copy(), np.zeros((*feet.shape, len(keys)))
    if not keys:
        return xy, slopes
    for v in np.unique(view):
        camera, of_view = cameras[v], view == v
        known = [k for k, key in enumerate(keys) if key in intrinsic_names(camera)]
        seen = pixels[of_view]
        xy[of_view] = camera.undistort(seen)
        some = np.zeros((*seen.shape, len(keys)))
        some[..., known] = undistort_derivatives(camera, seen, [keys[k] for k in known])
        slopes[of_view] = some
    return xy, slopes


@dataclass(frozen=True, eq=False)
class _Ends:
    """Both ends of legs in the camera frame, and what their derivatives are made of."""

    A: Array  # (n, 3) from the camera, in its directions, and B likewise
    B: Array
    A_turned: Array  # without the camera's place
    B_turned: Array
    arm: Array  # (n, 3) from the origin of R_e to B, in R_b
    R_camera: Array  # (n, 3, 3)
    R_pose: Array

    def with_others(self, slope: Array) -> tuple[Array, Array]:
        """Return the same with what comes after the ends: radius, biases, intrinsics."""
        J, J_pose = self.by_unknowns(slope[..., :6])
        return np.concatenate([J, slope[..., 6:]], axis=-1), J_pose

    def by_unknowns(self, slope: Array) -> tuple[Array, Array]:
        """Return derivatives by A, B, camera and by the pose from those by both ends."""
        by_A, by_B = slope[..., :3], slope[..., 3:6]
        a, b = by_A @ self.R_camera, by_B @ self.R_camera
        turn = cross(self.A_turned[:, None], by_A) + cross(self.B_turned[:, None], by_B)
        J = np.concatenate([a, b @ self.R_pose, turn, by_A + by_B], axis=-1)
        return J, np.concatenate([cross(self.arm[:, None], b), b], axis=-1)


def _ends_in_camera(state: State, leg: IntArray, view: IntArray, pose: IntArray) -> _Ends:
    """Return both ends of legs in the camera frames of views at poses."""
    R_camera, t = state.camera_pose.R[view], state.camera_pose.t[view]
    arm = state.arms[pose, leg]
    A = (state.A @ np.swapaxes(state.camera_pose.R, 1, 2))[view, leg]
    B = _times(R_camera, state.platform_pose.t[pose] + arm)
    return _Ends(A + t, B + t, A, B, arm, R_camera, state.platform_pose.R[pose])


def _times(R: Array, v: Array) -> Array:
    """Return R v of rows, (n, 3)."""
    return np.asarray((R @ v[..., None])[..., 0])
