"""Crossings of two edges in grey levels: where they are, by a model fitted to the pixels around.

Around a corner of a board the light is a product of two steps. Lens and pixels blur it, cameras
sharpen it afterwards: they add a part of its difference from a blurred copy of it, so that it
overshoots beside the edges. Both are linear, and so grey levels are

    f = c0 + c1 x + c2 y + (k0 + k1 x + k2 y) P(s) + k3 P(s') + b (G0 + G1),    s'^2 = s^2 + r^2,

P(s) the product of both steps under a blur s, P(s') the one of the copy, G0 + G1 what a tone curve
makes of the edges (a square of P), and linear terms what light and shade do. Each of these is even
about the crossing, so that none of them moves it. All crossings of an image are fitted at once.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from legcal.geometry.types import Array, BoolArray, IntArray
from legcal.vision.image_file import Grey

_Levels = NDArray[np.floating[Any]]

MIN_CONTRAST = 4.0  # grey levels of 255

_REACH = 9  # pixels of the window to each side, at most
_N_LINEAR, _N_PLACED = 13, 5  # coefficients; place, two angles, logarithm of the blur
_SLOPE = math.sqrt(2.0 / math.pi)
# The error function by the bell: Abramowitz and Stegun, 7.1.26, to 2e-7.
_STEP_SCALE = 0.3275911 / math.sqrt(2.0)
_STEP = (1.061405429, -1.453152027, 1.421413741, -0.284496736, 0.254829592)
_MIN_AREA = 1e-6  # [px^2 / unit^2] between axes that are not one line
_MIN_PIXELS = 24  # pixels that a fit needs
_SPARSE = 0.8  # part of the pixels of a window below which those that are used are picked out
_AT_ONCE = 20  # crossings whose functions stay in the cache of a processor
_ITERATIONS = 12
_ROUGH_PART, _ROUGH_HALF = 0.9, (2, 7)  # window of the first guess: part of what is free, [px]
_ROUGH_ENDS = (cv2.TERM_CRITERIA_EPS + cv2.TERM_CRITERIA_COUNT, 12, 0.02)  # its steps, [px]
_ROUGHLY_PX, _CONVERGED_PX = 0.1, 4e-3
_MAX_STEP = np.array([1.0, 1.0, 0.2, 0.2, 0.4])  # [px, px, rad, rad, 1]
_START_BLUR = 0.8  # [px]
_MASK_RADIUS = 1.3  # of the blurred copy: cameras have 1 to 1.5 px [px]
_RIDGE = 1e-4  # on overshoot and blur, which explain edges almost alike; contrasts are 1
_MANY_PIXELS = 200  # fewer do not tell overshoot from other shapes of an edge
_OVERSHOOT = [6, 7, 8, 10, 11, 12]  # functions of it, and of tones
_BLUR_RIDGE = 1e-3
_OTHER_PX = 0.3  # by which the strip beside the edges is another that is used again
_BLUR_SIGMAS = 1.5  # standard deviations of the blur that reach beside an edge
_MIN_BAND = 0.5  # of what is free beside an edge that is used at least
MAX_SHIFT_PX = 2.5  # of the result from the start
_MAX_TURN = 0.3  # [rad] of an edge from where it should point
_BLURS = (0.3, 4.0)  # [px]
_MAX_MISFIT = 0.35  # residual, as a part of the contrast
_MIN_SIGMA_PX = 0.01  # no corner is known better: print, flatness, pixels that differ
_LAGS = 2  # pixels over which residuals are correlated: mosaics of colour, JPEG, other shapes


@dataclass(frozen=True, eq=False)
class Saddles:
    """Crossings of two edges in an image."""

    px: Array  # (n, 2) where they are [px]
    sigma_px: Array  # (n,) standard deviation of either coordinate [px]
    # (n,) standard deviation of the blur with which edges would be as steep without overshoot [px]
    blur_px: Array
    # (n,) half of the step over an edge [grey levels]; positive if it is bright where both sides,
    # clockwise from the axes as the image shows them, are
    contrast: Array
    misfit: Array  # (n,) residual of the model (root mean square), over the contrast
    found: BoolArray  # (n,) whether the picture is a crossing at all; others have no numbers

    def choose(self, rows: IntArray | BoolArray) -> Saddles:
        """Return some of them."""
        return Saddles(*(value[rows] for value in vars(self).values()))

    def moved_to(self, px: Array, scale: float) -> Saddles:
        """Return them where they are in an image, found in one that is scaled by a factor."""
        return replace(self, px=px, sigma_px=self.sigma_px / scale, blur_px=self.blur_px / scale)


def fit_saddles(
    grey: Grey,  # (height, width) grey levels, 0 to 255
    start: Array,  # (n, 2) where the crossings should be [px]
    axes: Array,  # (n, 2, 2) the steps in the image along both edges [px / unit]
    length: float,  # how far both edges are straight on either side of the crossing [unit]
    band: float,  # how far from the edges nothing else is printed [unit]
    blur: float = 0.0,  # of crossings of this image, if it is known [px]
) -> Saddles:
    """Return the crossings of two edges near some pixels."""
    if not len(start):
        none = np.zeros(0)
        return Saddles(np.zeros((0, 2)), none, none, none, none, np.zeros(0, dtype=np.bool_))
    height, width = grey.shape
    at = np.where(np.isfinite(start), start, -1.0)
    there = np.all((at > -0.5) & (at < [width - 0.5, height - 0.5]), axis=1)
    start = np.where(there[:, None], at, 0.0)
    axes = np.where((there & np.isfinite(axes).all(axis=(1, 2)))[:, None, None], axes, 0.0)
    steps = np.maximum(np.linalg.norm(axes, axis=1).min(axis=1), 1e-9)
    turns = np.arctan2(axes[:, 1], axes[:, 0])
    reach = int(np.clip(np.ceil(length * np.abs(axes).sum(axis=2).max()), 3, _REACH))
    window = _Window.around(grey, start, axes, reach)

    def free(blur: Array) -> Array:
        return np.asarray(np.maximum(band - (0.5 + _BLUR_SIGMAS * blur) / steps, _MIN_BAND * band))

    at_first = np.full(len(start), blur or _START_BLUR)
    x = np.column_stack([np.zeros((len(start), 2)), turns, np.log(at_first)])
    at_first = free(at_first)
    weight = window.weight(length, at_first)
    c = np.zeros((len(start), _N_LINEAR))
    c[:, 3] = window.contrast(weight, turns)
    _fit(window, weight, x, c, _ROUGHLY_PX)
    # The first fit gives how far blur reaches from what else is printed, and where the edges are.
    now = free(np.exp(x[:, 4]))
    other = np.abs(now - at_first) * steps > _OTHER_PX
    other |= (np.linalg.norm(x[:, :2], axis=1) > _OTHER_PX) & (now * steps < reach)
    other &= np.linalg.norm(x[:, :2], axis=1) < MAX_SHIFT_PX
    if other.any():
        start = start.copy()
        start[other] += x[other, :2]
        x[other, :2] = 0.0
        part = _Window.around(grey, start[other], axes[other], reach)
        window.put(other, part)
        weight[other] = part.weight(length, now[other])
    _fit(window, weight, x, c, _CONVERGED_PX)
    return _judged(window, weight, x, c, start, turns)


def near_saddles(
    grey: Grey,  # (height, width) grey levels
    start: Array,  # (n, 2) where crossings should be [px]
    axes: Array,  # (n, 2, 2) the steps in the image along both edges [px / unit]
    band: float,  # how far from the edges nothing else is printed [unit]
    most: float = np.inf,  # by which they are moved at most [px], if not the half of a window
) -> Array:
    """Return about where crossings are (n, 2), by the gradients in a window around [px]."""
    with np.errstate(invalid="ignore"):
        free = band * np.linalg.norm(axes, axis=1).min(axis=1)
        half = int(np.clip(_ROUGH_PART * np.nanmedian(free), *_ROUGH_HALF)) if len(free) else 0
        height, width = grey.shape
        inside = np.all((start > half) & (start < [width - half - 1, height - half - 1]), axis=1)
    nearest = start.copy()
    if inside.any():
        at = np.ascontiguousarray(start[inside], dtype=np.float32)
        nearest[inside] = cv2.cornerSubPix(grey, at, (half, half), (-1, -1), _ROUGH_ENDS)
    moved = np.linalg.norm(nearest - start, axis=1)
    return np.where((moved < most)[:, None], nearest, start)


@dataclass(frozen=True, eq=False)
class _Window:
    """The pixels around places in single precision: columns and rows less the place, levels."""

    side: int  # pixels along a side; m is its square
    u: _Levels  # (n, m)
    v: _Levels
    levels: _Levels  # normalised: by half of their range, about their mean
    scale: _Levels  # (n,) that half [grey levels]
    inside: BoolArray  # (n, m) whether a pixel is in the image
    on_board: _Levels  # (n, 2, m) how far along the axes [unit], without sign

    @classmethod
    def around(cls, grey: Grey, start: Array, axes: Array, reach: int) -> _Window:
        """Return the pixels that are within a reach [px]."""
        height, width = grey.shape
        near = np.arange(-reach, reach + 1)
        rows, columns = (g.ravel() for g in np.meshgrid(near, near, indexing="ij"))
        middle = np.rint(start).astype(np.intp)
        column, row = middle[:, :1] + columns, middle[:, 1:] + rows
        inside = (column >= 0) & (column < width) & (row >= 0) & (row < height)
        levels = grey[np.clip(row, 0, height - 1), np.clip(column, 0, width - 1)]
        levels = levels.astype(np.float32)
        few = int(0.05 * levels.shape[1])
        ends = np.partition(levels, (few, -1 - few), axis=1)
        low, high = ends[:, few], ends[:, -1 - few]
        scale = np.maximum(0.5 * (high - low), np.float32(1e-3))
        levels = (levels - 0.5 * (high + low)[:, None]) / scale[:, None]
        u = (column - start[:, :1]).astype(np.float32)
        v = (row - start[:, 1:]).astype(np.float32)
        (a, b), (c, d) = (axes[:, k, :, None].swapaxes(0, 1).astype(np.float32) for k in range(2))
        area = a * d - b * c
        on_board = np.abs(np.stack([d * u - b * v, a * v - c * u], axis=1))
        is_line = np.abs(area) < _MIN_AREA  # nothing is on the board
        on_board /= np.where(is_line, 1.0, np.abs(area))[:, None]
        on_board[is_line[:, 0]] = np.inf
        return cls(len(near), u, v, levels, scale, inside, on_board)

    def weight(self, length: float, free: Array) -> _Levels:
        """Return 1 for pixels (n, m) that are used, else 0."""
        near = (self.on_board.max(axis=1) <= length) & (self.on_board.min(axis=1) <= free[:, None])
        return np.asarray(near & self.inside, dtype=np.float32)

    def contrast(self, weight: _Levels, angles: Array) -> Array:
        """Return about the contrast (n,), by which sides of edges at angles (n, 2) are bright."""
        c, s = np.cos(angles)[:, :, None], np.sin(angles)[:, :, None]
        sides = np.sign(c * self.v[:, None] - s * self.u[:, None]).prod(axis=1) * weight
        return np.asarray(np.sum(sides * self.levels, axis=1) / np.maximum(weight.sum(axis=1), 1.0))

    def put(self, rows: BoolArray, part: _Window) -> None:
        """Put the pixels around other places in some rows."""
        for name, value in vars(part).items():
            if name != "side":
                getattr(self, name)[rows] = value


def _fit(window: _Window, weight: _Levels, x: Array, c: Array, tolerance: float) -> None:
    """Fit the model by Gauss-Newton, from what *x* and *c* hold to what it finds.

    Place less the start, angles and logarithm of the blur x (n, 5); coefficients c (n, 13); the
    tolerance of a place [px].
    """
    count = weight.sum(axis=1, dtype=np.float64)
    open_ = np.flatnonzero(count >= _MIN_PIXELS)
    if not len(open_):
        return
    pixels = [window.u, window.v, window.levels, weight]
    most = np.full(len(count), weight.shape[1])
    if np.median(count[open_]) < _SPARSE * weight.shape[1]:
        used = np.argsort(-weight, axis=1, kind="stable")  # the pixels that are used, first
        pixels = [np.take_along_axis(part, used, axis=1) for part in pixels]
        most = count.astype(np.intp)
        open_ = open_[np.argsort(most[open_], kind="stable")]
    for _ in range(_ITERATIONS):
        going = []
        for first in range(0, len(open_), _AT_ONCE):
            at = open_[first : first + _AT_ONCE]
            u, v, levels, w = (part[at, : most[at].max()] for part in pixels)
            here = x[at]
            A = _functions(u, v, here, c[at])  # in single precision: enough for steps
            A *= w[:, None]
            N = (A @ np.swapaxes(A, 1, 2)).astype(np.float64)
            rhs = (A @ (levels * w)[:, :, None])[:, :, 0]
            expected = np.zeros((len(at), _N_LINEAR + _N_PLACED))
            expected[:, -1] = np.log(_START_BLUR) - here[:, 4]
            solution = _solve(N, rhs, count[at], expected)
            c[at], step = solution[:, :_N_LINEAR], solution[:, _N_LINEAR:]
            step = np.clip(step, -_MAX_STEP, _MAX_STEP)
            here = here + step
            here[:, 4] = np.clip(here[:, 4], *np.log(_BLURS))
            x[at] = here
            more = np.abs(step[:, :2]).max(axis=1) >= tolerance
            more &= np.abs(here[:, :2]).max(axis=1) <= 2.0 * MAX_SHIFT_PX
            going.append(at[more])
        open_ = np.concatenate(going)
        if not len(open_):
            break


def _solve(N: Array, rhs: _Levels, count: Array, expected: Array) -> Array:
    """Return the coefficients (n, k) of functions by normal equations N (n, k, k), rhs (n, k).

    Those of overshoot and tones are near zero where *count* (n,) pixels are few.
    """
    n, k, _ = N.shape
    ridge = np.full((n, k), 1e-9)
    few = np.maximum(_MANY_PIXELS / np.maximum(count, 1.0), 1.0) ** 4
    ridge[:, _OVERSHOOT] = (_RIDGE * few)[:, None]
    if k > _N_LINEAR:
        ridge[:, -1] = _BLUR_RIDGE
    ridge *= np.maximum(np.trace(N, axis1=1, axis2=2) / k, 1e-9)[:, None]
    N = N.copy()
    N[:, np.arange(k), np.arange(k)] += ridge
    return np.asarray(np.linalg.solve(N, (rhs + ridge * expected)[:, :, None])[:, :, 0])


def _functions(u: _Levels, v: _Levels, x: Array, c: Array) -> _Levels:
    """Return the linear functions (n, 18, m), the derivatives of their sum after them."""
    x = x.astype(u.dtype)
    dx, dy = u - x[:, :1], v - x[:, 1:2]
    n, m = dx.shape
    cos, sin = np.cos(x[:, 2:4]), np.sin(x[:, 2:4])
    d = cos[:, :, None] * dy[:, None] - sin[:, :, None] * dx[:, None]
    s = np.exp(x[:, 4])[:, None, None]
    wide = np.hypot(s, _MASK_RADIUS)
    t, tw = d / s, d / wide
    G, H = np.exp(-0.5 * t * t), np.exp(-0.5 * tw * tw)
    S, T = _blurred_step(t, G), _blurred_step(tw, H)
    # Edges at a slant share their blur, which to first order adds a product of bells.
    slant = (2.0 / math.pi) * np.cos(x[:, 2] - x[:, 3])[:, None]
    both = slant * G[:, 0] * G[:, 1]
    A = np.empty((n, _N_LINEAR + _N_PLACED, m), dtype=u.dtype)
    A[:, 0], A[:, 1], A[:, 2] = 1.0, dx, dy
    P = S[:, 0] * S[:, 1] + both
    A[:, 3], A[:, 4], A[:, 5] = P, P * dx, P * dy
    A[:, 6], A[:, 7], A[:, 8] = T[:, 0] * S[:, 1], S[:, 0] * T[:, 1], T[:, 0] * T[:, 1]
    A[:, 9], A[:, 10] = G.sum(axis=1), P * P
    A[:, 11:13] = H
    c = c.astype(u.dtype)
    k = (c[:, 3:4] + c[:, 4:5] * dx + c[:, 5:6] * dy)[:, None]
    over, Q = c[:, 6:8, None], c[:, 8, None, None]
    slope, slope_w = _SLOPE * G / s, _SLOPE * H / wide
    other, other_w = S[:, ::-1], T[:, ::-1]
    # by the distances in functions of the blur, and of the wide one
    tone = k + (2.0 * c[:, 10:11] * P)[:, None]
    by_s = tone * (slope * other - both[:, None] * t / s) + over[:, ::-1] * slope * other_w
    by_s -= c[:, 9, None, None] * t / s * G
    by_w = over * slope_w * other + Q * slope_w * other_w - c[:, 11:13, None] * tw / wide * H
    by_d = by_s + by_w
    along = cos[:, :, None] * dx[:, None] + sin[:, :, None] * dy[:, None]
    A[:, -5] = (sin[:, :, None] * by_d).sum(axis=1)
    A[:, -4] = -(cos[:, :, None] * by_d).sum(axis=1)
    A[:, -3:-1] = -by_d * along
    A[:, -1] = -(d * by_s).sum(axis=1) - ((s / wide) ** 2 * d * by_w).sum(axis=1)
    return A


def _blurred_step(t: _Levels, bell: _Levels) -> _Levels:
    """Return erf(t / sqrt 2) from t and the bell exp(-t^2 / 2)."""
    near = 1.0 / (1.0 + _STEP_SCALE * np.abs(t))
    rest = near * _STEP[0]
    for coefficient in _STEP[1:]:
        rest += coefficient
        rest *= near
    return np.copysign(1.0 - rest * bell, t)


def _judged(
    window: _Window, weight: _Levels, x: Array, c: Array, start: Array, turns: Array
) -> Saddles:
    """Return the crossings with what their residuals are worth."""
    n, k = len(x), _N_LINEAR + _N_PLACED
    count, levels = weight.sum(axis=1, dtype=np.float64), window.levels * weight
    c, contrast = c.copy(), np.zeros(n)
    residual, pull = np.zeros_like(levels), np.zeros((n, 2, levels.shape[1]))
    for first in range(0, n, _AT_ONCE):
        at = slice(first, first + _AT_ONCE)
        A = _functions(window.u[at], window.v[at], x[at], c[at])
        A *= weight[at, None]
        A = A.astype(np.float64)  # products of single precision would be no better than the ridge
        N = A @ np.swapaxes(A, 1, 2)
        L = A[:, :_N_LINEAR]
        rhs = (L @ levels[at, :, None])[:, :, 0]
        c[at] = _solve(N[:, :_N_LINEAR, :_N_LINEAR], rhs, count[at], np.zeros_like(c[at]))
        residual[at] = levels[at] - (c[at, None] @ L)[:, 0]
        P = L[:, 3]
        contrast[at] = np.sum(P * (levels[at] - c[at, :1] * L[:, 0]), axis=1)
        contrast[at] /= np.maximum(np.sum(P * P, axis=1), 1e-9)
        pull[at] = _pull(A, N)
    rms = np.sqrt(np.sum(residual**2, axis=1) / np.maximum(count - k, 1.0))
    size = np.maximum(np.abs(contrast), 1e-9)
    turn = np.abs(np.angle(np.exp(1j * (x[:, 2:4] - turns)))).max(axis=1)
    s = np.exp(x[:, 4])
    narrow = c[:, 3] + 0.5 * (c[:, 6] + c[:, 7])
    slope = narrow / s + (0.5 * (c[:, 6] + c[:, 7]) + c[:, 8]) / np.hypot(s, _MASK_RADIUS)
    slope /= np.where(contrast == 0.0, 1.0, contrast)
    are_found = count >= _MIN_PIXELS
    are_found &= np.linalg.norm(x[:, :2], axis=1) < MAX_SHIFT_PX
    are_found &= (turn < _MAX_TURN) & (size * window.scale > MIN_CONTRAST)
    are_found &= (rms < _MAX_MISFIT * size) & (slope > 1.0 / _BLURS[1])
    variance = np.zeros(n)
    if are_found.any():
        used = weight[are_found] > 0.0
        variance[are_found] = _variance(
            pull[are_found], used, residual[are_found], rms[are_found], window.side
        )
    are_found &= variance < MAX_SHIFT_PX**2
    return Saddles(
        start + x[:, :2],
        np.hypot(np.sqrt(variance), _MIN_SIGMA_PX),
        1.0 / np.maximum(slope, 1e-3),
        contrast * window.scale,
        rms / size,
        are_found,
    )


def _pull(A: _Levels, N: Array) -> Array:
    """Return derivatives of the position by grey levels, (n, 2, m), from the model's (n, k, m)."""
    n, k, _ = A.shape
    size = np.maximum(np.trace(N, axis1=1, axis2=2) / k, 1e-9)
    N = N.copy()
    N[:, np.arange(k), np.arange(k)] += 1e-9 * size[:, None]
    columns = np.zeros((n, k, 2))
    columns[:, [_N_LINEAR, _N_LINEAR + 1], [0, 1]] = 1.0
    return np.asarray(np.swapaxes(np.linalg.solve(N, columns), 1, 2) @ A)


