"""What a simulated dataset is made of: the choices, with defaults, and the limits of each.

:class:`SimulationSettings` is what Python gives; :func:`requested` makes it of the options of
``legcal simulate``.
"""

from __future__ import annotations

import math
import operator
import re
from collections.abc import Mapping, Sequence
from dataclasses import MISSING, dataclass, field, fields, replace
from dataclasses import Field as DataclassField
from enum import StrEnum
from functools import cache
from numbers import Real
from pathlib import Path
from typing import Annotated, Any, get_type_hints

import numpy as np
from pydantic import Field, create_model

from legcal.calibration.joint_fit.parameter_choices import joints_of_length
from legcal.data.axes import SIGMA_RANGE
from legcal.errors import UsageError
from legcal.files.quantity import ANGLE, LENGTH, PIXELS, parse_quantity
from legcal.files.schema import FileSchema, closest, describe, read_yaml, validate
from legcal.machine.leg import Leg, LegKind
from legcal.machine.model import Machine
from legcal.machine.parameters import kind_of_parameter, parametrization_of
from legcal.option_fields import flags_of
from legcal.simulation.board import KINDS as BOARD_KINDS
from legcal.simulation.cameras import mild_lens, read_cameras, read_lens
from legcal.simulation.observe import TableNoise
from legcal.simulation.rendering.appearance import Appearance, Light
from legcal.simulation.rendering.pipeline import CAMERAS
from legcal.simulation.request import Angles, Level, Request, Sampling
from legcal.simulation.visibility import Viewpoint
from legcal.vision.board import Board

MAX_SIZE = 1.0  # [m] or [rad]
ANGLES = ("axes", "twists")


class Distribution(StrEnum):
    """How errors of one kind are distributed, about zero."""

    UNIFORM = "uniform"
    NORMAL = "normal"


@dataclass(frozen=True)
class Spread:
    """How large the errors of one kind of parameter are.

    Attributes
    ----------
    size : float
        Half of the width where they are uniform, one standard deviation where they are normal
        [m] or [rad].
    distribution : Distribution
        How they are distributed.

    Raises
    ------
    UsageError
        If the size is no number, or there is no such distribution.
    """

    size: float = 0.0
    distribution: Distribution = Distribution.UNIFORM

    def __post_init__(self) -> None:
        if not isinstance(self.size, Real) or self.distribution not in list(Distribution):
            raise UsageError(
                f"A spread could not be used: found the size {self.size!r} and the distribution "
                f"{self.distribution!r}, needed a number [m, rad] and "
                f"{' or '.join(Distribution)}; correct it."
            )
        object.__setattr__(self, "size", float(self.size))
        object.__setattr__(self, "distribution", Distribution(self.distribution))

    @property
    def sigma(self) -> float:
        """Their standard deviation [m] or [rad]."""
        return self.size if self.distribution is Distribution.NORMAL else self.size / math.sqrt(3.0)


