"""How noisy a picture is on both sides of an outline, and what each pixel therefore counts.

Noise grows with light, and a surface has texture: a dark background is several times quieter than a
lit leg in front of it, so that the foot of the blurred step tells more of its place than the top.
"""

from itertools import pairwise

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtr

from legcal.geometry import Array, BoolArray, Image, IntArray
from legcal.perception.limb import Samples
from legcal.vision import Camera

Grey = NDArray[np.float32]


def to_grey(image: Image) -> Grey:
    """Return an image as float32 grey levels, 0 to 255 whatever the depth of the file.

    Parameters
    ----------
    image : (height, width) or (height, width, 1, 3 or 4) array
        8 or 16 bit integers, or floats that already have that scale; colour in OpenCV's
        order blue, green, red.
    """
    values = image.astype(np.float32, copy=False)
    if image.dtype == np.uint16:
        values = values / np.float32(257.0)
    if values.ndim == 3 and values.shape[2] == 1:
        values = values[..., 0]
    elif values.ndim == 3:
        values = np.asarray(cv2.cvtColor(values[..., :3], cv2.COLOR_BGR2GRAY), dtype=np.float32)
    return np.ascontiguousarray(values)


def reduce(grey: Grey, factor: int) -> Grey:
    """Return an image made smaller by a whole factor, each pixel the mean of a square."""
    if factor == 1:
        return grey
    height, width = (factor * (size // factor) for size in grey.shape)
    size = (width // factor, height // factor)
    small = cv2.resize(grey[:height, :width], size, interpolation=cv2.INTER_AREA)
    return np.asarray(small, dtype=np.float32)


def sample(grey: Grey, camera: Camera, x: Grey, y: Grey) -> tuple[Grey, NDArray[np.bool_]]:
    """Sample an image bilinearly.

    Parameters
    ----------
    grey : Grey
        The image.
    camera : Camera
        Its camera.
    x, y : (n, m) array
        Where it is sampled [px].

    Returns
    -------
    values : (n, m) array
        Grey levels.
    inside : (n, m) array of bool
        False for points outside the image, whose values repeat the border.
    """
    inside = (x >= 0.5) & (x <= camera.width - 1.5) & (y >= 0.5) & (y <= camera.height - 1.5)
    values = cv2.remap(grey, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    return np.asarray(values, dtype=np.float32), inside


DARK = 12.0  # grey level below which noise is taken to be that of this level


def to_light(
    grey: Samples, inside: NDArray[np.bool_], gamma: float
) -> tuple[Samples, NDArray[np.float32]]:
    """Return the light in blocks of pixels, and the weights that its noise asks for.

    Parameters
    ----------
    grey : (n, m) array of float32
        Grey levels, 255 at full scale.
    inside : (n, m) array of bool
        Pixels to use.
    gamma : float
        Grey levels are light to the power 1 / gamma.

    Returns
    -------
    light : (n, m) array of float32
        In units in which it changes like grey levels do at the mean grey level of the block.
    weight : (n, m) array of float32
        The change of a grey level with light: noise of grey levels is taken to be the same in all
        pixels of a block. Zero outside.

    Notes
    -----
    Shot noise grows like the root of light, so that its grey levels scatter the same all over a
    picture where gamma is 2.
    """
    use = inside.astype(np.float32)
    if gamma == 1.0:
        return grey, use
    level = np.sum(grey * use, axis=1) / np.maximum(use.sum(axis=1), 1.0)
    level = np.maximum(level, DARK).astype(np.float32)[:, None]
    light = (level / np.float32(gamma)) * (np.maximum(grey, 0.0) / level) ** np.float32(gamma)
    weight = use * (np.maximum(grey, DARK) / level) ** np.float32(1.0 - gamma)
    return light.astype(np.float32), weight.astype(np.float32)


NOISE_LEVELS = 4.0  # an edge this many times as steep as the median counts half
BESIDE = 0.8  # what an edge counts in the columns beside it


def edge_sharpness(
    profiles: NDArray[np.float32], seen: NDArray[np.bool_], bounds: IntArray
) -> NDArray[np.float32]:
    """Return how much each column of profiles (n_blocks, n) looks like an edge, 0 to 1.

    The maxima of the smoothed gradient along each profile against the median of its patch, widened
    by one column to each side, where they count less. ``bounds`` are the first blocks of patches.
    """
    smooth = cv2.GaussianBlur(profiles, (5, 1), 0.8)
    gradient = np.zeros_like(profiles)
    gradient[:, 1:-1] = np.abs(smooth[:, 2:] - smooth[:, :-2]) * (seen[:, 2:] & seen[:, :-2])
    beside = np.ones((1, 3), dtype=np.uint8)
    wide = np.asarray(cv2.dilate(gradient, beside), dtype=np.float32)
    peak = np.where(gradient >= wide, gradient, np.float32(0.0))
    typical = [
        _median(gradient[first:last][seen[first:last]]) for first, last in pairwise(bounds.tolist())
    ]
    level = np.repeat((NOISE_LEVELS * np.array(typical)) ** 2 + 1e-3, np.diff(bounds))
    sharpness = np.asarray(peak**2 / (peak**2 + level[:, None]), dtype=np.float32)
    widened = np.asarray(cv2.dilate(sharpness, beside), dtype=np.float32)
    return np.asarray(np.maximum(sharpness, np.float32(BESIDE) * widened), dtype=np.float32)


def _median(values: NDArray[np.float32]) -> float:
    """Return the middle value, the upper one of two; 0 of none."""
    middle = len(values) // 2
    return float(np.partition(values, middle)[middle]) if len(values) else 0.0


BEYOND = (1.0, 2.5)  # distance from an outline from which on the step is over: [px] and in blurs
N_SMOOTH = 3  # functions by which a side of a block is smooth: constant, linear, quadratic
ENOUGH = 8  # pixels on a side of a block
LEAST_NOISE = 0.3  # of rounded grey levels: their standard deviation
LARGEST_RATIO = 8.0  # of the noise on both sides that is believed
FEWEST = 3  # blocks of an outline that tell its noise


def evened_weights(
    d: Samples,
    light: Samples,
    weight: Samples,
    bounds: IntArray,
    kept: BoolArray,
    blur: float,
) -> Samples:
    """Return weights with which all pixels beside an outline are equally noisy.

    Parameters
    ----------
    d, light, weight : (n_blocks, m) array of float32
        Distances inside the outlines [px], light, and inverse noise in some unit so far; zero for
        pixels that are not to be used.
    bounds : (n_edges + 1,) array of int
        First block of each outline.
    kept : (n_blocks,) array of bool
        Blocks that lie on their outlines.
    blur : float
        Standard deviation of the blur [px].

    Returns
    -------
    (n_blocks, m) array of float32
        Either side of an outline keeps the noise that its median block shows there, and across the
        blurred step the variance changes as light does.
    """
    beyond = max(BEYOND[0], BEYOND[1] * blur)
    outer, inner = (
        _of_edges(_variance(side, light, weight * (side > beyond)), kept, bounds)
        for side in (-d, d)
    )
    least = LEAST_NOISE**2
    outer, inner = np.maximum(outer, least), np.maximum(inner, least)
    ratio = np.where(np.isfinite(outer) & np.isfinite(inner), inner / outer, 1.0)
    ratio = np.clip(ratio, LARGEST_RATIO**-2, LARGEST_RATIO**2)
    of_block = np.repeat(ratio, np.diff(bounds)).astype(np.float32)[:, None]
    rise = ndtr(d / np.float32(blur)).astype(np.float32)
    # In units of the noise in the middle of the step, which keeps the mean noise about the same.
    return np.asarray(weight * np.sqrt(0.5 * (1.0 + of_block) / (1.0 + (of_block - 1.0) * rise)))


def _variance(distance: Samples, light: Samples, weight: Samples) -> Array:
    """Return the variance of the pixels on one side of each block about a parabola, (n_blocks,)."""
    n = np.count_nonzero(weight, axis=1)
    x = (distance - np.float32(2.0)).astype(np.float64)
    functions = np.stack([np.ones_like(x), x, x * x], axis=1) * weight[:, None, :]
    level = np.sum(light * weight, axis=1) / np.maximum(weight.sum(axis=1), 1e-3)
    y = ((light - level[:, None]) * weight).astype(np.float64)
    normal = functions @ functions.swapaxes(1, 2) + 1e-6 * np.eye(N_SMOOTH)
    right = functions @ y[..., None]
    explained = np.sum(right * np.linalg.solve(normal, right), axis=(1, 2))
    free = np.maximum(n - N_SMOOTH, 1)
    return np.where(n >= ENOUGH, np.maximum(np.sum(y * y, axis=1) - explained, 0.0) / free, np.nan)


def _of_edges(variance: Array, kept: BoolArray, bounds: IntArray) -> Array:
    """Return the median variance of the kept blocks of each edge, NaN where too few tell it."""
    of_edge = np.full(len(bounds) - 1, np.nan)
    for i, (first, last) in enumerate(pairwise(bounds.tolist())):
        told = variance[first:last][kept[first:last] & np.isfinite(variance[first:last])]
        if len(told) >= FEWEST:
            of_edge[i] = np.median(told)
    return of_edge
