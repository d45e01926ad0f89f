"""Section 4.3: the paper's own evaluation, a hundred simulated calibrations of a 6-SPU."""

from __future__ import annotations

import io
from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from math import isfinite
from typing import TYPE_CHECKING, Any

import numpy as np
from rich.console import Group, RenderableType
from rich.table import Table
from rich.text import Text
from scipy.spatial.transform import RigidTransform, Rotation
from scipy.special import elliprg

from legcal.calibration import (
    FittedLegs,
    Start,
    average_images,
    bound,
    build_fit,
    cameras_from_hints,
    refine,
    start_from,
)
from legcal.data import (
    LegAxes,
    Measurements,
    Outlines,
    View,
    axes_from_outlines,
    axes_of_table,
    no_outlines,
)
from legcal.errors import DidNotConverge, LegcalError
from legcal.geometry import Array
from legcal.machine import (
    KinematicParameters,
    LegGeometry,
    free_coordinates,
    parametrize,
    point_like_legs,
    pose_equations,
    solve_poses,
    to_vector,
)
from legcal.paper import NominalMechanism, point_like_mechanism, run_steps
from legcal.simulation.cameras import PAPER_VIEWS, LegCamera, cameras_around, rough_pose
from legcal.simulation.machine import (
    Machine,
    extreme_poses,
    follow_from_home,
    hexapod,
    leg_vectors,
    length_jacobian,
    perturb,
    poses_with_lengths,
    random_poses,
)
from legcal.simulation.observe import OutlineNoise, observe_outlines, outline_table
from legcal.simulation.studies.runner import Record, failure_of, is_failure
from legcal.simulation.table_noise import TableNoise, observe_axes

RAISED = 0.030  # [m]


def coplanar_hexapod() -> Machine:
    """Return the shipped hexapod: all base joints in one plane, all platform joints in another."""
    return hexapod()


def noncoplanar_hexapod() -> Machine:
    """Return that hexapod with joints 2, 4 and 6 moved out of the planes of 1, 3 and 5.

    They are 30 mm higher at the base and 30 mm lower at the platform.
    """
    machine = hexapod()
    A, B = machine.parameters.base_joints.copy(), machine.parameters.platform_joints.copy()
    A[1::2, 2] += RAISED
    B[1::2, 2] -= RAISED
    return replace(machine, parameters=KinematicParameters(A, B, machine.parameters.offsets))


@dataclass(frozen=True)
class PlatformErrors:
    """Means over poses of eq (20)."""

    dX: float  # displacement of B_1 from A_1, which are the origins of R_e and R_b [m]
    # norm of the Euler angles of the rotation between both orientations, as printed [rad]
    dE: float
    # angle of that rotation [rad]: the norm of Euler angles is near it while both are small
    angle: float


def platform_errors(
    machine: Machine, parameters: KinematicParameters, T_Rb_Re: RigidTransform
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
    machine: Machine, parameters: KinematicParameters, T_Rb_Re: RigidTransform
) -> RigidTransform:
    """Return the poses that other parameters compute from the readings of true poses."""
    lengths = np.linalg.norm(leg_vectors(machine.parameters, T_Rb_Re), axis=-1)
    changed = lengths - machine.parameters.offsets + parameters.offsets
    return poses_with_lengths(parameters, changed, T_Rb_Re)


def expected_errors(machine: Machine, covariance: Array, T_Rb_Re: RigidTransform) -> PlatformErrors:
    """Return the errors of eq (20) to expect of Gaussian parameters, to first order."""
    follow = platform_by_parameters(machine, T_Rb_Re)
    of_pose = follow @ covariance @ np.swapaxes(follow, -1, -2)
    dX = float(expected_norm(of_pose[:, :3, :3]).mean())
    dE = float(expected_norm(of_pose[:, 3:, 3:]).mean())
    return PlatformErrors(dX, dE, dE)


def platform_by_parameters(machine: Machine, T_Rb_Re: RigidTransform) -> Array:
    """Return d (translation, rotation vector in R_b) / d parameters at fixed readings.

    The legs keep their lengths but for the offsets: u . (dt + w x R B + R dB - dA) = dq0.
    """
    R, t = T_Rb_Re.rotation.as_matrix(), T_Rb_Re.translation
    J = length_jacobian(machine.parameters, R, t)
    n_poses, n_legs = J.shape[:2]
    u = J[..., :3]
    to_base = np.zeros((n_poses, n_legs, n_legs, 3))
    to_platform = np.zeros((n_poses, n_legs, n_legs, 3))
    leg = np.arange(n_legs)
    to_base[:, leg, leg] = u
    to_platform[:, leg, leg] = -(u @ R)
    free = free_coordinates(n_legs, machine.frame_legs)
    to_offsets = np.tile(np.eye(n_legs), (n_poses, 1, 1))
    change = np.concatenate([to_base[:, :, free], to_platform[:, :, free], to_offsets], axis=-1)
    return np.asarray(np.linalg.pinv(J) @ change)


