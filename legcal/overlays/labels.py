"""Where texts stand on a picture: beside what they name, off other texts and lines."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from legcal.geometry.types import Array

_PLACES = (0.5, 0.3, 0.7, 0.15, 0.85)  # along a curve
_ORDER = 0.02  # of the area of a text, by which an earlier place is preferred
_ON_LINE = 0.1  # of the area of a text, that each point of a line under it costs
_ON_TEXT, _OUTSIDE = 4.0, 10.0  # times the area on other texts, and outside the picture


@dataclass(eq=False)
class LabelPlaces:
    """The texts of a picture.

    Attributes
    ----------
    width, height : int
        Of the picture [px].
    lines : (n, 2) array
        Points of all that is drawn [px].
    boxes : list of (4,) array
        Left, top, right and bottom of the texts that have a place.
    """

    width: int
    height: int
    lines: Array
    boxes: list[Array] = field(default_factory=list)

    def place(
        self, curve: Array, size: tuple[int, int], distance: float
    ) -> tuple[tuple[int, int], Array]:
        """Return the left top corner of a text beside a curve, and keep its place.

        Parameters
        ----------
        curve : (n, 2) array
            What the text names [px].
        size : tuple of two int
            Width and height of the text [px].
        distance : float
            From the curve, at least [px].

        Returns
        -------
        corner : tuple of two int
        leader : (2, 2) array
            From the curve to the text [px].
        """
        extent = np.array(size, dtype=np.float64)
        candidates = []
        for place in _PLACES:
            i = min(int(place * len(curve)), len(curve) - 2)
            along = curve[i + 1] - curve[i]
            normal = np.array([-along[1], along[0]]) / max(float(np.hypot(*along)), 1e-9)
            reach = distance + 0.5 * float(np.abs(normal) @ extent)
            for side in (reach, -reach, reach + distance, -reach - distance):
                candidates.append((curve[i], curve[i] + side * normal - 0.5 * extent))
        costs = [
            self._cost(corner, extent) + _ORDER * k * extent.prod()
            for k, (_, corner) in enumerate(candidates)
        ]
        anchor, best = candidates[int(np.argmin(costs))]
        limit = np.maximum([self.width, self.height] - extent, 0.0)
        corner = np.clip(np.rint(best), 0.0, np.floor(limit))
        self.boxes.append(np.concatenate([corner, corner + extent]))
        leader = np.array([anchor, np.clip(anchor, corner, corner + extent)])
        return (int(corner[0]), int(corner[1])), leader

    def _cost(self, corner: Array, extent: Array) -> float:
        """Return what speaks against a place, as an area [px^2]."""
        area = float(extent.prod())
        low, high = corner, corner + extent
        inside = np.minimum(high, [self.width, self.height]) - np.maximum(low, 0.0)
        cost = _OUTSIDE * (area - float(np.maximum(inside, 0.0).prod()))
        for box in self.boxes:
            overlap = np.minimum(high, box[2:]) - np.maximum(low, box[:2])
            cost += _ON_TEXT * float(np.maximum(overlap, 0.0).prod())
        under = np.all((self.lines > low) & (self.lines < high), axis=1)
        return cost + _ON_LINE * area * float(np.count_nonzero(under))
