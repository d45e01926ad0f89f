"""Figure 4 of the paper: mean errors of the thirty parameters as bars, true values as a line.

Drawn twice from the same panels: with Plotly as a page that needs nothing from elsewhere, and with
Matplotlib as a picture, which needs no browser. Errors are on one logarithmic scale in all panels:
those of the steps are up to a hundred times those at the bound.
"""

from __future__ import annotations

import io
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from legcal.geometry.types import Array
from legcal.studies.paper_means import BOUND, Means, PaperMeans
from legcal.studies.paper_table import JOINTS, LABELS

if TYPE_CHECKING:
    from matplotlib.axes import Axes

_DRAWN = ("literal", "default", "fit")
_BAR, _LIMIT, _LINE = "#4c78a8", "#e45756", "#8a8a8a"
_LETTERS = {"base": "A", "platform": "B", "offset": "q0"}
_ERROR_AXIS, _TRUTH_AXIS = "mean error [mm]", "true value [mm]"
_BARS, _MARKS, _TRUE = "mean error", "expected at the Cramer-Rao bound", "true value (right)"


@dataclass(frozen=True, eq=False)
class _Panel:
    """One panel: an estimator on a machine [mm]."""

    title: str
    errors: Array
    limit: Array
    truth: Array


def figure_as_html(found: PaperMeans) -> bytes:
    """Return the figure as one HTML page that works without a network."""
    from plotly.subplots import make_subplots

    grid, names = _panels(found), list(map(_label, found.names))
    n_rows, n_columns = len(grid), len(grid[0])
    decades = np.log10(_limits(grid)).tolist()
    figure = make_subplots(
        rows=n_rows,
        cols=n_columns,
        specs=[[{"secondary_y": True}] * n_columns] * n_rows,
        subplot_titles=[panel.title for row in grid for panel in row],
        vertical_spacing=0.1,
        horizontal_spacing=0.1,
    )
    for i, row in enumerate(grid):
        for j, panel in enumerate(row):
            place = {"row": i + 1, "col": j + 1}
            for trace, on_right in _traces(panel, names):
                trace.update(showlegend=i == j == 0, legendgroup=trace.name)
                figure.add_trace(trace, **place, secondary_y=on_right)
            left, right = {**place, "secondary_y": False}, {**place, "secondary_y": True}
            figure.update_yaxes(title_text=_ERROR_AXIS, type="log", range=decades, **left)
            figure.update_yaxes(title_text=_TRUTH_AXIS, showgrid=False, **right)
    figure.update_xaxes(tickangle=-90, tickfont={"size": 10})
    figure.update_layout(
        title=_title(found), height=360 * n_rows, template="plotly_white", legend_orientation="h"
    )
    page: str = figure.to_html(include_plotlyjs=True, include_mathjax=False, div_id="fig4")
    return page.encode()


def figure_as_png(found: PaperMeans) -> bytes:
    """Return the figure as a PNG picture."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure
    from matplotlib.layout_engine import ConstrainedLayoutEngine

    grid, names = _panels(found), list(map(_label, found.names))
    n_rows, n_columns = len(grid), len(grid[0])
    figure = Figure(
        figsize=(7.0 * n_columns, 2.9 * n_rows + 0.6), layout=ConstrainedLayoutEngine(h_pad=0.12)
    )
    FigureCanvasAgg(figure)
    axes = figure.subplots(n_rows, n_columns, squeeze=False)
    for axis, panel in zip(axes.flat, (panel for row in grid for panel in row), strict=True):
        handles = _draw(axis, panel, names)
        axis.set_ylim(_limits(grid))
    figure.suptitle(_title(found), fontsize=11)
    figure.legend(handles=handles, loc="outside lower center", ncols=len(handles), fontsize=9)
    content = io.BytesIO()
    figure.savefig(content, format="png", dpi=110, metadata={"Software": None})
    return content.getvalue()


def _traces(panel: _Panel, names: list[str]) -> list[tuple[Any, bool]]:
    """Return what Plotly draws in a panel, and whether it belongs to the axis on the right."""
    import plotly.graph_objects as go

    tick = {"symbol": "line-ew", "size": 9, "line": {"width": 2, "color": _LIMIT}}
    return [
        (go.Bar(x=names, y=panel.errors, name=_BARS, marker_color=_BAR), False),
        (go.Scatter(x=names, y=panel.limit, name=_MARKS, mode="markers", marker=tick), False),
        (go.Scatter(x=names, y=panel.truth, name=_TRUE, line={"color": _LINE, "width": 1}), True),
    ]


def _draw(axis: Axes, panel: _Panel, names: list[str]) -> list[Any]:
    """Draw a panel with Matplotlib and return what its legend explains."""
    place = range(len(names))
    bars = axis.bar(place, panel.errors, color=_BAR, label=_BARS)
    marks = axis.scatter(place, panel.limit, marker="_", s=70, lw=2.0, color=_LIMIT, label=_MARKS)
    marks.set_zorder(3)
    right = axis.twinx()
    line = right.plot(place, panel.truth, color=_LINE, lw=0.8, marker=".", ms=3, label=_TRUE)
    axis.set_title(panel.title, fontsize=10)
    axis.set_xticks(place, names, rotation=90, fontsize=7)
    axis.set_xlim(-0.7, len(names) - 0.3)
    axis.set_yscale("log")
    axis.yaxis.set_major_formatter("{x:g}")
    axis.set_ylabel(_ERROR_AXIS, fontsize=8)
    right.set_ylabel(_TRUTH_AXIS, fontsize=8)
    for side in (axis, right):
        side.tick_params(axis="y", labelsize=8)
    return [bars, marks, *line]


def _panels(found: PaperMeans) -> list[list[_Panel]]:
    """Return the panels: a row for each estimator, a column for each machine."""
    compared = {means.estimator for means in found.means}
    return [
        [_panel(found, name, estimator) for name in found.truths]
        for estimator in _DRAWN
        if estimator in compared
    ]


def _limits(grid: list[list[_Panel]]) -> tuple[float, float]:
    """Return the ends of the scale of errors that all panels share [mm]."""
    values = np.concatenate(
        [[1e-2, 1.0], *(x for row in grid for p in row for x in (p.errors, p.limit))]
    )
    shown = values[values > 0.0]
    return 0.7 * float(shown.min()), 1.4 * float(shown.max())


def _panel(found: PaperMeans, machine: str, estimator: str) -> _Panel:
    """Return one panel."""
    by_name = {means.estimator: means for means in found.of(machine)}
    means, limit = by_name[estimator], by_name[BOUND]
    return _Panel(
        f"{LABELS[estimator]}, {JOINTS[machine]} joints{_failed(means)}",
        1e3 * means.parameters,
        1e3 * limit.parameters,
        1e3 * found.truths[machine],
    )


def _failed(means: Means) -> str:
    """Return how many runs are not in the means, if any."""
    failed = sum(means.failures.values())
    return f" ({failed} of {means.n + failed} runs failed)" if failed else ""


def _title(found: PaperMeans) -> str:
    """Return the title of the figure."""
    n_runs = found.means[0].n + sum(found.means[0].failures.values())
    return f"Fig. 4 of the paper: {len(found.names)} parameters, means over {n_runs} calibrations"


def _label(name: str) -> str:
    """Return a short label of a parameter: A2x for leg2.base.x."""
    leg, kind, *axis = name.split(".")
    return f"{_LETTERS[kind]}{leg.removeprefix('leg')}{''.join(axis)}"
