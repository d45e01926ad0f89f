"""Sensitivity to errors of fixed quantities, and score tests of cameras.

Encoders carry the absolute scale, and no other parameter of the fit imitates the perspective of a
wrong focal length completely. The cost then has a gradient by the focal length at the minimum:
Rao's score test, which needs no further fit.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import ClassVar

import numpy as np

from legcal.calibration.joint_fit.problem import FitProblem
from legcal.calibration.joint_fit.variables import LegConstraints, State, intrinsic_of
from legcal.estimation.problem import Linearization
from legcal.estimation.solver import NormalEquations, normal_equations
from legcal.estimation.uncertainty import residual_changes, response, score_test
from legcal.geometry.types import Array, BoolArray, IntArray
from legcal.machine.leg import LegColumns
from legcal.machine.parameters import is_held_by_default
from legcal.vision.camera import shared_cameras

FITTED_CAMERA = (
    "the camera corrections that the measurements suggest"  # where they contradict their files
)
_FOCAL_PART = 0.01  # relative error of the focal length
_RADIUS_PART = 0.01
_TWIST_ERROR = np.radians(0.1)
_CAMERA_ERRORS: Mapping[str, tuple[Mapping[str, float], Mapping[str, float]]] = {  # relative, px
    "a focal length 1 % longer": ({"fx": _FOCAL_PART, "fy": _FOCAL_PART}, {}),
    "a principal point 0.1 px further to the right": ({}, {"cx": 0.1}),
    "a principal point 0.1 px further down": ({}, {"cy": 0.1}),
}
_KEYS = ("fx", "fy", "cx", "cy", "k1")  # intrinsics in errors and tests
_FOCAL: Mapping[str, float] = {"fx": 1.0, "fy": 1.0}  # relative
_SIGNIFICANT = 5.0  # standard deviations
_ROUNDING = 1e-9  # relative, in differences of nearly equal numbers


@dataclass(frozen=True)
class Sensitivity:
    """Change of the kinematic parameters by an error of a fixed quantity."""

    what: str  # the error, in words
    steps: Array  # (p, c) steps of all parameters [m, rad], for c independent errors


def sensitivities(
    cameras: CameraResiduals, normal: NormalEquations, contradicted: Sequence[WrongIntrinsic] = ()
) -> tuple[Sensitivity, ...]:
    """Return the sensitivity of the parameters to errors of cameras, radii and fixed twists.

    For parameters with a prior, the error is of the prior mean; free ones are left out. So are
    errors that change no outline, as in a fit to measured axes.

    Parameters
    ----------
    cameras : CameraResiduals
        At the minimum of the fit.
    normal : NormalEquations
        The information there.
    contradicted : sequence of WrongIntrinsic
        Contradicted intrinsics of camera files: their corrections are one more error.
    """
    problem, state, linear = cameras.problem, cameras.state, cameras.linear
    radii = np.array([problem.legs.radii[part] for part in problem.outlines.parts])
    camera_columns = _camera_columns(problem)
    errors = {
        what: (camera_columns, _camera_error(state, relative, added))
        for what, (relative, added) in _CAMERA_ERRORS.items()
    }
    if contradicted:
        errors[FITTED_CAMERA] = camera_columns, np.sum([one.error for one in contradicted], axis=0)
    errors["radii 1 % larger"] = problem.columns["radii"], _RADIUS_PART * radii[:, None]
    names, changes, pulls = list[str](), list[dict[str, Array]](), list[Array]()
    for what, (place, error) in errors.items():
        prior_error = np.zeros(problem.n_kept + 1)
        prior_error[place] = error
        pull = prior_error[problem.priors.unknown]
        fixed = np.where(place == problem.n_kept, error, 0.0)
        if place is camera_columns:
            change = cameras.changes(fixed)
        else:
            change = residual_changes(problem, linear, "radii", fixed)
        if change["outlines"].any() or pull.any():
            names.append(what)
            changes.append(change)
            pulls.append(problem.priors.whitened(pull))
    result: list[Sensitivity] = []
    if names:
        residual_changes_of = {
            factor.name: _efficiency(problem, factor.name)
            * np.stack([change[factor.name] for change in changes], axis=-1)
            for factor in problem.factors
            if factor.name in changes[0]
        }
        steps = response(problem, linear, normal, residual_changes_of)
        steps += normal.kept_covariance() @ linear.prior_J.T @ np.column_stack(pulls)
        result = [
            Sensitivity(what, kinematic_steps(problem, steps[:, [i]]))
            for i, what in enumerate(names)
        ]
    parametrization, choices = problem.legs.parametrization, problem.choices
    twists: dict[str, list[Array]] = {}
    for j, x in enumerate(parametrization.place[:, LegColumns.TWIST].tolist()):
        if x >= 0 and not problem.free[x]:
            name = parametrization.names[x]
            is_fixed = choices.holds(name, by_default=is_held_by_default(name))
            step = _twist_steps(problem, state, linear, normal, j)
            twists.setdefault("fixed" if is_fixed else "tied", []).append(step)
    for how, steps_of_twists in twists.items():
        what = f"an error of 0.1 deg in each {how} twist"
        result.append(Sensitivity(what, np.column_stack(steps_of_twists)))
    return tuple(result)


def _camera_columns(problem: FitProblem) -> IntArray:
    """Columns in x (n_views, 5) of the tested intrinsics."""
    place = np.full((len(problem.outlines.views), len(_KEYS)), problem.n_kept, dtype=np.intp)
    for k, key in enumerate(_KEYS):
        if key in problem.keys:
            place[:, k] = problem.columns["cameras"][:, problem.keys.index(key)]
    return place


def _efficiency(problem: FitProblem, name: str) -> float:
    """Efficiency of the loss for a factor."""
    factor = problem.factor(name)
    return problem.loss.efficiency(factor.n_rows) if factor.robust else 1.0


def _camera_error(state: State, relative: Mapping[str, float], added: Mapping[str, float]) -> Array:
    """Errors (n_views, 5) of all cameras: relative ones, then added ones."""
    error = np.zeros((len(state.cameras), len(_KEYS)))
    for key, part in relative.items():
        values = [intrinsic_of(camera, key) for camera in state.cameras]
        error[:, _KEYS.index(key)] = part * np.array(values)
    for key, step in added.items():
        error[:, _KEYS.index(key)] = step
    return error


def kinematic_steps(problem: FitProblem, steps: Array) -> Array:
    """Extract the steps (p, c) of all kinematic parameters from steps (n_kept, c)."""
    kinematic = np.zeros((len(problem.free), steps.shape[1]))
    kinematic[problem.free] = steps[: problem.n_kinematic]
    return kinematic


def _twist_steps(
    problem: FitProblem,
    state: State,
    linear: Linearization,
    normal: NormalEquations,
    leg: int,
) -> Array:
    """Return the steps (p,) of kinematic parameters by an error of a fixed twist."""
    motion = _TWIST_ERROR * LegConstraints(problem.parameters).following(
        state, leg, LegColumns.TWIST
    )
    changes = {
        factor.name: _efficiency(problem, factor.name)
        * linear[factor.name].J_element
        @ motion[factor.element][..., None]
        for factor in problem.factors
        if factor.element is not None  # corners on the base do not depend on poses
    }
    steps = kinematic_steps(problem, response(problem, linear, normal, changes))[:, 0]
    steps[problem.legs.parametrization.place[leg, LegColumns.TWIST]] = _TWIST_ERROR
    return steps


@dataclass(frozen=True, eq=False)
class WrongIntrinsic:
    """Intrinsics in a camera file that contradict the measurements."""

    units: ClassVar[tuple[tuple[Mapping[str, float], Mapping[str, float]], ...]]  # relative, added
    keys: ClassVar[tuple[str, ...]]  # of the intrinsics

    view: str  # the first one by name if several have the camera
    given: Array  # (u,) in the camera file
    change: Array  # (u,) correction, in ``units``
    sigma: Array  # (u,) standard deviations of the correction
    apart: float  # correction in standard deviations
    error: Array  # (n_views, 5) the correction, in all views

    @property
    def camera(self) -> str:
        """The first view by name that has this camera."""
        return self.view


class FocalLength(WrongIntrinsic):
    """A focal length: ``given`` is fx [px], ``change`` that of fx and fy, as a part of them."""

    units = ((_FOCAL, {}),)
    keys = ("fx",)

    def __str__(self) -> str:
        (given,), (change,) = self.given, self.change
        return (
            f"The focal length of {self.view} does not agree with the measurements: found fx = "
            f"{given * (1.0 + change):.1f} +- {given * self.sigma[0]:.1f} px, given "
            f"{given:.1f} px, {self.apart:.0f} standard deviations and {1e2 * change:+.2f} % "
            "apart; the stated uncertainty does not include this error; calibrate the camera again "
            "at the same focus and zoom, look for photographs that were scaled or refocused, or "
            f"estimate it (--set {self.view}.fx=free --set {self.view}.fy=free)."
        )


@dataclass(frozen=True, eq=False)
class ZoomedView(FocalLength):
    """The focal length of a view against that of the other views with its camera file."""

    of_others: str = ""  # the first view by name that has this camera

    @property
    def camera(self) -> str:
        """The first view by name that has this camera."""
        return self.of_others

    def __str__(self) -> str:
        return (
            f"The focal length of view {self.view} does not agree with the other views of its "
            f"camera: it differs by {1e2 * self.change[0]:+.2f} +- {1e2 * self.sigma[0]:.2f} %, "
            f"{self.apart:.0f} standard deviations; the stated uncertainty does not include this "
            "error; look for photographs of that view that were zoomed, scaled, cropped or "
            "refocused, and calibrate its camera with the settings used there."
        )


class PrincipalPoint(WrongIntrinsic):
    """A principal point, cx and cy [px]."""

    units = (({}, {"cx": 1.0}), ({}, {"cy": 1.0}))
    keys = ("cx", "cy")

    def __str__(self) -> str:
        (cx, cy), (dx, dy) = self.given + self.change, self.sigma
        return (
            f"The principal point of {self.view} does not agree with the measurements: found it at "
            f"({cx:.1f} +- {dx:.1f}, {cy:.1f} +- {dy:.1f}) px, given ({self.given[0]:.1f}, "
            f"{self.given[1]:.1f}) px, {self.apart:.0f} standard deviations apart; the stated "
            "uncertainty does not include this error; look for photographs that were cropped or "
            "stabilised, calibrate the camera again at the same focus and zoom, or estimate it "
            f"(--set {self.view}.cx=free --set {self.view}.cy=free)."
        )


class LensDistortion(WrongIntrinsic):
    """A distortion, by its first coefficient k1, which is the largest in most lenses."""

    units = (({}, {"k1": 1.0}),)
    keys = ("k1",)

    def __str__(self) -> str:
        (given,), (found,) = self.given, self.given + self.change
        looks = ""
        if abs(found) < 0.5 * abs(given):
            looks = "; the lens distortion of the photographs appears to have been removed"
        elif given == 0.0:
            looks = "; the lens distortion of the photographs appears not to have been removed"
        return (
            f"The distortion of {self.view} does not agree with the measurements: found k1 = "
            f"{found:.3f} +- {self.sigma[0]:.3f}, given {given:.3f}, {self.apart:.0f} standard "
            f"deviations apart{looks}; the stated uncertainty does not include this error; take "
            "and process the photographs of board and machine alike, with lens correction in all "
            "or in none, and calibrate the camera again."
        )


@dataclass(frozen=True, eq=False)
class CameraResiduals:
    """Score tests of the cameras of a fit, from the residuals at its minimum."""

    problem: FitProblem
    state: State
    linear: Linearization

    @cached_property
    def derivatives(self) -> dict[str, Array]:
        """Derivatives (n, q, 5) of whitened residuals by intrinsics of their view.

        Of outlines and corners, by focal lengths, principal point and first coefficient of
        distortion, whether estimated or fixed.
        """
        problem, state = self.problem, self.state
        outlines = problem.outlines.by_intrinsics(_KEYS, problem.keys, state)
        whitening = np.asarray(problem.factor("outlines").whitening)
        return {
            "outlines": np.einsum("nij,njk->nik", whitening, outlines),
        } | {
            corners.name: corners.by_intrinsics(_KEYS, state) / corners.sigma[:, None, None]
            for corners in problem.boards
        }

    @cached_property
    def _plain(self) -> NormalEquations:
        """The normal equations of plain squares."""
        return normal_equations(self.problem, self.state, self.linear)

    def changes(self, error: Array) -> dict[str, Array]:
        """Return the change of whitened residuals (n, q) by errors (n_views, 5) of cameras."""
        views = {corners.name: corners.view for corners in self.problem.boards}
        views["outlines"] = self.problem.outlines.view
        return {
            name: np.einsum("nqk,nk->nq", by, error[views[name]])
            for name, by in self.derivatives.items()
        }

    def zoomed(self, view: int) -> dict[str, Array]:
        """Return the change of whitened residuals (n, q) by an error of a view's focal length."""
        error = _camera_error(self.state, _FOCAL, {})
        return self.changes(error * (np.arange(len(error)) == view)[:, None])

    def contradicted(self) -> list[WrongIntrinsic]:
        """Return the intrinsics in camera files that contradict the measurements.

        One error of a camera resembles others: the most significant one is selected first, and
        further ones only if they stay significant after its correction.
        """
        owners = shared_cameras(self.problem.outlines.views, self.problem.first_cameras)
        zoomed = {test.camera: test for test in self._zoomed_views()}
        contradicted = list[WrongIntrinsic]()
        for owner in dict.fromkeys(owners):
            wrong = self._wrong_intrinsics(owner)
            zoomed_view = zoomed.get(owner)
            clearest = max((test.apart for test in wrong), default=_SIGNIFICANT)
            contradicted += (
                wrong if zoomed_view is None or zoomed_view.apart <= clearest else [zoomed_view]
            )
        return contradicted

    def _wrong_intrinsics(self, owner: str) -> list[WrongIntrinsic]:
        """Contradicted intrinsics of a camera, by its representative view.

        Intrinsics with a choice are not tested. The problem includes common-mode biases and the
        covariance of camera files, so that these are not mistaken for a wrong file.
        """
        kinds, errors, error_indices = list[type[WrongIntrinsic]](), list[Array](), list[IntArray]()
        for kind in (FocalLength, PrincipalPoint, LensDistortion):
            units = [_camera_error(self.state, *unit) for unit in kind.units]
            known_views, owners = self._known_views(np.sum(units, axis=0))
            views_of_camera = np.array(
                [v in known_views and owners[v] == owner for v in range(len(owners))]
            )
            if views_of_camera.any():
                kinds.append(kind)
                error_indices.append(len(errors) + np.arange(len(units), dtype=np.intp))
                errors += [views_of_camera[:, None] * unit for unit in units]
        if not kinds:
            return []
        score, information = self._score(errors)
        selected = _forward_selection(score, information, error_indices)
        if not selected:
            return []
        errors_of_wrong = np.concatenate([error_indices[k] for k in selected])
        covariance = _inverse(information, errors_of_wrong)
        change, sigma = -covariance @ score[errors_of_wrong], np.sqrt(np.diagonal(covariance))
        camera = self.problem.first_cameras[self.problem.outlines.views.index(owner)]
        wrong_intrinsics = []
        for k, gain in selected.items():
            views_of_camera = np.isin(errors_of_wrong, error_indices[k])
            given = np.array([intrinsic_of(camera, key) for key in kinds[k].keys])
            error = np.tensordot(
                change[views_of_camera],
                [errors[i] for i in errors_of_wrong[views_of_camera].tolist()],
                axes=1,
            )
            wrong_intrinsics.append(
                kinds[k](owner, given, change[views_of_camera], sigma[views_of_camera], gain, error)
            )
        return wrong_intrinsics

    def _zoomed_views(self) -> list[ZoomedView]:
        """Return the view of each camera whose focal length differs most from its other views.

        Causes are digital zoom and refocusing. Cameras with choices for intrinsics, or with only
        one informative view, are not tested.
        """
        problem, error = self.problem, _camera_error(self.state, _FOCAL, {})
        known_views, owners = self._known_views(error)
        views = [v for v in known_views if sum(owners[k] == owners[v] for k in known_views) > 1]
        if not views:
            return []
        masks = [np.arange(len(owners)) == v for v in views]
        visible, change, covariance = self._scores(error, masks)
        zoomed = []
        for owner in sorted({owners[v] for v in views}):
            indices = [i for i, k in enumerate(visible.tolist()) if owners[views[k]] == owner]
            weight = _inverse(covariance, np.array(indices, dtype=np.intp))
            tests = []
            for i, k in enumerate(indices if len(indices) > 1 else []):
                X = np.column_stack([np.ones(len(indices)), np.arange(len(indices)) == i])
                spread = np.linalg.inv(X.T @ weight @ X)
                apart = float((spread @ X.T @ weight @ change[indices])[1])
                view = views[int(visible[k])]
                given = intrinsic_of(problem.first_cameras[view], "fx")
                name, sigma = problem.outlines.views[view], float(np.sqrt(spread[1, 1]))
                if not sigma > 0.0:  # of measurements without noise
                    continue
                zoom = apart * error * (np.arange(len(error)) == view)[:, None]
                numbers = np.array([given]), np.array([apart]), np.array([sigma])
                tests.append(ZoomedView(name, *numbers, abs(apart) / sigma, zoom, owner))
            zoomed += sorted(tests, key=lambda test: test.apart)[-1:]
        return zoomed

    def _known_views(self, error: Array) -> tuple[list[int], tuple[str, ...]]:
        """Return views with the intrinsics in *error* from files, and the camera of each view."""
        problem, wrong = self.problem, np.flatnonzero(np.any(error, axis=0))
        known_columns = np.append(problem.calibrated, problem.n_kept)
        is_known = np.all(np.isin(_camera_columns(problem)[:, wrong], known_columns), axis=1)
        known_views = [v for v in np.unique(problem.outlines.view).tolist() if is_known[v]]
        return known_views, shared_cameras(problem.outlines.views, problem.first_cameras)

    def _scores(self, error: Array, masks: Sequence[BoolArray]) -> tuple[IntArray, Array, Array]:
        """Estimate the size of an error in c sets of views jointly.

        Return the sets with information (k,), their sizes (k,) relative to *error*, and the
        covariance (k, k).
        """
        score, information = self._score([error * mask[:, None] for mask in masks])
        visible = np.flatnonzero(np.diagonal(information) > 0.0)
        covariance = _inverse(information, visible)
        return visible, -covariance @ score[visible], covariance

    def _score(self, errors: Sequence[Array]) -> tuple[Array, Array]:
        """Score (c,) of errors (n_views, 5) of cameras, and its information (c, c).

        The information of errors invisible in the residuals is zero.
        """
        changes = [self.changes(error) for error in errors]
        columns = {
            name: np.stack([change[name] for change in changes], axis=-1)
            for name in self.derivatives
        }
        score, information = score_test(self.problem, self.linear, self._plain, columns)
        total = sum(np.sum(of_kind**2, axis=(0, 1)) for of_kind in columns.values())
        invisible = np.diagonal(information) <= _ROUNDING * total
        information[invisible] = information[:, invisible] = score[invisible] = 0.0
        return score, information


def _forward_selection(
    score: Array, information: Array, groups: Sequence[IntArray]
) -> dict[int, float]:
    """Select significant groups of errors, the most significant first.

    Return the significance of each in standard deviations, given the groups before it.
    """
    candidates = [
        k for k, indices in enumerate(groups) if np.all(np.diagonal(information)[indices] > 0.0)
    ]
    chosen, so_far = dict[int, float](), 0.0

    def explained(numbers: Sequence[int]) -> float:
        indices = np.concatenate([groups[k] for k in numbers])
        return float(score[indices] @ _inverse(information, indices) @ score[indices])

    while candidates:
        value = {k: explained([*chosen, k]) for k in candidates}
        best = max(candidates, key=value.__getitem__)
        gain = float(np.sqrt(max(value[best] - so_far, 0.0)))
        if gain <= _SIGNIFICANT:
            break
        candidates.remove(best)
        chosen[best], so_far = gain, value[best]
    return chosen


def _inverse(matrix: Array, at: IntArray) -> Array:
    """Pseudoinverse of the rows and columns *at* (c,) of a symmetric matrix."""
    block = matrix[np.ix_(at, at)]
    return np.asarray(np.linalg.pinv(block, rcond=_ROUNDING, hermitian=True), dtype=np.float64)
