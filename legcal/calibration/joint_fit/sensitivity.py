"""Sensitivity to errors of what counts as known, and score tests of cameras.

Encoders carry the absolute scale, and a focal length that is wrong makes perspective wrong in a way
that nothing else in the fit can imitate altogether. What is left in the residuals then has a slope
by the focal length: Rao's score test, which needs no further fit.
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

FOUND_CAMERA = "cameras as the measurements have them"  # where these contradict their files
_FOCAL_PART = 0.01  # of the focal length: the error whose effect is reported
_RADIUS_PART = 0.01
_TWIST_ERROR = np.radians(0.1)
_CAMERA_ERRORS: Mapping[str, tuple[Mapping[str, float], Mapping[str, float]]] = {  # relative, px
    "a focal length 1 % longer": ({"fx": _FOCAL_PART, "fy": _FOCAL_PART}, {}),
    "a principal point 0.1 px further right": ({}, {"cx": 0.1}),
    "a principal point 0.1 px further down": ({}, {"cy": 0.1}),
}
_KEYS = ("fx", "fy", "cx", "cy", "k1")  # the intrinsics in these, and of tests
_FOCAL: Mapping[str, float] = {"fx": 1.0, "fy": 1.0}  # relative
_SIGNIFICANT = 5.0  # standard deviations
_ROUNDING = 1e-9  # relative, in differences of nearly equal numbers


@dataclass(frozen=True)
class Sensitivity:
    """How an error of what counts as known would change the kinematic parameters."""

    what: str  # the error, in words
    steps: Array  # (p, c) steps of all of them [m, rad], for each independent part of the error


def sensitivities(
    cameras: CameraResiduals, normal: NormalEquations, contradicted: Sequence[WrongIntrinsic] = ()
) -> tuple[Sensitivity, ...]:
    """Return how errors of cameras, radii and fixed twists would change the parameters.

    What is estimated without a prior does not count as known. Errors that change no outline are
    left out, as where axes were measured in their place.

    Parameters
    ----------
    cameras : CameraResiduals
        Where the fit ended.
    normal : NormalEquations
        The information there.
    contradicted : sequence of WrongIntrinsic
        What the measurements contradict of cameras: what they have instead is one more error.
    """
    problem, state, linear = cameras.problem, cameras.state, cameras.linear
    radii = np.array([problem.legs.radii[part] for part in problem.outlines.parts])
    of_cameras = _places_of_cameras(problem)
    errors = {
        what: (of_cameras, _camera_error(state, relative, added))
        for what, (relative, added) in _CAMERA_ERRORS.items()
    }
    if contradicted:
        errors[FOUND_CAMERA] = of_cameras, np.sum([one.error for one in contradicted], axis=0)
    errors["radii 1 % larger"] = problem.columns["radii"], _RADIUS_PART * radii[:, None]
    names, changes, pulls = list[str](), list[dict[str, Array]](), list[Array]()
    for what, (place, error) in errors.items():
        of_prior = np.zeros(problem.n_kept + 1)
        of_prior[place] = error
        pull = of_prior[problem.priors.unknown]
        fixed = np.where(place == problem.n_kept, error, 0.0)
        if place is of_cameras:
            change = cameras.changes(fixed)
        else:
            change = residual_changes(problem, linear, "radii", fixed)
        if change["outlines"].any() or pull.any():
            names.append(what)
            changes.append(change)
            pulls.append(problem.priors.whitened(pull))
    found: list[Sensitivity] = []
    if names:
        moved = {
            factor.name: _efficiency(problem, factor.name)
            * np.stack([change[factor.name] for change in changes], axis=-1)
            for factor in problem.factors
            if factor.name in changes[0]
        }
        steps = response(problem, linear, normal, moved)
        steps += normal.kept_covariance() @ linear.prior_J.T @ np.column_stack(pulls)
        found = [
            Sensitivity(what, _of_kinematic(problem, steps[:, [i]])) for i, what in enumerate(names)
        ]
    every, choices = problem.legs.parametrization, problem.choices
    twists: dict[str, list[Array]] = {}
    for j, x in enumerate(every.place[:, LegColumns.TWIST].tolist()):
        if x >= 0 and not problem.free[x]:
            name = every.names[x]
            is_fixed = choices.holds(name, by_default=is_held_by_default(name))
            step = _of_twist(problem, state, linear, normal, j)
            twists.setdefault("fixed" if is_fixed else "tied", []).append(step)
    for how, steps_of_twists in twists.items():
        what = f"twists that are {how}, each 0.1 deg off,"
        found.append(Sensitivity(what, np.column_stack(steps_of_twists)))
    return tuple(found)


def _places_of_cameras(problem: FitProblem) -> IntArray:
    """Return the positions in x (n_views, 5) of the intrinsics that are looked at."""
    place = np.full((len(problem.outlines.views), len(_KEYS)), problem.n_kept, dtype=np.intp)
    for k, key in enumerate(_KEYS):
        if key in problem.keys:
            place[:, k] = problem.columns["cameras"][:, problem.keys.index(key)]
    return place


def _efficiency(problem: FitProblem, name: str) -> float:
    """Return the information that the loss keeps of a factor."""
    factor = problem.factor(name)
    return problem.loss.efficiency(factor.n_rows) if factor.robust else 1.0


def _camera_error(state: State, relative: Mapping[str, float], added: Mapping[str, float]) -> Array:
    """Return errors (n_views, 5) of all cameras, as parts of intrinsics and in pixels."""
    error = np.zeros((len(state.cameras), len(_KEYS)))
    for key, part in relative.items():
        values = [intrinsic_of(camera, key) for camera in state.cameras]
        error[:, _KEYS.index(key)] = part * np.array(values)
    for key, step in added.items():
        error[:, _KEYS.index(key)] = step
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
    leg: int,
) -> Array:
    """Return the steps (p,) of kinematic parameters if a fixed twist is off, poses following."""
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
    steps = _of_kinematic(problem, response(problem, linear, normal, changes))[:, 0]
    steps[problem.legs.parametrization.place[leg, LegColumns.TWIST]] = _TWIST_ERROR
    return steps


@dataclass(frozen=True, eq=False)
class WrongIntrinsic:
    """Intrinsics of a camera that the measurements contradict, which its file says."""

    units: ClassVar[tuple[tuple[Mapping[str, float], Mapping[str, float]], ...]]  # relative, added
    keys: ClassVar[tuple[str, ...]]  # the intrinsics that these are

    view: str  # the first one by name if several have the camera
    given: Array  # (u,) in the camera file
    change: Array  # (u,) what would have to be added, in these units
    sigma: Array  # (u,) standard deviations of that
    apart: float  # standard deviations between what was given and what was found
    error: Array  # (n_views, 5) the same change in all views

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
            "apart; the stated uncertainty knows nothing of it; calibrate the camera again at the "
            "same focus and zoom, look for pictures that were scaled or focused anew, or let the "
            f"fit find it (--set {self.view}.fx=free --set {self.view}.fy=free)."
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
            f"camera: found it {1e2 * self.change[0]:+.2f} +- {1e2 * self.sigma[0]:.2f} % apart "
            f"from theirs, {self.apart:.0f} standard deviations; the stated uncertainty knows "
            "nothing of it; look for photographs of that view that were zoomed, scaled, cropped or "
            "focused anew, and calibrate its camera as it was there."
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
            "uncertainty knows nothing of it; look for photographs that were cropped or "
            "stabilised, calibrate the camera again at the same focus and zoom, or let the fit "
            f"find it (--set {self.view}.cx=free --set {self.view}.cy=free)."
        )


class LensDistortion(WrongIntrinsic):
    """A distortion, by its first coefficient k1, which is the largest in most lenses."""

    units = (({}, {"k1": 1.0}),)
    keys = ("k1",)

    def __str__(self) -> str:
        (given,), (found,) = self.given, self.given + self.change
        looks = ""
        if abs(found) < 0.5 * abs(given):
            looks = "; the photographs look as if they had been corrected for their lens"
        elif given == 0.0:
            looks = "; the photographs look as if they had not been corrected for their lens"
        return (
            f"The distortion of {self.view} does not agree with the measurements: found k1 = "
            f"{found:.3f} +- {self.sigma[0]:.3f}, given {given:.3f}, {self.apart:.0f} standard "
            f"deviations apart{looks}; the stated uncertainty knows nothing of it; take and "
            "process the photographs of board and machine alike, with lens correction in all or in "
            "none, and calibrate the camera again."
        )


@dataclass(frozen=True, eq=False)
class CameraResiduals:
    """What the residuals of a fit say of its cameras, where it ended."""

    problem: FitProblem
    state: State
    linear: Linearization

    @cached_property
    def derivatives(self) -> dict[str, Array]:
        """Derivatives (n, q, 5) of whitened residuals by intrinsics, known or not.

        They are of outlines and corners, by focal lengths, principal point and first coefficient
        of distortion of the view of each.
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
        """Return how whitened residuals (n, q) change with errors (n_views, 5) of cameras."""
        views = {corners.name: corners.view for corners in self.problem.boards}
        views["outlines"] = self.problem.outlines.view
        return {
            name: np.einsum("nqk,nk->nq", by, error[views[name]])
            for name, by in self.derivatives.items()
        }

    def contradicted(self) -> list[WrongIntrinsic]:
        """Return what the measurements contradict of camera files.

        One mistake in a camera looks like others: what they show most clearly counts, and beside
        it only what they still show once that is corrected.
        """
        owners = shared_cameras(self.problem.outlines.views, self.problem.first_cameras)
        zoomed = {test.camera: test for test in self._zoomed_views()}
        found = list[WrongIntrinsic]()
        for owner in dict.fromkeys(owners):
            wrong = self._wrong_intrinsics(owner)
            zoom = zoomed.get(owner)
            clearest = max((one.apart for one in wrong), default=_SIGNIFICANT)
            found += wrong if zoom is None or zoom.apart <= clearest else [zoom]
        return found

    def _wrong_intrinsics(self, owner: str) -> list[WrongIntrinsic]:
        """Return what the measurements contradict of a camera, by the view that stands for it.

        Of what nothing was chosen. The common-mode biases of outlines are in the problem, and so
        are errors of intrinsics with the covariance that camera files state, so that these do not
        pass for a wrong file.
        """
        kinds, errors, place = list[type[WrongIntrinsic]](), list[Array](), list[IntArray]()
        for kind in (FocalLength, PrincipalPoint, LensDistortion):
            units = [_camera_error(self.state, *unit) for unit in kind.units]
            known, owners = self._known_views(np.sum(units, axis=0))
            own = np.array([v in known and owners[v] == owner for v in range(len(owners))])
            if own.any():
                kinds.append(kind)
                place.append(len(errors) + np.arange(len(units), dtype=np.intp))
                errors += [own[:, None] * unit for unit in units]
        if not kinds:
            return []
        score, information = self._score(errors)
        wrong = _forward_selection(score, information, place)
        if not wrong:
            return []
        at = np.concatenate([place[k] for k in wrong])
        covariance = _inverse(information, at)
        change, sigma = -covariance @ score[at], np.sqrt(np.diagonal(covariance))
        camera = self.problem.first_cameras[self.problem.outlines.views.index(owner)]
        found = []
        for k, gain in wrong.items():
            own = np.isin(at, place[k])
            given = np.array([intrinsic_of(camera, key) for key in kinds[k].keys])
            error = np.tensordot(change[own], [errors[i] for i in at[own].tolist()], axes=1)
            found.append(kinds[k](owner, given, change[own], sigma[own], gain, error))
        return found

    def _zoomed_views(self) -> list[ZoomedView]:
        """Return of each camera the view whose focal length differs most from the others'.

        Digital zoom, and a focus that was set anew for one place of the camera. Views of a camera
        of which something was chosen, or of which another view says nothing, are not compared.
        """
        problem, error = self.problem, _camera_error(self.state, _FOCAL, {})
        known, owners = self._known_views(error)
        views = [v for v in known if sum(owners[k] == owners[v] for k in known) > 1]
        if not views:
            return []
        each = [np.arange(len(owners)) == v for v in views]
        seen, change, covariance = self._scores(error, each)
        found = []
        for owner in sorted({owners[v] for v in views}):
            own = [i for i, k in enumerate(seen.tolist()) if owners[views[k]] == owner]
            weight = _inverse(covariance, np.array(own, dtype=np.intp))
            tests = []
            for i, k in enumerate(own if len(own) > 1 else []):
                X = np.column_stack([np.ones(len(own)), np.arange(len(own)) == i])
                spread = np.linalg.inv(X.T @ weight @ X)
                apart = float((spread @ X.T @ weight @ change[own])[1])
                view = views[int(seen[k])]
                given = intrinsic_of(problem.first_cameras[view], "fx")
                name, sigma = problem.outlines.views[view], float(np.sqrt(spread[1, 1]))
                if not sigma > 0.0:  # of measurements without noise
                    continue
                zoom = apart * error * (np.arange(len(error)) == view)[:, None]
                there = np.array([given]), np.array([apart]), np.array([sigma])
                tests.append(ZoomedView(name, *there, abs(apart) / sigma, zoom, owner))
            found += sorted(tests, key=lambda test: test.apart)[-1:]
        return found

    def _known_views(self, error: Array) -> tuple[list[int], tuple[str, ...]]:
        """Return views whose intrinsics with an error are as files say, and each view's camera."""
        problem, wrong = self.problem, np.flatnonzero(np.any(error, axis=0))
        of_files = np.append(problem.calibrated, problem.n_kept)
        is_known = np.all(np.isin(_places_of_cameras(problem)[:, wrong], of_files), axis=1)
        known = [v for v in np.unique(problem.outlines.view).tolist() if is_known[v]]
        return known, shared_cameras(problem.outlines.views, problem.first_cameras)

    def _scores(self, error: Array, which: Sequence[BoolArray]) -> tuple[IntArray, Array, Array]:
        """Return how much of an error the residuals show in some views, for c choices together.

        Which of these the residuals say anything of, (k,), how much of the error, (k,), and its
        covariance.
        """
        score, information = self._score([error * own[:, None] for own in which])
        seen = np.flatnonzero(np.diagonal(information) > 0.0)
        covariance = _inverse(information, seen)
        return seen, -covariance @ score[seen], covariance

    def _score(self, errors: Sequence[Array]) -> tuple[Array, Array]:
        """Return the slope (c,) by parts of errors (n_views, 5) of cameras, and its information.

        Of errors of which the residuals say nothing the information is zero.
        """
        changes = [self.changes(error) for error in errors]
        columns = {
            name: np.stack([change[name] for change in changes], axis=-1)
            for name in self.derivatives
        }
        score, information = score_test(self.problem, self.linear, self._plain, columns)
        whole = sum(np.sum(of_kind**2, axis=(0, 1)) for of_kind in columns.values())
        unseen = np.diagonal(information) <= _ROUNDING * whole
        information[unseen] = information[:, unseen] = score[unseen] = 0.0
        return score, information


def _forward_selection(
    score: Array, information: Array, groups: Sequence[IntArray]
) -> dict[int, float]:
    """Return the groups of errors that residuals show, the clearest first.

    Of each, by its number, how many standard deviations it is off beside those before it.
    """
    left = [k for k, at in enumerate(groups) if np.all(np.diagonal(information)[at] > 0.0)]
    chosen, so_far = dict[int, float](), 0.0

    def explained(which: Sequence[int]) -> float:
        at = np.concatenate([groups[k] for k in which])
        return float(score[at] @ _inverse(information, at) @ score[at])

    while left:
        value = {k: explained([*chosen, k]) for k in left}
        best = max(left, key=value.__getitem__)
        gain = float(np.sqrt(max(value[best] - so_far, 0.0)))
        if gain <= _SIGNIFICANT:
            break
        left.remove(best)
        chosen[best], so_far = gain, value[best]
    return chosen


def _inverse(matrix: Array, at: IntArray) -> Array:
    """Return the inverse of some rows and columns (c,) of a symmetric matrix, on its range."""
    own = matrix[np.ix_(at, at)]
    return np.asarray(np.linalg.pinv(own, rcond=_ROUNDING, hermitian=True), dtype=np.float64)
