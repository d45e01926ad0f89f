"""The report of a plan: positions, images, expected accuracy, checklist, drawings."""

from __future__ import annotations

import shlex
from collections.abc import Mapping
from pathlib import Path

import numpy as np

from legcal.files.quantity import SHOWN_IN
from legcal.geometry.types import Array
from legcal.machine.model import readings_at
from legcal.machine.picture import Mark, draw_machine
from legcal.pages.document import Block, Drawing, Items, Picture, Row, data_url, page_html
from legcal.pages.svg import Canvas
from legcal.planning.places import LaidBoard
from legcal.planning.session import Plan, poses_to_take, settings_in_words
from legcal.report.machine import scale_option
from legcal.report.render import Report, heading, report, table, text_page
from legcal.report.scene import pyramid

PLACES, CHECKLIST, PAGE_NAME = "places.svg", "checklist.txt", "plan.html"
_CAMERA_COLOUR, _BOARD_COLOUR = "#b45309", "#15803d"
_WORST = 12  # least certain parameters shown, equally many of each unit
_SIDE = 560.0  # width of a picture of camera places [px]
_DEPTH = 0.1  # depth of the pyramid of a camera, relative to its distance from the machine


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
    growth = _growth(plan)
    A, distances = _measured_joints(plan), []
    for view in plan.views:
        centre = view.T_base_camera.translation
        lengths = [*np.linalg.norm(A - centre, axis=1), centre[2] - A[:, 2].mean()]
        distances.append((view.name, *(f"{1e3 * x:.0f}" for x in lengths)))
    legs = ", ".join(names)
    option = (
        scale_option(plan.machine, board=plan.board is not None)
        if plan.only is None  # tolerances of the lengths are the scale then
        else f" --only {plan.only}"
    )
    return report(
        [
            heading(
                plan.machine.name,
                f": {plan.n_images} photographs from {len(views)} place{'s' * (len(views) != 1)}",
            ),
            plan.sentence,
        ],
        table(
            "view", ">images", ">x [m]", ">y [m]", ">z [m]", f"images of {legs}",
            rows=views,
        ),
        table(
            "view", *(f">distance to A{j + 1} [mm]" for j in plan.machine.frame_legs),
            ">height above the base joints [mm]",
            rows=distances,
            title="Distances to measure, from the middle of the lens to joints of the base"
            + plan.machine.at_zero,
        ),
        table("parameter", ">sigma", "unit", rows=parameters, title="Least certain parameters"),
        table(
            ">images", ">expected", rows=growth,
            title="Expected error vs. number of images",
        ),
        plan.notes,
        [] if output is None else [
            f"written: {output}",
            *([f"afterwards, {_to_be_added(plan)}"] if plan.given else []),
            "photograph it, and calibrate:",
            f"  legcal shoot {shlex.quote(str(output))} --watch FOLDER",
            f"  legcal calibrate {shlex.quote(str(plan.given or output))} -o OUT{option}",
        ],
    )  # fmt: skip


def _to_be_added(plan: Plan) -> str:
    """Return the instruction for a session that adds to another one."""
    return (
        "copy the photographs, the views in dataset.yaml and the rows of "
        f"measurements.csv into {plan.given}"
    )


