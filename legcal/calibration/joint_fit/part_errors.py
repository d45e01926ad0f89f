"""Tolerances as priors: what the parts of a machine may be off, and what that does to parameters.

Parts err independently of each other, in the links: a joint centre in each direction, an axis, a
rod, and the zero of each motor, by which its arm, carriage or leg stands further than it reads.
R_b and R_e are defined by joint centres that err as well, so that parameters err together: with
errors e of variances S, their change is J e, and its prior the covariance J S J^T.

After a fit with covariance C of the parameters x, the errors of the parts are
e = K (x - x_0), K = S J^T (J S J^T)^-1, with the covariance S + K (C - J S J^T) K^T. That is their
posterior with all else marginalised: what several parts explain alike is shared by their variances.

A horn on the wrong tooth of its spline is no small error: it is another nominal machine, with x_0
and J there.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache
from typing import Literal

import numpy as np

from legcal.calibration.joint_fit.parameter_choices import Choices, Group
from legcal.calibration.joint_fit.variables import FittedLegs
from legcal.calibration.tuning import ARM_AXIS_SIGMA, ARM_POINT_SIGMA
from legcal.estimation.problem import GaussianPrior
from legcal.files.quantity import SHOWN_IN
from legcal.files.schema import Document, Number
from legcal.geometry.types import Array, BoolArray, IntArray
from legcal.machine.actuator import ActuatorColumns, Line
from legcal.machine.leg import Leg, LegColumns, LegKind
from legcal.machine.parameters import in_joint_frames, moved_legs, vector_of
from legcal.machine.rods import reading_legs
from legcal.machine.tolerance import Tolerance

Kind = Literal["joints", "axes", "lengths", "zeros", "arms"]

_STEP = 1e-6  # of derivatives [rad], and relative to the size of the machine
_RANK = 1e-12  # of the largest eigenvalue of correlations


@dataclass(frozen=True, eq=False)
class PartErrors:
    """The m errors of parts, and the prior of the p kinematic parameters that follows from them.

    Parameters whose row of J is zero (gains, twists) have no prior by parts.
    """

    names: tuple[str, ...]  # the motor of a zero, else the leg
    kinds: tuple[Kind, ...]
    sigma: Array  # (m,) [m or rad]
    J: Array  # (p, m) change of the parameters by each error
    centre: Array  # (p,) the parameters without errors, [m or rad]

    @cached_property
    def covariance(self) -> Array:
        """Prior covariance (p, p) of the parameters."""
        return np.asarray((self.J * self.sigma**2) @ self.J.T)

    def prior(self, free: BoolArray) -> GaussianPrior:
        """Return the prior of the free parameters (p,), by their numbers among these."""
        C = self.covariance
        some = free & (np.diagonal(C) > 0.0)
        return GaussianPrior.from_covariance(
            (np.cumsum(free) - 1)[some], self.centre[some], C[np.ix_(some, some)]
        )

    @cached_property
    def gain(self) -> Array:
        """K (m, p): the errors by a change of the parameters, 0 for those without a prior."""
        scale, K = np.sqrt(np.diagonal(self.covariance)), np.zeros(self.J.T.shape)
        some = scale > 0.0
        J = self.J[some] / scale[some, None]
        prior = np.linalg.pinv((J * self.sigma**2) @ J.T, rcond=_RANK, hermitian=True)
        K[:, some] = self.sigma[:, None] ** 2 * J.T @ prior / scale[some]
        return K

    def posterior(self, x: Array, C: Array) -> tuple[Array, Array]:
        """Return the errors (m,) and their covariance (m, m) by a fit x (p,), C (p, p)."""
        K = self.gain
        return K @ (x - self.centre), np.diag(self.sigma**2) + K @ (C - self.covariance) @ K.T

    def of_group(self, group: Group | None) -> BoolArray:
        """Return a mask of the errors (m,) of a group of parts."""
        return np.array([group == "all" or kind == group for kind in self.kinds], dtype=np.bool_)

    def of(self, kind: Kind) -> IntArray:
        """Return the indices of the errors of a kind."""
        return np.flatnonzero(np.equal(self.kinds, kind))


class PartSigma(Document):
    """How well a part is expected to be known [m or rad]."""

    part: str  # the motor of a zero, else the leg
    kind: Kind
    sigma: Number  # one standard deviation; of a joint centre that of its worst direction
    tolerance: Number
    unit: Literal["m", "rad"]


def predicted_sigmas(legs: FittedLegs, choices: Choices, C: Array) -> tuple[PartSigma, ...]:
    """Return what a covariance C (p, p) of all parameters leaves open of the parts asked for.

    () without tolerances as priors.
    """
    if choices.built is None:
        return ()
    errors = part_errors(legs, choices.built)
    sigma = np.sqrt(np.diagonal(errors.posterior(errors.centre, C)[1]))
    of_motors = {leg.motor_label: leg.reading_unit for leg in legs.nominal}
    found = dict[tuple[str, Kind], PartSigma]()
    for i, (name, kind) in enumerate(zip(errors.names, errors.kinds, strict=True)):
        before = found.get((name, kind))
        if kind == "arms" or choices.only not in ("all", kind) or errors.sigma[i] <= 0.0:
            continue
        if before is None or sigma[i] > before.sigma:
            unit = of_motors[name] if kind == "zeros" else "rad" if kind == "axes" else "m"
            found[name, kind] = PartSigma(
                part=name,
                kind=kind,
                sigma=float(sigma[i]),
                tolerance=float(errors.sigma[i]),
                unit=unit,
            )
    return tuple(found.values())


def sigmas_in_words(parts: Sequence[PartSigma]) -> list[str]:
    """Return a sentence for each kind of parts."""
    sentences = []
    for kind in dict.fromkeys(one.kind for one in parts):
        some = [one for one in parts if one.kind == kind]
        scale, unit = SHOWN_IN[some[0].unit]
        least, most = (scale * pick(one.sigma for one in some) for pick in (min, max))
        sentences.append(
            f"Expected of the {kind}, with tolerances as priors: {least:.2g} to {most:.2g} {unit} "
            f"(1 sigma), where parts like these are {scale * some[0].tolerance:.2g} {unit} off."
        )
    return sentences


def part_errors(
    legs: FittedLegs, tolerance: Tolerance, turned: Mapping[str, float] | None = None
) -> PartErrors:
    """Return the errors of the parts of a machine with all tolerances stated.

    *turned* [m or rad] are motors whose zero is known to be elsewhere, by their labels.
    """
    moved, centre = part_derivatives(legs, tuple((turned or {}).items()))
    rods = [leg.q0 for leg in legs.nominal if leg.actuator is not None]
    of_arms = {"arm_axis": ARM_AXIS_SIGMA, "arm_point": ARM_POINT_SIGMA * float(np.mean(rods or 0))}
    names, kinds, sigmas, columns = list[str](), list[Kind](), list[float](), list[Array]()
    for (j, part), J in moved.items():
        leg, kind = legs.nominal[j], "zeros" if part == "zero" else _PARTS[part][1]
        if part == "length" and leg.kind is not LegKind.CONSTANT:  # that of its motor's zero
            continue
        if part == "point" and not leg.reads_angle:  # nothing turns about it
            continue
        stated = "angles_at_zero" if part == "zero" and leg.reads_angle else kind
        sigma = of_arms[part] if kind == "arms" else getattr(tolerance, stated) or 0.0
        names += [leg.motor_label if part == "zero" else leg.name] * J.shape[1]
        kinds += [kind] * J.shape[1]
        sigmas += [sigma] * J.shape[1]
        columns.append(J)
    return PartErrors(tuple(names), tuple(kinds), np.array(sigmas), np.hstack(columns), centre)


_PARTS: Mapping[str, tuple[slice, Kind]] = {  # with their columns among the numbers of a leg
    "A": (LegColumns.A, "joints"),
    "B": (LegColumns.B, "joints"),
    "length": (slice(LegColumns.LENGTH, LegColumns.LENGTH + 1), "lengths"),
    "base_axis": (LegColumns.BASE_AXIS, "axes"),
    "platform_axis": (LegColumns.PLATFORM_AXIS, "axes"),
    "axis": (ActuatorColumns.AXIS, "axes"),
    "point": (ActuatorColumns.POINT, "joints"),
    "arm_axis": (ActuatorColumns.ARM_AXIS, "arms"),
    "arm_point": (ActuatorColumns.ARM_POINT, "arms"),
}


@lru_cache(maxsize=4)  # the same for all tolerances and all fits of a machine
def part_derivatives(
    legs: FittedLegs, turned: tuple[tuple[str, float], ...] = ()
) -> tuple[dict[tuple[int, str], Array], Array]:
    """Return derivatives (p, d) of the parameters by moves of single parts, and x_0 (p,).

    By the leg that has the part, or the first rod on a motor, and the part: joint centres along
    the axes of R_b or R_e, axes about the two directions across them, the zero of the motor.
    *turned* are motors whose zero is elsewhere.
    """
    nominal, first, found = legs.nominal, reading_legs(legs.nominal), dict[tuple[int, str], Array]()
    base = with_zeros(nominal, dict(turned))
    place = np.arange(legs.n_legs * LegColumns.COUNT, dtype=np.intp).reshape(legs.n_legs, -1)
    actuators = LegColumns.ACTUATOR
    place[:, actuators] = place[list(first)][:, actuators]  # rods share their motor
    size = legs.length_at_home or float(np.mean([leg.q0 for leg in nominal]))

    def vector(moved: Sequence[Leg]) -> Array:
        framed = in_joint_frames(moved, legs.frame_legs)
        return vector_of(legs.parametrization, framed, nominal)

    for j, leg in enumerate(nominal):
        actuator = leg.actuator if first[j] == j else None
        parts = ["A", "B", *["length"] * (leg.kind is not LegKind.PASSIVE)]
        parts += ["base_axis"] * (leg.base_axis is not None)
        parts += ["platform_axis"] * (leg.platform_axis is not None)
        parts += ["axis", "point"] * (actuator is not None)
        parts += ["arm_axis", "arm_point"] * (actuator is not None and actuator.arm is not None)
        for columns, kind, part in ((*_PARTS[part], part) for part in parts):
            h = _STEP * (size if kind in ("joints", "lengths") else 1.0)
            steps = h * np.equal.outer(place[j, columns], np.arange(place.size))
            moved = [[moved_legs(base, place, by) for by in (step, -step)] for step in steps]
            slopes = [(vector(plus) - vector(minus)) / (2.0 * h) for plus, minus in moved]
            found[j, part] = np.column_stack(slopes)
        if leg.is_motor and first[j] == j:
            h = leg.reading_of(_STEP * size)
            plus, minus = (vector(with_zeros(base, {leg.motor_label: by})) for by in (h, -h))
            found[j, "zero"] = (plus - minus)[:, None] / (2.0 * h)
    return found, vector(base)


def with_zeros(legs: Sequence[Leg], zeros: Mapping[str, float]) -> tuple[Leg, ...]:
    """Return legs whose motors stand further by *zeros* [m or rad] than they read, by labels."""
    return tuple(
        _with_zero(leg, zeros[leg.motor_label]) if zeros.get(leg.motor_label) else leg
        for leg in legs
    )


def _with_zero(leg: Leg, zero: float) -> Leg:
    actuator = leg.actuator
    if actuator is None:
        return replace(leg, q0=leg.q0 + leg.sign * zero) if leg.kind is LegKind.ACTUATED else leg
    q = np.array([zero])
    turn, arm = actuator.rotations(q)[0], actuator.arm
    if arm is not None:
        arm = replace(arm, line=Line(actuator.at(arm.line.point, q)[0], turn @ arm.line.axis))
    return replace(
        leg,
        A=actuator.at(leg.A, q)[0],
        base_axis=None if leg.base_axis is None else turn @ leg.base_axis,
        actuator=replace(actuator, arm=arm),
    )
