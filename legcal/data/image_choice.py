"""Choices of images: by the order in which they were taken, by name, or at random.

The order is that of their times, else of the numbers in their names. A call names images ``p22``,
``c2:p22``, ``p22..p45`` or ``c2``, separated by commas: a range has all images between two in that
order, a view stands for its images, a pose (its label in the table) for those that show it. Images
that a fit must predict are held out in whole poses, since images of one pose share its unknowns,
and at random, in an order that does not depend on the files, so that every leg in every view loses
no more than its share.
"""

from __future__ import annotations

import re
import shlex
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import replace
from datetime import UTC, date, datetime, time
from pathlib import PurePosixPath

import numpy as np

from legcal.data.dataset import Dataset
from legcal.data.image_tables import canonical_order, measurements_at
from legcal.data.measurements import Measurements, OwnZero, row_names
from legcal.errors import NotIdentifiable, UsageError
from legcal.files.schema import closest, describe
from legcal.files.table import is_number
from legcal.geometry.types import Array, BoolArray, IntArray

_NUMBER = re.compile(r"\d+")
_EXIF_DATE = re.compile(r"(\d{4}):(\d\d):(\d\d)")
_DAY_FIRST = re.compile(r"(\d\d?)\.(\d\d?)\.(\d{4}),? ", re.ASCII)  # with dots, never the month
_OF_DAY = re.compile(r"\d\d?:|(\d{4}|\d{6})$", re.ASCII)  # other numbers are no times of a day
_DATE_DIGITS = 8  # of 20261123
_SEED = 20020721
DAY = 86400.0  # [s]


def image_sequences(
    measurements: Measurements, taken_at: Mapping[str, str]
) -> tuple[IntArray, ...]:
    """Return the rows in the order of their images, one array for each order that is known.

    Times order the images of all views; *taken_at* has those of files by image, as EXIF writes
    them. Numbers in names order the images of one view, or of one camera in the hand: nothing says
    which view came first. The order of rows in the table has no meaning.
    """
    times = _times(measurements, taken_at)
    if times is not None:
        return (np.argsort(times, kind="stable"),)
    names = row_names(measurements)
    cameras = [
        view.name.rpartition("-")[0] if view.hand_held else view.name for view in measurements.views
    ]
    of_row, sequences = np.array(cameras)[measurements.view], []
    for camera in dict.fromkeys(cameras):
        rows = np.flatnonzero(of_row == camera)
        numbers = _numbers([names[row] for row in rows.tolist()])
        if numbers is not None:
            sequences.append(rows[np.argsort(numbers)])
    return tuple(sequences)


def _times(measurements: Measurements, taken_at: Mapping[str, str]) -> Array | None:
    """Return the time of each row [s], None unless all are known and most poses differ in it."""
    times = measurements.time
    if times is None or not np.isfinite(times).all():
        times = np.full(measurements.n_rows, np.nan)
        for row, image in enumerate(measurements.image):
            seconds = seconds_in(taken_at.get(image, ""))
            if seconds is None:
                return None
            times[row] = seconds
    n_moments = len(np.unique(times))
    return times if 2 * n_moments > measurements.n_poses else None


def seconds_in(text: str, day: float | None = None) -> float | None:
    """Return the time in a text [s] by the clock on the wall, None if there is none.

    It is written as ISO 8601, as EXIF does, as spreadsheets do (31.12.2026 10:15), as the time of a
    *day* [s] alone, or as a Unix time. Of numbers, those of eight digits are dates if they can be.
    """
    text = _EXIF_DATE.sub(r"\1-\2-\3", text.strip(), count=1)
    if date_first := _DAY_FIRST.match(text):
        day_of_month, month, year = date_first.groups()
        text = f"{year}-{month:0>2}-{day_of_month:0>2} {text[date_first.end() :].strip()}"
    of_day = _seconds_of_day(text)
    if day is not None and of_day is not None:
        return day // DAY * DAY + of_day
    with suppress(ValueError):
        if len(text) == _DATE_DIGITS or not is_number(text):
            return datetime.fromisoformat(text).replace(tzinfo=UTC).timestamp()
    return unix_seconds(float(text)) if is_number(text) else None


def seconds_of_column(texts: Sequence[str], day: float) -> list[float | None]:
    """Return the times in the cells of a column, as :func:`seconds_in`.

    Numbers are times of the *day* only where all of them can be: 0, 800, 1000 are seconds.
    """
    are_elapsed = any(is_number(text) and _seconds_of_day(text) is None for text in texts)
    return [seconds_in(text, None if are_elapsed else day) for text in texts]


def _seconds_of_day(text: str) -> float | None:
    """Return the time in a text since midnight [s], None if it is no time of a day alone."""
    with suppress(ValueError):
        if _OF_DAY.match(text):
            at = datetime.combine(date(1970, 1, 1), time.fromisoformat(text))
            return at.replace(tzinfo=UTC).timestamp()
    return None


