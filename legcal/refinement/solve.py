"""Solving the fit: IPOPT to its tolerance, then Gauss-Newton steps down to rounding."""

import casadi as ca
import numpy as np

from legcal.errors import DidNotConverge
from legcal.geometry.types import Array
from legcal.refinement.inputs import inputs_of, parameter_of
from legcal.refinement.normal import linearize, normal_equations
from legcal.refinement.problem import FitProblem
from legcal.refinement.state import State

_STEP = 1e-11  # [mm, mrad]; steps end at rounding, two orders below
_MAX_STEPS = 30
_LARGEST_FIRST_STEP = 1.0  # [mm, mrad]; more means that IPOPT was not there


def solve(problem: FitProblem, state: State, whitening: Array, k: float) -> tuple[State, int]:
    """Minimise the robust cost from a state.

    Parameters
    ----------
    problem : FitProblem
    state : State
        Where to start.
    whitening : (n_outlines, 2, 2) array
        Weights of the outlines, as in :func:`legcal.refinement.inputs.inputs_of`.
    k : float
        Narrowness of the robust loss.

    Returns
    -------
    state : State
        The minimum.
    iterations : int
        What IPOPT needed.

    Raises
    ------
    DidNotConverge
        If IPOPT stops without success.
    """
    parameter = parameter_of(inputs_of(problem, state, whitening, k))
    solver = problem.solver
    found = solver(x0=ca.DM.zeros(problem.layout.size), p=parameter)
    stats = solver.stats()
    if not stats["success"]:
        wanted = "outlines of the right edges"
        if len(problem.axes):
            wanted = "axes of the right legs, in rad and m"
        raise DidNotConverge(
            "The fit of everything did not converge: IPOPT stopped with "
            f"{stats['return_status']} after {stats['iter_count']} iterations; it needs starting "
            f"values nearer to the truth (joints to 5 mm, cameras to 2 cm and 2 deg) and {wanted}; "
            "check the camera poses and the readings."
        )
    x = np.asarray(found["x"]).ravel()
    return state.moved(x, problem.layout), int(stats["iter_count"])


def polish(problem: FitProblem, state: State, whitening: Array, k: float) -> State:
    """Follow Newton-like steps from IPOPT's answer to a fixed point at the level of rounding.

    Raises
    ------
    DidNotConverge
        If the steps do not shrink to rounding.
    """
    size = np.inf
    for _ in range(_MAX_STEPS):
        step = normal_equations(problem, linearize(problem, state, whitening), k).step()
        previous, size = size, float(np.abs(step).max())
        if not size < _LARGEST_FIRST_STEP:
            break
        state = state.moved(step, problem.layout)
        if size < _STEP or (size < 1e3 * _STEP and size > 0.5 * previous):
            return state
    raise DidNotConverge(
        "The fit of everything did not settle: the last step still moves an unknown by "
        f"{size:.2g} mm or mrad; the data hardly determine it; add images from other "
        "directions or poses that differ more."
    )
