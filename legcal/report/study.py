"""Text report of the paper's evaluation (section 4.3): errors before and after calibration."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from rich.text import Text

from legcal.report.render import Report, report, table

_LABELS = {
    "initial": "before",
    "literal": "steps as printed",
    "default": "weighted steps",
    "fit": "joint fit",
    "bound": "Cramer-Rao bound",
}
_COLUMNS = ("joints", ">dX [mm]", ">dE [deg]", ">parameters [mm]", ">of bound", ">runs")
_LARGE = 10.0  # smallest value with fewer digits, in the unit of its column


def study_table(document: Mapping[str, Any]) -> Report:
    """Return the document of ``study paper`` as text, with the printed figures."""
    printed = document["as_printed"]
    rows, failures = [], []
    for is_coplanar in dict.fromkeys(row["coplanar"] for row in document["rows"]):
        joints = "coplanar" if is_coplanar else "non-coplanar"
        rows.append((joints, *[""] * 5))
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
    rows.append(("paper, as printed", *[""] * 5))
    rows.append((" before", *_printed_cells(printed["initial"])))
    rows.append((" after", *_printed_cells(printed["calibrated"])))
    notes = [*failures, printed["note"], *document["readings"]]
    return report(table(*_COLUMNS, rows=rows), [Text(f"- {note}", style="dim") for note in notes])


def _cells(row: Mapping[str, Any]) -> tuple[str, ...]:
    """Return the figures of an estimator."""
    if not row["runs"]:
        return ("all failed", "", "", "", "0")
    is_bound = row["estimator"] == "bound"
    return (
        _with_sigma(row["dX_mm"], row["dX_mean_sigma_mm"], digits=3),
        f"{row['dE_deg']:.4f}",
        _range(min(row["parameters_mm"]), max(row["parameters_mm"])),
        "1" if is_bound else _with_sigma(row["of_bound"], row["of_bound_sigma"], digits=2),
        f"{row['runs']}",
    )


def _printed_cells(printed: Mapping[str, Any]) -> tuple[str, ...]:
    """Return the figures of a row of the paper."""
    between = _range(*printed["parameters_mm"]) if "parameters_mm" in printed else ""
    runs = f"{printed.get('runs', '')}"
    return (f"{printed['dX_mm']:g}", f"{printed['dE_deg']:g}", between, "", runs)


def _range(lowest: float, highest: float) -> str:
    """Return the range of the errors of parameters."""
    digits = 3 if highest < _LARGE else 1
    return f"{lowest:.{digits}f} to {highest:.{digits}f}"


def _with_sigma(mean: float, sigma: float, *, digits: int) -> str:
    """Return a mean and its standard deviation; large ones with fewer digits."""
    shown = digits if mean < _LARGE else digits - 2
    return f"{mean:.{shown}f} +- {sigma:.{shown}f}"
