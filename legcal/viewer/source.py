"""What the viewer shows: a model, a result with its uncertainty, a session with photographs."""

from __future__ import annotations

import os
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from scipy.spatial.transform import RigidTransform

from legcal.errors import LegcalError, UsageError, printable
from legcal.exports.subject import Subject, load_subject
from legcal.machine.files import DATASET_YAML, shipped_names
from legcal.machine.model import Machine
from legcal.vision.image_file import small_jpeg

if TYPE_CHECKING:
    from legcal.calibration.result_folder import EarlierResult
    from legcal.data.dataset import Dataset
    from legcal.vision.camera import Camera

MAX_CAMERAS = 200
_SIDE, _QUALITY = 960, 85  # longer side of a displayed photograph [px], of its JPEG [percent]
_MARKERS = (DATASET_YAML, "result.json", "calibrated.yaml", "robot.yaml")


def open_source(given: str | Path, dataset: str | Path | None = None) -> Subject:
    """Return the dataset, result or mechanism at a path, or with the name of a shipped model.

    A result and a model do not name their *dataset*, which can be given beside them.
    """
    path = Path(given)
    if not os.path.exists(path) and str(given) not in shipped_names():
        raise UsageError(
            f"{path}: nothing could be shown: found no such file or folder and no shipped model of "
            "that name, needed a dataset, a result of legcal calibrate, a model, or one of "
            f"{', '.join(shipped_names())}; check the path."
        )
    has_models = any((path / "models").glob("*.yaml"))
    if os.path.isdir(path) and not (has_models or any((path / x).exists() for x in _MARKERS)):
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
        from legcal.data.cache import with_kept_moves
        from legcal.data.dataset import load_dataset

        loaded = with_kept_moves(load_dataset(path, check_images=False))
        return Subject(loaded.machine, str(given), dataset=loaded)
    subject = load_subject(given)
    if dataset is None:
        return subject
    return replace(subject, dataset=_session(subject.machine, dataset, subject.result))


def _session(machine: Machine, given: str | Path, result: EarlierResult | None) -> Dataset:
    """Return the session of a machine, with the outlines that its calibration used."""
    from legcal.data.cache import with_kept_moves
    from legcal.data.dataset import OBSERVATIONS_NAME, load_dataset, read_observed

    dataset = with_kept_moves(load_dataset(given, check_images=False))
    names = dataset.machine.leg_names
    if sorted(names) != sorted(machine.leg_names):
        raise UsageError(
            f"--dataset could not be used: found one of a machine with the legs {', '.join(names)},"
            f" needed those of {machine.name}: {', '.join(machine.leg_names)}; give a dataset of "
            f"{'that model' if result is None else 'that result: the one it was computed from'}."
        )
    outlines = dataset.observations
    if result is not None and os.path.isfile(result.folder / OBSERVATIONS_NAME):
        outlines, _ = read_observed(result.folder, dataset.machine, dataset.measurements)
    order = [names.index(name) for name in machine.leg_names]
    m = dataset.measurements
    measurements = replace(m, q=m.q[:, order], sigma_q=m.sigma_q[order])
    return replace(dataset, measurements=measurements, observations=outlines)


class Photographs:
    """The session of a subject, if it has one."""

    def __init__(self, source: Subject) -> None:
        self._dataset = source.dataset
        # Name, camera and T_base_camera of the views with a pose, calibrated or stated
        self.cameras: list[tuple[str, Camera, RigidTransform]] = []
        self.names: tuple[str, ...] = ()  # of the images, by row
        self.q = np.zeros((0, source.machine.n_legs))  # readings at the poses of the session [m]
        if source.dataset is None:
            return
        from legcal.data.measurements import row_names

        measurements = source.dataset.measurements
        for view in measurements.views[:MAX_CAMERAS]:
            T = view.T_base_camera
            if source.result is not None and view.name in source.result.result.views:
                T = source.result.result.views[view.name].T_base_camera.motion()
            if T is not None:
                self.cameras.append((view.name, view.camera, T))
        self.names = row_names(measurements)
        self.q = measurements.q_of_poses

    def at(self, pose: int) -> list[dict[str, Any]]:
        """Return the photographs of a pose, with their outlines in pixels, as the page has them."""
        if self._dataset is None:
            return []
        m, photographs = self._dataset.measurements, list[dict[str, Any]]()
        for row in np.flatnonzero(m.pose == pose).tolist():
            view, path = m.views[int(m.view[row])], self._dataset.image_path(row)
            caption, is_there = f"{view.name}: {self.names[row]}", path and os.path.exists(path)
            if path is not None and not is_there:
                caption += ", which could not be read: found no such file"
            photographs.append(
                {
                    "file": f"photographs/{row}" if is_there else "",
                    "size": [view.camera.width, view.camera.height],
                    "caption": printable(caption),
                    "lines": self._outlines(row),
                }
            )
        return photographs

    def picture(self, row: int) -> bytes | None:
        """Return the photograph of a row as a small JPEG; None without one."""
        if self._dataset is None or self._dataset.image_path(row) is None:
            return None
        try:
            return small_jpeg(self._dataset.image_reader([row])(0), _SIDE, _QUALITY)
        except LegcalError:
            return None

    def _outlines(self, row: int) -> list[tuple[str, list[list[float]]]]:
        """Return the outlines of an image: class of the line, and both ends [px]."""
        if self._dataset is None or (outlines := self._dataset.observations) is None:
            return []
        chosen = (outlines.row == row) & np.isfinite(outlines.ends).all(axis=(1, 2))
        return [
            ("measured" if outlines.used[i] else "rejected", np.round(outlines.ends[i], 1).tolist())
            for i in np.flatnonzero(chosen).tolist()
        ]
