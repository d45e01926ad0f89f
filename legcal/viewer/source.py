"""What the viewer shows: a model, a result with its uncertainty, a session with photographs."""

from __future__ import annotations

import os
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import RigidTransform

from legcal.errors import LegcalError, UsageError
from legcal.exports.subject import load_subject
from legcal.files.motions import motion_from_xyz_quat
from legcal.geometry.types import Array, BoolArray
from legcal.machine.files import DATASET_YAML, shipped_names
from legcal.machine.model import Machine

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
_MARKERS = (DATASET_YAML, "result.json", "calibrated.yaml", "robot.yaml")


@dataclass(frozen=True, eq=False)
class Source:
    """A machine, with its calibration and its session, if any."""

    machine: Machine  # the calibrated machine of a result
    nominal: Machine | None = None  # nominal machine (legs only); None without a result
    result: EarlierResult | None = None
    dataset: Dataset | None = None  # session, with readings in the order of the legs

    @property
    def name(self) -> str:
        """The name of the machine."""
        return self.machine.name if self.result is None else self.machine.urdf.name


def open_source(given: str | Path, dataset: str | Path | None = None) -> Source:
    """Return the source at a path, or with the name of a shipped model.

    Parameters
    ----------
    given : str or Path
        A dataset folder, a result folder, or a mechanism.
    dataset : str or Path, optional
        The dataset of a result or a model, which do not name it themselves.

    Raises
    ------
    UsageError
        If it does not exist, is a folder of another kind, or two datasets are given.
    DatasetError, ModelError, OutOfClass
        If its files are not valid.
    """
    path = Path(given)
    if not os.path.exists(path) and str(given) not in shipped_names():
        raise UsageError(
            f"{path}: nothing could be shown: found no such file or folder and no shipped model of "
            "that name, needed a dataset, a result of legcal calibrate, a model, or one of "
            f"{', '.join(shipped_names())}; check the path."
        )
    if os.path.isdir(path) and not any(os.path.exists(path / name) for name in _MARKERS):
        raise UsageError(
            f"{path}: nothing could be shown: found a folder without {', '.join(_MARKERS[:-1])} or "
            f"{_MARKERS[-1]}, needed a dataset, a result of legcal calibrate, or a model; give one."
        )
    is_result = os.path.isfile(path / "result.json") or path.name == "result.json"
    is_dataset = path.name == DATASET_YAML or os.path.isfile(path / DATASET_YAML)
    if is_dataset and not is_result:
        if dataset is not None:
            raise UsageError(
                f"--dataset could not be used: found the dataset {path} beside it, needed a result "
                "or a model; leave one of them out."
            )
        from legcal.data.dataset import load_dataset

        loaded = load_dataset(path, check_images=False)
        return Source(loaded.machine, dataset=loaded)
    subject = load_subject(given)
    if dataset is None:
        return Source(subject.machine, subject.nominal, subject.result)
    return Source(
        subject.machine,
        subject.nominal,
        subject.result,
        _session(subject.machine, dataset, subject.result),
    )


def _session(machine: Machine, given: str | Path, result: EarlierResult | None) -> Dataset:
    """Return the session of a machine, with the outlines that its calibration used."""
    from legcal.data.dataset import OBSERVATIONS_NAME, load_dataset, read_outlines

    dataset = load_dataset(given, check_images=False)
    names = dataset.machine.leg_names
    if sorted(names) != sorted(machine.leg_names):
        raise UsageError(
            f"--dataset could not be used: found one of a machine with the legs {', '.join(names)},"
            f" needed those of {machine.name}: {', '.join(machine.leg_names)}; give a dataset of "
            f"{'that model' if result is None else 'that result: the one it was computed from'}."
        )
    outlines = dataset.observations
    if result is not None and os.path.isfile(result.folder / OBSERVATIONS_NAME):
        outlines = read_outlines(result.folder, dataset.machine, dataset.measurements)
    order = [names.index(name) for name in machine.leg_names]
    measurements = replace(dataset.measurements, q=dataset.measurements.q[:, order])
    return replace(dataset, measurements=measurements, observations=outlines)


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
