"""Simulated machines: true parameters and what is needed to move and to see them."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import RigidTransform, Rotation

from legcal.geometry.frames import frame_on_points
from legcal.geometry.types import Array, IntArray
from legcal.mechanism.parameters import KinematicParameters, from_vector, to_vector


@dataclass(frozen=True, eq=False)
class Machine:
    """A 6-SPU hexapod, or any n-leg platform with point-like joints and motors on all legs.

    Attributes
    ----------
    parameters : KinematicParameters
        Its parameters xi, in R_b and R_e.
    sign : (n_legs,) array of int
        Leg length = sign * q + q0.
    frame_legs : tuple of 3 int
        The legs whose joint centres define R_b and R_e.
    radius : (n_legs,) array
        Radii of the legs [m].
    travel : (n_legs, 2) array
        Shortest and longest leg [m].
    home : RigidTransform
        T_Rb_Re of a pose in the assembly mode.
    """

    parameters: KinematicParameters
    sign: IntArray
    frame_legs: tuple[int, ...]
    radius: Array
    travel: Array
    home: RigidTransform

    @property
    def n_legs(self) -> int:
        """Number of legs."""
        return len(self.sign)

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


def hexapod(scale: float = 1.0) -> Machine:
    """Return the coplanar 6-SPU hexapod of ``models/hexapod.yaml``, lengths times ``scale``."""
    base_angles = np.deg2rad([210.0, -54.0, -30.0, 66.0, 90.0, 186.0])
    platform_angles = np.deg2rad([210.0, 234.0, -30.0, -6.0, 90.0, 114.0])
    frame_legs = (0, 2, 4)
    A_base = 0.270 * scale * _ring(base_angles)
    B_platform = 0.195 * scale * _ring(platform_angles)
    T_base_Rb = frame_on_points(A_base[list(frame_legs)])
    T_platform_Re = frame_on_points(B_platform[list(frame_legs)])
    T_base_platform = RigidTransform.from_components(
        [0.0, 0.0, 0.38274 * scale], Rotation.from_euler("z", 36.0, degrees=True)
    )
    parameters = KinematicParameters(
        T_base_Rb.inv().apply(A_base),
        T_platform_Re.inv().apply(B_platform),
        np.full(6, 0.345 * scale),
    )
    return Machine(
        parameters=_without_rounding(parameters, frame_legs),
        sign=np.ones(6, dtype=np.intp),
        frame_legs=frame_legs,
        radius=np.full(6, 0.010 * scale),
        travel=scale * np.tile([0.345, 0.485], (6, 1)),
        home=T_base_Rb.inv() * T_base_platform * T_platform_Re,
    )


def perturb(
    machine: Machine, rng: np.random.Generator, half_width: float, *, coplanar: bool = False
) -> Machine:
    """Return the machine with uniform errors on every parameter.

    Parameters
    ----------
    machine : Machine
        The machine to disturb.
    rng : numpy.random.Generator
        Source of the errors.
    half_width : float
        Errors are uniform in [-half_width, half_width] [m].
    coplanar : bool
        Leave the z coordinates as they are.
    """
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
