"""The session simulator: from a machine and settings to its measurements, in memory.

:func:`simulate_session` puts a true machine into poses and cameras around it, and returns readings
and the truth. :mod:`legcal.simulation.observe` observes outlines and corners in it, and
:func:`photographs` renders its images.

A controller could command its poses: both the true machine and its nominal model reach them. They
are drawn (:func:`legcal.machine.configurations.feasible_poses`) or given by their readings.
"""

from __future__ import annotations

from collections.abc import Generator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property, lru_cache
from pathlib import Path
from uuid import uuid4

import numpy as np
from scipy.spatial.transform import RigidTransform

from legcal.data.dataset import PLAN_NAME, load_dataset
from legcal.data.measurements import Measurements, View
from legcal.data.reading_units import sigmas_of_legs
from legcal.data.readings_sheet import ReadingsSheet
from legcal.errors import DatasetError, DidNotConverge, NotVisible, UsageError
from legcal.files.schema import read_json, validate
from legcal.files.table import Column
from legcal.geometry.types import Array, BoolArray
from legcal.machine.closing import singularities, singularity
from legcal.machine.configurations import (
    JITTER,
    TRAVEL_TOLERANCE,
    Cause,
    Configurations,
    Feasibility,
    feasible_poses,
    motor_travel,
    poses_at,
)
from legcal.machine.kinematics import follow_each, followed, followed_poses, platform_in_base
from legcal.machine.model import Machine, platform_pose
from legcal.machine.redundancy import contradictions
from legcal.planning.places import LaidBoard, Setting
from legcal.planning.request import difference
from legcal.planning.session import PlanDocument, pose_labels
from legcal.progress import Report, no_progress
from legcal.simulation.board import PlacedBoard, chosen_board, placed_at
from legcal.simulation.cameras import (
    MAX_HAND_DRAWS,
    board_and_cameras,
    board_on_platform,
    camera_in_hand,
    cameras_around,
    mild_lens,
    read_lens,
    rough_pose,
)
from legcal.simulation.observe import Images, Scene, Viewpoint, take_images
from legcal.simulation.rendering.appearance import Appearance
from legcal.simulation.rendering.rays import divided
from legcal.simulation.rendering.scene import RenderedView, prepare_view
from legcal.simulation.settings import Distribution, Level, Sampling, SimulationSettings
from legcal.simulation.solids import PlacedSolid, PosedMachine, Solid, dressed, pose_machine
from legcal.vision.board import FixedBoard
from legcal.vision.camera import Camera
from legcal.vision.image_file import small_jpeg
from legcal.workers import Workers, worker_pool

_PURPOSES = ("errors", "poses", "cameras", "readings", "hints", "observations", "photographs",
             "corners", "lengths")  # fmt: skip
_MIN_SIGMA_Q = 1e-9  # [m] stated standard deviation of readings without noise
_SECONDS_A_POSE = 10.0  # poses are taken one after the other, images of one a second apart
_MIN_SEEN = 0.5  # minimum share of photographs of a view that show a leg named in its hint


def streams(seed: int | np.random.SeedSequence) -> dict[str, np.random.Generator]:
    """Return a random generator for each purpose: draws for one do not change the others."""
    root = seed if isinstance(seed, np.random.SeedSequence) else np.random.SeedSequence(seed)
    children = root.spawn(len(_PURPOSES))
    return {
        name: np.random.default_rng(child) for name, child in zip(_PURPOSES, children, strict=True)
    }


@dataclass(frozen=True, eq=False)
class SimulatedSession:
    """The measurements of a simulated machine, and the truth behind them."""

    measurements: Measurements
    truth: Machine
    poses: Configurations  # all drawn poses; images may show only some
    labels: tuple[str, ...]  # their names
    posed_machines: tuple[PosedMachine, ...]  # in every pose, with the boards
    scene: Scene
    left_out: int  # images without a leg, for which a table of outlines has no row
    boards: tuple[FixedBoard, ...]
    groups: tuple[str, ...]  # view of each hand-held camera pose; empty for fixed cameras


