"""Controllers: LinuxCNC, FlyPT, and the nearest Delta that a firmware can express.

A firmware knows upright towers and two parallel rods as one (:mod:`legcal.descriptions.firmware`).
Its numbers are those with which it puts the nozzle, the origin of the platform link, nearest to
where the machine has it at the same steps from the endstops: least squares over the workspace, in a
frame that the firmware may choose, because photographs see no bed. What is stated is computed with
the numbers that are read back from the written lines.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import NamedTuple, TypeVar

import numpy as np
from scipy.spatial.transform import Rotation

from legcal.descriptions.controllers import SIDES, STRUTS, Rig, read_delta, rig_in
from legcal.descriptions.firmware import FIRMWARES, TOWERS, Firmware, IdealDelta
from legcal.exports.correction import stacked
from legcal.exports.subject import (
    Rendered,
    Subject,
    comment,
    one_file,
    other_gains,
)
from legcal.geometry.lines import cross
from legcal.geometry.types import Array
from legcal.machine.actuator import Actuator
from legcal.machine.closing import solve_poses
from legcal.machine.configurations import random_poses, workspace
from legcal.machine.kinematics import poses_at_readings
from legcal.machine.leg import JointType, Leg, LegKind
from legcal.machine.model import Machine, readings_at, vectors_A_to_B
from legcal.machine.picture import round_length
from legcal.pages.svg import BLUE, DIM, GREY, Canvas
from legcal.version import __version__

DIGITS = 7  # decimals of a number [mm, deg]
ROUNDS, RANK, SETTLED = 30, 1e-7, 1e-9  # of Gauss-Newton steps [mm, deg]
STEP = 1e-4  # of differences [mm, deg]
N_POSES, LEAST_POSES, SEED = 400, 50, 20160501
UPRIGHT = 0.97  # least cosine of a tower to the vertical
TURNED = 5.0  # [deg] of all towers from the nominal angles, above which the frame is turned
_MM = 1e3


def firmware_refusal(name: str, subject: Subject) -> str | None:
    """Return the reason for refusing a machine that a firmware does not know, or None."""
    machine, actuators = subject.machine, subject.machine.actuators
    kinds = {firmware.turns for firmware in FIRMWARES if firmware.name == name}
    title = next(firmware.title for firmware in FIRMWARES if firmware.name == name)
    needed = f"needed a Delta with three {'' if True in kinds else 'linear '}motors ({title})"
    if len(actuators) != TOWERS or machine.mobility != TOWERS:
        carry = f"{len(actuators)} motors that carry rods"
        return f"found {carry} and {machine.mobility} freedoms, {needed}"
    if machine.n_legs != 2 * TOWERS:
        return f"found {machine.n_legs} rods on them, {needed} and two rods on each"
    if not machine.is_determined:
        return f"found that {machine.undetermined}, {needed}"
    turns = {actuator.turns for actuator in actuators}
    if len(turns) > 1 or not turns <= kinds:
        return f"found motors that {'turn' if True in turns else 'slide'}, {needed}"
    up = _upwards(machine)
    for actuator in actuators:
        if (float(abs(actuator.axis @ up)) > UPRIGHT) is actuator.turns:
            return f"found that '{actuator.joint}' does not move as in a Delta, {needed}"
    return None


def firmware_files(name: str, subject: Subject, path: Path) -> Rendered:
    """Return the lines for a firmware, and a picture of what remains."""
    machine = subject.machine
    turns = machine.actuators[0].turns
    firmware = next(f for f in FIRMWARES if f.name == name and f.turns is turns)
    mount = _mounted(machine, firmware)
    readings, poses = _poses_to_print(mount)
    errors = mount.errors_at(readings, poses)
    fit = _nearest_delta(firmware, mount, errors)
    texts = {key: number_text(value) for key, value in firmware.values(fit).items()}
    texts["M669 A0"] = number_text(mount.lowest)
    lines = re.sub(r"\{(.+?)\}", lambda key: texts[key[1]], firmware.lines)
    mark = ";" if "M66" in lines else "#"
    head = f"{mark} {firmware.title} of {comment(subject.name)}, written by legcal {__version__}.\n"
    after, frame = _in_best_frame(errors, read_delta(path, f"{head}{lines}"))
    before = None
    if subject.nominal is not None:
        there, reached = poses_at_readings(
            subject.nominal, readings[:, list(subject.nominal.motors)], poses
        )
        then = _mounted(subject.nominal, firmware)
        of_nominal = then.errors_at(readings[reached], there[reached])
        before, _ = _in_best_frame(errors, _nearest_delta(firmware, then, of_nominal))
    remaining = _Remaining(firmware.title, mount.nozzle(poses), after, before)
    sentences = remaining.sentences("over the workspace")
    moved, across = np.linalg.norm(frame.reshape(2, 3), axis=1)
    turned = np.degrees(across / np.mean(mount.start.rod))
    ways = [f"{moved:.3g} mm and {turned:.3g} deg away"] * bool(moved > 1e-3 or turned > 1e-3)
    ways += ["turned so that its towers stand as in the firmware"] * mount.is_turned
    ways += [f"with z = 0 {mount.lift:g} mm below, where the bed may be"] * bool(mount.lift)
    if ways:
        sentences.append(f"Its frame is the base link, {', '.join(ways)}.")
    motors = zip(firmware.motors, mount.actuators, strict=True)
    named = ", ".join(f"{motor} is '{comment(actuator.joint)}'" for motor, actuator in motors)
    sentences.append(f"Motors: {named}; the endstops are where their travel ends at the top.")
    if gains := other_gains(machine):
        sentences.append(
            f"Motors move by their steps times {gains}: divide the steps per mm (rotation_distance "
            "multiplied) by it first, these numbers assume it done."
        )
    sentences.append(f"To use it, {firmware.after}.")
    said = "".join(f"{mark} {line}\n" for line in (*subject.warning, *sentences))
    text = f"{head}{said}\n{lines}"
    return remaining.rendered(text, sentences)


def number_text(value: float) -> str:
    """Return a number of a configuration [mm, deg]."""
    return f"{round(value, DIGITS) + 0.0:.{DIGITS}f}".rstrip("0").rstrip(".")


# --- the machine as a firmware sees it ----------------------------------------------------------


@dataclass(frozen=True, eq=False)
class _Mounted:
    """A machine in a frame with z up, its towers in the order of the firmware's angles."""

    machine: Machine
    frame: Array  # (3, 3) rotation of the frame in the base link
    is_turned: bool
    actuators: tuple[Actuator, ...]  # in the order of the towers
    tops: Array  # (3,) readings at the endstops [m or rad]
    signs: Array  # (3,) 1 where readings grow upwards
    start: IdealDelta
    lift: float = 0.0  # of the origin of the base link over z = 0 [mm]

    @property
    def _columns(self) -> list[int]:
        legs = self.machine.legs
        return [
            next(j for j, leg in enumerate(legs) if leg.motor_label == actuator.joint)
            for actuator in self.actuators
        ]

    @property
    def _size(self) -> float:
        return float(np.degrees(1.0)) if self.start.turns else _MM

    def steps(self, readings: Array) -> Array:
        """Return the way (k, 3) of the motors from their endstops, downwards [mm or deg]."""
        gains = np.array([actuator.gain for actuator in self.actuators])
        way = self.tops - readings[:, self._columns]
        return np.asarray(self._size * self.signs * gains * way)

    @property
    def lowest(self) -> float:
        """The lowest position of a motor."""
        travel = np.array([actuator.travel for actuator in self.actuators])
        way = self._size * np.abs(self.signs * self.tops - (self.signs * travel.T).min(axis=0))
        return float(np.min(self.start.at_stops - way))

    def nozzle(self, poses: Array) -> Array:
        """Return the origin of the platform link (k, 3) at poses [mm]."""
        return np.asarray(_MM * poses[:, :, 3] @ self.frame + [0.0, 0.0, self.lift])

    def errors_at(self, readings: Array, poses: Array) -> Errors[IdealDelta]:
        """Return the errors of the nozzle (k, 3) [mm] at readings and poses of the machine."""
        steps, nozzle, size = self.steps(readings), self.nozzle(poses), np.mean(self.start.rod)

        def errors(ideal: IdealDelta, frame: Array) -> Array:
            commanded = ideal.positions(ideal.at_stops - steps)
            turn = Rotation.from_rotvec(frame[3:] / size)
            return np.asarray(turn.apply(commanded) + frame[:3] - nozzle)

        return errors

    def over_bed(self) -> _Mounted:
        """Return it with z = 0 under the whole workspace, where its motors are not above z = 0."""
        start = self.start
        if (start.height if start.turns else start.stop).min() > 0.0:
            return self
        lift = float(np.ceil(-start.positions(np.full((1, TOWERS), self.lowest))[0, 2]))
        raised = replace(
            start,
            height=start.height + lift * start.turns,
            stop=start.stop + lift * (not start.stops_are_motors),
        )
        return replace(self, start=raised, lift=lift)


