"""What was recorded besides the pictures: for every image its view, its pose and the readings."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import RigidTransform

from legcal.geometry.types import Array, IntArray
from legcal.vision.camera import Camera


@dataclass(frozen=True, eq=False)
class View:
    """One position of a calibrated camera.

    Attributes
    ----------
    name : str
        The name in ``dataset.yaml``.
    camera : Camera
        Its intrinsics.
    T_base_camera : RigidTransform or None
        A rough pose of the camera in the base link, good to 2 cm and 2 degrees.
    legs : tuple of str or None
        Use only these legs in this view; None for all.
    hand_held : bool
        Whether this is one image of a camera in the hand, which only the board can place.
    """

    name: str
    camera: Camera
    T_base_camera: RigidTransform | None = None
    legs: tuple[str, ...] | None = None
    hand_held: bool = False


@dataclass(frozen=True, eq=False)
class Measurements:
    """The rows of ``measurements.csv``: one for each image.

    Attributes
    ----------
    views : tuple of View
        The camera positions.
    image : tuple of str, length n_rows
        The image of each row, relative to the dataset; "" where only outlines are given.
    view : (n_rows,) array of int
        Index into ``views``.
    pose : (n_rows,) array of int
        Index of the platform pose, 0 to n_poses - 1; rows that share it share one pose.
    q : (n_rows, n_legs) array
        Encoder readings in the order of the mechanism's legs [m]; zero for constant-length
        legs, NaN for passive ones.
    sigma_q : float
        Standard deviation of a reading [m].
    pose_labels : tuple of str, length n_poses
        What the optional column ``pose`` calls each pose; "" for a pose without a label.
        Empty where there is no such column.
    """

    views: tuple[View, ...]
    image: tuple[str, ...]
    view: IntArray
    pose: IntArray
    q: Array
    sigma_q: float
    pose_labels: tuple[str, ...] = ()

    @property
    def n_rows(self) -> int:
        """Number of images."""
        return len(self.image)

    @property
    def first_rows(self) -> IntArray:
        """The first row of every pose, (n_poses,): its reading is that of the pose."""
        return np.asarray(np.unique(self.pose, return_index=True)[1])

    @property
    def n_poses(self) -> int:
        """Number of different platform poses."""
        return int(self.pose.max()) + 1 if len(self.pose) else 0
