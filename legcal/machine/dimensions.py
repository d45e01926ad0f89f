"""What ``legcal new`` is told of a machine beside a table, or in place of one.

:func:`legcal.machine.family.description_of` builds the machine.
"""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import Any


@dataclass(frozen=True, kw_only=True)
class Dimensions:
    """Numbers given beside a table, or a family and its dimensions; None if not given.

    Lengths are in ``unit``.
    """

    family: str | None = None  # hexapod or delta, in place of a table
    unit: str | None = None
    name: str | None = None  # of the model and its files
    type: str | None = None  # of the legs: UPS
    min_length: float | None = None  # of a leg, where readings are zero
    max_length: float | None = None
    leg_radius: float | None = None  # of tube and rod
    height: float | None = None  # of the platform above the base at home
    base_radius: float | None = None  # of the circle of base joints, or motors
    platform_radius: float | None = None  # of the circle of platform joints
    arm_length: float | None = None  # of a delta
    rod_length: float | None = None  # of a delta

    def stated(self) -> dict[str, Any]:
        """Return the given dimensions by name."""
        dimensions = {field.name: getattr(self, field.name) for field in fields(self)}
        return {name: value for name, value in dimensions.items() if value is not None}