def _upwards(machine: Machine) -> Array:
    """Return the direction (3,) along the towers, or the axis of the arms, from the platform up."""
    axes = np.array([actuator.axis for actuator in machine.actuators])
    normal = np.linalg.svd(axes)[2][2 if machine.actuators[0].turns else 0]
    hanging = vectors_A_to_B(machine, machine.home).mean(axis=0)
    return np.asarray(-normal if hanging @ normal > 0.0 else normal)


def _mounted(machine: Machine, firmware: Firmware) -> _Mounted:
    """Return a machine in the frame of a firmware, with the start of its fit."""
    up = _upwards(machine)
    z = np.array([0.0, 0.0, 1.0])
    frame = np.eye(3)
    if up @ z < UPRIGHT:
        x = np.array([1.0, 0.0, 0.0]) if abs(up[0]) < 0.9 else np.array([0.0, 1.0, 0.0])
        x = x - (x @ up) * up
        x /= np.linalg.norm(x)
        frame = np.stack([x, cross(up, x), up], axis=1)
    is_turned = bool(up @ z < UPRIGHT)
    home = machine.home.rotation.as_matrix()
    rows = []
    for actuator in dict.fromkeys(machine.actuators):
        rods = [j for j, leg in enumerate(machine.legs) if leg.motor_label == actuator.joint]
        A = machine.A_base[rods].mean(axis=0)
        B = home @ machine.B_platform[rods].mean(axis=0)
        rod = float(np.mean([machine.legs[j].q0 for j in rods]))
        rows.append(_Row.of(actuator, A @ frame, B @ frame, rod, frame))
    angles = np.array([np.degrees(np.arctan2(*row.across[::-1])) for row in rows])
    if "angle" in firmware.nominal and ((angles[1] - angles[0]) % 360.0) > 180.0:
        rows, angles = [rows[0], rows[2], rows[1]], angles[[0, 2, 1]]
    nominal = np.array(firmware.nominal.get("angle", angles))
    off = (angles - nominal + 180.0) % 360.0 - 180.0
    off = off[0] + ((off - off[0] + 180.0) % 360.0 - 180.0)
    turn = float(off.mean())
    if "angle" in firmware.nominal and abs(turn) > TURNED:
        frame = frame @ Rotation.from_euler("z", turn, degrees=True).as_matrix()
        off, is_turned = off - turn, True
    start = IdealDelta(
        firmware.turns,
        radius=np.array([np.linalg.norm(row.across) for row in rows]),
        angle=nominal + off if "angle" in firmware.nominal else np.round(angles, 9) % 360.0,
        rod=np.array([row.rod for row in rows]),
        arm=np.array([row.arm for row in rows]),
        height=np.array([row.height for row in rows]),
        stop=np.array([row.stop for row in rows]),
        stops_are_motors=True,
    )
    if not firmware.stops_are_motors:  # the nozzle centred, under each tower's own endstop
        C = start.joints(start.stop[None])[0]
        across = np.linalg.norm(C[:, :2], axis=1)
        start = replace(
            start, stop=C[:, 2] - np.sqrt(start.rod**2 - across**2), stops_are_motors=False
        )
    start = firmware.ideal(firmware.values(start))
    mounted = _Mounted(
        machine,
        frame,
        is_turned,
        tuple(row.actuator for row in rows),
        np.array([row.top for row in rows]),
        np.array([row.sign for row in rows]),
        start,
    )
    return mounted.over_bed()


