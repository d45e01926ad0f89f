"""The page of a calibration: ``report.html`` of a result folder."""

from __future__ import annotations

import platform as system
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from legcal.calibration.evaluation import Evaluation, evaluate
from legcal.calibration.result import Calibration
from legcal.calibration.result_folder import REPORT_NAME
from legcal.calibration.summary import (
    brief_sentences,
    fit_lines,
    joints_of,
    parameter_charts,
    parameters_of,
    platform_chart,
    tables,
)
from legcal.calibration.workspace_errors import PlatformMap, platform_map
from legcal.data.measurements import row_names
from legcal.errors import printable
from legcal.files.quantity import SHOWN_IN
from legcal.geometry.types import Array
from legcal.machine.files import RESULT_YAML
from legcal.machine.loader import load_mechanism
from legcal.machine.model import Machine
from legcal.machine.parameters import geometries
from legcal.pages.document import (
    PAGE,
    Cell,
    Drawing,
    Facts,
    Gallery,
    Items,
    Light,
    Page,
    Row,
    Scene,
    Section,
    Table,
    Text,
    Verdict,
    number,
    page_html,
    time_of_page,
)
from legcal.pages.svg import Bars, log_bars, number_grid
from legcal.report.calibration import next_steps, platform_table
from legcal.report.residuals import outline_crops, residual_charts
from legcal.scene.motions import MachineScene, PlacedModel, pyramid, scene_content
from legcal.version import __version__

MAX_POSES = 60  # largest number of poses of the slider
MAX_CAMERAS = 60
_DEPTH = 0.25  # depth of the pyramid of a camera, relative to the machine
_WORDS: dict[Light, str] = {
    "good": "Use it",
    "doubtful": "Do not trust it yet",
    "bad": "Do not load it into the controller",
}


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
        The true model of a simulated or measured machine: the page then shows the errors of the
        nominal and the calibrated model, as Fig. 4 of the paper.
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
    against: Sequence[Any] = (),
) -> Page:
    """Return the page of a calibration whose result folder this is, made by a command.

    *against* are the blocks of a section on the truth, if it is given.
    """
    machine = calibration.dataset.machine
    when = time_of_page()
    sections = (
        ("next", "What to do next", [Items(next_steps(calibration, str(folder), command), True)]),
        ("platform", "Platform error", platform_blocks(calibration)),
        ("truth", "Against the truth", against),
        ("parameters", "Parameters", parameter_blocks(calibration)),
        ("machine", "The machine", [machine_scene(calibration)]),
        *_outline_sections(calibration),
        ("fit", "The fit", [Items(fit_lines(calibration.result, verbose=True))]),
        ("identifiability", "Identifiability", identifiability_blocks(calibration)),
        ("notes", "Diagnosis and notes", note_blocks(calibration)),
        ("record", "Reproducibility", reproducibility_blocks(calibration, command, when)),
    )
    return Page(
        f"Calibration of {machine.name}",
        f"{calibration.dataset.folder.name}, {when}",
        verdict_of(calibration),
        [Section(*section) for section in sections if section[2]],
    )


# Verdict and next steps


def verdict_of(calibration: Calibration) -> Verdict:
    """Return the verdict: green, amber where something speaks against it, or red."""
    verdict = calibration.verdict
    light: Light = "good"
    if not verdict.trustworthy:
        light = "bad" if verdict.is_to_be_refused else "doubtful"
    reasons = brief_sentences(calibration.result)
    return Verdict(light, _WORDS[light], verdict.sentence, reasons)


# Platform error


def platform_blocks(calibration: Calibration) -> list[Any]:
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
    blocks: list[Any] = [replace(platform_table(platform), note=note), *charts]
    workspace = platform_map(calibration)
    if workspace is not None:
        blocks += _maps(workspace)
    return blocks


def _maps(workspace: PlatformMap) -> list[Any]:
    """Return slices of constant z, whose colours mean the same before and after."""
    blocks: list[Any] = []
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


