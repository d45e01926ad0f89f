"""Whether a machine is still the one that was calibrated, asked of a few new images.

The new images are fitted by themselves, with priors so wide that any plausible change fits, so
that nothing which moved is taken for a wrong outline. What they say of the parameters is then
compared with the earlier result: the difference has the covariance of both, and the weighted square
of it has an F distribution if nothing moved. Directions of which the new images know less than the
priors say nothing and do not count.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import Rotation
from scipy.special import fdtrc

from legcal.errors import NotIdentifiable
from legcal.geometry import Array, frame_on_points, normal_basis
from legcal.machine import LegGeometry, LegKind, Parametrization, twist_after, vector_of

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


@dataclass(frozen=True, eq=False)
class Explanation:
    """One thing that may have changed, and what would then be left unexplained.

    Attributes
    ----------
    change : Change
        What.
    values, sigma : (m,) array
        By how much, and the standard deviations [m or rad].
    remaining : float
        The statistic that is left.
    p_value : float
        Its probability if this is all that changed.
    """

    change: Change
    values: Array
    sigma: Array
    remaining: float
    p_value: float


@dataclass(frozen=True, eq=False)
class Movement:
    """What new images say of an earlier result.

    Attributes
    ----------
    statistic : float
        Weighted square of the difference of the parameters.
    dof, noise_dof : int
        Directions that are compared, and degrees of freedom of the noise of the new images.
    p_value : float
        Probability of such a statistic or a larger one if nothing moved.
    significance : float
        Something has moved if the probability is below.
    explanations : tuple of Explanation
        If something moved: what explains it, the best first.
    """

    statistic: float
    dof: int
    noise_dof: int
    p_value: float
    significance: float
    explanations: tuple[Explanation, ...]

    @property
    def moved(self) -> bool:
        """Whether something has moved."""
        return self.p_value < self.significance


@dataclass(frozen=True, eq=False)
class Difference:
    """What the new images say against the earlier result, in the directions that they determine.

    Attributes
    ----------
    directions : (k, p) array
        Derivatives of what is compared by the parameters, each counted in sigmas of its prior.
    values : (k,) array
        The difference along them.
    covariance : (k, k) array
        That of the difference if nothing moved.
    """

    directions: Array
    values: Array
    covariance: Array


def difference(
    values: Array,
    covariance: Array,
    prior: Array,
    old: Array,
    known: Array,
    worse: float = 1.0,
) -> Difference:
    """Return what new images say against the earlier result.

    Parameters
    ----------
    values : (p,) array
        Parameters by the new images and the priors.
    covariance : (p, p) array
        Their covariance, priors included.
    prior : (p,) array
        Standard deviations of the priors; their means are the earlier result.
    old : (p,) array
        Parameters of the earlier result.
    known : (p, p) array
        Their covariance.
    worse : float
        How many times the variance of the outlines is at least what a few new images make of it:
        theirs alone may look small by chance.

    Raises
    ------
    NotIdentifiable
        If the new images determine nothing.
    """
    # In units of the priors, S is what the new images add to them.
    scaled = covariance / np.outer(prior, prior)
    S = np.linalg.inv(scaled) - np.eye(len(prior))
    score = np.linalg.solve(scaled, (values - old) / prior)
    weight, vectors = np.linalg.eigh(0.5 * (S + S.T))
    tells = weight > 1.0
    if not tells.any():
        raise NotIdentifiable(
            "The earlier result could not be tested: the new images determine no direction of the "
            "parameters better than it is known without them; take more images, of more legs at "
            "once and at other poses."
        )
    directions = vectors[:, tells].T / prior
    return Difference(
        directions,
        vectors[:, tells].T @ score / weight[tells],
        np.diag(worse / weight[tells]) + directions @ known @ directions.T,
    )


def noise_dof(dof: int, covariance: Array, prior: Array) -> int:
    """Return the degrees of freedom that tell of the noise in a fit with wide priors.

    Parameters
    ----------
    dof : int
        Residuals, those of priors among them, less unknowns.
    covariance : (p, p) array
        Of the parameters that have the priors.
    prior : (p,) array
        Standard deviations of the priors.
    """
    # A prior that the images outdo has no residual of its own.
    outdone = len(prior) - float(np.trace(covariance / prior**2))
    return max(round(dof - outdone), 1)


def judge_movement(
    found: Difference,
    noise_dof: int,
    changes: Sequence[Sequence[Change]],
    significance: float,
) -> Movement:
    """Return whether something has moved, and if so what explains it.

    Parameters
    ----------
    found : Difference
        What the new images say against the earlier result.
    noise_dof : int
        Degrees of freedom from which the noise of the new images is known.
    changes : sequence of sequences of Change
        What may have moved, the simplest first.
    significance : float
        Probability of a false alarm.
    """
    whitening = np.linalg.inv(np.linalg.cholesky(found.covariance))
    residual = whitening @ found.values
    statistic, k = float(residual @ residual), len(residual)
    p_value = _p_value(statistic, k, noise_dof)
    explanations: list[Explanation] = []
    if p_value < significance:
        for of_kind in changes:
            tried = [
                _explain(whitening @ found.directions, residual, c, noise_dof) for c in of_kind
            ]
            explanations = sorted(tried, key=lambda explanation: explanation.remaining)
            enough = [e for e in explanations if e.p_value >= significance]
            if enough:
                explanations = enough
                break
    return Movement(statistic, k, noise_dof, p_value, significance, tuple(explanations))


def _explain(directions: Array, residual: Array, change: Change, noise_dof: int) -> Explanation:
    """Return what a change leaves of a whitened difference (k,)."""
    by_change = directions @ change.columns
    inverse = np.linalg.pinv(by_change, rcond=1e-9)
    values = inverse @ residual
    left = residual - by_change @ values
    remaining, dof = float(left @ left), len(residual) - int(np.linalg.matrix_rank(by_change))
    return Explanation(
        change,
        values,
        np.sqrt(np.sum(inverse**2, axis=1)),
        remaining,
        _p_value(remaining, dof, noise_dof),
    )


def _p_value(statistic: float, dof: int, noise_dof: int) -> float:
    """Return the probability of a statistic or a larger one, the noise estimated itself."""
    return float(fdtrc(dof, max(noise_dof, 1), statistic / dof)) if dof > 0 else 0.0
