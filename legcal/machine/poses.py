"""Random closed configurations inside the travel, in the assembly mode of home.

Where the motors determine the pose their readings are drawn and followed from home. Not all legs
can be at the ends of a long travel at the same time: what is not reached is drawn again, and
nearer to home after two draws in vain. Where motors do not determine the pose, home wanders on the
manifold of closed configurations.
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import RigidTransform

from legcal.errors import DidNotConverge
from legcal.geometry import Array, BoolArray, IntArray
from legcal.machine.closing import (
    CLOSED,
    close_at,
    close_near,
    free_motions,
    platform_pose,
    project,
    slider_columns,
)
from legcal.machine.equations import demands_at, is_constrained, leg_scale, moved
from legcal.machine.leg import LegKind
from legcal.machine.model import Mechanism


def singularity(mechanism: Mechanism, T_base_platform: RigidTransform) -> float:
    """Return the smallest singular value of the dimensionless Jacobian of the legs' equations.

    Rows are the lengths of actuated and constant legs and all other demands, counted at the end
    of their leg; columns are a rotation about the mean of the platform joints and a displacement.
    Lengths are measured in mean leg lengths at the pose, angles in radian, so that the number has
    no unit and does not depend on the size of the machine or on the frames of its links.

    Parameters
    ----------
    mechanism : Mechanism
        The machine.
    T_base_platform : RigidTransform
        A pose; its readings need not be inside the travel.

    Returns
    -------
    float
        Zero at a singular pose, and wherever the motors do not determine the pose; of the order
        of the platform's size in leg lengths at a good one.
    """
    jacobian = dimensionless(mechanism, T_base_platform)
    if len(jacobian) < 6:
        return 0.0
    return float(np.linalg.svd(jacobian, compute_uv=False)[5])


def side(mechanism: Mechanism, T_base_platform: RigidTransform) -> float:
    """Return the sign of the determinant of the legs' equations where they are square, else 0.

    Between two poses of different sign lies a singularity.
    """
    rows = dimensionless(mechanism, T_base_platform)
    return float(np.sign(np.linalg.det(rows))) if len(rows) == 6 else 0.0


def dimensionless(mechanism: Mechanism, T_base_platform: RigidTransform) -> Array:
    """Return the Jacobian of :func:`singularity`, (n_rows, 6): rotation, displacement."""
    if not is_constrained(mechanism):
        return _lines(mechanism, T_base_platform)
    demands = demands_at(mechanism, T_base_platform)
    scale = leg_scale(mechanism, T_base_platform)
    centre = T_base_platform.as_matrix()[:3, :3] @ mechanism.B_platform.mean(axis=0)
    gradient, moment = demands.jacobian[:, 3:], demands.jacobian[:, :3]
    return np.hstack([(moment - np.cross(centre, gradient)) / scale, gradient])


def _lines(mechanism: Mechanism, T_base_platform: RigidTransform) -> Array:
    """Return the same of the motors' legs alone, (n_motors, 6): there is nothing else to meet.

    The moments arm x u are written out: ``np.cross`` is slow on six rows.
    """
    motors = list(mechanism.motors)
    matrix = T_base_platform.as_matrix()
    turned = mechanism.B_platform @ matrix[:3, :3].T
    vectors = turned + matrix[:3, 3] - mechanism.A_base
    lengths = np.linalg.norm(vectors, axis=1)
    arms = (turned - turned.mean(axis=0))[motors] / lengths.mean()
    u = (vectors / lengths[:, None])[motors]
    (x, y, z), (a, b, c) = arms.T, u.T
    return np.stack([y * c - z * b, z * a - x * c, x * b - y * a, a, b, c], axis=1)


NEWTON_STEPS = 12
CONTRACTION = 0.5  # of the step before; of 1 rad or a leg length for the first
SURE = 0.5  # norm of J0^-1 J1 - 1 that leaves no room for a singularity between J0 and J1
MET = 1e-13  # of a leg length
RANK = 1e-9  # of the largest singular value


def walk(attempt: Callable[[float], bool], shortest: float, done: float = 0.0) -> float:
    """Walk from a part of a way to its end, in halved steps where one fails.

    Parameters
    ----------
    attempt : callable
        Tries to reach a part of the way from where the last attempt that succeeded ended.
    shortest : float
        The shortest step, as a part of the way.
    done : float
        Where to begin.

    Returns
    -------
    float
        The part of the way that is done, 1 where the end is reached.
    """
    step = 1.0 - done
    while done < 1.0:
        wanted = min(done + step, 1.0)
        if attempt(wanted):
            done, step = wanted, 2.0 * step
        else:
            step *= 0.5
            if step < shortest:
                break
    return done


def follow_pose(
    mechanism: Mechanism, T: RigidTransform, first: Array, last: Array, shortest: float
) -> tuple[RigidTransform, float]:
    """Return the pose that is followed from a known one, and which part of the way is done.

    Parameters
    ----------
    mechanism : Mechanism
        The machine.
    T : RigidTransform
        T_base_platform at the first readings.
    first, last : (n_motors,) array
        Readings of the motors [m].
    shortest : float
        The shortest part of the way that is tried.

    Returns
    -------
    RigidTransform
        T_base_platform where the way ends; at the last readings where all of it is done.
    float
        The part that is done.
    """
    here, known = T, dimensionless(mechanism, T)

    def attempt(part: float) -> bool:
        nonlocal here, known
        readings = last if part == 1.0 else first + part * (last - first)
        there = _newton(mechanism, here, readings)
        if there is None or _turned_over(mechanism, there):
            return False
        jacobian = dimensionless(mechanism, there)
        if not (hardly_changes(known, jacobian) or _same_side(known, jacobian)):
            return False
        here, known = there, jacobian
        return True

    done = walk(attempt, shortest)
    return here, done


def hardly_changes(known: Array, jacobian: Array) -> bool:
    """Say whether two Jacobians differ too little for one of smaller rank between them."""
    difference = jacobian - known
    if known.shape[0] == known.shape[1]:
        try:
            change = np.linalg.solve(known, difference)
        except np.linalg.LinAlgError:
            change = np.full_like(known, np.inf)
        if float(np.abs(change).sum(axis=1).max()) < SURE:
            return True
    left, values, right = np.linalg.svd(known, full_matrices=False)
    rank = int(np.sum(values > 1e-6 * values[0]))
    change = (left[:, :rank].T @ difference @ right[:rank].T) / values[:rank, None]
    return float(np.linalg.norm(change, 2)) < SURE


def _same_side(known: Array, jacobian: Array) -> bool:
    """Say whether two square Jacobians have determinants of the same sign."""
    if known.shape[0] != known.shape[1]:
        return False
    signs = [float(np.sign(np.linalg.det(J))) for J in (known, jacobian)]
    return signs[0] == signs[1] != 0.0


def _newton(mechanism: Mechanism, T: RigidTransform, readings: Array) -> RigidTransform | None:
    """Return the pose at readings by Newton; None where its steps do not contract."""
    motors = list(mechanism.motors)
    lengthening = mechanism.sign[motors] * readings
    scale = leg_scale(mechanism, T)
    weights = np.array([1.0 / scale] * 3 + [1.0] * 3)
    previous = scale
    for _ in range(NEWTON_STEPS):
        demands = demands_at(mechanism, T)
        values = demands.values.copy()
        values[demands.measured] -= lengthening
        change = np.linalg.lstsq(demands.jacobian * weights, values, rcond=RANK)[0]
        size = float(np.abs(change).max())
        if not size <= CONTRACTION * previous:
            return T if float(np.abs(values).max()) < MET * scale else None
        previous = size
        T = moved(T, -weights * change)
        if size < MET * scale:
            return T
    return None


def _turned_over(mechanism: Mechanism, T: RigidTransform) -> bool:
    """Say whether a leg that is fixed to the platform points the wrong way."""
    vectors = np.asarray(T.apply(mechanism.B_platform)) - mechanism.A_base
    return any(
        leg.platform_joint == ""
        and leg.platform_axis is not None
        and float(T.rotation.apply(leg.platform_axis) @ vector) <= 0.0
        for leg, vector in zip(mechanism.legs, vectors, strict=True)
    )


SHORTEST = 1.0 / 4096.0  # of the way from known readings to the wanted ones
FRESH = 6  # starts from other angles of all legs there
RESTARTS = 2  # of legs that do not close where the platform arrived


@dataclass(frozen=True, eq=False)
class _Reached:
    """Where Newton ended: the configuration, the linearised closures, and how the steps went."""

    configuration: Array
    jacobian: Array
    contracts: bool


def follow(
    mechanism: Mechanism,
    configuration: Array,
    readings: Array,
    which: str = "",
    shortest: float = SHORTEST,
    on_the_chain: bool = False,
) -> Array:
    """Return the closed configuration at readings, followed from a closed one.

    Parameters
    ----------
    mechanism : Mechanism
        The machine.
    configuration : (nq,) array
        A closed configuration.
    readings : (n_motors,) array
        The readings of the motors to reach [m].
    which : str
        Which readings they are, for the message.
    shortest : float
        The shortest part of the way that is tried.
    on_the_chain : bool
        Whether to stop where the joints of the chain stop Newton: soon, but in a place that
        depends on the spanning tree.

    Returns
    -------
    (nq,) array
        Closed to 1e-12 m, in the same assembly mode, no leg flipped.

    Raises
    ------
    DidNotConverge
        If the steps stop contracting or reach a singularity, even tiny ones.
    """
    q_columns, v_columns = slider_columns(mechanism, mechanism.motors)
    free = np.delete(np.arange(mechanism.chain.nv), v_columns)
    first = configuration[q_columns]
    known = mechanism.chain.linearize(configuration)[1][:, free]
    here: float | None = None

    def attempt(part: float) -> bool:
        nonlocal configuration, known, here
        trial = configuration.copy()
        trial[q_columns] = readings if part == 1.0 else first + part * (readings - first)
        reached = _newton_following(mechanism, trial, free)
        if not reached.contracts or _flipped(mechanism, reached.configuration):
            return False
        if not hardly_changes(known, reached.jacobian):
            if here is None:
                here = side(mechanism, platform_pose(mechanism, configuration))
            there = side(mechanism, platform_pose(mechanism, reached.configuration))
            if not here == there != 0.0:  # not square: only ways on which little changes
                return False
        configuration, known = reached.configuration, reached.jacobian
        return True

    done = walk(attempt, shortest)
    if done == 1.0:
        return configuration
    T = platform_pose(mechanism, configuration)
    part = 0.0
    if not on_the_chain:
        T, part = follow_pose(mechanism, T, configuration[q_columns], readings, shortest)
    if part < 1.0:
        raise DidNotConverge(
            f"{mechanism.yaml_path}: the pose at the readings{which} could not be reached: at "
            f"{100 * (done + part * (1.0 - done)):.1f} % of the way from the starting pose the "
            "legs meet no more or the mechanism is singular, needed a regular path; check the "
            "readings and legcal.home."
        )
    closed = _closed(mechanism, T, configuration, readings, free)
    if closed is None:
        raise DidNotConverge(
            f"{mechanism.yaml_path}: the pose at the readings{which} could not be reached: found a "
            "platform pose at which the legs have the right lengths, but joints that were not "
            "closed there, needed a closed chain; give the joints of the legs axes at right angles "
            "(of three revolutes, and of a universal joint and its leg), which turn anywhere, or "
            "cut spherical joints with 3d."
        )
    return closed


def follow_rows(
    mechanism: Mechanism, readings: Array
) -> Iterator[tuple[Array, DidNotConverge | None]]:
    """Yield the closed configuration at each of many readings, or the nearest that is known.

    Parameters
    ----------
    mechanism : Mechanism
        The machine.
    readings : (n_rows, n_motors) array
        Readings [m]; each row starts from the nearest one that is solved already, or from home.

    Yields
    ------
    configuration : (nq,) array
        At the readings of the row; where it started, if these are not reached.
    failure : DidNotConverge or None
        Why they are not.
    """
    known = [mechanism.home_configuration[slider_columns(mechanism, mechanism.motors)[0]]]
    configurations = [mechanism.home_configuration]
    for i, row in enumerate(readings):
        nearest = configurations[int(np.argmin(np.abs(np.array(known) - row).max(axis=1)))]
        try:
            configuration = follow(mechanism, nearest, row, f" of row {i + 1}")
        except DidNotConverge as failure:
            yield nearest, failure
            continue
        known.append(row)
        configurations.append(configuration)
        yield configuration, None


def _closed(
    mechanism: Mechanism, T: RigidTransform, start: Array, readings: Array, free: IntArray
) -> Array | None:
    """Return the closed configuration at readings whose pose is known, None if joints forbid it.

    The platform is let go only where axes that are a little off leave no other way.
    """
    rng = np.random.default_rng(1965)
    angles = mechanism.chain.rotation_columns()
    step = np.zeros((1 + FRESH, mechanism.chain.nv))
    step[1:, angles] = rng.uniform(-np.pi, np.pi, (FRESH, mechanism.chain.nv))[:, angles]
    closes = [close_at] * len(step) + [close_near] * is_constrained(mechanism)
    for close, turn in zip(closes, [*step, step[0]], strict=False):
        try:
            trial = close(mechanism, T, mechanism.chain.integrate(start, turn), RESTARTS)
        except DidNotConverge:
            continue
        trial[slider_columns(mechanism, mechanism.motors)[0]] = readings
        exact = _newton_following(mechanism, trial, free)
        if exact.contracts:
            return exact.configuration
    return None


def _newton_following(mechanism: Mechanism, configuration: Array, free: IntArray) -> _Reached:
    """Close the loops by Newton with the motors held, watching how its steps shrink."""
    chain = mechanism.chain
    step = np.zeros(chain.nv)
    previous = 1.0
    for _ in range(NEWTON_STEPS):
        residual, jacobian = chain.linearize(configuration)
        J = jacobian[:, free]
        worst = float(np.abs(residual).max())
        if worst < 0.01 * CLOSED:
            return _Reached(configuration, J, True)
        change = _solve(J, residual)
        size = float(np.abs(change).max())
        if size > CONTRACTION * previous:
            return _Reached(configuration, J, worst < CLOSED)
        previous = size
        step[free] = -change
        configuration = chain.integrate(configuration, step)
    residual, jacobian = chain.linearize(configuration)
    closed = float(np.abs(residual).max()) < CLOSED
    return _Reached(configuration, jacobian[:, free], closed)


def _solve(jacobian: Array, residual: Array) -> Array:
    """Return Newton's step; the shortest one where legs spin or closures depend on each other."""
    if jacobian.shape[0] == jacobian.shape[1]:
        try:
            change = np.linalg.solve(jacobian, residual)
        except np.linalg.LinAlgError:
            change = np.full(len(residual), np.inf)
        if np.abs(change).max() < 1.0:
            return np.asarray(change)
    return np.asarray(np.linalg.lstsq(jacobian, residual, rcond=1e-10)[0])


