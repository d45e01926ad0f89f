"""Outliers among the readings of redundant motors: detected, reported, rejected.

The tests are those before image measurement (``ReadingTests``), here against all measurements. The
first fits use inflated standard deviations of readings, so that single outliers stand out; with the
stated ones they would bias the model, and outlines would be rejected instead.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np
from pydantic import Field

from legcal.calibration.documents import RedundantReadings, WrongReadingBlock
from legcal.calibration.joint_fit.problem import FitLinear, FitNormal, FitProblem
from legcal.calibration.joint_fit.variables import State
from legcal.estimation.problem import linearize
from legcal.estimation.solver import information, normal_equations
from legcal.estimation.uncertainty import leverage, score_test
from legcal.files.quantity import SHOWN_IN
from legcal.files.schema import few
from legcal.geometry.types import BoolArray
from legcal.machine.redundancy import AS_LIKELY, MIN_REDUNDANCY, ROUGH_READING, ReadingTests

_MAX_SHARE_OF_MOTOR = 0.1  # of the readings of a motor that may be outliers by accident
_MIN_COUNT = 3  # outliers of a motor that are no accident
_INSEPARABLE = 1e-4  # 1 - rho^2 of tests of errors that cannot be separated
_NO_INFORMATION = 1e-12  # floor of the information on an error
_SIGNIFICANT = 5.0  # standard deviations of the sum of squared residuals


class WrongReading(WrongReadingBlock):
    """A rejected reading, with the leg and the pose in the fit."""

    leg: int = Field(exclude=True)
    pose: int = Field(exclude=True)


class JudgedReadings(RedundantReadings):
    """Rejected readings of redundant motors, and the residuals of the others."""

    wrong: tuple[WrongReading, ...]
    # reasons to distrust the result, each with its remedy
    doubts: tuple[tuple[str, str], ...] = Field(exclude=True)

    def renumbered(self, legs: Sequence[int], poses: Mapping[int, int]) -> JudgedReadings:
        """Renumber legs and poses."""
        wrong = (
            one.model_copy(update={"leg": legs[one.leg], "pose": poses[one.pose]})
            for one in self.wrong
        )
        return self.model_copy(update={"wrong": tuple(wrong)})


def with_inflated_reading_noise(problem: FitProblem) -> FitProblem:
    """Inflate the noise of redundant readings and put them under the robust loss."""
    if not problem.legs.is_redundant:
        return problem
    factor, readings = problem.factor("readings"), problem.readings
    least = [problem.legs.nominal[j].reading_of(ROUGH_READING) for j in readings.leg.tolist()]
    weight = _used(problem) / np.maximum(readings.sigma, least)
    return problem.with_factors(replace(factor, whitening=weight[:, None, None], robust=True))


def with_rejected_readings_of(problem: FitProblem, other: FitProblem) -> FitProblem:
    """Reject the readings that another problem rejects."""
    return _using(problem, problem, _used(problem) & _used(other))


def reject_outlier_readings(problem: FitProblem, state: State) -> tuple[FitProblem, bool]:
    """Reject one outlier per pose where it can be identified; also return whether any was.

    At a pose without other measurements any of the suspects is rejected: the remaining readings
    are consistent and carry no information on the machine.
    """
    linear = linearize(problem, state)
    tests = _tests(information(linear, problem.loss))
    used, is_changed = _used(problem), False
    index = np.flatnonzero(used)
    for pose in np.unique(tests.pose).tolist():
        suspects = _suspects_of_pose(linear, tests, pose)
        if len(suspects) == 1 or (suspects and not _has_other_measurements(problem, pose)):
            used[index[suspects[0]]] = False
            is_changed = True
    return (_using(problem, problem, used) if is_changed else problem), is_changed


def restore_inlier_readings(
    problem: FitProblem, complete: FitProblem, state: State
) -> tuple[FitProblem, bool]:
    """Restore rejected readings that are inliers after all; also return whether any was.

    They were rejected when the model was still wrong. *complete* is the problem with all readings.
    The whitened residual of a rejected reading has the variance 1 + C, C that of its prediction.
    """
    restored = problem.with_factors(complete.factor("readings"))
    normal = information(linearize(problem, state), problem.loss)
    limit = problem.settings.rejection * _tests(normal).scale
    linear = linearize(restored, state)
    predicted = leverage(normal, "readings", linear=linear)[:, 0, 0]
    agrees = linear["readings"].r[:, 0] ** 2 <= limit**2 * (1.0 + predicted)
    restored_now = agrees & _used(complete) & ~_used(problem)
    used, is_changed = _used(problem) | restored_now, bool(restored_now.any())
    return (_using(problem, complete, used) if is_changed else problem), is_changed


def judged_readings(normal: FitNormal) -> JudgedReadings | None:
    """Summarise rejected and used readings of a fit; None without redundant motors."""
    problem, state = normal.problem, normal.state
    if not problem.legs.is_redundant:
        return None
    legs, wrong = problem.legs.nominal, list[WrongReading]()
    readings, used = problem.readings, _used(problem)
    off = -readings.sign * readings.rows(state).r[:, 0]  # measured minus predicted
    for k in np.flatnonzero(~used).tolist():
        leg, pose = int(readings.leg[k]), int(readings.pose[k])
        (view, image), alike = _first_image(problem, pose), list[str]()
        if not _has_other_measurements(problem, pose):
            factor = problem.factor("readings")
            whitening = np.array(factor.whitening)
            whitening[k] = 1.0 / readings.sigma[k]
            restored = problem.with_factors(replace(factor, whitening=whitening))
            linear_with = linearize(restored, state)
            tests_with = _tests(information(linear_with, problem.loss))
            alike = [
                legs[int(tests_with.leg[i])].motor_label
                for i in _suspects_of_pose(linear_with, tests_with, pose)
                if tests_with.leg[i] != leg
            ]
        wrong.append(
            WrongReading(
                motor=legs[leg].motor_label,
                view=view,
                image=image,
                off=float(off[k]),
                unit=legs[leg].reading_unit,
                alike=tuple(alike),
                leg=leg,
                pose=pose,
            )
        )
    tests = _tests(normal)
    assumed = 1.0 / np.asarray(problem.factor("readings").whitening)[used, 0, 0]
    tests = replace(tests, r=tests.r * assumed / readings.sigma[used])  # of what is stated
    distance = np.array([1.0 / legs[j].reading_of(1.0) for j in tests.leg.tolist()])
    displacements = tests.r * readings.sigma[used] * distance
    rms, rms_m = (float(np.sqrt(np.mean(x**2))) for x in (tests.r, displacements))
    expected = float(np.sqrt(np.mean(tests.redundancy)))
    doubts = _doubts(normal.linear, tests, wrong)
    return JudgedReadings(
        wrong=tuple(wrong), rms=rms, rms_expected=expected, rms_m=rms_m, doubts=doubts
    )


def reading_notes(judged: JudgedReadings | None) -> tuple[str, ...]:
    """Return a note on rejected readings, if any."""
    if judged is None or not judged.wrong:
        return ()
    listed = few([_in_words(wrong) for wrong in judged.wrong])
    n = len(judged.wrong)
    reading, was = ("readings", "were") if n > 1 else ("reading", "was")
    return (
        f"{n} {reading} of redundant motors contradict{'s' * (n == 1)} all other measurements and "
        f"{was} rejected: {listed}; check {'them' if n > 1 else 'it'}.",
    )


def _in_words(wrong: WrongReading) -> str:
    """Motor, image and error of a rejected reading, in words."""
    scale, unit = SHOWN_IN[wrong.unit]
    alternatives = f" (or {' or '.join(wrong.alike)}, equally likely)" if wrong.alike else ""
    place = f"{wrong.view}, image {wrong.image}"
    return f"{wrong.motor}{alternatives} in {place} by {scale * wrong.off:+.3g} {unit}"


def _first_image(problem: FitProblem, pose: int) -> tuple[str, str]:
    """First view and image of a pose."""
    view = min(view for view, other in problem.images if other == pose)
    return problem.outlines.views[view], problem.images[view, pose]


def _doubts(
    linear: FitLinear, tests: ReadingTests, wrong: list[WrongReading]
) -> tuple[tuple[str, str], ...]:
    """Reasons why readings put the result in doubt, each with its remedy."""
    problem = linear.problem
    legs, doubts = problem.legs.nominal, list[tuple[str, str]]()
    for leg in dict.fromkeys(reading.leg for reading in wrong):
        of_motor = [reading for reading in wrong if reading.leg == leg]
        n = len(of_motor) + int(np.sum(tests.leg == leg))
        if len(of_motor) >= max(_MIN_COUNT, _MAX_SHARE_OF_MOTOR * n):
            worst = max(of_motor, key=lambda reading: abs(reading.off))
            what = (
                f"{len(of_motor)} of {n} readings of {legs[leg].motor_label} contradict the other "
                f"measurements, most of all {_in_words(worst)}: too many to be random"
            )
            doubts.append((what, "check the scale, zero and slip of that motor"))
    undecided = list[str]()
    for pose in np.unique(tests.pose).tolist():
        suspects = _suspects_of_pose(linear, tests, pose)
        if len(suspects) > 1:
            view, image = _first_image(problem, pose)
            labels = [legs[j].motor_label for j in tests.leg[suspects].tolist()]
            undecided.append(f"{view}, image {image} ({few(labels)})")
    if undecided:
        what = (
            f"the readings of {few(undecided)} contradict each other, and the measurements do not "
            "show which motor is wrong"
        )
        doubts.append((what, "check them, or remove the images"))
    expected_squares, squares = float(tests.redundancy.sum()), float(np.sum(tests.r**2))
    if squares > expected_squares + _SIGNIFICANT * np.sqrt(2.0 * expected_squares):
        ratio = np.sqrt(squares / max(expected_squares, 1.0))
        what = (
            f"the readings of redundant motors contradict each other and the images {ratio:.1f} "
            "times as much as their standard deviations allow"
        )
        remedy = (
            "check the scale, zero and slip of the motors, or state the standard deviations of "
            "their readings"
        )
        doubts.append((what, remedy))
    return tuple(doubts)


def _suspects_of_pose(linear: FitLinear, tests: ReadingTests, pose: int) -> list[int]:
    """Suspect readings of a pose, of which one is wrong, the likeliest first.

    A robust loss assigns a contradiction to one of several readings that explain it equally well.
    Readings that cannot be separated from the likeliest one are therefore suspects too: 1 - rho^2
    is small, with rho the correlation of their tests.
    """
    problem = linear.problem
    suspects = tests.of_pose(pose, problem.settings.rejection, tests.scale)
    if not suspects:
        return []
    index = np.flatnonzero(_used(problem))
    readings_of_pose = [
        suspects[0],
        *(i for i in np.flatnonzero(tests.pose == pose).tolist() if i != suspects[0]),
    ]
    column = np.zeros((len(problem.readings), 1, len(readings_of_pose)))
    column[index[readings_of_pose], 0, np.arange(len(readings_of_pose))] = 1.0
    _, K = score_test(normal_equations(linear), {"readings": column})
    variance = np.maximum(np.diagonal(K), _NO_INFORMATION)
    unexplained = 1.0 - K[0] ** 2 / (variance[0] * variance)
    threshold = AS_LIKELY * tests.scale**2 / tests.squared[suspects[0]]
    alike = [
        i
        for i, share in zip(readings_of_pose[1:], unexplained[1:], strict=True)
        if share <= max(threshold, _INSEPARABLE)
    ]
    return [*suspects, *(i for i in alike if i not in suspects)]


def _has_other_measurements(problem: FitProblem, pose: int) -> bool:
    """Whether a pose has measurements besides readings."""
    return any(
        bool(np.any(np.asarray(f.whitening)[f.element == pose] != 0.0))
        for f in problem.factors
        if f.robust and f.name != "readings" and f.element is not None and f.n
    )


def _tests(normal: FitNormal) -> ReadingTests:
    """Test the used readings."""
    readings, used = normal.problem.readings, np.flatnonzero(_used(normal.problem))
    share = leverage(normal, "readings")[used, 0, 0]
    redundancy = np.where(1.0 - share > MIN_REDUNDANCY, 1.0 - share, 0.0)
    r = normal.linear["readings"].r[used, 0]
    return ReadingTests(readings.pose[used], readings.leg[used], r, redundancy)


def _using(problem: FitProblem, complete: FitProblem, used: BoolArray) -> FitProblem:
    """Use the readings *used*, weighted as in the *complete* problem."""
    factor = complete.factor("readings")
    whitening = np.where(used[:, None, None], factor.whitening, 0.0)
    return problem.with_factors(replace(factor, whitening=whitening))


def _used(problem: FitProblem) -> BoolArray:
    return np.asarray(np.asarray(problem.factor("readings").whitening)[:, 0, 0] > 0.0)
