"""Freedoms of drawn machines by the screws of their joints, without anything of legcal.

The platform moves as every leg alone lets it: its twists are those in which the twists of all legs,
sums of the screws of their joints at home, have part.
"""

from typing import NamedTuple

import numpy as np
from layouts import LegSpec, MachineSpec
from scipy.linalg import null_space

from legcal.geometry.types import Array


class Freedoms(NamedTuple):
    """What the joints of a machine leave."""

    mobility: int
    n_constraints: int  # of all legs
    n_redundant: int  # of them, those that follow from others
    left_by_motors: int  # freedoms of the platform with all motors held


def freedoms_of(machine: MachineSpec) -> Freedoms:
    """Return the freedoms of a platform at home."""
    wrenches = [null_space(_twists(leg)).T for leg in machine.legs]
    held = [null_space(_twists(leg, with_slider=leg.kind != "actuated")).T for leg in machine.legs]
    free, with_motors = (np.linalg.matrix_rank(np.concatenate(w), 1e-9) for w in (wrenches, held))
    n = sum(map(len, wrenches))
    return Freedoms(6 - int(free), n, n - int(free), 6 - int(with_motors))


def _twists(leg: LegSpec, *, with_slider: bool = True) -> Array:
    """Return the screws (n, 6) of the joints of a leg: angular parts, velocities of the origin."""
    found = []
    ends = (leg.A, leg.base_axis), (leg.B_home, leg.platform_axis)
    for letter, (point, axis) in zip(leg.type, ends, strict=False):
        axes = np.eye(3)
        if letter != "S":
            outer = np.asarray(axis)
            axes = np.array([outer, np.cross(leg.u, outer)])[: {"R": 1, "U": 2}[letter]]
        found += [np.concatenate([w, np.cross(point, w)]) for w in axes]
    if with_slider and leg.kind != "constant":
        found.append(np.concatenate([np.zeros(3), leg.u]))
    return np.array(found)
