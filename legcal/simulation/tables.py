"""The tables of simulated observations: outlines in pixels, and axes with the noise of Table 1."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.spatial.transform import RigidTransform

from legcal.geometry.types import Array
from legcal.observations.outlines import Outlines
from legcal.simulation.images import Images, Viewpoint
from legcal.simulation.observe import OutlineNoise, shifted_outlines
from legcal.simulation.posed_machine import PosedMachine
from legcal.simulation.silhouette import silhouette
from legcal.simulation.table_noise import AxisTable, TableNoise, observe_axes
from legcal.simulation.visibility import Stretch
from legcal.vision.camera import Camera

EXACT_PX = 1e-3  # standard deviation that outlines without noise claim for their edge points
_SIDEWAYS = 1e-3  # component along the image y axis below which a leg has no point M_LS


def outlines_of_images(
    images: Images,
    machines: Sequence[PosedMachine],
    viewpoints: Sequence[Viewpoint],
    sigma_px: float,
    rng: np.random.Generator | None,
) -> Outlines:
    """Return the outlines of all visible stretches, by row, leg and edge.

    Every pixel along an outline gives one edge point with white noise, and a line is fitted to
    them: the covariance of its offsets at the ends is known.

    Parameters
    ----------
    images : Images
        The images.
    machines, viewpoints : sequence
        The machine in every pose, and the cameras.
    sigma_px : float
        Standard deviation of an edge point [px].
    rng : numpy.random.Generator or None
        Source of the noise; None leaves the outlines exact.
    """
    claimed = max(sigma_px, EXACT_PX)
    rows, stretches, h, ends, covariances = [], [], [], [], []
    for row in range(len(images)):
        camera = viewpoints[images.view[row]].camera
        here = [s for leg in images.seen(row) for s in images.shown[row][leg].stretches]
        T_base_camera = viewpoints[images.view[row]].T_base_camera
        for stretch in here:
            line, pixels = _exact(
                camera, *_axis(machines[images.pose[row]], T_base_camera, stretch)
            )
            lengths = np.linalg.norm(pixels[:, 1] - pixels[:, 0], axis=-1)
            n_points = max(2, round(float(lengths.mean())))
            covariance = OutlineNoise(claimed, n_points).covariance
            if rng is not None and sigma_px > 0.0:
                offsets = rng.multivariate_normal(np.zeros(2), covariance, size=2)
                line, pixels = shifted_outlines(camera, line, pixels, offsets)
            rows.append(row)
            stretches.append(stretch)
            h.append(line)
            ends.append(pixels)
            covariances.append(covariance)
    n = 2 * len(rows)
    return Outlines(
        row=np.repeat(np.array(rows, dtype=np.intp), 2),
        leg=np.repeat(np.array([s.leg for s in stretches], dtype=np.intp), 2),
        part=tuple(s.part for s in stretches for _ in range(2)),
        edge=np.tile(np.array([1, 2], dtype=np.intp), len(rows)),
        h=np.array(h).reshape(n, 3),
        ends=np.array(ends).reshape(n, 2, 2),
        covariance=np.repeat(np.array(covariances).reshape(-1, 2, 2), 2, axis=0),
        used=np.ones(n, dtype=np.bool_),
        reason=("",) * n,
        source=("detected",) * n,
    )


def axes_of_images(
    images: Images,
    machines: Sequence[PosedMachine],
    viewpoints: Sequence[Viewpoint],
    noise: TableNoise,
    rng: np.random.Generator,
) -> AxisTable:
    """Return the table of the axes of all legs that images show, by row and leg.

    A leg parallel to the image x axis has no point M_LS = (x, 0, z) and is left out.

    Parameters
    ----------
    images, machines, viewpoints
        As in :func:`outlines_of_images`.
    noise : TableNoise
        What disturbs the axes.
    rng : numpy.random.Generator
        Source of the noise.
    """
    row, leg, u, A = [], [], [], []
    for r in range(len(images)):
        machine = machines[images.pose[r]]
        T = viewpoints[images.view[r]].T_base_camera.inv()
        for j in images.seen(r):
            along = machine.B[j] - machine.A[j]
            direction = T.rotation.apply(along / np.linalg.norm(along))
            if abs(direction[1]) > _SIDEWAYS:
                row.append(r)
                leg.append(j)
                u.append(direction)
                A.append(T.apply(machine.A[j]))
    shape = (len(row), 3)
    return observe_axes(
        np.array(row, dtype=np.intp),
        np.array(leg, dtype=np.intp),
        np.array(u).reshape(shape),
        np.array(A).reshape(shape),
        noise,
        rng,
    )


def _axis(
    machine: PosedMachine, T_base_camera: RigidTransform, stretch: Stretch
) -> tuple[Array, Array, float]:
    """Return the direction (3,) of a stretch and both ends (2, 3) of its axis in the camera."""
    A = machine.A[stretch.leg]
    along = machine.B[stretch.leg] - A
    u = along / np.linalg.norm(along)
    T_camera_base = T_base_camera.inv()
    ends = A + np.array([[stretch.start], [stretch.end]]) * u
    return T_camera_base.as_matrix()[:3, :3] @ u, T_camera_base.apply(ends), stretch.radius


def _exact(camera: Camera, u: Array, axis_ends: Array, radius: float) -> tuple[Array, Array]:
    """Return normals (2, 3) and ends (2, 2, 2) [px] of a cylinder between points of its axis."""
    h, offsets = silhouette(u, axis_ends[0], np.asarray(radius))
    return h, camera.project(axis_ends[None] + offsets[:, None])
