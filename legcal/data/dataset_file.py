"""The file dataset.yaml: its schema, and checks for contradictions; parameters given by name."""

from __future__ import annotations

import os
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

import yaml
from pydantic import (
    AfterValidator,
    BeforeValidator,
    Discriminator,
    Field,
    Strict,
    Tag,
    WithJsonSchema,
)

from legcal.data.reading_units import ReadingsEntry, ReadingUnitName
from legcal.errors import BadValue, Code, DatasetError, Problem, UsageError
from legcal.files.folder import with_schema
from legcal.files.motions import MotionEntry
from legcal.files.quantity import EXAMPLE, PRIOR_SCHEMA, Quantity, read_prior, read_value
from legcal.files.schema import FileSchema, Name, Number, Version, describe, read_yaml, validate
from legcal.files.table import format_table
from legcal.machine.files import DATASET_YAML, different_legs
from legcal.machine.leg import Link
from legcal.machine.model import Machine
from legcal.machine.parameters import list_in_words
from legcal.machine.tolerance import BuiltEntry

MEASUREMENTS = "measurements.csv"
ENCODER_SIGMAS = (1e-12, 1.0)  # [m] plausible standard deviations of an encoder
_Text = Annotated[str, Strict(), WithJsonSchema({"type": "string"})]
_BOUNDS = ("minimum", "maximum")
GAMMAS = (0.2, 5.0)  # plausible gammas of a camera


Action = Literal["prior", "fixed", "free"]
_WORDS: Mapping[Action, str] = {
    "prior": "prior",
    "fixed": "parameter to fix",
    "free": "parameter to free",
}


@dataclass(frozen=True)
class Override:
    """An override of one parameter, or of all that a pattern matches."""

    name: str  # or a pattern
    action: Action
    where: str  # its place, as the start of a sentence about it
    stated: Quantity | None = None  # the prior, or the value that it is fixed at
    in_file: bool = False  # stated in ``dataset.yaml``; overrides of a run take precedence


class ViewEntry(FileSchema):
    """One camera position."""

    camera: str
    gamma: Annotated[Number, Field(ge=GAMMAS[0], le=GAMMAS[1])] | None = None  # None: unknown
    T_base_camera: MotionEntry | None = None
    hand_held: Annotated[bool, Strict()] = False
    # none of them where a board on the platform is all that counts
    legs: Annotated[list[str], AfterValidator(different_legs)] | None = None


def _can_be_fixed(text: str) -> str:
    """Refuse a value that a parameter cannot be fixed at."""
    read_override("fixed", text, "")
    return text


class ParametersEntry(FileSchema):
    """Priors of parameters, and the parameters to fix or to free."""

    priors: dict[
        Name, Annotated[Quantity, BeforeValidator(read_prior), WithJsonSchema(PRIOR_SCHEMA)]
    ] = Field(default_factory=dict)
    lengths: dict[
        Name, Annotated[Quantity, BeforeValidator(read_prior), WithJsonSchema(PRIOR_SCHEMA)]
    ] = Field(default_factory=dict)  # between two joints: LEG.base:LEG.base
    fixed: list[Annotated[Name, AfterValidator(_can_be_fixed)]] = Field(default_factory=list)
    free: list[Name] = Field(default_factory=list)

    def overrides(self, path: Path) -> tuple[Override, ...]:
        """Return the overrides of the block; ``path`` is the file, for messages."""
        block = f"{path}: parameters"
        given = [("priors", self.priors), ("lengths", self.lengths)]
        stated: list[tuple[Action, Sequence[str]]] = [("fixed", self.fixed), ("free", self.free)]
        return (
            *(
                read_override("prior", name, f"{block}.{key}.{name}", value, in_file=True)
                for key, values in given
                for name, value in values.items()
            ),
            *(
                read_override(action, text, f"{block}.{action} '{text}'", in_file=True)
                for action, texts in stated
                for text in texts
            ),
        )


def _by_joint_or(of_all: str) -> Discriminator:
    """Return the discriminator of an entry by joint from one for all motors, which has this tag."""

    def form(value: Any) -> str:
        if value is None:
            return "[none]"
        return "[by joint]" if isinstance(value, dict) else of_all

    return Discriminator(form)


def _of_an_encoder(sigma: float) -> float:
    least, most = ENCODER_SIGMAS
    if not least <= sigma <= most:
        needed = f"{least:g} to {most:g} m"
        raise BadValue(f"{sigma:g} m", needed, "give one standard deviation of a reading in metres")
    return sigma


class DatasetEntry(BuiltEntry):
    """The whole of ``dataset.yaml``."""

    legcal_dataset: Version
    mechanism: str
    measurements: str
    encoder_sigma: Annotated[
        Annotated[
            Number,
            Field(gt=0.0, json_schema_extra=dict(zip(_BOUNDS, ENCODER_SIGMAS, strict=True))),
            AfterValidator(_of_an_encoder),
            Tag("[number]"),
        ]
        | Annotated[
            dict[str, Annotated[Number, Field(gt=0.0)] | _Text],
            Field(min_length=1),
            Tag("[by joint]"),
        ]
        | Annotated[None, Tag("[none]")],
        _by_joint_or("[number]"),
    ] = None  # None: servos with pulses as readings have a default
    readings: Annotated[
        Annotated[ReadingUnitName, Tag("[unit]")]
        | Annotated[dict[str, ReadingsEntry], Field(min_length=1), Tag("[by joint]")]
        | Annotated[None, Tag("[none]")],
        _by_joint_or("[unit]"),
    ] = None  # unit of the table, where it is not m or rad
    views: Annotated[dict[Name, ViewEntry], Field(min_length=1)]
    parameters: ParametersEntry = Field(default_factory=ParametersEntry)
    board: dict[str, Any] | list[Any] | None = None  # read by their kinds


