"""Whether the rounds of a fit have come to rest, and what is said where they have not."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from legcal.errors import DidNotConverge
from legcal.geometry.types import Array
from legcal.refinement.biases import KINDS, SharedShifts
from legcal.refinement.noise import NoiseModel
from legcal.refinement.settings import RefinementSettings

_ROUNDED_PX = 1e-3  # smaller errors of outlines do not matter
_FURTHEST = 0.5  # of the largest error of outlines, in the last round
_MOST_CHANGED = 0.05  # of the accepted outlines


@dataclass(frozen=True, eq=False)
class Changes:
    """What a round changed.

    Attributes
    ----------
    before, after : (n,) array
        Standard deviations of the errors of outlines, as :func:`sizes` has them.
    n_changed : int
        Outlines that were accepted and are not, or the other way round.
    n_accepted : int
        Outlines that are accepted after it.
    """

    before: Array
    after: Array
    n_changed: int
    n_accepted: int

    def are_settled(self, settings: RefinementSettings) -> bool:
        """Say whether another round would change nothing that matters."""
        near = np.allclose(self.after, self.before, rtol=settings.settled, atol=_ROUNDED_PX)
        return near and self.n_changed <= settings.settled * self.n_accepted


NO_CHANGES = Changes(np.zeros(0), np.zeros(0), 0, 0)


def sizes(noise: NoiseModel, shifts: SharedShifts) -> Array:
    """Return all standard deviations of errors in one vector: a factor, the others [px]."""
    return np.array([noise.scale, noise.bias_px, noise.tilt_px, *shifts.sigma[: len(KINDS)]])


def unsettled(changes: Changes, claimed: Array, settings: RefinementSettings) -> tuple[str, ...]:
    """Return what the last round changed though it should have left it, nothing if it did.

    Parameters
    ----------
    changes : Changes
        Of the last round.
    claimed : (n, 2, 2) array
        Claimed covariances of the outlines [px^2].
    settings : RefinementSettings

    Raises
    ------
    DidNotConverge
        If that is a lot.
    """
    if changes.are_settled(settings):
        return ()
    unit = np.ones(len(changes.after))
    unit[0] = np.sqrt(0.5 * np.mean(np.trace(claimed, axis1=1, axis2=2)))
    before, after = unit * changes.before, unit * changes.after
    i = int(np.argmax(np.abs(after - before)))
    found = (
        f"the last round accepted or rejected {changes.n_changed} outlines anew, with "
        f"{changes.n_accepted} accepted, and changed the standard deviation of one kind of error "
        f"from {before[i]:.3f} px to {after[i]:.3f} px"
    )
    largest = max(float(before.max()), float(after.max()))
    most_changed = _MOST_CHANGED * changes.n_accepted
    if abs(after[i] - before[i]) > _FURTHEST * largest or changes.n_changed > most_changed:
        raise DidNotConverge(
            "The fit of everything could not settle which outlines are right and how large their "
            f"errors are: found that {found}, needed hardly any change; add images, or correct "
            "outlines that are wrong."
        )
    return (
        "The errors of the outlines are not quite settled, and the uncertainty of the result is "
        f"that unsure: {found}.",
    )
