"""Forward and inverse kinematics of the closed chain, and its mobility (section 2).

Forward kinematics holds the motors at their readings and closes all loops by Newton on
Pinocchio's constraints. It follows the solution from a known one in steps that contract, so
that it stays in one assembly mode: a hexapod has at least nine at its home lengths.
"""

import numpy as np
from scipy.spatial.transform import RigidTransform

from legcal.errors import DidNotConverge, NotIdentifiable, UsageError
from legcal.geometry.types import Array, IntArray
from legcal.mechanism.closing import (
    CLOSED,
    close_at,
    platform_pose,
    readings_at,
    slider_columns,
    worst_closure,
)
from legcal.mechanism.leg import LegKind
from legcal.mechanism.mobility import mobility
from legcal.mechanism.model import Mechanism

__all__ = [
    "forward_kinematics",
    "forward_kinematics_many",
    "inverse_kinematics",
    "mobility",
    "outside_travel",
]

NEWTON_STEPS = 12
SHORTEST = 1.0 / 4096.0  # of the way from known readings to the wanted ones
CONTRACTION = 0.5


def forward_kinematics(
    mechanism: Mechanism, q: Array, start: RigidTransform | None = None
) -> RigidTransform:
    """Return the platform pose at motor readings.

    Parameters
    ----------
    mechanism : Mechanism
        The machine.
    q : (n_legs,) array
        Readings [m]; those of legs without a motor are ignored and may be NaN.
    start : RigidTransform, optional
        T_base_platform of a pose in the wanted assembly mode; ``mechanism.home`` without it.

    Returns
    -------
    RigidTransform
        T_base_platform, with every loop closed to 1e-12 m.

    Raises
    ------
    NotIdentifiable
        If the motors do not determine the pose.
    DidNotConverge
        If no closed pose is reached from ``start`` without crossing a singularity.
    UsageError
        If the readings are too few or not finite.
    """
    readings = _readings(mechanism, np.asarray(q, dtype=np.float64)[None])[0]
    configuration = mechanism.home_configuration
    if start is not None:
        configuration = close_at(mechanism, start, configuration)
    return platform_pose(mechanism, _follow(mechanism, configuration, readings))


def forward_kinematics_many(mechanism: Mechanism, q: Array) -> list[RigidTransform]:
    """Return the platform poses at many rows of readings, in the assembly mode of home.

    Parameters
    ----------
    mechanism : Mechanism
        The machine.
    q : (n_rows, n_legs) array
        Readings [m]; each row starts from the nearest one that is solved already, or from home.

    Returns
    -------
    list of RigidTransform
        T_base_platform of every row.

    Raises
    ------
    NotIdentifiable, DidNotConverge, UsageError
        As :func:`forward_kinematics`.
    """
    readings = _readings(mechanism, np.asarray(q, dtype=np.float64))
    known = [mechanism.home_configuration[slider_columns(mechanism, mechanism.motors)[0]]]
    configurations = [mechanism.home_configuration]
    poses = []
    for i, row in enumerate(readings):
        nearest = int(np.argmin(np.abs(np.array(known) - row).max(axis=1)))
        configuration = _follow(mechanism, configurations[nearest], row, f" of row {i + 1}")
        known.append(row)
        configurations.append(configuration)
        poses.append(platform_pose(mechanism, configuration))
    return poses


def inverse_kinematics(mechanism: Mechanism, T_base_platform: RigidTransform) -> Array:
    """Return the joint value of every leg at a pose, q = sign (|AB| - q0).

    A length is a distance, so that no leg is ever flipped. Values outside the travel are
    returned as they are; :func:`outside_travel` names them.

    Parameters
    ----------
    mechanism : Mechanism
        The machine.
    T_base_platform : RigidTransform
        Pose of the platform link in the base link.

    Returns
    -------
    (n_legs,) array
        Joint values [m]; zero for a leg of constant length.

    Raises
    ------
    UsageError
        If a leg of constant length does not reach the pose.
    """
    q = readings_at(mechanism, T_base_platform)
    for j, leg in enumerate(mechanism.legs):
        if leg.kind is LegKind.CONSTANT:
            if abs(q[j]) > 1e-9:
                raise UsageError(
                    f"The platform cannot stand there: leg '{leg.name}' would be {1e3 * q[j]:.4g} "
                    "mm longer than it is, needed its constant length; choose a pose that keeps it."
                )
            q[j] = 0.0
    return q


def outside_travel(mechanism: Mechanism, q: Array) -> dict[str, float]:
    """Return the legs whose joint value lies outside their travel.

    Parameters
    ----------
    mechanism : Mechanism
        The machine.
    q : (n_legs,) array
        Joint values [m].

    Returns
    -------
    dict of str to float
        Leg name, and how far outside [m]: negative below the travel, positive above it.
    """
    outside = {}
    for leg, value in zip(mechanism.legs, q, strict=True):
        lower, upper = leg.travel
        if leg.kind is not LegKind.CONSTANT and not lower <= value <= upper:
            outside[leg.name] = float(value - (lower if value < lower else upper))
    return outside


