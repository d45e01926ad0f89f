"""What each measurement of a fit depends on: positions of its unknowns in x, and its pose."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from legcal.geometry.types import IntArray
from legcal.refinement.layout import Layout
from legcal.refinement.observed import ObservedOutlines, Readings
from legcal.refinement.observed_axes import ObservedAxes
from legcal.refinement.observed_board import ObservedBoard
from legcal.refinement.rows import Places, places


@dataclass(frozen=True, eq=False)
class Couplings:
    """The unknowns of all measurements, by what they measure.

    Attributes
    ----------
    outlines, readings, axes, corners : Places
    """

    outlines: Places
    readings: Places
    axes: Places
    corners: Places


def couple(
    layout: Layout,
    outlines: ObservedOutlines,
    encoders: Readings,
    axes: ObservedAxes,
    board: ObservedBoard,
) -> Couplings:
    """Return what outlines, readings, axes and corners of the board depend on."""
    place, n_kept, n_poses = layout.place, layout.n_kept, layout.n_poses
    of_outlines = np.concatenate(
        [
            place[outlines.leg, :6],
            layout.camera[outlines.view],
            layout.radius[outlines.radius, None],
            layout.bias[outlines.bias_index],
            layout.intrinsic[outlines.view],
        ],
        axis=1,
    )
    of_axes = np.concatenate([place[axes.leg, :6], layout.camera[axes.view]], axis=1)
    of_corners = np.concatenate(
        [
            layout.camera[board.view],
            _for_each(layout.board, len(board)),
            _for_each(layout.board_scale, len(board)),
            layout.intrinsic[board.view],
        ],
        axis=1,
    )
    no_pose = np.zeros(len(board), dtype=np.intp)  # their derivatives by it are zero
    return Couplings(
        places(of_outlines, outlines.pose, n_kept, n_poses),
        places(place[encoders.leg, :7], encoders.pose, n_kept, n_poses),
        places(of_axes, axes.pose, n_kept, n_poses),
        places(of_corners, no_pose, n_kept, n_poses),
    )


def _for_each(position: IntArray, n: int) -> IntArray:
    """Return the same positions for each of n measurements."""
    return np.broadcast_to(position, (n, len(position)))
