"""Files appear complete or not at all, whatever interrupts the writing."""

import os
import signal
import subprocess
import sys
import textwrap
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from legcal.errors import UsageError
from legcal.files.folder import check_destination, output_path, result_folder, write_atomically

RESULT = '{"legcal_result": 1}'


def fill(folder: Path, text: str) -> None:
    (folder / "result.json").write_text(RESULT)
    (folder / "calibrated.urdf").write_text(text)


def write_result(destination: Path, at_the_end: Callable[[], None]) -> None:
    with result_folder(destination) as folder:
        fill(folder, "new")
        (folder / "another.txt").write_text("new")
        at_the_end()


def raise_(error: type[BaseException]) -> None:
    raise error


def contents(folder: Path) -> dict[str, str]:
    files = (p for p in sorted(folder.rglob("*")) if p.is_file())
    return {str(p.relative_to(folder)): p.read_text() for p in files}


@pytest.fixture
def out(tmp_path: Path) -> Path:
    """The folder of an earlier result, with a note of the user beside it."""
    out = tmp_path / "out"
    out.mkdir()
    fill(out, "old")
    (out / "notes.txt").write_text("mine")
    return out


def test_file_is_replaced_by_its_new_content(tmp_path: Path) -> None:
    path = tmp_path / "a.csv"
    for content in (b"old", b"new"):
        write_atomically(path, content)
        assert path.read_bytes() == content
    assert list(tmp_path.iterdir()) == [path]


