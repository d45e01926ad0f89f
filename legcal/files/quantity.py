"""A stated number with its unit and standard deviation: ``420±0.1 mm``."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from numbers import Real

from legcal.errors import UsageError
from legcal.files.schema import describe

LENGTH: Mapping[str, float] = {
    "mm": 1e-3, "um": 1e-6, "nm": 1e-9, "cm": 1e-2, "m": 1.0, "in": 0.0254, "ft": 0.3048
}  # fmt: skip
ANGLE: Mapping[str, float] = {"deg": math.pi / 180.0, "mrad": 1e-3, "rad": 1.0, "rev": math.tau}
PIXELS: Mapping[str, float] = {"px": 1.0}
# Units shown in place of those of files, and their factors
SHOWN_IN: Mapping[str, tuple[float, str]] = {
    "m": (1e3, "mm"),
    "rad": (math.degrees(1.0), "deg"),
    "px": (1.0, "px"),
    "": (1.0, ""),
}

_NUMBER = r"\s*([-+]?(?:\d+(?:\.\d*)?|\.\d+)(?:[eE][-+]?\d+)?)\s*([A-Za-z]*)\s*"
_VALUE = re.compile(_NUMBER, re.ASCII)
_PLACEHOLDERS = {
    "MEASURED": "the measured value",
    "SIGMA": "the standard deviation of the measurement",
    "VALUE": "a value",
}
_PLACEHOLDER = re.compile("|".join(_PLACEHOLDERS))
_PRIOR = re.compile(rf"{_NUMBER}(?:±|\+/?-){_NUMBER}", re.ASCII)

COUNTS = r"\s*(\d+(?:\.\d*)?)\s*(?:counts?|steps?|ticks?)\s*/\s*([a-z]+)\s*"  # 80 counts/mm


def unit_size(name: str, units: Mapping[str, float]) -> float | None:
    """Return the size of a unit, also of counts with a stated scale; None if it is not known."""
    counts = re.fullmatch(COUNTS, name)
    if counts is None:
        return units.get(name)
    size = units.get(counts[2])
    return None if size is None or float(counts[1]) == 0.0 else size / float(counts[1])


def split_quantity(text: str) -> tuple[float, str]:
    """Return the number and the unit of a text, NaN and "" where it is none."""
    match = _VALUE.fullmatch(text)
    return (float(match[1]), match[2]) if match else (math.nan, "")


def parse_quantity(text: str, units: Mapping[str, float], name: str) -> float:
    """Return a quantity in metres, radians or pixels."""
    value, unit = split_quantity(text)
    if not math.isfinite(value) or (unit not in units and (unit or value != 0.0)):
        raise UsageError(
            f"{name} could not be used: found {describe(text)}, needed a number and its unit "
            f"({', '.join(units)}), such as 0.5{next(iter(units))}; write the unit behind the "
            "number."
        )
    if value < 0.0:
        raise UsageError(
            f"{name} could not be used: found the negative {describe(text)}, needed zero or more; "
            "leave out the sign."
        )
    return value * units.get(unit, 1.0)


MIN_SIGMA = 1e-9  # [m, rad, px]; more certain quantities are fixed
MAX_SIGMA = 1e6  # [m, rad, px]; less certain quantities have no prior

_DIMENSIONS = {"m": LENGTH, "rad": ANGLE, "px": PIXELS}
_SIZES = {unit: size for units in _DIMENSIONS.values() for unit, size in units.items()}
_DIMENSION = {unit: name for name, units in _DIMENSIONS.items() for unit in units}
EXAMPLE = "0.4200±0.0001 or 420±0.1 mm"
_NUMBERS = {"value": {"type": "number"}, "sigma": {"type": "number", "exclusiveMinimum": 0}}
PRIOR_SCHEMA = {  # JSON Schema of the input of read_prior
    "anyOf": [
        {"type": "string", "pattern": r"±|\+/?-"},
        {"type": "array", "prefixItems": [*_NUMBERS.values()], "minItems": 2, "maxItems": 2},
        {
            "type": "object",
            "properties": _NUMBERS,
            "required": [*_NUMBERS],
            "additionalProperties": False,
        },
    ]
}


@dataclass(frozen=True)
class Quantity:
    """A number with its dimension, and the sigma of a prior."""

    value: float  # in SI units or pixels
    sigma: float | None = None  # its standard deviation; None where there is none
    dimension: str = ""  # kind of its unit; "" if none was written


def read_prior(value: object) -> Quantity:
    """Return a prior given as text, as (value, sigma) or as {value, sigma}."""
    if isinstance(value, Quantity):
        return value
    if isinstance(value, str):
        return _read_prior_text(value)
    if isinstance(value, Mapping) and set(value) == {"value", "sigma"}:
        value = (value["value"], value["sigma"])
    if not isinstance(value, Sequence) or len(value) != 2 or not all(map(_is_number, value)):
        raise ValueError(
            f"found {describe(value)}, needed a value and its sigma; write it like {EXAMPLE}."
        )
    try:
        return _prior(float(value[0]), float(value[1]))
    except OverflowError as error:
        raise ValueError(
            "found a number beyond 1e308, needed a value and its sigma; correct it."
        ) from error


def _read_prior_text(text: str) -> Quantity:
    """Return the prior that a text states; a unit at its end counts for both numbers."""
    _refuse_placeholders(text)
    match = _PRIOR.fullmatch(text)
    if match is None:
        raise ValueError(
            f"found {describe(text.strip())}, needed a value and its sigma; write it like "
            f"{EXAMPLE}."
        )
    value, unit, sigma, unit_of_sigma = match.groups()
    if unit and not unit_of_sigma:
        raise ValueError(
            f"found {describe(text.strip())}, needed the unit of sigma too; write it at "
            f"the end, like {EXAMPLE}."
        )
    mean = read_value(value + (unit or unit_of_sigma))
    spread = read_value(sigma + unit_of_sigma)
    if mean.dimension != spread.dimension:
        raise ValueError(
            f"found {describe(text.strip())}, needed units of one kind; write both in one unit."
        )
    return _prior(mean.value, spread.value, mean.dimension)


def read_value(text: str) -> Quantity:
    """Parse a number with an optional unit."""
    _refuse_placeholders(text)
    match = _VALUE.fullmatch(text)
    if match is None or not math.isfinite(float(match[1])):
        raise ValueError(
            f"found {describe(text.strip())}, needed a number, with a unit or in SI units; "
            "write one, such as 0.42 or 420mm."
        )
    unit = match[2]
    if unit and unit not in _SIZES:
        raise ValueError(
            f"found the unknown unit '{unit}', needed one of {', '.join(_SIZES)}; leave it out "
            "for SI units and pixels."
        )
    return Quantity(_in_si(float(match[1]), unit), None, _DIMENSION.get(unit, ""))


def _refuse_placeholders(text: str) -> None:
    """Refuse text with a placeholder of a printed command in it."""
    if placeholder := _PLACEHOLDER.search(text):
        raise ValueError(
            f"found the placeholder {placeholder[0]}, needed a number; replace {placeholder[0]} by "
            f"{_PLACEHOLDERS[placeholder[0]]}."
        )


def _in_si(number: float, unit: str) -> float:
    """Return a number in SI units or pixels; 350 mm is exactly equal to 0.35 m."""
    size = _SIZES.get(unit, 1.0)
    per_one = round(1.0 / size)
    return number / per_one if math.isclose(per_one * size, 1.0, rel_tol=1e-12) else number * size


def _prior(value: float, sigma: float, dimension: str = "") -> Quantity:
    """Return a prior; refuse numbers that make none."""
    if not math.isfinite(value):
        raise ValueError(f"found the value {value:g}, needed a finite one; correct it.")
    if not MIN_SIGMA <= sigma <= MAX_SIGMA:
        raise ValueError(
            f"found the sigma {sigma:g}, needed one standard deviation from {MIN_SIGMA:g} to "
            f"{MAX_SIGMA:g}; correct it, fix the parameter at the value, or leave the prior out."
        )
    return Quantity(value, sigma, dimension)


def _is_number(value: object) -> bool:
    """Return whether a value is a real number; booleans are not."""
    return isinstance(value, Real) and not isinstance(value, bool)
