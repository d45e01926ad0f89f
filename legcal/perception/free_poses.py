"""Platform poses that readings do not give, found in images together with their cameras.

A platform that is moved by hand, or has fewer motors than freedoms, is at a pose of its own in
every image. Base joints stay where they are, so that a rough camera pose says where each leg
begins: poses drawn from the workspace are judged by the edge pairs of their images, the better ones
improved by Gauss-Newton steps, and cameras and poses of all images fitted to their pairs in turn.
Readings and the constraints of legs hold as far as the nominal model has them.

From far a platform that tilts towards the camera looks like one that tilts away from it, and pairs
do not tell them apart. So the best poses that differ are kept of every image: the outlines that
can be measured at each of them decide.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
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
from legcal.machine import (
    LegKind,
    Machine,
    is_constrained,
    leg_scale,
    machine_equations,
    poses_after,
    solve,
)
from legcal.perception.candidate_pairs import CandidatePairs
from legcal.perception.pair_matching import (
    CameraPoses,
    LegSegments,
    Picture,
    Pictures,
    leg_segments,
    match_pairs,
    segment_equations,
)
from legcal.perception.placement import Search, sensor_extent
from legcal.workers import Run

N_CHAINS, SEED = 100, 1965  # random walks through the workspace, all at once
STRIDE, STEPS, SNAPSHOTS = 0.12, 48, (24, 32, 40, 48)  # [rad] and leg lengths; poses that are tried
KEPT = (100, 30, 8, 3)  # of them, before a step with each of these tolerances
TOLERANCES = (0.05, 0.035, 0.025, 0.018)  # of an axis beside its pair, cameras being rough [m]
FITTED = (0.025, 0.018, 0.012, 0.008, 0.006, 0.006)  # of all images together
EQUATION_SIGMA = 3e-3  # of lengths and constraints by the nominal model [m]
TRAVEL_SIGMA = 5e-3  # beyond the travel of a slider without a motor [m]
# Of the score, for squares of what the model says against a pose; larger ones count no more.
MODEL_COST, MODEL_WIDTH = 0.01, 5.0
CAMERA_SIGMA = 0.03, 0.03  # of a rough pose: angle, part of the distance
TURN_SIGMA, PLACE_SIGMA = 0.1, 0.1  # of a pose that its images do not determine [rad], leg lengths
MAX_STEP = 3.0  # of these, in one step
ROUNDS = 2  # of a search in each image and a fit of all
CHOICES, APART = 3, 0.12  # poses of an image that are kept, as far apart [leg lengths of joints]
ALL_ALIKE = 30  # so many or fewer poses in a step of the search differ


@dataclass(frozen=True, eq=False)
class FreePoses:
    """Where platforms and cameras are by the edge pairs of the images."""

    # Of every pose that images show, the likeliest first
    T_base_platform: dict[int, tuple[RigidTransform, ...]]
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
    targets: tuple[LegSegments, ...]  # what is to be seen at them
    images: Mapping[int, Sequence[_Image]]  # by pose

    @classmethod
    def of(
        cls, machine: Machine, wanted: BoolArray, q: Array, images: Mapping[int, Sequence[_Image]]
    ) -> _Scene:
        """Return the scene of a machine and its images."""
        drawn = _drawn(machine)
        return cls(machine, wanted, q, drawn, tuple(_targets(machine, drawn)), images)

    def pictures(
        self,
        targets: Sequence[LegSegments],
        of_pose: Sequence[int],
        cameras: Sequence[RigidTransform | None],
    ) -> tuple[Pictures, IntArray]:
        """Return what images show and should show with the legs at poses, and the index of each.

        *of_pose* are the poses of the measurements whose images they are.
        """
        found, index = list[Picture](), list[int]()
        placed = [None if T is None else (T.rotation.as_matrix(), T.translation)
                  for T in (None if T is None else T.inv() for T in cameras)]  # fmt: skip
        for n, (own, k) in enumerate(zip(targets, of_pose, strict=True)):
            for image in self.images[k]:
                camera = placed[image.view]
                if camera is None:
                    continue
                shown = replace(own, share=own.share * self.wanted[image.view, own.leg])
                found.append(Picture(image.pairs, shown, image.corners, *camera))
                index.append(n)
        return Pictures.of(found), np.array(index, dtype=np.intp)


def _targets(machine: Machine, poses: Array) -> list[LegSegments]:
    """Return what is to be seen of all legs at poses (n, 3, 4)."""
    A, every = machine.A_base, np.arange(machine.n_legs)
    B = machine.B_platform @ poses[:, :, :3].swapaxes(1, 2) + poses[:, None, :, 3]
    cylinders = [leg.cylinders for leg in machine.legs]
    return [leg_segments(A, at, cylinders, every) for at in B]


def _drawn(machine: Machine) -> Array:
    """Return poses (n, 3, 4) of the workspace: inside the travel of all sliders, whatever they say.

    Steps of random walks from home that leave the travel are not taken.
    """
    rng = np.random.default_rng(SEED)
    size = leg_scale(machine, machine.home)
    unit = np.array([1.0] * 3 + [size] * 3)
    poses = np.repeat(machine.home.as_matrix()[None, :3], N_CHAINS, axis=0)
    found = []
    for step in range(1, STEPS + 1):
        moved = poses_after(poses, STRIDE * unit * rng.normal(size=(N_CHAINS, 6)))
        moved, is_closed = _constrained(machine, moved, size)
        inside = is_closed & (np.abs(_beyond_travel(machine, moved)[0]).max(axis=1) == 0.0)
        poses = np.where(inside[:, None, None], moved, poses)
        if step in SNAPSHOTS:
            found.append(poses)
    return np.concatenate(found)


def _constrained(machine: Machine, poses: Array, size: float) -> tuple[Array, BoolArray]:
    """Return the nearest poses that legs and plane allow, and which of them were found."""
    if not is_constrained(machine):
        return poses, np.ones(len(poses), dtype=np.bool_)

    def constraints(poses: Array) -> tuple[Array, Array]:
        found = machine_equations(machine, poses[:, :, :3], poses[:, :, 3])
        return found.values[:, ~found.measured], found.by_pose[:, ~found.measured]

    unit = np.array([1.0 / size] * 3 + [1.0] * 3)
    found = solve(constraints, poses_after, poses, tolerance=1e-6 * size, unit=unit, steps=10)
    return found.points, found.worst < 1e-3 * size


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
        If a view has no rough camera pose, or joints at A move.
    """
    m = search.measurements
    require_standing_joints(machine)
    require_rough_cameras(m, rows, hints)
    images: dict[int, list[_Image]] = {}
    for row, pairs in zip(rows, run(search.own_pairs, rows), strict=True):
        view = int(m.view[row])
        image = _Image(view, pairs, sensor_extent(m.views[view].camera))
        images.setdefault(int(m.pose[row]), []).append(image)
    scene = _Scene.of(machine, search.wanted, m.q_of_poses, images)
    every, cameras = dict[int, Array](), tuple(hints)
    for _ in range(ROUNDS):
        for k, found in zip(images, run(partial(_searched, scene, cameras), images), strict=True):
            every[k] = found
            for _ in images[k]:
                progress(k)
        best, cameras = _fitted(scene, {k: found[0] for k, found in every.items()}, cameras)
    for k, found in every.items():
        others = _stepped_often(scene, cameras, k, found[1:], FITTED[1:])
        every[k] = _apart(scene.machine, np.concatenate([best[k][None], others]), CHOICES)
    T = {k: tuple(motion_of(at[:, :3], at[:, 3]) for at in found) for k, found in every.items()}
    return FreePoses(T, cameras)


