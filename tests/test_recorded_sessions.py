"""Answers of the commands on small sessions of all classes of machines, against the record."""

from pathlib import Path

import pytest
from hexapod_example import Run
from recorded_sessions import SESSIONS, differences, read_record, run_session, too_much


def _gives_what_was_recorded(session: str, folder: Path) -> None:
    worst = too_much(differences(session, run_session(session, folder), read_record()))
    assert not worst, f"\n{worst}\n(python benchmarks/recorded_sessions.py records anew)"


@pytest.mark.parametrize("session", [name for name in SESSIONS if name != "example"])
def test_sessions_give_what_was_recorded(session: str, tmp_path: Path) -> None:
    _gives_what_was_recorded(session, tmp_path)


def test_the_example_gives_what_was_recorded(
    example_run: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("legcal.calibration.pipeline.calibrate", example_run.written_again)
    _gives_what_was_recorded("example", tmp_path)