def _readings(mechanism: Mechanism, q: Array) -> Array:
    """Return the readings of the motors, (n_rows, n_motors), checked."""
    if q.ndim != 2 or q.shape[1] != mechanism.n_legs:
        raise UsageError(
            f"The pose could not be computed: found readings of shape {q.shape[1:]}, needed "
            f"({mechanism.n_legs},), one for each leg; pass them in the order of the legs."
        )
    if mechanism.mobility != len(mechanism.motors):
        raise NotIdentifiable(
            f"{mechanism.yaml_path}: the pose cannot be computed from readings: found mobility "
            f"{mechanism.mobility} and {len(mechanism.motors)} motors, needed as many motors as "
            "mobility; correct name_mot, or do not ask for poses of this mechanism."
        )
    readings = q[:, list(mechanism.motors)]
    for row, values in enumerate(readings):
        for j, value in zip(mechanism.motors, values, strict=True):
            leg = mechanism.legs[j]
            if not np.isfinite(value) or leg.sign * value + leg.q0 <= 0.0:
                raise UsageError(
                    f"The pose of row {row + 1} could not be computed: found the reading {value:g} "
                    f"of leg '{leg.name}', needed a finite number above a leg length of zero; "
                    "correct the reading."
                )
    return readings


def _follow(mechanism: Mechanism, configuration: Array, readings: Array, which: str = "") -> Array:
    """Return the closed configuration at readings, followed from a closed one."""
    q_columns, v_columns = slider_columns(mechanism, mechanism.motors)
    free = np.delete(np.arange(mechanism.chain.nv), v_columns)
    first = configuration[q_columns]
    side = _side(mechanism, configuration)
    done, step = 0.0, 1.0
    residual = np.full(mechanism.chain.n_rows, np.inf)
    while done < 1.0:
        wanted = min(done + step, 1.0)
        trial = configuration.copy()
        trial[q_columns] = readings if wanted == 1.0 else first + wanted * (readings - first)
        trial, residual, contracts = _newton(mechanism, trial, free)
        if contracts and _side(mechanism, trial) == side:
            configuration, done, step = trial, wanted, 2.0 * step
        else:
            step *= 0.5
            if step < SHORTEST:
                raise DidNotConverge(
                    f"{mechanism.yaml_path}: the pose at the readings{which} could not be reached: "
                    f"at {100 * done:.1f} % of the way from the starting pose "
                    f"{worst_closure(mechanism, residual)} or the mechanism is singular, needed "
                    "closure to 1e-12 m on a regular path; check the readings and legcal.home."
                )
    return configuration


def _newton(
    mechanism: Mechanism, configuration: Array, free: IntArray
) -> tuple[Array, Array, bool]:
    """Close the loops by Newton; the last value says whether its steps contracted to the end."""
    chain = mechanism.chain
    step = np.zeros(chain.nv)
    previous = 1.0
    for _ in range(NEWTON_STEPS):
        residual, jacobian = chain.linearize(configuration)
        worst = float(np.abs(residual).max())
        if worst < 0.01 * CLOSED:
            return configuration, residual, True
        J = jacobian[:, free]
        try:
            change = (
                np.linalg.solve(J, residual)
                if J.shape[0] == J.shape[1]
                else np.linalg.lstsq(J, residual, rcond=1e-10)[0]
            )
        except np.linalg.LinAlgError:
            return configuration, residual, False
        size = float(np.abs(change).max())
        if size > CONTRACTION * previous:
            return configuration, residual, worst < CLOSED
        previous = size
        step[free] = -change
        configuration = chain.integrate(configuration, step)
    residual = chain.residual(configuration)
    return configuration, residual, float(np.abs(residual).max()) < CLOSED


def _side(mechanism: Mechanism, configuration: Array) -> float:
    """Return on which side of a singularity a pose lies: the sign of the leg lines' determinant."""
    driven = [j for j, leg in enumerate(mechanism.legs) if leg.kind is not LegKind.PASSIVE]
    if len(driven) != 6:
        return 0.0
    R, t = mechanism.chain.placement(configuration, mechanism.base, mechanism.platform)
    arms = mechanism.B_platform[driven] @ R.T
    u = arms + t - mechanism.A_base[driven]
    # the moments u x arm about the platform's origin, written out: np.cross is slow on six rows
    (x, y, z), (a, b, c) = arms.T, u.T
    lines = np.stack([a, b, c, y * c - z * b, z * a - x * c, x * b - y * a])
    return float(np.sign(np.linalg.det(lines)))
