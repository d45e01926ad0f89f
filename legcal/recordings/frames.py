"""Frames of a recording with their times, one at a time, from a video or a folder of images."""

from __future__ import annotations

import os
import re
from collections.abc import Container, Iterator
from dataclasses import dataclass
from datetime import UTC
from itertools import pairwise
from pathlib import Path
from typing import Protocol

import cv2
import numpy as np
from numpy.typing import NDArray

from legcal.data.photograph_matching import Photograph, find_photographs, photograph_time
from legcal.errors import DatasetError
from legcal.files.reading import MAX_IMAGE, read_bytes
from legcal.recordings.series import Series, unix_seconds
from legcal.vision.image_file import quiet_opencv

# The decoder of OpenCV reads it once: quiet (AV_LOG_QUIET), since damage is reported in a sentence.
os.environ.setdefault("OPENCV_FFMPEG_LOGLEVEL", "-8")

VIDEOS = (".mp4", ".mov", ".avi", ".mkv", ".m4v", ".webm", ".mpg", ".mpeg", ".mts", ".wmv")
MAX_FRAMES = 1_000_000
# A Unix time: seconds with a fraction after a point, or after _ in ms, us or ns; or whole s, ms, us
# or ns.
_STAMP = re.compile(
    r"(?<!\d)(?:(\d{10})(?:\.(\d{1,9})|_(\d{3}|\d{6}|\d{9}))(?!\d)|(\d{10,19}))", re.ASCII
)
_LOST = 0.02  # share of missing frames of a video, below which its length is just rounded


@dataclass(frozen=True, eq=False)
class Frame:
    """A frame of a recording."""

    time: float  # [s] by the clock of the recording
    image: NDArray[np.uint8]  # (height, width) or (height, width, 3) in the colour order of OpenCV


class Recording(Protocol):
    """A recording of a camera at one place."""

    @property
    def path(self) -> Path:
        """The file or folder."""

    def frames(self, only: Container[int] | None = None) -> Iterator[Frame]:
        """Yield the frames in the order of their times, or *only* the frames with these indices.

        Each call starts at the first frame.
        """

    def notes(self) -> tuple[str, ...]:
        """Return notes, after all frames have been read."""

    def readings(self) -> Series | None:
        """Return the readings in the recording, if any."""


def _reader() -> int:
    """Return the id of FFmpeg if OpenCV has it.

    Other backends, which OpenCV tries on files that FFmpeg cannot read, print damage to stderr.
    """
    has_ffmpeg = cv2.videoio_registry.hasBackend(cv2.CAP_FFMPEG)
    return cv2.CAP_FFMPEG if has_ffmpeg else cv2.CAP_ANY


class Video:
    """A video file, read with OpenCV."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self._notes: tuple[str, ...] = ()

    def frames(self, only: Container[int] | None = None) -> Iterator[Frame]:
        """Yield the frames; a video without any is refused."""
        with quiet_opencv():
            video = cv2.VideoCapture(str(self.path), _reader())
            video.set(cv2.CAP_PROP_ORIENTATION_AUTO, 0)  # as in the calibration of its camera
            promised = video.get(cv2.CAP_PROP_FRAME_COUNT) if video.isOpened() else 0
            rate = video.get(cv2.CAP_PROP_FPS) if video.isOpened() else 0
            count, last = 0, -np.inf
            try:
                while video.isOpened() and count < MAX_FRAMES:
                    if not video.grab():
                        break
                    if only is not None and count not in only:
                        count += 1
                        continue
                    is_read, image = video.retrieve()
                    if not is_read:
                        break
                    time = 1e-3 * video.get(cv2.CAP_PROP_POS_MSEC)  # time of the frame just read
                    if time <= last:  # a container without times
                        time = last + 1.0 / (rate or 30.0)
                    last = time
                    count += 1
                    yield Frame(time, np.asarray(image, dtype=np.uint8))
            finally:
                video.release()
        if count == 0:
            raise DatasetError(
                f"{self.path}: the video could not be read: found no frame in it, needed a "
                "complete video that OpenCV reads; copy it again, or write it anew "
                "(ffmpeg -i IN -c:v libx264 -qp 0 OUT.mp4)."
            )
        if only is None and count < (1.0 - _LOST) * promised - 1:
            self._notes = (
                f"{self.path} ends after {count} of {promised:.0f} frames: it is cut off or "
                "damaged there; copy it again to use the rest.",
            )

    def notes(self) -> tuple[str, ...]:
        """Return a note if the video was cut off."""
        return self._notes

    def readings(self) -> Series | None:
        """Return None: a video holds no readings."""
        return None


class ImageFolder:
    """A folder of images with times in their names or EXIF data."""

    def __init__(self, path: Path) -> None:
        self.path = path

    def frames(self, only: Container[int] | None = None) -> Iterator[Frame]:
        """Yield the images in the order of their times."""
        photographs = find_photographs(self.path)
        times = {p.name: stamp_in(p.path.stem) or _taken(p) for p in photographs}
        lost = [name for name, time in times.items() if time is None]
        if lost:
            raise DatasetError(
                f"{self.path}: {lost[0]} could not be used: found no time in its name or EXIF "
                "data, needed one for each image (a Unix time in the name, or the date of the "
                "camera); for photographs of single poses use legcal init."
            )
        ordered = sorted(photographs, key=lambda p: times[p.name] or 0.0)
        for before, after in pairwise(ordered):
            if times[before.name] == times[after.name]:
                raise DatasetError(
                    f"{self.path}: {after.name} could not be used: found the time of {before.name} "
                    "again, needed one of its own for each image; write the fraction of the second "
                    "into the names, as in 1700000000.125.png."
                )
        for number, photograph in enumerate(ordered):
            if only is not None and number not in only:
                continue
            content = np.frombuffer(read_bytes(photograph.path, MAX_IMAGE), dtype=np.uint8)
            with quiet_opencv():
                image = cv2.imdecode(content, cv2.IMREAD_COLOR | cv2.IMREAD_IGNORE_ORIENTATION)
            if image is None:
                raise DatasetError(
                    f"{photograph.path}: the image could not be read: found bytes that are no "
                    "complete PNG, JPEG or TIFF; copy it again or remove it."
                )
            yield Frame(times[photograph.name] or 0.0, np.asarray(image, dtype=np.uint8))

    def notes(self) -> tuple[str, ...]:
        """Return no notes."""
        return ()

    def readings(self) -> Series | None:
        """Return None: images hold no readings."""
        return None


def _taken(photograph: Photograph) -> float | None:
    """Return the time of a photograph [s], from its EXIF data."""
    moment = photograph_time(photograph)
    return None if moment is None else moment.replace(tzinfo=UTC).timestamp()


def stamp_in(text: str) -> float | None:
    """Return the last Unix time [s] in a text, in any unit, or None."""
    stamps = _STAMP.findall(text)
    if not stamps:
        return None
    seconds, after_point, after_line, whole = stamps[-1]
    return unix_seconds(float(whole)) if whole else float(f"{seconds}.{after_point or after_line}")
