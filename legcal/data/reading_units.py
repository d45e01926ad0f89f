"""Readings: from a number in a table to the joint value of a motor.

Tables have readings in m, of motors that turn in rad, unless ``readings`` in ``dataset.yaml`` says
otherwise: another unit of length or angle, or pulses of hobby servos, of which the model or the
dataset knows the centre and the us for one degree. Another unit than stated is recognised by the
travel of the motors (:func:`meanings`).
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import (
    BeforeValidator,
    GetJsonSchemaHandler,
    TypeAdapter,
    WithJsonSchema,
    model_validator,
)

from legcal.errors import BadValue, DatasetError, Problem, UsageError
from legcal.files.quantity import ANGLE, COUNTS, LENGTH, SHOWN_IN, split_quantity, unit_size
from legcal.files.schema import FileSchema, Number, closest, describe
from legcal.geometry.types import Array, BoolArray
from legcal.machine.actuator import Pulses
from legcal.machine.leg import Leg

PULSES = "us"
SERVO_SIGMA = math.radians(0.5)  # [rad], positioning error of a hobby servo
SIGMA_ANGLE = 1e-4  # [rad], default for a reading of a motor that turns
LEAST_SIGMA = 1e-6  # fraction of the travel: exact beside outlines, and not lost in rounding
MOST_SIGMA = 0.2  # maximum fraction of the travel: a worse encoder is most likely a wrong unit
# Units of motors that slide and that turn: all of them, and those that tables are usually in
UNITS = {False: (*LENGTH,), True: (*ANGLE, PULSES)}
USUAL_UNITS = {False: ("m", "mm", "cm", "in"), True: ("rad", "deg", PULSES)}
USUAL_PULSES = (400.0, 2700.0)  # [us] range of hobby servos
# Fractions of the travel in use: in the stated unit, and in another that is certainly meant
HARDLY_MOVES, SURELY_MOVES = 0.04, 0.5  # inches taken for mm use a 25th
_LONG_TRAVEL = 1.0  # [m]: small motions are likely where the travel is shorter
MIN_POSES = 5  # different poses: fewer are a check, perhaps close together


NEEDED_UNIT = (
    f"one of {', '.join((*UNITS[False], *UNITS[True]))}, or counts with their scale (80 counts/mm)"
)


def is_known(name: object) -> bool:
    """Return whether readings may have a unit."""
    return isinstance(name, str) and any(takes_unit(name, turns=turns) for turns in UNITS)


def takes_unit(name: str, *, turns: bool) -> bool:
    """Return whether the readings of a motor that slides or turns may have a unit."""
    return name in UNITS[turns] or unit_size(name, ANGLE if turns else LENGTH) is not None


def _unit_name(name: object) -> object:
    if not is_known(name):
        raise BadValue(describe(name), NEEDED_UNIT, "correct it")
    return name


ReadingUnitName = Annotated[
    str,
    BeforeValidator(_unit_name),
    WithJsonSchema(
        {"anyOf": [{"enum": [*UNITS[False], *UNITS[True]]}, {"pattern": f"^{COUNTS}$"}]}
    ),
]
_WORDS = {"m": "metres", "mm": "millimetres", "cm": "centimetres", "in": "inches",
          "rad": "radians", "deg": "degrees", PULSES: "pulses of servos"}  # fmt: skip


@dataclass(frozen=True)
class ReadingUnit:
    """A unit of the readings of one motor: joint value = size (reading - zero)."""

    name: str
    size: float = 1.0  # [m or rad]
    zero: float = 0.0  # the reading at joint value 0

    @property
    def words(self) -> str:
        """The unit as readings in it are called."""
        return _WORDS.get(self.name, self.name)

    def values(self, readings: Array) -> Array:
        """Return the joint values [m or rad] of readings."""
        return readings if self.name in ("m", "rad") else (readings - self.zero) * self.size

    def reading(self, value: float) -> float:
        """Return the reading at a joint value."""
        return value / self.size + self.zero


def legs_with_readings(legs: Sequence[Leg]) -> list[Leg]:
    """Return the legs that a table has readings of: the first of several rods on one actuator."""
    first_legs: dict[str, Leg] = {}
    for leg in legs:
        if leg.is_motor:
            first_legs.setdefault(str(leg.prismatic), leg)
    return list(first_legs.values())


def default_unit(leg: Leg) -> ReadingUnit:
    """Return the unit of readings of a leg where none is stated."""
    return ReadingUnit(leg.reading_unit)


def unit_named(name: str, leg: Leg, pulses: Pulses | None = None) -> ReadingUnit:
    """Return a unit for the readings of a leg.

    ValueError continues a sentence that names the entry.
    """
    motor, turns = leg.prismatic, leg.reads_angle
    if not takes_unit(name, turns=turns):
        raise ValueError(
            f"found {name} of '{motor}', which {'turns' if turns else 'slides'}, needed one of "
            f"{', '.join(UNITS[turns])}; correct it."
        )
    if name != PULSES:
        return ReadingUnit(name, unit_size(name, ANGLE if turns else LENGTH) or 1.0)
    pulses = pulses or (leg.actuator.pulses if leg.actuator is not None else None)
    if pulses is None:
        raise ValueError(
            f"found pulses of servos, and of '{motor}' neither centre nor us for one degree, "
            "needed both: centre_us and us_per_deg of it in legcal.motors of the model, or in the "
            f"dataset file readings: {{{motor}: {{unit: us, centre_us: 1500, us_per_deg: 11.1}}}}; "
            "add them."
        )
    return ReadingUnit(PULSES, math.radians(1.0) / pulses.per_degree, pulses.centre)


class ReadingsEntry(FileSchema):
    """The unit of the readings of one motor, in the block ``readings``."""

    unit: ReadingUnitName
    centre_us: Number | None = None  # pulse at joint value 0 [us]
    us_per_deg: Number | None = None  # negative where longer pulses turn the servo backwards

    @classmethod
    def __get_pydantic_json_schema__(
        cls, core_schema: Any, handler: GetJsonSchemaHandler
    ) -> dict[str, Any]:
        """Return the schema of an entry, or of a unit alone."""
        return {"anyOf": [handler(core_schema), TypeAdapter(ReadingUnitName).json_schema()]}

    @model_validator(mode="before")
    @classmethod
    def _unit_alone(cls, given: Any) -> Any:
        return {"unit": given} if isinstance(given, str) else given


def reading_units(
    path: Path, legs: Sequence[Leg], stated: str | Mapping[str, ReadingsEntry] | None
) -> dict[str, ReadingUnit]:
    """Return the unit of the readings of each motor, by its joint.

    A single unit applies to the motors of its kind, sliding or turning.
    """
    motors = {str(leg.prismatic): leg for leg in legs_with_readings(legs)}
    units = {name: default_unit(leg) for name, leg in motors.items()}
    if stated is None:
        return units
    problems = []
    if isinstance(stated, str):
        alike = [name for name, leg in motors.items() if takes_unit(stated, turns=leg.reads_angle)]
        entries = {name: ReadingsEntry(unit=stated) for name in alike}
        if not alike:
            slides = takes_unit(stated, turns=False)
            problems.append(
                f"{path}: readings could not be used: found {stated} and no motor that "
                f"{'slides' if slides else 'turns'}, needed "
                f"{'an angle or us' if slides else 'a length'}; correct it."
            )
    else:
        entries = dict(stated)
    for name, entry in entries.items():
        start = f"{path}: readings.{name} could not be used"
        if name not in motors:
            problems.append(
                f"{start}: found no motor of that name, needed one of {', '.join(motors)}; "
                f"{closest(name, [*motors])}"
            )
            continue
        try:
            pulses = Pulses.stated(
                entry.centre_us, entry.us_per_deg, turns=motors[name].reads_angle
            )
            units[name] = unit_named(entry.unit, motors[name], pulses)
        except ValueError as error:
            problems.append(f"{start}: {error}")
    if problems:
        raise DatasetError(problems)
    return units


def sigmas_of_legs(
    legs: Sequence[Leg],
    sigma_q: float,
    stated: Mapping[str, float] = MappingProxyType({}),
) -> Array:
    """Return the standard deviation of the reading of each leg, (n_legs,) [m or rad].

    It is the stated value of its motor, or else the usual one: *sigma_q* [m] for a sliding motor.
    """
    sigmas = [stated.get(str(leg.prismatic), usual_sigma(leg, sigma_q)) for leg in legs]
    least = LEAST_SIGMA * np.ptp(np.reshape([leg.travel for leg in legs], (-1, 2)), axis=1)
    return np.maximum(sigmas, np.where(np.isfinite(least), least, 0.0))


def stated_sigma(legs: Sequence[Leg], sigma_q: Array) -> float | dict[str, float]:
    """Return ``encoder_sigma`` of a dataset: by motor where they turn or differ, else one [m]."""
    motors = [j for j, leg in enumerate(legs) if leg.is_motor]
    sigma_of = {str(legs[j].prismatic): float(sigma_q[j]) for j in motors}
    if len({*sigma_of.values()}) > 1 or any(legs[j].reads_angle for j in motors):
        return sigma_of
    return float(sigma_q[motors[0] if motors else 0])


def are_commands(leg: Leg, unit: ReadingUnit | None = None) -> bool:
    """Return whether readings are commands to a hobby servo, and not measured positions.

    They are if their *unit* is pulses, or if the model describes the pulses of the servo: it has
    no other readings, whatever their unit.
    """
    is_servo = leg.actuator is not None and leg.actuator.pulses is not None
    return is_servo or (unit is not None and unit.name == PULSES)


def usual_sigma(leg: Leg, sigma_q: float, unit: ReadingUnit | None = None) -> float:
    """Return the default standard deviation [m or rad] of readings of a leg."""
    if not leg.reads_angle:
        return sigma_q
    return SERVO_SIGMA if are_commands(leg, unit) else SIGMA_ANGLE


def sigmas_of(
    stated: float | str | Mapping[str, float | str],
    legs: Sequence[Leg],
    units: Mapping[str, ReadingUnit] = MappingProxyType({}),
) -> dict[str, float]:
    """Return the standard deviations of readings [m or rad] that are stated, by motor.

    A number applies to every motor in its own unit [m or rad], a text with a unit (of lengths,
    angles, or pulses of *units*) to the motors of that kind, sliding or turning.
    """
    refused = "The encoder sigma (encoder_sigma, --encoder-sigma) could not be used"
    motors = {str(leg.prismatic): leg for leg in legs_with_readings(legs)}
    if not isinstance(stated, Mapping):
        unit = split_quantity(stated)[1] if isinstance(stated, str) else ""
        alike = [name for name, leg in motors.items() if takes_unit(unit, turns=leg.reads_angle)]
        stated = dict.fromkeys(alike or motors, stated)
    if unknown := [name for name in stated if name not in motors]:
        raise UsageError(
            [
                f"{refused}: found one of '{name}', needed motors that have readings; "
                f"{closest(name, motors)}"
                for name in unknown
            ]
        )
    try:
        return {
            name: sigma_in(
                sigma,
                units.get(name, default_unit(motors[name]))
                if isinstance(sigma, str)
                else default_unit(motors[name]),
                motors[name],
            )
            for name, sigma in stated.items()
        }
    except ValueError as error:
        raise UsageError(f"{refused}: {error}") from error


def sigma_too_large(sigma: float, leg: Leg) -> tuple[str, str] | None:
    """Return a standard deviation [m or rad] that no encoder has and the limit, both in words.

    None if it is plausible.
    """
    width, range_name = leg.travel[1] - leg.travel[0], f"the travel of '{leg.prismatic}'"
    if not 0.0 < width < math.inf:
        width, range_name = (math.tau, "a turn") if leg.reads_angle else (math.inf, range_name)
    if sigma <= MOST_SIGMA * width:
        return None
    size, unit = SHOWN_IN[leg.reading_unit]
    needed = f"at most {MOST_SIGMA:.0%} of {range_name}, {MOST_SIGMA * size * width:.4g} {unit}"
    return f"{float(f'{size * sigma:.3g}'):g} {unit}", needed


def sigma_in(stated: float | str, unit: ReadingUnit, leg: Leg) -> float:
    """Return a standard deviation [m or rad] from a number in the unit of readings, or with a unit.

    ValueError continues a sentence that names the entry.
    """
    sizes = {PULSES: unit.size} if unit.name == PULSES else {}
    sizes |= ANGLE if leg.reads_angle else LENGTH
    number, name = (
        (stated, unit.name) if isinstance(stated, float | int) else split_quantity(stated)
    )
    if number > 0.0 and not name:
        raise ValueError(
            f"found {describe(stated)} without a unit, needed one of {', '.join(sizes)} behind the "
            "number; write it."
        )
    if not (math.isfinite(number) and number > 0.0) or name not in sizes:
        raise ValueError(
            f"found {describe(stated)}, needed a positive number and its unit "
            f"({', '.join(sizes)}), or one in the unit of the readings ({unit.name}); correct it."
        )
    sigma = number * abs(sizes[name])
    if too_large := sigma_too_large(sigma, leg):
        shown_as_stated, (shown, needed) = f"{number:g} {name}", too_large
        remedy = "correct it"
        if stated == number:
            other, words = ("deg", "degrees") if leg.reads_angle else ("um", "micrometres")
            remedy = f"write its unit behind it ('{number:g}{other}' if it is in {words})"
        raise ValueError(
            f"found {shown_as_stated}{f', which is {shown}' * (shown_as_stated != shown)}, needed "
            f"{needed}; {remedy}."
        )
    return sigma


@dataclass(frozen=True, eq=False)
class Meaning:
    """What the numbers in the columns of motors that all slide, or all turn, may be."""

    units: tuple[ReadingUnit, ...]
    q: Array  # (n_rows, n_motors) joint values [m or rad]
    are_lengths: bool = False  # whole lengths of legs
    is_reversed: bool = False

    @property
    def unit(self) -> str:
        """Name of the unit."""
        return self.units[0].name

    def used(self, legs: Sequence[Leg]) -> Array:
        """Return the fraction of the travel that each motor uses, (n_motors,)."""
        travel = np.ptp([leg.travel for leg in legs], axis=1)
        return np.asarray(np.ptp(self.q, axis=0) / travel)

    def said(
        self, legs: Sequence[Leg], stated: str, place: UnitPlace, joints: Sequence[str] = ()
    ) -> str:
        """Return what the numbers look like, and what to do if *stated* is another unit.

        Of some *joints*, or of all.
        """
        unit, remedies = self.units[0], list[str]()
        words = f"whole leg lengths{f' in {unit.words}' * (unit.name != 'm')}"
        if not self.are_lengths:
            words = "readings with the opposite sign" if self.is_reversed else unit.words
        if unit.name != stated:
            remedies.append(_stating(unit.name, place, joints))
        if self.are_lengths:
            remedies.append("subtract the leg lengths at reading zero (legcal inspect tells them)")
        if self.is_reversed:
            other_sign = "give us_per_deg the other sign"
            remedies.append(other_sign if unit.name == PULSES else "reverse them")
        return f"these look like {words}: {' and '.join(remedies)}"


# Where the unit of readings is stated
UnitPlace = Literal["headings", "dataset file"]


def _stating(unit: str, place: UnitPlace, joints: Sequence[str] = ()) -> str:
    """Return how to state the unit of readings, of some *joints* or of all."""
    of_each = f"{{{', '.join(f'{joint}: {unit}' for joint in joints)}}}" if joints else unit
    return (
        f"{f'state {unit}' if place == 'headings' else f'write readings: {of_each}'} in the {place}"
    )


def joint_values(values: Array, units: Sequence[ReadingUnit]) -> Array:
    """Return the joint values [m or rad] of numbers (n_rows, n_motors) in a table."""
    columns = zip(units, values.T, strict=True)
    return np.array([unit.values(column) for unit, column in columns]).reshape(values.T.shape).T


def meanings(values: Array, legs: Sequence[Leg], names: Sequence[str]) -> list[Meaning]:
    """Return numbers (n_rows, n_motors) as readings, and lengths of struts, in some units."""
    found = list[Meaning]()
    for name in names:
        try:
            units = tuple(unit_named(name, leg) for leg in legs)
        except ValueError:  # pulses that no model describes
            continue
        q = joint_values(values, units)
        found.append(Meaning(units, q))
        if all(leg.actuator is None for leg in legs):
            found.append(Meaning(units, readings_of_lengths(q, legs), are_lengths=True))
    return found


def readings_of_lengths(lengths: Array, legs: Sequence[Leg]) -> Array:
    """Return the readings (n_rows, n_legs) of whole leg lengths (n_rows, n_legs) [m]."""
    columns = zip(legs, lengths.T, strict=True)
    return np.array([leg.readings_at(column) for leg, column in columns]).T


def in_travel(q: Array, legs: Sequence[Leg]) -> BoolArray:
    """Return a mask of the joint values (n_rows, n_legs) in the travel of their legs, or nearly."""
    columns = zip(legs, q.T, strict=True)
    return np.array([leg.in_travel(column) for leg, column in columns], dtype=np.bool_).T


def likely_cause(
    values: Array,  # (n_rows, n_motors) as in the table
    legs: Sequence[Leg],  # that all slide, or all turn
    units: Sequence[ReadingUnit],  # stated, of one name
    place: UnitPlace,
    *,
    of_some: bool = False,  # whether others of their kind are inside
) -> str:
    """Return the likely mistake in readings outside the travel, and its remedy; "" if unclear.

    Of the corrections that bring all of them into the travel it is that with the largest motion
    there: any large divisor brings them in.
    """
    name, turns = units[0].name, legs[0].reads_angle
    corrected = [m for m in meanings(values, legs, USUAL_UNITS[turns])
                 if m.are_lengths or m.unit != name]  # fmt: skip
    corrected.append(Meaning(tuple(units), -joint_values(values, units), is_reversed=True))
    possible = [m for m in corrected if in_travel(m.q, legs).all()]
    if possible and len(values) > 1:
        best = max(possible, key=lambda m: float(m.used(legs).mean()))
        as_stated = float(Meaning(tuple(units), joint_values(values, units)).used(legs).max())
        if best.used(legs).mean() >= HARDLY_MOVES or not HARDLY_MOVES <= as_stated <= 1.0:
            joints = [str(leg.prismatic) for leg in legs] if of_some else ()
            return best.said(legs, name, place, joints)
        return (
            "they move no further than the travel, and so look like readings from another zero: "
            "shift them into it, or correct limits and offset of the model"
        )
    low, high = USUAL_PULSES
    if turns and name != PULSES and np.all((values > low) & (values < high)):
        return "these look like pulses of servos in us: " + (
            f"write readings: {{{legs[0].prismatic}: {{unit: us, centre_us: 1500, us_per_deg: "
            "11.1}, ...} in the dataset file, with the numbers of your servos"
            if place == "dataset file"
            else "convert them to radians"
        )
    return ""


def doubtful_units(
    path: Path,
    values: Array,  # (n_rows, n_motors) as in the table
    legs: Sequence[Leg],
    units: Sequence[ReadingUnit],
    place: UnitPlace,
) -> list[Problem]:
    """Return the problems of columns that hardly move in their unit, and would in a larger one.

    Few poses may be close together, and small motions can always be written in the largest unit.
    """
    problems, q = list[Problem](), joint_values(values, units)
    if len(np.unique(values, axis=0)) < MIN_POSES:
        return []
    for name in dict.fromkeys(unit.name for unit in units):
        some = [j for j, unit in enumerate(units) if unit.name == name]
        motors = [legs[j] for j in some]
        width = np.ptp([leg.travel for leg in motors], axis=1)
        if name == PULSES or not np.all((width > 0.0) & np.isfinite(width)):
            continue
        used = float(np.max(np.ptp(q[:, some], axis=0) / width))
        usual = meanings(values[:, some], motors, USUAL_UNITS[motors[0].reads_angle])
        other = max(
            (m for m in usual if not m.are_lengths and in_travel(m.q, motors).all()),
            key=lambda m: float(m.used(motors).mean()),
            default=None,
        )
        if used >= HARDLY_MOVES:
            continue
        if other is None or other.used(motors).mean() <= SURELY_MOVES:
            problems += _unit_of_model(path, q[:, some], motors)
            continue
        moved = 100.0 * float(other.used(motors).mean())
        problems.append(
            Problem(
                "the unit of the readings could not be decided",
                f"that they use {100.0 * used:.2g} % of the travel in {name}, which is stated, and "
                f"{moved:.2g} % in {other.unit}",
                "the unit in which they are",
                f"{_stating(other.unit, place)}, and convert them first if they are in {name}",
                str(path),
                columns=tuple(str(leg.prismatic) for leg in motors),
            )
        )
    return problems


def _unit_of_model(path: Path, q: Array, motors: Sequence[Leg]) -> list[Problem]:
    """Return the problem of a model in another unit, by whose travel motors hardly move, if so.

    Its travel is long, and readings (n_rows, n_motors) in metres use most of it once converted.
    """
    width = np.ptp([leg.travel for leg in motors], axis=1)
    is_long = not motors[0].reads_angle and width.min() > _LONG_TRAVEL
    for unit in USUAL_UNITS[False][1:] if is_long else ():
        meant = Meaning((ReadingUnit(unit),), q / LENGTH[unit])
        moved = float(meant.used(motors).mean())
        if moved > SURELY_MOVES and in_travel(meant.q, motors).all():
            return [
                Problem(
                    "the readings could not be used",
                    f"that they use {100.0 * float(np.max(np.ptp(q, axis=0) / width)):.2g} % of "
                    f"the travel of the model, and {100.0 * moved:.2g} % if its lengths are "
                    f"{_WORDS[unit]}",
                    "a model in metres",
                    "convert all lengths of the model",
                    str(path),
                    columns=tuple(str(leg.prismatic) for leg in motors),
                )
            ]
    return []
