"""Following a closed configuration from known readings to others, in one assembly mode.

A hexapod has at least nine assembly modes at its home lengths. Newton on Pinocchio's constraints is
trusted only where its steps contract from the first on and the leg lines keep their
orientation; else the way is halved, and the next step starts from what was reached.
"""

import numpy as np

from legcal.errors import DidNotConverge
from legcal.geometry.types import Array, IntArray
from legcal.mechanism.closing import CLOSED, slider_columns, worst_closure
from legcal.mechanism.leg import LegKind
from legcal.mechanism.model import Mechanism

NEWTON_STEPS = 12
SHORTEST = 1.0 / 4096.0  # of the way from known readings to the wanted ones
CONTRACTION = 0.5  # of the step before; of 1 rad or 1 m for the first


def follow(mechanism: Mechanism, configuration: Array, readings: Array, which: str = "") -> Array:
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

    Returns
    -------
    (nq,) array
        Closed to 1e-12 m.

    Raises
    ------
    DidNotConverge
        If the steps stop contracting or reach a singularity, even tiny ones.
    """
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
