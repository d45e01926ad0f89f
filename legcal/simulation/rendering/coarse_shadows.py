"""Shadows on large surfaces: traced at some pixels, smooth in between."""

import cv2
import numpy as np

from legcal.geometry.types import IntArray
from legcal.simulation.rendering.rays import PixelRays, Single
from legcal.simulation.rendering.shadows import Lamp, Occluders, seen_of_lamp

_STEP = 4  # [px] between traced pixels


class CoarseSurface:
    """A large surface: the points of it that are traced.

    Parameters
    ----------
    rays : PixelRays
        The camera's rays.
    pixels : (n,) array of int
        The pixels that show the surface, in order.
    z : (n,) array
        Their depths [m].
    """

    def __init__(self, rays: PixelRays, pixels: IntArray, z: Single) -> None:
        is_traced = np.zeros((rays.height, rays.width), dtype=np.bool_)
        is_traced[_STEP // 2 :: _STEP, _STEP // 2 :: _STEP] = True
        traced = np.flatnonzero(is_traced.ravel()[pixels])
        x, y, depth = rays.x[pixels[traced]], rays.y[pixels[traced]], z[traced]
        i, j = np.divmod(pixels[traced], rays.width)
        self._rays = rays
        self._where = i // _STEP, j // _STEP
        self._P: Single = np.stack([x * depth, y * depth, depth])

    def seen(self, lamp: Lamp, occluders: Occluders, own: int = -1) -> Single:
        """Return the share of a lamp that the surface sees, (width * height,).

        Parameters
        ----------
        lamp : Lamp
            The lamp.
        occluders : Occluders
            What may stand between.
        own : int, optional
            The surface's own solid among them.

        Returns
        -------
        (width * height,) array
            For all pixels; what does not show the surface has some number between 0 and 1.
        """
        shape = -(-self._rays.height // _STEP), -(-self._rays.width // _STEP)
        share, known = np.zeros(shape, np.float32), np.zeros(shape, np.float32)
        share[self._where] = seen_of_lamp(lamp, self._P, occluders, own)
        known[self._where] = 1.0
        around = cv2.blur(known, (3, 3))
        spread = np.divide(
            cv2.blur(share, (3, 3)), around, out=np.ones_like(share), where=around > 0.05
        )
        share = np.where(known > 0.0, share, spread)
        share = np.asarray(cv2.GaussianBlur(share, (3, 3), 0.0), np.float32)  # contacts show steps
        fine = cv2.resize(share, None, fx=_STEP, fy=_STEP, interpolation=cv2.INTER_LINEAR)
        whole = fine[: self._rays.height, : self._rays.width]
        return np.ascontiguousarray(whole, dtype=np.float32).ravel()
