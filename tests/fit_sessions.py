"""Sessions in memory for the tests of steps and fit: exact, noisy, and started from far away.

Outlines of any shipped machine, of a hexapod whose joints lie in no plane, corners of boards and
edges of bodies beside them.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache, cached_property
from typing import Any

import numpy as np
from outline_sessions import (
    NONCOPLANAR,
    closed_poses,
    exact_readings,
    moved_poses,
    shaken,
    true_machine,
)
from scipy.spatial.transform import RigidTransform, Rotation

from legcal.calibration.joint_fit.factors import BoardCorners
from legcal.calibration.joint_fit.fit import refine
from legcal.calibration.joint_fit.solution import Solution
from legcal.calibration.joint_fit.variables import (
    DEFAULT_SETTINGS,
    FittedLegs,
    RefinementSettings,
    Start,
    fitted_legs,
    start_from,
)
from legcal.data.corners import Corners, found_corners
from legcal.data.measurements import Measurements, View
from legcal.data.outlines import LegAxes, Outlines, axes_from_outlines, found_outlines
from legcal.data.reading_units import sigmas_of_legs
from legcal.geometry.motions import components, look_at, motions_of
from legcal.geometry.types import Array
from legcal.machine.kinematics import platform_in_base
from legcal.machine.leg import Leg
from legcal.machine.parameters import geometries, moved_legs
from legcal.machine.rods import (
    arms_at,
    ends_at_poses,
    measured_readings,
)
from legcal.paper.unknowns import NominalMachine
from legcal.simulation import observe
from legcal.simulation.observe import (
    Images,
    OutlineNoise,
    Scene,
    Viewpoint,
    moved_outlines,
    outlines_of,
)
from legcal.vision.board import Board, FixedBoard
from legcal.vision.camera import Camera
from legcal.vision.cylinder import outlines_of_axis, steps_to_outlines
from legcal.vision.visibility import Seen

K = np.array([[1290.0, 0.0, 518.0], [0.0, 1280.0, 380.0], [0.0, 0.0, 1.0]])
PINHOLE = Camera(K, 1024, 768)
LENS = Camera(K, 1024, 768, np.array([-0.12, 0.05, 1e-3, -5e-4, 0.0]))
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

    def noisy(self, seed: int | np.random.Generator, noise: float = 1.0) -> MachineSession:
        """Return the session with the errors that it claims, those of outlines times a factor."""
        rng, m, o = np.random.default_rng(seed), self.measurements, self.outlines
        q = m.q + m.sigma_q * rng.standard_normal(m.q.shape)
        claimed = replace(o, covariance=noise**2 * o.covariance)
        outlines = observe.noisy_outlines(claimed, m.views[0].camera, rng)
        return replace(self, measurements=replace(m, q=q), outlines=outlines)

    def with_readings(self, q: Array) -> MachineSession:
        """Return the session with other readings (n_poses, n_legs)."""
        return replace(self, measurements=replace(self.measurements, q=q))

    def moved(self, offsets: Array) -> MachineSession:
        """Return the session with outlines moved across themselves by (n, 2) pixels at ends."""
        camera = self.measurements.views[0].camera
        return replace(self, outlines=moved_outlines(self.outlines, camera, offsets))

    def with_camera(self, camera: Camera) -> MachineSession:
        """Return the same pixels, taken for those of another camera."""
        measurements, outlines = with_camera(self.measurements, self.outlines, camera)
        return replace(self, measurements=measurements, outlines=outlines)

    def fit(
        self,
        start: Start | Sequence[Start] | None = None,
        settings: RefinementSettings = DEFAULT_SETTINGS,
        **others: Any,
    ) -> Solution:
        """Return the fit of all data, from the start of the session where none is given."""
        begin = self.start if start is None else start
        return refine(self.legs, self.measurements, self.outlines, begin, settings, **others)

    @property
    def nominal(self) -> NominalMachine:
        """The nominal legs as the four steps take them."""
        return NominalMachine(self.legs.names, self.legs.nominal, self.legs.frame_legs)

    @cached_property
    def axes(self) -> LegAxes:
        """The axes that the outlines give."""
        radii = {part: radius for (_, part), radius in self.legs.radii.items()}
        return axes_from_outlines(self.outlines, self.measurements, radii)

    @property
    def true_values(self) -> dict[str, float]:
        """The true kinematic parameters, counted from the nominal legs."""
        values = self.legs.vector(self.truth.legs).tolist()
        return dict(zip(self.legs.parametrization.names, values, strict=True))

    def errors(self, legs: Sequence[Leg]) -> Array:
        """Return the errors of the kinematic parameters of legs [m, rad]."""
        return self.legs.vector(tuple(legs)) - self.legs.vector(self.truth.legs)

    def off(self, legs: Sequence[Leg]) -> float:
        """Return the largest of these errors."""
        return float(np.abs(self.errors(legs)).max())

    def squares(self, found: Solution) -> float:
        """Return e' C^-1 e of the kinematic parameters over their number: 1 by rights."""
        e, C = self.errors(found.legs), found.kinematic.value_covariance
        sigma = np.sqrt(np.diagonal(C))
        z = e / sigma
        return float(z @ np.linalg.solve(C / np.outer(sigma, sigma), z)) / len(e)


