"""Score tests of cameras, and what an error in what counts as known does to the parameters.

Encoders carry the absolute scale, and no other parameter of the fit imitates the perspective of a
wrong focal length completely. The cost then has a gradient by the focal length at the minimum:
Rao's score test, which needs no further fit.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Literal

import numpy as np
from scipy.sparse import csc_array

from legcal.calibration.joint_fit.diagnostics import MOST_SCATTER, Scatter
from legcal.calibration.joint_fit.factors import ObservedCorners, ObservedEdges, ObservedOutlines
from legcal.calibration.joint_fit.problem import FitLinear, FitNormal, FitProblem
from legcal.calibration.joint_fit.variables import State, intrinsic_of
from legcal.estimation.solver import normal_equations
from legcal.estimation.uncertainty import Projected, Scores, response, size_left
from legcal.geometry.types import Array, BoolArray, IntArray
from legcal.machine.leg import ParameterId
from legcal.vision.camera import shared_cameras

FITTED_CAMERA = (
    "the camera corrections that the measurements suggest"  # where they contradict their files
)
INTRINSICS = "what the fit leaves unknown of the intrinsics, a part of this,"
EXACT_CAMERAS = "an error of focal lengths that files give without covariance, by one sigma"
SIGMA_EXACT = 3e-3  # of such a focal length, relative: refocused, or known from a few photographs
_KEYS = ("fx", "fy", "cx", "cy", "k1")  # intrinsics in errors and tests
_FOCAL: Mapping[str, float] = {"fx": 1.0, "fy": 1.0}  # relative
_SIGNIFICANT = 5.0  # standard deviations
_OF_OTHER_EDGES = 3.0  # the same without any one edge of a part in a view
_AT_ONCE = 1000  # outlines that are projected together


def sensitivity_to_cameras(
    cameras: CameraResiduals, normal: FitNormal, contradicted: Sequence[WrongIntrinsic]
) -> dict[str, Array]:
    """Return how the corrections of contradicted intrinsics change the parameters, if any are.

    *cameras* are at the minimum of the fit, *normal* is the information there. Of intrinsics with
    a prior, the correction is that of its mean.
    """
    if not contradicted:
        return {}
    problem, place = cameras.problem, _camera_columns(cameras.problem)
    error = np.sum([one.error for one in contradicted], axis=0)
    of_priors = np.zeros(problem.n_kept + 1)
    of_priors[place] = error
    pull = problem.priors.whitened(of_priors[problem.priors.unknown])
    changes = cameras.changes(np.where(place == problem.n_kept, error, 0.0))
    steps = response(normal, {name: change[..., None] for name, change in changes.items()})
    steps += normal.kept_covariance() @ normal.linear.prior_J.T @ pull[:, None]
    return {FITTED_CAMERA: kinematic_steps(problem, steps)}


def sensitivity_to_exact_cameras(cameras: CameraResiduals) -> dict[str, Array]:
    """Return the change of parameters with the error that each exact focal length may have.

    Of cameras whose files state no covariance, unless somebody fixed them; the measurements say as
    much as they know, by their score.
    """
    problem, state = cameras.problem, cameras.state
    names = problem.outlines.views
    owners = np.array(shared_cameras(names, problem.first_cameras))
    chosen = {ParameterId.parse(name).owner for name in problem.choices.fixed}
    free = np.array([owner in chosen for owner in owners])
    free |= (_camera_columns(problem)[:, :2] < problem.n_kept).any(axis=1)
    unit = _camera_error(state, _FOCAL, {})
    errors = [unit * (owners == owner)[:, None] for owner in dict.fromkeys(owners[~free].tolist())]
    if not errors:
        return {}
    off = size_left(cameras.scores(errors), SIGMA_EXACT**2 * np.eye(len(errors)))
    moved = np.hstack([kinematic_steps(problem, cameras.response(error)) for error in errors])
    return {EXACT_CAMERAS: moved @ off}


def sensitivity_to_intrinsics(problem: FitProblem, covariance: Array) -> dict[str, Array]:
    """Return the part of the errors of the parameters that goes with those of estimated intrinsics.

    Were these known exactly, the rest of the covariance (n_kept, n_kept) would remain.
    """
    along = covariance[:, problem.where("cameras")]
    values, vectors = np.linalg.eigh(along[problem.where("cameras")])
    known = values > 0.0
    if not known.any():
        return {}
    steps = along @ (vectors[:, known] / np.sqrt(values[known]))
    return {INTRINSICS: kinematic_steps(problem, steps)}


def _camera_columns(problem: FitProblem) -> IntArray:
    """Columns in x (n_views, 5) of the tested intrinsics."""
    place = np.full((len(problem.outlines.views), len(_KEYS)), problem.n_kept, dtype=np.intp)
    for k, key in enumerate(_KEYS):
        if key in problem.keys:
            place[:, k] = problem.columns["cameras"][:, problem.keys.index(key)]
    return place


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


Intrinsic = Literal["focal_length", "zoom", "principal_point", "centre", "distortion"]
_OF_CAMERAS: tuple[Intrinsic, ...] = ("focal_length", "principal_point", "distortion")
_Unit = tuple[Mapping[str, float], Mapping[str, float]]  # a relative and an added error
_TESTED: Mapping[Intrinsic, tuple[tuple[str, ...], list[_Unit], str]] = {  # keys, units, name
    "focal_length": (("fx",), [(_FOCAL, {})], "focal length of"),
    "principal_point": (("cx", "cy"), [({}, {"cx": 1.0}), ({}, {"cy": 1.0})], "principal point of"),
    # By its first coefficient k1, which is the largest in most lenses
    "distortion": (("k1",), [({}, {"k1": 1.0})], "distortion of"),
    # A view against the others with its camera file
    "zoom": (("fx",), [(_FOCAL, {})], "focal length of view"),
    "centre": (
        ("cx", "cy"), [({}, {"cx": 1.0}), ({}, {"cy": 1.0})], "principal point of view"
    ),
}  # fmt: skip
_OF_VIEWS: tuple[Intrinsic, ...] = ("zoom", "centre")
_REMEDIES: Mapping[Intrinsic, str] = {
    "focal_length": (
        "calibrate the camera again at the same focus and zoom, look for photographs that were "
        "scaled or refocused, or estimate it (--set {0}.fx=free --set {0}.fy=free)"
    ),
    "principal_point": (
        "look for photographs that were cropped or stabilised, calibrate the camera again at the "
        "same focus and zoom, or estimate it (--set {0}.cx=free --set {0}.cy=free)"
    ),
    "distortion": (
        "take and process the photographs of board and machine alike, with lens correction in all "
        "or in none, and calibrate the camera again"
    ),
    "zoom": (
        "look for photographs of that view that were zoomed, scaled, cropped or refocused, and "
        "calibrate its camera with the settings used there"
    ),
    "centre": (
        "look for photographs of that view that were turned upside down, cropped or stabilised, "
        "and take them as the camera wrote them"
    ),
}
_HALF_TURN = 0.3  # of the difference of a principal point and that of the image upside down


@dataclass(frozen=True, eq=False)
class WrongIntrinsic:
    """Intrinsics in a camera file that contradict the measurements."""

    kind: Intrinsic
    view: str  # the first one by name if several have the camera
    given: Array  # (u,) in the camera file
    change: Array  # (u,) correction; of focal lengths as a part of them, else [px] or of k1
    sigma: Array  # (u,) standard deviations of the correction
    apart: float  # correction in standard deviations
    error: Array  # (n_views, 5) the correction, in all views
    is_turned: bool = False  # whether it is that of images upside down

    @property
    def found(self) -> str:
        """What the measurements say, as a clause."""
        (given, *_), (change, *_), (sigma, *_) = self.given, self.change, self.sigma
        if self.kind == "zoom":
            return f"it differs by {1e2 * change:+.2f} +- {1e2 * sigma:.2f} %"
        if self.kind == "centre":
            (dx, dy), (sigma_x, sigma_y) = self.change, self.sigma
            looks = ", as if its photographs had been turned upside down" if self.is_turned else ""
            return (
                f"it differs by ({dx:+.1f} +- {sigma_x:.1f}, {dy:+.1f} +- {sigma_y:.1f}) px{looks}"
            )
        if self.kind == "focal_length":
            return (
                f"found fx = {given * (1.0 + change):.1f} +- {given * sigma:.1f} px, given "
                f"{given:.1f} px ({1e2 * change:+.2f} %)"
            )
        if self.kind == "principal_point":
            (cx, cy), (dx, dy) = self.given + self.change, self.sigma
            return (
                f"found it at ({cx:.1f} +- {dx:.1f}, {cy:.1f} +- {dy:.1f}) px, given "
                f"({self.given[0]:.1f}, {self.given[1]:.1f}) px"
            )
        found, looks = given + change, ""
        if abs(found) < 0.5 * abs(given):
            looks = " (the lens distortion of the photographs appears to have been removed)"
        elif given == 0.0:
            looks = " (the lens distortion of the photographs appears not to have been removed)"
        return f"found k1 = {found:.3f} +- {sigma:.3f}, given {given:.3f}{looks}"

    @property
    def what(self) -> str:
        """The contradiction, as a clause."""
        of_view = self.kind in _OF_VIEWS
        against = "the other views of its camera" if of_view else "the measurements"
        return (
            f"the {_TESTED[self.kind][2]} {self.view} does not agree with {against}: {self.found}, "
            f"{self.apart:.0f} standard deviations apart"
        )

    @property
    def remedy(self) -> str:
        """What to do, as a clause."""
        return _REMEDIES[self.kind].format(self.view)

    def __str__(self) -> str:
        return (
            f"T{self.what[1:]}; the stated uncertainty does not include this error; {self.remedy}."
        )


@dataclass(frozen=True, eq=False)
class CameraResiduals:
    """Score tests of the cameras of a fit, from the residuals at its minimum."""

    linear: FitLinear

    @property
    def problem(self) -> FitProblem:
        """The joint fit."""
        return self.linear.problem

    @property
    def state(self) -> State:
        """Its minimum."""
        return self.linear.state

    @cached_property
    def derivatives(self) -> dict[str, tuple[IntArray, Array]]:
        """Derivatives (n, q, 5) of whitened residuals by intrinsics of their view, with the views.

        Of outlines, edges and corners, by focal lengths, principal point and first coefficient of
        distortion, whether estimated or fixed.
        """
        problem, derivatives = self.problem, dict[str, tuple[IntArray, Array]]()
        kinds: list[ObservedOutlines | ObservedEdges | ObservedCorners]
        kinds = [problem.outlines, problem.edges, *problem.boards]
        for seen in kinds:
            factor = seen.factor(_KEYS)
            factor = replace(factor, whitening=problem.factor(factor.name).whitening)
            slope = factor.linearize(self.state).slope
            derivatives[factor.name] = seen.view, slope[..., -len(_KEYS) :]
        return derivatives

    @cached_property
    def _plain(self) -> FitNormal:
        """The normal equations of plain squares."""
        return normal_equations(self.linear)

    def changes(self, error: Array) -> dict[str, Array]:
        """Return the change of whitened residuals (n, q) by errors (n_views, 5) of cameras."""
        return {
            name: np.einsum("nqk,nk->nq", by, error[view])
            for name, (view, by) in self.derivatives.items()
        }

    def response(self, error: Array) -> Array:
        """Return the steps (n_kept, 1) of the unknowns with errors (n_views, 5) of cameras."""
        columns = {name: change[..., None] for name, change in self.changes(error).items()}
        return response(self._plain, columns)

    def zoomed(self, view: int) -> dict[str, Array]:
        """Return the change of whitened residuals (n, q) by an error of a view's focal length."""
        error = _camera_error(self.state, _FOCAL, {})
        return self.changes(error * (np.arange(len(error)) == view)[:, None])

    def errors_of_files(self, views: BoolArray) -> dict[Intrinsic, list[Array]]:
        """Return unit errors (n_views, 5) of what camera files say of some views, by kind."""
        found = dict[Intrinsic, list[Array]]()
        for kind in _OF_CAMERAS:
            units = [_camera_error(self.state, *unit) for unit in _TESTED[kind][1]]
            known = self._known_views(np.sum(units, axis=0)) & views
            if known.any():
                found[kind] = [known[:, None] * unit for unit in units]
        return found

    def contradicted(self) -> list[WrongIntrinsic]:
        """Return the intrinsics in camera files that contradict the measurements.

        None where outlines scatter more than they claim even with these cameras corrected: then
        something else is wrong, of which cameras take a part. Nor what one edge alone says, as
        that of a polished part on its reflection.
        """
        owners = np.array(shared_cameras(self.problem.outlines.views, self.problem.first_cameras))
        contradicted = list[WrongIntrinsic]()
        for owner in dict.fromkeys(owners.tolist()):
            wrong = self._wrong_intrinsics(owner, owners == owner)
            apart = self._view_apart(owners == owner)
            clearest = max((test.apart for test in wrong), default=_SIGNIFICANT)
            wrong = wrong if apart is None or apart.apart <= clearest else [apart]
            contradicted += wrong if wrong and self._is_of_several_edges(wrong) else []
        squares = float(self.linear["outlines"].squared_norms.sum())
        left = 1.0 - sum(test.apart**2 for test in contradicted) / max(squares, 1e-300)
        scatter = Scatter.of(self.problem, self.state).ratio()
        return contradicted if np.sqrt(max(left, 0.0)) * scatter <= MOST_SCATTER else []

    def _wrong_intrinsics(self, owner: str, of_camera: BoolArray) -> list[WrongIntrinsic]:
        """Contradicted intrinsics of a camera, by its representative view and all of its views.

        One error of a camera resembles others: the most significant one is selected first, and
        further ones only if they stay significant after its correction. Intrinsics with a choice
        are not tested. The problem includes common-mode biases and the covariance of camera files,
        so that these are not mistaken for a wrong file.
        """
        of_kinds = self.errors_of_files(of_camera)
        kinds, errors, columns = list(of_kinds), list[Array](), list[IntArray]()
        for units in of_kinds.values():
            columns.append(len(errors) + np.arange(len(units), dtype=np.intp))
            errors += units
        selected = dict[int, float]()
        scores = given = self.scores(errors) if errors else None
        while given is not None and len(selected) < len(kinds):
            left = {k: given.estimate(columns[k]) for k in range(len(kinds)) if k not in selected}
            best = max(left, key=lambda k: left[k].square)
            if left[best].square <= _SIGNIFICANT**2:
                break
            selected[best], given = float(np.sqrt(left[best].square)), given.given(left[best])
        if scores is None or not selected:
            return []
        together = scores.estimate(np.concatenate([columns[k] for k in selected]))
        change, sigma = -together.amount, np.sqrt(np.diagonal(together.covariance))
        camera = self.problem.first_cameras[self.problem.outlines.views.index(owner)]
        wrong_intrinsics = []
        for k, apart in selected.items():
            own = np.isin(together.columns, columns[k])
            given_values = np.array([intrinsic_of(camera, key) for key in _TESTED[kinds[k]][0]])
            error = np.tensordot(change[own], [errors[i] for i in columns[k].tolist()], axes=1)
            wrong_intrinsics.append(
                WrongIntrinsic(kinds[k], owner, given_values, change[own], sigma[own], apart, error)
            )
        return wrong_intrinsics

    def _view_apart(self, of_camera: BoolArray) -> WrongIntrinsic | None:
        """Return the view of a camera whose intrinsics differ most from its other views.

        Causes are digital zoom and refocusing, or turned and cropped images. Cameras with choices
        for intrinsics, or with only one informative view, are not tested.
        """
        differ = list[WrongIntrinsic]()
        for kind in _OF_VIEWS:
            keys, units, _ = _TESTED[kind]
            errors = [_camera_error(self.state, *unit) for unit in units]
            views = np.flatnonzero(self._known_views(np.sum(errors, axis=0)) & of_camera).tolist()
            if len(views) < 2:
                continue
            n = len(errors)
            in_view = [error * (np.arange(len(error)) == v)[:, None]
                       for v in views for error in errors]  # fmt: skip
            scores, alike = self.scores(in_view), np.tile(np.eye(n), (len(views), 1))
            given = scores.given(scores.estimate(np.arange(len(in_view)), alike))
            for i, v in enumerate(views):
                number = given.estimate(n * i + np.arange(n))
                if number.rank < n:
                    continue
                change, sigma = -number.amount, np.sqrt(np.diagonal(number.covariance))
                name, camera = self.problem.outlines.views[v], self.problem.first_cameras[v]
                values = np.array([intrinsic_of(camera, key) for key in keys])
                by_turn = np.array([camera.width, camera.height]) - 1.0 - 2.0 * values
                is_turned = kind == "centre" and bool(
                    np.linalg.norm(change - by_turn) < _HALF_TURN * np.linalg.norm(by_turn)
                )
                wrong = np.tensordot(change, in_view[n * i : n * (i + 1)], axes=1)
                apart = float(np.sqrt(number.square))
                differ.append(
                    WrongIntrinsic(kind, name, values, change, sigma, apart, wrong, is_turned)
                )
        return max(differ, key=lambda test: test.apart, default=None)

    def _is_of_several_edges(self, wrong: Sequence[WrongIntrinsic]) -> bool:
        """Return whether the corrections of a camera are seen without any one edge of a part.

        In any one view: each of its outlines may then be anywhere.
        """
        o, error = self.problem.outlines, np.sum([one.error for one in wrong], axis=0)
        changes, views = self.changes(error), np.any(error, axis=1)
        shown = np.flatnonzero(views[o.view] & changes["outlines"].any(axis=1))
        edges = np.column_stack([o.view, o.radius, o.epsilon])[shown]
        _, edge, size = np.unique(edges, axis=0, return_inverse=True, return_counts=True)
        together = np.cumsum(size) // _AT_ONCE
        for part in np.unique(together).tolist():
            own = np.flatnonzero(together[edge] == part)
            free = (2 * shown[own, None] + np.arange(2)).ravel()  # both ends of each outline
            columns = dict[str, csc_array]()
            for name, change in changes.items():
                any_end = free if name == "outlines" else free[:0]
                value = np.append(change.ravel(), np.ones(len(any_end)))
                at = np.append(np.arange(change.size), any_end)
                column = np.append(
                    np.zeros(change.size, dtype=np.intp), 1 + np.arange(len(any_end))
                )
                shape = change.size, 1 + len(free)
                columns[name] = csc_array((value, (at, column)), shape=shape)
            projected = Projected.of(self._plain, columns)
            for one in np.flatnonzero(together == part).tolist():
                of_edge = 1 + np.flatnonzero(np.repeat(edge[own] == one, 2))
                scores = projected.at(np.append(0, of_edge))
                anywhere = scores.estimate(1 + np.arange(len(of_edge)))
                number = scores.given(anywhere).estimate(np.arange(1))
                if number.square <= _OF_OTHER_EDGES**2:
                    return False
        return True

    def _known_views(self, error: Array) -> BoolArray:
        """Return which views have the intrinsics in *error* from camera files, (n_views,)."""
        problem, wrong = self.problem, np.flatnonzero(np.any(error, axis=0))
        known_columns = np.append(problem.calibrated, problem.n_kept)
        is_known = np.all(np.isin(_camera_columns(problem)[:, wrong], known_columns), axis=1)
        return np.asarray(is_known & np.isin(np.arange(len(error)), problem.outlines.view))

    def scores(self, errors: Sequence[Array]) -> Scores:
        """Return the scores of errors (n_views, 5) of cameras."""
        changes = [self.changes(error) for error in errors]
        columns = {
            name: np.stack([change[name] for change in changes], axis=-1)
            for name in self.derivatives
        }
        return Projected.of(self._plain, columns).at(np.arange(len(errors)))
