"""What is searched for: the images of some views, and the legs that they should show."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from legcal.detection.picture import to_grey
from legcal.geometry.types import Array, BoolArray, Image
from legcal.mechanism.leg import Cylinder
from legcal.observations.measurements import Measurements
from legcal.recognition.agreement import Picture
from legcal.recognition.bars import Bars, find_bars
from legcal.recognition.segments import find_segments
from legcal.recognition.targets import Targets, targets_of
from legcal.vision.camera import Camera

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
