"""Quantities as people write them in options: a number and its unit, ``2mm``."""

import math
import re
from collections.abc import Mapping

from legcal.errors import UsageError
from legcal.files.schema import describe

LENGTH: Mapping[str, float] = {"mm": 1e-3, "um": 1e-6, "nm": 1e-9, "cm": 1e-2, "m": 1.0}
ANGLE: Mapping[str, float] = {"deg": math.pi / 180.0, "mrad": 1e-3, "rad": 1.0}
PIXELS: Mapping[str, float] = {"px": 1.0}

_WRITTEN = re.compile(r"\s*([-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?)\s*([A-Za-z]*)\s*", re.ASCII)


def parse_quantity(text: str, units: Mapping[str, float], what: str) -> float:
    """Return a quantity in metres, radians or pixels.

    Parameters
    ----------
    text : str
        A number and its unit: ``2mm``, ``0.05 deg``. Zero may do without one.
    units : mapping
        The units that it may be written in, with their size in SI.
    what : str
        What it is for, for the message: ``--pixel-noise``.

    Raises
    ------
    UsageError
        If it is no number, has no unit or one of something else, or is negative.
    """
    match = _WRITTEN.fullmatch(text)
    value, unit = (float(match[1]), match[2]) if match else (math.nan, "")
    if not math.isfinite(value) or (unit not in units and (unit or value != 0.0)):
        raise UsageError(
            f"{what} could not be used: found {describe(text)}, needed a number and its unit "
            f"({', '.join(units)}), such as 0.5{next(iter(units))}; write the unit behind the "
            "number."
        )
    if value < 0.0:
        raise UsageError(
            f"{what} could not be used: found the negative {describe(text)}, needed zero or more; "
            "leave out the sign."
        )
    return value * units.get(unit, 1.0)
