"""Placed cameras, their undistorted photographs, and outlines in space."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import RigidTransform

from legcal.errors import LegcalError
from legcal.files.motions import motion_from_xyz_quat
from legcal.geometry.types import Array, BoolArray
from legcal.viewer.source import Source

if TYPE_CHECKING:
    from legcal.calibration.result_folder import EarlierResult
    from legcal.data.dataset import Dataset
    from legcal.vision.camera import Camera

MAX_CAMERAS = 200
_SIDE = 720  # longer side of a displayed photograph [px]
_RIM = 17  # points along each side of an image
_WIDEST = 3.0  # largest tangent of half the displayed field of view
_EMPTY = 235.0  # grey level outside the image of a lens

Picture = NDArray[np.uint8]


@dataclass(frozen=True, eq=False)
class Place:
    """A camera with its pose."""

    view: int  # index of the view
    name: str
    camera: Camera
    T_base_camera: RigidTransform
    half: Array  # (2,) tangents of half the field of view of the whole image, x and y

    @property
    def fov(self) -> float:
        """Vertical field of view [rad]."""
        return float(2.0 * np.arctan(self.half[1]))

    @property
    def aspect(self) -> float:
        """Width over height."""
        return float(self.half[0] / self.half[1])


class Photographs:
    """The session of a source from its cameras.

    Attributes
    ----------
    places : tuple of Place
        The cameras with a pose, calibrated or stated in the dataset.
    names : tuple of str
        Names of the images, by row.
    poses : tuple of str
        Names of the poses of the session, from images.
    q : (n_poses, n_legs) array
        Readings at these poses [m].
    """

    def __init__(self, source: Source) -> None:
        self._dataset = source.dataset
        self._maps: dict[int, NDArray[np.float32]] = {}
        self.places: tuple[Place, ...] = ()
        self.names: tuple[str, ...] = ()
        self.poses: tuple[str, ...] = ()
        self.q = np.zeros((0, source.machine.n_legs))
        if source.dataset is None:
            return
        from legcal.data.measurements import row_names

        measurements = source.dataset.measurements
        self.places = _places(source.dataset, source.result)
        self.names = row_names(measurements)
        self.poses = tuple(self.names[row] for row in measurements.first_rows.tolist())
        self.q = measurements.q_of_poses

    @property
    def has_outlines(self) -> bool:
        """Whether there are outlines, measured or given."""
        return self._dataset is not None and self._dataset.observations is not None

    def row(self, place: Place, pose: int) -> int | None:
        """Return the row of the image of a camera at a pose, None without image."""
        if self._dataset is None:
            return None
        measurements = self._dataset.measurements
        rows = np.flatnonzero((measurements.view == place.view) & (measurements.pose == pose))
        return int(rows[0]) if len(rows) else None

    def name(self, row: int) -> str:
        """Return the name of the image in a row."""
        return self.names[row]

    def picture(self, place: Place, row: int) -> tuple[Picture | None, str]:
        """Return the photograph of a row as a pinhole image (h, w, 3), or why there is none."""
        if self._dataset is None or self._dataset.image_path(row) is None:
            return None, ""
        try:
            grey = self._dataset.image_reader([row])(0)
        except LegcalError as error:
            return None, str(error)
        at = self._map(place)
        import cv2

        shown = cv2.remap(grey, at[..., 0], at[..., 1], cv2.INTER_LINEAR, borderValue=_EMPTY)
        levels = np.clip(np.rint(shown), 0, 255).astype(np.uint8)
        return np.repeat(levels[..., None], 3, axis=2), ""

    def _map(self, place: Place) -> NDArray[np.float32]:
        """Return the pixel in the original image for each pixel of a picture, (h, w, 2) [px]."""
        if place.view in self._maps:
            return self._maps[place.view]
        camera = place.camera
        longer = min(_SIDE, max(camera.width, camera.height))
        w, h = (np.maximum(1, np.rint(longer * place.half / place.half.max()))).astype(int)
        x = place.half[0] * ((np.arange(w) + 0.5) / w * 2.0 - 1.0)
        y = place.half[1] * ((np.arange(h) + 0.5) / h * 2.0 - 1.0)
        rays = np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)
        self._maps[place.view] = camera.distort(rays).reshape(h, w, 2).astype(np.float32)
        return self._maps[place.view]

    def outlines(self, place: Place, row: int, depth: float) -> tuple[Array, BoolArray]:
        """Return the outlines of an image at a depth [m] of its camera, in the base link.

        The result is their ends (m, 2, 3) [m], and which outlines are used, (m,).
        """
        none = np.zeros((0, 2, 3)), np.zeros(0, dtype=np.bool_)
        if self._dataset is None or self._dataset.observations is None:
            return none
        observations = self._dataset.observations
        chosen = np.flatnonzero(
            (observations.row == row) & np.isfinite(observations.ends).all(axis=(1, 2))
        )
        if len(chosen) == 0:
            return none
        xy = place.camera.undistort(observations.ends[chosen].reshape(-1, 2))
        rays = depth * np.concatenate([xy, np.ones((len(xy), 1))], axis=1)
        return place.T_base_camera.apply(rays).reshape(-1, 2, 3), observations.used[chosen]


def _places(dataset: Dataset, result: EarlierResult | None) -> tuple[Place, ...]:
    """Return the cameras with a known pose."""
    places: list[Place] = []
    for v, view in enumerate(dataset.measurements.views):
        T = view.T_base_camera
        if result is not None and view.name in result.result.views:
            pose = result.result.views[view.name].T_base_camera
            T = motion_from_xyz_quat(pose.xyz, pose.quat_xyzw)
        if T is not None and len(places) < MAX_CAMERAS:
            places.append(Place(v, view.name, view.camera, T, _half(view.camera)))
    return tuple(places)


def _half(camera: Camera) -> Array:
    """Return the tangents of half the field of view of the whole image of a camera, (2,)."""
    w, h = camera.width - 0.5, camera.height - 0.5
    s = np.linspace(-0.5, 1.0, _RIM)
    x, y = np.linspace(-0.5, w, len(s)), np.linspace(-0.5, h, len(s))
    low = np.full(len(s), -0.5)
    rim = np.concatenate(
        [
            np.stack([x, low], axis=1),
            np.stack([x, low + h + 0.5], axis=1),
            np.stack([low, y], axis=1),
            np.stack([low + w + 0.5, y], axis=1),
        ]
    )
    return np.asarray(np.minimum(np.abs(camera.undistort(rim)).max(axis=0), _WIDEST))
