"""Configurations of firmwares as the table of a machine (:mod:`legcal.descriptions.table`).

The kind of a file is found from its content. Readings are the positions of the motors as the
firmware counts them: the height of a carriage, the angle of an arm above the horizontal; the
endstop is at the upper end of the travel. Struts of hexapods read their length less the one at
encoder zero (LinuxCNC), or less the middle one (FlyPT Mover).

A firmware knows the radius of its towers less that of the joints on the effector, and takes two
parallel rods for one. The effector is therefore assumed from :data:`EFFECTOR`, unless it is stated.
"""

from __future__ import annotations

import glob
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from legcal.descriptions.description import MAX_NUMBER
from legcal.descriptions.firmware import FIRMWARES, TOWERS, Firmware, IdealDelta, Parameter
from legcal.errors import ModelError
from legcal.files.quantity import LENGTH, split_quantity
from legcal.files.schema import content_of
from legcal.geometry.types import Array

EFFECTOR = 0.25  # typical radius of the joints on an effector, in radii of towers, or in arms
SPACING = 1.4  # typical distance of the two rods of a tower, in radii of the effector
ROD = 0.01  # typical radius of a rod, in its length
PRINTABLE = 0.6  # radius of the bed where it is not stated, in radii of towers, or in arms
MIN_APART = 30.0  # [deg] between two towers
SIZES = (30.0, 5000.0)  # rods [mm]
LARGEST_EFFECTOR = 0.8  # as EFFECTOR
LARGEST_TRIM = 0.05  # of a rod, in its length
_BEFORE_CODE = re.compile(r"^\s*(?:Recv:\s*)?(?:N\d+|echo:)?\s*")  # in logs of hosts


@dataclass
class Configuration:
    """The numbers of a configuration, as written."""

    firmware: Firmware
    values: dict[str, float]
    unit: str | None = None  # of lengths, if the file states it
    printable: float | None = None  # radius
    effector: float | None = None  # radius of the joints on it
    lowest: float | None = None  # angle of an arm
    notes: list[str] = field(default_factory=list)


_SOURCE = re.compile(r"^\s*#(?:include\s*[<\"]|define\s+\w)", re.MULTILINE)  # C, Arduino


def firmware_table(
    path: Path,
    text: str,
    unit: str | None = None,
    given: Mapping[str, Any] = MappingProxyType({}),
    effector: float | None = None,
) -> Table | None:
    """Return the table of a configuration and notes; None for a file of another kind.

    *unit* is that of lengths, *given* has entries of the table and *effector* is the radius of the
    joints on it, where stated by others.

    Raises ModelError with a sentence for each number that is missing or impossible, and for a file
    that cannot be included.
    """
    text = _with_named_files(path, text)
    for reads in _DELTAS:
        if (read := reads(path, text)) is not None:
            unit = _unit(path, read.unit, unit if read.unit else unit or "mm")
            return _table_of_delta(path, read, unit, effector)
    hexapod = linuxcnc_table(path, text, given) or flypt_table(path, text, given, unit)
    if hexapod is None and _SOURCE.search(text):
        raise ModelError(
            f"{path}: the machine could not be read: found the source of a program, needed a table "
            "of its joints; write its numbers into one (legcal new --template -o . makes a table; "
            "of servos with horns start from models/tables/servo-hexapod.yaml)."
        )
    if hexapod is None:
        return None
    table, notes = hexapod
    return {**table, "unit": _unit(path, table.get("unit"), unit)}, notes


def read_delta(path: Path, text: str) -> IdealDelta:
    """Return the Delta of a printer's configuration, as the firmware takes it."""
    read = next(filter(None, (reads(path, text) for reads in _DELTAS)))
    return read.firmware.ideal(_completed(path, read))


def _unit(path: Path, stated: str | None, given: str | None) -> str:
    if stated is not None and given not in (None, stated):
        raise ModelError(
            f"{path}: the unit could not be decided: found --unit {given} and {stated} in the "
            "file, needed one of them; leave out --unit."
        )
    if stated is None and given is None:
        raise ModelError(
            f"{path}: the lengths could not be read: found no unit, needed that of the machine; "
            "write [TRAJ] and LINEAR_UNITS of the INI file into it, or give --unit mm or in."
        )
    return str(stated or given)


# --- text of each firmware ----------------------------------------------------------------------

_INCLUDE = re.compile(r"^\[include\s+([^\]]+)\].*$", re.MULTILINE)  # of Klipper
_HALFILE = re.compile(r"^\s*HALFILE\s*=\s*(\S+)", re.MULTILINE)  # of LinuxCNC


