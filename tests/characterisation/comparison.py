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

DIGEST = re.compile(r"[0-9a-f]{64}$")  # of a table: its last digits are rounding

# What nothing is estimated for: numbers of models, and correlations, which are absolute.
EXACT = re.compile(r"\.(nominal|nominal_axes|radius|sign)\b")
OF_MODELS = re.compile(r"\.(legs\[\d+\]|parameters\[\d+\])\.")
COUNTED = re.compile(r"\.(dof|outlines|used|rejected|n_\w+|lines|length)\b")
CORRELATION = re.compile(r"\.correlation\[\d+\]$")


# Which pixels and outlines count is decided by thresholds, so that rounding decides of a few: a
# change of 4e-16 of the lengths of its model moved the 3-RPR of six photographs by 1.3 sigma in
# the code that these values were recorded from. Numbers of such a session agree roughly.
ROUGHLY = 3.0  # sigmas
ROUGH_SHARE = 0.3  # of other numbers, relative
# Of such a session these say which side of a threshold single outlines are on: whether the four
# steps suffice, sizes of errors that outlines share, which parameters of alike size are named, why
# outlines are not used, which files a detection has written; of repeats how many there are, the
# largest of them and its place, and how far shaded edges are from Canny's.
OPEN = re.compile(
    r"\.(stages|noise|shared_px|weakest|notes|rejected|upper_bound\w*|orientations|axes"
    r"|outlines_found|without_M_LS|difference\.\w+\.(mean|rms)|detection\.json\.files)$"
)
# Spreads of repeats are compared where both are of as many outlines: one that is bad counts most.
HOW_MANY = ("outlines_found", "samples")
WORST = re.compile(r"\.(\w+_ax[ei]s|home|change_d\w+|d[EX]_\w+)\b")  # as the worst parameter
# Which parameters count as weak is a threshold too; where two sessions do not agree on it, these
# are of different unknowns.
ADDED = re.compile(  # to documents and folders since they were recorded
    r"\.(document|(result|detection)\.json)(\.observations|\.details|\.links|\.explanations\.keys\.links|\.stages\.staged\.from_fit"
    r"|\.board\.(corners|used|images|off)|\.left_out|\.unreached|\.motor_rank"
    r"|\.weakest\[\d+\]\.links|\.platform_board|\.base_frame|\.home|\.legs\[\d+\]\.(travel|q_home))$"
    r"|/truth\.json\.settings\.(platform_board|plan|lengths|angles)$|\.files\.(staged\.(urdf|yaml)|report\.html|photographs/.*)$"
)
OF_UNKNOWNS = {"parameters", "covariance", "kinematic", "held", "base_axes", "platform_axes"}


def without_verdict(step: dict[str, Any]) -> dict[str, Any]:
    """Return a calibration without whether it is trusted, which exit codes 0 and 1 say too."""
    document = step["document"]
    if step["exit"] not in {0, 1} or "trustworthy" not in document:
        return step
    document = {name: value for name, value in document.items() if name != "trustworthy"}
    return step | {"exit": None, "document": document}


@dataclass(frozen=True)
class Scale:
    """Standard deviations of the calibration that numbers come from; zero without one."""

    sigma: dict[str, float]
    rough: bool = False  # whether they come from outlines that were searched in photographs

    @property
    def sigmas(self) -> float:
        """How many of them parameters may differ."""
        return ROUGHLY if self.rough else SIGMAS

    @property
    def largest(self) -> float:
        """The largest of all [m, rad]."""
        return max(self.sigma.values(), default=0.0)

    @property
    def typical(self) -> float:
        """The median of all [m, rad]."""
        return float(np.median(list(self.sigma.values()))) if self.sigma else 0.0


NO_SCALE = Scale({})


def scale_of(document: Any, *, rough: bool = False) -> Scale:
    """Return the standard deviations that a result states."""
    if isinstance(document, dict) and "parameters" not in document:
        document = document.get("result.json")
    rows = document.get("parameters") if isinstance(document, dict) else None
    if not isinstance(rows, list):
        return Scale({}, rough)
    return Scale(
        {
            row["name"]: row["sigma"]
            for row in rows
            if isinstance(row, dict) and row.get("unit") in {"m", "rad"} and row.get("sigma")
        },
        rough,
    )


