"""The YAML of a mechanism: its schema, strict reading, and writing."""

import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any

import yaml
from pydantic import BaseModel, ConfigDict, Field, field_validator

from legcal.errors import BadValue, DatasetError, ModelError, Problem
from legcal.files.motions import MotionEntry
from legcal.files.published import with_schema
from legcal.files.schema import (
    FileSchema,
    Number,
    PlainName,
    Version,
    closest,
    parse_yaml,
    validate,
)
from legcal.machine.actuator import Actuator
from legcal.machine.files import DATASET_YAML, read_file, what_a_dataset_is_for
from legcal.machine.tolerance import BuiltEntry

FILE_KIND = "mechanism file"
MAX_LOOPS = 100
GAINS = (0.5, 2.0)  # range of gains of motors that carry rods; others hint at a wrong unit
MAX_GAIN_ERROR = 1e-12  # tolerance of a gain of 1


class MotorEntry(FileSchema):
    """Numbers of a motor that carries rods which have no place in a URDF."""

    gain: Annotated[Number, Field(ge=GAINS[0], le=GAINS[1])] = 1.0  # motion over reading
    centre_us: Number | None = None  # pulse at joint value 0 [us], of a hobby servo
    us_per_deg: Number | None = None  # negative if longer pulses turn it backwards


class LegcalBlock(BuiltEntry):
    """The block ``legcal``: what belongs to base, platform and legs.

    Missing entries are proposed, see :mod:`legcal.machine.topology`.
    """

    version: Version
    urdf: str | None = None
    base: str
    platform: str
    platform_joint: str | None = None
    base_frame: Annotated[list[str], Field(min_length=2, max_length=3)] | None = None
    home: MotionEntry | None = None
    home_readings: dict[str, float] | None = None  # readings of actuators at home [m or rad]
    motors: dict[str, MotorEntry] | None = None  # motors that carry rods, by joint
    legs: Annotated[dict[PlainName, str], Field(min_length=1)]

    @field_validator("base_frame")
    @classmethod
    def _different(cls, value: list[str] | None) -> list[str] | None:
        if value is None:
            return None
        repeated = sorted({name for name in value if value.count(name) > 1})
        if repeated:
            raise BadValue(
                f"the leg '{repeated[0]}' more than once", "different legs", "name each once"
            )
        return value


class MechanismFile(BaseModel):
    """A mechanism YAML; keys of other programs are ignored."""

    model_config = ConfigDict(frozen=True, allow_inf_nan=False, extra="ignore")

    closed_loop: list[Annotated[list[str], Field(min_length=2, max_length=2)]]
    type: list[str]
    name_mot: list[str]
    joint_name: list[str] = []
    joint_type: list[str] = []
    legcal: LegcalBlock | None = None

    @field_validator("type")
    @classmethod
    def _small_letters(cls, value: list[str]) -> list[str]:
        return [kind.lower() for kind in value]


def read_mechanism_file(path: Path) -> MechanismFile:
    """Return a mechanism YAML, checked in itself (names are checked against the URDF later)."""
    content = read_file(path, FILE_KIND)
    _refuse_other_text(content, path)
    try:
        document = parse_yaml(content, path, FILE_KIND)
        _check_kind(document, path)
        file = validate(MechanismFile, _without_nulls(document), path)
    except DatasetError as error:
        raise ModelError(error.facts) from error
    problems = _contradictions(file, path)
    if problems:
        raise ModelError(problems)
    return file


_OTHER_TEXT = {  # kinds of files of other programs, by the first line that is no comment
    "a HAL file of LinuxCNC": re.compile(rb"(loadrt|loadusr|setp|net|addf)\s"),
    "a configuration with [sections]": re.compile(rb"\[[\w .:-]+\]\s*([#;].*)?$"),
    "G-code": re.compile(rb"[GM]\d+(\s|$)"),
}


def _refuse_other_text(content: bytes, path: Path) -> None:
    """Refuse files of other programs that hold dimensions but are no model."""
    lines = (line.strip() for line in content.splitlines())
    first = next((line for line in lines if line and line[:1] not in b"#;"), b"")
    kind = next((kind for kind, pattern in _OTHER_TEXT.items() if pattern.match(first)), None)
    if kind is not None:
        raise ModelError(
            f"the {FILE_KIND} could not be read",
            kind,
            "a mechanism YAML, URDF or MJCF file",
            f"make a model of it with: legcal new {path} -o DIR",
            path,
        )


