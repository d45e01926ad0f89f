"""A small simulated photograph of a machine from a planned camera."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
from scipy.spatial.transform import RigidTransform

from legcal.machine.configurations import Configurations
from legcal.machine.model import Machine
from legcal.planning.laid_board import LaidBoard
from legcal.simulation.board import PlacedBoard
from legcal.simulation.rendering.appearance import Appearance
from legcal.simulation.rendering.scene import prepare_view
from legcal.simulation.solids import dressed, pose_machine
from legcal.vision.camera import Camera

_WIDTH = 400  # [px] of a preview


def preview(
    machine: Machine,
    camera: Camera,
    T_base_camera: RigidTransform,
    poses: Configurations,
    board: LaidBoard | None = None,
) -> bytes:
    """Return a JPEG of a machine in the first of some poses, without noise and clutter."""
    scale = min(_WIDTH / camera.width, 1.0)
    K = camera.K * [[scale], [scale], [1.0]]
    small = replace(
        camera, K=K, width=round(camera.width * scale), height=round(camera.height * scale)
    )
    first = Configurations(poses.configurations[:1], poses.readings[:1], poses.poses[:1])
    (posed,) = pose_machine(machine, dressed(machine, meshes_needed=False), first)
    if board is not None:
        posed = PlacedBoard(board.board, board.T_base_board).beside(posed)
    rng = np.random.default_rng(0)
    look = replace(Appearance(), clutter=0)
    image = prepare_view(posed.solids, small, T_base_camera, look, rng).render(posed.solids, rng)
    return cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, 85])[1].tobytes()
