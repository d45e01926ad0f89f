"""The variables of the joint fit: state, start, manifolds, exact constraints.

The kinematic parameters are the vector of :mod:`legcal.machine` (``Parametrization``);
:class:`LegParameters` is its manifold with some of them fixed. Platform poses obey the constraints
of joints, constant lengths and the plane exactly (:class:`LegConstraints`).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property, lru_cache
from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import RigidTransform

from legcal.calibration.tuning import (
    ARM_AXIS_SIGMA,
    ARM_POINT_SIGMA,
    LOSS_WIDTH,
    RADIUS_SIGMA,
    REJECTION,
)
from legcal.data.measurements import Measurements
from legcal.errors import DidNotConverge
from legcal.estimation.problem import EstimationProblem, Frames, Tangent
from legcal.geometry.lines import axis_angles_slope
from legcal.geometry.types import Array, BoolArray, IntArray
from legcal.machine.actuator import ActuatorColumns, JointMotion
from legcal.machine.closing import solve_poses, solve_postures
from legcal.machine.equations import PoseEquations, freedoms, posture_constraints
from legcal.machine.leg import Leg, LegColumns, mean_length
from legcal.machine.model import Machine
from legcal.machine.parameters import (
    Parametrization,
    geometries,
    is_spatial,
    moved_legs,
    parametrize,
    tied_twist,
    tied_twist_slope,
    vector_of,
    with_numbers,
)
from legcal.machine.rods import actuator_index, actuators_of, first_rods
from legcal.machine.ties import Ties, independent, ties_of
from legcal.machine.tolerance import PART_OF_TRAVEL
from legcal.vision.camera import Camera, intrinsic_names, intrinsic_values, with_intrinsics

_RANK = 1e-7  # of the largest singular value
_TIED, _TIE_STEPS = 2.5e-13, 20  # residual of ties [mean leg lengths], and Newton steps
_MET = 2.5e-12  # residual of satisfied constraints [mean leg lengths]
_STEP_TOLERANCE = 1e-6  # last step where constraints contradict each other [mean leg lengths, rad]


@dataclass(frozen=True)
class RefinementSettings:
    """Settings of the joint fit; distances of outlines and axes are whitened."""

    radius_sigma: float = RADIUS_SIGMA  # of the prior on radii, as a part of the radius
    arm_axis_sigma: float = ARM_AXIS_SIGMA  # of the prior on the direction of an arm [rad]
    arm_point_sigma: float = ARM_POINT_SIGMA  # of its position across, in mean rod lengths
    board_scale_sigma: float = 0.001  # relative, of the dimensions of a board: printers, paper
    loss_width: float = LOSS_WIDTH  # where the loss of an outline turns from quadratic to linear
    rejection: float = REJECTION  # distance of rejection; false for one outline in 25,000
    rejection_rounds: int = 6  # at most, until the rejected outlines stay the same
    noise_rounds: int = 10  # at most, of noise estimation after that
    error_tolerance: float = 0.02  # relative change of these errors at which the rounds end
    largest_rms_px: float = 3.0  # of the offsets of accepted outlines [px]
    other_starts: int = 8  # at most, if a fit rejects a leg of a view
    judges_stated_values: bool = True  # refuse values that contradict the measurements
    max_iterations: int = 200  # steps to try in each solve


DEFAULT_SETTINGS = RefinementSettings()


@dataclass(frozen=True, eq=False)
class Start:
    """Starting values of a fit."""

    legs: tuple[Leg, ...]  # in R_b and R_e
    T_camera_Rb: tuple[RigidTransform, ...]  # one a view
    T_Rb_Re: tuple[RigidTransform, ...]  # one a pose
    label: str  # where it comes from: ``nominal`` or ``staged``
    # Of the calibration boards on base and platform
    T_Rb_board: RigidTransform = field(default_factory=RigidTransform.identity)
    T_Re_board: RigidTransform = field(default_factory=RigidTransform.identity)


class Postures(NamedTuple):
    """Platform poses T_Rb_Re with the readings of actuators at each.

    Tangent steps have 6 + n coordinates: those of ``Frames``, then readings.
    """

    R: Array  # (n_poses, 3, 3)
    t: Array  # (n_poses, 3) [m]
    q: Array  # (n_poses, n_actuators) [m or rad]; no column where no joint at A moves

    @property
    def frames(self) -> Frames:
        """The poses alone."""
        return Frames(self.R, self.t)

    @property
    def motions(self) -> tuple[RigidTransform, ...]:
        """Poses as ``RigidTransform`` objects."""
        return self.frames.motions

    def moved(self, change: Array) -> Postures:
        """Apply tangent steps (n_poses, 6 + n)."""
        return Postures(*self.frames.moved(change[:, :6]), self.q + change[:, 6:])

    def where(self, chosen: BoolArray, other: Postures) -> Postures:
        """Replace the chosen postures (n_poses,) by others."""
        R = np.where(chosen[:, None, None], other.R, self.R)
        t = np.where(chosen[:, None], other.t, self.t)
        return Postures(R, t, np.where(chosen[:, None], other.q, self.q))


@dataclass(frozen=True, eq=False)
class State:
    """Values of all blocks of variables of the joint fit, by their names."""

    legs: tuple[Leg, ...]  # in R_b and R_e
    radii: Array  # (n_radii,) of the parts of legs [m]
    cameras: tuple[Camera, ...]  # with the intrinsics of each view
    board_scale: Array  # (2,) factors on the dimensions of the boards on base and platform
    biases: Array  # (n_biases,) common-mode edge biases [px] and logarithms of gammas
    camera_pose: Frames  # T_camera_Rb, one a view
    board_pose: Frames  # T_Rb_board and T_Re_board; of no meaning where no image shows one
    platform_pose: Postures  # T_Rb_Re, one a pose
    # (n_own_zeros,) readings in images with a zero of their own, over those in others [m or rad]
    own_zeros: Array
    leans: Array  # (n_bodies, 3) of bodies against the lines of their joints, in R_b [rad]

    @cached_property
    def A(self) -> Array:
        """Base joint centres in R_b, (n_legs, 3) [m]; on actuators at reading 0."""
        return np.array([leg.A for leg in self.legs])

    @cached_property
    def actuated(self) -> dict[int, JointMotion]:
        """Motion of the joint at A at all poses, by leg on an actuator."""
        on, q = actuator_index(self.legs), self.platform_pose.q
        return {
            j: leg.actuator.motion(leg.A, q[:, on[j]])
            for j, leg in enumerate(self.legs)
            if leg.actuator is not None
        }

    @cached_property
    def arm_ends(self) -> dict[int, tuple[JointMotion, ...]]:
        """Motion of both ends of the arm at all poses, by the leg of the arm."""
        on, q = actuator_index(self.legs), self.platform_pose.q
        return {
            j: tuple(leg.actuator.motion(end, q[:, on[j]]) for end in leg.arm.ends)
            for j, leg in enumerate(self.legs)
            if leg.actuator is not None and leg.arm is not None
        }

    @cached_property
    def A_at_poses(self) -> Array:
        """Base joint centres in R_b at all poses, (n_poses, n_legs, 3) [m]."""
        A = np.repeat(self.A[None], len(self.platform_pose.t), axis=0)
        for j, motion in self.actuated.items():
            A[:, j] = motion.A
        return A

    @cached_property
    def B(self) -> Array:
        """Platform joint centres in R_e, (n_legs, 3) [m]."""
        return np.array([leg.B for leg in self.legs])

    @cached_property
    def lengths(self) -> Array:
        """Offsets and constant lengths, (n_legs,) [m]."""
        return np.array([leg.q0 for leg in self.legs])

    @cached_property
    def arms(self) -> Array:
        """Vectors from the origin of R_e to B in R_b, (n_poses, n_legs, 3) [m]."""
        shape = 3, len(self.platform_pose.t), len(self.legs)
        return self.ends_at_poses[0].reshape(shape).transpose(1, 2, 0)

    @cached_property
    def ends_at_poses(self) -> tuple[Array, Array]:
        """B at all poses, (3, n_poses * n_legs) each: from the origin of R_e, and of R_b."""
        arms = self.platform_pose.R.transpose(1, 0, 2) @ self.B.T
        ends = arms + self.platform_pose.t.T[..., None]
        return arms.reshape(3, -1), ends.reshape(3, -1)

    def with_chosen(self, chosen: BoolArray, poses: Postures) -> State:
        """Replace the chosen poses (n_poses,)."""
        return replace(self, platform_pose=self.platform_pose.where(chosen, poses))

    @property
    def mean_length(self) -> float:
        """Mean distance of the joints of a leg over the poses [m]."""
        ends = self.arms + self.platform_pose.t[:, None]
        return float(np.linalg.norm(ends - self.A_at_poses, axis=-1).mean())

    @property
    def posture_scale(self) -> Array:
        """Scale of steps of a posture (6 + n,): 1 rad, a mean leg length [m].

        For readings, the step that moves the joint at A of a rod by a mean leg length.
        """
        length = self.mean_length
        readings = [self.legs[j].reading_of(length) for j in first_rods(self.legs)]
        return np.array([1.0, 1.0, 1.0, length, length, length, *readings])


@dataclass(frozen=True, eq=False)
class FittedLegs:
    """The legs of a mechanism, as inputs of the joint fit."""

    names: tuple[str, ...]
    nominal: tuple[Leg, ...]  # in R_b and R_e: reference of axis angles, values of fixed ones
    frame_legs: tuple[int, ...]  # whose joint centres define R_b and R_e: three, two in a plane
    radii: dict[tuple[int, str], float]  # of the model [m], for each (leg index, part)
    home: RigidTransform | None = None  # T_Rb_Re; without it constraints tie no parameters
    is_redundant: bool = False  # whether readings can contradict each other
    # of the travel of all motors that slide alike, as a part of it
    sigma_travel: float = PART_OF_TRAVEL

    @property
    def n_legs(self) -> int:
        """Number of legs."""
        return len(self.names)

    @property
    def spatial(self) -> bool:
        """Whether the platform moves in space and not in a plane."""
        return is_spatial(self.frame_legs)

    @cached_property
    def length_at_home(self) -> float:
        """Mean length of the legs where ties are taken [m]; 0 without a home."""
        return 0.0 if self.home is None else mean_length(self.nominal, self.home.as_matrix()[:3])

    @cached_property
    def sign(self) -> IntArray:
        """Whether each leg grows (+1) or shrinks (-1) with its reading, (n_legs,)."""
        return np.array([leg.sign for leg in self.nominal], dtype=np.intp)

    @cached_property
    def n_actuators(self) -> int:
        """Number of actuators that move joints at A."""
        return len(actuators_of(self.nominal))

    @cached_property
    def parametrization(self) -> Parametrization:
        """The kinematic parameters, twists among them."""
        return parametrize(self.names, self.nominal, self.frame_legs, twists=True)

    @cached_property
    def ties(self) -> Ties:
        """Ties between the parameters, by exact constraints of the mechanism."""
        tied = self.home is not None and not self.n_actuators
        home = self.home.as_matrix()[:3] if tied and self.home is not None else None
        return ties_of(self.nominal, self.frame_legs, home)

    def vector(self, legs: tuple[Leg, ...]) -> Array:
        """Return the kinematic parameters of legs [m, rad]; axes as angles from nominal."""
        return vector_of(self.parametrization, legs, self.nominal)


@lru_cache(maxsize=1)  # one machine is fitted several times, and what follows from its legs kept
def fitted_legs(machine: Machine) -> FittedLegs:
    """Return the legs of a mechanism as inputs of the joint fit."""
    return FittedLegs(
        tuple(leg.name for leg in machine.legs),
        geometries(machine),
        tuple(machine.frame_legs),
        {
            (i, part): r
            for i, leg in enumerate(machine.legs)
            for part, r in leg.radius_of_part.items()
        },
        machine.home_of_frames,
        machine.is_redundant,
        machine.tolerance.travel or PART_OF_TRAVEL,
    )


@dataclass(frozen=True, eq=False)
class LegParameters:
    """The manifold of the legs: free parameters, and values of the fixed ones."""

    legs: FittedLegs
    free: BoolArray  # (p,) which kinematic parameters are unknowns
    values: Mapping[str, float]  # of fixed ones that are not at nominal

    @cached_property
    def unknown(self) -> IntArray:
        """Index of the unknown of each coordinate of each leg, -1 for fixed."""
        number = np.append(np.where(self.free, np.cumsum(self.free) - 1, -1), -1)
        return np.asarray(number[self.legs.parametrization.place], dtype=np.intp)

    @cached_property
    def fixed(self) -> dict[int, float]:
        """Values of the fixed parameters, by index."""
        nominal, names = self.legs.vector(self.legs.nominal), self.legs.parametrization.names
        return {
            int(i): self.values.get(names[i], float(nominal[i])) for i in np.flatnonzero(~self.free)
        }

    @cached_property
    def turns(self) -> bool:
        """Whether an axis is free; its angles from nominal are not additive."""
        axes = self.unknown[:, LegColumns.BASE_AXIS.start : LegColumns.TWIST]
        return bool(np.any(axes >= 0) or np.any(self.unknown[:, LegColumns.OWN :] >= 0))

    @cached_property
    def _half_fixed(self) -> dict[int, float]:
        """Fixed angles of axes with another angle free, by index."""
        columns_of_legs, values = self.legs.parametrization.place, dict[int, float]()
        for columns_of_leg, unknown in zip(columns_of_legs, self.unknown, strict=True):
            for axis in (LegColumns.BASE_AXIS, LegColumns.PLATFORM_AXIS):
                is_fixed = (columns_of_leg[axis] >= 0) & (unknown[axis] < 0)
                if is_fixed.sum() == 1:
                    number = int(columns_of_leg[axis][is_fixed][0])
                    values[number] = self.fixed[number]
            for columns in (ActuatorColumns.LINE, ActuatorColumns.ARM):
                is_fixed = (columns_of_leg[columns] >= 0) & (unknown[columns] < 0)
                if np.any(unknown[columns] >= 0):
                    values |= {
                        int(i): self.fixed[int(i)] for i in columns_of_leg[columns][is_fixed]
                    }
        return values

    def at_fixed(self, geometry: tuple[Leg, ...]) -> tuple[Leg, ...]:
        """Set fixed parameters to their values."""
        return self.tied(with_values(geometry, self.legs, self.fixed))

    def retract(self, geometry: tuple[Leg, ...], change: Array) -> tuple[Leg, ...]:
        """Apply tangent steps (n_legs, 21)."""
        place = np.arange(change.size, dtype=np.intp).reshape(change.shape)
        return self.tied(moved_legs(geometry, place, change.ravel()))

    def tied(self, geometry: tuple[Leg, ...]) -> tuple[Leg, ...]:
        """Restore fixed angles after steps of free axes.

        Turning an axis by one of its angles changes the other to second order, and turning it along
        a loop leaves a twist about it.
        """
        moved = with_values(geometry, self.legs, self._half_fixed) if self._half_fixed else geometry
        names = self.legs.names
        return tuple(
            replace(
                leg,
                twist=tied_twist(leg, nominal, self.values.get(f"{name}.twist", nominal.twist)),
            )
            if nominal.twist is not None
            and leg.is_fixed_to_platform
            and unknown[LegColumns.TWIST] < 0
            else leg
            for leg, nominal, name, unknown in zip(
                moved, self.legs.nominal, names, self.unknown, strict=True
            )
        )

    def _ties_at(self, geometry: tuple[Leg, ...], n: int | None) -> tuple[Array, Array]:
        """Residuals (w,) of *n* ties and their derivatives by the unknowns (w, p_free)."""
        ties = self.legs.ties.at(geometry)
        by_local = ties.by_local.copy()
        for leg, nominal, unknown, rows in zip(
            geometry, self.legs.nominal, self.unknown, np.moveaxis(by_local, 1, 0), strict=True
        ):
            if unknown[LegColumns.TWIST] < 0:
                slope = tied_twist_slope(leg, nominal)
                rows[:, LegColumns.PLATFORM_AXIS] += rows[:, [LegColumns.TWIST]] * slope
        rows = np.zeros((len(ties.values), int(self.free.sum())))
        is_unknown = self.unknown >= 0
        rows[:, self.unknown[is_unknown]] = by_local[:, is_unknown]
        return independent(ties, rows, n)

    @cached_property
    def n_tied(self) -> int:
        """Number of independent ties between the unknowns."""
        return len(self._ties_at(self.legs.nominal, None)[1]) if self.legs.ties else 0

    def tie_rows(self, geometry: tuple[Leg, ...]) -> tuple[Array, Array]:
        """Return residuals (w,) of ties and their derivatives by the unknowns (w, p_free)."""
        return self._ties_at(geometry, self.n_tied)

    def on_ties(self, geometry: tuple[Leg, ...]) -> tuple[Leg, ...]:
        """Project legs onto the ties."""
        for _ in range(_TIE_STEPS if self.n_tied else 0):
            left, rows = self.tie_rows(geometry)
            if np.abs(left).max() < _TIED * self.legs.length_at_home:
                break
            step = np.append(-rows.T @ left, 0.0)
            geometry = self.retract(geometry, step[self.unknown])
        return geometry

    def coordinates(self, geometry: tuple[Leg, ...]) -> Array:
        """Return the values of the unknowns [m, rad]; axes as angles from the nominal ones."""
        return np.asarray(self.legs.vector(geometry)[self.free])

    def jacobian(self, geometry: tuple[Leg, ...]) -> Array:
        """Return the derivative of the coordinates by steps (p_free, p_free): one but for axes."""
        J = np.eye(int(self.free.sum()))
        for leg, nominal, unknown, number in zip(
            geometry, self.legs.nominal, self.unknown, self.legs.parametrization.place, strict=True
        ):
            for columns, axis, start in (
                (LegColumns.BASE_AXIS, leg.base_axis, nominal.base_axis),
                (LegColumns.PLATFORM_AXIS, leg.platform_axis, nominal.platform_axis),
            ):
                if axis is None or start is None or np.all(unknown[columns] < 0):
                    continue
                slope_of_axis = np.zeros((len(self.free), 2))
                slope_of_axis[number[columns]] = axis_angles_slope(axis, start)
                if columns is LegColumns.PLATFORM_AXIS and number[LegColumns.TWIST] >= 0:
                    slope_of_axis[number[LegColumns.TWIST]] = -tied_twist_slope(leg, nominal)
                for x, column in zip(unknown[columns], slope_of_axis.T, strict=True):
                    if x >= 0:
                        J[:, x] = column[self.free]
            if leg.actuator is not None and nominal.actuator is not None:
                slope = leg.actuator.numbers_slope(nominal.actuator)
                parameter = number[LegColumns.ACTUATOR]
                for x, column in zip(unknown[LegColumns.ACTUATOR], slope.T, strict=True):
                    if x >= 0:
                        turned = np.zeros(len(self.free))
                        turned[parameter[parameter >= 0]] = column[parameter >= 0]
                        J[:, x] = turned[self.free]
        return J


def with_values(
    geometry: tuple[Leg, ...], legs: FittedLegs, values: Mapping[int, float]
) -> tuple[Leg, ...]:
    """Set parameters of legs, by index, to values [m, rad]."""
    numbers, place = np.append(legs.vector(geometry), 0.0), legs.parametrization.place
    numbers[list(values)] = list(values.values())
    return with_numbers(geometry, legs.nominal, numbers[place], np.isin(place, list(values)))


def intrinsic_of(camera: Camera, key: str) -> float:
    """Return an intrinsic of a camera by name."""
    return float(intrinsic_values(camera)[intrinsic_names(camera).index(key)])


def changed_cameras(
    cameras: tuple[Camera, ...], change: Array, keys: tuple[str, ...]
) -> tuple[Camera, ...]:
    """Add changes (n_views, n_keys) to the intrinsics *keys* of cameras."""
    if not np.any(change):
        return cameras
    changed = []
    for camera, by in zip(cameras, change, strict=True):
        moved = dict(zip(keys, by.tolist(), strict=True))
        values = {key: intrinsic_of(camera, key) + d for key, d in moved.items() if d != 0.0}
        changed.append(with_intrinsics(camera, values))
    return tuple(changed)


def _constraint_equations(legs: Sequence[Leg], poses: Postures) -> tuple[PoseEquations, Array]:
    """Constraint equations without readings, and their derivatives (k, m, 6 + n) by postures."""
    rows = posture_constraints(legs, *poses, by_local=True)
    return rows, np.concatenate([rows.by_pose, rows.by_q], axis=2)


@dataclass(frozen=True, eq=False)
class LegConstraints:
    """Exact constraints of platform poses: joints, constant lengths and the plane."""

    parameters: LegParameters

    @property
    def legs(self) -> FittedLegs:
        """The legs."""
        return self.parameters.legs

    @cached_property
    def binds(self) -> bool:
        """Whether legs have equations without a reading."""
        return any(leg.n_constraints for leg in self.legs.nominal)

    def project(self, state: State) -> State:
        """Project every pose onto the constraints; least squares if they are contradictory."""
        if np.any(state.radii <= 0.0):
            raise DidNotConverge("The joint fit reached a radius that is not positive.")
        projected, step = self._closed(state)
        size = float(step.max(initial=0.0))
        if size < _STEP_TOLERANCE:
            return projected
        raise DidNotConverge(
            "The joint fit could not satisfy the constraints of the joints: the projection of a "
            f"pose did not converge (last step {size:.2g} leg lengths or rad); start nearer to the "
            "truth (joints to 1 % of a leg length, axes to 3 deg)."
        )

    def with_poses(self, state: State, poses: Postures) -> State:
        """Set and project poses (n_poses,); those that cannot be projected stay."""
        finite: BoolArray = np.isfinite(poses.t + poses.R.sum(axis=2)).all(axis=1)
        finite &= np.isfinite(poses.q).all(axis=1)
        projected, step = self._closed(state.with_chosen(finite, poses))
        return state.with_chosen(finite & (step < _STEP_TOLERANCE), projected.platform_pose)

    def _closed(self, state: State) -> tuple[State, Array]:
        """Project the state; also return the last step of each pose (n_poses,), 0 if met."""
        if not self.binds:
            return state, np.zeros(len(state.platform_pose.t))
        state = replace(state, legs=self.parameters.on_ties(state.legs))
        frame_legs, (R, t, q) = self.legs.frame_legs, state.platform_pose
        scale = state.posture_scale
        if self.legs.n_actuators:
            solved, q = solve_postures(state.legs, frame_legs, R, t, q, scale)
        else:
            solved = solve_poses(state.legs, frame_legs, R, t, scale=scale)
        # The last step of a converged projection may be long.
        step = np.where(solved.missed < _MET * state.mean_length, 0.0, solved.size)
        return replace(state, platform_pose=Postures(solved.R, solved.t, q)), step

    @cached_property
    def _free(self) -> list[int]:
        """Free coordinates of a posture."""
        d = 6 + self.legs.n_actuators
        return [*freedoms(self.legs.frame_legs), *range(6, d)]

    def tangent(self, problem: EstimationProblem[State], state: State) -> Tangent | None:
        """Return the tangent space of poses; None without constraints.

        The basis is scaled to one radian or the mean leg length.
        """
        if self.legs.spatial and not self.binds:
            return None
        free, d = self._free, problem.d_element
        scale = state.posture_scale[free]
        n_poses, n_kept = problem.n_elements, problem.n_kept
        rows, by_posture = _constraint_equations(state.legs, state.platform_pose)
        Q = np.zeros((n_kept + 1, n_poses, d))
        if len(rows.leg) == 0:
            Z = np.broadcast_to(np.eye(d)[:, free] * scale, (n_poses, d, len(free))).copy()
            return Tangent(Z, Q[:-1])
        slopes = by_posture[:, :, free] * scale
        _, s, vt = np.linalg.svd(slopes)
        n = s.shape[1]
        binding = s > _RANK * s[:, :1]
        least = int(binding.sum(axis=1).min(initial=n))
        basis = np.swapaxes(vt, -1, -2)[:, :, least:].copy()
        basis[:, :, : n - least] *= ~binding[:, None, least:]
        Z = np.zeros((n_poses, d, basis.shape[2]))
        Z[:, free] = scale[:, None] * basis
        inverse = np.zeros((n_poses, d, len(rows.leg)))
        inverse[:, free] = scale[:, None] * np.linalg.pinv(slopes, rcond=_RANK)
        for i, leg in enumerate(rows.leg):
            place = problem.columns["legs"][leg]
            by_local = rows.by_local[:, i]
            if place[LegColumns.TWIST] == n_kept:
                slope = tied_twist_slope(state.legs[leg], self.legs.nominal[leg])
                by_local[:, LegColumns.PLATFORM_AXIS] += by_local[:, [LegColumns.TWIST]] * slope
            Q[place] -= by_local.T[..., None] * inverse[None, :, :, i]
        ties = np.zeros((0, n_kept))
        if self.parameters.n_tied:
            rows_of_ties = self.parameters.tie_rows(state.legs)[1]
            ties = np.zeros((len(rows_of_ties), n_kept))
            ties[:, problem.where("legs")] = rows_of_ties
        return Tangent(Z, Q[:-1], ties)

    def following(self, state: State, leg: int, column: int) -> Array:
        """Return the derivative of postures (n_poses, 6 + n) by a coordinate of a leg."""
        free, scale = self._free, state.posture_scale[self._free]
        rows, by_posture = _constraint_equations(state.legs, state.platform_pose)
        inverse = scale[:, None] * np.linalg.pinv(by_posture[:, :, free] * scale, rcond=_RANK)
        by_number = np.where(rows.leg == leg, rows.by_local[:, :, column], 0.0)
        motion = np.zeros((len(state.platform_pose.t), by_posture.shape[2]))
        motion[:, free] = -np.einsum("kfm,km->kf", inverse, by_number)
        return motion


def start_from(
    geometry: Sequence[Leg],
    measurements: Measurements,
    legs: FittedLegs,
    T_camera_Rb: Sequence[RigidTransform],
    T_Rb_Re: Sequence[RigidTransform],
    label: str,
) -> Start:
    """Return a start with platform poses by forward kinematics of *geometry* at the readings.

    *T_Rb_Re* are poses nearby, in the right assembly mode: the nominal forward kinematics.
    """
    lengthening = legs.sign * measurements.q_of_poses
    poses = platform_poses(geometry, lengthening, T_Rb_Re, legs.frame_legs)
    return Start(tuple(geometry), tuple(T_camera_Rb), poses, label)


def platform_poses(
    geometry: Sequence[Leg],
    lengthening: Array,
    T_Rb_Re: Sequence[RigidTransform],
    frame_legs: Sequence[int],
) -> tuple[RigidTransform, ...]:
    """Solve the forward kinematics for all poses.

    Where no pose has the readings (parameters far from the truth), the least-squares pose is
    returned: a fit can still start there.

    Parameters
    ----------
    geometry : sequence of Leg
        The legs in R_b and R_e.
    lengthening : (n_poses, n_legs) array
        s q of actuated legs [m], and q of rods on actuators [m, rad]; NaN where unknown. Others are
        ignored.
    T_Rb_Re : sequence of RigidTransform
        Poses nearby, in the right assembly mode.
    frame_legs : sequence of int
        The legs that define R_b and R_e.
    """
    solved = solve_poses(geometry, frame_legs, *Frames.of(T_Rb_Re), lengthening)
    return Frames(solved.R, solved.t).motions
