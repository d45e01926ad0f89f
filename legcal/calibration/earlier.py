"""An earlier calibration, read back from its result folder and compared with the model in it."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from legcal.calibration.joint_fit import BOARD_SCALE, KINDS
from legcal.calibration.result import MODEL_NAME, RESULT_NAME, ParameterRow, Result, refused
from legcal.errors import DatasetError, ModelError, OutOfClass
from legcal.geometry import Array
from legcal.machine import (
    Leg,
    Machine,
    calibrated_axis,
    geometries,
    load_mechanism,
    nominal_axes,
    parametrization_of,
    turns_between,
    vector_of,
)

_SAME = 1e-9  # [m]: rounding of files
_SYMMETRIC = 1e-6  # relative


@dataclass(frozen=True, eq=False)
class EarlierResult:
    """An earlier calibration, whose parts agree with each other."""

    folder: Path
    document: Result
    machine: Machine  # the calibrated model
    names: tuple[str, ...]  # kinematic parameters that were estimated, or weak
    covariance: Array  # theirs, zero along what was held; axes count from the calibrated ones
    held: Array  # (w, n) how they change along the directions that were held, by a metre
    fixed: tuple[str, ...]  # kinematic parameters that were fixed

    @property
    def intrinsics(self) -> dict[str, tuple[float, float]]:
        """Value and sigma of the estimated intrinsics, by name."""
        kinematic = set(self.document.kinematic.names)
        return {
            row.name: (row.value, row.sigma)
            for row in self.document.parameters
            if row.status == "estimated"
            and row.sigma is not None
            and row.name not in kinematic
            and row.name != BOARD_SCALE
            and ".radius." not in row.name
        }


def read_result(given: str | Path) -> EarlierResult:
    """Return the result in a folder that ``legcal calibrate`` wrote, or in its ``result.json``.

    Raises
    ------
    DatasetError
        If it is no such folder, damaged, or put together from several.
    """
    path = Path(given)
    path = path if path.name == RESULT_NAME and not os.path.isdir(path) else path / RESULT_NAME
    document = Result.read(path)
    try:
        machine = load_mechanism(path.parent / MODEL_NAME)
    except (ModelError, OutOfClass) as error:
        raise DatasetError(error.problems) from error
    if sorted(document.legs) != sorted(machine.leg_names):
        found = f"the legs {', '.join(document.legs)} in {RESULT_NAME}"
        needed = f"{', '.join(machine.leg_names)} as in {MODEL_NAME} beside it"
        raise refused(path, found, needed)
    machine = machine.with_leg_order(document.legs)
    legs, known = geometries(machine), parametrization_of(machine, twists=True)
    values = {row.name: row.value for row in document.parameters}
    nominal_legs = _with_nominal_axes(machine.leg_names, legs, document, values)
    estimated = [row for row in document.parameters if row.status == "estimated"]
    _check_covariance(path, estimated, np.array([row.sigma for row in estimated]), document)
    _check_same_model(path, document, values, machine, nominal_legs)
    covariance, held = _kinematic(path, estimated, document, known.names)
    others = [name for name in document.residuals.shared_px if name not in KINDS]
    if others:
        raise refused(path, f"the shared errors '{others[0]}'", ", ".join(KINDS))
    fixed = {row.name for row in document.parameters if row.status == "fixed"}
    kept = [i for i, name in enumerate(known.names) if name not in fixed]
    turns = turns_between(known, legs, nominal_legs)
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
        )
        for name, leg in zip(names, legs, strict=True)
    )


def _check_covariance(
    path: Path, estimated: Sequence[ParameterRow], sigma: Array, document: Result
) -> None:
    """Refuse a covariance that is none of the estimated parameters."""
    n, found = len(estimated), document.covariance
    needed = f"a covariance of the {n} estimated parameters that fits their sigmas"
    if n == 0 or len(found) != n or any(len(row) != n for row in found):
        shape = f"{len(found)} rows of {len(found[0]) if found else 0} numbers"
        raise refused(path, shape, needed)
    if all(row.sigma is not None for row in estimated):
        scaled = np.array(found) / np.outer(sigma, sigma)
        if (
            np.abs(scaled - scaled.T).max() < _SYMMETRIC
            and np.abs(np.diagonal(scaled) - 1.0).max() < _SYMMETRIC
            and np.linalg.eigvalsh(scaled)[0] > -_SYMMETRIC
        ):
            return
    raise refused(path, "another matrix", needed)


def _kinematic(
    path: Path, estimated: Sequence[ParameterRow], document: Result, known: Sequence[str]
) -> tuple[Array, Array]:
    """Return covariance (p, p) and held directions (w, p) of all kinematic parameters."""
    n, found = len(known), document.kinematic
    needed = f"a covariance and held directions of the {n} kinematic parameters"
    if sorted(found.names) != sorted(known) or len(found.covariance) != n:
        raise refused(path, f"those of {len(found.names)} others", needed)
    if any(len(row) != n for row in (*found.covariance, *found.held)):
        raise refused(path, "rows of other lengths", needed)
    order = [found.names.index(name) for name in known]
    covariance = np.array(found.covariance)[np.ix_(order, order)]
    held = np.array(found.held).reshape(-1, n)[:, order]
    both = [i for i, row in enumerate(estimated) if row.name in known]
    at = [known.index(estimated[i].name) for i in both]
    of_all = np.array(document.covariance)
    sigma = np.sqrt(np.diagonal(of_all))[both]
    apart = (covariance[np.ix_(at, at)] - of_all[np.ix_(both, both)]) / np.outer(sigma, sigma)
    is_same = np.abs(apart).max(initial=0.0) <= _SYMMETRIC
    if not is_same or np.abs(covariance - covariance.T).max() > _SAME:
        raise refused(path, "another matrix in 'kinematic'", needed)
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
    other = [
        name
        for name, number in numbers.items()
        if "_axis." not in name and not abs(values.get(name, number) - number) <= _SAME
    ]
    other += [name for name in numbers if name not in values and not name.endswith(".twist")]
    for side, axes in nominal_axes(machine.leg_names, legs).items():
        for leg, axis in axes.items():
            nominal = document.nominal_axes.get(side, {}).get(leg)
            found = None if nominal is None else calibrated_axis(nominal, leg, side, values)
            # An axis is a line: either direction is the same.
            if found is None or not np.linalg.norm(np.cross(found, axis)) < _SAME:
                other.append(f"the {side} axis of {leg}")
    if other:
        found_words = f"other values of {', '.join(other[:3])}" + " and more" * (len(other) > 3)
        raise refused(path, found_words, f"those of {MODEL_NAME} beside it")
