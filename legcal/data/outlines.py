"""Sets of outlines: chosen, joined, put in order, and corrected by hand."""

from __future__ import annotations

import csv
import io
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from legcal.data.measurements import Measurements
from legcal.errors import DatasetError
from legcal.files import closest, describe, read_named_rows, write_atomically
from legcal.geometry import Array, BoolArray, IntArray
from legcal.machine import Leg

QUALITY = ("contrast", "length", "residual")  # what tells how well an outline was seen
ENCODING = ("gamma", "by_gamma")  # what tells how an outline depends on the gamma of the camera


def _unknown() -> Array:
    return np.zeros(0)


@dataclass(frozen=True, eq=False)
class Outlines:
    """Outlines of cylinders in images, one row an outline (eqs 2, 3, 5).

    Attributes
    ----------
    row : (n,) array of int
        Index into the rows of :class:`legcal.data.measurements.Measurements`.
    leg : (n,) array of int
        Index into the legs of the mechanism.
    part : tuple of str, length n
        The URDF link of the cylinder.
    edge : (n,) array of int
        1 where epsilon of eq (5) is +1, 2 where it is -1.
    h : (n, 3) array
        Unit normal (a, b, c) of the plane through the camera centre and the outline, in the
        camera frame, signed as in eq (3): h . M = epsilon R for a leg oriented from base
        to platform. NaN for a leg that was not found.
    ends : (n, 2, 2) array
        Both ends of the used piece, in pixels of the image; the first is nearer to the base
        joint. NaN for a leg that was not found.
    covariance : (n, 2, 2) array
        Covariance of the offsets of the line, normal to itself, at these ends [px^2].
    used : (n,) array of bool
        False for rejected outlines.
    reason : tuple of str, length n
        Why an outline was rejected; "" for used ones.
    source : tuple of str, length n
        ``detected`` or ``edited``.
    contrast : (n,) array
        Median step from the background to the leg [grey levels]. This and the next two are NaN
        where nothing was found and for outlines that were given or edited; they may be left out.
    length : (n,) array
        How much of the used piece was seen on its line, without gaps [px].
    residual : (n,) array
        Robust standard deviation of its edge about the line [px].
    gamma : (n,) array
        The gamma of the camera with which it was measured. This and the next one are NaN where
        nothing was found and for outlines that were given or edited; they may be left out.
    by_gamma : (n,) array
        How far it moves towards the inside of the leg with the logarithm of that gamma [px].
    """

    row: IntArray
    leg: IntArray
    part: tuple[str, ...]
    edge: IntArray
    h: Array
    ends: Array
    covariance: Array
    used: BoolArray
    reason: tuple[str, ...]
    source: tuple[str, ...]
    contrast: Array = field(default_factory=_unknown)
    length: Array = field(default_factory=_unknown)
    residual: Array = field(default_factory=_unknown)
    gamma: Array = field(default_factory=_unknown)
    by_gamma: Array = field(default_factory=_unknown)

    def __post_init__(self) -> None:
        for name in (*QUALITY, *ENCODING):
            if len(getattr(self, name)) == 0:
                object.__setattr__(self, name, np.full(len(self.row), np.nan))

    def __len__(self) -> int:
        return len(self.row)


NUMBERS = ("a", "b", "c", "u0", "v0", "u1", "v1", "s00", "s01", "s11")
COLUMNS = ("view", "image", "leg", "part", "edge", *NUMBERS, "verdict", "reason", "source")
VERDICTS = ("used", "rejected")
SOURCES = ("detected", "edited")

UNIT_EXACT = 1e-12  # |h| as computed; it is kept as it stands
UNIT_TOLERANCE = 1e-3  # |h| as written with few digits; it is normalised


@dataclass(frozen=True)
class OutlineRow:
    """One row of the table, parsed."""

    where: str
    row: int
    leg: int
    part: str
    edge: int
    numbers: tuple[float, ...]
    used: bool
    reason: str
    source: str
    quality: tuple[float, ...]  # as QUALITY, NaN where unknown
    encoding: tuple[float, ...] = (math.nan,) * len(ENCODING)  # the same

    @property
    def key(self) -> tuple[int, int, str, int]:
        """What makes an outline one and the same."""
        return self.row, self.leg, self.part, self.edge


