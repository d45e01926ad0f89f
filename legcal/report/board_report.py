"""What a calibration tells of the calibration board, in ``result.json`` and for people."""

from __future__ import annotations

from typing import Any

import numpy as np
from scipy.spatial.transform import RigidTransform

from legcal.calibration import Calibration
from legcal.geometry.frames import motion_to_xyz_quat
from legcal.refinement.known_parameters import BOARD_SCALE


def board_document(calibration: Calibration) -> dict[str, Any]:
    """Return where the board stands and how well its corners fit; nothing where there is none.

    R_b is laid on the nominal one, so that ``T_base_board`` differs from what the dataset says of
    it by where R_b really stands.
    """
    solution, found = calibration.solution, _place(calibration)
    if found is None:
        return {}
    given = calibration.dataset.T_base_board
    return {
        "board": {
            "T_base_board": motion_to_xyz_quat(found),
            "given": None if given is None else motion_to_xyz_quat(given),
            "scale": solution.values.get(BOARD_SCALE, 1.0),
            "rms_px": solution.rms_corners_px,
        }
    }


def board_lines(calibration: Calibration) -> list[str]:
    """Return the same in a sentence."""
    solution, found, corners = calibration.solution, _place(calibration), calibration.corners
    if found is None or corners is None:
        return []
    images = len(np.unique(corners.row[corners.used]))
    line = (
        f"Calibration board: {int(corners.used.sum())} of {len(corners)} corners used, in {images} "
        f"images, {solution.rms_corners_px or 0.0:.3f} px rms."
    )
    given = calibration.dataset.T_base_board
    if given is not None:
        apart = given.inv() * found
        line += (
            f" It stands {1e3 * np.linalg.norm(apart.translation):.2f} mm and "
            f"{np.degrees(apart.rotation.magnitude()):.3f} deg from where the dataset has it, if "
            "the joints of the base stand where the nominal model has them."
        )
    return [line]


def _place(calibration: Calibration) -> RigidTransform | None:
    """Return T_base_board, with R_b laid on the nominal one."""
    T_Rb_board = calibration.solution.T_Rb_board
    return None if T_Rb_board is None else calibration.dataset.mechanism.T_base_Rb * T_Rb_board
