"""The unknowns of a step: some of the kinematic parameters of the legs, counted from a start.

Joint centres and lengths are unknown as they are [m], axes by two turns from where the step starts
(:func:`~legcal.paper.gibbs.turned_axis`), twists by their change [rad].
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from legcal.geometry import Array, BoolArray, IntArray
from legcal.machine import N_LOCAL, Leg, LegKind, Parametrization, parametrize, tied_twist
from legcal.paper.gibbs import axis_frames, turned_axis, turns_of
from legcal.paper.nominal import NominalMachine

# Columns among the twelve numbers of a leg
OF_A, OF_B, LENGTH = slice(0, 3), slice(3, 6), 6
BASE_TURNS, PLATFORM_TURNS, TWIST = slice(7, 9), slice(9, 11), 11


@dataclass(frozen=True, eq=False)
class Unknowns:
    """Which parameters a step estimates, and where the numbers of each leg stand among them."""

    parametrization: Parametrization  # of all parameters of the machine
    parameters: IntArray  # (n,), rising: which of them are unknown
    start: tuple[Leg, ...]  # what turns of axes and changes of twists count from

    @classmethod
    def of_base(cls, machine: NominalMachine) -> Unknowns:
        """Return those of step 2: base joints, and revolute axes at the base."""
        columns = np.zeros((machine.n_legs, N_LOCAL), dtype=np.bool_)
        columns[:, OF_A] = True
        columns[:, BASE_TURNS] = machine.revolute[:, None]
        return cls._among(machine, columns)

    @classmethod
    def of_lengths(cls, machine: NominalMachine) -> Unknowns:
        """Return those of step 3: offsets and constant lengths."""
        columns = np.zeros((machine.n_legs, N_LOCAL), dtype=np.bool_)
        columns[:, LENGTH] = True
        return cls._among(machine, columns)

    @classmethod
    def of_platform(cls, machine: NominalMachine, *, free_twists: bool = False) -> Unknowns:
        """Return those of step 4: all that step 2 does not estimate; twists only if freed."""
        columns = np.ones((machine.n_legs, N_LOCAL), dtype=np.bool_)
        columns[:, OF_A] = False
        columns[:, BASE_TURNS] = ~machine.revolute[:, None]
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
        """Place of each leg's twelve numbers among the unknowns, (n_legs, 12); -1 if known."""
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
        return np.where(self.place[:, OF_A] < 0, [leg.A for leg in self.start], 0.0)

    @property
    def known_B(self) -> Array:
        """The same of B."""
        return np.where(self.place[:, OF_B] < 0, [leg.B for leg in self.start], 0.0)

    @cached_property
    def base_frames(self) -> Array:
        """Start of axes at the base and their normal bases as columns, (n_legs, 3, 3).

        Zero for legs without one.
        """
        return _frames([leg.base_axis for leg in self.start])

    @cached_property
    def platform_frames(self) -> Array:
        """The same of axes at the platform."""
        return _frames([leg.platform_axis for leg in self.start])

    def vector(self, legs: Sequence[Leg]) -> Array:
        """Return the unknowns of legs, (n,)."""
        local = np.zeros(self.place.shape)
        for row, leg, start in zip(local, legs, self.start, strict=True):
            row[OF_A], row[OF_B] = leg.A, leg.B
            row[LENGTH] = 0.0 if leg.kind is LegKind.PASSIVE else leg.q0
            if leg.base_axis is not None and start.base_axis is not None:
                row[BASE_TURNS] = turns_of(leg.base_axis, start.base_axis)
            if leg.platform_axis is not None and start.platform_axis is not None:
                row[PLATFORM_TURNS] = turns_of(leg.platform_axis, start.platform_axis)
        x = np.zeros(len(self))
        x[self.place[self.place >= 0]] = local[self.place >= 0]
        return x

    def legs(self, x: Array, legs: Sequence[Leg]) -> tuple[Leg, ...]:
        """Return legs with the unknowns at values of which these are the first."""
        padded = np.append(x[: len(self)], 0.0)
        moved_legs = []
        for leg, start, place in zip(legs, self.start, self.place, strict=True):
            local = padded[place]
            moved = replace(
                leg,
                A=np.where(place[OF_A] >= 0, local[OF_A], leg.A),
                B=np.where(place[OF_B] >= 0, local[OF_B], leg.B),
                q0=float(local[LENGTH]) if place[LENGTH] >= 0 else leg.q0,
                base_axis=leg.base_axis
                if place[BASE_TURNS.start] < 0
                else turned(start.base_axis, local[BASE_TURNS]),
                platform_axis=leg.platform_axis
                if place[PLATFORM_TURNS.start] < 0
                else turned(start.platform_axis, local[PLATFORM_TURNS]),
            )
            if start.twist is not None:
                twist = start.twist + float(local[TWIST])
                moved = replace(moved, twist=tied_twist(moved, start, twist))
            moved_legs.append(moved)
        return tuple(moved_legs)


def turned(axis: Array | None, turns: Array) -> Array | None:
    """Return the axis to which two turns take another one, if there is one."""
    return None if axis is None else turned_axis(axis, turns)


def _frames(axes: Sequence[Array | None]) -> Array:
    frames = np.zeros((len(axes), 3, 3))
    for j, axis in enumerate(axes):
        if axis is not None:
            frames[j] = axis_frames(axis[None])[0]
    return frames