def place_of(
    where: str,
    cells: Mapping[str, str],
    places: Mapping[tuple[str, str], int],
    legs: Sequence[Leg],
) -> tuple[tuple[int, int], list[str]]:
    """Return image row and leg of an outline, and the names among its cells that are unknown."""
    (row, leg), unknown = place_in_measurements(
        where, cells, places, [leg.name for leg in legs], "outline"
    )
    if leg >= 0:
        parts = [cylinder.link for cylinder in legs[leg].cylinders]
        if cells["part"] not in parts:
            unknown.append(
                f"{where}, column part: the outline could not be used: found the unknown part "
                f"{describe(cells['part'])}, needed a link with a cylinder of {cells['leg']}; "
                f"{closest(cells['part'], parts)}"
            )
    return (row, leg), unknown


def place_in_measurements(
    where: str,
    cells: Mapping[str, str],
    places: Mapping[tuple[str, str], int],
    leg_names: Sequence[str],
    thing: str,
) -> tuple[tuple[int, int], list[str]]:
    """Return image row and leg that a table's row names, -1 where unknown, and what is unknown."""
    row, unknown = row_in_measurements(where, cells, places, thing)
    leg = list(leg_names).index(cells["leg"]) if cells["leg"] in leg_names else -1
    if leg < 0:
        unknown.append(
            f"{where}, column leg: the {thing} could not be used: found the unknown leg "
            f"{describe(cells['leg'])}, needed a leg of the mechanism; "
            f"{closest(cells['leg'], leg_names)}"
        )
    return (row, leg), unknown


def row_in_measurements(
    where: str, cells: Mapping[str, str], places: Mapping[tuple[str, str], int], thing: str
) -> tuple[int, list[str]]:
    """Return the image row that a table's row names, -1 if unknown, and what is unknown."""
    start = f"the {thing} could not be used: found"
    unknown = []
    view, image = cells["view"], cells["image"]
    views = dict.fromkeys(v for v, _ in places)
    if view not in views:
        unknown.append(
            f"{where}, column view: {start} the unknown view {describe(view)}, needed a view with "
            f"measurements; {closest(view, views)}"
        )
    elif (view, image) not in places:
        unknown.append(
            f"{where}, column image: {start} {describe(image)}, needed an image of view {view} in "
            f"the measurements; {closest(image, [i for v, i in places if v == view])}"
        )
    return places.get((view, image), -1), unknown


def parse_row(
    where: str, cells: Mapping[str, str], place: tuple[int, int], problems: list[str]
) -> OutlineRow | None:
    """Return one parsed row; None, with its problems added, if a cell is wrong."""
    wrong = [
        f"{where}, column {name}: the outline could not be used: found {describe(cells[name])}, "
        f"needed {' or '.join(allowed)}; correct it."
        for name, allowed in (("edge", ("1", "2")), ("verdict", VERDICTS), ("source", SOURCES))
        if cells[name] not in allowed
    ]
    used = cells["verdict"] == "used"
    numbers = [number_in(cells[name]) for name in NUMBERS]
    wrong += [
        f"{where}, column {name}: the outline could not be used: found "
        f"{describe(cells[name]) if cells[name] else 'an empty cell'}, needed a finite number; "
        "correct it or set the verdict to rejected with an empty cell."
        for name, x in zip(NUMBERS, numbers, strict=True)
        if not math.isfinite(x) and (used or cells[name])
    ]
    if not wrong and used:
        wrong = _number_problems(where, numbers)
    quality = [number_in(cells.get(name, "")) for name in QUALITY]
    wrong += [
        f"{where}, column {name}: the outline could not be used: found {describe(cells[name])}, "
        "needed a number from 0 on, or an empty cell; correct it or leave it empty."
        for name, x in zip(QUALITY, quality, strict=True)
        if cells.get(name) and not (math.isfinite(x) and x >= 0.0)
    ]
    encoding = [number_in(cells.get(name, "")) for name in ENCODING]
    wrong += _encoding_problems(where, cells, encoding)
    if cells["source"] == "edited":  # they tell of what detection found
        quality, encoding = [math.nan] * len(QUALITY), [math.nan] * len(ENCODING)
    problems += wrong
    if wrong:
        return None
    norm = math.hypot(*numbers[:3])
    if abs(norm - 1.0) > UNIT_EXACT:  # also false for NaN and zero norms below
        numbers[:3] = [x / norm if norm else math.nan for x in numbers[:3]]
    return OutlineRow(
        where,
        *place,
        cells["part"],
        int(cells["edge"]),
        tuple(numbers),
        used,
        cells["reason"],
        cells["source"],
        tuple(quality),
        tuple(encoding),
    )


