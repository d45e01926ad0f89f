"""Joints at A that an actuator moves: the analogue of (6), which is ours and not the paper's.

A rod hangs on a carriage or an arm, and its axes (u_k, M_k) in the images of one view go through
the places of its joint at the readings q_k, as those of a leg go through its base joint:

    (A(q_k) - M_k) x u_k = 0   (6')

This is linear in a and d of a prismatic, A(q) = a + q d, from three images, and in p, x and y of a
revolute, A(q) = p + x cos q + y sin q, from five. Afterwards |d| = 1 (readings and outlines that
disagree on lengths show there), or x.y = 0 and |x| = |y|, with the axis w along x x y.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from legcal.geometry.axes import turned_axis
from legcal.geometry.lines import cross, normal_basis
from legcal.geometry.types import Array, IntArray
from legcal.machine.actuator import Actuator, ActuatorColumns

MIN_IMAGES = {False: 3, True: 5}  # of one view, by whether the actuator turns
_SAME = 1e-9  # of the normalised information of (6'): smaller eigenvalues are rounding


class CarrierColumns:
    """Where the unknowns of a joint stand: A, turns of its revolute axis, and the actuator's."""

    A, V, AXIS, POINT = slice(0, 3), slice(3, 5), slice(5, 7), slice(7, 9)
    COUNT = 9


@dataclass(frozen=True, eq=False)
class Carrier:
    """A joint at A that an actuator moves, in the frame of a camera."""

    A: Array  # (3,) at reading 0 [m]
    v: Array  # (3,) the revolute axis of the joint at reading 0; zero without one
    actuator: Actuator
    # (9, 9) of A [m^2], of two turns of the revolute axis of the joint and of two of the actuator's
    # axis about their normal bases [rad^2], and of two displacements of this along its own [m^2];
    # zero for what it does not have
    covariance: Array

    @property
    def columns(self) -> IntArray:
        """Which of the unknowns it has."""
        v = [3, 4] if self.v.any() else []
        point = [7, 8] if self.actuator.turns else []
        return np.array([0, 1, 2, *v, 5, 6, *point])

    def at(self, q: Array) -> tuple[Array, Array]:
        """Return A at readings (k,), (k, 3) [m], and its derivative (k, 3, 9) by the unknowns."""
        motion = self.actuator.motion(self.A, q)
        slope = np.zeros((len(q), 3, CarrierColumns.COUNT))
        slope[:, :, CarrierColumns.A] = motion.by_A
        slope[:, :, CarrierColumns.AXIS] = motion.by_axis
        slope[:, :, CarrierColumns.POINT] = motion.by_point
        return motion.A, slope

    def axis_at(self, q: Array) -> tuple[Array, Array]:
        """Return the revolute axis of the joint in the same way; zero without one."""
        slope, R = np.zeros((len(q), 3, CarrierColumns.COUNT)), self.actuator.rotations(q)
        if not self.v.any():
            return np.zeros((len(q), 3)), slope
        slope[:, :, CarrierColumns.V] = R @ cross(normal_basis(self.v), self.v).T
        if self.actuator.turns:
            about_origin = replace(self.actuator, point=np.zeros(3))
            slope[:, :, CarrierColumns.AXIS] = about_origin.motion(self.v, q).by_axis
        return R @ self.v, slope

    def moved(self, step: Array) -> Carrier:
        """Return it after a step (9,) of the unknowns, its axis given by the point beside A."""
        columns = CarrierColumns
        A = self.A + step[columns.A]
        v = turned_axis(self.v, step[columns.V]) if self.v.any() else self.v
        of_axis = np.zeros(ActuatorColumns.COUNT)
        of_axis[:4] = *step[columns.AXIS], *step[columns.POINT]
        actuator = self.actuator.moved(of_axis)
        if actuator.turns:
            along = float((A - actuator.point) @ actuator.axis)
            actuator = replace(actuator, point=actuator.point + along * actuator.axis)
        return replace(self, A=A, v=v, actuator=actuator)


def linear_motion(
    actuator: Actuator,  # of which kind it is; its axis and its point are not looked at
    q: Array,
    normal: Array,
    M: Array,
) -> tuple[Array, Actuator] | None:
    """Solve (6') for readings q (k,), weights of points (k, 3, 3) and M (k, 3).

    Returns A at reading 0 and the actuator; None where readings and directions do not determine
    them.
    """
    motion = actuator.gain * q
    basis = [np.ones(len(q)), motion]
    if actuator.turns:
        basis = [np.ones(len(q)), np.cos(motion), np.sin(motion)]
    B = np.stack(basis, axis=1)
    n = 3 * B.shape[1]
    F = np.einsum("ka,kb,kij->aibj", B, B, normal).reshape(n, n)
    size = np.sqrt(np.diag(F))
    if size.min() <= 0.0 or np.linalg.eigvalsh(F / np.outer(size, size))[0] <= _SAME:
        return None
    right = np.einsum("ka,kij,kj->ai", B, normal, M).ravel()
    found = np.linalg.solve(F, right).reshape(-1, 3)
    if not actuator.turns:
        scale = float(np.linalg.norm(found[1]))
        if scale <= _SAME:
            return None
        d = found[1] / scale
        return found[0], replace(actuator, axis=d, point=found[0])
    centre, x, y = found
    w = cross(x, y)
    area = float(np.linalg.norm(w))
    if area <= _SAME * float(x @ x + y @ y):
        return None
    w /= area
    # The orthogonal pair of one length that is nearest to x and y
    arm = 0.5 * (x + cross(y, w))
    return centre + arm, replace(actuator, axis=w, point=centre)


def points_on(actuator: Actuator, A: Array) -> Array:
    """Return three places (3, 3) of a joint at A: over the travel, or as far as it is known."""
    low, high = actuator.travel
    if not np.isfinite(high - low) or high <= low:
        low, high = (-1.0, 1.0) if actuator.turns else (0.0, 1.0)
    return actuator.at(A, np.linspace(low, high, 3))
