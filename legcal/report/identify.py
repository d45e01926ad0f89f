"""Text report of identifiability: conditions, ranks, weak directions and remedies."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import groupby
from math import degrees

from rich.text import Text

from legcal.calibration.identify.report import (
    ConditionBlock,
    Identifiability,
    Ranks,
    WeakDirection,
)
from legcal.machine.parameters import leg_labels, legs_in_words, list_in_words
from legcal.pages.document import Table, Verdict
from legcal.report.render import Part, Report, table
from legcal.report.render import report as blocks

CONDITIONS = {
    "eq12": "base joints and axes (12)",
    "eq15": "offsets and lengths (15)",
    "eq17": "platform joints (17)",
    "every_leg_seen": "every leg seen",
    "two_directions": "two directions of every leg",
    "three_legs_at_once": "three legs at once (18, 19)",
}
_LEGEND = "length known: leg with an encoder (length = reading + offset), or of constant length"
_SCALE = (
    "readings are angles, and radii alone say how large the machine is, so that calibrate refuses "
    "it until a length or radii are stated (--length, --set), or a board is seen"
)
_MAX_WEAK = 6  # directions shown
_MAX_MM, _MAX_DEG = 1000.0, 180.0  # [mm], [deg]; beyond, a number says no more


def identify_table(report: Identifiability) -> Report:
    """Return an identifiability report as text, 80 columns wide."""
    return blocks(
        _heading(report),
        [conditions_table(report.conditions, report.legs), Text(_LEGEND, style="dim")],
        _weak(report.full) if report.full.weak else None,
        _remedies(report) if report.remedies else None,
        _verdict(report),
    )


def _heading(report: Identifiability) -> list[str]:
    """Return the machine, views and boards of the report."""
    space = "spatial" if report.spatial else "planar"
    r = f", {report.r} with a revolute joint at the base" if report.r else ""
    lines = [f"{space}, {report.n} legs ({report.n_ac} with known length{r})"]
    labels = leg_labels(report.legs)
    first = 0
    for (view, images), group in groupby(zip(report.views, report.images, strict=True)):
        last = first + len(list(group))
        between = " and " if last == first + 2 else " to "
        views_in_heading = (
            f"view {last}" if last == first + 1 else f"views {first + 1}{between}{last}"
        )
        per_view = "" if last == first + 1 else " each"
        legs = f"legs {', '.join(labels[name] for name in view)}" if view else "no leg"
        lines.append(f"{views_in_heading}: {legs} in {images} image{'s' * (images != 1)}{per_view}")
        first = last
    if report.board:
        lines.append("a calibration board on the base in every view")
    if report.platform_board:
        lines.append("a calibration board on the platform in every view")
    return lines


def conditions_table(conditions: Sequence[ConditionBlock], leg_names: Sequence[str]) -> Table:
    """Return the paper's conditions."""
    rows = []
    for c in conditions:
        failing = [leg_names.index(name) for name in c.failing or ()]
        legs = f": {legs_in_words(failing, leg_names)}" if failing else ""
        numbers = ("", "") if c.equations is None else (str(c.equations), str(c.unknowns))
        remark = ", not needed with the board" if c.needed is False else ""
        remark += ", by analogy" if c.by_analogy else ""
        rows.append((CONDITIONS[c.name], *numbers, f"{'ok' if c.ok else 'fails'}{legs}{remark}"))
    return table("condition of the paper", ">equations", ">unknowns", "", rows=rows)


def _weak(ranks: Ranks) -> Table:
    """Return the undetermined directions."""
    rows = [(weak.direction, *_hidden(weak)) for weak in ranks.weak[:_MAX_WEAK]]
    if len(ranks.weak) > _MAX_WEAK:
        rows.append((f"and {len(ranks.weak) - _MAX_WEAK} more (see --json)", "", ""))
    return table("undetermined combination", ">hides [mm]", ">[deg]", rows=rows)


def _hidden(weak: WeakDirection) -> tuple[str, str]:
    """Return the unobserved platform error of a direction with 1 mm in its largest component."""
    if weak.dX_m is None or weak.dE_rad is None:
        return "?", "?"
    if weak.harmless:
        return "harmless", ""
    dX_mm, dE_deg = 1e3 * weak.dX_m, degrees(weak.dE_rad)
    return (
        f"{dX_mm:.2f}" if dX_mm < _MAX_MM else f"> {_MAX_MM:.0f}",
        f"{dE_deg:.3f}" if dE_deg < _MAX_DEG else f"> {_MAX_DEG:.0f}",
    )


def _two_digits(value: float) -> str:
    """Return a number with two significant digits, without exponent if it is large."""
    return f"{float(f'{value:.2g}'):.12g}"


def _remedies(report: Identifiability) -> Table:
    """Return the remedies."""
    n_parameters = report.full.of
    rows = [
        (
            r.remedy,
            f"{r.full_rank}/{n_parameters}",
            "enough" if r.enough else "helps",
        )
        for r in report.remedies
    ]
    return table("remedy", ">rank", "", rows=rows)


def _verdict(report: Identifiability) -> list[Part]:
    """Return the verdict and the remedies."""
    harmless = sum(weak.harmless for weak in report.full.weak)
    determined = f"the joint fit determines {report.full.rank} of {report.full.of} parameters"
    lines: list[Part] = []
    if report.identifiable:
        undetermined = (
            f"; {harmless} undetermined directions do not move the platform" if harmless else ""
        )
        lines.append(f"Identifiable: {determined}{undetermined}.")
        if report.scale_is_open:
            lines.append(f"But for the scale: {_SCALE}.")
    else:
        lines.append(Text(f"NOT identifiable: {determined}.", style="bold"))
    if report.platform_sigma is not None:
        sigma = report.platform_sigma
        expected = (
            f"Predicted error of the platform (1 sigma): {_two_digits(1e3 * sigma.dX_m)} mm, "
            f"{_two_digits(degrees(sigma.dE_rad))} deg."
        )
        lines.append(Text(expected, style="dim"))
    if any(weak.dX_m is not None and not weak.harmless for weak in report.full.weak):
        hidden = "hides: unobserved platform error if the largest component is 1 mm."
        lines.append(Text(hidden, style="dim"))
    failed = [CONDITIONS[c.name] for c in report.conditions if c.fails]
    if failed:
        lines.append(f"The paper's conditions fail: {list_in_words(failed)}.")
    return [*lines, *(f"note: {note}" for note in report.notes)]


def identify_verdict(report: Identifiability) -> Verdict:
    """Return whether a session determines its machine: amber where a condition fails."""
    full = report.full
    sentence = f"The joint fit determines {full.rank} of {full.of} parameters."
    if not report.identifiable:
        word = "These images cannot determine the machine"
        reasons = [f"Open: {one.direction}." for one in full.weak if not one.harmless]
        return Verdict("bad", word, sentence, reasons)
    if report.scale_is_open:
        word = "These images can determine all of the machine but its scale"
        return Verdict("doubtful", word, sentence, [f"{_SCALE[0].upper()}{_SCALE[1:]}."])
    if not report.conditions_hold:
        word = "The joint fit can determine it, but conditions of the paper fail"
        return Verdict("doubtful", word, sentence, [])
    return Verdict("good", "These images determine the machine", sentence, [])
