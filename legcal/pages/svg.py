"""Drawings without scripts: bars with error bars, histograms, grids of numbers."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
from markupsafe import Markup, escape

from legcal.errors import printable
from legcal.geometry.types import Array, IntArray

INK, DIM, RULE, BLUE, GREY = "#1d2126", "#667080", "#dfe3e8", "#1f5fa8", "#8b929c"
_MAX_BARS = 14  # maximum number of bars of a histogram
_FONT = 'font-family="system-ui, sans-serif"'
_COLOURS = ("#1f5fa8", "#b26a00", "#1e7d46", "#8e44ad", "#b3261e", "#4a5568", "#00838f", "#6d4c41")
_MARKS = (  # paths about a point, as different as their colours
    "m-1.6 0a1.6 1.6 0 1 1 0 .1z",
    "m-1.6-1.6h3.2v3.2h-3.2z",
    "m0-2.2l2.2 2.2-2.2 2.2-2.2-2.2z",
    "m-2 0h4m-2-2v4",
    "m-1.6-1.6l3.2 3.2m0-3.2l-3.2 3.2",
    "m0-2l2 3.4h-4z",
    "m-2 0h4m-3-1.7l2 3.4m0-3.4l-2 3.4",
    "m0 2l2-3.4h-4z",
)


@dataclass
class Canvas:
    """An SVG under work, all texts escaped."""

    width: float
    height: float
    title: str
    parts: list[str] = field(default_factory=list)

    def line(
        self, x1: float, y1: float, x2: float, y2: float, colour: str = RULE, width: float = 1.0
    ) -> None:
        """Draw a line."""
        self.segment((x1, y1), (x2, y2), colour, width)

    def segment(
        self,
        start: Sequence[float] | Array,
        end: Sequence[float] | Array,
        colour: str,
        width: float,
        opacity: float = 1.0,
    ) -> None:
        """Draw a line between two points."""
        shown = f' stroke-opacity="{opacity:g}"' * (opacity < 1.0)
        self.parts.append(
            f'<line x1="{start[0]:.1f}" y1="{start[1]:.1f}" x2="{end[0]:.1f}" y2="{end[1]:.1f}" '
            f'stroke="{colour}" stroke-width="{width:.3g}"{shown}/>'
        )

    def box(
        self, x: float, y: float, width: float, height: float, colour: str, tip: str = ""
    ) -> None:
        """Draw a filled rectangle, with a tooltip."""
        inside = f"<title>{escape(printable(tip))}</title>" if tip else ""
        self.parts.append(
            f'<rect x="{x:.1f}" y="{y:.1f}" width="{max(width, 0.0):.1f}" height="{height:.1f}" '
            f'fill="{colour}">{inside}</rect>'
        )

    def text(
        self,
        x: float,
        y: float,
        text: str,
        *,
        anchor: str = "start",
        size: float = 12,
        colour: str = INK,
        upwards: bool = False,
    ) -> None:
        """Write a text, to the right or upwards."""
        place = f'x="{x:.1f}" y="{y:.1f}"'
        if upwards:
            place = f'transform="translate({x:.1f} {y:.1f}) rotate(-90)"'
        self.parts.append(
            f'<text {place} text-anchor="{anchor}" font-size="{size:g}" '
            f'fill="{colour}">{escape(printable(text))}</text>'
        )

    def markup(self) -> Markup:
        """Return the drawing."""
        label = escape(printable(self.title))
        return Markup(
            f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {self.width:g} {self.height:g}" '
            f'width="{self.width:g}" height="{self.height:g}" role="img" aria-label="{label}" '
            f"{_FONT}>" + "".join(self.parts) + "</svg>"
        )


def shortened(text: str, most: int) -> str:
    """Return a text without control characters, cut to *most* characters."""
    shown = printable(text)
    return shown if len(shown) <= most else f"{shown[: most - 3]}..."


def ticks(low: float, high: float, n: int = 5) -> list[float]:
    """Return round numbers from *low* to *high*, about *n*."""
    if not high > low:
        return [low]
    raw = (high - low) / n
    power = 10.0 ** np.floor(np.log10(raw))
    step = power * next(s for s in (1.0, 2.0, 2.5, 5.0, 10.0) if s * power >= raw * (1 - 1e-9))
    first = np.ceil(low / step - 1e-9)
    last = np.floor(high / step + 1e-9)
    return [float(k * step) + 0.0 for k in np.arange(first, last + 1)]


def change_bars(
    names: Sequence[str],
    values: Sequence[float],
    sigmas: Sequence[float | None],
    unit: str,
) -> Markup:
    """Return bars of changes to the right and left, with error bars of two standard deviations."""
    left, width, step, top = 190.0, 900.0, 17.0, 30.0
    reach = [abs(v) + 2.0 * (s or 0.0) for v, s in zip(values, sigmas, strict=True)]
    most = max([*reach, 1e-12]) * 1.04
    height = top + step * len(names) + 30.0
    canvas = Canvas(width, height, f"Changes of parameters [{unit}]")
    scale = 0.5 * (width - left - 20.0) / most
    zero = left + scale * most

    for tick in ticks(-most, most, 8):
        x = zero + scale * tick
        canvas.line(x, top, x, height - 26.0, GREY if tick == 0 else RULE)
        canvas.text(x, height - 10.0, f"{tick:g}", anchor="middle", size=11, colour=DIM)
    canvas.text(left, 16.0, f"change against the nominal model [{unit}]", size=12, colour=DIM)
    for k, (name, value, sigma) in enumerate(zip(names, values, sigmas, strict=True)):
        y = top + step * (k + 0.5)
        canvas.text(left - 12.0, y + 4.0, shortened(name, 28), anchor="end", size=11.5)
        spread = "" if sigma is None else f" +- {sigma:.3g} {unit} (1 sigma)"
        tip = f"{name}: {value:+.4g} {unit}{spread}"
        canvas.box(zero + scale * min(value, 0.0), y - 4.5, scale * abs(value), 9.0, "#9dbbe0", tip)
        if sigma is not None:
            a, b = (zero + scale * (value + f * sigma) for f in (-2.0, 2.0))
            canvas.line(a, y, b, y, INK, 1.3)
            for x in (a, b):
                canvas.line(x, y - 3.0, x, y + 3.0, INK, 1.3)
    return canvas.markup()


def error_bars(
    names: Sequence[str],
    before: Sequence[float],
    after: Sequence[float],
    sigmas: Sequence[float | None],
    unit: str,
) -> Markup:
    """Draw errors before and after on a logarithmic scale, with the predicted errors after.

    They are positive; errors below a hundred-thousandth of the largest reach the left border.
    """
    left, width, step, top = 190.0, 900.0, 21.0, 48.0
    shown = [x for x in (*before, *after, *(s or 0.0 for s in sigmas)) if x > 0.0] or [1.0]
    high = np.ceil(np.log10(max(shown)))
    low = max(np.floor(np.log10(min(shown))), high - 5.0) - 0.3
    height = top + step * len(names) + 30.0
    canvas = Canvas(width, height, f"Errors of parameters [{unit}]")

    def place(value: float) -> float:
        share = (np.log10(max(value, 1e-300)) - low) / (high - low)
        return left + (width - left - 20.0) * float(np.clip(share, 0.0, 1.0))

    canvas.box(left, 7.0, 22.0, 7.0, "#d6dae0")
    canvas.text(left + 28.0, 15.0, "nominal model", size=12, colour=DIM)
    canvas.box(left + 140.0, 7.0, 22.0, 7.0, BLUE)
    canvas.text(left + 168.0, 15.0, "calibrated", size=12, colour=DIM)
    canvas.line(left + 262.0, 5.0, left + 262.0, 16.0, INK, 2.0)
    canvas.text(left + 270.0, 15.0, "its standard deviation as predicted", size=12, colour=DIM)
    canvas.text(left, 34.0, f"distance from the truth [{unit}]", size=12, colour=DIM)
    for decade in np.arange(np.ceil(low), high + 1.0).tolist():
        x = place(10.0**decade)
        canvas.line(x, top, x, height - 26.0)
        canvas.text(x, height - 10.0, f"{10.0**decade:g}", anchor="middle", size=11, colour=DIM)
    for k, name in enumerate(names):
        y, sigma = top + step * (k + 0.5), sigmas[k]
        canvas.text(left - 12.0, y + 4.0, shortened(name, 28), anchor="end", size=11.5)
        tips = (f"{name}, nominal: {before[k]:.3g} {unit}", f"calibrated: {after[k]:.3g} {unit}")
        canvas.box(left, y - 7.5, place(before[k]) - left, 7.0, "#d6dae0", tips[0])
        canvas.box(left, y + 0.5, place(after[k]) - left, 7.0, BLUE, f"{name}, {tips[1]}")
        if sigma is not None and sigma > 0.0:
            canvas.line(place(sigma), y - 1.5, place(sigma), y + 9.5, INK, 2.0)
    return canvas.markup()


def histogram(values: Array, label: str) -> Markup:
    """Draw a histogram of values that are not negative, from zero on."""
    left, width, height, top, bottom = 34.0, 440.0, 210.0, 14.0, 40.0
    canvas = Canvas(width, height, label)
    low, high = 0.0, 1.05 * float(values.max()) or 1.0
    n = min(_MAX_BARS, max(4, len(values) // 2))
    counts, edges = np.histogram(values, bins=n, range=(low, high))
    most = max(int(counts.max()), 1)
    sx, sy = (width - left - 12.0) / (high - low), (height - top - bottom) / most
    base = height - bottom
    for tick in ticks(0.0, most, 4):
        if tick == int(tick):
            y = base - sy * tick
            canvas.line(left, y, width - 12.0, y)
            canvas.text(left - 6.0, y + 4.0, f"{tick:g}", anchor="end", size=11, colour=DIM)
    for count, a, b in zip(counts.tolist(), edges[:-1].tolist(), edges[1:].tolist(), strict=True):
        tip = f"{count} from {a:.3g} to {b:.3g}"
        canvas.box(
            left + sx * (a - low) + 1.0,
            base - sy * count,
            sx * (b - a) - 2.0,
            sy * count,
            BLUE,
            tip,
        )
    for tick in ticks(low, high, 5):
        x = left + sx * (tick - low)
        canvas.text(x, base + 15.0, f"{tick:g}", anchor="middle", size=11, colour=DIM)
    canvas.text(left, height - 6.0, label, size=12, colour=DIM)
    return canvas.markup()


def shade(share: float) -> str:
    """Return a colour from nearly white to deep blue, darker for more."""
    low, high = np.array([244, 247, 251.0]), np.array([38, 92, 158.0])
    r, g, b = np.rint(low + (high - low) * float(np.clip(share, 0.0, 1.0))).astype(int).tolist()
    return f"#{r:02x}{g:02x}{b:02x}"


def number_grid(
    x: Sequence[float], y: Sequence[float], values: Array, title: str, most: float, digits: int
) -> Markup:
    """Draw a map of numbers over x (columns) and y (rows, upwards); NaN leaves a field empty.

    Each field has its number, darker for larger ones: it can be read without colours.
    """
    left, top, size = 44.0, 24.0, 37.0
    width, height = left + size * len(x) + 8.0, top + size * len(y) + 34.0
    canvas = Canvas(width, height, title)
    canvas.text(left, 15.0, title, size=12.5)
    for row, coordinate in enumerate(y):
        v = top + size * (len(y) - 1 - row)
        canvas.text(
            left - 6.0,
            v + 0.5 * size + 4.0,
            f"{coordinate:z.0f}",
            anchor="end",
            size=10.5,
            colour=DIM,
        )
        for column in range(len(x)):
            u, value = left + size * column, float(values[row, column])
            if not np.isfinite(value):
                canvas.box(u, v, size - 1.0, size - 1.0, "#fbfbfc")
                continue
            share = value / most if most else 0.0
            canvas.box(u, v, size - 1.0, size - 1.0, shade(0.9 * share))
            colour = "#ffffff" if share > 0.62 else INK
            canvas.text(
                u + 0.5 * size - 0.5, v + 0.5 * size + 4.0, f"{value:.{digits}f}",
                anchor="middle", size=11 if digits < 4 else 9, colour=colour,
            )  # fmt: skip
    base = top + size * len(y)
    for column, coordinate in enumerate(x):
        canvas.text(
            left + size * (column + 0.5), base + 13.0, f"{coordinate:z.0f}", anchor="middle",
            size=10.5, colour=DIM,
        )  # fmt: skip
    canvas.text(left, base + 28.0, "x to the right, y up [mm]", size=11, colour=DIM)
    return canvas.markup()


def matrix(names: Sequence[str], values: Array, title: str) -> Markup:
    """Draw a symmetric matrix of numbers from -1 to 1 as squares of proportional area.

    Squares of positive numbers are filled, of negative numbers outlined.
    """
    n = len(names)
    size = float(np.clip(700.0 / max(n, 1), 5.0, 22.0))
    left = top = 130.0 if size > 8.0 else 20.0
    canvas = Canvas(left + size * n + 10.0, top + size * n + 10.0, title)
    if size > 8.0:
        for k, name in enumerate(names):
            middle = left + size * (k + 0.5)
            shown = shortened(name, 20)
            canvas.text(left - 6.0, middle + 3.5, shown, anchor="end", size=min(11.0, 0.8 * size))
            canvas.text(middle + 3.5, top - 6.0, shown, size=min(11.0, 0.8 * size), upwards=True)
    canvas.parts.append(
        f'<rect x="{left}" y="{top}" width="{size * n:.1f}" height="{size * n:.1f}" fill="none" '
        f'stroke="{RULE}"/>'
    )
    for i in range(n):
        for j in range(n):
            value = float(values[i, j])
            side = (size - 1.5) * np.sqrt(min(abs(value), 1.0))
            if i == j or side < 0.12 * size:
                continue
            x, y = left + size * (j + 0.5) - 0.5 * side, top + size * (i + 0.5) - 0.5 * side
            tip = escape(printable(f"{names[i]}, {names[j]}: {value:+.2f}"))
            look = (
                f'fill="{BLUE}"' if value > 0 else 'fill="none" stroke="#b3261e" stroke-width="1.2"'
            )
            canvas.parts.append(
                f'<rect x="{x:.1f}" y="{y:.1f}" width="{side:.1f}" height="{side:.1f}" {look}>'
                f"<title>{tip}</title></rect>"
            )
    return canvas.markup()


class Points(NamedTuple):
    """Points of a chart, in the colour and shape of their group."""

    x: Array  # (n,)
    y: Array  # (n,)
    numbers: IntArray  # (n,) what they stand for
    group: int = 0


def scatter(
    title: str,
    groups: Sequence[Points],
    x_label: str,
    y_label: str,
    *,
    words: Sequence[str] = (),
    diagonal: bool = False,
) -> Markup:
    """Draw points, whose numbers are for the script of the page.

    *words* name the x of 0, 1, 2, ...; a *diagonal* is the line of equal x and y.
    """
    top, width, height = 8.0, 340.0, 290.0
    x, y = (np.concatenate([points[k] for points in groups]) for k in range(2))
    (x_low, x_high), (y_low, y_high) = _limits(x), _limits(y)
    y_ticks = [(tick, f"{tick:g}") for tick in ticks(y_low, y_high, 5)]
    # The title of the axis stands beside the longest label.
    left = max(52.0, 28.0 + 6.6 * max((len(label) for _, label in y_ticks), default=0))
    names = [shortened(word, 14) for word in words]
    upwards = sum(map(len, names)) > 34
    bottom = height - (44.0 if not upwards else 26.0 + 6.5 * max(map(len, names)))
    if words:
        x_low, x_high = -0.5, len(words) - 0.5
    sx, sy = (width - left - 6.0) / (x_high - x_low), (bottom - top) / (y_high - y_low)

    def on_paper(x: Array, y: Array) -> list[list[float]]:
        uv = np.stack([left + sx * (x - x_low), bottom - sy * (y - y_low)], axis=-1)
        return [[u, v] for u, v in uv.tolist()]

    canvas = Canvas(width, height, title)
    for tick, word in y_ticks:
        v = bottom - sy * (tick - y_low)
        canvas.line(left, v, width - 6.0, v, GREY if tick == 0.0 else RULE)
        canvas.text(left - 6.0, v + 4.0, word, anchor="end", size=11, colour=DIM)
    every = -(-len(names) // 24)
    marks = list(zip(range(len(names)), names, strict=True))[::every] if words else [
        (tick, f"{tick:g}") for tick in ticks(x_low, x_high, 5)
    ]  # fmt: skip
    for tick, word in marks:
        u = left + sx * (tick - x_low)
        if not words:
            canvas.line(u, top, u, bottom)
        if upwards:
            canvas.text(
                u + 4.0, bottom + 6.0, word, anchor="end", size=11, colour=DIM, upwards=True
            )
        else:
            at = min(u, width - 3.3 * len(word))  # so that the last one is not cut
            canvas.text(at, bottom + 16.0, word, anchor="middle", size=11, colour=DIM)
    canvas.line(left, top, left, bottom, GREY)
    if diagonal:
        ends = np.array([max(x_low, y_low), min(x_high, y_high)])
        (x1, y1), (x2, y2) = on_paper(ends, ends)
        canvas.line(x1, y1, x2, y2, GREY)
    for points in groups:
        colour, mark = (of[points.group % len(of)] for of in (_COLOURS, _MARKS))
        path = "".join(f"M{u:.1f} {v:.1f}{mark}" for u, v in on_paper(points.x, points.y))
        numbers = " ".join(map(str, points.numbers.tolist()))
        canvas.parts.append(
            f'<path d="{path}" data-points="{numbers}" fill="{colour}" stroke="{colour}" '
            'fill-opacity="0.7" stroke-opacity="0.8"/>'
        )
    canvas.text(left + 0.5 * (width - left), height - 6.0, x_label, anchor="middle", size=12)
    canvas.text(12.0, 0.5 * (top + bottom), y_label, anchor="middle", size=12, upwards=True)
    return canvas.markup()


def _limits(values: Array) -> tuple[float, float]:
    """Return the ends of an axis: those of the values with a margin."""
    low, high = float(values.min()), float(values.max())
    margin = 0.04 * (high - low) or 1.0
    return low - margin, high + margin
