"""Outlines of legs in images, and the table ``observations.csv`` that holds them.

One row an outline: view, image, leg, part and edge; the plane (a, b, c) through the camera centre
and the outline, the ends of the used piece [px] and the covariance of the line there; verdict,
reason and source; and, where legcal measured it, how well it was seen.

Pairs of outlines give the axes of legs in camera frames; Table 1 of the paper states axes.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from legcal.brief import brief
from legcal.data.image_tables import ImageTable
from legcal.data.measurements import (
    Measurements,
    find_rows,
    places,
)
from legcal.data.reasons import USED, Reason, Rejection, read_rejection
from legcal.errors import NotVisible
from legcal.files.folder import write_atomically
from legcal.files.schema import closest, describe
from legcal.files.table import Column, Table, format_table, read_table
from legcal.geometry.lines import cross, nearest_point_to_line, normal_basis
from legcal.geometry.types import Array, BoolArray, IntArray
from legcal.machine.leg import Leg
from legcal.vision.camera import Camera
from legcal.vision.cylinder import (
    EPSILON,
    axis_of_outlines,
    direction_derivative,
    direction_of_angles,
)

if TYPE_CHECKING:
    from legcal.vision.visibility import Seen

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
    and for outlines that were given or edited.
    """

    keys = "row", "leg", "part", "edge"
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

    def used_keys(self) -> set[tuple[int, int, str, int]]:
        """Return image row, leg, part and edge of the used outlines."""
        pairs = zip(self.row_keys(), self.used.tolist(), strict=True)
        return {key for key, is_used in pairs if is_used}


def found_outlines(
    row: IntArray,
    leg: IntArray,
    part: tuple[str, ...],
    edge: IntArray,
    h: Array,
    ends: Array,
    covariance: Array,
    **measured: Array,
) -> Outlines:
    """Return detected outlines, all used; what was not measured of them is NaN."""
    n = len(row)
    columns = {name: np.full(n, np.nan) for name in MEASURED} | measured
    used, source = np.ones(n, dtype=np.bool_), ("detected",) * n
    return Outlines(row, leg, part, edge, h, ends, covariance, used, (USED,) * n, source, **columns)


def outlines_in_sight(seen: Seen, row: IntArray, covariance: Array) -> Outlines:
    """Return both outlines of visible segments (n,) in images *row*, exact.

    Their offsets have covariances (n, 2, 2).
    """
    n = len(row)
    return found_outlines(
        np.repeat(row, 2),
        np.repeat(seen.leg, 2),
        tuple(part for part in seen.part for _ in EPSILON),
        np.tile(np.array([1, 2], dtype=np.intp), n),
        seen.h.reshape(2 * n, 3),
        seen.ends.reshape(2 * n, 2, 2),
        np.repeat(covariance, 2, axis=0),
    )


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
        ends = (camera[v].rays(outlines.ends[indices]) for camera in (measured, wanted))
        before, after = (cross(rays[:, 0], rays[:, 1]) for rays in ends)
        size = np.linalg.norm(after, axis=1)
        size *= np.sign(np.sum(before * outlines.h[indices], axis=1))
        has_plane = size != 0.0
        h[indices[has_plane]] = after[has_plane] / size[has_plane, None]
    return replace(outlines, h=h)


def no_outlines() -> Outlines:
    """Return an empty table."""
    none = np.zeros(0, dtype=np.intp)
    pairs = np.zeros((0, 2, 2))
    return found_outlines(none, none, (), none, np.zeros((0, 3)), pairs, pairs)


