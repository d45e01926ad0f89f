"""What a simulated dataset is made of: the choices, with defaults, and the limits of each."""

from __future__ import annotations

import math
import operator
from dataclasses import dataclass, field
from enum import StrEnum
from numbers import Real
from pathlib import Path

import numpy as np

from legcal.data import SIGMA_RANGE
from legcal.errors import UsageError
from legcal.simulation.poses import Sampling
from legcal.simulation.rendering.appearance import Appearance
from legcal.simulation.table_noise import TableNoise
from legcal.simulation.truth import KINDS, LARGEST, Distribution, ParameterErrors, Spread
from legcal.vision import Board

_MILLIMETRES = Spread(2e-3)  # of the size by which the paper disturbs its machine
_TENTH_DEGREE = Spread(float(np.deg2rad(0.1)))
DEFAULT_ERRORS = ParameterErrors(
    base_joints=_MILLIMETRES,
    platform_joints=_MILLIMETRES,
    offsets=_MILLIMETRES,
    lengths=_MILLIMETRES,
    axes=_TENTH_DEGREE,
    twists=_TENTH_DEGREE,
)
DEFAULT_READINGS = Spread(2e-6, Distribution.NORMAL)
MOST_IMAGES = 100_000
MOST_SIGMA_PX = 100.0


class Level(StrEnum):
    """What a simulated dataset gives the calibration to work on."""

    AXES = "axes"
    OUTLINES = "outlines"
    PHOTOGRAPHS = "photographs"


