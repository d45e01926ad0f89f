"""The measurement noise of a dataset, and its document."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Generic, TypeVar

import numpy as np

from legcal.brief import brief
from legcal.calibration.measurement_noise.repeatability import (
    OUTLINE,
    QUANTITIES,
    LegOrientation,
    PooledSpread,
    Repeats,
    Sample,
    pool,
)
from legcal.data.dataset import Dataset
from legcal.files.schema import Document
from legcal.geometry.types import Array

CALLED = {"detector": "detector", "canny": "Canny"}  # methods, in words
_EVERY = (*QUANTITIES, OUTLINE)

T = TypeVar("T")


@dataclass(frozen=True, eq=False)
class LegNoise:
    """What one method finds of one leg."""

    name: str
    orientations: tuple[LegOrientation, ...]  # by view and pose; empty if no image shows the leg

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
        return [sample for o in self.orientations for sample in o.samples(quantity)]

    def spread(self, quantity: str) -> PooledSpread | None:
        """Return the spread over all orientations, None where nothing was found twice."""
        return pool(self.samples(quantity))


@dataclass(frozen=True, eq=False)
class MethodNoise:
    """What one method finds of all legs, in the order of the mechanism."""

    name: str  # one of METHODS
    legs: tuple[LegNoise, ...]

    def spread(self, quantity: str) -> PooledSpread | None:
        """Return the spread over all legs and orientations; its largest is that of Table 1."""
        return pool([sample for leg in self.legs for sample in leg.samples(quantity)])

    def bounding(self, quantity: str) -> LegOrientation | None:
        """Return the orientation whose standard deviation is the largest, None without any."""
        every = [o for leg in self.legs for o in leg.orientations if o.samples(quantity)]
        return max(every, key=lambda o: max(s.sd for s in o.samples(quantity)), default=None)


@brief
@dataclass(frozen=True, eq=False)
class DatasetNoise:
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
    leg_names : tuple of str
        What the legs of orientations mean.
    differences : mapping of str to array
        How far Canny's outlines lie outside the detector's, averaged over repeats, at both ends
        (n, 2) [px], by leg.
    notes : tuple of str
        What else a reader should know.
    """

    dataset: Dataset
    view_names: tuple[str, ...]
    pose_labels: tuple[str, ...]
    repeats: tuple[Repeats, ...]
    methods: tuple[MethodNoise, ...]
    leg_names: tuple[str, ...]
    differences: Mapping[str, Array]
    notes: tuple[str, ...]

    def difference(self, leg: str | None = None) -> tuple[float, float] | None:
        """Return mean and rms of the differences of a leg, or of all [px]; None without any."""
        outward = [d for name, d in self.differences.items() if leg in (None, name)]
        if not outward:
            return None
        every = np.concatenate(outward)
        return float(np.mean(every)), float(np.sqrt(np.mean(np.square(every))))

    def place(self, orientation: LegOrientation) -> Place:
        """Return leg, view and pose of an orientation, by their names."""
        return Place(
            leg=self.leg_names[orientation.leg],
            view=self.view_names[orientation.view],
            pose=self.pose_labels[orientation.pose],
        )

    def document(self) -> dict[str, Any]:
        """Return the document that ``--json`` prints."""
        counts = [len(group.rows) for group in self.repeats]
        return NoiseDocument(
            legcal_noise=1,
            mechanism=self.dataset.machine.name,
            images=sum(counts),
            orientations=len(counts),
            repeats=RepeatCounts(least=min(counts), most=max(counts)),
            methods={method.name: self._method(method) for method in self.methods},
            difference={
                name or "all": None if found is None else MeanAndRms(mean=found[0], rms=found[1])
                for name in (None, *(leg.name for leg in self.methods[0].legs))
                for found in [self.difference(name)]
            },
            notes=list(self.notes),
        ).document()

    def _method(self, method: MethodNoise) -> MethodBlock:
        spreads = {name: method.spread(name) for name in _EVERY}
        largest = {name: s.largest for name, s in spreads.items() if s is not None}
        bounding = {name: method.bounding(name) for name in _EVERY}
        at = {name: self.place(o) for name, o in bounding.items() if o is not None}
        return MethodBlock(
            legs=[
                LegBlock(
                    leg=leg.name,
                    images=leg.images,
                    axes=leg.axes,
                    outlines=sum(o.outlines for o in leg.orientations),
                    outlines_found=sum(o.outlines_found for o in leg.orientations),
                    without_M_LS=leg.without_M_LS,
                    **{name: leg.spread(name) for name in _EVERY},
                    orientations=[self._orientation(o) for o in leg.orientations],
                )
                for leg in method.legs
            ],
            all=ByQuantity[PooledSpread](**spreads),
            upper_bound=ByQuantity[float](**largest),
            upper_bound_at=ByQuantity[Place](**at),
        )

    def _orientation(self, o: LegOrientation) -> OrientationBlock:
        line = pool(o.lines)
        found = {name: o.quantities[name].sd for name in QUANTITIES if name in o.quantities}
        return OrientationBlock(
            view=self.view_names[o.view],
            pose=self.pose_labels[o.pose],
            images=o.images,
            axes=o.axes,
            **found,
            outline=None if line is None else line.sd,
        )


class ByQuantity(Document, Generic[T]):
    """Something of every quantity, or null."""

    psi: T | None = None
    theta: T | None = None
    x: T | None = None
    z: T | None = None
    angle: T | None = None
    across: T | None = None
    tilt: T | None = None
    depth: T | None = None
    outline: T | None = None


class Place(Document):
    """Which orientation."""

    leg: str
    view: str
    pose: str


class OrientationBlock(Document):
    """The standard deviations of one orientation."""

    view: str
    pose: str
    images: int
    axes: int
    psi: float | None = None
    theta: float | None = None
    x: float | None = None
    z: float | None = None
    angle: float | None = None
    across: float | None = None
    tilt: float | None = None
    depth: float | None = None
    outline: float | None = None


class LegBlock(Document):
    """What one method finds of one leg."""

    leg: str
    images: int
    axes: int
    outlines: int
    outlines_found: int
    without_M_LS: int
    psi: PooledSpread | None
    theta: PooledSpread | None
    x: PooledSpread | None
    z: PooledSpread | None
    angle: PooledSpread | None
    across: PooledSpread | None
    tilt: PooledSpread | None
    depth: PooledSpread | None
    outline: PooledSpread | None
    orientations: list[OrientationBlock]


class MethodBlock(Document):
    """What one method finds."""

    legs: list[LegBlock]
    all: ByQuantity[PooledSpread]
    upper_bound: ByQuantity[float]
    upper_bound_at: ByQuantity[Place]


class MeanAndRms(Document):
    """Of the differences between both methods [px]."""

    mean: float
    rms: float


class RepeatCounts(Document):
    """Images of one orientation."""

    least: int
    most: int


class NoiseDocument(Document):
    """What ``legcal noise --json`` prints."""

    legcal_noise: int
    mechanism: str
    images: int
    orientations: int
    repeats: RepeatCounts
    methods: dict[str, MethodBlock]
    difference: dict[str, MeanAndRms | None]
    notes: list[str]
