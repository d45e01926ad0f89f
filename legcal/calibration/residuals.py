"""Residuals of each outline, in the order of the files."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from legcal.brief import brief
from legcal.calibration.joint_fit.held_out import Posterior
from legcal.data.dataset import Dataset
from legcal.data.image_tables import canonical_order
from legcal.data.outlines import Outlines
from legcal.geometry.types import Array, IntArray


@brief
@dataclass(frozen=True, eq=False)
class OutlineResiduals:
    """Residuals of the outlines in the fit, including those it rejected."""

    index: IntArray  # (n,): rows of the table of outlines
    # (n, 2): distance of each end from the predicted outline, common-mode edge biases removed [px]
    offset: Array
    whitened: Array  # (n, 2): the same, uncorrelated and in standard deviations

    def __len__(self) -> int:
        return len(self.index)


def outline_residuals(
    posterior: Posterior, dataset: Dataset, outlines: Outlines
) -> OutlineResiduals:
    """Return the residuals of a fit to *outlines* of a *dataset*, in file order."""
    problem = posterior.problem
    offset = problem.offsets(posterior.state)
    covariance = posterior.noise.covariance(problem.outlines.covariance)
    L = np.linalg.cholesky(covariance) if len(offset) else covariance
    whitened = np.linalg.solve(L, offset[..., None])[..., 0]
    # The fit numbers outlines as they stand in canonical order.
    order = canonical_order(dataset.measurements, dataset.machine.leg_names)
    numbered = replace(outlines, contrast=np.arange(len(outlines), dtype=np.float64))
    number = order.reorder(numbered).contrast.astype(np.intp)
    index = number[problem.outlines.index]
    back = np.argsort(index, kind="stable")
    return OutlineResiduals(index[back], offset[back], whitened[back])
