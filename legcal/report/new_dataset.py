"""What is said of a dataset that ``legcal init`` makes: the matching, and what was written."""

from __future__ import annotations

import shlex
from collections.abc import Sequence
from pathlib import Path

from rich.console import RenderableType
from rich.text import Text

from legcal.data import NewDataset
from legcal.errors import printable
from legcal.report.render import heading, report, table

_MOST = 200  # rows that are shown


def matching_table(new: NewDataset) -> RenderableType:
    """Return what was understood of a folder and a table, and which photograph has which row."""
    pairs = list(zip(new.matching.pairs, new.views, strict=True))
    joints = new.joints
    rows = [
        (
            str(k + 1),
            new.rows[k].image or new.rows[k].time,
            photograph.name,
            view,
            f"{1e3 * new.readings[k, 0]:z.3f}",
        )
        for (k, photograph), view in pairs[:_MOST]
    ]
    if len(pairs) > _MOST:
        rows.append(("...", "", f"{len(pairs) - _MOST} more", "", ""))
    counts = {view: new.views.count(view) for view in new.cameras}
    columns = [f"{text} is {name}" for text, name in new.columns.items() if text != name]
    what = "whole lengths of legs" if new.are_lengths else "readings"
    return report(
        heading(
            printable(str(new.destination)),
            f": {len(pairs)} photographs, {len(counts)} view{'s' * (len(counts) != 1)}, "
            f"{len(joints)} encoders",
        ),
        [
            printable(f"Columns: {', '.join(columns)}.") if columns else "",
            f"Unit of the {what}: {new.unit}, {new.unit_from}.",
            f"Photographs are matched {new.matching.how}.",
        ],
        table(
            ">row",
            "in the table",
            "photograph",
            "view",
            f">{joints[0]} [mm]",
            rows=[tuple(map(printable, row)) for row in rows],
        ),
        [
            *(
                printable(f"View {view}: {counts[view]} photographs, camera file {camera}.")
                for view, camera in new.cameras.items()
            ),
            *(Text(printable(f"note: {note}")) for note in new.notes),
        ],
    )


def written_lines(new: NewDataset, written: Sequence[Path]) -> RenderableType:
    """Return what was written, and the command that goes on from there."""
    names = ", ".join(path.name for path in written)
    folder = shlex.quote(str(new.destination))
    return report(
        [
            Text(printable(f"Written to {new.destination}: {names}."), overflow="ignore"),
            Text(printable(f"Next: legcal calibrate {folder} -o OUT"), overflow="ignore"),
        ]
    )
