"""Text reports of a calibration, of a check of an earlier one, and of two compared models."""

from __future__ import annotations

import shlex
import textwrap
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from rich.text import Text

from legcal.calibration.documents import (
    ExplanationBlock,
    NextStep,
    PlatformBlock,
    Result,
    WorkspaceAccuracy,
)
from legcal.calibration.joint_fit.platform import PlatformAccuracy
from legcal.calibration.joint_fit.sensitivity import INTRINSICS
from legcal.calibration.summary import (
    DIGITS,
    brief_sentences,
    joints_of,
    parameters_of,
    sentences,
    tables,
)
from legcal.files.quantity import SHOWN_IN
from legcal.files.schema import few
from legcal.machine.leg import ParameterId
from legcal.machine.tolerance import TYPICAL
from legcal.pages.document import Light, Table, Verdict
from legcal.report.render import Report, report, table, verdict_line

if TYPE_CHECKING:
    from legcal.calibration.evaluation import Evaluation
    from legcal.calibration.result import Calibration
    from legcal.calibration.verification import Check

_SCREEN, _WIDTH = 24, 80  # lines and columns of a small terminal
_LARGEST = 3  # largest changes of parameters shown
_WORTH_A_BOARD = 0.9  # predicted error with exact intrinsics, relative to the present one
_EXPLANATIONS = 3  # alternative explanations shown
_WORDS: dict[Light, str] = {
    "good": "Use it",
    "doubtful": "Do not trust it yet",
    "bad": "Do not load it into the controller",
}


def summary(
    calibration: Calibration, output: Path, command: str = "", *, verbose: bool = False
) -> Report:
    """Return one screen: verdict, platform, largest changes, weakest direction, notes, what next.

    *verbose* adds all parameters in mm, degrees and pixels, and the quality of the fit.
    """
    result = calibration.result
    verdict = verdict_line(verdict_of(calibration))
    written = f"Written to {output}."
    following = list[str]()  # of doubts it stands in the verdict and beside each of them
    if calibration.verdict.trustworthy:
        steps = next_steps(calibration, str(output), command)
        first = next(one for one in steps if one.command)
        following = [f"Next: {first.what[0].lower()}{first.what[1:]}"]
        following.append(f"  {first.command}")
    if not verbose:
        platform = None if result.platform is None else platform_table(result.platform)
        changes = _largest_changes(result) if calibration.verdict.trustworthy else None
        taken = [calibration.verdict.sentence, *([""] * 5 if platform else [])]
        taken += [
            *([""] * (_LARGEST + 2) if changes else []),
            *(["", *following] if following else []),
        ]
        brief = [*brief_sentences(result), *(f"Note: {note}" for note in result.notes)]
        last = f"{written} All parameters: --verbose, or the files there."
        room = _SCREEN - sum(map(_height, [*taken, last])) - 1
        return report(verdict, platform, changes, [*_first(brief, room), last], following)
    shown = [parameters.as_table(title) for title, parameters in tables(result)]
    lines: list[str | Text] = [*sentences(result, verbose=True), written, verdict]
    return report(*shown, lines, following)


def _first(lines: Sequence[str], room: int) -> list[str]:
    """Return the lines that fit into the room on a screen, and how many notes do not."""
    shown = list(lines)
    while shown and sum(map(_height, shown)) + (len(shown) < len(lines)) > room:
        shown.pop()
    more = len(lines) - len(shown)
    s = "s" * (more != 1)
    return [*shown, *([f"{more} more note{s}: --verbose, or report.html."] if more else [])]


def _height(line: str) -> int:
    """Return the height of a text on a screen."""
    return max(1, len(textwrap.wrap(line, _WIDTH)))


def verdict_of(calibration: Calibration) -> Verdict:
    """Return the verdict: green, amber where something speaks against it, or red."""
    verdict = calibration.verdict
    light: Light = "good"
    if not verdict.trustworthy:
        light = "bad" if verdict.is_to_be_refused else "doubtful"
    reasons = brief_sentences(calibration.result)
    return Verdict(light, _WORDS[light], verdict.sentence, reasons)


def document(calibration: Calibration, output: Path, command: str) -> dict[str, Any]:
    """Return the document of ``calibrate --json``: the result, and what to do next."""
    steps = next_steps(calibration, str(output), command)
    return calibration.result.model_copy(update={"next": steps}).document()


def _written_beside(command: str, suffix: str) -> str:
    """Return a command with another output folder, so that the result of the first stays."""
    words = shlex.split(command.replace(" --output=", " --output "))
    for k, word in enumerate(words[:-1]):
        if word in ("-o", "--output"):
            words[k + 1] = f"{words[k + 1].rstrip('/')}-{suffix}"
    return shlex.join(words)


