"""A board or a camera that moved between the images of a view."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from scipy.stats import chi2

from legcal.geometry.types import Array
from legcal.observations.view_names import few
from legcal.vision.board import Board
from legcal.vision.camera import Camera
from legcal.vision.plane_pose import PlanePose

LEAST_PX = 0.15  # by which corners must shift together
SIGNIFICANCE = 1e-6  # of a motion, for each pair of images


def moved_board(
    name: str,
    single: Mapping[int, PlanePose],
    scale: float,
    board: Board,
    camera: Camera,
    names: tuple[str, ...],
) -> str | None:
    """Return in which images of a view the board stands elsewhere than in most, and how far.

    Parameters
    ----------
    name : str
        The view.
    single : mapping of int to PlanePose
        The pose by each image alone, by its row.
    scale : float
        By how much residuals exceed what corners claim.
    board, camera
        The board and the camera.
    names : tuple of str
        What each row is called.

    Returns
    -------
    str or None
        A sentence; None if nothing moved.
    """
    rows = list(single)
    if len(rows) < 2:
        return None
    limit = float(chi2.isf(SIGNIFICANCE / len(rows), 6)) * scale**2
    px = {
        row: camera.project(pose.T_camera_plane.apply(board.points)) for row, pose in single.items()
    }
    together = np.array(
        [[_agree(single[a], single[b], px[a] - px[b], limit) for b in rows] for a in rows]
    )
    most = int(np.argmax(together.sum(axis=1)))
    others = [row for row, same in zip(rows, together[most], strict=True) if not same]
    if not others:
        return None
    reference = single[rows[most]].T_camera_plane
    moves = [reference.inv() * single[row].T_camera_plane for row in others]
    middle = board.points.mean(axis=0)
    far = max(float(np.linalg.norm(T.apply(middle) - middle)) for T in moves)
    turn = max(float(T.rotation.magnitude()) for T in moves)
    told = few([names[row] for row in others])
    return (
        f"view {name}: its camera could not be placed: found the board elsewhere in {told} than in "
        f"{names[rows[most]]}, by up to {1e3 * far:.2g} mm and {np.rad2deg(turn):.2g} degrees, "
        "needed a camera and a board that stand still in all images of a view; leave those images "
        "out, or give them a view of their own."
    )


def _agree(one: PlanePose, other: PlanePose, shift_px: Array, limit: float) -> bool:
    """Say whether two poses of the board are one, within what is known of them."""
    if float(np.sqrt(np.mean(np.sum(shift_px**2, axis=1)))) < LEAST_PX:
        return True
    a, b = one.T_camera_plane, other.T_camera_plane
    turn = (b.rotation * a.rotation.inv()).as_rotvec()
    d = np.concatenate([b.translation - a.translation, turn])
    covariance = np.linalg.inv(one.information) + np.linalg.inv(other.information)
    return bool(d @ np.linalg.solve(covariance, d) < limit)
