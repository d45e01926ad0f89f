"""Platform poses that readings do not give, found in images together with their cameras.

A platform that is moved by hand, or has fewer motors than freedoms, is at a pose of its own in
every image. Base joints stay where they are, so that a rough camera pose says where each leg
begins: poses drawn from the workspace are judged by the edge pairs of their images, the better ones
improved by Gauss-Newton steps, and cameras and poses of all images fitted to their pairs in turn.
Readings and the constraints of legs hold as far as the nominal model has them.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np
from scipy.spatial.transform import RigidTransform, Rotation

from legcal.data import Measurements, few_views
from legcal.errors import NotIdentifiable
from legcal.estimation import (
    Factor,
    Frames,
    GaussianPrior,
    Problem,
    Residuals,
    Variables,
    all_free,
    information,
    linearize,
)
from legcal.geometry import Array, BoolArray, IntArray, cross, motion_of
from legcal.machine import LegKind, Machine, machine_equations, poses_after, random_poses
from legcal.perception.candidate_pairs import CandidatePairs
from legcal.perception.pair_matching import (
    CameraPoses,
    Picture,
    Pictures,
    leg_segments,
    match_pairs,
    segment_equations,
)
from legcal.perception.placement import Search, sensor_extent
from legcal.workers import Run

N_DRAWN, SEED = 400, 1965  # poses that are tried in every image
KEPT = (40, 8, 3)  # of them, after each of the first tolerances
TOLERANCES = (0.05, 0.035, 0.025, 0.018)  # of an axis beside its pair, cameras being rough [m]
FITTED = (0.025, 0.018, 0.012, 0.008, 0.006, 0.006)  # of all images together
EQUATION_SIGMA = 3e-3  # of lengths and constraints by the nominal model [m]
TRAVEL_SIGMA = 5e-3  # beyond the travel of a slider without a motor [m]
CAMERA_SIGMA = 0.03, 0.03  # of a rough pose: angle, part of the distance
TURN_SIGMA, PLACE_SIGMA = 0.1, 0.1  # of a pose that its images do not determine [rad], leg lengths
MAX_STEP = 3.0  # of these, in one step
ROUNDS = 2  # of a search in each image and a fit of all


@dataclass(frozen=True, eq=False)
class FreePoses:
    """Where platforms and cameras are by the edge pairs of the images."""

    T_base_platform: dict[int, RigidTransform]  # of every pose that images show
    T_base_camera: tuple[RigidTransform | None, ...]  # of every view


@dataclass(frozen=True, eq=False)
class _Image:
    """An image of a pose."""

    view: int
    pairs: CandidatePairs
    corners: Array  # (2, 2) of its sensor plane


@dataclass(frozen=True, eq=False)
class _Scene:
    """What is known of the machine; it travels to worker processes."""

    machine: Machine
    wanted: BoolArray  # (n_views, n_legs)
    q: Array  # (n_poses, n_legs) readings; of motors alone they have a meaning
    drawn: Array  # (n_drawn, 3, 4) poses of the workspace
    images: Mapping[int, Sequence[_Image]]  # by pose

    @property
    def size(self) -> float:
        """The mean length of the legs in the workspace [m]."""
        B = self.drawn[:, :, :3] @ self.machine.B_platform.T + self.drawn[:, :, 3:]
        return float(np.linalg.norm(B.swapaxes(1, 2) - self.machine.A_base, axis=2).mean())

    def pictures(
        self, poses: Array, of_pose: Sequence[int], cameras: Sequence[RigidTransform | None]
    ) -> tuple[list[Picture], IntArray, IntArray]:
        """Return what images show and should show with the platform at poses (n, 3, 4).

        With the index of the pose, and the view, of each; *of_pose* is the pose of the measurements
        whose images they are.
        """
        found, index, views = list[Picture](), list[int](), list[int]()
        machine = self.machine
        cylinders = [leg.cylinders for leg in machine.legs]
        for n, (pose, k) in enumerate(zip(poses, of_pose, strict=True)):
            B = machine.B_platform @ pose[:, :3].T + pose[:, 3]
            for image in self.images[k]:
                T_base_camera = cameras[image.view]
                if T_base_camera is None:
                    continue
                legs = np.flatnonzero(self.wanted[image.view])
                targets = leg_segments(machine.A_base, B, cylinders, legs)
                T = T_base_camera.inv()
                R = T.rotation.as_matrix()
                found.append(Picture(image.pairs, targets, image.corners, R, T.translation))
                index.append(n)
                views.append(image.view)
        return found, np.array(index, dtype=np.intp), np.array(views, dtype=np.intp)


def find_free_poses(
    search: Search,
    machine: Machine,
    rows: Sequence[int],
    hints: Sequence[RigidTransform | None],
    run: Run,
    progress: Callable[[int], None],
) -> FreePoses:
    """Find the platform poses that the images of rows show, and their cameras, near rough ones.

    Raises
    ------
    NotIdentifiable
        If a view has no rough camera pose.
    """
    m = search.measurements
    require_rough_cameras(m, rows, hints)
    images: dict[int, list[_Image]] = {}
    for row, pairs in zip(rows, run(search.own_pairs, rows), strict=True):
        view = int(m.view[row])
        image = _Image(view, pairs, sensor_extent(m.views[view].camera))
        images.setdefault(int(m.pose[row]), []).append(image)
    drawn = np.array([T.as_matrix()[:3] for T in random_poses(machine, N_DRAWN, SEED)[1]])
    scene = _Scene(machine, search.wanted, m.q[m.first_rows], drawn, images)
    poses, cameras = dict[int, Array](), tuple(hints)
    for _ in range(ROUNDS):
        for k, found in zip(images, run(partial(_searched, scene, cameras), images), strict=True):
            poses[k] = found
            for _ in images[k]:
                progress(k)
        poses, cameras = _fitted(scene, poses, cameras)
    return FreePoses({k: motion_of(at[:, :3], at[:, 3]) for k, at in poses.items()}, cameras)


def require_rough_cameras(
    measurements: Measurements, rows: Sequence[int], cameras: Sequence[RigidTransform | None]
) -> None:
    """Refuse views of images without a rough camera pose, where readings do not give the poses."""
    views = sorted({int(measurements.view[row]) for row in rows})
    missing = [measurements.views[v].name for v in views if cameras[v] is None]
    if missing:
        raise NotIdentifiable(
            f"{few_views(missing)}: the images could not be searched: found no rough camera pose, "
            "needed one (2 cm, 2 deg), since the motors do not determine the pose of the platform; "
            "write T_base_camera into dataset.yaml."
        )


def _searched(scene: _Scene, cameras: Sequence[RigidTransform | None], k: int) -> Array:
    """Return the pose (3, 4) at which the images of pose *k* show most legs."""
    poses = scene.drawn
    for i, tolerance in enumerate(TOLERANCES):
        poses = _stepped(scene, cameras, k, poses, tolerance)
        score = _scores(scene, cameras, k, poses, tolerance)
        if i < len(KEPT):
            poses = poses[np.argsort(-score, kind="stable")[: KEPT[i]]]
    score = _scores(scene, cameras, k, poses, TOLERANCES[-1])
    return np.asarray(poses[int(np.argmax(score))])


def _scores(
    scene: _Scene,
    cameras: Sequence[RigidTransform | None],
    k: int,
    poses: Array,
    tolerance: float,
) -> Array:
    """Return how many legs agree with each pose (n, 3, 4), less what the model says against it."""
    pictures, index, _ = scene.pictures(poses, [k] * len(poses), cameras)
    every = Pictures.of(pictures)
    found = match_pairs(every, _as_they_are(len(scene.machine.legs)), tolerance)
    value = (found.exclusive_score[:, 0] * every.share).sum(axis=1)
    score = np.bincount(index, value, minlength=len(poses))
    residual, _ = _model_rows(scene, poses, np.full(len(poses), k))
    return np.asarray(score - 0.01 * np.sum(residual**2, axis=1))


def _stepped(
    scene: _Scene,
    cameras: Sequence[RigidTransform | None],
    k: int,
    poses: Array,
    tolerance: float,
) -> Array:
    """Return poses (n, 3, 4) after a Gauss-Newton step towards the pairs that they match."""
    pictures, index, _ = scene.pictures(poses, [k] * len(poses), cameras)
    rows, _ = _line_rows(scene, pictures, index, poses, tolerance)
    residual, jacobian = _model_rows(scene, poses, np.full(len(poses), k))
    H = jacobian.swapaxes(1, 2) @ jacobian
    b = -(jacobian.swapaxes(1, 2) @ residual[..., None])[..., 0]
    np.add.at(H, index, np.einsum("krx,kry->kxy", rows[..., 1:], rows[..., 1:]))
    np.add.at(b, index, -np.einsum("krx,kr->kx", rows[..., 1:], rows[..., 0]))
    unit = np.array([TURN_SIGMA] * 3 + [PLACE_SIGMA * scene.size] * 3)
    step = np.linalg.solve(H + np.diag(unit**-2), b[..., None])[..., 0]
    longest = np.abs(step / unit).max(axis=1, keepdims=True)
    return poses_after(poses, step * np.minimum(1.0, MAX_STEP / longest))


def _as_they_are(n_legs: int) -> CameraPoses:
    """Return the pose of the base link in its own frame: pictures know their cameras."""
    return CameraPoses.rigid(np.eye(3)[None], np.zeros((1, 3)), n_legs)


def _line_rows(
    scene: _Scene, pictures: Sequence[Picture], index: IntArray, poses: Array, tolerance: float
) -> tuple[Array, Array]:
    """Return whitened rows of lines (n_pictures, 2 n_segments, 7): residual, derivatives by pose.

    With derivatives (n_pictures, 2 n_segments, 6) by a motion of everything in the base link.
    """
    every = Pictures.of(pictures)
    base = _as_they_are(len(scene.machine.legs))
    found = match_pairs(every, base, tolerance)
    J, J_leg, residual, weight = segment_equations(every, base, found, tolerance)
    root = np.sqrt(weight[:, 0, :, :2])  # (n_pictures, n_segments, 2)
    arm = np.einsum("kxy,ksy->ksx", poses[index, :, :3], scene.machine.B_platform[every.leg])
    by_B = J_leg[:, 0, :, :, 3:]
    by_pose = np.concatenate([cross(arm[:, :, None], by_B), by_B], axis=-1)
    flat = len(pictures), -1
    rows = np.concatenate([residual[:, 0, :, :2, None], by_pose], axis=-1) * root[..., None]
    by_base = J[:, 0, :, :2] * root[..., None]
    return rows.reshape(*flat, 7), by_base.reshape(*flat, 6)


def _model_rows(scene: _Scene, poses: Array, k: IntArray) -> tuple[Array, Array]:
    """Return whitened residuals (n, m) of readings, constraints and travel, and derivatives."""
    machine = scene.machine
    found = machine_equations(machine, poses[:, :, :3], poses[:, :, 3])
    wanted = np.zeros_like(found.values)
    measured = found.measured
    wanted[:, measured] = (machine.sign * scene.q[k])[:, found.leg[measured]]
    values, jacobian = (found.values - wanted) / EQUATION_SIGMA, found.by_pose / EQUATION_SIGMA
    arm = machine.B_platform @ poses[:, :, :3].swapaxes(1, 2)
    vector = arm + poses[:, None, :, 3] - machine.A_base
    length = np.linalg.norm(vector, axis=2)
    ends = [
        sorted(leg.length_at(x) for x in leg.travel)
        if leg.kind is LegKind.PASSIVE and not leg.is_fixed_to_platform
        else (0.0, np.inf)
        for leg in machine.legs
    ]
    low, high = np.array(ends).T
    beyond = (length - np.clip(length, low, high)) / TRAVEL_SIGMA
    u = vector / length[..., None] * (beyond != 0.0)[..., None] / TRAVEL_SIGMA
    by_travel = np.concatenate([cross(arm, u), u], axis=2)
    return np.concatenate([values, beyond], axis=1), np.concatenate([jacobian, by_travel], axis=1)


@dataclass(frozen=True, eq=False)
class _State:
    """What the fit of all images moves."""

    camera: Frames  # T_camera_base, one a view that is used
    platform: Frames  # T_base_platform, one a pose that has images

    @property
    def poses(self) -> Array:
        """The platform poses, (n_poses, 3, 4)."""
        return np.concatenate([self.platform.R, self.platform.t[..., None]], axis=2)


def _fitted(
    scene: _Scene, poses: dict[int, Array], cameras: Sequence[RigidTransform | None]
) -> tuple[dict[int, Array], tuple[RigidTransform | None, ...]]:
    """Return poses and cameras after steps of all of them together towards the pairs."""
    keys = np.array(sorted(poses), dtype=np.intp)
    images = [(i, image) for i, k in enumerate(keys.tolist()) for image in scene.images[k]]
    views = sorted({image.view for _, image in images})
    element = np.array([i for i, _ in images], dtype=np.intp)
    view = np.array([views.index(image.view) for _, image in images], dtype=np.intp)
    camera = Frames.of([T.inv() for v in views if (T := cameras[v]) is not None])
    at = np.array([poses[k] for k in keys.tolist()])
    state = _State(camera, Frames(at[..., :3], at[..., 3]))
    n_rows = 4 * sum(len(leg.cylinders) for leg in scene.machine.legs)  # at most, of an image
    unit = np.array([TURN_SIGMA] * 3 + [PLACE_SIGMA * scene.size] * 3)

    def placed(state: _State) -> tuple[RigidTransform | None, ...]:
        found = list(cameras)
        for v, T in zip(views, state.camera.motions, strict=True):
            found[v] = T.inv()
        return tuple(found)

    def lines(state: _State, tolerance: float) -> Residuals:
        pictures, index, _ = scene.pictures(state.poses, keys.tolist(), placed(state))
        rows, by_base = _line_rows(scene, pictures, index, state.poses, tolerance)
        R = state.camera.R[view].swapaxes(1, 2)
        by_camera = np.concatenate([by_base[..., :3] @ R, by_base[..., 3:] @ R], axis=-1)
        fill = ((0, 0), (0, n_rows - rows.shape[1]), (0, 0))
        rows, by_camera = np.pad(rows, fill), np.pad(by_camera, fill)
        return Residuals.of(rows[..., 0], by_camera, rows[..., 1:])

    def model(state: _State) -> Residuals:
        r, J = _model_rows(scene, state.poses, keys)
        return Residuals.of(r, np.zeros((*r.shape, 0)), J)

    def stays(state: _State) -> Residuals:
        r = np.zeros((len(state.poses), 6))
        J = np.broadcast_to(np.diag(1.0 / unit), (len(r), 6, 6))
        return Residuals.of(r, np.zeros((len(r), 6, 0)), J)

    def from_start(now: Frames) -> Array:
        turn = Rotation.from_matrix(now.R @ camera.R.swapaxes(1, 2)).as_rotvec()
        return np.concatenate([turn, now.t - camera.t], axis=1).ravel()

    far = np.linalg.norm(camera.t, axis=1)[:, None] * np.full(3, CAMERA_SIGMA[1])
    sigma = np.concatenate([np.full_like(far, CAMERA_SIGMA[0]), far], axis=1).ravel()
    of_cameras = Variables(
        "camera",
        all_free(len(views), 6),
        Frames.moved,
        coordinates=from_start,
        prior=GaussianPrior(np.arange(len(sigma)), np.zeros(len(sigma)), sigma),
    )
    every, n_model = np.arange(len(keys)), model(state).r.shape[1]
    for tolerance in FITTED:
        problem = Problem[_State](
            (of_cameras,),
            Variables("platform", all_free(len(keys), 6), Frames.moved),
            (
                Factor(
                    "lines",
                    partial(lines, tolerance=tolerance),
                    (("camera", view, slice(None)),),
                    len(images),
                    n_rows,
                    element,
                ),
                Factor("model", model, (), len(keys), n_model, every),
                Factor("stays", stays, (), len(keys), 6, every),
            ),
        )
        step, _ = information(problem, state, linearize(problem, state)).step(0.0)
        longest = np.abs(step[-6 * len(keys) :].reshape(-1, 6) / unit).max()
        state = problem.moved(state, step * min(1.0, MAX_STEP / longest))
    return dict(zip(keys.tolist(), state.poses, strict=True)), placed(state)
