"""Maximum-likelihood gamma of a camera whose gamma is not given.

Outlines are measured with a few gammas, and the joint fit is repeated for each. With a wrong gamma,
outlines are displaced by different amounts, and residuals increase. The restricted likelihoods of
the fits are compared, each with its estimated noise and common-mode biases, over the outlines that
all fits use; otherwise a gamma that loses outlines would look right for the remaining ones.

Linear photographs have a gamma of 1, sRGB ones about 2.2: trials begin at 1 and go on in steps of
:data:`GAMMA_STEP` until the likelihood falls. The estimate is the vertex of a parabola through the
best three. Where the likelihood is flat, the first gamma stays.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from legcal.calibration.joint_fit.rounds import with_edge_biases
from legcal.calibration.joint_fit.solution import Solution
from legcal.calibration.tuning import GAMMA_SIGMA
from legcal.data.measurements import few_views
from legcal.data.outlines import Outlines
from legcal.estimation.solver import minimise
from legcal.estimation.uncertainty import restricted_log_likelihood
from legcal.geometry.types import Array

GAMMA_RANGE = (1.0, 3.0)  # of trials: from linear to beyond sRGB
GAMMA_STEP = 0.4  # in ln gamma
GAMMA_TOLERANCE = 0.12  # in ln gamma; smaller than LIMB_GAMMA_SIGMA
MAX_GAMMA_TRIALS = 4  # after the first one
SIGNIFICANCE = 2.0  # standard deviations

Views = tuple[str, ...]  # of one camera


@dataclass(frozen=True, eq=False)
class GammaTrials:
    """Fits to outlines measured with several gammas, in the order of trials.

    Attributes
    ----------
    cameras : tuple of tuple of str
        Views of each camera with an unknown gamma.
    solutions : tuple of Solution or None
        The fit of each trial; None where it failed.
    log_gamma : (n_trials, n_cameras) array
        Logarithms of the gammas.
    """

    cameras: tuple[Views, ...]
    solutions: tuple[Solution | None, ...]
    log_gamma: Array

    @classmethod
    def begun(cls, first: Solution, given: Mapping[str, float]) -> GammaTrials:
        """Start with the first fit; gammas of views in *given* are fixed by earlier outlines."""
        unknown = [
            estimate
            for estimate in first.gammas
            if not any(view in given for view in estimate.views)
        ]
        logs = np.log([estimate.measured_with for estimate in unknown])
        return cls(tuple(estimate.views for estimate in unknown), (first,), logs[None])

    def tried(self, gammas: Mapping[str, float], solution: Solution | None) -> GammaTrials:
        """Append a trial with gammas by view."""
        row = np.log([[gammas[views[0]] for views in self.cameras]])
        return replace(
            self,
            solutions=(*self.solutions, solution),
            log_gamma=np.concatenate([self.log_gamma, row]),
        )

    @property
    def best(self) -> int:
        """Index of the most likely trial."""
        return int(np.argmax(self.likelihoods.sum(axis=1)))

    @cached_property
    def likelihoods(self) -> Array:
        """Log-likelihoods by camera with the prior of gamma, (n_trials, n_cameras).

        Minus infinity where the fit failed.
        """
        fitted = [solution for solution in self.solutions if solution is not None]
        log_likelihood = np.full(self.log_gamma.shape, -np.inf)
        is_fitted = np.array([solution is not None for solution in self.solutions])
        log_likelihood[is_fitted] = log_likelihoods(fitted, self.cameras)
        return np.asarray(log_likelihood - 0.5 * (self.log_gamma / GAMMA_SIGMA) ** 2)

    def next(self) -> dict[str, float]:
        """Return the gammas of the next trial, by view; empty if no trial is needed."""
        if not self.cameras or len(self.solutions) > MAX_GAMMA_TRIALS:
            return {}
        merits = self.likelihoods.T
        trials = list(zip(self.log_gamma.T, merits, strict=True))
        next_logs = [next_trial(*trial) for trial in trials]
        if all(trial is None for trial in next_logs):
            return {}
        best_logs = [float(tried[np.argmax(merit)]) for tried, merit in trials]
        return self._by_view(
            [b if a is None else a for a, b in zip(next_logs, best_logs, strict=True)]
        )

    def found(self) -> dict[str, float]:
        """Return the most likely gammas by view; empty if the first trial is close enough."""
        peaks = [
            most_likely(tried, merit)
            for tried, merit in zip(self.log_gamma.T, self.likelihoods.T, strict=True)
        ]
        moved = np.abs(np.array(peaks) - self.log_gamma[0]) > GAMMA_TOLERANCE
        return self._by_view(peaks) if np.any(moved) else {}

    def notes(self, refused: Mapping[str, float]) -> tuple[str, ...]:
        """Return notes on cameras with an undecided gamma; *refused* gammas lose outlines."""
        notes = []
        for views, tried, merit in zip(
            self.cameras, self.log_gamma.T, self.likelihoods.T, strict=True
        ):
            if views[0] in refused:
                why = f"with {refused[views[0]]:.2f}, fewer of its outlines are usable"
            elif np.isfinite(merit).sum() == 1 < len(merit):
                why = "the fit failed with every other gamma"
            elif (rival := _rival(tried, merit)) is not None:
                why = f"its outlines are about as likely with {np.exp(rival):.2f}"
            else:
                continue
            notes.append(
                f"The gamma of the camera of {few_views(views)} could not be determined: {why}; "
                "in-camera processing is a common cause; state gamma of the views in dataset.yaml, "
                "or switch the processing off."
            )
        return tuple(notes)

    def _by_view(self, log_gammas: Sequence[float]) -> dict[str, float]:
        return {
            view: float(np.exp(log_gamma))
            for views, log_gamma in zip(self.cameras, log_gammas, strict=True)
            for view in views
        }


def next_trial(log_gamma: Array, merit: Array) -> float | None:
    """Return ln gamma of the next trial beside the most likely one, if any."""
    best = float(log_gamma[np.argmax(merit)])
    least, most = np.log(GAMMA_RANGE).tolist()
    neighbours = [float(np.clip(best + side * GAMMA_STEP, least, most)) for side in (1.0, -1.0)]
    for candidate, side in zip(neighbours, (1.0, -1.0), strict=True):
        is_new = abs(candidate - best) > GAMMA_TOLERANCE
        if is_new and not np.any(side * (log_gamma - best) > GAMMA_TOLERANCE):
            return candidate
    return None


def most_likely(log_gamma: Array, merit: Array) -> float:
    """Return the most likely ln gamma, by a parabola through the best three trials.

    The first trial wins unless another one is significantly better.
    """
    x, y, i = _in_order(log_gamma, merit)
    if y[i] - merit[0] <= 0.5 * SIGNIFICANCE**2:
        return float(log_gamma[0])
    if not 0 < i < len(x) - 1 or not np.all(np.isfinite(y[i - 1 : i + 2])):
        return float(x[i])
    left, right = (y[i] - y[i - 1]) / (x[i] - x[i - 1]), (y[i + 1] - y[i]) / (x[i + 1] - x[i])
    midpoints = 0.5 * (x[i - 1] + x[i]), 0.5 * (x[i] + x[i + 1])
    return (
        float(midpoints[0] + (midpoints[1] - midpoints[0]) * left / (left - right))
        if left > right
        else float(x[i])
    )


def _rival(log_gamma: Array, merit: Array) -> float | None:
    """Return ln gamma of another trial nearly as likely as the best one, if any."""
    x, y, i = _in_order(log_gamma, merit)
    near = [k for k in range(len(x)) if k != i and y[i] - y[k] <= 0.5 * SIGNIFICANCE**2]
    return float(x[near[0]]) if near else None


def _in_order(log_gamma: Array, merit: Array) -> tuple[Array, Array, int]:
    """Sort trials by gamma, the most likely one of equal gammas; also return the best index."""
    order = sorted(range(len(merit)), key=lambda k: (log_gamma[k], -merit[k]))
    distinct = [k for n, k in enumerate(order) if n == 0 or log_gamma[k] > log_gamma[order[n - 1]]]
    return log_gamma[distinct], merit[distinct], int(np.argmax(merit[distinct]))


def log_likelihoods(solutions: Sequence[Solution], cameras: Sequence[Views]) -> Array:
    """Return restricted log-likelihoods (n_solutions, n_cameras) of the outlines used in all fits.

    Noise and biases are the most likely ones of each fit. The terms that do not belong to single
    outlines are divided among cameras by their numbers of outlines.
    """
    common_keys = set.intersection(*(solution.outlines.used_keys() for solution in solutions))
    log_likelihood = np.zeros((len(solutions), len(cameras)))
    for i, solution in enumerate(solutions):
        fit, key_of_row = solution.posterior, solution.outlines.row_keys()
        o = fit.problem.outlines
        kept = np.array([key_of_row[k] in common_keys for k in o.index.tolist()], dtype=np.bool_)
        problem, state = with_edge_biases(fit.problem, fit.state, fit.edge_biases.likeliest)
        problem = problem.weighted(fit.noise, kept)
        minimum = minimise(problem, state, is_near=True)
        norms = minimum.linear["outlines"].squared_norms
        log_determinants = np.linalg.slogdet(fit.noise.covariance(o.covariance))[1]
        log_densities = -0.5 * (norms + log_determinants) * kept
        shared = restricted_log_likelihood(problem, minimum) + 0.5 * float(norms.sum())
        for c, views in enumerate(cameras):
            of_camera = np.array([name in views for name in o.views], dtype=np.bool_)[o.view]
            share = float(np.sum(of_camera & kept)) / max(float(np.sum(kept)), 1.0)
            log_likelihood[i, c] = log_densities[of_camera].sum() + share * shared
    return log_likelihood


def loses_outlines(before: Outlines, after: Outlines) -> bool:
    """Whether significantly fewer outlines are used than before (McNemar's test)."""
    used, still = before.used_keys(), after.used_keys()
    lost, gained = len(used - still), len(still - used)
    return bool(lost - gained > SIGNIFICANCE * np.sqrt(lost + gained))