class _Row(NamedTuple):
    """A tower in the frame of a firmware [mm or deg]."""

    actuator: Actuator
    across: Array  # (2,) from the effector's joints to those of the carriage, or to the shaft
    rod: float
    arm: float
    height: float
    stop: float  # height of the carriage, or angle of the arm, at the endstop
    top: float  # the reading there [m or rad]
    sign: float

    @classmethod
    def of(cls, actuator: Actuator, A: Array, B: Array, rod: float, frame: Array) -> _Row:
        """Return the tower of a motor with A at reading 0, both joints in the frame [m]."""
        axis, point = actuator.axis @ frame, actuator.point @ frame
        if not actuator.turns:
            sign = 1.0 if axis[2] > 0.0 else -1.0
            top = actuator.travel[1] if sign > 0.0 else actuator.travel[0]
            at_top = A + actuator.gain * top * axis
            height = _MM * (at_top[2] - B[2])
            return cls(actuator, _MM * (at_top - B)[:2], _MM * rod, 0.0, 0.0, height, top, sign)
        shaft = point + ((A - point) @ axis) * axis
        across, arm = (shaft - B)[:2], A - shaft
        outwards = np.array([*across, 0.0]) / np.linalg.norm(across)
        sign = 1.0 if cross(axis, outwards)[2] > 0.0 else -1.0
        top = actuator.travel[1] if sign > 0.0 else actuator.travel[0]
        at_zero = float(np.arctan2(arm[2], arm @ outwards))
        stop = float(np.degrees(at_zero + sign * actuator.gain * top))
        length, height = float(np.linalg.norm(arm)), float(shaft[2] - B[2])
        return cls(actuator, _MM * across, _MM * rod, _MM * length, _MM * height, stop, top, sign)


