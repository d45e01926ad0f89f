"""Random closed configurations within the travel, in the assembly mode of home.

If the motors determine the pose, their readings are drawn and followed from home. Not all legs can
be at the ends of a long travel at the same time: readings that are not reached are drawn again,
nearer to home after two failures. If motors do not determine the pose, configurations come from a
random walk on the manifold of closed configurations.
"""

from collections.abc import Iterator, Sequence
from copy import deepcopy
from functools import lru_cache
from typing import NamedTuple

import numpy as np
from scipy.linalg import qr
from scipy.spatial.transform import RigidTransform

from legcal.errors import DidNotConverge, Problem
from legcal.geometry.motions import motions_of
from legcal.geometry.types import Array, BoolArray
from legcal.machine.equations import PoseEquations, equations_at_readings, freedoms, pose_equations
from legcal.machine.kinematics import follow, follow_poses
from legcal.machine.leg import Leg
from legcal.machine.mobility import free_motions, project, singularities, singularity
from legcal.machine.model import (
    Machine,
    joint_values,
    platform_pose,
    readings_at_poses,
    slider_columns,
)
from legcal.machine.redundancy import determining_readings
from legcal.machine.rods import actuator_index, readings_of_rods
from legcal.machine.solved_poses import solve_poses
from legcal.machine.solver import RANK, poses_after

MAX_DRAWS = 40  # draws per configuration
SHARES = 1.3 * 0.8 ** np.arange(MAX_DRAWS)  # share of the travel for each draw, at most 1
MIN_SINGULARITY = 0.1  # least singularity measure, relative to home: nobody works nearer to one
MIN_STEP = 1.0 / 16.0  # least step, relative to the way from home; harder draws are repeated
WALK = 6  # steps of the random walk between two configurations
ON_THE_CHAIN = 7  # draws out of eight that are followed on the chain, where that is quick
MAX_FAILED = 20  # failures before the first configuration
STRIDE = 0.15  # size of a step of the random walk [rad], and relative to the leg length
TRAVEL_TOLERANCE = 1e-11  # tolerance of travel limits, relative to the larger one
WORKSPACE_POSES = 100  # sample of the workspace, for all reported errors over it
WORKSPACE_SEED = 20020721

# Random poses of legs without a chain, many at once.
PARTS = 5  # steps from home to a pose, so that no pose jumps to another assembly mode
STEPS, LAST_STEPS = 3, 9  # solver iterations per step, and in the last step
CLOSED = 1e-9  # residual of a closed pose, relative to the mean leg length
NEARLY_CLOSED = 1e-5  # the same for overdetermined readings, whose residual does not vanish
DEPENDENT = 1e-4  # singular value of equations below which they are dependent
SINGULAR = 0.05  # least smallest singular value, relative to home
FREE = 0.05  # motion along freedoms that no motor holds, relative to the mean leg length
ATTEMPTS = 12
SHRINKING = 0.6  # share of the travel of each attempt, relative to the one before
MIN_SHARE = 0.078  # least share of the travel
LOOSE = 0.01  # least hold of the platform by motors and joints, dimensionless


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
    generator = np.random.default_rng(rng)
    draw = _drawn if mechanism.is_determined else _wandered
    configurations = list(draw(mechanism, count, generator))
    _require(mechanism, count, len(configurations))
    return Configurations(
        np.array(configurations).reshape(count, mechanism.chain.nq),
        np.array([joint_values(mechanism, c) for c in configurations]).reshape(
            count, mechanism.n_legs
        ),
        [platform_pose(mechanism, c) for c in configurations],
    )


