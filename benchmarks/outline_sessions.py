"""Sessions of outlines in memory: true machines before their cameras, measurements, estimates.

The covariance of outlines is known, the nominal model is wrong by a known amount, and so are the
rough camera poses.
"""

from __future__ import annotations

import tempfile
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import RigidTransform, Rotation

from legcal.calibration.joint_fit.fit import refine
from legcal.calibration.joint_fit.solution import Solution
from legcal.calibration.joint_fit.variables import (
    DEFAULT_SETTINGS,
    FittedLegs,
    RefinementSettings,
    Start,
    platform_poses,
    start_from,
)
from legcal.data.measurements import Measurements, View
from legcal.data.outlines import Outlines, axes_from_outlines
from legcal.descriptions.new_model import create_model
from legcal.descriptions.table import described_machine
from legcal.errors import DidNotConverge
from legcal.files.schema import read_yaml
from legcal.geometry.types import Array, IntArray
from legcal.machine.actuator import ActuatorColumns
from legcal.machine.closing import solve_poses
from legcal.machine.kinematics import platform_in_base, pose_differences
from legcal.machine.leg import Leg, LegKind, radius_name
from legcal.machine.loader import load_mechanism
from legcal.machine.model import Machine
from legcal.machine.parameters import Parametrization, geometries, moved_legs, parametrize
from legcal.machine.rods import (
    actuator_index,
    reading_legs,
    readings_of_rods,
)
from legcal.machine.ties import on_ties
from legcal.paper.criteria import Criteria
from legcal.paper.four_steps import run_steps
from legcal.paper.unknowns import NominalMachine
from legcal.simulation.cameras import cameras_around, mild_lens
from legcal.simulation.observe import OutlineNoise, Scene, noisy_outlines, outlines_of, take_images
from legcal.simulation.paper import noncoplanar_hexapod
from legcal.simulation.session import draw_poses
from legcal.simulation.solids import dressed, pose_machine
from legcal.vision.camera import Camera

COPLANAR, NONCOPLANAR = "6-spu-coplanar", "6-spu-noncoplanar"
MACHINES = (NONCOPLANAR, COPLANAR, "3-upu-tilted", "3-rpr")
# Whose joints at A move on carriages and arms
CARRIED = ("hexaglide", "3-prs", "linear-delta", "orthoglide", "delta", "servo-hexapod")
SHIPPED = (
    "hexapod",
    "nategh-agheli",
    "6-sps",
    "hexapod-rod",
    "hexapod-strut",
    "3-rps",
    "3-spr",
    "3-upu",
    "3-upu-tilted",
    "tricept",
    "3-rpr",
    *CARRIED,
)
# Shipped machines with arms that are cylinders, of this radius [mm], and are seen
ROUND_ARMS = {"delta-round-arms": ("delta", 8.0), "servo-round-arms": ("servo-hexapod", 3.0)}
KINDS = Path(__file__).with_name("machine_kinds.yaml")
TABLES = Path(__file__).parents[1] / "models" / "tables"
_MANY_LEGS, _MOST_LEGS = 6, 4  # of six or more that a view is said to see, as in the paper
_SEED = 2002  # of what is the same in all runs
_CLOSED = 1e-13  # [m]


# True machines before their cameras


def true_machine(name: str) -> Machine:
    """Return a true machine of the studies: one that is made for them, or a shipped model."""
    if name in kinds() or name in ROUND_ARMS:
        with tempfile.TemporaryDirectory(prefix="legcal-study-") as folder:
            return made(name, Path(folder))
    if name == NONCOPLANAR:
        return noncoplanar_hexapod()
    return load_mechanism("hexapod" if name == COPLANAR else name)


@lru_cache(maxsize=1)
def kinds() -> dict[str, dict[str, Any]]:
    """Return the tables of machines that are not shipped, by name."""
    return dict(read_yaml(KINDS, "table"))


