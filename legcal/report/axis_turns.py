"""Axes are written as turns of the nominal ones; here as turns of the calibrated ones."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from legcal.geometry.types import Array
from legcal.mechanism.leg_geometry import LegGeometry
from legcal.mechanism.leg_steps import moved_legs, turn_of
from legcal.mechanism.parametrization import Parametrization, vector_of

_STEP = 1e-6  # [m or rad]

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
    parametrization: Parametrization,
    calibrated: Sequence[LegGeometry],
    nominal: Sequence[LegGeometry],
) -> Array:
    """Return the derivative (p, p) of parameters with calibrated axes by those with nominal ones.

    Twists, which are tied to axes, depend on these and on the turns of the axes.

    Parameters
    ----------
    parametrization : Parametrization
        The parameters of rows and columns.
    calibrated, nominal : sequence of LegGeometry
        The legs at which the derivative is taken, and those whose axes counted as zero before.
    """
    by_step = []
    for start in (calibrated, nominal):
        columns = []
        for step in _STEP * np.eye(len(parametrization)):
            ahead, behind = (
                vector_of(parametrization, moved_legs(calibrated, parametrization.place, by), start)
                for by in (step, -step)
            )
            columns.append((ahead - behind) / (2.0 * _STEP))
        by_step.append(np.column_stack(columns))
    return np.asarray(np.linalg.solve(by_step[1].T, by_step[0].T).T)


def calibrated_axis(
    nominal: Sequence[float], leg: str, side: str, values: Mapping[str, float]
) -> Array:
    """Return the axis (3,) that a result has, from the nominal one and its turns."""
    w = np.array([values.get(f"{leg}.{side}_axis.{k}", 0.0) for k in (1, 2)])
    return np.asarray(turn_of(np.array(nominal), w).apply(nominal))
