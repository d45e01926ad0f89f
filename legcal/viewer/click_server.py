"""The page of a detection, served to a local browser for clicks on joints.

Posted clicks determine the cameras of their views, and the legs are drawn accordingly. They are
written to ``landmarks.csv`` of the dataset only on request.
"""

from __future__ import annotations

import tempfile
from pathlib import Path
from typing import Any

import numpy as np

from legcal.calibration.detection import (
    DETECTION_PAGE,
    Detection,
    Examination,
    edges_seen_from,
    examination_page,
)
from legcal.data.landmarks import (
    LANDMARKS_NAME,
    Landmarks,
    cameras_by_landmarks,
    format_landmarks,
    joint_name,
    joints_at_readings,
    read_landmarks,
)
from legcal.errors import LegcalError
from legcal.files.folder import out_of_resources, write_atomically
from legcal.viewer.server import HTML, LOCAL, Address, PageServer


class ClickServer(PageServer):
    """A server of the folder of a detection, to this machine alone: its posts write a table."""

    def __init__(
        self, examination: Examination, detection: Detection, folder: Path, port: int = 0
    ) -> None:
        super().__init__(Address(LOCAL, port))
        self.detection = detection
        self.folder = folder
        self._page = examination_page(examination, detection, self.token).encode()
        files = (*detection.photograph_files.values(), *detection.overlay_files.values())
        self._files = {f"/{name}": folder / name for name in files}

    def content(self, path: str) -> tuple[str, bytes] | None:
        """Return type and content of a path of the page; None for other paths."""
        if path in ("/", f"/{DETECTION_PAGE}"):
            return HTML, self._page
        file = self._files.get(path)
        return None if file is None or not file.is_file() else ("image/jpeg", file.read_bytes())

    def answer(self, path: str, query: dict[str, list[str]], text: bytes) -> dict[str, Any] | None:
        """Return the camera of an image by posted clicks, or the file they are saved in."""
        image, n_images = query.get("image", ["0"])[0], len(self.detection.photograph_files)
        try:
            if path == "/clicks" and image.isdecimal() and int(image) < n_images:
                return self.placed(text, int(image))
            return self.save(text) if path == "/save" else None
        except LegcalError as error:
            return {"problems": list(error.problems), "notes": [], "legs": [], "joints": {}}

    def read(self, table: bytes) -> Landmarks:
        """Return the clicks of a posted table; raise DatasetError as for a file."""
        dataset = self.detection.dataset
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder) / LANDMARKS_NAME
            path.write_bytes(table)
            return read_landmarks(path, dataset.machine.leg_names, dataset.measurements)

    def placed(self, table: bytes, image: int) -> dict[str, Any]:
        """Return the camera of an image determined by clicks: its legs and joints [px]."""
        dataset = self.detection.dataset
        m, machine = dataset.measurements, dataset.machine
        landmarks = self.read(table)
        row = list(self.detection.photograph_files)[image]
        v = int(m.view[row])
        answer: dict[str, Any] = {
            "image": image, "problems": [], "notes": [], "legs": [], "joints": {},
        }  # fmt: skip
        landmarks_here = landmarks.choose(m.view[landmarks.row] == v)
        if not len(landmarks_here):
            return answer
        camera = cameras_by_landmarks(Path(LANDMARKS_NAME), machine, m, landmarks_here)[v]
        answer |= {"problems": camera.problems, "notes": camera.notes}
        if camera.T_base_camera is not None:
            rows = np.array([row], dtype=np.intp)
            joints, has_place = (of_row[0] for of_row in joints_at_readings(machine, m, rows))
            ends = np.argwhere(has_place)
            P = camera.T_base_camera.inv().apply(joints[has_place])
            ahead = P[:, 2] > 0.0
            px = np.round(m.views[v].camera.project(P[ahead]), 2).tolist()
            names = [joint_name(machine.leg_names[j], end) for j, end in ends[ahead].tolist()]
            answer["joints"] = dict(zip(names, px, strict=True))
            answer["legs"] = edges_seen_from(self.detection, row, camera.T_base_camera)
        return answer

    def save(self, table: bytes) -> dict[str, Any]:
        """Write clicks into the dataset, and return the path of the file."""
        dataset = self.detection.dataset
        text = format_landmarks(self.read(table), dataset.measurements, dataset.machine.leg_names)
        path = dataset.folder / LANDMARKS_NAME
        with out_of_resources(path, "the clicks", "download them"):
            write_atomically(path, text.encode())
        return {"problems": [], "saved": str(path)}