def unix_seconds(number: float) -> float | None:
    """Return a Unix time [s] from s, ms, us or ns, distinguished by years 2001 to 2286.

    Other numbers, such as 20261123101500, give None; numbers before 2001 are seconds.
    """
    for unit in (1e9, 1e6, 1e3, 1.0):
        if number >= 1e9 * unit:
            return number / unit if number < 1e10 * unit else None
    return number


def _numbers(names: Sequence[str]) -> IntArray | None:
    """Return the rank of each name by the last number in its stem, None unless they all differ.

    Where all names have as many numbers, as dates and times have, the first ones count before.
    """
    found = [
        [int(digits) for digits in _NUMBER.findall(PurePosixPath(name).stem)] for name in names
    ]
    if len(names) < 2 or not all(found):
        return None
    if len({len(numbers) for numbers in found}) > 1:
        found = [numbers[-1:] for numbers in found]
    ranks = {numbers: rank for rank, numbers in enumerate(sorted({tuple(n) for n in found}))}
    return np.array([ranks[tuple(n)] for n in found]) if len(ranks) == len(names) else None


def sequences_of(dataset: Dataset) -> tuple[IntArray, ...]:
    """Return the rows of a dataset in the order of their images, as :func:`image_sequences`."""
    taken_at = {image: facts.taken_at for image, facts in dataset.facts.items()}
    return image_sequences(dataset.measurements, taken_at)


def chosen_images(dataset: Dataset, text: str) -> BoolArray:
    """Return the images that a text names, (n_rows,): some, not all of the dataset's."""
    chosen = np.zeros(dataset.measurements.n_rows, dtype=np.bool_)
    try:
        for part in text.split(","):
            chosen[_rows_of(dataset, part.strip())] = True
        if chosen.all():
            raise ValueError("found all images, needed some of them; leave it out.")
    except ValueError as error:
        raise UsageError(f"The images {describe(text)} could not be used: {error}") from None
    return chosen


def own_zeros(
    dataset: Dataset, texts: Sequence[str], left_out: BoolArray | None = None
) -> tuple[OwnZero, ...]:
    """Return the images of each ``MOTOR@IMAGES``, in which that motor has a zero of its own.

    ``all@IMAGES`` gives all motors one, as after homing. All images of a pose have its readings,
    and so belong to it if one of them is named. Other images of the motor have to remain.
    """
    pose, zeros = dataset.measurements.pose, list[OwnZero]()
    kept = np.ones(len(pose), dtype=np.bool_) if left_out is None else ~left_out
    split = [(text, *one) for text in texts for one in _motors_and_images(dataset, text)]
    for text, motor, images in split:
        named = chosen_images(dataset, images)
        rows = np.isin(pose, pose[named])
        used = [one.rows & kept for one in zeros if one.motor == motor]
        used.append(rows & kept)
        cause = ""
        if not used[-1].any():
            cause = "found only images that are left out, needed others"
        elif any((used[-1] & other).any() for other in used[:-1]):
            cause = "found images of another split of that motor, needed each image in one of them"
        elif (np.any(used, axis=0) == kept).all():
            shared = " with those that share a pose with them" * bool((rows & ~named).any())
            cause = (
                f"found all images in splits of that motor{shared}, needed some that have the zero "
                "of the model"
            )
        if cause:
            raise UsageError(
                f"The split {describe(text)} could not be used: {cause}; name other images or "
                "leave it out."
            )
        zeros.append(OwnZero(motor, rows, images))
    return tuple(zeros)


def _motors_and_images(dataset: Dataset, text: str) -> list[tuple[str, str]]:
    """Return both parts of ``MOTOR@IMAGES``, for each motor that it is of, by joint or by leg."""
    motor, _, images = text.partition("@")
    legs = [dataset.machine.legs[j] for j in dataset.machine.motors]
    motors = [leg.motor_label for leg in legs]
    named = [leg.motor_label for leg in legs if motor in (leg.motor_label, leg.prismatic, "all")]
    needed = f"needed MOTOR@IMAGES such as {motors[0]}@p22..p45"
    if not named:
        cause = f"found no motor of that name, {needed}; {closest(motor, motors)}"
    elif not images.strip():
        cause = f"found no images, {needed}; name them."
    else:
        return [(one, images) for one in named]
    raise UsageError(f"The split {describe(text)} could not be used: {cause}")


def images_to_name(measurements: Measurements, parts: Sequence[IntArray]) -> str:
    """Return the text that names rows in order: ranges, of one view or of all."""
    names, view = row_names(measurements), measurements.view
    words = []
    for rows in parts:
        of = measurements.views[int(view[rows[0]])].name
        ends = [names[int(rows[0])], names[int(rows[-1])]]
        if len(set(view[rows].tolist())) > 1:
            words.append(
                f"{of}:{ends[0]}..{measurements.views[int(view[rows[-1]])].name}:{ends[1]}"
            )
        elif len(rows) == np.count_nonzero(view == view[rows[0]]):
            words.append(of)
        else:
            words.append(f"{of}:{'..'.join(dict.fromkeys(ends))}")
    return shlex.quote(",".join(words))


