"""Sub-pixel places of outlines: the limb model fitted to blocks of pixels, then a line to blocks.

Five amplitudes of the limb model are free in every block and enter linearly; they are eliminated,
and one Gauss-Newton step gives how far the outline lies from the current line, with its
variance from the noise of the block. All blocks of all outlines of an image are fitted together.
The line through the blocks of one outline is fitted robustly; two or three rounds suffice.
"""

from dataclasses import dataclass

import numpy as np

from legcal.geometry.types import Array, BoolArray
from legcal.vision.limb import N_BASIS, Samples, basis

BLURS = np.array([0.35, 0.5, 0.7, 1.0, 1.4, 2.0, 2.8])  # [px]
BLUR_BLOCKS = 80
RIDGE = np.array([1e-6, 1e-3, 1e-6, 1e-4, 1e-3])  # keeps unseen amplitudes at zero
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
    """

    shift: Array
    variance: Array
    noise: Array
    contrast: Array


def fit_blocks(
    d: Samples, grey: Samples, inside: BoolArray, half_width: Samples, blur: float
) -> BlockFit:
    """Fit the limb model to blocks, by one Gauss-Newton step from the current line.

    Parameters
    ----------
    d, grey : (n, m) array of float32
        Distances inside the current line [px] and grey levels.
    inside : (n, m) array of bool
        Samples to use.
    half_width : (n, 1) array of float32
        Half-width of the cylinder [px].
    blur : float
        Standard deviation of the blur [px].
    """
    values, slopes = basis(d, half_width, blur)
    weight = inside.astype(np.float32)
    n_samples = weight.sum(axis=1).astype(np.float64)
    level = (grey * weight).sum(axis=1) / np.maximum(weight.sum(axis=1), 1)
    y = (grey - level[:, None]) * weight
    X = values * weight[..., None]
    Xt = X.swapaxes(1, 2)
    normal = (Xt @ X).astype(np.float64)
    normal += RIDGE * np.maximum(n_samples, 1.0)[:, None, None] * np.eye(N_BASIS)
    amplitude = np.linalg.solve(normal, (Xt @ y[..., None]).astype(np.float64))
    residual = y - (X @ amplitude.astype(np.float32))[..., 0]
    # The outline at distance s further inside lowers d by s.
    change = -(slopes @ amplitude.astype(np.float32))[..., 0] * weight
    eliminated = np.linalg.solve(normal, (Xt @ change[..., None]).astype(np.float64))
    change = change - (X @ eliminated.astype(np.float32))[..., 0]
    information = np.sum(change * change, axis=1, dtype=np.float64)
    gradient = np.sum(change * residual, axis=1, dtype=np.float64)
    noise = np.sum(residual * residual, axis=1, dtype=np.float64)
    freedom = np.maximum(n_samples - N_BASIS - 1.0, 1.0)
    seen = (information > 1e-9) & (n_samples > 4 * N_BASIS)
    safe = np.where(seen, information, 1.0)
    shift = np.where(seen, np.clip(gradient / safe, -STEP, STEP), 0.0)
    noise = np.maximum(noise - np.where(seen, gradient**2 / safe, 0.0), 0.0) / freedom
    reference = np.broadcast_to(np.float32(1.5 + blur), (len(d), 1))
    at, _ = basis(reference, half_width, blur)
    contrast = np.sum(at[:, 0, 2:] * amplitude[:, 2:, 0], axis=1)
    return BlockFit(shift, np.where(seen, noise / safe, np.inf), noise, contrast)


def estimate_blur(d: Samples, grey: Samples, inside: BoolArray, half_width: Samples) -> float:
    """Return the blur [px] that explains the best blocks of an image best."""
    start = fit_blocks(d, grey, inside, half_width, 1.0)
    merit = np.where(np.isfinite(start.variance), np.abs(start.contrast), 0.0)
    best = np.argsort(-merit, kind="stable")[:BLUR_BLOCKS]
    d, grey, inside, half_width = d[best], grey[best], inside[best], half_width[best]
    misfit = np.empty((len(BLURS), len(best)))
    for i, blur in enumerate(BLURS):
        moved = d
        for _ in range(3):
            fit = fit_blocks(moved, grey, inside, half_width, float(blur))
            moved = moved - fit.shift[:, None].astype(np.float32)
        misfit[i] = np.log(fit.noise + 1e-3)
    total = misfit.mean(axis=1)
    i = int(np.clip(np.argmin(total), 1, len(BLURS) - 2))
    left, middle, right = total[i - 1 : i + 2]
    bend = left - 2.0 * middle + right
    offset = float(np.clip(0.5 * (left - right) / bend, -1.0, 1.0)) if bend > 0.0 else 0.0
    return float(np.exp(np.interp(i + offset, np.arange(len(BLURS)), np.log(BLURS))))
