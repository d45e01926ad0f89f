"""What data determine of the kinematic parameters, and how well: as a fit states it, and at best.

A direction that is held at nominal is as wrong as the nominal model: errors along it say nothing of
the fit, and no covariance tells them. They are left out: of all errors those parts are judged that
moving along what is held does not change.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.linalg import null_space

from legcal.geometry.types import Array
from legcal.identify.elimination import compress, eliminate
from legcal.refinement.solution import Solution
from legcal.studies.outline_bound import information_of
from legcal.studies.outline_design import OutlineDesign


@dataclass(frozen=True, eq=False)
class Determined:
    """Independent parts of the errors of the kinematic parameters, and their covariance.

    Attributes
    ----------
    parts : (r, p) array
        What errors [m, rad] are multiplied with.
    covariance : (r, r) array
        Of the products.
    """

    parts: Array
    covariance: Array

    @property
    def rank(self) -> int:
        """How many directions of the parameters are determined."""
        return len(self.parts)

    def nse(self, error: Array) -> float:
        """Return the normalised squared error of errors (p,) [m, rad] for each direction."""
        sigma = np.sqrt(np.diagonal(self.covariance))
        z = (self.parts @ error) / sigma
        correlation = self.covariance / np.outer(sigma, sigma)
        return float(z @ np.linalg.solve(correlation, z)) / self.rank


def as_stated(design: OutlineDesign, solution: Solution) -> Determined:
    """Return what a fit says of the errors of its values; axes as angles from the nominal ones."""
    known = solution.parametrization.names  # twists too, which are fixed
    place, unit = [known.index(name) for name in design.parametrization.names], _unit(design)
    parts = _across(solution.held_basis[:, place] / unit) / unit
    covariance = solution.value_covariance[np.ix_(place, place)]
    return Determined(parts, np.asarray(parts @ covariance @ parts.T))


def at_best(
    design: OutlineDesign, sigma_q: float, radius_sigma: float, n_held: int = 0
) -> Determined:
    """Return the Cramer-Rao bound of a machine of which some directions are held.

    Parameters
    ----------
    design : OutlineDesign
        The machine, and what is measured of it.
    sigma_q, radius_sigma : float
        As in :func:`legcal.studies.outline_bound.information_of`.
    n_held : int
        How many directions are: those that data and radii say least of.

    Returns
    -------
    Determined
        Of errors that count axes as angles from the true ones.
    """
    n, unit = len(design.parametrization), _unit(design)
    rows = information_of(design, sigma_q, radius_sigma)
    radii_first = np.concatenate([rows[:, n:], rows[:, :n] * unit], axis=1)
    own = compress(eliminate(radii_first[None], rows.shape[1] - n))
    _, _, directions = np.linalg.svd(own)
    parts = _across(directions[n - n_held :])
    seen = np.linalg.qr(own @ parts.T, mode="r")
    root = np.linalg.inv(seen)
    return Determined(parts / unit, np.asarray(root @ root.T))


def _across(directions: Array) -> Array:
    """Return a basis (n - w, n) of what is perpendicular to directions (w, n)."""
    n = directions.shape[1]
    return np.asarray(null_space(directions).T) if len(directions) else np.eye(n)


def _unit(design: OutlineDesign) -> Array:
    """Return a metre of each parameter in its own unit: angles count at the mean leg length."""
    ends = np.einsum("kij,lj->kli", design.R, [leg.B for leg in design.legs]) + design.t[:, None]
    length = float(np.linalg.norm(ends - [leg.A for leg in design.legs], axis=-1).mean())
    is_length = np.array([u == "m" for u in design.parametrization.units], dtype=np.bool_)
    return np.where(is_length, 1.0, 1.0 / length)