def _flipped(mechanism: Mechanism, configuration: Array) -> bool:
    """Say whether a leg without a motor has shrunk through its base joint."""
    legs = tuple(j for j, leg in enumerate(mechanism.legs) if leg.kind is LegKind.PASSIVE)
    if not legs:
        return False
    q = configuration[slider_columns(mechanism, legs)[0]]
    rows = list(legs)
    return bool(np.any(mechanism.sign[rows] * q + mechanism.q0[rows] <= 0.0))


TRIES = 40  # draws for each configuration
NEARER = 1.3 * 0.8 ** np.arange(TRIES)  # how far from home draws go, at most all of the way
REGULAR = 0.1  # of the singularity measure at home: nobody works nearer to a singularity
SHORTEST_configurations = 1.0 / 16.0  # of the way from home; what is harder to reach is drawn again
WALK = 6  # steps of a random walk between two configurations
ON_THE_CHAIN = 7  # draws of eight, where following is quick
HOPELESS = 20  # configurations in vain, if they are the first
STRIDE = 0.15  # [rad], and of a leg length
INSIDE = 1e-12  # [m]
WORKSPACE_POSES = 100  # that stand for the workspace wherever errors over it are told
WORKSPACE_SEED = 20020721


class Configurations(NamedTuple):
    """Closed configurations.

    Attributes
    ----------
    configurations : (count, nq) array
        Of the closed chain.
    readings : (count, n_legs) array
        Joint value of every leg [m], passive ones too; zero for legs of constant length.
    poses : list of RigidTransform
        T_base_platform.
    """

    configurations: Array
    readings: Array
    poses: list[RigidTransform]


