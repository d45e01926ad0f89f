"""Images that a call names: ``p22``, ``c2:p22``, ``p22..p45`` or ``c2``, separated by commas.

A range has all images between two in the order in which they were taken, see
:mod:`legcal.data.image_order`; a view stands for its images.
"""

from __future__ import annotations

import shlex
from collections.abc import Sequence

import numpy as np

from legcal.data.dataset import Dataset
from legcal.data.image_order import image_sequences
from legcal.data.measurements import Measurements, OwnZero, row_names
from legcal.errors import UsageError
from legcal.files.schema import closest, describe
from legcal.geometry.types import BoolArray, IntArray


def sequences_of(dataset: Dataset) -> tuple[IntArray, ...]:
    """Return the rows of a dataset in the order of their images, as :func:`image_sequences`."""
    taken_at = {image: facts.taken_at for image, facts in dataset.facts.items()}
    return image_sequences(dataset.measurements, taken_at)


def chosen_images(dataset: Dataset, text: str) -> BoolArray:
    """Return the images that a text names, (n_rows,).

    Raises
    ------
    UsageError
        If it names images that the dataset does not have, all of them, or a range without order.
    """
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

    All images of a pose have its readings, and so belong to it if one of them is named.

    Raises
    ------
    UsageError
        If there is no such motor, or images cannot be used: other ones of the motor, or none, have
        to remain.
    """
    pose, zeros = dataset.measurements.pose, list[OwnZero]()
    kept = np.ones(len(pose), dtype=np.bool_) if left_out is None else ~left_out
    for text in texts:
        motor, images = _motor_and_images(dataset, text)
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


def _motor_and_images(dataset: Dataset, text: str) -> tuple[str, str]:
    """Return both parts of ``MOTOR@IMAGES``."""
    motor, _, images = text.partition("@")
    legs = [dataset.machine.legs[j] for j in dataset.machine.motors]
    motors = [leg.motor_label for leg in legs]
    needed = f"needed MOTOR@IMAGES such as {motors[0]}@p22..p45"
    if motor not in motors:
        cause = f"found no motor of that name, {needed}; {closest(motor, motors)}"
    elif not images.strip():
        cause = f"found no images, {needed}; name them."
    else:
        return motor, images
    raise UsageError(f"The split {describe(text)} could not be used: {cause}")


def images_in_words(measurements: Measurements, parts: Sequence[IntArray]) -> str:
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
    views = [view.name for view in m.views]
    if part in views and part not in names:
        return np.flatnonzero(m.view == views.index(part))
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
    """Return the view before an image (-1: none), and the rows of that name."""
    names, views = np.array(row_names(m), dtype=object), [view.name for view in m.views]
    head, colon, rest = name.partition(":")
    view = views.index(head) if colon and head in views and name not in names else -1
    rows = np.flatnonzero((names == (name if view < 0 else rest)) & ((view < 0) | (m.view == view)))
    if not len(rows):
        remedy = closest(name, [*names, *views])
        raise ValueError(f"found no image {describe(name)}, needed one of the dataset; {remedy}")
    return view, rows
