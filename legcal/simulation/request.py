"""What ``legcal simulate`` was asked: options as people write them, made into settings."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from legcal.errors import UsageError
from legcal.files.quantity import ANGLE, LENGTH, PIXELS, parse_quantity
from legcal.files.schema import closest, describe
from legcal.simulation.appearance_file import read_appearance
from legcal.simulation.motion import Sampling
from legcal.simulation.parameter_errors import Distribution, ParameterErrors, Spread
from legcal.simulation.rendering.appearance import Appearance
from legcal.simulation.settings import DEFAULT_ERRORS, Level, SimulationSettings
from legcal.simulation.table_noise import TableNoise

_ERROR_KINDS: Mapping[str, tuple[tuple[str, ...], Mapping[str, float]]] = {
    "joints": (("base_joints", "platform_joints"), LENGTH),
    "base-joints": (("base_joints",), LENGTH),
    "platform-joints": (("platform_joints",), LENGTH),
    "offsets": (("offsets",), LENGTH),
    "lengths": (("lengths",), LENGTH),
    "axes": (("axes",), ANGLE),
    "twists": (("twists",), ANGLE),
}
_NUMBER = re.compile(r"[-+]?[\d.]+")


def requested(
    *,
    level: str,
    poses: str,
    sampling: str,
    shared_poses: bool | None,
    images: int,
    views: int | None,
    cameras: Path | None,
    camera: Path | None,
    errors: Sequence[str],
    coplanar: bool,
    pixel_noise: str,
    table_noise: str,
    encoder_noise: str,
    hints: bool,
    seed: int,
    appearance: Path | None,
    look: Mapping[str, Any],
) -> SimulationSettings:
    """Return the settings of options, named as on the command line.

    Parameters
    ----------
    level, poses, sampling, shared_poses, images, views, cameras, camera
        What is simulated: ``poses`` is a number or the path of a CSV; at most one of ``views`` and
        ``cameras``; None where an option was not given.
    errors : sequence of str
        ``joints=2mm``, ``axes=0.1deg:normal`` or ``none``; each replaces the default of its kind.
    coplanar : bool
        Keep joints in the plane that they are nominally in.
    pixel_noise, table_noise, encoder_noise : str
        ``0.1px``; ``degrees`` or ``radians``; ``2um`` or ``2um:uniform``.
    hints, seed
        As in :class:`legcal.simulation.settings.SimulationSettings`.
    appearance : Path or None
        A YAML file of an appearance.
    look : mapping
        Fields of the appearance that replace those of the file; None for those not given.

    Raises
    ------
    UsageError
        If an option cannot be understood, or contradicts another.
    DatasetError
        If the file of the appearance is malformed.
    """
    if views is not None and cameras is not None:
        raise UsageError(
            "The cameras could not be placed: found both --views and --cameras, needed one of "
            "them; leave out --views, the file says how many there are."
        )
    given = _poses(poses)
    if isinstance(given, Path) and shared_poses is False:
        raise UsageError(
            "The poses could not be used: found --own-poses with a file of poses, needed poses "
            "that all views see; leave out --own-poses."
        )
    changes = {name: value for name, value in look.items() if value is not None}
    return SimulationSettings(
        level=Level(level),
        errors=replace(_errors(errors), coplanar=coplanar),
        poses=given,
        sampling=Sampling(sampling),
        shared_poses=bool(shared_poses) or isinstance(given, Path),
        images=images,
        views=cameras if cameras is not None else 3 if views is None else views,
        camera=camera,
        hints=hints,
        sigma_px=parse_quantity(pixel_noise, PIXELS, "--pixel-noise"),
        table=TableNoise.in_radians() if table_noise == "radians" else TableNoise(),
        readings=_spread(encoder_noise, LENGTH, Distribution.NORMAL, "--encoder-noise"),
        appearance=replace(
            Appearance() if appearance is None else read_appearance(appearance), **changes
        ),
        seed=seed,
    )


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


def _errors(texts: Sequence[str]) -> ParameterErrors:
    """Return the errors of parameters that options ask for."""
    found = DEFAULT_ERRORS
    for text in texts:
        if text == "none":
            found = ParameterErrors()
            continue
        kind, equals, size = text.partition("=")
        if not equals or kind not in _ERROR_KINDS:
            raise UsageError(
                f"--error could not be used: found {describe(text)}, needed KIND=SIZE or none, "
                f"such as joints=2mm; {closest(kind, _ERROR_KINDS)}"
            )
        fields, units = _ERROR_KINDS[kind]
        spread = _spread(size, units, Distribution.UNIFORM, f"--error {kind}")
        for field in fields:
            found = replace(found, **{field: spread})  # type: ignore[arg-type]
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
