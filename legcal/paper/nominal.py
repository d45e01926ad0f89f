"""The machine of the steps: nominal legs at first, in R_b and R_e, identified legs at last.

Every step takes such a machine and returns it with its estimates.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from legcal.geometry.types import Array, BoolArray
from legcal.machine.actuator import Actuator
from legcal.machine.leg import (
    EquationKind,
    KinematicParameters,
    Leg,
    LegKind,
    parameters_of_legs,
)
from legcal.machine.model import Machine
from legcal.machine.parameters import geometries, is_spatial


@dataclass(frozen=True, eq=False)
class NominalMachine:
    """The legs of a machine at the start of a step, and their unknowns."""

    leg_names: tuple[str, ...]
    legs: tuple[Leg, ...]  # geometry of the base in R_b, of the platform in R_e
    frame_legs: tuple[int, ...]  # their joints define R_b and R_e: three in space, two in a plane

    @property
    def n_legs(self) -> int:
        """Number of legs."""
        return len(self.legs)

    @cached_property
    def sign(self) -> Array:
        """Whether each leg grows (+1) or shrinks (-1) with its reading, (n_legs,)."""
        return np.array([float(leg.sign) for leg in self.legs])

    @property
    def spatial(self) -> bool:
        """Whether the platform moves in space and not in a plane."""
        return is_spatial(self.frame_legs)

    @cached_property
    def parameters(self) -> KinematicParameters:
        """Joint centres and offsets [m]; constant legs have their length."""
        return parameters_of_legs(self.legs)

    @cached_property
    def offsets(self) -> Array:
        """Offsets, (n_legs,) [m]; NaN for passive legs, like their readings."""
        passive = np.array([leg.kind is LegKind.PASSIVE for leg in self.legs])
        return np.where(passive, np.nan, self.parameters.offsets)

    @cached_property
    def constant(self) -> BoolArray:
        """Mask of the legs with a constant length and no reading, (n_legs,)."""
        return np.array([leg.kind is LegKind.CONSTANT for leg in self.legs], dtype=np.bool_)

    @cached_property
    def actuators(self) -> dict[int, Actuator]:
        """The actuators that move joints at A of legs that are rods, by leg."""
        return {j: leg.actuator for j, leg in enumerate(self.legs) if leg.actuator is not None}

    @cached_property
    def on_platform(self) -> BoolArray:
        """Mask of the legs that are fixed to the platform, (n_legs,)."""
        return np.array([leg.is_fixed_to_platform for leg in self.legs], dtype=np.bool_)

    @cached_property
    def revolute(self) -> BoolArray:
        """Mask of the legs with a revolute axis at the base as a parameter, (n_legs,)."""
        constrained = [EquationKind.BASE_AXIS in leg.equations for leg in self.legs]
        return np.array(constrained, dtype=np.bool_)

    @cached_property
    def base_axes(self) -> Array:
        """Revolute axes in R_b, (n_legs, 3); NaN where :attr:`revolute` is not."""
        axes = np.full((self.n_legs, 3), np.nan)
        for j in np.flatnonzero(self.revolute):
            axes[j] = self.legs[j].base_axis
        return axes

    @cached_property
    def base_normals(self) -> Array:
        """:attr:`base_axes`; in a planar machine z for all, where it is no parameter."""
        return self.base_axes if self.spatial else np.tile([0.0, 0.0, 1.0], (self.n_legs, 1))


def nominal_machine(machine: Machine) -> NominalMachine:
    """Return the nominal machine of the steps."""
    return NominalMachine(machine.leg_names, geometries(machine), machine.frame_legs)
