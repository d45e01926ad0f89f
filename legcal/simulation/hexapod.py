"""The 6-SPU of section 4.3 in numbers alone: its parameters, poses, cameras, and a session of it.

It needs no model file, and finds hundreds of poses at once.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import RigidTransform, Rotation

from legcal.data.axes import LegAxes, axes_from_outlines, axes_of_table
from legcal.data.measurements import Measurements, View
from legcal.data.outlines import Outlines
from legcal.errors import DidNotConverge
from legcal.geometry.motions import frame_on_points, look_at
from legcal.geometry.types import Array, BoolArray
from legcal.machine.equations import pose_equations
from legcal.machine.feasibility import near_ends
from legcal.machine.leg import KinematicParameters, point_like_legs
from legcal.machine.parameters import from_vector, to_vector
from legcal.machine.solved_poses import solve_poses
from legcal.simulation.cameras import rough_pose
from legcal.simulation.observe import (
    OutlineNoise,
    Scene,
    TableNoise,
    axes_in_images,
    outlines_of,
    plain_scene,
)
from legcal.simulation.visibility import Viewpoint
from legcal.vision.camera import Camera, sample_camera

PAPER_VIEWS = ((0, 1, 2, 3), (2, 3, 4, 5), (0, 1, 4, 5))  # four legs seen at a time
_DISTANCE = 0.9  # [m] of cameras from the middle of the machine, about
RAISED = 0.030  # [m] out of the plane of the others

_MAX_ERROR = 1e-12  # of the lengths
_MIN_SINGULAR = 0.1  # value of the scaled Jacobian that a pose may have
_N_STEPS = 6  # from home
_MAX_ROUNDS = 1000  # of draws of poses


@dataclass(frozen=True, eq=False)
class PaperHexapod:
    """A 6-SPU hexapod, or any n-leg platform with point-like joints and motors on all legs."""

    parameters: KinematicParameters  # its parameters xi, in R_b and R_e
    frame_legs: tuple[int, ...]  # the legs whose joint centres define R_b and R_e
    radius: Array  # (n_legs,) radii of the legs [m]
    travel: Array  # (n_legs, 2) shortest and longest leg [m]
    home: RigidTransform  # T_Rb_Re of a pose in the assembly mode

    @property
    def n_legs(self) -> int:
        """Number of legs."""
        return len(self.radius)

    @property
    def leg_names(self) -> tuple[str, ...]:
        """Names of the legs."""
        return tuple(f"leg{j + 1}" for j in range(self.n_legs))

    @property
    def parts(self) -> tuple[str, ...]:
        """The URDF link of each leg's one cylinder, named as in the shipped hexapod."""
        return tuple(f"leg{j + 1}_tube" for j in range(self.n_legs))

    def radius_of_part(self) -> dict[str, float]:
        """Return the radius of each visible cylinder by its link [m]."""
        return {part: float(R) for part, R in zip(self.parts, self.radius, strict=True)}


def paper_hexapod() -> PaperHexapod:
    """Return the coplanar 6-SPU hexapod of ``models/hexapod.yaml``."""
    base_angles = np.deg2rad([210.0, -54.0, -30.0, 66.0, 90.0, 186.0])
    platform_angles = np.deg2rad([210.0, 234.0, -30.0, -6.0, 90.0, 114.0])
    frame_legs = (0, 2, 4)
    A_base = 0.270 * _ring(base_angles)
    B_platform = 0.195 * _ring(platform_angles)
    T_base_Rb = frame_on_points(A_base[list(frame_legs)])
    T_platform_Re = frame_on_points(B_platform[list(frame_legs)])
    T_base_platform = RigidTransform.from_components(
        [0.0, 0.0, 0.38274], Rotation.from_euler("z", 36.0, degrees=True)
    )
    parameters = KinematicParameters(
        T_base_Rb.inv().apply(A_base),
        T_platform_Re.inv().apply(B_platform),
        np.full(6, 0.345),
    )
    return PaperHexapod(
        parameters=_without_rounding(parameters, frame_legs),
        frame_legs=frame_legs,
        radius=np.full(6, 0.010),
        travel=np.tile([0.345, 0.485], (6, 1)),
        home=T_base_Rb.inv() * T_base_platform * T_platform_Re,
    )


