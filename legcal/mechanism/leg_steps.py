"""Steps of the parameters of legs: joint centres, lengths, turns of axes, twists."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from scipy.spatial.transform import Rotation

from legcal.geometry.lines import normal_basis
from legcal.geometry.types import Array, IntArray
from legcal.mechanism.leg_geometry import LegGeometry
from legcal.mechanism.parametrization import twist_after


def moved_legs(
    legs: Sequence[LegGeometry], place: IntArray, step: Array
) -> tuple[LegGeometry, ...]:
    """Return legs after a small step of the parameters, which stand at *place* of it."""
    padded = np.append(step, 0.0)
    moved = []
    for leg, local in zip(legs, padded[place], strict=True):
        twist = leg.twist
        if twist is not None:
            twist = twist_after(leg, turn_of(leg.platform_axis, local[9:11]))
        moved.append(
            replace(
                leg,
                A=leg.A + local[:3],
                B=leg.B + local[3:6],
                q0=leg.q0 + float(local[6]),
                base_axis=turned(leg.base_axis, local[7:9]),
                platform_axis=turned(leg.platform_axis, local[9:11]),
                twist=None if twist is None else twist + float(local[11]),
            )
        )
    return tuple(moved)


def footed(legs: Sequence[LegGeometry], origin: Array) -> tuple[LegGeometry, ...]:
    """Return legs with B where models put it on those that are fixed to the platform.

    Nothing depends on where B lies on the line of such a leg; models take the foot of the platform
    link's origin.

    Parameters
    ----------
    legs : sequence of LegGeometry
        Legs in R_b and R_e.
    origin : (3,) array
        Origin of the platform link in R_e [m].
    """
    found = []
    for leg in legs:
        if leg.platform_joint == "" and leg.platform_axis is not None:
            along = float((origin - leg.B) @ leg.platform_axis)
            leg = replace(leg, B=leg.B + along * leg.platform_axis, q0=leg.q0 + along)
        found.append(leg)
    return tuple(found)


def turned(axis: Array | None, turn: Array) -> Array | None:
    """Return an axis turned by two angles about its :func:`normal_basis`."""
    return None if axis is None else np.asarray(turn_of(axis, turn).apply(axis))


def turn_of(axis: Array | None, turn: Array) -> Rotation:
    """Return the rotation by two angles about the :func:`normal_basis` of an axis."""
    return Rotation.from_rotvec(np.zeros(3) if axis is None else turn @ normal_basis(axis))
