"""The Cramer-Rao bound of a design: the least covariance that any unbiased estimator can have.

It is computed at the truth, from the equations of the legs and from differences of what the
simulator shows, and shares nothing with the fit that is measured by it. Poses follow the parameters
where the legs demand it; what remains of them, and the cameras, are unknown.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from scipy.spatial.transform import RigidTransform, Rotation

from legcal.errors import NotIdentifiable
from legcal.geometry.types import Array, IntArray
from legcal.identify.elimination import compress, eliminate
from legcal.mechanism.leg_geometry import LegGeometry
from legcal.mechanism.leg_steps import moved_legs
from legcal.mechanism.sensitivity import freedoms, pose_equations
from legcal.simulation.silhouette import silhouette
from legcal.studies.closed_poses import moved_poses
from legcal.studies.outline_design import OutlineDesign

_STEP = 1e-6  # [m] or [rad] of differences
_RANK = 1e-9  # of the largest singular value
_DETERMINED = 1e-12  # of the largest eigenvalue of the scaled information


@dataclass(frozen=True, eq=False)
class Bound:
    """The bound of a design.

    Attributes
    ----------
    names, units : tuple of str
        The kinematic parameters, then the radii that are observed; ``m`` or ``rad``.
    covariance : (n, n) array
        [m^2], [m rad], [rad^2]; axes count as angles from the true ones.
    """

    names: tuple[str, ...]
    units: tuple[str, ...]
    covariance: Array

    @property
    def sigma(self) -> Array:
        """Standard deviations (n,) [m, rad]."""
        return np.sqrt(np.diagonal(self.covariance))


def bound_of(design: OutlineDesign, sigma_q: float, radius_sigma: float) -> Bound:
    """Return the Cramer-Rao bound of all outlines, all readings and what is known of the radii.

    Parameters
    ----------
    design, sigma_q, radius_sigma
        As in :func:`information_of`.

    Raises
    ------
    NotIdentifiable
        If the data do not determine a parameter.
    """
    rows = information_of(design, sigma_q, radius_sigma)
    units = (*design.parametrization.units, *("m" for _ in design.parts))
    return Bound(design.names, units, _inverse(rows, design.names))


def information_of(design: OutlineDesign, sigma_q: float, radius_sigma: float) -> Array:
    """Return what all outlines, all readings and what is known of the radii say of a machine.

    Parameters
    ----------
    design : OutlineDesign
        What is measured.
    sigma_q : float
        Standard deviation of a reading [m].
    radius_sigma : float
        Standard deviation of what is known of a radius, as a part of it.

    Returns
    -------
    (m, n) array
        Whitened rows: their squares are the Fisher matrix of the kinematic parameters and then the
        radii, cameras and poses unknown [1/m], [1/rad].
    """
    parts = design.parts
    n_cameras, n_parameters = 6 * len(design.T_Rb_camera), len(design.parametrization)
    rows = [*_rows_of_poses(design, sigma_q)]
    known = np.zeros((len(parts), n_cameras + n_parameters + len(parts)))
    radius = np.array([design.radii[part] for part in parts])
    known[:, n_cameras + n_parameters :] = np.diag(1.0 / (radius_sigma * radius))
    rows.append(known)
    return compress(eliminate(np.concatenate(rows)[None], n_cameras))


def _rows_of_poses(design: OutlineDesign, sigma_q: float) -> list[Array]:
    """Return what the images and readings of each pose say of cameras, parameters and radii."""
    n_cameras, n_parameters = 6 * len(design.T_Rb_camera), len(design.parametrization)
    by_pose, by_shared = _outline_rows(design)
    demands = pose_equations(design.legs, design.parametrization, design.R, design.t)
    held, read = ~demands.measured, demands.measured
    columns, pose = list(freedoms(design.frame_legs)), design.pose[design.outlines.row]
    parameters = slice(n_cameras, n_cameras + n_parameters)
    found = []
    for k in range(len(design.t)):
        F, G = demands.by_pose[k][:, columns], demands.by_parameters[k]
        of_readings = np.zeros((int(read.sum()), by_shared.shape[-1]))
        of_readings[:, parameters] = G[read] / sigma_q
        seen = pose == k
        own = np.concatenate([by_pose[seen].reshape(-1, 6)[:, columns], F[read] / sigma_q])
        shared = np.concatenate([by_shared[seen].reshape(-1, by_shared.shape[-1]), of_readings])
        follow, free = _allowed(F[held], G[held])
        shared[:, parameters] += own @ follow
        wide = np.concatenate([own @ free, shared], axis=1)
        found.append(eliminate(wide[None], free.shape[1]))
    return found


def _allowed(F: Array, G: Array) -> tuple[Array, Array]:
    """Return how a pose follows xi where F d_pose + G d_xi = 0, and its free motions."""
    _, singular, right = np.linalg.svd(F)
    rank = int(np.sum(singular > _RANK * singular.max(initial=1.0)))
    return -np.linalg.pinv(F, rcond=_RANK) @ G, right[rank:].T


def _outline_rows(design: OutlineDesign) -> tuple[Array, Array]:
    """Return whitened derivatives of all outlines, (n, 2, 6) by their pose and (n, 2, m) by others.

    The others are six motions of each camera, then the kinematic parameters, then the radii.
    """
    truth = _Numbers(design.legs, design.R, design.t, design.T_Rb_camera, design.radii)
    motions, unit = np.eye(6), np.eye(len(design.parametrization))
    of_poses = [partial(_with_poses, truth, motion) for motion in motions]
    of_others = [
        *(
            partial(_with_camera, truth, v, motion)
            for v in range(len(truth.T_Rb_camera))
            for motion in motions
        ),
        *(partial(_with_legs, truth, design.parametrization.place, step) for step in unit),
        *(partial(_with_radius, truth, part) for part in design.parts),
    ]
    ends = design.camera.undistort(design.outlines.ends)
    whitening = np.linalg.inv(np.linalg.cholesky(design.outlines.covariance))
    by_pose, by_others = (
        np.stack([_derivative(design, ends, change) for change in changes], axis=-1)
        for changes in (of_poses, of_others)
    )
    return whitening @ by_pose, whitening @ by_others


@dataclass(frozen=True, eq=False)
class _Numbers:
    """All that decides what images show."""

    legs: Sequence[LegGeometry]
    R: Array
    t: Array
    T_Rb_camera: Sequence[RigidTransform]
    radii: Mapping[tuple[int, str], float]


def _with_poses(truth: _Numbers, motion: Array, size: float) -> _Numbers:
    R, t = moved_poses(truth.R, truth.t, size * motion)
    return replace(truth, R=R, t=t)


def _with_camera(truth: _Numbers, view: int, motion: Array, size: float) -> _Numbers:
    cameras, step = list(truth.T_Rb_camera), size * motion
    cameras[view] = RigidTransform.from_components(
        cameras[view].translation + step[3:],
        Rotation.from_rotvec(step[:3]) * cameras[view].rotation,
    )
    return replace(truth, T_Rb_camera=cameras)


def _with_legs(truth: _Numbers, place: IntArray, step: Array, size: float) -> _Numbers:
    return replace(truth, legs=moved_legs(truth.legs, place, size * step))


def _with_radius(truth: _Numbers, part: tuple[int, str], size: float) -> _Numbers:
    return replace(truth, radii={**truth.radii, part: truth.radii[part] + size})


def _derivative(design: OutlineDesign, ends: Array, change: Callable[[float], _Numbers]) -> Array:
    """Return the derivative (n, 2) [px] of offsets by a step that is taken both ways."""
    ahead, behind = (_offsets(design, ends, change(size)) for size in (_STEP, -_STEP))
    return (ahead - behind) / (2.0 * _STEP)


def _offsets(design: OutlineDesign, ends: Array, numbers: _Numbers) -> Array:
    """Return how far (n, 2) [px] the ends of the true outlines are from those of some numbers."""
    shown, legs, cameras = design.outlines, numbers.legs, numbers.T_Rb_camera
    pose, view, leg = design.pose[shown.row], design.view[shown.row], shown.leg
    A, B = np.array([x.A for x in legs])[leg], np.array([x.B for x in legs])[leg]
    along = np.einsum("nij,nj->ni", numbers.R[pose], B) + numbers.t[pose] - A
    u = along / np.linalg.norm(along, axis=1)[:, None]
    turn = np.array([T.rotation.as_matrix().T for T in cameras])[view]
    centre = np.array([T.translation for T in cameras])[view]
    radius = [numbers.radii[key] for key in zip(leg.tolist(), shown.part, strict=True)]
    h, _ = silhouette(
        np.einsum("nij,nj->ni", turn, u),
        np.einsum("nij,nj->ni", turn, A - centre),
        np.array(radius),
    )
    own = h[np.arange(len(leg)), shown.edge - 1]
    return design.camera.line_offset(own[:, None], ends)


def _inverse(rows: Array, names: Sequence[str]) -> Array:
    """Return the covariance of whitened rows, which must determine everything."""
    information = rows.T @ rows
    diagonal = np.diagonal(information)
    scale = 1.0 / np.sqrt(np.where(diagonal > 0.0, diagonal, 1.0))
    value, vector = np.linalg.eigh(scale[:, None] * information * scale)
    if value[0] < _DETERMINED * value[-1] or not np.all(diagonal > 0.0):
        worst = np.argsort(-np.abs(vector[:, 0]))[:3]
        raise NotIdentifiable(
            "The bound of a simulated machine could not be computed: found that its images do not "
            f"determine {', '.join(names[i] for i in worst)}, needed all parameters; add views."
        )
    turned = scale[:, None] * vector
    return np.asarray((turned / value) @ turned.T)
