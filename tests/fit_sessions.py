"""Simulated sessions in memory for the tests of the fit: exact, noisy, and started from far away.

Outlines of any shipped machine, of a hexapod whose joints lie in no plane, corners of a board
beside them.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cache

import numpy as np
from hexapod_sessions import plain_scene
from machines import from_vector
from outline_sessions import closed_poses, moved_poses, true_machine
from scipy.spatial.transform import RigidTransform, Rotation

from legcal.calibration.joint_fit.factors import BoardCorners
from legcal.calibration.joint_fit.variables import (
    FittedLegs,
    Start,
    fitted_legs,
    start_from,
)
from legcal.data.corners import Corners, found_corners
from legcal.data.measurements import Measurements, View
from legcal.data.outlines import Outlines, unmeasured
from legcal.data.reasons import USED
from legcal.geometry.motions import components, look_at, motions_of
from legcal.geometry.types import Array
from legcal.machine.kinematics import platform_in_base
from legcal.machine.leg import (
    KinematicParameters,
    Leg,
    LegKind,
    point_like_legs,
)
from legcal.machine.model import Machine
from legcal.machine.parameters import (
    geometries,
    moved_legs,
    to_vector,
)
from legcal.machine.rods import (
    actuator_index,
    arms_at,
    ends_at_poses,
    measured_readings,
    readings_of_rods,
)
from legcal.simulation import observe
from legcal.simulation.observe import (
    OutlineNoise,
    Viewpoint,
    moved_outlines,
    outlines_of,
)
from legcal.vision.board import Board, FixedBoard
from legcal.vision.camera import Camera

K = np.array([[1290.0, 0.0, 518.0], [0.0, 1280.0, 380.0], [0.0, 0.0, 1.0]])
PINHOLE = Camera(K, 1024, 768)
LENS = Camera(K, 1024, 768, np.array([-0.12, 0.05, 1e-3, -5e-4, 0.0]))
SHIPPED = (
    "hexapod",
    "hexapod-rod",
    "hexapod-strut",
    "nategh-agheli",
    "6-sps",
    "3-rpr",
    "3-rps",
    "3-spr",
    "3-upu",
    "3-upu-tilted",
    "tricept",
    "hexaglide",
    "linear-delta",
)
SIGMA_Q = 2e-6  # [m]
_TURN, _SHIFT = 0.12, 0.06  # of poses: [rad], of the length of a leg


@dataclass(frozen=True, eq=False)
class MachineSession:
    """What a true machine shows, and where a fit of it begins.

    Attributes
    ----------
    legs : FittedLegs
        The nominal legs, wrong, with the true radii.
    measurements : Measurements
        Exact readings; every image is a pose of its own.
    outlines : Outlines
        Exact outlines of all legs, with the covariance that noise would have.
    truth : Start
        The true legs, cameras and poses.
    start : Start
        The wrong legs, cameras that are wrong as well, poses that follow from these legs.
    """

    legs: FittedLegs
    measurements: Measurements
    outlines: Outlines
    truth: Start
    start: Start

    def noisy(self, seed: int) -> tuple[Measurements, Outlines]:
        """Return readings and outlines with the errors that they claim."""
        rng, m = np.random.default_rng(seed), self.measurements
        q = m.q + m.sigma_q * rng.standard_normal(m.q.shape)
        return replace(m, q=q), observe.noisy_outlines(self.outlines, m.views[0].camera, rng)


def shifted(session: MachineSession, outlines: Outlines, offsets: Array) -> Outlines:
    """Return outlines moved across themselves by (n, 2) pixels at their ends."""
    return moved_outlines(outlines, session.measurements.views[0].camera, offsets)


@cache
def machine_session(
    name: str,
    *,
    camera_shift: float = 0.003,
    camera_turn: float = float(np.deg2rad(1.0)),
    n_views: int = 3,
    n_poses: int = 6,
    camera: Camera = LENS,
) -> MachineSession:
    """Return a session of a shipped model, or of one that is made, which is the truth.

    Parameters
    ----------
    name : str
        The model; all lengths of the nominal legs are 3 mm wrong and all axes 1 deg.
    camera_shift, camera_turn : float
        How far each camera is from where it is said to be [m], [rad].
    n_views, n_poses : int
        Number of cameras, and of poses that each of them sees alone.
    camera : Camera
        Intrinsics of all cameras.
    """
    rng = np.random.default_rng(0)
    machine = true_machine(name)
    legs, fitted = geometries(machine), fitted_legs(machine)
    R, t = _poses(machine, legs, n_views * n_poses, rng)
    fitted = replace(fitted, home=platform_in_base(machine, machine.home))
    wrong = (0.003, float(np.deg2rad(1.0)), camera_shift, camera_turn)
    return session_of_legs(fitted, R, t, _readings(fitted, R, t), wrong, n_views, camera, rng)


def session_of_legs(
    fitted: FittedLegs,
    R: Array,
    t: Array,
    q: Array,
    wrong_by: tuple[float, float, float, float],
    n_views: int,
    camera: Camera,
    rng: np.random.Generator,
) -> MachineSession:
    """Return a session of true legs with a home, whose views see the poses in turn.

    Errors are those of lengths and angles of legs, then of places and turns of cameras [m, rad].
    """
    legs, length, angle, camera_shift, camera_turn = fitted.nominal, *wrong_by
    view = np.repeat(np.arange(n_views), len(t) // n_views)
    assert fitted.home is not None
    T_camera_Rb = _cameras(fitted.home, legs, n_views, camera)
    measurements = Measurements(
        tuple(View(f"c{v + 1}", camera) for v in range(n_views)),
        tuple(f"c{v + 1}_{i:03d}.png" for i, v in enumerate(view)),
        view,
        np.arange(len(view)),
        q,
        SIGMA_Q,
    )
    truth = Start(legs, T_camera_Rb, motions_of(R, t), "truth")
    away = _wrong(fitted, legs, length, angle, rng)
    home = (fitted.home,) * len(t)
    rough = tuple(_shaken(T, camera_shift, camera_turn, rng) for T in T_camera_Rb)
    wrong = replace(fitted, nominal=away)
    return MachineSession(
        wrong,
        measurements,
        shown_outlines(fitted.radii, measurements, truth, q),
        truth,
        start_from(away, measurements, wrong, rough, home, "nominal"),
    )


def _poses(
    machine: Machine, legs: tuple[Leg, ...], n: int, rng: np.random.Generator
) -> tuple[Array, Array]:
    """Return poses around home at which the legs close."""
    R, t = components((platform_in_base(machine, machine.home),) * n)
    size = np.mean([np.linalg.norm(R[0] @ leg.B + t[0] - leg.A) for leg in legs])
    step = rng.uniform(-1.0, 1.0, (n, 6)) * np.repeat([_TURN, _SHIFT * size], 3)
    return closed_poses(legs, machine.frame_legs, *moved_poses(R, t, step))


def _readings(fitted: FittedLegs, R: Array, t: Array) -> Array:
    legs = fitted.nominal
    q, on = np.full((len(t), len(legs)), np.nan), actuator_index(legs)
    of_actuators = readings_of_rods(legs, R, t)
    for j, leg in enumerate(legs):
        if leg.actuator is not None:
            q[:, j] = of_actuators[:, on[j]]
        elif leg.kind is LegKind.ACTUATED:
            length = np.linalg.norm(R @ leg.B + t - leg.A, axis=1)
            q[:, j] = fitted.sign[j] * (length - leg.q0)
    return q


def _cameras(
    home: RigidTransform, legs: tuple[Leg, ...], n_views: int, camera: Camera
) -> tuple[RigidTransform, ...]:
    """Return T_camera_Rb of cameras around the middle of the machine."""
    joints = np.array([leg.A for leg in legs] + [home.apply(leg.B) for leg in legs])
    middle = joints.mean(axis=0)
    size = np.linalg.norm(joints - middle, axis=1).max()
    found = []
    for v in range(n_views):
        turn = 0.4 + 2.1 * v
        outward = np.array([np.cos(turn), np.sin(turn), 0.35 + 0.1 * v])
        centre = middle + 4.0 * size * outward / np.linalg.norm(outward)
        found.append(look_at(centre, middle).inv())
    return tuple(found)


def shown_outlines(
    radii: Mapping[tuple[int, str], float],
    m: Measurements,
    truth: Start,
    q: Array | None = None,
) -> Outlines:
    """Return both outlines of every part of every leg in every image.

    Joints at A that motors move are where readings q (n_poses, n_legs) have them, if given.
    """
    R, t = components(truth.T_Rb_Re)
    read = None if q is None else measured_readings(truth.legs, R, t, q)
    A, ends = ends_at_poses(truth.legs, R, t, read)
    views = [
        Viewpoint(view.name, view.camera, T.inv())
        for view, T in zip(m.views, truth.T_camera_Rb, strict=True)
    ]
    arms = {} if read is None else arms_at(truth.legs, read)
    of_parts = {(j, arm.link): arms[j] for j in arms if (arm := truth.legs[j].arm) is not None}
    scene = plain_scene(A, ends, views, m.view, m.pose, radii, arms=of_parts)
    return outlines_of(scene, OutlineNoise(0.2, 150))


def _wrong(
    fitted: FittedLegs,
    legs: tuple[Leg, ...],
    length: float,
    angle: float,
    rng: np.random.Generator,
) -> tuple[Leg, ...]:
    """Return legs every number of which is wrong by as much, up or down; twists are right."""
    parametrization = fitted.parametrization
    size = np.where(np.array(parametrization.units) == "m", length, angle / np.sqrt(2.0))
    size[[name.endswith((".twist", ".gain")) for name in parametrization.names]] = 0.0
    step = size * rng.choice([-1.0, 1.0], len(size))
    return moved_legs(legs, parametrization.place, step)


def _shaken(
    T: RigidTransform, distance: float, angle: float, rng: np.random.Generator
) -> RigidTransform:
    """Return a camera that is wrong by a distance and an angle in any direction."""
    turn, shift = rng.standard_normal((2, 3))
    rotation = Rotation.from_rotvec(angle * turn / np.linalg.norm(turn))
    return RigidTransform.from_components(
        T.translation + distance * shift / np.linalg.norm(shift), rotation * T.rotation
    )


# A hexapod with point-like joints

FRAME_LEGS = (0, 2, 4)
RADIUS = 0.010
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
class HexapodSession:
    """Exact measurements and the truth behind them."""

    legs: FittedLegs
    measurements: Measurements
    outlines: Outlines
    truth: KinematicParameters
    T_camera_Rb: tuple[RigidTransform, ...]
    T_Rb_Re: tuple[RigidTransform, ...]


def irregular_hexapod(
    n_poses_per_view: int = 15,
    *,
    camera: Camera = PINHOLE,
    legs_seen: int = 4,
    sigma_px: float = 0.1,
    shared_poses: bool = False,
    n_views: int = 3,
    repeats: int = 1,
) -> HexapodSession:
    """Return a session of a non-coplanar hexapod: views around it, every image its own pose.

    The platform comes to each place so many times in succession, with a pose of its own each time.
    """
    rng = np.random.default_rng(0)
    T_cameras = tuple(_camera_around(angle) for angle in 0.4 + 2.1 * np.arange(n_views))
    n_rows = n_views * n_poses_per_view
    view = np.repeat(np.arange(n_views), n_poses_per_view)
    pose = np.tile(np.arange(n_poses_per_view), n_views) if shared_poses else np.arange(n_rows)
    poses = [_pose(rng) for _ in range(int(pose.max()) + 1)]
    poses = [poses[k - k % repeats] for k in range(len(poses))]
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
        {(j, "rod"): RADIUS for j in range(6)},
        nearest,
        span=(0.08, 0.92),
    )
    white = np.tile(sigma_px**2 * np.eye(2), (2 * legs_seen * n_rows, 1, 1))
    outlines = replace(outlines_of(scene), covariance=white)
    radii = {(i, "rod"): RADIUS for i in range(6)}
    legs = FittedLegs(names, point_like_legs(TRUTH), FRAME_LEGS, radii)
    return HexapodSession(legs, measurements, outlines, TRUTH, T_cameras, tuple(poses))


def noisy_outlines(session: HexapodSession, rng: np.random.Generator) -> Outlines:
    """Return outlines with Gaussian errors of their claimed covariances."""
    return observe.noisy_outlines(session.outlines, session.measurements.views[0].camera, rng)


def noisy_readings(session: HexapodSession, rng: np.random.Generator) -> Measurements:
    """Return measurements with Gaussian errors in the readings, equal within a pose."""
    m = session.measurements
    error = m.sigma_q * rng.standard_normal((m.n_poses, m.q.shape[1]))
    return replace(m, q=m.q + error[m.pose])


def disturbed_start(
    session: HexapodSession,
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
        point_like_legs(from_vector(xi, 6, FRAME_LEGS)),
        tuple(_shaken(T, camera, angle, rng) for T in session.T_camera_Rb),
        tuple(_shaken(T, camera, angle, rng) for T in session.T_Rb_Re),
        "nominal",
    )


def joint_errors(parameters: KinematicParameters) -> Array:
    """Return the errors of the free parameters [m]."""
    return to_vector(parameters, FRAME_LEGS) - to_vector(TRUTH, FRAME_LEGS)


def _camera_around(angle: float) -> RigidTransform:
    """Return T_camera_Rb of a camera 0.9 m away that looks at the middle of the machine."""
    middle = np.array([0.23, 0.15, 0.17])
    centre = middle + np.array([0.9 * np.cos(angle), 0.9 * np.sin(angle), 0.1])
    return look_at(centre, middle).inv()


def _pose(rng: np.random.Generator) -> RigidTransform:
    home = Rotation.from_rotvec([0.0, 0.0, 0.6])
    tilt = Rotation.from_rotvec(rng.uniform(-0.18, 0.18, 3))
    translation = np.array([0.14, -0.05, 0.34]) + rng.uniform(-0.03, 0.03, 3)
    return RigidTransform.from_components(translation, tilt * home)


# A calibration board on the base of a machine

BOARD = Board("chessboard", 7, 6, 0.025)
SIGMA_PX = 0.05
BOARD_SCALE = "board.scale"


def place_of_board(session: MachineSession) -> RigidTransform:
    """Return T_Rb_board: it lies flat under the middle of the legs, its z down into the base."""
    ends = [leg.A for leg in session.truth.legs]
    ends += [T.apply(leg.B) for T in session.truth.T_Rb_Re[:1] for leg in session.truth.legs]
    middle = np.mean(ends, axis=0) - BOARD.points.mean(axis=0)
    turn = Rotation.from_euler("xz", [np.pi, 0.4])
    return RigidTransform.from_components(middle, turn)


def corners_of(
    session: MachineSession, board: Board = BOARD, *, seed: int | None = None
) -> Corners:
    """Return the corners in every image, exact or with the errors that they claim."""
    T_Rb_board = place_of_board(session)
    seen, views = [], session.measurements.view
    for row, v in enumerate(views.tolist()):
        camera = session.measurements.views[v].camera
        in_camera = (session.truth.T_camera_Rb[v] * T_Rb_board).apply(board.points)
        seen.append((np.full(len(in_camera), row), camera.project(in_camera)))
    of_row = np.concatenate([r for r, _ in seen])
    px: Array = np.concatenate([p for _, p in seen])
    if seed is not None:
        px = px + SIGMA_PX * np.random.default_rng(seed).standard_normal(px.shape)
    corner = np.tile(np.arange(board.n_corners), len(views))
    return found_corners(of_row, corner, px, np.full(len(px), SIGMA_PX))


def with_board(session: MachineSession, corners: Corners) -> tuple[BoardCorners, Start]:
    """Return what is seen of the board, and the wrong start with a board that is wrong as well."""
    start = replace(session.start, T_Rb_board=place_of_board(session) * _WRONG)
    return BoardCorners((FixedBoard(BOARD, "base"),), corners), start


# A calibration board on the platform, beside the one on the base or alone

ON_PLATFORM = Board("charuco", 7, 5, 0.02, marker=0.014, dictionary="DICT_5X5_50")
T_RE_BOARD = RigidTransform.from_components([0.05, 0.04, 0.03], Rotation.from_rotvec([3.0, 0.4, 0]))
_WRONG = RigidTransform.from_components([0.004, -0.003, 0.005], Rotation.from_rotvec([0.02] * 3))


def with_boards(
    session: MachineSession, *, seed: int | None = None, base: bool = True
) -> tuple[BoardCorners, Start]:
    """Return what is seen of a board on the platform and one on the base, and the wrong start."""
    first = BOARD.n_corners if base else 0
    fixed = FixedBoard(ON_PLATFORM, "platform", None, first)
    m, truth = session.measurements, session.truth
    places = [truth.T_Rb_Re[p] * T_RE_BOARD for p in m.pose.tolist()]
    px: Array = np.concatenate(
        [
            m.views[v].camera.project((truth.T_camera_Rb[v] * T).apply(ON_PLATFORM.points))
            for v, T in zip(m.view.tolist(), places, strict=True)
        ]
    )
    if seed is not None:
        px = px + SIGMA_PX * np.random.default_rng([seed, 1]).standard_normal(px.shape)
    n = ON_PLATFORM.n_corners
    row, corner = np.repeat(np.arange(m.n_rows), n), np.tile(first + np.arange(n), m.n_rows)
    corners = found_corners(row, corner, px, np.full(len(px), SIGMA_PX))
    start = replace(session.start, T_Re_board=T_RE_BOARD * _WRONG)
    if not base:
        return BoardCorners((fixed,), corners), start
    start = replace(start, T_Rb_board=place_of_board(session) * _WRONG)
    on_base = corners_of(session, seed=seed)
    boards = FixedBoard(BOARD, "base"), fixed
    return BoardCorners(boards, Corners.joined([on_base, corners])), start


# Axes of the hexapod of section 4.3


def with_camera(
    measurements: Measurements, outlines: Outlines, camera: Camera
) -> tuple[Measurements, Outlines]:
    """Return the same pixels, taken for those of another camera."""
    views = tuple(replace(view, camera=camera) for view in measurements.views)
    xy = camera.undistort(outlines.ends)
    rays = np.concatenate([xy, np.ones((*xy.shape[:-1], 1))], axis=-1)
    h = np.cross(rays[:, 0], rays[:, 1])
    h /= np.linalg.norm(h, axis=1, keepdims=True)
    h *= np.sign(np.sum(h * outlines.h, axis=1, keepdims=True))
    return replace(measurements, views=views), replace(outlines, h=h)


def body_edges(session: MachineSession, sigma_px: float = 0.1, seed: int | None = None) -> Outlines:
    """Return edges of prismatic bodies on all legs of a session, which have turned as they like.

    Two in each image, 25 mm from the axis; with noise at their ends if a seed is given.
    """
    m, truth, rng = session.measurements, session.truth, np.random.default_rng(7)
    rows = [(row, j) for row in range(m.n_rows) for j in range(len(truth.legs)) for _ in range(2)]
    ends = []
    for row, j in rows:
        T, camera = truth.T_camera_Rb[m.view[row]], m.views[m.view[row]].camera
        pose = m.pose[row]
        R, t = components([truth.T_Rb_Re[pose]])
        q = measured_readings(truth.legs, R, t, m.q_of_poses[[pose]])
        A_Rb, B_Rb = ends_at_poses(truth.legs, R, t, q)
        A, B = T.apply(A_Rb[0, j]), T.apply(B_Rb[0, j])
        u = (B - A) / np.linalg.norm(B - A)
        away = np.cross(u, rng.standard_normal(3))
        away *= 0.025 / np.linalg.norm(away)
        ends.append(camera.project(np.stack([A + 0.3 * (B - A), A + 0.8 * (B - A)]) + away))
    n, pixels = len(rows), np.array(ends)
    if seed is not None:
        along = pixels[:, 1] - pixels[:, 0]
        normal = np.stack([-along[:, 1], along[:, 0]], axis=1)
        normal /= np.linalg.norm(normal, axis=1)[:, None]
        noise = np.random.default_rng(seed).standard_normal((n, 2, 1))
        pixels = pixels + sigma_px * noise * normal[:, None]
    return Outlines(
        row=np.array([row for row, _ in rows]),
        leg=np.array([j for _, j in rows]),
        part=tuple(f"{session.legs.names[j]}_body" for _, j in rows),
        edge=np.tile([3, 4], n // 2),
        h=np.full((n, 3), np.nan),
        ends=pixels,
        covariance=np.tile(sigma_px**2 * np.eye(2), (n, 1, 1)),
        used=np.ones(n, dtype=np.bool_),
        reason=(USED,) * n,
        source=("detected",) * n,
        **unmeasured(n),
    )
