"""What is recorded of a simulated machine: readings, hints, and the tables of its level."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from scipy.spatial.transform import RigidTransform

from legcal.data import (
    AXES_NAME,
    CORNERS_NAME,
    OBSERVATIONS_NAME,
    Corners,
    Measurements,
    Outlines,
    View,
    found_corners,
    join_corners,
    write_axis_table,
    write_corners,
    write_observations,
)
from legcal.geometry import Array
from legcal.simulation.board import PlacedBoard
from legcal.simulation.cameras import rough_pose
from legcal.simulation.folder import TRUTH, image_names, measurements_of
from legcal.simulation.imaged_machine import ImagedMachine
from legcal.simulation.observe import OutlineNoise, shifted_outlines
from legcal.simulation.settings import Level, SimulationSettings
from legcal.simulation.solids import PosedMachine
from legcal.simulation.table_noise import AxisTable, TableNoise, observe_axes
from legcal.simulation.truth import Distribution
from legcal.simulation.visibility import Images, Stretch, Viewpoint, silhouette
from legcal.vision import Camera

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


def corners_of_images(
    images: Images,
    machines: Sequence[PosedMachine],
    viewpoints: Sequence[Viewpoint],
    placed: PlacedBoard,
    sigma_px: float,
    rng: np.random.Generator | None,
) -> Corners:
    """Return the corners of the board that images show, by row and number."""
    P_base = placed.T_base_board.apply(placed.board.points)
    found = []
    for row in range(len(images)):
        view = viewpoints[images.view[row]]
        seen = placed.seen(machines[images.pose[row]], view.camera, view.T_base_camera)
        corner = np.flatnonzero(seen)
        px = view.camera.project(view.T_base_camera.inv().apply(P_base[corner]))
        if rng is not None:
            px = px + sigma_px * rng.normal(size=px.shape)
            size = np.array([view.camera.width, view.camera.height]) - 0.5
            inside = np.all((px >= -0.5) & (px <= size), axis=1)
            corner, px = corner[inside], px[inside]
        sigma = np.full(len(corner), max(sigma_px, EXACT_PX))
        found.append(found_corners(np.full(len(corner), row, dtype=np.intp), corner, px, sigma))
    return join_corners(found)


_OFTEN = 0.5  # of the photographs of a view that show a leg which its hint names


def recorded(
    imaged: ImagedMachine, settings: SimulationSettings, chance: Mapping[str, np.random.Generator]
) -> Measurements:
    """Return the rows of the dataset: readings with their errors, and what is told of cameras."""
    legs, images = imaged.truth.leg_names, imaged.images
    # Tables say themselves what is seen; in photographs nobody looks for a leg that often hides.
    least = _OFTEN if settings.level is Level.PHOTOGRAPHS else 0.0
    views = []
    for v, view in enumerate(imaged.views):
        T = rough_pose(view.T_base_camera, chance["hints"])
        shown = tuple(legs[j] for j in images.seen_in_view(v, least))
        hint = shown if 0 < len(shown) < len(legs) else None
        hints = (T, hint) if settings.hints and not imaged.groups else (None, None)
        views.append(View(view.name, view.camera, *hints))
    q, size = imaged.poses.readings, settings.readings.size
    if settings.readings.distribution is Distribution.UNIFORM:
        q = q + chance["readings"].uniform(-size, size, q.shape)
    else:
        q = q + size * chance["readings"].normal(size=q.shape)
    names = [""] * len(images)
    if settings.level is Level.PHOTOGRAPHS:
        names = image_names(images, imaged.views, imaged.labels)
    return measurements_of(images, views, imaged.labels, names, q, settings.encoder_sigma)


def write_tables(
    folder: Path,
    imaged: ImagedMachine,
    m: Measurements,
    settings: SimulationSettings,
    chance: Mapping[str, np.random.Generator],
) -> None:
    """Write the tables that the level asks for, and exact outlines and corners beside the truth."""
    images, machines, views = imaged.images, imaged.machines, imaged.views
    legs = imaged.truth.leg_names
    if imaged.board is not None:
        placed, sigma_px = imaged.board, settings.sigma_px
        exact_corners = corners_of_images(images, machines, views, placed, 0.0, None)
        write_corners(folder / TRUTH / CORNERS_NAME, exact_corners, m)
        if settings.level is not Level.PHOTOGRAPHS:
            corners = corners_of_images(
                images, machines, views, placed, sigma_px, chance["corners"]
            )
            write_corners(folder / CORNERS_NAME, corners, m)
    exact = outlines_of_images(images, machines, views, 0.0, None)
    write_observations(folder / TRUTH / "outlines.csv", exact, m, legs)
    if settings.level is Level.OUTLINES:
        noisy = outlines_of_images(
            images, machines, views, settings.sigma_px, chance["observations"]
        )
        write_observations(folder / OBSERVATIONS_NAME, noisy, m, legs)
    elif settings.level is Level.AXES:
        axes = axes_of_images(images, machines, views, settings.table, chance["observations"])
        write_axis_table(folder / AXES_NAME, axes.row, axes.leg, axes.values, axes.sigmas, m, legs)
