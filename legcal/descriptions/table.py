"""The table of a machine: YAML or CSV, read strictly, lengths in its stated unit.

A CSV is converted to the mapping of the same table in YAML (:func:`read_columns`), which alone can
describe motors that turn, or slide along anything but z. Common headings are understood, in three
layouts: a row for each leg (``bx by bz px py pz``, ``base_x``, ``x_base``), a row with all joints
(``B1x``), and a row for each joint (``B1, x, y, z``, or side and number in two columns; headings
are optional there). If both A and B occur they are base and platform, as in the paper; otherwise B
is the base and P, or T, the platform. ``B1 (home)`` is the joint at home, in the base link.

The mapping is validated as a :class:`TableFile`, whose entries are checked against each other and
converted to a :class:`Description` in metres, whose legs are checked against their types. An entry
is one value for all legs, or a list with one (or null) for each leg.
"""

from __future__ import annotations

import math
import re
import unicodedata
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from decimal import Decimal
from itertools import combinations
from pathlib import Path
from typing import Annotated, Any, Literal, Self

import numpy as np
from pydantic import (
    AfterValidator,
    BeforeValidator,
    ConfigDict,
    Field,
    ValidationError,
    ValidatorFunctionWrapHandler,
    WrapValidator,
    model_validator,
)
from scipy.spatial.transform import Rotation

from legcal.descriptions.controllers import firmware_table
from legcal.descriptions.description import (
    MAX_NUMBER,
    NEEDED_TYPE,
    Description,
    LegEntry,
    LegType,
    check_links,
    home_at_height,
    joints_from_base,
    leg_type,
    legs_in_words,
)
from legcal.errors import BadValue, Code, DatasetError, ModelError, Problem, Problems
from legcal.files.motions import Quaternion, Vector
from legcal.files.quantity import LENGTH
from legcal.files.schema import (
    FileSchema,
    Number,
    PlainName,
    Version,
    closest,
    content_of,
    describe,
    is_plain_name,
    read_yaml,
    validate,
)
from legcal.files.table import (
    Column,
    Lines,
    Table,
    concepts,
    header_problem,
    in_unit,
    is_number,
    read_table,
    split_heading,
)
from legcal.geometry.motions import motion_of
from legcal.geometry.types import Array
from legcal.machine.actuator import Actuator, ActuatorKind, Pulses
from legcal.machine.files import FrameLegs
from legcal.machine.leg import MAX_LEGS, LegKind

FILE_KIND = "table"
MOTIONS = ("direction", "point", "axis")  # of the motor that carries a rod


def _needed(words: str) -> WrapValidator:
    """Return a validator that refuses a value with one sentence, whatever is wrong inside it."""

    def check(value: Any, validated: ValidatorFunctionWrapHandler) -> Any:
        try:
            return validated(value)
        except ValidationError as error:
            raise BadValue(describe(value), words, "correct it") from error

    return WrapValidator(check)


def _lower_first(value: Any) -> Any:
    for pair in [value] if _is_pair(value) else value:
        if pair is not None and not pair[0] < pair[1]:
            raise BadValue(str(pair), "the lower reading first", "correct it")
    return value


def _is_pair(value: Any) -> bool:
    """Return whether a travel is one pair of readings, for all legs."""
    return bool(value) and not any(x is None or isinstance(x, list) for x in value)


def _not_zero(direction: list[float]) -> list[float]:
    if not float(np.linalg.norm(direction)) > 1e-6:
        raise ValueError
    return direction


def _type_of_leg(value: object) -> object:
    if not isinstance(value, str) or leg_type(value) is None:
        raise BadValue(f"the leg type {describe(value)}", NEEDED_TYPE, "correct it")
    return value


def _type(value: object) -> object:
    number, _, leg = value.rpartition("-") if isinstance(value, str) else ("", "", "")
    counts = number.isascii() and number.isdigit() and len(number) < 10 and int(number) > 0
    if not leg or (not counts and value != leg):
        raise BadValue(describe(value), "a type such as 6-UPS", "correct it")
    _type_of_leg(leg)
    return value


# One value for all legs, or a list with one (or null) for each
Bounded = Annotated[Number, Field(gt=-MAX_NUMBER, lt=MAX_NUMBER)]
Positive = Annotated[Number, Field(gt=0.0, lt=MAX_NUMBER)]
Point = Annotated[
    list[Bounded],
    Field(min_length=2, max_length=3),
    AfterValidator(lambda row: [*row, 0.0][:3]),
    _needed(f"three numbers below {MAX_NUMBER:g}, x y z (two in the plane)"),
]
Direction = Annotated[
    list[Bounded],
    Field(min_length=3, max_length=3),
    AfterValidator(_not_zero),
    _needed("a direction of three numbers that are not all zero, or null for the default"),
]
Lengths = Annotated[
    Bounded | list[Bounded | None],
    _needed(f"a number below {MAX_NUMBER:g}, or a list with a number (or null) for each leg"),
]
Pair = Annotated[list[Bounded], Field(min_length=2, max_length=2)]
Ends = Annotated[Pair, _needed("[lowest, highest] reading"), AfterValidator(_lower_first)]
Travel = Annotated[
    Pair | list[Pair | None],
    _needed("[lowest, highest] reading, or a list with that pair (or null) a leg"),
    AfterValidator(_lower_first),
]
Kinds = Annotated[
    LegKind | list[LegKind | None],
    _needed(f"{', '.join(kind.value for kind in LegKind)}, one for all legs or a list"),
]


class Radii(FileSchema):
    """The radii of the two parts of a leg, one of them at least."""

    model_config = ConfigDict(json_schema_extra={"minProperties": 1})

    tube: Positive | None = None
    rod: Positive | None = None

    @model_validator(mode="after")
    def _not_empty(self) -> Self:
        if self.tube is None and self.rod is None:
            raise ValueError
        return self


Radius = Annotated[
    Positive | Radii | list[Positive | Radii | None],
    _needed(
        "a positive number, {tube: ..., rod: ...}, or a list with one of these (or null) a leg"
    ),
]


class HomeEntry(FileSchema):
    """The block ``home``: a pose of the platform in the base, or its height alone."""

    xyz: Vector | None = None
    height: Number | None = None
    quat_xyzw: Quaternion | None = None
    rpy_deg: Vector | None = None


