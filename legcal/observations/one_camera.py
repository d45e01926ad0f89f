"""Leg axes of several cameras in the frame of one of them, as if it had seen all.

Where a calibration board on the base shows how cameras stand to each other, their axes are lines in
one frame, and the gathering of section 3.3 is done before it begins.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import RigidTransform

from legcal.geometry.types import IntArray
from legcal.observations.leg_axes import LegAxes
from legcal.observations.measurements import Measurements


@dataclass(frozen=True, eq=False)
class InOneCamera:
    """Axes of all views that show the board, in the frame of the first of them.

    Attributes
    ----------
    axes : LegAxes
        Those of views without the board are in their own camera frames.
    measurements : Measurements
        The same rows; all views that show the board are one, which comes first.
    T_first_camera : tuple of RigidTransform or None
        The camera of each original view in the first one; None where it does not show the board.
    view : (n_views,) array of int
        Which of the new views each of the original ones is.
    """

    axes: LegAxes
    measurements: Measurements
    T_first_camera: tuple[RigidTransform | None, ...]
    view: IntArray

    def cameras(self, placed: Sequence[RigidTransform | None]) -> tuple[RigidTransform | None, ...]:
        """Return the camera of every original view.

        Parameters
        ----------
        placed : sequence of RigidTransform or None
            T_x_camera of the new views; x is any frame.
        """
        found = []
        for v, T_first_camera in zip(self.view.tolist(), self.T_first_camera, strict=True):
            T = placed[v]
            found.append(T if T is None or T_first_camera is None else T * T_first_camera)
        return tuple(found)


def in_one_camera(
    axes: LegAxes,
    measurements: Measurements,
    T_board_camera: Sequence[RigidTransform | None],
) -> InOneCamera:
    """Return the axes of all views that show a board in the frame of the first of these.

    Parameters
    ----------
    axes : LegAxes
        In the camera frames.
    measurements : Measurements
        Their views.
    T_board_camera : sequence of RigidTransform or None
        The camera of each view; None where it does not show the board. One of them shows it.
    """
    shown = np.array([T is not None for T in T_board_camera], dtype=np.bool_)
    first = int(np.argmax(shown))
    from_board = next(T.inv() for T in T_board_camera if T is not None)
    T_first_camera = tuple(None if T is None else from_board * T for T in T_board_camera)
    others = np.flatnonzero(~shown).tolist()
    place = np.zeros(len(shown), dtype=np.intp)
    place[others] = 1 + np.arange(len(others))
    u, M, basis = axes.u.copy(), axes.M.copy(), axes.basis.copy()
    view = measurements.view[axes.row]
    for v, T in enumerate(T_first_camera):
        here = view == v
        if T is not None and here.any():
            u[here], M[here] = T.rotation.apply(u[here]), T.apply(M[here])
            basis[here] = T.rotation.apply(basis[here].reshape(-1, 3)).reshape(-1, 2, 3)
    views = [replace(measurements.views[first], legs=None)]
    views += [measurements.views[v] for v in others]
    return InOneCamera(
        replace(axes, u=u, M=M, basis=basis),
        replace(measurements, views=tuple(views), view=place[measurements.view]),
        T_first_camera,
        place,
    )
