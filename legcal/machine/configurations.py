"""Random and given poses: closed configurations within the travel, in the assembly mode of home.

If the motors determine the pose, their readings are drawn and followed from home. Not all legs can
be at the ends of a long travel at the same time: readings that are not reached are drawn again,
nearer to home. If motors do not determine the pose, configurations come from a random walk on the
manifold of closed configurations. :func:`random_poses` samples the workspace, many poses at once;
:func:`feasible_poses` is for poses that a machine takes: inside the limits of all joints, without
collisions, and away from singularities on the way, too (:class:`Feasibility`).
"""

import math
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from enum import StrEnum
from functools import lru_cache
from itertools import islice
from typing import NamedTuple, Self

import numpy as np
from scipy.spatial.transform import RigidTransform

from legcal.errors import DidNotConverge, ModelError, UsageError
from legcal.geometry.lines import segment_distance
from legcal.geometry.motions import motion_of
from legcal.geometry.types import Array, BoolArray
from legcal.machine.closing import LOOSE, free_motions, project, singularities, singularity
from legcal.machine.kinematics import follow, follow_poses
from legcal.machine.model import (
    B_at,
    Machine,
    joint_values,
    platform_pose,
    readings_at_poses,
    slider_columns,
    vectors_A_to_B,
)
from legcal.machine.redundancy import determining_readings
from legcal.progress import Report, no_progress

MAX_DRAWS = 40  # draws per configuration
SHARES = np.minimum(1.3 * 0.8 ** np.arange(MAX_DRAWS), 1.0)  # share of the travel for each draw
MIN_SINGULARITY = 0.1  # least singularity measure, relative to home: nobody works nearer to one
MIN_STEP = 1.0 / 16.0  # least step, relative to the way from home; harder draws are repeated
WALK = 6  # steps of the random walk between two configurations
STRIDE = 0.15  # size of a step of the random walk [rad], and relative to the leg length
TRAVEL_TOLERANCE = 1e-11  # tolerance of travel limits, relative to the larger one
WORKSPACE_POSES = 100  # sample of the workspace, for all reported errors over it
WORKSPACE_SEED = 20020721

JITTER = 0.12  # largest distance of extreme readings from an end, relative to the travel

_ANGLE_ROUNDING = 1e-9  # tolerance of joint limits [rad]

_MAX_DRAWS = 60  # draws per pose
_FULL_EXTREME, _FULL = 12, 2  # draws over the whole travel; the next ones are nearer to home
_NEARER = 0.85  # distance from home of a further draw, relative to the one before
_BEFORE_LAST = 6  # a pose starts so many draws before the last successful one (extremes at 0)
_WAY = (0.25, 0.5, 0.75, 1.0)  # fractions of the way from home checked for feasibility
_SHORTEST = 0.25  # least step within a fraction of the way; harder poses are dropped
_MAX_FAILED_POSES = 5  # consecutive failures before giving up


class Configurations(NamedTuple):
    """Closed configurations, their readings and poses.

    Attributes
    ----------
    configurations : (count, nq) array
        Joint values of the closed chain.
    readings : (count, n_legs) array
        Joint value of every leg [m], passive ones too; zero for legs of constant length.
    poses : list of RigidTransform
        T_base_platform.
    """

    configurations: Array
    readings: Array
    poses: list[RigidTransform]

    def chosen(self, which: Sequence[int]) -> Self:
        """Return some of them, in the order of their indices."""
        index = np.array(which, dtype=np.intp)
        poses = [self.poses[i] for i in which]
        return type(self)(self.configurations[index], self.readings[index], poses)


