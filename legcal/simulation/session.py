"""The session simulator: from a machine and settings to what is measured of it, in memory.

:func:`simulate_session` puts a true machine into poses and cameras around it, and returns readings,
outlines or axes, corners of a board, and the truth. :func:`photographs` renders its images.
"""

from __future__ import annotations

from collections.abc import Generator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import lru_cache
from uuid import uuid4

import numpy as np

from legcal.data import Corners, Measurements, Outlines, View
from legcal.errors import NotVisible, UsageError
from legcal.machine import Configurations, Machine
from legcal.progress import Report, no_progress
from legcal.simulation.board import chosen_board, placed_at
from legcal.simulation.cameras import (
    MAX_HAND_DRAWS,
    board_and_cameras,
    board_before,
    board_on_platform,
    camera_in_hand,
    cameras_around,
    mild_lens,
    read_cameras,
    read_lens,
    rough_pose,
)
from legcal.simulation.observe import (
    EVERY_PIXEL,
    AxisTable,
    OutlineNoise,
    Scene,
    axes_in_images,
    corners_in_images,
    outlines_of,
)
from legcal.simulation.planned import read_plan
from legcal.simulation.poses import commanded_poses, given_poses
from legcal.simulation.rendering.appearance import Appearance
from legcal.simulation.rendering.scene import RenderedView, prepare_view
from legcal.simulation.request import Level
from legcal.simulation.settings import Distribution, SimulationSettings
from legcal.simulation.solids import PlacedSolid, PosedMachine, dressed, pose_machine
from legcal.simulation.visibility import Images, Viewpoint, take_images
from legcal.vision import Camera, FixedBoard
from legcal.workers import Workers, worker_pool

Streams = Mapping[str, np.random.Generator]

_PURPOSES = ("errors", "poses", "cameras", "readings", "hints", "observations", "photographs",
             "corners", "lengths")  # fmt: skip
_MIN_SIGMA_Q = 1e-9  # [m] that readings without noise claim
_MIN_SEEN = 0.5  # of the photographs of a view that show a leg which its hint names


def streams(seed: int) -> dict[str, np.random.Generator]:
    """Return a random generator for each purpose: draws for one do not change the others."""
    children = np.random.SeedSequence(seed).spawn(len(_PURPOSES))
    return {
        name: np.random.default_rng(child) for name, child in zip(_PURPOSES, children, strict=True)
    }


@dataclass(frozen=True, eq=False)
class SimulatedSession:
    """What is measured of a simulated machine, and the truth behind it."""

    measurements: Measurements
    outlines: Outlines | None  # with noise, where the settings ask for them
    axes: AxisTable | None
    corners: Corners | None
    truth: Machine
    poses: Configurations  # all that were drawn; images may show only some
    labels: tuple[str, ...]  # their names
    posed_machines: tuple[PosedMachine, ...]  # in every pose, with the boards
    scene: Scene
    left_out: int  # images that show no leg, which a table of outlines or axes has no row for
    boards: tuple[FixedBoard, ...]
    groups: tuple[str, ...]  # view of the dataset of each camera in the hand; empty if they stand


