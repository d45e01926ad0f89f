"""The report of a plan: positions, images, expected accuracy, checklist, drawings."""

from __future__ import annotations

import base64
import io
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from markupsafe import Markup

from legcal.errors import printable
from legcal.figures import new_figure, plain
from legcal.files.quantity import SHOWN_IN
from legcal.geometry.types import Array
from legcal.machine.configurations import poses_at
from legcal.machine.drawing import BASE_COLOUR, LEG_COLOUR, PLATFORM_COLOUR
from legcal.machine.model import vectors_A_to_B
from legcal.pages.document import Drawing, Items, Picture, Row
from legcal.pages.html import page_html
from legcal.planning.laid_board import LaidBoard
from legcal.planning.planned_session import Plan, views_in_words
from legcal.report.machine import scale_option
from legcal.report.page.text_page import text_page
from legcal.report.render import Report, heading, report, table

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

PLACES, GROWTH, CHECKLIST, PAGE_NAME = "places.svg", "growth.svg", "checklist.txt", "plan.html"
_CAMERA_COLOUR, _BOARD_COLOUR = "#b45309", "#15803d"
_WORST = 12  # least certain parameters shown, equally many of each unit
_PANEL = (6.0, 5.6)  # [inch]
_LEAST = 6  # smallest number of images drawn; fewer determine next to nothing
_FEW_TICKS = 5.0  # largest ratio of errors with linear ticks
_WIDTH = 9.0  # width of the picture of places [inch]
_MOST_NAMES = 4  # largest number of names in one label
_ROOM = 0.1  # margin around the drawing, relative to its width


