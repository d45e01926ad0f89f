"""The method: candidate poses and places, selection of images, local search, evaluation.

:func:`plan_session` is the method from top to bottom. Feasible poses and camera places are drawn,
places selected by their mean information, images selected greedily and exchanged, then places and
poses refined by local search. The expected errors are the mean over random sessions, with tripods
and machine within their tolerances.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import lru_cache, partial

import numpy as np
from scipy.spatial.transform import RigidTransform

from legcal.calibration.joint_fit.part_errors import predicted_sigmas, sigmas_in_words
from legcal.calibration.joint_fit.platform import poses_at_readings, written_covariance
from legcal.calibration.joint_fit.predicted import (
    Contributions,
    Predictor,
    fitted_covariance,
    joined,
    predicted_outlines,
)
from legcal.errors import NotIdentifiable, NotVisible
from legcal.geometry.motions import components, look_at
from legcal.geometry.types import Array, BoolArray
from legcal.machine.configurations import Configurations
from legcal.machine.kinematics import platforms_in_base
from legcal.machine.leg import Leg
from legcal.machine.model import Machine
from legcal.planning.exchange import (
    Chosen,
    Criterion,
    Session,
    Workspace,
    choose,
    criterion_of,
    exchange,
    workspace_of,
)
from legcal.planning.places import (
    LaidBoard,
    Place,
    Setting,
    all_points,
    lying,
    near,
    places_around,
)
from legcal.planning.poses import (
    candidate_poses,
    drawn_legs,
    poses_near,
    shortest_order,
    ways,
)
from legcal.planning.session import Plan, PlannedView, pose_labels
from legcal.progress import Report, no_progress
from legcal.vision.board import Board
from legcal.vision.visibility import MIN_WIDTH, Bodies, Seen, visible_parts
from legcal.workers import Run, in_turn

MIN_POSES, POSES_EACH, MOST_POSES = 20, 6, 320  # candidates, by images
N_PROBES = 12  # poses by which places are compared
N_BOARD_PROBES = 4  # poses by which places of a board are compared
FAR = 3.0  # distance for this comparison, in sizes of the machine
N_HANDS = 10  # candidate places of a hand-held camera
MIN_SHARE = 0.5  # least number of images of a view, over an equal share
ROUNDS = 3  # of local search, each with half the step of the one before
POSE_STEP = 0.08  # of the travel
PLACE_STEP = 0.06  # of the distance
N_NEAR_PLACES = 8
# Mean leg lengths: a session with a larger error, also above the model's, is refused
_MIN_ERROR_LIMIT = 0.0025
_EXTRAPOLATED = (1.5, 2.0, 3.0, 4.0, 8.0, 16.0)  # multiples of the planned images
_MOST_NEEDED = 100  # images, in the search for a sufficient number

_FINER = "state a --camera with more pixels or a longer lens"
_N_ASKED = 8  # places of which the width of legs is looked at


@dataclass(frozen=True, eq=False)
class Candidates:
    """A camera place with poses of the machine."""

    place: Place
    poses: Configurations


@dataclass(frozen=True, eq=False)
class Task:
    """The planning task: machine, numbers of images and views, conditions, and what is seen."""

    predictor: Predictor
    n_images: int
    n_views: int
    setting: Setting
    bounds: Array | None = None  # (3, 2) of cameras in the base link [m]
    given: tuple[Candidates, ...] = ()  # existing images
    given_name: str = ""
    board: Board | None = None
    hand_held: bool = False
    seed: int = 0
    laid: LaidBoard | None = None  # the board at its selected place
    drawn: tuple[Leg, ...] | None = None  # of a machine within tolerance, in R_b and R_e

    @property
    def machine(self) -> Machine:
        """The nominal model."""
        return self.predictor.machine

    @property
    def n_given(self) -> int:
        """Number of existing images."""
        return sum(len(view.poses.poses) for view in self.given)

    @property
    def legs(self) -> tuple[Leg, ...]:
        """The legs that are seen, in R_b and R_e: drawn, or nominal."""
        return self.predictor.legs.nominal if self.drawn is None else self.drawn

    def bodies(self, poses: Sequence[RigidTransform]) -> Bodies:
        """Place legs and arms at poses T_Rb_Re."""
        return _bodies(self.machine, self.legs, tuple(poses))

    def seen(
        self,
        T: RigidTransform,
        poses: Sequence[RigidTransform],
        *,
        surely: bool,
        least_width: float = MIN_WIDTH,
    ) -> Seen:
        """Return the parts visible at poses T_Rb_Re; *surely*: for all tripods in tolerance."""
        bodies = self.bodies(poses)
        points = np.concatenate([bodies.A, bodies.B]).reshape(-1, 3)
        margin = self._margin(T, points) if surely else 0.0
        camera = self.predictor.camera
        return visible_parts(camera, T, bodies, margin, least_width=least_width)

    def too_narrow(self, seen_from: Sequence[Candidates]) -> str:
        """Say that the legs are too narrow in all pictures to be measured, "" if not."""
        widths = list[float]()
        for candidates in seen_from:
            poses = platforms_in_base(self.machine, candidates.poses.poses)
            T = candidates.place.T_base_camera
            ends = self.seen(T, poses, surely=False, least_width=0.0).ends
            if len(ends):
                widths.append(float(np.median(np.linalg.norm(ends[:, 0] - ends[:, 1], axis=-1))))
        most = max(widths, default=np.inf)
        is_said = f"legs are {most:.1f} px wide in the picture, and {MIN_WIDTH:g} px are needed"
        return is_said if most < MIN_WIDTH else ""

    def board_is_shown(
        self,
        T: RigidTransform,
        poses: Sequence[RigidTransform],
        *,
        surely: bool,
        is_read: bool = True,
    ) -> BoolArray:
        """Return a mask of images that show the board, (n_images,); all without a board."""
        laid, camera = self.laid, self.predictor.camera
        if laid is None:
            return np.ones(len(poses), dtype=np.bool_)
        bodies = self.bodies(poses)
        margin = self._margin(T, laid.corners) if surely else 0.0
        return laid.is_shown(camera, T, bodies, margin, is_read=is_read)

    def showing(self, candidates: Candidates) -> Candidates:
        """Select the candidates that show the board; the same object if all do."""
        poses = platforms_in_base(self.machine, candidates.poses.poses)
        shown = self.board_is_shown(candidates.place.T_base_camera, poses, surely=True)
        if shown.all():
            return candidates
        return replace(candidates, poses=candidates.poses.chosen(np.flatnonzero(shown).tolist()))

    def _margin(self, T: RigidTransform, points: Array) -> float:
        """Largest image shift of points (n, 3) in the base link within tolerance [px]."""
        nearest = float(T.inv().apply(points)[:, 2].min())
        return self.setting.margin(self.predictor.camera, max(nearest, 0.1))

    def contributions(
        self,
        T: RigidTransform,
        poses: Sequence[RigidTransform],
        *,
        surely: bool = True,
        is_shot: bool = False,
        to_choose: bool = True,
        found: BoolArray | None = None,  # (n_images, n_legs) legs whose outlines count
    ) -> Contributions | None:
        """Return the information of images at poses T_Rb_Re; None if they show nothing.

        To choose some of them, or of a fit to all. An image without the board has no information,
        unless it exists already.
        """
        seen, n = self.seen(T, poses, surely=surely), len(poses)
        with_board = is_shot or self.board_is_shown(T, poses, surely=surely)
        if not len(seen.leg) or not np.any(with_board):
            return None
        predictor = self.predictor
        outlines = predicted_outlines(seen, np.arange(n, dtype=np.intp))
        if found is not None:
            outlines = outlines.choose(found[outlines.row, outlines.leg])
        view, views = np.zeros(n, dtype=np.intp), {"here": T}
        if self.hand_held and not to_choose:
            view, views = np.arange(n), {f"here{k}": T for k in range(n)}
        laid = None if to_choose else self.laid
        added = predictor.contributions(
            views,
            view,
            poses,
            outlines,
            self.legs,
            board=None if laid is None else (laid.board, laid.T_base_board),
            hand_held=self.hand_held,
            to_choose=to_choose,
        )
        if self.board is not None:
            added = added.tied_by_board({"here": T}) if to_choose else added
            added = replace(added, rows=added.rows * np.reshape(with_board, (-1, 1, 1)))
        if self.hand_held and to_choose:  # one series of images of one camera
            added = replace(added, names=tuple(n.replace("here: ", "hand ") for n in added.names))
        return added

    def of(self, candidates: Candidates, *, is_shot: bool = False) -> Contributions | None:
        """Return the information of the images of candidates."""
        poses = platforms_in_base(self.machine, candidates.poses.poses)
        return self.contributions(candidates.place.T_base_camera, poses, is_shot=is_shot)


@lru_cache(maxsize=2)  # places are compared by the same poses
def _bodies(machine: Machine, legs: tuple[Leg, ...], poses: tuple[RigidTransform, ...]) -> Bodies:
    """Return :meth:`Task.bodies`."""
    R, t = components(poses)
    base, occluders = machine.T_base_Rb, machine.occluders
    return Bodies.at(legs, R, t, machine.size, T_base_Rb=base, occluders=occluders)


def plan_session(
    task: Task,
    progress: Report = no_progress,
    run: Run = in_turn,
) -> Plan:
    """Plan a session.

    The search uses the nominal machine and nominal camera places. A round of local search is kept
    if the mean over random machines and tripods within tolerance improves. Information of places
    and these draws are computed by *run*; the plan does not depend on it.

    Raises DidNotConverge, NotVisible or NotIdentifiable if there are no poses, no places, or too
    few images.
    """
    machine, legs, rng = task.machine, task.predictor.legs, np.random.default_rng(task.seed)
    n_poses = min(MOST_POSES, MIN_POSES + POSES_EACH * task.n_images)
    poses = candidate_poses(machine, legs, task.setting, n_poses, rng, progress)
    task = _with_laid_board(task, poses)
    shown = _visible_places(task, _places(task, poses), poses, rng, progress, run)
    before = [task.of(candidates, is_shot=True) for candidates in task.given]
    work, basis = workspace_of(machine, legs), shown[0][1].basis
    search = _Search(
        task,
        [contributions for contributions in before if contributions is not None],
        work,
        basis,
        criterion_of(work, legs, basis),
        rng,
        progress,
        run,
    )
    current, least, value = search.chosen(shown, poses)
    target = _framed(task, poses)
    middle = 0.5 * (target.min(axis=0) + target.max(axis=0))
    expected = search.expected_covariance(current)
    for turn in range(ROUNDS):
        step = 0.5**turn
        placed = search.improve_positions(current, step, middle)
        polished, reached = search.improve_poses(placed, step, least)
        polished_covariance = search.expected_covariance(polished)
        if search.value_of(polished_covariance) < search.value_of(expected):
            current, value, expected = polished, reached, polished_covariance
        progress("Polishing", turn + 1, ROUNDS)
    return search.judged(current, value, expected)


def _places(task: Task, poses: Configurations) -> list[Place]:
    points = _framed(task, poses)
    return places_around(task.machine, points, task.predictor.camera, task.setting, task.bounds)


def _framed(task: Task, poses: Configurations) -> Array:
    """Points to frame in pictures, (n, 3) in the base link [m]: joints, and the board."""
    points = all_points(task.machine, poses.poses)
    return points if task.laid is None else np.concatenate([points, task.laid.corners])


def _with_laid_board(task: Task, poses: Configurations) -> Task:
    """Place the board where most camera places see it.

    Raises NotVisible if none does.
    """
    if task.board is None:
        return task
    probes = np.linspace(0, len(poses.poses) - 1, min(N_BOARD_PROBES, len(poses.poses))).astype(int)
    in_Rb = platforms_in_base(task.machine, [poses.poses[i] for i in probes])
    places = [place.T_base_camera for place in _places(task, poses)]
    # Cameras can move back until the board is in the picture.
    points = all_points(task.machine, poses.poses)
    middle = 0.5 * (points.min(axis=0) + points.max(axis=0))
    directions = np.array([T.translation - middle for T in places])
    directions = np.unique(
        (directions / np.linalg.norm(directions, axis=1)[:, None]).round(6), axis=0
    )
    directions *= FAR * float(np.linalg.norm(np.ptp(points, axis=0)))
    places = [look_at(middle + step, middle) for step in directions]
    best, most = task, 0.0
    for laid in lying(task.board, task.machine):
        trial = replace(task, laid=laid)
        is_shown = [trial.board_is_shown(T, in_Rb, surely=False, is_read=False) for T in places]
        share = np.mean(is_shown)
        if share > most:
            best, most = trial, float(share)
    if not most:
        raise NotVisible(
            f"{task.machine.yaml_path}: no session could be planned: no camera sees the board flat "
            "on the base, at any place beside or between the legs; "
            "use another board, wider --bounds, or a camera with a wider view."
        )
    return best


def _visible_places(
    task: Task,
    places: Sequence[Place],
    poses: Configurations,
    rng: np.random.Generator,
    progress: Report,
    run: Run,
) -> list[tuple[Place, Contributions]]:
    """Return the camera places that see legs, with the information of a few poses."""
    visible, blind = [], []
    probes = np.sort(rng.permutation(len(poses.poses))[:N_PROBES]).tolist()
    in_Rb = platforms_in_base(task.machine, [poses.poses[i] for i in probes])
    contributions_of_places = run(
        partial(task.contributions, poses=in_Rb), [place.T_base_camera for place in places]
    )
    for k, (place, contributions) in enumerate(zip(places, contributions_of_places, strict=True)):
        if contributions is None:
            blind.append(place)
        else:
            visible.append((place, contributions))
        progress("Camera places", k + 1, len(places))
    if visible:
        return visible
    remedy = (
        "use a camera that shows 30 px of a leg from there, or correct what hides the legs in the "
        "model"
    )
    if task.board is not None:
        remedy = "use a board with larger squares, or a smaller one that is whole in the image"
    if task.bounds is not None:
        remedy = f"widen --bounds, or {remedy}"
    asked = blind[:: len(blind) // _N_ASKED + 1]
    if narrow := task.too_narrow([Candidates(place, poses) for place in asked]):
        remedy = f"{narrow}: {_FINER}"
    raise NotVisible(
        f"{task.machine.yaml_path}: no session could be planned: none of {len(places)} camera "
        f"positions sees legs{' and the board' * (task.board is not None)} with the tripod "
        f"tolerance of {1e2 * task.setting.shift:.2g} cm and {np.degrees(task.setting.turn):g} "
        f"deg; {remedy}."
    )


def choose_places(
    shown: Sequence[Contributions],
    n_views: int,
    n_images: int,
    criterion: Criterion,
    given: Sequence[Contributions] = (),
) -> list[int]:
    """Select the places whose images, on average, determine the machine best jointly."""
    shares = [*(n_images / n_views / len(place.rows) for place in shown), *(1.0 for _ in given)]
    parts = [
        replace(part, rows=np.sqrt(share) * part.rows).of_shared()
        for part, share in zip((*shown, *given), shares, strict=True)
    ]
    columns, prior = joined(parts)
    information = np.zeros((len(parts), *prior.shape))
    for of_part, part, at in zip(information, parts, columns, strict=True):
        of_part[np.ix_(at, at)] = part.rows[0].T @ part.rows[0]
    p, free_places = shown[0].basis.shape[1], information[: len(shown)]
    base = prior + information[len(shown) :].sum(axis=0)

    def values(others: Sequence[int]) -> Array:
        inverse = np.linalg.inv(base + free_places[list(others)].sum(axis=0) + free_places)
        criteria = criterion(np.asarray(inverse[:, :p, :p], dtype=np.float64))
        if n_views <= len(free_places):
            criteria[list(others)] = np.inf
        return criteria

    chosen: list[int] = []
    while len(chosen) < n_views:
        chosen.append(int(np.argmin(values(chosen))))
    while True:
        before = list(chosen)
        for i in range(n_views):
            others = chosen[:i] + chosen[i + 1 :]
            criteria = values(others)
            if criteria.min() < criteria[chosen[i]]:
                chosen[i] = int(np.argmin(criteria))
        if chosen == before:
            return chosen


def _selected_candidates(current: Sequence[Candidates], images: Chosen) -> list[Candidates]:
    """Return the selected poses by place; places without any are dropped."""
    images_of_slot = [[k for s, k in images.images if s == v] for v in range(len(current))]
    return [
        replace(candidates, poses=candidates.poses.chosen(which))
        for candidates, which in zip(current, images_of_slot, strict=True)
        if which
    ]


@dataclass(frozen=True, eq=False)
class _Search:
    task: Task  # with the nominal machine
    given: Sequence[Contributions]  # of existing images
    work: Workspace | None  # None if readings do not determine the pose
    basis: Array  # of the coordinates of the machine
    criterion: Criterion
    rng: np.random.Generator
    progress: Report
    run: Run

    def added(self, candidates: Sequence[Candidates]) -> list[Contributions]:
        """Return the information of candidates, all of which see legs."""
        return [one for one in self.run(self.task.of, candidates) if one is not None]

    def value(self, slots: Sequence[Contributions]) -> float:
        """Return the criterion with all images of all slots."""
        return float(self.criterion(Session([], [*slots, *self.given]).machine[None])[0])

    def chosen(
        self, shown: Sequence[tuple[Place, Contributions]], poses: Configurations
    ) -> tuple[list[Candidates], int, float]:
        """Select the first places and poses; return the least images of each, and the criterion.

        Raises NotVisible or NotIdentifiable if the images are too few.
        """
        task, machine = self.task, self.task.machine
        n_places = min(N_HANDS, len(shown)) if task.hand_held else task.n_views
        contributions = [contributions for _, contributions in shown]
        chosen = choose_places(contributions, n_places, task.n_images, self.criterion, self.given)
        current = [self.task.showing(Candidates(shown[i][0], poses)) for i in chosen]
        count = [len(candidates.poses.poses) for candidates in current]
        if sum(count) < task.n_images:
            raise NotVisible(
                f"{machine.yaml_path}: no session could be planned: only {sum(count)} images from "
                f"{len(current)} camera positions show legs and the board, {task.n_images} are "
                "needed; plan fewer --images, more --cameras, or a board of another size."
            )
        least = 0 if task.hand_held else max(1, int(MIN_SHARE * task.n_images / task.n_views))
        least = min([least, *count])
        session = Session(self.added(current), self.given)
        images = choose(
            session, task.n_images, self.criterion, self.rng, least, progress=self.progress
        )
        images = exchange(session, images, self.criterion, self.rng, least, progress=self.progress)
        self._refuse_undetermined(session, current)
        return _selected_candidates(current, images), least, images.value

    def _refuse_undetermined(self, session: Session, current: Sequence[Candidates]) -> None:
        """Refuse a session that does not improve the model; state a sufficient number of images."""
        task, work, basis = self.task, self.work, self.basis
        limit = max(task.setting.length, _MIN_ERROR_LIMIT * task.machine.size)

        def error_of(S: Array) -> Array:
            """Error of the platform, or the criterion if readings do not determine its pose."""
            if work is None:
                return self.criterion(S)
            errors = [
                work.error(basis @ covariance @ basis.T).mean_displacement for covariance in S
            ]
            return np.array(errors)

        if float(error_of(session.machine[None])[0]) < limit:
            return
        more = choose(
            Session(session.slots, self.given),
            _MOST_NEEDED,
            error_of,
            np.random.default_rng(task.seed),
            0,
            is_enough=lambda error: error < limit,
        )
        n = max(len(more.images), task.n_images + 1)
        places = f"{task.n_views} camera position{'s' * (task.n_views != 1)}"
        remedy = (
            f"give --images {n} or more"
            if more.value < limit
            else "plan more --cameras, or --board"
        )
        needed = f"{f'at least {n} images' if more.value < limit else 'more positions'} are needed"
        if narrow := task.too_narrow(current):
            needed, remedy = narrow, _FINER
        raise NotIdentifiable(
            f"{task.machine.yaml_path}: no session could be planned: {task.n_images} "
            f"image{'s' * (task.n_images != 1)} from {places} would not improve on the nominal "
            f"model; {needed}; {remedy}."
        )

    def improve_positions(
        self, current: Sequence[Candidates], step: float, target: Array
    ) -> list[Candidates]:
        """Local search over camera places, poses unchanged."""
        current, contributions = list(current), self.added(current)
        value = self.value(contributions)
        for v, candidates in enumerate(current):
            for _ in range(N_NEAR_PLACES):
                place = near(current[v].place, target, PLACE_STEP * step, self.rng)
                trial = replace(candidates, place=place)
                added = self.task.of(trial) if place.is_inside(self.task.bounds) else None
                if added is None or self.task.showing(trial) is not trial:
                    continue
                trial_value = self.value([*contributions[:v], added, *contributions[v + 1 :]])
                if trial_value < value:
                    current[v], contributions[v], value = trial, added, trial_value
        return current

    def improve_poses(
        self, current: Sequence[Candidates], step: float, least: int
    ) -> tuple[list[Candidates], float]:
        """Exchange poses with poses nearby; also return the criterion."""
        task, spread = self.task, POSE_STEP * step
        widened = []
        for candidates in current:
            poses, legs = candidates.poses, task.predictor.legs
            poses = poses_near(task.machine, legs, task.setting, poses, spread, self.rng)
            widened.append(self.task.showing(replace(candidates, poses=poses)))
        session = Session(self.added(widened), self.given)
        images = [
            (v, k)
            for v, candidates in enumerate(current)
            for k in range(len(candidates.poses.poses))
        ]
        for slot, image in images:
            session.changed(slot, image, 1.0)
        session.renewed()
        exchanged = exchange(session, Chosen(images), self.criterion, self.rng, least)
        return _selected_candidates(widened, exchanged), exchanged.value

    def value_of(self, covariance: Array) -> float:
        """Return the criterion of a covariance (p, p) of the parameters."""
        inverse = np.linalg.pinv(self.basis)
        return float(self.criterion((inverse @ covariance @ inverse.T)[None])[0])

    def expected_covariance(self, current: Sequence[Candidates]) -> Array:
        """Return the mean covariance (p, p) of the parameters over random sessions."""
        n, covariances = self.task.setting.draws, []
        rngs = np.random.default_rng(self.task.seed + 1).spawn(n)
        for drawn in self.run(partial(drawn_covariance, self.task, current), rngs):
            covariances.append(drawn)
            self.progress("Draws", len(covariances), n)
        return np.asarray(np.mean(covariances, axis=0))

    def judged(self, current: Sequence[Candidates], value: float, covariance: Array) -> Plan:
        """Assemble the plan with the expected *covariance* (p, p) of the parameters."""
        task, predictor, machine = self.task, self.task.predictor, self.task.machine
        contributions = self.added(current)
        ordered, begin = list[Configurations](), machine.home_configuration
        for candidates in current:
            ordered.append(
                candidates.poses.chosen(shortest_order(machine, candidates.poses, begin))
            )
            begin = ordered[-1].configurations[-1]
        via, blocked = ways(machine, np.concatenate([poses.configurations for poses in ordered]))
        views, n_done = [], 0
        for candidates, poses in zip(current, ordered, strict=True):
            via_of_view = via[n_done : n_done + len(poses.poses)]
            n_done += len(poses.poses)
            T, in_Rb = candidates.place.T_base_camera, platforms_in_base(machine, poses.poses)
            seen = self.task.seen(T, in_Rb, surely=False)
            views.append(PlannedView(candidates.place.name, T, poses, via_of_view, seen))
        notes = []
        if blocked:
            notes.append(
                f"No collision-free path was found to {blocked} of the poses, not even through "
                "home: move the machine there manually, away from singularities and collisions."
            )
        if not machine.is_determined:
            notes.append(f"Readings do not determine the pose: {machine.undetermined}.")
        parts = predicted_sigmas(predictor.legs, predictor.choices, covariance)
        notes += sigmas_in_words(parts)
        covariance = written_covariance(machine, predictor.legs, predictor.choices, covariance)
        parametrization = predictor.legs.parametrization
        sigma = np.sqrt(np.maximum(np.diagonal(covariance), 0.0))
        return Plan(
            machine=machine,
            camera=predictor.camera,
            setting=task.setting,
            noise=predictor.noise,
            sigma_q=predictor.sigma_q,
            views=_named(views, task),
            value=value,
            error=None if self.work is None else self.work.error(covariance),
            sigma=sigma,
            names=parametrization.names,
            units=parametrization.units,
            growth=self._growth(contributions),
            seed=task.seed,
            board=task.laid,
            hand_held=task.hand_held,
            given=task.given_name,
            n_given=task.n_given,
            notes=tuple(notes),
            parts=parts,
            only=predictor.choices.only,
        )

    def _growth(self, contributions: Sequence[Contributions]) -> Array:
        """Numbers of images and their criterion, (n, 2), extrapolated beyond the plan."""
        n = sum(len(part.rows) for part in contributions)
        session = Session(contributions, self.given)
        order = choose(session, n, self.criterion, np.random.default_rng(0), 0)
        rows = [(k + 1.0, value) for k, value in enumerate(order.history)]
        for times in _EXTRAPOLATED:
            more = [part.repeated(times) for part in contributions]
            rows.append((round(times * n), self.value(more)))
        return np.array(rows)


def _named(views: Sequence[PlannedView], task: Task) -> tuple[PlannedView, ...]:
    """Name views by number; hand-held images after their pose."""
    if task.hand_held:
        views = [
            replace(view, poses=view.poses.chosen([k]), via=(view.via[k],), seen=view.seen.only(k))
            for view in views
            for k in range(len(view.poses.poses))
        ]
        labels = pose_labels(len(views), task.n_given)
        return tuple(replace(view, name=label) for view, label in zip(views, labels, strict=True))
    taken = {one.place.name for one in task.given}
    free = (f"c{k}" for k in range(1, 10**6) if f"c{k}" not in taken)
    return tuple(replace(view, name=next(free)) for view in views)


def drawn_covariance(task: Task, current: Sequence[Candidates], rng: np.random.Generator) -> Array:
    """Return the covariance (p, p) of the parameters in a random session within tolerance."""
    scene = replace(task, drawn=drawn_legs(task.predictor.legs, task.setting, rng))
    machine, parts, every_pose = task.machine, [], list[RigidTransform]()
    for candidates, is_set in (*((c, False) for c in current), *((c, True) for c in task.given)):
        nearby = platforms_in_base(machine, candidates.poses.poses)
        poses: Sequence[RigidTransform] = nearby
        if machine.is_determined:
            poses = poses_at_readings(machine, scene.legs, candidates.poses.readings, nearby)
        T = candidates.place.T_base_camera
        T = T if is_set else task.setting.perturbed_camera(T, rng)
        added = scene.contributions(T, poses, surely=False, is_shot=is_set, to_choose=False)
        if added is not None:
            parts.append(added)
            every_pose += poses
    return fitted_covariance(parts, task.predictor.legs, every_pose, machine.size)
