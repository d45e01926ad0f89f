"""Directions of the unknowns of a step that its equation hardly determines.

Nominal models are known to some per cent. What an equation says less of than that stays where the
nominal model has it, and is named: z of coplanar joints in (9) and (16), or what the axes on base
and platform of a 3-UPU have in common, which only translates.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from legcal.geometry.types import Array, IntArray
from legcal.machine.directions import SHOWN, describe_direction
from legcal.paper.equations import nominal_value
from legcal.paper.least_squares import LeastSquares, Term
from legcal.paper.nominal import NominalMachine
from legcal.paper.unknowns import Unknowns

_SIGMA_LENGTH = 0.01  # of joint centres and lengths: mean leg lengths
_SIGMA_AXIS = 0.03  # of axes [rad]
_HELD = 3e-5  # of these: how well a direction is held


def with_prior(problem: LeastSquares, place: IntArray) -> LeastSquares:
    """Return a problem with axes that are known to be near the nominal ones, by their places."""
    rows = np.full((len(place), 1), 1.0 / _SIGMA_AXIS)
    term = Term(nominal_value(1), place[:, None], (rows, np.zeros(len(place))))
    return replace(problem, terms=(*problem.terms, term))


def hold_at_nominal(
    problem: LeastSquares,
    machine: NominalMachine,
    unknowns: Unknowns,
    step: str,  # what it is, with its equation: "Step 2 (9)"
    *,
    weighted: bool,
    wanted: IntArray | None = None,  # which of the unknowns those of the problem are; the first
    nominal: Array | None = None,  # (n,) values; without it the start
) -> tuple[LeastSquares, tuple[str, ...]]:
    """Return a problem that holds what it says less of than the nominal model, and its name."""
    n = len(problem.start)
    wanted = np.arange(n) if wanted is None else wanted
    nominal = problem.start if nominal is None else nominal
    information = problem.derivative_at_start(weighted=weighted)
    lengths = machine.offsets[np.isfinite(machine.offsets)]
    sigma_length = _SIGMA_LENGTH * float(np.mean(np.abs(lengths)))
    sigma = np.where(unknowns.is_angle, _SIGMA_AXIS, sigma_length)[wanted]
    in_it = np.zeros(n, dtype=np.bool_)
    for term in problem.terms:
        in_it[term.index[term.index >= 0]] = True
    part = np.flatnonzero(in_it)
    rows = np.vstack([information[:, part] * sigma[part], np.zeros((len(part), len(part)))])
    _, singular, vectors = np.linalg.svd(rows, full_matrices=False)
    held = np.zeros((np.count_nonzero(singular < 1.0), n))
    held[:, part] = vectors[singular < 1.0]
    if not len(held):
        return problem, ()
    shown = np.flatnonzero(np.any(np.abs(held) > SHOWN, axis=0)).tolist()
    words = describe_direction([unknowns.names[wanted[i]] for i in shown], machine.leg_names)
    rows = held / (_HELD * sigma)
    index = np.tile(np.arange(n), (len(rows), 1))
    term = Term(nominal_value(n), index, (rows, rows @ nominal))
    problem = replace(problem, terms=(*problem.terms, term))
    return problem, (f"{step} hardly shows {words}: it was left near nominal.",)
