"""How many freedoms the platform of the closed mechanism has, idle spins of legs not counted.

The closures leave a null space of joint rates; the mobility is the rank of the twist that it
gives the platform. What is left of the null space moves no platform: legs with an S joint at
both ends spin about themselves. Overconstrained closures (a planar mechanism welded in space)
need no care: dependent rows do not change a null space.
"""

from collections.abc import Iterator

import numpy as np

from legcal.geometry.types import Array
from legcal.mechanism.closing import CLOSED
from legcal.mechanism.demands import leg_scale
from legcal.mechanism.model import Mechanism

RANK_TOLERANCE = 1e-7  # of the largest singular value, lengths and angles made comparable
STEP = 0.05  # [rad], and of a leg length
CONFIGURATIONS = 3


def mobility(mechanism: Mechanism) -> int:
    """Return the rank of the platform's twist over the null space of the closures.

    It is taken where the closures have their largest rank, at closed configurations near home
    too, because a symmetric pose may be singular.

    Parameters
    ----------
    mechanism : Mechanism
        The machine.

    Returns
    -------
    int
        The mobility; the motors determine the pose where it equals their number.
    """
    found = [freedoms(mechanism, c) for c in generic_configurations(mechanism, CONFIGURATIONS)]
    return min(found)[1]


def freedoms(mechanism: Mechanism, configuration: Array) -> tuple[int, int]:
    """Return the freedoms of all joints and of the platform alone at a closed configuration."""
    scale = leg_scale(mechanism, mechanism.home)
    null_space = free_motions(mechanism, configuration)
    twist = mechanism.chain.twist(mechanism.base, mechanism.platform) @ null_space
    twist[:3] /= scale
    values = np.linalg.svd(twist, compute_uv=False)
    return null_space.shape[1], int(np.sum(values > RANK_TOLERANCE))


def generic_configurations(mechanism: Mechanism, count: int) -> Iterator[Array]:
    """Yield home, then up to ``count - 1`` closed ones a little way off in seeded directions."""
    chain = mechanism.chain
    yield mechanism.home_configuration
    rng = np.random.default_rng(1965)
    scale = _column_scale(mechanism, leg_scale(mechanism, mechanism.home))
    jacobian = chain.linearize(mechanism.home_configuration)[1] * scale
    inverse = np.linalg.pinv(jacobian, rcond=RANK_TOLERANCE)
    for _ in range(count - 1):
        direction = rng.normal(size=chain.nv)
        direction -= inverse @ (jacobian @ direction)
        size = float(np.abs(direction).max())
        if size < RANK_TOLERANCE:
            return  # nothing moves
        step = STEP * scale * direction / size
        configuration = project(mechanism, chain.integrate(mechanism.home_configuration, step))
        if configuration is not None:
            yield configuration


def project(mechanism: Mechanism, configuration: Array) -> Array | None:
    """Return the closed configuration nearest to one that is almost closed, None if none is.

    Gauss-Newton steps of least norm, lengths counted in leg lengths.
    """
    chain = mechanism.chain
    scale = _column_scale(mechanism, leg_scale(mechanism, mechanism.home))
    worst = np.inf
    for _ in range(15):
        residual, jacobian = chain.linearize(configuration)
        gap = float(np.abs(residual).max(initial=0.0))
        if gap < CLOSED and gap > 0.1 * worst:
            return configuration  # rounding
        if gap > 2.0 * worst:
            return None
        worst = gap
        change = np.linalg.lstsq(jacobian * scale, residual, rcond=RANK_TOLERANCE)[0]
        configuration = chain.integrate(configuration, -scale * change)
    return configuration if worst < CLOSED else None


def free_motions(mechanism: Mechanism, configuration: Array) -> Array:
    """Return the tangent steps that keep all loops closed, orthonormal with lengths in leg lengths.

    Returns
    -------
    (nv, k) array
        A basis; idle spins of legs are among them.
    """
    scale = leg_scale(mechanism, mechanism.home)
    columns = _column_scale(mechanism, scale)
    jacobian = mechanism.chain.linearize(configuration)[1] * columns
    row = 0
    for closure in mechanism.chain.closures:
        jacobian[row : row + 3] /= scale
        row += closure.rows
    _, values, right = np.linalg.svd(jacobian)
    rank = int(np.sum(values > RANK_TOLERANCE * values[0])) if len(values) else 0
    return np.asarray(columns[:, None] * right[rank:].T)


def _column_scale(mechanism: Mechanism, scale: float) -> Array:
    """Return what turns tangent steps without a unit into [m] and [rad]."""
    columns = np.full(mechanism.chain.nv, scale)
    columns[mechanism.chain.rotation_columns()] = 1.0
    return columns
