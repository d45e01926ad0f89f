"""Information of predicted observations on the parameters: whitened, linearised rows.

Everything is linearised at the nominal machine, in metres (angles count at the mean leg length) and
in standard deviations, so that a singular value is one over a standard deviation [1/m]. Platform
poses and cameras are nuisance parameters: they are eliminated.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from legcal.calibration.identify.session import Session, at_base_joints, at_platform_joints
from legcal.calibration.joint_fit import Choices
from legcal.geometry import Array, IntArray
from legcal.machine import Demand, freedoms, pose_equations

_UNSEEN = 1e-3  # 1/m: an unknown known to no better than a kilometre is not known
SIGMA_EXACT = 1e-7  # [m]: what the mechanism itself demands


def by_cameras(
    session: Session,
    # (n_images, n_legs, 4, f + 6 + p): what :func:`image_rows` says of them; other unknowns may
    # follow the parameters
    images: Array,
    demands: WhitenedDemands,  # what :func:`demands_of` says of them, and of these others
) -> Array:
    """Return what everything says of cameras and parameters, (m, 6 n_frames + p) [1/m].

    The motions of the platform are free. Views that show a board share one camera: that of the
    board.
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


def of_parameters(session: Session, rows: Array) -> Array:
    """Return what rows of cameras and parameters say of the parameters, (p, p)."""
    return compress(eliminate(rows[None], rows.shape[1] - len(session.parametrization)))


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


@dataclass(frozen=True, eq=False)
class WhitenedDemands:
    """The whitened equations of all legs at the poses of a session."""

    # (k, m, f): by the possible motions of the platform: turns [m at the leg's length],
    # displacements
    by_pose: Array
    by_parameters: Array  # (k, m, p): by the parameters in metres
    leg: IntArray  # (m,): the leg of each row
    demand: tuple[Demand, ...]  # (m,): what it is about

    def at(self, poses: IntArray) -> WhitenedDemands:
        """Return the equations at some of the poses, in that order."""
        return replace(self, by_pose=self.by_pose[poses], by_parameters=self.by_parameters[poses])


def demands_of(session: Session) -> WhitenedDemands:
    """Return what readings and legs demand of the poses of a session."""
    equations = pose_equations(session.legs, session.R, session.t)
    sigma = np.where(equations.measured, session.sigma_q, SIGMA_EXACT)[:, None]
    columns = list(freedoms(session.frame_legs))
    return WhitenedDemands(
        (equations.by_pose / sigma * pose_unit(session))[:, :, columns],
        equations.by_parameters(session.parametrization) / sigma * session.unit,
        equations.leg,
        equations.demands,
    )


def pose_unit(session: Session) -> Array:
    """Return what a metre of the six components of a motion is: turns count at the leg's length."""
    return np.repeat([1.0 / session.mean_length, 1.0], 3)


def known_rows(
    session: Session,  # the observations; its parameters are counted in metres
    choices: Choices,  # parameters that are fixed, and those of which something is known
) -> Array:
    """Return what is known of the parameters as whitened rows, (p, p) [1/m]."""
    known = np.zeros(len(session.unit))
    for i, name in enumerate(session.parametrization.names):
        if name in choices.priors:
            known[i] = session.unit[i] / choices.priors[name].sigma
        elif choices.holds(name, by_default=name.endswith(".twist")):
            known[i] = 1.0 / SIGMA_EXACT
    return np.diag(known)


def eliminate(
    # (k, r, n_own + n_shared): whitened rows of each group: derivatives in standard deviations per
    # metre
    rows: Array,
    n_own: int,  # number of unknowns, the first ones, that each group has for itself
) -> Array:
    """Return what groups of rows say about shared unknowns when their own ones are free.

    Rows are turned until as few as possible contain the own unknowns, which are then dropped:
    nothing is lost where the rows do not determine the own unknowns.

    Returns (m, n_shared).
    """
    n_shared = rows.shape[2] - n_own
    if rows.shape[0] == 0 or rows.shape[1] == 0:
        return np.zeros((0, n_shared))
    if n_own == 0:
        return rows.reshape(-1, n_shared)
    if rows.shape[1] < n_own:
        short = n_own - rows.shape[1]
        rows = np.concatenate([rows, np.zeros((len(rows), short, rows.shape[2]))], axis=1)
    upper = np.asarray(np.linalg.qr(rows, mode="r"))
    left, singular, _ = np.linalg.svd(upper[:, :n_own, :n_own])
    top = np.swapaxes(left, 1, 2) @ upper[:, :n_own, n_own:]
    top[singular > _UNSEEN] = 0.0
    rest = upper[:, n_own:, n_own:]
    kept = top[singular <= _UNSEEN]
    return np.concatenate([kept, rest.reshape(-1, n_shared)])


def compress(rows: Array) -> Array:
    """Return rows (p, p) that say the same as rows (m, p)."""
    n = rows.shape[1]
    upper = np.asarray(np.linalg.qr(rows, mode="r")) if len(rows) else np.zeros((0, n))
    return np.concatenate([upper, np.zeros((n - len(upper), n))])


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
