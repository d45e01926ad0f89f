"""Photographs that arrive one by one: in a watched folder, or from a camera at this machine."""

from __future__ import annotations

import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from legcal.errors import OutOfResources, UsageError
from legcal.files.reading import MAX_IMAGE, read_bytes
from legcal.geometry.types import Array
from legcal.vision.image_file import (
    COPY_AGAIN,
    HEIC_SUFFIXES,
    SUFFIXES,
    BadImage,
    image_size,
    quiet_opencv,
)

AGREE = 4.0  # largest difference of two frames at rest, means of squares of 8 px [grey levels]
_SQUARE = 8
PATIENCE = 10.0  # longest wait for frames that agree [s]
_PAUSE = 0.2  # between two frames [s]


class WatchedFolder:
    """New photographs in a folder; those that are there already are left alone.

    A file counts once its size stands still and its end has arrived, so that a half-copied one is
    waited for.
    """

    asks = "photograph it"  # what the owner does for the next one

    def __init__(self, folder: str | Path) -> None:
        self.folder = Path(folder)
        if not self.folder.is_dir():
            raise UsageError(
                f"{self.folder}: the folder could not be watched: found no such folder, needed the "
                "one where new photographs appear; correct --watch."
            )
        self._seen = self._files()
        self._last: dict[Path, tuple[int, int]] = {}
        self.incomplete: set[str] = set()  # names of new files that are not complete yet

    def poll(self, *, wanted: bool = True) -> Path | None:
        """Return the oldest new photograph that is complete; each once."""
        files = {
            path: state for path, state in self._files().items() if state != self._seen.get(path)
        }
        before, self._last, self.incomplete = self._last, files, set()
        for path, state in sorted(files.items(), key=lambda entry: (entry[1][1], entry[0])):
            if before.get(path) != state or _is_cut_off(path):
                self.incomplete.add(path.name)
                continue
            self._seen[path] = state
            return path
        return None

    def _files(self) -> dict[Path, tuple[int, int]]:
        """Return size and time of change [ns] of the photographs in the folder."""
        files = {}
        for path in self.folder.iterdir():
            if path.suffix.lower() in (*SUFFIXES, *HEIC_SUFFIXES) and not path.name.startswith("."):
                try:
                    file = path.stat()
                except FileNotFoundError:  # renamed meanwhile
                    continue
                files[path] = file.st_size, file.st_mtime_ns
        return files


def _is_cut_off(path: Path) -> bool:
    """Return whether more of a file may still arrive; other problems are those of its check."""
    try:
        image_size(read_bytes(path, MAX_IMAGE))
    except BadImage as error:
        return error.remedy == COPY_AGAIN
    except OSError:
        return True
    return False


class LiveCamera:
    """A camera at this machine, by OpenCV: a photograph is taken when two frames agree."""

    asks = "press Enter"

    def __init__(
        self,
        number: int,
        width: int,  # of the calibrated images [px]
        height: int,
        opened: Callable[[int], Any] = cv2.VideoCapture,
    ) -> None:
        with quiet_opencv():
            self._camera = opened(number)
        if not self._camera.isOpened():
            raise UsageError(
                f"The camera {number} could not be opened: found none of that number, or one in "
                "use by another program, needed one that is free; close that, or give another "
                "--camera."
            )
        self._camera.set(cv2.CAP_PROP_FRAME_WIDTH, width)
        self._camera.set(cv2.CAP_PROP_FRAME_HEIGHT, height)
        self.incomplete: set[str] = set()  # frames are complete
        self._folder = tempfile.TemporaryDirectory()
        self._n = 0

    def poll(self, *, wanted: bool = False) -> Path | None:
        """Return a photograph once two frames agree, if one is wanted.

        Raises OutOfResources if the camera gives no frames, or frames that never agree.
        """
        if not wanted:
            return None
        begin, before = time.monotonic(), None
        while time.monotonic() < begin + PATIENCE:
            is_read, frame = self._camera.read()
            if not is_read:
                break
            if before is not None and agree(before, frame):
                self._n += 1
                path = Path(self._folder.name) / f"frame{self._n}.png"
                cv2.imwrite(str(path), frame)
                return path
            before = frame
            time.sleep(_PAUSE)
        found = "no frame" if before is None else f"frames that still change after {PATIENCE:g} s"
        raise OutOfResources(
            f"No photograph could be taken: found {found}, needed two that agree; wait until the "
            "machine stands still, see that its light does not flicker, and press Enter again."
        )

    def close(self) -> None:
        """Let go of the camera, and remove its photographs."""
        self._camera.release()
        self._folder.cleanup()


def agree(first: Array, second: Array) -> bool:
    """Return whether two frames show the same, but for noise and a change of all light."""
    if first.shape != second.shape:
        return False
    size = max(1, first.shape[1] // _SQUARE), max(1, first.shape[0] // _SQUARE)
    small = [
        cv2.resize(frame, size, interpolation=cv2.INTER_AREA).astype(np.float32)
        for frame in (first, second)
    ]
    change = small[1] - small[0]
    return bool(np.abs(change - np.median(change)).max() < AGREE)
