"""What is held at nominal is not known: how far it may be off, for all that depends on it.

Directions are held where they hardly move the platform, by up to a hundredth of their own change.
The nominal model is wrong along them as it is wrong elsewhere, which the fit has found out: the
root mean square of its changes says how much, of lengths and of angles apart.
"""

from __future__ import annotations

import numpy as np

from legcal.geometry.types import Array
from legcal.refinement.determinacy import Held
from legcal.refinement.priors import named_jacobian
from legcal.refinement.problem import FitProblem
from legcal.refinement.state import State

_LEAST = 1e-12  # [m] a spread that counts as none


def held_spread(problem: FitProblem, state: State, held: Held) -> Array:
    """Return the covariance of steps of named kinematic unknowns along what is held.

    Nominal errors e of variance D^2, of which all but what is held (the rows of H) is found, leave
    H^T (H D^-2 H^T)^-1 H.

    Parameters
    ----------
    problem : FitProblem
    state : State
        The fit.
    held : Held
        What is held.

    Returns
    -------
    (n_kinematic, n_kinematic) array
        In the steps of :attr:`legcal.refinement.solution.Solution.kinematic_covariance`.
    """
    layout, legs = problem.layout, problem.legs
    n = layout.n_kinematic
    if len(held.basis) == 0:
        return np.zeros((n, n))
    free = layout.kinematic < layout.size
    unit, H = held.unit[:n], held.basis[:, :n]
    change = (legs.vector(state.legs) - legs.vector(legs.nominal))[free] / unit
    is_length = np.array([name == "m" for name in problem.named_units[:n]], dtype=np.bool_)
    sigma = np.zeros(n)
    for kind in (is_length, ~is_length):
        found = float(np.sum(kind) - np.sum(H[:, kind] ** 2))  # the rest is held: no change
        sigma[kind] = np.sqrt(np.sum(change[kind] ** 2) / max(found, 1.0))
    weighted = H / np.maximum(sigma, _LEAST)
    spread = H.T @ np.linalg.solve(weighted @ weighted.T, H)
    back = np.linalg.inv(named_jacobian(state, layout, legs))[:n, :n] * unit
    return np.asarray(back @ spread @ back.T)