def _with_named_files(path: Path, text: str, outer: tuple[Path, ...] = ()) -> str:
    """Return a configuration with the files that it names: includes in their place."""
    outer = (*outer, path.resolve())

    def included(match: re.Match[str]) -> str:
        pattern = match[1].strip()
        several = glob.has_magic(pattern)
        found = sorted(glob.glob(pattern, root_dir=path.parent)) if several else [pattern]
        texts = []
        for file in (path.parent / name for name in found):
            if file.resolve() in outer:
                raise ModelError(
                    f"{path}: [include {pattern}] could not be followed: found a file that "
                    "includes itself, needed one that does not; remove the line."
                )
            if not file.is_file():
                raise ModelError(
                    f"{path}: [include {pattern}] could not be followed: found no such file as the "
                    f"included file {file}, needed it there; copy it from the printer, or remove "
                    "the line if it says nothing of the machine's dimensions."
                )
            of_file = content_of(file, "included file", ModelError).decode(errors="replace")
            texts.append(_with_named_files(file, of_file, outer))
        return "\n".join(texts)

    text = _INCLUDE.sub(included, text)
    for name in _HALFILE.findall(text):
        if not name.startswith("LIB:") and (path.parent / name).is_file():
            of_file = content_of(path.parent / name, "HAL file", ModelError)
            text += "\n" + of_file.decode(errors="replace")
    return text


def _klipper(path: Path, text: str) -> Configuration | None:
    """Return the numbers of a printer.cfg; those of its SAVE_CONFIG block count."""
    section, words = "", dict[str, str]()
    for line in text.splitlines():
        line = re.split(r"[#;]", line.removeprefix("#*#"), maxsplit=1)[0].strip()
        if match := re.fullmatch(r"\[(.+)\]", line):
            section = match[1].strip()
        elif match := re.fullmatch(r"(\w+)\s*[:=]\s*(.*)", line):
            words[f"{section}.{match[1].lower()}"] = match[2]
    values = {key: float(word) for key, word in words.items() if re.fullmatch(NUMBER, word)}
    if not any(key.startswith(("printer.", "stepper_a.")) for key in words):
        return None
    kinematics = words.get("printer.kinematics")
    if kinematics not in ("delta", "rotary_delta"):
        raise ModelError(
            f"{path}: the Klipper configuration could not be used: found kinematics "
            f"{kinematics or 'nowhere'}, needed delta or rotary_delta; give the file with the "
            "section [printer] and the sections [stepper_a] to [stepper_c] of a Delta."
        )
    firmware = _named("klipper", turns=kinematics == "rotary_delta")
    for p in firmware.parameters:
        if p.key in words and p.key not in values:
            raise ModelError(
                f"{path}: {_shown(p.key)} could not be read: found '{words[p.key]}', needed a "
                "number; correct it."
            )
    printable = values.get("printer.print_radius")
    return Configuration(firmware, values, printable=printable)


def _named(name: str, *, turns: bool = False) -> Firmware:
    return next(f for f in FIRMWARES if f.name == name and f.turns is turns)


_DEFINES = {
    "DELTA_DIAGONAL_ROD": ("M665 L",),
    "DELTA_RADIUS": ("M665 R",),
    "DELTA_HEIGHT": ("M665 H",),
    "MANUAL_Z_HOME_POS": ("M665 H",),
    "DELTA_TOWER_ANGLE_TRIM": ("M665 X", "M665 Y", "M665 Z"),
    "DELTA_DIAGONAL_ROD_TRIM_TOWER": ("M665 A", "M665 B", "M665 C"),
    "DELTA_ENDSTOP_ADJ": ("M666 X", "M666 Y", "M666 Z"),
    "DELTA_RADIUS_TRIM_TOWER": tuple(f"DELTA_RADIUS_TRIM_TOWER{i}" for i in range(TOWERS)),
    "DELTA_SMOOTH_ROD_OFFSET": ("smooth",),
    "DELTA_EFFECTOR_OFFSET": ("effector",),
    "DELTA_CARRIAGE_OFFSET": ("carriage",),
    "DELTA_PRINTABLE_RADIUS": ("printable",),
}


def _marlin_header(path: Path, text: str) -> Configuration | None:
    """Return the numbers of the #define lines of a Configuration.h."""
    values, before = dict[str, float](), dict[str, tuple[object, str]]()
    plain = re.sub(
        r"/\*.*?\*/|//[^\n]*", lambda comment: "\n" * comment[0].count("\n"), text, flags=re.DOTALL
    )
    for i, line in enumerate(plain.splitlines(), start=1):
        match = re.match(r"\s*#\s*define\s+(\w+)\s+(.*)", line)
        name = match[1].removeprefix("DEFAULT_") if match else ""
        if match is None or name not in _DEFINES:
            continue
        numbers = re.fullmatch(rf"[\s{{(]*({NUMBER}(?:\s*,\s*{NUMBER})*)f?[\s}})]*", match[2])
        of_name = [float(x) for x in re.findall(NUMBER, numbers[1])] if numbers else []
        of_line = dict(zip(_DEFINES[name], of_name, strict=False))
        shown = f"'{match[1]} {match[2].strip()}' in line {i}"
        for key, value in {name: of_name or match[2].split(), **of_line}.items():
            one, there = before.setdefault(key, (value, shown))
            if one != value:
                raise ModelError(
                    f"{path}: the Marlin configuration could not be read: found {there} and "
                    f"{shown}, needed one value; put // before the line that is not in use."
                )
        values |= of_line
    if not re.search(r"^\s*#\s*define\s+(DEFAULT_)?DELTA_\w", plain, re.MULTILINE):
        return None
    switch = re.compile(r"^\s*(//)?\s*#\s*define\s+DELTA\s*$", re.MULTILINE)
    if switch.search(text) and not switch.search(plain):
        raise ModelError(
            f"{path}: the Marlin configuration could not be used: found DELTA commented out, "
            "needed a Delta; remove the // before '#define DELTA' if it is one."
        )
    if values.keys() >= {"smooth", "effector", "carriage"}:
        radius = values["smooth"] - values["effector"] - values["carriage"]
        values.setdefault("M665 R", radius)
    return Configuration(
        _named("marlin"),
        values,
        printable=values.get("printable"),
        effector=values.get("effector"),
    )


