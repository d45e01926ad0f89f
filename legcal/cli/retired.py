"""Commands and options of earlier versions: refused, with their replacements."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from legcal.errors import UsageError


def _benchmark(program: str) -> str:
    """Return in words the place of a study that was a command."""
    return f"run python benchmarks/{program} of the source tree"


COMMANDS = {
    "noise": "calibrate writes the noise of its outlines into its result, and legcal plan --noise "
    "RESULT reads it there",
    "study bound": _benchmark("bound.py"),
    "study convergence": _benchmark("convergence.py"),
    "study classes": _benchmark("classes_study.py"),
}
_DRY_RUN = "what was understood is shown before it is written, and files that are there stay"
_TOPIC = "write the topic of the images behind the bag, BAG:/left/image_raw"
_ONE_MACHINE = "calibrate one dataset a call, many in a loop (docs/python.md, Many machines)"
_TABLE = "write it in the table, for which legcal new --template makes one to start from"


def _setting(text: str) -> str:
    """Return in words the Python for a setting of a simulated dataset."""
    return f"call legcal.simulate(MODEL, FOLDER, legcal.SimulationSettings({text})) in Python"


_LOOK = _setting("appearance=legcal.Appearance(...)")
OPTIONS: Mapping[str, Mapping[str, str]] = {
    "calibrate": {
        "--fix": "write --set NAME, or --set NAME=VALUE",
        "--free": "write --set NAME=free",
        "--prior": "write --set NAME=VALUE±SIGMA",
        "--significance": "call legcal.check(dataset, result, significance=P) in Python",
        "--list": _ONE_MACHINE,
        "--earlier": _ONE_MACHINE,
        "--resume": _ONE_MACHINE,
        "--transformation": "--criteria chooses how the four steps solve (18): literal as "
        "printed; leave it out",
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
    "plan": {
        "--criterion": "a plan minimises the mean error of the platform over the workspace, or the "
        "determinant of the covariance where readings do not give its pose",
        "--parameter": "a plan minimises the mean error of the platform over the workspace; the "
        "sigma that is expected of each parameter is in plan.json",
        "--camera": "a plan takes the camera of --given DATASET, or in Python "
        "legcal.plan(camera=FILE)",
        "--places": "say with --bounds where cameras may stand, or in Python "
        "legcal.plan(places=[...])",
        "--model-error": "a plan allows for 0.5 % of a leg, or in Python "
        "legcal.plan(setting=legcal.planning.places.Setting(shift=METRES, length=METRES))",
        "--encoder-sigma": "a plan takes the encoder_sigma of --given DATASET, or in Python "
        "legcal.plan(encoder_sigma=SIGMA)",
        "--force": "remove the earlier session, or give another folder",
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
    "simulate": {
        "--level axes": _setting('level="axes"'),
        "--coplanar": _setting("errors=legcal.ParameterErrors(coplanar=True, ...)"),
        "--sampling": _setting('sampling="workspace"'),
        "--shared-poses": _setting("shared_poses=True"),
        "--own-poses": "each view has its own poses",
        "--images": _setting("images=N"),
        "--views": _setting("views=N"),
        "--cameras": _setting("views=[legcal.Viewpoint(NAME, CAMERA, T_base_camera), ...]"),
        "--platform-board": _setting("platform_board=..."),
        "--board-pose": _setting("board_pose=True, ..."),
        "--hints": "rough camera poses are written",
        "--no-hints": _setting("hints=False"),
        "--gamma": "gamma is written",
        "--no-gamma": _setting("tell_gamma=False"),
        "--length": _setting('lengths={"leg1.base:leg1.platform": 5e-5}'),
        "--pixel-noise": _setting('level="outlines", sigma_px=...'),
        "--table-noise": _setting('level="axes", table=legcal.TableNoise(...)'),
        "--encoder-noise": _setting('readings=legcal.Spread(2e-6, "normal")'),
        **dict.fromkeys(
            ("--appearance", "--blur", "--clutter", "--bits", "--colour", "--grey"), _LOOK
        ),
        "--force": "give a new or empty folder, or remove the old one first",
    },
    "study": {
        "--part": "--cluster spreads the runs",
        "--merge": "the same command goes on from the runs in its folder",
    },
}
"""Replacements of options, or of a choice, by command: the rest of a sentence."""


def refuse_retired(words: Sequence[str]) -> None:
    """Refuse a command line that uses a command or an option of an earlier version.

    Parameters
    ----------
    words : sequence of str
        The command line without the name of the program.
    """
    command = words[0] if words else ""
    for name in (command, " ".join(words[:2])):
        if name in COMMANDS:
            raise UsageError(f"legcal {name} is gone: {COMMANDS[name]}.")
    instead = OPTIONS.get(command, {})
    words_given = dict[str, None]()
    for word, following in zip(words[1:], [*words[2:], ""], strict=False):
        name, equals, value = word.partition("=")
        words_given |= {name: None, f"{name} {value if equals else following}": None}
    problems = [
        f"{option} of legcal {command} is gone: {instead[option]}."
        for option in words_given
        if option in instead
    ]
    if problems:
        raise UsageError(problems)
