"""Code blocks and commands of the README and the pages: run, or held against what they are for."""

import re
import shlex
import shutil
from collections.abc import Iterator
from functools import cache
from pathlib import Path
from typing import Any

import pytest
import typer
from command_line import run
from csv_rows import read_rows
from evidence import records
from hexapod_example import HEXAPOD, ROOT, TRUTH
from pydantic import BaseModel

from legcal import evaluate, load_mechanism
from legcal.cli.app import commands
from legcal.data.dataset_file import DatasetEntry
from legcal.descriptions.table import TableFile
from legcal.files.schema import parse_yaml, validate
from legcal.machine.files import MechanismFile

PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md"))]
RUN_ELSEWHERE = {  # by the language of a block, or its page
    "python": "test_project.py and test_python_api.py, with what they print",
    "{code-cell} ipython3": "the site, when it is built",
}
FORMATS: dict[str, type[BaseModel]] = {
    "legcal_dataset": DatasetEntry,
    "closed_loop": MechanismFile,
    "legcal_table": TableFile,
}


def _blocks(path: Path) -> Iterator[tuple[str, str, str]]:
    """Yield language, text and what stands before each block of a page."""
    text = path.read_text(encoding="utf-8")
    for found in re.finditer(r"^```(\S[^\n]*)\n(.*?)^```$", text, re.DOTALL | re.MULTILINE):
        yield found[1], found[2], text[: found.start()].rstrip()


def _commands(block: str) -> list[str]:
    """Return the command lines of a block, without prompts and comments, each in one line."""
    lines = re.sub(r"(^|\s+)#.*", "", re.sub(r"\\\n\s*", "", block), flags=re.M).splitlines()
    return [part for line in lines for part in line.removeprefix("$ ").split(" && ") if part]


def _blocks_of_commands() -> Iterator[tuple[Path, str]]:
    for path in PAGES:
        for language, text, _ in _blocks(path):
            if language in ("sh", "text", "console", "{code-cell} ipython3"):
                yield from ((path, line) for line in _commands(text) if _words(line))


def _words(line: str) -> list[str]:
    """Return the words after ``legcal`` of a command line; none if it runs something else."""
    found = re.match(r"(?:\S*/)?legcal (.*)|docker run .* legcal (.*)", line)
    return shlex.split(found[1] or found[2]) if found else []


@cache
def _root() -> Any:
    return typer.main.get_command(commands())


def _command(words: list[str]) -> tuple[Any, list[str]]:
    """Return the command that words name, and the words behind its name."""
    command, rest = _root(), list(words)
    while rest and rest[0] in getattr(command, "commands", {}):
        command = command.commands[rest.pop(0)]
    return command, rest


def _options(command: Any) -> set[str]:
    return {"--help", *(name for p in command.params for name in (*p.opts, *p.secondary_opts))}


def test_every_block_is_one_of_the_kinds_that_are_checked() -> None:
    kinds = {"sh", "text", "console", "yaml", *RUN_ELSEWHERE}
    odd = []
    for path in PAGES:
        for language, text, before in _blocks(path):
            if language.startswith(("{toctree}", "{include}", "{eval-rst}")):
                continue
            is_output = language == "text" and before.endswith("```")
            is_list = language == "text" and all(
                re.match(r"\S+\s{2,}\S", line) for line in text.splitlines() if " " in line
            )
            is_run = language == "{code-cell} ipython3" or all(
                re.match(r"(\S*/)?(legcal|docker|pip|pytest|python3|dask) ", f"{line} ")
                for line in _commands(text)
            )
            is_known = language in kinds and (
                language in ("yaml", "python") or is_output or is_list or is_run
            )
            odd += [] if is_known else [f"{path.name}: {language}: {text.splitlines()[0]}"]
    assert odd == []


def test_every_command_of_a_block_is_understood() -> None:
    commands = [(path, line) for path, line in _blocks_of_commands() if not set("|$") & set(line)]
    assert len(commands) > 15
    for path, line in commands:
        command, rest = _command(_words(line))
        if rest and rest[0] not in ("--version",):
            assert command is not _root(), f"{path.name}: {line}"
            command.make_context("legcal", rest)  # refuses what it does not know, or lacks


