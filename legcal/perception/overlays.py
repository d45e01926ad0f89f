"""One image with what was found in it drawn over it.

Widths of lines and sizes of letters grow with the picture, and small pictures are enlarged, so
that both are legible when the picture fills a screen.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from itertools import product
from pathlib import Path
from typing import Literal, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from legcal.data.corners import Corners
from legcal.data.outlines import Outlines, are_of_bodies
from legcal.data.reasons import Reason, Rejection
from legcal.geometry.types import Array, Image
from legcal.vision.camera import Camera
from legcal.vision.visibility import PredictedLeg

MarkKind = Literal["edge 1", "edge 2", "axis", "body", "rejected", "predicted", "corner"]
N_POINTS = 40  # of a curve
OVERLAYS, PHOTOGRAPHS = "overlays", "photographs"  # the subfolders of pictures

Canvas = NDArray[np.uint8]

SCREEN = 1600  # longer side from which on a picture is not enlarged [px]
MAX_ENLARGEMENT = 4
PER_LINE, PER_LETTER = 1000.0, 75.0  # longer sides in a line's width, and in a letter's height
COLOURS: dict[MarkKind, tuple[int, int, int]] = {  # blue, green, red
    "edge 1": (80, 230, 60),
    "edge 2": (255, 170, 40),
    "axis": (0, 225, 255),
    "body": (220, 220, 0),
    "rejected": (70, 70, 255),
    "predicted": (30, 150, 255),
    "corner": (255, 255, 0),
}
_MEANING: dict[MarkKind, str] = {
    "edge 1": "edge 1",
    "edge 2": "edge 2",
    "axis": "axis",
    "body": "edge of a body",
    "rejected": "rejected",
    "predicted": "expected here, not found",
    "corner": "corner of a board",
}
_WHITE = (255, 255, 255)
_DARK = (32, 32, 32)
_FONT = cv2.FONT_HERSHEY_SIMPLEX
_LETTER = 22.0  # height of a letter of this font at scale 1 [px]
_FRACTION_BITS = 4  # of coordinates that OpenCV draws at
_SMALLER = 0.8  # letters of reasons and of the legend
_DASH, _GAP = 9.0, 7.0  # in widths of a line
_CROSS = 5.0  # arms of a corner, in widths of a line

_PLACES = (0.5, 0.3, 0.7, 0.15, 0.85)  # of texts along a curve


def is_overlay(name: Path, folder: str = OVERLAYS) -> bool:
    """Return whether a relative path is that of an overlay, or another picture of an image."""
    return ".." not in name.parts and name.parts[:1] == (folder,) and name.suffix == ".jpg"


class Mark(NamedTuple):
    """A curve of the picture."""

    kind: MarkKind
    points: Array  # (n, 2) [px]


class PartMarks(NamedTuple):
    """The drawing of a part of a leg."""

    name: str  # the leg, and the part where the leg has several; "" without a label
    reason: str  # why an outline of it is not used, shortened; "" if both are
    marks: tuple[Mark, ...]


def marks_of_image(
    camera: Camera,
    outlines: Outlines,
    predicted: Sequence[PredictedLeg],
    leg_names: Sequence[str],
) -> list[PartMarks]:
    """Return the drawings over an image, one for each part of a leg in it.

    From its outlines, those of bodies as well, and the predicted legs.
    """
    of_bodies = outlines.choose(are_of_bodies(outlines))
    outlines = outlines.choose(~are_of_bodies(outlines))
    of_part = {(leg.leg, segment.link): leg for leg in predicted for segment in leg.segments}
    pairs: dict[tuple[int, str], list[int]] = {}
    for i, key in enumerate(zip(outlines.leg.tolist(), outlines.part, strict=True)):
        pairs.setdefault(key, []).append(i)
    n_parts, found = Counter(leg for leg, _ in pairs), []
    for (leg, part), rows in pairs.items():
        pair = outlines.choose(np.array(rows, dtype=np.intp))
        marks = _part_marks(camera, pair, part, of_part.get((leg, part)))
        if not marks:
            continue
        name = leg_names[leg]
        if n_parts[leg] > 1:
            name += " " + part.removeprefix(name).lstrip("_- ")
        if "edited" in pair.source:
            name += " (edited)"
        found.append(PartMarks(name, _reason(pair), marks))
    for absent in predicted:  # legs and arms of which the table has nothing
        if any((absent.leg, segment.link) in pairs for segment in absent.segments):
            continue
        parts = range(len(absent.segments))
        marks = tuple(mark for i in parts for mark in _predicted(camera, absent, i, (1, 2)))
        if marks:
            found.append(PartMarks(leg_names[absent.leg], "", marks))
    edges = tuple(
        Mark(
            "body" if of_bodies.used[i] else "rejected",
            curve(camera, of_bodies.h[i], camera.undistort(of_bodies.ends[i])),
        )
        for i in range(len(of_bodies))
    )
    return [*found, PartMarks("", "", edges)] if edges else found


def _reason(pair: Outlines) -> str:
    """Return the reason of a rejected outline."""
    rejections = {
        int(edge): why
        for edge, why, used in zip(pair.edge, pair.reason, pair.used, strict=True)
        if not used
    }
    causes = {e: why for e, why in rejections.items() if why.reason is not Reason.PARTNER}
    first = {edge: _drawn(why) for edge, why in (causes or rejections).items()}
    if len(rejections) == len(pair) and len(set(first.values())) == 1:
        return next(iter(first.values()))
    return "; ".join(f"edge {edge}: {reason}" for edge, reason in sorted(first.items()))


def _drawn(why: Rejection) -> str:
    """Return a reason as it is drawn: with names and notes, without figures."""
    named = Reason.HIDDEN, Reason.OTHER
    return (str(why) if why.reason in named else why.reason.words) or "rejected"


def _part_marks(
    camera: Camera, pair: Outlines, part: str, leg: PredictedLeg | None
) -> tuple[Mark, ...]:
    """Return the outlines of a part, its axis if both are used, and where it should be if not."""
    marks: list[Mark] = []
    are_measured = np.all(np.isfinite(pair.h), axis=1) & np.all(np.isfinite(pair.ends), axis=(1, 2))
    used = pair.used & are_measured
    for i in np.flatnonzero(are_measured).tolist():
        kind: MarkKind = "rejected"
        if pair.used[i]:
            kind = "edge 1" if pair.edge[i] == 1 else "edge 2"
        ends = camera.undistort(pair.ends[i])
        marks.append(Mark(kind, curve(camera, pair.h[i], ends)))
    if np.count_nonzero(used) == 2:
        # h1 . M = R and h2 . M = -R of all points M of the axis, eq (5): it is seen at h1 + h2.
        ends = np.mean([camera.undistort(pair.ends[i]) for i in np.flatnonzero(used)], axis=0)
        marks.append(Mark("axis", curve(camera, pair.h[used].sum(axis=0), ends)))
    if leg is not None and not np.all(are_measured) and not pair.rejected_for(Reason.OUTSIDE).any():
        for i, segment in enumerate(leg.segments):
            if segment.link == part:
                marks += _predicted(camera, leg, i, sorted(pair.edge[~are_measured].tolist()))
    return tuple(marks)


def curve(camera: Camera, h: Array, ends: Array, n: int = N_POINTS) -> Array:
    """Return a line (3,) of the sensor plane between the feet of two of its points, (n, 2) [px]."""
    normal = h[:2] / (h[:2] @ h[:2])
    feet = ends - (ends @ h[:2] + h[2])[:, None] * normal
    share = np.linspace(0.0, 1.0, n)[:, None]
    return camera.distort(feet[0] + share * (feet[1] - feet[0]))


def _predicted(camera: Camera, leg: PredictedLeg, part: int, edges: Sequence[int]) -> list[Mark]:
    """Return predicted outlines of a part of a leg; none where it is outside the image."""
    points = (leg.points_of(part, edge, N_POINTS) for edge in edges)
    return [Mark("predicted", camera.distort(xy)) for xy in points if xy is not None]


def marks_of_corners(corners: Corners) -> tuple[Mark, ...]:
    """Return the crosses over the corners of boards in an image."""
    return tuple(
        Mark("corner" if used else "rejected", px[None])
        for px, used in zip(corners.px, corners.used.tolist(), strict=True)
    )


def draw(
    image: Image, parts: Sequence[PartMarks], caption: str, corners: Sequence[Mark] = ()
) -> Canvas:
    """Return a grey image with lines, names and reasons over it, and a legend below, BGR.

    The caption stands in the legend.
    """
    longer = max(image.shape)
    factor = int(np.clip(np.ceil(SCREEN / longer), 1, MAX_ENLARGEMENT))
    grey = np.clip(np.rint(image), 0, 255).astype(np.uint8)
    if factor > 1:
        grey = np.asarray(
            cv2.resize(grey, None, fx=factor, fy=factor, interpolation=cv2.INTER_CUBIC), np.uint8
        )
    picture = np.asarray(cv2.cvtColor(grey, cv2.COLOR_GRAY2BGR), np.uint8)
    width = max(1, round(factor * longer / PER_LINE))
    letter = factor * longer / PER_LETTER
    # Pixel (0, 0) is the centre of a pixel in both pictures.
    curves = [
        [Mark(mark.kind, (mark.points + 0.5) * factor - 0.5) for mark in part.marks]
        for part in parts
    ]
    for marks in curves:
        for mark in marks:
            _draw_curve(picture, mark, width)
    for mark in corners:
        for arm in np.array([[[-1.0, -1.0], [1.0, 1.0]], [[-1.0, 1.0], [1.0, -1.0]]]):
            at = (mark.points + 0.5) * factor - 0.5 + _CROSS * width * arm
            _polyline(picture, at, COLOURS[mark.kind], width)
    boxes = list[Array]()
    for part, marks in zip(parts, curves, strict=True):
        if part.name:
            boxes.append(_label(picture, boxes, part, marks, letter))
    kinds = {mark.kind for mark in [*corners, *(mark for part in parts for mark in part.marks)]}
    return np.vstack([picture, _legend(picture.shape[1], letter, width, caption, kinds)])


def _draw_curve(picture: Canvas, mark: Mark, width: int) -> None:
    """Draw a curve; predictions are dashed, axes thin."""
    colour = COLOURS[mark.kind]
    if mark.kind == "predicted":
        steps = np.linalg.norm(np.diff(mark.points, axis=0), axis=1)
        along = np.concatenate([[0.0], np.cumsum(steps)])
        starts = np.arange(0.0, along[-1], (_DASH + _GAP) * width)
        dashes = []
        for start in starts:
            at = np.linspace(start, min(start + _DASH * width, along[-1]), 4)
            dashes.append(np.column_stack([np.interp(at, along, c) for c in mark.points.T]))
        for dash in dashes:
            _polyline(picture, dash, colour, width)
    elif mark.kind == "axis":
        _polyline(picture, mark.points, colour, max(1, width // 2))
    else:
        _polyline(picture, mark.points, colour, width)


def _polyline(picture: Canvas, points: Array, colour: tuple[int, int, int], width: int) -> None:
    fixed = np.rint(points * 2**_FRACTION_BITS).astype(np.int32)
    cv2.polylines(picture, [fixed], False, colour, width, cv2.LINE_AA, _FRACTION_BITS)


def _label(
    picture: Canvas, boxes: Sequence[Array], part: PartMarks, marks: Sequence[Mark], letter: float
) -> Array:
    """Write the name of a part beside it, and why an outline of it is not used.

    Return the box (2, 2) of the text, which keeps clear of earlier ones.
    """
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
    limit = np.array(picture.shape[1::-1], dtype=np.float64)
    corner = _place(middle, size, 1.2 * letter, limit, boxes)
    x, y = corner.astype(int).tolist()
    box = picture[y : y + size[1], x : x + size[0]]
    box[:] = (0.35 * box).astype(np.uint8)
    for k, (line, (scale, thick)) in enumerate(zip(lines, lettering, strict=False), start=1):
        at = (x + pad, y + k * step - pad // 2)
        cv2.putText(picture, line, at, _FONT, scale, colour, thick, cv2.LINE_AA)
    return np.array([corner, corner + size])


def _lettering(letter: float) -> tuple[float, int]:
    """Return scale and thickness of letters of a height [px]."""
    return letter / _LETTER, max(1, round(letter / 12.0))


def _legend(width: int, letter: float, line: int, caption: str, kinds: set[MarkKind]) -> Canvas:
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
        if kind in ("body", "corner") and kind not in kinds:
            continue
        (w, _), _ = cv2.getTextSize(meaning, _FONT, _SMALLER * scale, thick)
        start = np.array([x, y - 0.3 * letter])
        sample = np.linspace(start, (start[0] + 3.0 * letter, start[1]), 8)
        _draw_curve(strip, Mark(kind, sample), line)
        at = (round(x + 3.6 * letter), round(y))
        cv2.putText(strip, meaning, at, _FONT, _SMALLER * scale, _WHITE, thick, cv2.LINE_AA)
        x += 3.6 * letter + w + 2.0 * letter
    return strip


def _place(
    curve: Array, size: tuple[int, int], distance: float, limit: Array, boxes: Sequence[Array]
) -> Array:
    """Return the left top corner (2,) of a text beside a curve (n, 2), over no earlier text.

    Texts have a size (width, height) and are a distance from the curve [px], where the picture has
    room, which ends at a limit (2,); boxes (2, 2) of the earlier ones are their corners.
    """
    extent, corners = np.array(size, dtype=np.float64), list[Array]()
    for place, side in product(_PLACES, (1.0, -1.0)):
        i = min(int(place * len(curve)), len(curve) - 2)
        along = curve[i + 1] - curve[i]
        normal = np.array([-along[1], along[0]]) / max(float(np.hypot(*along)), 1e-9)
        reach = distance + 0.5 * float(np.abs(normal) @ extent)
        middle = curve[i] + side * reach * normal
        corners.append(np.clip(np.rint(middle - 0.5 * extent), 0.0, np.maximum(limit - extent, 0)))
    for corner in corners:
        if not any(np.all((corner < b[1]) & (corner + extent > b[0])) for b in boxes):
            return corner
    return corners[0]
