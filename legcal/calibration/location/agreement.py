"""Rows that disagree with the others, found from the inside out (forward search).

The search starts at the rows that agree best and takes in one after the other, the next best
first, as long as it lies where those inside predict it, at the scatter that they show. What stays
outside is named. One wrong row never decides about another.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy import stats

from legcal.calibration.location.fit import Fit, fit
from legcal.calibration.location.frames import Frames, Noise, PosePairs, jacobian, residuals
from legcal.calibration.location.search import kept_rows
from legcal.geometry import Array, BoolArray, IntArray

FALSE_ALARM = 1e-3  # probability that a row of a good file is left out
_LIKELY = 0.05  # rows at least as likely come in together
_OPEN = 1e-15  # of the largest information: directions that those inside do not know
_ENOUGH = 1.0  # degrees of freedom for a scatter


@dataclass(frozen=True, eq=False)
class Agreement:
    """Which rows agree, and how far off the others are."""

    agrees: BoolArray  # (n,): the rows to use
    # distance, angle: (n,): how far each row is from where the agreeing ones predict it [m, rad]
    distance: Array
    angle: Array
    frames: Frames  # the frames by the agreeing rows
    factor: Array  # (2,): the scatter of the agreeing rows, as a factor of :class:`Noise`


def find_agreement(
    pairs: PosePairs,
    start: Frames,  # what most rows agree with
    noise: Noise,  # standard deviations; a row is never left out for what the stated ones allow
    fewest: int,  # rows that determine the frames
) -> Agreement:
    """Return which rows agree with each other."""
    n = len(pairs)
    units = np.repeat([1.0 / pairs.length, 1.0], 3)
    apart = (residuals(start, pairs) * units) ** 2
    inside = np.zeros(n, dtype=np.bool_)
    inside[np.argsort(apart.sum(axis=1), kind="stable")[: kept_rows(n, fewest)]] = True
    frames = start
    while True:
        found = _fit_to(pairs.of(inside), frames, noise.of(inside))
        frames = found.frames
        outside: IntArray = np.flatnonzero(~inside)
        if not len(outside):
            break
        likely = _probability(pairs.of(outside), noise.of(outside), found, noise.stated)
        best = int(np.argmax(likely))
        if likely[best] < FALSE_ALARM / n:
            break
        inside[outside[likely > _LIKELY]] = True
        inside[outside[best]] = True
    r = residuals(frames, pairs)
    return Agreement(
        inside,
        np.linalg.norm(r[:, :3], axis=1),
        np.linalg.norm(r[:, 3:], axis=1),
        frames,
        found.noise.factor,
    )


def _fit_to(pairs: PosePairs, start: Frames, noise: Noise) -> Fit:
    """Return the fit of some rows at the scatter that they show, at least at the stated one."""
    found = fit(pairs, start, replace(noise, stated=(False, False), readings=None))
    least = np.where(noise.stated, noise.factor, 0.0)
    return replace(found, noise=found.noise.scaled(np.maximum(found.noise.factor, least)))


def _probability(pairs: PosePairs, noise: Noise, found: Fit, stated: tuple[bool, bool]) -> Array:
    """Return how probable rows as far off as these are, given those of a fit, (n,)."""
    sigma = noise.scaled(found.noise.factor).standard_deviations()
    H = found.information
    H = H + _OPEN * float(np.linalg.norm(H, 2)) * np.eye(len(H))
    J = jacobian(found.frames, pairs) * pairs.scale
    covariance = J @ np.linalg.solve(H, np.swapaxes(J, 1, 2))
    covariance[:, range(6), range(6)] += sigma**2
    r = residuals(found.frames, pairs)
    least = np.ones(len(pairs))
    for kind, rows in enumerate((slice(0, 3), slice(3, 6))):
        dof = float(found.kind_dof[kind])
        at_stated = stated[kind] and bool(found.noise.factor[kind] <= noise.factor[kind])
        if dof < _ENOUGH and not at_stated:
            continue
        part = np.linalg.solve(covariance[:, rows, rows], r[:, rows, None])[:, :, 0]
        distance = (part * r[:, rows]).sum(axis=1)
        # Not F with infinite degrees of freedom: SciPy has no number for that.
        here = stats.chi2.sf(distance, 3) if at_stated else stats.f.sf(distance / 3.0, 3, dof)
        least = np.minimum(least, np.where(pairs.oriented | (kind == 0), here, 1.0))
    return np.minimum(1.0, 2.0 * least)