def random_configurations(
    mechanism: Machine, count: int, rng: np.random.Generator | int
) -> Configurations:
    """Return random closed configurations with every slider inside its travel.

    Readings of motors are uniform in the travel and followed from home without crossing a
    singularity or ending beside one; those that cannot be reached are drawn again, nearer and
    nearer to home. Where motors do not determine the pose, the mechanism takes a random walk.

    Parameters
    ----------
    mechanism : Machine
        The machine.
    count : int
        Number of configurations.
    rng : Generator or int
        Random generator, or its seed.

    Returns
    -------
    Configurations
        Arrays of configurations and readings, and a list of poses.

    Raises
    ------
    DidNotConverge
        If too few configurations are reached.
    """
    if count < 0:
        raise UsageError(
            f"Configurations could not be drawn: found {count}, needed 0 or more; correct it."
        )
    generator, configurations = np.random.default_rng(rng), list[Array]()
    if mechanism.is_determined:
        for q, _, _ in _sampled(mechanism, generator, lambda: count - len(configurations)):
            with suppress(DidNotConverge):  # joints of the chain do not turn so far
                configurations.append(follow(mechanism, mechanism.home_configuration, q))
    else:
        walk = _walk(
            mechanism,
            generator,
            lambda c: (
                not beyond_travel(mechanism, c).any()
                and bool(mechanism.may_move_to(platform_pose(mechanism, c).translation))
            ),
        )
        for configuration in islice(walk, count):
            if configuration is None:
                break
            configurations.append(configuration)
    _require(mechanism, count, len(configurations))
    return poses_at(mechanism, configurations)


def random_poses(
    machine: Machine, count: int, rng: np.random.Generator | int
) -> tuple[Array, list[RigidTransform]]:
    """Return readings and poses as :func:`random_configurations` does, at a tenth of the time.

    If the motors determine the pose the chain is not closed.

    Raises DidNotConverge as :func:`random_configurations`.
    """
    if not machine.is_determined:
        drawn = random_configurations(machine, count, rng)
        return drawn.readings, drawn.poses
    generator, readings, poses = np.random.default_rng(rng), list[Array](), list[RigidTransform]()
    for _, row, T in _sampled(machine, generator, lambda: count - len(poses)):
        readings.append(row)
        poses.append(motion_of(T[:, :3], T[:, 3]))
    _require(machine, count, len(poses))
    return np.array(readings).reshape(count, machine.n_legs), poses


def _require(machine: Machine, count: int, n_reached: int) -> None:
    """Raise DidNotConverge if too few poses are reached."""
    if n_reached == count:
        return
    remedy = f"check {machine.urdf.wording.home} and the limits of the sliders"
    if math.isfinite(machine.reach) or math.isfinite(machine.floor):
        remedy += ", and the reach and floor of the model"
    if machine.is_determined and singularity(machine, machine.home) < LOOSE:
        remedy = (
            "choose a home further from a singular pose, or joints that do not make the same "
            "figure on base and platform"
        )
    raise DidNotConverge(
        "random poses could not be drawn",
        f"{n_reached} of {count} inside the travel in {MAX_DRAWS} tries for each",
        "all",
        remedy,
        machine.yaml_path,
    )


@lru_cache(maxsize=2)  # shared by verdict and report of a calibration
def workspace(machine: Machine) -> tuple[Array, list[RigidTransform]]:
    """Return the readings and poses that sample the workspace, the same at every call.

    All errors over the workspace, predicted or between two models, are errors at these poses. They
    do not depend on the order of the legs.

    Raises DidNotConverge as :func:`random_configurations`.
    """
    names = sorted(machine.leg_names)
    ordered = machine.with_leg_order(names)
    readings, poses = random_poses(ordered, WORKSPACE_POSES, WORKSPACE_SEED)
    return readings[:, [names.index(name) for name in machine.leg_names]], poses


def _sampled(
    machine: Machine, generator: np.random.Generator, missing: Callable[[], int]
) -> Iterator[tuple[Array, Array, Array]]:
    """Yield readings of motors and of all legs, and poses (3, 4), until none is *missing*.

    Readings of motors that are drawn again are nearer to home.
    """
    for share in SHARES:
        if (count := missing()) == 0:
            return
        yield from _usable(machine, generator, count, share)


def _usable(
    machine: Machine, generator: np.random.Generator, count: int, share: float
) -> Iterator[tuple[Array, Array, Array]]:
    """Yield those of some draws that are usable, in a share of the travel about home."""
    motors = list(machine.motors)
    lower, upper = motor_travel(machine)
    home = machine.home_configuration[slider_columns(machine, motors)[0]]
    q = determining_readings(machine, generator.uniform(lower, upper, (count, len(motors))))
    if share < 1.0:
        q = np.clip(home + share * (q - home), lower, upper)
    poses, part = follow_poses(machine, machine.home, home, q, MIN_STEP)
    readings = readings_at_poses(machine, poses)
    readings[:, [not leg.has_value for leg in machine.legs]] = 0.0
    if not machine.is_redundant:
        read = [leg.is_motor for leg in machine.legs]
        readings[:, read] = machine.at_readings(q)[:, read]
    least = MIN_SINGULARITY * singularity(machine, machine.home)
    usable = (part == 1.0) & ~_outside(machine, readings).any(axis=1)
    usable &= singularities(machine, poses) >= least
    usable &= machine.may_move_to(poses[:, :, 3])
    for k in np.flatnonzero(usable):
        yield q[k], readings[k], poses[k]


