"""The result folder: what a controller and a script read, written, and read back for other jobs.

It is written all of it or nothing: the calibrated model, that of the four steps, ``result.json``,
and the tables of what was observed. A result that is read back must be complete and consistent: its
covariance that of its parameters, and these the ones of the model beside it.
"""

from __future__ import annotations

import json
import os
import shutil
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from legcal.calibration.detection import OVERLAYS
from legcal.calibration.documents import (
    ParameterRow,
    Result,
    unreadable,
)
from legcal.calibration.fit_overlays import draw_overlays, earlier_overlays
from legcal.calibration.joint_fit.outline_errors import KINDS, PLACES
from legcal.calibration.joint_fit.parameter_choices import KnownIntrinsics
from legcal.calibration.link_joints import joints_in_links
from legcal.calibration.result import Calibration
from legcal.calibration.summary import Summarised, few_lines
from legcal.data.corners import write_corners
from legcal.data.dataset import CORNERS_NAME, OBSERVATIONS_NAME
from legcal.data.outlines import write_observations
from legcal.errors import DatasetError, DidNotConverge, ModelError, OutOfClass, OutOfResources
from legcal.files.folder import result_folder
from legcal.geometry.types import Array
from legcal.machine.files import RESULT_YAML
from legcal.machine.home import home_of_legs
from legcal.machine.leg import Leg
from legcal.machine.loader import load_mechanism
from legcal.machine.model import Machine
from legcal.machine.model_writer import reload_and_check, write_calibrated_yaml, write_urdf
from legcal.machine.parameter_id import ARMS, AXES, ParameterId
from legcal.machine.parameters import (
    calibrated_axis,
    geometries,
    nominal_axes,
    parametrization_of,
    turns_between,
    vector_of,
)
from legcal.pages.html import PAGE
from legcal.progress import Report, no_progress
from legcal.vision.camera import Camera, camera_numbers, intrinsic_names, intrinsic_values
from legcal.workers import Run, in_turn

Beside = Callable[[Calibration, Path], None]
RESULT_NAME, STAGED_NAME = "result.json", "staged.yaml"
REPORT_NAME = "report.html"  # written beside a result, which an earlier one does not describe
RELOAD_TOLERANCE = 2.5e-11  # mean leg lengths, [rad] between reloaded and written parameters
MAX_HOME_RESIDUAL = 0.2  # of a leg length: of calibrated legs at the nominal home
ROUNDING = 2.5e-9  # mean leg lengths, [rad]: of numbers in files
SYMMETRY_TOLERANCE = 1e-6  # relative, of covariances


def write_result(
    calibration: Calibration,
    destination: Path,
    *,
    run: Run = in_turn,
    progress: Report = no_progress,
    beside: Beside | None = None,
) -> Calibration:
    """Write the result folder, all of it or nothing, and return what was written.

    The calibrated model is loaded again from the files and must have the parameters that were
    written and close at home, before the folder appears. So must the model of the four steps, or
    it is left out, with a note that says why; and so are overlays that cannot be drawn. What
    *beside* writes into the folder that it is given appears with the result.

    Raises
    ------
    UsageError
        If the destination holds something else than an earlier result.
    DidNotConverge
        If the written model does not load as what was computed.
    """
    dataset, solution, steps = calibration.dataset, calibration.solution, calibration.steps
    machine = dataset.machine
    stale = [OBSERVATIONS_NAME, CORNERS_NAME, STAGED_NAME, str(_urdf_of(Path(STAGED_NAME)))]
    stale += [REPORT_NAME] * PAGE.is_at(destination / REPORT_NAME)
    old = [*map(Path, stale), *earlier_overlays(destination)]
    with result_folder(destination, stale=old) as folder:
        _write_model(machine, solution.legs, folder / RESULT_YAML)
        if steps.legs is not None:
            try:
                _write_model(machine, steps.legs, folder / STAGED_NAME)
            except (DidNotConverge, ModelError, OutOfClass):
                # The nominal model, of which the refusal speaks, is not the cause: the calibrated
                # one was made from it in the same way.
                note = (
                    "There is no model of the four steps (staged.yaml): the joints that they found "
                    "make none that loads and closes. The calibrated model does not depend on it."
                )
                calibration = replace(calibration, notes=(*calibration.notes, note))
                for path in (folder / STAGED_NAME, _urdf_of(folder / STAGED_NAME)):
                    path.unlink(missing_ok=True)
        if calibration.overlays:
            try:
                draw_overlays(calibration, folder, run, progress)
            except (DatasetError, OutOfResources) as failure:
                note = f"There are no overlays. {' '.join(failure.problems)}"
                notes = (*calibration.notes, note)
                calibration = replace(calibration, notes=notes, overlays={})
                shutil.rmtree(folder / OVERLAYS, ignore_errors=True)
        document = json.dumps(calibration.result.document(), indent=1, allow_nan=False)
        (folder / RESULT_NAME).write_text(document + "\n", encoding="utf-8")
        if dataset.axes is None:
            table, measurements = folder / OBSERVATIONS_NAME, dataset.measurements
            write_observations(table, solution.outlines, measurements, machine.leg_names)
        if calibration.corners is not None:
            write_corners(folder / CORNERS_NAME, calibration.corners, dataset.measurements)
        if beside is not None:
            beside(calibration, folder)
    return calibration


