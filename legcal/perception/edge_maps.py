"""Where pictures show edges of each direction, to compare many camera poses with at once.

A rod shows edges along itself wherever light changes across it: limbs, stripes of reflection, the
side in shadow. Thousands of camera poses are scored by the edges along the limbs that they predict,
in several pictures together. Pairs of clean edges suggest such poses, but one rod in two may have
none that is clean.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np

from legcal.geometry.types import Array, Image
from legcal.perception.pair_matching import CameraPoses, Pictures, projected
from legcal.perception.profiles import Samples
from legcal.vision.camera import Camera
from legcal.vision.image_file import Grey

N_DIRECTIONS = 12  # of edges, in half a turn
SMOOTH = 1.0  # of a picture before slopes are taken [cells]
NEARBY, STRONG = 31, 3.0  # an edge counts in full that is so many times the mean slope of so much
EVEN = 0.25  # of the mean slope of a picture, which is added to that
RIDGE = 0.8  # of the largest slope beside it, which an edge has
SAMPLES = 8  # points of a limb that are looked up
MOST_SAMPLES = 4_000_000  # that are looked up at once


@dataclass(frozen=True, eq=False)
class EdgeMaps:
    """Edges in pictures, on their sensor planes."""

    maps: Samples  # (n_pictures, N_DIRECTIONS, height, width), 0 to 1
    corner: Array  # (n_pictures, 2) x and y of the middle of the first cell
    cell: Array  # (n_pictures,) size of a cell

    @classmethod
    def of(
        cls,
        pictures: Sequence[Grey],
        moving: Sequence[Image | None],
        cameras: Sequence[Camera],
        factors: Sequence[int],
    ) -> EdgeMaps:
        """Return the edge maps of images reduced by factors, without static background if given."""
        grids = [_grid(*one) for one in zip(pictures, cameras, factors, strict=True)]
        flat = [
            (_on_plane(picture, grid), None if part is None else _on_plane(part, grid))
            for picture, part, (grid, _, _) in zip(pictures, moving, grids, strict=True)
        ]
        of_pictures = [_edges(picture, part) for picture, part in flat]
        shape = np.max([one.shape for one in of_pictures], axis=0)
        maps = np.zeros((len(pictures), *shape), dtype=np.float32)
        for into, of_picture in zip(maps, of_pictures, strict=True):
            into[:, : of_picture.shape[1], : of_picture.shape[2]] = of_picture
        corner = np.array([corner for _, corner, _ in grids])
        return cls(maps, corner, np.array([cell for _, _, cell in grids]))

    def take(self, chosen: slice) -> EdgeMaps:
        """Return the maps of some images."""
        return EdgeMaps(self.maps[chosen], self.corner[chosen], self.cell[chosen])

    def mirrored(self, middle: Array) -> EdgeMaps:
        """Return maps with left and right exchanged about middles x (n_pictures,)."""
        turned = np.roll(self.maps[:, ::-1, :, ::-1], 1, axis=1)
        last = self.corner[:, 0] + self.cell * (self.maps.shape[3] - 1)
        corner = np.stack([2.0 * middle - last, self.corner[:, 1]], axis=1)
        return EdgeMaps(np.ascontiguousarray(turned), corner, self.cell)

    def halved(self) -> EdgeMaps:
        """Return maps of half the size, with the strongest edge of four cells."""
        n, directions, height, width = self.maps.shape
        even = self.maps[:, :, : height // 2 * 2, : width // 2 * 2]
        fours = even.reshape(n, directions, height // 2, 2, width // 2, 2)
        corner = self.corner + 0.5 * self.cell[:, None]
        return EdgeMaps(fours.max(axis=(3, 5)), corner, 2.0 * self.cell)

    def blurred(self, cells: float) -> EdgeMaps:
        """Return maps in which edges count that are some cells away."""
        peak = np.float32(1.0 / (np.sqrt(2.0 * np.pi) * cells))  # of a line
        flat = self.maps.reshape(-1, *self.maps.shape[2:])
        soft = [np.minimum(cv2.GaussianBlur(one, (0, 0), cells) / peak, 1.0) for one in flat]
        return replace(self, maps=np.reshape(np.array(soft, dtype=np.float32), self.maps.shape))

    def scores(self, pictures: Pictures, poses: CameraPoses) -> Array:
        """Return the number of legs that poses explain in all images together, (n_poses,)."""
        samples = 2 * SAMPLES * pictures.ends.shape[1] * len(pictures)
        n = max(1, MOST_SAMPLES // max(samples, 1))
        chunks = [poses.take(slice(k, k + n)) for k in range(0, len(poses), n)]
        return np.concatenate([np.zeros(0), *(self._scores(pictures, some) for some in chunks)])

    def _scores(self, pictures: Pictures, poses: CameraPoses) -> Array:
        """Return the scores of poses that are few enough."""
        X, xy, width = projected(pictures, poses)
        front = np.all(X[..., 2] > pictures.min_depth, axis=-1)
        of_picture = (slice(None), *(np.newaxis,) * 4)
        at = (xy - self.corner[:, None, None, None]) / self.cell[of_picture]
        along = at[..., 1, :] - at[..., 0, :]  # (K, n, T, 2)
        along /= np.maximum(np.linalg.norm(along, axis=-1, keepdims=True), 1e-6)
        normal = np.stack([-along[..., 1], along[..., 0]], axis=-1)
        half = (0.5 * width / self.cell[of_picture[:4]])[..., None] * normal[..., None, :]
        limbs = np.stack([at - half, at + half], axis=-3)  # (K, n, T, 2 limbs, 2 ends, 2)
        place = ((np.arange(SAMPLES) + 0.5) / SAMPLES)[:, None]
        points = limbs[..., :1, :] + place * (limbs[..., 1:, :] - limbs[..., :1, :])
        turn = np.arctan2(along[..., 1], along[..., 0]) * (N_DIRECTIONS / np.pi)
        direction = np.rint(turn).astype(np.intp) % N_DIRECTIONS
        n_pictures, _, rows, columns = self.maps.shape
        column, row = np.floor(points[..., 0] + 0.5), np.floor(points[..., 1] + 0.5)
        inside = (row >= 0) & (row < rows) & (column >= 0) & (column < columns)
        inside &= front[..., None, None]
        row, column = (np.where(inside, x, 0).astype(np.intp) for x in (row, column))
        number = np.arange(n_pictures)[:, None, None] * N_DIRECTIONS + direction
        cells = (number * (rows * columns))[..., None, None] + row * columns + column
        value = np.where(inside, self.maps.reshape(-1)[cells], 0.0).mean(axis=(-1, -2))
        return np.asarray(np.einsum("knt,kt->n", value, pictures.share))


def _grid(picture: Grey, camera: Camera, factor: int) -> tuple[Samples | None, Array, float]:
    """Return the pixels (h, w, 2) of a reduced picture for even cells, their corner and size.

    None where the lens bends nothing.
    """
    K = camera.K
    height, width = picture.shape
    cell = factor / float(np.sqrt(K[0, 0] * K[1, 1]))
    corner = camera.undistort(np.full((1, 2), 0.5 * (factor - 1)))[0]
    if not camera.has_distortion and K[0, 0] == K[1, 1]:
        return None, corner, cell
    far = camera.undistort(np.array([[factor * width - 1.0, factor * height - 1.0]]))[0]
    n = np.clip(np.ceil((far - corner) / cell), 1, 2 * max(picture.shape)).astype(int)
    x, y = (corner[k] + cell * np.arange(n[k]) for k in (0, 1))
    xy = np.stack(np.meshgrid(x, y), axis=-1)
    pixels = camera.distort(xy.reshape(-1, 2)).reshape(xy.shape)
    return ((pixels + 0.5) / factor - 0.5).astype(np.float32), corner, cell


def _on_plane(picture: Image, grid: Samples | None) -> Samples:
    """Return a picture on even cells of the sensor plane."""
    even = picture.astype(np.float32)
    if grid is None:
        return even
    return np.asarray(cv2.remap(even, grid[..., 0], grid[..., 1], cv2.INTER_LINEAR))


def _edges(picture: Samples, moving: Samples | None) -> Samples:
    """Return the strength of edges by direction, (N_DIRECTIONS, height, width)."""
    smooth = cv2.GaussianBlur(np.sqrt(np.maximum(picture, 0.0)), (0, 0), SMOOTH)
    dx, dy = (np.asarray(cv2.Sobel(smooth, cv2.CV_32F, 1 - k, k)) for k in (0, 1))
    slope = cv2.magnitude(dx, dy)
    around = cv2.blur(slope, (NEARBY, NEARBY)) + EVEN * float(slope.mean()) + 1e-6
    edge = np.minimum(slope / (np.float32(STRONG) * around), np.float32(1.0))
    edge[slope < RIDGE * cv2.dilate(slope, np.ones((3, 3), np.uint8))] = 0.0
    if moving is not None:
        edge[moving < 0.5] = 0.0
    turn = (np.arctan2(dy, dx) + 0.5 * np.pi) * (N_DIRECTIONS / np.pi)
    low = np.floor(turn)
    share, low = (turn - low).astype(np.float32), low.astype(np.intp) % N_DIRECTIONS
    rows, columns = np.indices(picture.shape)
    maps = np.zeros((N_DIRECTIONS, *picture.shape), dtype=np.float32)
    maps[low, rows, columns] = edge * (1.0 - share)
    maps[(low + 1) % N_DIRECTIONS, rows, columns] += edge * share
    return maps
