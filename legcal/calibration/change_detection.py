"""Change detection: whether the geometry of a machine has changed since its calibration.

A few new images are fitted twice: with wide priors, so that no plausible change is rejected as an
outlier, and with the earlier result as prior. The reduction of the squares by the free fit has an F
distribution if nothing moved. Unlike a difference of parameters, this likelihood ratio is not
affected by several minima of equal cost.

The change itself is identified from the difference of the free fit and the earlier result, with the
covariance of both. Directions that the new images determine worse than the priors do not count.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.special import fdtrc

from legcal.errors import NotIdentifiable
from legcal.geometry.covariances import whitener
from legcal.geometry.types import Array
from legcal.machine.actuator import Actuator, ActuatorColumns, Line
from legcal.machine.leg import Leg, LegColumns, LegKind
from legcal.machine.model import Machine
from legcal.machine.parameters import (
    Parametrization,
    geometries,
    in_joint_frames,
    moved_legs,
    vector_of,
)
from legcal.machine.rods import actuator_index, actuators_of

_STEP = 1e-6  # step of numerical derivatives [rad, mean leg lengths]


@dataclass(frozen=True, eq=False)
class Change:
    """A possible change of the geometry."""

    part: str  # offset, base joint; "" for all of the owner
    owner: str  # a leg, or a motor that moves joints at A
    components: tuple[str, ...]  # names of the changed values: leg1.offset or x, y, z
    units: tuple[str, ...]  # m or rad
    links: tuple[str, ...]  # links of the axes of coordinates; empty for other components
    columns: Array  # (p, m): derivative of all parameters by the components

    @property
    def what(self) -> str:
        """Description: offset of leg1, base joint of leg2, leg3."""
        return f"{self.part} of {self.owner}" if self.part else self.owner


@dataclass(frozen=True, eq=False)
class Explanation:
    """A change with its fitted amount and the remaining statistic."""

    change: Change
    values: Array  # (m,): amounts [m or rad]
    sigma: Array  # (m,)
    remaining: float  # statistic that the change does not explain
    p_value: float  # probability of a larger remaining statistic if nothing else changed


@dataclass(frozen=True, eq=False)
class LikelihoodRatio:
    """Reduction of the squares by a fit with wide priors, relative to one with the earlier result.

    Along a direction with posterior variance v, relative to that of the wide prior, the reduction
    is 1 - v times a chi2 variable with one degree of freedom.
    """

    saved: float  # reduction of the squares, in variances of the noise
    parts: Array  # (p,): 1 - v by direction

    @classmethod
    def of(cls, saved: float, covariance: Array, prior: Array) -> LikelihoodRatio:
        """Return the ratio for a *covariance* (p, p) and priors as in :func:`difference`."""
        v = np.linalg.eigvalsh(covariance / np.outer(prior, prior))
        return cls(saved, np.clip(1.0 - v, 0.0, 1.0))

    def p_value(self, noise_dof: int) -> float:
        """Return the probability of a larger reduction if nothing moved, by moment matching."""
        mean, variance = float(np.sum(self.parts)), 2.0 * float(np.sum(self.parts**2))
        return float(fdtrc(2.0 * mean**2 / variance, max(noise_dof, 1), self.saved / mean))


@dataclass(frozen=True, eq=False)
class Movement:
    """Test of an earlier result by new images."""

    statistic: float  # reduction of the squares by the free fit
    dof: int  # number of compared directions
    noise_dof: int  # degrees of freedom of the noise of the new images
    p_value: float  # probability of a larger statistic if nothing moved
    significance: float  # largest p-value of a movement
    explanations: tuple[Explanation, ...]  # the best first; empty if nothing moved

    @property
    def moved(self) -> bool:
        """Whether something has moved."""
        return self.p_value < self.significance


def difference(
    values: Array,  # (p,): parameters by the new images and the priors
    covariance: Array,  # (p, p): covariance of the values, priors included
    prior: Array,  # (p,): standard deviations of the priors, with the earlier result as mean
    old: Array,  # (p,): parameters of the earlier result
    old_covariance: Array,  # (p, p)
) -> tuple[Array, Array, Array]:
    """Return the determined directions (k, p), the differences (k,) and their covariance (k, k).

    Directions are derivatives by the parameters, each in sigmas of its prior.

    Raises
    ------
    NotIdentifiable
        If the new images determine nothing.
    """
    # In units of the priors, S is the information of the new images.
    scaled = covariance / np.outer(prior, prior)
    S = np.linalg.inv(scaled) - np.eye(len(prior))
    score = np.linalg.solve(scaled, (values - old) / prior)
    weight, vectors = np.linalg.eigh(0.5 * (S + S.T))
    is_determined = weight > 1.0
    if not is_determined.any():
        raise NotIdentifiable(
            "The earlier result could not be tested: the new images determine no direction of the "
            "parameters better than it is known without them; take more images, of more legs at "
            "once and at other poses."
        )
    directions = vectors[:, is_determined].T / prior
    return (
        directions,
        vectors[:, is_determined].T @ score / weight[is_determined],
        np.diag(1.0 / weight[is_determined]) + directions @ old_covariance @ directions.T,
    )


def noise_dof(dof: int, covariance: Array, prior: Array) -> int:
    """Return the degrees of freedom of the noise in a fit with wide priors.

    ``dof`` are residuals, including those of priors, less unknowns; ``covariance`` (p, p) is the
    covariance of the parameters with priors.
    """
    # A prior that is much wider than the posterior leaves no residual.
    dominated = len(prior) - float(np.trace(covariance / prior**2))
    return max(round(dof - dominated), 1)


def judge_movement(
    measured_difference: tuple[Array, Array, Array],
    ratio: LikelihoodRatio,
    noise_dof: int,
    changes: Sequence[Sequence[Change]],
    significance: float,
) -> Movement:
    """Return the test of the earlier result, with the simplest sufficient explanations.

    ``measured_difference`` is the result of :func:`difference`, ``significance`` the probability of
    a false alarm.
    """
    directions, values, covariance = measured_difference
    whitening = whitener(covariance)
    residual = whitening @ values
    # Linear theory counts far outliers in full, the costs do not.
    share = ratio.saved / max(float(residual @ residual), np.finfo(np.float64).tiny)
    p_value = ratio.p_value(noise_dof)
    explanations: list[Explanation] = []
    if p_value < significance:
        for of_kind in changes:
            candidates = [
                _explain(whitening @ directions, residual, c, noise_dof, share) for c in of_kind
            ]
            explanations = sorted(candidates, key=lambda explanation: explanation.remaining)
            sufficient = [e for e in explanations if e.p_value >= significance]
            if sufficient:
                explanations = sufficient
                break
    return Movement(
        ratio.saved, len(residual), noise_dof, p_value, significance, tuple(explanations)
    )


def _explain(
    directions: Array, residual: Array, change: Change, noise_dof: int, share: float
) -> Explanation:
    """Return the fit of a change to a whitened difference (k,); *share* scales the statistic."""
    by_change = directions @ change.columns
    inverse = np.linalg.pinv(by_change, rcond=1e-9)
    values = inverse @ residual
    remainder = residual - by_change @ values
    remaining = share * float(remainder @ remainder)
    dof = len(residual) - int(np.linalg.matrix_rank(by_change))
    sigma = np.sqrt(np.sum(inverse**2, axis=1))
    return Explanation(change, values, sigma, remaining, _p_value(remaining, dof, noise_dof))


def _p_value(statistic: float, dof: int, noise_dof: int) -> float:
    """Return the probability of a larger statistic with estimated noise."""
    return float(fdtrc(dof, max(noise_dof, 1), statistic / dof)) if dof > 0 else 0.0


_Moved = Callable[[float], Sequence[Leg]]  # the legs after a step of a component
# part, and the name, unit, link of the axes and motion of its components
_Possible = tuple[str, list[tuple[str, str, str, _Moved]]]


def possible_changes(
    machine: Machine, parametrization: Parametrization
) -> tuple[tuple[Change, ...], ...]:
    """Return the possible changes: single lengths first, then joints, then whole legs.

    Joints move along the axes of the links of base and platform. Changes of a motor that moves
    joints at A affect all its rods.
    """
    legs = geometries(machine)
    single, of_joints, of_legs = list[Change](), list[Change](), list[Change]()
    metre = np.where([unit == "m" for unit in parametrization.units], machine.size, 1.0)
    rods = list(zip(actuator_index(legs), range(len(legs)), strict=True))
    parts = [(leg.name, _of_leg(machine, legs, j)) for j, leg in enumerate(machine.legs)]
    parts += [
        (actuator.joint, _of_actuator(legs, actuator, [j for other, j in rods if other == a]))
        for a, actuator in enumerate(actuators_of(legs))
    ]
    for name, changes in parts:
        of_part = list[Change]()
        for part, components in changes:
            shown = list[tuple[str, str, str, Array]]()
            for component, unit, link, moved in components:
                size = _STEP * (machine.size if unit == "m" else 1.0)
                before, after = (
                    vector_of(
                        parametrization, in_joint_frames(moved(step), machine.frame_legs), legs
                    )
                    for step in (-size, size)
                )
                column = (after - before) / (2.0 * size)
                if np.any(np.abs(column) * size > _STEP * _STEP * metre):
                    shown.append((component, unit, link, column))
            if shown:
                names, units, links, columns = zip(*shown, strict=True)
                of_part.append(Change(part, name, names, units, links, np.column_stack(columns)))
        single += [change for change in of_part if len(change.components) == 1]
        of_joints += [change for change in of_part if len(change.components) > 1]
        if len(of_part) > 1:
            of_legs.append(_together(name, of_part))
    return tuple(single), tuple(of_joints), tuple(of_legs)


def _along(legs: Sequence[Leg], which: Sequence[int], columns: slice, direction: Array) -> _Moved:
    """Return the motion of some of the numbers of legs (:class:`LegColumns`) along a direction."""
    place = np.arange(len(legs) * LegColumns.COUNT).reshape(len(legs), LegColumns.COUNT)

    def moved(step: float) -> Sequence[Leg]:
        change = np.zeros(place.shape)
        change[list(which), columns] = step * direction
        return moved_legs(legs, place, change.ravel())

    return moved


def _of_actuator(legs: Sequence[Leg], actuator: Actuator, rods: Sequence[int]) -> list[_Possible]:
    """Return the possible changes of a motor that moves joints at A: zero, axis and arm."""

    def zero_moved(step: float) -> Sequence[Leg]:
        reading = np.array([step])
        turn, arm = actuator.rotations(reading)[0], actuator.arm
        if arm is not None:
            line = Line(actuator.at(arm.line.point, reading)[0], turn @ arm.line.axis)
            arm = replace(arm, line=line)
        return [
            leg
            if j not in rods
            else replace(
                leg,
                A=actuator.at(leg.A, reading)[0],
                base_axis=None if leg.base_axis is None else turn @ leg.base_axis,
                actuator=replace(actuator, arm=arm),
            )
            for j, leg in enumerate(legs)
        ]

    def of_line(part: str, columns: slice) -> _Possible:
        units = ("rad", "rad", "m", "m")[: columns.stop - columns.start]
        names = ("1", "2", "place 1", "place 2")
        directions = zip(names, units, np.eye(len(units)), strict=False)
        return part, [(n, u, "", _along(legs, rods, columns, x)) for n, u, x in directions]

    zero: _Possible = ("zero", [(f"{actuator.joint}.zero", actuator.unit, "", zero_moved)])
    if not actuator.turns:
        return [zero, of_line("direction", ActuatorColumns.AXIS)]
    arm_line = [] if actuator.arm is None else [of_line("arm line", ActuatorColumns.ARM)]
    return [zero, of_line("axis", ActuatorColumns.LINE), *arm_line]


def _of_leg(machine: Machine, legs: Sequence[Leg], j: int) -> list[_Possible]:
    """Return the possible changes of a leg."""
    leg, name, changes = legs[j], machine.leg_names[j], list[_Possible]()
    if leg.kind is not LegKind.PASSIVE:
        length = "length" if leg.kind is LegKind.CONSTANT else "offset"
        columns = slice(LegColumns.LENGTH, LegColumns.LENGTH + 1)
        moved = _along(legs, [j], columns, np.ones(1))
        changes.append((length, [(f"{name}.{length}", "m", "", moved)]))
    for part, link, T, columns in (  # rows of T are the axes of the links in R_b and R_e
        ("base joint", machine.base, machine.T_base_Rb, LegColumns.A),
        ("platform joint", machine.platform, machine.T_platform_Re, LegColumns.B),
    ):
        axes = zip("xyz", T.rotation.as_matrix(), strict=True)
        changes.append((part, [(x, "m", link, _along(legs, [j], columns, v)) for x, v in axes]))
    for part, axis, columns in (
        ("base axis", leg.base_axis, LegColumns.BASE_AXIS),
        ("platform axis", leg.platform_axis, LegColumns.PLATFORM_AXIS),
    ):
        turns = zip("12", np.eye(2), strict=True)
        if axis is not None:
            changes.append(
                (part, [(x, "rad", "", _along(legs, [j], columns, v)) for x, v in turns])
            )
    return changes


def _together(name: str, changes: Sequence[Change]) -> Change:
    """Return all changes of one leg as one change."""
    return Change(
        "",
        name,
        tuple(
            component if component == f"{name}.{change.part}" else f"{change.part} {component}"
            for change in changes
            for component in change.components
        ),
        tuple(unit for change in changes for unit in change.units),
        tuple(link for change in changes for link in change.links),
        np.concatenate([change.columns for change in changes], axis=1),
    )
