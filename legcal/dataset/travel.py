"""Readings against the travel of their encoders, which is the joint limits of the model."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from legcal.geometry.types import Array, BoolArray
from legcal.mechanism.leg import Leg

TRAVEL_MARGIN = 0.05  # of the travel: a reading further outside is an error

_SHOWN = 3  # readings quoted in a sentence about many


def check_travel(
    path: Path, wheres: Sequence[str], legs: Sequence[Leg], readings: Array
) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """Return what is wrong with readings outside their travel, and what is only odd.

    Parameters
    ----------
    path : Path
        The table, for the message.
    wheres : sequence of str, length n_rows
        The place of each row, for the message.
    legs : sequence of Leg
        The actuated legs.
    readings : (n_rows, n_actuated) array
        Their readings [m]; NaN is passed over.

    Returns
    -------
    problems : tuple of str
        One sentence for each column with readings outside by more than 5 % of the travel.
    notes : tuple of str
        One sentence for each other column with readings outside by less.
    """
    problems, notes = [], []
    for leg, column in zip(legs, readings.T, strict=True):
        lower, upper = leg.travel
        margin = TRAVEL_MARGIN * (upper - lower)
        if not (np.isfinite(margin) and margin > 0.0):
            continue
        outside = (column < lower) | (column > upper)
        far = (column < lower - margin) | (column > upper + margin)
        start = f"{path}, column {leg.prismatic}"
        travel = f"{lower:g} to {upper:g} m (the joint limits of the model)"
        if np.any(far):
            remedy = (
                "these look like millimetres: divide the column by 1000"
                if 2 * np.sum(far) >= len(column)
                and _look_like_millimetres(column[far], lower, upper)
                else "correct the readings or the limits"
            )
            problems.append(
                f"{start}: readings are outside the travel: found {_some(wheres, column, far)}, "
                f"needed {travel} with a margin of {TRAVEL_MARGIN:.0%}; {remedy}."
            )
        elif np.any(outside):
            found = _some(wheres, column, outside)
            notes.append(f"{start}: readings are a little outside the travel {travel}: {found}.")
    return tuple(problems), tuple(notes)


def _look_like_millimetres(readings: Array, lower: float, upper: float) -> bool:
    """Say whether readings lie far outside a travel [m], and in it when divided by 1000."""
    metres, margin = 1e-3 * readings, TRAVEL_MARGIN * (upper - lower)
    fit = (metres >= lower - margin) & (metres <= upper + margin)
    far = (readings > 2.0 * upper - lower) | (readings < 2.0 * lower - upper)
    return bool(np.all(fit & far))


def _some(wheres: Sequence[str], column: Array, chosen: BoolArray) -> str:
    """Return the first of some readings with their rows, and how many more there are."""
    index = np.flatnonzero(chosen).tolist()
    shown = ", ".join(f"{column[i]:g} m in {_row(wheres[i])}" for i in index[:_SHOWN])
    return shown + (f" and {len(index) - _SHOWN} more" if len(index) > _SHOWN else "")


def _row(where: str) -> str:
    """Return a place without its file."""
    return where.rsplit(", ", 1)[-1]
