"""Everything at once: what all images, all readings and the mechanism say of the parameters."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from legcal.geometry.types import Array, IntArray
from legcal.identify.elimination import compress, eliminate
from legcal.identify.observed import at_base_joints, at_platform_joints
from legcal.identify.session import Session
from legcal.mechanism.leg import LegKind
from legcal.mechanism.leg_geometry import Demand
from legcal.mechanism.sensitivity import freedoms, pose_equations

SIGMA_EXACT = 1e-7  # [m]: what the mechanism itself demands


@dataclass(frozen=True, eq=False)
class WhitenedDemands:
    """The whitened equations of all legs at the poses of a session.

    Attributes
    ----------
    by_pose : (k, m, f) array
        By the possible motions of the platform: turns [m at the leg's length], displacements.
    by_parameters : (k, m, p) array
        By the parameters in metres.
    leg : (m,) array of int
        The leg of each row.
    demand : (m,) array of Demand
        What it is about.
    """

    by_pose: Array
    by_parameters: Array
    leg: IntArray
    demand: tuple[Demand, ...]

    def at(self, poses: IntArray) -> WhitenedDemands:
        """Return the equations at some of the poses, in that order."""
        return replace(self, by_pose=self.by_pose[poses], by_parameters=self.by_parameters[poses])


def demands_of(session: Session) -> WhitenedDemands:
    """Return what readings and legs demand of the poses of a session."""
    equations = pose_equations(session.legs, session.parametrization, session.R, session.t)
    sigma = np.where(equations.measured, session.sigma_q, SIGMA_EXACT)[:, None]
    demand = tuple(
        d
        for leg in session.legs
        for d in leg.demands
        if not (d is Demand.LENGTH and leg.kind is LegKind.PASSIVE)
    )
    columns = list(freedoms(session.frame_legs))
    return WhitenedDemands(
        (equations.by_pose / sigma * pose_unit(session))[:, :, columns],
        equations.by_parameters / sigma * session.unit,
        equations.leg,
        demand,
    )


def pose_unit(session: Session) -> Array:
    """Return what a metre of the six components of a motion is: turns count at the leg's length."""
    return np.repeat([1.0 / session.mean_length, 1.0], 3)


def image_rows(session: Session) -> Array:
    """Return what each image says, (n_images, n_legs, 4, f + 6 + p), whitened.

    The unknowns are the platform's motion, the motion of the camera of that image, and the
    parameters, all in metres.
    """
    base, platform = at_base_joints(session), at_platform_joints(session)
    turns = pose_unit(session)
    by_camera = np.concatenate([base.by_camera(), platform.by_camera()], axis=2) * turns
    turn = np.cross(session.arm[session.pose][:, :, None], platform.gradient)
    by_pose = np.zeros_like(by_camera)
    by_pose[:, :, 2:] = np.concatenate([turn, platform.gradient], axis=3) * turns
    scatter = session.local_to_parameters
    inside = platform.gradient @ session.R[session.pose][:, None]
    by_parameters = np.concatenate(
        [base.gradient @ scatter[:, :3], inside @ scatter[:, 3:6]], axis=2
    )
    columns = list(freedoms(session.frame_legs))
    return np.concatenate([by_pose[..., columns], by_camera, by_parameters], axis=3)


def information(session: Session, images: Array, demands: WhitenedDemands) -> Array:
    """Return what everything at once says of the parameters, (p, p) whitened rows [1/m].

    The arguments are those of :func:`by_cameras`.
    """
    return of_parameters(session, by_cameras(session, images, demands))


def of_parameters(session: Session, rows: Array) -> Array:
    """Return what rows of cameras and parameters say of the parameters, (p, p)."""
    return compress(eliminate(rows[None], rows.shape[1] - len(session.parametrization)))


def by_cameras(session: Session, images: Array, demands: WhitenedDemands) -> Array:
    """Return what everything says of cameras and parameters, (m, 6 n_frames + p) [1/m].

    The motions of the platform are free. Views that show a board share one camera: that of the
    board.

    Parameters
    ----------
    session : Session
        The observations.
    images : (n_images, n_legs, 4, f + 6 + p) array
        What :func:`image_rows` says of them; other unknowns may follow the parameters.
    demands : WhitenedDemands
        What :func:`demands_of` says of them, and of these others.
    """
    n_f, n_p = len(freedoms(session.frame_legs)), demands.by_parameters.shape[2]
    seen = images.reshape(len(session.view), -1, n_f + 6 + n_p)
    n_cameras = 6 * session.n_frames
    wide = np.zeros((*seen.shape[:2], n_f + n_cameras + n_p))
    wide[..., :n_f], wide[..., n_f + n_cameras :] = seen[..., :n_f], seen[..., n_f + 6 :]
    for v, frame in enumerate(session.frame.tolist()):
        here = session.view == v
        place = n_f + 6 * frame
        wide[here, :, place : place + 6] = seen[here, :, n_f : n_f + 6]
    equations = np.zeros((len(session.t), demands.by_pose.shape[1], wide.shape[2]))
    equations[..., :n_f] = demands.by_pose
    equations[..., n_f + n_cameras :] = demands.by_parameters
    rows = np.concatenate([equations, by_group(wide, session.pose, len(session.t))], axis=1)
    return compress_groups(eliminate(rows, n_f))


def compress_groups(rows: Array) -> Array:
    """Return fewer rows that say the same."""
    return rows if len(rows) < rows.shape[1] else np.asarray(np.linalg.qr(rows, mode="r"))


def by_group(rows: Array, group: IntArray, n_groups: int) -> Array:
    """Return rows (n, r, c) of members laid out by group, (n_groups, most * r, c), with zeros."""
    number = np.bincount(group, minlength=n_groups)
    place = np.zeros(len(group), dtype=np.intp)
    order = np.argsort(group, kind="stable")
    place[order] = np.arange(len(group)) - np.repeat(np.cumsum(number) - number, number)
    most = int(number.max(initial=0))
    laid = np.zeros((n_groups, most, *rows.shape[1:]))
    laid[group, place] = rows
    return laid.reshape(n_groups, most * rows.shape[1], rows.shape[2])
