"""What the study of convergence records of one fit."""

from __future__ import annotations

from typing import Any

from legcal.studies.bound_record import is_number
from legcal.studies.checkpoint_lines import is_failure
from legcal.studies.outline_platform import Misses
from legcal.studies.paper_record import has_keys
from legcal.studies.study import Record

FAR = 5.0  # standard deviations
_PLACES = ("before", "after", "predicted")


def fit_record(worst: float, before: Misses, after: Misses, predicted: Misses) -> Record:
    """Return the record of a fit that ended.

    Parameters
    ----------
    worst : float
        Largest error of a parameter, in standard deviations that the fit states.
    before, after : Misses
        Errors of the platform of the nominal and of the found model.
    predicted : Misses
        One standard deviation of the latter.
    """
    found = {"before": before, "after": after, "predicted": predicted}
    return {"worst": worst, **{key: list(misses) for key, misses in found.items()}}


def is_right(record: Record) -> bool:
    """Return whether a fit that ended found the truth, within what it states."""
    platform = zip(record["after"], record["predicted"], strict=True)
    return bool(record["worst"] <= FAR and all(miss <= FAR * sigma for miss, sigma in platform))


def is_outcome(found: Any) -> bool:
    """Return whether a document says where a fit ended, or how it was refused."""
    if has_keys(found, {"failure"}):
        return is_failure(found["failure"])
    return (
        has_keys(found, {"worst", *_PLACES})
        and is_number(found["worst"])
        and all(isinstance(found[key], list) and len(found[key]) == 2 for key in _PLACES)
        and all(is_number(value) for key in _PLACES for value in found[key])
    )
