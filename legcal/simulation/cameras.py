"""Camera positions around a simulated machine."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import RigidTransform, Rotation

from legcal.geometry.frames import motion_of
from legcal.geometry.types import Array
from legcal.simulation.machine import Machine
from legcal.vision.camera import Camera

UPWARD = np.array([0.0, 0.0, 1.0])
PAPER_VIEWS = ((0, 1, 2, 3), (2, 3, 4, 5), (0, 1, 4, 5))  # four legs seen at a time


@dataclass(frozen=True, eq=False)
class LegCamera:
    """A camera around a machine in memory, and the legs that it is said to see.

    Attributes
    ----------
    camera : Camera
        Its intrinsics.
    T_Rb_camera : RigidTransform
        Its pose in R_b.
    legs : tuple of int
        The legs that its images show.
    """

    camera: Camera
    T_Rb_camera: RigidTransform
    legs: tuple[int, ...]


def sample_camera() -> Camera:
    """Return a camera of 1024 x 768 pixels without distortion, as of the example hexapod."""
    K = np.array([[1290.3, 0.0, 518.3], [0.0, 1290.3, 379.6], [0.0, 0.0, 1.0]])
    return Camera(K, 1024, 768)


def mild_lens() -> Camera:
    """Return the camera of :func:`sample_camera` behind a lens that distorts a little."""
    pinhole = sample_camera()
    return replace(pinhole, distortion=np.array([-0.1, 0.03, 2e-4, -1e-4, 0.0]))


def cameras_around(
    machine: Machine,
    rng: np.random.Generator,
    *,
    legs: Sequence[Sequence[int]] = PAPER_VIEWS,
    distance: float = 0.9,
    camera: Camera | None = None,
) -> tuple[LegCamera, ...]:
    """Return cameras that stand around a machine, each on the side of the legs it sees.

    Parameters
    ----------
    machine : Machine
        The machine in its home pose.
    rng : numpy.random.Generator
        Source of small variations of position and roll.
    legs : sequence of sequences of int
        The legs that each camera sees.
    distance : float
        Distance of the cameras from the middle of the machine [m].
    camera : Camera, optional
        Intrinsics of all cameras; :func:`sample_camera` without it.

    Returns
    -------
    tuple of LegCamera
    """
    A_Rb = machine.parameters.base_joints
    B_Rb = machine.home.apply(machine.parameters.platform_joints)
    middle = 0.5 * (A_Rb + B_Rb)
    centre = middle.mean(axis=0)
    cameras = []
    for seen in legs:
        outward = (middle[list(seen)] - centre).mean(axis=0)
        outward[2] = 0.0
        if np.linalg.norm(outward) < 1e-3 * distance:  # every leg is seen: any side will do
            outward = np.array([*rng.normal(size=2), 0.0])
        outward /= np.linalg.norm(outward)
        lift = rng.uniform(0.0, 0.25)
        toward = np.array([*(outward[:2] * np.cos(lift)), np.sin(lift)])
        position = centre + distance * rng.uniform(0.95, 1.05) * toward
        pose = look_at(position, centre, roll=rng.uniform(-0.1, 0.1))
        cameras.append(LegCamera(camera or sample_camera(), pose, tuple(seen)))
    return tuple(cameras)


def look_at(
    position: Array, target: Array, roll: float = 0.0, *, up: Array = UPWARD
) -> RigidTransform:
    """Return the pose of a camera that looks at a point, with its y axis down.

    Parameters
    ----------
    position, target : (3,) array
        The camera centre and the point on its optical axis, in a frame L [m].
    roll : float
        Turn about the optical axis [rad].
    up : (3,) array
        The direction in L that is up in the image; not along the optical axis.

    Returns
    -------
    RigidTransform
        T_L_camera.
    """
    z = (target - position) / np.linalg.norm(target - position)
    x = np.cross(z, up)
    x /= np.linalg.norm(x)
    upright = np.column_stack([x, np.cross(z, x), z])
    return motion_of(upright @ Rotation.from_euler("z", roll).as_matrix(), position)
