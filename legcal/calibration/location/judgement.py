"""The verdict: frames, residuals and their spread, put into words."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy import stats
from scipy.spatial.transform import RigidTransform

from legcal.calibration.location.agreement import Agreement
from legcal.calibration.location.fit import Fit
from legcal.calibration.location.frames import jacobian, residuals
from legcal.calibration.location.open import Determinacy
from legcal.calibration.location.problem import Problem
from legcal.calibration.location.result import Location, MeasurementNoise, RowResidual, Status
from legcal.geometry import Array

DOUBTFUL = 1e-3  # probability of residuals as large as these
TOO_GOOD = 1e-4  # probability of residuals as small as these
_NONE = 1e-12  # [m, rad]: held
_KINDS = ("positions", "orientations")


def judge(
    problem: Problem,
    name: str,  # what the poses are called
    agreement: Agreement,  # the rows that the frames rest on
    determined: Determinacy,
    at: Array,  # (3,): the tool position in the platform that was held where it is open [m]
    *,
    is_given: bool,
) -> Location:
    """Return the location with its verdict."""
    found = determined.fit
    p_value, too_large, too_small = _judged(found)
    base, tool = found.frames.transforms()
    if not problem.is_oriented:
        tool = RigidTransform.from_translation(tool.translation)
    tool_position, tool_angle = _at_the_tool(problem, determined)
    left_out = problem.poses.numbers[~agreement.agrees].tolist()
    status: Status = "located in part" if determined.held else "located"
    if too_large:
        status = "doubtful"
    return Location(
        model=str(problem.machine.yaml_path),
        poses=name,
        T_world_base=base,
        T_platform_tool=tool,
        has_tool_orientation=problem.is_oriented,
        covariance=0.5 * (determined.covariance + determined.covariance.T),
        held=determined.held,
        held_at=(float(at[0]), float(at[1]), float(at[2])),
        held_words=determined.words,
        noise=_noise(problem, found),
        rows=tuple(_rows(problem, agreement, found)),
        chi2=found.chi2,
        dof=found.dof,
        p_value=p_value,
        tool_position_sigma=tool_position,
        tool_angle_sigma=tool_angle,
        status=status,
        sentence=_sentence(problem, determined, left_out, too_large),
        notes=tuple(_notes(problem, determined, agreement, too_small, is_given=is_given)),
    )


def _judged(found: Fit) -> tuple[float | None, str, str]:
    """Return the probability of larger residuals, and what is too large or too small in words."""
    noise = found.noise
    kinds = [k for k in range(2) if noise.stated[k] and found.kind_dof[k] > 0.5]
    if not kinds:
        return None, "", ""
    squares = (found.whitened**2).reshape(-1, 2, 3).sum(axis=(0, 2))
    if len(kinds) == 2 or found.kind_dof.min() <= 0.5:
        total, dof = found.chi2, float(found.dof)
    else:
        total, dof = float(squares[kinds[0]]), float(found.kind_dof[kinds[0]])
    p_value = float(stats.chi2.sf(total, dof))
    large, small = list[str](), list[str]()
    for k in kinds:
        ratio = float(np.sqrt(squares[k] / found.kind_dof[k]))
        words = f"{_KINDS[k]} scatter {ratio:.2g} times as much as was stated of them"
        (large if ratio > 1.0 else small).append(words)
    too_small = " and ".join(small) if stats.chi2.cdf(total, dof) < TOO_GOOD else ""
    return p_value, " and ".join(large) if p_value < DOUBTFUL else "", too_small


def _noise(problem: Problem, found: Fit) -> MeasurementNoise:
    """Return what was stated or found of the measurement."""
    rms = found.noise.factor * np.sqrt((found.noise.sigma**2).mean(axis=0))
    oriented = problem.is_oriented
    return MeasurementNoise(
        position=float(rms[0]),
        angle=float(rms[1]) if oriented else None,
        position_stated=problem.noise.stated[0],
        angle_stated=problem.noise.stated[1] and oriented,
        reading=problem.encoder_sigma,
        model=problem.by_model is not None,
    )


def _rows(problem: Problem, agreement: Agreement, found: Fit) -> list[RowResidual]:
    """Return the residuals of all rows; errors of the model are not taken out of them."""
    pairs = problem.pairs
    r = residuals(found.frames, pairs)
    rows = []
    for i, number in enumerate(problem.poses.numbers.tolist()):
        reason = "" if agreement.agrees[i] else _off(problem, agreement, i)
        rows.append(
            RowResidual(
                number,
                (float(r[i, 0]), float(r[i, 1]), float(r[i, 2])),
                (float(r[i, 3]), float(r[i, 4]), float(r[i, 5])) if pairs.oriented[i] else None,
                reason,
            )
        )
    return rows


def _off(problem: Problem, agreement: Agreement, i: int) -> str:
    """Return how far a row is from where the others predict it."""
    sigma = agreement.factor * problem.noise.sigma[i]
    found = f"{1e3 * agreement.distance[i]:.3g} mm"
    scatter = f"{1e3 * sigma[0]:.2g} mm"
    if problem.pairs.oriented[i]:
        found += f" and {np.degrees(agreement.angle[i]):.3g} deg"
        scatter += f" and {np.degrees(sigma[1]):.2g} deg"
    return f"{found} from where the other rows predict it, which scatter {scatter}"


def _at_the_tool(problem: Problem, determined: Determinacy) -> tuple[float, float | None]:
    """Return how well the frames put the tool in the world, rms over the poses [m], [rad]."""
    J = jacobian(determined.fit.frames, problem.pairs)
    variance = np.einsum("nij,jk,nik->ni", J, determined.covariance, J)
    position = float(np.sqrt(variance[:, :3].sum(axis=1).mean()))
    oriented = problem.pairs.oriented
    if not oriented.any():
        return position, None
    return position, float(np.sqrt(variance[oriented, 3:].sum(axis=1).mean()))


def _sentence(
    problem: Problem, determined: Determinacy, left_out: Sequence[int], too_large: str
) -> str:
    """Return the verdict."""
    used = len(problem.poses) - len(left_out)
    sigma = np.sqrt(np.maximum(np.diagonal(determined.covariance), 0.0)).reshape(4, 3)
    size = np.linalg.norm(sigma, axis=1)
    base = f"{1e3 * size[0]:.2g} mm and {np.degrees(size[1]):.2g} deg"
    known = [
        f"{1e3 * size[2]:.2g} mm" * bool(size[2] > _NONE),
        f"{np.degrees(size[3]):.2g} deg" * bool(problem.is_oriented and size[3] > _NONE),
    ]
    tool = " and ".join(words for words in known if words)
    tool = f", the tool in the platform to {tool}" if tool else ""
    tool += "" if problem.is_oriented else " (its position only)"
    rows = f"{used} of {len(problem.poses)} poses" if left_out else f"{used} poses"
    out = ""
    if left_out:
        several = len(left_out) > 1
        out = (
            f" Row{'s' * several} {', '.join(map(str, left_out))} disagree{'s' * (not several)} "
            f"with the others and {'were' if several else 'was'} left out."
        )
    if too_large:
        return (
            f"Doubtful: {too_large}, so that the standard deviations are too small; errors of the "
            "model or of the readings may be the reason, or readings and poses that do not belong "
            "together." + out
        )
    start = "Base and tool are located" + " in part" * bool(determined.held)
    return (
        f"{start} from {rows}: the base in the world to {base}{tool} "
        f"(1 sigma{'' if problem.by_model is not None else ', if the model is right'})."
        f"{' ' * bool(determined.words)}{determined.words}{out}"
    )


def _notes(
    problem: Problem,
    determined: Determinacy,
    agreement: Agreement,
    too_small: str,
    *,
    is_given: bool,
) -> list[str]:
    """Return what else a reader should know."""
    notes = [*problem.poses.notes, *determined.weak]
    if problem.by_model is None:
        notes.append(
            "Nothing is known of the errors of the model, which move all poses at once: the "
            "standard deviations hold for a model without errors; locate the model in the folder "
            "of its calibration, or state how precise the measurement is to have it tested."
        )
    if int(agreement.agrees.sum()) == problem.fewest:
        notes.append(
            f"A wrong row among the {problem.fewest} poses could not have been noticed; measure "
            "more."
        )
    if too_small:
        notes.append(f"The stated standard deviations look too large: {too_small}.")
    if is_given and not determined.held:
        notes.append("The given position of the tool was not needed: the poses determine it.")
    return notes
