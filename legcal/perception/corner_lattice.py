"""Lattices of crossings in images: a chessboard of any extent, whole or in part.

Candidates are saddles of grey levels around which bright and dark sectors follow each other; those
that an edge joins, bright on one side all along, are neighbours; what hangs together is a lattice.
:func:`measured` fits its corners, and those beside them where the others let one expect them:
corners of which the search knew nothing, because of a tag that is not decoded or a hand between.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass, replace

import cv2
import numpy as np
from scipy.spatial import KDTree

from legcal.geometry.types import Array, BoolArray, IntArray
from legcal.perception.saddles import MAX_SHIFT_PX, MIN_CONTRAST, Saddles, fit_saddles, near_saddles
from legcal.vision.image_file import Grey

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


@dataclass(frozen=True, eq=False)
class Lattice:
    """Crossings that hang together."""

    ij: IntArray  # (k, 2) their columns and rows; the first ones are 0
    px: Array  # (k, 2) where they are [px]; x, y and the line of sight are right-handed
    black: IntArray  # (k,) 1 where the square at greater column and row is black, else -1

    @property
    def extent(self) -> tuple[int, int]:
        """Columns and rows between the outermost corners."""
        x, y = (np.ptp(self.ij, axis=0) + 1).tolist() if len(self.ij) else (0, 0)
        return x, y


def find_lattice(grey: Grey) -> Lattice:
    """Return the largest lattice of crossings in an image (height, width), maybe of none."""
    places, angles, contrast = _candidates(grey)
    near, ray = _neighbours(grey, places, angles, contrast)
    return _largest(places, angles, contrast, near, ray)


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


def _largest(px: Array, angles: Array, contrast: Array, near: IntArray, back: IntArray) -> Lattice:
    """Return the largest set of candidates that are neighbours of each other, as a lattice."""
    n = len(px)
    none = Lattice(np.zeros((0, 2), np.intp), np.zeros((0, 2)), np.zeros(0, np.intp))
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
        return none
    members = np.array([k for k, _ in best], dtype=np.intp)
    ij = np.array([at for _, at in best], dtype=np.intp)
    # Rays turn from x to y of the image, and so do the steps of the lattice: it is right-handed.
    # Bright after ray 0; the square at greater column and row follows the ray of step (1, 0).
    follows = (-turn[members]) % 2 == 0
    bright = np.where(follows, contrast[members], -contrast[members]) > 0.0
    return Lattice(ij - ij.min(axis=0), px[members], np.where(bright, -1, 1).astype(np.intp))


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
        both = replace(
            found,
            **{
                name: np.concatenate([value, getattr(more, name)])
                for name, value in vars(found).items()
            },
        )
        ij, found = _alike(board, known, both)
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
