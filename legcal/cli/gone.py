"""Options of earlier versions: each is refused in one sentence that names what takes its place."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import zip_longest

from legcal.errors import UsageError


def _setting(text: str) -> str:
    return f"legcal.simulate(MODEL, FOLDER, legcal.SimulationSettings({text})) in Python"


_LOOK = "appearance=legcal.Appearance({}=...)"
GONE: Mapping[str, Mapping[str, str]] = {  # by command: what is to be written instead
    "simulate": {
        "--level=axes": _setting('level="axes"'),
        "--coplanar": _setting("errors=legcal.ParameterErrors(coplanar=True, ...)"),
        "--sampling": _setting('sampling="workspace"'),
        "--shared-poses": _setting("shared_poses=True"),
        "--own-poses": "nothing, each view has its own poses",
        "--images": _setting("images=N"),
        "--views": _setting("views=N"),
        "--cameras": _setting("views=[legcal.Viewpoint(NAME, CAMERA, T_base_camera), ...]"),
        "--platform-board": _setting("platform_board=..."),
        "--board-pose": _setting("board_pose=True, ..."),
        "--hints": "nothing, rough camera poses are written",
        "--no-hints": _setting("hints=False"),
        "--gamma": "nothing, gamma is written",
        "--no-gamma": _setting("tell_gamma=False"),
        "--length": _setting('lengths={"leg1.base:leg1.platform": 5e-5}'),
        "--pixel-noise": _setting('level="outlines", sigma_px=...'),
        "--table-noise": _setting('level="axes", table=legcal.TableNoise(...)'),
        "--encoder-noise": _setting('readings=legcal.Spread(2e-6, "normal")'),
        **{
            f"--{name}": _setting(_LOOK.format(name))
            for name in ("blur", "clutter", "bits", "colour")
        },
        "--appearance": _setting("appearance=legcal.Appearance(...)"),
        "--grey": _setting("appearance=legcal.Appearance(colour=False)"),
        "--force": "a new or empty folder; remove the old one first",
    },
    "study paper": {
        "--part": "--cluster, which spreads the runs",
        "--merge": "the folder of the study with -o, which goes on from the runs in it",
    },
}


def refuse_gone(words: Sequence[str]) -> None:
    """Refuse an option that a command had in an earlier version."""
    for command, options in GONE.items():
        n = len(command.split())
        if " ".join(words[:n]) != command:
            continue
        for word, following in zip_longest(words[n:], words[n + 1 :], fillvalue=""):
            name, equals, value = word.partition("=")
            for found in (name, f"{name}={value if equals else following}"):
                if found in options:
                    raise UsageError(
                        f"{found.replace('=', ' ')} could not be used: found an option of legcal "
                        f"{command} in earlier versions, needed {options[found]}."
                    )