def _rows_of(dataset: Dataset, part: str) -> IntArray:
    """Return the rows of an image, a range or a view.

    A range that begins with a view and does not end with one is of that view alone.
    """
    m, names = dataset.measurements, row_names(dataset.measurements)
    if part in m.view_names and part not in names:
        return np.flatnonzero(m.view == m.view_names.index(part))
    first, dots, last = part.partition("..")
    view, begins = _rows_named(m, first)
    if not dots:
        return begins
    of_last, ends = _rows_named(m, last)
    is_of_view = view >= 0 and of_last < 0
    for rows in sequences_of(dataset):
        among = rows[m.view[rows] == view] if is_of_view else rows
        at = [np.flatnonzero(np.isin(among, end)) for end in (begins, ends)]
        if all(len(places) == 1 for places in at):
            start, stop = sorted(int(places[0]) for places in at)
            return among[start : stop + 1]
    raise ValueError(
        f"found the range {part}, needed two images that have an order: with times, or of one view "
        "with numbers in their names; name the images one by one, or their view (VIEW:IMAGE)."
    )


def _rows_named(m: Measurements, name: str) -> tuple[int, IntArray]:
    """Return the view before an image (-1: none), and the rows of that name.

    It is that of the table, of the file with or without its ending, or of the pose.
    """
    names, views = row_names(m), m.view_names
    head, colon, rest = name.partition(":")
    view = views.index(head) if colon and head in views and name not in names else -1
    files = [PurePosixPath(one) for one in names]
    poses = [m.pose_labels[p] for p in m.pose.tolist()] if m.pose_labels else names
    for kind in (names, [one.name for one in files], [one.stem for one in files], poses):
        is_named = np.array([one == (name if view < 0 else rest) for one in kind])
        if len(rows := np.flatnonzero(is_named & ((view < 0) | (m.view == view)))):
            return view, rows
    remedy = closest(name, [*names, *views])
    raise ValueError(f"found no image {describe(name)}, needed one of the dataset; {remedy}")


def split_images(dataset: Dataset, fraction: float) -> tuple[IntArray, IntArray]:
    """Return the rows of the images to fit and of the held-out images, each ascending."""
    if not 0.0 < fraction < 1.0:
        raise UsageError(
            f"The images to keep aside could not be chosen: found the fraction {fraction:g}, "
            "needed a number between 0 and 1 (0.2 keeps a fifth aside); correct it."
        )
    measurements = dataset.measurements
    shown = _shown(dataset)
    wanted = max(1, round(fraction * measurements.n_rows))
    most = np.minimum(np.ceil(fraction * shown.sum(axis=0)), shown.sum(axis=0) - 1)
    held_out = np.zeros(measurements.n_rows, dtype=np.bool_)
    m = dataset.measurements
    rows = canonical_order(m, dataset.machine.leg_names).rows
    poses = np.array(list(dict.fromkeys(m.pose[rows].tolist())), dtype=np.intp)
    for pose in np.random.default_rng(_SEED).permutation(poses):
        tried = held_out | (measurements.pose == pose)
        fits = np.all(shown[tried].sum(axis=0) <= np.maximum(most, 0.0))
        if fits and tried.sum() <= wanted:
            held_out = tried
    if not held_out.any():
        raise NotIdentifiable(
            f"{dataset.folder}: no images could be kept aside: found "
            f"{measurements.n_rows} image{'s' * (measurements.n_rows != 1)} of "
            f"{measurements.n_poses} pose{'s' * (measurements.n_poses != 1)}, needed so many that "
            f"a whole pose is {100 * fraction:g} % of them and every leg stays in every view that "
            "shows it; take more images or leave out --holdout."
        )
    return np.flatnonzero(~held_out), np.flatnonzero(held_out)


def dataset_at(dataset: Dataset, rows: IntArray) -> Dataset:
    """Return a dataset with some of its images only."""
    observations, corners = dataset.observations, dataset.corners
    return replace(
        dataset,
        measurements=measurements_at(dataset.measurements, rows),
        observations=None if observations is None else observations.at(rows),
        body_edges=None if dataset.body_edges is None else dataset.body_edges.at(rows),
        corners=None if corners is None else corners.at(rows),
        landmarks=None if dataset.landmarks is None else dataset.landmarks.at(rows),
    )


def _shown(dataset: Dataset) -> BoolArray:
    """Return a mask of the legs by view that each row shows or may show, (n_rows, views * legs)."""
    measurements, names = dataset.measurements, dataset.machine.leg_names
    shown = np.zeros((measurements.n_rows, len(measurements.views), len(names)), dtype=np.bool_)
    has_observations = np.zeros(measurements.n_rows, dtype=np.bool_)
    if (outlines := dataset.observations) is not None:
        used = outlines.row[outlines.used]
        shown[used, measurements.view[used], outlines.leg[outlines.used]] = True
        has_observations[used] = True
    for row in np.flatnonzero(~has_observations).tolist():
        view = int(measurements.view[row])
        shown[row, view] = [measurements.views[view].uses(name) for name in names]
    return shown.reshape(measurements.n_rows, -1)
