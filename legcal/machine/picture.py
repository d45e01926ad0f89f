"""Drawings of a machine at home as SVG: from above and from the side, with numbers of joints.

A joint of the base is a disc ``A1``, a joint of the platform a disc ``B1``; those that define R_b
and R_e, the gauge of a calibration, have a ring. Legs have the thickness of their visible parts,
frame axes are red (x), green (y) and blue (z). Rails, carriages and arms are brown.
"""

from __future__ import annotations

from collections.abc import Sequence
from html import escape
from textwrap import wrap
from typing import NamedTuple

import numpy as np

from legcal.errors import printable
from legcal.files.folder import OutputFile
from legcal.geometry.types import Array
from legcal.machine.leg import Leg
from legcal.machine.model import Machine, vectors_A_to_B
from legcal.machine.rods import actuator_index, actuators_of
from legcal.pages.svg import Canvas, Figure

BASE_COLOUR, PLATFORM_COLOUR, LEG_COLOUR = "#333333", "#1f66b0", "#b9b9b9"
MOTOR_COLOUR = "#8a6d3b"  # arms, carriages and rails
AXIS_COLOURS = ("#c62828", "#2e7d32", "#1565c0")  # x, y, z
_CARRIAGE = 0.06  # length of a carriage, relative to its travel
_STRAIGHT = 1e-9  # bend that counts as straight, relative to the squared size
_EDGE, _HEAD, _LINE = 46.0, 44.0, 15.0  # margin, title, text line [px]
_ARM = 34.0  # length of the axis of a frame [px]
_APART = 15.0  # smallest distance of the names of marks [px]
_NAME = np.array([18.0, 11.0])  # least distances of names in a row and in a column [px]
_STEP, _MOST_STEPS = 6.0, 8  # [px] to the next place that is tried for a name
_LETTER = 6.6  # width of a letter of the legend [px], at most on average
_MARK = b"<!-- legcal inspect -->"


MACHINE_PICTURE = OutputFile(
    "the picture", "picture", "", "a new file or a picture that this command wrote", mark=_MARK
)


class MotorLines(NamedTuple):
    """Motors that move joints at A, as lines [m]."""

    anchors: Array  # (n_motors, 3) middles of rails, and where arms meet their axes
    standing: Array  # (n_motors, 2, 3) rails over their travel, and axes
    moving: Array  # (k, m, 2, 3) carriages, arms, and bars between the joints of one motor


def motor_lines(legs: Sequence[Leg], A: Array) -> MotorLines:
    """Return the motors of legs at joint positions A (k, n_legs, 3), in the frame of the legs.

    Machines with fixed joints A have none. The sizes of carriages and axes are only for display.
    """
    on, k = actuator_index(legs), len(A)
    anchors, standing, moving = list[Array](), list[Array](), list[Array]()
    for number, motor in enumerate(actuators_of(legs)):
        rods = [j for j, a in enumerate(on) if a == number]
        joints = A[:, rods]
        middle = joints.mean(axis=1)
        start = np.mean([legs[j].A for j in rods], axis=0)
        if motor.turns:
            foot = motor.point + ((start - motor.point) @ motor.axis) * motor.axis
            size = float(np.linalg.norm(start - foot))
            anchors.append(foot)
            standing.append(foot + size * np.outer([-0.25, 0.25], motor.axis))
            moving.append(np.stack([np.tile(foot, (k, 1)), middle], axis=1))
        else:
            low, high = motor.travel
            if not np.isfinite(high - low):
                low, high = -0.5 * legs[rods[0]].q0, 0.5 * legs[rods[0]].q0
            rail = start + motor.gain * np.outer([low, high], motor.axis)
            anchors.append(rail.mean(axis=0))
            standing.append(rail)
            half = 0.5 * _CARRIAGE * (rail[1] - rail[0])
            moving.append(np.stack([middle - half, middle + half], axis=1))
        moving += [joints[:, i : i + 2] for i in range(len(rods) - 1)]
    return MotorLines(
        np.array(anchors).reshape(-1, 3),
        np.array(standing).reshape(-1, 2, 3),
        np.stack(moving, axis=1) if moving else np.zeros((k, 0, 2, 3)),
    )


def corners_of_base(A: Array, anchors: Array) -> Array:
    """Return the corners of the base: its motors if there are three or more, else its joints A."""
    return anchors if len(anchors) > 2 else A


def around(points: Array) -> list[int]:
    """Return the rim of joints (n, 2 or 3), ordered about their centroid, the first twice.

    Inner joints, such as of a leg in the middle, are left out.
    """
    away = points - points.mean(axis=0)
    _, _, axes = np.linalg.svd(away)
    flat = away @ axes[:2].T
    order = np.argsort(np.arctan2(flat[:, 1], flat[:, 0])).tolist()
    least = -_STRAIGHT * np.ptp(flat, axis=0).max() ** 2
    k = 0
    while k < len(order) and len(order) > 3:
        before, here, after = (flat[order[(k + i) % len(order)]] for i in (-1, 0, 1))
        (a, b), (c, d) = here - before, after - here
        if a * d - b * c < least:
            del order[k]
            k = 0
        else:
            k += 1
    return [*order, order[0]]


