"""Which gamma of a camera makes its outlines most likely, where nobody gives it.

Outlines are measured with a few gammas and fitted anew for each. Where a gamma is wrong, outlines
lie off by different amounts, and what the fit leaves of them is larger. What is compared is the
restricted likelihood of the fits, with noise and common-mode biases as each of them finds, of
the same outlines: those that all of these fits use. A gamma at which outlines get lost could not be
compared otherwise, since it seems right for those that are left.

Linear photographs have a gamma of 1, those encoded for screens one near 2.2: trials begin at 1 and
go on in steps of :data:`GAMMA_STEP` until the likelihood falls. A parabola through the best three
gives the gamma. Where the likelihood is flat, the first one stays.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from legcal.calibration.joint_fit.outline_errors import GAMMA_SIGMA
from legcal.calibration.joint_fit.rounds import with_edge_biases
from legcal.calibration.joint_fit.solution import Solution
from legcal.data.measurements import few_views
from legcal.data.outlines import Outlines
from legcal.estimation.solver import minimise
from legcal.estimation.uncertainty import restricted_log_likelihood
from legcal.geometry.types import Array

GAMMA_RANGE = (1.0, 3.0)  # of gammas that are tried: linear, or encoded for screens
GAMMA_STEP = 0.4  # of the logarithm
GAMMA_TOLERANCE = 0.12  # of the logarithm: smaller than LIMB_SIGMA
MAX_GAMMA_TRIALS = 4  # after the first one
SIGNIFICANCE = 2.0  # standard deviations: less may be chance

Views = tuple[str, ...]  # those of one camera


@dataclass(frozen=True, eq=False)
class GammaTrials:
    """Fits to outlines that were measured with several gammas, the first one first.

    Attributes
    ----------
    cameras : tuple of tuple of str
        The views of each camera whose gamma is searched for.
    solutions : tuple of Solution or None
        What was fitted in each trial; None where nothing fits.
    log_gamma : (n_trials, n_cameras) array
        Logarithms of the gammas.
    """

    cameras: tuple[Views, ...]
    solutions: tuple[Solution | None, ...]
    log_gamma: Array

    @classmethod
    def begun(cls, first: Solution, given: Mapping[str, float]) -> GammaTrials:
        """Return the first trial; gammas of some views are given by outlines that are kept."""
        found = [one for one in first.gammas if not any(view in given for view in one.views)]
        logs = np.log([one.measured_with for one in found])
        return cls(tuple(one.views for one in found), (first,), logs[None])

    def tried(self, gammas: Mapping[str, float], solution: Solution | None) -> GammaTrials:
        """Return the trials with one more, of gammas by view."""
        row = np.log([[gammas[views[0]] for views in self.cameras]])
        return replace(
            self,
            solutions=(*self.solutions, solution),
            log_gamma=np.concatenate([self.log_gamma, row]),
        )

    @property
    def best(self) -> int:
        """The number of the most likely trial."""
        return int(np.argmax(self.likelihoods.sum(axis=1)))

    @cached_property
    def likelihoods(self) -> Array:
        """Logarithms of the likelihood of outlines of each camera, (n_trials, n_cameras).

        With what is known of gammas beforehand; minus infinity where nothing fits.
        """
        known = [solution for solution in self.solutions if solution is not None]
        found = np.full(self.log_gamma.shape, -np.inf)
        has = np.array([solution is not None for solution in self.solutions])
        found[has] = log_likelihoods(known, self.cameras)
        return np.asarray(found - 0.5 * (self.log_gamma / GAMMA_SIGMA) ** 2)

    def next(self) -> dict[str, float]:
        """Return the gammas to try next, by view; nothing where no other one has to be tried."""
        if not self.cameras or len(self.solutions) > MAX_GAMMA_TRIALS:
            return {}
        merits = self.likelihoods.T
        every = list(zip(self.log_gamma.T, merits, strict=True))
        ahead = [next_trial(*one) for one in every]
        if all(one is None for one in ahead):
            return {}
        at_best = [float(tried[np.argmax(merit)]) for tried, merit in every]
        return self._by_view([b if a is None else a for a, b in zip(ahead, at_best, strict=True)])

    def found(self) -> dict[str, float]:
        """Return the most likely gammas by view; nothing where the first ones are near these."""
        peaks = [
            most_likely(tried, merit)
            for tried, merit in zip(self.log_gamma.T, self.likelihoods.T, strict=True)
        ]
        moved = np.abs(np.array(peaks) - self.log_gamma[0]) > GAMMA_TOLERANCE
        return self._by_view(peaks) if np.any(moved) else {}

    def notes(self, refused: Mapping[str, float]) -> tuple[str, ...]:
        """Return notes on cameras whose gamma stays open; some gammas may have been *refused*."""
        notes = []
        for views, tried, merit in zip(
            self.cameras, self.log_gamma.T, self.likelihoods.T, strict=True
        ):
            if views[0] in refused:
                why = f"fewer of its outlines can be used with {refused[views[0]]:.2f}"
            elif np.isfinite(merit).sum() == 1 < len(merit):
                why = "no other one could be fitted"
            elif (rival := _rival(tried, merit)) is not None:
                why = f"its outlines are about as likely with {np.exp(rival):.2f}"
            else:
                continue
            notes.append(
                f"The gamma of the camera of {few_views(views)} stays undecided: {why}, as where "
                "a camera has processed its photographs; write gamma of the views in dataset.yaml "
                "if you know it, or switch the processing off."
            )
        return tuple(notes)

    def _by_view(self, log_gammas: Sequence[float]) -> dict[str, float]:
        return {
            view: float(np.exp(log_gamma))
            for views, log_gamma in zip(self.cameras, log_gammas, strict=True)
            for view in views
        }


def next_trial(log_gamma: Array, merit: Array) -> float | None:
    """Return the logarithm of the gamma to try next, beside the most likely one, if any."""
    best = float(log_gamma[np.argmax(merit)])
    least, most = np.log(GAMMA_RANGE).tolist()
    beyond = [float(np.clip(best + side * GAMMA_STEP, least, most)) for side in (1.0, -1.0)]
    for there, side in zip(beyond, (1.0, -1.0), strict=True):
        is_new = abs(there - best) > GAMMA_TOLERANCE
        if is_new and not np.any(side * (log_gamma - best) > GAMMA_TOLERANCE):
            return there
    return None


def most_likely(log_gamma: Array, merit: Array) -> float:
    """Return the most likely logarithm of a gamma, by a parabola through the best three trials.

    That of the first trial where no other one is clearly better.
    """
    x, y, i = _in_order(log_gamma, merit)
    if y[i] - merit[0] <= 0.5 * SIGNIFICANCE**2:
        return float(log_gamma[0])
    if not 0 < i < len(x) - 1 or not np.all(np.isfinite(y[i - 1 : i + 2])):
        return float(x[i])
    left, right = (y[i] - y[i - 1]) / (x[i] - x[i - 1]), (y[i + 1] - y[i]) / (x[i + 1] - x[i])
    at = 0.5 * (x[i - 1] + x[i]), 0.5 * (x[i] + x[i + 1])
    return float(at[0] + (at[1] - at[0]) * left / (left - right)) if left > right else float(x[i])


def _rival(log_gamma: Array, merit: Array) -> float | None:
    """Return the logarithm of another gamma that is nearly as likely as the best one, if any."""
    x, y, i = _in_order(log_gamma, merit)
    near = [k for k in range(len(x)) if k != i and y[i] - y[k] <= 0.5 * SIGNIFICANCE**2]
    return float(x[near[0]]) if near else None


def _in_order(log_gamma: Array, merit: Array) -> tuple[Array, Array, int]:
    """Return trials of different gammas, rising, the most likely of each, and which is the best."""
    order = sorted(range(len(merit)), key=lambda k: (log_gamma[k], -merit[k]))
    place = [k for n, k in enumerate(order) if n == 0 or log_gamma[k] > log_gamma[order[n - 1]]]
    return log_gamma[place], merit[place], int(np.argmax(merit[place]))


def log_likelihoods(solutions: Sequence[Solution], cameras: Sequence[Views]) -> Array:
    """Return logarithms of the restricted likelihood (n_solutions, n_cameras) of the same outlines.

    Of all that are used in all solutions, with noise and biases as they are most likely for each.
    Every camera has its outlines, and of what they have in common its part.
    """
    same = set.intersection(*(solution.outlines.used_keys() for solution in solutions))
    found = np.zeros((len(solutions), len(cameras)))
    for i, solution in enumerate(solutions):
        fit, of = solution.posterior, solution.outlines.row_keys()
        o = fit.problem.outlines
        kept = np.array([of[k] in same for k in o.index.tolist()], dtype=np.bool_)
        problem, state = with_edge_biases(fit.problem, fit.state, fit.edge_biases.likeliest)
        problem = problem.weighted(fit.noise, kept)
        minimum = minimise(problem, state, is_near=True)
        norms = minimum.linear["outlines"].squared_norms
        widths = np.linalg.slogdet(fit.noise.covariance(o.covariance))[1]
        own = -0.5 * (norms + widths) * kept
        common = restricted_log_likelihood(problem, minimum) + 0.5 * float(norms.sum())
        for c, views in enumerate(cameras):
            shown = np.array([name in views for name in o.views], dtype=np.bool_)[o.view]
            part = float(np.sum(shown & kept)) / max(float(np.sum(kept)), 1.0)
            found[i, c] = own[shown].sum() + part * common
    return found


def loses_outlines(before: Outlines, after: Outlines) -> bool:
    """Say whether fewer outlines are used than before, by more than chance (McNemar's test)."""
    used, still = before.used_keys(), after.used_keys()
    lost, gained = len(used - still), len(still - used)
    return bool(lost - gained > SIGNIFICANCE * np.sqrt(lost + gained))
