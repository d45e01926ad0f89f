"""Errors of the radii of legs, of the cylinders that are seen: no errors of the kinematics."""

from __future__ import annotations

import numpy as np

from legcal.errors import UsageError
from legcal.mechanism.model import Mechanism
from legcal.simulation.parameter_errors import Distribution, Spread
from legcal.simulation.shapes import Cylinder
from legcal.simulation.solids import solids_of

_MOST = {Distribution.UNIFORM: 0.5, Distribution.NORMAL: 0.1}  # of the thinnest cylinder
_ALIKE = 1e-9  # [m]; cylinders of one leg with one radius are one tube and stay so


def draw_radii(
    nominal: Mechanism, spread: Spread, rng: np.random.Generator
) -> dict[tuple[str, int], float]:
    """Return the radii of the true legs.

    Parameters
    ----------
    nominal : Mechanism
        The nominal model.
    spread : Spread
        How large the errors are [m].
    rng : numpy.random.Generator
        Source of the errors.

    Returns
    -------
    dict
        By link and number of the cylinder among the visual cylinders of that link [m]; all that
        are coaxial with legs, none if there are no errors.

    Raises
    ------
    UsageError
        If an error may leave nothing of a leg.
    """
    if spread.size == 0.0:
        return {}
    counts: dict[str, int] = {}
    radii: dict[tuple[str, int], float] = {}
    tubes: dict[tuple[int, int], list[tuple[str, int]]] = {}
    for solid in solids_of(nominal):
        if isinstance(solid.shape, Cylinder) and solid.link is not None:
            place = solid.link, counts.setdefault(solid.link, 0)
            counts[solid.link] += 1
            if solid.leg is not None:
                radii[place] = solid.shape.radius
                tube = solid.leg, round(solid.shape.radius / _ALIKE)
                tubes.setdefault(tube, []).append(place)
    _check(spread, min(radii.values(), default=np.inf))
    uniform, normal = rng.uniform(-1.0, 1.0, len(tubes)), rng.normal(size=len(tubes))
    unit = normal if spread.distribution is Distribution.NORMAL else uniform
    for step, places in zip((spread.size * unit).tolist(), tubes.values(), strict=True):
        for place in places:
            radii[place] += step
    return radii


def _check(spread: Spread, thinnest: float) -> None:
    """Refuse errors that may leave nothing of a leg."""
    most = _MOST[spread.distribution] * thinnest
    if not spread.size <= most:
        raise UsageError(
            f"The errors of radii could not be drawn: found a size of {1e3 * spread.size:g} mm, "
            f"needed at most {1e3 * most:.3g} mm ({spread.distribution}) for cylinders as thin as "
            f"{1e3 * thinnest:g} mm; make it smaller."
        )
