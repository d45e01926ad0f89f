"""Absolute scale of a machine: its witnesses, and how they agree with each other.

Encoders of arms measure angles, and passive legs have none. Without a measured length, such a
machine at twice the size, with rods twice as thick and cameras twice as far, gives the same
measurements. Where several things say a length, each pair of them can be compared.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from itertools import combinations

import numpy as np
from scipy.special import ndtri

from legcal.calibration.joint_fit.diagnostics import stated_parameters
from legcal.calibration.joint_fit.factors import measured_lengths
from legcal.calibration.joint_fit.held_out import Posterior, with_weights
from legcal.calibration.joint_fit.parameter_choices import board_scale, joints_of_length
from legcal.calibration.joint_fit.problem import FitLinear, FitProblem
from legcal.calibration.joint_fit.sensitivity import kinematic_steps
from legcal.calibration.tuning import SCALE_BY_CHANCE
from legcal.errors import DidNotConverge, NotIdentifiable
from legcal.estimation.problem import linearize
from legcal.estimation.solver import inverse_on_range, normal_equations
from legcal.estimation.uncertainty import (
    Projected,
    residual_changes,
    response,
    score_test,
    size_left,
)
from legcal.files.schema import few
from legcal.geometry.types import Array
from legcal.machine.leg import LINKS, LegColumns, ParameterId

SCALE = "an error of the scale, known from radii alone, by one standard deviation"
ALL_READINGS = "an error of pitch, of all motors alike and of each one, by one sigma"
TRAVEL, BOARD = "the travel of the motors", "the calibration board"
RADII, MODEL = "the radii", "the nominal model"
_CLEARLY = 4.0  # squared sigmas, by which the others agree better without one witness
_LENGTHS = {"base", "platform", "offset", "length"}  # kinds of parameters with a length


def has_length(problem: FitProblem) -> bool:
    """Whether a length was measured or stated: a reading, a board, a parameter.

    A list, not a rank test as ``is_scale_open`` of identify, since it is used after failed fits.
    """
    stated = {
        ParameterId.parse(name).kind for name in stated_parameters(problem) if ":" not in name
    }
    return (
        bool(_witnesses_in_images(problem))
        or any(":" in name for name in problem.choices.priors)
        or bool(stated & _LENGTHS)
    )


@contextmanager
def explaining_missing_scale(problem: FitProblem) -> Iterator[None]:
    """Prepend to a failure that radii alone determine the scale, if they do."""
    try:
        yield
    except (DidNotConverge, NotIdentifiable) as failure:
        if has_length(problem):
            raise
        raise type(failure)(
            [
                "The joint fit failed, and no measured length determines the scale: there is "
                "neither a reading of a leg nor a board, and radii alone hardly determine the "
                "platform joints; "
                + (
                    "measure a distance of two joints and state it (--length), or put a "
                    "calibration board on the base."
                    if problem.legs.n_actuators
                    else "put a calibration board on the platform and one on the base, give a leg "
                    "an encoder, or state measured coordinates of joints (--set)."
                ),
                *failure.facts,
            ]
        ) from None


def sensitivity_to_scale(linear: FitLinear, covariance: Array) -> dict[str, Array]:
    """Return the change of parameters with one sigma of a scale that no sigma of the fit contains.

    *covariance* is of the kept unknowns. Where radii alone say the scale, it is the relative change
    of the mean length of rods; its share of the covariance would vanish with one measured length.
    Where motors slide, their readings are exact in the fit, but screws and belts are not: they
    share an error, each one differs from that by as much again, and boards, stated lengths and
    images say as much as they know of both, by their scores.
    """
    problem, state = linear.problem, linear.state
    if (travel := _travel(problem)).any():
        leg, normal = problem.readings.leg, normal_equations(linear)
        of_motors = np.equal(leg[:, None], np.unique(leg[travel != 0.0]))
        columns = {"readings": (_whitened_travel(problem, travel) * of_motors)[:, None]}
        n = of_motors.shape[1]
        scores = Projected.of(normal, columns).at(np.arange(n))
        alike = np.ones((n, n))  # and the differences of each one from the mean
        prior = problem.legs.sigma_travel**2 * (alike + np.eye(n) - alike / n)
        moved = kinematic_steps(problem, response(normal, columns))
        return {ALL_READINGS: moved @ size_left(scores, prior)}
    parametrization = problem.legs.parametrization
    column = parametrization.place[:, LegColumns.LENGTH]
    rods = np.flatnonzero(column >= 0)
    if not len(rods) or has_length(problem):
        return {}
    by_scale = np.zeros(len(parametrization))
    by_scale[column[rods]] = 1.0 / (len(rods) * np.array([state.legs[j].q0 for j in rods]))
    n = problem.n_kinematic
    by_scale = by_scale[problem.free]
    moved = covariance[:n, :n] @ by_scale
    step = np.zeros((len(parametrization), 1))
    step[problem.free, 0] = moved / np.sqrt(by_scale @ moved)
    return {SCALE: step}


def scale_witnesses(problem: FitProblem) -> list[str]:
    """Return what says how large the machine is, besides radii and the nominal model, in words."""
    return [*_witnesses_in_images(problem), *(name for name, _ in _stated_lengths(problem))]


def only_lengths(problem: FitProblem) -> list[str]:
    """Return the stated lengths that alone say how large the machine is, besides radii."""
    stated = _stated_lengths(problem)
    return stated[0][1] if len(stated) == 1 and not _witnesses_in_images(problem) else []


def _witnesses_in_images(problem: FitProblem) -> list[str]:
    """Return the measured lengths that images come with: readings, a board."""
    has_board = any(len(corners) for corners in problem.boards)
    return [TRAVEL] * bool(_travel(problem).any()) + [BOARD] * has_board


def _travel(problem: FitProblem) -> Array:
    """Return the readings of motors, (n,) [m]; zero where they are angles."""
    is_angle = np.array([leg.reads_angle for leg in problem.legs.nominal], dtype=np.bool_)
    return np.where(is_angle[problem.readings.leg], 0.0, problem.readings.length)


def _whitened_travel(problem: FitProblem, travel: Array) -> Array:
    """Return the change of whitened residuals (n, 1) by readings that are too large by one unit."""
    return np.asarray(-np.asarray(problem.factor("readings").whitening)[:, :, 0] * travel[:, None])


def stated_lengths(problem: FitProblem) -> dict[str, float]:
    """Return the stated values of lengths by parameter, with a standard deviation or as exact."""
    legs, choices = problem.legs, problem.choices
    nominal = dict(zip(legs.parametrization.names, legs.vector(legs.nominal).tolist(), strict=True))
    lengths = {name: prior.mean for name, prior in choices.priors.items() if ":" in name}
    for name in stated_parameters(problem):
        if ":" not in name and ParameterId.parse(name).kind in _LENGTHS:
            prior = choices.priors.get(name)
            fixed = choices.values.get(name, nominal.get(name, 0.0))
            lengths[name] = fixed if prior is None else prior.mean
    return dict(sorted(lengths.items()))


def _stated_lengths(problem: FitProblem) -> list[tuple[str, list[str]]]:
    """Return stated lengths in words with the names of their parameters.

    Coordinates of joints count together, and so do parameters of a kind with one value: somebody
    measured it once.
    """
    groups = dict[tuple[str, float], list[str]]()
    for name, value in stated_lengths(problem).items():
        kind = name if ":" in name else ParameterId.parse(name).kind
        is_coordinate = kind in ("base", "platform")
        groups.setdefault(("joints", 0.0) if is_coordinate else (kind, value), []).append(name)
    return [
        (
            "the coordinates of joints that are stated"
            if kind == "joints"
            else f"the stated {few(names)}",
            names,
        )
        for (kind, _), names in groups.items()
    ]


def single_witness(problem: FitProblem) -> str:
    """Return a sentence on a scale that one witness alone says, "" where there are more or none."""
    witnesses = scale_witnesses(problem)
    if len(witnesses) != 1:
        return ""
    return (
        f"The scale of the machine rests on {witnesses[0]} alone: an error of that would not show "
        "in photographs; a measured length beside it would (--length, --set)."
    )


@dataclass(frozen=True)
class NominalSize:
    """What the nominal model says of the size of the machine."""

    by_parameter: Array  # (p,) relative size by changes of parameters, those of the problem
    excess: float  # by how much the fitted machine is larger than the nominal one, relatively
    sigma: float  # standard deviation of the size of a machine built to its model, relative


@dataclass(frozen=True)
class Disagreement:
    """Two witnesses of the scale that contradict each other."""

    larger: int  # index of the witness by which the machine is larger
    smaller: int
    ratio: float  # of these sizes, less one
    sigmas: float


@dataclass(frozen=True, eq=False)
class ScaleComparison:
    """How large the machine is by each witness, the radii and the nominal model."""

    witnesses: tuple[str, ...]  # in words
    size: Array  # (n,) relative sizes, up to a common one
    covariance: Array  # (n, n) of their differences
    # (p, n) error of the fitted kinematic parameters by a witness that is too large by one unit
    steps: Array

    @property
    def disagreements(self) -> list[Disagreement]:
        """The pairs that differ by more than all of them do by chance, the surest first."""
        found, pairs = list[Disagreement](), list(combinations(range(len(self.size)), 2))
        most = -float(ndtri(0.5 * SCALE_BY_CHANCE / len(pairs)))
        for i, j in pairs:
            apart, variance = self.size[i] - self.size[j], self._contrasts([i, j])[1][0, 0]
            sigmas = float(abs(apart) / np.sqrt(variance)) if variance > 0.0 else 0.0
            if sigmas > most:
                larger, smaller = (i, j) if apart > 0.0 else (j, i)
                found.append(Disagreement(larger, smaller, float(abs(apart)), sigmas))
        return sorted(found, key=lambda one: -one.sigmas)

    def likelier_wrong(self) -> int | None:
        """Return the witness without which the others agree best; None where that is not clear."""
        n = len(self.size)
        left = [self._squares([i for i in range(n) if i != without]) for without in range(n)]
        first, second = np.argsort(left, kind="stable")[:2].tolist()
        return first if left[second] - left[first] > _CLEARLY else None

    def _squares(self, which: Sequence[int]) -> float:
        """Return the squares of sizes about their mean, in standard deviations."""
        if len(which) < 2:
            return 0.0
        difference, covariance = self._contrasts(which)
        return float(difference @ np.linalg.solve(covariance, difference))

    def _contrasts(self, which: Sequence[int]) -> tuple[Array, Array]:
        """Return the differences of sizes from the first one, and their covariance."""
        by_size = np.eye(len(self.size))[list(which[1:])]
        by_size[:, which[0]] = -1.0
        return by_size @ self.size, by_size @ self.covariance @ by_size.T


@dataclass(frozen=True, eq=False)
class _Error:
    """What a witness that is too large by one unit does to whitened residuals."""

    witness: str
    factors: Mapping[str, Array]  # (n, q) by name
    priors: Array  # (n_priors,)
    common: float = 0.0  # standard deviation that its numbers share, relative


def compare_scales(posterior: Posterior, nominal: NominalSize) -> ScaleComparison | None:
    """Compare the witnesses of the scale in pairs; None where there is none in the fit.

    Each gets a number, its relative error. All of them are estimated together by the derivatives
    of the fit, without another fit; as the size of the machine is open then, the first one's is
    zero. The nominal model has no part in the fit.
    """
    problem = with_weights(posterior.problem, posterior.state)
    linear = linearize(problem, posterior.state)
    errors = _errors(linear)
    if not errors:
        return None
    normal = normal_equations(linear)
    stacked = {
        factor.name: np.stack(
            [e.factors.get(factor.name, np.zeros((factor.n, factor.n_rows))) for e in errors], -1
        )
        for factor in problem.factors
    }
    priors = np.stack([e.priors for e in errors], axis=-1)
    score, information = score_test(normal, stacked)
    by_priors = linear.prior_J.T @ priors
    moved_by_priors = -normal.moved_by(by_priors)
    moved = response(normal, stacked)
    crossed = by_priors.T @ moved
    score = score + priors.T @ linear.prior_r
    information = (
        information + priors.T @ priors + by_priors.T @ moved_by_priors + crossed + crossed.T
    )
    steps = kinematic_steps(problem, moved + moved_by_priors)
    others = slice(1, None)
    of_others = inverse_on_range(information[others, others])
    n = len(errors) + 1
    size, covariance = np.zeros(n), np.zeros((n, n))
    size[1:-1] = of_others @ score[others]
    covariance[1:-1, 1:-1] = of_others
    by_error = nominal.by_parameter @ steps[:, others]
    b = nominal.by_parameter[problem.free]
    p = problem.n_kinematic
    size[-1] = by_error @ size[1:-1] - nominal.excess
    covariance[-1, 1:-1] = covariance[1:-1, -1] = of_others @ by_error
    covariance[-1, -1] = (
        nominal.sigma**2 + b @ posterior.covariance[:p, :p] @ b + by_error @ of_others @ by_error
    )
    covariance += np.diag([*(e.common**2 for e in errors), 0.0])
    return ScaleComparison(
        (*(e.witness for e in errors), MODEL),
        size,
        covariance,
        np.column_stack([steps, np.zeros(len(steps))]),
    )


def _errors(linear: FitLinear) -> list[_Error]:
    """Return the errors of all witnesses in a fit, those of radii last."""
    problem, priors = linear.problem, linear.problem.priors
    names = [problem.named[i] for i in priors.unknown.tolist()]
    by_mean = -priors.mean / priors.sigma
    no_prior = np.zeros(len(names))

    def of_priors(which: Collection[str]) -> Array:
        return np.where([name in which for name in names], by_mean, 0.0)

    errors = list[_Error]()
    if (travel := _travel(problem)).any():
        errors.append(_Error(TRAVEL, {"readings": _whitened_travel(problem, travel)}, no_prior))
    boards = [board_scale(corners.link) for corners in problem.boards if len(corners)]
    if fixed := [name for name in boards if problem.choices.holds(name)]:
        size = np.array([[float(board_scale(link) in fixed)] for link in LINKS])
        by_size = residual_changes(linear, "board_scale", size)
        errors.append(_Error(BOARD, by_size, of_priors(boards)))
    elif set(boards) & set(names):
        errors.append(_Error(BOARD, {}, of_priors(boards)))
    distances = measured_lengths(problem.legs.names, problem.choices)
    of_distances = [name for name in sorted(problem.choices.priors) if joints_of_length(name)]
    for words, stated in _stated_lengths(problem):
        if stated[0] in of_distances:
            at = np.equal(of_distances, stated[0])
            error = np.where(at, -distances.length / distances.sigma, 0.0)[:, None]
            errors.append(_Error(words, {"lengths": error}, no_prior))
        else:
            held = _of_held(linear, stated)
            if held or set(stated) & set(names):
                errors.append(_Error(words, held, of_priors(stated)))
    radii = problem.block("radii").labels
    of_radii = np.array([name in radii for name in names], dtype=np.bool_)
    if of_radii.any():
        common = float(np.max(priors.sigma[of_radii] / priors.mean[of_radii]))
        errors.append(_Error(RADII, {}, of_priors(radii), common))
    return errors


def _of_held(linear: FitLinear, names: Collection[str]) -> dict[str, Array]:
    """Return the changes of residuals by held parameters that are too large by one unit."""
    legs, held = linear.problem.legs, linear.problem.choices.fixed
    parametrization, values = legs.parametrization, legs.vector(linear.state.legs)
    lengths = [
        value if name in names and name in held else 0.0
        for name, value in zip(parametrization.names, values.tolist(), strict=True)
    ]
    if not any(lengths):
        return {}
    place = parametrization.place
    error = np.where(place >= 0, np.array(lengths)[place], 0.0)
    return residual_changes(linear, "legs", error)