def require_standing_joints(machine: Machine) -> None:
    """Refuse to look for poses where joints at A move, so that nothing says where legs begin."""
    if machine.actuators:
        raise NotIdentifiable(
            "The images could not be searched: found joints at A that move and that "
            f"{machine.undetermined}, needed motors that do, or the outlines in observations.csv; "
            "name the other motors in name_mot of the model."
        )


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
    """Return the poses (n, 3, 4) at which the images of pose *k* show most legs, best first."""
    poses, targets = scene.drawn, list(scene.targets)
    for kept, tolerance in zip(KEPT, TOLERANCES, strict=True):
        score = _scores(scene, cameras, k, poses, targets, tolerance)
        poses = poses[np.argsort(-score, kind="stable")]
        poses = _apart(scene.machine, poses, kept) if kept <= ALL_ALIKE else poses[:kept]
        poses = _stepped_often(scene, cameras, k, poses, [tolerance] * (1 + (kept <= ALL_ALIKE)))
        targets = _targets(scene.machine, poses)
    score = _scores(scene, cameras, k, poses, targets, TOLERANCES[-1])
    return _apart(scene.machine, poses[np.argsort(-score, kind="stable")], CHOICES)


def _apart(machine: Machine, poses: Array, n: int) -> Array:
    """Return the first n poses (m, 3, 4) that are not near an earlier one."""
    ends = machine.B_platform @ poses[:, :, :3].swapaxes(1, 2) + poses[:, None, :, 3]
    off = np.linalg.norm(ends[:, None] - ends, axis=3)
    near = np.sqrt(np.mean(off**2, axis=2)) < APART * leg_scale(machine, machine.home)
    kept = list[int]()
    for i in range(len(poses)):
        if len(kept) < n and not near[i, kept].any():
            kept.append(i)
    return poses[kept]


