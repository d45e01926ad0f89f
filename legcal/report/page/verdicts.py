"""What a calibration is worth at a glance, why, and what to do next."""

from __future__ import annotations

import shlex

import numpy as np

from legcal.calibration.doubts import Doubt
from legcal.calibration.identify.report import Identifiability
from legcal.calibration.joint_fit.scale import single_witness
from legcal.calibration.pipeline import exact_cameras
from legcal.calibration.quantities import mm_deg
from legcal.calibration.result import Calibration
from legcal.calibration.verification import Check
from legcal.pages.document import Light, Verdict

_WORDS: dict[Light, str] = {
    "good": "Use it",
    "doubtful": "Do not trust it yet",
    "bad": "Do not load it into the controller",
}


def verdict_of(calibration: Calibration) -> Verdict:
    """Return the verdict: green, amber where something speaks against it, or red."""
    verdict = calibration.verdict
    light: Light = "good"
    if not verdict.trustworthy:
        light = "bad" if verdict.is_to_be_refused else "doubtful"
    doubts = [f"{doubt.sentence}{_effect(doubt)}" for doubt in verdict.doubts]
    return Verdict(light, _WORDS[light], verdict.sentence, [*doubts, *_grounds(calibration)])


def _effect(doubt: Doubt) -> str:
    """Return how far a doubt would move the platform, in words."""
    if doubt.sigma_dX_m is None or doubt.sigma_dE_rad is None:
        return ""
    return f" At the platform: {mm_deg(doubt.sigma_dX_m, doubt.sigma_dE_rad)}."


def _grounds(calibration: Calibration) -> list[str]:
    """Return what the verdict rests on."""
    result, found = calibration.result, []
    platform, seen = result.platform, result.observations
    if platform is not None:
        ratio = platform.change_dX_m / platform.sigma_dX_m if platform.sigma_dX_m else np.inf
        found.append(
            f"The change of the platform is {ratio:.1f} times its standard deviation; above 2 a "
            "calibration counts as an improvement."
        )
    if seen is not None:
        found.append(f"{seen.used} of {seen.total} {seen.kind} in {seen.images} images were used.")
    quality = result.residuals
    if quality.rms_px is not None:
        found.append(f"Outlines lie {quality.rms_px:.3f} px (rms) from the fit.")
    held_out = result.holdout
    if held_out is not None and held_out.rms_px is not None and held_out.expected_px is not None:
        found.append(
            f"Images that were kept aside lie {held_out.rms_px:.3f} px off; "
            f"{held_out.expected_px:.3f} px were expected."
        )
    if witness := single_witness(calibration.solution.posterior.problem):
        found.append(witness)
    return found


def _written_beside(command: str) -> str:
    """Return a command with another output folder, so that the result of the first stays."""
    words = shlex.split(command)
    for k, word in enumerate(words[:-1]):
        if word in ("-o", "--output"):
            words[k + 1] = f"{words[k + 1].rstrip('/')}-holdout"
    return shlex.join(words)


def next_steps(calibration: Calibration, folder: str, command: str) -> list[str]:
    """Return what to do next, the first thing first; *command* has made the result, if any has."""
    result, steps = calibration.result, list[str]()
    dataset, out = shlex.quote(str(calibration.dataset.folder)), shlex.quote(folder)
    for doubt in calibration.doubts:
        what, remedy = (f"{text[0].upper()}{text[1:]}" for text in (doubt.what, doubt.remedy))
        steps.append(f"{what}. {remedy}, and calibrate again.")
    remedy = calibration.verdict.remedy
    if remedy and all(remedy != doubt.remedy for doubt in calibration.doubts):
        steps.append(f"{remedy[0].upper()}{remedy[1:]}, and calibrate again.")
    if calibration.verdict.trustworthy:
        steps.append(
            "Load calibrated.urdf, or the numbers of the table below, into the controller, and "
            "move to a few poses whose place you can measure."
        )
        if result.holdout is None and calibration.dataset.machine.is_determined:
            steps.append(
                "See how well it predicts images that it has not seen: "
                f"{_written_beside(command or f'legcal calibrate {dataset} -o {out}')} "
                "--holdout 0.2."
            )
        steps.append(
            "Where the base stands in the cell and the tool on the platform is not seen in "
            f"photographs of legs: legcal locate {out}/calibrated.yaml POSES -o located.yaml."
        )
        steps.append(
            "In some months, or after a collision, photograph a few poses and ask whether anything "
            f"moved: legcal calibrate NEW --check {out}."
        )
    elif not result.diagnosis:
        if result.weakest:
            steps.append(f"More images help where least is known: {result.weakest[0].in_words}.")
        steps.append(
            "Look at the worst outlines below: blur, reflections and wrong edges show there."
        )
    if exact_cameras(calibration.dataset, calibration.solution.posterior.problem.choices):
        steps.append(
            "Calibrate the camera with legcal camera: its file then states how well it is known, "
            "which belongs into the uncertainty of the result."
        )
    return steps


def check_verdict(check: Check) -> Verdict:
    """Return whether anything has moved: green or red."""
    if check.movement.moved:
        return Verdict("bad", "Something has moved", check.sentence, [])
    return Verdict("good", "No change was detected", check.sentence, [])


def identify_verdict(report: Identifiability) -> Verdict:
    """Return whether a session determines its machine: amber where a condition fails."""
    full = report.full
    sentence = f"The joint fit determines {full.rank} of {full.of} parameters."
    if not report.identifiable:
        word = "These images cannot determine the machine"
        reasons = [f"Open: {one.direction}." for one in full.weak if not one.harmless]
        return Verdict("bad", word, sentence, reasons)
    if report.scale:
        word = "These images can determine all of the machine but its scale"
        ways = ", or ".join(one.assumed for one in report.scale if one.sigma is not None)
        return Verdict("doubtful", word, sentence, [f"To fix the scale: {ways}."] if ways else [])
    if not report.conditions_hold:
        word = "The joint fit can determine it, but conditions of the paper fail"
        return Verdict("doubtful", word, sentence, [])
    return Verdict("good", "These images determine the machine", sentence, [])
