"""A result folder that an earlier calibration wrote, read back."""

from __future__ import annotations

import json
import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import BaseModel, ConfigDict, Field

from legcal.calibration.joint_fit import BOARD_SCALE, KINDS
from legcal.errors import DatasetError, ModelError, OutOfClass
from legcal.estimation import NoiseModel
from legcal.files import Number, Version, describe, read_text, validate
from legcal.geometry import Array
from legcal.machine import (
    Axes,
    LegGeometry,
    Mechanism,
    calibrated_axis,
    geometries,
    load_mechanism,
    nominal_axes,
    parametrization_of,
    turns_between,
    vector_of,
)

Axis = Annotated[list[Number], Field(min_length=3, max_length=3)]


class Row(BaseModel):
    """A row of the parameters."""

    model_config = ConfigDict(frozen=True, allow_inf_nan=False)
    name: str
    value: Number
    nominal: Number
    sigma: Annotated[Number, Field(gt=0.0)] | None
    unit: str
    status: Literal["estimated", "fixed", "weak"]


class Noise(BaseModel):
    """The noise of the outlines."""

    model_config = ConfigDict(frozen=True, allow_inf_nan=False)
    scale: Annotated[Number, Field(gt=0.0)]
    bias_px: Annotated[Number, Field(ge=0.0)]
    tilt_px: Annotated[Number, Field(ge=0.0)]


class KinematicPart(BaseModel):
    """What is known of all kinematic parameters."""

    model_config = ConfigDict(frozen=True, allow_inf_nan=False)
    names: list[str]
    covariance: list[list[Number]]
    held: list[list[Number]]


class Residuals(BaseModel):
    """What was left of the observations."""

    model_config = ConfigDict(frozen=True, allow_inf_nan=False)
    dof: int
    noise: Noise
    shared_px: dict[str, Annotated[Number, Field(ge=0.0)]]


class ResultDocument(BaseModel):
    """What is needed of ``result.json``; there is more in it."""

    model_config = ConfigDict(frozen=True, allow_inf_nan=False)
    legcal_result: Version
    status: Literal["converged"]
    legs: list[str]
    parameters: Annotated[list[Row], Field(min_length=1)]
    nominal_axes: dict[str, dict[str, Axis]]
    covariance: list[list[Number]]
    kinematic: KinematicPart
    cameras: dict[str, dict[str, Number | str]]
    residuals: Residuals


def read_document(path: Path) -> ResultDocument:
    """Return what the document says.

    Raises
    ------
    DatasetError
        If it is missing, or no such document.
    """
    content = read_text(path, "result of an earlier calibration")
    try:
        found = json.loads(content)
    except (ValueError, RecursionError) as error:
        raise DatasetError(refused(path, "no JSON", "the document of a calibration")) from error
    if not isinstance(found, dict) or "legcal_result" not in found:
        what = "another document" if isinstance(found, dict) else describe(found)
        raise DatasetError(refused(path, what, "one with 'legcal_result: 1'"))
    return validate(ResultDocument, found, path)


def refused(path: Path, found: str, needed: str) -> str:
    """Return why a result could not be read."""
    return (
        f"{path}: the result of the earlier calibration could not be read: found {found}, needed "
        f"{needed}; give the folder that legcal calibrate wrote."
    )


RESULT_NAME, MODEL_NAME = "result.json", "calibrated.yaml"
_SAME = 1e-9  # [m]: rounding of files
_SYMMETRIC = 1e-6  # relative


