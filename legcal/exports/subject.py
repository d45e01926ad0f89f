"""The subject of an export: a machine, and the result that it comes from."""

from __future__ import annotations

import os
import re
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from legcal.machine.leg import LegColumns
from legcal.machine.loader import load_mechanism
from legcal.machine.model import Machine
from legcal.machine.model_writer import model_name
from legcal.machine.parameters import geometries, legs_in_links, parametrization_of, with_numbers

if TYPE_CHECKING:
    from legcal.calibration.result_folder import EarlierResult
    from legcal.data.dataset import Dataset

RESULT_NAME = "result.json"


@dataclass(frozen=True, eq=False)
class Subject:
    """A mechanism, with the result that it comes from and a session of it, if any."""

    machine: Machine
    given: str  # argument of the caller
    nominal: Machine | None = None  # nominal machine (legs only); None for a model
    result: EarlierResult | None = None
    dataset: Dataset | None = None  # with readings in the order of the legs

    @property
    def name(self) -> str:
        """The name of the machine: from its URDF for a result, else from its file."""
        return model_name(self.machine) if self.result is None else self.machine.urdf.name

    @property
    def warning(self) -> tuple[str, ...]:
        """The verdict of a calibration that is in doubt, else nothing."""
        document = None if self.result is None else self.result.document
        return () if document is None or document.trustworthy else (document.verdict,)


@dataclass(frozen=True)
class Rendered:
    """The files of a format, with notes and figures."""

    # contents by name: of a folder relative to it; else what follows the name asked for, "" if that
    files: Mapping[str, bytes]
    notes: tuple[str, ...] = ()  # notes for the reader, one sentence each
    figures: Mapping[str, Any] = field(default_factory=dict)  # for ``--json``


def one_file(text: str) -> Rendered:
    """Return the rendering of a format with a single text file."""
    return Rendered({"": text.encode()})


def other_gains(machine: Machine) -> str:
    """Return the motor gains other than 1, which formats cannot hold, in words."""
    return ", ".join(f"'{a.joint}' {a.gain:.9g}" for a in machine.actuators if a.gain != 1.0)


def load_subject(given: str | Path | Machine | EarlierResult) -> Subject:
    """Return the subject of an export: a result, its folder or ``result.json``, or a mechanism.

    Raises DatasetError if the result is damaged, or of another version. Raises ModelError if there
    is no such mechanism.
    """
    if isinstance(given, Machine):
        return Subject(given, str(given.yaml_path))
    if not isinstance(given, (str, os.PathLike)):
        return Subject(given.machine, str(given.folder), _nominal(given), given)
    path = Path(given)
    if os.path.isfile(path / RESULT_NAME) or path.name == RESULT_NAME:
        from legcal.calibration.result_folder import load_result

        result = load_result(path)
        return Subject(result.machine, str(given), _nominal(result), result)
    return Subject(load_mechanism(given), str(given))


def _nominal(result: EarlierResult) -> Machine:
    """Return the nominal machine of a result, in the same links; only its legs are nominal."""
    from legcal.calibration.result_folder import with_nominal_axes

    machine = result.machine
    parametrization = parametrization_of(machine, twists=True)
    values = {row.name: row.nominal for row in result.document.parameters}
    legs = with_nominal_axes(machine.leg_names, geometries(machine), result.document, values)
    nominal = [values.get(name, np.nan) for name in parametrization.names]
    numbers = np.append(nominal, np.nan)[parametrization.place]
    stated = np.isfinite(numbers)
    stated[:, LegColumns.LENGTH + 1 :] = False  # axes, twists and actuators are nominal already
    return replace(machine, legs=legs_in_links(machine, with_numbers(legs, legs, numbers, stated)))


# Names of a machine as identifiers and literals of other languages


MAX_IDENTIFIER = 40  # letters: MATLAB names have at most 63, with prefixes
# Reserved in Python, C or MATLAB, so that a machine has the same name in all of them.
_RESERVED = frozenset(
    {
        "false", "none", "true", "and", "as", "assert", "async", "await", "auto", "bool",
        "break", "case", "catch", "char", "class", "classdef", "const", "continue", "def",
        "default", "del", "do", "double", "elif", "else", "elseif", "end", "enum", "except",
        "extern", "finally", "float", "for", "from", "function", "global", "goto", "if",
        "import", "in", "inline", "int", "is", "lambda", "long", "nonlocal", "not", "or",
        "otherwise", "parfor", "pass", "persistent", "raise", "register", "restrict",
        "return", "short", "signed", "sizeof", "spmd", "static", "struct", "switch", "try",
        "typedef", "union", "unsigned", "void", "volatile", "while", "with", "yield"
    }
)  # fmt: skip


def identifier(name: str) -> str:
    """Return a name as an identifier of ASCII letters, digits and underscores."""
    text = re.sub(r"[^A-Za-z0-9]+", "_", name).strip("_")[:MAX_IDENTIFIER].lower()
    if not text or text[0].isdigit() or text in _RESERVED:
        text = f"m_{text}".rstrip("_")
    return text


def is_identifier(name: str) -> bool:
    """Return whether a name is an identifier in all languages."""
    return re.fullmatch(r"[A-Za-z][A-Za-z0-9_]{0,62}", name) is not None and name not in _RESERVED


def identifiers(names: Iterable[str]) -> list[str]:
    """Return names as distinct identifiers."""
    unique_names: list[str] = []
    for name in names:
        plain, number = identifier(name), 1
        unique = plain
        while unique in unique_names:
            number += 1
            unique = f"{plain}_{number}"
        unique_names.append(unique)
    return unique_names


def c_string(text: str) -> str:
    """Return text as a C literal, in UTF-8."""
    return '"' + "".join(_c_byte(byte) for byte in text.encode()) + '"'


def _c_byte(byte: int) -> str:
    letter = chr(byte)
    is_plain = 0x20 <= byte < 0x7F and letter not in '"\\?'
    return letter if is_plain else f"\\{byte:03o}"


def matlab_string(text: str) -> str:
    """Return text as a character vector of MATLAB."""
    return "'" + text.replace("'", "''") + "'"


def comment(text: str) -> str:
    """Return text for a comment of any language: one line of ASCII without comment ends."""
    return re.sub(r"[^A-Za-z0-9 ._,;:()+=-]", "_", text)
