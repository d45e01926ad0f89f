"""One group of parameters from few images: zeros, lengths or all, with tolerances as priors.

The joint fit has the tolerances as priors of all parameters
(:mod:`legcal.calibration.joint_fit.part_errors`). What is reported is the posterior of
the group, with all else marginalised. The written model keeps nominal values of all else, and its
predicted error contains what that leaves
(:class:`legcal.calibration.joint_fit.platform.WrittenGroup`).
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from itertools import combinations

import numpy as np

from legcal.calibration.documents import Doubt, MotorZero
from legcal.calibration.doubts import MOST_MOVED, TOLERANCE
from legcal.calibration.joint_fit.parameter_choices import Group
from legcal.calibration.joint_fit.part_errors import (
    Kind,
    PartErrors,
    part_errors,
    with_zeros,
)
from legcal.calibration.joint_fit.platform import WrittenGroup, platform_by_parts, workspace_poses
from legcal.calibration.joint_fit.solution import Solution
from legcal.calibration.joint_fit.variables import fitted_legs
from legcal.files.quantity import SHOWN_IN
from legcal.geometry.motions import frame_on_points
from legcal.geometry.types import Array
from legcal.machine.leg import Leg
from legcal.machine.model import Machine
from legcal.machine.parameters import (
    geometries,
    in_joint_frames,
    vector_of,
)
from legcal.machine.tolerance import Tolerance

_KINDS: Mapping[Kind, str] = {"joints": "joints", "axes": "axes", "lengths": "rods"}
RARE = 10.0  # by which a horn on another tooth must raise twice the logarithm of a likelihood
_UNSEEN = 0.98  # part of the variance by tolerances above which images tell nothing
_SURE = 2.5  # standard deviations within which an offset is a whole number of teeth


@dataclass(frozen=True, eq=False)
class GroupEstimate:
    """The posterior of the parts of a machine, and the model with one group of them."""

    group: Group
    machine: Machine  # the nominal model
    turned: Mapping[str, float]  # by motor: how far its horn is on another tooth [rad]
    errors: PartErrors
    value: Array  # (m,) posterior mean of these errors [m, rad], beside what is turned
    covariance: Array  # (m, m) of these
    held: Array  # (m,) what the written model has of them
    solution: Solution  # with the parameters that are written, and their uncertainty
    written: tuple[Leg, ...]  # in R_b and R_e of the nominal model, only the group having moved

    @property
    def sigma(self) -> Array:
        """Standard deviations of the errors (m,)."""
        return np.asarray(np.sqrt(np.diagonal(self.covariance)))

    @property
    def zeros(self) -> list[MotorZero]:
        """The zeros of the motors, in their order."""
        step = None if (n := self.machine.spline_teeth) is None else 2.0 * np.pi / n
        found = list[MotorZero]()
        for j, i in zip(self.machine.motors, self.errors.of("zeros").tolist(), strict=True):
            motor = self.machine.legs[j].motor_label
            value = float(self.value[i]) + self.turned.get(motor, 0.0)
            teeth = 0
            if step is not None and self.machine.legs[j].reads_angle:
                nearest = round(value / step)
                allowed = np.hypot(self.sigma[i], self.errors.sigma[i])
                teeth = nearest if abs(value - nearest * step) < _SURE * allowed else 0
            found.append(
                MotorZero(
                    motor=motor,
                    value=value,
                    written=float(self.held[i]) + self.turned.get(motor, 0.0),
                    sigma=float(self.sigma[i]),
                    tolerance=float(self.errors.sigma[i]),
                    unit=self.machine.legs[j].reading_unit,
                    teeth=teeth,
                )
            )
        return found

    @property
    def sentence(self) -> str:
        """Which zeros are wrong, and how far the others are off."""
        zeros = self.zeros
        wrong = [
            zero
            for zero in zeros
            if zero.teeth or abs(zero.value) > MOST_MOVED * np.hypot(zero.sigma, zero.tolerance)
        ]
        others = [z for z in zeros if z not in wrong]
        clauses = []
        for zero in wrong:
            scale, unit = SHOWN_IN[zero.unit]
            clause = f"{zero.motor} is {scale * abs(zero.value):.1f} {unit} off"
            if zero.teeth and (n := self.machine.spline_teeth):
                teeth = "one tooth" if abs(zero.teeth) == 1 else f"{abs(zero.teeth)} teeth"
                clause += f": {teeth} of its spline is {abs(zero.teeth) * 360.0 / n:.1f} deg"
            clauses.append(clause)
        if others:
            scale, unit = SHOWN_IN[others[0].unit]
            most = max(abs(z.value) for z in others)
            who = "the others are" if wrong else "all zeros are"
            if wrong or (apart := self._zeros_apart()) is None:
                clauses.append(f"{who} within {scale * most:.1f} {unit}")
            else:
                most, sigma = apart
                clauses.append(
                    f"zeros relative to each other are within {scale * most:.1f} ± "
                    f"{scale * sigma:.1f} {unit}; their common part is not seen by images"
                )
        return "; ".join(clauses)

    def _zeros_apart(self) -> tuple[float, float] | None:
        """Return the largest distance of a zero from the mean of all, and the largest sigma.

        None if images see the mean: a common shift of all rails of a linear Delta moves the whole
        machine along, and its mean stays as uncertain as its prior.
        """
        at = self.errors.of("zeros")
        C, by_prior = self.covariance[np.ix_(at, at)], self.errors.sigma[at]
        if len(at) < 2 or C.sum() < _UNSEEN * np.sum(by_prior**2):
            return None
        centred = np.eye(len(at)) - 1.0 / len(at)
        apart = np.abs(centred @ [zero.value for zero in self.zeros])
        sigma = np.sqrt(np.diagonal(centred @ C @ centred))
        return float(apart.max()), float(sigma.max())

    @property
    def doubts(self) -> list[Doubt]:
        """Return parts that are far beyond their tolerance, the zeros apart."""
        found = list[Doubt]()
        for kind, noun in _KINDS.items():
            at = self.errors.of(kind)
            if not len(at):
                continue
            i = at[int(np.argmax(np.abs(self.value[at]) / self.errors.sigma[at]))]
            if abs(self.value[i]) <= MOST_MOVED * self.errors.sigma[i]:
                continue
            scale, unit = SHOWN_IN["rad" if kind == "axes" else "m"]
            what = (
                f"{noun} moved by {scale * abs(self.value[i]):.2g} {unit} ({self.errors.names[i]}),"
                f" where parts like these are {scale * self.errors.sigma[i]:.2g} {unit} off"
            )
            remedy = (
                "look at the worst outlines of that leg and at the model there, or state how well "
                "the machine is built (tolerance)"
            )
            found.append(Doubt(TOLERANCE, what, remedy))
        return found


def joint_error(machine: Machine, tolerance: Tolerance) -> float:
    """Return how far joints may be from where the model has them, of the mean leg length.

    One standard deviation, of machines with these tolerances over their workspace; infinite where
    readings do not determine the pose.
    """
    fitted = fitted_legs(machine)
    legs = in_joint_frames(fitted.nominal, machine.frame_legs)
    poses = workspace_poses(machine, legs) if machine.is_determined else None
    if poses is None:
        return math.inf
    errors = part_errors(fitted, tolerance)
    of_parts = platform_by_parts(machine, legs, errors.J, poses) * errors.sigma
    moved = float(np.sqrt(np.sum(of_parts**2, axis=1).mean()))
    return math.hypot(moved, tolerance.joints or 0.0) / machine.size


def likely_teeth(
    machine: Machine, solution: Solution, built: Tolerance, wide: Tolerance, step: float
) -> list[tuple[float, dict[str, float]]]:
    """Return horns on other teeth with their evidence against the likeliest, which is first.

    Of a fit with *wide* tolerances of zeros in place of those that are *built*. Hypotheses are no
    horn, any one or two of them a *step* [rad] further or back; evidence is twice a logarithm, by
    the fit linearised. A horn on another tooth is rare.
    """
    errors = part_errors(fitted_legs(machine), wide)
    x = vector_of(solution.kinematic.parametrization, solution.legs, geometries(machine))
    value, covariance = errors.posterior(x, solution.kinematic.value_covariance)
    at = errors.of("zeros")
    known = np.linalg.inv(covariance[np.ix_(at, at)])
    by_images = known - np.diag(errors.sigma[at] ** -2.0)  # information
    zeros = part_errors(fitted_legs(machine), built).sigma[at]
    both = np.linalg.inv(by_images + np.diag(zeros**-2.0))
    S = np.diag(zeros**-2.0)
    A, b = S - S @ both @ S, S @ both @ known @ value[at]
    legs = [machine.legs[j] for j in machine.motors]
    one = [(k, s) for k, leg in enumerate(legs) if leg.reads_angle for s in (step, -step)]
    ranked = []
    for some in ((), *((x,) for x in one), *combinations(one, 2)):
        if len({k for k, _ in some}) < len(some):
            continue
        h = np.zeros(len(at))
        h[[k for k, _ in some]] = [angle for _, angle in some]
        evidence = float(h @ A @ h - 2.0 * b @ h) + RARE * len(some)
        ranked.append((evidence, {legs[k].motor_label: angle for k, angle in some}))
    ranked.sort(key=lambda each: each[0])
    return [(evidence - ranked[0][0], turned) for evidence, turned in ranked]


def estimate_group(
    machine: Machine,
    solution: Solution,
    tolerance: Tolerance,
    turned: Mapping[str, float],
    group: Group,
) -> GroupEstimate:
    """Return the posterior of the parts by a fit, and the model with a group of them.

    The fit has the readings of *turned* motors [rad] corrected, and so the nominal model.
    """
    legs = fitted_legs(machine)
    near, there = part_errors(legs, tolerance), part_errors(legs, tolerance, turned)
    parametrization = solution.kinematic.parametrization
    x = vector_of(parametrization, solution.legs, legs.nominal)
    K = near.gain
    value, covariance = near.posterior(x, solution.kinematic.value_covariance)
    chosen = near.of_group(group)
    marginal = _with_group(legs.nominal, near, value, turned, group)
    framed = in_joint_frames(marginal, machine.frame_legs)
    model = WrittenGroup.of(machine, framed, there.J, chosen)
    left = model.left @ value
    moved = with_zeros(solution.legs, turned)
    if group != "all":
        moved = _with_group(legs.nominal, near, value - left, turned, group)
    C = model.covariance(covariance, np.outer(value, value))
    if group == "all" and not turned:
        return GroupEstimate(
            group, machine, turned, near, value, covariance, value, solution, moved
        )
    by_fit, free = there.J @ K, np.any(there.J[:, chosen] != 0.0, axis=1)
    frame_legs = list(machine.frame_legs)
    T = frame_on_points(np.array([moved[j].A for j in frame_legs])).inv()
    written = in_joint_frames(moved, machine.frame_legs)
    numbers = vector_of(parametrization, written, legs.nominal).tolist()
    reported = replace(
        solution,
        legs=written,
        T_camera_Rb=tuple(one * T.inv() for one in solution.T_camera_Rb),
        T_Rb_Re=tuple(T * one for one in solution.T_Rb_Re),
        kinematic=replace(
            solution.kinematic,
            covariance=C,
            value_covariance=C,
            held_covariance=by_fit @ solution.kinematic.held_covariance @ by_fit.T,
            held_basis=solution.kinematic.held_basis @ by_fit.T,
        ),
        estimates=solution.estimates.transformed(
            dict(zip(parametrization.names, numbers, strict=True)),
            {name for name, one in zip(parametrization.names, free, strict=True) if one},
            C,
            by_fit,
        ),
        sensitivities={what: by_fit @ one for what, one in solution.sensitivities.items()},
    )
    return GroupEstimate(
        group, machine, turned, near, value, covariance, value - left, reported, moved
    )


def _with_group(
    nominal: tuple[Leg, ...],
    errors: PartErrors,
    value: Array,
    turned: Mapping[str, float],
    group: Group,
) -> tuple[Leg, ...]:
    """Return the nominal legs with the zeros or the lengths of a group."""
    kind: Kind = "lengths" if group == "lengths" else "zeros"
    of = {errors.names[i]: float(value[i]) for i in errors.of(kind).tolist()}
    if kind == "lengths":
        legs = tuple(replace(leg, q0=leg.q0 + of.get(leg.name, 0.0)) for leg in nominal)
        return with_zeros(legs, turned)
    return with_zeros(nominal, {m: of[m] + turned.get(m, 0.0) for m in of})
