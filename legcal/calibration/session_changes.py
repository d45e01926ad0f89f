"""Tests of a fit for what changed in the course of a session, and for how readings follow motors.

An encoder that slips, a camera that was bumped or refocused, photographs of a platform that still
moves: each is a number that the fit lacks, from some image on or in all images. Rao's score tests
ask the derivatives of the fit whether that number is zero, without another fit. Moments of changes
are scanned over the images in the order in which they were taken; where only the images of each
view have an order, over both sides for each other view. The most certain finding comes first, and
others are tested given those before, so that one cause is named once.

Errors that images share make scores scatter more than the covariances of outlines say; a score
counts in units of its scatter from image to image. The squares of the scores of single images say
how much readings scatter, the focal length and the direction of a camera: variance components,
tested after all other numbers. Where something was found, joints that moved and errors once a turn
of a screw are tried as better explanations.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from itertools import chain, combinations, count, groupby, pairwise
from typing import Any, Literal, NamedTuple, cast

import numpy as np
from scipy.sparse import csc_array
from scipy.special import chdtrc, chdtri

from legcal.calibration.joint_fit.factors import ObservedOutlines
from legcal.calibration.joint_fit.held_out import Posterior
from legcal.calibration.joint_fit.problem import FitNormal, FitProblem
from legcal.calibration.joint_fit.sensitivity import CameraResiduals, kinematic_steps
from legcal.calibration.joint_fit.variables import LegConstraints
from legcal.calibration.tuning import DOUBT_BY_CHANCE
from legcal.data.image_choice import images_to_name
from legcal.data.measurements import Measurements, few_views, row_names
from legcal.estimation.problem import linearize
from legcal.estimation.solver import normal_equations
from legcal.estimation.uncertainty import (
    LEAST_SEEN,
    Estimated,
    Projected,
    Scores,
    residual_changes,
    response,
)
from legcal.files.quantity import SHOWN_IN
from legcal.geometry.types import Array, BoolArray, IntArray
from legcal.machine.leg import LegColumns
from legcal.vision.camera import shared_cameras

MAX_FINDINGS = 3
MAX_BLOCKS = 60  # groups of consecutive images between which changes are looked for
MIN_IMAGES = 3  # on each side of a change
_MAX_OTHER_VIEWS = 5  # views whose side of a change is tried
_BY_OTHERS = 0.0027  # probability by chance of a number that one image may not be the reason of
_HUBER = 3.0  # standard deviations from which on outlines count less
ALL_MOTORS = "all motors"

_GOOD_PART = 0.2  # of a turn, beyond which errors once a turn are looked for
_LEADS = (1, 1.25, 1.5, 2, 2.5, 3, 4, 5, 6, 8, 10, 12, 16, 20, 25, 32, 40)  # of screws, belts [mm]
_COARSE = 15  # groups of images whose scores say how much those of errors once a turn scatter
_BETTER = 10.0  # squared sigmas a number, by which further explanations must be better
_CHANGED = 3.0  # standard deviations from which on the zero of one of all motors changed
_STEADY = {"focal_length": 1e-6, "camera": 1e-7}  # relative, [rad]: scatter from image to image
_LESS = np.geomspace(1e-3, 0.2, 24)  # of the stated standard deviation of readings
_SURELY_LESS = 10.0  # of the logarithm of the likelihood
_FURTHER = (-5.0, 30.0)  # logarithms of variances of readings over the stated one
MOST_REJECTED, FEW = 0.5, 0.1  # outlines of an image that is not left out; of images that are
_SAME_SCATTER = 0.3  # of that of all images, by those in the fit: of less a few make the most
MOST_SCATTER = 2.0  # times the stated standard deviation of readings

Kind = Literal[
    "encoder",
    "drift",
    "camera",
    "focal_length",
    "lag",
    "backlash",
    "gain",
    "pitch",
    "eccentricity",
    "joint",
    "reading_noise",
    "autofocus",
    "vibration",
]
OF_MOTORS: frozenset[Kind] = frozenset(
    ("encoder", "drift", "lag", "backlash", "gain", "pitch", "eccentricity", "reading_noise")
)
OF_SCATTER: frozenset[Kind] = frozenset(("reading_noise", "autofocus", "vibration"))


@dataclass(frozen=True, eq=False)
class UnmodelledEffect:
    """An effect that a fit does not model, with the number that it lacks for that."""

    kind: Kind  # what changed, or how readings follow motors
    # the motor, the view or the joint; "" where it is all motors. Several motors have commas
    subject: str
    unit: str  # ``m``, ``rad`` or ``1``
    # amount, sigma: the number; of a camera the angle or the distance, whichever is surer, of noise
    # the standard deviation of readings
    amount: float
    sigma: float
    # the images, or views, before and after a change; None where it is of all images
    between: tuple[str, str] | None
    # (p, c): the error of the kinematic parameters of the fit without the number, as in the
    # parametrization of its problem; of noise, c independent errors
    steps: Array
    # the images on one side of a change, as options name them: before that of an encoder, the fewer
    # ones beside that of a camera
    images: str = ""
    stated: float = 0.0  # the standard deviation of readings that is stated, of noise alone

    @property
    def size(self) -> str:
        """The amount with its standard deviation, without a sign where words tell it."""
        scale, unit = (100.0, "%") if self.unit == "1" else SHOWN_IN[self.unit]
        sigma = scale * self.sigma
        digits = max(1 - math.floor(math.log10(sigma)), 0) if sigma > 0.0 else 3
        if self.kind == "reading_noise":
            stated = f"{scale * self.stated:.2g} {unit}"
            return f"{scale * self.amount:.{digits}f} {unit} where {stated} are stated"
        sign = "" if self.kind in _WITHOUT_SIGN else "+"
        amount = abs(self.amount) if self.kind in _BY_SIGN else self.amount
        return f"{scale * amount:{sign}.{digits}f} ± {sigma:.{digits}f} {unit}"

    @property
    def what(self) -> str:
        """What was found, as a clause."""
        between = "" if self.between is None else f" between {' and '.join(self.between)}"
        sense = _BY_SIGN.get(self.kind, ("", ""))[int(self.amount < 0.0)]
        what = self._words[0].format(subject=self.subject, size=self.size, sense=sense)
        return f"{what}{between}"

    @property
    def remedy(self) -> str:
        """What to do, as a clause."""
        splits = " ".join(f"--split {motor}@{self.images}" for motor in self.subject.split(", "))
        return self._words[1].format(subject=self.subject, images=self.images, splits=splits)

    @property
    def _words(self) -> tuple[str, str]:
        if self.kind == "encoder" and self.subject == ALL_MOTORS:
            return _HOMED
        return _SEVERAL if self.kind == "encoder" and ", " in self.subject else _WORDS[self.kind]


_WITHOUT_ORDER: tuple[str, ...] = ("gain", "pitch", "eccentricity", "camera_file")
_BY_SIGN: Mapping[Kind, tuple[str, str]] = {  # words for positive and negative amounts
    "lag": ("ahead of", "behind"),
    "gain": ("too large", "too small"),
    "pitch": ("larger", "smaller"),
}
_WITHOUT_SIGN: tuple[Kind, ...] = (
    "camera", "backlash", "eccentricity", "joint", "autofocus", "vibration", *_BY_SIGN
)  # fmt: skip
_HOMED = (  # in place of the words for one encoder
    "{subject} were homed anew: the zeros of their encoders changed, one by {size}",
    "home the machine once before all photographs, and calibrate with zeros of their own before "
    "that (--split all@{images}), or without the images on one side of it (--leave-out)",
)
_SEVERAL = (
    "the zeros of the encoders of {subject} changed, one by {size}",
    "look for slipped couplings or lost homes there, and calibrate with zeros of their own before "
    "that ({splits})",
)
_WORDS: Mapping[Kind, tuple[str, str]] = {
    "encoder": (
        "the zero of the encoder of {subject} changed by {size}",
        "look for a slipped coupling or a lost home there, and calibrate with a zero of its own "
        "before that (--split {subject}@{images})",
    ),
    "drift": (
        "the zero of the encoder of {subject} drifts by {size}",
        "look for a loose coupling or warming up there, and take the images again",
    ),
    "camera": (
        "the camera of {subject} moved by {size}",
        "look for a bumped tripod, or light that came from another side; make the images after it "
        "a view of their own in dataset.yaml and measurements.csv, or calibrate without those on "
        "one side of it (--leave-out {images})",
    ),
    "focal_length": (
        "the focal length of {subject} changed by {size}",
        "switch off autofocus and zoom; make the images after it a view of their own, with a "
        "camera file of their own, or calibrate without those on one side of it "
        "(--leave-out {images})",
    ),
    "lag": (
        "readings are {sense} the platform by {size} of the last move",
        "wait until the platform stands still before each photograph, and read the encoders then",
    ),
    "backlash": (
        "readings of {subject} differ by {size} with the direction of approach",
        "approach all poses from one side, and look for backlash there",
    ),
    "gain": (
        "readings of {subject} are {size} {sense}",
        "check the pitch or gear ratio of that motor, and its counts per turn",
    ),
    "pitch": (
        "readings of {subject} are {size} {sense} than all other measurements say together",
        "measure stated lengths and boards again, and check pitch or gear ratio and counts per "
        "turn",
    ),
    "eccentricity": (
        "readings of {subject} are wrong by up to {size} once a turn",
        "look for an eccentric or tilted disc of that encoder, and for a bent screw",
    ),
    "joint": (
        "the joint {subject} moved by {size}",
        "look for a loose joint or bracket there and take the images again, or calibrate without "
        "those on one side of it (--leave-out {images})",
    ),
    "autofocus": (
        "the focal length of {subject} differs from image to image by {size}",
        "switch off autofocus and stabilisation, and take the images of that view again",
    ),
    "vibration": (
        "the camera of {subject} turns from image to image by {size}",
        "look for a tripod that shakes, rolling shutter and stabilisation, and take the images of "
        "that view again",
    ),
    "reading_noise": (
        "readings of {subject} scatter by {size}, as commands in place of readings would",
        "write down what encoders read when the platform stands still; if that was done, look for "
        "play and for a camera that vibrates, or state their scatter as encoder_sigma",
    ),
}


@dataclass(frozen=True, eq=False)
class _Hypothesis:
    """A number that a fit lacks, by what a unit of it does to whitened residuals in each image."""

    # The fit itself names camera files that are wrong: here they explain what others would
    kind: Kind | Literal["camera_file"]
    subject: str
    unit: str
    columns: Mapping[str, Array]  # (n, q, d) of factors by name
    share: Mapping[str, Array]  # (n, n_blocks) of blocks of images in each residual
    size: IntArray  # (n_blocks,) images in each block
    changes: bool  # from some image on; else in all images


class _Test(NamedTuple):
    """A hypothesis, by its place among all, with the blocks of images in which it holds."""

    place: int
    of: _Hypothesis
    holds: BoolArray  # (n_blocks,)
    between: tuple[str, str] | None  # the images, or views, before and after a change


@dataclass(frozen=True)
class SessionTests:
    """Tests of a session."""

    # the numbers that the fit lacks, the most certain first
    findings: tuple[UnmodelledEffect, ...] = ()
    # the least changes of encoders that would show half of the time, by motor [m or rad]; motors of
    # which no change can be seen are not in it
    least_slips: Mapping[str, float] = field(default_factory=dict)
    # by unit how much readings scatter and what is stated, where that is five times as much
    overstated: Mapping[str, tuple[float, ...]] = field(default_factory=dict)
    # the outlines of the fit (n,) in each quarter of the images in order, by its images
    periods: Mapping[str, BoolArray] = field(default_factory=dict)


def session_tests(
    posterior: Posterior,
    measurements: Measurements,  # the rows that were fitted
    sequences: Sequence[IntArray],  # rows in the order of their images (image_sequences)
) -> SessionTests:
    """Test a fit for numbers that it lacks."""
    if not len(posterior.problem.outlines):
        return SessionTests()
    left_out = _left_out(posterior.problem)
    tests = _tests(_with_rejected(posterior), measurements, sequences)
    changes = any(finding.kind not in OF_SCATTER for finding in tests.findings)
    if changes or not 0.0 < left_out.mean() <= FEW:
        return tests
    # A few wrong rows, or photographs of others, are no scatter if there is far less without them
    others = _tests(_with_rejected(posterior, ~left_out), measurements, sequences)
    of_all, of_others = (
        {
            (one.kind, one.subject): one.amount / one.stated
            for one in found.findings
            if one.kind in OF_SCATTER
        }
        for found in (tests, others)
    )
    same = (of_others[one] > _SAME_SCATTER * of_all[one] for one in of_all.keys() & of_others)
    return tests if any(same) else others


def _tests(
    posterior: Posterior, measurements: Measurements, sequences: Sequence[IntArray]
) -> SessionTests:
    """Test a fit with some outlines for numbers that it lacks."""
    has_order = len(sequences) > 0
    fit = _Fit.of(
        posterior, measurements, sequences if has_order else [np.arange(measurements.n_rows)]
    )
    hypotheses = [*fit.of_motors(), *fit.of_views()]
    hypotheses = [h for h in hypotheses if any(c.any() for c in h.columns.values())]
    if not hypotheses:
        return SessionTests()
    tests = [
        test
        for place, hypothesis in enumerate(hypotheses)
        if has_order or hypothesis.kind in _WITHOUT_ORDER
        for test in fit.course.tests(place, hypothesis)
    ]
    scores = fit.scores(hypotheses)
    least = math.sqrt(chdtri(1.0, DOUBT_BY_CHANCE / max(len(tests), 1)))
    slips, solved = dict[str, list[float]](), scores.solved(tests)
    for number in solved:
        if number.test.of.kind == "encoder" and number.rank and len(number.amount) == 1:
            sigma = math.sqrt(number.covariance[0, 0])
            slips.setdefault(number.test.of.subject, []).append(least * sigma)
    lacking, left = _forward_selection(scores, solved, len(tests))
    noise, overstated = _excess_variance(hypotheses, left), _overstated(hypotheses, left)
    if lacking or noise:
        least = max((number.explains for number in lacking), default=0.0)
        of_scatter = 2.0 * noise.gain if noise is not None and not lacking else 0.0
        in_all = max((number.explains * number.scatter for number in lacking), default=of_scatter)
        better = fit.better(least, in_all)
        if better is not None:
            noise, lacking = None, [better]
    if noise is not None:
        scores = scores.with_noise(noise)
        solved = scores.solved([number.test for number in lacking])
        lacking, _ = _forward_selection(scores, solved, len(tests))
    named = [number for number in lacking if number.test.of.kind != "camera_file"]
    findings = [fit.finding(number, measurements) for number in named]
    if noise is not None:
        findings.append(fit.scattering(noise, hypotheses))
    least_slips = {motor: float(np.median(sizes)) for motor, sizes in slips.items()}
    periods = fit.course.periods(fit.problem.outlines) if has_order else {}
    return SessionTests(tuple(findings), least_slips, overstated, periods)


def _forward_selection(
    scores: _Scores, solved: Sequence[_Solved], n_tests: int
) -> tuple[list[_Solved], _Scores]:
    """Return the numbers that the fit lacks, the most certain first, and the scores given them."""
    lacking = list[_Solved]()
    while sum(one.test.of.kind != "camera_file" for one in lacking) < MAX_FINDINGS:
        best = scores.most_certain(solved, n_tests)
        if best is None:
            break
        lacking.append(best)
        scores = _Scores(scores.scores.given(best.estimated), scores.column)
        left = [number.test for number in solved if number.test.place != best.test.place]
        solved = scores.solved(left)
    return lacking, scores


def _side(measurements: Measurements, course: _Course, test: _Test) -> str:
    """Return the images before a change of an encoder; beside that of a camera, the fewer ones.

    Images of a pose share its readings, and so the side of an encoder. Those in which nothing can
    be seen of a change are on the side of the ones before them.
    """
    hypothesis = test.of
    if not hypothesis.changes:
        return ""
    if hypothesis.kind == "encoder":
        images, by = list(course.rows_in_order), course.reading_row
    elif hypothesis.kind == "joint":
        images, by = list(course.rows_in_order), np.arange(measurements.n_rows)
    else:
        of_view = measurements.view == measurements.view_names.index(hypothesis.subject)
        images = [rows[of_view[rows]] for rows in course.rows_in_order]
        by = np.arange(measurements.n_rows)
    seen = np.append(_blocks_of(hypothesis).any(axis=0), False)
    block = np.where(by >= 0, course.block[by], -1)  # -1 is the last of those seen
    after = np.append(test.holds, False)[block]
    is_known, sides = seen[block], (list[IntArray](), list[IntArray]())
    for rows in images:
        known = np.flatnonzero(is_known[rows])
        if len(known):
            last = np.searchsorted(known, np.arange(len(rows)), side="right") - 1
            is_after = after[rows[known[np.maximum(last, 0)]]]
            for side, on_side in zip(sides, (~is_after, is_after), strict=True):
                side.extend(_runs(measurements.view, rows, on_side))
    if hypothesis.kind == "encoder":
        for row in np.flatnonzero(is_known & (course.block < 0)).tolist():
            sides[int(after[row])].append(np.array([row], dtype=np.intp))
        return images_to_name(measurements, sides[0])
    return images_to_name(measurements, min(sides, key=lambda side: sum(map(len, side))))


def _runs(view: IntArray, rows: IntArray, chosen: BoolArray) -> Iterator[IntArray]:
    """Yield chosen rows as ranges of a sequence: one of all views, or those of each view."""
    of_each = [view[rows] == v for v in dict.fromkeys(view[rows].tolist())]
    at = np.flatnonzero(chosen)
    is_one = len(at) > 0 and len(at) == at[-1] - at[0] + 1
    for among in [np.ones(len(rows), dtype=np.bool_)] if is_one else of_each:
        places = np.flatnonzero(chosen[among])
        breaks = np.flatnonzero(np.diff(places) > 1) + 1
        for run in np.split(rows[among][places], breaks):
            if len(run):
                yield run


def _with_rejected(posterior: Posterior, among: BoolArray | float = 1.0) -> Posterior:
    """Return the fit with what it rejected, what is far off with the weights of Huber's loss.

    A fit rejects outlines, and readings of redundant motors, on one side of a change where the
    other side has more. *Among* some outlines.
    """
    problem, noise, state = posterior.problem, posterior.noise, posterior.state
    offsets, claimed = problem.offsets(state), problem.outlines.covariance
    distance = np.sqrt(noise.squared_norms(offsets, claimed))
    problem = problem.weighted(noise, among * _HUBER / np.maximum(distance, _HUBER))
    if problem.legs.is_redundant:
        factor, sigma = problem.factor("readings"), problem.readings.sigma
        distance = np.abs(factor.rows(state).r[:, 0]) / sigma
        root = np.sqrt(_HUBER / np.maximum(distance, _HUBER)) / sigma
        problem = problem.with_factors(replace(factor, whitening=root[:, None, None]))
    return replace(posterior, problem=problem)


def _left_out(problem: FitProblem) -> BoolArray:
    """Return the outlines (n,) of images most of whose outlines a fit rejects."""
    o = problem.outlines
    rejected = ~np.asarray(problem.factor("outlines").whitening).any(axis=(1, 2))
    image = o.view * problem.n_elements + o.pose
    most = MOST_REJECTED * np.bincount(image)
    return np.asarray((np.bincount(image, rejected) > most)[image], dtype=np.bool_)


def _size(number: _Solved) -> tuple[str, float, float]:
    """Return the unit, the amount and its standard deviation.

    Of a camera, which moves by a rotation vector and a displacement: those of the surer one. Of
    all encoders those of the surest one.
    """
    hypothesis, amount, covariance = number.test.of, number.amount, number.covariance
    parts = {"rad": slice(0, 3), "m": slice(3, 6)}
    if hypothesis.kind == "encoder":
        sigma = np.sqrt(np.diagonal(covariance))
        surest = int(np.argmax(np.abs(amount) / np.maximum(sigma, 1e-300)))
        return hypothesis.unit, float(amount[surest]), float(sigma[surest])
    if hypothesis.kind != "camera":
        if len(amount) == 1 or hypothesis.kind == "drift":
            return hypothesis.unit, float(amount[0]), float(np.sqrt(covariance[0, 0]))
        parts = {hypothesis.unit: slice(None)}
    sizes = []
    for unit, part in parts.items():
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
    names: tuple[str, ...]  # the view of each sequence, where it is of one
    sequences: tuple[IntArray, ...]  # blocks in order
    rows_in_order: tuple[IntArray, ...]  # the same by rows
    size: IntArray  # (n_blocks,) images
    rows: Mapping[tuple[int, int], int]  # of views and poses of the fit
    row_of_pose: IntArray  # (n_poses,) first row of each pose of the fit
    reading_row: IntArray  # (n_rows,) the same of the pose of each row; -1: not in the fit
    before: IntArray  # (n_rows,) the reading row of the pose taken before that of each; -1: none

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
            for previous, row in pairwise(rows):
                moved = measurements.pose[row] != measurements.pose[previous]
                before[row] = previous if moved else before[previous]
            numbers = []
            for begin in range(0, len(rows), per_block):
                members = rows[begin : begin + per_block]
                block[members] = len(size)
                numbers.append(len(size))
                first.append(names[members[0]])
                last.append(names[members[-1]])
                size.append(len(members))
            ordered.append(np.array(numbers, dtype=np.intp))
        problem, views = posterior.problem, measurements.view_names
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
        row_of_measured = np.full(measurements.n_poses, -1, dtype=np.intp)
        in_fit = row_of_pose[row_of_pose >= 0]
        row_of_measured[measurements.pose[in_fit]] = in_fit
        reading_row = row_of_measured[measurements.pose]
        return cls(
            block,
            tuple(first),
            tuple(last),
            tuple(views[measurements.view[rows[0]]] for rows in sequences),
            tuple(ordered),
            tuple(sequences),
            np.array(size, dtype=np.intp),
            rows_of,
            row_of_pose,
            reading_row,
            np.where(before >= 0, reading_row[before], -1),
        )

    @property
    def n_blocks(self) -> int:
        """Number of blocks."""
        return len(self.size)

    def tests(self, number: int, hypothesis: _Hypothesis) -> Iterator[_Test]:
        """Yield the tests of a hypothesis, by its number."""
        if hypothesis.changes:
            for holds, between in self.changes(np.asarray(_blocks_of(hypothesis).any(axis=0))):
                yield _Test(number, hypothesis, holds, between)
            return
        drifts, whole = hypothesis.kind == "drift", len(self.sequences) == 1
        span = (
            ("the first image", "the last") if whole else ("the first image of a view", "its last")
        )
        n_blocks = next(iter(hypothesis.share.values())).shape[1]
        yield _Test(number, hypothesis, np.ones(n_blocks, dtype=np.bool_), span if drifts else None)

    def changes(self, among: BoolArray) -> Iterator[tuple[BoolArray, tuple[str, str]]]:
        """Yield the blocks after each possible change, among some blocks, and what is beside it.

        Where only the images of each view have an order, it may be between views.
        """
        inside = [blocks[among[blocks]] for blocks in self.sequences]
        whole = [i for i, blocks in enumerate(inside) if len(blocks)]
        for i in whole:
            blocks, others = inside[i], [j for j in whole if j != i]
            for cut in range(1, len(blocks)):
                sides = blocks[:cut], blocks[cut:]
                if min(int(self.size[side].sum()) for side in sides) < MIN_IMAGES:
                    continue
                for after in _subsets(others, [()]):
                    holds = self._blocks([sides[1], *(inside[j] for j in after)])
                    yield holds, (self.last[blocks[cut - 1]], self.first[blocks[cut]])
        for after in _subsets(whole[1:], [(j,) for j in whole[1:]]):
            if after:
                views = [[self.names[j] for j in whole if j not in after]]
                views.append([self.names[j] for j in after])
                names = [few_views(part) for part in views]
                yield self._blocks([inside[j] for j in after]), (names[0], names[1])

    def _blocks(self, parts: Sequence[IntArray]) -> BoolArray:
        holds = np.zeros(self.n_blocks, dtype=np.bool_)
        holds[np.concatenate(parts)] = True
        return holds

    def periods(self, outlines: ObservedOutlines) -> dict[str, BoolArray]:
        """Return masks of the outlines in the quarters of each sequence, by their images."""
        share, quarters = self.of_images(outlines.view, outlines.pose), dict[str, BoolArray]()
        for sequence in self.sequences:
            for blocks in np.array_split(sequence, 4):
                if len(blocks):
                    name = f"images {self.first[blocks[0]]} to {self.last[blocks[-1]]}"
                    quarters[name] = np.asarray(share[:, blocks].any(axis=1))
        return quarters

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

    def of_poses(self, pose: IntArray) -> Array:
        """Return the share of each block in poses of the fit, (n, n_blocks): one or none."""
        return self._of_rows(self.row_of_pose[pose])

    def of_images(self, view: IntArray, pose: IntArray) -> Array:
        """Return the share of each block in images of the fit, (n, n_blocks).

        Pose -1 stands for all images of the view, in equal parts.
        """
        images = zip(view.tolist(), pose.tolist(), strict=True)
        share = self._of_rows(np.array([self.rows.get(i, -1) for i in images], dtype=np.intp))
        for v in np.unique(view[pose < 0]).tolist():
            rows = np.array([row for (of, _), row in self.rows.items() if of == v], dtype=np.intp)
            share[(view == v) & (pose < 0)] = self._of_rows(rows).mean(axis=0)
        return share

    def _of_rows(self, row: IntArray) -> Array:
        block = np.where(row >= 0, self.block[row], -1)
        return np.equal(block[:, None], np.arange(self.n_blocks)).astype(np.float64)


def _blocks_of(hypothesis: _Hypothesis) -> BoolArray:
    """Return the blocks in which each number of a hypothesis has an effect, (d, n_blocks)."""
    seen = [
        np.any(hypothesis.columns[name] != 0.0, axis=1).T @ (share > 0.0)
        for name, share in hypothesis.share.items()
    ]
    return np.asarray(np.any(seen, axis=0))


def _subsets(sequences: Sequence[int], few: Sequence[tuple[int, ...]]) -> Sequence[tuple[int, ...]]:
    """Return all subsets of other sequences, or *few* where there are many sequences."""
    if len(sequences) > _MAX_OTHER_VIEWS:
        return few
    sizes = range(len(sequences) + 1)
    return list(chain.from_iterable(combinations(sequences, n) for n in sizes))


@dataclass(frozen=True, eq=False)
class _Fit:
    """A fit at its minimum, and the course of its images: what it may lack, with the scores."""

    normal: FitNormal
    course: _Course

    @classmethod
    def of(
        cls, posterior: Posterior, measurements: Measurements, sequences: Sequence[IntArray]
    ) -> _Fit:
        """Linearise a fit."""
        normal = normal_equations(linearize(posterior.problem, posterior.state))
        return cls(normal, _Course.of(posterior, measurements, sequences))

    @property
    def problem(self) -> FitProblem:
        """The joint fit."""
        return self.normal.problem

    def _wrong_readings(
        self, kind: Kind, subject: str, unit: str, by: Array, groups: Array | None = None
    ) -> _Hypothesis:
        """Return the hypothesis that readings are wrong by multiples of *by* (n, d).

        In blocks of images, or in *groups* of these (n_blocks, n_groups).
        """
        problem, readings = self.problem, self.problem.readings
        whitening = np.asarray(problem.factor("readings").whitening)[:, 0, 0]
        columns = {"readings": (-readings.sign * whitening)[:, None, None] * by[:, None]}
        share = self.course.of_poses(readings.pose)
        size = self.course.size
        if groups is not None:
            share, size = share @ groups, np.asarray(size @ groups, dtype=np.intp)
        changes = kind == "encoder"
        return _Hypothesis(kind, subject, unit, columns, {"readings": share}, size, changes)

    def of_motors(self) -> Iterator[_Hypothesis]:
        """Yield what may be wrong with the readings of motors."""
        course, legs, wrong_by = self.course, self.problem.legs.nominal, self._wrong_readings
        readings, reading = self.problem.readings, self.problem.readings.reading
        row = course.row_of_pose[readings.pose]
        last_move = _last_moves(reading, readings.leg, row, course.before)
        motors = np.unique(readings.leg)
        if len(motors) > 1 and len(units := {legs[j].reading_unit for j in motors.tolist()}) == 1:
            of_each = np.equal(readings.leg[:, None], motors)
            yield wrong_by("encoder", ALL_MOTORS, units.pop(), 1.0 * of_each)
        for j in motors.tolist():
            leg, of_motor = legs[j], (readings.leg == j)[:, None]
            unit, subject = leg.reading_unit, leg.motor_label
            yield wrong_by("encoder", subject, unit, 1.0 * of_motor)
            yield wrong_by("drift", subject, unit, of_motor * course.drift(row))
            yield wrong_by("gain", subject, "1", of_motor * reading[:, None])
            yield wrong_by("backlash", subject, unit, of_motor * 0.5 * np.sign(last_move)[:, None])
            turned = math.tau if leg.reads_angle else math.inf
            if np.ptp(reading[of_motor[:, 0]]) > _GOOD_PART * turned:
                yield wrong_by("eccentricity", subject, unit, of_motor * _once_a_turn(reading))
        yield wrong_by("lag", "", "1", last_move[:, None])
        yield wrong_by("pitch", ALL_MOTORS, "1", reading[:, None])

    def of_views(self) -> Iterator[_Hypothesis]:
        """Yield what may have changed about the camera of each view, and wrong camera files.

        A file may be wrong in all views that have it, or in one. Corners of a board on the base are
        means over the images of a view, changed by the share of those after a change.
        """
        problem, linear, course = self.problem, self.normal.linear, self.course
        owners = np.array(shared_cameras(problem.outlines.views, problem.first_cameras))
        of_files = [owners == owner for owner in owners]
        boards = {corners.name: corners for corners in problem.boards if len(corners)}
        shares = {
            name: course.of_images(table.view, table.pose)
            for name, table in ({"outlines": problem.outlines} | boards).items()
        }
        residuals = CameraResiduals(linear)
        for v, view in enumerate(problem.outlines.views):
            if sum(of == v for of, _ in course.rows) < 2 * MIN_IMAGES:
                continue
            of_files.append(np.arange(len(owners)) == v)
            moved = []
            for turn, shift in zip(np.eye(6)[:, :3], np.eye(6)[:, 3:], strict=True):
                error = np.zeros((len(problem.outlines.views), 6))
                error[v] = np.append(turn, np.cross(turn, linear.state.camera_pose.t[v]) - shift)
                moved.append(residual_changes(linear, "camera_pose", error))
            camera = {
                name: np.stack([change[name] for change in moved], axis=-1) for name in shares
            }
            yield _Hypothesis("camera", view, "", camera, shares, course.size, True)
            zoom = residuals.zoomed(v)
            focal = {name: -zoom[name][..., None] for name in shares}
            yield _Hypothesis("focal_length", view, "1", focal, shares, course.size, True)
        for views in np.unique(of_files, axis=0):
            errors = chain.from_iterable(residuals.errors_of_files(views).values())
            if changes := [residuals.changes(error) for error in errors]:
                columns = {of: np.stack([one[of] for one in changes], axis=-1) for of in shares}
                yield _Hypothesis("camera_file", "", "", columns, shares, course.size, False)

    def of_joints(self) -> Iterator[list[_Hypothesis]]:
        """Yield joints that may have moved, by leg."""
        problem, linear, course = self.problem, self.normal.linear, self.course
        constraints, legs = LegConstraints(problem.parameters), problem.legs
        readings, outlines = problem.readings, problem.outlines
        share = {
            "readings": course.of_poses(readings.pose),
            "outlines": course.of_images(outlines.view, outlines.pose),
        }
        for j, name in enumerate(legs.names):
            joints = []
            for side, columns in (("base", LegColumns.A), ("platform", LegColumns.B)):
                moved = []
                for column in range(columns.start, columns.stop):
                    error = np.zeros((len(legs.names), LegColumns.COUNT))
                    error[j, column] = 1.0
                    change = residual_changes(linear, "legs", error)
                    motion = constraints.following(linear.state, j, column)
                    moved.append(
                        {
                            of: change[of]
                            + np.einsum(
                                "nqk,nk->nq",
                                linear[of].J_element,
                                motion[problem.factor(of).element],
                            )
                            for of in share
                        }
                    )
                by = {of: np.stack([one[of] for one in moved], axis=-1) for of in share}
                joints.append(
                    _Hypothesis("joint", f"{name}.{side}", "m", by, share, course.size, True)
                )
            yield joints

    def of_screws(self) -> Iterator[list[_Hypothesis]]:
        """Yield errors once a turn of the screws of each motor that slides, of usual leads."""
        readings, n = self.problem.readings, self.course.n_blocks
        group = np.arange(n) * min(_COARSE, n) // max(n, 1)
        groups = np.equal(group[:, None], np.unique(group)).astype(np.float64)
        for j in np.unique(readings.leg).tolist():
            leg, of_motor = self.problem.legs.nominal[j], (readings.leg == j)[:, None]
            if not leg.reads_angle:
                turns = (math.tau * readings.reading / (1e-3 * lead) for lead in _LEADS)
                yield [
                    self._wrong_readings(
                        "eccentricity", leg.motor_label, "m", of_motor * _once_a_turn(turn), groups
                    )
                    for turn in turns
                ]

    def scores(self, hypotheses: Sequence[_Hypothesis]) -> _Scores:
        """Compute the scores of hypotheses."""
        columns, c = list[IntArray](), 0
        for hypothesis in hypotheses:
            seen = _blocks_of(hypothesis)
            column = np.where(seen, c + np.cumsum(seen).reshape(seen.shape) - 1, -1)
            c += int(seen.sum())
            columns.append(column)
        entries, shapes = dict[str, list[tuple[Array, IntArray, IntArray]]](), dict[str, int]()
        for hypothesis, column in zip(hypotheses, columns, strict=True):
            for name, values in hypothesis.columns.items():
                n, q, _ = values.shape
                shapes[name] = n * q
                row, block = np.nonzero(hypothesis.share[name])
                part = values[row] * hypothesis.share[name][row, block][:, None, None]
                number, at = np.broadcast_arrays(
                    q * row[:, None, None] + np.arange(q)[:, None], column[:, block].T[:, None]
                )
                seen = (at >= 0) & (part != 0.0)
                entries.setdefault(name, []).append((part[seen], number[seen], at[seen]))
        stacked = dict[str, Any]()
        for name, found in entries.items():
            value, number, at = (np.concatenate(of_all) for of_all in zip(*found, strict=True))
            stacked[name] = csc_array((value, (number, at)), shape=(shapes[name], c))
        return _Scores(Projected.of(self.normal, stacked), columns)

    def better(self, least: float, in_all: float) -> _Solved | None:
        """Return a joint that moved or an error once a turn that explains more than what was found.

        In squares: *least* in units of the scatter that a number leaves behind, *in_all* in those
        of the covariances of outlines. Wrong edges near a right cause leave scatter behind.
        """
        found, asked = list[tuple[_Solved, _Scores]](), 0
        for hypotheses in (*self.of_joints(), *self.of_screws()):
            tests = list(chain.from_iterable(map(self.course.tests, count(), hypotheses)))
            asked += len(tests)
            scores = self.scores(hypotheses)
            for one in scores.solved(tests):
                if one.explains > least and one.explains * one.scatter > in_all:
                    found.append((one, scores))
        for one, scores in sorted(found, key=lambda each: -each[0].explains):
            if one.p_value * asked > DOUBT_BY_CHANCE:
                return None
            if scores.is_of_several_images(one):
                return one
        return None

    def finding(self, number: _Solved, measurements: Measurements) -> UnmodelledEffect:
        """Return a number that the fit lacks."""
        test, hypothesis = number.test, number.test.of
        holds = test.holds.astype(np.float64)[:, None]
        return UnmodelledEffect(
            cast(Kind, hypothesis.kind),
            self._changed(number),
            *_size(number),
            test.between,
            self._effect(hypothesis, holds, number.amount[:, None]),
            _side(measurements, self.course, test),
        )

    def _changed(self, number: _Solved) -> str:
        """Return the subject of a finding: of all encoders those that changed, if they are few."""
        hypothesis = number.test.of
        if hypothesis.kind != "encoder" or hypothesis.subject != ALL_MOTORS:
            return hypothesis.subject
        sigmas = np.abs(number.amount) / np.sqrt(np.diagonal(number.covariance))
        changed = sigmas >= min(_CHANGED, sigmas.max())
        if 2 * np.sum(changed) > len(changed):
            return ALL_MOTORS
        motors = np.unique(self.problem.readings.leg)[changed].tolist()
        return ", ".join(self.problem.legs.nominal[j].motor_label for j in motors)

    def scattering(
        self, noise: _ExcessVariance, hypotheses: Sequence[_Hypothesis]
    ) -> UnmodelledEffect:
        """Return how much readings or a camera scatter."""
        unit = "rad" if noise.kind == "vibration" else hypotheses[noise.group[0][0]].unit
        steps = [
            self._effect(
                hypotheses[i],
                np.diag(noise.further * sigma),
                np.eye(next(iter(hypotheses[i].columns.values())).shape[2])[:, [row]]
                * np.ones(len(sigma)),
            )
            for (i, row), sigma in zip(noise.group, noise.sigma, strict=True)
        ]
        more = noise.further**2 * noise.eigenvalues
        # Standard deviation of the logarithm of the further variance
        spread = math.sqrt(2.0 / max(float(np.sum((more / (1.0 + more)) ** 2)), 1.0))
        sigma_of_ratio = 0.5 * spread * noise.further**2 / noise.ratio
        return UnmodelledEffect(
            noise.kind,
            noise.subject,
            unit,
            noise.ratio * noise.stated,
            sigma_of_ratio * noise.stated,
            None,
            np.hstack(steps),
            stated=noise.stated,
        )

    def _effect(self, hypothesis: _Hypothesis, holds: Array, amount: Array) -> Array:
        """Return errors of the kinematic parameters (p, c) by numbers (d, c) that the fit lacks.

        *holds* (n_blocks, c) has the part of each number in the blocks of images.
        """
        changes = {
            name: (values @ amount) * (hypothesis.share[name] @ holds)[:, None]
            for name, values in hypothesis.columns.items()
        }
        return kinematic_steps(self.problem, response(self.normal, changes))


def _once_a_turn(angle: Array) -> Array:
    """Return the numbers (n, 2) of an error that comes again with each turn."""
    return np.column_stack([np.cos(angle), np.sin(angle)])


def _last_moves(q: Array, leg: IntArray, row: IntArray, before: IntArray) -> Array:
    """Return how far readings are from those of the pose before, zero for first poses."""
    keys = zip(leg.tolist(), row.tolist(), strict=True)
    reading = dict(zip(keys, q.tolist(), strict=True))
    previous = np.where(row >= 0, before[row], -1).tolist()
    return np.array(
        [
            x - reading.get((j, last), x) if last >= 0 else 0.0
            for x, j, last in zip(q.tolist(), leg.tolist(), previous, strict=True)
        ]
    )


@dataclass(frozen=True, eq=False)
class _Scores:
    """Rao's scores of all hypotheses in each block of images."""

    scores: Projected
    column: Sequence[IntArray]  # (d, n_blocks) columns of each hypothesis in turn, -1 without any

    @cached_property
    def _of_hypotheses(self) -> list[Scores]:
        """The scores of each hypothesis in all blocks."""
        ends = [0, *(int(column.max(initial=-1)) + 1 for column in self.column)]
        return [self.scores.at(slice(*own)) for own in pairwise(np.maximum.accumulate(ends))]

    def of_single(
        self, group: Sequence[tuple[int, int]], sigma: Sequence[Array]
    ) -> tuple[IntArray, Array]:
        """Return the columns (c,) of some numbers in single blocks, and what is given of each."""
        columns = np.concatenate([self.column[i][row] for i, row in group])
        return columns[columns >= 0], np.concatenate(sigma)[columns >= 0]

    def with_noise(self, noise: _ExcessVariance) -> _Scores:
        """Return the scores where numbers scatter as much as they were found to."""
        columns, sigma = self.of_single(noise.group, noise.sigma)
        scores = self.scores
        toward = scores.information(slice(None), columns)
        precision = np.diag((noise.further * sigma) ** -2.0) + toward[columns]
        by_noise = np.asarray(np.linalg.solve(precision, toward.T).T, dtype=np.float64)
        scores = scores.less(by_noise, toward, by_noise @ scores.score[columns])
        return _Scores(scores, self.column)

    def most_certain(self, solved: Sequence[_Solved], n_tests: int) -> _Solved | None:
        """Return the number that is least likely by chance; None if all may be chance."""
        for number in sorted(solved, key=lambda one: (one.p_value, -one.explains)):
            if number.p_value * n_tests > DOUBT_BY_CHANCE:
                return None
            if self.is_of_several_images(number):
                return number
        return None

    def is_of_several_images(self, number: _Solved) -> bool:
        """Return whether a number is seen beside an error of its own in any one image.

        Wrong edges or readings of a single image are neither a change nor an error of a motor.
        Blocks of as many images as a change needs are no single image. The others are asked about
        this number alone, which all of them chose.
        """
        place, size = number.test.place, number.test.of.size
        of_blocks, columns = self._of_hypotheses[place], number.estimated.columns
        block = np.nonzero(self.column[place] >= 0)[1]
        every = number.estimated._replace(columns=np.arange(len(columns)))
        score, variance = of_blocks.left([every])
        apart = score[0] ** 2 / np.maximum(variance[0], LEAST_SEEN * of_blocks.size)
        for one in dict.fromkeys(block[np.argsort(-apart, kind="stable")].tolist()):
            if size[one] >= MIN_IMAGES:
                continue
            beside = of_blocks.given(of_blocks.estimate(np.flatnonzero(block == one)))
            (again,) = _solved_by(beside, [number.test], every.chosen[None], columns)
            if again.p_value > _BY_OTHERS:
                return False
        return True

    def solved(self, tests: Sequence[_Test]) -> list[_Solved]:
        """Estimate the number of each test."""
        return [
            number
            for place, of_place in groupby(tests, key=lambda test: test.place)
            for number in self._of_hypothesis(place, list(of_place))
        ]

    def _of_hypothesis(self, place: int, tests: Sequence[_Test]) -> Iterator[_Solved]:
        """Yield the number of each test of one hypothesis."""
        column, of_blocks = self.column[place], self._of_hypotheses[place]
        used = column >= 0
        number, block = np.nonzero(used)
        holds = np.array([test.holds for test in tests])[:, block]
        chosen = np.equal(number[:, None], np.arange(len(column))) * holds[..., None]
        columns = column[used]
        yield from _solved_by(of_blocks, tests, chosen.astype(np.float64), columns)


