"""What the data determine: covariances, weak directions, and the refusal when they do not.

Poses and cameras are eliminated from the Gauss-Newton normal matrix; the inverse of what
remains is the covariance of kinematic parameters and radii with everything else unknown.
"""

from dataclasses import dataclass

import numpy as np

from legcal.errors import NotIdentifiable
from legcal.geometry.types import Array
from legcal.refinement.normal import Linearization, NormalEquations, inverse_on_range
from legcal.refinement.problem import FitProblem
from legcal.refinement.residuals import UNIT

_RANK = 1e-10  # eigenvalues of the scaled normal matrix below this part of the largest
_LARGEST_SIGMA = 0.1  # of the size of the machine
_NAMED = 0.3  # components of a direction that are named, relative to the largest


@dataclass(frozen=True, eq=False)
class WeakDirection:
    """A combination of parameters that is known worst.

    Attributes
    ----------
    sigma : float
        Standard deviation along it [m].
    parts : tuple of (str, float)
        Its largest components: parameter names and coefficients of a unit vector.
    """

    sigma: float
    parts: tuple[tuple[str, float], ...]

    def __str__(self) -> str:
        return " ".join(f"{value:+.2f} {name}" for name, value in self.parts)


@dataclass(frozen=True, eq=False)
class Uncertainty:
    """Covariances of what the fit found.

    Attributes
    ----------
    covariance : (n, n) array
        Of the kinematic parameters and then the radii [m^2].
    weak : tuple of WeakDirection
        The worst-known directions, worst first.
    """

    covariance: Array
    weak: tuple[WeakDirection, ...]


def uncertainty(
    problem: FitProblem,
    normal: NormalEquations,
    names: tuple[str, ...],
    size: float,
    added: Array | None = None,
    n_weak: int = 3,
) -> Uncertainty:
    """Return the covariance of the parameters, or refuse.

    Parameters
    ----------
    problem : FitProblem
    normal : NormalEquations
        From :func:`legcal.refinement.normal.information`.
    names : tuple of str
        Names of the kinematic parameters.
    size : float
        Largest joint coordinate of the machine [m].
    added : (n_kept, n_kept) array, optional
        Covariance to add, of the unknowns other than poses [mm^2, mrad^2].
    n_weak : int
        How many weak directions to name.

    Returns
    -------
    Uncertainty

    Raises
    ------
    NotIdentifiable
        If a direction of the parameters is not determined, or known worse than to a tenth of
        the size of the machine, where a covariance means nothing.
    """
    S = without_cameras(problem, normal)
    labels = (*names, *(f"radius of {part}" for _, part in problem.layout.parts))
    diagonal = np.diagonal(S)
    if not np.all(diagonal > 0.0):
        found = ", ".join(labels[i] for i in np.flatnonzero(~(diagonal > 0.0)))
        raise NotIdentifiable(
            f"The fit is not determined: no measurement depends on {found}; every leg needs "
            "readings or outlines; add images that show it."
        )
    scale = 1.0 / np.sqrt(diagonal)
    value, vector = np.linalg.eigh(scale[:, None] * S * scale)
    _refuse_free_directions(value, scale[:, None] * vector, labels)
    covariance = UNIT**2 * ((scale[:, None] * vector / value) @ (scale[:, None] * vector).T)
    if added is not None:
        covariance += UNIT**2 * added[: len(S), : len(S)]
    n = len(names)
    kinematic = covariance[:n, :n]
    variances, directions = np.linalg.eigh(kinematic)
    limit = _LARGEST_SIGMA * size
    if variances[-1] > limit**2:
        sigma = float(np.sqrt(variances[-1]))
        raise NotIdentifiable(
            f"The fit is hardly determined: {_direction(directions[:, -1], names, sigma)} is known "
            f"to {1e3 * sigma:.3g} mm only, at least {1e3 * limit:.3g} mm is needed for a machine "
            f"of {1e3 * size:.0f} mm; add images from other directions, of other legs or at poses "
            "that differ more."
        )
    weak = tuple(
        _direction(directions[:, -1 - i], names, float(np.sqrt(variances[-1 - i])))
        for i in range(min(n_weak, n))
    )
    return Uncertainty(covariance, weak)


