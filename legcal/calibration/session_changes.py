"""Tests of a fit for what changed in the course of a session, and for how readings follow motors.

An encoder that slips, a camera that was bumped or refocused, photographs of a platform that still
moves: each is a number that the fit lacks, from some image on or in all images. Rao's score tests
ask the derivatives of the fit whether that number is zero, without another fit. Moments of changes
are scanned over the images in the order in which they were taken; where only the images of each
view have an order, over both sides for each other view. The most certain finding comes first, and
others are tested given those before, so that one cause is named once.

Errors that images share make scores scatter more than the covariances of outlines say; a score
counts in units of its scatter from image to image.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import product
from typing import Literal, NamedTuple

import numpy as np
from scipy.special import chdtrc, chdtri

from legcal.calibration.joint_fit.held_out import Posterior
from legcal.calibration.joint_fit.problem import FitProblem
from legcal.calibration.joint_fit.sensitivity import kinematic_steps
from legcal.calibration.joint_fit.variables import State
from legcal.data.measurements import Measurements, row_names
from legcal.estimation.problem import Linearization, linearize
from legcal.estimation.solver import NormalEquations, normal_equations
from legcal.estimation.uncertainty import residual_changes, response, score_test
from legcal.files.quantity import SHOWN_IN
from legcal.geometry.types import Array, BoolArray, IntArray

SIGNIFICANCE = 1e-4  # largest probability of a finding by chance, times the number of tests
MAX_FINDINGS = 3
ALL_MOTORS = "all motors"  # subject of a gain that they share
MAX_BLOCKS = 60  # groups of consecutive images between which changes are looked for
MIN_IMAGES = 3  # on each side of a change
_MAX_OTHER_VIEWS = 5  # views whose side of a change is tried
_HUBER = 3.0  # standard deviations from which on outlines count less
_UNSEEN = 1e-6  # part of the square of a column below which the fit absorbs it

Kind = Literal["encoder", "drift", "camera", "focal_length", "lag", "backlash", "gain"]
OF_MOTORS: frozenset[Kind] = frozenset(("encoder", "drift", "lag", "backlash", "gain"))


@dataclass(frozen=True, eq=False)
class Finding:
    """A number that a fit lacks.

    Attributes
    ----------
    kind : str
        What changed, or how readings follow motors.
    subject : str
        The motor or the view; "" where it is all motors.
    unit : str
        ``m``, ``rad`` or ``1``.
    amount, sigma : float
        The number; of a camera the angle or the distance, whichever is surer.
    between : (str, str) or None
        The images before and after a change; None where it is of all images.
    p_value : float
        Probability of such a score by chance, times the number of tests.
    steps : (p,) array
        The error of the kinematic parameters of the fit without the number, as in the
        parametrization of its problem.
    """

    kind: Kind
    subject: str
    unit: str
    amount: float
    sigma: float
    between: tuple[str, str] | None
    p_value: float
    steps: Array

    @property
    def size(self) -> str:
        """The amount with its standard deviation."""
        scale, unit = (100.0, "%") if self.unit == "1" else SHOWN_IN[self.unit]
        sigma = scale * self.sigma
        digits = max(1 - math.floor(math.log10(sigma)), 0) if sigma > 0.0 else 3
        sign = "" if self.kind in ("camera", "backlash") else "+"
        return f"{scale * self.amount:{sign}.{digits}f} ± {sigma:.{digits}f} {unit}"

    @property
    def what(self) -> str:
        """What was found, as a clause."""
        between = "" if self.between is None else f" between {' and '.join(self.between)}"
        return f"{_WORDS[self.kind][0].format(subject=self.subject, size=self.size)}{between}"

    @property
    def remedy(self) -> str:
        """What to do, as a clause."""
        return _WORDS[self.kind][1].format(subject=self.subject)


_WORDS: Mapping[Kind, tuple[str, str]] = {
    "encoder": (
        "the zero of the encoder of {subject} changed by {size}",
        "look for a slipped coupling or a lost home there, and leave the images before it, or "
        "those after it, out of measurements.csv",
    ),
    "drift": (
        "the zero of the encoder of {subject} drifts by {size} from the first image to the last",
        "look for a loose coupling or warming up there, and take the images again",
    ),
    "camera": (
        "the camera of {subject} moved by {size}",
        "make the images after it a view of their own in dataset.yaml and measurements.csv",
    ),
    "focal_length": (
        "the focal length of {subject} changed by {size}",
        "switch off autofocus and zoom; make the images after it a view of their own, with a "
        "camera file of their own",
    ),
    "lag": (
        "readings are ahead of the platform by {size} of the last move",
        "wait until the platform stands still before each photograph, and read the encoders then",
    ),
    "backlash": (
        "readings of {subject} differ by {size} with the direction of approach",
        "approach all poses from one side, and look for backlash there",
    ),
    "gain": (
        "readings of {subject} are {size} too large",
        "check the pitch or gear ratio of that motor, and its counts per turn",
    ),
}


@dataclass(frozen=True, eq=False)
class _Hypothesis:
    """A number that a fit lacks, by what a unit of it does to whitened residuals in each image."""

    kind: Kind
    subject: str
    unit: str
    columns: Mapping[str, Array]  # (n, q, d) of factors by name
    block: Mapping[str, IntArray]  # (n,) block of images of each residual; -1: none
    changes: bool  # from some image on; else in all images


class _Test(NamedTuple):
    """A hypothesis with the blocks of images in which it holds."""

    hypothesis: int
    holds: BoolArray  # (n_blocks,)
    at: tuple[int, int] | None  # the blocks before and after a change


@dataclass(frozen=True)
class SessionTests:
    """Tests of a session.

    Attributes
    ----------
    findings : tuple of Finding
        The numbers that the fit lacks, the most certain first.
    least_slips : dict
        The least changes of encoders that would show half of the time, by motor [m or rad].
    """

    findings: tuple[Finding, ...] = ()
    least_slips: Mapping[str, float] = field(default_factory=dict)


def session_tests(
    posterior: Posterior, measurements: Measurements, sequences: Sequence[IntArray]
) -> SessionTests:
    """Test a fit for numbers that it lacks.

    Parameters
    ----------
    posterior : Posterior
        The fit.
    measurements : Measurements
        The rows that were fitted.
    sequences : sequence of (n,) array
        Rows in the order of their images, as of
        :func:`legcal.data.image_order.image_sequences`.
    """
    if not len(posterior.problem.outlines) or not len(sequences):
        return SessionTests()
    posterior = replace(posterior, problem=_with_rejected(posterior))
    problem, state = posterior.problem, posterior.state
    course = _Course.of(posterior, measurements, sequences)
    linear = linearize(problem, state)
    normal = normal_equations(problem, state, linear)
    hypotheses = [*_of_motors(problem, course), *_of_views(problem, state, linear, course)]
    hypotheses = [h for h in hypotheses if any(c.any() for c in h.columns.values())]
    tests = [
        _Test(i, holds, at)
        for i, hypothesis in enumerate(hypotheses)
        for holds, at in (
            course.changes(_blocks_of(hypothesis, course.n_blocks))
            if hypothesis.changes
            else course.always
        )
    ]
    if not tests:
        return SessionTests()
    scores = _Scores.of(problem, linear, normal, hypotheses, course.n_blocks)
    least = math.sqrt(chdtri(1.0, SIGNIFICANCE / len(tests)))
    slips = dict[str, list[float]]()
    for test in tests:
        if hypotheses[test.hypothesis].kind == "encoder":
            sigma = math.sqrt(scores.estimate(test)[1][0, 0])
            slips.setdefault(hypotheses[test.hypothesis].subject, []).append(least * sigma)
    findings = list[Finding]()
    while len(findings) < MAX_FINDINGS:
        values = [scores.value(test) for test in tests]
        best = min(range(len(tests)), key=lambda i: (values[i][0], -values[i][1]))
        p_value = values[best][0] * len(tests)
        if p_value > SIGNIFICANCE:
            break
        test = tests[best]
        hypothesis = hypotheses[test.hypothesis]
        amount, covariance = scores.estimate(test)
        steps = _effect(problem, linear, normal, hypothesis, test.holds, amount)
        findings.append(
            Finding(
                hypothesis.kind,
                hypothesis.subject,
                *_size(hypothesis, amount, covariance),
                None if test.at is None else course.images(*test.at),
                p_value,
                steps,
            )
        )
        scores = scores.given(test)
        tests = [t for t in tests if t.hypothesis != test.hypothesis]
        if not tests:
            break
    least_slips = {motor: float(np.median(sizes)) for motor, sizes in slips.items()}
    return SessionTests(tuple(findings), least_slips)


def _with_rejected(posterior: Posterior) -> FitProblem:
    """Return the problem with rejected outlines, those far off with the weights of Huber's loss.

    A fit rejects the images on one side of a change where the other side has more.
    """
    problem, noise = posterior.problem, posterior.noise
    offsets, claimed = problem.offsets(posterior.state), problem.outlines.covariance
    distance = np.sqrt(noise.squared_norms(offsets, claimed))
    return problem.weighted(noise, _HUBER / np.maximum(distance, _HUBER))


def _size(hypothesis: _Hypothesis, amount: Array, covariance: Array) -> tuple[str, float, float]:
    """Return the unit, the amount and its standard deviation.

    Of a camera, which moves by a rotation vector and a displacement: those of the surer one.
    """
    if hypothesis.kind != "camera":
        return hypothesis.unit, float(amount[0]), float(np.sqrt(covariance[0, 0]))
    sizes = []
    for unit, part in (("rad", slice(0, 3)), ("m", slice(3, 6))):
        size = float(np.linalg.norm(amount[part]))
        along = amount[part] / max(size, 1e-300)
        sizes.append((unit, size, float(np.sqrt(along @ covariance[part, part] @ along))))
    return max(sizes, key=lambda one: one[1] / max(one[2], 1e-300))


@dataclass(frozen=True, eq=False)
class _Course:
    """The images of a session in blocks, in the order in which they were taken."""

    block: IntArray  # (n_rows,) block of each row; -1: not in any order
    first: tuple[str, ...]  # first image of each block
    last: tuple[str, ...]
    sequences: tuple[IntArray, ...]  # blocks in order
    rows_in_order: tuple[IntArray, ...]  # the same by rows
    size: IntArray  # (n_blocks,) images
    rows: Mapping[tuple[int, int], int]  # of views and poses of the fit
    row_of_pose: IntArray  # (n_poses,) first row of each pose of the fit
    before: IntArray  # (n_rows,) the row taken before each; -1: none

    @classmethod
    def of(
        cls, posterior: Posterior, measurements: Measurements, sequences: Sequence[IntArray]
    ) -> _Course:
        """Group the images of a session."""
        n, names = measurements.n_rows, row_names(measurements)
        per_block = -(-sum(map(len, sequences)) // MAX_BLOCKS)
        block, before = np.full(n, -1, dtype=np.intp), np.full(n, -1, dtype=np.intp)
        first, last = list[str](), list[str]()
        size, ordered = list[int](), list[IntArray]()
        for sequence in sequences:
            rows = sequence.tolist()
            before[rows[1:]] = rows[:-1]
            numbers = []
            for begin in range(0, len(rows), per_block):
                members = rows[begin : begin + per_block]
                block[members] = len(size)
                numbers.append(len(size))
                first.append(names[members[0]])
                last.append(names[members[-1]])
                size.append(len(members))
            ordered.append(np.array(numbers, dtype=np.intp))
        problem, views = posterior.problem, [view.name for view in measurements.views]
        row_of = {
            (views[v], name): row
            for row, (v, name) in enumerate(zip(measurements.view.tolist(), names, strict=True))
        }
        rows_of = {
            (v, pose): row_of[problem.outlines.views[v], name]
            for (v, pose), name in problem.images.items()
            if (problem.outlines.views[v], name) in row_of
        }
        row_of_pose = np.full(problem.n_elements, -1, dtype=np.intp)
        for (_, pose), row in sorted(rows_of.items(), reverse=True):
            row_of_pose[pose] = row
        return cls(
            block,
            tuple(first),
            tuple(last),
            tuple(ordered),
            tuple(sequences),
            np.array(size, dtype=np.intp),
            rows_of,
            row_of_pose,
            before,
        )

    @property
    def n_blocks(self) -> int:
        """Number of blocks."""
        return len(self.size)

    @property
    def always(self) -> list[tuple[BoolArray, None]]:
        """The blocks of something that holds in all images."""
        return [(np.ones(self.n_blocks, dtype=np.bool_), None)]

    def images(self, before: int, after: int) -> tuple[str, str]:
        """Return the last image of one block and the first one of another."""
        return self.last[before], self.first[after]

    def changes(self, among: BoolArray) -> Iterator[tuple[BoolArray, tuple[int, int]]]:
        """Yield the blocks after each possible change, among some blocks, and both beside it."""
        inside = [blocks[among[blocks]] for blocks in self.sequences]
        for i, blocks in enumerate(inside):
            others = [other for j, other in enumerate(inside) if j != i and len(other)]
            are_many = len(others) > _MAX_OTHER_VIEWS
            sides: list[tuple[bool, ...]] = [(False,) if are_many else (False, True)] * len(others)
            for cut in range(1, len(blocks)):
                n_before, n_after = (
                    int(self.size[part].sum()) for part in (blocks[:cut], blocks[cut:])
                )
                if min(n_before, n_after) < MIN_IMAGES:
                    continue
                for are_after in product(*sides):
                    holds = np.zeros(self.n_blocks, dtype=np.bool_)
                    holds[blocks[cut:]] = True
                    for other, is_after in zip(others, are_after, strict=True):
                        holds[other] = is_after
                    yield holds, (int(blocks[cut - 1]), int(blocks[cut]))

    def drift(self, row: IntArray) -> Array:
        """Return the time of rows from 0 to 1 over their sequence, and levels of other sequences.

        (n, d); nothing is known of the time between sequences.
        """
        columns = np.zeros((len(row), len(self.sequences)))
        for i, rows in enumerate(self.rows_in_order):
            position = np.full(len(self.block), -1.0)
            position[rows] = np.linspace(0.0, 1.0, len(rows))
            at = np.where(row >= 0, position[row], -1.0)
            columns[at >= 0.0, 0] = at[at >= 0.0]
            if i > 0:
                columns[at >= 0.0, i] = 1.0
        return columns

    def of_poses(self, pose: IntArray) -> IntArray:
        """Return the blocks of poses of the fit."""
        row = self.row_of_pose[pose]
        return np.where(row >= 0, self.block[row], -1)

    def of_images(self, view: IntArray, pose: IntArray) -> IntArray:
        """Return the blocks of images of the fit."""
        rows = [
            self.rows.get(image, -1) for image in zip(view.tolist(), pose.tolist(), strict=True)
        ]
        row = np.array(rows, dtype=np.intp)
        return np.where(row >= 0, self.block[row], -1)


def _blocks_of(hypothesis: _Hypothesis, n_blocks: int) -> BoolArray:
    """Return the blocks in which a hypothesis can be told from others, (n_blocks,)."""
    seen = np.zeros(n_blocks, dtype=np.bool_)
    for name, block in hypothesis.block.items():
        has_effect = np.any(hypothesis.columns[name] != 0.0, axis=(1, 2)) & (block >= 0)
        seen[block[has_effect]] = True
    return seen


class _Encoders(NamedTuple):
    """The readings of a factor of the fit."""

    factor: str
    leg: IntArray  # (n,) index of the leg
    reading: Array  # (n,) [m or rad]
    by_reading: Array  # (n,) derivative of the whitened residual
    block: IntArray  # (n,)
    row: IntArray  # (n,) first row of the pose, -1 without any


def _encoders(problem: FitProblem, course: _Course) -> list[_Encoders]:
    """Return the readings of rods that change their length, and of actuators."""
    rods, arms = problem.readings, problem.observed.actuator_readings
    both = (
        ("readings", rods, rods.sign * rods.length, -rods.sign),
        ("actuator_readings", arms, arms.reading, np.full(len(arms), -1.0)),
    )
    return [
        _Encoders(
            name,
            table.leg,
            reading,
            np.asarray(problem.factor(name).whitening)[:, 0, 0] * derivative,
            course.of_poses(table.pose),
            course.row_of_pose[table.pose],
        )
        for name, table, reading, derivative in both
        if len(table)
    ]


def _of_motors(problem: FitProblem, course: _Course) -> Iterator[_Hypothesis]:
    """Yield what may be wrong with the readings of motors."""
    encoders = _encoders(problem, course)
    moves = [_last_moves(e.reading, e.leg, e.row, course.before) for e in encoders]
    for e, last_move in zip(encoders, moves, strict=True):
        for j in np.unique(e.leg).tolist():
            leg = problem.legs.nominal[j]
            unit = "rad" if leg.reads_angle else "m"
            once = np.ones((len(e.leg), 1))
            numbers: list[tuple[Kind, str, Array]] = [
                ("encoder", unit, once),
                ("drift", unit, course.drift(e.row)),
                ("gain", "1", e.reading[:, None]),
                ("backlash", unit, 0.5 * np.sign(last_move)[:, None]),
            ]
            for kind, of_unit, by in numbers:
                wrong = (e.by_reading * (e.leg == j))[:, None, None] * by[:, None]
                of_factor, block = {e.factor: wrong}, {e.factor: e.block}
                label, changes = leg.motor_label, kind == "encoder"
                yield _Hypothesis(kind, label, of_unit, of_factor, block, changes)
    of_all: list[tuple[Kind, str, list[Array]]] = [
        ("lag", "", moves),
        ("gain", ALL_MOTORS, [e.reading for e in encoders]),
    ]
    for kind, label, numbers_of_all in of_all:
        columns = {
            e.factor: (e.by_reading * by)[:, None, None]
            for e, by in zip(encoders, numbers_of_all, strict=True)
        }
        yield _Hypothesis(kind, label, "1", columns, {e.factor: e.block for e in encoders}, False)


def _last_moves(q: Array, leg: IntArray, row: IntArray, before: IntArray) -> Array:
    """Return how far readings are from those of the image before, zero for first images."""
    keys = zip(leg.tolist(), row.tolist(), strict=True)
    reading = dict(zip(keys, q.tolist(), strict=True))
    previous = np.where(row >= 0, before[row], -1).tolist()
    return np.array(
        [
            x - reading.get((j, last), x)
            for x, j, last in zip(q.tolist(), leg.tolist(), previous, strict=True)
        ]
    )


def _of_views(
    problem: FitProblem, state: State, linear: Linearization, course: _Course
) -> Iterator[_Hypothesis]:
    """Yield what may have changed about the camera of each view; boards would say more."""
    if any(map(len, problem.boards)):
        return
    o = problem.outlines
    block = course.of_images(o.view, o.pose)
    by_focal = np.sum(
        o.by_intrinsics(("fx", "fy"), problem.keys, state)
        * np.array([[c.K[0, 0], c.K[1, 1]] for c in state.cameras])[o.view][:, None],
        axis=2,
    )
    by_focal = np.einsum("nij,nj->ni", np.asarray(problem.factor("outlines").whitening), by_focal)
    for v, name in enumerate(o.views):
        own = (o.view == v)[:, None]
        moved = []
        for turn, shift in zip(np.eye(6)[:, :3], np.eye(6)[:, 3:], strict=True):
            error = np.zeros((len(o.views), 6))
            error[v] = np.append(turn, np.cross(turn, state.camera_pose.t[v]) - shift)
            moved.append(residual_changes(problem, linear, "camera_pose", error)["outlines"])
        blocks = {"outlines": block}
        yield _Hypothesis("camera", name, "", {"outlines": np.stack(moved, axis=-1)}, blocks, True)
        focal = np.where(own, -by_focal, 0.0)[..., None]
        yield _Hypothesis("focal_length", name, "1", {"outlines": focal}, blocks, True)


@dataclass(frozen=True, eq=False)
class _Scores:
    """Rao's scores of all hypotheses in each block, and their information."""

    score: Array  # (c,)
    information: Array  # (c, c)
    size: Array  # (c,) squares of the columns before the fit absorbs its part
    column: Sequence[IntArray]  # (d, n_blocks) columns of each hypothesis, -1 without any

    @classmethod
    def of(
        cls,
        problem: FitProblem,
        linear: Linearization,
        normal: NormalEquations,
        hypotheses: Sequence[_Hypothesis],
        n_blocks: int,
    ) -> _Scores:
        """Compute the scores."""
        columns, c = list[IntArray](), 0
        for hypothesis in hypotheses:
            d = next(iter(hypothesis.columns.values())).shape[-1]
            seen = _blocks_of(hypothesis, n_blocks)
            column = np.full((d, n_blocks), -1, dtype=np.intp)
            column[:, seen] = c + np.arange(d * int(seen.sum())).reshape(d, -1)
            c += d * int(seen.sum())
            columns.append(column)
        stacked = dict[str, Array]()
        for hypothesis, column in zip(hypotheses, columns, strict=True):
            for name, values in hypothesis.columns.items():
                n, q, d = values.shape
                of_factor = stacked.setdefault(name, np.zeros((n, q, c)))
                block = hypothesis.block[name]
                for k in range(d):
                    rows = np.flatnonzero((block >= 0) & (column[k][block] >= 0))
                    of_factor[rows, :, column[k][block[rows]]] = values[rows, :, k]
        score, information = score_test(problem, linear, normal, stacked)
        size = sum(np.einsum("nqc,nqc->c", v, v) for v in stacked.values())
        return cls(score, information, np.asarray(size), columns)

    def value(self, test: _Test) -> tuple[float, float]:
        """Return the probability of a score by chance, and its square in units of its scatter."""
        solved = self._solved(test)
        if not solved.rank:
            return 1.0, 0.0
        square = solved.square / solved.scatter
        return float(chdtrc(float(solved.rank), square)), square

    def estimate(self, test: _Test) -> tuple[Array, Array]:
        """Return the number and its covariance."""
        solved = self._solved(test)
        return solved.amount, solved.inverse * solved.scatter

    def given(self, test: _Test) -> _Scores:
        """Return the scores given that a test is true."""
        solved = self._solved(test)
        toward = self.information[:, solved.columns] @ solved.chosen
        return replace(
            self,
            score=self.score - toward @ solved.amount,
            information=self.information - toward @ solved.inverse @ toward.T,
        )

    def _solved(self, test: _Test) -> _Solved:
        """Estimate the number of a test."""
        column = self.column[test.hypothesis]
        used = column >= 0
        columns = column[used]
        number, block = np.nonzero(used)
        chosen = (number[:, None] == np.arange(len(column))) & test.holds[block][:, None]
        chosen = chosen.astype(np.float64)
        of_blocks = self.information[np.ix_(columns, columns)]
        toward = of_blocks @ chosen
        score, information = chosen.T @ self.score[columns], chosen.T @ toward
        scale = np.sqrt(np.maximum(chosen.T @ self.size[columns], np.finfo(np.float64).tiny))
        value, vector = np.linalg.eigh(information / scale / scale[:, None])
        seen = value > _UNSEEN
        root = vector[:, seen] / np.sqrt(value[seen]) / scale[:, None]
        inverse = root @ root.T
        amount = inverse @ score
        left = self.score[columns] - toward @ amount
        variance = np.diagonal(of_blocks) - np.sum((toward @ inverse) * toward, axis=1)
        tested = variance > _UNSEEN * self.size[columns]
        ratio = left[tested] ** 2 / variance[tested]
        scatter = max(float(ratio.mean()), 1.0) if len(ratio) else 1.0
        rank, square = int(seen.sum()), float(score @ amount)
        return _Solved(columns, chosen, amount, inverse, rank, square, scatter)


class _Solved(NamedTuple):
    """The number of a test by its score."""

    columns: IntArray  # (c,) of the hypothesis
    chosen: Array  # (c, d) those of the blocks in which it holds, zeros and ones
    amount: Array  # (d,)
    inverse: Array  # (d, d) covariance of the number, by the covariances of outlines
    rank: int  # directions of the number that the fit does not absorb
    square: float  # of the score, in standard deviations
    scatter: float  # mean square of the scores of single blocks over their variance, at least 1


def _effect(
    problem: FitProblem,
    linear: Linearization,
    normal: NormalEquations,
    hypothesis: _Hypothesis,
    holds: BoolArray,
    amount: Array,
) -> Array:
    """Return the error of the kinematic parameters (p,) by a number that the fit lacks."""
    changes = {}
    for name, values in hypothesis.columns.items():
        block = hypothesis.block[name]
        in_blocks = (block >= 0) & holds[block]
        changes[name] = np.where(in_blocks[:, None, None], values @ amount[:, None], 0.0)
    return kinematic_steps(problem, response(problem, linear, normal, changes))[:, 0]
