"""The estimators that studies compare, on the same simulated measurements."""

from __future__ import annotations

from collections.abc import Callable

from scipy.spatial.transform import RigidTransform

from legcal.geometry.types import Array
from legcal.mechanism.leg_geometry import point_like_legs
from legcal.mechanism.parameters import KinematicParameters
from legcal.observations.leg_axes import LegAxes
from legcal.observations.sets import no_outlines
from legcal.refinement.bound import average_images, bound
from legcal.refinement.build import build_fit
from legcal.refinement.legs import FittedLegs
from legcal.refinement.refine import refine
from legcal.refinement.start import Start, cameras_from_hints, start_from
from legcal.simulation.forward import follow_from_home
from legcal.simulation.machine import Machine
from legcal.stages.nominal import NominalMechanism, point_like_mechanism
from legcal.stages.run import run_steps
from legcal.studies.session import SimulatedSession

Estimator = Callable[[SimulatedSession, Machine], KinematicParameters]
"""Called as ``estimator(session, nominal)``; it looks at measurements and axes alone."""


def literal_steps(session: SimulatedSession, nominal: Machine) -> KinematicParameters:
    """Return what the four steps with the criteria as printed find."""
    steps = run_steps(nominal_of(nominal), session.axes, session.measurements, criteria="literal")
    return steps.parameters


def default_steps(session: SimulatedSession, nominal: Machine) -> KinematicParameters:
    """Return what the four steps with legcal's criteria find."""
    return run_steps(nominal_of(nominal), session.axes, session.measurements).parameters


def one_fit(session: SimulatedSession, nominal: Machine) -> KinematicParameters:
    """Return what one fit of everything finds, started from the nominal model and rough cameras.

    ``legcal calibrate`` also starts from what the steps find and keeps the better of both; here the
    fit is compared with the steps, and does without them.
    """
    measurements = session.measurements
    axes = average_images(session.axes, measurements)
    legs = _legs(nominal)
    lengths = nominal.sign * measurements.q[measurements.first_rows] + nominal.parameters.offsets
    start = start_from(
        legs.nominal,
        measurements,
        legs,
        cameras_from_hints(measurements, RigidTransform.identity()),
        tuple(follow_from_home(nominal, lengths).T_Rb_Re),
        "nominal",
    )
    return refine(legs, measurements, no_outlines(), start, axes=axes).parameters


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
    legs = _legs(session.machine)
    problem = build_fit(legs, session.measurements, no_outlines(), axes=axes)
    truth = Start(
        legs.nominal,
        tuple(camera.T_Rb_camera.inv() for camera in session.cameras),
        tuple(session.T_Rb_Re),
        "truth",
    )
    return bound(problem, truth)


ESTIMATORS: dict[str, Estimator] = {
    "literal": literal_steps,
    "default": default_steps,
    "fit": one_fit,
}


def nominal_of(machine: Machine) -> NominalMechanism:
    """Return a simulated machine as the steps take a mechanism."""
    return point_like_mechanism(
        machine.leg_names, machine.parameters, machine.sign, machine.frame_legs
    )


def _legs(machine: Machine) -> FittedLegs:
    """Return the legs of a machine as the fit sees them."""
    legs = point_like_legs(machine.parameters)
    return FittedLegs(machine.leg_names, legs, machine.sign, machine.frame_legs, {})
