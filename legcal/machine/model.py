"""A parallel mechanism as loaded: its legs, its frames, and its closed chain (section 2)."""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Literal, Protocol

import numpy as np
from numpy.typing import ArrayLike
from scipy.spatial.transform import RigidTransform

from legcal.brief import brief
from legcal.errors import UsageError
from legcal.geometry.motions import frame_on_points, motion_of
from legcal.geometry.types import Array, BoolArray
from legcal.machine.actuator import Actuator
from legcal.machine.chain import ClosedChain
from legcal.machine.leg import (
    Cylinder,
    Leg,
    with_platform_points,
    with_radii,
)
from legcal.machine.rods import (
    AT_ZERO,
    actuator_index,
    actuators_of,
    ends_at_poses,
    first_rods,
    joints_at,
    reading_legs,
    readings_of_rods,
)
from legcal.machine.shapes import Occluder, bodies_of, reordered
from legcal.machine.tolerance import NOT_STATED, Tolerance
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
    frame_legs: tuple[int, ...]  # legs that define R_b and R_e: origin, x axis, xy plane
    spatial: bool  # motion in space, not in a plane
    home: RigidTransform  # T_base_platform of a pose in the assembly mode
    home_configuration: Array  # (nq,) the closed chain there
    chain: ClosedChain  # the tree and its closures in Pinocchio
    urdf: Urdf  # the tree as written
    mobility: int = 0  # freedoms of the platform
    motor_rank: int = 0  # freedoms of the platform held by motors
    diagnostics: tuple[str, ...] = ()  # notes for the reader, one sentence each
    base_normal: Array | None = None  # (3,) normal of the plane of motion in the base link
    platform_normal: Array | None = None  # the same in the platform link; both None in space
    occluders: tuple[Occluder, ...] = ()  # what hides besides legs and arms
    tolerance: Tolerance = NOT_STATED  # how well it is built
    spline_teeth: int | None = None  # of the shafts that horns of servos sit on
    reach: float = math.inf  # farthest that the platform moves from the z axis of the base [m]
    floor: float = -math.inf  # lowest z of the platform there [m]

    def may_move_to(self, positions: Array) -> BoolArray:
        """Return which positions (..., 3) of the platform its control allows."""
        inside = np.hypot(positions[..., 0], positions[..., 1]) <= self.reach
        return np.asarray(inside & (positions[..., 2] >= self.floor))

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
        """Mean leg length at home [m], the reference of relative errors and tolerances."""
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
    def bodies(self) -> list[list[Cylinder]]:
        """Bodies with straight edges around the axis of each leg, as cylinders."""
        return bodies_of(self.occluders, self.n_legs)

    @property
    def unseen_legs(self) -> tuple[int, ...]:
        """Indices of the legs that no image can show: without a visible cylinder or body."""
        return tuple(j for j, leg in enumerate(self.legs) if not (leg.cylinders or self.bodies[j]))

    @cached_property
    def motors(self) -> tuple[int, ...]:
        """Indices of the legs with a motor; for rods on one actuator the first leg."""
        return tuple(j for j, leg in enumerate(self.legs) if leg.is_motor and self.reads[j] == j)

    @cached_property
    def reads(self) -> tuple[int, ...]:
        """Index of the leg whose encoder reads each leg; rods on one motor share it."""
        return reading_legs(self.legs)

    @property
    def readings_carry_length(self) -> bool:
        """Whether the readings determine the scale of the machine: not if all are angles."""
        return not self.actuators or any(leg.is_motor and not leg.reads_angle for leg in self.legs)

    @cached_property
    def rod_to_measure(self) -> tuple[Leg, str] | None:
        """The first rod on a motor, and the names of its ends for --length; None without any."""
        rod = next((leg for leg in self.legs if leg.actuator is not None), None)
        return None if rod is None else (rod, f"{rod.name}.base:{rod.name}.platform")

    @property
    def length_option(self) -> str:
        """The option of ``legcal calibrate`` for the length of this rod; bare without any."""
        rod = self.rod_to_measure
        return "--length" if rod is None else f"--length {rod[1]}=MEASURED±SIGMAmm"

    def rod_for_scale(self, *, has_length: bool) -> tuple[Leg, str] | None:
        """Return the rod to measure, None if readings or other measurements determine the scale."""
        return None if has_length or self.readings_carry_length else self.rod_to_measure

    @cached_property
    def actuators(self) -> tuple[Actuator, ...]:
        """The motors that move joints at A, each once, in the base link."""
        return actuators_of(self.legs)

    @property
    def at_zero(self) -> str:
        """Words after "joints A" if these move: the reading at which their coordinates hold."""
        return AT_ZERO if self.actuators else ""

    @cached_property
    def motor_names(self) -> tuple[str, ...]:
        """The URDF joints of the motors."""
        return tuple(str(self.legs[j].prismatic) for j in self.motors)

    @property
    def is_determined(self) -> bool:
        """Whether the motors hold all freedoms of the platform: readings determine its pose."""
        return min(self.motor_rank, len(self.motors)) == self.mobility

    @property
    def is_redundant(self) -> bool:
        """Whether readings overdetermine the pose, which is then a least-squares pose."""
        return self.is_determined and len(self.motors) > self.mobility

    @property
    def undetermined(self) -> str:
        """The reason why readings do not determine the pose, as the end of a sentence."""
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
        """Return joint values (..., n_legs) from motor readings (..., n_motors); others are 0."""
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
        """Sign of the length change of each leg with its reading, (n_legs,): +1 or -1."""
        return self._arrays[3].copy()

    @cached_property
    def _arrays(self) -> tuple[Array, Array, Array, Array]:
        """Joint centres of base and platform, offsets and signs; callers get copies."""
        return (
            np.array([leg.A for leg in self.legs]),
            np.array([leg.B for leg in self.legs]),
            np.array([leg.q0 for leg in self.legs]),
            np.array([float(leg.sign) for leg in self.legs]),
        )

    def lengths_at(self, q: Array, legs: Sequence[int] | None = None) -> Array:
        """Return the lengths of some or all legs at readings (..., n): :meth:`Leg.length_at`."""
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

    def with_radii(self, radius: Callable[[int, Cylinder], float]) -> "Machine":
        """Return the machine with other radii of its visible cylinders; see :func:`with_radii`."""
        others = with_radii([leg.cylinders for leg in self.legs], radius)
        legs = zip(self.legs, others, strict=True)
        return replace(
            self, legs=tuple(replace(leg, cylinders=cylinders) for leg, cylinders in legs)
        )

    def with_leg_order(self, names: Sequence[str]) -> "Machine":
        """Return the machine with its legs, each named once, in another order.

        Raises
        ------
        UsageError
            If the names are not the names of all legs.
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
    matrix = T_base_platform.as_matrix()  # faster than RigidTransform.apply on few points
    return np.asarray(vectors_at(machine, matrix[None])[0])


def B_at(machine: Machine, poses: Array) -> Array:
    """Return the platform joint centres in the base link, (k, n_legs, 3) [m].

    Poses T_base_platform are (k, 3 or 4, 4).
    """
    R, t = poses[:, :3, :3], poses[:, :3, 3]
    return np.asarray(machine.B_platform @ np.swapaxes(R, 1, 2) + t[:, None])


def vectors_at(machine: Machine, poses: Array) -> Array:
    """Return the vectors from A to B at poses T_base_platform (k, 3 or 4, 4), (k, n_legs, 3) [m].

    Moving joints at A are at the position where the first rod of their actuator reaches B.
    """
    A, B = ends_at_poses(machine.legs, poses[:, :3, :3], poses[:, :3, 3])
    return np.asarray(B - A)


def readings_at_poses(machine: Machine, poses: Array) -> Array:
    """Return the joint values (k, n_legs) at poses T_base_platform (k, 3 or 4, 4) [m or rad].

    q = sign (|AB| - q0); for rods on an actuator its reading at which the first rod reaches the
    platform.
    """
    lengths = np.linalg.norm(B_at(machine, poses) - machine.A_base, axis=2)
    q = machine.sign * (lengths - machine.q0)
    if machine.actuators:
        on = np.array(actuator_index(machine.legs))
        rods = readings_of_rods(machine.legs, poses[:, :3, :3], poses[:, :3, 3])
        q = np.where(on >= 0, rods[:, on], q)
    return np.asarray(q)


def readings_at(machine: Machine, T_base_platform: RigidTransform) -> Array:
    """Return the joint values at one pose, (n_legs,)."""
    return np.asarray(readings_at_poses(machine, T_base_platform.as_matrix()[None])[0])


def platform_pose(machine: Machine, configuration: Array) -> RigidTransform:
    """Return T_base_platform at a configuration."""
    return machine.chain.pose(configuration, machine.base, machine.platform)


def slider_columns(machine: Machine, legs: Sequence[int]) -> tuple[list[int], list[int]]:
    """Return the indices of the sliders of some legs in configurations and in tangent vectors."""
    names = [machine.legs[j].prismatic for j in legs]
    joints = [name for name in names if name is not None]
    chain = machine.chain
    return [chain.q_index(j) for j in joints], [chain.v_index(j) for j in joints]


def joint_values(machine: Machine, configuration: Array) -> Array:
    """Return the joint value of every leg at a configuration, (n_legs,) [m or rad].

    It is the value of the slider, or of the actuator of a rod, and zero for other rods.
    """
    values = np.zeros(machine.n_legs)
    sliding = [j for j, leg in enumerate(machine.legs) if leg.has_value]
    values[sliding] = configuration[slider_columns(machine, sliding)[0]]
    return values


class Homogeneous(Protocol):
    """A motion as Pinocchio's ``SE3``."""

    @property
    def homogeneous(self) -> Array:
        """The matrix (4, 4)."""


