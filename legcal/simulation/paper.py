"""Section 4.3: the paper's own evaluation, a hundred simulated calibrations of a 6-SPU."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import asdict, dataclass, field
from typing import Any

import numpy as np
from scipy.spatial.transform import RigidTransform
from scipy.special import elliprg

from legcal.calibration.joint_fit.factors import average_images
from legcal.calibration.joint_fit.fit import bound, refine
from legcal.calibration.joint_fit.problem import build_fit
from legcal.calibration.joint_fit.variables import FittedLegs, Start, cameras_from_hints, start_from
from legcal.data.axes import LegAxes
from legcal.data.outlines import no_outlines
from legcal.errors import LegcalError
from legcal.geometry.types import Array
from legcal.machine.equations import pose_sensitivity
from legcal.machine.leg import KinematicParameters, point_like_legs
from legcal.machine.parameters import parametrize, to_vector
from legcal.paper.four_steps import run_steps
from legcal.paper.nominal import NominalMachine, point_like_machine
from legcal.simulation.hexapod import (
    PAPER_VIEWS,
    RAISED,
    HexapodSession,
    PaperHexapod,
    follow_from_home,
    hexapod_cameras,
    hexapod_session,
    noncoplanar_hexapod,
    outlines_and_axes,
    paper_hexapod,
    perturb,
    poses_with_lengths,
    random_hexapod_poses,
    simulated_leg_vectors,
)
from legcal.simulation.observe import TableNoise
from legcal.simulation.paper_report import BOUND, INITIAL, PaperSummary
from legcal.simulation.study import Record, failure_of

MACHINES = {"coplanar": paper_hexapod, "noncoplanar": noncoplanar_hexapod}


@dataclass(frozen=True)
class PaperStudy:
    """The simulation of section 4.3, for coplanar and for non-coplanar joints."""

    noise: TableNoise = field(default_factory=TableNoise)  # of the axes
    initial_error: float = 0.002  # half width of the uniform errors of the initial parameters [m]
    reading_error: float = 3e-6  # half width of the uniform errors of the readings [m]
    n_poses: int = 15  # extreme poses of each camera position
    n_images: int = 3  # of each pose
    n_checked: int = 10  # random poses of eq (20)
    estimators: tuple[str, ...] = ("literal", "default", "fit")  # what is compared

    @property
    def name(self) -> str:
        """Its name on the command line."""
        return "paper"

    @property
    def settings(self) -> dict[str, Any]:
        """Everything that decides a run beside its seed."""
        return {
            "radians": self.noise == TableNoise.in_radians(),
            **asdict(self),
            "raised": RAISED,
            "views": [[f"leg{leg + 1}" for leg in legs] for legs in PAPER_VIEWS],
            "estimators": [*self.estimators, BOUND],
        }

    def one_run(self, seed: np.random.SeedSequence) -> Record:
        """Return what every estimator finds on one session of either machine."""
        seeds = seed.spawn(len(MACHINES))
        return {
            name: self._calibrations(truth(), np.random.default_rng(child))
            for (name, truth), child in zip(MACHINES.items(), seeds, strict=True)
        }

    def summary(self, records: Iterable[Record]) -> PaperSummary:
        """Return the means over all runs."""
        machines = {name: truth() for name, truth in MACHINES.items()}
        in_radians = self.noise == TableNoise.in_radians()
        return PaperSummary.of(records, machines, in_radians=in_radians)

    def _calibrations(self, machine: PaperHexapod, rng: np.random.Generator) -> Record:
        """Return the errors of all estimators for one session of a machine."""
        nominal = perturb(machine, rng, self.initial_error)
        session = hexapod_session(
            machine,
            hexapod_cameras(machine, rng),
            rng,
            noise=self.noise,
            sigma_q=self.reading_error / np.sqrt(3.0),
            uniform_readings=True,
            n_poses=self.n_poses,
            n_images=self.n_images,
        )
        checked = random_hexapod_poses(machine, self.n_checked, rng)
        exact = outlines_and_axes(machine, session.scene, session.measurements, self.noise, None)[1]
        covariance = bound_covariance(session, exact)
        found = {INITIAL: _errors(machine, nominal.parameters, covariance, checked)}
        for name in self.estimators:
            try:
                parameters = ESTIMATORS[name](session, nominal)
            except LegcalError as error:
                found[name] = {"failure": failure_of(error)}
            else:
                found[name] = _errors(machine, parameters, covariance, checked)
        sigma = np.sqrt(np.diagonal(covariance))
        found[BOUND] = errors_record(
            expected_errors(machine, covariance, checked), 1.0, np.sqrt(2.0 / np.pi) * sigma
        )
        return found


def _errors(
    machine: PaperHexapod,
    parameters: KinematicParameters,
    covariance: Array,
    checked: RigidTransform,
) -> Record:
    """Return the errors of eq (20) and those of every parameter, or the failure to compute them."""
    difference = to_vector(parameters, machine.frame_legs) - to_vector(
        machine.parameters, machine.frame_legs
    )
    squared = float(difference @ np.linalg.solve(covariance, difference)) / len(difference)
    try:
        errors = platform_errors(machine, parameters, checked)
    except LegcalError as error:
        return {"failure": failure_of(error)}
    return errors_record(errors, squared, np.abs(difference))


# Errors of the platform, eq (20)


@dataclass(frozen=True)
class PlatformErrors:
    """Means over poses of eq (20)."""

    dX: float  # displacement of B_1 from A_1, which are the origins of R_e and R_b [m]
    dE: float  # norm of the Euler angles between both orientations, as printed [rad]
    angle: float  # of that rotation [rad]: near the norm of Euler angles while both are small


def platform_errors(
    machine: PaperHexapod, parameters: KinematicParameters, T_Rb_Re: RigidTransform
) -> PlatformErrors:
    """Return the errors of eq (20) that parameters cause at poses of the true machine."""
    found = poses_of_readings(machine, parameters, T_Rb_Re)
    turn = T_Rb_Re.rotation.inv() * found.rotation
    displacement = np.linalg.norm(found.translation - T_Rb_Re.translation, axis=-1)
    euler = np.linalg.norm(turn.as_euler("xyz"), axis=-1)
    return PlatformErrors(
        float(displacement.mean()), float(euler.mean()), float(turn.magnitude().mean())
    )


def poses_of_readings(
    machine: PaperHexapod, parameters: KinematicParameters, T_Rb_Re: RigidTransform
) -> RigidTransform:
    """Return the poses that other parameters compute from the readings of true poses."""
    lengths = np.linalg.norm(simulated_leg_vectors(machine.parameters, T_Rb_Re), axis=-1)
    changed = lengths - machine.parameters.offsets + parameters.offsets
    return poses_with_lengths(parameters, changed, T_Rb_Re)


def expected_errors(
    machine: PaperHexapod, covariance: Array, T_Rb_Re: RigidTransform
) -> PlatformErrors:
    """Return the expected errors of eq (20) for Gaussian parameters, to first order."""
    legs, frame_legs = point_like_legs(machine.parameters), machine.frame_legs
    R, t = T_Rb_Re.rotation.as_matrix(), T_Rb_Re.translation
    parametrization = parametrize(machine.leg_names, legs, frame_legs)
    motion = pose_sensitivity(legs, parametrization, frame_legs, R, t)
    of_pose = motion @ covariance @ np.swapaxes(motion, -1, -2)
    dX = float(expected_norm(of_pose[:, 3:, 3:]).mean())
    dE = float(expected_norm(of_pose[:, :3, :3]).mean())
    return PlatformErrors(dX, dE, dE)


def expected_norm(covariance: Array) -> Array:
    """Return the expected norm of Gaussian vectors with covariances (..., 3, 3).

    The length of a Gaussian vector is that of its direction times a chi-distributed number of
    mean sqrt(8 / pi); the mean over directions is Carlson's elliptic integral R_G.
    """
    value = np.maximum(np.linalg.eigvalsh(covariance), 0.0)
    mean = elliprg(value[..., 0], value[..., 1], value[..., 2])
    return np.asarray(np.sqrt(8.0 / np.pi) * mean)


# Estimators


def literal_steps(session: HexapodSession, nominal: PaperHexapod) -> KinematicParameters:
    """Return what the four steps with the criteria as printed find."""
    steps = run_steps(nominal_of(nominal), session.axes, session.measurements, criteria="literal")
    return steps.parameters


def default_steps(session: HexapodSession, nominal: PaperHexapod) -> KinematicParameters:
    """Return what the four steps with legcal's criteria find."""
    return run_steps(nominal_of(nominal), session.axes, session.measurements).parameters


