"""Whether an image can show anything: black, overexposed, featureless, or blurred.

The blur is that of the sharpest edges. An edge of blur sigma that is blurred by s besides has a
slope proportional to (sigma^2 + s^2)^(-1/2); slopes after two such s give sigma, whatever the step.
"""

import math
from collections.abc import Hashable, Mapping
from dataclasses import dataclass

import cv2
import numpy as np

from legcal.data.reasons import USED, Reason, Rejection
from legcal.errors import Cause
from legcal.geometry.types import BoolArray, IntArray
from legcal.vision.image_file import Grey, shrink

BLACK, WHITE = 8.0, 247.0  # bounds of nearly all pixels of an unusable image [grey levels]
BRIGHTEST = 254.5  # [grey levels]
TAIL_PERCENT = 0.5  # percent of an image that may be otherwise
MIN_RANGE = 10.0  # of an image in which something can be seen [grey levels]
REDUCTION = 8  # factor by which an image is reduced before its range is taken, against noise
SCALES = (0.95, 2.5)  # at which slopes are compared, standard deviations [px]
# The first is that of the filter of slopes alone. The second is taken from means of four pixels,
# where that filter is twice as wide.
_BLUR_OF_HALF = 0.5 * math.sqrt(SCALES[1] ** 2 - 4.0 * SCALES[0] ** 2 - 0.25)
STRIDE = 6  # every such row and column is enough for percentiles
_SMOOTH, _SLOPE = (1.0, 4.0, 6.0, 4.0, 1.0), (1.0, 2.0, 0.0, -2.0, -1.0)  # Sobel's, of 5 pixels
_SQUARE = np.ones((3, 3), dtype=np.uint8)
AROUND = 2  # how far from the middle of a coarse edge the fine one may be [px]
_REACH = AROUND + len(_SMOOTH) // 2
_ROWS, _COLUMNS = np.ogrid[: 2 * _REACH + 2, : 2 * _REACH + 2]
_SMOOTHED, _SLOPES = (  # of a row of pixels, without the ends
    np.stack([np.convolve(one, taps, "valid") for one in np.eye(len(_ROWS))]).astype(np.float32)
    for taps in (_SMOOTH, _SLOPE)
)
MARGIN = 3  # of the image of half the size, beyond which edges do not count [px]
DIRECTIONS = 4  # of edges: motion blurs one of them
WEAK = 70.0  # percentile of the slopes from which on a place may be an edge
STRONG = 95.0  # percentile of the slopes from which on they count
FLAT = 1.0  # slope below which nothing is there: a hundredth of a grey level in a pixel
MIN_EDGES, MIN_EDGES_PART = 40, 0.1  # places of a direction, and of all
MAX_EDGES = 1000  # places of a direction that are compared
MAX_BLUR = 8.0  # that the scales can measure [px]
MAX_BLUR_OF_OTHERS = (2.0, 1.2)  # against others: factor, and more [px]
USUAL_PERCENTILE = 40.0  # percentile of blurs, for the usual blur
MIN_IMAGES = 3  # images of a view or camera, to be compared


@dataclass(frozen=True)
class Exposure:
    """Range of grey levels and blur of an image."""

    dark: float  # nearly all of the image is brighter [grey levels]
    bright: float  # nearly all of it is darker [grey levels]
    range: float  # between the darkest and the brightest places [grey levels]
    blur: float  # standard deviation of the blur of its sharp edges [px]
    clipped: float = 0.0  # share of it that is as bright as a file can say

    @property
    def defect(self) -> Rejection:
        """Why nothing can be seen in the image; false if something may."""
        if self.bright < BLACK:
            return Rejection(Reason.BLACK, Cause("{:.0f}", (self.bright,)))
        if self.dark > WHITE:
            return Rejection(Reason.OVEREXPOSED_IMAGE, Cause("{:.0f}", (self.dark,)))
        if self.range < MIN_RANGE:
            return Rejection(Reason.EMPTY, Cause("{:.0f}", (self.range,)))
        return USED