def _urdf_of(yaml: Path) -> Path:
    """Return the URDF beside the YAML of a written model."""
    return yaml.with_suffix(".urdf")


def _write_model(machine: Machine, legs: Sequence[Leg], yaml: Path) -> None:
    """Write a mechanism with other legs; loaded again it must be what was computed, and close."""
    start = f"{yaml}: the model could not be written: found"
    write_urdf(machine, legs, _urdf_of(yaml))
    home = home_of_legs(machine, legs, MAX_HOME_RESIDUAL)
    if home is None:
        raise DidNotConverge(
            f"{start} no closed pose of its legs near legcal.home, needed one; check legcal.home "
            f"of {machine.yaml_path}, and the nominal model."
        )
    moved = None if home is machine.home else home
    write_calibrated_yaml(machine, yaml, _urdf_of(yaml).name, moved, legs)
    written = reload_and_check(yaml)
    found = parametrization_of(written, twists=True)
    apart = vector_of(found, geometries(written), legs) - vector_of(found, legs, legs)
    unit = np.where([unit == "m" for unit in found.units], machine.size, 1.0)
    off = float(np.abs(apart / unit).max())
    if not off <= RELOAD_TOLERANCE:
        raise DidNotConverge(
            f"{start} that its parameters, loaded again, differ by {off:.1e} leg lengths or rad "
            f"from the computed ones, needed at most {RELOAD_TOLERANCE:.0e}; please report this."
        )


@dataclass(frozen=True, eq=False)
class EarlierResult(Summarised):
    """An earlier calibration, whose parts agree with each other."""

    folder: Path
    document: Result
    machine: Machine  # the calibrated model
    names: tuple[str, ...]  # kinematic parameters that were estimated, or weak
    covariance: Array  # theirs, zero along what was held; axes count from the calibrated ones
    held: Array  # (w, n) how they change along the directions that were held, by a metre
    fixed: tuple[str, ...]  # kinematic parameters that were fixed

    @property
    def result(self) -> Result:
        """The document."""
        return self.document

    def __repr__(self) -> str:
        return few_lines(f"Calibration in {self.folder}", self.result)

    def intrinsics(self, given: Camera) -> KnownIntrinsics | None:
        """Return what was found of the intrinsics of a camera; None if none was estimated."""
        rows = [row for row in self.result.parameters if row.status == "estimated"]
        number, names = {row.name: i for i, row in enumerate(rows)}, intrinsic_names(given)
        for owner, numbers in self.result.cameras.items():
            found = {
                k: number[f"{owner}.{name}"]
                for k, name in enumerate(names)
                if numbers == camera_numbers(given) and f"{owner}.{name}" in number
            }
            if found:
                covariance, at = np.zeros((len(names), len(names))), list(found.values())
                known = np.array(self.result.covariance)[np.ix_(at, at)]
                covariance[np.ix_(list(found), list(found))] = known
                mean = intrinsic_values(given)
                mean[list(found)] = [rows[i].value for i in at]
                return KnownIntrinsics(mean, covariance)
        return None


