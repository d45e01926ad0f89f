"""Pictures of a machine: at home from above and from the side, motors as lines.

In SVG a joint of the base is a disc ``A1``, a joint of the platform a disc ``B1``; those that
define R_b and R_e, the gauge of a calibration, have a ring. Legs have the thickness of their
visible parts, frame axes are red (x), green (y) and blue (z). Rails, carriages and arms are brown.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from legcal.figures import new_figure, plain
from legcal.geometry.types import Array
from legcal.machine.leg import Leg
from legcal.machine.model import Machine, vectors_A_to_B
from legcal.machine.rods import actuator_index, actuators_of

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

from html import escape

from legcal.errors import printable
from legcal.files.folder import OutputFile
from legcal.pages.svg import Canvas

BASE_COLOUR, PLATFORM_COLOUR, LEG_COLOUR = "#333333", "#1f66b0", "#b9b9b9"
MOTOR_COLOUR = "#8a6d3b"  # arms, carriages and rails
AXIS_COLOURS = ("#c62828", "#2e7d32", "#1565c0")  # x, y, z
_PANEL = (5.0, 5.0)  # size of a panel [inch]
_ARM = 0.1  # length of the axes of a frame, relative to the machine
_CARRIAGE = 0.06  # length of a carriage, relative to its travel
_STRAIGHT = 1e-9  # bend that counts as straight, relative to the squared size
_RING = 140.0  # area of rings around joints that define R_b and R_e [pt^2]


@dataclass(frozen=True, eq=False)
class Panel:
    """A machine seen along an axis of its base link, in the coordinates of the other two [m]."""

    title: str
    is_plan: bool  # seen from above
    A: Array  # (n_legs, 2) joints of the base
    B: Array  # (n_legs, 2) joints of the platform at home
    frames: tuple[tuple[str, Array], ...]  # R_b and R_e: (4, 2) origin, and x, y, z from it
    rim: Array  # (n, 2) outline of the base: its joints, or the positions of its motors
    standing: Array  # (n_motors, 2, 2) ends of rails and axes
    moving: Array  # (m, 2, 2) ends of arms, of carriages, and of bars between their joints


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


@dataclass(frozen=True, eq=False)
class Sketch:
    """The content of a picture of a machine."""

    name: str
    leg_names: tuple[str, ...]
    frame_legs: tuple[int, ...]
    radii: tuple[float, ...]  # largest visible radius of each leg [m]; zero without cylinders
    panels: tuple[Panel, ...]  # from above (y up), and in space from the side (z up)


def sketch_of(machine: Machine) -> Sketch:
    """Return the sketch of a machine at home."""
    B = machine.home.apply(machine.B_platform)
    A = B - vectors_A_to_B(machine, machine.home)
    motors = motor_lines(machine.legs, A[None])
    frames = {"R_b": machine.T_base_Rb, "R_e": machine.home * machine.T_platform_Re}
    views = [("from above", [0, 1])] + [("from the side", [0, 2])] * machine.spatial
    panels = tuple(
        Panel(
            f"{view}: x to the right, {'xyz'[axes[1]]} up",
            axes == [0, 1],
            A[:, axes],
            B[:, axes],
            tuple(
                (name, np.vstack([T.translation, T.rotation.as_matrix().T])[:, axes])
                for name, T in frames.items()
            ),
            corners_of_base(A, motors.anchors)[:, axes],
            motors.standing[..., axes],
            motors.moving[0][..., axes],
        )
        for view, axes in views
    )
    radii = tuple(max([c.radius for c in leg.cylinders], default=0.0) for leg in machine.legs)
    return Sketch(machine.name, machine.leg_names, machine.frame_legs, radii, panels)


def plot_machine(machine: Machine) -> Figure:
    """Return a figure of a machine at home from above and from the side, in millimetres.

    Joints have the number of their leg (A1 on the base, B1 on the platform); those that define
    R_b and R_e have a ring, and axes are red (x), green (y) and blue (z).
    """
    sketch = sketch_of(machine)
    with new_figure(len(sketch.panels), 2, _PANEL) as (figure, axes):
        for panel, ax in zip(sketch.panels, axes, strict=True):
            _draw(sketch, panel, ax)
        rings = ", ".join(plain(sketch.leg_names[j]) for j in sketch.frame_legs)
        figure.suptitle(
            f"{plain(sketch.name)} at home [mm]; rings: joints of {rings}, which define R_b and "
            "R_e",
            fontsize="medium",
        )
    return figure


def _draw(sketch: Sketch, panel: Panel, ax: Axes) -> None:
    A, B = 1e3 * panel.A, 1e3 * panel.B
    size = float(np.ptp(np.concatenate([A, B]), axis=0).max())
    for joints, colour in ((1e3 * panel.rim, BASE_COLOUR), (B, PLATFORM_COLOUR)):
        if panel.is_plan:
            ax.fill(*joints[around(joints)].T, facecolor=colour, edgecolor=colour, alpha=0.08)
    for lines, width in ((panel.standing, 1.5), (panel.moving, 4.0)):
        for ends in lines:
            ax.plot(*(1e3 * ends).T, color=MOTOR_COLOUR, linewidth=width, alpha=0.8)
    for j, (a, b) in enumerate(zip(A, B, strict=True)):
        across = np.array([a[1] - b[1], b[0] - a[0]])
        across *= 1e3 * sketch.radii[j] / max(float(np.linalg.norm(across)), 1e-9)
        ax.fill(*np.array([a + across, b + across, b - across, a - across]).T, color=LEG_COLOUR)
        ax.plot(*np.array([a, b]).T, color=LEG_COLOUR, linewidth=1.0)
    for letter, joints, colour in (("A", A, BASE_COLOUR), ("B", B, PLATFORM_COLOUR)):
        ax.scatter(joints[:, 0], joints[:, 1], s=25.0, color=colour, zorder=3)
        rings = joints[list(sketch.frame_legs)]
        ax.scatter(
            rings[:, 0], rings[:, 1], s=_RING, facecolors="none", edgecolors=colour, zorder=3
        )
        for j, joint in enumerate(joints):
            ax.annotate(
                f"{letter}{j + 1}", joint, (7.0, 7.0), textcoords="offset points", color=colour
            )
    for name, (origin, *arms) in panel.frames:
        at = 1e3 * origin
        for k, (arm, colour) in enumerate(zip(arms, AXIS_COLOURS, strict=True)):
            end = at + _ARM * size * arm
            if np.linalg.norm(arm) < 0.05:  # towards the viewer
                continue
            ax.annotate("", end, at, arrowprops={"arrowstyle": "->", "color": colour})
            ax.annotate(f"{name} x" if k == 0 else "xyz"[k], end, color=colour, fontsize="small")
    ax.set_aspect("equal")
    ax.margins(0.12)
    ax.set_title(panel.title, fontsize="medium")


_SIDE, _EDGE, _HEAD, _LINE = 420.0, 46.0, 44.0, 15.0  # panel, margin, title, text line [px]
_ARROW = 34.0  # length of the axis of a frame [px]
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
            tips = origin + _ARROW / scale * np.array(arms)
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
