"""The kinematic parameters xi of section 2: their names, units and gauge.

The frames R_b and R_e are built on the joint centres of N_d legs: origin, x axis, xy
plane. The coordinates that this makes zero are not parameters: 12 + 12 + 6 = 30 remain for
a 6-SPU.

This is the vector of machines with point-like joints, which steps and fit use;
:mod:`legcal.mechanism.parametrization` has that of every class, with axes and twists.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from legcal.geometry.types import Array, BoolArray


@dataclass(frozen=True, eq=False)
class KinematicParameters:
    """The parameters of a mechanism with point-like joints, in R_b and R_e.

    Attributes
    ----------
    base_joints : (n_legs, 3) array
        Base joint centres A in R_b [m].
    platform_joints : (n_legs, 3) array
        Platform joint centres B in R_e [m].
    offsets : (n_legs,) array
        q0 for actuated legs, the length for constant ones, NaN for passive ones [m].
    """

    base_joints: Array
    platform_joints: Array
    offsets: Array


def n_frame_legs(*, spatial: bool) -> int:
    """Return N_d, the number of legs whose joints define a frame."""
    return 3 if spatial else 2


def free_coordinates(n_legs: int, frame_legs: Sequence[int]) -> BoolArray:
    """Return which joint coordinates are parameters and not zero by the frame's definition.

    Two frame legs belong to a planar mechanism, whose heights z are no parameters.

    Parameters
    ----------
    n_legs : int
        Number of legs.
    frame_legs : sequence of 3 or 2 int
        The legs whose joint centres are origin, x axis and xy plane of the frame.

    Returns
    -------
    (n_legs, 3) array of bool
    """
    free = np.ones((n_legs, 3), dtype=np.bool_)
    free[:, 2] = len(frame_legs) == 3
    for rank, leg in enumerate(frame_legs):
        free[leg, rank:] = False
    return free


def parameter_names(leg_names: Sequence[str], frame_legs: Sequence[int]) -> tuple[str, ...]:
    """Return the parameter names, in the order of :func:`to_vector`."""
    free = free_coordinates(len(leg_names), frame_legs)
    joints = [
        f"{name}.{side}.{'xyz'[axis]}"
        for side in ("base", "platform")
        for leg, name in enumerate(leg_names)
        for axis in range(3)
        if free[leg, axis]
    ]
    return (*joints, *(f"{name}.offset" for name in leg_names))


def radius_name(leg_name: str, part: str) -> str:
    """Return the name of the radius of a cylinder of a leg."""
    return f"{leg_name}.radius.{part}"


def to_vector(parameters: KinematicParameters, frame_legs: Sequence[int]) -> Array:
    """Return the free parameters as one vector [m]: base joints, platform joints, offsets."""
    free = free_coordinates(len(parameters.offsets), frame_legs)
    return np.concatenate(
        [parameters.base_joints[free], parameters.platform_joints[free], parameters.offsets]
    )


def from_vector(vector: Array, n_legs: int, frame_legs: Sequence[int]) -> KinematicParameters:
    """Return the parameters of a vector laid out as in :func:`to_vector`."""
    free = free_coordinates(n_legs, frame_legs)
    n_free = int(free.sum())
    base, platform = np.zeros((n_legs, 3)), np.zeros((n_legs, 3))
    base[free] = vector[:n_free]
    platform[free] = vector[n_free : 2 * n_free]
    return KinematicParameters(base, platform, np.array(vector[2 * n_free :]))
