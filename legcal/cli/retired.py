"""Commands and options of earlier versions: refused with what does the same now."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from legcal.errors import UsageError

COMMANDS = {
    "noise": "calibrate writes the noise of its outlines into its result, and legcal plan --noise "
    "RESULT reads it there",
}
OPTIONS: Mapping[str, Mapping[str, str]] = {}
"""What stands in place of options, by command: the rest of a sentence."""


def refuse_retired(words: Sequence[str]) -> None:
    """Refuse a command line that uses a command or an option of an earlier version.

    Parameters
    ----------
    words : sequence of str
        The command line without the name of the program.
    """
    command = words[0] if words else ""
    if command in COMMANDS:
        raise UsageError(f"legcal {command} is gone: {COMMANDS[command]}.")
    instead = OPTIONS.get(command, {})
    given = dict.fromkeys(word.partition("=")[0] for word in words[1:])
    problems = [
        f"{option} of legcal {command} is gone: {instead[option]}."
        for option in given
        if option in instead
    ]
    if problems:
        raise UsageError(problems)
