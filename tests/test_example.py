"""The dataset that comes with legcal: copied whole or not at all."""

from pathlib import Path

import pytest
from command_line import run

from legcal import load_dataset
from legcal.data import new_dataset

EXAMPLE = Path(__file__).parents[1] / "examples/hexapod"


def test_the_example_is_copied_and_loads(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    copy = tmp_path / "here" / "example"
    assert run(monkeypatch, "example", "-o", str(copy)) == 0
    assert "Next:\n  legcal calibrate" in capsys.readouterr().out
    copied = {path.relative_to(copy) for path in copy.rglob("*") if path.is_file()}
    own = {path.relative_to(EXAMPLE) for path in EXAMPLE.rglob("*") if path.is_file()}
    assert own - copied <= {Path("observations.csv"), Path(".legcal-cache.json")}
    assert copied <= own
    assert len(load_dataset(copy).measurements.image) == 45


def test_an_installation_without_the_example_says_so(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(new_dataset, "_EXAMPLE", "examples/none")
    assert run(monkeypatch, "example", "-o", str(tmp_path / "copy")) == 1
    assert "install it again" in capsys.readouterr().err
    assert not (tmp_path / "copy").exists()