def _walk(
    machine: Machine, generator: np.random.Generator, is_usable: Callable[[Array], bool]
) -> Iterator[Array | None]:
    """Yield usable configurations of a random walk on the closed chain; None after many others."""
    here = machine.home_configuration
    while True:
        for _ in range(MAX_DRAWS):
            there = random_walk(machine, here, generator)
            usable = is_usable(there)
            if usable or beyond_travel(machine, there).any():
                here = there  # walks never lead further outside the travel
            if usable:
                yield there
                break
        else:
            yield None


def random_walk(machine: Machine, here: Array, generator: np.random.Generator) -> Array:
    """Return a closed configuration a few steps away, no further outside the travel."""
    for _ in range(WALK):
        motions = free_motions(machine, here)
        weights = generator.normal(size=motions.shape[1]) / np.sqrt(max(motions.shape[1], 1))
        there = project(machine, machine.chain.integrate(here, STRIDE * motions @ weights))
        if there is None:
            continue
        if not np.any(beyond_travel(machine, there) & ~beyond_travel(machine, here)):
            here = there
    return here


def beyond_travel(machine: Machine, configuration: Array) -> BoolArray:
    """Return which legs are outside their travel, or flipped, (n_legs,)."""
    return _outside(machine, joint_values(machine, configuration))


def _outside(machine: Machine, values: Array) -> BoolArray:
    """Return which joint values (..., n_legs) are outside the travel of their leg."""
    lower, upper = np.array([leg.travel for leg in machine.legs]).T
    slack = TRAVEL_TOLERANCE * np.maximum(np.abs(lower), np.abs(upper))
    outside = (values < lower - slack) | (values > upper + slack)
    return np.asarray(outside | (machine.lengths_at(values) <= 0.0))


class Cause(StrEnum):
    """The kinds of obstacles between a machine and a pose."""

    LIMITS = "the limits of joints"
    LENGTHS = "legs that cannot have such lengths at the same time"
    SINGULARITY = "the mechanism near a singularity"
    COLLISION = "collisions of legs"


Obstacle = tuple[Cause, str]
"""A cause and its details in words."""

_REMEDIES = {
    Cause.LIMITS: "check legcal.home and the limits of the joints",
    Cause.LENGTHS: "check legcal.home and the travel of the motors",
    Cause.SINGULARITY: "check legcal.home, and choose one away from singularities",
    Cause.COLLISION: "check radii and ends of the cylinders of the legs in the model",
}


def motor_travel(machine: Machine) -> tuple[Array, Array]:
    """Return the lowest and the highest reading of the motors, (n_motors,) [m]."""
    lower, upper = np.array([machine.legs[j].travel for j in machine.motors]).reshape(-1, 2).T
    return lower, upper


def feasible_poses(
    machine: Machine,
    n_poses: int,
    rng: np.random.Generator,
    *,
    extreme: bool,  # every motor near an end of its travel
    progress: Report = no_progress,
) -> Configurations:
    """Return random feasible poses, each followed from home.

    Raises DidNotConverge if there are too few, and ModelError if home is beyond a limit.
    """
    obstacles: Counter[Obstacle] = Counter()
    feasibility = Feasibility(machine)

    def is_feasible(configuration: Array) -> bool:
        obstacle = feasibility.obstacle(configuration)
        if obstacle is not None:
            obstacles[obstacle] += 1
        return obstacle is None

    draws = (
        _followed(machine, rng, feasibility, obstacles, extreme=extreme)
        if machine.is_determined
        else _walk(machine, rng, is_feasible)
    )
    configurations: list[Array] = []
    failed = 0
    progress("Poses", 0, n_poses)
    while len(configurations) < n_poses and failed < _MAX_FAILED_POSES:
        configuration = next(draws)
        if configuration is None:
            failed += 1
        else:
            failed = 0
            configurations.append(configuration)
            progress("Poses", len(configurations), n_poses)
    if len(configurations) < n_poses:
        causes: Counter[Cause] = Counter()
        for (cause, _), count in obstacles.items():
            causes[cause] += count
        (main, _), *_others = causes.most_common()
        excluded = ", ".join(_counted(cause, n, obstacles) for cause, n in causes.most_common())
        raise DidNotConverge(
            f"{n_poses} poses could not be drawn",
            f"{len(configurations)} that the machine reaches in "
            f"{obstacles.total() + len(configurations)} draws, others excluded {excluded}",
            "all",
            _REMEDIES[main],
            machine.yaml_path,
        )
    return poses_at(machine, configurations)


