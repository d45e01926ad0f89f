"""The Cramer-Rao bound of a design by differences of what the simulator shows, without the fit.

Also what errors of calibrations must be beside it: limits, and those of chance for few runs.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np
from outline_sessions import (
    Design,
    Noise,
    arm_sigmas,
    moved_poses,
)
from scipy.linalg import null_space
from scipy.spatial.transform import RigidTransform, Rotation
from scipy.stats import chi2, norm

from legcal.errors import NotIdentifiable
from legcal.geometry.types import Array
from legcal.machine.equations import freedoms, pose_equations
from legcal.machine.leg import Leg
from legcal.machine.parameters import moved_legs
from legcal.machine.rods import actuator_index, arms_at, joints_at
from legcal.machine.ties import by_step, independent
from legcal.vision.cylinder import outlines_of_axis

_STEP = 1e-6  # [m] or [rad] of differences
_RANK = 1e-9  # of the largest singular value
_DETERMINED = 1e-12  # of the largest eigenvalue of the scaled information

LEVEL = 0.999  # of sampling bands
COVERED, COVERAGE = 0.95, (0.94, 0.96)
INSIDE = float(norm.ppf(0.5 + 0.5 * COVERED))  # standard deviations on either side
_WIDE = float(norm.ppf(0.5 + 0.5 * LEVEL))
_TOGETHER = 10  # runs: what is believed of the spread of coverage before any, see below


@dataclass(frozen=True, eq=False)
class Bound:
    """The bound of a design: the kinematic parameters, then radii and arms that are observed."""

    names: tuple[str, ...]
    units: tuple[str, ...]  # m or rad
    covariance: Array  # (n, n); axes count as angles from the true ones

    @property
    def sigma(self) -> Array:
        """Standard deviations (n,) [m, rad]."""
        return np.sqrt(np.diagonal(self.covariance))


def bound_of(design: Design, sigma_q: float, radius_sigma: float) -> Bound:
    """Return the bound of all outlines, all readings and what is known of the radii."""
    rows = information_of(design, sigma_q, radius_sigma)
    units = (*design.parametrization.units, *("m" for _ in design.parts), *design.arms.units)
    information = rows.T @ rows
    diagonal = np.diagonal(information)
    scale = 1.0 / np.sqrt(np.where(diagonal > 0.0, diagonal, 1.0))
    value, vector = np.linalg.eigh(scale[:, None] * information * scale)
    if value[0] < _DETERMINED * value[-1] or not np.all(diagonal > 0.0):
        worst = np.argsort(-np.abs(vector[:, 0]))[:3]
        raise NotIdentifiable(
            "The bound of a simulated machine could not be computed: found that its images do not "
            f"determine {', '.join(design.names[i] for i in worst)}, needed all parameters; add "
            "views."
        )
    turned = scale[:, None] * vector
    return Bound(design.names, units, np.asarray((turned / value) @ turned.T))


def information_of(design: Design, sigma_q: float, radius_sigma: float) -> Array:
    """Return whitened rows (m, n) of parameters, radii, arms; cameras and poses are unknown.

    Their squares are the Fisher matrix [1/m], [1/rad].
    """
    n_cameras, n_parameters = 6 * len(design.T_Rb_camera), len(design.parametrization)
    by_pose, by_shared = _outline_rows(design)
    legs, q = design.legs.nominal, design.q_of_actuators
    demands = pose_equations(legs, design.R, design.t, q=q if q.shape[1] else None)
    by_parameters = demands.by_parameters(design.parametrization)
    hangs = np.array([leg.actuator is not None for leg in legs])[demands.leg]
    constraints, read = ~demands.measured | hangs, demands.measured & ~hangs
    columns = [*freedoms(design.legs.frame_legs), *range(6, 6 + q.shape[1])]
    by_posture = np.concatenate([demands.by_pose, demands.by_q], axis=2)
    on, sigma = actuator_index(legs), Noise(sigma_q=sigma_q).of_readings(legs)
    of_q = np.zeros((q.shape[1], 6 + q.shape[1]))
    for a in range(q.shape[1]):
        of_q[a, 6 + a] = 1.0 / sigma[on.index(a)]
    pose = design.pose[design.outlines.row]
    parameters = slice(n_cameras, n_cameras + n_parameters)
    rows = []
    for k in range(len(design.t)):
        F, G = by_posture[k][:, columns], by_parameters[k]
        of_readings = np.zeros((int(read.sum()) + len(of_q), by_shared.shape[-1]))
        of_readings[: int(read.sum()), parameters] = G[read] / sigma_q
        seen = pose == k
        by_own = by_pose[seen].reshape(-1, by_pose.shape[-1])[:, columns]
        own = np.concatenate([by_own, F[read] / sigma_q, of_q[:, columns]])
        shared = np.concatenate([by_shared[seen].reshape(-1, by_shared.shape[-1]), of_readings])
        # A pose follows the parameters where F d_pose + G d_xi = 0; the rest of it is free.
        _, singular, right = np.linalg.svd(F[constraints])
        rank = int(np.sum(singular > _RANK * singular.max(initial=1.0)))
        shared[:, parameters] -= own @ np.linalg.pinv(F[constraints], rcond=_RANK) @ G[constraints]
        rows.append(_without(own @ right[rank:].T, shared))
    radius = np.array([design.legs.radii[part] for part in design.parts])
    sigmas = np.concatenate([radius_sigma * radius, arm_sigmas(design.arms, design.legs.nominal)])
    known = np.zeros((len(sigmas), n_cameras + n_parameters + len(sigmas)))
    known[:, n_cameras + n_parameters :] = np.diag(1.0 / sigmas)
    together = np.concatenate([*rows, known])
    return _without(together[:, :n_cameras], together[:, n_cameras:])


def _without(own: Array, shared: Array) -> Array:
    """Return what rows say of shared unknowns when their own ones are free."""
    upper = np.asarray(np.linalg.qr(np.concatenate([own, shared], axis=1), mode="r"))
    n = own.shape[1]
    left, singular, _ = np.linalg.svd(upper[:, :n])
    rank = int(np.sum(singular > _RANK * singular.max(initial=1.0)))
    return np.asarray(left[:, rank:].T @ upper[:, n:])


@dataclass(frozen=True, eq=False)
class _Numbers:
    """All that decides what images show."""

    legs: Sequence[Leg]
    R: Array
    t: Array
    T_Rb_camera: Sequence[RigidTransform]
    radii: Mapping[tuple[int, str], float]
    q: Array  # of actuators


def _outline_rows(design: Design) -> tuple[Array, Array]:
    """Return whitened derivatives of all outlines by pose and readings of actuators, and others.

    The former are (n, 2, 6 + n_actuators), the latter (n, 2, m).

    The others are six motions of each camera, then the kinematic parameters, radii and arms.
    """
    place = design.parametrization.place
    truth = _Numbers(
        design.legs.nominal,
        design.R,
        design.t,
        design.T_Rb_camera,
        design.legs.radii,
        design.q_of_actuators,
    )
    ends = design.camera.undistort(design.outlines.ends)
    whitening = np.linalg.inv(np.linalg.cholesky(design.outlines.covariance))

    def with_poses(step: Array) -> _Numbers:
        R, t = moved_poses(truth.R, truth.t, step[:6])
        return replace(truth, R=R, t=t, q=truth.q + step[6:])

    def with_camera(view: int, step: Array) -> _Numbers:
        cameras = list(truth.T_Rb_camera)
        cameras[view] = RigidTransform.from_components(
            cameras[view].translation + step[3:],
            Rotation.from_rotvec(step[:3]) * cameras[view].rotation,
        )
        return replace(truth, T_Rb_camera=cameras)

    def with_legs(step: Array) -> _Numbers:
        return replace(truth, legs=moved_legs(truth.legs, place, step))

    def with_arms(step: Array) -> _Numbers:
        return replace(truth, legs=moved_legs(truth.legs, design.arms.place, step))

    def with_radius(part: tuple[int, str], step: Array) -> _Numbers:
        return replace(truth, radii={**truth.radii, part: truth.radii[part] + float(step[0])})

    def derivatives(change: Callable[[Array], _Numbers], n: int) -> list[Array]:
        found = []
        for unit in _STEP * np.eye(n):
            ahead, behind = (_offsets(design, ends, change(step)) for step in (unit, -unit))
            found.append(whitening @ ((ahead - behind) / (2.0 * _STEP))[..., None])
        return found

    of_others = [
        *(
            d
            for v in range(len(truth.T_Rb_camera))
            for d in derivatives(partial(with_camera, v), 6)
        ),
        *derivatives(with_legs, len(design.parametrization)),
        *(d for part in design.parts for d in derivatives(partial(with_radius, part), 1)),
        *derivatives(with_arms, len(design.arms)),
    ]
    of_postures = derivatives(with_poses, 6 + truth.q.shape[1])
    return np.concatenate(of_postures, axis=-1), np.concatenate(of_others, axis=-1)


def _offsets(design: Design, ends: Array, numbers: _Numbers) -> Array:
    """Return how far (n, 2) [px] the ends of the true outlines are from those of some numbers."""
    shown, legs, cameras = design.outlines, numbers.legs, numbers.T_Rb_camera
    pose, view, leg = design.pose[shown.row], design.view[shown.row], shown.leg
    A, B = joints_at(legs, numbers.q)[pose, leg], np.array([x.B for x in legs])[leg]
    B = np.einsum("nij,nj->ni", numbers.R[pose], B) + numbers.t[pose]
    for j, arm in arms_at(legs, numbers.q).items():
        of_arm = [i == j and legs[j].is_arm(part) for i, part in zip(leg, shown.part, strict=True)]
        A[of_arm], B[of_arm] = np.moveaxis(arm[pose[of_arm]], 1, 0)
    along = B - A
    u = along / np.linalg.norm(along, axis=1)[:, None]
    turn = np.array([T.rotation.as_matrix().T for T in cameras])[view]
    centre = np.array([T.translation for T in cameras])[view]
    radius = [numbers.radii[key] for key in zip(leg.tolist(), shown.part, strict=True)]
    h = outlines_of_axis(
        np.einsum("nij,nj->ni", turn, u),
        np.einsum("nij,nj->ni", turn, A - centre),
        np.array(radius),
    )
    own = h[np.arange(len(leg)), shown.edge - 1]
    return design.camera.line_offset(own[:, None], ends)


@dataclass(frozen=True, eq=False)
class Determined:
    """Independent parts of the errors of the kinematic parameters, and their covariance."""

    parts: Array  # (r, p) what errors [m, rad] are multiplied with
    covariance: Array  # (r, r) of the products

    @property
    def rank(self) -> int:
        """How many directions of the parameters are determined."""
        return len(self.parts)

    def nse(self, error: Array) -> float:
        """Return the normalised squared error of errors (p,) [m, rad] for each direction."""
        sigma = np.sqrt(np.diagonal(self.covariance))
        z = (self.parts @ error) / sigma
        correlation = self.covariance / np.outer(sigma, sigma)
        return float(z @ np.linalg.solve(correlation, z)) / self.rank


def at_best(design: Design, sigma_q: float, radius_sigma: float, n_held: int = 0) -> Determined:
    """Return the bound of a machine of which some directions are held, those known least.

    Errors count axes as angles from the true ones; what is tied has none.
    """
    n, unit = len(design.parametrization), unit_of(design)
    rows = information_of(design, sigma_q, radius_sigma)
    own = _without(rows[:, n:], rows[:, :n] * unit)
    tied = tied_directions(design)
    free = across(tied) if len(tied) else np.eye(n)
    _, _, directions = np.linalg.svd(own @ free.T)
    parts = across(np.concatenate([directions[len(free) - n_held :] @ free, tied]))
    seen = np.linalg.qr(own @ parts.T, mode="r")
    root = np.linalg.inv(seen)
    return Determined(parts / unit, np.asarray(root @ root.T))


def across(directions: Array) -> Array:
    """Return a basis (n - w, n) of what is perpendicular to directions (w, n)."""
    n = directions.shape[1]
    return np.asarray(null_space(directions).T) if len(directions) else np.eye(n)


def tied_directions(design: Design) -> Array:
    """Return orthonormal directions (w, n) in which parameters cannot move, in ``unit_of``."""
    place, legs = design.parametrization.place, design.legs
    rows = legs.ties.at(legs.nominal)
    return independent(rows, by_step(rows, place) * unit_of(design))[1]


def unit_of(design: Design) -> Array:
    """Return a metre of each parameter in its own unit: angles count at the mean leg length."""
    legs = design.legs.nominal
    ends = np.einsum("kij,lj->kli", design.R, [leg.B for leg in legs]) + design.t[:, None]
    length = float(np.linalg.norm(ends - [leg.A for leg in legs], axis=-1).mean())
    is_length = np.array([u == "m" for u in design.parametrization.units], dtype=np.bool_)
    return np.where(is_length, 1.0, 1.0 / length)


# What errors must be beside the bound: figures over all parameters, with the limits asked for, or
# those of chance where the runs are so few that chance leads beyond them.

Figure = dict[str, Any]


def _figure(value: float, low: float, high: float, *, by_chance: bool) -> Figure:
    """Return a figure of the document."""
    return {
        "value": value,
        "limits": [low, high],
        "limits_of_chance": by_chance,
        "met": low <= value <= high,
    }


def band_of_ratio(n: int) -> tuple[float, float]:
    """Return where 99.9 % of all root mean squares of n unit Gaussians are."""
    n = max(n, 1)
    low, high = (float(chi2.ppf(0.5 + sign * 0.5 * LEVEL, n)) / n for sign in (-1.0, 1.0))
    return low**0.5, high**0.5


def ratio_figure(value: float, n: int, n_parameters: int, largest: float) -> Figure:
    """Return the figure of all errors over the bound; below it is as wrong as far above it."""
    low, high = band_of_ratio(n * n_parameters)
    return _figure(value, low, max(largest, high), by_chance=high > largest)


def nse_figure(value: float, n: int, n_parameters: int, limits: tuple[float, float]) -> Figure:
    """Return the figure of all normalised squared errors."""
    low, high = (limit**2 for limit in band_of_ratio(n * n_parameters))
    by_chance = low < limits[0] or high > limits[1]
    return _figure(value, min(limits[0], low), max(limits[1], high), by_chance=by_chance)


def coverage_figure(shares: Array) -> Figure:
    """Return the figure of all intervals, of the parts (n_runs,) of those of a run that hold truth.

    Intervals of one run hold the truth together or not. Few runs may show no spread: it counts
    beside some runs in which they do.
    """
    n, value = len(shares), float(np.mean(shares))
    together = COVERED * (1.0 - COVERED)
    variance = (n * np.var(shares) + _TOGETHER * together) / (n + _TOGETHER)
    half = _WIDE * float(np.sqrt(variance / n))
    low, high = min(COVERAGE[0], COVERED - half), max(COVERAGE[1], COVERED + half)
    return _figure(value, low, high, by_chance=half > COVERED - COVERAGE[0])


def figure_remarks(machine: str, n: int, figures: Mapping[str, Figure]) -> list[str]:
    """Return which figures of n runs are outside their limits, and which limits are of chance."""
    said = [
        f"{machine}: {name} is {figure['value']:.4f}, outside {figure['limits'][0]:.4f} to "
        f"{figure['limits'][1]:.4f}."
        for name, figure in figures.items()
        if not figure["met"]
    ]
    few = [name for name, figure in figures.items() if figure["limits_of_chance"]]
    if few:
        said.append(
            f"{machine}: {n} runs are too few for the limits of {', '.join(few)}; "
            "those of chance are taken."
        )
    return said
