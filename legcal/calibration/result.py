"""The result of a calibration: what was found, its document, and what people see of it."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Any

import numpy as np
from scipy.spatial.transform import RigidTransform

from legcal.brief import brief
from legcal.calibration.diagnosis import Diagnosis
from legcal.calibration.documents import (
    AxisInLink,
    BoardPose,
    CoordinateStatus,
    Distance,
    Doubt,
    FrameMark,
    Gamma,
    Holdout,
    JointInLink,
    Kinematic,
    LinkBlock,
    NoSteps,
    Observations,
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
    overlay_blocks,
)
from legcal.calibration.four_steps import Steps
from legcal.calibration.joint_fit.parameter_choices import board_scale, dataset_parameters
from legcal.calibration.joint_fit.platform import PlatformAccuracy, PlatformError, poses_at_readings
from legcal.calibration.joint_fit.scale import single_witness
from legcal.calibration.joint_fit.solution import Solution
from legcal.calibration.summary import Summarised, few_lines
from legcal.data.corners import Corners
from legcal.data.dataset import Dataset
from legcal.data.image_tables import canonical_order
from legcal.data.measurements import places
from legcal.files.motions import Pose
from legcal.geometry.lines import normal_basis, turned_axis
from legcal.geometry.types import Array, IntArray
from legcal.machine.files import RESULT_YAML
from legcal.machine.inspection import ActuatorBlock
from legcal.machine.kinematics import pose_differences
from legcal.machine.leg import LINKS, Leg, LegColumns, LegKind, Link
from legcal.machine.model import Machine
from legcal.machine.model_writer import write_calibrated
from legcal.machine.parameters import (
    SHOWN,
    describe_direction,
    geometries,
    nominal_axes,
    parametrization_of,
    vector_of,
)
from legcal.machine.rods import actuators_of
from legcal.perception.diagnostics import images_left_out
from legcal.vision.camera import camera_numbers

if TYPE_CHECKING:
    from legcal.calibration.only import GroupEstimate

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

    @property
    def legs(self) -> Sequence[Leg]:
        """The legs of the calibrated model, in R_b and R_e."""
        return self.solution.legs if self.group is None else self.group.written

    @cached_property
    def machine(self) -> Machine:
        """The calibrated model, as its folder has it: evaluate, export and kinematics take it."""
        with TemporaryDirectory() as folder:
            nominal = self.dataset.machine
            written = write_calibrated(nominal, self.legs, Path(folder) / RESULT_YAML)
        return written.with_leg_order(nominal.leg_names)

    @cached_property
    def result(self) -> Result:
        """The document of ``result.json``."""
        return _result_of(self)

    @cached_property
    def residuals(self) -> OutlineResiduals:
        """How far each outline is from the fit, in the order of the table."""
        posterior, outlines = self.solution.posterior, self.solution.outlines
        problem = posterior.problem
        offset = problem.offsets(posterior.state)
        covariance = posterior.noise.covariance(problem.outlines.covariance)
        L = np.linalg.cholesky(covariance) if len(offset) else covariance
        whitened = np.linalg.solve(L, offset[..., None])[..., 0]
        # The fit numbers outlines as they stand in canonical order
        order = canonical_order(self.dataset.measurements, self.dataset.machine.leg_names)
        numbered = replace(outlines, contrast=np.arange(len(outlines), dtype=np.float64))
        index = order.reorder(numbered).contrast.astype(np.intp)[problem.outlines.index]
        back = np.argsort(index, kind="stable")
        return OutlineResiduals(index[back], offset[back], whitened[back])

    def __repr__(self) -> str:
        return few_lines(f"Calibration of '{self.dataset.machine.name}'", self.result)


def _result_of(calibration: Calibration) -> Result:
    """Return the document of a calibration."""
    solution, dataset = calibration.solution, calibration.dataset
    machine, measurements = dataset.machine, dataset.measurements
    names, views = machine.leg_names, measurements.views
    owners = measurements.owners
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
        doubts=list(calibration.doubts),
        legs=list(names),
        **_legs(names, solution.legs),
        nominal_axes=turned_from,
        nominal_actuators=_actuators(nominal),
        parameters=parameters,
        covariance=solution.estimates.covariance.tolist(),
        kinematic=kinematic,
        links=joints_in_links(machine, parameters, kinematic),
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
        diagnosis=list(calibration.diagnosis) or None,
        only=None if calibration.group is None else calibration.group.group,
        zeros=None if calibration.group is None else calibration.group.zeros,
        overlays=overlay_blocks(places(measurements), calibration.overlays) or None,
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
        for name, parameter in dataset_parameters(dataset).by_name.items()
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
    outlines, measurements = calibration.solution.outlines, calibration.dataset.measurements
    reasons = Counter(
        str(why.reason)
        for why, used in zip(outlines.reason, outlines.used, strict=True)
        if not used
    )
    return Observations(
        used=int(outlines.used.sum()),
        total=len(outlines),
        images=measurements.n_rows,
        rejected=dict(reasons.most_common()),
        left_out=left_out_blocks(places(measurements), images_left_out(outlines)),
    )


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
            SensitivityRow(what=what, **error.fields()) for what, error in platform.effects.items()
        ],
    )


def _predicted(error: PlatformError) -> dict[str, Any]:
    """Return the fields of :class:`WorkspaceAccuracy`."""
    return {"poses": len(error.displacement), **error.fields("sigma_")}


# Joints in the links of the model
#
# Results are computed in R_b and R_e; users know the links. The calibrated R_b is aligned with the
# nominal one in the base link and R_e likewise in the platform link, as in ``calibrated.urdf``. A
# joint centre in its link and the turn of an axis are linear in the parameters, with the covariance
# J C J^T. Coordinates that define a frame have no uncertainty there: their variance is zero, and
# they are marked.


_MARKS: tuple[FrameMark, ...] = ("origin", "x axis", "xy plane")
_STATUSES: tuple[CoordinateStatus, ...] = ("weak", "estimated", "fixed", "frame")
_ROUNDING = 1e-9  # rounding of the components of unit vectors


@dataclass(frozen=True, eq=False)
class _LinkVector:
    """A joint centre in a link, or the turn of an axis from its nominal direction there."""

    leg: int
    nominal: Array  # (3,) the centre [m], or the direction of the axis, in R_b or R_e
    is_axis: bool
    names: tuple[str, ...]  # n parameters in R_b or R_e; "" for a number that is none
    by: Array  # (3, n) derivative of x, y, z in the link by these


def _in_link(machine: Machine, side: Link) -> Iterator[_LinkVector]:
    """Yield the joint centre of each leg and, if it has one, its axis."""
    parametrization = parametrization_of(machine, twists=True)
    R = machine.T_link_frame(side).rotation.as_matrix()  # from R_b or R_e to the link
    centre, axis = LegColumns.A, LegColumns.BASE_AXIS
    if side == "platform":
        centre, axis = LegColumns.B, LegColumns.PLATFORM_AXIS
    named = (*parametrization.names, "")  # the last one is number -1
    for j, (leg, place) in enumerate(zip(geometries(machine), parametrization.place, strict=True)):
        point, direction = (leg.A, leg.base_axis) if side == "base" else (leg.B, leg.platform_axis)
        yield _LinkVector(j, point, False, tuple(named[k] for k in place[centre]), R)
        if direction is not None:
            by_turns = R @ normal_basis(direction).T
            yield _LinkVector(j, direction, True, tuple(named[k] for k in place[axis]), by_turns)


def joints_in_links(
    machine: Machine,  # the nominal model
    parameters: Sequence[ParameterRow],  # in R_b and R_e [m]
    kinematic: Kinematic,  # with the covariance of all, zero for fixed or held ones
) -> dict[Link, LinkBlock]:
    """Return the joints of a calibration in the links of base and platform, in leg order [m]."""
    rows = {row.name: row for row in parameters}
    number = {name: k for k, name in enumerate(kinematic.names)}
    everything = np.array(kinematic.covariance)
    blocks: dict[Link, LinkBlock] = {}
    for side in LINKS:
        T, joints, axes = machine.T_link_frame(side), list[JointInLink](), list[AxisInLink]()
        for vector in _in_link(machine, side):
            known = [i for i, name in enumerate(vector.names) if name in number]
            indices = [number[vector.names[i]] for i in known]
            C = everything[np.ix_(indices, indices)]
            C = vector.by[:, known] @ C @ vector.by[:, known].T
            if not vector.is_axis:
                joints.append(_joint(machine, T, vector, rows, C))
            elif all(vector.names):
                axes.append(_axis(machine, T, vector, rows, C))
        link = machine.base if side == "base" else machine.platform
        blocks[side] = LinkBlock(link=link, T_link_frame=Pose.of(T), joints=joints, axes=axes)
    return blocks


def _joint(
    machine: Machine,
    T_link_frame: RigidTransform,
    centre: _LinkVector,
    rows: Mapping[str, ParameterRow],
    C: Array,
) -> JointInLink:
    """Return a joint centre with its covariance C (3, 3)."""
    nominal, calibrated = centre.nominal.copy(), centre.nominal.copy()
    n_d, rank = len(machine.frame_legs), 3
    if centre.leg in machine.frame_legs:  # zero from its rank on; heights in a plane define nothing
        rank = machine.frame_legs.index(centre.leg)
    of_numbers = list[str]()
    for k, row in enumerate(rows.get(name) for name in centre.names):
        if row is not None:
            nominal[k], calibrated[k] = row.nominal, row.value
        of_numbers.append("frame" if rank <= k < n_d else "fixed" if row is None else row.status)
    statuses: list[CoordinateStatus] = []
    for by in centre.by:
        parts = {of for of, part in zip(of_numbers, by, strict=True) if abs(part) > _ROUNDING}
        statuses.append(next(possible for possible in _STATUSES if possible in parts))
    sigma = zip(_sigma(C), statuses, strict=True)
    return JointInLink(
        leg=machine.leg_names[centre.leg],
        xyz=T_link_frame.apply(calibrated).tolist(),
        nominal=T_link_frame.apply(nominal).tolist(),
        sigma=[s if status == "estimated" else None for s, status in sigma],
        covariance=(0.5 * (C + C.T)).tolist(),
        status=statuses,
        defines=_MARKS[rank] if rank < n_d else None,
    )


def _axis(
    machine: Machine,
    T_link_frame: RigidTransform,
    axis: _LinkVector,
    rows: Mapping[str, ParameterRow],
    C: Array,
) -> AxisInLink:
    """Return an axis with the covariance C (3, 3) of its turn."""
    turns = [rows.get(name) for name in axis.names]
    w = np.array([0.0 if row is None else row.value for row in turns])
    is_estimated = all(row is not None and row.status == "estimated" for row in turns)
    return AxisInLink(
        leg=machine.leg_names[axis.leg],
        direction=T_link_frame.rotation.apply(turned_axis(axis.nominal, w)).tolist(),
        nominal=T_link_frame.rotation.apply(axis.nominal).tolist(),
        turn=(axis.by @ w).tolist(),
        sigma=_sigma(C) if is_estimated else None,
    )


def _sigma(C: Array) -> list[float]:
    """Return the standard deviations of x, y, z."""
    sigma: list[float] = np.sqrt(np.maximum(np.diagonal(C), 0.0)).tolist()
    return sigma


def weak_in_links(machine: Machine, parts: Sequence[tuple[str, float]]) -> WeakInLinks:
    """Return a combination of parameters with joints and axes in link coordinates.

    ``parts`` are names and components of a vector in R_b and R_e; other parameters stay.
    """
    component, named_parts = dict(parts), dict[str, float]()
    for side in LINKS:
        for vector in _in_link(machine, side):
            name = f"{machine.leg_names[vector.leg]}.{side}{'_axis' * vector.is_axis}"
            v = vector.by @ [component.pop(parameter, 0.0) for parameter in vector.names]
            named_parts |= {f"{name}.{xyz}": x for xyz, x in zip("xyz", v.tolist(), strict=True)}
    named_parts |= component
    largest = max(map(abs, named_parts.values()), default=0.0)
    significant = {name: x for name, x in named_parts.items() if abs(x) > SHOWN * largest}
    return WeakInLinks(
        direction=describe_direction(list(significant), machine.leg_names),
        parameters=list(significant),
        components=list(significant.values()),
    )
