"""Corners of the calibration board in images: searched, fitted as saddles of grey levels, judged.

:func:`find_corners` is for one image, :func:`detect_corners` for those of a dataset; where no image
shows the board, :func:`require_board` says what they show instead.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache, partial

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.special import erf

from legcal.data import MIN_CORNERS, Corners, Measurements, found_corners, join_corners
from legcal.errors import NotVisible
from legcal.geometry import Array, BoolArray, IntArray
from legcal.perception.placement import Load
from legcal.progress import Report
from legcal.vision import (
    APRIL_TAGS,
    DICTIONARIES,
    Board,
    Grey,
    charuco_board,
    dictionary,
    possible_scale,
    reduced,
    rescaled,
)
from legcal.workers import Run

STAGE = "Searching the board"
MAX_ASKED = 2  # images of a view that are searched for what they show instead

_NEIGHBOURHOOD = 1.5  # squares within which corners give how the board lies in the image around one
_STRAIGHT_AROUND = 0.9  # of what is straight around a corner that is used
_FRAME = 0.2  # of the side of a tag that its black frame is wide, as Kalibr prints it
_MAX_BLUR_RATIO, _MAX_MISFIT_RATIO = 1.5, 2.5  # times what is usual in the image
_GOOD_FIT = 0.03  # of the contrast left over: always accepted


def find_corners(
    board: Board,
    image: NDArray[np.generic],  # (height, width) grey levels, 0 to 255
) -> tuple[IntArray, Array, Array]:
    """Return the corners of a board that an image shows.

    Corners whose surroundings are not those of a board, or partly hidden, are left out. A
    chessboard is found as a whole, or not at all.

    Returns numbers (k,); px (k, 2); sigma_px (k,) [px].
    """
    grey = np.ascontiguousarray(image, dtype=np.float32)
    search = {
        "chessboard": _search_chessboard,
        "charuco": _search_charuco,
        "aprilgrid": _search_aprilgrid,
    }[board.kind]
    numbers, rough = search(board, grey)
    numbers, first = np.unique(numbers, return_index=True)
    rough = rough[first]
    axes = _axes(board, numbers, rough) if len(numbers) >= MIN_CORNERS else np.zeros((0, 2, 2))
    clearance = _clearance(board)
    fitted = [_fit_saddle(grey, *at, *clearance) for at in zip(rough, axes, strict=False)]
    found = _consistent([(n, s) for n, s in zip(numbers.tolist(), fitted, strict=False) if s])
    return (
        np.array([number for number, _ in found], dtype=np.intp),
        np.array([saddle.px for _, saddle in found]).reshape(-1, 2),
        np.array([saddle.sigma_px for _, saddle in found], dtype=np.float64),
    )


def _searched(grey: Grey, wanted: float, max_pixels: int) -> tuple[NDArray[np.uint8], float]:
    """Return an image as OpenCV searches it, of at most so many pixels, and its scale."""
    scale = possible_scale(grey, wanted, max_pixels)
    if scale < 1:  # first, as the conversion takes memory
        return _eight_bits(rescaled(grey, scale)), scale
    return rescaled(_eight_bits(grey), scale), scale


def _eight_bits(grey: NDArray[np.generic]) -> NDArray[np.uint8]:
    levels = np.clip(np.rint(grey), 0.0, 255.0)
    return np.asarray(levels, dtype=np.uint8)


def _consistent(found: list[tuple[int, _Saddle]]) -> list[tuple[int, _Saddle]]:
    """Return the corners that look like most of them; none if these are too few.

    What stands before a corner, or a shadow through it, makes its edges look wider or other.
    """
    if not found:
        return []
    blur = np.array([saddle.blur_px for _, saddle in found])
    misfit = np.array([saddle.misfit for _, saddle in found])
    usual = np.median(blur), np.median(misfit)
    kept = np.abs(np.log(blur / usual[0])) < np.log(_MAX_BLUR_RATIO)
    kept &= misfit < max(_MAX_MISFIT_RATIO * usual[1], _GOOD_FIT)
    left = [both for both, is_kept in zip(found, kept, strict=True) if is_kept]
    return left if len(left) >= MIN_CORNERS else []


def _clearance(board: Board) -> tuple[float, float]:
    """Return how far edges through a corner are straight, and free of other print beside [m]."""
    if board.kind == "aprilgrid":
        gap = board.spacing * board.side
        return _STRAIGHT_AROUND * gap, min(_FRAME * board.side, gap)
    gap = 0.5 * (board.side - board.marker)
    band = gap if board.kind == "charuco" else board.side
    return 0.5 * _STRAIGHT_AROUND * board.side, band


def _axes(board: Board, numbers: IntArray, px: Array) -> Array:
    """Return the steps in the image for a metre along x and y of the board, (k, 2, 2) [px / m]."""
    xy = board.points[numbers, :2]
    pitch = board.side * (1.0 + board.spacing)
    found = []
    for here in xy:
        away = (xy - here) / pitch
        weight = np.exp(-0.5 * np.sum(away**2, axis=1) / _NEIGHBOURHOOD**2) + 1e-3
        A = weight[:, None] * np.column_stack([away, np.ones(len(away))])
        found.append(np.linalg.lstsq(A, weight[:, None] * px, rcond=None)[0][:2].T / pitch)
    return np.array(found)


_WINDOW_PX = 9  # pixels of the window to each side, at most
_MIN_PIXELS = 24  # pixels that a fit needs
_MAX_ITERATIONS = 15
_CONVERGED_PX = 1e-3
_MAX_STEP = np.array([1.0, 1.0, 0.2, 0.2, 1.0])  # [px, px, rad, rad, px]
_START_BLUR = 0.7  # [px] at the start
_BLUR_SIGMAS = 1.5  # standard deviations of the blur that reach beside an edge
_MIN_BAND = 0.3  # of what is free beside an edge that is used at least
_MAX_SHIFT_PX = 2.0  # of the result from the start
_MAX_TURN = 0.2  # [rad] of an edge from where it should point
_BLURS = (0.35, 4.0)  # [px]
_MIN_CONTRAST = 4.0  # grey levels of 255
_MAX_MISFIT = 0.15  # residual, as a part of the contrast
_MIN_SIGMA_PX = 0.01  # no corner is known better: print, flatness, pixels that differ


@dataclass(frozen=True)
class _Saddle:
    """A crossing of two edges in an image."""

    px: Array  # (2,) where it is [px]
    sigma_px: float  # standard deviation of either coordinate [px]
    blur_px: float  # standard deviation of the blur of both edges [px]
    misfit: float  # what the model leaves over (root mean square), as a part of the contrast


def _fit_saddle(
    grey: NDArray[np.float32],  # (height, width) grey levels, 0 to 255
    start: Array,  # (2,) where the corner should be [px]
    axes: Array,  # (2, 2) the steps in the image along the edges of the board through the corner
    length: float,  # how far both edges are straight on either side of the corner [m]
    band: float,  # how far from the edges nothing else is printed [m]
) -> _Saddle | None:
    """Return where two edges cross near a pixel; None where the picture is another."""
    u, v, levels = _window(grey, start)
    away = np.stack([u - start[0], v - start[1]])
    on_board = np.abs(np.linalg.solve(axes, away))
    steps = np.linalg.norm(axes, axis=0)
    turns = np.arctan2(axes[1], axes[0])
    x = np.array([*start, *turns, _START_BLUR])
    found = None
    for _ in range(2):  # the first fit gives how far blur reaches from what else is printed
        clear = max(band - (0.5 + _BLUR_SIGMAS * x[4]) / float(steps.min()), _MIN_BAND * band)
        used = (on_board.max(axis=0) <= length) & (on_board.min(axis=0) <= clear)
        if np.count_nonzero(used) < _MIN_PIXELS:
            return None
        found = _fitted(np.stack([u[used], v[used]]), levels[used], x)
        if found is None or not np.hypot(*(found.x[:2] - start)) < _MAX_SHIFT_PX:
            return None
        x = found.x
        if np.abs(x[2:4] - turns).max() > _MAX_TURN:
            return None
    return None if found is None else _saddle(found)


@dataclass(frozen=True, eq=False)
class _CornerFit:
    """A fitted model: place, angles of the edges and blur, and its derivatives and residual."""

    x: Array
    linear: Array
    residual: Array
    J: Array
    levels: Array


def _window(grey: NDArray[np.float32], start: Array) -> tuple[Array, Array, Array]:
    """Return columns, rows and levels of the pixels around a place."""
    height, width = grey.shape
    column, row = np.rint(start).astype(int)
    columns = np.arange(max(column - _WINDOW_PX, 0), min(column + _WINDOW_PX + 1, width))
    rows = np.arange(max(row - _WINDOW_PX, 0), min(row + _WINDOW_PX + 1, height))
    u, v = (grid.ravel().astype(np.float64) for grid in np.meshgrid(columns, rows))
    levels = grey[np.ix_(rows, columns)].ravel().astype(np.float64)
    return u, v, levels


def _fitted(p: Array, levels: Array, x: Array) -> _CornerFit | None:
    """Fit the model to pixels (2, n) by Gauss-Newton, its linear parameters eliminated."""
    linear, residual, J = _linearised(x, p, levels)
    for _ in range(_MAX_ITERATIONS):
        A = np.concatenate([J, linear], axis=0).T
        step = np.linalg.lstsq(A, residual, rcond=None)[0][:5]
        step *= min(1.0, *(_MAX_STEP / np.maximum(np.abs(step), 1e-12)))
        x = x + step
        x[4] = np.clip(x[4], *_BLURS)
        linear, residual, J = _linearised(x, p, levels)
        if np.abs(step[:2]).max() < _CONVERGED_PX:
            return _CornerFit(x, linear, residual, J, levels)
    return None


def _linearised(x: Array, p: Array, levels: Array) -> tuple[Array, Array, Array]:
    """Return the linear functions (7, n), the residual (n,) and its derivative (5, n) by x."""
    away = p - x[:2, None]
    sides = np.array([[-np.sin(a), np.cos(a)] for a in x[2:4]])
    d = sides @ away
    along = np.array([[np.cos(a), np.sin(a)] for a in x[2:4]]) @ away
    t = d / x[4]
    S = erf(t / np.sqrt(2.0))
    dS = np.sqrt(2.0 / np.pi) * np.exp(-0.5 * t * t)
    product = S[0] * S[1]
    ones = np.ones_like(product)
    bump = np.exp(-0.5 * t * t).sum(axis=0)
    linear = np.stack([ones, *away, product, *(product * away), bump])
    weights = np.linalg.lstsq(linear.T, levels, rcond=None)[0]
    k = weights[3] + weights[4] * away[0] + weights[5] * away[1]
    by_d = np.stack([k * dS[0] * S[1], k * S[0] * dS[1]]) / x[4]
    centre = -(sides.T @ by_d) - (weights[1:3, None] + weights[4:6, None] * product)
    turn = -by_d * along
    blur = -(by_d * t).sum(axis=0)
    residual = levels - weights @ linear
    return linear, residual, np.concatenate([centre, turn, blur[None]])


def _saddle(fit: _CornerFit) -> _Saddle | None:
    """Return the corner with what its residual is worth; None where the model does not fit."""
    A = np.concatenate([fit.J, fit.linear], axis=0).T
    n, free = A.shape
    rms = float(np.sqrt(fit.residual @ fit.residual / max(n - free, 1)))
    contrast = 0.5 * float(np.ptp(fit.levels))
    if contrast < _MIN_CONTRAST or rms > _MAX_MISFIT * contrast or fit.x[4] >= _BLURS[1]:
        return None
    variance = 0.5 * float(np.trace(np.linalg.pinv(A.T @ A)[:2, :2])) * rms**2
    if not 0.0 < variance < _MAX_SHIFT_PX**2:
        return None
    sigma = float(np.hypot(np.sqrt(variance), _MIN_SIGMA_PX))
    return _Saddle(fit.x[:2].copy(), sigma, float(fit.x[4]), rms / contrast)


_PLAIN = cv2.CALIB_CB_NORMALIZE_IMAGE | cv2.CALIB_CB_ACCURACY
# Slow searches where quick ones fail; corners near each other are separate in a larger image.
_SEARCHES = ((1, _PLAIN), (2, _PLAIN), (1, _PLAIN | cv2.CALIB_CB_EXHAUSTIVE))
_MAX_SEARCHED = 3_000_000  # pixels in which OpenCV looks for a chessboard: 170 bytes each
_STRAIGHT = 0.45  # of a square from a corner
_MAX_STEP_RATIO = 1.6  # times as long as the one before it is no step to the next line
_MIN_ALTERNATING = 0.9  # of the neighbours that must be black and white
_MAX_CROSSING_MISFIT = 0.08  # misfit of a corner; where squares meet a rim it is twice as large


def _search_chessboard(
    board: Board,
    grey: Grey,
) -> tuple[IntArray, Array]:
    """Return numbers (k,) and rough places (k, 2) [px] of the corners: all of them, or none.

    A part of a larger chessboard does not count, as nothing shows which part it is.
    """
    grid = _inner_corners(grey, board.grid)
    if grid is None or _continues(grid, grey):
        return np.zeros(0, dtype=np.intp), np.zeros((0, 2))
    return np.arange(board.n_corners), _oriented(grid, grey).reshape(-1, 2)


def _inner_corners(grey: Grey, grid: tuple[int, int]) -> Array | None:
    """Return a grid of so many corners along x and y, (ny, nx, 2) [px]; None if there is none."""
    done = set[tuple[float, int]]()
    for wanted, flags in _SEARCHES:
        image, scale = _searched(grey, wanted, _MAX_SEARCHED)
        if (scale, flags) in done:
            continue
        done.add((scale, flags))
        found = _regular_grid(grey, image, scale, grid, flags)
        if found is not None:
            return found
    return None


def _regular_grid(
    grey: Grey, image: NDArray[np.uint8], scale: float, grid: tuple[int, int], flags: int
) -> Array | None:
    """Return what one search of OpenCV finds, (ny, nx, 2) [px], if that is a regular grid."""
    if np.ptp(image) < 2.0 * _MIN_CONTRAST:
        return None
    found, corners, meta = cv2.findChessboardCornersSBWithMeta(image, grid, flags)
    if not found or corners is None:
        return None
    px = reduced(np.asarray(corners, dtype=np.float64), scale)
    lines = px.reshape(*np.asarray(meta).shape[:2], 2)
    return lines if _is_regular(lines, grey) else None


def _is_regular(grid: Array, grey: Grey) -> bool:
    """Say whether no line of a grid is left out and its squares are black and white in turn."""
    for lines in (grid, np.swapaxes(grid, 0, 1)):
        steps = np.linalg.norm(np.diff(lines, axis=0), axis=-1)
        if np.any(np.abs(np.log(steps[1:] / steps[:-1])) > np.log(_MAX_STEP_RATIO)):
            return False
    black, levels = _squares(grid, grey)
    signed = np.where(black, -1.0, 1.0) * levels
    beside = np.concatenate(
        [(signed[:, 1:] + signed[:, :-1]).ravel(), (signed[1:] + signed[:-1]).ravel()]
    )
    return bool(max(np.mean(beside > 0.0), np.mean(beside < 0.0)) > _MIN_ALTERNATING)


def _continues(grid: Array, grey: Grey) -> bool:
    """Say whether the squares go on beyond a grid of corners, (ny, nx, 2), on one of its sides."""
    size = np.array([grey.shape[1], grey.shape[0]])
    for side in (grid, grid[::-1], np.swapaxes(grid, 0, 1), np.swapaxes(grid, 0, 1)[::-1]):
        beyond = 3.0 * side[0] - 3.0 * side[1] + side[2]  # as the last three lines go on
        away = beyond - side[0]
        along = np.gradient(side[0], axis=0)
        inside = np.all((beyond > 0.0) & (beyond < size - 1), axis=1)
        fits = [
            _fit_saddle(grey, p, np.column_stack([x, y]), _STRAIGHT, 1.0)
            for p, x, y in zip(beyond[inside], along[inside], away[inside], strict=True)
        ]
        crossings = [fit for fit in fits if fit is not None and fit.misfit < _MAX_CROSSING_MISFIT]
        if len(crossings) > 0.5 * len(side[0]):
            return True
    return False


def _oriented(grid: Array, grey: Grey) -> Array:
    """Return the grid with x, y, and the line of sight right-handed, and its first square black."""
    x = grid[:, -1].mean(axis=0) - grid[:, 0].mean(axis=0)
    y = grid[-1].mean(axis=0) - grid[0].mean(axis=0)
    if x[0] * y[1] - x[1] * y[0] < 0.0:
        grid = grid[:, ::-1]
    return grid if _blackness(grid, grey) > 0.0 else grid[::-1, ::-1]


def _blackness(grid: Array, grey: Grey) -> float:
    """Return how much darker the squares are that should be black than those beside them."""
    black, levels = _squares(grid, grey)
    return float(levels[~black].mean() - levels[black].mean())


def _squares(grid: Array, grey: Grey) -> tuple[BoolArray, Array]:
    """Return which squares between corners should be black, and the levels in their middles."""
    middles = 0.25 * (grid[:-1, :-1] + grid[1:, :-1] + grid[:-1, 1:] + grid[1:, 1:])
    column, row = np.rint(np.moveaxis(middles, -1, 0)).astype(np.intp)
    row = np.clip(row, 0, grey.shape[0] - 1)
    column = np.clip(column, 0, grey.shape[1] - 1)
    i, j = np.indices(row.shape)
    # The square after the first one along both axes is black like that.
    return (i + j) % 2 == 0, grey[row, column].astype(np.float64)


_MIN_PERIMETER = 0.01  # perimeter of a marker, as a part of the longer side of the image
_BORDERS = (2, 1)  # modules of the black frame of a tag: Kalibr's, and the usual one
_SCALES = (1, 2)  # by which images are enlarged: modules may be only a few pixels wide
_MAX_PIXELS = 24_000_000  # of an image in which OpenCV looks for markers
_FIRST_TAG = 0xD5D628584  # of the family 36h11, its modules row by row from the top left


def _search_charuco(
    board: Board,
    grey: Grey,
) -> tuple[IntArray, Array]:
    """Return numbers (k,) and rough places (k, 2) [px] of the corners that are seen."""
    charuco = cv2.aruco.CharucoParameters()
    charuco.minMarkers = 1  # places are refined later
    detector = cv2.aruco.CharucoDetector(charuco_board(board), charuco, _parameters(1))
    best = _flat(None, None)
    for wanted in _SCALES:
        searched, scale = _searched(grey, wanted, _MAX_PIXELS)
        corners, numbers, _, _ = detector.detectBoard(searched)
        found = _flat(numbers, corners)
        if len(found[0]) > len(best[0]):
            best = found[0], reduced(found[1], scale)
        if len(best[0]) == board.n_corners:
            break
    return best


def _search_aprilgrid(
    board: Board,
    grey: Grey,
) -> tuple[IntArray, Array]:
    """Return numbers (k,) and rough places (k, 2) [px] of the corners of the tags that are seen."""
    tags, places = _search_tags(board, grey)
    own = tags < board.columns * board.rows
    tags, places = tags[own], places[own]
    column, row = tags % board.columns, tags // board.columns
    numbers = np.stack(
        [
            (2 * row + up) * (2 * board.columns) + 2 * column + right
            for right, up in ((0, 0), (1, 0), (1, 1), (0, 1))
        ],
        axis=-1,
    )
    return numbers.ravel().astype(np.intp), places.reshape(-1, 2)


def _search_tags(
    board: Board,
    grey: Grey,
) -> tuple[IntArray, Array]:
    """Return the tags or markers in an image, of whatever board of the same dictionary.

    Returns numbers (n,); places (n, 4, 2) [px].
    """
    borders = _BORDERS if board.kind == "aprilgrid" else (1,)
    ids, found = np.zeros(0, dtype=np.intp), np.zeros((0, 4, 2))
    for border, wanted in ((border, wanted) for border in borders for wanted in _SCALES):
        searched, scale = _searched(grey, wanted, _MAX_PIXELS)
        detector = cv2.aruco.ArucoDetector(dictionary(board.dictionary), _parameters(border))
        corners, numbers, _ = detector.detectMarkers(searched)
        if numbers is not None and len(numbers) > len(ids):
            ids = np.asarray(numbers).ravel().astype(np.intp)
            found = reduced(np.asarray(corners, dtype=np.float64).reshape(-1, 4, 2), scale)
        if len(ids) and wanted == _SCALES[-1]:
            break
    turn = _quarter_turns() if board.dictionary == APRIL_TAGS else 0
    order = [(k + turn) % 4 for k in (3, 2, 1, 0)]
    return ids, found[:, order]


@lru_cache(maxsize=1)
def _quarter_turns() -> int:
    """Return how far OpenCV's tags are turned against Kalibr's, in quarter turns clockwise.

    OpenCV lists the corners of a tag clockwise from the top left of its own picture of it.
    """
    picture = np.asarray(cv2.aruco.generateImageMarker(dictionary(APRIL_TAGS), 0, 8))[1:-1, 1:-1]
    bits = [(_FIRST_TAG >> (35 - k)) & 1 for k in range(36)]
    upright = np.array(bits).reshape(6, 6) == 1
    return next(k for k in range(4) if np.array_equal(np.rot90(picture > 0, k), upright))


def _parameters(border: int) -> cv2.aruco.DetectorParameters:
    """Return the settings of the detector."""
    found = cv2.aruco.DetectorParameters()
    found.markerBorderBits = border
    found.minMarkerPerimeterRate = _MIN_PERIMETER
    found.cornerRefinementMethod = cv2.aruco.CORNER_REFINE_NONE
    return found


def _flat(numbers: object, corners: object) -> tuple[IntArray, Array]:
    """Return what OpenCV found as arrays; nothing where it says None."""
    if numbers is None or corners is None:
        return np.zeros(0, dtype=np.intp), np.zeros((0, 2))
    places = np.asarray(corners, dtype=np.float64).reshape(-1, 2)
    return np.asarray(numbers).ravel().astype(np.intp), places


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
    report(STAGE, 0, len(rows))
    found = []
    search = partial(_search, board, load)
    for k, (row, (corner, px, sigma)) in enumerate(zip(rows, run(search, rows), strict=True)):
        found.append(found_corners(np.full(len(corner), row, dtype=np.intp), corner, px, sigma))
        report(STAGE, k + 1, len(rows))
    return join_corners(found)


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
            f"{board_in_words(board)}; correct the block board of the dataset file, or turn the "
            "camera."
        )
    if problems:
        raise NotVisible(problems)


def board_in_words(board: Board) -> str:
    """Return a board in words."""
    what = "tags" if board.kind == "aprilgrid" else "squares"
    whole = ", the whole of it" if board.kind == "chessboard" else ""
    name = {"chessboard": "a chessboard", "charuco": "a ChArUco board", "aprilgrid": "an AprilGrid"}
    return f"{name[board.kind]} of {board.columns} x {board.rows} {what}{whole}"


def _search(board: Board, load: Load, row: int) -> tuple[IntArray, Array, Array]:
    """Return the corners, their pixels and sigmas in the image of a row."""
    return find_corners(board, load(row))


_MIN_SIDE = 3  # along a side of a chessboard, for OpenCV
_MIN_MARKERS = 3  # of another dictionary that are no chance


def describe_image(
    board: Board,
    image: NDArray[np.generic],  # (height, width) grey levels, 0 to 255
) -> str | None:
    """Return what an image shows instead of a board, in words that go after "found"."""
    grey = np.ascontiguousarray(image, dtype=np.float32)
    grey = rescaled(grey, possible_scale(grey, 1, _MAX_SEARCHED))
    if board.kind == "chessboard":
        return _other_squares(board, grey)
    return _other_markers(board, grey)


def _other_squares(board: Board, grey: Grey) -> str | None:
    """Return which grid of squares is seen."""
    image, scale = _searched(grey, 1, _MAX_SEARCHED)
    flags = _PLAIN | cv2.CALIB_CB_LARGER
    grid = _regular_grid(grey, image, scale, (_MIN_SIDE, _MIN_SIDE), flags)
    if grid is None:
        return None
    if _continues(grid, grey):
        return "a part of a chessboard of more squares"
    nx, ny = board.grid
    sides = (grid.shape[:2], grid.shape[1::-1])  # either side may be the one with the columns
    x, y = min(sides, key=lambda side: (abs(side[0] - nx) + abs(side[1] - ny), abs(side[0] - nx)))
    seen = f"a chessboard of {x + 1} x {y + 1} squares"
    return seen + (" or that part of one" if x <= nx and y <= ny else "")


def _other_markers(board: Board, grey: Grey) -> str | None:
    """Return which markers or tags are seen."""
    thing = "tags" if board.kind == "aprilgrid" else "markers"
    count = board.columns * board.rows
    own = count if board.kind == "aprilgrid" else count // 2
    numbers, _ = _search_tags(board, grey)
    beyond = np.unique(numbers[numbers >= own])
    if len(beyond):
        return (
            f"{thing} with numbers up to {int(beyond.max())}, and such a board has 0 to {own - 1}"
        )
    if len(numbers) and board.kind == "charuco":
        for turned, what in (
            (replace(board, columns=board.rows, rows=board.columns), "squares_x and squares_y"),
            (replace(board, legacy=not board.legacy), "legacy_pattern"),
        ):
            if len(_search_charuco(turned, grey)[0]) > 3:
                return f"its {thing}, as of a board with another {what}"
    if len(numbers):
        return f"only {len(numbers)} of its {own} {thing}"
    for other in DICTIONARIES:
        seen = _search_tags(replace(board, dictionary=other), grey)[0]
        if other != board.dictionary and len(seen) >= _MIN_MARKERS:
            return f"markers of {other}"
    return None