def _solved_by(
    of_blocks: Scores,  # (c,) of one hypothesis
    tests: Sequence[_Test],
    chosen: Array,  # (n_tests, c, d)
    columns: IntArray,  # (c,) among those of all hypotheses
) -> Iterator[_Solved]:
    """Yield the number of each test of a hypothesis by its scores in single blocks."""
    estimated = of_blocks.estimates(np.arange(len(columns)), chosen)
    score, variance = of_blocks.left(estimated)
    tested = variance > LEAST_SEEN * of_blocks.size
    total = np.sum(np.where(tested, score**2 / np.where(tested, variance, 1.0), 0.0), axis=1)
    scatters = np.maximum(total / np.maximum(tested.sum(axis=1), 1), 1.0).tolist()
    for test, found, scatter in zip(tests, estimated, scatters, strict=True):
        rank, square = found.rank, found.square / scatter
        if test.of.kind == "drift":  # all numbers but the first are levels that may be anything
            variance_of_first = max(
                float(found.covariance[0, 0]) * scatter, np.finfo(np.float64).tiny
            )
            rank, square = min(rank, 1), float(found.amount[0]) ** 2 / variance_of_first
        yield _Solved(test, found._replace(columns=columns), rank, square, scatter)


class _Solved(NamedTuple):
    """The number of a test by its score."""

    test: _Test
    estimated: Estimated
    rank: int  # directions of the number that are tested
    square: float  # of the score, in units of its scatter
    scatter: float  # mean square of the scores of single blocks over their variance, at least 1

    @property
    def p_value(self) -> float:
        """Probability of such a score by chance."""
        return float(chdtrc(float(self.rank), self.square)) if self.rank else 1.0

    @property
    def explains(self) -> float:
        """What the number explains, in squares, less what its parts would by chance."""
        return self.square - _BETTER * self.rank

    @property
    def amount(self) -> Array:
        """The number, (d,)."""
        return self.estimated.amount

    @property
    def covariance(self) -> Array:
        """Covariance of the number."""
        return self.estimated.covariance * self.scatter


