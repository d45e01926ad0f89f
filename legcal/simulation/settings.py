"""The settings of a simulated dataset and their limits."""

from __future__ import annotations

import math
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from enum import StrEnum
from numbers import Real
from pathlib import Path
from typing import get_type_hints

import numpy as np

from legcal.arguments import fits, in_words
from legcal.calibration.joint_fit.parameter_choices import joints_of_length
from legcal.errors import UsageError
from legcal.files.quantity import ANGLE, LENGTH, parse_quantity
from legcal.files.schema import closest, describe, is_plain_name
from legcal.machine.leg import Leg, LegKind, ParameterId
from legcal.machine.model import Machine
from legcal.machine.parameters import parametrization_of
from legcal.simulation.board import KINDS as BOARD_KINDS
from legcal.simulation.observe import Viewpoint
from legcal.simulation.rendering.appearance import CAMERAS, Appearance
from legcal.vision.board import Board

MAX_SIZE = 1.0  # maximum size of errors [m] or [rad]
MAX_IMAGES = 100_000
MAX_SIGMA_PX = 100.0
ANGLES = ("axes", "twists")


class Level(StrEnum):
    """The kind of observations in a simulated dataset."""

    OUTLINES = "outlines"
    PHOTOGRAPHS = "photographs"


class Sampling(StrEnum):
    """The drawing of poses: every motor near an end of its travel, or anywhere in it."""

    EXTREME = "extreme"
    WORKSPACE = "workspace"


class Distribution(StrEnum):
    """The distribution of errors of one kind about zero."""

    UNIFORM = "uniform"
    NORMAL = "normal"


@dataclass(frozen=True)
class Spread:
    """The size of the errors of one kind of parameter.

    Attributes
    ----------
    size : float
        Half of the width of a uniform distribution, one standard deviation of a normal one
        [m] or [rad].
    distribution : Distribution
        Their distribution.

    Raises
    ------
    UsageError
        If the size is no number from 0 to 1, or there is no such distribution.
    """

    size: float = 0.0
    distribution: Distribution | str = Distribution.UNIFORM

    def __post_init__(self) -> None:
        is_size = isinstance(self.size, Real) and 0.0 <= self.size <= MAX_SIZE
        if not is_size or self.distribution not in list(Distribution):
            raise UsageError(
                f"A spread could not be used: found the size {self.size!r} and the distribution "
                f"{self.distribution!r}, needed 0 to {MAX_SIZE:g} [m, rad] and "
                f"{' or '.join(Distribution)}; correct it."
            )

    @property
    def sigma(self) -> float:
        """Their standard deviation [m] or [rad]."""
        return self.size if self.distribution == Distribution.NORMAL else self.size / math.sqrt(3.0)


@dataclass(frozen=True)
class ParameterErrors:
    """The size of the errors of each kind of parameter.

    Attributes
    ----------
    base_joints, platform_joints : Spread
        Errors of each coordinate of the joint centres [m]; for the base also errors of points on
        the axes of motors that carry joints.
    offsets : Spread
        Errors of the offsets of actuated legs [m].
    lengths : Spread
        Errors of the lengths of constant legs [m].
    axes : Spread
        Errors of both angles of axes at base and platform, and of such motors [rad].
    twists : Spread
        Errors of the twists of legs without an S joint [rad].
    radii : Spread
        Errors of the radii of visible cylinders [m]; no parameters of the kinematics.
    coplanar : bool
        Whether joint centres keep their heights z in R_b and R_e: coplanar joints stay coplanar.
    """

    base_joints: Spread = Spread()
    platform_joints: Spread = Spread()
    offsets: Spread = Spread()
    lengths: Spread = Spread()
    axes: Spread = Spread()
    twists: Spread = Spread()
    radii: Spread = Spread()
    coplanar: bool = False


ERRORS_OF = {  # kind of parameter, as in its name
    "base": "base_joints",
    "platform": "platform_joints",
    "offset": "offsets",
    "length": "lengths",
    "base_axis": "axes",
    "platform_axis": "axes",
    "twist": "twists",
    "direction": "axes",
    "axis": "axes",
    "axis_point": "base_joints",
    "arm_axis": "axes",
    "arm_point": "base_joints",
}


KINDS = (*dict.fromkeys(ERRORS_OF.values()), "radii")  # the fields of type Spread


def kinds_of(machine: Machine) -> set[str]:
    """Return the kinds of errors, fields of :class:`ParameterErrors`, that a machine can have."""
    names = parametrization_of(machine, twists=True).names
    kinds = {ERRORS_OF[kind] for name in names if (kind := ParameterId.parse(name).kind) != "gain"}
    return kinds | ({"radii"} if any(leg.cylinders for leg in machine.legs) else set())


