"""The rays of a camera's pixels."""

from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import RectBivariateSpline

from legcal.geometry.types import IntArray
from legcal.vision.camera import Camera

Single = NDArray[np.float32]
Faces = NDArray[np.integer[Any]]

_TILE = 64  # pixels after which the shifts of the lattice repeat
_SPACING = 8  # [px] between the pixels at which distortion is undone


class PixelRays:
    """The points (x, y) of the sensor plane seen at every pixel, and between pixels.

    In single precision: 3e-8 of the sensor plane, 1e-4 px of a long lens.

    Parameters
    ----------
    camera : Camera
        The camera.
    """

    def __init__(self, camera: Camera) -> None:
        self.camera = camera
        self.width, self.height = camera.width, camera.height
        x, y = _undistorted(camera)
        self.x: Single = x.ravel()
        self.y: Single = y.ravel()
        self.low = np.array([x.min(), y.min()], dtype=np.float64)
        self.high = np.array([x.max(), y.max()], dtype=np.float64)

    def within(self, pixels: IntArray, samples: int) -> tuple[Single, Single]:
        """Return several points (x, y) inside each of some pixels, both (n, samples).

        They are a Fibonacci lattice, shifted differently in each pixel, so that the share of
        them on one side of an edge is an unbiased estimate of the pixel's area there.

        Parameters
        ----------
        pixels : (n,) array of int
            Pixels as row * width + column.
        samples : int
            A Fibonacci number.
        """
        rows, columns = np.divmod(pixels, self.width)
        du, dv = _offsets(samples)
        tile = rows % _TILE * _TILE + columns % _TILE
        du, dv = du[tile], dv[tile]
        left = np.where(columns > 0, pixels - 1, pixels)
        right = np.where(columns < self.width - 1, pixels + 1, pixels)
        above = np.where(rows > 0, pixels - self.width, pixels)
        below = np.where(rows < self.height - 1, pixels + self.width, pixels)
        across = (right - left).astype(np.float32)[:, None]
        down = ((below - above) // self.width).astype(np.float32)[:, None]
        points = []
        for grid in (self.x, self.y):
            along_u = (grid[right] - grid[left])[:, None] / across
            along_v = (grid[below] - grid[above])[:, None] / down
            point = along_u * du
            point += along_v * dv
            point += grid[pixels][:, None]
            points.append(point)
        return points[0], points[1]


def _undistorted(camera: Camera) -> tuple[Single, Single]:
    """Return the sensor plane's x and y at every pixel, (height, width).

    Distortion is undone at some pixels and is a quintic spline in between, to 1e-6 px.
    """
    v, u = (np.linspace(0.0, n - 1.0, max(n // _SPACING, 6)) for n in (camera.height, camera.width))
    xy = camera.undistort(np.stack(np.meshgrid(u, v), axis=-1))
    rows, columns = np.arange(float(camera.height)), np.arange(float(camera.width))
    x, y = (
        RectBivariateSpline(v, u, xy[..., i], kx=5, ky=5, s=0.0)(rows, columns).astype(np.float32)
        for i in (0, 1)
    )
    return x, y


@lru_cache(maxsize=4)
def pixel_rays(camera: Camera) -> PixelRays:
    """Return the rays of a camera, the same ones for all of its images."""
    return PixelRays(camera)


@lru_cache(maxsize=4)
def _offsets(samples: int) -> tuple[Single, Single]:
    """Return where in each pixel of a tile the rays are, (_TILE * _TILE, samples) [px]."""
    before, now = 1, 1
    while now < samples:
        before, now = now, before + now
    i = np.arange(samples)
    lattice = np.stack([(i + 0.5) / samples, (i * before % samples + 0.5) / samples])
    shifts = np.random.default_rng(0).random((2, _TILE * _TILE, 1))
    u, v = ((lattice[:, None] + shifts) % 1.0 - 0.5).astype(np.float32)
    return u, v
