"""A parallel mechanism as loaded: its legs, its frames, and its closed chain (section 2)."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Literal

import numpy as np
from scipy.spatial.transform import RigidTransform

from legcal.brief import brief
from legcal.errors import UsageError
from legcal.geometry.motions import frame_on_points
from legcal.geometry.types import Array
from legcal.machine.actuator import Actuator
from legcal.machine.chain import ClosedChain
from legcal.machine.leg import (
    Cylinder,
    KinematicParameters,
    Leg,
    parameters_of_legs,
    with_platform_points,
    with_radii,
)
from legcal.machine.occluders import Occluder, reordered
from legcal.machine.rods import (
    AT_ZERO,
    actuators_of,
    first_rods,
    joints_at,
    reading_legs,
    reading_of_rod,
)
from legcal.machine.urdf import Urdf


@brief
@dataclass(frozen=True, eq=False)
class Machine:
    """A platform on legs, read from a YAML and its URDF."""

    name: str
    yaml_path: Path
    urdf_path: Path
    base: str  # link
    platform: str  # link
    platform_joint: str | None  # the virtual joint that carries the platform
    legs: tuple[Leg, ...]  # in the order of the YAML, in the links of base and platform
    frame_legs: tuple[int, ...]  # whose joints define R_b and R_e: origin, x axis, xy plane
    spatial: bool  # whether the platform moves in space and not in a plane
    home: RigidTransform  # T_base_platform of a pose in the assembly mode
    home_configuration: Array  # (nq,) the closed chain there
    chain: ClosedChain  # the tree and its closures in Pinocchio
    urdf: Urdf  # the tree as written
    mobility: int = 0  # freedoms of the platform
    motor_rank: int = 0  # of which the motors hold
    diagnostics: tuple[str, ...] = ()  # what the reader should know, one sentence each
    base_normal: Array | None = None  # (3,) of the plane of motion in the links of base and
    platform_normal: Array | None = None  # platform, the same way up; None in space
    occluders: tuple[Occluder, ...] = ()  # what hides besides legs and arms

    @property
    def upward(self) -> Array:
        """The direction (3,) from base to platform at home, or the normal of a plane of motion."""
        if self.base_normal is not None:
            return self.base_normal
        across = (B_at(self, self.home.as_matrix()[None])[0] - self.A_base).mean(axis=0)
        size = float(np.linalg.norm(across))
        reach = float(np.ptp(self.A_base, axis=0).max())
        return np.asarray(across / size) if size > 1e-3 * reach else np.array([0.0, 0.0, 1.0])

    @cached_property
    def size(self) -> float:
        """Mean leg length at home [m]: what errors and tolerances of lengths are parts of."""
        vectors = vectors_at(self, self.home.as_matrix()[None])[0]
        return float(np.linalg.norm(vectors, axis=1).mean())

    @property
    def n_legs(self) -> int:
        """Number of legs."""
        return len(self.legs)

    @cached_property
    def leg_names(self) -> tuple[str, ...]:
        """Names of the legs."""
        return tuple(leg.name for leg in self.legs)

    @cached_property
    def motors(self) -> tuple[int, ...]:
        """Indices of the legs with a motor; of rods on one actuator that of the first."""
        return tuple(j for j, leg in enumerate(self.legs) if leg.is_motor and self.reads[j] == j)

    @cached_property
    def reads(self) -> tuple[int, ...]:
        """Index of the leg whose encoder reads each leg: rods on one motor share one."""
        return reading_legs(self.legs)

    @property
    def readings_carry_length(self) -> bool:
        """Whether the scale of the machine is in its readings: not where all of them are angles."""
        return not self.actuators or any(leg.is_motor and not leg.reads_angle for leg in self.legs)

    @cached_property
    def rod_to_measure(self) -> tuple[Leg, str] | None:
        """The first rod on a motor, and what --length calls its ends; None without any."""
        rod = next((leg for leg in self.legs if leg.actuator is not None), None)
        return None if rod is None else (rod, f"{rod.name}.base:{rod.name}.platform")

    @property
    def length_option(self) -> str:
        """The option of ``legcal calibrate`` that states this rod's length; bare without any."""
        rod = self.rod_to_measure
        return "--length" if rod is None else f"--length {rod[1]}=MEASURED±SIGMAmm"

    def rod_for_scale(self, *, has_length: bool) -> tuple[Leg, str] | None:
        """Return the rod to measure, None where readings or something measured carry lengths."""
        return None if has_length or self.readings_carry_length else self.rod_to_measure

    @cached_property
    def actuators(self) -> tuple[Actuator, ...]:
        """What moves joints at A, each once, in the base link."""
        return actuators_of(self.legs)

    @property
    def at_zero(self) -> str:
        """Words after "joints A": the reading at which their coordinates hold, if they move."""
        return AT_ZERO if self.actuators else ""

    @cached_property
    def motor_names(self) -> tuple[str, ...]:
        """The URDF joints of the motors."""
        return tuple(str(self.legs[j].prismatic) for j in self.motors)

    @property
    def is_determined(self) -> bool:
        """Whether the motors hold all freedoms of the platform: readings give its pose."""
        return min(self.motor_rank, len(self.motors)) == self.mobility

    @property
    def is_redundant(self) -> bool:
        """Whether readings give the pose and can contradict each other: it is of least squares."""
        return self.is_determined and len(self.motors) > self.mobility

    @property
    def undetermined(self) -> str:
        """Why readings do not give the pose, as a sentence goes on."""
        n, moves = len(self.motors), f"a platform with mobility {self.mobility}"
        if n == 0:
            return f"no motor determines the pose of {moves}"
        does = "motor does" if n == 1 else "motors do"
        held = f", of which they hold {self.motor_rank}" if self.motor_rank < n else ""
        return f"{n} {does} not determine the pose of {moves}{held}"

    @property
    def A_base(self) -> Array:
        """Base joint centres in the base link, (n_legs, 3) [m]; on actuators at reading 0."""
        return self._arrays[0].copy()

    def A_at(self, q: Array) -> Array:
        """Return the base joint centres (..., n_legs, 3) [m] at joint values q (..., n_legs)."""
        q = np.asarray(q, dtype=np.float64)
        if not self.actuators:
            return np.broadcast_to(self._arrays[0], (*q.shape, 3))
        A = joints_at(self.legs, q.reshape(-1, self.n_legs)[:, first_rods(self.legs)])
        return A.reshape(*q.shape, 3)

    def at_readings(self, readings: Array) -> Array:
        """Return joint values (..., n_legs) with those of motors (..., n_motors); others are 0."""
        readings = np.asarray(readings)
        number = {j: i for i, j in enumerate(self.motors)}
        q = np.zeros((*readings.shape[:-1], self.n_legs))
        for j, motor in enumerate(self.reads):
            if motor in number:
                q[..., j] = readings[..., number[motor]]
        return q

    @property
    def B_platform(self) -> Array:
        """Platform joint centres in the platform link, (n_legs, 3) [m]."""
        return self._arrays[1].copy()

    @property
    def q0(self) -> Array:
        """Leg lengths at reading zero, (n_legs,) [m]."""
        return self._arrays[2].copy()

    @property
    def sign(self) -> Array:
        """Whether each leg grows (+1) or shrinks (-1) with its reading, (n_legs,)."""
        return self._arrays[3].copy()

    @cached_property
    def _arrays(self) -> tuple[Array, Array, Array, Array]:
        """Joint centres of base and platform, offsets and signs, of which callers get copies."""
        return (
            np.array([leg.A for leg in self.legs]),
            np.array([leg.B for leg in self.legs]),
            np.array([leg.q0 for leg in self.legs]),
            np.array([float(leg.sign) for leg in self.legs]),
        )

    def lengths_at(self, q: Array, legs: Sequence[int] | None = None) -> Array:
        """Return the lengths of some legs, or all, at readings (..., n): :meth:`Leg.length_at`."""
        chosen = slice(None) if legs is None else list(legs)
        moves = np.array([leg.actuator is None for leg in self.legs])[chosen]
        return np.asarray(np.where(moves, self.sign[chosen] * q, 0.0) + self.q0[chosen])

    @cached_property
    def legs_of_frames(self) -> tuple[Leg, ...]:
        """The legs, with B at the point that defines R_e on frame legs fixed to the platform."""
        return with_platform_points(self.legs, self.frame_legs)

    @cached_property
    def T_base_Rb(self) -> RigidTransform:
        """The frame on the base joint centres of the frame legs, in the base link."""
        return frame_on_points(self.A_base[list(self.frame_legs)], self.base_normal)

    @cached_property
    def T_platform_Re(self) -> RigidTransform:
        """The frame on the platform joint centres of the frame legs, in the platform link."""
        points = np.array([self.legs_of_frames[j].B for j in self.frame_legs])
        return frame_on_points(points, self.platform_normal)

    def T_link_frame(self, link: Literal["base", "platform"]) -> RigidTransform:
        """Return the frame on the joints of a link, R_b or R_e, in that link."""
        return self.T_base_Rb if link == "base" else self.T_platform_Re

    @property
    def home_of_frames(self) -> RigidTransform:
        """T_Rb_Re at home."""
        return self.T_base_Rb.inv() * self.home * self.T_platform_Re

    @cached_property
    def parameters(self) -> KinematicParameters:
        """The kinematic parameters xi, in R_b and R_e [m]."""
        base = self.T_base_Rb.inv().apply(self.A_base)
        platform = self.T_platform_Re.inv().apply([leg.B for leg in self.legs_of_frames])
        n_d = len(self.frame_legs)
        for rank, leg in enumerate(self.frame_legs):  # zero by definition, not by rounding
            base[leg, rank:n_d] = 0.0
            platform[leg, rank:n_d] = 0.0
        parameters = parameters_of_legs(self.legs_of_frames)
        return replace(parameters, base_joints=base, platform_joints=platform)

    def with_radii(self, radius: Callable[[int, Cylinder], float]) -> "Machine":
        """Return the mechanism with other radii of its visible cylinders, as :func:`with_radii`."""
        others = with_radii([leg.cylinders for leg in self.legs], radius)
        legs = zip(self.legs, others, strict=True)
        return replace(
            self, legs=tuple(replace(leg, cylinders=cylinders) for leg, cylinders in legs)
        )

    def with_leg_order(self, names: Sequence[str]) -> "Machine":
        """Return the same mechanism with its legs, each named once, in another order.

        Raises
        ------
        UsageError
            If the names are not those of the legs.
        """
        if sorted(names) != sorted(self.leg_names):
            raise UsageError(
                f"The legs could not be reordered: found {', '.join(names)}, needed each of "
                f"{', '.join(self.leg_names)} once; pass all leg names."
            )
        order = [self.leg_names.index(name) for name in names]
        return replace(
            self,
            legs=tuple(self.legs[j] for j in order),
            frame_legs=tuple(order.index(j) for j in self.frame_legs),
            occluders=reordered(self.occluders, order),
        )


