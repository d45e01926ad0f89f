"""Outliers among the readings of redundant motors: found, named, left out.

Every reading is tested by its residual over the standard deviation that this has if the reading is
right, the root of its redundancy (Baarda's data snooping); the largest of a pose names the wrong
one, unless another one explains as much. The first fits have rough readings, so that single wrong
ones stand out; with the stated standard deviations they would bend the model, and outlines would
seem to be wrong in their place.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from legcal.calibration.joint_fit.factors import ActuatorReadings, Readings
from legcal.calibration.joint_fit.problem import FitProblem
from legcal.calibration.joint_fit.variables import RefinementSettings, State
from legcal.data import few
from legcal.estimation import (
    Linearization,
    NormalEquations,
    PseudoHuber,
    explained_share,
    information,
    linearize,
)
from legcal.files import SHOWN_IN
from legcal.geometry import Array, BoolArray, IntArray

_FACTORS = "readings", "actuator_readings"
_ROUGH = 6e-5  # standard deviation of rough readings, as far as they move a joint [m]
_MIN_REDUNDANCY = 1e-3  # of a reading that something else says anything about
_AS_LIKELY = 25.0  # difference of squared tests from which one reading is clearly the wrong one
_MOST_OF_MOTOR = 0.1  # of the readings of a motor that may be wrong by accident
_MIN_COUNT = 3  # that are no accident
_SIGNIFICANT = 5.0  # standard deviations of the sum of squares of residuals


@dataclass(frozen=True, eq=False)
class WrongReading:
    """A reading that was left out."""

    leg: int
    pose: int  # as the fit counts them
    motor: str  # leg, or the joint that moves A
    view: str
    image: str
    off: float  # how far it is above what all else shows [m or rad]
    unit: Literal["m", "rad"]


@dataclass(frozen=True, eq=False)
class JudgedReadings:
    """What a fit says of the readings of redundant motors."""

    wrong: tuple[WrongReading, ...]
    rms: float  # of the residuals of the others, over their standard deviations
    rms_expected: float  # the same if they are right: the fit follows each in part
    rms_m: float  # the same as far as they move joints [m]
    doubts: tuple[str, ...]  # why the result cannot be trusted, a sentence each


@dataclass(frozen=True, eq=False)
class _Tests:
    """Readings that are used, of both factors, and how well each agrees."""

    factor: IntArray  # (n,) index in _FACTORS
    number: IntArray  # (n,) in its factor
    leg: IntArray  # (n,)
    pose: IntArray  # (n,)
    r: Array  # (n,) residuals over their standard deviations
    redundancy: Array  # (n,) variance of r if the reading is right

    @property
    def squared(self) -> Array:
        """Squared residuals over their variance, 0 where nothing else tells of a reading."""
        told = self.redundancy > _MIN_REDUNDANCY
        return np.where(told, self.r**2 / np.maximum(self.redundancy, _MIN_REDUNDANCY), 0.0)


def with_rough_readings(problem: FitProblem) -> FitProblem:
    """Return the problem with rough readings under the loss, if they can contradict each other."""
    if not problem.legs.is_redundant:
        return problem
    rough = []
    for name, readings in zip(_FACTORS, _readings(problem), strict=True):
        factor = problem.factor(name)
        least = np.array([problem.legs.nominal[j].reading_of(_ROUGH) for j in readings.leg])
        used = np.asarray(factor.whitening)[:, 0, 0] > 0.0
        weight = used / np.maximum(readings.sigma, least)
        rough.append(replace(factor, whitening=weight[:, None, None], robust=True))
    return problem.with_factors(*rough)


def like_readings(problem: FitProblem, other: FitProblem) -> FitProblem:
    """Return a problem that leaves out the readings that another one leaves out."""
    found = []
    for name in _FACTORS:
        factor = problem.factor(name)
        used = np.asarray(other.factor(name).whitening) > 0.0
        found.append(replace(factor, whitening=used * np.asarray(factor.whitening)))
    return problem.with_factors(*found)


def with_judged_readings(
    problem: FitProblem, state: State, settings: RefinementSettings
) -> tuple[FitProblem, bool]:
    """Return the problem without the clearly wrong reading of every pose; say if there was one."""
    linear = linearize(problem, state)
    normal = information(problem, state, linear, PseudoHuber(settings.loss_width))
    tests = _tests(problem, linear, normal)
    out: list[list[int]] = [[], []]
    scale = max(1.0, _scale(tests))
    for pose in np.unique(tests.pose).tolist():
        best, is_clear = _worst(tests, pose, scale * settings.rejection)
        if best is not None and is_clear:
            out[int(tests.factor[best])].append(int(tests.number[best]))
    if not any(out):
        return problem, False
    changed = []
    for name, numbers in zip(_FACTORS, out, strict=True):
        factor = problem.factor(name)
        whitening = np.array(factor.whitening)
        whitening[numbers] = 0.0
        changed.append(replace(factor, whitening=whitening))
    return problem.with_factors(*changed), True


def with_agreeing_readings(
    problem: FitProblem, every: FitProblem, state: State, settings: RefinementSettings
) -> tuple[FitProblem, bool]:
    """Return the problem with the readings that agree after all; say if there was one.

    They were left out near a model that was still wrong. *every* is the problem that uses all. A
    reading that is out has the variance 1 + that of its prediction, over its own.
    """
    restored = problem.with_factors(*map(every.factor, _FACTORS))
    linear = linearize(problem, state)
    normal = information(problem, state, linear, PseudoHuber(settings.loss_width))
    most = settings.rejection * max(1.0, _scale(_tests(problem, linear, normal)))
    linear, back = linearize(restored, state), list[BoolArray]()
    for name in _FACTORS:
        predicted = explained_share(restored, linear, normal, name)[:, 0, 0]
        agrees = linear[name].r[:, 0] ** 2 <= most**2 * (1.0 + predicted)
        back.append(agrees & _used(every, name) & ~_used(problem, name))
    if not any(one.any() for one in back):
        return problem, False
    changed = []
    for name, agrees in zip(_FACTORS, back, strict=True):
        factor = every.factor(name)
        used = _used(problem, name) | agrees
        whitening = np.where(used[:, None, None], factor.whitening, 0.0)
        changed.append(replace(factor, whitening=whitening))
    return problem.with_factors(*changed), True


def judged_readings(
    problem: FitProblem,
    state: State,
    linear: Linearization,
    normal: NormalEquations,
    settings: RefinementSettings,
) -> JudgedReadings | None:
    """Return which readings a fit left out, and how the others agree; None if they always do."""
    if not problem.legs.is_redundant:
        return None
    legs, wrong = problem.legs.nominal, list[WrongReading]()
    for name, readings in zip(_FACTORS, _readings(problem), strict=True):
        off = readings.wrong_by(problem.factor(name).rows(state))
        for k in np.flatnonzero(~_used(problem, name)).tolist():
            leg, pose = int(readings.leg[k]), int(readings.pose[k])
            where, unit = _first_image(problem, pose), legs[leg].reading_unit
            motor = legs[leg].motor_label
            wrong.append(WrongReading(leg, pose, motor, *where, float(off[k]), unit))
    tests = _tests(problem, linear, normal)
    sigma = np.concatenate([readings.sigma for readings in _readings(problem)])
    used = np.concatenate([_used(problem, name) for name in _FACTORS])
    distance = np.array([1.0 / legs[j].reading_of(1.0) for j in tests.leg.tolist()])
    moved = tests.r * sigma[used] * distance
    rms, rms_m = (float(np.sqrt(np.mean(x**2))) for x in (tests.r, moved))
    expected = float(np.sqrt(np.mean(tests.redundancy)))
    doubts = _doubts(problem, tests, wrong, settings)
    return JudgedReadings(tuple(wrong), rms, expected, rms_m, doubts)


def reading_notes(judged: JudgedReadings | None) -> tuple[str, ...]:
    """Return a sentence on readings that were left out, if any."""
    if judged is None or not judged.wrong:
        return ()
    named = few([_in_words(wrong) for wrong in judged.wrong])
    n = len(judged.wrong)
    reading, was = ("readings", "were") if n > 1 else ("reading", "was")
    return (
        f"{n} {reading} of redundant motors contradict{'s' * (n == 1)} all other measurements and "
        f"{was} left out: {named}; check {'them' if n > 1 else 'it'}.",
    )


def _in_words(wrong: WrongReading) -> str:
    """Return whose reading it is, of which image, and by how much it is wrong."""
    size, unit = SHOWN_IN[wrong.unit]
    return f"{wrong.motor} in {wrong.view}, image {wrong.image} by {size * wrong.off:+.3g} {unit}"


def _first_image(problem: FitProblem, pose: int) -> tuple[str, str]:
    """Return the first view and image of a pose."""
    view = min(view for view, other in problem.images if other == pose)
    return problem.outlines.views[view], problem.images[view, pose]


def _doubts(
    problem: FitProblem, tests: _Tests, wrong: list[WrongReading], settings: RefinementSettings
) -> tuple[str, ...]:
    """Return why readings leave a result in doubt."""
    legs, doubts = problem.legs.nominal, list[str]()
    for leg in dict.fromkeys(one.leg for one in wrong):
        of_motor = [one for one in wrong if one.leg == leg]
        n = len(of_motor) + int(np.sum(tests.leg == leg))
        if len(of_motor) >= max(_MIN_COUNT, _MOST_OF_MOTOR * n):
            worst = max(of_motor, key=lambda one: abs(one.off))
            doubts.append(
                f"{len(of_motor)} of {n} readings of {legs[leg].motor_label} contradict the other "
                f"measurements, most {_in_words(worst)}, which is no accident; check the "
                "scale, the zero and the slip of that motor"
            )
    alike = list[str]()
    for pose in np.unique(tests.pose).tolist():
        best, is_clear = _worst(tests, pose, max(1.0, _scale(tests)) * settings.rejection)
        if best is not None and not is_clear:
            view, image = _first_image(problem, pose)
            alike.append(f"{view}, image {image} ({few(_as_likely(problem, tests, pose))})")
    if alike:
        doubts.append(
            f"the readings of {few(alike)} contradict each other, and the measurements do not tell "
            "which of these motors is wrong; check them, or take the images out"
        )
    expected, found = float(tests.redundancy.sum()), float(np.sum(tests.r**2))
    if found > expected + _SIGNIFICANT * np.sqrt(2.0 * expected):
        times = np.sqrt(found / max(expected, 1.0))
        squared = tests.squared
        motors = np.unique(tests.leg)
        leg = int(motors[np.argmax([squared[tests.leg == j].mean() for j in motors])])
        doubts.append(
            f"the readings of redundant motors contradict each other and the images {times:.1f} "
            f"times as much as their standard deviations allow, those of {legs[leg].motor_label} "
            "most; check the scale, the zero and the slip of the motors, or state the standard "
            "deviations of their readings"
        )
    return tuple(doubts)


def _as_likely(problem: FitProblem, tests: _Tests, pose: int) -> list[str]:
    """Return the motors of which one is as likely wrong as another at a pose."""
    own = np.flatnonzero(tests.pose == pose)
    squared = tests.squared[own]
    return [
        problem.legs.nominal[int(tests.leg[own[k]])].motor_label
        for k in np.argsort(-squared).tolist()
        if squared.max() - squared[k] < _AS_LIKELY
    ]


def _worst(tests: _Tests, pose: int, most: float) -> tuple[int | None, bool]:
    """Return the reading of a pose that agrees least, if beyond *most*, and whether it is clear."""
    own = np.flatnonzero(tests.pose == pose)
    order = own[np.argsort(-tests.squared[own])]
    squared = tests.squared[order]
    if not squared[0] > most**2:
        return None, False
    return int(order[0]), len(squared) < 2 or bool(squared[0] - squared[1] > _AS_LIKELY)


def _scale(tests: _Tests) -> float:
    """Return how many times their standard deviations the residuals of most readings are."""
    told = tests.redundancy > _MIN_REDUNDANCY
    return float(np.sqrt(np.median(tests.squared[told])) / 0.6745) if told.any() else 0.0


def _tests(problem: FitProblem, linear: Linearization, normal: NormalEquations) -> _Tests:
    """Return the tests of the readings that are used."""
    parts = []
    for i, (name, readings) in enumerate(zip(_FACTORS, _readings(problem), strict=True)):
        used = np.flatnonzero(_used(problem, name))
        if not len(readings):
            continue
        share = explained_share(problem, linear, normal, name)[used, 0, 0]
        r = linear[name].r[used, 0]
        parts.append(
            (np.full(len(used), i), used, readings.leg[used], readings.pose[used], r, 1.0 - share)
        )
    return _Tests(*(np.concatenate(column) for column in zip(*parts, strict=True)))


def _used(problem: FitProblem, name: str) -> BoolArray:
    return np.asarray(np.asarray(problem.factor(name).whitening)[:, 0, 0] > 0.0)


def _readings(problem: FitProblem) -> tuple[Readings | ActuatorReadings, ...]:
    return problem.readings, problem.observed.actuator_readings
