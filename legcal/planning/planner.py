"""``legcal.plan``: from a machine to poses and camera places of a session, with what to expect.

:func:`plan` reads as the method: poses that the machine can take, places of cameras, places chosen
by what they show on average, images chosen greedily and exchanged, places and poses polished by
exchanges with others nearby, and the result judged by sessions as they will be, with
tripods and machine a little elsewhere.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from scipy.spatial.transform import RigidTransform

from legcal.brief import brief
from legcal.calibration import KINDS, FittedLegs, PlatformError, poses_at_readings
from legcal.errors import DidNotConverge, NotVisible
from legcal.estimation import Frames
from legcal.files import motion_to_xyz_quat
from legcal.geometry import Array, BoolArray
from legcal.machine import (
    Configurations,
    Feasibility,
    Leg,
    LegKind,
    Machine,
    feasible_poses,
    follow,
    motor_travel,
    moved_legs,
    platforms_in_base,
    poses_at,
    slider_columns,
)
from legcal.planning.exchange import Chosen, Criterion, Session, choose, exchange
from legcal.planning.goals import Goal, Workspace, criterion_of, workspace_of
from legcal.planning.information import Contributions, PredictedNoise, Predictor
from legcal.planning.order import in_short_order, ways
from legcal.planning.places import (
    USUAL,
    Place,
    Setting,
    all_points,
    near,
    places_around,
    upward,
)
from legcal.planning.sight import Seen, what_is_seen
from legcal.progress import Report, no_progress
from legcal.version import __version__
from legcal.vision import Camera

MIN_POSES, POSES_EACH, MOST_POSES = 20, 4, 240  # candidates, half of them extreme, by images
MIN_SHARE_REACHED = 0.2  # of these, that a machine reaches however far it is off
N_REACHING = 10  # machines that are tried in that
MOST_MOVED = 0.1  # of the length of a leg, by which poses then move
CLOSED = 1e-7  # [m]
N_PROBES = 12  # poses by which places are compared
MIN_SHARE = 0.5  # of its equal share that each view has of the images, at least
ROUNDS = 2  # of polishing
N_NEAR = 3  # poses near each that was chosen
POSE_STEP = 0.08  # of the travel
PLACE_STEP = 0.06  # of the distance
N_NEAR_PLACES = 8


@dataclass(frozen=True, eq=False)
class PlannedView:
    """A camera place and the images that are to be taken from it."""

    name: str
    T_base_camera: RigidTransform
    poses: Configurations  # in the order in which they are to be taken
    via: tuple[str, ...]  # where to go before each pose: "" straight there, else home or a pose
    shows: BoolArray  # (n_images, n_legs)


@brief
@dataclass(frozen=True, eq=False)
class Plan:
    """A planned session.

    Attributes
    ----------
    machine : Machine
        The nominal model.
    views : tuple of PlannedView
        Camera places, each with its poses.
    goal : Goal
        What was made small.
    value : float
        The criterion, as planned [m; a determinant without unit].
    error : PlatformError or None
        Expected error of the platform over the workspace, one standard deviation, as the root mean
        square over the draws.
    sigma : (p,) array
        Expected standard deviation of each kinematic parameter [m, rad].
    growth : (n,) array
        The criterion with 1, 2, ... images, in the order in which they help most.
    """

    machine: Machine
    camera: Camera
    setting: Setting
    noise: PredictedNoise
    sigma_q: float
    goal: Goal
    views: tuple[PlannedView, ...]
    value: float
    error: PlatformError | None
    sigma: Array
    names: tuple[str, ...]
    units: tuple[str, ...]
    growth: Array
    notes: tuple[str, ...] = field(default=())

    @property
    def n_images(self) -> int:
        """Number of photographs."""
        return sum(len(view.poses.poses) for view in self.views)

    def document(self) -> dict[str, Any]:
        """Return the document of ``legcal plan --json``, which ``self.json`` holds."""
        error = self.error
        return {
            "legcal_plan": 1,
            "legcal": __version__,
            "mechanism": self.machine.name,
            "images": self.n_images,
            "criterion": self.goal.value,
            "value": self.value,
            "expected": None
            if error is None
            else {
                "dX_m": error.mean_displacement,
                "dE_rad": error.mean_rotation,
                "dX_max_m": error.max_displacement,
                "dE_max_rad": error.max_rotation,
            },
            "tolerance": {
                "camera_m": self.setting.shift,
                "camera_rad": self.setting.turn,
                "machine_m": self.setting.length,
                "machine_rad": self.setting.angle,
                "draws": self.setting.draws,
            },
            "noise": {
                "sigma_px": self.noise.sigma_px,
                "correlation": self.noise.correlation,
                "common_px": dict(zip(KINDS, self.noise.common_px, strict=True)),
                "gamma_px": self.noise.gamma_px,
                "source": self.noise.source,
            },
            "views": {
                view.name: {
                    "T_base_camera": motion_to_xyz_quat(view.T_base_camera),
                    "images": len(view.poses.poses),
                    "legs": dict(
                        zip(self.machine.leg_names, view.shows.sum(axis=0).tolist(), strict=True)
                    ),
                }
                for view in self.views
            },
            "parameters": [
                {"name": name, "sigma": sigma, "unit": unit}
                for name, sigma, unit in zip(
                    self.names, self.sigma.tolist(), self.units, strict=True
                )
            ],
            "growth": [{"images": k + 1, "value": x} for k, x in enumerate(self.growth.tolist())],
            "notes": list(self.notes),
        }


@dataclass(frozen=True, eq=False)
class Scene:
    """The nominal machine, or one that is drawn, before cameras."""

    predictor: Predictor
    setting: Setting
    A: Array  # (n_legs, 3) in the base link
    legs: tuple[Leg, ...]  # in R_b and R_e

    @classmethod
    def nominal(cls, predictor: Predictor, setting: Setting) -> Scene:
        """Return the nominal machine."""
        return cls(predictor, setting, predictor.machine.A_base, predictor.legs.nominal)

    def seen(self, T: RigidTransform, poses: Sequence[RigidTransform], *, surely: bool) -> Seen:
        """Return what a camera sees at poses T_Rb_Re; *surely*: wherever the tripod is set."""
        machine, camera = self.predictor.machine, self.predictor.camera
        B_Re = np.array([leg.B for leg in self.legs])
        R, t = Frames.of(poses)
        in_Rb = np.swapaxes(R @ B_Re.T, 1, 2) + t[:, None]
        B = machine.T_base_Rb.apply(in_Rb.reshape(-1, 3)).reshape(in_Rb.shape)
        joints = np.concatenate([self.A, B.reshape(-1, 3)])
        depth = float(T.inv().apply(joints)[:, 2].min())
        margin = self.setting.margin(camera, max(depth, 0.1)) if surely else 0.0
        return what_is_seen(camera, T, self.A, B, [leg.cylinders for leg in machine.legs], margin)

    def contributions(
        self, T: RigidTransform, poses: Sequence[RigidTransform], *, surely: bool = True
    ) -> tuple[Contributions, BoolArray] | None:
        """Return what images of poses add and which legs they show; None if that is nothing."""
        seen = self.seen(T, poses, surely=surely)
        if not len(seen.leg):
            return None
        n = len(poses)
        outlines = seen.outlines(1.0, np.arange(n, dtype=np.intp))
        view = np.zeros(n, dtype=np.intp)
        found = self.predictor.contributions({"here": T}, view, poses, outlines, self.legs)
        return found, seen.legs_in(n, len(self.A))


def plan_session(
    predictor: Predictor,
    n_images: int,
    n_views: int,
    goal: Goal,
    *,
    named: Sequence[str] = (),
    setting: Setting = USUAL,
    bounds: Array | None = None,
    places: Sequence[Place] = (),
    seed: int = 0,
    progress: Report = no_progress,
    stop: Callable[[], bool] = lambda: False,
) -> Plan:
    """Return the plan of a session; see :mod:`legcal.planning`."""
    machine, rng = predictor.machine, np.random.default_rng(seed)
    n_poses = min(MOST_POSES, MIN_POSES + POSES_EACH * n_images)
    scene = Scene.nominal(predictor, setting)
    poses = candidate_poses(scene, n_poses, rng, progress)
    points = all_points(machine, poses.poses)
    every = list(places) or places_around(machine, points, predictor.camera, setting, bounds)
    in_Rb = platforms_in_base(machine, poses.poses)
    probes = np.sort(rng.permutation(len(in_Rb))[:N_PROBES])
    shown = []
    for k, place in enumerate(every):
        found = scene.contributions(place.T_base_camera, [in_Rb[i] for i in probes])
        if found is not None:
            shown.append((place, found[0]))
        progress("Camera places", k + 1, len(every))
    if not shown:
        raise NotVisible(
            f"{machine.yaml_path}: no session could be planned: found no leg in the picture from "
            f"any of {len(every)} camera places, needed legs at two of them at least; give other "
            "places or wider bounds."
        )
    work = workspace_of(machine, predictor.legs)
    criterion = criterion_of(goal, work, predictor.legs, shown[0][1].basis, named)
    chosen_places = choose_places([c for _, c in shown], n_views, n_images, criterion)
    views = [shown[i][0] for i in chosen_places]
    share = n_images / len(views)
    least, most = max(1, int(MIN_SHARE * share)), n_images
    slots = [_of(scene, place, in_Rb) for place in views]
    session = Session([c for c, _ in slots])
    chosen = choose(session, n_images, criterion, rng, least, most, progress=progress)
    chosen = exchange(session, chosen, criterion, rng, least, most, progress=progress)
    current = [
        _Candidates(place, _some(poses, [k for s, k in chosen.images if s == v]))
        for v, place in enumerate(views)
    ]
    value = chosen.value
    target = 0.5 * (points.min(axis=0) + points.max(axis=0))
    for turn in range(ROUNDS):
        if stop():
            break
        current, value = polished(
            scene, current, criterion, rng, turn, target, bounds, least, most, value
        )
        progress("Polishing", turn + 1, ROUNDS)
    progress("Polishing", ROUNDS, ROUNDS)
    return judged(scene, current, goal, criterion, work, value, rng, progress)


@dataclass(frozen=True, eq=False)
class _Candidates:
    """A place with poses."""

    place: Place
    poses: Configurations


def candidate_poses(
    scene: Scene, n: int, rng: np.random.Generator, progress: Report = no_progress
) -> Configurations:
    """Return poses that the machine can take, half of them extreme.

    Raises DidNotConverge if there are too few.
    """
    machine = scene.predictor.machine
    found: list[Array] = []
    for extreme in (True, False):
        drawn = feasible_poses(machine, n // 2, rng, extreme=extreme, progress=progress)
        kept = surely_reached(scene, drawn, np.random.default_rng(0))
        found += [drawn.configurations[k] for k in np.flatnonzero(kept)]
    if len(found) < MIN_SHARE_REACHED * n:
        raise DidNotConverge(
            f"{machine.yaml_path}: no session could be planned: found {len(found)} of {n} poses "
            f"that the machine reaches at the same readings if it is "
            f"{1e3 * scene.setting.length:g} mm off, needed more; check legcal.home and the limits "
            "of the joints, or state that the machine is known better."
        )
    return poses_at(machine, found)


def surely_reached(scene: Scene, poses: Configurations, rng: np.random.Generator) -> BoolArray:
    """Return which poses machines reach, at the same readings, that are as far off as they may be.

    Beside a singularity, or at the border of what legs can do, small errors decide that.
    """
    machine, legs = scene.predictor.machine, scene.predictor.legs
    reached = np.ones(len(poses.poses), dtype=np.bool_)
    if not machine.is_determined or not len(reached):
        return reached
    nearby = platforms_in_base(machine, poses.poses)
    measured = [j for j, leg in enumerate(machine.legs) if leg.kind is not LegKind.PASSIVE]
    t_nearby = Frames.of(nearby).t
    for _ in range(N_REACHING):
        drawn = drawn_legs(legs, scene.setting, rng)
        R, t = Frames.of(poses_at_readings(machine, drawn, poses.readings, nearby))
        ends = np.swapaxes(R @ np.array([leg.B for leg in drawn]).T, 1, 2) + t[:, None]
        length = np.linalg.norm(ends - np.array([leg.A for leg in drawn]), axis=2)
        wanted = machine.sign * poses.readings + [leg.q0 for leg in drawn]
        off = np.abs(length - wanted)[:, measured].max(axis=1)
        moved = np.linalg.norm(t - t_nearby, axis=1)
        reached &= (off < CLOSED) & (moved < MOST_MOVED * length.mean())
    return reached


def _some(poses: Configurations, which: Sequence[int]) -> Configurations:
    index = np.array(which, dtype=np.intp)
    return Configurations(
        poses.configurations[index], poses.readings[index], [poses.poses[i] for i in which]
    )


def _of(
    scene: Scene, place: Place, in_Rb: Sequence[RigidTransform]
) -> tuple[Contributions, BoolArray]:
    found = scene.contributions(place.T_base_camera, in_Rb)
    if found is None:
        raise NotVisible("a place sees nothing")
    return found


def choose_places(
    shown: Sequence[Contributions], n_views: int, n_images: int, criterion: Criterion
) -> list[int]:
    """Return the places whose images, on average, determine the machine best together."""
    names: dict[str, int] = {}
    for found in shown:
        for name in found.names:
            if ": " not in name:
                names.setdefault(name, len(names))
    shared = np.zeros((len(shown), len(names), len(names)))
    prior = np.zeros((len(names), len(names)))
    for k, found in enumerate(shown):
        is_own = np.array([": " in name for name in found.names])
        at = np.array([names[name] for name in found.names if ": " not in name])
        stacked = found.rows.reshape(-1, len(found.names))
        G = stacked.T @ stacked * (n_images / n_views / len(found.rows))
        own = G[np.ix_(is_own, is_own)] + found.prior[np.ix_(is_own, is_own)]
        mixed = G[np.ix_(is_own, ~is_own)]
        G = G[np.ix_(~is_own, ~is_own)] - mixed.T @ np.linalg.solve(own, mixed)
        shared[k][np.ix_(at, at)] = G
        prior[np.ix_(at, at)] = found.prior[np.ix_(~is_own, ~is_own)]
    p = shown[0].basis.shape[1]

    def values(base: Array) -> Array:
        return criterion(np.asarray(np.linalg.inv(base + shared)[:, :p, :p], dtype=np.float64))

    chosen: list[int] = []
    while len(chosen) < n_views:
        chosen.append(int(np.argmin(values(prior + shared[chosen].sum(axis=0)))))
    for _ in range(3):
        before = list(chosen)
        for i in range(n_views):
            others = chosen[:i] + chosen[i + 1 :]
            chosen[i] = int(np.argmin(values(prior + shared[others].sum(axis=0))))
        if chosen == before:
            break
    return chosen


def polished(
    scene: Scene,
    current: list[_Candidates],
    criterion: Criterion,
    rng: np.random.Generator,
    turn: int,
    target: Array,
    bounds: Array | None,
    least: int,
    most: int,
    value: float,
) -> tuple[list[_Candidates], float]:
    """Return places and poses after exchanges with others nearby."""
    machine, up = scene.predictor.machine, upward(scene.predictor.machine)
    step = 0.5**turn

    def parts(candidates: _Candidates) -> tuple[Contributions, BoolArray] | None:
        in_Rb = platforms_in_base(machine, candidates.poses.poses)
        return scene.contributions(candidates.place.T_base_camera, in_Rb)

    def all_in(found: Sequence[Contributions]) -> float:
        session = Session(found)
        for slot, part in zip(session.places, found, strict=True):
            stacked = part.rows.reshape(-1, part.rows.shape[2])
            session.information[np.ix_(slot, slot)] += stacked.T @ stacked
        session.renewed()
        return float(criterion(session.machine[None])[0])

    known = [found[0] for found in map(parts, current) if found is not None]
    for v, own in enumerate(current):
        for _ in range(N_NEAR_PLACES):
            place = near(own.place, target, up, PLACE_STEP * step, rng)
            if place is own.place:
                break
            trial = replace(own, place=place)
            found = parts(trial)
            if found is None:
                continue
            trial_value = all_in([*known[:v], found[0], *known[v + 1 :]])
            if trial_value < value:
                own, value = trial, trial_value
                current[v], known[v] = own, found[0]
    slots, widened = [], []
    for own in current:
        more = poses_near(scene, own.poses, POSE_STEP * step, rng)
        both = poses_at(machine, [*own.poses.configurations, *more])
        found = parts(replace(own, poses=both))
        assert found is not None
        slots.append(found[0])
        widened.append(both)
    session = Session(slots)
    images = [(v, k) for v, own in enumerate(current) for k in range(len(own.poses.poses))]
    for slot, image in images:
        session.changed(slot, image, 1.0)
    session.renewed()
    better = exchange(session, Chosen(images), criterion, rng, least, most)
    if better.value < value:
        value = better.value
        current = [
            replace(own, poses=_some(both, [k for s, k in better.images if s == v]))
            for v, (own, both) in enumerate(zip(current, widened, strict=True))
        ]
    return current, value


def poses_near(
    scene: Scene, poses: Configurations, step: float, rng: np.random.Generator
) -> list[Array]:
    """Return closed configurations a little beside poses, those that the machine can take."""
    machine = scene.predictor.machine
    feasibility = Feasibility(machine)
    columns = slider_columns(machine, machine.motors)[0]
    lower, upper = motor_travel(machine)
    found = []
    for configuration in poses.configurations:
        for _ in range(N_NEAR if machine.is_determined else 0):
            q = configuration[columns] + step * (upper - lower) * rng.normal(size=len(columns))
            try:
                there = follow(machine, configuration, np.clip(q, lower, upper), min_step=0.5)
            except DidNotConverge:
                continue
            if feasibility.problem(there, of_motors=False) is None:
                found.append(there)
    if not found:
        return found
    kept = surely_reached(scene, poses_at(machine, found), np.random.default_rng(0))
    return [found[k] for k in np.flatnonzero(kept)]


def judged(
    scene: Scene,
    current: Sequence[_Candidates],
    goal: Goal,
    criterion: Criterion,
    work: Workspace | None,
    value: float,
    rng: np.random.Generator,
    progress: Report,
) -> Plan:
    """Return the plan with what sessions as they will be are expected to give."""
    predictor, setting = scene.predictor, scene.setting
    machine, legs = predictor.machine, predictor.legs
    found = [
        scene.contributions(c.place.T_base_camera, platforms_in_base(machine, c.poses.poses))
        for c in current
    ]
    covariances = []
    for draw in range(setting.draws):
        covariances.append(drawn_covariance(scene, current, rng))
        progress("Draws", draw + 1, setting.draws)
    covariance = np.mean(covariances, axis=0)
    error = None if work is None else work.error(covariance)
    views, blocked = [], 0
    for v, (c, part) in enumerate(zip(current, found, strict=True)):
        assert part is not None
        in_order = in_short_order(machine, c.poses)
        poses = _some(c.poses, in_order)
        via, missing = ways(machine, poses)
        blocked += missing
        name = c.place.name or f"c{v + 1}"
        views.append(PlannedView(name, c.place.T_base_camera, poses, via, part[1][in_order]))
    notes = []
    if blocked:
        notes.append(
            f"No free way was found to {blocked} of the poses, not even by home: lead the machine "
            "there by hand, away from singularities and collisions."
        )
    session = Session([part[0] for part in found if part is not None])
    n = sum(len(c.poses.poses) for c in current)
    order = choose(session, n, criterion, np.random.default_rng(0), 0, n)
    return Plan(
        machine=machine,
        camera=predictor.camera,
        setting=setting,
        noise=predictor.noise,
        sigma_q=predictor.sigma_q,
        goal=goal,
        views=tuple(views),
        value=value,
        error=error,
        sigma=np.sqrt(np.diagonal(covariance)),
        names=legs.parametrization.names,
        units=legs.parametrization.units,
        growth=np.array(order.history),
        notes=tuple(notes),
    )


def drawn_covariance(
    scene: Scene, current: Sequence[_Candidates], rng: np.random.Generator
) -> Array:
    """Return the covariance (p, p) of the parameters in a session as it may be."""
    predictor, setting = scene.predictor, scene.setting
    machine, legs = predictor.machine, predictor.legs
    drawn = drawn_legs(legs, setting, rng)
    A = machine.T_base_Rb.apply(np.array([leg.A for leg in drawn]))
    there = Scene(predictor, setting, A, drawn)
    parts = []
    for own in current:
        nearby = platforms_in_base(machine, own.poses.poses)
        poses = poses_at_readings(machine, drawn, own.poses.readings, nearby)
        T = setting.camera_elsewhere(own.place.T_base_camera, rng)
        found = there.contributions(T, poses, surely=False)
        if found is not None:
            parts.append(found[0])
    session = Session([], parts)
    basis = parts[0].basis
    return np.asarray(basis @ session.machine @ basis.T)


def drawn_legs(legs: FittedLegs, setting: Setting, rng: np.random.Generator) -> tuple[Leg, ...]:
    """Return legs as they may be, within the prior errors of the machine."""
    found = legs.parametrization
    size = np.where([unit == "m" for unit in found.units], setting.length, setting.angle)
    size = size * np.array([not name.endswith(".twist") for name in found.names])
    return moved_legs(legs.nominal, found.place, size * rng.uniform(-1.0, 1.0, len(size)))