def noncoplanar_hexapod() -> PaperHexapod:
    """Return that hexapod with joints 2, 4 and 6 moved out of the planes of 1, 3 and 5.

    They are 30 mm higher at the base and 30 mm lower at the platform.
    """
    machine = paper_hexapod()
    A, B = machine.parameters.base_joints.copy(), machine.parameters.platform_joints.copy()
    A[1::2, 2] += RAISED
    B[1::2, 2] -= RAISED
    return replace(machine, parameters=KinematicParameters(A, B, machine.parameters.offsets))


def perturb(
    machine: PaperHexapod, rng: np.random.Generator, half_width: float, *, coplanar: bool = False
) -> PaperHexapod:
    """Return the machine with uniform errors on every parameter."""
    vector = to_vector(machine.parameters, machine.frame_legs)
    vector = vector + rng.uniform(-half_width, half_width, vector.shape)
    parameters = from_vector(vector, machine.n_legs, machine.frame_legs)
    if coplanar:
        parameters.base_joints[:, 2] = machine.parameters.base_joints[:, 2]
        parameters.platform_joints[:, 2] = machine.parameters.platform_joints[:, 2]
    return replace(machine, parameters=parameters)


def _ring(angles: Array) -> Array:
    """Return points of the unit circle in the plane z = 0."""
    return np.stack([np.cos(angles), np.sin(angles), np.zeros_like(angles)], axis=-1)


def _without_rounding(
    parameters: KinematicParameters, frame_legs: tuple[int, ...]
) -> KinematicParameters:
    """Set the coordinates that the frame makes zero to exactly zero."""
    vector = to_vector(parameters, frame_legs)
    return from_vector(vector, len(parameters.offsets), frame_legs)


def simulated_leg_vectors(parameters: KinematicParameters, T_Rb_Re: RigidTransform) -> Array:
    """Return A_j B_j of every leg in R_b at one or several poses, (..., n_legs, 3) [m]."""
    arms = parameters.platform_joints @ np.swapaxes(T_Rb_Re.rotation.as_matrix(), -1, -2)
    return np.asarray(arms + T_Rb_Re.translation[..., None, :] - parameters.base_joints)


def poses_with_lengths(
    parameters: KinematicParameters, lengths: Array, start: RigidTransform
) -> RigidTransform:
    """Return the platform poses with given leg lengths that are nearest to a start."""
    legs, R, t = point_like_legs(parameters), start.rotation.as_matrix(), start.translation
    solved = solve_poses(legs, range(3), R, t, lengths - parameters.offsets)
    if np.any(solved.missed > _MAX_ERROR * lengths.max(axis=1, initial=0.0)):
        raise DidNotConverge(
            f"A simulated pose was not found: leg lengths are still "
            f"{1e3 * solved.missed.max():.2g} mm off; choose lengths that the machine can reach."
        )
    return RigidTransform.from_components(solved.t, Rotation.from_matrix(solved.R))


