"""What can change at a machine: an offset, a length, a joint or axis that moved, a whole leg.

R_b and R_e are built on joint centres, so that one joint of a frame leg that moves changes the
coordinates of all others: every change is written in the parameters that it leads to.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import Rotation

from legcal.geometry.frames import frame_on_points
from legcal.geometry.lines import normal_basis
from legcal.geometry.types import Array
from legcal.mechanism.leg import LegKind
from legcal.mechanism.leg_geometry import LegGeometry
from legcal.mechanism.parametrization import Parametrization, twist_after, vector_of

_STEP = 1e-6  # [m or rad]


@dataclass(frozen=True, eq=False)
class Change:
    """One thing that may have changed.

    Attributes
    ----------
    what : str
        In words: ``offset of leg1``, ``base joint of leg2``, ``leg3``.
    components : tuple of str
        Its numbers: ``leg1.offset`` or ``x``, ``y``, ``z`` of R_b or R_e.
    units : tuple of str
        ``m`` or ``rad``.
    columns : (p, m) array
        Derivative of all parameters by them.
    """

    what: str
    components: tuple[str, ...]
    units: tuple[str, ...]
    columns: Array


def possible_changes(
    names: Sequence[str],
    legs: Sequence[LegGeometry],
    frame_legs: Sequence[int],
    parametrization: Parametrization,
) -> tuple[tuple[Change, ...], ...]:
    """Return what may have changed: single lengths and joints first, then whole legs.

    Parameters
    ----------
    names : sequence of str
        Leg names.
    legs : sequence of LegGeometry
        The legs in R_b and R_e.
    frame_legs : sequence of int
        The legs that define R_b and R_e.
    parametrization : Parametrization
        The parameters.

    Returns
    -------
    tuple of tuples of Change
        Those with one number, those of one joint, and those of one leg.
    """
    single, of_joints, of_legs = list[Change](), list[Change](), list[Change]()
    for j, (name, leg) in enumerate(zip(names, legs, strict=True)):
        of_leg = list[Change]()
        for what, components, unit, moved in _of_leg(name, leg):
            columns = np.column_stack(
                [
                    _derivative(moved, k, legs, j, frame_legs, parametrization)
                    for k in range(len(components))
                ]
            )
            found = np.any(np.abs(columns) > _STEP, axis=0)
            if not found.any():
                continue
            kept = tuple(c for c, is_found in zip(components, found, strict=True) if is_found)
            of_leg.append(Change(what, kept, (unit,) * len(kept), columns[:, found]))
        single += [change for change in of_leg if len(change.components) == 1]
        of_joints += [change for change in of_leg if len(change.components) > 1]
        if len(of_leg) > 1:
            of_legs.append(_together(name, of_leg))
    return tuple(single), tuple(of_joints), tuple(of_legs)


_Moved = Callable[[LegGeometry, int, float], LegGeometry]


def _of_leg(name: str, leg: LegGeometry) -> list[tuple[str, tuple[str, ...], str, _Moved]]:
    """Return what may change at one leg: in words, its numbers, their unit, and how."""
    found: list[tuple[str, tuple[str, ...], str, _Moved]] = []
    if leg.kind is not LegKind.PASSIVE:
        what = "length" if leg.kind is LegKind.CONSTANT else "offset"
        found.append((f"{what} of {name}", (f"{name}.{what}",), "m", _longer))
    xyz = ("x", "y", "z")
    found.append((f"base joint of {name}", xyz, "m", _base_moved))
    found.append((f"platform joint of {name}", xyz, "m", _platform_moved))
    if leg.base_axis is not None:
        found.append((f"base axis of {name}", ("1", "2"), "rad", _base_turned))
    if leg.platform_axis is not None:
        found.append((f"platform axis of {name}", ("1", "2"), "rad", _platform_turned))
    return found


def _longer(leg: LegGeometry, _: int, step: float) -> LegGeometry:
    return replace(leg, q0=leg.q0 + step)


def _base_moved(leg: LegGeometry, k: int, step: float) -> LegGeometry:
    return replace(leg, A=leg.A + step * np.eye(3)[k])


def _platform_moved(leg: LegGeometry, k: int, step: float) -> LegGeometry:
    return replace(leg, B=leg.B + step * np.eye(3)[k])


def _base_turned(leg: LegGeometry, k: int, step: float) -> LegGeometry:
    axis = leg.base_axis
    return leg if axis is None else replace(leg, base_axis=_about(axis, k, step).apply(axis))


def _platform_turned(leg: LegGeometry, k: int, step: float) -> LegGeometry:
    axis = leg.platform_axis
    if axis is None:
        return leg
    turn = _about(axis, k, step)
    return replace(leg, platform_axis=turn.apply(axis), twist=twist_after(leg, turn))


def _about(axis: Array, k: int, step: float) -> Rotation:
    return Rotation.from_rotvec(step * normal_basis(axis)[k])


def _derivative(
    moved: _Moved,
    component: int,
    legs: Sequence[LegGeometry],
    j: int,
    frame_legs: Sequence[int],
    parametrization: Parametrization,
) -> Array:
    """Return the derivative of the parameters (p,) by one number of leg j."""
    ends = []
    for step in (-_STEP, _STEP):
        changed = [*legs[:j], moved(legs[j], component, step), *legs[j + 1 :]]
        ends.append(vector_of(parametrization, in_own_frames(changed, frame_legs), legs))
    return np.asarray((ends[1] - ends[0]) / (2.0 * _STEP))


def in_own_frames(
    legs: Sequence[LegGeometry], frame_legs: Sequence[int]
) -> tuple[LegGeometry, ...]:
    """Return legs in the frames R_b and R_e that their own joint centres define."""
    frames = list(frame_legs)
    base = frame_on_points(np.array([leg.A for leg in legs])[frames]).inv()
    platform = frame_on_points(np.array([leg.B for leg in legs])[frames]).inv()
    return tuple(
        replace(
            leg,
            A=base.apply(leg.A),
            B=platform.apply(leg.B),
            base_axis=None if leg.base_axis is None else base.rotation.apply(leg.base_axis),
            platform_axis=None
            if leg.platform_axis is None
            else platform.rotation.apply(leg.platform_axis),
            twist=twist_after(leg, platform.rotation),
        )
        for leg in legs
    )


def _together(name: str, changes: Sequence[Change]) -> Change:
    """Return all that may change at one leg as one change."""
    return Change(
        name,
        tuple(
            component if "." in component else f"{change.what.split(' of ')[0]} {component}"
            for change in changes
            for component in change.components
        ),
        tuple(unit for change in changes for unit in change.units),
        np.concatenate([change.columns for change in changes], axis=1),
    )
