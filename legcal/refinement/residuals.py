"""The residuals of the fit, one small pure CasADi function for each kind of measurement.

Every function takes ``(local, data)``: *local* are the unknowns that one measurement
depends on, as changes in mm and mrad around a reference; *data* holds that reference, what was
measured and its weight. The last entry of *data* is the narrowness k of the robust loss
(:mod:`legcal.refinement.loss`); residuals do not use it. Rotations are changed by Cayley's map,
which is the rotation vector to second order, has no singularity short of half a turn
and needs no trigonometry.
"""

from dataclasses import dataclass
from functools import cache

import casadi as ca

UNIT = 1e-3  # [m] or [rad] for one unit of a local unknown: mm and mrad


@dataclass(frozen=True, eq=False)
class Residual:
    """A kind of measurement.

    Attributes
    ----------
    name : str
    n_local, n_data, n_rows : int
        Sizes of the unknowns, of the data and of the whitened residual.
    function : casadi.Function
        (local, data) -> whitened residual.
    """

    name: str
    n_local: int
    n_data: int
    n_rows: int
    function: ca.Function


def rotation_of(w: ca.SX) -> ca.SX:
    """Return Cayley's rotation matrix of a small rotation vector [rad]."""
    g = w / 2.0
    K = ca.skew(g)
    return ca.SX.eye(3) + 2.0 / (1.0 + ca.sumsqr(g)) * (K + K @ K)


def moved_frame(change: ca.SX, reference: ca.SX) -> tuple[ca.SX, ca.SX]:
    """Return rotation and translation of a frame changed by (w, t) around its reference.

    The reference is the rotation matrix, column by column, and the translation [m].
    """
    R = rotation_of(UNIT * change[:3]) @ ca.reshape(reference[:9], 3, 3)
    return R, reference[9:12] + UNIT * change[3:6]


def outline_of_leg(A: ca.SX, B: ca.SX, radius: ca.SX, epsilon: ca.SX) -> ca.SX:
    """Return the outline h of the cylinder about AB seen from the origin, eqs (1) and (3)."""
    u = (B - A) / ca.norm_2(B - A)
    foot = A - u * ca.dot(u, A)
    distance = ca.norm_2(foot)
    sine = radius / distance
    return ca.sqrt(1.0 - sine**2) * ca.cross(u, A) / distance + epsilon * sine * foot / distance


def offset_in_image(h: ca.SX, xy: ca.SX, J_inverse_transposed: ca.SX) -> ca.SX:
    """Return the signed distance [px] of a point of the sensor plane from the line h.

    The same as :meth:`legcal.vision.camera.Camera.line_offset`, with the derivative of the
    lens at the point given as a constant.
    """
    normal = J_inverse_transposed @ h[:2]
    return (h[0] * xy[0] + h[1] * xy[1] + h[2]) / ca.norm_2(normal)


@cache
def outline_offsets() -> ca.Function:
    """Return (local, data) -> distances [px] of the predicted outline from both measured ends.

    local (19): A, B, radius, camera (w, t), platform pose (w, t). data (48): their references (3,
    3, 1, 12, 12), feet of the two ends (2 x 2), J^-T there (2 x 4, column by column),
    epsilon; T00, T10, T11 of the whitening matrix and k, which this function leaves unused.
    """
    local, data = ca.SX.sym("local", 19), ca.SX.sym("data", 48)
    A = data[0:3] + UNIT * local[0:3]
    B = data[3:6] + UNIT * local[3:6]
    radius = data[6] + UNIT * local[6]
    R_camera, t_camera = moved_frame(local[7:13], data[7:19])
    R_pose, t_pose = moved_frame(local[13:19], data[19:31])
    A_camera = R_camera @ A + t_camera
    B_camera = R_camera @ (R_pose @ B + t_pose) + t_camera
    h = outline_of_leg(A_camera, B_camera, radius, data[43])
    offsets = [
        offset_in_image(
            h,
            data[31 + 2 * end : 33 + 2 * end],
            ca.reshape(data[35 + 4 * end : 39 + 4 * end], 2, 2),
        )
        for end in range(2)
    ]
    return ca.Function("outline_offsets", [local, data], [ca.vertcat(*offsets)])


@cache
def outline_residual() -> Residual:
    """Return the whitened offsets of an outline, T times the offsets, T lower triangular."""
    local, data = ca.SX.sym("local", 19), ca.SX.sym("data", 48)
    offsets = outline_offsets()(local, data)
    whitened = ca.vertcat(
        data[44] * offsets[0],
        data[45] * offsets[0] + data[46] * offsets[1],
    )
    return Residual("outline", 19, 48, 2, ca.Function("outline", [local, data], [whitened]))


@cache
def axis_residual() -> Residual:
    """Return how far a leg's predicted axis is from a measured one, whitened.

    It is T times (alpha1, alpha2, beta1, beta2). The measured axis passes through M along e1 x e2.
    alpha is the predicted direction in e1 and e2, over its part along the axis; beta is where
    the predicted axis meets the plane through M with these directions, from M.

    local (18): A, B, camera (w, t), platform pose (w, t). data (50): their references (3, 3, 12,
    12), M, e1, e2; the lower triangle of the whitening T, column by column, and k.
    """
    local, data = ca.SX.sym("local", 18), ca.SX.sym("data", 50)
    A = data[0:3] + UNIT * local[0:3]
    B = data[3:6] + UNIT * local[3:6]
    R_camera, t_camera = moved_frame(local[6:12], data[6:18])
    R_pose, t_pose = moved_frame(local[12:18], data[18:30])
    A_camera = R_camera @ A + t_camera
    leg = R_camera @ (R_pose @ B + t_pose) + t_camera - A_camera
    M, e1, e2 = data[30:33], data[33:36], data[36:39]
    basis = ca.horzcat(e1, e2).T
    slope = leg / ca.dot(ca.cross(e1, e2), leg)
    to_A = A_camera - M
    beta = basis @ (to_A - slope * ca.dot(ca.cross(e1, e2), to_A))
    T = ca.SX(ca.Sparsity.lower(4), data[39:49])
    whitened = T @ ca.vertcat(basis @ slope, beta)
    return Residual("axis", 18, 50, 4, ca.Function("axis", [local, data], [whitened]))


@cache
def encoder_residual() -> Residual:
    """Return the whitened closure of a leg, (|R B + t - A| - sign q - q0) / sigma_q.

    local (13): A, B, q0, platform pose. data (22): references (3, 3, 1, 12), sign * q, 1 / sigma,
    k.
    """
    local, data = ca.SX.sym("local", 13), ca.SX.sym("data", 22)
    A = data[0:3] + UNIT * local[0:3]
    B = data[3:6] + UNIT * local[3:6]
    q0 = data[6] + UNIT * local[6]
    R, t = moved_frame(local[7:13], data[7:19])
    closure = (ca.norm_2(R @ B + t - A) - data[19] - q0) * data[20]
    return Residual("encoder", 13, 22, 1, ca.Function("encoder", [local, data], [closure]))


@cache
def prior_residual() -> Residual:
    """Return the whitened distance of one unknown from its prior.

    local (1): the unknown. data (3): reference minus mean, 1 / sigma, k.
    """
    local, data = ca.SX.sym("local", 1), ca.SX.sym("data", 3)
    distance = (data[0] + UNIT * local[0]) * data[1]
    return Residual("prior", 1, 3, 1, ca.Function("prior", [local, data], [distance]))