def _variance(pull: Array, used: BoolArray, residual: Array, rms: Array, side: int) -> Array:
    """Return the variance of either coordinate (n,) [px^2], residuals being correlated.

    Neighbouring residuals are alike where colours are filled in, a JPEG is coarse or the model is
    not all; the correlation is that of all crossings of the image.
    """
    n, wide = len(pull), side + _LAGS
    padded = np.zeros((3, n, wide, wide), dtype=np.float32)  # lags do not reach the next crossing
    padded[:2, :, :side, :side] = np.moveaxis(pull, 1, 0).reshape(2, n, side, side)
    padded[2, :, :side, :side] = (residual / np.maximum(rms, 1e-12)[:, None]).reshape(n, side, side)
    inside = np.zeros((n, wide, wide), dtype=np.float32)
    inside[:, :side, :side] = used.reshape(n, side, side)
    r, there = padded[2].ravel(), inside.ravel()
    alike = np.zeros((2 * _LAGS + 1, 2 * _LAGS + 1))
    for i in range(_LAGS + 1):
        for j in range(-_LAGS if i else 0, _LAGS + 1):
            lag = i * wide + j
            pairs = float(there[lag:] @ there[: len(there) - lag])
            of_lag = float(r[lag:] @ r[: len(r) - lag]) / max(pairs, 1.0) if lag else 1.0
            alike[_LAGS + i, _LAGS + j] = alike[_LAGS - i, _LAGS - j] = of_lag
    g = padded[:2].reshape(-1, wide)
    near = cv2.filter2D(g, cv2.CV_32F, alike, borderType=cv2.BORDER_CONSTANT)
    total = np.sum((g * near).reshape(2, n, -1), axis=(0, 2), dtype=np.float64)
    alone = np.sum(pull**2, axis=(1, 2))
    return np.asarray(0.5 * np.maximum(total, alone) * rms**2)