_MILLIMETRES = Spread(2e-3)  # size of the disturbances in the paper
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


@dataclass(frozen=True)
class SimulationSettings:
    """The choices of a simulated dataset.

    Attributes
    ----------
    level : Level
        ``outlines`` with noise in pixels, or ``photographs``.
    errors : ParameterErrors
        Errors of the true machine relative to the nominal model.
    poses : int or path
        Number of poses for each view, or a CSV of readings for all views.
    sampling : Sampling
        Drawing of poses: ``extreme`` or ``workspace``.
    shared_poses : bool
        All views see the same poses (several cameras at once) instead of separate ones.
    images : int
        Images of each pose in each view.
    views : int or sequence of Viewpoint
        Number of cameras around the machine, or their poses.
    camera : path or None
        Camera file of all views if these are a number; None for a camera of 1024 x 768 pixels with
        slight distortion.
    hints : bool
        State rough camera poses in the dataset, and the legs that each view shows well.
    tell_gamma : bool
        State the gamma of the cameras in the dataset.
    sigma_px : float
        Standard deviation of each edge point of outlines, and of each corner of a board [px].
    readings : Spread
        Errors of encoder readings [m]; for motors that turn, displacements of A.
    appearance : Appearance
        Appearance of photographs.
    board : Board, str, path or None
        A calibration board on the base: ``chessboard``, ``charuco`` or ``aprilgrid`` of a size that
        fits the machine, a YAML file with the block ``board`` of a dataset, or a Board.
    board_pose : bool
        State the poses of boards in their links in the dataset.
    hand_held : bool
        Hand-held camera: a new pose for every image, with the board in view.
    seed : int
        Seed of all random numbers.
    platform_board : Board, str, path or None
        As ``board``, on the platform.
    plan : path or None
        A session from ``legcal plan`` with poses, cameras and views.
    lengths : dict
        Standard deviations [m] of distances of two joints measured by hand, by
        ``LEG.SIDE:LEG.SIDE``.
    angles : Spread or None
        Errors of readings of motors that turn [rad], in place of ``readings``.
    occlusion : bool
        Whether parts of the machine hide its legs from a camera; in photographs they always do.

    Raises
    ------
    UsageError
        If a value has a wrong type, is out of its limits, or contradicts another.
    """

    level: Level | str = Level.PHOTOGRAPHS
    errors: ParameterErrors = DEFAULT_ERRORS
    poses: int | str | Path = 15
    sampling: Sampling | str = Sampling.EXTREME
    shared_poses: bool = False
    images: int = 1
    views: int | Sequence[Viewpoint] = 3
    camera: str | Path | None = None
    hints: bool = True
    tell_gamma: bool = True
    sigma_px: float = 0.1
    readings: Spread = DEFAULT_READINGS
    appearance: Appearance = field(default_factory=Appearance)
    board: Board | str | Path | None = None
    board_pose: bool = False
    hand_held: bool = False
    seed: int = 0
    platform_board: Board | str | Path | None = None
    plan: str | Path | None = None
    lengths: Mapping[str, float] = field(default_factory=dict)
    angles: Spread | None = None
    occlusion: bool = True

    def __post_init__(self) -> None:
        for check in (self._of_other_kinds, self._out_of_limits, self._contradictions):
            problems = [f"The dataset could not be simulated: {problem}" for problem in check()]
            if problems:
                raise UsageError(problems)
        n_poses = 1 if isinstance(self.poses, str | Path) else self.poses
        self.check_images(self.n_views, n_poses)

    @property
    def n_views(self) -> int:
        """Number of cameras."""
        return len(self.views) if isinstance(self.views, Sequence) else self.views

    def check_images(self, n_views: int, n_poses: int) -> None:
        """Refuse more images than a dataset may have."""
        n_images = n_views * n_poses * self.images
        if n_images > MAX_IMAGES:
            raise UsageError(
                f"The dataset could not be simulated: found {n_images} images ({n_views} views of "
                f"{n_poses} poses, {self.images} of each), needed at most {MAX_IMAGES}; give "
                "fewer views, poses or images."
            )

    @property
    def encoder_sigma(self) -> float:
        """Standard deviation of a reading [m]."""
        return self.readings.sigma

    def reading_errors(self, leg: Leg) -> Spread:
        """Return the errors of the readings of a leg's motor [m or rad]."""
        if leg.reads_angle and self.angles is not None:
            return self.angles
        return replace(self.readings, size=leg.reading_of(self.readings.size))

    def _of_other_kinds(self) -> Iterator[str]:
        """Yield values of a wrong type, in words."""
        hints = get_type_hints(type(self))
        given = {name: (value, hints[name]) for name, value in vars(self).items()}
        if isinstance(self.errors, ParameterErrors):
            given |= {f"errors.{kind}": (getattr(self.errors, kind), Spread) for kind in KINDS}
        del given["level"], given["sampling"]
        for name, (value, hint) in given.items():
            if hint is not bool and (isinstance(value, bool) or not fits(value, hint)):
                needed = " or ".join(in_words(hint))
                yield f"found {value!r} as {name}, needed {needed}; correct it."
        for name, choices in (("level", Level), ("sampling", Sampling)):
            if getattr(self, name) not in list(choices):
                yield (
                    f"found the {name} {getattr(self, name)!r}, needed {' or '.join(choices)}; "
                    "choose one."
                )

    def _out_of_limits(self) -> Iterator[str]:
        """Yield numbers that are out of their limits, in words."""
        limits: dict[str, tuple[float, float, float, str]] = {
            "poses": (1 if isinstance(self.poses, str | Path) else self.poses, 1, MAX_IMAGES, ""),
            "views": (self.n_views, 1, MAX_IMAGES, ""),
            "images": (self.images, 1, MAX_IMAGES, ""),
            "the seed": (self.seed, 0, math.inf, ""),
            "the noise of edge points": (self.sigma_px, 0.0, MAX_SIGMA_PX, " px"),
        }
        for name, (value, least, most, unit) in limits.items():
            if not least <= value <= most:
                needed = (
                    f"{least:g} or more" if most == math.inf else f"{least:g} to {most:g}{unit}"
                )
                yield f"found {value:g} as {name}, needed {needed}; correct it."

    def _contradictions(self) -> Iterator[str]:
        """Yield contradictions between choices, in words."""
        if self.hand_held and self.board is None:
            yield "found a camera in the hand without a board on the base; choose a board."
        if self.board_pose and self.board is None and self.platform_board is None:
            yield "found the pose of a board without a board; choose a board."
        if isinstance(self.views, Sequence):
            names = [view.name for view in self.views]
            if len(set(names)) < len(names) or not all(map(is_plain_name, names)):
                yield (
                    f"found views named {', '.join(map(repr, names))}, needed different names that "
                    "can be those of files; rename some."
                )
        if (self.board, self.platform_board) != (None, None) and (
            self.plan is not None or isinstance(self.views, Sequence)
        ):
            yield (
                "found a board, and cameras that stand already, needed cameras that are placed to "
                "see it; leave out the board, or plan with one (legcal plan --board)."
            )
        if self.hand_held and self.images > 1:
            yield (
                f"found {self.images} images of each pose from a camera in the hand, needed 1, "
                "each image has a place of its own; take more poses."
            )


