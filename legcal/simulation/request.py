"""What ``legcal simulate`` was asked: options as people write them, made into settings."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import MISSING, dataclass, fields, replace
from dataclasses import Field as DataclassField
from functools import cache
from pathlib import Path
from typing import Annotated, Any, get_type_hints

from pydantic import Field, create_model

from legcal.errors import UsageError
from legcal.files import (
    ANGLE,
    LENGTH,
    PIXELS,
    FileSchema,
    closest,
    describe,
    parse_quantity,
    parse_yaml,
    read_text,
    validate,
)
from legcal.machine import Mechanism
from legcal.simulation.board import KINDS
from legcal.simulation.poses import Sampling
from legcal.simulation.rendering.appearance import Appearance, Light
from legcal.simulation.settings import DEFAULT_ERRORS, Level, SimulationSettings
from legcal.simulation.table_noise import TableNoise
from legcal.simulation.truth import LARGEST, Distribution, ParameterErrors, Spread, kinds_of


def read_appearance(path: Path) -> Appearance:
    """Return the appearance that a file describes."""
    found = parse_yaml(read_text(path, "appearance file"), path, "appearance file")
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
_OF_LEVEL = {
    "pixel_noise": ("--pixel-noise", "outlines"),
    "table_noise": ("--table-noise", "axes"),
    "appearance": ("--appearance", "photographs"),
    "blur": ("--blur", "photographs"),
    "clutter": ("--clutter", "photographs"),
    "bits": ("--bits", "photographs"),
    "colour": ("--colour or --grey", "photographs"),
    "tell_gamma": ("--gamma or --no-gamma", "photographs"),
}
_NUMBER = re.compile(r"[-+]?[\d.]+")


@dataclass(frozen=True)
class Request:
    """The options of ``legcal simulate``, named as on the command line; None where not given."""

    level: str = "photographs"  # ``photographs``, ``outlines`` or ``axes``
    seed: int = 0  # what all chance comes from
    # ``joints=2mm``, ``axes=0.1deg:normal`` or ``none``; each replaces the default of its kind
    error: tuple[str, ...] = ()
    coplanar: bool = False  # keep joints in the plane that they are nominally in
    # A number or the path of a CSV. sampling, shared_poses, images, views, cameras, camera, board,
    # board_pose, hand_held, hints As in :class:`legcal.simulation.settings.SimulationSettings`; at
    # most one of ``views`` and the file ``cameras``
    poses: str = "15"
    sampling: str | None = None
    shared_poses: bool | None = None
    images: int = 1
    views: int | None = None
    cameras: Path | None = None
    camera: Path | None = None
    board: str | None = None
    board_pose: bool = False
    hand_held: bool = False
    hints: bool = True
    tell_gamma: bool | None = None  # the same; None for True
    # pixel_noise, table_noise, encoder_noise: ``0.1px``; ``degrees`` or ``radians``; ``2um`` or
    # ``2um:uniform``
    pixel_noise: str | None = None
    table_noise: str | None = None
    encoder_noise: str = "2um"
    # A YAML file of an appearance. blur, clutter, bits, colour Fields of the appearance that
    # replace those of the file
    appearance: Path | None = None
    blur: float | None = None
    clutter: int | None = None
    bits: int | None = None
    colour: bool | None = None


def requested(request: Request, nominal: Mechanism) -> SimulationSettings:
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
        level=Level(request.level),
        errors=replace(_errors(request, nominal), coplanar=request.coplanar),
        poses=given,
        sampling=Sampling(request.sampling or Sampling.EXTREME),
        shared_poses=bool(request.shared_poses) or isinstance(given, Path),
        images=request.images,
        views=request.cameras or (3 if request.views is None else request.views),
        camera=request.camera,
        board=_board(request.board),
        board_pose=request.board_pose,
        hand_held=request.hand_held,
        hints=request.hints,
        tell_gamma=request.tell_gamma is not False,
        sigma_px=parse_quantity(noise, PIXELS, "--pixel-noise"),
        table=TableNoise.in_radians() if request.table_noise == "radians" else TableNoise(),
        readings=_spread(request.encoder_noise, LENGTH, Distribution.NORMAL, "--encoder-noise"),
        appearance=_appearance(request),
        seed=request.seed,
    )


def _refuse_contradictions(request: Request, poses: int | Path, nominal: Mechanism) -> None:
    """Refuse options that others make void."""
    problems = []
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
    for option, given in (("--hand-held", request.hand_held), ("--board-pose", request.board_pose)):
        if given and request.board is None:
            problems.append(
                f"{option} could not be used: found no --board, needed a board on the base; add "
                "--board charuco."
            )
    if problems:
        raise UsageError(problems)


def _refuse_other_levels(request: Request) -> None:
    """Refuse options that belong to another level."""
    problems = [
        f"{option} could not be used: found --level {request.level}, needed --level {level}, the "
        "only one that it has an effect on; leave it out or give that level."
        for name, (option, level) in _OF_LEVEL.items()
        if getattr(request, name) is not None
        and request.level != level
        and not (name == "pixel_noise" and request.level == "axes" and request.board is not None)
    ]
    if problems:
        raise UsageError(problems)


def _board(choice: str | None) -> str | Path | None:
    """Return a kind of board, or the path of a file."""
    if choice is None or choice in KINDS:
        return choice
    if not Path(choice).exists():
        raise UsageError(
            f"--board could not be used: found {describe(choice)}, neither a kind of board nor a "
            f"file, needed {', '.join(KINDS)} or the path of a YAML file; {closest(choice, KINDS)}"
        )
    return Path(choice)


def _appearance(request: Request) -> Appearance:
    """Return how photographs look."""
    base = Appearance() if request.appearance is None else read_appearance(request.appearance)
    given = {name: getattr(request, name) for name in ("blur", "clutter", "bits", "colour")}
    return replace(base, **{name: value for name, value in given.items() if value is not None})


def _poses(text: str) -> int | Path:
    """Return a number of poses, or the path of a CSV."""
    if not _NUMBER.fullmatch(text):
        return Path(text)
    if not text.lstrip("+").isdecimal():
        raise UsageError(
            f"--poses could not be used: found {describe(text)}, needed a whole number of one or "
            "more, or the path of a CSV; correct it."
        )
    return int(text)


def _errors(request: Request, nominal: Mechanism) -> ParameterErrors:
    """Return the errors of parameters that options ask for."""
    found, possible = DEFAULT_ERRORS, kinds_of(nominal)
    for text in request.error:
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
        fields, units = _ERROR_KINDS[kind]
        spread = _spread(size, units, Distribution.UNIFORM, f"--error {kind}")
        if spread.size > LARGEST:
            most = f"{LARGEST / units['deg']:.3g}deg" if "deg" in units else f"{LARGEST:g}m"
            raise UsageError(
                f"--error {kind} could not be used: found {describe(size)}, needed 0 to {most}; "
                "correct it and its unit."
            )
        if spread.size > 0.0 and not possible & set(fields):
            raise UsageError(
                f"--error {kind} could not be used: found none in the mechanism "
                f"'{nominal.name}', needed one that has them; leave it out."
            )
        for field in fields:
            found = replace(found, **{field: spread})  # type: ignore[arg-type]
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
