"""The options of ``legcal new`` that describe a machine; the command line takes them from here.

This module imports the standard library only, so that help and completion are fast.
:func:`legcal.machine.family.description_of` builds the machine.
"""

from __future__ import annotations

from dataclasses import dataclass, field, fields
from typing import Any

from legcal.option_fields import option

_FAMILY = "Dimensions of --family"


@dataclass(frozen=True, kw_only=True)
class Dimensions:
    """Numbers given beside a table, or a family and its dimensions; None if not given.

    Lengths are in ``unit``.
    """

    family: str | None = field(
        default=None, metadata=option("In place of a table: hexapod or delta.")
    )
    unit: str | None = field(default=None, metadata=option("Unit of all lengths: mm, m, in."))
    name: str | None = field(default=None, metadata=option("Name of the model and its files."))
    type: str | None = field(
        default=None, metadata=option("Type of the legs, where the table has none: UPS.")
    )
    min_length: float | None = field(
        default=None, metadata=option("Shortest length of a leg, where readings are zero.")
    )
    max_length: float | None = field(default=None, metadata=option("Longest length of a leg."))
    leg_radius: float | None = field(default=None, metadata=option("Radius of tube and rod."))
    height: float | None = field(
        default=None, metadata=option("Height of the platform above the base at home.")
    )
    base_radius: float | None = field(
        default=None, metadata=option("Radius of the circle of base joints, or motors.", _FAMILY)
    )
    platform_radius: float | None = field(
        default=None, metadata=option("Radius of the circle of platform joints.", _FAMILY)
    )
    arm_length: float | None = field(
        default=None, metadata=option("Length of the arms of a delta.", _FAMILY)
    )
    rod_length: float | None = field(
        default=None, metadata=option("Length of the rods of a delta.", _FAMILY)
    )

    def stated(self) -> dict[str, Any]:
        """Return the given dimensions by name."""
        dimensions = {field.name: getattr(self, field.name) for field in fields(self)}
        return {name: value for name, value in dimensions.items() if value is not None}
