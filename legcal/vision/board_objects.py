"""Boards as OpenCV has them."""

import cv2

from legcal.vision.board import Board
from legcal.vision.board_dictionaries import dictionary


def charuco_board(board: Board) -> cv2.aruco.CharucoBoard:
    """Return a ChArUco board as OpenCV has it, its squares of the size of the board's [m]."""
    found = cv2.aruco.CharucoBoard(
        (board.columns, board.rows), board.side, board.marker, dictionary(board.dictionary)
    )
    found.setLegacyPattern(board.legacy)
    return found