@dataclass(frozen=True)
class ParameterErrors:
    """How large the errors of each kind of parameter are.

    Attributes
    ----------
    base_joints, platform_joints : Spread
        Errors of each coordinate of the joint centres [m]; those of the base also of where the axes
        of motors lie that carry joints.
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
        Whether joint centres keep their heights, their z in R_b and R_e: what is coplanar stays so.
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


KINDS = (*dict.fromkeys(ERRORS_OF.values()), "radii")  # the fields that are sizes


def kinds_of(machine: Machine) -> set[str]:
    """Return the kinds of errors, fields of :class:`ParameterErrors`, that a machine can have."""
    names = parametrization_of(machine, twists=True).names
    kinds = {ERRORS_OF[kind_of_parameter(name)] for name in names if not name.endswith(".gain")}
    return kinds | ({"radii"} if any(leg.cylinders for leg in machine.legs) else set())


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
MAX_IMAGES = 100_000
MAX_SIGMA_PX = 100.0


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
    views : int or sequence of Viewpoint
        Number of cameras around the machine, or where they stand.
    occlusion : bool
        Parts of the machine hide its legs from a camera; in photographs they always do.
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
        Errors of encoder readings [m]; of motors that turn as far as they move A.
    appearance : Appearance
        How photographs look.
    board : Board, str, Path or None
        A calibration board on the base: ``chessboard``, ``charuco`` or ``aprilgrid`` of a size that
        fits the machine, a YAML file with the block ``board`` of a dataset, or a Board.
    board_pose : bool
        Say in the dataset where the boards are in their links.
    hand_held : bool
        Every image is taken from a place of its own, with the board in it.
    seed : int
        Seed of all random numbers.
    platform_board : Board, str, Path or None
        As ``board``, on the platform.
    plan : Path or None
        A session that ``legcal plan`` wrote, which says poses, cameras and views.
    lengths : dict
        Distances of two joints that are measured by hand, by ``LEG.SIDE:LEG.SIDE``, with their
        standard deviations [m].
    angles : Spread or None
        Errors of readings of motors that turn [rad], in place of ``readings``.

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
    views: int | Sequence[Viewpoint] = 3
    occlusion: bool = True
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
    platform_board: Board | str | Path | None = None
    plan: Path | None = None
    lengths: Mapping[str, float] = field(default_factory=dict)
    angles: Spread | None = None

    def __post_init__(self) -> None:
        for name, choices in (("level", Level), ("sampling", Sampling)):
            object.__setattr__(self, name, _choice(choices, name, getattr(self, name)))
        for name in ("poses", "camera", "plan"):
            if isinstance(getattr(self, name), str):
                object.__setattr__(self, name, Path(getattr(self, name)))
        self._check_kinds()
        for name in ("poses", "views", "images", "seed"):
            if not isinstance(getattr(self, name), Path | Sequence):
                least, most = (0, None) if name == "seed" else (1, MAX_IMAGES)
                what = "as the seed" if name == "seed" else name
                whole = whole_number(what, getattr(self, name), least, most)
                object.__setattr__(self, name, whole)
        self._check_sizes()
        self._check_board()
        n_poses = self.poses if isinstance(self.poses, int) else 1
        self.check_images(self.n_views, n_poses)

    def _check_kinds(self) -> None:
        """Refuse settings that are no settings at all."""
        kinds: dict[str, tuple[object, type]] = {
            "errors": (self.errors, ParameterErrors),
            "readings": (self.readings, Spread),
            "table": (self.table, TableNoise),
            "appearance": (self.appearance, Appearance),
            "sigma_px": (self.sigma_px, Real),
        }
        if self.angles is not None:
            kinds["angles"] = (self.angles, Spread)
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
            "noise of edge points": (self.sigma_px, 0.0, MAX_SIGMA_PX),
            "noise of readings": (self.readings.size, 0.0, MAX_SIZE),
        }
        if self.angles is not None:
            sizes["noise of angles"] = (self.angles.size, 0.0, MAX_SIZE)
        for name in KINDS:
            size = getattr(self.errors, name).size
            sizes[f"errors of {name.replace('_', ' ')}"] = (size, 0.0, MAX_SIZE)
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
        for board in (self.board, self.platform_board):
            if board is not None and not isinstance(board, Board | str | Path):
                problems.append(f"{start} {board!r} as board, needed a Board; correct it.")
        if self.board is None:
            problems += [
                f"{start} {what} without a board, needed one on the base; choose a board."
                for what, wanted in (
                    ("a camera in the hand", self.hand_held),
                    ("the pose of a board", self.board_pose and self.platform_board is None),
                )
                if wanted
            ]
        if self.hand_held and not isinstance(self.views, int):
            problems.append(
                f"{start} a camera in the hand and places of cameras, needed a number of views; "
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
        if found > MAX_IMAGES:
            raise UsageError(
                f"The dataset could not be simulated: found {found} images ({n_views} views of "
                f"{n_poses} poses, {self.images} of each), needed at most {MAX_IMAGES}; give "
                "fewer views, poses or images."
            )

    @property
    def n_views(self) -> int:
        """Number of cameras."""
        return self.views if isinstance(self.views, int) else len(self.views)

    @property
    def encoder_sigma(self) -> float:
        """Standard deviation of a reading [m]."""
        return self.readings.sigma

    def reading_errors(self, leg: Leg) -> Spread:
        """Return the errors of the readings of a leg's motor [m or rad]."""
        if leg.reads_angle and self.angles is not None:
            return self.angles
        return replace(self.readings, size=leg.reading_of(self.readings.size))


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
    return "rad" if name.endswith(("axes", "twists", "psi", "theta", "angles")) else "m"


def read_appearance(path: Path) -> Appearance:
    """Return the appearance that a file describes."""
    found = read_yaml(path, "appearance file")
    entry = validate(_schema(), found, path)
    values = {name: getattr(entry, name) for name in entry.model_fields_set}
    if "lights" in values:
        values["lights"] = tuple(Light(**light.model_dump()) for light in values["lights"])
    return Appearance(**values)


