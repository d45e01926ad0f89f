"""The rays of a camera's pixels."""

from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from legcal.geometry.types import IntArray
from legcal.vision.camera import Camera

Single = NDArray[np.float32]
Faces = NDArray[np.integer[Any]]

_TILE = 64  # pixels after which the shifts of the lattice repeat
_ROWS = 256  # undistorted at a time


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
        x = np.empty((self.height, self.width), np.float32)
        y = np.empty_like(x)
        columns = np.arange(self.width, dtype=np.float64)
        for top in range(0, self.height, _ROWS):
            rows = np.arange(top, min(top + _ROWS, self.height), dtype=np.float64)
            pixels = np.stack(np.meshgrid(columns, rows), axis=-1)
            xy = camera.undistort(pixels)
            x[top : top + len(rows)], y[top : top + len(rows)] = xy[..., 0], xy[..., 1]
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
