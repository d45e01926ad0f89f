"""What is printed on a face of a box, as rays see it."""

import numpy as np

from legcal.geometry.types import IntArray
from legcal.simulation.rendering.rays import Faces, PixelRays, Single
from legcal.simulation.rendering.solid_in_view import SolidInView
from legcal.simulation.shapes import Box

_PIXELS = 8192  # at a time


def printed(solid: SolidInView, x: Single, y: Single, face: Faces) -> Single | None:
    """Return factors (n,) of the albedo where rays meet a solid; None if nothing is printed on it.

    Parameters
    ----------
    solid : SolidInView
        The solid.
    x, y, face : (n,) array
        Rays (x, y, 1), and the faces that they meet.
    """
    sheet = solid.material.sheet
    if sheet is None or not isinstance(solid.shape, Box):
        return None
    height = (0.5 if sheet.face > 2 else -0.5) * solid.shape.size[2]
    origin = -solid.R.T @ solid.w
    a, b, c = (solid.R[:, i].tolist() for i in range(3))
    with np.errstate(divide="ignore", over="ignore", invalid="ignore"):
        depth = (height - float(origin[2])) / (x * c[0] + y * c[1] + c[2])
        u = float(origin[0]) + depth * (x * a[0] + y * a[1] + a[2])
        v = float(origin[1]) + depth * (x * b[0] + y * b[1] + b[2])
    factor = np.ones(len(x), dtype=np.float32)
    on = np.flatnonzero((face == sheet.face) & np.isfinite(u) & np.isfinite(v))
    factor[on] = sheet.reflectance(u[on], v[on])
    return factor


def printed_inside(
    solid: SolidInView, rays: PixelRays, pixels: IntArray, face: Faces, samples: int
) -> Single | None:
    """Return the mean of :func:`printed` over each of some pixels, (n,); None without a print.

    Parameters
    ----------
    solid : SolidInView
        The solid.
    rays : PixelRays
        The camera's rays.
    pixels, face : (n,) array
        Pixels that show one face of the solid, and which.
    samples : int
        Rays of each pixel.
    """
    if solid.material.sheet is None:
        return None
    means = []
    for start in range(0, len(pixels), _PIXELS):
        here = pixels[start : start + _PIXELS]
        x, y = rays.within(here, samples)
        faces = np.repeat(face[start : start + _PIXELS], samples)
        found = printed(solid, x.ravel(), y.ravel(), faces)
        if found is None:
            return None
        means.append(found.reshape(len(here), samples).mean(axis=1))
    return np.concatenate(means) if means else np.zeros(0, dtype=np.float32)