class Mark(NamedTuple):
    """A line beside the machine, such as a camera, with a name."""

    points: Array  # (n, 3) in the base link [m]
    colour: str
    name: str = ""
    name_at: int = 0  # the point that has the name
    width: float = 1.5
    only_plan: bool = False  # seen from above alone


def plot_machine(machine: Machine) -> Figure:
    """Return a figure of a machine at home from above and from the side.

    Joints have the number of their leg (A1 on the base, B1 on the platform); those that define
    R_b and R_e have a ring, and axes are red (x), green (y) and blue (z).
    """
    return draw_machine(machine).markup()


def draw_machine(
    machine: Machine,
    *,
    in_page: bool = False,
    marks: Sequence[Mark] = (),
    title: str = "at home",
    side: float = 420.0,
) -> Canvas:
    """Draw a machine and marks beside it: from above (x to the right, y up) and the side (z up).

    The views, *side* pixels wide, are side by side in a file; *in_page*, which is narrow, one below
    the other.
    """
    B = machine.home.apply(machine.B_platform)
    A = B - vectors_A_to_B(machine, machine.home)
    motors = motor_lines(machine.legs, A[None])
    ends = (A, B, motors.standing.reshape(-1, 3), motors.moving.reshape(-1, 3))
    corners = np.concatenate([*ends, *(mark.points for mark in marks)])
    low, high = corners.min(axis=0), corners.max(axis=0)
    scale = (side - 2 * _EDGE) / max(float((high - low).max()), 1e-6)
    views = [("from above", [0, 1])] + [("from the side", [0, 2])] * machine.spatial
    heights = [2.0 * _EDGE + scale * float((high - low)[axes[1]]) for _, axes in views]
    width = side if in_page else side * len(views)
    foot = _HEAD + (sum(heights) if in_page else max(heights))
    legend = _legend(machine, width)
    height = foot + _LINE * (1 + len(legend))
    canvas = Canvas(width, height, f"{machine.name} {title}")
    canvas.box(0.0, 0.0, width, height, "white")
    canvas.text(12.0, 20.0, canvas.title, size=15)
    for k, (view, axes) in enumerate(views):
        left, top = (0.0, _HEAD + sum(heights[:k])) if in_page else (k * side, _HEAD)
        middle = 0.5 * (low + high)[axes]

        def on_paper(
            points: Array,
            axes: list[int] = axes,
            middle: Array = middle,
            at: tuple[float, float] = (left + 0.5 * side, top + 0.5 * heights[k]),
        ) -> Array:
            return np.asarray(at + scale * (points[..., axes] - middle) * [1.0, -1.0])

        is_plan = axes == [0, 1]
        canvas.text(left + 12.0, top, f"{view}: x to the right, {'xyz'[axes[1]]} up")
        if is_plan:
            rim = on_paper(corners_of_base(A, motors.anchors))
            canvas.parts += [_outline(rim, BASE_COLOUR), _outline(on_paper(B), PLATFORM_COLOUR)]
        for parts, thick in ((motors.standing, 2.0), (motors.moving[0], 6.0)):
            for start, end in on_paper(parts):
                canvas.segment(start, end, MOTOR_COLOUR, thick, 0.8)
        for leg, a, b in zip(machine.legs, on_paper(A), on_paper(B), strict=True):
            radius = max([c.radius for c in leg.cylinders], default=0.0)
            canvas.segment(a, b, LEG_COLOUR, max(2.0 * scale * radius, 1.5), 0.7)
        names = _Names()
        for end, joints, colour in (("base", A, BASE_COLOUR), ("platform", B, PLATFORM_COLOUR)):
            _joints(canvas, machine, end, on_paper(joints), colour, names, is_plan=is_plan)
        frames = {"R_b": machine.T_base_Rb, "R_e": machine.home * machine.T_platform_Re}
        for name, T in frames.items():
            tips = np.vstack([np.zeros(3), _ARM / scale * np.eye(3)])
            _frame(canvas, name, on_paper(T.apply(tips)), names)
        shown = [(m, on_paper(m.points)) for m in marks if is_plan or not m.only_plan]
        _draw_marks(canvas, shown, names)
    step = round_length(100.0 / scale)
    canvas.segment((12.0, foot), (12.0 + step * scale, foot), BASE_COLOUR, 2.0)
    canvas.text(18.0 + step * scale, foot + 4.0, f"{1e3 * step:g} mm")
    for k, text in enumerate(legend, 1):
        canvas.text(12.0, foot + _LINE * k + 7.0, text)
    if not in_page:
        canvas.parts.insert(0, _MARK.decode())
    return canvas


