"""Lattices of crossings in images: a chessboard of any extent, whole or in part.

Candidates are saddles of grey levels around which bright and dark sectors follow each other; those
that an edge joins, bright on one side all along, are neighbours; what hangs together is a lattice.
:func:`measured` fits its corners, and those beside them where the others let one expect them:
corners of which the search knew nothing, because of a tag that is not decoded or a hand between.

:func:`fit_saddles` fits a model of the light to the pixels around each crossing. Around a corner of
a board the light is a product of two steps. Lens and pixels blur it, cameras sharpen it afterwards:
they add a part of its difference from a blurred copy of it, so that it overshoots beside the edges.
Both are linear, and so grey levels are

    f = c0 + c1 x + c2 y + (k0 + k1 x + k2 y) P(s) + k3 P(s') + b (G0 + G1),    s'^2 = s^2 + r^2,

P(s) the product of both steps under a blur s, P(s') the one of the copy, G0 + G1 what a tone curve
makes of the edges (a square of P), and linear terms what light and shade do. Each of these is even
about the crossing, so that none of them moves it. All crossings of an image are fitted at once.
"""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial import KDTree

from legcal.geometry.tables import Table
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
class Saddles(Table):
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


_BLUR = 1.2  # [px] before derivatives are taken
_MAX_CANDIDATES = 1500
_RING, _RINGS = 16, (3.5, 5.0)  # samples of half a circle around a candidate; its radii [px]
_MAX_ODD = 0.5  # of what changes around a candidate, that is not alike on opposite sides
_N_NEAR = 12  # nearest candidates among which neighbours are sought
_MAX_ASIDE = 0.4  # [rad] between an edge at a candidate and the way to its neighbour
_ALONG = (0.25, 0.4, 0.5, 0.6, 0.75)  # of the way to a neighbour, where the edge is looked at
_BESIDE = 0.12  # of that way, to either side of it
_MIN_STEP = 0.3  # of the contrast at both ends that an edge must have all along
_MIN_LATTICE = 6  # corners
_STEPS = np.array([[1, 0], [0, 1], [-1, 0], [0, -1]], dtype=np.intp)


def find_lattice(grey: Grey) -> tuple[IntArray, Array]:
    """Return the largest lattice of crossings in an image (height, width), maybe of none.

    Columns and rows (k, 2), the first ones being 0, and places (k, 2) [px]; x, y and the line of
    sight are right-handed.
    """
    places, angles, contrast = _candidates(grey)
    near, ray = _neighbours(grey, places, angles, contrast)
    return _largest(places, near, ray)


def _candidates(grey: Grey) -> tuple[Array, Array, Array]:
    """Return places of saddles (n, 2) [px], the angles of their edges (n, 2) [rad], contrasts (n,).

    Angles are within half a turn, the smaller one first; contrasts are half of the step, positive
    if it is bright between the first angle and the second one.
    """
    soft = np.asarray(cv2.GaussianBlur(grey, (0, 0), _BLUR), dtype=np.float32)
    xx, yy = cv2.Sobel(soft, cv2.CV_32F, 2, 0, ksize=3), cv2.Sobel(soft, cv2.CV_32F, 0, 2, ksize=3)
    xy = cv2.Sobel(soft, cv2.CV_32F, 1, 1, ksize=3)
    strength = xy * xy - (xx * yy) * np.float32(1.0 / 4.0)
    peak = cv2.dilate(strength, np.ones((5, 5), np.uint8))
    least = (0.3 * MIN_CONTRAST) ** 2
    row, column = np.nonzero((strength >= peak) & (strength > least))
    margin = int(_RINGS[0]) + 1
    height, width = grey.shape
    inner = (
        (row >= margin) & (row < height - margin) & (column >= margin) & (column < width - margin)
    )
    row, column = row[inner], column[inner]
    if len(row) > _MAX_CANDIDATES:
        best = np.argpartition(-strength[row, column], _MAX_CANDIDATES)[:_MAX_CANDIDATES]
        row, column = row[best], column[best]
    px = np.column_stack([column, row]).astype(np.float64) + _summit(strength, row, column)
    phi = np.pi * np.arange(2 * _RING) / _RING
    kept = np.zeros(len(px), dtype=np.bool_)
    angles, contrast = np.zeros((len(px), 2)), np.zeros(len(px))
    for radius in _RINGS:
        ring = px[:, None] + radius * np.stack([np.cos(phi), np.sin(phi)], axis=-1)
        level = _sampled(soft, ring)
        even = 0.5 * (level[:, :_RING] + level[:, _RING:])
        odd = 0.5 * (level[:, :_RING] - level[:, _RING:])
        low, high = even.min(axis=1), even.max(axis=1)
        even = even - 0.5 * (low + high)[:, None]
        following = np.roll(even, -1, axis=1)
        change = (even >= 0.0) != (following >= 0.0)
        good = (change.sum(axis=1) == 2) & (high - low > MIN_CONTRAST)
        good &= np.sum(odd**2, axis=1) < _MAX_ODD**2 * np.sum(even**2, axis=1)
        good &= ~kept
        at = np.argwhere(change & good[:, None])[:, 1].reshape(-1, 2)
        rows = np.flatnonzero(good)[:, None]
        a, b = even[rows, at], following[rows, at]
        angles[good] = (at + a / (a - b)) * np.pi / _RING
        contrast[good] = 0.5 * (high - low)[good] * np.where(b[:, 0] >= 0.0, 1.0, -1.0)
        kept |= good
    return px[kept], angles[kept], contrast[kept]