def plan_table(plan: Plan, output: Path | None) -> Report:
    """Return the views, distances and expected accuracy of a plan, and the written folder."""
    names = plan.machine.leg_names
    views = [
        (
            view.name,
            str(len(view.poses.poses)),
            *(f"{x:.2f}" for x in view.T_base_camera.translation),
            " ".join(str(n) for n in view.shows.sum(axis=0).tolist()),
        )
        for view in plan.views
    ]
    estimated = [i for i in np.argsort(-plan.sigma, kind="stable").tolist() if plan.sigma[i] > 0.0]
    by_unit = {
        unit: [i for i in estimated if plan.units[i] == unit] for unit in sorted(set(plan.units))
    }
    of_units = [of_unit for of_unit in by_unit.values() if of_unit]
    worst = [i for of_unit in of_units for i in of_unit[: _WORST // len(of_units)]]
    parameters = [
        (
            plan.names[i],
            f"{SHOWN_IN[plan.units[i]][0] * plan.sigma[i]:.4f}",
            SHOWN_IN[plan.units[i]][1],
        )
        for i in worst
    ]
    growth = [(f"{n:.0f}", _scaled_in_words(plan, value)) for n, value in _selected_growth(plan)]
    distances = [
        (name, *(f"{1e3 * x:.0f}" for x in row)) for name, row in camera_distances(plan).items()
    ]
    legs = ", ".join(names)
    length = scale_option(plan.machine, board=plan.board is not None)
    return report(
        heading(printable(plan.machine.name), f": {views_in_words(plan.views)}"),
        table(
            "view", ">images", ">x [m]", ">y [m]", ">z [m]", f"images of {printable(legs)}",
            rows=[tuple(map(printable, row)) for row in views],
        ),
        table(
            "view", *(f">distance to A{j + 1} [mm]" for j in _measured(plan)),
            ">height above the base joints [mm]",
            rows=[tuple(map(printable, row)) for row in distances],
            title="Distances to measure, from the middle of the lens to joints of the base"
            + plan.machine.at_zero,
        ),
        table("parameter", ">sigma", "unit", rows=parameters, title="Least certain parameters"),
        table(
            ">images", ">expected", rows=growth,
            title="Expected error vs. number of images",
        ),
        [plan.sentence, *map(printable, plan.notes)],
        [] if output is None else [
            printable(f"written: {output}"),
            *([printable(f"afterwards, {_to_be_added(plan)}")] if plan.given else []),
            printable(
                f"calibrate with: legcal calibrate {plan.given or output} -o OUT{length}"
            ),
        ],
    )  # fmt: skip


def _to_be_added(plan: Plan) -> str:
    """Return the instruction for a session that adds to another one."""
    return (
        "copy the photographs, the views in dataset.yaml and the rows of "
        f"measurements.csv into {plan.given}"
    )


def _selected_growth(plan: Plan) -> list[tuple[float, float]]:
    """Return the criterion at selected numbers of images."""
    n = plan.n_images
    chosen = {
        max(n // 3, 1),
        max(2 * n // 3, 1),
        n,
        *(k for k in plan.growth[:, 0] if n < k <= 4 * n),
    }
    return [(k, value) for k, value in plan.growth.tolist() if k in chosen]


def _scaled(plan: Plan, value: float) -> tuple[float, str]:
    """Return the expected error at another value of the criterion, and its unit."""
    ratio = value / plan.value
    if plan.error is None:
        return ratio, "relative to the plan"
    return 1e3 * ratio * plan.error.mean_displacement, "mm"


def _scaled_in_words(plan: Plan, value: float) -> str:
    """Return the expected error at another value of the criterion, in words."""
    expected, unit = _scaled(plan, value)
    return f"{expected:.{3 if unit == 'mm' else 2}f} {unit}"


def _measured(plan: Plan) -> tuple[int, ...]:
    """Return the joints of the base to which distances are measured."""
    return plan.machine.frame_legs


def _measured_joints(plan: Plan) -> Array:
    """Return the measured joints in the base, motors at zero, (3, 3) [m]."""
    return np.asarray(plan.machine.A_base[list(_measured(plan))])


def camera_distances(plan: Plan) -> dict[str, list[float]]:
    """Return the distances of the lens of each view from joints of the base, and its height [m]."""
    A = _measured_joints(plan)
    distances = {}
    for view in plan.views:
        centre = view.T_base_camera.translation
        distances[view.name] = [
            *np.linalg.norm(A - centre, axis=1).tolist(),
            float(centre[2] - A[:, 2].mean()),
        ]
    return distances


def checklist(plan: Plan) -> list[str]:
    """Return the checklist for taking the photographs."""
    hand_held = plan.hand_held
    first = f"Put the file of the calibrated camera in place of camera_info.yaml: it was planned \
with {plan.camera.width} x {plan.camera.height} px and a focal length of \
{plan.camera.K[0, 0]:.0f} px."
    cm, deg = 1e2 * plan.setting.shift, np.degrees(plan.setting.turn)
    place = (
        "Take each image from about the position in poses.csv; the whole board must be in it."
        if hand_held
        else f"Set the tripod to within {float(f'{cm:.2g}'):g} cm and {deg:.3g} deg: measure the "
        "distances from the lens, then turn the camera until the picture looks as its preview."
    )
    items = [
        first,
        place,
        "Focus by hand at the middle of the legs, then leave focus, zoom and aperture; no "
        "autofocus, no stabiliser, no portrait mode.",
        "An aperture of f/8 or so: the nearest and the farthest leg must both be sharp. Look at "
        "both ends of the legs at full size.",
        "Light from two sides through paper, or an overcast window; nothing clipped, neither legs "
        "nor background.",
        "A background that differs from the legs in brightness along their whole length.",
        "A remote release or two seconds of delay; lossless files, or JPEG of quality 95.",
        "Move the machine through the poses of poses.csv in order, via the pose in the column "
        f"'on the way'. It starts at home, where motors read {_home_in_words(plan)}.",
        "Wait until it is at rest; record the encoder values, not the commands, in "
        "measurements.csv.",
        "Save each photograph under its name in measurements.csv.",
    ]
    if plan.given:
        items.append(f"Afterwards, {_to_be_added(plan)}.")
    if plan.board is not None:
        items.insert(1, _board_in_words(plan, plan.board))
    measured = plan.machine.rod_for_scale(has_length=plan.board is not None)
    if measured is not None:
        items.insert(
            1,
            f"Measure the rod of {measured[0].name} from joint centre to joint centre: readings of "
            "motors that turn carry no length. Calibrate with "
            f"{plan.machine.length_option}.",
        )
    return items


def _home_in_words(plan: Plan) -> str:
    """Return the readings of the motors at home."""
    machine = plan.machine
    readings = poses_at(machine, [machine.home_configuration]).readings[0]
    readings_in_words = []
    for j in machine.motors:
        leg = machine.legs[j]
        size, unit = SHOWN_IN[leg.reading_unit]
        readings_in_words.append(f"{leg.prismatic} {size * readings[j]:z.2f} {unit}")
    return ", ".join(readings_in_words)


def _board_in_words(plan: Plan, board: LaidBoard) -> str:
    """Return the instruction for fixing the board."""
    A = _measured_joints(plan)
    distance = 1e3 * np.linalg.norm(A - board.middle, axis=1)
    x, y, z = 1e3 * board.middle
    facing = "up" if board.normal[2] > 0.0 else "down"  # down for a hanging machine
    joints = ", ".join(
        f"{d:.0f} mm from A{j + 1}" for d, j in zip(distance, _measured(plan), strict=True)
    )
    return (
        f"Fix the board to the base, flat at the level of its joints, print {facing}, as "
        f"places.svg shows it: its middle about {joints}, at x {x:z.0f}, y {y:z.0f}, z {z:z.0f} mm "
        "in the base link. It must not move, and be whole in every image."
    )


def plan_files(plan: Plan, previews: Mapping[str, bytes], command: str) -> dict[str, str | bytes]:
    """Return the pictures, the checklist and the page of a session, by their names."""
    places, growth = _svg(_draw_places(plan)), _svg(_draw_growth(plan))
    images = [
        Picture(
            Markup(f"data:image/jpeg;base64,{base64.b64encode(data).decode()}"),
            f"{name}: as the first image should look",
        )
        for name, data in previews.items()
    ]
    blocks: list[Any] = [
        Drawing(Markup(places), "Camera places from above and from the side."),
        Drawing(Markup(growth), "Expected error vs. number of images."),
        Row(images),
        Items(checklist(plan), ordered=True, title="Checklist"),
    ]
    text = plan_table(plan, None)
    page = text_page(
        f"Plan of a session: {plan.machine.name}", text, blocks=blocks, command=command
    )
    listed = "".join(f"[ ] {item}\n" for item in checklist(plan))
    return {
        PLACES: places,
        GROWTH: growth,
        CHECKLIST: listed,
        PAGE_NAME: page_html(page),
        **{f"previews/{name}.jpg": data for name, data in previews.items()},
    }


def _draw_places(plan: Plan) -> Figure:
    """Return a figure of machine and cameras from above and from the side, with distances."""
    machine = plan.machine
    B = np.asarray(machine.home.apply(machine.B_platform))
    A = B - vectors_A_to_B(machine, machine.home)
    with new_figure(2, 1, (_WIDTH, _WIDTH)) as (figure, axes):
        for ax, (i, j), title in zip(
            axes, ((0, 1), (0, 2)), ("from above: x, y [mm]", "from the side: x, z [mm]"),
            strict=True,
        ):  # fmt: skip
            _draw_panel(ax, plan, A, B, i, j)
            ax.set_title(title, fontsize="medium")
        heights = [_WIDTH * np.ptp(ax.get_ylim()) / np.ptp(ax.get_xlim()) + 0.6 for ax in axes]
        axes[0].get_gridspec().set_height_ratios(heights)  # type: ignore[union-attr]
        figure.set_size_inches(_WIDTH, sum(heights))
    return figure


def _draw_panel(ax: Axes, plan: Plan, A: Array, B: Array, i: int, j: int) -> None:
    """Draw one panel: coordinates i and j."""
    for a, b in zip(1e3 * A, 1e3 * B, strict=True):
        ax.plot([a[i], b[i]], [a[j], b[j]], color=LEG_COLOUR, linewidth=2.0)
    for joints, colour in ((A, BASE_COLOUR), (B, PLATFORM_COLOUR)):
        ax.scatter(1e3 * joints[:, i], 1e3 * joints[:, j], s=16.0, color=colour, zorder=3)
    if plan.board is not None:
        outer = 1e3 * plan.board.corners[[0, 1, 2, 3, 0]]
        ax.plot(outer[:, i], outer[:, j], color=_BOARD_COLOUR, linewidth=1.5)
        ax.annotate("board", (outer[0, i], outer[0, j]), (3.0, 3.0), color=_BOARD_COLOUR,
                    textcoords="offset points", fontsize="small")  # fmt: skip
    for view in plan.views:
        centre = 1e3 * view.T_base_camera.translation
        sight = view.T_base_camera.rotation.as_matrix()[:, 2]
        tip = centre + 250.0 * sight
        arrow = {"arrowstyle": "->", "color": _CAMERA_COLOUR}
        ax.annotate("", (tip[i], tip[j]), (centre[i], centre[j]), arrowprops=arrow)
        ax.scatter(centre[i], centre[j], marker="s", s=40.0, color=_CAMERA_COLOUR, zorder=4)
        if (i, j) == (0, 1) and not plan.hand_held:
            _draw_distances(ax, centre, 1e3 * _measured_joints(plan))
    ax.set_aspect("equal")
    ax.margins(0.0)
    room = _ROOM * float(np.ptp(ax.get_xlim()))
    joints_of_base = [f"A{k + 1}" for k in range(len(A))]
    for n, (name, position) in enumerate(_together(joints_of_base, 1e3 * A[:, [i, j]], 0.4 * room)):
        ax.annotate(name, position, (5.0, -12.0 if n % 2 else 5.0), color=BASE_COLOUR,
                    textcoords="offset points", fontsize="small")  # fmt: skip
    lenses = 1e3 * np.array([view.T_base_camera.translation for view in plan.views])
    for n, (name, position) in enumerate(
        _together([view.name for view in plan.views], lenses[:, [i, j]], 0.2 * room)
    ):
        ax.annotate(name, position, (7.0, -16.0 if n % 2 else 7.0), color=_CAMERA_COLOUR,
                    textcoords="offset points")  # fmt: skip
    for limits, put in ((ax.get_xlim(), ax.set_xlim), (ax.get_ylim(), ax.set_ylim)):
        put(limits[0] - room, limits[1] + room)
    ax.grid(alpha=0.2)


def _together(
    names: Sequence[str], points: Array, near: float
) -> list[tuple[str, tuple[float, float]]]:
    """Return labels of points (n, 2) with their positions, one label for points near each other.

    Labels are ordered from left to right, so that they can alternate above and below.
    """
    groups: list[list[int]] = []
    for k in range(len(points)):
        near_groups = [
            g for g in groups if np.linalg.norm(points[g] - points[k], axis=1).min() < near
        ]
        groups = [g for g in groups if g not in near_groups]
        groups.append(sorted([k, *(i for g in near_groups for i in g)]))
    labels = []
    for group in groups:
        of_group = [names[k] for k in group]
        if len(group) > _MOST_NAMES:
            of_group = [of_group[0], "...", of_group[-1]]
        x, y = points[group[int(np.argmax(points[group, 0]))]].tolist()
        labels.append((plain(", ".join(of_group)), (x, y)))
    return sorted(labels, key=lambda text: text[1])


def _draw_distances(ax: Axes, lens: Array, joints: Array) -> None:
    """Draw the distances of a lens from joints (rings) from above, as text along lines [mm]."""
    ax.scatter(joints[:, 0], joints[:, 1], s=70.0, facecolors="none", edgecolors=_CAMERA_COLOUR)
    for part, joint in zip(np.linspace(0.2, 0.6, len(joints)), joints, strict=True):
        ax.plot([lens[0], joint[0]], [lens[1], joint[1]], color=_CAMERA_COLOUR,
                linewidth=0.6, linestyle=":")  # fmt: skip
        x, y = (part * lens[:2] + (1.0 - part) * joint[:2]).tolist()
        slope = np.degrees(np.arctan2(lens[1] - joint[1], lens[0] - joint[0]))
        ax.text(x, y, f"{np.linalg.norm(lens - joint):.0f}", color=_CAMERA_COLOUR,
                fontsize="x-small", ha="center", va="center", rotation_mode="anchor",
                rotation=(slope + 90.0) % 180.0 - 90.0,
                bbox={"facecolor": "white", "edgecolor": "none", "pad": 0.8})  # fmt: skip


def _draw_growth(plan: Plan) -> Figure:
    """Return a figure of the expected error over the number of images."""
    planned = plan.growth[:, 0] <= plan.n_images
    min_images = 1 if plan.given else min(_LEAST, plan.n_images)
    is_known = np.isfinite(plan.growth[:, 1]) & (plan.growth[:, 0] >= min_images)
    scale, unit = _scaled(plan, 1.0)
    quantity = "expected error of the platform" if unit == "mm" else "determinant's root"
    from matplotlib.ticker import LogLocator, MaxNLocator, NullFormatter

    with new_figure(1, 1, _PANEL) as (figure, (ax,)):
        extrapolated = is_known & (~planned | (plan.growth[:, 0] == plan.n_images))
        for chosen, style, label, above in (  # planned images in front
            (is_known & planned, "-o", "planned", 3.0),
            (extrapolated, "--o", "more of their kind", 2.0),
        ):
            n, value = plan.growth[chosen].T
            ax.loglog(n, scale * value, style, markersize=3.0, label=label, zorder=above)
        for axis in (ax.xaxis, ax.yaxis):
            axis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
            axis.set_major_formatter("{x:g}")
            axis.set_minor_formatter(NullFormatter())
        drawn = plan.growth[is_known, 1]
        if drawn.max() < _FEW_TICKS * drawn.min():
            ax.yaxis.set_major_locator(MaxNLocator(6))
        ax.set_xlabel("images")
        ax.set_ylabel(f"{quantity} [{unit}]")
        ax.grid(which="both", alpha=0.2)
        ax.legend()
    return figure


def _svg(figure: Figure) -> str:
    """Return a figure as reproducible SVG."""
    import matplotlib as mpl

    text = io.StringIO()
    with mpl.rc_context({"svg.hashsalt": "legcal", "svg.fonttype": "none"}):
        figure.savefig(text, format="svg", metadata={"Date": None, "Creator": "legcal plan"})
    svg = text.getvalue()
    return svg[svg.index("<svg") :]
