"""Solids painted into a picture: one ray a pixel inside surfaces, many where edges are.

Edges are where solids, or the faces of a cylinder or box, meet in the picture. Those between the
triangles of one mesh, and where a mesh hides a part of itself, keep one ray a pixel.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from legcal.geometry.types import BoolArray, IntArray
from legcal.simulation.rendering.footprint import footprint
from legcal.simulation.rendering.intersect import intersect
from legcal.simulation.rendering.parts import Part, shares_of_lamps
from legcal.simulation.rendering.printed import printed, printed_inside
from legcal.simulation.rendering.rays import PixelRays, Single
from legcal.simulation.rendering.shading import Lighting, shade
from legcal.simulation.rendering.shadows import Occluders
from legcal.simulation.rendering.solid_in_view import SolidInView
from legcal.simulation.shapes import Box, Cylinder, Mesh, Sphere

_TIE = 1.0 - 3e-6  # surfaces nearer to each other than this part of the depth are one
_THIN = 3.0  # [px] solids that rays through pixel centres may miss
_PIXELS = 8192  # on edges, at a time
_SHADED = 3  # of so many of a pixel's rays that meet a solid, one is shaded
_FACES = 8  # that are told apart in the search for edges


@dataclass(frozen=True, eq=False)
class Canvas:
    """A picture being painted.

    Attributes
    ----------
    z : (n,) array
        Depth of what every pixel's centre shows [m]; infinite for the background.
    terms : (n_terms, n_channels, n) array
        Radiance: the sum, or apart what no shadow takes away and the light of each lamp.
    """

    z: Single
    terms: Single


class Painter:
    """Paints solids with one light and one camera.

    Parameters
    ----------
    rays : PixelRays
        The camera's rays.
    light : Lighting
        The light.
    samples : int
        Rays of each pixel on an edge.
    """

    def __init__(self, rays: PixelRays, light: Lighting, samples: int) -> None:
        self.rays, self.light, self.samples = rays, light, samples

    def paint(
        self, canvas: Canvas, solids: Sequence[SolidInView], bystanders: Sequence[SolidInView] = ()
    ) -> None:
        """Paint solids over a picture, where they are in front of what it shows.

        Parameters
        ----------
        canvas : Canvas
            The picture; changed in place.
        solids : sequence of SolidInView
            What to paint.
        bystanders : sequence of SolidInView
            What is not painted but casts shadows.
        """
        behind = canvas.z.copy()
        occluders = Occluders([*solids, *bystanders])
        feet = [footprint(self.rays, solid) for solid in solids]
        key, face = self._first_hits(canvas.z, solids, feet)
        edge = self._edges(key, solids, feet)
        on_edge = np.flatnonzero(edge)
        near = self._near_edges(key, on_edge, solids, feet)
        parts = []
        for i, (solid, foot) in enumerate(zip(solids, feet, strict=True)):
            inside = foot[(key[foot] // _FACES == i + 1) & ~edge[foot]]
            if len(inside):
                x, y = self.rays.x.take(inside), self.rays.y.take(inside)
                ink = printed_inside(solid, self.rays, inside, face[inside], self.samples)
                shaded = shade(solid, x, y, canvas.z[inside], face[inside], self.light, ink)
                parts.append(Part(i, inside, shaded))
        seen = shares_of_lamps(parts, self.light.lamps, occluders, self.rays)
        for part, shares in zip(parts, seen, strict=True):
            canvas.terms[:, :, part.pixels] = part.radiance(shares, len(canvas.terms))
        del key, face, parts, seen
        for start in range(0, len(on_edge), _PIXELS):
            pixels = on_edge[start : start + _PIXELS]
            shown = near[:, start : start + _PIXELS]
            self._paint_edge(canvas, pixels, behind[pixels], solids, shown, occluders)

    def _first_hits(
        self, z: Single, solids: Sequence[SolidInView], feet: Sequence[IntArray]
    ) -> tuple[NDArray[np.uint16], NDArray[np.int32]]:
        """Find what every pixel's centre shows: solid and face as a key (0: none of them), face."""
        key = np.zeros(len(z), dtype=np.uint16)
        faces = np.zeros(len(z), dtype=np.int32)
        for i, (solid, foot) in enumerate(zip(solids, feet, strict=True)):
            depth, face = intersect(solid, self.rays.x.take(foot), self.rays.y.take(foot))
            closer = np.flatnonzero(depth < z.take(foot) * np.float32(_TIE))
            pixels = foot[closer]
            z[pixels], faces[pixels] = depth[closer], face[closer]
            key[pixels] = _FACES * (i + 1)
            if not isinstance(solid.shape, Mesh):
                key[pixels] += face[closer].astype(np.uint16)
        return key, faces

    def _edges(
        self, key: NDArray[np.uint16], solids: Sequence[SolidInView], feet: Sequence[IntArray]
    ) -> BoolArray:
        """Return the pixels that an edge of a painted surface may cross.

        A straight edge through a pixel parts its centre from that of one of the four beside it.
        """
        picture = key.reshape(self.rays.height, self.rays.width)
        cross = cv2.getStructuringElement(cv2.MORPH_CROSS, (3, 3))
        edge = (cv2.dilate(picture, cross) != cv2.erode(picture, cross)).ravel()
        for solid, foot in zip(solids, feet, strict=True):
            if self._is_thin(solid):
                edge[foot] = True
        return np.asarray(edge, dtype=np.bool_)

    def _near_edges(
        self,
        key: NDArray[np.uint16],
        on_edge: IntArray,
        solids: Sequence[SolidInView],
        feet: Sequence[IntArray],
    ) -> BoolArray:
        """Return which solids each of some pixels may show, (n_solids, n): those of pixels around.

        Thin ones may be anywhere in their footprints.
        """
        rows, columns = np.divmod(on_edge, self.rays.width)
        above, below = np.maximum(rows - 1, 0), np.minimum(rows + 1, self.rays.height - 1)
        left, right = np.maximum(columns - 1, 0), np.minimum(columns + 1, self.rays.width - 1)
        shown = np.zeros((len(solids) + 1, len(on_edge)), dtype=np.bool_)
        every = np.arange(len(on_edge))
        for row in (above, rows, below):
            for column in (left, columns, right):
                shown[key.take(row * self.rays.width + column) // _FACES, every] = True
        for solid, foot, here in zip(solids, feet, shown[1:], strict=True):
            if self._is_thin(solid):
                here |= np.isin(on_edge, foot, assume_unique=True)
        return shown[1:]

    def _is_thin(self, solid: SolidInView) -> bool:
        """Return whether rays through the centres of pixels may miss a solid."""
        farthest = float(solid.centre[2]) + solid.reach
        return _thickness(solid) * float(self.rays.camera.K[0, 0]) < _THIN * farthest

    def _paint_edge(
        self,
        canvas: Canvas,
        pixels: IntArray,
        behind: Single,
        solids: Sequence[SolidInView],
        shown: BoolArray,
        occluders: Occluders,
    ) -> None:
        """Average many rays in each of some pixels, which may show some of the solids.

        ``behind`` is the depth before painting.
        """
        n, S = len(pixels), self.samples
        X, Y = self.rays.within(pixels, S)
        X, Y = X.ravel(), Y.ravel()
        Z = np.repeat(behind, S)
        who = np.zeros(n * S, dtype=np.uint16)
        faces = np.zeros(n * S, dtype=np.int32)
        one_pixel = np.arange(S)
        touched = []
        for i in np.flatnonzero(shown.any(axis=1)).tolist():
            here = (np.flatnonzero(shown[i])[:, None] * S + one_pixel).ravel()
            depth, face = intersect(solids[i], X.take(here), Y.take(here))
            closer = np.flatnonzero(depth < Z.take(here) * np.float32(_TIE))
            if len(closer):
                at = here.take(closer)
                Z[at], who[at], faces[at] = depth.take(closer), i + 1, face.take(closer)
                touched.append((i, here))
        uncovered = np.count_nonzero(who.reshape(n, S) == 0, axis=1) / S
        total = canvas.terms[:, :, pixels] * uncovered.astype(np.float32)
        parts, weights = [], []
        for i, here in touched:
            at = here[who.take(here) == i + 1]
            if len(at):
                at, first, weight = _some_of_each(at, at // S)
                x, y, face = X.take(at), Y.take(at), faces.take(at)
                ink = printed(solids[i], x, y, face)
                shaded = shade(solids[i], x, y, Z.take(at), face, self.light, ink)
                parts.append(Part(i, at[first] // S, shaded, first))
                weights.append(weight)
        seen = shares_of_lamps(parts, self.light.lamps, occluders, self.rays)
        for part, shares, weight in zip(parts, seen, weights, strict=True):
            light = part.radiance(shares, len(canvas.terms))
            total[:, :, part.pixels] += light * (weight / np.float32(S))
        canvas.terms[:, :, pixels] = total


def _some_of_each(
    rays: IntArray, pixel: NDArray[np.intp]
) -> tuple[IntArray, NDArray[np.intp], Single]:
    """Return every third ray of each pixel, where each pixel's rays start, and what they weigh.

    A surface's light varies little inside a pixel; that its rays are many matters for its edge.
    """
    first = np.flatnonzero(np.diff(pixel, prepend=-1))
    count = np.diff(first, append=len(rays))
    kept = (np.arange(len(rays)) - np.repeat(first, count)) % _SHADED == 0
    n_kept = -(-count // _SHADED)
    return rays[kept], np.cumsum(n_kept) - n_kept, (count / n_kept).astype(np.float32)


def _thickness(solid: SolidInView) -> float:
    """Return the least size of a solid [m]."""
    shape = solid.shape
    if isinstance(shape, Box):
        return min(shape.size)
    if isinstance(shape, Cylinder):
        return min(2.0 * shape.radius, shape.length)
    if isinstance(shape, Sphere):
        return 2.0 * shape.radius
    return np.inf
