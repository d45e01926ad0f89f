"""What mistakes in what counts as known would do, and what measurements say of focal lengths.

Encoders carry the absolute scale, and a focal length that is wrong makes perspective wrong in a way
that nothing else in the fit can imitate altogether. What is left in the residuals then has a slope
by the focal length: Rao's score test, which needs no further fit.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from legcal.calibration.joint_fit.poses import LegConstraints
from legcal.calibration.joint_fit.problem import FitProblem
from legcal.calibration.joint_fit.state import TWIST, State, intrinsic_of
from legcal.estimation import (
    Linearization,
    NormalEquations,
    PseudoHuber,
    normal_equations,
    response,
    score_test,
)
from legcal.geometry import Array, IntArray
from legcal.vision import shared_cameras, undistort_derivatives

FOCAL_PART = 0.01  # of the focal length, in the mistake that is told
_OF_RADII = 0.01
_OF_TWISTS = np.radians(0.1)
_PART = 1e-3  # of a mistake that is tried: its effect is told to first order
_OF_CAMERAS: Mapping[str, tuple[Mapping[str, float], Mapping[str, float]]] = {  # relative, added
    "a focal length 1 % longer": ({"fx": FOCAL_PART, "fy": FOCAL_PART}, {}),
    "a principal point 0.1 px further right": ({}, {"cx": 0.1}),
    "a principal point 0.1 px further down": ({}, {"cy": 0.1}),
}
_SIGNIFICANT = 5.0  # standard deviations
_ROUNDED = 1e-9  # relative: what is left of a difference of equals
_FOCAL = ("fx", "fy")


@dataclass(frozen=True)
class Sensitivity:
    """What a mistake in what was taken as known would do to the kinematic parameters."""

    what: str  # the mistake, in words
    steps: Array  # (p, c) steps of all of them [m, rad], for each independent part of the mistake


def sensitivities(
    problem: FitProblem,
    state: State,
    linear: Linearization,
    normal: NormalEquations,
    loss: PseudoHuber,
) -> tuple[Sensitivity, ...]:
    """Return what mistakes in cameras, radii and fixed twists would do to the parameters.

    What the fit looked for without a prior is not taken as known; a mistake in nothing else is
    left out. So are those in cameras and radii where axes were measured in place of outlines.
    *linear* and *normal*, the information, are those where the fit ended.
    """
    changes = [
        (what, *_in_cameras(problem, state, relative, added))
        for what, (relative, added) in _OF_CAMERAS.items()
    ]
    changes.append(("radii 1 % larger", *_in_radii(problem, state)))
    changes = [c for c in changes if c[1].any() or c[3].any()]
    found: list[Sensitivity] = []
    if changes:
        names, offsets, corners, pulls = zip(*changes, strict=True)
        whitening = problem.factor("outlines").whitening
        moved = {
            "outlines": loss.efficiency(2) * whitening @ np.stack(offsets, axis=-1),
            "corners": loss.efficiency(2) * np.stack(corners, axis=-1),
        }
        steps = response(problem, linear, normal, moved)
        pulled = np.column_stack(pulls) / problem.priors.sigma[:, None]
        steps += normal.kept_covariance() @ linear.prior_J.T @ pulled
        found = [
            Sensitivity(what, _of_kinematic(problem, steps[:, [i]])) for i, what in enumerate(names)
        ]
    place = problem.legs.parametrization.place[:, TWIST]
    twisted = [j for j, x in enumerate(place) if x >= 0 and not problem.free[x]]
    if twisted:
        columns = [_of_twist(problem, state, linear, normal, loss, j) for j in twisted]
        what = "twists that are fixed, each 0.1 deg off,"
        found.append(Sensitivity(what, np.column_stack(columns)))
    return tuple(found)


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
    motion = _OF_TWISTS * LegConstraints(problem.legs).following(state, leg, TWIST)
    changes = {}
    for name, kept in (
        ("outlines", loss.efficiency(2)),
        ("readings", 1.0),
        ("axes", loss.efficiency(4)),
    ):  # corners do not know of poses
        own = problem.factor(name).own
        if own is not None:
            changes[name] = kept * linear[name].J_own @ motion[own][..., None]
    steps = _of_kinematic(problem, response(problem, linear, normal, changes))[:, 0]
    steps[problem.legs.parametrization.place[leg, TWIST]] = _OF_TWISTS
    return steps


def _in_cameras(
    problem: FitProblem, state: State, relative: Mapping[str, float], added: Mapping[str, float]
) -> tuple[Array, Array, Array]:
    """Return what a mistake in all cameras changes: offsets, corners, means of priors."""
    views = np.unique(np.append(problem.outlines.view, problem.board.view))
    steps, priors = {}, np.zeros(len(problem.priors.mean))
    for v in views.tolist():
        camera = state.cameras[v]
        by = {key: part * intrinsic_of(camera, key) for key, part in relative.items()}
        by |= added
        places = dict(zip(problem.keys, problem.place["cameras"][v].tolist(), strict=True))
        for name, step in by.items():
            priors[problem.priors.unknown == places.get(name, -1)] = step
        steps[v] = {
            name: step
            for name, step in by.items()
            if places.get(name, problem.n_kept) == problem.n_kept
        }
    return *_moved_by(problem, state, steps), priors


def _moved_by(
    problem: FitProblem, state: State, steps: Mapping[int, Mapping[str, float]]
) -> tuple[Array, Array]:
    """Return how offsets [px] and whitened corners change as intrinsics of views do."""
    o, c = problem.outlines, problem.board
    moved, corners = np.zeros(o.feet.shape), np.zeros(c.feet.shape)
    for v, by in steps.items():
        camera, of_view, shown = state.cameras[v], o.view == v, c.view == v
        size = np.array(list(by.values()))
        moved[of_view] = undistort_derivatives(camera, o.pixels[of_view], list(by)) @ size
        corners[shown] = undistort_derivatives(camera, c.pixels[shown], list(by)) @ size
    change = (c.pixels_per_unit @ corners[..., None])[..., 0]
    return offsets_change(problem, state, moved), -change / c.sigma[:, None]


def offsets_change(problem: FitProblem, state: State, moved: Array) -> Array:
    """Return how offsets (n, 2) [px] change as measured ends (n, 2, 2) move [sensor plane]."""
    feet = problem.feet(state)
    there, here = (
        problem.offsets(state, replace(problem.outlines, feet=feet + part * moved))
        for part in (_PART, 0.0)
    )
    return np.asarray((there - here) / _PART)


def _in_radii(problem: FitProblem, state: State) -> tuple[Array, Array, Array]:
    """Return what a mistake in all radii changes: offsets, corners, means of priors."""
    steps = _OF_RADII * np.array([problem.legs.radii[part] for part in problem.outlines.parts])
    place, priors = problem.place["radii"][:, 0], np.zeros(len(problem.priors.mean))
    for x, step in zip(place.tolist(), steps.tolist(), strict=True):
        priors[problem.priors.unknown == x] = step
    fixed = np.where(place == problem.n_kept, steps, 0.0)
    thicker = replace(state, radii=state.radii + _PART * fixed)
    offsets = (problem.offsets(thicker) - problem.offsets(state)) / _PART
    return offsets, np.zeros((len(problem.board), 2)), priors


@dataclass(frozen=True)
class FocalLength:
    """What the measurements say of the focal length of a camera that was taken as known."""

    view: str  # the first one by name if several have the camera
    given: float  # fx of the camera [px]
    change: float  # what would have to be added to fx and fy, as a part of them
    sigma: float  # standard deviation of that

    @property
    def is_doubtful(self) -> bool:
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


def focal_lengths(
    problem: FitProblem, state: State, linear: Linearization
) -> tuple[FocalLength, ...]:
    """Return what the measurements say of the focal lengths that the fit took as known.

    One for each camera of which they say anything. *problem* is with the biases that outlines
    share, so that these are not taken for a focal length.
    """
    known = [
        v
        for v in np.unique(problem.outlines.view).tolist()
        if not any(
            x < problem.n_kept
            for key, x in zip(problem.keys, problem.place["cameras"][v].tolist(), strict=True)
            if key in _FOCAL
        )
    ]
    owners = shared_cameras(problem.outlines.views, state.cameras)
    tested = sorted({owners[v] for v in known})
    if not tested:
        return ()
    changes = [
        _by_focal_length(
            problem, state, np.array([v for v in known if owners[v] == owner], dtype=np.intp)
        )
        for owner in tested
    ]
    whitening = problem.factor("outlines").whitening
    columns = {
        "outlines": whitening @ np.stack([offsets for offsets, _ in changes], axis=-1),
        "corners": np.stack([corners for _, corners in changes], axis=-1),
    }
    normal = normal_equations(problem, state, linear)
    score, information = score_test(problem, linear, normal, columns)
    whole = sum(np.sum(of_kind**2, axis=(0, 1)) for of_kind in columns.values())
    seen = np.flatnonzero(np.diagonal(information) > _ROUNDED * whole)
    covariance = np.linalg.pinv(information[np.ix_(seen, seen)], rcond=_ROUNDED, hermitian=True)
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


def _by_focal_length(problem: FitProblem, state: State, views: IntArray) -> tuple[Array, Array]:
    """Return how offsets [px] and whitened corners change by a relative change of focal length."""
    steps = {
        v: {key: intrinsic_of(state.cameras[v], key) for key in _FOCAL} for v in views.tolist()
    }
    return _moved_by(problem, state, steps)
