"""The joint fit linearised at predicted observations, and its information.

Variables are platform poses, cameras, parameters and lines of arms; factors are images and the
equations of readings and legs, linearised at the nominal machine. Unknowns are in metres (angles
times the mean leg length) and rows are whitened, so that a singular value is the inverse of a
standard deviation [1/m]. Radii and intrinsics are optional further variables.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from legcal.calibration.identify.predicted_observations import (
    SIGMA_PX,
    Across,
    PredictedObservations,
    at_base_joints,
    at_platform_joints,
)
from legcal.calibration.identify.report import CameraIntrinsics
from legcal.calibration.joint_fit.parameter_choices import Choices, joints_of_length
from legcal.calibration.joint_fit.problem import arm_sigmas
from legcal.calibration.joint_fit.variables import RefinementSettings
from legcal.estimation.problem import (
    NO_PRIOR,
    EstimationProblem,
    Factor,
    GaussianPrior,
    Residuals,
    Variables,
    all_free,
)
from legcal.estimation.square_root import information_rows, marginal_rows
from legcal.geometry.lines import cross, normal_basis
from legcal.geometry.types import Array, IntArray
from legcal.machine.actuator import ActuatorColumns
from legcal.machine.equations import freedoms, pose_equations
from legcal.machine.leg import LegColumns
from legcal.machine.parameter_id import ARMS, ParameterId
from legcal.machine.parameters import is_held_by_default, parametrize

INTRINSICS = ("fx", "fy", "cx", "cy")
_MAX_INTRINSICS_SIGMA = 0.1  # focal lengths: above, intrinsics are not determined
_WHOLE = slice(None)  # all coordinates of a variable
_BOARD = 0.5  # half side of a board on the platform, over the spread of its joints
_OPEN = 0.05  # least component of an intrinsic in an open direction


@dataclass(frozen=True, eq=False)
class _Nominal:
    """Deviations from the nominal machine, all of them zero."""

    parameters: Array
    camera: Array
    pose: Array
    platform_board: Array
    arm: Array = field(default_factory=lambda: np.zeros(0))
    radius: Array = field(default_factory=lambda: np.zeros(0))
    intrinsics: Array = field(default_factory=lambda: np.zeros(0))


@dataclass(frozen=True, eq=False)
class WhitenedEquations:
    """The whitened equations of all legs at the poses of a session."""

    # (k, m, f): by the degrees of freedom of the platform: rotations [m at the leg's length] and
    # displacements, then by readings of actuators, in metres
    by_pose: Array
    by_parameters: Array  # (k, m, p): by the parameters in metres

    def at(self, poses: IntArray) -> WhitenedEquations:
        """Select the equations of poses."""
        return replace(self, by_pose=self.by_pose[poses], by_parameters=self.by_parameters[poses])


def whitened_leg_equations(predicted: PredictedObservations) -> WhitenedEquations:
    """Return the whitened equations of readings and legs at the poses of a session."""
    actuators, n_poses = predicted.actuators, len(predicted.t)
    q = predicted.q if actuators else None
    equations = pose_equations(predicted.legs, predicted.R, predicted.t, q=q)
    # Readings of actuators are separate rows
    is_reading = equations.measured & (predicted.carried_by < 0)[equations.leg]
    sigma = np.where(is_reading, predicted.sigma_of_legs[equations.leg], predicted.sigma_exact)[
        :, None
    ]
    columns = list(freedoms(predicted.frame_legs))
    by_pose = (equations.by_pose / sigma * pose_unit(predicted))[:, :, columns]
    by_parameters = equations.by_parameters(predicted.parametrization) / sigma * predicted.unit
    if actuators:  # their positions are unknowns at each pose, with a measured reading each
        unit, n = predicted.unit_of_q, len(actuators)
        first = by_pose.shape[2]
        by_pose = np.concatenate([by_pose, equations.by_q / sigma * unit], axis=2)
        rows = np.zeros((n_poses, n, by_pose.shape[2]))
        rows[:, :, first : first + n] = np.diag(unit / predicted.sigma_of_q)
        by_pose = np.concatenate([by_pose, rows], axis=1)
        zeros = np.zeros((n_poses, n, by_parameters.shape[2]))
        by_parameters = np.concatenate([by_parameters, zeros], axis=1)
    return WhitenedEquations(by_pose, by_parameters)


def image_rows(predicted: PredictedObservations) -> Array:
    """Return whitened derivatives (n_images, n_bodies, 4, f + 6 + p) of the measured bodies.

    Columns are the motion of the platform, the readings of actuators, the motion of the camera, and
    the parameters.
    """
    base, platform = at_base_joints(predicted), at_platform_joints(predicted)
    turns = pose_unit(predicted)
    by_camera = np.concatenate([base.by_camera(), platform.by_camera()], axis=2) * turns
    n = predicted.n_legs
    at_A, at_B = base.gradient[:, :n], platform.gradient[:, :n]
    turn = cross(predicted.arm[predicted.pose][:, :, None], at_B)
    by_pose = np.zeros_like(by_camera)
    by_pose[:, :n, 2:] = np.concatenate([turn, at_B], axis=3) * turns
    scatter = predicted.local_to_parameters
    in_platform = at_B @ predicted.R[predicted.pose][:, None]
    A_by_parameters, B_by_parameters = at_A @ scatter[:, :3], in_platform @ scatter[:, 3:6]
    columns = list(freedoms(predicted.frame_legs))
    by_pose = by_pose[..., columns]
    if predicted.actuators:
        A_by_parameters = at_A @ (predicted.A_by_local @ scatter)[predicted.pose]
        ends = zip((base, platform), predicted.ends_by_reading, strict=True)
        by_reading = [end.gradient @ by_numbers[predicted.pose] for end, by_numbers in ends]
        by_pose = np.concatenate([by_pose, np.concatenate(by_reading, axis=2)], axis=3)
    by_parameters = np.concatenate([A_by_parameters, B_by_parameters], axis=2)
    if predicted.arms:
        by_numbers = predicted.arms_by_local @ scatter[list(predicted.arms)][:, None]
        of_arms = _arm_rows(predicted, by_numbers)
        by_parameters = np.concatenate([by_parameters, of_arms], axis=1)
    return np.concatenate([by_pose, by_camera, by_parameters], axis=3)


def _arm_rows(predicted: PredictedObservations, by_ends: Array) -> Array:
    """Whitened derivatives (n_images, n_arms, 4, d) from those of both ends (k, ..., 3, d)."""
    n, by_ends = predicted.n_legs, by_ends[predicted.pose]
    ends = at_base_joints(predicted), at_platform_joints(predicted)
    return np.concatenate(
        [e.gradient[:, n:] @ by_ends[:, :, k] for k, e in enumerate(ends)], axis=2
    )


def _line_unit(predicted: PredictedObservations) -> Array:
    """Equivalent of a metre in the unit of each coordinate of the line of an arm, (4,)."""
    return np.repeat([1.0 / predicted.mean_length, 1.0], 2)


def pose_unit(predicted: PredictedObservations) -> Array:
    """Return the equivalent of a metre for the six coordinates of a motion [rad, m]."""
    return np.repeat([1.0 / predicted.mean_length, 1.0], 3)


def prior_of(predicted: PredictedObservations, choices: Choices) -> GaussianPrior:
    """Return the prior of the parameters; fixed ones have a negligible standard deviation."""
    sigma: dict[int, float] = {}
    for i, name in enumerate(predicted.parametrization.names):
        is_arm = ParameterId.parse(name).kind in ARMS  # in :func:`prior_of_arms`
        if name in choices.priors and not is_arm:
            sigma[i] = choices.priors[name].sigma
        elif is_arm or choices.holds(name, by_default=is_held_by_default(name)):
            sigma[i] = predicted.sigma_exact * predicted.unit[i]
    index, values = np.array(list(sigma), dtype=np.intp), np.array(list(sigma.values()))
    return GaussianPrior(index, np.zeros(len(sigma)), values)


def prior_of_arms(
    predicted: PredictedObservations, choices: Choices, *, stated: bool = False
) -> GaussianPrior:
    """Return the prior of the lines of arms, four coordinates each; *stated*: without defaults."""
    parametrization = parametrize(
        predicted.leg_names, predicted.legs, predicted.frame_legs, twists=True
    )
    sigmas, unit = (
        arm_sigmas(parametrization, predicted.legs, predicted.arms),
        _line_unit(predicted),
    )
    sigma_of = {}
    for i, (name, sigma) in enumerate(sigmas.items()):
        if name in choices.priors:
            sigma_of[i] = choices.priors[name].sigma / unit[i % 4]
        elif name in choices.fixed:
            sigma_of[i] = predicted.sigma_exact
        elif name not in choices.free and not stated:
            sigma_of[i] = sigma / unit[i % 4]
    index = np.array(list(sigma_of), dtype=np.intp)
    return GaussianPrior(index, np.zeros(len(index)), np.array(list(sigma_of.values())))


def length_rows(predicted: PredictedObservations, choices: Choices) -> Array:
    """Return whitened derivatives (n, p) of measured distances of joints by the parameters."""
    rows, names = [np.zeros((0, len(predicted.unit)))], predicted.leg_names
    scatter = predicted.local_to_parameters
    for name, prior in choices.priors.items():
        joints = joints_of_length(name)
        if joints is None:
            continue
        (first, side), (second, _) = joints
        j, k = names.index(first), names.index(second)
        columns = LegColumns.A if side == "base" else LegColumns.B
        points = [leg.A if side == "base" else leg.B for leg in predicted.legs]
        u = points[j] - points[k]
        u /= np.linalg.norm(u)
        rows.append((u @ (scatter[j, columns] - scatter[k, columns]) / prior.sigma)[None])
    return np.concatenate(rows)


def session_problem(
    predicted: PredictedObservations,
    images: Array,  # of image_rows
    equations: WhitenedEquations,
    prior: GaussianPrior,
    more: Sequence[tuple[Variables, IntArray, Array]] = (),  # see below
    lengths: Array | None = None,  # of length_rows
    arms: GaussianPrior = NO_PRIOR,  # of prior_of_arms
) -> tuple[EstimationProblem[_Nominal], _Nominal]:
    """Return the problem of a session and the state where it is linearised.

    Views of a board on the base share one camera frame, that of the board. A board on the platform
    has its own factor. *more* are further variables of images: for each, the element that each body
    in each image depends on (n_images, n_bodies), and derivatives (n_images, n_bodies, 4, d).
    """
    if predicted.arms:
        more = (*more, _arm_lines(predicted, arms))
    on_platform = _platform_board_factor(predicted)
    n_f, n_p, n_poses = predicted.n_motions, len(predicted.unit), len(predicted.t)
    parameters = Variables(
        "parameters",
        all_free(1, n_p),
        labels=predicted.parametrization.names,
        units=predicted.parametrization.units,
        coordinates=lambda x: x * predicted.unit,
        jacobian=lambda x: np.diag(predicted.unit),
        prior=prior,
    )
    problem = EstimationProblem[_Nominal](
        variables=(
            parameters,
            Variables("camera", all_free(predicted.n_frames, 6)),
            Variables("platform_board", all_free(int(bool(on_platform)), 6)),
            *(variables for variables, _, _ in more),
        ),
        eliminated=Variables("pose", all_free(n_poses, n_f)),
        factors=(
            _image_factor(predicted, images, more),
            _leg_factor(equations, n_poses),
            _tie_factor(predicted, lengths),
            *on_platform,
        ),
    )
    zeros = {b.name: np.zeros(b.n_unknowns) for b in problem.variables}
    return problem, _Nominal(pose=np.zeros((n_poses, n_f)), **zeros)


def _image_factor(
    predicted: PredictedObservations,
    images: Array,
    more: Sequence[tuple[Variables, IntArray, Array]],
) -> Factor[_Nominal]:
    """Build the factor of bodies in images."""
    n_f, (n_images, n_bodies) = predicted.n_motions, images.shape[:2]
    n = n_images * n_bodies
    J = np.concatenate([images[..., n_f:], *(by for _, _, by in more)], axis=3).reshape(n, 4, -1)
    residuals = Residuals.of(np.zeros((n, 4)), J, images[..., :n_f].reshape(n, 4, n_f))
    touches = (
        ("camera", np.repeat(predicted.frame[predicted.view], n_bodies), _WHOLE),
        ("parameters", np.zeros(n, dtype=np.intp), _WHOLE),
        *((variables.name, element.ravel(), _WHOLE) for variables, element, _ in more),
    )
    return Factor("images", lambda _: residuals, touches, n, 4, np.repeat(predicted.pose, n_bodies))


def _leg_factor(equations: WhitenedEquations, n_poses: int) -> Factor[_Nominal]:
    """Build the factor of the equations of legs and readings."""
    m = equations.by_pose.shape[1]
    residuals = Residuals.of(np.zeros((n_poses, m)), equations.by_parameters, equations.by_pose)
    touches = (("parameters", np.zeros(n_poses, dtype=np.intp), _WHOLE),)
    return Factor("legs", lambda _: residuals, touches, n_poses, m, np.arange(n_poses))


def _tie_factor(predicted: PredictedObservations, lengths: Array | None) -> Factor[_Nominal]:
    """Build the factor of ties between parameters, and of measured lengths."""
    ties = predicted.ties[None] / predicted.sigma_exact
    if lengths is not None:
        ties = np.concatenate([ties, lengths[None]], axis=1)
    residuals = Residuals.of(np.zeros(ties.shape[:2]), ties)
    touches = (("parameters", np.zeros(1, dtype=np.intp), _WHOLE),)
    return Factor("ties", lambda _: residuals, touches, 1, ties.shape[1])


def _arm_lines(
    predicted: PredictedObservations, prior: GaussianPrior
) -> tuple[Variables, IntArray, Array]:
    """Lines of arms as further variables of :func:`session_problem`."""
    n_images, n, n_arms = len(predicted.view), predicted.n_legs, len(predicted.arms)
    by_line = np.zeros((n_images, predicted.n_bodies, 4, 4))
    slopes = predicted.arms_by_local[..., ActuatorColumns.ARM] * _line_unit(predicted)
    by_line[:, n:] = _arm_rows(predicted, slopes)
    arm = np.maximum(np.arange(predicted.n_bodies) - n, 0)  # no derivative for legs
    element = np.broadcast_to(arm, (n_images, predicted.n_bodies))
    return Variables("arm", all_free(n_arms, 4), prior=prior), element, by_line


def _platform_board_factor(predicted: PredictedObservations) -> tuple[Factor[_Nominal], ...]:
    """Build the factor of a board on the platform, if any, from its outer corners.

    The board is centred on the platform joints, its pose is unknown, and corners have the standard
    deviation of outlines.
    """
    image = np.flatnonzero(predicted.platform_board)
    if not len(image):
        return ()
    B = np.array([leg.B for leg in predicted.legs])
    middle = B.mean(axis=0)
    _, spread, axes = np.linalg.svd(B - middle)
    half = _BOARD * float(spread[0]) / np.sqrt(len(B))
    corners = middle + half * np.array([[1, 1], [1, -1], [-1, -1], [-1, 1]]) @ axes[:2]
    view, pose = (np.repeat(x[image], len(corners)) for x in (predicted.view, predicted.pose))
    R, on_platform = predicted.R[pose], np.tile(corners, (len(image), 1))
    arm = np.einsum("nij,nj->ni", R, on_platform)
    corner_points = arm + predicted.t[pose]
    ray = corner_points - predicted.camera[view]
    depth = np.linalg.norm(ray, axis=1)
    across = np.array([normal_basis(u) for u in ray / depth[:, None]])  # (n, 2, 3)
    by_corner = across * (predicted.focal[view] / (SIGMA_PX * depth))[:, None, None]
    turns, by_y = pose_unit(predicted), by_corner @ R

    def moved(point: Array, by_point: Array) -> Array:
        """Return derivatives by a rotation about the origin and a displacement."""
        return np.concatenate([cross(point[:, None], by_point), by_point], axis=2) * turns

    columns, board = (
        list(freedoms(predicted.frame_legs)),
        np.zeros(len(corner_points), dtype=np.intp),
    )
    by_readings = np.zeros((*by_corner.shape[:2], len(predicted.actuators)))
    residuals = Residuals.of(
        np.zeros(by_corner.shape[:2]),
        np.concatenate([moved(corner_points, by_corner), moved(on_platform, by_y)], axis=2),
        np.concatenate([moved(arm, by_corner)[..., columns], by_readings], axis=2),
    )
    touches = (
        ("camera", predicted.frame[view], _WHOLE),
        ("platform_board", board, _WHOLE),
    )
    return (Factor("platform_board", lambda _: residuals, touches, len(corner_points), 2, pose),)


def expected_intrinsics(
    predicted: PredictedObservations,
    images: Array,  # of image_rows
    equations: WhitenedEquations,
    prior: GaussianPrior,
    orientation: Array,  # (n_views, 3, 3): R of every camera in R_b, its optical axis last
    # (n_views): the camera of every view; views of one camera share intrinsics
    owners: Sequence[str],
    arms: GaussianPrior = NO_PRIOR,  # of prior_of_arms
) -> tuple[CameraIntrinsics, ...]:
    """Return the expected uncertainty of intrinsics, estimated jointly with all other unknowns."""
    cameras = tuple(dict.fromkeys(owners))
    of_view = np.array([cameras.index(owner) for owner in owners], dtype=np.intp)
    n, n_cameras = predicted.n_bodies, len(cameras)
    by_radius, by_intrinsics = _radii_and_intrinsics(predicted, orientation)
    sigma_radius = RefinementSettings.radius_sigma * predicted.body_radius
    prior_of_radii = GaussianPrior(np.arange(n), np.zeros(n), sigma_radius)
    body = np.broadcast_to(np.arange(n), images.shape[:2])
    camera = np.broadcast_to(of_view[predicted.view][:, None], images.shape[:2])
    intrinsics = Variables("intrinsics", all_free(n_cameras, len(INTRINSICS)))
    problem, state = session_problem(
        predicted,
        images,
        equations,
        prior,
        (
            (Variables("radius", all_free(n, 1), prior=prior_of_radii), body, by_radius),
            (intrinsics, camera, by_intrinsics),
        ),
        arms=arms,
    )
    rows = marginal_rows(information_rows(problem, state), problem.where("intrinsics"))
    _, singular, basis = np.linalg.svd(rows)
    # A metre of an intrinsic is the focal length over the mean leg length, in pixels.
    is_determined = singular > 1.0 / (_MAX_INTRINSICS_SIGMA * predicted.mean_length)
    spread = np.sqrt(np.sum((basis[is_determined].T / singular[is_determined]) ** 2, axis=1))
    is_open = np.sqrt(np.sum(basis[~is_determined] ** 2, axis=0)) > _OPEN
    first = np.unique(of_view, return_index=True)[1]
    pixels_per_metre = predicted.focal[first] / predicted.mean_length  # of each camera [px]
    sigma = spread.reshape(n_cameras, -1) * pixels_per_metre[:, None]
    return tuple(
        CameraIntrinsics(
            camera,
            not any(opens),
            {n: None if o else s for n, s, o in zip(INTRINSICS, sigmas, opens, strict=True)},
        )
        for camera, sigmas, opens in zip(
            cameras, sigma.tolist(), is_open.reshape(sigma.shape).tolist(), strict=True
        )
    )


def _radii_and_intrinsics(
    predicted: PredictedObservations, orientation: Array
) -> tuple[Array, Array]:
    """Return derivatives (n_images, n_bodies, 4, d) of bodies by radii and intrinsics."""
    shape = len(predicted.view), predicted.n_bodies, 4
    by_radius, by_intrinsics = np.zeros((*shape, 1)), np.zeros((*shape, len(INTRINSICS)))
    unit = (predicted.focal / predicted.mean_length)[predicted.view][:, None, None, None]
    for k, across in enumerate((at_base_joints(predicted), at_platform_joints(predicted))):
        lateral, widening = intrinsics_changes(predicted, across, orientation)
        sigma_lateral, towards = _edge_weights(predicted, across)
        rows = [lateral / sigma_lateral[..., None], widening * towards[..., None]]
        by_intrinsics[:, :, 2 * k : 2 * k + 2] = np.stack(rows, 2) * unit
        by_radius[:, :, 2 * k + 1, 0] = towards / predicted.body_radius
    by_radius[~predicted.shown] = by_intrinsics[~predicted.shown] = 0.0
    return by_radius, by_intrinsics


def radius_rows(predicted: PredictedObservations) -> Array:
    """Return derivatives (..., 4, 1) of measured bodies by their radius [1/m].

    A thicker body looks nearer, such that scaling the scene with cameras and radii changes no
    image.
    """
    by_radius = np.zeros((len(predicted.view), predicted.n_bodies, 4, 1))
    for k, across in enumerate((at_base_joints(predicted), at_platform_joints(predicted))):
        ray = across.point - predicted.camera[predicted.view][:, None]
        towards = -np.sum(across.gradient[:, :, 1] * ray, axis=2)
        by_radius[:, :, 2 * k + 1, 0] = towards / predicted.body_radius
    return by_radius


def intrinsics_changes(
    predicted: PredictedObservations, across: Across, orientation: Array
) -> tuple[Array, Array]:
    """Return the effects of one pixel of each intrinsic, both (n_images, n_bodies, 4).

    The lateral shift of the axis of a body [m/px], and its relative change of width [1/px].
    """
    R = orientation[predicted.view]
    in_camera = (
        across.point - predicted.camera[predicted.view][:, None]
    ) @ R  # in the camera frame
    lateral = across.gradient[:, :, 0] @ R
    lateral /= np.maximum(np.linalg.norm(lateral, axis=2), 1e-300)[..., None]
    focal = predicted.focal[predicted.view][:, None, None]
    depth = np.maximum(in_camera[..., 2:], 1e-6 * predicted.mean_length)
    xy = in_camera[..., :2] / depth
    u = predicted.body_u[predicted.pose] @ R
    along, imaged = (focal / depth * (d[..., :2] - d[..., 2:] * xy) for d in (u, lateral))  # px/m
    normal = np.stack([-along[..., 1], along[..., 0]], axis=2)
    normal /= np.maximum(np.linalg.norm(normal, axis=2, keepdims=True), 1e-300)
    pixels_per_metre = np.sum(normal * imaged, axis=2, keepdims=True)
    shift = np.concatenate([normal * xy, normal], axis=2) / np.where(
        pixels_per_metre, pixels_per_metre, 1.0
    )
    return shift, np.concatenate([normal**2 / focal, np.zeros_like(normal)], axis=2)


def _edge_weights(predicted: PredictedObservations, across: Across) -> tuple[Array, Array]:
    """Lateral standard deviation [m], and weight of the width, both (n_images, n_bodies).

    The weight is the change of depth by doubling the width, in standard deviations of depth.
    """
    lateral, depth = across.gradient[:, :, 0], across.gradient[:, :, 1]
    ray = across.point - predicted.camera[predicted.view][:, None]
    sigma = 1.0 / np.maximum(np.linalg.norm(lateral, axis=2), 1e-300)
    sign = np.sign(np.sum(depth * ray, axis=2))
    return sigma, -sign * np.linalg.norm(ray, axis=2) * np.linalg.norm(depth, axis=2)
