"""Whether an image can show anything: black, overexposed, featureless, or blurred.

The blur is that of the sharpest edges. An edge of blur sigma that is blurred by s besides has a
slope proportional to (sigma^2 + s^2)^(-1/2); slopes after two such s give sigma, whatever the step.
"""

import math
from collections.abc import Hashable, Mapping
from dataclasses import dataclass

import cv2
import numpy as np

from legcal.perception.light import reduce
from legcal.vision import Grey

BLACK, WHITE = 8.0, 247.0  # what nearly all of an image is below or above [grey levels]
TAIL_PERCENT = 0.5  # percent of an image that may be otherwise
MIN_RANGE = 10.0  # of an image in which something can be seen [grey levels]
REDUCTION = 8  # factor by which an image is reduced before its range is taken, against noise
SCALES = (0.95, 2.5)  # at which slopes are compared, standard deviations [px]
# The first is that of the filter of slopes alone. The second is taken from means of four pixels,
# where that filter is twice as wide.
_BLUR_OF_HALF = 0.5 * math.sqrt(SCALES[1] ** 2 - 4.0 * SCALES[0] ** 2 - 0.25)
STRIDE = 6  # every such row and column is enough for percentiles
DIRECTIONS = 4  # of edges: what moves is blurred in one
WEAK = 70.0  # percentile of the slopes from which on a place may be an edge
STRONG = 95.0  # percentile of the slopes from which on they count
MIN_EDGES, MIN_EDGES_PART = 40, 0.1  # places of a direction, and of all
MAX_BLUR = 8.0  # that the scales can measure [px]
MAX_BLUR_OF_OTHERS = (2.0, 1.2)  # against others: factor, and more [px]
USUAL_PERCENTILE = 40.0  # percentile of blurs, for what is usual
MIN_IMAGES = 3  # images of a view or camera, to be compared


@dataclass(frozen=True)
class Exposure:
    """Range of grey levels and blur of an image."""

    dark: float  # nearly all of the image is brighter [grey levels]
    bright: float  # nearly all of it is darker [grey levels]
    range: float  # between the darkest and the brightest places [grey levels]
    blur: float  # standard deviation of the blur of its sharp edges [px]

    @property
    def defect(self) -> str:
        """Why nothing can be seen in the image, "" if something may."""
        if self.bright < BLACK:
            return f"the image is black, at most {self.bright:.0f} of 255 grey levels"
        if self.dark > WHITE:
            return f"the image is overexposed, at least {self.dark:.0f} of 255 grey levels"
        if self.range < MIN_RANGE:
            return f"the image shows nothing, all of it within {self.range:.0f} of 255 grey levels"
        return ""


def measure_exposure(grey: Grey) -> Exposure:
    """Return the range of grey levels and the blur of an image."""
    small = reduce(grey, max(1, min(REDUCTION, min(grey.shape) // 16)))
    low, high = np.percentile(small, [TAIL_PERCENT, 100.0 - TAIL_PERCENT])
    dark, bright = np.percentile(grey[::STRIDE, ::STRIDE], [TAIL_PERCENT, 100.0 - TAIL_PERCENT])
    return Exposure(float(dark), float(bright), float(high - low), _blur(grey))


def _blur(grey: Grey) -> float:
    """Return the blur of sharp edges [px], in all directions but one."""
    fine, coarse, angle = _edges(grey)
    direction = np.rint(angle / (np.pi / DIRECTIONS)).astype(np.intp) % DIRECTIONS
    least = max(MIN_EDGES, int(MIN_EDGES_PART * len(fine)))  # else they are corners of others
    of_direction = [direction == d for d in range(DIRECTIONS)]
    chosen = [own for own in of_direction if np.count_nonzero(own) >= least]
    blurs = sorted(_blur_of(fine[own], coarse[own]) for own in chosen)
    # Shades of one direction may be soft everywhere; what moves is sharp in one direction only.
    return blurs[min(1, len(blurs) - 1)] if blurs else 0.0


def _edges(grey: Grey) -> tuple[Grey, Grey, Grey]:
    """Return slopes of edges in their middle, fine and coarse, and their directions [rad]."""
    height, width = (2 * (size // 2) for size in grey.shape)
    slope = cv2.magnitude(*_slopes(grey[:height, :width]))
    rows = np.maximum(slope[::2], slope[1::2])
    fine = np.maximum(rows[:, ::2], rows[:, 1::2])  # the greatest of four pixels
    half = cv2.GaussianBlur(reduce(grey, 2), (0, 0), _BLUR_OF_HALF)
    x, y = _slopes(np.asarray(half, dtype=np.float32))
    coarse = cv2.magnitude(x, y)
    # Beside the middle of an edge the ratio says nothing.
    edge = fine >= cv2.dilate(fine, np.ones((3, 3), np.uint8))
    edge &= coarse >= np.percentile(coarse[::STRIDE, ::STRIDE], WEAK)
    coarse = np.maximum(0.5 * coarse[edge], np.float32(1e-3))  # by pixels of the whole image
    return fine[edge], coarse, np.arctan2(y[edge], x[edge])


def _blur_of(fine: Grey, coarse: Grey) -> float:
    """Return the blur of the strongest of some edges by their slopes, fine and coarse."""
    strong = coarse >= np.partition(coarse, -MIN_EDGES)[-MIN_EDGES]
    strong |= coarse >= np.percentile(coarse, STRONG)
    ratio = float(np.median(fine[strong] / coarse[strong]))
    one, two = (s**2 for s in SCALES)
    # ratio^2 = (sigma^2 + s2^2) / (sigma^2 + s1^2)
    squared = (two - ratio**2 * one) / max(ratio**2 - 1.0, 1e-3)
    return float(np.sqrt(np.clip(squared, 0.0, MAX_BLUR**2)))


def _slopes(grey: Grey) -> tuple[Grey, Grey]:
    """Return both slopes of an image, a little blurred."""
    x, y = (cv2.Sobel(grey, cv2.CV_32F, i, 1 - i, ksize=5) for i in (1, 0))
    return np.asarray(x, dtype=np.float32), np.asarray(y, dtype=np.float32)


def image_defects(
    exposures: Mapping[int, Exposure], view: Mapping[int, int], camera: Mapping[int, Hashable]
) -> dict[int, str]:
    """Return why images cannot be used: by themselves, or beside others, by row.

    ``view`` and ``camera`` are those of each row: images of a view show about the same through the
    same lens. Where a view has few, as of a camera in the hand, all of its camera are compared.
    """
    found = {row: why for row, exposure in exposures.items() if (why := exposure.defect)}
    good = {row: exposure.blur for row, exposure in exposures.items() if row not in found}
    for row, blur in good.items():
        others, whose = [b for r, b in good.items() if view[r] == view[row]], "view"
        if len(others) < MIN_IMAGES:
            others, whose = [b for r, b in good.items() if camera[r] == camera[row]], "camera"
        if len(others) < MIN_IMAGES:
            continue
        usual = float(np.percentile(others, USUAL_PERCENTILE))
        factor, more = MAX_BLUR_OF_OTHERS
        if blur > max(factor * usual, usual + more):
            found[row] = (
                f"the image is blurred by {blur:.1f} px, the others of its {whose} by {usual:.1f}"
            )
    return found
