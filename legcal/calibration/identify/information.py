"""The problem of the joint fit at predicted observations, and what these determine.

Platform poses, cameras, parameters and lines of arms are variables; images, the equations of
readings and legs are factors, linearised at the nominal machine. Unknowns are in metres (angles
count at the mean leg length) and rows in standard deviations, so that a singular value is one over
a standard deviation [1/m]. Radii and intrinsics come as further variables where these are judged.
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
    Factor,
    GaussianPrior,
    Problem,
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
_MAX_INTRINSICS_SIGMA = 0.1  # of a focal length: what is known to no better is not determined
_WHOLE = slice(None)  # all numbers of a variable are touched
_BOARD = 0.5  # half the side of a board on the platform, of how far its joints are apart
_OPEN = 0.05  # component of an open direction from which on an intrinsic is part of it


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

    # (k, m, f): by the possible motions of the platform: turns [m at the leg's length],
    # displacements; and by readings of actuators, in metres
    by_pose: Array
    by_parameters: Array  # (k, m, p): by the parameters in metres

    def at(self, poses: IntArray) -> WhitenedEquations:
        """Return the equations at some of the poses, in that order."""
        return replace(self, by_pose=self.by_pose[poses], by_parameters=self.by_parameters[poses])


def whitened_leg_equations(predicted: PredictedObservations) -> WhitenedEquations:
    """Return what readings and legs demand of the poses of a session."""
    actuators, n_poses = predicted.actuators, len(predicted.t)
    q = predicted.q if actuators else None
    equations = pose_equations(predicted.legs, predicted.R, predicted.t, q=q)
    # The readings that move rods are rows of their own
    read = equations.measured & (predicted.carried_by < 0)[equations.leg]
    sigma = np.where(read, predicted.sigma_of_legs[equations.leg], predicted.sigma_exact)[:, None]
    columns = list(freedoms(predicted.frame_legs))
    by_pose = (equations.by_pose / sigma * pose_unit(predicted))[:, :, columns]
    by_parameters = equations.by_parameters(predicted.parametrization) / sigma * predicted.unit
    if actuators:  # what moves joints is unknown at each pose, of actuators it is measured
        unit, n = predicted.unit_of_q, len(actuators)
        first = by_pose.shape[2]
        by_pose = np.concatenate([by_pose, equations.by_q / sigma * unit], axis=2)
        rows = np.zeros((n_poses, n, by_pose.shape[2]))
        rows[:, :, first : first + n] = np.diag(unit / predicted.sigma_of_q)
        by_pose = np.concatenate([by_pose, rows], axis=1)
        none = np.zeros((n_poses, n, by_parameters.shape[2]))
        by_parameters = np.concatenate([by_parameters, none], axis=1)
    return WhitenedEquations(by_pose, by_parameters)


def image_rows(predicted: PredictedObservations) -> Array:
    """Return the whitened derivatives (n_images, n_bodies, 4, f + 6 + p) of what images show.

    They are derivatives by the motion of the platform, the readings of actuators, the motion of the
    camera, and the parameters.
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
    of_A, of_B = at_A @ scatter[:, :3], in_platform @ scatter[:, 3:6]
    columns = list(freedoms(predicted.frame_legs))
    by_pose = by_pose[..., columns]
    if predicted.actuators:
        of_A = at_A @ (predicted.A_by_local @ scatter)[predicted.pose]
        ends = zip((base, platform), predicted.ends_by_reading, strict=True)
        by_reading = [end.gradient @ by[predicted.pose] for end, by in ends]
        by_pose = np.concatenate([by_pose, np.concatenate(by_reading, axis=2)], axis=3)
    by_parameters = np.concatenate([of_A, of_B], axis=2)
    if predicted.arms:
        by = predicted.arms_by_local @ scatter[list(predicted.arms)][:, None]
        of_arms = _of_arms(predicted, by)
        by_parameters = np.concatenate([by_parameters, of_arms], axis=1)
    return np.concatenate([by_pose, by_camera, by_parameters], axis=3)


def _of_arms(predicted: PredictedObservations, by: Array) -> Array:
    """Return whitened derivatives (n_images, n_arms, 4, d) by those of both ends (k, ..., 3, d)."""
    n, by = predicted.n_legs, by[predicted.pose]
    ends = at_base_joints(predicted), at_platform_joints(predicted)
    return np.concatenate([e.gradient[:, n:] @ by[:, :, k] for k, e in enumerate(ends)], axis=2)


def _line_unit(predicted: PredictedObservations) -> Array:
    """Return a metre of each number of the line of an arm in its own unit, (4,)."""
    return np.repeat([1.0 / predicted.mean_length, 1.0], 2)