def differences(expected: Any, found: Any, scale: Scale = NO_SCALE, path: str = "") -> list[str]:
    """Return one line for each fact that is another one; none where all agree."""
    if scale.rough and (OPEN.search(path) or _is_of_few(expected, found)):
        return []
    if isinstance(expected, dict) and isinstance(found, dict):
        return _of_mappings(expected, found, scale, path)
    if isinstance(expected, list) and isinstance(found, list):
        if len(expected) != len(found):
            return [f"{path}: {len(found)} entries, expected {len(expected)}"]
        if scale.rough and path.endswith("_axis") and np.dot(expected, found) < 0.0:
            found = [-x for x in found]  # one in the plane of the base has no direction
        pairs = enumerate(zip(expected, found, strict=True))
        return [x for i, (e, f) in pairs for x in differences(e, f, scale, f"{path}[{i}]")]
    if isinstance(expected, float) and isinstance(found, float | int):
        within = _tolerance(path, expected, scale)
        if abs(expected - found) <= within:
            return []
        return [f"{path}: {found!r}, expected {expected!r} within {within:.3g}"]
    if type(expected) is int and (isinstance(found, float) or (scale.rough and type(found) is int)):
        return differences(float(expected), float(found), scale, path)
    if isinstance(expected, str) and isinstance(found, str) and DIGEST.match(expected):
        return [] if DIGEST.match(found) else [f"{path}: {found!r}, expected a digest"]
    return [] if expected == found else [f"{path}: {found!r}, expected {expected!r}"]


def _is_of_few(expected: Any, found: Any) -> bool:
    """Say whether one of two spreads could not be told, for too few outlines of a leg."""
    spreads = [one for one in (expected, found) if isinstance(one, dict) and "ratio_low" in one]
    return len(spreads) == 1 and (expected is None or found is None)


def _of_mappings(
    expected: dict[str, Any], found: dict[str, Any], scale: Scale, path: str
) -> list[str]:
    lost, new = sorted(expected.keys() - found.keys()), sorted(found.keys() - expected.keys())
    told = [f"{path}.{name}: lost" for name in lost]
    told += [f"{path}.{name}: new" for name in new if not ADDED.search(f"{path}.{name}")]
    if "correlation" in expected and "correlation" in found:
        expected, found = _of_variables(expected), _of_variables(found)
    if scale.rough and "reference" in expected:  # parameters of the result, less those of the truth
        return told
    if scale.rough and any(expected.get(name) != found.get(name) for name in HOW_MANY):
        return told
    if scale.rough and "ratio_low" in expected:
        return told + _of_spread(expected, found, path)
    if scale.rough and _weak_names(expected) != _weak_names(found):
        expected = {name: value for name, value in expected.items() if name not in OF_UNKNOWNS}
    sigma = expected.get("sigma")
    if not isinstance(sigma, float) or not sigma:
        sigma = scale.sigma.get(str(expected.get("name")), 0.0)
    for name in expected.keys() & found.keys():
        one, other = expected[name], found[name]
        here = f"{path}.{name}"
        if name in {"value", "difference", "change"} and sigma and isinstance(one, float):
            within = scale.sigmas * sigma + ROUNDING * max(1.0, abs(one))
            if not isinstance(other, float | int) or abs(one - other) > within:
                told.append(f"{here}: {other!r}, expected {one!r} within {scale.sigmas} sigma")
            continue
        told += differences(one, other, scale, here)
    return told


def _of_spread(expected: dict[str, Any], found: dict[str, Any], path: str) -> list[str]:
    """Compare standard deviations of few repeats by the interval that is stated for them."""
    apart = expected["ratio_high"] / expected["ratio_low"]
    return [
        f"{path}.{name}: {found[name]!r}, expected {expected[name]!r} to a factor of {apart:.3g}"
        for name in ("sd", "claimed", "ratio")
        if not 1.0 / apart <= found[name] / expected[name] <= apart
    ]


def _weak_names(result: dict[str, Any]) -> list[str]:
    """Return the parameters that a result calls weak; none where this is no result."""
    rows = result.get("parameters") if "legcal_result" in result else None
    return [row["name"] for row in rows or [] if row["status"] == "weak"]


def _of_variables(covariance: dict[str, Any]) -> dict[str, Any]:
    """Return a covariance without the correlations of what is held: its sigma is rounding."""
    held = np.array(covariance["sigma"]) < ROUNDING**1.5
    row, column = np.tril_indices(len(held), -1)
    correlation = np.where(held[row] | held[column], 0.0, covariance["correlation"])
    sigma = [0.0 if h else s for h, s in zip(held, covariance["sigma"], strict=True)]
    return covariance | {"sigma": sigma, "correlation": correlation.tolist()}


def _tolerance(path: str, expected: float, scale: Scale) -> float:
    if scale.rough and not EXACT.search(path):
        many = COUNTED.search(path) or CORRELATION.search(path)
        share = ROUGH_SHARE * max(abs(expected), 1.0 if many else 0.0)
        sigma = scale.largest if WORST.search(path) else scale.typical
        return share + ROUGHLY * sigma + ROUNDING
    if CORRELATION.search(path):
        return 2e-4 if STRICT else 1e-2
    if EXACT.search(path) or (not scale.sigma and OF_MODELS.search(path)):
        return 1e-8 * abs(expected) + ROUNDING
    relative, times = OTHERWISE, 1.0
    for pattern, looser, factor in LOOSER:
        if re.search(pattern, path):
            relative, times = max(relative, looser), max(times, factor)
    return relative * abs(expected) + times * SIGMAS * scale.typical + ROUNDING
