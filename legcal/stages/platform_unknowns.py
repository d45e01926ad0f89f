"""The unknowns of step 4: joints and axes on the platform, lengths, universal axes, twists.

They are some of the parameters of :mod:`legcal.mechanism.parametrization`, in its order. Base
joints and revolute axes of the base are known from step 2.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from legcal.geometry.lines import normal_basis
from legcal.geometry.types import Array, BoolArray, IntArray
from legcal.mechanism.leg_geometry import N_LOCAL, LegGeometry
from legcal.mechanism.parametrization import Parametrization, parametrize, tied_twist
from legcal.stages.nominal import NominalMechanism

B_COLUMNS, LENGTH, BASE_TURNS, PLATFORM_TURNS, TWIST = slice(3, 6), 6, slice(7, 9), slice(9, 11), 11


@dataclass(frozen=True, eq=False)
class PlatformUnknowns:
    """Where the numbers of each leg stand among the shared unknowns of step 4.

    Attributes
    ----------
    parametrization : Parametrization
        All parameters of the mechanism.
    parameters : (n,) array of int
        Which of them are unknowns of step 4, rising: free coordinates of B [m], offsets and
        lengths [m], turns of universal axes at the base and of axes at the platform, changes
        of twists [rad].
    nominal : tuple of LegGeometry
        What turns of axes and changes of twists count from.
    """

    parametrization: Parametrization
    parameters: IntArray
    nominal: tuple[LegGeometry, ...]

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
    def held(self) -> Array:
        """Coordinates of B that are no unknowns, at nominal, (n_legs, 3) [m]; zero the others."""
        B = np.array([leg.B for leg in self.nominal])
        return np.where(self.place[:, B_COLUMNS] < 0, B, 0.0)

    def vector(self, legs: Sequence[LegGeometry]) -> Array:
        """Return the unknowns of legs, (n,)."""
        local = np.zeros(self.place.shape)
        for row, leg, nominal in zip(local, legs, self.nominal, strict=True):
            row[B_COLUMNS], row[LENGTH] = leg.B, leg.q0
            row[BASE_TURNS] = turns_of(leg.base_axis, nominal.base_axis)
            row[PLATFORM_TURNS] = turns_of(leg.platform_axis, nominal.platform_axis)
        x = np.zeros(len(self))
        x[self.place[self.place >= 0]] = local[self.place >= 0]
        return x

    def legs(self, x: Array, legs: Sequence[LegGeometry]) -> tuple[LegGeometry, ...]:
        """Return legs with the unknowns at values x (n,)."""
        padded = np.append(x, 0.0)
        found = []
        for leg, nominal, place, B in zip(legs, self.nominal, self.place, self.held, strict=True):
            local = padded[place]
            moved = replace(
                leg,
                B=local[B_COLUMNS] + B,
                q0=float(local[LENGTH]) if place[LENGTH] >= 0 else leg.q0,
                base_axis=leg.base_axis
                if place[BASE_TURNS.start] < 0
                else turned_axis(nominal.base_axis, local[BASE_TURNS]),
                platform_axis=turned_axis(nominal.platform_axis, local[PLATFORM_TURNS]),
            )
            if nominal.twist is not None:
                moved = replace(
                    moved, twist=tied_twist(moved, nominal, nominal.twist + float(local[TWIST]))
                )
            found.append(moved)
        return tuple(found)


def platform_unknowns(
    mechanism: NominalMechanism, *, free_twists: bool = False
) -> PlatformUnknowns:
    """Return the unknowns of step 4 of a mechanism; twists are held unless they are freed."""
    legs = mechanism.legs
    everything = parametrize(mechanism.leg_names, legs, mechanism.frame_legs, twists=free_twists)
    wanted = np.ones((len(legs), N_LOCAL), dtype=np.bool_)
    wanted[:, :3] = False
    wanted[:, BASE_TURNS] = np.array([[leg.base_joint != "R"] for leg in legs])
    place = everything.place[wanted & (everything.place >= 0)]
    return PlatformUnknowns(everything, np.sort(place), legs)


def turns_of(axis: Array | None, nominal: Array | None) -> Array:
    """Return the two turns that take a nominal axis to an axis, both as lines, (2,).

    They are twice the Gibbs vector of the smallest rotation, along the :func:`normal_basis` of
    the nominal axis: its rotation vector but for the cube of the angle, without a root.
    """
    if axis is None or nominal is None:
        return np.zeros(2)
    axis = axis if axis @ nominal > 0.0 else -axis
    gibbs = np.cross(nominal, axis) / (1.0 + float(nominal @ axis))
    return np.asarray(2.0 * normal_basis(nominal) @ gibbs)


def turned_axis(nominal: Array | None, turns: Array) -> Array | None:
    """Return the axis to which two turns take the nominal one; see :func:`turns_of`."""
    if nominal is None or not turns.any():
        return nominal
    gibbs = 0.5 * turns @ normal_basis(nominal)
    across = np.cross(gibbs, nominal)
    axis = nominal + 2.0 / (1.0 + gibbs @ gibbs) * (across + np.cross(gibbs, across))
    return np.asarray(axis / np.linalg.norm(axis))
