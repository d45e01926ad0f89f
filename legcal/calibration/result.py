"""The result folder: what a controller and a script read, written and read back by one model.

:class:`Result` is ``result.json``: its fields are the keys, in their order, and the schema by which
an earlier result is read (formats, section 4).
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import (
    Field,
    SerializerFunctionWrapHandler,
    StrictFloat,
    StrictInt,
    StrictStr,
    model_serializer,
)
from scipy.spatial.transform import RigidTransform

from legcal.calibration.joint_fit import BOARD_SCALE, PlatformError, known_parameters
from legcal.calibration.verdict import Calibration
from legcal.data import CORNERS_NAME, OBSERVATIONS_NAME, write_corners, write_observations
from legcal.errors import DatasetError, DidNotConverge
from legcal.files import (
    Document,
    Number,
    Version,
    describe,
    motion_to_xyz_quat,
    read_text,
    result_folder,
    validate,
)
from legcal.machine import (
    Leg,
    LegKind,
    describe_direction,
    geometries,
    home_with,
    nominal_axes,
    parametrization_of,
    reload_and_check,
    vector_of,
    write_calibrated_yaml,
    write_urdf,
)
from legcal.vision import camera_numbers, shared_cameras

RESULT_NAME, MODEL_NAME = "result.json", "calibrated.yaml"
_RELOADED = 1e-11  # how far reloaded parameters may be from the written ones [m, rad]
_FURTHEST = 0.2  # of a leg length, by which the nominal home may miss what calibrated legs demand

Vector = Annotated[list[Number], Field(min_length=3, max_length=3)]
Axes = dict[str, Vector]  # unit vectors by leg
Matrix = list[list[Number]]
Positive = Annotated[Number, Field(gt=0.0)]
NotNegative = Annotated[Number, Field(ge=0.0)]


class Pose(Document):
    """A rigid motion."""

    xyz: Vector
    quat_xyzw: Annotated[list[Number], Field(min_length=4, max_length=4)]


class Legs(Document):
    """The legs in R_b and R_e [m, rad]."""

    base_joints: list[Vector]
    platform_joints: list[Vector]
    offsets: list[Number | None]  # the length of a constant leg, null for a passive one
    base_axes: Axes  # of axes that are parameters
    platform_axes: Axes
    twists: dict[str, Number]


class ParameterRow(Document):
    """One parameter."""

    name: str
    value: Number  # [unit]; axes are turns of the nominal ones
    nominal: Number  # in the model or camera file
    sigma: Positive | None  # None where it was not estimated
    unit: str  # m, rad, px, or nothing for coefficients of distortion
    status: Literal["estimated", "fixed", "weak"]  # weak: part of a direction that is held


class Kinematic(Document):
    """What is known of all kinematic parameters."""

    names: list[str]
    covariance: Matrix  # zero where they are fixed and along what is held
    held: Matrix  # how they change along each held direction, by a metre


class WeakCombination(Document):
    """A combination of parameters that is known badly."""

    direction: str
    parameters: list[str]
    components: list[Number]
    sigma_m: Number


class ViewPlace(Document):
    """Where the camera of a view stands."""

    T_base_camera: Pose


class Gamma(Document):
    """The gamma that outlines show of a camera."""

    views: list[str]
    gamma: Number
    sigma: Number


class Staged(Legs):
    """What the four steps gave."""

    diagnostics: list[str]


class NoSteps(Document):
    """Why the four steps gave nothing."""

    failure: str


class Stages(Document):
    """What single parts of the method gave."""

    staged: Staged | NoSteps


class Noise(Document):
    """The noise of the outlines."""

    scale: Positive
    bias_px: NotNegative
    tilt_px: NotNegative


class Residuals(Document):
    """What was left of the observations."""

    chi2: Number
    dof: int
    rms_px: Number | None
    rms_axes: Number | None
    noise: Noise
    shared_px: dict[str, NotNegative]


class BoardPlace(Document):
    """Where the calibration board stands, R_b laid on the nominal one."""

    T_base_board: Pose
    given: Pose | None
    scale: Number
    rms_px: Number | None


class PoseAccuracy(Document):
    """Change and predicted error at one pose."""

    pose: str | None
    images: list[str]
    change_dX_m: Number
    change_dE_rad: Number
    sigma_dX_m: Number
    sigma_dE_rad: Number


class WorkspaceAccuracy(Document):
    """The predicted error all over the travel."""

    poses: int
    sigma_dX_m: Number
    sigma_dE_rad: Number
    sigma_dX_max_m: Number
    sigma_dE_max_rad: Number


class SensitivityRow(Document):
    """What an error in what counts as known would do to the platform."""

    what: str
    dX_m: Number
    dE_rad: Number
    dX_max_m: Number
    dE_max_rad: Number


class PlatformBlock(Document):
    """Change and predicted error of the platform, means and maxima over poses."""

    poses: int
    change_dX_m: Number
    change_dE_rad: Number
    sigma_dX_m: Number
    sigma_dE_rad: Number
    sigma_dX_max_m: Number
    sigma_dE_max_rad: Number
    per_pose: list[PoseAccuracy]
    workspace: WorkspaceAccuracy | None
    sensitivities: list[SensitivityRow]


class HoldoutPlatform(Document):
    """The pose by readings against that by an image alone, root mean squares."""

    poses: int
    dX_m: Number
    expected_dX_m: Number
    dE_rad: Number
    expected_dE_rad: Number


class Holdout(Document):
    """What the images that were kept aside say of the fit."""

    images: int
    poses: int
    outlines: int
    wrong: int
    rms_px: Number | None
    expected_px: Number | None
    views: dict[str, Number]
    platform: HoldoutPlatform | None


class Result(Document):
    """``result.json``."""

    legcal_result: Version
    status: Literal["converged"]
    verdict: str
    trustworthy: bool
    legs: list[str]  # the order of what follows
    base_joints: list[Vector]
    platform_joints: list[Vector]
    offsets: list[Number | None]
    base_axes: Axes
    platform_axes: Axes
    twists: dict[str, Number]
    nominal_axes: dict[str, Axes]  # that turns count from, by side
    parameters: Annotated[list[ParameterRow], Field(min_length=1)]
    covariance: Matrix  # of the estimated parameters, in their order
    kinematic: Kinematic
    weakest: list[WeakCombination]
    held: list[str]
    views: dict[str, ViewPlace]
    cameras: dict[str, dict[str, StrictInt | StrictFloat | StrictStr]]  # as they came
    gammas: list[Gamma]
    stages: Stages
    residuals: Residuals
    board: BoardPlace | None = None  # left out without a board
    start: str
    platform: PlatformBlock | None
    holdout: Holdout | None = None  # left out without images that were kept aside
    notes: list[str]

    @model_serializer(mode="wrap")
    def _without_absent_blocks(self, handler: SerializerFunctionWrapHandler) -> dict[str, Any]:
        found: dict[str, Any] = handler(self)
        absent = [key for key in ("board", "holdout") if found[key] is None]
        return {key: value for key, value in found.items() if key not in absent}

    @classmethod
    def read(cls, path: Path) -> Result:
        """Return the result in a file.

        Raises
        ------
        DatasetError
            If it is missing, or no such document.
        """
        content = read_text(path, "result of an earlier calibration")
        try:
            found = json.loads(content)
        except (ValueError, RecursionError) as error:
            raise refused(path, "no JSON", "the document of a calibration") from error
        if not isinstance(found, dict) or "legcal_result" not in found:
            what = "another document" if isinstance(found, dict) else describe(found)
            raise refused(path, what, "one with 'legcal_result: 1'")
        return validate(cls, found, path)


def refused(path: Path, found: str, needed: str) -> DatasetError:
    """Return why a result could not be read."""
    return DatasetError(
        f"{path}: the result of the earlier calibration could not be read: found {found}, needed "
        f"{needed}; give the folder that legcal calibrate wrote."
    )


def result_of(calibration: Calibration) -> Result:
    """Return the document of a calibration."""
    solution, dataset = calibration.solution, calibration.dataset
    machine, measurements = dataset.machine, dataset.measurements
    names, views, steps = machine.leg_names, measurements.views, calibration.steps
    owners = shared_cameras([view.name for view in views], [view.camera for view in views])
    o, axes = solution.outlines, dataset.axes
    shown = np.unique(measurements.view[o.row[o.used] if axes is None else axes.row]).tolist()
    T_base_Rb = machine.T_base_Rb
    return Result(
        legcal_result=1,
        status="converged",
        verdict=calibration.verdict.sentence,
        trustworthy=calibration.verdict.trustworthy,
        legs=list(names),
        **_legs(names, solution.legs),
        nominal_axes=nominal_axes(names, geometries(machine)),
        parameters=_parameters(calibration),
        covariance=solution.covariance.tolist(),
        kinematic=Kinematic(
            names=list(solution.parametrization.names),
            covariance=solution.value_covariance.tolist(),
            held=solution.held_basis.tolist(),
        ),
        weakest=[
            WeakCombination(
                direction=describe_direction([name for name, _ in weak.parts], names),
                parameters=[name for name, _ in weak.parts],
                components=[component for _, component in weak.parts],
                sigma_m=weak.sigma,
            )
            for weak in solution.weak
        ],
        held=list(solution.held),
        views={
            views[v].name: ViewPlace(T_base_camera=_pose(T_base_Rb * solution.T_camera_Rb[v].inv()))
            for v in shown
        },
        cameras={v.name: camera_numbers(v.camera) for v in views if v.name in set(owners)},
        gammas=[
            Gamma(views=list(one.views), gamma=one.gamma, sigma=one.gamma * one.sigma)
            for one in solution.gammas
        ],
        stages=Stages(
            staged=NoSteps(failure=steps.failure)
            if steps.legs is None
            else Staged(**_legs(names, steps.legs), diagnostics=list(steps.diagnostics))
        ),
        residuals=Residuals.model_validate(solution),
        board=_board(calibration),
        start=solution.start,
        platform=_platform(calibration),
        holdout=_holdout(calibration),
        notes=list(calibration.notes),
    )


def _legs(names: Sequence[str], legs: Sequence[Leg]) -> dict[str, Any]:
    """Return the fields of :class:`Legs`."""
    named = list(zip(names, legs, strict=True))
    return {
        "base_joints": [leg.A.tolist() for leg in legs],
        "platform_joints": [leg.B.tolist() for leg in legs],
        "offsets": [None if leg.kind is LegKind.PASSIVE else leg.q0 for leg in legs],
        "base_axes": {n: leg.base_axis.tolist() for n, leg in named if leg.base_axis is not None},
        "platform_axes": {
            n: leg.platform_axis.tolist() for n, leg in named if leg.platform_axis is not None
        },
        "twists": {name: leg.twist for name, leg in named if leg.twist is not None},
    }


def _pose(T: RigidTransform) -> Pose:
    return Pose(**motion_to_xyz_quat(T))


def _parameters(calibration: Calibration) -> list[ParameterRow]:
    """Return all kinematic parameters, the radii that were observed, and estimated intrinsics."""
    solution, dataset = calibration.solution, calibration.dataset
    machine = dataset.machine
    found = parametrization_of(machine, twists=True)
    numbers = vector_of(found, solution.legs, geometries(machine)).tolist()
    values = {**solution.values, **dict(zip(found.names, numbers, strict=True))}
    sigma = dict(zip(solution.names, solution.sigma.tolist(), strict=True))
    with_board = dataset.board is not None
    known = known_parameters(machine, dataset.measurements.views, with_board=with_board).by_name
    return [
        ParameterRow(
            name=name,
            value=values[name],
            nominal=parameter.nominal,
            sigma=sigma.get(name),
            unit=parameter.unit,
            status=solution.status.get(name, "fixed"),
        )
        for name, parameter in known.items()
        if name in values
    ]


def _board(calibration: Calibration) -> BoardPlace | None:
    """Return where the board stands, which differs from what the dataset says by where R_b is."""
    solution, dataset = calibration.solution, calibration.dataset
    if solution.T_Rb_board is None:
        return None
    given = dataset.T_base_board
    return BoardPlace(
        T_base_board=_pose(dataset.machine.T_base_Rb * solution.T_Rb_board),
        given=None if given is None else _pose(given),
        scale=solution.values.get(BOARD_SCALE, 1.0),
        rms_px=solution.rms_corners_px,
    )


def _platform(calibration: Calibration) -> PlatformBlock | None:
    """Return what all this means at the platform."""
    platform, measurements = calibration.platform, calibration.dataset.measurements
    if platform is None:
        return None
    labels = measurements.pose_labels or ("",) * measurements.n_poses
    images: list[list[str]] = [[] for _ in labels]
    for pose, image in zip(measurements.pose.tolist(), measurements.image, strict=True):
        if image:
            images[pose].append(image)
    change, sigma, workspace = platform.change, platform.sigma, platform.workspace
    return PlatformBlock(
        change_dX_m=change.mean_displacement,
        change_dE_rad=change.mean_rotation,
        **_predicted(sigma),
        per_pose=[
            PoseAccuracy(
                pose=label or None,
                images=images[k],
                change_dX_m=change.displacement[k],
                change_dE_rad=change.rotation[k],
                sigma_dX_m=sigma.displacement[k],
                sigma_dE_rad=sigma.rotation[k],
            )
            for k, label in enumerate(labels)
        ],
        workspace=None if workspace is None else WorkspaceAccuracy(**_predicted(workspace)),
        sensitivities=[
            SensitivityRow(what=effect.what, **_errors(effect.error)) for effect in platform.effects
        ],
    )


def _errors(error: PlatformError, prefix: str = "") -> dict[str, Any]:
    """Return means and maxima of an error of the platform, as the document names them."""
    return {
        f"{prefix}dX_m": error.mean_displacement,
        f"{prefix}dE_rad": error.mean_rotation,
        f"{prefix}dX_max_m": error.max_displacement,
        f"{prefix}dE_max_rad": error.max_rotation,
    }


def _predicted(error: PlatformError) -> dict[str, Any]:
    """Return the fields of :class:`WorkspaceAccuracy`."""
    return {"poses": len(error.displacement), **_errors(error, "sigma_")}


def _holdout(calibration: Calibration) -> Holdout | None:
    """Return what images that were kept aside say."""
    held_out = calibration.held_out
    if held_out is None:
        return None
    pair = held_out.at_platform
    return Holdout(
        images=held_out.n_images,
        poses=held_out.n_poses,
        outlines=held_out.outlines,
        wrong=held_out.wrong,
        rms_px=held_out.rms_px,
        expected_px=held_out.expected_px,
        views=held_out.rms_px_of_view,
        platform=None
        if pair is None
        else HoldoutPlatform(
            poses=len(held_out.displacement),
            dX_m=pair.displacement,
            expected_dX_m=pair.expected_displacement,
            dE_rad=pair.rotation,
            expected_dE_rad=pair.expected_rotation,
        ),
    )


def write_result(calibration: Calibration, destination: Path) -> None:
    """Write the result folder, all of it or nothing.

    The calibrated model is loaded again from the files and must have the parameters that were
    written and close at home, before the folder appears.

    Raises
    ------
    UsageError
        If the destination holds something else than an earlier result.
    DidNotConverge
        If the written model does not load as what was computed.
    """
    dataset, solution = calibration.dataset, calibration.solution
    machine = dataset.machine
    stale = [Path(OBSERVATIONS_NAME), Path(CORNERS_NAME)]
    with result_folder(destination, stale=stale) as folder:
        urdf, yaml = folder / "calibrated.urdf", folder / MODEL_NAME
        write_urdf(machine, solution.legs, urdf)
        home = home_with(machine, solution.legs, _FURTHEST)
        if home is None:
            raise DidNotConverge(
                f"{machine.yaml_path}: the calibrated model could not be written: found no "
                "closed pose of its legs near legcal.home, needed one; check legcal.home and the "
                "nominal model; nothing was written."
            )
        write_calibrated_yaml(machine, yaml, urdf.name, None if home is machine.home else home)
        _check_written(yaml, solution.legs)
        document = json.dumps(result_of(calibration).document(), indent=1, allow_nan=False)
        (folder / RESULT_NAME).write_text(document + "\n", encoding="utf-8")
        if dataset.axes is None:
            table, measurements = folder / OBSERVATIONS_NAME, dataset.measurements
            write_observations(table, solution.outlines, measurements, machine.leg_names)
        if calibration.corners is not None:
            write_corners(folder / CORNERS_NAME, calibration.corners, dataset.measurements)


def _check_written(yaml: Path, legs: Sequence[Leg]) -> None:
    """Load what was written; it must be the model that was computed, and close."""
    written = reload_and_check(yaml)
    found = parametrization_of(written, twists=True)
    apart = vector_of(found, geometries(written), legs) - vector_of(found, legs, legs)
    off = float(np.abs(apart).max())
    if not off <= _RELOADED:
        raise DidNotConverge(
            f"The calibrated model could not be written: loaded again, its parameters differ by "
            f"{off:.1e} m or rad from the computed ones; at most {_RELOADED:.0e} is allowed; "
            "nothing was written; please report this."
        )
