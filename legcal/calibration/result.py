"""The result of a calibration: what was found, its document, and what people see of it."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

import numpy as np
from scipy.spatial.transform import RigidTransform

from legcal.brief import brief
from legcal.calibration.diagnosis.diagnosis import Diagnosis
from legcal.calibration.documents import (
    AxisInLink,
    BoardPose,
    CoordinateStatus,
    Distance,
    DoubtBlock,
    FrameMark,
    Gamma,
    Holdout,
    JointInLink,
    Kinematic,
    LinkBlock,
    NoSteps,
    Observations,
    Overlay,
    ParameterRow,
    PlatformBlock,
    PlatformBoardPose,
    PoseAccuracy,
    ResidualsBlock,
    Result,
    SensitivityRow,
    Staged,
    Stages,
    ViewPose,
    WeakCombination,
    WeakInLinks,
    WorkspaceAccuracy,
    left_out_blocks,
)
from legcal.calibration.doubts import Doubt
from legcal.calibration.four_steps import Steps
from legcal.calibration.joint_fit.held_out import Posterior
from legcal.calibration.joint_fit.parameter_choices import board_scale, known_parameters
from legcal.calibration.joint_fit.platform import PlatformAccuracy, PlatformError, poses_at_readings
from legcal.calibration.joint_fit.scale import single_witness
from legcal.calibration.joint_fit.solution import Solution
from legcal.calibration.only import GroupEstimate
from legcal.calibration.summary import Summarised, few_lines
from legcal.data.corners import Corners
from legcal.data.dataset import Dataset
from legcal.data.image_tables import canonical_order
from legcal.data.measurements import row_names
from legcal.data.outlines import Outlines
from legcal.files.motions import Pose
from legcal.geometry.lines import normal_basis, turned_axis
from legcal.geometry.types import Array, BoolArray, IntArray
from legcal.machine.inspection import ActuatorBlock
from legcal.machine.kinematics import pose_differences
from legcal.machine.leg import Leg, LegColumns, LegKind
from legcal.machine.model import Machine
from legcal.machine.parameters import (
    SHOWN,
    describe_direction,
    free_coordinates,
    geometries,
    nominal_axes,
    parametrization_of,
    vector_of,
)
from legcal.machine.rods import actuators_of
from legcal.perception.diagnostics import images_left_out
from legcal.vision.board import LINKS, Link
from legcal.vision.camera import camera_numbers, shared_cameras

REFUSED = "Do not load this into the controller"  # how the sentence begins where a doubt is grave


@dataclass(frozen=True)
class Verdict:
    """Whether the calibrated model should replace the nominal one."""

    doubts: tuple[Doubt, ...]  # what speaks against it, the worst first
    sentence: str  # the verdict for people
    remedy: str = ""  # what would tell more than further images, as a sentence goes on

    @property
    def trustworthy(self) -> bool:
        """Whether nothing speaks against it: the improvement is larger than two sigma as well."""
        return not self.doubts

    @property
    def is_to_be_refused(self) -> bool:
        """Whether it is not to be loaded into a controller: a doubt is grave."""
        return any(doubt.is_grave for doubt in self.doubts)


@brief
@dataclass(frozen=True, eq=False)
class OutlineResiduals:
    """Residuals of the outlines in the fit, including those it rejected."""

    index: IntArray  # (n,): rows of the table of outlines
    # (n, 2): distance of each end from the predicted outline, common-mode edge biases removed [px]
    offset: Array
    whitened: Array  # (n, 2): the same, uncorrelated and in standard deviations

    def __len__(self) -> int:
        return len(self.index)


def outline_residuals(
    posterior: Posterior, dataset: Dataset, outlines: Outlines
) -> OutlineResiduals:
    """Return the residuals of a fit to *outlines* of a *dataset*, in file order."""
    problem = posterior.problem
    offset = problem.offsets(posterior.state)
    covariance = posterior.noise.covariance(problem.outlines.covariance)
    L = np.linalg.cholesky(covariance) if len(offset) else covariance
    whitened = np.linalg.solve(L, offset[..., None])[..., 0]
    # The fit numbers outlines as they stand in canonical order.
    order = canonical_order(dataset.measurements, dataset.machine.leg_names)
    numbered = replace(outlines, contrast=np.arange(len(outlines), dtype=np.float64))
    number = order.reorder(numbered).contrast.astype(np.intp)
    index = number[problem.outlines.index]
    back = np.argsort(index, kind="stable")
    return OutlineResiduals(index[back], offset[back], whitened[back])


@dataclass(frozen=True, eq=False)
class Calibration(Summarised):
    """The result of :func:`legcal.calibrate`, in the order of the files.

    Attributes
    ----------
    dataset : Dataset
        What it was computed from; its ``machine`` is the nominal model.
    solution : Solution
        The joint fit: parameters, covariance, cameras, platform poses, radii.
    steps : Steps
        What the four steps gave.
    platform : PlatformAccuracy or None
        What the platform of the calibrated model does differently, and how well that is known;
        None where the motors do not determine its pose.
    verdict : Verdict
        Whether to use it.
    notes : tuple of str
        What else a reader should know.
    held_out : Holdout or None
        How well the fit predicts the held-out images; None without any.
    corners : Corners or None
        The corners of the calibration board in all images; None without a board.
    diagnosis : tuple of Diagnosis
        What looks wrong with the session, the likeliest first; empty where nothing does.
    overlays : dict
        The overlays beside the result, relative to its folder, by row of the measurements.
    group : GroupEstimate or None
        The zeros, the lengths or all parts, with tolerances as priors; None where not asked for.
    """

    dataset: Dataset
    solution: Solution
    steps: Steps
    platform: PlatformAccuracy | None
    verdict: Verdict
    notes: tuple[str, ...]
    held_out: Holdout | None = None
    corners: Corners | None = None
    diagnosis: tuple[Diagnosis, ...] = ()
    overlays: Mapping[int, str] = field(default_factory=dict)
    group: GroupEstimate | None = None

    @property
    def doubts(self) -> tuple[Doubt, ...]:
        """What speaks against the result, the worst first; empty where it is trusted."""
        return self.verdict.doubts

    @cached_property
    def result(self) -> Result:
        """The document of ``result.json``."""
        return _result_of(self)

    @cached_property
    def residuals(self) -> OutlineResiduals:
        """How far each outline is from the fit."""
        solution = self.solution
        return outline_residuals(solution.posterior, self.dataset, solution.outlines)

    def __repr__(self) -> str:
        return few_lines(f"Calibration of '{self.dataset.machine.name}'", self.result)


def _result_of(calibration: Calibration) -> Result:
    """Return the document of a calibration."""
    solution, dataset = calibration.solution, calibration.dataset
    machine, measurements = dataset.machine, dataset.measurements
    names, views = machine.leg_names, measurements.views
    owners = shared_cameras([view.name for view in views], [view.camera for view in views])
    rows, corners = solution.outlines.row[solution.outlines.used], calibration.corners
    if corners is not None:
        rows = np.concatenate([rows, corners.row[corners.used]])
    shown = np.unique(measurements.view[rows]).tolist()
    cameras = solution.cameras_in_base(machine.T_base_Rb)
    parameters = _parameters(calibration)
    kinematic = Kinematic(
        names=list(solution.kinematic.parametrization.names),
        covariance=solution.kinematic.value_covariance.tolist(),
        held=solution.kinematic.held_basis.tolist(),
    )
    on_base, on_platform = (_board(calibration, link) for link in LINKS)
    nominal, witness = geometries(machine), single_witness(solution.posterior.problem)
    turned_from = nominal_axes(names, nominal)
    return Result(
        legcal_result=1,
        status="converged",
        verdict=calibration.verdict.sentence,
        trustworthy=calibration.verdict.trustworthy,
        doubts=[DoubtBlock.model_validate(doubt) for doubt in calibration.doubts],
        legs=list(names),
        **_legs(names, solution.legs),
        nominal_axes=turned_from,
        nominal_actuators=_actuators(nominal),
        parameters=parameters,
        covariance=solution.estimates.covariance.tolist(),
        kinematic=kinematic,
        links=joints_in_links(machine, parameters, kinematic, turned_from),
        weakest=[
            WeakCombination(
                direction=describe_direction([name for name, _ in weak.parts], names),
                parameters=[name for name, _ in weak.parts],
                components=[component for _, component in weak.parts],
                sigma_m=weak.sigma,
                links=weak_in_links(machine, weak.parts),
            )
            for weak in solution.estimates.weak
        ],
        held=list(solution.kinematic.held),
        views={views[v].name: ViewPose(T_base_camera=Pose.of(cameras[v])) for v in shown},
        cameras={v.name: camera_numbers(v.camera) for v in views if v.name in set(owners)},
        gammas=[
            Gamma(views=list(one.views), gamma=one.gamma, sigma=one.gamma * one.sigma)
            for one in solution.gammas
        ],
        stages=Stages(staged=_staged(calibration)),
        residuals=ResidualsBlock.model_validate(solution.quality),
        observations=_observations(calibration),
        board=None if on_base is None else BoardPose.model_validate(on_base),
        platform_board=(
            None if on_platform is None else PlatformBoardPose.model_validate(on_platform)
        ),
        start=solution.start,
        platform=_platform(calibration),
        holdout=calibration.held_out,
        notes=list(calibration.notes),
        details=list(filter(None, [witness, *calibration.solution.details])),
        diagnosis=[one.document() for one in calibration.diagnosis] or None,
        only=None if calibration.group is None else calibration.group.group,
        zeros=None if calibration.group is None else calibration.group.zeros,
        overlays=_overlays(calibration),
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
        "actuators": _actuators(legs),
    }


def _actuators(legs: Sequence[Leg]) -> dict[str, ActuatorBlock] | None:
    """Return what moves joints at A, by joint; None where nothing does."""
    found = actuators_of(legs)
    return {one.joint: ActuatorBlock.model_validate(one.document()) for one in found} or None


def _parameters(calibration: Calibration) -> list[ParameterRow]:
    """Return all kinematic parameters, the radii that were observed, and estimated intrinsics."""
    found, dataset = calibration.solution.estimates, calibration.dataset
    machine = dataset.machine
    kinematic = parametrization_of(machine, twists=True)
    numbers = vector_of(kinematic, calibration.solution.legs, geometries(machine)).tolist()
    values = {**found.values, **dict(zip(kinematic.names, numbers, strict=True))}
    sigma = dict(zip(found.names, found.sigma.tolist(), strict=True))
    known = known_parameters(machine, dataset.measurements.views, boards=dataset.boards).by_name
    return [
        ParameterRow(
            name=name,
            value=values[name],
            nominal=parameter.nominal,
            sigma=sigma.get(name),
            prior_sigma=found.prior_sigma.get(name),
            unit=parameter.unit,
            status=found.status.get(name, "fixed"),
        )
        for name, parameter in known.items()
        if name in values
    ]


def _staged(calibration: Calibration) -> Staged | NoSteps:
    """Return what the four steps gave, and how far it is from the fit."""
    steps, machine = calibration.steps, calibration.dataset.machine
    if steps.legs is None:
        return NoSteps(failure=steps.failure)
    from_fit = None
    if calibration.platform is not None:
        measurements = calibration.dataset.measurements
        near, q = calibration.solution.T_Rb_Re, measurements.q_of_poses
        displacement, rotation = pose_differences(
            poses_at_readings(machine, steps.legs, q, near),
            poses_at_readings(machine, calibration.solution.legs, q, near),
        )
        from_fit = Distance(dX_m=displacement.mean(), dE_rad=rotation.mean())
    return Staged(
        **_legs(machine.leg_names, steps.legs),
        diagnostics=list(steps.diagnostics),
        from_fit=from_fit,
    )


def _observations(calibration: Calibration) -> Observations:
    """Return what the fit was made from."""
    outlines = calibration.solution.outlines
    reasons = Counter(
        str(why.reason)
        for why, used in zip(outlines.reason, outlines.used, strict=True)
        if not used
    )
    return Observations(
        used=int(outlines.used.sum()),
        total=len(outlines),
        images=calibration.dataset.measurements.n_rows,
        rejected=dict(reasons.most_common()),
        left_out=left_out_blocks(calibration.dataset.measurements, images_left_out(outlines)),
    )


def _overlays(calibration: Calibration) -> list[Overlay] | None:
    """Return where each image is drawn with its outlines; None without overlays."""
    measurements = calibration.dataset.measurements
    views, names = [view.name for view in measurements.views], row_names(measurements)
    return [
        Overlay(view=views[measurements.view[row]], image=names[row], file=file)
        for row, file in calibration.overlays.items()
    ] or None


def _board(calibration: Calibration, link: Link) -> dict[str, Any] | None:
    """Return where the board on a link is, which differs from the dataset by where R_b, R_e are."""
    solution, dataset, corners = calibration.solution, calibration.dataset, calibration.corners
    fixed, T_frame_board = dataset.board_on(link), solution.T_frame_board.get(link)
    if fixed is None or T_frame_board is None or corners is None:
        return None
    T_link_board = dataset.machine.T_link_frame(link) * T_frame_board
    given = fixed.T_link_board
    off = None
    if given is not None:
        apart = given.inv() * T_link_board
        turn = float(apart.rotation.magnitude())
        off = Distance(dX_m=float(np.linalg.norm(apart.translation)), dE_rad=turn)
    own = corners.choose(fixed.has(corners.corner))
    numbers: dict[str, Any] = {
        f"T_{link}_board": Pose.of(T_link_board),
        "given": None if given is None else Pose.of(given),
        "scale": solution.estimates.values.get(board_scale(link), 1.0),
        "rms_px": solution.quality.rms_corners_px.get(link),
        "corners": len(own),
        "used": int(own.used.sum()),
        "images": len(np.unique(own.row[own.used])),
        "off": off,
    }
    return numbers


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
            SensitivityRow(what=what, **_errors(error)) for what, error in platform.effects.items()
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


# Joints in the links of the model
#
# Results are computed in R_b and R_e; users know the links. The calibrated R_b is aligned with the
# nominal one in the base link and R_e likewise in the platform link, as in ``calibrated.urdf``:
# p_link = T_link_frame p_frame, with the covariance R C R^T. Coordinates that define a frame have
# no uncertainty there: their variance is zero, and they are marked.


_MARKS: tuple[FrameMark, ...] = ("origin", "x axis", "xy plane")
_STATUSES: tuple[CoordinateStatus, ...] = ("weak", "estimated", "fixed", "frame")
_ROUNDING = 1e-9  # rounding of the components of unit vectors


@dataclass(frozen=True, eq=False)
class _LinkFrame:
    """R_b in the base link, or R_e in the platform link, with the joints of that side."""

    side: Link
    link: str
    T_link_frame: RigidTransform
    points: Array  # (n_legs, 3): joint centres in the frame [m]
    place: IntArray  # (n_legs, 3): indices of the coordinates among kinematic parameters, or -1
    names: tuple[str, ...]  # names of the kinematic parameters
    legs: tuple[str, ...]
    frame_legs: tuple[int, ...]
    zero: BoolArray  # (n_legs, 3): whether the definition of the frame makes a coordinate zero
    axes: tuple[Array | None, ...]  # joint axes of the legs in the frame; None without one
    turns: IntArray  # (n_legs, 2): indices of the axis rotations among kinematic parameters, or -1

    @classmethod
    def of(cls, machine: Machine, side: Link) -> _LinkFrame:
        """Return the frame of one side of a machine."""
        parametrization, legs = parametrization_of(machine, twists=True), geometries(machine)
        is_base = side == "base"
        n_d = len(machine.frame_legs)
        zero = ~free_coordinates(machine.n_legs, machine.frame_legs)
        zero[:, n_d:] = False  # heights of planar machines are fixed, and define nothing
        return cls(
            side,
            machine.base if is_base else machine.platform,
            machine.T_link_frame(side),
            np.array([leg.A if is_base else leg.B for leg in legs]),
            parametrization.place[:, LegColumns.A if is_base else LegColumns.B],
            parametrization.names,
            machine.leg_names,
            machine.frame_legs,
            zero,
            tuple(leg.base_axis if is_base else leg.platform_axis for leg in legs),
            parametrization.place[:, LegColumns.BASE_AXIS if is_base else LegColumns.PLATFORM_AXIS],
        )

    @property
    def R(self) -> Array:
        """Rotation (3, 3) from the frame to the link."""
        return np.asarray(self.T_link_frame.rotation.as_matrix())

    def points_with(self, values: Mapping[str, float]) -> Array:
        """Return the joint centres (n_legs, 3) in the link at given parameter values [m]."""
        points = self.points.copy()
        for index in np.argwhere(self.place >= 0).tolist():
            name = self.names[self.place[tuple(index)]]
            points[tuple(index)] = values.get(name, points[tuple(index)])
        return np.asarray(self.T_link_frame.apply(points))

    def defines(self, leg: int) -> FrameMark | None:
        """Return the part of the frame that a joint defines."""
        return _MARKS[self.frame_legs.index(leg)] if leg in self.frame_legs else None

    def named(self, indices: IntArray) -> list[str]:
        """Return the names of parameters by index; "" for -1."""
        return [self.names[k] if k >= 0 else "" for k in indices.tolist()]

    def turned(self, leg: int, w: Array) -> Array:
        """Return two turns of an axis (2,) as a rotation vector in the link [rad]."""
        axis = self.axes[leg]
        return np.zeros(3) if axis is None else np.asarray(self.R @ (w @ normal_basis(axis)))

    def statuses(self, leg: int, status: Mapping[str, str]) -> list[CoordinateStatus]:
        """Return the status of each coordinate of a joint in the link, by its parameters."""
        statuses: list[CoordinateStatus] = []
        for row in self.R:
            parts = {
                "frame" if is_zero else "fixed" if k < 0 else status.get(self.names[k], "fixed")
                for k, is_zero, part in zip(self.place[leg], self.zero[leg], row, strict=True)
                if abs(part) > _ROUNDING
            }
            statuses.append(next(possible for possible in _STATUSES if possible in parts))
        return statuses


def joints_in_links(
    machine: Machine,
    parameters: Sequence[ParameterRow],
    kinematic: Kinematic,
    axes: Mapping[str, Mapping[str, Sequence[float]]] | None = None,
) -> dict[Link, LinkBlock]:
    """Return the joints of a calibration in the links of base and platform.

    Parameters
    ----------
    machine : Machine
        The nominal or the calibrated model; R_b and R_e in the links are the same.
    parameters : sequence of ParameterRow
        Parameters of ``result.json``, in R_b and R_e [m].
    kinematic : Kinematic
        The covariance of all kinematic parameters by name, zero for fixed or held ones.
    axes : mapping, optional
        The nominal axes by side and leg, in R_b and R_e; axes are returned only if given.

    Returns
    -------
    dict
        A :class:`LinkBlock` for ``base`` and ``platform`` [m]; joints in the order of the legs.
    """
    rows = {row.name: row for row in parameters}
    status = {name: row.status for name, row in rows.items()}
    number = {name: k for k, name in enumerate(kinematic.names)}
    everything = np.array(kinematic.covariance)
    blocks: dict[Link, LinkBlock] = {}
    for side in LINKS:
        frame = _LinkFrame.of(machine, side)
        nominal = frame.points_with({name: row.nominal for name, row in rows.items()})
        calibrated = frame.points_with({name: row.value for name, row in rows.items()})
        joints = []
        for j, leg in enumerate(frame.legs):
            names = frame.named(frame.place[j])
            numbered = [i for i, name in enumerate(names) if name in number]
            indices = [number[names[i]] for i in numbered]
            C = np.zeros((3, 3))
            C[np.ix_(numbered, numbered)] = everything[np.ix_(indices, indices)]
            C = frame.R @ C @ frame.R.T
            statuses = frame.statuses(j, status)
            sigma = np.sqrt(np.maximum(np.diagonal(C), 0.0)).tolist()
            joints.append(
                JointInLink(
                    leg=leg,
                    xyz=calibrated[j].tolist(),
                    nominal=nominal[j].tolist(),
                    sigma=[
                        s if coordinate_status == "estimated" else None
                        for s, coordinate_status in zip(sigma, statuses, strict=True)
                    ],
                    covariance=(0.5 * (C + C.T)).tolist(),
                    status=statuses,
                    defines=frame.defines(j),
                )
            )
        blocks[side] = LinkBlock(
            link=frame.link,
            T_link_frame=Pose.of(frame.T_link_frame),
            joints=joints,
            axes=_axes_in_link(frame, (axes or {}).get(side, {}), rows, number, everything),
        )
    return blocks


def _axes_in_link(
    frame: _LinkFrame,
    nominal: Mapping[str, Sequence[float]],
    rows: Mapping[str, ParameterRow],
    number: Mapping[str, int],
    C: Array,
) -> list[AxisInLink]:
    """Return the axes of joints, with C the covariance of the numbered parameters."""
    axes = []
    for j, leg in enumerate(frame.legs):
        names = frame.named(frame.turns[j])
        if leg not in nominal or not all(names):
            continue
        axis = np.array(nominal[leg])
        turns = normal_basis(axis) @ frame.R.T  # (2, 3) unit turns in the link
        w = np.array([rows[name].value if name in rows else 0.0 for name in names])
        sigma = None
        if all(name in rows and rows[name].status == "estimated" for name in names):
            indices = [number[name] for name in names]
            variance = np.einsum("ki,kl,li->i", turns, C[np.ix_(indices, indices)], turns)
            sigma = np.sqrt(np.maximum(variance, 0.0)).tolist()
        axes.append(
            AxisInLink(
                leg=leg,
                direction=(frame.R @ turned_axis(axis, w)).tolist(),
                nominal=(frame.R @ axis).tolist(),
                turn=(w @ turns).tolist(),
                sigma=sigma,
            )
        )
    return axes


def weak_in_links(machine: Machine, parts: Sequence[tuple[str, float]]) -> WeakInLinks:
    """Return a combination of parameters with joints and axes in link coordinates.

    ``parts`` are names and components of a vector in R_b and R_e; other parameters stay.
    """
    component, named_parts = dict(parts), dict[str, float]()
    for side in LINKS:
        frame = _LinkFrame.of(machine, side)
        for j, leg in enumerate(frame.legs):
            for kind, names in (
                (side, frame.named(frame.place[j])),
                (f"{side}_axis", frame.named(frame.turns[j])),
            ):
                in_frame = np.array([component.pop(name, 0.0) for name in names])
                v = frame.R @ in_frame if kind == side else frame.turned(j, in_frame)
                named_parts |= {
                    f"{leg}.{kind}.{axis}": float(x) for axis, x in zip("xyz", v, strict=True)
                }
    named_parts |= component
    largest = max(map(abs, named_parts.values()), default=0.0)
    significant = {name: x for name, x in named_parts.items() if abs(x) > SHOWN * largest}
    return WeakInLinks(
        direction=describe_direction(list(significant), machine.leg_names),
        parameters=list(significant),
        components=list(significant.values()),
    )