def expected_norm(covariance: Array) -> Array:
    """Return the expected norm of Gaussian vectors with covariances (..., 3, 3).

    The length of a Gaussian vector is that of its direction times a chi-distributed number of
    mean sqrt(8 / pi); the mean over directions is Carlson's elliptic integral R_G.
    """
    value = np.maximum(np.linalg.eigvalsh(covariance), 0.0)
    mean = elliprg(value[..., 0], value[..., 1], value[..., 2])
    return np.asarray(np.sqrt(8.0 / np.pi) * mean)


@dataclass(frozen=True, eq=False)
class SimulatedSession:
    """Measurements of a simulated machine, and what is true of it."""

    # images, readings and rough camera poses. The base link's frame is R_b
    measurements: Measurements
    # outlines in the images; None where Table 1 gave the noise of the axes
    outlines: Outlines | None
    axes: LegAxes  # axes of the legs
    machine: Machine  # the true machine
    cameras: tuple[LegCamera, ...]  # the true cameras
    T_Rb_Re: RigidTransform  # the true platform poses, by index of pose


def simulate_session(
    machine: Machine,
    cameras: Sequence[LegCamera],
    rng: np.random.Generator,
    *,
    noise: OutlineNoise | TableNoise,
    noisy: bool = True,
    sigma_q: float = 2e-6,
    uniform_readings: bool = False,
    n_poses: int = 15,
    n_images: int = 1,
    share_poses: bool = False,
) -> SimulatedSession:
    """Simulate readings and observations of a machine (section 4.3)."""
    n_views = len(cameras)
    T_Rb_Re = extreme_poses(machine, n_poses if share_poses else n_views * n_poses, rng)
    view = np.repeat(np.arange(n_views), n_poses * n_images)
    pose = np.repeat(np.arange(n_views * n_poses), n_images)
    pose = (pose % n_poses if share_poses else pose).astype(np.intp)
    lengths = np.linalg.norm(leg_vectors(machine.parameters, T_Rb_Re), axis=-1)
    q = (lengths - machine.parameters.offsets) * machine.sign
    if noisy:
        q = q + _reading_errors(rng, sigma_q, q.shape, uniform=uniform_readings)
    measurements = Measurements(
        views=tuple(_view(i, c, machine, rng if noisy else None) for i, c in enumerate(cameras)),
        image=("",) * len(view),
        view=view.astype(np.intp),
        pose=pose,
        q=q[pose],
        sigma_q=sigma_q,
    )
    outlines, axes = observe_session(
        machine, cameras, T_Rb_Re, measurements, noise, rng if noisy else None
    )
    return SimulatedSession(measurements, outlines, axes, machine, tuple(cameras), T_Rb_Re)


def _reading_errors(
    rng: np.random.Generator, sigma: float, shape: tuple[int, ...], *, uniform: bool
) -> Array:
    """Return errors of readings with a given standard deviation [m]."""
    if uniform:
        half_width = np.sqrt(3.0) * sigma
        return rng.uniform(-half_width, half_width, shape)
    return rng.normal(scale=sigma, size=shape)


def observe_session(
    machine: Machine,
    cameras: Sequence[LegCamera],
    T_Rb_Re: RigidTransform,
    measurements: Measurements,
    noise: OutlineNoise | TableNoise,
    rng: np.random.Generator | None,
) -> tuple[Outlines | None, LegAxes]:
    """Return what all images of a session show."""
    seen = [np.array(cameras[v].legs, dtype=np.intp) for v in measurements.view]
    legs = [
        _legs_in_camera(machine, camera, T_Rb_Re[measurements.pose[measurements.view == v]])
        for v, camera in enumerate(cameras)
    ]
    if isinstance(noise, TableNoise):
        row = np.repeat(np.arange(len(seen)), [len(s) for s in seen])
        u, A, _, _ = (np.concatenate(part) for part in zip(*legs, strict=True))
        table = observe_axes(row, np.concatenate(seen), u, A, noise, rng)
        return None, axes_of_table(table.row, table.leg, table.values, table.sigmas)
    images = [
        observe_outlines(camera.camera, of_view, noise, rng)
        for camera, of_view in zip(cameras, legs, strict=True)
    ]
    h, ends = zip(*images, strict=True)
    outlines = outline_table(range(len(seen)), seen, h, ends, machine.parts, noise)
    return outlines, axes_from_outlines(outlines, measurements, machine.radius_of_part())


