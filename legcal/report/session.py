"""Text reports of a dataset: imported, examined, simulated; and of the paper's simulation."""

from __future__ import annotations

import shlex
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rich.text import Text

from legcal.files.quantity import SHOWN_IN
from legcal.machine.model import Machine
from legcal.pages.document import Table
from legcal.report.machine import scale_option, understood
from legcal.report.render import Report, heading, report, table

if TYPE_CHECKING:
    from legcal.calibration.detection import Examination
    from legcal.data.new_dataset import NewDataset
    from legcal.recordings.importing import Import

_MOST = 200  # largest number of rows shown
_OFTEN = 0.5  # smallest share of images with a leg without a remark
_STYLES = {"note": "green", "warning": "yellow", "error": "red"}
_LABELS = {
    "initial": "before",
    "literal": "steps as printed",
    "default": "weighted steps",
}
_COLUMNS = ("joints", ">dX [mm]", ">dE [deg]", ">parameters [mm]", ">runs")
_LARGE = 10.0  # smallest value with fewer digits, in the unit of its column


def matching_table(new: NewDataset) -> Report:
    """Return the interpretation of a folder and a table: columns, units, matched photographs."""
    table_of, pairs = new.sheet.table, new.pairs
    images, times = table_of.text("image"), table_of.text("time")
    shown = [
        (joint, *SHOWN_IN[leg.reading_unit])
        for leg in (new.machine.legs[j] for j in new.machine.motors)
        if (joint := str(leg.prismatic)) in new.readings.joints
    ][:1]
    rows = [
        (
            str(k + 1),
            images[k] or times[k],
            photograph.name,
            photograph.view,
            *(f"{size * new.readings_of(k)[joint]:z.3f}" for joint, size, _ in shown),
        )
        for k, photograph in pairs[:_MOST]
    ]
    if len(pairs) > _MOST:
        rows.append(("...", "", f"{len(pairs) - _MOST} more", "", *("" for _ in shown)))
    counts = Counter(photograph.view for _, photograph in pairs)
    noun = "whole lengths of legs" if new.readings.are_lengths else "readings"
    unit_in_table = new.readings.unit and f"{new.readings.unit}, {new.readings.unit_from}"
    return report(
        heading(
            str(new.destination),
            f": {len(pairs)} photographs, {len(counts)} view{'s' * (len(counts) != 1)}, "
            f"{len(new.readings.joints)} encoders",
        ),
        [
            *understood(new.sheet.taken, noun, unit_in_table),
            f"Photographs are matched {new.matched}.",
        ],
        table(
            ">row",
            "in the table",
            "photograph",
            "view",
            *(f">{joint} [{unit}]" for joint, _, unit in shown),
            rows=rows,
        ),
        [
            *(
                f"View {view}: {counts[view]} photograph{'s' * (counts[view] != 1)}, camera file "
                f"{camera}."
                for view, camera in new.cameras.items()
            ),
            *(f"note: {note}" for note in new.notes),
        ],
    )


def written_lines(destination: Path, written: Sequence[Path], machine: Machine) -> Report:
    """Return the written files and the next command."""
    names = ", ".join(path.name for path in written)
    folder, length = shlex.quote(str(destination)), scale_option(machine, board=False)
    return report(
        [
            Text(f"Written to {destination}: {names}.", overflow="ignore"),
            "Calibrate it:",
            f"  legcal calibrate {folder} -o OUT{length}",
        ]
    )


def import_table(recording_import: Import) -> Report:
    """Return the used frames of recordings, and the reasons for leaving out others."""
    blocks: list[Text | Table | list[str]] = []
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
                view.name,
                f": {block.used} of {len(stills)} rests in {block.frames} frames are used",
            ),
            [
                f"Clock of {block.recording} less that of {block.readings}: {offset}.",
                f"Unit of the readings: {view.unit}.",
                f"Not used: {', '.join(reasons)}." if reasons else "",
            ],
            table(">rest from [s]", ">for [s]", "used", rows=rows),
            [f"note: {note}" for note in block.notes],
        ]  # fmt: skip
    sigma = recording_import.encoder_sigma
    scatter_in_words = (
        f"{1e6 * sigma:.3g} um"
        if isinstance(sigma, float)
        else ", ".join(f"{name} {scatter:.3g}" for name, scatter in sigma.items()) + " [m or rad]"
    )
    return report(*blocks, [f"encoder_sigma, the scatter at rest: {scatter_in_words}."])


def examination_table(examination: Examination, output: Path | None = None) -> Report:
    """Return the text of ``legcal doctor`` and ``legcal detect``; *output* is the folder."""
    from legcal.calibration.detection import DETECTION_PAGE, tables_of  # not needed to simulate

    return report(
        heading(examination.mechanism, f": {examination.dataset}"),
        *map(_with_dashes, tables_of(examination)),
        [
            Text.assemble((f"{finding.severity}: ", _STYLES[finding.severity]), finding.what)
            for finding in examination.findings
        ],
        [examination.sentence, "" if output is None else f"Look at {output / DETECTION_PAGE}."],
    )


