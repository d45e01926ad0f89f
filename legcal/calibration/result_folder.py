"""The result folder for controllers, scripts and other jobs: written and read back.

It is written atomically: the calibrated model, the model of the four steps, ``result.json``, and
the tables of outlines and corners. A result that is read back must be complete and consistent:
covariance and parameters must match, and agree with the model in the folder.
"""

from __future__ import annotations

import json
import os
import shutil
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from legcal.calibration.documents import (
    ParameterRow,
    Result,
    unreadable,
)
from legcal.calibration.joint_fit.outline_errors import KINDS, PLACES
from legcal.calibration.joint_fit.parameter_choices import KnownIntrinsics
from legcal.calibration.joint_fit.solution import Solution
from legcal.calibration.result import REFUSED, Calibration, Verdict
from legcal.calibration.summary import Summarised, few_lines
from legcal.data.corners import write_corners
from legcal.data.dataset import CORNERS_NAME, OBSERVATIONS_NAME, Dataset, rows_with_image
from legcal.data.outlines import with_body_edges, write_observations
from legcal.errors import (
    DatasetError,
    DidNotConverge,
    ModelError,
    OutOfClass,
    OutOfResources,
    UsageError,
)
from legcal.files.folder import RESULT, in_the_way, path_problem, result_folder
from legcal.files.schema import read_json
from legcal.geometry.types import Array
from legcal.machine.files import RESULT_YAML
from legcal.machine.leg import AXES, Leg, ParameterId, with_radii
from legcal.machine.loader import load_mechanism
from legcal.machine.model import Machine
from legcal.machine.model_writer import urdf_of, write_calibrated
from legcal.machine.parameters import (
    calibrated_axis,
    geometries,
    nominal_axes,
    parametrization_of,
    turns_between,
    vector_of,
)
from legcal.pages.document import PAGE
from legcal.perception.overlays import OVERLAYS, is_overlay
from legcal.progress import Report, no_progress
from legcal.vision.camera import Camera, camera_numbers, intrinsic_names, intrinsic_values
from legcal.workers import Run, in_turn

if TYPE_CHECKING:
    from legcal.calibration.detection import Detection

Beside = Callable[[Calibration, Path], None]
RESULT_NAME, STAGED_NAME = "result.json", "staged.yaml"
REPORT_NAME = "report.html"  # removed with an earlier result
ROUNDING = 2.5e-9  # rounding of numbers in files [mean leg lengths, rad]
SYMMETRY_TOLERANCE = 1e-6  # relative asymmetry of covariances


def write_result(
    calibration: Calibration,
    destination: Path,
    *,
    run: Run = in_turn,
    progress: Report = no_progress,
    beside: Beside | None = None,
) -> Calibration:
    """Write the result folder atomically, and return the written calibration.

    Before the folder appears, the calibrated model is loaded again and must have the written
    parameters and close at home. The model of the four steps is left out with a note if it fails
    this test, and overlays if they cannot be drawn. *beside* may write further files into the
    folder.

    Raises UsageError if the destination is not an earlier result; DidNotConverge if the written
    model does not load with the computed parameters.
    """
    dataset, solution, steps = calibration.dataset, calibration.solution, calibration.steps
    machine = dataset.machine
    stale = [OBSERVATIONS_NAME, CORNERS_NAME, STAGED_NAME, str(urdf_of(Path(STAGED_NAME)))]
    stale += [REPORT_NAME] * PAGE.is_at(destination / REPORT_NAME)
    old = [*map(Path, stale), *earlier_overlays(destination)]
    with result_folder(destination, stale=old) as folder:
        write_calibrated(machine, calibration.legs, folder / RESULT_YAML)
        if steps.legs is not None:
            try:
                write_calibrated(machine, steps.legs, folder / STAGED_NAME)
            except (DidNotConverge, ModelError, OutOfClass):
                # The nominal model, which the error names, is not the cause: the calibrated model
                # was made from it in the same way.
                note = (
                    "There is no model of the four steps (staged.yaml): their joints make no model "
                    "that loads and closes. The calibrated model does not depend on it."
                )
                calibration = replace(calibration, notes=(*calibration.notes, note))
                for path in (folder / STAGED_NAME, urdf_of(folder / STAGED_NAME)):
                    path.unlink(missing_ok=True)
        if calibration.overlays:
            from legcal.calibration.detection import draw_images

            try:
                detection = replace(
                    _as_detection(dataset, solution),
                    outlines=with_body_edges(solution.outlines, solution.edges),
                    rows=np.array(list(calibration.overlays), dtype=np.intp),
                    corners=calibration.corners,
                )
                draw_images(detection, folder, run, progress)
            except (DatasetError, OutOfResources) as failure:
                note = f"There are no overlays. {' '.join(failure.problems)}"
                notes = (*calibration.notes, note)
                calibration = replace(calibration, notes=notes, overlays={})
                shutil.rmtree(folder / OVERLAYS, ignore_errors=True)
        document = json.dumps(calibration.result.document(), indent=1, allow_nan=False)
        (folder / RESULT_NAME).write_text(document + "\n", encoding="utf-8")
        table, measurements = folder / OBSERVATIONS_NAME, dataset.measurements
        outlines = with_body_edges(solution.outlines, solution.edges)
        write_observations(table, outlines, measurements, machine.leg_names)
        if calibration.corners is not None:
            write_corners(folder / CORNERS_NAME, calibration.corners, dataset.measurements)
        if beside is not None:
            beside(calibration, folder)
    return calibration


