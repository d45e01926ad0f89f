"""Building the fit: which unknowns there are, what each measurement depends on, what is known."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from legcal.geometry.types import IntArray
from legcal.mechanism.parameters import radius_name
from legcal.observations.leg_axes import LegAxes
from legcal.observations.measurements import Measurements
from legcal.observations.outlines import Outlines
from legcal.refinement.biases import SharedShifts
from legcal.refinement.choices import NO_CHOICES, Choices
from legcal.refinement.covariance import check_counts
from legcal.refinement.layout import Layout, lay_out
from legcal.refinement.legs import FittedLegs
from legcal.refinement.observed import (
    ObservedOutlines,
    Readings,
    observed_outlines,
    readings,
    seen_by,
)
from legcal.refinement.observed_axes import ObservedAxes, observed_axes
from legcal.refinement.priors import Priors
from legcal.refinement.problem import FirstValues, FitProblem
from legcal.refinement.rows import Places, places
from legcal.refinement.settings import DEFAULT_SETTINGS, RefinementSettings
from legcal.vision.camera import Camera
from legcal.vision.intrinsics import (
    intrinsic_names,
    intrinsic_unit,
    shared_cameras,
    with_intrinsics,
)


def build_fit(
    legs: FittedLegs,
    measurements: Measurements,
    outlines: Outlines,
    settings: RefinementSettings = DEFAULT_SETTINGS,
    *,
    axes: LegAxes | None = None,
    choices: Choices = NO_CHOICES,
) -> FitProblem:
    """Build the fit of everything without solving it.

    Parameters
    ----------
    legs : FittedLegs
        The mechanism (:func:`legcal.refinement.legs.fitted_legs`).
    measurements : Measurements
        Views, poses and readings [m].
    outlines : Outlines
        Outlines in pixels; only the used ones enter.
    settings : RefinementSettings
        Choices of the fit.
    axes : LegAxes, optional
        Measured axes, beside outlines or instead of them (give
        :func:`legcal.observations.sets.no_outlines`). Their covariances are taken as they are.
    choices : Choices
        Parameters that are fixed, freed or known beforehand.

    Raises
    ------
    NotIdentifiable
        If there are fewer equations than unknowns.
    DatasetError
        If an outline or an axis cannot be used.
    """
    observed = observed_outlines(outlines, measurements, legs)
    cameras = _cameras(measurements, choices)
    if any(
        camera is not view.camera for camera, view in zip(cameras, measurements.views, strict=True)
    ):
        observed = seen_by(observed, cameras)
    problem = _with_unknowns(
        legs,
        choices,
        observed,
        readings(measurements, legs),
        observed_axes(axes, measurements, legs),
        cameras,
        shared_cameras(observed.views, [view.camera for view in measurements.views]),
        measurements.n_poses,
        settings,
    )
    check_counts(problem, measurements.n_rows)
    return problem


def with_choices(problem: FitProblem, choices: Choices, settings: RefinementSettings) -> FitProblem:
    """Return a problem with the same measurements and cameras, and other unknowns.

    Parameters
    ----------
    problem : FitProblem
        Without anything held, and without shifts.
    choices : Choices
    settings : RefinementSettings
    """
    cameras = problem.first.cameras
    return _with_unknowns(
        problem.legs,
        choices,
        problem.outlines,
        problem.readings,
        problem.axes,
        cameras,
        shared_cameras(problem.outlines.views, cameras),
        problem.layout.n_poses,
        settings,
    )


def _with_unknowns(
    legs: FittedLegs,
    choices: Choices,
    observed: ObservedOutlines,
    encoders: Readings,
    lines: ObservedAxes,
    cameras: tuple[Camera, ...],
    owners: tuple[str, ...],
    n_poses: int,
    settings: RefinementSettings,
) -> FitProblem:
    """Return the problem of measurements, with the unknowns and the priors of choices."""
    seen = np.zeros(len(cameras), dtype=np.bool_)
    seen[observed.view] = seen[lines.view] = True
    radii = [radius_name(legs.names[leg], part) for leg, part in observed.parts]
    intrinsic, keys, intrinsics = _intrinsics(observed.views, cameras, owners, choices)
    names = legs.parametrization.names
    is_free = [not choices.holds(name, by_default=name.endswith(".twist")) for name in names]
    layout = lay_out(
        legs.parametrization.place,
        np.array(is_free, dtype=np.bool_),
        np.array([not choices.holds(name) for name in radii], dtype=np.bool_),
        observed.parts,
        intrinsic,
        keys,
        seen,
        n_poses,
    )
    units = legs.parametrization.units
    named = [
        *((n, u) for n, u, free in zip(names, units, is_free, strict=True) if free),
        *((name, "m") for name in radii if not choices.holds(name)),
        *((name, intrinsic_unit(name.rsplit(".", 1)[1])) for name in intrinsics),
    ]
    nominal = np.array([legs.radii[part] for part in observed.parts])
    first = FirstValues(
        np.array([choices.values.get(n, r) for n, r in zip(radii, nominal.tolist(), strict=True)]),
        cameras,
    )
    return FitProblem(
        legs,
        choices,
        layout,
        observed,
        encoders,
        lines,
        _priors(layout, named, dict(zip(radii, nominal.tolist(), strict=True)), choices, settings),
        first,
        *_places(layout, observed, encoders, lines),
        tuple(name for name, _ in named),
        tuple(unit for _, unit in named),
        np.zeros((0, layout.n_kept)),
    )


def with_measurements(
    problem: FitProblem,
    measurements: Measurements,
    outlines: ObservedOutlines,
    biases: SharedShifts,
) -> FitProblem:
    """Return a problem with the same unknowns but shifts, and other images without axes.

    Parameters
    ----------
    problem : FitProblem
    measurements : Measurements
        Of the same views.
    outlines : ObservedOutlines
        Their outlines; the parts of the problem come first in theirs, others have known radii.
    biases : SharedShifts
        The shifts that these outlines share.
    """
    layout = problem.layout.of_poses(measurements.n_poses)
    of_others = np.full(len(outlines.parts) - len(layout.parts), layout.size, dtype=np.intp)
    radius = np.concatenate([layout.radius, of_others])
    other = replace(
        problem,
        layout=replace(layout, radius=radius, parts=outlines.parts),
        outlines=outlines,
        readings=readings(measurements, problem.legs),
        axes=observed_axes(None, measurements, problem.legs),
    )
    return with_biases(other, biases)


def with_biases(problem: FitProblem, biases: SharedShifts) -> FitProblem:
    """Return a problem in which outlines share unknown shifts, in place of those it had.

    Parameters
    ----------
    problem : FitProblem
    biases : SharedShifts
    """
    old = problem.layout
    n_old, n_new = len(old.bias), len(biases.names)
    first = int(old.bias[0]) if n_old else _first_after_radii(old)

    def moved(position: IntArray) -> IntArray:
        later = np.where(position >= first + n_old, position + n_new - n_old, position)
        return np.asarray(later, dtype=np.intp)

    layout = replace(
        old,
        place=moved(old.place),
        kinematic=moved(old.kinematic),
        radius=moved(old.radius),
        bias=first + np.arange(n_new, dtype=np.intp),
        intrinsic=moved(old.intrinsic),
        camera=moved(old.camera),
        n_kept=old.n_kept + n_new - n_old,
    )
    priors = problem.priors
    known = ~np.isin(priors.position, old.bias)
    outlines = replace(problem.outlines, bias_index=biases.index, bias_shift=biases.shift)
    held = np.zeros((len(problem.held), layout.n_kept))
    kept = np.r_[0:first, first + n_old : old.n_kept]
    held[:, moved(kept)] = problem.held[:, kept]
    by_outline, by_reading, by_axis = _places(layout, outlines, problem.readings, problem.axes)
    return replace(
        problem,
        layout=layout,
        outlines=outlines,
        priors=Priors(
            layout,
            np.concatenate([moved(priors.position[known]), layout.bias]),
            np.concatenate([priors.mean[known], np.zeros(n_new)]),
            np.concatenate([priors.sigma[known], biases.sigmas]),
        ),
        named=_inserted(problem.named, biases.names, first, n_old),
        named_units=_inserted(problem.named_units, ("px",) * n_new, first, n_old),
        held=held,
        outline_places=by_outline,
        reading_places=by_reading,
        axis_places=by_axis,
    )


def _first_after_radii(layout: Layout) -> int:
    """Return where biases stand if there are none yet."""
    return layout.n_kinematic + int(np.sum(layout.radius < layout.size))


def _inserted(
    names: tuple[str, ...], new: tuple[str, ...], first: int, n_old: int
) -> tuple[str, ...]:
    """Return names with others in place of *n_old* from *first* on."""
    return (*names[:first], *new, *names[first + n_old :])


def _places(
    layout: Layout, outlines: ObservedOutlines, encoders: Readings, axes: ObservedAxes
) -> tuple[Places, Places, Places]:
    """Return what outlines, readings and axes depend on."""
    place, n_kept, n_poses = layout.place, layout.n_kept, layout.n_poses
    of_outlines = np.concatenate(
        [
            place[outlines.leg, :6],
            layout.camera[outlines.view],
            layout.radius[outlines.radius, None],
            layout.bias[outlines.bias_index],
            layout.intrinsic[outlines.view],
        ],
        axis=1,
    )
    of_axes = np.concatenate([place[axes.leg, :6], layout.camera[axes.view]], axis=1)
    return (
        places(of_outlines, outlines.pose, n_kept, n_poses),
        places(place[encoders.leg, :7], encoders.pose, n_kept, n_poses),
        places(of_axes, axes.pose, n_kept, n_poses),
    )


def _intrinsics(
    views: Sequence[str], cameras: Sequence[Camera], owners: Sequence[str], choices: Choices
) -> tuple[IntArray, tuple[str, ...], tuple[str, ...]]:
    """Return the unknown intrinsic of each view (n_views, n_keys), what they are, their names."""
    asked = {*choices.free, *choices.priors}
    names = [
        f"{view}.{key}"
        for view, camera in zip(views, cameras, strict=True)
        if view in owners
        for key in intrinsic_names(camera)
        if f"{view}.{key}" in asked
    ]
    keys = tuple(dict.fromkeys(name.rsplit(".", 1)[1] for name in names))
    number = {name: i for i, name in enumerate(names)}
    index = [[number.get(f"{owner}.{key}", -1) for key in keys] for owner in owners]
    return np.array(index, dtype=np.intp).reshape(len(views), len(keys)), keys, tuple(names)


def _cameras(measurements: Measurements, choices: Choices) -> tuple[Camera, ...]:
    """Return the camera of each view with the intrinsics that are fixed at given values."""
    views = measurements.views
    owners = shared_cameras([view.name for view in views], [view.camera for view in views])
    cameras = []
    for view, owner in zip(views, owners, strict=True):
        given = {
            key: choices.values[f"{owner}.{key}"]
            for key in intrinsic_names(view.camera)
            if f"{owner}.{key}" in choices.values
        }
        cameras.append(with_intrinsics(view.camera, given) if given else view.camera)
    return tuple(cameras)


def _priors(
    layout: Layout,
    named: Sequence[tuple[str, str]],
    radii: Mapping[str, float],
    choices: Choices,
    settings: RefinementSettings,
) -> Priors:
    """Return the priors that somebody stated, and those on the other radii."""
    found = []
    for i, (name, _) in enumerate(named):
        if name in choices.priors:
            found.append((i, choices.priors[name].mean, choices.priors[name].sigma))
        elif name in radii and name not in choices.free:
            found.append((i, radii[name], settings.radius_sigma * radii[name]))
    position, mean, sigma = (np.array(part) for part in zip(*found, strict=True)) if found else (
        np.zeros(0), np.zeros(0), np.zeros(0)
    )  # fmt: skip
    return Priors(layout, position.astype(np.intp), mean, sigma)
