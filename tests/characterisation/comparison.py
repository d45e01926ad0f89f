"""When a recorded fact and a new one agree."""

from __future__ import annotations

import os
import re
from dataclasses import dataclass
from typing import Any

import numpy as np

SIGMAS = float(os.environ.get("LEGCAL_CHARACTERISATION_SIGMAS", "0.02"))
STRICT = SIGMAS < 1e-3
ROUNDING = 1e-11  # of numbers that are zero but for rounding [m, rad]
OF_SIGMA = max(1e-6, SIGMAS) if STRICT else 0.01  # of standard deviations, relative
OTHERWISE = 1e-6 if STRICT else 1e-4  # of other numbers, relative

# Where numbers may differ more: path, relative difference, times the sigma of parameters.
# Costs follow the noise of a fit, places of cameras have larger sigmas than joints, and the
# four steps end where IPOPT's tolerance lets them.
LOOSER: tuple[tuple[str, float, float], ...] = (
    (r"\.(sigma\w*|\w+_sigma|expected\w*|bound)\b", OF_SIGMA, 1.0),
    (r"\.(chi2|rms\w*|p_value|statistic|noise|shared_px|noise_px|gammas?)\b", 10 * OTHERWISE, 1.0),
    (r"\.T_\w+\.", OTHERWISE, 20.0),
    (r"\.stages\.", 10 * OTHERWISE, 20.0),
    (r"\.(weakest|sensitivities|explanations|holdout)\b", OF_SIGMA, 1.0),
)

# What nothing is estimated for: numbers of models, and correlations, which are absolute.
EXACT = re.compile(r"\.(nominal|nominal_axes|radius|sign)\b")
OF_MODELS = re.compile(r"\.(legs\[\d+\]|parameters\[\d+\])\.")
CORRELATION = re.compile(r"\.correlation\[\d+\]$")


@dataclass(frozen=True)
class Scale:
    """Standard deviations of the calibration that numbers come from; zero without one."""

    sigma: dict[str, float]

    @property
    def typical(self) -> float:
        """The median of all [m, rad]."""
        return float(np.median(list(self.sigma.values()))) if self.sigma else 0.0


NO_SCALE = Scale({})


def scale_of(document: Any) -> Scale:
    """Return the standard deviations that a result states."""
    if isinstance(document, dict) and "parameters" not in document:
        document = document.get("result.json")
    rows = document.get("parameters") if isinstance(document, dict) else None
    if not isinstance(rows, list):
        return NO_SCALE
    return Scale(
        {
            row["name"]: row["sigma"]
            for row in rows
            if isinstance(row, dict) and row.get("unit") in {"m", "rad"} and row.get("sigma")
        }
    )


def differences(expected: Any, found: Any, scale: Scale = NO_SCALE, path: str = "") -> list[str]:
    """Return one line for each fact that is another one; none where all agree."""
    if isinstance(expected, dict) and isinstance(found, dict):
        return _of_mappings(expected, found, scale, path)
    if isinstance(expected, list) and isinstance(found, list):
        if len(expected) != len(found):
            return [f"{path}: {len(found)} entries, expected {len(expected)}"]
        pairs = enumerate(zip(expected, found, strict=True))
        return [x for i, (e, f) in pairs for x in differences(e, f, scale, f"{path}[{i}]")]
    if isinstance(expected, float) and isinstance(found, float | int):
        within = _tolerance(path, expected, scale)
        if abs(expected - found) <= within:
            return []
        return [f"{path}: {found!r}, expected {expected!r} within {within:.3g}"]
    if isinstance(found, float) and type(expected) is int:
        return differences(float(expected), found, scale, path)
    return [] if expected == found else [f"{path}: {found!r}, expected {expected!r}"]


def _of_mappings(
    expected: dict[str, Any], found: dict[str, Any], scale: Scale, path: str
) -> list[str]:
    lost, new = sorted(expected.keys() - found.keys()), sorted(found.keys() - expected.keys())
    told = [f"{path}.{name}: lost" for name in lost] + [f"{path}.{name}: new" for name in new]
    sigma = expected.get("sigma")
    if not isinstance(sigma, float) or not sigma:
        sigma = scale.sigma.get(str(expected.get("name")), 0.0)
    for name in expected.keys() & found.keys():
        one, other = expected[name], found[name]
        here = f"{path}.{name}"
        if name in {"value", "difference", "change"} and sigma and isinstance(one, float):
            within = SIGMAS * sigma + ROUNDING * max(1.0, abs(one))
            if not isinstance(other, float | int) or abs(one - other) > within:
                told.append(f"{here}: {other!r}, expected {one!r} within {SIGMAS} sigma")
            continue
        told += differences(one, other, scale, here)
    return told


def _tolerance(path: str, expected: float, scale: Scale) -> float:
    if CORRELATION.search(path):
        return 2e-4 if STRICT else 1e-2
    if EXACT.search(path) or (not scale.sigma and OF_MODELS.search(path)):
        return 1e-8 * abs(expected) + ROUNDING
    relative, times = OTHERWISE, 1.0
    for pattern, looser, factor in LOOSER:
        if re.search(pattern, path):
            relative, times = max(relative, looser), max(times, factor)
    return relative * abs(expected) + times * SIGMAS * scale.typical + ROUNDING