@dataclass(frozen=True, eq=False)
class EarlierResult(Summarised):
    """An earlier calibration, whose parts agree with each other."""

    folder: Path
    document: Result
    machine: Machine  # the calibrated model
    names: tuple[str, ...]  # estimated and weak kinematic parameters
    # (n, n): their covariance, zero along held directions; axes are relative to the calibrated ones
    covariance: Array
    held: Array  # (w, n): change of the parameters by a metre along each held direction
    fixed: tuple[str, ...]  # fixed kinematic parameters

    @property
    def result(self) -> Result:
        """The document."""
        return self.document

    @property
    def verdict(self) -> Verdict:
        """Whether to use it, as it was written; the file does not hold its ``remedy``."""
        sentence, written = self.document.verdict, self.document.doubts
        is_refused = sentence.startswith(REFUSED)
        # Too small an improvement is always grave, and follows its causes; else the worst is first
        grave = [k for k, doubt in enumerate(written) if doubt.code == "no_improvement"] or [0]
        doubts = [
            replace(doubt, is_grave=is_refused and k in grave) for k, doubt in enumerate(written)
        ]
        return Verdict(tuple(doubts), sentence)

    def __repr__(self) -> str:
        return few_lines(f"Calibration in {self.folder}", self.result)

    def intrinsics(self, given: Camera) -> KnownIntrinsics | None:
        """Return the estimated intrinsics of a camera; None if none was estimated."""
        rows = [row for row in self.result.parameters if row.status == "estimated"]
        number, names = {row.name: i for i, row in enumerate(rows)}, intrinsic_names(given)
        for owner, numbers in self.result.cameras.items():
            row_of = {
                k: number[f"{owner}.{name}"]
                for k, name in enumerate(names)
                if numbers == camera_numbers(given) and f"{owner}.{name}" in number
            }
            if row_of:
                covariance, indices = np.zeros((len(names), len(names))), list(row_of.values())
                covariance_of_estimated = np.array(self.result.covariance)[np.ix_(indices, indices)]
                covariance[np.ix_(list(row_of), list(row_of))] = covariance_of_estimated
                mean = intrinsic_values(given)
                mean[list(row_of)] = [rows[i].value for i in indices]
                return KnownIntrinsics(mean, covariance)
        return None


def load_result(given: str | Path) -> EarlierResult:
    """Return the result in a folder that ``legcal calibrate`` wrote, or in its ``result.json``.

    Raises
    ------
    DatasetError
        If it is not a result folder, damaged, or a mix of several results.
    """
    path = Path(given)
    path = path if path.name == RESULT_NAME and not os.path.isdir(path) else path / RESULT_NAME
    if os.path.isdir(path.parent) and not os.path.exists(path):
        raise DatasetError(
            f"{given}: the result of an earlier calibration could not be read: found no "
            f"{RESULT_NAME} in the folder, needed one that legcal calibrate wrote (-o); check the "
            "path."
        )
    document = Result.read(path)
    try:
        machine = load_mechanism(path.parent / RESULT_YAML)
    except (ModelError, OutOfClass) as error:
        raise DatasetError(error.facts) from error
    if sorted(document.legs) != sorted(machine.leg_names):
        legs_in_words = f"the legs {', '.join(document.legs)} in {RESULT_NAME}"
        needed = f"{', '.join(machine.leg_names)} as in {RESULT_YAML} beside it"
        raise unreadable(path, legs_in_words, needed)
    machine = machine.with_leg_order(document.legs)
    legs, parametrization = geometries(machine), parametrization_of(machine, twists=True)
    values = {row.name: row.value for row in document.parameters}
    _check_actuators(path, document, machine)
    nominal_legs = with_nominal_axes(machine.leg_names, legs, document, values)
    estimated = [row for row in document.parameters if row.status == "estimated"]
    _check_covariance(path, estimated, np.array([row.sigma for row in estimated]), document)
    _check_same_model(path, document, values, machine, nominal_legs)
    covariance, held = _kinematic(path, estimated, document, parametrization.names)
    error_names = (*KINDS, *PLACES)
    unknown = [name for name in document.residuals.shared_px if name not in error_names]
    if unknown:
        raise unreadable(path, f"the shared errors '{unknown[0]}'", ", ".join(error_names))
    fixed = {row.name for row in document.parameters if row.status == "fixed"}
    not_fixed = [i for i, name in enumerate(parametrization.names) if name not in fixed]
    turns = turns_between(parametrization, legs, nominal_legs)
    return EarlierResult(
        folder=path.parent,
        document=document,
        machine=machine,
        names=tuple(parametrization.names[i] for i in not_fixed),
        covariance=(turns @ covariance @ turns.T)[np.ix_(not_fixed, not_fixed)],
        held=(held @ turns.T)[:, not_fixed],
        fixed=tuple(name for name in values if name in fixed and name in parametrization.names),
    )