def pose_unit(predicted: PredictedObservations) -> Array:
    """Return what a metre of the six components of a motion is: turns count at the leg's length."""
    return np.repeat([1.0 / predicted.mean_length, 1.0], 3)


def prior_of(predicted: PredictedObservations, choices: Choices) -> GaussianPrior:
    """Return what is known of the parameters of a session: fixed ones, and those with priors."""
    sigma: dict[int, float] = {}
    for i, name in enumerate(predicted.parametrization.names):
        is_arm = ParameterId.parse(name).kind in ARMS  # :func:`prior_of_arms` knows of it
        if name in choices.priors and not is_arm:
            sigma[i] = choices.priors[name].sigma
        elif is_arm or choices.holds(name, by_default=is_held_by_default(name)):
            sigma[i] = predicted.sigma_exact * predicted.unit[i]
    known, values = np.array(list(sigma), dtype=np.intp), np.array(list(sigma.values()))
    return GaussianPrior(known, np.zeros(len(sigma)), values)


def prior_of_arms(
    predicted: PredictedObservations, choices: Choices, *, stated: bool = False
) -> GaussianPrior:
    """Return what is known of the lines of arms, four numbers each; *stated*: by somebody."""
    named = parametrize(predicted.leg_names, predicted.legs, predicted.frame_legs, twists=True)
    sigmas, unit = arm_sigmas(named, predicted.legs, predicted.arms), _line_unit(predicted)
    known = {}
    for i, (name, sigma) in enumerate(sigmas.items()):
        if name in choices.priors:
            known[i] = choices.priors[name].sigma / unit[i % 4]
        elif name in choices.fixed:
            known[i] = predicted.sigma_exact
        elif name not in choices.free and not stated:
            known[i] = sigma / unit[i % 4]
    of = np.array(list(known), dtype=np.intp)
    return GaussianPrior(of, np.zeros(len(of)), np.array(list(known.values())))


def length_rows(predicted: PredictedObservations, choices: Choices) -> Array:
    """Return measured distances of joints by the parameters, whitened, (n, p)."""
    rows, names = [np.zeros((0, len(predicted.unit)))], predicted.leg_names
    scatter = predicted.local_to_parameters
    for name, prior in choices.priors.items():
        joints = joints_of_length(name)
        if joints is None:
            continue
        (one, side), (other, _) = joints
        j, k = names.index(one), names.index(other)
        columns = LegColumns.A if side == "base" else LegColumns.B
        points = [leg.A if side == "base" else leg.B for leg in predicted.legs]
        u = points[j] - points[k]
        u /= np.linalg.norm(u)
        rows.append((u @ (scatter[j, columns] - scatter[k, columns]) / prior.sigma)[None])
    return np.concatenate(rows)


def problem_of(
    predicted: PredictedObservations,
    images: Array,  # of image_rows
    equations: WhitenedEquations,
    prior: GaussianPrior,
    more: Sequence[tuple[Variables, IntArray, Array]] = (),  # see below
    lengths: Array | None = None,  # of length_rows
    arms: GaussianPrior = NO_PRIOR,  # of prior_of_arms
) -> tuple[Problem[_Nominal], _Nominal]:
    """Return the problem of a session and the state that it is linearised at.

    Views that show a board on the base share one camera: that of the board. One on the platform is
    a factor of its own. *more* has variables that images depend on too: the element that each body
    in each image depends on (n_images, n_bodies), and the derivatives (n_images, n_bodies, 4, d) of
    what it shows.
    """
    if predicted.arms:
        more = (*more, _lines(predicted, arms))
    on_platform = _platform_board(predicted)
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
    problem = Problem[_Nominal](
        variables=(
            parameters,
            Variables("camera", all_free(predicted.n_frames, 6)),
            Variables("platform_board", all_free(int(bool(on_platform)), 6)),
            *(variables for variables, _, _ in more),
        ),
        eliminated=Variables("pose", all_free(n_poses, n_f)),
        factors=(
            _images(predicted, images, more),
            _legs(equations, n_poses),
            _ties(predicted, lengths),
            *on_platform,
        ),
    )
    zeros = {b.name: np.zeros(b.n_unknowns) for b in problem.variables}
    return problem, _Nominal(pose=np.zeros((n_poses, n_f)), **zeros)


def _images(
    predicted: PredictedObservations,
    images: Array,
    more: Sequence[tuple[Variables, IntArray, Array]],
) -> Factor[_Nominal]:
    """Return the factor of what images show of bodies."""
    n_f, (n_images, n_bodies) = predicted.n_motions, images.shape[:2]
    n = n_images * n_bodies
    J = np.concatenate([images[..., n_f:], *(by for _, _, by in more)], axis=3).reshape(n, 4, -1)
    shown = Residuals.of(np.zeros((n, 4)), J, images[..., :n_f].reshape(n, 4, n_f))
    touches = (
        ("camera", np.repeat(predicted.frame[predicted.view], n_bodies), _WHOLE),
        ("parameters", np.zeros(n, dtype=np.intp), _WHOLE),
        *((variables.name, element.ravel(), _WHOLE) for variables, element, _ in more),
    )
    return Factor("images", lambda _: shown, touches, n, 4, np.repeat(predicted.pose, n_bodies))


