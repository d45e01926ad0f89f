"""Recordings of a camera (videos, folders of images, bags), frame by frame, and of readings.

Bags are those of ROS 1 and 2, and MCAP files: images of one topic, and joint states. For a bag of
several cameras, append the topic of one: ``run.mcap:/left/image_raw``.

Photographs may also arrive one by one: in a watched folder, or from a camera at this machine.
"""

from __future__ import annotations

import os
import re
import tempfile
from collections.abc import Callable, Container, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from importlib.util import find_spec
from itertools import pairwise
from pathlib import Path
from time import monotonic, sleep
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from legcal.data.image_choice import seconds_in, unix_seconds
from legcal.data.photograph_matching import find_photographs, photograph_time
from legcal.data.readings_sheet import ReadingsSheet
from legcal.errors import DatasetError, OutOfResources, UsageError
from legcal.files.schema import HEIC_SUFFIXES, MAX_IMAGE, SUFFIXES, describe, read_bytes
from legcal.files.table import is_number
from legcal.geometry.types import Array
from legcal.machine.model import Machine
from legcal.vision.image_file import (
    COPY_AGAIN,
    BadImage,
    image_size,
    quiet_opencv,
)

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
_BAGS = (".bag", ".mcap", ".db3")
_METADATA = "metadata.yaml"
_IMAGES = ("sensor_msgs/msg/Image", "sensor_msgs/msg/CompressedImage")
_JOINTS = ("sensor_msgs/msg/JointState",)
_USUAL_JOINTS = "/joint_states"  # the preferred topic of several
_COLOURS = {
    "rgb8": cv2.COLOR_RGB2BGR,
    "rgba8": cv2.COLOR_RGBA2BGR,
    "bgra8": cv2.COLOR_BGRA2BGR,
    "bayer_rggb8": cv2.COLOR_BayerRGGB2BGR,
    "bayer_bggr8": cv2.COLOR_BayerBGGR2BGR,
    "bayer_gbrg8": cv2.COLOR_BayerGBRG2BGR,
    "bayer_grbg8": cv2.COLOR_BayerGRBG2BGR,
}
_CHANNELS = {"mono8": 1, "8UC1": 1, "bgr8": 3, "8UC3": 3, "rgb8": 3, "rgba8": 4, "bgra8": 4}


@dataclass(frozen=True, eq=False)
class Frame:
    """A frame of a recording."""

    time: float  # [s] by the clock of the recording
    image: NDArray[np.uint8]  # (height, width) or (height, width, 3) in the colour order of OpenCV


