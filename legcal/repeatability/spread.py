"""Standard deviations from repeats, pooled over orientations, beside what is claimed.

Repeats of orientation k give a covariance S_k with nu_k = n_k - 1 degrees of freedom, where
detection claims C_k. Pooled, the variance is ``sum nu_k tr S_k / sum nu_k dim``, the claimed one
the same mean of C_k. Were the claims right up to a common factor, the pooled variance would vary
like that of ``(sum nu_k tr C_k)^2 / sum nu_k tr C_k^2`` equal independent values (Welch,
Satterthwaite): that number gives the confidence range of the ratio.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.stats import chi2

from legcal.geometry.types import Array

CONFIDENCE = 0.95


@dataclass(frozen=True, eq=False)
class Sample:
    """What the repeats of one orientation tell about one quantity.

    Attributes
    ----------
    covariance : (d, d) array
        Of the repeats, with n - 1 degrees of freedom.
    claimed : (d, d) array
        The mean covariance that the method claims.
    dof : int
        n - 1.
    """

    covariance: Array
    claimed: Array
    dof: int

    @property
    def sd(self) -> float:
        """Standard deviation, the root mean square over the components."""
        return float(np.sqrt(np.trace(self.covariance) / len(self.covariance)))

    @property
    def ratio(self) -> float:
        """Standard deviation in the claimed one."""
        return float(np.sqrt(np.trace(self.covariance) / np.trace(self.claimed)))


@dataclass(frozen=True)
class Spread:
    """A standard deviation pooled over orientations.

    Attributes
    ----------
    sd, claimed : float
        Standard deviation of the repeats, and the one that the method claims.
    median, largest : float
        The median and the largest standard deviation of one orientation.
    dof : float
        Degrees of freedom of ``sd``.
    samples : int
        How many were pooled: orientations, and each outline in each of them.
    """

    sd: float
    claimed: float
    median: float
    largest: float
    dof: float
    samples: int

    @property
    def ratio(self) -> float:
        """Standard deviation of the repeats in the claimed one."""
        return self.sd / self.claimed

    @property
    def ratio_range(self) -> tuple[float, float]:
        """Both ends of the 95 % confidence range of the ratio."""
        tail = 0.5 * (1.0 - CONFIDENCE)
        least, most = (
            self.ratio * float(np.sqrt(self.dof / chi2.ppf(p, self.dof)))
            for p in (1.0 - tail, tail)
        )
        return least, most


def sample_of(deviations: Array, claimed: Array) -> Sample:
    """Return the sample of repeats.

    Parameters
    ----------
    deviations : (n, d) array
        Values of n repeats, two or more, against any common origin.
    claimed : (n, d, d) array
        Their claimed covariances.
    """
    dof = len(deviations) - 1
    centred = deviations - deviations.mean(axis=0)
    return Sample(np.asarray(centred.T @ centred / dof), np.asarray(claimed.mean(axis=0)), dof)


def pool(samples: Sequence[Sample]) -> Spread | None:
    """Return the pooled standard deviation; None without a sample.

    Parameters
    ----------
    samples : sequence of Sample
        Of the same quantity and dimension.
    """
    if not samples:
        return None
    size = len(samples[0].covariance)
    dof = np.array([s.dof for s in samples], dtype=np.float64)
    found, claimed = (
        np.sqrt(float(dof @ [np.trace(c) for c in covariances]) / (size * dof.sum()))
        for covariances in ([s.covariance for s in samples], [s.claimed for s in samples])
    )
    traces = np.array([np.trace(s.claimed) for s in samples])
    squares = np.array([np.sum(s.claimed**2) for s in samples])  # tr C^2 of a symmetric C
    effective = float(dof @ traces) ** 2 / float(dof @ squares)
    each = [s.sd for s in samples]
    return Spread(
        sd=float(found),
        claimed=float(claimed),
        median=float(np.median(each)),
        largest=max(each),
        dof=effective,
        samples=len(samples),
    )