class ActuatorEntry(FileSchema):
    """A motor that carries rods: a sliding carriage or a turning arm, in the base link."""

    direction: Direction | None = None
    point: Vector | None = None
    axis: Direction | None = None
    travel: Ends | None = None
    travel_deg: Ends | None = None
    travel_us: Ends | None = None  # of a hobby servo, with centre_us and us_per_deg
    centre_us: Number | None = None
    us_per_deg: Number | None = None
    arm_radius: Annotated[Number, Field(gt=0.0)] | None = None  # of a cylindrical arm

    @property
    def turns(self) -> bool:
        """Whether it is an arm."""
        return self.axis is not None

    @property
    def pulses(self) -> Pulses | None:
        """The pulses of a hobby servo. Raises ValueError if its numbers are implausible."""
        return Pulses.stated(self.centre_us, self.us_per_deg, turns=self.turns)

    def problem(self, unit: str) -> str | None:
        """Return the contradiction between the entries, None if there is none."""
        given = [key for key in MOTIONS if getattr(self, key) is not None]
        if given not in (["direction"], ["point", "axis"]):
            return (
                f"found {' and '.join(given) or 'no motion'}, needed the direction of a "
                "carriage, or a point and the axis of an arm; correct it."
            )
        try:
            pulses = self.pulses
        except ValueError as error:
            return str(error)
        if self.arm_radius is not None and not self.turns:
            return "found arm_radius of a carriage, needed that of an arm that turns; leave it out."
        travels = [key for key in _TRAVELS if getattr(self, key) is not None]
        right = ["travel_deg", "travel_us"] if self.turns else ["travel"]
        if len(travels) == 1 and travels[0] in right and (travels != ["travel_us"] or pulses):
            return None
        reading = f"a carriage, in {unit}"
        if self.turns:
            reading = "an arm, in degrees, or travel_us with centre_us and us_per_deg of a servo"
        return (
            f"found {' and '.join(travels) or 'no travel'}, needed {right[0]}, the lowest and "
            f"highest reading of {reading}; correct it."
        )

    def travel_in_metres(self, unit: str) -> tuple[float, float]:
        """Return the lowest and highest reading [m or rad]; *unit* is the unit of lengths."""
        if self.travel_us and (pulses := self.pulses):
            low, high = sorted(pulses.angles(np.array(self.travel_us)).tolist())
            return low, high
        low, high = self.travel_deg or self.travel or [0.0, 0.0]
        if self.turns:
            return float(np.radians(low)), float(np.radians(high))
        return in_metres(low, unit), in_metres(high, unit)


class TableFile(FileSchema):
    """A table in YAML. All lengths are in ``unit``; directions have no length."""

    legcal_table: Version
    name: PlainName
    unit: Literal["m", "mm", "cm", "um", "nm", "in", "ft"]
    type: Annotated[str | None, BeforeValidator(_type)] = None
    types: list[Annotated[str, BeforeValidator(_type_of_leg)]] | None = None
    legs: list[PlainName] | None = None
    base_joints: Annotated[list[Point], Field(min_length=2, max_length=MAX_LEGS)]
    platform_joints: list[Point]
    offsets: Lengths | None = None
    lengths: Lengths | None = None
    min_length: Lengths | None = None
    max_length: Lengths | None = None
    travel: Travel | None = None
    radius: Radius | None = None
    kinds: Kinds | None = None
    base_axes: list[Direction | None] | None = None
    platform_axes: list[Direction | None] | None = None
    actuators: Annotated[dict[PlainName, ActuatorEntry], Field(min_length=1)] | None = None
    hangs_on: list[str | None] | None = None
    home: HomeEntry | None = None
    home_readings: dict[PlainName, Number] | None = None  # of carriages, in the unit
    home_readings_deg: dict[PlainName, Number] | None = None  # of arms
    reach: Annotated[Number, Field(gt=0.0)] | None = None
    floor: Number | None = None
    platform_in: Literal["base", "platform"] | None = None
    base_frame: FrameLegs | None = None

    @property
    def n(self) -> int:
        """The number of legs."""
        return len(self.base_joints)

    def per_leg(self, key: str) -> list[Any]:
        """Return the entry of each leg under a key; one value is that of all legs."""
        value = getattr(self, key)
        return [value] * self.n if self.is_for_all(key) else value

    def is_for_all(self, key: str) -> bool:
        """Return whether an entry is one value for all legs."""
        value = getattr(self, key)
        return not isinstance(value, list) or (key == "travel" and _is_pair(value))

    @property
    def leg_names(self) -> list[str]:
        """The names of the legs, their numbers by default."""
        return self.legs or [f"leg{j + 1}" for j in range(self.n)]

    @property
    def motors_of_legs(self) -> list[str | None]:
        """The motor that carries each leg: as stated, or in the order of the motors."""
        if self.hangs_on is not None:
            return self.hangs_on
        motors = list(self.actuators or ())
        return [*motors] if len(motors) == self.n else [None] * self.n

    @property
    def leg_types(self) -> list[LegType]:
        """The types of the legs."""
        texts = self.types or [(self.type or "").split("-")[-1]] * self.n
        return [type_ for text in texts if (type_ := leg_type(text)) is not None]

    def metres(self, value: Any) -> Any:
        """Return a length, or a list of lengths and nulls, in metres."""
        if isinstance(value, list | tuple):
            return [self.metres(x) for x in value]
        return None if value is None else in_metres(value, self.unit)


BESIDE = {  # options that may be given beside a table, and their entries in it
    "type": "type",
    "min_length": "min_length",
    "max_length": "max_length",
    "leg_radius": "radius",
    "height": "home",
}
_TRAVELS = ("travel", "travel_deg", "travel_us")
_SAME = 1e-6  # largest distance of coincident joints, relative to the span of the joints


