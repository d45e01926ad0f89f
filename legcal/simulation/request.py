"""The options of ``legcal simulate``, parsed into settings."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path

from legcal.errors import UsageError
from legcal.files.quantity import ANGLE, LENGTH, parse_quantity
from legcal.files.schema import closest, describe
from legcal.machine.model import Machine
from legcal.simulation.board import KINDS as BOARD_KINDS
from legcal.simulation.rendering.appearance import Appearance
from legcal.simulation.rendering.pipeline import CAMERAS
from legcal.simulation.settings import (
    DEFAULT_ERRORS,
    MAX_SIZE,
    Distribution,
    Level,
    ParameterErrors,
    SimulationSettings,
    Spread,
    kinds_of,
)

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
        spread = _spread(size, units, f"--error {kind}")
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
    return Spread(parse_quantity(size, units, option), name if colon else Distribution.UNIFORM)
