"""Straight edges of the bodies of legs, found near a fit.

The body of a leg that is not round, an extrusion with a motor beside it say, has edges that are
parallel to the axis of the leg: corners, grooves, its silhouette. Where such an edge is about the
axis, nobody needs to know: its direction is that of the leg, in whatever way the body has turned
about itself. In an image, each is a line to the vanishing point of the axis.

The image is sampled in the plane of the axis that faces the camera, so that edges are columns but
for the error of the fit. In blocks along the body, the steepest places of the light across it are
found; lines on which many blocks agree are edges. What a line shares with its neighbours (shading,
blur, a groove beside it) moves it as a whole and does not turn it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from typing import NamedTuple

import cv2
import numpy as np
from scipy.spatial.transform import RigidTransform

from legcal.data.outlines import (
    FIRST_EDGE,
    QUALITY,
    Outlines,
    found_outlines,
    join_outlines,
    no_outlines,
)
from legcal.geometry.lines import cross
from legcal.geometry.tables import first_apart
from legcal.geometry.types import Array, BoolArray, IntArray
from legcal.machine.leg import Cylinder
from legcal.machine.shapes import Occluder, PlacedOccluders, bodies_of
from legcal.perception.blocks import BlockLine, fit_lines
from legcal.perception.photographs import Photographs
from legcal.perception.placement import (
    Placement,
    Search,
    predict_legs_and_arms,
)
from legcal.perception.profiles import Samples
from legcal.progress import Report
from legcal.vision.camera import Camera
from legcal.vision.image_file import Grey
from legcal.vision.visibility import PredictedLeg, hidden_by, in_picture, longest_runs

REACH = 1.4  # half-width of what is searched, of the radius of a body
BLOCK = 8  # length of a block along the body [px]
STEP = 0.5  # between samples across [px]
SMOOTHING = 1.0  # of the light across [px]
LEAST_SLOPE = 1.0  # of the light at an edge [grey levels/px]
WINDOW = 3.0  # largest difference of an edge's ends from the fit [px]
NEAR = 0.8  # distance up to which a steep place is of a line [px]
APART = 2.0  # least distance of lines [px]
MOST_LINES = 8  # of a body
LEAST_SHARE = 0.4  # of the blocks of a body that must lie on a line
LEAST_SPAN = 0.5  # of the length of the body, from the first of them to the last
LEAST_BLOCKS = 8
LEAST_VOTES = 0.24  # of the blocks of a body for a line to be tried
MAX_SCATTER = 0.3  # of the blocks of a line [px]
PLACE_SIGMA = 0.05  # of the steepest place in a block, at least [px]
N_SAMPLES = 400  # along a body, where its axis is placed in the image
NEAREST, BORDER = 0.05, 6.0  # of it: depth [leg lengths], distance from the border [px]
SIGMAS = 3.0  # distance from the common direction of the edges of a body, at which one is left out


def measure_body_edges(
    photographs: Photographs, placement: Placement, report: Report, stage: str
) -> Outlines:
    """Return the edges of bodies in all images that are searched, near a placement by a fit."""
    search = replace(photographs.search(placement), edge_pairs={}, still={})
    rows = photographs.detect.tolist()
    tables = []
    for n, edges in enumerate(photographs.run(partial(_of_image, search, placement), rows)):
        tables.append(edges)
        report(stage, n + 1, len(rows))
    return join_outlines(tables)


def _of_image(search: Search, placement: Placement, row: int) -> Outlines:
    """Find the edges of the bodies of the wanted legs in the image of a row."""
    view = int(search.measurements.view[row])
    camera, T = search.measurements.views[view].camera, placement.T_base_camera[view]
    bodies = bodies_of(search.occluders, search.n_legs)
    if T is None or not any(bodies):
        return no_outlines()
    ends = placement.A_base, placement.B_base
    legs = predict_legs_and_arms(camera, T, ends, search.cylinders, placement.arms, row)
    here = ends[0][row], ends[1][row]
    (placed,) = PlacedOccluders.at(search.occluders, here[0][None], here[1][None])
    grey, tables = search.load(row), []
    for seen in bodies_in_view(bodies, placed, camera, T, here, search.wanted[view], legs):
        found = edges_of_body(grey, camera, seen)
        tables.append(_table(row, seen.leg, seen.body.link, camera, found))
    return join_outlines(tables)


class BodyInView(NamedTuple):
    """A body of a leg where an image shows it."""

    leg: int
    body: Cylinder
    A: Array  # (3,) joints of the leg in the camera frame [m]
    B: Array
    along: Array  # (n,) distances from A at which its axis is in view, evenly apart in pixels [m]
    hidden: BoolArray  # (n,) which of them other things hide


def bodies_in_view(
    bodies: Sequence[Sequence[Cylinder]],  # of each leg
    placed: PlacedOccluders,  # in the base link
    camera: Camera,
    T_base_camera: RigidTransform,
    ends: tuple[Array, Array],  # A and B in the base link, (n_legs, 3) each [m]
    wanted: BoolArray,  # (n_legs,)
    legs: Sequence[PredictedLeg] = (),  # round parts that may hide bodies
    step: int = 1,  # between points along a body [px]
) -> list[BodyInView]:
    """Return the bodies of wanted legs, as far as their axes are in view."""
    T = T_base_camera.as_matrix()
    A, B = ((X - T[:3, 3]) @ T[:3, :3] for X in ends)
    placed, shown = placed.before(T), []
    for j, of_leg in enumerate(bodies):
        for body in of_leg if wanted[j] else ():
            along = _in_view(camera, A[j], B[j], body, step)
            if len(along) * step < LEAST_BLOCKS * BLOCK:
                continue
            P = A[j] + along[:, None] * ((B[j] - A[j]) / np.linalg.norm(B[j] - A[j]))
            every, reach = np.full(len(P), j), np.full(len(P), body.radius)
            hidden = placed.without_leg(j).hide(P, every, reach, reach) >= 0
            if legs:
                hidden |= hidden_by(legs, every, P, reach / P[:, 2]) >= 0
            shown.append(BodyInView(j, body, A[j], B[j], along, hidden))
    return shown


def predicted_edges(
    occluders: Sequence[Occluder],
    views: Sequence[tuple[Camera, RigidTransform]],  # with T_base_camera
    view: IntArray,  # (n_images,)
    ends: tuple[Array, Array],  # A and B of each image in the base link, (n_images, n_legs, 3) [m]
    wanted: BoolArray,  # (n_views, n_legs)
) -> Outlines:
    """Return the edges of bodies in images, hidden by bodies of other legs alone.

    Their covariance is that of ends known to a pixel.
    """
    tables, bodies = list[Outlines](), bodies_of(occluders, wanted.shape[1])
    placed = PlacedOccluders.at(occluders, *ends) if any(bodies) else ()
    for row, here in enumerate(placed):
        v, joints = int(view[row]), (ends[0][row], ends[1][row])
        for body in bodies_in_view(bodies, here, *views[v], joints, wanted[v], step=BLOCK):
            tables.append(_silhouette(row, views[v][0], body))
    return join_outlines(tables)


def _silhouette(row: int, camera: Camera, seen: BodyInView) -> Outlines:
    """Return the two edges of a body as its silhouette has them, where nothing hides it.

    The body counts as round: what a fit learns from edges does not depend on where they are.
    """
    first, last = longest_runs(~seen.hidden)
    if last - first < LEAST_BLOCKS:
        return no_outlines()
    u = (seen.B - seen.A) / np.linalg.norm(seen.B - seen.A)
    axis = seen.A + seen.along[[first, last], None] * u
    beside = cross(u, axis.mean(axis=0))
    beside *= seen.body.radius / np.linalg.norm(beside)
    length = float(BLOCK * (last - first))
    edges = [
        BodyEdge(camera.project(axis + side * beside), np.eye(2), np.nan, length, np.nan)
        for side in (-1.0, 1.0)
    ]
    return _table(row, seen.leg, seen.body.link, camera, edges)


def _in_view(camera: Camera, A: Array, B: Array, body: Cylinder, step: int) -> Array:
    """Return the distances from A at which the axis of a body is in view, *step* pixels apart."""
    length = float(np.linalg.norm(B - A))
    first = 0.0 if body.side == "base" else length
    s = np.linspace(first + body.start, first + body.end, N_SAMPLES)
    X = A + s[:, None] * ((B - A) / length)
    start, end = longest_runs(in_picture(camera, X, NEAREST * length, BORDER))
    s, X = s[start : end + 1], X[start : end + 1]
    px = camera.distort(X[:, :2] / X[:, 2:])
    passed = np.cumsum([0.0, *np.linalg.norm(np.diff(px, axis=0), axis=1)])
    return np.asarray(np.interp(np.arange(0.0, passed[-1], step), passed, s))


def _table(row: int, leg: int, link: str, camera: Camera, edges: Sequence[BodyEdge]) -> Outlines:
    """Return edges as rows of the table of outlines, numbered from 3."""
    n = len(edges)
    if not n:
        return no_outlines()
    ends = np.array([edge.ends for edge in edges])
    ones = np.ones((n, 2, 1))
    rays = np.concatenate([camera.undistort(ends), ones], axis=2)
    h = cross(rays[:, 0], rays[:, 1])
    return found_outlines(
        np.full(n, row),
        np.full(n, leg),
        (link,) * n,
        np.arange(n) + FIRST_EDGE,
        h / np.linalg.norm(h, axis=1, keepdims=True),
        ends,
        np.array([edge.covariance for edge in edges]),
        **{name: np.array([getattr(edge, name) for edge in edges]) for name in QUALITY},
    )


class BodyEdge(NamedTuple):
    """A straight edge of a body in an image."""

    ends: Array  # (2, 2) of the used piece [px], the first nearer to the base joint
    covariance: Array  # (2, 2) of the offsets of the line there [px^2]
    contrast: float  # median slope of the light [grey levels/px]
    length: float  # seen on the line, without gaps [px]
    residual: float  # robust standard deviation of the blocks about the line [px]


def edges_of_body(grey: Grey, camera: Camera, body_in_view: BodyInView) -> list[BodyEdge]:
    """Return the edges of a body in an image."""
    _, body, A, B, along, hidden = body_in_view
    n_blocks = len(along) // BLOCK
    along, hidden = along[: n_blocks * BLOCK], hidden[: n_blocks * BLOCK]
    u = (B - A) / np.linalg.norm(B - A)
    middle = A + 0.5 * (along[0] + along[-1]) * u
    beside = cross(u, middle)
    beside /= np.linalg.norm(beside)
    step = middle + np.array([[-0.5], [0.5]]) * 1e-3 * beside
    ends = camera.distort(step[:, :2] / step[:, 2:])
    pixel = 1e-3 / float(np.linalg.norm(ends[1] - ends[0]))  # across the body at its middle [m]
    n_side = int(np.ceil((REACH * body.radius / pixel + WINDOW) / STEP))
    across = np.arange(-n_side, n_side + 1, dtype=np.float64) * STEP  # [px] at the middle

    def pixels(s: Array, v: Array) -> Array:
        X = A + s[..., None] * u + (pixel * v)[..., None] * beside
        return camera.distort(X[..., :2] / X[..., 2:])

    at = pixels(along[:, None], across[None]).astype(np.float32)
    light = cv2.remap(
        grey, at[..., 0], at[..., 1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE
    )
    in_blocks = np.asarray(light, dtype=np.float32).reshape(n_blocks, BLOCK, -1).mean(axis=1)
    seen: BoolArray = ~np.any(hidden.reshape(n_blocks, BLOCK), axis=1)
    block, place, slope = _steep_places(in_blocks, seen, across)
    position = (block + 0.5) / n_blocks
    lines = _lines(position, place, slope, LEAST_VOTES * n_blocks, float(across[-1]))
    found = _fitted(lines, block, position, place, slope)
    least = max(LEAST_SHARE * int(seen.sum()), LEAST_BLOCKS)
    found = [
        (line, contrast)
        for line, contrast in found
        if len(line.position) >= least
        and line.scatter <= MAX_SCATTER
        and line.last - line.first >= LEAST_SPAN
    ]
    edges = []
    for line, contrast in _of_one_direction(_apart(found)):
        t = np.array([line.first, line.last])
        v = line.ends[0] + (line.ends[1] - line.ends[0]) * t
        s = along[0] + (along[-1] - along[0]) * _distance(along, t)
        ends = pixels(s, v)
        # An offset across the body, in pixels of the middle, in those normal to the line there.
        size = np.linalg.norm(pixels(s, v + 0.5) - pixels(s, v - 0.5), axis=1)
        length = (
            float(np.linalg.norm(ends[1] - ends[0]))
            * len(line.position)
            / max(1.0, n_blocks * (line.last - line.first))
        )
        covariance = line.covariance * np.outer(size, size)
        edges.append(BodyEdge(ends, covariance, contrast, length, line.scatter))
    return edges


def _distance(along: Array, t: Array) -> Array:
    """Return the distances along the body at fractions of its rows, as fractions."""
    s = np.interp(t * len(along) - 0.5, np.arange(len(along)), along)
    return np.asarray((s - along[0]) / (along[-1] - along[0]))


def _steep_places(light: Samples, seen: BoolArray, across: Array) -> tuple[IntArray, Array, Array]:
    """Return where the light (n_blocks, n) changes fastest: blocks, places [px] and slopes."""
    smooth = cv2.GaussianBlur(light, (0, 0), sigmaX=SMOOTHING / STEP, sigmaY=1e-6)
    slope = np.gradient(smooth, STEP, axis=1)
    size = np.abs(slope)
    least = max(LEAST_SLOPE, float(np.median(size[seen])) if seen.any() else 0.0)
    peak = np.zeros(size.shape, dtype=np.bool_)
    peak[:, 1:-1] = (size[:, 1:-1] >= size[:, :-2]) & (size[:, 1:-1] > size[:, 2:])
    peak &= (size >= least) & seen[:, None]
    block, i = np.nonzero(peak)
    left, here, right = (size[block, i + k] for k in (-1, 0, 1))
    place = across[i] + 0.5 * STEP * (left - right) / (left - 2.0 * here + right)
    return block, place, slope[block, i]


def _lines(position: Array, place: Array, slope: Array, least: float, widest: float) -> Array:
    """Return both ends and the sign (n, 3) of lines on which many blocks agree, best first."""
    tilts = np.arange(-WINDOW, WINDOW + 0.25, 0.5)
    n = int(2.0 * (widest + WINDOW) / STEP) + 3
    votes = np.zeros((2, len(tilts), n))
    at = place - (position - 0.5) * tilts[:, None]  # at the middle
    column = np.clip(np.rint((at + widest + WINDOW) / STEP).astype(np.intp), 0, n - 3) + 1
    column += n * (np.arange(len(tilts))[:, None] + len(tilts) * (slope > 0.0))
    votes += np.bincount(column.ravel(), minlength=votes.size).reshape(votes.shape)
    votes[..., 1:-1] += 0.7 * (votes[..., :-2] + votes[..., 2:])
    around = int(APART / STEP)
    lines = []
    for _ in range(3 * MOST_LINES):
        sign, k, i = np.unravel_index(int(np.argmax(votes)), votes.shape)
        if votes[sign, k, i] < least:
            break
        middle = (i - 1) * STEP - widest - WINDOW
        lines.append((middle - 0.5 * tilts[k], middle + 0.5 * tilts[k], 2.0 * sign - 1.0))
        votes[sign, :, max(0, i - around) : i + around + 1] = 0.0
    return np.array(lines).reshape(-1, 3)


def _fitted(
    lines: Array, block: IntArray, position: Array, place: Array, slope: Array
) -> list[tuple[BlockLine, float]]:
    """Fit lines to the nearest steep place in each block; return them with their slopes."""
    chosen = []
    for first, last, sign in lines.tolist():
        off = np.abs(place - first - (last - first) * position)
        near = np.flatnonzero((off <= NEAR) & (slope * sign > 0.0))
        near = near[np.lexsort((off[near], block[near]))]
        chosen.append(near[np.unique(block[near], return_index=True)[1]])
    if not chosen:
        return []
    bounds = np.cumsum([0, *map(len, chosen)])
    every = np.concatenate(chosen)
    noise = np.full(len(every), PLACE_SIGMA**2)
    fits = fit_lines(bounds, position[every], place[every], noise)
    return [
        (line, float(np.median(np.abs(slope[near]))))
        for line, near in zip(fits, chosen, strict=True)
        if line is not None
    ]


def _apart(lines: Sequence[tuple[BlockLine, float]]) -> list[tuple[BlockLine, float]]:
    """Return the lines that are not another one before them."""
    middle = np.array([np.mean(line.ends) for line, _ in lines])
    near = np.abs(middle[:, None] - middle) < APART
    return [lines[i] for i in first_apart(near).tolist()]


def _of_one_direction(lines: Sequence[tuple[BlockLine, float]]) -> list[tuple[BlockLine, float]]:
    """Return the lines that are parallel to most others, at most ``MOST_LINES``."""
    lines = lines[:MOST_LINES]
    if len(lines) < 3:
        return list(lines)
    turned = np.array([line.ends[1] - line.ends[0] for line, _ in lines])
    off = np.abs(turned - np.median(turned))
    scatter = max(1.4826 * float(np.median(off)), 0.1)
    return [line for line, d in zip(lines, off.tolist(), strict=True) if d <= SIGMAS * scatter]
