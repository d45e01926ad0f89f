"""Pixels beside an outline, with their distances from it: the data of the limb fit.

No pixel is interpolated: rows of the picture (columns, where the outline is flat) are
read as they are, and the distance of every pixel centre from the outline is computed.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from legcal.geometry.types import Array, BoolArray, IntArray
from legcal.perception.light import Samples
from legcal.vision.camera import Camera
from legcal.vision.image_file import Grey
from legcal.vision.visibility import Band

SATURATED = 250.0  # grey level from which a pixel is saturated
MAX_NOISY = 4  # saturated pixels of a block that may be noise
MAX_OFFSET = 1.0  # how far an outline may be from where it was found [px]
MIN_SHARE_CLIPPED = 0.5  # share of saturated pixels with which a background is clipped
MAX_ROWS = 512  # along one outline
TAPER = 1.0  # over which pixels come to count where the used range begins [px]
NODE_SPACING = 16.0  # between points at which the lens distortion is computed [px]


@dataclass(frozen=True, eq=False)
class Edge:
    """An outline that is known to about a pixel."""

    band: Band  # the frame of its part
    v: Array  # (2,) offsets at both ends of the band [px]
    epsilon: float  # +1 for edge 1, whose inside has greater v, -1 for edge 2
    half_width: float  # of the part in the image [px]
    hidden: BoolArray  # (n,) which of n equal stretches of the band other legs hide
    polished: bool = False  # the surface of its part


@dataclass(frozen=True, eq=False)
class Profiles:
    """Blocks of pixels along outlines, one outline after the other."""

    bounds: IntArray  # (n_edges + 1,) first block of each outline
    position: Array  # (n_blocks,) as fractions of the bands
    gain: Array  # (n_blocks,) pixels of distance in the image per unit of v of the band; near 1
    d: Samples  # (n_blocks, n_samples) distances inside the outline [px]
    grey: Samples  # (n_blocks, n_samples) grey levels
    # (n_blocks, n_samples) how much pixels count: 0 outside the image, out of range and saturated,
    # falling from 1 within TAPER where the range ends, so that no pixel counts or not by a hair
    window: Samples
    clipped: Samples  # (n_blocks,) depth up to which the background saturates [px], or -inf


def read_profiles(
    grey: Grey,
    camera: Camera,
    edges: Sequence[Edge],
    v: Sequence[Array],
    depths: tuple[float, Array],
    n_rows: int,
    most: int | None = None,
) -> Profiles:
    """Read the pixels beside one outline or more with offsets v (2,), where nothing hides them.

    Up to the depths (outside, and inside of each) from the outlines [px], in blocks of ``n_rows``;
    about ``most`` blocks of each outline at even distances, all of them by default.
    """
    nodes = _nodes(camera, edges, np.array(v))
    rows = nodes.rows(n_rows)
    # Blocks that are read: a few consecutive rows of one edge.
    position = nodes.at(rows, nodes.position).reshape(-1, n_rows).mean(axis=1)
    edge = rows.edge[::n_rows]
    free = np.ones(len(edge), dtype=np.bool_)
    if most is not None:
        first = np.searchsorted(edge, np.arange(len(edges) + 1))
        step = np.maximum(np.diff(first) // most, 1)
        free = (np.arange(len(edge)) - first[edge]) % step[edge] == 0
    for k, searched in enumerate(edges):
        if np.any(searched.hidden):
            n, blocks = len(searched.hidden), slice(*np.searchsorted(edge, [k, k + 1]))
            free[blocks] &= ~searched.hidden[
                np.clip((position[blocks] * n).astype(np.intp), 0, n - 1)
            ]
    kept = np.repeat(free, n_rows)
    rows = _Rows(rows.edge[kept], rows.along[kept], rows.node[kept], rows.part[kept])
    edge = edge[free]
    centre, tangent = nodes.at(rows, nodes.offset), nodes.at(rows, nodes.slope)
    cosine = 1.0 / np.sqrt(1.0 + tangent**2)
    across = nodes.at(rows, nodes.across)
    inner = depths[1][rows.edge]
    outside, inside_of = depths[0] + 0.5 * TAPER, inner + 0.5 * TAPER
    first = np.ceil(centre - np.where(across > 0.0, outside, inside_of) / cosine)
    n_columns = int(np.max((outside + inside_of) / cosine, initial=0.0)) + 1
    columns = first[:, None] + np.arange(n_columns)
    d = (columns - centre[:, None]) * (cosine * np.sign(across))[:, None]
    height, width = len(grey), grey.shape[1]
    flat = nodes.flat[rows.edge][:, None]
    along = rows.along[:, None]
    n_columns_there, n_rows_there = np.where(flat, height, width), np.where(flat, width, height)
    inside = (columns >= 0) & (columns < n_columns_there) & (along >= 0) & (along < n_rows_there)
    window = np.minimum(fading(-d, depths[0]), fading(d, inner[:, None])) * inside
    inside = window > 0.0
    row = np.clip(along, 0, n_rows_there - 1) * np.where(flat, 1, width)
    column = np.clip(columns, 0, n_columns_there - 1) * np.where(flat, width, 1)
    values = np.asarray(np.ravel(grey).take((row + column).astype(np.intp)), dtype=np.float32)
    shape = (len(edge), n_rows * n_columns)
    distance, values = d.reshape(shape).astype(np.float32), values.reshape(shape)
    inside, window = inside.reshape(shape), window.reshape(shape).astype(np.float32)
    clipped, bright = _unsaturated(distance, values, inside)
    # A step dv moves the outline by dv across; its part normal to the tangent is the gain.
    gain = np.abs(nodes.at(rows, nodes.gain)) * cosine
    return Profiles(
        np.searchsorted(edge, np.arange(len(edges) + 1)),
        position[free],
        gain.reshape(-1, n_rows).mean(axis=1),
        distance,
        values,
        window * ((distance > clipped[:, None]) & (distance < bright[:, None])),
        clipped,
    )


def fading(depth: NDArray[Any], end: NDArray[Any] | float) -> NDArray[Any]:
    """Return the weights of pixels at depths, with a used range that ends at ``end`` [px].

    From 1 to 0 within TAPER, half of it to either side of the end.
    """
    within = end + 0.5 * TAPER - depth
    return np.asarray(np.clip(within / TAPER, 0.0, 1.0), dtype=depth.dtype)


class _Rows(NamedTuple):
    """Rows of pixels (columns, where an outline is flat) that outlines cross, edge by edge."""

    edge: IntArray  # (n,)
    along: Array  # (n,) y of rows, x of columns [px]
    node: IntArray  # (n,) the node before it, among those of all edges
    part: Array  # (n,) how far it is towards the next


@dataclass(frozen=True, eq=False)
class _Nodes:
    """Points of outlines between which the image is taken to be without distortion."""

    flat: BoolArray  # (n_edges,) whether an outline crosses columns in place of rows
    position: Array  # (n_edges, n_nodes) fractions of the bands
    along: Array  # (n_edges, n_nodes) y, or x of flat outlines, rising [px]
    offset: Array  # (n_edges, n_nodes) x, or y of flat outlines [px]
    slope: Array  # (n_edges, n_nodes) the change of offset by along
    across: Array  # (n_edges, n_nodes) how offset changes inwards; only its sign is of use
    gain: Array  # (n_edges, n_nodes) px of offset at the same along, by px of v

    def rows(self, n_rows: int) -> _Rows:
        """Return the rows of all whole blocks."""
        first, last = np.ceil(self.along[:, 0]), np.floor(self.along[:, -1])
        available = np.maximum(0, (last - first).astype(np.intp) + 1)
        stride = np.maximum(1, -(-available // MAX_ROWS))
        # Blocks stay where they are in the image while bands move by less.
        first = np.ceil(first / (n_rows * stride)) * (n_rows * stride)
        available = np.maximum(0, (last - first).astype(np.intp) + 1)
        n = available // (n_rows * stride) * n_rows
        edge = np.repeat(np.arange(len(n)), n)
        number = np.arange(len(edge)) - np.repeat(np.cumsum(n) - n, n)
        along = first[edge] + stride[edge] * number
        n_nodes = self.along.shape[1]
        apart = 4.0 * np.abs(self.along).max(initial=0.0) + 1.0  # puts one edge after the other
        keys = self.along + apart * np.arange(len(n))[:, None]
        node = np.searchsorted(keys.ravel(), along + apart * edge, side="right") - 1
        node = np.clip(node, edge * n_nodes, edge * n_nodes + n_nodes - 2)
        here, there = self.along.ravel()[node], self.along.ravel()[node + 1]
        return _Rows(edge, along, node, (along - here) / np.maximum(there - here, 1e-9))

    def at(self, rows: _Rows, values: Array) -> Array:
        """Return values of nodes (n_edges, n_nodes) at rows (n,)."""
        values = values.ravel()
        here = values[rows.node]
        return np.asarray(here + (values[rows.node + 1] - here) * rows.part)


def _nodes(camera: Camera, edges: Sequence[Edge], v: Array) -> _Nodes:
    """Return points of all outlines with offsets v (n_edges, 2) [px]."""
    bands = [edge.band for edge in edges]
    length, scale = np.array([[b.length, b.scale] for b in bands]).T[..., None]
    origin, along, normal = np.array([[b.origin, b.along, b.normal] for b in bands]).swapaxes(0, 1)
    origin, along, normal = origin[:, None], along[:, None], normal[:, None]
    position = np.linspace(0.0, 1.0, max(3, int(length.max() / NODE_SPACING) + 1))
    at = v[:, :1] + (v[:, 1:] - v[:, :1]) * position
    xy = origin + (length / scale * position)[..., None] * along + (at / scale)[..., None] * normal
    pixels = camera.distort(xy)
    across = np.sum(camera.pixels_per_unit(xy) * normal[:, :, None, :], axis=-1) / scale[..., None]
    reach = np.abs(pixels[:, -1] - pixels[:, 0])
    flat = reach[:, 0] > reach[:, 1]
    pixels, across = (np.where(flat[:, None, None], x[..., ::-1], x) for x in (pixels, across))
    order = np.argsort(pixels[..., 1], axis=1, kind="stable")
    offset, along_px = (np.take_along_axis(pixels[..., k], order, axis=1) for k in (0, 1))
    inwards, besides = (np.take_along_axis(across[..., k], order, axis=1) for k in (0, 1))
    slope = _slopes(offset, along_px)
    epsilon = np.array([[edge.epsilon] for edge in edges])
    return _Nodes(
        flat,
        np.take_along_axis(np.broadcast_to(position, order.shape), order, axis=1),
        along_px,
        offset,
        slope,
        epsilon * inwards,
        inwards - besides * slope,
    )


def _slopes(y: Array, x: Array) -> Array:
    """Return dy/dx at the points of curves (n, m) with rising x, to second order inside."""
    rise = np.diff(y, axis=1) / np.maximum(np.diff(x, axis=1), 1e-9)
    apart = np.diff(x, axis=1)
    part = apart[:, :-1] / np.maximum(apart[:, :-1] + apart[:, 1:], 1e-9)
    inner = rise[:, :-1] + (rise[:, 1:] - rise[:, :-1]) * part
    return np.concatenate([rise[:, :1], inner, rise[:, -1:]], axis=1)


def _unsaturated(d: Samples, grey: Grey, inside: BoolArray) -> tuple[Samples, Samples]:
    """Return between which depths (n,) of each block nothing saturates the picture.

    Clipped, a background ends the blurred step too early, and the outline would seem to lie where
    the rest of the step does. One whose noise alone reaches saturation is not clipped.
    """
    first, last = (np.full(len(d), at, dtype=np.float32) for at in (-np.inf, np.inf))
    bright = inside & (grey >= SATURATED)
    some = np.flatnonzero(np.count_nonzero(bright, axis=1) > MAX_NOISY)
    if len(some) == 0:
        return first, last
    d, bright, inside = d[some], bright[some], inside[some]
    behind = np.partition(np.where(bright & (d < 0.0), d, -np.inf), -1 - MAX_NOISY, axis=1)[
        :, -1 - MAX_NOISY
    ]
    beyond = inside & (d <= behind[:, None])
    n_bright = np.count_nonzero(beyond & bright, axis=1)
    clipped = (n_bright > MIN_SHARE_CLIPPED * np.count_nonzero(beyond, axis=1))[:, None]
    # The line may be off: what is bright near it is the background, where that is clipped.
    near = np.where(clipped, np.float32(MAX_OFFSET), np.float32(0.0))
    first[some] = np.max(np.where(bright & clipped & (d < near), d, -np.inf), axis=1)
    last[some] = np.partition(np.where(bright & (d > near), d, np.inf), MAX_NOISY, axis=1)[
        :, MAX_NOISY
    ]
    return first, last