def join_outlines(tables: Sequence[Outlines]) -> Outlines:
    """Return the rows of several tables, sorted by image row, leg, part and edge."""
    return Outlines.joined([no_outlines(), *tables]).sort()


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
    parts, needed = [list(leg.radius_of_part) for leg in legs], "a leg of the mechanism"
    remedy = "delete the file to have it written again"
    table = read_table(path, "table of observations", "outline", OUTLINE_COLUMNS, remedy=remedy)
    if skip_stale:
        row = find_rows(table, measurements, refuse=False)
        leg = table.positions("leg", leg_names, needed, refuse=False)
        exists = np.array(
            [j >= 0 and part in parts[j] for j, part in zip(leg, table.text("part"), strict=True)],
            dtype=np.bool_,
        )
        exists |= (leg >= 0) & (table.number("edge") >= FIRST_EDGE)
        detected = np.array([source == "detected" for source in table.text("source")], dtype=bool)
        table.keep((exists & (row >= 0)) | ~detected)
    row, leg = find_rows(table, measurements), table.positions("leg", leg_names, needed)
    part, of_body = table.text("part"), table.number("edge") >= FIRST_EDGE
    for i in np.flatnonzero(leg >= 0).tolist():
        if part[i] not in parts[leg[i]] and not of_body[i]:
            unknown_part = f"the unknown part {describe(part[i])}"
            cylinder = f"a link with a cylinder of {leg_names[leg[i]]}"
            table.refuse(i, unknown_part, cylinder, "part", remedy=closest(part[i], parts[leg[i]]))
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
    # The end nearer to the base joint comes first. h is the moment u x P, and the ray to the
    # second end is that to the first plus a piece of u, so that (second x first) . h > 0.
    rays = _rays(outlines, measurements)
    swap = (np.sum(cross(rays[:, 1], rays[:, 0]) * outlines.h, axis=-1) < 0.0)[:, None, None]
    _refuse_ends_off_line(table, outlines, measurements, rays)
    table.check()
    turned = outlines.covariance[:, ::-1, ::-1]
    return replace(
        outlines,
        ends=np.where(swap, outlines.ends[:, ::-1], outlines.ends),
        covariance=np.where(swap, turned, outlines.covariance),
    )


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
    """Return the rays through the ends of outlines, (n, 2, 3); NaN without ends."""
    rays = np.full((*outlines.ends.shape[:2], 3), np.nan)
    view = measurements.view[outlines.row]
    has_ends = np.all(np.isfinite(outlines.ends), axis=(1, 2))
    for v in np.unique(view):
        chosen = (view == v) & has_ends
        if np.any(chosen):
            rays[chosen] = measurements.views[v].camera.rays(outlines.ends[chosen])
    return rays


def _refuse_ends_off_line(
    table: Table, outlines: Outlines, measurements: Measurements, rays: Array
) -> None:
    """Refuse used outlines whose ends do not lie on their line."""
    view = measurements.view[outlines.row]
    offset = np.zeros(len(outlines))
    for v in np.unique(view):
        chosen = (view == v) & outlines.used
        camera, h = measurements.views[v].camera, outlines.h[chosen][:, None]
        offset[chosen] = np.abs(camera.line_offset(h, rays[chosen, :, :2])).max(axis=1)
    off = ~(offset <= LINE_TOLERANCE_PX)
    for i in np.flatnonzero(off).tolist():
        actual = f"ends {offset[i]:.3g} px from the line (a, b, c)"
        needed, remedy = f"at most {LINE_TOLERANCE_PX:g} px", "correct the line or its ends"
        table.refuse(i, actual, needed, *NUMBERS[:7], remedy=remedy)


_FLOOR_PX = 1e-3  # minimum standard deviation of an outline: keeps weights finite for any file


@brief
@dataclass(frozen=True, eq=False)
class LegAxes(ImageTable):
    """Axes of legs in camera frames, oriented from base to platform: the input of steps 1 to 4.

    The errors of an axis: ``u + alpha1 e1 + alpha2 e2`` through ``M + beta1 e1 + beta2 e2``.
    """

    keys = "row", "leg"
    leg: IntArray  # (n,)
    u: Array  # (n, 3) unit directions in the camera
    M: Array  # (n, 3) a point of each axis in the camera [m]
    basis: Array  # (n, 2, 3) unit vectors e1, e2 normal to u
    covariance: Array  # (n, 4, 4) of (alpha1, alpha2, beta1, beta2) [rad, rad, m, m]