def _counted(cause: Cause, n: int, obstacles: Counter[Obstacle]) -> str:
    """Return the number of draws that a cause excluded, with its most frequent details."""
    most = max((count, detail) for (reason, detail), count in obstacles.items() if reason is cause)
    detail = f" ({most[0]} times {most[1]})" if most[1] != cause else ""
    return f"{n} times by {cause}{detail}"


class Feasibility:
    """The feasibility of closed configurations: limits, singularities, collisions."""

    def __init__(self, machine: Machine) -> None:
        self._machine = machine
        limited = [
            (joint, joint.limits)
            for joint in machine.urdf.joints.values()
            if joint.type == "revolute" and joint.limits is not None
        ]
        self._revolutes = [joint.name for joint, _ in limited]
        self._columns = [machine.chain.q_index(name) for name in self._revolutes]
        self._limits = np.array([limits for _, limits in limited]).reshape(-1, 2)
        self._min_singularity = MIN_SINGULARITY * singularity(machine, machine.home)
        cylinders = [(j, c) for j, leg in enumerate(machine.legs) for c in leg.cylinders]
        self._leg = np.array([j for j, _ in cylinders], dtype=np.intp)
        self._ends = np.array([(c.start, c.end) for _, c in cylinders]).reshape(-1, 2)
        self._on_platform = np.array([c.side == "platform" for _, c in cylinders], dtype=np.bool_)
        radius = np.array([c.radius for _, c in cylinders])
        pairs = np.stack(np.triu_indices(len(cylinders), 1))
        self._pairs = pairs[:, self._leg[pairs[0]] != self._leg[pairs[1]]]
        self._clearance = radius[self._pairs].sum(axis=0)
        apart = ~self._touching(machine.home)  # cylinders that touch at home do so by design
        self._pairs, self._clearance = self._pairs[:, apart], self._clearance[apart]
        problem = self._beyond_limits(machine.home_configuration)
        if problem is not None:
            raise ModelError(
                "no pose could be drawn",
                f"{problem} at home",
                "every joint inside its limits there",
                f"correct the limits, or {machine.urdf.wording.correct_home}",
                machine.yaml_path,
            )

    def problem(self, configuration: Array, *, of_motors: bool = True) -> str | None:
        """Return the obstacle of an infeasible closed configuration in words, None if feasible.

        The travel of motors is checked only if *of_motors*.
        """
        obstacle = self.obstacle(configuration, of_motors=of_motors)
        return None if obstacle is None else obstacle[1]

    def obstacle(self, configuration: Array, *, of_motors: bool = True) -> Obstacle | None:
        """Return the obstacle of a closed configuration with its cause, None if feasible."""
        machine = self._machine
        outside = beyond_travel(machine, configuration)
        if not of_motors:
            outside[[leg.is_motor for leg in machine.legs]] = False
        beyond = np.flatnonzero(outside)
        if len(beyond):
            return Cause.LIMITS, f"leg '{machine.leg_names[beyond[0]]}' outside its travel"
        problem = self._beyond_limits(configuration)
        if problem is not None:
            return Cause.LIMITS, problem
        T = platform_pose(machine, configuration)
        if not machine.may_move_to(T.translation):
            return Cause.LIMITS, "the platform beyond the reach or floor of the model"
        if singularity(machine, T) < self._min_singularity:
            return Cause.SINGULARITY, Cause.SINGULARITY.value
        collision = self.collision(T)
        if collision is not None:
            first, second = collision
            return Cause.COLLISION, f"legs '{first}' and '{second}' collide"
        return None

    def led(self, here: Array, readings: Array, parts: Sequence[float]) -> Array | Obstacle:
        """Return the configuration at readings (n_motors,) after a straight path, or its obstacle.

        Feasibility is checked at the fractions *parts* of the path from configuration *here* (the
        last is 1).
        """
        first = here[slider_columns(self._machine, self._machine.motors)[0]]
        for part in parts:
            q = readings if part == 1.0 else first + part * (readings - first)
            try:
                here = follow(self._machine, here, q, min_step=_SHORTEST)
            except DidNotConverge:
                return Cause.LENGTHS, Cause.LENGTHS.value
            obstacle = self.obstacle(here, of_motors=part == 1.0)
            if obstacle is not None:
                return obstacle
        return here

    def collision(self, T_base_platform: RigidTransform) -> tuple[str, str] | None:
        """Return the names of the first two colliding legs at a pose, None if none collide."""
        touching = np.flatnonzero(self._touching(T_base_platform))
        if not len(touching):
            return None
        first, second = self._leg[self._pairs[:, touching[0]]]
        return self._machine.leg_names[first], self._machine.leg_names[second]

    def _touching(self, T_base_platform: RigidTransform) -> BoolArray:
        """Return which pairs of cylinders are closer than the sum of their radii."""
        vectors = vectors_A_to_B(self._machine, T_base_platform)
        lengths = np.linalg.norm(vectors, axis=1)
        u = (vectors / lengths[:, None])[self._leg]
        along = self._ends + np.where(self._on_platform, lengths[self._leg], 0.0)[:, None]
        B = B_at(self._machine, T_base_platform.as_matrix()[None])[0]
        start = (B - vectors)[self._leg] + along[:, :1] * u
        first, second = self._pairs
        span = np.diff(along, axis=1) * u
        distance = segment_distance(start[first], span[first], start[second], span[second])
        return np.asarray(distance < self._clearance)

    def _beyond_limits(self, configuration: Array) -> str | None:
        """Return the revolute joint outside its limits (modulo full turns) in words, or None."""
        lower, upper = self._limits.T
        angles = configuration[self._columns]
        above = np.mod(angles - lower + _ANGLE_ROUNDING, 2.0 * np.pi) - _ANGLE_ROUNDING
        beyond = np.flatnonzero(above > upper - lower + _ANGLE_ROUNDING)
        if not len(beyond):
            return None
        i = int(beyond[0])
        limits = f"{np.degrees(lower[i]):.1f} to {np.degrees(upper[i]):.1f} deg"
        return f"joint '{self._revolutes[i]}' outside its limits of {limits}"