class _Names:
    """The places of short names in a drawing, none over another one."""

    def __init__(self) -> None:
        self._taken: list[Array] = []

    def place(self, at: Array, away: Array) -> Array:
        """Return the first free place (2,) for a name, from a place on in a direction."""
        steps = (at + k * _STEP * away for k in range(_MOST_STEPS))
        place = next((p for p in steps if all(np.any(abs(p - q) > _NAME) for q in self._taken)), at)
        self._taken.append(place)
        return place


def _draw_marks(canvas: Canvas, marks: Sequence[tuple[Mark, Array]], names: _Names) -> None:
    """Draw marks at points (n, 2), and their names but for those over the name of another mark."""
    named: list[Array] = []
    for mark, points in marks:
        canvas.path(points, mark.colour, mark.width)
        at = points[mark.name_at]
        if mark.name and all(np.linalg.norm(at - other) > _APART for other in named):
            named.append(at)
            half = 3.0 * len(mark.name)  # names of joints are placed by their middles
            beside, up = np.array([5.0 + half, -5.0]), np.array([0.0, -1.0])
            x, y = names.place(at + beside, up)
            canvas.text(x - half, y, mark.name, colour=mark.colour, size=11)


def _outline(joints: Array, colour: str) -> str:
    """Return the polygon around joints."""
    corners = " ".join(f"{x:.1f},{y:.1f}" for x, y in joints[around(joints)])
    return (
        f'<polygon points="{corners}" fill="{colour}" fill-opacity="0.06" stroke="{colour}" '
        'stroke-opacity="0.5" stroke-dasharray="4 3"/>'
    )


def _joints(
    canvas: Canvas,
    machine: Machine,
    end: str,
    joints: Array,
    colour: str,
    names: _Names,
    *,
    is_plan: bool,
) -> None:
    """Draw discs with numbers and names, with a ring if they define the frames."""
    middle = joints.mean(axis=0)
    sign = 1.0 if end == "base" else -1.0  # numbers of the base outside or below
    for j, (x, y) in enumerate(joints):
        name = escape(printable(f"{machine.leg_names[j]}.{end}"))
        canvas.parts.append(
            f'<circle cx="{x:.1f}" cy="{y:.1f}" r="4" fill="{colour}" data-joint="{name}">'
            f"<title>{name}</title></circle>"
        )
        if j in machine.frame_legs:
            canvas.parts.append(
                f'<circle cx="{x:.1f}" cy="{y:.1f}" r="8" fill="none" stroke="{colour}" '
                'stroke-width="1.5"/>'
            )
        away = np.array([x, y]) - middle if is_plan else np.array([0.0, 1.0])
        away = away / max(float(np.linalg.norm(away)), 1e-9) * sign
        x, y = names.place(np.array([x, y + 4.0]) + 17.0 * away, away)
        canvas.text(x, y, f"{joint_letter(end)}{j + 1}", colour=colour, anchor="middle")


def joint_letter(end: str) -> str:
    """Return the letter of joint numbers: A at the base, B at the platform."""
    return "A" if end == "base" else "B"


def _frame(canvas: Canvas, name: str, points: Array, names: _Names) -> None:
    """Draw the axes of a frame: its origin and the ends of x, y and z."""
    for axis, (end, colour) in enumerate(zip(points[1:], AXIS_COLOURS, strict=True)):
        if np.linalg.norm(end - points[0]) < 3.0:  # towards the viewer
            continue
        canvas.segment(points[0], end, colour, 2.0)
        along = (end - points[0]) / np.linalg.norm(end - points[0])
        x, y = names.place(points[0] + 1.2 * (end - points[0]) - np.array([0.0, 2.0]), along)
        letter = f"{name} {'xyz'[axis]}" if axis == 0 else "xyz"[axis]
        canvas.text(x, y, letter, colour=colour, anchor="middle", size=11)


def _legend(machine: Machine, width: float) -> list[str]:
    """Return the lines of the legend, which a drawing of this width holds: rings, and legs."""
    frame = ", ".join(str(j + 1) for j in machine.frame_legs)
    rings = f"legs {frame} define R_b (base{machine.at_zero}) and R_e (platform)."
    legs = [f"{j}\N{NO-BREAK SPACE}{name}" for j, name in enumerate(machine.leg_names, 1)]
    most = int((width - 24.0) / _LETTER)
    return [line for text in (f"Rings: the joints of {rings}", ",  ".join(legs))
            for line in wrap(text, most)]  # fmt: skip


def round_length(length: float) -> float:
    """Return the largest length of 1, 2 or 5 times a power of ten that is not longer."""
    power = 10.0 ** np.floor(np.log10(length))
    return float(max(step * power for step in (1, 2, 5) if step * power <= length * (1 + 1e-9)))
