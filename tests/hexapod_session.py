"""A simulated calibration session with exact outlines, for the tests of the fit."""

from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import RigidTransform, Rotation

from legcal.calibration.joint_fit.variables import FittedLegs, Start
from legcal.data.measurements import Measurements, View
from legcal.data.outlines import Outlines
from legcal.geometry.types import Array
from legcal.machine import (
    JointType,
    KinematicParameters,
    Leg,
    LegKind,
    free_coordinates,
    from_vector,
    to_vector,
)
from legcal.simulation import Viewpoint, outlines_of, plain_scene
from legcal.vision.camera import Camera

FRAME_LEGS = (0, 2, 4)
RADIUS = 0.010
PINHOLE = Camera(np.array([[1290.0, 0.0, 518.0], [0.0, 1290.0, 380.0], [0.0, 0.0, 1.0]]), 1024, 768)
LENS = Camera(PINHOLE.K, 1024, 768, np.array([-0.12, 0.05, 1e-3, -5e-4, 0.0]))
TRUTH = KinematicParameters(
    np.array(
        [
            [0.0, 0.0, 0.0],
            [0.392, -0.083, -0.004],
            [0.467, 0.0, 0.0],
            [0.343, 0.380, 0.010],
            [0.233, 0.404, 0.0],
            [-0.037, 0.105, 0.004],
        ]
    ),
    np.array(
        [
            [0.0, 0.0, 0.0],
            [0.057, -0.061, -0.019],
            [0.339, 0.0, 0.0],
            [0.362, 0.077, 0.003],
            [0.170, 0.293, 0.0],
            [0.089, 0.276, -0.006],
        ]
    ),
    np.array([0.3457, 0.3438, 0.3466, 0.3439, 0.3431, 0.3438]),
)


@dataclass(frozen=True, eq=False)
class Session:
    """Exact measurements and the truth behind them."""

    legs: FittedLegs
    measurements: Measurements
    outlines: Outlines
    truth: KinematicParameters
    T_camera_Rb: tuple[RigidTransform, ...]
    T_Rb_Re: tuple[RigidTransform, ...]


def simulate(
    n_poses_per_view: int = 15,
    *,
    camera: Camera = PINHOLE,
    legs_seen: int = 4,
    radius: float = RADIUS,
    sigma_px: float = 0.1,
    seed: int = 0,
    shared_poses: bool = False,
    n_views: int = 3,
) -> Session:
    """Return a session of a non-coplanar hexapod: views around it, every image its own pose."""
    rng = np.random.default_rng(seed)
    T_cameras = tuple(_camera_around(angle) for angle in 0.4 + 2.1 * np.arange(n_views))
    n_rows = n_views * n_poses_per_view
    view = np.repeat(np.arange(n_views), n_poses_per_view)
    pose = np.tile(np.arange(n_poses_per_view), n_views) if shared_poses else np.arange(n_rows)
    poses = [_pose(rng) for _ in range(int(pose.max()) + 1)]
    A, B = TRUTH.base_joints, TRUTH.platform_joints
    lengths = np.array([np.linalg.norm(T.apply(B) - A, axis=1) for T in poses])
    names = tuple(f"leg{i + 1}" for i in range(6))
    measurements = Measurements(
        tuple(View(f"c{v + 1}", camera) for v in range(n_views)),
        tuple(f"c{v + 1}_{i:03d}.png" for i, v in enumerate(view)),
        view,
        pose,
        (lengths - TRUTH.offsets)[pose],
        2e-6,
    )
    # Images show the legs whose base joints are nearest to the camera.
    depth = np.array([T.apply(A)[:, 2] for T in T_cameras])
    nearest = [np.sort(np.argsort(depth[v])[:legs_seen]).tolist() for v in view]
    scene = plain_scene(
        np.broadcast_to(A, (*lengths.shape, 3)),
        np.array([T.apply(B) for T in poses]),
        [Viewpoint(f"c{v + 1}", camera, T.inv()) for v, T in enumerate(T_cameras)],
        view,
        pose,
        {(j, "rod"): radius for j in range(6)},
        nearest,
        span=(0.08, 0.92),
    )
    white = np.tile(sigma_px**2 * np.eye(2), (2 * legs_seen * n_rows, 1, 1))
    outlines = replace(outlines_of(scene), covariance=white)
    radii = {(i, "rod"): RADIUS for i in range(6)}
    sign = np.ones(6, dtype=np.intp)
    legs = FittedLegs(names, geometry_of(TRUTH), sign, FRAME_LEGS, radii)
    return Session(legs, measurements, outlines, TRUTH, T_cameras, tuple(poses))


