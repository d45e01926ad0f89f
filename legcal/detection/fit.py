"""Sub-pixel places of outlines: the limb model fitted to blocks of pixels, then a line to blocks.

Five amplitudes of the limb model are free in every block and enter linearly; they are eliminated,
and one Gauss-Newton step gives how far the outline lies from the current line, with its
variance from the noise of the block. All blocks of all outlines of an image are fitted together.
The line through the blocks of one outline is fitted robustly; two or three rounds suffice.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from legcal.detection.limb import N_BASIS, Samples, basis
from legcal.geometry.types import Array

BLURS = (0.3, 2.7, 6)  # trials, least to greatest [px]
BLUR_BLOCKS = 16
BLUR_ROUNDS = 2
DEPTH = (2.0, 2.5)  # used distance from an outline: [px] and in blurs
# Prior precision of the amplitudes, in units of the contrast of a block.
RIDGE = np.array([1e-6, 1.0, 1e-2, 0.05, 0.05])
BEND = (0, 1, 4)  # functions of the limb model without an edge
STEP = 0.8  # largest step of a block [px]


@dataclass(frozen=True, eq=False)
class BlockFit:
    """Where the outline lies in every block.

    Attributes
    ----------
    shift : (n,) array
        Distance of the outline from the current line, positive towards the inside [px].
    variance : (n,) array
        Its variance by the noise of the block [px^2]; infinite where nothing is seen.
    noise : (n,) array
        Mean square residual of the block [grey levels^2].
    contrast : (n,) array
        Step from the background to the leg, a pixel and a half inside [grey levels].
    sharp : (n,) array
        How much chi^2 falls by there being a step or a limb, and not only a bend of the shading.
    """

    shift: Array
    variance: Array
    noise: Array
    contrast: Array
    sharp: Array


def fit_blocks(
    d: Samples, grey: Samples, weight: Samples, half_width: Samples, blur: Samples | float
) -> BlockFit:
    """Fit the limb model to blocks, by one Gauss-Newton step from the current line.

    Parameters
    ----------
    d, grey : (n, m) array of float32
        Distances inside the current line [px] and grey levels, proportional to light.
    weight : (n, m) array of float32
        Inverse noise of the samples in some unit; zero for those that are not to be used.
    half_width : (n, 1) array of float32
        Half-width of the cylinder [px].
    blur : float or (n, 1) array of float32
        Standard deviation of the blur [px].
    """
    values, slopes = basis(d, half_width, blur)
    n_samples = np.count_nonzero(weight, axis=1).astype(np.float64)
    level = np.einsum("nm,nm->n", grey, weight) / np.maximum(weight.sum(axis=1), 1e-3)
    y = (grey - level[:, None]) * weight
    X = values * weight[:, None, :]
    Xt = X.swapaxes(1, 2)
    normal = (X @ Xt).astype(np.float64)
    right = (X @ y[..., None]).astype(np.float64)
    inverse = _regularised_inverse(normal, right, y, n_samples)
    amplitude = inverse @ right
    residual = y - (Xt @ amplitude.astype(np.float32))[..., 0]
    # The outline at distance s further inside lowers d by s.
    change = -(slopes.swapaxes(1, 2) @ amplitude.astype(np.float32))[..., 0] * weight
    eliminated = inverse @ (X @ change[..., None]).astype(np.float64)
    change -= (Xt @ eliminated.astype(np.float32))[..., 0]
    information = np.einsum("nm,nm->n", change, change).astype(np.float64)
    gradient = np.einsum("nm,nm->n", change, residual).astype(np.float64)
    noise = np.einsum("nm,nm->n", residual, residual).astype(np.float64)
    freedom = np.maximum(n_samples - N_BASIS - 1.0, 1.0)
    seen = (information > 1e-9) & (n_samples > 4 * N_BASIS)
    safe = np.where(seen, information, 1.0)
    shift = np.where(seen, np.clip(gradient / safe, -STEP, STEP), 0.0)
    noise = np.maximum(noise - np.where(seen, gradient**2 / safe, 0.0), 0.0) / freedom
    reference = np.broadcast_to(np.asarray(1.5 + blur, dtype=np.float32), (len(d), 1))
    at, _ = basis(reference, half_width, blur)
    contrast = np.sum(at[:, 2:, 0] * amplitude[:, 2:, 0], axis=1)
    sharp = _without(normal, right, y, BEND) / np.maximum(noise, 1e-9) - freedom
    return BlockFit(shift, np.where(seen, noise / safe, np.inf), noise, contrast, sharp)


def _without(normal: Array, right: Array, y: Samples, kept: Sequence[int]) -> Array:
    """Return the sum of squares that some of the functions of the model leave unexplained."""
    some = list(kept)
    part = normal[:, some][:, :, some] + 1e-3 * np.eye(len(some))
    explained = np.sum(right[:, some] * np.linalg.solve(part, right[:, some]), axis=(1, 2))
    return np.asarray(np.einsum("nm,nm->n", y, y).astype(np.float64) - explained)


def _regularised_inverse(normal: Array, right: Array, y: Samples, n_samples: Array) -> Array:
    """Invert normal matrices, drawing amplitudes that the noise of a block leaves open to zero."""
    count = np.maximum(n_samples, 1.0)
    power = np.einsum("nm,nm->n", y, y).astype(np.float64) / count + 1e-3
    free = np.linalg.solve(normal + 1e-3 * np.eye(N_BASIS), right)
    unexplained = power - np.sum(right * free, axis=(1, 2)) / count
    prior = np.clip(unexplained / power, 1e-4, 1.0)[:, None] * RIDGE
    return np.asarray(np.linalg.inv(normal + prior[:, :, None] * np.eye(N_BASIS)))


def estimate_blur(
    d: Samples, grey: Samples, weight: Samples, half_width: Samples, merit: Array
) -> float:
    """Return the blur [px] that explains the best blocks of an image best.

    Parameters
    ----------
    d, grey, weight, half_width
        As for :func:`fit_blocks`.
    merit : (n,) array
        How much each block tells, such as its contrast.
    """
    best = np.argsort(-merit, kind="stable")[:BLUR_BLOCKS]
    d, grey, weight, half_width = d[best], grey[best], weight[best], half_width[best]
    blurs = np.geomspace(*BLURS)
    misfit = _misfits(d, grey, weight, half_width, blurs)
    i = int(np.clip(np.argmin(misfit), 1, len(blurs) - 2))
    left, middle, right = misfit[i - 1 : i + 2]
    bend = left - 2.0 * middle + right
    offset = float(np.clip(0.5 * (left - right) / bend, -1.0, 1.0)) if bend > 0.0 else 0.0
    return float(blurs[i] * (blurs[1] / blurs[0]) ** offset)


def depth_for_blur(blur: float) -> float:
    """Return how far from an outline pixels are used [px]: little more than the blur reaches."""
    return DEPTH[0] + DEPTH[1] * blur


def _misfits(
    d: Samples, grey: Samples, weight: Samples, half_width: Samples, blurs: Array
) -> Array:
    """Return, for each of some blurs, the mean logarithm of the noise of the fitted blocks."""
    n = len(blurs)
    blur = np.repeat(blurs, len(d)).astype(np.float32)[:, None]
    d, grey, weight, half_width = (np.concatenate([x] * n) for x in (d, grey, weight, half_width))
    for _ in range(BLUR_ROUNDS):
        fit = fit_blocks(d, grey, weight, half_width, blur)
        d = d - fit.shift[:, None].astype(np.float32)
    return np.asarray(np.log(fit.noise + 1e-3).reshape(n, -1).mean(axis=1))
