"""What the study of the bound records of one fit."""

from __future__ import annotations

from dataclasses import dataclass
from math import isfinite
from typing import Any

import numpy as np

from legcal.geometry.types import Array
from legcal.studies.checkpoint_lines import is_failure
from legcal.studies.paper_record import has_keys
from legcal.studies.study import Record


@dataclass(frozen=True, eq=False)
class RunErrors:
    """The errors of one run.

    Attributes
    ----------
    error : (n,) array
        Of the parameters, axes as angles from the true ones [m, rad].
    of_sigma : (n,) array
        The same over the standard deviations that the estimator states.
    nse : float
        Normalised squared error per parameter by the covariance that it states.
    """

    error: Array
    of_sigma: Array
    nse: float


def errors_record(errors: RunErrors) -> Record:
    """Return the errors of a run as a record [m, rad]."""
    return {
        "error": errors.error.tolist(),
        "of_sigma": errors.of_sigma.tolist(),
        "nse": errors.nse,
    }


def run_errors(record: Record) -> RunErrors:
    """Return the errors of the record of a fit that ended."""
    return RunErrors(np.array(record["error"]), np.array(record["of_sigma"]), record["nse"])


def is_errors(found: Any) -> bool:
    """Return whether a document has the errors of a fit, or how it failed."""
    if has_keys(found, {"failure"}):
        return is_failure(found["failure"])
    return (
        has_keys(found, {"error", "of_sigma", "nse"})
        and is_number(found["nse"])
        and all(isinstance(found[key], list) for key in ("error", "of_sigma"))
        and len(found["error"]) == len(found["of_sigma"]) > 0
        and all(map(is_number, (*found["error"], *found["of_sigma"])))
    )


def is_number(found: Any) -> bool:
    """Return whether a document is a finite number."""
    return isinstance(found, float | int) and not isinstance(found, bool) and isfinite(found)
