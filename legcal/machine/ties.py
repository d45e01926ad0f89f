"""Ties: equations between the parameters of legs that hold exactly, whatever is measured.

A leg that is fixed to the platform and defines R_e has B at its
:func:`~legcal.machine.leg.frame_point`: sliding B along the leg together with its offset
shows nowhere. Parameters move on the manifold where all ties hold.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from legcal.geometry import Array, cross, normal_basis
from legcal.machine.leg import Leg, LegColumns, frame_point


class TieRows(NamedTuple):
    """Ties at some legs."""

    values: Array  # (m,) what is left of each [m]
    by_local: Array  # (m, n_legs, 12) derivative by the numbers of legs (LegColumns)


@dataclass(frozen=True)
class Ties:
    """What ties the parameters of the legs of a machine."""

    frame_legs: tuple[int, ...]
    points: tuple[int, ...]  # the frame legs that are fixed to the platform

    def at(self, legs: Sequence[Leg]) -> TieRows:
        """Return the ties at legs in R_b and R_e."""
        values, rows = np.zeros(len(self.points)), []
        for i, j in enumerate(self.points):
            value, row = self._point(legs, j)
            values[i] = value
            rows.append(row)
        by_local = np.array(rows).reshape(len(rows), len(legs), LegColumns.COUNT)
        return TieRows(values, by_local)

    def _point(self, legs: Sequence[Leg], leg: int) -> tuple[float, Array]:
        """Return how far B of a leg is past its frame point, and the derivative (n_legs, 12)."""
        B, u = legs[leg].B, np.asarray(legs[leg].platform_axis)
        others = [j for j in self.frame_legs if j not in self.points]
        row = np.zeros((len(legs), LegColumns.COUNT))
        row[leg, LegColumns.B] = u
        away = B - np.mean([legs[j].B for j in others], axis=0)
        row[leg, LegColumns.PLATFORM_AXIS] = cross(normal_basis(u), u) @ away
        for j in others:
            row[j, LegColumns.B] -= u / len(others)
        if len(others) == 2:
            between = legs[others[0]].B - legs[others[1]].B
            between /= np.linalg.norm(between)
            row[others[0], LegColumns.B] -= 0.5 * between
            row[others[1], LegColumns.B] += 0.5 * between
        return float((B - frame_point(legs, self.frame_legs, leg)) @ u), row


def ties_of(legs: Sequence[Leg], frame_legs: Sequence[int]) -> Ties:
    """Return the ties of a machine from its nominal legs in R_b and R_e."""
    fixed = [j for j in frame_legs if legs[j].is_fixed_to_platform]
    defined = any(not legs[j].is_fixed_to_platform for j in frame_legs)
    return Ties(tuple(frame_legs), tuple(fixed) if defined else ())