def _legs_in_camera(
    machine: Machine, camera: LegCamera, T_Rb_Re: RigidTransform
) -> tuple[Array, Array, Array, Array]:
    """Return u, A (camera frame), length and radius of the legs in images, by image, then leg."""
    seen = list(camera.legs)
    legs = leg_vectors(machine.parameters, T_Rb_Re)[:, seen].reshape(-1, 3)
    length = np.linalg.norm(legs, axis=-1)
    T_camera_Rb = camera.T_Rb_camera.inv()
    u = T_camera_Rb.rotation.apply(legs / length[:, None])
    A = T_camera_Rb.apply(machine.parameters.base_joints[seen])
    n_images = len(T_Rb_Re)
    return u, np.tile(A, (n_images, 1)), length, np.tile(machine.radius[seen], n_images)


def _view(index: int, camera: LegCamera, machine: Machine, rng: np.random.Generator | None) -> View:
    """Return the view with a rough camera pose; the true one without a source of chance."""
    T = camera.T_Rb_camera if rng is None else rough_pose(camera.T_Rb_camera, rng)
    names = tuple(f"leg{j + 1}" for j in camera.legs)
    everything = len(names) == machine.n_legs
    return View(f"c{index + 1}", camera.camera, T, None if everything else names)


_STEPS = 20
_CLOSED = 1e-13  # [m]


def closed_poses(
    legs: Sequence[LegGeometry], frame_legs: Sequence[int], R: Array, t: Array
) -> tuple[Array, Array]:
    """Return the nearest poses at which everything holds that legs demand without a reading."""
    if len(frame_legs) < 3:
        R, t = _in_plane(legs, R, t)
    found = solve_poses(legs, frame_legs, R, t)
    if found.missed.max(initial=0.0) < _CLOSED:
        return found.R, found.t
    raise DidNotConverge(
        f"Simulated poses could not be closed: found legs {1e3 * found.missed.max():.2g} mm off "
        "what they demand, needed poses that they allow; check the model's home."
    )


def unmeasured(legs: Sequence[LegGeometry], R: Array, t: Array) -> tuple[Array, Array]:
    """Return the equations that hold without a reading, (k, m) [m], and how poses change them."""
    found = pose_equations(legs, R, t, by_local=False)
    held = found.of(~found.measured)
    return held.values, held.by_pose


def moved_poses(R: Array, t: Array, step: Array) -> tuple[Array, Array]:
    """Return poses after a rotation [rad] and a displacement [m] in R_b, (k, 6)."""
    turn = Rotation.from_rotvec(step[..., :3]).as_matrix()
    return np.asarray(turn @ R), np.asarray(t + step[..., 3:])


def _in_plane(legs: Sequence[LegGeometry], R: Array, t: Array) -> tuple[Array, Array]:
    """Return poses turned and lifted into the plane of motion."""
    angle = np.arctan2(R[:, 1, 0], R[:, 0, 0])
    t = t.copy()
    t[:, 2] = np.mean([leg.A[2] - leg.B[2] for leg in legs])
    return Rotation.from_euler("z", angle[:, None]).as_matrix(), t


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
    """Return the Cramer-Rao bound of the parameters from all axes and all readings."""
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


SCALARS = ("dX", "dE", "angle", "of_bound_squared")
_N_PARAMETERS = 30  # of a 6-SPU


def errors_record(errors: PlatformErrors, of_bound_squared: float, parameters: Array) -> Record:
    """Return errors as a record [m, rad]."""
    return {
        **asdict(errors),
        "of_bound_squared": of_bound_squared,
        "parameters": parameters.tolist(),
    }


def is_errors(found: Any) -> bool:
    """Return whether a document has the errors of one estimator, or how it failed."""
    if has_keys(found, {"failure"}):
        return is_failure(found["failure"])
    return (
        has_keys(found, {*SCALARS, "parameters"})
        and all(_is_number(found[name]) for name in SCALARS)
        and isinstance(found["parameters"], list)
        and len(found["parameters"]) == _N_PARAMETERS
        and all(map(_is_number, found["parameters"]))
    )


def has_keys(found: Any, keys: set[str]) -> bool:
    """Return whether a document is an object with exactly these keys."""
    return isinstance(found, dict) and found.keys() == keys