def random_poses(
    machine: Machine, count: int, rng: np.random.Generator | int
) -> tuple[Array, list[RigidTransform]]:
    """Return the readings and poses of :func:`random_configurations`, at a tenth of the time.

    If the motors determine the pose it is followed for many draws at once; the chain is closed only
    in doubtful cases.

    Raises
    ------
    DidNotConverge
        As :func:`random_configurations`.
    """
    if not machine.is_determined:
        drawn = random_configurations(machine, count, rng)
        return drawn.readings, drawn.poses
    pairs = list(_drawn_poses(machine, count, np.random.default_rng(rng)))
    _require(machine, count, len(pairs))
    if not pairs:
        return np.zeros((0, machine.n_legs)), []
    readings, poses = (np.array(part) for part in zip(*pairs, strict=True))
    return readings, list(motions_of(poses[:, :, :3], poses[:, :, 3]))


def _require(machine: Machine, count: int, n_found: int) -> None:
    if n_found < count:
        raise DidNotConverge(
            Problem(
                "random poses could not be drawn",
                f"{n_found} of {count} inside the travel in {MAX_DRAWS} tries for each",
                "all",
                f"check {machine.urdf.wording.home} and the limits of the sliders",
                str(machine.yaml_path),
            )
        )


@lru_cache(maxsize=2)  # shared by verdict and report of a calibration
def workspace(machine: Machine) -> tuple[Array, list[RigidTransform]]:
    """Return the readings and poses that sample the workspace, the same at every call.

    All errors over the workspace, predicted or between two models, are errors at these poses. They
    do not depend on the order of the legs.

    Raises
    ------
    DidNotConverge
        As :func:`random_configurations`.
    """
    names = sorted(machine.leg_names)
    ordered = machine.with_leg_order(names)
    readings, poses = random_poses(ordered, WORKSPACE_POSES, WORKSPACE_SEED)
    return readings[:, [names.index(name) for name in machine.leg_names]], poses


def _drawn(machine: Machine, count: int, generator: np.random.Generator) -> Iterator[Array]:
    """Yield configurations at random readings of the motors, followed from home."""
    drawn = 0
    for turn in range(count):
        if turn == MAX_FAILED and not drawn:
            return
        for tries, share in enumerate(SHARES):
            (q,) = _random_readings(machine, generator, [share])
            reached = _reached_on_the_chain(machine, q, tries)
            if reached is not None:
                drawn += 1
                yield reached
                break


def _drawn_poses(
    machine: Machine, count: int, generator: np.random.Generator
) -> Iterator[tuple[Array, Array]]:
    """Yield readings (n_legs,) and pose (3, 4) of the configurations of :func:`_drawn`.

    Draws are followed together as if none failed, which holds for most machines. With redundant
    motors many fail, because dependent motors leave their travel: then the draws of one share of
    the travel are followed together.
    """
    drawn = 0
    if machine.is_redundant:
        for share in SHARES:
            if drawn == count:
                return
            q = _random_readings(machine, generator, np.full(count - drawn, share))
            for readings, pose, is_reached in _reached(machine, q):
                drawn += is_reached
                if is_reached:
                    yield readings, pose
        return
    ahead = list[tuple[Array, Array, bool]]()
    for turn in range(count):
        if turn == MAX_FAILED and not drawn:
            return
        for tries, share in enumerate(SHARES):
            if not ahead:
                ahead += _reached(
                    machine, _random_readings(machine, deepcopy(generator), np.ones(count - turn))
                )
            (q,) = _random_readings(machine, generator, [share])
            readings, pose, is_reached = ahead.pop(0)
            if share < 1.0 or not is_reached:
                configuration = _reached_on_the_chain(machine, q, tries)
                if configuration is None:
                    continue
                readings = joint_values(machine, configuration)
                pose = platform_pose(machine, configuration).as_matrix()[:3]
            drawn += 1
            yield readings, pose
            break


def _random_readings(
    machine: Machine, generator: np.random.Generator, shares: Sequence[float] | Array
) -> Array:
    """Return random readings of the motors, each in a share of the travel about home."""
    motors = list(machine.motors)
    lower, upper = np.array([machine.legs[j].travel for j in motors]).T
    home = machine.home_configuration[slider_columns(machine, motors)[0]]
    q = determining_readings(machine, generator.uniform(lower, upper, (len(shares), len(motors))))
    share = np.asarray(shares)[:, None]
    return np.where(share < 1.0, np.clip(home + share * (q - home), lower, upper), q)