def axes_from_outlines(
    outlines: Outlines,
    measurements: Measurements,
    radius_of_part: Mapping[str, float],  # radius of each cylinder by its URDF link [m]
) -> LegAxes:
    """Return the axis of every leg with two used outlines, eqs (4) and (5).

    The cylinders of one leg in one image (a tube and a rod) share an axis: they are joined,
    weighted by their covariances.
    """
    pairs = _pairs(outlines)
    if len(pairs) == 0:
        raise NotVisible(
            "Leg axes could not be computed: no leg has both outlines in any image; at least "
            "two images of every leg are needed; check the camera poses and the detection."
        )
    radius = np.array([radius_of_part[outlines.part[first]] for first in pairs[:, 0]])
    h = outlines.h[pairs]
    u, M = axis_of_outlines(h[:, 0], h[:, 1], radius)
    view = measurements.view[outlines.row[pairs[:, 0]]]
    rays = np.empty((len(pairs), 2, 2, 3))
    h_of_offset = np.empty((len(pairs), 2, 2, 3))
    for v in np.unique(view):
        view_pairs = pairs[view == v]
        camera = measurements.views[v].camera
        rays[view == v], h_of_offset[view == v] = outline_derivative(
            camera, outlines.h[view_pairs], outlines.ends[view_pairs]
        )
    middle = rays.mean(axis=(1, 2))
    middle /= np.linalg.norm(middle, axis=-1, keepdims=True)
    M = nearest_point_to_line(u, M, middle, np.zeros(3))
    basis = normal_basis(u)
    derivative = axis_derivative(h, h_of_offset, u, M, basis)
    offsets = np.zeros((len(pairs), 4, 4))
    offsets[:, :2, :2] = outlines.covariance[pairs[:, 0]]
    offsets[:, 2:, 2:] = outlines.covariance[pairs[:, 1]]
    offsets += _FLOOR_PX**2 * np.eye(4)
    covariance = derivative @ offsets @ np.swapaxes(derivative, -1, -2)
    separate = LegAxes(
        outlines.row[pairs[:, 0]], outlines.leg[pairs[:, 0]], u, M, basis, covariance
    )
    return join_axes(separate, separate.row)


def axis_derivative(
    h: Array,  # (n, 2, 3) unit normals of both outlines
    h_of_offset: Array,  # (n, 2, 2
    u: Array,  # (n, 3)
    M: Array,  # (n, 3)
    basis: Array,  # (n, 2, 3) e1 and e2 of each axis
) -> Array:
    """Return the derivative of axes with respect to the offsets of both outlines.

    A change of h_i must keep h_i . u = 0 (4) and h_i . M = epsilon_i R (5), so the
    changes of u and of M solve the same 2 x 2 system.
    """
    system = np.einsum("nia,nja->nij", h, basis)
    change = np.zeros((len(u), 2, 2, 4))  # (n, equation i, of u or of M, offset)
    for i in range(2):
        for column, point in enumerate((u, M)):
            change[:, i, column, 2 * i : 2 * i + 2] = -np.einsum(
                "nea,na->ne", h_of_offset[:, i], point
            )
    solved = np.linalg.solve(system, change.reshape(len(u), 2, 8)).reshape(len(u), 2, 2, 4)
    return np.concatenate([solved[:, :, 0], solved[:, :, 1]], axis=1)


def join_axes(
    axes: LegAxes,
    group: IntArray,  # (n,) axes with the same group and leg are observations of one line
) -> LegAxes:
    """Return one axis for each leg in each group of rows, weighted by the covariances."""
    keys = np.stack([group, axes.leg], axis=1)
    _, first, which, count = np.unique(
        keys, axis=0, return_index=True, return_inverse=True, return_counts=True
    )
    u, M, basis, covariance = (
        part[first] for part in (axes.u, axes.M, axes.basis, axes.covariance)
    )
    several = np.flatnonzero(count > 1)
    if len(several):
        members = np.flatnonzero(count[which.ravel()] > 1)
        line = np.searchsorted(several, which.ravel()[members])
        u[several], M[several], basis[several], covariance[several] = _joined(
            axes, first[several], members, line
        )
    return LegAxes(axes.row[first], axes.leg[first], u, M, basis, covariance)


