"""The house: what the README promises is what is checked on every change."""

import json
import re
import shutil
import tomllib
from functools import cache
from importlib.metadata import distribution, requires
from importlib.resources import files
from pathlib import Path, PurePath

import pytest
from constants import ROOMS, numbers, unused
from evidence import page_text
from format_schemas import FOLDER, NAMES, schema_text
from hexapod_example import Run

import legcal
from legcal.calibration.result import Calibration
from legcal.files.folder import schema_names

ROOT = Path(__file__).parents[1]


def _shell_blocks(text: str) -> list[str]:
    return [block.strip() for block in re.findall(r"```sh\n(.*?)```", text, flags=re.DOTALL)]


def test_the_two_commands_of_the_readme_are_the_ones_that_are_checked() -> None:
    commands = _shell_blocks((ROOT / "README.md").read_text())
    assert len(commands) == 2
    assert all("\n" not in command for command in commands)
    checked = [
        line
        for line in (ROOT / ".ci/run").read_text().splitlines()
        if line.startswith("python3 -m venv")
    ]
    assert checked == commands


DOCUMENTS = [ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md"))]


@pytest.mark.parametrize("document", [pytest.param(path, id=path.name) for path in DOCUMENTS])
def test_documents_name_files_and_functions_that_exist(document: Path) -> None:
    text = document.read_text()
    headings = {path: _headings(path) for path in DOCUMENTS}
    lost = []
    for link in re.findall(r"\]\((?!http)([^)\s]+)\)", text):
        name, _, part = link.partition("#")
        target = (document.parent / name).resolve() if name else document
        if not target.exists() or (part and part not in headings[target]):
            lost.append(link)
    words = " ".join(re.findall(r"`([^`\n]+)`", text))
    lost += sorted({*re.findall(r"\b\w+\.py\b", words)} - _names_of_modules())
    paths = re.findall(r"(?<![\w/.])(?:legcal|benchmarks|tests|docs|examples)/[\w./-]+", words)
    lost += [path for path in paths if not (ROOT / path).exists()]
    for name in re.findall(r"\blegcal\.([A-Za-z_]+)\(", text):
        lost += [] if hasattr(legcal, name) else [f"legcal.{name}"]
    assert lost == []


@cache
def _names_of_modules() -> set[str]:
    """Return the names of the Python files of the project, and not of what is installed in it."""
    folders = ("legcal", "benchmarks", "tests", "docs", "examples")
    return {path.name for folder in folders for path in (ROOT / folder).rglob("*.py")}


def _headings(path: Path) -> set[str]:
    """Return the anchors of the headings of a page."""
    names = re.findall(r"^#+ (.*)$", path.read_text(), flags=re.MULTILINE)
    return {re.sub(r"[^\w\- ]", "", name.strip().lower()).replace(" ", "-") for name in names}


def test_every_direct_dependency_is_pinned_to_the_version_that_was_tested() -> None:
    pinned = {
        re.split(r"==", line)[0].lower().replace("_", "-")
        for line in (ROOT / "constraints.txt").read_text().splitlines()
    }
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    extras = [name for group in project["optional-dependencies"].values() for name in group]
    for requirement in [*project["dependencies"], *extras]:
        name = re.split(r"[<>=!~ \[]", requirement)[0].lower().replace("_", "-")
        assert name in pinned, f"{name} is not in constraints.txt"


def test_the_version_stands_in_one_place() -> None:
    hits = [
        path
        for path in [ROOT / "pyproject.toml", *(ROOT / "legcal").rglob("*.py")]
        if f'"{legcal.__version__}"' in path.read_text()
    ]
    assert hits == [ROOT / "legcal/version.py"]
    notes = (ROOT / "CHANGELOG.md").read_text()
    assert f"## {legcal.__version__}" in notes
    entries = [line for line in notes.splitlines() if line.startswith("- ")]
    assert len(entries) == len(set(entries))


def test_the_python_snippet_of_the_readme_runs(
    example_run: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    snippets = re.findall(r"```python\n(.*?)```", (ROOT / "README.md").read_text(), re.DOTALL)
    assert len(snippets) == 1

    def calibrated(folder: str, *, output: str) -> Calibration:
        assert folder == "examples/hexapod"
        shutil.copytree(example_run.output, output)
        return example_run.calibration

    (tmp_path / "examples").symlink_to(ROOT / "examples")
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("legcal.calibrate", calibrated)
    exec(snippets[0], {})


def test_the_installed_package_asks_for_what_pyproject_says() -> None:
    origin = json.loads(distribution("legcal").read_text("direct_url.json") or "{}")
    if origin.get("dir_info", {}).get("editable") and origin["url"] != ROOT.as_uri():
        pytest.skip(f"what is installed is another tree: {origin['url']}")
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    installed = {_plain(r) for r in requires("legcal") or [] if "extra ==" not in r}
    assert installed == {_plain(requirement) for requirement in project["dependencies"]}


def test_the_shipped_schemas_are_those_of_the_models() -> None:
    assert schema_names() == list(NAMES)
    for name in NAMES:
        assert (FOLDER / f"{name}.json").read_text(encoding="utf-8") == schema_text(name), (
            "run: python tests/format_schemas.py"
        )


def test_the_package_holds_all_that_pages_are_made_of() -> None:
    assets = {one.name for one in (files("legcal.pages") / "assets").iterdir()}
    assert assets == {
        *("dialogue.js", "editor.js", "landmarks.js", "sliders.js"),
        *("page.css", "page.html", "page.js", "scene.js"),
    }
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())
    targets = project["tool"]["hatch"]["build"]["targets"]
    assert targets["wheel"]["packages"] == ["legcal"]
    assert not any("exclude" in target for target in targets.values())
    ignored = re.findall(r"\S+", (ROOT / ".gitignore").read_text())  # hatchling leaves that out too
    places = [f"legcal/pages/assets/{name}" for name in assets]
    assert not any(PurePath(place).match(one) for place in places for one in ignored)
    assert not {f"{part}/" for part in PurePath(places[0]).parts} & set(ignored)


def _plain(requirement: str) -> str:
    """Return a requirement with its bounds in one order."""
    name, *bounds = re.split(r"(?<![<>=!~])(?=[<>=!~])|,", requirement.replace(" ", ""))
    return " ".join([name, *sorted(bound for bound in bounds if bound)])


def test_the_page_of_evidence_has_the_recorded_figures() -> None:
    page = (ROOT / "docs/evidence.md").read_text(encoding="utf-8")
    assert page_text(page) == page, "python benchmarks/evidence.py writes its tables"
    for recorded, other in (("0.286 and 0.423 mm off", "0.286 and 0.424 mm off"), ("`shaken`", "")):
        assert recorded in page
        with pytest.raises(ValueError, match=r"0\.424|shaken"):
            page_text(page.replace(recorded, other))


@pytest.mark.parametrize("room", ROOMS)
def test_every_number_that_is_swept_is_used(room: str) -> None:
    assert numbers(room)
    assert unused(room) == []