def _g_code(path: Path, text: str) -> Configuration | None:
    """Return the numbers of M665, M666 and M669 of Marlin or RepRapFirmware."""
    values, unit = dict[str, float](), None
    for line in text.splitlines():
        words = re.split(r"[;(]", _BEFORE_CODE.sub("", line))[0].upper().split()
        if words and words[0] in ("G20", "G21"):
            unit = {"G20": "in", "G21": "mm"}[words[0]]
        if not words or words[0] not in ("M665", "M666", "M669"):
            continue
        for letter, numbers in re.findall(
            rf"([A-Z])\s*({NUMBER}(?:\s*:\s*{NUMBER})*)", " ".join(words[1:])
        ):
            of_letter = [float(x) for x in numbers.split(":")]
            stated = re.compile(rf"{words[0]} {letter}\d*")
            values = {key: value for key, value in values.items() if not stated.fullmatch(key)}
            for i, value in enumerate(of_letter):
                values[f"{words[0]} {letter}{i}"] = value
            values[f"{words[0]} {letter}"] = of_letter[0]
    if not any(key.startswith(("M665", "M669")) for key in values):
        return None
    name = _speaker(path, text, values)
    notes = []
    if name == "marlin" and not {"M665 A", "M665 C"} & values.keys() and values.pop("M665 B", 0.0):
        notes.append(
            "B of M665 is taken for the radius of the bed, because no A or C is beside it; write "
            "A0 and C0 beside it if it corrects a rod."
        )
    kinematics = values.get("M669 K")
    turns = kinematics == 10.0 or (kinematics is None and "M669 U" in values)
    if kinematics not in (None, 3.0, 10.0):
        raise ModelError(
            f"{path}: the RepRapFirmware configuration could not be used: found M669 K"
            f"{kinematics:g}, needed the linear Delta (M665, or K3) or the rotary Delta (K10); "
            "describe another machine in a table, for which legcal new --template writes a start."
        )
    if f"M665 L{TOWERS}" in values:
        raise ModelError(
            f"{path}: the RepRapFirmware configuration could not be used: found more than three "
            "towers in L of M665, needed three; describe such a machine in a table."
        )
    read = Configuration(
        _named(name, turns=turns),
        values,
        unit,
        lowest=values.get("M669 A0"),
        printable=values.get("M669 B" if turns else "M665 B") if name != "marlin" else None,
        notes=notes,
    )
    if not turns and name != "marlin" and (values.get("M666 A") or values.get("M666 B")):
        read.notes.append(
            "The tilt of the bed in M666 (A, B) is left out: heights z are along the towers; keep "
            "both values in the firmware."
        )
    return read


_MARLIN = re.compile(
    r"^\s*;+\s*Marlin\b|^\s*echo:\s*;?\s*Marlin\b|FIRMWARE_NAME:\s*Marlin",
    re.IGNORECASE | re.MULTILINE,
)
_DUET = re.compile(
    r"^\s*;+\s*(?:Configuration file for |generated by )?(?:RepRap ?Firmware|Duet|RRF)|"
    r"FIRMWARE_NAME:\s*(?:RepRapFirmware|Duet)",
    re.IGNORECASE | re.MULTILINE,
)
_DUET_CODES = re.compile(  # that Marlin does not have
    r"^\s*(?:M(?:584|558|563|98)(?![\d.])|M569(?![\d.])[^;\n]*P\d)", re.IGNORECASE | re.MULTILINE
)


def _speaker(path: Path, text: str, values: Mapping[str, float]) -> str:
    """Return the firmware that reads some G-code: by its name in a header, or by its own codes."""
    lines = [line for line in text.splitlines() if "M555" not in line.upper()]  # looks like others
    text = "\n".join(lines)
    ends = [values.get(f"M666 {letter}", 0.0) for letter in "XYZ"]
    lists = any(re.fullmatch(r"M66[59] [A-Z]1", key) for key in values)
    known = {
        "marlin": bool(_MARLIN.search(text))
        or any(key in values for key in ("M665 S", "M665 A", "M665 C")),
        "reprapfirmware": bool(_DUET.search(text) or _DUET_CODES.search(text))
        or lists
        or any(key in values for key in ("M669 K", "M669 U", "M666 A", "M666 B"))
        or max(ends) > 0.0,
    }
    named = [name for name, is_so in known.items() if is_so]
    if len(named) == 1:
        return named[0]
    if not any(ends) and not named:
        return "reprapfirmware"  # both read the rest alike
    if named:
        raise ModelError(
            f"{path}: the firmware could not be told: found lines of both Marlin (its name, or A, "
            "C or S of M665) and RepRapFirmware (its name, lists with ':', M584, M569 P, M558, "
            "M563, M98, or M666 above zero), needed one, because they count the endstops in M666 "
            "downwards and upwards; give the lines of the firmware in use alone."
        )
    raise ModelError(
        f"{path}: the endstops could not be read: found M666 lines that may be of Marlin or "
        "RepRapFirmware, which count them downwards and upwards, needed one of them; write the "
        "comment '; Marlin' or '; RepRapFirmware' in a line of its own."
    )