def _poses_to_print(mount: _Mounted) -> tuple[Array, Array]:
    """Return readings (k, n_legs) and poses (k, 3, 4) where a Delta is used."""
    readings, motions = random_poses(mount.machine, N_POSES, SEED)
    usual = mount.start.is_usual(mount.start.at_stops - mount.steps(readings))
    if usual.sum() < LEAST_POSES:
        usual[:] = True
    return readings[usual], stacked(motions)[usual]


# --- least squares ------------------------------------------------------------------------------


# The errors of an ideal machine in a frame (6,), translation and turn [mm]; turns at its size.
Ideal = TypeVar("Ideal")
Errors = Callable[[Ideal, Array], Array]


def _nearest(errors: Errors[Ideal], ideal: Callable[[Array], Ideal], n: int) -> Ideal:
    """Return the ideal machine of n unknowns that is nearest to a machine, in any frame."""
    x = least_squares(lambda x: errors(ideal(x[:n]), x[n:]).ravel(), n + 6)
    return ideal(x[:n])


def _in_best_frame(errors: Errors[Ideal], ideal: Ideal) -> tuple[Array, Array]:
    """Return the errors of an ideal machine in the frame where they are least, and this frame."""
    frame = least_squares(lambda x: errors(ideal, x).ravel(), 6)
    return errors(ideal, frame), frame


