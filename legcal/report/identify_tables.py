"""The tables of ``legcal identify``: conditions, ranks, weak directions and remedies."""

from __future__ import annotations

from itertools import groupby
from math import degrees

from rich.console import Group, RenderableType
from rich.table import Table
from rich.text import Text

from legcal.calibration import (
    BoardReport,
    CameraIntrinsics,
    Identifiability,
    Ranks,
    WeakDirection,
    legs_in_words,
    views_in_words,
)
from legcal.machine import joined, leg_labels

_CONDITIONS = {
    "eq12": "base joints and axes (12)",
    "eq15": "offsets and lengths (15)",
    "eq17": "platform joints (17)",
    "every_leg_seen": "every leg seen",
    "two_directions": "two directions of every leg",
    "three_legs_at_once": "three legs at once (18, 19)",
}
_STEPS = {
    "joints_in_cameras": "1 joints in the cameras (6, 7)",
    "base_joints": "2 base joints and axes (9)",
    "offsets": "3 offsets and lengths (14)",
    "platform_joints": "4 platform joints, axes (16-19)",
}
_LEGEND = (
    "as printed: the rank with the equations of the paper as it prints them\n"
    "known length law: a leg with a reading (length = reading + offset), or constant"
)
_NEEDS = {"staged": "the four steps", "full": "the fit of everything"}
_MOST_WEAK = 6  # directions shown
_MOST_MENDED = 3
_FAR, _HALF_TURN = 1000.0, 180.0  # [mm], [deg]; beyond, a number says no more


def identify_table(report: Identifiability) -> RenderableType:
    """Return an identifiability report as people read it, on 80 columns.

    Parameters
    ----------
    report : Identifiability
        The report.
    """
    parts: list[RenderableType] = [_heading(report), Text()]
    if report.recommendation is not None:
        parts += [_recommendation(report), Text()]
    parts += [_conditions(report), Text(), _ranks(report), Text(_LEGEND, style="dim")]
    tables = [("step by step", report.staged), ("everything at once", report.full)]
    if _directions(report.staged) == _directions(report.full):
        tables = [("step by step or at once", report.full)]
    for title, ranks in tables:
        if ranks.weak:
            parts += [Text(), _weak(title, ranks)]
    if report.remedies:
        parts += [Text(), _remedies(report)]
    parts += [Text(), Text(_board(report.board, report.full.of))]
    parts += [Text(_intrinsics(camera)) for camera in report.intrinsics]
    return Group(*parts, Text(), *_verdict(report))


def _heading(report: Identifiability) -> RenderableType:
    """Return what is judged."""
    space = "spatial" if report.spatial else "planar"
    r = f", {report.r} with a revolute joint at the base" if report.r else ""
    lines = [Text(f"{space}, {report.n} legs ({report.n_ac} of known length law{r})")]
    labels = leg_labels(report.legs)
    first = 0
    for (view, images), group in groupby(zip(report.views, report.images, strict=True)):
        last = first + len(list(group))
        between = " and " if last == first + 2 else " to "
        which = f"view {last}" if last == first + 1 else f"views {first + 1}{between}{last}"
        each = "" if last == first + 1 else " each"
        legs = ", ".join(labels[name] for name in view)
        lines.append(Text(f"{which}: legs {legs} in {images} image{'s' * (images != 1)}{each}"))
        first = last
    if report.board.present:
        lines.append(Text("a calibration board on the base in every view"))
    return Group(*lines)


def _recommendation(report: Identifiability) -> RenderableType:
    """Return the sets of views that suffice."""
    if not report.recommendation:
        return Text("No set of views was found that suffices; all legs in one view are judged.")
    labels = leg_labels(report.legs)
    table = _plain_table("smallest sets of views that suffice", "legs each", "sigma \\[mm]")
    for found in report.recommendation:
        number = len(found.views)
        views = views_in_words([",".join(labels[name] for name in view) for view in found.views])
        sigma = "" if found.platform_sigma is None else f"{1e3 * found.platform_sigma.dX_m:.2g}"
        judged = "  *" if found.views == report.views else ""
        table.add_row(
            f"{number} view{'s' * (number != 1)}: {views}", str(found.legs_a_view), sigma + judged
        )
    legend = "sigma: of the platform, to expect; *: judged here"
    return Group(table, Text(legend, style="dim"))


def _conditions(report: Identifiability) -> Table:
    """Return the paper's conditions."""
    table = _plain_table("condition of the paper", "equations", "unknowns", "")
    for c in report.conditions:
        legs = f": {legs_in_words(c.legs, report.legs)}" if c.legs else ""
        numbers = ("", "") if c.equations is None else (str(c.equations), str(c.unknowns))
        verdict = f"{'ok' if c.ok else 'fails'}{legs}"
        remark = "" if c.needed else ", not needed with the board"
        table.add_row(_CONDITIONS[c.name], *numbers, f"{verdict}{remark}")
    return table


def _ranks(report: Identifiability) -> Table:
    """Return the ranks of the steps and of everything at once."""
    table = _plain_table("rank of the equations", "rank", "of", "as printed")
    by_name = {(s.name, s.criteria): s for s in report.steps}
    for name, title in _STEPS.items():
        default, printed = by_name[name, "default"], by_name[name, "literal"]
        other = f"{printed.rank} of {printed.of}"
        table.add_row(title, str(default.rank), str(default.of), other)
    table.add_row("the four steps", str(report.staged.rank), str(report.staged.of), "")
    table.add_row("everything at once", str(report.full.rank), str(report.full.of), "")
    return table