def _is_number(found: Any) -> bool:
    return isinstance(found, float | int) and not isinstance(found, bool) and isfinite(found)


INITIAL = "initial"
BOUND = "bound"


@dataclass(frozen=True, eq=False)
class Means:
    """Means of one estimator's errors over the runs in which it did not fail."""

    machine: str  # machine, estimator: whose they are
    estimator: str
    n: int  # number of these runs
    failures: dict[str, int]  # the others, by kind of error
    dX: float  # dX, dE, angle: means of eq (20) [m], [rad]; zero without any run, as all others
    dE: float
    angle: float
    # root mean square of d' inv(C) d / n for errors d of the n parameters, C being the covariance
    # of the Cramer-Rao bound of the same run: 1 for an estimator that reaches it. Its spread is far
    # smaller than that of dX
    of_bound: float
    # dX_uncertainty, dE_uncertainty, of_bound_uncertainty: standard deviations of these means [m],
    # [rad], [1]
    dX_uncertainty: float
    dE_uncertainty: float
    of_bound_uncertainty: float
    parameters: Array  # (n_parameters,) mean absolute error of every parameter [m]

    def document(self) -> dict[str, Any]:
        """Return a row of ``--json``; null where every run failed."""
        return {
            "estimator": self.estimator,
            "coplanar": self.machine == "coplanar",
            "dX_mm": 1e3 * self.dX if self.n else None,
            "dE_deg": float(np.degrees(self.dE)) if self.n else None,
            "parameters_mm": (1e3 * self.parameters).tolist() if self.n else [],
            "angle_deg": float(np.degrees(self.angle)) if self.n else None,
            "dX_mean_sigma_mm": 1e3 * self.dX_uncertainty if self.n else None,
            "dE_mean_sigma_deg": float(np.degrees(self.dE_uncertainty)) if self.n else None,
            "of_bound": self.of_bound if self.n else None,
            "of_bound_sigma": self.of_bound_uncertainty if self.n else None,
            "runs": self.n,
            "failed": sum(self.failures.values()),
            "failures": self.failures,
        }


@dataclass(frozen=True, eq=False)
class PaperMeans:
    """Errors before and after calibration, of every estimator on either machine."""

    means: tuple[Means, ...]  # by machine, and then: initial, the estimators, the bound
    names: tuple[str, ...]  # names of the parameters
    truths: dict[str, Array]  # (n_parameters,) true values of each machine [m]

    def of(self, machine: str) -> tuple[Means, ...]:
        """Return the means of one machine."""
        return tuple(means for means in self.means if means.machine == machine)


class _Sums:
    """Running sums of one estimator's errors."""

    def __init__(self, n_parameters: int) -> None:
        self.n = 0
        self.scalars = np.zeros(len(SCALARS))
        self.squares = np.zeros(len(SCALARS))
        self.parameters = np.zeros(n_parameters)
        self.failures: Counter[str] = Counter()

    def add(self, record: Record) -> None:
        """Add what one run found."""
        if "failure" in record:
            self.failures[record["failure"]["kind"]] += 1
            return
        scalars = np.array([record[name] for name in SCALARS])
        self.n += 1
        self.scalars += scalars
        self.squares += scalars**2
        self.parameters += record["parameters"]

    def means(self, machine: str, estimator: str) -> Means:
        """Return the means."""
        means = self.scalars / max(self.n, 1)
        variances = np.maximum(self.squares / max(self.n, 1) - means**2, 0.0)
        dX, dE, angle, squared = means.tolist()
        of_dX, of_dE, _, of_squared = np.sqrt(variances / max(self.n - 1, 1)).tolist()
        ratio = float(np.sqrt(squared))
        return Means(
            machine,
            estimator,
            self.n,
            dict(sorted(self.failures.items())),
            dX,
            dE,
            angle,
            ratio,
            of_dX,
            of_dE,
            of_squared / (2.0 * ratio) if ratio else 0.0,
            self.parameters / max(self.n, 1),
        )


def means_of(records: Iterable[Record], machines: Mapping[str, Machine]) -> PaperMeans:
    """Return the means over records, which are read once."""
    first = next(iter(machines.values()))
    names = parametrize(first.leg_names, point_like_legs(first.parameters), first.frame_legs).names
    sums: dict[tuple[str, str], _Sums] = {}
    for record in records:
        for machine, found in record.items():
            for estimator, errors in found.items():
                sums.setdefault((machine, estimator), _Sums(len(names))).add(errors)
    return PaperMeans(
        tuple(total.means(*key) for key, total in sums.items()),
        names,
        {
            name: to_vector(machine.parameters, machine.frame_legs)
            for name, machine in machines.items()
        },
    )


