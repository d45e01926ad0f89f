"""What the study of the classes records of one session."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from legcal.geometry.types import Array
from legcal.stages.nominal import Criteria
from legcal.studies.bound_record import is_number
from legcal.studies.checkpoint_lines import is_failure
from legcal.studies.paper_record import has_keys
from legcal.studies.study import Record

NOMINAL, FIT = "nominal", "fit"
STEPS: tuple[Criteria, ...] = ("literal", "default")
ESTIMATORS = (NOMINAL, *STEPS, FIT)
_PLATFORM = {"dX", "dE"}
_ERRORS = {"rank", "nse", "of_bound", "of_sigma"}


@dataclass(frozen=True, eq=False)
class FitErrors:
    """The errors of the kinematic parameters of one fit.

    Attributes
    ----------
    rank : int
        How many directions are determined; the others are held.
    nse : float
        Normalised squared error for each of them, by the covariance that the fit states.
    of_bound : float
        The same by the Cramer-Rao bound.
    of_sigma : (k,) array
        Errors of the parameters that are estimated each for itself, over the standard deviations
        that the fit states.
    """

    rank: int
    nse: float
    of_bound: float
    of_sigma: Array


def fit_record(errors: FitErrors) -> Record:
    """Return the errors of a fit as a part of its record."""
    return {
        "rank": errors.rank,
        "nse": errors.nse,
        "of_bound": errors.of_bound,
        "of_sigma": errors.of_sigma.tolist(),
    }


def fit_errors(record: Record) -> FitErrors:
    """Return the errors of the record of a fit that ended."""
    of_sigma = np.array(record["of_sigma"])
    return FitErrors(record["rank"], record["nse"], record["of_bound"], of_sigma)


def is_record(found: Any) -> bool:
    """Return whether a document has errors or a failure of every estimator."""
    if not has_keys(found, set(ESTIMATORS)):
        return False
    others = (found[name] for name in ESTIMATORS if name != FIT)
    return all(map(_is_platform, others)) and _is_fit(found[FIT])


def _is_platform(found: Any) -> bool:
    if has_keys(found, {"failure"}):
        return is_failure(found["failure"])
    return has_keys(found, _PLATFORM) and all(map(is_number, found.values()))


def _is_fit(found: Any) -> bool:
    if has_keys(found, {"failure"}):
        return is_failure(found["failure"])
    return (
        has_keys(found, _PLATFORM | _ERRORS)
        and all(is_number(found[key]) for key in (_PLATFORM | _ERRORS) - {"of_sigma"})
        and isinstance(found["of_sigma"], list)
        and len(found["of_sigma"]) > 0
        and all(map(is_number, found["of_sigma"]))
    )