def made(kind: str, folder: Path) -> Machine:
    """Write a machine that is not shipped as a model and load it."""
    folder.mkdir(parents=True, exist_ok=True)
    if kind in ROUND_ARMS:
        name, radius = ROUND_ARMS[kind]
        table = dict(read_yaml(TABLES / f"{name}.yaml", "table"), name=kind)
        for motor in table["actuators"].values():
            motor["arm_radius"] = radius
    else:
        table = {"legcal_table": 1, "name": kind, "unit": "mm", **kinds()[kind]}
    described = described_machine(table, Path(kind))
    return create_model(described, folder, force=True).machine


@dataclass(frozen=True, eq=False)
class Design:
    """A true machine, its poses, its cameras and its outlines without noise."""

    legs: FittedLegs  # the true ones
    home: RigidTransform  # T_Rb_Re of the pose that the model calls home
    R: Array  # (n_poses, 3, 3) true orientations of R_e in R_b
    t: Array  # (n_poses, 3) [m]
    q: Array  # (n_poses, n_legs) exact readings [m]; zero for constant legs, NaN for passive ones
    camera: Camera  # of all views
    T_Rb_camera: tuple[RigidTransform, ...]
    seen: tuple[tuple[str, ...] | None, ...]  # legs that each view is said to see; None for all
    view: IntArray  # (n_rows,)
    pose: IntArray  # (n_rows,)
    outlines: Outlines  # with the covariance of the noise

    @property
    def q_of_actuators(self) -> Array:
        """Exact readings of actuators, (n_poses, n_actuators) [m or rad]."""
        on = actuator_index(self.legs.nominal)
        return self.q[:, [on.index(a) for a in range(max(on) + 1)]]

    @property
    def parametrization(self) -> Parametrization:
        """The kinematic parameters; twists are known."""
        return parametrize(self.legs.names, self.legs.nominal, self.legs.frame_legs)

    @property
    def arms(self) -> Parametrization:
        """The lines of the arms that are observed."""
        every = self.legs.parametrization
        seen = {j for j, part in self.parts if self.legs.nominal[j].is_arm(part)}
        place = np.full_like(every.place, -1)
        own = every.place[sorted(seen), ActuatorColumns.ARM]
        place[sorted(seen), ActuatorColumns.ARM] = np.arange(own.size).reshape(own.shape)
        names, units = (tuple(of[i] for i in own.ravel()) for of in (every.names, every.units))
        return Parametrization(names, units, place)

    @property
    def parts(self) -> tuple[tuple[int, str], ...]:
        """Leg and part of each radius that is observed, by leg and name."""
        shown = zip(self.outlines.leg.tolist(), self.outlines.part, strict=True)
        return tuple(sorted(set(shown)))

    @property
    def names(self) -> tuple[str, ...]:
        """Names of what is to be found: kinematic parameters, then radii and arms observed."""
        radii = (radius_name(self.legs.names[leg], part) for leg, part in self.parts)
        return (*self.parametrization.names, *radii, *self.arms.names)

    @property
    def poses(self) -> tuple[RigidTransform, ...]:
        """The true poses T_Rb_Re."""
        together = RigidTransform.from_components(self.t, Rotation.from_matrix(self.R))
        return tuple(together[k] for k in range(len(self.t)))


