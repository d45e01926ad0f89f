"""What people read of an examination: a line a check, figures of views, findings with remedies."""

from __future__ import annotations

import shlex

from rich.console import RenderableType
from rich.text import Text

from legcal.calibration.examination import Examination
from legcal.calibration.summary import UNITS
from legcal.errors import printable
from legcal.report.render import heading, report, table

_STYLES = {"ok": "green", "note": "green", "warning": "yellow", "error": "red"}
_STATES = {"ok": "ok", "note": "ok", "warning": "look", "error": "wrong"}


def examination_table(found: Examination) -> RenderableType:
    """Return what ``legcal doctor`` found."""
    checks = [
        (one.name, Text(_STATES[one.state], style=_STYLES[one.state]), printable(one.found))
        for one in found.checks
    ]
    views = [
        (
            printable(one.view),
            str(one.images),
            "-" if one.blur_px is None else f"{one.blur_px:.1f} px",
            "-" if one.clipped is None else f"{100 * one.clipped:.0f} %",
            "-" if one.jpeg_quality is None else str(one.jpeg_quality),
            "-" if one.legs_found is None else f"{one.legs_found}/{one.legs_visible}",
        )
        for one in found.views
    ]
    encoders = [
        (
            printable(one.column),
            f"{UNITS[one.unit][0] * one.least:z.3f}",
            f"{UNITS[one.unit][0] * one.greatest:z.3f}",
            "-"
            if one.travel is None
            else " to ".join(f"{UNITS[one.unit][0] * end:z.6g}" for end in one.travel),
            "-" if one.used is None else f"{100 * one.used:.0f} %",
        )
        for one in found.encoders
    ]
    units = dict.fromkeys(UNITS[one.unit][1] for one in found.encoders)
    return report(
        heading(printable(found.mechanism), f": {printable(found.dataset)}"),
        table("check", "", "found", rows=checks),
        table("view", ">images", ">blur", ">clipped", ">JPEG", ">legs found", rows=views)
        if views
        else None,
        table(
            f"encoder [{', '.join(units)}]",
            ">least",
            ">greatest",
            ">travel",
            ">used",
            rows=encoders,
        )
        if encoders
        else None,
        [
            Text.assemble((f"{one.severity}: ", _STYLES[one.severity]), printable(one.what))
            for one in found.findings
        ],
        _verdict(found),
    )


def _verdict(found: Examination) -> str:
    """Return whether to go on, and with what."""
    wrong = sum(one.severity == "error" for one in found.findings)
    odd = sum(one.severity == "warning" for one in found.findings)
    look = f"{odd} thing{'s' * (odd != 1)} to look at"
    if wrong:
        return f"{wrong} thing{'s' * (wrong != 1)} to mend before calibrating" + (
            f", {look}." if odd else "."
        )
    ready = f"Nothing stands against calibrating{f', {look}' if odd else ''}"
    return f"{ready}: legcal calibrate {shlex.quote(printable(found.dataset))} -o OUT"
