"""Commands and options of earlier versions: refused with what does the same now."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from legcal.errors import UsageError

COMMANDS: Mapping[str, str] = {}
_TABLE = "write it in the table, for which legcal new --template makes one to start from"
OPTIONS: Mapping[str, Mapping[str, str]] = {
    "new": {
        "--offset": "write offsets in the table (in a CSV the column offset), or give --min-length "
        "and --max-length",
        "--travel": "write travel in the table (in a CSV the columns travel_low and travel_high), "
        "or give --min-length and --max-length",
        "--platform-in": "write platform_in in the table (in a CSV a column of that name)",
        "--base-spread": _TABLE,
        "--platform-spread": _TABLE,
        "--turn": _TABLE,
        "--tilt": "write base_axes and platform_axes in the table",
        "--arm-radius": "write arm_radius of each motor in the table, for which legcal new "
        "--template --family delta makes one to start from",
        "--rod-spacing": "write the joints in the table, for which legcal new --template --family "
        "delta makes one to start from",
    }
}
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
