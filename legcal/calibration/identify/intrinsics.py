"""What legs show of the intrinsics of cameras, estimated together with all else."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from legcal.calibration.identify.information import by_cameras, compress, eliminate
from legcal.calibration.identify.ranks import Analysis
from legcal.calibration.identify.session import Across, Session, at_base_joints, at_platform_joints
from legcal.geometry import Array, IntArray

NAMES = ("fx", "fy", "cx", "cy")
_LARGEST_SIGMA = 0.1  # of a focal length: what is known to no better is not determined
RADIUS = 0.02  # standard deviation of a radius, relative, as a fit has it
OPEN = 0.05  # component of an open direction from which on an intrinsic is part of it


@dataclass(frozen=True)
class CameraIntrinsics:
    """What the legs tell of one camera, its four numbers looked for together with all others."""

    camera: str  # the view after whose name the intrinsics are called
    determined: bool  # whether the legs determine all four
    # standard deviations of ``fx``, ``fy``, ``cx``, ``cy`` to expect with outlines good to 0.1 px,
    # radii known to 2 % [px]; None for those that stay open
    sigma: dict[str, float | None]


def judge_intrinsics(
    analysis: Analysis,  # what the session says of the machine
    orientation: Array,  # (n_views, 3, 3): R of every camera in R_b, its optical axis last
    # (n_views): the camera of every view: views with the same one share their intrinsics
    owners: Sequence[str],
) -> tuple[CameraIntrinsics, ...]:
    """Return what the legs tell of the cameras of a session."""
    session = analysis.session
    cameras = tuple(dict.fromkeys(owners))
    of_view = np.array([cameras.index(owner) for owner in owners], dtype=np.intp)
    images = np.concatenate(
        [analysis.images, _by_radii_and_intrinsics(session, orientation, of_view, len(cameras))],
        axis=3,
    )
    n_p, n_legs, n_numbers = len(session.unit), session.n_legs, len(NAMES) * len(cameras)
    demands = analysis.demands
    wide = np.pad(demands.by_parameters, ((0, 0), (0, 0), (0, n_legs + n_numbers)))
    rows = by_cameras(session, images, replace(demands, by_parameters=wide))
    rows = compress(eliminate(rows[None], rows.shape[1] - n_p - n_legs - n_numbers))
    known = np.zeros((n_legs, rows.shape[1]))
    known[:, n_p : n_p + n_legs] = np.diag(1.0 / (RADIUS * session.radius))
    of_parameters = np.zeros((0, rows.shape[1]))
    if analysis.known is not None:
        of_parameters = np.pad(analysis.known, ((0, 0), (0, rows.shape[1] - n_p)))
    rows = compress(np.concatenate([rows, known, of_parameters]))
    left = compress(eliminate(rows[None], n_p + n_legs))
    _, singular, basis = np.linalg.svd(left)
    # An unknown of one metre is one of as many pixels as a leg's length is long from afar.
    is_seen = singular > 1.0 / (_LARGEST_SIGMA * session.mean_length)
    spread = np.sqrt(np.sum((basis[is_seen].T / singular[is_seen]) ** 2, axis=1))
    is_open = np.sqrt(np.sum(basis[~is_seen] ** 2, axis=0)) > OPEN
    sigma = spread.reshape(-1, len(NAMES)) * _unit(session, of_view)[:, None]
    return tuple(
        CameraIntrinsics(
            camera,
            not any(lost),
            {name: None if out else one for name, one, out in zip(NAMES, own, lost, strict=True)},
        )
        for camera, own, lost in zip(
            cameras, sigma.tolist(), is_open.reshape(sigma.shape).tolist(), strict=True
        )
    )


def _unit(session: Session, of_view: IntArray) -> Array:
    """Return what a metre of the intrinsics of each camera is [px]."""
    first = np.unique(of_view, return_index=True)[1]
    return np.asarray(session.focal[first] / session.mean_length)


def _by_radii_and_intrinsics(
    session: Session, orientation: Array, of_view: IntArray, n_cameras: int
) -> Array:
    """Return derivatives (n_images, n_legs, 4, n_legs + 4 n_cameras) of what images say."""
    n_images, n_legs = len(session.view), session.n_legs
    rows = np.zeros((n_images, n_legs, 4, n_legs + len(NAMES) * n_cameras))
    legs = np.arange(n_legs)
    camera = of_view[session.view]
    for k, across in enumerate((at_base_joints(session), at_platform_joints(session))):
        aside, wider = _changes(session, across, orientation)
        sigma_lateral, towards = _scales(session, across)
        unit = (session.focal / session.mean_length)[session.view][:, None, None]
        by_numbers = np.stack([aside / sigma_lateral[..., None], wider * towards[..., None]], 2)
        for c in range(n_cameras):
            first = n_legs + len(NAMES) * c
            own = camera == c
            rows[own, :, 2 * k : 2 * k + 2, first : first + len(NAMES)] = (
                by_numbers * unit[..., None]
            )[own]
        rows[:, legs, 2 * k + 1, legs] = towards / session.radius
    rows[~session.seen[session.view]] = 0.0
    return rows


def _changes(session: Session, across: Across, orientation: Array) -> tuple[Array, Array]:
    """Return what a pixel more of each number does, both (n_images, n_legs, 4).

    How far it moves the axis across the leg [m/px], and how much wider it makes the leg [1/px].
    """
    R = orientation[session.view]
    at = (across.point - session.camera[session.view][:, None]) @ R  # in the camera frame
    lateral = across.gradient[:, :, 0] @ R
    lateral /= np.maximum(np.linalg.norm(lateral, axis=2), 1e-300)[..., None]
    focal = session.focal[session.view][:, None, None]
    depth = np.maximum(at[..., 2:], 1e-6)
    xy = at[..., :2] / depth
    u = session.u[session.pose] @ R
    along, imaged = (focal / depth * (d[..., :2] - d[..., 2:] * xy) for d in (u, lateral))  # px/m
    normal = np.stack([-along[..., 1], along[..., 0]], axis=2)
    normal /= np.maximum(np.linalg.norm(normal, axis=2, keepdims=True), 1e-300)
    by_metre = np.sum(normal * imaged, axis=2, keepdims=True)
    aside = np.concatenate([normal * xy, normal], axis=2) / np.where(by_metre, by_metre, 1.0)
    wider = np.concatenate([normal**2 / focal, np.zeros_like(normal)], axis=2)
    return aside, wider


def _scales(session: Session, across: Across) -> tuple[Array, Array]:
    """Return, both (n_images, n_legs), what weighs such changes.

    The standard deviation of the axis across the leg [m], and by how many standard deviations a leg
    as wide again looks nearer, as what is seen towards the camera counts it.
    """
    lateral, depth = across.gradient[:, :, 0], across.gradient[:, :, 1]
    ray = across.point - session.camera[session.view][:, None]
    sigma = 1.0 / np.maximum(np.linalg.norm(lateral, axis=2), 1e-300)
    away = np.sign(np.sum(depth * ray, axis=2))
    return sigma, -away * np.linalg.norm(ray, axis=2) * np.linalg.norm(depth, axis=2)
