"""Sensitivity to errors of what counts as known, and score tests of focal lengths.

Encoders carry the absolute scale, and a focal length that is wrong makes perspective wrong in a way
that nothing else in the fit can imitate altogether. What is left in the residuals then has a slope
by the focal length: Rao's score test, which needs no further fit.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from legcal.calibration.joint_fit.problem import FitProblem
from legcal.calibration.joint_fit.variables import LegConstraints, State, intrinsic_of
from legcal.estimation import (
    Linearization,
    NormalEquations,
    PseudoHuber,
    linearize,
    normal_equations,
    residual_changes,
    response,
    score_test,
)
from legcal.geometry import Array
from legcal.machine import LegColumns
from legcal.vision import shared_cameras

FOCAL_PART = 0.01  # of the focal length: the error whose effect is reported
_RADIUS_PART = 0.01
_TWIST_ERROR = np.radians(0.1)
_CAMERA_ERRORS: Mapping[str, tuple[Mapping[str, float], Mapping[str, float]]] = {  # relative, px
    "a focal length 1 % longer": ({"fx": FOCAL_PART, "fy": FOCAL_PART}, {}),
    "a principal point 0.1 px further right": ({}, {"cx": 0.1}),
    "a principal point 0.1 px further down": ({}, {"cy": 0.1}),
}
_KEYS = ("fx", "fy", "cx", "cy")  # the intrinsics in these
_FOCAL: Mapping[str, float] = {"fx": 1.0, "fy": 1.0}  # relative
_SIGNIFICANT = 5.0  # standard deviations
_ROUNDING = 1e-9  # relative, in differences of nearly equal numbers


@dataclass(frozen=True)
class Sensitivity:
    """How an error of what counts as known would change the kinematic parameters."""

    what: str  # the error, in words
    steps: Array  # (p, c) steps of all of them [m, rad], for each independent part of the error


def with_known_intrinsics(
    problem: FitProblem, state: State, linear: Linearization
) -> tuple[FitProblem, Linearization]:
    """Return problem and rows with derivatives by intrinsics that count as known, too."""
    wide = problem.with_keys(tuple(dict.fromkeys((*problem.keys, *_KEYS))))
    without_cameras = {name: linear[name] for name in ("readings", "axes")}
    return wide, linearize(wide, state, without_cameras)


def sensitivities(
    wide: FitProblem,
    state: State,
    linear: Linearization,
    normal: NormalEquations,
    loss: PseudoHuber,
) -> tuple[Sensitivity, ...]:
    """Return how errors of cameras, radii and fixed twists would change the parameters.

    What is estimated without a prior does not count as known. Errors that change no outline are
    left out, as where axes were measured in their place.

    Parameters
    ----------
    wide, state, linear
        Where the fit ended, by :func:`with_known_intrinsics`.
    normal : NormalEquations
        The information there.
    loss : PseudoHuber
    """
    errors = {
        what: ("cameras", _camera_error(wide, state, relative, added))
        for what, (relative, added) in _CAMERA_ERRORS.items()
    }
    radii = np.array([wide.legs.radii[part] for part in wide.outlines.parts])
    errors["radii 1 % larger"] = "radii", _RADIUS_PART * radii[:, None]
    names, changes, pulls = list[str](), list[dict[str, Array]](), list[Array]()
    for what, (block, error) in errors.items():
        place, of_prior = wide.place[block], np.zeros(wide.n_kept + 1)
        of_prior[place] = error
        pull = of_prior[wide.priors.unknown]
        fixed = np.where(place == wide.n_kept, error, 0.0)
        change = residual_changes(wide, linear, block, fixed)
        if change["outlines"].any() or pull.any():
            names.append(what)
            changes.append(change)
            pulls.append(pull / wide.priors.sigma)
    found: list[Sensitivity] = []
    if names:
        moved = {
            factor.name: _efficiency(wide, loss, factor.name)
            * np.stack([change[factor.name] for change in changes], axis=-1)
            for factor in wide.factors
        }
        steps = response(wide, linear, normal, moved)
        steps += normal.kept_covariance() @ linear.prior_J.T @ np.column_stack(pulls)
        found = [
            Sensitivity(what, _of_kinematic(wide, steps[:, [i]])) for i, what in enumerate(names)
        ]
    place = wide.legs.parametrization.place[:, LegColumns.TWIST]
    twisted = [j for j, x in enumerate(place) if x >= 0 and not wide.free[x]]
    if twisted:
        columns = [_of_twist(wide, state, linear, normal, loss, j) for j in twisted]
        what = "twists that are fixed, each 0.1 deg off,"
        found.append(Sensitivity(what, np.column_stack(columns)))
    return tuple(found)


def _efficiency(problem: FitProblem, loss: PseudoHuber, name: str) -> float:
    """Return the information that the loss keeps of a factor."""
    factor = problem.factor(name)
    return loss.efficiency(factor.n_rows) if factor.robust else 1.0


def _camera_error(
    wide: FitProblem, state: State, relative: Mapping[str, float], added: Mapping[str, float]
) -> Array:
    """Return errors (n_views, n_keys) of all cameras, as parts of intrinsics and in pixels."""
    error = np.zeros((len(state.cameras), len(wide.keys)))
    for key, part in relative.items():
        values = [intrinsic_of(camera, key) for camera in state.cameras]
        error[:, wide.keys.index(key)] = part * np.array(values)
    for key, step in added.items():
        error[:, wide.keys.index(key)] = step
    return error


def _of_kinematic(problem: FitProblem, steps: Array) -> Array:
    """Return of steps (n_kept, c) those of all kinematic parameters (p, c)."""
    found = np.zeros((len(problem.free), steps.shape[1]))
    found[problem.free] = steps[: problem.n_kinematic]
    return found


def _of_twist(
    problem: FitProblem,
    state: State,
    linear: Linearization,
    normal: NormalEquations,
    loss: PseudoHuber,
    leg: int,
) -> Array:
    """Return the steps (p,) of kinematic parameters if a fixed twist is off, poses following."""
    motion = _TWIST_ERROR * LegConstraints(problem.legs).following(state, leg, LegColumns.TWIST)
    changes = {
        factor.name: _efficiency(problem, loss, factor.name)
        * linear[factor.name].J_element
        @ motion[factor.element][..., None]
        for factor in problem.factors
        if factor.element is not None  # corners do not depend on poses
    }
    steps = _of_kinematic(problem, response(problem, linear, normal, changes))[:, 0]
    steps[problem.legs.parametrization.place[leg, LegColumns.TWIST]] = _TWIST_ERROR
    return steps


@dataclass(frozen=True)
class FocalLength:
    """What the measurements say of the focal length of a camera that was taken as known."""

    view: str  # the first one by name if several have the camera
    given: float  # fx of the camera [px]
    change: float  # what would have to be added to fx and fy, as a part of them
    sigma: float  # standard deviation of that

    @property
    def is_contradicted(self) -> bool:
        """Whether the measurements disagree with what was given."""
        return abs(self.change) > _SIGNIFICANT * self.sigma

    def __str__(self) -> str:
        found, sigma = self.given * (1.0 + self.change), self.given * self.sigma
        away = abs(self.change) / self.sigma
        return (
            f"The focal length of {self.view} does not agree with the measurements: found fx = "
            f"{found:.1f} +- {sigma:.1f} px, given {self.given:.1f} px, {away:.0f} standard "
            f"deviations and {1e2 * self.change:+.2f} % apart; the stated uncertainty knows "
            "nothing of it; calibrate the camera again, look for pictures that were scaled or "
            f"focused anew, or let the fit find it (--free {self.view}.fx --free {self.view}.fy)."
        )


def focal_lengths(wide: FitProblem, state: State, linear: Linearization) -> tuple[FocalLength, ...]:
    """Return what the measurements say of the focal lengths that the fit took as known.

    One for each camera of which they say anything; arguments as those of :func:`sensitivities`.
    The common-mode biases of outlines are in the problem, so that these do not pass for a focal
    length.
    """
    focal = [wide.keys.index(key) for key in _FOCAL]
    is_known = np.all(wide.place["cameras"][:, focal] == wide.n_kept, axis=1)
    known = [v for v in np.unique(wide.outlines.view).tolist() if is_known[v]]
    owners = shared_cameras(wide.outlines.views, state.cameras)
    tested = sorted({owners[v] for v in known})
    if not tested:
        return ()
    error = _camera_error(wide, state, _FOCAL, {})
    changes = [
        residual_changes(wide, linear, "cameras", error * of_owner[:, None])
        for of_owner in (
            np.array([v in known and owners[v] == owner for v in range(len(owners))])
            for owner in tested
        )
    ]
    columns = {
        name: np.stack([change[name] for change in changes], axis=-1)
        for name in ("outlines", "corners")
    }
    normal = normal_equations(wide, state, linear)
    score, information = score_test(wide, linear, normal, columns)
    whole = sum(np.sum(of_kind**2, axis=(0, 1)) for of_kind in columns.values())
    seen = np.flatnonzero(np.diagonal(information) > _ROUNDING * whole)
    covariance = np.linalg.pinv(information[np.ix_(seen, seen)], rcond=_ROUNDING, hermitian=True)
    change, sigma = -covariance @ score[seen], np.sqrt(np.diagonal(covariance))
    return tuple(
        FocalLength(
            tested[i],
            intrinsic_of(state.cameras[owners.index(tested[i])], "fx"),
            float(d),
            float(s),
        )
        for i, d, s in zip(seen.tolist(), change, sigma, strict=True)
    )