def joint_distance(machine: Machine, name: str) -> float | None:
    """Return the distance [m] of LEG.SIDE:LEG.SIDE, at reading 0 on the base; None for others."""
    joints = joints_of_length(name)
    if joints is None or any(leg not in machine.leg_names for leg, _ in joints):
        return None
    (first_leg, side), (second_leg, second_side) = (
        (machine.leg_names.index(leg), side) for leg, side in joints
    )
    if {side, second_side} == {"base", "platform"} and first_leg == second_leg:
        leg = machine.legs[first_leg]
        return leg.q0 if leg.kind is LegKind.CONSTANT else None
    if side != second_side or first_leg == second_leg or side not in ("base", "platform"):
        return None
    points = machine.A_base if side == "base" else machine.B_platform
    return float(np.linalg.norm(points[first_leg] - points[second_leg]))


# The options of ``legcal simulate``


_ERROR_KINDS = {"joints": ("base_joints", "platform_joints")} | {
    kind.replace("_", "-"): (kind,) for kind in KINDS
}


def requested(
    nominal: Machine,
    *,
    level: str = Level.PHOTOGRAPHS,
    camera: Sequence[str] = (),
    poses: str | None = None,
    error: Sequence[str] = (),
    board: str | None = None,
    hand_held: bool = False,
    plan: Path | None = None,
    seed: int = 0,
) -> SimulationSettings:
    """Return the settings of options; Python has more (:class:`SimulationSettings`)."""
    for option, is_given in (("--poses", poses is not None), ("--hand-held", hand_held)):
        if plan is not None and is_given:
            raise UsageError(
                f"The plan could not be shot: found --plan and {option}, needed one of them, a "
                f"plan says poses and cameras; leave out {option}."
            )
    if hand_held and board is None:
        raise UsageError(
            "--hand-held could not be used: found no --board, needed a board on the base; add "
            "--board charuco."
        )
    file, appearance = _camera(camera, level)
    return SimulationSettings(
        level=level,
        errors=parameter_errors(error, nominal),
        poses=15 if poses is None else _poses(poses),
        camera=file,
        appearance=appearance,
        board=_board(board),
        hand_held=hand_held,
        plan=plan,
        seed=seed,
    )


