"""Outliers among the readings of redundant motors: found, named, left out.

Every reading is tested as it is before images are searched (``ReadingTests``),
here against all measurements. The first fits have rough readings, so that single wrong ones stand
out; with the stated standard deviations they would bend the model, and outlines would seem to be
wrong in their place.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from legcal.calibration.joint_fit.factors import ActuatorReadings, Readings
from legcal.calibration.joint_fit.problem import FitProblem
from legcal.calibration.joint_fit.variables import State
from legcal.data.measurements import few
from legcal.estimation.problem import Linearization, linearize
from legcal.estimation.solver import NormalEquations, information, normal_equations
from legcal.estimation.uncertainty import explained_share, score_test
from legcal.files.quantity import SHOWN_IN
from legcal.geometry.types import Array, BoolArray, IntArray
from legcal.machine.redundancy import AS_LIKELY, MIN_REDUNDANCY, ROUGH_READING, ReadingTests

_FACTORS = "readings", "actuator_readings"
_MOST_OF_MOTOR = 0.1  # of the readings of a motor that may be wrong by accident
_MIN_COUNT = 3  # that are no accident
_SAME = 1e-4  # part of a test that an error of another reading leaves: not told apart
_NOTHING = 1e-12  # information on a scale of which nothing tells
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
    alike: tuple[str, ...] = ()  # other motors one of which may be meant as well


@dataclass(frozen=True, eq=False)
class JudgedReadings:
    """What a fit says of the readings of redundant motors."""

    wrong: tuple[WrongReading, ...]
    rms: float  # of the residuals of the others, over their standard deviations
    rms_expected: float  # the same if they are right: the fit follows each in part
    rms_m: float  # the same as far as they move joints [m]
    doubts: tuple[str, ...]  # why the result cannot be trusted, a sentence each

    def renumbered(self, legs: Sequence[int], poses: Mapping[int, int]) -> JudgedReadings:
        """Return the same with other numbers of legs and poses."""
        wrong = (replace(one, leg=legs[one.leg], pose=poses[one.pose]) for one in self.wrong)
        return replace(self, wrong=tuple(wrong))


def with_rough_readings(problem: FitProblem) -> FitProblem:
    """Return the problem with rough readings under the loss, if they can contradict each other."""
    if not problem.legs.is_redundant:
        return problem
    rough = []
    for name, readings in zip(_FACTORS, _readings(problem), strict=True):
        factor = problem.factor(name)
        least = np.array([problem.legs.nominal[j].reading_of(ROUGH_READING) for j in readings.leg])
        used = np.asarray(factor.whitening)[:, 0, 0] > 0.0
        weight = used / np.maximum(readings.sigma, least)
        rough.append(replace(factor, whitening=weight[:, None, None], robust=True))
    return problem.with_factors(*rough)


def like_readings(problem: FitProblem, other: FitProblem) -> FitProblem:
    """Return a problem that leaves out the readings that another one leaves out."""
    used = [_used(problem, name) & _used(other, name) for name in _FACTORS]
    return _using(problem, problem, used)


def with_judged_readings(problem: FitProblem, state: State) -> tuple[FitProblem, bool]:
    """Return the problem without the wrong reading of every pose; say if there was one.

    Of a pose that nothing but readings shows any of those that may be wrong will do: the others
    agree then, and say nothing of the machine.
    """
    linear = linearize(problem, state)
    normal = information(problem, state, linear, problem.loss)
    tests = _tests(problem, linear, normal)
    of_factor, number = _numbers(problem)
    used = [_used(problem, name) for name in _FACTORS]
    is_changed = False
    for pose in np.unique(tests.pose).tolist():
        found = _of_pose(problem, state, linear, tests, pose)
        if len(found) == 1 or (found and not _is_shown(problem, pose)):
            used[int(of_factor[found[0]])][number[found[0]]] = False
            is_changed = True
    return (_using(problem, problem, used) if is_changed else problem), is_changed


def with_agreeing_readings(
    problem: FitProblem, every: FitProblem, state: State
) -> tuple[FitProblem, bool]:
    """Return the problem with the readings that agree after all; say if there was one.

    They were left out near a model that was still wrong. *every* is the problem that uses all. A
    reading that is out has the variance 1 + that of its prediction, over its own.
    """
    restored = problem.with_factors(*map(every.factor, _FACTORS))
    linear = linearize(problem, state)
    normal = information(problem, state, linear, problem.loss)
    most = problem.settings.rejection * _tests(problem, linear, normal).scale
    linear, used, is_changed = linearize(restored, state), list[BoolArray](), False
    for name in _FACTORS:
        predicted = explained_share(restored, linear, normal, name)[:, 0, 0]
        agrees = linear[name].r[:, 0] ** 2 <= most**2 * (1.0 + predicted)
        back = agrees & _used(every, name) & ~_used(problem, name)
        used.append(_used(problem, name) | back)
        is_changed |= bool(back.any())
    return (_using(problem, every, used) if is_changed else problem), is_changed


def judged_readings(
    problem: FitProblem,
    state: State,
    linear: Linearization,
    normal: NormalEquations,
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
            motor, alike = legs[leg].motor_label, list[str]()
            if not _is_shown(problem, pose):
                whole = _with_used(problem, name, k)
                again = linearize(whole, state)
                every = _tests(whole, again, information(whole, state, again, whole.loss))
                alike = [
                    legs[int(every.leg[i])].motor_label
                    for i in _of_pose(whole, state, again, every, pose)
                    if every.leg[i] != leg
                ]
            wrong.append(WrongReading(leg, pose, motor, *where, float(off[k]), unit, tuple(alike)))
    tests = _tests(problem, linear, normal)
    sigma = np.concatenate([readings.sigma for readings in _readings(problem)])
    used = np.concatenate([_used(problem, name) for name in _FACTORS])
    distance = np.array([1.0 / legs[j].reading_of(1.0) for j in tests.leg.tolist()])
    moved = tests.r * sigma[used] * distance
    rms, rms_m = (float(np.sqrt(np.mean(x**2))) for x in (tests.r, moved))
    expected = float(np.sqrt(np.mean(tests.redundancy)))
    doubts = _doubts(problem, state, linear, tests, wrong)
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
    alike = f" (or as likely one of {', '.join(wrong.alike)})" if wrong.alike else ""
    where = f"{wrong.view}, image {wrong.image}"
    return f"{wrong.motor}{alike} in {where} by {size * wrong.off:+.3g} {unit}"


def _first_image(problem: FitProblem, pose: int) -> tuple[str, str]:
    """Return the first view and image of a pose."""
    view = min(view for view, other in problem.images if other == pose)
    return problem.outlines.views[view], problem.images[view, pose]


def _doubts(
    problem: FitProblem,
    state: State,
    linear: Linearization,
    tests: ReadingTests,
    wrong: list[WrongReading],
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
        found = _of_pose(problem, state, linear, tests, pose)
        if len(found) > 1:
            view, image = _first_image(problem, pose)
            labels = [legs[j].motor_label for j in tests.leg[found].tolist()]
            alike.append(f"{view}, image {image} ({few(labels)})")
    if alike:
        doubts.append(
            f"the readings of {few(alike)} contradict each other, and the measurements do not tell "
            "which of these motors is wrong; check them, or take the images out"
        )
    expected, missed = float(tests.redundancy.sum()), float(np.sum(tests.r**2))
    if missed > expected + _SIGNIFICANT * np.sqrt(2.0 * expected):
        times = np.sqrt(missed / max(expected, 1.0))
        plain = normal_equations(problem, state, linear)
        doubts.append(
            f"the readings of redundant motors contradict each other and the images {times:.1f} "
            f"times as much as their standard deviations allow, {_most(problem, linear, plain)}; "
            "check the scale, the zero and the slip of the motors, or state the standard "
            "deviations of their readings"
        )
    return tuple(doubts)


def _of_pose(
    problem: FitProblem,
    state: State,
    linear: Linearization,
    tests: ReadingTests,
    pose: int,
) -> list[int]:
    """Return the readings of a pose one of which is wrong, the likeliest first.

    A robust loss leaves a contradiction to one of the readings that explain it alike. So those
    count as alike, too, whose errors the measurements do not tell from that of the likeliest: the
    part of its test that theirs does not explain is 1 - rho^2, rho the correlation of both tests.
    """
    found = tests.of_pose(pose, problem.settings.rejection, tests.scale)
    if not found:
        return []
    factor, number = _numbers(problem)
    own = [found[0], *(i for i in np.flatnonzero(tests.pose == pose).tolist() if i != found[0])]
    columns = {
        name: np.zeros((len(readings), 1, len(own)))
        for name, readings in zip(_FACTORS, _readings(problem), strict=True)
        if len(readings)
    }
    for c, i in enumerate(own):
        columns[_FACTORS[int(factor[i])]][number[i], 0, c] = 1.0
    _, K = score_test(problem, linear, normal_equations(problem, state, linear), columns)
    variance = np.maximum(np.diagonal(K), _NOTHING)
    apart = 1.0 - K[0] ** 2 / (variance[0] * variance)
    enough = AS_LIKELY * tests.scale**2 / tests.squared[found[0]]
    alike = [i for i, a in zip(own[1:], apart[1:], strict=True) if a <= max(enough, _SAME)]
    return [*found, *(i for i in alike if i not in found)]


def _is_shown(problem: FitProblem, pose: int) -> bool:
    """Say whether anything but readings is measured at a pose."""
    return any(
        bool(np.any(np.asarray(f.whitening)[f.element == pose] != 0.0))
        for f in problem.factors
        if f.robust and f.name not in _FACTORS and f.element is not None and f.n
    )


def _with_used(problem: FitProblem, name: str, number: int) -> FitProblem:
    """Return the problem with a reading that it leaves out."""
    factor = problem.factor(name)
    readings = dict(zip(_FACTORS, _readings(problem), strict=True))[name]
    whitening = np.array(factor.whitening)
    whitening[number] = 1.0 / readings.sigma[number]
    return problem.with_factors(replace(factor, whitening=whitening))


def _most(problem: FitProblem, linear: Linearization, normal: NormalEquations) -> str:
    """Return whose scale explains most of what readings miss, all else following (Rao's test)."""
    legs, columns = problem.legs.nominal, dict[str, Array]()
    motors = sorted({int(j) for readings in _readings(problem) for j in readings.leg})
    for name, readings in zip(_FACTORS, _readings(problem), strict=True):
        if len(readings):
            of_motor = readings.leg[:, None] == np.array(motors)
            by_scale = of_motor * readings.by_scale[:, None]
            columns[name] = np.asarray(problem.factor(name).whitening) @ by_scale[:, None]
    score, left = score_test(problem, linear, normal, columns)
    K = np.maximum(np.diagonal(left), _NOTHING)
    squared = score**2 / K
    order = np.argsort(-squared)
    alike = order[squared[order[0]] - squared[order] <= AS_LIKELY]
    first = int(order[0])
    labels = few([legs[motors[i]].motor_label for i in alike.tolist()])
    if len(alike) > 1:
        return f"and the scales of {labels} explain most of that alike"
    return (
        f"and a scale of {labels} that is {100 * score[first] / K[first]:+.2g} % off explains most"
    )


def _tests(problem: FitProblem, linear: Linearization, normal: NormalEquations) -> ReadingTests:
    """Return the tests of the readings that are used, of both factors."""
    parts = []
    for name, readings in zip(_FACTORS, _readings(problem), strict=True):
        used = np.flatnonzero(_used(problem, name))
        if not len(readings):
            continue
        share = explained_share(problem, linear, normal, name)[used, 0, 0]
        redundancy = np.where(1.0 - share > MIN_REDUNDANCY, 1.0 - share, 0.0)
        r = linear[name].r[used, 0]
        parts.append((readings.pose[used], readings.leg[used], r, redundancy))
    return ReadingTests(*(np.concatenate(column) for column in zip(*parts, strict=True)))


def _numbers(problem: FitProblem) -> tuple[IntArray, IntArray]:
    """Return factor and number of every reading that is used."""
    used = [np.flatnonzero(_used(problem, name)) for name in _FACTORS]
    of_factor = np.repeat(np.arange(len(used)), [len(one) for one in used])
    return of_factor, np.concatenate(used)


def _using(problem: FitProblem, every: FitProblem, used: Sequence[BoolArray]) -> FitProblem:
    """Return the problem with those readings of another one that are *used*, by factor."""
    factors = [every.factor(name) for name in _FACTORS]
    return problem.with_factors(
        *(
            replace(factor, whitening=np.where(own[:, None, None], factor.whitening, 0.0))
            for factor, own in zip(factors, used, strict=True)
        )
    )


def _used(problem: FitProblem, name: str) -> BoolArray:
    return np.asarray(np.asarray(problem.factor(name).whitening)[:, 0, 0] > 0.0)


def _readings(problem: FitProblem) -> tuple[Readings | ActuatorReadings, ...]:
    return problem.readings, problem.observed.actuator_readings