def load_result(given: str | Path) -> EarlierResult:
    """Return the result in a folder that ``legcal calibrate`` wrote, or in its ``result.json``.

    Raises
    ------
    DatasetError
        If it is no such folder, damaged, or put together from several.
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
        found = f"the legs {', '.join(document.legs)} in {RESULT_NAME}"
        needed = f"{', '.join(machine.leg_names)} as in {RESULT_YAML} beside it"
        raise unreadable(path, found, needed)
    machine = machine.with_leg_order(document.legs)
    legs, known = geometries(machine), parametrization_of(machine, twists=True)
    values = {row.name: row.value for row in document.parameters}
    _check_actuators(path, document, machine)
    nominal_legs = _with_nominal_axes(machine.leg_names, legs, document, values)
    estimated = [row for row in document.parameters if row.status == "estimated"]
    _check_covariance(path, estimated, np.array([row.sigma for row in estimated]), document)
    _check_same_model(path, document, values, machine, nominal_legs)
    covariance, held = _kinematic(path, estimated, document, known.names)
    known_errors = (*KINDS, *PLACES)
    others = [name for name in document.residuals.shared_px if name not in known_errors]
    if others:
        raise unreadable(path, f"the shared errors '{others[0]}'", ", ".join(known_errors))
    fixed = {row.name for row in document.parameters if row.status == "fixed"}
    kept = [i for i, name in enumerate(known.names) if name not in fixed]
    turns = turns_between(known, legs, nominal_legs)
    if document.links is None:
        links = joints_in_links(
            machine, document.parameters, document.kinematic, document.nominal_axes
        )
        document = document.model_copy(update={"links": links})
    return EarlierResult(
        folder=path.parent,
        document=document,
        machine=machine,
        names=tuple(known.names[i] for i in kept),
        covariance=(turns @ covariance @ turns.T)[np.ix_(kept, kept)],
        held=(held @ turns.T)[:, kept],
        fixed=tuple(name for name in values if name in fixed and name in known.names),
    )


def _with_nominal_axes(
    names: Sequence[str],
    legs: Sequence[Leg],
    document: Result,
    values: Mapping[str, float],
) -> tuple[Leg, ...]:
    """Return legs with the axes and twists that the parameters of a document count from."""
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
    """Refuse a document whose actuators are not those of the model beside it."""
    needed = {actuator.joint: actuator.kind.value for actuator in machine.actuators}
    for blocks in (document.actuators, document.nominal_actuators):
        found = {joint: block.kind for joint, block in (blocks or {}).items()}
        if found != needed:
            words, wanted = (
                ", ".join(f"{joint} ({kind})" for joint, kind in sorted(of.items())) or "none"
                for of in (found, needed)
            )
            raise unreadable(path, f"the actuators {words}", f"{wanted} as in {RESULT_YAML}")


def _check_covariance(
    path: Path, estimated: Sequence[ParameterRow], sigma: Array, document: Result
) -> None:
    """Refuse a covariance that cannot be that of the estimated parameters."""
    n, found = len(estimated), document.covariance
    needed = f"a covariance of the {n} estimated parameters that fits their sigmas"
    if n == 0 or len(found) != n or any(len(row) != n for row in found):
        shape = f"{len(found)} rows of {len(found[0]) if found else 0} numbers"
        raise unreadable(path, shape, needed)
    if all(row.sigma is not None for row in estimated):
        scaled = np.array(found) / np.outer(sigma, sigma)
        if (
            np.abs(scaled - scaled.T).max() < SYMMETRY_TOLERANCE
            and np.abs(np.diagonal(scaled) - 1.0).max() < SYMMETRY_TOLERANCE
            and np.linalg.eigvalsh(scaled)[0] > -SYMMETRY_TOLERANCE
        ):
            return
    raise unreadable(path, "another matrix", needed)


def _kinematic(
    path: Path, estimated: Sequence[ParameterRow], document: Result, known: Sequence[str]
) -> tuple[Array, Array]:
    """Return covariance (p, p) and held directions (w, p) of all kinematic parameters."""
    n, found = len(known), document.kinematic
    needed = f"a covariance and held directions of the {n} kinematic parameters"
    if sorted(found.names) != sorted(known) or len(found.covariance) != n:
        raise unreadable(path, f"those of {len(found.names)} others", needed)
    if any(len(row) != n for row in (*found.covariance, *found.held)):
        raise unreadable(path, "rows of other lengths", needed)
    order = [found.names.index(name) for name in known]
    covariance = np.array(found.covariance)[np.ix_(order, order)]
    held = np.array(found.held).reshape(-1, n)[:, order]
    both = [i for i, row in enumerate(estimated) if row.name in known]
    at = [known.index(estimated[i].name) for i in both]
    of_all = np.array(document.covariance)
    sigma = np.sqrt(np.diagonal(of_all))[both]
    apart = (covariance[np.ix_(at, at)] - of_all[np.ix_(both, both)]) / np.outer(sigma, sigma)
    is_same = np.abs(apart).max(initial=0.0) <= SYMMETRY_TOLERANCE
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
    """Refuse a document whose parameters are not those of the model beside it."""
    legs, known = geometries(machine), parametrization_of(machine, twists=True)
    numbers = dict(zip(known.names, vector_of(known, legs, nominal_legs).tolist(), strict=True))
    turned = (*AXES, "arm_axis")  # by angles from nominal axes
    other = [
        name
        for name, number in numbers.items()
        if ParameterId.parse(name).kind not in turned
        and not abs(values.get(name, number) - number) <= ROUNDING * machine.size
    ]
    later = ("twist", *ARMS)  # what results of earlier versions do not have
    other += [n for n in numbers if n not in values and ParameterId.parse(n).kind not in later]
    for side, axes in nominal_axes(machine.leg_names, legs).items():
        for leg, axis in axes.items():
            nominal = document.nominal_axes.get(side, {}).get(leg)
            found = None if nominal is None else calibrated_axis(nominal, leg, side, values)
            # An axis is a line: either direction is the same.
            if found is None or not np.linalg.norm(np.cross(found, axis)) < ROUNDING:
                other.append(f"the {side} axis of {leg}")
    if other:
        found_words = f"other values of {', '.join(other[:3])}" + " and more" * (len(other) > 3)
        raise unreadable(path, found_words, f"those of {RESULT_YAML} beside it")
