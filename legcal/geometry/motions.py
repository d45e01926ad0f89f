"""Rotations, rigid motions as transforms, batches (R, t) or matrices (..., 4, 4), and point sets.

Matrices are for chains of motions: transforms of SciPy are ten times slower than a matrix product.
"""

from collections.abc import Sequence

import numpy as np
from scipy.spatial.transform import RigidTransform, Rotation

from legcal.geometry.lines import cross, normal_basis
from legcal.geometry.types import Array, IntArray

_HALF_MORE = 1.5 * np.eye(3)


def cross_matrices(v: Array) -> Array:
    """Return the matrices (..., 3, 3) of w -> v x w."""
    matrix = np.zeros((*v.shape[:-1], 3, 3))
    matrix[..., [2, 0, 1], [1, 2, 0]] = v
    matrix[..., [1, 2, 0], [2, 0, 1]] = -v
    return matrix


def rotation_matrices(w: Array) -> Array:
    """Return the rotation matrices (..., 3, 3) of rotation vectors (..., 3) [rad]."""
    return np.asarray(
        Rotation.from_rotvec(w.reshape(-1, 3)).as_matrix().reshape(*w.shape[:-1], 3, 3)
    )


def cayley(w: Array) -> Array:
    """Return Cayley's rotation matrices (..., 3, 3) of w (..., 3), rotations by w [rad] if small.

    w / 2 is the Gibbs vector, tan(angle / 2) along the axis: no branches and no square root.
    """
    K = cross_matrices(0.5 * w)
    scale = 2.0 / (1.0 + 0.25 * np.sum(w**2, axis=-1))[..., None, None]
    return np.asarray(np.eye(3) + scale * (K + K @ K))


def turned(R: Array, w: Array) -> Array:
    """Return rotation matrices rotated from the left by :func:`cayley`, orthogonal to rounding."""
    return orthogonal(cayley(w) @ R)


def orthogonal(R: Array) -> Array:
    """Return rotation matrices (..., 3, 3) with their rounding errors corrected."""
    return np.asarray(R @ (_HALF_MORE - 0.5 * (np.swapaxes(R, -1, -2) @ R)))


def nearest_rotation(matrix: Array) -> Array:
    """Return the nearest rotation matrices to matrices (..., 3, 3), never reflections."""
    U, _, Vt = np.linalg.svd(matrix)
    flip = np.ones(U.shape[:-1])
    flip[..., 2] = np.sign(np.linalg.det(U @ Vt))
    return np.asarray((U * flip[..., None, :]) @ Vt)


def rotation_between(first: Array, second: Array) -> Rotation:
    """Return the smallest rotation of one unit direction (3,) onto another."""
    normal = cross(first, second)
    sine, cosine = float(np.linalg.norm(normal)), float(first @ second)
    if sine == 0.0:
        return Rotation.from_rotvec((0.0 if cosine > 0.0 else np.pi) * normal_basis(first)[0])
    return Rotation.from_rotvec(np.arctan2(sine, cosine) / sine * normal)


def roll_pitch_yaw(rotation: Array) -> Array:
    """Return the angles of a rotation matrix about fixed x, y, z, (3,) [rad], to rounding.

    Near a pitch of 90 degrees the yaw is poorly determined, and the roll compensates for it.
    """
    r = rotation
    yaw = np.arctan2(r[1, 0], r[0, 0])
    s, c = np.sin(yaw), np.cos(yaw)
    pitch = np.arctan2(-r[2, 0], np.hypot(r[0, 0], r[1, 0]))
    roll = np.arctan2(s * r[0, 2] - c * r[1, 2], c * r[1, 1] - s * r[0, 1])
    return np.array([roll, pitch, yaw])


