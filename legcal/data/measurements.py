"""The table ``measurements.csv``: for every image its view, its pose and the readings.

The header is ``view,image,<actuated joint>,...`` with an optional ``pose``, in any order.
Readings are in metres. Rows with the same pose label, in any view, share one platform pose
and one reading (their mean); a row without a label is a pose of its own. Tables of what images
show name their rows by view and image, see :func:`row_names`.
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

MAX_NAMED = 5  # views or other things, in one sentence
# Of the travel, and in standard deviations: readings outside by less are within it but for rounding
# and noise.
ROUNDED, NOISY = 1e-3, 3.0
MANY, FEWEST = 0.25, 2  # of the rows: where so many are outside, it may be for one cause
MAX_READING_SPREAD = 10.0  # sigma by which rows of one pose may differ
INCH = 0.0254  # [m]
# Parts of the travel: in the unit that is stated, and in another that may be, or surely is, meant
HARDLY_MOVES, MAY_MOVE, SURELY_MOVES = 0.02, 0.2, 0.5
WOULD_MOVE = 0.05  # what readings outside the travel would use of it in what they are taken for
MIN_POSES = 5  # different ones, as an arm needs (6'): fewer are a check, and may be near each other
USUAL_PULSES = (400.0, 2700.0)  # [us], of hobby servos
_TEXTS = ("view", "image", "pose")  # columns
_MAX_SHOWN = 3  # readings quoted in a sentence about many


@dataclass(frozen=True, eq=False)
class View:
    """One position of a calibrated camera."""

    name: str  # in dataset.yaml
    camera: Camera
    T_base_camera: RigidTransform | None = None  # rough: good to 2 cm and 2 degrees
    legs: tuple[str, ...] | None = None  # use only these legs in this view; None for all
    hand_held: bool = False  # one image of a camera in the hand, which only the board can place
    by_landmarks: bool = False  # whether the rough pose is that of clicks on joints

    def uses(self, leg: str) -> bool:
        """Say whether a leg, by its name, is to be used in this view."""
        return self.legs is None or leg in self.legs


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
    # (n_rows, n_legs) readings [m], of rods on actuators those of the actuator [m or rad]; zero for
    # other constant-length legs, NaN for passive ones
    q: Array
    sigma_q: float  # of a reading [m]
    pose_labels: tuple[str, ...] = ()  # of each pose, "" without; empty without that column
    sigma_by_joint: Mapping[str, float] = field(default_factory=dict)  # where stated [m or rad]

    @property
    def n_rows(self) -> int:
        """Number of images."""
        return len(self.image)

    @property
    def first_rows(self) -> IntArray:
        """The first row of every pose, (n_poses,): its reading is that of the pose."""
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
        """The views whose rough poses are those of clicks on joints."""
        return tuple(view.name for view in self.views if view.by_landmarks)

    def sigma_of(self, legs: Sequence[Leg]) -> Array:
        """Return the standard deviation of the reading of each leg, (n_legs,) [m or rad]."""
        return sigmas_of_legs(legs, self.sigma_q, self.sigma_by_joint)


def row_names(measurements: Measurements) -> tuple[str, ...]:
    """Return what the image column of other tables calls each row of the measurements."""
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
    """Return the row of the measurements that each row of a table names, -1 where unknown."""
    index = {place: row for row, place in enumerate(places(measurements))}
    found = zip(table.text("view"), table.text("image"), strict=True)
    return np.array([index.get(place, -1) for place in found], dtype=np.intp)


def refuse_unknown_rows(table: Table, row: IntArray, measurements: Measurements) -> None:
    """Refuse rows of a table of which :func:`find_rows` knew none."""
    names = places(measurements)
    views = list(dict.fromkeys(view for view, _ in names))
    found = list(zip(table.text("view"), table.text("image"), strict=True))
    for i in np.flatnonzero(row < 0).tolist():
        view, image = found[i]
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
    """Refuse rows of a table of which :func:`find_legs` knew none."""
    names = table.text("leg")
    for i in np.flatnonzero(leg < 0).tolist():
        found, remedy = f"the unknown leg {describe(names[i])}", closest(names[i], leg_names)
        table.refuse(i, found, "a leg of the mechanism", "leg", remedy=remedy)


def few(names: Sequence[str]) -> str:
    """Return names one after the other, not more than a few: ``c1, c2 and 3 more``."""
    more = len(names) - MAX_NAMED
    return ", ".join(names[:MAX_NAMED]) + f" and {more} more" * (more > 0)


def few_views(names: Sequence[str]) -> str:
    """Return views as a sentence names them: ``views c1, c2``, not more than a few."""
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
    """Return the motors whose readings a table leaves empty in all of its rows.

    What else is wrong with the table is no concern of this.
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

    Readings outside their travel by more than 5 % of it are refused, others are noted if it is more
    than rounding and noise. Refused is as well what hardly moves in its unit and makes use of the
    travel in a larger one; where that is not sure, as of few poses, it is noted. *units* and
    standard deviations *sigma* (n_motors,) are those of a dataset; without units, tables are in m
    and rad.
    """
    actuated = legs_with_readings(legs)
    noise = np.zeros(len(actuated)) if sigma is None else NOISY * sigma
    given = table.numbers(str(leg.prismatic) for leg in actuated)
    stated = [(units or {}).get(str(leg.prismatic), default_unit(leg)) for leg in actuated]
    readings = np.empty_like(given)
    for j, unit in enumerate(stated):
        readings[:, j] = unit.values(given[:, j])
    notes = []
    beyond: list[tuple[str, str, bool]] = []  # column, what was found of it, whether of many rows
    each = zip(actuated, stated, given.T, readings.T, noise.tolist(), strict=True)
    for leg, one, numbers, column, of_noise in each:
        lower, upper = leg.travel
        if not 0.0 < upper - lower < np.inf:
            continue
        beyond_travel = np.maximum(lower - column, column - upper)
        outside = beyond_travel > max(ROUNDED * (upper - lower), of_noise)
        far = (beyond_travel > 0.0) & ~leg.in_travel(column)
        unit_name, ends = one.name, sorted(map(one.reading, leg.travel))
        travel = f"{ends[0]:g} to {ends[1]:g} {unit_name} (the joint limits of the model)"
        if np.any(far):
            found = (
                f"found {_some(table, numbers, far, unit_name)}, needed {travel} with a margin of "
            )
            found += f"{TRAVEL_MARGIN:.0%}"
            n = len(column)
            many = np.count_nonzero(far) >= max(MANY * n, min(FEWEST, n))
            beyond.append((str(leg.prismatic), found, bool(many)))
        elif np.any(outside):
            notes.append(
                f"{table.path}, column {leg.prismatic}: readings are a little outside the travel "
                f"{travel}: {_some(table, numbers, outside, unit_name)}."
            )
    often = [name for name, _, most in beyond if most]
    cause = ""
    if often:
        # whatever is outside lies inside once divided by enough: there it has to move, too
        wrong = [j for j, leg in enumerate(actuated) if str(leg.prismatic) in often]
        every = list(range(len(actuated)))
        tries = (every, WOULD_MOVE), (wrong, WOULD_MOVE), (wrong, 0.0), (every, 0.0)
        for some, least in tries:
            cause = cause or _likely_cause(
                given[:, some],
                [actuated[j] for j in some],
                [stated[j] for j in some],
                in_dataset=units is not None,
                least=least,
            )
    alike = often if cause else []
    for name, found, _ in beyond:
        if name in alike[1:]:
            continue
        of_this, remedy = [name], "correct the readings or the limits"
        if name in alike:
            remedy = cause
            if len(alike) > 1:
                of_this, found = alike, f"in {name} {found}"
        table.refuse_file(
            Problem(
                f"readings are outside the travel: {found}",
                remedy=remedy,
                file=str(table.path),
                columns=tuple(of_this),
            )
        )
    if not beyond:
        for doubt in doubted_units(given, readings, actuated, stated):
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
    """A unit in which readings hardly move, and a larger one in which they use the travel."""

    columns: tuple[str, ...]
    uses: str  # which part of the travel they use in either unit, in words
    stated: str  # the unit
    other: str  # the larger one
    is_sure: bool

    def problem(self, path: Path, remedy: str) -> Problem:
        """Return what refuses it."""
        return Problem(
            "the unit of the readings could not be decided",
            f"that they {self.uses}",
            "the unit in which they are",
            remedy,
            str(path),
            columns=self.columns,
        )


def doubted_units(
    given: Array, readings: Array, legs: Sequence[Leg], units: Sequence[ReadingUnit]
) -> list[DoubtedUnit]:
    """Return which columns hardly move in their unit and do in a larger one, and whether surely.

    The largest units are never doubted, so that small motions can always be written in them.
    """
    found = list[DoubtedUnit]()
    n_poses = len(np.unique(given, axis=0))
    for name in dict.fromkeys(unit.name for unit in units):
        some = [j for j, unit in enumerate(units) if unit.name == name]
        width = np.ptp([legs[j].travel for j in some], axis=1)
        sizes = ANGLE if legs[some[0]].reads_angle else LENGTH
        if not n_poses or name not in sizes or not np.all((width > 0.0) & np.isfinite(width)):
            continue
        used = float(np.max(np.ptp(readings[:, some], axis=0) / width))
        for other, size in sizes.items():
            meant = size * given[:, some]
            moved = float(np.mean(np.ptp(meant, axis=0) / width))
            if used >= HARDLY_MOVES or moved <= MAY_MOVE or size <= sizes[name]:
                continue
            if not np.all(in_travel(meant, [legs[j] for j in some])):
                continue
            columns = tuple(str(legs[j].prismatic) for j in some)
            uses = (
                f"use {100 * used:.2g} % of the travel in {name}, which is stated, and "
                f"{100 * moved:.2g} % in {other}"
            )
            is_sure = n_poses >= MIN_POSES and moved > SURELY_MOVES
            found.append(DoubtedUnit(columns, uses, name, other, is_sure))
            break
    return found


def _likely_cause(
    given: Array,
    legs: Sequence[Leg],
    units: Sequence[ReadingUnit],
    *,
    in_dataset: bool,
    least: float = 0.0,
) -> str:
    """Return what readings (n_rows, n_legs) look like, and the remedy; "" where it is not clear.

    Of what would bring all of them into their travel, that with which they move in it most, and
    more than a part of it. They are as the table has them, in *units*.
    """
    groups = dict.fromkeys(
        (leg.reads_angle, unit.name) for leg, unit in zip(legs, units, strict=True)
    )
    if len(groups) > 1:
        for group in sorted(groups, reverse=True):
            some = [j for j, unit in enumerate(units) if (legs[j].reads_angle, unit.name) == group]
            chosen = [[of[j] for j in some] for of in (legs, units)]
            cause = _likely_cause(
                given[:, some],
                *chosen,  # type: ignore[arg-type]
                in_dataset=in_dataset,
                least=least,
            )
            if cause:
                return cause
        return ""
    name = units[0].name
    if legs[0].reads_angle:
        tried = _as_angles(given, legs, units, in_dataset)
    elif name == "m":
        tried = _as_lengths(given, legs)
    else:
        tried = tuple(
            (size * given, f"{other}: write readings: {other}")
            for other, size in LENGTH.items()
            if other != name
        )
    width = np.ptp([leg.travel for leg in legs], axis=1)
    found, most = "", least
    for meant, what in tried:
        moved = float(np.mean(np.ptp(meant, axis=0) / width))
        if moved > most and np.all(in_travel(meant, legs)):
            found, most = f"these look like {what}", moved
    low, high = USUAL_PULSES
    if (
        not found
        and legs[0].reads_angle
        and name != PULSES
        and np.all((given > low) & (given < high))
    ):
        found = "these look like pulses of servos in us: "
        found += (
            f"write readings: {{{legs[0].prismatic}: {{unit: us, centre_us: 1500, us_per_deg: "
            "11.1}, ...} in the dataset file, with the numbers of your servos"
            if in_dataset
            else "convert them to radians"
        )
    return found


def _as_angles(
    given: Array, legs: Sequence[Leg], units: Sequence[ReadingUnit], in_dataset: bool
) -> tuple[tuple[Array, str], ...]:
    """Return what readings of motors that turn may be meant as, and how that is said."""
    name, degrees = units[0].name, np.degrees(1.0)

    def write(unit: str) -> str:
        return f"write readings: {unit} in the dataset file"

    angles = np.column_stack([u.values(x) for u, x in zip(units, given.T, strict=True)])
    pulses = [leg.actuator.pulses if leg.actuator is not None else None for leg in legs]
    found: list[tuple[Array, str]] = []
    if name == "rad":
        or_write = f", or {write('deg')}" if in_dataset else ""
        found += [
            (given / degrees, f"degrees: multiply them by pi/180{or_write}"),
            (-given / degrees, "degrees with the opposite sign: multiply them by -pi/180"),
            (given * degrees, "radians divided by 180/pi once too often: multiply by 180/pi"),
        ]
    else:
        found.append((given, f"radians: {write('rad')}"))
        if name == PULSES:
            found.append((given / degrees, f"degrees: {write('deg')}"))
    if name != PULSES and all(pulses):
        meant = [p.angles(x) for p, x in zip(pulses, given.T, strict=True) if p is not None]
        remedy = write(PULSES) if in_dataset else "convert them to radians"
        found.append((np.column_stack(meant), f"pulses of servos in us: {remedy}"))
    reverse = "reverse them" if name != PULSES else "give us_per_deg the other sign"
    return (*found, (-angles, f"readings with the opposite sign: {reverse}"))


def _as_lengths(readings: Array, legs: Sequence[Leg]) -> tuple[tuple[Array, str], ...]:
    """Return what readings in metres may be meant as, and how that is said."""
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
    each = zip(legs, lengths.T, strict=True)
    return np.array([leg.readings_at(column) for leg, column in each]).T


def in_travel(readings: Array, legs: Sequence[Leg]) -> BoolArray:
    """Return which readings (n_rows, n_legs) [m] are in the travel of their legs, or nearly."""
    each = zip(legs, readings.T, strict=True)
    return np.array([leg.in_travel(column) for leg, column in each], dtype=np.bool_).T


def _some(table: Table, column: Array, chosen: BoolArray, unit: str) -> str:
    """Return the first of some readings with their rows, and how many more there are."""
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

    Images are relative to ``folder``; whether they exist is not looked at. Columns of *unread*
    motors, which are empty, are not those of a leg with a reading. Raises DatasetError with one
    sentence for each thing that is wrong.
    """
    texts = [
        *(Column(name, "text", required=name != "pose") for name in _TEXTS),
        *(Column(name, "text", blank=True) for name in unread),
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
            found, remedy = f"the unknown view {describe(name)}", closest(name, view_index)
            table.refuse(row, found, "a view of the dataset file", "view", remedy=remedy)
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
    targets: dict[str, Path | str] = {}  # of each image, or what is wrong with it
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
            found = f"it also in {table.places[earlier]}"
            needed, remedy = "one row an image", "remove one of them"
            table.refuse(row, found, needed, "image", remedy=remedy, what=f"image {image}")


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
    """Return the readings with those of one pose replaced by their mean."""
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
