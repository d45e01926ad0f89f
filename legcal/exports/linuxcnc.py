"""LinuxCNC: the HAL lines of genhexkins, and the home offsets of its joints.

genhexkins documents (manual page ``kins``): base and platform joint coordinates are the pins
``genhexkins.base.N.x|y|z`` and ``genhexkins.platform.N.x|y|z`` in machine units; a pose X Y Z A B C
is the position and the angles about fixed x, y and z [deg], R = Rz(C) Ry(B) Rx(A); joint N is the
length |xyz + R platform_N - base_N|. ``spindle-offset`` and ``tool-offset`` shift all joints along
z, ``screw-lead`` corrects screws that rotate with their leg: all three are zero in the model.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from legcal.exports.firmware import firmware_files, firmware_refusal
from legcal.exports.identifiers import comment
from legcal.exports.subject import ExportOptions, Rendered, Subject, one_file
from legcal.machine.hexapod_files import STRUTS
from legcal.machine.leg import LegKind
from legcal.machine.model import readings_at
from legcal.version import __version__

_MM = 1e3


def linuxcnc_refusal(subject: Subject) -> str | None:
    """Return the reason for refusing a machine that no kinematics of LinuxCNC are like, or None."""
    refusal = hexapod_refusal(subject)
    of_deltas = firmware_refusal("linuxcnc")(subject)
    return None if of_deltas is None else refusal and f"{refusal}, or a Delta with three motors"


def hexapod_refusal(subject: Subject) -> str | None:
    """Return the reason for refusing a machine unsupported by genhexkins, or None."""
    machine, legs = subject.machine, subject.machine.legs
    needed = "needed six legs with motors between universal and spherical joints (genhexkins)"
    if machine.actuators:
        motor = machine.actuators[0]
        return f"found that the motor '{motor.joint}' moves joints at A, {needed}"
    if len(legs) != STRUTS:
        return f"found {len(legs)} legs, {needed}"
    others = [
        f"'{leg.name}' of type {leg.type}{'' if leg.is_motor else ' without motor'}"
        for leg in legs
        if leg.kind is not LegKind.ACTUATED or len(leg.equations) > 1
    ]
    return f"found the leg {others[0]}, {needed}" if others else None


def linuxcnc_files(subject: Subject, options: ExportOptions, path: Path) -> Rendered:
    """Return the HAL file; lines for the INI file are in its comments."""
    machine = subject.machine
    if machine.actuators:
        return firmware_files("linuxcnc")(subject, options, path)
    home = readings_at(machine, machine.home)
    pose = [*(_MM * machine.home.translation), *machine.home.rotation.as_euler("xyz", degrees=True)]
    lines = [
        f"# genhexkins of {comment(subject.name)}, written by legcal {__version__}.",
        "# Machine units are mm and degrees ([TRAJ] LINEAR_UNITS = mm, ANGULAR_UNITS = degree).",
        "# X Y Z A B C is the platform link in the base link; joint N is the length of a leg:",
        *(f"#   joint {j}: {comment(leg.name)}" for j, leg in enumerate(machine.legs)),
        "# Load it after the module: loadrt genhexkins, or [KINS] KINEMATICS = genhexkins.",
        "",
    ]
    for side, points in (("base", machine.A_base), ("platform", machine.B_platform)):
        for j, point in enumerate(points):
            lines += [
                f"setp genhexkins.{side}.{j}.{axis} {float(_MM * x)!r}"
                for axis, x in zip("xyz", point, strict=True)
            ]
        lines.append("")
    lines += [
        "setp genhexkins.spindle-offset 0.0",
        "setp genhexkins.screw-lead 0.0",
        "",
        "# For the INI file. HOME_OFFSET is the length where the encoder reads zero, HOME that at",
        "# the home pose of the model. Readings of the sign -1 shrink as the leg grows.",
        "# [TRAJ]",
        "# LINEAR_UNITS = mm",
        f"# HOME = {' '.join(repr(float(x)) for x in pose)}",
    ]
    for j, leg in enumerate(machine.legs):
        lines += [
            f"# [JOINT_{j}]",
            "# TYPE = LINEAR",
            f"# HOME_OFFSET = {float(_MM * leg.q0)!r}",
            f"# HOME = {float(_MM * leg.length_at(float(home[j])))!r}",
            f"# (sign of the encoder: {leg.sign:+d})",
        ]
        ends = sorted(leg.length_at(q) for q in leg.travel)
        if np.isfinite(ends).all():
            lines += [
                f"# {key} = {float(_MM * end)!r}"
                for key, end in zip(("MIN_LIMIT", "MAX_LIMIT"), ends, strict=True)
            ]
    return one_file("\n".join(lines) + "\n")