def _encoding_problems(
    where: str, cells: Mapping[str, str], encoding: Sequence[float]
) -> list[str]:
    """Return what is wrong with the cells that tell of the gamma of the camera."""
    gamma, by_gamma = encoding
    problems = [
        f"{where}, column {name}: the outline could not be used: found {describe(cells[name])}, "
        f"needed {needed}, or an empty cell; correct it or leave it empty."
        for name, is_good, needed in (
            ("gamma", math.isfinite(gamma) and gamma > 0.0, "a number above 0"),
            ("by_gamma", math.isfinite(by_gamma), "a finite number"),
        )
        if cells.get(name) and not is_good
    ]
    if not problems and bool(cells.get("gamma")) != bool(cells.get("by_gamma")):
        problems.append(
            f"{where}, columns gamma, by_gamma: the outline could not be used: found one of them, "
            "needed both or none; correct them."
        )
    return problems


def number_in(text: str) -> float:
    """Return the number in a cell, NaN if there is none."""
    try:
        return float(text) if "_" not in text else math.nan
    except ValueError:
        return math.nan


def _number_problems(where: str, numbers: Sequence[float]) -> list[str]:
    """Return what is wrong with the finite numbers of a used outline."""
    start = "the outline could not be used: found"
    a, b, c, u0, v0, u1, v1, s00, s01, s11 = numbers
    problems = []
    norm = math.hypot(a, b, c)
    if abs(norm - 1.0) > UNIT_TOLERANCE:
        problems.append(
            f"{where}, columns a, b, c: {start} a vector of norm {norm:.6g}, needed a unit vector; "
            "divide the three by their norm."
        )
    if (u0, v0) == (u1, v1):
        problems.append(
            f"{where}, columns u0 to v1: {start} both ends at the same pixel, needed two ends of "
            "a piece of the edge; correct them."
        )
    if not (s00 > 0.0 and s11 > 0.0 and s00 * s11 > s01 * s01):
        problems.append(
            f"{where}, columns s00, s01, s11: {start} a covariance that is not positive definite "
            f"({s00:g}, {s01:g}, {s11:g}), needed variances of the offsets at both ends [px^2]; "
            "correct them."
        )
    return problems


def rows_to_outlines(found: Sequence[OutlineRow]) -> Outlines:
    """Return parsed rows as arrays."""
    numbers = np.array([o.numbers for o in found], dtype=np.float64).reshape(-1, len(NUMBERS))
    quality = np.array([o.quality for o in found], dtype=np.float64).reshape(-1, len(QUALITY))
    encoding = np.array([o.encoding for o in found], dtype=np.float64).reshape(-1, len(ENCODING))
    return Outlines(
        row=np.array([o.row for o in found], dtype=np.intp),
        leg=np.array([o.leg for o in found], dtype=np.intp),
        part=tuple(o.part for o in found),
        edge=np.array([o.edge for o in found], dtype=np.intp),
        h=numbers[:, :3],
        ends=numbers[:, 3:7].reshape(-1, 2, 2),
        covariance=numbers[:, [7, 8, 8, 9]].reshape(-1, 2, 2),
        used=np.array([o.used for o in found], dtype=np.bool_),
        reason=tuple(o.reason for o in found),
        source=tuple(o.source for o in found),
        contrast=quality[:, 0],
        length=quality[:, 1],
        residual=quality[:, 2],
        gamma=encoding[:, 0],
        by_gamma=encoding[:, 1],
    )