def _stepped_often(
    scene: _Scene,
    cameras: Sequence[RigidTransform | None],
    k: int,
    poses: Array,
    tolerances: Sequence[float],
) -> Array:
    """Return poses (n, 3, 4) after a Gauss-Newton step with each tolerance."""
    for tolerance in tolerances if len(poses) else ():
        targets = _targets(scene.machine, poses)
        poses = _stepped(scene, cameras, k, poses, targets, tolerance)
    return poses


def _scores(
    scene: _Scene,
    cameras: Sequence[RigidTransform | None],
    k: int,
    poses: Array,
    targets: Sequence[LegSegments],
    tolerance: float,
) -> Array:
    """Return how many legs agree with each pose (n, 3, 4), less what the model says against it."""
    every, index = scene.pictures(targets, [k] * len(poses), cameras)
    found = match_pairs(every, _as_they_are(scene), tolerance)
    value = (found.exclusive_score[:, 0] * every.share).sum(axis=1)
    score = np.bincount(index, value, minlength=len(poses))
    residual, _ = _model_rows(scene, poses, np.full(len(poses), k))
    off = np.sum(residual**2 / (1.0 + residual**2 / MODEL_WIDTH**2), axis=1)
    return np.asarray(score - MODEL_COST * off)


def _stepped(
    scene: _Scene,
    cameras: Sequence[RigidTransform | None],
    k: int,
    poses: Array,
    targets: Sequence[LegSegments],
    tolerance: float,
) -> Array:
    """Return poses (n, 3, 4) after a Gauss-Newton step towards the pairs that they match."""
    every, index = scene.pictures(targets, [k] * len(poses), cameras)
    rows, _ = _line_rows(scene, every, index, poses, tolerance)
    residual, jacobian = _model_rows(scene, poses, np.full(len(poses), k))
    H = jacobian.swapaxes(1, 2) @ jacobian
    b = -(jacobian.swapaxes(1, 2) @ residual[..., None])[..., 0]
    np.add.at(H, index, np.einsum("krx,kry->kxy", rows[..., 1:], rows[..., 1:]))
    np.add.at(b, index, -np.einsum("krx,kr->kx", rows[..., 1:], rows[..., 0]))
    unit = _pose_unit(scene)
    step = np.linalg.solve(H + np.diag(unit**-2), b[..., None])[..., 0]
    longest = np.abs(step / unit).max(axis=1, keepdims=True)
    return poses_after(poses, step * (MAX_STEP / np.maximum(longest, MAX_STEP)))


