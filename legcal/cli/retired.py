"""Commands and options of earlier versions: refused with what does the same now."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from legcal.errors import UsageError

COMMANDS = {
    "noise": "calibrate writes the noise of its outlines into its result, and legcal plan --noise "
    "RESULT reads it there",
}
_DRY_RUN = "what was understood is shown before it is written, and files that are there stay"
_TOPIC = "write the topic of the images behind the bag, BAG:/left/image_raw"
_ONE_MACHINE = "calibrate one dataset a call, many in a loop (docs/python.md, Many machines)"
_TABLE = "write it in the table, for which legcal new --template makes one to start from"
OPTIONS: Mapping[str, Mapping[str, str]] = {
    "calibrate": {
        "--fix": "write --set NAME, or --set NAME=VALUE",
        "--free": "write --set NAME=free",
        "--prior": "write --set NAME=VALUE±SIGMA",
        "--significance": "call legcal.check(dataset, result, significance=P) in Python",
        "--list": _ONE_MACHINE,
        "--earlier": _ONE_MACHINE,
        "--resume": _ONE_MACHINE,
        "--transformation": "the four steps solve (18) as printed, whatever the criteria; leave "
        "it out",
    },
    "init": {
        "--servo": "write centre_us and us_per_deg of each servo into legcal.motors of the model",
        "--views": "give a FOLDER that holds only the photographs to use",
        "--view-pattern": "put the photographs of each place in a folder, or add a column view",
        "--match": "rows and photographs are matched by a column image, else by a column time, "
        "else in order; remove the column that is not to count",
        "--dry-run": _DRY_RUN,
    },
    "import": {
        "--unit": "state the unit in the headings of the table, such as 'leg1 [mm]'",
        "--still": "rests of 0.3 s and more are used",
        "--image-topic": _TOPIC,
        "--joint-topic": "joint states are read from the only topic that has them or from "
        "/joint_states; give others as a table with --readings",
        "--dry-run": _DRY_RUN,
    },
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
    },
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