def _legs(equations: WhitenedEquations, n_poses: int) -> Factor[_Nominal]:
    """Return the factor of what legs demand of poses, readings among it."""
    m = equations.by_pose.shape[1]
    demanded = Residuals.of(np.zeros((n_poses, m)), equations.by_parameters, equations.by_pose)
    touches = (("parameters", np.zeros(n_poses, dtype=np.intp), _WHOLE),)
    return Factor("legs", lambda _: demanded, touches, n_poses, m, np.arange(n_poses))


def _ties(predicted: PredictedObservations, lengths: Array | None) -> Factor[_Nominal]:
    """Return the factor of what ties parameters to each other, and of measured lengths."""
    ties = predicted.ties[None] / predicted.sigma_exact
    if lengths is not None:
        ties = np.concatenate([ties, lengths[None]], axis=1)
    tied = Residuals.of(np.zeros(ties.shape[:2]), ties)
    touches = (("parameters", np.zeros(1, dtype=np.intp), _WHOLE),)
    return Factor("ties", lambda _: tied, touches, 1, ties.shape[1])


def _lines(
    predicted: PredictedObservations, prior: GaussianPrior
) -> tuple[Variables, IntArray, Array]:
    """Return the lines of arms as further variables of :func:`problem_of`."""
    n_images, n, n_arms = len(predicted.view), predicted.n_legs, len(predicted.arms)
    by_line = np.zeros((n_images, predicted.n_bodies, 4, 4))
    slopes = predicted.arms_by_local[..., ActuatorColumns.ARM] * _line_unit(predicted)
    by_line[:, n:] = _of_arms(predicted, slopes)
    arm = np.maximum(np.arange(predicted.n_bodies) - n, 0)  # legs depend on none
    element = np.broadcast_to(arm, (n_images, predicted.n_bodies))
    return Variables("arm", all_free(n_arms, 4), prior=prior), element, by_line