def _pose_unit(scene: _Scene) -> Array:
    """Return how far a pose may be from where it is if nothing says so, (6,) [rad, m]."""
    size = leg_scale(scene.machine, scene.machine.home)
    return np.array([TURN_SIGMA] * 3 + [PLACE_SIGMA * size] * 3)


def _as_they_are(scene: _Scene) -> CameraPoses:
    """Return the pose of the base link in its own frame: pictures know their cameras."""
    return CameraPoses.rigid(np.eye(3)[None], np.zeros((1, 3)), scene.machine.n_legs)


def _line_rows(
    scene: _Scene, every: Pictures, index: IntArray, poses: Array, tolerance: float
) -> tuple[Array, Array]:
    """Return whitened rows of lines (n_pictures, 2 n_segments, 7): residual, derivatives by pose.

    With derivatives (n_pictures, 2 n_segments, 6) by a motion of everything in the base link.
    """
    base = _as_they_are(scene)
    found = match_pairs(every, base, tolerance)
    J, J_leg, residual, weight = segment_equations(every, base, found, tolerance)
    root = np.sqrt(weight[:, 0, :, :2])  # (n_pictures, n_segments, 2)
    arm = np.einsum("kxy,ksy->ksx", poses[index, :, :3], scene.machine.B_platform[every.leg])
    by_B = J_leg[:, 0, :, :, 3:]
    by_pose = np.concatenate([cross(arm[:, :, None], by_B), by_B], axis=-1)
    flat = len(every), -1
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
    beyond, by_travel = _beyond_travel(machine, poses)
    return (
        np.concatenate([values, beyond / TRAVEL_SIGMA], axis=1),
        np.concatenate([jacobian, by_travel / TRAVEL_SIGMA], axis=1),
    )


def _beyond_travel(machine: Machine, poses: Array) -> tuple[Array, Array]:
    """Return how far sliders are beyond their travel (n, n_legs) [m], and derivatives by pose."""
    arm = machine.B_platform @ poses[:, :, :3].swapaxes(1, 2)
    vector = arm + poses[:, None, :, 3] - machine.A_base
    length = np.linalg.norm(vector, axis=2)
    ends = [
        (0.0, np.inf)
        if leg.kind is LegKind.CONSTANT
        else sorted(leg.length_at(x) for x in leg.travel)
        for leg in machine.legs
    ]
    low, high = np.array(ends).T
    beyond = length - np.clip(length, low, high)
    u = vector / length[..., None] * (beyond != 0.0)[..., None]
    return beyond, np.concatenate([cross(arm, u), u], axis=2)


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
    unit = _pose_unit(scene)

    def placed(state: _State) -> tuple[RigidTransform | None, ...]:
        found = list(cameras)
        for v, T in zip(views, state.camera.motions, strict=True):
            found[v] = T.inv()
        return tuple(found)

    def lines(state: _State, tolerance: float) -> Residuals:
        targets = _targets(scene.machine, state.poses)
        every, index = scene.pictures(targets, keys.tolist(), placed(state))
        rows, by_base = _line_rows(scene, every, index, state.poses, tolerance)
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
    each, n_model = np.arange(len(keys)), model(state).r.shape[1]
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
                Factor("model", model, (), len(keys), n_model, each),
                Factor("stays", stays, (), len(keys), 6, each),
            ),
        )
        step, _ = information(problem, state, linearize(problem, state)).step(0.0)
        longest = float(np.abs(step[-6 * len(keys) :].reshape(-1, 6) / unit).max())
        state = problem.moved(state, step * (MAX_STEP / max(longest, MAX_STEP)))
    return dict(zip(keys.tolist(), state.poses, strict=True)), placed(state)
