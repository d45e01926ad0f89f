"""From recordings to a dataset: planned first, then written completely or not at all."""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from scipy.signal import correlate

from legcal.data.dataset import Dataset, load_dataset
from legcal.data.dataset_file import listed
from legcal.data.new_dataset import (
    DATASET_FOLDER,
    MIN_SIGMA,
    SheetOptions,
    plan_new_dataset,
    split_camera,
    write_new_dataset,
)
from legcal.data.reading_units import usual_sigma
from legcal.errors import DatasetError, UsageError
from legcal.files.folder import (
    ANOTHER_FOLDER,
    check_path,
    existing_parent,
    out_of_resources,
    temporary_folder,
)
from legcal.files.schema import NAME_NEEDED, Document, Number, describe, few, is_name
from legcal.files.table import format_table
from legcal.geometry.types import Array, BoolArray
from legcal.machine.loader import load_mechanism
from legcal.machine.model import Machine
from legcal.progress import Report, no_progress
from legcal.recordings.frames import (
    VIDEOS,
    Bag,
    ImageFolder,
    Recording,
    Series,
    Video,
    is_bag,
    read_series,
    split_topic,
)
from legcal.vision.camera_file import read_camera

LEAST_STILL = 0.3  # least duration of a rest [s]
ONE_CLOCK = 2.0  # largest offset of frames and readings in one bag [s]
_WIDTH = 160  # width of compared frames [px]
_SHOTS, _TABLE = "shots", "readings.csv"
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


class RecordingBlock(Document):
    """The recording of a view."""

    recording: str
    readings: str  # source of the readings
    frames: int
    used: int
    offset_s: Number  # offset between the clocks
    offset_sigma_s: Number
    agreement: Number | None  # correlation of motions; None if the offset was stated
    stills: list[Still]
    notes: list[str]


class ImportDocument(Document):
    """The document of ``legcal import --json``."""

    dataset: str
    encoder_sigma: Number | dict[str, Number]  # [m], or by motor [m, rad] if one turns
    views: dict[str, RecordingBlock]
    written: list[str]


@dataclass(frozen=True, eq=False)
class View:
    """The evaluated recording of one camera position."""

    name: str  # from the file
    recording: Recording
    readings: Array  # (n_used, n_motors) means over the used intervals [m or rad]
    scatter: Array  # (n_motors,) standard deviation of a reading around them [m or rad]
    unit: str  # of the readings, in words
    block: RecordingBlock


@dataclass(frozen=True, eq=False)
class Import:
    """Recordings with their selected frames, not written yet."""

    machine: Machine
    model: str | Path
    destination: Path
    views: tuple[View, ...]
    cameras: tuple[str, ...]

    @property
    def encoder_sigma(self) -> float | dict[str, float]:
        """Standard deviation of a reading at rest [m]; constant errors do not average out.

        By joint [m or rad] if a motor turns.
        """
        scatter = np.max([view.scatter for view in self.views], axis=0)
        motors = [self.machine.legs[j] for j in self.machine.motors]
        if not any(leg.reads_angle for leg in motors):
            return max(float(scatter.max()), MIN_SIGMA)
        return {
            str(leg.prismatic): max(sigma, usual_sigma(leg, MIN_SIGMA))
            for leg, sigma in zip(motors, scatter.tolist(), strict=True)
        }

    def document(self, written: Sequence[Path]) -> dict[str, Any]:
        """Return the document of ``legcal import --json``, with the written files."""
        return ImportDocument(
            dataset=str(self.destination),
            encoder_sigma=self.encoder_sigma,
            views={view.name: view.block for view in self.views},
            written=[str(path) for path in written],
        ).document()


def import_recordings(
    sources: str | Path | Sequence[str | Path],
    model: str | Path,
    output: str | Path,
    *,
    cameras: str | Path | Sequence[str | Path],
    readings: str | Path | Sequence[str | Path] = (),
    lengths: bool = False,
    offset: float | None = None,
    force: bool = False,
) -> Dataset:
    """Make a dataset from recordings of a machine that rests at each pose, and load it.

    Parameters
    ----------
    sources : path or sequence of path
        A video, a ROS bag or a folder of images with times for each camera position; of a bag with
        several cameras the topic of one: ``run.mcap:/left/image_raw``.
    model : path or str
        The nominal model, as for :func:`legcal.load_mechanism`.
    output : path
        The folder of the dataset.
    cameras : path or sequence of str
        Camera files: one of all views, or ``VIEW=FILE`` for each.
    readings : path or sequence of path
        One table with times for all recordings, or one for each; none for bags with joint states.
    lengths : bool
        The tables hold whole leg lengths.
    offset : float, optional
        Clock of the camera minus that of the readings [s]; otherwise found from the motion.
    force : bool
        Whether files that exist already are replaced.

    Raises
    ------
    DatasetError, ModelError, UsageError
        With one sentence for each problem.
    OutOfResources
        If the folder cannot be written.
    """
    plan = plan_import(
        [Path(source) for source in listed(sources)],
        model,
        output,
        readings=[Path(table) for table in listed(readings)],
        cameras=listed(cameras),
        lengths=lengths,
        offset=offset,
    )
    write_import(plan, force=force)
    return load_dataset(output)


