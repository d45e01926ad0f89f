"""The page of a detection, served to a local browser for clicks on joints.

Posted clicks determine the cameras of their views, and the legs are drawn accordingly. They are
written to ``landmarks.csv`` of the dataset only on request.
"""

from __future__ import annotations

import http.server
import json
import secrets
import sys
import tempfile
from functools import partial
from pathlib import Path
from typing import Any
from urllib.parse import parse_qs, urlsplit

import numpy as np

from legcal.calibration.detection import Detection
from legcal.calibration.detection_folder import DETECTION_PAGE, edges_seen_from, examination_page
from legcal.calibration.examination import Examination
from legcal.data.landmarks import (
    LANDMARKS_NAME,
    Landmarks,
    cameras_by_landmarks,
    format_landmarks,
    joint_name,
    joints_at_readings,
    read_landmarks,
)
from legcal.errors import DatasetError
from legcal.files.folder import write_atomically
from legcal.viewer.address import Address

HOST = "127.0.0.1"  # local only: anybody who reaches the page may write the table
TOKEN_HEADER = "X-Legcal-Token"
MAX_TABLE = 2**20  # largest posted table [bytes]


class ClickServer:
    """A server of the folder of a detection, until it is closed."""

    def __init__(
        self, examination: Examination, detection: Detection, folder: Path, port: int = 0
    ) -> None:
        self.detection = detection
        self.folder = folder
        self.token = secrets.token_urlsafe(16)
        self._page = examination_page(examination, detection, self.token).encode()
        handler = partial(_Handler, self)
        self._server = _Server((HOST, port), handler)
        files = (*detection.photograph_files.values(), *detection.overlay_files.values())
        self._files = {f"/{name}": folder / name for name in files}

    @property
    def address(self) -> Address:
        """The address of the page."""
        return Address(HOST, self._server.server_port)

    def run(self) -> None:
        """Serve until :meth:`close` or an interrupt."""
        self._server.serve_forever()

    def close(self) -> None:
        """Stop serving."""
        self._server.shutdown()
        self._server.server_close()

    def content(self, path: str) -> tuple[str, bytes] | None:
        """Return type and content of a path of the page; None for other paths."""
        if path in ("/", f"/{DETECTION_PAGE}"):
            return "text/html; charset=utf-8", self._page
        if path == "/favicon.ico":  # browsers ask for it
            return "image/x-icon", b""
        file = self._files.get(path)
        return None if file is None or not file.is_file() else ("image/jpeg", file.read_bytes())

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
            joints, has_place = (of_row[row] for of_row in joints_at_readings(machine, m, rows))
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
        try:
            write_atomically(path, text.encode())
        except OSError as error:
            return {
                "problems": [
                    f"{path}: the clicks could not be saved: found '{error.strerror}', needed a "
                    "folder that can be written to; download them."
                ]
            }
        return {"problems": [], "saved": str(path)}


class _Server(http.server.ThreadingHTTPServer):
    """A server that ignores browsers that disconnect early."""

    daemon_threads = True

    def handle_error(self, request: Any, client_address: Any) -> None:
        """Report an error in a request."""
        if not isinstance(sys.exception(), ConnectionError):
            super().handle_error(request, client_address)


class _Handler(http.server.BaseHTTPRequestHandler):
    """The handler of the page; requests for other hosts, or without its token, are refused."""

    server_version, sys_version = "legcal", ""

    def __init__(self, clicks: ClickServer, *args: Any) -> None:
        self.clicks = clicks
        super().__init__(*args)

    def do_GET(self) -> None:
        """Send the page or one of its pictures."""
        content = self.clicks.content(urlsplit(self.path).path) if self._is_for_here() else None
        if content is None:
            self.send_error(404)
            return
        self._send(*content)

    def do_POST(self) -> None:
        """Handle posted clicks."""
        token = self.headers.get(TOKEN_HEADER, "")
        if not self._is_for_here() or not secrets.compare_digest(
            token.encode(), self.clicks.token.encode()
        ):
            self.send_error(403)
            return
        length = self.headers.get("Content-Length", "")
        if not length.isdecimal() or int(length) > MAX_TABLE:
            self.send_error(413)
            return
        place, table = urlsplit(self.path), self.rfile.read(int(length))
        image = parse_qs(place.query).get("image", ["0"])[0]
        n_images = len(self.clicks.detection.photograph_files)
        try:
            if place.path == "/clicks" and image.isdecimal() and int(image) < n_images:
                answer = self.clicks.placed(table, int(image))
            elif place.path == "/save":
                answer = self.clicks.save(table)
            else:
                self.send_error(404)
                return
        except DatasetError as error:
            answer = {"problems": list(error.problems), "notes": [], "legs": [], "joints": {}}
        self._send("application/json", json.dumps(answer).encode())

    def _is_for_here(self) -> bool:
        """Return whether a request names this host: other names may belong to other pages."""
        port = self.clicks.address.port
        return self.headers.get("Host", "") in (f"{HOST}:{port}", f"localhost:{port}")

    def _send(self, kind: str, content: bytes) -> None:
        self.send_response(200)
        self.send_header("Content-Type", kind)
        self.send_header("Content-Length", str(len(content)))
        self.send_header("Cache-Control", "no-store")
        self.end_headers()
        self.wfile.write(content)

    def log_message(self, format: str, *args: Any) -> None:
        """Log nothing."""
