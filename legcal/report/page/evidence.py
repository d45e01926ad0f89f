"""What a calibration rests on: counts and ranks, correlations, held-out images, notes, inputs."""

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
from legcal.calibration.result import Calibration
from legcal.calibration.summary import UNITS
from legcal.data.dataset import OBSERVATIONS_NAME, Dataset
from legcal.errors import LegcalError
from legcal.pages.document import Cell, Drawing, Facts, Items, Table, Text, number
from legcal.pages.svg import matrix
from legcal.report.identify import CONDITIONS
from legcal.report.page.parameter_rows import correlation
from legcal.version import __version__

MAX_HASHED = 400_000_000  # of images [bytes]: more would be waited for


def identifiability_blocks(calibration: Calibration) -> list[Any]:
    """Return counts, ranks, and the directions that are known worst."""
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
            Table((">rank before any image was searched", ">of", ""), ranks),
        ]
    weak: list[list[Cell]] = [
        [row.in_words, number(1e3 * row.sigma_m, 4), _parts(one.parameters, one.components)]
        for row in result.weakest
        for one in (row.links or row,)
    ]
    if weak:
        columns = ("known worst", ">1 sigma [mm]", "as a unit vector")
        note = "The machine above shows them as motions: choose one under Show."
        blocks.append(Table(columns, weak, note=note))
    if result.held:
        blocks.append(Items(result.held, title="Held at nominal, without effect on the platform"))
    return blocks


def _parts(names: Any, components: Any) -> str:
    return ", ".join(f"{c:+.2f} {name}" for name, c in zip(names, components, strict=True))


def correlation_blocks(calibration: Calibration) -> list[Any]:
    """Return the correlation matrix and the pairs that are correlated most."""
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
        Table(("correlated most", "with", ">correlation"), rows),
    ]


def held_out_blocks(calibration: Calibration) -> list[Any]:
    """Return how well the fit predicts images that it has not seen."""
    found = calibration.result.holdout
    if found is None:
        return [Text(["No images were kept aside; --holdout 0.2 keeps a fifth."], dim=True)]
    if found.rms_px is None:
        return [Text(["The images that were kept aside show no outline that could be compared."])]
    facts = {
        "Kept aside": f"{found.images} images of {found.poses} poses, {found.outlines} outlines, "
        f"{found.wrong} of them far off and left out",
        "Off by": f"{found.rms_px:.3f} px (rms); {found.expected_px or 0.0:.3f} px were expected",
    }
    if found.platform is not None:
        pair = found.platform
        facts["At the platform"] = (
            f"{1e3 * pair.dX_m:.3f} mm / {np.degrees(pair.dE_rad):.4f} deg (rms over {pair.poses} "
            f"poses); {1e3 * pair.expected_dX_m:.3f} mm / {np.degrees(pair.expected_dE_rad):.4f} "
            "deg were expected"
        )
    rows: list[list[Cell]] = [[name, number(rms, 3)] for name, rms in found.views.items()]
    return [Facts(facts), Table(("view", ">rms [px]"), rows)]


def note_blocks(calibration: Calibration) -> list[Any]:
    """Return the diagnosis, and the notes by what they are about."""
    blocks: list[Any] = []
    diagnosis: list[list[Cell]] = [
        [one.what, "; ".join(one.same_as), number(one.images_before, 0),
         number(one.images_after, 0), one.remedy]
        for one in calibration.result.diagnosis or ()
    ]  # fmt: skip
    if diagnosis:
        columns = ("what looks wrong", "cannot be told from", ">images that agree", ">without it",
                   "remedy")  # fmt: skip
        blocks.append(Table(columns, diagnosis, "Diagnosis"))
    for topic in Topic:
        if topic is Topic.DIAGNOSIS:
            continue  # as a table
        notes = [note for note in calibration.notes if topic_of(note) is topic]
        blocks += [Items(notes, title=topic)] * bool(notes)
    steps = calibration.result.stages.staged
    said = [getattr(steps, "failure", ""), *getattr(steps, "diagnostics", ())]
    if any(said):
        blocks.append(Items([one for one in said if one], title="The four steps alone"))
    return blocks


def reproducibility_blocks(calibration: Calibration, command: str, when: str) -> list[Any]:
    """Return version, command, settings, and the hashes of all files that went in."""
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
    return [Facts(facts), Table(columns, rows, "Files that went in", note, folded=True)]


def _encoder_sigma(dataset: Dataset) -> str:
    """Return the standard deviation of readings, by motor where they differ."""
    machine = dataset.machine
    sigma = dataset.measurements.sigma_of(machine.legs)
    found = {
        str(machine.legs[j].prismatic): f"{np.degrees(sigma[j]):.3g} deg"
        if machine.legs[j].reads_angle
        else f"{1e6 * sigma[j]:g} um"
        for j in machine.motors
    }
    alike = set(found.values())
    if len(alike) < 2:
        return next(iter(alike), "no encoder")
    return ", ".join(f"{name} {words}" for name, words in found.items())


def _chosen(calibration: Calibration) -> str:
    """Return which parameters were chosen to be fixed, free, or to have a prior."""
    choices = calibration.solution.posterior.problem.choices
    units = {row.name: row.unit for row in calibration.result.parameters}

    def shown(name: str, *values: float) -> str:
        scale, unit, digits = UNITS[units.get(name, "")]
        return " +- ".join(f"{scale * value:.{digits}f}" for value in values) + f" {unit}".rstrip()

    found = [f"{name} fixed" for name in sorted(choices.fixed - choices.values.keys())]
    found += [f"{k} fixed at {shown(k, v)}" for k, v in sorted(choices.values.items())]
    found += [f"{name} free" for name in sorted(choices.free)]
    found += [f"{k} {shown(k, p.mean, p.sigma)}" for k, p in sorted(choices.priors.items())]
    found += [f"camera of {view} from an earlier result" for view in sorted(choices.cameras)]
    return ", ".join(found)


def _hashes(calibration: Calibration) -> tuple[list[list[Cell]], str]:
    """Return the files that went in with their digests, and what is said of images without."""
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
