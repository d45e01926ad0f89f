"""Text reports of a new dataset: matching, frames of recordings, written files."""

from __future__ import annotations

import shlex
from collections import Counter
from collections.abc import Sequence
from pathlib import Path

from rich.text import Text

from legcal.data.new_dataset import NewDataset
from legcal.errors import printable
from legcal.files.quantity import SHOWN_IN
from legcal.machine.model import Machine
from legcal.pages.document import Table
from legcal.recordings.importing import Import
from legcal.report.machine import scale_option
from legcal.report.render import Report, heading, report, table

_MOST = 200  # largest number of rows shown


def matching_table(new: NewDataset) -> Report:
    """Return the interpretation of a folder and a table: columns, units, matched photographs."""
    pairs = list(zip(new.matching.pairs, new.views, strict=True))
    joints = new.joints
    size, unit = SHOWN_IN[new.machine.legs[new.machine.motors[0]].reading_unit]
    rows = [
        (
            str(k + 1),
            new.rows[k].image or new.rows[k].time,
            photograph.name,
            view,
            f"{size * new.readings.q[k, 0]:z.3f}",
        )
        for (k, photograph), view in pairs[:_MOST]
    ]
    if len(pairs) > _MOST:
        rows.append(("...", "", f"{len(pairs) - _MOST} more", "", ""))
    counts = {view: new.views.count(view) for view in new.cameras}
    columns = [f"{text} is {name}" for text, name in new.columns.items() if text != name]
    noun = "whole lengths of legs" if new.are_lengths else "readings"
    return report(
        heading(
            printable(str(new.destination)),
            f": {len(pairs)} photographs, {len(counts)} view{'s' * (len(counts) != 1)}, "
            f"{len(joints)} encoders",
        ),
        [
            printable(f"Columns: {', '.join(columns)}.") if columns else "",
            f"Unit of the {noun}: {new.readings.unit}, {new.readings.unit_from}.",
            f"Photographs are matched {new.matching.how}.",
        ],
        table(
            ">row",
            "in the table",
            "photograph",
            "view",
            f">{joints[0]} [{unit}]",
            rows=[tuple(map(printable, row)) for row in rows],
        ),
        [
            *(
                printable(
                    f"View {view}: {counts[view]} photograph{'s' * (counts[view] != 1)}, camera "
                    f"file {camera}."
                )
                for view, camera in new.cameras.items()
            ),
            *(Text(printable(f"note: {note}")) for note in new.notes),
        ],
    )


def written_lines(destination: Path, written: Sequence[Path], machine: Machine) -> Report:
    """Return the written files and the next command."""
    names = ", ".join(path.name for path in written)
    folder, length = shlex.quote(str(destination)), scale_option(machine, board=False)
    return report(
        [
            Text(printable(f"Written to {destination}: {names}."), overflow="ignore"),
            Text(printable(f"Next: legcal calibrate {folder} -o OUT{length}"), overflow="ignore"),
        ]
    )


def import_table(recording_import: Import) -> Report:
    """Return the used frames of recordings, and the reasons for leaving out others."""
    blocks: list[Text | Table | list[str] | list[Text]] = []
    for view in recording_import.views:
        block = view.block
        stills, unused = block.stills, Counter(s.why_not for s in block.stills if s.why_not)
        rows = [
            (f"{s.begin_s:.2f}", f"{s.end_s - s.begin_s:.2f}", s.why_not or f"frame {s.frame}")
            for s in stills[:_MOST]
        ]
        if len(stills) > _MOST:
            rows.append(("...", "", f"{len(stills) - _MOST} more"))
        offset = f"{block.offset_s:+.3f} s"
        if block.agreement is not None:
            offset += f" (+-{block.offset_sigma_s:.3f} s, motion agrees to {block.agreement:.0%})"
        reasons = [f"{n} {why_not}" for why_not, n in unused.items()]
        blocks += [
            heading(
                printable(view.name),
                f": {block.used} of {len(stills)} rests in {block.frames} frames are used",
            ),
            [
                printable(f"Clock of {block.recording} less that of {block.readings}: {offset}."),
                f"Unit of the readings: {view.unit}.",
                f"Not used: {', '.join(reasons)}." if reasons else "",
            ],
            table(">rest from [s]", ">for [s]", "used", rows=rows),
            [Text(printable(f"note: {note}")) for note in block.notes],
        ]  # fmt: skip
    sigma = recording_import.encoder_sigma
    scatter_in_words = (
        f"{1e6 * sigma:.3g} um"
        if isinstance(sigma, float)
        else ", ".join(f"{name} {scatter:.3g}" for name, scatter in sigma.items()) + " [m or rad]"
    )
    return report(*blocks, [f"encoder_sigma, the scatter at rest: {scatter_in_words}."])