def follow_from_home(machine: PaperHexapod, lengths: Array) -> tuple[RigidTransform, BoolArray]:
    """Return the poses with leg lengths (n, n_legs) by small steps from home, and which have them.

    They are in the assembly mode of home; those beyond or beside a singularity are not reached, and
    are the last pose on the way.
    """
    parameters, n = machine.parameters, len(lengths)
    legs = point_like_legs(parameters)
    R = np.tile(machine.home.rotation.as_matrix(), (n, 1, 1))
    t = np.tile(machine.home.translation, (n, 1))
    reached = np.ones(n, dtype=np.bool_)
    first = np.linalg.norm(simulated_leg_vectors(parameters, machine.home), axis=-1)
    size = float(np.mean(np.linalg.norm(parameters.platform_joints, axis=-1)))
    unit = np.repeat([size, 1.0], 3)
    for part in np.linspace(0.0, 1.0, _N_STEPS + 1)[1:]:
        here = np.flatnonzero(reached)
        wanted = first + part * (lengths[here] - first)
        solved = solve_poses(legs, range(3), R[here], t[here], wanted - parameters.offsets)
        J = pose_equations(legs, solved.R, solved.t, by_local=False).by_pose / unit
        smallest = np.linalg.svd(J, compute_uv=False)[:, -1]
        exact = solved.missed <= _MAX_ERROR * wanted.max(axis=1, initial=0.0)
        regular = exact & (smallest >= _MIN_SINGULAR)
        R[here[regular]], t[here[regular]] = solved.R[regular], solved.t[regular]
        reached[here] = regular
    return RigidTransform.from_components(t, Rotation.from_matrix(R)), reached


def extreme_poses(machine: PaperHexapod, n_poses: int, rng: np.random.Generator) -> RigidTransform:
    """Return random poses with every leg near its shortest or its longest (section 4.3).

    Poses are followed from home in small steps, so that they stay in its assembly mode; those
    that cannot be reached or pass near a singularity are drawn again.
    """
    n = machine.n_legs
    return _drawn(machine, n_poses, lambda: near_ends(rng.integers(0, 2, n), rng.random(n)))


def random_hexapod_poses(
    machine: PaperHexapod, n_poses: int, rng: np.random.Generator
) -> RigidTransform:
    """Return random poses with every leg length drawn uniformly from its travel.

    They are followed from home as those of :func:`extreme_poses`.
    """
    return _drawn(machine, n_poses, lambda: rng.random(machine.n_legs))


def _drawn(machine: PaperHexapod, n_poses: int, draw: Callable[[], Array]) -> RigidTransform:
    """Return poses whose leg lengths are drawn, as parts of the travel, until enough are reached.

    Each round draws as many as are missing, so that the draws are those of one pose at a time.
    """
    lowest, highest = machine.travel.T
    found: list[RigidTransform] = []
    for _ in range(_MAX_ROUNDS):
        if len(found) == n_poses:
            return RigidTransform.concatenate(found)
        part = np.array([draw() for _ in range(n_poses - len(found))])
        poses, reached = follow_from_home(machine, lowest + part * (highest - lowest))
        found += poses[reached]
    raise DidNotConverge(
        f"Only {len(found)} of {n_poses} random poses of a simulated machine were found; "
        "check its travel."
    )


@dataclass(frozen=True, eq=False)
class LegCamera:
    """A camera around a machine in memory, and the legs that it is said to see."""

    camera: Camera  # its intrinsics
    T_Rb_camera: RigidTransform  # its pose in R_b
    legs: tuple[int, ...]  # the legs that its images show


def hexapod_cameras(
    machine: PaperHexapod,
    rng: np.random.Generator,
    *,
    legs: Sequence[Sequence[int]] = PAPER_VIEWS,
    camera: Camera | None = None,
) -> tuple[LegCamera, ...]:
    """Return cameras that stand around a machine, each on the side of the legs it sees."""
    A_Rb = machine.parameters.base_joints
    B_Rb = machine.home.apply(machine.parameters.platform_joints)
    middle = 0.5 * (A_Rb + B_Rb)
    centre = middle.mean(axis=0)
    cameras = []
    for seen in legs:
        outward = (middle[list(seen)] - centre).mean(axis=0)
        outward[2] = 0.0
        if np.linalg.norm(outward) < 1e-3 * _DISTANCE:  # every leg is seen: any side will do
            outward = np.array([*rng.normal(size=2), 0.0])
        outward /= np.linalg.norm(outward)
        lift = rng.uniform(0.0, 0.25)
        toward = np.array([*(outward[:2] * np.cos(lift)), np.sin(lift)])
        position = centre + _DISTANCE * rng.uniform(0.95, 1.05) * toward
        pose = look_at(position, centre, roll=rng.uniform(-0.1, 0.1))
        cameras.append(LegCamera(camera or sample_camera(), pose, tuple(seen)))
    return tuple(cameras)