def next_steps(calibration: Calibration, folder: str, command: str) -> list[NextStep]:
    """Return what to do next, the first thing first; *command* has made the result, if any has."""
    from legcal.calibration.pipeline import exact_cameras  # not needed to compare models

    result, steps = calibration.result, list[NextStep]()
    dataset, out = shlex.quote(str(calibration.dataset.folder)), shlex.quote(folder)
    command = command or f"legcal calibrate {dataset} -o {out}"

    def add(what: str, command: str = "") -> None:
        steps.append(NextStep(what=what, command=command))

    for doubt in calibration.doubts:
        what, remedy = (f"{text[0].upper()}{text[1:]}" for text in (doubt.what, doubt.remedy))
        add(f"{what}. {remedy}, and calibrate again.")
    remedy = calibration.verdict.remedy
    if remedy and all(remedy != doubt.remedy for doubt in calibration.doubts):
        add(f"{remedy[0].upper()}{remedy[1:]}, and calibrate again.")
    if calibration.verdict.trustworthy:
        add(
            "Load calibrated.urdf, or the numbers of its parameters, into the controller, and "
            "move to a few poses whose place you can measure."
        )
        if result.holdout is None and calibration.dataset.machine.is_determined:
            add(
                "See how well it predicts images that it has not seen:",
                f"{_written_beside(command, 'holdout')} --holdout 0.2",
            )
        add(
            "Where the base stands in the cell and the tool on the platform is not seen in "
            "photographs of legs; with measured POSES of the tool:",
            f"legcal locate {out}/calibrated.yaml POSES -o located.yaml",
        )
        add(
            "In some months, or after a collision, photograph a few poses (NEW) and ask "
            "whether anything moved:",
            f"legcal calibrate NEW --check {out}",
        )
    elif not result.diagnosis:
        if result.weakest:
            add(f"More images help where least is known: {result.weakest[0].in_words}.")
        add(
            "Look at the worst outlines in report.html: blur, reflections and wrong edges "
            "show there."
        )
    if _is_left_open(calibration):
        stated = "that you state"
        if not calibration.dataset.machine.tolerance.says_parts:
            stated = "of its kind (machine_kind in dataset.yaml: printed, machined or bought)"
        add(
            "These images do not tell all parameters to better than a machine is built; with the "
            f"tolerances {stated} as priors they may tell the zeros of its motors (or lengths, or "
            "all):",
            f"{_written_beside(command, 'zeros')} --only zeros",
        )
    if exact_cameras(calibration.dataset, calibration.solution.posterior.problem.choices):
        add(
            "Calibrate the camera, with the board that you have: its file then states how well "
            "it is known, which belongs into the uncertainty of the result.",
            "legcal camera BOARDS --board chessboard:9x6:25mm -o camera_info.yaml",
        )
    elif gain := _gain_of_a_board(calibration.platform):
        add(gain, "legcal camera BOARDS --board chessboard:9x6:25mm -o FILE")
    return steps


def _is_left_open(calibration: Calibration) -> bool:
    """Return whether the platform stays as uncertain as a machine is built, or directions open."""
    machine, platform = calibration.dataset.machine, calibration.platform
    if platform is None or calibration.group is not None:
        return False
    built = machine.tolerance.joints or TYPICAL["printed"].joints or 0.0
    error = (platform.workspace or platform.sigma).mean_displacement
    return error > built or (bool(calibration.result.held) and not calibration.verdict.trustworthy)


def _gain_of_a_board(platform: PlatformAccuracy | None) -> str:
    """Return what exact intrinsics would bring, "" if it is little."""
    if platform is None:
        return ""
    error = (platform.workspace or platform.sigma).mean_displacement
    of_cameras = platform.effects.get(INTRINSICS)
    if of_cameras is None:
        return ""
    rest = float(np.sqrt(max(error**2 - of_cameras.mean_displacement**2, 0.0)))
    if rest > _WORTH_A_BOARD * error:
        return ""
    return (
        f"Calibrate the camera with a board: with exact intrinsics the predicted error would be "
        f"{1e3 * rest:.2g} mm in place of {1e3 * error:.2g} mm:"
    )


