"""Residuals of outlines as charts: by view, leg and image, along the image, by contrast, QQ."""

from __future__ import annotations

import numpy as np
from scipy.special import ndtri

from legcal.calibration.result import Calibration
from legcal.data.measurements import row_names
from legcal.errors import printable
from legcal.geometry.types import Array, IntArray
from legcal.pages.document import Charts, Drawing
from legcal.pages.svg import Points, scatter

MAX_POINTS = 3000  # largest number of outlines of a chart that browsers draw quickly
_OFFSET = "outline less fit [px]"


def chosen_points(size: Array) -> IntArray:
    """Return the indices of drawn points: the largest, and a regular sample of the others."""
    n = len(size)
    if n <= MAX_POINTS:
        return np.arange(n)
    order = np.argsort(-size, kind="stable")
    worst, others = order[: MAX_POINTS // 2], order[MAX_POINTS // 2 :]
    spread = others[np.linspace(0, len(others) - 1, MAX_POINTS // 2).astype(np.intp)]
    return np.sort(np.concatenate([worst, spread]))


def residual_charts(calibration: Calibration, links: dict[int, str]) -> Charts:
    """Return the charts; *links* are the targets of clicks on outlines, by row of the table."""
    residuals, outlines = calibration.residuals, calibration.solution.outlines
    measurements, legs = calibration.dataset.measurements, calibration.dataset.machine.leg_names
    keep = chosen_points(np.abs(residuals.offset).max(axis=1))
    index = residuals.index[keep]
    offset, whitened = residuals.offset[keep], residuals.whitened[keep]
    row, leg = outlines.row[index], outlines.leg[index]
    views, images = [v.name for v in measurements.views], row_names(measurements)
    both_ends = np.repeat(np.arange(len(index)), 2)
    number, leg_of_end = index[both_ends], leg[both_ends]
    jitter = np.random.default_rng(0).uniform(-0.3, 0.3, len(both_ends))
    charts = []
    for title, x, label, words in (
        ("By view", measurements.view[row][both_ends] + jitter, "view", views),
        ("By leg", leg_of_end + jitter, "leg", legs),
        ("By image", row[both_ends] + 1.0, "image, in the order of the table", ()),
        ("Along the image", outlines.ends[index].reshape(-1, 2)[:, 0],
         "place along the image, u [px]", ()),
        ("Against contrast", outlines.contrast[index][both_ends], "contrast [grey levels]", ()),
    ):  # fmt: skip
        if not (has_x := np.isfinite(x)).any():
            continue
        groups = [
            Points(x[chosen], offset.ravel()[chosen], number[chosen], j)
            for j in np.unique(leg_of_end[has_x]).tolist()
            if (chosen := has_x & (leg_of_end == j)).any()
        ]
        svg = scatter(f"Residuals: {title}", groups, label, _OFFSET, words=words)
        charts.append(Drawing(svg, title=title))
    quantiles = Points(_normal(residuals.whitened)[keep].ravel(), whitened.ravel(), number)
    svg = scatter("Residuals: QQ plot", [quantiles], "normal quantile", "residual / sigma",
                  diagonal=True)  # fmt: skip
    charts.append(Drawing(svg, title="QQ plot"))
    labels = {
        i: f"{printable(legs[j])} {printable(outlines.part[i])}, edge {edge}: "
        f"{a:+.3f} and {b:+.3f} px\n{printable(images[r])}"
        for i, j, edge, (a, b), r in zip(
            index.tolist(), leg.tolist(), outlines.edge[index].tolist(), offset.tolist(),
            row.tolist(), strict=True,
        )
    }  # fmt: skip
    return Charts(charts, labels, {i: links[i] for i in labels if i in links})


def _normal(whitened: Array) -> Array:
    """Return the quantiles of a normal distribution at the ranks of residuals."""
    flat = whitened.ravel()
    rank = np.empty(len(flat))
    rank[np.argsort(flat, kind="stable")] = np.arange(len(flat))
    return np.asarray(ndtri((rank + 0.5) / len(flat)).reshape(whitened.shape))
