"""Firmwares of Delta printers: their parameters, and the kinematics that they document.

All of them know one machine, in mm and degrees, with z up from the bed. Tower i stands at the angle
a_i. With its motor at m, the upper joint of its rod is, seen from above along a_i and upwards,

    C_i(m) = (radius_i, m)                                       m the height of a carriage
    C_i(m) = (radius_i + arm_i cos m, height_i + arm_i sin m)    m the angle of an arm, upwards

and the nozzle is the lower point at the distance rod_i from each C_i. ``radius`` is that of the
towers, or shoulders, less that of the joints on the effector. Firmwares differ in the parameters
that they add up to these numbers, which :data:`FIRMWARES` lists:

- Klipper: ``docs/Config_Reference.md`` (linear and rotary Delta), ``klippy/kinematics/delta.py``
  and ``rotary_delta.py``: ``position_endstop`` is the height of the centred nozzle at which the
  endstop triggers.
- RepRapFirmware: ``LinearDeltaKinematics.cpp`` and ``RotaryDeltaKinematics.cpp``: M665 (M669 K10 of
  arms) and M666, whose values raise endstops, of arms in degrees.
- Marlin: ``module/delta.cpp``, ``M665.cpp``, ``M666.cpp``: after its endstop a carriage moves by
  the value of M666, which is negative or zero.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np

from legcal.geometry.lines import cross
from legcal.geometry.types import Array, BoolArray

TOWERS = 3
FLATTEST = 20.0  # [deg] of a rod from the horizontal at the edge of the bed
_ALL = (0, 1, 2)
FIELDS = ("radius", "angle", "rod", "arm", "height", "stop")


@dataclass(frozen=True, eq=False)
class IdealDelta:
    """The Delta of a firmware; arrays (3,) by tower [mm or deg]."""

    turns: bool  # arms, not carriages
    radius: Array
    angle: Array
    rod: Array
    arm: Array
    height: Array  # of shoulders
    stop: Array  # height of the centred nozzle at the endstop; of ``stops_are_motors`` the motor
    stops_are_motors: bool = False

    @property
    def out(self) -> Array:
        """The directions of the towers (3, 3)."""
        angle = np.radians(self.angle)
        return np.stack([np.cos(angle), np.sin(angle), np.zeros(TOWERS)], axis=1)

    @property
    def at_stops(self) -> Array:
        """The positions (3,) of the motors at their endstops."""
        if self.stops_are_motors:
            return self.stop
        centred = np.zeros((TOWERS, 3))
        centred[:, 2] = self.stop
        # Firmwares take the radius without corrections of single towers for a centred nozzle.
        return np.asarray(np.diagonal(self.motors(centred)))

    def joints(self, motors: Array) -> Array:
        """Return the upper joints of the rods (k, 3, 3) with motors (k, 3)."""
        across, up = self.radius, motors
        if self.turns:
            angle = np.radians(motors)
            across, up = across + self.arm * np.cos(angle), self.height + self.arm * np.sin(angle)
        return np.asarray(
            np.asarray(across)[..., None] * self.out + up[..., None] * [0.0, 0.0, 1.0]
        )

    def positions(self, motors: Array) -> Array:
        """Return the nozzle (k, 3) with motors (k, 3): forward kinematics by trilateration.

        Where rods do not meet, the nearest point in the plane of their joints is returned.
        """
        C, rod = self.joints(motors), self.rod
        along, third = C[:, 1] - C[:, 0], C[:, 2] - C[:, 0]
        d = np.linalg.norm(along, axis=1)
        ex = along / d[:, None]
        i = np.einsum("ki,ki->k", ex, third)
        off = third - i[:, None] * ex
        j = np.linalg.norm(off, axis=1)
        ey = off / j[:, None]
        ez = cross(ex, ey)
        ez = ez * np.sign(ez[:, 2:])
        x = (rod[0] ** 2 - rod[1] ** 2 + d**2) / (2.0 * d)
        y = (rod[0] ** 2 - rod[2] ** 2 + i**2 + j**2 - 2.0 * i * x) / (2.0 * j)
        z = np.sqrt(np.maximum(rod[0] ** 2 - x**2 - y**2, 0.0))
        return np.asarray(C[:, 0] + x[:, None] * ex + y[:, None] * ey - z[:, None] * ez)

    def is_usual(self, motors: Array) -> BoolArray:
        """Return where (k,) all rods hang as steeply as Deltas are built for."""
        down = self.joints(motors)[:, :, 2] - self.positions(motors)[:, 2:]
        return np.asarray((down >= np.sin(np.radians(FLATTEST)) * self.rod).all(axis=1))

    def motors(self, positions: Array) -> Array:
        """Return the motors (k, 3) at positions of the nozzle (k, 3), NaN out of reach."""
        out = self.out
        across = positions @ out.T - self.radius
        beside = positions @ np.stack([-out[:, 1], out[:, 0], out[:, 2]])
        with np.errstate(invalid="ignore"):
            if not self.turns:
                return np.asarray(positions[:, 2:] + np.sqrt(self.rod**2 - across**2 - beside**2))
            up = positions[:, 2:] - self.height
            reach = np.hypot(across, up)
            cosine = (reach**2 + self.arm**2 - self.rod**2 + beside**2) / (2.0 * self.arm * reach)
            return np.asarray(np.degrees(np.arctan2(up, across) + np.arccos(cosine)))


@dataclass(frozen=True)
class Parameter:
    """A parameter of a firmware; it adds ``sign`` times its value to a field of some towers."""

    key: str
    field: str  # of IdealDelta
    towers: tuple[int, ...] = _ALL
    default: float | str | None = None  # or the parameter whose value it has; None if needed
    sign: float = 1.0
    is_fitted: bool = True  # exports have it; zero there if not


@dataclass(frozen=True)
class Firmware:
    """A kinematics of a firmware."""

    name: str  # as in ``export --to``
    title: str
    parameters: tuple[Parameter, ...]
    nominal: Mapping[str, tuple[float, ...]]  # numbers that parameters are added to
    motors: tuple[str, ...]  # their names
    lines: str  # to paste, with parameters by key
    after: str  # what the owner does with them
    turns: bool = False
    stops_are_motors: bool = False
    least: frozenset[str] = field(default_factory=frozenset)  # shared as the least of the towers

    def ideal(self, values: Mapping[str, float]) -> IdealDelta:
        """Return the Delta that values of the parameters describe."""
        fields = {name: np.zeros(TOWERS) for name in FIELDS}
        fields |= {name: np.array(start) for name, start in self.nominal.items()}
        for p in self.parameters:
            fields[p.field][list(p.towers)] += p.sign * values[p.key]
        return IdealDelta(self.turns, **fields, stops_are_motors=self.stops_are_motors)

    def values(self, ideal: IdealDelta) -> dict[str, float]:
        """Return the values of the parameters of a Delta: shared ones first, as means."""
        rest = {
            name: getattr(ideal, name) - np.array(self.nominal.get(name, (0.0,) * TOWERS))
            for name in FIELDS
        }
        values = {}
        for p in self.parameters:
            towers = list(p.towers)
            share = (np.min if p.key in self.least else np.mean)(rest[p.field][towers])
            values[p.key] = p.sign * float(share) * p.is_fitted + 0.0
            rest[p.field][towers] -= p.sign * values[p.key]
        return values

    def free(self) -> list[tuple[str, tuple[int, ...]]]:
        """Return the numbers that an export may change: a field, and its towers that share one."""
        numbers = []
        for name in FIELDS:
            fitted = [p.towers for p in self.parameters if p.field == name and p.is_fitted]
            single = [towers for towers in fitted if len(towers) == 1]
            numbers += [(name, towers) for towers in single or fitted]
        return numbers

    def moved(self, ideal: IdealDelta, step: Array) -> IdealDelta:
        """Return a Delta after a step (n,) of its free numbers [mm or deg]."""
        fields = {name: np.array(getattr(ideal, name)) for name in FIELDS}
        for (name, towers), change in zip(self.free(), step.tolist(), strict=True):
            fields[name][list(towers)] += change
        return IdealDelta(ideal.turns, **fields, stops_are_motors=ideal.stops_are_motors)


_KLIPPER = "abc"
_STEPPERS = tuple(f"stepper_{letter}" for letter in _KLIPPER)
_TOWERS = tuple(f"tower_{letter}" for letter in "xyz")
_LINEAR = {"angle": (210.0, 330.0, 90.0)}


def _klipper(keys: Mapping[str, str], angles: tuple[float, ...]) -> tuple[Parameter, ...]:
    """Return the parameters of sections [stepper_a] to [stepper_c]: by key, their fields."""
    return tuple(
        Parameter(
            f"stepper_{letter}.{key}",
            of_field,
            (i,),
            angles[i] if key == "angle" else (f"stepper_a.{key}" if i else None),
        )
        for i, letter in enumerate(_KLIPPER)
        for key, of_field in keys.items()
    )


def _klipper_lines(keys: Mapping[str, str], printer: str) -> str:
    sections = "".join(
        f"[stepper_{letter}]\n"
        + "".join(f"{key}: {{stepper_{letter}.{key}}}\n" for key in keys)
        + "\n"
        for letter in _KLIPPER
    )
    return f"{sections}[printer]\n{printer}"


_TOWER_KEYS = {"position_endstop": "stop", "arm_length": "rod", "angle": "angle"}
_ARM_KEYS = {
    "position_endstop": "stop",
    "upper_arm_length": "arm",
    "lower_arm_length": "rod",
    "angle": "angle",
}


def _by_tower(code: str, letters: str, of_field: str, sign: float = 1.0) -> tuple[Parameter, ...]:
    """Return a parameter of a G-code for each tower, zero by default."""
    return tuple(
        Parameter(f"{code} {letter}", of_field, (i,), 0.0, sign) for i, letter in enumerate(letters)
    )


def _list(code: str, of_field: str) -> tuple[Parameter, ...]:
    """Return the values of a list such as ``L288:288:288``; one value counts for all."""
    return tuple(
        Parameter(f"{code}{i}", of_field, (i,), f"{code}0" if i else None) for i in range(TOWERS)
    )


_BED = "photographs do not see the bed: "
_KLIPPER_AFTER = (
    "replace the same lines of printer.cfg and those of its SAVE_CONFIG block, then RESTART and "
    f"G28; {_BED}level it by a bed_mesh, because DELTA_CALIBRATE replaces radius and angles"
)
_DUET_AFTER = (
    "replace the same values in config.g and delete those of config-override.g, keep the tilt of "
    f"the bed (A and B of M666), then M999 and G28; {_BED}calibrate the endstops alone (G30 S3)"
)

FIRMWARES = (
    Firmware(
        "klipper",
        "Klipper",
        (
            Parameter("printer.delta_radius", "radius"),
            *_klipper(_TOWER_KEYS, _LINEAR["angle"]),
        ),
        {},
        _STEPPERS,
        _klipper_lines(_TOWER_KEYS, "kinematics: delta\ndelta_radius: {printer.delta_radius}\n"),
        _KLIPPER_AFTER,
    ),
    Firmware(
        "klipper",
        "Klipper",
        (
            Parameter("printer.shoulder_radius", "radius"),
            Parameter("printer.shoulder_height", "height"),
            *_klipper(_ARM_KEYS, (30.0, 150.0, 270.0)),
        ),
        {},
        _STEPPERS,
        _klipper_lines(
            _ARM_KEYS,
            "kinematics: rotary_delta\nshoulder_radius: {printer.shoulder_radius}\n"
            "shoulder_height: {printer.shoulder_height}\n",
        ),
        _KLIPPER_AFTER,
        turns=True,
    ),
    Firmware(
        "reprapfirmware",
        "RepRapFirmware",
        (
            Parameter("M665 R", "radius"),
            *_list("M665 L", "rod"),
            *_by_tower("M665", "XYZ", "angle"),
            Parameter("M665 H", "stop"),
            *_by_tower("M666", "XYZ", "stop"),
        ),
        _LINEAR,
        _TOWERS,
        "M665 L{M665 L0}:{M665 L1}:{M665 L2} R{M665 R} H{M665 H} X{M665 X} Y{M665 Y} Z{M665 Z}\n"
        "M666 X{M666 X} Y{M666 Y} Z{M666 Z}\n",
        _DUET_AFTER,
    ),
    Firmware(
        "reprapfirmware",
        "RepRapFirmware",
        (
            Parameter("M669 R", "radius"),
            *_list("M669 U", "arm"),
            *_list("M669 L", "rod"),
            *_list("M669 H", "height"),
            *_by_tower("M669", "XYZ", "angle"),
            Parameter("M669 A1", "stop"),
            *_by_tower("M666", "XYZ", "stop"),
        ),
        _LINEAR,
        _TOWERS,
        "M669 K10 R{M669 R} U{M669 U0}:{M669 U1}:{M669 U2} L{M669 L0}:{M669 L1}:{M669 L2} "
        "H{M669 H0}:{M669 H1}:{M669 H2} A{M669 A0}:{M669 A1} X{M669 X} Y{M669 Y} Z{M669 Z}\n"
        "M666 X{M666 X} Y{M666 Y} Z{M666 Z}\n",
        _DUET_AFTER,
        turns=True,
        stops_are_motors=True,
    ),
    Firmware(
        "marlin",
        "Marlin",
        (
            Parameter("M665 R", "radius"),
            *(
                Parameter(f"DELTA_RADIUS_TRIM_TOWER{i}", "radius", (i,), 0.0, is_fitted=False)
                for i in _ALL
            ),
            Parameter("M665 L", "rod"),
            *_by_tower("M665", "ABC", "rod"),
            *_by_tower("M665", "XYZ", "angle"),
            Parameter("M665 H", "stop"),
            *_by_tower("M666", "XYZ", "stop", -1.0),
        ),
        _LINEAR,
        _TOWERS,
        "M665 L{M665 L} R{M665 R} H{M665 H} A{M665 A} B{M665 B} C{M665 C} X{M665 X} Y{M665 Y} "
        "Z{M665 Z}\nM666 X{M666 X} Y{M666 Y} Z{M666 Z}\n",
        "send these lines, then M500 and G28 (DELTA_RADIUS_TRIM_TOWER in Configuration.h must be "
        f"zero or left out); {_BED}set its height alone (G33 P1) and level it (G29)",
        least=frozenset({"M665 H"}),
    ),
)