def platform_table(platform: PlatformBlock) -> Table:
    """Return the platform error before the calibration, and the predicted error after it."""
    after: PlatformBlock | WorkspaceAccuracy = platform.workspace or platform
    scope = "poses" if platform.workspace is None else "workspace"
    rows = [
        ("nominal vs. calibrated", platform.change_dX_m, platform.change_dE_rad),
        (f"calibrated, predicted (1 sigma, {scope})", after.sigma_dX_m, after.sigma_dE_rad),
        ("maximum", after.sigma_dX_max_m, after.sigma_dE_max_rad),
    ]
    return table(
        "platform error",
        ">mm",
        ">deg",
        rows=[(name, f"{1e3 * dX:.3f}", f"{np.degrees(dE):.4f}") for name, dX, dE in rows],
    )


def _largest_changes(result: Result) -> Table | None:
    """Return the lengths and coordinates that changed most, joints in the links."""
    others = [q for q in parameters_of(result) if not q.parameter.is_joint_coordinate]
    changes = [
        (q.name, q.change, q.sigma)
        for q in (*joints_of(result), *others)
        if q.unit == "mm" and q.change is not None and q.sigma is not None
    ]
    largest = sorted(changes, key=lambda row: -abs(row[1]))[:_LARGEST]
    if not largest:
        return None
    return table(
        "largest changes",
        ">mm",
        ">sigma",
        rows=[(name, f"{change:+.3f}", f"{sigma:.3f}") for name, change, sigma in largest],
    )


def check_summary(check: Check) -> Report:
    """Return the result of a check: the verdict, what explains it, and how it was tested."""
    movement, images = check.movement, check.dataset.measurements.n_rows
    lines = list[str]()
    if movement.explanations:
        best, *others = movement.explanations
        change, amount = best.what, _amount(best)
        if best.p_value < movement.significance:
            lines.append(
                f"No single leg explains it; {change} explains most ({amount}; residual statistic "
                f"{best.remaining:.1f} of {movement.statistic:.1f})."
            )
        else:
            lines.append(f"It is explained by {change}: {amount}.")
            named = ", ".join(other.what for other in others[:_EXPLANATIONS])
            lines += [f"These images cannot distinguish that from: {named}."] if named else []
    lines += [
        f"{images} image{'s' * (images != 1)} compared with {check.earlier.folder}: {movement.dof} "
        f"of {len(check.earlier.names)} directions of the parameters, "
        f"statistic {movement.statistic:.1f}.",
        *(f"Note: {note}" for note in check.notes),
    ]
    return report(verdict_line(check_verdict(check)), lines)


def _amount(change: ExplanationBlock) -> str:
    parts = []
    components = zip(change.components, change.units, change.links, strict=True)
    numbers = zip(change.values, change.sigma, strict=True)
    for (name, unit, link), (value, sigma) in zip(components, numbers, strict=True):
        scale, shown = SHOWN_IN[unit]
        digits = DIGITS[shown]
        amount = f"{scale * value:+.{digits}f} {shown}"
        moved = f"{amount} in {name} of {link}" if link else f"{name} {amount}"
        parts.append(f"{moved} (1 sigma {scale * sigma:.{digits}f})")
    return ", ".join(parts)


def accuracy_table(evaluation: Evaluation) -> Report:
    """Return the platform errors and the parameters of two models, in mm and degrees."""
    dX, dE = 1e3 * evaluation.displacement, np.degrees(evaluation.rotation)
    headline = "Parameters only: the motors of a model do not determine its pose."
    if len(dX):
        headline = (
            f"Platform error over {len(dX)} poses: displacement {dX.mean():.4f} mm "
            f"(max {dX.max():.4f}), orientation {dE.mean():.4f} deg (max {dE.max():.4f})"
        )
    left_out = None
    if n := evaluation.n_left_out:
        rows_left_out = few([str(row) for row in evaluation.unreached])
        left_out = (
            f"{n} of {n + len(dX)} poses are left out, which one of the models does not reach "
            f"(rows {rows_left_out})."
        )
    scale = np.array([SHOWN_IN[unit][0] for unit in evaluation.units])
    values, references = scale * evaluation.values, scale * evaluation.references
    rows = [
        (name, f"{value:z.4f}", f"{reference:z.4f}", f"{value - reference:+z.4f}")
        for name, value, reference in zip(evaluation.names, values, references, strict=True)
        if not (ParameterId.parse(name).kind == "gain" and value == reference == 1.0)
    ]
    angles = "; axes and twists in deg" * ("rad" in evaluation.units)
    columns = ("parameter", ">model", ">reference", ">difference")
    return report(
        headline,
        left_out,
        table(*columns, rows=rows, title=f"Parameters, joints in R_b and R_e [mm{angles}]"),
    )


def check_verdict(check: Check) -> Verdict:
    """Return whether anything has moved: green or red."""
    if check.movement.moved:
        return Verdict("bad", "Something has moved", check.sentence, [])
    return Verdict("good", "No change was detected", check.sentence, [])