def frame_on_points(
    points: Array,  # (3, 3) joint centres in some frame L [m]
    normal: Array | None = None,  # (3,) unit normal of the plane of motion in L, for two points
) -> RigidTransform:
    """Return the frame defined by three points: origin, x axis, xy plane (z completes).

    Two points define the frame of a planar mechanism: its z axis is the normal of the plane, its x
    axis the direction of the second point in that plane.
    """
    x = points[1] - points[0]
    spread = float(np.linalg.norm(points - points[0], axis=1).max())
    if len(points) == 3:
        z = cross(x, points[2] - points[0])
    else:
        z = np.array([0.0, 0.0, 1.0]) if normal is None else normal
        x = x - (x @ z) * z
        z = z * float(x @ x)
    if spread == 0.0 or np.linalg.norm(z) < 1e-9 * spread**2:
        raise ValueError("the points that should define a frame coincide or are collinear")
    x = x / np.linalg.norm(x)
    z = z / np.linalg.norm(z)
    return motion_of(np.column_stack([x, cross(z, x), z]), points[0])


def look_at(
    position: Array,  # (3,) [m]
    target: Array,  # (3,) [m]
    roll: float = 0.0,  # about the viewing direction [rad]
    *,
    up: Array | Sequence[float] = (0.0, 0.0, 1.0),
) -> RigidTransform:
    """Return the pose of a camera that looks at a point, with its y axis down before the roll."""
    z = (target - position) / np.linalg.norm(target - position)
    x = cross(z, np.asarray(up))
    size = np.linalg.norm(x)
    x = x / size if size >= 1e-6 else normal_basis(z)[0]  # the view is along *up*
    upright = np.column_stack([x, cross(z, x), z])
    return motion_of(upright @ Rotation.from_euler("z", roll).as_matrix(), position)


def motion_of(
    R: Array,  # (..., 3, 3) rotation matrix; rounding is corrected
    t: Array,  # (..., 3) translation [m]
) -> RigidTransform:
    """Return the rigid motion of a rotation matrix and a translation.

    Faster than ``RigidTransform.from_components``, which decomposes every matrix: most of the time
    of reading a model.
    """
    return RigidTransform(matrix_of(R, t), normalize=False, copy=False)


def matrix_of(R: Array, t: Array) -> Array:
    """Return the matrix (..., 4, 4) of a motion; rounding of the rotation is corrected."""
    matrix = np.zeros((*R.shape[:-2], 4, 4))
    matrix[..., :3, :3] = orthogonal(R)
    matrix[..., :3, 3] = t
    matrix[..., 3, 3] = 1.0
    return matrix


def matrix_product(*matrices: Array) -> Array:
    """Return the matrix (..., 4, 4) of a sequence of motions, the last one applied first."""
    product = matrices[0]
    for matrix in matrices[1:]:
        product = product @ matrix
    return matrix_of(product[..., :3, :3], product[..., :3, 3])


def matrix_inverse(matrix: Array) -> Array:
    """Return the matrix (4, 4) of the inverse motion."""
    inverse = np.eye(4)
    inverse[:3, :3] = matrix[:3, :3].T
    inverse[:3, 3] = -(inverse[:3, :3] @ matrix[:3, 3])
    return inverse


def matrix_applied(matrix: Array, points: Array) -> Array:
    """Return points (..., 3) transformed by a matrix (4, 4) [m]."""
    return np.asarray(points @ matrix[:3, :3].T + matrix[:3, 3])


def pose_distance(first: RigidTransform, second: RigidTransform) -> tuple[float, float]:
    """Return distance [m] and angle [rad] between two poses."""
    off = first.inv() * second
    return float(np.linalg.norm(off.translation)), float(off.rotation.magnitude())


def product(*motions: RigidTransform) -> RigidTransform:
    """Return the product of motions, like ``*`` but faster; see :func:`motion_of`."""
    matrix = matrix_product(*[motion.as_matrix() for motion in motions])
    return RigidTransform(matrix, normalize=False, copy=False)


def motions_of(R: Array, t: Array) -> tuple[RigidTransform, ...]:
    """Return rigid motions of rotation matrices (n, 3, 3) and translations (n, 3) [m]."""
    return tuple(motion_of(R, t)) if len(R) else ()


