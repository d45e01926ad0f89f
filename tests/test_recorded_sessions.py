"""Answers of the commands on small sessions of all classes of machines, against the record."""

from pathlib import Path

import pytest
from recorded_sessions import SESSIONS, differences, read_record, run_session, too_much


@pytest.mark.parametrize("session", SESSIONS)
def test_sessions_give_what_was_recorded(session: str, tmp_path: Path) -> None:
    worst = too_much(differences(session, run_session(session, tmp_path), read_record()))
    assert not worst, f"\n{worst}\n(python benchmarks/recorded_sessions.py records anew)"
