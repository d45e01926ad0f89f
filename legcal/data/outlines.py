"""Outlines of legs in images, and the table ``observations.csv`` that holds them.

One row an outline: view, image, leg, part and edge; the plane (a, b, c) through the camera centre
and the outline, the ends of the used piece [px] and the covariance of the line there; verdict,
reason and source; and, where legcal measured it, how well it was seen.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from legcal.brief import brief
from legcal.data.image_tables import ImageTable
from legcal.data.measurements import (
    Measurements,
    find_legs,
    find_rows,
    places,
)
from legcal.data.reasons import Reason, Rejection, read_rejection
from legcal.files.folder import write_atomically
from legcal.files.schema import closest, describe
from legcal.files.table import Column, Table, format_table, read_table
from legcal.geometry.lines import cross
from legcal.geometry.types import Array, BoolArray, IntArray
from legcal.machine.leg import Leg
from legcal.vision.camera import Camera

QUALITY = ("contrast", "length", "residual")  # how well an outline was seen
ENCODING = ("gamma", "by_gamma")  # how an outline depends on the gamma of the camera
MEASURED = (*QUALITY, *ENCODING, "polish")
NUMBERS = ("a", "b", "c", "u0", "v0", "u1", "v1", "s00", "s01", "s11")
VERDICTS = ("used", "rejected")
SOURCES = ("detected", "edited")

FIRST_EDGE = 3  # number of the first straight edge of a body; 1 and 2 are limbs of cylinders
MAX_POLISH = 4.0  # maximum log likelihood ratio of one outline for or against polish
UNIT_EXACT = 1e-12  # tolerance of |h| = 1 up to which h is kept as it is
UNIT_TOLERANCE = 1e-3  # tolerance of |h| = 1 written with few digits; h is normalised
LINE_TOLERANCE_PX = 5.0  # ends further from the line contradict it
MIN_PIECE = 0.1  # [px] between the ends: the direction of a shorter piece is only rounding
SIGMA_RANGE = (1e-5, 100.0)  # [px] plausible standard deviations of offsets

VERDICT_COLUMNS = (
    Column("verdict", "text", choices=VERDICTS, remedy="correct it"),
    Column("reason", "text"),
    Column("source", "text", choices=SOURCES, remedy="correct it"),
)
DETAIL_COLUMN = Column("detail", "text", required=False)  # detail of the reason
UNLESS_REJECTED = "correct it or set the verdict to rejected with an empty cell"
_LEAVE = "correct it or leave it empty"
OUTLINE_COLUMNS = (
    *(Column(name, "text") for name in ("view", "image", "leg", "part")),
    Column("edge", "whole", least=1.0, most=999.0, remedy="correct it",
           needed="1 or 2 of a cylinder, or a number from 3 on of a body"),
    *(Column(name, blank=True, remedy=UNLESS_REJECTED) for name in NUMBERS),
    *VERDICT_COLUMNS,
    *(
        Column(name, least=0.0, needed="a number from 0 on", blank=True, required=False,
               remedy=_LEAVE)
        for name in QUALITY
    ),
    Column("gamma", least=math.ulp(0.0), needed="a number above 0", blank=True, required=False,
           group="gamma", remedy=_LEAVE),
    Column("by_gamma", blank=True, required=False, group="gamma", remedy=_LEAVE),
    Column("polish", blank=True, required=False, remedy=_LEAVE),
    DETAIL_COLUMN,
)  # fmt: skip


@brief
@dataclass(frozen=True, eq=False)
class Outlines(ImageTable):
    """Outlines of cylinders in images, one row an outline (eqs 2, 3, 5).

    The quality of an outline and its dependence on the gamma are NaN where detection failed
    and for outlines that were given or edited (:func:`unmeasured`).
    """

    leg: IntArray  # (n,) of the mechanism
    part: tuple[str, ...]  # the URDF link of the cylinder
    edge: IntArray  # (n,) 1 where epsilon of eq (5) is +1, 2 where it is -1
    h: Array  # (n, 3) unit normal in the camera, h . M = epsilon R (3); NaN where detection failed
    ends: Array  # (n, 2, 2) of the used piece [px], the first nearer to the base joint
    covariance: Array  # (n, 2, 2) of the offsets of the line, normal to itself, there [px^2]
    used: BoolArray  # (n,)
    reason: tuple[Rejection, ...]  # reasons of rejections; false for used outlines
    source: tuple[str, ...]  # detected or edited
    contrast: Array  # (n,) median step to the leg [grey levels]
    length: Array  # (n,) seen on the line, without gaps [px]
    residual: Array  # (n,) robust standard deviation of the edge about it [px]
    gamma: Array  # (n,) gamma of the camera in the measurement
    by_gamma: Array  # (n,) shift inwards with log gamma [px]
    polish: Array  # (n,) log likelihood ratio of a polished surface over a matte one

    def row_keys(self) -> list[tuple[int, int, str, int]]:
        """Return image row, leg, part and edge of each outline."""
        leg, edge = self.leg.tolist(), self.edge.tolist()
        return list(zip(self.row.tolist(), leg, self.part, edge, strict=True))

    def used_keys(self) -> set[tuple[int, int, str, int]]:
        """Return image row, leg, part and edge of the used outlines."""
        pairs = zip(self.row_keys(), self.used.tolist(), strict=True)
        return {key for key, is_used in pairs if is_used}


def unmeasured(n: int) -> dict[str, Array]:
    """Return the columns of quality (n,) of outlines without a measurement: NaN."""
    return {name: np.full(n, np.nan) for name in MEASURED}


def polished_parts(outlines: Outlines) -> frozenset[tuple[int, str]]:
    """Return the legs and parts with a polished surface.

    Decided by the sum of the log likelihood ratios of their used outlines, each clipped to
    ``MAX_POLISH``.
    """
    evidence: dict[tuple[int, str], float] = {}
    used = np.flatnonzero(outlines.used & np.isfinite(outlines.polish)).tolist()
    for i in used:
        part = int(outlines.leg[i]), outlines.part[i]
        ratio = float(np.clip(outlines.polish[i], -MAX_POLISH, MAX_POLISH))
        evidence[part] = evidence.get(part, 0.0) + ratio
    return frozenset(part for part, ratio in evidence.items() if ratio > 0.0)


def through_cameras(
    outlines: Outlines, view: IntArray, measured: Sequence[Camera], wanted: Sequence[Camera]
) -> Outlines:
    """Return outlines that were measured with some cameras, recomputed for other cameras.

    The ends keep their pixels, and the planes go through them. *view* is the view of each outline,
    and has a camera in either sequence.
    """
    h = outlines.h.copy()
    for v in np.unique(view).tolist():
        indices = np.flatnonzero((view == v) & np.isfinite(outlines.h).all(axis=1))
        old_lens, new_lens = ((camera[v].K, camera[v].distortion) for camera in (measured, wanted))
        if len(indices) == 0 or all(map(np.array_equal, old_lens, new_lens)):
            continue
        before, after = (
            _plane_through(camera[v].undistort(outlines.ends[indices]))
            for camera in (measured, wanted)
        )
        size = np.linalg.norm(after, axis=1)
        size *= np.sign(np.sum(before * outlines.h[indices], axis=1))
        has_plane = size != 0.0
        h[indices[has_plane]] = after[has_plane] / size[has_plane, None]
    return replace(outlines, h=h)


def _plane_through(ends: Array) -> Array:
    """Return normals (n, 3) of the planes through the camera and two points (n, 2, 2) each."""
    rays = np.concatenate([ends, np.ones((*ends.shape[:2], 1))], axis=2)
    return cross(rays[:, 0], rays[:, 1])


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
        **unmeasured(0),
    )


def join_outlines(tables: Sequence[Outlines]) -> Outlines:
    """Return the rows of several tables, sorted by image row, leg, part and edge."""
    return no_outlines().join(tables).sort()


def are_of_bodies(outlines: Outlines) -> BoolArray:
    """Return a mask (n,) of the straight edges of bodies, which are not limbs of cylinders."""
    return np.asarray(outlines.edge >= FIRST_EDGE)


def with_body_edges(outlines: Outlines, edges: Outlines | None) -> Outlines:
    """Return outlines and edges of bodies in one table, as files have them."""
    return outlines if edges is None else join_outlines([outlines, edges])


def is_edited(outlines: Outlines) -> BoolArray:
    """Return a mask (n,) of the outlines that were corrected by hand."""
    return np.array([source == "edited" for source in outlines.source], dtype=np.bool_)


def merge_edited(detected: Outlines, table: Outlines) -> Outlines:
    """Return detected outlines with the edited rows of a table laid over them.

    An edited row wins over the detected outline of the same image, leg, part and edge, and is
    kept where nothing was detected.
    """
    edited = table.choose(is_edited(table))
    taken = set(edited.row_keys())
    kept = np.array([key not in taken for key in detected.row_keys()], dtype=np.bool_)
    return join_outlines([detected.choose(kept), edited])


def along_legs(outlines: Outlines, legs: Sequence[Leg]) -> Outlines:
    """Return the outlines of cylinders along legs, without outlines of arms."""
    arms = are_of_arms(outlines, legs)
    return outlines.choose(~arms) if arms.any() else outlines


def are_of_arms(outlines: Outlines, legs: Sequence[Leg]) -> BoolArray:
    """Return a mask (n,) of the outlines of arms."""
    parts = zip(outlines.leg.tolist(), outlines.part, strict=True)
    return np.array([legs[j].is_arm(part) for j, part in parts], dtype=np.bool_)


def reject_unused_legs(
    outlines: Outlines, measurements: Measurements, leg_names: Sequence[str]
) -> Outlines:
    """Reject outlines of legs that the dataset excludes from their view."""
    views = [measurements.views[v] for v in measurements.view[outlines.row].tolist()]
    names = [leg_names[leg] for leg in outlines.leg.tolist()]
    used = [view.uses(name) for view, name in zip(views, names, strict=True)]
    out = ~np.array(used, dtype=np.bool_)
    return outlines.reject(out, [Rejection(Reason.UNUSED_LEG, view.name) for view in views])


def write_observations(
    path: Path, outlines: Outlines, measurements: Measurements, leg_names: Sequence[str]
) -> None:
    """Write outlines so that reading gives the same numbers, and the file complete or not at all.

    Raises OSError if it cannot be written.
    """
    text = format_observations(outlines, measurements, leg_names)
    write_atomically(path, text.encode())


def format_observations(
    outlines: Outlines, measurements: Measurements, leg_names: Sequence[str]
) -> str:
    """Return the text of ``observations.csv``."""
    names = places(measurements)
    numbers = np.hstack(
        [
            outlines.h,
            outlines.ends.reshape(-1, 4),
            outlines.covariance.reshape(-1, 4)[:, [0, 1, 3]],
        ]
    ).tolist()
    measured = np.array([getattr(outlines, name) for name in MEASURED]).T.tolist()
    rows = (
        [
            *names[row],
            leg_names[outlines.leg[i]],
            outlines.part[i],
            int(outlines.edge[i]),
            *numbers[i],
            VERDICTS[0 if outlines.used[i] else 1],
            outlines.reason[i].reason,
            outlines.source[i],
            *measured[i],
            str(outlines.reason[i].detail),
        ]
        for i, row in enumerate(outlines.row.tolist())
    )
    return format_table([column.name for column in OUTLINE_COLUMNS], rows)


def read_observations(
    path: Path,
    legs: Sequence[Leg],
    measurements: Measurements,
    *,
    skip_stale: bool = False,
) -> Outlines:
    """Return the table ``observations.csv`` in the order of the file.

    (a, b, c) is normalised; the ends are put in order, nearer to the base joint first, according to
    the sign of eq (3). With ``skip_stale``, detected outlines of images, legs or parts that no
    longer exist are left out, as in a table that legcal wrote for an earlier state of the dataset.
    Raises DatasetError with one sentence for each problem.
    """
    leg_names = [leg.name for leg in legs]
    parts = [list(leg.radius_of_part) for leg in legs]
    remedy = "delete the file to have it written again"
    table = read_table(path, "table of observations", "outline", OUTLINE_COLUMNS, remedy=remedy)
    if skip_stale:
        row = find_rows(table, measurements, refuse=False)
        leg = find_legs(table, leg_names, refuse=False)
        exists = np.array(
            [j >= 0 and part in parts[j] for j, part in zip(leg, table.text("part"), strict=True)],
            dtype=np.bool_,
        )
        exists |= (leg >= 0) & (table.number("edge") >= FIRST_EDGE)
        detected = np.array([source == "detected" for source in table.text("source")], dtype=bool)
        table.keep((exists & (row >= 0)) | ~detected)
    row, leg = find_rows(table, measurements), find_legs(table, leg_names)
    part, of_body = table.text("part"), table.number("edge") >= FIRST_EDGE
    for i in np.flatnonzero(leg >= 0).tolist():
        if part[i] not in parts[leg[i]] and not of_body[i]:
            unknown_part = f"the unknown part {describe(part[i])}"
            needed = f"a link with a cylinder of {leg_names[leg[i]]}"
            table.refuse(i, unknown_part, needed, "part", remedy=closest(part[i], parts[leg[i]]))
    used = np.array([verdict == "used" for verdict in table.text("verdict")], dtype=np.bool_)
    edited = np.array([source == "edited" for source in table.text("source")], dtype=np.bool_)
    table.need(NUMBERS, used)
    numbers = table.numbers(NUMBERS)
    _refuse_numbers(table, numbers, used)
    keys = zip(row.tolist(), leg.tolist(), part, table.text("edge"), strict=True)
    table.once([None if -1 in key else key for key in keys], "the same image, leg, part and edge")
    table.check()
    norm = np.linalg.norm(numbers[:, :3], axis=1)
    inexact = ~(np.abs(norm - 1.0) <= UNIT_EXACT)
    with np.errstate(invalid="ignore"):
        numbers[inexact, :3] /= norm[inexact, None]
    measured = [np.where(edited, np.nan, table.number(name)) for name in MEASURED]
    outlines = Outlines(
        row,
        leg,
        part,
        np.array(table.text("edge"), dtype=np.intp),
        numbers[:, :3],
        numbers[:, 3:7].reshape(-1, 2, 2),
        numbers[:, [7, 8, 8, 9]].reshape(-1, 2, 2),
        used,
        tuple(map(read_rejection, table.text("reason"), table.text("detail"))),
        table.text("source"),
        *measured,  # results of detection, which do not apply to edited rows
    )
    outlines = _order_ends(outlines, measurements)
    _refuse_ends_off_line(table, outlines, measurements)
    table.check()
    return outlines


def _refuse_numbers(table: Table, numbers: Array, used: BoolArray) -> None:
    """Refuse used outlines whose numbers contradict each other."""
    for i in np.flatnonzero(used & np.all(np.isfinite(numbers), axis=1)).tolist():
        a, b, c, u0, v0, u1, v1, s00, s01, s11 = numbers[i].tolist()
        norm = math.hypot(a, b, c)
        if abs(norm - 1.0) > UNIT_TOLERANCE:
            actual, remedy = f"a vector of norm {norm:.6g}", "divide the three by their norm"
            table.refuse(i, actual, "a unit vector", "a", "b", "c", remedy=remedy)
        length = math.hypot(u1 - u0, v1 - v0)
        if length < MIN_PIECE:
            actual = f"ends {length:.3g} px apart" if length else "both ends at the same pixel"
            needed = "two ends of a piece of the edge"
            table.refuse(i, actual, needed, "u0", "v0", "u1", "v1", remedy="correct them")
        if not (s00 > 0.0 and s11 > 0.0 and s00 * s11 > s01 * s01):
            actual = f"a covariance that is not positive definite ({s00:g}, {s01:g}, {s11:g})"
            needed = "variances of the offsets at both ends [px^2]"
            table.refuse(i, actual, needed, "s00", "s01", "s11", remedy="correct them")
            continue
        largest = 0.5 * (s00 + s11 + math.hypot(s00 - s11, 2.0 * s01))
        least = s00 * (s11 / largest) - s01 * (s01 / largest)  # the determinant is their product
        fewest, most = SIGMA_RANGE[0], min(SIGMA_RANGE[1], max(length, MIN_PIECE))
        if not (least >= fewest**2 and largest <= most**2):
            sigmas = math.sqrt(max(least, 0.0)), math.sqrt(largest)
            actual = f"offsets known to between {sigmas[0]:.3g} and {sigmas[1]:.3g} px"
            needed = f"standard deviations from {fewest:g} to {most:.3g} px"
            remedy = "write px^2, or set the verdict to rejected"
            table.refuse(i, actual, needed, "s00", "s01", "s11", remedy=remedy)


def _rays(outlines: Outlines, measurements: Measurements) -> Array:
    """Return the ends of outlines on the sensor plane, (n, 2, 2)."""
    xy = np.full(outlines.ends.shape, np.nan)
    view = measurements.view[outlines.row]
    has_ends = np.all(np.isfinite(outlines.ends), axis=(1, 2))
    for v in np.unique(view):
        chosen = (view == v) & has_ends
        if np.any(chosen):
            xy[chosen] = measurements.views[v].camera.undistort(outlines.ends[chosen])
    return xy


def _order_ends(outlines: Outlines, measurements: Measurements) -> Outlines:
    """Return outlines with the end nearer to the base joint first.

    h is the moment u x P, and the ray to the second end is that to the first plus a piece of
    u, so that (second x first) . h > 0.
    """
    xy = _rays(outlines, measurements)
    rays = np.concatenate([xy, np.ones((*xy.shape[:2], 1))], axis=-1)
    swap = np.sum(cross(rays[:, 1], rays[:, 0]) * outlines.h, axis=-1) < 0.0
    ends = np.where(swap[:, None, None], outlines.ends[:, ::-1], outlines.ends)
    turned = outlines.covariance[:, ::-1, ::-1]
    covariance = np.where(swap[:, None, None], turned, outlines.covariance)
    return replace(outlines, ends=ends, covariance=covariance)


def _refuse_ends_off_line(table: Table, outlines: Outlines, measurements: Measurements) -> None:
    """Refuse used outlines whose ends do not lie on their line."""
    xy = _rays(outlines, measurements)
    view = measurements.view[outlines.row]
    offset = np.zeros(len(outlines))
    for v in np.unique(view):
        chosen = (view == v) & outlines.used
        camera, h = measurements.views[v].camera, outlines.h[chosen][:, None]
        offset[chosen] = np.abs(camera.line_offset(h, xy[chosen])).max(axis=1)
    off = ~(offset <= LINE_TOLERANCE_PX)
    for i in np.flatnonzero(off).tolist():
        actual = f"ends {offset[i]:.3g} px from the line (a, b, c)"
        needed, remedy = f"at most {LINE_TOLERANCE_PX:g} px", "correct the line or its ends"
        table.refuse(i, actual, needed, *NUMBERS[:7], remedy=remedy)