def _summit(strength: Grey, row: IntArray, column: IntArray) -> Array:
    """Return the subpixel offsets of peaks, (n, 2), by parabolas."""
    height, width = strength.shape
    offsets = []
    for dr, dc, size, at in ((0, 1, width, column), (1, 0, height, row)):
        inner = (at > 0) & (at < size - 1)
        r, c = np.where(inner, row, 1), np.where(inner, column, 1)
        before, here, after = (strength[r + k * dr, c + k * dc] for k in (-1, 0, 1))
        bend = before - 2.0 * here + after
        offsets.append(
            np.where(inner & (bend < 0.0), 0.5 * (before - after) / np.minimum(bend, -1e-9), 0.0)
        )
    return np.asarray(np.clip(np.column_stack(offsets), -0.5, 0.5))


def _sampled(image: Grey, px: Array) -> Array:
    """Return levels between pixels, px (..., 2)."""
    if not px.size:
        return np.zeros(px.shape[:-1])
    flat = px.reshape(1, -1, 2).astype(np.float32)
    pieces = [
        cv2.remap(
            image, part[..., 0], part[..., 1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE
        )
        for part in np.array_split(flat, flat.shape[1] // 30_000 + 1, axis=1)
    ]
    return np.concatenate(pieces, axis=1).reshape(px.shape[:-1]).astype(np.float64)


def _neighbours(grey: Grey, px: Array, angles: Array, contrast: Array) -> tuple[IntArray, IntArray]:
    """Return the neighbour of each candidate along its four rays (n, 4), -1 for none.

    The second array has the ray by which the neighbour sees it. Rays are in the order of angles:
    both edges, and both of them turned by half a turn.
    """
    n = len(px)
    near, back = np.full((n, 4), -1, dtype=np.intp), np.full((n, 4), -1, dtype=np.intp)
    if n < 2:
        return near, back
    count = min(_N_NEAR + 1, n)
    distance, other = (np.asarray(part)[:, 1:] for part in KDTree(px).query(px, k=count))
    rays = np.concatenate([angles, angles + np.pi], axis=1)
    way = px[other] - px[:, None]
    heading = np.arctan2(way[..., 1], way[..., 0])
    # by which ray each leaves, and arrives (seen from there)
    leave = np.abs(_wrapped(heading[:, :, None] - rays[:, None]))
    arrive = np.abs(_wrapped(heading[:, :, None] + np.pi - rays[other]))
    out, into = leave.argmin(axis=2), arrive.argmin(axis=2)
    good = np.maximum(leave.min(axis=2), arrive.min(axis=2)) < _MAX_ASIDE
    # Bright to the left of the way: after an even ray if the contrast is positive.
    left = np.where(out % 2 == 0, 1.0, -1.0) * contrast[:, None]
    left_there = np.where(into % 2 == 0, 1.0, -1.0) * contrast[other]
    good &= left * left_there < 0.0
    here, k = np.nonzero(good)
    if not len(here):
        return near, back
    there = other[here, k]
    step = way[here, k]
    aside = _BESIDE * np.column_stack([-step[:, 1], step[:, 0]])
    on = px[here][:, None] + np.array(_ALONG)[:, None] * step[:, None]
    difference = _sampled(grey, on + aside[:, None]) - _sampled(grey, on - aside[:, None])
    difference *= np.sign(left[here, k])[:, None]
    least = 2.0 * _MIN_STEP * np.minimum(np.abs(contrast[here]), np.abs(contrast[there]))
    holds = np.sum(difference > least[:, None], axis=1) >= len(_ALONG) - 1
    here, k, there = here[holds], k[holds], there[holds]
    order = np.argsort(-distance[here, k], kind="stable")  # the nearest is written last
    here, k, there = here[order], k[order], there[order]
    near[here, out[here, k]] = there
    back[here, out[here, k]] = into[here, k]
    rows, ray = np.nonzero(near >= 0)
    mutual = near[near[rows, ray], back[rows, ray]] == rows
    near[rows[~mutual], ray[~mutual]] = -1
    return near, back


def _wrapped(angle: Array) -> Array:
    """Return angles within half a turn to either side."""
    return np.asarray((angle + np.pi) % (2.0 * np.pi) - np.pi)


def _largest(px: Array, near: IntArray, back: IntArray) -> tuple[IntArray, Array]:
    """Return the largest set of candidates that are neighbours of each other, as a lattice."""
    n = len(px)
    turn = np.full(n, -1, dtype=np.intp)  # quarter turns of the lattice against each one's rays
    best: list[tuple[int, tuple[int, int]]] = []
    links, arrivals = near.tolist(), back.tolist()
    steps = [tuple(step) for step in _STEPS.tolist()]
    for first in range(n):
        if turn[first] >= 0 or max(links[first]) < 0:
            continue
        turn[first] = 0
        place = {first: (0, 0)}
        taken = {(0, 0): first}
        queue = deque([first])
        while queue:
            here = queue.popleft()
            i, j = place[here]
            for ray, there in enumerate(links[here]):
                if there < 0:
                    continue
                way = (ray + int(turn[here])) % 4
                at = (i + steps[way][0], j + steps[way][1])
                if turn[there] >= 0 or at in taken:
                    continue
                turn[there] = (way + 2 - arrivals[here][ray]) % 4
                place[there] = at
                taken[at] = there
                queue.append(there)
        if len(place) > len(best):
            best = list(place.items())
    if len(best) < _MIN_LATTICE:
        return np.zeros((0, 2), dtype=np.intp), np.zeros((0, 2))
    members = np.array([k for k, _ in best], dtype=np.intp)
    ij = np.array([at for _, at in best], dtype=np.intp)
    # Rays turn from x to y of the image, and so do the steps of the lattice: it is right-handed.
    return ij - ij.min(axis=0), px[members]


_NEAR = 1.5  # pitches within which corners give how the board lies around a place
_STIFF = 1e-3  # ridge on squares of distances, as a part of the weights
_MAX_BLUR_RATIO, _MAX_MISFIT_RATIO = 2.0, 2.5  # over the median of the image
_GOOD_FIT = 0.05  # of the contrast left over: always accepted
_MIN_CONTRAST_RATIO = 0.3  # over the median
# From where its neighbours put a corner that is another thing: at least; times what is usual; parts
# of a pitch, with neighbours all around it and at the rim, where lenses bend what goes on.
_OFF_PX, _OFF_MEDIANS, _OFF_BETWEEN, _OFF_BESIDE = 0.5, 9.0, 0.03, 0.25
_MIN_QUADRANTS = 0.3  # of the usual step: by how much bright quadrants are brighter than dark ones
_MAX_ROUNDS = 40  # of corners beside those that are known


@dataclass(frozen=True, eq=False)
class Print:
    """Lattice of corners of a board, by columns and rows."""

    x: Array | None  # coordinates of columns; None where they are whole numbers, and go on
    y: Array | None  # coordinates of rows, the same
    length: float  # how far edges through a corner are straight
    band: float  # how far beside them nothing else is printed
    pitch: float  # the longest step from a corner to the next

    def xy(self, ij: IntArray) -> Array:
        """Return the places of corners on the board (k, 2)."""
        if self.x is None or self.y is None:
            return ij.astype(np.float64)
        return np.column_stack([self.x[ij[:, 0]], self.y[ij[:, 1]]])

    def has(self, ij: IntArray) -> BoolArray:
        """Return the mask of existing columns and rows (k, 2)."""
        if self.x is None or self.y is None:
            return np.ones(len(ij), dtype=np.bool_)
        return np.asarray(np.all((ij >= 0) & (ij < [len(self.x), len(self.y)]), axis=1))


def expected(
    xy: Array, px: Array, at: Array, pitch: float, *, without_own: bool = False
) -> tuple[Array, Array]:
    """Predict the image positions of columns and rows *at* (k, 2) by their neighbours.

    Returns px (k, 2) and the steps in the image along x and y, (k, 2, 2) [px / unit].
    ``without_own`` leaves out for each place the row of the same number.
    """
    away = (xy - at[:, None]) / pitch
    square = np.sum(away**2, axis=2)
    if without_own:
        square[np.arange(len(at)), np.arange(len(at))] = np.inf
    others = min(8, len(xy) - without_own)
    nearest = np.partition(square, others - 1, axis=1)[:, :others].mean(axis=1, keepdims=True)
    reach = np.maximum(nearest, 0.5 * _NEAR**2)
    weight = np.exp(-0.5 * square / reach) + np.where(np.isfinite(square), 1e-6, 0.0)
    x, y = away[..., 0], away[..., 1]
    A = np.stack([np.ones_like(x), x, y, x * x, x * y, y * y], axis=1)
    W = A * weight[:, None]
    N = W @ np.swapaxes(A, 1, 2)
    size = weight.sum(axis=1)
    ridge = np.array([1e-9, 1e-6, 1e-6, _STIFF, _STIFF, _STIFF])
    N[:, np.arange(6), np.arange(6)] += ridge * size[:, None]
    centre = (weight @ px) / size[:, None]
    slopes = np.linalg.solve(N, W @ (px - centre[:, None]))
    return centre + slopes[:, 0], np.swapaxes(slopes[:, 1:3], 1, 2) / pitch


def measured(
    grey: Grey, board: Print, ij: IntArray, px: Array, blur: float = 0.0, *, grow: bool = True
) -> tuple[IntArray, Saddles]:
    """Fit corners near some pixels, and those beside them.

    Columns and rows ij (k, 2), px (k, 2), the blur of such corners [px] or 0. Returns columns and
    rows, and where they are: of those that look like most of them and are where the others put
    them.
    """
    none = np.zeros((0, 2), dtype=np.intp)
    if len(ij) < _MIN_KNOWN:
        return none, fit_saddles(grey, np.zeros((0, 2)), np.zeros((0, 2, 2)), 1.0, 1.0)
    _, axes = expected(board.xy(ij), px, board.xy(ij), board.pitch)
    px = near_saddles(grey, px, axes, board.band)
    found = fit_saddles(grey, px, axes, board.length, board.band, blur)
    ij, found = _alike(board, ij, found)
    tried: set[tuple[int, int]] = set()
    while grow and len(ij) >= _MIN_KNOWN:
        beside, start = _grown(grey, board, ij, found, tried)
        if not len(beside):
            break
        known, places = np.concatenate([ij, beside]), np.concatenate([found.px, start])
        _, axes = expected(board.xy(known), places, board.xy(beside), board.pitch)
        more = fit_saddles(grey, start, axes, board.length, board.band, blur)
        n = len(ij)
        ij, found = _alike(board, known, Saddles.joined([found, more]))
        tried = (tried | set(map(tuple, beside.tolist()))) - set(map(tuple, ij.tolist()))
        if len(ij) <= n:
            break
    return ij, found


def _grown(
    grey: Grey, board: Print, ij: IntArray, found: Saddles, tried: set[tuple[int, int]]
) -> tuple[IntArray, Array]:
    """Return columns and rows (k, 2) that continue the known ones, px (k, 2).

    One line after the other is expected from those before it, and looked at.
    """
    known, places = ij, found.px
    sign, usual = _sign(ij, found), float(np.median(np.abs(found.contrast)))
    refused = set(tried)
    for _ in range(_MAX_ROUNDS):
        beside = _beside(board, known, refused)
        if not len(beside):
            break
        start, axes = expected(board.xy(known), places, board.xy(beside), board.pitch)
        start = near_saddles(grey, start, axes, board.band, MAX_SHIFT_PX)
        step = _quadrants(grey, board, start, axes) * sign * _parity(beside)
        seems = step > _MIN_QUADRANTS * usual
        refused |= set(map(tuple, beside[~seems].tolist()))
        known = np.concatenate([known, beside[seems]])
        places = np.concatenate([places, start[seems]])
    return known[len(ij) :], places[len(ij) :]


_MIN_KNOWN = 4  # corners from which others are expected


def _beside(board: Print, ij: IntArray, tried: set[tuple[int, int]]) -> IntArray:
    """Return columns and rows next to the known ones."""
    around = (ij[:, None] + _STEPS).reshape(-1, 2)
    known = set(map(tuple, ij.tolist())) | tried
    fresh = sorted({at for at in map(tuple, around[board.has(around)].tolist()) if at not in known})
    return np.array(fresh, dtype=np.intp).reshape(-1, 2)


def _parity(ij: IntArray) -> Array:
    """Return 1 for corners with the contrast of the first one, -1 for the others."""
    return np.where(ij.sum(axis=1) % 2 == 0, 1.0, -1.0)


def _sign(ij: IntArray, found: Saddles) -> float:
    """Return the sign of the contrast of the first corner, by majority."""
    return 1.0 if np.median(np.sign(found.contrast) * _parity(ij)) >= 0.0 else -1.0


def _quadrants(grey: Grey, board: Print, px: Array, axes: Array) -> Array:
    """Return by how much two opposite quadrants are brighter than both others, (k,).

    Positive where they are those beside the axes, as contrasts are; zero where the four are not in
    turn.
    """
    d = 0.5 * min(board.length, board.band)
    corners = d * np.array([[1.0, 1.0], [-1.0, -1.0], [1.0, -1.0], [-1.0, 1.0]])
    level = _sampled(grey, px[:, None] + np.einsum("kab,cb->kca", axes, corners))
    between, beside = level[:, :2], level[:, 2:]
    up = beside.min(axis=1) - between.max(axis=1)
    down = between.min(axis=1) - beside.max(axis=1)
    return 0.5 * np.where(up > 0.0, up, np.where(down > 0.0, -down, 0.0))


def _alike(board: Print, ij: IntArray, found: Saddles) -> tuple[IntArray, Saddles]:
    """Return the corners that look like most of them, and are where their neighbours put them."""
    ij, found = ij[found.found], found.choose(found.found)
    if len(ij) < _MIN_KNOWN:
        return ij[:0], found.choose(np.zeros(0, dtype=np.intp))
    usual = np.median(found.misfit), np.median(found.blur_px), np.median(np.abs(found.contrast))
    kept = found.misfit < max(_MAX_MISFIT_RATIO * usual[0], _GOOD_FIT)
    kept &= np.abs(np.log(found.blur_px / usual[1])) < np.log(_MAX_BLUR_RATIO)
    signed = found.contrast * _parity(ij) * _sign(ij, found)
    kept &= signed > _MIN_CONTRAST_RATIO * usual[2]
    ij, found = ij[kept], found.choose(kept)
    for _ in range(3):
        if len(ij) < 2 * _MIN_KNOWN:
            break
        xy = board.xy(ij)
        there, axes = expected(xy, found.px, xy, board.pitch, without_own=True)
        off = np.linalg.norm(found.px - there, axis=1)
        step = np.linalg.norm(axes, axis=1).mean(axis=1) * board.pitch
        known = set(map(tuple, ij.tolist()))
        around = (ij[:, None] + _STEPS).reshape(-1, 2).tolist()
        between = np.array([tuple(at) in known for at in around]).reshape(-1, 4).all(axis=1)
        scatter = float(np.median(off[between])) if between.any() else 0.0
        near = np.maximum(_OFF_PX, np.maximum(_OFF_MEDIANS * scatter, _OFF_BETWEEN * step))
        far = np.maximum(2.0 * _OFF_PX, _OFF_BESIDE * step)
        wrong = off > np.where(between, near, far)
        if not wrong.any():
            break
        wrong &= off >= 0.5 * off[wrong].max()  # a wrong corner puts its neighbours off
        ij, found = ij[~wrong], found.choose(~wrong)
    return ij, found
