"""Folders of files appear complete or not at all; quantities carry their unit."""

import errno
import os
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from command_line import run

from legcal.errors import UsageError
from legcal.files.folder import result_folder, write_atomically
from legcal.files.quantity import ANGLE, LENGTH, PIXELS, parse_quantity

RESULT = '{"legcal_result": 1}'
PIPE = "a pipe"
REPLACED = {"calibrated.urdf": "new", "notes.txt": "mine", "result.json": RESULT}


def fill(folder: Path, text: str) -> None:
    (folder / "result.json").write_text(RESULT)
    (folder / "calibrated.urdf").write_text(text)


def write_result(destination: Path, at_the_end: Callable[[Path], None] | None = None) -> None:
    with result_folder(destination) as folder:
        fill(folder, "new")
        if at_the_end is not None:
            at_the_end(folder)


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


def test_a_file_is_replaced_whole_or_not_at_all(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "a.csv"
    for content in (b"old", b"new"):
        write_atomically(path, content)
        assert path.read_bytes() == content

    def fail(*_: Any) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(os, "replace", fail)
    with pytest.raises(OSError, match="No space left"):
        write_atomically(path, b"newer")
    assert path.read_bytes() == b"new"
    assert list(tmp_path.iterdir()) == [path]


def test_a_result_appears_when_the_block_ends(tmp_path: Path) -> None:
    out = tmp_path / "new" / "out"
    with result_folder(out) as folder:
        fill(folder, "new")
        (folder / "sub").mkdir()
        (folder / "sub" / "a.txt").write_text("deep")
        assert not out.parent.exists()
    assert contents(out) == {"calibrated.urdf": "new", "result.json": RESULT, "sub/a.txt": "deep"}
    assert [p.name for p in tmp_path.iterdir()] == ["new"]
    assert out.stat().st_mode & 0o077 == (tmp_path / "new").stat().st_mode & 0o077


def test_an_earlier_result_is_replaced_and_other_files_are_kept(out: Path) -> None:
    with result_folder(out) as folder:
        fill(folder, "new")
        assert contents(out)["calibrated.urdf"] == "old"
    assert contents(out) == REPLACED
    assert list(out.parent.iterdir()) == [out]


def test_a_folder_on_another_file_system_is_filled(
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
    write_result(out)
    assert contents(out) == REPLACED


def test_an_interrupted_block_leaves_everything_as_it_was(out: Path) -> None:
    def interrupt(_: Path) -> None:
        raise KeyboardInterrupt

    before = contents(out)
    for destination in (out, out.parent / "none" / "deep"):
        with pytest.raises(KeyboardInterrupt):
            write_result(destination, interrupt)
    assert contents(out) == before
    assert list(out.parent.iterdir()) == [out]


@pytest.mark.parametrize("after", [0, 1, 2])
def test_an_interrupted_move_leaves_everything_as_it_was(
    out: Path, monkeypatch: pytest.MonkeyPatch, after: int
) -> None:
    before, replace = contents(out), os.replace
    moved: list[Path] = []

    def interrupted(source: Path, target: Path) -> None:
        moved.append(target)
        if len(moved) == after + 1:
            raise KeyboardInterrupt
        replace(source, target)

    def begin(folder: Path) -> None:
        (folder / "another.txt").write_text("new")
        monkeypatch.setattr(os, "replace", interrupted)

    with pytest.raises(KeyboardInterrupt):
        write_result(out, begin)
    assert contents(out) == before
    assert list(out.parent.iterdir()) == [out]


REFUSED: dict[str, tuple[dict[str, str | None], str, str]] = {  # files, destination, named
    "a file": ({"out": "mine"}, "out", "out: .*found a file"),
    "below a file": ({"file": "mine"}, "file/out", "file is a file"),
    "other files": ({"notes.txt": "mine"}, "", r"other files and no result\.json"),
    "other JSON": (
        {"notes.txt": "mine", "result.json": '{"a": 1}'},
        "",
        r"result\.json that is damaged",
    ),
    "a folder in the way": (
        {"out/result.json": RESULT, "out/calibrated.urdf/a.txt": "mine"},
        "out",
        r"calibrated\.urdf, which is a folder",
    ),
    "a pipe in the way": (
        {"out/result.json": RESULT, "out/calibrated.urdf": PIPE},
        "out",
        r"calibrated\.urdf, which is a pipe or a device",
    ),
    "a broken link": ({"link": None}, "link", "a broken link"),
}


@pytest.mark.parametrize("case", REFUSED)
def test_a_place_that_is_not_free_is_refused_and_stays(case: str, tmp_path: Path) -> None:
    files, destination, named = REFUSED[case]
    for name, text in files.items():
        path = tmp_path / name
        path.parent.mkdir(parents=True, exist_ok=True)
        if text is None:
            path.symlink_to(tmp_path / "none")
        elif text == PIPE:
            os.mkfifo(path)
        else:
            path.write_text(text)
    before = contents(tmp_path)
    with pytest.raises(UsageError, match=named):
        write_result(tmp_path / destination)
    assert contents(tmp_path) == before


@pytest.mark.parametrize(
    ("module", "name", "number"),
    [(tempfile, "mkdtemp", errno.EROFS), (Path, "write_bytes", errno.ENOSPC)],
)
def test_places_that_take_no_files_are_refused_before_any_work(
    module: Any, name: str, number: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def refused(*_found: Any, **_more: Any) -> None:
        raise OSError(number, os.strerror(number))

    monkeypatch.setattr(module, name, refused)
    out, film = tmp_path / "out", tmp_path / "none.mp4"
    for words in (
        ("simulate", "3-rpr", "-o", out),
        ("plan", "3-rpr", "-o", out),
        ("study", "paper", "-o", out),
        ("example", "-o", out),
        ("import", film, "--model", "3-rpr", "--camera", "none.yaml", "-o", out),
    ):
        outcome = run(*words)
        assert outcome.code == 2
        assert f"{tmp_path} takes no files ('{os.strerror(number)}'), needed" in outcome.err
        assert outcome.err.count("\n") == 1
        assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("text", "units", "value"),
    [
        ("2mm", LENGTH, 2e-3),
        ("2 um", LENGTH, 2e-6),
        ("1e-3m", LENGTH, 1e-3),
        (".5cm", LENGTH, 5e-3),
        ("180deg", ANGLE, 3.141592653589793),
        ("2mrad", ANGLE, 2e-3),
        ("0.1px", PIXELS, 0.1),
        ("0", LENGTH, 0.0),
    ],
)
def test_quantities_are_in_si(text: str, units: dict[str, float], value: float) -> None:
    assert parse_quantity(text, units, "--x") == pytest.approx(value, rel=1e-15)
