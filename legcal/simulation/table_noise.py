"""Axes of legs with the noise of Table 1: what Section 4.3 gives the calibration to work on."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from legcal.geometry.types import Array, IntArray
from legcal.observations.leg_axes import LegAxes
from legcal.observations.table_axes import axes_of_table
from legcal.vision.cylinder import point_with_zero_y
from legcal.vision.euler import angles_of_direction


@dataclass(frozen=True)
class TableNoise:
    """The noise of Table 1, on the Euler angles of an axis and on its point M_LS = (x, 0, z).

    The paper prints 0.05 and 0.06 "rad"; its results fit degrees only, so the default reads
    them as degrees. :meth:`in_radians` is the table to the letter.

    Attributes
    ----------
    psi, theta : float
        Standard deviations of the angles (:mod:`legcal.vision.euler`) [rad].
    x, z : float
        Standard deviations of the coordinates of M_LS [m].
    """

    psi: float = float(np.deg2rad(0.05))
    theta: float = float(np.deg2rad(0.06))
    x: float = 0.05e-3
    z: float = 0.10e-3

    @classmethod
    def in_radians(cls) -> TableNoise:
        """Return the table with its angles read as radians."""
        return cls(psi=0.05, theta=0.06)

    @property
    def sigmas(self) -> Array:
        """The four standard deviations, (4,) [rad, rad, m, m]."""
        return np.array([self.psi, self.theta, self.x, self.z])


def observe_axes(
    row: IntArray,
    leg: IntArray,
    u: Array,
    A: Array,
    noise: TableNoise,
    rng: np.random.Generator | None,
) -> LegAxes:
    """Return the axes of legs as images show them.

    Parameters
    ----------
    row, leg : (n,) array of int
        Indices of the image and of the leg.
    u, A : (n, 3) array
        True directions, and a point of each axis [m], in the camera frame.
    noise : TableNoise
        What disturbs the axes, and the covariance that they carry.
    rng : numpy.random.Generator or None
        Source of the noise; None leaves the axes exact.

    Returns
    -------
    LegAxes

    Raises
    ------
    NotVisible
        If an axis is parallel to the image x axis, where M_LS does not exist.
    """
    M = point_with_zero_y(u, A)
    values = np.stack([*angles_of_direction(u), M[:, 0], M[:, 2]], axis=-1)
    if rng is not None:
        values += rng.normal(size=values.shape) * noise.sigmas
    return axes_of_table(row, leg, values, np.broadcast_to(noise.sigmas, values.shape))