def read_description(
    path: Path,
    unit: str | None = None,
    name: str | None = None,
    given: Mapping[str, Any] | None = None,
    effector: float | None = None,
) -> Description:
    """Return the machine described by a table, or by the configuration of a firmware.

    ``given`` holds entries from the command line, in the unit of the table, which must not have
    them; ``effector`` is the radius of the joints on the effector of a printer, in that unit.
    """
    given = {} if given is None else given
    content = content_of(path, FILE_KIND, ModelError).decode("utf-8-sig", errors="replace")
    if (of_firmware := firmware_table(path, content, unit, given, effector)) is not None:
        table, notes = of_firmware
        stated = {"name": name} if name is not None else {}
        described = described_machine({**table, **stated, **given}, path)
        return replace(described, notes=(*described.notes, *notes))
    if content.lstrip().startswith("<"):
        raise ModelError(
            f"{path}: the table could not be read: found XML, needed a table of joints or the "
            f"configuration of a firmware; give a URDF or MJCF to legcal inspect {path} --write ."
        )
    if effector is not None:
        raise ModelError(
            f"{path}: --platform-radius could not be used: found a table of joints, needed the "
            "configuration of a printer, or --family; write the joints in the table."
        )
    notes = tuple[str, ...]()
    if _is_csv(path, content):
        try:
            table = read_columns(path, unit)
        except DatasetError as error:
            raise ModelError(error.facts) from error
        if "actuators" in table:
            notes = (
                "Carriages slide along z of the base link, and joints on them are where they are "
                "at reading 0: a table in YAML can say otherwise (actuators).",
            )
        table["name"] = name or _plain(table["name"]).strip("_-.") or "machine"
    else:
        table = read_yaml(path, FILE_KIND, ModelError)
        table = {key: value for key, value in table.items() if value is not None}
        if name is not None:
            table["name"] = name
        if unit is not None:
            table.setdefault("unit", unit)
    options = {entry: f"--{option.replace('_', '-')}" for option, entry in BESIDE.items()}
    twice = [
        f"{options[key]} beside {key if key in table else other}"
        for key in given
        for other in (key, *("types" for _ in [0] if key == "type"))
        if _is_given(table.get(other))
    ]
    if twice:
        raise ModelError(
            f"{path}: the model could not be read: found {' and '.join(twice)} of the table, "
            "needed one of them; leave out the option."
        )
    if unit is not None and table.get("unit", unit) != unit:
        raise ModelError(
            f"{path}: the unit could not be decided: found --unit {unit} and "
            f"{describe(table['unit'])} in the table, needed one of them; leave out --unit."
        )
    described = described_machine({**table, **given}, path)
    return replace(described, notes=(*described.notes, *notes))


def _is_csv(path: Path, content: str) -> bool:
    """Return whether a table is CSV or a workbook, from its first line, else from its name."""
    lines = (line.strip() for line in content.splitlines())
    first = next((line for line in lines if line and not line.startswith("#")), "")
    is_csv = path.suffix.lower() in (".csv", ".xlsx", ".xls") or content.startswith("PK\x03\x04")
    if re.match(r"""(---|\{|legcal_table|['"]?[\w-]+['"]?\s*:(\s|$))""", first):
        return is_csv and bool(re.search(r"[;\t,]\s*[;\t,]", first))
    return is_csv or any(mark in first for mark in ",;\t")


def described_machine(table: Mapping[str, Any], source: Path) -> Description:
    """Return the machine of a table (as in YAML); messages name its source.

    Raises ModelError with one sentence for each entry that is impossible or contradicts others.
    """
    file, problems = validate(TableFile, table, source, kind=ModelError), Problems(source)
    _check_entries(file, problems)
    problems.raise_if_any()
    description = _description(file, str(source))
    _check_legs(description, problems)
    if not problems and file.platform_in is None:
        check_links(description, problems)
    problems.raise_if_any()
    return description


def _is_given(value: Any) -> bool:
    """Return whether an entry of a table, or any of its list, is not null."""
    return any(x is not None for x in value) if isinstance(value, list) else value is not None


def in_metres(value: float, unit: str) -> float:
    """Return a length in metres: the float nearest to its decimal digits in any unit."""
    return float(Decimal(repr(float(value))) * Decimal(repr(LENGTH[unit])))


def _check_entries(file: TableFile, problems: Problems) -> None:
    """Note the contradictions between counts, names and types of a table."""
    if (file.type is None) == (file.types is None):
        stated = "both" if file.type else "neither"
        needed = "one: 'type: 6-UPS', or 'types' with one entry for each leg, or --type UPS"
        problems.add("the legs could not be read", f"{stated} of type and types", needed)
        return
    n, names = file.n, file.leg_names
    for key in (
        "platform_joints", "types", "legs", "offsets", "lengths", "min_length", "max_length",
        "travel", "radius", "kinds", "base_axes", "platform_axes", "hangs_on",
    ):  # fmt: skip
        if getattr(file, key) is not None and (count := len(file.per_leg(key))) != n:
            there = f"{count} entries and {n} base_joints"
            problems.add(_unused(key), there, "one for each leg", "correct their number")
    parts = (file.type or "").split("-")
    if len(parts) == 2 and int(parts[0]) != n:
        there = f"{n} base_joints"
        problems.add(_unused(f"type {file.type}"), there, parts[0], "correct the type or the rows")
    for leg in sorted({leg for leg in names if names.count(leg) > 1}):
        problems.add(_unused("legs"), f"'{leg}' twice", "unique names", "rename it")
    _check_use(file, problems)
    for leg in file.base_frame or ():
        if leg not in names:
            there = f"'{leg}', which is not a leg"
            problems.add(_unused("base_frame"), there, remedy=closest(leg, names))
    _check_home(file, problems)
    _check_actuators(file, problems)
    _check_home_readings(file, problems)
    _check_lengths(file, problems)


def _unused(entry: str) -> str:
    return f"{entry} could not be used"