def _with_dashes(table: Table) -> Table:
    """Return a table whose empty cells have dashes."""
    texts = [[cell if isinstance(cell, str) else cell.text for cell in row] for row in table.rows]
    return replace(table, rows=[[text or "-" for text in row] for row in texts])


def simulation_table(document: dict[str, Any], *, to_measure: str = "") -> Report:
    """Return the document of ``simulate``: the number of images of each view with each leg.

    *to_measure* is the distance that would fix the scale, if nothing in the dataset does.
    """
    n_images, n_poses, left_out = (document[key] for key in ("images", "poses", "left_out"))
    views = document["views"]
    legs = list(dict.fromkeys(name for view in views.values() for name in view["legs"]))
    rows = [
        (name, str(view["images"]), *(str(n) for n in view["legs"].values()))
        for name, view in views.items()
    ]
    folder = shlex.quote(document["dataset"])
    length = f"--length {to_measure}=MEASURED±SIGMAmm"
    return report(
        heading(
            document["mechanism"],
            f": {document['level']}, {n_images} image{'s' * (n_images != 1)} of {n_poses} "
            f"pose{'s' * (n_poses != 1)}",
        ),
        table("view", ">images", *(f">{leg}" for leg in legs), rows=rows),
        [
            "Images of each view that show 40 % of a leg or more in one piece.",
            f"{left_out} image{'s' * (left_out > 1)} without legs are left out." * bool(left_out),
            _hidden(views.values(), n_images),
            f"{document['extreme_poses']} of {n_poses} poses have every motor near an end of its "
            "travel.",
            Text(
                "Readings of motors that turn carry no length, and nothing else in this dataset "
                "does: simulate with --board charuco, or measure a rod and calibrate with its "
                "length, as below.",
                style="yellow",
            )
            if to_measure
            else "",
        ],
        [
            Text(line, overflow="fold")
            for line in (
                f"written: {document['dataset']}",
                f"the true model: {document['truth']}",
                "calibrate it, and compare with the truth:",
                f"  legcal calibrate {folder} -o OUT" + (f" {length}" if to_measure else ""),
                f"  legcal evaluate OUT/calibrated.yaml {shlex.quote(document['truth'])}",
            )
        ],
    )


def _hidden(views: Iterable[dict[str, Any]], n_images: int) -> str:
    """Return the legs that few images show, in words; "" without any."""
    images = Counter[str]()
    for view in views:
        images.update(view["legs"])
    rarely_shown = {name: n for name, n in images.items() if n < _OFTEN * n_images}
    if not rarely_shown:
        return ""
    legs = ", ".join(f"{name} in {n}" for name, n in rarely_shown.items())
    return (
        f"Few of the {n_images} images show these legs: {legs}. Other parts or a board hide them, "
        "or they are outside; use other or more cameras, or a smaller board."
    )


def study_table(document: Mapping[str, Any]) -> Report:
    """Return the document of ``study paper`` as text, with the printed figures."""
    printed = document["as_printed"]
    rows, failures = [], []
    for is_coplanar in dict.fromkeys(row["coplanar"] for row in document["rows"]):
        joints = "coplanar" if is_coplanar else "non-coplanar"
        rows.append((joints, *[""] * 4))
        for row in (*document["initial"], *document["rows"]):
            if row["coplanar"] is not is_coplanar:
                continue
            label = _LABELS[row["estimator"]]
            rows.append((f" {label}", *_cells(row)))
            if row["failed"]:
                failures.append(
                    f"{label}, {joints} joints: {row['failed']} of {row['runs'] + row['failed']} "
                    f"runs failed ({', '.join(row['failures'])}) and are not in the means."
                )
    rows.append(("paper, as printed", *[""] * 4))
    rows.append((" before", *_printed_cells(printed["initial"])))
    rows.append((" after", *_printed_cells(printed["calibrated"])))
    notes = [*failures, printed["note"], *document["readings"]]
    return report(table(*_COLUMNS, rows=rows), [Text(note, style="dim") for note in notes])


def _cells(row: Mapping[str, Any]) -> tuple[str, ...]:
    if not row["runs"]:
        return ("all failed", "", "", "0")
    dX = row["dX_mm"]
    digits = 3 if dX < _LARGE else 1
    return (
        f"{dX:.{digits}f} +- {row['dX_mean_sigma_mm']:.{digits}f}",
        f"{row['dE_deg']:.4f}",
        _range(min(row["parameters_mm"]), max(row["parameters_mm"])),
        f"{row['runs']}",
    )


def _printed_cells(printed: Mapping[str, Any]) -> tuple[str, ...]:
    """Return the figures of a row of the paper."""
    between = _range(*printed["parameters_mm"]) if "parameters_mm" in printed else ""
    runs = f"{printed.get('runs', '')}"
    return (f"{printed['dX_mm']:g}", f"{printed['dE_deg']:g}", between, runs)


def _range(lowest: float, highest: float) -> str:
    """Return the range of the errors of parameters."""
    digits = 3 if highest < _LARGE else 1
    return f"{lowest:.{digits}f} to {highest:.{digits}f}"