def test_every_option_that_a_page_names_exists() -> None:
    spans = [
        (path, span)
        for path in PAGES
        for span in re.findall(r"`(legcal [^`]+)`", path.read_text(encoding="utf-8"))
    ]
    spans += list(_blocks_of_commands())
    assert len(spans) > 100
    missing = []
    for path, span in spans:
        words = span.replace("[", " ").replace("]", " ").replace("\\|", " ").split()
        command, rest = _command(words[1:] if words[0] == "legcal" else _words(span))
        options = re.findall(r"(?<![\w'{*-])--?[A-Za-z][\w-]*", " ".join(rest))
        if command is _root() and rest and not rest[0].startswith("-"):
            missing.append(f"{path.name}: legcal {rest[0]}")
        missing += [f"{path.name}: {span}: {o}" for o in options if o not in _options(command)]
    assert missing == []


DAY = re.compile(r"\b20\d\d-\d\d-\d\d\b")


def test_every_recorded_figure_states_its_command_and_its_day() -> None:
    rows = [row for table in records().values() for row in table]
    assert len(rows) > 100
    for row in rows:
        assert DAY.fullmatch(row["date"]), row
        programs = re.findall(r"benchmarks/\w+\.py", row["command"])
        assert programs or "legcal" in row["command"] or "the same" in row["command"], row
        assert all((ROOT / program).exists() for program in programs), row


def test_every_yaml_of_a_page_is_what_reading_takes() -> None:
    found = [
        (path, text) for path in PAGES for language, text, _ in _blocks(path) if language == "yaml"
    ]
    kinds = set()
    for path, text in found:
        content = parse_yaml(text.encode(), path, "example")
        key = next((key for key in FORMATS if key in content), "")
        if key:
            validate(FORMATS[key], content, path)
            kinds.add(key)
        else:  # a block of dataset.yaml
            block = parse_yaml((HEXAPOD / "dataset.yaml").read_bytes(), path, "example") | content
            validate(DatasetEntry, block, path)
    assert kinds == set(FORMATS)


def _write_files_as_people_have_them() -> None:
    """Write joints, photographs and lengths of legs of the example into the current folder."""
    shipped = load_mechanism(HEXAPOD / "models/hexapod.yaml")
    joints = [("A", shipped.A_base), ("B", shipped.B_platform)]
    points = [
        ",".join([f"{side}{j + 1}", *(f"{1e3 * x:.3f}" for x in p)])
        for side, all_points in joints
        for j, p in enumerate(all_points)
    ]
    Path("joints.csv").write_text("\n".join(["point,x,y,z", *points]))
    lines = ["photo," + ",".join(f"L{j} [mm]" for j in range(1, 7))]
    for row in read_rows(HEXAPOD / "measurements.csv")[::2]:
        name = row["image"].removeprefix("images/").upper()
        (path := Path("photos") / row["view"] / name).parent.mkdir(parents=True, exist_ok=True)
        shutil.copy(HEXAPOD / row["image"], path)
        lengths = [1e3 * float(row[f"leg{j}_prismatic"]) + 345.0 for j in range(1, 7)]
        lines.append(",".join([row["image"], *(f"{x:.4f}" for x in lengths)]))
    Path("readings.csv").write_text("\n".join(lines))
    shutil.copy(HEXAPOD / "camera_info.yaml", "camera_info.yaml")


@pytest.mark.system
def test_the_commands_of_the_readme_lead_from_files_to_a_calibration(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    _write_files_as_people_have_them()
    block = next(text for _, text, _ in _blocks(ROOT / "README.md") if "legcal new" in text)
    commands = [_words(line.replace("UPS", "SPU")) for line in _commands(block)]  # its legs are SPU
    assert [words[0] for words in commands] == ["new", "camera", "init", "calibrate"]
    del commands[1]  # tests/test_camera_calibration.py has boards
    assert [run(*words).code for words in commands] == [0, 0, 0]
    nominal, found = (
        evaluate(model, TRUTH, dataset=HEXAPOD).displacement.mean()
        for model in ("models/joints.yaml", "calibrated")
    )
    assert found < 0.2 * nominal
    assert found < 2e-4