class Recording:
    """A recording of a camera at one place."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.notes: tuple[str, ...] = ()  # after all frames have been read

    def frames(self, only: Container[int] | None = None) -> Iterator[Frame]:
        """Yield the frames in the order of their times, or *only* the frames with these indices.

        Each call starts at the first frame.
        """
        raise NotImplementedError

    def readings(self) -> Series | None:
        """Return the readings in the recording, if any."""
        return None


class Video(Recording):
    """A video file, read with OpenCV."""

    def frames(self, only: Container[int] | None = None) -> Iterator[Frame]:
        """Yield the frames; a video without any is refused."""
        with quiet_opencv():
            # Other backends, which OpenCV tries if FFmpeg cannot read a file, print to stderr.
            has_ffmpeg = cv2.videoio_registry.hasBackend(cv2.CAP_FFMPEG)
            reader = cv2.CAP_FFMPEG if has_ffmpeg else cv2.CAP_ANY
            video = cv2.VideoCapture(str(self.path), reader)
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
            self.notes = (
                f"{self.path} ends after {count} of {promised:.0f} frames: it is cut off or "
                "damaged there; copy it again to use the rest.",
            )


class ImageFolder(Recording):
    """A folder of images with times in their names or EXIF data."""

    def frames(self, only: Container[int] | None = None) -> Iterator[Frame]:
        """Yield the images in the order of their times."""
        photographs = find_photographs(self.path)
        times = {p.name: stamp_in(p.path.stem) or photograph_time(p) for p in photographs}
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


def stamp_in(text: str) -> float | None:
    """Return the last Unix time [s] in a text, in any unit, or None."""
    stamps = _STAMP.findall(text)
    if not stamps:
        return None
    seconds, after_point, after_line, whole = stamps[-1]
    return unix_seconds(float(whole)) if whole else float(f"{seconds}.{after_point or after_line}")


def is_bag(path: Path) -> bool:
    """Return whether a path is a bag."""
    return path.suffix.lower() in _BAGS or (path / _METADATA).is_file()


def split_topic(path: Path) -> tuple[Path, str | None]:
    """Return the path of a recording, and the topic appended to it."""
    file, colon, topic = str(path).rpartition(":/")
    return (Path(file), f"/{topic}") if colon and is_bag(Path(file)) else (path, None)


class Bag(Recording):
    """A bag with the images of one camera and, unless given in a table, joint states."""

    def __init__(self, path: Path, machine: Machine, image_topic: str | None = None) -> None:
        if find_spec("rosbags") is None:
            raise UsageError(
                f"{path}: the bag could not be read: found no package rosbags, needed it; install "
                "it with: pip install 'legcal[ros]'"
            )
        super().__init__(path)
        self._machine = machine
        self._image_topic = image_topic

    def frames(self, only: Container[int] | None = None) -> Iterator[Frame]:
        """Yield the images in the order of the bag; damaged images are skipped and counted."""
        n_bad, last, number = 0, -np.inf, -1
        messages = self._messages(
            "images",
            _IMAGES,
            self._image_topic,
            lambda first: f"name it behind the bag, {self.path}:{first}, or give another bag",
        )
        for time, kind, message in messages:
            image = _image(message) if kind == _IMAGES[0] else _decoded(message)
            if image is None or time <= last:
                n_bad += 1
                continue
            last, number = time, number + 1
            if only is None or number in only:
                yield Frame(time, image)
        if n_bad:
            images, were = ("image", "was") if n_bad == 1 else ("images", "were")
            self.notes = (
                f"{n_bad} {images} of {self.path} {were} left out: damaged, of an unknown "
                "encoding, or not later than the one before.",
            )

    def readings(self) -> Series | None:
        """Return the joint states, None if the bag holds none."""
        with self._opened() as reader:
            topics = _topics(reader, _JOINTS)
        if not topics:
            return None
        times, states = [], []
        usual = _USUAL_JOINTS if _USUAL_JOINTS in topics else None
        remedy = f"call it {_USUAL_JOINTS}, or give the readings as a table with --readings"
        for time, _, message in self._messages("joint states", _JOINTS, usual, lambda _: remedy):
            times.append(time)
            states.append(dict(zip(message.name, map(float, message.position), strict=False)))
        return series_of_joints(f"{self.path}, joint states", times, states, self._machine)

    def _messages(
        self, noun: str, kinds: tuple[str, ...], stated: str | None, remedy: Callable[[str], str]
    ) -> Iterator[tuple[float, str, Any]]:
        """Yield time [s], type and content of the messages of the stated topic, or the only one."""
        with self._opened() as reader:
            topics = _topics(reader, kinds)
            topic = topics[0] if stated is None and len(topics) == 1 else stated
            if topic not in topics:
                found = ", ".join(map(describe, topics)) or "no topic"
                missing = f"no topic {describe(stated)}, but " * (stated is not None)
                raise DatasetError(
                    f"{self.path}: the {noun} could not be read: found {missing}{found} with them, "
                    f"needed one; {remedy(topics[0] if topics else '/TOPIC')}."
                )
            chosen = [c for c in reader.connections if c.topic == topic]
            for connection, stamp, raw in reader.messages(connections=chosen):
                message = reader.deserialize(raw, connection.msgtype)
                yield _time(message, stamp), connection.msgtype, message

    @contextmanager
    def _opened(self) -> Iterator[Any]:
        """Open the bag; errors of the library are reported in one sentence."""
        from rosbags.highlevel import AnyReader, AnyReaderError
        from rosbags.typesys import Stores, get_typestore

        try:
            with AnyReader([self.path], default_typestore=get_typestore(Stores.LATEST)) as reader:
                yield reader
        except (AnyReaderError, OSError, ValueError, EOFError) as error:
            lines = str(error).strip().splitlines()
            raise DatasetError(
                f"{self.path}: the bag could not be read: found "
                f"{describe(lines[0]) if lines else 'an error'}, needed a complete bag of ROS 1 "
                "(.bag) or 2 (its folder, .mcap); close its recording in order, or repair it "
                "(rosbag reindex, ros2 bag reindex, mcap recover)."
            ) from error


def _topics(reader: Any, kinds: tuple[str, ...]) -> list[str]:
    """Return the topics of messages of some kinds."""
    return list(dict.fromkeys(c.topic for c in reader.connections if c.msgtype in kinds))


def _time(message: Any, recorded: int) -> float:
    """Return the time of a message [s]: from its header, else from the recording."""
    stamp = message.header.stamp
    made = float(stamp.sec) + 1e-9 * float(stamp.nanosec)
    return made if made > 0.0 else 1e-9 * recorded


def _image(message: Any) -> NDArray[np.uint8] | None:
    """Return a raw image, None if it is damaged or of an unsupported encoding."""
    rows, columns, step = int(message.height), int(message.width), int(message.step)
    encoding = message.encoding
    data = np.asarray(message.data)
    if encoding in ("mono16", "16UC1"):
        order = ">u2" if message.is_bigendian else "<u2"
        if step % 2 or data.nbytes < rows * step or step < 2 * columns:
            return None
        deep = np.frombuffer(data.tobytes(), dtype=order)[: rows * step // 2]
        return np.asarray(deep.reshape(rows, step // 2)[:, :columns] >> 8, dtype=np.uint8)
    channels = 1 if encoding.startswith("bayer_") else _CHANNELS.get(encoding, 0)
    is_supported = encoding in _CHANNELS or encoding in _COLOURS
    if (
        not is_supported
        or min(rows, columns) < 1
        or step < columns * channels
        or data.size < rows * step
    ):
        return None
    image = data[: rows * step].reshape(rows, step)[:, : columns * channels]
    shaped = image if channels == 1 else image.reshape(rows, columns, channels)
    code = _COLOURS.get(encoding)
    shaped = np.ascontiguousarray(shaped, dtype=np.uint8)
    return shaped if code is None else np.asarray(cv2.cvtColor(shaped, code), dtype=np.uint8)


def _decoded(message: Any) -> NDArray[np.uint8] | None:
    """Return a compressed image, None if it is damaged."""
    with quiet_opencv():
        image = cv2.imdecode(np.asarray(message.data, dtype=np.uint8), cv2.IMREAD_COLOR)
    return None if image is None else np.asarray(image, dtype=np.uint8)


# Readings over time: a table with a column of times, or joint states


@dataclass(frozen=True, eq=False)
class Series:
    """Readings of all encoders at times."""

    source: str  # source of the readings, for messages
    times: Array  # (n,) increasing times [s], by their own clock
    q: Array  # (n, n_motors) readings [m or rad], in the order of the actuated legs
    unit: str = "m"  # unit in the table and its origin, in words
    notes: tuple[str, ...] = ()

    def in_order(self) -> Series:
        """Return the readings in the order of their times; of equal times the first is kept."""
        times, first = np.unique(self.times, return_index=True)
        if len(times) < 3:
            raise DatasetError(
                f"{self.source}: the readings could not be used: found {len(times)} different "
                "times, needed the readings of the whole recording, some each second; record them "
                "again."
            )
        return replace(self, times=times, q=self.q[first])


def read_series(path: Path, machine: Machine, *, lengths: bool = False) -> Series:
    """Return the readings of a CSV with a column of times, in the order of times."""
    sheet = ReadingsSheet(path, machine, "time")
    if "time" not in sheet.table:
        raise DatasetError(
            f"{path}: the readings could not be used: found no column 'time', needed one in "
            "seconds or as dates; add it or call it so, or use legcal init for photographs of "
            f"single poses. {' '.join(sheet.notes)}".rstrip()
        )
    readings, texts = sheet.readings(lengths=lengths), sheet.table.text("time")
    # Digits alone are no dates here: 12121000 may be the milliseconds of a controller.
    times = [unix_seconds(float(x)) if is_number(x) else seconds_in(x) for x in texts]
    are_numbers = is_number(texts[0])
    for text, time in zip(texts, times, strict=True):
        if time is None or is_number(text) is not are_numbers:
            raise DatasetError(
                f"{path}, column {sheet.table.heading('time')}: the time could not be read: found "
                f"{describe(text)}, needed seconds, Unix times or dates such as "
                "2026-11-23T10:15:00.125, one form in all rows; correct it."
            )
    in_words, notes = f"{readings.unit}, {readings.unit_from}", (*sheet.notes, *readings.notes)
    series = Series(str(path), np.array(times, dtype=float), readings.q, in_words, notes)
    return series.in_order()


def series_of_joints(
    source: str, times: Sequence[float], states: Sequence[Mapping[str, float]], machine: Machine
) -> Series:
    """Return the readings of joint states: positions [m or rad] by joint name."""
    joints = machine.motor_names
    complete = [k for k, state in enumerate(states) if all(name in state for name in joints)]
    if not complete:
        names = sorted({name for state in states for name in state})
        missing = [name for name in joints if name not in names]
        raise DatasetError(
            f"{source}: the readings could not be used: found the joints "
            f"{', '.join(map(describe, names[:10])) or 'none'}, needed "
            f"{', '.join(missing or joints)} in one message; rename the joints of the model or "
            "give a table with --readings."
        )
    q = np.array([[states[k][name] for name in joints] for k in complete], dtype=float)
    if not np.isfinite(q).all():
        raise DatasetError(
            f"{source}: the readings could not be used: found one that is no finite number, needed "
            "positions in metres; record them again."
        )
    return Series(source, np.array([times[k] for k in complete], dtype=float), q).in_order()


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
        begin, before = monotonic(), None
        while monotonic() < begin + PATIENCE:
            is_read, frame = self._camera.read()
            if not is_read:
                break
            if before is not None and agree(before, frame):
                self._n += 1
                path = Path(self._folder.name) / f"frame{self._n}.png"
                cv2.imwrite(str(path), frame)
                return path
            before = frame
            sleep(_PAUSE)
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
