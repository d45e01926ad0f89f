"""Calibration boards: their print, their corners in the board frame, and how files state them.

The block ``board`` of YAML and the option ``--board`` describe a board.
"""

from __future__ import annotations

import os
import re
from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Annotated, Any, Literal, Self

import cv2
import numpy as np
from pydantic import AfterValidator, ConfigDict, Field, Strict, field_validator, model_validator
from scipy.spatial.transform import RigidTransform, Rotation

from legcal.errors import DatasetError, UsageError
from legcal.files.motions import MotionEntry
from legcal.files.quantity import LENGTH, parse_quantity
from legcal.files.schema import FileSchema, Number, closest, describe, read_yaml, validate
from legcal.files.table import is_number
from legcal.geometry.lines import cross, normal_basis
from legcal.geometry.types import Array, BoolArray, IntArray
from legcal.machine.leg import LINKS, Link

BoardKind = Literal["chessboard", "charuco", "aprilgrid", "circles", "asymmetric_circles"]


@dataclass(frozen=True, eq=False)
class Board:
    """A flat calibration board."""

    kind: BoardKind
    # along x: squares, black and white (chessboard, ChArUco), tags, or circles in a row
    columns: int
    rows: int  # along y, the same
    # side of a square, of the black frame of a tag (AprilGrid), or distance of rows of circles [m]
    side: float
    marker: float = 0.0  # side of a marker (ChArUco), diameter of a circle [m]; zero for others
    spacing: float = 0.0  # gap between the tags of an AprilGrid as a part of their side
    dictionary: str = ""  # of markers and tags, as OpenCV names it
    legacy: bool = False  # ChArUco as OpenCV printed it before version 4.6

    @property
    def grid(self) -> tuple[int, int]:
        """Number of corners along x and along y."""
        if self.kind == "aprilgrid":
            return 2 * self.columns, 2 * self.rows
        if self.has_circles:
            return self.columns, self.rows
        return self.columns - 1, self.rows - 1

    @property
    def has_circles(self) -> bool:
        """Whether its corners are the centres of circles, of the radius ``marker / 2``."""
        return self.kind in _CIRCLES

    @property
    def towards_viewer(self) -> float:
        """1 where the z axis of the board comes out of its print, else -1."""
        return 1.0 if self.kind == "aprilgrid" else -1.0

    @property
    def n_corners(self) -> int:
        """Number of corners; they are numbered from 0, along x first."""
        return self.grid[0] * self.grid[1]

    @cached_property
    def points(self) -> Array:
        """The corners in the board frame, (n_corners, 3) [m]; the index is the number.

        Corner 0 is the origin of a chessboard; the inner corner at (side, side) of a ChArUco board,
        whose origin is the outer corner of its first square; the first corner of tag 0, the
        origin, of an AprilGrid; the centre of the first circle. In every second row of an
        asymmetric grid circles are between those of the row before.
        """
        x, y = np.meshgrid(*(self._along(n) for n in self.grid))
        if self.kind == "asymmetric_circles":
            x = 2.0 * x + self.side * (np.arange(self.rows) % 2)[:, None]
        grid = np.stack([x, y], axis=-1).reshape(-1, 2)
        return np.column_stack([grid, np.zeros(len(grid))])

    @cached_property
    def extent(self) -> Array:
        """The four outer corners of the print, in cyclic order, (4, 3) in the board frame [m]."""
        if self.kind == "aprilgrid":
            gap = self.spacing * self.side
            low, high = np.array([-gap, -gap]), self.points[-1, :2] + gap
        elif self.has_circles:
            low, high = -self.side * np.ones(2), self.points[:, :2].max(axis=0) + self.side
        else:
            first = self.points[0, :2]
            low = first - self.side
            high = low + self.side * np.array([self.columns, self.rows])
        x, y = zip(low.tolist(), high.tolist(), strict=True)
        around = [(x[0], y[0]), (x[1], y[0]), (x[1], y[1]), (x[0], y[1])]
        return np.array([[*corner, 0.0] for corner in around])

    def _along(self, n: int) -> Array:
        """Return the coordinates of n corners along an axis [m]."""
        k = np.arange(n)
        if self.kind == "aprilgrid":
            return np.asarray(self.side * ((1.0 + self.spacing) * (k // 2) + k % 2))
        return np.asarray(self.side * (k + (self.kind == "charuco")))


def facing_board(board: Board, place: Array, normal: Array, side: Array) -> RigidTransform:
    """Return T_base_board with the middle of the print at a place and its face along a normal.

    The y axis of the board is along *side*, as far as that is across the normal.
    """
    z = board.towards_viewer * normal
    y = side - (side @ z) * z
    if np.linalg.norm(y) < 1e-6:
        y = normal_basis(z)[0]
    y = y / np.linalg.norm(y)
    turn = Rotation.from_matrix(np.column_stack([cross(y, z), y, z]))
    return RigidTransform.from_components(place - turn.apply(board.extent.mean(axis=0)), turn)


@dataclass(frozen=True, eq=False)
class FixedBoard:
    """A board that is fixed to a link of a machine.

    Corners are numbered across boards: the corners of the platform's board come after the corners
    of the base's.
    """

    board: Board
    link: Link
    T_link_board: RigidTransform | None = None  # None if not known
    first: int = 0  # the number of its first corner

    def has(self, corner: IntArray) -> BoolArray:
        """Return a mask (n,) of the corner indices that belong to this board."""
        return (corner >= self.first) & (corner < self.first + self.board.n_corners)


def board_name(link: Link) -> str:
    """Return the name of the board on a link, in parameters and messages."""
    return "board" if link == "base" else f"{link}_board"


DICTIONARIES = tuple(
    [f"DICT_{bits}X{bits}_{size}" for bits in (4, 5, 6, 7) for size in (50, 100, 250, 1000)]
    + ["DICT_ARUCO_ORIGINAL", "DICT_ARUCO_MIP_36h12"]
    + [f"DICT_APRILTAG_{name}" for name in ("16h5", "25h9", "36h10", "36h11")]
)
APRIL_TAGS = "DICT_APRILTAG_36h11"


def dictionary(name: str) -> cv2.aruco.Dictionary:
    """Return a dictionary of OpenCV by its name."""
    return cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, name))


def dictionary_size(name: str) -> int:
    """Return the number of markers in a dictionary."""
    return len(dictionary(name).bytesList)


def charuco_board(board: Board) -> cv2.aruco.CharucoBoard:
    """Return a ChArUco board as an object of OpenCV, lengths in metres."""
    board_object = cv2.aruco.CharucoBoard(
        (board.columns, board.rows), board.side, board.marker, dictionary(board.dictionary)
    )
    board_object.setLegacyPattern(board.legacy)
    return board_object


SIDES = (0.0005, 1.0)  # [m] limits of the side of a square, a marker or a tag
MAX_COUNT = 100  # maximum number of squares or tags along a side


def _in_metres(side: float) -> float:
    """Refuse the side of a square that no board has."""
    least, most = SIDES
    if not least <= side <= most:
        raise ValueError(
            f"found {side:g} m, needed {least:g} to {most:g} m; correct the unit, 30 mm are 0.03 m."
        )
    return side


Side = Annotated[
    Number,
    AfterValidator(_in_metres),
    Field(json_schema_extra={"minimum": SIDES[0], "maximum": SIDES[1]}),
]
Count = Annotated[int, Strict(), Field(ge=1, le=MAX_COUNT)]


class _BoardEntry(FileSchema):
    """The common entries of all boards."""

    on: Literal["base", "platform"] = "base"
    T_base_board: MotionEntry | None = None
    T_platform_board: MotionEntry | None = None

    @model_validator(mode="after")
    def _has_the_pose_in_its_link(self) -> Self:
        other = "platform" if self.on == "base" else "base"
        if getattr(self, f"T_{other}_board") is not None:
            raise ValueError(
                f"found T_{other}_board of a board on the {self.on}, needed its pose in the link "
                f"that it is fixed to; write T_{self.on}_board, or on: {other}."
            )
        return self


class ChessboardEntry(_BoardEntry):
    """A chessboard: squares are counted, not inner corners."""

    kind: Literal["chessboard"]
    squares_x: Count
    squares_y: Count
    square: Side

    @model_validator(mode="after")
    def _has_enough_corners(self) -> Self:
        if min(self.squares_x, self.squares_y) < 4:
            raise ValueError(
                f"found {self.squares_x} x {self.squares_y} squares, needed 4 or more each way, of "
                "which black and white ones are counted; correct them or use another board."
            )
        return self


class CharucoEntry(_BoardEntry):
    """A ChArUco board: markers in the white squares of a chessboard."""

    kind: Literal["charuco"]
    squares_x: Count
    squares_y: Count
    square: Side
    marker: Side
    dictionary: str
    legacy_pattern: Annotated[bool, Strict()] = False

    @field_validator("dictionary")
    @classmethod
    def _is_known(cls, name: str) -> str:
        if name not in DICTIONARIES:
            raise ValueError(
                f"found {describe(name)}, needed a dictionary of OpenCV; "
                f"{closest(name, DICTIONARIES)}"
            )
        return name

    @model_validator(mode="after")
    def _can_be_printed(self) -> Self:
        x, y = self.squares_x, self.squares_y
        if min(x, y) < 2 or (x - 1) * (y - 1) < 4:
            raise ValueError(
                f"found {x} x {y} squares, needed four or more corners between them; correct the "
                "numbers, which count black and white squares."
            )
        if not self.marker < self.square:
            raise ValueError(
                f"found markers of {self.marker:g} m in squares of {self.square:g} m, needed "
                "smaller markers; exchange marker and square, or correct them."
            )
        size = dictionary_size(self.dictionary)
        if x * y // 2 > size:
            raise ValueError(
                f"found {x * y // 2} markers on {x} x {y} squares, needed at most the {size} of "
                f"{self.dictionary}; correct the dictionary or the numbers of squares."
            )
        return self


class AprilgridEntry(_BoardEntry):
    """An AprilGrid as Kalibr prints it."""

    kind: Literal["aprilgrid"]
    tags_x: Count
    tags_y: Count
    tag_size: Side
    tag_spacing: Annotated[Number, Field(gt=0.0)]
    family: Literal["36h11"] = "36h11"

    @field_validator("tag_spacing")
    @classmethod
    def _is_a_part_of_the_side(cls, spacing: float) -> float:
        if not 0.05 <= spacing <= 2.0:
            raise ValueError(
                f"found {spacing:g}, needed 0.05 to 2: the gap between two tags as a part of the "
                "side of one; divide the gap by tag_size."
            )
        return spacing

    @model_validator(mode="after")
    def _has_tags(self) -> Self:
        x, y, most = self.tags_x, self.tags_y, dictionary_size(APRIL_TAGS)
        if not 2 <= x * y <= most:
            raise ValueError(
                f"found {x} x {y} tags, needed 2 to {most} tags of {self.family} in all; correct "
                "the numbers."
            )
        return self


class CirclesEntry(FileSchema):
    """A grid of dark circles, in the words of ``--board``."""

    kind: Literal["circles", "asymmetric_circles"]
    circles_x: Annotated[Count, Field(ge=3)]
    circles_y: Annotated[Count, Field(ge=3)]
    distance: Side
    diameter: Side

    @model_validator(mode="after")
    def _has_gaps(self) -> Self:
        if not self.diameter < self.distance:
            raise ValueError(
                f"found circles of {self.diameter:g} m with a distance of {self.distance:g} m, "
                "needed gaps between them; exchange distance and diameter, or correct them."
            )
        return self


class _ForeignTarget(FileSchema):
    model_config = ConfigDict(extra="ignore")


class KalibrAprilgrid(_ForeignTarget):
    """An AprilGrid in the target file of Kalibr or Basalt."""

    tagCols: Count
    tagRows: Count
    tagSize: Side
    tagSpacing: Number


class KalibrCheckerboard(_ForeignTarget):
    """A chessboard in the target file of Kalibr, which counts inner corners."""

    targetCols: Annotated[Count, Field(ge=3)]
    targetRows: Annotated[Count, Field(ge=3)]
    colSpacingMeters: Side
    rowSpacingMeters: Side


_SAME_SIDE = 1e-3  # largest relative difference of the sides of squares
_CIRCLES = ("circles", "asymmetric_circles")
_KINDS: Mapping[str, type[ChessboardEntry | CharucoEntry | AprilgridEntry]] = {
    "chessboard": ChessboardEntry,
    "charuco": CharucoEntry,
    "aprilgrid": AprilgridEntry,
}


def parse_boards(entry: Any, path: Path) -> tuple[FixedBoard, ...]:
    """Return the boards of a block (one mapping or a list of them), the board on the base first.

    Raises DatasetError if a link has two boards, or if images cannot distinguish them.
    """
    blocks = entry if isinstance(entry, list) else [entry]
    boards = [parse_board(block, path) for block in blocks]
    boards.sort(key=lambda board: LINKS.index(board.link))
    if not boards:
        raise DatasetError(
            f"{path}: board could not be used: found an empty list, needed a board; describe one, "
            "or remove the block."
        )
    placed: list[FixedBoard] = []
    for fixed_board in boards:
        for earlier in placed:
            if earlier.link == fixed_board.link:
                raise DatasetError(
                    f"{path}: board could not be used: found two boards on the {fixed_board.link}, "
                    "needed at most one on the base and one on the platform; remove one, or "
                    "correct on."
                )
            if likeness := _looks_like(fixed_board.board, earlier.board):
                raise DatasetError(
                    f"{path}: board could not be used: found {likeness} on base and platform, "
                    "which images cannot tell apart, needed two boards with other markers or "
                    "numbers of squares, or of two kinds; print one of them anew, such as ChArUco "
                    "with another dictionary."
                )
        placed.append(replace(fixed_board, first=sum(b.board.n_corners for b in placed)))
    return tuple(placed)


def _looks_like(board: Board, other_board: Board) -> str:
    """Return a property of two boards that makes them indistinguishable in images; "" if none."""
    if board.kind == other_board.kind == "chessboard":
        counts = {board.columns, board.rows}, {other_board.columns, other_board.rows}
        return "chessboards of the same numbers of squares" if counts[0] == counts[1] else ""
    markers = _markers(board)
    return f"markers of {markers}" if markers and markers == _markers(other_board) else ""


def _markers(board: Board) -> str:
    """Return the family of the markers of a board; all sizes of a family share markers."""
    name = board.dictionary
    return name.rsplit("_", 1)[0] if name[5:6].isdigit() else name


def parse_board(mapping: Any, path: Path) -> FixedBoard:
    """Return the board that one mapping describes; it may not look like itself turned."""
    entry = _entry(mapping, path)
    board = _board(entry)
    if board.kind == "chessboard" and board.columns % 2 == board.rows % 2:
        raise DatasetError(
            f"{path}: board could not be used: found a chessboard of {board.columns} x "
            f"{board.rows} squares, which looks the same after half a turn, needed an odd number "
            "of squares one way and an even one the other; cover a row of squares, or use another "
            "board, such as ChArUco."
        )
    pose = entry.T_base_board if entry.on == "base" else entry.T_platform_board
    return FixedBoard(board, entry.on, None if pose is None else pose.motion())


def _entry(mapping: Any, path: Path) -> ChessboardEntry | CharucoEntry | AprilgridEntry:
    """Return the checked block of a board."""
    if not isinstance(mapping, Mapping):
        raise DatasetError(
            f"{path}: board could not be read: found {describe(mapping)}, needed a mapping with "
            "its kind, or a list of such mappings; describe the board."
        )
    link = mapping.get("on", LINKS[0])
    if link not in LINKS:
        raise DatasetError(
            f"{path}: board.on could not be used: found a board on {describe(link)}, needed base "
            "or platform, the only links whose motion the joint fit follows; fix the board to one "
            "of these and correct on."
        )
    kind = mapping.get("kind")
    if not isinstance(kind, str) or kind not in _KINDS:
        kind_in_words = "no such key" if "kind" not in mapping else describe(kind)
        remedy = "name the kind of the board"
        if isinstance(kind, str) and kind in _CIRCLES:  # cut off or behind a leg, none is found
            remedy = "put one of these into the scene: circles serve legcal camera alone"
        raise DatasetError(
            f"{path}: board.kind could not be read: found {kind_in_words}, needed "
            f"{', '.join(_KINDS)}; {remedy}."
        )
    return validate(_KINDS[kind], mapping, path, "board")


def board_document(board: Board) -> dict[str, Any]:
    """Return the block of ``dataset.yaml`` for a board, without its pose."""
    values = {key: getattr(board, _FIELDS[key]) for key in _KEYS[board.kind]}
    values = {key: round(x, 9) if isinstance(x, float) else x for key, x in values.items()}
    if not board.legacy:
        values.pop("legacy_pattern", None)
    return {"kind": board.kind, **values}


def _board(entry: ChessboardEntry | CharucoEntry | AprilgridEntry | CirclesEntry) -> Board:
    """Return the board of a block."""
    values = {_FIELDS[key]: getattr(entry, key) for key in _KEYS[entry.kind]}
    if entry.kind == "aprilgrid":
        values["dictionary"] = APRIL_TAGS
    return Board(entry.kind, **values)


FORMS = {
    "chessboard": "chessboard:9x6:25mm (squares, side)",
    "charuco": "charuco:7x5:40mm:29mm:DICT_4X4_50 (squares, side, marker, dictionary)",
    "aprilgrid": "aprilgrid:6x6:88mm:0.3 (tags, side, gap as a part of it)",
    "circles": "circles:9x7:30mm:15mm (circles, distance, diameter)",
    "asymmetric_circles": "asymmetric_circles:4x11:20mm:15mm (circles in a row, rows, distance of "
    "rows, diameter)",
}
# The keys of a block in the order of the words of --board
_KEYS = {
    "chessboard": ("squares_x", "squares_y", "square"),
    "charuco": ("squares_x", "squares_y", "square", "marker", "dictionary", "legacy_pattern"),
    "aprilgrid": ("tags_x", "tags_y", "tag_size", "tag_spacing"),
    "circles": ("circles_x", "circles_y", "distance", "diameter"),
    "asymmetric_circles": ("circles_x", "circles_y", "distance", "diameter"),
}
# The fields of a board by these keys
_FIELDS = {
    **dict.fromkeys(("squares_x", "tags_x", "circles_x"), "columns"),
    **dict.fromkeys(("squares_y", "tags_y", "circles_y"), "rows"),
    **dict.fromkeys(("square", "tag_size", "distance"), "side"),
    **dict.fromkeys(("marker", "diameter"), "marker"),
    "tag_spacing": "spacing",
    "dictionary": "dictionary",
    "legacy_pattern": "legacy",
}
_USUAL_SQUARE = 0.025  # [m]: the size does not matter to a camera
_COUNTS = re.compile(r"(\d{1,4})[xX](\d{1,4})", re.ASCII)
_OPTION = "--board"


def board_of(spec: str | Path | Board) -> Board:
    """Return the board that a word or a file describes; the orientation of a chessboard is open."""
    if isinstance(spec, Board):
        return spec
    kind, *words = str(spec).split(":")
    if kind not in FORMS:
        return read_board_file(Path(spec))
    counts, keys = _COUNTS.fullmatch(words[0]) if words else None, _KEYS[kind]
    n_optional = 1 if kind in ("chessboard", "charuco") else 0
    if counts is None or not 0 <= len(keys) - 1 - len(words) <= n_optional:
        raise _refused(str(spec), describe(str(spec)), FORMS[kind])
    block: dict[str, Any] = {"kind": kind, keys[0]: int(counts[1]), keys[1]: int(counts[2])}
    for key, word in zip(keys[2:], words[1:], strict=False):
        if key == "dictionary":
            block[key] = word
        elif key == "legacy_pattern":
            if word != "legacy":
                raise _refused(str(spec), describe(word), "legacy, or nothing, at the end")
            block[key] = True
        elif key == "tag_spacing":
            if not is_number(word):
                raise _refused(str(spec), describe(word), "the gap as a number, 0.3")
            block[key] = float(word)
        else:
            block[key] = parse_quantity(word, LENGTH, _OPTION)
    if kind == "chessboard":
        block.setdefault("square", _USUAL_SQUARE)
    try:
        if kind not in _KINDS:  # datasets have no circles
            return _board(validate(CirclesEntry, block, Path(_OPTION), "board"))
        return _board(_entry(block, Path(_OPTION)))
    except DatasetError as error:
        raise UsageError(error.facts) from error


def board_beside_machine(spec: str | Path | Board) -> Board:
    """Return the board that a word or a file describes, if a dataset may have it."""
    board = board_of(spec)
    parse_board(board_document(board), Path(_OPTION))
    return board


def read_board_file(path: Path) -> Board:
    """Return the board of a YAML file."""
    if not os.path.isfile(path):
        kinds = "; ".join(FORMS.values())
        raise _refused(str(path), describe(str(path)), f"a YAML file or one of: {kinds}")
    document = read_yaml(path, "board file")
    block = document.get("board")
    if isinstance(block, dict):
        return _board(_entry(block, path))
    if "target_type" in document or "tagCols" in document:
        return _kalibr_target(document, path)
    raise DatasetError(
        f"{path}: the board could not be read: found no block board, needed one as in "
        "dataset.yaml, or a target of Kalibr or Basalt; add it."
    )


def _kalibr_target(document: Mapping[str, Any], path: Path) -> Board:
    """Return the board of a target file of Kalibr, or of Basalt, which has AprilGrids only."""
    kind = document.get("target_type", "aprilgrid")
    if kind == "aprilgrid":
        grid = validate(KalibrAprilgrid, document, path)
        sides = {"tag_size": grid.tagSize, "tag_spacing": grid.tagSpacing}
        numbers = {"tags_x": grid.tagCols, "tags_y": grid.tagRows, **sides}
        return _board(_entry({"kind": kind, **numbers}, path))
    if kind != "checkerboard":
        raise DatasetError(
            f"{path}: target_type could not be used: found {describe(kind)}, needed aprilgrid or "
            "checkerboard; photograph such a board."
        )
    inner = validate(KalibrCheckerboard, document, path)
    x, y = inner.colSpacingMeters, inner.rowSpacingMeters
    if abs(x / y - 1.0) > _SAME_SIDE:
        raise DatasetError(
            f"{path}: the board could not be used: found fields of {1e3 * x:g} x {1e3 * y:g} mm, "
            "needed squares; photograph such a board."
        )
    return Board("chessboard", inner.targetCols + 1, inner.targetRows + 1, x)


def _refused(spec: str, actual: str, needed: str) -> UsageError:
    return UsageError(
        f"The board {describe(spec)} could not be used: found {actual}, needed {needed}; correct "
        f"{_OPTION}."
    )
