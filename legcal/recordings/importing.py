"""From recordings to a dataset: planned first, then written completely or not at all."""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from legcal.data.measurements import few
from legcal.data.new_dataset import (
    DATASET_FOLDER,
    MIN_SIGMA,
    SheetOptions,
    plan_new_dataset,
    write_new_dataset,
)
from legcal.data.reading_units import usual_sigma
from legcal.errors import DatasetError, OutOfResources, UsageError
from legcal.files.folder import check_path, existing_parent, temporary_folder
from legcal.files.schema import NAME_NEEDED, Document, Number, describe, is_name
from legcal.files.table import format_table
from legcal.geometry.types import Array
from legcal.machine.loader import load_mechanism
from legcal.machine.model import Machine
from legcal.progress import Report, no_progress
from legcal.recordings.frames import (
    VIDEOS,
    Bag,
    ImageFolder,
    Recording,
    Video,
    is_bag,
    split_topic,
)
from legcal.recordings.series import Series, read_series
from legcal.recordings.stillness import (
    NoOffset,
    Offset,
    Still,
    clock_offset,
    moving,
    reading_speeds,
    still_frames,
)
from legcal.vision.camera_file import read_camera

LEAST_STILL = 0.3  # least duration of a rest [s]
ONE_CLOCK = 2.0  # largest offset of frames and readings in one bag [s]
_WIDTH = 160  # width of compared frames [px]
_SHOTS, _TABLE = "shots", "readings.csv"


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

    @property
    def used(self) -> list[int]:
        """Indices of the used frames."""
        return [still.frame for still in self.block.stills if still.frame is not None]


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


def plan_import(
    sources: Sequence[Path],
    model: str | Path,
    destination: str | Path,
    *,
    readings: Sequence[Path] = (),
    cameras: Sequence[str] = (),
    lengths: bool = False,
    offset: float | None = None,
    progress: Report = no_progress,
) -> Import:
    """Select the frames of recordings in which the machine is at rest, with their readings.

    Parameters
    ----------
    sources : sequence of path
        A video, a ROS bag or a folder of images with times for each camera position; for a bag with
        several cameras append the topic of one, ``run.mcap:/left/image_raw``.
    model : path or str
        The nominal model, as for :func:`legcal.load_mechanism`.
    destination : path
        The folder of the dataset.
    readings : sequence of path
        Tables of readings with a column of times: one for all recordings, or one for each; none
        for bags with joint states.
    cameras : sequence of str
        Camera files: one for all views, or ``VIEW=FILE`` for each.
    lengths : bool
        Whether tables hold total lengths of legs instead of readings.
    offset : float, optional
        Clock of the camera minus clock of the readings [s]; determined from motion by default.

    Raises
    ------
    DatasetError, ModelError, UsageError
        If a file cannot be read, nothing moves or rests, or the clocks cannot be compared.
    """
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
        read_camera(
            Path(text if "=" not in text or os.path.isfile(text) else text.split("=", 1)[1])
        )
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
    moves = moving(reading_speeds(series.times, series.q))
    for signal, motion in (("frames", frames_move), ("readings", moves)):
        if motion is None:
            raise DatasetError(
                f"{start} found {signal} that change at one rate all the time, needed a machine "
                "that rests at each pose and moves between; for photographs of single poses use "
                f"legcal init. ({series.source if signal == 'readings' else recording.path})"
            )
    assert frames_move is not None
    assert moves is not None
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
    _check_overlap(times - apart.seconds, series, start)
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
        notes=[*recording.notes(), *series.notes],
    )
    return View(name, recording, q, scatter, series.unit, block)


def _check_overlap(times: Array, series: Series, start: str) -> None:
    """Refuse frames at *times* [s] by the clock of the readings, if none of them has readings."""
    first, last = float(series.times.min()), float(series.times.max())
    if times[0] > last or times[-1] < first:
        raise DatasetError(
            f"{start} found its frames from {times[0]:.1f} to {times[-1]:.1f} s by the clock of "
            f"the readings, and these from {first:.1f} to {last:.1f} s ({series.source}), needed "
            "times that overlap; give the right table, or correct --offset SECONDS."
        )


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


def import_recordings(
    plan: Import, *, force: bool = False, progress: Report = no_progress
) -> list[Path]:
    """Write the dataset of an import, complete or not at all; return its files but the images.

    Raises
    ------
    DatasetError
        If the frames do not match the camera files.
    UsageError
        If files are in the way and *force* is not given.
    """
    check_path(plan.destination, DATASET_FOLDER)
    motors = [plan.machine.legs[j] for j in plan.machine.motors]
    joints = [f"{leg.prismatic} [{leg.reading_unit}]" for leg in motors]
    try:
        with temporary_folder(existing_parent(plan.destination), plan.destination.name) as folder:
            rows: list[tuple[object, ...]] = []
            for view in plan.views:
                (folder / _SHOTS / view.name).mkdir(parents=True)
                used = view.used
                for k, frame in enumerate(view.recording.frames(only=frozenset(used))):
                    name = f"{view.name}_{k + 1:03d}.png"
                    place = folder / _SHOTS / view.name / name
                    done, content = cv2.imencode(".png", frame.image)
                    assert done
                    place.write_bytes(content.tobytes())
                    q = view.readings[k]
                    rows.append((view.name, f"{view.name}/{name}", *q.tolist()))
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
    except OSError as error:
        raise OutOfResources(
            f"{plan.destination}: the dataset could not be written: found "
            f"'{error.strerror or error}', needed a folder that takes its files; free some space "
            "or give another folder; nothing was written."
        ) from error