def with_nominal_axes(
    names: Sequence[str],
    legs: Sequence[Leg],
    document: Result,
    values: Mapping[str, float],
) -> tuple[Leg, ...]:
    """Return legs with the nominal axes and twists to which parameters of a document refer."""
    base, platform = (
        {name: np.array(axis) for name, axis in document.nominal_axes.get(side, {}).items()}
        for side in ("base", "platform")
    )
    return tuple(
        replace(
            leg,
            base_axis=base.get(name, leg.base_axis),
            platform_axis=platform.get(name, leg.platform_axis),
            twist=values.get(f"{name}.twist", leg.twist),
            actuator=document.nominal_actuator(leg.actuator),
        )
        for name, leg in zip(names, legs, strict=True)
    )


def _check_actuators(path: Path, document: Result, machine: Machine) -> None:
    """Refuse a document with other actuators than the model in its folder."""
    needed = {actuator.joint: actuator.kind.value for actuator in machine.actuators}
    for blocks in (document.actuators, document.nominal_actuators):
        kinds = {joint: block.kind for joint, block in (blocks or {}).items()}
        if kinds != needed:
            kinds_in_words, wanted = (
                ", ".join(f"{joint} ({kind})" for joint, kind in sorted(of.items())) or "none"
                for of in (kinds, needed)
            )
            raise unreadable(
                path, f"the actuators {kinds_in_words}", f"{wanted} as in {RESULT_YAML}"
            )


def _check_covariance(
    path: Path, estimated: Sequence[ParameterRow], sigma: Array, document: Result
) -> None:
    """Refuse a covariance that does not match the estimated parameters."""
    n, matrix = len(estimated), document.covariance
    needed = f"a covariance of the {n} estimated parameters that fits their sigmas"
    if n == 0 or len(matrix) != n or any(len(row) != n for row in matrix):
        shape = f"{len(matrix)} rows of {len(matrix[0]) if matrix else 0} numbers"
        raise unreadable(path, shape, needed)
    if all(row.sigma is not None for row in estimated):
        scaled = np.array(matrix) / np.outer(sigma, sigma)
        if (
            np.abs(scaled - scaled.T).max() < SYMMETRY_TOLERANCE
            and np.abs(np.diagonal(scaled) - 1.0).max() < SYMMETRY_TOLERANCE
            and np.linalg.eigvalsh(scaled)[0] > -SYMMETRY_TOLERANCE
        ):
            return
    raise unreadable(path, "another matrix", needed)


def _kinematic(
    path: Path, estimated: Sequence[ParameterRow], document: Result, names: Sequence[str]
) -> tuple[Array, Array]:
    """Return covariance (p, p) and held directions (w, p) of all kinematic parameters."""
    n, kinematic = len(names), document.kinematic
    needed = f"a covariance and held directions of the {n} kinematic parameters"
    if sorted(kinematic.names) != sorted(names) or len(kinematic.covariance) != n:
        raise unreadable(path, f"those of {len(kinematic.names)} others", needed)
    if any(len(row) != n for row in (*kinematic.covariance, *kinematic.held)):
        raise unreadable(path, "rows of other lengths", needed)
    order = [kinematic.names.index(name) for name in names]
    covariance = np.array(kinematic.covariance)[np.ix_(order, order)]
    held = np.array(kinematic.held).reshape(-1, n)[:, order]
    common = [i for i, row in enumerate(estimated) if row.name in names]
    indices = [names.index(estimated[i].name) for i in common]
    of_all = np.array(document.covariance)
    sigma = np.sqrt(np.diagonal(of_all))[common]
    difference = (covariance[np.ix_(indices, indices)] - of_all[np.ix_(common, common)]) / np.outer(
        sigma, sigma
    )
    is_same = np.abs(difference).max(initial=0.0) <= SYMMETRY_TOLERANCE
    largest = np.abs(covariance).max()
    if not is_same or np.abs(covariance - covariance.T).max() > SYMMETRY_TOLERANCE * largest:
        raise unreadable(path, "another matrix in 'kinematic'", needed)
    return covariance, held