def _joined(
    axes: LegAxes,
    first: IntArray,  # (m,) the first observation of each line, in whose basis the mean is taken
    members: IntArray,  # (n,)
    line: IntArray,  # (n,)
) -> tuple[Array, Array, Array, Array]:
    """Return u, M, basis and covariance of the weighted mean of the observations of each line."""
    u, M, basis = axes.u[first], axes.M[first], axes.basis[first]
    E = basis[line]
    # Each observation at the height of the first one's M, written in its basis.
    slope = axes.u[members] / np.sum(axes.u[members] * u[line], axis=-1, keepdims=True)
    shift = np.sum(u[line] * (M[line] - axes.M[members]), axis=-1)
    point = axes.M[members] + shift[:, None] * slope - M[line]
    value = np.concatenate([E @ slope[..., None], E @ point[..., None]], axis=1)
    turn = E @ np.swapaxes(axes.basis[members], -1, -2)
    move = np.zeros((len(line), 4, 4))
    move[:, :2, :2] = move[:, 2:, 2:] = turn
    move[:, 2:, :2] = shift[:, None, None] * turn
    weight = np.linalg.inv(move @ axes.covariance[members] @ np.swapaxes(move, -1, -2))
    information, weighted = np.zeros((len(first), 4, 4)), np.zeros((len(first), 4, 1))
    np.add.at(information, line, weight)
    np.add.at(weighted, line, weight @ value)
    covariance = np.asarray(np.linalg.inv(information), dtype=np.float64)
    change = (covariance @ weighted)[..., 0]
    u += np.einsum("nia,ni->na", basis, change[:, :2])
    u /= np.linalg.norm(u, axis=-1, keepdims=True)
    M += np.einsum("nia,ni->na", basis, change[:, 2:])
    # Carry e1 along so that the covariance keeps its meaning.
    e1 = basis[:, 0] - u * np.sum(u * basis[:, 0], axis=-1, keepdims=True)
    e1 /= np.linalg.norm(e1, axis=-1, keepdims=True)
    return u, M, np.stack([e1, cross(u, e1)], axis=1), covariance


def _pairs(outlines: Outlines) -> IntArray:
    """Return the indices (edge 1, edge 2) of outlines of one cylinder in one image, (n, 2)."""
    edges_of_part: dict[tuple[int, int, str], dict[int, int]] = {}
    for i in np.flatnonzero(outlines.used):
        key = (int(outlines.row[i]), int(outlines.leg[i]), outlines.part[i])
        edges_of_part.setdefault(key, {})[int(outlines.edge[i])] = int(i)
    pairs = [(edges[1], edges[2]) for _, edges in sorted(edges_of_part.items()) if len(edges) == 2]
    return np.array(pairs, dtype=np.intp).reshape(-1, 2)


def outline_derivative(
    camera: Camera,
    h: Array,  # (..., 3) unit normals of outlines, in its frame
    ends: Array,  # (..., 2, 2) their ends [px]
) -> tuple[Array, Array]:
    """Return the rays of an outline's ends and the derivative of its normal by offsets of the ends.

    Returns rays (..., 2, 3); derivative (..., 2, 3) [1/px].
    """
    rays = camera.rays(ends)
    xy = rays[..., :2]
    # The line follows an offset of an end: (h + dh) . ray = -dvalue keeps the point on it.
    J = camera.pixels_per_unit(xy)
    ab = np.broadcast_to(h[..., None, :2], xy.shape)
    normal = np.linalg.solve(np.swapaxes(J, -1, -2), ab[..., None])[..., 0]
    moved = np.linalg.norm(normal, axis=-1)  # d (h . ray) / d offset
    # dh is normal to h, zero on the ray of the other end, and -moved on the ray of this end.
    other_rays = rays[..., ::-1, :]
    direction = cross(np.broadcast_to(h[..., None, :], rays.shape), other_rays)
    scale = -moved / np.sum(direction * rays, axis=-1)
    return rays, direction * scale[..., None]


def axes_of_table(
    row: IntArray,  # (n,)
    leg: IntArray,  # (n,)
    values: Array,  # (n, 4) psi, theta [rad] and x, z [m] in the camera frame
    sigmas: Array,  # (n, 4) their standard deviations; their errors are independent
) -> LegAxes:
    """Return axes from their Euler angles psi, theta and their points M_LS = (x, 0, z).

    See :mod:`legcal.vision.cylinder` for the angles.
    """
    psi, theta, x, z = values.T
    u = direction_of_angles(psi, theta)
    M = np.stack([x, np.zeros_like(x), z], axis=-1)
    basis = normal_basis(u)
    derivative = np.zeros((len(basis), 4, 4))
    derivative[:, :2, :2] = basis @ direction_derivative(psi, theta)
    derivative[:, 2:, 2:] = basis[:, :, [0, 2]]
    scaled = derivative * sigmas[:, None, :]
    return LegAxes(row, leg, u, M, basis, scaled @ np.swapaxes(scaled, -1, -2))
