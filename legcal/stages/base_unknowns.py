"""The unknowns of step 2: base joint centres and revolute axes in R_b.

Coordinates that are zero by the choice of R_b are known, and so are the heights of the joints of a
planar mechanism and the normal of its plane: nothing depends on them.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache

import casadi as ca
import numpy as np

from legcal.geometry.lines import normal_basis
from legcal.geometry.types import Array, BoolArray, IntArray
from legcal.mechanism.parameters import free_coordinates
from legcal.stages.nominal import NominalMechanism
from legcal.stages.solution import Solution


@dataclass(frozen=True, eq=False)
class BaseUnknowns:
    """Where coordinates of A and turns of v stand among the unknowns, and where they start.

    Attributes
    ----------
    joints : (n_legs, 3) array of int
        Places of the coordinates of A, leg by leg; -1 where they are known.
    axes : (n_legs, 2) array of int
        Places of the turns of v about the normal basis of its nominal direction, after those of
        all joints; -1 for legs without a revolute axis.
    A_nominal : (n_legs, 3) array
        Nominal centres in R_b [m], with the values of known coordinates.
    v_nominal : (n_legs, 3) array
        Nominal axes in R_b, see :func:`nominal_axes`.
    """

    joints: IntArray
    axes: IntArray
    A_nominal: Array
    v_nominal: Array

    @classmethod
    def of(cls, mechanism: NominalMechanism) -> BaseUnknowns:
        """Return the unknowns of a mechanism."""
        free = free_coordinates(mechanism.n_legs, mechanism.frame_legs)
        turned = np.repeat(mechanism.revolute[:, None], 2, axis=1)
        return cls(
            _numbered(free, 0),
            _numbered(turned, int(free.sum())),
            mechanism.parameters.base_joints,
            nominal_axes(mechanism),
        )

    def __len__(self) -> int:
        return int(np.sum(self.joints >= 0) + np.sum(self.axes >= 0))

    @property
    def known(self) -> Array:
        """Known coordinates of A, zero for unknown ones, (n_legs, 3) [m]."""
        return np.where(self.joints < 0, self.A_nominal, 0.0)

    @property
    def frames(self) -> Array:
        """Nominal axis and its normal basis as columns, (n_legs, 3, 3); zero without an axis."""
        frames = np.zeros((len(self.axes), 3, 3))
        for j in np.flatnonzero(np.isfinite(self.v_nominal[:, 0])):
            v = self.v_nominal[j]
            frames[j] = np.column_stack([v, *normal_basis(v)])
        return frames

    @property
    def start(self) -> Array:
        """The nominal values of the unknowns, (n,) [m, rad]."""
        return np.concatenate(
            [self.A_nominal[self.joints >= 0], np.zeros(int(np.sum(self.axes >= 0)))]
        )

    def joints_at(self, x: Array) -> Array:
        """Return A in R_b, (n_legs, 3) [m], from unknowns of which these are the first."""
        return np.where(self.joints >= 0, x[self.joints], self.A_nominal)

    def axes_at(self, x: Array) -> Array:
        """Return v in R_b, (n_legs, 3), from unknowns of which these are the first."""
        turns = np.where(self.axes >= 0, x[self.axes], 0.0)
        axes = self.v_nominal.copy()
        for j in np.flatnonzero(self.axes[:, 0] >= 0):
            axes[j] = np.array(_axis_of_turns()(turns[j], self.frames[j])).ravel()
        return axes

    def axis_covariance(self, solution: Solution) -> Array:
        """Return the covariance of v in R_b, (n_legs, 3, 3) [rad^2]; zero for legs without one."""
        turns = np.where(self.axes >= 0, solution.x[self.axes], 0.0)
        of_turns, found = solution.covariance(), np.zeros((len(self.axes), 3, 3))
        for j in np.flatnonzero(self.axes[:, 0] >= 0):
            slope = np.array(_slope_of_turns()(turns[j], self.frames[j]))
            found[j] = slope @ of_turns[np.ix_(self.axes[j], self.axes[j])] @ slope.T
        return found


def nominal_axes(mechanism: NominalMechanism) -> Array:
    """Return revolute axes at the base in R_b, (n_legs, 3), those of a plane included.

    They are z in a planar mechanism, where they are no parameters; NaN for other joints.
    """
    if mechanism.spatial:
        return mechanism.base_axes
    return np.tile([0.0, 0.0, 1.0], (mechanism.n_legs, 1))


def turned_axis(turns: ca.SX, frame: ca.SX) -> ca.SX:
    """Return a unit axis turned from its nominal direction.

    Parameters
    ----------
    turns : (2, 1) SX
        Turns w_1, w_2 about the normal basis [rad], as 2 tan(angle / 2) along w_1 e_1 + w_2 e_2:
        to second order those of :mod:`legcal.mechanism.parametrization`, and without a square root.
    frame : (3, 3) SX
        The nominal axis and its normal basis as columns.

    Returns
    -------
    (3, 1) SX
    """
    v, w = frame[:, 0], 0.5 * frame[:, 1:] @ turns
    across = ca.cross(w, v)
    return v + 2.0 / (1.0 + ca.dot(w, w)) * (across + ca.cross(w, across))


@cache
def _axis_of_turns() -> ca.Function:
    """Return (turns, frame) -> v, for numbers."""
    turns, frame = ca.SX.sym("turns", 2), ca.SX.sym("frame", 3, 3)
    return ca.Function("axis", [turns, frame], [turned_axis(turns, frame)])


@cache
def _slope_of_turns() -> ca.Function:
    """Return (turns, frame) -> derivative of v by the turns, (3, 2), for numbers."""
    turns, frame = ca.SX.sym("turns", 2), ca.SX.sym("frame", 3, 3)
    return ca.Function("slope", [turns, frame], [ca.jacobian(turned_axis(turns, frame), turns)])


def _numbered(free: BoolArray, first: int) -> IntArray:
    """Return consecutive numbers where something is free, -1 elsewhere."""
    numbers = np.full(free.shape, -1, dtype=np.intp)
    numbers[free] = first + np.arange(free.sum())
    return numbers