Pose = RigidTransform | Homogeneous | ArrayLike  # of callers
MAX_ROUNDING = 1e-4  # of rotation matrices of callers, such as printed ones


def pose_of(pose: Pose) -> RigidTransform:
    """Return a pose given as a transform of SciPy, an SE3 of Pinocchio or a matrix (4, 4) [m].

    Raises UsageError if it is no rigid motion.
    """
    if isinstance(pose, RigidTransform) and pose.single:
        return pose
    matrix = getattr(pose, "homogeneous", pose)
    if isinstance(matrix, RigidTransform):
        matrix = matrix.as_matrix()
    try:
        T = np.asarray(matrix, dtype=np.float64)
    except (TypeError, ValueError):
        T = np.empty(0)
    needed = "needed one RigidTransform, pinocchio.SE3 or matrix (4, 4) in metres"
    if T.shape != (4, 4):
        kind = f"an array of shape {T.shape}" if T.size else f"a {type(pose).__name__}"
        raise UsageError(f"The pose could not be read: found {kind}, {needed}; convert it.")
    R = T[:3, :3]
    wrong = np.abs(R @ R.T - np.eye(3)).max(initial=np.abs(T[3] - [0.0, 0.0, 0.0, 1.0]).max())
    if not (np.all(np.isfinite(T)) and wrong <= MAX_ROUNDING and np.linalg.det(R) > 0.0):
        raise UsageError(
            "The pose could not be read: found a matrix that is no rigid motion, needed a rotation "
            "matrix, a translation in metres, and 0 0 0 1 in the last row; correct the matrix."
        )
    return motion_of(R, T[:3, 3])
