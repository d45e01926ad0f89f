"""Redundant motors: consistent readings, and the wrong readings among contradicting ones.

The contradiction of redundant readings is the component of their equations that no platform motion
changes. Every reading is tested as if it alone were wrong: its residual over the standard deviation
of this residual for a correct reading, the root of its redundancy (Baarda's data snooping). The
largest test of a pose identifies the wrong reading, unless another one explains as much.

With a nominal model even correct readings contradict each other, because the joints of the model
are inexact: its parameters have a prior here. Smaller errors of readings are found by the fit,
which knows the model better.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property, lru_cache

import numpy as np
from scipy.linalg import qr
from scipy.spatial.transform import RigidTransform

from legcal.errors import Cause
from legcal.geometry.motions import components
from legcal.geometry.types import Array, IntArray
from legcal.machine.closing import solve_poses
from legcal.machine.equations import equations_at, equations_at_readings, freedoms
from legcal.machine.model import Machine, readings_at, slider_columns
from legcal.machine.parameters import geometries, parametrization_of
from legcal.machine.rods import actuator_index

# Standard deviation of rough readings, as motion of a joint relative to the mean leg length.
ROUGH_READING = 1.5e-4
REJECTION = 4.5  # threshold of the test of a wrong reading; exceeded by 1 of 150,000 correct ones
AS_LIKELY = 25.0  # largest difference of squared tests of readings that are equally likely wrong
MIN_REDUNDANCY = 1e-3  # least redundancy of a reading that can be tested
_MODEL = 0.005  # standard deviation of a nominal model, relative to the mean leg length
_DEPENDENT = 1e-7  # singular value of dependent equations, relative to the largest
_AT_REST = 2.5e-6  # last step of a converged pose [mean leg lengths, rad]
_SAYS = 1e-6  # least redundancy of a reading that may explain a contradiction
_OF_MEDIAN = 0.6745  # median of absolute values, relative to the standard deviation


@dataclass(frozen=True, eq=False)
class ReadingTests:
    """Agreement of readings with all other data, each tested as if it alone were wrong."""

    pose: IntArray  # (n,)
    leg: IntArray  # (n,) leg of the motor
    r: Array  # (n,) residuals over the standard deviations of the readings
    redundancy: Array  # (n,) variance of r for a correct reading; 0 if nothing else measures it

    @cached_property
    def squared(self) -> Array:
        """Squared residuals over their variance; 0 if nothing else measures the reading."""
        is_tested = self.redundancy > 0.0
        return np.where(is_tested, self.r**2 / np.where(is_tested, self.redundancy, 1.0), 0.0)

    @cached_property
    def scale(self) -> float:
        """Robust ratio of residuals to their standard deviations, at least 1."""
        is_tested = self.redundancy > 0.0
        if not is_tested.any():
            return 1.0
        return max(1.0, float(np.sqrt(np.median(self.squared[is_tested]))) / _OF_MEDIAN)

    def of_pose(self, pose: int, most: float, scale: float) -> list[int]:
        """Return the readings of a pose one of which is wrong, the likeliest first.

        There are none if no test exceeds *most* times the *scale* of residuals. Several readings
        are equally likely.
        """
        tests = np.flatnonzero(self.pose == pose)
        order = tests[np.argsort(-self.squared[tests], kind="stable")]
        squared = self.squared[order]
        if not squared[0] > (scale * most) ** 2:
            return []
        return [int(k) for k in order[squared[0] - squared <= AS_LIKELY * scale**2]]


@dataclass(frozen=True, eq=False)
class Contradiction:
    """Readings of a pose that no platform pose can have together."""

    legs: tuple[int, ...]  # legs of which one motor reads wrong, by increasing error
    distances: tuple[float, ...]  # error of each if it alone is wrong, as joint motion [m]
    allowed: float  # largest error of the first if readings agree, as joint motion [m]

    def cause(self, machine: Machine) -> Cause:
        """Return the disagreement of the redundant readings, and its limit."""
        legs = [machine.legs[j] for j in self.legs]
        first, *others = [leg.motor_label for leg in legs]
        off, *distances = [1e3 * distance for distance in self.distances]
        also = list(zip(others, distances, strict=True))
        words = ", ".join(["{} by {:.1f} mm"] * len(also))
        alike = f" (or, equally likely, of {words})" if also else ""
        whose = "leg" if legs[0].actuator is None else "motor"
        return Cause(
            f"the reading of {whose} '{{}}'{alike} {{:.1f}} mm from the value given by the other "
            "motors, needed at most {:.1f} mm",
            (first, *(value for pair in also for value in pair), off, 1e3 * self.allowed),
        )


def contradictions(
    machine: Machine, T_Rb_Re: Sequence[RigidTransform], readings: Array, sigma: Array | None = None
) -> dict[int, Contradiction]:
    """Return the contradictions between readings of redundant motors, by pose.

    Parameters
    ----------
    machine : Machine
        A nominal model.
    T_Rb_Re : sequence of RigidTransform
        The least-squares poses at the readings.
    readings : (n_poses, n_motors) array
        Readings [m, rad].
    sigma : (n_motors,) array, optional
        Standard deviations of the readings [m, rad], at least the rough ones (also the default).
    """
    if not machine.is_redundant or len(readings) == 0:
        return {}
    R, t = components(T_Rb_Re)
    rough = ROUGH_READING * machine.size
    unit = np.array([machine.legs[j].reading_of(1.0) for j in machine.motors])  # reading per metre
    sigma_m = np.maximum(np.zeros(len(unit)) if sigma is None else sigma / unit, rough)
    chi2, r, redundancy = _tested(machine, R, t, readings, sigma_m)
    tests = ReadingTests(
        *_numbers(machine, np.arange(len(readings))), r.ravel(), redundancy.ravel()
    )
    suspected = np.unique(tests.pose[tests.squared > REJECTION**2])
    if not len(suspected):
        return {}
    # A wrong reading shifts the pose of all readings: each is tested at the pose of the others. A
    # reading without which the pose is undetermined explains everything.
    chi2, r, redundancy = chi2[suspected], r[suspected], redundancy[suspected]
    R, t, readings = R[suspected], t[suspected], readings[suspected]
    is_told = redundancy > 0.0
    off = np.where(is_told, r / np.where(is_told, redundancy, 1.0), 0.0)
    explained = np.where(is_told, chi2[:, None], 0.0)
    for i in range(len(unit)):
        others = readings.copy()
        others[:, i] = np.nan
        lengthening = machine.sign * machine.at_readings(others)
        there = solve_poses(geometries(machine), machine.frame_legs, R, t, lengthening)
        left, r_there, redundancy_there = _tested(machine, there.R, there.t, readings, sigma_m)
        good = (redundancy_there[:, i] > 0.0) & (there.size < _AT_REST)
        redundancy[good, i] = redundancy_there[good, i]
        off[good, i] = r_there[good, i] / redundancy_there[good, i]
        freed = chi2 - left + redundancy_there[:, i] * off[:, i] ** 2
        explained[good, i] = np.maximum(freed, 0.0)[good]
    r = np.sqrt(explained * redundancy)
    tests = ReadingTests(*_numbers(machine, suspected), r.ravel(), redundancy.ravel())
    by_pose = dict[int, Contradiction]()
    for k, pose in enumerate(suspected.tolist()):
        alike = [reading - k * len(unit) for reading in tests.of_pose(pose, REJECTION, 1.0)]
        if not alike:
            continue
        distance = np.abs(off[k]) * sigma_m
        alike.sort(key=distance.__getitem__)
        i = alike[0]
        by_pose[pose] = Contradiction(
            tuple(machine.motors[motor] for motor in alike),
            tuple(distance[alike].tolist()),
            float(REJECTION * sigma_m[i] / np.sqrt(redundancy[k, i])),
        )
    return by_pose


def _numbers(machine: Machine, poses: IntArray) -> tuple[IntArray, IntArray]:
    """Return pose and leg of every reading of some poses."""
    return np.repeat(poses, len(machine.motors)), np.tile(machine.motors, len(poses))


def _tested(
    machine: Machine, R: Array, t: Array, readings: Array, sigma_m: Array
) -> tuple[Array, Array, Array]:
    """Return chi2 (k,) of poses R, t of R_e in R_b, and r and redundancy (k, n_motors).

    They are of the components of the equations that no platform motion changes. A nominal model
    is inexact: its parameters and equations have standard deviations beside the readings.
    """
    legs, motors = geometries(machine), machine.motors
    lengthening = machine.sign * machine.at_readings(readings)
    equations = equations_at_readings(legs, R, t, lengthening, by_local=True)
    by_pose = equations.by_pose[:, :, list(freedoms(machine.frame_legs))]
    left = np.linalg.svd(by_pose)[0][:, :, by_pose.shape[2] :]  # unchanged by motion
    on, by_reading = actuator_index(legs), np.zeros((*equations.values.shape, len(motors)))
    for i, j in enumerate(motors):
        if on[j] >= 0:
            by_reading[:, :, i] = equations.by_q[:, :, on[j]] * legs[j].reading_of(1.0)
        else:
            by_reading[:, equations.measured & (equations.leg == j), i] = -legs[j].sign
    parametrization = parametrization_of(machine)
    size = np.array([machine.size if unit == "m" else 1.0 for unit in parametrization.units])
    of_model = equations.by_parameters(parametrization) * (_MODEL * size)
    e, by, P = (
        np.einsum("kms,km...->ks...", left, x) for x in (equations.values, by_reading, of_model)
    )
    share = np.sum(by**2, axis=1) / np.maximum(np.sum(by_reading**2, axis=1), 1e-300)
    moved, rough = by * sigma_m, (ROUGH_READING * machine.size) ** 2 * np.eye(e.shape[1])
    spread = moved @ np.swapaxes(moved, 1, 2) + P @ np.swapaxes(P, 1, 2) + rough
    information = np.linalg.inv(spread)
    v = (information @ e[..., None])[..., 0]
    r = sigma_m * np.einsum("ksn,ks->kn", by, v)
    redundancy = sigma_m**2 * np.einsum("ksn,kst,ktn->kn", by, information, by)
    return np.einsum("ks,ks->k", e, v), r, np.where(share > _SAYS, redundancy, 0.0)


def consistent_readings(
    machine: Machine, readings: Array, at: RigidTransform | None = None
) -> Array:
    """Return the nearest consistent readings (k, n_motors), to first order.

    The linearisation is at home or another pose T_base_platform. Readings without redundancy are
    returned unchanged.
    """
    if not machine.is_redundant:
        return readings
    motors = list(machine.motors)
    if at is None:
        at, here = machine.home, machine.home_configuration[slider_columns(machine, motors)[0]]
    else:
        here = readings_at(machine, at)[motors]
    span = machine.sign[motors][:, None] * reading_span(machine, at)
    return np.asarray(here + (readings - here) @ span @ span.T)


def determining_readings(machine: Machine, readings: Array) -> Array:
    """Return readings (k, n_motors) near given ones, NaN for motors beyond the freedoms.

    The other motors determine the pose at home best. Using all readings would require distributing
    their contradiction far from home among all motors, which takes many steps.
    """
    if not machine.is_redundant:
        return readings
    determining = consistent_readings(machine, readings)
    determining[:, _surplus_motors(machine)] = np.nan
    return determining


@lru_cache(maxsize=8)
def _surplus_motors(machine: Machine) -> IntArray:
    """Return the motors of a redundant machine that determine the pose at home least (indices)."""
    _, _, order = qr(reading_span(machine, machine.home).T, mode="economic", pivoting=True)
    return np.asarray(order[machine.mobility :])


def reading_span(machine: Machine, T: RigidTransform) -> Array:
    """Return a basis (n_motors, mobility) of joint changes of lengths near a pose."""
    equations = equations_at(machine, T)
    J = equations.by_pose[0][equations.measured]
    C = equations.by_pose[0][~equations.measured]
    J = J - J @ np.linalg.pinv(C, rcond=_DEPENDENT) @ C
    return np.linalg.svd(J, full_matrices=False)[0][:, : machine.mobility]
