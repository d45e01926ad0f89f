"""Intervals of rest, and the offset between the clocks of camera and encoders.

Motion is visible in both: pixels change from frame to frame, and readings change. Motion and rest
are distinguished by the threshold that separates the logarithms of both best (N. Otsu, *A threshold
selection method from gray-level histograms*, 1979), so that noise of cameras and encoders needs no
setting. The offset of the clocks maximises the agreement of motion in frames and readings over the
whole recording.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.signal import correlate

from legcal.files.schema import Document, Number
from legcal.geometry.types import Array, BoolArray

MIN_CONTRAST = 5.0  # least contrast of motion and rest, in scatters of rest (a normal has 2.7)
MIN_AGREEMENT = 0.5  # least correlation of motion in frames and readings
MIN_LEAD = 0.1  # least lead of the best offset over the second best
_LEAST_OVERLAP = 0.5  # least overlap, relative to the shorter recording
_MOST_SAMPLES = 200_000


class Still(Document):
    """An interval without motion in the frames, and its use."""

    begin_s: Number  # by the clock of the camera
    end_s: Number
    frame: int | None = None  # the used frame
    why_not: str = ""  # reason for not using it; "" if used


@dataclass(frozen=True)
class Offset:
    """The clock of the camera minus the clock of the readings."""

    seconds: float
    sigma: float  # [s]
    agreement: float | None  # correlation of motion, at most 1; None for a stated offset


class NoOffset(ValueError):
    """The clocks cannot be compared; the text completes "found ..."."""


def moving(speeds: Array) -> BoolArray | None:
    """Return where speeds (n,) of any unit show motion; None if they are all alike."""
    positive = speeds[speeds > 0.0]
    if len(positive) < 2:
        return None
    logs = np.log(np.maximum(speeds, 1e-3 * np.quantile(positive, 0.01)))
    order = np.sort(logs)
    n = np.arange(1, len(order))
    below = np.cumsum(order)[:-1] / n
    above = (order.sum() - n * below) / (len(order) - n)
    between = n * (len(order) - n) * (above - below) ** 2
    k = int(np.argmax(between))
    threshold = 0.5 * (order[k] + order[k + 1])
    fast = logs > threshold
    if not fast.any() or fast.all():
        return None
    rest = np.median(logs[~fast])
    scatter = 1.4826 * np.median(np.abs(logs[~fast] - rest))
    return fast if np.median(logs[fast]) - rest > MIN_CONTRAST * scatter else None


def reading_speeds(times: Array, q: Array) -> Array:
    """Return the speeds (n - 1,) [m/s] of readings (n, n_motors) between times (n,)."""
    return np.asarray(np.abs(np.diff(q, axis=0)).max(axis=1) / np.diff(times))


def clock_offset(
    frame_times: Array,  # (n + 1,) by their own clock [s]
    frames_move: BoolArray,  # (n,) whether there is motion between neighbouring times
    times: Array,  # (m + 1,) of readings, by their own clock [s]
    moves: BoolArray,  # (m,)
    most: float | None = None,  # largest offset [s] if both were recorded by one clock
) -> Offset:
    """Return the offset with the best agreement of motion in frames and in readings.

    Raises
    ------
    NoOffset
        If motion does not agree, or agrees equally well with another offset.
    """
    span = max(np.ptp(frame_times), np.ptp(times))
    step = max(float(np.median(np.diff(frame_times))), span / _MOST_SAMPLES)
    frame_samples, start_of_frames = _on_grid(frame_times, frames_move, step)
    reading_samples, start_of_readings = _on_grid(times, moves, step)
    ones_1, ones_2 = np.ones_like(frame_samples), np.ones_like(reading_samples)
    n = correlate(ones_1, ones_2)
    sums = [
        correlate(frame_samples, ones_2),
        correlate(ones_1, reading_samples),
        correlate(frame_samples, reading_samples),
        correlate(frame_samples**2, ones_2),
        correlate(ones_1, reading_samples**2),
    ]
    n = np.maximum(np.round(n), 1.0)
    mean = [s / n for s in sums]
    spread = [np.maximum(mean[3] - mean[0] ** 2, 1e-6), np.maximum(mean[4] - mean[1] ** 2, 1e-6)]
    score = (mean[2] - mean[0] * mean[1]) / np.sqrt(spread[0] * spread[1])
    # At index i the readings start at frame sample i - len(reading_samples) + 1.
    lags = (
        start_of_frames
        - start_of_readings
        + step * (np.arange(len(score)) - (len(reading_samples) - 1))
    )
    score[n < _LEAST_OVERLAP * min(len(frame_samples), len(reading_samples))] = -1.0
    if most is not None:
        score[np.abs(lags) > most] = -1.0
    best = int(np.argmax(score))
    if score[best] < MIN_AGREEMENT:
        raise NoOffset(
            f"motion in frames and in readings that agree to {max(score[best], 0.0):.0%} at best"
        )
    near = best
    while near > 0 and 0.0 < score[near - 1] <= score[near]:
        near -= 1
    far = best
    while far < len(score) - 1 and 0.0 < score[far + 1] <= score[far]:
        far += 1
    others = np.concatenate([score[:near], score[far + 1 :]])
    if len(others) and others.max() > score[best] - MIN_LEAD:
        at = int(np.flatnonzero(score == others.max())[0])
        raise NoOffset(
            f"motion that agrees as well with clocks {lags[at]:+.1f} s apart as with "
            f"{lags[best]:+.1f} s"
        )
    return _refined(float(lags[best]), step, (frame_times, frames_move), (times, moves),
                    float(score[best]))  # fmt: skip


def _on_grid(times: Array, moves: BoolArray, step: float) -> tuple[Array, float]:
    """Return motion as 1 and 0 on a grid of times, and the first time."""
    elapsed = times - times[0]  # small numbers: Unix times are rounded to 0.2 us
    grid = np.arange(0.0, elapsed[-1], step)
    at = np.searchsorted(elapsed, grid, side="right") - 1
    at = np.minimum(at, len(moves) - 1)  # rounding may put the last grid point at the last time
    return moves[at].astype(float), float(times[0])


def _changes(times: Array, moves: BoolArray) -> tuple[Array, Array]:
    """Return the times at which motion begins (1) or ends (-1).

    The estimate is the middle of the first or last interval with motion.
    """
    change = np.diff(moves.astype(int))
    at = np.flatnonzero(change)
    shows = np.where(change[at] > 0, at + 1, at)
    return 0.5 * (times[shows] + times[shows + 1]), change[at]


def _refined(rough: float, step: float, frames: tuple[Array, BoolArray],
             readings: tuple[Array, BoolArray], agreement: float) -> Offset:  # fmt: skip
    """Return the offset from beginnings and ends of motion, more precise than the grid."""
    ones, kinds = _changes(*frames)
    twos, others = _changes(*readings)
    reach = 3.0 * max(step, float(np.median(np.diff(readings[0]))))
    apart = []
    for kind in (1, -1):
        later = twos[others == kind] + rough
        for time in ones[kinds == kind]:
            if len(later):
                difference = time - later[np.argmin(np.abs(later - time))]
                apart += [difference] if abs(difference) <= reach else []
    if len(apart) < 2:
        return Offset(rough, reach, agreement)
    middle = float(np.median(apart))
    spread = 1.4826 * float(np.median(np.abs(np.array(apart) - middle)))
    return Offset(
        rough + middle, max(spread, step / np.sqrt(12.0)) / np.sqrt(len(apart)), agreement
    )


def runs(moves: BoolArray) -> list[tuple[int, int]]:
    """Return the runs without motion as (first, last) of the samples between the differences."""
    rests = np.concatenate([[False], ~moves, [False]]).astype(int)
    change = np.diff(rests)
    return list(zip(np.flatnonzero(change == 1).tolist(), np.flatnonzero(change == -1).tolist(),
                    strict=True))  # fmt: skip


def still_frames(
    frame_times: Array,
    frames_move: BoolArray,
    times: Array,
    moves: BoolArray,
    offset: Offset,
    least: float,
) -> tuple[list[Still], list[Sequence[int]]]:
    """Return the intervals without motion in frames, and the readings of the used intervals.

    An interval is used if frames and readings rest for *least* seconds, within the uncertainty of
    the clocks; its middle frame is taken.
    """
    shifted = times + offset.seconds
    margin = 3.0 * offset.sigma
    stills: list[Still] = []
    used: list[Sequence[int]] = []
    for first, last in runs(frames_move):
        begin, end = float(frame_times[first]), float(frame_times[last])
        if end - begin < least:
            continue
        inside = np.flatnonzero((shifted >= begin + margin) & (shifted <= end - margin))
        if not len(inside):
            stills.append(Still(begin_s=begin, end_s=end, why_not="no reading"))
            continue
        rests = max(
            ((a, b) for a, b in runs(moves[inside[0] : inside[-1]])),
            key=lambda run: run[1] - run[0],
            default=(0, 0) if len(inside) == 1 else None,
        )
        if rests is None:
            stills.append(Still(begin_s=begin, end_s=end, why_not="readings moved"))
            continue
        kept = inside[rests[0] : rests[1] + 1]
        low, high = max(begin, shifted[kept[0]] - margin), min(end, shifted[kept[-1]] + margin)
        middle = 0.5 * (low + high) if len(kept) > 1 else float(shifted[kept[0]])
        if len(inside) > 1 and high - low < least:
            stills.append(Still(begin_s=begin, end_s=end, why_not="readings moved"))
            continue
        frame = first + int(np.argmin(np.abs(frame_times[first : last + 1] - middle)))
        stills.append(Still(begin_s=begin, end_s=end, frame=frame))
        used.append(kept.tolist())
    return stills, used
