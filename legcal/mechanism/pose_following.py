"""Following the platform itself from known readings to others, whatever the spanning tree.

The equations of the legs know the pose and the readings, but no joint angle: they stay regular
where a spherical joint that is written as three revolutes comes near gimbal lock and Newton on
the joints of the chain hardly moves. Steps are trusted as on the chain: where Newton contracts from
the first step on, no leg turns over, and the Jacobian hardly changes or its determinant keeps
its sign.
"""

from collections.abc import Callable

import numpy as np
from scipy.spatial.transform import RigidTransform

from legcal.geometry.types import Array
from legcal.mechanism.demands import demands_at, leg_scale, moved
from legcal.mechanism.model import Mechanism
from legcal.mechanism.singularity import dimensionless

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
