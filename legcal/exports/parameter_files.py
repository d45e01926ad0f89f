"""Parameters for people and scripts, in millimetres and degrees: ``table``, ``csv``, ``json``.

Every joint is listed twice: in the link that carries it, and in the frame of estimation, R_b or
R_e, defined by the joints of the ``base_frame`` legs.
"""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from legcal.calibration.documents import JointInLink
from legcal.calibration.summary import FRAMES, Quantity, aligned, joints_of, parameters_of
from legcal.exports.subject import Rendered, Subject, one_file
from legcal.files.quantity import SHOWN_IN
from legcal.files.table import format_table
from legcal.geometry.types import Array
from legcal.machine.leg import Leg, LegKind
from legcal.machine.model import Machine
from legcal.machine.parameters import geometries
from legcal.machine.rods import actuators_of
from legcal.version import __version__

COLUMNS = ("name", "frame", "unit", "value", "nominal", "change", "sigma", "status")
_DIGITS = 6  # decimals in the table


def csv_files(subject: Subject, path: Path) -> Rendered:
    """Return a CSV with a row for each number, read back exactly."""
    return one_file(
        format_table(COLUMNS, ([getattr(q, c) for c in COLUMNS] for q in rows_of(subject)))
    )


def table_files(subject: Subject, path: Path) -> Rendered:
    """Return a text table with aligned columns."""
    rows = [[_shown(getattr(row, c)) for c in COLUMNS] for row in rows_of(subject)]
    title = f"{subject.name}, written by legcal {__version__}"
    return one_file(f"{title}\n\n{aligned(COLUMNS, rows, COLUMNS[3:7])}\n")


def json_files(subject: Subject, path: Path) -> Rendered:
    """Return legs in links and in R_b and R_e, and the parameters with their covariance."""
    machine, joints = subject.machine, _joints(subject)
    document: dict[str, Any] = {
        "legcal_export": 1,
        "legcal": __version__,
        "machine": subject.name,
        "units": {"length": "mm", "angle": "deg"},
        "base_link": machine.base,
        "platform_link": machine.platform,
        "base_frame": [machine.leg_names[j] for j in machine.frame_legs],
        "T_base_Rb": _millimetres(machine.T_base_Rb.as_matrix()),
        "T_platform_Re": _millimetres(machine.T_platform_Re.as_matrix()),
        "home": _millimetres(machine.home.as_matrix()),
        "legs": [
            _leg(name, in_links, in_frames, joints)
            for name, in_links, in_frames in zip(
                machine.leg_names, machine.legs_of_frames, geometries(machine), strict=True
            )
        ],
        **_actuators(machine),
        "rows": [{c: getattr(row, c) for c in COLUMNS} for row in rows_of(subject)],
    }
    if subject.result is not None:
        result = subject.result.document
        unit = {row.name: row.unit for row in result.parameters}
        names = result.kinematic.names
        units = [SHOWN_IN[unit.get(name, "m")] for name in names]
        scale = np.array([factor for factor, _ in units])
        covariance = np.array(result.kinematic.covariance) * np.outer(scale, scale)
        document["covariance"] = {
            "names": names,
            "units": [word for _, word in units],
            "matrix": covariance.tolist(),
        }
    return one_file(json.dumps(document, indent=1, allow_nan=False) + "\n")


def rows_of(subject: Subject) -> list[Quantity]:
    """Return the rows of a subject: joints and axes in their links, then all parameters."""
    machine = subject.machine
    if subject.result is not None:
        result = subject.result.document
        return [*joints_of(result), *_directions(subject), *parameters_of(result)]
    legs, links = machine.legs_of_frames, {"base": machine.base, "platform": machine.platform}
    lengths = [
        Quantity.of(f"{leg.name}.{kind}", "", unit, (value, None, None))
        for leg in legs
        for kind, unit, value in (
            ("length" if leg.kind is LegKind.CONSTANT else "offset", "m", leg.q0),
            ("twist", "rad", leg.twist),
        )
        if value is not None and not (unit == "m" and leg.kind is LegKind.PASSIVE)
    ]
    in_links, in_frames = (
        [
            row
            for leg in several
            for side, frame in frames.items()
            for row in _vector(f"{leg.name}.{side}", frame, "m", _end(leg, side)[0])
        ]
        for several, frames in ((legs, links), (geometries(machine), FRAMES))
    )
    return [*in_links, *_directions(subject), *in_frames, *lengths]


