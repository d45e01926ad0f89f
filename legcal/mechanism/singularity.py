"""How far a pose is from a singularity of the legs' equations.

The equations of the legs (the readings of motors, and what rods, revolute axes and joints without
a sphere demand) fix the platform where their Jacobian has full rank. Where it has not, the
platform moves although all motors stand: a singularity of the motors, or of the constraints (a
3-UPU that starts to turn).
"""

import numpy as np
from scipy.spatial.transform import RigidTransform

from legcal.geometry.types import Array
from legcal.mechanism.demands import demands_at, is_constrained, leg_scale
from legcal.mechanism.model import Mechanism


def singularity(mechanism: Mechanism, T_base_platform: RigidTransform) -> float:
    """Return the smallest singular value of the dimensionless Jacobian of the legs' equations.

    Rows are the lengths of actuated and constant legs and all other demands, counted at the end
    of their leg; columns are a rotation about the mean of the platform joints and a displacement.
    Lengths are measured in mean leg lengths at the pose, angles in radian, so that the number has
    no unit and does not depend on the size of the machine or on the frames of its links.

    Parameters
    ----------
    mechanism : Mechanism
        The machine.
    T_base_platform : RigidTransform
        A pose; its readings need not be inside the travel.

    Returns
    -------
    float
        Zero at a singular pose, and wherever the motors do not determine the pose; of the order
        of the platform's size in leg lengths at a good one.
    """
    jacobian = dimensionless(mechanism, T_base_platform)
    if len(jacobian) < 6:
        return 0.0
    return float(np.linalg.svd(jacobian, compute_uv=False)[5])


def side(mechanism: Mechanism, T_base_platform: RigidTransform) -> float:
    """Return the sign of the determinant of the legs' equations where they are square, else 0.

    Between two poses of different sign lies a singularity.
    """
    rows = dimensionless(mechanism, T_base_platform)
    return float(np.sign(np.linalg.det(rows))) if len(rows) == 6 else 0.0


def dimensionless(mechanism: Mechanism, T_base_platform: RigidTransform) -> Array:
    """Return the Jacobian of :func:`singularity`, (n_rows, 6): rotation, displacement."""
    if not is_constrained(mechanism):
        return _lines(mechanism, T_base_platform)
    demands = demands_at(mechanism, T_base_platform)
    scale = leg_scale(mechanism, T_base_platform)
    centre = T_base_platform.as_matrix()[:3, :3] @ mechanism.B_platform.mean(axis=0)
    gradient, moment = demands.jacobian[:, 3:], demands.jacobian[:, :3]
    return np.hstack([(moment - np.cross(centre, gradient)) / scale, gradient])


def _lines(mechanism: Mechanism, T_base_platform: RigidTransform) -> Array:
    """Return the same of the motors' legs alone, (n_motors, 6): there is nothing else to meet.

    The moments arm x u are written out: ``np.cross`` is slow on six rows.
    """
    motors = list(mechanism.motors)
    matrix = T_base_platform.as_matrix()
    turned = mechanism.B_platform @ matrix[:3, :3].T
    vectors = turned + matrix[:3, 3] - mechanism.A_base
    lengths = np.linalg.norm(vectors, axis=1)
    arms = (turned - turned.mean(axis=0))[motors] / lengths.mean()
    u = (vectors / lengths[:, None])[motors]
    (x, y, z), (a, b, c) = arms.T, u.T
    return np.stack([y * c - z * b, z * a - x * c, x * b - y * a, a, b, c], axis=1)
