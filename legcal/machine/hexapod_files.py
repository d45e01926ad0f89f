"""Configurations of controllers of hexapods as the table of a machine.

- LinuxCNC, ``genhexkins`` (manual page ``kins``, ``src/emc/kinematics/genhexkins.c``): joints in
  ``setp`` lines of a HAL file, units, limits and homes in the INI file, which names its HAL files.
  A joint of LinuxCNC is the length of a strut; a reading is that less HOME_OFFSET, the length where
  the encoder reads zero.
- FlyPT Mover, a rig of the type LinearHexapod: L1 and L2 are the long and the short side of the
  platform, L3 and L4 the short and the long side of the base, an actuator has the length Middle
  plus and minus Range, and COR is the centre of rotation over the middle of the platform's joints.
  A reading is the length less Middle.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from legcal.errors import ModelError
from legcal.files.quantity import LENGTH, split_quantity
from legcal.files.schema import content_of
from legcal.geometry.types import Array
from legcal.machine.description_csv import MAX_NUMBER

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


def length_unit(word: str) -> str | None:
    """Return the unit of lengths that a word means, None for others."""
    word = word.lower()
    return word if word in LENGTH else LINEAR_UNITS.get(word)


def linuxcnc_table(path: Path, text: str, given: Mapping[str, Any]) -> Table | None:
    """Return the table of a HAL file, or of an INI file with the HAL files that it names."""
    if not re.search(r"^\s*#?\s*\[(KINS|TRAJ|JOINT_\d)\]|^\s*setp\s+genhex", text, re.MULTILINE):
        return None
    entries = ini_entries(text)
    kinematics = next(iter(entries.get("KINS.KINEMATICS", "genhexkins").split()), "nothing")
    if kinematics != "genhexkins":
        raise ModelError(
            f"{path}: the LinuxCNC configuration could not be used: found KINEMATICS = "
            f"{kinematics}, needed genhexkins, or the HAL file with the setp lines of "
            "lineardeltakins or rotarydeltakins; describe another machine in a table (legcal new "
            "--template)."
        )
    pins = text
    for name in re.findall(r"^\s*HALFILE\s*=\s*(\S+)", text, re.MULTILINE):
        beside = path.parent / name
        if not name.startswith("LIB:") and beside.is_file():
            pins += "\n" + content_of(beside, "HAL file").decode(errors="replace")
    numbers = {
        match[1]: float(match[2])
        for match in re.finditer(rf"^\s*setp\s+genhexkins\.(\S+)\s+({NUMBER})", pins, re.MULTILINE)
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
    words = [word for word in (behind, within[1] if within else "") if word]
    units = [length_unit(word) for word in words]
    if np.isnan(number) or None in units or len(set(units)) > 1:
        found = " ".join([*([within[0]] if within else []), written])
        raise ModelError(
            f"{path}: {key} could not be read: found '{found}', needed a number, with a decimal "
            f"point and no other separators, and a unit ({', '.join(LENGTH)}) or none; write it as "
            f"'{key}: 1030 mm'."
        )
    return number, units[0] if units else None
