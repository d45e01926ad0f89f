"""The table ``measurements.csv``: for every image its view, its pose and the readings.

The header is ``view,image,<actuated joint>,...`` with an optional ``pose``, in any order.
Readings are in metres. Rows with the same pose label, in any view, share one platform pose
and one reading (their mean); a row without a label is a separate pose. Tables of observations
name their rows by view and image, see :func:`row_names`.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.spatial.transform import RigidTransform

from legcal.brief import brief
from legcal.data.reading_units import (
    ReadingUnit,
    UnitPlace,
    doubtful_units,
    joint_values,
    legs_with_readings,
    likely_cause,
    readings_of_lengths,
)
from legcal.errors import Cause, Problem, by_cause
from legcal.files.folder import path_problem
from legcal.files.schema import closest, describe, few
from legcal.files.table import Column, Table, read_table
from legcal.geometry.types import Array, BoolArray, IntArray
from legcal.machine.leg import TRAVEL_MARGIN, Leg
from legcal.vision.camera import Camera, shared_cameras

# Fraction of the travel, and standard deviations: readings outside by less are within the travel
# but for rounding and noise.
ROUNDED, NOISY = 1e-3, 3.0
# Minimum fraction and number of rows outside the travel for a search of a common cause
MANY, FEWEST = 0.25, 2
MAX_READING_SPREAD = 10.0  # maximum difference [sigma] between rows of one pose
_TEXTS = ("view", "image", "pose")  # columns
_MAX_SHOWN = 3  # readings quoted in a sentence about many


@dataclass(frozen=True, eq=False)
class View:
    """One position of a calibrated camera."""

    name: str  # in dataset.yaml
    camera: Camera
    T_base_camera: RigidTransform | None = None  # rough: good to 2 cm and 2 degrees
    legs: tuple[str, ...] | None = None  # use only these legs in this view; None for all
    hand_held: bool = False  # one image of a hand-held camera
    by_landmarks: bool = False  # whether the rough pose comes from clicks on joints
    is_placed: bool = False  # whether enough clicks agree that it is the camera, and not a start

    def uses(self, leg: str) -> bool:
        """Return whether a leg, by its name, is used in this view."""
        return self.legs is None or leg in self.legs


@dataclass(frozen=True, eq=False)
class OwnZero:
    """Images in which the encoder of a motor has a zero of its own."""

    motor: str  # its label
    rows: BoolArray  # (n_rows,)
    images: str  # as they were named


@brief
@dataclass(frozen=True, eq=False)
class Measurements:
    """The rows of ``measurements.csv``: one for each image.

    Rows that share a pose index share one platform pose, and its readings.
    """

    views: tuple[View, ...]
    image: tuple[str, ...]  # relative to the dataset; "" where only outlines are given
    view: IntArray  # (n_rows,) index into views
    pose: IntArray  # (n_rows,) 0 to n_poses - 1, numbered as they first appear
    # (n_rows, n_legs) readings [m]; for rods on actuators the reading of the actuator [m or rad];
    # zero for other constant-length legs, NaN for passive ones
    q: Array
    sigma_q: Array  # (n_legs,) standard deviation of the reading of each leg [m or rad]
    pose_labels: tuple[str, ...] = ()  # label of each pose, or ""; empty without that column
    time: Array | None = None  # (n_rows,) when images were taken [s], NaN where unknown
    own_zeros: tuple[OwnZero, ...] = ()

    @property
    def n_rows(self) -> int:
        """Number of images."""
        return len(self.image)

    @property
    def first_rows(self) -> IntArray:
        """The first row of every pose, (n_poses,), with the reading of the pose."""
        return np.asarray(np.unique(self.pose, return_index=True)[1])

    @property
    def q_of_poses(self) -> Array:
        """The readings of every pose, (n_poses, n_legs) [m or rad]."""
        return self.q[self.first_rows]

    @property
    def n_poses(self) -> int:
        """Number of different platform poses."""
        return int(self.pose.max()) + 1 if len(self.pose) else 0

    @property
    def view_names(self) -> tuple[str, ...]:
        """The names of the views."""
        return tuple(view.name for view in self.views)

    @property
    def cameras(self) -> tuple[Camera, ...]:
        """The camera of each view, with the intrinsics of its file."""
        return tuple(view.camera for view in self.views)

    @property
    def owners(self) -> tuple[str, ...]:
        """For each view the name of the first view with its camera."""
        return shared_cameras(self.view_names, self.cameras)

    @property
    def clicked_views(self) -> tuple[str, ...]:
        """The views with a rough pose from clicks on joints."""
        return tuple(view.name for view in self.views if view.by_landmarks)


def row_names(measurements: Measurements) -> tuple[str, ...]:
    """Return the name of each row of the measurements in the image column of other tables."""
    names = list(measurements.image)
    for v in range(len(measurements.views)):
        rows = np.flatnonzero(measurements.view == v).tolist()
        blank = [i for i in rows if not names[i]]
        taken = {names[i] for i in rows}
        labels = [
            measurements.pose_labels[measurements.pose[i]] if measurements.pose_labels else ""
            for i in blank
        ]
        if not all(labels) or len(set(labels)) < len(labels) or set(labels) & taken:
            labels = [str(i + 1) for i in blank]
        for i, label in zip(blank, labels, strict=True):
            names[i] = label
    return tuple(names)


def places(measurements: Measurements) -> list[tuple[str, str]]:
    """Return the view and the name in the image column of every row."""
    views = [measurements.views[v].name for v in measurements.view.tolist()]
    return list(zip(views, row_names(measurements), strict=True))


def find_rows(table: Table, measurements: Measurements, *, refuse: bool = True) -> IntArray:
    """Return for each row of a table of images the row of the measurements, -1 where unknown.

    Unknown views and images are refused, unless said otherwise: images with one sentence a view.
    """
    m, names = measurements, places(measurements)
    views = list(dict.fromkeys(view for view, _ in names))
    index = {place: row for row, place in enumerate(names)}
    named = list(zip(table.text("view"), table.text("image"), strict=True))
    rows = np.array([index.get(place, -1) for place in named], dtype=np.intp)
    unknown = np.flatnonzero(rows < 0).tolist() if refuse else []
    for view in dict.fromkeys(named[i][0] for i in unknown):
        of_view = [i for i in unknown if named[i][0] == view]
        if view not in views:
            found, remedy = f"the unknown view {describe(view)}", closest(view, views)
            for i in of_view:
                table.refuse(i, found, "a view with measurements", "view", remedy=remedy)
            continue
        images = list(dict.fromkeys(named[i][1] for i in of_view))
        found, needed = describe(images[0]), f"an image of view {view} in the measurements"
        remedy = closest(images[0], [name for v, name in names if v == view])
        if len(images) > 1:
            found = f"{few(list(map(describe, images)))} in {len(of_view)} rows"
            needed = f"images of view {view} in the measurements"
            remedy = "add their rows to the measurements, or remove theirs from this table"
        poses = [m.pose_labels[p] for p, v in zip(m.pose, m.view, strict=True)
                 if m.pose_labels and m.views[v].name == view]  # fmt: skip
        if repeated := [image for image in images if poses.count(image) > 1]:
            found += f", and two rows of view {view} with pose {repeated[0]} in the measurements"
            needed = "one row of each pose there, which names an image without a file"
            remedy = "remove one of these two from the measurements"
        what = f"{table.thing}{'s' * (len(images) > 1)}"
        table.refuse(of_view[0], found, needed, "image", remedy=remedy, what=what)
    return rows


def refuse_outside(
    table: Table, rows: IntArray, columns: Sequence[str], measurements: Measurements
) -> None:
    """Refuse pixels, in two columns, outside the image of their row of the measurements."""
    px = table.numbers(columns)
    sizes = np.array([(camera.width, camera.height) for camera in measurements.cameras])
    size = sizes[measurements.view[rows]]
    outside = ((px < -0.5) | (px > size - 0.5)) & (rows >= 0)[:, None]
    for i, k in np.argwhere(outside).tolist():
        needed = f"-0.5 to {size[i, k] - 0.5:g} px, inside the image"
        table.refuse(i, f"{px[i, k]:g} px", needed, columns[k], remedy="correct it")


def few_views(names: Sequence[str]) -> str:
    """Return views in words, at most a few names: ``views c1, c2``."""
    return f"view{'s' * (len(names) > 1)} {few(names)}"


def image_notes(measurements: Measurements, causes: Mapping[int, Cause]) -> list[str]:
    """Return one sentence for each cause, which begins with the images of its rows."""
    return [
        f"{images_in_words(measurements, rows)}{': ' if len(rows) == 1 else ', each: '}{cause}"
        for cause, rows in by_cause(causes)
    ]


def images_in_words(measurements: Measurements, rows: Sequence[int]) -> str:
    """Return rows in words: ``3 images of views c1, c2 (a.png, b.png, c.png)``.

    A single one is ``view c1, image a.png``.
    """
    names = row_names(measurements)
    views = dict.fromkeys(measurements.views[int(measurements.view[row])].name for row in rows)
    of_views = few_views(list(views))
    if len(rows) == 1:
        return f"view {next(iter(views))}, image {names[rows[0]]}"
    return f"{len(rows)} images of {of_views} ({few([names[row] for row in rows])})"


def readings_in(
    table: Table,
    legs: Sequence[Leg],
    units: Mapping[str, ReadingUnit],
    sigma: Array | None = None,
    *,
    place: UnitPlace,
    lengths: bool = False,
) -> tuple[Array, tuple[str, ...]]:
    """Return the readings in a table (n_rows, n_motors) [m or rad], and notes on odd ones.

    Readings outside their travel by more than 5 % of it are refused; smaller excesses are noted if
    they exceed rounding and noise. Many readings that hardly move in their unit and use the travel
    in a larger one are refused as well.

    *units* are stated in a *place*; *sigma* (n_motors,) are their standard deviations. The numbers
    may be whole *lengths* of legs.
    """
    motors = legs_with_readings(legs)
    values = table.numbers(str(leg.prismatic) for leg in motors)
    names = [str(leg.prismatic) for leg in motors]
    stated = [units[str(leg.prismatic)] for leg in motors]
    readings = joint_values(values, stated)
    readings = readings_of_lengths(readings, motors) if lengths else readings
    noise = np.zeros(len(motors)) if sigma is None else NOISY * sigma
    what = "lengths" if lengths else "readings"
    notes, outside, often = [], dict[int, str](), dict[tuple[bool, str], list[int]]()
    for j, (leg, unit, column) in enumerate(zip(motors, stated, readings.T, strict=True)):
        lower, upper = leg.travel
        if not 0.0 < upper - lower < np.inf:
            continue
        beyond = np.maximum(lower - column, column - upper)
        is_odd = beyond > max(ROUNDED * (upper - lower), float(noise[j]))
        is_far = (beyond > 0.0) & ~leg.in_travel(column)
        ends = [leg.length_at(q) if lengths else q for q in leg.travel]
        low, high = sorted(map(unit.reading, ends))
        travel = f"{low:g} to {high:g} {unit.name} (the joint limits of the model)"
        if np.any(is_far):
            some, n = _some(table, values[:, j], is_far, unit.name), len(column)
            outside[j] = f"found {some}, needed {travel} with a margin of {TRAVEL_MARGIN:.0%}"
            if np.count_nonzero(is_far) >= max(MANY * n, min(FEWEST, n)):
                often.setdefault((leg.reads_angle, unit.name), []).append(j)
        elif np.any(is_odd):
            notes.append(
                f"{table.path}, column {table.heading(names[j])}: {what} are a little outside the "
                f"travel {travel}: {_some(table, values[:, j], is_odd, unit.name)}."
            )
    notes += still_encoders(table.path, motors, readings)
    usual = f"correct the {what} or the limits"
    remedies: dict[tuple[int, ...], str] = {(j,): usual for j in outside}  # by columns
    for alike in often.values():
        of_alike, turns = [motors[j] for j in alike], motors[alike[0]].reads_angle
        of_some = sum(leg.reads_angle == turns for leg in motors) > len(alike)
        named = of_alike, [stated[j] for j in alike], place
        if not lengths and (cause := likely_cause(values[:, alike], *named, of_some=of_some)):
            kept = {columns: text for columns, text in remedies.items() if columns[0] not in alike}
            remedies = {**kept, tuple(alike): cause}
    for columns, remedy in remedies.items():
        where = f"in {table.heading(names[columns[0]])} " * (len(columns) > 1)
        said = f"{what} are outside the travel: {where}{outside[columns[0]]}"
        of_columns = tuple(names[k] for k in columns)
        table.refuse_file(Problem(said, remedy=remedy, file=str(table.path), columns=of_columns))
    if not outside and not lengths:
        for problem in doubtful_units(table.path, values, motors, stated, place):
            table.refuse_file(problem)
    return readings, tuple(notes)


def still_encoders(path: Path, motors: Sequence[Leg], readings: Array) -> list[str]:
    """Return a sentence on encoders that read the same in all rows while others move."""
    still = np.ptp(readings, axis=0) == 0.0 if len(readings) else np.ones(len(motors), dtype=bool)
    if still.all() or not still.any():
        return []
    constant = few([str(leg.prismatic) for leg, one in zip(motors, still, strict=True) if one])
    return [
        f"{path}: found the same reading in all rows of {constant}, while other encoders move; "
        "check that these were recorded, and move these legs as well."
    ]


def _some(table: Table, column: Array, chosen: BoolArray, unit: str) -> str:
    """Return the first of some readings with their rows, and the number of further ones."""
    index = np.flatnonzero(chosen).tolist()
    places = table.places
    shown = ", ".join(f"{column[i]:g} {unit} in {places[i]}" for i in index[:_MAX_SHOWN])
    return shown + (f" and {len(index) - _MAX_SHOWN} more" if len(index) > _MAX_SHOWN else "")


def measurement_table(
    path: Path, units: Mapping[str, ReadingUnit]
) -> tuple[Table, tuple[str, ...]]:
    """Return the table ``measurements.csv``, and the motors whose column of readings is empty."""
    table = read_table(
        path,
        "table of measurements",
        "row",
        [
            *(Column(name, "text", required=name != "pose") for name in _TEXTS),
            Column("time", unit="seconds", required=False, blank=True),
            *(Column(name, what="reading", unit=unit.words) for name, unit in units.items()),
        ],
        needed="one row for each image; record measurements",
    )
    unread = tuple(name for name in units if len(table) and not any(table.text(name)))
    table.forgive(unread)
    return table, unread


def measurements_in(
    table: Table,
    folder: Path,
    views: Sequence[View],
    legs: Sequence[Leg],
    sigma_q: Array,
    units: Mapping[str, ReadingUnit],
) -> tuple[Measurements, tuple[str, ...]]:
    """Return the rows of the table ``measurements.csv`` in its order, and notes on odd readings.

    Images are relative to ``folder``; their existence is not checked. *legs* have no readings of
    motors whose column is empty. Raises DatasetError with one sentence for each problem.
    """
    view_names, images = [view.name for view in views], table.text("image")
    view = table.positions("view", view_names, "a view of the dataset file")
    _refuse_images(table, images, folder)
    motors = legs_with_readings(legs)
    sigma = sigma_q[[next(j for j, leg in enumerate(legs) if leg is motor) for motor in motors]]
    readings, notes = readings_in(table, legs, units, sigma, place="dataset file")
    pose, labels = _poses(table.text("pose"))
    q = np.full((len(table), len(legs)), math.nan)
    q[:, [not leg.has_value for leg in legs]] = 0.0
    measurements = Measurements(
        views=tuple(views),
        image=images,
        view=np.maximum(view, 0),
        pose=pose,
        q=q,
        sigma_q=sigma_q,
        pose_labels=labels if "pose" in table else (),
        time=table.number("time") if "time" in table else None,
    )
    shared = _shared_readings(table, legs, pose, readings, sigma)
    column = {leg.prismatic: i for i, leg in enumerate(motors)}
    for j, leg in enumerate(legs):
        if leg.is_motor:
            q[:, j] = shared[:, column[leg.prismatic]]
    table.check()
    return measurements, notes


def _refuse_images(table: Table, images: Sequence[str], folder: Path) -> None:
    """Refuse images that are named twice or lie outside the dataset folder."""
    first: dict[Path, int] = {}
    targets: dict[str, Path | str] = {}  # path of each image, or its problem in words
    for row, image in enumerate(images):
        if not image:
            continue
        if image not in targets:
            problem = path_problem(folder, image)
            targets[image] = problem or (folder / image).resolve()
        target = targets[image]
        if isinstance(target, str):
            needed, remedy = "a relative path inside it", "move the image there"
            table.refuse(row, target, needed, "image", remedy=remedy, what=f"image {image}")
            continue
        earlier = first.setdefault(target, row)
        if earlier != row:
            actual = f"it also in {table.places[earlier]}"
            needed, remedy = "one row an image", "remove one of them"
            table.refuse(row, actual, needed, "image", remedy=remedy, what=f"image {image}")


def _poses(names: Sequence[str]) -> tuple[IntArray, tuple[str, ...]]:
    """Return the pose of each row, numbered as they first appear, and the label of each pose."""
    labels: list[str] = []
    index: dict[str, int] = {}
    pose = []
    for label in names:
        if not label or label not in index:
            index[label] = len(labels)
            labels.append(label)
        pose.append(index[label])
    return np.array(pose, dtype=np.intp), tuple(labels)


def _shared_readings(
    table: Table, legs: Sequence[Leg], pose: IntArray, readings: Array, sigma_q: Array
) -> Array:
    """Replace the readings of each pose by their mean."""
    motors = legs_with_readings(legs)
    labels = table.text("pose")
    shared = readings.copy()
    for p in np.unique(pose):
        members = np.flatnonzero(pose == p)
        if len(members) == 1:
            continue
        first = int(members[0])
        spread = np.ptp(readings[members], axis=0)
        for j in np.flatnonzero(spread > MAX_READING_SPREAD * sigma_q).tolist():
            most, unit = MAX_READING_SPREAD, motors[j].reading_unit
            table.refuse(
                first,
                f"readings of its {len(members)} rows that differ by {spread[j]:.3g} {unit}",
                f"one reading within {most:g} sigma ({most * sigma_q[j]:.3g} {unit})",
                str(motors[j].prismatic),
                remedy="give rows of different poses different labels",
                what=f"pose {labels[first]}",
            )
        # fsum rounds once, so that the mean does not depend on the order of the rows.
        shared[members] = [math.fsum(c) / len(members) for c in readings[members].T.tolist()]
    return shared
