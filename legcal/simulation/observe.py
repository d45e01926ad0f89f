"""What simulated cameras see: outlines with noise in pixels."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from legcal.data import Outlines
from legcal.geometry import Array, IntArray
from legcal.simulation.visibility import silhouette
from legcal.vision import Camera


@dataclass(frozen=True)
class OutlineNoise:
    """White noise of the edge points of an outline."""

    sigma_px: float = 0.1  # standard deviation of each point [px]
    n_points: int = 300  # points of each outline, equally spaced

    @property
    def covariance(self) -> Array:
        """Covariance of the fitted line's offsets at its ends, (2, 2) [px^2]."""
        t = np.linspace(0.0, 1.0, self.n_points)
        design = np.stack([1.0 - t, t], axis=-1)
        return np.asarray(self.sigma_px**2 * np.linalg.inv(design.T @ design))


def exact_outlines(
    camera: Camera, u: Array, M: Array, length: Array, radius: Array, *, margin: float = 0.15
) -> tuple[Array, Array]:
    """Return the outlines of legs without noise."""
    h, offsets = silhouette(u, M, radius)
    parts = np.array([margin, 1.0 - margin])
    axis_points = M[:, None] + (length[:, None] * parts)[..., None] * u[:, None]
    return h, camera.project(axis_points[:, None] + offsets[:, :, None])


def shifted_outlines(camera: Camera, h: Array, ends: Array, offsets: Array) -> tuple[Array, Array]:
    """Return outlines whose ends are moved across the line by offsets in pixels."""
    xy = camera.undistort(ends)
    J = camera.pixels_per_unit(xy)
    ab = np.broadcast_to(h[..., None, :2], xy.shape)
    normal = np.linalg.solve(np.swapaxes(J, -1, -2), ab[..., None])[..., 0]
    normal /= np.linalg.norm(normal, axis=-1, keepdims=True)
    moved = ends + offsets[..., None] * normal
    xy = camera.undistort(moved)
    rays = np.concatenate([xy, np.ones((*xy.shape[:-1], 1))], axis=-1)
    n = np.cross(rays[..., 0, :], rays[..., 1, :])
    n *= np.sign(np.sum(n * h, axis=-1, keepdims=True))
    return n / np.linalg.norm(n, axis=-1, keepdims=True), moved


def observe_outlines(
    camera: Camera,
    legs: tuple[Array, Array, Array, Array],
    noise: OutlineNoise,
    rng: np.random.Generator | None,
) -> tuple[Array, Array]:
    """Return the outlines of legs (u, A, length, radius) with noise; without it if rng is None."""
    h, ends = exact_outlines(camera, *legs)
    if rng is None:
        return h, ends
    offsets = rng.multivariate_normal(np.zeros(2), noise.covariance, size=h.shape[:2])
    return shifted_outlines(camera, h, ends, offsets)


def outline_table(
    rows: Sequence[int],
    seen: Sequence[IntArray],
    h: Sequence[Array],
    ends: Sequence[Array],
    parts: Sequence[str],
    noise: OutlineNoise,
) -> Outlines:
    """Return the table of outlines of images: by row, then leg, then edge."""
    row = np.concatenate([np.full(2 * len(s), r) for r, s in zip(rows, seen, strict=True)])
    leg = np.concatenate([np.repeat(s, 2) for s in seen])
    n = len(row)
    return Outlines(
        row=row.astype(np.intp),
        leg=leg.astype(np.intp),
        part=tuple(parts[j] for j in leg),
        edge=np.tile(np.array([1, 2], dtype=np.intp), n // 2),
        h=np.concatenate([x.reshape(-1, 3) for x in h]),
        ends=np.concatenate([x.reshape(-1, 2, 2) for x in ends]),
        covariance=np.broadcast_to(noise.covariance, (n, 2, 2)).copy(),
        used=np.ones(n, dtype=np.bool_),
        reason=("",) * n,
        source=("detected",) * n,
    )
