"""Building the fit: which unknowns there are, what each measurement depends on, what is known."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from legcal.calibration.joint_fit.choices import NO_CHOICES, Choices
from legcal.calibration.joint_fit.normal import check_counts
from legcal.calibration.joint_fit.observations import (
    ObservedAxes,
    ObservedBoard,
    ObservedOutlines,
    Readings,
    SeenBoard,
    observed_axes,
    observed_board,
    observed_outlines,
    readings,
    seen_by,
)
from legcal.calibration.joint_fit.parameters import BOARD_SCALE
from legcal.calibration.joint_fit.problem import (
    FirstValues,
    FitProblem,
    Priors,
    chosen_cameras,
    couple,
    unknown_intrinsics,
)
from legcal.calibration.joint_fit.state import (
    DEFAULT_SETTINGS,
    FittedLegs,
    Layout,
    RefinementSettings,
    lay_out,
)
from legcal.data import LegAxes, Measurements, Outlines
from legcal.machine import radius_name
from legcal.vision import Camera, intrinsic_unit, shared_cameras


def build_fit(
    legs: FittedLegs,
    measurements: Measurements,
    outlines: Outlines,
    settings: RefinementSettings = DEFAULT_SETTINGS,
    *,
    axes: LegAxes | None = None,
    board: SeenBoard | None = None,
    choices: Choices = NO_CHOICES,
) -> FitProblem:
    """Build the fit of everything without solving it.

    Parameters
    ----------
    legs : FittedLegs
        The mechanism (:func:`legcal.calibration.joint_fit.state.fitted_legs`).
    measurements : Measurements
        Views, poses and readings [m].
    outlines : Outlines
        Outlines in pixels; only the used ones enter.
    settings : RefinementSettings
        Choices of the fit.
    axes : LegAxes, optional
        Measured axes, beside outlines or instead of them (give
        :func:`legcal.data.outlines.no_outlines`). Their covariances are taken as they are.
    board : SeenBoard, optional
        A calibration board that stands still on the base, and its corners in images.
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
    cameras = chosen_cameras(measurements, choices)
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
        observed_board(board, measurements, cameras),
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
        problem.board,
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
    corners: ObservedBoard,
    cameras: tuple[Camera, ...],
    owners: tuple[str, ...],
    n_poses: int,
    settings: RefinementSettings,
) -> FitProblem:
    """Return the problem of measurements, with the unknowns and the priors of choices."""
    seen = np.zeros(len(cameras), dtype=np.bool_)
    seen[observed.view] = seen[lines.view] = seen[corners.view] = True
    radii = [radius_name(legs.names[leg], part) for leg, part in observed.parts]
    intrinsic, keys, intrinsics = unknown_intrinsics(observed.views, cameras, owners, choices)
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
        (len(corners) > 0 and not choices.holds(BOARD_SCALE), len(corners) > 0),
        n_poses,
    )
    units = legs.parametrization.units
    named = [
        *((n, u) for n, u, free in zip(names, units, is_free, strict=True) if free),
        *((name, "m") for name in radii if not choices.holds(name)),
        *((name, intrinsic_unit(name.rsplit(".", 1)[1])) for name in intrinsics),
        *((BOARD_SCALE, "") for _ in layout.board_scale[layout.board_scale < layout.size]),
    ]
    nominal = np.array([legs.radii[part] for part in observed.parts])
    first = FirstValues(
        np.array([choices.values.get(n, r) for n, r in zip(radii, nominal.tolist(), strict=True)]),
        cameras,
        choices.values.get(BOARD_SCALE, 1.0),
    )
    return FitProblem(
        legs,
        choices,
        layout,
        observed,
        encoders,
        lines,
        corners,
        _priors(layout, named, dict(zip(radii, nominal.tolist(), strict=True)), choices, settings),
        first,
        couple(layout, observed, encoders, lines, corners),
        tuple(name for name, _ in named),
        tuple(unit for _, unit in named),
        np.zeros((0, layout.n_kept)),
    )


def _priors(
    layout: Layout,
    named: Sequence[tuple[str, str]],
    radii: Mapping[str, float],
    choices: Choices,
    settings: RefinementSettings,
) -> Priors:
    """Return the priors that somebody stated, and those on the other radii and on the board."""
    found = []
    for i, (name, _) in enumerate(named):
        if name in choices.priors:
            found.append((i, choices.priors[name].mean, choices.priors[name].sigma))
        elif name in radii and name not in choices.free:
            found.append((i, radii[name], settings.radius_sigma * radii[name]))
        elif name == BOARD_SCALE and name not in choices.free:
            found.append((i, 1.0, settings.board_scale_sigma))
    position, mean, sigma = (np.array(part) for part in zip(*found, strict=True)) if found else (
        np.zeros(0), np.zeros(0), np.zeros(0)
    )  # fmt: skip
    return Priors(layout, position.astype(np.intp), mean, sigma)
