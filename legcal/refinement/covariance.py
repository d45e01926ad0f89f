"""The covariance of what was found, and the directions that are known worst.

Poses and cameras are eliminated from the Gauss-Newton normal matrix; the inverse of what
remains is the covariance of the named unknowns with everything else unknown.
"""

from dataclasses import dataclass

import numpy as np

from legcal.errors import NotIdentifiable
from legcal.geometry.types import Array
from legcal.refinement.priors import named_jacobian
from legcal.refinement.problem import FitProblem
from legcal.refinement.state import State

_NAMED = 0.3  # components of a direction that are named, relative to the largest


@dataclass(frozen=True, eq=False)
class WeakDirection:
    """A combination of parameters that is known worst.

    Attributes
    ----------
    sigma : float
        Standard deviation along it; angles count at the mean length of the legs [m].
    parts : tuple of (str, float)
        Its largest components: parameter names and coefficients of a unit vector.
    """

    sigma: float
    parts: tuple[tuple[str, float], ...]

    def __str__(self) -> str:
        return " ".join(f"{value:+.2f} {name}" for name, value in self.parts)


def named_covariance(problem: FitProblem, state: State, covariance: Array) -> Array:
    """Return the covariance (n_named, n_named) of the values of the named unknowns.

    Parameters
    ----------
    problem : FitProblem
    state : State
    covariance : (n_kept, n_kept) array
        Of all unknowns but poses, as :func:`legcal.refinement.normal.information` has them.
    """
    n = problem.layout.n_named
    by_x = named_jacobian(state, problem.layout, problem.legs)
    return np.asarray(by_x @ covariance[:n, :n] @ by_x.T)


def worst_directions(
    covariance: Array, names: tuple[str, ...], unit: Array, n_directions: int = 3
) -> tuple[WeakDirection, ...]:
    """Return the directions known worst, worst first.

    Parameters
    ----------
    covariance : (n, n) array
        Of parameters, each in its own unit.
    names : tuple of str
        Their names.
    unit : (n,) array
        A metre of each parameter in its unit.
    n_directions : int
        How many to name.
    """
    scaled = covariance / unit[:, None] / unit
    variance, vector = np.linalg.eigh(scaled)
    return tuple(
        direction(vector[:, -1 - i], names, float(np.sqrt(max(variance[-1 - i], 0.0))))
        for i in range(min(n_directions, len(names)))
    )


def direction(vector: Array, names: tuple[str, ...], sigma: float) -> WeakDirection:
    """Return the largest components of a direction, the largest one positive."""
    vector = vector * np.sign(vector[np.argmax(np.abs(vector))])
    order = np.argsort(-np.abs(vector), kind="stable")
    named = [i for i in order if abs(vector[i]) >= _NAMED * abs(vector[order[0]])][:4]
    return WeakDirection(sigma, tuple((names[i], float(vector[i])) for i in named))


def check_counts(problem: FitProblem, n_images: int) -> None:
    """Refuse a fit with fewer equations than unknowns.

    Raises
    ------
    NotIdentifiable
        With both numbers.
    """
    equations = problem.n_equations + len(problem.priors)
    unknowns = problem.n_unknowns
    if equations < unknowns:
        seen = f"{len(problem.outlines)} outlines"
        if len(problem.axes):
            seen = f"{len(problem.axes)} axes" + f", {seen}" * bool(len(problem.outlines))
        raise NotIdentifiable(
            f"The fit is not determined: {n_images} images with {seen} "
            f"and {len(problem.readings)} readings give {equations} equations for "
            f"{unknowns} unknowns; add images."
        )
