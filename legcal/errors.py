"""What legcal refuses, and why.

Every message is one sentence a problem: what could not be done, what was found, what is
needed, what to do. Errors that describe a file carry all of its problems at once, as facts
(:class:`Problem`): whoever adds where something is, or looks for its cause, reads no sentence.
A cause is data too (:class:`Cause`): causes with the same words and names are one cause, whatever
their figures, and are stated once with the range of the figures.
"""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Callable, Hashable, Mapping, Sequence
from dataclasses import dataclass, fields, replace
from enum import StrEnum
from pathlib import Path
from typing import Any, NamedTuple, TypeAlias, TypeVar

MAX_WORD = 200  # characters without a space: longer ones are cut in the middle
MAX_SENTENCE = 4000  # characters of one problem
MAX_MESSAGE = 16_000  # characters of all that are shown
_CONTROL = re.compile(  # not printable, or turning the direction of what is
    r"[^\x20-\x7e\xa0-\u200d\u2010-\u2027\u2030-\u2065\u206a-\ud7ff\ue000-\ufefe\uff00-\U0010ffff]"
)
_LONG_WORD = re.compile(rf"\S{{{MAX_WORD + 1},}}")
_MANY_ALIKE = 10  # problems of one kind: a message that has more spells out the first few
_SPELT_OUT = 5
HEADER = 0  # the row of a table that names its columns

_K = TypeVar("_K", bound=Hashable)


class Figures(tuple[float, ...]):
    """Numbers that are stated as a range, from the smallest to the largest."""

    def __format__(self, spec: str) -> str:
        shown = list(dict.fromkeys(format(number, spec) for number in sorted(self)))
        return " to ".join(dict.fromkeys((shown[0], shown[-1])))


Value: TypeAlias = "str | float | Figures | Cause"


@dataclass(frozen=True)
class Cause:
    """A cause: words with a place for each value, as ``str.format`` has them, and the values.

    A value is a name, a number (or several), or another cause.
    """

    words: str
    values: tuple[Value, ...] = ()

    def __str__(self) -> str:
        return self.words.format(*self.values)

    @property
    def kind(self) -> Hashable:
        """The cause without its figures."""
        return self.words, tuple(
            value.kind if isinstance(value, Cause) else value if isinstance(value, str) else None
            for value in self.values
        )


def together(causes: Sequence[Cause]) -> Cause:
    """Merge causes of one kind, with all their figures."""
    columns = zip(*(cause.values for cause in causes), strict=True)
    return Cause(causes[0].words, tuple(map(_joined, columns)))


def _joined(values: tuple[Value, ...]) -> Value:
    """Merge a value of several causes of one kind."""
    if isinstance(values[0], str):
        return values[0]
    if isinstance(values[0], Cause):
        return together([value for value in values if isinstance(value, Cause)])
    numbers: list[float] = []
    for value in values:
        if isinstance(value, int | float):
            numbers.append(value)
        elif isinstance(value, Figures):
            numbers += value
    return Figures(numbers)


def by_cause(causes: Mapping[_K, Cause]) -> list[tuple[Cause, tuple[_K, ...]]]:
    """Return each cause once, with the keys of its effects."""
    alike: dict[Hashable, dict[_K, Cause]] = {}
    for key, cause in causes.items():
        alike.setdefault(cause.kind, {})[key] = cause
    return [
        (together(list(causes_by_key.values())), tuple(causes_by_key))
        for causes_by_key in alike.values()
    ]


class Place(NamedTuple):
    """Where something is named."""

    file: str = ""
    row: int | None = None  # of a table, from 1 below its header
    line: int | None = None  # of the file, from 1

    def __str__(self) -> str:
        if self.row == HEADER:
            return f"{self.file}, header"
        if self.row is not None:
            line = f" (line {self.line})" * (self.line is not None)
            return f"{self.file}, row {self.row}{line}"
        return self.file + f", line {self.line}" * (self.line is not None)


class Code(StrEnum):
    """What kind of thing is wrong, as programs compare it.

    Where a problem has none, its code is the kind of its error: ``not-visible``.
    """

    MISSING_FILE = "missing-file"
    UNREADABLE_FILE = "unreadable-file"
    BAD_SYNTAX = "bad-syntax"  # neither YAML, XML nor CSV
    WRONG_IMAGE_SIZE = "wrong-image-size"
    MISSING_KEY = "missing-key"
    UNKNOWN_KEY = "unknown-key"
    BAD_VALUE = "bad-value"
    BAD_ELEMENT = "bad-element"  # of a URDF or MJCF file
    MISSING_COLUMN = "missing-column"
    UNKNOWN_COLUMN = "unknown-column"
    REPEATED_COLUMN = "repeated-column"
    NO_ROW = "no-row"
    BAD_ROW = "bad-row"
    REPEATED_ROW = "repeated-row"
    BAD_CELL = "bad-cell"