# --- Deltas -------------------------------------------------------------------------------------

_WORDS = {
    "radius": "the horizontal distance from the joints on a carriage (of an arm: the shaft) to "
    "those on the centred effector",
    "rod": "the length of the rods",
    "arm": "the length of the arms",
    "height": "the height of the shafts over the bed, less that of the effector's joints over the "
    "nozzle",
    "stop": "the height of the centred nozzle over the bed at the endstops",
    "angle": "the angle of the tower",
}
_STOPS_OF_ARMS = "the lowest and highest angle of the arms"


def _shown(key: str) -> str:
    """Return a parameter as its owner sees it."""
    section, dot, name = key.rpartition(".")
    if dot:
        return f"{name} in [{section}]"
    code, _, letter = key.partition(" ")
    return f"{letter[0]} of {code}" if letter else key


def _completed(path: Path, read: Configuration) -> dict[str, float]:
    """Return the values of all parameters, with defaults; refuse those that are missing."""
    for key, stated in read.values.items():
        if not abs(stated) < MAX_NUMBER:
            raise ModelError(
                f"{path}: {_shown(key)} could not be used: found {stated:g}, needed a number below "
                f"{MAX_NUMBER:g}; correct it."
            )
    values, missing = dict[str, float](), list[Parameter]()
    for p in read.firmware.parameters:
        value = read.values.get(p.key)
        if value is None:
            value = values.get(p.default) if isinstance(p.default, str) else p.default
        if value is None and not isinstance(p.default, str):
            missing.append(p)
        values[p.key] = 0.0 if value is None else value
    if missing:
        words = _WORDS | ({"stop": _STOPS_OF_ARMS} if read.firmware.stops_are_motors else {})
        raise ModelError(
            [
                f"{path}: the {read.firmware.title} configuration could not be read: found no "
                f"{_shown(p.key)}, needed {words[p.field]}; write it, or give the file "
                "that has it."
                + "".join(f" {note}" for note in read.notes if "not followed" in note)
                for p in missing
            ]
        )
    return values


def _table_of_delta(path: Path, read: Configuration, unit: str, effector: float | None) -> Table:
    """Return the table of a Delta, and what was assumed."""
    firmware = read.firmware
    ideal = firmware.ideal(_completed(path, read))
    _check(path, read, ideal, unit)
    at_stops = ideal.at_stops
    size = float(np.mean(ideal.arm if ideal.turns else ideal.radius))
    if effector is not None and not 0.0 < effector < LARGEST_EFFECTOR * size:
        raise ModelError(
            f"{path}: --platform-radius could not be used: found {effector:g} {unit}, needed the "
            "radius of the joints on the effector, above 0 and below "
            f"{LARGEST_EFFECTOR * size:.4g} {unit} ({LARGEST_EFFECTOR:g} of the "
            f"{'arms' if ideal.turns else 'radius of the towers'}); correct it, or write it in the "
            "unit of the file."
        )
    stated = effector if effector is not None else read.effector
    r = float(np.round(EFFECTOR * size, 1)) if stated is None else stated
    pair = 0.5 * SPACING * r
    out, along = ideal.out, np.stack([-ideal.out[:, 1], ideal.out[:, 0], np.zeros(TOWERS)], 1)
    both = pair * np.stack([-along, along], axis=1)  # (3, 2, 3)
    centre = np.array([0.0, 0.0, 1.0]) * ideal.height[:, None]
    A = (ideal.radius + ideal.arm + r)[:, None] * out + centre
    low = _lowest(read, ideal, size)
    if not (np.isfinite(at_stops).all() and (low < at_stops).all()):
        raise ModelError(
            f"{path}: the endstops could not be used: found them where the nozzle "
            f"{'is not over the bed' if np.isfinite(at_stops).all() else 'cannot be'}, needed "
            "motors that move the nozzle from there to the bed; correct the numbers of the "
            "endstops, or the unit of lengths."
        )
    travels = np.stack([low, at_stops], axis=1).tolist()
    motors: list[dict[str, Any]] = [{"direction": [0, 0, 1], "travel": q} for q in travels]
    if ideal.turns:
        shafts = ((ideal.radius + r)[:, None] * out + centre).tolist()
        motors = [
            {"point": point, "axis": axis, "travel_deg": q}
            for point, axis, q in zip(shafts, (-along).tolist(), travels, strict=True)
        ]
    ends = ideal.positions(np.stack([np.asarray(low), at_stops]))[:, 2]
    thick = float(np.round(ROD * np.mean(ideal.rod), 2))
    table = {
        "legcal_table": 1,
        "name": path.stem,
        "unit": unit,
        "type": f"6-{'R' if ideal.turns else 'P'}SS",
        "actuators": dict(zip(firmware.motors, motors, strict=True)),
        "hangs_on": [name for name in firmware.motors for _ in range(2)],
        "base_joints": (A[:, None] + both).reshape(6, 3).tolist(),
        "platform_joints": (r * out[:, None] + both).reshape(6, 3).tolist(),
        "lengths": np.repeat(ideal.rod, 2).tolist(),
        "radius": thick,
        "reach": float(np.round(_printable(read, size), 3)),
        "floor": 0.0,
        "home": {"xyz": [0, 0, float(np.round(ends.mean(), 3))], "rpy_deg": [0, 0, 0]},
    }
    assumed = [] if stated is not None else [f"joints {r:g} {unit} from its middle"]
    assumed += [f"the rods of a tower {2.0 * pair:g} {unit} apart"]
    where = " (stepper of GET_POSITION)" if firmware.title == "Klipper" else ""
    return table, (
        *read.notes,
        f"{firmware.title} knows no effector: assumed are {' and '.join(assumed)} "
        "(--platform-radius states its radius, from which the distance follows), and a radius of "
        f"{thick:g} {unit} of the rods (--leg-radius). Where rods are looked for in photographs "
        "depends on these, the numbers of the firmware do not.",
        f"A reading is {'the angle of an arm' if ideal.turns else 'the height of a carriage'} as "
        f"{firmware.title} counts it{where}, the endstop the upper end of the travel.",
    )