@lru_cache(maxsize=32)  # a study goes through all of its machines in every run
def design_of(name: str, n_views: int, n_poses: int, sigma_px: float) -> Design:
    """Return the design of a machine, the same one in all processes; no two views share a pose."""
    machine = true_machine(name)
    rng = np.random.default_rng(_SEED)
    lens = mild_lens()
    drawn = draw_poses(machine, n_views * n_poses, rng)
    machines = pose_machine(machine, dressed(machine), drawn)
    cameras = {f"c{v + 1}": lens for v in range(n_views)}
    views, _ = cameras_around(machine, machines, cameras, rng)
    poses_of = [range(v * n_poses, (v + 1) * n_poses) for v in range(n_views)]
    images = take_images(machine.legs, machines, views, poses_of, 1)
    legs = geometries(machine)
    at = RigidTransform.concatenate([platform_in_base(machine, T) for T in drawn.poses])
    rotation: Rotation = at.rotation
    R, t = closed_poses(legs, machine.frame_legs, rotation.as_matrix(), at.translation)
    in_base = [np.array([getattr(m, side) for m in machines]) for side in "AB"]
    scene = Scene(in_base[0], in_base[1], views, images)
    outlines = outlines_of(scene, OutlineNoise(sigma_px, None))
    most = _MOST_LEGS if machine.n_legs >= _MANY_LEGS else machine.n_legs
    seen = []
    for v in range(n_views):
        rows = np.flatnonzero(images.view == v)
        length = np.zeros(len(legs))
        for image in (images.shown[r] for r in rows):
            np.add.at(length, image.leg, np.where(image.is_arm, 0.0, image.length_px))
        longest = np.argsort(-length, kind="stable")
        seen.append(sorted(longest[:most].tolist()))
    shown = zip(outlines.row.tolist(), outlines.leg.tolist(), strict=True)
    told = np.flatnonzero([j in seen[images.view[r]] for r, j in shown])
    q = exact_readings(legs, R, t)
    q[:, [leg.kind is LegKind.CONSTANT and leg.actuator is None for leg in legs]] = 0.0
    radii = {
        (j, part): radius
        for j, leg in enumerate(machine.legs)
        for part, radius in leg.radius_of_part.items()
    }
    return Design(
        legs=FittedLegs(
            machine.leg_names,
            legs,
            machine.frame_legs,
            radii,
            platform_in_base(machine, machine.home),
            machine.is_redundant,
        ),
        home=platform_in_base(machine, machine.home),
        R=R,
        t=t,
        q=q,
        camera=lens,
        T_Rb_camera=tuple(machine.T_base_Rb.inv() * view.T_base_camera for view in views),
        seen=tuple(
            None if len(s) == machine.n_legs else tuple(machine.leg_names[j] for j in s)
            for s in seen
        ),
        view=images.view,
        pose=images.pose,
        outlines=outlines.choose(told),
    )


def exact_readings(legs: Sequence[Leg], R: Array, t: Array) -> Array:
    """Return readings at poses, (n_poses, n_legs) [m or rad]; NaN without an encoder."""
    q, on = np.full((len(t), len(legs)), np.nan), actuator_index(legs)
    of_actuators = readings_of_rods(legs, R, t)
    for j, leg in enumerate(legs):
        if leg.actuator is not None:
            q[:, j] = of_actuators[:, on[j]]
        elif leg.kind is LegKind.ACTUATED:
            q[:, j] = leg.sign * (np.linalg.norm(R @ leg.B + t - leg.A, axis=1) - leg.q0)
    return q


def closed_poses(
    legs: Sequence[Leg], frame_legs: Sequence[int], R: Array, t: Array
) -> tuple[Array, Array]:
    """Return the nearest poses at which everything holds that legs demand without a reading.

    A metre is as far as one radian.
    """
    if len(frame_legs) < 3:  # turned and lifted into the plane of motion
        angle = np.arctan2(R[:, 1, 0], R[:, 0, 0])
        R = Rotation.from_euler("z", angle[:, None]).as_matrix()
        t = np.column_stack([t[:, :2], np.full(len(t), np.mean([x.A[2] - x.B[2] for x in legs]))])
    found = solve_poses(legs, frame_legs, R, t, scale=np.ones(6))
    if found.missed.max(initial=0.0) < _CLOSED:
        return found.R, found.t
    raise DidNotConverge(
        f"Simulated poses could not be closed: found legs {1e3 * found.missed.max():.2g} mm off "
        "what they demand, needed poses that they allow; check the model's home."
    )


def moved_poses(R: Array, t: Array, step: Array) -> tuple[Array, Array]:
    """Return poses after a rotation [rad] and a displacement [m] in R_b, (k, 6)."""
    turn = Rotation.from_rotvec(step[..., :3]).as_matrix()
    return np.asarray(turn @ R), np.asarray(t + step[..., 3:])


