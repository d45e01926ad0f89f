"""The options of ``legcal new`` that describe a machine; the command line takes them from here.

Nothing but the standard library is imported here, so that help and completion answer at once.
:func:`legcal.machine.family.description_of` makes a machine of them.
"""

from __future__ import annotations

from dataclasses import dataclass, field, fields
from typing import Any, Literal

from legcal.option_fields import option


@dataclass(frozen=True, kw_only=True)
class Dimensions:
    """A machine by a family and its dimensions, or what stands beside a table; None if not given.

    Lengths are in ``unit``, angles in degrees.
    """

    family: str | None = field(
        default=None,
        metadata=option(
            "Instead of a table: number and type of legs, 6-UPS; or hexaglide, 3-prs, "
            "linear-delta, orthoglide, delta or servo-hexapod, whose dimensions have defaults."
        ),
    )
    unit: str | None = field(default=None, metadata=option("Unit of all lengths: mm or m."))
    name: str | None = field(default=None, metadata=option("Name of the model and its files."))
    base_radius: float | None = field(
        default=None, metadata=option("Radius of the circle of base joints.")
    )
    platform_radius: float | None = field(
        default=None, metadata=option("Radius of the circle of platform joints.")
    )
    height: float | None = field(
        default=None, metadata=option("Height of the platform above the base.")
    )
    base_spread: float | None = field(
        default=None,
        metadata=option(
            "Angle between the base joints of a pair (6 legs), in degrees; default 30."
        ),
    )
    platform_spread: float | None = field(
        default=None,
        metadata=option("Angle between the platform joints of a pair, in degrees; default 30."),
    )
    turn: float | None = field(
        default=None,
        metadata=option("Rotation of the platform about z, in degrees; default 0, planar 30."),
    )
    offset: float | None = field(default=None, metadata=option("Leg length at reading zero."))
    travel: tuple[float, float] | None = field(
        default=None, metadata=option("Lowest and highest reading; degrees where motors turn.")
    )
    min_length: float | None = field(
        default=None,
        metadata=option("Shortest length of a leg, where readings are zero; without --offset."),
    )
    max_length: float | None = field(
        default=None, metadata=option("Longest length of a leg, in place of --travel.")
    )
    leg_radius: float | None = field(default=None, metadata=option("Radius of tube and rod."))
    arm_length: float | None = field(
        default=None, metadata=option("Length of the arms of a delta, or horns of servos.")
    )
    arm_radius: float | None = field(
        default=None, metadata=option("Radius of arms that are cylinders; boxes without it.")
    )
    rod_length: float | None = field(
        default=None, metadata=option("Length of rods on carriages or arms.")
    )
    rod_spacing: float | None = field(
        default=None, metadata=option("Distance of the two rods of a parallelogram.")
    )
    type: str | None = field(
        default=None, metadata=option("Type of the legs of a table that has none: UPS.")
    )
    platform_in: Literal["base", "platform"] | None = field(
        default=None,
        metadata=option(
            "What the platform joints of a table are coordinates of: the platform, or the "
            "base with the machine at home."
        ),
    )
    tilt: float | None = field(
        default=None,
        metadata=option("Tilt of R and U axes from their default, in degrees; default 0."),
    )

    def stated(self) -> dict[str, Any]:
        """Return what is given, by its name."""
        found = {each.name: getattr(self, each.name) for each in fields(self)}
        return {name: value for name, value in found.items() if value is not None}