def random_configurations(
    mechanism: Mechanism, count: int, rng: np.random.Generator | int
) -> Configurations:
    """Return random closed configurations with every slider inside its travel.

    Readings of motors are uniform in the travel and followed from home without crossing a
    singularity or ending beside one; those that cannot be reached are drawn again, nearer and
    nearer to home. Where motors do not determine the pose, the mechanism takes a random walk.

    Parameters
    ----------
    mechanism : Mechanism
        The machine.
    count : int
        How many.
    rng : Generator or int
        Source of chance, or its seed.

    Returns
    -------
    Configurations
        Arrays of configurations and readings, and a list of poses.

    Raises
    ------
    DidNotConverge
        If too few are reached.
    """
    chance = np.random.default_rng(rng)
    draw = _drawn if mechanism.is_determined else _wandered
    found = list(draw(mechanism, count, chance))
    if len(found) < count:
        raise DidNotConverge(
            f"{mechanism.yaml_path}: random poses could not be drawn: found {len(found)} of "
            f"{count} inside the travel in {TRIES} tries for each, needed all; check legcal.home "
            "and the limits of the sliders."
        )
    return Configurations(
        np.array(found).reshape(count, mechanism.chain.nq),
        np.array([joint_values(mechanism, c) for c in found]).reshape(count, mechanism.n_legs),
        [platform_pose(mechanism, c) for c in found],
    )


