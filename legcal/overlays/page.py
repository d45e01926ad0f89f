"""A page with the figures of every view and all pictures; it needs no network."""

from __future__ import annotations

from collections.abc import Mapping
from html import escape
from typing import Any
from urllib.parse import quote

import numpy as np

from legcal.detection.outline import OUTSIDE
from legcal.observations.table import row_names
from legcal.overlays.detected import Detection
from legcal.overlays.figures import reason_class

_HEAD = """<!DOCTYPE html>
<html lang="en"><head><meta charset="utf-8"><title>{title}</title><style>
body {{ font: 15px/1.45 system-ui, sans-serif; margin: 1.5em; color: #222; }}
table {{ border-collapse: collapse; margin: .7em 0; }}
th, td {{ padding: .25em .8em; border-bottom: 1px solid #ddd; text-align: right; }}
th:first-child, td:first-child, th:last-child, td:last-child {{ text-align: left; }}
.views {{ display: grid; grid-template-columns: repeat(auto-fill, minmax(330px, 1fr)); gap: 1em; }}
figure {{ margin: 0; }} figcaption {{ font-size: 13px; }} img {{ width: 100%; }}
.bad {{ color: #b00; }} .dim {{ color: #777; }}
</style></head><body>
"""
_COLUMNS = ("view", "images", "legs found", "of visible", "outlines used", "of", "contrast",
            "length [px]", "residual [px]", "rejected")  # fmt: skip
_HOW = (
    "To correct an outline, edit its row in observations.csv: set its verdict, or its line "
    "(a, b, c) and ends, and its source to edited; then copy the file into the dataset."
)


def overlay_page(
    detection: Detection, document: Mapping[str, Any], pictures: Mapping[int, str]
) -> str:
    """Return the text of ``index.html``.

    Parameters
    ----------
    detection : Detection
        What was found.
    document : mapping
        Its document.
    pictures : mapping of int to str
        The picture of each row, relative to the page.
    """
    title = f"Outlines of {detection.dataset.mechanism.name}"
    parts = [_HEAD.format(title=escape(title)), f"<h1>{escape(title)}</h1>\n"]
    parts.append(
        f"<p>{document['used']} of {document['outlines']} outlines in {document['images']} images "
        f"are used.</p>\n{_table(document['views'])}<p class=dim>{escape(_HOW)}</p>\n"
    )
    parts += [f"<p>{escape(note)}</p>\n" for note in document["notes"]]
    names = row_names(detection.dataset.measurements)
    for view, figures in document["views"].items():
        rows = [row for row in pictures if detection.view_of(row) == view]
        parts.append(f'<h2 id="{escape(view)}">{escape(view)}</h2>\n')
        if figures["problem"]:
            parts.append(f"<p class=bad>{escape(figures['problem'])}</p>\n")
        parts.append("<div class=views>\n")
        parts += [_figure(names[row], pictures[row], _said(detection, row)) for row in rows]
        parts.append("</div>\n")
    return "".join([*parts, "</body></html>\n"])


def _table(views: Mapping[str, Any]) -> str:
    """Return the figures of the views as a table."""
    rows = ["<tr>" + "".join(f"<th>{name}</th>" for name in _COLUMNS) + "</tr>"]
    for name, view in views.items():
        rejected = ", ".join(f"{n} {escape(why)}" for why, n in view["rejected"].items())
        cells = (
            f'<a href="#{escape(name)}">{escape(name)}</a>',
            view["images"],
            view["legs_found"],
            view["legs_visible"],
            view["used"],
            view["outlines"],
            _number(view["contrast"], 1),
            _number(view["length"], 0),
            _number(view["residual"], 3),
            "<span class=bad>camera not placed</span>" if view["problem"] else rejected,
        )
        rows.append("<tr>" + "".join(f"<td>{cell}</td>" for cell in cells) + "</tr>")
    return "<table>" + "\n".join(rows) + "</table>\n"


def _number(value: float | None, digits: int) -> str:
    return "" if value is None else f"{value:.{digits}f}"


def _figure(name: str, file: str, said: str) -> str:
    """Return a picture with its name and what was found."""
    place = quote(file)
    return (
        f'<figure><a href="{place}"><img loading=lazy src="{place}" alt=""></a>'
        f"<figcaption>{escape(name)}: {said}</figcaption></figure>\n"
    )


def _said(detection: Detection, row: int) -> str:
    """Return what was found in the image of a row."""
    outlines, legs = detection.outlines, detection.dataset.mechanism.leg_names
    here = np.flatnonzero(outlines.row == row).tolist()
    said = f"{np.count_nonzero(outlines.used[here])} of {len(here)} used"
    wrong: dict[str, list[str]] = {}
    for i in here:
        if not outlines.used[i] and outlines.reason[i] != OUTSIDE:
            name = legs[outlines.leg[i]]
            names = wrong.setdefault(reason_class(outlines.reason[i]), [])
            if name not in names:
                names.append(name)
    told = "; ".join(f"{', '.join(names)}: {why}" for why, names in wrong.items())
    return said + (f" <span class=bad>({escape(told)})</span>" if told else "")