# Sessions


@dataclass(frozen=True)
class StartErrors:
    """How wrong the nominal model and the rough camera poses are."""

    length: float  # of every coordinate of the joints, every offset and constant length [m]
    angle: float  # of every axis [rad]
    camera_shift: float  # of every camera, in any direction [m]
    camera_turn: float  # about any axis [rad]
    full: bool  # all errors have this size, up or down; else it is the most of uniform ones


@dataclass(frozen=True)
class Noise:
    """What is measured how well."""

    sigma_px: float = 0.1  # of an edge point; every pixel along an outline has one
    sigma_q: float = 2e-6  # of a reading [m]
    radius_sigma: float = 0.02  # of the nominal radii, as a part of the true ones

    def of_readings(self, legs: Sequence[Leg]) -> Array:
        """Return the standard deviation of the reading of each leg, (n_legs,) [m or rad].

        A motor that turns has that with which the joint at A moves by ``sigma_q``.
        """
        return np.array([0.0 if not leg.is_motor else leg.reading_of(self.sigma_q) for leg in legs])


@dataclass(frozen=True, eq=False)
class OutlineSession:
    """What was measured, and what was known before."""

    legs: FittedLegs  # the nominal ones
    measurements: Measurements  # with rough camera poses; the base link's frame is R_b
    outlines: Outlines
    home: RigidTransform  # T_Rb_Re near which the nominal legs meet


def draw_session(
    design: Design, noise: Noise, errors: StartErrors, rng: np.random.Generator
) -> OutlineSession:
    """Return a measurement of a design, and what is known of it before."""
    step = _parameter_errors(design.parametrization, errors, rng)
    true = design.legs
    sigma = noise.of_readings(true.nominal)
    errors_of_q = sigma * rng.normal(size=design.q.shape)
    q = design.q + errors_of_q[:, list(reading_legs(true.nominal))]
    views = tuple(
        View(f"c{v + 1}", design.camera, _rough(T, errors, rng), seen)
        for v, (T, seen) in enumerate(zip(design.T_Rb_camera, design.seen, strict=True))
    )
    image = ("",) * len(design.view)
    measurements = Measurements(
        views,
        image,
        design.view,
        design.pose,
        q[design.pose],
        np.where(sigma > 0.0, sigma, noise.sigma_q),
    )
    outlines = noisy_outlines(design.outlines, design.camera, rng)
    nominal = moved_legs(true.nominal, design.parametrization.place, step)
    arms = design.arms
    if len(arms):
        nominal = moved_legs(
            nominal, arms.place, arm_sigmas(arms, nominal) * rng.normal(size=len(arms))
        )
    radii = {
        part: radius * float(1.0 + noise.radius_sigma * rng.normal())
        for part, radius in true.radii.items()
    }
    home = design.home
    if true.ties:  # models of such a machine have its mobility
        found, length = true.parametrization, float(np.linalg.norm(home.translation))
        scale = np.where([unit == "m" for unit in found.units], length, 1.0)
        nominal = on_ties(nominal, true.nominal, true.ties, found.place, scale)
        at = solve_poses(
            nominal, true.frame_legs, home.as_matrix()[None, :3, :3], home.translation[None]
        )
        home = RigidTransform.from_components(at.t[0], Rotation.from_matrix(at.R[0]))
    legs = replace(true, nominal=nominal, radii=radii, home=home)
    return OutlineSession(legs, measurements, outlines, home)


def arm_sigmas(arms: Parametrization, legs: Sequence[Leg]) -> Array:
    """Return how well lines of arms are known before [rad, m]: as the joint fit takes them."""
    length = float(np.mean([leg.q0 for leg in legs]))
    point = DEFAULT_SETTINGS.arm_point_sigma * length
    known = {"rad": DEFAULT_SETTINGS.arm_axis_sigma, "m": point}
    return np.array([known[unit] for unit in arms.units])