def geometry_of(parameters: KinematicParameters) -> tuple[Leg, ...]:
    """Return legs with point-like joints."""
    joints = zip(parameters.base_joints, parameters.platform_joints, strict=True)
    return tuple(
        Leg(JointType("S"), JointType("S"), LegKind.ACTUATED, A, B, float(q0))
        for (A, B), q0 in zip(joints, parameters.offsets, strict=True)
    )


def moved_outlines(outlines: Outlines, camera: Camera, offsets_px: Array) -> Outlines:
    """Return outlines whose two ends are moved along their normals by (n, 2) pixels."""
    a, b = outlines.ends[:, 0], outlines.ends[:, 1]
    along = (b - a) / np.linalg.norm(b - a, axis=1, keepdims=True)
    normal = np.stack([-along[:, 1], along[:, 0]], axis=1)
    ends = outlines.ends + offsets_px[:, :, None] * normal[:, None, :]
    xy = camera.undistort(ends)
    rays = np.concatenate([xy, np.ones((*xy.shape[:-1], 1))], axis=-1)
    h = np.cross(rays[:, 0], rays[:, 1])
    h /= np.linalg.norm(h, axis=1, keepdims=True)
    h *= np.sign(np.sum(h * outlines.h, axis=1, keepdims=True))
    return replace(outlines, h=h, ends=ends)


def noisy_outlines(session: Session, rng: np.random.Generator) -> Outlines:
    """Return outlines with Gaussian errors of their claimed covariances."""
    chol = np.linalg.cholesky(session.outlines.covariance)
    errors = np.einsum("nij,nj->ni", chol, rng.standard_normal((len(chol), 2)))
    return moved_outlines(session.outlines, session.measurements.views[0].camera, errors)


def noisy_readings(session: Session, rng: np.random.Generator) -> Measurements:
    """Return measurements with Gaussian errors in the readings, equal within a pose."""
    m = session.measurements
    error = m.sigma_q * rng.standard_normal((m.n_poses, m.q.shape[1]))
    return Measurements(m.views, m.image, m.view, m.pose, m.q + error[m.pose], m.sigma_q)


def disturbed_start(
    session: Session,
    *,
    joints: float = 0.002,
    camera: float = 0.005,
    angle: float = 0.01,
    seed: int = 1,
) -> Start:
    """Return a start whose every coordinate, camera and pose is wrong by that much [m, rad]."""
    rng = np.random.default_rng(seed)
    xi = to_vector(session.truth, FRAME_LEGS)
    xi = xi + joints * rng.choice([-1.0, 1.0], len(xi))
    return Start(
        geometry_of(from_vector(xi, 6, FRAME_LEGS)),
        tuple(_shaken(T, camera, angle, rng) for T in session.T_camera_Rb),
        tuple(_shaken(T, camera, angle, rng) for T in session.T_Rb_Re),
        "nominal",
    )


def joint_errors(parameters: KinematicParameters) -> Array:
    """Return the errors of the free parameters [m]."""
    return to_vector(parameters, FRAME_LEGS) - to_vector(TRUTH, FRAME_LEGS)


def gauge_is_kept(parameters: KinematicParameters) -> bool:
    """Return whether the coordinates that define the frames are still exactly zero."""
    fixed = ~free_coordinates(6, FRAME_LEGS)
    return not (parameters.base_joints[fixed].any() or parameters.platform_joints[fixed].any())


def _camera_around(angle: float) -> RigidTransform:
    """Return T_camera_Rb of a camera 0.9 m away that looks at the middle of the machine."""
    middle = np.array([0.23, 0.15, 0.17])
    centre = middle + np.array([0.9 * np.cos(angle), 0.9 * np.sin(angle), 0.1])
    z = (middle - centre) / np.linalg.norm(middle - centre)
    x = np.cross(z, [0.0, 0.0, 1.0])
    x /= np.linalg.norm(x)
    rotation = Rotation.from_matrix(np.column_stack([x, np.cross(z, x), z]))
    return RigidTransform.from_components(centre, rotation).inv()


def _pose(rng: np.random.Generator) -> RigidTransform:
    home = Rotation.from_rotvec([0.0, 0.0, 0.6])
    tilt = Rotation.from_rotvec(rng.uniform(-0.18, 0.18, 3))
    translation = np.array([0.14, -0.05, 0.34]) + rng.uniform(-0.03, 0.03, 3)
    return RigidTransform.from_components(translation, tilt * home)


def _shaken(
    T: RigidTransform, distance: float, angle: float, rng: np.random.Generator
) -> RigidTransform:
    turn = rng.standard_normal(3)
    shift = rng.standard_normal(3)
    rotation = Rotation.from_rotvec(angle * turn / np.linalg.norm(turn))
    return RigidTransform.from_components(
        T.translation + distance * shift / np.linalg.norm(shift), rotation * T.rotation
    )
