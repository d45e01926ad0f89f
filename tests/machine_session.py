"""A simulated session of any shipped machine in memory: exact, noisy, and started from far away."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cache

import numpy as np
from outline_sessions import (
    closed_poses,
    moved_poses,
)
from scipy.spatial.transform import RigidTransform, Rotation

from legcal.calibration.joint_fit.variables import FittedLegs, Start, fitted_legs, start_from
from legcal.data.measurements import Measurements, View
from legcal.data.outlines import Outlines
from legcal.geometry import components, motions_of
from legcal.geometry.types import Array
from legcal.machine import (
    Leg,
    LegKind,
    Machine,
    geometries,
    load_mechanism,
    moved_legs,
    platform_in_base,
)
from legcal.simulation import OutlineNoise, Viewpoint, noisy_outlines, outlines_of, plain_scene
from legcal.simulation.observe import moved_outlines
from legcal.vision.camera import Camera

K = np.array([[1290.0, 0.0, 518.0], [0.0, 1280.0, 380.0], [0.0, 0.0, 1.0]])
PINHOLE = Camera(K, 1024, 768)
LENS = Camera(K, 1024, 768, np.array([-0.12, 0.05, 1e-3, -5e-4, 0.0]))
SHIPPED = (
    "hexapod",
    "hexapod-rod",
    "hexapod-strut",
    "nategh-agheli",
    "6-sps",
    "3-rpr",
    "3-rps",
    "3-spr",
    "3-upu",
    "3-upu-tilted",
    "tricept",
)
SIGMA_Q = 2e-6  # [m]
_TURN, _SHIFT = 0.12, 0.06  # of poses: [rad], of the length of a leg


@dataclass(frozen=True, eq=False)
class MachineSession:
    """What a true machine shows, and where a fit of it begins.

    Attributes
    ----------
    legs : FittedLegs
        The nominal legs, wrong, with the true radii.
    measurements : Measurements
        Exact readings; every image is a pose of its own.
    outlines : Outlines
        Exact outlines of all legs, with the covariance that noise would have.
    truth : Start
        The true legs, cameras and poses.
    start : Start
        The wrong legs, cameras that are wrong as well, poses that follow from these legs.
    """

    legs: FittedLegs
    measurements: Measurements
    outlines: Outlines
    truth: Start
    start: Start

    def noisy(self, seed: int) -> tuple[Measurements, Outlines]:
        """Return readings and outlines with the errors that they claim."""
        rng, m = np.random.default_rng(seed), self.measurements
        q = m.q + m.sigma_q * rng.standard_normal(m.q.shape)
        return replace(m, q=q), noisy_outlines(self.outlines, m.views[0].camera, rng)


def shifted(session: MachineSession, outlines: Outlines, offsets: Array) -> Outlines:
    """Return outlines moved across themselves by (n, 2) pixels at their ends."""
    return moved_outlines(outlines, session.measurements.views[0].camera, offsets)


@cache
def machine_session(
    name: str,
    *,
    length: float = 0.003,
    angle: float = float(np.deg2rad(1.0)),
    camera_shift: float = 0.003,
    camera_turn: float = float(np.deg2rad(1.0)),
    n_views: int = 3,
    n_poses: int = 6,
    camera: Camera = LENS,
    seed: int = 0,
) -> MachineSession:
    """Return a session of a shipped model, which is the truth.

    Parameters
    ----------
    name : str
        The model.
    length, angle : float
        How wrong every coordinate, offset and constant length [m] and every axis [rad] of the
        nominal legs is.
    camera_shift, camera_turn : float
        How far each camera is from where it is said to be [m], [rad].
    n_views, n_poses : int
        Number of cameras, and of poses that each of them sees alone.
    camera : Camera
        Intrinsics of all cameras.
    seed : int
        Of poses and errors.
    """
    rng = np.random.default_rng(seed)
    machine = load_mechanism(name)
    legs, fitted = geometries(machine), fitted_legs(machine)
    R, t = _poses(machine, legs, n_views * n_poses, rng)
    view = np.repeat(np.arange(n_views), n_poses)
    T_camera_Rb = _cameras(machine, legs, n_views, camera)
    measurements = Measurements(
        tuple(View(f"c{v + 1}", camera) for v in range(n_views)),
        tuple(f"c{v + 1}_{i:03d}.png" for i, v in enumerate(view)),
        view,
        np.arange(len(view)),
        _readings(machine, legs, R, t),
        SIGMA_Q,
    )
    truth = Start(legs, T_camera_Rb, motions_of(R, t), "truth")
    away = _wrong(fitted, legs, length, angle, rng)
    home = (platform_in_base(machine, machine.home),) * len(t)
    rough = tuple(_shaken(T, camera_shift, camera_turn, rng) for T in T_camera_Rb)
    wrong = replace(fitted, nominal=away)
    return MachineSession(
        wrong,
        measurements,
        shown_outlines(fitted.radii, measurements, truth),
        truth,
        start_from(away, measurements, wrong, rough, home, "nominal"),
    )


def _poses(
    machine: Machine, legs: tuple[Leg, ...], n: int, rng: np.random.Generator
) -> tuple[Array, Array]:
    """Return poses around home at which the legs close."""
    R, t = components((platform_in_base(machine, machine.home),) * n)
    size = np.mean([np.linalg.norm(R[0] @ leg.B + t[0] - leg.A) for leg in legs])
    step = rng.uniform(-1.0, 1.0, (n, 6)) * np.repeat([_TURN, _SHIFT * size], 3)
    return closed_poses(legs, machine.frame_legs, *moved_poses(R, t, step))


def _readings(machine: Machine, legs: tuple[Leg, ...], R: Array, t: Array) -> Array:
    q = np.full((len(t), len(legs)), np.nan)
    for j, leg in enumerate(legs):
        if leg.kind is LegKind.ACTUATED:
            length = np.linalg.norm(R @ leg.B + t - leg.A, axis=1)
            q[:, j] = machine.sign[j] * (length - leg.q0)
    return q


def _cameras(
    machine: Machine, legs: tuple[Leg, ...], n_views: int, camera: Camera
) -> tuple[RigidTransform, ...]:
    """Return T_camera_Rb of cameras around the middle of the machine."""
    home = platform_in_base(machine, machine.home)
    joints = np.array([leg.A for leg in legs] + [home.apply(leg.B) for leg in legs])
    middle = joints.mean(axis=0)
    size = np.linalg.norm(joints - middle, axis=1).max()
    found = []
    for v in range(n_views):
        turn = 0.4 + 2.1 * v
        outward = np.array([np.cos(turn), np.sin(turn), 0.35 + 0.1 * v])
        centre = middle + 4.0 * size * outward / np.linalg.norm(outward)
        z = (middle - centre) / np.linalg.norm(middle - centre)
        x = np.cross(z, [0.0, 0.0, 1.0])
        x /= np.linalg.norm(x)
        rotation = Rotation.from_matrix(np.column_stack([x, np.cross(z, x), z]))
        found.append(RigidTransform.from_components(centre, rotation).inv())
    return tuple(found)


def shown_outlines(
    radii: Mapping[tuple[int, str], float], m: Measurements, truth: Start
) -> Outlines:
    """Return both outlines of every part of every leg in every image."""
    R, t = components(truth.T_Rb_Re)
    A, B = (np.array([getattr(leg, joint) for leg in truth.legs]) for joint in "AB")
    ends = np.einsum("kij,lj->kli", R, B) + t[:, None]
    views = [
        Viewpoint(view.name, view.camera, T.inv())
        for view, T in zip(m.views, truth.T_camera_Rb, strict=True)
    ]
    scene = plain_scene(np.broadcast_to(A, ends.shape), ends, views, m.view, m.pose, radii)
    return outlines_of(scene, OutlineNoise(0.2, 150))


def _wrong(
    fitted: FittedLegs,
    legs: tuple[Leg, ...],
    length: float,
    angle: float,
    rng: np.random.Generator,
) -> tuple[Leg, ...]:
    """Return legs every number of which is wrong by as much, up or down; twists are right."""
    parametrization = fitted.parametrization
    size = np.where(np.array(parametrization.units) == "m", length, angle / np.sqrt(2.0))
    size[[name.endswith(".twist") for name in parametrization.names]] = 0.0
    step = size * rng.choice([-1.0, 1.0], len(size))
    return moved_legs(legs, parametrization.place, step)


def _shaken(
    T: RigidTransform, distance: float, angle: float, rng: np.random.Generator
) -> RigidTransform:
    """Return a camera that is wrong by a distance and an angle in any direction."""
    turn, shift = rng.standard_normal((2, 3))
    rotation = Rotation.from_rotvec(angle * turn / np.linalg.norm(turn))
    return RigidTransform.from_components(
        T.translation + distance * shift / np.linalg.norm(shift), rotation * T.rotation
    )
