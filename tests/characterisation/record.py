"""Write what the present version gives: ``python -m characterisation.record [NAME ...]``.

Run in ``tests``. Expected values are recorded once, and are no place to make tests pass.
"""

from __future__ import annotations

import argparse
import dataclasses
import inspect
import json
import re
import sys
import tempfile
import time
import traceback
from collections.abc import Callable
from fnmatch import fnmatch
from functools import cache
from pathlib import Path
from typing import Any

import legcal
from characterisation.cases import CASES
from characterisation.inputs import remove_inputs
from characterisation.refusals import REFUSALS

EXPECTED = Path(__file__).parent / "expected"


def expected_path(name: str) -> Path:
    """Return where the facts of a case are."""
    return EXPECTED / f"{name}.json"


@cache
def recorded(name: str) -> Any:
    """Return the facts of a case."""
    return json.loads(expected_path(name).read_text(encoding="utf-8"))


def public_api() -> dict[str, Any]:
    """Return the parameters of all public functions and classes, and what classes have."""
    found = {}
    for name in sorted(set(legcal.__all__) - {"__version__"}):
        value = getattr(legcal, name)
        members: set[str] = set()
        if inspect.isclass(value):
            members = {member for member in dir(value) if not member.startswith("_")}
            if dataclasses.is_dataclass(value):
                members |= {field.name for field in dataclasses.fields(value)}
        members -= set(dir(Exception))
        parameters = list(inspect.signature(value).parameters)
        found[name] = {"parameters": parameters, "members": sorted(members)}
    return found


def recorded_refusals() -> dict[str, Any]:
    """Return how commands that are refused end."""
    found = {}
    for refusal in REFUSALS:
        with tempfile.TemporaryDirectory() as folder:
            entry = refusal.observe(Path(folder))
            named = [word.replace("{in}", f"{folder}/in") for word in refusal.named]
        lost = [word for word in named if word not in entry["message"]]
        if lost or entry["changed"]:
            print(f"{refusal.name}: not named {lost}, changed {entry['changed']}")
        found[refusal.name] = {key: entry[key] for key in ("exit", "kind", "problems")}
    return found


OTHERS: dict[str, Callable[[], dict[str, Any]]] = {
    "api": public_api,
    "refusals": recorded_refusals,
}


def write_facts(name: str, found: dict[str, Any]) -> None:
    """Write facts, lists of numbers in one line."""
    text = json.dumps(found, indent=1, ensure_ascii=False)
    text = re.sub(r"\[\s+([^\[\]{}]*?)\s+\]", lambda m: _joined(m.group(1)), text)
    expected_path(name).write_text(text + "\n", encoding="utf-8")


def _joined(entries: str) -> str:
    return "[" + re.sub(r",\s+", ", ", entries) + "]"


def main() -> None:
    """Record cases, those that match a pattern or all that are new."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("names", nargs="*", default=["*"])
    parser.add_argument("--again", action="store_true", help="also what is recorded already")
    asked = parser.parse_args()
    failed = 0
    for case in CASES:
        if not any(fnmatch(case.name, name) for name in asked.names):
            continue
        if expected_path(case.name).exists() and not asked.again:
            continue
        start = time.process_time()
        try:
            with tempfile.TemporaryDirectory() as folder:
                found = case.observe(Path(folder))
        except Exception:
            traceback.print_exc()
            failed += 1
            continue
        write_facts(case.name, found)
        codes = [step["exit"] for step in found.get("steps", [])]
        print(f"{case.name}: exit {codes}, {time.process_time() - start:.1f} s", flush=True)
    for name, observe in OTHERS.items():
        wanted = any(fnmatch(name, pattern) for pattern in asked.names)
        if wanted and (asked.again or not expected_path(name).exists()):
            write_facts(name, observe())
    remove_inputs()
    sys.exit(failed)


if __name__ == "__main__":
    main()
