"""Which of the seeded defects of defects.yaml the tests catch.

    python benchmarks/defects.py --check
    OMP_NUM_THREADS=1 python benchmarks/defects.py --run [--only ID ...] [--concern NAME ...]

A defect replaces a snippet of the package by another one that is as plausible: a sign, a factor, a
weight, a frame, a refusal. The snippet is looked up in the whole package, whatever file it is in,
and however its lines are broken and indented; it must be there once (``--check``). One defect at a
time is put into a copy of the tree, and pytest runs there until the first failure: the files that
are named at the defect (``tests``), then the recorded sessions.

One line for each defect is appended to defects.jsonl beside this file, so that a run continues
where it stopped; ``--again`` repeats what is there. ``--confirm`` runs the tests that caught
something without any defect: they must pass.
"""

import argparse
import ast
import contextlib
import json
import os
import re
import shutil
import signal
import sys
import time
import traceback
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from importlib import import_module
from itertools import pairwise
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import NoReturn

import pytest
import yaml

HERE = Path(__file__).parent
ROOT = HERE.parent
DEFECTS = HERE / "defects.yaml"
OUTCOMES = HERE / "defects.jsonl"
RECORDED = "tests/test_recorded_sessions.py"
CAUGHT, SURVIVED, TIMEOUT = "caught", "survived", "timeout"
LIBRARIES = (
    "casadi",
    "cv2",
    "lxml.etree",
    "numpy",
    "pinocchio",
    "pydantic",
    "rich.console",
    "scipy.interpolate",
    "scipy.optimize",
    "scipy.sparse",
    "scipy.spatial.transform",
    "scipy.stats",
    "trimesh",
    "typer",
    "yourdfpy",
)
COPIED = ("legcal", "tests", "benchmarks")  # the rest of the tree is linked
FAILED, NOTHING_RUN = 1, 5  # exit codes of pytest
_TOKEN, _WORD = re.compile(r"\w+|[^\w\s]"), re.compile(r"\w+")


@dataclass(frozen=True)
class Defect:
    """A snippet of the package and what it is replaced by."""

    id: str
    concern: str
    what: str
    old: str
    new: str
    tests: tuple[str, ...]  # files that are about it


@dataclass(frozen=True)
class Place:
    """Where the snippet of a defect is."""

    path: Path
    start: int
    end: int


@dataclass(frozen=True)
class Outcome:
    """What pytest said: caught, survived or timeout, the first failing test, and the seconds."""

    found: str
    by: str
    seconds: float


def read_defects(path: Path = DEFECTS) -> list[Defect]:
    """Return the defects of the data file."""
    document = yaml.safe_load(path.read_text(encoding="utf-8"))
    return [Defect(**{**entry, "tests": tuple(entry["tests"])}) for entry in document["defects"]]


def pattern_of(snippet: str) -> re.Pattern[str]:
    """Return what finds a snippet, however its lines are broken and indented."""
    tokens = _TOKEN.findall(snippet)
    parts = [re.escape(tokens[0])]
    for before, token in pairwise(tokens):
        needs_space = before[-1].isidentifier() and (token[0] + "a").isidentifier()
        comma = r",?" if token in ")]}" and before != "," else ""
        parts.append(comma + (r"\s+" if needs_space else r"\s*") + re.escape(token))
    start = r"(?<!\w)" if re.match(r"\w", tokens[0]) else ""
    end = r"(?!\w)" if re.match(r"\w", tokens[-1][-1]) else ""
    return re.compile(start + "".join(parts) + end)


def places(defect: Defect, sources: dict[Path, str]) -> list[Place]:
    """Return everywhere that the snippet of a defect is in the package."""
    pattern, words = pattern_of(defect.old), set(_WORD.findall(defect.old))
    return [
        Place(path, match.start(), match.end())
        for path, text in sources.items()
        if all(word in text for word in words)  # quicker than the pattern
        for match in pattern.finditer(text)
    ]


def replaced(text: str, place: Place, new: str) -> str:
    """Return a module with the snippet replaced; further lines get the first one's indentation."""
    line = text[text.rfind("\n", 0, place.start) + 1 :]
    indent = line[: len(line) - len(line.lstrip())]
    return text[: place.start] + new.replace("\n", f"\n{indent}") + text[place.end :]


def read_package(root: Path) -> dict[Path, str]:
    """Return the modules of the package, and the bound of benchmarks, by their paths."""
    paths = [
        *sorted((root / "legcal").rglob("*.py")),
        *sorted((root / "benchmarks").glob("*bound.py")),
    ]
    return {path.relative_to(root): path.read_text(encoding="utf-8") for path in paths}