@dataclass(frozen=True)
class Problem:
    """One thing that is wrong, and where. Its text is the sentence that a message has.

    Where found, needed and remedy are empty, ``what`` is all that is said, as it stands: a sentence
    that ends with a command has no full stop.
    """

    what: str  # what could not be done: "the number could not be used"
    found: str | Cause = ""
    needed: str = ""
    remedy: str = ""
    file: str = ""
    row: int | None = None  # of a table, from 1 below its header, which is 0
    line: int | None = None  # of the file, from 1
    columns: tuple[str, ...] = ()  # of the table, or the place in the line
    name: str = ""  # of the entry, element or image that it is about; ``what`` says it as well
    code: Code | None = None

    def __str__(self) -> str:
        where = str(Place(self.file, self.row, self.line))
        if self.columns:
            where += f", column{'s' * (len(self.columns) > 1)} {', '.join(self.columns)}"
        said = f"{where}: {self.what}" if where else self.what
        if not (self.found or self.needed or self.remedy):
            return said
        said += f": found {self.found}" * bool(self.found)
        said += f", needed {self.needed}" * bool(self.needed)
        said += f"; {self.remedy}" * bool(self.remedy)
        return said if said.endswith((".", "?")) else f"{said}."

    @property
    def kind(self) -> Hashable:
        """What problems of one kind share; of one that is a sentence alone, all of it."""
        if self.code or self.needed:
            return self.code, self.columns, self.needed or self.remedy
        return str(self)

    def in_file(self, file: object) -> Problem:
        """Return the problem with the file that it is in, where it does not say one."""
        return self if self.file else replace(self, file=str(file))

    def moved(self, old: Path, new: Path) -> Problem:
        """Return the problem of a file that goes from one folder to another."""
        if not Path(self.file).is_relative_to(old):
            return self
        return replace(self, file=str(new / Path(self.file).relative_to(old)))

    def document(self) -> dict[str, Any]:
        """Return the facts that there are, as ``--json`` has them."""
        facts = {field.name: getattr(self, field.name) for field in fields(self)}
        return {
            key: printable(str(value)) if isinstance(value, str | Cause) else value
            for key, value in facts.items()
            if value not in ("", None, ())
        }


class BadValue(ValueError):
    """A value cannot be used: what was found and what is needed; its reader knows where."""

    def __init__(self, found: str | Cause, needed: str, remedy: str) -> None:
        super().__init__(f"found {found}, needed {needed}; {remedy}.")
        self.found, self.needed, self.remedy = found, needed, remedy


class LegcalError(Exception):
    """Anything that legcal refuses to do, in words meant for the person who asked.

    Attributes
    ----------
    facts : tuple of Problem
        What is wrong, in the order in which it was found.
    problems : tuple of str
        One sentence for each of them. The message has them all, but of more than ten of a kind
        only five and how many there are besides, and as many as a screen or two can hold.
    exit_code : int
        The process exit code of the command line: 1 for a reason in the data, 2 for
        malformed input or wrong use.
    diagnosis : tuple of dict
        The likely mistakes of the session, as ``--json`` has them; empty without any.
    consequences : tuple of Problem
        Problems that may follow from these mistakes. The message only counts them; documents have
        them with their codes.
    notes : tuple of str
        What is odd, allowed, and perhaps the cause; the command line shows it below the problems.
    """

    exit_code = 1
    diagnosis: tuple[dict[str, object], ...] = ()
    consequences: tuple[Problem, ...] = ()
    notes: tuple[str, ...] = ()

    def __init__(
        self,
        problems: str | Problem | Sequence[str | Problem],
        found: str | Cause = "",
        needed: str = "",
        remedy: str = "",
        file: object = "",
    ) -> None:
        """Take problems, or what could not be done with the facts of a :class:`Problem`."""
        if isinstance(problems, str):
            problems = Problem(problems, found, needed, remedy, str(file))
        said = [problems] if isinstance(problems, Problem) else problems
        self.facts = tuple(Problem(one) if isinstance(one, str) else one for one in said)
        self.problems = tuple(printable(str(problem)) for problem in self.facts)
        super().__init__("\n".join(_shortened(self.facts, self.problems)))

    def __reduce__(self) -> tuple[type, tuple[tuple[Problem, ...]], dict[str, object]]:
        state: dict[str, object] = {"diagnosis": self.diagnosis, "notes": self.notes}
        state["consequences"] = self.consequences
        return type(self), (self.facts,), state

    def documents(self) -> list[dict[str, Any]]:
        """Return facts and consequences as ``--json`` has them, each with its code."""
        code = code_of_kind(type(self).__name__)
        return [{"code": code, **fact.document()} for fact in (*self.facts, *self.consequences)]

    def map_problems(self, change: Callable[[Problem], Problem]) -> LegcalError:
        """Return an error of the same kind with every problem replaced by *change* of it."""
        error = type(self)([change(problem) for problem in self.facts])
        error.diagnosis, error.notes = self.diagnosis, self.notes
        error.consequences = tuple(map(change, self.consequences))
        return error