def _encoders(hypotheses: Sequence[_Hypothesis]) -> dict[str, list[tuple[int, int]]]:
    """Return the hypotheses of the zeros of single encoders, and their number, by unit."""
    found: dict[str, list[tuple[int, int]]] = {"m": [], "rad": []}
    for i, h in enumerate(hypotheses):
        if h.kind == "encoder" and h.subject != ALL_MOTORS:
            found[h.unit].append((i, 0))
    return found


def _excess_variance(hypotheses: Sequence[_Hypothesis], scores: _Scores) -> _ExcessVariance | None:
    """Return what scatters from image to image: readings beyond what is stated, or a camera."""
    encoders = _encoders(hypotheses)
    single = sorted(one for alike in encoders.values() for one in alike)
    groups: list[tuple[Kind, str, list[tuple[int, int]]]] = [
        ("reading_noise", hypotheses[one[0]].subject, [one]) for one in single
    ]
    for unit, alike in encoders.items():
        if len(alike) > 1:
            subject = ALL_MOTORS if len(alike) == len(single) else f"all motors [{unit}]"
            groups.append(("reading_noise", subject, alike))
    for i, hypothesis in enumerate(hypotheses):
        if hypothesis.kind == "focal_length":
            groups.append(("autofocus", hypothesis.subject, [(i, 0)]))
        if hypothesis.kind == "camera":
            groups.append(("vibration", hypothesis.subject, [(i, row) for row in range(3)]))
    tests = [_ExcessVariance.of(*group, hypotheses, scores, len(groups)) for group in groups]
    if all(test.p_value > DOUBT_BY_CHANCE for test in tests):
        return None
    best = max(tests, key=lambda test: test.gain)
    return None if best.p_value > DOUBT_BY_CHANCE or best.ratio < MOST_SCATTER else best


