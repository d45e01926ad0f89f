"""Platform poses that readings do not give, found in images together with their cameras.

A platform that is moved by hand, or has fewer motors than freedoms, is at a pose of its own in
every image. Base joints stay where they are, so that a rough camera pose says where each leg
begins: poses drawn from the workspace are judged by the edge pairs of their images, the better ones
improved by Gauss-Newton steps in which their cameras follow as far as they are rough, and cameras
and poses of all images fitted to their pairs in turn. Readings and the constraints of legs hold as
far as the nominal model has them.

From far a platform that tilts towards the camera looks like one that tilts away from it, and pairs
do not tell them apart. So the best poses that differ are kept of every image: the outlines that
can be measured at each of them decide.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from types import MappingProxyType

import numpy as np
from scipy.spatial.transform import RigidTransform, Rotation

from legcal.data.landmarks import LANDMARKS_NAME
from legcal.data.measurements import Measurements, few_views
from legcal.errors import NotIdentifiable
from legcal.estimation.problem import (
    EstimationProblem,
    Factor,
    GaussianPrior,
    Residuals,
    Variables,
    all_free,
    linearize,
)
from legcal.estimation.solver import information
from legcal.geometry.lines import cross
from legcal.geometry.motions import motions_of, rotation_matrices
from legcal.geometry.tables import Table, first_apart
from legcal.geometry.types import Array, BoolArray, IntArray
from legcal.machine.equations import is_constrained, machine_equations
from legcal.machine.leg import LegKind
from legcal.machine.model import Machine
from legcal.machine.solver import poses_after, solve
from legcal.perception.pair_matching import (
    CameraPoses,
    LegSegments,
    Picture,
    Pictures,
    leg_segments,
    match_pairs,
    segment_equations,
)
from legcal.perception.placement import Search
from legcal.perception.tuning import JOINT_ERROR, SEARCHING
from legcal.workers import Run

N_CHAINS, SEED = 100, 1965  # random walks through the workspace, all at once
STRIDE, STEPS, SNAPSHOTS = 0.12, 48, (24, 32, 40, 48)  # [rad] and leg lengths; poses that are tried
KEPT = (100, 30, 8, 3)  # of them, before a step with each of these tolerances
# Lengths are parts of the mean leg length.
TOLERANCES = SEARCHING[:4]  # of an axis beside its pair, cameras being rough
FITTED = (*SEARCHING[2:], SEARCHING[-1])  # of all images together
EQUATION_SIGMA = 0.5 * JOINT_ERROR  # of lengths and constraints by the nominal model
TRAVEL_SIGMA = 0.0125  # beyond the travel of a slider without a motor
# Of the score, for squares of what the model says against a pose; larger ones count no more.
MODEL_COST, MODEL_WIDTH = 0.01, 5.0
CAMERA_SIGMA = 0.03, 0.03  # of a rough pose: angle [rad], place as a part of the distance
TURN_SIGMA, PLACE_SIGMA = 0.1, 0.1  # of a pose that its images do not determine [rad], leg lengths
CLICKED_SIGMA, N_AROUND = (0.06, 0.03), 12  # of a pose by clicks, as before; poses around it
MAX_STEP = 3.0  # of these, in one step
ROUNDS = 2  # of a search in each image and a fit of all
CHOICES, APART = 3, 0.12  # poses of an image that are kept, as far apart [leg lengths of joints]
ALL_ALIKE = 30  # so many or fewer poses in a step of the search differ


@dataclass(frozen=True, eq=False)
class _Scene:
    """Constants of the machine; they travel to worker processes."""

    machine: Machine
    wanted: BoolArray  # (n_views, n_legs)
    q: Array  # (n_poses, n_legs) readings; of motors alone they have a meaning
    drawn: Array  # (n_drawn, 3, 4) poses of the workspace
    targets: tuple[LegSegments, ...]  # predicted legs at them
    images: Mapping[int, Sequence[tuple[int, Picture]]]  # by pose, with their views
    # (n, 3, 4) by pose: where clicks have the platform, and around; drawn ones are not tried then
    clicked: Mapping[int, Array] = field(default_factory=dict)

    @classmethod
    def of(
        cls,
        machine: Machine,
        wanted: BoolArray,
        q: Array,
        images: Mapping[int, Sequence[tuple[int, Picture]]],
        clicked: Mapping[int, Sequence[RigidTransform]],
    ) -> _Scene:
        """Return the scene of a machine and its images."""
        drawn = _drawn(machine)
        around = {pose: _around(machine, every) for pose, every in clicked.items()}
        return cls(machine, wanted, q, drawn, tuple(_targets(machine, drawn)), images, around)

    def pictures(
        self, targets: Sequence[LegSegments], of_pose: Sequence[int], cameras: Array
    ) -> tuple[Pictures, IntArray]:
        """Return edge pairs and predicted legs of images at poses, and the index of each.

        *of_pose* are the poses of the measurements whose images they are, *cameras* (n, n_views, 3,
        4) T_camera_base with each of them.
        """
        found, index = list[Picture](), list[int]()
        for n, (own, k) in enumerate(zip(targets, of_pose, strict=True)):
            for view, image in self.images[k]:
                camera = cameras[n, view]
                shown = replace(own, share=own.share * self.wanted[view, own.leg])
                found.append(replace(image, targets=shown, R=camera[:, :3], t=camera[:, 3]))
                index.append(n)
        return Pictures.of(found), np.array(index, dtype=np.intp)

    def views(self, k: int) -> list[int]:
        """Return the views that show a pose of the measurements."""
        return sorted({view for view, _ in self.images[k]})


@dataclass(frozen=True, eq=False)
class _Guesses(Table):
    """Where the platform may be at a pose of the measurements, each with cameras that suit it."""

    poses: Array  # (n, 3, 4) T_base_platform
    cameras: Array  # (n, n_views, 3, 4) T_camera_base

    @classmethod
    def before(cls, cameras: Array, poses: Array) -> _Guesses:
        """Return all poses before the same cameras (n_views, 3, 4)."""
        return cls(poses, np.repeat(cameras[None], len(poses), axis=0))


def _targets(machine: Machine, poses: Array) -> list[LegSegments]:
    """Return the predicted cylinders of all legs at poses (n, 3, 4)."""
    A, every = machine.A_base, np.arange(machine.n_legs)
    B = machine.B_platform @ poses[:, :, :3].swapaxes(1, 2) + poses[:, None, :, 3]
    cylinders = [leg.cylinders for leg in machine.legs]
    return [leg_segments(A, at, cylinders, every) for at in B]


def _around(machine: Machine, T_base_platform: Sequence[RigidTransform]) -> Array:
    """Return rough poses and others around each of them (n, 3, 4), as far as they may be off."""
    rng = np.random.default_rng(SEED)
    unit = np.repeat([CLICKED_SIGMA[0], CLICKED_SIGMA[1] * machine.size], 3)
    given = np.array([T.as_matrix()[:3] for T in T_base_platform])
    others = np.repeat(given, N_AROUND, axis=0)
    others = poses_after(others, unit * rng.normal(size=(len(others), 6)))
    return np.concatenate([given, _constrained(machine, others, machine.size)[0]])


def _drawn(machine: Machine) -> Array:
    """Return poses (n, 3, 4) of the workspace: inside the travel of all sliders, whatever they say.

    Steps of random walks from home that leave the travel are not taken.
    """
    rng = np.random.default_rng(SEED)
    size = machine.size
    unit = np.array([1.0] * 3 + [size] * 3)
    poses = np.repeat(machine.home.as_matrix()[None, :3], N_CHAINS, axis=0)
    poses_drawn = []
    for step in range(1, STEPS + 1):
        moved = poses_after(poses, STRIDE * unit * rng.normal(size=(N_CHAINS, 6)))
        moved, is_closed = _constrained(machine, moved, size)
        inside = is_closed & (np.abs(_beyond_travel(machine, moved)[0]).max(axis=1) == 0.0)
        poses = np.where(inside[:, None, None], moved, poses)
        if step in SNAPSHOTS:
            poses_drawn.append(poses)
    return np.concatenate(poses_drawn)


def _constrained(machine: Machine, poses: Array, size: float) -> tuple[Array, BoolArray]:
    """Return the nearest poses that legs and plane allow, and which of them were found."""
    if not is_constrained(machine):
        return poses, np.ones(len(poses), dtype=np.bool_)

    def constraints(poses: Array) -> tuple[Array, Array]:
        solved = machine_equations(machine, poses)
        return solved.values[:, ~solved.measured], solved.by_pose[:, ~solved.measured]

    unit = np.array([1.0 / size] * 3 + [1.0] * 3)
    solved = solve(constraints, poses_after, poses, tolerance=1e-6 * size, unit=unit, steps=10)
    return solved.points, solved.worst < 1e-3 * size


def find_free_poses(
    search: Search,
    machine: Machine,
    rows: Sequence[int],
    hints: Sequence[RigidTransform | None],
    run: Run,
    progress: Callable[[int], None],
    clicked: Mapping[int, Sequence[RigidTransform]] = MappingProxyType({}),
) -> tuple[dict[int, tuple[RigidTransform, ...]], tuple[RigidTransform | None, ...]]:
    """Find the platform poses that the images of rows show, and their cameras, near rough ones.

    Where clicks have the platform at a pose, T_base_platform, it is looked for there alone.

    Returns T_base_platform of every pose that images show, the likeliest first; T_base_camera of
    every view. Raises NotIdentifiable if a view has no rough camera pose, or joints at A move.
    """
    m = search.measurements
    require_standing_joints(machine)
    require_rough_cameras(m, rows, hints)
    images: dict[int, list[tuple[int, Picture]]] = {}
    for row, picture in zip(rows, run(search.picture, rows), strict=True):
        images.setdefault(int(m.pose[row]), []).append((int(m.view[row]), picture))
    scene = _Scene.of(machine, search.wanted, m.q_of_poses, images, clicked)
    rough = _cameras_of(hints)
    cameras, every = rough, dict[int, _Guesses]()
    for _ in range(ROUNDS):
        for k, found in zip(images, run(partial(_searched, scene, cameras), images), strict=True):
            every[k] = found
            for _ in images[k]:
                progress(k)
        first = {k: one.poses[0] for k, one in every.items()}
        best, cameras = _fitted(scene, first, _agreed(scene, cameras, every), rough)
    T = dict[int, tuple[RigidTransform, ...]]()
    for k, found in every.items():
        others = _Guesses.before(cameras, found.poses[1:])
        others = _stepped_often(scene, None, k, others, FITTED[1:])
        poses = np.concatenate([best[k][None], others.poses])
        T[k] = _motions(poses[_apart(machine, poses, CHOICES)])
    return T, _placed(hints, cameras)


def require_standing_joints(machine: Machine) -> None:
    """Refuse to look for poses where joints at A move, so that nothing says where legs begin."""
    if machine.actuators:
        raise NotIdentifiable(
            "The images could not be searched: found joints at A that move and that "
            f"{machine.undetermined}, needed motors that do, or the outlines in observations.csv; "
            "name the other motors in name_mot of the model."
        )


def views_without_rough_camera(
    measurements: Measurements, rows: Sequence[int], cameras: Sequence[RigidTransform | None]
) -> list[str]:
    """Return the views of images without a rough camera pose, by their names."""
    views = sorted({int(measurements.view[row]) for row in rows})
    return [measurements.views[v].name for v in views if cameras[v] is None]


def require_rough_cameras(
    measurements: Measurements, rows: Sequence[int], cameras: Sequence[RigidTransform | None]
) -> None:
    """Refuse views of images without a rough camera pose, where readings do not give the poses."""
    missing = views_without_rough_camera(measurements, rows, cameras)
    if missing:
        raise NotIdentifiable(
            f"{few_views(missing)}: the images could not be searched: found no rough camera pose, "
            "needed one (2 cm, 2 deg), since the motors do not determine the pose of the platform; "
            f"click its joints at the base ({LANDMARKS_NAME}), or write T_base_camera into "
            "dataset.yaml."
        )


def _searched(scene: _Scene, cameras: Array, k: int) -> _Guesses:
    """Return the poses at which the images of pose *k* show most legs, best first."""
    guesses, targets = _Guesses.before(cameras, scene.drawn), list(scene.targets)
    if k in scene.clicked:
        guesses = _Guesses.before(cameras, scene.clicked[k])
        targets = _targets(scene.machine, guesses.poses)
    for kept, tolerance in zip(KEPT, TOLERANCES, strict=True):
        score = _scores(scene, cameras, k, guesses, targets, tolerance)
        guesses = guesses.choose(np.argsort(-score, kind="stable"))
        few = kept <= ALL_ALIKE
        guesses = guesses.choose(_apart(scene.machine, guesses.poses, kept) if few else slice(kept))
        guesses = _stepped_often(scene, cameras, k, guesses, [tolerance] * (1 + few))
        targets = _targets(scene.machine, guesses.poses)
    score = _scores(scene, cameras, k, guesses, targets, TOLERANCES[-1])
    guesses = guesses.choose(np.argsort(-score, kind="stable"))
    return guesses.choose(_apart(scene.machine, guesses.poses, CHOICES))


def _agreed(scene: _Scene, rough: Array, every: Mapping[int, _Guesses]) -> Array:
    """Return the cameras on which the likeliest poses of all images agree: medians."""
    found = rough.copy()
    for v in range(len(rough)):
        own = np.array([one.cameras[0, v] for k, one in every.items() if v in scene.views(k)])
        if len(own):
            found[v] = _camera_after(rough[v], np.median(_camera_change(rough[v], own), axis=0))
    return found


def _apart(machine: Machine, poses: Array, n: int) -> IntArray:
    """Return the indices of the first n poses (m, 3, 4) that are not near an earlier one."""
    ends = machine.B_platform @ poses[:, :, :3].swapaxes(1, 2) + poses[:, None, :, 3]
    off = np.linalg.norm(ends[:, None] - ends, axis=3)
    near = np.sqrt(np.mean(off**2, axis=2)) < APART * machine.size
    return first_apart(near, n)


def _stepped_often(
    scene: _Scene, rough: Array | None, k: int, guesses: _Guesses, tolerances: Sequence[float]
) -> _Guesses:
    """Return guesses after a Gauss-Newton step with each tolerance."""
    for tolerance in tolerances if len(guesses) else ():
        guesses = _stepped(scene, rough, k, guesses, tolerance)
    return guesses


def _scores(
    scene: _Scene,
    rough: Array,
    k: int,
    guesses: _Guesses,
    targets: Sequence[LegSegments],
    tolerance: float,
) -> Array:
    """Return the number of legs that agree with each guess, less the cost of its priors."""
    poses = guesses.poses
    every, index = scene.pictures(targets, [k] * len(poses), guesses.cameras)
    matches = match_pairs(every, _as_they_are(scene), tolerance)
    value = (matches.exclusive_score[:, 0] * every.share).sum(axis=1)
    score = np.bincount(index, value, minlength=len(poses))
    residual, _ = _model_rows(scene, poses, np.full(len(poses), k))
    views = scene.views(k)
    turns = _camera_change(rough[views], guesses.cameras[:, views]) / _camera_unit(rough[views])
    residual = np.concatenate([residual, turns.reshape(len(poses), -1)], axis=1)
    off = np.sum(residual**2 / (1.0 + residual**2 / MODEL_WIDTH**2), axis=1)
    return np.asarray(score - MODEL_COST * off)


def _stepped(
    scene: _Scene, rough: Array | None, k: int, guesses: _Guesses, tolerance: float
) -> _Guesses:
    """Return guesses after a Gauss-Newton step towards the pairs that they match.

    Cameras move as far as rough poses (n_views, 3, 4) let them; without these they are held.
    """
    poses, views = guesses.poses, [] if rough is None else scene.views(k)
    targets = _targets(scene.machine, poses)
    every, index = scene.pictures(targets, [k] * len(poses), guesses.cameras)
    of_lines, by_camera = _line_rows(scene, every, index, poses, tolerance)
    residual, jacobian = _model_rows(scene, poses, np.full(len(poses), k))
    n, unit = 6 + 6 * len(views), _pose_unit(scene)
    J = np.zeros((*of_lines.shape[:2], n))
    J[..., :6] = of_lines[..., 1:]
    weight, value = np.zeros(n), np.zeros((len(poses), n))  # of the priors
    weight[:6] = unit**-2
    if rough is not None:
        seen = np.array([views.index(view) for view, _ in scene.images[k]] * len(poses))
        for i, v in enumerate(views):
            part = slice(6 + 6 * i, 12 + 6 * i)
            J[:, :, part] = by_camera * (seen == i)[:, None, None]
            weight[part] = _camera_unit(rough[v]) ** -2
            value[:, part] = _camera_change(rough[v], guesses.cameras[:, v])
    H = np.zeros((len(poses), n, n))
    b = -value * weight
    H[:, :6, :6] = jacobian.swapaxes(1, 2) @ jacobian
    b[:, :6] -= (jacobian.swapaxes(1, 2) @ residual[..., None])[..., 0]
    np.add.at(H, index, np.einsum("krx,kry->kxy", J, J))
    np.add.at(b, index, -np.einsum("krx,kr->kx", J, of_lines[..., 0]))
    step = np.asarray(np.linalg.solve(H + np.diag(weight), b[..., None])[..., 0], dtype=np.float64)
    longest = np.abs(step[:, :6] / unit).max(axis=1, keepdims=True)
    step *= MAX_STEP / np.maximum(longest, MAX_STEP)
    cameras = guesses.cameras.copy()
    for i, v in enumerate(views):
        cameras[:, v] = _camera_after(cameras[:, v], step[:, 6 + 6 * i : 12 + 6 * i])
    return _Guesses(poses_after(poses, step[:, :6]), cameras)


def _cameras_of(T_base_camera: Sequence[RigidTransform | None]) -> Array:
    """Return T_camera_base (n_views, 3, 4); NaN where nothing is known."""
    cameras = np.full((len(T_base_camera), 3, 4), np.nan)
    for v, T in enumerate(T_base_camera):
        if T is not None:
            cameras[v] = T.inv().as_matrix()[:3]
    return cameras


def _placed(
    hints: Sequence[RigidTransform | None], cameras: Array
) -> tuple[RigidTransform | None, ...]:
    """Return T_base_camera of the cameras that are known."""
    motions = _motions(np.where(np.isnan(cameras), np.eye(4)[:3], cameras))
    return tuple(None if hint is None else T.inv() for hint, T in zip(hints, motions, strict=True))


def _motions(of: Array) -> tuple[RigidTransform, ...]:
    """Return rigid motions of matrices (n, 3, 4)."""
    return motions_of(of[..., :3], of[..., 3])


def _camera_after(cameras: Array, step: Array) -> Array:
    """Return T_camera_base (..., 3, 4) after turns about the camera and moves, (..., 6)."""
    R = rotation_matrices(step[..., :3])
    moved = R @ cameras
    moved[..., 3] += step[..., 3:]
    return moved


def _camera_change(start: Array, cameras: Array) -> Array:
    """Return the step (..., 6) from T_camera_base (..., 3, 4) to others."""
    R = cameras[..., :3] @ start[..., :3].swapaxes(-1, -2)
    turn = Rotation.from_matrix(R.reshape(-1, 3, 3)).as_rotvec().reshape(*R.shape[:-2], 3)
    moved = cameras[..., 3] - (R @ start[..., 3:])[..., 0]
    return np.concatenate([turn, moved], axis=-1)


def _camera_unit(rough: Array) -> Array:
    """Return the tolerance (..., 6) of cameras about rough ones (..., 3, 4) [rad, m]."""
    far = CAMERA_SIGMA[1] * np.linalg.norm(rough[..., 3], axis=-1)
    return np.stack([np.full_like(far, CAMERA_SIGMA[0])] * 3 + [far] * 3, axis=-1)


def _pose_unit(scene: _Scene) -> Array:
    """Return the standard deviations of a weak prior on a pose, (6,) [rad, m]."""
    size = scene.machine.size
    return np.array([TURN_SIGMA] * 3 + [PLACE_SIGMA * size] * 3)


def _as_they_are(scene: _Scene) -> CameraPoses:
    """Return the pose of the base link in its own frame: pictures know their cameras."""
    return CameraPoses.rigid(np.eye(3)[None], np.zeros((1, 3)), scene.machine.n_legs)


def _line_rows(
    scene: _Scene, every: Pictures, index: IntArray, poses: Array, tolerance: float
) -> tuple[Array, Array]:
    """Return whitened rows of lines (n_pictures, 2 n_segments, 7): residual, derivatives by pose.

    With derivatives (n_pictures, 2 n_segments, 6) by a step of the camera.
    """
    base = _as_they_are(scene)
    matches = match_pairs(every, base, tolerance)
    J, J_leg, residual, weight = segment_equations(every, base, matches, tolerance)
    root = np.sqrt(weight[:, 0, :, :2])  # (n_pictures, n_segments, 2)
    arm = np.einsum("kxy,ksy->ksx", poses[index, :, :3], scene.machine.B_platform[every.leg])
    by_B = J_leg[:, 0, :, :, 3:]
    by_pose = np.concatenate([cross(arm[:, :, None], by_B), by_B], axis=-1)
    flat = len(every), -1
    rows = np.concatenate([residual[:, 0, :, :2, None], by_pose], axis=-1) * root[..., None]
    by_base = (J[:, 0, :, :2] * root[..., None]).reshape(*flat, 6)
    R = every.R.swapaxes(1, 2)
    by_move = by_base[..., 3:] @ R
    by_turn = by_base[..., :3] @ R + cross(every.t[:, None], by_move)
    return rows.reshape(*flat, 7), np.concatenate([by_turn, by_move], axis=-1)


def _model_rows(scene: _Scene, poses: Array, k: IntArray) -> tuple[Array, Array]:
    """Return whitened residuals (n, m) of readings, constraints and travel, and derivatives."""
    machine = scene.machine
    equations = machine_equations(machine, poses)
    wanted = np.zeros_like(equations.values)
    measured = equations.measured
    wanted[:, measured] = (machine.sign * scene.q[k])[:, equations.leg[measured]]
    sigma, sigma_travel = EQUATION_SIGMA * machine.size, TRAVEL_SIGMA * machine.size
    values, jacobian = (equations.values - wanted) / sigma, equations.by_pose / sigma
    beyond, by_travel = _beyond_travel(machine, poses)
    return (
        np.concatenate([values, beyond / sigma_travel], axis=1),
        np.concatenate([jacobian, by_travel / sigma_travel], axis=1),
    )


def _beyond_travel(machine: Machine, poses: Array) -> tuple[Array, Array]:
    """Return the excess of sliders over their travel (n, n_legs) [m], with derivatives by pose."""
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
    """The unknowns of the fit of all images."""

    cameras: Array  # (n_used, 3, 4) T_camera_base of the views that have images
    poses: Array  # (n_poses, 3, 4) T_base_platform of the poses that have images


def _fitted(
    scene: _Scene, poses: Mapping[int, Array], cameras: Array, rough: Array
) -> tuple[dict[int, Array], Array]:
    """Return poses and cameras after steps of all of them together towards the pairs."""
    keys = np.array(sorted(poses), dtype=np.intp)
    images = [(i, view) for i, k in enumerate(keys.tolist()) for view, _ in scene.images[k]]
    views = sorted({view for _, view in images})
    element = np.array([i for i, _ in images], dtype=np.intp)
    view = np.array([views.index(view) for _, view in images], dtype=np.intp)
    state = _State(cameras[views], np.array([poses[k] for k in keys.tolist()]))
    n_rows = 4 * sum(len(leg.cylinders) for leg in scene.machine.legs)  # at most, of an image
    unit = _pose_unit(scene)

    def placed(state: _State) -> Array:
        fitted = cameras.copy()
        fitted[views] = state.cameras
        return fitted

    def lines(state: _State, tolerance: float) -> Residuals:
        targets = _targets(scene.machine, state.poses)
        every_camera = np.repeat(placed(state)[None], len(keys), axis=0)
        every, index = scene.pictures(targets, keys.tolist(), every_camera)
        rows, by_camera = _line_rows(scene, every, index, state.poses, tolerance)
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

    sigma = _camera_unit(rough[views]).ravel()
    of_cameras = Variables(
        "cameras",
        all_free(len(views), 6),
        _camera_after,
        coordinates=lambda now: _camera_change(rough[views], now).ravel(),
        prior=GaussianPrior(np.arange(len(sigma)), np.zeros(len(sigma)), sigma),
    )
    each, n_model = np.arange(len(keys)), model(state).r.shape[1]
    for tolerance in FITTED:
        problem = EstimationProblem[_State](
            (of_cameras,),
            Variables("poses", all_free(len(keys), 6), poses_after),
            (
                Factor(
                    "lines",
                    partial(lines, tolerance=tolerance),
                    (("cameras", view, slice(None)),),
                    len(images),
                    n_rows,
                    element,
                ),
                Factor("model", model, (), len(keys), n_model, each),
                Factor("stays", stays, (), len(keys), 6, each),
            ),
        )
        step, _ = information(linearize(problem, state)).step(0.0)
        longest = float(np.abs(step[-6 * len(keys) :].reshape(-1, 6) / unit).max())
        state = problem.moved(state, step * (MAX_STEP / max(longest, MAX_STEP)))
    return dict(zip(keys.tolist(), state.poses, strict=True)), placed(state)
