"""Kinematics of a machine as source code: its numbers, inverse and forward kinematics.

All three languages have the equations of :mod:`legcal.machine.equations` in the links of base and
platform: lengths of legs, directions perpendicular to a leg (R joints, legs fixed to the platform),
twists, and the plane of a planar machine. Joints at A on carriages and arms follow the readings;
readings at a pose are in closed form, in the working mode of home. The pose at readings, or at
coordinates of the platform, is followed from a start in short steps by Newton's method, so that the
assembly mode is kept.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from legcal.errors import UsageError
from legcal.exports.subject import (
    Rendered,
    Subject,
    c_string,
    comment,
    identifier,
    identifiers,
    is_identifier,
    matlab_string,
    one_file,
)
from legcal.geometry.lines import normal_basis
from legcal.geometry.types import Array
from legcal.machine.actuator import Actuator
from legcal.machine.closing import COORDINATES, independent_coordinates
from legcal.machine.kinematics import inverse_kinematics
from legcal.machine.leg import EquationKind, Leg, LegKind
from legcal.machine.model import Machine
from legcal.machine.rods import actuator_index
from legcal.version import __version__

TEMPLATES = Path(__file__).parent / "templates"
MAX_STEP = 0.05  # largest motion between poses, relative to the leg length
MAX_TURN = 0.25  # largest rotation of a short arm between poses [rad]
_ALONG_PLATFORM = (EquationKind.DIRECTION_1, EquationKind.DIRECTION_2)


def kinematics_refusal(subject: Subject) -> str | None:
    """Return the reason for refusing kinematics that Newton's method cannot follow, or None."""
    machine = subject.machine
    if not machine.is_determined:
        return f"found that {machine.undetermined}, needed readings that give the pose"
    if machine.is_redundant:
        return (
            f"found {len(machine.motors)} motors of a platform with mobility {machine.mobility}, "
            "whose poses are of least squares, needed as many motors as freedoms"
        )
    return None


def python_files(subject: Subject, path: Path) -> Rendered:
    """Return a Python module."""
    return one_file(_rendered("kinematics.py.jinja", subject.machine, subject.name, repr))


def c_files(subject: Subject, path: Path) -> Rendered:
    """Return a C99 source file."""
    return one_file(_rendered("kinematics.c.jinja", subject.machine, subject.name, c_string))


def matlab_files(subject: Subject, path: Path) -> Rendered:
    """Return a MATLAB function file, named like its function."""
    name = path.stem
    if not is_identifier(name) or path.suffix != ".m":
        raise UsageError(
            f"{path}: the export could not be written: found a name that MATLAB cannot call, "
            "needed letters, digits and '_', the first a letter, and the ending .m; give "
            f"{path.with_name(identifier(name) + '.m')}."
        )
    text = _rendered(
        "kinematics.m.jinja", subject.machine, subject.name, matlab_string, function=name
    )
    return one_file(text)


def _rendered(template: str, machine: Machine, name: str, quoted: Any, **more: Any) -> str:
    from jinja2 import Environment, FileSystemLoader, StrictUndefined

    environment = Environment(
        loader=FileSystemLoader(TEMPLATES),
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
        keep_trailing_newline=True,
        autoescape=False,
    )
    environment.filters |= {"row": _row, "quoted": quoted}
    return environment.get_template(template).render(
        **_numbers(machine), title=comment(name), name=name, prefix=identifier(name), **more
    )


def _row(numbers: Any) -> str:
    """Return numbers separated by commas, read back exactly."""
    return ", ".join(repr(float(x)) for x in np.ravel(numbers))