@dataclass(frozen=True)
class Printed:
    """Figures of section 4.3 as printed."""

    dX_mm: float  # dX_mm, dE_deg: means of (20)
    dE_deg: float
    # the least and the largest mean error of a parameter
    parameters_mm: tuple[float, float] | None = None
    runs: int | None = None  # number of calibrations

    def document(self) -> dict[str, Any]:
        """Return what there is as a JSON document."""
        found = asdict(self)
        if self.parameters_mm is not None:
            found["parameters_mm"] = list(self.parameters_mm)
        return {key: value for key, value in found.items() if value is not None}


PRINTED_BEFORE = Printed(dX_mm=1.0, dE_deg=0.12)
PRINTED_AFTER = Printed(dX_mm=0.08, dE_deg=0.018, parameters_mm=(0.04, 1.0), runs=100)
CONTEXT = (
    "The paper's figures are context only: the dimensions of its machine are not published. It "
    "prints orientation errors of 0.12 and 0.018 rad; only degrees fit 1 and 0.08 mm."
)
IN_DEGREES = (
    'Table 1 prints the standard deviations of psi and theta as "0.05 rad" and "0.06 rad": read '
    "as degrees. --radians takes them to the letter: the steps then end tens of millimetres off."
)
IN_RADIANS = (
    'Table 1 prints the standard deviations of psi and theta as "0.05 rad" and "0.06 rad": taken '
    "to the letter, as --radians asks."
)
READINGS = (
    "psi and theta are not defined: read as the tilt out of the image plane, asin(u_z), and the "
    "angle in the image, atan2(-u_x, u_y).",
    '"uniform noise with variance equal to 2mm" on the initial parameters: read as uniform '
    "within +-2 mm.",
    '"uniformly distributed noise, variance equal to 3um" on leg lengths: read as uniform within '
    "+-3 um, a standard deviation of 1.7 um; one reading for all images of a pose.",
    '"Fifteen end-effector poses": read as fifteen of each of the three camera positions, whose '
    "poses differ.",
    '"randomly selecting configurations with extreme leg lengths": every leg at random within '
    "12 % of its travel from its shortest or its longest, reached from home without a singularity.",
    '"three images are acquired" of each pose: each with its own noise. The fit and the bound use '
    "the mean of a leg's axis in them, weighted by the covariances; it holds all that they tell.",
    '"ten randomly chosen poses" of (20): leg lengths uniform in the travel, drawn anew in every '
    "run.",
    "(20) as printed: dX is the displacement of B_1 from A_1, dE the norm of the x-y-z Euler "
    "angles of the rotation between both orientations.",
    "The machine: the shipped hexapod, whose joints are coplanar, and the same with joints 2, 4 "
    "and 6 moved 30 mm out of the planes of 1, 3 and 5; cameras stand 0.9 m from its middle.",
    "one fit: started from the initial model and from cameras up to 15 mm and 1.5 deg off, not "
    "from what the steps find.",
    "bound: the Cramer-Rao bound of the same data, all used at once; the table has the errors to "
    "be expected of an estimator that reaches it. Errors of readings count as Gaussian there, "
    "with the variance of the uniform ones.",
    '"of bound": root mean square of the errors of all thirty parameters together, each measured '
    "by the covariance of the bound of its run; 1 where it is reached. +- is one standard "
    "deviation of the mean over runs.",
)


LABELS = {  # also of the figure
    "initial": "before",
    "literal": "steps as printed",
    "default": "legcal's steps",
    "fit": "one fit",
    "bound": "Cramer-Rao bound",
}
JOINTS = {"coplanar": "coplanar", "noncoplanar": "non-coplanar"}
_COLUMNS = ("dX [mm]", "dE [deg]", "parameters [mm]", "of bound", "runs")
_LARGE = 10.0  # in the unit of its column


def paper_table(found: PaperMeans, readings: Sequence[str]) -> RenderableType:
    """Return errors before and after calibration, beside the figures that the paper prints."""
    table = Table(box=None, pad_edge=False)
    table.add_column("joints", no_wrap=True)
    for column in _COLUMNS:
        table.add_column(Text(column), justify="right")
    for name in found.truths:
        table.add_row(JOINTS[name])
        for means in found.of(name):
            table.add_row(f" {LABELS[means.estimator]}", *_cells(means))
    table.add_row("paper, as printed")
    table.add_row(" before", *_printed_cells(PRINTED_BEFORE))
    table.add_row(" after", *_printed_cells(PRINTED_AFTER))
    notes = [*_failures(found), CONTEXT, *readings]
    return Group(table, Text(), *(Text(f"- {line}", style="dim") for line in notes))


