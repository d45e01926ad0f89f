"""A fit that is built, with other images or with shifts that its outlines share."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from legcal.geometry.types import IntArray
from legcal.observations.measurements import Measurements
from legcal.refinement.biases import SharedShifts
from legcal.refinement.couplings import couple
from legcal.refinement.layout import Layout
from legcal.refinement.observed import ObservedOutlines, readings
from legcal.refinement.observed_axes import observed_axes
from legcal.refinement.observed_board import no_board
from legcal.refinement.priors import Priors
from legcal.refinement.problem import FitProblem


def with_measurements(
    problem: FitProblem,
    measurements: Measurements,
    outlines: ObservedOutlines,
    biases: SharedShifts,
) -> FitProblem:
    """Return a problem with the same unknowns but shifts, and other images without axes and board.

    Parameters
    ----------
    problem : FitProblem
    measurements : Measurements
        Of the same views.
    outlines : ObservedOutlines
        Their outlines; the parts of the problem come first in theirs, others have known radii.
    biases : SharedShifts
        The shifts that these outlines share.
    """
    layout = problem.layout.of_poses(measurements.n_poses)
    of_others = np.full(len(outlines.parts) - len(layout.parts), layout.size, dtype=np.intp)
    radius = np.concatenate([layout.radius, of_others])
    other = replace(
        problem,
        layout=replace(layout, radius=radius, parts=outlines.parts),
        outlines=outlines,
        readings=readings(measurements, problem.legs),
        axes=observed_axes(None, measurements, problem.legs),
        board=no_board(),
    )
    return with_biases(other, biases)


def with_biases(problem: FitProblem, biases: SharedShifts) -> FitProblem:
    """Return a problem in which outlines share unknown shifts, in place of those it had.

    Parameters
    ----------
    problem : FitProblem
    biases : SharedShifts
    """
    old = problem.layout
    n_old, n_new = len(old.bias), len(biases.names)
    first = int(old.bias[0]) if n_old else _first_after_radii(old)

    def moved(position: IntArray) -> IntArray:
        later = np.where(position >= first + n_old, position + n_new - n_old, position)
        return np.asarray(later, dtype=np.intp)

    layout = replace(
        old,
        place=moved(old.place),
        kinematic=moved(old.kinematic),
        radius=moved(old.radius),
        bias=first + np.arange(n_new, dtype=np.intp),
        intrinsic=moved(old.intrinsic),
        camera=moved(old.camera),
        board_scale=moved(old.board_scale),
        board=moved(old.board),
        n_kept=old.n_kept + n_new - n_old,
    )
    priors = problem.priors
    known = ~np.isin(priors.position, old.bias)
    outlines = replace(problem.outlines, bias_index=biases.index, bias_shift=biases.shift)
    held = np.zeros((len(problem.held), layout.n_kept))
    kept = np.r_[0:first, first + n_old : old.n_kept]
    held[:, moved(kept)] = problem.held[:, kept]
    return replace(
        problem,
        layout=layout,
        outlines=outlines,
        priors=Priors(
            layout,
            np.concatenate([moved(priors.position[known]), layout.bias]),
            np.concatenate([priors.mean[known], np.zeros(n_new)]),
            np.concatenate([priors.sigma[known], biases.sigmas]),
        ),
        named=_inserted(problem.named, biases.names, first, n_old),
        named_units=_inserted(problem.named_units, biases.units, first, n_old),
        held=held,
        couplings=couple(layout, outlines, problem.readings, problem.axes, problem.board),
    )


def _first_after_radii(layout: Layout) -> int:
    """Return where biases stand if there are none yet."""
    return layout.n_kinematic + int(np.sum(layout.radius < layout.size))


def _inserted(
    names: tuple[str, ...], new: tuple[str, ...], first: int, n_old: int
) -> tuple[str, ...]:
    """Return names with others in place of *n_old* from *first* on."""
    return (*names[:first], *new, *names[first + n_old :])
