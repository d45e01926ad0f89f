"""Measured axes of legs, as arrays that the residual of an axis takes."""

from dataclasses import dataclass

import numpy as np

from legcal.errors import DatasetError
from legcal.geometry.types import Array, IntArray
from legcal.observations.leg_axes import LegAxes
from legcal.observations.measurements import Measurements
from legcal.refinement.legs import FittedLegs


@dataclass(frozen=True, eq=False)
class ObservedAxes:
    """The axes that enter the fit, n of them.

    Attributes
    ----------
    leg, view, pose : (n,) array of int
        Indices.
    M : (n, 3) array
        A point of each axis in the camera frame [m].
    basis : (n, 2, 3) array
        Unit vectors e1, e2 normal to the axis; its direction is e1 x e2.
    whitening : (n, 4, 4) array
        Lower triangular T with T C T^T = 1, C being the claimed covariance of (alpha1, alpha2,
        beta1, beta2) [1/rad, 1/m].
    """

    leg: IntArray
    view: IntArray
    pose: IntArray
    M: Array
    basis: Array
    whitening: Array

    def __len__(self) -> int:
        return len(self.leg)


def observed_axes(
    axes: LegAxes | None, measurements: Measurements, legs: FittedLegs
) -> ObservedAxes:
    """Return axes in the form that the residual takes.

    Raises
    ------
    DatasetError
        If an axis has a covariance that is not positive definite.
    """
    if axes is None or len(axes) == 0:
        none = np.zeros(0, dtype=np.intp)
        return ObservedAxes(
            none, none, none, np.zeros((0, 3)), np.zeros((0, 2, 3)), np.zeros((0, 4, 4))
        )
    scale = np.sqrt(np.abs(np.einsum("nii->ni", axes.covariance)))
    scale = np.where(scale > 0.0, scale, 1.0)  # rad and m side by side
    correlation = axes.covariance / (scale[:, :, None] * scale[:, None, :])
    least = np.linalg.eigvalsh(correlation)[:, 0]
    problems = [
        f"The axis of {legs.names[axes.leg[i]]} in "
        f"{measurements.image[axes.row[i]] or f'row {axes.row[i] + 1}'} could not be used: its "
        "covariance is not positive definite, needed four positive variances; correct its "
        "standard deviations."
        for i in np.flatnonzero(~(least > 0.0))
    ]
    if problems:
        raise DatasetError(problems)
    whitening = np.linalg.inv(np.linalg.cholesky(correlation)) / scale[:, None, :]
    return ObservedAxes(
        axes.leg,
        measurements.view[axes.row],
        measurements.pose[axes.row],
        axes.M,
        axes.basis,
        whitening,
    )
