"""Following a closed configuration from known readings to others, in one assembly mode.

A hexapod has at least nine assembly modes at its home lengths. Newton on Pinocchio's constraints
is trusted only where its steps contract from the first on and the legs' equations keep the sign
of their determinant; else the way is halved, and the next step starts from what was reached.
Where the Jacobian of the closures hardly changes on the way there is no room for a singularity, and
no need to look at the determinant; where the equations are not square there is no other way.
"""

from dataclasses import dataclass

import numpy as np

from legcal.errors import DidNotConverge
from legcal.geometry.types import Array, IntArray
from legcal.mechanism.closing import CLOSED, platform_pose, slider_columns, worst_closure
from legcal.mechanism.leg import LegKind
from legcal.mechanism.model import Mechanism
from legcal.mechanism.singularity import side

NEWTON_STEPS = 12
SHORTEST = 1.0 / 4096.0  # of the way from known readings to the wanted ones
CONTRACTION = 0.5  # of the step before; of 1 rad or 1 m for the first
SURE = 0.5  # norm of J0^-1 J1 - 1 that leaves no room for a singularity between J0 and J1


@dataclass(frozen=True, eq=False)
class _Reached:
    """Where Newton ended: the configuration, the linearised closures, and how the steps went."""

    configuration: Array
    residual: Array
    jacobian: Array
    contracts: bool


def follow(
    mechanism: Mechanism,
    configuration: Array,
    readings: Array,
    which: str = "",
    shortest: float = SHORTEST,
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
    done, step = 0.0, 1.0
    while done < 1.0:
        wanted = min(done + step, 1.0)
        trial = configuration.copy()
        trial[q_columns] = readings if wanted == 1.0 else first + wanted * (readings - first)
        reached = _newton(mechanism, trial, free)
        accepted = reached.contracts and not _flipped(mechanism, reached.configuration)
        if accepted and not _hardly_changes(known, reached.jacobian):
            if here is None:
                here = side(mechanism, platform_pose(mechanism, configuration))
            there = side(mechanism, platform_pose(mechanism, reached.configuration))
            accepted = here == there != 0.0  # not square: only ways on which little changes
        if accepted:
            configuration, known = reached.configuration, reached.jacobian
            done, step = wanted, 2.0 * step
        else:
            step *= 0.5
            if step < shortest:
                raise DidNotConverge(
                    f"{mechanism.yaml_path}: the pose at the readings{which} could not be reached: "
                    f"at {100 * done:.1f} % of the way from the starting pose "
                    f"{worst_closure(mechanism, reached.residual)} or the mechanism is singular, "
                    "needed closure to 1e-12 m on a regular path; check the readings and "
                    "legcal.home."
                )
    return configuration


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
            return _Reached(configuration, residual, J, True)
        change = _solve(J, residual)
        size = float(np.abs(change).max())
        if size > CONTRACTION * previous:
            return _Reached(configuration, residual, J, worst < CLOSED)
        previous = size
        step[free] = -change
        configuration = chain.integrate(configuration, step)
    residual, jacobian = chain.linearize(configuration)
    closed = float(np.abs(residual).max()) < CLOSED
    return _Reached(configuration, residual, jacobian[:, free], closed)


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


def _hardly_changes(known: Array, jacobian: Array) -> bool:
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


def _flipped(mechanism: Mechanism, configuration: Array) -> bool:
    """Say whether a leg without a motor has shrunk through its base joint."""
    legs = tuple(j for j, leg in enumerate(mechanism.legs) if leg.kind is LegKind.PASSIVE)
    if not legs:
        return False
    q = configuration[slider_columns(mechanism, legs)[0]]
    rows = list(legs)
    return bool(np.any(mechanism.sign[rows] * q + mechanism.q0[rows] <= 0.0))