@dataclass(frozen=True, eq=False)
class _ExcessVariance:
    """Variance of readings, or of a camera, beyond what is stated, by the squares of scores.

    With scores z of the errors in single images and their covariance K under the stated scatter,
    a further variance adds its multiple of K^2 to that of z; the likeliest one is taken. Blocks
    have the mean of their images.
    """

    kind: Kind
    subject: str
    group: Sequence[tuple[int, int]]  # hypotheses and their numbers that scatter alike
    sigma: Sequence[Array]  # (n_blocks,) stated, of the mean in each block [m, rad or 1]
    stated: float  # of a reading, in the median of motors, or of a camera that stands still
    eigenvalues: Array  # (c,) of K
    squares: Array  # (c,) of z along the eigenvectors
    n_tests: int

    @property
    def p_value(self) -> float:
        """Probability of such squares by chance, times the number of tests.

        A weighted sum of squares is nearly chi-squared.
        """
        own, least = self.eigenvalues, np.finfo(np.float64).tiny
        total = max(float(own.sum()), least)
        dof = total**2 / max(float(own @ own), least)
        by_chance = float(chdtrc(dof, float(self.squares.sum()) * dof / total))
        return min(self.n_tests * by_chance, 1.0)

    @cached_property
    def _likeliest(self) -> tuple[float, float]:
        """Logarithm of the likeliest further variance over the stated one, and its likelihood's."""
        from scipy.optimize import minimize_scalar  # only where something scatters

        def loss(logarithm: float) -> float:
            more = math.exp(logarithm) * self.eigenvalues
            return _loss(more, self.eigenvalues, self.squares)

        found = minimize_scalar(loss, bounds=_FURTHER, method="bounded")
        return float(found.x), -float(found.fun)

    @property
    def gain(self) -> float:
        """Gain of the logarithm of the likelihood by the further variance."""
        return self._likeliest[1]

    @property
    def further(self) -> float:
        """Standard deviation beside the stated one, over that."""
        return math.exp(0.5 * self._likeliest[0])

    @property
    def ratio(self) -> float:
        """Standard deviation of readings over the stated one."""
        return math.hypot(1.0, self.further)

    @classmethod
    def of(
        cls,
        kind: Kind,
        subject: str,
        group: Sequence[tuple[int, int]],
        hypotheses: Sequence[_Hypothesis],
        scores: _Scores,
        n_tests: int = 1,
    ) -> _ExcessVariance:
        """Return the scatter of a group of numbers."""
        sigmas, stated = list[Array](), list[float]()
        for i, row in group:
            hypothesis = hypotheses[i]
            if steady := _STEADY.get(hypothesis.kind):
                stated.append(steady)
                sigmas.append(np.full(scores.column[i].shape[1], steady))
                continue
            ((name, wrong),) = hypothesis.columns.items()
            read = wrong[:, 0, row] != 0.0
            stated.append(1.0 / float(np.abs(wrong[read, 0, row]).max()))
            n = hypothesis.share[name][read].sum(axis=0)
            sigmas.append(stated[-1] / np.sqrt(np.maximum(n, 1.0)))
        columns, sigma = scores.of_single(group, sigmas)
        z = sigma * scores.scores.score[columns]
        K = sigma[:, None] * scores.scores.information(columns, columns) * sigma
        own, vector = np.linalg.eigh(K)
        squares, usual = (vector.T @ z) ** 2, float(np.median(stated))
        return cls(kind, subject, group, sigmas, usual, np.maximum(own, 0.0), squares, n_tests)


def _loss(more: Array, own: Array, squares: Array) -> float:
    """Return minus the logarithm of the likelihood of a further variance, by *more* = its part."""
    part = squares / np.where(own > 0.0, own, 1.0)
    return 0.5 * float(np.sum(np.log1p(more) - part * more / (1.0 + more)))


def _overstated(hypotheses: Sequence[_Hypothesis], scores: _Scores) -> dict[str, tuple[float, ...]]:
    """Return how much readings of a unit scatter, and what is stated, where that is far more."""
    found = dict[str, tuple[float, ...]]()
    for unit, group in _encoders(hypotheses).items():
        if not group:
            continue
        one = _ExcessVariance.of("reading_noise", unit, group, hypotheses, scores)
        own, squares = one.eigenvalues, one.squares
        less = np.square(_LESS) - 1.0  # of the variance
        loss = [_loss(v * np.minimum(own, 1.0), own, squares) for v in less]
        if min(loss) < -_SURELY_LESS:
            found[unit] = float(_LESS[int(np.argmin(loss))]) * one.stated, one.stated
    return found
