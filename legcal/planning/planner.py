"""The method: poses, camera places, images chosen and exchanged, polished, judged.

:func:`plan_session` reads from the top. Poses that the machine can take and places of cameras are
drawn, places chosen by what they show on average, images chosen greedily and exchanged,
then places and poses polished by exchanges with others nearby. What is expected is judged by
sessions as they will be, with tripods and machine a little elsewhere.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from scipy.linalg import block_diag
from scipy.spatial.transform import RigidTransform

from legcal.calibration.joint_fit.platform import poses_at_readings
from legcal.errors import NotIdentifiable, NotVisible
from legcal.geometry.motions import look_at
from legcal.geometry.types import Array, BoolArray
from legcal.machine.configurations import Configurations
from legcal.machine.kinematics import platforms_in_base
from legcal.machine.leg import Leg
from legcal.machine.model import Machine
from legcal.planning.exchange import Chosen, Criterion, Session, choose, exchange
from legcal.planning.goals import Workspace, criterion_of, workspace_of
from legcal.planning.information import Contributions, Predictor
from legcal.planning.laid_board import LaidBoard, lying
from legcal.planning.order import in_short_order, ways
from legcal.planning.places import (
    Place,
    Setting,
    all_points,
    near,
    places_around,
)
from legcal.planning.planned_session import Plan, PlannedView, pose_labels
from legcal.planning.poses import candidate_poses, drawn_legs, poses_near, some_of
from legcal.planning.sight import Bodies, Seen, what_is_seen
from legcal.progress import Report, no_progress
from legcal.vision.board import Board
from legcal.vision.visibility import in_picture, least_length
from legcal.workers import Run, in_turn

MIN_POSES, POSES_EACH, MOST_POSES = 20, 6, 320  # candidates, by images
N_PROBES = 12  # poses by which places are compared
N_BOARD_PROBES = 4  # poses by which places of a board are compared
FAR = 3.0  # sizes of the machine, from where that is looked at
N_HANDS = 10  # places that a camera in the hand chooses from
MIN_SHARE = 0.5  # of its equal share that each view has of the images, at least
ROUNDS = 3  # of polishing, each with half the steps of the one before
POSE_STEP = 0.08  # of the travel
PLACE_STEP = 0.06  # of the distance
N_NEAR_PLACES = 8
# Mean leg lengths: a session that leaves more, and more than the model, is refused
_LEAST_ERROR = 0.0025
_CONTINUED = (1.5, 2.0, 3.0, 4.0, 8.0, 16.0)  # times the planned images
_MOST_NEEDED = 100  # images that are looked at to say how many would do


@dataclass(frozen=True, eq=False)
class Candidates:
    """A camera place with poses of the machine."""

    place: Place
    poses: Configurations


@dataclass(frozen=True, eq=False)
class Task:
    """The planning task: machine, numbers of images and views, conditions."""

    predictor: Predictor
    n_images: int
    n_views: int
    setting: Setting
    bounds: Array | None = None  # (3, 2) of cameras in the base link [m]
    places: tuple[Place, ...] = ()  # in place of those around the machine
    given: tuple[Candidates, ...] = ()  # what was shot already
    given_name: str = ""
    board: Board | None = None
    hand_held: bool = False
    seed: int = 0
    laid: LaidBoard | None = None  # the board in its place, once that is chosen

    @property
    def machine(self) -> Machine:
        """The nominal model."""
        return self.predictor.machine

    @property
    def n_given(self) -> int:
        """Number of images that were shot already."""
        return sum(len(one.poses.poses) for one in self.given)


@dataclass(frozen=True, eq=False)
class Scene:
    """The nominal machine, or one that is drawn, before cameras."""

    task: Task
    legs: tuple[Leg, ...]  # in R_b and R_e

    @classmethod
    def nominal(cls, task: Task) -> Scene:
        """Return the nominal machine."""
        return cls(task, task.predictor.legs.nominal)

    @classmethod
    def drawn(cls, task: Task, rng: np.random.Generator) -> Scene:
        """Return a machine as it may be."""
        return cls(task, drawn_legs(task.predictor.legs, task.setting, rng))

    def seen(self, T: RigidTransform, poses: Sequence[RigidTransform], *, surely: bool) -> Seen:
        """Return what a camera sees at poses T_Rb_Re; *surely*: wherever the tripod is set."""
        bodies = Bodies.at(self.task.machine, self.legs, poses)
        points = np.concatenate([bodies.A, bodies.B]).reshape(-1, 3)
        margin = self._margin(T, points) if surely else 0.0
        return what_is_seen(self.task.predictor.camera, T, bodies, margin)

    def board_is_shown(
        self,
        T: RigidTransform,
        poses: Sequence[RigidTransform],
        *,
        surely: bool,
        is_read: bool = True,
    ) -> BoolArray:
        """Return which images show the board, (n_images,); all of them where there is none."""
        laid, camera = self.task.laid, self.task.predictor.camera
        if laid is None:
            return np.ones(len(poses), dtype=np.bool_)
        bodies = Bodies.at(self.task.machine, self.legs, poses)
        margin = self._margin(T, laid.corners) if surely else 0.0
        return laid.is_shown(camera, T, bodies, margin, is_read=is_read)

    def showing(self, own: Candidates) -> Candidates:
        """Return the candidates whose images show the board, the same if all do."""
        poses = platforms_in_base(self.task.machine, own.poses.poses)
        shown = self.board_is_shown(own.place.T_base_camera, poses, surely=True)
        if shown.all():
            return own
        return replace(own, poses=some_of(own.poses, np.flatnonzero(shown).tolist()))

    def _margin(self, T: RigidTransform, points: Array) -> float:
        """Return how far in the picture points (n, 3) in the base link move at most [px]."""
        nearest = float(T.inv().apply(points)[:, 2].min())
        return self.task.setting.margin(self.task.predictor.camera, max(nearest, 0.1))

    def contributions(
        self,
        T: RigidTransform,
        poses: Sequence[RigidTransform],
        *,
        surely: bool = True,
        is_shot: bool = False,
        is_fit: bool = False,
    ) -> Contributions | None:
        """Return what images of poses T_Rb_Re add; None if they show nothing.

        An image without the board adds nothing, unless it was shot already.
        """
        seen, n = self.seen(T, poses, surely=surely), len(poses)
        with_board = is_shot or self.board_is_shown(T, poses, surely=surely)
        if not len(seen.leg) or not np.any(with_board):
            return None
        outlines = seen.outlines(1.0, np.arange(n, dtype=np.intp))
        view = np.zeros(n, dtype=np.intp)
        found = self.task.predictor.contributions(
            {"here": T}, view, poses, outlines, self.legs, is_fit=is_fit
        )
        if self.task.board is not None:
            found = _tied_by_board(found, T)
            found = replace(found, rows=found.rows * np.reshape(with_board, (-1, 1, 1)))
        if self.task.hand_held:  # one series of images of one camera
            found = replace(found, names=tuple(n.replace("here: ", "hand ") for n in found.names))
        return found

    def of(self, candidates: Candidates, *, is_shot: bool = False) -> Contributions | None:
        """Return what images of candidates add."""
        poses = platforms_in_base(self.task.machine, candidates.poses.poses)
        return self.contributions(candidates.place.T_base_camera, poses, is_shot=is_shot)


def _tied_by_board(found: Contributions, T_base_camera: RigidTransform) -> Contributions:
    """Return contributions of a view whose camera a board on the base places.

    What the board shows of where cameras stand to it counts as exact: cameras move with it alone,
    each turned and displaced as its own frame sees that.
    """
    R = T_base_camera.rotation.as_matrix().T
    at = [found.names.index(f"here: pose {k}") for k in range(6)]
    turned = block_diag(R, R)
    rows, prior, names = found.rows.copy(), found.prior.copy(), list(found.names)
    rows[..., at] = rows[..., at] @ turned
    prior[np.ix_(at, at)] = turned.T @ prior[np.ix_(at, at)] @ turned
    for k, i in enumerate(at):
        names[i] = f"board {k}"
    return replace(found, rows=rows, prior=prior, names=tuple(names))


def plan_session(
    task: Task,
    progress: Report = no_progress,
    stop: Callable[[], bool] = lambda: False,
    run: Run = in_turn,
) -> Plan:
    """Return the plan of a session.

    Its steps look at the nominal machine before cameras where they are planned. A round of steps
    is kept where the mean over machines and tripods as they may be is better. What places show, and
    these draws, are worked out by *run*; plans do not depend on it.

    Raises DidNotConverge, NotVisible or NotIdentifiable if there are no poses, no places, or too
    few images.
    """
    machine, legs, rng = task.machine, task.predictor.legs, np.random.default_rng(task.seed)
    n_poses = min(MOST_POSES, MIN_POSES + POSES_EACH * task.n_images)
    poses = candidate_poses(machine, legs, task.setting, n_poses, rng, progress)
    task = _with_laid_board(task, poses)
    scene = Scene.nominal(task)
    shown = _probed(scene, _places(task, poses), poses, rng, progress, run)
    before = [scene.of(one, is_shot=True) for one in task.given]
    work, basis = workspace_of(machine, legs), shown[0][1].basis
    search = _Search(
        scene,
        [found for found in before if found is not None],
        work,
        basis,
        criterion_of(work, legs, basis),
        rng,
        progress,
        stop,
        run,
    )
    current, least, value = search.chosen(shown, poses)
    target = _framed(task, poses)
    middle = 0.5 * (target.min(axis=0) + target.max(axis=0))
    expected = search.expected_covariance(current)
    for turn in range(ROUNDS):
        if stop():
            break
        step = 0.5**turn
        placed = search.better_places(current, step, middle)
        polished, reached = search.better_poses(placed, step, least)
        there = search.expected_covariance(polished)
        if search.value_of(there) < search.value_of(expected):
            current, value, expected = polished, reached, there
        progress("Polishing", turn + 1, ROUNDS)
    was_stopped = stop()
    plan = search.judged(current, value, expected)
    if was_stopped:
        note = "The search was stopped: this is the best plan that it had found."
        plan = replace(plan, notes=(note, *plan.notes))
    return plan


def _places(task: Task, poses: Configurations) -> list[Place]:
    """Return the places that cameras may take."""
    if task.places:
        return list(task.places)
    points = _framed(task, poses)
    return places_around(task.machine, points, task.predictor.camera, task.setting, task.bounds)


def _framed(task: Task, poses: Configurations) -> Array:
    """Return what pictures are to show, (n, 3) in the base link [m]: joints, and the board."""
    points = all_points(task.machine, poses.poses)
    return points if task.laid is None else np.concatenate([points, task.laid.corners])


def _with_laid_board(task: Task, poses: Configurations) -> Task:
    """Return the task with its board where most places around the machine see it.

    Raises NotVisible if none does.
    """
    if task.board is None:
        return task
    some = np.linspace(0, len(poses.poses) - 1, min(N_BOARD_PROBES, len(poses.poses))).astype(int)
    in_Rb = platforms_in_base(task.machine, [poses.poses[i] for i in some])
    places = [place.T_base_camera for place in _places(task, poses)]
    if not task.places:  # wherever the board is, they can go back until it is in the picture
        points = all_points(task.machine, poses.poses)
        middle = 0.5 * (points.min(axis=0) + points.max(axis=0))
        away = np.array([T.translation - middle for T in places])
        away = np.unique((away / np.linalg.norm(away, axis=1)[:, None]).round(6), axis=0)
        away *= FAR * float(np.linalg.norm(np.ptp(points, axis=0)))
        places = [look_at(middle + step, middle) for step in away]
    best, most = task, 0.0
    for laid in lying(task.board, task.machine):
        trial = replace(task, laid=laid)
        scene = Scene.nominal(trial)
        of_all = [
            scene.board_is_shown(T, in_Rb, surely=False, is_read=bool(task.places)) for T in places
        ]
        share = np.mean(of_all)
        if share > most:
            best, most = trial, float(share)
    if not most:
        raise NotVisible(
            f"{task.machine.yaml_path}: no session could be planned: found no place of the board "
            "flat on the base that a camera sees beside the legs wherever it is set, needed one; "
            "use another board, wider --bounds, or a camera with a wider view."
        )
    return best


def _probed(
    scene: Scene,
    places: Sequence[Place],
    poses: Configurations,
    rng: np.random.Generator,
    progress: Report,
    run: Run,
) -> list[tuple[Place, Contributions]]:
    """Return the places that see legs, with what they show of some poses."""
    machine, found = scene.task.machine, []
    probes = np.sort(rng.permutation(len(poses.poses))[:N_PROBES]).tolist()
    in_Rb = platforms_in_base(machine, [poses.poses[i] for i in probes])
    of_places = run(
        partial(scene.contributions, poses=in_Rb), [place.T_base_camera for place in places]
    )
    for k, (place, contributions) in enumerate(zip(places, of_places, strict=True)):
        if contributions is not None:
            found.append((place, contributions))
        progress("Camera places", k + 1, len(places))
    needed = 1 if scene.task.hand_held else scene.task.n_views
    if not found or (scene.task.places and len(found) < needed):
        used = {id(place) for place, _ in found}
        blind = [place for place in places if id(place) not in used]
        raise NotVisible(_unseen(scene, blind, len(places), needed, in_Rb))
    return found


_REMEDIES = {
    "elsewhere": "turn {} to the machine, or move further away",
    "near": "move {} further away, or use a camera with a wider view",
    "far": "move {} nearer, or use a camera with a longer focal length or more pixels",
    "hidden": "move {} to where no plate or other leg is in front of the legs",
    "board": "move {} to where all of the board is in the picture, or use a smaller one",
    "small": "use a board of larger squares, or a camera with a longer focal length or more pixels",
}


def _unseen(
    scene: Scene,
    blind: Sequence[Place],
    n_places: int,
    needed: int,
    poses: Sequence[RigidTransform],
) -> str:
    """Return that too few places see legs, and the remedy for what most of the others lack."""
    setting = scene.task.setting
    board = "" if scene.task.board is None else " and the board"
    causes = [_why_unseen(scene, place.T_base_camera, poses) for place in blind]
    remedy = _REMEDIES[max(_REMEDIES, key=causes.count)]
    names = ", ".join(place.name for place in blind if place.name)
    return (
        f"{scene.task.machine.yaml_path}: no session could be planned: found "
        f"{n_places - len(blind)} of {n_places} camera places that see legs{board} wherever the "
        f"tripod is set within {1e2 * setting.shift:.2g} cm and {np.degrees(setting.turn):g} deg, "
        f"needed {needed}; {remedy.format(names or 'the places')}."
    )


def _why_unseen(scene: Scene, T: RigidTransform, poses: Sequence[RigidTransform]) -> str:
    """Return why a camera sees no legs, or no board, at poses T_Rb_Re, a key of the remedies."""
    camera = scene.task.predictor.camera
    if len(scene.seen(T, poses, surely=True).leg):  # the board alone is missing
        is_in_view = scene.board_is_shown(T, poses, surely=True, is_read=False).any()
        return "small" if is_in_view else "board"
    bodies = Bodies.at(scene.task.machine, scene.legs, poses).before(T)
    points = np.concatenate([bodies.A, bodies.B]).reshape(-1, 3)
    if not in_picture(camera, points, bodies.nearest).any():
        return "elsewhere"
    nearest = float(points[:, 2].min())
    if nearest > bodies.nearest:
        stretch = camera.project(bodies.A) - camera.project(bodies.B)
        if np.linalg.norm(stretch, axis=-1).max() < least_length(0.0):
            return "far"
    margin = scene.task.setting.margin(camera, max(nearest, bodies.nearest))
    return "hidden" if in_picture(camera, points, bodies.nearest, margin).all() else "near"


def choose_places(
    shown: Sequence[Contributions],
    n_views: int,
    n_images: int,
    criterion: Criterion,
    given: Sequence[Contributions] = (),
) -> list[int]:
    """Return the places whose images, on average, determine the machine best together."""
    names: dict[str, int] = {}
    for found in (*shown, *given):
        for name in found.names:
            if ": " not in name:
                names.setdefault(name, len(names))
    shared = np.zeros((len(shown) + len(given), len(names), len(names)))
    prior = np.zeros((len(names), len(names)))
    for k, found in enumerate((*shown, *given)):
        is_own = np.array([": " in name for name in found.names])
        at = np.array([names[name] for name in found.names if ": " not in name])
        stacked = found.all_gains().reshape(-1, len(found.names))
        share = n_images / n_views / len(found.rows) if k < len(shown) else 1.0
        G = stacked.T @ stacked * share
        own = G[np.ix_(is_own, is_own)] + found.prior[np.ix_(is_own, is_own)]
        mixed = G[np.ix_(is_own, ~is_own)]
        G = G[np.ix_(~is_own, ~is_own)] - mixed.T @ np.linalg.solve(own, mixed)
        shared[k][np.ix_(at, at)] = G
        prior[np.ix_(at, at)] = found.prior[np.ix_(~is_own, ~is_own)]
    p, free = shown[0].basis.shape[1], shared[: len(shown)]
    base = prior + shared[len(shown) :].sum(axis=0)

    def values(others: Sequence[int]) -> Array:
        inverse = np.linalg.inv(base + free[list(others)].sum(axis=0) + free)
        of_each = criterion(np.asarray(inverse[:, :p, :p], dtype=np.float64))
        if n_views <= len(free):
            of_each[list(others)] = np.inf
        return of_each

    chosen: list[int] = []
    while len(chosen) < n_views:
        chosen.append(int(np.argmin(values(chosen))))
    while True:
        before = list(chosen)
        for i in range(n_views):
            others = chosen[:i] + chosen[i + 1 :]
            of_each = values(others)
            if of_each.min() < of_each[chosen[i]]:
                chosen[i] = int(np.argmin(of_each))
        if chosen == before:
            return chosen


def _of_images(current: Sequence[Candidates], images: Chosen) -> list[Candidates]:
    """Return the places with the poses that were chosen, places without any left out."""
    of_slot = [[k for s, k in images.images if s == v] for v in range(len(current))]
    return [
        replace(own, poses=some_of(own.poses, which))
        for own, which in zip(current, of_slot, strict=True)
        if which
    ]


@dataclass(frozen=True, eq=False)
class _Search:
    """The search for a session, and what each of its steps needs."""

    scene: Scene  # the nominal machine
    given: Sequence[Contributions]  # of images that were shot already
    work: Workspace | None  # None where readings give no pose
    basis: Array  # of the coordinates of the machine
    criterion: Criterion
    rng: np.random.Generator
    progress: Report
    stop: Callable[[], bool]
    run: Run

    @property
    def task(self) -> Task:
        """What is asked."""
        return self.scene.task

    def added(self, candidates: Sequence[Candidates]) -> list[Contributions]:
        """Return what images of candidates add, all of which see legs."""
        return [one for one in self.run(self.scene.of, candidates) if one is not None]

    def with_all(self, slots: Sequence[Contributions]) -> Session:
        """Return the session with all images of all slots."""
        return Session([], [*slots, *self.given])

    def value(self, slots: Sequence[Contributions]) -> float:
        """Return the criterion with all images of all slots."""
        return float(self.criterion(self.with_all(slots).machine[None])[0])

    def chosen(
        self, shown: Sequence[tuple[Place, Contributions]], poses: Configurations
    ) -> tuple[list[Candidates], int, float]:
        """Return places and poses to begin with, the least images of each, and the criterion.

        Raises NotVisible or NotIdentifiable if the images are too few.
        """
        task, machine = self.task, self.task.machine
        n_places = min(N_HANDS, len(shown)) if task.hand_held else task.n_views
        of_places = [contributions for _, contributions in shown]
        chosen = choose_places(of_places, n_places, task.n_images, self.criterion, self.given)
        current = [self.scene.showing(Candidates(shown[i][0], poses)) for i in chosen]
        count = [len(own.poses.poses) for own in current]
        if sum(count) < task.n_images:
            raise NotVisible(
                f"{machine.yaml_path}: no session could be planned: found {sum(count)} images from "
                f"{len(current)} places that show legs and the board, needed {task.n_images}; plan "
                "fewer --images, more --cameras, or a board of another size."
            )
        least = 0 if task.hand_held else max(1, int(MIN_SHARE * task.n_images / task.n_views))
        least = min([least, *count])
        session = Session(self.added(current), self.given)
        images = choose(
            session, task.n_images, self.criterion, self.rng, least, task.n_images,
            progress=self.progress,
        )  # fmt: skip
        images = exchange(
            session, images, self.criterion, self.rng, least, task.n_images,
            progress=self.progress, stop=self.stop,
        )  # fmt: skip
        self._refuse_undetermined(session)
        return _of_images(current, images), least, images.value

    def _refuse_undetermined(self, session: Session) -> None:
        """Refuse a session that leaves a direction open that matters; say how many images do."""
        task, work, basis = self.task, self.work, self.basis
        most = max(task.setting.length, _LEAST_ERROR * task.machine.size)

        def off(S: Array) -> Array:
            """Return the error of the platform, or the criterion where readings give no pose."""
            if work is None:
                return self.criterion(S)
            errors = [work.error(basis @ one @ basis.T).mean_displacement for one in S]
            return np.array(errors)

        if float(off(session.machine[None])[0]) < most:
            return
        more = choose(
            Session(session.slots, self.given),
            _MOST_NEEDED,
            off,
            np.random.default_rng(task.seed),
            0,
            _MOST_NEEDED,
            is_enough=lambda error: error < most,
        )
        n = max(len(more.images), task.n_images + 1)
        places = f"{task.n_views} place{'s' * (task.n_views != 1)}"
        remedy = (
            f"plan {n} --images or more" if more.value < most else "plan more --cameras, or --board"
        )
        needed = f"at least {n}" if more.value < most else "more places"
        raise NotIdentifiable(
            f"{task.machine.yaml_path}: no session could be planned: found {task.n_images} "
            f"image{'s' * (task.n_images != 1)} from {places}, not enough to know the machine "
            f"better than its model does, needed {needed}; {remedy}."
        )

    def better_places(
        self, current: Sequence[Candidates], step: float, target: Array
    ) -> list[Candidates]:
        """Return the same poses seen from places nearby, where that is better."""
        current, known = list(current), self.added(current)
        value = self.value(known)
        for v, own in enumerate(current):
            for _ in range(0 if own.place.fixed else N_NEAR_PLACES):
                if self.stop():
                    break
                place = near(current[v].place, target, PLACE_STEP * step, self.rng)
                trial = replace(own, place=place)
                found = self.scene.of(trial) if place.is_inside(self.task.bounds) else None
                if found is None or self.scene.showing(trial) is not trial:
                    continue
                there = self.value([*known[:v], found, *known[v + 1 :]])
                if there < value:
                    current[v], known[v], value = trial, found, there
        return current

    def better_poses(
        self, current: Sequence[Candidates], step: float, least: int
    ) -> tuple[list[Candidates], float]:
        """Return places and poses after exchanges with poses nearby, and the criterion."""
        task, far = self.task, POSE_STEP * step
        widened = []
        for own in current:
            poses = own.poses
            if not self.stop():
                legs = task.predictor.legs
                poses = poses_near(task.machine, legs, task.setting, poses, far, self.rng)
            widened.append(self.scene.showing(replace(own, poses=poses)))
        session = Session(self.added(widened), self.given)
        images = [(v, k) for v, own in enumerate(current) for k in range(len(own.poses.poses))]
        for slot, image in images:
            session.changed(slot, image, 1.0)
        session.renewed()
        better = exchange(
            session, Chosen(images), self.criterion, self.rng, least, len(images), stop=self.stop
        )
        return _of_images(widened, better), better.value

    def value_of(self, covariance: Array) -> float:
        """Return the criterion of a covariance (p, p) of the parameters."""
        inverse = np.linalg.pinv(self.basis)
        return float(self.criterion((inverse @ covariance @ inverse.T)[None])[0])

    def expected_covariance(self, current: Sequence[Candidates]) -> Array:
        """Return the mean covariance (p, p) of the parameters in sessions as they may be."""
        n, covariances = self.task.setting.draws, []
        rngs = np.random.default_rng(self.task.seed + 1).spawn(n)
        for drawn in self.run(partial(drawn_covariance, self.task, current), rngs):
            covariances.append(drawn)
            self.progress("Draws", len(covariances), n)
        return np.asarray(np.mean(covariances, axis=0))

    def judged(self, current: Sequence[Candidates], value: float, covariance: Array) -> Plan:
        """Return the plan with what sessions as they may be are expected to give, (p, p)."""
        task, predictor, machine = self.task, self.task.predictor, self.task.machine
        found = self.added(current)
        ordered, begin = list[Configurations](), machine.home_configuration
        for own in current:
            ordered.append(some_of(own.poses, in_short_order(machine, own.poses, begin)))
            begin = ordered[-1].configurations[-1]
        via, blocked = ways(machine, np.concatenate([poses.configurations for poses in ordered]))
        views, done = [], 0
        for own, poses in zip(current, ordered, strict=True):
            of_view = via[done : done + len(poses.poses)]
            done += len(poses.poses)
            T, in_Rb = own.place.T_base_camera, platforms_in_base(machine, poses.poses)
            seen = self.scene.seen(T, in_Rb, surely=False)
            views.append(PlannedView(own.place.name, T, poses, of_view, seen))
        notes = []
        if blocked:
            notes.append(
                f"No free way was found to {blocked} of the poses, not even by home: lead the "
                "machine there by hand, away from singularities and collisions."
            )
        if not machine.is_determined:
            notes.append(f"Readings do not give the pose: {machine.undetermined}.")
        parametrization = predictor.legs.parametrization
        sigma = np.sqrt(np.maximum(np.diagonal(covariance), 0.0))
        return Plan(
            machine=machine,
            camera=predictor.camera,
            setting=task.setting,
            noise=predictor.noise,
            sigma_q=predictor.sigma_q,
            sigma_by_joint=predictor.sigma_by_joint,
            views=_named(views, task),
            value=value,
            error=None if self.work is None else self.work.error(covariance),
            sigma=sigma,
            names=parametrization.names,
            units=parametrization.units,
            growth=self._growth(found),
            limits=_limits(self.with_all(found), self.criterion),
            seed=task.seed,
            board=task.laid,
            hand_held=task.hand_held,
            given=task.given_name,
            n_given=task.n_given,
            notes=tuple(notes),
        )

    def _growth(self, found: Sequence[Contributions]) -> Array:
        """Return numbers of images and the criterion with so many, (n, 2), beyond those planned."""
        n = sum(len(part.rows) for part in found)
        session = Session(found, self.given)
        order = choose(session, n, self.criterion, np.random.default_rng(0), 0, n)
        rows = [(k + 1.0, value) for k, value in enumerate(order.history)]
        for times in _CONTINUED:
            more = [part.repeated(times) for part in found]
            rows.append((round(times * n), self.value(more)))
        return np.array(rows)


def _named(views: Sequence[PlannedView], task: Task) -> tuple[PlannedView, ...]:
    """Return views with the names of their places, or new ones in turn; hand-held ones by pose."""
    if task.hand_held:
        views = [
            replace(
                view, poses=some_of(view.poses, [k]), via=(view.via[k],), seen=view.seen.only(k)
            )
            for view in views
            for k in range(len(view.poses.poses))
        ]
        labels = pose_labels(len(views), task.n_given)
        return tuple(replace(view, name=own) for view, own in zip(views, labels, strict=True))
    taken = {one.place.name for one in task.given}
    free = (f"c{k}" for k in range(1, 10**6) if f"c{k}" not in taken)
    return tuple(view if view.name else replace(view, name=next(free)) for view in views)


def drawn_covariance(task: Task, current: Sequence[Candidates], rng: np.random.Generator) -> Array:
    """Return the covariance (p, p) of the parameters in a session as it may be."""
    there, machine, parts = Scene.drawn(task, rng), task.machine, []
    for own, is_set in (*((c, False) for c in current), *((c, True) for c in task.given)):
        nearby = platforms_in_base(machine, own.poses.poses)
        poses: Sequence[RigidTransform] = nearby
        if machine.is_determined:
            poses = poses_at_readings(machine, there.legs, own.poses.readings, nearby)
        T = own.place.T_base_camera
        T = T if is_set else task.setting.camera_elsewhere(T, rng)
        found = there.contributions(T, poses, surely=False, is_shot=is_set, is_fit=True)
        if found is not None:
            parts.append(found)
    session = Session([], parts)
    basis = parts[0].basis
    return np.asarray(basis @ session.fitted() @ basis.T)


_LIMITS = {
    "common-mode edge biases": ("bias", "tilt"),
    "the gamma of the camera": ("camera gamma",),
    "radii": ("radii",),
    "intrinsics of the camera": ("camera ",),
}


def _limits(session: Session, criterion: Criterion) -> dict[str, float]:
    """Return the criterion if errors of a kind were not there, or images were without end."""
    found = {}
    for what, words in _LIMITS.items():
        known = [
            i for name, i in session.names.items()
            if any(word in name for word in words)
            and not (what.startswith("intrinsics") and "gamma" in name)
        ]  # fmt: skip
        if known:
            left = np.setdiff1d(np.arange(len(session.names)), known)
            inverse = np.linalg.inv(session.information[np.ix_(left, left)])
            S = np.asarray(inverse[: session.p, : session.p], dtype=np.float64)
            found[what] = float(criterion(S[None])[0])
    return found
