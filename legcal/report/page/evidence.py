"""Evidence for a calibration: counts, ranks, correlations, held-out images, notes, inputs."""

from __future__ import annotations

import hashlib
import os
import platform as system
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

from legcal.calibration.identify.identifiability import ranks_of_dataset
from legcal.calibration.notes import Topic, topic_of
from legcal.calibration.quantities import DIGITS, mm_deg
from legcal.calibration.result import Calibration
from legcal.data.dataset import OBSERVATIONS_NAME, Dataset
from legcal.errors import LegcalError
from legcal.files.quantity import SHOWN_IN
from legcal.pages.document import Cell, Drawing, Facts, Items, Table, Text, number
from legcal.pages.svg import matrix
from legcal.report.identify import CONDITIONS
from legcal.report.page.parameter_rows import correlation
from legcal.version import __version__

MAX_HASHED = 400_000_000  # largest total size of hashed images [bytes]; more would take long


def identifiability_blocks(calibration: Calibration) -> list[Any]:
    """Return counts, ranks, and the least certain directions."""
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
    try:
        conditions, full = ranks_of_dataset(calibration.dataset, problem.choices)
    except LegcalError:
        conditions = ()
    if conditions:
        rows: list[list[Cell]] = [
            [
                CONDITIONS[c.name],
                number(c.equations, 0),
                number(c.unknowns, 0),
                "holds" if c.ok else "fails" if c.needed else "fails, not needed with the board",
            ]
            for c in conditions
        ]
        enough = "" if full.complete else "not enough"
        ranks: list[list[Cell]] = [[number(full.rank, 0), number(full.of, 0), enough]]
        blocks += [
            Table(("condition of the paper", ">equations", ">unknowns", ""), rows),
            Table((">predicted rank", ">of", ""), ranks),
        ]
    weak: list[list[Cell]] = [
        [
            row.in_words,
            number(1e3 * row.sigma_m, 4),
            _parts(components.parameters, components.components),
        ]
        for row in result.weakest
        for components in (row.links or row,)
    ]
    if weak:
        columns = ("least certain combination", ">1 sigma [mm]", "as a unit vector")
        note = "Select one under Show in the machine above to see it as a motion."
        blocks.append(Table(columns, weak, note=note))
    if result.held:
        blocks.append(Items(result.held, title="Held at nominal, without effect on the platform"))
    return blocks


def _parts(names: Any, components: Any) -> str:
    return ", ".join(f"{c:+.2f} {name}" for name, c in zip(names, components, strict=True))


def correlation_blocks(calibration: Calibration) -> list[Any]:
    """Return the correlation matrix and the most correlated pairs."""
    names, values = correlation(calibration)
    if len(names) < 2:
        return []
    above = np.triu(np.abs(values), 1)
    order = np.argsort(-above, axis=None, kind="stable")[:10]
    pairs = [divmod(int(k), len(names)) for k in order if above.flat[k] > 0.0]
    rows: list[list[Cell]] = [
        [names[i], names[j], number(float(values[i, j]), 3, signed=True)] for i, j in pairs
    ]
    caption = "Filled squares are positive correlations, outlines negative; the area is the size."
    return [
        Drawing(matrix(names, values, "Correlations of the estimated parameters"), caption),
        Table(("most correlated", "with", ">correlation"), rows),
    ]


def held_out_blocks(calibration: Calibration) -> list[Any]:
    """Return the prediction errors in held-out images."""
    holdout = calibration.result.holdout
    if holdout is None:
        return [Text(["No held-out images (use --holdout 0.2)."], dim=True)]
    if holdout.rms_px is None:
        return [Text(["The held-out images show no outline that could be compared."])]
    facts = {
        "Held out": f"{holdout.images} images of {holdout.poses} poses, {holdout.outlines} "
        f"outlines, {holdout.wrong} of them far off and left out",
        "Prediction error": f"{holdout.rms_px:.3f} px (rms); {holdout.expected_px or 0.0:.3f} px "
        "were expected",
    }
    if holdout.platform is not None:
        pair = holdout.platform
        facts["At the platform"] = (
            f"{mm_deg(pair.dX_m, pair.dE_rad)} (rms over {pair.poses} poses); "
            f"{mm_deg(pair.expected_dX_m, pair.expected_dE_rad)} were expected"
        )
    rows: list[list[Cell]] = [[name, number(rms, 3)] for name, rms in holdout.views.items()]
    return [Facts(facts), Table(("view", ">rms [px]"), rows)]


def note_blocks(calibration: Calibration) -> list[Any]:
    """Return the diagnosis, and the notes by topic."""
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
    for topic in Topic:
        if topic is Topic.DIAGNOSIS:
            continue  # as a table
        notes = [note for note in calibration.notes if topic_of(note) is topic]
        blocks += [Items(notes, title=topic)] * bool(notes)
    steps = calibration.result.stages.staged
    remarks = [getattr(steps, "failure", ""), *getattr(steps, "diagnostics", ())]
    if any(remarks):
        remarks_of_steps = [remark for remark in remarks if remark]
        blocks.append(Items(remarks_of_steps, title="The four steps alone"))
    return blocks