def _check_actuators(file: TableFile, problems: Problems) -> None:
    """Note the contradictions between motors and the rods that they carry."""
    names, motors, actuators = file.leg_names, file.motors_of_legs, file.actuators or {}
    n_before = len(problems)
    for name, entry in actuators.items():
        if (problem := entry.problem(file.unit)) is not None:
            problems.add(f"{_unused(f'actuators.{name}')}: {problem}")
    of_rods = dict.fromkeys(type_ for type_ in file.leg_types if type_.actuator is not None)
    if of_rods and not actuators:
        problems.add(
            f"rods of type {' and '.join(map(str, of_rods))} could not be used",
            "no motors that they hang on",
            "actuators with point and axis or direction of each motor, which a YAML table has, or "
            "in a CSV a column 'rail' of upright rails",
            "start from models/tables/servo-hexapod.yaml, orthoglide.yaml or 3-prs.yaml beside it",
        )
        return
    for leg, type_, motor in zip(names, file.leg_types, motors, strict=False):
        refused = _unused(f"leg '{leg}'")
        if motor is not None and motor not in actuators:
            missing = f"'{motor}' in hangs_on, which is not among actuators"
            problems.add(refused, missing, remedy=closest(motor, list(actuators) or ["none"]))
            continue
        moves = None
        if motor is not None:
            moves = ActuatorKind.REVOLUTE if actuators[motor].turns else ActuatorKind.PRISMATIC
        if moves is not type_.actuator:
            found = f"no motor that it hangs on and the type {type_}"
            needed = "hangs_on for types that begin with the motor of a rod (PSS, RSS, PRS)"
            if moves is not None:
                slides = moves is ActuatorKind.PRISMATIC
                how, types = ("slides", "P (PSS, PRS)") if slides else ("turns", "R (RSS)")
                found = f"the type {type_} on '{motor}', which {how}"
                needed = f"a type for its rods that begins with {types}"
            problems.add(refused, found, needed, "correct the type or the motor")
    for name in actuators:
        if name not in motors:
            problems.add(
                _unused(f"actuators.{name}"),
                "no leg that hangs on it",
                "one in hangs_on",
                "leave it out, or name it there",
            )
    lacking = [
        leg
        for leg, motor, length in zip(names, motors, file.per_leg("lengths"), strict=False)
        if motor is not None and length is None
    ]
    if lacking and len(problems) == n_before:
        needed = "that of rods that hang on a motor"
        problems.add(_unused(legs_in_words(lacking)), "no length", needed, "add lengths")


def _actuators(file: TableFile) -> dict[str, Actuator]:
    """Return the motors that carry rods, in the base link."""
    actuators, motors = {}, file.motors_of_legs
    for name, entry in (file.actuators or {}).items():
        along = np.array(entry.axis or entry.direction, dtype=float)
        A = [file.base_joints[j] for j, motor in enumerate(motors) if motor == name]
        at = entry.point or np.mean(A, axis=0).tolist()
        actuators[name] = Actuator(
            name,
            ActuatorKind.REVOLUTE if entry.turns else ActuatorKind.PRISMATIC,
            np.asarray(along / np.linalg.norm(along)),
            np.array(file.metres(at)),
            entry.travel_in_metres(file.unit),
            f"{name}_link",
            pulses=entry.pulses,
        )
        if entry.arm_radius is not None:
            first = file.leg_names[motors.index(name)]
            joints, radius = np.array(file.metres(A)), file.metres(entry.arm_radius)
            actuators[name] = actuators[name].with_arm(joints, radius, first)
    return actuators


def _check_home_readings(file: TableFile, problems: Problems) -> None:
    """Note home readings without a motor of their kind."""
    for key, turns in (("home_readings", False), ("home_readings_deg", True)):
        right = [name for name, entry in (file.actuators or {}).items() if entry.turns is turns]
        motor = "arm, in degrees" if turns else f"carriage, in {file.unit}"
        for name in getattr(file, key) or {}:
            if name not in right:
                problems.add(
                    _unused(f"{key}.{name}"),
                    f"no such {motor}",
                    ", ".join(right) or "one among actuators",
                    closest(name, right or ["none"]),
                )


def _check_home(file: TableFile, problems: Problems) -> None:
    """Note the contradictions in the block ``home``."""
    home = file.home
    if home is None:
        return
    if (home.xyz is None) == (home.height is None):
        there = f"{'neither' if home.xyz is None else 'both'} of xyz and height"
        problems.add(_unused("home.xyz"), there, "one", "write one of them")
    turns = [home.quat_xyzw is not None, home.rpy_deg is not None]
    if sum(turns) > 1 or (home.xyz is not None and sum(turns) < 1):
        needed = "its turn once, as quat_xyzw or as rpy_deg"
        problems.add(_unused("home"), needed=needed, remedy="write one of them")
    if file.platform_in == "base":
        problems.add(
            _unused("home"),
            "it beside platform joints in coordinates of the base (platform_in: base), which are "
            "those at home",
            "one of them",
            "leave out home",
        )


def _check_lengths(file: TableFile, problems: Problems) -> None:
    """Note shortest and longest lengths that are missing, redundant or impossible."""
    laws = map(file.per_leg, ("min_length", "max_length", "travel"))
    for name, low, high, travel in zip(file.leg_names, *laws, strict=False):
        if low is None and high is None:
            continue
        conflict = ""
        if low is None or high is None:
            conflict = f"{'max' if low is None else 'min'}_length alone"
        elif not low < high:
            conflict = f"min_length {low:g} and max_length {high:g}"
        elif travel is not None:
            conflict = "travel beside min_length and max_length"
        if conflict:
            problems.add(
                _unused("min_length and max_length"),
                f"{conflict} of leg '{name}'",
                "the shortest and the longest length, in place of travel",
                "correct them",
            )
            return


def _check_use(file: TableFile, problems: Problems) -> None:
    """Note entries for legs whose type does not have them."""
    names = file.leg_names
    for key, of_sliders in (
        ("lengths", False), ("offsets", True), ("travel", True),
        ("min_length", True), ("max_length", True),
    ):  # fmt: skip
        useless = [
            leg
            for leg, entry, type_ in zip(names, file.per_leg(key), file.leg_types, strict=False)
            if entry is not None and type_.has_slider is not of_sliders
        ]
        if useless and not (file.is_for_all(key) and len(useless) < len(names)):
            with_p, without_p = ("with", "without") if of_sliders else ("without", "with")
            problems.add(
                _unused(key),
                f"an entry for leg '{useless[0]}', whose type is {without_p} P",
                f"it for legs {with_p} P only",
                "leave it out, or write null in a list",
            )


