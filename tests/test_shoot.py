"""Guided shooting: photographs that arrive become a dataset, one by one."""

import errno
import json
import shutil
import threading
import time
import urllib.request
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from command_line import run as run_command
from csv_rows import read_rows, write_rows
from hexapod_example import HEXAPOD, copy_of_the_example

import legcal
from legcal.data.dataset import load_dataset
from legcal.errors import OutOfResources, UsageError
from legcal.files import folder
from legcal.files.folder import write_atomically
from legcal.geometry.types import Array
from legcal.planning import shooting
from legcal.planning.shooting import Asked, GuidedSession
from legcal.recordings import frames as recordings
from legcal.recordings.frames import LiveCamera, WatchedFolder
from legcal.viewer import shooting as dialogues
from legcal.viewer.server import TOKEN_HEADER
from legcal.viewer.shooting import Dialogue, DialogueServer

PATIENCE = 60.0  # [s]


@pytest.fixture
def session(tmp_path: Path) -> Path:
    """The example as a plan: four poses of a view, one of another, no photograph yet."""
    folder = copy_of_the_example(tmp_path / "session")
    shutil.rmtree(folder / "images")
    rows = read_rows(folder / "measurements.csv")
    write_rows(folder / "measurements.csv", [*rows[:4], rows[15]])
    return folder


@pytest.fixture
def labelled(session: Path) -> Path:
    """The same plan with labels of poses."""
    rows = read_rows(session / "measurements.csv")
    for k, row in enumerate(rows, start=1):
        row["pose"] = f"p{k}"
    write_rows(session / "measurements.csv", rows)
    return session


@contextmanager
def talking(session: Path, watched: Path) -> Iterator[Dialogue]:
    """Run the dialogue of a session in a thread, until the block ends."""
    watched.mkdir(exist_ok=True)
    dialogue = Dialogue(GuidedSession(session), WatchedFolder(watched), lambda _: None)
    thread = threading.Thread(target=dialogue.run)
    thread.start()
    try:
        yield dialogue
    finally:
        dialogue.words.put("quit")
        thread.join(PATIENCE)


def heard(dialogue: Dialogue, text: str) -> str:
    """Wait for a line that holds a text, and return it."""
    end = time.monotonic() + PATIENCE
    while time.monotonic() < end:
        for line in list(dialogue.lines):
            if text in line:
                return line
        time.sleep(0.02)
    pytest.fail(f"'{text}' was not said, but {dialogue.lines}")


def asked(session: GuidedSession) -> Asked:
    """Return the photograph that a session asks for."""
    found = session.next()
    assert found is not None
    return found


def photograph(name: str) -> bytes:
    """Return a photograph of the example."""
    return (HEXAPOD / "images" / f"{name}.jpg").read_bytes()


