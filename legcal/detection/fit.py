"""Sub-pixel places of outlines: the limb model fitted to blocks of pixels, then a line to blocks.

Five amplitudes of the limb model are free in every block and enter linearly; they are eliminated,
and one Gauss-Newton step gives how far the outline lies from the current line, with its
variance from the noise of the block. All blocks of all outlines of an image are fitted together.
The line through the blocks of one outline is fitted robustly; two or three rounds suffice.
"""

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
    freedom : (n,) array
        Samples of the block beyond what is fitted, at least one.
    amplitude : (n, 5) array
        Of the functions of the limb model [grey levels].
    normal, right, power : (n, 5, 5), (n, 5) and (n,) array
        Products of these functions, of them with the grey levels, and of grey levels.
    """

    shift: Array
    variance: Array
    noise: Array
    freedom: Array
    amplitude: Array
    normal: Array
    right: Array
    power: Array

    def contrast(self, half_width: Samples, blur: float) -> Array:
        """Return the steps (n,) to the leg, a pixel and a half inside [grey levels]."""
        reference = np.full((len(half_width), 1), 1.5 + blur, dtype=np.float32)
        at, _ = basis(reference, half_width, blur)
        return np.asarray(np.sum(at[:, 2:, 0] * self.amplitude[:, 2:], axis=1))

    def sharpness(self) -> Array:
        """Return how much chi^2 (n,) falls by there being more than a bend of the shading."""
        kept = list(BEND)
        part = self.normal[:, kept][:, :, kept] + 1e-3 * np.eye(len(kept))
        right = self.right[:, kept]
        explained = np.sum(right * np.linalg.solve(part, right[..., None])[..., 0], axis=1)
        share = (self.power - explained) / np.maximum(self.noise, 1e-9)
        return np.asarray(share - self.freedom)


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
    X, slopes = basis(d, half_width, blur)
    n_samples = np.count_nonzero(weight, axis=1).astype(np.float64)
    level = _products(grey, weight) / np.maximum(weight.sum(axis=1), 1e-3)
    y = (grey - level.astype(np.float32)[:, None]) * weight
    X *= weight[:, None, :]
    normal = (X @ X.swapaxes(1, 2)).astype(np.float64)
    right, power = _with(X, y), _products(y, y)
    inverse = _regularised_inverse(normal, right, power, n_samples)
    amplitude = _applied(inverse, right)
    residual = y - _sum(X, amplitude)
    # The outline at distance s further inside lowers d by s.
    change = _sum(slopes, -amplitude) * weight
    change -= _sum(X, _applied(inverse, _with(X, change)))
    information, gradient = _products(change, change), _products(change, residual)
    freedom = np.maximum(n_samples - N_BASIS - 1.0, 1.0)
    seen = (information > 1e-9) & (n_samples > 4 * N_BASIS)
    safe = np.where(seen, information, 1.0)
    step = np.where(seen, gradient / safe, 0.0)
    noise = np.maximum(_products(residual, residual) - step * gradient, 0.0) / freedom
    variance = np.where(seen, noise / safe, np.inf)
    shift = np.clip(step, -STEP, STEP)
    return BlockFit(shift, variance, noise, freedom, amplitude, normal, right, power)


def _products(one: Samples, other: Samples) -> Array:
    """Return the sums of products (n,) in each block."""
    return np.asarray(np.einsum("nm,nm->n", one, other).astype(np.float64))


def _with(functions: Samples, values: Samples) -> Array:
    """Return the sums of products (n, 5) of functions (n, 5, m) with values (n, m)."""
    return np.asarray((functions @ values[..., None])[..., 0].astype(np.float64))


def _sum(functions: Samples, amplitude: Array) -> Samples:
    """Return functions (n, 5, m) with amplitudes (n, 5), added up, (n, m)."""
    return np.asarray((amplitude.astype(np.float32)[:, None] @ functions)[:, 0])


def _applied(matrices: Array, vectors: Array) -> Array:
    return np.asarray((matrices @ vectors[..., None])[..., 0])


def _regularised_inverse(normal: Array, right: Array, power: Array, n_samples: Array) -> Array:
    """Invert normal matrices, drawing amplitudes that the noise of a block leaves open to zero."""
    count = np.maximum(n_samples, 1.0)
    power = power / count + 1e-3
    free = np.linalg.solve(normal + 1e-3 * np.eye(N_BASIS), right[..., None])[..., 0]
    unexplained = power - np.sum(right * free, axis=1) / count
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