def code_of_kind(kind: str) -> str:
    """Return the code of a problem that has no other: ``not-visible`` for ``NotVisible``."""
    return re.sub(r"\B(?=[A-Z])", "-", kind).lower()


def printable(text: str) -> str:
    """Return text, also of foreign files, as it may be shown: one line, no control characters.

    Control characters (escape sequences of terminals, changes of direction, ends of lines) are
    written as escapes; words and texts that are too long are cut in the middle.
    """
    text = _LONG_WORD.sub(lambda word: _cut(word[0], MAX_WORD), text)
    return _cut(escaped(text), MAX_SENTENCE)


def escaped(text: str) -> str:
    """Return text with control characters written as escapes, ends of lines as spaces."""
    return _CONTROL.sub(_escape, text)


def _escape(match: re.Match[str]) -> str:
    character = match[0]
    return " " if character in "\n\r\t" else character.encode("unicode_escape").decode()


def _cut(text: str, most: int) -> str:
    if len(text) <= most:
        return text
    return f"{text[: 2 * most // 3]} ... {text[-most // 4 :]}"


def _shortened(facts: Sequence[Problem], problems: Sequence[str]) -> list[str]:
    """Return sentences; of more than ten of a kind five, and how many there are besides."""
    kinds = [fact.kind for fact in facts]
    total, shown = Counter(kinds), Counter[Hashable]()
    lines = []
    for kind, problem in zip(kinds, problems, strict=True):
        shown[kind] += 1
        if total[kind] <= _MANY_ALIKE or shown[kind] <= _SPELT_OUT:
            lines.append(problem)
        elif shown[kind] == _SPELT_OUT + 1:
            lines.append(f"... and {total[kind] - _SPELT_OUT} more like these.")
    length = 0
    for k, line in enumerate(lines):
        length += len(line)
        if k and length > MAX_MESSAGE:
            return [*lines[:k], f"... and {len(lines) - k} more."]
    return lines


class UsageError(LegcalError):
    """A command or a function was asked for something that it does not offer."""

    exit_code = 2


class ModelError(LegcalError):
    """A mechanism file is malformed or contradicts itself."""

    exit_code = 2


class Problems(list[Problem]):
    """The problems of a file, collected to be raised together."""

    def __init__(self, file: object) -> None:
        super().__init__()
        self.file = str(file)

    def add(
        self,
        what: str,
        found: str | Cause = "",
        needed: str = "",
        remedy: str = "",
        line: int | None = None,
        name: str = "",
    ) -> None:
        """Add a problem of the file."""
        self.append(Problem(what, found, needed, remedy, self.file, line=line, name=name))

    def raise_if_any(self, kind: type[LegcalError] = ModelError) -> None:
        """Raise all problems as one error."""
        if self:
            raise kind(self)


class OutOfClass(LegcalError):
    """A well-formed mechanism that the method does not cover."""


class DatasetError(LegcalError):
    """A dataset is malformed, incomplete or contradicts its mechanism."""

    exit_code = 2


class NotVisible(LegcalError):
    """The images do not show what is needed."""


class NotIdentifiable(LegcalError):
    """The observations do not determine what was asked for."""


class DidNotConverge(LegcalError):
    """An iterative method stopped before it reached its tolerance."""


class OutOfResources(LegcalError):
    """The machine did not give what the work needs, such as memory."""