LINE_TOLERANCE_PX = 5.0  # ends further from the line contradict it


def row_names(measurements: Measurements) -> tuple[str, ...]:
    """Return what the image column calls each row of the measurements.

    Parameters
    ----------
    measurements : Measurements
        The rows, in the order of the file.
    """
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


def rows_by_name(measurements: Measurements) -> dict[tuple[str, str], int]:
    """Return the row of the measurements for each view and name in the image column."""
    names = row_names(measurements)
    views = [measurements.views[v].name for v in measurements.view.tolist()]
    return {place: row for row, place in enumerate(zip(views, names, strict=True))}


def write_observations(
    path: Path, outlines: Outlines, measurements: Measurements, leg_names: Sequence[str]
) -> None:
    """Write outlines so that reading gives the same numbers, and the file complete or not at all.

    Parameters
    ----------
    path : Path
        ``observations.csv``.
    outlines : Outlines
        What to write.
    measurements : Measurements
        The rows they belong to, in the order of the file.
    leg_names : sequence of str
        The legs of the mechanism.

    Raises
    ------
    OSError
        If the file cannot be written.
    """
    write_atomically(path, format_observations(outlines, measurements, leg_names).encode())


def format_observations(
    outlines: Outlines, measurements: Measurements, leg_names: Sequence[str]
) -> str:
    """Return the text of ``observations.csv``; arguments as in :func:`write_observations`."""
    names = row_names(measurements)
    text = io.StringIO(newline="")
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow([*COLUMNS, *QUALITY, *ENCODING])
    for i in range(len(outlines)):
        row, covariance = outlines.row[i], outlines.covariance[i]
        told = [float(getattr(outlines, name)[i]) for name in (*QUALITY, *ENCODING)]
        numbers = [
            *outlines.h[i].tolist(),
            *outlines.ends[i].ravel().tolist(),
            *covariance[[0, 0, 1], [0, 1, 1]].tolist(),
        ]
        writer.writerow(
            [
                measurements.views[measurements.view[row]].name,
                names[row],
                leg_names[outlines.leg[i]],
                outlines.part[i],
                int(outlines.edge[i]),
                *map(_cell, numbers),
                VERDICTS[0 if outlines.used[i] else 1],
                outlines.reason[i],
                outlines.source[i],
                *map(_cell, told),
            ]
        )
    return text.getvalue()


def _cell(number: float) -> str:
    """Return a number as it is read back, nothing for NaN."""
    return "" if math.isnan(number) else repr(number)


def read_observations(
    path: Path,
    legs: Sequence[Leg],
    measurements: Measurements,
    *,
    skip_stale: bool = False,
) -> Outlines:
    """Read ``observations.csv``.

    (a, b, c) is normalised; the ends are put in order, nearer to the base joint first, as the
    sign of eq (3) tells it.

    Parameters
    ----------
    path : Path
        The table.
    legs : sequence of Leg
        The legs of the mechanism, for their names and visible cylinders.
    measurements : Measurements
        The rows that outlines belong to, in the order of the file.
    skip_stale : bool
        Leave out detected outlines of images, legs or parts that are no longer there, as in
        a table that legcal wrote for an earlier state of the dataset.

    Returns
    -------
    Outlines
        In the order of the file.

    Raises
    ------
    DatasetError
        With one sentence for each thing that is wrong, naming row and column.
    """
    problems: list[str] = []
    places = rows_by_name(measurements)
    found: list[OutlineRow] = []
    first: dict[tuple[int, int, str, int], str] = {}
    remedy = "delete the file to have it written again"
    optional = (*QUALITY, *ENCODING)
    rows = read_named_rows(
        path, "table of observations", COLUMNS, remedy, problems, optional=optional
    )
    for where, cells in rows:
        place, unknown = place_of(where, cells, places, legs)
        if unknown and skip_stale and cells["source"] == "detected":
            continue
        problems += unknown
        outline = parse_row(where, cells, place, problems)
        if outline is None or unknown:
            continue
        earlier = first.setdefault(outline.key, where)
        if earlier != where:
            problems.append(
                f"{where}: the outline could not be used: found the same image, leg, part and edge "
                f"in {earlier.rsplit(', ', 1)[-1]}, needed it once; remove one of them."
            )
        found.append(outline)
    if problems:
        raise DatasetError(problems)
    outlines = _ordered_ends(rows_to_outlines(found), measurements)
    problems = _line_problems(outlines, [o.where for o in found], measurements)
    if problems:
        raise DatasetError(problems)
    return outlines


