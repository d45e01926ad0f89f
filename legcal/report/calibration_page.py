"""The page of a calibration: ``report.html`` of a result folder."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from markupsafe import Markup

from legcal.calibration.joint_fit.platform import PlatformMap, platform_map
from legcal.calibration.result import Calibration
from legcal.calibration.result_folder import REPORT_NAME
from legcal.calibration.summary import (
    fit_lines,
    joints_of,
    parameter_charts,
    parameters_of,
    platform_chart,
    tables,
)
from legcal.data.measurements import row_names
from legcal.errors import LegcalError, printable
from legcal.geometry.motions import components
from legcal.geometry.types import Array, Image, IntArray
from legcal.machine.files import RESULT_YAML
from legcal.machine.loader import load_mechanism
from legcal.machine.model import Machine
from legcal.machine.parameters import geometries
from legcal.machine.rods import arms_at, ends_at_poses, measured_readings
from legcal.pages.document import (
    PAGE,
    Block,
    Charts,
    Crop,
    Drawing,
    Gallery,
    Items,
    Page,
    Row,
    Scene,
    Section,
    Text,
    data_url,
    page_html,
    time_of_page,
)
from legcal.pages.svg import Points, number_grid, scatter
from legcal.perception.overlays import curve
from legcal.report.calibration import next_steps, platform_table, verdict_of
from legcal.report.render import record_section, table
from legcal.report.scene import MachineScene
from legcal.vision.cylinder import outlines_of_axis
from legcal.vision.image_file import small_jpeg

MAX_POSES = 60  # largest number of poses of the slider
MAX_CAMERAS = 60


def write_report(
    calibration: Calibration,
    folder: str | Path,
    command: str = "",
    *,
    truth: str | Path | Machine | None = None,
    into: str | Path | None = None,
) -> Path:
    """Write ``report.html`` into the result folder of a calibration.

    Parameters
    ----------
    calibration : Calibration
        The result of :func:`legcal.calibrate`.
    folder : path
        The result folder.
    command : str
        The command of the calibration, for the record.
    truth : path, name or Machine, optional
        The true model of a simulated or measured machine: the page then states the errors of the
        nominal and the calibrated model.
    into : path, optional
        The folder with the files of the result while it is being written.

    Returns
    -------
    path
        The page.

    Raises
    ------
    UsageError
        If another file has that name.
    ModelError
        If the truth is not a model of the same machine.
    OutOfResources
        If it cannot be written.
    """
    files = Path(folder if into is None else into)
    path = files / REPORT_NAME
    PAGE.check_place(path)
    against = []
    if truth is not None:
        true = truth if isinstance(truth, Machine) else load_mechanism(truth)
        against = truth_blocks(calibration, true, load_mechanism(files / RESULT_YAML))
    PAGE.write(path, page_html(calibration_page(calibration, Path(folder), command, against)))
    return path


def calibration_page(
    calibration: Calibration,
    folder: Path,
    command: str = "",
    against: Sequence[Block] = (),
) -> Page:
    """Return the page of a calibration whose result folder this is, made by a command.

    *against* are the blocks of a section on the truth, if it is given.
    """
    result, dataset, when = calibration.result, calibration.dataset, time_of_page()
    sections: list[tuple[str, str, Sequence[Block]]] = [
        ("next", "What to do next", [Items(next_steps(calibration, str(folder), command), True)]),
        ("platform", "Platform error", platform_blocks(calibration)),
        ("truth", "Against the truth", against),
        ("parameters", "Parameters", parameter_blocks(calibration)),
        ("machine", "The machine", [machine_scene(calibration)]),
        *_outline_sections(calibration),
        ("fit", "The fit", [Items(fit_lines(result, verbose=True))]),
        ("identifiability", "Identifiability", identifiability_blocks(calibration)),
        ("notes", "Diagnosis and notes", note_blocks(calibration)),
    ]
    facts = {
        "Dataset": str(dataset.folder),
        "Start of the fit": f"{result.start}, {calibration.solution.iterations} iterations",
    }
    return Page(
        f"Calibration of {dataset.machine.name}",
        f"{dataset.folder.name}, {when}",
        verdict_of(calibration),
        [
            *(Section(*section) for section in sections if section[2]),
            record_section(command, when, facts),
        ],
    )


# Platform error


def platform_blocks(calibration: Calibration) -> list[Block]:
    """Return figures, a chart and maps of the error of the platform."""
    platform = calibration.result.platform
    if platform is None or calibration.platform is None:
        reason = calibration.dataset.machine.undetermined
        return [Text([f"No error of the platform is predicted, because {reason}."])]
    note = (
        f"The first row is at the {platform.poses} poses of the images. Both models get the same "
        "readings; errors of the readings themselves are not in sigma."
    )
    charts = [Drawing(chart.markup()) for chart in platform_chart(calibration.result)]
    blocks: list[Block] = [replace(platform_table(platform), note=note), *charts]
    workspace = platform_map(calibration.dataset.machine, calibration.solution)
    if workspace is not None:
        blocks += _maps(workspace)
    return blocks


def _maps(workspace: PlatformMap) -> list[Block]:
    """Return slices of constant z, whose colours mean the same before and after."""
    blocks: list[Block] = []
    before, after = 1e3 * workspace.change, 1e3 * workspace.sigma
    most = float(max(np.nanmax(before), np.nanmax(after)))
    for name, values in (("Before", before), ("After, 1 sigma", after)):
        digits = int(np.clip(np.ceil(1.5 - np.log10(max(np.nanmax(values), 1e-9))), 0, 5))
        x, y = (1e3 * workspace.x).tolist(), (1e3 * workspace.y).tolist()
        slices = [
            number_grid(x, y, level, f"{name} [mm], z = {1e3 * z:z.0f} mm", most, digits)
            for z, level in zip(workspace.z.tolist(), values, strict=True)
        ]
        blocks.append(Row([Drawing(chart.markup()) for chart in slices]))
    note = "Slices at the orientation of home; empty cells are out of reach."
    return [*blocks, Text([note], dim=True)]


# Against the truth


def truth_blocks(calibration: Calibration, truth: Machine, calibrated: Machine) -> list[Block]:
    """Return the errors of the nominal and the calibrated model."""
    from legcal.calibration.evaluation import evaluate

    before = evaluate(calibration.dataset.machine, truth)
    after = evaluate(calibrated, truth)
    at_platform = (
        "The motors do not determine the pose of the platform, so that its errors are not compared."
    )
    if len(after.displacement):
        by_nominal, by_calibrated = (
            f"{1e3 * evaluation.displacement.mean():.3f} mm and "
            f"{np.degrees(evaluation.rotation.mean()):.4f} deg by the"
            for evaluation in (before, after)
        )
        at_platform = (
            f"At the same readings the platform is off by {by_nominal} nominal model, and by "
            f"{by_calibrated} calibrated model (means over {len(after.displacement)} poses of the "
            "workspace, eq 20)."
        )
    origin = (
        "The truth was given for this page alone: the result was computed without it. legcal "
        "evaluate compares every parameter."
    )
    return [Text([at_platform, origin])]


# Parameters


def parameter_blocks(calibration: Calibration) -> list[Block]:
    """Return joints in the links with all other parameters, as tables and as bars."""
    result, machine = calibration.result, calibration.dataset.machine
    motors = ""
    if any(motor.turns for motor in machine.actuators):
        motors = "; axis_point: lateral displacement of the arm axis"
        if any(motor.arm is not None for motor in machine.actuators):
            motors += ", arm_point: lateral displacement of the line of the arm"
    elif machine.actuators:
        motors = "; directions of carriages too"
    note = (
        f"Joints are in the links{machine.at_zero}, as in calibrated.urdf; axes are turns from the "
        f"nominal ones{motors}. Sigma is one standard deviation; coordinates without sigma fix the "
        "frame R_b or R_e, which photographs of legs cannot determine. Click a heading to sort."
    )
    joints, parameters = list(joints_of(result)), parameters_of(result)
    others = [q for q in parameters if not (joints and q.parameter.is_joint_coordinate)]
    charts = parameter_charts([q for q in (*joints, *others) if q.parameter.kind != "radius"])
    return [
        *(shown.as_table(title) for title, shown in tables(result)),
        Text([note], dim=True),
        Row([Drawing(chart.markup()) for chart in charts]),
    ]


# The machine


def machine_scene(calibration: Calibration) -> Scene:
    """Return the machine with sliders for pose and exaggeration."""
    machine, measurements = calibration.dataset.machine, calibration.dataset.measurements
    solution, result = calibration.solution, calibration.result
    n = measurements.n_poses
    chosen = np.unique(np.linspace(0, n - 1, min(MAX_POSES, n)).astype(int))
    T = [solution.T_Rb_Re[k] for k in chosen.tolist()]
    q, by_readings = measurements.q_of_poses[chosen], calibration.platform is not None
    scene = MachineScene(machine, solution.legs, geometries(machine), result)
    calibrated = scene.placed(solution.legs, q, T, by_readings=by_readings)
    images, frame, views = row_names(measurements), machine.T_base_Rb, measurements.views
    used = [v for v, view in enumerate(views) if view.name in result.views][:MAX_CAMERAS]
    content = scene.compared(calibrated, q, T, by_readings=by_readings)
    content |= {
        "poses": [printable(images[row]) for row in measurements.first_rows[chosen].tolist()],
        "cameras": scene.cameras(
            (views[v].name, solution.cameras[v], frame * solution.T_camera_Rb[v].inv())
            for v in used
        ),
    }
    left_out = f" {len(chosen)} of {n} poses are shown." if len(chosen) < n else ""
    caption = (
        "Drag to turn, scroll to zoom. Grey is the nominal model, blue the calibrated one at the "
        "same readings; the slider exaggerates the difference. Rings are ellipsoids of one "
        "standard deviation at the joints: those that define R_b and R_e have flat ones or none."
        f"{' Brown are arms and carriages, at the readings.' * bool(machine.actuators)}{left_out}"
    )
    return Scene("machine-scene", content, 560, caption)


# Outlines


def _outline_sections(calibration: Calibration) -> list[tuple[str, str, Sequence[Block]]]:
    """Return the sections on residuals, and on the outlines with the largest and usual ones."""
    residuals, overlays = calibration.residuals, calibration.overlays
    if not len(residuals):
        return []
    order = np.argsort(-np.linalg.norm(residuals.whitened, axis=1), kind="stable")
    middle = max(N_WORST, (len(order) - N_MEDIAN) // 2)
    worst, median = order[:N_WORST], order[middle : middle + N_MEDIAN]
    crops, n = _crops(calibration, np.concatenate([worst, median]).tolist())
    rows = calibration.solution.outlines.row.tolist()
    links = {i: overlays[row] for i, row in enumerate(rows) if row in overlays}
    links |= {int(residuals.index[k]): f"#{crop.name}" for k, crop in crops.items()}
    galleries = [
        Gallery(shown, f"{title[0]}{len(shown)}{title[1]}")
        for numbers, title in (
            (worst, ("The worst ", ", by their distance in standard deviations")),
            (median, ("", " typical ones (median distance)")),
        )
        if (shown := [crops[k] for k in numbers.tolist() if k in crops])
    ]
    missing = [Text([f"{n} image{'s' * (n != 1)} could not be read any more."])] * bool(n)
    lines = (
        "Green: measured outline, red if rejected by the fit; dashed orange: predicted by the fit. "
        "Click to enlarge, scroll to zoom, drag to move."
    )
    pictures = [*missing, Text([lines], dim=True), *galleries] if galleries or missing else []
    return [
        ("residuals", "Residuals", [residual_charts(calibration, links)]),
        ("outlines", "Outlines", pictures),
    ]


# Evidence


def identifiability_blocks(calibration: Calibration) -> list[Block]:
    """Return the number of determined directions, and the least certain ones."""
    problem, result = calibration.solution.posterior.problem, calibration.result
    free = int(problem.free.sum())
    determined = free - len(calibration.solution.kinematic.held_basis)
    blocks: list[Block] = [
        Text([f"{determined} of {free} directions of the kinematic parameters are determined."])
    ]
    weak = [
        (
            row.in_words,
            f"{1e3 * row.sigma_m:.4f}",
            ", ".join(
                f"{c:+.2f} {name}"
                for name, c in zip(row.links.parameters, row.links.components, strict=True)
            ),
        )
        for row in result.weakest
    ]
    if weak:
        columns = ("least certain combination", ">1 sigma [mm]", "as a unit vector")
        blocks.append(table(*columns, rows=weak))
    return blocks


def note_blocks(calibration: Calibration) -> list[Block]:
    """Return the diagnosis, and the notes."""
    blocks: list[Block] = []
    diagnosis = [
        (d.what, "; ".join(d.same_as), f"{d.images_before}", f"{d.images_after}", d.remedy)
        for d in calibration.result.diagnosis or ()
    ]
    if diagnosis:
        columns = ("likely mistake", "indistinguishable from", ">images that agree",
                   ">with correction", "remedy")  # fmt: skip
        blocks.append(table(*columns, rows=diagnosis, title="Diagnosis"))
    in_table = {diagnosis.sentence for diagnosis in calibration.diagnosis}
    notes = [note for note in calibration.notes if note not in in_table]
    blocks += [Items(notes)] * bool(notes)
    steps = calibration.result.stages.staged
    remarks = [getattr(steps, "failure", ""), *getattr(steps, "diagnostics", ())]
    if shown := [remark for remark in remarks if remark]:
        blocks.append(Items(shown, title="The four steps alone"))
    return blocks


# Outlines: charts of residuals, and crops of the worst


N_WORST, N_MEDIAN = 30, 10
MAX_BYTES = 1_300_000  # largest total size of the pictures, so that pages stay below 9 MB
MAX_POINTS = 3000  # largest number of outlines of a chart that browsers draw quickly
_OFFSET = "outline less fit [px]"
_MARGIN = 18  # margin around an outline [px]
_ASPECT = 0.8  # smallest ratio of the shorter to the longer side
_SIDE = 360  # largest longer side of a picture [px]
_QUALITY = 78  # JPEG quality [percent]
_N_POINTS = 12  # points along a line
_SMALLER = 0.7  # factor of the side in each attempt to keep to MAX_BYTES


def _crops(calibration: Calibration, numbers: Sequence[int]) -> tuple[dict[int, Crop], int]:
    """Return pieces of images with the outlines of some residuals, by the numbers of these.

    Also return how many of the images could not be read any more.
    """
    residuals, outlines = calibration.residuals, calibration.solution.outlines
    dataset, missing = calibration.dataset, 0
    reader = dataset.image_reader(range(dataset.measurements.n_rows))
    wanted: dict[int, list[int]] = {}
    for k in numbers:
        wanted.setdefault(int(outlines.row[residuals.index[k]]), []).append(k)
    pieces: dict[int, tuple[Image, Array]] = {}
    for row, of_row in wanted.items():
        if dataset.image_path(row) is None:
            continue
        try:
            image = reader.levels(row)
        except LegcalError:
            missing += 1
            continue
        pieces |= {k: _cut(image, outlines.ends[residuals.index[k]]) for k in of_row}
    side, jpegs = float(_SIDE), dict[int, Markup]()
    while pieces and (not jpegs or sum(map(len, jpegs.values())) > MAX_BYTES):
        jpegs = {
            k: data_url(small_jpeg(grey, int(side), _QUALITY)) for k, (grey, _) in pieces.items()
        }
        side *= _SMALLER
    return {k: _crop(calibration, k, *pieces[k], jpegs[k]) for k in pieces}, missing


def _cut(image: Image, ends: Array) -> tuple[Image, Array]:
    """Return the piece of an image around an outline, and the place of its first pixel."""
    middle, half = ends.mean(axis=0), 0.5 * np.ptp(ends, axis=0) + _MARGIN
    half = np.maximum(half, _ASPECT * half.max())
    low, high = np.floor(middle - half).astype(int), np.ceil(middle + half).astype(int) + 1
    height, width = image.shape
    left, top = corner = np.clip(low, 0, [width - 1, height - 1])
    right, bottom = np.clip(high, corner + 1, [width, height])
    return image[top:bottom, left:right].astype(np.float32), corner


def _crop(calibration: Calibration, k: int, grey: Image, corner: Array, picture: Markup) -> Crop:
    """Return a piece of an image with the lines and the caption of residual k."""
    residuals, outlines = calibration.residuals, calibration.solution.outlines
    dataset, solution = calibration.dataset, calibration.solution
    i, measurements = int(residuals.index[k]), dataset.measurements
    row, j = int(outlines.row[i]), int(outlines.leg[i])
    v, pose = int(measurements.view[row]), int(measurements.pose[row])
    leg, part = solution.legs[j], outlines.part[i]
    R, t = components([solution.T_Rb_Re[pose]])
    q = measured_readings(solution.legs, R, t, measurements.q_of_poses[pose : pose + 1])
    if leg.is_arm(part):
        ends = arms_at(solution.legs, q)[j][0]
    else:
        ends = np.stack([of_legs[0, j] for of_legs in ends_at_poses(solution.legs, R, t, q)])
    A, B = solution.T_camera_Rb[v].apply(ends)
    u = (B - A) / np.linalg.norm(B - A)
    fit = outlines_of_axis(u, A, solution.radii[j, part])[int(outlines.edge[i]) - 1]
    given = measurements.views[v].camera
    origin = corner - 0.5  # pixel (0, 0) is the centre of the first one
    used, ends_px = bool(outlines.used[i]), outlines.ends[i]
    measured = curve(given, outlines.h[i], given.undistort(ends_px), _N_POINTS)
    predicted = curve(solution.cameras[v], fit, solution.cameras[v].undistort(ends_px), _N_POINTS)
    lines = [
        ("measured" if used else "rejected", _points(measured - origin)),
        ("predicted", _points(predicted - origin)),
    ]
    offset, sigmas = residuals.offset[k], float(np.linalg.norm(residuals.whitened[k]))
    name = dataset.machine.leg_names[j]
    rejected = "" if used else f"; rejected: {outlines.reason[i]}"
    return Crop(
        name=f"outline-{i}",
        picture=picture,
        width=grey.shape[1],
        height=grey.shape[0],
        lines=lines,
        caption=f"{name}, edge {outlines.edge[i]}: {offset[0]:+.3f} and {offset[1]:+.3f} px",
        detail=f"{sigmas:.1f} sigma, {row_names(measurements)[row]}{rejected}",
        link=calibration.overlays.get(row, ""),
    )


def _points(pixels: Array) -> str:
    return " ".join(f"{x:.2f},{y:.2f}" for x, y in pixels.tolist())


def chosen_points(size: Array) -> IntArray:
    """Return the indices of drawn points: the largest, and a regular sample of the others."""
    n = len(size)
    if n <= MAX_POINTS:
        return np.arange(n)
    order = np.argsort(-size, kind="stable")
    worst, others = order[: MAX_POINTS // 2], order[MAX_POINTS // 2 :]
    spread = others[np.linspace(0, len(others) - 1, MAX_POINTS // 2).astype(np.intp)]
    return np.sort(np.concatenate([worst, spread]))


def residual_charts(calibration: Calibration, links: dict[int, str]) -> Charts:
    """Return the charts; *links* are the targets of clicks on outlines, by row of the table."""
    residuals, outlines = calibration.residuals, calibration.solution.outlines
    measurements, legs = calibration.dataset.measurements, calibration.dataset.machine.leg_names
    keep = chosen_points(np.abs(residuals.offset).max(axis=1))
    index = residuals.index[keep]
    offset, row, leg = residuals.offset[keep], outlines.row[index], outlines.leg[index]
    views, images = measurements.view_names, row_names(measurements)
    both_ends = np.repeat(np.arange(len(index)), 2)
    number, leg_of_end = index[both_ends], leg[both_ends]
    jitter = np.random.default_rng(0).uniform(-0.3, 0.3, len(both_ends))
    charts = []
    for title, x, label, words in (
        ("By view", measurements.view[row][both_ends] + jitter, "view", views),
        ("By leg", leg_of_end + jitter, "leg", legs),
        ("By image", row[both_ends] + 1.0, "image, in the order of the table", ()),
    ):  # fmt: skip
        groups = [
            Points(x[of_leg], offset.ravel()[of_leg], number[of_leg], j)
            for j in np.unique(leg_of_end).tolist()
            for of_leg in [leg_of_end == j]
        ]
        svg = scatter(f"Residuals: {title}", groups, label, _OFFSET, words=words)
        charts.append(Drawing(svg.markup(), title=title))
    labels = {
        i: f"{printable(legs[j])} {printable(outlines.part[i])}, edge {edge}: "
        f"{a:+.3f} and {b:+.3f} px\n{printable(images[r])}"
        for i, j, edge, (a, b), r in zip(
            index.tolist(), leg.tolist(), outlines.edge[index].tolist(), offset.tolist(),
            row.tolist(), strict=True,
        )
    }  # fmt: skip
    return Charts(charts, labels, {i: links[i] for i in labels if i in links})