def _growth(plan: Plan) -> list[tuple[str, str]]:
    """Return the expected error at selected numbers of images."""
    n, rows = plan.n_images, list[tuple[str, str]]()
    for k, value in plan.growth.tolist():
        if k in (max(n // 3, 1), max(2 * n // 3, 1), n) or n < k <= 4 * n:
            ratio, words = value / plan.value, "{:.2f} relative to the plan"
            if plan.only not in (None, "all"):
                words += ", with all parameters"
            elif plan.error is not None:
                ratio, words = 1e3 * ratio * plan.error.mean_displacement, "{:.3f} mm"
            rows.append((f"{k:.0f}", words.format(ratio)))
    return rows


def _measured_joints(plan: Plan) -> Array:
    """Return the joints to which distances are measured, motors at zero, (3, 3) [m]."""
    return np.asarray(plan.machine.A_base[list(plan.machine.frame_legs)])


def checklist(plan: Plan) -> list[str]:
    """Return the checklist for taking the photographs."""
    machine, hand_held = plan.machine, plan.hand_held
    first = (
        f"The plan is for the camera of camera_info.yaml, {plan.camera.width} x "
        f"{plan.camera.height} px with a focal length of {plan.camera.K[0, 0]:.0f} px: if yours is "
        "another, plan again with --camera."
    )
    cm, deg = 1e2 * plan.setting.shift, np.degrees(plan.setting.turn)
    home = settings_in_words(machine, readings_at(machine, machine.home), digits=2)
    place = (
        "Take each image from about the position in poses.csv; the whole board must be in it."
        if hand_held
        else f"Set the tripod to within {float(f'{cm:.2g}'):g} cm and {deg:.3g} deg: measure the "
        "distances from the lens, then turn the camera until the picture looks as its preview."
    )
    by_way = ", via the pose in the column 'on the way'" if plan.has_ways else ""
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
        f"Move the machine through the poses of poses.csv in order{by_way}. It starts at home, "
        f"where motors read {', '.join(home)}.",
        "Wait until it is at rest; record the encoder values, not the commands, in "
        "measurements.csv.",
        "Save each photograph under its name in measurements.csv.",
    ]
    if plan.given:
        items.append(f"Afterwards, {_to_be_added(plan)}.")
    if plan.board is not None:
        items.insert(1, _board_in_words(plan, plan.board))
    measured = machine.rod_for_scale(has_length=plan.board is not None)
    if measured is not None and plan.only is None:
        items.insert(
            1,
            f"Measure the rod of {measured[0].name} from joint centre to joint centre: readings of "
            "motors that turn carry no length. Calibrate with "
            f"{machine.length_option}.",
        )
    return items


def _board_in_words(plan: Plan, board: LaidBoard) -> str:
    """Return the instruction for fixing the board."""
    A = _measured_joints(plan)
    distance = 1e3 * np.linalg.norm(A - board.middle, axis=1)
    x, y, z = 1e3 * board.middle
    facing = "up" if board.normal[2] > 0.0 else "down"  # down for a hanging machine
    joints = ", ".join(
        f"{d:.0f} mm from A{j + 1}" for d, j in zip(distance, plan.machine.frame_legs, strict=True)
    )
    return (
        f"Fix the board to the base, flat at the level of its joints, print {facing}, as "
        f"places.svg shows it: its middle about {joints}, at x {x:z.0f}, y {y:z.0f}, z {z:z.0f} mm "
        "in the base link. It must not move, and be whole in every image."
    )


def plan_files(plan: Plan, previews: Mapping[str, bytes], command: str) -> dict[str, str | bytes]:
    """Return the pictures, the checklist and the page of a session, by their names."""
    places, in_page = (_draw_places(plan, in_page=x).markup() for x in (False, True))
    images = [
        Picture(data_url(data), f"{name}: as the first image should look")
        for name, data in previews.items()
    ]
    header, rows = poses_to_take(plan)
    first_motor = 4
    settings = [0, 1, *range(first_motor, first_motor + len(plan.machine.motors))]  # view, pose
    if plan.has_ways:
        settings.insert(2, 3)
    poses = table(
        *(f"{'>' * (i >= first_motor)}{header[i]}" for i in settings),
        rows=[[row[i] for i in settings] for row in rows],
        title="Poses to take, in this order",
    )
    blocks: list[Block] = [
        poses,
        Drawing(in_page, "Camera places from above and from the side."),
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
        CHECKLIST: listed,
        PAGE_NAME: page_html(page),
        **{f"previews/{name}.jpg": data for name, data in previews.items()},
    }


def _draw_places(plan: Plan, *, in_page: bool) -> Canvas:
    """Draw machine, cameras and board, with the distances to measure [mm]."""
    machine, marks = plan.machine, list[Mark]()
    if plan.board is not None:
        outer = plan.board.corners[[0, 1, 2, 3, 0]]
        marks.append(Mark(outer, _BOARD_COLOUR, "board"))
    for view in plan.views:
        T = view.T_base_camera
        away = float(np.linalg.norm(T.translation - machine.home.translation))
        eye, *rim = pyramid(plan.camera, T, _DEPTH * away)
        outline = np.array([eye, *(p for corner in rim for p in (corner, eye)), *rim, rim[0]])
        marks.append(Mark(outline, _CAMERA_COLOUR, view.name))
        for part, joint in zip((0.4, 0.55, 0.7), _measured_joints(plan), strict=False):
            if not plan.hand_held:
                line = np.array([eye, eye + part * (joint - eye), joint])
                distance = f"{1e3 * np.linalg.norm(joint - eye):.0f}"
                marks.append(Mark(line, _CAMERA_COLOUR, distance, 1, 0.5, only_plan=True))
    title = "at home, with the cameras; distances in mm"
    return draw_machine(machine, in_page=in_page, marks=marks, title=title, side=_SIDE)
