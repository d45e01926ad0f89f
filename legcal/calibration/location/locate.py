"""Locating base and tool: search, rows that agree, most likely frames, what stays open."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from legcal.calibration.location.agreement import Agreement, find_agreement
from legcal.calibration.location.fit import Fit, fit
from legcal.calibration.location.frames import SMALLEST, Frames
from legcal.calibration.location.judgement import judge
from legcal.calibration.location.mistakes import likely_mistake
from legcal.calibration.location.open import Determinacy, determine, hold
from legcal.calibration.location.problem import Problem, build_problem
from legcal.calibration.location.result import Location, ToolPoses
from legcal.calibration.location.search import Candidates, search
from legcal.calibration.location.table import LARGEST_ANGLE, read_tool_poses
from legcal.errors import DatasetError, DidNotConverge, NotIdentifiable, UsageError
from legcal.files import describe
from legcal.geometry import Array
from legcal.machine import Machine, load_mechanism

MOST_LEFT_OUT = 4  # a row of so many may disagree, and one of few
SUSPICIOUS = 0.05  # residuals in parts of the spread of positions, and [rad]
HOPELESS = 0.2
ENOUGH = 1.0  # degrees of freedom
LARGEST = 1.0  # [m]
LARGEST_TOOL = 100.0  # [m]
_SAME_FIT = 30.0  # of chi2: two answers that explain the poses alike
_ALIKE = 25.0  # times the cost of the best
_ROUNDING = 1e-20
_APART = 0.02  # [rad], and of the length: two answers
_ROUNDS = 3  # of frames and what readings do to the tool


def locate(
    model: str | Path | Machine,
    poses: str | Path | ToolPoses,
    *,
    position_sigma: float | None = None,
    angle_sigma: float | None = None,
    encoder_sigma: float = 0.0,
    tool_position: Sequence[float] | None = None,
) -> Location:
    """Return where the base stands in the world and the tool in the platform.

    The frames make the measured poses T_world_tool = T_world_base T_base_platform(q)
    T_platform_tool most likely. Rows that disagree with the others are left out and named.

    Parameters
    ----------
    model : str, Path or Machine
        The machine, as for :func:`legcal.load_mechanism`. Where it lies in the result folder of a
        calibration, the covariance of its parameters counts.
    poses : str, Path or ToolPoses
        The table of measured tool poses.
    position_sigma, angle_sigma : float, optional
        Standard deviations of the measurement, a component [m], [rad]; where neither they nor the
        table tell, they are estimated from the residuals.
    encoder_sigma : float
        Standard deviation of a reading [m].
    tool_position : (3,) sequence of float, optional
        Position of the tool in the platform [m], taken where the machine leaves it open; the
        origin without it.

    Returns
    -------
    Location

    Raises
    ------
    DatasetError
        If the table is malformed, or contradicts the machine.
    NotIdentifiable
        If the poses leave open what other poses of the machine would tell.
    """
    _check_numbers(position_sigma, angle_sigma, encoder_sigma, tool_position)
    machine = model if isinstance(model, Machine) else load_mechanism(model)
    name = "The tool poses" if isinstance(poses, ToolPoses) else str(poses)
    measured = poses if isinstance(poses, ToolPoses) else read_tool_poses(Path(poses), machine)
    problem = build_problem(
        machine,
        measured,
        name,
        position_sigma=position_sigma,
        angle_sigma=angle_sigma,
        encoder_sigma=encoder_sigma,
    )
    candidates = search(problem.pairs, problem.fewest)
    _check_plausible(problem, candidates, name)
    agreement = find_agreement(
        problem.pairs, candidates.frames.at(0), problem.noise, problem.fewest
    )
    _check_agreement(problem, candidates, agreement, name)
    used = problem.of(agreement.agrees)
    found = most_likely(used, agreement.frames)
    _check_scatter(used, found, name)
    at = np.zeros(3) if tool_position is None else np.asarray(tool_position, dtype=np.float64)
    determined = determine(used, found, at, name)
    _check_unique(used, determined, candidates, at, name)
    return judge(problem, name, agreement, determined, at, is_given=tool_position is not None)


def most_likely(problem: Problem, start: Frames) -> Fit:
    """Return the maximum likelihood fit of a problem, from a start.

    Errors of the readings move the tool through the frames that are looked for: their covariance
    follows the frames.
    """
    found = fit(problem.pairs, start, problem.noise_at(start), problem.by_model)
    for _ in range(_ROUNDS if problem.by_readings is not None else 0):
        found = fit(problem.pairs, found.frames, problem.noise_at(found.frames), problem.by_model)
    return found


def _check_numbers(
    position_sigma: float | None,
    angle_sigma: float | None,
    encoder_sigma: float,
    tool_position: Sequence[float] | None,
) -> None:
    """Refuse numbers that cannot be meant."""
    for what, value, least, most, unit in (
        ("position sigma", position_sigma, SMALLEST, LARGEST, "m"),
        ("angle sigma", angle_sigma, SMALLEST, LARGEST_ANGLE, "rad"),
        ("encoder sigma", encoder_sigma, 0.0, LARGEST, "m"),
    ):
        if value is not None and not least <= value <= most:
            raise UsageError(
                f"The {what} could not be used: found {value:g} {unit}, needed {least:g} to "
                f"{most:g} {unit}; correct it."
            )
    if tool_position is not None and not (
        len(tool_position) == 3 and bool(np.all(np.abs(tool_position) <= LARGEST_TOOL))
    ):
        raise UsageError(
            f"The tool position could not be used: found {describe(list(tool_position))}, needed "
            f"three numbers within {LARGEST_TOOL:g} m; give x, y, z in the platform."
        )


def _check_plausible(problem: Problem, candidates: Candidates, name: str) -> None:
    """Refuse poses that no frames explain, with the mistake that would explain them.

    The rows that agree best are looked at: most are right, or all are wrong in one way.
    """
    pairs = problem.pairs
    spread = float(np.sqrt(pairs.p.var(axis=0).sum()))
    left = float(np.sqrt(candidates.cost[0]))  # in lengths of the machine, and [rad]
    part = left / min(1.0, spread / pairs.length + 1e-12)
    if part <= SUSPICIOUS:
        return
    _refuse_mistakes(problem, candidates, name)
    if part > HOPELESS:
        size = f"{1e3 * left * pairs.length:.3g} mm"
        turn = f" or {np.degrees(left):.3g} deg" * problem.is_oriented
        raise DatasetError(
            f"{name}: base and tool could not be located: found poses about {size}{turn} from "
            "where the readings put them, whatever the frames, needed poses measured at these "
            "readings; check that rows belong together, the columns of the readings, and the model."
        )


def _refuse_mistakes(problem: Problem, candidates: Candidates, name: str) -> None:
    """Refuse poses that a common mistake explains."""
    mistake = likely_mistake(problem.pairs, float(candidates.cost[0]), problem.fewest)
    if mistake is not None:
        raise DatasetError(
            f"{name}: base and tool could not be located: found poses that look like {mistake[0]}, "
            "needed positions in metres and quaternions x, y, z, w of the tool in right-handed "
            f"axes of the world; {mistake[1]}."
        )


def _check_agreement(
    problem: Problem, candidates: Candidates, agreement: Agreement, name: str
) -> None:
    """Refuse poses of which too many disagree."""
    n, n_out = len(problem.pairs), int(np.sum(~agreement.agrees))
    most = max(1, n // MOST_LEFT_OUT)
    if n_out <= most:
        return
    _refuse_mistakes(problem, candidates, name)
    rows = ", ".join(str(i) for i in problem.poses.numbers[~agreement.agrees])
    raise DatasetError(
        f"{name}: base and tool could not be located: found {n_out} of {n} rows that disagree with "
        f"the others ({rows}), needed at most {most}; check that readings and poses of these rows "
        "belong together."
    )


def _check_scatter(problem: Problem, found: Fit, name: str) -> None:
    """Refuse to estimate a scatter from rows that leave nothing over."""
    for kind, (what, option) in enumerate(
        (("positions", "--position-sigma"), ("orientations", "--angle-sigma"))
    ):
        if not problem.noise.stated[kind] and found.kind_dof[kind] < ENOUGH:
            raise NotIdentifiable(
                f"{name}: the uncertainty could not be estimated: found {what} of "
                f"{len(problem.pairs)} rows that leave {found.kind_dof[kind]:.2g} degrees of "
                f"freedom, needed at least {ENOUGH:g}; measure more poses, or state how precise "
                f"they are with {option}."
            )


def _check_unique(
    problem: Problem, determined: Determinacy, candidates: Candidates, at: Array, name: str
) -> None:
    """Refuse where other frames explain the poses as well."""
    best = determined.fit
    noise = replace(best.noise, stated=(True, True))
    for i in range(1, len(candidates.cost)):
        start = candidates.frames.at(i)
        if candidates.cost[i] > _ALIKE * candidates.cost[0] + _ROUNDING:
            break
        if not determined.held and _are_one(best.frames, start, problem.pairs.length):
            continue
        try:
            other = fit(problem.pairs, start, noise, problem.by_model)
            other = hold(problem, other, at)
        except (DidNotConverge, np.linalg.LinAlgError):
            continue
        is_other = not _are_one(best.frames, other.frames, problem.pairs.length)
        if is_other and other.chi2 < best.chi2 + _SAME_FIT:
            shift, turn = _apart(best.frames, other.frames)
            raise NotIdentifiable(
                f"{name}: base and tool could not be located: found two answers, "
                f"{1e3 * shift:.3g} mm and {np.degrees(turn):.3g} deg apart, that explain the "
                f"{len(problem.pairs)} poses equally well, needed one; add poses from all over "
                "the workspace."
            )


def _are_one(one: Frames, other: Frames, length: float) -> bool:
    """Say whether the frames of two answers are the same but for noise."""
    shift, turn = _apart(one, other)
    return shift <= _APART * length and turn <= _APART


def _apart(one: Frames, other: Frames) -> tuple[float, float]:
    """Return how far the frames of two answers are apart, the worse of base and tool [m, rad]."""
    shifts = (one.t_base - other.t_base, one.t_tool - other.t_tool)
    # The matrices of two orientations are sqrt(8) sin(turn / 2) apart.
    chords = (one.R_base - other.R_base, one.R_tool - other.R_tool)
    half = min(1.0, max(float(np.linalg.norm(chord)) for chord in chords) / np.sqrt(8.0))
    return max(float(np.linalg.norm(shift)) for shift in shifts), 2.0 * float(np.arcsin(half))