def _rays(outlines: Outlines, measurements: Measurements) -> Array:
    """Return the ends of outlines on the sensor plane, (n, 2, 2)."""
    xy = np.full(outlines.ends.shape, np.nan)
    view = measurements.view[outlines.row]
    known = np.all(np.isfinite(outlines.ends), axis=(1, 2))
    for v in np.unique(view):
        chosen = (view == v) & known
        if np.any(chosen):
            xy[chosen] = measurements.views[v].camera.undistort(outlines.ends[chosen])
    return xy


def _ordered_ends(outlines: Outlines, measurements: Measurements) -> Outlines:
    """Return outlines with the end nearer to the base joint first.

    h is the moment u x P, and the ray to the second end is that to the first plus a piece of
    u, so that (second x first) . h > 0.
    """
    xy = _rays(outlines, measurements)
    rays = np.concatenate([xy, np.ones((*xy.shape[:2], 1))], axis=-1)
    swap = np.sum(np.cross(rays[:, 1], rays[:, 0]) * outlines.h, axis=-1) < 0.0
    ends = np.where(swap[:, None, None], outlines.ends[:, ::-1], outlines.ends)
    turned = outlines.covariance[:, ::-1, ::-1]
    covariance = np.where(swap[:, None, None], turned, outlines.covariance)
    return replace(outlines, ends=ends, covariance=covariance)


def _line_problems(
    outlines: Outlines, wheres: Sequence[str], measurements: Measurements
) -> list[str]:
    """Return used outlines whose ends do not lie on their line."""
    xy = _rays(outlines, measurements)
    problems = []
    for i in np.flatnonzero(outlines.used).tolist():
        camera = measurements.views[measurements.view[outlines.row[i]]].camera
        offset = float(np.abs(camera.line_offset(outlines.h[i][None], xy[i])).max())
        if not offset <= LINE_TOLERANCE_PX:
            problems.append(
                f"{wheres[i]}, columns a to v1: the outline could not be used: found ends "
                f"{offset:.3g} px from the line (a, b, c), needed at most "
                f"{LINE_TOLERANCE_PX:g} px; correct the line or its ends."
            )
    return problems


Key = tuple[int, int, str, int]


def no_outlines() -> Outlines:
    """Return an empty table."""
    none = np.zeros(0, dtype=np.intp)
    return Outlines(
        row=none,
        leg=none,
        part=(),
        edge=none,
        h=np.zeros((0, 3)),
        ends=np.zeros((0, 2, 2)),
        covariance=np.zeros((0, 2, 2)),
        used=np.zeros(0, dtype=np.bool_),
        reason=(),
        source=(),
    )


def outline_keys(outlines: Outlines) -> list[Key]:
    """Return what makes each outline one and the same: image row, leg, part and edge."""
    return list(
        zip(
            outlines.row.tolist(),
            outlines.leg.tolist(),
            outlines.part,
            outlines.edge.tolist(),
            strict=True,
        )
    )


