"""The measurement noise of a dataset: by method, leg and orientation."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from legcal.dataset.folder import Dataset
from legcal.repeatability.difference import Difference
from legcal.repeatability.repeats import Repeats
from legcal.repeatability.samples import LegOrientation
from legcal.repeatability.spread import Sample, Spread, pool

OUTLINE = "outline"  # the spread of outlines, beside the QUANTITIES of axes
CALLED = {"detector": "detector", "canny": "Canny"}  # methods, in words


@dataclass(frozen=True, eq=False)
class LegNoise:
    """What one method finds of one leg.

    Attributes
    ----------
    name : str
        The leg.
    orientations : tuple of LegOrientation
        Its repeated images, by view and pose; empty if none show the leg.
    """

    name: str
    orientations: tuple[LegOrientation, ...]

    @property
    def images(self) -> int:
        """Images that show the leg by the model."""
        return sum(o.images for o in self.orientations)

    @property
    def axes(self) -> int:
        """Images in which the axis was found."""
        return sum(o.axes for o in self.orientations)

    @property
    def without_M_LS(self) -> int:
        """Orientations in which M_LS does not exist."""
        return sum(o.inclination is not None for o in self.orientations)

    def samples(self, quantity: str) -> list[Sample]:
        """Return the samples of one of the ``QUANTITIES`` or of the outlines."""
        return [sample for o in self.orientations for sample in samples_of(o, quantity)]

    def spread(self, quantity: str) -> Spread | None:
        """Return the spread over all orientations, None where nothing was found twice."""
        return pool(self.samples(quantity))


@dataclass(frozen=True, eq=False)
class MethodNoise:
    """What one method finds.

    Attributes
    ----------
    name : {"detector", "canny"}
        The method.
    legs : tuple of LegNoise
        In the order of the mechanism.
    """

    name: str
    legs: tuple[LegNoise, ...]

    def spread(self, quantity: str) -> Spread | None:
        """Return the spread over all legs and orientations; its largest is that of Table 1."""
        return pool([sample for leg in self.legs for sample in leg.samples(quantity)])

    def bounding(self, quantity: str) -> LegOrientation | None:
        """Return the orientation whose standard deviation is the largest, None without any."""
        every = [o for leg in self.legs for o in leg.orientations if samples_of(o, quantity)]
        return max(every, key=lambda o: max(s.sd for s in samples_of(o, quantity)), default=None)


def samples_of(orientation: LegOrientation, quantity: str) -> list[Sample]:
    """Return what repeats say of one of the ``QUANTITIES``, or of each outline."""
    if quantity == OUTLINE:
        return list(orientation.lines)
    return [orientation.quantities[quantity]] if quantity in orientation.quantities else []


@dataclass(frozen=True, eq=False)
class Noise:
    """The measurement noise of a dataset.

    Attributes
    ----------
    dataset : Dataset
        The dataset.
    view_names, pose_labels : tuple of str
        What the indices of orientations mean.
    repeats : tuple of Repeats
        The images that repeat each other.
    methods : tuple of MethodNoise
        Both methods.
    differences : tuple of Difference
        How far Canny's outlines lie outside the detector's.
    notes : tuple of str
        What else a reader should know.
    """

    dataset: Dataset
    view_names: tuple[str, ...]
    pose_labels: tuple[str, ...]
    repeats: tuple[Repeats, ...]
    methods: tuple[MethodNoise, ...]
    differences: tuple[Difference, ...]
    notes: tuple[str, ...]

    def difference(self, leg: str | None = None) -> tuple[float, float] | None:
        """Return mean and rms of the differences of a leg, or of all [px]; None without any."""
        outward = [d.outward for d in self.differences if leg in (None, d.leg)]
        if not outward:
            return None
        return float(np.mean(outward)), float(np.sqrt(np.mean(np.square(outward))))