@cache
def _schema() -> type[FileSchema]:
    """Return the schema of the file."""
    light = _schema_of(Light, {})
    electrons = Annotated[float, Field(allow_inf_nan=True)]  # .inf: no noise
    other_types = {"lights": tuple[light, ...], "electrons": electrons}  # type: ignore[valid-type]
    return _schema_of(Appearance, other_types)


def _schema_of(described: type[Any], other_types: dict[str, Any]) -> type[FileSchema]:
    """Return the schema of a dataclass."""
    types = get_type_hints(described) | other_types
    columns: dict[str, Any] = {f.name: (types[f.name], _default(f)) for f in fields(described)}
    return create_model(described.__name__, __base__=FileSchema, **columns)


def _default(field: DataclassField[Any]) -> Any:
    """Return the default of a field, or that it must be given."""
    return ... if field.default is MISSING else field.default


_ERROR_KINDS: Mapping[str, tuple[tuple[str, ...], Mapping[str, float]]] = {
    "joints": (("base_joints", "platform_joints"), LENGTH),
    "base-joints": (("base_joints",), LENGTH),
    "platform-joints": (("platform_joints",), LENGTH),
    "offsets": (("offsets",), LENGTH),
    "lengths": (("lengths",), LENGTH),
    "axes": (("axes",), ANGLE),
    "twists": (("twists",), ANGLE),
    "radii": (("radii",), LENGTH),
}


def requested(request: Request, nominal: Machine) -> SimulationSettings:
    """Return the settings that options ask for."""
    given = _poses(request.poses)
    _refuse_contradictions(request, given, nominal)
    _refuse_other_levels(request)
    if isinstance(given, Path) and not given.exists():
        raise UsageError(
            f"--poses could not be used: found {describe(request.poses)}, neither a whole number "
            "nor a file, needed the number of poses or the path of a CSV; correct it."
        )
    noise = request.pixel_noise or "0.1px"
    return SimulationSettings(
        level=request.level,
        errors=replace(_errors(request, nominal), coplanar=request.coplanar),
        poses=given,
        sampling=request.sampling or Sampling.EXTREME,
        shared_poses=bool(request.shared_poses) or isinstance(given, Path),
        images=request.images,
        views=_views(request),
        camera=_camera(request)[0],
        board=_board(request.board, "--board"),
        platform_board=_board(request.platform_board, "--platform-board"),
        board_pose=request.board_pose,
        hand_held=request.hand_held,
        hints=request.hints,
        tell_gamma=request.tell_gamma is not False,
        sigma_px=parse_quantity(noise, PIXELS, "--pixel-noise"),
        table=TableNoise.in_radians() if request.table_noise is Angles.RADIANS else TableNoise(),
        **_encoder_noise(request.encoder_noise, nominal),
        appearance=_appearance(request),
        seed=request.seed,
        plan=request.plan,
        lengths=_lengths(request.length or (), nominal),
    )


def _views(request: Request) -> int | tuple[Viewpoint, ...]:
    """Return how many cameras there are, or where they stand."""
    if request.cameras is None:
        return 3 if request.views is None else request.views
    file = _camera(request)[0]
    return read_cameras(request.cameras, mild_lens() if file is None else read_lens(file))


def _encoder_noise(text: str, nominal: Machine) -> dict[str, Spread]:
    """Return the errors of readings [m], or of motors that turn [rad] where it is an angle."""
    turns = any(leg.reads_angle for leg in nominal.legs)
    if not any(text.partition(":")[0].endswith(unit) for unit in ANGLE):
        units = {**ANGLE, **LENGTH} if turns else LENGTH  # that a refusal names
        return {"readings": _spread(text, units, Distribution.NORMAL, "--encoder-noise")}
    if not turns:
        raise UsageError(
            f"--encoder-noise could not be used: found {describe(text)} and no motor that turns, "
            "needed a length such as 2um; correct it."
        )
    return {"angles": _spread(text, ANGLE, Distribution.NORMAL, "--encoder-noise")}


def _lengths(stated: Sequence[str], nominal: Machine) -> dict[str, float]:
    """Return the sigma [m] of each distance that is measured."""
    found = {}
    for text in stated:
        name, _, sigma = text.partition("=")
        if joint_distance(nominal, name.strip()) is None:
            raise UsageError(
                f"--length could not be used: found {describe(text)}, needed two joints of the "
                "base, of the platform or of one rod, and a sigma; write "
                "leg1.base:leg1.platform=0.05mm."
            )
        found[name.strip()] = parse_quantity(sigma, LENGTH, "--length")
    return found


