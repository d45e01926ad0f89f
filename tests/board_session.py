"""A calibration board on the base of a simulated machine, and what images show of its corners."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from machine_session import MachineSession
from scipy.spatial.transform import RigidTransform, Rotation

from legcal.calibration.joint_fit.factors import BoardCorners
from legcal.calibration.joint_fit.variables import Start
from legcal.data.corners import Corners, found_corners
from legcal.geometry.types import Array
from legcal.vision.board import Board

BOARD = Board("chessboard", 7, 6, 0.025)
SIGMA_PX = 0.05


def place_of_board(session: MachineSession) -> RigidTransform:
    """Return T_Rb_board: it lies flat under the middle of the legs, its z down into the base."""
    ends = [leg.A for leg in session.truth.legs]
    ends += [T.apply(leg.B) for T in session.truth.T_Rb_Re[:1] for leg in session.truth.legs]
    middle = np.mean(ends, axis=0) - BOARD.points.mean(axis=0)
    turn = Rotation.from_euler("xz", [np.pi, 0.4])
    return RigidTransform.from_components(middle, turn)


def corners_of(
    session: MachineSession, board: Board = BOARD, *, seed: int | None = None
) -> Corners:
    """Return the corners in every image, exact or with the errors that they claim."""
    T_Rb_board = place_of_board(session)
    seen, views = [], session.measurements.view
    for row, v in enumerate(views.tolist()):
        camera = session.measurements.views[v].camera
        in_camera = (session.truth.T_camera_Rb[v] * T_Rb_board).apply(board.points)
        seen.append((np.full(len(in_camera), row), camera.project(in_camera)))
    of_row = np.concatenate([r for r, _ in seen])
    px: Array = np.concatenate([p for _, p in seen])
    if seed is not None:
        px = px + SIGMA_PX * np.random.default_rng(seed).standard_normal(px.shape)
    corner = np.tile(np.arange(board.n_corners), len(views))
    return found_corners(of_row, corner, px, np.full(len(px), SIGMA_PX))


def with_board(session: MachineSession, corners: Corners) -> tuple[BoardCorners, Start]:
    """Return what is seen of the board, and the wrong start with a board that is wrong as well."""
    wrong = RigidTransform.from_components([0.004, -0.003, 0.005], Rotation.from_rotvec([0.02] * 3))
    start = replace(session.start, T_Rb_board=place_of_board(session) * wrong)
    return BoardCorners(BOARD, corners), start
