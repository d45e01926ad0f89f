"""The table ``measurements.csv``: for every image its view, its pose and the readings.

The header is ``view,image,<actuated joint>,...`` with an optional ``pose``, in any order.
Readings are in metres. Rows with the same pose label, in any view, share one platform pose
and one reading (their mean); a row without a label is a separate pose. Tables of observations
name their rows by view and image, see :func:`row_names`.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from types import MappingProxyType
from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import RigidTransform

from legcal.brief import brief
from legcal.data.reading_units import (
    PULSES,
    ReadingUnit,
    default_unit,
    legs_with_readings,
    sigmas_of_legs,
)
from legcal.errors import DatasetError, Problem
from legcal.files.folder import path_problem
from legcal.files.quantity import ANGLE, LENGTH
from legcal.files.schema import closest, describe
from legcal.files.table import Column, Table, read_table
from legcal.geometry.types import Array, BoolArray, IntArray
from legcal.machine.leg import TRAVEL_MARGIN, Leg
from legcal.vision.camera import Camera

MAX_NAMED = 5  # maximum number of names in one sentence
# Fraction of the travel, and standard deviations: readings outside by less are within the travel
# but for rounding and noise.
ROUNDED, NOISY = 1e-3, 3.0
# Minimum fraction and number of rows outside the travel for a search of a common cause
MANY, FEWEST = 0.25, 2
MAX_READING_SPREAD = 10.0  # maximum difference [sigma] between rows of one pose
INCH = 0.0254  # [m]
# Fractions of the travel in use: in the stated unit, and in another possible, or certain, unit
HARDLY_MOVES, MAY_MOVE, SURELY_MOVES = 0.02, 0.2, 0.5
WOULD_MOVE = 0.05  # minimum fraction of the travel that corrected readings would use
MIN_POSES = 5  # different poses, as an arm needs (6'): fewer are a check, perhaps close together
USUAL_PULSES = (400.0, 2700.0)  # [us] range of hobby servos
_TEXTS = ("view", "image", "pose")  # columns
_MAX_SHOWN = 3  # readings quoted in a sentence about many


@dataclass(frozen=True, eq=False)
class View:
    """One position of a calibrated camera."""

    name: str  # in dataset.yaml
    camera: Camera
    T_base_camera: RigidTransform | None = None  # rough: good to 2 cm and 2 degrees
    legs: tuple[str, ...] | None = None  # use only these legs in this view; None for all
    hand_held: bool = False  # one image of a hand-held camera, which only the board can place
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
    sigma_q: float  # of a reading [m]
    pose_labels: tuple[str, ...] = ()  # label of each pose, or ""; empty without that column
    sigma_by_joint: Mapping[str, float] = field(default_factory=dict)  # where stated [m or rad]
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
    def clicked_views(self) -> tuple[str, ...]:
        """The views with a rough pose from clicks on joints."""
        return tuple(view.name for view in self.views if view.by_landmarks)

    def sigma_of(self, legs: Sequence[Leg]) -> Array:
        """Return the standard deviation of the reading of each leg, (n_legs,) [m or rad]."""
        return sigmas_of_legs(legs, self.sigma_q, self.sigma_by_joint)


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


def find_rows(table: Table, measurements: Measurements) -> IntArray:
    """Return for each row of a table the row of the measurements, -1 where unknown."""
    index = {place: row for row, place in enumerate(places(measurements))}
    named = zip(table.text("view"), table.text("image"), strict=True)
    return np.array([index.get(place, -1) for place in named], dtype=np.intp)


def refuse_unknown_rows(table: Table, row: IntArray, measurements: Measurements) -> None:
    """Refuse rows of a table with an image unknown to :func:`find_rows`."""
    names = places(measurements)
    views = list(dict.fromkeys(view for view, _ in names))
    named = list(zip(table.text("view"), table.text("image"), strict=True))
    for i in np.flatnonzero(row < 0).tolist():
        view, image = named[i]
        if view not in views:
            unknown, remedy = f"the unknown view {describe(view)}", closest(view, views)
            table.refuse(i, unknown, "a view with measurements", "view", remedy=remedy)
        else:
            near = closest(image, [name for v, name in names if v == view])
            needed = f"an image of view {view} in the measurements"
            table.refuse(i, describe(image), needed, "image", remedy=near)


def find_legs(table: Table, leg_names: Sequence[str]) -> IntArray:
    """Return the leg that each row of a table names, -1 where unknown."""
    index = {name: j for j, name in enumerate(leg_names)}
    return np.array([index.get(name, -1) for name in table.text("leg")], dtype=np.intp)


def refuse_unknown_legs(table: Table, leg: IntArray, leg_names: Sequence[str]) -> None:
    """Refuse rows of a table with a leg unknown to :func:`find_legs`."""
    names = table.text("leg")
    for i in np.flatnonzero(leg < 0).tolist():
        unknown, remedy = f"the unknown leg {describe(names[i])}", closest(names[i], leg_names)
        table.refuse(i, unknown, "a leg of the mechanism", "leg", remedy=remedy)


def few(names: Sequence[str]) -> str:
    """Return a list of at most a few names: ``c1, c2 and 3 more``."""
    more = len(names) - MAX_NAMED
    return ", ".join(names[:MAX_NAMED]) + f" and {more} more" * (more > 0)


def few_views(names: Sequence[str]) -> str:
    """Return views in words, at most a few names: ``views c1, c2``."""
    return f"view{'s' * (len(names) > 1)} {few(names)}"


def reading_columns(
    legs: Sequence[Leg], units: Mapping[str, ReadingUnit] = MappingProxyType({})
) -> list[Column]:
    """Return the columns of readings of the motors, in the order of the legs."""
    return [
        Column(
            str(leg.prismatic),
            what="reading",
            unit=units.get(str(leg.prismatic), default_unit(leg)).words,
        )
        for leg in legs_with_readings(legs)
    ]


def unread_motors(path: Path, legs: Sequence[Leg]) -> tuple[str, ...]:
    """Return the motors with empty readings in all rows of a table.

    Other problems of the table are ignored here.
    """
    motors = [str(leg.prismatic) for leg in legs_with_readings(legs)]
    others = [Column(name, "text", blank=True, required=False) for name in _TEXTS]
    columns = [Column(name, "text", blank=True, required=False) for name in motors]
    try:
        table = read_table(path, "table of measurements", "row", [*others, *columns])
    except DatasetError:
        return ()
    return tuple(
        name for name in motors if name in table and len(table) and not any(table.text(name))
    )


def readings_in(
    table: Table,
    legs: Sequence[Leg],
    units: Mapping[str, ReadingUnit] | None = None,
    sigma: Array | None = None,
) -> tuple[Array, tuple[str, ...]]:
    """Return the readings in a table (n_rows, n_motors) [m or rad], and notes on odd ones.

    Readings outside their travel by more than 5 % of it are refused; smaller excesses are noted if
    they exceed rounding and noise. Readings that hardly move in their unit but use the travel in a
    larger unit are refused as well, or noted where that is uncertain, as with few poses. *units*
    and standard deviations *sigma* (n_motors,) come from a dataset; without units, tables are in m
    and rad.
    """
    actuated = legs_with_readings(legs)
    noise = np.zeros(len(actuated)) if sigma is None else NOISY * sigma
    values = table.numbers(str(leg.prismatic) for leg in actuated)
    stated = [(units or {}).get(str(leg.prismatic), default_unit(leg)) for leg in actuated]
    readings = np.empty_like(values)
    for j, unit in enumerate(stated):
        readings[:, j] = unit.values(values[:, j])
    notes = []
    beyond: list[tuple[str, str, bool]] = []  # column, its values in words, whether in many rows
    motor_columns = zip(actuated, stated, values.T, readings.T, noise.tolist(), strict=True)
    for leg, unit_of_motor, numbers, column, of_noise in motor_columns:
        lower, upper = leg.travel
        if not 0.0 < upper - lower < np.inf:
            continue
        beyond_travel = np.maximum(lower - column, column - upper)
        outside = beyond_travel > max(ROUNDED * (upper - lower), of_noise)
        far = (beyond_travel > 0.0) & ~leg.in_travel(column)
        unit_name, ends = unit_of_motor.name, sorted(map(unit_of_motor.reading, leg.travel))
        travel = f"{ends[0]:g} to {ends[1]:g} {unit_name} (the joint limits of the model)"
        if np.any(far):
            actual = (
                f"found {_some(table, numbers, far, unit_name)}, needed {travel} with a margin of "
            )
            actual += f"{TRAVEL_MARGIN:.0%}"
            n = len(column)
            many = np.count_nonzero(far) >= max(MANY * n, min(FEWEST, n))
            beyond.append((str(leg.prismatic), actual, bool(many)))
        elif np.any(outside):
            notes.append(
                f"{table.path}, column {leg.prismatic}: readings are a little outside the travel "
                f"{travel}: {_some(table, numbers, outside, unit_name)}."
            )
    often = [name for name, _, most in beyond if most]
    cause = ""
    if often:
        # A large divisor brings any readings into the travel: they must also move there.
        wrong = [j for j, leg in enumerate(actuated) if str(leg.prismatic) in often]
        all_motors = list(range(len(actuated)))
        tries = (all_motors, WOULD_MOVE), (wrong, WOULD_MOVE), (wrong, 0.0), (all_motors, 0.0)
        for some, least in tries:
            cause = cause or _likely_cause(
                values[:, some],
                [actuated[j] for j in some],
                [stated[j] for j in some],
                in_dataset=units is not None,
                least=least,
            )
    alike = often if cause else []
    for name, actual, _ in beyond:
        if name in alike[1:]:
            continue
        of_this, remedy = [name], "correct the readings or the limits"
        if name in alike:
            remedy = cause
            if len(alike) > 1:
                of_this, actual = alike, f"in {name} {actual}"
        table.refuse_file(
            Problem(
                f"readings are outside the travel: {actual}",
                remedy=remedy,
                file=str(table.path),
                columns=tuple(of_this),
            )
        )
    if not beyond:
        for doubt in doubted_units(values, readings, actuated, stated):
            if doubt.is_sure:
                remedy = (
                    f"write readings: {doubt.other} in the dataset file, and convert them first "
                    f"if they are in {doubt.stated}"
                )
                table.refuse_file(doubt.problem(table.path, remedy))
            else:
                columns = f"column{'s' * (len(doubt.columns) > 1)} {few(doubt.columns)}"
                notes.append(f"{table.path}, {columns}: readings {doubt.uses}; check their unit.")
    return readings, tuple(notes)


class DoubtedUnit(NamedTuple):
    """A unit in which readings hardly move, and a larger unit in which they use the travel."""

    columns: tuple[str, ...]
    uses: str  # fraction of the travel in use in either unit, in words
    stated: str  # the unit
    other: str  # the larger unit
    is_sure: bool

    def problem(self, path: Path, remedy: str) -> Problem:
        """Return the problem of a table with these readings."""
        return Problem(
            "the unit of the readings could not be decided",
            f"that they {self.uses}",
            "the unit in which they are",
            remedy,
            str(path),
            columns=self.columns,
        )


def doubted_units(
    values: Array, readings: Array, legs: Sequence[Leg], units: Sequence[ReadingUnit]
) -> list[DoubtedUnit]:
    """Return the columns that hardly move in their unit but would in a larger unit.

    The largest units are never doubted, so that small motions can always be written in them.
    """
    doubts = list[DoubtedUnit]()
    n_poses = len(np.unique(values, axis=0))
    for name in dict.fromkeys(unit.name for unit in units):
        some = [j for j, unit in enumerate(units) if unit.name == name]
        width = np.ptp([legs[j].travel for j in some], axis=1)
        sizes = ANGLE if legs[some[0]].reads_angle else LENGTH
        if not n_poses or name not in sizes or not np.all((width > 0.0) & np.isfinite(width)):
            continue
        used = float(np.max(np.ptp(readings[:, some], axis=0) / width))
        for other_unit, size in sizes.items():
            meant = size * values[:, some]
            moved = float(np.mean(np.ptp(meant, axis=0) / width))
            if used >= HARDLY_MOVES or moved <= MAY_MOVE or size <= sizes[name]:
                continue
            if not np.all(in_travel(meant, [legs[j] for j in some])):
                continue
            columns = tuple(str(legs[j].prismatic) for j in some)
            uses = (
                f"use {100 * used:.2g} % of the travel in {name}, which is stated, and "
                f"{100 * moved:.2g} % in {other_unit}"
            )
            is_sure = n_poses >= MIN_POSES and moved > SURELY_MOVES
            doubts.append(DoubtedUnit(columns, uses, name, other_unit, is_sure))
            break
    return doubts


def _likely_cause(
    values: Array,
    legs: Sequence[Leg],
    units: Sequence[ReadingUnit],
    *,
    in_dataset: bool,
    least: float = 0.0,
) -> str:
    """Return the likely mistake in *values* (n_rows, n_legs) and the remedy; "" if unclear.

    Among the corrections that bring all readings into their travel, it is the one with the largest
    motion there, which must exceed the fraction *least*. The values are in *units*.
    """
    groups = dict.fromkeys(
        (leg.reads_angle, unit.name) for leg, unit in zip(legs, units, strict=True)
    )
    if len(groups) > 1:
        for group in sorted(groups, reverse=True):
            some = [j for j, unit in enumerate(units) if (legs[j].reads_angle, unit.name) == group]
            chosen = [[sequence[j] for j in some] for sequence in (legs, units)]
            cause = _likely_cause(
                values[:, some],
                *chosen,  # type: ignore[arg-type]
                in_dataset=in_dataset,
                least=least,
            )
            if cause:
                return cause
        return ""
    name = units[0].name
    if legs[0].reads_angle:
        tried = _as_angles(values, legs, units, in_dataset)
    elif name == "m":
        tried = _as_lengths(values, legs)
    else:
        tried = tuple(
            (size * values, f"{other}: write readings: {other}")
            for other, size in LENGTH.items()
            if other != name
        )
    width = np.ptp([leg.travel for leg in legs], axis=1)
    likely, most = "", least
    for meant, meaning in tried:
        moved = float(np.mean(np.ptp(meant, axis=0) / width))
        if moved > most and np.all(in_travel(meant, legs)):
            likely, most = f"these look like {meaning}", moved
    low, high = USUAL_PULSES
    if (
        not likely
        and legs[0].reads_angle
        and name != PULSES
        and np.all((values > low) & (values < high))
    ):
        likely = "these look like pulses of servos in us: "
        likely += (
            f"write readings: {{{legs[0].prismatic}: {{unit: us, centre_us: 1500, us_per_deg: "
            "11.1}, ...} in the dataset file, with the numbers of your servos"
            if in_dataset
            else "convert them to radians"
        )
    return likely


def _as_angles(
    values: Array, legs: Sequence[Leg], units: Sequence[ReadingUnit], in_dataset: bool
) -> tuple[tuple[Array, str], ...]:
    """Return possible corrections of readings of motors that turn [rad], with words for each."""
    name, degrees = units[0].name, np.degrees(1.0)

    def write(unit: str) -> str:
        return f"write readings: {unit} in the dataset file"

    angles = np.column_stack([u.values(x) for u, x in zip(units, values.T, strict=True)])
    pulses = [leg.actuator.pulses if leg.actuator is not None else None for leg in legs]
    meanings: list[tuple[Array, str]] = []
    if name == "rad":
        or_write = f", or {write('deg')}" if in_dataset else ""
        meanings += [
            (values / degrees, f"degrees: multiply them by pi/180{or_write}"),
            (-values / degrees, "degrees with the opposite sign: multiply them by -pi/180"),
            (values * degrees, "radians divided by 180/pi once too often: multiply by 180/pi"),
        ]
    else:
        meanings.append((values, f"radians: {write('rad')}"))
        if name == PULSES:
            meanings.append((values / degrees, f"degrees: {write('deg')}"))
    if name != PULSES and all(pulses):
        meant = [p.angles(x) for p, x in zip(pulses, values.T, strict=True) if p is not None]
        remedy = write(PULSES) if in_dataset else "convert them to radians"
        meanings.append((np.column_stack(meant), f"pulses of servos in us: {remedy}"))
    reverse = "reverse them" if name != PULSES else "give us_per_deg the other sign"
    return (*meanings, (-angles, f"readings with the opposite sign: {reverse}"))


def _as_lengths(readings: Array, legs: Sequence[Leg]) -> tuple[tuple[Array, str], ...]:
    """Return possible corrections of readings in metres, with words for each."""
    whole = "subtract the leg lengths at reading zero (legcal inspect tells them)"
    return (
        (LENGTH["mm"] * readings, "millimetres: divide them by 1000"),
        (readings_of_lengths(readings, legs), f"whole leg lengths: {whole}"),
        (
            readings_of_lengths(LENGTH["mm"] * readings, legs),
            f"whole leg lengths in millimetres: divide them by 1000, and {whole}",
        ),
        (LENGTH["cm"] * readings, "centimetres: divide them by 100"),
        (INCH * readings, "inches: multiply them by 0.0254"),
        (-readings, "readings with the opposite sign: reverse them"),
    )


def readings_of_lengths(lengths: Array, legs: Sequence[Leg]) -> Array:
    """Return the readings (n_rows, n_legs) of whole leg lengths (n_rows, n_legs) [m]."""
    columns = zip(legs, lengths.T, strict=True)
    return np.array([leg.readings_at(column) for leg, column in columns]).T


def in_travel(readings: Array, legs: Sequence[Leg]) -> BoolArray:
    """Return a mask of the readings (n_rows, n_legs) [m] in the travel of their legs, or nearly."""
    columns = zip(legs, readings.T, strict=True)
    return np.array([leg.in_travel(column) for leg, column in columns], dtype=np.bool_).T


def _some(table: Table, column: Array, chosen: BoolArray, unit: str) -> str:
    """Return the first of some readings with their rows, and the number of further ones."""
    index = np.flatnonzero(chosen).tolist()
    places = table.places
    shown = ", ".join(f"{column[i]:g} {unit} in {places[i]}" for i in index[:_MAX_SHOWN])
    return shown + (f" and {len(index) - _MAX_SHOWN} more" if len(index) > _MAX_SHOWN else "")


def read_measurements(
    path: Path,
    folder: Path,
    views: Sequence[View],
    legs: Sequence[Leg],
    sigma_q: float,
    sigma_by_joint: Mapping[str, float] = MappingProxyType({}),
    units: Mapping[str, ReadingUnit] = MappingProxyType({}),
    unread: Collection[str] = (),
) -> tuple[Measurements, tuple[str, ...]]:
    """Return the table ``measurements.csv`` in the order of the file, and notes on odd readings.

    Images are relative to ``folder``; their existence is not checked. Columns of *unread* motors
    are empty: *legs* have no readings of these. Raises DatasetError with one sentence for each
    problem.
    """
    texts = [
        *(Column(name, "text", required=name != "pose") for name in _TEXTS),
        *(Column(name, "text", blank=True) for name in unread),
        Column("time", unit="seconds", required=False, blank=True),
    ]
    table = read_table(
        path,
        "table of measurements",
        "row",
        [*texts, *reading_columns(legs, units)],
        needed="one row for each image; record measurements",
    )
    view_index = {view.name: i for i, view in enumerate(views)}
    view_names, images = table.text("view"), table.text("image")
    for row, name in enumerate(view_names):
        if name not in view_index:
            unknown, remedy = f"the unknown view {describe(name)}", closest(name, view_index)
            table.refuse(row, unknown, "a view of the dataset file", "view", remedy=remedy)
    _refuse_images(table, images, folder)
    motors = legs_with_readings(legs)
    sigma = sigmas_of_legs(motors, sigma_q, sigma_by_joint)
    readings, notes = readings_in(table, legs, units, sigma)
    pose, labels = _poses(table.text("pose"))
    q = np.full((len(table), len(legs)), math.nan)
    q[:, [not leg.has_value for leg in legs]] = 0.0
    measurements = Measurements(
        views=tuple(views),
        image=images,
        view=np.array([view_index.get(name, 0) for name in view_names], dtype=np.intp),
        pose=pose,
        q=q,
        sigma_q=sigma_q,
        pose_labels=labels if "pose" in table else (),
        sigma_by_joint=sigma_by_joint,
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
    joints = [column.name for column in reading_columns(legs)]
    units = [leg.reading_unit for leg in legs_with_readings(legs)]
    labels = table.text("pose")
    shared = readings.copy()
    for p in np.unique(pose):
        members = np.flatnonzero(pose == p)
        if len(members) == 1:
            continue
        first = int(members[0])
        spread = np.ptp(readings[members], axis=0)
        for j in np.flatnonzero(spread > MAX_READING_SPREAD * sigma_q).tolist():
            most = MAX_READING_SPREAD
            table.refuse(
                first,
                f"readings of its {len(members)} rows that differ by {spread[j]:.3g} {units[j]}",
                f"one reading within {most:g} sigma ({most * sigma_q[j]:.3g} {units[j]})",
                joints[j],
                remedy="give rows of different poses different labels",
                what=f"pose {labels[first]}",
            )
        # fsum rounds once, so that the mean does not depend on the order of the rows.
        shared[members] = [math.fsum(c) / len(members) for c in readings[members].T.tolist()]
    return shared