@dataclass(frozen=True, eq=False)
class EarlierResult:
    """An earlier calibration.

    Attributes
    ----------
    folder : Path
        Where it lies.
    mechanism : Mechanism
        The calibrated model.
    names : tuple of str
        The kinematic parameters that were looked for: estimated ones, and those of which the
        calibration says nothing along some direction.
    covariance : (n, n) array
        Their covariance, zero along what was held; axes count from the calibrated ones [m, rad].
    held : (w, n) array
        How they change along the directions that were held, by a metre.
    fixed : tuple of str
        Kinematic parameters that were fixed.
    intrinsics : mapping
        (value, sigma) of intrinsics that were looked for, by name.
    cameras : mapping
        What :func:`legcal.vision.camera.camera_numbers` says of the cameras as they came, by
        the view that intrinsics are named after.
    noise : NoiseModel
        The noise of its outlines.
    shared_px : mapping
        Standard deviations of the errors that its outlines share, by what they are [px].
    dof : int
        Degrees of freedom that it is known from.
    """

    folder: Path
    mechanism: Mechanism
    names: tuple[str, ...]
    covariance: Array
    held: Array
    fixed: tuple[str, ...]
    intrinsics: Mapping[str, tuple[float, float]]
    cameras: Mapping[str, Mapping[str, float | str]]
    noise: NoiseModel
    shared_px: Mapping[str, float]
    dof: int


def read_result(given: str | Path) -> EarlierResult:
    """Return the result in a folder that ``legcal calibrate`` wrote.

    Parameters
    ----------
    given : str or Path
        The folder, or ``result.json`` in it.

    Raises
    ------
    DatasetError
        If it is no such folder, damaged, or put together from several.
    """
    path = Path(given)
    path = path if path.name == RESULT_NAME and not os.path.isdir(path) else path / RESULT_NAME
    document = read_document(path)
    try:
        mechanism = load_mechanism(path.parent / MODEL_NAME)
    except (ModelError, OutOfClass) as error:
        raise DatasetError(error.problems) from error
    if sorted(document.legs) != sorted(mechanism.leg_names):
        found = f"the legs {', '.join(document.legs)} in {RESULT_NAME}"
        needed = f"{', '.join(mechanism.leg_names)} as in {MODEL_NAME} beside it"
        raise DatasetError(refused(path, found, needed))
    return _assembled(path, document, mechanism.with_leg_order(document.legs))


def _assembled(path: Path, document: ResultDocument, mechanism: Mechanism) -> EarlierResult:
    """Return the result, its parts compared with each other."""
    rows = document.parameters
    estimated = [row for row in rows if row.status == "estimated"]
    covariance = _covariance(path, estimated, document.covariance)
    values = {row.name: row.value for row in rows}
    legs, known = geometries(mechanism), parametrization_of(mechanism, twists=True)
    nominal_legs = _with_nominal_axes(mechanism.leg_names, legs, document.nominal_axes, values)
    _check_same_model(path, document, values, mechanism, nominal_legs)
    wide, held = _kinematic(path, estimated, covariance, document.kinematic, known.names)
    turns = turns_between(known, legs, nominal_legs)
    fixed = tuple(r.name for r in rows if r.status == "fixed" and r.name in known.names)
    kept = [i for i, name in enumerate(known.names) if name not in fixed]
    _check_shared(path, document.residuals.shared_px)
    return EarlierResult(
        folder=path.parent,
        mechanism=mechanism,
        names=tuple(known.names[i] for i in kept),
        covariance=(turns @ wide @ turns.T)[np.ix_(kept, kept)],
        held=(held @ turns.T)[:, kept],
        fixed=fixed,
        intrinsics={
            row.name: (row.value, row.sigma)
            for row in estimated
            if _is_intrinsic(row.name, known.names) and row.sigma is not None
        },
        cameras=document.cameras,
        noise=NoiseModel(**document.residuals.noise.model_dump()),
        shared_px=document.residuals.shared_px,
        dof=document.residuals.dof,
    )


def _is_intrinsic(name: str, kinematic: Sequence[str]) -> bool:
    """Say whether a parameter of a result is one of a camera."""
    return name not in kinematic and name != BOARD_SCALE and ".radius." not in name