def one_fit(session: HexapodSession, nominal: PaperHexapod) -> KinematicParameters:
    """Return what the joint fit finds, started from the nominal model and rough cameras.

    ``legcal calibrate`` also starts from what the steps find and keeps the better of both; here the
    fit is compared with the steps, and does without them.
    """
    measurements = session.measurements
    axes = average_images(session.axes, measurements)
    legs = _legs(nominal)
    lengths = measurements.q_of_poses + nominal.parameters.offsets
    start = start_from(
        legs.nominal,
        measurements,
        legs,
        cameras_from_hints(measurements, RigidTransform.identity()),
        tuple(follow_from_home(nominal, lengths)[0]),
        "nominal",
    )
    return refine(legs, measurements, no_outlines(), start, axes=axes).parameters


# They look at measurements and axes of a session alone, and at the nominal machine.
ESTIMATORS = {"literal": literal_steps, "default": default_steps, "fit": one_fit}


def bound_covariance(session: HexapodSession, exact: LegAxes) -> Array:
    """Return the Cramer-Rao bound of the parameters from all axes and all readings."""
    axes = average_images(exact, session.measurements)
    legs = _legs(session.machine)
    problem = build_fit(legs, session.measurements, no_outlines(), axes=axes)
    problem.require_determined()
    truth = Start(
        legs.nominal,
        tuple(camera.T_Rb_camera.inv() for camera in session.cameras),
        tuple(session.T_Rb_Re),
        "truth",
    )
    return bound(problem, truth)


def nominal_of(machine: PaperHexapod) -> NominalMachine:
    """Return a simulated machine as the steps take it."""
    return point_like_machine(machine.leg_names, machine.parameters, machine.frame_legs)


def _legs(machine: PaperHexapod) -> FittedLegs:
    """Return the legs of a machine as the fit sees them."""
    legs = point_like_legs(machine.parameters)
    return FittedLegs(machine.leg_names, legs, machine.frame_legs, {})


def errors_record(errors: PlatformErrors, of_bound_squared: float, parameters: Array) -> Record:
    """Return errors as a record [m, rad]."""
    return {
        **asdict(errors),
        "of_bound_squared": of_bound_squared,
        "parameters": parameters.tolist(),
    }