def _camera(choices: Sequence[str], level: str) -> tuple[Path | None, Appearance]:
    """Return the camera file, and the appearance of photographs for the kind of camera."""
    files, looks = list[Path](), list[Appearance]()
    for choice in choices:
        kind, colon, quality = choice.partition(":")
        if kind in CAMERAS and (not colon or quality.isdecimal()):
            jpeg = int(quality) if colon else None
            looks.append(Appearance(camera=kind, jpeg=jpeg, colour=CAMERAS[kind].colour))
        elif kind not in CAMERAS and (Path(choice).exists() or re.search(r"[./\\]", choice)):
            files.append(Path(choice))
        else:
            raise UsageError(
                f"--camera could not be used: found {describe(choice)}, neither a kind of camera "
                f"nor a file, needed {', '.join(CAMERAS)}, one of them with the quality of its "
                f"JPEG files such as webcam:60, or the path of a file; {closest(kind, CAMERAS)}"
            )
    if max(len(files), len(looks)) > 1:
        raise UsageError(
            f"--camera could not be used: found {len(files)} files and {len(looks)} kinds, needed "
            "at most one of each; leave out the others."
        )
    if looks and level != Level.PHOTOGRAPHS:
        raise UsageError(
            f"--camera {looks[0].camera} could not be used: found --level {level}, needed "
            "photographs, which a kind of camera changes; leave it out."
        )
    return files[0] if files else None, looks[0] if looks else Appearance()


def _poses(text: str) -> int | Path:
    """Return a number of poses, or the path of a CSV."""
    if text.isdecimal():
        return int(text)
    if re.fullmatch(r"[-+]?[\d.]+", text) or not Path(text).exists():
        raise UsageError(
            f"--poses could not be used: found {describe(text)}, neither a whole number nor a "
            "file, needed the number of poses for each view or the path of a CSV; correct it."
        )
    return Path(text)


def _board(choice: str | None) -> str | Path | None:
    """Return a kind of board, or the path of a file."""
    if choice is None or choice in BOARD_KINDS:
        return choice
    if not Path(choice).exists():
        raise UsageError(
            f"--board could not be used: found {describe(choice)}, neither a kind of board nor a "
            f"file, needed {', '.join(BOARD_KINDS)} or the path of a YAML file; "
            f"{closest(choice, BOARD_KINDS)}"
        )
    return Path(choice)


def parameter_errors(texts: Sequence[str], nominal: Machine) -> ParameterErrors:
    """Return the errors of parameters from words such as ``joints=2mm``."""
    errors, possible = DEFAULT_ERRORS, kinds_of(nominal)
    for text in texts:
        if text == "none":
            errors = ParameterErrors()
            continue
        kind, equals, size = text.partition("=")
        units = ANGLE if kind in ANGLES else LENGTH
        if kind in _ERROR_KINDS and not size:
            raise UsageError(
                f"--error could not be used: found {describe(text)} without a size, needed "
                f"KIND=SIZE; write {kind}={'2mm' if units is LENGTH else '0.1deg'}."
            )
        if not equals or kind not in _ERROR_KINDS:
            raise UsageError(
                f"--error could not be used: found {describe(text)}, needed KIND=SIZE or none, "
                f"such as joints=2mm; {closest(kind, _ERROR_KINDS)}"
            )
        kinds, spread = _ERROR_KINDS[kind], _spread(size, units, f"--error {kind}")
        if spread.size > 0.0 and not possible & set(kinds):
            remedy = "leave it out"
            if kind == "offsets" and nominal.actuators:
                remedy = "base-joints also move the zeros of motors that carry joints"
            raise UsageError(
                f"--error {kind} could not be used: found none in the mechanism "
                f"'{nominal.name}', needed one that has them; {remedy}."
            )
        errors = replace(errors, **dict.fromkeys(kinds, spread))  # type: ignore[arg-type]
    return errors


def _spread(text: str, units: Mapping[str, float], option: str) -> Spread:
    """Return a spread such as ``2mm`` or ``2mm:normal``."""
    size, colon, name = text.partition(":")
    if colon and name not in list(Distribution):
        raise UsageError(
            f"{option} could not be used: found the distribution {describe(name)}, needed uniform "
            "(the size is half the width) or normal (the size is one standard deviation); "
            "correct it."
        )
    number = parse_quantity(size, units, option)
    if not 0.0 <= number <= MAX_SIZE:
        unit = "m" if units is LENGTH else "rad"
        raise UsageError(
            f"{option} could not be used: found {describe(size)}, needed 0 to {MAX_SIZE:g} {unit}; "
            "correct it and its unit."
        )
    return Spread(number, name if colon else Distribution.UNIFORM)