def simulate_session(
    truth: Machine,
    nominal: Machine,
    settings: SimulationSettings,
    rngs: Streams,
    progress: Report = no_progress,
) -> SimulatedSession:
    """Return a session of a true machine of which the nominal model is known."""
    planned = None if settings.plan is None else read_plan(settings.plan, nominal)
    cameras, given = _cameras(settings)
    if planned is not None:
        cameras = {view.name: view.camera for view in planned.measurements.views}
    shared = settings.shared_poses or not isinstance(settings.poses, int)
    n_sets = 1 if shared else len(cameras)
    if planned is not None:
        poses = planned.poses(truth)
    elif isinstance(settings.poses, int):
        n_poses = settings.poses * n_sets
        poses = commanded_poses(truth, nominal, n_poses, rngs["poses"], settings.sampling, progress)
    else:
        poses = given_poses(truth, settings.poses)
    settings.check_images(len(cameras), len(poses.poses) // n_sets)
    # Meshes lie beside the nominal URDF, of which that of the true machine is a copy.
    shown = replace(truth, urdf=replace(truth.urdf, path=nominal.urdf.path))
    posed_machines = pose_machine(truth, dressed(shown), poses)
    placed = None if planned is None else planned.board
    if placed is not None and settings.board is not None:
        raise UsageError(
            "The plan could not be shot: found --board and a plan with a board, needed one of "
            "them; leave out --board."
        )
    if planned is not None:
        if placed is not None:
            posed_machines = tuple(placed.beside(posed) for posed in posed_machines)
        given = planned.viewpoints(rngs["cameras"], posed_machines)
    board = chosen_board(settings.board, posed_machines)
    on_platform = chosen_board(settings.platform_board, posed_machines, "platform")
    boards: tuple[FixedBoard, ...] = ()
    if on_platform is not None:
        T = board_on_platform(on_platform, truth, posed_machines, poses.poses, given)
        first = 0 if board is None else board.n_corners
        boards = (FixedBoard(on_platform, "platform", T, first),)
        posed_machines = tuple(
            placed_at(boards[0], T).beside(posed)
            for T, posed in zip(poses.poses, posed_machines, strict=True)
        )
    groups = () if planned is None or not planned.hand else (planned.hand,) * len(given)
    if board is None:
        views = given
        if not given:
            views, least = cameras_around(truth, posed_machines, cameras, rngs["cameras"], progress)
            if boards and least <= 0.0:
                raise NotVisible(
                    "The cameras could not be placed: found no place for one of them from which it "
                    "sees the board on the platform in most poses, needed one for each; use fewer "
                    "views, or a smaller board."
                )
    elif given:
        placed, views = board_before(board, truth, posed_machines, given), given
    else:
        in_turn = [
            posed_machines[p]
            for v in range(len(cameras))
            for p in _poses_of(v, n_sets, posed_machines)
        ]
        bodies = in_turn if settings.hand_held else posed_machines
        placed, views = board_and_cameras(board, truth, bodies, cameras, rngs["cameras"], progress)
    if placed is not None:
        if board is not None:
            posed_machines = tuple(placed.beside(posed) for posed in posed_machines)
        boards = (FixedBoard(placed.board, "base", placed.T_base_board), *boards)
    if placed is not None and settings.hand_held:
        views, groups = _in_hand(truth, posed_machines, n_sets, cameras, rngs, progress)
    if settings.level is Level.PHOTOGRAPHS:
        views = _encoding(views, settings.appearance.gamma, settings.tell_gamma)
    poses_of: list[Sequence[int]] = [
        [v % len(posed_machines)] if groups else _poses_of(v, n_sets, posed_machines)
        for v in range(len(views))
    ]
    if planned is not None:
        poses_of = list(planned.poses_of)
    images = take_images(
        truth.legs, posed_machines, views, poses_of, settings.images, progress,
        each=planned is None or not planned.hand,
    )  # fmt: skip
    rows = list(range(len(images)))
    if settings.level is not Level.PHOTOGRAPHS:
        rows = [row for row in rows if images.seen(row)]
    kept = images.chosen(rows)
    if groups:
        kept, views, groups = _numbered(kept, views, groups)
    A, B = (np.array([getattr(m, joint) for m in posed_machines]) for joint in "AB")
    arms = {j: np.array([m.arms[j] for m in posed_machines]) for j in posed_machines[0].arms}
    scene = Scene(A, B, views, kept, arms)
    outlines = axes = corners = None
    if settings.level is Level.OUTLINES:
        noise = OutlineNoise(settings.sigma_px, n_points=None)
        outlines = outlines_of(scene, noise, rngs["observations"])
    elif settings.level is Level.AXES:
        axes = axes_in_images(scene, settings.table, rngs["observations"])
    if boards and settings.level is not Level.PHOTOGRAPHS:
        corners = corners_in_images(scene, posed_machines, settings.sigma_px, rngs["corners"])
    width = max(2, len(str(len(poses.poses))))
    labels = tuple(f"p{k + 1:0{width}d}" for k in range(len(poses.poses)))
    measurements = _recorded(
        truth, poses, labels, scene, settings, rngs, hints=settings.hints and not groups
    )
    if (
        planned is not None and settings.hints and not groups
    ):  # they are where the tripods should stand
        both = zip(measurements.views, planned.measurements.views, strict=True)
        hinted = tuple(replace(view, T_base_camera=p.T_base_camera) for view, p in both)
        measurements = replace(measurements, views=hinted)
    return SimulatedSession(
        measurements, outlines, axes, corners, truth, poses, labels, posed_machines, scene,
        len(images) - len(rows), boards, groups,
    )  # fmt: skip


def exact_outlines(scene: Scene) -> Outlines:
    """Return the outlines of a scene as they are, with next to no noise claimed."""
    return outlines_of(scene, replace(EVERY_PIXEL, sigma_px=0.0))


def _cameras(settings: SimulationSettings) -> tuple[dict[str, Camera], tuple[Viewpoint, ...]]:
    """Return the camera of each view, and where all of them stand if that is given."""
    camera = mild_lens() if settings.camera is None else read_lens(settings.camera)
    if isinstance(settings.views, int):
        return {f"c{v + 1}": camera for v in range(settings.views)}, ()
    given = read_cameras(settings.views, camera)
    cameras = {name: lens for name, (lens, _) in given.items()}
    return cameras, tuple(Viewpoint(name, lens, T) for name, (lens, T) in given.items())


def _poses_of(view: int, n_sets: int, posed_machines: Sequence[PosedMachine]) -> range:
    """Return the poses that a view sees: all of them, or those of its own set."""
    own = len(posed_machines) // n_sets
    return range(own) if n_sets == 1 else range(view * own, (view + 1) * own)


def _in_hand(
    truth: Machine,
    posed_machines: Sequence[PosedMachine],  # with the board
    n_sets: int,
    cameras: Mapping[str, Camera],
    rngs: Streams,
    progress: Report,
) -> tuple[tuple[Viewpoint, ...], tuple[str, ...]]:
    """Return a place for each image from which it shows board and legs, and the view of each."""
    views: list[Viewpoint] = []
    groups: list[str] = []
    n_images = len(cameras) * len(posed_machines) // n_sets
    for v, (name, camera) in enumerate(cameras.items()):
        for k, pose in enumerate(_poses_of(v, n_sets, posed_machines)):
            progress("Camera places", len(views), n_images)
            T = camera_in_hand(truth, posed_machines[pose], camera, rngs["cameras"])
            if T is None:
                raise NotVisible(
                    f"view {name}: a camera in the hand could not be placed: found none of "
                    f"{MAX_HAND_DRAWS} places from which image {k + 1} shows the board and a leg, "
                    "needed one; use a smaller board."
                )
            views.append(Viewpoint(f"{name}-{k + 1}", camera, T))
            groups.append(name)
    progress("Camera places", n_images, n_images)
    return tuple(views), tuple(groups)


def _numbered(
    images: Images, views: Sequence[Viewpoint], groups: Sequence[str]
) -> tuple[Images, tuple[Viewpoint, ...], tuple[str, ...]]:
    """Return hand-held views counted anew by the images that are left, one for each of them."""
    counts = dict.fromkeys(groups, 0)
    left, names = [], []
    for v in images.view.tolist():
        name = groups[v]
        counts[name] += 1
        left.append(replace(views[v], name=f"{name}-{counts[name]}"))
        names.append(name)
    own = replace(images, view=np.arange(len(images), dtype=np.intp))
    return own, tuple(left), tuple(names)


def _encoding(views: Sequence[Viewpoint], gamma: float, given: bool) -> tuple[Viewpoint, ...]:
    """Return views whose cameras have a gamma, which the dataset gives or not."""
    cameras = {
        id(view.camera): replace(view.camera, gamma=gamma, gamma_is_given=given) for view in views
    }
    return tuple(replace(view, camera=cameras[id(view.camera)]) for view in views)


def _recorded(
    truth: Machine,
    poses: Configurations,
    labels: Sequence[str],
    scene: Scene,
    settings: SimulationSettings,
    rngs: Streams,
    *,
    hints: bool,  # whether the dataset says roughly where cameras stand
) -> Measurements:
    """Return the rows of the dataset: readings with their errors, and rough poses of cameras."""
    legs, images = truth.leg_names, scene.images
    photographs = settings.level is Level.PHOTOGRAPHS
    # Tables say themselves what is seen; in photographs nobody looks for a leg that often hides.
    least = _MIN_SEEN if photographs else 0.0
    views = []
    for v, view in enumerate(scene.views):
        T = rough_pose(view.T_base_camera, rngs["hints"])
        shown = tuple(legs[j] for j in images.seen_in_view(v, least))
        used = shown if 0 < len(shown) < len(legs) else None
        views.append(View(view.name, view.camera, *((T, used) if hints else (None, None))))
    q = poses.readings
    spreads = [settings.reading_errors(leg) for leg in truth.legs]
    errors = np.zeros(q.shape)
    for kind in dict.fromkeys(spread.distribution for spread in spreads):
        size = np.array([spread.size * (spread.distribution is kind) for spread in spreads])
        if kind is Distribution.UNIFORM:
            errors += rngs["readings"].uniform(-size, size, q.shape)
        else:
            errors += size * rngs["readings"].normal(size=q.shape)
    q = q + errors[:, list(truth.reads)]
    names = [""] * len(images)
    if photographs:
        repeated, suffix = int(images.repeat.max()) > 0, settings.appearance.pipeline.suffix
        names = [
            f"images/{views[v].name}_{labels[p]}{f'_{k + 1}' * repeated}{suffix}"
            for v, p, k in zip(images.view, images.pose, images.repeat, strict=True)
        ]
    seen, pose = np.unique(images.pose, return_inverse=True)
    return Measurements(
        views=tuple(views),
        image=tuple(names),
        view=images.view,
        pose=pose.astype(np.intp),
        q=q[images.pose],
        sigma_q=max(settings.encoder_sigma, _MIN_SIGMA_Q),
        sigma_by_joint={
            str(truth.legs[j].prismatic): max(spreads[j].sigma, _MIN_SIGMA_Q) for j in truth.motors
        }
        if any(a.turns for a in truth.actuators)
        else {},
        pose_labels=tuple(labels[p] for p in seen),
    )


# Photographs: surroundings are drawn once for each view, the noise of the sensor for each image.
# Images do not depend on how many processes make them.


def photographs(
    session: SimulatedSession,
    appearance: Appearance,
    rng: np.random.Generator,
    workers: Workers = 1,
) -> Generator[tuple[int, bytes]]:
    """Yield row and file of all images of a session."""
    views, images = session.scene.views, session.scene.images
    of_views, of_images = rng.spawn(len(views)), rng.spawn(len(images))
    name = uuid4().hex  # workers of a cluster see many sessions
    try:
        with worker_pool(workers) as run:
            for v, view in enumerate(views):
                rows = np.flatnonzero(images.view == v).tolist()
                machines = {row: session.posed_machines[images.pose[row]].solids for row in rows}
                sensor_rngs = {row: of_images[row] for row in rows}
                key = f"{name} {v}"
                studio = _Studio(key, view, appearance, of_views[v], machines, sensor_rngs)
                yield from zip(rows, run(studio.photograph, rows), strict=True)
    finally:
        _rendered_view.cache_clear()


@dataclass(frozen=True)
class _Studio:
    """A camera before its surroundings, and the machine in the poses that it photographs.

    Two of one key are the same, in whatever process they are.
    """

    key: str
    viewpoint: Viewpoint = field(compare=False)
    appearance: Appearance = field(compare=False)
    rng: np.random.Generator = field(compare=False)  # of the surroundings
    machines: Mapping[int, tuple[PlacedSolid, ...]] = field(compare=False)  # of each row
    sensor_rngs: Mapping[int, np.random.Generator] = field(compare=False)

    def photograph(self, row: int) -> bytes:
        """Return the file of a row's photograph."""
        image = _rendered_view(self).render(self.machines[row], self.sensor_rngs[row])
        return self.appearance.pipeline.file(image)


@lru_cache(maxsize=1)
def _rendered_view(studio: _Studio) -> RenderedView:
    """Return the surroundings, painted once in each process."""
    view, nearby = studio.viewpoint, next(iter(studio.machines.values()), ())
    return prepare_view(nearby, view.camera, view.T_base_camera, studio.appearance, studio.rng)
