"""Corners of the calibration board beside a fit: how large their errors are, which are wrong."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from legcal.errors import DidNotConverge
from legcal.geometry.types import Array
from legcal.refinement.couplings import couple
from legcal.refinement.influence import explained_share
from legcal.refinement.linearize import linearize
from legcal.refinement.loss import width_to_k
from legcal.refinement.normal import information
from legcal.refinement.problem import FitProblem
from legcal.refinement.settings import RefinementSettings
from legcal.refinement.state import State

_MEDIAN_OF_2 = 2.0 * np.log(2.0)  # of the squared norm of two unit Gaussians
_LEAST_LEFT = 0.05  # of the equations of corners, beyond what the fit takes up
_SMALLEST_SCALE = 0.1
_NAMED = 4


def with_judged_corners(
    problem: FitProblem, state: State, whitening: Array, settings: RefinementSettings
) -> FitProblem:
    """Return a problem whose corners have the errors that residuals show, without wrong ones.

    Parameters
    ----------
    problem : FitProblem
    state : State
        Near a minimum.
    whitening : (n_outlines, 2, 2) array
        Of the outlines, zero for rejected ones [1/px].
    settings : RefinementSettings

    Raises
    ------
    DidNotConverge
        If most corners disagree with the fit.
    """
    board, of = problem.board, problem.couplings
    linear = linearize(problem, state, whitening)
    normal = information(problem, state, linear, width_to_k(settings.loss_width))
    share = explained_share(of.corners, linear.corners, normal)
    left = 1.0 - 0.5 * np.einsum("nqq->n", share)
    norms = linear.corners.squared_norms
    variance = float(np.median(norms)) / _MEDIAN_OF_2 / max(float(np.mean(left)), _LEAST_LEFT)
    scale = max(float(np.sqrt(variance)), _SMALLEST_SCALE)
    agrees = norms <= (scale * settings.rejection) ** 2
    kept = board.chosen(agrees).with_scale(scale)
    rejected = (
        *problem.rejected_corners,
        *zip(board.view[~agrees].tolist(), board.corner[~agrees].tolist(), strict=True),
    )
    rms = float(np.sqrt(np.mean((linear.corners.r * board.sigma[:, None]) ** 2)))
    if len(rejected) > len(kept) or np.median(norms * board.sigma**2) > settings.largest_rms_px**2:
        raise DidNotConverge(
            f"The fit of everything ended where the corners of the calibration board are "
            f"{rms:.1f} px off (rms), needed {settings.largest_rms_px:g} px for most; check that "
            "the board stood still, its dimensions, and the camera files."
        )
    couplings = couple(problem.layout, problem.outlines, problem.readings, problem.axes, kept)
    return replace(problem, board=kept, rejected_corners=rejected, couplings=couplings)


def corner_notes(problem: FitProblem) -> tuple[str, ...]:
    """Return what is to be said of corners that were left out, one sentence."""
    rejected = problem.rejected_corners
    if not rejected:
        return ()
    views = problem.outlines.views
    named = [f"{corner} in {views[view]}" for view, corner in sorted(rejected)[:_NAMED]]
    more = f" and {len(rejected) - _NAMED} more" if len(rejected) > _NAMED else ""
    n = len(rejected) + len(problem.board)
    return (
        f"Of {n} corners of the calibration board {len(rejected)} disagree with the fit and were "
        f"left out: {', '.join(named)}{more}.",
    )
