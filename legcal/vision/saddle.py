"""Where two edges cross: a model of the grey levels around a corner, fitted to an image.

Around a corner of a board the grey level is a blurred product of two edges,

    I(p) = m + g . (p - c) + (k + l . (p - c)) S(d1 / s) S(d2 / s) + b (N(d1 / s) + N(d2 / s)),
    S(t) = erf(t / sqrt(2)),    N(t) = exp(-t^2 / 2),

with the distances d1, d2 of p from both edges, which cross in c; b stands for the gamma of the
camera. Turned by half a turn about c the picture is the same: blur, exposure and gamma move both
edges evenly to both sides and leave c.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.special import erf

from legcal.geometry.types import Array

REACH_PX = 9  # pixels of the window to each side, at most
_FEWEST_PX = 24  # pixels that a fit needs
_ITERATIONS = 15
_STOP_PX = 1e-3
_LARGEST_STEP = np.array([1.0, 1.0, 0.2, 0.2, 1.0])  # [px, px, rad, rad, px]
_USUAL_BLUR = 0.7  # [px] at the start
_BLUR_REACH = 1.5  # standard deviations of the blur that reach beside an edge
_LEAST_BAND = 0.3  # of what is free beside an edge that is used at least
_FARTHEST_PX = 2.0  # of the result from the start
_MOST_TURNED = 0.2  # [rad] of an edge from where it should point
_BLUR = (0.35, 4.0)  # [px]
_LEAST_CONTRAST = 4.0  # grey levels of 255
_WORST_FIT = 0.15  # residual, as a part of the contrast
FLOOR_PX = 0.01  # no corner is known better: print, flatness, pixels that differ


@dataclass(frozen=True)
class Saddle:
    """A crossing of two edges in an image.

    Attributes
    ----------
    px : (2,) array
        Where it is [px].
    sigma_px : float
        Standard deviation of either coordinate [px].
    blur_px : float
        Standard deviation of the blur of both edges [px].
    misfit : float
        What the model leaves over (root mean square), as a part of the contrast.
    """

    px: Array
    sigma_px: float
    blur_px: float
    misfit: float


def fit_saddle(
    grey: NDArray[np.float32], start: Array, axes: Array, length: float, band: float
) -> Saddle | None:
    """Return where two edges cross near a pixel; None where the picture is another.

    Parameters
    ----------
    grey : (height, width) array
        Grey levels, 0 to 255.
    start : (2,) array
        Where the corner should be [px].
    axes : (2, 2) array
        The steps in the image along the edges of the board through the corner, in columns,
        for one metre on the board [px / m].
    length : float
        How far both edges are straight on either side of the corner [m].
    band : float
        How far from the edges nothing else is printed [m].
    """
    u, v, levels = _window(grey, start)
    away = np.stack([u - start[0], v - start[1]])
    on_board = np.abs(np.linalg.solve(axes, away))
    steps = np.linalg.norm(axes, axis=0)
    turns = np.arctan2(axes[1], axes[0])
    x = np.array([*start, *turns, _USUAL_BLUR])
    found = None
    for _ in range(2):  # how far blur reaches from what else is printed, the first fit tells
        clear = max(band - (0.5 + _BLUR_REACH * x[4]) / float(steps.min()), _LEAST_BAND * band)
        used = (on_board.max(axis=0) <= length) & (on_board.min(axis=0) <= clear)
        if np.count_nonzero(used) < _FEWEST_PX:
            return None
        found = _fitted(np.stack([u[used], v[used]]), levels[used], x)
        if found is None or not np.hypot(*(found.x[:2] - start)) < _FARTHEST_PX:
            return None
        x = found.x
        if np.abs(x[2:4] - turns).max() > _MOST_TURNED:
            return None
    return None if found is None else _judged(found)


@dataclass(frozen=True, eq=False)
class _Fit:
    """A fitted model: place, angles of the edges and blur, and its derivatives and residual."""

    x: Array
    linear: Array
    residual: Array
    J: Array
    levels: Array


def _window(grey: NDArray[np.float32], start: Array) -> tuple[Array, Array, Array]:
    """Return columns, rows and levels of the pixels around a place."""
    height, width = grey.shape
    column, row = np.rint(start).astype(int)
    columns = np.arange(max(column - REACH_PX, 0), min(column + REACH_PX + 1, width))
    rows = np.arange(max(row - REACH_PX, 0), min(row + REACH_PX + 1, height))
    u, v = (grid.ravel().astype(np.float64) for grid in np.meshgrid(columns, rows))
    levels = grey[np.ix_(rows, columns)].ravel().astype(np.float64)
    return u, v, levels


def _fitted(p: Array, levels: Array, x: Array) -> _Fit | None:
    """Fit the model to pixels (2, n) by Gauss-Newton, its linear parameters eliminated."""
    linear, residual, J = _linearised(x, p, levels)
    for _ in range(_ITERATIONS):
        A = np.concatenate([J, linear], axis=0).T
        step = np.linalg.lstsq(A, residual, rcond=None)[0][:5]
        step *= min(1.0, *(_LARGEST_STEP / np.maximum(np.abs(step), 1e-12)))
        x = x + step
        x[4] = np.clip(x[4], *_BLUR)
        linear, residual, J = _linearised(x, p, levels)
        if np.abs(step[:2]).max() < _STOP_PX:
            return _Fit(x, linear, residual, J, levels)
    return None


def _linearised(x: Array, p: Array, levels: Array) -> tuple[Array, Array, Array]:
    """Return the linear functions (7, n), the residual (n,) and its derivative (5, n) by x."""
    away = p - x[:2, None]
    sides = np.array([[-np.sin(a), np.cos(a)] for a in x[2:4]])
    d = sides @ away
    along = np.array([[np.cos(a), np.sin(a)] for a in x[2:4]]) @ away
    t = d / x[4]
    S = erf(t / np.sqrt(2.0))
    dS = np.sqrt(2.0 / np.pi) * np.exp(-0.5 * t * t)
    product = S[0] * S[1]
    ones = np.ones_like(product)
    bump = np.exp(-0.5 * t * t).sum(axis=0)
    linear = np.stack([ones, *away, product, *(product * away), bump])
    weights = np.linalg.lstsq(linear.T, levels, rcond=None)[0]
    k = weights[3] + weights[4] * away[0] + weights[5] * away[1]
    by_d = np.stack([k * dS[0] * S[1], k * S[0] * dS[1]]) / x[4]
    centre = -(sides.T @ by_d) - (weights[1:3, None] + weights[4:6, None] * product)
    turn = -by_d * along
    blur = -(by_d * t).sum(axis=0)
    residual = levels - weights @ linear
    return linear, residual, np.concatenate([centre, turn, blur[None]])


def _judged(fit: _Fit) -> Saddle | None:
    """Return the corner with what its residual is worth; None where the model does not fit."""
    A = np.concatenate([fit.J, fit.linear], axis=0).T
    n, free = A.shape
    rms = float(np.sqrt(fit.residual @ fit.residual / max(n - free, 1)))
    contrast = 0.5 * float(np.ptp(fit.levels))
    if contrast < _LEAST_CONTRAST or rms > _WORST_FIT * contrast or fit.x[4] >= _BLUR[1]:
        return None
    variance = 0.5 * float(np.trace(np.linalg.pinv(A.T @ A)[:2, :2])) * rms**2
    if not 0.0 < variance < _FARTHEST_PX**2:
        return None
    sigma = float(np.hypot(np.sqrt(variance), FLOOR_PX))
    return Saddle(fit.x[:2].copy(), sigma, float(fit.x[4]), rms / contrast)
