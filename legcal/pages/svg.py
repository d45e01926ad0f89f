"""Drawings without scripts: bars, points and lines over axes, grids of numbers."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from os import fspath
from pathlib import Path
from typing import NamedTuple

import numpy as np
from markupsafe import Markup, escape

from legcal.errors import UsageError, printable
from legcal.files.folder import out_of_resources
from legcal.geometry.types import Array, IntArray

INK, DIM, RULE, BLUE, GREY = "#1d2126", "#667080", "#dfe3e8", "#1f5fa8", "#8b929c"
PALE = "#d6dae0"
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


class Figure(Markup):
    """A drawing (SVG), which a notebook shows and :meth:`savefig` writes."""

    def _repr_svg_(self) -> str:
        return str(self)

    def __repr__(self) -> str:
        return f"Figure of {len(self)} characters: savefig() writes it"

    def savefig(self, path: str | Path) -> None:
        """Write the drawing to a file ``.svg``, which browsers show and text programs take.

        Raises
        ------
        UsageError
            If the name ends otherwise.
        OutOfResources
            If the file cannot be written.
        """
        file = Path(fspath(path))
        if file.suffix.lower() != ".svg":
            raise UsageError(
                f"{file}: the drawing could not be written: found the suffix '{file.suffix}', "
                "needed .svg; change the name."
            )
        with out_of_resources(file, "the drawing", "give another path"):
            file.write_text(str(self), encoding="utf-8")


@dataclass
class Canvas:
    """An SVG under work, all texts escaped."""

    width: float
    height: float
    title: str
    parts: list[str] = field(default_factory=list)

    def segment(
        self,
        start: Sequence[float] | Array,
        end: Sequence[float] | Array,
        colour: str = RULE,
        width: float = 1.0,
        opacity: float = 1.0,
    ) -> None:
        """Draw a line between two points."""
        shown = f' stroke-opacity="{opacity:g}"' * (opacity < 1.0)
        self.parts.append(
            f'<line x1="{start[0]:.1f}" y1="{start[1]:.1f}" x2="{end[0]:.1f}" y2="{end[1]:.1f}" '
            f'stroke="{colour}" stroke-width="{width:.3g}"{shown}/>'
        )

    def path(self, points: Array, colour: str, width: float = 1.5, dashes: str = "") -> None:
        """Draw a line through points (n, 2)."""
        shown = " ".join(f"{x:.1f},{y:.1f}" for x, y in points.tolist())
        dashed = f' stroke-dasharray="{dashes}"' * bool(dashes)
        self.parts.append(
            f'<polyline points="{shown}" fill="none" stroke="{colour}" '
            f'stroke-width="{width:.3g}"{dashed}/>'
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

    def put(self, other: Canvas, x: float, y: float) -> None:
        """Draw another canvas on this one."""
        inside = "".join(other.parts)
        self.parts.append(f'<g transform="translate({x:.1f} {y:.1f})">{inside}</g>')

    def markup(self) -> Figure:
        """Return the drawing."""
        label = escape(printable(self.title))
        return Figure(
            f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {self.width:g} {self.height:g}" '
            f'width="{self.width:g}" height="{self.height:g}" role="img" aria-label="{label}" '
            f"{_FONT}>" + "".join(self.parts) + "</svg>"
        )


def stacked(title: str, canvases: Sequence[Canvas], columns: int = 1) -> Canvas:
    """Return drawings in rows from the left, under a title."""
    width = max((canvas.width for canvas in canvases), default=300.0) + 20.0
    whole = Canvas(columns * width, 30.0, title)
    whole.text(8.0, 18.0, title, size=14)
    for start in range(0, len(canvases), columns):
        row = canvases[start : start + columns]
        for k, canvas in enumerate(row):
            whole.put(canvas, k * width, whole.height)
        whole.height += max(canvas.height for canvas in row) + 14.0
    return whole


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


def _log_ticks(low: float, high: float) -> list[float]:
    """Return powers of ten from *low* to *high*; if few, their double and fivefold too."""
    powers = 10.0 ** np.arange(np.floor(np.log10(low)), np.ceil(np.log10(high)) + 1.0)
    for steps in ((1.0, 2.0, 5.0), (1.0,)):
        marks = [float(f"{s * power:.1g}") for power in powers for s in steps]
        inside = [mark for mark in marks if low <= mark <= high]
        if len(inside) < 9:
            break
    return inside if len(inside) > 1 else ticks(low, high)


class Bars(NamedTuple):
    """Values of a bar chart, which are positive; None and zero have no bar."""

    label: str
    values: Sequence[float | None]


def log_bars(title: str, unit: str, names: Sequence[str], before: Bars, after: Bars) -> Canvas:
    """Draw values before and after on a logarithmic scale.

    Values below a hundred-thousandth of the largest reach the left border.
    """
    left, width, step = 134.0, 400.0, 21.0
    series = before, after
    shown = [x for bars in series for x in bars.values if x] or [1.0]
    high = np.ceil(np.log10(max(shown)))
    low = max(np.floor(np.log10(min(shown))), high - 5.0) - 0.3
    top = 32.0 + 16.0 * len(series)
    canvas = Canvas(width, top + step * len(names) + 26.0, f"{title} [{unit}]")

    def place(value: float | None) -> float:
        share = (np.log10(max(value or 0.0, 1e-300)) - low) / (high - low)
        return left + (width - left - 20.0) * float(np.clip(share, 0.0, 1.0))

    canvas.text(8.0, 16.0, canvas.title)
    for k, (bars, colour) in enumerate(zip(series, (PALE, BLUE), strict=True)):
        y = 23.0 + 16.0 * k
        canvas.box(left, y, 22.0, 9.0, colour)
        canvas.text(left + 28.0, y + 9.0, bars.label, colour=DIM)
    for decade in np.arange(np.ceil(low), high + 1.0).tolist():
        x = place(10.0**decade)
        canvas.segment((x, top), (x, canvas.height - 22.0))
        label = f"{10.0**decade:g}"
        canvas.text(x, canvas.height - 6.0, label, anchor="middle", colour=DIM)
    for k, name in enumerate(names):
        y = top + step * (k + 0.5)
        canvas.text(left - 8.0, y + 4.0, shortened(name, 22), anchor="end", size=11.5)
        for bars, colour, dy in ((before, PALE, -7.5), (after, BLUE, 0.5)):
            if value := bars.values[k]:
                tip = f"{name}, {bars.label}: {value:.3g} {unit}"
                canvas.box(left, y + dy, place(value) - left, 7.0, colour, tip)
    return canvas


def shade(share: float) -> str:
    """Return a colour from nearly white to deep blue, darker for more."""
    low, high = np.array([244, 247, 251.0]), np.array([38, 92, 158.0])
    r, g, b = np.rint(low + (high - low) * float(np.clip(share, 0.0, 1.0))).astype(int).tolist()
    return f"#{r:02x}{g:02x}{b:02x}"


def number_grid(
    x: Sequence[float], y: Sequence[float], values: Array, title: str, most: float, digits: int
) -> Canvas:
    """Draw a map of numbers over x (columns) and y (rows, upwards); NaN leaves a field empty.

    Each field has its number, darker for larger ones up to *most*: it can be read without colours.
    """
    left, top, size = 44.0, 24.0, 37.0
    width, height = left + size * len(x) + 8.0, top + size * len(y) + 34.0
    canvas = Canvas(width, height, title)
    canvas.text(left, 15.0, title, size=12.5)
    for row, coordinate in enumerate(y):
        v = top + size * (len(y) - 1 - row)
        middle = v + 0.5 * size + 4.0
        canvas.text(left - 6.0, middle, f"{coordinate:z.0f}", anchor="end", size=10.5, colour=DIM)
        for column in range(len(x)):
            u, value = left + size * column, float(values[row, column])
            if not np.isfinite(value):
                canvas.box(u, v, size - 1.0, size - 1.0, "#fbfbfc")
                continue
            share = value / most if most else 0.0
            canvas.box(u, v, size - 1.0, size - 1.0, shade(0.9 * share))
            canvas.text(
                u + 0.5 * size - 0.5, middle, f"{value:.{digits}f}", anchor="middle",
                size=11 if digits < 4 else 9, colour="#ffffff" if share > 0.62 else INK,
            )  # fmt: skip
    base = top + size * len(y)
    for column, coordinate in enumerate(x):
        canvas.text(
            left + size * (column + 0.5), base + 13.0, f"{coordinate:z.0f}", anchor="middle",
            size=10.5, colour=DIM,
        )  # fmt: skip
    canvas.text(left, base + 28.0, "x to the right, y up [mm]", size=11, colour=DIM)
    return canvas


class Points(NamedTuple):
    """Points of a chart, in the colour and shape of their group."""

    x: Array  # (n,)
    y: Array  # (n,)
    numbers: IntArray | None = None  # (n,) what they stand for
    group: int = 0
    label: str = ""  # in the legend
    line: str | None = None  # dashes of a line through the points, "" for none


def scatter(
    title: str,
    groups: Sequence[Points],
    x_label: str,
    y_label: str,
    *,
    words: Sequence[str] = (),
    log: bool = False,
) -> Canvas:
    """Draw points, whose numbers are for the script of the page, or lines through them.

    *words* name the x of 0, 1, 2, ...; y is logarithmic with *log*.
    """
    labels = [points.label for points in groups if points.label]
    top, width, height = 8.0 + 16.0 * len(labels), 340.0, 290.0 + 16.0 * len(labels)
    x_axis = _Axis.of([points.x for points in groups], False)
    y_axis = _Axis.of([points.y for points in groups], log)
    y_ticks = [(tick, f"{tick:g}") for tick in y_axis.ticks]
    # The title of the axis stands beside the longest label.
    left = max(52.0, 28.0 + 6.6 * max((len(label) for _, label in y_ticks), default=0))
    names = [shortened(word, 14) for word in words]
    upwards = sum(map(len, names)) > 34
    bottom = height - (44.0 if not upwards else 26.0 + 6.5 * max(map(len, names)))
    if words:
        x_axis = _Axis(-0.5, len(words) - 0.5, False)

    def on_paper(x: Array, y: Array) -> Array:
        u = left + (width - left - 6.0) * x_axis.share(x)
        return np.stack([u, bottom - (bottom - top) * y_axis.share(y)], axis=-1)

    canvas = Canvas(width, height, title)
    for tick, word in y_ticks:
        v = float(bottom - (bottom - top) * y_axis.share(np.array(tick)))
        canvas.segment((left, v), (width - 6.0, v), GREY if tick == 0.0 else RULE)
        canvas.text(left - 6.0, v + 4.0, word, anchor="end", size=11, colour=DIM)
    every = -(-len(names) // 24)
    marks = list(zip(range(len(names)), names, strict=True))[::every] if words else [
        (tick, f"{tick:g}") for tick in x_axis.ticks
    ]  # fmt: skip
    for tick, word in marks:
        u = float(left + (width - left - 6.0) * x_axis.share(np.array(tick)))
        if not words:
            canvas.segment((u, top), (u, bottom))
        if upwards:
            canvas.text(
                u + 4.0, bottom + 6.0, word, anchor="end", size=11, colour=DIM, upwards=True
            )
        else:
            at = min(u, width - 3.3 * len(word))  # so that the last one is not cut
            canvas.text(at, bottom + 16.0, word, anchor="middle", size=11, colour=DIM)
    canvas.segment((left, top), (left, bottom), GREY)
    for points in groups:
        colour, mark = (of[points.group % len(of)] for of in (_COLOURS, _MARKS))
        places = on_paper(points.x, points.y)
        if points.line is not None:
            canvas.path(places, colour, 1.5, points.line)
        path = "".join(f"M{u:.1f} {v:.1f}{mark}" for u, v in places.tolist())
        numbers = () if points.numbers is None else points.numbers.tolist()
        stands_for = f'data-points="{" ".join(map(str, numbers))}" ' * bool(numbers)
        canvas.parts.append(
            f'<path d="{path}" {stands_for}fill="{colour}" stroke="{colour}" '
            'fill-opacity="0.7" stroke-opacity="0.8"/>'
        )
        if points.label:
            y = 12.0 + 16.0 * labels.index(points.label)
            ends = np.array([[left, y - 4.0], [left + 22.0, y - 4.0]])
            canvas.path(ends, colour, 2.0, points.line or "")
            canvas.text(left + 28.0, y, points.label, colour=DIM)
    canvas.text(left + 0.5 * (width - left), height - 6.0, x_label, anchor="middle", size=12)
    canvas.text(12.0, 0.5 * (top + bottom), y_label, anchor="middle", size=12, upwards=True)
    return canvas


class _Axis(NamedTuple):
    """An axis of a chart from *low* to *high*."""

    low: float
    high: float
    is_log: bool

    @classmethod
    def of(cls, values: Sequence[Array], is_log: bool) -> _Axis:
        """Return the axis of some values, which has a margin."""
        every = np.concatenate(values)
        every = every[every > 0.0] if is_log else every
        low, high = (float(every.min()), float(every.max())) if len(every) else (1.0, 1.0)
        if is_log:
            margin = (high / low) ** 0.04 if high > low else 1.5
            return cls(low / margin, high * margin, True)
        margin = 0.04 * (high - low) or 1.0
        return cls(low - margin, high + margin, False)

    @property
    def ticks(self) -> list[float]:
        """The labelled values."""
        return _log_ticks(self.low, self.high) if self.is_log else ticks(self.low, self.high, 5)

    def share(self, values: Array) -> Array:
        """Return where values are, from 0 at the low end to 1."""
        if self.is_log:
            lowest = np.maximum(values, self.low)
            return np.asarray(np.log(lowest / self.low) / np.log(self.high / self.low))
        return np.asarray((values - self.low) / (self.high - self.low))
