"""The content of pictures of a machine: at home from above and from the side, motors as lines."""

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
