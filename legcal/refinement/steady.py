"""What keeps a first fit near its nominal model where the measurements do not say anything.

Steps along directions that are open cost nothing, and without a hold they go on: axes of a 3-UPU
that only translates end half a radian off, where the machine is another one and other directions
seem to be known. No nominal model is that bad, and a first fit may know it: what it leaves open is
held from there on, and all else is fitted again without this knowledge.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from legcal.refinement.determinacy import mean_length, named_units
from legcal.refinement.priors import Priors
from legcal.refinement.problem import FitProblem
from legcal.refinement.state import State

_NOMINAL_SIGMA = 0.1  # of the mean leg length, angles at it


def steadied(problem: FitProblem, state: State) -> FitProblem:
    """Return a problem that knows that no nominal model is wrong by a large part of a leg.

    Parameters
    ----------
    problem : FitProblem
    state : State
        Where its fit begins; it tells the mean leg length.
    """
    layout, legs, n = problem.layout, problem.legs, problem.layout.n_kinematic
    nominal = legs.vector(legs.nominal)[layout.kinematic < layout.size]
    sigma = _NOMINAL_SIGMA * mean_length(state) * named_units(problem, state)[:n]
    priors = Priors(
        layout,
        np.concatenate([problem.priors.position, np.arange(n, dtype=np.intp)]),
        np.concatenate([problem.priors.mean, nominal]),
        np.concatenate([problem.priors.sigma, sigma]),
    )
    return replace(problem, priors=priors)