def _refuse_free_directions(value: Array, directions: Array, labels: tuple[str, ...]) -> None:
    """Raise NotIdentifiable if a scaled normal matrix with these eigenvalues is singular."""
    missing = int(np.sum(value < _RANK * value[-1]))
    if missing:
        free = directions[:, 0] / np.linalg.norm(directions[:, 0])
        raise NotIdentifiable(
            f"The fit is not determined: the measurements fix {len(value) - missing} of "
            f"{len(value)} directions of the parameters; free is {_direction(free, labels, 0.0)}; "
            "add images from other directions, of other legs or at poses that differ more."
        )


def without_cameras(problem: FitProblem, normal: NormalEquations) -> Array:
    """Return the normal matrix of kinematic parameters and radii [1/mm^2], all else unknown."""
    S = normal.reduced()
    n = len(problem.layout.kinematic) + len(problem.layout.radius)
    S = S[:n, :n] - S[:n, n:] @ inverse_on_range(S[n:, n:]) @ S[n:, :n] if n < len(S) else S
    return np.asarray(0.5 * (S + S.T))


def reduced_jacobian(problem: FitProblem, linear: Linearization, normal: NormalEquations) -> Array:
    """Return the whitened offsets (n, 2, n_kept) by the kept unknowns, poses following them."""
    n_kept = problem.layout.n_kept
    J, pose = linear.outline_J, problem.outlines.pose
    at = np.minimum(problem.outline_index[:, :13], n_kept)
    G = np.zeros((len(J), 2, n_kept + 1))
    outline, row = np.arange(len(J))[:, None, None], np.arange(2)[None, :, None]
    np.add.at(G, (outline, row, at[:, None, :]), J[..., :13])
    follow = normal.V_inverse[pose] @ np.swapaxes(normal.W[pose], -1, -2)
    return np.asarray(G[..., :n_kept] - J[..., 13:] @ follow)


def explained_share(problem: FitProblem, linear: Linearization, normal: NormalEquations) -> Array:
    """Return the covariance (n, 2, 2) of the predicted whitened offsets of every outline.

    The residuals of a right fit have covariance one minus this.
    """
    G = reduced_jacobian(problem, linear, normal)
    J_pose = linear.outline_J[..., 13:]
    share = (G @ inverse_on_range(normal.reduced())) @ np.swapaxes(G, -1, -2)
    through_pose = J_pose @ normal.V_inverse[problem.outlines.pose]
    return np.asarray(share + through_pose @ np.swapaxes(J_pose, -1, -2))


def check_counts(problem: FitProblem, n_images: int) -> None:
    """Refuse a fit with fewer equations than unknowns.

    Raises
    ------
    NotIdentifiable
        With both numbers.
    """
    equations = problem.n_equations + len(problem.radius_prior.mean)
    if equations < problem.layout.size:
        seen = f"{len(problem.outlines)} outlines"
        if len(problem.axes):
            seen = f"{len(problem.axes)} axes" + f", {seen}" * bool(len(problem.outlines))
        raise NotIdentifiable(
            f"The fit is not determined: {n_images} images with {seen} "
            f"and {len(problem.readings)} readings give {equations} equations for "
            f"{problem.layout.size} unknowns; add images."
        )


def _direction(vector: Array, names: tuple[str, ...], sigma: float) -> WeakDirection:
    """Return the largest components of a direction, the largest one positive."""
    vector = vector * np.sign(vector[np.argmax(np.abs(vector))])
    order = np.argsort(-np.abs(vector), kind="stable")
    named = [i for i in order if abs(vector[i]) >= _NAMED * abs(vector[order[0]])][:4]
    return WeakDirection(sigma, tuple((names[i], float(vector[i])) for i in named))
