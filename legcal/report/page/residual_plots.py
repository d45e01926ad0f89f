"""Residuals of outlines as charts: by view, leg and image, along the image, by contrast, QQ."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from scipy.special import ndtri

from legcal.calibration.result import Calibration
from legcal.data.measurements import row_names
from legcal.geometry.types import Array, IntArray
from legcal.pages.document import Plot, plain

_MAX_WORD = 14  # largest length of a name at an axis
MAX_POINTS = 3000  # largest number of points of a chart that browsers draw quickly
_SYMBOLS = ("circle", "square", "diamond", "cross", "x", "triangle-up", "star", "pentagon")
_COLOURS = ("#1f5fa8", "#b26a00", "#1e7d46", "#8e44ad", "#b3261e", "#4a5568", "#00838f", "#6d4c41")
_AXIS = {"zeroline": False, "gridcolor": "#e8ebef", "linecolor": "#8b929c", "ticks": "outside",
         "tickcolor": "#c3c9d1", "automargin": True}  # fmt: skip
FONT = {"family": "system-ui, sans-serif", "size": 12, "color": "#1d2126"}


def chosen_points(size: Array) -> IntArray:
    """Return the indices of drawn points: the largest, and a regular sample of the others."""
    n = len(size)
    if n <= MAX_POINTS:
        return np.arange(n)
    order = np.argsort(-size, kind="stable")
    worst, others = order[: MAX_POINTS // 2], order[MAX_POINTS // 2 :]
    spread = others[np.linspace(0, len(others) - 1, MAX_POINTS // 2).astype(np.intp)]
    return np.sort(np.concatenate([worst, spread]))


def residual_plots(calibration: Calibration, links: dict[int, str]) -> list[Plot]:
    """Return the charts; *links* are the targets of clicks on outlines, by row of the table."""
    residuals, outlines = calibration.residuals, calibration.solution.outlines
    measurements, legs = calibration.dataset.measurements, calibration.dataset.machine.leg_names
    keep = chosen_points(np.abs(residuals.offset).max(axis=1))
    index = residuals.index[keep]
    offset, whitened = residuals.offset[keep], residuals.whitened[keep]
    row, leg = outlines.row[index], outlines.leg[index]
    view = measurements.view[row]
    views = [v.name for v in measurements.views]
    images = row_names(measurements)
    labels = [
        f"{plain(legs[j])} {plain(outlines.part[i])}, edge {e}<br>{plain(images[r])}"
        for i, j, e, r in zip(
            index.tolist(), leg.tolist(), outlines.edge[index].tolist(), row.tolist(), strict=True
        )
    ]
    both_ends = np.repeat(np.arange(len(index)), 2)
    y = np.round(offset.ravel(), 4)
    number, ends = index[both_ends], outlines.ends[index].reshape(-1, 2)
    jitter = np.random.default_rng(0).uniform(-0.3, 0.3, len(both_ends))
    fields = {
        "view": (view[both_ends] + jitter, "view", views),
        "leg": (leg[both_ends] + jitter, "leg", legs),
        "image": (row[both_ends] + 1.0, "image, in the order of the table", ()),
        "along": (ends[:, 0], "place along the image, u [px]", ()),
        "contrast": (outlines.contrast[index][both_ends], "contrast [grey levels]", ()),
    }
    titles = {"view": "By view", "leg": "By leg", "image": "By image", "along": "Along the image",
              "contrast": "Against contrast"}  # fmt: skip
    plots = []
    hover = np.array(labels, dtype=object)[both_ends]
    for name, (x, label, words) in fields.items():
        if not np.isfinite(x).any():
            continue
        data = _by_leg(np.round(x, 3), y, leg[both_ends], hover, number, legs)
        plots.append(_chart(f"residuals-{name}", titles[name], data, label, words, links))
    plots.append(_quantiles(residuals.whitened, whitened, residuals, keep, hover, links))
    return plots


def _by_leg(
    x: Array, y: Array, leg: IntArray, hover: Array, number: IntArray, legs: Sequence[str]
) -> list[dict[str, Any]]:
    """Return the points as one trace for each leg, with its symbol and colour."""
    traces = []
    for j in np.unique(leg).tolist():
        selected = (leg == j) & np.isfinite(x)
        traces.append(
            {
                "type": "scatter",
                "mode": "markers",
                "name": plain(legs[j]),
                "x": x[selected].tolist(),
                "y": y[selected].tolist(),
                "text": hover[selected].tolist(),
                "customdata": [[k] for k in number[selected].tolist()],
                "hovertemplate": "%{text}<br>%{y:.3f} px<extra></extra>",
                "marker": {"size": 4.5, "opacity": 0.75, "symbol": _SYMBOLS[j % len(_SYMBOLS)],
                           "color": _COLOURS[j % len(_COLOURS)]},
            }
        )  # fmt: skip
    return traces


def layout(x: str, y: str, **more: Any) -> dict[str, Any]:
    """Return the layout of a chart with given axis titles."""
    return {
        "font": FONT,
        "margin": {"l": 54, "r": 8, "t": 8, "b": 44},
        "paper_bgcolor": "#fff",
        "plot_bgcolor": "#fff",
        "showlegend": False,
        "hovermode": "closest",
        "xaxis": {**_AXIS, "title": {"text": x, "standoff": 8}},
        "yaxis": {**_AXIS, "title": {"text": y, "standoff": 6}, "zeroline": True,
                  "zerolinecolor": "#8b929c"},
        **more,
    }  # fmt: skip


def _chart(
    name: str,
    title: str,
    data: list[dict[str, Any]],
    label: str,
    words: Sequence[str],
    links: dict[int, str],
) -> Plot:
    axes = layout(label, "outline less fit [px]")
    if words:
        shown = [plain(word, _MAX_WORD) for word in words]
        axes["xaxis"] |= {"tickvals": list(range(len(words))), "ticktext": shown}
    return Plot(name, data, axes, 280, extra=_linked(data, links), title=title)


def _linked(data: list[dict[str, Any]], links: dict[int, str]) -> dict[str, Any]:
    """Return the targets of clicks on points."""
    shown = {k for trace in data for (k,) in trace.get("customdata", ())}
    return {"links": {str(k): to for k, to in links.items() if k in shown}}


def _quantiles(
    all_whitened: Array,
    whitened: Array,
    residuals: Any,
    keep: IntArray,
    hover: Array,
    links: dict[int, str],
) -> Plot:
    """Return a QQ plot of the whitened residuals against a normal distribution."""
    flat = all_whitened.ravel()
    rank = np.empty(len(flat))
    rank[np.argsort(flat, kind="stable")] = np.arange(len(flat))
    expected = ndtri((rank + 0.5) / max(len(flat), 1)).reshape(all_whitened.shape)[keep].ravel()
    y = whitened.ravel()
    limit = float(np.abs(expected).max(initial=1.0))
    number = np.repeat(residuals.index[keep], 2)
    data: list[dict[str, Any]] = [
        {"type": "scatter", "mode": "lines", "x": [-limit, limit], "y": [-limit, limit],
         "line": {"color": "#8b929c", "width": 1}, "hoverinfo": "skip"},
        {"type": "scatter", "mode": "markers", "x": np.round(expected, 3).tolist(),
         "y": np.round(y, 3).tolist(), "text": hover.tolist(),
         "customdata": [[k] for k in number.tolist()],
         "hovertemplate": "%{text}<br>%{y:.2f} sigma<extra></extra>",
         "marker": {"size": 4, "color": "#1f5fa8", "opacity": 0.7}},
    ]  # fmt: skip
    axes = layout("normal quantile", "residual / sigma")
    return Plot("residuals-qq", data, axes, 280, extra=_linked(data[1:], links), title="QQ plot")