def _description(file: TableFile, source: str) -> Description:
    """Return the machine of a table, in metres."""
    actuators, per_leg = _actuators(file), file.per_leg
    laws = map(per_leg, ("min_length", "max_length", "offsets", "lengths", "travel"))
    notes = list[str]()
    legs = []
    for j, (name, type_, kind, radius, motor, law) in enumerate(
        zip(
            file.leg_names, file.leg_types, per_leg("kinds"), per_leg("radius"),
            file.motors_of_legs, zip(*laws, strict=True), strict=True,
        )
    ):  # fmt: skip
        low, high, offset, length, limits = law
        if not type_.has_slider:
            kind, offset, limits = LegKind.CONSTANT, length, None
        kind = kind or LegKind.ACTUATED
        if type_.has_slider and low is not None:
            if offset is None and kind is LegKind.ACTUATED:
                offset = low
                notes = [
                    "Readings are assumed to be zero at the shortest length of a leg (min_length): "
                    "give offsets, the length at reading zero, if they are not."
                ]
            limits = [
                float(Decimal(repr(float(end))) - Decimal(repr(float(offset or 0.0))))
                for end in (low, high)
            ]
        if kind is LegKind.PASSIVE and offset is None and _is_pair(file.travel):
            limits = None  # a single pair means readings
        tube, rod = (radius.tube, radius.rod) if isinstance(radius, Radii) else (radius, radius)
        if not type_.has_slider:  # one part, whatever it is called
            tube, rod = tube or rod, rod or tube
        legs.append(
            LegEntry(
                name, type_, kind,
                np.array(file.metres(file.base_joints[j])),
                np.array(file.metres(file.platform_joints[j])),
                file.metres(offset), None if limits is None else tuple(file.metres(limits)),
                file.metres(tube), file.metres(rod),
                _unit_axis(file.base_axes, j), _unit_axis(file.platform_axes, j),
                None if motor is None else actuators[motor],
            )
        )  # fmt: skip
    home = turn = None
    if file.home is not None and file.home.quat_xyzw is not None:
        turn = Rotation.from_quat(file.home.quat_xyzw)
    elif file.home is not None and file.home.rpy_deg is not None:
        turn = Rotation.from_euler("xyz", file.home.rpy_deg, degrees=True)
    if file.home is not None and file.home.xyz is not None and turn is not None:
        home = motion_of(turn.as_matrix(), np.array(file.metres(file.home.xyz)))
    frame = None if file.base_frame is None else tuple(file.base_frame)
    described = Description(
        file.name, source, file.unit, tuple(legs), home, frame, tuple(notes),
        {name: file.metres(q) for name, q in (file.home_readings or {}).items()}
        | {name: float(np.radians(q)) for name, q in (file.home_readings_deg or {}).items()},
        *(None if x is None else file.metres(x) for x in (file.reach, file.floor)),
    )  # fmt: skip
    if file.home is not None and file.home.height is not None:
        return home_at_height(described, in_metres(file.home.height, file.unit), turn)
    if file.platform_in == "base":
        return joints_from_base(described)
    return described


def _unit_axis(axes: list[Any] | None, j: int) -> Array | None:
    """Return the unit vector of one direction of a list, None if it has none."""
    if axes is None or axes[j] is None:
        return None
    axis = np.array(axes[j], dtype=float)
    return np.asarray(axis / np.linalg.norm(axis))


def _check_legs(described: Description, problems: Problems) -> None:
    """Note the contradictions between legs and their types, and coincident legs."""
    legs = described.legs
    actuated = [leg for leg in legs if leg.kind is LegKind.ACTUATED]
    lacking = [
        (
            [leg for leg in actuated if leg.offset is None],
            "actuated sliders without an offset",
            "the length at reading zero",
            "add offsets, or min_length and max_length",
        ),
        (
            [leg for leg in actuated if leg.travel is None],
            "actuated sliders without travel",
            "the lowest and the highest reading of their encoders",
            "add travel, or min_length and max_length",
        ),
        (
            [leg for leg in legs if leg.kind is LegKind.CONSTANT and leg.type.has_slider],
            "the kind constant with a P in the type",
            "a type without P for legs of constant length",
            "correct kinds or types",
        ),
    ]
    for side in ("base", "platform"):
        odd = [
            leg
            for leg in legs
            if getattr(leg, f"{side}_axis") is not None and not getattr(leg.type, side).has_axis
        ]
        for type_ in dict.fromkeys(getattr(leg.type, side) for leg in odd):
            joint = f"an {type_} joint" if type_ else "a leg that is fixed"
            lacking.append(
                (
                    [leg for leg in odd if getattr(leg.type, side) is type_],
                    f"an axis for {joint} at the {side}",
                    "axes of R and U joints only",
                    f"write null in {side}_axes",
                )
            )
    for some, found, needed, remedy in lacking:
        if some:
            problems.add(_unused(legs_in_words([leg.name for leg in some])), found, needed, remedy)
    # Coincident legs, and joints that all coincide.
    A, B = (np.array([getattr(leg, side) for leg in legs]) for side in ("A_base", "B_platform"))
    spans = [float(np.linalg.norm(np.ptp(joints, axis=0))) for joints in (A, B)]
    for i, j in combinations(range(len(legs)), 2):
        gap = max(float(np.linalg.norm(ends[i] - ends[j])) for ends in (A, B))
        if gap <= _SAME * max(spans):
            pair = f"legs '{legs[i].name}' and '{legs[j].name}'"
            there = "both between the same two points"
            problems.add(_unused(pair), there, "different joints", "correct their rows")
    if min(spans) <= _SAME * max(spans):
        problems.add(
            _unused("the joints"),
            "all of one side in one point",
            "them spread out",
            "correct base_joints or platform_joints",
        )