def _followed(
    machine: Machine,
    rng: np.random.Generator,
    feasibility: Feasibility,
    obstacles: Counter[Obstacle],
    *,
    extreme: bool,
) -> Iterator[Array | None]:
    """Yield configurations followed from home to drawn readings; None after many failures.

    Each failed draw brings the next one nearer to home; the next pose begins a few draws before the
    last successful one.
    """
    home = machine.home_configuration[slider_columns(machine, machine.motors)[0]]
    lower, upper = motor_travel(machine)
    last = 0  # the draw of the last successful pose

    def drawn(shrink: float) -> Array:
        part = rng.random(len(home))
        if extreme:
            # 0 is the shortest, 1 the longest.
            part = np.asarray(np.abs(rng.integers(0, 2, len(home)) - JITTER * part))
        q = determining_readings(machine, (lower + part * (upper - lower))[None])[0]
        return np.asarray(q if shrink == 1.0 else np.clip(home + shrink * (q - home), lower, upper))

    while True:
        first = 0 if extreme else max(0, last - _BEFORE_LAST)
        for draw in range(first, first + _MAX_DRAWS):
            full = _FULL_EXTREME if extreme else _FULL
            readings = drawn(_NEARER ** max(0, draw + 1 - full))
            start = machine.home_configuration
            result = feasibility.led(start, readings, _WAY)
            if not isinstance(result, tuple):
                last = draw
                yield result
                break
            obstacles[result] += 1
        else:
            yield None


def poses_at(machine: Machine, configurations: Sequence[Array]) -> Configurations:
    """Return closed configurations with their readings and poses."""
    return Configurations(
        np.array(configurations).reshape(-1, machine.chain.nq),
        np.array([joint_values(machine, c) for c in configurations]).reshape(-1, machine.n_legs),
        [platform_pose(machine, c) for c in configurations],
    )
