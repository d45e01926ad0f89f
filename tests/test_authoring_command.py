"""The command ``legcal new``."""

import json
import sys
from pathlib import Path

import pytest
from authoring import ROOT, write_table

from legcal.cli import main
from legcal.machine import describe, load_mechanism


def _run(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], *arguments: str
) -> tuple[int, str, str]:
    monkeypatch.setattr(sys, "argv", ["legcal", "new", *arguments])
    with pytest.raises(SystemExit) as left:
        main()
    out, err = capsys.readouterr()
    return int(left.value.code or 0), out, err


def test_new_writes_a_model_that_inspect_knows(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    table = str(write_table(tmp_path))
    code, out, err = _run(monkeypatch, capsys, table, "-o", str(tmp_path / "out"))
    assert (code, err) == (0, "")
    assert "tripod: spatial, 3 legs, mobility 3" in out
    assert "written:" in out
    document = describe(load_mechanism(tmp_path / "out" / "models" / "tripod.yaml"))
    arguments = (table, "-o", str(tmp_path / "out"), "--json", "--force")
    code, out, err = _run(monkeypatch, capsys, *arguments)
    printed = json.loads(out)
    paths = printed.pop("paths")
    assert (code, err, printed) == (0, "", document)
    assert paths["urdf"] == str(tmp_path / "out" / "urdf" / "tripod.urdf")
    assert Path(paths["yaml"]).is_file()


def test_a_family_is_written_from_its_dimensions(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    arguments = "--family 6-UPS --base-radius 300 --platform-radius 150 --height 400 --unit mm"
    more = ("--travel", "0", "100", "--offset", "370", "--name", "mine", "-o", str(tmp_path))
    code, out, _ = _run(monkeypatch, capsys, *arguments.split(), *more)
    assert code == 0
    assert "mine: spatial, 6 legs, mobility 6" in out
    assert load_mechanism(tmp_path / "models" / "mine.yaml").legs[0].travel == (0.0, 0.1)


def test_refusals_are_one_sentence_and_leave_nothing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    output = ("-o", str(tmp_path / "out"))
    code, out, err = _run(monkeypatch, capsys, "--family", "6-UPS", *output)
    assert (code, out, len(err.splitlines())) == (2, "", 1)
    assert "found no --base-radius and no --platform-radius" in err
    code, out, err = _run(monkeypatch, capsys, *output, "--json")
    assert (code, err) == (2, "")
    assert json.loads(out)["error"]["kind"] == "UsageError"
    assert not (tmp_path / "out").exists()


def test_shipped_models_are_made_by_the_command_as_they_are(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    table = str(ROOT / "models" / "tables" / "tricept.yaml")
    assert _run(monkeypatch, capsys, table, "-o", str(tmp_path))[0] == 0
    for name in ("models/tricept.yaml", "urdf/tricept.urdf"):
        assert (tmp_path / name).read_bytes() == (ROOT / name).read_bytes()