def _nearest_delta(firmware: Firmware, mount: _Mounted, errors: Errors[IdealDelta]) -> IdealDelta:
    return _nearest(errors, partial(firmware.moved, mount.start), len(firmware.free()))


def least_squares(errors: Callable[[Array], Array], n: int) -> Array:
    """Return the unknowns (n,) of least errors, nearest to zero where several are as good."""
    x = np.zeros(n)
    for _ in range(ROUNDS):
        steps = STEP * np.eye(n)
        slope = np.stack([(errors(x + h) - errors(x - h)) / (2.0 * STEP) for h in steps], axis=1)
        change = np.linalg.lstsq(slope, -errors(x), rcond=RANK)[0]
        x = x + change
        if np.abs(change).max() < SETTLED:
            break
    return x


# --- figures ------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class _Remaining:
    """What remains between a machine and the nearest one that a controller can express [mm]."""

    title: str  # of the controller
    points: Array  # (..., 3) of the machine
    after: Array  # (..., 3) errors there
    before: Array | None  # with the nominal model

    def sentences(self, where: str) -> list[str]:
        """Return the errors in words."""
        sentences = [f"{self.title} is off by {describe_errors(self.after)} {where}."]
        if self.before is not None:
            sentences.append(
                "With the numbers of the nominal model it is off by "
                f"{describe_errors(self.before)}."
            )
        return sentences

    def rendered(self, text: str, sentences: Sequence[str]) -> Rendered:
        """Return a file with the picture of its errors beside it."""
        figures = {"remaining_mm": figures_of(self.after)}
        if self.before is not None:
            figures["nominal_mm"] = figures_of(self.before)
        first = None if self.before is None else self.before.reshape(-1, 3)
        points, after = self.points.reshape(-1, 3), self.after.reshape(-1, 3)
        picture = _picture(self.title, points, after, first)
        return Rendered({"": text.encode(), ".svg": picture.encode()}, tuple(sentences), figures)


def figures_of(errors: Array) -> dict[str, float]:
    """Return the sizes of errors (..., 3)."""
    sizes = np.linalg.norm(errors, axis=-1)
    return {"rms": float(np.sqrt(np.mean(sizes**2))), "max": float(sizes.max())}


def describe_errors(errors: Array) -> str:
    """Return the sizes of errors (..., 3) [mm] in words."""
    figures = figures_of(errors)
    return f"{figures['rms']:.3g} mm rms and {figures['max']:.3g} mm at most"


def _picture(title: str, nozzle: Array, after: Array, before: Array | None) -> str:
    """Return the errors at poses of the workspace, from above, as SVG."""
    panels = [(f"{title}: what remains", after)]
    if before is not None:
        panels.insert(0, ("with the nominal model", before))
    side, edge = 420.0, 50.0
    canvas = Canvas(side * len(panels), side + 30.0, f"Errors of the nozzle with {title}")
    canvas.box(0.0, 0.0, canvas.width, canvas.height, "white")
    middle = 0.5 * (nozzle.min(axis=0) + nozzle.max(axis=0))
    scale = (side - 2.0 * edge) / max(float(np.ptp(nozzle[:, :2], axis=0).max()), 1e-6)
    most = max(float(np.linalg.norm(errors, axis=1).max()) for _, errors in panels)
    longest = round_length(max(most, 1e-6))
    magnified = 30.0 / longest
    for k, (label, errors) in enumerate(panels):
        at = np.array([side * (k + 0.5), 0.5 * side])
        canvas.text(side * k + 12.0, 20.0, f"{label}: {describe_errors(errors)}")
        for point, error in zip(nozzle, errors, strict=True):
            x, y = at + scale * (point - middle)[:2] * [1.0, -1.0]
            place = " ".join(f"{coordinate:.1f}" for coordinate in point)
            tip = f"x y z {place}: {np.linalg.norm(error):.3g} mm"
            canvas.box(x - 2.0, y - 2.0, 4.0, 4.0, GREY, tip)
            canvas.segment((x, y), (x + magnified * error[0], y - magnified * error[1]), BLUE, 1.5)
            canvas.segment((x, y), (x, y - magnified * error[2]), "#b3541e", 1.0)
    y = side + 10.0
    canvas.segment((12.0, y), (12.0 + magnified * longest, y), BLUE, 2.0)
    canvas.text(
        22.0 + magnified * longest,
        y + 4.0,
        f"{longest:g} mm across (blue) and of height (brown, upwards on paper)",
        colour=DIM,
    )
    return str(canvas.markup())


