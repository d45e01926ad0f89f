"""How well a machine is built: what its parts may be off their model, stated or assumed.

They are thresholds of doubts: a fit whose parameters moved far beyond them has been led away more
likely than the machine was built that badly. Where few images are to tell one group of parameters
(``--only``), they are priors as well (:mod:`legcal.calibration.joint_fit.part_errors`).
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, fields, replace
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import BeforeValidator, Field, WithJsonSchema, model_validator

from legcal.errors import BadValue
from legcal.files.quantity import Quantity, read_value
from legcal.files.schema import FileSchema, describe
from legcal.machine.leg import AXES, Leg, ParameterId

MachineKind = Literal["printed", "machined", "bought"]

# Where nothing is stated: parts of the mean leg length, and angles. The search for legs and the
# fit rely on a model about that good.
_PART_OF_SIZE = 0.01
_PART_OF_ZERO = 0.05
_ANGLE = math.radians(3.0)
_ANGLE_AT_ZERO = math.radians(5.0)
# Screws of tolerance class 10 (ISO 3408) may be 0.07 % off, hobby screws and belts 0.1 to 0.5 %
PART_OF_TRAVEL = 0.002
_MOST_OF_TRAVEL = 0.01


def _stated(*dimensions: str) -> BeforeValidator:
    """Return what reads a standard deviation: a number in SI units, or text with a unit."""

    def read(given: Any) -> Quantity:
        if isinstance(given, Quantity):
            return given
        if isinstance(given, bool) or not isinstance(given, int | float | str):
            raise ValueError(
                f"found {describe(given)}, needed one standard deviation; write a number in SI "
                "units or with its unit."
            )
        found = read_value(given if isinstance(given, str) else repr(float(given)))
        if found.dimension not in ("", *dimensions):
            raise ValueError(
                f"found {describe(given)}, needed a value in {' or '.join(dimensions)}; correct "
                "its unit."
            )
        if not found.value > 0.0:
            raise BadValue(
                describe(given), "a standard deviation above zero", "state how well it is built"
            )
        return found

    return BeforeValidator(read)


def _read_part(given: Any) -> float:
    """Read a standard deviation as a part: a number, or text in per cent."""
    text = given.strip() if isinstance(given, str) else describe(given)
    try:
        part = float(text[:-1]) / 100.0 if text.endswith("%") else float(text)
    except ValueError:
        part = math.nan
    if not 0.0 < part <= _MOST_OF_TRAVEL:
        raise BadValue(
            describe(given),
            f"a part of the travel up to {_MOST_OF_TRAVEL:.0%}",
            "write per cent with their sign, such as 0.02%",
        )
    return part


_SCHEMA = WithJsonSchema({"anyOf": [{"type": "number", "exclusiveMinimum": 0}, {"type": "string"}]})
_Length = Annotated[Quantity, _stated("m"), _SCHEMA]
_Angle = Annotated[Quantity, _stated("rad"), _SCHEMA]
_Zero = Annotated[Quantity, _stated("m", "rad"), _SCHEMA]
_Part = Annotated[float, BeforeValidator(_read_part), _SCHEMA]


class ToleranceEntry(FileSchema):
    """One standard deviation of each kind of number of a model."""

    joints: _Length | None = None  # coordinates of joint centres
    axes: _Angle | None = None  # directions of axes
    lengths: _Length | None = None  # of rods and constant legs
    zeros: _Zero | None = None  # of motors, in their unit
    travel: _Part | None = None  # of all motors that slide alike, as a part of it


class BuiltEntry(FileSchema):
    """What a file says of how well its machine is built."""

    tolerance: ToleranceEntry | None = None
    machine_kind: MachineKind | None = None
    spline_teeth: Annotated[int, Field(ge=4, le=200)] | None = None  # of the shafts of all servos

    @model_validator(mode="after")
    def _says_it_once(self) -> BuiltEntry:
        if self.tolerance is not None and self.machine_kind is not None:
            raise ValueError(
                "found tolerance and machine_kind, needed one of them; remove machine_kind."
            )
        return self

    @property
    def built(self) -> Tolerance | None:
        """The tolerance that is stated; None where nothing is."""
        if self.machine_kind is not None:
            return TYPICAL[self.machine_kind]
        stated = self.tolerance
        return (
            None
            if stated is None
            else Tolerance(
                _value(stated.joints),
                _value(stated.axes),
                _value(stated.lengths),
                _value(stated.zeros, "m"),
                _value(stated.zeros, "rad"),
                stated.travel,
            )
        )


def _value(stated: Quantity | None, dimension: str = "") -> float | None:
    """Return what is stated, None where it is of another dimension."""
    if stated is None or (dimension and stated.dimension not in ("", dimension)):
        return None
    return stated.value


@dataclass(frozen=True)
class Tolerance:
    """Standard deviations of the numbers of a model [m, rad]; None where nothing is stated."""

    joints: float | None = None
    axes: float | None = None
    lengths: float | None = None
    zeros: float | None = None  # of motors that read a length
    angles_at_zero: float | None = None  # of motors that turn
    # Of the travel of all motors that slide alike, as a part of it: pitches of screws and belts.
    # Readings are exact in the fit; what this does to the platform is stated beside its sigma.
    travel: float | None = None

    @property
    def says_parts(self) -> bool:
        """Whether something is stated beside the travel."""
        return replace(self, travel=None) != NOT_STATED

    @property
    def entries(self) -> dict[str, Any]:
        """The keys of a file that state it."""
        if (
            kind := next((k for k, typical in TYPICAL.items() if typical == self), None)
        ) is not None:
            return {"machine_kind": str(kind)}
        zeros: float | str | None = self.zeros
        if self.zeros != self.angles_at_zero:  # of one dimension
            unit = "rad" if self.zeros is None else "m"
            zeros = f"{self.zeros or self.angles_at_zero!r} {unit}"
        numbers = {"joints": self.joints, "axes": self.axes, "lengths": self.lengths}
        others = {"zeros": zeros, "travel": self.travel}
        stated = {name: x for name, x in {**numbers, **others}.items() if x is not None}
        return {"tolerance": stated} if stated else {}

    def completed(self, size: float) -> Tolerance:
        """Return all of them, rough ones where nothing is stated; *size* is the mean leg length."""
        rough = (_PART_OF_SIZE * size, _ANGLE, _PART_OF_SIZE * size, _PART_OF_ZERO * size)
        names = [one.name for one in fields(self)]
        assumed = dict(zip(names, (*rough, _ANGLE_AT_ZERO, PART_OF_TRAVEL), strict=True))
        return Tolerance(**{n: getattr(self, n) or assumed[n] for n in names})

    def of_parameters(
        self, names: tuple[str, ...], legs: Mapping[str, Leg], size: float
    ) -> dict[str, float]:
        """Return the tolerances of kinematic parameters by name [m, rad]; gains have none.

        *size* is the mean leg length. Joints on an actuator at reading zero follow its zero too.
        """
        full, found = self.completed(size), dict[str, float]()
        joints, axes, lengths, zeros, turn, _ = (
            float(getattr(full, one.name) or 0.0) for one in fields(full)
        )
        of_kind = {
            **dict.fromkeys(("base", "platform", "axis_point", "arm_point"), joints),
            **dict.fromkeys((*AXES, "twist", "direction", "axis", "arm_axis"), axes),
            "length": lengths,
            "offset": zeros,
        }
        for name in names:
            number = ParameterId.parse(name)
            kind, leg = number.kind, legs.get(number.owner)
            if kind == "base" and leg is not None and leg.actuator is not None:
                moved = float(np.linalg.norm(leg.actuator.motion(leg.A, np.zeros(1)).by_q))
                found[name] = float(np.hypot(joints, moved * (turn if leg.reads_angle else zeros)))
            elif kind in of_kind:
                found[name] = of_kind[kind]
        return found


NOT_STATED = Tolerance()

# Typical machines of each kind: 3D printed parts on a flat board, milled parts on machined plates,
# a product with a data sheet. They move by belts or hobby screws, by ball screws, by either.
TYPICAL: Mapping[MachineKind, Tolerance] = {
    "printed": Tolerance(0.5e-3, math.radians(1.0), 0.5e-3, 5e-3, math.radians(5.0), 3e-3),
    "machined": Tolerance(0.1e-3, math.radians(0.2), 0.1e-3, 2e-3, math.radians(2.0), 5e-4),
    "bought": Tolerance(0.2e-3, math.radians(0.2), 0.1e-3, 1e-3, math.radians(1.0), 1e-3),
}