def workspace(mechanism: Mechanism) -> Configurations:
    """Return the configurations that stand for the workspace, the same at every call.

    Errors over the workspace are those at these poses, whether they are predicted or found by
    comparing two models. The order of the legs does not matter.

    Raises
    ------
    DidNotConverge
        As :func:`random_configurations`.
    """
    names = sorted(mechanism.leg_names)
    ordered = mechanism.with_leg_order(names)
    drawn = random_configurations(ordered, WORKSPACE_POSES, WORKSPACE_SEED)
    legs = [names.index(name) for name in mechanism.leg_names]
    return drawn._replace(readings=drawn.readings[:, legs])


def _drawn(mechanism: Mechanism, count: int, chance: np.random.Generator) -> Iterator[Array]:
    """Yield what is reached from home at random readings of the motors."""
    motors = [mechanism.legs[j] for j in mechanism.motors]
    lower, upper = np.array([leg.travel for leg in motors]).T
    home = mechanism.home_configuration[slider_columns(mechanism, mechanism.motors)[0]]
    least = REGULAR * singularity(mechanism, mechanism.home)
    drawn = 0
    for turn in range(count):
        if turn == HOPELESS and not drawn:
            return
        for tries, nearer in enumerate(NEARER):
            q = chance.uniform(lower, upper)
            if nearer < 1.0:
                q = np.clip(home + nearer * (q - home), lower, upper)
            try:
                reached = follow(
                    mechanism,
                    mechanism.home_configuration,
                    q,
                    shortest=SHORTEST_configurations,
                    on_the_chain=tries % (ON_THE_CHAIN + 1) < ON_THE_CHAIN,
                )
            except DidNotConverge:  # the legs cannot have these lengths at the same time
                continue
            if beyond_travel(mechanism, reached).any():
                continue
            if singularity(mechanism, platform_pose(mechanism, reached)) >= least:
                drawn += 1
                yield reached
                break


