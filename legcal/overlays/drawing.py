"""One image with what was found in it.

Widths of lines and sizes of letters grow with the picture, and small pictures are enlarged, so
that both are legible when the picture fills a screen.
"""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np
from numpy.typing import NDArray

from legcal.geometry.types import Array, Image
from legcal.overlays.labels import LabelPlaces
from legcal.overlays.marks import Kind, Mark, PartMarks

Picture = NDArray[np.uint8]

SCREEN = 1600  # longer side from which on a picture is not enlarged [px]
MOST_ENLARGED = 4
PER_LINE, PER_LETTER = 1000.0, 75.0  # longer sides in a line's width, and in a letter's height
COLOURS: dict[Kind, tuple[int, int, int]] = {  # blue, green, red
    "edge 1": (80, 230, 60),
    "edge 2": (255, 170, 40),
    "axis": (0, 225, 255),
    "rejected": (70, 70, 255),
    "predicted": (30, 150, 255),
}
_MEANING: dict[Kind, str] = {
    "edge 1": "edge 1",
    "edge 2": "edge 2",
    "axis": "axis",
    "rejected": "rejected",
    "predicted": "expected here, not found",
}
_WHITE = (255, 255, 255)
_DARK = (32, 32, 32)
_FONT = cv2.FONT_HERSHEY_SIMPLEX
_LETTER = 22.0  # height of a letter of this font at scale 1 [px]
_FRACTION_BITS = 4  # of coordinates that OpenCV draws at
_SMALLER = 0.8  # letters of reasons and of the legend
_DASH, _GAP = 9.0, 7.0  # in widths of a line


def draw(image: Image, parts: Sequence[PartMarks], caption: str) -> Picture:
    """Return an image with lines, names and reasons drawn over it, and a legend below.

    Parameters
    ----------
    image : (height, width) array
        Grey levels 0 to 255.
    parts : sequence of PartMarks
        What to draw.
    caption : str
        Stands in the legend.

    Returns
    -------
    (height, width, 3) array of uint8
        Blue, green, red.
    """
    longer = max(image.shape)
    factor = int(np.clip(np.ceil(SCREEN / longer), 1, MOST_ENLARGED))
    grey = np.clip(np.rint(image), 0, 255).astype(np.uint8)
    if factor > 1:
        grey = np.asarray(
            cv2.resize(grey, None, fx=factor, fy=factor, interpolation=cv2.INTER_CUBIC), np.uint8
        )
    picture = np.asarray(cv2.cvtColor(grey, cv2.COLOR_GRAY2BGR), np.uint8)
    width = max(1, round(factor * longer / PER_LINE))
    letter = factor * longer / PER_LETTER
    curves = [[_enlarged(mark, factor) for mark in part.marks] for part in parts]
    for marks in curves:
        for mark in marks:
            _draw_curve(picture, mark, width)
    lines = np.concatenate([np.zeros((0, 2)), *(m.points for marks in curves for m in marks)])
    places = LabelPlaces(picture.shape[1], picture.shape[0], lines)
    for part, marks in zip(parts, curves, strict=True):
        _label(picture, places, part, marks, letter)
    return np.vstack([picture, _legend(picture.shape[1], letter, width, caption)])


def _enlarged(mark: Mark, factor: int) -> Mark:
    """Return a curve of the enlarged picture; pixel (0, 0) is the centre of a pixel in both."""
    return Mark(mark.kind, (mark.points + 0.5) * factor - 0.5)


def _draw_curve(picture: Picture, mark: Mark, width: int) -> None:
    """Draw a curve; predictions are dashed, axes thin."""
    colour = COLOURS[mark.kind]
    if mark.kind == "predicted":
        for dash in _dashes(mark.points, width):
            _polyline(picture, dash, colour, width)
    elif mark.kind == "axis":
        _polyline(picture, mark.points, colour, max(1, width // 2))
    else:
        _polyline(picture, mark.points, colour, width)


def _polyline(picture: Picture, points: Array, colour: tuple[int, int, int], width: int) -> None:
    fixed = np.rint(points * 2**_FRACTION_BITS).astype(np.int32)
    cv2.polylines(picture, [fixed], False, colour, width, cv2.LINE_AA, _FRACTION_BITS)


def _dashes(points: Array, width: int) -> list[Array]:
    """Return the dashes of a curve, (n, 2) each."""
    steps = np.linalg.norm(np.diff(points, axis=0), axis=1)
    along = np.concatenate([[0.0], np.cumsum(steps)])
    starts = np.arange(0.0, along[-1], (_DASH + _GAP) * width)
    dashes = []
    for start in starts:
        at = np.linspace(start, min(start + _DASH * width, along[-1]), 4)
        dashes.append(np.column_stack([np.interp(at, along, c) for c in points.T]))
    return dashes


def _label(
    picture: Picture, places: LabelPlaces, part: PartMarks, marks: Sequence[Mark], letter: float
) -> None:
    """Write the name of a part beside it, and why an outline of it is not used."""
    kinds = {mark.kind for mark in marks}
    colour = _WHITE
    if part.reason or kinds == {"predicted"}:
        colour = COLOURS["rejected" if "rejected" in kinds else "predicted"]
    lines = [line for line in (part.name, part.reason) if line]
    lettering = [_lettering(size) for size in (letter, _SMALLER * letter)]
    widths = [
        cv2.getTextSize(line, _FONT, *style)[0][0]
        for line, style in zip(lines, lettering, strict=False)
    ]
    pad, step = round(0.3 * letter), round(1.3 * letter)
    size = (max(widths) + 2 * pad, step * len(lines) + pad)
    middle = min(marks, key=lambda mark: mark.kind != "axis").points
    (x, y), leader = places.place(middle, size, 1.2 * letter)
    _polyline(picture, leader, colour, 1 + round(letter / 40.0))
    box = picture[y : y + size[1], x : x + size[0]]
    box[:] = (0.35 * box).astype(np.uint8)
    for k, (line, (scale, thick)) in enumerate(zip(lines, lettering, strict=False), start=1):
        at = (x + pad, y + k * step - pad // 2)
        cv2.putText(picture, line, at, _FONT, scale, colour, thick, cv2.LINE_AA)


def _lettering(letter: float) -> tuple[float, int]:
    """Return scale and thickness of letters of a height [px]."""
    return letter / _LETTER, max(1, round(letter / 12.0))


def _legend(width: int, letter: float, line: int, caption: str) -> Picture:
    """Return the strip below a picture: what it shows, and what the colours mean."""
    height = round(3.6 * letter)
    strip = np.full((height, width, 3), _DARK, dtype=np.uint8)
    scale, thick = _lettering(letter)
    (w, _), _ = cv2.getTextSize(caption, _FONT, scale, thick)
    fit = min(1.0, (width - 2.0 * letter) / max(w, 1))
    base = round(1.4 * letter)
    cv2.putText(
        strip, caption, (round(letter), base), _FONT, fit * scale, _WHITE, thick, cv2.LINE_AA
    )
    x, y = letter, 2.9 * letter
    for kind, meaning in _MEANING.items():
        (w, _), _ = cv2.getTextSize(meaning, _FONT, _SMALLER * scale, thick)
        start = np.array([x, y - 0.3 * letter])
        sample = np.linspace(start, (start[0] + 3.0 * letter, start[1]), 8)
        _draw_curve(strip, Mark(kind, sample), line)
        at = (round(x + 3.6 * letter), round(y))
        cv2.putText(strip, meaning, at, _FONT, _SMALLER * scale, _WHITE, thick, cv2.LINE_AA)
        x += 3.6 * letter + w + 2.0 * letter
    return strip