def vectors_A_to_B(machine: Machine, T_base_platform: RigidTransform) -> Array:
    """Return the vectors from base to platform joint of every leg, (n_legs, 3), base link [m]."""
    matrix = T_base_platform.as_matrix()  # RigidTransform.apply is slow on few points
    return np.asarray(vectors_at(machine, matrix[None])[0])


def B_at(machine: Machine, poses: Array) -> Array:
    """Return the platform joint centres in the base link, (k, n_legs, 3) [m].

    Poses T_base_platform are (k, 3 or 4, 4).
    """
    R, t = poses[:, :3, :3], poses[:, :3, 3]
    return np.asarray(machine.B_platform @ np.swapaxes(R, 1, 2) + t[:, None])


def vectors_at(machine: Machine, poses: Array) -> Array:
    """Return the same at poses T_base_platform (k, 3 or 4, 4), (k, n_legs, 3) [m].

    Joints at A that move are where the first rod on their actuator reaches the platform.
    """
    B = B_at(machine, poses)
    A = machine.A_at(_of_actuators(machine, B)) if machine.actuators else machine.A_base
    return np.asarray(B - A)


def _of_actuators(machine: Machine, B: Array) -> Array:
    """Return the joint values (k, n_legs) of actuators whose rods reach B (k, n_legs, 3)."""
    q = np.zeros(B.shape[:2])
    for j, first in enumerate(machine.reads):
        if machine.legs[j].actuator is not None:
            q[:, j] = q[:, first] if first < j else reading_of_rod(machine.legs[j], B[:, j])
    return q