def simulate_session(
    truth: Machine,
    nominal: Machine,
    settings: SimulationSettings,
    rngs: Streams,
    progress: Report = no_progress,
) -> SimulatedSession:
    """Return a session of a true machine with its nominal model."""
    simulator = _Simulator(truth, nominal, settings, rngs, progress)
    poses, plan = simulator.poses(), simulator.plan
    posed, boards, views, groups = simulator.set_up(poses)
    poses_of: Sequence[Sequence[int]] = [
        [v % len(posed)] if groups else simulator.poses_of(v, len(posed)) for v in range(len(views))
    ]
    images = take_images(
        truth.legs, posed, views, poses_of if plan is None else plan.poses_of, settings.images,
        progress, all_views=plan is None or not plan.hand,
    )  # fmt: skip
    rows = list(range(len(images)))
    if settings.level != Level.PHOTOGRAPHS:  # tables need a leg in every row
        rows = [row for row in rows if images.seen(row)]
    left_out, images = len(images) - len(rows), images.choose(np.array(rows, dtype=np.intp))
    if groups:
        images, views, groups = _numbered(images, views, groups)
    A, B = (np.array([getattr(m, joint) for m in posed]) for joint in "AB")
    scene = Scene(A, B, views, images)
    labels = tuple(pose_labels(len(posed)))
    hints = settings.hints and not groups
    measurements = _recorded(truth, poses, labels, scene, settings, rngs, hints=hints)
    if plan is not None and hints:  # hints are the planned poses of the tripods
        view_pairs = zip(measurements.views, plan.measurements.views, strict=True)
        hinted = tuple(replace(view, T_base_camera=p.T_base_camera) for view, p in view_pairs)
        measurements = replace(measurements, views=hinted)
    return SimulatedSession(
        measurements, truth, poses, labels, posed, scene, left_out, boards, groups
    )


