"""Shadows on large surfaces: traced at some pixels, smooth in between."""

import cv2
import numpy as np

from legcal.geometry.types import IntArray
from legcal.simulation.rendering.rays import PixelRays, Single
from legcal.simulation.rendering.shadows import Lamp, Occluders, seen_of_lamp

_STEP = 4  # [px] between traced pixels


def seen_coarsely(
    lamp: Lamp,
    rays: PixelRays,
    pixels: IntArray,
    z: Single,
    occluders: Occluders,
    own: int = -1,
) -> Single:
    """Return the share of a lamp that a large surface sees, (n,).

    Parameters
    ----------
    lamp : Lamp
        The lamp.
    rays : PixelRays
        The camera's rays.
    pixels : (n,) array of int
        The pixels that show the surface, in order.
    z : (n,) array
        Their depths [m].
    occluders : Occluders
        What may stand between.
    own : int, optional
        The surface's own solid among them.
    """
    is_traced = np.zeros((rays.height, rays.width), dtype=np.bool_)
    is_traced[_STEP // 2 :: _STEP, _STEP // 2 :: _STEP] = True
    traced = np.flatnonzero(is_traced.ravel()[pixels])
    i, j = np.divmod(pixels[traced], rays.width)
    i, j = i // _STEP, j // _STEP
    x, y, depth = rays.x[pixels[traced]], rays.y[pixels[traced]], z[traced]
    P = np.stack([x * depth, y * depth, depth])
    shape = -(-rays.height // _STEP), -(-rays.width // _STEP)
    share, known = np.zeros(shape, np.float32), np.zeros(shape, np.float32)
    share[i, j], known[i, j] = seen_of_lamp(lamp, P, occluders, own), 1.0
    around = cv2.blur(known, (3, 3))
    spread = np.divide(
        cv2.blur(share, (3, 3)), around, out=np.ones_like(share), where=around > 0.05
    )
    share = np.where(known > 0.0, share, spread)
    share = np.asarray(cv2.GaussianBlur(share, (3, 3), 0.0), np.float32)  # contacts show steps
    fine = cv2.resize(share, None, fx=_STEP, fy=_STEP, interpolation=cv2.INTER_LINEAR)
    whole = np.ascontiguousarray(fine[: rays.height, : rays.width], dtype=np.float32)
    return np.asarray(whole.ravel()[pixels])
