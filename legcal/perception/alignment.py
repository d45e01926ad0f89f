"""How the camera of a view moved between its images, by the static background.

The camera of a view stands, but a tripod gives way when the shutter is pressed, optical
stabilisation shifts the lens, and autofocus changes its focal length: all that stands still then
moves in the image, by pixels. Squares of each image, evenly apart, are compared with their median
over all images of the view. In most of them nothing moves, and their shifts, weighted by what each
shows and robust against legs, platform and shadows, give a shift, a turn, a zoom and a slant of the
image (Lucas and Kanade, 1981, of each square). Where these are significant, images are read as if
the camera had stood still (:class:`legcal.data.dataset.ImageReader`).
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from functools import partial

import cv2
import numpy as np

from legcal.data.measurements import Measurements
from legcal.geometry.types import Array, IntArray
from legcal.perception.placement import Load
from legcal.perception.profiles import Samples
from legcal.progress import Report
from legcal.vision.image_file import Move, shrink
from legcal.workers import Run

LONG_SIDE = 1200  # about which images are reduced [px]
SIDE, MARGIN = 24, 4  # of a square, and how far around it is looked [px]
ACROSS = 16  # squares beside each other along the longer side
MIN_IMAGES = 5  # of a view
MOST_IMAGES = 60  # of a view by which its background is known, and at a time
MIN_SQUARES, MIN_SHARE = 12, 0.35  # squares that show something, and the share of these that agree
SHARP = 0.1  # standard deviation of the shift of a square that shows something, at most [px]
STRIDE = 4  # squares, and their rows, that are enough for medians
MOST_GAIN = 2.0  # of the exposure of an image
LEAST_NOISE = 0.3  # of pixels [grey levels]
ROUNDS = 10
READ = 1.0 / 32.0  # steps in which OpenCV reads between pixels [px]
SMOOTHING, NEAR = 2.5, 0.5  # of squares while steps are larger: far shifts are found [px]
SETTLED = 0.01  # change of shifts at which no further round is needed [px]
CUT = 4.0  # standard deviations beyond which a square does not count
WEIGHED_ROUNDS = 10
FAR = 1e3  # standard deviation of moves before any image is seen: squares may not tell all [px]
LEAST_MOVE, MAX_SIGMA = 0.1, 0.05  # of an image, to be corrected [px]
SIGMAS = 10.0
# Squares that two images share: their deviation [grey levels], and their correlation in both; the
# share of squares below which the camera is somewhere else. At most 0.03 with a camera in the hand,
# at least 0.16 on tripods; and the share that shows anything, below which most are of the machine
SHOWS, ALIKE, LEAST_ALIKE, LEAST_SHOWN = 3.0, 0.8, 0.1, 0.33


def camera_moves(
    load: Load, measurements: Measurements, rows: Sequence[int], run: Run, report: Report
) -> dict[int, Move]:
    """Return how the images of views were moved where the camera did not stand still, by row.

    Parameters
    ----------
    load : callable
        Returns the image of a row.
    measurements : Measurements
        The rows with their views.
    rows : sequence of int
        The rows to compare.
    run, report : callable
        How images are read, and the progress.
    """
    of_view: dict[int, list[int]] = {}
    for row in rows:
        of_view.setdefault(int(measurements.view[row]), []).append(row)
    groups = [group for group in of_view.values() if len(group) >= MIN_IMAGES]
    samples = [
        [group[k * len(group) // n] for k in range(n)]
        for group in groups
        for n in [min(len(group), MOST_IMAGES)]
    ]
    n_read, n_total = itertools.count(1), sum(map(len, samples))

    def read(some: Sequence[int]) -> Samples:
        found = []
        for own in run(partial(_squares, load), some):
            found.append(own)
            report("Comparing backgrounds", min(next(n_read), n_total), n_total)
        return np.stack(found)

    moves = dict[int, Move]()
    for group, sample in zip(groups, samples, strict=True):
        camera = measurements.views[measurements.view[group[0]]].camera
        size = camera.width, camera.height
        found, still = _moves_of_view(read(sample), size)
        moves |= _known(sample, found)
        rest = [row for row in group if row not in set(sample)] if still is not None else []
        for first in range(0, len(rest), MOST_IMAGES):
            some = rest[first : first + MOST_IMAGES]
            moves |= _known(some, _moves_of_view(read(some), size, still)[0])
    return moves


def is_moved(load: Load, rows: Sequence[int]) -> bool:
    """Return whether images one after the other share no background, as of a camera in the hand.

    Where most of them show too little of a background, nobody knows.
    """
    if len(rows) < MIN_IMAGES:
        return False
    inner = slice(MARGIN, -MARGIN)
    squares = [_squares(load, row)[:, inner, inner] for row in rows[:MOST_IMAGES]]
    if len({len(own) for own in squares}) > 1:
        return False
    flat = np.stack(squares).reshape(len(squares), -1, SIDE**2)
    flat = flat - flat.mean(axis=2, keepdims=True)
    spread = flat.std(axis=2)
    shown = np.minimum(spread[1:], spread[:-1]) > SHOWS
    alike = np.mean(flat[1:] * flat[:-1], axis=2) > ALIKE * spread[1:] * spread[:-1]
    n = np.count_nonzero(shown, axis=1)
    told = n >= max(MIN_SQUARES, LEAST_SHOWN * shown.shape[1])
    share = np.count_nonzero(shown & alike, axis=1)[told] / n[told]
    return bool(2 * len(share) > len(n) and np.median(share) < LEAST_ALIKE)


def _known(rows: Sequence[int], found: Sequence[Move | None]) -> dict[int, Move]:
    return {row: move for row, move in zip(rows, found, strict=True) if move is not None}


def _factor(size: tuple[int, int]) -> int:
    return max(1, round(max(size) / LONG_SIDE))


def _places(size: tuple[int, int]) -> tuple[IntArray, Array]:
    """Return first pixels (n, 2) of squares of a reduced image, and their middles from its own."""
    reduced = np.array(size) // _factor(size)
    n = [max(4, round(ACROSS * side / max(size))) for side in size]
    first = [
        np.linspace(0, side - SIDE - 2 * MARGIN, k).astype(np.intp)
        for side, k in zip(reduced.tolist(), n, strict=True)
    ]
    at = np.stack(np.meshgrid(*first), axis=-1).reshape(-1, 2)
    return at, at + 0.5 * (SIDE + 2 * MARGIN) - 0.5 * reduced


def _squares(load: Load, row: int) -> Samples:
    """Return the squares (n, side, side) of an image."""
    grey, side = load(row), SIDE + 2 * MARGIN
    size = grey.shape[1], grey.shape[0]
    small = shrink(grey, _factor(size))
    if min(small.shape) <= side:
        return np.zeros((0, side, side), dtype=np.float32)
    return np.stack([small[y : y + side, x : x + side] for x, y in _places(size)[0].tolist()])


def _moves_of_view(
    squares: Samples, size: tuple[int, int], still: Samples | None = None
) -> tuple[list[Move | None], Samples | None]:
    """Return the move of each image by its squares (n_images, n, side, side), and their background.

    The *still* background is that of other images of the view, or else the median. None for an
    image that shows too little of it, and for all, and no background, if the camera stood still.
    """
    stood: tuple[list[Move | None], None] = [None] * len(squares), None
    if not squares.shape[1]:
        return stood
    middle, factor = _places(size)[1], _factor(size)
    by_motion = _shifts_by_motion(middle)
    everywhere = np.einsum("kdp,kdq->pq", by_motion, by_motion) / len(by_motion)
    model = by_motion, everywhere
    squares = _as_exposed(squares, still)
    motion, now, smooth = np.zeros((len(squares), by_motion.shape[2])), squares, True
    at = np.zeros((*squares.shape[:2], 2))  # the shifts at which squares are read
    for _ in range(ROUNDS):
        before = motion
        behind = _background(now, sharp=not motion.any()) if still is None else still
        if smooth:
            motion, sigma = _motions(_smooth(now), _smooth(behind[None])[0], at, *model)
        else:
            motion, sigma = _motions(now, behind, at, *model)
        seen, sigma = np.isfinite(sigma), factor * sigma
        if still is None:
            if np.count_nonzero(seen) < MIN_IMAGES:
                return stood
            motion[seen] -= np.median(motion[seen], axis=0)
            away = factor * _rms_shift(motion, everywhere)
            if not np.any(away[seen] > np.maximum(LEAST_MOVE, SIGMAS * sigma[seen])):
                return stood
        step = float(_rms_shift(motion - before, everywhere)[seen].max(initial=0.0))
        if step < SETTLED and not smooth:
            break
        smooth &= step > NEAR
        at = np.round(np.einsum("kdp,np->nkd", by_motion, motion) / READ) * READ
        now = np.stack([_moved(*one) for one in zip(squares, at, strict=True)])
    known = sigma < MAX_SIGMA
    if still is None and np.count_nonzero(known) < MIN_IMAGES:
        return stood
    motion *= np.array([factor, factor, 1.0, 1.0, 1.0 / factor, 1.0 / factor])
    moves = zip(known.tolist(), motion.tolist(), strict=True)
    return [Move(*own) if is_known else None for is_known, own in moves], np.median(now, axis=0)


def _as_exposed(squares: Samples, still: Samples | None) -> Samples:
    """Return the squares of images as if all had the exposure of the background."""
    level = squares.mean(axis=(2, 3))
    usual = np.median(level, axis=0) if still is None else still.mean(axis=(1, 2))
    gain = np.median(level / np.maximum(usual, 1.0), axis=1)
    gain = np.clip(gain, 1.0 / MOST_GAIN, MOST_GAIN)
    return np.asarray(squares / gain[:, None, None, None], dtype=np.float32)


def _background(squares: Samples, *, sharp: bool) -> Samples:
    """Return the median of images, or, where they may be far apart, the one nearest to it."""
    if not sharp:
        return np.asarray(np.median(squares, axis=0))
    some = squares[:, ::STRIDE]
    off = np.abs(some - np.median(some, axis=0)).mean(axis=(1, 2, 3))
    return np.asarray(squares[int(np.argmin(off))])


def _smooth(squares: Samples) -> Samples:
    """Return blurred squares."""
    blurred = [cv2.GaussianBlur(np.moveaxis(own, 0, 2), (0, 0), SMOOTHING) for own in squares]
    return np.moveaxis(np.stack(blurred), 3, 1).astype(np.float32)


def _rms_shift(motion: Array, everywhere: Array) -> Array:
    """Return how far motions (n, 6) move an image, rms over all places, (n,) [px]."""
    return np.asarray(np.sqrt(np.einsum("np,pq,nq->n", motion, everywhere, motion)))


def _motions(
    squares: Samples, still: Samples, at: Array, by_motion: Array, everywhere: Array
) -> tuple[Array, Array]:
    """Return the motions (n_images, 6) of images against a background, read at shifts.

    With the standard deviation of shifts (n_images,) [px], rms over all places, infinite where few
    squares agree.
    """
    off = np.abs(squares[:, :, ::STRIDE] - still[:, ::STRIDE])
    noise = 1.4826 * np.median(off, axis=(0, 2, 3))
    noise = np.maximum(noise, LEAST_NOISE)
    information, slope = _information(still)
    shown = np.linalg.eigvalsh(information)[:, 0] > (noise / SHARP) ** 2
    motion, sigma = np.zeros((len(squares), by_motion.shape[2])), np.full(len(squares), np.inf)
    if np.count_nonzero(shown) < MIN_SQUARES:
        return motion, sigma
    information, slope = information[shown], slope[shown]
    weighed = information / noise[shown, None, None] ** 2
    for i, image in enumerate(squares):
        off = _inside(still[shown] - image[shown]).reshape(len(slope), -1)
        pull = np.einsum("kpd,kp->kd", slope, off)
        shift = np.linalg.solve(information, pull[..., None])[..., 0]
        motion[i], covariance, share = _common(
            at[i, shown] + shift, weighed, by_motion[shown], everywhere / FAR**2
        )
        if share >= MIN_SHARE:
            sigma[i] = float(np.sqrt(0.5 * np.sum(covariance * everywhere)))
    return motion, sigma


def _shifts_by_motion(middle: Array) -> Array:
    """Return the derivatives (n, 2, 6) of shifts at places by the numbers of a :class:`Move`."""
    shifts = np.zeros((len(middle), 2, len(Move._fields)))
    shifts[:, 0, 0] = shifts[:, 1, 1] = 1.0
    shifts[:, :, 2] = middle
    shifts[:, 0, 3], shifts[:, 1, 3] = -middle[:, 1], middle[:, 0]
    shifts[:, :, 4:] = middle[:, :, None] * middle[:, None, :]
    return shifts


def _inside(squares: Samples) -> Samples:
    """Return squares without their margin, less their mean: the light may change."""
    inner = squares[:, MARGIN:-MARGIN, MARGIN:-MARGIN]
    return np.asarray(inner - inner.mean(axis=(1, 2), keepdims=True))


def _information(still: Samples) -> tuple[Array, Array]:
    """Return information (n, 2, 2) of squares on their shifts, and the slopes (n, pixels, 2)."""
    down, right = np.gradient(still, axis=(1, 2))
    slopes = [_inside(np.asarray(one)).reshape(len(still), -1) for one in (right, down)]
    slope = np.stack(slopes, axis=-1).astype(np.float64)
    return np.einsum("kpd,kpe->kde", slope, slope), slope


def _common(
    shift: Array, information: Array, by_motion: Array, prior: Array
) -> tuple[Array, Array, float]:
    """Return the motion (6,) that most squares share, its covariance, and their share.

    Shifts (n, 2) of squares have this information (n, 2, 2), the motion that of its *prior* (6, 6);
    the weights of squares that disagree vanish (Tukey's biweight).
    """
    root = np.swapaxes(np.linalg.cholesky(information), 1, 2)
    y, X = np.einsum("kij,kj->ki", root, shift), root @ by_motion
    motion = np.zeros(by_motion.shape[2])
    motion[:2] = np.median(shift, axis=0)
    for _ in range(WEIGHED_ROUNDS):
        off = np.linalg.norm(y - X @ motion, axis=1)
        scale = max(1.0, 1.2 * float(np.median(off)))
        weight = np.maximum(1.0 - (off / (CUT * scale)) ** 2, 0.0) ** 2
        normal = np.einsum("k,kij,kil->jl", weight, X, X) + prior
        before, motion = motion, np.linalg.solve(normal, np.einsum("k,kij,ki->j", weight, X, y))
        if np.abs(motion - before)[:2].max() < 0.03 * SETTLED:
            break
    return motion, scale**2 * np.linalg.inv(normal), float(np.mean(weight > 0.25))


def _moved(squares: Samples, shift: Array) -> Samples:
    """Return the squares (n, side, side) read at places that are shifted (n, 2) [px]."""
    n, side, _ = squares.shape
    place = np.arange(side, dtype=np.float32)
    x, y = (np.clip(place + one[:, None], 0, side - 1) for one in shift.T.astype(np.float32))
    x = np.broadcast_to(x[:, None, :], squares.shape)
    y = np.broadcast_to(y[:, :, None], squares.shape) + side * np.arange(n)[:, None, None]
    flat = cv2.remap(
        squares.reshape(-1, side),
        x.reshape(-1, side).astype(np.float32),
        y.reshape(-1, side).astype(np.float32),
        cv2.INTER_LANCZOS4,  # cubic ones of OpenCV are off by up to 0.05 px
    )
    return np.asarray(flat, dtype=np.float32).reshape(squares.shape)
