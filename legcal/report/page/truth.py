"""Errors of the parameters if the truth is given: Fig. 4 of the paper, for one calibration.

The truth is for the page alone: the result was computed before, without it.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from legcal.calibration.evaluation import Evaluation, evaluate
from legcal.calibration.result import Calibration
from legcal.files.quantity import SHOWN_IN
from legcal.machine.model import Machine
from legcal.pages.document import Drawing, Text
from legcal.pages.svg import error_bars


def truth_blocks(calibration: Calibration, truth: Machine, calibrated: Machine) -> list[Any]:
    """Return the errors of the nominal and the calibrated model.

    Raises
    ------
    ModelError
        If the truth is not a model of the same machine.
    DidNotConverge
        If the models reach no readings together.
    """
    before = evaluate(calibration.dataset.machine, truth)
    after = evaluate(calibrated, truth)
    sigma = {row.name: row.sigma for row in calibration.result.parameters}
    blocks: list[Any] = [Text([_at_the_platform(before, after), _ORIGIN])]
    for unit_of_chart in ("m", "rad"):
        # Coordinates that the frame makes zero are not parameters.
        indices = [
            i
            for i, name in enumerate(after.names)
            if after.units[i] == unit_of_chart and name in sigma
        ]
        if not indices:
            continue
        scale, unit = SHOWN_IN[unit_of_chart]
        before_errors, after_errors = (
            (scale * np.abs(evaluation.values - evaluation.references))[indices].tolist()
            for evaluation in (before, after)
        )
        names = [after.names[i] for i in indices]
        scaled = [None if sigma[n] is None else scale * float(sigma[n] or 0.0) for n in names]
        blocks.append(
            Drawing(error_bars(names, before_errors, after_errors, scaled, unit), _CAPTION)
        )
    return blocks


_ORIGIN = "The truth was given for this page alone: the result was computed without it."
_CAPTION = (
    "As Fig. 4 of the paper, of this calibration alone: coordinates are those in R_b and R_e."
)


def _at_the_platform(before: Evaluation, after: Evaluation) -> str:
    """Return the errors of eq (20) as a sentence."""
    if not len(after.displacement):
        return (
            "The motors do not determine the pose of the platform: parameters are compared alone."
        )
    errors = [
        f"{1e3 * evaluation.displacement.mean():.3f} mm and "
        f"{np.degrees(evaluation.rotation.mean()):.4f} deg by the {name} model"
        for name, evaluation in (("nominal", before), ("calibrated", after))
    ]
    return (
        f"At the same readings the platform is off by {errors[0]}, and by {errors[1]} (means over "
        f"{len(after.displacement)} poses of the workspace, eq 20)."
    )
