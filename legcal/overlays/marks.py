"""The lines that belong on an image: outlines, axes and predictions as curves of the picture.

Lines of the sensor plane are bent by the lens: all are drawn through distorted points.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from legcal.detection.band import band_of_leg
from legcal.detection.outline import OUTSIDE
from legcal.detection.prediction import PredictedLeg
from legcal.geometry.types import Array
from legcal.observations.outlines import Outlines
from legcal.observations.sets import choose_outlines
from legcal.vision.camera import Camera

Kind = Literal["edge 1", "edge 2", "axis", "rejected", "predicted"]
N_POINTS = 40  # of a curve
OTHER_FAILS = "other outline fails"


@dataclass(frozen=True, eq=False)
class Mark:
    """A curve of the picture.

    Attributes
    ----------
    kind : {"edge 1", "edge 2", "axis", "rejected", "predicted"}
    points : (n, 2) array
        Its points [px].
    """

    kind: Kind
    points: Array


@dataclass(frozen=True, eq=False)
class PartMarks:
    """What is drawn of a part of a leg.

    Attributes
    ----------
    name : str
        The leg, and the part where the leg has several.
    reason : str
        Why an outline of it is not used, shortened; "" if both are.
    marks : tuple of Mark
    """

    name: str
    reason: str
    marks: tuple[Mark, ...]


def short_reason(reason: str) -> str:
    """Return a reason without its figures, as it is counted and drawn."""
    if reason.startswith("its other outline"):
        return OTHER_FAILS
    return reason.split(", ")[0].split(": ")[0]


def marks_of_image(
    camera: Camera,
    outlines: Outlines,
    predicted: Sequence[PredictedLeg],
    leg_names: Sequence[str],
) -> list[PartMarks]:
    """Return what is drawn over an image, one entry for each part of a leg in it.

    Parameters
    ----------
    camera : Camera
        Its camera.
    outlines : Outlines
        Those of this image.
    predicted : sequence of PredictedLeg
        Where its legs should be.
    leg_names : sequence of str
        The legs of the mechanism.
    """
    of_leg = {leg.leg: leg for leg in predicted}
    several = {leg.leg for leg in predicted if len(leg.pieces) > 1}
    pairs: dict[tuple[int, str], list[int]] = {}
    for i, key in enumerate(zip(outlines.leg.tolist(), outlines.part, strict=True)):
        pairs.setdefault(key, []).append(i)
    several |= {leg for leg, _ in pairs if len([None for j, _ in pairs if j == leg]) > 1}
    found = []
    for (leg, part), rows in pairs.items():
        pair = choose_outlines(outlines, np.array(rows, dtype=np.intp))
        marks = _part_marks(camera, pair, part, of_leg.get(leg))
        if not marks:
            continue
        name = leg_names[leg]
        if leg in several:
            name += " " + part.removeprefix(name).lstrip("_- ")
        if "edited" in pair.source:
            name += " (edited)"
        found.append(PartMarks(name, _reason(pair), marks))
    for lost in predicted:  # legs of which the table has nothing
        if any(lost.leg == j for j, _ in pairs):
            continue
        parts = range(len(lost.pieces))
        marks = tuple(mark for i in parts for mark in _prediction(camera, lost, i))
        if marks:
            found.append(PartMarks(leg_names[lost.leg], "", marks))
    return found


def _reason(pair: Outlines) -> str:
    """Return why an outline of a part is not used."""
    reasons = {
        int(edge): short_reason(reason) or "rejected"
        for edge, reason, used in zip(pair.edge, pair.reason, pair.used, strict=True)
        if not used
    }
    first = {edge: reason for edge, reason in reasons.items() if reason != OTHER_FAILS} or reasons
    if len(reasons) == len(pair) and len(set(first.values())) == 1:
        return next(iter(first.values()))
    return "; ".join(f"edge {edge}: {reason}" for edge, reason in sorted(first.items()))


def _part_marks(
    camera: Camera, pair: Outlines, part: str, leg: PredictedLeg | None
) -> tuple[Mark, ...]:
    """Return the outlines of a part, its axis if both are used, and where it should be if not."""
    marks: list[Mark] = []
    found = np.all(np.isfinite(pair.h), axis=1) & np.all(np.isfinite(pair.ends), axis=(1, 2))
    used = pair.used & found
    for i in np.flatnonzero(found).tolist():
        kind: Kind = "rejected"
        if pair.used[i]:
            kind = "edge 1" if pair.edge[i] == 1 else "edge 2"
        ends = camera.undistort(pair.ends[i])
        marks.append(Mark(kind, _curve(camera, pair.h[i], ends)))
    if np.count_nonzero(used) == 2:
        # h1 . M = R and h2 . M = -R of all points M of the axis, eq (5): it is seen at h1 + h2.
        ends = np.mean([camera.undistort(pair.ends[i]) for i in np.flatnonzero(used)], axis=0)
        marks.append(Mark("axis", _curve(camera, pair.h[used].sum(axis=0), ends)))
    if leg is not None and not np.all(found) and OUTSIDE not in pair.reason:
        for i, piece in enumerate(leg.pieces):
            if piece.link == part:
                edges = [e - 1 for e, seen in zip(pair.edge, found, strict=True) if not seen]
                marks += [mark for k, mark in enumerate(_prediction(camera, leg, i)) if k in edges]
    return tuple(marks)


def _curve(camera: Camera, h: Array, ends: Array) -> Array:
    """Return a line (3,) of the sensor plane between the feet of two of its points, (n, 2) [px]."""
    normal = h[:2] / (h[:2] @ h[:2])
    feet = ends - (ends @ h[:2] + h[2])[:, None] * normal
    share = np.linspace(0.0, 1.0, N_POINTS)[:, None]
    return camera.distort(feet[0] + share * (feet[1] - feet[0]))


def _prediction(camera: Camera, leg: PredictedLeg, i: int) -> list[Mark]:
    """Return both predicted outlines of piece i of a leg; none where the image misses it."""
    piece = leg.pieces[i]
    band = band_of_leg(camera, leg.A_camera, leg.B_camera, piece.start, piece.end)
    if band is None:
        return []
    t = np.linspace(0.0, band.length, N_POINTS)
    return [
        Mark("predicted", camera.distort(band.points(t, band.offsets(h, t))))
        for h in leg.outlines[i]
    ]
