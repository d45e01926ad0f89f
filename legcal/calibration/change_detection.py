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
from scipy.spatial.transform import Rotation
from scipy.special import fdtrc

from legcal.errors import NotIdentifiable
from legcal.geometry.covariances import whitener
from legcal.geometry.lines import normal_basis
from legcal.geometry.motions import frame_on_points
from legcal.geometry.types import Array
from legcal.machine.actuator import Actuator, ActuatorColumns, Line
from legcal.machine.leg import Leg, LegKind, with_platform_points
from legcal.machine.model import Machine
from legcal.machine.parameters import Parametrization, geometries, twist_after, vector_of
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


def possible_changes(
    machine: Machine, parametrization: Parametrization
) -> tuple[tuple[Change, ...], ...]:
    """Return the possible changes: single lengths first, then joints, then whole legs.

    Joints move along the axes of the links of base and platform. Changes of a motor that moves
    joints at A affect all its rods.
    """
    legs, frame_legs = geometries(machine), machine.frame_legs
    single, of_joints, of_legs = list[Change](), list[Change](), list[Change]()
    parts = [
        (name, [j], _of_leg(machine, name, leg))
        for j, (name, leg) in enumerate(zip(machine.leg_names, legs, strict=True))
    ]
    actuator_of_leg = actuator_index(legs)
    parts += [
        (
            actuator.joint,
            [j for j, other in enumerate(actuator_of_leg) if other == a],
            _of_actuator(actuator),
        )
        for a, actuator in enumerate(actuators_of(legs))
    ]

    def derivative(affected: Sequence[int], moved: _Moved, k: int, unit: str) -> Array:
        """Return the derivative of the parameters by component k of a change, (p,)."""
        size = _STEP * (machine.size if unit == "m" else 1.0)
        before, after = (
            _in_frames_of_joints(
                [moved(leg, k, step) if j in affected else leg for j, leg in enumerate(legs)],
                frame_legs,
            )
            for step in (-size, size)
        )
        change = vector_of(parametrization, after, legs) - vector_of(parametrization, before, legs)
        return np.asarray(change / (2.0 * size))

    for name, affected, changes in parts:
        of_part = list[Change]()
        for part, components, units, link, moved in changes:
            columns = np.column_stack(
                [derivative(affected, moved, k, unit) for k, unit in enumerate(units)]
            )
            is_length = np.array([unit == "m" for unit in (*parametrization.units, *units)])
            metre = np.where(is_length, machine.size, 1.0)
            relative = columns * metre[-len(units) :] / metre[: len(columns), None]
            moves = np.any(np.abs(relative) > _STEP, axis=0)
            if moves.any():
                indices = np.flatnonzero(moves).tolist()
                of_part.append(
                    Change(
                        part,
                        name,
                        tuple(components[k] for k in indices),
                        tuple(units[k] for k in indices),
                        (link,) * len(indices),
                        columns[:, moves],
                    )
                )
        single += [change for change in of_part if len(change.components) == 1]
        of_joints += [change for change in of_part if len(change.components) > 1]
        if len(of_part) > 1:
            of_legs.append(_together(name, of_part))
    return tuple(single), tuple(of_joints), tuple(of_legs)


_Moved = Callable[[Leg, int, float], Leg]  # leg with component k changed by a step
# part, components, units, link of the axes, change
_Possible = tuple[str, tuple[str, ...], tuple[str, ...], str, _Moved]
_METRES, _RADIANS = ("m",) * 3, ("rad",) * 2