def problem(defect: Defect, sources: dict[Path, str]) -> str:
    """Return what is wrong with a defect at the present package, an empty text if nothing is."""
    at = places(defect, sources)
    if len(at) != 1:
        where = ", ".join(str(place.path) for place in at[:4])
        return f"the snippet is there {len(at)} times{where and f': {where}'}"
    before = sources[at[0].path]
    try:
        after = ast.dump(ast.parse(replaced(before, at[0], defect.new)))
    except SyntaxError as error:
        return f"what replaces the snippet is no Python: {error}"
    return "nothing changes" if after == ast.dump(ast.parse(before)) else ""


def usable(defects: Sequence[Defect], sources: dict[Path, str]) -> list[Defect]:
    """Return the defects that can be put into the present package, and name the others."""
    counts = Counter(defect.id for defect in defects)
    twice = [name for name, count in counts.items() if count > 1]
    if twice:
        raise SystemExit(f"these ids are there more than once: {', '.join(twice)}")
    found = []
    for defect in defects:
        wrong = problem(defect, sources)
        if wrong:
            print(f"{defect.id}: {wrong}")
        else:
            found.append(defect)
    return found


class Tree:
    """A copy of the tree in which one defect at a time is put."""

    def __init__(self, root: Path, folder: Path) -> None:
        self.folder = folder
        self.sources = read_package(root)
        self._clock = time.time()
        for path in root.iterdir():
            if path.name in COPIED:
                ignored = shutil.ignore_patterns("__pycache__")
                shutil.copytree(path, folder / path.name, ignore=ignored)
            elif path.name != ".git":
                (folder / path.name).symlink_to(path)

    @contextlib.contextmanager
    def with_defect(self, defect: Defect) -> Iterator[None]:
        """Put a defect into the copy, and take it out at the end."""
        (place,) = places(defect, self.sources)
        before = self.sources[place.path]
        self._write(place.path, replaced(before, place, defect.new))
        try:
            yield
        finally:
            self._write(place.path, before)

    def run(self, command: Sequence[str], limit: float) -> Outcome:
        """Run pytest in the copy until the first failure, in a process of its own."""
        begin = time.perf_counter()
        said = self.folder / "said.txt"
        child = os.fork()
        if child == 0:
            self._be_pytest(command, said)
        status = _ended(child, begin + limit)
        seconds = time.perf_counter() - begin
        if status is None:
            return Outcome(TIMEOUT, "", seconds)
        code, text = os.waitstatus_to_exitcode(status), said.read_text(encoding="utf-8")
        if code == NOTHING_RUN:
            raise SystemExit(f"there are no such tests: {' '.join(command)}")
        if code == 0:
            return Outcome(SURVIVED, "", seconds)
        if code != FAILED and "rror" not in text:
            raise SystemExit(f"pytest could not be run: {text[-2000:]}")
        by = re.search(r"^(?:FAILED|ERROR) (.+?)(?: - .*)?$", text, re.MULTILINE)
        return Outcome(CAUGHT, by[1] if by else text.strip().splitlines()[-1], seconds)

    def _be_pytest(self, command: Sequence[str], said: Path) -> NoReturn:
        """Make this process one that runs pytest, and end it."""
        code = 3  # of pytest: an internal error
        try:
            os.setsid()  # so that the processes of the tests end with it
            with said.open("w", encoding="utf-8") as file:
                os.dup2(file.fileno(), 1)
                os.dup2(file.fileno(), 2)
            os.chdir(self.folder)
            os.environ["PYTHONPATH"] = str(self.folder)
            sys.path[0] = str(self.folder)
            options = ["-x", "-q", "-n", "0", "-m", "", "-p", "no:cacheprovider"]
            code = int(pytest.main([*options, "--tb=no", "-rfE", *command]))
        except BaseException:
            traceback.print_exc()
        finally:
            sys.stdout.flush()
            sys.stderr.flush()
            os._exit(code)

    def _write(self, path: Path, text: str) -> None:
        """Write a module with a time of its own, so that no compiled one is taken for it."""
        self._clock += 2.0
        (self.folder / path).write_text(text, encoding="utf-8")
        os.utime(self.folder / path, (self._clock, self._clock))


def _ended(child: int, end: float) -> int | None:
    """Return the status of a process that ends before a time, None after killing it otherwise."""
    while time.perf_counter() < end:
        found, status = os.waitpid(child, os.WNOHANG)
        if found:
            return status
        time.sleep(0.05)
    os.killpg(child, signal.SIGKILL)
    os.waitpid(child, 0)
    return None


def load_libraries() -> None:
    """Import what every test needs and takes seconds, for all processes that run tests."""
    for name in LIBRARIES:
        import_module(name)