def _parameter_errors(
    parametrization: Parametrization, errors: StartErrors, rng: np.random.Generator
) -> Array:
    """Return by how much the nominal parameters are wrong [m, rad]."""
    unit = rng.uniform(-1.0, 1.0, len(parametrization))
    if errors.full:
        unit = np.sign(unit)
        for place in parametrization.place:
            for axis in (place[7:9], place[9:11]):
                if axis[0] >= 0:
                    unit[axis] = _direction(rng, 2)
    is_angle = np.array([u == "rad" for u in parametrization.units], dtype=np.bool_)
    return np.asarray(np.where(is_angle, errors.angle, errors.length) * unit)


def _rough(T: RigidTransform, errors: StartErrors, rng: np.random.Generator) -> RigidTransform:
    """Return the pose of a camera as somebody noted it."""
    shift, turn = (1.0, 1.0) if errors.full else rng.random(2)
    return shaken(T, shift * errors.camera_shift, turn * errors.camera_turn, rng)


def shaken(
    T: RigidTransform, distance: float, angle: float, rng: np.random.Generator
) -> RigidTransform:
    """Return a pose that is wrong by a distance [m] and an angle [rad], in any direction."""
    turned = Rotation.from_rotvec(angle * _direction(rng, 3))
    moved = distance * _direction(rng, 3)
    return RigidTransform.from_components(T.translation + moved, turned * T.rotation)


def _direction(rng: np.random.Generator, n: int) -> Array:
    """Return a unit vector (n,) that points anywhere."""
    v = rng.normal(size=n)
    return np.asarray(v / np.linalg.norm(v))


# Estimators


def nominal_start(legs: FittedLegs, m: Measurements, T_base_Rb: RigidTransform) -> Start:
    """Return nominal legs, moved from home to the readings, and the rough cameras."""
    assert legs.home is not None
    R, t = legs.home.rotation.as_matrix(), legs.home.translation
    B = legs.home.apply([leg.B for leg in legs.nominal])
    first = np.linalg.norm(B - [leg.A for leg in legs.nominal], axis=1)
    first -= np.array([leg.q0 for leg in legs.nominal])
    for j, a in enumerate(actuator_index(legs.nominal)):
        if a >= 0:
            first[j] = readings_of_rods(legs.nominal, R[None], t[None])[0, a]
    wanted = legs.sign * m.q_of_poses
    poses: Sequence[RigidTransform] = (legs.home,) * m.n_poses
    for part in (0.25, 0.5, 0.75):
        readings = first + part * (wanted - first)
        poses = platform_poses(legs.nominal, readings, poses, legs.frame_legs)
    hints = [view.T_base_camera for view in m.views]
    cameras = [T.inv() * T_base_Rb for T in hints if T is not None]
    return start_from(legs.nominal, m, legs, cameras, poses, "nominal")


def one_fit(session: OutlineSession, radius_sigma: float) -> Solution:
    """Return what the joint fit finds from the nominal model and rough cameras."""
    settings = RefinementSettings(radius_sigma=radius_sigma)
    start = nominal_start(session.legs, session.measurements, RigidTransform.identity())
    return refine(session.legs, session.measurements, session.outlines, start, settings)


def staged_legs(session: OutlineSession, criteria: Criteria) -> tuple[Leg, ...]:
    """Return the legs that the four steps find from the axes which the outlines give."""
    legs = session.legs
    radii = {part: radius for (_, part), radius in legs.radii.items()}
    axes = axes_from_outlines(session.outlines, session.measurements, radii)
    machine = NominalMachine(legs.names, legs.nominal, legs.frame_legs)
    return run_steps(machine, axes, session.measurements, criteria=criteria).legs


def platform_errors(design: Design, legs: Sequence[Leg]) -> tuple[Array, Array]:
    """Return displacement [m] and angle [rad] of R_e that legs cause at exact readings, (n_poses,).

    Where legs cannot have these readings, the platform stands where it misses them least.
    """
    poses = design.poses
    there = platform_poses(legs, design.legs.sign * design.q, poses, design.legs.frame_legs)
    return pose_differences(there, poses)