_OF_CONCEPTS = {  # columns by what their headings speak of, legs and joints aside
    frozenset(key.split()): column
    for column, keys in {
        "type": ("type",),
        "unit": ("unit",),
        "leg": ("number", "name"),
        "offset": ("zero length", "reading 0", "length 0"),
        "length": ("rod length",),
        "min_length": ("min length", "short", "short length"),
        "max_length": ("max length", "long", "long length"),
        "stroke": ("stroke", "length stroke", "rail stroke", "reading"),
        "rail": ("rail", "rail name", "rail number"),
        "travel_low": ("min reading", "min stroke"),
        "travel_high": ("max reading", "max stroke"),
        "radius": ("radius",),
        "tube": ("tube", "tube radius"),
        "rod": ("rod", "rod radius"),
        "diameter": ("diameter",),
        "tube diameter": ("tube diameter",),
        "rod diameter": ("rod diameter",),
        "note": ("note",),
    }.items()
    for key in keys
}
_DIAMETERS = {"diameter": "radius", "tube diameter": "tube", "rod diameter": "rod"}
_NOT_LENGTHS = ("deg", "-")  # units of other columns
_LETTERS = ("a", "b", "p", "t")  # of sides, as in A1
_XYZ = ("x", "y", "z")
_REMARK = re.compile(
    r"\b(?:all|lengths?|dimensions?|units?|alle|maße|längen|tout|cotes)\b[^\n,;|]{0,30}?"
    rf"\b(?:in|en) ({'|'.join(LENGTH)})\b",
    re.IGNORECASE,
)
_RADII = ("radius", "tube", "rod")
_POINTS = tuple(f"{side}_{i}" for side in ("base", "platform") for i in _XYZ)
_NUMBERS = (
    *("offset", "length", "min_length", "max_length", "travel_low", "travel_high"),
    *_RADII,
    *(f"{side}_axis_{i}" for side in ("base", "platform") for i in _XYZ),
)
_TEXTS = ("leg", "rail", "type", "kind", "unit", "platform_in")
COLUMNS = (
    *(Column(name, "text", required=False) for name in _TEXTS),
    *(
        Column(
            name,
            least=-MAX_NUMBER,
            most=MAX_NUMBER,
            needed=f"a number below {MAX_NUMBER:g}",
            remedy="correct the cell",
            required=name in _POINTS and not name.endswith("z"),
            blank=name not in _POINTS or name.endswith("z"),
        )
        for name in (*_POINTS, *_NUMBERS)
    ),
)


def read_columns(path: Path, unit: str | None) -> dict[str, Any]:
    """Return a CSV as the mapping that the same table would be in YAML.

    ``unit`` is the unit of lengths if no column states it. Raises DatasetError with one sentence
    for each wrong column or cell.
    """
    names = [column.name for column in COLUMNS]
    table = read_table(
        path,
        FILE_KIND,
        "leg",
        COLUMNS,
        needed="one row for each leg; add them",
        reshape=lambda lines: _one_row_a_leg(lines, names, path),
    )
    filled = [np.array([text != "" for text in table.text(name)], dtype=bool) for name in _RADII]
    for row in np.flatnonzero(filled[0] & (filled[1] | filled[2])).tolist():
        conflict, remedy = "radius beside tube or rod", "empty the others"
        table.refuse(row, conflict, "one of them", *_RADII, remedy=remedy, what="radius")
    table.check()
    joints = (
        [[x, y, z or 0.0] for x, y, z in _cells(table, *(f"{side}_{i}" for i in _XYZ))]
        for side in ("base", "platform")
    )
    document: dict[str, Any] = {
        "legcal_table": 1,
        "name": path.stem,
        "unit": _unit(table, unit),
        "platform_in": _shared(table, "platform_in"),
        "types": _cells(table, "type") if "type" in table else None,
        "base_joints": next(joints),
        "platform_joints": next(joints),
        "travel": _cells(table, "travel_low", "travel_high"),
        "radius": [
            {k: x for k, x in (("tube", tube), ("rod", rod)) if x is not None} or radius
            for radius, tube, rod in zip(*(_cells(table, name) for name in _RADII), strict=True)
        ],
    }
    rails = _cells(table, "rail")
    if any(rails):  # upright
        ends = dict(zip(reversed(rails), reversed(document["travel"]), strict=True))
        document["actuators"] = {
            rail: {"direction": [0.0, 0.0, 1.0], "travel": ends[rail]}
            for rail in dict.fromkeys(filter(None, rails))
        }
        pairs = zip(document["travel"], rails, strict=True)
        document["travel"] = [travel if rail is None else None for travel, rail in pairs]
    optional: dict[str, Any] = {
        "legs": _cells(table, "leg"),
        "hangs_on": rails,
        "kinds": _cells(table, "kind"),
        "offsets": _cells(table, "offset"),
        "lengths": _cells(table, "length"),
        "min_length": _cells(table, "min_length"),
        "max_length": _cells(table, "max_length"),
        "base_axes": _cells(table, *(f"base_axis_{i}" for i in _XYZ)),
        "platform_axes": _cells(table, *(f"platform_axis_{i}" for i in _XYZ)),
    }
    return document | {key: of_legs for key, of_legs in optional.items() if _is_given(of_legs)}


def _cells(table: Table, *names: str) -> list[Any]:
    """Return the cells of a column by row, or those of several as lists; None where empty."""
    columns: list[list[Any]] = [
        [text or None for text in table.text(name)]
        if name in _TEXTS
        else [None if math.isnan(x) else x for x in table.number(name).tolist()]
        for name in names
    ]
    if len(columns) == 1:
        return columns[0]
    rows = map(list, zip(*columns, strict=True))
    return [row if _is_given(row) else None for row in rows]


def _shared(table: Table, name: str) -> str | None:
    """Return the text of a column that is the same in all rows, None for an empty column."""
    stated = sorted(set(filter(None, table.text(name))))
    if len(stated) > 1:
        raise DatasetError(
            f"{table.path}: the {name} could not be decided: found {' and '.join(stated)}, needed "
            f"the same in all lines; correct the column '{name}'."
        )
    return stated[0] if stated else None


def _unit(table: Table, given: str | None) -> str:
    """Return the unit of the column, the given one, or that of a remark (``all in mm``)."""
    stated = _shared(table, "unit") or given
    if stated is None:
        text = content_of(table.path, FILE_KIND).decode("utf-8", errors="replace")
        remarked = set(map(str.lower, _REMARK.findall(text)))
        stated = remarked.pop() if len(remarked) == 1 else None
    if stated is None:
        raise DatasetError(
            f"{table.path}: the lengths could not be read: found no unit, needed one of "
            f"{', '.join(LENGTH)}; add a column 'unit', or give --unit mm."
        )
    return stated