def _printable(read: Configuration, size: float) -> float:
    """Return the radius of the bed, beyond which the firmware does not move."""
    return read.printable or PRINTABLE * size


def _lowest(read: Configuration, ideal: IdealDelta, size: float) -> Array:
    """Return the lowest positions of the motors: those on the bed, or as stated."""
    if read.lowest is not None:
        return np.full(TOWERS, read.lowest)
    turn = np.linspace(0.0, 2.0 * np.pi, 36, endpoint=False)
    ring = _printable(read, size) * np.stack(
        [np.cos(turn), np.sin(turn), np.zeros_like(turn)], axis=1
    )
    on_bed = ideal.motors(np.concatenate([np.zeros((1, 3)), ring]))
    return np.asarray(np.min(np.where(np.isfinite(on_bed), on_bed, np.inf), axis=0)) - 1e-3 * size


def _check(path: Path, read: Configuration, ideal: IdealDelta, unit: str) -> None:
    """Refuse a Delta that cannot be one, the most likely cause first."""
    start = f"{path}: the {read.firmware.title} configuration could not be used: found"
    apart = np.abs((ideal.angle - np.roll(ideal.angle, 1) + 180.0) % 360.0 - 180.0)
    rod, radius, stop, problems = ideal.rod, ideal.radius, ideal.stop, []
    if apart.min() < MIN_APART:
        i = int(np.argmin(apart))
        problems.append(
            f"{start} towers {'abc'[i - 1]} and {'abc'[i]} {apart[i]:.4g} deg apart, at "
            f"{ideal.angle[i - 1]:g} and {ideal.angle[i]:g} deg, needed towers around the bed, as "
            f"a rule 120 deg apart; correct their angles."
        )
    sizes = 1e3 * LENGTH[unit] * rod
    least = min(radius.min(), ideal.arm.min() if ideal.turns else np.inf)
    over_bed = f"{unit} over the bed with rods of"
    height = "the height of the nozzle at the endstops; write"
    faults = (
        (not least > 0.0, f"a radius or arm of {least:g} {unit}", "a positive length; correct it"),
        (
            np.ptp(sizes) > 0.5 * sizes.max(),
            f"rods of {', '.join(f'{x:g}' for x in rod)} {unit} on a radius of {radius.min():g} "
            f"{unit}",
            "rods that are nearly alike; write all lengths in one unit",
        ),
        (
            not (SIZES[0] <= sizes.min() and sizes.max() <= SIZES[1]),
            f"rods of {rod.min():g} {unit}",
            f"{SIZES[0]:g} to {SIZES[1]:g} mm; state their unit with --unit in or --unit m if they "
            "are in another one, or correct them",
        ),
        (
            not ideal.turns and (rod <= radius).any(),
            f"rods of {rod.min():g} {unit} on a radius of {radius.max():g} {unit}",
            "rods that are longer than the radius, as a rule twice as long; write both in one "
            "unit, or correct them",
        ),
        (
            not ideal.stops_are_motors and not (0.05 * rod < stop).all(),
            f"endstops {stop.min():g} {over_bed} {rod.max():g} {unit}",
            f"{height} it in the unit of the rods",
        ),
        (
            not ideal.turns and (stop > 15.0 * rod).any(),
            f"endstops {stop.max():g} {over_bed} {rod.min():g} {unit}",
            f"{height} both in one unit",
        ),
    )
    likeliest = [f"{start} {found}, needed {needed}." for is_so, found, needed in faults if is_so]
    problems += likeliest[:1]
    largest = LARGEST_TRIM * read.values.get("M665 L", np.inf)
    problems += [
        f"{start} {letter} of M665, the correction of a rod, of {trim:g} {unit}, needed at most "
        f"{largest:.4g} {unit} (5 % of the rod); correct it."
        for letter in "ABC" * (read.firmware.name == "marlin")
        if not abs(trim := read.values.get(f"M665 {letter}", 0.0)) <= largest
    ]
    if problems:
        raise ModelError(problems)