def _reached_on_the_chain(machine: Machine, q: Array, tries: int) -> Array | None:
    """Return the configuration at readings of the motors, None if it is not usable."""
    try:
        reached = follow(
            machine,
            machine.home_configuration,
            q,
            min_step=MIN_STEP,
            on_the_chain=tries % (ON_THE_CHAIN + 1) < ON_THE_CHAIN,
        )
    except DidNotConverge:  # the legs cannot have these lengths at the same time
        return None
    if beyond_travel(machine, reached).any():
        return None
    least = MIN_SINGULARITY * singularity(machine, machine.home)
    return reached if singularity(machine, platform_pose(machine, reached)) >= least else None


def _reached(machine: Machine, q: Array) -> Iterator[tuple[Array, Array, bool]]:
    """Yield readings of all legs, pose, and whether it is usable, at readings of the motors."""
    motors = list(machine.motors)
    home = machine.home_configuration[slider_columns(machine, motors)[0]]
    poses, part = follow_poses(machine, machine.home, home, q, MIN_STEP)
    readings = readings_at_poses(machine, poses)
    readings[:, [not leg.has_value for leg in machine.legs]] = 0.0
    if not machine.is_redundant:
        read = [leg.is_motor for leg in machine.legs]
        readings[:, read] = machine.at_readings(q)[:, read]
    least = MIN_SINGULARITY * singularity(machine, machine.home)
    usable = (part == 1.0) & ~_outside(machine, readings).any(axis=1)
    usable &= singularities(machine, poses) >= least
    return zip(readings, poses, usable.tolist(), strict=True)


def _wandered(machine: Machine, count: int, generator: np.random.Generator) -> Iterator[Array]:
    """Yield configurations of a random walk, every few steps, with sliders within their travel."""
    here = machine.home_configuration
    for _ in range(count):
        for _ in range(MAX_DRAWS):
            here = random_walk(machine, here, generator)
            if not beyond_travel(machine, here).any():
                yield here
                break


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


def random_postures_of_legs(
    legs: Sequence[Leg],
    frame_legs: Sequence[int],
    home: RigidTransform,
    travel: Array,
    count: int,
    rng: np.random.Generator,
) -> tuple[Array, Array]:
    """Return random poses (count, 3, 3) and (count, 3) [m] of R_e in R_b inside the travel.

    The legs are in R_b and R_e and need no file and no chain. *home* is T_Rb_Re near a closed pose
    of the assembly mode, *travel* (n_legs, 2) the shortest and longest length of each leg [m],
    equal for legs of constant length, or for rods on actuators the lowest and highest reading [m or
    rad].

    Raises
    ------
    DidNotConverge
        If the machine cannot move inside its travel.
    """
    start = solve_poses(legs, frame_legs, home.rotation.as_matrix()[None], home.translation[None])
    drive = _Drive(legs, frame_legs, start.R, start.t)
    at_home = drive.values(start.R, start.t)[0]
    rounding = NEARLY_CLOSED * float(drive.lengths(start.R, start.t).mean())
    slack = rounding + 0.05 * (travel[:, 1] - travel[:, 0])
    low = np.minimum(travel[:, 0], at_home) - slack  # home counts as inside
    high = np.maximum(travel[:, 1], at_home) + slack
    postures = start.R[:0], start.t[:0]
    share, tried, near_singular = 1.0, 0, 0
    for _ in range(ATTEMPTS):
        n = 2 * (count - len(postures[1])) + 10
        wanted = rng.uniform(travel[:, 0], travel[:, 1], (n, len(legs)))[:, drive.first]
        wanted = at_home + share * (wanted - at_home)
        R, t = drive.wandered(n, share, rng)
        first, good = drive.values(R, t), np.ones(n, dtype=np.bool_)
        for part in np.linspace(0.0, 1.0, PARTS + 1)[1:]:
            R, t = drive.closed(R, t, first + part * (wanted - first), STEPS)
            good &= drive.is_regular(R, t)
        tried, near_singular = tried + n, near_singular + int(np.sum(~good))
        R, t = drive.closed(R, t, wanted, LAST_STEPS)
        values = drive.values(R, t)
        good &= drive.is_closed(R, t, wanted) & np.all((values >= low) & (values <= high), axis=1)
        postures = np.concatenate([postures[0], R[good]]), np.concatenate([postures[1], t[good]])
        if len(postures[1]) >= count:
            return postures[0][:count], postures[1][:count]
        share = max(SHRINKING * share, MIN_SHARE)
    reached = f"found {len(postures[1])} of {count} random poses inside the travel"
    if 2 * near_singular > tried and drive.hold() < LOOSE:
        raise DidNotConverge(
            f"The observations could not be predicted: {reached}, needed all; most ways there come "
            "near a singular pose, in which motors and joints do not hold the platform: choose a "
            "home further from it, or joints that do not make the same figure on base and platform."
        )
    raise DidNotConverge(
        f"The observations could not be predicted: {reached}, needed all; check the travel (limit "
        "lower, upper) and the home pose of the model."
    )


