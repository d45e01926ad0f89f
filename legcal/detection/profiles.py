"""Pixels beside an outline, with their distances from it: the data of the limb fit.

No pixel is interpolated: rows of the picture (columns, where the outline is flat) are
read as they are, and the distance of every pixel centre from the outline is computed.
"""

from dataclasses import dataclass

import numpy as np

from legcal.detection.band import Band
from legcal.detection.limb import Samples
from legcal.detection.picture import Grey
from legcal.geometry.types import Array, BoolArray
from legcal.vision.camera import Camera

SATURATED = 250.0  # grey level from which a pixel tells no more than "bright"
FEW = 4  # such pixels of a block that may be noise
MAX_ROWS = 512  # along one outline
NODE_SPACING = 16.0  # between points at which the lens distortion is computed [px]


@dataclass(frozen=True, eq=False)
class Profiles:
    """Blocks of pixels along one outline.

    Attributes
    ----------
    t : (n_blocks,) array
        Positions of the blocks along the band [px].
    gain : (n_blocks,) array
        Pixels of distance in the image per unit of v of the band; near 1.
    d : (n_blocks, n_samples) array of float32
        Distances inside the outline [px].
    grey : (n_blocks, n_samples) array of float32
        Grey levels.
    inside : (n_blocks, n_samples) array of bool
        False for samples outside the image or out of range.
    """

    t: Array
    gain: Array
    d: Samples
    grey: Samples
    inside: BoolArray

    def take(self, blocks: BoolArray) -> "Profiles":
        """Return a selection of the blocks."""
        return Profiles(
            self.t[blocks],
            self.gain[blocks],
            self.d[blocks],
            self.grey[blocks],
            self.inside[blocks],
        )


def read_profiles(
    grey: Grey,
    camera: Camera,
    band: Band,
    v: Array,
    epsilon: float,
    depth_range: tuple[float, float],
    reach: int,
    n_rows: int,
) -> Profiles:
    """Read the pixels beside an outline.

    Parameters
    ----------
    grey : Grey
        The image.
    camera : Camera
        Its camera.
    band : Band
        The frame in which the outline is given.
    v : (2,) array
        Offsets of the outline at both ends of the band [px].
    epsilon : float
        +1 for edge 1, whose inside has greater v, -1 for edge 2.
    depth_range : tuple of float
        Least and greatest distance inside the outline that is read [px].
    reach : int
        Pixels read to each side, the same for all outlines of an image.
    n_rows : int
        Rows of a block.
    """
    n_nodes = max(3, int(band.length / NODE_SPACING) + 1)
    t = np.linspace(0.0, band.length, n_nodes)
    xy = band.points(t, v[0] + (v[1] - v[0]) * t / band.length)
    nodes = camera.distort(xy)
    across = np.einsum("nij,j->ni", camera.pixels_per_unit(xy), band.normal)
    flat = bool(abs(nodes[-1, 0] - nodes[0, 0]) > abs(nodes[-1, 1] - nodes[0, 1]))
    if flat:  # read columns: exchange x and y
        grey, nodes, across = grey.T, nodes[:, ::-1], across[:, ::-1]
    order = np.argsort(nodes[:, 1], kind="stable")
    along, offset = nodes[order, 1], nodes[order, 0]
    first, last = np.ceil(along[0]), np.floor(along[-1])
    available = max(0, int(last - first) + 1)
    stride = max(1, int(np.ceil(available / MAX_ROWS)))
    n_blocks = available // (n_rows * stride)
    rows = first + stride * np.arange(n_blocks * n_rows)
    centre = np.interp(rows, along, offset)
    slope = np.gradient(offset, along)
    tangent = np.interp(rows, along, slope)
    cosine = 1.0 / np.sqrt(1.0 + tangent**2)
    columns = np.rint(centre)[:, None] + np.arange(-reach, reach + 1.0)
    sign = epsilon * np.sign(np.interp(rows, along, across[order, 0]))
    d = (columns - centre[:, None]) * (cosine * sign)[:, None]
    height, width = grey.shape
    inside = (columns >= 0) & (columns < width) & (rows[:, None] >= 0) & (rows[:, None] < height)
    inside &= (d >= depth_range[0]) & (d <= depth_range[1])
    values = grey[
        np.clip(rows, 0, height - 1).astype(np.intp)[:, None],
        np.clip(columns, 0, width - 1).astype(np.intp),
    ]
    shape = (n_blocks, n_rows * (2 * reach + 1))
    inside = _unsaturated(d.reshape(shape), values.reshape(shape), inside.reshape(shape))
    # A step dv moves the outline by dv across; its part normal to the tangent is the gain.
    gain = np.abs(np.interp(rows, along, across[order, 0] - across[order, 1] * slope))
    return Profiles(
        np.interp(rows, along, t[order]).reshape(n_blocks, n_rows).mean(axis=1),
        (gain * cosine / band.scale).reshape(n_blocks, n_rows).mean(axis=1),
        d.reshape(shape).astype(np.float32),
        values.reshape(shape).astype(np.float32),
        inside,
    )


def _unsaturated(d: Array, grey: Grey, inside: BoolArray) -> BoolArray:
    """Leave out the depths of each block from which on the leg saturates the picture."""
    bright = np.where(inside & (grey >= SATURATED) & (d > 0.0), d, np.inf)
    limit = np.partition(bright, FEW, axis=1)[:, FEW]
    return np.asarray(inside & (d < limit[:, None]))