@dataclass(frozen=True, eq=False)
class _Simulator:
    """The inputs of a simulated session, and the steps: poses, set-up, images."""

    truth: Machine
    nominal: Machine
    settings: SimulationSettings
    rngs: Streams
    progress: Report

    @cached_property
    def plan(self) -> PlannedSession | None:
        """The plan of the session, if there is one."""
        plan = self.settings.plan
        return None if plan is None else read_plan(Path(plan), self.nominal)

    @property
    def given_views(self) -> tuple[Viewpoint, ...]:
        """The cameras in the settings, if any."""
        views = self.settings.views
        if not isinstance(views, Sequence):
            return ()
        for view in views:
            if unknown_legs := set(view.legs or ()) - set(self.truth.leg_names):
                raise UsageError(
                    f"view {view.name}: its legs could not be simulated: found "
                    f"{', '.join(sorted(unknown_legs))}, which '{self.truth.name}' lacks, needed "
                    f"some of {', '.join(self.truth.leg_names)}; correct the name."
                )
        return tuple(views)

    @cached_property
    def cameras(self) -> dict[str, Camera]:
        settings = self.settings
        if self.plan is not None:
            return {view.name: view.camera for view in self.plan.measurements.views}
        if isinstance(settings.views, Sequence):
            return {view.name: view.camera for view in settings.views}
        camera = mild_lens() if settings.camera is None else read_lens(Path(settings.camera))
        return {f"c{v + 1}": camera for v in range(settings.views)}

    @property
    def n_sets(self) -> int:
        """The number of sets of poses: one for each view unless they share them."""
        shared = self.settings.shared_poses or isinstance(self.settings.poses, str | Path)
        return 1 if shared else len(self.cameras)

    def poses_of(self, view: int, n_poses: int) -> range:
        """Return the poses of a view: all poses, or the set of the view."""
        poses_each = n_poses // self.n_sets
        return (
            range(poses_each)
            if self.n_sets == 1
            else range(view * poses_each, (view + 1) * poses_each)
        )

    def poses(self) -> Configurations:
        """Return the poses of the true machine: of the plan, given, or drawn."""
        settings, n_views, n_sets = self.settings, len(self.cameras), self.n_sets
        if self.plan is not None:
            poses = self.plan.poses(self.truth)
        elif isinstance(settings.poses, str | Path):
            poses = given_poses(self.truth, Path(settings.poses))
        else:
            poses = commanded_poses(
                self.truth, self.nominal, settings.poses * n_sets, self.rngs["poses"],
                settings.sampling, self.progress,
            )  # fmt: skip
        settings.check_images(n_views, len(poses.poses) // n_sets)
        return poses

    def set_up(
        self, poses: Configurations
    ) -> tuple[
        tuple[PosedMachine, ...], tuple[FixedBoard, ...], tuple[Viewpoint, ...], tuple[str, ...]
    ]:
        """Return the machine in its poses with boards, these, cameras, and the view of each.

        According to plan and settings. Fixed cameras are views themselves: there are no others.
        """
        # Meshes are beside the nominal URDF; the URDF of the true machine is a copy.
        urdf = replace(self.truth.urdf, path=self.nominal.urdf.path)
        has_images = self.settings.level == Level.PHOTOGRAPHS
        solids: tuple[Solid, ...] = ()
        if self.settings.occlusion or has_images:
            solids = dressed(replace(self.truth, urdf=urdf), meshes_needed=has_images)
        posed = pose_machine(self.truth, solids, poses)
        on_base, views, groups = None, self.given_views, tuple[str, ...]()
        if self.plan is not None:
            on_base = self.plan.board
            if on_base is not None:
                posed = tuple(map(on_base.beside, posed))
            views = self.plan.viewpoints(self.rngs["cameras"], posed)
            groups = (self.plan.hand,) * len(views) if self.plan.hand else ()
        board = chosen_board(self.settings.board, posed)
        board_of_platform = chosen_board(self.settings.platform_board, posed, "platform")
        boards: tuple[FixedBoard, ...] = ()
        if board_of_platform is not None:
            T = board_on_platform(board_of_platform, self.truth, posed, poses.poses)
            first = 0 if board is None else board.n_corners
            boards = (FixedBoard(board_of_platform, "platform", T, first),)
            posed = tuple(
                placed_at(boards[0], T).beside(posed_machine)
                for T, posed_machine in zip(poses.poses, posed, strict=True)
            )
        if board is not None:
            in_order: Sequence[PosedMachine] = posed
            if self.settings.hand_held:
                views_of = range(len(self.cameras))
                in_order = [posed[p] for v in views_of for p in self.poses_of(v, len(posed))]
            on_base, views = board_and_cameras(
                board, self.truth, in_order, self.cameras, self.rngs["cameras"], self.progress
            )
            posed = tuple(map(on_base.beside, posed))
        elif not views:
            views, least = cameras_around(
                self.truth, posed, self.cameras, self.rngs["cameras"], self.progress
            )
            if boards and least <= 0.0:
                raise NotVisible(
                    "The cameras could not be placed: found no place for one of them from which it "
                    "sees the board on the platform in most poses, needed one for each; use fewer "
                    "views, or a smaller board."
                )
        if on_base is not None:
            boards = (FixedBoard(on_base.board, "base", on_base.T_base_board), *boards)
            if self.settings.hand_held:
                views, groups = self._in_hand(posed)
        if self.settings.level == Level.PHOTOGRAPHS:
            cameras = {
                id(view.camera): replace(
                    view.camera,
                    gamma=self.settings.appearance.gamma,
                    gamma_is_given=self.settings.tell_gamma,
                )
                for view in views
            }
            views = tuple(replace(view, camera=cameras[id(view.camera)]) for view in views)
        return posed, boards, views, groups

    def _in_hand(
        self, posed: tuple[PosedMachine, ...]
    ) -> tuple[tuple[Viewpoint, ...], tuple[str, ...]]:
        """Return for each image a camera with board and legs in view, and the name of its view."""
        views: list[Viewpoint] = []
        groups: list[str] = []
        n_images = len(self.cameras) * len(posed) // self.n_sets
        for v, (name, camera) in enumerate(self.cameras.items()):
            for k, pose in enumerate(self.poses_of(v, len(posed))):
                self.progress("Camera places", len(views), n_images)
                T = camera_in_hand(self.truth, posed[pose], camera, self.rngs["cameras"])
                if T is None:
                    raise NotVisible(
                        f"view {name}: a camera in the hand could not be placed: found none of "
                        f"{MAX_HAND_DRAWS} places from which image {k + 1} shows the board and a "
                        "leg, needed one; use a smaller board."
                    )
                views.append(Viewpoint(f"{name}-{k + 1}", camera, T))
                groups.append(name)
        self.progress("Camera places", n_images, n_images)
        return tuple(views), tuple(groups)


def _numbered(
    images: Images, views: Sequence[Viewpoint], groups: Sequence[str]
) -> tuple[Images, tuple[Viewpoint, ...], tuple[str, ...]]:
    """Renumber hand-held views by the remaining images, one view for each."""
    counts = dict.fromkeys(groups, 0)
    left, names = [], []
    for v in images.view.tolist():
        name = groups[v]
        counts[name] += 1
        left.append(replace(views[v], name=f"{name}-{counts[name]}"))
        names.append(name)
    numbered_images = replace(images, view=np.arange(len(images), dtype=np.intp))
    return numbered_images, tuple(left), tuple(names)


def _recorded(
    truth: Machine,
    poses: Configurations,
    labels: Sequence[str],
    scene: Scene,
    settings: SimulationSettings,
    rngs: Streams,
    *,
    hints: bool,  # whether the dataset states rough camera poses
) -> Measurements:
    """Return the rows of the dataset: readings with their errors, and rough poses of cameras."""
    legs, images = truth.leg_names, scene.images
    photographs = settings.level == Level.PHOTOGRAPHS
    # Tables list the visible legs; in photographs, legs that are often hidden are not searched.
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
        size = np.array([spread.size * (spread.distribution == kind) for spread in spreads])
        if kind == Distribution.UNIFORM:
            errors += rngs["readings"].uniform(-size, size, q.shape)
        else:
            errors += size * rngs["readings"].normal(size=q.shape)
    q = q + errors[:, list(truth.reads)]
    stated = {str(truth.legs[j].prismatic): spreads[j].sigma for j in truth.motors}
    sigma = np.maximum(sigmas_of_legs(truth.legs, settings.encoder_sigma, stated), _MIN_SIGMA_Q)
    names = [""] * len(images)
    if photographs:
        repeated, suffix = int(images.repeat.max()) > 0, settings.appearance.pipeline.suffix
        names = [
            f"images/{views[v].name}_{labels[p]}{f'_{k + 1}' * repeated}{suffix}"
            for v, p, k in zip(images.view, images.pose, images.repeat, strict=True)
        ]
    visible_poses, pose = np.unique(images.pose, return_inverse=True)
    return Measurements(
        views=tuple(views),
        image=tuple(names),
        view=images.view,
        pose=pose.astype(np.intp),
        q=q[images.pose],
        sigma_q=sigma,
        pose_labels=tuple(labels[p] for p in visible_poses),
        time=np.asarray(_SECONDS_A_POSE * images.pose + images.repeat, dtype=np.float64),
    )


# Poses


_REGULAR_NOMINAL = 0.05  # minimum singularity measure of the nominal model, in units of home
_MAX_ROUNDS = 20  # maximum rounds of draws that replace poses unreachable for the nominal model


def are_extreme(machine: Machine, readings: Array) -> BoolArray:
    """Return a mask (n_poses,) of the poses with every motor near an end of its travel."""
    lower, upper = motor_travel(machine)
    part = (readings[:, list(machine.motors)] - lower) / (upper - lower)
    return np.asarray(np.all(np.minimum(part, 1.0 - part) <= JITTER, axis=1))


def draw_poses(
    machine: Machine,
    n_poses: int,
    rng: np.random.Generator,
    sampling: Sampling | str = Sampling.EXTREME,
    progress: Report = no_progress,
) -> Configurations:
    """Return random poses of a machine."""
    if n_poses < 1 or sampling not in list(Sampling):
        raise UsageError(
            f"Poses could not be drawn: found {n_poses} poses and the sampling '{sampling}', "
            f"needed at least one pose and {' or '.join(Sampling)}; choose them."
        )
    extreme = Sampling(sampling) is Sampling.EXTREME
    return feasible_poses(machine, n_poses, rng, extreme=extreme, progress=progress)


def given_poses(machine: Machine, path: Path) -> Configurations:
    """Return the poses at the readings of a CSV: a table as ``init`` reads it, in SI by joints.

    Each is reached from the nearest pose that has been reached already, or from home.
    """
    if not machine.is_determined:
        raise UsageError(
            f"{path}: poses could not be given: found a machine of {machine.mobility} freedoms "
            f"and {len(machine.motors)} motors, needed one whose readings tell its pose; let "
            "poses be drawn."
        )
    sheet = ReadingsSheet(path, machine, "pose", others=[Column("name", "text", required=False)])
    table = sheet.table
    readings = sheet.readings(in_si=set(machine.motor_names) <= sheet.taken.keys()).q
    feasibility, reached = Feasibility(machine), list[Array]()
    obstacles = [_outside_travel(machine, row) for row in readings]
    inside = [k for k, obstacle in enumerate(obstacles) if obstacle is None]
    chains = followed(machine, readings[inside], must_agree=False)
    for k, (configuration, failure) in zip(inside, chains, strict=True):
        reached.append(configuration)
        T = platform_in_base(machine, platform_pose(machine, configuration))
        if failure is not None:
            obstacles[k] = Cause.LENGTHS
        elif off := contradictions(machine, [T], readings[[k]]):
            obstacles[k] = str(off[0].cause(machine))
        else:
            obstacles[k] = feasibility.problem(configuration, of_motors=False)
    if problems := [
        f"{place}: the pose could not be used: found {obstacle} there, needed a pose that the "
        "machine reaches from home; correct or remove the row."
        for place, obstacle in zip(table.where, obstacles, strict=True)
        if obstacle is not None
    ]:
        raise DatasetError(problems)
    return poses_at(machine, reached)


def commanded_poses(
    truth: Machine,
    nominal: Machine,
    n_poses: int,
    rng: np.random.Generator,
    sampling: Sampling | str,
    progress: Report = no_progress,
) -> Configurations:
    """Return random poses of a machine that its nominal model reaches at the same readings.

    A controller plans with the nominal model. Beside a singularity small errors decide whether
    legs of some lengths meet at all, and poses there are drawn again. Where motors do not
    determine the pose, the nominal model need not reach them.
    """
    kept: list[Array] = []

    def report(stage: str, done: int, total: int) -> None:
        progress(stage, len(kept) + done, len(kept) + total)

    for _ in range(_MAX_ROUNDS):
        drawn = draw_poses(truth, n_poses - len(kept), rng, sampling, report)
        kept += list(drawn.configurations[_reached(nominal, drawn.readings)])
        if len(kept) == n_poses:
            return poses_at(truth, kept)
    raise DidNotConverge(
        f"{nominal.yaml_path}: {n_poses} poses could not be drawn: found {len(kept)} that "
        f"the true machine and the nominal model reach at the same readings in {_MAX_ROUNDS} "
        "rounds, needed all; make the errors of the true machine smaller, or give poses."
    )


def _outside_travel(machine: Machine, row: Array) -> str | None:
    """Return in words the reading of a motor outside its travel, among (n_motors,) [m]."""
    for j, q in zip(machine.motors, row, strict=True):
        leg = machine.legs[j]
        lower, upper = leg.travel
        slack = TRAVEL_TOLERANCE * max(abs(lower), abs(upper))
        if not lower - slack <= q <= upper + slack:
            travel = f"{lower:.9g} to {upper:.9g} m"
            return f"{leg.prismatic} at {q:.9g} m, outside its travel of {travel},"
    return None


def _reached(nominal: Machine, readings: Array) -> BoolArray:
    """Return a mask of readings (k, n_legs) in reach of the nominal model, off singularities."""
    if not nominal.is_determined:
        return np.ones(len(readings), dtype=np.bool_)
    poses, failures = zip(*followed_poses(nominal, readings, on_the_chain=False), strict=True)
    is_reached = np.array([failure is None for failure in failures])
    regular = singularities(nominal, np.array([T.as_matrix() for T in poses]))
    least = _REGULAR_NOMINAL * singularity(nominal, nominal.home)
    return np.asarray(is_reached & (regular >= least))


Streams = Mapping[str, np.random.Generator]


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
    """A camera with its surroundings, and the machine in the poses to photograph.

    Two studios with the same key are equal, in whatever process they are.
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


# A session planned by ``legcal plan``, the tripods a little off the planned poses


@dataclass(frozen=True, eq=False)
class PlannedSession:
    """A plan: its rows, tolerances, and board."""

    measurements: Measurements  # one row an image, with planned poses of views
    setting: Setting  # tolerances of tripods
    board: PlacedBoard | None  # on the base
    hand: str  # name of the view of a hand-held camera; "" for fixed cameras

    @property
    def poses_of(self) -> list[list[int]]:
        """The poses that each view sees."""
        m = self.measurements
        return [m.pose[m.view == v].tolist() for v in range(len(m.views))]

    def viewpoints(
        self,
        rng: np.random.Generator,
        posed_machines: Sequence[PosedMachine],  # in all poses, with the board
    ) -> tuple[Viewpoint, ...]:
        """Return the views with actual camera poses, within the tolerance of the plan.

        A hand-held camera is moved until it shows the board. Raises NotVisible if it never does.
        """
        viewpoints = []
        for view, poses in zip(self.measurements.views, self.poses_of, strict=True):
            T = view.T_base_camera
            if T is None:
                raise UsageError(
                    f"The plan could not be shot: found no T_base_camera of view {view.name}, "
                    "needed where its camera stands; write it into dataset.yaml, or plan again."
                )
            for _ in range(MAX_HAND_DRAWS if self.hand else 1):
                moved, board = self.setting.perturbed_camera(T, rng), self.board
                if not self.hand or board is None:
                    break
                if board.is_enough(board.seen(posed_machines[poses[0]], view.camera, moved)):
                    break
            else:
                raise NotVisible(
                    f"The plan could not be shot: found that image {view.name} shows the board "
                    f"from none of {MAX_HAND_DRAWS} places near that of the plan, needed all of "
                    "it; plan with a smaller board."
                )
            viewpoints.append(Viewpoint(view.name, view.camera, moved))
        return tuple(viewpoints)

    def poses(self, truth: Machine) -> Configurations:
        """Return the poses of the true machine at the planned readings."""
        m = self.measurements
        reached: list[Array] = []
        try:
            for configuration in follow_each(truth, m.q_of_poses[:, list(truth.motors)]):
                reached.append(configuration)
        except DidNotConverge as error:
            raise DidNotConverge(
                f"The plan could not be shot: found that the true machine does not reach pose "
                f"{len(reached) + 1}, needed all of them; draw smaller --error, or plan again."
            ) from error
        return poses_at(truth, reached)


def read_plan(folder: Path, nominal: Machine) -> PlannedSession:
    """Return a planned session. Raises UsageError if it is invalid, or of another machine."""
    try:
        document = read_json(folder / PLAN_NAME)
        if not isinstance(document, dict) or "legcal_plan" not in document:
            raise ValueError("another document")
        plan = validate(PlanDocument, document, folder / PLAN_NAME)
        places = [view.T_base_camera.motion() for view in plan.views.values()]
        laid = None if plan.T_base_board is None else plan.T_base_board.motion()
    except (OSError, ValueError, TypeError) as error:
        raise UsageError(
            f"{folder}: the plan could not be shot: found no {PLAN_NAME} in it that can be read, "
            "needed the folder that legcal plan wrote; correct --plan."
        ) from error
    tolerance = plan.tolerance
    setting = Setting(
        tolerance.camera_m, tolerance.machine_m, tolerance.camera_rad, tolerance.machine_rad
    )
    dataset = load_dataset(folder, check_images=False)
    if difference_in_words := difference(nominal, dataset.machine):
        raise UsageError(
            f"{folder}: the plan could not be shot: found {difference_in_words}, needed a plan of "
            f"{nominal.name}; correct MODEL or --plan."
        )
    if not nominal.is_determined:
        raise UsageError(
            f"{folder}: the plan could not be shot: found a machine whose readings do not tell its "
            "pose, needed one whose do; simulate it without --plan."
        )
    m, on_base, hand = dataset.measurements, dataset.board_on("base"), ""
    board = None if on_base is None or laid is None else PlacedBoard(on_base.board, laid)
    if any(view.hand_held for view in m.views):
        if board is None or len(places) != len(m.views):
            raise UsageError(
                f"{folder}: the plan could not be shot: found {len(places)} camera places and "
                f"{'no' if board is None else 'a'} place of the board for {len(m.views)} images of "
                f"a camera in the hand, needed one for each image and that of the board in "
                f"{PLAN_NAME}; plan again."
            )
        hand = m.views[0].name.rpartition("-")[0]
        views_and_places = zip(m.views, places, strict=True)
        m = replace(m, views=tuple(replace(view, T_base_camera=T) for view, T in views_and_places))
    return PlannedSession(m, setting, board, hand)


# A small photograph from a planned camera


_WIDTH = 400  # [px] of a preview


def preview(
    machine: Machine,
    camera: Camera,
    T_base_camera: RigidTransform,
    poses: Configurations,
    board: LaidBoard | None = None,
) -> bytes:
    """Return a JPEG of a machine in the first of some poses, without noise and clutter."""
    small = divided(camera, min(_WIDTH / camera.width, 1.0))
    (posed,) = pose_machine(machine, dressed(machine, meshes_needed=False), poses.chosen([0]))
    if board is not None:
        posed = PlacedBoard(board.board, board.T_base_board).beside(posed)
    rng = np.random.default_rng(0)
    look = replace(Appearance(), clutter=0)
    image = prepare_view(posed.solids, small, T_base_camera, look, rng).render(posed.solids, rng)
    return small_jpeg(image, _WIDTH, quality=85)
