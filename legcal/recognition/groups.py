"""Views whose cameras are placed together: one alone, or all that see one calibration board."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import RigidTransform

from legcal.geometry.types import IntArray
from legcal.observations.measurements import Measurements
from legcal.recognition.agreement import Picture

NEAR_IMAGES = 6  # of a group that are searched where a rough pose is given, at first


@dataclass(frozen=True, eq=False)
class Group:
    """Views whose cameras are placed together, since they know how they stand to each other.

    Attributes
    ----------
    views : list of int
    T_group_camera : dict of RigidTransform, by view
    rows, some : list of int
        All images to use, and a few of them.
    view_of_row : dict of int
    hint : RigidTransform or None
        T_base_group, roughly.
    """

    views: list[int]
    T_group_camera: dict[int, RigidTransform]
    rows: list[int]
    some: list[int]
    view_of_row: dict[int, int]
    hint: RigidTransform | None

    def pictures(self, of_row: dict[int, Picture], rows: Sequence[int]) -> list[Picture]:
        """Return the pictures of some rows, in the frame of the group."""
        found = []
        for row in rows:
            T = self.T_group_camera[self.view_of_row[row]].inv()
            found.append(replace(of_row[row], R=T.rotation.as_matrix(), t=T.translation))
        return found


def group_views(
    measurements: Measurements,
    rows: IntArray,
    hints: Sequence[RigidTransform | None],
    joined: Sequence[RigidTransform | None] | None,
) -> list[Group]:
    """Return the views that stand alone, and those that are joined.

    Parameters
    ----------
    measurements : Measurements
        All rows.
    rows : (n,) array of int
        Those whose images are used.
    hints, joined : sequence of RigidTransform or None, for each view
        As :func:`legcal.recognition.recognise.recognise` has them.
    """
    view_of = {int(row): int(measurements.view[row]) for row in rows}
    views = sorted(set(view_of.values()))
    together = [v for v in views if joined is not None and joined[v] is not None]
    groups = [[v] for v in views if v not in together] + ([together] if together else [])
    found = []
    for group in groups:
        own = [row for row, v in view_of.items() if v in group]
        T = {v: RigidTransform.identity() for v in group}
        if joined is not None and group == together:
            T = {v: joined_v for v in group if (joined_v := joined[v]) is not None}
        given = [(hint, T[v]) for v in group if (hint := hints[v]) is not None]
        hint = None if not given else given[0][0] * given[0][1].inv()
        found.append(Group(group, T, own, some_rows(own), view_of, hint))
    return found


def some_rows(rows: Sequence[int]) -> list[int]:
    """Return a few rows spread over all of them."""
    chosen = np.linspace(0, len(rows) - 1, min(NEAR_IMAGES, len(rows)))
    return [rows[int(k)] for k in np.unique(np.rint(chosen).astype(int))]