def find_dataset_file(location: Path) -> Path:
    """Return the path of dataset.yaml."""
    path = (
        location
        if location.suffix in (".yaml", ".yml") and not os.path.isdir(location)
        else location / DATASET_YAML
    )
    if not os.path.isdir(path.parent):
        raise DatasetError(
            f"{location}: the dataset could not be read: found no such folder, needed a folder "
            f"with a {DATASET_YAML}; check the path."
        )
    if not os.path.exists(path):
        raise DatasetError(
            f"{location}: the dataset could not be read: found no {path.name} in the folder, "
            "needed one; give the folder of a dataset, or make one of photographs and a table of "
            "readings (legcal init)."
        )
    return path


def read_dataset_file(path: Path) -> DatasetEntry:
    """Return the checked content of dataset.yaml."""
    return validate(DatasetEntry, read_yaml(path, "dataset file"), path)


def entry_problem(path: Path, entry: str, found: str, needed: str, remedy: str) -> Problem:
    """Return the problem of an entry of the dataset file that cannot be used."""
    sentence = f"{entry} could not be used"
    return Problem(sentence, found, needed, remedy, str(path), name=entry, code=Code.BAD_VALUE)


def view_problems(
    path: Path, views: Mapping[str, ViewEntry], boards: Collection[Link]
) -> list[Problem]:
    """Return the problems of views without legs and of hand-held views.

    *boards* are the links that have a board.
    """
    blind = [name for name, view in views.items() if view.legs == []]
    problems = []
    if blind and "platform" not in boards:
        problems.append(
            entry_problem(
                path,
                list_in_words([f"views.{name}.legs" for name in blind]),
                "no leg and no board on the platform",
                "a leg or such a board in the images of every view",
                "name legs, or describe the board in the block board (on: platform)",
            )
        )
    held = {name: view for name, view in views.items() if view.hand_held}
    problems += [
        entry_problem(
            path,
            f"views.{name}.T_base_camera",
            "one pose of a camera that is held in the hand",
            "none, each image has its own, by the board or by the legs",
            "remove it",
        )
        for name, view in held.items()
        if view.T_base_camera is not None
    ]
    return problems


def overrides_of_call(
    priors: Mapping[str, object] | Sequence[str] = (),
    fixed: Sequence[str] = (),
    free: Sequence[str] = (),
) -> tuple[Override, ...]:
    """Return the overrides in the arguments of a call or the options of a command."""
    entries: list[tuple[Action, str, object]] = []
    if isinstance(priors, Mapping):
        entries += [("prior", str(name), value) for name, value in priors.items()]
    else:
        entries += [("prior", text, None) for text in listed(priors)]
    entries += [("fixed", text, None) for text in listed(fixed)]
    entries += [("free", text, None) for text in listed(free)]
    overrides: list[Override] = []
    problems: list[str] = []
    for action, text, value in entries:
        word = "length" if action == "prior" and ":" in text else _WORDS[action]
        start = f"The {word} {describe(text)}"
        try:
            overrides.append(read_override(action, text, start, value))
        except ValueError as error:
            problems.append(f"{start} could not be used: {error}")
    if problems:
        raise UsageError(problems)
    return tuple(overrides)


def overrides_of_settings(texts: Iterable[str]) -> dict[str, list[str]]:
    """Return the settings of the option ``--set`` as the arguments priors, fixed and free.

    ``NAME`` and ``NAME=VALUE`` fix a parameter, ``NAME=VALUE±SIGMA`` is a prior, and ``NAME=free``
    estimates the parameter without one.
    """
    arguments: dict[str, list[str]] = {"priors": [], "fixed": [], "free": []}
    for text in texts:
        name, _, value = text.rpartition("=")
        if name and value.strip().casefold() == "free":
            arguments["free"].append(name)
        elif name and any(sign in value for sign in ("±", "+-", "+/-")):
            arguments["priors"].append(text)
        else:
            arguments["fixed"].append(text)
    return arguments


def read_override(
    action: Action, text: str, where: str, value: object = None, *, in_file: bool = False
) -> Override:
    """Parse an override."""
    name, stated = text, None
    if value is not None:
        stated = read_prior(value)
    elif action != "free" and "=" in text:
        name, _, behind = text.rpartition("=")
        stated = read_prior(behind) if action == "prior" else read_value(behind)
    if action == "prior" and stated is None:
        raise ValueError(
            f"found no value, needed one and its sigma; write them behind the name: {EXAMPLE}."
        )
    return Override(name, action, where, stated, in_file)


def listed(texts: str | Path | Iterable[str | Path]) -> list[str]:
    """Return texts as a list; a single text or path counts as one element."""
    return list(map(str, [texts] if isinstance(texts, str | Path) else texts))


def dataset_texts(
    machine: Machine,
    model: str,  # path of its YAML in the dataset
    views: Mapping[str, Any],
    rows: Iterable[Sequence[Any]],  # of *columns* and readings
    encoder_sigma: float | dict[str, float],
    blocks: Mapping[str, Any],
    columns: Sequence[str] = ("view", "image", "pose"),
) -> dict[str, str]:
    """Return ``dataset.yaml`` and ``measurements.csv`` of a session, by their names."""
    document = {
        "legcal_dataset": 1,
        "mechanism": model,
        "measurements": MEASUREMENTS,
        "encoder_sigma": encoder_sigma,
        "views": dict(views),
        **blocks,
    }
    text = yaml.safe_dump(
        document, sort_keys=False, default_flow_style=None, allow_unicode=True, width=100
    )
    table = format_table([*columns, *machine.motor_names], rows)
    return {DATASET_YAML: with_schema("dataset", text), MEASUREMENTS: table}