def _of_actuator(actuator: Actuator) -> list[_Possible]:
    """Return the possible changes of a motor that moves joints at A: zero, axis and arm."""

    def zero_moved(leg: Leg, _: int, step: float) -> Leg:
        step_of_reading = np.array([step])
        axis, turn = leg.base_axis, actuator.rotations(step_of_reading)[0]
        moved = actuator
        if actuator.arm is not None:
            line = Line(
                actuator.at(actuator.arm.line.point, step_of_reading)[0],
                turn @ actuator.arm.line.axis,
            )
            moved = replace(actuator, arm=replace(actuator.arm, line=line))
        return replace(
            leg,
            A=actuator.at(leg.A, step_of_reading)[0],
            base_axis=None if axis is None else turn @ axis,
            actuator=moved,
        )

    def moved_from(first: int) -> _Moved:
        def moved(leg: Leg, k: int, step: float) -> Leg:
            change = np.zeros(ActuatorColumns.COUNT)
            change[first + k] = step
            return replace(leg, actuator=actuator.moved(change))

        return moved

    joint = actuator.joint
    changes: list[_Possible] = [("zero", (f"{joint}.zero",), (actuator.unit,), "", zero_moved)]
    numbers, units = ("1", "2", "place 1", "place 2"), (*_RADIANS, *_METRES[:2])
    if not actuator.turns:
        return [*changes, ("direction", ("1", "2"), _RADIANS, "", moved_from(0))]
    changes.append(("axis", numbers, units, "", moved_from(0)))
    if actuator.arm is not None:
        line = ActuatorColumns.ARM.start - ActuatorColumns.AXIS.start
        changes.append(("arm line", numbers, units, "", moved_from(line)))
    return changes


def _of_leg(machine: Machine, name: str, leg: Leg) -> list[_Possible]:
    """Return the possible changes of a leg."""
    changes = list[_Possible]()
    xyz = ("x", "y", "z")
    # Rows are the axes of the links in R_b and R_e.
    base = machine.T_base_Rb.rotation.as_matrix()
    platform = machine.T_platform_Re.rotation.as_matrix()

    def longer(leg: Leg, _: int, step: float) -> Leg:
        return replace(leg, q0=leg.q0 + step)

    if leg.kind is not LegKind.PASSIVE:
        length_name = "length" if leg.kind is LegKind.CONSTANT else "offset"
        changes.append((length_name, (f"{name}.{length_name}",), ("m",), "", longer))

    def base_moved(leg: Leg, k: int, step: float) -> Leg:
        return replace(leg, A=leg.A + step * base[k])

    def platform_moved(leg: Leg, k: int, step: float) -> Leg:
        return replace(leg, B=leg.B + step * platform[k])

    changes += [
        ("base joint", xyz, _METRES, machine.base, base_moved),
        ("platform joint", xyz, _METRES, machine.platform, platform_moved),
    ]
    a, b = leg.base_axis, leg.platform_axis
    if a is not None:

        def base_turned(leg: Leg, k: int, step: float) -> Leg:
            return replace(leg, base_axis=_about(a, k, step).apply(a))

        changes.append(("base axis", ("1", "2"), _RADIANS, "", base_turned))
    if b is not None:

        def platform_turned(leg: Leg, k: int, step: float) -> Leg:
            turn = _about(b, k, step)
            return replace(leg, platform_axis=turn.apply(b), twist=twist_after(leg, turn))

        changes.append(("platform axis", ("1", "2"), _RADIANS, "", platform_turned))
    return changes


def _about(axis: Array, k: int, step: float) -> Rotation:
    """Return a small rotation about one of the two normals of an axis."""
    return Rotation.from_rotvec(step * normal_basis(axis)[k])


def _in_frames_of_joints(legs: Sequence[Leg], frame_legs: Sequence[int]) -> tuple[Leg, ...]:
    """Return legs in the frames R_b and R_e defined by their joint centres."""
    frames = list(frame_legs)
    legs = with_platform_points(legs, frame_legs)
    base = frame_on_points(np.array([leg.A for leg in legs])[frames]).inv()
    platform = frame_on_points(np.array([leg.B for leg in legs])[frames]).inv()

    turn_base, turn_platform = base.rotation, platform.rotation

    def turned(T: Rotation, axis: Array | None) -> Array | None:
        return None if axis is None else T.apply(axis)

    return tuple(
        replace(
            leg,
            A=base.apply(leg.A),
            B=platform.apply(leg.B),
            actuator=None if leg.actuator is None else leg.actuator.in_frame(base.as_matrix()),
            base_axis=turned(turn_base, leg.base_axis),
            platform_axis=turned(turn_platform, leg.platform_axis),
            twist=twist_after(leg, turn_platform),
        )
        for leg in legs
    )


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