def _wandered(mechanism: Mechanism, count: int, chance: np.random.Generator) -> Iterator[Array]:
    """Yield every few steps of a random walk whose sliders stay inside their travel."""
    here = mechanism.home_configuration
    for _ in range(count):
        for _ in range(TRIES):
            here = strolled(mechanism, here, chance)
            if not beyond_travel(mechanism, here).any():
                yield here
                break


def strolled(mechanism: Mechanism, here: Array, chance: np.random.Generator) -> Array:
    """Return a closed configuration a few steps away, no further outside the travel."""
    for _ in range(WALK):
        motions = free_motions(mechanism, here)
        weights = chance.normal(size=motions.shape[1]) / np.sqrt(max(motions.shape[1], 1))
        there = project(mechanism, mechanism.chain.integrate(here, STRIDE * motions @ weights))
        if there is None:
            continue
        if not np.any(beyond_travel(mechanism, there) & ~beyond_travel(mechanism, here)):
            here = there
    return here


def joint_values(mechanism: Mechanism, configuration: Array) -> Array:
    """Return the joint value of every leg at a configuration, zero for rods, (n_legs,) [m]."""
    values = np.zeros(mechanism.n_legs)
    sliding = [j for j, leg in enumerate(mechanism.legs) if leg.kind is not LegKind.CONSTANT]
    values[sliding] = configuration[slider_columns(mechanism, tuple(sliding))[0]]
    return values


def beyond_travel(mechanism: Mechanism, configuration: Array) -> BoolArray:
    """Return which legs are outside their travel, or flipped, (n_legs,)."""
    values = joint_values(mechanism, configuration)
    lower, upper = np.array([leg.travel for leg in mechanism.legs]).T
    outside = (values < lower - INSIDE) | (values > upper + INSIDE)
    return np.asarray(outside | (mechanism.sign * values + mechanism.q0 <= 0.0))