def _directions(subject: Subject) -> Iterator[Quantity]:
    """Yield axes of joints in their links, directions and axes of actuators in the base link."""
    machine, nominal = subject.machine, subject.nominal
    status = "model" if subject.result is None else "derived"
    for side, link in (("base", machine.base), ("platform", machine.platform)):
        for j, leg in enumerate(machine.legs_of_frames):
            axis = _end(leg, side)[1]
            was = None if nominal is None else _end(nominal.legs_of_frames[j], side)[1]
            if axis is not None:
                if was is not None and axis @ was < 0.0:
                    was = -was  # axes are lines
                yield from _vector(f"{leg.name}.{side}_axis", link, "", axis, was, status)
    before = {} if nominal is None else {other.joint: other for other in nominal.actuators}
    for actuator in machine.actuators:
        other, joint = before.get(actuator.joint), actuator.joint
        name = f"{joint}.{'axis' if actuator.turns else 'direction'}"
        was = None if other is None else other.axis
        yield from _vector(name, machine.base, "", actuator.axis, was, status)
        if actuator.turns:
            was = None if other is None else other.point
            yield from _vector(
                f"{joint}.axis_point", machine.base, "m", actuator.point, was, status
            )


def _vector(
    name: str,
    frame: str,
    unit: str,
    vector: Array,
    nominal: Array | None = None,
    status: str = "model",
) -> Iterator[Quantity]:
    for k, axis in enumerate("xyz"):
        before = None if nominal is None else float(nominal[k])
        yield Quantity.of(f"{name}.{axis}", frame, unit, (float(vector[k]), before, None), status)


def _joints(subject: Subject) -> dict[tuple[str, str], JointInLink]:
    """Return the joints of a result in their links, by side and leg."""
    links = {} if subject.result is None else subject.result.document.links
    return {(side, joint.leg): joint for side, block in links.items() for joint in block.joints}


def _end(leg: Leg, side: str) -> tuple[Array, Array | None]:
    """Return the joint centre and the axis of a leg at base or platform."""
    return (leg.A, leg.base_axis) if side == "base" else (leg.B, leg.platform_axis)


def _leg(
    name: str, in_links: Leg, in_frames: Leg, joints: Mapping[tuple[str, str], JointInLink]
) -> dict[str, Any]:
    actuator = in_links.actuator
    has_travel = in_links.has_value and bool(np.isfinite(in_links.travel).all())
    scale = SHOWN_IN["m" if actuator is None else actuator.unit][0]
    return {
        "name": name,
        "type": in_links.type,
        "kind": in_links.kind.value,
        "sign": in_links.sign,
        "offset": None if in_links.kind is LegKind.PASSIVE else 1e3 * in_links.q0,
        "travel": [scale * x for x in in_links.travel] if has_travel else None,
        "A": {
            "link": _point(in_links.A),
            "R_b": _point(in_frames.A),
            **_uncertainty(joints.get(("base", name))),
        },
        "B": {
            "link": _point(in_links.B),
            "R_e": _point(in_frames.B),
            **_uncertainty(joints.get(("platform", name))),
        },
        "base_axis": _axes(in_links.base_axis, in_frames.base_axis, "R_b"),
        "platform_axis": _axes(in_links.platform_axis, in_frames.platform_axis, "R_e"),
        "twist": None if in_links.twist is None else float(np.degrees(in_links.twist)),
        **({} if actuator is None else {"actuator": actuator.joint}),
    }


def _actuators(machine: Machine) -> dict[str, Any]:
    """Return the entries of actuators, in the base link and in R_b."""
    in_frames = {actuator.joint: actuator for actuator in actuators_of(geometries(machine))}
    actuators = {}
    for actuator in machine.actuators:
        there = in_frames[actuator.joint]
        vector = "axis" if actuator.turns else "direction"
        actuators[actuator.joint] = {
            "kind": actuator.kind.value,
            vector: _axes(actuator.axis, there.axis, "R_b"),
        }
        if actuator.turns:
            points = {"link": _point(actuator.point), "R_b": _point(there.point)}
            actuators[actuator.joint]["point"] = points
    return {"actuators": actuators} if actuators else {}


def _point(point: Array) -> list[float]:
    """Return a point in millimetres."""
    return [1e3 * float(x) for x in point]


def _uncertainty(joint: JointInLink | None) -> dict[str, Any]:
    """Return the uncertainty of a joint centre in its link [mm, mm^2]."""
    if joint is None:
        return {}
    return {
        "sigma": [None if sigma is None else 1e3 * sigma for sigma in joint.sigma],
        "covariance": (1e6 * np.array(joint.covariance)).tolist(),
    }


def _axes(in_link: Array | None, in_frame: Array | None, frame: str) -> dict[str, Any] | None:
    if in_link is None or in_frame is None:
        return None
    return {"link": in_link.tolist(), frame: in_frame.tolist()}


def _millimetres(matrix: Array) -> list[list[float]]:
    """Return a motion with its translation in millimetres."""
    scaled = matrix.copy()
    scaled[:3, 3] *= 1e3
    rows: list[list[float]] = scaled.tolist()
    return rows


def _shown(value: str | float | None) -> str:
    if isinstance(value, str | None):
        return value or ""
    return f"{round(value, _DIGITS) + 0.0:.{_DIGITS}f}"
