"""The numbers of a calibrated machine as people read them: what tables, pages and files show.

``result.json`` has them in SI units; here they are in mm, degrees and pixels, with their frames.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import TYPE_CHECKING

from legcal.files.quantity import SHOWN_IN
from legcal.machine.leg import ParameterId

if TYPE_CHECKING:
    from legcal.calibration.documents import FrameMark, Result
    from legcal.vision.board import Link

FRAMES: dict[str, str] = {"base": "R_b", "platform": "R_e"}
DIGITS = {"mm": 4, "deg": 4, "px": 3, "": 6}  # decimals by unit


def mm_deg(dX_m: float, dE_rad: float) -> str:
    """Return an error of the platform in words."""
    return f"{1e3 * dX_m:.3f} mm / {math.degrees(dE_rad):.4f} deg"


@dataclass(frozen=True)
class Quantity:
    """A number of a machine, and how well it is known."""

    name: str  # as in result.json; ``leg1.base.x`` may be along x of the link or of R_b
    frame: str  # a link, R_b or R_e; "" if independent of a frame
    unit: str  # mm, deg, px or nothing
    value: float
    nominal: float | None = None  # None without a result
    sigma: float | None = None  # None if not estimated
    # estimated, fixed, weak, frame (zero by definition of it), derived (from estimated quantities),
    # or model (without a result)
    status: str = "model"
    defines: FrameMark | None = None  # the part of its frame that the joint defines

    @classmethod
    def of(
        cls,
        name: str,
        frame: str,
        unit: str,
        numbers: tuple[float, float | None, float | None],
        status: str = "model",
        defines: FrameMark | None = None,
    ) -> Quantity:
        """Return a quantity from its value, nominal value and sigma in metres or radians."""
        scale, shown = SHOWN_IN[unit]
        value, *others = numbers
        nominal, sigma = (None if x is None else scale * x for x in others)
        return cls(name, frame, shown, scale * value, nominal, sigma, status, defines)

    @property
    def parameter(self) -> ParameterId:
        """The parsed name."""
        return ParameterId.parse(self.name)

    @property
    def change(self) -> float | None:
        """Value minus nominal."""
        return None if self.nominal is None else self.value - self.nominal

    @property
    def digits(self) -> int:
        """The number of decimals that people are shown."""
        return DIGITS[self.unit]


def parameters_of(result: Result) -> list[Quantity]:
    """Return the parameters of a result that tables have, joints and axes in R_b and R_e."""
    return [
        Quantity.of(
            row.name, frame_of(row.name), row.unit, (row.value, row.nominal, row.sigma), row.status
        )
        for row in result.parameters
        if row.is_shown
    ]


def frame_of(name: str) -> str:
    """Return the frame of a parameter; "" if it has none."""
    parameter = ParameterId.parse(name)
    side = parameter.kind.removesuffix("_axis")
    return FRAMES[side] if parameter.component and side in FRAMES else ""


def joints_of(result: Result, *sides: Link) -> Iterator[Quantity]:
    """Yield the coordinates of the joints in the links of the model."""
    for side, block in result.links.items():
        for joint in block.joints if side in (sides or FRAMES) else ():
            for k, axis in enumerate("xyz"):
                numbers = joint.xyz[k], joint.nominal[k], joint.sigma[k]
                name = f"{joint.leg}.{side}.{axis}"
                yield Quantity.of(name, block.link, "m", numbers, joint.status[k], joint.defines)


def turns_of(result: Result) -> Iterator[Quantity]:
    """Yield the turns of the axes of joints from the nominal ones, about the axes of the links."""
    for side, block in result.links.items():
        for turned in block.axes:
            status = "fixed" if turned.sigma is None else "estimated"
            for k, axis in enumerate("xyz"):
                sigma = None if turned.sigma is None else turned.sigma[k]
                name = f"{turned.leg}.{side}_axis.{axis}"
                yield Quantity.of(name, block.link, "rad", (turned.turn[k], 0.0, sigma), status)
