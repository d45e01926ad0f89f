"""A drawing of a machine at home as SVG: from above and from the side, with numbers of joints.

A joint of the base is a disc ``A1``, a joint of the platform a disc ``B1``; those that define R_b
and R_e, the gauge of a calibration, have a ring. Legs have the thickness of their visible parts,
frame axes are red (x), green (y) and blue (z). Rails, carriages and arms are brown.
"""

from __future__ import annotations

from html import escape

import numpy as np

from legcal.errors import printable
from legcal.files.folder import OutputFile
from legcal.geometry.types import Array
from legcal.machine.drawing import (
    AXIS_COLOURS,
    BASE_COLOUR,
    LEG_COLOUR,
    MOTOR_COLOUR,
    PLATFORM_COLOUR,
    around,
    motor_lines,
    sketch_of,
)
from legcal.machine.model import Machine, vectors_A_to_B
from legcal.pages.svg import Canvas

_SIDE, _EDGE, _HEAD, _LINE = 420.0, 46.0, 44.0, 15.0  # panel, margin, title, text line [px]
_ARM = 34.0  # length of the axis of a frame [px]
_MARK = b"<!-- legcal inspect -->"


MACHINE_PICTURE = OutputFile(
    "the picture", "picture", "", "a new file or a picture that this command wrote", mark=_MARK
)


def draw_machine(machine: Machine, *, in_page: bool = False) -> str:
    """Return a machine as SVG: from above (x to the right, y up) and from the side (z up).

    The views are side by side in a file; *in_page*, which is narrow, one below the other.
    """
    sketch = sketch_of(machine)
    views = sketch.panels
    B = machine.home.apply(machine.B_platform)
    A = B - vectors_A_to_B(machine, machine.home)
    motors = motor_lines(machine.legs, A[None])
    points = np.concatenate([A, B, motors.standing.reshape(-1, 3), motors.moving.reshape(-1, 3)])
    low, high = points.min(axis=0), points.max(axis=0)
    scale = (_SIDE - 2 * _EDGE) / max(float((high - low).max()), 1e-6)
    across, down = (1, len(views)) if in_page else (len(views), 1)
    foot = _HEAD + _SIDE * down
    width, height = _SIDE * across, foot + _LINE * (2 + (machine.n_legs + 3) // 4)
    title = f"{machine.name} at home"
    canvas = Canvas(width, height, title)
    canvas.box(0.0, 0.0, width, height, "white")
    canvas.text(12.0, 20.0, title, size=15)
    for k, panel in enumerate(views):
        ends = (panel.standing.reshape(-1, 2), panel.moving.reshape(-1, 2))
        corners = np.concatenate([panel.A, panel.B, *ends])
        middle = 0.5 * (corners.min(axis=0) + corners.max(axis=0))
        left, top = _SIDE * (k % across), _HEAD + _SIDE * (k // across)
        corner = np.array([left, top]) + 0.5 * _SIDE

        def on_paper(points: Array, middle: Array = middle, at: Array = corner) -> Array:
            return np.asarray(at + scale * (points - middle) * [1.0, -1.0])

        A, B = on_paper(panel.A), on_paper(panel.B)
        canvas.text(left + 12.0, top, panel.title)
        if panel.is_plan:
            canvas.parts.append(_outline(on_paper(panel.rim), BASE_COLOUR))
            canvas.parts.append(_outline(B, PLATFORM_COLOUR))
        for parts, thick in ((panel.standing, 2.0), (panel.moving, 6.0)):
            for part in parts:
                start, end_of_part = on_paper(part)
                canvas.segment(start, end_of_part, MOTOR_COLOUR, thick, 0.8)
        for j, (a, b) in enumerate(zip(A, B, strict=True)):
            thick = 2.0 * scale * sketch.radii[j]
            canvas.segment(a, b, LEG_COLOUR, max(thick, 1.5), 0.7)
        for end, joints, colour in (("base", A, BASE_COLOUR), ("platform", B, PLATFORM_COLOUR)):
            _joints(canvas, machine, end, joints, colour, is_plan=panel.is_plan)
        for frame, (origin, *arms) in panel.frames:
            tips = origin + _ARM / scale * np.array(arms)
            _frame(canvas, frame, on_paper(np.vstack([origin, tips])))
    _legend(canvas, machine, scale, foot)
    if not in_page:
        canvas.parts.insert(0, _MARK.decode())
    return canvas.markup()


def _outline(joints: Array, colour: str) -> str:
    """Return the polygon around joints."""
    corners = " ".join(f"{x:.1f},{y:.1f}" for x, y in joints[around(joints)])
    return (
        f'<polygon points="{corners}" fill="{colour}" fill-opacity="0.06" stroke="{colour}" '
        'stroke-opacity="0.5" stroke-dasharray="4 3"/>'
    )


def _joints(
    canvas: Canvas, machine: Machine, end: str, joints: Array, colour: str, *, is_plan: bool
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
        at = (x + 17.0 * away[0], y + 17.0 * away[1] + 4.0)
        canvas.text(*at, f"{joint_letter(end)}{j + 1}", colour=colour, anchor="middle")


def joint_letter(end: str) -> str:
    """Return the letter of joint numbers: A at the base, B at the platform."""
    return "A" if end == "base" else "B"


def _frame(canvas: Canvas, name: str, points: Array) -> None:
    """Draw the axes of a frame: its origin and the ends of x, y and z."""
    for axis, (end, colour) in enumerate(zip(points[1:], AXIS_COLOURS, strict=True)):
        if np.linalg.norm(end - points[0]) < 3.0:  # towards the viewer
            continue
        canvas.segment(points[0], end, colour, 2.0)
        x, y = points[0] + 1.2 * (end - points[0])
        letter = f"{name} {'xyz'[axis]}" if axis == 0 else "xyz"[axis]
        canvas.text(x, y - 2.0, letter, colour=colour, anchor="middle", size=11)


def _legend(canvas: Canvas, machine: Machine, scale: float, y: float) -> None:
    """Draw a scale bar, and write the numbers of the legs."""
    step = _round_length(100.0 / scale)
    canvas.line(12.0, y, 12.0 + step * scale, y, BASE_COLOUR, 2.0)
    canvas.text(18.0 + step * scale, y + 4.0, f"{1e3 * step:g} mm")
    frame = ", ".join(str(j + 1) for j in machine.frame_legs)
    y += _LINE
    rings = f"legs {frame} define R_b (base{machine.at_zero}) and R_e (platform)."
    canvas.text(12.0, y + 6.0, f"Rings: the joints of {rings}")
    for k in range(0, machine.n_legs, 4):
        y += _LINE
        names = [f"{j + 1} {machine.leg_names[j]}" for j in range(k, min(k + 4, machine.n_legs))]
        canvas.text(12.0, y + 8.0, ",  ".join(names))


def _round_length(length: float) -> float:
    """Return the largest length of 1, 2 or 5 times a power of ten that is not longer."""
    power = 10.0 ** np.floor(np.log10(length))
    return float(max(step * power for step in (1, 2, 5) if step * power <= length * (1 + 1e-9)))
