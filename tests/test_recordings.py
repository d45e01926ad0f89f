"""Videos, folders of frames and bags with readings become datasets of the poses that were held."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from command_line import Outcome, run
from simulated import small_camera

from legcal import import_recordings, load_dataset, load_mechanism
from legcal.geometry.types import Array
from legcal.recordings.frames import VIDEOS, read_series, stamp_in

MODEL = "hexapod"
SIZE = 96, 64  # [px]
RATE = 20.0  # frames a second
AHEAD = 7.31  # [s] of the camera's clock


@dataclass(frozen=True, eq=False)
class Motion:
    """A machine that rests at poses for times of different length."""

    times: Array
    s: Array  # which pose, between them while it moves
    q: Array  # (n_poses, n_motors) readings [m]

    @property
    def rests(self) -> int:
        return len(self.q)

    def readings(self, times: Array) -> Array:
        """Return readings with the noise of an encoder."""
        s = np.interp(times, self.times, self.s)
        k = np.clip(np.floor(s).astype(int), 0, self.rests - 2)
        q = self.q[k] + (s - k)[:, None] * (self.q[k + 1] - self.q[k])
        return np.asarray(q + np.random.default_rng(1).normal(scale=1e-6, size=q.shape))

    def frame(self, time: float, rng: np.random.Generator) -> Array:
        """Return a picture in which a bar stands where the machine is, with pixel noise."""
        x = 8.0 + 7.0 * float(np.interp(time, self.times, self.s))
        across = np.arange(SIZE[0])[None, :]
        grey = 60.0 + 120.0 / (1.0 + np.exp(-np.abs(across - x) + 4.0)) * np.ones((SIZE[1], 1))
        noise = rng.normal(scale=1.5, size=(SIZE[1], SIZE[0]))
        return np.asarray(np.clip(grey + noise, 0, 255)[..., None].repeat(3, 2), dtype=np.uint8)


@pytest.fixture(scope="module")
def motion() -> Motion:
    machine = load_mechanism(MODEL)
    rng = np.random.default_rng(7)
    low, high = np.array([leg.travel for leg in machine.legs]).T
    q = low + (high - low) * rng.uniform(0.2, 0.8, (10, len(low)))
    times, s = [0.0], [0.0]
    for k in range(10):
        times.append(times[-1] + rng.uniform(0.8, 2.5))
        s.append(k)
        if k < 9:
            times.append(times[-1] + rng.uniform(0.4, 0.9))
            s.append(k + 1)
    return Motion(np.array(times), np.array(s, dtype=float), q)


def _table(motion: Motion, path: Path, times: Array) -> Path:
    joints = load_mechanism(MODEL).motor_names
    rows = [",".join([f"{t + 1.7e9:.4f}", *(f"{1e3 * x:.6f}" for x in q)])
            for t, q in zip(times, motion.readings(times), strict=True)]  # fmt: skip
    path.write_text("\n".join([",".join(["time", *joints]), *rows]))
    return path


def _stamps(motion: Motion) -> Array:
    return np.arange(0.5, motion.times[-1] - 0.3, 1.0 / RATE)


@cache
def _frames(motion: Motion) -> list[Array]:
    rng = np.random.default_rng(0)
    return [motion.frame(time, rng) for time in _stamps(motion)]


def _video(motion: Motion, folder: Path) -> Path:
    path = folder / "c1.avi"
    assert path.suffix in VIDEOS
    video = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"MJPG"), RATE, SIZE)
    for frame in _frames(motion):
        video.write(frame)
    video.release()
    return path


def _folder(motion: Motion, folder: Path) -> Path:
    (place := folder / "c1").mkdir()
    for time, frame in zip(_stamps(motion), _frames(motion), strict=True):
        stamp = round(1e9 * (1.7e9 + AHEAD)) + round(1e9 * time)
        cv2.imwrite(str(place / f"{stamp}.png"), frame)
    return place


def _bag(motion: Motion, folder: Path, **extra: str) -> Path:
    rosbags = pytest.importorskip("rosbags.rosbag2", reason="the package rosbags is not there")
    from rosbags.typesys import Stores, get_typestore

    store = get_typestore(Stores.ROS2_HUMBLE)
    joints = load_mechanism(MODEL).motor_names
    types = store.types
    header, stamp = types["std_msgs/msg/Header"], types["builtin_interfaces/msg/Time"]

    def at(time: float) -> tuple[int, Any]:
        ns = round(1e9 * time) + 1_700_000_000 * 10**9
        return ns, header(stamp(sec=ns // 10**9, nanosec=ns % 10**9), "")

    path = folder / "c1"
    with rosbags.Writer(path, version=9) as writer:
        image = types["sensor_msgs/msg/Image"]
        state = types["sensor_msgs/msg/JointState"]
        pictures = writer.add_connection("/camera", image.__msgtype__, typestore=store)
        states = writer.add_connection("/joint_states", state.__msgtype__, typestore=store)
        for topic in extra.values():
            writer.add_connection(topic, image.__msgtype__, typestore=store)
        none = np.zeros(0)
        times = np.arange(0.2, motion.times[-1], 0.02)
        for time, q in zip(times, motion.readings(times), strict=True):
            ns, head = at(time)
            message = state(head, joints, q, none, none)
            writer.write(states, ns, store.serialize_cdr(message, state.__msgtype__))
        for time, picture in zip(_stamps(motion), _frames(motion), strict=True):
            ns, head = at(time)
            message = image(head, SIZE[1], SIZE[0], "bgr8", 0, 3 * SIZE[0], picture.reshape(-1))
            writer.write(pictures, ns, store.serialize_cdr(message, image.__msgtype__))
    return path


@pytest.fixture
def import_(tmp_path: Path) -> Iterator[Callable[..., Outcome]]:
    """Import into a folder ``dataset``."""
    given = (
        "--model",
        MODEL,
        "--camera",
        small_camera(tmp_path, *SIZE),
        "-o",
        tmp_path / "dataset",
    )
    yield lambda *words: run("import", *words, *given)
    left = [p.name for p in tmp_path.iterdir() if p.name.endswith(".legcal-part")]
    assert left == []


@pytest.mark.parametrize("kind", ["video", "folder", pytest.param("bag", marks=pytest.mark.system)])
def test_poses_that_were_held_become_rows(
    motion: Motion, tmp_path: Path, import_: Callable[..., Outcome], kind: str
) -> None:
    source = {"video": _video, "folder": _folder, "bag": _bag}[kind](motion, tmp_path)
    words = [] if kind == "bag" else ["--readings", _ticks(motion, tmp_path)]
    assert import_(source, *words).code == 0
    folder = tmp_path / "dataset"
    dataset = load_dataset(folder)
    found = dataset.measurements.q
    assert [view.name for view in dataset.measurements.views] == ["c1"]
    assert len(found) == motion.rests
    assert np.abs(found - motion.q).max() < 3e-6
    sigma = dataset.measurements.sigma_q
    assert sigma.min() > 3e-7
    assert sigma.max() < 3e-6
    shown = [np.asarray(cv2.imread(str(folder / image)))[:, :, 0].mean(axis=0) for image in
             dataset.measurements.image]  # fmt: skip
    dark = [int(np.argmin(np.convolve(row, np.ones(5), "same")[4:-4])) + 4 for row in shown]
    assert np.abs(np.array(dark) - (8.0 + 7.0 * np.arange(10))).max() <= 2.0
    if kind == "folder":
        again = import_recordings(
            source, MODEL, tmp_path / "again",
            cameras=small_camera(tmp_path, *SIZE), readings=str(words[1]),
        )  # fmt: skip
        np.testing.assert_array_equal(again.measurements.q, found)


def test_clocks_are_compared_by_motion_and_json_tells_what_was_left_out(
    motion: Motion, tmp_path: Path, import_: Callable[..., Outcome]
) -> None:
    times = np.arange(0.0, motion.times[-1], 0.02)
    begin, end = motion.times[6], motion.times[7]  # of a rest without readings
    table = _table(motion, tmp_path / "q.csv", times[(times < begin - 0.1) | (times > end + 0.1)])
    outcome = import_(_folder(motion, tmp_path), "--readings", table, "--json")
    assert outcome.code == 0
    found = outcome.document["views"]["c1"]
    assert abs(found["offset_s"] - AHEAD) < 0.05
    assert abs(found["offset_s"] - AHEAD) < 4.0 * found["offset_sigma_s"] + 1.0 / RATE
    assert [still["why_not"] for still in found["stills"]].count("no reading") == 1
    assert found["used"] == motion.rests - 1
    assert load_dataset(tmp_path / "dataset").measurements.n_rows == motion.rests - 1


def test_a_damaged_video_is_told_in_one_sentence_and_times_may_have_a_unit(
    motion: Motion,
    tmp_path: Path,
    import_: Callable[..., Outcome],
    capfd: pytest.CaptureFixture[str],
) -> None:
    video, rng = _video(motion, tmp_path), np.random.default_rng(2)
    content = bytearray(video.read_bytes())
    end = 3 * len(content) // 4
    for k in rng.integers(len(content) // 2, end, 40).tolist():
        content[k : k + 30] = rng.bytes(30)
    video.write_bytes(content[:end])
    table = _ticks(motion, tmp_path)
    rows = [line.split(",", 1) for line in table.read_text().splitlines()]
    ticks = [f"{1e3 * (float(time) - 1.7e9):.1f},{rest}" for time, rest in rows[1:]]
    table.write_text("\n".join([f"Time [ms],{rows[0][1]}", *ticks]))
    outcome = import_(video, "--readings", table, "--offset", "-0.5")
    assert outcome.code == 0
    assert "it is cut off or damaged there" in outcome.said
    assert "@ 0x" not in outcome.err + capfd.readouterr().err  # as the decoder writes
    assert 3 <= len(load_dataset(tmp_path / "dataset").measurements.q) < motion.rests


@pytest.mark.parametrize(
    ("name", "seconds"),
    [
        ("1305031102.175304", 1305031102.175304),
        ("left-1700000000.100", 1700000000.1),
        ("1700000000_100000000", 1700000000.1),
        ("1700000000100000000", 1700000000.1),
        ("frame_1700000000_12", 1700000000.0),  # the number of a frame is no fraction
        ("frame_12", None),
    ],
)
def test_times_in_names_keep_their_fraction(name: str, seconds: float | None) -> None:
    assert stamp_in(name) == seconds


def test_digits_alone_are_no_dates(motion: Motion, tmp_path: Path) -> None:
    """Seconds of a controller pass 20260101, 20260102, which as dates are days apart."""
    table = _table(motion, tmp_path / "q.csv", np.arange(4.0) + 20260101 - 1.7e9)
    table.write_text(table.read_text().replace(".0000,", ","))
    times = read_series(table, load_mechanism(MODEL)).times
    np.testing.assert_allclose(np.diff(times), 1.0)


REFUSALS: dict[str, tuple[Callable[[Motion, Path], tuple[object, ...]], str]] = {
    "no such file": (lambda m, t: (t / "none.mp4",), "found no such file"),
    "another format": (lambda m, t: (_written(t / "a.txt", b"x"),), "found a file ending in"),
    "cut-off video": (lambda m, t: (_written(t / "a.mp4", b"\0" * 99), "--readings",
                                    _ticks(m, t)), "found no frame in it"),
    "damaged bag": (lambda m, t: (_written(t / "a.bag", b"\0" * 99),), "a complete bag"),
    "no readings": (lambda m, t: (_video(m, t),), "give it with --readings"),
    "no times": (lambda m, t: (_video(m, t), "--readings", _timeless(m, t)), "no column 'time'"),
    "nothing moves": (lambda m, t: (_video(m, t), "--readings", _resting(m, t)),
                      "readings that change at one rate all the time"),
    "other motion": (lambda m, t: (_video(m, t), "--readings", _other(m, t)),
                     "needed the readings of the same time"),
    "no such topic": (lambda m, t: (f"{_bag(m, t)}:/other",), "found no topic '/other'"),
    "two topics": (lambda m, t: (_bag(m, t, second="/second"),), "c1:/camera"),
    "no overlap": (lambda m, t: (_video(m, t), "--readings", _ticks(m, t), "--offset", "1e6"),
                   "needed times that overlap"),
    "no camera file": (lambda m, t: (_video(m, t), "--readings", _ticks(m, t),
                                     "--camera", f"c1={t / 'nope.yaml'}"), "nope.yaml"),
    "no offset": (lambda m, t: (_video(m, t), "--readings", _ticks(m, t), "--offset", "nan"),
                  "correct --offset"),
    "a row without a time": (lambda m, t: (_video(m, t), "--readings", _holed(m, t)),
                             "column Uhrzeit [s]: the time could not be read: found '',"),
}  # fmt: skip


def _written(path: Path, content: bytes) -> Path:
    path.write_bytes(content)
    return path


def _ticks(motion: Motion, folder: Path) -> Path:
    return _table(motion, folder / "q.csv", np.arange(0.0, motion.times[-1], 0.02))


def _timeless(motion: Motion, folder: Path) -> Path:
    path = _ticks(motion, folder)
    path.write_text("\n".join(line.split(",", 1)[1] for line in path.read_text().splitlines()))
    return path


def _holed(motion: Motion, folder: Path) -> Path:
    path = _ticks(motion, folder)
    first, second, *others = path.read_text().splitlines()
    first = first.replace("time", "Uhrzeit [s]")
    path.write_text("\n".join([first, second[second.index(",") :], *others]))
    return path


def _resting(motion: Motion, folder: Path) -> Path:
    return _table(motion, folder / "q.csv", np.arange(0.0, motion.times[1], 0.02))


def _other(motion: Motion, folder: Path) -> Path:
    rng = np.random.default_rng(3)
    times = np.concatenate([[0.0], np.cumsum(rng.uniform(0.4, 2.5, 19))])
    other = Motion(times, motion.s[np.r_[0 : len(times)]], motion.q)
    return _table(other, folder / "q.csv", np.arange(0.0, times[-1], 0.02))


@pytest.mark.parametrize("name", REFUSALS)
def test_what_cannot_be_imported_is_refused(
    motion: Motion,
    tmp_path: Path,
    import_: Callable[..., Outcome],
    capfd: pytest.CaptureFixture[str],
    name: str,
) -> None:
    words, said = REFUSALS[name]
    outcome = import_(*words(motion, tmp_path))
    assert outcome.code in (1, 2)
    assert said in outcome.said
    error = outcome.err + capfd.readouterr().err
    assert "Traceback" not in error
    assert "Unexpected element" not in error  # as readers of OpenCV write
    assert not (tmp_path / "dataset").exists()