@cache
def machine_session(
    name: str,
    *,
    camera_shift: float = 0.003,
    camera_turn: float = float(np.deg2rad(1.0)),
    n_views: int = 3,
    n_poses: int = 6,
    camera: Camera = LENS,
    distance: float = 4.0,
    repeats: int = 1,
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
    distance : float
        From the cameras to the middle of the machine, in sizes of it.
    repeats : int
        How often in succession the platform comes to each place, with a pose of its own each time.
    """
    rng = np.random.default_rng(0)
    machine = true_machine(name)
    legs, home = geometries(machine), platform_in_base(machine, machine.home)
    fitted = replace(fitted_legs(machine), home=home)
    R, t = components((home,) * (n_views * n_poses))
    lengths = [np.linalg.norm(R[0] @ leg.B + t[0] - leg.A) for leg in legs]
    step = rng.uniform(-1.0, 1.0, (len(t), 6)) * np.repeat([_TURN, _SHIFT * np.mean(lengths)], 3)
    R, t = closed_poses(legs, machine.frame_legs, *moved_poses(R, t, step))
    first = np.arange(len(t)) // repeats * repeats
    R, t = R[first], t[first]
    q, view = exact_readings(legs, R, t), np.repeat(np.arange(n_views), n_poses)
    T_camera_Rb = _cameras(home, legs, n_views, distance)
    measurements = Measurements(
        tuple(View(f"c{v + 1}", camera) for v in range(n_views)),
        tuple(f"c{v + 1}_{i:03d}.png" for i, v in enumerate(view)),
        view,
        np.arange(len(view)),
        q,
        sigmas_of_legs(legs, SIGMA_Q),
    )
    truth = Start(legs, T_camera_Rb, motions_of(R, t), "truth")
    away = _wrong(fitted, legs, 0.003, float(np.deg2rad(1.0)), rng)
    rough = tuple(shaken(T, camera_shift, camera_turn, rng) for T in T_camera_Rb)
    wrong, at_home = replace(fitted, nominal=away), (home,) * len(t)
    return MachineSession(
        wrong,
        measurements,
        _shown_outlines(fitted.radii, measurements, truth, q),
        truth,
        start_from(away, measurements, wrong, rough, at_home, "nominal"),
    )


def _cameras(
    home: RigidTransform, legs: tuple[Leg, ...], n_views: int, distance: float
) -> tuple[RigidTransform, ...]:
    """Return T_camera_Rb of cameras around the middle of the machine."""
    joints = np.array([leg.A for leg in legs] + [home.apply(leg.B) for leg in legs])
    middle = joints.mean(axis=0)
    size = np.linalg.norm(joints - middle, axis=1).max()
    found = []
    for v in range(n_views):
        turn = 0.4 + 2.1 * v
        outward = np.array([np.cos(turn), np.sin(turn), 0.35 + 0.1 * v])
        centre = middle + distance * size * outward / np.linalg.norm(outward)
        found.append(look_at(centre, middle).inv())
    return tuple(found)


def _shown_outlines(
    radii: Mapping[tuple[int, str], float], m: Measurements, truth: Start, q: Array
) -> Outlines:
    """Return both outlines of every part of every leg in every image; nothing is hidden.

    Joints at A that motors move are where readings q (n_poses, n_legs) have them.
    """
    R, t = components(truth.T_Rb_Re)
    read = measured_readings(truth.legs, R, t, q)
    A, B = ends_at_poses(truth.legs, R, t, read)
    arms = arms_at(truth.legs, read)
    links = {j: arm.link for j in arms if (arm := truth.legs[j].arm) is not None}
    of_arm = np.array([links.get(j) == part for j, part in radii], dtype=np.bool_)
    leg, radius = np.array([j for j, _ in radii]), np.array(list(radii.values()))
    span, shown = np.array([0.15, 0.85]), list[Seen]()  # the part of their length that is seen
    for v, k in zip(m.view.tolist(), m.pose.tolist(), strict=True):
        ends = np.array(
            [
                arms[j][k] if moved else (A[k, j], B[k, j])
                for j, moved in zip(leg, of_arm, strict=True)
            ]
        )
        ends = truth.T_camera_Rb[v].apply(ends.reshape(-1, 3)).reshape(-1, 2, 3)
        along = ends[:, 1] - ends[:, 0]
        h = outlines_of_axis(
            along / np.linalg.norm(along, axis=1, keepdims=True), ends[:, 0], radius
        )
        axis = ends[:, :1] + span[:, None] * along[:, None]
        touching = axis[:, None] + steps_to_outlines(h, radius)[:, :, None]
        px = m.views[v].camera.project(touching)
        length = np.linalg.norm(px[:, :, 1] - px[:, :, 0], axis=-1).mean(axis=1)
        parts = tuple(part for _, part in radii)
        view = np.zeros(len(leg), dtype=np.intp)
        shown.append(Seen(view, leg, of_arm, parts, h, px, np.tile(span, (len(leg), 1)), length))
    views = [
        Viewpoint(view.name, view.camera, T.inv())
        for view, T in zip(m.views, truth.T_camera_Rb, strict=True)
    ]
    images = Images(m.view, m.pose, np.zeros(m.n_rows, dtype=np.intp), tuple(shown))
    return outlines_of(Scene(A, B, tuple(views), images), OutlineNoise(0.2, 150))


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


def disturbed_start(
    session: MachineSession,
    *,
    joints: float = 0.002,
    camera: float = 0.005,
    angle: float = 0.01,
    seed: int = 1,
) -> Start:
    """Return a start whose every parameter, camera and pose is wrong by that much [m, rad]."""
    rng, truth = np.random.default_rng(seed), session.truth
    return Start(
        _wrong(session.legs, truth.legs, joints, angle, rng),
        tuple(shaken(T, camera, angle, rng) for T in truth.T_camera_Rb),
        tuple(shaken(T, camera, angle, rng) for T in truth.T_Rb_Re),
        "nominal",
    )


@cache
def irregular_hexapod(
    n_poses: int = 15,
    *,
    legs_seen: int = 4,
    sigma_px: float = 0.1,
    n_views: int = 3,
    repeats: int = 1,
) -> MachineSession:
    """Return a session of a hexapod whose joints lie in no plane.

    Each view shows the tubes of the legs whose base joints are nearest to it, and ends of outlines
    have errors that do not depend on each other.
    """
    session = machine_session(
        NONCOPLANAR, n_views=n_views, n_poses=n_poses, camera=PINHOLE, distance=2.5, repeats=repeats
    )
    A = np.array([leg.A for leg in session.truth.legs])
    depth = np.array([T.apply(A)[:, 2] for T in session.truth.T_camera_Rb])
    is_near = depth.argsort(axis=1).argsort(axis=1) < legs_seen
    o = session.outlines
    is_tube = np.array([part.endswith("_tube") for part in o.part])
    shown = o.choose(is_tube & is_near[session.measurements.view[o.row], o.leg])
    white = np.tile(sigma_px**2 * np.eye(2), (len(shown), 1, 1))
    return replace(session, outlines=replace(shown, covariance=white))


# A calibration board on the base of a machine

BOARD = Board("chessboard", 7, 6, 0.025)
ON_BASE = FixedBoard(BOARD, "base")
SIGMA_PX = 0.05
BOARD_SCALE = "board.scale"


def place_of_board(session: MachineSession) -> RigidTransform:
    """Return T_Rb_board: it lies flat under the middle of the legs, its z down into the base."""
    ends = [leg.A for leg in session.truth.legs]
    ends += [T.apply(leg.B) for T in session.truth.T_Rb_Re[:1] for leg in session.truth.legs]
    middle = np.mean(ends, axis=0) - BOARD.points.mean(axis=0)
    turn = Rotation.from_euler("xz", [np.pi, 0.4])
    return RigidTransform.from_components(middle, turn)


def _corners(
    session: MachineSession,
    fixed: FixedBoard,
    places: Sequence[RigidTransform],  # T_Rb_board of each image
    seed: Sequence[int] | None,
) -> Corners:
    """Return the corners in every image, exact or with the errors that they claim."""
    m, points = session.measurements, fixed.board.points
    px: Array = np.concatenate(
        [
            m.views[v].camera.project((session.truth.T_camera_Rb[v] * T).apply(points))
            for v, T in zip(m.view.tolist(), places, strict=True)
        ]
    )
    if seed is not None:
        px = px + SIGMA_PX * np.random.default_rng(seed).standard_normal(px.shape)
    row = np.repeat(np.arange(m.n_rows), len(points))
    corner = np.tile(fixed.first + np.arange(len(points)), m.n_rows)
    return found_corners(row, corner, px, np.full(len(px), SIGMA_PX))


def corners_of(session: MachineSession, *, seed: int | None = None) -> Corners:
    """Return the corners of the board on the base."""
    places = [place_of_board(session)] * session.measurements.n_rows
    return _corners(session, ON_BASE, places, None if seed is None else [seed])


def with_board(session: MachineSession, corners: Corners) -> tuple[BoardCorners, Start]:
    """Return what is seen of the board, and the wrong start with a board that is wrong as well."""
    start = replace(session.start, T_Rb_board=place_of_board(session) * _WRONG)
    return BoardCorners((ON_BASE,), corners), start


# A calibration board on the platform, beside the one on the base or alone

ON_PLATFORM = Board("charuco", 7, 5, 0.02, marker=0.014, dictionary="DICT_5X5_50")
T_RE_BOARD = RigidTransform.from_components([0.05, 0.04, 0.03], Rotation.from_rotvec([3.0, 0.4, 0]))
_WRONG = RigidTransform.from_components([0.004, -0.003, 0.005], Rotation.from_rotvec([0.02] * 3))


def with_boards(
    session: MachineSession, *, seed: int | None = None, base: bool = True
) -> tuple[BoardCorners, Start]:
    """Return what is seen of a board on the platform and one on the base, and the wrong start."""
    fixed = FixedBoard(ON_PLATFORM, "platform", None, BOARD.n_corners if base else 0)
    places = [session.truth.T_Rb_Re[p] * T_RE_BOARD for p in session.measurements.pose.tolist()]
    corners = _corners(session, fixed, places, None if seed is None else [seed, 1])
    if not base:
        start = replace(session.start, T_Re_board=T_RE_BOARD * _WRONG)
        return BoardCorners((fixed,), corners), start
    seen, start = with_board(session, corners_of(session, seed=seed))
    both = BoardCorners((ON_BASE, fixed), Corners.joined([seen.corners, corners]))
    return both, replace(start, T_Re_board=T_RE_BOARD * _WRONG)


# The same pixels otherwise, and edges of bodies


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
    return found_outlines(
        np.array([row for row, _ in rows]),
        np.array([j for _, j in rows]),
        tuple(f"{session.legs.names[j]}_body" for _, j in rows),
        np.tile([3, 4], n // 2),
        np.full((n, 3), np.nan),
        pixels,
        np.tile(sigma_px**2 * np.eye(2), (n, 1, 1)),
    )