def truth_blocks(calibration: Calibration, truth: Machine, calibrated: Machine) -> list[Any]:
    """Return the errors of the nominal and the calibrated model.

    Raises
    ------
    ModelError
        If the truth is not a model of the same machine.
    DidNotConverge
        If the models reach no readings together.
    """
    before = evaluate(calibration.dataset.machine, truth)
    after = evaluate(calibrated, truth)
    sigma = {row.name: row.sigma for row in calibration.result.parameters}
    blocks: list[Any] = [Text([_at_the_platform(before, after), _ORIGIN])]
    for unit_of_chart in ("m", "rad"):
        # Coordinates that the frame makes zero are not parameters.
        indices = [
            i
            for i, name in enumerate(after.names)
            if after.units[i] == unit_of_chart and name in sigma
        ]
        if not indices:
            continue
        scale, unit = SHOWN_IN[unit_of_chart]
        before_errors, after_errors = (
            (scale * np.abs(evaluation.values - evaluation.references))[indices].tolist()
            for evaluation in (before, after)
        )
        names = [after.names[i] for i in indices]
        chart = log_bars(
            "Distance from the truth",
            unit,
            names,
            Bars("nominal", before_errors),
            Bars("calibrated", after_errors),
            Bars("its sigma as predicted", [scale * (sigma[name] or 0.0) for name in names]),
        )
        blocks.append(Drawing(chart.markup(), _CAPTION))
    return blocks


_ORIGIN = "The truth was given for this page alone: the result was computed without it."
_CAPTION = (
    "As Fig. 4 of the paper, of this calibration alone: coordinates are those in R_b and R_e."
)


def _at_the_platform(before: Evaluation, after: Evaluation) -> str:
    """Return the errors of eq (20) as a sentence."""
    if not len(after.displacement):
        return (
            "The motors do not determine the pose of the platform: parameters are compared alone."
        )
    errors = [
        f"{1e3 * evaluation.displacement.mean():.3f} mm and "
        f"{np.degrees(evaluation.rotation.mean()):.4f} deg by the {name} model"
        for name, evaluation in (("nominal", before), ("calibrated", after))
    ]
    return (
        f"At the same readings the platform is off by {errors[0]}, and by {errors[1]} (means over "
        f"{len(after.displacement)} poses of the workspace, eq 20)."
    )


# Parameters


def parameter_blocks(calibration: Calibration) -> list[Any]:
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
        *(table.as_table(title) for title, table in tables(result)),
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
    nominal, parameters = geometries(machine), solution.kinematic.parametrization
    scene = MachineScene(machine, solution.legs, nominal, result, parameters)

    def placed(legs: Any) -> PlacedModel:
        return scene.placed(legs, q, T, by_readings=by_readings)

    calibrated = placed(solution.legs)
    pairs = [("change by the calibration", ("nominal", "calibrated"),
              placed(nominal), calibrated)]  # fmt: skip
    pairs += [
        (words, ("calibrated", "moved along the direction"), calibrated, placed(scene.moved(k)))
        for k, (words, _) in enumerate(scene.directions)
    ]
    images = row_names(measurements)
    platform = [machine.T_base_Rb * pose * machine.T_platform_Re.inv() for pose in T]
    content = scene_content(scene, pairs, np.array([pose.as_matrix() for pose in platform]))
    content |= {
        "poses": [printable(images[row]) for row in measurements.first_rows[chosen].tolist()],
        "cameras": _cameras(calibration, _DEPTH * scene.size),
    }
    left_out = f" {len(chosen)} of {n} poses are shown." if len(chosen) < n else ""
    caption = (
        "Drag to turn, scroll to zoom. Grey is the nominal model, blue the calibrated one at the "
        "same readings, or grey the calibrated one and blue where a direction would move it; the "
        "slider exaggerates the difference. Rings are ellipsoids of one "
        "standard deviation at the joints: those that define R_b and R_e have flat ones or none."
        f"{' Brown are arms and carriages, at the readings.' * bool(machine.actuators)}{left_out}"
    )
    return Scene("machine-scene", content, 560, caption)


def _cameras(calibration: Calibration, depth: float) -> list[dict[str, Any]]:
    """Return the cameras of used views as pyramids of their field of view."""
    solution, views = calibration.solution, calibration.dataset.measurements.views
    frame, used_views = calibration.dataset.machine.T_base_Rb, calibration.result.views
    used = [v for v, view in enumerate(views) if view.name in used_views][:MAX_CAMERAS]
    return [
        {
            "name": printable(views[v].name),
            "points": _rounded(
                pyramid(solution.cameras[v], frame * solution.T_camera_Rb[v].inv(), depth), 4
            ),
        }
        for v in used
    ]


def _rounded(values: Array, digits: int) -> Any:
    return np.round(values, digits).tolist()


# Outlines


