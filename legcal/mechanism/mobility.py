"""How many freedoms the closed mechanism has, idle spins of legs not counted."""

from collections.abc import Iterator

import numpy as np

from legcal.geometry.types import Array
from legcal.mechanism.model import Mechanism

RANK_TOLERANCE = 1e-7  # of the largest singular value, lengths and angles made comparable
STEP = 0.05  # [rad], and of a leg length


def mobility(mechanism: Mechanism) -> int:
    """Return the freedoms of the platform: joint freedoms less the rank of the closures.

    The rank is taken at closed configurations near home too, because a symmetric pose may be
    singular. Legs with a sphere at both ends spin about themselves: that is no freedom.

    Parameters
    ----------
    mechanism : Mechanism
        The machine.

    Returns
    -------
    int
        The mobility; the motors determine the pose where it equals their number.
    """
    rank = max(_rank(mechanism, c) for c in generic_configurations(mechanism, 3))
    return mechanism.chain.nv - rank - idle_spins(mechanism)


def idle_spins(mechanism: Mechanism) -> int:
    """Return the number of legs that spin about themselves without moving anything else."""
    return sum(leg.base_joint == leg.platform_joint == "S" for leg in mechanism.legs)


def generic_configurations(mechanism: Mechanism, count: int) -> Iterator[Array]:
    """Yield home, then closed configurations a little way off in seeded directions."""
    chain = mechanism.chain
    yield mechanism.home_configuration
    rng = np.random.default_rng(1965)
    scale = _column_scale(mechanism)
    for _ in range(count - 1):
        configuration = mechanism.home_configuration
        _, jacobian = chain.linearize(configuration)
        direction = rng.normal(size=chain.nv)
        direction -= np.linalg.pinv(jacobian * scale, rcond=RANK_TOLERANCE) @ (
            jacobian @ (scale * direction)
        )
        step = STEP * scale * direction / np.abs(direction).max()
        configuration = chain.integrate(configuration, step)
        for _ in range(12):
            residual, jacobian = chain.linearize(configuration)
            if np.abs(residual).max() < 1e-12:
                break
            change = np.linalg.lstsq(jacobian * scale, residual, rcond=RANK_TOLERANCE)[0]
            configuration = chain.integrate(configuration, -scale * change)
        yield configuration


def _rank(mechanism: Mechanism, configuration: Array) -> int:
    """Return the rank of the closures, with lengths in leg lengths."""
    _, jacobian = mechanism.chain.linearize(configuration)
    scaled = jacobian * _column_scale(mechanism)
    row = 0
    for closure in mechanism.chain.closures:
        if closure.kind == "6d":
            scaled[row + 3 : row + 6] *= leg_scale(mechanism)
        row += closure.rows
    values = np.linalg.svd(scaled, compute_uv=False)
    return int(np.sum(values > RANK_TOLERANCE * values[0]))


def _column_scale(mechanism: Mechanism) -> Array:
    """Return what turns tangent steps without a unit into [m] and [rad]."""
    scale = np.full(mechanism.chain.nv, leg_scale(mechanism))
    scale[mechanism.chain.rotation_columns()] = 1.0
    return scale


def leg_scale(mechanism: Mechanism) -> float:
    """Return the mean length of the legs at home [m]."""
    B = mechanism.home.apply(mechanism.B_platform)
    return float(np.linalg.norm(B - mechanism.A_base, axis=1).mean())