_DELTAS: Sequence[Callable[[Path, str], Configuration | None]] = (
    _klipper,
    _marlin_header,
    _g_code,
)


STRUTS = 6
NUMBER = r"[-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?"
Table = tuple[dict[str, Any], tuple[str, ...]]
_TRAVEL = (0.8, 1.2)  # of the length at home, where limits are not stated
LINEAR_UNITS = {
    "mm": "mm",
    "metric": "mm",
    "cm": "cm",
    "in": "in",
    "inch": "in",
    "inches": "in",
    "imperial": "in",
}
_UNSEEN = "No radius of the legs is stated: give --leg-radius, without which legs are invisible."


def linuxcnc_table(path: Path, text: str, given: Mapping[str, Any]) -> Table | None:
    """Return the table of a HAL file, or of an INI file with the lines of its HAL files."""
    if not re.search(r"^\s*#?\s*\[(KINS|TRAJ|JOINT_\d)\]|^\s*setp\s+genhex", text, re.MULTILINE):
        return None
    entries = ini_entries(text)
    kinematics = next(iter(entries.get("KINS.KINEMATICS", "genhexkins").split()), "nothing")
    if kinematics != "genhexkins":
        raise ModelError(
            f"{path}: the LinuxCNC configuration could not be used: found KINEMATICS = "
            f"{kinematics}, needed genhexkins; describe another machine in a table (legcal new "
            "--template)."
        )
    numbers = {
        match[1]: float(match[2])
        for match in re.finditer(rf"^\s*setp\s+genhexkins\.(\S+)\s+({NUMBER})", text, re.MULTILINE)
    }
    joints, missing = {}, list[str]()
    for side in ("base", "platform"):
        names = [[f"{side}.{j}.{axis}" for axis in "xyz"] for j in range(STRUTS)]
        missing += [name for row in names for name in row if name not in numbers]
        joints[side] = np.array([[numbers.get(name, 0.0) for name in row] for row in names])
        joints[side][:, 2] += numbers.get("spindle-offset", 0.0)
    if missing:
        raise ModelError(
            f"{path}: the hexapod could not be read: found no 'setp genhexkins.{missing[0]}'"
            + f" and {len(missing) - 1} more" * (len(missing) > 1)
            + ", needed x, y, z of six joints of base and platform; give the INI file that names "
            "the HAL file with these lines, or add them."
        )
    unit = linuxcnc_unit(path, entries)
    notes = [_UNSEEN] * ("radius" not in given)
    if numbers.get("screw-lead"):
        notes.append("The correction of screw-lead is left out: readings are lengths of struts.")
    table: dict[str, Any] = {
        "legcal_table": 1,
        "name": path.stem,
        "type": f"{STRUTS}-UPS",
        "base_joints": joints["base"].tolist(),
        "platform_joints": joints["platform"].tolist(),
    }
    if unit is not None:
        table["unit"] = unit
    of_home = entries.get("TRAJ.HOME")
    if "home" not in given:
        pose = re.findall(NUMBER, of_home or "")
        if len(pose) != STRUTS:
            raise ModelError(
                f"{path}: home could not be read: found {'no' if of_home is None else 'another'} "
                "HOME in [TRAJ], needed X Y Z A B C of a pose of the platform; give the INI file "
                "that has it, or --height."
            )
        xyz, rpy = np.array(pose, dtype=float).reshape(2, 3)
        table["home"] = {"xyz": xyz.tolist(), "rpy_deg": rpy.tolist()}
        at_home = np.linalg.norm(
            xyz
            + Rotation.from_euler("xyz", rpy, degrees=True).apply(joints["platform"])
            - joints["base"],
            axis=1,
        )
        notes += _set_lengths(path, table, entries, at_home, given)
    return table, tuple(notes)


def linuxcnc_unit(path: Path, entries: Mapping[str, str]) -> str | None:
    """Return the unit of lengths of an INI file, None where it is not stated."""
    words = entries.get("TRAJ.LINEAR_UNITS", "").split()
    unit = LINEAR_UNITS.get(words[0].lower()) if words else None
    if words and unit is None:
        raise ModelError(
            f"{path}: the unit could not be read: found LINEAR_UNITS = {words[0]}, needed mm or "
            "inch; correct it."
        )
    return unit