def plan_import(
    sources: Sequence[Path],  # a video, bag or folder of images with times for each camera position
    model: str | Path,
    destination: str | Path,
    *,
    readings: Sequence[Path] = (),  # one table for all recordings, one for each, or none for bags
    cameras: Sequence[str] = (),
    lengths: bool = False,
    offset: float | None = None,  # clock of the camera minus clock of the readings [s]
    progress: Report = no_progress,
) -> Import:
    """Select the frames of recordings in which the machine is at rest, with their readings."""
    machine = load_mechanism(model)
    destination = Path(destination)
    check_path(destination, DATASET_FOLDER)
    recordings = [open_recording(Path(path), machine) for path in sources]
    names = [_view_name(Path(path), destination) for path in sources]
    twice = sorted({name for name in names if names.count(name) > 1})
    if twice:
        raise UsageError(
            f"The recordings could not be imported: found {describe(twice[0])} as the name of two, "
            "needed one for each camera position; rename the files."
        )
    if len(readings) not in (0, 1, len(recordings)):
        raise UsageError(
            f"The recordings could not be imported: found {len(readings)} tables of readings for "
            f"{len(recordings)} recordings, needed one for all or one for each, in their order."
        )
    if offset is not None and not np.isfinite(offset):
        raise UsageError(
            f"The recordings could not be imported: found an offset of {offset:g} s between the "
            "clocks, needed a finite number; correct --offset."
        )
    for text in cameras:  # before minutes of reading frames
        read_camera(Path(split_camera(text)[1]))
    tables = {path: read_series(path, machine, lengths=lengths) for path in dict.fromkeys(readings)}
    views = []
    for k, (name, recording) in enumerate(zip(names, recordings, strict=True)):
        series = tables[readings[min(k, len(readings) - 1)]] if readings else recording.readings()
        if series is None:
            raise UsageError(
                f"{recording.path}: the readings could not be found: found none in it, needed a "
                "table with times; give it with --readings."
            )
        views.append(_view(name, recording, series, offset, progress, one_clock=not readings))
    return Import(machine, model, destination, tuple(views), tuple(cameras))


def open_recording(path: Path, machine: Machine) -> Recording:
    """Return the recording at a path: a bag (with an optional topic), images or a video."""
    path, topic = split_topic(path)
    if not os.path.exists(path):
        raise DatasetError(
            f"{path}: the recording could not be read: found no such file, needed a video, a bag "
            "or a folder of images; check the path."
        )
    if is_bag(path):
        return Bag(path, machine, topic)
    if path.is_dir():
        return ImageFolder(path)
    if path.suffix.lower() in VIDEOS:
        return Video(path)
    raise DatasetError(
        f"{path}: the recording could not be read: found a file ending in "
        f"{describe(path.suffix)}, needed a video ({', '.join(VIDEOS)}), a bag (.bag, .mcap, or "
        "the folder of a ROS 2 bag) or a folder of images."
    )


def _view_name(path: Path, destination: Path) -> str:
    """Return the name of the view of a recording, from its file and topic."""
    path, topic = split_topic(path)
    name = path.resolve().stem if not path.is_dir() else path.resolve().name
    if topic is not None:
        name = f"{name}_{topic.strip('/').replace('/', '_')}"
    if not is_name(name) or "/" in name or "=" in name:
        raise DatasetError(
            f"{path}: the recording could not be used: found the name {describe(name)}, which is "
            f"that of its view in {destination}, needed {NAME_NEEDED}; rename it."
        )
    return name


def _view(
    name: str,
    recording: Recording,
    series: Series,
    given: float | None,
    progress: Report,
    *,
    one_clock: bool,
) -> View:
    """Return the view of a recording, with its used frames and their readings."""
    start = f"{recording.path}: the recording could not be used:"
    times, changes = _changes(recording, progress, name)
    if len(times) < 3:
        raise DatasetError(f"{start} found {len(times)} frames, needed those of a recording.")
    frames_move = moving(changes)
    speeds = np.abs(np.diff(series.q, axis=0)).max(axis=1) / np.diff(series.times)
    moves = moving(speeds)
    if frames_move is None or moves is None:
        signal, source = (
            ("readings", series.source) if moves is None else ("frames", recording.path)
        )
        raise DatasetError(
            f"{start} found {signal} that change at one rate all the time, needed a machine that "
            "rests at each pose and moves between; for photographs of single poses use legcal "
            f"init. ({source})"
        )
    if given is not None:
        apart = Offset(given, 0.0, None)
    else:
        try:
            apart = clock_offset(
                times, frames_move, series.times, moves, ONE_CLOCK if one_clock else None
            )
        except NoOffset as error:
            raise DatasetError(
                f"{start} found {error} ({series.source}), needed the readings of the same time, "
                "with pauses of different length; give the right table, or how far the clock of "
                "the camera is ahead, --offset SECONDS."
            ) from error
    clock = times - apart.seconds
    first, last = float(series.times.min()), float(series.times.max())
    if clock[0] > last or clock[-1] < first:
        raise DatasetError(
            f"{start} found its frames from {clock[0]:.1f} to {clock[-1]:.1f} s by the clock of "
            f"the readings, and these from {first:.1f} to {last:.1f} s ({series.source}), needed "
            "times that overlap; give the right table, or correct --offset SECONDS."
        )
    stills, kept = still_frames(times, frames_move, series.times, moves, apart, LEAST_STILL)
    if not kept:
        reasons = few([f"{s.why_not} from {s.begin_s:.1f} s" for s in stills]) or "no rest"
        raise DatasetError(
            f"{start} found no frame to use ({reasons}), needed rests of {LEAST_STILL:g} s and "
            "more with readings; record longer rests."
        )
    q = np.array([series.q[rows].mean(axis=0) for rows in kept])
    rest = np.concatenate([series.q[rows] - q[k] for k, rows in enumerate(kept)])
    freedoms = max(len(rest) - len(kept), 1)
    scatter = np.sqrt((rest**2).sum(axis=0) / freedoms)
    block = RecordingBlock(
        recording=str(recording.path),
        readings=series.source,
        frames=len(times),
        used=len(kept),
        offset_s=apart.seconds,
        offset_sigma_s=apart.sigma,
        agreement=apart.agreement,
        stills=stills,
        notes=[*recording.notes, *series.notes],
    )
    return View(name, recording, q, scatter, series.unit, block)


