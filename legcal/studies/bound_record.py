"""What the study of the bound records of one fit."""

from __future__ import annotations

from math import isfinite
from typing import Any

import numpy as np

from legcal.studies.bound_statistics import RunErrors
from legcal.studies.checkpoint_lines import is_failure
from legcal.studies.paper_record import has_keys
from legcal.studies.study import Record


def errors_record(errors: RunErrors) -> Record:
    """Return the errors of a run as a record [m, rad]."""
    return {
        "error": errors.error.tolist(),
        "of_sigma": errors.of_sigma.tolist(),
        "nse": errors.nse,
    }


def run_errors(record: Record) -> RunErrors | str:
    """Return the errors of a record, or the kind of error with which its run failed."""
    if "failure" in record:
        return str(record["failure"]["kind"])
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