def _weak(title: str, ranks: Ranks) -> Table:
    """Return the directions that are not determined."""
    table = Table(box=None, pad_edge=False, padding=(0, 2, 0, 0))
    table.add_column(f"not determined {title}", overflow="fold", ratio=1)
    table.add_column(r"hides \[mm]", justify="right")
    table.add_column(r"\[deg]", justify="right")
    for weak in ranks.weak[:_MOST_WEAK]:
        table.add_row(weak.direction, *_hidden(weak))
    if len(ranks.weak) > _MOST_WEAK:
        table.add_row(f"and {len(ranks.weak) - _MOST_WEAK} more (see --json)", "", "")
    return table


def _directions(ranks: Ranks) -> list[str]:
    """Return the directions that are not determined."""
    return [weak.direction for weak in ranks.weak]


def _hidden(weak: WeakDirection) -> tuple[str, str]:
    """Return the platform error that a direction hides when its largest component is 1 mm."""
    if weak.dX_m is None or weak.dE_rad is None:
        return "?", "?"
    if weak.harmless:
        return "harmless", ""
    dX_mm, dE_deg = 1e3 * weak.dX_m, degrees(weak.dE_rad)
    return (
        f"{dX_mm:.2f}" if dX_mm < _FAR else f"> {_FAR:.0f}",
        f"{dE_deg:.3f}" if dE_deg < _HALF_TURN else f"> {_HALF_TURN:.0f}",
    )


def _two_digits(value: float) -> str:
    """Return a number with two digits, never with an exponent where it is large."""
    return f"{float(f'{value:.2g}'):.12g}"


def _board(board: BoardReport, of: int) -> str:
    """Return what a calibration board does, in a few sentences."""
    subject = "The calibration board on the base" if board.present else "A calibration board"
    before, after = board.without, board.with_board
    if not board.needed_for and before == after:
        return f"{subject} is not needed: the ranks are the same without it."
    verb = "raises" if board.present else "on the base would raise"
    text = f"{subject} {verb}"
    if board.needed_for:
        needed = joined(
            [_NEEDS.get(name, _CONDITIONS.get(name, name)) for name in board.needed_for]
        )
        where = "" if board.present else " on the base"
        text = f"{subject}{where} is needed for {needed}; it raises"
    text += (
        f" the ranks from {before.staged_rank} to {after.staged_rank} of {of} step by step, and "
        f"from {before.full_rank} to {after.full_rank} at once"
    )
    if not board.mends:
        return f"{text}."
    shown = list(board.mends[:_MOST_MENDED])
    if len(board.mends) > _MOST_MENDED:
        shown.append(f"{len(board.mends) - _MOST_MENDED} more (see --json)")
    return f"{text}, and mends: {'; '.join(shown)}."


def _intrinsics(found: CameraIntrinsics) -> str:
    """Return what the legs tell of a camera."""
    camera = f"Camera of {found.camera}: the legs"
    known = {name: sigma for name, sigma in found.sigma.items() if sigma is not None}
    if not found.determined:
        open_ = joined([name for name in found.sigma if name not in known])
        return f"{camera} do not determine {open_}; calibrate it with legcal camera."
    sigmas = ", ".join(f"{name} {_two_digits(sigma)}" for name, sigma in known.items())
    return f"{camera} determine its intrinsics too (sigma to expect: {sigmas} px)."


def _remedies(report: Identifiability) -> Table:
    """Return what would help."""
    table = _plain_table("what would mend it", "steps", "at once", "")
    for r in report.remedies:
        of = report.full.of
        enough = "enough" if r.enough else "helps"
        table.add_row(r.remedy, f"{r.staged_rank}/{of}", f"{r.full_rank}/{of}", enough)
    return table


def _verdict(report: Identifiability) -> list[RenderableType]:
    """Return what follows."""
    harmless = sum(weak.harmless for weak in report.full.weak)
    lines: list[RenderableType] = []
    if report.identifiable:
        rest = f", but for {harmless} directions that do not move the platform" if harmless else ""
        lines.append(Text(f"Identifiable: everything at once determines all parameters{rest}."))
        if not report.staged.complete:
            lines.append(Text("The steps alone do not: calibration starts from the nominal model."))
    else:
        lines.append(Text("NOT identifiable: see what is not determined.", style="bold"))
    if report.platform_sigma is not None:
        sigma = report.platform_sigma
        lines.append(
            Text(
                f"Platform sigma to expect: {_two_digits(1e3 * sigma.dX_m)} mm, "
                f"{_two_digits(degrees(sigma.dE_rad))} deg, from outlines good to 0.1 px "
                "at both ends of a leg.",
                style="dim",
            )
        )
    weak = (*report.staged.weak, *report.full.weak)
    if any(direction.dX_m is not None and not direction.harmless for direction in weak):
        lines.append(
            Text(
                "What a direction hides is the platform's error for 1 mm in its largest component.",
                style="dim",
            )
        )
    failed = [_CONDITIONS[c.name] for c in report.conditions if c.fails]
    if failed:
        lines.append(Text(f"The paper's conditions fail: {joined(failed)}."))
    return [*lines, *(Text(f"note: {note}") for note in report.notes)]


def _plain_table(*columns: str) -> Table:
    """Return a table whose middle columns are numbers."""
    table = Table(box=None, pad_edge=False, padding=(0, 2, 0, 0))
    for k, title in enumerate(columns):
        table.add_column(title, justify="left" if k in (0, len(columns) - 1) else "right")
    return table