def test_file_that_cannot_be_replaced_stays(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "a.csv"
    path.write_bytes(b"old")

    def fail(*_: Any) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(os, "replace", fail)
    with pytest.raises(OSError, match="No space left"):
        write_atomically(path, b"new")
    assert path.read_bytes() == b"old"
    assert list(tmp_path.iterdir()) == [path]


def test_result_appears_when_the_block_ends(tmp_path: Path) -> None:
    out = tmp_path / "new" / "out"
    with result_folder(out) as folder:
        fill(folder, "new")
        (folder / "sub").mkdir()
        (folder / "sub" / "a.txt").write_text("deep")
        assert not out.parent.exists()
    assert contents(out) == {
        "calibrated.urdf": "new",
        "result.json": RESULT,
        "sub/a.txt": "deep",
    }
    assert [p.name for p in tmp_path.iterdir()] == ["new"]
    assert out.stat().st_mode & 0o077 == (tmp_path / "new").stat().st_mode & 0o077


def test_earlier_result_is_replaced_and_other_files_are_kept(out: Path) -> None:
    with result_folder(out) as folder:
        fill(folder, "new")
        assert contents(out)["calibrated.urdf"] == "old"
    assert contents(out) == {"calibrated.urdf": "new", "notes.txt": "mine", "result.json": RESULT}
    assert list(out.parent.iterdir()) == [out]


def test_folder_on_another_file_system_is_filled(
    out: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    replace, stat = os.replace, os.stat

    def refuses_to_cross(source: Path, target: Path) -> None:
        if not Path(source).is_relative_to(out) and Path(target).is_relative_to(out):
            raise OSError(18, "Invalid cross-device link")
        replace(source, target)

    def mounted(path: Any, **options: Any) -> Any:
        found = stat(path, **options)
        if Path(path) != out:
            return found
        values = list(found)
        values[2] += 1  # st_dev
        return os.stat_result(values)

    monkeypatch.setattr(os, "replace", refuses_to_cross)
    monkeypatch.setattr(os, "stat", mounted)
    with result_folder(out) as folder:
        fill(folder, "new")
    assert contents(out) == {"calibrated.urdf": "new", "notes.txt": "mine", "result.json": RESULT}


def test_what_a_killed_run_left_behind_does_not_make_a_folder_foreign(tmp_path: Path) -> None:
    (tmp_path / ".out.x.legcal-part").mkdir()
    check_destination(tmp_path)


@pytest.mark.parametrize("name", [".", "out"])
def test_empty_and_current_folders_are_filled(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, name: str
) -> None:
    (tmp_path / "here" / "out").mkdir(parents=True)
    monkeypatch.chdir(tmp_path / "here" / "out" if name == "." else tmp_path / "here")
    with result_folder(Path(name)) as folder:
        fill(folder, "new")
    assert contents(tmp_path / "here" / "out")["calibrated.urdf"] == "new"


@pytest.mark.parametrize("stop", [KeyboardInterrupt, SystemExit, ValueError])
def test_interrupted_block_leaves_everything_as_it_was(
    out: Path, stop: type[BaseException]
) -> None:
    before = contents(out)
    for destination in (out, out.parent / "none" / "deep"):
        with pytest.raises(stop):
            write_result(destination, lambda: raise_(stop))
    assert contents(out) == before
    assert list(out.parent.iterdir()) == [out]


@pytest.mark.parametrize("after", [0, 1, 2])
def test_interrupted_move_leaves_everything_as_it_was(
    out: Path, monkeypatch: pytest.MonkeyPatch, after: int
) -> None:
    before, replace = contents(out), os.replace
    moved: list[Path] = []

    def interrupted(source: Path, target: Path) -> None:
        if len(moved) == after:
            moved.append(target)
            raise KeyboardInterrupt
        moved.append(target)
        replace(source, target)

    with pytest.raises(KeyboardInterrupt):
        write_result(out, lambda: monkeypatch.setattr(os, "replace", interrupted))
    assert contents(out) == before
    assert list(out.parent.iterdir()) == [out]


def test_killed_run_leaves_everything_as_it_was_and_does_not_disturb_the_next(out: Path) -> None:
    before = contents(out)
    script = textwrap.dedent(
        f"""
        import time
        from pathlib import Path
        from legcal.files import result_folder
        with result_folder(Path({str(out)!r})) as folder:
            (folder / "result.json").write_text("half")
            print("writing", flush=True)
            time.sleep(60)
        """
    )
    with subprocess.Popen(
        [sys.executable, "-c", script], stdout=subprocess.PIPE, cwd=Path(__file__).parents[1]
    ) as run:
        assert run.stdout is not None
        assert run.stdout.readline() == b"writing\n"
        run.send_signal(signal.SIGKILL)
        run.wait(timeout=10.0)
    assert contents(out) == before
    start = time.monotonic()
    with result_folder(out) as folder:
        assert contents(folder) == {}
        fill(folder, "new")
    assert time.monotonic() - start < 1.0
    assert contents(out)["calibrated.urdf"] == "new"


def test_file_is_refused_as_output_folder(tmp_path: Path) -> None:
    (tmp_path / "out").write_text("mine")
    with (
        pytest.raises(UsageError, match="found a file of that name, needed a folder"),
        result_folder(tmp_path / "out"),
    ):
        raise AssertionError("the block must not run")
    assert (tmp_path / "out").read_text() == "mine"


@pytest.mark.parametrize("result", [None, "{", "[]", '{"other": 1}'])
def test_folder_with_other_files_is_refused(tmp_path: Path, result: str | None) -> None:
    (tmp_path / "notes.txt").write_text("mine")
    if result is not None:
        (tmp_path / "result.json").write_text(result)
    with pytest.raises(UsageError, match=r"found a folder with other files and no result\.json"):
        check_destination(tmp_path)
    assert (tmp_path / "notes.txt").read_text() == "mine"


def test_path_below_a_file_and_broken_link_are_refused(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("mine")
    with pytest.raises(UsageError, match="file is a file, needed a path"):
        check_destination(tmp_path / "file" / "out")
    (tmp_path / "link").symlink_to(tmp_path / "none")
    with pytest.raises(UsageError, match="found a broken link"):
        check_destination(tmp_path / "link")


def test_folder_without_permission_is_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(os, "access", lambda *_: False)
    with pytest.raises(UsageError, match="cannot be written to, needed permission to create"):
        check_destination(tmp_path / "out")


def test_an_empty_text_is_no_output_folder() -> None:
    with pytest.raises(UsageError, match="found an empty text, needed the path of a folder"):
        output_path("")
    assert output_path(".") == Path()


def test_a_folder_in_the_place_of_a_file_is_refused(out: Path) -> None:
    (out / "calibrated.urdf").unlink()
    (out / "calibrated.urdf").mkdir()
    with pytest.raises(UsageError, match=r"found calibrated\.urdf, which is a folder"):
        write_result(out, lambda: None)
    assert (out / "calibrated.urdf").is_dir()