def measure_exposure(grey: Grey) -> Exposure:
    """Return the range of grey levels and the blur of an image."""
    half = shrink(grey, 2)
    small = shrink(half, max(1, min(REDUCTION, min(grey.shape) // 16) // 2))
    low, high = _tails(small)
    dark, bright = _tails(grey[::STRIDE, ::STRIDE])
    clipped = float(np.mean(grey[::STRIDE, ::STRIDE] >= BRIGHTEST))
    return Exposure(dark, bright, high - low, _blur(grey, half), clipped)


def _tails(grey: Grey) -> tuple[float, float]:
    """Return the grey levels between which nearly all of an image is."""
    n = grey.size
    k = int(0.01 * TAIL_PERCENT * (n - 1))
    ordered = np.partition(grey, (k, n - 1 - k), axis=None)
    return float(ordered[k]), float(ordered[n - 1 - k])


def _blur(grey: Grey, half: Grey) -> float:
    """Return the blur of sharp edges [px] of an image, in all directions but one."""
    coarse, row, column, angle = _edges(half)
    direction = np.rint(angle / np.float32(np.pi / DIRECTIONS)).astype(np.int8) % DIRECTIONS
    least = max(MIN_EDGES, int(MIN_EDGES_PART * len(coarse)))  # else they are corners of others
    of_directions = [np.flatnonzero(direction == d) for d in range(DIRECTIONS)]
    strong = [edges[_strongest(coarse[edges])] for edges in of_directions if len(edges) >= least]
    strong = [one[:: -(-len(one) // MAX_EDGES)] for one in strong]
    if not strong:
        return 0.0
    every = np.concatenate(strong)
    ratios = _greatest_slopes(grey, 2 * row[every], 2 * column[every]) / coarse[every]
    blurs = [
        _blur_of(edges) for edges in np.split(ratios, np.cumsum([len(one) for one in strong]))[:-1]
    ]
    # Shades of one direction may be soft everywhere; what moves is sharp in one direction only.
    return sorted(blurs)[min(1, len(blurs) - 1)]


def _edges(half: Grey) -> tuple[Grey, IntArray, IntArray, Grey]:
    """Return slopes in the middles of edges by pixels of the whole image, and where they are.

    By an image of half the size; rows and columns are those of its pixels, angles in radians.
    """
    soft = cv2.GaussianBlur(half, (0, 0), _BLUR_OF_HALF)
    x, y = (cv2.Sobel(soft, cv2.CV_32F, i, 1 - i, ksize=len(_SMOOTH)) for i in (1, 0))
    coarse = np.asarray(cv2.magnitude(x, y), dtype=np.float32)
    few = coarse[::STRIDE, ::STRIDE].ravel()
    k = int(0.01 * WEAK * (len(few) - 1))
    weak = max(np.partition(few, k)[k], np.float32(FLAT))
    # Beside the middle of an edge the ratio of slopes says nothing.
    around = cv2.dilate(coarse, _SQUARE)
    edge = coarse >= np.maximum(around, weak)
    edge[:MARGIN] = edge[-MARGIN:] = edge[:, :MARGIN] = edge[:, -MARGIN:] = False
    at = np.flatnonzero(edge)
    row, column = np.divmod(at, half.shape[1])
    of_edges = np.maximum(0.5 * coarse.take(at), np.float32(1e-3))
    return of_edges, row, column, np.arctan2(y.take(at), x.take(at))


def _strongest(slope: Grey) -> BoolArray:
    """Return the mask of edges of a direction that count."""
    k = min(len(slope) - MIN_EDGES, math.ceil(0.01 * STRONG * (len(slope) - 1)))
    return np.asarray(slope >= np.partition(slope, k)[k])


def _greatest_slopes(grey: Grey, row: IntArray, column: IntArray) -> Grey:
    """Return the greatest slopes (n,) of an image within two pixels of squares of four pixels."""
    corner = (row - _REACH) * grey.shape[1] + (column - _REACH)
    square = grey.ravel().take(corner[:, None, None] + _ROWS * grey.shape[1] + _COLUMNS)
    x, y = _SMOOTHED.T @ square @ _SLOPES, _SLOPES.T @ square @ _SMOOTHED
    return np.asarray(np.sqrt((x * x + y * y).max(axis=(1, 2))))


def _blur_of(ratios: Grey) -> float:
    """Return the blur of edges by the ratios of their slopes, fine to coarse."""
    ordered, n = np.sort(ratios), len(ratios)
    ratio = 0.5 * float(ordered[(n - 1) // 2] + ordered[n // 2])
    one, two = (s**2 for s in SCALES)
    # ratio^2 = (sigma^2 + s2^2) / (sigma^2 + s1^2)
    squared = (two - ratio**2 * one) / max(ratio**2 - 1.0, 1e-3)
    return float(np.sqrt(np.clip(squared, 0.0, MAX_BLUR**2)))


def image_defects(
    exposures: Mapping[int, Exposure], view: Mapping[int, int], camera: Mapping[int, Hashable]
) -> dict[int, Rejection]:
    """Return the rejections of unusable images, alone or compared with others, by row.

    ``view`` and ``camera`` are those of each row: images of a view show about the same through the
    same lens. Where a view has few, as of a camera in the hand, all of its camera are compared.
    """
    defects = {row: why for row, exposure in exposures.items() if (why := exposure.defect)}
    good = {row: exposure.blur for row, exposure in exposures.items() if row not in defects}
    for row, blur in good.items():
        others, whose = [b for r, b in good.items() if view[r] == view[row]], "view"
        if len(others) < MIN_IMAGES:
            others, whose = [b for r, b in good.items() if camera[r] == camera[row]], "camera"
        if len(others) < MIN_IMAGES:
            continue
        usual = float(np.percentile(others, USUAL_PERCENTILE))
        factor, more = MAX_BLUR_OF_OTHERS
        if blur > max(factor * usual, usual + more):
            detail = Cause("{:.1f} px, the others of its {} by {:.1f}", (blur, whose, usual))
            defects[row] = Rejection(Reason.BLURRED, detail)
    return defects
