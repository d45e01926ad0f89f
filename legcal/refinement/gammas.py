"""The gamma of cameras that nobody told, by how outlines lie that move with it.

A camera with a gamma encodes light, and outlines that are measured with another one lie off, those
of bright legs before dark backgrounds to one side and the others to the other side. So each such
camera has one unknown: the logarithm of its gamma over that with which outlines were measured.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from legcal.geometry.types import Array
from legcal.observations.outlines import Outlines
from legcal.observations.view_names import few_views
from legcal.refinement.biases import GAMMA_SUFFIX
from legcal.refinement.problem import FitProblem
from legcal.refinement.state import State

SEEN_SHARE = 0.5  # of how far a gamma is off that a fit sees, about
# What limbs do to outlines that looks like another gamma, as in rendered photographs of machines
# with a known one: standard deviation of its logarithm.
FEIGNED = 0.17
_VAGUE = 0.25  # the same from where on outlines hardly tell a gamma


@dataclass(frozen=True)
class EstimatedGamma:
    """The gamma of a camera.

    Attributes
    ----------
    views : tuple of str
        The views of the camera.
    gamma : float
    fitted_sigma : float
        Standard deviation of its logarithm, by the fit.
    measured_with : float
        The gamma with which the outlines were measured.
    """

    views: tuple[str, ...]
    gamma: float
    fitted_sigma: float
    measured_with: float

    @property
    def sigma(self) -> float:
        """Standard deviation of its logarithm: fits see a share of it, and limbs feign some."""
        unseen = (1.0 / SEEN_SHARE - 1.0) * np.log(self.gamma / self.measured_with)
        return float(np.sqrt((self.fitted_sigma / SEEN_SHARE) ** 2 + unseen**2 + FEIGNED**2))

    def __str__(self) -> str:
        hardly = ", and its outlines hardly tell it" * (self.sigma > _VAGUE)
        return (
            f"The gamma of the camera of {few_views(self.views)} is not told{hardly}: found "
            f"{self.gamma:.2f} +- {self.gamma * self.sigma:.2f} by outlines measured with "
            f"{self.measured_with:.2f}, "
            "which the uncertainty of the result takes into account; write gamma of the views in "
            "dataset.yaml if you know it."
        )


def estimated_gammas(
    problem: FitProblem, state: State, covariance: Array, outlines: Outlines
) -> tuple[EstimatedGamma, ...]:
    """Return the gammas that a fit has found.

    Parameters
    ----------
    problem : FitProblem
    state : State
        Where the fit ended.
    covariance : (n_kept, n_kept) array
        Of all unknowns but poses.
    outlines : Outlines
        The table that the fit was built with.
    """
    o = problem.outlines
    found = []
    for k, position in enumerate(problem.layout.bias.tolist()):
        camera = problem.named[position].removesuffix(GAMMA_SUFFIX)
        if camera == problem.named[position]:
            continue
        of_camera = np.array([name == camera for name in o.cameras], dtype=np.bool_)
        moved = of_camera[o.view] & (o.by_gamma != 0.0)
        measured_with = float(outlines.gamma[o.index[moved]][0])
        views = tuple(name for name, own in zip(o.views, of_camera, strict=True) if own)
        gamma = measured_with * float(np.exp(state.biases[k]))
        sigma = float(np.sqrt(covariance[position, position]))
        found.append(EstimatedGamma(views, gamma, sigma, measured_with))
    return tuple(found)