def _one_row_a_leg(lines: Lines, names: Sequence[str], path: Path) -> Lines:
    """Return a table with a row for each leg under the names of its columns.

    ``names`` are the names of the columns. Unknown headings stay, in lower case, and a column
    ``unit`` is added if headings of joints state one.
    """
    lines = _with_headings(_upright(lines), path)
    number, header = lines[0]
    units = [split_heading(text, others=True)[1] for text in header]
    of_lengths = [
        unit
        for unit, text in zip(units, header, strict=True)
        if text not in names and unit not in ("", *_NOT_LENGTHS) and "home" not in concepts(unit)
    ]
    if unknown := sorted({unit for unit in of_lengths if unit not in LENGTH}):
        raise DatasetError(
            f"{path}, header: the unit could not be decided: found {' and '.join(unknown)}, needed "
            f"one of {', '.join(LENGTH)}; correct the headings."
        )
    if of_lengths:  # all lengths in that of the first
        sizes = [Decimal(repr(LENGTH.get(unit, 1.0))) for unit in (*units, of_lengths[0])]
        factors = [
            size / sizes[-1] if unit in of_lengths else Decimal(1)
            for size, unit in zip(sizes, units, strict=False)
        ]
        lines = _scaled(lines, factors)
    named = [*header, *(text for _, cells in lines for text in cells[:2])]
    at_home = any("home" in concepts(text) and _place(text) is not None for text in named)
    lines = [(number, [_column(text, names) for text in header]), *lines[1:]]
    first = [cells[0] for _, cells in lines[1:]]
    if lines[0][1][0] == "rod" and first == [str(k) for k in range(1, len(first) + 1)]:
        lines[0][1][0] = "leg"  # the number of the rod, not its radius
    if {"x", "y"} <= set(lines[0][1]) and len(lines) > 1:
        lines = _from_points(lines, path)
    coordinates = [None if text in names else _place(text) for text in lines[0][1]]
    sides = _sides(side for side, *_ in filter(None, coordinates))
    if any(coordinate is not None and coordinate[1] for coordinate in coordinates):
        lines = _from_one_row(lines, coordinates, sides, path)
    else:
        columns = zip(coordinates, lines[0][1], strict=True)
        header = [f"{sides[x[0]]}_{x[2]}" if x and x[2] else text for x, text in columns]
        lines = [(number, header), *lines[1:]]
    stated = {"unit": of_lengths[0] if of_lengths else "", "platform_in": "base" if at_home else ""}
    return _of_legs(lines, stated)


def _upright(lines: Lines) -> Lines:
    """Return a table with a column for each leg as one with a row for each leg."""
    first = [cells[0] for _, cells in lines[1:]]
    if not first or len({len(cells) for _, cells in lines}) > 1:
        return lines
    places = [_place(text) for text in first]
    if {place[2] for place in places if place} != {*_XYZ} or any(map(_place, lines[0][1][1:])):
        return lines
    turned = zip(*(cells for _, cells in lines), strict=True)
    return [(lines[0][0], [text or "leg" for text in cells]) for cells in turned]


def _column(text: str, names: Sequence[str]) -> str:
    """Return the column of a heading by its exact name or by what it speaks of; others as it is."""
    plain = {split_heading(name)[0]: name for name in names}
    if (key := split_heading(text, others=True)[0]) in plain:
        return plain[key]
    found = concepts(text)
    if found and set(found) <= {*_XYZ, "joint"} and len(set(found) & {*_XYZ}) == 1:
        return next(x for x in found if x in _XYZ)
    what = frozenset(found) - {"leg", "joint"}
    if not what and "leg" in found:
        return "leg"
    return _OF_CONCEPTS.get(what, text.lower())


def _scaled(lines: Lines, factors: Sequence[Decimal]) -> Lines:
    """Return the numbers of columns times their factors."""
    scaled = [lines[0]]
    for line, cells in lines[1:]:
        pairs = zip(cells, factors, strict=False)
        some = [in_unit(cell, factor) if factor != 1 else cell for cell, factor in pairs]
        scaled.append((line, some + cells[len(some) :]))
    return scaled


def _of_legs(lines: Lines, stated: Mapping[str, str]) -> Lines:
    """Return lines with diameters halved, strokes added, legs named, remarks gone.

    ``stated`` holds columns to add, the same in all rows; empty ones are left out.
    """
    (number, header), n = lines[0], len(lines[0][1])
    lines = _scaled(
        lines, [Decimal("0.5") if name in _DIAMETERS else Decimal(1) for name in header]
    )
    on_rails = "rail" in header
    add_stroke = "stroke" in header and "min_length" in header and "max_length" not in header
    kept = [i for i, name in enumerate(header) if name != "note"]
    added = {key: text for key, text in stated.items() if text and key not in header}
    if on_rails and "stroke" in header and "travel_low" not in header:
        added["travel_low"] = "0"
    below: Lines = []
    for line, cells in lines[1:]:
        if len(cells) == n:
            row = dict(zip(header, cells, strict=True))
            if add_stroke and is_number(row["stroke"]) and is_number(row["min_length"]):
                cells[header.index("stroke")] = str(
                    Decimal(row["min_length"]) + Decimal(row["stroke"])
                )
            for key in {"leg", "rail"} & {*header}:
                if name := row[key]:
                    cells[header.index(key)] = f"{key}{name}" if name.isdigit() else _plain(name)
            cells = [*(cells[i] for i in kept), *added.values()]
        below.append((line, cells))
    names = {**_DIAMETERS, **({"stroke": "max_length"} if add_stroke else {})}
    names |= {"stroke": "travel_high"} if on_rails else {}
    return [(number, [*(names.get(header[i], header[i]) for i in kept), *added]), *below]


def _plain(name: str) -> str:
    """Return a name in the letters that files and joints can have."""
    ascii_letters = unicodedata.normalize("NFKD", name).encode("ascii", "ignore").decode()
    return re.sub(r"[^\w.-]+", "_", ascii_letters).strip("_") if not is_plain_name(name) else name


def _with_headings(lines: Lines, path: object) -> Lines:
    """Return lines with headings, which a list of named points may omit."""
    first = lines[0][1]
    if sum(is_number(text) for text in first) < 2:
        return lines
    if len(first) in (3, 4) and _joint(first[0]):
        return [(lines[0][0], ["point", *_XYZ[: len(first) - 1]]), *lines]
    raise DatasetError(
        f"{path}: the joints could not be read: found numbers in the first line, needed headings "
        "such as leg,base_x,base_y,base_z,platform_x,platform_y,platform_z, or names of the joints "
        "before their coordinates (B1,289.8,77.6,0 and P1,106.1,106.1,0); add them."
    )