def readings_at_poses(machine: Machine, poses: Array) -> Array:
    """Return the joint values (k, n_legs) at poses T_base_platform (k, 3 or 4, 4) [m or rad].

    q = sign (|AB| - q0); of a rod the reading of its actuator at which the first of its rods
    reaches the platform.
    """
    B = B_at(machine, poses)
    lengths = np.linalg.norm(B - machine.A_base, axis=2)
    hangs = np.array([leg.actuator is not None for leg in machine.legs])
    of_sliders = machine.sign * (lengths - machine.q0)
    return np.asarray(np.where(hangs, _of_actuators(machine, B), of_sliders))


def readings_at(machine: Machine, T_base_platform: RigidTransform) -> Array:
    """Return the same at one pose, (n_legs,)."""
    return np.asarray(readings_at_poses(machine, T_base_platform.as_matrix()[None])[0])


def platform_pose(machine: Machine, configuration: Array) -> RigidTransform:
    """Return T_base_platform at a configuration."""
    return machine.chain.pose(configuration, machine.base, machine.platform)


def slider_columns(machine: Machine, legs: Sequence[int]) -> tuple[list[int], list[int]]:
    """Return where the sliders of some legs stand in configurations and in tangent vectors."""
    names = [machine.legs[j].prismatic for j in legs]
    joints = [name for name in names if name is not None]
    chain = machine.chain
    return [chain.q_index(j) for j in joints], [chain.v_index(j) for j in joints]


def joint_values(machine: Machine, configuration: Array) -> Array:
    """Return the joint value of every leg at a configuration, (n_legs,) [m or rad].

    It is that of its slider, or of what it hangs on, and zero for other rods.
    """
    values = np.zeros(machine.n_legs)
    sliding = [j for j, leg in enumerate(machine.legs) if leg.has_value]
    values[sliding] = configuration[slider_columns(machine, sliding)[0]]
    return values
