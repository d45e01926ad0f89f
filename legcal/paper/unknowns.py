"""The unknowns of a step: some of the kinematic parameters of the legs, relative to a start.

The unknowns are joint centres and lengths [m], two rotations of each axis from the start
(:func:`~legcal.paper.gibbs.gibbs_of` the angles), and changes of twists [rad]. Rods on the same
actuator share its numbers; its gain is not an unknown of the steps.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from legcal.geometry.types import Array, BoolArray, IntArray
from legcal.machine.actuator import ActuatorColumns
from legcal.machine.leg import Leg, LegColumns
from legcal.machine.parameters import Parametrization, numbers_of, parametrize, with_numbers
from legcal.paper.gibbs import angles_of, axis_frames, gibbs_of
from legcal.paper.nominal import NominalMachine

_AXES = (LegColumns.BASE_AXIS, LegColumns.PLATFORM_AXIS, ActuatorColumns.AXIS)


@dataclass(frozen=True, eq=False)
class Unknowns:
    """The parameters that a step estimates, with the indices of each leg among them."""

    parametrization: Parametrization  # of all parameters of the machine
    parameters: IntArray  # (n,), ascending: indices of the unknown parameters
    start: tuple[Leg, ...]  # reference of rotations of axes and changes of twists

    @classmethod
    def of_base(cls, machine: NominalMachine) -> Unknowns:
        """Return the unknowns of step 2: base joints, revolute axes at the base, and actuators."""
        columns = np.zeros((machine.n_legs, LegColumns.COUNT), dtype=np.bool_)
        columns[:, LegColumns.A] = True
        columns[:, LegColumns.BASE_AXIS] = machine.revolute[:, None]
        columns[:, ActuatorColumns.AXIS] = columns[:, ActuatorColumns.POINT] = True
        return cls._among(machine, columns)

    @classmethod
    def of_lengths(cls, machine: NominalMachine) -> Unknowns:
        """Return the unknowns of step 3: offsets and constant lengths."""
        columns = np.zeros((machine.n_legs, LegColumns.COUNT), dtype=np.bool_)
        columns[:, LegColumns.LENGTH] = True
        return cls._among(machine, columns)

    @classmethod
    def of_platform(cls, machine: NominalMachine, *, free_twists: bool = False) -> Unknowns:
        """Return the unknowns of step 4: all but those of step 2; twists only if freed."""
        columns = np.ones((machine.n_legs, LegColumns.COUNT), dtype=np.bool_)
        columns[:, LegColumns.A] = False
        columns[:, LegColumns.OWN :] = False
        columns[:, LegColumns.BASE_AXIS] = ~machine.revolute[:, None]
        return cls._among(machine, columns, free_twists=free_twists)

    @classmethod
    def _among(
        cls, machine: NominalMachine, columns: BoolArray, *, free_twists: bool = False
    ) -> Unknowns:
        legs = machine.legs
        parametrization = parametrize(
            machine.leg_names, legs, machine.frame_legs, twists=free_twists
        )
        return cls(
            parametrization,
            np.sort(parametrization.place[columns & (parametrization.place >= 0)]),
            legs,
        )

    def __len__(self) -> int:
        return len(self.parameters)

    @cached_property
    def place(self) -> IntArray:
        """Indices of each leg's numbers (LegColumns) among the unknowns, (n_legs, 21), or -1."""
        place = np.full(len(self.parametrization) + 1, -1, dtype=np.intp)
        place[self.parameters] = np.arange(len(self))
        return np.asarray(place[self.parametrization.place])

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the unknowns."""
        return tuple(self.parametrization.names[i] for i in self.parameters)

    @property
    def is_angle(self) -> BoolArray:
        """Mask (n,) of the unknowns that are angles [rad] rather than lengths [m]."""
        return np.array([self.parametrization.units[i] == "rad" for i in self.parameters])

    @property
    def known_A(self) -> Array:
        """Known coordinates of A, zero for unknown ones, (n_legs, 3) [m]."""
        return np.where(self.place[:, LegColumns.A] < 0, [leg.A for leg in self.start], 0.0)

    @property
    def known_B(self) -> Array:
        """Known coordinates of B, zero for unknown ones, (n_legs, 3) [m]."""
        return np.where(self.place[:, LegColumns.B] < 0, [leg.B for leg in self.start], 0.0)

    @cached_property
    def base_frames(self) -> Array:
        """Start of axes at the base and their normal bases as columns, (n_legs, 3, 3).

        Zero for legs without an axis.
        """
        return _frames([leg.base_axis for leg in self.start])

    @cached_property
    def actuator_frames(self) -> Array:
        """The same of the axes of actuators."""
        return _frames([None if leg.actuator is None else leg.actuator.axis for leg in self.start])

    @cached_property
    def actuator_points(self) -> Array:
        """The reference points of these axes, (n_legs, 3) [m]."""
        return np.array(
            [np.zeros(3) if leg.actuator is None else leg.actuator.point for leg in self.start]
        )

    def vector(self, legs: Sequence[Leg]) -> Array:
        """Return the unknowns of legs, (n,)."""
        local = numbers_of(legs, self.start)
        for columns in _AXES:
            local[:, columns] = gibbs_of(local[:, columns])
        local[:, LegColumns.TWIST] -= [leg.twist or 0.0 for leg in self.start]
        x = np.zeros(len(self))
        x[self.place[self.place >= 0]] = local[self.place >= 0]
        return x

    def legs(self, x: Array, legs: Sequence[Leg]) -> tuple[Leg, ...]:
        """Return legs with the unknowns at the first values of x."""
        local = np.append(x[: len(self)], 0.0)[self.place]
        for columns in _AXES:
            local[:, columns] = angles_of(local[:, columns])
        local[:, LegColumns.TWIST] += [leg.twist or 0.0 for leg in self.start]
        return with_numbers(legs, self.start, local, self.place >= 0)


def _frames(axes: Sequence[Array | None]) -> Array:
    frames = np.zeros((len(axes), 3, 3))
    for j, axis in enumerate(axes):
        if axis is not None:
            frames[j] = axis_frames(axis[None])[0]
    return frames
