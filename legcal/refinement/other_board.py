"""A calibration board whose dimensions cannot be those that were given."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from legcal.errors import DidNotConverge, NotIdentifiable
from legcal.refinement.build import with_choices
from legcal.refinement.contradictions import without_prior
from legcal.refinement.known_parameters import BOARD_SCALE
from legcal.refinement.normal import NormalEquations
from legcal.refinement.problem import FitProblem
from legcal.refinement.rounds import first_minimum
from legcal.refinement.settings import RefinementSettings
from legcal.refinement.state import State

_SIGNIFICANT = 5.0  # standard deviations
_KNOWN = 0.05  # of the size: what measurements must tell to be believed against the file


def refuse_other_board(
    problem: FitProblem, state: State, normal: NormalEquations, settings: RefinementSettings
) -> None:
    """Refuse a calibration board of other dimensions than the dataset says.

    Encoders and radii carry the scale too; a board that was taken for larger than it is puts
    cameras further away.

    Parameters
    ----------
    problem : FitProblem
    state : State
        A first minimum.
    normal : NormalEquations
        There: :func:`legcal.refinement.normal.information`.
    settings : RefinementSettings

    Raises
    ------
    DidNotConverge
        If its size contradicts what else was measured, and nobody stated a prior of it.
    """
    if BOARD_SCALE not in problem.named or BOARD_SCALE in problem.choices.priors:
        return
    place = problem.named.index(BOARD_SCALE)
    for i in np.flatnonzero(problem.priors.position == place).tolist():
        mean, sigma = float(problem.priors.mean[i]), float(problem.priors.sigma[i])
        found = without_prior(problem, state, normal, place, mean, sigma)
        if found is None or found.sigma > _KNOWN or found.apart <= _SIGNIFICANT:
            continue
        size = _size(problem, state, settings)
        told = "of another size than" if size is None else f"{size:.4g} times as large as"
        raise DidNotConverge(
            "The calibration board does not fit the readings and the legs: found that it is "
            f"{told} the dataset says ({found.apart:.0f} standard deviations away), needed its "
            f"dimensions to {1e2 * sigma:.2g} %; measure the board and correct its dimensions in "
            f"dataset.yaml, or let the fit find them (--free {BOARD_SCALE})."
        )


def _size(problem: FitProblem, state: State, settings: RefinementSettings) -> float | None:
    """Return the size that a fit finds which is free to, over the given one; None if it fails."""
    choices = replace(problem.choices, free=problem.choices.free | {BOARD_SCALE})
    try:
        found = first_minimum(with_choices(problem, choices, settings), state, settings)
    except (DidNotConverge, NotIdentifiable):
        return None
    return float(found.state.board_scale[0])