# LinuxCNC


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


def linuxcnc_files(subject: Subject, path: Path) -> Rendered:
    """Return the HAL file; lines for the INI file are in its comments."""
    machine = subject.machine
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
                f"setp genhexkins.{side}.{j}.{axis} {round(float(_MM * x), 9)!r}"
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


# FlyPT Mover: the regular hexapod nearest to a machine, as the numbers of its rig. The rig has two
# sides each of platform and base, one length for all actuators, and the place of the centre of
# rotation (:class:`legcal.descriptions.controllers.Rig`). FlyPT Mover is taken to be off by the
# distance of the joints of the platform from where the rig has them, at the same positions of the
# actuators: least squares over the workspace, in a frame of the base that is chosen with it.

_NEWTON = 8  # steps of the forward kinematics of a rig


def flypt_refusal(subject: Subject) -> str | None:
    """Return the reason for refusing a machine other than a hexapod, or None."""
    refusal = hexapod_refusal(subject)
    return (
        None if refusal is None else refusal.split("; ")[0].replace("genhexkins", "LinearHexapod")
    )


def flypt_files(subject: Subject, path: Path) -> Rendered:
    """Return the numbers of the rig, and a picture of what remains."""
    machine = subject.machine
    readings, motions = workspace(machine)
    poses = stacked(motions)
    places = _Places(machine, readings, poses)
    x = places.nearest()
    numbers = dict(zip((*SIDES, "Middle", "COR X", "COR Y", "COR Z"), x, strict=True))
    stroke = np.ptp([leg.travel for leg in machine.legs], axis=1).min()
    numbers["Range"] = 0.5 * _MM * stroke
    text = "".join(f"{key}: {number_text(float(value))}\n" for key, value in numbers.items())
    rig, centre = rig_in(path, text)[:2]
    written = np.array([*(getattr(rig, side) for side in SIDES), rig.Middle, *centre])
    after, _ = _in_best_frame(places.errors, written)
    before = None
    if subject.nominal is not None:
        there, reached = poses_at_readings(
            subject.nominal, readings[:, list(subject.nominal.motors)], poses
        )
        of_nominal = _Places(subject.nominal, readings[reached], there[reached], places.order)
        before, _ = _in_best_frame(places.errors, of_nominal.nearest())
    remaining = _Remaining("FlyPT Mover", places.joints, after, before)
    legs = ", ".join(f"'{comment(machine.leg_names[j])}'" for j in places.order)
    sentences = [
        *remaining.sentences("at the joints of the platform"),
        f"Actuators counterclockwise from the right one of the short side in front: {legs}.",
        "To use it, write the numbers into the rig (LinearHexapod) and start the rig from its "
        "lowest position; actuators have no offsets there, so that what they need is set in their "
        "controllers.",
    ]
    head = f"FlyPT Mover rig of {comment(subject.name)}, written by legcal {__version__}."
    comments = "".join(f"# {line}\n" for line in [head, *sentences])
    return remaining.rendered(f"{comments}\n{text}", sentences)


