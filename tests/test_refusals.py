"""Every refusal of a command: exit code, kind of error, number of problems, what is named.

The inputs and commands are in ``refusal_table``, what ends how in ``data/refusals.json``;
``python tests/test_refusals.py`` writes that file anew.
"""

import json
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from made_inputs import remove_inputs
from refusal_table import REFUSALS, Refusal

ENDS = Path(__file__).parent / "data/refusals.json"


@pytest.fixture(scope="module", autouse=True)
def _inputs() -> Iterator[None]:
    yield
    remove_inputs()


@pytest.fixture(scope="module")
def ends() -> dict[str, dict[str, Any]]:
    """How each refusal ends, by name."""
    found: dict[str, dict[str, Any]] = json.loads(ENDS.read_text(encoding="utf-8"))
    return found


@pytest.mark.parametrize("refusal", [pytest.param(r, id=r.name) for r in REFUSALS])
def test_refusals_name_what_is_wrong_and_leave_nothing(
    refusal: Refusal, ends: dict[str, dict[str, Any]], tmp_path: Path
) -> None:
    found = refusal.observe(tmp_path)
    message, changed = found.pop("message"), found.pop("changed")
    assert found == ends[refusal.name], message
    named = [word.replace("{in}", str(tmp_path / "in")) for word in refusal.named]
    assert [word for word in named if word not in message] == []
    assert changed == []


def test_every_refusal_has_an_end(ends: dict[str, dict[str, Any]]) -> None:
    assert {refusal.name for refusal in REFUSALS} == ends.keys()
    assert len(ends) == len(REFUSALS)


def _record() -> None:
    found = {}
    for refusal in REFUSALS:
        with tempfile.TemporaryDirectory() as folder:
            entry = refusal.observe(Path(folder))
            named = [word.replace("{in}", f"{folder}/in") for word in refusal.named]
        lost = [word for word in named if word not in entry["message"]]
        if lost or entry["changed"]:
            print(f"{refusal.name}: not named {lost}, changed {entry['changed']}", file=sys.stderr)
        found[refusal.name] = {key: entry[key] for key in ("exit", "kind", "problems")}
    ENDS.write_text(json.dumps(found, indent=1) + "\n", encoding="utf-8")
    remove_inputs()


if __name__ == "__main__":
    _record()