def _check_same_model(
    path: Path,
    document: Result,
    values: Mapping[str, float],
    machine: Machine,
    nominal_legs: Sequence[Leg],
) -> None:
    """Refuse a document with other parameters than the model in its folder."""
    legs, parametrization = geometries(machine), parametrization_of(machine, twists=True)
    numbers = dict(
        zip(
            parametrization.names,
            vector_of(parametrization, legs, nominal_legs).tolist(),
            strict=True,
        )
    )
    by_angles = (*AXES, "arm_axis")  # parametrised by angles from nominal axes
    different = [
        name
        for name, number in numbers.items()
        if ParameterId.parse(name).kind not in by_angles
        and not abs(values.get(name, number) - number) <= ROUNDING * machine.size
    ]
    different += [name for name in numbers if name not in values]
    for side, axes in nominal_axes(machine.leg_names, legs).items():
        for leg, axis in axes.items():
            nominal = document.nominal_axes.get(side, {}).get(leg)
            axis_in_document = (
                None if nominal is None else calibrated_axis(nominal, leg, side, values)
            )
            # An axis is a line: either direction is the same.
            if (
                axis_in_document is None
                or not np.linalg.norm(np.cross(axis_in_document, axis)) < ROUNDING
            ):
                different.append(f"the {side} axis of {leg}")
    if different:
        values_in_words = f"other values of {', '.join(different[:3])}" + " and more" * (
            len(different) > 3
        )
        raise unreadable(path, values_in_words, f"those of {RESULT_YAML} beside it")


# Overlays: photographs with the fitted outlines, drawn like those of a detection


def with_overlays(calibration: Calibration) -> Calibration:
    """Return the calibration with the files of its overlays, by row; nothing is drawn."""
    files = _as_detection(calibration.dataset, calibration.solution).overlay_files
    return replace(calibration, overlays=files)


def check_overlays(dataset: Dataset, destination: Path | None) -> None:
    """Refuse overlays without photographs, or over files of another program, before any work."""
    start = f"{dataset.table_path}: the overlays could not be drawn: found"
    if destination is None:
        raise UsageError(f"{start} no output folder, needed one to write them into; give one.")
    if not len(rows_with_image(dataset)):
        raise UsageError(
            f"{start} no photograph, needed those of the outlines; leave the overlays out."
        )
    earlier = set(earlier_overlays(destination))
    if os.path.lexists(destination / OVERLAYS) and not earlier:
        raise UsageError(in_the_way(destination, RESULT, f"{OVERLAYS}, which legcal did not write"))


def earlier_overlays(destination: Path) -> list[Path]:
    """Return the overlays of an earlier result in a folder, relative to it."""
    if not RESULT.is_in(destination):
        return []
    listed = read_json(destination / RESULT.marker).get("overlays")
    names = [overlay.get("file") for overlay in listed or () if isinstance(overlay, Mapping)]
    return [
        Path(name)
        for name in names
        if isinstance(name, str)
        and path_problem(destination, name) is None
        and is_overlay(Path(name))
    ]


def _as_detection(dataset: Dataset, solution: Solution) -> Detection:
    """Return the outlines, legs and cameras of a fit as a detection."""
    from legcal.calibration.detection import Detection

    placed = solution.placement(dataset.machine, dataset.measurements)
    return Detection(
        dataset=dataset,
        outlines=solution.outlines,
        A_base=placed.A_base,
        B_base=placed.B_base,
        cylinders=with_radii(
            [leg.cylinders for leg in dataset.machine.legs],
            lambda j, c: solution.radii.get((j, c.link), c.radius),
        ),
        T_base_camera=placed.T_base_camera,
        rows=rows_with_image(dataset),
        unplaced={},
        image_notes=(),
        leg_notes=(),
        arms=placed.arms,
    )
