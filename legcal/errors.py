"""What legcal refuses, and why.

Every message is one sentence a problem: what could not be done, what was found, what is
needed, what to do. Errors that describe a file carry all of its problems at once.
"""

from collections.abc import Sequence


class LegcalError(Exception):
    """Anything that legcal refuses to do, in words meant for the person who asked.

    Attributes
    ----------
    problems : tuple of str
        One sentence for each problem found, in the order in which they were found.
    exit_code : int
        The process exit code of the command line: 1 for a reason in the data, 2 for
        malformed input or wrong use.
    """

    exit_code = 1

    def __init__(self, problems: str | Sequence[str]) -> None:
        self.problems = (problems,) if isinstance(problems, str) else tuple(problems)
        super().__init__("\n".join(self.problems))

    def __reduce__(self) -> tuple[type, tuple[tuple[str, ...]]]:
        return type(self), (self.problems,)


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
