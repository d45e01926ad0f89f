"""Families whose joints at A move: rods on carriages or on arms, with a few dimensions."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np

from legcal.geometry.lines import cross
from legcal.geometry.types import Array
from legcal.machine.actuator import Actuator, ActuatorKind
from legcal.machine.description import Description, Home, LegEntry, LegType, leg_type
from legcal.machine.description_table import in_metres
from legcal.machine.leg import LegKind

SPREADS = 70.0, 20.0  # [deg] between the two servos of a pair, and its two platform joints


@dataclass(frozen=True)
class Rod:
    """One rod: where it ends, in the links, and what it hangs on."""

    A: Array  # (3,) at reading 0 [m]
    B: Array  # (3,) [m]
    motor: int


@dataclass(frozen=True)
class ActuatedFamily:
    """A family: its legs, its dimensions where none are given, and how they make a machine."""

    type: str  # of its legs
    motor: str  # what its motors are called, before their number
    dimensions: Mapping[str, float]  # [mm, deg]; these and no others can be given
    travel: tuple[float, float]  # [mm, or deg where motors turn]
    make: Callable[[Mapping[str, float], tuple[float, float]], Made]

    @property
    def legs(self) -> LegType:
        """The type of its legs."""
        found = leg_type(self.type)
        if found is None:
            raise ValueError(f"{self.type} is no type of a leg")
        return found

    @property
    def turns(self) -> bool:
        """Whether its motors turn."""
        return self.legs.actuator is ActuatorKind.REVOLUTE


@dataclass(frozen=True)
class Made:
    """A machine of a family; lengths in metres."""

    motors: tuple[tuple[Array, Array], ...]  # a point and the axis or direction of each
    rods: tuple[Rod, ...]
    height: float  # of the platform over the base at home


def describe_actuated_family(
    name: str,
    source: str,
    family: ActuatedFamily,
    given: Mapping[str, float],
    travel: tuple[float, float] | None,
    unit: str,
) -> Description:
    """Return the machine of a family: *given* are its dimensions [m, deg], travel is [m or deg].

    Raises
    ------
    ValueError
        If its rods are too short to reach the platform, or are one in the other; the text says
        which dimension is at fault, and goes on after what was found.
    """
    usual = {
        key: value if key.endswith("spread") else in_metres(value, "mm")
        for key, value in family.dimensions.items()
    }
    size = usual | dict(given)
    width, spacing = 2.0 * size["leg_radius"], size.get("rod_spacing", np.inf)
    if not width < spacing:
        raise ValueError(
            f"two rods {1e3 * spacing:.6g} mm apart that are {1e3 * width:.6g} mm thick, needed "
            "them beside each other; enlarge --rod-spacing, or give half of their diameter as "
            "--leg-radius."
        )
    low, high = travel or family.travel
    if family.turns:
        ends = float(np.radians(low)), float(np.radians(high))
    else:
        ends = travel or (in_metres(low, "mm"), in_metres(high, "mm"))
    made = family.make(size, ends)
    kind = ActuatorKind.REVOLUTE if family.turns else ActuatorKind.PRISMATIC
    motors = [
        Actuator(f"{family.motor}{i}", kind, axis, point, ends, f"{family.motor}{i}_link")
        for i, (point, axis) in enumerate(made.motors, start=1)
    ]
    for i, motor in enumerate(motors) if "arm_radius" in size else ():
        on_it = [j for j, rod in enumerate(made.rods) if rod.motor == i]
        A = np.array([made.rods[j].A for j in on_it])
        motors[i] = motor.with_arm(A, size["arm_radius"], f"leg{on_it[0] + 1}")
    radius = size["leg_radius"]
    legs = tuple(
        LegEntry(
            f"leg{j}", family.legs, LegKind.CONSTANT, rod.A, rod.B, size["rod_length"], None,
            radius, radius, None, None, motors[rod.motor],
        )
        for j, rod in enumerate(made.rods, start=1)
    )  # fmt: skip
    home = Home((0.0, 0.0, made.height), (0.0, 0.0, 0.0, 1.0))
    return Description(name, source, unit, legs, home, None)


def _third(k: int) -> tuple[Array, Array]:
    """Return the directions outward and along the circle of the k-th of three motors."""
    angle = 2.0 * np.pi * k / 3.0
    c, s = (round(float(f(angle)), 15) + 0.0 for f in (np.cos, np.sin))
    return np.array([c, s, 0.0]), np.array([-s, c, 0.0])


def _leg_over(length: float, beside: float, what: str) -> float:
    """Return the other leg of a right triangle below a rod."""
    if not abs(beside) < length:
        raise ValueError(
            f"rods of {1e3 * length:.6g} mm that reach {1e3 * abs(beside):.6g} mm {what}, needed "
            "longer rods; enlarge --rod-length, or correct the other dimensions."
        )
    return float(np.sqrt(length**2 - beside**2))


_Z = np.array([0.0, 0.0, 1.0])


def _hexaglide(size: Mapping[str, float], travel: tuple[float, float]) -> Made:
    """Return six carriages on three parallel rails, two on each, with a rod each.

    The outer rails carry the outer pairs of platform joints; the rods of the third lean across.
    Carriages of a rail move towards each other.
    """
    w, r, h = size["base_radius"], size["platform_radius"], size["height"]
    rails = -w, w, 0.4 * w
    joints = (0.2 * r, -r), (0.2 * r, r), (r, -0.6 * r)  # half the distance along, and across
    motors, rods = list[tuple[Array, Array]](), list[Rod]()
    for rail, (along, across) in zip(rails, joints, strict=True):
        beside = np.hypot(across - rail, h)
        reach = _leg_over(size["rod_length"], float(beside), "across the rails")
        # The first of rails 1 and 3 and the second of rail 2 are on one side: legs 1, 4, 5.
        for side in (-1.0, 1.0) if rail != w else (1.0, -1.0):
            d = np.array([-side, 0.0, 0.0])
            A = np.array([side * (along + reach), rail, 0.0]) - 0.5 * sum(travel) * d
            motors.append((A, d))
            rods.append(Rod(A, np.array([side * along, across, 0.0]), len(rods)))
    return Made(tuple(motors), tuple(rods), h)


def _three_prs(size: Mapping[str, float], travel: tuple[float, float]) -> Made:
    """Return three upright rails with a rod each, the platform above the carriages."""
    ends = _on_upright_rails(size, travel, side=-1.0)
    motors = tuple((A, _Z) for A, _, _ in ends)
    rods = tuple(Rod(A, B, k) for k, (A, B, _) in enumerate(ends))
    return Made(motors, rods, size["height"])


def _linear_delta(size: Mapping[str, float], travel: tuple[float, float]) -> Made:
    """Return three upright rails with two parallel rods each, the platform below the carriages."""
    ends = _on_upright_rails(size, travel, side=1.0)
    motors, rods = tuple((A, _Z) for A, _, _ in ends), list[Rod]()
    for k, (A, B, along) in enumerate(ends):
        rods += _pair(A, B, along, size["rod_spacing"], k)
    return Made(motors, tuple(rods), size["height"])


def _on_upright_rails(
    size: Mapping[str, float], travel: tuple[float, float], *, side: float
) -> list[tuple[Array, Array, Array]]:
    """Return A, B and the direction along the circle of rods that lean inwards on three rails.

    Carriages are above the platform (*side* 1) or below it (-1).
    """
    R, r, h = size["base_radius"], size["platform_radius"], size["height"]
    away = side * _leg_over(size["rod_length"], R - r, "inwards")
    thirds = [_third(k) for k in range(3)]
    return [
        (R * out + (h + away - 0.5 * sum(travel)) * _Z, r * out, along) for out, along in thirds
    ]


def _orthoglide(size: Mapping[str, float], travel: tuple[float, float]) -> Made:
    """Return three rails along x, y and z with two parallel rods each, in line with it at home."""
    motors, rods = list[tuple[Array, Array]](), list[Rod]()
    for k, d in enumerate(np.eye(3)):
        B = -size["platform_radius"] * d
        A = B - (size["rod_length"] + 0.5 * sum(travel)) * d
        motors.append((A, d))
        rods += _pair(A, B, np.roll(d, 1), size["rod_spacing"], k)
    return Made(tuple(motors), tuple(rods), 0.0)


def _delta(size: Mapping[str, float], travel: tuple[float, float]) -> Made:
    """Return three arms with two parallel rods each; arms are level at reading 0 and sink with it.

    Without a height the arms stand at mid-travel at home.
    """
    R, r, arm = size["base_radius"], size["platform_radius"], size["arm_length"]
    q = 0.5 * sum(travel)
    reach = R + arm * float(np.cos(q)) - r
    down = arm * float(np.sin(q)) + _leg_over(size["rod_length"], reach, "inwards at mid-travel")
    motors, rods = list[tuple[Array, Array]](), list[Rod]()
    for k in range(3):
        out, along = _third(k)
        motors.append((R * out, along))
        rods += _pair((R + arm) * out, r * out, along, size["rod_spacing"], k)
    return Made(tuple(motors), tuple(rods), size.get("height", -down))


def _servo_hexapod(size: Mapping[str, float], travel: tuple[float, float]) -> Made:
    """Return six servos in pairs, axes outwards, horns level at reading 0 and rising with it.

    Without a height the horns stand at mid-travel at home.
    """
    R, r, horn = size["base_radius"], size["platform_radius"], size["arm_length"]
    q = 0.5 * sum(travel)
    motors, rods, heights = list[tuple[Array, Array]](), list[Rod](), list[float]()
    for j in range(6):
        side = 1.0 if j % 2 == 0 else -1.0  # the first of a pair stands before its middle
        pair = 120.0 * (j // 2)
        at = np.radians(pair - 0.5 * side * size["base_spread"])
        out = np.array([float(np.cos(at)), float(np.sin(at)), 0.0])
        horn_out = side * cross(_Z, out)  # towards the other of the pair
        A = R * out + horn * horn_out
        to = np.radians(pair - side * (60.0 - 0.5 * size["platform_spread"]))
        B = r * np.array([float(np.cos(to)), float(np.sin(to)), 0.0])
        level = R * out + horn * np.cos(q) * horn_out - B
        beside = float(np.linalg.norm(level))
        up = _leg_over(size["rod_length"], beside, "beside the horns")
        heights.append(up + horn * float(np.sin(q)))
        motors.append((R * out, cross(horn_out, _Z)))
        rods.append(Rod(A, B, j))
    return Made(tuple(motors), tuple(rods), size.get("height", float(np.mean(heights))))


def _pair(A: Array, B: Array, along: Array, spacing: float, motor: int) -> list[Rod]:
    """Return the two rods of a parallelogram."""
    half = 0.5 * spacing * along
    return [Rod(A - half, B - half, motor), Rod(A + half, B + half, motor)]


FAMILIES = {
    "hexaglide": ActuatedFamily(
        "PSS",
        "rail",
        {"base_radius": 250.0, "platform_radius": 100.0, "height": 300.0, "rod_length": 400.0,
         "leg_radius": 6.0},
        (0.0, 200.0),
        _hexaglide,
    ),
    "3-prs": ActuatedFamily(
        "PRS",
        "rail",
        {"base_radius": 300.0, "platform_radius": 120.0, "height": 400.0, "rod_length": 350.0,
         "leg_radius": 7.0},
        (0.0, 200.0),
        _three_prs,
    ),
    "linear-delta": ActuatedFamily(
        "PSS",
        "rail",
        {"base_radius": 250.0, "platform_radius": 60.0, "height": 150.0, "rod_length": 400.0,
         "rod_spacing": 60.0, "leg_radius": 5.0},
        (0.0, 200.0),
        _linear_delta,
    ),
    "orthoglide": ActuatedFamily(
        "PSS",
        "rail",
        {"platform_radius": 60.0, "rod_length": 400.0, "rod_spacing": 60.0, "leg_radius": 5.0},
        (0.0, 200.0),
        _orthoglide,
    ),
    "delta": ActuatedFamily(
        "RSS",
        "arm",
        {"base_radius": 120.0, "platform_radius": 50.0, "arm_length": 200.0, "rod_length": 400.0,
         "rod_spacing": 60.0, "leg_radius": 5.0},
        (-30.0, 70.0),
        _delta,
    ),
    "servo-hexapod": ActuatedFamily(
        "RSS",
        "servo",
        {"base_radius": 80.0, "platform_radius": 60.0, "arm_length": 25.0, "rod_length": 150.0,
         "base_spread": SPREADS[0], "platform_spread": SPREADS[1], "leg_radius": 2.5},
        (-45.0, 45.0),
        _servo_hexapod,
    ),
}  # fmt: skip
# What follows where not given: heights from the lengths, and arms are boxes
OPTIONAL = {"delta": ("height", "arm_radius"), "servo-hexapod": ("height", "arm_radius")}
ALIASES = {"6-pss": "hexaglide", "6-rss": "servo-hexapod"}  # what else people call them
