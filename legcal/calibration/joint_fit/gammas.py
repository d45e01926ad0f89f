"""With which gamma to read the photographs of a camera that nobody told: the next one to try.

Outlines that were measured with a wrong gamma lie off, and a fit sees by how much, but less than
all of it: how far each of them moves is known roughly, and shifts that they share take some. It
sees nothing where the gamma is right all the same, and that is found by secants. Where outlines
tell little, it may see nothing where the gamma is wrong as well: what is found is stated so.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from legcal.calibration.joint_fit.edge_biases import GAMMA_SUFFIX
from legcal.calibration.joint_fit.problem import FitProblem
from legcal.calibration.joint_fit.state import State
from legcal.data import Outlines, few_views
from legcal.geometry import Array

SEEN_SHARE = 0.5  # of how far a gamma is off that a fit sees, about
# What limbs do to outlines that looks like another gamma, as in rendered photographs of machines
# with a known one: standard deviation of its logarithm.
FEIGNED = 0.17
_VAGUE = 0.25  # the same from where on outlines hardly tell a gamma


@dataclass(frozen=True)
class EstimatedGamma:
    """The gamma of a camera."""

    views: tuple[str, ...]  # of the camera
    gamma: float
    fitted_sigma: float  # standard deviation of its logarithm, by the fit
    measured_with: float  # the gamma with which the outlines were measured

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
    """Return the gammas that a fit has found; *covariance* is that of all unknowns but poses."""
    o = problem.outlines
    found = []
    for k, position in enumerate(problem.where("biases").tolist()):
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


ROUNDS = 2  # of measuring outlines with another gamma, at most
SETTLED = 0.12  # what a fit sees, in the logarithm: no more than limbs feign
SIGNIFICANT = 2.0  # standard deviations of the fit: less may be chance
SEEN_SHARES = (0.25, 1.2)  # what is believed when they have
LARGEST_STEP = 0.7  # of the logarithm
RANGE = (1.0, 3.0)  # of gammas that are tried: photographs are linear, or encoded for screens


def next_gammas(found: Sequence[Sequence[EstimatedGamma]]) -> dict[str, float]:
    """Return the gammas to read photographs with, by view; nothing where fits see none but theirs.

    *found* has what successive fits have found, to outlines that were measured anew for each.
    """
    gammas: dict[str, float] = {}
    for one in found[-1]:
        of_camera = [other for fit in found for other in fit if other.views == one.views]
        read = np.log([other.measured_with for other in of_camera])
        seen = np.log([other.gamma for other in of_camera]) - read
        if abs(seen[-1]) > max(SETTLED, SIGNIFICANT * one.fitted_sigma):
            step = np.clip(seen[-1] / _share(read, seen), -LARGEST_STEP, LARGEST_STEP)
            other = float(np.clip(np.exp(read[-1] + step), *RANGE))
            if abs(np.log(other) - read[-1]) > SETTLED:
                gammas |= dict.fromkeys(one.views, other)
    return gammas


def _share(read: Array, seen: Array) -> float:
    """Return which share of a wrong gamma fits see, by the last two of them."""
    if len(read) < 2 or abs(read[-1] - read[-2]) < SETTLED:
        return SEEN_SHARE
    share = -(seen[-1] - seen[-2]) / (read[-1] - read[-2])
    return float(np.clip(share, *SEEN_SHARES))
