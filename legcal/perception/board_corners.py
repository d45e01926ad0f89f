"""Corners of the calibration board in images: searched, fitted as saddles of grey levels, judged.

:func:`search_board` is for one image, :func:`detect_corners` for those of a dataset; where no image
shows the board, :func:`require_board` says what they show instead.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Collection, Sequence
from dataclasses import dataclass, field, replace
from functools import lru_cache, partial

import cv2
import numpy as np
from numpy.typing import NDArray

from legcal.data.corners import Corners, found_corners, join_corners
from legcal.data.dataset import MIN_CORNERS
from legcal.data.measurements import Measurements
from legcal.errors import NotVisible
from legcal.geometry.tables import Table
from legcal.geometry.types import Array, BoolArray, IntArray
from legcal.perception.corner_lattice import (
    Print,
    Saddles,
    expected,
    find_lattice,
    fit_saddles,
    measured,
    near_saddles,
)
from legcal.perception.placement import Load
from legcal.progress import Report
from legcal.vision.board import APRIL_TAGS, DICTIONARIES, Board, charuco_board, dictionary
from legcal.vision.image_file import Grey, possible_scale, quiet_opencv, reduced, rescaled
from legcal.workers import Run

STAGE = "Searching the board"
MAX_ASKED = 2  # images of a view that are searched for other boards

_STRAIGHT_AROUND = 0.9  # of what is straight around a corner that is used
_FRAME = 0.2  # of the side of a tag that its black frame is wide, as Kalibr prints it
_SEARCHED = (300_000, 1_200_000, 80_000)  # pixels of the images in which lattices are searched
_MAX_BLUR = 2.2  # [px]: more is measured in a smaller image,
_MEASURED_BLUR = 1.4  # where it is so much
_N_ASKED = 9  # corners by which the blur is known
_SAME = 0.45  # scale of a search from which on corners are found in the image itself
_MIN_LINE = 0.34  # of the corners of the line inside it, that an outer line of a lattice has
_SIGMA_CIRCLE = 0.03  # standard deviation of the centre of a circle [px]
_MIN_SIDE = 3  # corners along the sides of a chessboard whose extent counts


@dataclass(frozen=True, eq=False)
class SeenBoard:
    """The corners of a board in an image."""

    # (k, 2) columns and rows of the corners: those of the board, but of a chessboard from the first
    # that is seen
    ij: IntArray
    px: Array  # (k, 2) where they are [px]
    sigma_px: Array  # (k,) standard deviation of either coordinate [px]
    black: IntArray  # (k,) 1 where the square at greater column and row is black, else -1
    # (m,) numbers of markers or tags of the dictionary, also those that are not on the board
    tags: IntArray = field(default_factory=lambda: np.zeros(0, dtype=np.intp))
    tags_px: Array = field(default_factory=lambda: np.zeros((0, 2)))  # (m, 2) their middles [px]

    @property
    def extent(self) -> tuple[int, int]:
        """Columns and rows from the first to the last corner, the larger number first."""
        if not len(self.ij):
            return 0, 0
        y, x = sorted((np.ptp(self.ij, axis=0) + 1).tolist())
        return x, y

    def numbered(self, board: Board) -> NumberedCorners:
        """Return the corners with their numbers on a board; none where they are not of it.

        The corners of a part of a chessboard may be numbered in several ways, which differ by
        whole squares and turns; it is one of these, and not certain. Such a choice moves the board
        before the camera and nothing else if the board is flat; of a bent one or an uneven print a
        quarter turn also exchanges both sides.
        """
        nx, ny = board.grid
        if board.kind != "chessboard" or not len(self.ij):
            at = self.ij[:, 1] * nx + self.ij[:, 0]
            return self._in_order(at, certain=True)
        ways = []
        ij, black = self.ij, self.black
        for _ in range(4):
            spare = np.array([nx, ny]) - np.ptp(ij, axis=0) - 1
            for shift in np.ndindex(*np.maximum(spare + 1, 0).tolist()):
                at = ij - ij.min(axis=0) + shift
                if np.mean((at.sum(axis=1) % 2 == 0) == (black > 0)) > 0.5:
                    ways.append(at[:, 1] * nx + at[:, 0])
            ij, black = np.column_stack([-ij[:, 1], ij[:, 0]]), -black
        if not ways:
            return self._in_order(np.zeros(0, dtype=np.intp), certain=False)
        return self._in_order(ways[0], certain=len(ways) == 1)

    def _in_order(self, numbers: IntArray, *, certain: bool) -> NumberedCorners:
        order = np.argsort(numbers)
        return NumberedCorners(numbers[order], self.px[order], self.sigma_px[order], certain)


@dataclass(frozen=True, eq=False)
class NumberedCorners(Table):
    """Corners of a board in an image."""

    number: IntArray  # (k,) on the board, ascending
    px: Array  # (k, 2)
    sigma_px: Array  # (k,) of either coordinate [px]
    certain: bool  # whether the numbers could be no others


def certain_corners(board: Board, seen: SeenBoard) -> tuple[IntArray, Array, Array]:
    """Return the corners of a seen board if their numbers are certain.

    Of a chessboard some corner of each outer line must be seen.

    Returns numbers (k,); px (k, 2); sigma_px (k,) [px].
    """
    detection = seen.numbered(board)
    if not detection.certain or len(detection.number) < MIN_CORNERS:
        return np.zeros(0, dtype=np.intp), np.zeros((0, 2)), np.zeros(0)
    return detection.number, detection.px, detection.sigma_px


def search_board(
    board: Board,
    image: NDArray[np.generic],  # (height, width) grey levels, 0 to 255
) -> SeenBoard:
    """Detect a board in an image; a chessboard of any extent.

    Corners whose surroundings are not those of a board, or partly hidden, are left out.
    """
    grey = np.ascontiguousarray(image, dtype=np.float32)
    tags = np.zeros(0, dtype=np.intp), np.zeros((0, 2))
    if board.has_circles:
        return _circles(board, grey)
    if board.kind == "chessboard":
        ij, saddles = _chessboard(grey)
    else:
        (ij, saddles), tags = _tags_and_corners(board, grey)
    black = np.where(saddles.contrast > 0.0, 1, -1)
    return SeenBoard(ij, saddles.px, saddles.sigma_px, black, *tags)


def _circles(board: Board, grey: Grey) -> SeenBoard:
    """Detect the whole grid of circles by OpenCV; of one that is cut off nothing is found."""
    how = cv2.SimpleBlobDetector.Params()
    how.maxArea = grey.size / board.n_corners  # larger blobs, as of the sheet, confuse the search
    is_plain = board.kind == "circles"
    layout = cv2.CALIB_CB_SYMMETRIC_GRID if is_plain else cv2.CALIB_CB_ASYMMETRIC_GRID
    blobs = cv2.SimpleBlobDetector.create(how)
    with quiet_opencv():
        found, px = cv2.findCirclesGrid(_eight_bits(grey), board.grid, None, layout, blobs)
    k = np.arange(board.n_corners if found else 0)
    ij = np.column_stack([k % board.columns, k // board.columns])
    at = np.reshape(px, (-1, 2)).astype(np.float64) if found else np.zeros((0, 2))
    return SeenBoard(ij, at, np.full(len(k), _SIGMA_CIRCLE), np.ones_like(k))


def _chessboard(grey: Grey) -> tuple[IntArray, Saddles]:
    """Return columns and rows of the corners of a chessboard, and where they are."""
    board = Print(None, None, 0.5 * _STRAIGHT_AROUND, 1.0, 1.0)
    ij, px, scale_of_best = np.zeros((0, 2), dtype=np.intp), np.zeros((0, 2)), 1.0
    for scale in dict.fromkeys(possible_scale(grey, 1.0, pixels) for pixels in _SEARCHED):
        found = find_lattice(rescaled(grey, scale))
        if len(found[0]) > len(ij):
            (ij, px), scale_of_best = found, scale
        columns, rows = np.ptp(ij, axis=0) + 1 if len(ij) else (0, 0)
        if len(ij) >= columns * rows and min(columns, rows) >= _MIN_SIDE:
            break
    ij, saddles = _measured_twice(grey, board, ij, px, scale_of_best)
    kept = _without_loose_lines(ij)
    return ij[kept] - (ij[kept].min(axis=0) if kept.any() else 0), saddles.choose(kept)


def _measured_twice(
    grey: Grey, board: Print, ij: IntArray, px: Array, scale: float
) -> tuple[IntArray, Saddles]:
    """Measure corners px (k, 2) of a smaller image, first there and then in the image itself.

    One that is blurred over many pixels is made smaller for that.
    """
    blur = 0.0
    if len(ij) and (scale < _SAME or scale > 1.0):
        ij, saddles = measured(rescaled(grey, scale), board, ij, px, grow=False)
        px, blur = reduced(saddles.px, scale), _usual_blur(saddles) / scale
    elif len(ij):
        px = reduced(px, scale)
        some = np.linspace(0, len(ij) - 1, min(_N_ASKED, len(ij))).astype(np.intp)
        _, axes = expected(board.xy(ij), px, board.xy(ij[some]), board.pitch)
        start = near_saddles(grey, px[some], axes, board.band)
        blur = _usual_blur(fit_saddles(grey, start, axes, board.length, board.band))
    if blur <= _MAX_BLUR:
        return measured(grey, board, ij, px, blur)
    scale = _MEASURED_BLUR / blur
    small = rescaled(grey, scale)
    both = np.array(small.shape[::-1]) / grey.shape[::-1]  # of columns and rows, which are whole
    ij, saddles = measured(small, board, ij, (px + 0.5) * both - 0.5, _MEASURED_BLUR)
    px, sigma_px = (saddles.px + 0.5) / both - 0.5, saddles.sigma_px / scale
    return ij, replace(saddles, px=px, sigma_px=sigma_px, blur_px=saddles.blur_px / scale)


def _usual_blur(saddles: Saddles) -> float:
    """Return the blur of most corners [px]; 0 without any."""
    return float(np.median(saddles.blur_px[saddles.found])) if saddles.found.any() else 0.0


def _without_loose_lines(ij: IntArray) -> BoolArray:
    """Return the mask of corners of a lattice without sparse outer lines."""
    kept = np.ones(len(ij), dtype=np.bool_)
    while kept.any():
        for axis, end in ((0, -1), (0, 1), (1, -1), (1, 1)):
            line = end * ij[:, axis]
            outer = line[kept].max()
            n = int(np.sum(kept & (line == outer)))
            if n < max(2, _MIN_LINE * np.sum(kept & (line == outer - 1))):
                kept &= line != outer
                break
        else:
            break
    return kept


def _print(board: Board) -> Print:
    """Return the positions of the corners of a board with markers or tags [m]."""
    nx, ny = board.grid
    points = board.points.reshape(ny, nx, 3)
    x, y = points[0, :, 0], points[:, 0, 1]
    if board.kind == "aprilgrid":
        gap = board.spacing * board.side
        return Print(x, y, _STRAIGHT_AROUND * gap, min(_FRAME * board.side, gap), board.side + gap)
    gap = 0.5 * (board.side - board.marker)
    return Print(x, y, 0.5 * _STRAIGHT_AROUND * board.side, gap, board.side)


_MIN_PERIMETER = 0.01  # perimeter of a marker, as a part of the longer side of the image
_BORDERS = (2, 1)  # modules of the black frame of a tag: Kalibr's, and the usual one
_MARKERS_SEARCHED = 1_200_000  # pixels of the image in which markers are searched first
_MAX_PIXELS = 24_000_000  # of an image in which OpenCV looks for markers
_SHARPENED, _SHARPENED_PX = 4.0, 2.5  # unsharp mask by which blurred modules are told apart
# Windows of the adaptive threshold [px]: the smallest, the largest. One finds most markers in a
# third of the time, a wider one where edges are blurred.
_WINDOWS, _WINDOW, _BLURRED_WINDOW = (3, 23), (13, 13), (23, 23)
_ENLARGED = 2.0  # modules may be only a few pixels wide
_FIRST_TAG = 0xD5D628584  # of the family 36h11, its modules row by row from the top left


def _tags_and_corners(
    board: Board, grey: Grey
) -> tuple[tuple[IntArray, Saddles], tuple[IntArray, Array]]:
    """Return columns and rows of the corners beside markers or tags, and where they are.

    With them the numbers of the markers or tags, and their middles [px].
    """
    board_print = _print(board)
    best: tuple[IntArray, Saddles] | None = None
    most: tuple[IntArray, Array] = np.zeros(0, dtype=np.intp), np.zeros((0, 2))
    wanted = (
        (1.0, _MARKERS_SEARCHED, False, _WINDOW),
        (1.0, _MARKERS_SEARCHED, True, _BLURRED_WINDOW),
        (1.0, _MARKERS_SEARCHED, False, _WINDOWS),
        (1.0, _MARKERS_SEARCHED, True, _WINDOWS),
        (1.0, _MAX_PIXELS, False, _WINDOWS),
        (_ENLARGED, _MAX_PIXELS, False, _WINDOWS),
    )
    ways = [
        (possible_scale(grey, scale, pixels), is_blurred, windows)
        for scale, pixels, is_blurred, windows in wanted
    ]
    for scale, is_blurred, windows in list(dict.fromkeys(ways)):
        tags, places = _search_tags(board, grey, scale, is_blurred=is_blurred, windows=windows)
        if len(tags) > len(most[0]):
            most = tags, places.mean(axis=1)
        xy, px = _anchors(board, tags, places)
        if not len(xy):
            continue
        assert board_print.x is not None
        assert board_print.y is not None
        j, i = np.indices((len(board_print.y), len(board_print.x)))
        ij = np.column_stack([i.ravel(), j.ravel()]).astype(np.intp)
        gap = np.abs(board_print.xy(ij)[:, None] - xy[None]).max(axis=2).min(axis=1)
        ij = np.asarray(ij[gap < 0.75 * board_print.pitch])
        at, _ = expected(xy, px, board_print.xy(ij), board_print.pitch)
        saddles = _measured_twice(grey, board_print, ij, (at + 0.5) * scale - 0.5, scale)
        if best is None or len(saddles[0]) > len(best[0]):
            best = saddles
        if len(best[0]) >= MIN_CORNERS:
            break
    if best is None:
        best = measured(grey, board_print, np.zeros((0, 2), np.intp), np.zeros((0, 2)))
    return best, most


def _anchors(board: Board, tags: IntArray, places: Array) -> tuple[Array, Array]:
    """Return corners of markers that agree with each other: on the board (n, 2) [m], and in px."""
    if board.kind == "aprilgrid":
        is_known_tag = tags < board.columns * board.rows
        tags, places = tags[is_known_tag], places[is_known_tag]
        corner = board.side * np.array([[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0]])
        pitch = (1.0 + board.spacing) * board.side
        first = pitch * np.column_stack([tags % board.columns, tags // board.columns])
        xy = first[:, None] + corner
    else:
        printed = charuco_board(board)
        known = {
            int(k): np.asarray(p)[::-1, :2]
            for k, p in zip(np.ravel(printed.getIds()), printed.getObjPoints(), strict=True)
        }
        is_known_tag = np.array([int(tag) in known for tag in tags], dtype=np.bool_)
        tags, places = tags[is_known_tag], places[is_known_tag]
        xy = np.array([known[int(tag)] for tag in tags]).reshape(-1, 4, 2)
    _, first_of = np.unique(tags, return_index=True)
    xy, px = xy[first_of].reshape(-1, 2), places[first_of].reshape(-1, 2)
    if len(xy) > 8:  # three markers or more
        sides = np.linalg.norm(px.reshape(-1, 4, 2)[:, 1] - px.reshape(-1, 4, 2)[:, 0], axis=1)
        _, agree = cv2.findHomography(xy, px, cv2.RANSAC, float(np.median(sides)))
        if agree is not None:
            agree = np.repeat(np.all(agree.reshape(-1, 4) > 0, axis=1), 4)
            xy, px = xy[agree], px[agree]
    return xy, px


def _search_tags(
    board: Board,
    grey: Grey,
    scale: float,
    *,
    is_blurred: bool = False,
    windows: tuple[int, int] = _WINDOWS,
) -> tuple[IntArray, Array]:
    """Return the tags or markers in an image, of whatever board of the same dictionary.

    A blurred image is sharpened for it. Returns numbers (n,); places (n, 4, 2) [px] anticlockwise
    from the lower left of a tag.
    """
    ids, outlines = np.zeros(0, dtype=np.intp), np.zeros((0, 4, 2))
    # Where it becomes smaller that is first, as the conversion takes memory.
    image = _eight_bits(rescaled(grey, scale)) if scale < 1 else rescaled(_eight_bits(grey), scale)
    if is_blurred:
        soft = cv2.GaussianBlur(image, (0, 0), _SHARPENED_PX)
        image = np.asarray(cv2.addWeighted(image, 1.0 + _SHARPENED, soft, -_SHARPENED, 0.0))
    for border in _BORDERS if board.kind == "aprilgrid" else (1,):
        how = _parameters(border, windows)
        detector = cv2.aruco.ArucoDetector(dictionary(board.dictionary), how)
        corners, numbers, _ = detector.detectMarkers(image)
        if numbers is not None and len(numbers) > len(ids):
            ids = np.asarray(numbers).ravel().astype(np.intp)
            outlines = reduced(np.asarray(corners, dtype=np.float64).reshape(-1, 4, 2), scale)
        if len(ids):
            break
    turn = _quarter_turns() if board.dictionary == APRIL_TAGS else 0
    order = [(k + turn) % 4 for k in (3, 2, 1, 0)]
    return ids, outlines[:, order]


def _eight_bits(grey: NDArray[np.generic]) -> NDArray[np.uint8]:
    positive = np.maximum(np.asarray(grey, dtype=np.float32), 0.0)
    return np.asarray(cv2.convertScaleAbs(positive), dtype=np.uint8)  # rounded, and 255 at most


@lru_cache(maxsize=1)
def _quarter_turns() -> int:
    """Return the rotation of OpenCV's tags against Kalibr's, in quarter turns clockwise.

    OpenCV lists the corners of a tag clockwise from the top left of its own picture of it.
    """
    picture = np.asarray(cv2.aruco.generateImageMarker(dictionary(APRIL_TAGS), 0, 8))[1:-1, 1:-1]
    bits = [(_FIRST_TAG >> (35 - k)) & 1 for k in range(36)]
    upright = np.array(bits).reshape(6, 6) == 1
    return next(k for k in range(4) if np.array_equal(np.rot90(picture > 0, k), upright))


def _parameters(border: int, windows: tuple[int, int]) -> cv2.aruco.DetectorParameters:
    """Return the settings of the detector."""
    parameters = cv2.aruco.DetectorParameters()
    parameters.adaptiveThreshWinSizeMin, parameters.adaptiveThreshWinSizeMax = windows
    parameters.markerBorderBits = border
    parameters.minMarkerPerimeterRate = _MIN_PERIMETER
    parameters.cornerRefinementMethod = cv2.aruco.CORNER_REFINE_NONE
    return parameters


def detect_corners(
    board: Board,
    load: Load,
    rows: Sequence[int],
    run: Run,
    report: Report,
) -> Corners:
    """Return the corners of the board in the images of rows; one without the board has none.

    ``load`` returns the image of a row and can travel to another process.
    """
    tables = []
    for row, seen in zip(rows, search_images(board, load, rows, run, report), strict=True):
        corner, px, sigma = certain_corners(board, seen)
        tables.append(found_corners(np.full(len(corner), row, dtype=np.intp), corner, px, sigma))
    return join_corners(tables)


def search_images(
    board: Board, load: Load, rows: Sequence[int], run: Run, report: Report
) -> list[SeenBoard]:
    """Detect a board in images, as :func:`detect_corners` does."""
    report(STAGE, 0, len(rows))
    found = list[SeenBoard]()
    for seen in run(partial(_search, board, load), rows):
        found.append(seen)
        report(STAGE, len(found), len(rows))
    return found


def _search(board: Board, load: Load, row: int) -> SeenBoard:
    """Detect a board in the image of a row."""
    return search_board(board, load(row))


def require_board(
    board: Board,
    corners: Corners,
    load: Load,
    measurements: Measurements,
    views: Collection[str],
) -> None:
    """Refuse needed views whose images do not show the board, and say what they show instead.

    Raises NotVisible with one sentence for each of them.
    """
    shown = set(measurements.view[corners.row].tolist())
    whole = ", its outer corners in sight" if board.kind == "chessboard" else ""
    problems = []
    for v, view in enumerate(measurements.views):
        rows = [row for row in np.flatnonzero(measurements.view == v).tolist()
                if measurements.image[row]]  # fmt: skip
        if view.name not in views or v in shown or not rows:
            continue
        found = next(
            (what for row in rows[:MAX_ASKED] if (what := describe_image(board, load(row)))),
            None,
        )
        problems.append(
            f"view {view.name}: the board could not be found in any of its {len(rows)} "
            f"image{'s' * (len(rows) != 1)}: found {found or 'nothing like it'}, needed "
            f"{board_in_words(board)}{whole}; correct the block board of the dataset file, or "
            "turn the camera."
        )
    if problems:
        raise NotVisible(problems)


_IN_WORDS = {
    "chessboard": ("a chessboard", "squares"),
    "charuco": ("a ChArUco board", "squares"),
    "aprilgrid": ("an AprilGrid", "tags"),
    "circles": ("a grid", "circles"),
    "asymmetric_circles": ("an asymmetric grid", "circles"),
}


def board_in_words(board: Board) -> str:
    """Return a board in words."""
    name, what = _IN_WORDS[board.kind]
    return f"{name} of {board.columns} x {board.rows} {what}"


_MIN_MARKERS = 3  # of another dictionary that are no chance
_MIN_TAGS = 6  # of an image that says how tags are laid out
_MISLAID = 0.2  # of the step from a tag to the nearest, by which they are off (rms): wrong,
_BETTER = 0.5  # where otherwise laid out it is less than this part


def shown_board(board: Board, seen: Sequence[SeenBoard]) -> tuple[Board | None, str]:
    """Return the board that images show, and a note on it, "" for none.

    Of a chessboard squares are stated, and most people count its inner corners: it is the reading
    that more images show. None where they show another one: which one goes after "found".
    """
    in_all = f"of its {len(seen)} image{'s' * (len(seen) != 1)}"
    if board.kind != "chessboard":
        return _shown_by_tags(board, seen, in_all)
    extents = Counter(one.extent for one in seen if one.extent[1] >= _MIN_SIDE)
    counted = replace(board, columns=board.columns + 1, rows=board.rows + 1)
    shown = max(board, counted, key=lambda one: extents[_extent(one)])
    most = _extent(shown)
    larger = Counter({e: n for e, n in extents.items() if e[0] > most[0] or e[1] > most[1]})
    if larger.total() > extents[most]:
        usual, n = larger.most_common(1)[0]
        return None, f"{_squares(board, usual)} in {n} {in_all}"
    if shown is counted and extents:
        word = f"{shown.columns}x{shown.rows}"
        return shown, (
            f"The board has {word} squares ({board.columns}x{board.rows} inner corners); write "
            f"--board chessboard:{word}:{1e3 * board.side:g}mm."
        )
    usual, n = extents.most_common(1)[0] if extents else (most, 0)
    if not extents[most] and 2 * n > len(seen):
        return board, _smaller(board, _squares(board, usual), f"{n} {in_all}")
    return board, ""


def _smaller(board: Board, seen: str, n_images: str) -> str:
    """Return a note for a detected board that is smaller than stated."""
    return (
        f"{seen[0].upper()}{seen[1:]} or that part of one is seen in {n_images}, and the whole "
        f"of {board_in_words(board)} in none; correct --board, or uncover the board."
    )


def _shown_by_tags(
    board: Board, seen: Sequence[SeenBoard], in_all: str
) -> tuple[Board | None, str]:
    """Return the board with tags or markers that images show, by how their numbers lie.

    The result is that of :func:`shown_board`.
    """
    for one in seen:
        number, times = np.unique(one.tags, return_counts=True)
        if len(number) < times.max(initial=0) >= _MIN_TAGS:
            thing, k = _things(board)[:-1], number[int(np.argmax(times))]
            return None, f"the same {thing} (number {k}) {times.max()} times in an image"
    telling = [one for one in seen if len(np.unique(one.tags)) >= _MIN_TAGS]
    if not telling:
        return board, ""
    # Markers of a ChArUco board are on white squares; in the older pattern the first may be one.
    usual = 0 if board.kind == "charuco" and board.legacy and board.rows % 2 == 0 else 1
    stated = np.array([_mislaid(board, board.columns, usual, one) for one in telling])
    number, times = np.unique(np.concatenate([one.tags for one in telling]), return_counts=True)
    is_common = times >= min(2, len(telling))
    last = int((number[is_common] if is_common.any() else number).max())
    n_agree, columns, parity = len(telling), board.columns, usual
    if 2 * np.count_nonzero(stated > _MISLAID) > len(telling):
        patterns = (1, 0) if board.kind == "charuco" else (1,)
        off = {
            (n, k): np.array([_mislaid(board, n, k, one) for one in telling])
            for n in range(2, last + 2)
            for k in patterns
        }
        columns, parity = min(off, key=lambda way: float(np.minimum(off[way], 1.0).sum()))
        n_agree = int(np.sum(off[columns, parity] < _BETTER * np.minimum(stated, 1.0)))
        if 2 * n_agree <= len(telling):
            return board, ""
    rows = int(_middles(board, columns, parity, np.array([last]))[0, 1]) + 1
    what = board_in_words(replace(board, columns=columns, rows=rows))
    if parity != usual:
        what += " of the older pattern (:legacy)" if parity == 0 else " without :legacy"
    if (columns, parity) != (board.columns, usual) or rows > board.rows:
        return None, f"{what} in {n_agree} {in_all}"
    return board, _smaller(board, what, f"{n_agree} {in_all}") if rows < board.rows else ""


def _middles(board: Board, columns: int, parity: int, tags: IntArray) -> Array:
    """Return columns and rows (n, 2) of tags, or of the squares of markers, in so many columns."""
    if board.kind == "aprilgrid":
        return np.column_stack([tags % columns, tags // columns]).astype(np.float64)
    n_rows = 2 * (int(tags.max()) + 1) // columns + 3
    y, x = np.indices((n_rows, columns))
    marked = (x + y) % 2 == parity
    return np.column_stack([x[marked], y[marked]])[tags].astype(np.float64)


def _mislaid(board: Board, columns: int, parity: int, seen: SeenBoard) -> float:
    """Return the misfit (rms) of tags in a number of columns, over the distance of tags."""
    at = _middles(board, columns, parity, seen.tags)
    with quiet_opencv():
        H, _ = cv2.findHomography(at, seen.tags_px)
    if H is None:
        return np.inf
    back = np.column_stack([at, np.ones(len(at))]) @ np.asarray(H, dtype=np.float64).T
    with np.errstate(divide="ignore", invalid="ignore"):
        off = np.linalg.norm(back[:, :2] / back[:, 2:] - seen.tags_px, axis=1)
    apart = np.linalg.norm(seen.tags_px[:, None] - seen.tags_px, axis=2)
    apart[np.diag_indices(len(apart))] = np.inf
    misfit = float(np.sqrt(np.mean(off**2)) / np.median(apart.min(axis=1)))
    return misfit if np.isfinite(misfit) else np.inf


def _extent(board: Board) -> tuple[int, int]:
    """Return the corners along the sides of a board, the larger number first."""
    return max(board.grid), min(board.grid)


def _squares(board: Board, extent: tuple[int, int]) -> str:
    """Return the chessboard with these numbers of corners, turned as the board is."""
    nx, ny = board.grid
    x, y = min(
        (extent[::-1], extent),
        key=lambda side: (abs(side[0] - nx) + abs(side[1] - ny), abs(side[0] - nx)),
    )
    return f"a chessboard of {x + 1} x {y + 1} squares"


def describe_image(
    board: Board,
    image: NDArray[np.generic],  # (height, width) grey levels, 0 to 255
) -> str | None:
    """Describe what an image shows instead of the board."""
    grey = np.ascontiguousarray(image, dtype=np.float32)
    if board.dictionary and (markers := _other_markers(board, grey)):
        return markers
    extent, most = search_board(replace(board, kind="chessboard"), grey).extent, _extent(board)
    if extent[1] < _MIN_SIDE:
        return None
    if board.kind != "chessboard":
        return f"{_squares(board, extent)} without such {_things(board)}"
    is_part = extent[0] <= most[0] and extent[1] <= most[1]
    return _squares(board, extent) + " or that part of one" * is_part


def _things(board: Board) -> str:
    if board.has_circles:
        return "circles"
    return "tags" if board.kind == "aprilgrid" else "markers"


def tags_are_mirrored(
    board: Board,
    image: NDArray[np.generic],  # (height, width) grey levels, 0 to 255
) -> bool:
    """Whether an image shows tags or markers of a board with left and right exchanged."""
    grey = np.ascontiguousarray(np.asarray(image, dtype=np.float32)[:, ::-1])
    scale = possible_scale(grey, 1.0, _MARKERS_SEARCHED)
    return len(_search_tags(board, grey, scale)[0]) >= _MIN_MARKERS


def _other_markers(board: Board, grey: Grey) -> str | None:
    """Describe markers or tags that are not those of a board, or too few of them."""
    thing, count = _things(board), board.columns * board.rows
    n_tags = count if board.kind == "aprilgrid" else count // 2
    scale = possible_scale(grey, 1.0, _MAX_PIXELS)
    numbers, places = _search_tags(board, grey, scale)
    if len(numbers) < _MIN_MARKERS and tags_are_mirrored(board, grey):
        return f"its {thing} mirrored (left and right exchanged)"
    none = np.zeros((0, 2))
    ij = none.astype(np.intp)
    seen = SeenBoard(ij, none, none[:, 0], ij[:, 0], numbers, places.mean(axis=1))
    if (layout := _shown_by_tags(board, [seen], ""))[0] is None:
        return layout[1].removesuffix(" in 1 ")
    if (numbers >= n_tags).any():
        return (
            f"{thing} with numbers up to {int(numbers.max())}, and such a board has 0 to "
            f"{n_tags - 1}"
        )
    if len(numbers):
        return f"only {len(numbers)} of its {n_tags} {thing}"
    for other in DICTIONARIES:
        others = _search_tags(replace(board, dictionary=other), grey, scale)[0]
        if other != board.dictionary and len(others) >= _MIN_MARKERS:
            return f"markers of {other}"
    return None