def ini_entries(text: str) -> dict[str, str]:
    """Return the entries of an INI file, by section; of a HAL file of legcal those of comments."""
    is_own = "written by legcal" in text
    section, entries = "", dict[str, str]()
    for line in text.splitlines():
        line = (line.removeprefix("#") if is_own else line.split("#")[0]).strip()
        if match := re.fullmatch(r"\[(\w+)\]", line):
            section = match[1]
        elif match := re.fullmatch(r"(\w+)\s*=\s*(.*)", line):
            entries.setdefault(f"{section}.{match[1]}", match[2])
    return entries


def _set_lengths(
    path: Path,
    table: dict[str, Any],
    entries: Mapping[str, str],
    at_home: Array,
    given: Mapping[str, Any],
) -> list[str]:
    """Write offsets and travel of the struts into a table; return what was assumed."""
    stated = {
        key: [
            float(number[0])
            for j in range(STRUTS)
            if (number := re.findall(NUMBER, entries.get(f"JOINT_{j}.{key}", "")))
        ]
        for key in ("HOME_OFFSET", "MIN_LIMIT", "MAX_LIMIT")
    }
    has_offsets = any(f"JOINT_{j}.HOME_OFFSET" in entries for j in range(STRUTS))
    if has_offsets and len(stated["HOME_OFFSET"]) < STRUTS:
        raise ModelError(
            f"{path}: the struts could not be used: found a HOME_OFFSET of "
            f"{len(stated['HOME_OFFSET'])} joints, needed a number in each of [JOINT_0] to "
            f"[JOINT_{STRUTS - 1}]; write the others, or leave out all."
        )
    if has_offsets:
        table["offsets"] = stated["HOME_OFFSET"]
    unit = table.get("unit", "machine units")
    limits = [np.array(stated[key]) for key in ("MIN_LIMIT", "MAX_LIMIT")]
    if "min_length" in given:
        return []
    if all(len(limit) == STRUTS for limit in limits) and (limits[0] > 0.0).all():
        for factor, words in ((25.4, "mm"), (1.0 / 25.4, "inches"), (1e3, "mm")):
            lengths = np.stack([at_home, factor * at_home])
            inside = ((limits[0] < lengths) & (lengths < limits[1])).all(axis=1)
            if inside.tolist() == [False, True]:
                raise ModelError(
                    f"{path}: the struts could not be used: found them {np.median(at_home):.6g} "
                    f"{unit} long at HOME and limits of {limits[0].min():g} to "
                    f"{limits[1].max():g}, which look like {words}, needed one unit in the HAL and "
                    "the INI file (LINEAR_UNITS); convert one of them."
                )
        offsets = np.array(table.setdefault("offsets", limits[0].tolist()))
        table["travel"] = (np.stack(limits, axis=1) - offsets[:, None]).tolist()
        return []
    table.setdefault("offsets", at_home.tolist())
    ends = np.outer(at_home, _TRAVEL) - np.array(table["offsets"])[:, None]
    table["travel"] = ends.tolist()
    low, high = _TRAVEL
    return [
        f"The limits of the joints are no lengths of struts: their travel is assumed from {low:g} "
        f"to {high:g} of the length at HOME; give --min-length and --max-length."
    ]


# --- FlyPT Mover --------------------------------------------------------------------------------


@dataclass(frozen=True)
class Rig:
    """The linear hexapod of FlyPT Mover, in one unit: x to the right, y to the front, z up.

    A short side of the platform is taken to be in front, and those of the base between those of
    the platform. Struts are counterclockwise from the right one of that side.
    """

    L1: float  # long side of the platform
    L2: float  # short side of the platform
    L3: float  # short side of the base
    L4: float  # long side of the base
    Middle: float  # length of an actuator at half of its travel

    @property
    def platform(self) -> Array:
        """The joints of the platform (6, 3) about their middle."""
        return _hexagon(self.L1, self.L2, np.array([90.0, 90.0, 210.0, 210.0, 330.0, 330.0]), -1.0)

    @property
    def base(self) -> Array:
        """The joints of the base (6, 3)."""
        return _hexagon(self.L4, self.L3, np.array([30.0, 150.0, 150.0, 270.0, 270.0, 390.0]), 1.0)


def _hexagon(long: float, short: float, middles: Array, sign: float) -> Array:
    """Return corners (6, 3) of a hexagon, on alternate sides of the middles of short sides."""
    r = np.sqrt((long**2 + long * short + short**2) / 3.0)
    half = sign * np.degrees(np.arcsin(short / (2.0 * r))) * np.tile([1.0, -1.0], 3)
    angle = np.radians(middles + half)
    return np.asarray(r * np.stack([np.cos(angle), np.sin(angle), np.zeros(STRUTS)], axis=1))


SIDES = ("L1", "L2", "L3", "L4")
_FLYPT = re.compile(
    r"<NUD(?:Rig)?(\w+)>([^<]*)<|"
    r"^[^\w\n]*(?:Rig|Base)?\s*(L[1-4]|Range|Middle|COR ?[XYZ])\b([^:=\n]*)[:=]"
    r"[ \t]*([-+.\d\"'][^\n]*)$",
    re.MULTILINE | re.IGNORECASE,
)


