"""The unknowns of a step: some of the kinematic parameters of the legs, counted from a start.

Joint centres and lengths are unknown as they are [m], axes by two turns from where the step starts
(:func:`~legcal.paper.gibbs.gibbs_of` the angles), twists by their change [rad]. Rods on the same
actuator share its numbers; its gain is no unknown of the steps.
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
    """Which parameters a step estimates, and where the numbers of each leg stand among them."""

    parametrization: Parametrization  # of all parameters of the machine
    parameters: IntArray  # (n,), rising: which of them are unknown
    start: tuple[Leg, ...]  # what turns of axes and changes of twists count from

    @classmethod
    def of_base(cls, machine: NominalMachine) -> Unknowns:
        """Return those of step 2: base joints, revolute axes at the base, and actuators."""
        columns = np.zeros((machine.n_legs, LegColumns.COUNT), dtype=np.bool_)
        columns[:, LegColumns.A] = True
        columns[:, LegColumns.BASE_AXIS] = machine.revolute[:, None]
        columns[:, ActuatorColumns.AXIS] = columns[:, ActuatorColumns.POINT] = True
        return cls._among(machine, columns)

    @classmethod
    def of_lengths(cls, machine: NominalMachine) -> Unknowns:
        """Return those of step 3: offsets and constant lengths."""
        columns = np.zeros((machine.n_legs, LegColumns.COUNT), dtype=np.bool_)
        columns[:, LegColumns.LENGTH] = True
        return cls._among(machine, columns)

    @classmethod
    def of_platform(cls, machine: NominalMachine, *, free_twists: bool = False) -> Unknowns:
        """Return those of step 4: all that step 2 does not estimate; twists only if freed."""
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
        every = parametrize(machine.leg_names, legs, machine.frame_legs, twists=free_twists)
        return cls(every, np.sort(every.place[columns & (every.place >= 0)]), legs)

    def __len__(self) -> int:
        return len(self.parameters)

    @cached_property
    def place(self) -> IntArray:
        """Where each leg's numbers (LegColumns) are among the unknowns, (n_legs, 21), or -1."""
        place = np.full(len(self.parametrization) + 1, -1, dtype=np.intp)
        place[self.parameters] = np.arange(len(self))
        return np.asarray(place[self.parametrization.place])

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the unknowns."""
        return tuple(self.parametrization.names[i] for i in self.parameters)

    @property
    def is_angle(self) -> BoolArray:
        """Which unknowns are angles [rad] and no lengths [m], (n,)."""
        return np.array([self.parametrization.units[i] == "rad" for i in self.parameters])

    @property
    def known_A(self) -> Array:
        """Coordinates of A that are no unknowns, zero for the others, (n_legs, 3) [m]."""
        return np.where(self.place[:, LegColumns.A] < 0, [leg.A for leg in self.start], 0.0)

    @property
    def known_B(self) -> Array:
        """The same of B."""
        return np.where(self.place[:, LegColumns.B] < 0, [leg.B for leg in self.start], 0.0)

    @cached_property
    def base_frames(self) -> Array:
        """Start of axes at the base and their normal bases as columns, (n_legs, 3, 3).

        Zero for legs without one.
        """
        return _frames([leg.base_axis for leg in self.start])

    @cached_property
    def actuator_frames(self) -> Array:
        """The same of the axes of actuators."""
        return _frames([None if leg.actuator is None else leg.actuator.axis for leg in self.start])

    @cached_property
    def actuator_points(self) -> Array:
        """The points of these axes from which their places count, (n_legs, 3) [m]."""
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
        """Return legs with the unknowns at values of which these are the first."""
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