def choose_outlines(outlines: Outlines, chosen: BoolArray | IntArray) -> Outlines:
    """Return some of the outlines.

    Parameters
    ----------
    outlines : Outlines
        The table.
    chosen : (n,) array of bool, or (m,) array of int
        Which rows of the table, or their indices in a new order.
    """
    index = np.flatnonzero(chosen) if chosen.dtype == np.bool_ else chosen
    return Outlines(
        row=outlines.row[index],
        leg=outlines.leg[index],
        part=tuple(outlines.part[i] for i in index.tolist()),
        edge=outlines.edge[index],
        h=outlines.h[index],
        ends=outlines.ends[index],
        covariance=outlines.covariance[index],
        used=outlines.used[index],
        reason=tuple(outlines.reason[i] for i in index.tolist()),
        source=tuple(outlines.source[i] for i in index.tolist()),
        contrast=outlines.contrast[index],
        length=outlines.length[index],
        residual=outlines.residual[index],
        gamma=outlines.gamma[index],
        by_gamma=outlines.by_gamma[index],
    )


def join_outlines(tables: Sequence[Outlines]) -> Outlines:
    """Return the rows of several tables, sorted by image row, leg, part and edge."""
    tables = [no_outlines(), *tables]
    joined = Outlines(
        row=np.concatenate([t.row for t in tables]),
        leg=np.concatenate([t.leg for t in tables]),
        part=tuple(part for t in tables for part in t.part),
        edge=np.concatenate([t.edge for t in tables]),
        h=np.concatenate([t.h for t in tables]),
        ends=np.concatenate([t.ends for t in tables]),
        covariance=np.concatenate([t.covariance for t in tables]),
        used=np.concatenate([t.used for t in tables]),
        reason=tuple(reason for t in tables for reason in t.reason),
        source=tuple(source for t in tables for source in t.source),
        contrast=np.concatenate([t.contrast for t in tables]),
        length=np.concatenate([t.length for t in tables]),
        residual=np.concatenate([t.residual for t in tables]),
        gamma=np.concatenate([t.gamma for t in tables]),
        by_gamma=np.concatenate([t.by_gamma for t in tables]),
    )
    return sort_outlines(joined)


def sort_outlines(outlines: Outlines) -> Outlines:
    """Return the outlines sorted by image row, leg, part and edge."""
    keys = outline_keys(outlines)
    order = sorted(range(len(keys)), key=keys.__getitem__)
    return choose_outlines(outlines, np.array(order, dtype=np.intp))


def is_edited(outlines: Outlines) -> BoolArray:
    """Return which outlines were corrected by hand."""
    return np.array([source == "edited" for source in outlines.source], dtype=np.bool_)


def merge_edited(detected: Outlines, table: Outlines) -> Outlines:
    """Return detected outlines with the edited rows of a table laid over them.

    An edited row wins over the detected outline of the same image, leg, part and edge, and is
    kept where nothing was detected.

    Parameters
    ----------
    detected : Outlines
        What detection found.
    table : Outlines
        A table with edited rows; its other rows are left out.
    """
    edited = choose_outlines(table, is_edited(table))
    taken = set(outline_keys(edited))
    kept = np.array([key not in taken for key in outline_keys(detected)], dtype=np.bool_)
    return join_outlines([choose_outlines(detected, kept), edited])


def reject_unused_legs(
    outlines: Outlines, measurements: Measurements, leg_names: Sequence[str]
) -> Outlines:
    """Return outlines with those rejected whose leg the dataset leaves out of their view.

    Parameters
    ----------
    outlines : Outlines
        The table.
    measurements : Measurements
        The rows it belongs to; their views may name the legs to use.
    leg_names : sequence of str
        The legs of the mechanism.
    """
    views = [measurements.views[v] for v in measurements.view[outlines.row].tolist()]
    names = [leg_names[leg] for leg in outlines.leg.tolist()]
    out = np.array(
        [
            view.legs is not None and name not in view.legs
            for view, name in zip(views, names, strict=True)
        ],
        dtype=np.bool_,
    )
    out &= outlines.used
    reason = tuple(
        f"view {view.name} does not use this leg" if left_out else reason
        for view, left_out, reason in zip(views, out.tolist(), outlines.reason, strict=True)
    )
    return replace(outlines, used=outlines.used & ~out, reason=reason)
