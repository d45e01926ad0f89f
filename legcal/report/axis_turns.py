"""Axes are written as turns of the nominal ones; here as turns of the calibrated ones."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from legcal.geometry.lines import normal_basis
from legcal.geometry.types import Array
from legcal.mechanism.leg_geometry import LegGeometry
from legcal.mechanism.leg_steps import turn_of

_STEP = 1e-6  # [rad]

Axes = Mapping[str, Sequence[float]]  # by leg name, in R_b or R_e


def nominal_axes(
    leg_names: Sequence[str], nominal: Sequence[LegGeometry]
) -> dict[str, dict[str, list[float]]]:
    """Return the axes that turns count from, at the base in R_b and at the platform in R_e.

    Parameters
    ----------
    leg_names : sequence of str
        Names of the legs.
    nominal : sequence of LegGeometry
        The nominal legs in R_b and R_e.
    """
    named = list(zip(leg_names, nominal, strict=True))
    return {
        "base": {name: leg.base_axis.tolist() for name, leg in named if leg.base_axis is not None},
        "platform": {
            name: leg.platform_axis.tolist() for name, leg in named if leg.platform_axis is not None
        },
    }


def turns_between(
    nominal: Mapping[str, Axes], values: Mapping[str, float], names: Sequence[str]
) -> Array:
    """Return the derivative (n, n) of parameters with calibrated axes by those with nominal ones.

    Parameters
    ----------
    nominal : mapping
        What :func:`nominal_axes` gave.
    values : mapping
        All parameters by name, axes as turns of the nominal ones.
    names : sequence of str
        The parameters of rows and columns.
    """
    place = {name: i for i, name in enumerate(names)}
    turns = np.eye(len(names))
    for side, axes in nominal.items():
        for leg, axis in axes.items():
            both = [f"{leg}.{side}_axis.{k}" for k in (1, 2)]
            kept = [k for k in range(2) if both[k] in place]
            at = [place[both[k]] for k in kept]
            w = np.array([values.get(name, 0.0) for name in both])
            turns[np.ix_(at, at)] = _turns_of(np.array(axis), w)[np.ix_(kept, kept)]
    return turns


def calibrated_axis(
    nominal: Sequence[float], leg: str, side: str, values: Mapping[str, float]
) -> Array:
    """Return the axis (3,) that a result has, from the nominal one and its turns."""
    w = np.array([values.get(f"{leg}.{side}_axis.{k}", 0.0) for k in (1, 2)])
    return np.asarray(turn_of(np.array(nominal), w).apply(nominal))


def _turns_of(nominal: Array, w: Array) -> Array:
    """Return the derivative (2, 2) of turns of the calibrated axis by those of the nominal one."""
    axis = turn_of(nominal, w).apply(nominal)
    columns = []
    for k in range(2):
        ends = [
            turn_of(nominal, w + step * np.eye(2)[k]).apply(nominal) for step in (-_STEP, _STEP)
        ]
        columns.append(normal_basis(axis) @ np.cross(axis, (ends[1] - ends[0]) / (2.0 * _STEP)))
    return np.column_stack(columns)
