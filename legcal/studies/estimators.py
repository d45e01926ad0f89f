"""The estimators that studies compare, on the same simulated measurements."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from functools import lru_cache

import numpy as np
from scipy.spatial.transform import RigidTransform

from legcal.geometry.types import Array
from legcal.mechanism.parameters import KinematicParameters
from legcal.observations.leg_axes import LegAxes
from legcal.observations.measurements import Measurements
from legcal.refinement.legs import FittedLegs
from legcal.refinement.repeated import (
    AxesFit,
    average_images,
    bound,
    build_axes_fit,
    solve_again,
)
from legcal.refinement.start import Start, cameras_from_hints, start_from
from legcal.simulation.forward import follow_from_home
from legcal.simulation.machine import Machine
from legcal.stages.run import run_steps
from legcal.studies.session import SimulatedSession

Estimator = Callable[[SimulatedSession, Machine], KinematicParameters]
"""Called as ``estimator(session, nominal)``; it looks at measurements and axes alone."""


def literal_steps(session: SimulatedSession, nominal: Machine) -> KinematicParameters:
    """Return what the four steps with the criteria as printed find."""
    return run_steps(nominal, session.axes, session.measurements, criteria="literal").parameters


def default_steps(session: SimulatedSession, nominal: Machine) -> KinematicParameters:
    """Return what the four steps with legcal's criteria find."""
    return run_steps(nominal, session.axes, session.measurements).parameters


def one_fit(session: SimulatedSession, nominal: Machine) -> KinematicParameters:
    """Return what one fit of everything finds, started from the nominal model and rough cameras.

    ``legcal calibrate`` also starts from what the steps find and keeps the better of both; here the
    fit is compared with the steps, and does without them.
    """
    measurements = session.measurements
    axes = average_images(session.axes, measurements)
    fit = _fit_of(nominal, measurements, axes)
    lengths = nominal.sign * measurements.q[measurements.first_rows] + nominal.parameters.offsets
    start = start_from(
        nominal.parameters,
        measurements,
        fit.legs,
        cameras_from_hints(measurements, RigidTransform.identity()),
        tuple(follow_from_home(nominal, lengths).T_Rb_Re),
        "nominal",
    )
    return solve_again(fit, measurements, axes, start).parameters


def bound_covariance(session: SimulatedSession, exact: LegAxes) -> Array:
    """Return the Cramer-Rao bound of the parameters from all axes and all readings.

    Parameters
    ----------
    session : SimulatedSession
        What was measured, and the truth.
    exact : LegAxes
        The axes of all its images without noise, with the covariance of the noise.

    Returns
    -------
    (n, n) array
        In the order of ``parameters.to_vector`` [m^2]; cameras and platform poses are unknown.
    """
    axes = average_images(exact, session.measurements)
    fit = _fit_of(session.machine, session.measurements, axes)
    truth = Start(
        session.machine.parameters,
        tuple(camera.T_Rb_camera.inv() for camera in session.cameras),
        tuple(session.T_Rb_Re),
        "truth",
    )
    return bound(fit, session.measurements, axes, truth).covariance


ESTIMATORS: dict[str, Estimator] = {
    "literal": literal_steps,
    "default": default_steps,
    "fit": one_fit,
}


def _fit_of(machine: Machine, measurements: Measurements, axes: LegAxes) -> AxesFit:
    """Return the fit of axes, built once for all sessions that show the same legs and poses."""
    shown = np.column_stack([axes.leg, measurements.view[axes.row], measurements.pose[axes.row]])
    return _built(
        _Structure(
            machine.leg_names,
            machine.frame_legs,
            tuple(machine.sign.tolist()),
            shown.tobytes(),
            (machine, measurements, axes),
        )
    )


@dataclass(frozen=True)
class _Structure:
    """What fits of sessions share, and a session to build one of.

    The legs, and which leg at which pose is in which view; the session makes no difference.
    """

    leg_names: tuple[str, ...]
    frame_legs: tuple[int, ...]
    sign: tuple[int, ...]
    shown: bytes
    session: tuple[Machine, Measurements, LegAxes] = field(compare=False)


@lru_cache(maxsize=1)  # it may be large
def _built(structure: _Structure) -> AxesFit:
    """Return the fit of a structure."""
    machine, measurements, axes = structure.session
    legs = FittedLegs(machine.leg_names, machine.sign, machine.frame_legs, {})
    return build_axes_fit(legs, measurements, axes)
