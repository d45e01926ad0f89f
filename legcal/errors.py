"""What legcal refuses, and why.

Every message is one sentence a problem: what could not be done, what was found, what is
needed, what to do. Errors that describe a file carry all of its problems at once.
"""

import re
from collections import Counter
from collections.abc import Sequence

MAX_WORD = 200  # characters without a space: longer ones are cut in the middle
MAX_SENTENCE = 4000  # characters of one problem
MAX_MESSAGE = 16_000  # characters of all that are shown
_CONTROL = re.compile(  # not printable, or turning the direction of what is
    r"[^\x20-\x7e\xa0-\u200d\u2010-\u2027\u2030-\u2065\u206a-\ud7ff\ue000-\ufefe\uff00-\U0010ffff]"
)
_LONG_WORD = re.compile(rf"\S{{{MAX_WORD + 1},}}")
_MANY_ALIKE = 10  # problems of one kind: a message that has more spells out the first few
_SPELT_OUT = 5
_PARTICULAR = re.compile(r"'[^']*'|[^\s\d]*+\d\S*")  # what differs between problems of one kind


class LegcalError(Exception):
    """Anything that legcal refuses to do, in words meant for the person who asked.

    Attributes
    ----------
    problems : tuple of str
        One sentence for each problem found, in the order in which they were found. The message
        has them all, but of more than ten of a kind only five and how many there are besides,
        and as many as a screen or two can hold.
    exit_code : int
        The process exit code of the command line: 1 for a reason in the data, 2 for
        malformed input or wrong use.
    diagnosis : tuple of dict
        What looks wrong with the session, as ``--json`` has it; empty where nothing was found.
    """

    exit_code = 1
    diagnosis: tuple[dict[str, object], ...] = ()

    def __init__(self, problems: str | Sequence[str]) -> None:
        found = (problems,) if isinstance(problems, str) else problems
        self.problems = tuple(printable(problem) for problem in found)
        super().__init__("\n".join(_shortened(self.problems)))

    def __reduce__(self) -> tuple[type, tuple[tuple[str, ...]], dict[str, object]]:
        return type(self), (self.problems,), {"diagnosis": self.diagnosis}


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


def _shortened(problems: Sequence[str]) -> list[str]:
    """Return sentences; of more than ten of a kind five, and how many there are besides."""
    kinds = [_PARTICULAR.sub("", problem) for problem in problems]
    total, shown = Counter(kinds), Counter[str]()
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