def reproducibility_blocks(calibration: Calibration, command: str, when: str) -> list[Any]:
    """Return version, command, settings, and the hashes of all input files."""
    dataset, problem = calibration.dataset, calibration.solution.posterior.problem
    settings = {name.replace("_", " "): f"{v:g}" for name, v in asdict(problem.settings).items()}
    facts = {
        "Version": f"legcal {__version__}, Python {system.python_version()}, {system.machine()}",
        "Command": command or "from Python",
        "Time": when,
        "Dataset": str(dataset.folder),
        "Encoder sigma": _encoder_sigma(dataset),
        "Start of the fit": f"{calibration.result.start}, {calibration.solution.iterations} "
        "iterations",
        "Chosen parameters": _chosen(calibration) or "none",
        "Least common-mode biases": ", ".join(
            f"{name} {px:.3g} px" for name, px in sorted(problem.choices.least_shared_px.items())
        )
        or "none",
        "Settings of the fit": ", ".join(f"{name} {value}" for name, value in settings.items()),
    }
    rows, note = _hashes(calibration)
    columns = ("file", ">bytes", "SHA-256")
    return [Facts(facts), Table(columns, rows, "Input files", note, folded=True)]


def _encoder_sigma(dataset: Dataset) -> str:
    """Return the standard deviation of readings, by motor if they differ."""
    machine = dataset.machine
    sigma = dataset.measurements.sigma_of(machine.legs)
    sigma_in_words = {
        str(machine.legs[j].prismatic): f"{np.degrees(sigma[j]):.3g} deg"
        if machine.legs[j].reads_angle
        else f"{1e6 * sigma[j]:g} um"
        for j in machine.motors
    }
    distinct = set(sigma_in_words.values())
    if len(distinct) < 2:
        return next(iter(distinct), "no encoder")
    return ", ".join(f"{name} {words}" for name, words in sigma_in_words.items())


def _chosen(calibration: Calibration) -> str:
    """Return the parameters that were fixed, freed or given a prior by choice."""
    choices = calibration.solution.posterior.problem.choices
    units = {row.name: row.unit for row in calibration.result.parameters}

    def shown(name: str, *values: float) -> str:
        scale, unit = SHOWN_IN[units.get(name, "")]
        return (
            " +- ".join(f"{scale * value:.{DIGITS[unit]}f}" for value in values)
            + f" {unit}".rstrip()
        )

    choices_in_words = [f"{name} fixed" for name in sorted(choices.fixed - choices.values.keys())]
    choices_in_words += [f"{k} fixed at {shown(k, v)}" for k, v in sorted(choices.values.items())]
    choices_in_words += [f"{name} free" for name in sorted(choices.free)]
    choices_in_words += [
        f"{k} {shown(k, p.mean, p.sigma)}" for k, p in sorted(choices.priors.items())
    ]
    choices_in_words += [
        f"camera of {view} from an earlier result" for view in sorted(choices.cameras)
    ]
    return ", ".join(choices_in_words)


def _hashes(calibration: Calibration) -> tuple[list[list[Cell]], str]:
    """Return the input files with their digests, and a note on images without."""
    dataset = calibration.dataset
    machine = dataset.machine
    files = [dataset.yaml_path, dataset.table_path, *dict.fromkeys(dataset.camera_paths),
             machine.yaml_path, machine.urdf_path, dataset.folder / OBSERVATIONS_NAME]  # fmt: skip
    images = [dataset.image_path(row) for row in range(dataset.measurements.n_rows)]
    pictures = [path for path in dict.fromkeys(images) if path is not None]
    sizes = {path: _size(path) for path in (*files, *pictures)}
    with_images = sum(sizes[path] or 0 for path in pictures) <= MAX_HASHED
    rows: list[list[Cell]] = []
    for path in (*files, *pictures):
        size = sizes[path]
        if size is None:
            if path in pictures:
                rows.append([_name(path, dataset.folder), number(None, 0), "no longer there"])
            continue
        is_hashed = with_images or path not in pictures
        digest = hashlib.sha256(path.read_bytes()).hexdigest() if is_hashed else ""
        rows.append([_name(path, dataset.folder), number(size, 0), digest])
    note = "" if with_images else "Images are listed without digests: there are too many bytes."
    return rows, note


def _size(path: Path) -> int | None:
    try:
        return os.stat(path).st_size if path.is_file() else None
    except OSError:
        return None


def _name(path: Path, folder: Path) -> str:
    path, folder = path.absolute(), folder.absolute()
    return os.path.relpath(path, folder) if path.is_relative_to(folder) else str(path)