class _Drive:
    """Legs whose motors draw their values at many poses; of redundant motors an independent subset.

    The subset determines best the freedoms that the constraints leave. The value of a leg is its
    length, or for a rod on an actuator the reading of the actuator.
    """

    def __init__(self, legs: Sequence[Leg], frame_legs: Sequence[int], R: Array, t: Array) -> None:
        self.legs, self.frame_legs, self.R, self.t = tuple(legs), frame_legs, R, t
        self.columns = list(freedoms(frame_legs))
        self.on = np.array(actuator_index(legs), dtype=np.intp)
        each = np.arange(len(legs))
        # The leg that holds the value: for rods on one actuator the first.
        self.first = np.array(
            [j if a < 0 else int(np.argmax(self.on == a)) for j, a in enumerate(self.on.tolist())]
        )
        self.zero = np.where(self.on < 0, [leg.q0 for leg in legs], 0.0)
        motors = [j for j in each.tolist() if legs[j].is_motor and self.first[j] == j]
        self.driven = np.array([], dtype=np.intp)
        constrained = self.slopes(R, t)[0]
        self.driven = np.array(motors, dtype=np.intp)
        unconstrained = self.slopes(R, t)[0]
        rank_all, rank_constrained = (
            int(np.linalg.matrix_rank(J, tol=DEPENDENT)) if J.size else 0
            for J in (unconstrained, constrained)
        )
        count = rank_all - rank_constrained
        if count < len(motors):
            size = np.where(np.array(self.columns) < 3, self.lengths(R, t).mean(), 1.0)
            equations = pose_equations(legs, R, t, by_local=False)
            rows = equations.by_pose[0][equations.measured][:, self.columns] / size
            left = np.eye(len(size)) - np.linalg.pinv(constrained / size, rcond=RANK) @ (
                constrained / size
            )
            order = qr((rows @ left).T, mode="r", pivoting=True)[1]
            self.driven = np.array([motors[k] for k in order[:count]], dtype=np.intp)

    def lengths(self, R: Array, t: Array) -> Array:
        """Return the leg lengths, (k, n_legs) [m]."""
        A, B = np.array([leg.A for leg in self.legs]), np.array([leg.B for leg in self.legs])
        lengths = np.linalg.norm(B @ np.swapaxes(R, 1, 2) + t[:, None] - A, axis=2)
        return np.asarray(np.where(self.on < 0, lengths, [leg.q0 for leg in self.legs]))

    def values(self, R: Array, t: Array) -> Array:
        """Return the values of legs, (k, n_legs) [m or rad]."""
        values = self.lengths(R, t)
        if self.on.max(initial=-1) >= 0:
            carried = self.on >= 0
            values[:, carried] = readings_of_rods(self.legs, R, t)[:, self.on[carried]]
        return values

    def lengthening(self, wanted: Array) -> Array:
        """Return s q, or q of actuators, at target values (k, n_legs) of driven motors, or NaN."""
        driven = np.isin(self.first, self.driven)
        return np.asarray(np.where(driven, wanted - self.zero, np.nan))

    def equations(self, R: Array, t: Array) -> PoseEquations:
        """Return the equations of poses: the constraints, and the lengths of driven motors."""
        equations = pose_equations(self.legs, R, t, by_local=False)
        return equations.of(~equations.measured | np.isin(equations.leg, self.driven))

    def slopes(self, R: Array, t: Array) -> Array:
        """Return the derivatives (k, m, f) of these equations by the possible motions."""
        return self.equations(R, t).by_pose[:, :, self.columns]

    def hold(self) -> float:
        """Return the hold of the platform by motors and joints at home; 0 if singular."""
        scale = np.where(np.array(self.columns) < 3, 1.0 / self.lengths(self.R, self.t).mean(), 1.0)
        slopes = self.slopes(self.R, self.t)[0] * scale
        return float(np.linalg.svd(slopes, compute_uv=False)[-1]) if slopes.size else 0.0

    def closed(self, R: Array, t: Array, wanted: Array, steps: int) -> tuple[Array, Array]:
        """Return poses nearer to target values (k, n_legs) of driven motors."""
        lengthening = self.lengthening(wanted)
        solution = solve_poses(self.legs, self.frame_legs, R, t, lengthening, steps)
        return solution.R, solution.t

    def wandered(self, n: int, share: float, rng: np.random.Generator) -> tuple[Array, Array]:
        """Return n poses near home, moved along the freedoms that no motor holds."""
        J = self.slopes(self.R, self.t)[0]
        left = np.eye(len(self.columns))
        if len(J):
            left -= np.linalg.pinv(J, rcond=1e-6) @ J
        scale = np.where(np.array(self.columns) < 3, 1.0, self.lengths(self.R, self.t).mean())
        step = np.zeros((n, 6))
        step[:, self.columns] = scale * (
            rng.normal(size=(n, len(self.columns))) * share * FREE @ left.T
        )
        pose = np.concatenate([self.R, self.t[..., None]], axis=2)
        poses = poses_after(np.repeat(pose, n, axis=0), step)
        return poses[:, :, :3], poses[:, :, 3]

    def is_closed(self, R: Array, t: Array, wanted: Array) -> BoolArray:
        """Return at which poses the equations of legs hold with the target values."""
        redundant = len(self.equations(R[:1], t[:1]).leg) > len(self.columns)
        limit = (NEARLY_CLOSED if redundant else CLOSED) * self.lengths(R, t).mean(axis=1)
        missed = equations_at_readings(self.legs, R, t, self.lengthening(wanted)).values
        return np.asarray(np.abs(missed).max(axis=1, initial=0.0) <= limit)

    def is_regular(self, R: Array, t: Array) -> BoolArray:
        """Return which poses are less singular than a share of home, and on the same side."""
        J, J0 = self.slopes(R, t), self.slopes(self.R, self.t)
        if J.shape[1] == 0:
            return np.ones(len(t), dtype=np.bool_)
        s, s0 = np.linalg.svd(J, compute_uv=False), np.linalg.svd(J0, compute_uv=False)[0]
        last = int(np.sum(s0 > 1e-6 * s0[0])) - 1
        good = s[:, last] > SINGULAR * s0[last]
        if J.shape[1] == J.shape[2]:
            good &= np.linalg.det(J) * np.linalg.det(J0) >= 0.0
        return np.asarray(good)