def read_outcomes() -> dict[str, dict[str, object]]:
    """Return the last outcome of every defect, in the order of the file."""
    if not OUTCOMES.is_file():
        return {}
    lines = [json.loads(line) for line in OUTCOMES.read_text(encoding="utf-8").splitlines()]
    return {str(line["id"]): line for line in lines}


def commands(defect: Defect) -> list[list[str]]:
    """Return what pytest runs for a defect, one after the other until it is caught."""
    named = [f"tests/{name}" for name in defect.tests if (ROOT / "tests" / name).is_file()]
    return [paths for paths in (named, [RECORDED]) if paths]


def confirm(tree: Tree, outcomes: dict[str, dict[str, object]], limit: float) -> None:
    """Run all tests that caught a defect without any, since they would catch nothing if they fail.

    Raises
    ------
    SystemExit
        If one of them fails.
    """
    caught_by = {str(line["by"]) for line in outcomes.values() if line["by"]}
    plain = re.compile(r"[\w./:-]+(\[[\w.-]+\])?")  # else all parameters of the test
    tests = {name if plain.fullmatch(name) else name.split("[")[0] for name in caught_by}
    outcome = tree.run(sorted(tests), limit)
    if outcome.found != SURVIVED:
        raise SystemExit(f"without a defect: {outcome.found} {outcome.by}")
    print(f"the {len(tests)} tests that catch defects pass without ({outcome.seconds:.0f} s)")


def run(arguments: argparse.Namespace, defects: Sequence[Defect]) -> None:
    """Run the tests on the defects that have no outcome yet."""
    done = {} if arguments.again else read_outcomes()
    todo = [defect for defect in defects if defect.id not in done]
    end = time.perf_counter() + 60.0 * arguments.minutes
    load_libraries()
    with TemporaryDirectory(prefix="legcal-defects-") as folder:
        tree = Tree(ROOT, Path(folder))
        if arguments.confirm:
            confirm(tree, read_outcomes(), 3600.0)
            return
        for defect in todo:
            if time.perf_counter() > end:
                print("the time is over; start again to continue")
                break
            outcome, seconds = Outcome(SURVIVED, "", 0.0), 0.0
            with tree.with_defect(defect):
                for command in commands(defect):
                    outcome = tree.run(command, arguments.limit)
                    seconds += outcome.seconds
                    if outcome.found != SURVIVED:
                        break
            line = {
                "id": defect.id,
                "found": outcome.found,
                "by": outcome.by,
                "seconds": round(seconds, 1),
            }
            with OUTCOMES.open("a", encoding="utf-8") as file:
                file.write(json.dumps(line) + "\n")
            print(f"{outcome.found:9}{seconds:7.1f} s  {defect.id:34}{outcome.by}", flush=True)
    table(defects, read_outcomes())


def table(defects: Sequence[Defect], outcomes: dict[str, dict[str, object]]) -> None:
    """Print the counts by concern."""
    columns = (CAUGHT, SURVIVED, TIMEOUT)
    counts: dict[str, Counter[str]] = {}
    for defect in defects:
        found = str(outcomes.get(defect.id, {}).get("found", ""))
        counts.setdefault(defect.concern, Counter())[found] += 1
    print(f"{'':20}{'defects':>9}" + "".join(f"{name:>10}" for name in columns))
    total = sum(counts.values(), Counter[str]())
    for name, count in [*counts.items(), ("all", total)]:
        print(f"{name:20}{count.total():9}" + "".join(f"{count[found]:10}" for found in columns))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--check", action="store_true", help="are all snippets there once?")
    parser.add_argument("--run", action="store_true", help="run those without an outcome")
    parser.add_argument("--only", nargs="+", default=[], metavar="ID")
    parser.add_argument("--concern", nargs="+", default=[])
    parser.add_argument("--again", action="store_true", help="repeat what has an outcome")
    parser.add_argument("--confirm", action="store_true", help="do those that catch pass without?")
    parser.add_argument("--limit", type=float, default=300.0, help="seconds of a run of pytest")
    parser.add_argument("--minutes", type=float, default=1e9, help="of all; then stop")
    arguments = parser.parse_args()
    every = read_defects()
    chosen = [
        defect
        for defect in every
        if (not arguments.only or defect.id in arguments.only)
        and (not arguments.concern or defect.concern in arguments.concern)
    ]
    defects = usable(chosen, read_package(ROOT))
    if arguments.run or arguments.confirm:
        run(arguments, defects)
    print(f"{len(defects)} of {len(chosen)} defects can be put into the package")
    raise SystemExit(0 if len(defects) == len(chosen) else 1)


if __name__ == "__main__":
    main()
