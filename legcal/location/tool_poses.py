"""Tool poses measured in the world, with the readings at which they were measured."""

from __future__ import annotations

from dataclasses import dataclass

from legcal.geometry.types import Array, BoolArray, IntArray


@dataclass(frozen=True, eq=False)
class ToolPoses:
    """What a laser tracker, a CMM or a camera measured, one row a pose.

    Attributes
    ----------
    q : (n, n_legs) array
        Readings in the order of the legs [m]; NaN for legs without a motor.
    position : (n, 3) array
        Of the tool in the world [m].
    rotation : (n, 3, 3) array
        T_world_tool; the identity where only the position was measured.
    oriented : (n,) array of bool
        Where the orientation was measured too.
    position_sigma, angle_sigma : (n,) array or None
        Standard deviation of each component [m], [rad]; None if not stated.
    numbers : (n,) array of int
        Of the rows in the file, from 1.
    notes : tuple of str
        What is odd but allowed.
    """

    q: Array
    position: Array
    rotation: Array
    oriented: BoolArray
    position_sigma: Array | None
    angle_sigma: Array | None
    numbers: IntArray
    notes: tuple[str, ...] = ()

    def __len__(self) -> int:
        return len(self.position)
