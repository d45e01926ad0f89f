"""One row of ``observations.csv``: parsed, and checked cell by cell."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from legcal.files.schema import closest, describe
from legcal.mechanism.leg import Leg
from legcal.observations.outlines import ENCODING, QUALITY, Outlines

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