def _cells(means: Means) -> tuple[str, ...]:
    """Return the figures of a row."""
    if means.n == 0:
        return ("all failed", "", "", "", "0")
    return (
        _with_sigma(1e3 * means.dX, 1e3 * means.dX_uncertainty, digits=3),
        f"{np.degrees(means.dE):.4f}",
        _range(1e3 * means.parameters.min(), 1e3 * means.parameters.max()),
        "1"
        if means.estimator == BOUND
        else _with_sigma(means.of_bound, means.of_bound_uncertainty, digits=2),
        f"{means.n}",
    )


def _printed_cells(printed: Printed) -> tuple[str, ...]:
    """Return the figures of a row that the paper prints."""
    between = "" if printed.parameters_mm is None else _range(*printed.parameters_mm)
    runs = "" if printed.runs is None else f"{printed.runs}"
    return (f"{printed.dX_mm:g}", f"{printed.dE_deg:g}", between, "", runs)


def _range(lowest: float, highest: float) -> str:
    """Return the least and the largest error of a parameter."""
    digits = 3 if highest < _LARGE else 1
    return f"{lowest:.{digits}f} to {highest:.{digits}f}"


def _with_sigma(mean: float, sigma: float, *, digits: int) -> str:
    """Return a mean and its standard deviation; large ones with fewer digits."""
    shown = digits if mean < _LARGE else digits - 2
    return f"{mean:.{shown}f} +- {sigma:.{shown}f}"


def _failures(found: PaperMeans) -> list[str]:
    """Return a sentence for each row that some runs are not in."""
    return [
        f"{LABELS[means.estimator]}, {JOINTS[means.machine]} joints: {failed} of "
        f"{means.n + failed} runs failed ({', '.join(means.failures)}) and are not in the means."
        for means in found.means
        if (failed := sum(means.failures.values()))
    ]


if TYPE_CHECKING:
    from matplotlib.axes import Axes

_DRAWN = ("literal", "default", "fit")
_BAR, _LIMIT, _LINE = "#4c78a8", "#e45756", "#8a8a8a"
_LETTERS = {"base": "A", "platform": "B", "offset": "q0"}
_ERROR_AXIS, _TRUTH_AXIS = "mean error [mm]", "true value [mm]"
_BARS, _MARKS, _TRUE = "mean error", "expected at the Cramer-Rao bound", "true value (right)"


@dataclass(frozen=True, eq=False)
class _Panel:
    """One panel: an estimator on a machine [mm]."""

    title: str
    errors: Array
    limit: Array
    truth: Array


def figure_as_html(found: PaperMeans) -> bytes:
    """Return the figure as one HTML page that works without a network."""
    from plotly.subplots import make_subplots

    grid, names = _panels(found), list(map(_label, found.names))
    n_rows, n_columns = len(grid), len(grid[0])
    decades = np.log10(_limits(grid)).tolist()
    figure = make_subplots(
        rows=n_rows,
        cols=n_columns,
        specs=[[{"secondary_y": True}] * n_columns] * n_rows,
        subplot_titles=[panel.title for row in grid for panel in row],
        vertical_spacing=0.1,
        horizontal_spacing=0.1,
    )
    for i, row in enumerate(grid):
        for j, panel in enumerate(row):
            place = {"row": i + 1, "col": j + 1}
            for trace, on_right in _traces(panel, names):
                trace.update(showlegend=i == j == 0, legendgroup=trace.name)
                figure.add_trace(trace, **place, secondary_y=on_right)
            left, right = {**place, "secondary_y": False}, {**place, "secondary_y": True}
            figure.update_yaxes(title_text=_ERROR_AXIS, type="log", range=decades, **left)
            figure.update_yaxes(title_text=_TRUTH_AXIS, showgrid=False, **right)
    figure.update_xaxes(tickangle=-90, tickfont={"size": 10})
    figure.update_layout(
        title=_title(found), height=360 * n_rows, template="plotly_white", legend_orientation="h"
    )
    page: str = figure.to_html(include_plotlyjs=True, include_mathjax=False, div_id="fig4")
    return page.encode()