@dataclass(frozen=True)
class SimulationSettings:
    """The choices of a simulated dataset.

    Attributes
    ----------
    level : Level
        ``axes`` with the noise of Table 1, ``outlines`` with noise in pixels, or ``photographs``.
    errors : ParameterErrors
        How the true machine differs from the nominal model.
    poses : int or Path
        Number of poses for each view, or a CSV of readings that all views see.
    sampling : Sampling
        How poses are drawn: ``extreme`` or ``workspace``.
    shared_poses : bool
        Every view sees the same poses (several cameras at once) instead of its own.
    images : int
        Images of each pose in each view.
    views : int or Path
        Number of cameras around the machine, or a file that says where they stand.
    camera : Path or None
        Camera file of all views that name none; None for a camera of 1024 x 768 pixels with
        slight distortion.
    hints : bool
        Say roughly where the cameras stand, and which legs each view shows well.
    tell_gamma : bool
        Say how the cameras encode light.
    sigma_px : float
        Standard deviation of each edge point of outlines [px].
    table : TableNoise
        Noise of axes.
    readings : Spread
        Errors of encoder readings [m].
    appearance : Appearance
        How photographs look.
    board : Board, str, Path or None
        A calibration board on the base: ``chessboard``, ``charuco`` or ``aprilgrid`` of a size that
        fits the machine, a YAML file with the block ``board`` of a dataset, or a Board.
    board_pose : bool
        Say in the dataset where the board is in the base link.
    hand_held : bool
        Every image is taken from a place of its own, with the board in it.
    seed : int
        What all chance comes from.

    Raises
    ------
    UsageError
        If a number is out of its limits.
    """

    level: Level = Level.PHOTOGRAPHS
    errors: ParameterErrors = DEFAULT_ERRORS
    poses: int | Path = 15
    sampling: Sampling = Sampling.EXTREME
    shared_poses: bool = False
    images: int = 1
    views: int | Path = 3
    camera: Path | None = None
    hints: bool = True
    tell_gamma: bool = True
    sigma_px: float = 0.1
    table: TableNoise = field(default_factory=TableNoise)
    readings: Spread = DEFAULT_READINGS
    appearance: Appearance = field(default_factory=Appearance)
    board: Board | str | Path | None = None
    board_pose: bool = False
    hand_held: bool = False
    seed: int = 0

    def __post_init__(self) -> None:
        for name, choices in (("level", Level), ("sampling", Sampling)):
            object.__setattr__(self, name, _choice(choices, name, getattr(self, name)))
        for name in ("poses", "views", "camera"):
            if isinstance(getattr(self, name), str):
                object.__setattr__(self, name, Path(getattr(self, name)))
        self._check_kinds()
        for name in ("poses", "views", "images", "seed"):
            if not isinstance(getattr(self, name), Path):
                least, most = (0, None) if name == "seed" else (1, MOST_IMAGES)
                what = "as the seed" if name == "seed" else name
                whole = whole_number(what, getattr(self, name), least, most)
                object.__setattr__(self, name, whole)
        self._check_sizes()
        self._check_board()
        n_views, n_poses = (1 if isinstance(x, Path) else x for x in (self.views, self.poses))
        self.check_images(n_views, n_poses)

    def _check_kinds(self) -> None:
        """Refuse settings that are no settings at all."""
        kinds: dict[str, tuple[object, type]] = {
            "errors": (self.errors, ParameterErrors),
            "readings": (self.readings, Spread),
            "table": (self.table, TableNoise),
            "appearance": (self.appearance, Appearance),
            "sigma_px": (self.sigma_px, Real),
        }
        if isinstance(self.errors, ParameterErrors):
            kinds |= {f"errors.{name}": (getattr(self.errors, name), Spread) for name in KINDS}
        if isinstance(self.table, TableNoise):
            kinds |= {f"table.{name}": (x, Real) for name, x in vars(self.table).items()}
        problems = [
            f"The dataset could not be simulated: found {found!r} as {name}, needed a "
            f"{'number' if kind is Real else kind.__name__}; correct it."
            for name, (found, kind) in kinds.items()
            if not isinstance(found, kind) or isinstance(found, bool)
        ]
        if problems:
            raise UsageError(problems)

    def _check_sizes(self) -> None:
        """Refuse numbers out of their limits."""
        sizes: dict[str, tuple[float, float, float]] = {
            "noise of edge points": (self.sigma_px, 0.0, MOST_SIGMA_PX),
            "noise of readings": (self.readings.size, 0.0, LARGEST),
        }
        for name in KINDS:
            size = getattr(self.errors, name).size
            sizes[f"errors of {name.replace('_', ' ')}"] = (size, 0.0, LARGEST)
        for name, sigma in vars(self.table).items():
            sizes[f"noise of {name}"] = (sigma, *SIGMA_RANGE)
        problems = [
            f"The dataset could not be simulated: found {value:g} as the {name}, needed {least:g} "
            f"to {most:g} {_unit(name)}; correct it and its unit."
            for name, (value, least, most) in sizes.items()
            if not least <= value <= most
        ]
        if problems:
            raise UsageError(problems)

    def _check_board(self) -> None:
        """Refuse settings of a board that contradict others."""
        start = "The dataset could not be simulated: found"
        problems = []
        if self.board is not None and not isinstance(self.board, Board | str | Path):
            problems.append(f"{start} {self.board!r} as board, needed a Board; correct it.")
        if self.board is None:
            problems += [
                f"{start} {what} without a board, needed one on the base; choose a board."
                for what, wanted in (
                    ("a camera in the hand", self.hand_held),
                    ("the pose of a board", self.board_pose),
                )
                if wanted
            ]
        if self.hand_held and not isinstance(self.views, int):
            problems.append(
                f"{start} a camera in the hand and a file of cameras, needed a number of views; "
                "leave out one of the two."
            )
        if self.hand_held and self.images > 1:
            problems.append(
                f"{start} {self.images} images of each pose from a camera in the hand, needed 1, "
                "each image has a place of its own; take more poses."
            )
        if problems:
            raise UsageError(problems)

    def check_images(self, n_views: int, n_poses: int) -> None:
        """Refuse more images than a dataset may have."""
        found = n_views * n_poses * self.images
        if found > MOST_IMAGES:
            raise UsageError(
                f"The dataset could not be simulated: found {found} images ({n_views} views of "
                f"{n_poses} poses, {self.images} of each), needed at most {MOST_IMAGES}; give "
                "fewer views, poses or images."
            )

    @property
    def encoder_sigma(self) -> float:
        """Standard deviation of a reading [m]."""
        size = self.readings.size
        return size if self.readings.distribution is Distribution.NORMAL else size / math.sqrt(3.0)


def _choice(choices: type[StrEnum], name: str, found: str) -> StrEnum:
    """Return a choice that may be given by its name."""
    if found not in list(choices):
        raise UsageError(
            f"The dataset could not be simulated: found the {name} {found!r}, needed "
            f"{' or '.join(choices)}; choose one."
        )
    return choices(found)


def whole_number(name: str, found: object, least: int, most: int | None = None) -> int:
    """Return a whole number between limits, of whatever type."""
    try:
        number = least - 1 if isinstance(found, bool) else operator.index(found)  # type: ignore[arg-type]
    except TypeError:
        number = least - 1
    if number < least or (most is not None and number > most):
        limits = f"of {least} or more" if most is None else f"from {least} to {most}"
        raise UsageError(
            f"The dataset could not be simulated: found {found!s:.40} {name}, needed a whole "
            f"number {limits}; correct it."
        )
    return number


def _unit(name: str) -> str:
    """Return the unit of a size, by its name."""
    if name.endswith("points"):
        return "px"
    return "rad" if name.endswith(("axes", "twists", "psi", "theta")) else "m"