def _numbers(machine: Machine) -> dict[str, Any]:
    """Return the variables of the templates."""
    home = machine.home.as_matrix()
    legs, on = machine.legs, actuator_index(machine.legs)
    scale = machine.size
    first = sorted(set(machine.reads))  # the leg of each reading
    home_readings = inverse_kinematics(machine, machine.home)[first]
    columns = independent_coordinates(machine)
    return {
        "version": __version__,
        "base": machine.base,
        "platform": machine.platform,
        "legs": [
            {
                "name": leg.name,
                "identifier": identifier,
                "type": leg.type,
                "A": leg.A,
                "B": leg.B,
                "q0": leg.q0,
                "sign": leg.sign,
                "moves": int(leg.kind is not LegKind.CONSTANT),
                "has_length": int(leg.kind is not LegKind.PASSIVE),
                "reading": first.index(machine.reads[j]),
                "hangs_on": on[j],
            }
            for j, (leg, identifier) in enumerate(
                zip(legs, identifiers(machine.leg_names), strict=True)
            )
        ],
        "readings": [
            {
                "name": legs[j].prismatic or "",
                "leg": j,
                "is_motor": int(legs[j].is_motor),
                "step": _step(legs[j], MAX_STEP * scale),
            }
            for j in first
        ],
        "actuators": [
            _carrier(j, legs[j].mode, actuator, float(home_readings[r]))
            for r, j in enumerate(first)
            if (actuator := legs[j].actuator) is not None
        ],
        "coordinates": [
            {"name": COORDINATES[k], "number": int(k), "step": MAX_STEP * (scale if k < 3 else 1.0)}
            for k in columns
        ],
        "across": [row for j, leg in enumerate(legs) for row in _across(j, leg)],
        "twists": [row for j, leg in enumerate(legs) for row in _twists(j, leg)],
        "plane": None if machine.spatial else _plane(machine),
        "home": home[:3],
        "home_readings": home_readings,
        "scale": scale,
    }


def _step(leg: Leg, length: float) -> float:
    """Return the largest change of a reading that moves its joint by a length [m]."""
    return min(leg.reading_of(length), MAX_TURN) if leg.reads_angle else length


def _carrier(j: int, mode: int, actuator: Actuator, at_home: float) -> dict[str, Any]:
    """Return a carriage or an arm, with the solution of its reading from its first rod, leg j."""
    middle = 0.5 * sum(actuator.travel)
    return {
        "leg": j,
        "mode": mode,
        "turns": int(actuator.turns),
        "axis": actuator.axis,
        "point": actuator.point,
        "gain": actuator.gain,
        "middle": middle if np.isfinite(middle) else at_home,
    }


def _across(j: int, leg: Leg) -> list[dict[str, Any]]:
    """Return the directions that stay perpendicular to a leg, in base or platform."""
    directions = []
    for kind in leg.equations:
        if kind is EquationKind.BASE_AXIS:
            directions.append({"leg": j, "in_platform": 0, "direction": leg.base_axis})
        elif kind is EquationKind.PLATFORM_AXIS:
            directions.append({"leg": j, "in_platform": 1, "direction": leg.platform_axis})
        elif kind in _ALONG_PLATFORM and leg.platform_axis is not None:
            basis = normal_basis(leg.platform_axis)
            direction: Array = basis[_ALONG_PLATFORM.index(kind)]
            directions.append({"leg": j, "in_platform": 1, "direction": direction})
    return directions


def _twists(j: int, leg: Leg) -> list[dict[str, Any]]:
    """Return the angle between the axes at both ends of a leg without S."""
    if leg.twist is None or leg.base_axis is None or leg.platform_axis is None:
        return []
    tied = normal_basis(leg.platform_axis)[0] if leg.is_fixed_to_platform else leg.platform_axis
    return [
        {
            "leg": j,
            "base_axis": leg.base_axis,
            "base_crossed": int(leg.base_joint.inner_is_across),
            "platform_axis": tied,
            "platform_crossed": int(leg.platform_joint.inner_is_across),
            "angle": leg.twist,
        }
    ]


def _plane(machine: Machine) -> dict[str, Array]:
    """Return the normal of the plane of motion in base and platform, and two directions in it."""
    normal = machine.T_base_Rb.as_matrix()[:3, 2]
    across = normal_basis(normal)
    return {
        "normal": normal,
        "first": across[0],
        "second": across[1],
        "carried": machine.T_platform_Re.as_matrix()[:3, 2],
    }