def figure_as_png(found: PaperMeans) -> bytes:
    """Return the figure as a PNG picture."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure
    from matplotlib.layout_engine import ConstrainedLayoutEngine

    grid, names = _panels(found), list(map(_label, found.names))
    n_rows, n_columns = len(grid), len(grid[0])
    figure = Figure(
        figsize=(7.0 * n_columns, 2.9 * n_rows + 0.6), layout=ConstrainedLayoutEngine(h_pad=0.12)
    )
    FigureCanvasAgg(figure)
    axes = figure.subplots(n_rows, n_columns, squeeze=False)
    for axis, panel in zip(axes.flat, (panel for row in grid for panel in row), strict=True):
        handles = _draw(axis, panel, names)
        axis.set_ylim(_limits(grid))
    figure.suptitle(_title(found), fontsize=11)
    figure.legend(handles=handles, loc="outside lower center", ncols=len(handles), fontsize=9)
    content = io.BytesIO()
    figure.savefig(content, format="png", dpi=110, metadata={"Software": None})
    return content.getvalue()


def _traces(panel: _Panel, names: list[str]) -> list[tuple[Any, bool]]:
    """Return what Plotly draws in a panel, and whether it belongs to the axis on the right."""
    import plotly.graph_objects as go

    tick = {"symbol": "line-ew", "size": 9, "line": {"width": 2, "color": _LIMIT}}
    return [
        (go.Bar(x=names, y=panel.errors, name=_BARS, marker_color=_BAR), False),
        (go.Scatter(x=names, y=panel.limit, name=_MARKS, mode="markers", marker=tick), False),
        (go.Scatter(x=names, y=panel.truth, name=_TRUE, line={"color": _LINE, "width": 1}), True),
    ]


def _draw(axis: Axes, panel: _Panel, names: list[str]) -> list[Any]:
    """Draw a panel with Matplotlib and return what its legend explains."""
    place = range(len(names))
    bars = axis.bar(place, panel.errors, color=_BAR, label=_BARS)
    marks = axis.scatter(place, panel.limit, marker="_", s=70, lw=2.0, color=_LIMIT, label=_MARKS)
    marks.set_zorder(3)
    right = axis.twinx()
    line = right.plot(place, panel.truth, color=_LINE, lw=0.8, marker=".", ms=3, label=_TRUE)
    axis.set_title(panel.title, fontsize=10)
    axis.set_xticks(place, names, rotation=90, fontsize=7)
    axis.set_xlim(-0.7, len(names) - 0.3)
    axis.set_yscale("log")
    axis.yaxis.set_major_formatter("{x:g}")
    axis.set_ylabel(_ERROR_AXIS, fontsize=8)
    right.set_ylabel(_TRUTH_AXIS, fontsize=8)
    for side in (axis, right):
        side.tick_params(axis="y", labelsize=8)
    return [bars, marks, *line]


def _panels(found: PaperMeans) -> list[list[_Panel]]:
    """Return the panels: a row for each estimator, a column for each machine."""
    compared = {means.estimator for means in found.means}
    return [
        [_panel(found, name, estimator) for name in found.truths]
        for estimator in _DRAWN
        if estimator in compared
    ]


def _limits(grid: list[list[_Panel]]) -> tuple[float, float]:
    """Return the ends of the scale of errors that all panels share [mm]."""
    values = np.concatenate(
        [[1e-2, 1.0], *(x for row in grid for p in row for x in (p.errors, p.limit))]
    )
    shown = values[values > 0.0]
    return 0.7 * float(shown.min()), 1.4 * float(shown.max())


def _panel(found: PaperMeans, machine: str, estimator: str) -> _Panel:
    """Return one panel."""
    by_name = {means.estimator: means for means in found.of(machine)}
    means, limit = by_name[estimator], by_name[BOUND]
    return _Panel(
        f"{LABELS[estimator]}, {JOINTS[machine]} joints{_failed(means)}",
        1e3 * means.parameters,
        1e3 * limit.parameters,
        1e3 * found.truths[machine],
    )


def _failed(means: Means) -> str:
    """Return how many runs are not in the means, if any."""
    failed = sum(means.failures.values())
    return f" ({failed} of {means.n + failed} runs failed)" if failed else ""


def _title(found: PaperMeans) -> str:
    """Return the title of the figure."""
    n_runs = found.means[0].n + sum(found.means[0].failures.values())
    return f"Fig. 4 of the paper: {len(found.names)} parameters, means over {n_runs} calibrations"


def _label(name: str) -> str:
    """Return a short label of a parameter: A2x for leg2.base.x."""
    leg, kind, *axis = name.split(".")
    return f"{_LETTERS[kind]}{leg.removeprefix('leg')}{''.join(axis)}"


if TYPE_CHECKING:
    from rich.console import RenderableType


@dataclass(frozen=True, eq=False)
class PaperSummary:
    """The paper's evaluation, before and after, for every estimator."""

    found: PaperMeans  # the means over all runs
    in_radians: bool  # whether Table 1 was read in radians

    @property
    def readings(self) -> tuple[str, ...]:
        """How the paper's text was read where it leaves a choice."""
        return (IN_RADIANS if self.in_radians else IN_DEGREES, *READINGS)

    def document(self) -> dict[str, Any]:
        """Return the document of ``--json``."""
        found = self.found
        return {
            "rows": [means.document() for means in found.means if means.estimator != INITIAL],
            "initial": [means.document() for means in found.means if means.estimator == INITIAL],
            "names": list(found.names),
            "true_values_mm": {name: (1e3 * xi).tolist() for name, xi in found.truths.items()},
            "as_printed": {
                "initial": PRINTED_BEFORE.document(),
                "calibrated": PRINTED_AFTER.document(),
                "note": CONTEXT,
            },
            "readings": list(self.readings),
        }

    def table(self) -> RenderableType:
        """Return the table for people."""
        return paper_table(self.found, self.readings)

    def files(self) -> dict[str, bytes]:
        """Return figure 4, to look at in a browser and as a picture."""
        return {"fig4.html": figure_as_html(self.found), "fig4.png": figure_as_png(self.found)}


