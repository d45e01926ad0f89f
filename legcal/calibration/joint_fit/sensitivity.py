"""Sensitivity to errors of what counts as known, and score tests of cameras.

Encoders carry the absolute scale, and a focal length that is wrong makes perspective wrong in a way
that nothing else in the fit can imitate altogether. What is left in the residuals then has a slope
by the focal length: Rao's score test, which needs no further fit.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from legcal.calibration.joint_fit.problem import FitProblem
from legcal.calibration.joint_fit.variables import LegConstraints, State, intrinsic_of
from legcal.estimation import (
    Linearization,
    NormalEquations,
    normal_equations,
    residual_changes,
    response,
    score_test,
)
from legcal.geometry import Array, BoolArray, IntArray
from legcal.machine import LegColumns, is_held_by_default
from legcal.vision import Camera, shared_cameras

FOCAL_PART = 0.01  # of the focal length: the error whose effect is reported
FOUND_DISTORTION = "the distortion that the measurements show"
_RADIUS_PART = 0.01
_TWIST_ERROR = np.radians(0.1)
_CAMERA_ERRORS: Mapping[str, tuple[Mapping[str, float], Mapping[str, float]]] = {  # relative, px
    "a focal length 1 % longer": ({"fx": FOCAL_PART, "fy": FOCAL_PART}, {}),
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
    cameras: CameraResiduals, normal: NormalEquations, distorted: Sequence[LensDistortion] = ()
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
    distorted : sequence of LensDistortion
        Those that the measurements contradict: what they have instead is one more error.
    """
    problem, state, linear = cameras.problem, cameras.state, cameras.linear
    radii = np.array([problem.legs.radii[part] for part in problem.outlines.parts])
    of_cameras = _places_of_cameras(problem)
    errors = {
        what: (of_cameras, _camera_error(state, relative, added))
        for what, (relative, added) in _CAMERA_ERRORS.items()
    }
    if distorted:
        owners = shared_cameras(problem.outlines.views, problem.first_cameras)
        by_owner = {lens.view: lens.change for lens in distorted}
        error = np.zeros((len(owners), len(_KEYS)))
        error[:, _KEYS.index("k1")] = [by_owner.get(owner, 0.0) for owner in owners]
        errors[FOUND_DISTORTION] = of_cameras, error
    errors["radii 1 % larger"] = problem.place["radii"], _RADIUS_PART * radii[:, None]
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
            place[:, k] = problem.place["cameras"][:, problem.keys.index(key)]
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


@dataclass(frozen=True)
class _TestedIntrinsic:
    """What the measurements say of an intrinsic of a camera whose file says what it is."""

    view: str  # the first one by name if several have the camera
    given: float  # in the camera file
    change: float  # what would have to be added to it
    sigma: float  # standard deviation of that

    @property
    def apart(self) -> float:
        """How many standard deviations lie between what was given and what was found."""
        return abs(self.change) / self.sigma

    @property
    def is_contradicted(self) -> bool:
        """Whether the measurements disagree with what was given."""
        return self.apart > _SIGNIFICANT

    @property
    def camera(self) -> str:
        """The first view by name that has this camera."""
        return self.view


class FocalLength(_TestedIntrinsic):
    """A focal length: ``given`` is fx [px], ``change`` that of fx and fy, as a part of them."""

    def __str__(self) -> str:
        found, sigma = self.given * (1.0 + self.change), self.given * self.sigma
        return (
            f"The focal length of {self.view} does not agree with the measurements: found fx = "
            f"{found:.1f} +- {sigma:.1f} px, given {self.given:.1f} px, {self.apart:.0f} standard "
            f"deviations and {1e2 * self.change:+.2f} % apart; the stated uncertainty knows "
            "nothing of it; calibrate the camera again at the same focus and zoom, look for "
            "pictures that were scaled or focused anew, or let the fit find it "
            f"(--free {self.view}.fx --free {self.view}.fy)."
        )


@dataclass(frozen=True)
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
            f"camera: found it {1e2 * self.change:+.2f} +- {1e2 * self.sigma:.2f} % apart from "
            f"theirs, {self.apart:.0f} standard deviations; the stated uncertainty knows nothing "
            "of it; look for photographs of that view that were zoomed, scaled, cropped or focused "
            "anew, and calibrate its camera as it was there."
        )