def _changes(recording: Recording, progress: Report, name: str) -> tuple[Array, Array]:
    """Return the times of frames [s] and their differences from the frame before [levels]."""
    times: list[float] = []
    changes: list[float] = []
    before: Array | None = None
    for frame in recording.frames():
        grey = frame.image if frame.image.ndim == 2 else cv2.cvtColor(
            frame.image, cv2.COLOR_BGR2GRAY)  # fmt: skip
        scale = min(_WIDTH / grey.shape[1], 1.0)
        small = np.asarray(
            cv2.resize(grey, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA), dtype=float
        )
        if before is not None:
            if before.shape != small.shape:
                raise DatasetError(
                    f"{recording.path}: the recording could not be used: found frames of different "
                    "shape, needed those of one camera; record each camera position apart."
                )
            changes.append(float(np.sqrt(np.mean((small - before) ** 2))))
        times.append(frame.time)
        before = small
        if len(times) % 100 == 0:
            progress(f"Looking at {name}", len(times), 0)
    return np.array(times), np.array(changes)


def write_import(
    plan: Import, *, force: bool = False, progress: Report = no_progress
) -> list[Path]:
    """Write the dataset of an import, complete or not at all; return its files but the images."""
    motors = [plan.machine.legs[j] for j in plan.machine.motors]
    joints = [f"{leg.prismatic} [{leg.reading_unit}]" for leg in motors]
    with (
        out_of_resources(plan.destination, "the dataset", ANOTHER_FOLDER),
        temporary_folder(existing_parent(plan.destination), plan.destination.name) as folder,
    ):
        rows: list[tuple[object, ...]] = []
        for view in plan.views:
            (folder / _SHOTS / view.name).mkdir(parents=True)
            used = [still.frame for still in view.block.stills if still.frame is not None]
            for k, frame in enumerate(view.recording.frames(only=frozenset(used))):
                name = f"{view.name}/{view.name}_{k + 1:03d}.png"
                done, content = cv2.imencode(".png", frame.image)
                assert done
                (folder / _SHOTS / name).write_bytes(content.tobytes())
                rows.append((view.name, name, *view.readings[k].tolist()))
                progress(f"Writing {view.name}", k + 1, len(used))
                if k + 1 == len(used):
                    break
        table = folder / _TABLE
        table.write_text(format_table(["view", "image", *joints], rows), encoding="utf-8")
        new = plan_new_dataset(
            folder / _SHOTS, table, plan.model, plan.destination,
            SheetOptions(cameras=plan.cameras, encoder_sigma=plan.encoder_sigma),
        )  # fmt: skip
        return write_new_dataset(new, force=force)


# Intervals of rest, and the offset between the clocks of camera and encoders
#
# Motion is visible in both: pixels change from frame to frame, and readings change. Motion and
# rest are distinguished by the threshold that separates the logarithms of both best (N. Otsu, A
# threshold selection method from gray-level histograms, 1979), so that noise of cameras and
# encoders needs no setting. The offset of the clocks maximises the agreement of motion in frames
# and readings over the whole recording.


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


def clock_offset(
    frame_times: Array,  # (n + 1,) by their own clock [s]
    frames_move: BoolArray,  # (n,) whether there is motion between neighbouring times
    times: Array,  # (m + 1,) of readings, by their own clock [s]
    moves: BoolArray,  # (m,)
    most: float | None = None,  # largest offset [s] if both were recorded by one clock
) -> Offset:
    """Return the offset with the best agreement of motion in frames and in readings."""
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


def _beginnings_and_ends(times: Array, moves: BoolArray) -> tuple[Array, Array]:
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
    ones, kinds = _beginnings_and_ends(*frames)
    twos, others = _beginnings_and_ends(*readings)
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
