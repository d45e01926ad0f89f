"""What the fit would have found if something that it took as known were mistaken.

A mistake changes residuals: a longer focal length puts what is seen elsewhere on the sensor
plane, a thicker leg has its outlines further apart, a prior pulls elsewhere, and another twist
keeps the platform elsewhere. The fit follows by one Gauss-Newton step.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from legcal.geometry.types import Array
from legcal.refinement.constraints import following
from legcal.refinement.influence import response
from legcal.refinement.linearize import Linearization, offsets_of
from legcal.refinement.loss import efficiency
from legcal.refinement.normal import NormalEquations
from legcal.refinement.problem import FitProblem
from legcal.refinement.solution import Sensitivity
from legcal.refinement.state import State, intrinsic_of
from legcal.vision.intrinsics import undistort_derivatives

_PART = 1e-3  # of a mistake that is tried: its effect is told to first order
_OF_RADII = 0.01
FOCAL_PART = 0.01  # of the focal length, in the mistake that is told
_OF_TWISTS = np.radians(0.1)
_TWISTED = "twists that are fixed, each 0.1 deg off,"
_TWIST = 11  # among the numbers of a leg


@dataclass(frozen=True)
class _Mistake:
    """A mistake in cameras: a part of some of their numbers, and pixels in others."""

    what: str
    relative: Mapping[str, float]
    added: Mapping[str, float]


_OF_CAMERAS = (
    _Mistake("a focal length 1 % longer", {"fx": FOCAL_PART, "fy": FOCAL_PART}, {}),
    _Mistake("a principal point 0.1 px further right", {}, {"cx": 0.1}),
    _Mistake("a principal point 0.1 px further down", {}, {"cy": 0.1}),
)


@dataclass(frozen=True, eq=False)
class _Change:
    """How residuals change with a mistake.

    Attributes
    ----------
    what : str
        The mistake.
    offsets : (n, 2) array
        Change of the offsets of outlines [px].
    corners : (m, 2) array
        Change of the whitened residuals of corners of the calibration board.
    priors : (n_priors,) array
        Change of the means of priors [m, rad, px].
    """

    what: str
    offsets: Array
    corners: Array
    priors: Array


def sensitivities(
    problem: FitProblem,
    state: State,
    linear: Linearization,
    normal: NormalEquations,
    whitening: Array,
    k: float,
) -> tuple[Sensitivity, ...]:
    """Return what mistakes in cameras, radii and fixed twists would do to the parameters.

    What the fit looked for without a prior is not taken as known; a mistake in nothing else is
    left out. So are those in cameras and radii where axes were measured in place of outlines.

    Parameters
    ----------
    problem : FitProblem
    state : State
        Where the fit ended.
    linear : Linearization
        There.
    normal : NormalEquations
        There: :func:`legcal.refinement.normal.information`.
    whitening : (n_outlines, 2, 2) array
        What *linear* was taken with.
    k : float
        What *normal* was taken with.
    """
    twisted = _of_twists(problem, state, linear, normal, k)
    changes = [*(_in_cameras(problem, state, m) for m in _OF_CAMERAS), _in_radii(problem, state)]
    changes = [c for c in changes if c.offsets.any() or c.priors.any()]
    if not changes:
        return twisted
    offsets = efficiency(k, 2) * whitening @ np.stack([c.offsets for c in changes], axis=-1)
    pulls = np.column_stack([c.priors for c in changes]) / problem.priors.sigma[:, None]
    steps = response(problem.couplings.outlines, linear.outlines, normal, offsets)
    corners = efficiency(k, 2) * np.stack([c.corners for c in changes], axis=-1)
    steps += response(problem.couplings.corners, linear.corners, normal, corners)
    steps += normal.kept_covariance() @ linear.prior_J.T @ pulls
    padded = np.vstack([steps, np.zeros(len(changes))])
    kinematic = padded[np.minimum(problem.layout.kinematic, problem.layout.n_kept)]
    others = (Sensitivity(c.what, kinematic[:, i : i + 1]) for i, c in enumerate(changes))
    return (*others, *twisted)


def _of_twists(
    problem: FitProblem, state: State, linear: Linearization, normal: NormalEquations, k: float
) -> tuple[Sensitivity, ...]:
    """Return what fixed twists would do, each of them by itself, or nothing."""
    layout = problem.layout
    names = problem.legs.parametrization.names
    place = problem.legs.parametrization.place[:, _TWIST]
    fixed = [j for j, x in enumerate(place) if x >= 0 and layout.kinematic[x] >= layout.size]
    if not fixed:
        return ()
    steps = np.zeros((len(names), len(fixed)))
    for i, leg in enumerate(fixed):
        motion = _OF_TWISTS * following(state, problem.legs.frame_legs, leg, _TWIST)
        moved = np.zeros((layout.n_kept + 1, 1))
        for where, rows, kept in (  # corners do not know of poses
            (problem.couplings.outlines, linear.outlines, efficiency(k, 2)),
            (problem.couplings.readings, linear.readings, 1.0),
            (problem.couplings.axes, linear.axes, efficiency(k, 4)),
        ):
            change = kept * rows.J_pose @ motion[where.pose][..., None]
            moved[:-1] += response(where, rows, normal, change)
        steps[:, i] = moved[np.minimum(layout.kinematic, layout.n_kept), 0]
        steps[place[leg], i] = _OF_TWISTS
    return (Sensitivity(_TWISTED, steps),)


def _in_cameras(problem: FitProblem, state: State, mistake: _Mistake) -> _Change:
    """Return what a mistake in all cameras changes."""
    layout, o, c = problem.layout, problem.outlines, problem.board
    moved, corners = np.zeros(o.feet.shape), np.zeros(c.feet.shape)
    priors = np.zeros(len(problem.priors))
    for v in np.unique(np.append(o.view, c.view)).tolist():
        camera, of_view, shown = state.cameras[v], o.view == v, c.view == v
        steps = {k: part * intrinsic_of(camera, k) for k, part in mistake.relative.items()}
        steps |= mistake.added
        places = dict(zip(layout.intrinsic_keys, layout.intrinsic[v].tolist(), strict=True))
        for name, step in steps.items():
            priors[problem.priors.position == places.get(name, -1)] = step
        fixed = [name for name in steps if places.get(name, layout.size) >= layout.size]
        by = np.array([steps[name] for name in fixed])
        moved[of_view] = undistort_derivatives(camera, o.pixels[of_view], fixed) @ by
        corners[shown] = undistort_derivatives(camera, c.pixels[shown], fixed) @ by
    offsets = offsets_change(problem, state, moved)
    return _Change(mistake.what, offsets, corners_change(problem, corners), priors)


def _in_radii(problem: FitProblem, state: State) -> _Change:
    """Return what a mistake in all radii of the model changes."""
    layout = problem.layout
    steps = _OF_RADII * np.array([problem.legs.radii[part] for part in layout.parts])
    priors = np.zeros(len(problem.priors))
    for x, step in zip(layout.radius.tolist(), steps.tolist(), strict=True):
        priors[problem.priors.position == x] = step
    fixed = np.where(layout.radius >= layout.size, steps, 0.0)
    thicker = replace(state, radii=state.radii + _PART * fixed)
    offsets = (offsets_of(problem, thicker) - offsets_of(problem, state)) / _PART
    return _Change("radii 1 % larger", offsets, np.zeros((len(problem.board), 2)), priors)


def corners_change(problem: FitProblem, moved: Array) -> Array:
    """Return how whitened residuals of corners (n, 2) change as these move [sensor plane]."""
    board = problem.board
    change = (board.pixels_per_unit @ moved[..., None])[..., 0]
    return np.asarray(-change / board.sigma[:, None])


def offsets_change(problem: FitProblem, state: State, moved: Array) -> Array:
    """Return how offsets (n, 2) [px] change as measured ends (n, 2, 2) move [sensor plane]."""
    feet, _ = problem.measured_ends(state)
    fixed = replace(problem.layout, intrinsic_keys=())

    def offsets(part: float) -> Array:
        """Return the offsets once the ends have moved a part of the way."""
        seen = replace(problem.outlines, feet=feet + part * moved)
        return offsets_of(replace(problem, outlines=seen, layout=fixed), state)

    return np.asarray((offsets(_PART) - offsets(0.0)) / _PART)