def _place(text: str) -> tuple[str, str, str] | None:
    """Return side, number and coordinate ("" if none) of the heading or the name of a joint.

    A word for the side (A1 (Boden)) counts more than a letter.
    """
    found = concepts(text)
    letters = [x for x in found if x in _LETTERS]
    sides = {x for x in found if x in ("base", "platform", "rail")} or set(letters)
    numbers, axes = [x for x in found if x.isdigit()], [x for x in found if x in _XYZ]
    known = {"joint", "leg", "number", "name", *(["home"] if "rail" not in sides else [])}
    others = set(found) - {*sides, *letters, *numbers, *axes, *known}
    if len(sides) != 1 or max(len(letters), len(numbers), len(axes)) > 1 or others:
        return None
    if not numbers and not axes:
        return None
    return sides.pop(), "".join(numbers), "".join(axes)


def _joint(name: str) -> tuple[str, str] | None:
    """Return the side and the number of the leg in the name of a joint."""
    place = _place(name)
    return (place[0], place[1]) if place and place[1] and not place[2] else None


def _sides(words: Iterable[str]) -> dict[str, str]:
    """Return the side of each word; B is the platform if there is an A."""
    known = {"base": "base", "rail": "base", "a": "base", "platform": "platform", "p": "platform"}
    return known | {"t": "platform", "b": "platform" if "a" in set(words) else "base"}


def _from_one_row(
    lines: Lines,
    coordinates: Sequence[tuple[str, str, str] | None],
    sides: dict[str, str],
    path: object,
) -> Lines:
    """Return a row for each leg, from a table with all joints in one row."""
    (number, header), rows = lines[0], lines[1:]
    if len(rows) != 1 or any(len(cells) != len(header) for _, cells in rows):
        raise DatasetError(
            f"{path}: the joints could not be read: found {len(rows)} rows under headings that "
            f"number the legs ({describe(header[0])}), needed one complete row; write one row for "
            "each leg with base_x,base_y,base_z,platform_x,platform_y,platform_z."
        )
    cells = rows[0][1]
    joints: dict[int, dict[str, str]] = {}
    others = {}
    for coordinate, text, cell in zip(coordinates, header, cells, strict=True):
        if coordinate is not None and coordinate[1]:
            side, leg, letter = coordinate
            joints.setdefault(int(leg), {})[f"{sides[side]}_{letter}"] = cell
        else:
            others[text.lower()] = cell
    return _rows(joints, others, (number, rows[0][0]))


def _from_points(lines: Lines, path: Path) -> Lines:
    """Return a row for each leg, from a table with a row for each joint.

    A joint is named in one column, or in two: side and number of the leg.
    """
    number, header = lines[0]
    axes = {text: i for i, text in enumerate(header) if text in _XYZ}
    others = [i for i, text in enumerate(header) if text not in (*_XYZ, "unit", "note")]
    of_name = [i for i in others if "joint" in concepts(header[i]) or header[i] == "leg"] or others
    if len(of_name) < 2 and (more := [i for i in others if "side" in concepts(header[i])]):
        of_name = [*of_name, *(i for i in more if i not in of_name)]
    known = of_name[:2]
    for i in others:
        if i not in known:
            raise DatasetError(
                header_problem(
                    path,
                    f"the unknown column {describe(header[i])}",
                    "those of a table with a row for each joint",
                    closest(header[i], ["point", *_XYZ, "unit"]),
                    Code.UNKNOWN_COLUMN,
                )
            )
    problems, named = list[Problem](), list[tuple[int, int, str, str, str, list[str]]]()

    def refuse(row: int, line: int, found: str, needed: str, *columns: str) -> None:
        what = "the joint could not be used"
        problems.append(Problem(what, found, needed, "correct it", str(path), row, line, columns))

    for row, (line, cells) in enumerate(lines[1:], start=1):
        if len(cells) != len(header):
            refuse(row, line, f"{len(cells)} cells", f"{len(header)} as in the header")
            continue
        words = [cells[i] for i in of_name[:2]]
        joint = _joint(" ".join(words))
        stated = describe(" ".join(words)) if "".join(words) else "no name"
        if joint is None:
            needed = (
                "a row for each joint, with side and number in its name such as B1 and P1, or "
                "base1 and platform1, as legcal new --template writes it"
            )
            refuse(row, line, stated, needed, *(header[i] for i in of_name[:2]))
            continue
        for axis, i in axes.items():
            if not is_number(cells[i]) and (cells[i] or axis != "z"):
                found = describe(cells[i]) if cells[i] else "an empty cell"
                refuse(row, line, found, f"a number below {MAX_NUMBER:g}", header[i])
        named.append((row, line, stated, *joint, cells))
    sides = _sides(side for _, _, _, side, *_ in named)
    joints: dict[int, dict[str, str]] = {}
    for row, line, stated, side, leg, cells in named:
        of_leg = joints.setdefault(int(leg), {})
        if f"{sides[side]}_x" in of_leg:
            refuse(row, line, f"{stated} twice", "each joint once")
        of_leg |= {f"{sides[side]}_{axis}": cells[i] for axis, i in axes.items()}
    if problems:
        problems.sort(key=lambda problem: problem.line or 0)
        raise DatasetError(problems)
    units = {cells[header.index("unit")] for *_, cells in named} if "unit" in header else set()
    if len(units) > 1:
        raise DatasetError(
            f"{path}: the unit could not be decided: found {' and '.join(sorted(units))}, needed "
            "the same in all lines; correct the column 'unit'."
        )
    return _rows(joints, dict(zip(["unit"], units, strict=False)), (number, lines[1][0]))


def _rows(joints: dict[int, dict[str, str]], others: dict[str, str], at: tuple[int, int]) -> Lines:
    """Return a header and a row for each leg, in the order of their numbers."""
    columns = list(dict.fromkeys(name for leg in joints.values() for name in leg))
    rows = [
        (at[1], [*(joints[k].get(name, "") for name in columns), *others.values()])
        for k in sorted(joints)
    ]
    return [(at[0], [*columns, *others]), *rows]