class _Places:
    """Where a machine has the joints of its platform, at positions of its actuators [mm]."""

    def __init__(
        self, machine: Machine, readings: Array, poses: Array, order: list[int] | None = None
    ) -> None:
        B = _MM * machine.B_platform
        centred = B - B.mean(axis=0)
        home = machine.home.rotation.as_matrix()
        seen = centred @ home.T
        angle = np.degrees(np.arctan2(seen[:, 1], seen[:, 0])) % 360.0
        by_angle = np.argsort(angle)
        gaps = np.diff(angle[by_angle], append=angle[by_angle[0]] + 360.0)
        first = int(np.argmin([gaps[k] + gaps[k + 2] + gaps[(k + 4) % 6] for k in (0, 1)]))
        pairs = list(range(first, STRUTS, 2))
        middles = np.array([(angle[by_angle[k]] + 0.5 * gaps[k]) % 360.0 for k in pairs])
        front = pairs[int(np.argmin(np.abs((middles - 90.0 + 180.0) % 360.0 - 180.0)))]
        self.order = [int(j) for j in np.roll(by_angle, -front)] if order is None else order
        turn = (middles[pairs.index(front)] - 90.0 + 180.0) % 360.0 - 180.0
        self._turn = Rotation.from_euler("z", turn, degrees=True)
        self._of_platform = home.T @ self._turn.as_matrix()  # axes of the rig in the link
        legs = [machine.legs[j] for j in self.order]
        mid = np.array([np.mean(leg.travel) for leg in legs])
        sign = np.array([float(leg.sign) for leg in legs])
        self.moves = _MM * sign * (readings[:, self.order] - mid)  # (k, 6) beyond the middle
        self.poses = poses.copy()
        self.poses[:, :, 3] *= _MM
        self._B = B[self.order]
        A = _MM * machine.A_base[self.order]
        self._middle = A.mean(axis=0)
        self.joints = self._B @ np.swapaxes(poses[:, :, :3], 1, 2) + self.poses[:, None, :, 3]
        lengths = _MM * np.array(
            [leg.length_at(q) for leg, q in zip(legs, mid.tolist(), strict=True)]
        )
        (long, short), (short_base, long_base) = _sides(self._B, 0), _sides(A, 1)
        sides = [long, short, short_base, long_base]
        centre = -B.mean(axis=0) @ self._of_platform
        self._start = np.array([*sides, lengths.mean(), *centre])

    def errors(self, rig: Array, frame: Array) -> Array:
        """Return the errors (k, 6, 3) of the joints, with a rig (8,) and the frame of its base."""
        sides = Rig(*rig[: len(SIDES) + 1])
        R_base = (self._turn * Rotation.from_rotvec(frame[3:] / self._start[4])).as_matrix()
        origin = self._middle + frame[:3]
        near_R = R_base.T @ self.poses[:, :, :3] @ self._of_platform
        near = (self.joints.mean(axis=1) - origin) @ R_base
        pairs = zip(sides.base, sides.platform, strict=True)
        ends = JointType.UNIVERSAL, JointType.SPHERICAL
        legs = [Leg(*ends, LegKind.ACTUATED, A, B, sides.Middle) for A, B in pairs]
        R, t = solve_poses(legs, (0, 2, 4), near_R, near, self.moves, steps=_NEWTON)[:2]
        joints = sides.platform @ np.swapaxes(R, 1, 2) + t[:, None]
        return np.asarray(joints @ R_base.T + origin - self.joints)

    def nearest(self) -> Array:
        """Return the rig (8,) of least errors; its centre of rotation stays."""
        n, centre = len(SIDES) + 1, np.zeros(3)
        return _nearest(self.errors, lambda x: self._start + np.append(x, centre), n)


def _sides(joints: Array, first: int) -> tuple[float, float]:
    """Return the mean sides of a hexagon: of pairs from the first or second joint, and others."""
    sides = np.linalg.norm(np.roll(joints, -1, axis=0) - joints, axis=1)
    others, pairs = float(sides[1 - first :: 2].mean()), float(sides[first::2].mean())
    return (others, pairs) if first == 0 else (pairs, others)