def test_only_complete_sharp_photographs_of_the_pose_that_is_asked_are_taken(
    session: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(dialogues, "PAUSE", 0.05)
    commanded, watched = read_rows(session / "measurements.csv"), tmp_path / "phone"
    watched.mkdir()
    (watched / "last-week.jpg").write_bytes(photograph("c3_k09"))
    with talking(session, watched) as dialogue:
        heard(dialogue, "pose c1_k01")
        half = photograph("c1_k01")
        (watched / "1.jpg").write_bytes(half[: len(half) // 2])
        heard(dialogue, "waiting for the rest of 1.jpg")
        assert read_rows(session / "measurements.csv") == commanded
        (watched / "1.jpg").write_bytes(half)
        heard(dialogue, "1.jpg is c1 c1_k01")
        (watched / "list.jpg").write_text("c1_k02 as planned")
        assert "none of these" in heard(dialogue, "list.jpg was not taken")
        grey = np.asarray(cv2.imread(str(HEXAPOD / "images" / "c1_k02.jpg"), cv2.IMREAD_GRAYSCALE))
        cv2.imwrite(str(watched / "soft.jpg"), cv2.GaussianBlur(grey, (0, 0), 5.0))
        assert "blurred by" in heard(dialogue, "soft.jpg was not taken")
        (watched / "other.jpg").write_bytes(photograph("c1_k07"))
        assert "another pose" in heard(dialogue, "other.jpg was not taken")
        (watched / "again.jpg").write_bytes(half)
        heard(dialogue, "again.jpg was not taken")
        cv2.imwrite(str(watched / "small.jpg"), grey[::2, ::2])
        assert "needed 1024 x 768 px" in heard(dialogue, "small.jpg was not taken")
        dialogue.words.put("undo")  # and take it again
        heard(dialogue, "images/c1_k01.jpg was taken out")
        (watched / "1b.jpg").write_bytes(half)
        heard(dialogue, "1b.jpg is c1 c1_k01")
    assert not list((session / "images").glob("*k02*"))
    with talking(session, watched) as dialogue:  # goes on where it was left
        heard(dialogue, "Photograph 2 of 5: camera at c1, pose c1_k02")
        (watched / "2.JPG").write_bytes(photograph("c1_k02"))
        assert "6 of 6 legs" in heard(dialogue, "2.JPG is c1 c1_k02")
        dialogue.words.put("skip")
        heard(dialogue, "pose c1_k04")
    rows = read_rows(session / "measurements.csv")
    assert rows == commanded[:2]
    loaded = load_dataset(session)  # with the photographs checked
    assert loaded.measurements.image == ("images/c1_k01.jpg", "images/c1_k02.jpg")
    assert len(list(watched.iterdir())) == 9  # copied, not moved


@pytest.mark.system
def test_the_second_photograph_of_a_machine_that_is_off_by_millimetres_is_taken(
    tmp_path: Path,
) -> None:
    off, folder, taken = legcal.Spread(4e-3), tmp_path / "session", tmp_path / "taken"
    errors = legcal.ParameterErrors(base_joints=off, platform_joints=off)
    settings = legcal.SimulationSettings(poses=4, views=1, seed=3, errors=errors)
    legcal.simulate("linear-delta", folder, settings)
    shutil.move(folder / "images", taken)
    session = GuidedSession(folder)
    wrong = tmp_path / "wrong.png"
    for k, path in enumerate(sorted(taken.iterdir())[:3]):
        if k > 0:
            cv2.imwrite(str(wrong), np.asarray(cv2.imread(str(path)))[:, ::-1])
            before = dict(session.cameras)
            assert "at another pose" in " ".join(session.check(asked(session), wrong).problems)
            assert session.cameras == before  # a photograph that is refused places no camera
        found = session.check(asked(session), path)
        assert found.problems == ()
        if k > 0:
            assert found.legs is not None
            assert found.legs.sum() >= 0.6 * found.n_visible > 2.0
        session.accept(asked(session), path, found)


def test_a_photograph_that_finds_no_room_is_kept_by_word_once_there_is_some(
    session: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(dialogues, "PAUSE", 0.05)

    def full(path: Path, content: bytes) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    with talking(session, tmp_path / "phone") as dialogue:
        heard(dialogue, "pose c1_k01")
        monkeypatch.setattr(shooting, "write_atomically", full)
        (tmp_path / "phone/1.jpg").write_bytes(photograph("c1_k01"))
        assert "free some space" in heard(dialogue, "'No space left on device'")
        monkeypatch.setattr(shooting, "write_atomically", write_atomically)
        dialogue.words.put("keep")
        heard(dialogue, "1.jpg is c1 c1_k01")
        monkeypatch.setattr(shooting, "write_atomically", full)
        dialogue.words.put("undo")
        assert "undo it then" in heard(dialogue, "c1_k01.jpg could not be taken out")
        monkeypatch.setattr(shooting, "write_atomically", write_atomically)
        dialogue.words.put("undo")
        heard(dialogue, "c1_k01.jpg was taken out")
        (tmp_path / "phone/2.jpg").write_bytes(photograph("c1_k01"))
        heard(dialogue, "2.jpg is c1 c1_k01")
    assert len(read_rows(session / "measurements.csv")) == 1


def test_a_session_that_takes_no_files_is_refused_before_the_first_photograph(
    session: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def read_only(*_: object) -> None:
        raise OSError(errno.EROFS, "Read-only file system")

    monkeypatch.setattr(folder, "temporary_folder", read_only)
    with pytest.raises(UsageError, match="Read-only file system"):
        GuidedSession(session)


def test_a_session_that_is_killed_between_its_files_goes_on(
    labelled: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    write, guided = write_atomically, GuidedSession(labelled)
    asked = guided.next()
    assert asked is not None

    def killed(path: Path, content: bytes) -> None:
        if path.name == "measurements.csv":
            raise KeyboardInterrupt
        write(path, content)

    monkeypatch.setattr(shooting, "write_atomically", killed)
    with pytest.raises(KeyboardInterrupt):
        guided.accept(asked, HEXAPOD / "images" / "c1_k01.jpg")
    monkeypatch.undo()
    again, left = GuidedSession(labelled), []
    while (asked := again.next()) is not None:
        left.append(asked.pose)
        again.accept(asked, None)
    assert left in (["p1", "p2", "p3", "p4", "p5"], ["p2", "p3", "p4", "p5"])
    assert len(read_rows(labelled / "measurements.csv")) == 5


def test_beyond_the_plan_the_next_pose_determines_more_than_others(labelled: Path) -> None:
    guided = GuidedSession(labelled, target=1e-9)
    for _ in range(5):
        asked = guided.next()
        assert asked is not None
        guided.accept(asked, None)
    before, best = guided.error, guided.next()
    assert before is not None
    assert best is not None
    assert (best.view, best.pose, best.is_planned) == ("c2", "n01", False)
    values = []
    for q in (best.q, *load_dataset(HEXAPOD).measurements.q[16:20]):
        guided.accept(replace(best, q=q), None)
        assert guided.error is not None
        values.append(guided.error.mean_displacement)
        guided.undo()
    assert values[0] < min(values[1:])
    assert max(values) < before.mean_displacement


class Frames:
    """A camera of OpenCV whose machine moves for some frames."""

    def __init__(self, moving: int) -> None:
        self.moving, self.last = moving, np.zeros((0,))

    def isOpened(self) -> bool:
        return True

    def set(self, *_: Any) -> None:
        pass

    release = set

    def read(self) -> tuple[bool, Array]:
        image = np.asarray(cv2.imread(str(HEXAPOD / "images" / "c1_k01.jpg")))
        self.moving -= 1
        rng = np.random.default_rng(abs(self.moving))
        noisy = image + rng.normal(0.0, 3.0, image.shape) + 2.0 * (self.moving % 2)
        self.last = np.roll(noisy, 9 * max(self.moving, 0), axis=1).clip(0, 255).astype(np.uint8)
        return True, self.last


def test_a_camera_photographs_when_two_frames_agree(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(recordings, "_PAUSE", 0.0)
    frames = Frames(4)
    camera = LiveCamera(0, 1024, 768, lambda _: frames)
    assert camera.poll(wanted=False) is None
    path = camera.poll(wanted=True)
    assert path is not None
    assert np.array_equal(np.asarray(cv2.imread(str(path))), frames.last)
    assert frames.moving == -1  # the second frame at rest
    monkeypatch.setattr(recordings, "PATIENCE", 0.5)
    frames.moving = 10**6
    with pytest.raises(OutOfResources, match="frames that still change"):
        camera.poll(wanted=True)
    camera.close()


def test_the_page_shows_what_is_asked_and_takes_words(session: Path, tmp_path: Path) -> None:
    with talking(session, tmp_path / "phone") as dialogue:
        server = DialogueServer(dialogue)
        threading.Thread(target=server.run, daemon=True).start()

        def post(path: str, text: str) -> dict[str, Any]:
            request = urllib.request.Request(
                f"{server.address}/{path}", text.encode(), {TOKEN_HEADER: server.token}
            )
            with urllib.request.urlopen(request) as answer:
                return dict(json.loads(answer.read()))

        with urllib.request.urlopen(str(server.address)) as page:
            assert server.token in page.read().decode()
        heard(dialogue, "c1_k01")
        assert "leg1_prismatic 9.766 mm" in " ".join(post("state", "")["prompt"])
        post("word", "skip")
        heard(dialogue, "pose c1_k02")
        assert "c1_k02" in " ".join(post("state", "")["prompt"])
        server.close()


@pytest.mark.parametrize(
    ("words", "said"),
    [
        ([], "neither of --watch and --camera"),
        (["--watch", "missing"], "no such folder"),
        (["--watch", ".", "--camera", "0"], "both of --watch and --camera"),
        (["--camera", "99"], "The camera 99 could not be opened"),
        (["--watch", ".", "--target", "5"], "--target"),
    ],
)
def test_refusals(words: list[str], said: str, session: Path) -> None:
    outcome = run_command("shoot", session, *words)
    assert outcome.code == 2
    assert said in outcome.err
