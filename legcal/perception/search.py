"""Images that were looked at before: their bars are known and not found anew."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from scipy.spatial.transform import RigidTransform

from legcal.data import Measurements
from legcal.geometry import Array, BoolArray, Image, IntArray
from legcal.machine import Cylinder
from legcal.perception.agreement import Picture, Targets, targets_of
from legcal.perception.bars import Bars, find_bars, find_segments
from legcal.perception.picture import to_grey
from legcal.vision import Camera

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
        As :func:`legcal.perception.recognise.recognise` has them.
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


Load = Callable[[int], Image]


@dataclass(frozen=True, eq=False)
class Search:
    """What is searched for; it travels to worker processes.

    Attributes
    ----------
    load : callable
        Returns the image of a row.
    measurements : Measurements
        All rows.
    A_base, B_base : (n_rows, n_legs, 3) array
        Joint centres of every row by the model, in the base link [m].
    cylinders : sequence, for each leg a sequence of Cylinder
        What can be seen of the legs.
    wanted : (n_views, n_legs) array of bool
        Legs that each view is said to show.
    """

    load: Load
    measurements: Measurements
    A_base: Array
    B_base: Array
    cylinders: Sequence[Sequence[Cylinder]]
    wanted: BoolArray

    @property
    def n_legs(self) -> int:
        """Number of legs."""
        return len(self.cylinders)

    def picture(self, row: int) -> Picture:
        """Return what the image of a row shows, and what it should."""
        view = int(self.measurements.view[row])
        camera = self.measurements.views[view].camera
        return Picture(self.bars(row, view), self.targets(row, view), corners_of(camera))

    def bars(self, row: int, view: int) -> Bars:
        """Return the bars of an image as if the camera of a view had taken it."""
        camera = self.measurements.views[view].camera
        return find_bars(find_segments(to_grey(self.load(row)), camera))

    def targets(self, row: int, view: int) -> Targets:
        """Return the legs at the reading of a row that a view is said to show."""
        legs = np.flatnonzero(self.wanted[view])
        return targets_of(self.A_base[row], self.B_base[row], self.cylinders, legs)

    def retargeted(self, row: int, picture: Picture) -> Picture:
        """Return what an image shows with what it should show by other cylinders."""
        return replace(picture, targets=self.targets(row, int(self.measurements.view[row])))


def corners_of(camera: Camera) -> Array:
    """Return the least and the greatest x and y (2, 2) of the sensor plane that an image shows."""
    x, y = camera.width - 1.0, camera.height - 1.0
    border = np.array(
        [[0, 0], [x, 0], [0, y], [x, y], [x / 2, 0], [0, y / 2], [x / 2, y], [x, y / 2]]
    )
    xy = camera.undistort(border)
    return np.array([xy.min(axis=0), xy.max(axis=0)])


@dataclass(frozen=True, eq=False)
class LookedAt(Search):
    """A search in images of which some were looked at.

    Attributes
    ----------
    known : mapping of Bars
        The bars of some images, by row, as the cameras of their own views have taken them.
    """

    known: Mapping[int, Bars] = field(default_factory=dict)

    def bars(self, row: int, view: int) -> Bars:
        """Return the bars of an image as if the camera of a view had taken it."""
        is_own = view == int(self.measurements.view[row])
        return self.known[row] if is_own and row in self.known else super().bars(row, view)