def joint_distance(machine: Machine, name: str) -> float | None:
    """Return the distance [m] of LEG.SIDE:LEG.SIDE, at reading 0 on the base; None of others."""
    joints = joints_of_length(name)
    if joints is None or any(leg not in machine.leg_names for leg, _ in joints):
        return None
    (one, side), (other, there) = ((machine.leg_names.index(leg), side) for leg, side in joints)
    if {side, there} == {"base", "platform"} and one == other:
        leg = machine.legs[one]
        return leg.q0 if leg.kind is LegKind.CONSTANT else None
    if side != there or one == other or side not in ("base", "platform"):
        return None
    points = machine.A_base if side == "base" else machine.B_platform
    return float(np.linalg.norm(points[one] - points[other]))


def _refuse_contradictions(request: Request, poses: int | Path, nominal: Machine) -> None:
    """Refuse options that others make void."""
    problems = []
    if request.plan is not None:
        others = {
            "--poses": request.poses != "15",
            "--sampling": request.sampling is not None,
            "--shared-poses": request.shared_poses is not None,
            "--views": request.views is not None,
            "--cameras": request.cameras is not None,
            "--hand-held": request.hand_held,
            "--images": request.images != 1,
        }
        problems += [
            f"The plan could not be shot: found --plan and {option}, needed one of them, a plan "
            f"says poses and cameras; leave out {option}."
            for option, given in others.items()
            if given
        ]
    if request.views is not None and request.cameras is not None:
        problems.append(
            "The cameras could not be placed: found both --views and --cameras, needed one of "
            "them; leave out --views, the file says how many there are."
        )
    if isinstance(poses, Path) and request.shared_poses is False:
        problems.append(
            "The poses could not be used: found --own-poses with a file of poses, needed poses "
            "that all views see; leave out --own-poses."
        )
    if isinstance(poses, Path) and request.sampling is not None:
        problems.append(
            "The poses could not be used: found --sampling with a file of poses, needed a number "
            "of poses to draw; leave out --sampling."
        )
    elif request.sampling is not None and not nominal.is_determined:
        problems.append(
            "The poses could not be drawn: found --sampling for a machine whose motors do not "
            "determine its pose, needed none, it takes a random walk; leave out --sampling."
        )
    if request.hand_held and request.cameras is not None:
        problems.append(
            "The cameras could not be placed: found both --hand-held and --cameras, needed one of "
            "them; leave out one of the two."
        )
    pose = request.board_pose and request.platform_board is None
    for option, given in (("--hand-held", request.hand_held), ("--board-pose", pose)):
        if given and request.board is None:
            problems.append(
                f"{option} could not be used: found no --board, needed a board on the base; add "
                "--board charuco."
            )
    if problems:
        raise UsageError(problems)


def _refuse_other_levels(request: Request) -> None:
    """Refuse options that belong to another level."""
    problems = []
    for option in fields(request):
        level = option.metadata["only"]
        value = getattr(request, option.name)
        with_board = request.board is not None or request.platform_board is not None
        of_corners = request.level is Level.AXES and with_board
        if level in (None, request.level) or value is None:
            continue
        if not (option.name == "pixel_noise" and of_corners):
            given = flags_of(option)[0].split("/")[1 if value is False else 0]
            problems.append(
                f"{given} could not be used: found --level "
                f"{request.level}, needed --level {level}, the only one that it has an effect on; "
                "leave it out or give that level."
            )
    if problems:
        raise UsageError(problems)


def _board(choice: str | None, option: str) -> str | Path | None:
    """Return a kind of board, or the path of a file."""
    if choice is None or choice in BOARD_KINDS:
        return choice
    if not Path(choice).exists():
        raise UsageError(
            f"{option} could not be used: found {describe(choice)}, neither a kind of board nor a "
            f"file, needed {', '.join(BOARD_KINDS)} or the path of a YAML file; "
            f"{closest(choice, BOARD_KINDS)}"
        )
    return Path(choice)