def _outline_sections(calibration: Calibration) -> list[tuple[str, str, Sequence[Any]]]:
    """Return the sections on residuals and on the outlines with the largest ones."""
    if not len(calibration.residuals):
        return []
    crops = outline_crops(calibration, calibration.overlays)
    n = len(crops.missing)
    missing = [Text([f"{n} image{'s' * (n != 1)} could not be read any more."])] if n else []
    lines = Text(
        [
            "Green: measured outline, red if rejected by the fit; dashed orange: predicted by the "
            "fit. Click to enlarge, scroll to zoom, drag to move."
        ],
        dim=True,
    )
    galleries = [
        Gallery(gallery, title)
        for gallery, title in (
            (
                crops.worst,
                f"The worst {len(crops.worst)}, by their distance in standard deviations",
            ),
            (crops.median, f"{len(crops.median)} typical ones (median distance)"),
        )
        if gallery
    ]
    sections: list[tuple[str, str, Sequence[Any]]] = [
        ("residuals", "Residuals", [residual_charts(calibration, crops.links)])
    ]
    if galleries or missing:
        sections.append(("outlines", "Outlines", [*missing, lines, *galleries]))
    return sections


# Evidence


def identifiability_blocks(calibration: Calibration) -> list[Any]:
    """Return counts, and the least certain directions."""
    problem, result = calibration.solution.posterior.problem, calibration.result
    free = int(problem.free.sum())
    n_held = len(calibration.solution.kinematic.held_basis)
    counts = {
        "Equations": f"{problem.n_equations}: "
        + ", ".join(
            f"{f.n * f.n_rows} of {f.name.replace('_', ' ')}" for f in problem.factors if f.n
        ),
        "Priors": str(len(problem.priors.mean)),
        "Unknowns": f"{problem.n_unknowns}: "
        + ", ".join(
            f"{block.n_unknowns} of {block.name.replace('_', ' ')}"
            for block in problem.variables
            if block.n_unknowns
        )
        + f", and {problem.n_elements} platform poses",
        "Kinematic parameters": f"{free - n_held} of {free} directions determined",
        "Degrees of freedom": f"{result.residuals.dof}, chi2 {result.residuals.chi2:.1f}",
    }
    blocks: list[Any] = [Facts(counts)]
    weak: list[list[Cell]] = [
        [
            row.in_words,
            number(1e3 * row.sigma_m, 4),
            _parts(components.parameters, components.components),
        ]
        for row in result.weakest
        for components in (row.links,)
    ]
    if weak:
        columns = ("least certain combination", ">1 sigma [mm]", "as a unit vector")
        note = "Select one under Show in the machine above to see it as a motion."
        blocks.append(Table(columns, weak, note=note))
    return blocks


def _parts(names: Any, components: Any) -> str:
    return ", ".join(f"{c:+.2f} {name}" for name, c in zip(names, components, strict=True))


def note_blocks(calibration: Calibration) -> list[Any]:
    """Return the diagnosis, and the notes."""
    blocks: list[Any] = []
    diagnosis: list[list[Cell]] = [
        [d.what, "; ".join(d.same_as), number(d.images_before, 0), number(d.images_after, 0),
         d.remedy]
        for d in calibration.result.diagnosis or ()
    ]  # fmt: skip
    if diagnosis:
        columns = ("likely mistake", "indistinguishable from", ">images that agree",
                   ">with correction", "remedy")  # fmt: skip
        blocks.append(Table(columns, diagnosis, "Diagnosis"))
    in_table = {diagnosis.sentence for diagnosis in calibration.diagnosis}
    notes = [note for note in calibration.notes if note not in in_table]
    blocks += [Items(notes)] * bool(notes)
    steps = calibration.result.stages.staged
    remarks = [getattr(steps, "failure", ""), *getattr(steps, "diagnostics", ())]
    if any(remarks):
        remarks_of_steps = [remark for remark in remarks if remark]
        blocks.append(Items(remarks_of_steps, title="The four steps alone"))
    return blocks


def reproducibility_blocks(calibration: Calibration, command: str, when: str) -> list[Any]:
    """Return version, command, and where the fit started."""
    facts = {
        "Version": f"legcal {__version__}, Python {system.python_version()}, {system.machine()}",
        "Command": command or "from Python",
        "Time": when,
        "Dataset": str(calibration.dataset.folder),
        "Start of the fit": f"{calibration.result.start}, {calibration.solution.iterations} "
        "iterations",
    }
    return [Facts(facts)]