def _check_kind(document: Mapping[str, Any], path: Path) -> None:
    """Refuse other YAML files of legcal, with the command for each."""
    if "legcal_table" in document:
        raise ModelError(
            f"the {FILE_KIND} could not be read: found a table of legs (legcal_table), needed "
            f"a model; write the model of the table with: legcal new {path} -o DIR",
            file=path,
        )
    if path.name == DATASET_YAML:
        raise ModelError(what_a_dataset_is_for(path))


def _without_nulls(document: dict[str, Any]) -> dict[str, Any]:
    """Return the mapping without empty optional lists, which YAML reads as null."""
    return {
        k: v for k, v in document.items() if v is not None or k not in ("joint_name", "joint_type")
    }


def _contradictions(file: MechanismFile, path: Path) -> list[Problem]:
    """Return the contradictions within the file."""
    problems = []
    if len(file.type) != len(file.closed_loop):
        problems.append(
            Problem(
                "the loops could not be closed",
                f"{len(file.closed_loop)} pairs in closed_loop and {len(file.type)} "
                "entries in type",
                "equal numbers",
                "write one type for each pair",
                str(path),
            )
        )
    problems += [
        Problem(
            f"type.{i} could not be used",
            f"'{kind}'",
            "'3d' (points coincide) or '6d' (frames coincide)",
            "correct it",
            str(path),
        )
        for i, kind in enumerate(file.type)
        if kind not in ("3d", "6d")
    ]
    if len(file.closed_loop) > MAX_LOOPS:
        problems.append(
            Problem(
                "the loops could not be closed",
                f"{len(file.closed_loop)} pairs in closed_loop",
                f"at most {MAX_LOOPS}",
                "give one mechanism",
                str(path),
            )
        )
    if not file.closed_loop:
        problems.append(
            Problem(
                "the mechanism could not be closed",
                "no pair in closed_loop",
                "the loops of a parallel mechanism",
                "write the pairs of frames that coincide",
                str(path),
            )
        )
    if len(file.joint_name) != len(file.joint_type):
        problems.append(
            Problem(
                "joint_name could not be used",
                f"{len(file.joint_name)} names and {len(file.joint_type)} entries in joint_type",
                "equal numbers",
                "write one type for each joint",
                str(path),
            )
        )
    repeated = sorted({name for name in file.name_mot if file.name_mot.count(name) > 1})
    problems += [
        Problem(
            "name_mot could not be used",
            f"'{name}' more than once",
            "each motor once",
            "remove the repetition",
            str(path),
        )
        for name in repeated
    ]
    block = file.legcal
    if block is None:
        return problems
    problems += [
        Problem(
            "legcal.base_frame could not be used",
            f"'{name}', which is not a leg",
            "",
            closest(name, block.legs),
            str(path),
        )
        for name in block.base_frame or ()
        if name not in block.legs
    ]
    return problems


def motor_entries(actuators: Sequence[Actuator]) -> dict[str, Any]:
    """Return the YAML entries of actuators that a URDF cannot hold, by joint."""
    entries = dict[str, dict[str, float]]()
    for actuator in actuators:
        entry = {} if abs(actuator.gain - 1.0) <= MAX_GAIN_ERROR else {"gain": actuator.gain}
        if actuator.pulses is not None:
            entry["centre_us"] = actuator.pulses.centre
            entry["us_per_deg"] = actuator.pulses.per_degree
        if entry:
            entries[actuator.joint] = entry
    return entries


def mechanism_yaml(
    loops: Sequence[tuple[str, str, str]], motors: Sequence[str], legcal: dict[str, Any]
) -> str:
    """Return the YAML of a mechanism from closures (two frames, kind), motors and block."""
    document = {
        "closed_loop": [[first, second] for first, second, _ in loops],
        "type": [kind for *_, kind in loops],
        "name_mot": motors,
        "joint_name": [],
        "joint_type": [],
        "legcal": {"version": 1, **legcal},
    }
    text = yaml.safe_dump(document, sort_keys=False, default_flow_style=False, allow_unicode=True)
    return with_schema("mechanism", text)