def flypt_table(
    path: Path, text: str, given: Mapping[str, Any], unit: str | None = None
) -> Table | None:
    """Return the table of a rig of FlyPT Mover: its XML, or ``L1: 1030`` lines.

    *unit* is that of lines without one, mm if None.
    """
    named = {match[3].upper() for match in _FLYPT.finditer(text) if match[3]}
    if "<RIG>" not in text and not named.issuperset(SIDES):
        return None
    rig, centre, half, stated = rig_in(path, text)
    unit = stated or unit or "mm"
    across = np.linalg.norm((rig.platform - rig.base)[:, :2], axis=1).max()
    if not (across < rig.Middle and half < 0.8 * rig.Middle):
        raise ModelError(
            f"{path}: the rig could not be used: found joints {across:.6g} {unit} apart from "
            f"above, Middle {rig.Middle:g} and Range {half:g} {unit}, needed Middle above the "
            f"first and far above Range; write all in {unit} (L1 and L4 are the long sides, Range "
            "half of the stroke)."
        )
    height = float(np.sqrt(rig.Middle**2 - across**2))
    table = {
        "legcal_table": 1,
        "name": path.stem,
        "unit": unit,
        "type": f"{STRUTS}-UPS",
        "base_joints": rig.base.tolist(),
        "platform_joints": (rig.platform - centre).tolist(),
        "offsets": rig.Middle,
        "travel": [-half, half],
        "home": {"xyz": [*centre[:2].tolist(), float(centre[2]) + height], "rpy_deg": [0, 0, 0]},
    }
    notes = [_UNSEEN] * ("radius" not in given)
    notes.append(
        "FlyPT Mover does not say where its first actuator is: leg1 is taken to be the right one "
        "of the short side in front (y), the others follow counterclockwise from above."
    )
    return table, tuple(notes)


def rig_in(path: Path, text: str) -> tuple[Rig, Array, float, str | None]:
    """Return the rig in a text, its centre of rotation (3,), half of its stroke, and their unit.

    The unit is None where none is stated, as in lines ``L1: 1030``; FlyPT Mover writes mm.
    """
    types = re.findall(r"Mover\.Rigs\.(\w+)", text)
    if types and "LinearHexapod" not in types:
        raise ModelError(
            f"{path}: the rig could not be used: found {', '.join(sorted(set(types)))}, needed "
            "LinearHexapod; describe another machine in a table, for which legcal new --template "
            "writes a start."
        )
    rigs = re.findall(r"<RIG>.*?</RIG>", text, re.DOTALL)
    text = next((rig for rig in rigs if "Rigs.LinearHexapod" in rig), text)
    names = {key.upper(): key for key in (*SIDES, "Range", "Middle", "CORX", "CORY", "CORZ")}
    values, units = dict[str, float](), dict[str, str | None]()
    for match in _FLYPT.finditer(text):
        key = names.get((match[1] or match[3]).upper().replace(" ", ""))
        if key is not None and key not in values:
            label, written = ("", match[2]) if match[1] else (match[4], match[5])
            values[key], units[key] = _length(path, key, label, written)
            units[key] = units[key] or ("mm" if match[1] else None)
    if len(set(units.values())) > 1:
        found = ", ".join(f"{key} in {unit or 'no unit'}" for key, unit in units.items())
        raise ModelError(
            f"{path}: the rig could not be read: found {found}, needed one unit for all; write all "
            "lengths in it."
        )
    needed = (*SIDES, "Range", "Middle")
    if missing := [key for key in needed if not 0.0 < values.get(key, 0.0) < MAX_NUMBER]:
        raise ModelError(
            f"{path}: the rig could not be read: found no positive {' and '.join(missing)}, needed "
            "the sides L1 to L4, Middle and Range of the actuators; write them as 'L1: 1030'."
        )
    centre = np.array([values.get(f"COR{axis}", 0.0) for axis in "XYZ"])
    rig = Rig(*(values[key] for key in (*SIDES, "Middle")))
    return rig, centre, values["Range"], units["Middle"]


def _length(path: Path, key: str, label: str, written: str) -> tuple[float, str | None]:
    """Return the number of a line and its unit, stated behind it or in brackets of the label."""
    written = re.split(r"#|;|//", written)[0].strip().rstrip(",").strip("\"' \t")
    number, behind = split_quantity(written)
    within = re.search(r"[\[(]\s*([A-Za-z]+)\s*[\])]", label)
    words = [word.lower() for word in (behind, within[1] if within else "") if word]
    units = [word if word in LENGTH else LINEAR_UNITS.get(word) for word in words]
    if np.isnan(number) or None in units or len(set(units)) > 1:
        found = " ".join([*([within[0]] if within else []), written])
        raise ModelError(
            f"{path}: {key} could not be read: found '{found}', needed a number, with a decimal "
            f"point and no other separators, and a unit ({', '.join(LENGTH)}) or none; write it as "
            f"'{key}: 1030 mm'."
        )
    return number, units[0] if units else None
