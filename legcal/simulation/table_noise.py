"""Axes of legs with the noise of Table 1: what Section 4.3 gives the calibration to work on."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from legcal.errors import NotVisible
from legcal.geometry import Array, IntArray

_LEAST_UPRIGHT = 1e-9  # component along the image y axis


@dataclass(frozen=True)
class TableNoise:
    """The noise of Table 1, on the Euler angles of an axis and on its point M_LS = (x, 0, z).

    The paper prints 0.05 and 0.06 "rad"; its results fit degrees only, so the default reads
    them as degrees. :meth:`in_radians` is the table to the letter.

    Attributes
    ----------
    psi, theta : float
        Standard deviations of the angles (:mod:`legcal.vision.cylinder`) [rad].
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


@dataclass(frozen=True, eq=False)
class AxisTable:
    """Axes of legs as Table 1 states them."""

    row: IntArray  # row, leg: (n,) indices of the image and of the leg
    leg: IntArray
    # values, sigmas: (n, 4) psi, theta, x, z and their standard deviations [rad, rad, m, m]
    values: Array
    sigmas: Array


def table_of_lines(u: Array, A: Array) -> Array:
    """Return psi, theta and M_LS of lines, by the way of their moments.

    The direction u is at 90 deg - psi to the optical axis, and its picture u_y - i u_x as a complex
    number is at theta to the image's y axis. M_LS is in the plane y = 0 and has the moment of
    the line, M x u = A x u. The method finds the same by other ways, so that a mistake shows.
    """
    u_x, u_y, u_z = u.T
    if np.any(np.abs(u_y) < _LEAST_UPRIGHT):
        raise NotVisible(
            "The axis of a simulated leg could not be tabulated: found it parallel to the image x "
            "axis, needed a leg that crosses the plane y = 0 of its camera; turn the camera."
        )
    # The angle to the optical axis from the chords to both of its ends: exact for all angles.
    across = np.hypot(u_x, u_y)
    psi = 0.5 * np.pi - 2.0 * np.arctan2(np.hypot(across, u_z - 1.0), np.hypot(across, u_z + 1.0))
    theta = np.angle(u_y - 1j * u_x)
    moment = np.cross(A, u)
    return np.stack([psi, theta, moment[:, 2] / u_y, -moment[:, 0] / u_y], axis=-1)


def observe_axes(
    row: IntArray,
    leg: IntArray,
    u: Array,
    A: Array,
    noise: TableNoise,
    rng: np.random.Generator | None,
) -> AxisTable:
    """Return the table of the axes of legs as images show them."""
    values = table_of_lines(u, A)
    if rng is not None:
        values += rng.normal(size=values.shape) * noise.sigmas
    return AxisTable(row, leg, values, np.broadcast_to(noise.sigmas, values.shape))
