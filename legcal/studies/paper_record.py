"""What the paper's evaluation records of an estimator in one run."""

from __future__ import annotations

from dataclasses import asdict
from math import isfinite
from typing import Any

from legcal.geometry.types import Array
from legcal.studies.checkpoint_lines import is_failure
from legcal.studies.eq20 import PlatformErrors
from legcal.studies.study import Record

SCALARS = ("dX", "dE", "angle", "of_bound_squared")
_N_PARAMETERS = 30  # of a 6-SPU


def errors_record(errors: PlatformErrors, of_bound_squared: float, parameters: Array) -> Record:
    """Return errors as a record [m, rad]."""
    return {
        **asdict(errors),
        "of_bound_squared": of_bound_squared,
        "parameters": parameters.tolist(),
    }


def is_errors(found: Any) -> bool:
    """Return whether a document has the errors of one estimator, or how it failed."""
    if has_keys(found, {"failure"}):
        return is_failure(found["failure"])
    return (
        has_keys(found, {*SCALARS, "parameters"})
        and all(_is_number(found[name]) for name in SCALARS)
        and isinstance(found["parameters"], list)
        and len(found["parameters"]) == _N_PARAMETERS
        and all(map(_is_number, found["parameters"]))
    )


def has_keys(found: Any, keys: set[str]) -> bool:
    """Return whether a document is an object with exactly these keys."""
    return isinstance(found, dict) and found.keys() == keys


def _is_number(found: Any) -> bool:
    return isinstance(found, float | int) and not isinstance(found, bool) and isfinite(found)