class LensDistortion(_TestedIntrinsic):
    """A distortion, by its first coefficient k1."""

    def __str__(self) -> str:
        found = self.given + self.change
        looks = ""
        if abs(found) < 0.5 * abs(self.given):
            looks = "; the photographs look as if they had been corrected for their lens"
        elif self.given == 0.0:
            looks = "; the photographs look as if they had not been corrected for their lens"
        return (
            f"The distortion of {self.view} does not agree with the measurements: found k1 = "
            f"{found:.3f} +- {self.sigma:.3f}, given {self.given:.3f}, {self.apart:.0f} standard "
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

    def changes(self, error: Array) -> dict[str, Array]:
        """Return how whitened residuals (n, q) change with errors (n_views, 5) of cameras."""
        views = {corners.name: corners.view for corners in self.problem.boards}
        views["outlines"] = self.problem.outlines.view
        return {
            name: np.einsum("nqk,nk->nq", by, error[views[name]])
            for name, by in self.derivatives.items()
        }

    def contradicted(self) -> list[FocalLength | LensDistortion]:
        """Return what the measurements contradict of camera files, the clearest of each camera.

        One mistake in a camera looks like others: of each camera the test that sees most counts.
        """
        tests: list[FocalLength | LensDistortion] = [
            *self._focal_lengths(),
            *self._zoomed_views(),
            *self._lens_distortions(),
        ]
        clearest = {test.camera: test for test in sorted(tests, key=lambda test: test.apart)}
        return [test for test in clearest.values() if test.is_contradicted]

    def _focal_lengths(self) -> list[FocalLength]:
        """Return what the measurements say of the focal lengths that camera files say.

        One for each camera of which they say anything and nothing was chosen. The common-mode
        biases of outlines are in the problem, and so are errors of intrinsics with the covariance
        that camera files state, so that these do not pass for a focal length.
        """
        return [
            FocalLength(view, intrinsic_of(camera, "fx"), change, sigma)
            for view, camera, change, sigma in self._tested(_camera_error(self.state, _FOCAL, {}))
        ]

    def _lens_distortions(self) -> list[LensDistortion]:
        """Return the same of distortions, by the coefficient that is largest in most lenses."""
        error = _camera_error(self.state, {}, {"k1": 1.0})
        return [
            LensDistortion(view, intrinsic_of(camera, "k1"), change, sigma)
            for view, camera, change, sigma in self._tested(error)
        ]

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
            weight = np.linalg.pinv(covariance[np.ix_(own, own)], rcond=_ROUNDING, hermitian=True)
            tests = []
            for i, k in enumerate(own if len(own) > 1 else []):
                X = np.column_stack([np.ones(len(own)), np.arange(len(own)) == i])
                spread = np.linalg.inv(X.T @ weight @ X)
                apart = float((spread @ X.T @ weight @ change[own])[1])
                view = views[int(seen[k])]
                given = intrinsic_of(problem.first_cameras[view], "fx")
                name, sigma = problem.outlines.views[view], float(np.sqrt(spread[1, 1]))
                tests.append(ZoomedView(name, given, apart, sigma, owner))
            found += sorted(tests, key=lambda test: test.apart)[-1:]
        return found

    def _tested(self, error: Array) -> list[tuple[str, Camera, float, float]]:
        """Return how much of an error (n_views, 5) the residuals show, and its standard deviation.

        They come with the view that stands for each camera of which nothing was chosen, and with
        the camera of its file.
        """
        known, owners = self._known_views(error)
        tested = sorted({owners[v] for v in known})
        if not tested:
            return []
        which = [
            np.array([v in known and owners[v] == owner for v in range(len(owners))])
            for owner in tested
        ]
        cameras = self.problem.first_cameras
        seen, change, covariance = self._scores(error, which)
        return [
            (tested[i], cameras[owners.index(tested[i])], float(d), float(s))
            for i, d, s in zip(seen.tolist(), change, np.sqrt(np.diagonal(covariance)), strict=True)
        ]

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
        changes = [self.changes(error * own[:, None]) for own in which]
        columns = {
            name: np.stack([change[name] for change in changes], axis=-1)
            for name in self.derivatives
        }
        normal = normal_equations(self.problem, self.state, self.linear)
        score, information = score_test(self.problem, self.linear, normal, columns)
        whole = sum(np.sum(of_kind**2, axis=(0, 1)) for of_kind in columns.values())
        seen = np.flatnonzero(np.diagonal(information) > _ROUNDING * whole)
        own = information[np.ix_(seen, seen)]
        covariance = np.linalg.pinv(own, rcond=_ROUNDING, hermitian=True)
        return seen, -covariance @ score[seen], np.asarray(covariance, dtype=np.float64)
