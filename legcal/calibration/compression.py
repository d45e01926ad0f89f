"""How much lossy compression adds to the errors of outlines, found by compressing once more.

What a JPEG has lost is gone, but losing as much again shows how much that is: photographs are
compressed once more with the quality of their files, in blocks that begin elsewhere, and their
outlines are measured again. How far these move is about how far they had moved before.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace

import cv2
import numpy as np

from legcal.calibration.joint_fit.outline_errors import NoiseModel
from legcal.data.outlines import Outlines, no_outlines
from legcal.data.photograph_notes import GOOD_QUALITY
from legcal.geometry.types import Array
from legcal.perception.photographs import Photographs, measure_photographs
from legcal.perception.placement import Placement
from legcal.progress import Report
from legcal.vision.image_facts import ImageFacts
from legcal.vision.image_file import Grey

STAGE = "Compressing once more"
_MAX_IMAGES = 8
_MIN_OUTLINES = 8
_SHIFT = 4  # half a block of a JPEG [px]
_MEDIAN_OF_1 = 0.454936423119573  # of the square of a unit Gaussian
_MOST = 0.9  # of the variance of outlines, beyond which what is left is not known


@dataclass(frozen=True)
class CompressionEffect:
    """What compressing photographs once more does to their outlines.

    Attributes
    ----------
    moved_px : float
        How far the ends of outlines move, a standard deviation by the median [px].
    increase : float
        Standard deviation of outlines over that without compression; infinite where compression is
        nearly all of it.
    """

    moved_px: float
    increase: float

    def __str__(self) -> str:
        """In words, that go after "with standard deviations"."""
        times = f"about {self.increase:.2f}" if math.isfinite(self.increase) else "more than 3"
        return (
            f"{times} times those without compression (compressing photographs once more moves a "
            f"typical outline by {self.moved_px:.3f} px)"
        )


@dataclass(frozen=True)
class _CompressedAgain:
    """Reads photographs and compresses each once more."""

    load: Callable[[int], Grey]  # the photographs themselves cannot travel to other processes
    quality: Mapping[int, int]  # by row

    def __call__(self, row: int) -> Grey:
        grey = np.clip(np.rint(self.load(row)), 0.0, 255.0).astype(np.uint8)
        shifted = np.pad(grey, ((_SHIFT, 0), (_SHIFT, 0)), mode="edge")
        _, file = cv2.imencode(".jpg", shifted, [cv2.IMWRITE_JPEG_QUALITY, self.quality[row]])
        again = np.asarray(cv2.imdecode(file, cv2.IMREAD_GRAYSCALE))
        return again[_SHIFT:, _SHIFT:].astype(np.float32)


def compression_effect(
    photographs: Photographs,
    placement: Placement,
    outlines: Outlines,
    facts: Mapping[str, ImageFacts],
    noise: NoiseModel,
    report: Report,
) -> CompressionEffect | None:
    """Return what compression does to outlines; None where hardly anything was lost.

    Parameters
    ----------
    photographs, placement
        The images, and where the legs are in them.
    outlines : Outlines
        That were measured there.
    facts : mapping
        What the files of images say, by the names of the images.
    noise : NoiseModel
        Errors of these outlines.
    report : callable
        Told the progress.
    """
    names = photographs.measurements.image
    quality = {
        row: found.jpeg_quality
        for row in photographs.detect.tolist()
        if (found := facts.get(names[row])) is not None
        and found.jpeg_quality is not None
        and found.jpeg_quality < GOOD_QUALITY
    }
    if not quality:
        return None
    every = np.array(list(quality), dtype=np.intp)
    chosen = np.linspace(0, len(every) - 1, min(_MAX_IMAGES, len(every))).round().astype(np.intp)
    rows = every[chosen]
    load = _CompressedAgain(photographs.load, quality)
    again = replace(photographs, load=load, detect=rows, keep=no_outlines())
    moved = measure_photographs(again, placement, report, stage=STAGE)
    offsets, claimed = _between(outlines, moved, photographs)
    if len(offsets) < _MIN_OUTLINES:
        return None
    variance = float(np.median(offsets**2)) / _MEDIAN_OF_1
    of_all = np.median(np.diagonal(noise.covariance(claimed), axis1=1, axis2=2))
    share = variance / float(of_all)
    increase = (1.0 - share) ** -0.5 if share < _MOST else math.inf
    return CompressionEffect(math.sqrt(variance), increase)


def _between(one: Outlines, other: Outlines, photographs: Photographs) -> tuple[Array, Array]:
    """Return how far the ends of used outlines are from others (n, 2) [px]; claimed covariances."""
    m = photographs.measurements
    places = {key: k for k, key in enumerate(other.row_keys()) if other.used[k]}
    offsets, claimed = [], []
    for k, key in enumerate(one.row_keys()):
        if one.used[k] and key in places:
            camera = m.views[m.view[key[0]]].camera
            ends = camera.undistort(one.ends[k])
            offsets.append(camera.line_offset(other.h[places[key]], ends))
            claimed.append(one.covariance[k])
    return np.array(offsets).reshape(-1, 2), np.array(claimed).reshape(-1, 2, 2)
