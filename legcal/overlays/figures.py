"""How well the legs of each view were found: counts, medians, and what was rejected why."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from legcal.detection.outline import HIDDEN, OUTSIDE
from legcal.geometry.types import BoolArray
from legcal.observations.outlines import QUALITY, Outlines
from legcal.observations.sets import choose_outlines, is_edited
from legcal.overlays.detected import Detection
from legcal.overlays.marks import short_reason

HIDDEN_LEG = "hidden by another leg"


@dataclass(frozen=True)
class ViewFigures:
    """What was found in the images of a view.

    Attributes
    ----------
    images : int
    visible : int
        Legs, counted in each image, that should be seen: neither outside nor hidden.
    found : int
        Those of which an outline is used.
    outlines, used, edited : int
        Rows of the table; those with a line or a reason, whether used or not.
    medians : mapping
        Of contrast [grey levels], length and residual [px] of the used outlines; None where
        nothing is known of any.
    rejected : mapping of str to int
        How many outlines are not used, by the reason without its figures, the most first.
    problem : str
        Why its camera could not be placed, "" if it was.
    """

    images: int
    visible: int
    found: int
    outlines: int
    used: int
    edited: int
    medians: Mapping[str, float | None]
    rejected: Mapping[str, int]
    problem: str

    def document(self) -> dict[str, Any]:
        """Return the figures as JSON has them."""
        return {
            "images": self.images,
            "legs_visible": self.visible,
            "legs_found": self.found,
            "outlines": self.outlines,
            "used": self.used,
            "edited": self.edited,
            **self.medians,
            "rejected": dict(self.rejected),
            "problem": self.problem or None,
        }


def reason_class(reason: str) -> str:
    """Return what kind of reason it is, as it is counted."""
    return HIDDEN_LEG if reason.startswith(HIDDEN) else short_reason(reason) or "no reason given"


def view_figures(detection: Detection) -> dict[str, ViewFigures]:
    """Return the figures of every view that has images or outlines."""
    measurements, outlines = detection.dataset.measurements, detection.outlines
    found = {}
    for v in np.unique(measurements.view).tolist():
        name = measurements.views[v].name
        images = int(np.count_nonzero(measurements.view[detection.rows] == v))
        here = choose_outlines(outlines, measurements.view[outlines.row] == v)
        found[name] = _figures(here, images, detection.unplaced.get(name, ""))
    return found


def _figures(outlines: Outlines, images: int, problem: str) -> ViewFigures:
    """Return the figures of the outlines of a view."""
    expected = np.array([_is_expected(reason) for reason in outlines.reason], dtype=np.bool_)
    reasons = Counter(
        reason_class(reason)
        for reason, used in zip(outlines.reason, outlines.used, strict=True)
        if not used
    )
    return ViewFigures(
        images=images,
        visible=_count_legs(outlines, expected | outlines.used),
        found=_count_legs(outlines, outlines.used),
        outlines=len(outlines),
        used=int(np.count_nonzero(outlines.used)),
        edited=int(np.count_nonzero(is_edited(outlines))),
        medians={name: _median(outlines, name) for name in QUALITY},
        rejected=dict(reasons.most_common()),
        problem=problem,
    )


def _is_expected(reason: str) -> bool:
    return reason != OUTSIDE and not reason.startswith(HIDDEN)


def _count_legs(outlines: Outlines, chosen: BoolArray) -> int:
    """Return in how many images legs have one of the chosen outlines, summed over the legs."""
    places = zip(outlines.row[chosen].tolist(), outlines.leg[chosen].tolist(), strict=True)
    return len(set(places))


def _median(outlines: Outlines, name: str) -> float | None:
    values = getattr(outlines, name)[outlines.used]
    values = values[np.isfinite(values)]
    return float(np.median(values)) if len(values) else None
