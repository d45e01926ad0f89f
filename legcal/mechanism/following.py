"""Following a closed configuration from known readings to others, in one assembly mode.

A hexapod has at least nine assembly modes at its home lengths. Newton on Pinocchio's constraints
is trusted only where its steps contract from the first on and the legs' equations keep the sign
of their determinant; else the way is halved, and the next step starts from what was reached.
Where the Jacobian of the closures hardly changes on the way there is no room for a singularity, and
no need to look at the determinant; where the equations are not square there is no other way.
Where the joints of the chain stop Newton the platform itself is followed, and the chain is closed
where it arrives.
"""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import RigidTransform

from legcal.errors import DidNotConverge
from legcal.geometry.types import Array, IntArray
from legcal.mechanism.closing import CLOSED, close_at, close_near, platform_pose, slider_columns
from legcal.mechanism.demands import is_constrained
from legcal.mechanism.leg import LegKind
from legcal.mechanism.model import Mechanism
from legcal.mechanism.pose_following import follow_pose, hardly_changes, walk
from legcal.mechanism.singularity import side

NEWTON_STEPS = 12
SHORTEST = 1.0 / 4096.0  # of the way from known readings to the wanted ones
CONTRACTION = 0.5  # of the step before; of 1 rad or 1 m for the first
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
        reached = _newton(mechanism, trial, free)
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
        exact = _newton(mechanism, trial, free)
        if exact.contracts:
            return exact.configuration
    return None


def _newton(mechanism: Mechanism, configuration: Array, free: IntArray) -> _Reached:
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
