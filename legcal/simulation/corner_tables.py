"""The corners of the board that simulated images show, with white noise."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from legcal.observations.corners import Corners, found_corners, join_corners
from legcal.simulation.images import Images, Viewpoint
from legcal.simulation.placed_board import PlacedBoard
from legcal.simulation.posed_machine import PosedMachine
from legcal.simulation.tables import EXACT_PX


def corners_of_images(
    images: Images,
    machines: Sequence[PosedMachine],
    viewpoints: Sequence[Viewpoint],
    placed: PlacedBoard,
    sigma_px: float,
    rng: np.random.Generator | None,
) -> Corners:
    """Return the corners of the board that images show, by row and number.

    Parameters
    ----------
    images : Images
        The images.
    machines, viewpoints : sequence
        The machine in every pose, with the board beside it, and the cameras.
    placed : PlacedBoard
        The board.
    sigma_px : float
        Standard deviation of each coordinate [px].
    rng : numpy.random.Generator or None
        Source of the noise; None leaves the corners exact.
    """
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
