"""Sentences on photographs: why images were left out, and of legs that views are said to show."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from legcal.observations.outlines import Outlines
from legcal.photographs import Photographs, Placement
from legcal.recognition.doubts import Explanation, share_shown

FEW = 0.5  # found, against other images
WITNESSES = 3  # good images that tell how much of the legs they show
SHOWN = 0.5  # share of a leg's length in each of them, from which on it is clearly visible
NOTHING_LIKE = "it does not show the legs where its reading has them"  # a reason


@dataclass(frozen=True)
class OutlineCount:
    """How many outlines of an image were found, of those that it should show."""

    used: int
    visible: int

    @property
    def share(self) -> float:
        """Their ratio."""
        return self.used / self.visible


def witnesses(photographs: Photographs, found: Mapping[int, OutlineCount], view: int) -> list[int]:
    """Return the images of a view in which most was found; of all views if it has none."""
    own = [row for row in found if photographs.measurements.view[row] == view]
    return sorted(own or found, key=lambda row: -found[row].share)[:WITNESSES]


def image_name(photographs: Photographs, row: int) -> str:
    """Return what an image is called in notes."""
    measurements = photographs.measurements
    view = measurements.views[int(measurements.view[row])]
    return f"view {view.name}, image {measurements.image[row]}"


def judged(
    photographs: Photographs,
    row: int,
    explanation: Explanation,
    usual: Mapping[int, float],
    found: Mapping[int, OutlineCount],
) -> tuple[str, str]:
    """Return why an image is left out, "" if it is not, and the sentence that says so."""
    name, count = image_name(photographs, row), found[row]
    much = f"{count.used} of {count.visible} outlines where its reading has the legs"
    if explanation.reason:
        return (
            explanation.reason,
            f"{name}: was left out: {explanation.reason}; {explanation.remedy}.",
        )
    view = int(photographs.measurements.view[row])
    if explanation.own >= FEW * usual[view]:
        return "", (
            f"{name}: shows little of the legs: found {much}, in other images most; look "
            " at its light and sharpness."
        )
    return NOTHING_LIKE, (
        f"{name}: was left out: found {much}, and nothing else that it shows; check that it is a "
        "photograph of this machine, taken by this camera at this reading."
    )


def defect_notes(photographs: Photographs, defects: Mapping[int, str]) -> list[str]:
    """Return what is to be said of images that show nothing."""
    return [
        f"{image_name(photographs, row)}: was left out: {why}; take it again."
        for row, why in sorted(defects.items())
    ]


def leg_notes(
    photographs: Photographs,
    placement: Placement,
    outlines: Outlines,
    found: Mapping[int, OutlineCount],
    reasons: Mapping[int, str],
) -> list[str]:
    """Return what is to be said of the legs that views are said to show."""
    measurements, names = photographs.measurements, photographs.mechanism.leg_names
    notes = []
    for v, view in enumerate(measurements.views):
        rows = [r for r in found if measurements.view[r] == v and r not in reasons]
        if view.legs is None or not rows:
            continue
        own = np.isin(outlines.row, rows)
        used = set(outlines.leg[own & outlines.used].tolist())
        for leg in np.flatnonzero(photographs.wanted[v]).tolist():
            mine = own & (outlines.leg == leg)
            if leg in used or not used or not mine.any():
                continue
            why = Counter(outlines.reason[i] for i in np.flatnonzero(mine).tolist())
            notes.append(
                f"view {view.name}: legs names {names[leg]}, of which none of its images shows an "
                f"outline that can be used ({why.most_common(1)[0][0]}); look at legcal detect, "
                "or leave it out there."
            )
        good = {row: found[row] for row in rows}
        notes += _left_out_legs(photographs, placement, v, witnesses(photographs, good, v))
    return notes


def _left_out_legs(
    photographs: Photographs, placement: Placement, v: int, rows: Sequence[int]
) -> list[str]:
    """Return a note on legs that a view leaves out although its images show them clearly."""
    search = placement.search
    clear = [
        name
        for leg, name in enumerate(photographs.mechanism.leg_names)
        if not photographs.wanted[v, leg]
        and search.cylinders[leg]
        and all(
            share_shown(search, placement.recognised, row, legs=np.array([leg])) >= SHOWN
            for row in rows
        )
    ]
    if not clear:
        return []
    return [
        f"view {photographs.measurements.views[v].name}: legs leaves out {', '.join(clear)}, which "
        "its images show clearly; name them there to use them."
    ]
