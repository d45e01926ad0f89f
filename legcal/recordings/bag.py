"""Bags of ROS 1 and 2, and MCAP files: images of one topic, and joint states.

For a bag of several cameras, append the topic of one: ``run.mcap:/left/image_raw``.
"""

from __future__ import annotations

from collections.abc import Callable, Container, Iterator, Sequence
from contextlib import contextmanager
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from legcal.errors import DatasetError, UsageError
from legcal.files.schema import describe
from legcal.machine.model import Machine
from legcal.recordings.frames import Frame
from legcal.recordings.series import Series, series_of_joints
from legcal.vision.image_file import quiet_opencv

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


def is_bag(path: Path) -> bool:
    """Return whether a path is a bag."""
    return path.suffix.lower() in _BAGS or (path / _METADATA).is_file()


def split_topic(path: Path) -> tuple[Path, str | None]:
    """Return the path of a recording, and the topic appended to it."""
    file, colon, topic = str(path).rpartition(":/")
    return (Path(file), f"/{topic}") if colon and is_bag(Path(file)) else (path, None)


class Bag:
    """A bag with the images of one camera and, unless given in a table, joint states."""

    def __init__(self, path: Path, machine: Machine, image_topic: str | None = None) -> None:
        if find_spec("rosbags") is None:
            raise UsageError(
                f"{path}: the bag could not be read: found no package rosbags, needed it; install "
                "it with: pip install 'legcal[ros]'"
            )
        self.path = path
        self._machine = machine
        self._image_topic = image_topic
        self._bad = 0

    def frames(self, only: Container[int] | None = None) -> Iterator[Frame]:
        """Yield the images in the order of the bag; damaged images are skipped and counted."""
        self._bad, last, number = 0, -np.inf, -1
        for time, kind, message in self._messages(_IMAGES, self._topic_of_images):
            image = _image(message) if kind == _IMAGES[0] else _decoded(message)
            if image is None or time <= last:
                self._bad += 1
                continue
            last, number = time, number + 1
            if only is None or number in only:
                yield Frame(time, image)

    def notes(self) -> tuple[str, ...]:
        """Return a note with the number of unusable images, if any."""
        if not self._bad:
            return ()
        images, were = ("image", "was") if self._bad == 1 else ("images", "were")
        return (
            f"{self._bad} {images} of {self.path} {were} left out: damaged, of an unknown "
            "encoding, or not later than the one before.",
        )

    def readings(self) -> Series | None:
        """Return the joint states, None if the bag holds none."""
        with self._opened() as reader:
            if not self._topics(reader, _JOINTS):
                return None
        times, states = [], []
        for time, _, message in self._messages(_JOINTS, self._topic_of_joints):
            times.append(time)
            states.append(dict(zip(message.name, map(float, message.position), strict=False)))
        return series_of_joints(f"{self.path}, joint states", times, states, self._machine)

    def _topic_of_images(self, topics: Sequence[str]) -> str:
        """Return the topic of the images: the stated one, or the only one."""
        if self._image_topic is not None and self._image_topic not in topics:
            raise UsageError(
                f"{self.path}: the images could not be read: found no topic "
                f"{describe(self._image_topic)} with them, needed "
                f"{', '.join(map(describe, topics)) or 'one'}; correct the name."
            )
        if self._image_topic is None and len(topics) != 1:
            stated = ", ".join(map(describe, topics)) or "no topic"
            remedy = f"name it behind the bag, {self.path}:{topics[0]}" if topics else (
                "give another bag")  # fmt: skip
            raise DatasetError(
                f"{self.path}: the images could not be read: found {stated} with them, needed one; "
                f"{remedy}."
            )
        return self._image_topic or topics[0]

    def _topic_of_joints(self, topics: Sequence[str]) -> str:
        """Return the topic of the joint states: the only one, or the one with the usual name."""
        if len(topics) > 1 and _USUAL_JOINTS not in topics:
            raise DatasetError(
                f"{self.path}: the joint states could not be read: found "
                f"{', '.join(map(describe, topics))} with them, needed one or {_USUAL_JOINTS}; "
                "give the readings as a table with --readings."
            )
        return topics[0] if len(topics) == 1 else _USUAL_JOINTS

    def _messages(
        self, kinds: tuple[str, ...], choose: Callable[[Sequence[str]], str]
    ) -> Iterator[tuple[float, str, Any]]:
        """Yield time [s], type and content of the messages of one topic."""
        with self._opened() as reader:
            topic = choose(self._topics(reader, kinds))
            chosen = [c for c in reader.connections if c.topic == topic]
            for connection, stamp, raw in reader.messages(connections=chosen):
                message = reader.deserialize(raw, connection.msgtype)
                yield _time(message, stamp), connection.msgtype, message

    def _topics(self, reader: Any, kinds: tuple[str, ...]) -> list[str]:
        return list(dict.fromkeys(c.topic for c in reader.connections if c.msgtype in kinds))

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