def components(motions: Sequence[RigidTransform]) -> tuple[Array, Array]:
    """Return rotation matrices (n, 3, 3) and translations (n, 3) of motions."""
    T = np.array([T.as_matrix() for T in motions]).reshape(-1, 4, 4)
    return T[:, :3, :3].copy(), T[:, :3, 3].copy()


def moved_poses(R: Array, t: Array, turn: Array, shift: Array) -> tuple[Array, Array]:
    """Return poses (..., 3, 3), (..., 3) after rotation vectors from the left and displacements.

    The map is Exp(turn) R, t + shift. Estimation uses Cayley's map instead (:func:`turned`), which
    agrees to second order.
    """
    return rotation_matrices(turn) @ R, t + shift


def register_points(P_from: Array, P_to: Array) -> RigidTransform:
    """Return the rigid motion of points onto points, unweighted least squares in closed form.

    It is never a reflection, and coplanar points suffice.

    Parameters
    ----------
    P_from, P_to : (n, 3) array
        The same points in two frames [m], at least three and not collinear.

    Returns
    -------
    RigidTransform
        T_to_from.
    """
    R, t = register_groups(P_from, P_to, np.zeros(len(P_from), dtype=np.intp))
    return RigidTransform.from_components(t[0], Rotation.from_matrix(R[0]))


def register_groups(
    P_from: Array, P_to: Array, group: IntArray, weight: Array | None = None
) -> tuple[Array, Array]:
    """Return the motion of :func:`register_points` for each group of points.

    Parameters
    ----------
    P_from, P_to : (n, 3) array
        The same points in two frames [m].
    group : (n,) array of int
        The group of each point: 0, 1 and so on.
    weight : (n,) array, optional
        Weight of each point, equal by default.

    Returns
    -------
    (n_groups, 3, 3) array, (n_groups, 3) array
        Rotation matrix and translation [m] of T_to_from.
    """
    arm_from, arm_to, centre_from, centre_to, weight = _arms(P_from, P_to, group, weight)
    moment = np.zeros((len(centre_to), 3, 3))
    np.add.at(moment, group, weight[:, None, None] * arm_to[:, :, None] * arm_from[:, None, :])
    R = nearest_rotation(moment)
    return R, centre_to - np.einsum("gij,gj->gi", R, centre_from)


def register_in_plane(
    P_from: Array, P_to: Array, group: IntArray, weight: Array | None = None
) -> tuple[Array, Array]:
    """Return the motion in the plane z = 0 of points onto points, for each group.

    Two points suffice; heights are ignored. Otherwise as :func:`register_groups`.
    """
    arm_from, arm_to, centre_from, centre_to, weight = _arms(P_from, P_to, group, weight)
    (x, y), (i, j) = arm_from.T[:2], arm_to.T[:2]
    sine, cosine = (
        np.bincount(group, weights=weight * part) for part in (x * j - y * i, x * i + y * j)
    )
    R = rotation_matrices(np.arctan2(sine, cosine)[:, None] * [0.0, 0.0, 1.0])
    t = centre_to - np.einsum("gij,gj->gi", R, centre_from)
    t[:, 2] = 0.0
    return R, t


def _arms(
    P_from: Array, P_to: Array, group: IntArray, weight: Array | None
) -> tuple[Array, Array, Array, Array, Array]:
    """Return points relative to the centres of their groups, these centres, and the weights."""
    weight = np.ones(len(group)) if weight is None else weight
    whole = np.bincount(group, weights=weight)[:, None]

    def centres(points: Array) -> Array:
        sums = np.zeros((len(whole), 3))
        np.add.at(sums, group, weight[:, None] * points)
        return sums / whole

    centre_from, centre_to = centres(P_from), centres(P_to)
    return P_from - centre_from[group], P_to - centre_to[group], centre_from, centre_to, weight