def _appearance(request: Request) -> Appearance:
    """Return how photographs look."""
    base = Appearance() if request.appearance is None else read_appearance(request.appearance)
    given = {name: getattr(request, name) for name in ("blur", "clutter", "bits", "colour")}
    _, kind, quality = _camera(request)
    if kind is not None:
        given |= {"camera": kind, "jpeg": quality}
        given["colour"] = CAMERAS[kind].colour if request.colour is None else request.colour
    return replace(base, **{name: value for name, value in given.items() if value is not None})


def _camera(request: Request) -> tuple[Path | None, str | None, int | None]:
    """Return the camera file, the kind of camera, and the quality of its JPEG files."""
    files, kinds = [], []
    for choice in request.camera or ():
        kind, colon, quality = choice.partition(":")
        if kind in CAMERAS and (not colon or quality.isdecimal()):
            kinds.append((kind, int(quality) if colon else None))
        elif kind not in CAMERAS and (Path(choice).exists() or re.search(r"[./\\]", choice)):
            files.append(Path(choice))
        else:
            raise UsageError(
                f"--camera could not be used: found {describe(choice)}, neither a kind of camera "
                f"nor a file, needed {', '.join(CAMERAS)}, one of them with the quality of its "
                f"JPEG files such as webcam:60, or the path of a file; {closest(kind, CAMERAS)}"
            )
    if max(len(files), len(kinds)) > 1:
        raise UsageError(
            f"--camera could not be used: found {len(files)} files and {len(kinds)} kinds, needed "
            "at most one of each; leave out the others."
        )
    if kinds and request.level is not Level.PHOTOGRAPHS:
        raise UsageError(
            f"--camera {kinds[0][0]} could not be used: found --level {request.level}, needed "
            "photographs, which a kind of camera changes; leave it out."
        )
    return (files[0] if files else None, *(kinds[0] if kinds else (None, None)))


def _poses(text: str) -> int | Path:
    """Return a number of poses, or the path of a CSV."""
    if not re.fullmatch(r"[-+]?[\d.]+", text):
        return Path(text)
    if not text.lstrip("+").isdecimal():
        raise UsageError(
            f"--poses could not be used: found {describe(text)}, needed a whole number of one or "
            "more, or the path of a CSV; correct it."
        )
    return int(text)


def _errors(request: Request, nominal: Machine) -> ParameterErrors:
    """Return the errors of parameters that options ask for."""
    found, possible = DEFAULT_ERRORS, kinds_of(nominal)
    for text in request.error or ():
        if text == "none":
            found = ParameterErrors()
            continue
        kind, equals, size = text.partition("=")
        if kind in _ERROR_KINDS and not size:
            raise UsageError(
                f"--error could not be used: found {describe(text)} without a size, needed "
                f"KIND=SIZE; write {kind}={'2mm' if _ERROR_KINDS[kind][1] is LENGTH else '0.1deg'}."
            )
        if not equals or kind not in _ERROR_KINDS:
            raise UsageError(
                f"--error could not be used: found {describe(text)}, needed KIND=SIZE or none, "
                f"such as joints=2mm; {closest(kind, _ERROR_KINDS)}"
            )
        kinds, units = _ERROR_KINDS[kind]
        spread = _spread(size, units, Distribution.UNIFORM, f"--error {kind}")
        if spread.size > MAX_SIZE:
            most = f"{MAX_SIZE / units['deg']:.3g}deg" if "deg" in units else f"{MAX_SIZE:g}m"
            raise UsageError(
                f"--error {kind} could not be used: found {describe(size)}, needed 0 to {most}; "
                "correct it and its unit."
            )
        if spread.size > 0.0 and not possible & set(kinds):
            raise UsageError(
                f"--error {kind} could not be used: found none in the mechanism "
                f"'{nominal.name}', needed one that has them; leave it out."
            )
        for kind_of_joint in kinds:
            found = replace(found, **{kind_of_joint: spread})  # type: ignore[arg-type]
    if request.coplanar and found.base_joints.size == found.platform_joints.size == 0.0:
        raise UsageError(
            "--coplanar could not be used: found no errors of joints, needed some; leave it out."
        )
    return found


def _spread(text: str, units: Mapping[str, float], usual: Distribution, what: str) -> Spread:
    """Return a spread such as ``2mm`` or ``2mm:normal``."""
    size, colon, name = text.partition(":")
    if colon and name not in list(Distribution):
        raise UsageError(
            f"{what} could not be used: found the distribution {describe(name)}, needed uniform "
            "(the size is half the width) or normal (the size is one standard deviation); "
            "correct it."
        )
    return Spread(parse_quantity(size, units, what), Distribution(name) if colon else usual)
