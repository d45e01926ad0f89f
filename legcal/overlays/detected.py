"""What detection found in a dataset, and where the legs were expected."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from scipy.spatial.transform import RigidTransform

from legcal.dataset.folder import Dataset
from legcal.detection.prediction import PredictedLeg, predict_legs
from legcal.geometry.types import Array, IntArray
from legcal.mechanism.leg import Cylinder
from legcal.observations.outlines import Outlines


@dataclass(frozen=True, eq=False)
class Detection:
    """The result of :func:`legcal.detect`, in the order of the files.

    Attributes
    ----------
    dataset : Dataset
        What was searched.
    outlines : Outlines
        All outlines: detected, given and edited.
    A_base, B_base : (n_rows, n_legs, 3) array
        Joint centres at every row, where each view sees them, in the base link [m].
    cylinders : sequence, for each leg a sequence of Cylinder
        What can be seen of the legs, with the radii that outlines were searched by.
    T_base_camera : tuple of RigidTransform or None
        The camera of every view; None where nothing is known of it.
    rows : (n,) array of int
        The rows that have an image.
    unplaced : dict
        Why the cameras of some views could not be placed, by name of the view; they are left where
        they were expected, and no outline of theirs is here but those that were given.
    notes : tuple of str
        What else a reader should know.
    """

    dataset: Dataset
    outlines: Outlines
    A_base: Array
    B_base: Array
    cylinders: Sequence[Sequence[Cylinder]]
    T_base_camera: tuple[RigidTransform | None, ...]
    rows: IntArray
    unplaced: dict[str, str]
    notes: tuple[str, ...]

    def view_of(self, row: int) -> str:
        """Return the name of the view of a row."""
        measurements = self.dataset.measurements
        return measurements.views[int(measurements.view[row])].name

    def predicted(self, row: int) -> list[PredictedLeg]:
        """Return where the legs of a row should be seen; none where the camera is not known."""
        measurements, legs = self.dataset.measurements, self.dataset.mechanism.legs
        view = int(measurements.view[row])
        T = self.T_base_camera[view]
        if T is None:
            return []
        used = measurements.views[view].legs
        found = predict_legs(
            measurements.views[view].camera,
            T,
            self.A_base[row],
            self.B_base[row],
            self.cylinders,
            row,
        )
        return [leg for leg in found if used is None or legs[leg.leg].name in used]