@dataclass(frozen=True, eq=False)
class HexapodSession:
    """Measurements of a simulated machine, and what is true of it; its base link's frame is R_b."""

    measurements: Measurements  # with rough camera poses
    outlines: Outlines | None  # None where Table 1 gave the noise of the axes
    axes: LegAxes
    machine: PaperHexapod
    cameras: tuple[LegCamera, ...]
    T_Rb_Re: RigidTransform  # n_poses of them
    scene: Scene


def hexapod_session(
    machine: PaperHexapod,
    cameras: Sequence[LegCamera],
    rng: np.random.Generator,
    *,
    noise: OutlineNoise | TableNoise,
    noisy: bool = True,  # else all is exact; observations carry covariances in either case
    sigma_q: float = 2e-6,  # of readings [m]
    uniform_readings: bool = False,  # of that standard deviation, instead of normal
    n_poses: int = 15,  # for each view
    n_images: int = 1,  # of each pose in each view
    share_poses: bool = False,  # several cameras at once
) -> HexapodSession:
    """Return a session of a machine before cameras, in poses with extreme leg lengths."""
    n_views = len(cameras)
    T_Rb_Re = extreme_poses(machine, n_poses if share_poses else n_views * n_poses, rng)
    view = np.repeat(np.arange(n_views), n_poses * n_images)
    pose = np.repeat(np.arange(n_views * n_poses), n_images)
    pose = (pose % n_poses if share_poses else pose).astype(np.intp)
    legs = simulated_leg_vectors(machine.parameters, T_Rb_Re)
    q = np.linalg.norm(legs, axis=-1) - machine.parameters.offsets
    if noisy and uniform_readings:
        half_width = np.sqrt(3.0) * sigma_q
        q = q + rng.uniform(-half_width, half_width, q.shape)
    elif noisy:
        q = q + rng.normal(scale=sigma_q, size=q.shape)
    views = []
    for v, camera in enumerate(cameras):
        T = rough_pose(camera.T_Rb_camera, rng) if noisy else camera.T_Rb_camera
        names = tuple(machine.leg_names[j] for j in camera.legs)
        views.append(
            View(f"c{v + 1}", camera.camera, T, names if len(names) < machine.n_legs else None)
        )
    measurements = Measurements(
        views=tuple(views),
        image=("",) * len(view),
        view=view.astype(np.intp),
        pose=pose,
        q=q[pose],
        sigma_q=sigma_q,
    )
    scene = plain_scene(
        np.broadcast_to(machine.parameters.base_joints, legs.shape),
        machine.parameters.base_joints + legs,
        [
            Viewpoint(view.name, c.camera, c.T_Rb_camera)
            for view, c in zip(views, cameras, strict=True)
        ],
        measurements.view,
        pose,
        {(j, part): float(machine.radius[j]) for j, part in enumerate(machine.parts)},
        [cameras[v].legs for v in view.tolist()],
    )
    outlines, axes = outlines_and_axes(machine, scene, measurements, noise, rng if noisy else None)
    return HexapodSession(measurements, outlines, axes, machine, tuple(cameras), T_Rb_Re, scene)


def outlines_and_axes(
    machine: PaperHexapod,
    scene: Scene,
    measurements: Measurements,
    noise: OutlineNoise | TableNoise,
    rng: np.random.Generator | None,
) -> tuple[Outlines | None, LegAxes]:
    """Return outlines, unless Table 1 has the noise, and axes of a scene; exact without *rng*."""
    if isinstance(noise, TableNoise):
        return None, axes_of_table(*axes_in_images(scene, noise, rng))
    outlines = outlines_of(scene, noise, rng)
    return outlines, axes_from_outlines(outlines, measurements, machine.radius_of_part())