MACHINES = {"coplanar": coplanar_hexapod, "noncoplanar": noncoplanar_hexapod}


@dataclass(frozen=True)
class PaperStudy:
    """The simulation of section 4.3, for coplanar and for non-coplanar joints."""

    # noise of the axes; ``TableNoise.in_radians()`` reads Table 1 to the letter
    noise: TableNoise = field(default_factory=TableNoise)
    initial_error: float = 0.002  # half width of the uniform errors of the initial parameters [m]
    reading_error: float = 3e-6  # half width of the uniform errors of the readings [m]
    # n_poses, n_images: extreme poses of each camera position, and images of each pose
    n_poses: int = 15
    n_images: int = 3
    n_checked: int = 10  # random poses of eq (20)
    estimators: tuple[str, ...] = tuple(ESTIMATORS)  # which are compared, of ``ESTIMATORS``

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

    def is_record(self, found: Any) -> bool:
        """Return whether a document has the errors of every estimator on either machine."""
        wanted = {INITIAL, *self.estimators, BOUND}
        return has_keys(found, set(MACHINES)) and all(
            has_keys(of_machine, wanted) and all(map(is_errors, of_machine.values()))
            for of_machine in found.values()
        )

    def summary(self, records: Iterable[Record]) -> PaperSummary:
        """Return the means over all runs."""
        machines = {name: truth() for name, truth in MACHINES.items()}
        return PaperSummary(
            means_of(records, machines), in_radians=self.noise == TableNoise.in_radians()
        )

    def _calibrations(self, machine: Machine, rng: np.random.Generator) -> Record:
        """Return the errors of all estimators for one session of a machine."""
        nominal = perturb(machine, rng, self.initial_error)
        session = simulate_session(
            machine,
            cameras_around(machine, rng),
            rng,
            noise=self.noise,
            sigma_q=self.reading_error / np.sqrt(3.0),
            uniform_readings=True,
            n_poses=self.n_poses,
            n_images=self.n_images,
        )
        checked = random_poses(machine, self.n_checked, rng)
        covariance = self._bound_covariance(session)
        found = {INITIAL: _errors(machine, nominal.parameters, covariance, checked)}
        for name in self.estimators:
            try:
                parameters = ESTIMATORS[name](session, nominal)
            except LegcalError as error:
                found[name] = {"failure": failure_of(error)}
            else:
                found[name] = _errors(machine, parameters, covariance, checked)
        found[BOUND] = _expected(machine, covariance, checked)
        return found

    def _bound_covariance(self, session: SimulatedSession) -> Array:
        """Return the covariance of the Cramer-Rao bound of a session [m^2]."""
        _, exact = observe_session(
            session.machine,
            session.cameras,
            session.T_Rb_Re,
            session.measurements,
            self.noise,
            None,
        )
        return bound_covariance(session, exact)


def _errors(
    machine: Machine, parameters: KinematicParameters, covariance: Array, checked: RigidTransform
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


def _expected(machine: Machine, covariance: Array, checked: RigidTransform) -> Record:
    """Return the errors to expect at the Cramer-Rao bound."""
    sigma = np.sqrt(np.diagonal(covariance))
    return errors_record(
        expected_errors(machine, covariance, checked), 1.0, np.sqrt(2.0 / np.pi) * sigma
    )
