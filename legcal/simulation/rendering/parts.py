"""Lit parts of a picture, and the shadows on all of them at once."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from legcal.geometry.types import BoolArray, IntArray
from legcal.simulation.rendering.coarse_shadows import CoarseSurface
from legcal.simulation.rendering.rays import PixelRays, Single
from legcal.simulation.rendering.shading import Shaded
from legcal.simulation.rendering.shadows import Lamp, Occluders, seen_of_lamp

_LARGE = 20_000  # pixels of a solid from which its shadows are traced coarsely


@dataclass(frozen=True, eq=False)
class Part:
    """What is seen of one solid.

    Attributes
    ----------
    solid : int
        The solid, as an index.
    pixels : (n_pixels,) array of int
        The pixels that show it, in order.
    shaded : Shaded
        The light from its points.
    first : (n_pixels,) array of int or None
        The first point of each pixel where a pixel has several.
    """

    solid: int
    pixels: IntArray
    shaded: Shaded
    first: IntArray | None = None

    def faces(self, lamp: int) -> BoolArray:
        """Return the pixels in which the surface faces a lamp, (n_pixels,)."""
        faces = self.shaded.faces_lamp[lamp]
        return faces if self.first is None else np.logical_or.reduceat(faces, self.first)

    def radiance(self, seen: Sequence[Single | None], n_terms: int) -> Single:
        """Return the light of its pixels, (n_terms, n_channels, n_pixels), a sum over their points.

        Parameters
        ----------
        seen : sequence of (n_pixels,) array or None
            The share of each lamp that is seen; None for all of it.
        n_terms : int
            1 for the sum of all light, or one term more than lamps to have it apart.
        """
        lit = [
            light if share is None else light * self._spread(share)
            for light, share in zip(self.shaded.of_lamp, seen, strict=True)
        ]
        fixed = self.shaded.fixed
        terms = np.stack([fixed, *lit]) if n_terms > 1 else np.asarray(sum(lit, fixed))[None]
        if self.first is None:
            return terms
        return np.asarray(np.add.reduceat(terms, self.first, axis=-1))

    def _spread(self, share: Single) -> Single:
        """Return what holds for pixels for all of their points."""
        if self.first is None:
            return share
        return np.repeat(share, np.diff(self.first, append=self.shaded.P.shape[1]))


def shares_of_lamps(
    parts: Sequence[Part], lamps: Sequence[Lamp], occluders: Occluders, rays: PixelRays
) -> list[list[Single | None]]:
    """Return the share of each lamp that each part sees, for each part and lamp.

    A pixel with several points is traced from the first of them. Where a solid fills many
    pixels, some of them are traced.
    """
    found: list[list[Single | None]] = [[] for _ in parts]
    for k, lamp in enumerate(lamps):
        if not lamp.shadows:
            for shares in found:
                shares.append(None)
            continue
        lit = [np.flatnonzero(part.faces(k)) for part in parts]
        points = [_traced(part, some) for part, some in zip(parts, lit, strict=True)]
        small = [len(some) <= _LARGE for some in lit]
        together = [P for P, is_small in zip(points, small, strict=True) if is_small]
        owners = [np.full(P.shape[1], p.solid) for p, P in zip(parts, points, strict=True)]
        own = [o for o, is_small in zip(owners, small, strict=True) if is_small]
        seen = np.ones(0, dtype=np.float32)
        if together:
            P = np.concatenate(together, axis=1)
            seen = seen_of_lamp(lamp, P, occluders, np.concatenate(own))
        start = 0
        for part, some, P, is_small, shares in zip(parts, lit, points, small, found, strict=True):
            share = np.ones(len(part.pixels), dtype=np.float32)
            if is_small:
                share[some] = seen[start : start + len(some)]
                start += len(some)
            else:
                pixels = part.pixels[some]
                surface = CoarseSurface(rays, pixels, P[2])
                share[some] = surface.seen(lamp, occluders, part.solid).take(pixels)
            shares.append(share)
    return found


def _traced(part: Part, some: IntArray) -> Single:
    """Return a point of each of some pixels, (3, n)."""
    return part.shaded.P[:, some if part.first is None else part.first[some]]