def _platform_board(predicted: PredictedObservations) -> tuple[Factor[_Nominal], ...]:
    """Return the factor of the outer corners of a board on the platform; none if there is none.

    It lies among the joints of the platform, where it is fixed is unknown, and corners are seen as
    well as an outline.
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
    R, y = predicted.R[pose], np.tile(corners, (len(image), 1))
    arm = np.einsum("nij,nj->ni", R, y)
    place = arm + predicted.t[pose]
    ray = place - predicted.camera[view]
    depth = np.linalg.norm(ray, axis=1)
    across = np.array([normal_basis(u) for u in ray / depth[:, None]])  # (n, 2, 3)
    by_place = across * (predicted.focal[view] / (SIGMA_PX * depth))[:, None, None]
    turns, by_y = pose_unit(predicted), by_place @ R

    def moved(at: Array, by: Array) -> Array:
        """Return derivatives by a turn about the origin and a displacement."""
        return np.concatenate([cross(at[:, None], by), by], axis=2) * turns

    columns, one = list(freedoms(predicted.frame_legs)), np.zeros(len(place), dtype=np.intp)
    none = np.zeros((*by_place.shape[:2], len(predicted.actuators)))
    shown = Residuals.of(
        np.zeros(by_place.shape[:2]),
        np.concatenate([moved(place, by_place), moved(y, by_y)], axis=2),
        np.concatenate([moved(arm, by_place)[..., columns], none], axis=2),
    )
    touches = (
        ("camera", predicted.frame[view], _WHOLE),
        ("platform_board", one, _WHOLE),
    )
    return (Factor("platform_board", lambda _: shown, touches, len(place), 2, pose),)


def expected_intrinsics(
    predicted: PredictedObservations,
    images: Array,  # of image_rows
    equations: WhitenedEquations,
    prior: GaussianPrior,
    orientation: Array,  # (n_views, 3, 3): R of every camera in R_b, its optical axis last
    # (n_views): the camera of every view: views with the same one share their intrinsics
    owners: Sequence[str],
    arms: GaussianPrior = NO_PRIOR,  # of prior_of_arms
) -> tuple[CameraIntrinsics, ...]:
    """Return what the legs determine of the intrinsics of cameras, estimated with all else."""
    cameras = tuple(dict.fromkeys(owners))
    of_view = np.array([cameras.index(owner) for owner in owners], dtype=np.intp)
    n, n_cameras = predicted.n_bodies, len(cameras)
    by_radius, by_intrinsics = _radii_and_intrinsics(predicted, orientation)
    sigma_radius = RefinementSettings.radius_sigma * predicted.body_radius
    known = GaussianPrior(np.arange(n), np.zeros(n), sigma_radius)
    body = np.broadcast_to(np.arange(n), images.shape[:2])
    camera = np.broadcast_to(of_view[predicted.view][:, None], images.shape[:2])
    numbers = Variables("intrinsics", all_free(n_cameras, len(INTRINSICS)))
    problem, state = problem_of(
        predicted,
        images,
        equations,
        prior,
        (
            (Variables("radius", all_free(n, 1), prior=known), body, by_radius),
            (numbers, camera, by_intrinsics),
        ),
        arms=arms,
    )
    left = marginal_rows(information_rows(problem, state), problem.where("intrinsics"))
    _, singular, basis = np.linalg.svd(left)
    # An unknown of one metre is one of as many pixels as a leg's length is long from afar.
    is_seen = singular > 1.0 / (_MAX_INTRINSICS_SIGMA * predicted.mean_length)
    spread = np.sqrt(np.sum((basis[is_seen].T / singular[is_seen]) ** 2, axis=1))
    is_open = np.sqrt(np.sum(basis[~is_seen] ** 2, axis=0)) > _OPEN
    first = np.unique(of_view, return_index=True)[1]
    metre = predicted.focal[first] / predicted.mean_length  # of each camera [px]
    sigma = spread.reshape(n_cameras, -1) * metre[:, None]
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
    """Return derivatives (n_images, n_bodies, 4, d) of what images show by radii and intrinsics."""
    shape = len(predicted.view), predicted.n_bodies, 4
    by_radius, by_intrinsics = np.zeros((*shape, 1)), np.zeros((*shape, len(INTRINSICS)))
    unit = (predicted.focal / predicted.mean_length)[predicted.view][:, None, None, None]
    for k, across in enumerate((at_base_joints(predicted), at_platform_joints(predicted))):
        lateral, widening = intrinsics_changes(predicted, across, orientation)
        sigma_lateral, towards = _scales(predicted, across)
        rows = [lateral / sigma_lateral[..., None], widening * towards[..., None]]
        by_intrinsics[:, :, 2 * k : 2 * k + 2] = np.stack(rows, 2) * unit
        by_radius[:, :, 2 * k + 1, 0] = towards / predicted.body_radius
    by_radius[~predicted.shown] = by_intrinsics[~predicted.shown] = 0.0
    return by_radius, by_intrinsics


def radius_rows(predicted: PredictedObservations) -> Array:
    """Return the derivatives of what images show by the radius of each body, (..., 4, 1) [1/m].

    A thicker one looks nearer, by as much as makes a scene that is larger in all, cameras and radii
    included, look the same.
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
    """Return what a pixel more of each intrinsic does, both (n_images, n_bodies, 4).

    How far it moves the axis across the body [m/px], and how much wider it makes this [1/px].
    """
    R = orientation[predicted.view]
    at = (across.point - predicted.camera[predicted.view][:, None]) @ R  # in the camera frame
    lateral = across.gradient[:, :, 0] @ R
    lateral /= np.maximum(np.linalg.norm(lateral, axis=2), 1e-300)[..., None]
    focal = predicted.focal[predicted.view][:, None, None]
    depth = np.maximum(at[..., 2:], 1e-6 * predicted.mean_length)
    xy = at[..., :2] / depth
    u = predicted.body_u[predicted.pose] @ R
    along, imaged = (focal / depth * (d[..., :2] - d[..., 2:] * xy) for d in (u, lateral))  # px/m
    normal = np.stack([-along[..., 1], along[..., 0]], axis=2)
    normal /= np.maximum(np.linalg.norm(normal, axis=2, keepdims=True), 1e-300)
    by_metre = np.sum(normal * imaged, axis=2, keepdims=True)
    shift = np.concatenate([normal * xy, normal], axis=2) / np.where(by_metre, by_metre, 1.0)
    return shift, np.concatenate([normal**2 / focal, np.zeros_like(normal)], axis=2)


def _scales(predicted: PredictedObservations, across: Across) -> tuple[Array, Array]:
    """Return, both (n_images, n_bodies), what weighs such changes.

    The standard deviation of the axis across the body [m], and by how many standard deviations one
    as wide again looks nearer, as what is seen towards the camera counts it.
    """
    lateral, depth = across.gradient[:, :, 0], across.gradient[:, :, 1]
    ray = across.point - predicted.camera[predicted.view][:, None]
    sigma = 1.0 / np.maximum(np.linalg.norm(lateral, axis=2), 1e-300)
    away = np.sign(np.sum(depth * ray, axis=2))
    return sigma, -away * np.linalg.norm(ray, axis=2) * np.linalg.norm(depth, axis=2)