def _kinematic(
    path: Path,
    estimated: Sequence[Row],
    covariance: Array,
    found: KinematicPart,
    known: Sequence[str],
) -> tuple[Array, Array]:
    """Return covariance (p, p) and held directions (w, p) of all kinematic parameters."""
    n = len(known)
    needed = f"a covariance and held directions of the {n} kinematic parameters"
    rows = (*found.covariance, *found.held)
    if sorted(found.names) != sorted(known) or len(found.covariance) != n:
        raise DatasetError(refused(path, f"those of {len(found.names)} others", needed))
    if any(len(row) != n for row in rows):
        raise DatasetError(refused(path, "rows of other lengths", needed))
    order = [found.names.index(name) for name in known]
    wide = np.array(found.covariance)[np.ix_(order, order)]
    held = np.array(found.held).reshape(-1, n)[:, order]
    both = [i for i, row in enumerate(estimated) if row.name in known]
    at = [known.index(estimated[i].name) for i in both]
    sigma = np.sqrt(np.diagonal(covariance))[both]
    apart = (wide[np.ix_(at, at)] - covariance[np.ix_(both, both)]) / np.outer(sigma, sigma)
    if np.abs(apart).max(initial=0.0) > _SYMMETRIC or np.abs(wide - wide.T).max() > _SAME:
        raise DatasetError(refused(path, "another matrix in 'kinematic'", needed))
    return wide, held


def _check_shared(path: Path, shared_px: Mapping[str, float]) -> None:
    """Refuse sizes of shared errors that are none."""
    others = [name for name in shared_px if name not in KINDS]
    if others:
        raise DatasetError(refused(path, f"the shared errors '{others[0]}'", ", ".join(KINDS)))


def _check_same_model(
    path: Path,
    document: ResultDocument,
    values: Mapping[str, float],
    mechanism: Mechanism,
    nominal_legs: Sequence[LegGeometry],
) -> None:
    """Refuse a document whose parameters are not those of the model beside it."""
    legs, known = geometries(mechanism), parametrization_of(mechanism, twists=True)
    numbers = dict(zip(known.names, vector_of(known, legs, nominal_legs).tolist(), strict=True))
    other = [
        name
        for name, number in numbers.items()
        if "_axis." not in name and not abs(values.get(name, number) - number) <= _SAME
    ]
    other += [name for name in numbers if name not in values and not name.endswith(".twist")]
    for side, axes in nominal_axes(mechanism.leg_names, legs).items():
        for leg, axis in axes.items():
            nominal = document.nominal_axes.get(side, {}).get(leg)
            if nominal is None or not _is_axis(calibrated_axis(nominal, leg, side, values), axis):
                other.append(f"the {side} axis of {leg}")
    if other:
        found = f"other values of {', '.join(other[:3])}" + " and more" * (len(other) > 3)
        raise DatasetError(refused(path, found, f"those of {MODEL_NAME} beside it"))


def _with_nominal_axes(
    names: Sequence[str],
    legs: Sequence[LegGeometry],
    axes: Mapping[str, Axes],
    values: Mapping[str, float],
) -> tuple[LegGeometry, ...]:
    """Return legs with the axes and twists that the parameters of a document count from."""
    base, platform = (
        {name: np.array(axis) for name, axis in axes.get(side, {}).items()}
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


def _is_axis(found: Array, axis: Sequence[float]) -> bool:
    """Say whether an axis, a line, is another."""
    return bool(np.linalg.norm(np.cross(found, axis)) < _SAME)


def _covariance(path: Path, estimated: Sequence[Row], found: list[list[Any]]) -> Array:
    """Return the covariance, refused where it is none of the estimated parameters."""
    n = len(estimated)
    needed = f"a covariance of the {n} estimated parameters that fits their sigmas"
    if n == 0 or len(found) != n or any(len(row) != n for row in found):
        shape = f"{len(found)} rows of {len(found[0]) if found else 0} numbers"
        raise DatasetError(refused(path, shape, needed))
    covariance = np.array(found)
    sigma = np.array([row.sigma or 0.0 for row in estimated])
    scaled = covariance / np.maximum(np.outer(sigma, sigma), 1e-300)
    good = (
        bool(np.all(sigma > 0.0))
        and bool(np.abs(scaled - scaled.T).max() < _SYMMETRIC)
        and bool(np.abs(np.diagonal(scaled) - 1.0).max() < _SYMMETRIC)
        and bool(np.linalg.eigvalsh(scaled)[0] > -_SYMMETRIC)
    )
    if not good:
        raise DatasetError(refused(path, "another matrix", needed))
    return covariance
