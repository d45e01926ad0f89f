"""A straight line through the blocks of one outline, robust, with an honest covariance.

Neighbouring blocks share what the limb model leaves out (texture, shading, the lens), so
the covariance rests on the scatter and the correlation that are seen, and never falls
below what the model is known to be good for.
"""

from dataclasses import dataclass

import numpy as np

from legcal.geometry.types import Array, BoolArray

TUKEY = 4.0  # sigmas at which a block counts no longer
N_ROUNDS = 10
N_SCALES = 3  # rounds in which the scale of the scatter is estimated
LEAST_SCATTER = 0.01  # [px]
COMMON_BIAS, TILT_BIAS = 0.03, 0.02  # of the outline model: of both ends, of each end [px]
LEAST_BLOCKS = 4


@dataclass(frozen=True, eq=False)
class StraightFit:
    """A line through blocks.

    Attributes
    ----------
    ends : (2,) array
        Shift of the outline at t = 0 and at t = length [px of the band].
    kept : (n,) array of bool
        The blocks that lie on it.
    agreement : float
        Share of the blocks that show an edge at all which lie on the line.
    position, residual, variance : (n_kept,) array
        Places of the kept blocks as fractions of the length, their distances from the line
        [px], and the variances of these by noise, scaled to the scatter seen [px^2].
    """

    ends: Array
    kept: BoolArray
    agreement: float
    position: Array
    residual: Array
    variance: Array

    @property
    def first(self) -> float:
        """Position of the first kept block, as a fraction of the length."""
        return float(self.position.min())

    @property
    def last(self) -> float:
        """Position of the last kept block, as a fraction of the length."""
        return float(self.position.max())

    @property
    def scatter(self) -> float:
        """Robust standard deviation of the blocks about the line [px]."""
        return 1.4826 * _median(np.abs(self.residual))

    @property
    def covariance(self) -> Array:
        """Covariance (2, 2) of the shifts at ``first`` and ``last`` [px^2]."""
        along = (self.position - self.first) / (self.last - self.first)
        design = np.column_stack([1.0 - along, along])
        covariance = np.linalg.inv(design.T @ (design / self.variance[:, None]))
        covariance *= _correlation_length(self.residual / np.sqrt(self.variance))
        bias = COMMON_BIAS**2 * np.ones((2, 2)) + TILT_BIAS**2 * np.eye(2)
        return np.asarray(0.5 * (covariance + covariance.T) + bias)


def fit_straight(
    position: Array, shift: Array, variance: Array, largest: float = np.inf
) -> StraightFit | None:
    """Fit a line to the shifts of blocks by iteratively reweighted least squares.

    Parameters
    ----------
    position : (n,) array
        Places of the blocks as fractions of the length.
    shift : (n,) array
        Shifts of the outline there [px].
    variance : (n,) array
        Their variances by noise [px^2], infinite where a block shows nothing.
    largest : float
        Blocks with this variance or a larger one are left out [px^2].

    Returns
    -------
    StraightFit or None
        None if fewer than ``LEAST_BLOCKS`` blocks agree.
    """
    usable = variance < largest
    if np.count_nonzero(usable) < LEAST_BLOCKS:
        return None
    along, moved = position[usable], shift[usable]
    floored = variance[usable] + LEAST_SCATTER**2
    design = np.stack([1.0 - along, along])
    products = np.stack([design[0] ** 2, design[0] * design[1], design[1] ** 2])
    ends, factor = np.full(2, _weighted_median(moved, 1.0 / floored)), 1.0
    for turn in range(N_ROUNDS):
        pull = np.abs(moved - ends @ design) / np.sqrt(floored)
        if turn < N_SCALES:
            factor = max(1.0, 1.4826 * _median(pull))
        robust = np.maximum(1.0 - (pull / (TUKEY * factor)) ** 2, 0.0) ** 2
        weight = robust / floored
        a, b, c = products @ weight
        determinant = a * c - b * b
        if np.count_nonzero(robust) < LEAST_BLOCKS or determinant < 1e-9 * a * c:
            return None
        p, q = design @ (weight * moved)
        before, ends = ends, np.array([c * p - b * q, a * q - b * p]) / determinant
        if turn >= N_SCALES and np.abs(ends - before).max() < 1e-4:
            break
    on_line = robust > 0.0
    kept = usable.copy()
    kept[usable] = on_line
    residual = (moved - ends @ design)[on_line]
    scaled = floored[on_line] * factor**2
    return StraightFit(ends, kept, float(np.mean(on_line)), along[on_line], residual, scaled)


def _correlation_length(pull: Array) -> float:
    """Return the number of successive blocks that count as one, from their correlation."""
    n = len(pull)
    if n < 8:
        return 2.0
    pull = pull - pull.mean()
    power = float(pull @ pull) + 1e-12
    rho = max(0.0, *(float(pull[lag:] @ pull[:-lag]) / power for lag in (1, 2)))
    rho = min(rho, 0.8)
    return (1.0 + rho) / (1.0 - rho)


def _median(values: Array) -> float:
    """Return the middle value, the upper one of two."""
    middle = len(values) // 2
    return float(np.partition(values, middle)[middle])


def _weighted_median(values: Array, weight: Array) -> float:
    """Return the median of values with weights."""
    order = np.argsort(values, kind="stable")
    total = np.cumsum(weight[order])
    return float(values[order][np.searchsorted(total, 0.5 * total[-1])])
